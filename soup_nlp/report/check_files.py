"""Claims about the files of a result folder: recomputed from the arrays, or compared by hash."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float
from soup_nlp.errors import DataError
from soup_nlp.evaluate import recompute, recompute_files
from soup_nlp.report.claim import HASHED, Claim, same
from soup_nlp.report.record import RECORD, recorded_files
from soup_nlp.storage.files import read_bytes
from soup_nlp.storage.mark import digest_of
from soup_nlp.storage.store import require

Entries: TypeAlias = Mapping[str, Any]

COLUMNS = ("x", "y", "z", "nx", "ny", "nz")
"""First properties of a point cloud."""
ULPS = 4 * 2.0**-24
"""Rounding error of a coordinate in float32, relative to its summands."""


def file_claims(folder: Path, claims: Entries, tree: Entries) -> Iterator[Claim]:
    """Claims about the files of a result."""
    yield from _counts(claims, tree)
    state = {
        k: np.asarray(require(tree, f"solution/{k}"), float) for k in ("lam", "n", "d", "R", "t")
    }
    for which in ("ref", "next"):
        yield from _depth_png(folder, claims, which, require(tree, f"depth/{which}"))
    yield from _clouds(folder, tree, state)
    yield _entries(claims, tree)
    yield from _hashes(folder, tree)


def _counts(claims: Entries, tree: Entries) -> Iterator[Claim]:
    """Claims about numbers that are counts of arrays."""
    height, width = require(tree, "segmentation/labels").shape
    found = {
        "superpixels": len(require(tree, "segmentation/anchors")),
        "knn_edges": len(require(tree, "energy/edges")),
        "neighbour_pairs": len(require(tree, "energy/pairs")),
        "width": width,
        "height": height,
    }
    multipliers = tree.get("multipliers", {})
    if "variables" in claims["sizes"]:
        rows = [len(v) for k, v in multipliers.items() if k != "lam_x"]
        found |= {"variables": len(multipliers["lam_x"]), "constraints": sum(rows)}
    for name, value in found.items():
        yield same(f"size {name}", claims["sizes"][name], value)
    for name, count in claims["iterations"].items():
        key = name.replace(" ", "_").replace("/", "_")
        own = [v for k, v in tree.get("iterations", {}).items() if k.partition("_")[2] == key]
        if own and own[0]:
            length = len(next(iter(own[0].values())))
            yield same(f"iterations {name}", count, max(0, length - 1))
    start = require(tree, "start/borrowed"), require(tree, "start/error")
    yield same("start borrowed", claims["start"]["borrowed"], int(start[0].sum()))
    yield same("start median_error_px", claims["start"]["median_error_px"], np.median(start[1]))


def _depth_png(folder: Path, claims: Entries, which: str, depth: Float) -> Iterator[Claim]:
    """Claims about scale and pixels of a 16-bit depth map."""
    scale = recompute_files.png_scale(depth)
    yield same(f"depth_png_scale {which}", claims["depth_png_scale"][which], scale)
    name = f"depth_{which}.png"
    expected = recompute_files.png_values(depth, scale)
    try:
        data = read_bytes(folder / name, name)
    except DataError as error:
        yield Claim(f"{name} pixels", 0, np.nan, 0, False, note=str(error.found or error.what))
        return
    # check the size in bytes 16 to 23 before decoding the image
    size = int.from_bytes(data[20:24], "big"), int.from_bytes(data[16:20], "big")
    value = None
    if size == depth.shape:
        value = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if value is None or value.shape != expected.shape:
        yield Claim(f"{name} pixels", 0, np.nan, 0, False, note="no image of the depth's size")
        return
    off = int((value != expected).sum())
    yield Claim(f"{name} pixels", 0, off, 0, not off, note=f"{off} pixels differ" if off else "")


def _clouds(folder: Path, tree: Entries, state: recompute.State) -> Iterator[Claim]:
    """Claims about points and normals of both clouds; their pixels and colours are hashed."""
    labels, K = require(tree, "segmentation/labels"), require(tree, "input/K_ref")
    depth = require(tree, "depth/ref").astype(float)
    ref, following, size = recompute_files.clouds(state, depth, labels, K)
    names = "points_ref.ply", "points_next.ply"
    tables = [_read_ply(folder / name) for name in names]
    index = np.zeros(0, int)
    if tables[0] is not None:
        image = tables[0][:, :3].astype(float) @ K.T
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = (np.rint(image[:, k] / image[:, 2]) for k in (0, 1))
        # a point outside the image matches no pixel
        inside = (u >= 0) & (v >= 0) & (u < labels.shape[1]) & (v < labels.shape[0])
        index = np.where(inside, v * labels.shape[1] + u, -1).astype(int)
    for name, table, rows in zip(names, tables, (ref, following)):
        if table is None or len(table) != len(index):
            note = "no cloud, or another number of points"
            yield Claim(f"{name} points", 0, np.nan, 0, False, note=note)
            continue
        gap = np.abs(table.astype(float) - rows[index])
        with np.errstate(divide="ignore", invalid="ignore"):
            off = np.maximum(gap[:, :3].max(1) / size[index], gap[:, 3:].max(1))
        worst = float(np.max(off, initial=0.0))
        twice = bool((np.diff(index) <= 0).any())
        ok = worst <= ULPS and not twice and bool((index >= 0).all())
        note = "pixels out of order" if twice else ""
        yield Claim(f"{name} points", 0, worst, ULPS, ok, note=note)


def _read_ply(path: Path) -> NDArray[np.float32] | None:
    """(M, 6) positions and normals of a cloud written by `write_ply`; None if it is malformed."""
    try:
        data = read_bytes(path, path.name)
    except DataError:
        return None
    head, end, _ = data[:4096].partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    count = [line[2] for line in lines if line[:2] == ["element", "vertex"]]
    floats = [line[2] for line in lines if line[:2] == ["property", "float"] and len(line) == 3]
    if not end or len(count) != 1 or not count[0].isdecimal() or floats[:6] != list(COLUMNS):
        return None
    kind = np.dtype([("floats", "<f4", (len(floats),)), ("colour", "u1", (3,))])
    size = len(head) + len(end)
    if len(data) != size + int(count[0]) * kind.itemsize:
        return None
    return np.asarray(np.frombuffer(data, kind, offset=size)["floats"][:, :6])


def _entries(claims: Entries, tree: Entries) -> Claim:
    """Claim that no entry of summary.json was changed after it was written."""
    name = "entries of summary.json"
    if "summary" not in tree.get(RECORD, {}):
        return Claim(name, 0, np.nan, 0, False, how=HASHED, note="result.h5 has no record of them")
    written, now = (_leaves(x) for x in (json.loads(str(tree[RECORD]["summary"])), claims))
    every = sorted(written.keys() | now.keys())
    changed = [k for k in every if k not in written or k not in now or written[k] != now[k]]
    names = ", ".join(".".join(key) for key in changed[:3]) + (", ..." if len(changed) > 3 else "")
    note = f"{names}: not as written" if changed else ""
    return Claim(name, 0, len(changed), 0, not changed, how=HASHED, note=note)


def _leaves(tree: Any, place: tuple[str, ...] = ()) -> dict[tuple[str, ...], Any]:
    """Leaves of nested mappings and lists by their path."""
    if isinstance(tree, Mapping | list) and tree:
        items = tree.items() if isinstance(tree, Mapping) else enumerate(tree)
        return {k: v for name, x in items for k, v in _leaves(x, (*place, str(name))).items()}
    return {place: tree}


def _hashes(folder: Path, tree: Entries) -> Iterator[Claim]:
    """Claims that the files were not changed after they were written."""
    files = recorded_files(tree)
    if not files:
        note = "result.h5 has no record of the files"
        yield Claim("files as written", 1, 0, 0, False, how=HASHED, note=note)
    for name, digest in files.items():
        # other claims compare the entries of these two
        if name in ("summary.json", "config.yaml"):
            continue
        path = folder / name
        ok = ".." not in name and path.is_file() and digest_of(path) == digest
        note = "" if ok else "changed" if path.is_file() else "missing"
        yield Claim(f"{name} as written", 1, float(ok), 0, ok, how=HASHED, note=note)
