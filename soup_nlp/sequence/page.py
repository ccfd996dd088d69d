"""A chain for viewers: its page, and an animated GLB.

The page has a 3D view, images and depths with a slider, tables of tracks and links. The GLB (glTF
2.0, binary) has the static scene, the moving components and the camera.
"""

import html
import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Image, Mask
from soup_nlp.geometry.motion import RigidMotion
from soup_nlp.report.colour import colourise_depth, depth_range
from soup_nlp.report.findings import guess_line
from soup_nlp.report.models import GLTF
from soup_nlp.report.page import colour_bar, encoded, filled, packed, table
from soup_nlp.report.pictures import depth_bar
from soup_nlp.sequence.chain import Chain
from soup_nlp.sequence.fused import Cloud, every_kth, fuse, movers, shown_tracks
from soup_nlp.sequence.score import certainty, link_table, score_text
from soup_nlp.storage.files import PathLike, write_bytes

WIDTH = 720
"""Larger side of an image in the page, pixels."""
MANY = 24
"""Frames above which the images have half the width."""
STILL, MOVING = 120_000, 60_000
"""Largest numbers of points of the static scene, and of moving components in all frames."""
QUALITY = 80
"""JPEG quality of the images."""
COLOURS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#17becf")


def depth_pictures(chain: Chain) -> tuple[list[Image], tuple[float, float]]:
    """Depth of every frame in colour, pale where it is a guess; the range of the colours (near,
    far), one for all."""
    depths = [chain.depth(k) for k in range(len(chain))]
    span = depth_range(np.concatenate([z.ravel()[::7] for z in depths]))
    return [colourise_depth(z, *span, guess_of(chain, k)) for k, z in enumerate(depths)], span


def guess_of(chain: Chain, frame: int) -> Mask:
    """(H, W) True where the depth of a frame is a guess; False where it is unknown."""
    pair, side = chain.seen(frame)
    return chain.pairs[pair].result.guesses[side]


def chain_page(chain: Chain, contents: Mapping[str, Any]) -> str:
    """The page as one HTML file, with the contents of chain.json."""
    pictures, (near, far) = depth_pictures(chain)
    # long sequences have smaller pictures
    width = WIDTH if len(chain) <= MANY else WIDTH // 2
    scene = _scene(chain)
    data = {
        "frames": [
            [encoded(one, "jpeg", width, quality=QUALITY) for one in (chain.image(k), picture)]
            for k, picture in enumerate(pictures)
        ],
        "guess": [float(guess_of(chain, k).mean()) for k in range(len(chain))],
        "names": [Path(x).name for x in contents["sources"]],
        "scene": scene,
    }
    heads, rows = link_table(contents)
    links = table(heads, rows) if rows else ""
    if contents["score"]:
        links += f"<p>{score_text(contents['score'])}.</p>"
    guess = html.escape(guess_line(certainty(chain), "all images"))
    parts = {
        "title": html.escape(str(contents["name"])),
        "certainty": f"<p><b>{guess}</b></p>" if guess else "",
        "last": len(chain) - 1,
        "bar": colour_bar(depth_bar(near, far)),
        "tracks": _tracks(chain, scene["tracks"]),
        "links": links,
        "unit": html.escape(str(contents["unit"])),
    }
    return filled("chain", data, parts)


def _scene(chain: Chain) -> dict[str, Any]:
    """The 3D view: clouds, paths and cameras as numbers and packed arrays."""
    still = fuse(chain, STILL)
    height, width = chain.image(0).shape[:2]

    def points(cloud: Cloud) -> dict[str, str]:
        numbers = packed(cloud["points"].astype(np.float32))
        return {"points": numbers, "colours": packed(cloud["colours"])}

    most = MOVING // len(chain)
    moving = [every_kth(movers(chain, k), most) for k in range(len(chain))]
    return {
        "still": points(still),
        "moving": [*map(points, moving)],
        "tracks": [
            {"track": t, "path": [*chain.path(t).values()], "colour": COLOURS[k % len(COLOURS)]}
            for k, t in enumerate(shown_tracks(chain))
        ],
        "cameras": [pose.matrix for pose in chain.world_from_camera],
        "K": chain.camera(0),
        "size": [width, height],
        "middle": float(np.median(still["points"][:, 2])) if len(still) else 1.0,
        "far": float(np.abs(still["points"]).max(initial=1.0)),
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
KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
NUMBERS = {np.dtype(np.float32): 5126, np.dtype(np.uint8): 5121}
"""glTF's names of the shapes and numbers of the types of an array."""


def write_animation(path: PathLike, chain: Chain, contents: Mapping[str, Any]) -> None:
    """Write the sequence; axes of glTF, world = the first frame's camera, five frames a second.

    Nodes are "static scene", "track N" for a moving component, and "camera". A track has the points
    of its first frame, which move rigidly from frame to frame as its component does.
    """
    arrays: list[NDArray[Any]] = []
    meshes, nodes, channels, samplers = [], [], [], []

    def add(array: NDArray[Any]) -> int:
        """The number of the accessor of an array; real numbers become float32."""
        arrays.append(array if array.dtype == np.uint8 else array.astype(np.float32))
        return len(arrays) - 1

    times = add(np.arange(len(chain)) / RATE)

    def animate(node: int, poses: Sequence[RigidMotion]) -> None:
        shifts = np.array([GLTF @ p.t for p in poses])
        turns = np.array([RigidMotion(GLTF @ p.R @ GLTF, p.t).quaternion for p in poses])
        # neighbours in one half of the sphere
        signs = np.where((turns[1:] * turns[:-1]).sum(axis=1) < 0, -1.0, 1.0)
        turns[1:] *= np.cumprod(signs)[:, None]
        for what, values in (("translation", shifts), ("rotation", turns)):
            samplers.append({"input": times, "output": add(values), "interpolation": "LINEAR"})
            target = {"node": node, "path": what}
            channels.append({"sampler": len(samplers) - 1, "target": target})

    def show(cloud: Cloud, name: str) -> None:
        colours = np.hstack([cloud["colours"], np.full((len(cloud), 1), 255, np.uint8)])
        attributes = {"POSITION": add(cloud["points"] @ GLTF), "COLOR_0": add(colours)}
        meshes.append({"name": name, "primitives": [{"attributes": attributes, "mode": 0}]})
        nodes.append({"name": name, "mesh": len(meshes) - 1})

    static = fuse(chain)
    if len(static):
        show(static, "static scene")
    for track in shown_tracks(chain):
        first = min(chain.path(track))
        cloud = movers(chain, first)
        cloud = cloud[cloud["label"] == track]
        if len(cloud):
            show(cloud, f"track {track}")
            members = chain.members(track)
            poses = [RigidMotion(np.eye(3), np.zeros(3))] * (first + 1)
            # the track rests before its first frame, and where a pair does not show it
            for k in range(first, len(chain.pairs)):
                now = poses[-1]
                poses.append(chain.motion(k, members[k].label) @ now if k in members else now)
            animate(len(nodes) - 1, poses)
    K, (height, width) = chain.camera(0), chain.image(0).shape[:2]
    optics = {
        "yfov": 2 * float(np.arctan(height / 2 / K[1, 1])),
        "aspectRatio": width / height,
        "znear": 1e-3 * float(np.nanmedian(chain.depth(0))),
    }
    nodes.append({"name": "camera", "camera": 0})
    animate(len(nodes) - 1, chain.world_from_camera)
    extras = {"unit": str(contents["unit"])}
    tree = {
        "asset": {"version": "2.0", "generator": "soup_nlp", "extras": extras},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": meshes,
        "cameras": [{"type": "perspective", "perspective": optics}],
        "animations": [{"name": "sequence", "channels": channels, "samplers": samplers}],
    }
    write_bytes(path, _glb({key: value for key, value in tree.items() if value != []}, arrays))


def _glb(tree: Mapping[str, Any], arrays: Sequence[NDArray[Any]]) -> bytes:
    """A GLB of a tree and its arrays (M,), (M, 3) or (M, 4), each of which has an accessor."""
    views, accessors, data = [], [], b""
    for k, array in enumerate(arrays):
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes})
        accessors.append(
            {
                "bufferView": k,
                "componentType": NUMBERS[array.dtype],
                "normalized": array.dtype == np.uint8,
                "count": len(array),
                "type": KINDS[array[0].size],
                "min": np.atleast_1d(array.min(axis=0)).tolist(),
                "max": np.atleast_1d(array.max(axis=0)).tolist(),
            }
        )
        data += array.tobytes() + b"\0" * (-array.nbytes % 4)
    buffers = [{"byteLength": len(data)}]
    tables = {"accessors": accessors, "bufferViews": views, "buffers": buffers}
    text = json.dumps({**tree, **tables}).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
