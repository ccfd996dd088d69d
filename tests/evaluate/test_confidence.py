"""Marginal variances of depth: dense inverses, derivatives, scale, missing flow, calibration."""

from dataclasses import replace

import numpy as np
import pytest
from helpers_model import directional
from scipy import ndimage, sparse

from soup_nlp.config.problem import make_problem
from soup_nlp.data.formats.cameras import GUESS_SIGMA
from soup_nlp.data.pair import Flow
from soup_nlp.evaluate import information as information_module
from soup_nlp.evaluate.confidence import (
    BENDING_FACTOR,
    BENDING_SIGMA,
    CONTACT,
    GUESSED,
    LEAST_SPREAD,
    MIXED,
    MOST_SIGMA,
    OUTLINE,
    POWER,
    SIGMA_PRIOR,
    USUAL,
    at_outlines,
    calibrated,
    confidence,
    flow_misfit,
    of_mixed_flow,
    scale_by_contact,
)
from soup_nlp.evaluate.information import information, learned, marginals, spread_in_image
from soup_nlp.geometry.camera import project
from soup_nlp.geometry.soup import reconstruct
from soup_nlp.model.formulation import Formulation
from soup_nlp.pipeline.case import prepare
from soup_nlp.solve.selected_inverse import BlockCholesky, layers
from soup_nlp.start.components import TIES
from soup_nlp.start.ground import STANDS
from soup_nlp.start.labelling import LEAST_NOISE

FORM = Formulation()


@pytest.fixture(scope="module")
def small_room(small_room):
    """The small room with a second component, whose scale is from contact."""
    second = np.arange(len(small_room.soup)) < 9
    tie = np.where(second, TIES.index("contact below"), TIES.index("reference"))
    start = replace(small_room.start, component=second.astype(int), tie=tie, off_ground=None)
    return replace(small_room, start=start)


@pytest.fixture(scope="module")
def info(small_room):
    return information(small_room.soup, small_room.data, small_room.weights, FORM)


@pytest.fixture(scope="module")
def dense(small_room, info):
    """Covariance with the mean log depth of all pixels fixed, by a dense inverse."""
    sizes = small_room.segmentation.sizes
    mean = np.zeros(len(info.growth))
    mean[::9] = -sizes / sizes.sum() / info.plane[:, 0]
    scale = 1 / np.sqrt(info.matrix.diagonal())
    scaled = info.matrix.toarray() * np.outer(scale, scale)
    # the fixed mean is a constraint: the KKT matrix is regular
    row = mean * scale
    row /= np.linalg.norm(row)
    kkt = np.block([[scaled, row[:, None]], [row[None], np.zeros((1, 1))]])
    return np.linalg.inv(kkt)[:-1, :-1] * np.outer(scale, scale)


def blocks_of(matrix: np.ndarray, size: int) -> np.ndarray:
    n = len(matrix) // size
    return matrix.reshape(n, size, n, size)[np.arange(n), :, np.arange(n)]


@pytest.mark.parametrize("seed", range(6))
def test_diagonal_blocks_equal_those_of_a_dense_inverse(seed):
    """Random graphs; the last four have uncoupled parts."""
    rng = np.random.default_rng(seed)
    n, size = 30, 3
    position = rng.uniform(0, 1, (n, 2))
    near = np.linalg.norm(position[:, None] - position, axis=-1) < (0.35 if seed < 2 else 0.15)
    J = rng.normal(size=(n * size, n * size)) * np.kron(near, np.ones((size, size)))
    A = J.T @ J * np.kron(near, np.ones((size, size))) + 40 * n * np.eye(n * size)
    solver = BlockCholesky(sparse.csr_matrix(A), position)
    inverse = np.linalg.inv(A)
    np.testing.assert_allclose(solver.inverse_blocks(), blocks_of(inverse, size), rtol=1e-8)
    b = rng.normal(size=(n * size, 2))
    np.testing.assert_allclose(solver.solve(b), inverse @ b, rtol=1e-7, atol=1e-12)
    order = layers(sparse.csr_matrix(near), position)
    assert len(order) > 2
    assert np.array_equal(np.sort(np.concatenate(order)), np.arange(n))
    for k, layer in enumerate(order):
        beyond = np.concatenate([*order[k + 2 :], np.zeros(0, int)])
        assert not near[np.ix_(layer, beyond)].any()


def test_a_matrix_that_is_not_positive_is_refused():
    with pytest.raises(ArithmeticError, match="diagonal"):
        BlockCholesky(sparse.csr_matrix(np.diag([1.0, 0.0])), np.zeros((2, 2)))
    with pytest.raises(ArithmeticError, match="positive definite"):
        BlockCholesky(sparse.csr_matrix([[1.0, 2.0], [2.0, 1.0]]), np.array([[0.0, 0], [1, 1]]))


def test_marginals_are_those_of_a_dense_inverse(small_room, info, dense):
    component = np.arange(len(small_room)) % 3
    variances = marginals(info, small_room.segmentation.sizes, component)
    np.testing.assert_allclose(
        variances.plane, blocks_of(dense, 9)[:, :3, :3], rtol=1e-4, atol=1e-12
    )
    for c in range(3):
        row = np.zeros(len(info.growth))
        weight = np.where(component == c, small_room.segmentation.sizes, 0)
        row[::9] = -weight / weight.sum() / info.plane[:, 0]
        assert variances.component[c] == pytest.approx(row @ dense @ row, rel=1e-4)


def test_all_depths_growing_alike_costs_nothing(info):
    size = abs(info.matrix) @ abs(info.growth)
    assert abs(info.matrix @ info.growth).max() < 1e-9 * size.max()


def test_the_variance_of_a_pixel_is_of_log_depth(small_room, info, dense):
    """Against finite differences of the log depth of a plane."""
    seg, K = small_room.segmentation, small_room.pair.K_ref
    variances = marginals(info, seg.sizes, np.zeros(len(small_room), int))
    sigma = spread_in_image(info, variances.plane, seg.labels, K)
    v, u = 40, 100
    i = seg.labels[v, u]

    def log_depth(x):
        z = reconstruct(info.layout.unpack(x), seg.labels, K, K).depth_ref
        # the length unit of the answer changes with every plane
        return np.log(z[v, u] / z[0, 0])

    # the start's planes were tilted until they face the camera
    x0, h = info.layout.pack(small_room.soup), 1e-5
    x0.reshape(-1, 9)[:, :3] = info.plane
    slope = np.zeros(9)
    for k in range(3):
        e = np.zeros(len(x0))
        e[9 * i + k] = h
        slope[k] = (log_depth(x0 + e) - log_depth(x0 - e)) / (2 * h)
    expected = np.sqrt(slope @ blocks_of(dense, 9)[i] @ slope)
    assert sigma[v, u] == pytest.approx(expected, rel=1e-4)


def test_pixels_beside_a_step_may_lie_on_either_side():
    log_depth = np.where(np.arange(400) < 200, 0.0, 0.4) * np.ones((60, 1))
    sigma = at_outlines(np.exp(log_depth))
    np.testing.assert_allclose(sigma[:, 198:202], 0.4 * OUTLINE, atol=1e-6)
    assert sigma[:, :190].max() == sigma[:, 210:].max() == 0
    slope = at_outlines(np.exp(np.linspace(0, 4, 400) * np.ones((60, 1))))
    assert slope[:, 10:-10].max() < 1e-5


def test_a_superpixel_with_partly_usable_flow_is_less_sure():
    """Superpixels of 10 columns: usable, half usable, not usable, leaving the image."""
    labels = np.repeat(np.arange(4), 10)[None] * np.ones((20, 1), np.int32)
    confidence = np.where(labels == 0, 1.0, 0.0)
    confidence[:10, labels[0] == 1] = confidence[:10, labels[0] == 3] = 1.0
    uv = np.where(labels[..., None] == 3, [30.0, 0.0], 0.0)
    flow = Flow(uv.astype(np.float32), confidence.astype(np.float32), "test")
    sigma = of_mixed_flow(flow, labels.astype(np.int32), (60, 60))
    np.testing.assert_allclose(sigma, [0, MIXED, MIXED, 0], atol=1e-3)


def test_calibration_is_capped_where_nothing_is_known():
    zero, most, endless = calibrated(np.array([0.0, 1e9, np.inf]), 0.1)
    assert zero == 0.0
    assert most == endless == pytest.approx(SIGMA_PRIOR)
    single, double = calibrated(np.array([0.001, 0.002]), 0.1)
    assert double / single == pytest.approx(2**POWER, rel=1e-4)
    assert calibrated(np.array([0.001]), 0.2)[0] == pytest.approx(double)
    # the prior's information is added to the pair's
    alone = calibrated(np.array([0.5]), 0.1, prior=np.inf)[0]
    assert calibrated(np.array([0.5]), 0.1)[0] ** -2 == pytest.approx(alone**-2 + SIGMA_PRIOR**-2)


def test_the_information_is_that_of_measured_pixels(small_room, monkeypatch):
    """With a smoothing wider than all errors it is w / eps times the squared motion of pixels."""
    wide = 300.0
    monkeypatch.setattr(information_module, "SMOOTHING", wide)
    others = dict.fromkeys(("arap", "cont", "orient", "prior", "depth", "order"), 0.0)
    weights = small_room.weights.replace(**others, sigma_proj=np.inf)
    data, info = small_room.data, information(small_room.soup, small_room.data, weights, FORM)

    def pixels(x):
        soup = info.layout.unpack(x)
        return project(data.K_next, soup.moved(soup.points(data.pixel_ray)))

    x = info.layout.pack(small_room.soup)
    x.reshape(-1, 9)[:, :3] = info.plane
    direction = np.random.default_rng(0).normal(size=len(x))
    squared = np.sum(directional(pixels, x, direction, 1e-4) ** 2, axis=-1)
    expected = weights.proj * np.sum(data.pixel_weight * squared) / wide
    assert direction @ info.matrix @ direction == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("term", ["arap", "proj", "cont", "prior"])
def test_a_smoothing_wider_than_all_errors_divides_the_information(term, small_room, monkeypatch):
    free = dict.fromkeys(("sigma_proj", "sigma_cont", "sigma_cont_ref", "sigma_arap"), np.inf)
    none = dict.fromkeys(("arap", "proj", "cont", "orient", "prior", "depth", "order"), 0.0)
    weights = small_room.weights.replace(**free, **none | {term: 1.0}, sigma_orient=np.inf)
    sizes = []
    for wide in (300.0, 600.0):
        monkeypatch.setattr(information_module, "SMOOTHING", wide)
        info = information(small_room.soup, small_room.data, weights, FORM)
        sizes.append(np.abs(info.matrix).sum())
    assert sizes[0] == pytest.approx(2 * sizes[1], rel=1e-3)


def sure_of(case, data=None, weights=None):
    K = case.pair.K_ref, case.pair.K_next
    rec = reconstruct(case.soup, case.segmentation.labels, *K)
    energy = data or case.data, weights or case.weights, FORM
    return confidence(rec, case.pair, case.start, *energy)


@pytest.fixture(scope="module")
def sure(small_room):
    """The uncertainty of the start of the small room."""
    return sure_of(small_room)


def test_an_undetermined_superpixel_has_the_sigma_of_the_prior(small_room, sure):
    blind = 25
    weight = small_room.data.pixel_weight.copy()
    weight[blind] = 0.0
    data = replace(small_room.data, pixel_weight=weight)
    loose = small_room.weights.replace(arap=1e-9, cont=1e-9, orient=1e-9)
    sigma = sure_of(small_room, data, loose).sigma
    inside = small_room.segmentation.labels == blind
    np.testing.assert_allclose(sigma[inside], SIGMA_PRIOR, rtol=0.02)
    assert sure.sigma[inside].mean() < 0.9 * SIGMA_PRIOR


@pytest.mark.slow
def test_the_background_of_a_camera_at_rest_is_a_guess(small_room, sure):
    scene = {"kind": "scene", "scene": "still", "width": 256, "height": 128}
    still = prepare(make_problem({"input": scene, "segmentation": {"superpixels": 60}}))
    moves = still.pair.truth.components > 0
    at_rest = sure_of(still).sigma > MOST_SIGMA
    assert at_rest[~moves].mean() > 0.8
    assert sure.guessed < 0.4


@pytest.mark.slow
def test_a_guessed_or_wrong_focal_length_makes_depth_unsure():
    scene = {"kind": "scene", "scene": "orbit", "width": 320, "height": 136}
    raw = {"input": scene, "flow": {"source": "truth"}, "segmentation": {"superpixels": 100}}
    problem = make_problem(raw)
    right = problem.load_pair()
    longer = np.diag([1.25, 1.25, 1.0])
    K = right.K_ref.copy()
    K[:2, :2] *= longer[:2, :2]
    case = prepare(problem, pair=replace(right, K_ref=K, K_next=K))
    depth = reconstruct(case.soup, case.segmentation.labels, K, K).depth_ref
    error = np.log(depth / right.truth.depth_ref)
    error = np.abs(error - np.median(error))
    assert error.mean() > 0.05

    def within_two(focal_sigma):
        sigma = sure_of(replace(case, pair=replace(case.pair, focal_sigma=focal_sigma))).sigma
        return np.mean(error < 2 * sigma)

    # the flow shows the error of a given one
    assert within_two(0.0) > 0.8
    assert within_two(GUESS_SIGMA) > 0.88


def test_flow_that_the_answer_contradicts_makes_it_less_sure(small_room):
    K = small_room.pair.K_ref, small_room.pair.K_next
    rec = reconstruct(small_room.soup, small_room.segmentation.labels, *K)
    inside = small_room.segmentation.labels == 25
    flow = small_room.pair.flow
    assert flow_misfit(rec, Flow(rec.flow.astype(np.float32), flow.confidence)).max() < 1e-4
    moved = np.where(inside[..., None], rec.flow + np.array([2.0, 0.0]), rec.flow).astype(
        np.float32
    )
    misfit = flow_misfit(rec, Flow(moved, flow.confidence))
    assert misfit[25] == pytest.approx(2.0, abs=1e-4)
    assert np.delete(misfit, 25).max() < 1e-4
    quiet, loud = (calibrated(np.array([0.001]), 0.1, m) for m in (0.05, 0.4))
    # the geometric mean of noise and misfit is twice the noise
    assert loud / quiet == pytest.approx(2**POWER, rel=1e-3)


def test_misfit_and_spread_count_differently_where_surfaces_bend():
    spread, misfit = np.array([100 * LEAST_SPREAD]), 100 * LEAST_NOISE
    base = calibrated(spread, 0.1, misfit, prior=np.inf, bends=True)
    # what is added in squares is 1e-4 of either square
    assert base[0] == pytest.approx(BENDING_FACTOR * misfit * np.sqrt(spread[0]), rel=1e-4)
    half = calibrated(0.25 * spread, 0.1, misfit, prior=np.inf, bends=True)
    assert half[0] == pytest.approx(0.5 * base[0], rel=1e-3)
    # small spreads keep their order and add little
    small = calibrated(LEAST_SPREAD * np.array([0.0, 0.1]), 0.1, LEAST_NOISE, bends=True)
    assert small[0] < small[1] == pytest.approx(small[0], rel=0.01)
    assert calibrated(spread, 0.6, misfit, prior=np.inf, bends=True) == base
    assert calibrated(spread, 0.1, 0.0, bends=True)[0] > 0
    assert calibrated(np.array([np.inf]), 0.1, bends=True)[0] == pytest.approx(SIGMA_PRIOR)


@pytest.mark.parametrize("bends", [False, True])
def test_systematic_uncertainty_is_added_at_any_noise(bends):
    spread = np.array([0.01])
    for noise in (0.05, 0.6):
        alone, total = (
            calibrated(spread, noise, 0.1, prior=np.inf, bends=bends, added=added)[0]
            for added in (0.0, 0.2)
        )
        assert total**2 == pytest.approx(alone**2 + 0.2**2)
    assert calibrated(spread, 0.1, added=np.inf)[0] == pytest.approx(SIGMA_PRIOR)


def test_other_components_are_less_sure_than_the_reference(small_room, sure):
    start = small_room.start
    sizes = small_room.segmentation.sizes
    scale = scale_by_contact(sure.marginals, start, sizes, np.ones(len(sizes)))
    reference = start.tie == TIES.index("reference")
    assert 0 < reference.sum() < len(reference)
    # the other scales move the mean, to which the reference component refers
    mean = np.sum(sizes[~reference] * scale[~reference]) / sizes.sum()
    np.testing.assert_allclose(scale[reference], mean, rtol=0.2)
    assert scale[~reference].min() > np.hypot(CONTACT, scale[reference][0]) * (1 - 1e-9)
    # no component is less certain than the prior
    raw = np.sqrt(sure.marginals.component)
    expected = 1 / np.sqrt(1 / raw**2 + 1 / SIGMA_PRIOR**2)
    np.testing.assert_allclose(sure.component_sigma, expected)


def test_a_scale_is_open_where_contact_implies_too_fast_motion(small_room, sure):
    start = small_room.start
    tied = start.tie != TIES.index("reference")
    fast = int(start.component[tied][0])
    moving = start.component == fast

    def scale(ratio):
        far = np.where(moving, ratio, 1.0)
        return scale_by_contact(sure.marginals, start, small_room.segmentation.sizes, far)

    usual = scale(1.0)
    np.testing.assert_array_equal(scale(np.exp(0.9 * USUAL)), usual)
    np.testing.assert_allclose(scale(5.0)[moving], np.hypot(usual[moving], np.log(5.0)))
    # the other components do not change
    np.testing.assert_array_equal(scale(5.0)[~moving], usual[~moving])


@pytest.mark.slow
def test_depth_far_from_the_initialisation_is_unsure_by_the_ratio(small_room, sure):
    parts, n = small_room.start.component, len(small_room.soup)
    at = surest(small_room, sure)
    inside = small_room.segmentation.labels == at
    assert sure.sigma[inside].mean() < 0.1

    def sigma(factor, **start):
        first = small_room.start.soup
        first = replace(first, d=first.d * factor)
        return sure_of(replace(small_room, start=replace(small_room.start, soup=first, **start)))

    for ratio in (0.8, 1.25):
        apart = sigma(np.where(np.arange(n) == at, ratio, 1.0)).sigma
        assert apart[inside].min() > 0.18
        np.testing.assert_allclose(apart[~inside], sure.sigma[~inside], rtol=1e-9)
    # a scale of a component is no evidence about its relief
    of_component = sigma(np.where(parts == parts[at], 1.25, 1.0))
    np.testing.assert_allclose(of_component.sigma, sure.sigma, rtol=1e-9)
    # where surfaces bend the initialisation is rough
    bends = np.ones(n, bool)
    rough = sigma(np.where(np.arange(n) == at, 1.25, 1.0), bends=bends).sigma
    np.testing.assert_allclose(rough, sigma(1.0, bends=bends).sigma, rtol=1e-9)


def surest(small_room, sure):
    """The superpixel whose depth is surest."""
    labels = small_room.segmentation.labels
    return int(np.argmin(ndimage.mean(sure.sigma, labels, np.arange(labels.max() + 1))))


def test_what_floats_above_the_ground_is_unsure_by_the_ratio(small_room, sure):
    at = surest(small_room, sure)
    inside = small_room.segmentation.labels == at
    usual = sure.sigma
    assert usual[inside].mean() < 0.1

    def sigma(log_ratio):
        off = np.where(np.arange(len(small_room.soup)) == at, log_ratio, 0.0)
        return sure_of(replace(small_room, start=replace(small_room.start, off_ground=off))).sigma

    np.testing.assert_array_equal(sigma(0.99 * STANDS), usual)
    # both too near and too far by 20 %
    for log_ratio in np.log([0.8, 1.25]):
        floats = sigma(log_ratio)
        assert floats[inside].min() > 0.18
        np.testing.assert_array_equal(floats[~inside], usual[~inside])


def test_a_camera_at_rest_leaves_a_guess_in_its_order(small_room, sure):
    rests = replace(small_room, start=replace(small_room.start, at_rest=True))
    moving, resting = sure.sigma, sure_of(rests).sigma
    least = GUESSED / np.hypot(1, GUESSED / SIGMA_PRIOR)
    assert least <= resting.min() <= resting.max() <= SIGMA_PRIOR
    sharp = moving < MOST_SIGMA
    assert np.all(np.diff(resting[sharp][np.argsort(moving[sharp])]) > -1e-9)
    assert np.unique(resting).size > 1000


def test_what_no_motion_explains_is_a_guess(small_room, sure):
    part = np.arange(len(small_room.soup)) < 5
    more = part | small_room.start.unexplained
    doubtful = replace(small_room, start=replace(small_room.start, unexplained=more))
    inside = part[small_room.segmentation.labels]
    sigma = sure_of(doubtful).sigma
    least = GUESSED / np.hypot(1, GUESSED / SIGMA_PRIOR)
    assert sigma[inside].min() >= least * (1 - 1e-9)
    np.testing.assert_allclose(sigma[~inside], sure.sigma[~inside], rtol=1e-9)


def test_where_surfaces_bend_nothing_is_surer_than_relief_without_parallax(small_room):
    all_bend = np.ones(len(small_room.soup), bool)
    bends = replace(small_room, start=replace(small_room.start, bends=all_bend))
    limit = BENDING_SIGMA / np.hypot(1, BENDING_SIGMA / SIGMA_PRIOR)
    assert sure_of(bends).sigma.min() >= limit * (1 - 1e-9)


def test_an_energy_that_sees_no_plane_leaves_everything_a_guess(small_room):
    alone = dict.fromkeys(("proj", "cont", "orient", "prior"), 0.0)
    sigma = sure_of(small_room, weights=small_room.weights.replace(**alone)).sigma
    assert np.isfinite(sigma).all()
    assert np.median(sigma) == pytest.approx(SIGMA_PRIOR, rel=0.02)


def test_what_the_flow_adds_to_the_terms_on_shape():
    """The information is 4 with the flow and 3 without: the flow adds 1."""
    assert learned(np.array([1 / 4]), np.array([1 / 3]))[0] == pytest.approx(1.0)
    assert learned(np.array([2.0]), np.array([2.0]))[0] > 1e3
