"""Camera files: Sintel .cam, KITTI calibration, Virtual KITTI intrinsics, plain text.

All intrinsics are (3, 3), in pixels. Every reader raises `DataError` for a file that is missing, of
another kind, or without a valid camera.
"""

import re
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, Image
from soup_nlp.data.formats.images import check_body
from soup_nlp.data.formats.map_files import after_magic
from soup_nlp.errors import DataError
from soup_nlp.geometry.camera import intrinsics
from soup_nlp.storage.files import PathLike, parse_yaml, read_text

CAMERA = ("fx", "fy", "cx", "cy")
DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Coefficients of distortion in OpenCV's order; up to six more have no common names."""


def _numbers(text: str, where: PathLike, what: str) -> list[float]:
    """Numbers of a text, separated by blanks or commas."""
    values = []
    for word in text.replace(",", " ").split():
        try:
            values.append(float(word))
        except ValueError:
            raise DataError(
                f"{what} holds a word that is not a number", where=where, found=repr(word)
            ) from None
    return values


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
            hint="give fy without its sign, if the y axis points up (ICL-NUIM)" if up else None,
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
    """Read intrinsics (3, 3) and distortion (n,) of OpenCV (k1 k2 p1 p2 k3 ...) from a text file.

    The file holds nine numbers (the 3x3 matrix, row by row) or four (fx fy cx cy), separated by
    blanks or commas; lines that start with # are comments. The distortion follows if there is one.
    Instead, numbers may have names (fx: 500), or the file may be a YAML file of OpenCV or ROS.
    """
    lines = read_text(path, "intrinsics file").splitlines()
    text = "\n".join(x for x in lines if not x.strip().startswith("#"))
    values = _named(text, path) or _numbers(text, path, "intrinsics file")
    matrix = len(values) in (13, 14, 17) or (len(values) == 9 and values[6:] == [0, 0, 1])
    count = 9 if matrix or (len(values) == 9 and not _is_distortion(values[4:])) else 4
    if not (len(values) == count or (_is_distortion(values[count:]) and len(values) < 23)):
        raise DataError(
            "intrinsics file has the wrong number of values",
            where=path,
            found=len(values),
            expected="9 (the 3x3 matrix by rows) or 4 (fx fy cx cy), then the distortion if any",
        )
    K = np.reshape(values[:9], (3, 3)) if count == 9 else intrinsics(*values[:4])
    return check_intrinsics(K, path), np.array(values[count:])


def _is_distortion(values: Sequence[float]) -> bool:
    """Whether numbers may be coefficients of distortion, which are small."""
    return len(values) > 0 and max(abs(x) for x in values) < 100


def _named(text: str, where: PathLike) -> list[float]:
    """fx, fy, cx, cy and distortion of a text with names; empty if it has none.

    Raises:
        DataError: the distortion model of the lens is not OpenCV's.
    """
    if re.search("fisheye|equidistant|KannalaBrandt", text, re.IGNORECASE):
        raise DataError(
            "camera file holds the distortion of a fisheye lens",
            where=where,
            expected="a pinhole camera, with distortion k1 k2 p1 p2 k3 ... or without",
            hint="undistort the images first, for example by cv2.fisheye.undistortImage",
        )
    pattern = rf"\b({'|'.join((*CAMERA, *DISTORTION))})\b[\"']?\s*[:=]?\s*(-?[\d.]+(?:e[-+]?\d+)?)"
    named = {name.lower(): float(x) for name, x in re.findall(pattern, text, re.IGNORECASE)}
    if named.keys() >= set(CAMERA):
        last = max((k + 1 for k, name in enumerate(DISTORTION) if name in named), default=0)
        return [named.get(name, 0.0) for name in (*CAMERA, *DISTORTION[:last])]
    try:
        # the YAML parser rejects OpenCV's header and tags
        tree = parse_yaml(re.sub(r"^%YAML.*$|!!opencv-matrix", "", text, flags=re.MULTILINE))
    except ValueError:
        return []
    if not isinstance(tree, dict):
        return []

    def entry(names: str) -> list[float]:
        value: Any = next((v for k, v in tree.items() if re.fullmatch(names, str(k))), [])
        value = value.get("data", []) if isinstance(value, dict) else value
        return [float(x) for x in np.ravel(value)]

    try:
        K = entry("camera_?[mM]atrix|K")
        return [*K, *entry("distortion_(coefficients|parameters)|dist_?[cC]oeffs|D")] if K else []
    except (TypeError, ValueError):
        return []


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
        row = _numbers(" ".join(rows[0] if rows else []), f"{path}, {name}", "calibration file")
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
