"""Tiny problems, finite differences and rendered planes of known energy, for tests of the model."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from soup_nlp.data.pair import Flow, Pair
from soup_nlp.data.scenes.catalogue import about, placed
from soup_nlp.data.scenes.raycast import Body, Part, Scene, render
from soup_nlp.data.scenes.surfaces import Plane, Texture
from soup_nlp.geometry import camera, rotation
from soup_nlp.geometry.graph import Segmentation, build_segmentation
from soup_nlp.geometry.soup import Soup, reconstruct
from soup_nlp.geometry.superpixels import segment
from soup_nlp.model.elements import elements
from soup_nlp.model.energy_data import EnergyData, build_energy_data
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.layout import GAUGES as GAUGES
from soup_nlp.model.layout import Layout, MatrixLayout
from soup_nlp.model.nlp import NLP
from soup_nlp.model.programs import build_matrix_nlp
from soup_nlp.model.reweighting import in_pixels
from soup_nlp.model.superpixel import matrix_view, tangent_view

Float = NDArray[np.float64]

WIDTH, HEIGHT = 64, 48
K_REF = camera.intrinsics(70.0, 72.0, 31.0, 24.5)
K_NEXT = camera.intrinsics(68.0, 69.0, 32.5, 23.0)
PAPER = Weights(
    arap=1.0,
    proj=0.3,
    cont=0.7,
    orient=0.9,
    prior=0.6,
    depth=0.8,
    order=0.5,
    sigma_cont=0.4,
    sigma_cont_ref=np.inf,
    sigma_orient=0.05,
    sigma_arap=np.inf,
    sigma_proj=np.inf,
)
"""Truncated as in the paper, with E_prior; elements lie on either side of both truncations."""
TRUNCATED = PAPER.replace(sigma_cont_ref=0.3, sigma_arap=0.25, leak_arap=0.2, sigma_proj=2.0)
"""Everything truncated."""
GREY = Texture(((0.5, 0.5, 0.5), (0.3, 0.4, 0.6)), cell=0.2)


def weights_for(units: str, truncated: bool = True) -> Weights:
    """Weights whose truncations are exceeded by some elements but not by all."""
    w = TRUNCATED if truncated else PAPER
    if units == "pixels":
        w = w.replace(sigma_cont=6.0)
        if truncated:
            w = w.replace(sigma_cont_ref=5.0, sigma_arap=12.0)
    return w


def random_soup(seed: int, count: int, spread: float = 1.0) -> Soup:
    """A soup whose planes face every ray of the tiny camera; depths, motions vary by spread."""
    rng = np.random.default_rng(seed)
    n = np.array([0.0, 0.0, -1.0]) + spread * rng.uniform(-0.35, 0.35, (count, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    D = 1.0 + spread * rng.uniform(-0.3, 0.3, count)
    R = rotation.exp(np.array([0.02, -0.03, 0.01]) + spread * rng.normal(0, 0.06, (count, 3)))
    T = np.array([0.1, 0.02, -0.05]) + spread * rng.normal(0, 0.05, (count, 3))
    lam = rng.uniform(0.5, 2.0, count)
    return Soup(lam, n, D / lam, R, T / lam[:, None])


def disturbed(soup: Soup, size: float) -> Soup:
    """The soup with normals, scales, rotations and translations changed by about `size`."""
    rng = np.random.default_rng(3)
    n = soup.n + rng.normal(0, size, soup.n.shape)
    return Soup(
        soup.lam * rng.uniform(1 - size, 1 + size, len(soup)),
        n / np.linalg.norm(n, axis=1, keepdims=True),
        soup.d,
        rotation.exp(rng.normal(0, size / 10, soup.n.shape)) @ soup.R,
        soup.t * rng.uniform(1 - size, 1 + size, soup.t.shape),
    )


class Tiny:
    """Grid superpixels of a 64 x 48 image of noise, a random soup and a noisy flow."""

    def __init__(
        self,
        units: str = "paper",
        at_anchors: bool = False,
        seed: int = 0,
        boundary_samples: int | None = 2,
        samples: int = 3,
        neighbours: int = 4,
        superpixels: int = 12,
    ) -> None:
        rng = np.random.default_rng(seed)
        self.image = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        labels = segment(self.image, superpixels, "grid")
        self.seg: Segmentation = build_segmentation(
            labels, self.image, neighbours=neighbours, boundary_samples=boundary_samples
        )
        self.soup = random_soup(seed + 1, len(self.seg))
        confidence = rng.choice([0.0, 0.5, 1.0], (HEIGHT, WIDTH), p=[0.1, 0.3, 0.6])
        exact = reconstruct(self.soup, labels, K_REF, K_NEXT).flow
        noisy = exact + rng.normal(0, 1.0, exact.shape)
        self.flow = Flow(noisy.astype(np.float32), confidence.astype(np.float32), "test")
        self.data: EnergyData = build_energy_data(
            self.seg, self.flow, K_REF, K_NEXT, samples, seed, arap_at_anchors=at_anchors
        )
        # E_prior allows a relief of 0.3 at every third edge without cost
        relief = np.where(np.arange(len(self.data.edges)) % 3, 0.0, 0.3)
        # a depth prior determines about two of three edges
        change = np.log(rng.uniform(0.7, 1.4, len(relief)))
        has_depth = rng.random(len(relief)) < 0.7
        prior = {"depth_weight": 0.4 * has_depth, "depth_change": change}
        # occlusion determines the order of about two of three pairs
        pairs = len(self.data.pairs)
        prior["order_weight"] = rng.choice([-0.7, 0.0, 1.0], pairs)
        prior["order_step"] = rng.uniform(0.0, 0.4, pairs)
        # E_orient allows a turn at every third pair without cost
        third = np.arange(pairs) % 3 == 0
        prior["orient_turn"] = third[:, None] * rng.uniform(-0.2, 0.2, (pairs, 3))
        self.data = replace(self.data, prior_relief=relief, **prior)
        if units == "pixels":
            self.data = in_pixels(self.data, self.soup, self.seg)

    def nlp(self, weights: Weights, form: Formulation) -> tuple[NLP, MatrixLayout]:
        """The constrained NLP at the tiny soup."""
        return build_matrix_nlp(self.soup, self.data, weights, form)


# --- values and finite differences of an NLP ---------------------------------------------------


def lagrangian_gradient(nlp: NLP, x: Float, lam_f: float, lam_g: Float) -> Float:
    return lam_f * nlp.gradient(x) + nlp.jacobian(x).T @ lam_g


def directional(fun: Callable[[Float], Float], x: Float, v: Float, h: float = 1e-4) -> Float:
    """Derivative of fun along v by Richardson-extrapolated central differences, O(h^4)."""

    def central(step: float) -> Float:
        return (np.asarray(fun(x + step * v)) - np.asarray(fun(x - step * v))) / (2 * step)

    return (4 * central(h / 2) - central(h)) / 3


def wiggle(nlp: NLP, seed: int, size: float) -> Float:
    """A random point near x0, off the manifold."""
    rng = np.random.default_rng(seed)
    x = nlp.x0 * (1 + size * rng.uniform(-1, 1, nlp.nx)) + size * rng.uniform(-0.2, 0.2, nlp.nx)
    return np.clip(x, nlp.lbx + 1e-3, nlp.ubx - 1e-3)


def exact_terms(x: Float, data: EnergyData, weights: Weights, layout: Layout) -> dict[str, float]:
    """Exact energy by term of a solver's vector, from the norms of the symbolic terms."""
    matrix = isinstance(layout, MatrixLayout)
    view, option = (matrix_view, layout.gauge) if matrix else (tangent_view, layout.chart)
    out = {}
    for name, element in elements(data, weights, layout).items():
        size, arity = element.superpixels.shape
        variables = ca.SX.sym("x", layout.stride * arity)
        row = {k: ca.SX.sym(k, count) for k, count in element.fields.items()}
        parts = ca.vertsplit(variables, layout.stride)
        views = [view(part, row, a, option) for a, part in enumerate(parts)]
        total = ca.SX(0)
        exact = {"eps": ca.SX(0), "eps_pixel": ca.SX(0)}
        for n in element.norms(*views, {**row, **exact}, *element.given):
            square = ca.dot(n.vector, n.vector)
            y = square / 2 if n.kind == "half_square" else ca.sqrt(square)
            cut = y if n.sigma is None else ca.fmin(y, n.sigma)
            total += n.weight * ((1 - n.leak) * cut + n.leak * y)
        f = ca.Function("f", [variables, ca.vertcat(*row.values())], [total]).map(size)
        table = np.column_stack([c.reshape(size, -1) for c in element.columns.values()])
        index = np.concatenate([layout.of(i) for i in element.superpixels.T], axis=1)
        out[name] = float(np.asarray(f(x[index].T, table.T)).sum())
    return out


# --- worlds with known truth ---------------------------------------------------------------------


def motion(turn_deg: tuple[float, float, float], shift: tuple[float, float, float]) -> Float:
    """(4, 4) next_from_ref."""
    return about(turn=turn_deg, shift=shift)


def plane_world(
    pose: Float, move: Float, width: int = 96, height: int = 72, focal: float = 90.0
) -> Pair:
    """Rendered pair of one infinite plane under one rigid camera motion, with true flow."""
    K = camera.intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2)
    scene = Scene((Body((Part(Plane(), pose, GREY),)),), np.eye(4), move)
    return with_true_flow(render(scene, K, height, width))


def with_true_flow(pair: Pair) -> Pair:
    """The pair with its exact flow, full confidence wherever it is finite."""
    truth = pair.truth
    valid = np.isfinite(truth.flow).all(-1)
    uv = np.where(valid[..., None], truth.flow, 0.0)
    # float64 on purpose: float32 rounding (1e-6 px) would hide an inexact formula
    return pair.with_flow(Flow(uv, valid.astype(float), "truth"))


def plane_soup(pose: Float, move: Float, count: int) -> Soup:
    """The true soup of `plane_world`: every superpixel has the same plane and motion."""
    n = pose[:3, :3] @ [0.0, 0.0, -1.0]
    D = -n @ pose[:3, 3]
    lam = np.full(count, 1.0 / count)
    return Soup(
        lam,
        np.tile(n, (count, 1)),
        D / lam,
        np.tile(move[:3, :3], (count, 1, 1)),
        move[:3, 3] / lam[:, None],
    )


# --- the tiny problem and rendered planes in their units -----------------------------------------

UNITS = ("paper", "pixels")


@cache
def tiny(units: str = "paper", at_anchors: bool = False) -> Tiny:
    return Tiny(units, at_anchors)


form = Formulation


def assert_same_soup(a: Soup, b: Soup, tolerance: float = 1e-12) -> None:
    np.testing.assert_allclose(a.lam.sum(), 1.0, rtol=tolerance)
    for name in ("n", "R", "distance", "translation"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=0, atol=tolerance)


WORLDS = {
    "fronto-parallel, sideways": (placed(0, 0, 2.0), motion((0, 0, 0), (0.1, 0.03, 0))),
    "fronto-parallel, turning": (placed(0, 0, 3.0), motion((0.5, -1, 2), (0.1, 0.03, 0.2))),
    "slanted": (placed(0, 0, 2.5, yaw=25, pitch=-30), motion((1, 0.5, -1), (0.02, 0.1, -0.1))),
    "at rest": (placed(0, 0, 2.0, yaw=10), motion((0, 0, 0), (0, 0, 0))),
}


def world(name: str, units: str, at_anchors: bool) -> tuple[Soup, EnergyData]:
    pose, move = WORLDS[name]
    pair = plane_world(pose, move, WIDTH, HEIGHT)
    labels = segment(pair.image_ref, 12, "grid")
    seg = build_segmentation(labels, pair.image_ref, neighbours=5, boundary_samples=2)
    data = build_energy_data(
        seg, pair.flow, pair.K_ref, pair.K_next, 8, 0, arap_at_anchors=at_anchors
    )
    soup = plane_soup(pose, move, len(seg))
    return soup, in_pixels(data, soup, seg) if units == "pixels" else data
