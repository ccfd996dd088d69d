"""The page of a comparison of solvers: conclusion, tables, limits."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from soup_nlp.bench.solvers.profiles import cost_table, problem_key
from soup_nlp.bench.tables import code_versions, columns, page_text, show, table

Row = Mapping[str, Any]

FEASIBLE = 1e-5
"""Largest violation of a feasible point."""
LIMITS = (
    "Times are CPU times of one run each, set-up included, on the machine named; so is the limit.",
    "The presolve's answer is almost optimal: energies hardly move, and the comparison is of how "
    "quickly a solver proves it. From the proposal it is harder.",
    "Local solvers end in local minima: an energy says where this start led, not what is best.",
    "Residuals are unscaled and may be ten times the tolerance, as every solver scales its own.",
    "Options are those of `soup_nlp/bench/solvers/plugins.py`, the package's own ones being tuned "
    "on such problems. alpaqa and sleqp differentiate an expanded graph, which costs set-up time.",
    "lm, the reference solver on the manifold, claims no optimum; its rows are for the energy.",
    "SCIP is a global solver: here it shows what its time limit allows from the same start.",
)


def page(rows: Sequence[Row], each: bool = True) -> str:
    """Markdown page of all rows; `each` adds lines on each problem to the conclusion."""
    machine = sorted({str(r["machine"]) for r in rows})
    packages = sorted({f"{k} {v}" for r in rows for k, v in r["versions"].items()})
    note = (
        "Verified: the solver claims an optimum, and the KKT residuals and the exact energy,"
        " recomputed from its point, agree."
    )
    details = [*machine, ", ".join(packages), f"code {code_versions([dict(r) for r in rows])}"]
    pictures = ["![performance profiles](profile.png)", "", "![energy against time](curves.png)"]
    lines = ["# Solvers on the Superpixel Soup NLP", "", *conclusion(rows, each), "", *pictures]
    for title, body in {
        "By solver": [note, "", *by_solver(rows)],
        "By run": by_run(rows),
        "Limits": [f"- {text}" for text in (_limits(rows), *LIMITS)],
        "Machine and versions": [f"- {text}" for text in details],
    }.items():
        lines += ["", f"## {title}", "", *body]
    return page_text(lines)


def _limits(rows: Sequence[Row]) -> str:
    """Sentence on the limits of the runs, whose time limits may differ."""
    own = rows[0]["limits"]
    seconds = " or ".join(f"{s:g}" for s in sorted({r["limits"]["seconds"] for r in rows}))
    return (
        f"A run has {seconds} CPU seconds, {own['iterations']} iterations and"
        f" {own['memory'] / 2**30:g} GiB, and is asked for a dual infeasibility of {own['tol']:g}."
    )


def conclusion(rows: Sequence[Row], each: bool = True) -> list[str]:
    """Conclusion in sentences; `each` adds lines on each problem."""
    problems, solvers, time = cost_table(rows, "time")
    _, _, energy = cost_table(rows, "energy")
    solved = np.isfinite(time).sum(axis=0)
    some = [s for s, n in zip(solvers, solved) if n]
    out = [
        f"**{len(problems)} problems, {len(solvers)} solvers, {len(rows)} runs:"
        f" {sum(bool(r['verified']) for r in rows)} verified, by {len(some)} solvers"
        f" ({', '.join(some) or 'none'}).**"
    ]
    if some:
        best = [s for s, n in zip(solvers, solved) if n == solved.max()]
        out[0] += f" Most problems ({solved.max()}): {', '.join(best)}."
    for k, problem in enumerate(problems if each else ()):
        energies = [
            (float(r["energy"]), str(r["solver"]), float(r["seconds"]))
            for r in rows
            if problem_key(r) == problem and _feasible(r)
        ]
        if energies:
            value, who, when = min(energies)
            out.append(
                f"- {problem}: lowest exact energy of any run {value:.6g} by {who} ({when:.1f} s)."
            )
        if not np.isfinite(time[k]).any():
            out.append(f"- {problem}: none is verified.")
            continue
        quick, low = int(time[k].argmin()), int(energy[k].argmin())
        out.append(
            f"- {problem}: quickest {solvers[quick]}"
            f" ({time[k, quick]:.2f} s, E {energy[k, quick]:.6g}); lowest energy"
            f" {solvers[low]} (E {energy[k, low]:.6g} in {time[k, low]:.2f} s)."
        )
    claims = [r for r in rows if r["claimed"]]
    if claims:
        false = sorted({str(r["solver"]) for r in claims if not r["verified"]})
        true = sum(bool(r["verified"]) for r in claims)
        more = f"; not always those of {', '.join(false)}" if false else ""
        out.append(f"- Claims of an optimum that were true: {true} of {len(claims)}{more}.")
    return out


def _feasible(row: Row) -> bool:
    """Whether the point of a row is feasible and has an energy."""
    primal = row.get("primal")
    return row.get("energy") is not None and primal is not None and primal <= FEASIBLE


def by_solver(rows: Sequence[Row]) -> list[str]:
    """Table of the numbers of runs, claims and verified claims of each solver."""
    lines = []
    for solver in sorted({str(r["solver"]) for r in rows}):
        here = [r for r in rows if r["solver"] == solver]
        claimed, verified = (sum(bool(r[k]) for r in here) for k in ("claimed", "verified"))
        share = f"{verified} of {claimed}" if claimed else "-"
        other = "; ".join(sorted({_status(r) for r in here if not r["claimed"]}))
        lines.append([solver, str(len(here)), str(claimed), str(verified), share, other])
    head = ["solver", "runs", "claimed", "verified", "claims that were true", "ended otherwise"]
    return table(head, lines)


CELLS: dict[str, Callable[[Row], str]] = {
    "problem": lambda r: str(r["problem"]),
    "N": lambda r: str(r["superpixels"]),
    "formulation": lambda r: str(r["formulation"]),
    "solver": lambda r: str(r["solver"]),
    "verified": lambda r: "yes" if r["verified"] else "claimed" if r["claimed"] else "no",
    "exact E": lambda r: show(r.get("energy"), ".6g"),
    "start E": lambda r: show(r.get("energy_start"), ".6g"),
    "primal": lambda r: show(r.get("primal"), ".0e"),
    "dual": lambda r: show(r.get("dual"), ".0e"),
    "compl.": lambda r: show(r.get("complementarity"), ".0e"),
    "iterations": lambda r: str(r["iterations"]) if r["iterations"] >= 0 else "-",
    "seconds": lambda r: show(r.get("seconds"), ".2f"),
    "MB": lambda r: str(r["peak_bytes"] >> 20) if r["peak_bytes"] else "-",
    "status": lambda r: _status(r),
}


def by_run(rows: Sequence[Row]) -> list[str]:
    """Table of every run."""
    order = sorted(rows, key=lambda r: (problem_key(r), not r["verified"], r["seconds"]))
    return columns(CELLS, order)


def _status(row: Row) -> str:
    return " ".join(str(row["status"])[:50].replace("|", "/").split())
