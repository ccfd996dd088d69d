"""Coloured point clouds as binary PLY files (Stanford polygon format 1.0)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from soup_nlp.data.pair import check_intrinsics
from soup_nlp.errors import DataError
from soup_nlp.geometry.camera import rays
from soup_nlp.storage.atomic import PathLike, atomic_path

Float32 = NDArray[np.float32]
Bytes = NDArray[np.uint8]

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "<i2",
    "int16": "<i2",
    "ushort": "<u2",
    "uint16": "<u2",
    "int": "<i4",
    "int32": "<i4",
    "uint": "<u4",
    "uint32": "<u4",
    "float": "<f4",
    "float32": "<f4",
    "double": "<f8",
    "float64": "<f8",
}
_NAMES = {"f4": "float", "u1": "uchar"}
_POSITION = ("x", "y", "z")
_NORMAL = ("nx", "ny", "nz")
_COLOUR = ("red", "green", "blue")


def write_ply(
    path: PathLike, xyz: ArrayLike, rgb: ArrayLike, normals: ArrayLike | None = None
) -> int:
    """Write a coloured point cloud: binary little endian, float32 and uchar, whole or not at all.

    Points with a coordinate (or normal) that is not finite are left out, so a depth map with
    unknown pixels can be given as it is.

    Args:
        path: File to write; its folder must exist.
        xyz: (..., 3) positions, camera frame (x right, y down, z forward), any length unit.
        rgb: (..., 3) uint8 colours, same leading shape.
        normals: (..., 3) unit normals, same leading shape, or None.

    Returns:
        The number of points written.

    Raises:
        DataError: shapes or types do not fit, or the folder cannot be written.
    """
    points = _triples(xyz, "xyz")
    colours = _triples(rgb, "rgb")
    if colours.dtype != np.uint8:
        raise DataError("colours must be 8-bit", where="rgb", found=colours.dtype, expected="uint8")
    fields = [(name, "<f4") for name in _POSITION]
    columns = [points]
    if normals is not None:
        fields += [(name, "<f4") for name in _NORMAL]
        columns.append(_triples(normals, "normals"))
    for what, column in (("rgb", colours), ("normals", columns[-1])):
        if len(column) != len(points):
            raise DataError(
                "point cloud arrays differ in length",
                where=what,
                found=len(column),
                expected=f"{len(points)}, as many as positions",
            )
    numbers = np.concatenate(columns, axis=1).astype(np.float64)
    # what overflows float32 is as little use as what is not finite
    good = (np.abs(numbers) <= np.finfo(np.float32).max).all(axis=1)
    table = np.empty(
        int(good.sum()), dtype=np.dtype([*fields, *((name, "u1") for name in _COLOUR)])
    )
    for k, (name, _) in enumerate(fields):
        table[name] = numbers[good, k]
    for k, name in enumerate(_COLOUR):
        table[name] = colours[good, k]
    properties = [
        f"property {_NAMES[table.dtype[name].str[1:]]} {name}" for name in table.dtype.names or ()
    ]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(table)}",
        *properties,
        "end_header",
    ]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        file.write(table.tobytes())
    return len(table)


def _triples(value: ArrayLike, where: str) -> NDArray[np.generic]:
    """(M, 3) view of an array (..., 3)."""
    array = np.asarray(value)
    if array.ndim < 2 or array.shape[-1] != 3 or array.dtype.kind not in "iuf":
        raise DataError(
            "point cloud array has the wrong shape or type",
            where=where,
            found=f"{array.dtype} {array.shape}",
            expected="numbers (..., 3)",
        )
    return array.reshape(-1, 3)


def points_from_depth(
    depth: ArrayLike, K: ArrayLike, image: ArrayLike, max_edge: float | None = None
) -> tuple[NDArray[np.float64], Bytes]:
    """The coloured points `z K^-1 (u, v, 1)` of a depth map, ready for `write_ply`.

    A depth map interpolated across an occlusion edge leaves points that fly between two surfaces.
    With `max_edge` both sides of such an edge are left out: a pixel goes where its depth and that
    of one of its four neighbours differ by more than this share of the nearer of the two.

    Args:
        depth: (H, W) z; unknown where not finite or not positive.
        K: (3, 3) intrinsics, pixels; (0, 0) is the centre of the top-left pixel.
        image: (H, W, 3) uint8 RGB.
        max_edge: Largest relative jump of depth between neighbours; None keeps every pixel.

    Returns:
        (M, 3) points in the camera frame, in the unit of the depth, and (M, 3) colours, in row
        order of the pixels that are left.

    Raises:
        DataError: shapes or types do not fit, the camera is wrong, or `max_edge` is not positive.
    """
    z, rgb, camera = np.asarray(depth, np.float64), np.asarray(image), np.asarray(K, np.float64)
    check_intrinsics(camera, "K")
    if z.ndim != 2 or rgb.shape != (*z.shape, 3) or rgb.dtype != np.uint8:
        raise DataError(
            "depth and image do not fit",
            where="points_from_depth",
            found=f"depth {z.shape}, image {rgb.dtype} {rgb.shape}",
            expected="depth (H, W), image uint8 (H, W, 3)",
        )
    if max_edge is not None and not max_edge > 0:
        raise DataError(
            "largest jump of depth must be positive",
            where="max_edge",
            found=max_edge,
            expected="> 0, as a share of the depth, or None",
        )
    keep = np.isfinite(z) & (z > 0)
    if max_edge is not None:
        safe = np.where(keep, z, np.nan)  # a comparison with NaN is no jump
        for here, there in (
            ((slice(None), slice(1, None)), (slice(None), slice(None, -1))),
            ((slice(1, None), slice(None)), (slice(None, -1), slice(None))),
        ):
            a, b = safe[here], safe[there]
            jump = np.abs(a - b) > max_edge * np.fmin(a, b)
            keep[here] &= ~jump
            keep[there] &= ~jump
    v, u = np.nonzero(keep)
    ray = rays(camera, np.stack([u, v], axis=-1))
    return ray * z[keep][:, None], np.asarray(rgb[keep], np.uint8)


def read_ply(path: PathLike) -> tuple[Float32, Bytes, Float32 | None]:
    """Read the vertices of a binary little-endian PLY file without list properties on them.

    Returns:
        (M, 3) positions, (M, 3) uint8 colours (white where the file has none), and (M, 3) normals
        or None.

    Raises:
        DataError: the file is missing, of another kind, or shorter than its header says.
    """
    try:
        raw = Path(path).read_bytes()
    except OSError as error:
        raise DataError("cannot read the PLY file", where=path, found=error) from error
    end = raw.find(b"end_header")
    stop = raw.find(b"\n", end)
    if not raw.startswith(b"ply") or end < 0 or stop < 0:
        raise DataError("file is not PLY", where=path, expected="'ply' ... 'end_header'")
    count, dtype = _parse_header(raw[:end].decode("ascii", "replace").splitlines(), path)
    body = raw[stop + 1 :]
    if len(body) < count * dtype.itemsize:
        raise DataError(
            "PLY file is shorter than its header says",
            where=path,
            found=f"{len(body)} bytes of data",
            expected=f"{count} vertices of {dtype.itemsize} bytes",
        )
    table = np.frombuffer(body, dtype, count)

    def take(names: tuple[str, ...], kind: type) -> NDArray[np.generic]:
        return np.stack([table[name].astype(kind) for name in names], axis=1)

    have = set(dtype.names or ())
    missing = [name for name in _POSITION if name not in have]
    if missing:
        raise DataError("PLY vertices have no position", where=path, found=sorted(have))
    xyz = np.asarray(take(_POSITION, np.float32), np.float32)
    rgb = np.full((count, 3), 255, np.uint8)
    if have.issuperset(_COLOUR):
        rgb = np.asarray(take(_COLOUR, np.uint8), np.uint8)
    normals = None
    if have.issuperset(_NORMAL):
        normals = np.asarray(take(_NORMAL, np.float32), np.float32)
    return xyz, rgb, normals


def _parse_header(lines: list[str], path: PathLike) -> tuple[int, np.dtype[np.void]]:
    """(number of vertices, type of one) of the lines of a header."""
    words = [line.split() for line in lines]
    if ["format", "binary_little_endian", "1.0"] not in words:
        found = [" ".join(w) for w in words if w[:1] == ["format"]]
        raise DataError(
            "PLY file is of another format",
            where=path,
            found=found or "no format line",
            expected="format binary_little_endian 1.0",
        )
    elements = [k for k, w in enumerate(words) if w[:1] == ["element"]]
    first = words[elements[0]] if elements else []
    if len(first) != 3 or first[1] != "vertex" or not first[2].isdigit():
        raise DataError(
            "PLY file does not start with vertices",
            where=path,
            found=" ".join(first) or "no element",
            expected="element vertex <count> first",
        )
    stop = elements[1] if len(elements) > 1 else len(words)
    fields = []
    for w in words[elements[0] : stop]:
        if w[:1] == ["property"]:
            if len(w) != 3 or w[1] not in _TYPES:
                raise DataError(
                    "PLY property is not supported",
                    where=path,
                    found=" ".join(w),
                    expected="property <number type> <name>",
                )
            fields.append((w[2], _TYPES[w[1]]))
    return int(first[2]), np.dtype(fields)
