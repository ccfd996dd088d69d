"""The page of a chain: images and depths with a slider, a plan view of paths, a table."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from soup_nlp.arrays import Float, Image
from soup_nlp.report.colour import colourise_depth
from soup_nlp.report.page import colour_bar, encoded, packed, table, web_file
from soup_nlp.report.pictures import Bar
from soup_nlp.sequence.chain import Chain
from soup_nlp.sequence.fused import Cloud, fuse, movers, shown_tracks
from soup_nlp.storage.store import plain

WIDTH = 720
"""Largest width of an image in the page, pixels."""
MANY = 24
"""Frames above which the images have half the width."""
STILL, MOVING = 120_000, 60_000
"""Largest numbers of points of the static scene, and of what moves in all frames."""
QUALITY = 80
"""JPEG quality of the images."""
PLAN = 360
"""Side of the plan view, pixels."""
COLOURS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#17becf")


def chain_page(
    chain: Chain,
    contents: Mapping[str, Any],
    images: Sequence[Image],
    depths: Sequence[Image],
    span: tuple[float, float],
) -> str:
    """The page as one HTML file.

    Args:
        chain: The chain.
        contents: Contents of chain.json.
        images: (H, W, 3) image of every frame.
        depths: (H, W, 3) its depth in colour, one range for all.
        span: That range, (near, far).
    """
    # long sequences have smaller pictures
    width = WIDTH if len(images) <= MANY else WIDTH // 2
    data = {
        "frames": [[_jpeg(a, width), _jpeg(b, width)] for a, b in zip(images, depths)],
        "names": [Path(x).name for x in contents["sources"]],
        "scene": _scene(chain),
    }
    title = html.escape(str(contents["name"]))
    return _PAGE.format(
        title=title,
        last=len(chain) - 1,
        # "<" could end the script element
        data=json.dumps(plain(data)).replace("<", "\\u003c"),
        three=web_file("three.js"),
        script=web_file("chain.js"),
        bar=_bar(*span),
        plan=_plan(chain),
        table=_table(contents),
        unit=html.escape(str(contents["unit"])),
    )


def _scene(chain: Chain) -> dict[str, Any]:
    """The 3D view: clouds, paths and cameras as numbers and packed arrays."""
    still = fuse(chain)
    still = still.kept(np.arange(0, len(still), max(1, -(-len(still) // STILL))))
    most = MOVING // len(chain)
    moving = []
    for k in range(len(chain)):
        own = movers(chain, k)
        moving.append(own.kept(np.arange(0, len(own), max(1, -(-len(own) // most)))))
    result = chain.pairs[0].result
    K, (height, width) = result.K[0], result.images[0].shape[:2]
    far = float(np.abs(still.points).max(initial=1.0))
    return {
        "still": _cloud(still),
        "moving": [_cloud(own) for own in moving],
        "tracks": [
            {"path": list(chain.path(t).values()), "colour": COLOURS[k % len(COLOURS)]}
            for k, t in enumerate(shown_tracks(chain))
        ],
        "cameras": [pose.matrix for pose in chain.world_from_camera],
        "K": [K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
        "size": [width, height],
        "middle": float(np.median(still.points[:, 2])) if len(still) else 1.0,
        "far": far,
    }


def _cloud(cloud: Cloud) -> dict[str, str]:
    points, colours = packed(cloud.points, np.float32), packed(cloud.colours, np.uint8)
    return {"points": points, "colours": colours}


def _jpeg(image: Image, most: int) -> str:
    """A picture of at most so many columns as the address of its data."""
    height, width = image.shape[:2]
    if width > most:
        size = (most, round(height * most / width))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return encoded(image, "jpeg", [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


def _bar(near: float, far: float) -> str:
    """The colours of depth with their values, as HTML."""
    z = 1 / np.linspace(1 / far, 1 / near, 25)
    return colour_bar(Bar(colourise_depth(z[None], near, far), tuple(f"{x:.3g}" for x in z[::6])))


def _plan(chain: Chain) -> str:
    """Camera and tracks from above, x to the right and z upwards, with a scale, as SVG."""
    camera = np.array([m.t for m in chain.world_from_camera])
    names = sorted({t for own in chain.tracks for t in own.values()} - {0})
    paths = {t: np.array(list(chain.path(t).values())) for t in names}
    # tracks in one pair only are mostly not real bodies
    paths = {t: p for t, p in paths.items() if len(p) > 2}
    points = np.concatenate([camera, *paths.values()])[:, [0, 2]]
    low, high = points.min(axis=0), points.max(axis=0)
    size = float(max((high - low).max(), 1e-9))
    middle = (low + high) / 2

    def place(p: Float) -> str:
        xy = ((p[:, [0, 2]] - middle) / size * 0.86 + 0.5) * PLAN
        return " ".join(f"{x:.1f},{PLAN - y:.1f}" for x, y in xy)

    def line(p: Float, colour: str, text: str) -> str:
        spots = place(p)
        x, y = spots.split()[-1].split(",")
        dots = "".join(
            f'<circle cx="{s.split(",")[0]}" cy="{s.split(",")[1]}" r="3" fill="{colour}"/>'
            for s in spots.split()
        )
        return (
            f'<polyline points="{spots}" fill="none" stroke="{colour}" stroke-width="2"/>{dots}'
            f'<text x="{x}" y="{y}" dx="6" dy="4" fill="{colour}">{text}</text>'
        )

    drawn = [line(camera, "#222", "camera")]
    drawn += [
        line(p, COLOURS[k % len(COLOURS)], f"track {t}") for k, (t, p) in enumerate(paths.items())
    ]
    # a round length of about a fifth of the plot
    unit = 10 ** np.floor(np.log10(size / 3))
    long, y = unit / size * 0.86 * PLAN, PLAN - 12
    drawn.append(
        f'<path d="M 12 {y} h {long:.1f}" stroke="#222" stroke-width="2"/>'
        f'<text x="{18 + long:.1f}" y="{y + 4}">{unit:g} units</text>'
    )
    return f'<svg width="{PLAN}" height="{PLAN}" viewBox="0 0 {PLAN} {PLAN}">{"".join(drawn)}</svg>'


def _table(contents: Mapping[str, Any]) -> str:
    """Links, and scores where there is a truth, as a table of HTML."""
    true = {tuple(k["pairs"]): k["true"] for k in (contents["score"] or {}).get("links", ())}
    rows = []
    for k in contents["links"]:
        a, b = k["pairs"]
        known = f"{true[a, b]:.3f}" if (a, b) in true else ""
        note = "bridge" if k["bridge"] else "a guess" if k["flagged"] else ""
        numbers = [f"{k['ratio']:.3f}", f"{k['spread']:.3f}", known, str(k["pixels"])]
        rows.append([f"{a}, {b}", *numbers, note])
    heads = ["pairs", "ratio of scales", "spread (log)", "true ratio", "pixels", ""]
    out = table(heads, rows)
    if contents["score"]:
        s = contents["score"]
        out += (
            f"<p>Mean relative error: {s['mre_own_scale']:.4f} with a scale for every frame,"
            f" {s['mre_one_scale']:.4f} with one for the sequence ({s['cost']:+.1%}).</p>"
        )
    return out


_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<style>
body {{ font: 15px/1.4 system-ui, sans-serif; margin: 1.2em; color: #222; }}
#stage {{ position: relative; height: 58vh; background: #20262e; }}
#canvas {{ width: 100%; height: 100%; display: block; }}
#message {{ position: absolute; inset: 1em; color: #ddd; }} label {{ margin: 0 .6em; }}
#size {{ width: 7em; }}
.row {{ display: flex; flex-wrap: wrap; gap: 1em; align-items: flex-start; }}
figure {{ margin: 0; }} .pictures figure {{ flex: 1 1 380px; max-width: 720px; }}
img {{ width: 100%; max-height: 62vh; object-fit: contain; object-position: left; }}
img {{ display: block; }} .row + .row {{ margin-top: 1em; }}
figcaption {{ color: #555; }} input[type=range] {{ width: 24em; max-width: 60vw; }}
.row > figure:has(svg) {{ max-width: 362px; }} .words {{ flex: 1 1 300px; min-width: 0; }}
.bar {{ height: 10px; margin-top: 4px; }}
.ticks {{ display: flex; justify-content: space-between; font-size: 12px; }}
table {{ border-collapse: collapse; }} td, th {{ padding: .2em .7em; text-align: right; }}
tr:nth-child(even) {{ background: #f3f3f3; }} svg {{ border: 1px solid #ddd; font-size: 12px; }}
</style></head><body>
<h1>{title}</h1>
<div id="stage"><canvas id="canvas" aria-label="3D view"></canvas><p id="message">loading</p></div>
<p><span id="views"></span>
<label>point size <input id="size" type="range" min="1" max="8" value="2"></label>
<label><input id="movers" type="checkbox" checked> what moves</label>
<label><input id="paths" type="checkbox" checked> its paths</label>
<label><input id="cameras" type="checkbox" checked> cameras</label>
<label><input id="follow" type="checkbox"> look from the camera</label>
drag: turn, right drag: move, wheel: zoom</p>
<p><button id="play">play</button>
<input id="time" type="range" min="0" max="{last}" value="0" aria-label="frame">
<span id="now">frame 0</span></p>
<p>The static scene of all frames as one cloud: guesses and points that contradict a surer frame
are left out, so that there are holes behind what moves.</p>
<div class="row pictures">
<figure><img id="image" alt="image"><figcaption>image</figcaption></figure>
<figure><img id="depth" alt="depth"><figcaption>
{bar}depth in units, one scale and one colour range for all frames; grey is
unknown</figcaption></figure>
</div>
<div class="row">
<figure>{plan}<figcaption>
from above: x to the right, z (ahead) upwards; a dot is a frame. What moves by itself has a
scale of its own in every pair: its path is as good as its depth.</figcaption>
</figure>
<div class="words">{table}<p>Unit of length: {unit}.</p></div>
</div>
<script>{three}</script>
<script type="application/json" id="data">{data}</script>
<script>{script}</script></body></html>
"""
