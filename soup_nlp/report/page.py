"""report.html: a result as one page that a browser opens without a network or a server."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Mapping
from functools import cache
from html import escape
from importlib.resources import files
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Image
from soup_nlp.errors import DataError
from soup_nlp.evaluate.metrics import skill
from soup_nlp.report.colour import component_colours
from soup_nlp.report.limits import limits
from soup_nlp.report.pictures import Bar, Picture, Swatches, Wheel
from soup_nlp.report.result import Result
from soup_nlp.report.scene3d import PageScene, make_scene
from soup_nlp.report.verdict import TITLES
from soup_nlp.start.components import TIES
from soup_nlp.storage.store import plain

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


def page(shown: Result, found: Mapping[str, Picture]) -> str:
    """The page of a result: HTML that holds everything it shows."""
    scene = make_scene(shown)
    data = {
        "scene": _scene(shown, scene),
        "modes": [
            {"name": name, "word": word, "title": found[name].title,
             "legend": _legend(found[name]) + NOTES.get(name, "")}
            for name, word in MODES.items() if name in found
        ],
    }  # fmt: skip
    images = {name: _data_uri(picture) for name, picture in found.items()}
    parts = {
        "title": escape(shown.name),
        "style": web_file("page.css"),
        "summary": _summary(shown),
        "gallery": "\n".join(_figure(picture, images[name]) for name, picture in found.items()),
        "limits": "\n".join(f"<li>{escape(line)}</li>" for line in limits(shown)),
        "energy": _energy(shown),
        "accuracy": _accuracy(shown),
        "components": _components(shown),
        "verdict": escape(shown.verdict) or "not recorded",
        "three": web_file("three.js"),
        "script": web_file("page.js"),
        # "<" could end the script element
        "data": json.dumps(plain(data)).replace("<", "\\u003c"),
    }
    head, *rest = web_file("page.html").split("{{")
    out = [head]
    for piece in rest:
        name, _, text = piece.partition("}}")
        out += [parts[name], text]
    return "".join(out)


@cache
def web_file(name: str) -> str:
    """A file of the pages."""
    return (files("soup_nlp.report") / "web" / name).read_text(encoding="utf-8")


def _scene(shown: Result, scene: PageScene) -> dict[str, Any]:
    """The 3D view as numbers, lists and packed arrays."""
    height, width = shown.labels.shape
    arrays = {
        "labels": (scene.labels, np.uint16),
        "planes": (scene.planes, np.float32),
        "motion": (scene.motion, np.float32),
        "motionCamera": (scene.motion_camera, np.float32),
        "guess": (scene.guess, np.uint8),
        "seen": (scene.seen, np.uint8),
        "sigma": (scene.sigma, np.uint8),
        "component": (shown.components.of_superpixel, np.uint16),
        "tie": (np.asarray(shown.tree["start"]["tie"]), np.uint8),
        "surface": (np.packbits(scene.surface, bitorder="little"), np.uint8),
    }
    return {
        **{key: packed(array, kind) for key, (array, kind) in arrays.items()},
        "count": len(scene.planes),
        "step": scene.step,
        "size": [width, height],
        "grid": [scene.labels.shape[1], scene.labels.shape[0]],
        "sizeNext": _next_size(shown),
        "K": shown.array("input/K_ref"),
        "KNext": shown.array("input/K_next"),
        "camera": scene.camera,
        "middle": scene.middle,
        "far": scene.far,
        "deepest": scene.deepest,
        "unit": shown.length,
        "ties": TIES,
    }


def _next_size(shown: Result) -> list[int]:
    depth = shown.array("depth/next")
    assert depth is not None
    return [depth.shape[1], depth.shape[0]]


def packed(array: NDArray[Any], kind: type) -> str:
    """An array's numbers, deflated, as base64."""
    if np.issubdtype(kind, np.floating):
        # limits values of a diverged solve
        array = np.clip(array, np.finfo(kind).min, np.finfo(kind).max)
    little = np.ascontiguousarray(array, np.dtype(kind).newbyteorder("<"))
    return base64.b64encode(zlib.compress(little.tobytes(), 9)).decode("ascii")


def _data_uri(picture: Picture) -> str:
    """A picture as a data URI: photographs as JPEG, pictures with a legend as lossless WebP."""
    image, side = picture.image, max(picture.image.shape[:2])
    if side > SIDE:
        size = [round(x * SIDE / side) for x in image.shape[1::-1]]
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    photo = picture.legend is None
    # a quality above 100 is lossless
    kind, options = ("jpeg", [cv2.IMWRITE_JPEG_QUALITY, 90]) if photo else (
        "webp", [cv2.IMWRITE_WEBP_QUALITY, 101])  # fmt: skip
    return encoded(image, kind, options)


def encoded(image: Image, kind: str, options: list[int] | None = None) -> str:
    """A picture (H, W, 3) as a data URI; `kind` is "jpeg", "png" or "webp"."""
    good, data = cv2.imencode(f".{kind}", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), options or [])
    if not good:
        raise DataError("image cannot be encoded", where="report.html", found=kind)
    return f"data:image/{kind};base64,{base64.b64encode(data.tobytes()).decode('ascii')}"


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


def _figure(picture: Picture, source: str) -> str:
    """A picture with its title and legend in HTML."""
    title = escape(picture.title)
    return (
        f'<figure><figcaption>{title}</figcaption><img data-name="{picture.name}" alt="{title}"'
        f' src="{source}">{_legend(picture)}</figure>'
    )


def _number(value: Any, form: str = ".4g") -> str:
    return "" if value is None else format(float(value), form)


def table(head: list[str], rows: list[list[str]]) -> str:
    """A table in HTML; cells are HTML."""
    top = "".join(f"<th>{escape(h)}</th>" for h in head)
    body = "".join("<tr>" + "".join(f"<td>{c}</td>" for c in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"


def _summary(shown: Result) -> str:
    """The most important figures in one line."""
    s, m = shown.summary, shown.summary["metrics"].get("solution")
    words = ["converged" if s["converged"] else f"not converged ({s['status']})"]
    words.append(f"{s['sizes']['superpixels']} superpixels")
    if m and m["mre"] is not None:
        words.append(f"MRE {m['mre']:.4f} after one {m['scale_rule']} scale")
    usable = float((np.asarray(shown.array("input/confidence")) > 0).mean())
    words.append(f"{usable:.0%} of the flow usable")
    whole = sum(v for k, v in s["seconds"].items() if not k.startswith("nlp_"))
    if whole:
        words.append(f"{whole:.1f} s")
    return " &middot; ".join(escape(word) for word in words)


def _energy(shown: Result) -> str:
    """Exact energy by stage, with a bar for each total, or for what the refinement minimises."""
    stages = {"start": "start", "nlp": "NLP", "solution": "solution"}
    known = {k: shown.summary["energy"][k] for k in stages if k in shown.summary["energy"]}
    terms = list(known["solution"])
    refinement = shown.summary.get("refinement")
    lowered, note = {}, ""
    if refinement and "photo" in refinement["end"]:
        lowered = dict(zip(stages, (refinement[k] for k in ("start", "begin", "end"))))
        note = (
            "<p>The NLP minimises E, its total; the refinement minimises E + E_photo, in which the"
            " images outweigh the flow where they contradict it (at"
            f" {refinement['contradicted']} superpixels). E may rise there.</p>"
        )
    # the bars are of E + E_photo where there is one
    lengths = {key: float((lowered or known)[key]["total"] or 0) for key in known}
    most = max(lengths.values()) or 1.0
    rows = []
    for key, energy in known.items():
        width = 100 * lengths[key] / most
        bar = f'<div class="length" style="width:{width:.1f}%"></div>'
        cells = [_number(energy.get(t)) for t in terms]
        cells += [_number(lowered[key]["total"])] if lowered else []
        rows.append([stages[key], *cells, bar])
    return table(["stage", *terms, *["E + E_photo"] * bool(lowered), ""], rows) + note


def _accuracy(shown: Result) -> str:
    """Scores of the solution and of the baselines."""
    metrics: Mapping[str, Any] = shown.summary["metrics"]
    if not metrics:
        return "<p>There is no truth to compare with.</p>"
    worst = (metrics.get("constant") or {}).get("mre") or float("nan")
    order = ("solution", "nlp", "start", "rigid", "constant", "solution_next")
    rows = [
        [
            escape({"solution_next": "solution, next frame"}.get(name, TITLES.get(name, name))),
            _number(m["mre"]),
            _number(m["median_relative"]),
            "" if name == "solution_next" else _number(skill(m["mre"] or np.nan, worst), ".3f"),
            _number(100 * m["coverage"], ".1f") + " %",
        ]
        for name in order
        if (m := metrics.get(name))
    ]
    return table(["depth", "MRE", "median error", "skill", "coverage"], rows)


def _components(shown: Result) -> str:
    """Motions of the largest components, the camera's first."""
    parts, scale = shown.components, shown.scale
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
                f"{part.pixels / shown.labels.size:.1%}",
                f"{motion.angle:.2f}&deg;",
                f"{shift:.3g} {escape(shown.length)}",
                f"{part.residual_px:.2g} px",
            ]
        )
    rest = len(parts) - LISTED
    note = f"<p>Smaller components that are not listed: {rest}.</p>" if rest > 0 else ""
    head = ["component", "share of the image", "rotation", "shift", "not rigid by"]
    return table(head, rows) + note
