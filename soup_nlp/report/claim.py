"""A claim of a result folder with the result of its check."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

RELATIVE = 1e-9
ABSOLUTE = 1e-12
RECOMPUTED, HASHED = "recomputed", "as written"
"""How a claim is checked: from the arrays, or against hashes and copies in result.h5."""


@dataclass(frozen=True)
class Claim:
    """One claim of a result folder.

    Attributes:
        name: Subject of the claim.
        claimed: Value in summary.json.
        found: Value recomputed from the arrays.
        limit: Largest allowed value (constraints) or relative difference (numbers).
        ok: Whether the claim holds.
        worst: Superpixel with the largest residual, -1 if there is none.
        note: Explanation.
        how: RECOMPUTED or HASHED.
    """

    name: str
    claimed: float
    found: float
    limit: float
    ok: bool
    worst: int = -1
    note: str = ""
    how: str = RECOMPUTED

    def __str__(self) -> str:
        where = f"  superpixel {self.worst}" if self.worst >= 0 else ""
        return (
            f"{'ok  ' if self.ok else 'FAIL'} {self.name:<34} {self.claimed:>13.6g}"
            f" {self.found:>13.6g} {self.limit:>9.1e}  {self.how}{where}"
            f"{'  ' if self.note else ''}{self.note}"
        )


def number(value: Any) -> float:
    """A claim as a number; null in JSON stands for a number that is not finite."""
    return float("nan") if value is None else float(value)


def same(
    name: str, claimed: Any, found: float, of: float = 0.0, absolute: float = ABSOLUTE
) -> Claim:
    """Claim that must equal `found` up to rounding of it or the sum `of`, or up to `absolute`."""
    value = number(claimed)
    gap = abs(value - found)
    ok = gap <= RELATIVE * max(abs(found), abs(of)) + absolute or (
        np.isnan(value) and np.isnan(found)
    )
    return Claim(name, value, float(found), RELATIVE, bool(ok))
