"""Depth and disparity files: Sintel .dpt, .pfm, 16-bit PNG of several scales, NumPy arrays.

In memory a depth is (H, W) float64, z along the optical axis, NaN where unknown. Zero, negative and
infinite depths count as unknown.
"""

from __future__ import annotations

import re
import struct
from functools import partial

import numpy as np
from numpy.typing import NDArray

from soup_nlp.data.formats.flow_files import FLO_MAGIC
from soup_nlp.data.formats.images import (
    PathLike,
    Reader,
    check_body,
    check_size,
    decode_png16,
    dispatch,
    encode_png,
    load_npy,
    read_bytes,
    write_bytes,
)
from soup_nlp.errors import DataError

Float = NDArray[np.float64]

VKITTI_SKY = 65535
"""Virtual KITTI stores depths of 655.35 m and more, the sky, as this value."""


def _known(depth: NDArray[np.floating]) -> Float:
    """The depth as float64 with NaN where it is not positive and finite."""
    out = np.array(depth, dtype=np.float64)
    out[~(np.isfinite(out) & (out > 0))] = np.nan
    return out


def _map(values: NDArray[np.floating], path: PathLike) -> NDArray[np.floating]:
    """Raise DataError unless values form a map (H, W)."""
    if values.ndim != 2 or values.size == 0:
        raise DataError(
            "depth has the wrong shape", where=path, found=values.shape, expected="(H, W)"
        )
    return values


def read_dpt(path: PathLike) -> Float:
    """Read a Sintel .dpt depth file.

    Returns:
        (H, W) float64 depth in scene units (metres in Sintel); NaN where unknown.

    Raises:
        DataError: the file is missing, has another magic number or an impossible size, or its
            length does not fit its header.
    """
    content = read_bytes(path, "depth file")
    if content[:4] != FLO_MAGIC:
        raise DataError(
            "depth file has the wrong magic number",
            where=path,
            found=repr(content[:4]),
            expected=f"{FLO_MAGIC!r} (float 202021.25)",
            hint="is it really a .dpt file?",
        )
    check_body(min(len(content) - 4, 8), 8, path, "depth file header")
    width, height = struct.unpack("<ii", content[4:12])
    check_size(width, height, path)
    check_body(len(content) - 12, 4 * width * height, path, "depth file")
    return _known(np.frombuffer(content, "<f4", offset=12).reshape(height, width))


def write_dpt(path: PathLike, depth: NDArray[np.floating]) -> None:
    """Write a Sintel .dpt depth file (float32; NaN is kept).

    Args:
        path: Target; written whole or not at all.
        depth: (H, W) depth; NaN where unknown.

    Raises:
        DataError: the depth is no map, or the file cannot be written.
    """
    _map(depth, path)
    header = FLO_MAGIC + struct.pack("<ii", depth.shape[1], depth.shape[0])
    write_bytes(path, header + depth.astype("<f4").tobytes())


def read_pfm(path: PathLike) -> NDArray[np.float32]:
    """Read a grey .pfm map of either byte order, flipped so that row 0 is the top.

    The values are returned as stored (a .pfm may hold disparities, where 0 and infinity have a
    meaning of their own); the size of the scale in the header is ignored, its sign is the byte
    order.

    Returns:
        (H, W) float32.

    Raises:
        DataError: the file is missing, in colour, has a damaged header, or its length is wrong.
    """
    content = read_bytes(path, "PFM file")
    if content[:2] == b"PF":
        raise DataError(
            "PFM file is in colour", where=path, found="'PF'", expected="'Pf' (grey, one channel)"
        )
    header = re.match(rb"Pf\s+(-?\d+)\s+(-?\d+)\s+([-+.\deE]+)[ \t]*\r?\n", content[:256])
    try:
        scale = float(header.group(3)) if header else 0.0
    except ValueError:
        scale = 0.0
    if header is None or scale == 0.0:
        raise DataError(
            "PFM file has a damaged header",
            where=path,
            found=repr(content[:24]),
            expected="'Pf', width height, scale (negative: little endian)",
        )
    width, height = int(header.group(1)), int(header.group(2))
    check_size(width, height, path)
    check_body(len(content) - header.end(), 4 * width * height, path, "PFM file")
    order = "<f4" if scale < 0 else ">f4"
    values = np.frombuffer(content, order, offset=header.end()).reshape(height, width)
    return np.ascontiguousarray(values[::-1], dtype=np.float32)


def write_pfm(path: PathLike, values: NDArray[np.floating], big_endian: bool = False) -> None:
    """Write a grey .pfm map (float32, bottom row first, as the format asks).

    Args:
        path: Target; written whole or not at all.
        values: (H, W), row 0 at the top.
        big_endian: Byte order of the file.

    Raises:
        DataError: the values are no map, or the file cannot be written.
    """
    _map(values, path)
    scale, order = ("1.0", ">f4") if big_endian else ("-1.0", "<f4")
    header = f"Pf\n{values.shape[1]} {values.shape[0]}\n{scale}\n".encode("ascii")
    write_bytes(path, header + values[::-1].astype(order).tobytes())


def read_depth_png16(path: PathLike, scale: float = 1000.0) -> Float:
    """Read a 16-bit grey PNG of depth = value / scale, 0 where unknown.

    Args:
        path: The file.
        scale: Values per unit of length: 1000 for millimetres, 5000 for TUM RGB-D, 256 for KITTI
            depth, 100 for Virtual KITTI.

    Returns:
        (H, W) float64 depth; NaN where unknown.

    Raises:
        DataError: the scale is not positive, or the file is missing, damaged or not 16-bit grey.
    """
    _check_scale(scale, path)
    return _known(decode_png16(path, 1, "depth image") / float(scale))


def write_depth_png16(path: PathLike, depth: NDArray[np.floating], scale: float = 1000.0) -> None:
    """Write a 16-bit grey PNG of round(depth * scale), 0 where unknown.

    Raises:
        DataError: the depth is no map, or a known depth does not fit 1 to 65535.
    """
    _check_scale(scale, path)
    _map(depth, path)
    known = np.isfinite(depth) & (depth > 0)
    code = np.rint(np.where(known, depth, 0.0).astype(np.float64) * scale)
    if code[known].size and not (code[known].min() >= 1 and code.max() <= 65535):
        raise DataError(
            "depth does not fit a 16-bit image of this scale",
            where=path,
            found=f"{depth[known].min():g} to {depth[known].max():g}",
            expected=f"{1 / scale:g} to {65535 / scale:g}",
            hint="choose another scale or write a .dpt or .npy file",
        )
    encode_png(path, code.astype(np.uint16))


def _check_scale(scale: float, path: PathLike) -> None:
    if not (np.isfinite(scale) and scale > 0):
        raise DataError(
            "depth scale must be positive",
            where=path,
            found=scale,
            expected="values per unit of length, e.g. 1000 for millimetres",
        )


def read_kitti_disparity(path: PathLike) -> Float:
    """Read a KITTI disparity PNG: 16-bit grey, disparity = value / 256 pixels, 0 unknown.

    Returns:
        (H, W) float64 disparity, pixels; NaN where unknown.

    Raises:
        DataError: the file is missing, damaged or not 16-bit grey.
    """
    return read_depth_png16(path, 256.0)


def write_kitti_disparity(path: PathLike, disparity: NDArray[np.floating]) -> None:
    """Write a KITTI disparity PNG (values rounded to 1/256 pixel, unknown as 0).

    Raises:
        DataError: the disparity is no map, or a known value is outside 1/256 to 255.99 pixels.
    """
    write_depth_png16(path, disparity, 256.0)


def read_vkitti_depth(path: PathLike) -> Float:
    """Read a Virtual KITTI 1 or 2 depth PNG: 16-bit grey, centimetres, 65535 for the sky.

    Returns:
        (H, W) float64 depth, metres; NaN for the sky and unknown pixels.

    Raises:
        DataError: the file is missing, damaged or not 16-bit grey.
    """
    code = decode_png16(path, 1, "Virtual KITTI depth")
    depth = _known(code / 100.0)
    depth[code == VKITTI_SKY] = np.nan
    return depth


def _read_npy(path: PathLike) -> Float:
    return _known(_map(load_npy(path, "depth file"), path))


def _read_pfm_depth(path: PathLike) -> Float:
    return _known(read_pfm(path))


def read_depth(path: PathLike, png_scale: float = 1000.0) -> Float:
    """Read a depth by the suffix of its file: .dpt, .npy, .pfm or 16-bit .png.

    Args:
        path: The file.
        png_scale: Values per unit of length of a .png, see `read_depth_png16`.

    Returns:
        (H, W) float64 depth in the unit of the file; NaN where unknown, not positive or infinite.

    Raises:
        DataError: the suffix is unknown or the file is wrong for its format.
    """
    readers: dict[str, Reader] = {
        ".dpt": read_dpt,
        ".npy": _read_npy,
        ".pfm": _read_pfm_depth,
        ".png": partial(read_depth_png16, scale=png_scale),
    }
    return dispatch(path, readers, "depth")
