"""Evidence of two views for depth: parallax beyond any rotation, relief, undetermined motion.

See docs/confidence.md. Curvature at the answer is conditional on the motions of the components. A
small turn and a small translation move an image almost alike, so that a flow with a small
systematic error determines the depth of a component only where neither a turn alone nor a constant
depth explains it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy import special

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.geometry.camera import rays
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.start.bending import CLIP_PX, at_one_depth, fit_turn, least_gap, trimmed_mean
from soup_nlp.start.camera_error import (
    TRIED_ERRORS,
    CameraError,
    camera_error,
    camera_errors,
    likeliest,
)
from soup_nlp.start.regions import SCENE
from soup_nlp.start.views import Views

LEAST_MEMBERS = 3
"""Least number of superpixels with flow of a component whose depth can be known."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence of the flow for the depth of C components; errors are in pixels.

    Attributes:
        turn: (C,) mean error of the best rotation alone, the focal length free.
        constant: (C,) mean error of the best rigid motion of a component at a constant depth.
        solution: (C,) mean error of the answer.
        noise: Noise of the flow, pixels.
        sigma: (N,) standard deviation of log depth by errors of the camera.
        errors: What the flow says of every error of the given camera.
    """

    turn: Float
    constant: Float
    solution: Float
    noise: float
    sigma: Float
    errors: Mapping[str, CameraError] = field(default_factory=dict)

    @property
    def camera(self) -> str | None:
        """Error of the given camera that the flow shows, one of `ERROR_KINDS`, or None."""
        return likeliest(self.errors)

    @property
    def gap(self) -> Float:
        """(C,) pixels by which depth explains the flow better than no or constant depth."""
        return np.minimum(self.turn, self.constant) - self.solution

    @property
    def guess(self) -> Mask:
        """(C,) True where the depth of a component is a guess, see `least_gap`."""
        return ~(self.gap >= least_gap(self.noise))


def evidence(
    soup: Soup,
    data: EnergyData,
    component: Int,
    noise: float,
    focal_sigma: float = 0.0,
    rigid: Mask | None = None,
) -> Evidence:
    """Evidence of the flow for the depth of every component.

    Args:
        soup: The answer.
        data: Sampled pixels with their flow.
        component: (N,) rigid component of every superpixel.
        noise: Noise of the flow, pixels.
        focal_sigma: Standard deviation of the log focal length, 0 where it is given.
        rigid: (N,) True where the flow is that of a moving camera and may show its errors; None
            where none is sought.
    """
    views = Views(
        data.pixel_ray,
        rays(data.K_next, data.pixel_target),
        data.pixel_weight * data.pixel_weight.shape[1],
        data.anchor_ray,
        np.ones(len(data)),
        np.diag(data.K_next)[:2],
    )
    valid = views.weight.mean(axis=1) > 0.25
    misfit = views.distance(soup.moved(soup.points(data.pixel_ray)))
    count = int(component.max()) + 1
    errors = np.full((3, count), np.nan)
    sigma = np.full(len(soup), np.inf)
    shown: dict[str, CameraError] = {}
    # what moves by itself has another motion
    scene = valid & (component == SCENE)
    at = scene if rigid is None else scene & rigid
    if rigid is not None and at.any():
        shown = camera_errors(views.subset(at).matches())
    acting = dict(shown)
    if focal_sigma and scene.any():
        # its deviation is known
        guess = camera_error(views.subset(scene).matches(), "focal length", focal_sigma)
        acting[guess.kind] = guess._replace(density=tuple(special.softmax(-(TRIED_ERRORS**2) / 2)))
    squares = np.zeros(len(soup))
    if acting:
        still, point = component == SCENE, soup.points(data.anchor_ray)
        target = soup.moved(point)
        target = target / target[:, 2:]
        seen = data.anchor_ray[still], target[still], point[still, 2]
        squares[still] = sum(error.squares(*seen) for error in acting.values())
        # other components stand in the scene
        squares[~still] = np.median(squares[still])
    for c in range(count):
        at = np.flatnonzero((component == c) & valid)
        if len(at) < LEAST_MEMBERS:
            continue
        part = views.subset(at)
        each = fit_turn(part)[1], fit_turn(part, 6, at_one_depth)[1], misfit[at]
        # a flow that is not known counts as the largest error
        errors[:, c] = [trimmed_mean(np.fmin(error, CLIP_PX)) for error in each]
        sigma[component == c] = np.sqrt(squares[component == c])
    return Evidence(errors[0], errors[1], errors[2], noise, sigma, shown)
