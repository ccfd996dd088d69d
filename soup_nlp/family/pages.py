"""Texts in the folder of the family: README and licence."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from soup_nlp import __version__
from soup_nlp.family.instances import VERSION

Entry = Mapping[str, Any]

LICENCE = """The SOUP problem set (every file of this folder)
Copyright 2026 the soup_nlp authors

Licensed under the Creative Commons Attribution 4.0 International licence (CC BY 4.0):
https://creativecommons.org/licenses/by/4.0/legalcode

You may copy, change and publish the files, also commercially, if you name the source:
"SOUP problem set, made by soup_nlp". All scenes are rendered with textures of our own; no data of
others is in them. The program that makes the files has a licence of its own (MIT).
"""

HEAD = """# SOUP: nonlinear programs from dense 3D vision

What: the pose and plane of every superpixel of an image, found from the flow to a second image
("Superpixel Soup"; S. Kumar, Y. Dai, H. Li). Every norm of the objective is un-squared, so that the
solution lies on the kinks of what the objective is a smoothing of (width 0.01 px).

    min  f(x) = sum over edges, pixels, boundaries of sqrt(|v(x)|^2 + eps^2) - eps, truncated
    s.t. sum lam = 1, lam > 0,  R_i'R_i = I,  |n_i|^2 = 1,  -n_i . ray >= c

Continuous, sparse, nonconvex, feasible and bounded below by 0; many local
minima close to each other. Equality rows are quadratic, the visibility rows linear, the objective
is general. All functions are twice differentiable at every point with lam > 0 and a positive depth.

| | |
|---|---|
| family | {scenes}; names are `SOUP-<scene>-<formulation>-N<size>-<start>` |
| short names | at most 24 characters, in `instancedata.csv`: `SOUP-street-os-100h` |
| sizes | N = {sizes} superpixels asked for; 16 variables each in the standard formulation |
| start `easy` | the best known point, an answer of Ipopt, rounded to 20 significant bits |
| start `hard` | an initial proposal, made from the true flow |
| start `cold` | planes at one depth, shifted as the true flow says, without rotation |
| generator | `soup-nlp family` of soup_nlp {package}; family version {version} |
| determinism | one version, one set of bytes on any processor; SHA-256 in `index.json` |
| licence | CC BY 4.0, see LICENSE.txt; rendered scenes only |

## How hard they are

`hard` and `cold` are the problem. **No general solver that was tried solves any of them** within
the limits of the table below: Ipopt and POUNCE with default or tuned options, Bonmin and an SQP
method stop far above the best known points or without a point. What gets there narrows the
smoothing in steps (soup_nlp, and its Levenberg-Marquardt method on the manifold, "lm"). An `easy`
start is a solution already, so that a run from there is a confirmation only.

## How to run

Any solver that reads AMPL's `.nl` takes the files: `SOLVER NAME -AMPL`. A runner in one file calls
it on every instance, recomputes objective, violation and stationarity from its answer, and says
whether it converged to the best known point, differs from it, or is WRONG (needs Python with
casadi; words select instances):

    python run.py "pounce mu_init=1e-5 bound_push=1e-6 bound_frac=1e-6 nlp_scaling_method=none" easy
    python run.py "pounce max_cpu_time=50" hard --seconds 60

The first confirms `easy` starts, of N = 100 in seconds each: an interior-point method stays at a
solution only with a small barrier. The second ends at its limit (see below). With soup_nlp,
`soup-nlp check NAME.sol` builds the instance again and recomputes the same from derivatives of its
own.

`.col` and `.row` name variables and rows. `<name without start>.casadi` is the program as CasADi's
serialised text: function `nlp` of x to f and g, then lbx, ubx, lbg, ubg and x0 of every start of
this folder; casadi-reader (PyPI) reads it without CasADi. Converters to GAMS, OSiL or SIF were not
tried. To send results, write a JSON object with a list `results` of objects with at least `solver`,
`name`, `n`, `m`, `status`, `objective`, `iterations`, `time` (seconds).

## Known optima

`<name without start>.sol` is the best known point (primal). `index.json` and `index.csv` have its
objective, its unscaled KKT residuals, who found it and who reached it: with a verified point at
most 1e-4 relative above. `instancedata.csv` has the columns of MINLPLib; its dual bound is 0, as
every term of the objective is at least 0.
"""

COLUMNS: Mapping[str, Callable[[Entry], str]] = {
    "problem": lambda e: e["name"].rpartition("-")[0],
    "n": lambda e: str(e["variables"]),
    "m": lambda e: str(e["constraints"]),
    "Jacobian": lambda e: str(e["jacobian_nonzeros"]),
    "Hessian": lambda e: str(e["hessian_nonzeros"]),
    "class": lambda e: e["classification"],
    "LICQ": lambda e: f"{'holds' if e['licq'] else 'FAILS'} ({e['active_rank']})",
    "best known": lambda e: f"{e['best_known']['objective']:.8g}",
    "dual inf.": lambda e: f"{e['best_known']['dual']:.0e}",
    "found by": lambda e: str(e["best_known"]["found_by"] or "soup_nlp"),
    "reached by": lambda e: _share(e["best_known"]),
}


def _share(best: Entry) -> str:
    tried, reached = best["tried_by"], best["reached_by"]
    return f"{len(reached)} of {len(tried)} solvers" if tried else "not measured"


def _reached(entries: Sequence[Entry]) -> list[str]:
    """What each solver reached from each start: objective above the best known one, CPU seconds."""
    known = [e for e in entries if e["runs"]]
    solvers = list(dict.fromkeys(s for e in known for s in e["runs"]))
    if not solvers:
        return []

    def cell(entry: Entry, solver: str) -> str:
        objective, seconds, limit, verified = entry["runs"].get(solver, (None, None, None, False))
        if seconds is None:
            return "-"
        if objective is None:
            return f"no point, {seconds:g} of {limit:g} s"
        best = entry["best_known"]["objective"]
        gap = f"{100 * (objective - best) / abs(best):+.2g} %"
        return f"{f'**{gap}**' if verified else gap}, {seconds:g} of {limit:g} s"

    rows = [[e["short"], *(cell(e, s) for s in solvers)] for e in known]
    return [
        "",
        "## What solvers reached",
        "",
        "Objective above the best known one; bold: the point is verified as an optimum. CPU seconds"
        " of their limit. Options and machine: results/family of the soup_nlp repository.",
        "",
        "| instance | " + " | ".join(solvers) + " |",
        "|" + "---|" * (len(solvers) + 1),
        *("| " + " | ".join(row) + " |" for row in rows),
    ]


def readme(entries: Sequence[Entry]) -> str:
    """README of the folder, for the entries of its index."""
    scenes = ", ".join(dict.fromkeys(e["scene"] for e in entries))
    sizes = ", ".join(str(n) for n in sorted({e["size"] for e in entries}))
    head = HEAD.format(scenes=scenes, sizes=sizes, package=__version__, version=VERSION)
    unique = list({COLUMNS["problem"](e): e for e in entries}.values())
    lines = ["| " + " | ".join(COLUMNS) + " |", "|" + "---|" * len(COLUMNS)]
    lines += ["| " + " | ".join(f(e) for f in COLUMNS.values()) + " |" for e in unique]
    starts = ["", "## Instances", "", "| file | objective at start | MB | SHA-256 |"]
    starts.append("|---|---|---|---|")
    starts += [
        f"| {e['file']} | {e['objective_at_start']:.6g} | {e['bytes'] / 1e6:.1f}"
        f" | {e['sha256'][:16]}... |"
        for e in entries
    ]
    note = [
        "",
        "Nonzeros of the Hessian are of its upper triangle. LICQ: at the best known point, with the"
        " rank of the active rows in brackets.",
    ]
    return head + "\n" + "\n".join([*lines, *note, *_reached(entries), *starts]) + "\n"
