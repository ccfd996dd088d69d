"""report.html: a pair or a chain as one page that a browser opens without a network or a server."""

import base64
import json
import zlib
from collections.abc import Mapping
from dataclasses import replace
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float
from soup_nlp.geometry.rotation import log, nearest
from soup_nlp.geometry.surface import hidden, whole_cells
from soup_nlp.report.chain import STILL, Chain
from soup_nlp.report.figures import Legend, Picture, component_colours, data_url
from soup_nlp.report.findings import ORIGIN_WORDS, SAID, drawn_line
from soup_nlp.report.pictures import pictures
from soup_nlp.report.result import Result
from soup_nlp.start.regions import ORIGINS
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
LEAST_PATH = 3
"""Smallest number of frames of a shown path of a chain; shorter ones are mostly no objects."""
SIDE, MANY = 1600, 4
"""Larger side of a picture, pixels; number of pairs above which pictures are smaller."""
MOST_PAIRS = 100
"""Largest number of pairs on a page; of a longer chain so many across all of it."""
PIXELS = 600_000, 4_000_000
"""Largest number of shown pixels of a pair, and of all pairs; larger images are subsampled."""


def page(chain: Chain, drawn: Mapping[str, Picture] | None = None) -> str:
    """The page as HTML that holds everything it shows; `drawn` are pictures of a pair, if drawn."""
    verdict = chain.summary.get("verdict") or [str(chain)]
    return Template(_file("page.html")).substitute(
        title=escape(chain.name),
        style=_file("page.css"),
        summary=_headline(chain),
        verdict=escape("\n".join(verdict)),
        three=_file("three.js"),
        script=_file("page.js"),
        # "<" could end the script element
        data=json.dumps(plain(make_scene(chain, drawn))).replace("<", "\\u003c"),
    )


def _file(name: str) -> str:
    return (files("soup_nlp.report") / "web" / name).read_text(encoding="utf-8")


def _headline(chain: Chain) -> str:
    """The most important figures in one line of HTML; the sentence on what is drawn is first."""
    told = chain.summary
    drawn = drawn_line(chain.certainty, "the image" if chain.single else "all images")
    words = [f"{len(chain)} frames"]
    if "status" in told:
        words.append("converged" if told["converged"] else f"not converged ({told['status']})")
    score = told.get("score") or {"mre_one_scale": None}
    scored = told.get("metrics", {}).get("solution", {"mre": score["mre_one_scale"]})
    if scored["mre"] is not None:
        words.append(f"MRE {scored['mre']:.4f} with one scale")
    strong = [f"<strong>{escape(drawn)}</strong>"] if drawn else []
    return " &middot; ".join([*strong, *map(escape, words)])


def _packed(array: NDArray[Any]) -> str:
    """Numbers, deflated, as base64."""
    data = array.astype(array.dtype.newbyteorder("<")).tobytes()
    return base64.b64encode(zlib.compress(data)).decode()


def _figure(picture: Picture, pairs: int) -> dict[str, str]:
    """A picture for the data; of a single pair, those with a legend are stored without loss."""
    image, most = picture.image, SIDE * min(1.0, np.sqrt(MANY / pairs))
    side = max(image.shape[:2])
    if side > most:
        size = [round(x * most / side) for x in image.shape[1::-1]]
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    exact = picture.legend is not None and pairs == 1
    # the least effort takes a fifth of the time; files are half as large again
    source = data_url(image, "webp", lossless=exact, method=0, quality=50 if exact else 90)
    return {"title": picture.title, "legend": _legend(picture.legend), "source": source}


def _legend(legend: Legend | None) -> str:
    if legend is None:
        return ""
    count, colours = legend.colours.shape[1], [f"#{c.tobytes().hex()}" for c in legend.colours[0]]
    if legend.of_classes:
        stops = [f"{c} {k / count:.1%} {(k + 1) / count:.1%}" for k, c in enumerate(colours)]
    else:
        stops = [colours[k] for k in np.linspace(0, count - 1, 24).astype(int)]
    texts = "".join(f"<span>{escape(text)}</span>" for text in legend.texts)
    kind = "ticks classes" if legend.of_classes else "ticks"
    bar = f'<div class="bar" style="background:linear-gradient(to right,{",".join(stops)})"></div>'
    return f'{bar}<div class="{kind}">{texts}</div>'


# --- the data of the page: planes, motions, cameras and pictures ----------------------------------


def make_scene(chain: Chain, drawn: Mapping[str, Picture] | None = None) -> dict[str, Any]:
    """What page.js reads, in the shown unit and the first camera's axes.

    Returns:
        "pairs": see `make_pair`. "names": of both frames of every pair. "modes": names and words of
        the colours. "cameras": (4, 4) world_from_camera of both; of a pair whose surfaces bend, the
        identity. "paths": colour and points of what moves and of the camera. "middle", "far",
        "deepest": median depth, depth beyond which points are hidden at first, largest depth.
        "origins": words for what gives a component its scale. "kinds": words for kinds of depth.
    """
    metre, count = chain.metre or 1.0, min(len(chain.pairs), MOST_PAIRS)
    at = np.linspace(0, len(chain.pairs) - 1, count).astype(int).tolist()
    pairs = []
    for k in at:
        pair = make_pair(chain, k, min(PIXELS[0], PIXELS[1] / count))
        shown = {n: _figure(one, count) for n, one in (drawn or pictures(chain, k)).items()}
        pair = {n: _packed(x) if isinstance(x, np.ndarray) else x for n, x in pair.items()}
        pairs.append({**pair, "pictures": shown})
    z = metre * chain.depths
    z = z[np.isfinite(z)] if np.isfinite(z).any() else np.ones(1)
    # sky and horizon may be orders of magnitude behind the rest; a wall at one depth is shown
    far = 1.001 * min(float(np.percentile(z, 99.5)), 4.0 * float(np.percentile(z, 70)))
    still = chain.single and chain.pairs[0].bends.all()
    poses = [STILL] * len(chain) if still else chain.world_from_camera
    cameras = [replace(pose, t=metre * pose.t).matrix for pose in poses]
    names = [str(x).rpartition("/")[2] for x in chain.summary.get("sources", ())]
    names = names or ["reference frame", "next frame"]
    return {
        "pairs": pairs,
        "names": [names[k : k + 2] for k in at],
        "modes": [[n, word] for n, word in MODES.items() if n in pairs[0]["pictures"]],
        "cameras": [cameras[k : k + 2] for k in at],
        "paths": _paths(chain, metre),
        "middle": float(np.median(z)),
        "far": far,
        "deepest": float(z.max()),
        "unit": chain.length,
        "origins": [ORIGIN_WORDS[name] for name in ORIGINS],
        "kinds": [*SAID.values()],
    }


def _paths(chain: Chain, metre: float) -> list[dict[str, Any]]:
    """Colours and points of the paths of the camera and of what moves."""
    camera = [metre * pose.t for pose in chain.world_from_camera]
    out = [{"colour": "#ffa94d", "points": camera}]
    colours = component_colours(max(chain.paths, default=0) + 1)
    for track, path in chain.paths.items():
        points = [metre * point for point in path.values()]
        moved = np.linalg.norm(points[-1] - points[0]) > 0.01 * abs(points[0][2])
        if moved if chain.single else len(points) >= LEAST_PATH:
            out.append({"colour": f"#{colours[track].tobytes().hex()}", "points": points})
    return out


def make_pair(chain: Chain, k: int, most: float = PIXELS[0]) -> dict[str, Any]:
    """A pair in the shown unit, in the axes of its reference camera.

    Returns:
        Arrays in the types in which they are packed, numbers and lists:

        "labels": (h, w) superpixel of the shown pixels, every "step"-th in both directions.
        "planes": (N, 3) m with depth 1 / (m . ray).
        "detail": (h, w) log depth relative to the planes, in thousandths.
        "motion": (N, 9) motion of every superpixel relative to the background: rotation vector w,
            pivot p and shift s; at time t a point X is at exp(t w) (X - p) + p + t s.
        "motionCamera": (N, 9) the same relative to the camera.
        "component": (N,) what moves as one, by track. "origin": (N,) index in "origins".
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
    camera = STILL if result.bends.all() else result.components.camera.inverse
    home = T @ camera.R.T + scale * camera.t
    pivot = _pivots(result, scale)
    labels, sigma, known = rec.labels[every], result.sigma[every], np.isfinite(rec.depth_ref)
    byte = np.where(np.isfinite(sigma), 254 * np.clip(sigma / 0.5, 0, 1), 255)
    return {
        "labels": labels.astype(np.uint16),
        "planes": _single(result.planes[0] / scale),
        "detail": (1000 * result.detail[every]).round().astype(np.int16),
        "motion": _single(_motion(camera.R @ R, home, pivot)),
        "motionCamera": _single(_motion(R, T, pivot)),
        "seen": (~hidden(rec)[every]).astype(np.uint8),
        "sigma": byte.round().astype(np.uint8),
        "kind": result.kind[every].astype(np.uint8),
        "component": chain.tracks[k][result.components.of_superpixel].astype(np.uint16),
        "origin": np.asarray(start["origin"], np.uint8),
        "surface": np.packbits(whole_cells(*result.surface, known, step), bitorder="little"),
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
