"""Costs of particles are the exact energy, label by label and pair by pair."""

from dataclasses import replace

import numpy as np
import pytest
from helpers_model import Tiny, random_soup, weights_for

from soup_nlp.geometry.soup import Soup
from soup_nlp.model import oracle
from soup_nlp.refine.costs import PairCosts, feasible, unary_costs
from soup_nlp.refine.mppbp import length_slope
from soup_nlp.refine.particles import Particles


def cloud(tiny: Tiny, labels: int, seed: int = 3, spread: float = 1.0) -> Particles:
    """Particles of `labels` soups: the tiny soup first, then random ones."""
    n = len(tiny.soup)
    random = [Particles.of(random_soup(seed + k, n, spread)) for k in range(labels - 1)]
    return Particles.of(tiny.soup).joined(*random)


def chosen(p: Particles, labels: np.ndarray) -> Soup:
    """The soup of labels, in the length unit of its particles."""
    picked = p.take(labels[:, None])
    ones = np.ones(len(labels))
    return Soup(ones, picked.n[:, 0], picked.D[:, 0], picked.R[:, 0], picked.T[:, 0])


def assembled(costs: PairCosts, p: Particles, labels: np.ndarray, unit: float = 1.0) -> float:
    unary, _ = unary_costs(p, costs.data, costs.weights)
    table = costs.tables(p, unit)
    i, k = costs.edges.T
    pairs = table[np.arange(len(i)), labels[i], labels[k]]
    return float(unary[np.arange(len(labels)), labels].sum() + pairs.sum())


@pytest.mark.parametrize("units", ["paper", "pixels"])
@pytest.mark.parametrize("at_anchors", [False, True])
@pytest.mark.parametrize("truncated", [False, True])
def test_costs_of_chosen_labels_are_the_exact_energy(units, at_anchors, truncated):
    tiny = Tiny(units, at_anchors=at_anchors, samples=None)
    weights = weights_for(units, truncated)
    costs = PairCosts(tiny.data, weights)
    p = cloud(tiny, 6)
    exactly = costs.tables(p, 1.3)
    single = costs.tables(p, 1.3, np.float32)
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, exactly, rtol=1e-6, atol=1e-6 * exactly.max())
    rng = np.random.default_rng(5)
    for _ in range(4):
        labels = rng.integers(0, 6, len(tiny.soup))
        soup = chosen(p, labels)
        unit = float(np.sum(tiny.data.share * soup.distance))
        exact = oracle.energy(soup, tiny.data, weights)["total"]
        assert assembled(costs, p, labels, unit) == pytest.approx(exact, rel=1e-12)
        # the delivered soup has the same energy, because E does not depend on the scale
        delivered = oracle.energy(p.soup(labels, tiny.data.share), tiny.data, weights)["total"]
        assert delivered == pytest.approx(exact, rel=1e-12)


def test_blocks_change_no_digit_that_matters(monkeypatch):
    tiny, weights = Tiny("pixels"), weights_for("pixels")
    costs = PairCosts(tiny.data, weights)
    p = cloud(tiny, 5)
    whole, (unary, ahead) = costs.tables(p), unary_costs(p, tiny.data, weights)
    monkeypatch.setattr("soup_nlp.refine.costs.BLOCK_BYTES", 1)
    monkeypatch.setattr("soup_nlp.refine.costs.UNARY_BYTES", 1)
    np.testing.assert_allclose(costs.tables(p), whole, rtol=1e-12, atol=1e-13 * whole.max())
    in_blocks = unary_costs(p, tiny.data, weights)
    np.testing.assert_allclose(in_blocks[0], unary, rtol=1e-12)
    np.testing.assert_array_equal(in_blocks[1], ahead)


def test_a_particle_whose_pixels_fall_behind_the_camera_is_told():
    tiny = Tiny("pixels")
    p = cloud(tiny, 2)
    p.T[3, 1] = [0.0, 0.0, -50.0]
    _, ahead = unary_costs(p, tiny.data, weights_for("pixels"))
    assert not ahead[3, 1]
    assert ahead.sum() == ahead.size - 1


def test_visibility_is_that_of_the_nlp():
    tiny = Tiny()
    p = cloud(tiny, 2)
    rays = tiny.data.visibility_ray(5.0)
    assert feasible(p, rays, 1e-3).all()
    p.n[2, 1] = [0.0, 0.0, 1.0]
    visible = feasible(p, rays, 1e-3)
    assert not visible[2, 1]
    assert visible.sum() == visible.size - 1


def test_the_length_slope_is_the_derivative_of_the_energy():
    tiny = Tiny("paper")
    weights = weights_for("paper", truncated=False)
    h = 1e-5
    # the unit is sum(share D)
    scaled = [replace(tiny.data, share=tiny.data.share * (1 + s * h)) for s in (1, -1)]
    up, down = (oracle.energy(tiny.soup, d, weights)["total"] for d in scaled)
    assert length_slope(tiny.soup, tiny.data, weights) == pytest.approx(
        (down - up) / (2 * h), rel=1e-5
    )
