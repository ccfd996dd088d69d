"""report.html: a pair or a chain as one page that a browser opens without a network or a server."""

import base64
import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from html import escape
from importlib.resources import files
from io import BytesIO
from string import Template
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL.Image import fromarray

from soup_nlp.arrays import Float, Image, Mask
from soup_nlp.geometry.plane import inverse_depth
from soup_nlp.geometry.rotation import log, nearest
from soup_nlp.geometry.surface import hidden, whole_cells
from soup_nlp.report.chain import STILL, Chain
from soup_nlp.report.figures import Legend, Picture, component_colours
from soup_nlp.report.findings import ORIGINS, SAID, drawn_line
from soup_nlp.report.pictures import pictures
from soup_nlp.report.result import Result
from soup_nlp.start.components import TIES
from soup_nlp.storage.files import plain

MODES = {
    "image_ref": "image",
    "image_next": "next image",
    "depth_ref": "depth",
    "normals": "normal",
    "components": "component",
    "superpixels": "superpixels",
    "confidence": "sigma",
    "flow_confidence": "flow confidence",
    "error": "error",
}
"""Labels of the buttons that colour the 3D view, by name of the picture."""
IN_CHAIN = ("image_ref", "depth_ref", "normals", "components", "superpixels", "confidence", "error")
"""Pictures of every frame of a chain."""
LISTED = 8
"""Number of components whose motion is listed."""
SHOWN = 3
"""Smallest number of frames of a track that is shown; shorter tracks are mostly no objects."""
SIDES, MANY, QUALITY = (1600, 720), 16, 80
"""Larger side of a picture of a pair and of a chain, pixels; number of pairs above which pictures
are smaller; JPEG quality of those of a chain."""
PIXELS = 600_000, 4_000_000
"""Largest number of shown pixels of a pair, and of all pairs; larger images are subsampled."""


def page(chain: Chain, parts: Mapping[str, str], drawn: Mapping[str, Picture] | None = None) -> str:
    """The page as HTML that holds everything it shows.

    `parts` are HTML of "summary", the line below the title, and of sections by their titles;
    `drawn` are pictures of a pair, where they are drawn already.
    """
    sections = "".join(
        f"<div{' class=wide' * (title == 'Verdict')}><h2>{title}</h2>{text}</div>\n"
        for title, text in parts.items()
        if title != "summary" and text
    )
    return Template(_file("page.html")).substitute(
        title=escape(chain.name),
        style=_file("page.css"),
        summary=parts["summary"],
        sections=sections,
        three=_file("three.js"),
        script=_file("page.js"),
        # "<" could end the script element
        data=json.dumps(plain(make_scene(chain, drawn))).replace("<", "\\u003c"),
    )


def pair_page(result: Result, drawn: Mapping[str, Picture] | None = None) -> str:
    """The page of a result."""
    chain = Chain.of(result)
    parts = {
        "summary": _summary(result),
        "Paths": path_table(chain),
        "Verdict": preformatted(result.summary["verdict"]),
    }
    return page(chain, parts, drawn)


def _file(name: str) -> str:
    """Text of a script, style or template of the page."""
    return (files("soup_nlp.report") / "web" / name).read_text(encoding="utf-8")


def preformatted(lines: Sequence[str]) -> str:
    """Lines of text in HTML."""
    return "<pre>" + escape("\n".join(lines)) + "</pre>"


class Markup(str):
    """HTML of the program itself, which is not escaped."""


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in HTML; cells are text, or `Markup`."""
    top = "".join(f"<th>{escape(h)}</th>" for h in head)
    cells = [[c if isinstance(c, Markup) else escape(c) for c in row] for row in rows]
    body = "".join("<tr>" + "".join(f"<td>{c}</td>" for c in row) + "</tr>" for row in cells)
    return f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"


def _css(colour: Any) -> str:
    return "#" + "".join(f"{int(c):02x}" for c in colour)


def _packed(array: NDArray[Any]) -> str:
    """Numbers, deflated, as base64."""
    little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    return base64.b64encode(zlib.compress(little.tobytes(), 9)).decode("ascii")


def encoded(image: Image, kind: str, most: int = SIDES[0], **options: Any) -> str:
    """A picture (H, W, 3), reduced to a largest side of `most` pixels, as a data URI."""
    side = max(image.shape[:2])
    if side > most:
        size = [round(x * most / side) for x in image.shape[1::-1]]
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    data = BytesIO()
    fromarray(image).save(data, kind, **options)
    return f"data:image/{kind};base64,{base64.b64encode(data.getvalue()).decode('ascii')}"


def _figure(picture: Picture, pairs: int) -> dict[str, str]:
    """A picture for the data; of a single pair, those with a legend are stored without loss."""
    if pairs > 1:
        side = round(SIDES[1] * min(1.0, np.sqrt(MANY / pairs)))
        source = encoded(picture.image, "jpeg", side, quality=QUALITY)
    elif picture.legend is None:
        source = encoded(picture.image, "jpeg", quality=90)
    else:
        # the least effort takes a fifth of the time; files are half as large again
        source = encoded(picture.image, "webp", lossless=True, method=0, quality=50)
    return {"title": picture.title, "legend": _legend(picture.legend), "source": source}


def _legend(legend: Legend | None) -> str:
    if legend is None:
        return ""
    count, colours = legend.colours.shape[1], [*map(_css, legend.colours[0])]
    if legend.of_classes:
        stops = [f"{c} {k / count:.1%} {(k + 1) / count:.1%}" for k, c in enumerate(colours)]
    else:
        stops = [colours[k] for k in np.linspace(0, count - 1, 24).astype(int)]
    texts = "".join(f"<span>{escape(text)}</span>" for text in legend.texts)
    kind = "ticks classes" if legend.of_classes else "ticks"
    bar = f'<div class="bar" style="background:linear-gradient(to right,{",".join(stops)})"></div>'
    return f'{bar}<div class="{kind}">{texts}</div>'


def _summary(result: Result) -> str:
    """The most important figures in one line."""
    s, m = result.summary, result.summary["metrics"].get("solution")
    words = ["converged" if s["converged"] else f"not converged ({s['status']})"]
    words.append(f"{s['sizes']['superpixels']} superpixels")
    if m and m["mre"] is not None:
        words.append(f"MRE {m['mre']:.4f} after one {m['scale_rule']} scale")
    words.append(f"{np.mean(result.flow_confidence > 0):.0%} of the flow usable")
    whole = sum(v for k, v in s["seconds"].items() if not k.startswith("nlp_"))
    if whole:
        words.append(f"{whole:.1f} s")
    return headline(drawn_line(s["certainty"]), words)


def headline(drawn: str, words: Sequence[str]) -> str:
    """Figures in one line of HTML; the sentence on what is drawn is first."""
    strong = [f"<strong>{escape(drawn)}</strong>"] if drawn else []
    return " &middot; ".join([*strong, *map(escape, words)])


class Path(NamedTuple):
    """What moves, or the camera: its colour, first frame, points (3,) and share of the images."""

    name: str
    colour: str
    first: int
    points: list[Float]
    share: float | None = None


def paths(chain: Chain) -> list[Path]:
    """Paths of the camera and of what moves, in the shown unit, the largest first."""
    metre = chain.metre or 1.0
    camera = [metre * pose.t for pose in chain.world_from_camera]
    out = list[Path]()
    colours = component_colours(max(chain.track_numbers, default=0) + 1)
    for track in chain.track_numbers:
        path = chain.path(track)
        points = [metre * point for point in path.values()]
        moved = np.linalg.norm(points[-1] - points[0]) > 0.01 * abs(points[0][2])
        if moved if chain.single else len(path) >= SHOWN:
            first, share = min(path), chain.share(track)
            out.append(Path(f"component {track}", _css(colours[track]), first, points, share))
    out.sort(key=lambda one: -(one.share or 0.0))
    return [Path("camera", "#ffa94d", 0, camera), *out]


def path_table(chain: Chain) -> str:
    """The largest paths as a table."""
    rows, known = [], paths(chain)
    for path in known[: LISTED + 1]:
        length = float(np.linalg.norm(np.diff(path.points, axis=0), axis=1).sum())
        share = "" if path.share is None else f"{path.share:.1%}"
        frames = f"{path.first} to {path.first + len(path.points) - 1}"
        name = Markup(f'<i style="background:{path.colour}"></i>{escape(path.name)}')
        rows.append([name, share, frames, f"{length:.3g}"])
    rest = f"<p>Smaller ones: {len(known) - LISTED - 1}.</p>" if len(known) > LISTED + 1 else ""
    return (
        table(["path of", "share of the images", "frames", f"length, {chain.length}"], rows)
        + rest
        + "<p>What moves by itself has a scale of its own: its path is as good as its depth.</p>"
    )


# --- the data of the page: planes, motions, cameras and pictures ----------------------------------


def make_scene(chain: Chain, drawn: Mapping[str, Picture] | None = None) -> dict[str, Any]:
    """What page.js reads, in the shown unit and the first camera's axes.

    Returns:
        "pairs": see `make_pair`. "names": of the frames. "modes": names and words of the colours.
        "cameras": (4, 4) world_from_camera of every frame; of a pair whose surfaces bend, the
        identity. "paths": colour and points of what moves and of the camera. "middle", "far",
        "deepest": median depth, depth beyond which points are hidden at first, largest depth.
        "origins": words for what gives a component its scale. "kinds": words for kinds of depth.
    """
    metre, pairs, depths = chain.metre or 1.0, [], []
    most = min(PIXELS[0], PIXELS[1] / len(chain.pairs))
    for k in range(len(chain.pairs)):
        shown = drawn or pictures(chain, k)
        kept = {n: p for n, p in shown.items() if chain.single or n in IN_CHAIN}
        figures = {name: _figure(picture, len(chain.pairs)) for name, picture in kept.items()}
        packed = {
            name: _packed(value) if isinstance(value, np.ndarray) else value
            for name, value in make_pair(chain, k, most).items()
        }
        pairs.append({**packed, "pictures": figures})
        depths.append(chain.pairs[k].depths[0].ravel())
    z = metre * np.concatenate(depths)
    z = z[np.isfinite(z)]
    far, deepest = _far(z)
    still = chain.single and chain.pairs[0].bending
    poses = [STILL] * len(chain) if still else chain.world_from_camera
    names = [str(x).rpartition("/")[2] for x in chain.summary.get("sources", ())]
    return {
        "pairs": pairs,
        "names": names or ["reference frame", "next frame"],
        "modes": [[n, word] for n, word in MODES.items() if n in pairs[0]["pictures"]],
        "cameras": [replace(pose, t=metre * pose.t).matrix for pose in poses],
        "paths": [{"colour": p.colour, "points": p.points} for p in paths(chain)],
        "middle": float(np.median(z)) if z.size else 1.0,
        "far": far,
        "deepest": deepest,
        "unit": chain.length,
        "origins": [ORIGINS[name] for name in TIES],
        "kinds": [*SAID.values()],
    }


def make_pair(chain: Chain, k: int, most: float = PIXELS[0]) -> dict[str, Any]:
    """A pair in the shown unit, in the axes of its reference camera.

    Returns:
        Arrays in the types in which they are packed, numbers and lists:

        "labels": (h, w) superpixel of the shown pixels, every "step"-th in both directions.
        "planes": (N, 3) m with depth 1 / (m . ray).
        "motion": (N, 9) motion of every superpixel relative to the background: rotation vector w,
            pivot p and shift s; at time t a point X is at exp(t w) (X - p) + p + t s.
        "motionCamera": (N, 9) the same relative to the camera.
        "component": (N,) what moves as one, by track. "tie": (N,) index in "origins".
        "seen": (h, w) pixels that are visible in the next frame.
        "sigma": (h, w) standard deviation of log depth, 0 to 254 for 0 to 0.5; 255 where unknown.
        "surface": bits of the (h - 1, w - 1) cells of four pixels without a jump of the depth.
        "kind": (h, w) by what the depth is known, an index of "kinds".
        "drawn": share of the pixels whose depth is drawn.
    """
    result, scale = chain.pairs[k], chain.metre or 1.0
    rec, soup, start = result.reconstruction, result.soup, result.tree["start"]
    step = int(np.ceil(np.sqrt(max(rec.labels.size / most, 1.0))))
    every = np.s_[::step, ::step]
    R, T = nearest(soup.R), scale * soup.translation
    camera = STILL if result.bending else result.components.camera.inverse
    home = T @ camera.R.T + scale * camera.t
    pivot = _pivots(result, scale)
    labels, sigma = rec.labels[every], result.sigma[every]
    byte = np.where(np.isfinite(sigma), 254 * np.clip(sigma / 0.5, 0, 1), 255)
    return {
        "labels": labels.astype(np.uint16),
        "planes": _single(inverse_depth(soup.n, scale * soup.distance)),
        "motion": _single(_motion(camera.R @ R, home, pivot)),
        "motionCamera": _single(_motion(R, T, pivot)),
        "seen": (~hidden(rec)[every]).astype(np.uint8),
        "sigma": byte.round().astype(np.uint8),
        "kind": result.kind[every].astype(np.uint8),
        "component": chain.of_track(k)[result.components.of_superpixel].astype(np.uint16),
        "tie": np.asarray(start["tie"], np.uint8),
        "surface": np.packbits(surface_cells(result, step), bitorder="little"),
        "count": len(soup),
        "step": step,
        "size": rec.labels.shape[::-1],
        "grid": labels.shape[::-1],
        "sizeNext": rec.depth_next.shape[::-1],
        "K": result.K.tolist(),
        "KNext": result.K_next.tolist(),
        "drawn": float(result.drawn.mean()),
    }


def _single(values: Float) -> NDArray[np.float32]:
    """Numbers in single precision; those of a diverged solve are limited to its range."""
    limits = np.finfo(np.float32)
    return np.clip(values, limits.min, limits.max).astype(np.float32)


def surface_cells(result: Result, step: int) -> Mask:
    """(h - 1, w - 1) cells of four shown pixels without a jump of the depth."""
    return whole_cells(*result.surface, np.isfinite(result.reconstruction.depth_ref), step)


def _far(z: Float) -> tuple[float, float]:
    """Depth at which the view ends at first, and largest depth."""
    if not z.size:
        return 1.0, 1.0
    # sky and horizon may be orders of magnitude behind the rest; a wall at one depth is shown
    far = 1.001 * min(float(np.percentile(z, 99.5)), 4.0 * float(np.percentile(z, 70)))
    return far, float(z.max())


def _pivots(result: Result, scale: float) -> Float:
    """(N, 3) centre of the component of every superpixel, or of the superpixel if it bends."""
    parts, rec = result.components, result.reconstruction
    known = np.isfinite(rec.depth_ref)
    at, count = rec.labels[known], len(parts.of_superpixel)
    sums = [np.bincount(at, x, count) for x in rec.points_ref[known].T]
    centroid = np.stack(sums, axis=1) / np.maximum(np.bincount(at, minlength=count), 1)[:, None]
    common = np.stack([part.centre for part in parts])[parts.of_superpixel]
    return np.asarray(scale * np.nan_to_num(np.where(result.bends[:, None], centroid, common)))


def _motion(R: Float, T: Float, pivot: Float) -> Float:
    """(N, 9) rotation vectors, pivots and shifts of motions X' = R X + T."""
    shift = np.einsum("nij,nj->ni", R, pivot) + T - pivot
    return np.concatenate([log(R), pivot, shift], axis=1)
