"""Camera files: intrinsics and distortion of common tools, Sintel .cam.

All intrinsics are (3, 3), in pixels. Every reader raises `DataError` for a file that is missing, of
another kind, or without one valid camera. Names of other models, values that are no numbers, and a
name twice with other values are refused.
"""

import math
import re
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, Image
from soup_nlp.data.formats.camera_text import Leaf, leaves
from soup_nlp.data.formats.cameras import written
from soup_nlp.data.formats.images import check_body
from soup_nlp.data.formats.map_files import MAGIC, after_magic
from soup_nlp.errors import DataError
from soup_nlp.geometry.camera import intrinsics
from soup_nlp.storage.files import PathLike, read_bytes

DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Coefficients of distortion in OpenCV's order; up to six more have no common names."""

_EXPECTED = (
    "one pinhole camera in pixels: fx fy cx cy or a 3x3 matrix, as numbers or with names (text,"
    " YAML, JSON, INI, .npy, COLMAP's cameras.txt), with distortion k1 k2 p1 p2 k3 ... or without"
)
TRY = "give the four numbers: --intrinsics FX,FY,CX,CY, in Python K_ref=(fx, fy, cx, cy)"

_NUMBER = re.compile(
    r"[-+]?(?:(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?|\.?nan|\.?inf(?:inity)?)", re.IGNORECASE
)
_FOCAL = r"(?:f|fl|focal(?:_?length)?)"
_POINT = r"(?:c|pp|principal_?point)"
_SCALARS = {
    "fx": rf"{_FOCAL}_?x|fu",
    "fy": rf"{_FOCAL}_?y|fv",
    "cx": rf"{_POINT}_?x|cu|u0",
    "cy": rf"{_POINT}_?y|cv|v0",
    "f": rf"{_FOCAL}|fc",
    "c": rf"{_POINT}|cc",
    "skew": "skew",
}
_PARAMETER = re.compile(
    "(?:(.*)[._ -])?(?:"
    + "|".join(f"(?P<{name}>{pattern})" for name, pattern in _SCALARS.items())
    + "|"
    + "|".join(f"(?P<{name}>{name[0]}_?{name[1]})" for name in DISTORTION)
    + ")",
    re.IGNORECASE,
)
_MATRIX = r"k|k_\d+|mtx|cam_?k|(?:camera_?)?intrinsics?(?:_?matrix)?|camera_?matrix"
_OTHER_MODEL = r"xi|alpha|beta|omega|lambda"
"""Parameters of double sphere, extended unified, field-of-view and division cameras."""
_LIST = r"d_?\d*|kc|disto?|(?:distortion|dist)(?:_?(?:coeff\w*|param\w*|vector))?|coeff\w*"
_DISTORTED = (
    r"(?<!un)distort|dist_?co|\bdist\b|radial|tangential|coeff|kappa|poly|\bk_?\d*$|\bp_?\d+$"
    r"|\bs_?[1-4]$|\btau_?[xy]$"
)
_MODEL = r"(?:camera|distortion|lens|projection)?_?(?:model|type)(?:_?name)?|projection|lens"
_PINHOLE = (
    r"pin_?hole|opencv|rad_?tan|radial|plumb|rational|brown|perspective|linear|none|null|false|^$"
)
_OTHER = (
    r"fish|equi|kannala|brandt|double|spher|^ds$|^e?ucm$|unified|omni|^mei|^fov|atan|^kb\d*$|scara"
    r"|ocam|pano|cylind|division|prism|theta|ortho"
)


def check_intrinsics(matrix: NDArray[Any], where: object) -> Float:
    """A finite, upper-triangular 3x3 matrix with positive focal lengths as (3, 3) intrinsics."""
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
    """Read intrinsics from a file without distortion, see `read_camera`."""
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
    Open3D, RealSense, COLMAP ...). Several cameras and other models are refused.
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
    different: dict[tuple[float, ...], tuple[str, str]] = {}
    for name, K in cameras:
        different.setdefault(tuple(K.ravel()), (name or "unnamed", written(K, 9)))
    if len(different) > 1:
        several = list(different.values())
        name, four = several[0]
        raise refused(
            f"camera file holds {len(several)} cameras",
            path,
            "; ".join(": ".join(camera) for camera in several[:8]),
            f"choose one by its numbers: --intrinsics {four} for {name}",
        )
    if not cameras:
        shown = ", ".join(".".join(names) for names, _ in named[:12]) or "nothing"
        raise refused("camera file holds no camera", path, shown, _field_of_view(named) or TRY)
    return check_intrinsics(cameras[0][1], path), distortion_of(named, path)


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


# --- cameras in the named values of a file --------------------------------------------------------


def refused(what: str, where: PathLike, found: object = None, hint: str = TRY) -> DataError:
    """The error for a camera file, with what is expected and what to try."""
    return DataError(what, where=where, found=found, expected=_EXPECTED, hint=hint)


def _numbers(
    words: Sequence[str], name: str, where: PathLike, counts: Sequence[int]
) -> list[float]:
    """Words as numbers, of which there must be one of these counts."""
    if len(words) not in counts:
        raise refused(f"{name} is not one number", where, " ".join(words) or "no number")
    return [number(word, name, where) for word in words]


def number(word: str, name: str, where: PathLike) -> float:
    """A word as a number, all of it."""
    if not _NUMBER.fullmatch(word):
        comma = ", with a point instead of the decimal comma" if "," in word else ""
        what = f"camera file holds a word that is not a number{name and ' for '}{name}"
        raise refused(what, where, repr(word), f"write plain numbers{comma}; or {TRY}")
    return float(re.sub(r"\.(?=[ni])", "", word.lower()))


def _field_of_view(named: Sequence[Leaf]) -> str | None:
    """A hint for a file with the field of view in radians, as of NeRF, in place of intrinsics."""
    for names, words in named:
        if names[-1:] == ("camera_angle_x",) and re.fullmatch(r"\d*\.\d+", "".join(words)):
            degrees = math.degrees(float(words[0]))
            return f"camera_angle_x is a field of view: --fov {degrees:.2f}"
    return None


def matrix_of(values: Sequence[float]) -> Float | None:
    """The camera of 9 numbers of a matrix, by rows or columns, of 3x4 or of 4x4; None for others.

    Column by column it has its principal point in the last row.
    """
    if len(values) not in (9, 12, 16):
        return None
    whole = np.reshape(values, (4, 4) if len(values) == 16 else (3, -1))
    for matrix in (whole, whole.T) if len(values) != 12 else (whole,):
        K = matrix[:3, :3]
        rest = matrix[3:].ravel().tolist() in ([], [0, 0, 0, 1])
        if rest and (K[2] == [0, 0, 1]).all() and K[1, 0] == 0:
            return np.array(K)
    return None


def _scalar(names: Sequence[str]) -> tuple[str, str]:
    """The names before a parameter of a camera, and which one it is; empty for other names."""
    match = _PARAMETER.fullmatch(".".join(names))
    return (match.group(1) or "", str(match.lastgroup)) if match else ("", "")


def cameras_of(named: Sequence[Leaf], where: PathLike) -> list[tuple[str, Float]]:
    """Name and intrinsics (3, 3) of every camera with names."""
    groups: dict[str, dict[str, list[float]]] = {}
    out: list[tuple[str, Float]] = []
    for names, words in named:
        name, last = ".".join(names), names[-1] if names else ""
        group, parameter = _scalar(names)
        if parameter in ("f", "c") and not all(map(_NUMBER.fullmatch, words)):
            continue  # a text, such as the focal length in millimetres
        if parameter in _SCALARS:
            values = _numbers(words, name, where, (1, 2) if parameter in "fc" else (1,))
            if groups.setdefault(group, {}).setdefault(parameter, values) != values:
                both = f"{groups[group][parameter][0]:g} and {values[0]:g}"
                raise refused(f"{name} is given twice", where, both)
        elif re.fullmatch(_MATRIX, last, re.IGNORECASE) and len(words) in (4, 9, 12, 16):
            values = [number(word, name, where) for word in words]
            K = intrinsics(*values) if len(values) == 4 else matrix_of(values)
            out.append((name, np.reshape(values[:9], (3, 3)) if K is None else K))
        elif len(words) == 9 or (len(words) == 12 and re.fullmatch(r"[pP]\d+", last)):
            K = matrix_of([number(word, name, where) for word in words if _NUMBER.fullmatch(word)])
            # a rotation has no element above 1
            if K is not None and K.diagonal().min() > 0 and K[0, 0] > 1:
                out.append((name, K))
    for group, found in groups.items():
        if {"fx", "fy"} & found.keys() or ("f" in found and {"cx", "cy", "c"} & found.keys()):
            out.append((group, _grouped(group, found, where)))
    return out


def _grouped(group: str, values: dict[str, list[float]], where: PathLike) -> Float:
    """Intrinsics of parameters with the same names before them."""
    four = ("fx", "fy", "cx", "cy")
    # both may have one name, f or c
    parts = {name: values.get(name) or values.get(name[0], []) for name in four}
    missing = [name for name, found in parts.items() if not found]
    if missing:
        what = f"camera {group}".strip() + f" lacks {' and '.join(missing)}"
        raise refused(what, where, ", ".join(values))
    K = intrinsics(*(found[-1 if name[1] == "y" else 0] for name, found in parts.items()))
    K[0, 1] = values.get("skew", [0.0])[0]
    return K


def check_model(named: Sequence[Leaf], where: PathLike) -> None:
    """Raise DataError if a name or a parameter is that of another model than a pinhole camera."""
    for names, words in named:
        last, value = (names[-1] if names else "").lower(), " ".join(words).lower()
        numbers = re.fullmatch(r"[-+.\d\se]*", value)
        of_model = re.fullmatch(_MODEL, last) or (re.fullmatch(_LIST, last) and not numbers)
        strict = last not in ("model", "type", "lens", "projection")
        other = re.search(_OTHER, value) or (strict and not re.search(_PINHOLE, value))
        # is_fisheye: true, fisheye.k1: 0.1, xi: 0.2
        parameter = re.fullmatch(_OTHER_MODEL, last) and numbers
        named_other = re.search("fish|equidist|kannala|omni", ".".join(names).lower())
        given = value not in ("", "0", "0.0", "false", "none", "null", "no")
        if (of_model and not numbers and other) or (given and (parameter or named_other)):
            raise refused(
                "camera file holds a camera of another model, such as a fisheye lens",
                where,
                f"{'.'.join(names)}: {value}",
                "undistort the images first, for example by cv2.fisheye.undistortImage, and give"
                " the camera of the new images",
            )


def distortion_of(named: Sequence[Leaf], where: PathLike) -> Float:
    """Coefficients (n,) of the distortion of all names in the file, in OpenCV's order."""
    found: dict[int, float] = {}
    inverse = any("inverse" in word.lower() for _, words in named for word in words)
    for names, words in named:
        name, (_, parameter) = ".".join(names), _scalar(names)
        matrix = len(words) in (9, 12, 16)  # K, or a projection P1
        as_list = re.fullmatch(_LIST, names[-1] if names else "", re.IGNORECASE)
        if parameter in DISTORTION and not matrix:
            values = {DISTORTION.index(parameter): _numbers(words, name, where, (1,))[0]}
        elif not as_list and (matrix or not re.search(_DISTORTED, name, re.IGNORECASE)):
            continue
        elif not words or not re.match(r"[-+.\d]", words[0]):
            continue  # a name of the model, none, false
        else:
            values = {k: number(word, name, where) for k, word in enumerate(words)}
            if any(values.values()) and (not as_list or len(values) > 14 or inverse):
                what = "camera file holds distortion of another model than OpenCV's"
                hint = "undistort the images first, and give the camera of the new images"
                raise refused(what, where, f"{name}: {' '.join(words)}", hint)
        for k, value in values.items():
            if not math.isfinite(value) or found.setdefault(k, value) != value:
                both = f"{found[k]:g} and {value:g}" if k in found else f"{value:g}"
                raise refused(f"distortion {name} is unclear", where, both)
    last = max((k + 1 for k, value in found.items() if value), default=0)
    return np.array([found.get(k, 0.0) for k in range(last)])
