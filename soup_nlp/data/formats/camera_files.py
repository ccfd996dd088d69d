"""Camera files: Sintel .cam, KITTI calibration, Virtual KITTI intrinsics, plain text."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from soup_nlp.data.formats.flow_files import FLO_MAGIC
from soup_nlp.data.formats.images import (
    PathLike,
    check_body,
    parse_numbers,
    read_bytes,
    read_text,
    write_bytes,
)
from soup_nlp.data.pair import check_intrinsics
from soup_nlp.errors import DataError

Float = NDArray[np.float64]

_CAM_BYTES = 8 * (9 + 12)


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> Float:
    """(3, 3) intrinsics of a camera without skew; all arguments in pixels."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def read_intrinsics(path: PathLike) -> Float:
    """Read intrinsics from a text file.

    The file holds nine numbers (the 3x3 matrix, row by row) or four (fx fy cx cy), separated by
    blanks or commas; lines that start with # are comments.

    Returns:
        (3, 3) intrinsics, pixels.

    Raises:
        DataError: the file is missing, holds other than 9 or 4 numbers, or no valid camera.
    """
    lines = [x for x in read_text(path, "intrinsics").splitlines() if not x.strip().startswith("#")]
    values = parse_numbers("\n".join(lines), path, "intrinsics file")
    if len(values) == 9:
        K = np.array(values).reshape(3, 3)
    elif len(values) == 4:
        K = intrinsics(*values)
    else:
        raise DataError(
            "intrinsics file has the wrong number of values",
            where=path,
            found=len(values),
            expected="9 (the 3x3 matrix by rows) or 4 (fx fy cx cy)",
        )
    check_intrinsics(K, str(path))
    return K


def read_cam(path: PathLike) -> tuple[Float, Float]:
    """Read a Sintel .cam file.

    Returns:
        Intrinsics (3, 3), pixels, and extrinsics (3, 4), camera from world, scene units.

    Raises:
        DataError: the file is missing, has another magic number or length, or no valid camera.
    """
    content = read_bytes(path, "camera file")
    if content[:4] != FLO_MAGIC:
        raise DataError(
            "camera file has the wrong magic number",
            where=path,
            found=repr(content[:4]),
            expected=f"{FLO_MAGIC!r} (float 202021.25)",
            hint="is it really a .cam file?",
        )
    check_body(len(content) - 4, _CAM_BYTES, path, "camera file")
    values = np.frombuffer(content, "<f8", offset=4).astype(np.float64)
    K, extrinsics = values[:9].reshape(3, 3), values[9:].reshape(3, 4)
    check_intrinsics(K, str(path))
    if not np.isfinite(extrinsics).all():
        raise DataError("extrinsics are not finite", where=path, found=extrinsics.tolist())
    return K, extrinsics


def write_cam(path: PathLike, K: NDArray[np.floating], extrinsics: NDArray[np.floating]) -> None:
    """Write a Sintel .cam file.

    Args:
        path: Target; written whole or not at all.
        K: (3, 3) intrinsics, pixels.
        extrinsics: (3, 4) camera from world, scene units.

    Raises:
        DataError: K is no camera, the extrinsics have another shape, or the file is not writable.
    """
    check_intrinsics(np.asarray(K, dtype=np.float64), str(path))
    if np.shape(extrinsics) != (3, 4):
        raise DataError(
            "extrinsics have the wrong shape",
            where=path,
            found=np.shape(extrinsics),
            expected="(3, 4)",
        )
    body = np.asarray(K, "<f8").tobytes() + np.asarray(extrinsics, "<f8").tobytes()
    write_bytes(path, FLO_MAGIC + body)


def read_kitti_calib(path: PathLike) -> dict[str, Float]:
    """Read a KITTI calibration file of 'name: numbers' lines.

    The stereo/flow 2012 files ('P0: ...') and the raw 'calib_cam_to_cam.txt' ('K_00: ...',
    'P_rect_02: ...') are both understood. Lines without any number (calib_time) are left out.

    Returns:
        Name -> array: (3, 4) for 12 numbers, (3, 3) for 9, (n,) for any other number.

    Raises:
        DataError: the file is missing, a line has no name, a value is not a finite number, or no
            matrix is left.
    """
    entries: dict[str, Float] = {}
    for number, line in enumerate(read_text(path, "calibration file").splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        name, colon, rest = line.partition(":")
        if not colon:
            raise DataError(
                "calibration line has no name",
                where=f"{path}, line {number}",
                found=repr(line[:40]),
                expected="'name: numbers', e.g. 'P0: 7.188560e+02 0 6.071928e+02 ...'",
            )
        numeric = [_is_number(word) for word in rest.split()]
        if not any(numeric):
            continue
        if not all(numeric):
            raise DataError(
                "calibration line mixes numbers and words",
                where=f"{path}, line {number}",
                found=repr(line[:60]),
                expected="finite numbers only",
            )
        values = np.array([float(word) for word in rest.split()])
        shape = {12: (3, 4), 9: (3, 3)}.get(values.size, (values.size,))
        entries[name.strip()] = values.reshape(shape)
    if not entries:
        raise DataError(
            "calibration file holds no matrix", where=path, expected="lines 'P0: 12 numbers'"
        )
    return entries


def _is_number(word: str) -> bool:
    try:
        return bool(np.isfinite(float(word)))
    except ValueError:
        return False


def calib_entry(
    calib: dict[str, Float], name: str, shape: tuple[int, ...], path: PathLike
) -> Float:
    """One matrix of `read_kitti_calib`.

    Raises:
        DataError: the name is missing or has another shape.
    """
    if name not in calib:
        raise DataError(
            f"calibration file lacks {name}",
            where=path,
            found=", ".join(calib),
            expected=f"a line '{name}: ...' with {int(np.prod(shape))} numbers",
        )
    if calib[name].shape != shape:
        raise DataError(
            f"calibration entry {name} has the wrong size",
            where=path,
            found=f"{calib[name].size} numbers",
            expected=f"{int(np.prod(shape))} numbers",
        )
    return calib[name]


def vkitti1_intrinsics() -> Float:
    """(3, 3) intrinsics of every Virtual KITTI 1 image (1242 x 375): f 725, cx 620.5, cy 187."""
    return intrinsics(725.0, 725.0, 620.5, 187.0)


def read_vkitti2_intrinsics(path: PathLike) -> dict[tuple[int, int], Float]:
    """Read a Virtual KITTI 2 intrinsic.txt.

    Its columns are: frame cameraID K[0,0] K[1,1] K[0,2] K[1,2].

    Returns:
        (frame, camera) -> (3, 3) intrinsics, pixels.

    Raises:
        DataError: the file or a column is missing, a row is not numeric, or no valid camera.
    """
    lines = read_text(path, "intrinsics file").splitlines()
    columns = _columns(lines[0].split(), path)
    out: dict[tuple[int, int], Float] = {}
    for number, line in enumerate(lines[1:], 2):
        if not line.strip():
            continue
        where = f"{path}, line {number}"
        row = parse_numbers(line, where, "intrinsics file")
        if len(row) <= max(columns):
            raise DataError(
                "intrinsics row is too short",
                where=where,
                found=f"{len(row)} values",
                expected=f"{max(columns) + 1} values",
            )
        frame, camera, fx, fy, cx, cy = (row[c] for c in columns)
        K = intrinsics(fx, fy, cx, cy)
        check_intrinsics(K, where)
        out[int(frame), int(camera)] = K
    return out


def _columns(header: Sequence[str], path: PathLike) -> list[int]:
    """Positions of the six columns that `read_vkitti2_intrinsics` needs."""
    names = ["frame", "cameraID", "K[0,0]", "K[1,1]", "K[0,2]", "K[1,2]"]
    missing = [name for name in names if name not in header]
    if missing:
        raise DataError(
            "intrinsics file lacks columns",
            where=path,
            found=" ".join(header),
            expected=" ".join(names),
        )
    return [header.index(name) for name in names]
