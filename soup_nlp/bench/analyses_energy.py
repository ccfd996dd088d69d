"""Energy at the truth against energy at the solution, and what solving makes of the truth.

E(truth) well above E(solution) is an error of the model; below it, of the solver. Solving from the
truth shows the same in depth: what it loses there, the energy's minimum has lost.
"""

from __future__ import annotations

import time

import numpy as np

from soup_nlp.bench.accuracy import Job, Row, clean, flow_error, head
from soup_nlp.bench.truth import rescaled, true_soup
from soup_nlp.evaluate.protocols import preset
from soup_nlp.geometry.soup import Soup, reconstruct
from soup_nlp.model import oracle
from soup_nlp.model.formulation import Formulation
from soup_nlp.pipeline.case import solver_options
from soup_nlp.pipeline.run import Run, run
from soup_nlp.refine.mppbp import refine_soup
from soup_nlp.solve.stages import solve_soup

WORSE = 0.01
"""Median relative error that solving from the truth may add."""

ABOVE = 1.10
"""E(truth) / E(solution) beyond which the model prefers something else."""


def measure_energy(job: Job) -> Row:
    """Energies by term and errors of start, solution, truth and of solves from the truth."""
    row = head(job)
    begin, cpu = time.perf_counter(), time.process_time()
    try:
        result = run(job.item.problem(job.overrides))
        row |= {"ok": True, "error": None, **energies(result, job.item.presets[0])}
    except Exception as error:
        row |= {"ok": False, "error": f"{type(error).__name__}: {error}"}
    row["seconds"] = time.perf_counter() - begin
    row["cpu_seconds"] = time.process_time() - cpu
    return clean(row)


def energies(result: Run, convention: str = "paper") -> Row:
    """Exact energies and depth errors by soup.

    Raises:
        DataError: the pair has no dense truth of depth and motion.
    """
    true = true_soup(result.pair, result.segmentation)

    def energy(soup: Soup) -> dict[str, float]:
        return oracle.energy(soup, result.data, result.weights)

    soups = {"start": result.start.soup, "solution": result.soup, "truth": true.soup}
    if len(np.unique(true.component)) > 1:
        soups["truth rescaled"] = rescaled(true, lambda soup: energy(soup)["total"])
    soups |= from_soup(result, true.soup)
    p, truth = result.pair, result.pair.truth
    assert truth is not None
    assert truth.depth_ref is not None
    metrics = {}
    for name, soup in soups.items():
        rec = reconstruct(soup, result.segmentation.labels, p.K_ref, p.K_next)
        m = preset(convention).score(rec.depth_ref, truth.depth_ref)
        metrics[name] = {"mre": m.mre, "median_relative": m.median_relative}
    return {
        "status": result.solution.status,
        "good": result.good,
        "superpixels": len(result.segmentation),
        "size": list(p.size),
        "mixed": float((true.purity < 0.95).mean()),
        "energy": {name: energy(soup) for name, soup in soups.items()},
        "metrics": {convention: metrics},
        "flow_error": flow_error(p),
    }


def from_soup(result: Run, soup: Soup) -> dict[str, Soup]:
    """What the NLP, and then the refinement where it is on, make of another start."""
    problem = result.problem
    form = Formulation(**dict(problem.formulation))
    options = solver_options(problem, result.start)
    solved = solve_soup(soup, result.data, result.weights, form, options)
    out = {"NLP from truth": solved.soup}
    refine = problem.refine
    if refine.enabled:
        refined = refine_soup(
            solved.soup,
            result.data,
            result.weights,
            refine,
            seed=problem.seed,
            min_facing=form.min_facing,
            depth_ratio=form.depth_ratio,
        )
        out["refined from truth"] = refined.soup
    return out
