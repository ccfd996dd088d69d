"""Ground plane: what stands on it, lies below it or floats above it.

A superpixel without usable flow (it leaves the image, is dark or moves too fast) borrows its depth
from its neighbours, and a component without a known support is scaled by its outline. Both may come
out far below the road. In an upright image, a level plane on which much of the scene lies and below
which almost nothing lies bounds the depth of everything seen below the horizon.

The camera's motion also explains an object that moves along the epipolar lines, such as an oncoming
car, but at a depth that is too small. Such an object floats: the ground that is visible along its
lower border is far behind it.

In a traffic jam a group of vehicles may be larger than the road. The static scene is then known by
what stands on it, and by its level ground.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.geometry.soup import Soup
from soup_nlp.start.components import (
    FIXED,
    GROUND,
    SCENE,
    TIES,
    connected_pieces,
    numbered,
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
"""Of the area with known depth, the least share on the ground and the largest share below it."""
RISES = 1.35
"""Ratio to the inverse depth of the ground from which on a superpixel is part of what may float;
superpixels on an outline contain pixels of both sides."""
STANDS = 0.1
"""Log ratio to the depth of the ground up to which a superpixel lies on it, and up to which a
region stands on it. Regions with the right depth have at most 0.16."""
STEP, FLOATS = 0.15, 0.2
"""Least log ratios to the depth of a region on its outline: of another surface, and of the plane of
the ground along its lower border."""
FEWEST = 3
"""Least number of superpixels of a region that may be off the ground."""
MOST_AREA = 0.25
"""Largest share of the image of a region of the scene whose contact with the ground tells its
depth: a larger one may be a table, which does not stand on the floor below its edge."""
MOST_CLIMB = 0.1
"""Largest share of its displacement that is across the ground, of what moves along it. Vehicles
have up to 0.07, boxes that swing and limbs 0.22 to 0.44."""
VISIBLE = 0.6
"""Least share of ground along the lower border of a region."""
FACES_DOWN = 0.7
"""Cosine between the normal of a superpixel and the vertical downwards from which it fills the gap
between a region and the ground below: it contains pixels of both."""
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
    total, area_on = weight[at].sum(), weight[at][on(best)].sum()
    if area_on < LEAST_ON * total or weight[reliable & below].sum() > MOST_BELOW * total:
        return none
    return np.maximum(plane_mu, 0.0)


def above_ground(
    flow: FlowFit, soup: Soup, reliable: Mask, component: Int, floor: Float
) -> tuple[Soup, Mask]:
    """The soup with unreliable or independently moving parts lifted to the ground.

    A component with most of its area below the ground comes nearer as a whole, and its translation
    becomes shorter. Single superpixels of the scene keep the translation they share.

    Args:
        flow: The flow of every superpixel.
        soup: Start, its components scaled.
        reliable: (N,) True where the depth is reliable and belongs to the scene.
        component: (N,) group that moves as one.
        floor: (N,) inverse depth of the ground (`ground`).

    Returns:
        The soup, and (N,) True in components that were lifted as a whole.
    """
    mu, weight = 1 / soup.depth_at(flow.views.anchor), flow.seg.sizes
    scene = component == SCENE
    lam, t = soup.lam.copy(), soup.t.copy()
    lifted = np.zeros(len(mu), bool)

    def below() -> Mask:
        return np.asarray(mu * soup.lam / lam < (1 - BELOW) * floor)

    for c in np.unique(component[below() & ~scene]):
        members = np.flatnonzero((component == c) & (floor > 0))
        under = members[below()[members]]
        if weight[under].sum() > 0.5 * weight[component == c].sum():
            lam[component == c] *= np.median(mu[under] / floor[under])
            lifted |= component == c
    left = below() & ~reliable
    factor = mu[left] * soup.lam[left] / lam[left] / floor[left]
    lam[left] *= factor
    t[left & scene] /= factor[scene[left], None]
    return Soup(lam, soup.n, soup.d, soup.R, t), lifted


class Region(NamedTuple):
    """A region off the ground that is continuous in depth, and the ground along its lower border.

    Attributes:
        members: (N,) True in the region.
        ground: Log ratio of the depth of the plane of the ground to that of the region, along the
            lower border.
        step: The same ratio with the depth of the superpixels on the ground there.
        climb: Share of its displacement in the scene that is across the ground, at the depth of the
            ground.
    """

    members: Mask
    ground: float
    step: float
    climb: float


def regions(
    flow: FlowFit, soup: Soup, floor: Float, component: Int, ratios: tuple[float, float]
) -> list[Region]:
    """Regions off the ground, with the ground visible along most of their lower borders.

    Regions of fewer than `FEWEST` superpixels are left out, and those of the scene with more than
    `MOST_AREA` of the image.

    Args:
        flow: The flow of every superpixel.
        soup: Start, its components scaled.
        floor: (N,) inverse depth of the ground (`ground`).
        component: (N,) group that moves as one.
        ratios: Between these ratios to its inverse depth a superpixel lies on the ground.
    """
    if not floor.any():
        return []
    seg, ray, middle = flow.seg, flow.views.anchor, flow.middle
    mu = 1 / soup.depth_at(ray)
    on_ground = (floor > 0) & (mu > ratios[0] * floor) & (mu <= ratios[1] * floor)
    depth = soup.depth_across(seg.pairs, middle)
    step = np.log(depth[1] / depth[0])
    whole = (np.abs(step) < STEP) & ~seg.across(component)
    region = 1 + connected_pieces(~on_ground, seg, whole)
    around, across = outlines(region, seg), seg.across(region)
    plane = np.linalg.lstsq(ray[floor > 0], floor[floor > 0])[0]
    # by entry of the outlines: log ratios of the other side's and the ground's depth to its own
    gap = np.concatenate([step[across], -step[across]])
    level = np.tile(-np.log(np.maximum(middle @ plane, 1e-9))[across], 2)
    rise = level - np.log(depth[:, across]).ravel()
    scene, first = component == SCENE, int(np.argmax(component == SCENE))
    down = soup.n[:, 1] > FACES_DOWN
    fills = down[seg.pairs[across].T.ravel()]
    out = []
    for c in range(1, int(region.max()) + 1):
        mine = region == c
        low = (around.component == c) & around.below
        on = low & on_ground[around.neighbour]
        visible = on.any() and around.weight[on].sum() >= VISIBLE * around.weight[low].sum()
        if mine.sum() < FEWEST or not visible:
            continue
        if seg.sizes[mine].sum() > MOST_AREA * seg.sizes.sum() and scene[mine].any():
            continue
        body = mine & ~down
        # what fills a gap has the depth of the rest
        own = level + np.log(np.median(mu[body])) if body.any() else rise
        values = np.where(fills, own, rise), gap
        above, off = (quantile(v[on], around.weight[on], GROUND) for v in values)
        point, t = (np.exp(above) * v[mine] for v in (soup.points(ray), soup.translation))
        moved = np.einsum("nij,nj->ni", soup.R[mine], point) + t - soup.translation[first]
        way = np.median(moved @ soup.R[first] - point, axis=0)
        climb = abs(way @ plane) / max(np.linalg.norm(way) * np.linalg.norm(plane), 1e-12)
        out.append(Region(mine, above, off, float(climb)))
    return out


def floating(flow: FlowFit, soup: Soup, floor: Float, component: Int) -> list[Region]:
    """The regions that float above the ground; the arguments are those of `regions`.

    A region floats if the ground along its lower border is clearly farther, and it moves along the
    ground there: what hangs in the air does not.
    """
    return [
        r
        for r in regions(flow, soup, floor, component, (1 - BELOW, RISES))
        if r.climb < MOST_CLIMB and r.ground > FLOATS and r.step > STEP
    ]


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
    for r in regions(flow, soup, floor, component, (np.exp(-STANDS), np.exp(STANDS))):
        out[r.members] = r.ground
    return out


def on_ground(
    flow: FlowFit, soup: Soup, reliable: Mask, component: Int, tie: Int
) -> tuple[Soup, Int, Int, Float]:
    """Soup, components and ties (N,) with what is below the ground lifted and what floats lowered.

    Args:
        flow: The flow of every superpixel.
        soup: Start, its components scaled.
        reliable: (N,) True where the depth is reliable.
        component: (N,) group that moves as one.
        tie: (N,) origin of its scale, an index of `TIES`.

    Returns:
        Soup, components, ties and (N,) inverse depth of the ground, see `ground`.
    """
    reliable = reliable & (component == SCENE)
    floor = ground(flow, 1 / soup.depth_at(flow.views.anchor), reliable)
    soup, lifted = above_ground(flow, soup, reliable, component, floor)
    tie = np.where(lifted & (tie != FIXED), TIES.index("ground"), tie)
    lam, component = soup.lam.copy(), component.copy()
    for region in floating(flow, soup, floor, component):
        # at the depth of the ground its flow shows a motion of its own
        lam[region.members] *= np.exp(region.ground)
        component[region.members] = component.max() + 1
        tie[region.members] = TIES.index("contact below")
    return replace(soup, lam=lam), numbered(component), tie, floor


def scene_first(flow: FlowFit, soup: Soup, reliable: Mask, label: Int, fixed: Mask) -> Int:
    """(N,) indices of the components (N,), that of the static scene first, see `SCENE`.

    The scene is the largest component. In a traffic jam that may be a group of vehicles: if it
    stands on a component with a level ground that stands on nothing, that one is the scene.

    Args:
        flow: The flow of every superpixel.
        soup: Planes, every motion in its own scale.
        reliable: (N,) True where the depth is reliable.
        label: (N,) index of the component.
        fixed: (N,) True in components that are fixed in the image.
    """
    scene, image = int(np.argmax(np.bincount(label, ~fixed))), label[flow.seg.labels]
    below = stands_on(image, scene)
    own = reliable & ~fixed & (label == below)
    mu = 1 / soup.depth_at(flow.views.anchor)
    if own.any() and stands_on(image, below) < 0 and ground(flow, mu, own).any():
        scene = below
    return numbered(np.where(label == scene, -1, label))


def stands_on(image: Int, component: int) -> int:
    """The component below the lower end of another one in an image (H, W) of components.

    It is below on most of the width; -1 for the border.
    """
    mine = image == component
    seen, under = mine.any(axis=0), len(image) - np.argmax(mine[::-1], axis=0)
    border = seen & (under == len(image))
    columns = np.flatnonzero(seen & ~border)
    count = np.bincount(image[under[columns], columns], minlength=1)
    return -1 if border.sum() >= count.max() else int(np.argmax(count))
