"""The way through the house: a problem in, a run with reconstruction and metrics out."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soup_nlp.config import (
    FilesInput,
    FolderInput,
    KittiInput,
    MotorcycleInput,
    Problem,
    SceneInput,
    SintelInput,
    make_problem,
)
from soup_nlp.data import datasets
from soup_nlp.data.flow import resolve_flow
from soup_nlp.data.formats import read_depth, read_image
from soup_nlp.data.pair import Flow, Pair, Truth
from soup_nlp.data.scenes import render_scene
from soup_nlp.errors import DataError
from soup_nlp.geometry.camera import intrinsics
from soup_nlp.geometry.graph import Segmentation, build_segmentation
from soup_nlp.geometry.soup import Reconstruction, Soup, reconstruct
from soup_nlp.geometry.superpixels import segment
from soup_nlp.model.energy import EnergyData, Weights, build_energy_data, in_pixels
from soup_nlp.model.formulation import Formulation
from soup_nlp.report.baselines import rigid_depth
from soup_nlp.report.metrics import (
    DepthMetrics,
    constant_depth_metrics,
    depth_metrics,
    sample_at_points,
)
from soup_nlp.solve.ipopt import Listener
from soup_nlp.solve.soup import Solution, SolverOptions, solve_soup
from soup_nlp.start.propose import Start, StartOptions, propose

Float = NDArray[np.float64]


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
        solution: What the constrained NLP ended with.
        start_reconstruction: Dense 3D of the start.
        reconstruction: Dense 3D of the solution.
        metrics: By "solution", "start", "constant", "rigid"; empty without truth.
        seconds: Wall time by stage.
    """

    problem: Problem
    pair: Pair
    segmentation: Segmentation
    start: Start
    data: EnergyData
    weights: Weights
    solution: Solution
    start_reconstruction: Reconstruction
    reconstruction: Reconstruction
    metrics: Mapping[str, DepthMetrics] = field(repr=False)
    seconds: Mapping[str, float]

    @property
    def soup(self) -> Soup:
        """The solution's soup."""
        return self.solution.soup


def load_pair(problem: Problem) -> Pair:
    """The frame pair of a problem, without its flow.

    Raises:
        DataError: a file is missing, damaged, or does not fit.
    """
    source = problem.input
    if isinstance(source, MotorcycleInput):
        pair = datasets.load_motorcycle()
    elif isinstance(source, SceneInput):
        pair = render_scene(source.scene, source.seed, source.width, source.height)
    elif isinstance(source, FilesInput):
        pair = _load_files(problem, source)
    elif isinstance(source, FolderInput):
        pair = datasets.load_folder(problem.path(source.path), source.depth_scale, source.unit)
    elif isinstance(source, SintelInput):
        pair = datasets.load_sintel(
            problem.path(source.root), source.scene, source.frame, source.render, source.step
        )
    elif isinstance(source, KittiInput):
        twelve = source.kind == "kitti2012"
        kitti = datasets.load_kitti2012 if twelve else datasets.load_kitti2015
        pair = kitti(problem.path(source.root), source.index, source.occ)
    else:
        root, where = problem.path(source.root), (source.scene, source.frame, source.variation)
        if source.kind == "vkitti1":
            pair = datasets.load_vkitti1(root, *where, step=source.step)
        else:
            pair = datasets.load_vkitti2(root, *where, step=source.step)
    return replace(pair, name=problem.name)


def _load_files(problem: Problem, source: FilesInput) -> Pair:
    ref, next_ = read_image(problem.path(source.ref)), read_image(problem.path(source.next))
    if ref.shape != next_.shape:
        raise DataError(
            "the two images differ in size",
            where=f"{source.ref}, {source.next}",
            found=f"{ref.shape[1]}x{ref.shape[0]} and {next_.shape[1]}x{next_.shape[0]}",
            expected="the same size",
        )
    truth = None
    if source.depth:
        truth = Truth(depth_ref=read_depth(problem.path(source.depth)), unit="file")
    K_next = source.intrinsics_next or source.intrinsics
    return Pair(ref, next_, intrinsics(*source.intrinsics), intrinsics(*K_next), truth=truth)


def load_flow_of(problem: Problem, pair: Pair) -> Flow:
    """The flow that a problem asks for."""
    source = problem.flow.source
    if source.endswith((".flo", ".png", ".npy")):
        source = str(problem.path(source))
    return resolve_flow(pair, source)


def _tell(say: Callable[[str], None] | None, line: object) -> None:
    if say:
        say(str(line))


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
        listener: Called at every iteration of Ipopt.
        stop: Set it to end with the best iterate.
        say: Called with a line after every stage.
        ipopt_log: File for Ipopt's own log.

    Raises:
        SoupError: the input cannot be used.
    """
    seconds: dict[str, float] = {}
    clock = time.perf_counter()

    def lap(stage: str) -> None:
        nonlocal clock
        now = time.perf_counter()
        seconds[stage] = seconds.get(stage, 0.0) + now - clock
        clock = now

    pair = pair or load_pair(problem)
    lap("load")
    flow = pair.flow or load_flow_of(problem, pair)
    pair = pair.with_flow(flow)
    lap("flow")
    _tell(say, pair)
    s = problem.segmentation
    labels = segment(pair.image_ref, s.superpixels, s.method, s.compactness, s.smoothing_px)
    samples = None if s.boundary_samples == "all" else s.boundary_samples
    seg = build_segmentation(labels, pair.image_ref, s.neighbours, s.beta, s.beta_colour, samples)
    lap("segmentation")
    _tell(say, seg)
    options = StartOptions(**{**problem.start.model_dump(), "seed": problem.seed})
    start = propose(seg, flow, pair.K_ref, pair.K_next, options)
    lap("start")
    _tell(say, start)
    e = problem.energy
    pixels = None if e.pixel_samples == "all" else e.pixel_samples
    data = build_energy_data(
        seg, flow, pair.K_ref, pair.K_next, pixels, problem.seed, e.arap_at_anchors
    )
    if e.units == "pixel":
        data = in_pixels(data, start.soup, seg, e.rotation_px)
    weights = Weights(**e.weights.model_dump())
    solver = problem.solver.model_dump()
    solver["presolve_eps"] = tuple(solver["presolve_eps"])
    solution = solve_soup(
        start.soup,
        data,
        weights,
        Formulation(**problem.formulation.model_dump()),
        SolverOptions(**solver),
        listener=listener,
        stop=stop,
        say=say,
        log_file=ipopt_log,
    )
    lap("nlp")
    size = pair.image_next.shape[0], pair.image_next.shape[1]
    before, after = (
        reconstruct(x, labels, pair.K_ref, pair.K_next, size) for x in (start.soup, solution.soup)
    )
    metrics = score(pair, before, after, problem.expected.scale)
    lap("evaluation")
    nlp = {f"nlp_{k}": v for k, v in solution.seconds.items()}
    return Run(
        problem,
        pair,
        seg,
        start,
        data,
        weights,
        solution,
        before,
        after,
        metrics,
        {**seconds, **nlp},
    )


def solve_pair(pair: Pair, **options: Any) -> Run:
    """Solve a pair that is in memory.

    Args:
        pair: Images, cameras, and a flow if there is one (else OpenCV DIS).
        options: Sections of a problem file, e.g. `segmentation={"superpixels": 500}`.
    """
    raw = {"name": pair.name, "input": {"kind": "motorcycle"}, **options}
    return run(make_problem(raw, where="solve_pair"), pair=pair)


def score(
    pair: Pair, before: Reconstruction, after: Reconstruction, scale: str = "median"
) -> dict[str, DepthMetrics]:
    """Metrics of start, solution, a constant depth and one rigid motion; {} without truth."""
    if pair.truth is None:
        return {}
    depths = {"solution": after.depth_ref, "start": before.depth_ref}
    # where no rigid motion can be fitted the row is absent
    with contextlib.suppress(DataError):
        depths["rigid"] = rigid_depth(pair).depth
    return score_depths(pair.truth, depths, scale)


def score_depths(
    truth: Truth, depths: Mapping[str, Float], scale: str = "median", cap: float | None = None
) -> dict[str, DepthMetrics]:
    """Metrics of named depth maps against dense or sparse truth, constant depth beside them."""
    out: dict[str, DepthMetrics] = {}
    gt = truth.depth_ref
    for name, depth in depths.items():
        estimate, reference = (depth, gt)
        if gt is None:
            if truth.points is None:
                return {}
            estimate, reference = sample_at_points(depth, truth.points)
        assert reference is not None
        out[name] = depth_metrics(estimate, reference, scale=scale, cap=cap)  # type: ignore[arg-type]
        if "constant" not in out:
            out["constant"] = constant_depth_metrics(reference, scale=scale, cap=cap)  # type: ignore[arg-type]
    return out


def evaluate(
    folder: str | Path,
    depth: str | Path,
    *,
    scale: str = "median",
    cap: float | None = None,
) -> dict[str, DepthMetrics]:
    """Score the depth of a result folder against a truth file.

    Args:
        folder: Result folder.
        depth: .dpt, .npy, .pfm or 16-bit .png depth of the reference frame.
        scale: "median", "mre", "lsq" or "none".
        cap: Truth beyond this depth is dropped.

    Raises:
        DataError: a file is missing or sizes differ.
    """
    from soup_nlp.report.store import read_h5, require

    tree = read_h5(Path(folder) / "result.h5")
    estimate, start = require(tree, "depth/ref"), require(tree, "depth/start_ref")
    gt = read_depth(Path(depth))
    if gt.shape != estimate.shape:
        raise DataError(
            "truth and result differ in size", where=depth, found=gt.shape, expected=estimate.shape
        )
    truth = Truth(depth_ref=np.asarray(gt, float))
    return score_depths(truth, {"solution": estimate, "start": start}, scale, cap)
