"""Plausibility of intrinsics for the size of an image, and the likely cause where they are not."""

from __future__ import annotations

import warnings

from soup_nlp.arrays import Float
from soup_nlp.data.formats.images import DataWarning
from soup_nlp.errors import DataError
from soup_nlp.geometry.camera import intrinsics

OFF_MIDDLE = 0.25
"""Largest distance of the principal point from the middle, relative to the side."""
UNEVEN = 1.2
"""Largest ratio of fx and fy."""
NEAR_MIDDLE = 0.05
"""Usual distance of the principal point from the middle, relative to the side."""
RESIZED = 1.25
"""Smallest ratio of sizes that shows that intrinsics belong to another resolution."""
_AGREE = 1.1
"""Ratio of two numbers that are taken to be equal."""


def check_camera(K: Float, size: tuple[int, int], where: object, cropped: bool = False) -> None:
    """Check intrinsics (3, 3) for an image of `size` (height, width).

    Args:
        K: Intrinsics, pixels.
        size: (height, width) of the image.
        where: The image, for messages.
        cropped: The image is a part of a larger one, so that its principal point is anywhere.

    Raises:
        DataError: the principal point is outside of the image.

    Warns:
        DataWarning: the principal point is far from the middle, fx and fy differ much, or the
            intrinsics are those of another resolution.
    """
    problems = _problems(K, size, cropped)
    if not problems:
        return
    cause, fits = _explanation(K, size)
    hint = f"{cause}; {','.join(f'{x:g}' for x in _four(fits))} would fit"
    (x, y), (height, width) = K[:2, 2], size
    if not cropped and not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
        raise DataError(
            "principal point is outside of the image",
            where=where,
            found=f"fx,fy,cx,cy {','.join(f'{x:g}' for x in _four(K))} at {width} x {height}",
            expected="a principal point near the middle",
            hint=f"{hint}. Of images that were cropped, --set input.cropped=true accepts it",
        )
    text = f"{where}, {width} x {height}: {' and '.join(problems)}. Likely cause: {hint}"
    warnings.warn(text, DataWarning, stacklevel=3)


def _four(K: Float) -> tuple[float, float, float, float]:
    return K[0, 0], K[1, 1], K[0, 2], K[1, 2]


def _ratio(a: float, b: float) -> float:
    """Ratio of two numbers, at least 1; infinite unless both are positive."""
    return max(a / b, b / a) if a > 0 and b > 0 else float("inf")


def _off_middle(x: float, y: float, size: tuple[int, int]) -> float:
    """Larger distance of a point from the middle of an image, relative to the side."""
    height, width = size
    return max(abs(x - (width - 1) / 2) / width, abs(y - (height - 1) / 2) / height)


def _problems(K: Float, size: tuple[int, int], cropped: bool) -> list[str]:
    """What is implausible about intrinsics."""
    fx, fy, cx, cy = _four(K)
    height, width = size
    off = _off_middle(cx, cy, size)
    across, down = (cx + 0.5) / width * 2, (cy + 0.5) / height * 2
    out = []
    exchanged = off > 2 * NEAR_MIDDLE and _off_middle(cy, cx, size) < NEAR_MIDDLE
    if (off > OFF_MIDDLE or exchanged) and not cropped:
        out.append(f"principal point {cx:g}, {cy:g} is far from the middle")
    elif _ratio(across, 1) > RESIZED and _ratio(across, down) < _AGREE and not cropped:
        out.append(f"principal point {cx:g}, {cy:g} is the middle of another size")
    if _ratio(fx, fy) > UNEVEN:
        out.append(f"fx {fx:g} and fy {fy:g} differ much")
    return out


def _explanation(K: Float, size: tuple[int, int]) -> tuple[str, Float]:
    """The likely cause of implausible intrinsics, and intrinsics without it."""
    fx, fy, cx, cy = _four(K)
    height, width = size
    middle = (width - 1) / 2, (height - 1) / 2
    candidates = [
        ("the order is fx cx fy cy", intrinsics(fx, cx, fy, cy)),
        ("cx and cy are exchanged", intrinsics(fx, fy, cy, cx)),
    ]
    if cx > 0 and cy > 0:
        # half a pixel, since (0, 0) is the centre of the first pixel
        across, down = width / (2 * cx + 1), height / (2 * cy + 1)
        other = f"intrinsics of an image of {2 * cx + 1:.0f} x {2 * cy + 1:.0f}"
        # sizes keep their proportions, or the focal lengths show that they do not
        if _ratio(across, down) < _AGREE or _ratio(fx * across, fy * down) < _AGREE:
            candidates.append((other, intrinsics(fx * across, fy * down, *middle)))
    for cause, fits in candidates:
        near = _off_middle(fits[0, 2], fits[1, 2], size) < 2 * NEAR_MIDDLE
        if near and min(fits[0, 0], fits[1, 1]) > 0 and not _problems(fits, size, False):
            return cause, fits
    focal = fx if _ratio(fx, fy) > UNEVEN else fy
    return "a crop, or a wrong file", intrinsics(fx, focal, *middle)
