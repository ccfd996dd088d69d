"""A chain for viewers: its page, and an animated GLB.

The page has a 3D view, images and depths with a slider, tables of tracks and links. The GLB (glTF
2.0, binary) has the static scene, what moves, and the camera.
"""

from __future__ import annotations

import html
import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, Image
from soup_nlp.geometry.motion import RigidMotion
from soup_nlp.report.colour import colourise_depth, depth_range
from soup_nlp.report.models import GLTF
from soup_nlp.report.page import colour_bar, encoded, packed, table, web_file
from soup_nlp.report.pictures import Bar
from soup_nlp.sequence.chain import Chain
from soup_nlp.sequence.fused import Cloud, fuse, movers, shown_tracks
from soup_nlp.sequence.score import LINK_HEADS, link_rows, score_text
from soup_nlp.storage.files import PathLike, write_bytes
from soup_nlp.storage.store import plain

WIDTH = 720
"""Larger side of an image in the page, pixels."""
MANY = 24
"""Frames above which the images have half the width."""
STILL, MOVING = 120_000, 60_000
"""Largest numbers of points of the static scene, and of what moves in all frames."""
QUALITY = 80
"""JPEG quality of the images."""
COLOURS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#17becf")


def depth_pictures(chain: Chain) -> tuple[list[Image], tuple[float, float]]:
    """Depth of every frame in colour, and the range of the colours (near, far), one for all."""
    depths = [chain.depth(k) for k in range(len(chain))]
    span = depth_range(np.concatenate([z.ravel()[::7] for z in depths]))
    return [colourise_depth(z, *span) for z in depths], span


def chain_page(chain: Chain, contents: Mapping[str, Any]) -> str:
    """The page as one HTML file, with the contents of chain.json."""
    pictures, (near, far) = depth_pictures(chain)
    # long sequences have smaller pictures
    width = WIDTH if len(chain) <= MANY else WIDTH // 2
    quality = [cv2.IMWRITE_JPEG_QUALITY, QUALITY]
    scene = _scene(chain)
    data = {
        "frames": [
            [encoded(image, "jpeg", quality, width) for image in (chain.image(k), picture)]
            for k, picture in enumerate(pictures)
        ],
        "names": [Path(x).name for x in contents["sources"]],
        "scene": scene,
    }
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

    def points(cloud: Cloud) -> dict[str, str]:
        numbers = packed(cloud.points.astype(np.float32))
        return {"points": numbers, "colours": packed(cloud.colours)}

    moving = [movers(chain, k).thinned(MOVING // len(chain)) for k in range(len(chain))]
    return {
        "still": points(still),
        "moving": [*map(points, moving)],
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


# --- animated GLB --------------------------------------------------------------------------------

RATE = 5.0
"""Frames a second, of the video too."""
FLOAT, UBYTE = 5126, 5121
"""glTF's numbers of the types."""


class _Buffer:
    """Binary part of a GLB with its views and accessors."""

    def __init__(self) -> None:
        self.data = b""
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, array: NDArray[Any]) -> int:
        """Number of the accessor of an array (M, ...) of float32, with its limits, or uint8."""
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[1 if array.ndim == 1 else array.shape[1]]
        raw = np.ascontiguousarray(array).tobytes()
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(raw)})
        self.data += raw + b"\0" * (-len(raw) % 4)
        accessor: dict[str, Any] = {
            "bufferView": len(self.views) - 1,
            "componentType": UBYTE if array.dtype == np.uint8 else FLOAT,
            "count": len(array),
            "type": kind,
        }
        if array.dtype == np.uint8:
            accessor["normalized"] = True
        else:
            low, high = np.atleast_1d(array.min(axis=0)), np.atleast_1d(array.max(axis=0))
            accessor |= {"min": low.tolist(), "max": high.tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def write_animation(path: PathLike, chain: Chain, contents: Mapping[str, Any]) -> None:
    """Write the sequence; axes of glTF, world = the first frame's camera, five frames a second.

    Nodes are "static scene", "track N" for what moves, and "camera". A track has the points of its
    first frame, which move rigidly from frame to frame as its component does.
    """
    buffer, meshes, nodes, channels, samplers = _Buffer(), [], [], [], []
    times = buffer.add(np.arange(len(chain), dtype=np.float32) / np.float32(RATE))

    def animate(node: int, poses: list[RigidMotion]) -> None:
        for what, values in (
            ("translation", np.array([GLTF @ p.t for p in poses])),
            ("rotation", _quaternions(poses)),
        ):
            output = buffer.add(values.astype(np.float32))
            samplers.append({"input": times, "output": output, "interpolation": "LINEAR"})
            target = {"node": node, "path": what}
            channels.append({"sampler": len(samplers) - 1, "target": target})

    def mesh(cloud: Cloud, name: str) -> int:
        white = np.full((len(cloud), 1), 255, np.uint8)
        places = {
            "POSITION": buffer.add((cloud.points @ GLTF).astype(np.float32)),
            "COLOR_0": buffer.add(np.hstack([cloud.colours, white])),
        }
        meshes.append({"name": name, "primitives": [{"attributes": places, "mode": 0}]})
        return len(meshes) - 1

    static = fuse(chain)
    if len(static):
        nodes.append({"name": "static scene", "mesh": mesh(static, "static scene")})
    for track in shown_tracks(chain):
        first = min(chain.path(track))
        cloud = movers(chain, first)
        cloud = cloud.kept(cloud.label == track)
        if len(cloud):
            nodes.append({"name": f"track {track}", "mesh": mesh(cloud, f"track {track}")})
            animate(len(nodes) - 1, _from_first(chain, track, first))
    K, size = chain.pairs[0].result.K[0], chain.pairs[0].result.images[0].shape
    view = 2 * float(np.arctan(size[0] / 2 / K[1, 1]))
    near = 1e-3 * float(np.nanmedian(chain.depth(0)))
    optics = {"yfov": view, "aspectRatio": size[1] / size[0], "znear": near}
    nodes.append({"name": "camera", "camera": 0})
    animate(len(nodes) - 1, list(chain.world_from_camera))
    tree = {
        "asset": {
            "version": "2.0",
            "generator": "soup_nlp",
            "extras": {"unit": str(contents["unit"])},
        },
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": meshes,
        "cameras": [{"type": "perspective", "perspective": optics}],
        "animations": [{"name": "sequence", "channels": channels, "samplers": samplers}],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }
    text = json.dumps({key: value for key, value in tree.items() if value != []}).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(buffer.data), b"BIN\0") + buffer.data
    write_bytes(path, struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def _from_first(chain: Chain, track: int, first: int) -> list[RigidMotion]:
    """Motion of a track from its first frame to every frame; it rests before and after."""
    now = RigidMotion(np.eye(3), np.zeros(3))
    poses = [now] * (first + 1)
    for k in range(first, len(chain.pairs)):
        label = chain.label(k, track)
        now = now if label is None else chain.motion(k, label) @ now
        poses.append(now)
    return poses


def _quaternions(poses: list[RigidMotion]) -> Float:
    """(M, 4) x, y, z, w in the axes of glTF, neighbours in one half of the sphere."""
    quaternions = np.array([RigidMotion(GLTF @ p.R @ GLTF, p.t).quaternion for p in poses])
    for k in range(1, len(quaternions)):
        if quaternions[k] @ quaternions[k - 1] < 0:
            quaternions[k] *= -1
    return quaternions
