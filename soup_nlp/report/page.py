"""report.html: a result as one page that a browser opens without a network or a server."""

import base64
import json
import zlib
from collections.abc import Mapping
from functools import cache
from html import escape
from importlib.resources import files
from io import BytesIO
from string import Template
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL.Image import fromarray

from soup_nlp.arrays import Float, Image, Mask
from soup_nlp.geometry.motion import RigidMotion
from soup_nlp.geometry.plane import inverse_depth
from soup_nlp.geometry.rotation import log, nearest
from soup_nlp.geometry.surface import hidden, whole_cells
from soup_nlp.report.colour import component_colours
from soup_nlp.report.findings import ORIGINS, guess_line
from soup_nlp.report.pictures import Bar, Picture, Swatches, Wheel
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
NOTES = {
    "image_next": "<p>The next frame on the points that it shows; dark grey = hidden there.</p>"
}
LISTED = 8
"""Number of components whose motion is listed."""
SIDE = 1600
"""Larger side of a picture in the page, pixels; larger pictures are resized."""


def page(result: Result, drawn: Mapping[str, Picture]) -> str:
    """The page of a result: HTML that holds everything it shows."""
    data = {
        "scene": {
            key: packed(value) if isinstance(value, np.ndarray) else value
            for key, value in make_scene(result).items()
        },
        "modes": [
            {"name": name, "word": word, "title": drawn[name].title,
             "legend": _legend(drawn[name]) + NOTES.get(name, "")}
            for name, word in MODES.items() if name in drawn
        ],
    }  # fmt: skip
    parts = {
        "title": escape(result.name),
        "style": web_file("page.css"),
        "summary": _summary(result),
        "gallery": "\n".join(_figure(picture) for picture in drawn.values()),
        "limits": "\n".join(f"<li>{escape(line)}</li>" for line in result.summary["limits"]),
        "components": _components(result),
        "verdict": escape("\n".join(result.summary["verdict"])),
    }
    return filled("page", data, parts)


def filled(name: str, data: Mapping[str, Any], parts: Mapping[str, object]) -> str:
    """A page as one HTML file: the template of a name with its script and other parts."""
    return Template(web_file(f"{name}.html")).substitute(
        parts,
        three=web_file("three.js"),
        script=web_file("view.js") + web_file(f"{name}.js"),
        # "<" could end the script element
        data=json.dumps(plain(data)).replace("<", "\\u003c"),
    )


@cache
def web_file(name: str) -> str:
    """Text of a script, style or template of the pages."""
    return (files("soup_nlp.report") / "web" / name).read_text(encoding="utf-8")


def packed(array: NDArray[Any]) -> str:
    """An array's numbers, deflated, as base64."""
    little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    return base64.b64encode(zlib.compress(little.tobytes(), 9)).decode("ascii")


def encoded(image: Image, kind: str, most: int = SIDE, **options: Any) -> str:
    """A picture (H, W, 3) as a data URI.

    Args:
        image: The picture.
        kind: "jpeg", "png" or "webp".
        most: Largest side, pixels; larger pictures are resized.
        options: Those of Pillow's encoder.
    """
    side = max(image.shape[:2])
    if side > most:
        size = [round(x * most / side) for x in image.shape[1::-1]]
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    data = BytesIO()
    fromarray(image).save(data, kind, **options)
    return f"data:image/{kind};base64,{base64.b64encode(data.getvalue()).decode('ascii')}"


def _legend(picture: Picture) -> str:
    """A legend in HTML."""
    legend = picture.legend
    if isinstance(legend, Bar):
        return colour_bar(legend)
    if isinstance(legend, Swatches):
        return '<div class="swatches">' + "".join(
            f'<span><i style="background:{_css(c)}"></i>{escape(text)}</span>'
            for c, text in legend.entries
        ) + "</div>"  # fmt: skip
    if isinstance(legend, Wheel):
        source = encoded(legend.image, "png")
        text = f"<span>{escape(legend.text)}</span>"
        return f'<div class="wheel"><img src="{source}" alt="">{text}</div>'
    return ""


def colour_bar(bar: Bar) -> str:
    """A colour scale with its values below, in HTML."""
    stops = bar.colours[0, np.linspace(0, bar.colours.shape[1] - 1, 24).astype(int)]
    ramp = ",".join(_css(c) for c in stops)
    texts = "".join(f"<span>{escape(text)}</span>" for text in bar.texts)
    return (
        f'<div class="bar" style="background:linear-gradient(to right,{ramp})"></div>'
        f'<div class="ticks">{texts}</div>'
    )


def _css(colour: Any) -> str:
    return "#" + "".join(f"{int(c):02x}" for c in colour)


def _figure(picture: Picture) -> str:
    """A picture with its title and legend in HTML; those with a legend are stored without loss."""
    if picture.legend is None:
        source = encoded(picture.image, "jpeg", quality=90)
    else:
        # the least effort takes a fifth of the time; files are half as large again
        source = encoded(picture.image, "webp", lossless=True, method=0, quality=50)
    title = escape(picture.title)
    return (
        f'<figure><figcaption>{title}</figcaption><img data-name="{picture.name}" alt="{title}"'
        f' src="{source}">{_legend(picture)}</figure>'
    )


def table(head: list[str], rows: list[list[str]]) -> str:
    """A table in HTML; cells are HTML."""
    top = "".join(f"<th>{escape(h)}</th>" for h in head)
    body = "".join("<tr>" + "".join(f"<td>{c}</td>" for c in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"


def _summary(result: Result) -> str:
    """The most important figures in one line."""
    s, m = result.summary, result.summary["metrics"].get("solution")
    words = ["converged" if s["converged"] else f"not converged ({s['status']})"]
    words.append(f"{s['sizes']['superpixels']} superpixels")
    if m and m["mre"] is not None:
        words.append(f"MRE {m['mre']:.4f} after one {m['scale_rule']} scale")
    usable = float(np.mean(result.flow_confidence > 0))
    words.append(f"{usable:.0%} of the flow usable")
    whole = sum(v for k, v in s["seconds"].items() if not k.startswith("nlp_"))
    if whole:
        words.append(f"{whole:.1f} s")
    figures = [escape(word) for word in words]
    if guess := guess_line(s["certainty"]):
        figures.insert(0, f"<strong>{escape(guess)}</strong>")
    return " &middot; ".join(figures)


def _components(result: Result) -> str:
    """Motions of the largest components, the camera's first."""
    parts, scale = result.components, result.scale
    colours = component_colours(len(parts))
    rows = []
    for part in [*parts][:LISTED]:
        motion = parts.camera.inverse if part.label == 0 else parts.own_motion(part.label)
        # shift of the camera centre, or of the centre of a component
        start = np.zeros(3) if part.label == 0 else part.centre
        shift = scale * float(np.linalg.norm(motion(start) - start))
        name = "0, the camera's motion" if part.label == 0 else str(part.label)
        rows.append(
            [
                f'<i style="background:{_css(colours[part.label])}"></i>{name}',
                f"{part.pixels / result.labels.size:.1%}",
                f"{motion.angle:.2f}&deg;",
                f"{shift:.3g} {escape(result.length)}",
                f"{part.residual_px:.2g} px",
            ]
        )
    rest = len(parts) - LISTED
    note = f"<p>Smaller components that are not listed: {rest}.</p>" if rest > 0 else ""
    head = ["component", "share of the image", "rotation", "shift", "not rigid by"]
    return table(head, rows) + note


# --- the data of the 3D view: planes, motions and cameras -----------------------------------------

MOST_PIXELS = 600_000
"""Larger images are subsampled for the view."""


def make_scene(result: Result) -> dict[str, Any]:
    """The 3D view of a result, in the shown unit and the reference camera's axes.

    Returns:
        Arrays, numbers and lists by the names that page.js reads. The arrays have the types in
        which they are packed:

        "labels": (h, w) superpixel of the shown pixels, every "step"-th in both directions.
        "planes": (N, 3) m with depth 1 / (m . ray).
        "motion": (N, 9) motion of every superpixel relative to the background: rotation vector w,
            pivot p and shift s; at time t a point X is at exp(t w) (X - p) + p + t s.
        "motionCamera": (N, 9) the same relative to the camera.
        "borrowed": (N,) the depth comes from neighbours.
        "component": (N,) what moves as one. "tie": (N,) index in "origins", words on its scale.
        "seen": (h, w) pixels that are visible in the next frame.
        "sigma": (h, w) standard deviation of log depth, 0 to 254 for 0 to 0.5; 255 where unknown.
        "surface": bits of the (h - 1, w - 1) cells of four pixels without a jump of the depth.
        "camera": (4, 4) reference_from_next; the identity if surfaces bend.
        "middle", "far", "deepest": median depth, depth beyond which points are hidden at first,
            largest depth.
    """
    rec = result.reconstruction
    step = int(np.ceil(np.sqrt(max(rec.labels.size / MOST_PIXELS, 1.0))))
    every = slice(None, None, step)
    n, lam, scale = result.soup("n"), result.soup("lam"), result.scale
    R, T = nearest(result.soup("R")), scale * lam[:, None] * result.soup("t")
    pivot = _pivots(result)
    camera = RigidMotion(np.eye(3), np.zeros(3))
    if not result.bending:
        pose = result.components.camera.inverse
        camera = RigidMotion(pose.R, scale * pose.t)
    z = scale * rec.depth_ref[np.isfinite(rec.depth_ref)]
    far, deepest = _far(z)
    labels, start = rec.labels[every, every], result.tree["start"]
    surface = np.packbits(surface_cells(result, step), bitorder="little")
    return {
        "labels": labels.astype(np.uint16),
        "planes": _single(inverse_depth(n, scale * lam * result.soup("d"))),
        "motion": _single(_motion(camera.R @ R, camera(T), pivot)),
        "motionCamera": _single(_motion(R, T, pivot)),
        "borrowed": (np.asarray(start["borrowed"], bool) & ~result.bends).astype(np.uint8),
        "seen": (~hidden(rec)[every, every]).astype(np.uint8),
        "sigma": _sigma(result)[every, every],
        "component": result.components.of_superpixel.astype(np.uint16),
        "tie": np.asarray(start["tie"], np.uint8),
        "surface": surface,
        "count": len(n),
        "step": step,
        "size": rec.labels.shape[::-1],
        "grid": labels.shape[::-1],
        "sizeNext": rec.depth_next.shape[::-1],
        "K": result.K[0].tolist(),
        "KNext": result.K[1].tolist(),
        "camera": camera.matrix.tolist(),
        "middle": float(np.median(z)) if z.size else 1.0,
        "far": far,
        "deepest": deepest,
        "unit": result.length,
        "origins": [ORIGINS[name][1] for name in TIES],
    }


def _single(values: Float) -> NDArray[np.float32]:
    """Numbers in single precision; those of a diverged solve are limited to its range."""
    limits = np.finfo(np.float32)
    return np.clip(values, limits.min, limits.max).astype(np.float32)


def surface_cells(result: Result, step: int) -> Mask:
    """(h - 1, w - 1) cells of four shown pixels without a jump of the depth."""
    return whole_cells(*result.surface, np.isfinite(result.reconstruction.depth_ref), step)


def _sigma(result: Result) -> NDArray[np.uint8]:
    """(H, W) sigma as a byte, see `make_scene`."""
    byte = np.rint(np.clip(result.sigma / 0.5, 0, 1) * 254)
    return np.where(np.isfinite(result.sigma), byte, 255).astype(np.uint8)


def _far(z: Float) -> tuple[float, float]:
    """Depth at which the view ends at first, and largest depth."""
    if not z.size:
        return 1.0, 1.0
    deepest = float(z.max())
    # sky and horizon may be orders of magnitude behind the rest
    return min(float(np.percentile(z, 99.5)), 4.0 * float(np.percentile(z, 70))), deepest


def _pivots(result: Result) -> Float:
    """(N, 3) centre of the component of every superpixel, or of the superpixel if it bends."""
    parts, rec = result.components, result.reconstruction
    known = np.isfinite(rec.depth_ref)
    at, count = rec.labels[known], len(parts.of_superpixel)
    sums = [np.bincount(at, x, count) for x in rec.points_ref[known].T]
    centroid = np.stack(sums, axis=1) / np.maximum(np.bincount(at, minlength=count), 1)[:, None]
    common = np.stack([part.centre for part in parts])[parts.of_superpixel]
    centre = np.where(result.bends[:, None], centroid, common)
    return np.asarray(result.scale * np.nan_to_num(centre))


def _motion(R: Float, T: Float, pivot: Float) -> Float:
    """(N, 9) rotation vectors, pivots and shifts of motions X' = R X + T."""
    shift = np.einsum("nij,nj->ni", R, pivot) + T - pivot
    return np.concatenate([log(R), pivot, shift], axis=1)
