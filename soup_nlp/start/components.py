"""Rigid components of superpixels: connected pieces, borrowed depths, scales by contact."""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.geometry.graph import Segmentation, connected
from soup_nlp.geometry.soup import Soup
from soup_nlp.start.views import FlowFit


def connected_pieces(mask: Mask, seg: Segmentation, hold: Mask | bool = True) -> Int:
    """(N,) connected component of every superpixel of a mask (N,), -1 outside.

    Pairs of neighbours join them, if `hold` (P,) marks these pairs.
    """
    joined = np.asarray(mask[seg.pairs].all(axis=1) & hold)
    return np.where(mask, connected_labels(joined, seg), -1)


def connected_labels(hold: Mask, seg: Segmentation) -> Int:
    """(N,) connected component of every superpixel, joined by the pairs that `hold` (P,) marks."""
    return connected(seg.pairs[hold], len(seg))


def numbered(label: Int) -> Int:
    """(N,) indices in the same order, without gaps in their numbers."""
    return np.unique(label, return_inverse=True)[1].ravel()


SCENE = 0
"""Index of the component that is the static scene: depths and motions refer to it."""


def borrow(
    mu: Float, slope: Float, label: Int, weak: Mask, seg: Segmentation
) -> tuple[Float, Float]:
    """Weak superpixels take the median inverse depth of strong neighbours of their motion.

    A motion without any strong superpixel borrows from those of other motions.

    Args:
        mu: (N,) inverse depth at the anchor, in units of |t|.
        slope: (N, 2) relative change of mu at the superpixel's radius; 0 where borrowed.
        label: (N,) index of the motion.
        weak: (N,) True where the depth is not reliable, not everywhere.
        seg: Superpixels and graphs.

    Returns:
        mu and slope after borrowing.
    """
    mu, slope = mu.copy(), slope.copy()
    for c in np.unique(label[weak]):
        borrowers, strong = weak & (label == c), ~weak & (label == c)
        lenders = np.flatnonzero(strong if strong.any() else ~weak)
        count = min(5, len(lenders))
        _, near = cKDTree(seg.anchors[lenders]).query(seg.anchors[borrowers], k=count)
        mu[borrowers] = np.median(mu[lenders][near.reshape(borrowers.sum(), -1)], axis=1)
        slope[borrowers] = 0.0
    return mu, slope


OUTLINE, GROUND, MOST = 0.2, 0.4, 0.6
"""Quantiles of the depth ratios: along the outline of a component, along its contact with lower
neighbours, and along the outline as the upper limit of a scale by contact below."""
BELOW = 0.5
"""Cosine of the angle to the vertical up to which a neighbour lies below."""
TIES = (
    "reference",
    "contact below",
    "outline",
    "cut off below",
    "nothing",
    "ground",
    "fixed in the image",
    "given depth",
    "occlusion",
    "too fast",
)
"""What gives a component its scale. reference: it is the scene and defines the scale.
contact below: it stands on its lower neighbours. outline: it touches its neighbours. cut off below:
the lower image border hides its support. nothing: it has no neighbour with a scale. ground:
it was lifted to the ground. fixed in the image: it stands still there, though the camera moves,
and is placed by its outline. given depth: a depth prior gives it. occlusion: it covers its
background, and is placed in front of the background by a guess. too fast: contact is probably
wrong, because it would make the component move much farther than the scene."""
FIXED, TOO_FAST = TIES.index("fixed in the image"), TIES.index("too fast")
UNSUPPORTED = 1e-6
"""Added to the placed share of a component's support, so that the longest contact goes first where
no support is placed."""


class Outlines(NamedTuple):
    """The B neighbour pairs that join two components, in both directions (2 B entries).

    Attributes:
        component: First component of the pair.
        other: Second component of the pair.
        neighbour: Superpixel of the second component.
        contact: Length of their boundary, pixels.
        below: Whether the second lies below the first in the image.
        weight: Contact times the squared height difference to the top of the first component, since
            a car touches the road at its wheels only.
        top: (C,) row of the highest anchor of every component.
    """

    component: Int
    other: Int
    neighbour: Int
    contact: Float
    below: Mask
    weight: Float
    top: Float


def outlines(label: Int, seg: Segmentation) -> Outlines:
    """Contacts between the components that `label` (N,) gives the superpixels."""
    ends = label[seg.pairs]
    across = ends[:, 0] != ends[:, 1]
    component, other = np.concatenate([ends[across], ends[across, ::-1]]).T
    neighbour = seg.pairs[across, ::-1].T.ravel()
    contact = np.tile(seg.boundary_length[across], 2).astype(float)
    way = np.diff(seg.anchors[seg.pairs[across]], axis=1)[:, 0]
    down = way[:, 1] / np.linalg.norm(way, axis=1)
    top = np.full(int(label.max()) + 1, np.inf)
    np.minimum.at(top, label, seg.anchors[:, 1])
    low = np.maximum(np.tile(seg.boundary[across, :, 1].mean(axis=1), 2) - top[component], 1.0)
    below = np.concatenate([down, -down]) > BELOW
    return Outlines(component, other, neighbour, contact, below, contact * low**2, top)


def contact_scales(flow: FlowFit, soup: Soup, label: Int, fixed: Mask) -> tuple[Float, Int]:
    """Relative scale of every component, such that components touch their surroundings.

    In an upright image a component stands on its lower neighbours. Its scale is then the quantile
    `GROUND` of the depth ratios to them, weighted by `Outlines.weight`. A component occludes what
    is behind it, so its depth is at most that of its neighbours; therefore the scale is at most the
    quantile `MOST` of the depth ratios along the whole outline. If the lower neighbours make up
    less than a tenth of the contact, or if the image is not upright, the scale is the quantile
    `OUTLINE` of the depth ratios along the whole outline.

    Components are placed one after the other, in the order of their contact length with placed
    components times the placed share of their lower neighbours (1 where there are none). The roof
    of a car that is cut into pieces is thus placed after its wheels, and not on the background.
    No component stands on one that is fixed in the image.

    Args:
        flow: The flow of every superpixel.
        soup: Planes, every motion in its own scale.
        label: (N,) index of the component.
        fixed: (N,) True in components that are fixed in the image.

    Returns:
        (N,) scale of every superpixel's component, and (N,) its origin, an index of `TIES`.
    """
    seg, upright = flow.seg, flow.options.upright
    count = int(label.max()) + 1
    log_scale = np.zeros(count)
    tie = np.full(count, TIES.index("nothing"))
    tie[SCENE] = TIES.index("reference")
    if count == 1 or not len(seg.pairs):
        return np.ones(len(soup)), tie[label]
    zi, zk = depth_from_inside(flow, soup, label)
    ratio = np.log(np.concatenate([zk / zi, zi / zk]))
    at_camera = np.zeros(count, bool)
    at_camera[label[fixed]] = True
    around = outlines(label, seg)
    keep = ~at_camera[around.other]
    a, b, contact, weight = (
        v[keep] for v in (around.component, around.other, around.contact, around.weight)
    )
    ratio, below = ratio[keep], around.below[keep] & upright
    support = np.bincount(a[below], weight[below], minlength=count)
    placed = np.zeros(count, bool)
    placed[SCENE] = True
    while not placed.all():
        touch = ~placed[a] & placed[b]
        if not touch.any():
            break
        length = np.bincount(a[touch], contact[touch], minlength=count)
        on = touch & below
        stands = np.bincount(a[on], weight[on], minlength=count) / np.maximum(support, 1.0)
        stands[support == 0] = 1.0
        c = int(np.argmax(length * (stands + UNSUPPORTED)))
        mine = touch & (a == c)
        ground = mine & below
        value = ratio + log_scale[b]
        if contact[ground].sum() >= 0.1 * contact[mine].sum():
            log_scale[c] = min(
                quantile(value[ground], weight[ground], GROUND),
                quantile(value[mine], contact[mine], MOST),
            )
            tie[c] = TIES.index("contact below")
        else:
            log_scale[c] = quantile(value[mine], contact[mine], OUTLINE)
            tie[c] = TIES.index("outline")
        placed[c] = True
    tie[at_camera] = FIXED
    return np.exp(log_scale)[label], tie[label]


def depth_from_inside(flow: FlowFit, soup: Soup, label: Int) -> Float:
    """(2, B) depths of both components at the B pairs across outlines, from planes further inside.

    The flow is blurred across an outline, which falsifies the planes of the superpixels along it.
    The depth is therefore the median over their inner neighbours, whose planes are extended to the
    boundary; without inner neighbours the superpixel's own plane is used. `label` (N,) gives the
    components.
    """
    seg, across = flow.seg, flow.seg.across(label)
    pairs, ray = seg.pairs[across], flow.middle[across]
    outline = np.zeros(len(soup), bool)
    outline[pairs] = True
    links = np.concatenate([seg.pairs[~across], seg.pairs[~across, ::-1]])
    first, second = links[~outline[links[:, 1]]].T
    depth = soup.depth_across(pairs, ray)
    for side, p in np.ndindex(depth.shape):
        inner = second[first == pairs[p, side]]
        if len(inner):
            inner_depth = soup.depth_across(inner[None], ray[p : p + 1])
            depth[side, p] = 1 / np.median(1 / inner_depth)
    return depth


def quantile(value: Float, weight: Float, share: float) -> float:
    """Weighted quantile: the value below which a share of the weight lies."""
    return float(np.quantile(value, share, weights=weight, method="inverted_cdf"))
