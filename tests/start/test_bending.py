"""Surfaces that bend are told from components that move apart, and solved without rigid pieces."""

import json
from dataclasses import replace
from functools import cache

import h5py
import numpy as np
import pytest
from helpers_files import sets
from helpers_start import fitted, flow_of, scene_problem, squares
from helpers_truth import majority

from soup_nlp.arrays import Mask
from soup_nlp.cli.main import main
from soup_nlp.config.problem import Problem, load_problem
from soup_nlp.data.pair import Pair
from soup_nlp.evaluation.metrics import UNSCALED, depth_metrics
from soup_nlp.geometry import rotation
from soup_nlp.geometry.graph import connected
from soup_nlp.geometry.soup import Soup, reconstruct
from soup_nlp.model.energy_options import BENDING_ARAP
from soup_nlp.pipeline.case import prepare, solver_options
from soup_nlp.pipeline.record import Case
from soup_nlp.solve.stages import solve_soup
from soup_nlp.start.bending import (
    ANY_TURN,
    AT_REST,
    REFERENCE,
    constant_depth,
    discontinuous,
    fit_turn,
    joined,
    turn_alone,
)
from soup_nlp.start.labelling import IN_NOISE, LEAST_NOISE, Labelling, dominant, labelled
from soup_nlp.start.views import FlowFit

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("simple_starts")]

UNORDERED = "energy.weights.order=0"  # leaves out the order that occlusion shows


def size(scene: str) -> tuple[int, int]:
    """Columns and rows; in a smaller banner the flow jumps too little along its outline."""
    return (512, 218) if scene == "banner" else (320, 136)


def problem(scene: str, *overrides: str) -> Problem:
    return scene_problem(scene, *size(scene), 150, *overrides)


@cache
def rendered(scene: str) -> Pair:
    return problem(scene).load_pair()


@cache
def case(scene: str, *overrides: str) -> Case:
    return prepare(problem(scene, *overrides), pair=rendered(scene))


def fit(c: Case) -> FlowFit:
    """The flow of a case's superpixels."""
    return fitted(c.pair, c.segmentation)


def test_sheet_bends_and_can_be_told_not_to():
    for c in (case("sheet"), case("sheet", UNORDERED)):
        assert c.start.bending
        assert c.start.bends.all()
        assert c.data.arap_at_anchors
    assert c.start.order is None
    assert (c.start.component == 0).all()
    np.testing.assert_allclose(c.soup.depth_at(c.data.anchor_ray), 1.0, rtol=1e-9)
    # occlusion shows the sheet before strips of the wall, which become components behind it
    ordered = case("sheet")
    z, front = ordered.soup.depth_at(ordered.data.anchor_ray), ordered.start.component == 0
    assert 0.9 < front.mean() < 1
    assert np.ptp(z[front]) < 1e-9
    assert (z[~front] > z[front].max()).all()
    assert not case("sheet", "start.bending=false").start.bending


@pytest.mark.parametrize("count", [60, 300])
@pytest.mark.parametrize(
    ("scene", "least", "most"), [("sheet", 0.9, 1), ("banner", 0.2, 0.4), ("street", 0, 0)]
)
def test_the_decision_does_not_depend_on_the_number_of_superpixels(scene, least, most, count):
    start = case(scene, f"segmentation.superpixels={count}").start
    assert least <= start.bends.mean() <= most


def test_a_bending_region_whose_flow_jumps_is_discontinuous():
    seg = squares(6, 20)
    column = seg.anchors[:, 0] // 8
    left, cut = column < 10, seg.across(column == 5)
    one = np.zeros(len(seg), int)
    jump = np.where(cut, 1.0, 0.05)

    def found(surface: np.ndarray, bends: np.ndarray, usable: np.ndarray | None = None) -> Mask:
        return discontinuous(flow_of(seg, jump, usable), surface, bends)

    # one column moves by itself inside the left half, nothing does inside the right one
    np.testing.assert_array_equal(found(one, left), left)
    assert not found(one, ~left).any()
    np.testing.assert_array_equal(found(one, left | (column > 12)), left)
    # neither an outline nor an unusable flow tears a surface
    assert not found((column == 5).astype(int), left).any()
    assert not found(one, left, column != 5).any()


def test_small_surfaces_join_the_neighbour_with_the_longest_outline():
    seg = squares(2, 30)
    column = (seg.anchors[:, 0] // 8).astype(int)
    surface = np.where(column < 10, 0, np.where(column == 10, 1, 2))
    usable = np.ones(len(seg), bool)

    def joined_where(usable: np.ndarray) -> np.ndarray:
        return joined(flow_of(seg, np.zeros(len(seg.pairs)), usable), surface)

    # two superpixels of sixty: both outlines are equally long, so the first neighbour is taken
    np.testing.assert_array_equal(joined_where(usable), np.where(column < 11, 0, 2))
    # without usable flow a surface is small, however many superpixels it has
    np.testing.assert_array_equal(joined_where(column >= 11), 2)
    np.testing.assert_array_equal(joined_where(~usable), joined_where(~usable)[0])


def test_a_bending_surface_is_found_beside_rigid_ones():
    c = case("banner")
    start, true = c.start, majority(c.pair.truth, c.segmentation)[0]
    assert 0.2 < start.bends.mean() < 0.5
    np.testing.assert_array_less(0.93, np.mean(start.bends == (true == 1)))
    # it is one component without shared motions; other superpixels have those of a rigid scene
    assert len(np.unique(start.component[start.bends])) == 1
    assert not np.isin(start.component[~start.bends], start.component[start.bends]).any()
    assert (start.motion[start.bends] == -1).all()
    assert (start.motion[~start.bends] == 0).mean() > 0.9
    assert not case("banner", "start.bending=false").start.bending


@pytest.mark.xfail(strict=True, reason="the flow jumps too little: MRE 0.06, 0.03 at most if found")
def test_a_bending_surface_is_found_in_a_small_picture():
    small = problem("banner", "input.width=320", "input.height=136")
    assert 0.2 < prepare(small).start.bends.mean() < 0.5


def test_depth_starts_on_one_plane_where_the_camera_is_at_rest():
    """An upright scene recedes upwards; nothing tells more."""
    c = case("still", UNORDERED)
    assert c.start.at_rest
    assert c.start.bending
    mu, ray = 1 / c.soup.depth_at(c.data.anchor_ray), c.data.anchor_ray
    plane = np.linalg.lstsq(ray, mu)[0]
    np.testing.assert_allclose(ray @ plane, mu, rtol=1e-9)
    assert plane[0] == pytest.approx(0.0, abs=1e-9)
    assert plane[1] > 0.1
    # parts that occlude the background come nearer than its plane
    ordered = case("still")
    z = ordered.soup.depth_at(ordered.data.anchor_ray) * (ordered.data.anchor_ray @ plane)
    background = ordered.start.component == 0
    np.testing.assert_allclose(z[background], z[background][0], rtol=1e-9)
    assert (z[~background] < z[background].min()).all()


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.02, -0.05, 0.03)])
@pytest.mark.parametrize("longer", [1.0, 1.4])
def test_a_turn_is_found_despite_wrong_focal_length_and_movers(turn, longer):
    c = case("street")
    views = fit(c).views
    R = rotation.exp(np.array(turn))
    scale = np.array([longer, longer, 1.0])
    target = (views.ray * scale) @ R.T / scale
    target = target / target[..., 2:]
    moves = np.arange(len(target)) % 5 == 0
    target[moves, :, 0] += 20.0 / views.focal[0]
    R_fitted, error = fit_turn(replace(views, target=target))
    np.testing.assert_allclose(R_fitted, R, atol=2e-4)
    assert error[~moves].max() < 0.1
    assert error[moves].min() > 15.0
    # no translation is made of it
    if longer == 1.0:
        still = ~moves
        soup, left = constant_depth(replace(views, target=target), R)
        np.testing.assert_allclose(soup.R[still] - R, 0.0, atol=1e-6)
        assert left[still].max() < 1e-6


def quiet_orbit(**changes: object) -> tuple[FlowFit, Labelling]:
    """The changed flow of a moving camera, with a noise of 0.02 px, and its labels."""
    c = case("orbit")
    flow = fit(c)._replace(residual=np.full(len(c), 0.02 * np.sqrt(REFERENCE / len(c))), **changes)
    return flow, labelled(
        flow, [dominant(flow)], connected(flow.seg.pairs[flow.jump < 1], len(flow.seg))
    )


def test_depth_that_explains_the_flow_is_no_turn():
    flow, choice = quiet_orbit(jump=np.zeros(len(case("orbit").segmentation.pairs)))
    assert flow.views.usable.all()
    assert turn_alone(flow, choice) is None
    # the same flow with the depths taken out of it
    turned = flow.views.ray @ choice.motions[0].R.T
    still = replace(flow.views, target=turned / turned[..., 2:])
    assert turn_alone(flow._replace(views=still), choice) is not None


@pytest.mark.parametrize(
    ("scene", "widths", "overrides"),
    [
        ("room", (0.3, 0.03, 0.01), ()),
        ("sheet", (0.1, 0.03, 0.01), ()),
        # all widths above the limit are one stage
        ("sheet", (0.1, 0.02), ("solver.presolve_eps=[1.0, 0.3, 0.02]",)),
    ],
)
def test_bending_surfaces_have_a_narrower_presolve_of_two_strategies(scene, widths, overrides):
    """One strategy truncates E_arap from the start, the other at its end only."""
    options = solver_options(problem(scene, *overrides), case(scene).start)
    assert options.presolve_eps == widths
    assert options.untruncated == (scene == "sheet")


@pytest.mark.parametrize(
    ("scene", "count", "words", "most"),
    [("sheet", 80, "100% bending", {}), ("banner", 150, "bending", {0: 0.04, 1: 0.12})],
)
def test_bending_regions_are_reconstructed_and_every_claim_holds(
    tmp_path, capsys, scene, count, words, most
):
    """Both kinds of regions are in one image; `most` limits the MRE of each component."""
    width, height = size(scene)
    sized = f"input.width={width} input.height={height} segmentation.superpixels={count}"
    sized += " flow.source=truth expected.mre_at_most=null"
    main(["solve", scene, "--out", str(tmp_path), "--no-refine", *sets(sized)])
    assert words in (tmp_path / "log.txt").read_text()
    assert main(["check", str(tmp_path)]) == 0, capsys.readouterr().out
    summary = json.loads((tmp_path / "summary.json").read_text())
    # without refinement the NLP's soup is delivered
    assert summary["refinement"] is None
    assert summary["energy"]["nlp"] == summary["energy"]["solution"]
    assert load_problem(tmp_path / "config.yaml").refine.enabled is False
    metrics = summary["metrics"]
    assert "nlp" not in metrics
    assert metrics["solution"]["mre"] < 0.6 * metrics["constant"]["mre"]
    truth = rendered(scene).truth
    with h5py.File(tmp_path / "result.h5") as file:
        z = file["depth/ref"][:] * metrics["solution"]["scale"]
    for component, limit in most.items():
        true_depth = np.where(truth.components == component, truth.depth_ref, np.nan)
        assert 1e-4 < depth_metrics(z, true_depth, UNSCALED).mre < limit


def own_relief(c: Case, soup: Soup) -> float:
    """Mean relative error of the sheet's depth in its own median scale."""
    z = reconstruct(soup, c.segmentation.labels, c.pair.K_ref, c.pair.K_next).depth_ref
    gt = c.pair.truth.depth_ref
    return depth_metrics(z, np.where(c.pair.truth.components == 1, gt, np.nan)).mre


@pytest.mark.parametrize("scene", ["room", "orbit"])
def test_rigid_components_before_a_moving_camera_do_not_bend(scene):
    start = case(scene).start
    assert not start.at_rest
    assert not start.bending


@pytest.mark.xfail(strict=True, reason="the whole image bends: the price of simpler surfaces")
@pytest.mark.parametrize(
    ("seed", "least"),
    # small jumps join the banner of 1 to its room; the outline of 3 has no discontinuity: a
    # compromise motion has more inliers than that of the room
    [(1, 0.3), (3, 0.25)],
)
def test_a_rigid_room_does_not_bend_with_its_banner(seed, least):
    banner = problem("banner", f"input.seed={seed}")
    start = prepare(banner, pair=banner.load_pair()).start
    assert least < start.bends.mean() < 0.4


def test_regions_that_bend_have_their_own_weights_in_one_energy():
    c, rigid = case("banner"), case("banner", "start.bending=false")
    weights, bends = c.weights, c.start.bends
    assert weights == rigid.weights
    # only the truncation changes where the whole image bends
    assert case("sheet").weights == weights.replace(**BENDING_ARAP)
    assert c.data.arap_at_anchors
    focal = float(c.data.K_next[0, 0])
    any_end = bends[c.data.edges].any(axis=1)
    np.testing.assert_allclose(c.data.rotation_scale, np.where(any_end, 1e-3, focal))
    both = bends[c.data.pairs].all(axis=1)
    orient_ratio = 4.0 * len(c) / 1000 / weights.orient
    np.testing.assert_allclose(c.data.orient_weight, np.where(both, 2.0 * orient_ratio, 2.0))
    # elsewhere the weights are those of a scene without bending
    outside = ~bends[c.data.pairs].any(axis=1)
    np.testing.assert_array_equal(c.data.pair_weight[outside], c.segmentation.pair_weight[outside])


def test_depth_within_three_noises_of_the_flow_is_not_seen():
    c, (flow, choice) = case("orbit"), quiet_orbit()
    choice = replace(choice, label=np.zeros(len(c), int), excess=0)
    error = float(np.quantile(fit_turn(flow.views, ANY_TURN)[1], AT_REST))
    assert error > 320 / 512  # 1 px at 512 columns
    # the residual of affine flows is part of the error
    part = np.sqrt(REFERENCE / len(c))
    for share, sees in ((0.95, True), (1.05, False)):
        residual = np.full(len(c), share * error / (IN_NOISE + part) * part)
        assert (turn_alone(flow._replace(residual=residual), choice) is None) == sees


def test_a_stabilised_turn_is_a_turn():
    """The next image is moved back by stabilisation; the rotation is that of the plain turn."""
    flow, choice = quiet_orbit()
    target = flow.views.ray @ rotation.exp(np.array([0.02, -0.2, 0.05])).T
    target = 1.03 * target / target[..., 2:] + np.array([0.2, 0.02, 0.0])
    target[..., 2] = 1.0
    stabilised = flow._replace(views=replace(flow.views, target=target))
    turn = turn_alone(stabilised, choice)
    assert turn is not None
    plain, error = fit_turn(stabilised.views)
    assert np.median(error) > 1.0
    np.testing.assert_allclose(turn, plain, atol=0.01)


def test_noise_where_surfaces_bend_is_that_of_affine_flows():
    """The error of a start without relief is no noise."""
    quiet = case("sheet", "segmentation.superpixels=100").start
    assert quiet.noise == LEAST_NOISE
    assert np.median(quiet.error) > LEAST_NOISE
    noisy = prepare(scene_problem("sheet", 768, 327, 150, "flow.source=truth+noise:0.11")).start
    assert noisy.bending
    assert 2 * LEAST_NOISE < noisy.noise < 0.5


def test_the_order_by_occlusion_leaves_a_sheet_its_relief():
    # without E_prior, which flattens relief; with fewer superpixels nothing is ordered
    c = case("sheet", "segmentation.superpixels=120", "energy.weights.prior=0.0")
    assert c.data.order_weight.any()
    answer = solve_soup(c.soup, c.data, c.weights, c.formulation(), c.options)
    assert own_relief(c, answer.soup) < 0.1 * own_relief(c, c.soup)
