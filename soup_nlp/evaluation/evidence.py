"""What errors of the given camera leave open of the depth; see docs/confidence.md."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy import special

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.geometry.camera import rays
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.start.camera_error import (
    LEAST_ODDS,
    TRIED_ERRORS,
    CameraError,
    camera_error,
    camera_errors,
)
from soup_nlp.start.epipolar import Matches
from soup_nlp.start.regions import SCENE

LEAST_MEMBERS = 3
"""Least number of superpixels with flow of a component whose depth can be known."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence of the flow for the camera.

    Attributes:
        sigma: (N,) standard deviation of log depth by errors of the camera; inf for components with
            fewer than `LEAST_MEMBERS` superpixels with flow.
        errors: What the flow says of every error of the given camera.
    """

    sigma: Float
    errors: Mapping[str, CameraError] = field(default_factory=dict)

    @property
    def camera(self) -> str | None:
        """Error of the given camera that the flow shows, one of `ERROR_KINDS`, or None: the most
        probable one, if its odds are at least `LEAST_ODDS`."""
        kind = max(self.errors, key=lambda kind: self.errors[kind].log_odds, default=None)
        return kind if kind and self.errors[kind].log_odds > LEAST_ODDS else None


def evidence(
    soup: Soup, data: EnergyData, component: Int, focal_sigma: float = 0, rigid: Mask | None = None
) -> Evidence:
    """Evidence of the flow for the camera, at an answer with rigid components (N,).

    `focal_sigma` is the standard deviation of the log focal length, 0 where it is given; `rigid`
    (N,) is True where the flow is that of a moving camera and may show its errors, None where none
    are sought.
    """
    valid = data.pixel_weight.sum(axis=1) > 0.25
    # what moves by itself has another motion
    scene, shown = valid & (component == SCENE), {}
    if rigid is not None and (scene & rigid).any():
        shown = camera_errors(_matches(data, scene & rigid))
    acting = dict(shown)
    if focal_sigma and scene.any():
        # its deviation is known
        guess = camera_error(_matches(data, scene), "focal length", focal_sigma)
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
    known = np.bincount(component, valid)[component] >= LEAST_MEMBERS
    return Evidence(np.where(known, np.sqrt(squares), np.inf), shown)


def _matches(data: EnergyData, at: Mask) -> Matches:
    """Correspondences by the flow of superpixels."""
    ray, target = data.pixel_ray[at], rays(data.K_next, data.pixel_target[at])
    weight = data.pixel_weight[at].ravel() / data.pixel_weight[at].max()
    return Matches(ray.reshape(-1, 3), target.reshape(-1, 3), weight, data.K_next[0, 0])
