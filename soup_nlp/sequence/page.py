"""The page of a chain: 3D view, images and depths with a slider, tables of tracks and links."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any

import cv2
import numpy as np

from soup_nlp.arrays import Image
from soup_nlp.report.colour import colourise_depth
from soup_nlp.report.page import colour_bar, encoded, packed, table, web_file
from soup_nlp.report.pictures import Bar
from soup_nlp.sequence.chain import Chain
from soup_nlp.sequence.fused import Cloud, fuse, movers, shown_tracks
from soup_nlp.sequence.score import LINK_HEADS, link_rows, score_text
from soup_nlp.storage.store import plain

WIDTH = 720
"""Largest width of an image in the page, pixels."""
MANY = 24
"""Frames above which the images have half the width."""
STILL, MOVING = 120_000, 60_000
"""Largest numbers of points of the static scene, and of what moves in all frames."""
QUALITY = 80
"""JPEG quality of the images."""
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
    scene = _scene(chain)
    data = {
        "frames": [[_jpeg(a, width), _jpeg(b, width)] for a, b in zip(images, depths)],
        "names": [Path(x).name for x in contents["sources"]],
        "scene": scene,
    }
    near, far = span
    z = 1 / np.linspace(1 / far, 1 / near, 25)
    ticks = tuple(f"{x:.3g}" for x in z[::6])
    links = table(LINK_HEADS, link_rows(contents))
    if contents["score"]:
        links += f"<p>{score_text(contents['score'])}.</p>"
    return Template(web_file("chain.html")).substitute(
        title=html.escape(str(contents["name"])),
        last=len(chain) - 1,
        # "<" could end the script element
        data=json.dumps(plain(data)).replace("<", "\\u003c"),
        three=web_file("three.js"),
        script=web_file("chain.js"),
        bar=colour_bar(Bar(colourise_depth(z[None], near, far), ticks)),
        tracks=_tracks(chain, scene["tracks"]),
        links=links,
        unit=html.escape(str(contents["unit"])),
    )


def _scene(chain: Chain) -> dict[str, Any]:
    """The 3D view: clouds, paths and cameras as numbers and packed arrays."""
    still = fuse(chain).thinned(STILL)
    K, (height, width) = chain.camera(0), chain.image(0).shape[:2]
    return {
        "still": _cloud(still),
        "moving": [
            _cloud(movers(chain, k).thinned(MOVING // len(chain))) for k in range(len(chain))
        ],
        "tracks": [
            {"track": t, "path": [*chain.path(t).values()], "colour": COLOURS[k % len(COLOURS)]}
            for k, t in enumerate(shown_tracks(chain))
        ],
        "cameras": [pose.matrix for pose in chain.world_from_camera],
        "K": [K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
        "size": [width, height],
        "middle": float(np.median(still.points[:, 2])) if len(still) else 1.0,
        "far": float(np.abs(still.points).max(initial=1.0)),
    }


def _cloud(cloud: Cloud) -> dict[str, str]:
    points, colours = packed(cloud.points.astype(np.float32)), packed(cloud.colours)
    return {"points": points, "colours": colours}


def _jpeg(image: Image, most: int) -> str:
    """A picture of at most so many columns as the address of its data."""
    height, width = image.shape[:2]
    if width > most:
        size = (most, round(height * most / width))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return encoded(image, "jpeg", [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


def _tracks(chain: Chain, tracks: Sequence[Mapping[str, Any]]) -> str:
    """The paths of the 3D view as a table: colour, first and last frame, length."""
    paths = [("camera", "#ffa94d", 0, [pose.t for pose in chain.world_from_camera])]
    for track in tracks:
        first = min(chain.path(track["track"]))
        paths.append((f"track {track['track']}", track["colour"], first, track["path"]))
    rows = []
    for name, colour, first, path in paths:
        long = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
        mark = f'<i style="color:{colour}">&#9644;</i> {name}'
        rows.append([mark, f"{first} to {first + len(path) - 1}", f"{long:.3g}"])
    return table(["path", "frames", "length, units"], rows)
