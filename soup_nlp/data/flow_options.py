"""What OpenCV's DIS flow and its forward-backward check can be told."""

from __future__ import annotations

from collections.abc import Mapping
from numbers import Integral, Real

import cv2
import numpy as np

from soup_nlp.errors import DataError

PRESETS = {
    "ultrafast": cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST,
    "fast": cv2.DISOPTICAL_FLOW_PRESET_FAST,
    "medium": cv2.DISOPTICAL_FLOW_PRESET_MEDIUM,
}
RANGES: Mapping[str, tuple[int, int]] = {
    "finest_scale": (0, 5),
    "patch_size": (4, 32),
    "patch_stride": (1, 32),
    "planes": (0, 20),
}
"""Smallest and largest value of whole-number options."""
_TINY, _HUGE = float(np.nextafter(0, 1)), float(np.finfo(np.float32).max)
# smallest, largest, whole number, in words; OpenCV's own parameters are int and float32
_CHECKS: Mapping[str, tuple[float, float, bool, str]] = {
    "finest_scale": (*RANGES["finest_scale"], True, "a whole number, 0 to 5"),
    "patch_size": (*RANGES["patch_size"], True, "4 to 32 pixels, whole"),
    "patch_stride": (*RANGES["patch_stride"], True, "1 to patch_size, whole"),
    "refinement_iterations": (0, 10_000, True, "a whole number, 0 to 10000"),
    "alpha": (0, _HUGE, False, "a finite number, at least 0"),
    "delta": (0, _HUGE, False, "a finite number, at least 0"),
    "gamma": (0, _HUGE, False, "a finite number, at least 0"),
    "tau": (_TINY, np.inf, False, "a positive number of pixels"),
    "limit": (_TINY, _HUGE, False, "a positive, finite number of pixels"),
    "support": (1, 10_001, True, "an odd number of pixels"),
    "planes": (*RANGES["planes"], True, "a whole number, 0 to 20"),
}


def check_dis_options(options: Mapping[str, object]) -> None:
    """Raise DataError for an option that OpenCV would not survive or the check cannot use.

    Args:
        options: By name, as given to `dis_flow`.

    Raises:
        DataError: one is out of range, not finite, or no whole number where one is needed.
    """
    preset, size, stride, window = (
        options[k] for k in ("preset", "patch_size", "patch_stride", "support")
    )
    if preset not in PRESETS:
        raise _refused("preset", preset, ", ".join(PRESETS))
    for name, (low, high, whole, expected) in _CHECKS.items():
        value = options[name]
        number = isinstance(value, Integral if whole else Real) and not isinstance(value, bool)
        # NaN is in no range
        if not (number and low <= value <= high):  # type: ignore[operator]
            raise _refused(name, value, expected)
    if stride > size:  # type: ignore[operator]
        raise _refused("patch_stride", stride, "1 to patch_size")
    if window % 2 == 0:  # type: ignore[operator]
        raise _refused("support", window, "an odd number of pixels")


def _refused(name: str, value: object, expected: str) -> DataError:
    return DataError("DIS option is out of range", where=name, found=value, expected=expected)
