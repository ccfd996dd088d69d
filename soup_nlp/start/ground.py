"""Ground plane: what stands on it, lies below it or is off it.

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
    CONTACT,
    SCENE,
    connected_pieces,
    outlines,
    quantile,
)
from soup_nlp.start.views import FlowFit

LEVEL = 0.92
"""Least cosine between the normal of the ground and the vertical of the image."""
ON, BELOW = 0.05, 0.2
"""Relative differences of inverse depth: up to the first a superpixel lies on the ground, from the
second on it lies below."""
LEAST_ON, MOST_BELOW = 0.05, 0.05
"""Of the area with known depth, the least share on the ground and the largest share of another
surface below it. Of wrong flow less must lie below it than on it."""
STANDS = 0.1
"""Log ratio to the depth of the ground up to which a superpixel lies on it, and up to which a
region stands on it. Regions with the right depth have at most 0.16."""
STEP = 0.15
"""Least log ratio of depths along the outline of a region."""
FEWEST = 3
"""Least number of superpixels of a region that may be off the ground."""
MOST_AREA = 0.25
"""Largest share of the image of a region of the scene whose contact with the ground tells its
depth: a larger one may be a table, which does not stand on the floor below its edge."""
VISIBLE = 0.6
"""Least share of ground along the lower border of a region."""
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

    under = (mu[at] < (1 - BELOW) * (planes @ ray[at].T)) @ weight[at]
    best = planes[np.argmax(on(planes) @ weight[at] - under)]
    for _ in range(3):
        inliers = at[on(best)]
        root = np.sqrt(weight[inliers]) / mu[inliers]
        best = np.linalg.lstsq(ray[inliers] * root[:, None], mu[inliers] * root)[0]
    plane_mu = ray @ best
    below = (plane_mu > 0) & (mu < (1 - BELOW) * plane_mu)
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
    near = np.abs(ratio / quantile(ratio, weight[under], 0.5) - 1) < BELOW
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
    lifted = mu < (1 - BELOW) * floor
    under = lifted & reliable & scene
    if _level(mu, floor, under, flow.seg.sizes.astype(float)):
        lifted &= ~under
    factor = np.where(lifted, mu / np.maximum(floor, 1e-12), 1.0)
    t = np.where((lifted & scene)[:, None], soup.t / factor[:, None], soup.t)
    return replace(soup, lam=soup.lam * factor, t=t), lifted


def off_ground(flow: FlowFit, soup: Soup, component: Int, reliable: Mask) -> Float:
    """(N,) log ratio of the depth of the ground below a region to its own, 0 where none is known.

    The camera's motion explains what moves along the epipolar lines at a wrong depth. Where the
    ground is visible along the lower border of a region, its depth there shows that. The ground is
    that of the component with the largest area on a level plane.

    Args:
        flow: The flow of every superpixel.
        soup: Start.
        component: (N,) group that moves as one.
        reliable: (N,) True where the depth is reliable.
    """
    mu, area = 1 / soup.depth_at(flow.views.anchor), flow.seg.sizes
    floor, most = np.zeros(len(mu)), 0
    for c in range(int(component.max()) + 1):
        own = component == c
        level = ground(flow, mu, reliable & own)
        on = area[own & (np.abs(mu - level) < ON * level)].sum()
        if on > most:
            floor, most = level, on
    out = np.zeros(len(mu))
    if not floor.any():
        return out
    seg, middle = flow.seg, flow.middle
    on_ground = (floor > 0) & (np.abs(np.log(mu / np.maximum(floor, 1e-9))) < STANDS)
    depth = soup.depth_across(seg.pairs, middle)
    whole = (np.abs(np.log(depth[1] / depth[0])) < STEP) & ~seg.across(component)
    region = 1 + connected_pieces(~on_ground, seg, whole)
    around, across = outlines(region, seg), seg.across(region)
    ray = flow.views.anchor[floor > 0]
    plane = np.linalg.lstsq(ray, floor[floor > 0])[0]
    level = -np.log(np.maximum(middle @ plane, 1e-9))
    rise = (level - np.log(depth))[:, across].ravel()
    scene = component == SCENE
    for c in range(1, int(region.max()) + 1):
        mine = region == c
        low = (around.component == c) & around.below
        on = low & on_ground[around.neighbour]
        visible = on.any() and around.contact[on].sum() >= VISIBLE * around.contact[low].sum()
        large = area[mine].sum() > MOST_AREA * area.sum() and scene[mine].any()
        if mine.sum() >= FEWEST and visible and not large:
            out[mine] = quantile(rise[on], around.contact[on], CONTACT)
    return out
