"""The way through the house: a problem in, a run with reconstruction and metrics out."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from soup_nlp.config.problem import Problem, make_problem
from soup_nlp.data.inputs import pair_hash
from soup_nlp.data.pair import Pair
from soup_nlp.errors import SoupError
from soup_nlp.evaluate.baselines import RigidBaseline
from soup_nlp.evaluate.metrics import DepthMetrics
from soup_nlp.evaluate.scoring import rigid_baseline, score_depths
from soup_nlp.geometry.graph import Segmentation
from soup_nlp.geometry.soup import Reconstruction, Soup, reconstruct
from soup_nlp.model import oracle
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulation import FormulationOptions
from soup_nlp.model.layout import MatrixLayout
from soup_nlp.pipeline.case import Case, prepare
from soup_nlp.refine.mppbp import refine_soup
from soup_nlp.refine.records import Refined
from soup_nlp.refine.select import upright
from soup_nlp.solve.ipopt import Listener
from soup_nlp.solve.kkt import constraint_residuals
from soup_nlp.solve.stages import Solution, solve_soup
from soup_nlp.start.propose import Start

BEFORE_START = ("load", "flow", "segmentation")
"""Stages at whose end there is no soup yet."""


class StoppedError(SoupError):
    """A run was told to stop before it had a start, which is the least that can be kept."""


@dataclass(frozen=True)
class Run:
    """Everything that a solve made.

    Attributes:
        problem: The merged problem.
        pair: Images, cameras, flow, truth.
        segmentation: Superpixels and graphs.
        start: The unorganised soup.
        data: Numbers of the energy.
        weights: Constants of the energy.
        solution: What the constrained NLP ended with, before any refinement.
        answer: Ipopt's own answer to the constrained NLP (the best iterate where it did not
            converge), before anything is made of it: constraints hold to its tolerance only.
        delivered: What `solution.soup` is made of: "constrained NLP", "presolve" or
            "start" where that has the lower exact energy, "start" where the NLP was skipped.
        start_reconstruction: Dense 3D of the start.
        reconstruction: Dense 3D of `soup`.
        rigid: One rigid motion for the whole image; None without truth or where none fits.
        metrics: By "solution" (delivered), "nlp" (where refined), "start", "constant", "rigid",
            and "solution_next" for the next frame; a key without truth is absent.
        seconds: Wall time by stage; those that start with nlp_ are parts of "nlp".
        refined: What the refinement made of `solution`; None where it is off.
        nlp_reconstruction: Dense 3D of `solution`, where there is an NLP and it was refined.
    """

    problem: Problem
    pair: Pair
    segmentation: Segmentation
    start: Start
    data: EnergyData
    weights: Weights
    solution: Solution
    answer: Soup
    delivered: str
    start_reconstruction: Reconstruction
    reconstruction: Reconstruction
    rigid: RigidBaseline | None
    metrics: Mapping[str, DepthMetrics] = field(repr=False)
    seconds: Mapping[str, float]
    refined: Refined | None = None
    nlp_reconstruction: Reconstruction | None = None

    @property
    def soup(self) -> Soup:
        """What is delivered: the refined soup, or the NLP's where there is no refinement."""
        return self.refined.soup if self.refined else self.solution.soup

    @property
    def energy(self) -> Mapping[str, float]:
        """Exact energy by term of `soup`."""
        return self.refined.energy if self.refined else self.solution.energy

    @property
    def residuals(self) -> dict[str, float]:
        """Constraint residuals of `soup`; what is said of Ipopt's answer stays as it is."""
        facing = self.problem.formulation.min_facing
        own = constraint_residuals(self.soup, self.data.rim_ray, facing)
        return {**self.solution.residuals, **own}

    @property
    def good(self) -> bool:
        """Whether the NLP converged (or was skipped) and nobody interrupted the refinement."""
        solved = self.solution.converged or self.solution.status == "Skipped"
        return solved and (self.refined is None or self.refined.status != "interrupted")


def run(
    problem: Problem,
    *,
    pair: Pair | None = None,
    listener: Listener | None = None,
    stop: threading.Event | None = None,
    say: Callable[[str], None] | None = None,
    ipopt_log: str | None = None,
) -> Run:
    """Solve a problem.

    Args:
        problem: See `config.load_problem`.
        pair: Images and cameras, instead of the problem's input; its flow is used when it has one.
        listener: Called at every iteration of presolve, Ipopt and TRW-S.
        stop: Set it to end with the best iterate, or after the stage where there is no start yet.
        say: Called with a line after every stage.
        ipopt_log: File for Ipopt's own log.

    Raises:
        StoppedError: `stop` was set before there was a start.
        SoupError: the input cannot be used.
    """
    seconds: dict[str, float] = {}
    clock = time.perf_counter()

    def lap(stage: str) -> None:
        nonlocal clock
        now = time.perf_counter()
        seconds[stage] = seconds.get(stage, 0.0) + now - clock
        clock = now
        if stop is not None and stop.is_set() and stage in BEFORE_START:
            raise StoppedError(
                "interrupted before there was a start: nothing to write",
                where=f"after stage {stage}",
            )

    case = prepare(problem, pair=pair, lap=lap, say=say)
    start, data, weights = case.start, case.data, case.weights
    form, refine = problem.formulation, problem.refine

    def nlp(soup: Soup) -> Solution:
        return solve_soup(
            soup,
            data,
            weights,
            case.formulation(),
            case.options,
            listener=listener,
            stop=stop,
            say=say,
            log_file=ipopt_log,
        )

    if refine.enabled and refine.from_start:
        solution = _skipped(start.soup, data, weights, form)
        answer, delivered = solution.soup, "start"
    else:
        solution = nlp(start.soup)
        answer = MatrixLayout(data.share, form.gauge).unpack(solution.stages[-1].x)
        delivered = solution.delivered
        lap("nlp")
    refined = None
    if refine.enabled:
        refined = refine_soup(
            solution.soup,
            data,
            weights,
            refine,
            seed=problem.seed,
            min_facing=form.min_facing,
            depth_ratio=form.depth_ratio,
            listener=listener,
            stop=stop,
            say=say,
        )
        if refine.polish and refined.status != "interrupted":
            refined = _polished(refined, nlp(refined.soup))
        if say:
            say(str(refined))
        lap("refine")
    done = make_run(case, solution, answer, delivered, refined)
    lap("evaluation")
    own = {f"nlp_{k}": v for k, v in solution.seconds.items()}
    return replace(done, seconds={**seconds, **own})


def make_run(
    case: Case,
    solution: Solution,
    answer: Soup,
    delivered: str,
    refined: Refined | None = None,
) -> Run:
    """Dense 3D and scores of a solution: everything that a run holds but its times.

    Args:
        case: The problem as it was before the solve.
        solution: What the constrained NLP ended with.
        answer: Ipopt's own answer, or the start where the NLP was skipped.
        delivered: What `solution.soup` is made of, see `Run`.
        refined: What the refinement made of it.
    """
    pair, labels, expected = case.pair, case.segmentation.labels, case.problem.expected
    size = pair.image_next.shape[0], pair.image_next.shape[1]

    def dense(soup: Soup) -> Reconstruction:
        return reconstruct(soup, labels, pair.K_ref, pair.K_next, size)

    before, middle = dense(case.start.soup), dense(solution.soup)
    after = middle if refined is None else dense(refined.soup)
    between = middle if refined is not None and solution.stages else None
    rigid = rigid_baseline(pair)
    depths = {"solution": after.depth_ref, "start": before.depth_ref}
    if between is not None:
        depths["nlp"] = between.depth_ref
    if rigid is not None:
        depths["rigid"] = rigid.depth
    return Run(
        problem=case.problem,
        pair=pair,
        segmentation=case.segmentation,
        start=case.start,
        data=case.data,
        weights=case.weights,
        solution=solution,
        answer=answer,
        delivered=delivered,
        start_reconstruction=before,
        reconstruction=after,
        rigid=rigid,
        metrics=score_depths(pair.truth, depths, expected.scale, expected.cap, after.depth_next),
        seconds={},
        refined=refined,
        nlp_reconstruction=between,
    )


def _skipped(start: Soup, data: EnergyData, weights: Weights, form: FormulationOptions) -> Solution:
    """The start in the place of the NLP's solution: planes tilted until they face the camera."""
    rays = data.visibility_ray(form.depth_ratio)
    soup = upright(start, data.anchor_ray, rays, form.min_facing)
    soup = soup.normalised(data.share).retracted()
    return Solution(
        soup=soup,
        status="Skipped",
        converged=False,
        stages=(),
        energy_start=oracle.energy(start, data, weights),
        energy=oracle.energy(soup, data, weights),
        residuals=constraint_residuals(soup, data.rim_ray, form.min_facing),
        multipliers={},
        nlp={},
        description="",
        seconds={},
    )


def _polished(refined: Refined, again: Solution) -> Refined:
    """The refined soup, or the NLP's answer from it where that has the lower exact energy."""
    gain = refined.energy["total"] - again.energy["total"]
    # what rounding gives is no gain
    if gain <= 1e-9 * refined.energy["total"]:
        return replace(refined, polish_gain=0.0)
    return replace(refined, soup=again.soup, energy=again.energy, polish_gain=gain)


def solve_pair(pair: Pair, **options: Any) -> Run:
    """Solve a pair that is in memory.

    The problem of the run says so by a hash of the pair; its config.yaml cannot be solved again.

    Args:
        pair: Images, cameras, and a flow if there is one (else OpenCV DIS).
        options: Sections of a problem file, e.g. `segmentation={"superpixels": 500}`.

    Raises:
        ConfigError: an option is wrong.
        DataError: the pair cannot be used.
    """
    source = {"kind": "memory", "hash": pair_hash(pair)}
    raw = {"name": pair.name, "input": source, **options}
    return run(make_problem(raw, where="solve_pair"), pair=pair)
