"""Initial proposal of every superpixel: candidates, choice, planes, scales (paper, Sec. 4.4.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.data.pair import Flow
from soup_nlp.geometry.graph import Segmentation
from soup_nlp.geometry.soup import Soup
from soup_nlp.start.bending import (
    constant_depth,
    reference_noise,
    surface_motions,
    surfaces,
    turn_alone,
)
from soup_nlp.start.choice import LEAST_NOISE, Choice, limited_noise, rigid_choice
from soup_nlp.start.components import (
    FIXED,
    TIES,
    borrow,
    connected_labels,
    connected_pieces,
    contact_scales,
    largest,
)
from soup_nlp.start.epipolar import Motion
from soup_nlp.start.ground import above_ground, floating, ground
from soup_nlp.start.homographies import unorganised
from soup_nlp.start.merge import earned, gather, unmoved
from soup_nlp.start.overlay import STILL_PX, fixed_to_camera
from soup_nlp.start.settle import settle
from soup_nlp.start.start_options import SeededStart
from soup_nlp.start.views import LEAST_PARALLAX_PX, USABLE, FlowFit, Views

__all__ = ["SeededStart", "Start", "propose"]


@dataclass(frozen=True, eq=False)
class Start:
    """The initial soup, and how it was made.

    Attributes:
        soup: Start of the optimisation, mean plane distance 1.
        error: (N,) mean re-projection error of every superpixel, pixels.
        parallax: (N,) pixels by which its translation moves the anchor.
        borrowed: (N,) True where plane or motion come from neighbours.
        motion: (N,) index of its motion in `motions`, -1 where it has its own.
        component: (N,) index of the rigid component, which shares one scale: the superpixels of a
            dominant motion, or a connected piece of superpixels with their own motions.
        part: (N,) group that moves as one, an index of `component`: its own, or the largest one
            where its flow is not usable, so that its motion is not known.
        motions: The dominant motions.
        surface: (N,) index of the surface: a connected group without flow discontinuities inside;
            where a region bends, discontinuities make up most of its outline.
        tie: (N,) origin of the scale of every superpixel's component, an index of `TIES`.
        grounded: (N,) True where the depth is borrowed and the ground is known below the horizon.
        bends: (N,) True where the energy for bending surfaces is used. Its connected regions are
            components that start at a constant depth, each superpixel with a motion of its own. If
            the rigid part is small or has no parallax, or the camera is at rest, the whole image is
            one such component.
        wrong: (N,) True where no accepted motion (`earned`) explains the flow, which then counts as
            wrong.
        at_rest: Whether the camera is taken to be at rest, or to turn only.
        noise: Noise of the flow, pixels, see `limited_noise`.
        order: (P,) probability that the second superpixel of a neighbour pair covers the first one,
            negative if the first covers the second, 0 where neither is known (`start.occlusion`);
            None where nothing is known.
    """

    soup: Soup
    error: Float
    parallax: Float
    borrowed: Mask
    motion: Int
    component: Int
    part: Int
    motions: list[Motion]
    surface: Int
    tie: Int
    grounded: Mask
    bends: Mask
    wrong: Mask
    at_rest: bool = False
    noise: float = LEAST_NOISE
    order: Float | None = None

    def __str__(self) -> str:
        return (
            f"Start({len(self.soup)} superpixels, {len(self.motions)} dominant motions, median"
            f" error {np.median(self.error):.2f} px, {int(self.borrowed.sum())} borrowed"
            + (f", {self.bends.mean():.0%} bending)" if self.bending else ")")
        )

    __repr__ = __str__

    @property
    def bending(self) -> bool:
        """Whether a region bends."""
        return bool(self.bends.any())


def propose(
    seg: Segmentation,
    flow: Flow,
    K_ref: Float,
    K_next: Float,
    options: SeededStart | None = None,
    fitted: FlowFit | None = None,
) -> Start:
    """Rotation, translation, plane and scale of every superpixel from its flow.

    Args:
        seg: Superpixels and graphs.
        flow: Flow with confidence.
        K_ref: (3, 3) intrinsics of the reference frame.
        K_next: (3, 3) intrinsics of the next frame.
        options: See SeededStart.
        fitted: The flow as affine maps; computed without it.

    Raises:
        DataError: fewer than 8 pixels have a usable flow.
    """
    o = options or SeededStart()
    fitted = fitted or FlowFit.of(seg, flow, K_ref, K_next, o)
    views, poor, _, residual, jump = fitted
    if o.method == "homography":
        return _of_homographies(views, seg, o)
    fixed, shift = np.zeros(len(seg), bool), np.zeros(len(seg))
    if np.array_equal(K_ref, K_next):
        fixed, shift = fixed_to_camera(views, seg, jump, o)
    views, poor = views.without(fixed), poor | fixed
    surface = surfaces(jump, seg, o.discontinuity_px)
    usable, centre = views.usable, fitted.centre
    motions, bends = surface_motions(views, seg, surface, residual, usable, o)
    bends &= o.bending
    choice, noise = rigid_motions(views, seg, jump, motions, o)
    turn = turn_alone(views, choice, usable, reference_noise(residual))
    if turn is not None or bends.all():
        return _constant(views, surface, choice, limited_noise(residual), turn)
    free = constant_depth(views)
    if bends.any():
        # the flow of bending regions is no evidence of the motions of rigid ones
        views, poor = views.without(bends), poor | bends
        choice, noise = rigid_motions(views, seg, jump, motions, o)
    else:
        surface = connected_labels(jump < o.discontinuity_px, seg)
    choice, wrong = earned(views, choice, seg, noise)
    weight = np.where(usable & ~bends, 1.0, 0.0)
    choice = settle(views, choice, centre, weight, limited_noise(residual))
    soup, weak = _with_depth(choice, views, poor | wrong, seg)
    label, parallax = choice.label, choice.parallax
    component, error = label, choice.fit.cost[:, 0]
    at_camera = Soup(soup.lam, soup.n, soup.d, 0 * soup.R + np.eye(3), 0 * soup.t)
    for mask, made, miss in ((bends, *free), (fixed, at_camera, shift)):
        if mask.any():
            soup, error = soup.taking(made, mask), np.where(mask, miss, error)
            parallax = np.where(mask, views.parallax(made), parallax)
            label = np.where(mask, -1, label)
            component = with_regions(component, mask, seg)
    wrong |= fixed & (shift > STILL_PX)
    scale, tie = contact_scales(soup, component, seg, K_ref, o.upright, fixed, usable)
    soup = Soup(soup.lam * scale, soup.n, soup.d, soup.R, soup.t)
    grounded = np.zeros(len(seg), bool)
    if o.upright and o.ground:
        reliable = ~weak & views.usable
        ground_input = views.anchor, seg, K_ref, reliable, component, tie, o
        soup, component, tie, floor = _on_ground(soup, *ground_input)
        grounded = weak & (floor > 0)
    soup = soup.normalised()
    moved = (centre - views.anchor)[:, :2] * views.focal
    mixed = unmoved(component, choice, moved, usable, views, seg) & ~(fixed | bends)
    part = moving_parts(np.where(mixed, largest(component), component), views, seg, fixed | bends)
    fields = soup, error, parallax, weak, label, component, part
    all_fields = *fields, choice.motions, surface, tie, grounded, bends
    return Start(*all_fields, wrong & ~bends, noise=limited_noise(error[~bends]))


def rigid_motions(
    views: Views, seg: Segmentation, jump: Float, motions: list[Motion], o: SeededStart
) -> tuple[Choice, float]:
    """One of few rigid motions for every superpixel, and the noise of the flow, pixels."""
    choice, noise = rigid_choice(views, seg, jump, motions, o)
    return gather(views, seg, jump, choice, noise, o), noise


def _with_depth(choice: Choice, views: Views, poor: Mask, seg: Segmentation) -> tuple[Soup, Mask]:
    """Planes under the chosen motions, and (N,) True where they are borrowed from neighbours.

    Args:
        choice: Motion and plane of every superpixel.
        views: Rays, targets and confidence of every superpixel.
        poor: (N,) True where the views are a neighbour's or have no confidence.
        seg: Superpixels and graphs.
    """
    fit, parallax = choice.fit, choice.parallax
    mu, slope = fit.inverse_depth[:, 0], fit.slope[:, 0]
    weak = (mu <= 0) | (parallax < LEAST_PARALLAX_PX) | (fit.cost[:, 0] > 3.0) | poor
    weak |= views.weight.sum(axis=1) < 2.0
    if weak.all():
        # where all parallax is little, it is used as long as it exceeds rounding
        weak = ~np.isfinite(mu) | (mu <= 0) | (parallax < 0.02)
    if weak.all():
        # no depth is known: all depths are one, with translations that move the image as before
        length = np.where(mu > 0, mu, 0.0)
        mu, slope = np.ones(len(seg)), np.zeros((len(seg), 2))
    else:
        length = np.ones(len(seg))
        mu, slope = borrow(mu, slope, choice.label, weak, seg)
    R, t = (np.stack([getattr(m, v) for m in choice.motions])[choice.label] for v in ("R", "t"))
    return views.soup(mu, slope, R, t * length[:, None]), weak


def _constant(
    views: Views, surface: Int, choice: Choice, noise: float, turn: Float | None
) -> Start:
    """Start without relief, where everything bends or the camera is at rest (`turn` is given)."""
    soup, error = constant_depth(views, turn)
    zero, everywhere = np.zeros(len(surface), np.int64), np.ones(len(surface), bool)
    fields = soup, error, views.parallax(soup), everywhere, zero - 1, zero, zero
    all_fields = *fields, choice.motions, surface, zero, ~everywhere, everywhere
    return Start(*all_fields, ~everywhere, at_rest=turn is not None, noise=noise)


def with_regions(component: Int, mask: Mask, seg: Segmentation) -> Int:
    """(N,) components without gaps in their numbers; each connected region of a mask is one."""
    component = np.where(mask, component.max() + 1 + connected_pieces(mask, seg), component)
    return np.unique(component, return_inverse=True)[1].ravel()


def moving_parts(component: Int, views: Views, seg: Segmentation, kept: Mask) -> Int:
    """(N,) component of every superpixel, the largest one in pieces without usable flow.

    A part that leaves the image or is hidden has the same wrong flow over several superpixels. As a
    component of its own it gets a better depth than from its neighbours, but it need not move.
    Beside a piece that does move it is taken to be part of that piece.

    Args:
        component: (N,) rigid component of every superpixel.
        views: Confidence of the flow of every superpixel.
        seg: Superpixels and graphs.
        kept: (N,) True in components that stay.
    """
    main = largest(component)
    i, k = seg.pairs.T
    same = component[i] == component[k]
    piece = connected_labels(same, seg)
    weight = np.bincount(piece, views.weight.mean(axis=1)) / np.bincount(piece)
    moves = kept | ((component != main) & (weight >= USABLE)[piece])
    beside = np.zeros(len(weight), bool)
    for first, second in ((i, k), (k, i)):
        beside[piece[first[~same & moves[second]]]] = True
    return np.where(moves | beside[piece], component, main)


def _of_homographies(views: Views, seg: Segmentation, o: SeededStart) -> Start:
    """The paper's initialisation, which has no components: all superpixels are one."""
    soup, borrowed = unorganised(views, seg, o)
    soup = soup.normalised()
    error = views.distance(soup.moved(soup.points(views.ray)))
    parallax, whole = views.parallax(soup), np.zeros(len(seg), np.int64)
    noise = limited_noise(error)
    none = np.zeros(len(seg), bool)
    fields = soup, error, parallax, borrowed, whole - 1, whole, whole
    return Start(*fields, [], whole, whole, none, none, none, noise=noise)


def _on_ground(
    soup: Soup,
    anchor: Float,
    seg: Segmentation,
    K_ref: Float,
    reliable: Mask,
    component: Int,
    tie: Int,
    o: SeededStart,
) -> tuple[Soup, Int, Int, Float]:
    """Soup, components, ties and (N,) inverse depth of the ground, see `ground`.

    Superpixels below the ground are lifted, and regions that float above it are lowered.
    """
    reliable = reliable & (component == largest(component))
    area = seg.sizes.astype(float)
    floor = ground(1 / soup.depth_at(anchor), anchor, area, reliable, o.seed)
    soup, lifted = above_ground(soup, anchor, area, reliable, component, floor)
    tie = np.where(lifted & (tie != FIXED), TIES.index("ground"), tie)
    lam, component = soup.lam.copy(), component.copy()
    for region, farther in floating(soup, seg, K_ref, floor, component):
        # at the depth of the ground its flow shows a motion of its own
        lam[region] *= farther
        component[region] = component.max() + 1
        tie[region] = TIES.index("contact below")
    # components are numbered without gaps
    component = np.unique(component, return_inverse=True)[1].ravel()
    return Soup(lam, soup.n, soup.d, soup.R, soup.t), component, tie, floor
