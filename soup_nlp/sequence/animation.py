"""A sequence as an animated GLB: static scene, what moves, and the camera (glTF 2.0, binary)."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float
from soup_nlp.geometry.motion import RigidMotion
from soup_nlp.report.ply_glb import GLTF
from soup_nlp.sequence.chain import Chain
from soup_nlp.sequence.fused import Cloud, fuse, movers, shown_tracks
from soup_nlp.storage.files import PathLike, write_bytes

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

    def add(self, array: NDArray[Any], limits: bool = False) -> int:
        """Number of the accessor of an array (M, ...) of float32 or uint8."""
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
        if limits:
            low, high = np.atleast_1d(array.min(axis=0)), np.atleast_1d(array.max(axis=0))
            accessor |= {"min": low.tolist(), "max": high.tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def write_animation(path: PathLike, chain: Chain, unit: str) -> None:
    """Write the sequence; axes of glTF, world = the first frame's camera, five frames a second.

    Nodes are "static scene", "track N" for what moves, and "camera". A track has the points of its
    first frame, which move rigidly from frame to frame as its component does.
    """
    buffer, meshes, nodes, channels, samplers = _Buffer(), [], [], [], []
    times = buffer.add(np.arange(len(chain), dtype=np.float32) / np.float32(RATE), limits=True)

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
            "POSITION": buffer.add((cloud.points @ GLTF).astype(np.float32), limits=True),
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
        "asset": {"version": "2.0", "generator": "soup_nlp", "extras": {"unit": unit}},
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
    if not meshes:
        del tree["meshes"]
    text = json.dumps(tree).encode()
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
    found = np.array([RigidMotion(GLTF @ p.R @ GLTF, p.t).quaternion for p in poses])
    for k in range(1, len(found)):
        if found[k] @ found[k - 1] < 0:
            found[k] *= -1
    return found
