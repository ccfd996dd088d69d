"""Plausibility of intrinsics for the size of an image, and the likely cause where they are not."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from soup_nlp.arrays import Float, Image
from soup_nlp.data.formats.images import DataWarning
from soup_nlp.errors import DataError
from soup_nlp.geometry.camera import intrinsics

OFF_MIDDLE, NEAR_MIDDLE = 0.25, 0.05
"""Largest and usual distance of the principal point from the middle, relative to the side."""
UNEVEN = 1.2
"""Largest ratio of fx and fy."""
RESIZED, ALIKE = 1.25, 1.1
"""Ratio of sizes that shows another resolution; ratio of two numbers that are taken as equal."""

Size = tuple[int, int]


def check_cameras(
    cameras: Sequence[Float], images: Sequence[Image], names: Sequence[object], cropped: bool
) -> None:
    """Check the intrinsics of both frames, once where they are the same; see `check_camera`."""
    alike = images[0].shape == images[1].shape and np.array_equal(cameras[0], cameras[1])
    for k in range(1 if alike else 2):
        check_camera(cameras[k], images[k].shape[:2], names[k], cropped)


def check_camera(K: Float, size: Size, where: object, cropped: bool = False) -> None:
    """Check intrinsics (3, 3) for an image of `size` (height, width).

    `cropped` says that the image is a part of a larger one: its principal point is anywhere.

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
    hint = f"{cause}; {_text(fits)} would fit"
    (x, y), (height, width) = K[:2, 2], size
    if not cropped and not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
        raise DataError(
            "principal point is outside of the image",
            where=where,
            found=f"fx,fy,cx,cy {_text(K)} at {width} x {height}",
            expected="a principal point near the middle",
            hint=f"{hint}. If the images were cropped, --set input.cropped=true accepts it, in"
            " Python solve_pair(pair, cropped=True)",
        )
    text = f"{where}, {width} x {height}: {' and '.join(problems)}. Likely cause: {hint}"
    warnings.warn(text, DataWarning, stacklevel=3)


def _text(K: Float) -> str:
    return ",".join(f"{x:g}" for x in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))


def _ratio(a: float, b: float) -> float:
    """Ratio of two numbers, at least 1; infinite unless both are positive."""
    return max(a / b, b / a) if a > 0 and b > 0 else float("inf")


def _off_middle(x: float, y: float, size: Size) -> float:
    """Larger distance of a point from the middle of an image, relative to the side."""
    return max(abs((x + 0.5) / size[1] - 0.5), abs((y + 0.5) / size[0] - 0.5))


def _problems(K: Float, size: Size, cropped: bool) -> list[str]:
    """What is implausible about intrinsics."""
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
    return out


def _explanation(K: Float, size: Size) -> tuple[str, Float]:
    """The likely cause of implausible intrinsics, and intrinsics without it."""
    (fx, fy), (cx, cy), (height, width) = K[[0, 1], [0, 1]], K[:2, 2], size
    middle = (width - 1) / 2, (height - 1) / 2
    candidates = {
        "the order is fx cx fy cy": intrinsics(fx, cx, fy, cy),
        "cx and cy are exchanged": intrinsics(fx, fy, cy, cx),
    }
    # scale to this image from the image whose middle the principal point is
    across, down = width / max(2 * cx + 1, 1e-9), height / max(2 * cy + 1, 1e-9)
    # sizes keep their proportions, or the focal lengths show that they do not
    if _ratio(across, down) < ALIKE or _ratio(fx * across, fy * down) < ALIKE:
        other = f"intrinsics of an image of {2 * cx + 1:.0f} x {2 * cy + 1:.0f}"
        candidates[other] = intrinsics(fx * across, fy * down, *middle)
    for cause, fits in candidates.items():
        near = _off_middle(fits[0, 2], fits[1, 2], size) < 2 * NEAR_MIDDLE
        if near and fits.diagonal().min() > 0 and not _problems(fits, size, False):
            return cause, fits
    return "a crop, or a wrong file", intrinsics(fx, fx if _ratio(fx, fy) > UNEVEN else fy, *middle)
