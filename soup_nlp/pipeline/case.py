"""A problem ready for any solver: pair, segmentation, start and energy."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from soup_nlp.config.problem import Problem
from soup_nlp.data.flow.borders import follow_depth, follow_flow
from soup_nlp.data.flow.consistency import SURE
from soup_nlp.data.flow.epipolar_search import searched
from soup_nlp.data.flow.layers import corrected, still
from soup_nlp.data.flow.sources import is_named
from soup_nlp.data.formats.cameras import GUESS_SIGMA
from soup_nlp.data.pair import Flow, Pair
from soup_nlp.data.working_size import resized_flow, working_size
from soup_nlp.geometry.graph import Segmentation, build_segmentation
from soup_nlp.geometry.superpixels import Labels, check_count, segment
from soup_nlp.model.energy_data import EnergyData, build_energy_data
from soup_nlp.model.energy_options import BENDING_ARAP, WIDEST_BENDING_EPS, Weights
from soup_nlp.model.reweighting import Known, in_pixels, in_translations, weighted
from soup_nlp.pipeline.record import Case
from soup_nlp.solve.solver_options import ITERATIONS, Stages
from soup_nlp.solve.stages import solve_soup
from soup_nlp.start.camera_error import camera_error
from soup_nlp.start.epipolar import estimate, flow_matches
from soup_nlp.start.given_depth import GivenDepth, by_prior
from soup_nlp.start.prior_evidence import JUDGED_PIECES, LEAST_SIGMA, PriorEvidence, judged
from soup_nlp.start.propose import Start, most_usual, propose
from soup_nlp.start.regions import ORIGINS, TOO_FAST, covering
from soup_nlp.start.views import FlowFit
from soup_nlp.storage.progress import Watch
from soup_nlp.storage.system import require_memory


def _silent(line: str) -> None:
    """Tell nobody."""


def prepare(
    problem: Problem,
    presolve: bool = False,
    *,
    pair: Pair | None = None,
    log: Callable[[str], None] = _silent,
    on_stage: Callable[[str], None] = _silent,
) -> Case:
    """Load, segment, start and weight a problem: everything before a solve.

    Args:
        problem: See `config.load_problem`.
        presolve: Let solvers start where the tangent presolve ends.
        pair: Images and cameras, instead of the problem's input; its flow is used when it has one.
        log: Called with a line after every stage.
        on_stage: Called with the name of a stage at its end: "load", "flow", "segmentation",
            "start".
    """
    full, pair, labels, seg = _observed(problem, pair, log, on_stage)
    begun, evidence, given_depth = _begun(problem, pair, seg), None, None
    if pair.depth_prior is not None and problem.energy.weights.depth > 0:
        begun, evidence = _judged(problem, labels, begun)
    start, _, flow = begun
    seg = flow.seg
    if evidence is not None:
        start, given_depth = by_prior(*begun, evidence)
        log(str(evidence))
    log(str(start))
    on_stage("start")
    data, weights = build_energy(problem, pair, seg, start, given_depth)
    stages = solver_options(problem, start)
    larger = None if pair.size == full.size else full
    parts = problem, pair, seg, start, data, weights, start.soup, stages
    case = Case(*parts, larger, given_depth)
    if not presolve:
        return case
    # a solve has at least one iteration of the constrained NLP
    limit = stages.presolve_iterations or ITERATIONS
    once = stages.replace(presolve_iterations=limit, max_iter=1)
    answer = solve_soup(start.soup, data, weights, case.formulation(), once, watch=Watch(say=log))
    return replace(case, soup=answer.soup)


def observed_pair(problem: Problem) -> Pair:
    """The pair of a problem with its flow, and the focal length by it where it was a guess."""
    return _observed(problem)[1]


def _observed(
    problem: Problem,
    pair: Pair | None = None,
    log: Callable[[str], None] = _silent,
    on_stage: Callable[[str], None] = _silent,
) -> tuple[Pair, Pair, Labels, Segmentation]:
    """Everything before the start: the pair in full size, the pair that is solved, labels and
    graphs of the superpixels; see `prepare`."""
    full = problem.depth_prior.load(pair or problem.load_pair(), problem.path)
    pair = working_size(full, problem.max_size)
    check_fits(problem, pair)
    if pair is not full:
        (h, w), (rows, columns) = full.size, pair.size
        log(f"{w}x{h} is solved at {columns}x{rows} (max_size {problem.max_size:g} megapixels)")
    on_stage("load")
    pair = with_flow(problem, full, pair, log)
    log(str(pair))
    on_stage("flow")
    labels = superpixels(problem, pair)
    seg = segmented(problem, pair, labels)
    log(str(seg))
    on_stage("segmentation")
    if pair.focal_sigma >= GUESS_SIGMA:
        matches = _flow_fit(problem, pair, seg).views.matches()
        error = camera_error(matches, "focal length", pair.focal_sigma)
        better = float(np.exp(error.mean)), error.deviation
        full, pair = full.with_focal(*better), pair.with_focal(*better)
        log(f"focal length {pair.K_ref[0, 0]:.0f} px by the flow, right to {better[1]:.0%}")
    return full, pair, labels, seg


Begun = tuple[Start, Pair, FlowFit]
"""A start, its pair, and the flow of its superpixels as affine maps."""


def segmented(problem: Problem, pair: Pair, labels: Labels) -> Segmentation:
    """Superpixels with their graphs."""
    s = problem.segmentation
    samples = None if s.boundary_samples == "all" else s.boundary_samples
    return build_segmentation(labels, pair.image_ref, s.neighbours, boundary_samples=samples)


STARTS = 3
"""Number of starts, each from other samples of the flow, of which the most usual is taken."""


def _flow_fit(problem: Problem, pair: Pair, seg: Segmentation, sample: int = 0) -> FlowFit:
    """The flow of a pair as affine maps, fitted to one of its samples."""
    assert pair.flow is not None
    seen = pair.flow, pair.K_ref, pair.K_next
    return FlowFit.of(seg, *seen, problem.start, problem.seed ^ sample)


def _begun(problem: Problem, pair: Pair, seg: Segmentation) -> Begun:
    """The most usual of several starts on given superpixels, without a depth prior."""

    def started(sample: int) -> tuple[Start, FlowFit]:
        fitted = _flow_fit(problem, pair, seg, sample)
        contrast = covering(pair, fitted) if problem.energy.weights.order > 0 else None
        return propose(fitted, contrast), fitted

    count = 1 if problem.start.method == "homography" else STARTS
    starts, flows = zip(*map(started, range(count)), strict=True)
    best, start = most_usual(starts, seg, flows[0].views.anchor)
    return start, pair, flows[best]


def _judged(problem: Problem, labels: Labels, begun: Begun) -> tuple[Begun, PriorEvidence]:
    """Judge the depth prior of a pair, and return the start for it with the evidence.

    Superpixels follow a prior that is used although the flow does not confirm it.
    """
    s, pair, few = problem.segmentation, begun[1], begun
    if s.superpixels > JUDGED_PIECES:
        pieces = superpixels(problem, pair, JUDGED_PIECES)
        few = _begun(problem, pair, segmented(problem, pair, pieces))
    evidence = judged(*few, problem.depth_prior.kind)
    if evidence.used and not evidence.confirmed and s.follow_flow_px is not None:
        assert pair.depth_prior is not None
        # the flow does not show where surfaces end
        followed = follow_depth(labels, evidence.log_depth(pair.depth_prior))
        begun = _begun(problem, pair, segmented(problem, pair, followed))
    return begun, evidence


def superpixels(problem: Problem, pair: Pair, count: int | None = None) -> Labels:
    """The superpixels of a problem, or `count` of them, on a pair that carries its flow."""
    assert pair.flow is not None
    s = problem.segmentation
    labels = segment(pair.image_ref, count or s.superpixels, s.method)
    return labels if s.follow_flow_px is None else follow_flow(labels, pair.flow, s.follow_flow_px)


def solver_options(problem: Problem, start: Start) -> Stages:
    """The solver's options of a problem, the smoothing no wider than bending surfaces allow."""
    solver = Stages(**dict(problem.solver))
    if not start.bending or problem.energy.units != "pixel":
        return solver
    # widths above the limit become the limit, which then occurs once
    eps = dict.fromkeys(min(e, WIDEST_BENDING_EPS) for e in solver.presolve_eps)
    # E_arap truncated from the beginning tears bending surfaces; beside rigid regions E_arap
    # without truncation lets the scales of components slide
    return solver.replace(presolve_eps=tuple(eps), untruncated=bool(start.bends.all()))


def build_energy(
    problem: Problem,
    pair: Pair,
    seg: Segmentation,
    start: Start,
    given_depth: GivenDepth | None = None,
) -> tuple[EnergyData, Weights]:
    """The energy of a problem, on a pair that carries its flow."""
    assert pair.flow is not None
    e, weights = problem.energy, Weights(**dict(problem.energy.weights))
    pixels = None if e.pixel_samples == "all" else e.pixel_samples
    bends = start.bends & (e.units == "pixel")
    anchors = bool(bends.any())
    data = build_energy_data(seg, pair.flow, pair.K_ref, pair.K_next, pixels, problem.seed, anchors)
    data = replace(data, pixel_weight=np.where(start.wrong[:, None], 0.0, data.pixel_weight))
    prior = None
    if given_depth is not None and given_depth.evidence.used:
        prior = given_depth.log_depth, given_depth.ambiguity, given_depth.error
    elif start.at_rest:
        # nothing is measured: terms on shape must not undo what is drawn
        drawn, one = np.log(start.soup.depth_at(data.anchor_ray)), np.ones(len(seg))
        prior = drawn, one, LEAST_SIGMA * one
    placed = np.isin(start.origin, [ORIGINS.index("occlusion"), TOO_FAST])
    known = Known(start.component, bends, start.variance, start.noise, start.order, placed, prior)
    data = weighted(data, start.soup, known, e)
    if e.units == "paper":
        return in_translations(data, start.soup), weights
    # what the truncation of E_arap is follows from all of the image
    weights = weights.replace(**BENDING_ARAP) if bends.all() else weights
    return in_pixels(data, start.soup, seg, bends), weights


# --- the flow, searched again where the camera's motion tells more -------------------------------

LEAST_SHARE = 0.003
"""Least share of pixels that stand still for the search for a layer."""
LEAST_FLOW = 2.0
"""Median displacement and parallax, pixels, below which the camera may be at rest, or turn only."""


def with_flow(
    problem: Problem, full: Pair, pair: Pair, log: Callable[[str], None] = _silent
) -> Pair:
    """A pair with its flow; one that is computed here is searched again by the camera's motion.

    If a layer stands still, the scene behind it is searched for, else what is not sure. A flow that
    the pair has is taken as it is. `full` is the pair at its own size; `log` is called with a line
    if there is such a layer.
    """
    if pair.flow is not None:
        return pair
    if pair is not full and problem.flow.is_file():
        # a flow file has the size of the original images
        flow = resized_flow(problem.flow.load(full, problem.path), full, pair)
    else:
        flow = problem.flow.load(pair, problem.path)
    pair = pair.with_flow(flow)
    computed = is_named(flow.source) and not flow.source.startswith("truth")
    if not (computed and problem.flow.consistency and pair.size == pair.image_next.shape[:2]):
        return pair
    behind = see_through(pair, problem.seed)
    if behind is None:
        return pair.with_flow(search_again(pair, problem.seed))
    log("a layer stands still before the scene: flow searched for behind it")
    return pair.with_flow(behind)


def see_through(pair: Pair, seed: int = 0) -> Flow | None:
    """The flow of the moving scene behind a still layer, of a flow computed from the images.

    None if no pixel stands still, if all may, or if the images do not contradict the flow of those
    that do.
    """
    flow = pair.flow
    assert flow is not None
    at_rest, sure = still(flow), flow.confidence > SURE
    if at_rest.mean() < LEAST_SHARE:
        return None
    if np.median(np.linalg.norm(flow.uv[sure], axis=1)) < LEAST_FLOW:
        return None
    motion = estimate(flow_matches(pair, sure & ~at_rest, seed))
    if motion is None:
        return None
    return corrected(pair, motion.R, motion.t)


def search_again(pair: Pair, seed: int = 0) -> Flow:
    """The flow of a pair, searched for along the epipolar lines of the camera's motion (`searched`)
    unless the camera is at rest or turns only: then its lines are chance."""
    flow = pair.flow
    assert flow is not None
    matches = flow_matches(pair, flow.confidence > SURE, seed)
    motion = estimate(matches)
    if motion is None:
        return flow
    turned = matches.ray @ motion.R.T
    parallax = np.linalg.norm((turned / turned[:, 2:] - matches.target)[:, :2], axis=1)
    if np.median(matches.focal * parallax) < LEAST_FLOW:
        return flow
    return searched(pair, motion.R, motion.t)


# --- memory, estimated before a solve ---------------------------------------------------------

PIXEL = 800
"""Bytes per pixel of the reference image: flow in both directions, superpixels, maps, pictures."""
ROW = 5_000
"""Bytes per sampled pixel or boundary point: a row of data and a share of the derivatives."""
EDGE = 20_000
"""Bytes per edge and neighbour pair in the two programs and their factors."""
NEIGHBOURS = 3
"""Neighbour pairs per superpixel; a planar graph has no more."""


def check_fits(problem: Problem, pair: Pair) -> None:
    """Raise DataError for more superpixels than the image has room for, or too little memory."""
    check_count(problem.segmentation.superpixels, *pair.size)
    parts = solve_bytes(problem, pair)
    shares = ", ".join(f"{name} {size / 1e9:.3g} GB" for name, size in parts.items())
    hint = "smaller images with their intrinsics, or lower the option behind the largest part"
    require_memory(sum(parts.values()), "this problem", shares, hint)


def solve_bytes(problem: Problem, pair: Pair) -> dict[str, float]:
    """Bytes of a solve, right within a factor of two, by measured part: option, or the images."""
    s, r = problem.segmentation, problem.refine
    pixels, n = pair.size[0] * pair.size[1], s.superpixels
    graph = n * (s.neighbours + NEIGHBOURS)
    # a superpixel has no more samples than pixels, and no more boundary points than its outline
    sampled = problem.energy.pixel_samples
    inside = pixels if sampled == "all" else min(pixels, n * sampled)
    around = 4 * (pixels / n) ** 0.5
    points = around if s.boundary_samples == "all" else min(around, s.boundary_samples)
    tables = 2.0 * graph * r.particles**2 * 8 if r.enabled else 0.0
    return {
        "images": PIXEL * pixels,
        "energy.pixel_samples": ROW * inside,
        "segmentation.boundary_samples": ROW * n * NEIGHBOURS * points,
        "segmentation.superpixels and neighbours": EDGE * graph,
        "refine.particles": tables,
    }
