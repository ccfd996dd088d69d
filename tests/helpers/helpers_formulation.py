"""The tiny problem in its units, and planes of known energy, for the tests of the model."""

from __future__ import annotations

from functools import cache

import numpy as np
from helpers_model import HEIGHT, WIDTH, Tiny, motion, plane_pose, plane_soup, plane_world

from soup_nlp.geometry.graph import build_segmentation
from soup_nlp.geometry.soup import Soup
from soup_nlp.geometry.superpixels import segment
from soup_nlp.model.energy_data import EnergyData, build_energy_data
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.reweighting import in_pixels

UNITS = ("paper", "pixels")
NORMS = ("smooth", "epigraph")


@cache
def tiny(units: str = "paper", at_anchors: bool = False) -> Tiny:
    return Tiny(units, at_anchors)


def form(**options) -> Formulation:
    return Formulation(**{"compiled": False, **options})


def assert_same_soup(a: Soup, b: Soup, tolerance: float = 1e-12) -> None:
    np.testing.assert_allclose(a.lam.sum(), 1.0, rtol=tolerance)
    for name in ("n", "R", "distance", "translation"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=0, atol=tolerance)


WORLDS = {
    "fronto-parallel, sideways": (plane_pose(2.0), motion((0, 0, 0), (0.1, 0.03, 0))),
    "fronto-parallel, turning": (plane_pose(3.0), motion((0.5, -1, 2), (0.1, 0.03, 0.2))),
    "slanted": (plane_pose(2.5, yaw=25, pitch=-30), motion((1, 0.5, -1), (0.02, 0.1, -0.1))),
    "at rest": (plane_pose(2.0, yaw=10), motion((0, 0, 0), (0, 0, 0))),
}


def world(name: str, units: str, at_anchors: bool) -> tuple[Soup, EnergyData]:
    pose, move = WORLDS[name]
    pair = plane_world(pose, move, WIDTH, HEIGHT)
    seg = build_segmentation(segment(pair.image_ref, 12, "grid"), pair.image_ref, neighbours=5)
    data = build_energy_data(
        seg, pair.flow, pair.K_ref, pair.K_next, 8, 0, arap_at_anchors=at_anchors
    )
    soup = plane_soup(pose, move, len(seg))
    return soup, in_pixels(data, soup, seg) if units == "pixels" else data
