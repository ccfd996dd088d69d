"""Rigid components of superpixels: connected pieces, borrowed depths, scales by contact."""

from typing import NamedTuple

import numpy as np

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.geometry.graph import Segmentation, connected


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


STEEP = 0.5
"""Cosine of the angle to the vertical up to which a neighbour lies below."""
TIES = (
    "reference",
    "contact below",
    "outline",
    "nothing",
    "ground",
    "fixed in the image",
    "given depth",
    "occlusion",
    "too fast",
)
"""What gives a component its scale. reference: it is the scene and defines the scale.
contact below: it stands on its lower neighbours. outline: it touches its neighbours. nothing: it
has no neighbour with a scale. ground: it would lie below the ground. fixed in the image: it stands
still there, though the camera moves, and is placed by its outline. given depth: a depth prior gives
it. occlusion: it covers its background, and is placed in front of it by the least step that is
usual. too fast: contact is probably wrong, because it would make the component move much farther
than the scene."""
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
    below = np.concatenate([down, -down]) > STEEP
    return Outlines(component, other, neighbour, contact, below)


def quantile(value: Float, weight: Float, share: float) -> float:
    """Weighted quantile: the value below which a share of the weight lies."""
    return float(np.quantile(value, share, weights=weight, method="inverted_cdf"))
