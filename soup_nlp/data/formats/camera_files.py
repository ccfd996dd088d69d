"""Camera files: intrinsics of common tools, Sintel .cam, rows of KITTI and Virtual KITTI.

All intrinsics are (3, 3), in pixels. Every reader raises `DataError` for a file that is missing, of
another kind, or without one valid camera.
"""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, Image
from soup_nlp.data.formats.camera_names import (
    DISTORTION,
    TRY,
    cameras_of,
    check_model,
    distortion_of,
    matrix_of,
    names_found,
    number,
    refused,
)
from soup_nlp.data.formats.camera_text import leaves
from soup_nlp.data.formats.images import check_body
from soup_nlp.data.formats.map_files import MAGIC, after_magic
from soup_nlp.errors import DataError
from soup_nlp.geometry.camera import intrinsics
from soup_nlp.storage.files import PathLike, read_bytes, read_text


def check_intrinsics(matrix: NDArray[Any], where: object) -> Float:
    """A matrix as (3, 3) intrinsics.

    Raises:
        DataError: it is not a finite, upper-triangular 3x3 matrix with positive focal lengths.
    """
    K = np.array(matrix, dtype=np.float64)
    if not (
        K.shape == (3, 3)
        and np.isfinite(K).all()
        and (K.diagonal() > 0).all()
        and (K[np.tril_indices(3, -1)] == 0).all()
        and K[2, 2] == 1
    ):
        up = K.shape == (3, 3) and K[1, 1] < 0 < K[0, 0]
        raise DataError(
            "intrinsics are no camera matrix",
            where=where,
            found=K.tolist(),
            expected="finite numbers [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with positive fx and fy",
            hint="give fy without its sign, if the y axis points up (ICL-NUIM)" if up else TRY,
        )
    return K


def read_intrinsics(path: PathLike) -> Float:
    """Read intrinsics without distortion, see `read_camera`.

    Raises:
        DataError: the file holds distortion.
    """
    K, distortion = read_camera(path)
    if distortion.any():
        raise DataError(
            "camera file holds lens distortion, which the method does not model",
            where=path,
            found=" ".join(f"{n} {x:g}" for n, x in zip(DISTORTION, distortion)),
            expected="fx fy cx cy of images without distortion",
            hint="--undistort (input.undistort) removes it from both images by OpenCV; if they are"
            " free of it already, delete its numbers from the file",
        )
    return K


def read_camera(path: PathLike) -> tuple[Float, Float]:
    """Read intrinsics (3, 3) and distortion (n,) of OpenCV (k1 k2 p1 p2 k3 ...) from a file.

    Numbers without names are the 3x3 matrix, row by row, or fx fy cx cy, and then the distortion if
    there is one. With names the file is that of a common tool (ROS, OpenCV, Kalibr, nerfstudio,
    Open3D, RealSense, COLMAP ...).

    Raises:
        DataError: the file holds no camera, several cameras, or one of another model.
    """
    try:
        if read_bytes(path, "camera file").startswith(MAGIC):
            return read_cam(path), np.zeros(0)
        named = leaves(path)
    except DataError as error:
        if error.hint:
            raise
        raise refused(error.what, path, error.found) from None
    except ValueError as error:  # also of decoding
        raise refused("camera file is not text of a known kind", path, error) from None
    if [names for names, _ in named] == [()]:
        return _plain([number(word, "", path) for word in named[0][1]], path)
    check_model(named, path)
    cameras = cameras_of(named, path)
    different: dict[tuple[float, ...], str] = {}
    for name, K in cameras:
        different.setdefault(tuple(K.ravel()), f"{name or 'unnamed'}: {_four(K)}")
    if len(different) > 1:
        several = list(different.values())
        raise refused(
            f"camera file holds {len(several)} cameras",
            path,
            "; ".join(several[:8]),
            f"choose one by its numbers: --intrinsics {_four(cameras[0][1])} for {cameras[0][0]}",
        )
    if not cameras:
        raise refused("camera file holds no camera", path, *names_found(named))
    return check_intrinsics(cameras[0][1], path), distortion_of(named, path)


def _four(K: Float) -> str:
    return ",".join(f"{x:.9g}" for x in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))


def _plain(values: list[float], where: PathLike) -> tuple[Float, Float]:
    """Intrinsics and distortion of numbers without names."""
    K = matrix_of(values)
    if K is not None:
        return check_intrinsics(K, where), np.zeros(0)
    matrix = len(values) in (13, 14, 17) or (len(values) == 9 and not _small(values[4:]))
    count = 9 if matrix else 4
    if not (len(values) == count or (_small(values[count:]) and len(values) < 23)):
        raise refused("intrinsics file has the wrong number of values", where, len(values))
    K = np.reshape(values[:9], (3, 3)) if matrix else intrinsics(*values[:4])
    return check_intrinsics(K, where), np.array(values[count:])


def _small(values: Sequence[float]) -> bool:
    """Whether numbers may be coefficients of distortion."""
    return len(values) > 0 and max(abs(x) for x in values) < 100


def undistorted(image: Image, K: Float, distortion: Float) -> tuple[Image, Float]:
    """An undistorted image (H, W, 3) without empty pixels, and its intrinsics."""
    padded = np.zeros(14)
    padded[: len(distortion)] = distortion
    size = image.shape[1], image.shape[0]
    new, _ = cv2.getOptimalNewCameraMatrix(K, padded, size, 0)
    return np.asarray(cv2.undistort(image, K, padded, None, new)), np.asarray(new, np.float64)


def read_cam(path: PathLike) -> Float:
    """Read the intrinsics of a Sintel .cam file; its extrinsics are not used."""
    content = after_magic(path, "camera file")
    check_body(len(content), 8 * (9 + 12), path, "camera file")  # (3, 3) and (3, 4)
    return check_intrinsics(np.frombuffer(content, "<f8", 9).reshape(3, 3), path)


def read_rows(path: PathLike, names: Sequence[str], count: int) -> Float:
    """Read the rows of a text file with these names as numbers (len(names), count).

    A projection of KITTI is the row "P0:" or "P_rect_02:" of 12 numbers, a camera of Virtual KITTI
    2 the row "FRAME CAMERA" of fx fy cx cy.
    """
    lines = [line.split() for line in read_text(path, "calibration file").splitlines()]
    out = []
    for name in names:
        head = name.split()
        rows = [line[len(head) :] for line in lines if line[: len(head)] == head]
        row = [number(word, name, path) for word in (rows[0] if rows else [])]
        if len(row) != count or not np.isfinite(row).all():
            others = [line[0] for line in lines if line]
            raise DataError(
                f"calibration file lacks the numbers of {name}",
                where=path,
                found=" ".join(rows[0]) if rows else f"lines {', '.join(others[:20])}",
                expected=f"a line '{name} ...' with {count} finite numbers",
            )
        out.append(row)
    return np.array(out)
