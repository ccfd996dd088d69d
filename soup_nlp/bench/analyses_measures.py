"""Measurements of analyses beside the scores: energy at the truth, flow errors, changed views."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from soup_nlp.bench.accuracy import flow_error, measure_pair
from soup_nlp.bench.pair_views import backwards, cropped, mirrored
from soup_nlp.bench.suite_pairs import Item
from soup_nlp.bench.truth import moves_by_itself, rescaled, true_soup
from soup_nlp.config.problem import Problem
from soup_nlp.data.flow.robust import reweighted
from soup_nlp.data.pair import Pair
from soup_nlp.errors import DataError
from soup_nlp.evaluate.protocols import preset
from soup_nlp.geometry.soup import Soup, reconstruct
from soup_nlp.model import oracle
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulation import Formulation
from soup_nlp.pipeline.case import solver_options, superpixels
from soup_nlp.pipeline.record import Run
from soup_nlp.pipeline.run import run
from soup_nlp.refine.mppbp import refine_soup
from soup_nlp.refine.records import Refined
from soup_nlp.solve.stages import solve_soup
from soup_nlp.storage.rows import Row

VIEWS: Mapping[str, Callable[[Pair], Pair] | None] = MappingProxyType(
    {
        "as it is": None,
        "mirrored": mirrored,
        "backwards": backwards,
        "cropped 7x5": lambda pair: cropped(pair, 7, 5),
        "mirrored and cropped 7x5": lambda pair: mirrored(cropped(pair, 7, 5)),
    }
)
"""Transformation of a pair by name of the variant; 7x5 are the columns x rows cut off."""


def measure_view(item: Item, overrides: tuple[str, ...] = (), variant: str = "") -> Row:
    """Solve and score one pair after the transformation of a variant."""
    return measure_pair(item, overrides, change=VIEWS[variant])


def measure_flow(item: Item, overrides: tuple[str, ...] = (), variant: str = "") -> Row:
    """End-point error of the flow of one pair, in pixels; nothing is solved.

    Raises:
        DataError: the pair has no true flow.
    """
    problem = item.problem(overrides)
    pair = problem.load_pair()
    flow = problem.flow.load(pair, problem.path)
    if problem.flow.reweight_px is not None:
        labels = superpixels(problem, pair.with_flow(flow))
        flow = reweighted(flow, labels, problem.flow.reweight_px)
    error = flow_error(pair.with_flow(flow))
    if error is None:
        raise DataError("pair has no true flow", where=pair.name)
    return {"metrics": {}, "flow_error": error}


def measure_energy(item: Item, overrides: tuple[str, ...] = (), variant: str = "") -> Row:
    """Exact energies by term and depth errors of start, solution, truth and solves from the truth.

    An E(truth) well above E(solution) is an error of the model; one below it is an error of the
    solver. The depth error of a solve from the truth is that of the nearest minimum of the energy.

    Raises:
        DataError: the pair has no dense truth of depth and motion.
    """
    result, convention = run(item.problem(overrides)), item.presets[0]
    true = true_soup(result.pair, result.segmentation)

    def energy(soup: Soup) -> dict[str, float]:
        return oracle.energy(soup, result.data, result.weights)

    soups = {"start": result.start.soup, "solution": result.soup, "truth": true.soup}
    truth = result.pair.truth
    assert truth is not None
    if truth.components is not None:
        own = moves_by_itself(truth)[true.component]
        if own.any():
            apart = replace(true, component=np.where(own, true.component, 0))
            soups["truth rescaled"] = rescaled(apart, lambda soup: energy(soup)["total"])
    soups |= solutions_from(result, true.soup)
    p = result.pair
    assert truth.depth_ref is not None
    metrics = {}
    for name, soup in soups.items():
        rec = reconstruct(soup, result.segmentation.labels, p.K_ref, p.K_next)
        m = preset(convention).score(rec.depth_ref, truth.depth_ref)
        metrics[name] = {"mre": m.mre, "median_relative": m.median_relative}
    return {
        "status": result.solution.status,
        "good": result.solved,
        "mixed": float((true.purity < 0.95).mean()),
        "energy": {name: energy(soup) for name, soup in soups.items()},
        "metrics": {convention: metrics},
    }


def solutions_from(result: Run, soup: Soup) -> dict[str, Soup]:
    """Solutions of the NLP, and of the refinement if it is enabled, from another start."""
    problem = result.problem
    form = Formulation(**dict(problem.formulation))
    options = solver_options(problem, result.start)
    solved = solve_soup(soup, result.data, result.weights, form, options)
    out = {"NLP from truth": solved.soup}
    if problem.refine.enabled:
        out["refined from truth"] = refined(
            problem, form, solved.soup, result.data, result.weights
        ).soup
    return out


def refined(
    problem: Problem, form: Formulation, soup: Soup, data: EnergyData, weights: Weights
) -> Refined:
    """The refinement of a soup with the options of a problem."""
    return refine_soup(
        soup,
        data,
        weights,
        problem.refine,
        seed=problem.seed,
        min_facing=form.min_facing,
        depth_ratio=form.depth_ratio,
    )
