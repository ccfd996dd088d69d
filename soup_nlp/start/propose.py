"""Initial proposal of every superpixel: candidates, choice, planes, scales (paper, Sec. 4.4.1)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.geometry.graph import Segmentation, connected
from soup_nlp.geometry.plane import about_anchor, at_anchor, normal_and_distance
from soup_nlp.geometry.soup import Soup
from soup_nlp.start.bending import (
    constant_depth,
    discontinuous,
    moving_pieces,
    surface_motions,
    turn_alone,
)
from soup_nlp.start.epipolar import (
    LEAST_MATCHES,
    SIDEWAYS,
    Matches,
    Motion,
    essential_motion,
    stacked,
)
from soup_nlp.start.labelling import (
    LEAST_NOISE,
    PIECE_SIZE,
    Labelling,
    fixed_to_camera,
    labelled,
    limited_noise,
    with_least_relief,
)
from soup_nlp.start.regions import ORIGINS, SCENE, connected_pieces, continued, numbered, vote
from soup_nlp.start.scales import ground, held, on_ground, scaled
from soup_nlp.start.views import JUMP_PX, LEAST_SEEN, FlowFit, Views, determined


@dataclass(frozen=True, eq=False)
class Start:
    """The initial soup, and how it was made.

    Attributes:
        soup: Start of the optimisation, mean plane distance 1.
        error: (N,) mean re-projection error of every superpixel, pixels.
        parallax: (N,) pixels by which its translation moves the anchor.
        interpolated: (N,) True where plane or motion come from neighbours.
        motion: (N,) index of its motion in `motions`, -1 where it has its own.
        component: (N,) index of the rigid component, which shares one scale: the superpixels of a
            dominant motion, or a connected piece of superpixels with their own motions; `SCENE`.
        part: (N,) group that moves as one: its component; at rest each piece that moves.
        motions: The M motions that superpixels share.
        covariance: (M, 5, 5) covariances by the error that a flow shares, see `relief_spread`.
        surface: (N,) index of the surface: a connected group without flow discontinuities inside.
        origin: (N,) origin of the scale of every superpixel's component, an index of `ORIGINS`.
        bends: (N,) True where the energy for bending surfaces is used. Its connected regions are
            components that start at a constant depth, each superpixel with a motion of its own.
        unexplained: (N,) True where nothing tells the depth: the motion leaves a large error, or a
            region bends although its flow jumps, see `discontinuous`.
        wrong: (N,) True where the motion does not explain the flow, which does not count then.
        at_rest: Whether the camera is taken to be at rest, or to turn only.
        noise: Noise of the flow, pixels, see `limited_noise`.
        order: (P,) probability that the second superpixel of a neighbour pair covers the first one,
            negative if the first covers the second, 0 where neither is known (`vote`, `held`);
            None where nothing is known.
        scatter: (N,) root mean square difference of log depth from the starts that were not taken
            (`most_usual`); 0 where there is one.
    """

    soup: Soup
    error: Float
    parallax: Float
    interpolated: Mask
    motion: Int
    component: Int
    part: Int
    motions: list[Motion]
    covariance: Float
    surface: Int
    origin: Int
    bends: Mask
    unexplained: Mask
    wrong: Mask
    at_rest: bool = False
    noise: float = LEAST_NOISE
    order: Float | None = None
    scatter: Float | float = 0.0

    def __str__(self) -> str:
        count = len(self.motions)
        parts = [
            f"{len(self.soup)} superpixels",
            f"{count or 'no'} shared motion{'s' * (count != 1)}",
            f"median error {np.median(self.error):.2f} px",
            f"{int(self.interpolated.sum())} interpolated",
        ]
        parts += [f"{self.bends.mean():.0%} bending"] * self.bending
        return f"Start({', '.join(parts)})"

    __repr__ = __str__

    @classmethod
    def whole(
        cls, views: Views, soup: Soup, error: Float, interpolated: Mask, noise: float
    ) -> Self:
        """A start whose only component and surface is the whole image, without shared motions."""
        zero, none = np.zeros(len(soup), np.int64), np.zeros(len(soup), bool)
        return cls(
            soup=soup,
            error=error,
            parallax=views.parallax(soup),
            interpolated=interpolated,
            motion=zero - 1,
            component=zero,
            part=zero,
            motions=[],
            covariance=np.zeros((0, 5, 5)),
            surface=zero,
            origin=zero,
            bends=none,
            unexplained=none,
            wrong=none,
            noise=noise,
        )

    @property
    def variance(self) -> Float:
        """(N,) variance of log depth by noise and parallax; inf where the depth is interpolated."""
        with np.errstate(divide="ignore"):
            return np.asarray((self.noise / np.where(self.interpolated, 0.0, self.parallax)) ** 2)

    @property
    def bending(self) -> bool:
        """Whether a region bends."""
        return bool(self.bends.any())


def most_usual(starts: Sequence[Start], seg: Segmentation, ray: Float) -> tuple[int, Start]:
    """The index of the start that is nearest to the others, and that start with their `scatter`.

    Starts from other samples of one flow label and scale components differently where it hardly
    tells them; most agree where one goes astray. Of S starts, the one with the least mean
    difference of log depth at the anchors' rays (N, 3) over pixels and other starts is taken, up to
    a common scale.
    """
    if len(starts) == 1:
        return 0, starts[0]
    depth = np.stack([np.log(start.soup.depth_at(ray)) for start in starts])
    depth -= np.median(depth, axis=1, keepdims=True)
    apart = np.abs(depth[:, None] - depth)
    best = int(np.argmin(apart.sum(axis=1) @ seg.sizes))
    scatter = np.sqrt(np.sum(apart[best] ** 2, axis=0) / (len(starts) - 1))
    return best, replace(starts[best], scatter=scatter)


def propose(flow: FlowFit, contrast: Float | None = None) -> Start:
    """Rotation, translation, plane and scale of every superpixel from its flow.

    Contrasts (P,) across outlines (`covering`) give the order by occlusion; None for none.
    """
    seg, views, o = flow.seg, flow.views, flow.options
    if o.method == "homography":
        soup, interpolated = unorganised(flow)
        soup = soup.normalised()
        error = views.distance(soup.moved(soup.points(views.ray)))
        return Start.whole(views, soup, error, interpolated, limited_noise(error))
    contrast = np.zeros(len(seg.pairs)) if contrast is None else contrast
    fixed, shift = fixed_to_camera(flow)
    flow = flow.without(fixed)
    surface = connected(seg.pairs[flow.jump < JUMP_PX], len(seg))
    motions, bends = surface_motions(flow, surface)
    bends &= o.bending
    jumping = discontinuous(flow, surface, bends)
    # the flow of bending regions is no evidence of the motions of rigid ones
    rigid = flow.without(bends)
    choice = None if bends.all() else labelled(rigid, motions, surface)
    turn = turn_alone(rigid, choice) if o.bending and choice is not None else None
    if choice is None or turn is not None:
        start = _without_relief(flow, surface, turn, contrast)
        return replace(start, surface=surface, unexplained=jumping)
    choice, covariance = with_least_relief(rigid, choice)
    wrong = choice.unexplained & rigid.views.usable
    soup, interpolated = _with_depth(rigid, choice, wrong)
    label = component = choice.label
    error, parallax = choice.fit.cost[:, 0], choice.parallax
    at_camera = replace(soup, R=0 * soup.R + np.eye(3), t=0 * soup.t)
    for mask, made, miss in ((bends, *constant_depth(flow.views)), (fixed, at_camera, shift)):
        if mask.any():
            soup, error = soup.taking(made, mask), np.where(mask, miss, error)
            parallax = np.where(mask, rigid.views.parallax(made), parallax)
            label = np.where(mask, -1, label)
            # each connected region of the mask is a component
            regions = component.max() + 1 + connected_pieces(mask, seg)
            component = numbered(np.where(mask, regions, component))
    component = _scene_first(component, ~fixed)
    known = ~interpolated & rigid.views.usable & (component == SCENE)
    area = np.where(known & (o.upright and o.ground), seg.sizes, 0.0)
    p = ground(views.anchor, 1 / soup.depth_at(views.anchor), area, flow.seed)
    floor = np.maximum(views.anchor @ p, 0.0)
    order = vote(contrast, component, seg)
    scale, origin = scaled(flow, soup, component, order, fixed, floor)
    soup = replace(soup, lam=soup.lam * scale)
    soup, lifted = on_ground(flow, soup, floor, known, component)
    wrong = (wrong | lifted) & ~bends
    piece = connected_pieces(wrong, seg)
    large = np.bincount(piece[wrong], minlength=1)[piece] >= PIECE_SIZE
    return Start(
        soup=soup.normalised(),
        error=error,
        parallax=parallax,
        interpolated=interpolated | lifted,
        motion=label,
        component=component,
        part=component,
        motions=choice.motions,
        covariance=covariance,
        surface=surface,
        origin=origin,
        bends=bends,
        unexplained=jumping | (wrong & large),
        wrong=wrong,
        noise=limited_noise(error[~bends]),
        order=held(flow, soup, component, origin, order, contrast),
    )


def _without_relief(flow: FlowFit, surface: Int, turn: Float | None, contrast: Float) -> Start:
    """Surfaces (N,) that bend, or what moves before a camera that only turns, in their order."""
    every, at_rest = np.ones(len(surface), bool), turn is not None
    soup, error = constant_depth(flow.views, turn)
    if at_rest and flow.options.upright:
        soup = receding(flow.views, soup)
    start = Start.whole(flow.views, soup, error, every, limited_noise(flow.residual))
    part = moving_pieces(flow) if at_rest else _scene_first(surface)
    order = vote(contrast, part, flow.seg)
    scale, origin = scaled(flow, soup, part, order)
    placed = np.abs(scale - 1) > 1e-6
    soup = replace(soup, lam=soup.lam * scale).normalised()
    origin = np.where(placed, ORIGINS.index("occlusion"), 0)
    component = numbered(np.where(placed, part, SCENE))
    stays = held(flow, soup, component, origin, order, contrast)
    part = part if at_rest else component
    start = replace(start, soup=soup, component=component, part=part, origin=origin, order=stays)
    return replace(start, bends=every, at_rest=at_rest)


def _scene_first(label: Int, counts: Mask | None = None) -> Int:
    """(N,) labels, numbered so that the largest is `SCENE`, of those that count (N,)."""
    scene = np.argmax(np.bincount(label, counts))
    return numbered(np.where(label == scene, -1, label))


def _with_depth(flow: FlowFit, choice: Labelling, wrong: Mask) -> tuple[Soup, Mask]:
    """Planes under the chosen motions, and (N,) True where they are interpolated, as also where
    the motion does not explain the flow, `wrong` (N,)."""
    fit, views = choice.fit, flow.views
    mu, slope = fit.inverse_depth[:, 0], fit.slope[:, 0]
    interpolated = ~determined(fit)[:, 0] | flow.poor | wrong | (flow.seen < LEAST_SEEN)
    if interpolated.all():
        # no depth is known: all depths are one, with translations that move the image as before
        length = np.where(mu > 0, mu, 0.0)
        mu, slope = np.ones(len(mu)), np.zeros((len(mu), 2))
    else:
        length = np.ones(len(mu))
        mu = continued(flow.seg, mu, choice.label, ~interpolated)
        slope = np.where(interpolated[:, None], 0.0, slope)
    R, t = stacked(choice.motions)
    return views.soup(mu, slope, R[choice.label], t[choice.label] * length[:, None]), interpolated


RECEDES = 0.7
"""Relative change of inverse depth from the top to the bottom of an upright image of a scene that
two views tell nothing of. True depths of cameras at rest have slopes of 0.2 to 3."""


def receding(views: Views, soup: Soup) -> Soup:
    """A soup at depth 1 on one plane that recedes upwards by `RECEDES`, with the same flow."""
    low, high = views.ray[..., 1].min(), views.ray[..., 1].max()
    fall = RECEDES / max(high - low, 1e-9)
    mu = 1 + fall * (views.anchor[:, 1] - (low + high) / 2)
    slope = np.stack([0 * mu, fall * views.radius / mu], axis=1)
    return views.soup(mu, slope, soup.R, soup.translation / mu[:, None]).normalised()


# --- the paper's initialisation: epipolar geometry and homography of every superpixel -------------

PATCH_PIXELS, PATCH_PX = 400, 0.5
"""Largest number of correspondences to which a motion is fitted, and their inlier distance."""


def unorganised(flow: FlowFit) -> tuple[Soup, Mask]:
    """The soup of independent superpixels with equal scales, and which are a neighbour's (N,).

    The motion (R, t) of a superpixel comes from the flow of itself and of its nearest neighbours,
    by essential matrix and cheirality; its plane then follows from `q ~ (R - t n^T / d) r`, which
    is linear in n / d. A superpixel for which this fails takes the result of the nearest one for
    which it succeeds. All anchors have the same depth, a positive constant in the paper. The soup
    is not normalised.
    """
    seg, anchor = flow.seg, flow.views.anchor
    patches = [_patch(flow, i) for i in range(len(seg))]
    fails = np.array([p is None for p in patches])
    source = np.arange(len(seg)) if fails.all() else seg.nearest(~fails)
    sideways = SIDEWAYS, np.array([0.0, 0.0, 1.0])
    motions, planes = zip(*(patches[s] or sideways for s in source))
    R, t = stacked(motions)
    # a neighbour's plane keeps depth and slopes, since at this anchor it may be behind the camera
    depth, slope = at_anchor(np.stack(planes), anchor[source])
    n, D = normal_and_distance(about_anchor(np.ones(len(seg)), slope, anchor))
    return Soup(np.ones(len(seg)), n, D, R, t / depth[:, None]), fails


def _patch(flow: FlowFit, i: int) -> tuple[Motion, Float] | None:
    """Motion of a superpixel, and m = -n / d with |t| = 1 as the length unit, if determined."""
    views = flow.views
    inside = views.subset(np.array([i])).matches().confident(PATCH_PIXELS)
    if len(inside.ray) < LEAST_MATCHES:
        return None
    around = views.subset(np.append(i, flow.seg.knn[i])).matches()
    motion = essential_motion(around.confident(PATCH_PIXELS), PATCH_PX)
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
