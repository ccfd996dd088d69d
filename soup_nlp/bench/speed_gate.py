"""Regression gate of `bench speed`: ratios of a measurement to a committed baseline."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from soup_nlp.errors import DataError
from soup_nlp.storage.files import read_json
from soup_nlp.storage.rows import failed

Row = Mapping[str, Any]

LIMITS: dict[str, tuple[float, float]] = {
    "iterations": (1.3, 3.0),
    "energy": (1.005, 0.0),
    "energy_to_reference": (1.005, 0.0),
    "nonzeros": (1.01, 0.0),
    "time_to_reference": (1.5, 0.0),
}
"""(factor, addition) by name of a value: a value above factor x baseline + addition fails.
Iterations and energies may change a little, since rounding differs between machines. Times are
compared relative to the reference solver in the same process, so that the machine cancels out."""
VERSION = 3


class Run(NamedTuple):
    """A run of the baseline: settings, and values by name."""

    settings: dict[str, Any]
    values: dict[str, float]


class Finding(NamedTuple):
    """One value of one run against the baseline.

    Attributes:
        key: Settings of the run.
        name: Name in LIMITS, or "converged" or "run".
        old: Value of the baseline.
        new: Measured value.
        ok: Whether it is within its limit.
    """

    key: str
    name: str
    old: float
    new: float
    ok: bool

    def __str__(self) -> str:
        ratio = f"{self.new / self.old:.3f} x" if self.old else "-"
        word = "ok" if self.ok else "WORSE"
        return f"{word:<6} {self.key}  {self.name} {self.old:.6g} -> {self.new:.6g} ({ratio})"


def values(record: Row) -> dict[str, float]:
    """The values of a run that the gate compares."""
    sizes, reference, total = record["sizes"], record["reference"], record["energy"]["total"]
    return {
        "iterations": float(record["iterations"]),
        "energy": total,
        "nonzeros": float(sizes["hessian_nonzeros"] + sizes["jacobian_nonzeros"]),
        "converged": float(record["converged"]),
        "energy_to_reference": total / reference["energy"]["total"],
        "time_to_reference": record["cpu"]["nlp"] / reference["cpu_seconds"],
    }


def baseline(records: Sequence[Row], machine: Mapping[str, str]) -> dict[str, Any]:
    """Contents of a baseline file.

    Raises:
        DataError: a run failed, or there is none.
    """
    bad = [r["key"] for r in records if failed(r)]
    if bad or not records:
        raise DataError("no baseline of runs that failed", found=", ".join(bad) or "no run")
    runs = [{"settings": r["settings"], "values": values(r)} for r in records]
    return {"version": VERSION, "machine": dict(machine), "runs": runs}


def read_baseline(path: Path) -> list[Run]:
    """Runs of a baseline.

    Raises:
        DataError: the file is missing or no baseline.
    """
    try:
        tree = read_json(path, "baseline")
        if tree["version"] != VERSION:
            raise ValueError(f"version {tree['version']}")
        return [Run(dict(run["settings"]), dict(run["values"])) for run in tree["runs"]]
    except (DataError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            "not a baseline of bench speed",
            where=path,
            found=error,
            expected=f"JSON of version {VERSION}",
            hint="soup-nlp bench speed --scenes street --superpixels 250 --write-baseline FILE",
        ) from error


def check(records: Sequence[Row], kept: Sequence[Run]) -> Iterator[Finding]:
    """Findings on every run of the baseline; a failed or missing run gives one that is not ok."""
    for settings, old in kept:
        key = " ".join(str(v) for v in settings.values() if v != [])
        own = [r for r in records if r["settings"] == settings and not failed(r)]
        if not own:
            yield Finding(key, "run", 1.0, 0.0, False)
            continue
        new = values(own[-1])
        for name, (factor, addition) in LIMITS.items():
            good = new[name] <= factor * old[name] + addition
            yield Finding(key, name, old[name], new[name], good)
        both = old["converged"], new["converged"]
        yield Finding(key, "converged", *both, both[1] >= both[0])
