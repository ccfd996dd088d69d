"""One problem of scales: the log scales of all components are the minimum of one linear program.

Each rigid component has a scale that its flow does not tell. With z the depths of both sides of a
pair of neighbours and x the log scales, the program adds up

* contact: the pinball loss with the quantile `HIDES` of `x_a - x_b - log(z_b / z_a)` over the
  outline of a component, which hides what is behind it; below it, where it stands, it counts more;
* displacement: what a component moves farther than the scene;
* ground: how far a component reaches below the ground of the scene;
* order: by how much a component that covers another one is less than `LEAST_STEP_IN_FRONT`
  before it.

Interpolated superpixels, and components scaled by their outline, may come out far below the road.
In an upright image, a level plane on which much of the scene lies and below which almost nothing
lies bounds the depth of everything seen below the horizon.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.optimize import linprog

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.geometry.soup import Soup
from soup_nlp.start.regions import CONTRAST, FIXED, ORIGINS, SCENE, TOO_FAST, numbered
from soup_nlp.start.views import JUMP_PX, FlowFit

STEEP_COSINE = 0.5
"""Cosine of the angle to the vertical up to which a neighbour lies below."""
HIDES = 0.3
"""Quantile of the depth ratios along the outline of a component, which hides what is behind it."""
STRONG = 3.0
"""Weight of the contact below a component and of the order along an outline, relative to the
contact of a whole outline."""
FASTER, FREE_DISPLACEMENT = 1.5, 1.0
"""Price of a log unit by which a component moves farther than the scene, and how many are free."""
UNDER = 2.0
"""Price of a log unit by which a component lies below the ground."""
LEAST_STEP_IN_FRONT = 0.3
"""Least step of log depth along the outline of what covers something: true steps have medians of
0.2 to 1.9."""
MOST_LOG_DISPLACEMENT, MOST_LOG_SCALE = np.log(100.0), 6.0
"""If motion and contact differ by more, in logarithms, the camera is taken to be at rest; largest
log scale."""


class Rows(NamedTuple):
    """Rows `w_up max(r, 0) + w_down max(-r, 0)`, r = x_a - x_b - value, of a kind of `ORIGINS`.

    Every field is an array, or a number for all rows.
    """

    a: Int
    b: Int | int
    value: Float
    up: Float | float
    down: Float | float
    origin: Int | int


def minimum(count: int, parts: list[Rows]) -> tuple[Float, Int]:
    """(C,) log scales of least cost, that of the scene 0, and (C,) the kind of row behind each.

    A row decides if it is exact at the minimum; among several the one of the largest weight.
    """
    wide = (np.broadcast_arrays(*part) for part in parts)
    a, b, value, up, down, kind = (np.concatenate(v) for v in zip(*wide))
    m, each = len(a), np.arange(len(a))
    one = np.ones(m)
    columns = np.concatenate([a, b, count + each, count + m + each])
    A = sparse.coo_matrix(
        (np.concatenate([one, -one, -one, one]), (np.tile(each, 4), columns)), (m, count + 2 * m)
    )
    bounds = np.tile([-MOST_LOG_SCALE, MOST_LOG_SCALE], (count, 1))
    bounds[SCENE] = 0.0
    slack = np.tile([0.0, np.inf], (2 * m, 1))
    cost = np.concatenate([np.zeros(count), up, down])
    x = linprog(cost, A_eq=A.tocsr(), b_eq=value, bounds=np.vstack([bounds, slack])).x[:count]
    exact = np.abs(x[a] - x[b] - value) < 1e-7
    by_weight = np.flatnonzero(exact)[np.argsort((up + down)[exact], kind="stable")]
    origin = np.full(count, ORIGINS.index("nothing"))
    # of values with the same index the last one, that of the largest weight, is kept
    origin[b[by_weight]] = kind[by_weight]
    origin[a[by_weight]] = kind[by_weight]
    origin[SCENE] = ORIGINS.index("reference")
    return x, origin


def contact(flow: FlowFit, soup: Soup, label: Int, fixed: Mask) -> Rows:
    """Rows of contact between components (N,); none stands on one that is fixed (N,)."""
    seg = flow.seg
    across = seg.across(label)
    pairs = seg.pairs[across]
    zi, zk = soup.depth_across(pairs, flow.middle[across])
    way = np.diff(seg.anchors[pairs], axis=1)[:, 0]
    down = way[:, 1] / np.linalg.norm(way, axis=1)
    # every pair in both directions, but for those from the scene
    own, other = np.concatenate([pairs, pairs[:, ::-1]]).T
    mine = (label[own] != SCENE) & ~fixed[other]
    ratio = np.log(np.concatenate([zk / zi, zi / zk]))[mine]
    length = np.tile(seg.boundary_length[across], 2).astype(float)[mine]
    below = (np.concatenate([down, -down]) > STEEP_COSINE)[mine] & flow.options.upright
    a, b = label[own[mine]], label[other[mine]]
    part = 2 * a + below
    weight = length / np.bincount(part, length)[part] * np.where(below, STRONG, 1.0)
    origin = np.where(below, ORIGINS.index("contact below"), ORIGINS.index("outline"))
    return Rows(a, b, ratio, weight * (1 - HIDES), weight * HIDES, origin)


def displacement(flow: FlowFit, soup: Soup, label: Int) -> Rows:
    """Rows of how far the anchors of components (N,) move relative to the camera, which turns as
    the scene does; medians count."""
    point = soup.points(flow.views.anchor)
    first = int(np.argmax(label == SCENE))
    moved = np.einsum("nij,nj->ni", soup.R, point) + soup.translation - point @ soup.R[first].T
    far = np.linalg.norm(moved, axis=1)
    median = np.array([np.median(far[label == c]) for c in range(int(label.max()) + 1)])
    median = np.maximum(median, 1e-12)
    ratio = np.log(median / median[SCENE])
    c = np.flatnonzero((np.abs(ratio) < MOST_LOG_DISPLACEMENT) & (np.arange(len(ratio)) != SCENE))
    return Rows(c, SCENE, FREE_DISPLACEMENT - ratio[c], FASTER, 0.0, TOO_FAST)


def above(flow: FlowFit, soup: Soup, label: Int, floor: Float) -> Rows:
    """Rows of the ground, whose inverse depth is floor (N,), 0 where there is none."""
    mu, size = 1 / soup.depth_at(flow.views.anchor), flow.seg.sizes
    at = np.flatnonzero((floor > 0) & (label != SCENE))
    weight = UNDER * (size[at] / np.bincount(label, size)[label[at]])
    value = np.log(mu[at] / floor[at])
    return Rows(label[at], SCENE, value, weight, 0.0, ORIGINS.index("ground"))


def before(flow: FlowFit, soup: Soup, label: Int, order: Float) -> Rows:
    """Rows of the order by occlusion (P,) of components (N,), see `Start.order`.

    In an upright image none are below what covers: what stands on something has no step there.
    """
    seg, at = flow.seg, np.flatnonzero(order)
    ends = np.where(order[at, None] > 0, seg.pairs[at, ::-1], seg.pairs[at])
    way = np.diff(seg.anchors[ends], axis=1)[:, 0]
    steps = (not flow.options.upright) | (way[:, 1] <= STEEP_COSINE * np.linalg.norm(way, axis=1))
    at, ends = at[steps], ends[steps]
    front, back = label[ends].T
    z = soup.depth_across(ends, flow.middle[at])
    length = seg.boundary_length[at].astype(float)
    outline = numbered(front * (int(label.max()) + 1) + back)
    weight = STRONG * length / np.bincount(outline, length)[outline]
    value = np.log(z[1] / z[0]) - LEAST_STEP_IN_FRONT
    return Rows(front, back, value, weight, 0.0, ORIGINS.index("occlusion"))


def scaled(
    flow: FlowFit,
    soup: Soup,
    label: Int,
    order: Float,
    fixed: Mask | None = None,
    floor: Float | None = None,
) -> tuple[Float, Int]:
    """(N,) scale of the component (N,) of every superpixel, and (N,) what decides it.

    The image stands still before a moving camera where it is fixed (N,). The floor (N,) is the
    inverse depth of the ground, 0 where there is none; None without a rigid scene, with which
    displacements could be compared. For the order (P,) see `Start.order`.
    """
    count = int(label.max()) + 1
    if count == 1:
        return np.ones(len(soup)), np.full(len(soup), ORIGINS.index("reference"))
    fixed = np.zeros(len(soup), bool) if fixed is None else fixed
    parts = [contact(flow, soup, label, fixed), before(flow, soup, label, order)]
    if floor is not None:
        parts += [displacement(flow, soup, label), above(flow, soup, label, floor)]
    x, origin = minimum(count, parts)
    origin = np.where(fixed, FIXED, origin[label])
    return np.exp(x)[label], origin


def held(
    flow: FlowFit, soup: Soup, label: Int, origin: Int, order: Float, contrast: Float
) -> Float | None:
    """(P,) order that the energy holds, see `Start.order`; None where nothing is known.

    It is the order by occlusion (P,) where the images tell it, by contrasts (P,), and along all
    outlines of the components (N,) that it places. Those that contact makes too fast, by their ties
    (N,), keep the steps of the soup, which the energy would close otherwise.
    """
    pairs = flow.seg.pairs
    by_order = (origin == ORIGINS.index("occlusion"))[pairs].any(axis=1)
    told = np.abs(contrast) > CONTRAST
    out = np.where(told | (by_order & (flow.jump >= JUMP_PX)), order, 0.0)
    near = (origin == TOO_FAST)[pairs]
    z = soup.depth_across(pairs, flow.middle)
    second = np.where(z[1] < z[0], near[:, 1], 0.0)
    first = np.where(z[0] < z[1], near[:, 0], 0.0)
    out = np.where((out == 0) & flow.seg.across(label), second - first, out)
    return out if out.any() else None


# --- the ground -----------------------------------------------------------------------------------

LEVEL = 0.92
"""Least cosine between the normal of the ground and the vertical of the image."""
ON, OFF = 0.05, 0.2
"""Relative differences of inverse depth: up to the first a superpixel lies on the ground, from the
second on it lies below."""
LEAST_ON = 0.05
"""Of the area with known depth, the least share on the ground, and the largest share of another
surface below it. Of wrong flow less must lie below it than on it."""
LOWEST = 5.0
"""Depth relative to that of the ground up to which a surface may lie below it, as beside a dam:
then four times as low as the ground. More is wrong flow. Fitted on 000074 of KITTI 2012;
3 and 10 score within 12 % there."""
GROUND_TRIALS = 500
"""Number of planes through three superpixels that are tried."""


def ground(ray: Float, mu: Float, weight: Float, seed: int) -> Float:
    """(3,) p of the ground, whose inverse depth along a ray r is `p . r`; zeros without a ground.

    It follows from the inverse depths mu (N,) along the rays (N, 3) of an upright image, where
    their weight (N,), an area in pixels, is not 0.
    """
    none, at = np.zeros(3), np.flatnonzero(weight)
    if len(at) < 20:
        return none
    # inverse depth of a plane is linear in the ray; (x, y, 1) . p with p along the normal
    low = at[ray[at, 1] > np.quantile(ray[at, 1], 0.4)]
    if len(low) < 3:
        return none
    three = np.random.default_rng(seed).choice(low, (GROUND_TRIALS, 3))
    three = three[np.abs(np.linalg.det(ray[three])) > 1e-6]
    planes = np.linalg.solve(ray[three], mu[three][..., None])[..., 0]
    planes = planes[planes[:, 1] > LEVEL * np.linalg.norm(planes, axis=1)]
    if not len(planes):
        return none

    def on(planes: Float) -> Mask:
        plane_mu = planes @ ray[at].T
        return np.asarray((plane_mu > 0) & (np.abs(mu[at] - plane_mu) < ON * np.abs(plane_mu)))

    below = (mu[at] < (1 - OFF) * (planes @ ray[at].T)) @ weight[at]
    best = planes[np.argmax(on(planes) @ weight[at] - below)]
    for _ in range(3):
        inliers = at[on(best)]
        root = np.sqrt(weight[inliers]) / mu[inliers]
        best = np.linalg.lstsq(ray[inliers] * root[:, None], mu[inliers] * root)[0]
    plane_mu = ray @ best
    under = (weight > 0) & (plane_mu > 0) & (mu < (1 - OFF) * plane_mu)
    total, area_on = weight.sum(), weight[at][on(best)].sum()
    most = LEAST_ON * total if _level(mu, plane_mu, under, weight) else area_on
    return none if area_on < LEAST_ON * total or weight[under].sum() > most else best


def _level(mu: Float, floor: Float, under: Mask, weight: Float) -> bool:
    """Whether most of what lies under a plane (N,) has one distance from it.

    It is then real, as the floor beside a table; wrong flow leaves any depth.
    """
    if not under.any():
        return False
    ratio = mu[under] / floor[under]
    middle = np.quantile(ratio, 0.5, weights=weight[under], method="inverted_cdf")
    near = np.abs(ratio / middle - 1) < OFF
    return bool(weight[under][near].sum() > weight[under][~near].sum())


def on_ground(
    flow: FlowFit, soup: Soup, floor: Float, known: Mask, component: Int
) -> tuple[Soup, Mask]:
    """The soup with what is below the ground lifted to it, and (N,) True where that is.

    Superpixels of the scene keep the translation they share: their flow is wrong. Those whose depth
    is known (N,) may be lower. For the floor (N,) see `ground`.
    """
    mu = 1 / soup.depth_at(flow.views.anchor)
    lifted = mu < np.where(known, 1 / LOWEST, 1 - OFF) * floor
    factor = np.where(lifted, mu / np.maximum(floor, 1e-12), 1.0)
    t = np.where((lifted & (component == SCENE))[:, None], soup.t / factor[:, None], soup.t)
    return replace(soup, lam=soup.lam * factor, t=t), lifted
