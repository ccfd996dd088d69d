"""The gate: ratios of a measurement against a committed baseline, never seconds."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from soup_nlp.bench.rows import failed
from soup_nlp.bench.speed import Spec
from soup_nlp.errors import DataError

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

VERSION = 2


@dataclass(frozen=True)
class Finding:
    """One value of one run against the baseline.

    Attributes:
        key: Of the run.
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
    total = float(record["energy"]["total"])
    out = {
        "iterations": float(record["iterations"]),
        "energy": total,
        "nonzeros": float(
            record["sizes"]["hessian_nonzeros"] + record["sizes"]["jacobian_nonzeros"]
        ),
        "converged": float(record["converged"]),
    }
    reference = record["reference"].get("same")
    if reference:
        out["energy_to_reference"] = total / reference["energy"]["total"]
        out["time_to_reference"] = record["cpu"]["nlp"] / reference["cpu_seconds"]
    return out


def baseline(records: Sequence[Row], machine: Mapping[str, str]) -> dict[str, Any]:
    """What is committed.

    Raises:
        DataError: a run failed, so it cannot be a baseline.
    """
    bad = [r["key"] for r in records if failed(r)]
    if bad or not records:
        raise DataError("no baseline of runs that failed", found=", ".join(bad) or "no run")
    return {
        "version": VERSION,
        "machine": dict(machine),
        "runs": [{"spec": r["spec"], "values": values(r)} for r in records],
    }


def read_baseline(path: Path) -> tuple[list[Spec], dict[str, dict[str, float]]]:
    """Runs of a baseline and their values by key.

    Raises:
        DataError: the file is missing or no baseline.
    """
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
        if tree["version"] != VERSION:
            raise ValueError(f"version {tree['version']}")
        specs = [Spec.from_dict(run["spec"]) for run in tree["runs"]]
        kept = {s.key: dict(run["values"]) for s, run in zip(specs, tree["runs"])}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            "not a baseline of bench speed",
            where=path,
            found=error,
            expected=f"JSON of version {VERSION}",
            hint="soup-nlp bench speed --quick --write-baseline FILE",
        ) from error
    return specs, kept


def check(records: Sequence[Row], kept: Mapping[str, Mapping[str, float]]) -> list[Finding]:
    """Every value of every run of the baseline; a run that failed or is missing fails the gate."""
    by_key = {r["key"]: r for r in records}
    out = []
    for key, old in kept.items():
        record = by_key.get(key)
        if record is None or failed(record):
            out.append(Finding(key, "run", 1.0, 0.0, False))
            continue
        new = values(record)
        for name, (factor, addition) in LIMITS.items():
            if name in old:
                value = new.get(name, float("inf"))
                out.append(
                    Finding(key, name, old[name], value, value <= factor * old[name] + addition)
                )
        both = old["converged"], new["converged"]
        out.append(Finding(key, "converged", *both, both[1] >= both[0]))
    return out
