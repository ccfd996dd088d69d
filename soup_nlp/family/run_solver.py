"""Run a solver on the SOUP problem set: python run.py SOLVER [--seconds S] [WORD ...].

SOLVER is a program of AMPL's convention with its options, such as "ipopt mu_strategy=adaptive"; it
is called as `SOLVER NAME -AMPL OPTIONS` and has to write NAME.sol. A word selects instances whose
names contain it. Needs Python with casadi and numpy, which read the .nl files; not soup_nlp.

A line per instance, by the point and the multipliers that the solver wrote:
  converged   it claims an optimum, the point is one, and is as low as the best known one
  differs     it claims an optimum, the point is stationary, and is higher: another local minimum
  WRONG       it claims an optimum, and the point violates a constraint or is not stationary
  stopped     it claims none, or wrote no point: a limit, a failure
"""

from __future__ import annotations

import argparse
import csv
import shlex
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np

FEASIBLE, STATIONARY = 1e-6, 1e-3
"""Largest violation, and largest dual infeasibility or complementarity, of an optimum; unscaled."""
WORDS = ("converged", "differs", "WRONG", "stopped")


@dataclass(frozen=True)
class Point:
    """Contents of a .sol file: message, solve_result_num, multipliers (may be none), variables."""

    message: str
    code: int
    y: np.ndarray
    x: np.ndarray


def read_point(path: Path) -> Point | None:
    """The point of a .sol file; None if there is none."""
    if not path.is_file():
        return None
    lines = path.read_text(errors="replace").splitlines()
    at = lines.index("Options") + 1 if "Options" in lines else len(lines)
    try:
        count = int(lines[at])
        # a count above 4 announces a tolerance, which follows the sizes
        tolerance = count > 4
        at += 1 + count - 2 * tolerance
        _, duals, _, values = (int(v) for v in lines[at : at + 4])
        at += 4 + tolerance
        y, x = (np.array(v, float) for v in (lines[at : at + duals], lines[at + duals :][:values]))
        code = next((int(s.split()[2]) for s in lines if s.startswith("objno")), -1)
    except (ValueError, IndexError):
        return None
    return Point(next(filter(None, lines), ""), code, y, x) if len(x) else None


def judge(model: Path, point: Point) -> tuple[float, float, float]:
    """Objective, largest violation, and dual infeasibility of a point (nan without multipliers)."""
    nl = ca.NlpBuilder()
    nl.import_nl(str(model), {})
    x, g = ca.vertcat(*nl.x), ca.densify(ca.vertcat(*nl.g))
    values = ca.Function("v", [x], [nl.f, g, ca.gradient(nl.f, x), ca.jacobian(g, x)])(point.x)
    f, rows, slope = (np.array(v, float).ravel() for v in values[:3])
    low, high, above, below = (np.array(b) for b in (nl.x_lb, nl.x_ub, nl.g_lb, nl.g_ub))
    off = [low - point.x, point.x - high, above - rows, rows - below]
    violation = max(float(v.max(initial=0.0)) for v in off)
    if not len(point.y):
        return float(f[0]), violation, float("nan")
    rest = slope - np.array(values[3].T @ point.y).ravel()
    room = np.where(rest > 0, point.x - low, high - point.x)
    loose = np.where(point.y > 0, rows - above, below - rows)
    # at a bound the rest of the gradient is its multiplier
    dual = np.minimum(np.abs(rest), np.maximum(room, 0.0)).max(initial=0.0)
    wrong = np.minimum(np.abs(point.y), np.maximum(loose, 0.0)).max(initial=0.0)
    return float(f[0]), violation, float(max(dual, wrong))


def verdict(
    point: Point | None, f: float, violation: float, dual: float, best: float, near: float
) -> str:
    """One of WORDS."""
    if point is None or not 0 <= point.code < 100:
        return "stopped"
    if not violation <= FEASIBLE or dual > STATIONARY or not np.isfinite(f):
        return "WRONG"
    return "converged" if f <= best + near * abs(best) else "differs"


def run(solver: str, folder: Path, row: dict[str, str], seconds: float) -> str:
    """Run the solver on an instance, print its line and return its verdict."""
    model = folder / row["file"]
    path = model.with_suffix(".sol")
    path.unlink(missing_ok=True)
    program, *options = shlex.split(solver)
    print(f"{row['name']} ...", end="\r", file=sys.stderr, flush=True)
    begin = time.perf_counter()
    try:
        command = [program, model.stem, "-AMPL", *options]
        subprocess.run(command, cwd=folder, timeout=seconds, capture_output=True, check=False)
    except subprocess.TimeoutExpired:
        path.unlink(missing_ok=True)
    spent = time.perf_counter() - begin
    point, best = read_point(path), float(row["primalbound"])
    f = violation = dual = float("nan")
    if point is not None:
        f, violation, dual = judge(model, point)
    word = verdict(point, f, violation, dual, best, float(row["primaltolerance"]))
    print(
        f"{row['name']:<24} {word:<9} f {f:>12.8g}  best {best:>12.8g}  violation {violation:.0e}"
        f"  dual {dual:.0e}  {spent:7.1f} s  {point.message[:50] if point else 'no point'}",
        flush=True,
    )
    return word


def main(words: list[str] | None = None) -> int:
    """Exit code 1 where an answer is wrong."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("solver", help="program and options, in quotes")
    parser.add_argument("words", nargs="*")
    parser.add_argument("--seconds", type=float, default=60.0, help="wall time of an instance")
    parser.add_argument("--folder", type=Path, default=Path(__file__).parent)
    o = parser.parse_args(words)
    with (o.folder / "instancedata.csv").open(newline="") as file:
        rows = list(csv.DictReader(file, delimiter=";"))
    rows = [r for r in rows if all(w in f"{r['name']} {r['file']}" for w in o.words)]
    verdicts = [run(o.solver, o.folder, row, o.seconds) for row in rows]
    print(f"{o.solver}: " + ", ".join(f"{verdicts.count(w)} {w}" for w in WORDS))
    return int("WRONG" in verdicts)


if __name__ == "__main__":
    sys.exit(main())
