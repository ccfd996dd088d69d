"""Inverse depth of every superpixel from what the flow tells of it and of the surface around it.

A superpixel without usable flow has no motion of its own to tell: it continues the surface that it
belongs to. Inverse depth is linear in the image on a plane, so a surface is continued by the
harmonic extension of inverse depth along edges where the image is continuous.
"""

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.geometry.graph import Segmentation

CONTRAST = 3.0
"""Fall-off of the weight of a pair with the difference of its colours in [0, 1]."""
JOINED = 1e-6
"""Weight of pairs across components, relative to those inside: it keeps the system regular."""


def likeness(seg: Segmentation) -> Float:
    """(P,) weight of two neighbours: the length of their boundary, less where colours differ."""
    colour = seg.pair_weight / seg.pair_weight.max(initial=1e-12)
    return np.asarray(seg.boundary_length * colour**CONTRAST)


def laplacian(weight: Float, seg: Segmentation) -> sparse.csr_matrix:
    """(N, N) Laplacian of the neighbour pairs with weights (P,)."""
    i, k = seg.pairs.T
    n = len(seg)
    W = sparse.coo_matrix((weight, (i, k)), (n, n)).tocsr()
    W = W + W.T
    return sparse.diags(np.asarray(W.sum(axis=1)).ravel()) - W


def harmonic(weight: Float, seg: Segmentation, value: Float, known: Mask) -> Float:
    """(N, C) values where they are known (N,), and their harmonic extension elsewhere."""
    L = laplacian(weight, seg)
    out = np.array(value, float)
    if known.all() or not known.any():
        return out
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
