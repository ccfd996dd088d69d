"""Chains as results: read from their folder, checked, scored, and written for other programs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.errors import ConfigError, DataError
from soup_nlp.report.check import check_folder
from soup_nlp.report.colmap import write_model
from soup_nlp.report.ply_glb import AXES, write_ply
from soup_nlp.sequence.animation import write_animation
from soup_nlp.sequence.chain import Chain, make_chain
from soup_nlp.sequence.fused import fuse, projected
from soup_nlp.sequence.pairs import read_pair
from soup_nlp.storage.files import as_path, is_file, read_json
from soup_nlp.storage.folders import staged

CHAIN = "chain.json"
"""File that makes a folder that of a chain."""
SAME = 1e-6
"""Largest relative difference of stored scales and poses from recomputed ones."""
COLMAP_POINTS = 60_000
"""Largest number of points of a COLMAP model."""
VISIBLE = 0.03
"""A point is seen in a frame whose depth there is its own to this ratio."""


def is_chain(folder: Path) -> bool:
    """Whether a folder is that of a chain."""
    return is_file(folder / CHAIN)


def read_chain(folder: Path) -> tuple[Chain, dict[str, Any]]:
    """The chain of a folder, made again from its pairs, and the contents of chain.json.

    Raises:
        DataError: a pair is missing or damaged.
    """
    folder = as_path(folder, "folder of a chain")
    contents = read_json(folder / CHAIN, CHAIN)
    try:
        count = int(contents["frames"])
        over = [(int(a), int(b)) for a, b in contents.get("over", ())]
    except (KeyError, TypeError, ValueError) as error:
        raise DataError("chain.json cannot be read", where=folder, found=error) from error
    found = [
        read_pair(a, b, folder / "pairs" / f"{a:03d}_{b:03d}")
        for a, b in [*((k, k + 1) for k in range(count - 1)), *over]
    ]
    return make_chain(found[: count - 1], found[count - 1 :]), contents


def check_chain(folder: Path) -> Iterator[tuple[str, bool]]:
    """Claims of a chain with their results: every pair's, then scales and poses of the chain."""
    chain, contents = read_chain(folder)
    for pair in (folder / "pairs" / f"{p.first:03d}_{p.second:03d}" for p in chain.pairs):
        report = check_folder(pair)
        yield f"pair {pair.name}: every claim", report.ok
    stored = np.array([row["scale"] for row in contents["scales"]], float)
    yield "scales follow from the pairs", _same(stored, chain.scales)
    poses = np.array(contents["world_from_camera"], float)
    recomputed = np.array([m.matrix for m in chain.world_from_camera])
    yield "camera poses follow from pairs and scales", _same(poses, recomputed)


def _same(stored: Float, found: Float) -> bool:
    """Whether two arrays are equal up to rounding."""
    size = float(np.abs(found).max(initial=1.0))
    return stored.shape == found.shape and bool(np.abs(stored - found).max() <= SAME * size)


def write_fused(folder: Path, chain: Chain, contents: Mapping[str, Any]) -> str:
    """The static scene of all frames as one cloud."""
    cloud = fuse(chain)
    comments = [
        f"{contents['name']}: static scene of {len(chain)} frames, one point per voxel",
        f"frame: the first frame's camera, {AXES}",
        f"unit: {contents['unit']}",
        "sigma_log_depth: of the frame that the point is from; guesses are left out",
    ]
    scalars = {"sigma_log_depth": cloud.sigma, "frame": cloud.label}
    write_ply(folder / "scene.ply", cloud.points, cloud.colours, None, scalars, comments)
    return "scene.ply"


def _write_glb(folder: Path, chain: Chain, contents: Mapping[str, Any]) -> str:
    """The static scene, with what moves and the camera as an animation."""
    write_animation(folder / "scene.glb", chain, str(contents["unit"]))
    return "scene.glb"


def _write_colmap(folder: Path, chain: Chain, contents: Mapping[str, Any]) -> str:
    """COLMAP's model of the sequence: all frames and the fused cloud."""
    cloud = fuse(chain).thinned(COLMAP_POINTS)
    frames, seen = range(len(chain)), []
    for k in frames:
        inside, v, u, z = projected(chain, cloud.points, k)
        with np.errstate(invalid="ignore", divide="ignore"):
            near = np.abs(np.log(z / chain.depth(k)[v, u])) < VISIBLE
        at = np.flatnonzero(inside & near)
        seen.append((at, np.stack([u[at], v[at]], 1).astype(float)))
    write_model(
        folder / "colmap",
        [f"{k:04d}.png" for k in frames],
        [chain.image(k) for k in frames],
        [chain.camera(k) for k in frames],
        [pose.inverse for pose in chain.world_from_camera],
        [chain.labels(k) > 0 for k in frames],
        (cloud.points, cloud.colours),
        seen,
        f"{contents['name']}; unit: {contents['unit']}",
    )
    return "colmap"


Writer = Callable[[Path, Chain, Mapping[str, Any]], str]
FORMATS: Mapping[str, Writer] = {"ply": write_fused, "glb": _write_glb, "colmap": _write_colmap}
"""Writers of the formats that a chain has beside trajectory.tum and its clouds by frame."""


def convert_chain(
    folder: Path, names: Sequence[str], out: Path | None = None, overwrite: bool = False
) -> list[str]:
    """Write a chain for other programs; returns the names of the files.

    Raises:
        ConfigError: a format is not one of a chain.
    """
    wrong = [name for name in names if name not in FORMATS]
    if wrong or not names:
        raise ConfigError(
            "a chain has no such format",
            found=", ".join(wrong) or "no format",
            expected=", ".join(FORMATS),
            hint="formats of single pairs: soup-nlp convert DIR/pairs/000_001 --to ...",
        )
    chain, contents = read_chain(folder)
    with staged(folder if out is None else out, overwrite=overwrite) as new:
        return [FORMATS[name](new, chain, contents) for name in dict.fromkeys(names)]
