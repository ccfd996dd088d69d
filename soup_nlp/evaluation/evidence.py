"""Evidence of two views for depth: parallax beyond any rotation, relief, undetermined motion.

See docs/confidence.md. Curvature at the answer is conditional on the motions of the components. A
small turn and a small translation move an image almost alike, so that a flow with a small
systematic error determines the depth of a component only where neither a turn alone nor a constant
depth explains it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy import special

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.geometry.camera import project, rays
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.start.bending import (
    CLIP_PX,
    PLAIN_TURN,
    displaced,
    fit_robustly,
    least_gap,
    trimmed_mean,
    turned,
)
from soup_nlp.start.camera_error import (
    TRIED_ERRORS,
    CameraError,
    camera_error,
    camera_errors,
    likeliest,
)
from soup_nlp.start.epipolar import Matches
from soup_nlp.start.regions import SCENE

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
    valid = data.pixel_weight.sum(axis=1) > 0.25
    moved = soup.moved(soup.points(data.pixel_ray))
    misfit = _error(project(data.K_next, moved), data)
    count = int(component.max()) + 1
    errors = np.full((3, count), np.nan)
    sigma = np.full(len(soup), np.inf)
    shown: dict[str, CameraError] = {}
    # what moves by itself has another motion
    scene = valid & (component == SCENE)
    at = scene if rigid is None else scene & rigid
    if rigid is not None and at.any():
        shown = camera_errors(_matches(data, at))
    acting = dict(shown)
    if focal_sigma and scene.any():
        # its deviation is known
        guess = camera_error(_matches(data, scene), "focal length", focal_sigma)
        acting[guess.kind] = guess._replace(density=tuple(special.softmax(-(TRIED_ERRORS**2) / 2)))
    squares = np.zeros(len(soup))
    if acting:
        still, point = component == SCENE, soup.points(data.anchor_ray)
        target = rays(data.K_next, project(data.K_next, soup.moved(point)))
        seen = data.anchor_ray[still], target[still], point[still, 2]
        squares[still] = sum(error.squares(*seen) for error in acting.values())
        # other components stand in the scene
        squares[~still] = np.median(squares[still])
    for c in range(count):
        at = np.flatnonzero((component == c) & valid)
        if len(at) < LEAST_MEMBERS:
            continue
        errors[:, c] = *_without_depth(data, at), trimmed_mean(misfit[at])
        sigma[component == c] = np.sqrt(squares[component == c])
    return Evidence(errors[0], errors[1], errors[2], noise, sigma, shown)


def _matches(data: EnergyData, at: Mask) -> Matches:
    """Correspondences by the flow of superpixels."""
    ray, target = data.pixel_ray[at], rays(data.K_next, data.pixel_target[at])
    weight = data.pixel_weight[at].ravel() / data.pixel_weight[at].max()
    return Matches(ray.reshape(-1, 3), target.reshape(-1, 3), weight, data.K_next[0, 0])


def _error(pixel: Float, data: EnergyData, at: Int | slice = slice(None)) -> Float:
    """(N,) mean distance of pixels (N, S, 2) from the flow's targets, limited."""
    distance = np.linalg.norm(pixel - data.pixel_target[at], axis=2)
    distance = np.where(np.isfinite(distance), np.minimum(distance, CLIP_PX), CLIP_PX)
    weight = data.pixel_weight[at]
    return np.asarray(np.sum(weight * distance, axis=1) / np.maximum(weight.sum(axis=1), 1e-9))


def _without_depth(data: EnergyData, at: Int, pixels: int = 2000) -> tuple[float, float]:
    """Errors of superpixels `at` under the best turn alone and the best motion at equal depths."""
    step = max(1, data.pixel_ray[at].shape[0] * data.pixel_ray.shape[1] // pixels)
    weight = data.pixel_weight[at].ravel()[::step] * data.pixel_ray.shape[1]
    target = rays(data.K_next, data.pixel_target[at].reshape(-1, 2)[::step])[:, :2]
    scale = np.sqrt(weight)[:, None] * np.diag(data.K_next)[:2]

    def error(matrix: Callable[[Float], Float], size: int, ray: Float) -> float:
        point = ray.reshape(-1, ray.shape[-1])[::step]
        x, _ = fit_robustly(matrix, size, point, target, scale)
        return trimmed_mean(_error(project(data.K_next, ray @ matrix(x).T), data, at))

    ray = data.pixel_ray[at]
    at_one = np.insert(ray, 3, 1.0, axis=-1)
    return error(turned, PLAIN_TURN, ray), error(displaced, 6, at_one)
