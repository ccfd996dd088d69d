"""How low every method ends on one energy, and which formulations of the NLP converge."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import Any

from soup_nlp.bench.analyses_measures import refined
from soup_nlp.bench.reference_solvers import EPS, levenberg_marquardt
from soup_nlp.bench.rows import Row, Say
from soup_nlp.bench.speed import REFERENCE_ITERATIONS, Spec, plan, problem_of
from soup_nlp.bench.studies import made_on, run_study, settings_table
from soup_nlp.config.problem import make_problem
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.layout import GAUGES
from soup_nlp.pipeline.case import Case, prepare
from soup_nlp.solve.stages import solve_soup

METHODS = {
    "NLP as shipped": None,
    "NLP from 0.1": 0.1,
    "NLP from 1": 1.0,
    "LM from 0.3": 0.3,
    "LM from 1": 1.0,
}
"""First smoothing width by method, pixels; the next ones are those of EPS below it."""


def measure_methods(spec: dict[str, Any], refine: bool) -> Row:
    """Exact energies from one start by every method, and what the refinement makes of them."""
    case = prepare(problem_of(Spec.from_dict(spec)))
    solved = [_solved(case, method) for method in METHODS]
    out: Row = {"superpixels": len(case), "before": [energy for _, energy in solved]}
    if refine:
        own = case.problem, case.formulation()
        after = [refined(*own, soup, case.data, case.weights) for soup, _ in solved]
        out["after"] = [r.energy["total"] for r in after]
    return out


def _solved(case: Case, method: str) -> tuple[Soup, float]:
    """Soup and exact energy of a method, from the case's start."""
    own = case.soup, case.data, case.weights, case.formulation()
    first = METHODS[method]
    eps = case.options.presolve_eps if first is None else EPS[EPS.index(first) :]
    if method.startswith("NLP"):
        s = solve_soup(*own, case.options.replace(presolve_eps=eps))
        return s.soup, s.energy["total"]
    r = levenberg_marquardt(*own, eps=eps, iterations=REFERENCE_ITERATIONS)
    return r.soup, r.energy["total"]


def study_methods(
    out: Path,
    scenes: Sequence[str],
    seeds: Sequence[int],
    sizes: Sequence[int],
    neighbours: int,
    refine: bool = True,
    say: Say | None = None,
) -> list[Row]:
    """Write OUT/methods.md, or OUT/methods_unrefined.md without the refinement."""
    note = (
        "Exact energy E by method and first smoothing width (px) from one start"
        + (", and what the refinement as shipped makes of it" if refine else "")
        + ". LM: on-manifold Levenberg-Marquardt. DIS flow,"
        f" K = {neighbours}. {made_on()}"
    )
    head = ["pair, seed", "N", *METHODS, "shipped / least", *(["both refined"] if refine else [])]

    def cells(row: Row) -> list[str]:
        spec, before, after = row["settings"]["spec"], row["before"], row.get("after")
        told = [f"{energy:.2f}" for energy in before]
        if after:
            told = [f"{cell} -> {energy:.2f}" for cell, energy in zip(told, after)]
        ratios = [f"{e[0] / min(e):.4f}" for e in (before, after) if e]
        return [f"{spec['scene']}, {spec['seed']}", str(row["superpixels"]), *told, *ratios]

    specs = plan(scenes, sizes, [neighbours], seeds)
    settings = [{"spec": asdict(spec), "refine": refine} for spec in specs]
    page = out / ("methods.md" if refine else "methods_unrefined.md")
    return run_study(page, settings, measure_methods, settings_table(note, head, cells), say)


FORMULATION_HEAD = (
    "gauge", "norm", "truncation", "status", "presolve its", "NLP its", "CPU s", "E",
    "dual infeasibility", "SO(3)", "violation", "complementarity",
)  # fmt: skip


def measure_formulation(
    scene: str,
    superpixels: int,
    iterations: int,
    seconds: float,
    gauge: str,
    norm: str,
    truncation: str,
) -> Row:
    """Solve one formulation of the constrained NLP from its presolve."""
    raw = {
        "input": {"kind": "scene", "scene": scene},
        "segmentation": {"superpixels": superpixels},
        "flow": {"source": "truth"},
    }
    case = prepare(make_problem(raw))
    options = case.options.replace(
        max_iter=iterations, far_iterations=iterations, max_seconds=seconds
    )
    form = case.formulation().replace(gauge=gauge, norm=norm, truncation=truncation)
    begin = time.process_time()
    s = solve_soup(case.soup, case.data, case.weights, form, options)
    return {
        "superpixels": len(case),
        "status": s.status,
        "presolve": sum(stage.iterations for stage in s.stages[:-1]),
        "nlp": s.stages[-1].iterations,
        "solve_cpu": time.process_time() - begin,
        "energy": s.energy["total"],
        "residuals": dict(s.residuals),
    }


def study_formulations(
    out: Path, scene: str, superpixels: int, iterations: int, seconds: float, say: Say | None = None
) -> list[Row]:
    """Write OUT/formulations.md: status, iterations, residuals and energy of all twelve."""
    note = (
        f"{scene}, true flow, {superpixels} superpixels wanted; constrained NLP to 1e-6 from the"
        f" same presolve, at most {iterations} iterations. {made_on()}"
    )

    def cells(row: Row) -> list[str]:
        own, r = row["settings"], row["residuals"]
        return [
            *(own[k] for k in ("gauge", "norm", "truncation")),
            row["status"].replace("_", " "),
            *(str(row[k]) for k in ("presolve", "nlp")),
            f"{row['solve_cpu']:.1f}",
            f"{row['energy']:.4f}",
            *(
                f"{r[k]:.1e}"
                for k in ("dual_infeasibility", "so3", "nlp_infeasibility", "complementarity")
            ),
        ]

    fixed = {"scene": scene, "superpixels": superpixels}
    fixed |= {"iterations": iterations, "seconds": seconds}
    settings = [
        {**fixed, "gauge": gauge, "norm": norm, "truncation": truncation}
        for norm, truncation, gauge in product(("smooth", "epigraph"), ("smooth", "lifted"), GAUGES)
    ]
    text = settings_table(note, FORMULATION_HEAD, cells)
    return run_study(out / "formulations.md", settings, measure_formulation, text, say)
