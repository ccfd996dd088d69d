"""Marginal variances of depth: dense inverses, derivatives, scale, missing flow, calibration."""

from dataclasses import replace

import numpy as np
import pytest
from helpers_model import directional
from helpers_start import scene_problem
from scipy import sparse

from soup_nlp.data.formats.cameras import GUESS_SIGMA
from soup_nlp.data.pair import Flow
from soup_nlp.evaluation import information as information_module
from soup_nlp.evaluation.confidence import (
    ADDED,
    FACTORS,
    MISFIT,
    at_outlines,
    confidence,
    flow_misfit,
    sigma_of,
    with_prior,
)
from soup_nlp.evaluation.information import (
    BlockCholesky,
    information,
    layers,
    marginals,
    spread_in_image,
)
from soup_nlp.geometry.camera import project
from soup_nlp.geometry.soup import reconstruct
from soup_nlp.model.formulation import Formulation
from soup_nlp.pipeline.case import prepare
from soup_nlp.start.regions import FIXED, ORIGINS, SCENE

FORM = Formulation()
PRIOR = FACTORS["prior"]


@pytest.fixture(scope="module")
def small_room(small_room):
    """The small room with a second component, whose scale is from contact."""
    second = np.arange(len(small_room.soup)) < 9
    origin = np.where(second, ORIGINS.index("contact below"), ORIGINS.index("reference"))
    start = replace(small_room.start, component=second.astype(int), origin=origin)
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
    plane, variance = marginals(info, small_room.segmentation.sizes, component)
    np.testing.assert_allclose(plane, blocks_of(dense, 9)[:, :3, :3], rtol=1e-4, atol=1e-12)
    for c in range(3):
        row = np.zeros(len(info.growth))
        weight = np.where(component == c, small_room.segmentation.sizes, 0)
        row[::9] = -weight / weight.sum() / info.plane[:, 0]
        assert variance[c] == pytest.approx(row @ dense @ row, rel=1e-4)


def test_the_variance_of_a_pixel_is_of_log_depth(small_room, info, dense):
    """Against finite differences of the log depth of a plane."""
    seg, K = small_room.segmentation, small_room.pair.K_ref
    plane, _ = marginals(info, seg.sizes, np.zeros(len(small_room), int))
    sigma = spread_in_image(info, plane, seg.labels, K)
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
    step = at_outlines(np.exp(log_depth))
    np.testing.assert_allclose(step[:, 198:202], 0.4, atol=1e-6)
    assert step[:, :190].max() == step[:, 210:].max() == 0
    slope = at_outlines(np.exp(np.linspace(0, 4, 400) * np.ones((60, 1))))
    assert slope[:, 10:-10].max() < 1e-5


def test_sigma_is_capped_by_the_prior():
    zero, most, endless = with_prior(np.array([0.0, 1e9, np.inf]))
    assert zero == 0.0
    assert most == endless == pytest.approx(PRIOR)
    assert with_prior(np.array([0.5]))[0] ** -2 == pytest.approx(0.5**-2 + PRIOR**-2)


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


@pytest.mark.slow
@pytest.mark.parametrize("term", ["arap", "prior"])
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


def sure_of(case, data=None, weights=None, **changed):
    """The uncertainty of the start of a case, some of whose fields are changed."""
    K = case.pair.K_ref, case.pair.K_next
    rec = reconstruct(case.soup, case.segmentation.labels, *K)
    energy = data or case.data, weights or case.weights, FORM
    return confidence(rec, case.pair, replace(case.start, **changed), *energy)


@pytest.fixture(scope="module")
def sure(small_room):
    """The uncertainty of the start of the small room."""
    return sure_of(small_room)


@pytest.mark.slow
def test_sigma_is_the_root_of_the_squares_of_its_terms(small_room, sure):
    terms = sure.terms
    assert not any(terms[name].any() for name in ("camera", "bends", "drawn"))
    scaled = sum((FACTORS[name] * terms[name]) ** 2 for name in ADDED if name in FACTORS)
    known = scaled + terms["starts"] ** 2 + terms["relief"] ** 2
    np.testing.assert_allclose(sure.sigma, with_prior(np.sqrt(known)))
    assert all(np.isfinite(term).all() and term.min() >= 0 for term in terms.values())
    loose = {**terms, "camera": np.full_like(sure.sigma, 0.3)}
    np.testing.assert_allclose(sigma_of(loose), with_prior(np.sqrt(known + 0.09)))


@pytest.mark.slow
def test_a_guessed_or_wrong_focal_length_makes_depth_unsure():
    problem = scene_problem("orbit", 320, 136, 100)
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


@pytest.mark.slow
def test_flow_that_the_answer_contradicts_makes_it_less_sure(small_room):
    K = small_room.pair.K_ref, small_room.pair.K_next
    rec = reconstruct(small_room.soup, small_room.segmentation.labels, *K)
    inside = small_room.segmentation.labels == 25
    moved = np.where(inside[..., None], np.add(rec.flow, [2.0, 0.0]), rec.flow)
    same, other = (Flow(uv, small_room.pair.flow.confidence) for uv in (rec.flow, moved))
    assert flow_misfit(rec, same).max() < 1e-4
    misfit = flow_misfit(rec, other)
    assert misfit[25] == pytest.approx(2.0, abs=1e-4)
    assert np.delete(misfit, 25).max() < 1e-4
    # the geometric mean of noise and misfit counts
    quiet, loud = (
        replace(small_room, pair=small_room.pair.with_flow(flow)) for flow in (same, other)
    )
    before, after = (sure_of(case).terms["flow"][inside] for case in (quiet, loud))
    np.testing.assert_allclose(after / before, np.sqrt(MISFIT * 2.0 / small_room.start.noise))


@pytest.mark.slow
def test_other_components_are_less_sure_than_the_scene(small_room, sure):
    scene = (small_room.start.component == SCENE)[small_room.segmentation.labels]
    assert 0 < scene.mean() < 1
    assert sure.terms["scale"][scene].max() == 0
    assert sure.terms["scale"][~scene].min() > 0
    # no component is less certain than the prior
    assert (sure.component_sigma <= PRIOR).all()
    raw = sure.terms["scale"][~scene].max()
    np.testing.assert_allclose(sure.component_sigma[1], 1 / np.sqrt(raw**-2 + PRIOR**-2))


def test_a_case_knows_how_far_its_starts_are_apart(small_room):
    """There are several, each from other samples of the flow."""
    assert np.mean(small_room.start.scatter > 0) > 0.5


@pytest.mark.slow
def test_depth_is_less_sure_where_the_starts_disagree(small_room, sure):
    labels = small_room.segmentation.labels
    scatter = np.where(np.arange(len(small_room)) % 2, 0.5, small_room.start.scatter)
    other = sure_of(small_room, scatter=scatter)
    odd = labels % 2 == 1
    np.testing.assert_allclose(other.terms["starts"][odd], 0.5)
    assert other.sigma[odd].min() > 1 / np.hypot(1 / 0.5, 1 / PRIOR) - 1e-9
    np.testing.assert_allclose(other.sigma[~odd], sure.sigma[~odd])


@pytest.mark.slow
def test_relief_is_as_unsure_as_the_motion_of_its_superpixel(small_room, sure):
    start, labels = small_room.start, small_room.segmentation.labels
    wide = sure_of(small_room, covariance=4 * start.covariance)
    np.testing.assert_allclose(wide.terms["relief"], 2 * sure.terms["relief"], rtol=1e-9)
    assert sure.terms["relief"].max() > 0
    # neighbours share that error: it is none of the superpixel's own sigma
    np.testing.assert_allclose(wide.own_sigma, sure.own_sigma)
    squares = np.bincount(labels.ravel(), sure.sigma.ravel() ** 2)
    whole = np.sqrt(squares / small_room.segmentation.sizes)
    assert (sure.own_sigma < whole).any()
    assert (sure.own_sigma < whole * (1 + 1e-12)).all()
    odd = np.arange(len(small_room)) % 2 == 1
    relief = sure_of(small_room, motion=np.where(odd, -1, start.motion)).terms["relief"]
    assert (relief[odd[labels]] == 0).all()
    assert (relief[~odd[labels]] > 0).any()
    none = np.full_like(start.motion, -1)
    assert not sure_of(small_room, motion=none).terms["relief"].any()


@pytest.mark.slow
def test_drawn_depth_has_the_sigma_of_what_is_drawn(small_room):
    """As before a camera at rest, see test_certainty."""
    start, part = small_room.start, np.arange(len(small_room.soup)) < 5
    drawn = sure_of(small_room, origin=np.where(part, FIXED, start.origin)).sigma
    inside = part[small_room.segmentation.labels]
    assert (drawn[inside] == FACTORS["drawn"]).all()
    assert (drawn[~inside] != FACTORS["drawn"]).any()


@pytest.mark.slow
def test_where_surfaces_bend_nothing_is_surer_than_relief_without_parallax(small_room):
    bends = np.ones(len(small_room.soup), bool)
    assert sure_of(small_room, bends=bends).sigma.min() >= with_prior(FACTORS["bends"]) * (1 - 1e-9)


def test_all_depths_growing_alike_costs_nothing(info):
    size = abs(info.matrix) @ abs(info.growth)
    assert abs(info.matrix @ info.growth).max() < 1e-9 * size.max()


def test_an_undetermined_superpixel_has_the_sigma_of_the_prior(small_room, sure):
    blind = 25
    weight = small_room.data.pixel_weight.copy()
    weight[blind] = 0.0
    data = replace(small_room.data, pixel_weight=weight)
    loose = small_room.weights.replace(arap=1e-9, cont=1e-9, orient=1e-9)
    sigma = sure_of(small_room, data, loose).sigma
    inside = small_room.segmentation.labels == blind
    np.testing.assert_allclose(sigma[inside], PRIOR, rtol=0.05)
    assert sure.sigma[inside].mean() < 0.9 * PRIOR
