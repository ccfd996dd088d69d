"""Detail: exact for exact flow, small for noise, none without evidence; shrinkage."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers_model import HEIGHT, K_NEXT, K_REF, WIDTH, Tiny, random_soup

from soup_nlp.data.pair import Flow
from soup_nlp.evaluation import recompute
from soup_nlp.evaluation.confidence import KINDS
from soup_nlp.geometry.camera import pixel_grid, rays
from soup_nlp.geometry.soup import Reconstruction, Soup, plane_depth, reconstruct
from soup_nlp.pipeline.run import make_run, skipped
from soup_nlp.refine.detail import GROUND_SIGMA, STEP, above_ground, detail, shrinkage
from soup_nlp.start.regions import likeness

LABELS = np.kron(np.arange(12).reshape(3, 4), np.ones((HEIGHT // 3, WIDTH // 4), int))
EVERY = np.ones(12, bool)
BUMPS = 0.3 * np.sin(pixel_grid(HEIGHT, WIDTH) / 5).prod(axis=-1)
"""Log depth of a surface relative to planes."""


def planes_of(turned: bool) -> Reconstruction:
    """Random planes that share a translation to the side, or turn and move as they like."""
    soup = random_soup(0, 12)
    if not turned:
        side = np.array([0.2, -0.1, 0.0]) / soup.lam[:, None]
        soup = Soup(soup.lam, soup.n, soup.d, np.eye(3)[None].repeat(12, 0), side)
    return reconstruct(soup, LABELS, K_REF, K_NEXT)


def flow_of(planes: Reconstruction, noise: float = 0.0, depth: np.ndarray | None = None) -> Flow:
    bumps = np.zeros(LABELS.shape) if depth is None else depth
    exact = reconstruct(planes.soup, LABELS, K_REF, K_NEXT, detail=bumps).flow
    error = np.random.default_rng(0).normal(0, noise, exact.shape)
    return Flow(exact + error, np.ones(LABELS.shape), "test")


def test_a_surface_beside_its_planes_is_found():
    planes = planes_of(turned=False)
    found = detail(planes, flow_of(planes, depth=BUMPS), K_NEXT, EVERY)
    # a step to the side is linear in the inverse depth
    np.testing.assert_allclose(found, BUMPS, atol=1e-9)
    # any other motion nearly is
    planes = planes_of(turned=True)
    found = detail(planes, flow_of(planes, depth=BUMPS), K_NEXT, EVERY)
    assert np.abs(found - BUMPS).mean() < 0.1 * np.abs(BUMPS).mean()


def test_noise_in_all_directions_gives_little_detail():
    planes = planes_of(turned=False)
    flow = flow_of(planes, noise=0.3)
    found = detail(planes, flow, K_NEXT, EVERY)
    # without a comparison of directions all of it would be depth, with a deviation of
    length = np.linalg.norm(planes.flow - flow_of_far_points(planes), axis=-1)
    assert np.sqrt((found**2).mean()) < 0.3 * np.sqrt(((0.3 / length) ** 2).mean())
    # the round trip of a pixel tells of its error, too
    flow = flow_of(planes, noise=0.1, depth=BUMPS)
    less = Flow(flow.uv, np.full(LABELS.shape, np.exp(-1.0)), "test")
    sure, unsure = (np.abs(detail(planes, f, K_NEXT, EVERY)).mean() for f in (flow, less))
    assert unsure < 0.5 * sure


def flow_of_far_points(planes: Reconstruction) -> np.ndarray:
    return reconstruct(planes.soup, LABELS, K_REF, K_NEXT, detail=np.full(LABELS.shape, 30.0)).flow


def test_flow_that_is_no_evidence_gives_no_detail():
    planes = planes_of(turned=False)
    flow = flow_of(planes, depth=np.where(LABELS == 5, 1.0, BUMPS))
    flow.confidence[:8] = 0.0
    used = EVERY & (np.arange(12) != 7)
    found = detail(planes, flow, K_NEXT, used)
    # a point at e times the depth of its plane is on another surface
    none = (LABELS == 5) | (LABELS == 7) | (pixel_grid(HEIGHT, WIDTH)[..., 1] < 8)
    assert not found[none].any()
    np.testing.assert_allclose(found[~none], BUMPS[~none], atol=1e-9)


@pytest.mark.parametrize("seed", [0, 1])
def test_an_independent_computation_agrees(seed):
    tiny, rng = Tiny(seed=seed), np.random.default_rng(seed)
    K = K_NEXT.copy()
    K[0, 1] = 1.5
    planes = reconstruct(tiny.soup, tiny.seg.labels, K_REF, K)
    rough = reconstruct(tiny.soup, tiny.seg.labels, K_REF, K, detail=3 * BUMPS)
    uv = rough.flow + rng.normal(0, 0.3, rough.flow.shape)
    flow, used = Flow(uv, tiny.flow.confidence, "test"), rng.random(len(tiny.soup)) < 0.8
    found = detail(planes, flow, K, used)
    given = {"flow": uv, "confidence": flow.confidence, "K_ref": K_REF, "K_next": K}
    again = recompute.detail(vars(tiny.soup), tiny.seg.labels, given, used)
    np.testing.assert_allclose(found, again, atol=1e-11)
    assert 0.02 < np.abs(found).mean() < 0.2


def moved(tiny: Tiny, sigma: np.ndarray, drawn: np.ndarray, **data: np.ndarray) -> np.ndarray:
    """Change of log depth by superpixel where sigma and what is drawn are given by superpixel."""
    labels = tiny.seg.labels
    planes = reconstruct(tiny.soup, labels, K_REF, K_NEXT)
    energy = replace(tiny.data, **data)
    return shrinkage(planes, energy, likeness(tiny.seg), sigma, drawn[labels])


@pytest.mark.parametrize("seed", [0, 1])
def test_what_is_drawn_moves_as_an_independent_computation_says(seed):
    tiny, rng = Tiny(seed=seed), np.random.default_rng(seed)
    n = len(tiny.soup)
    sigma, drawn = rng.uniform(0.1, 1.0, n), rng.random(n) < 0.6
    found = moved(tiny, sigma, drawn)
    assert not found[~drawn].any()
    assert np.abs(found[drawn]).max() > 0.05
    labels, seg = tiny.seg.labels, vars(tiny.seg)
    of = labels, sigma, drawn[labels]
    again = recompute.shrinkage(vars(tiny.soup), vars(tiny.data), seg, *of)
    np.testing.assert_allclose(found[labels], again, atol=1e-11)


def test_shrinkage_weighs_neighbours_against_the_own_depth():
    tiny, every = Tiny(), np.ones(12, bool)
    order, one = np.zeros(len(tiny.data.pairs)), np.arange(12) == 5
    # superpixels that face the camera, all at one depth but one
    flat = Soup(
        np.where(one, 1.2, 1.0),
        np.tile([0.0, 0.0, -1.0], (12, 1)),
        np.ones(12),
        *(np.zeros((12, *shape)) for shape in ((3, 3), (3,))),
    )
    tiny.soup = flat
    sigma, beside = np.full(12, 0.2), (tiny.data.pairs == 5).any(axis=1)
    weight = likeness(tiny.seg) / likeness(tiny.seg).mean() / STEP**2
    step = np.log(1.2)
    w = (weight * np.exp(-(step**2) / (4 * 0.2**2)))[beside].sum()
    found = moved(tiny, sigma, one, order_weight=order)
    np.testing.assert_allclose(found, np.where(one, -step * w / (w + 1 / 0.2**2), 0.0))
    # less where it is surer, not where one is known to cover the other, nothing if nothing is drawn
    assert 0 > moved(tiny, np.full(12, 0.1), one, order_weight=order)[5] > found[5]
    assert not moved(tiny, sigma, one, order_weight=np.ones(len(order))).any()
    assert not moved(tiny, sigma, ~every).any()


def test_a_lone_superpixel_that_is_drawn_stays():
    tiny = Tiny(superpixels=1)
    assert len(tiny.soup) == 1
    assert moved(tiny, np.ones(1), np.ones(1, bool)) == 0
    maps = tiny.seg.labels, np.ones(1), tiny.seg.labels == 0
    again = recompute.shrinkage(vars(tiny.soup), vars(tiny.data), vars(tiny.seg), *maps)
    assert not again.any()


def test_a_run_delivers_what_is_drawn_shrunk_and_above_the_ground(small_room):
    # before a camera at rest all is drawn, and the flow gives no detail
    case = replace(small_room, start=replace(small_room.start, at_rest=True))
    solution = skipped(case)
    done = make_run(case, solution, SimpleNamespace(soup=solution.soup))
    planes = plane_depth(done.soup, case.segmentation.labels, case.pair.K_ref)
    assert np.abs(done.shrinkage).max() > 0.01
    change = np.log(done.reconstruction.depth_ref / planes)
    labels, shrunk = case.segmentation.labels, done.shrinkage[case.segmentation.labels]
    given = case.pair.K_ref, done.ground, done.confidence.sigma
    expected = recompute.ground(vars(done.soup), labels, *given, shrunk)
    assert 0.01 < (expected < shrunk).mean() < 0.5
    np.testing.assert_allclose(change, expected, atol=1e-12)
    assert make_run(case, solution).shrinkage is None
    # measured depth stays
    done = make_run(small_room, solution, SimpleNamespace(soup=solution.soup))
    beside, measured = done.reconstruction.detail, done.confidence.kind == KINDS.index("measured")
    exact = recompute.ground(
        vars(done.soup), labels, *given[:2], np.full(labels.shape, 1e9), beside
    )
    assert (exact < beside - 1e-6)[measured].any()


def test_what_is_below_the_ground_is_lifted_by_its_sigma():
    tiny, far = Tiny(), np.full(BUMPS.shape, 1e9)
    planes, labels = reconstruct(tiny.soup, tiny.seg.labels, K_REF, K_NEXT), tiny.seg.labels
    p = np.array([0.1, 6.0, 0.3]) / np.median(planes.depth_ref)
    inverse = rays(K_REF, pixel_grid(*labels.shape)) @ p
    found = planes.depth_ref * np.exp(above_ground(planes, BUMPS, p, K_REF, far))
    bumps, under = planes.depth_ref * np.exp(BUMPS), inverse > 0
    under[under] &= bumps[under] > 1 / inverse[under]
    assert 0.1 < under.mean() < 0.9
    np.testing.assert_allclose(found[under], 1 / inverse[under])
    np.testing.assert_allclose(found[~under], bumps[~under])
    # what is as sure as the ground goes half of the way
    sigma = np.full(BUMPS.shape, GROUND_SIGMA)
    half = above_ground(planes, BUMPS, p, K_REF, sigma)
    np.testing.assert_allclose(2 * (BUMPS - half), np.log(bumps / found), atol=1e-12)
    again = recompute.ground(vars(tiny.soup), labels, K_REF, p, sigma, BUMPS)
    np.testing.assert_allclose(half, again, atol=1e-12)
    # without a ground nothing changes
    np.testing.assert_array_equal(above_ground(planes, BUMPS, np.zeros(3), K_REF, far), BUMPS)
