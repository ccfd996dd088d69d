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


CONTACT = 0.4
"""Quantile of the depth ratios along a contact that is the scale of a component: it occludes what
is behind it."""
BELOW = 0.5
"""Cosine of the angle to the vertical up to which a neighbour lies below."""
TIES = (
    "reference",
    "contact below",
    "outline",
    "nothing",
    "fixed in the image",
    "given depth",
    "occlusion",
    "too fast",
)
"""What gives a component its scale. reference: it is the scene and defines the scale.
contact below: it stands on its lower neighbours. outline: it touches its neighbours. nothing: it
has no neighbour with a scale. fixed in the image: it stands
still there, though the camera moves, and is placed by its outline. given depth: a depth prior gives
it. occlusion: it covers its background, and is placed in front of the background by a guess. too
fast: contact is probably wrong, because it would make the component move much farther than the
scene."""
FIXED, TOO_FAST = TIES.index("fixed in the image"), TIES.index("too fast")


class Outlines(NamedTuple):
    """The B neighbour pairs that join two components, in both directions (2 B entries).

    Attributes:
        component: First component of the pair.
        other: Second component of the pair.
        neighbour: Superpixel of the second component.
        contact: Length of their boundary, pixels.
        below: Whether the second lies below the first in the image.
    """

    component: Int
    other: Int
    neighbour: Int
    contact: Float
    below: Mask


def outlines(label: Int, seg: Segmentation) -> Outlines:
    """Contacts between the components that `label` (N,) gives the superpixels."""
    ends = label[seg.pairs]
    across = ends[:, 0] != ends[:, 1]
    component, other = np.concatenate([ends[across], ends[across, ::-1]]).T
    neighbour = seg.pairs[across, ::-1].T.ravel()
    contact = np.tile(seg.boundary_length[across], 2).astype(float)
    way = np.diff(seg.anchors[seg.pairs[across]], axis=1)[:, 0]
    down = way[:, 1] / np.linalg.norm(way, axis=1)
    below = np.concatenate([down, -down]) > BELOW
    return Outlines(component, other, neighbour, contact, below)


def contact_scales(flow: FlowFit, soup: Soup, label: Int, fixed: Mask) -> tuple[Float, Int]:
    """Relative scale of every component, such that components touch their surroundings.

    In an upright image a component stands on its lower neighbours. Its scale is then the quantile
    `CONTACT` of the depth ratios to them; without lower neighbours, or if the image is not upright,
    of those along the whole outline. Components are placed one after the other, the one with the
    longest contact with placed components first. None stands on one that is fixed in the image.

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
    across = seg.across(label)
    zi, zk = soup.depth_across(seg.pairs[across], flow.middle[across])
    ratio = np.log(np.concatenate([zk / zi, zi / zk]))
    at_camera = np.zeros(count, bool)
    at_camera[label[fixed]] = True
    around = outlines(label, seg)
    keep = ~at_camera[around.other]
    a, b, contact = around.component[keep], around.other[keep], around.contact[keep]
    ratio, below = ratio[keep], around.below[keep] & upright
    placed = np.zeros(count, bool)
    placed[SCENE] = True
    while (touch := ~placed[a] & placed[b]).any():
        c = int(np.argmax(np.bincount(a[touch], contact[touch])))
        mine = touch & (a == c)
        stands = (mine & below).any()
        mine &= below | ~stands
        log_scale[c] = quantile((ratio + log_scale[b])[mine], contact[mine], CONTACT)
        tie[c] = TIES.index("contact below" if stands else "outline")
        placed[c] = True
    tie[at_camera] = FIXED
    return np.exp(log_scale)[label], tie[label]


def quantile(value: Float, weight: Float, share: float) -> float:
    """Weighted quantile: the value below which a share of the weight lies."""
    return float(np.quantile(value, share, weights=weight, method="inverted_cdf"))
