"""Camera files: intrinsics and distortion of common tools, Sintel .cam.

All intrinsics are (3, 3), in pixels. Every reader raises `DataError` for a file that is missing, of
another kind, or without one valid camera. `camera_text` gives the names and words of a file, and
one table says what a name means. Names of other models, values that are no numbers, and a name
twice with other values are refused.
"""

import math
import re
from collections.abc import Sequence
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, Image
from soup_nlp.data.formats.camera_text import Named, named_words
from soup_nlp.data.formats.cameras import written
from soup_nlp.data.formats.images import array_of, check_body, is_path
from soup_nlp.data.formats.map_files import MAGIC, after_magic
from soup_nlp.errors import DataError
from soup_nlp.geometry.camera import intrinsics
from soup_nlp.storage.files import PathLike, read_bytes

CameraLike: TypeAlias = Any
"""A 3x3 matrix, four numbers (fx, fy, cx, cy) in pixels, or a file with one of these."""
DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Coefficients of distortion in OpenCV's order; up to six more have no common names."""

_EXPECTED = (
    "one pinhole camera in pixels: fx fy cx cy or a 3x3 matrix, as numbers or with names (text,"
    " YAML, JSON, INI, .npy, COLMAP's cameras.txt), with distortion k1 k2 p1 p2 k3 ... or without"
)
_FOUR = "give the four numbers: --intrinsics FX,FY,CX,CY, in Python K_ref=(fx, fy, cx, cy)"
_UNDISTORT = "undistort the images first, and give the camera of the new images"

_FOCAL = r"(?:f|fl|focal(?:_?length)?)"
_POINT = r"(?:c|pp|principal_?point)"
_PARAMETERS = {
    "fx": rf"{_FOCAL}_?x|fu",
    "fy": rf"{_FOCAL}_?y|fv",
    "cx": rf"{_POINT}_?x|cu|u0",
    "cy": rf"{_POINT}_?y|cv|v0",
    "f": rf"{_FOCAL}|fc",
    "c": rf"{_POINT}|cc",
    "skew": "skew",
    **{name: f"{name[0]}_?{name[1]}" for name in DISTORTION},
}
"""Names of single parameters, which may have others before them: left_fx, Camera1.fx."""
_WHOLE = {
    "matrix": r"k|k_\d+|mtx|cam_?k|(?:camera_?)?intrinsics?(?:_?matrix)?|camera_?matrix",
    "list": r"d_?\d*|kc|disto?|(?:distortion|dist)(?:_?(?:coeff\w*|param\w*|vector))?|coeff\w*",
    "model": r"(?:camera|distortion|lens|projection)?_?(?:model|type)(?:_?name)?|projection|lens",
    # parameters of double sphere, extended unified, field-of-view and division cameras
    "other": r"xi|alpha|beta|omega|lambda",
}
"""Names of a camera, of its distortion, of its model, and of parameters of other models."""
_OTHER = r"fish|equidist|kannala|omni"
_UNKNOWN = (
    r"(?<!un)distort|dist_?co|\bdist\b|radial|tangential|coeff|kappa|poly|\bk_?\d*$|\bp_?\d+$"
    r"|\bs_?[1-4]$|\btau_?[xy]$"
)
"""Parts of names of another model; of a distortion that is not OpenCV's."""


def _either(patterns: dict[str, str]) -> str:
    return "|".join(f"(?P<{meaning}>{pattern})" for meaning, pattern in patterns.items())


_MEANING = re.compile(
    rf"(?P<other_name>.*(?:{_OTHER}).*)"
    rf"|(?:(?P<group>.*)[._ -])?(?:{_either(_PARAMETERS)})"
    rf"|(?:.*\.)?(?:{_either(_WHOLE)})"
    rf"|(?P<unknown>.*(?:{_UNKNOWN}).*)",
    re.IGNORECASE,
)
"""The one table of names."""
_PINHOLE = (
    r"pin_?hole|opencv|rad_?tan|radial|plumb|rational|brown|perspective|linear|none|null|false|^$"
)
_OTHER_MODEL = (
    r"fish|equi|kannala|brandt|double|spher|^ds$|^e?ucm$|unified|omni|^mei|^fov|atan|^kb\d*$|scara"
    r"|ocam|pano|cylind|division|prism|theta|ortho"
)
_NUMBER = re.compile(
    r"[-+]?(?:(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?|\.?nan|\.?inf(?:inity)?)", re.IGNORECASE
)


def refused(what: str, where: PathLike, found: object = None, hint: str = _FOUR) -> DataError:
    """The error for a camera file, with what is expected and what to try."""
    return DataError(what, where=where, found=found, expected=_EXPECTED, hint=hint)


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
            hint="give fy without its sign, if the y axis points up (ICL-NUIM)" if up else _FOUR,
        )
    return K


def camera_of(source: CameraLike, where: str) -> Float:
    """(3, 3) intrinsics from a matrix, from (fx, fy, cx, cy), or from a file."""
    if is_path(source):
        return read_intrinsics(source)
    numbers = array_of(source, "intrinsics", where, "(3, 3), or fx, fy, cx, cy")
    return check_intrinsics(intrinsics(*numbers) if numbers.shape == (4,) else numbers, where)


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
        named = named_words(path)
    except DataError as error:
        if error.hint:
            raise
        raise refused(error.what, path, error.found) from None
    except ValueError as error:  # also of decoding
        raise refused("camera file is not text of a known kind", path, error) from None
    if [name for name, _ in named] == [""]:
        return _plain([number(word, "", path) for word in named[0][1]], path)
    cameras, distortion = _interpreted(named, path)
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
        shown = ", ".join(name for name, _ in named[:12]) or "nothing"
        angles = [words[0] for name, words in named if words and name.endswith("camera_angle_x")]
        hint = _FOUR
        if angles and re.fullmatch(r"\d*\.\d+", angles[0]):
            # NeRF's, in radians
            degrees = math.degrees(float(angles[0]))
            hint = f"camera_angle_x is a field of view: --fov {degrees:.2f}"
        raise refused("camera file holds no camera", path, shown, hint)
    return check_intrinsics(cameras[0][1], path), distortion


def _plain(values: list[float], where: PathLike) -> tuple[Float, Float]:
    K = _matrix_of(values)
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
    return len(values) > 0 and all(abs(x) < 100 for x in values)


def _matrix_of(values: Sequence[float]) -> Float | None:
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


def number(word: str, name: str, where: PathLike) -> float:
    """A word as a number, all of it."""
    if not _NUMBER.fullmatch(word):
        comma = ", with a point instead of the decimal comma" if "," in word else ""
        what = f"camera file holds a word that is not a number{name and ' for '}{name}"
        raise refused(what, where, repr(word), f"write plain numbers{comma}; or {_FOUR}")
    return float(re.sub(r"\.(?=[ni])", "", word.lower()))


def _interpreted(named: Named, where: PathLike) -> tuple[list[tuple[str, Float]], Float]:
    """Names and intrinsics (3, 3) of all cameras, and distortion (n,) of all names in the file."""
    cameras: list[tuple[str, Float]] = []
    groups: dict[str, dict[str, list[float]]] = {}
    lens: dict[int, float] = {}
    inverse = any("inverse" in word.lower() for _, words in named for word in words)
    for name, words in named:
        group, meaning = _meaning(name, words)
        text = " ".join(words)
        if meaning in ("model", "other") and _of_other_model(name, meaning, text.lower()):
            what = "camera file holds a camera of another model, such as a fisheye lens"
            hint = f"{_UNDISTORT}, for example by cv2.fisheye.undistortImage"
            raise refused(what, where, f"{name}: {text}", hint)
        if meaning in ("", "model", "other"):
            continue
        if meaning in _PARAMETERS and len(words) not in ((1, 2) if meaning in "fc" else (1,)):
            raise refused(f"{name} is not one number", where, text or "no number")
        values = [number(word, name, where) for word in words]
        if meaning == "matrix":
            K = intrinsics(*values) if len(values) == 4 else _matrix_of(values)
            cameras.append((name, np.reshape(values[:9], (3, 3)) if K is None else K))
        elif meaning == "unknown" or (meaning == "list" and (len(values) > 14 or inverse)):
            if any(values):
                what = "camera file holds distortion of another model than OpenCV's"
                raise refused(what, where, f"{name}: {text}", _UNDISTORT)
        elif meaning == "list" or meaning in DISTORTION:
            for k, x in enumerate(values, 0 if meaning == "list" else DISTORTION.index(meaning)):
                if not math.isfinite(x) or lens.setdefault(k, x) != x:
                    both = f"{lens[k]:g} and {x:g}" if k in lens else f"{x:g}"
                    raise refused(f"distortion {name} is unclear", where, both)
        elif groups.setdefault(group, {}).setdefault(meaning, values) != values:
            both = f"{groups[group][meaning][0]:g} and {values[0]:g}"
            raise refused(f"{name} is given twice", where, both)
    for group, found in groups.items():
        if {"fx", "fy"} & found.keys() or ("f" in found and {"cx", "cy", "c"} & found.keys()):
            cameras.append((group, _grouped(group, found, where)))
    return cameras, np.trim_zeros(np.array([lens.get(k, 0.0) for k in range(14)]), "b")


def _meaning(name: str, words: Sequence[str]) -> tuple[str, str]:
    """The names before a parameter of a camera, and its meaning; empty for neither."""
    match = _MEANING.fullmatch(name)
    meaning = str(match.lastgroup).removesuffix("_name") if match else ""
    numeric = len(words) > 0 and all(map(_NUMBER.fullmatch, words))
    if meaning in ("list", "unknown") and words and not re.match(r"[-+.\d]", words[0]):
        meaning = "model" if meaning == "list" else ""
    elif meaning in ("f", "c") and not numeric:
        meaning = ""  # such as the focal length in millimetres
    elif meaning == "matrix" and len(words) not in (4, 9, 12, 16):
        meaning = "unknown" if re.fullmatch(r"(?:.*\.)?k(?:_\d+)?", name, re.IGNORECASE) else ""
    elif len(words) in (9, 12, 16) and meaning in ("", "model", "unknown", *DISTORTION):
        projection = len(words) == 12 and re.fullmatch(r"(?:.*\.)?p\d+", name, re.IGNORECASE)
        K = _matrix_of([float(word) for word in words]) if numeric else None
        # a rotation has no element above 1
        camera = K is not None and K.diagonal().min() > 0 and K[0, 0] > 1
        meaning = "matrix" if camera and (projection or len(words) == 9) else ""
    return (match["group"] or "" if match else ""), meaning


def _of_other_model(name: str, meaning: str, value: str) -> bool:
    """Whether the value of a name means another model than a pinhole camera."""
    numbers = re.fullmatch(r"[-+.\d\se]*", value)
    last = name.rpartition(".")[2].lower()
    if meaning == "model":
        # a model or type may be that of something else
        loose = last in ("model", "type", "lens", "projection") or re.search(_PINHOLE, value)
        return not numbers and bool(re.search(_OTHER_MODEL, value) or not loose)
    # is_fisheye: true, fisheye.k1: 0.1, xi: 0.2
    parameter = re.fullmatch(_WHOLE["other"], last)
    given = value not in ("", "0", "0.0", "false", "none", "null", "no")
    return given and bool(numbers or not parameter)


def _grouped(group: str, values: dict[str, list[float]], where: PathLike) -> Float:
    # both may have one name, f or c
    parts = {n: values.get(n) or values.get(n[0], []) for n in ("fx", "fy", "cx", "cy")}
    missing = [name for name, found in parts.items() if not found]
    if missing:
        what = f"camera {group}".strip() + f" lacks {' and '.join(missing)}"
        raise refused(what, where, ", ".join(values))
    K = intrinsics(*(found[-1 if name[1] == "y" else 0] for name, found in parts.items()))
    K[0, 1] = values.get("skew", [0.0])[0]
    return K


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
