"""Components of superpixels: connected pieces, what touches them, and what is continued.

A superpixel without usable flow has no motion of its own to tell: it continues the surface that it
belongs to. Inverse depth is linear in the image on a plane, so a surface is continued by the
harmonic extension of inverse depth along edges where the image is continuous.
"""

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.geometry.graph import Segmentation, connected


def connected_pieces(mask: Mask, seg: Segmentation) -> Int:
    """(N,) connected component of every superpixel of a mask (N,), -1 outside."""
    inside = np.asarray(mask[seg.pairs].all(axis=1))
    return np.where(mask, connected_labels(inside, seg), -1)


def connected_labels(hold: Mask, seg: Segmentation) -> Int:
    """(N,) connected component of every superpixel, joined by the pairs that `hold` (P,) marks."""
    return connected(seg.pairs[hold], len(seg))


def numbered(label: Int) -> Int:
    """(N,) indices in the same order, without gaps in their numbers."""
    return np.unique(label, return_inverse=True)[1].ravel()


SCENE = 0
"""Index of the component that is the static scene: depths and motions refer to it."""
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


# --- what is not seen continues what is around it -------------------------------------------------

COLOUR_EXPONENT = 3.0
"""Fall-off of the weight of a pair with the difference of its colours in [0, 1]."""
JOINED = 1e-6
"""Weight of pairs across components, relative to those inside: it keeps the system regular."""


def likeness(seg: Segmentation) -> Float:
    """(P,) weight of two neighbours: the length of their boundary, less where colours differ."""
    colour = seg.pair_weight / seg.pair_weight.max(initial=1e-12)
    return np.asarray(seg.boundary_length * colour**COLOUR_EXPONENT)


def harmonic(weight: Float, seg: Segmentation, value: Float, known: Mask) -> Float:
    """(N, C) values where they are known (N,), and their harmonic extension elsewhere."""
    out = np.array(value, float)
    if known.all() or not known.any():
        return out
    W = sparse.coo_matrix((weight, tuple(seg.pairs.T)), (len(seg), len(seg))).tocsr()
    W = W + W.T
    L = sparse.diags(np.asarray(W.sum(axis=1)).ravel()) - W
    A = L[~known][:, ~known] + 1e-12 * sparse.identity(int((~known).sum()))
    b = -L[~known][:, known] @ out[known]
    out[~known] = spsolve(A.tocsc(), b).reshape(b.shape)
    return out


def belonging(seg: Segmentation, label: Int, seen: Mask) -> Int:
    """(N,) label of every superpixel: its own where it is seen, else that which a random walk
    along continuous edges meets first with the largest probability."""
    if seen.all() or not seen.any():
        return label
    values, index = np.unique(label[seen], return_inverse=True)
    one = np.zeros((len(label), len(values)))
    one[np.flatnonzero(seen), index] = 1.0
    share = harmonic(likeness(seg), seg, one, seen)
    return np.where(seen, label, values[np.argmax(share, axis=1)])


def continued(seg: Segmentation, mu: Float, label: Int, known: Mask) -> Float:
    """(N,) inverse depth where it is known, elsewhere continued inside the same label (N,)."""
    weight = likeness(seg) * np.where(seg.across(label), JOINED, 1.0)
    return np.maximum(harmonic(weight, seg, mu, known), 1e-9)
