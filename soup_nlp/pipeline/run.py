"""Solve a problem: prepare, solve, refine, reconstruct and evaluate."""

import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from types import FunctionType, NoneType
from typing import Any, TypedDict, Unpack

import numpy as np
from pydantic import BaseModel

from soup_nlp.arrays import Float
from soup_nlp.config.problem import (
    Expected,
    OutputOptions,
    Problem,
    SegmentationOptions,
    make_problem,
    title,
)
from soup_nlp.data.flow.consistency import check_flow
from soup_nlp.data.flow.sources import FlowOptions
from soup_nlp.data.formats.cameras import check_cameras
from soup_nlp.data.inputs import PriorOptions, pair_hash, pair_with_prior
from soup_nlp.data.pair import Pair
from soup_nlp.errors import ConfigError, StoppedError, expect
from soup_nlp.evaluation.confidence import KINDS, confidence
from soup_nlp.evaluation.scoring import rigid_depth, score_depths
from soup_nlp.geometry.constraints import constraints
from soup_nlp.geometry.plane import tilt_to_camera
from soup_nlp.geometry.soup import Soup, plane_depth, reconstruct
from soup_nlp.model import oracle
from soup_nlp.model.energy_options import EnergyOptions
from soup_nlp.model.formulation import FormulationOptions
from soup_nlp.pipeline.case import prepare
from soup_nlp.pipeline.record import Case, Run, full_size
from soup_nlp.refine.detail import above_ground, detail, shrinkage
from soup_nlp.refine.mppbp import refine_soup
from soup_nlp.refine.photometric import photometric_term
from soup_nlp.refine.records import Refined, RefineOptions
from soup_nlp.solve.solver_options import SolverOptions
from soup_nlp.solve.stages import Solution, solve_soup
from soup_nlp.start.regions import likeness
from soup_nlp.start.scales import ground
from soup_nlp.start.views import StartOptions
from soup_nlp.storage.progress import Listener, Watch

EXACT, EXACT_PARALLAX = 0.015, 1.0
"""Flow is exact below this median re-projection error of the start, with more parallax than this,
both in pixels; E_photo, exact to a tenth of a pixel, would only disturb it."""

PAIR = "soup_nlp.Pair(image_ref, image_next, K_ref)"
"""How a pair is made, for messages."""


def run(
    problem: Problem,
    *,
    pair: Pair | None = None,
    listener: Listener | None = None,
    stop: threading.Event | None = None,
    log: Callable[[str], None] | None = None,
    on_stage: Callable[[str], None] | None = None,
    ipopt_log: str | None = None,
) -> Run:
    """Solve a problem.

    Args:
        problem: See `config.load_problem`.
        pair: Images and cameras, instead of the problem's input; its flow is used when it has one.
        listener: Called at every iteration of presolve, Ipopt and TRW-S.
        stop: Set it to end with the best iterate, or after the stage where there is no start yet.
        log: Called with a line after every stage.
        on_stage: Called with the name of a stage at its end: those of `prepare`, "nlp", "refine",
            "evaluation".
        ipopt_log: File for Ipopt's own log.

    Raises:
        StoppedError: `stop` was set before there was a start.
        SoupError: the input cannot be used.
    """
    expect(problem, Problem, "problem", "soup_nlp.load_problem(FILE), or make_problem({...})")
    if pair is not None:
        expect(pair, Pair, "pair", PAIR)
    calls = {"listener": listener, "log": log, "on_stage": on_stage}
    for name, call in calls.items():
        if not callable(call):
            expect(call, (FunctionType, NoneType), name, "a function, such as print, or None")
    expect(stop, (threading.Event, NoneType), "stop", "threading.Event(), or None")
    expect(ipopt_log, (str, NoneType), "ipopt_log", "the name of a file, or None")
    seconds, begin = dict[str, float](), time.perf_counter()

    def ended(stage: str) -> None:
        """Add the wall time of a stage; without a start, a stop ends the run here."""
        seconds[stage] = time.perf_counter() - begin - sum(seconds.values())
        if on_stage:
            on_stage(stage)
        if stop and stop.is_set() and stage in ("load", "flow", "segmentation"):
            what = "interrupted before there was a start: nothing to write"
            raise StoppedError(what, where=f"after stage {stage}")

    watch = Watch(listener, stop or threading.Event(), log or (lambda line: None), ipopt_log)
    case = prepare(problem, pair=pair, log=watch.say, on_stage=ended)

    if problem.refine.enabled and problem.refine.from_start:
        solution = skipped(case)
    else:
        energy = case.data, case.weights, case.formulation()
        solution = solve_soup(case.start.soup, *energy, case.options, watch=watch)
        ended("nlp")
    refined = None
    if problem.refine.enabled:
        refined = _refined(case, solution.soup, watch)
        watch.say(str(refined))
        ended("refine")
    done = make_run(case, solution, refined)
    ended("evaluation")
    parts = {f"nlp_{k}": v for k, v in solution.seconds.items()}
    return replace(done, seconds={**seconds, **parts})


def _refined(case: Case, soup: Soup, watch: Watch) -> Refined:
    """The refinement of the NLP's solution or the start.

    E_photo is used unless rigid motions explain the flow more exactly than images can tell. A flow
    without parallax does not count as exact, because any depth explains it.
    """
    problem, start, photo = case.problem, case.start, None
    exact = np.median(start.parallax) > EXACT_PARALLAX and np.median(start.error) < EXACT
    if not exact:
        photo = photometric_term(
            case.pair, case.segmentation.labels, soup, case.data, problem.refine
        )
    return refine_soup(
        soup,
        case.data,
        case.weights,
        problem.refine,
        start=start.soup,
        photo=photo,
        seed=problem.seed,
        min_facing=problem.formulation.min_facing,
        depth_ratio=case.formulation().depth_ratio,
        watch=watch,
    )


def make_run(case: Case, solution: Solution, refined: Refined | None = None) -> Run:
    """Reconstruct and score a solution and its refinement: a whole run except its times."""
    pair, labels = case.pair, case.segmentation.labels
    soup = solution.soup if refined is None else refined.soup
    size = pair.image_next.shape[0], pair.image_next.shape[1]
    dense = partial(reconstruct, soup, labels, pair.K_ref, pair.K_next, size)
    after = planes = dense()
    assert pair.flow is not None
    energy = case.data, case.weights, case.formulation()
    sure = confidence(planes, pair, case.start, *energy, case.given)
    moved = level = None
    if refined is not None and case.problem.refine.detail:
        drawn = sure.kind == KINDS.index("drawn")
        moved = shrinkage(planes, case.data, likeness(case.segmentation), sure.own_sigma, drawn)
        beside = moved[labels]
        if not case.start.at_rest:
            used = ~case.start.bends & case.data.pixel_weight.any(axis=1)
            beside = beside + detail(planes, pair.flow, pair.K_next, used)
        level = _ground(case, soup)
        above = above_ground(planes, beside, level, pair.K_ref, sure.sigma)
        after = dense(np.where(sure.kind == KINDS.index("measured"), beside, above))
    after = replace(after, sigma_ref=sure.sigma)
    full = None if case.original is None else full_size(case.original, pair, after)
    start = plane_depth(case.start.soup, labels, pair.K_ref)
    depths = {"solution": after.depth_ref, "start": start}
    if refined is not None and solution.stages:
        depths["nlp"] = plane_depth(solution.soup, labels, pair.K_ref)
    if pair.truth is not None and (rigid := rigid_depth(pair)) is not None:
        depths["rigid"] = rigid
    fields = vars(case) | {"soup": soup}
    return Run(
        **fields,
        solution=solution,
        reconstruction=after,
        depth_maps=depths,
        metrics=score_depths(
            pair.truth, depths, depth_next=after.depth_next, sigma=after.sigma_ref
        ),
        seconds={},
        confidence=sure,
        refined=refined,
        full=full,
        shrinkage=moved,
        ground=level,
    )


def _ground(case: Case, soup: Soup) -> Float:
    """(3,) p of the ground by all superpixels whose flow determines their depth, see `ground`."""
    start, anchor, o = case.start, case.data.anchor_ray, case.problem.start
    known = ~start.interpolated & ~start.bends & (o.upright and o.ground)
    area = np.where(known, case.segmentation.sizes, 0.0)
    return ground(anchor, 1 / soup.depth_at(anchor), area, case.problem.seed)


def skipped(case: Case) -> Solution:
    """The start in place of the NLP's solution, its planes tilted until they face the camera."""
    start, data, form = case.start.soup, case.data, case.formulation()
    rays = data.visibility_ray(form.depth_ratio)
    soup = tilt_to_camera(start, data.anchor_ray, rays, form.min_facing)
    soup = soup.normalised(data.share).retracted()
    return Solution(
        soup=soup,
        status="Skipped",
        converged=False,
        stages=(),
        energy_start=oracle.energy(start, data, case.weights),
        energy=oracle.energy(soup, data, case.weights),
        residuals=constraints(soup, data.rim_ray, form.min_facing).largest,
        delivered="start",
    )


Options = Mapping[str, Any]
"""Keys of a section of a problem file."""


class ProblemKeys(TypedDict, total=False):
    """Keys of a problem file for a pair in memory; a section that is None has its defaults."""

    preset: str | None
    seed: int
    max_size: float | None
    segmentation: Options | SegmentationOptions | None
    flow: Options | FlowOptions | None
    depth_prior: Options | PriorOptions | None
    start: Options | StartOptions | None
    energy: Options | EnergyOptions | None
    formulation: Options | FormulationOptions | None
    solver: Options | SolverOptions | None
    refine: Options | RefineOptions | None
    expected: Options | Expected | None
    output: Options | OutputOptions | None


def sections(keys: ProblemKeys, where: str) -> dict[str, Any]:
    """Keys of a problem that a caller of the function `where` gives, as those of a file."""
    raw = {
        key: value.model_dump(exclude_unset=True) if isinstance(value, BaseModel) else value
        for key, value in keys.items()
        if value is not None or key == "max_size"
    }
    # make_problem names the other unknown keys
    if decided := sorted(raw.keys() & {"name", "input"}):
        raise ConfigError("key follows from the images", where=where, found=decided[0])
    return raw


def solve_pair(
    pair: Pair,
    *,
    prior_ref: object = None,
    progress: bool | Listener = False,
    cropped: bool = False,
    **keys: Unpack[ProblemKeys],
) -> Run:
    """Solve a pair that is in memory.

    The problem of the run holds a hash of the pair only, so that its config.yaml cannot be solved.
    `soup-nlp show street --all` lists the keys of a problem.

    Args:
        pair: Images, cameras, and a flow if there is one (else OpenCV DIS).
        prior_ref: Depth of the reference frame from elsewhere, (H, W) or a file.
        progress: True prints a line after every stage; a function is called at every iteration.
        cropped: The images are parts of larger ones: the principal points may be anywhere.
        keys: Those of `ProblemKeys`: `preset`, `seed`, `max_size`, and sections such as
            `segmentation={"superpixels": 500}` or `segmentation=SegmentationOptions(...)`.

    Raises:
        ConfigError: an option is wrong.
        DataError: the pair cannot be used.
    """
    expect(pair, Pair, "pair", PAIR)
    if prior_ref is not None:
        pair = pair_with_prior(pair, prior_ref, "prior_ref")
    images, names = (pair.image_ref, pair.image_next), ("K_ref", "K_next")
    check_cameras((pair.K_ref, pair.K_next), images, names, cropped)
    if pair.flow is not None:
        check_flow(pair.flow, pair)
    raw = sections(keys, "solve_pair")
    raw |= {"name": title(pair.name), "input": {"kind": "memory", "hash": pair_hash(pair)}}
    begin = time.perf_counter()

    def say(stage: str) -> None:
        print(f"{stage:<13}{time.perf_counter() - begin:6.1f} s", file=sys.stderr)

    listener = progress if callable(progress) else None
    problem = make_problem(raw, where="solve_pair")
    return run(problem, pair=pair, listener=listener, on_stage=say if progress is True else None)
