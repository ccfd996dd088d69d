"""The gate: ratios of a measurement against a committed baseline, never seconds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from soup_nlp.bench.rows import failed
from soup_nlp.errors import DataError
from soup_nlp.storage.files import read_json

Row = Mapping[str, Any]

LIMITS: dict[str, tuple[float, float]] = {
    "iterations": (1.3, 3.0),
    "energy": (1.005, 0.0),
    "energy_to_reference": (1.005, 0.0),
    "nonzeros": (1.01, 0.0),
    "time_to_reference": (1.5, 0.0),
}
"""Allowed (factor, addition) of the baseline's value: a value above factor x old + addition fails.
Rounding differs between machines, so iterations and energies have room; seconds are compared with
the reference solver's in the same process, which a slower machine slows down alike."""
VERSION = 3


class Run(NamedTuple):
    """A run of the baseline: its settings and its values by name."""

    settings: dict[str, Any]
    values: dict[str, float]


class Finding(NamedTuple):
    """One value of one run against the baseline.

    Attributes:
        key: Settings of the run.
        name: Of LIMITS, or "converged", "run".
        old: Baseline's value.
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
    """What the gate looks at."""
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
    """What is committed.

    Raises:
        DataError: a run failed, so it cannot be a baseline.
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
    """Every value of every run of the baseline; a run that failed or is missing fails the gate."""
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
