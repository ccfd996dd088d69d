"""Ground plane: what stands on it or lies below it.

A superpixel without usable flow (it leaves the image, is dark or moves too fast) borrows its depth
from its neighbours, and a component without a known support is scaled by its outline. Both may come
out far below the road. In an upright image, a level plane on which much of the scene lies and below
which almost nothing lies bounds the depth of everything seen below the horizon.
"""

from dataclasses import replace

import numpy as np

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.geometry.soup import Soup
from soup_nlp.start.components import (
    SCENE,
    quantile,
)
from soup_nlp.start.views import FlowFit

LEVEL = 0.92
"""Least cosine between the normal of the ground and the vertical of the image."""
ON, OFF = 0.05, 0.2
"""Relative differences of inverse depth: up to the first a superpixel lies on the ground, from the
second on it lies below."""
LEAST_ON, MOST_BELOW = 0.05, 0.05
"""Of the area with known depth, the least share on the ground and the largest share of another
surface below it. Of wrong flow less must lie below it than on it."""
TRIALS = 500
"""Number of planes through three superpixels that are tried."""


def ground(flow: FlowFit, mu: Float, reliable: Mask) -> Float:
    """(N,) inverse depth of the ground at the anchors; 0 above the horizon and without a ground.

    It follows from the inverse depth mu (N,) of the anchors where that is reliable (N,). None is
    sought unless the options `upright` and `ground` are set.
    """
    none, at = np.zeros(len(mu)), np.flatnonzero(reliable)
    ray, weight, o = flow.views.anchor, flow.seg.sizes.astype(float), flow.options
    if len(at) < 20 or not (o.upright and o.ground):
        return none
    # inverse depth of a plane is linear in the ray; (x, y, 1) . p with p along the normal
    low = at[ray[at, 1] > np.quantile(ray[at, 1], 0.4)]
    if len(low) < 3:
        return none
    three = np.random.default_rng(o.seed).choice(low, (TRIALS, 3))
    three = three[np.abs(np.linalg.det(ray[three])) > 1e-6]
    planes = np.linalg.solve(ray[three], mu[three][..., None])[..., 0]
    planes = planes[planes[:, 1] > LEVEL * np.linalg.norm(planes, axis=1)]
    if not len(planes):
        return none

    def on(planes: Float) -> Mask:
        plane_mu = planes @ ray[at].T
        return np.asarray((plane_mu > 0) & (np.abs(mu[at] - plane_mu) < ON * np.abs(plane_mu)))

    under = (mu[at] < (1 - OFF) * (planes @ ray[at].T)) @ weight[at]
    best = planes[np.argmax(on(planes) @ weight[at] - under)]
    for _ in range(3):
        inliers = at[on(best)]
        root = np.sqrt(weight[inliers]) / mu[inliers]
        best = np.linalg.lstsq(ray[inliers] * root[:, None], mu[inliers] * root)[0]
    plane_mu = ray @ best
    below = (plane_mu > 0) & (mu < (1 - OFF) * plane_mu)
    total, area_on, under = weight[at].sum(), weight[at][on(best)].sum(), reliable & below
    most = MOST_BELOW * total if _level(mu, plane_mu, under, weight) else area_on
    if area_on < LEAST_ON * total or weight[under].sum() > most:
        return none
    return np.maximum(plane_mu, 0.0)


def _level(mu: Float, floor: Float, under: Mask, weight: Float) -> bool:
    """Whether most of what lies under a plane (N,) has one distance from it.

    It is then real, as the floor beside a table. Wrong flow leaves any depth.
    """
    if not under.any():
        return False
    ratio = mu[under] / floor[under]
    near = np.abs(ratio / quantile(ratio, weight[under], 0.5) - 1) < OFF
    return bool(weight[under][near].sum() > 0.5 * weight[under].sum())


def on_ground(
    flow: FlowFit, soup: Soup, floor: Float, reliable: Mask, component: Int
) -> tuple[Soup, Mask]:
    """The soup with what is below the ground lifted to it, and (N,) True where that is.

    Superpixels of the scene keep the translation they share: their flow is wrong. Where most of
    what is reliable below the ground is another surface, that is kept.

    Args:
        flow: The flow of every superpixel.
        soup: Start, its components scaled.
        floor: (N,) inverse depth of the ground, see `ground`.
        reliable: (N,) True where the depth is reliable.
        component: (N,) group that moves as one.
    """
    mu, scene = 1 / soup.depth_at(flow.views.anchor), component == SCENE
    lifted = mu < (1 - OFF) * floor
    under = lifted & reliable & scene
    if _level(mu, floor, under, flow.seg.sizes.astype(float)):
        lifted &= ~under
    factor = np.where(lifted, mu / np.maximum(floor, 1e-12), 1.0)
    t = np.where((lifted & scene)[:, None], soup.t / factor[:, None], soup.t)
    return replace(soup, lam=soup.lam * factor, t=t), lifted
