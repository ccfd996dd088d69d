"""Components of superpixels: connected pieces, which covers which, and what is continued.

Where two regions move differently, one covers the other along their outline. If they close in on
each other, pixels of the farther region are covered in the next frame: followed with the flow of
their own region they do not look as before. If they part, the area that appears between them
belongs to the farther region, and looks like the pixels of that region beside the outline.

A superpixel without usable flow has no motion of its own to tell: it continues the surface that it
belongs to. Inverse depth is linear in the image on a plane, so a surface is continued by the
harmonic extension of inverse depth along edges where the image is continuous.
"""

import cv2
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from soup_nlp.arrays import Float, Image, Int, Mask
from soup_nlp.data.pair import Pair
from soup_nlp.geometry.camera import rays
from soup_nlp.geometry.graph import Segmentation, connected
from soup_nlp.start.views import JUMP_PX, FlowFit


def connected_pieces(mask: Mask, seg: Segmentation) -> Int:
    """(N,) connected component of every superpixel of a mask (N,), -1 outside."""
    inside = mask[seg.pairs].all(axis=1)
    return np.where(mask, connected(seg.pairs[inside], len(seg)), -1)


def numbered(label: Int) -> Int:
    """(N,) indices in the same order, without gaps in their numbers."""
    return np.unique(label, return_inverse=True)[1].ravel()


SCENE = 0
"""Index of the component that is the static scene: depths and motions refer to it."""
ORIGINS = (
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
FIXED, TOO_FAST = ORIGINS.index("fixed in the image"), ORIGINS.index("too fast")


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


# --- order along outlines -------------------------------------------------------------------------

WIDEST_STRIP, LEAST_STRIP = 8, 3
"""Largest width of a strip beside an outline, pixels, and least number of its pixels."""
CONTRAST, MOST_GREY = 8.0, 40.0
"""Least difference between the mean costs of both strips that tells the order, and limit of the
cost of a pixel, grey levels."""
LEAST_ORDER = 0.8
"""Probability from which the order along an outline counts."""


def covering(pair: Pair, flow: FlowFit) -> Float:
    """(P,) contrast, grey levels: positive where the second superpixel of a pair covers the first.

    It is 0 without a flow discontinuity, and where too little is visible. With a strip S of each
    superpixel along the boundary, the affine flow u of that superpixel, and the speed
    `v = (u_i - u_k) . n` at which the boundary closes (n points from i to k), it is

        v > 1 px:   c_i - c_k   with  c = mean over x in S of |I_ref(x) - I_next(x + u(x))|
        v < -1 px:  c_k - c_i   with  c = mean over y in G of min over x in S |I_next(y) - I_ref(x)|

    where G is the area of the next frame between the boundary moved by u_i and moved by u_k.
    """
    seg, out = flow.seg, np.zeros(len(flow.seg.pairs))
    rows = np.flatnonzero(flow.jump >= JUMP_PX)
    if not len(rows):
        return out
    before, after = (
        cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.8)
        for image in (pair.image_ref, pair.image_next)
    )
    ends, edge = seg.pairs[rows], seg.boundary[rows]
    normal = _normals(edge, seg.anchors[ends[:, 1]] - seg.anchors[ends[:, 0]])

    def target(which: Int, at: Float) -> Float:
        # (M, ..., 2) pixels of the next frame
        return flow.followed(which, rays(pair.K_ref, at)) + pair.K_next[:2, 2]

    landed = [target(ends[:, e], edge) for e in (0, 1)]
    closing = np.einsum("mbc,mc->mb", landed[0] - landed[1], normal).mean(axis=1)
    step = np.arange(1.0, WIDEST_STRIP + 1)
    inside = step <= np.clip(np.abs(closing) + 1.5, 2, WIDEST_STRIP)[:, None, None]
    share = (np.arange(WIDEST_STRIP) + 0.5)[:, None] / WIDEST_STRIP
    between = landed[0][:, :, None] + (landed[1] - landed[0])[:, :, None] * share
    gap = _colours(after, between)
    covered, uncovered = np.full((2, len(rows), 2), np.nan)
    for e, side in ((0, -1.0), (1, 1.0)):
        at = edge[:, :, None] + side * normal[:, None, None] * step[:, None]
        u, v = np.moveaxis(np.rint(at).astype(int), -1, 0)
        owner = seg.labels.take(v * seg.labels.shape[1] + u, mode="clip")
        members = inside & (owner == ends[:, e, None, None])
        strip = np.where(members.reshape(len(members), -1, 1), _colours(before, at), np.nan)
        covered[:, e] = _cost(np.abs(strip - _colours(after, target(ends[:, e], at))).mean(axis=-1))
        off = np.abs(gap[:, :, None] - strip[:, None]).mean(axis=-1)
        enough = np.isfinite(strip[..., 0]).sum(axis=1) >= LEAST_STRIP
        uncovered[enough, e] = _cost(np.fmin.reduce(off[enough], axis=2))
    contrast = np.where(closing > 0, covered @ [1.0, -1.0], uncovered @ [-1.0, 1.0])
    out[rows] = np.where(np.abs(closing) > JUMP_PX, np.nan_to_num(contrast), 0.0)
    return out


def _normals(edge: Float, way: Float) -> Float:
    """(M, 2) normals of boundaries (M, B, 2) that point along `way` (M, 2)."""
    off = edge - edge.mean(axis=1, keepdims=True)
    scatter = np.einsum("mbi,mbj->mij", off, off)
    point = np.trace(scatter, axis1=1, axis2=2) < 1
    normal = np.where(point[:, None], way, np.linalg.eigh(scatter)[1][:, :, 0])
    normal = normal * np.where(np.sum(normal * way, axis=1) < 0, -1.0, 1.0)[:, None]
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


def _colours(image: Image, at: Float) -> Float:
    """(M, B T, 3) interpolated values of an image at (M, B, T, 2); NaN outside."""
    u, v = np.moveaxis(at.astype(np.float32).reshape(len(at), -1, 2), -1, 0)
    colours = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    rows, columns = image.shape[:2]
    visible = (u >= 0) & (v >= 0) & (u <= columns - 1) & (v <= rows - 1)
    return np.where(visible[..., None], colours, np.nan)


def _cost(change: Float) -> Float:
    """(M,) mean of limited changes (M, T), which are NaN where unknown; NaN for too few."""
    count = np.isfinite(change).sum(axis=1)
    total = np.nansum(np.minimum(change, MOST_GREY), axis=1)
    return np.where(count >= LEAST_STRIP, total / np.maximum(count, 1), np.nan)


def vote(contrast: Float, region: Int, seg: Segmentation) -> Float:
    """(P,) order of every pair with its probability, see `Start.order`.

    A pair along the outline between two regions (N,) votes if its contrast is above `CONTRAST`. All
    pairs of the outline take the order of the majority. With m of n votes for it, its probability
    is `(m + 1) / (n + 2)`. Pairs that voted against it, and outlines with a probability of at most
    `LEAST_ORDER`, get 0. For the contrast (P,) see `covering`.
    """
    ends = region[seg.pairs]
    a, b = ends.min(axis=1), ends.max(axis=1)
    turned = np.where(ends[:, 0] == a, 1.0, -1.0)
    votes = np.where((a != b) & (np.abs(contrast) > CONTRAST), np.sign(contrast) * turned, 0.0)
    outline = numbered(a * (int(region.max()) + 1) + b)
    total = np.bincount(outline, np.abs(votes))
    lead = np.bincount(outline, votes)
    sure = ((total + np.abs(lead)) / 2 + 1) / (total + 2)
    holds = (a != b) & (votes * lead[outline] >= 0) & (sure[outline] > LEAST_ORDER)
    return np.where(holds, np.sign(lead[outline]) * turned * sure[outline], 0.0)
