"""The comparison as a page: conclusion first, tables, limits last."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from soup_nlp.bench.solvers.profiles import cost_table, problem_key, problem_names

Row = Mapping[str, Any]

FEASIBLE = 1e-5
"""Largest violation of a point whose energy counts."""
LIMITS = (
    "Times are wall times of one run each, set-up included, on the machine named; where it was "
    "shared with other work, CPU seconds stand beside them.",
    "From the presolve's answer little is left to do: energies hardly move, what is compared is "
    "how quickly a solver proves a point that is almost optimal. From the proposal it is harder.",
    "Local solvers end in local minima: an energy says where this start led, not what is best.",
    "Residuals are unscaled and may be ten times the tolerance, as every solver scales its own.",
    "Solvers run with the options in `soup_nlp/compare/plugins.py`, the package's own ones being "
    "tuned on problems of this kind; the others are as they come, but for tolerances and limits.",
    "alpaqa and sleqp differentiate an expanded expression graph, which costs set-up time; "
    "every other plug-in gets this package's own derivatives, and readers of .nl make theirs.",
    "lm and lbfgs, the yardsticks on the manifold, end where the energy stops falling and claim "
    "no optimum; their rows are for the energy.",
    "SCIP is a global solver: here it shows what its time limit allows from the same start.",
)


def page(rows: Sequence[Row]) -> str:
    """Markdown of all rows."""
    machine = sorted({str(r["machine"]) for r in rows})
    packages = sorted({f"{k} {v}" for r in rows for k, v in r["versions"].items()})
    lines = [
        "# Solvers on the Superpixel Soup NLP",
        "",
        *conclusion(rows),
        "",
        "![performance profiles](profile.png)",
        "",
        "![energy against time](curves.png)",
        "",
        "## By solver",
        "",
        "Verified: the solver claims an optimum, and the KKT residuals and the exact energy,"
        " recomputed from its point, agree.",
        "",
        *by_solver(rows),
        "",
        "## By run",
        "",
        *by_run(rows),
        "",
        "## Limits",
        "",
        *(f"- {text}" for text in LIMITS),
        "",
        "## Machine and versions",
        "",
        *(f"- {m}" for m in machine),
        f"- {', '.join(packages)}",
        f"- code {', '.join(sorted({str(r['code']) for r in rows}))}",
        "",
    ]
    return "\n".join(lines)


def conclusion(rows: Sequence[Row]) -> list[str]:
    """What the rows say, in sentences."""
    problems, solvers, time = cost_table(rows, "time")
    _, _, energy = cost_table(rows, "energy")
    solved = np.isfinite(time).sum(axis=0)
    best = [s for s, n in zip(solvers, solved) if n and n == solved.max()]
    some = [s for s, n in zip(solvers, solved) if n]
    out = [
        f"**{len(problems)} problems, {len(solvers)} solvers, {len(rows)} runs:"
        f" {sum(bool(r['verified']) for r in rows)} verified, by {len(some)} solvers"
        f" ({', '.join(some) or 'none'}).**"
    ]
    if best:
        out[0] += f" Most problems ({solved.max()}): {', '.join(best)}."
    names = problem_names(rows)
    for k, problem in enumerate(problems):
        head = f"- {names[problem]}, N = {problem.superpixels}, {problem.formulation}:"
        energies = [
            (float(r["energy"]), str(r["solver"]), float(r["seconds"]))
            for r in rows
            if problem_key(r) == problem and _feasible(r)
        ]
        if energies:
            value, who, when = min(energies)
            out.append(
                f"{head} lowest exact energy of any run {value:.6g} by {who} ({when:.1f} s)."
            )
        if not np.isfinite(time[k]).any():
            out.append(f"{head} none is verified.")
            continue
        quick, low = int(time[k].argmin()), int(energy[k].argmin())
        out.append(
            f"{head} quickest {solvers[quick]}"
            f" ({time[k, quick]:.2f} s, E {energy[k, quick]:.6g}); lowest energy"
            f" {solvers[low]} (E {energy[k, low]:.6g} in {time[k, low]:.2f} s)."
        )
    claims = [r for r in rows if r["claimed"]]
    false = sorted({str(r["solver"]) for r in claims if not r["verified"]})
    if claims:
        true = sum(bool(r["verified"]) for r in claims)
        out.append(
            f"- Claims of an optimum that were true: {true} of {len(claims)}"
            + (f"; not always those of {', '.join(false)}." if false else ".")
        )
    return out


def _feasible(row: Row) -> bool:
    """It has a point on the constraints, whose energy is a number."""
    primal = row.get("primal")
    return row.get("energy") is not None and primal is not None and primal <= FEASIBLE


def by_solver(rows: Sequence[Row]) -> list[str]:
    """Table: how many runs, claims, true claims."""
    out = ["| solver | runs | claimed | verified | claims that were true | ended otherwise |"]
    out.append("|---|---|---|---|---|---|")
    for solver in sorted({str(r["solver"]) for r in rows}):
        here = [r for r in rows if r["solver"] == solver]
        claimed = sum(bool(r["claimed"]) for r in here)
        verified = sum(bool(r["verified"]) for r in here)
        share = f"{verified} of {claimed}" if claimed else "-"
        other = sorted({str(r["status"])[:50] for r in here if not r["claimed"]})
        out.append(
            f"| {solver} | {len(here)} | {claimed} | {verified} | {share} |"
            f" {'; '.join(_cell(o) for o in other)} |"
        )
    return out


def by_run(rows: Sequence[Row]) -> list[str]:
    """Table of every run."""
    head = (
        "problem", "N", "formulation", "solver", "verified", "exact E", "start E", "primal",
        "dual", "compl.", "iterations", "seconds", "CPU s", "MB", "status",
    )  # fmt: skip
    out = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]

    def text(row: Row, key: str, form: str) -> str:
        value = row.get(key)
        return "-" if value is None else format(value, form)

    names = problem_names(rows)
    for row in sorted(rows, key=lambda r: (problem_key(r), not r["verified"], r["seconds"])):
        word = "yes" if row["verified"] else "claimed" if row["claimed"] else "no"
        steps = row["iterations"]
        cells = [
            names[problem_key(row)],
            str(row["superpixels"]),
            str(row["formulation"]),
            str(row["solver"]),
            word,
            text(row, "energy", ".6g"),
            text(row, "energy_start", ".6g"),
            text(row, "primal", ".0e"),
            text(row, "dual", ".0e"),
            text(row, "complementarity", ".0e"),
            str(steps) if steps >= 0 else "-",
            text(row, "seconds", ".2f"),
            text(row, "cpu_seconds", ".2f"),
            str(row["peak_bytes"] >> 20) if row["peak_bytes"] else "-",
            _cell(str(row["status"])[:50]),
        ]
        out.append(f"| {' | '.join(cells)} |")
    return out


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "/").split())
