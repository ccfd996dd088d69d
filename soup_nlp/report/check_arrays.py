"""Checks of shapes, types and indices of the arrays of a result before they are used."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from soup_nlp.errors import DataError
from soup_nlp.report.tree import LAYOUT, Table

INDICES = {
    "segmentation/labels": "N",
    "segmentation/knn": "N",
    "energy/edges": "N",
    "energy/pairs": "N",
}
"""Arrays of indices with the letter of the axis that they index."""
SHARED = ("N", "E", "P", "H", "W")
"""Axes with one size in all arrays: superpixels, edges, pairs, rows and columns."""
FREE = ("depth/next", "depth/sigma_next", "input/image_next", "truth/depth_next")
"""Maps of the next frame, whose size may differ."""


def require_layout(tree: Mapping[str, Any]) -> None:
    """Check every stored array against its axes.

    Raises:
        DataError: an array has a wrong shape, no numbers, or indices out of range.
    """
    sizes: dict[str, int] = {}
    for group, table in LAYOUT.items():
        values = tree.get(group, {})
        if not isinstance(values, Mapping):
            raise _wrong(group, "an array", "a group")
        _require_shapes(group, table, values, sizes)
    for place, letter in INDICES.items():
        group, name = place.split("/")
        found = tree.get(group, {}).get(name)
        if found is None:
            continue
        top = sizes.get(letter, 0)
        if found.dtype.kind not in "iu" or (
            found.size and not 0 <= found.min() <= found.max() < top
        ):
            raise _wrong(place, "other values", f"whole numbers from 0 to {top - 1}")


def _require_shapes(
    group: str, table: Table, values: Mapping[str, Any], sizes: dict[str, int]
) -> None:
    """Check the shapes of a group; `sizes` collects the sizes of the shared axes."""
    for name, (_, letters, _) in table.items():
        place, value = f"{group}/{name}", values.get(name)
        if value is None:
            continue
        if isinstance(value, Mapping) or value.dtype.kind not in "biuf":
            raise _wrong(place, "a group or text", "numbers")
        if name.startswith("image_") and value.dtype != np.uint8:
            raise _wrong(place, value.dtype, "uint8")
        axes = letters.split(",") if letters else []
        if len(axes) != value.ndim:
            raise _wrong(place, value.shape, f"axes ({letters})")
        for axis, size in zip(axes, value.shape, strict=True):
            expected = int(axis) if axis.isdigit() else size
            if axis in SHARED and place not in FREE:
                expected = sizes.setdefault(axis, size)
            if size != expected or (axis in ("H", "W") and not size):
                raise _wrong(place, value.shape, f"({letters}) with {axis} = {expected}")


def _wrong(place: str, found: object, expected: str) -> DataError:
    return DataError(
        "array of a result does not fit the others",
        where=f"result.h5, {place}",
        found=found,
        expected=expected,
    )
