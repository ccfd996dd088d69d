"""Optical-flow files: Middlebury .flo, KITTI and Virtual KITTI PNG, NumPy arrays.

In memory a flow is (H, W, 2) float32, displacement (u right, v down) in pixels, NaN where unknown
(both components).
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from soup_nlp.data.formats.images import (
    PathLike,
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

FloatFlow = NDArray[np.float32]

FLO_MAGIC = b"PIEH"
"""First four bytes of a .flo file; as a little-endian float32 they read 202021.25."""

FLO_UNKNOWN = 1e9
"""A component larger than this marks an unknown flow in a .flo file."""

FLO_FILL = 1e10
"""Value that `write_flo` stores for an unknown flow."""


def _checked(flow: NDArray[np.floating], path: PathLike) -> FloatFlow:
    """The flow as float32 with NaN in both components where either is not finite."""
    if flow.ndim != 3 or flow.shape[2] != 2:
        raise DataError(
            "flow has the wrong shape", where=path, found=flow.shape, expected="(H, W, 2)"
        )
    with np.errstate(over="ignore"):
        out = np.array(flow, dtype=np.float32)
    out[~np.isfinite(out).all(axis=2)] = np.nan
    return out


def read_flo(path: PathLike) -> FloatFlow:
    """Read a Middlebury .flo file (little endian; also used by Sintel).

    Returns:
        (H, W, 2) float32, pixels; NaN where a component is NaN or larger than 1e9 in magnitude,
        the format's mark for unknown.

    Raises:
        DataError: the file is missing, has another magic number or an impossible size, or its
            length does not fit its header.
    """
    content = read_bytes(path, "flow file")
    if content[:4] != FLO_MAGIC:
        raise DataError(
            "flow file has the wrong magic number",
            where=path,
            found=repr(content[:4]),
            expected=f"{FLO_MAGIC!r} (float 202021.25)",
            hint="is it really a .flo file?",
        )
    check_body(min(len(content) - 4, 8), 8, path, "flow file header")
    width, height = struct.unpack("<ii", content[4:12])
    check_size(width, height, path)
    check_body(len(content) - 12, 8 * width * height, path, "flow file")
    flow = np.frombuffer(content, "<f4", offset=12).reshape(height, width, 2).astype(np.float32)
    flow[~(np.abs(flow) <= FLO_UNKNOWN).all(axis=2)] = np.nan
    return flow


def write_flo(path: PathLike, flow: NDArray[np.floating]) -> None:
    """Write a Middlebury .flo file.

    Args:
        path: Target; written whole or not at all.
        flow: (H, W, 2), pixels; not finite where unknown (stored as 1e10).

    Raises:
        DataError: the flow has another shape, or the file cannot be written.
    """
    out = _checked(flow, path)
    out[np.isnan(out)] = FLO_FILL
    header = FLO_MAGIC + struct.pack("<ii", out.shape[1], out.shape[0])
    write_bytes(path, header + out.astype("<f4").tobytes())


def read_kitti_flow(path: PathLike) -> FloatFlow:
    """Read a KITTI flow PNG: 16-bit RGB, u = (R - 2^15) / 64, v = (G - 2^15) / 64, B > 0 valid.

    Returns:
        (H, W, 2) float32, pixels; NaN where not valid.

    Raises:
        DataError: the file is missing, damaged, or no 16-bit PNG with three channels.
    """
    bgr = decode_png16(path, 3, "KITTI flow")
    flow = (bgr[:, :, :0:-1].astype(np.float32) - 2.0**15) / 64.0
    flow[bgr[:, :, 0] == 0] = np.nan
    return flow


def write_kitti_flow(path: PathLike, flow: NDArray[np.floating]) -> None:
    """Write a KITTI flow PNG; values are rounded to 1/64 pixel.

    Args:
        path: Target; written whole or not at all.
        flow: (H, W, 2), pixels, within -512 to 511.984; not finite where unknown.

    Raises:
        DataError: the flow has another shape or does not fit the range of the format.
    """
    checked = _checked(flow, path)
    valid = ~np.isnan(checked[:, :, 0])
    code = np.rint(np.where(valid[:, :, None], checked, 0.0).astype(np.float64) * 64.0) + 2.0**15
    if code.size and (code.min() < 0 or code.max() > 65535):
        raise DataError(
            "flow does not fit the KITTI format",
            where=path,
            found=f"displacements up to {np.nanmax(np.abs(checked)):g} pixels",
            expected="-512 to 511.98 pixels",
            hint="write a .flo file instead",
        )
    code[~valid] = 0
    bgr = np.dstack([valid, code[:, :, 1], code[:, :, 0]]).astype(np.uint16)
    encode_png(path, bgr)


def read_vkitti_flow(path: PathLike) -> FloatFlow:
    """Read a Virtual KITTI 1 or 2 flow PNG.

    16-bit RGB: u = (2 R / 65535 - 1) (W - 1), v = (2 G / 65535 - 1) (H - 1), B = 0 invalid
    (sky and the like).

    Returns:
        (H, W, 2) float32, pixels; NaN where invalid.

    Raises:
        DataError: the file is missing, damaged, or no 16-bit PNG with three channels.
    """
    bgr = decode_png16(path, 3, "Virtual KITTI flow")
    height, width = bgr.shape[:2]
    unit = 2.0 / 65535.0 * bgr[:, :, :0:-1].astype(np.float64) - 1.0
    flow: FloatFlow = (unit * [width - 1, height - 1]).astype(np.float32)
    flow[bgr[:, :, 0] == 0] = np.nan
    return flow


def _read_npy(path: PathLike) -> FloatFlow:
    flow = _checked(load_npy(path, "flow file"), path)
    flow[~(np.abs(flow) <= FLO_UNKNOWN).all(axis=2)] = np.nan
    return flow


def read_flow(path: PathLike) -> FloatFlow:
    """Read a flow by the suffix of its file.

    `.flo` is Middlebury, `.png` is KITTI (for Virtual KITTI call `read_vkitti_flow`, the two look
    alike), `.npy` is a plain (H, W, 2) array in pixels with NaN or values over 1e9 where unknown.

    Returns:
        (H, W, 2) float32, pixels; NaN where unknown.

    Raises:
        DataError: the suffix is unknown or the file is wrong for its format.
    """
    readers = {".flo": read_flo, ".png": read_kitti_flow, ".npy": _read_npy}
    return dispatch(path, readers, "flow")
