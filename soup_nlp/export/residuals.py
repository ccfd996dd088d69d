"""Constraints by kind: largest violation, number of violations, and the worst superpixels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.evaluate import recompute

WORST = 3
"""Number of superpixels that are listed for a kind."""
EQUATIONS: Mapping[str, str] = {
    "so3": "R'R = I",
    "normal": "|n|^2 = 1",
    "simplex": "sum lam = 1",
    "positive": "lam, d > 0",
    "det": "det R = 1",
    "visible": "-n . r >= c",
    "bounds": "lbx <= x <= ubx",
    "rows": "lbg <= g <= ubg",
}


@dataclass(frozen=True)
class Kind:
    """One kind of constraint.

    Attributes:
        name: Name in EQUATIONS.
        largest: Largest violation.
        limit: Largest allowed violation.
        count: Number of superpixels (or entries) beyond the limit.
        total: Number of superpixels (or entries).
        worst: (superpixel, violation), worst first; empty if entries are not superpixels.
    """

    name: str
    largest: float
    limit: float
    count: int
    total: int
    worst: tuple[tuple[int, float], ...]

    @property
    def ok(self) -> bool:
        """Whether the largest violation is within the limit; False for NaN."""
        return bool(self.largest <= self.limit)

    def __str__(self) -> str:
        who = "  ".join(f"{i} ({v:.1e})" for i, v in self.worst)
        return (
            f"{'ok  ' if self.ok else 'FAIL'} {self.name:<9} {EQUATIONS[self.name]:<17}"
            f"{self.largest:>9.1e} {self.limit:>9.1e} {self.count:>6} of {self.total:<6} {who}"
        )


def kind(name: str, violation: Float, limit: float, superpixels: bool = True) -> Kind:
    """Summary of nonnegative violations (M,)."""
    # NaN counts as an infinite violation
    v = np.where(np.isfinite(violation), violation, np.inf)
    order = np.argsort(-v, kind="stable")[:WORST]
    worst = tuple((int(k), float(v[k])) for k in order if v[k] > 0) if superpixels else ()
    largest = float(v.max(initial=0.0))
    return Kind(name, largest, limit, int((v > limit).sum()), len(v), worst)


def residual_table(
    state: Mapping[str, Any], rim_ray: Float, min_facing: float, limits: Mapping[str, float]
) -> list[Kind]:
    """Residuals of a soup by kind of constraint, recomputed from its arrays.

    Args:
        state: lam, n, d, R, t.
        rim_ray: (N, V, 3) rays of the visibility constraint.
        min_facing: c of `-n . r >= c`.
        limits: Largest violation by kind.
    """
    found = recompute.constraints(state, rim_ray, min_facing)
    return [kind(k, v, limits[k], superpixels=k != "simplex") for k, v in found.items()]


def table_text(rows: list[Kind]) -> str:
    """The table with its header."""
    head = (
        f"     {'kind':<9} {'equation':<17}{'largest':>9} {'limit':>9} {'beyond':>9}"
        f"{'':<8}worst superpixels"
    )
    return "\n".join([head, *map(str, rows)])
