"""Intrinsics of pictures: estimated where no file gives them, and checked for plausibility."""

import math
from collections.abc import Sequence

import numpy as np
from PIL.ExifTags import Base

from soup_nlp.arrays import Float, Image
from soup_nlp.data.formats.images import PathLike, exif_tags, warn
from soup_nlp.errors import ConfigError, DataError
from soup_nlp.geometry.camera import intrinsics

GUESS = 1.2
"""Default focal length relative to the longer side of the image (45 degrees of view)."""
GUESS_SIGMA = 0.4
"""Standard deviation of the logarithm of `GUESS`; cameras of nine data sets have 0.58 to 1.91."""
NARROWEST, WIDEST = 10.0, 150.0
"""Plausible fields of view along the longer side, degrees."""

_LONGER_35 = 36.0  # longer side of a frame of 35 mm film, mm


def estimated_cameras(
    paths: Sequence[PathLike | None], images: Sequence[Image], fov: float | None = None
) -> tuple[list[Float], float]:
    """Intrinsics (3, 3) of pictures, and the standard deviation of the log focal length.

    Pixels are square, and the principal point is in the middle. The focal length is that of the
    horizontal field of view `fov` (degrees) of the first picture, or else of EXIF, or else `GUESS`;
    a warning names its origin. The deviation is 0 where `fov` or EXIF gives it. A picture without
    EXIF, or without a file (None), gets the focal length of another one, relative to the longer
    side.
    """
    exif_focals = [exif_focal(path) for path in paths]
    first_exif = next((focal for focal in exif_focals if focal), None)
    relative = [focal or first_exif or GUESS for focal in exif_focals]
    sizes = [(image.shape[1], image.shape[0]) for image in images]
    if fov is not None:
        if not 0 < fov < 180:
            raise ConfigError(
                "field of view is out of range", found=f"{fov:g}", expected="0 to 180 degrees"
            )
        # the ratio of the two focal lengths is that in EXIF
        first = sizes[0][0] / (2 * math.tan(math.radians(fov) / 2)) / max(sizes[0])
        if not NARROWEST <= _degrees(first) <= WIDEST:
            usual = f"{NARROWEST:g} to {WIDEST:g}; it is in degrees, not in radians"
            warn("fov", f"a field of view of {fov:g} degrees is outside of the usual {usual}")
        relative = [first * focal / relative[0] for focal in relative]
    sides = [focal * max(size) for focal, size in zip(relative, sizes)]
    out = [intrinsics(f, f, (w - 1) / 2, (h - 1) / 2) for f, (w, h) in zip(sides, sizes)]
    alike = all(np.array_equal(K, out[0]) for K in out)
    other = "the EXIF of the other frame" if first_exif else f"{GUESS} times the longer side"
    doubt = (
        ". The flow corrects it where it determines it; a wrong focal length stretches and bends"
        " depth: give --intrinsics or --fov"
    )
    for k, focal in enumerate(sides[: 0 if fov is not None else 1 if alike else None]):
        warn(
            paths[k] or "image",
            f"no intrinsics; focal length {focal:.0f} px from {'EXIF' if exif_focals[k] else other}"
            f" ({_degrees(focal / sizes[k][0]):.0f} degrees of view horizontally), principal point"
            f" in the middle{'' if first_exif else doubt}",
        )
    return out, 0.0 if first_exif or fov is not None else GUESS_SIGMA


def _degrees(focal: float) -> float:
    """Field of view of a side of length 1, degrees."""
    return 2 * math.degrees(math.atan2(0.5, focal))


def exif_focal(path: PathLike | None) -> float | None:
    """Focal length of EXIF relative to the longer side of a picture; None if not plausible."""
    try:
        tag = ({} if path is None else exif_tags(path)).get(Base.FocalLengthIn35mmFilm, 0)
        focal = float(tag) / _LONGER_35
    except Exception:  # a malformed tag may raise any type
        return None
    if not (math.isfinite(focal) and focal > 0):
        return None
    if NARROWEST <= _degrees(focal) <= WIDEST:
        return focal
    side = f"{focal:.3g} times the longer side ({_degrees(focal):.1f} degrees of view)"
    warn(path, f"the focal length of EXIF is ignored, since {side} is implausible")
    return None


# --- plausibility ---------------------------------------------------------------------------------

OFF_MIDDLE, NEAR_MIDDLE = 0.25, 0.05
"""Largest and usual distance of the principal point from the middle, relative to the side."""
UNEVEN = 1.2
"""Largest ratio of fx and fy."""
RESIZED, ALIKE = 1.25, 1.1
"""Ratio of sizes that shows another resolution; ratio of two numbers that are taken as equal."""


def check_cameras(
    cameras: Sequence[Float], images: Sequence[Image], names: Sequence[object], cropped: bool
) -> None:
    """Warn of implausible intrinsics (3, 3) and of their likely cause.

    A principal point outside of its image is a DataError. Those of `cropped` images, which are
    parts of larger ones, may be anywhere.
    """
    alike = images[0].shape == images[1].shape and np.array_equal(cameras[0], cameras[1])
    for K, image, where in list(zip(cameras, images, names))[: 1 if alike else 2]:
        height, width = size = image.shape[:2]
        problems = _problems(K, size, cropped)
        if not problems:
            continue
        cause, fits = _explanation(K, size)
        hint, (x, y) = f"{cause}; {written(fits)} would fit", K[:2, 2]
        if not cropped and not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
            raise DataError(
                "principal point is outside of the image",
                where=where,
                found=f"fx,fy,cx,cy {written(K)} at {width} x {height}",
                expected="a principal point near the middle",
                hint=f"{hint}. If the images were cropped, --set input.cropped=true accepts it, in"
                " Python solve_pair(pair, cropped=True)",
            )
        text = f"{' and '.join(problems)}. Likely cause: {hint}"
        warn(f"{where}, {width} x {height}", text)


def written(K: Float, digits: int = 6) -> str:
    """fx,fy,cx,cy as `--intrinsics` takes them."""
    return ",".join(f"{x:.{digits}g}" for x in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))


def _ratio(a: float, b: float) -> float:
    """Ratio of two numbers, at least 1; infinite unless both are positive."""
    return max(a / b, b / a) if a > 0 and b > 0 else float("inf")


def _off_middle(x: float, y: float, size: Sequence[int]) -> float:
    """Larger distance of a point from the middle of an image, relative to the side."""
    return max(abs((x + 0.5) / size[1] - 0.5), abs((y + 0.5) / size[0] - 0.5))


def _problems(K: Float, size: Sequence[int], cropped: bool) -> list[str]:
    """Descriptions of implausible intrinsics; empty for plausible ones."""
    (fx, fy), (cx, cy) = K[[0, 1], [0, 1]], K[:2, 2]
    off, exchanged = _off_middle(cx, cy, size), _off_middle(cy, cx, size)
    across, down = (2 * cx + 1) / size[1], (2 * cy + 1) / size[0]
    out = []
    if not cropped:
        if off > OFF_MIDDLE or (off > 2 * NEAR_MIDDLE and exchanged < NEAR_MIDDLE):
            out.append(f"principal point {cx:g}, {cy:g} is far from the middle")
        elif _ratio(across, 1) > RESIZED and _ratio(across, down) < ALIKE:
            out.append(f"principal point {cx:g}, {cy:g} is the middle of another size")
    if _ratio(fx, fy) > UNEVEN:
        out.append(f"fx {fx:g} and fy {fy:g} differ much")
    if (degrees := _degrees(fx / max(size))) > WIDEST:
        out.append(f"fx {fx:g} is a view of {degrees:.0f} degrees")
    return out


def _explanation(K: Float, size: Sequence[int]) -> tuple[str, Float]:
    """The likely cause of implausible intrinsics, and intrinsics without it."""
    (fx, fy), (cx, cy), (height, width) = K[[0, 1], [0, 1]], K[:2, 2], size
    middle = (width - 1) / 2, (height - 1) / 2
    # scale from the image that has its middle at the principal point to this image
    across, down = width / max(2 * cx + 1, 1e-9), height / max(2 * cy + 1, 1e-9)
    resized = intrinsics(fx * across, fy * down, *middle)
    if _ratio(across, down) < ALIKE:
        # square pixels stay square, and images are mostly halved or doubled: the principal point
        # is not exactly in the middle
        scale = math.sqrt(across * down)
        whole = float(round(max(scale, 1 / scale))) ** (1 if scale > 1 else -1)
        scale = whole if _ratio(whole, scale) < ALIKE else scale
        centre = (cx + 0.5) * scale - 0.5, (cy + 0.5) * scale - 0.5
        resized = intrinsics(fx * scale, fy * scale, *centre)
    candidates = {
        "the order is fx cx fy cy": intrinsics(fx, cx, fy, cy),
        "cx and cy are exchanged": intrinsics(fx, fy, cy, cx),
        f"intrinsics of an image of {2 * cx + 1:.0f} x {2 * cy + 1:.0f}": resized,
    }
    for cause, fits in candidates.items():
        near = _off_middle(fits[0, 2], fits[1, 2], size) < 2 * NEAR_MIDDLE
        if near and fits.diagonal().min() > 0 and not _problems(fits, size, False):
            return cause, fits
    if _degrees(fx / max(size)) > WIDEST:
        usual = GUESS * max(size)
        return "a focal length that is not in pixels", intrinsics(usual, usual, *middle)
    return "a crop, or a wrong file", intrinsics(fx, fx if _ratio(fx, fy) > UNEVEN else fy, *middle)
