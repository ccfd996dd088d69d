"""How costs grow: exponents of power laws fitted over the number of superpixels."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from soup_nlp.bench.rows import failed

Row = Mapping[str, Any]
Cell = Callable[[Row], str]

COSTS: dict[str, Callable[[Row], float]] = {
    "NLP, CPU s": lambda r: r["cpu"]["nlp"],
    "CPU s an iteration": lambda r: r["cpu"]["nlp"] / max(1, r["iterations"]),
    "functions, s": lambda r: r["wall"]["functions"],
    "linear algebra, s": lambda r: r["wall"]["linear algebra"],
    "outside the NLP, CPU s": lambda r: outside(r),
    "Hessian nonzeros": lambda r: r["sizes"]["hessian_nonzeros"],
    "peak memory": lambda r: r["peak_bytes"],
}
"""What growth is fitted of."""

ALL = "all"
"""Name of all scenes together, with one exponent and a factor for each."""

OUTSIDE = ("flow", "segmentation", "start", "weights", "evaluation", "output")
"""Stages that are not Ipopt's and not the loading or rendering of frames."""


def outside(record: Row) -> float:
    """CPU seconds of every stage but loading and the NLP."""
    return float(sum(record["cpu"].get(stage, 0.0) for stage in OUTSIDE))


@dataclass(frozen=True)
class Growth:
    """cost = factor N^exponent.

    Attributes:
        exponent: Slope of log cost over log N.
        error: Standard error of the slope; NaN for two points.
        low: Smallest N.
        high: Largest N.
        count: Runs.
    """

    exponent: float
    error: float
    low: float
    high: float
    count: int

    def __str__(self) -> str:
        error = "" if np.isnan(self.error) else f" ± {self.error:.2f}"
        return f"{self.exponent:.2f}{error}"


def fit(
    sizes: Sequence[float], costs: Sequence[float], scenes: Sequence[str] | None = None
) -> Growth | None:
    """Least squares of log cost over log N; None with fewer than two different sizes.

    Args:
        sizes: N of every run.
        costs: Positive cost of every run.
        scenes: Scene of every run: one exponent for all, a factor for each. None: all are one.
    """
    n, c = np.asarray(sizes, float), np.asarray(costs, float)
    use = (n > 0) & (c > 0)
    x, y = np.log(n[use]), np.log(c[use])
    if len(x) < 2:
        return None
    names, scene = np.unique(np.asarray(scenes or [""] * len(n))[use], return_inverse=True)
    count = np.bincount(scene)
    dx = x - (np.bincount(scene, x) / count)[scene]
    dy = y - (np.bincount(scene, y) / count)[scene]
    # actual numbers of superpixels differ a little between seeds of one size
    if np.ptp(dx) < 0.2:
        return None
    slope = float(dx @ dy / (dx @ dx))
    rest = dy - slope * dx
    free = len(x) - len(names) - 1
    error = float(np.sqrt(rest @ rest / free / (dx @ dx))) if free else np.nan
    return Growth(slope, error, float(n[use].min()), float(n[use].max()), len(x))


def growth(records: Sequence[Row], least: int = 0) -> dict[tuple[str, int], dict[str, Growth]]:
    """Growth of every cost by scene and K, seeds together, and of all scenes (ALL) where several.

    Args:
        records: Measured runs.
        least: Leave out runs with fewer wanted superpixels than this.
    """
    groups: dict[tuple[str, int], list[Row]] = defaultdict(list)
    for record in records:
        if not failed(record) and record["spec"]["superpixels"] >= least:
            groups[record["spec"]["scene"], record["spec"]["neighbours"]].append(record)
    for k in sorted({k for _, k in groups}):
        own = [group for (_, other), group in groups.items() if other == k]
        if len(own) > 1:
            groups[ALL, k] = [record for group in own for record in group]
    out = {}
    for key, group in groups.items():
        runs = [r["sizes"]["superpixels"] for r in group], [r["spec"]["scene"] for r in group]
        fits = {
            name: fit(runs[0], [cost(r) for r in group], runs[1]) for name, cost in COSTS.items()
        }
        found = {name: f for name, f in fits.items() if f is not None}
        if found:
            out[key] = found
    return out
