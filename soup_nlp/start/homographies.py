"""The paper's initialisation: epipolar geometry and homography of every superpixel (Sec. 4.4.1).

The motion (R, t) of a superpixel comes from the flow of itself and of its nearest neighbours, by
essential matrix and cheirality; its plane then follows from `q ~ (R - t n^T / d) r`, which is
linear in n / d.

A superpixel for which this fails takes the result of the nearest one for which it succeeds. All
scales are equal and all anchors have the same depth, which the paper takes as a positive constant.
The result is the unorganised soup.
"""

import numpy as np

from soup_nlp.arrays import Float, Mask
from soup_nlp.geometry.plane import about_anchor, at_anchor, normal_and_distance
from soup_nlp.geometry.soup import Soup
from soup_nlp.start.epipolar import SIDEWAYS, Matches, Motion, essential_motion, stacked
from soup_nlp.start.views import LEAST_PIXELS, FlowFit

MOST_PIXELS = 400
"""Largest number of correspondences to which a motion is fitted."""


def unorganised(flow: FlowFit) -> tuple[Soup, Mask]:
    """The soup of independent superpixels with equal scales, and which of them borrowed.

    Returns:
        The soup, not normalised, and (N,) True where the result of another superpixel was taken.
    """
    seg, anchor = flow.seg, flow.views.anchor
    patches = [_patch(flow, i) for i in range(len(seg))]
    fails = np.array([p is None for p in patches])
    source = np.arange(len(seg)) if fails.all() else seg.nearest(~fails)
    sideways = SIDEWAYS, np.array([0.0, 0.0, 1.0])
    motions, planes = zip(*(patches[s] or sideways for s in source))
    R, t = stacked(motions)
    # a borrowed plane keeps depth and slopes, since at this anchor it may be behind the camera
    depth, slope = at_anchor(np.stack(planes), anchor[source])
    n, D = normal_and_distance(about_anchor(np.ones(len(seg)), slope, anchor))
    return Soup(np.ones(len(seg)), n, D, R, t / depth[:, None]), fails


def _patch(flow: FlowFit, i: int) -> tuple[Motion, Float] | None:
    """Motion of a superpixel, and m = -n / d with |t| = 1 as the length unit.

    None if its flow does not determine them.
    """
    views, o = flow.views, flow.options
    inside = views.subset(np.array([i])).matches().confident(MOST_PIXELS)
    if len(inside.ray) < LEAST_PIXELS:
        return None
    around = views.subset(np.append(i, flow.seg.knn[i])).matches()
    motion = essential_motion(around.confident(MOST_PIXELS), o.threshold_px)
    if motion is None:
        return None
    m, seen = plane_of(motion, inside), np.vstack([inside.ray, views.anchor[i]])
    return (motion, m) if (seen @ m > 0).all() else None


def plane_of(motion: Motion, matched: Matches) -> Float:
    """Least-squares m (3,) in `q ~ R r + t (m . r)`, errors perpendicular to the target ray."""
    y, q, t = matched.ray @ motion.R.T, matched.target, motion.t
    root = np.sqrt(matched.weight)[:, None]
    a = (y[:, :2] - q[:, :2] * y[:, 2:]) * root
    b = (t[:2] - q[:, :2] * t[2]) * root
    A = b[:, :, None] * matched.ray[:, None, :]
    return np.asarray(np.linalg.lstsq(A.reshape(-1, 3), -a.ravel(), rcond=None)[0])
