"""Bending surfaces: flow discontinuities, surfaces, and an initialisation without relief.

The flow is discontinuous along the outline of a rigid component that moves independently. On a
bending surface it is continuous, but no single rigid motion explains it: one explains the flow of
most superpixels of a rigid surface, whatever else moves there. If a bending surface is cut into
rigid pieces, each with its own parallax, the depths do not follow its shape. The test does not
depend on the number of superpixels or of rigid components.
"""

from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.geometry import rotation
from soup_nlp.geometry.graph import connected
from soup_nlp.geometry.soup import Soup
from soup_nlp.start.epipolar import MOTION_STEP, Motion
from soup_nlp.start.labelling import (
    IN_NOISE,
    LEAST_GAP_PX,
    LEAST_SHARED,
    MOTION_PIXELS,
    PIECE_SIZE,
    Labelling,
    candidates,
    dominant,
)
from soup_nlp.start.regions import connected_pieces, numbered
from soup_nlp.start.views import JUMP_PX, FlowFit, Views

REFERENCE = 1000
"""Number of superpixels at which the noise is measured: an affine flow leaves a residual that grows
with the diameter of the superpixel."""
AT_REST, TURN_SHARE = 0.8, 9e-5
"""Least ratio of what a turn explains to what the main rigid motion explains, if the camera rests,
and the error up to which it explains the flow, as a share of the longer side of a small image."""
LEAST_MOVED_DEPTH, LEAST_SCALE = 1e-3, 0.02
"""Least depth of a moved point, and least scale of the refinement of a motion, pixels."""
LEAST_GAIN = 1e-3
"""Relative change of the loss that ends a fit of `fit_robustly`."""


def least_gap(noise: float) -> float:
    """Pixels of relief that determine the depth of a component, by the noise of the flow."""
    return max(LEAST_GAP_PX, IN_NOISE * noise)


def reference_noise(residual: Float) -> float:
    """Noise of the flow, pixels, from (N,) residuals of affine flows, whatever N."""
    return float(np.median(residual) * np.sqrt(len(residual) / REFERENCE))


def turn_alone(flow: FlowFit, choice: Labelling) -> Float | None:
    """The camera's (3, 3) rotation, if a turn explains nearly as much as the main motion does.

    Of what is seen it explains at least `AT_REST` of the superpixels that the main rigid motion
    explains with depths. Explained is an error of at most `IN_NOISE` noises beyond that of an
    affine flow, or of `LEAST_SHARED` (in a small image `TURN_SHARE` of its longer side). A zoom and
    a shift of the next image are free, because they leave a residual that depths explain; the
    rotation itself, which a shift can replace, is that of the plain turn.
    """
    at = np.flatnonzero(flow.views.usable)
    if not len(at):
        return None
    least = min(LEAST_SHARED, TURN_SHARE * max(flow.seg.labels.shape))
    most = max(least, IN_NOISE * reference_noise(flow.residual))
    rigid = (choice.label == 0) & (choice.excess < most)
    turned = fit_turn(flow.views.subset(at), ANY_TURN)[1] - flow.residual[at] < most
    if not turned.any() or turned.sum() < AT_REST * rigid[at].sum():
        return None
    return fit_turn(flow.views.subset(at[turned]))[0]


PLAIN_TURN, ANY_TURN = 4, 7
"""Parameters of `turned`: rotation and focal length; and with zoom and shift between the images."""


def turned(x: Float) -> Float:
    """Matrices (..., 3, 3) that turn rays, by parameters (..., 7): a rotation vector, the log of a
    factor of the focal length, and zoom (log) and shift of the next image, as by stabilisation."""
    out = rotation.exp(x[..., :3])
    out[..., 2] *= np.exp(-x[..., 3:4])
    out[..., 2, :] *= np.exp(x[..., 3:4] - x[..., 4:5])
    out[..., :2, :] += x[..., 5:, None] * out[..., 2:, :]
    return out


def displaced(x: Float) -> Float:
    """Matrices (..., 3, 4) that move rays with inverse depths (4 components), by parameters
    (..., 7): a rotation vector, a translation, and a number added to all inverse depths."""
    R, T = rotation.exp(x[..., :3]), x[..., 3:6, None]
    R[..., 2:] += x[..., 6:, None] * T
    return np.concatenate([R, T], axis=-1)


def fit_robustly(
    matrix: Callable[[Float], Float], size: int, point: Float, target: Float, scale: Float
) -> tuple[Float, Float]:
    """(7,) parameters with the least Cauchy loss of points off their targets, by narrowing scales,
    and (M, 2) distances there, pixels.

    The first `size` parameters of the matrices (..., 3, C), `turned` or `displaced`, are free, the
    others 0. They move points (M, C) to target rays (M, 2), without their third component; `scale`
    (M, 2) weighs the distances, pixels per ray unit.
    """
    point, target, scale = point.T, target.T, scale.T
    free = np.eye(ANY_TURN)[:size]

    def moved(x: Float) -> tuple[Float, Float]:
        out = matrix(x @ free) @ point
        depth = np.maximum(out[2], LEAST_MOVED_DEPTH)
        return out[:2] / depth, depth

    def miss(x: Float) -> Float:
        return (scale * (moved(x)[0] - target)).ravel()

    def slope(x: Float) -> Float:
        (at, depth), step = moved(x), MOTION_STEP * free
        change = (matrix(x @ free + step) - matrix(x @ free - step)) @ point / (2 * MOTION_STEP)
        return (scale / depth * (change[:, :2] - at * change[:, 2:])).reshape(size, -1).T

    x = np.zeros(size)
    for width in (10.0, 3.0, 1.0, 0.3):
        fit = least_squares(
            miss, x, slope, loss="cauchy", f_scale=width, ftol=LEAST_GAIN, max_nfev=30
        )
        x = fit.x
    return x @ free, miss(x).reshape(2, -1).T


def fit_turn(views: Views, size: int = PLAIN_TURN) -> tuple[Float, Float]:
    """Rotation of the turn that explains a flow best, and (N,) mean error of that turn, pixels.

    The first `size` parameters of `turned` are free.
    """
    ray, target, weight, _ = views.matches(2 * MOTION_PIXELS)
    scale = np.sqrt(weight)[:, None] * views.focal
    x, _ = fit_robustly(turned, size, ray, target[:, :2], scale)
    return rotation.exp(x[:3]), views.distance(views.ray @ turned(x).T)


def moving_pieces(flow: FlowFit) -> Int:
    """(N,) connected piece of what moves before a camera that turns at most; 0 is what the turn
    explains, and pieces with too few superpixels whose flow is usable."""
    still = fit_turn(flow.views)[1] < JUMP_PX
    continuous = ~flow.seg.across(still) & (flow.jump < JUMP_PX)
    piece = connected(flow.seg.pairs[continuous], len(still))
    still |= np.bincount(piece, flow.views.usable)[piece] < PIECE_SIZE
    return numbered(np.where(still, -1, piece))


LEAST_SURFACE = 0.06
"""Least share of the superpixels that makes a surface: a smaller one joins a neighbour, because a
few superpixels with a wrong flow look like a bending one."""


def joined(flow: FlowFit, surface: Int) -> Int:
    """(N,) surfaces; those with too few usable superpixels are joined to a neighbour.

    The smallest joins the neighbour with the longest common outline, until all are large enough.
    """
    while True:
        across = flow.seg.across(surface)
        ends, length = surface[flow.seg.pairs[across]], flow.seg.boundary_length[across]
        size = np.bincount(surface, flow.views.usable)
        small = np.unique(ends[size[ends] < LEAST_SURFACE * len(surface)])
        if not len(small):
            return surface
        c = small[np.argmin(size[small])]
        beside = (ends == c).any(axis=1)
        outline = np.bincount(ends[beside].sum(axis=1) - c, length[beside])
        surface = np.where(surface == c, np.argmax(outline), surface)


def constant_depth(views: Views, turn: Float | None = None) -> tuple[Soup, Float]:
    """Fronto-parallel superpixels at depth 1 in both frames, rotated in the image plane.

    Two views of a bending surface do not determine its relief. An initialisation without relief
    favours none, and the energy determines it. The camera's rotation `turn` (3, 3) is applied last.
    Returns the soup, mean plane distance 1, and (N,) its mean re-projection error in pixels.
    """
    turn = np.eye(3) if turn is None else turn
    w = views.weight + 1e-9
    total = w.sum(axis=1)
    target = views.target @ turn
    target = target / target[..., 2:]
    a, b = (np.sum(w[..., None] * v, axis=1) / total[:, None] for v in (views.ray, target))
    spread = (w[..., None] * (target - b[:, None])).transpose(0, 2, 1)
    M = spread @ (views.ray - a[:, None])
    # Procrustes; equal depths leave a turn about the optical axis
    angle = np.arctan2(M[:, 1, 0] - M[:, 0, 1], M[:, 0, 0] + M[:, 1, 1])
    R = rotation.exp(angle[:, None] * np.array([0.0, 0.0, 1.0]))
    T = b - np.einsum("nij,nj->ni", R, a)
    R, T = turn @ R, T @ turn.T
    error = views.distance(views.ray @ R.transpose(0, 2, 1) + T[:, None])
    n = np.tile([0.0, 0.0, -1.0], (len(R), 1))
    return Soup(np.ones(len(R)), n, np.ones(len(R)), R, T).normalised(), error


DISCONTINUOUS = 8.0
"""Ratio of the 95 % quantile of the flow's jumps inside surfaces to their median above which parts
move differently: surfaces that bend have at most 6.4, vehicles that seem to bend at least 9.2."""


def discontinuous(flow: FlowFit, surface: Int, bends: Mask) -> Mask:
    """(N,) True in connected regions that bend although the flow jumps inside surfaces (N,)."""
    region, pairs = connected_pieces(bends, flow.seg), flow.seg.pairs
    inside = (bends & flow.views.usable)[pairs].all(axis=1) & ~flow.seg.across(surface)
    out = np.zeros(len(bends), bool)
    for c in np.unique(region[bends]):
        jump = flow.jump[inside & (region[pairs] == c).all(axis=1)]
        if len(jump) and np.quantile(jump, 0.95) > DISCONTINUOUS * np.median(jump):
            out |= region == c
    return out


TELLS = 7.0
"""Ratio of what depth explains to what it leaves from which the flow tells of depth. Of rigid pairs
`sun3d_lounge` and `s7_kitchen_150` have the least, 7.8; `rgbd/opening_door`, which bends, 6.5."""
MOST_NOISES, LEAST_NOISES, LEAST_EXCESS_PX, MOST_EXCESS_PX = 2.5, 4.0, 0.01, 0.08
"""Median excess of the error, in units of the noise, from which a surface may bend; below
`LEAST_NOISES` noises, within these limits in pixels, it never does."""


def surface_motions(flow: FlowFit, surface: Int) -> tuple[list[Motion], Mask]:
    """The motion that most of the image shares, the best one of each surface (N,) that does not
    bend, and (N,) True where the surface bends.

    A surface bends if the best rigid motion leaves a median excess over the residual of affine
    flows that noise does not explain, or from which depth, which explains what a turn alone does
    not, stands out less than `TELLS` times: an error shared along the epipolar lines would then
    cause much of the relief.
    """
    views, usable = flow.views, flow.views.usable
    noise = reference_noise(flow.residual)
    least = float(np.clip(LEAST_NOISES * noise, LEAST_EXCESS_PX, MOST_EXCESS_PX))
    motions = [dominant(flow)]
    surface = joined(flow, surface)
    bends = np.zeros(len(surface), bool)
    for c in np.unique(surface[usable]):
        at = np.flatnonzero((surface == c) & usable)
        tried = candidates(flow, at, motions[0], motions[:1], max(noise, LEAST_SCALE))
        excess = np.median(views.subset(at).fit(tried).cost - flow.residual[at, None], axis=0)
        gain = np.median(fit_turn(views.subset(at), ANY_TURN)[1] - flow.residual[at])
        best = int(np.argmin(excess))
        if excess[best] > max(least, min(gain / TELLS, MOST_NOISES * noise)):
            bends |= surface == c
        else:
            motions.append(tried[best])
    return motions, bends
