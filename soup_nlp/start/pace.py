"""How far components move, and the order of those that contact would make too fast."""

import numpy as np

from soup_nlp.arrays import Float, Int
from soup_nlp.geometry.soup import Soup
from soup_nlp.start.components import SCENE, TOO_FAST
from soup_nlp.start.views import FlowFit

LEAST_DISPLACEMENT = 1e-12
"""Displacements count as at least this, so that their ratio is finite."""


def order_in_front(flow: FlowFit, soup: Soup, label: Int, tie: Int) -> Float | None:
    """(P,) order along the outlines of components that contact makes too fast, see `Start.order`.

    It holds their steps of depth, which the energy would close otherwise, since nothing else gives
    them a scale. None without such components among those of `label` (N,), with ties (N,).
    """
    pairs, near = flow.seg.pairs, (tie == TOO_FAST)[flow.seg.pairs]
    if not near.any():
        return None
    z = soup.depth_across(pairs, flow.middle)
    second = np.where(z[1] < z[0], near[:, 1], 0.0)
    first = np.where(z[0] < z[1], near[:, 0], 0.0)
    return np.where(flow.seg.across(label), second - first, 0.0)


def log_pace(far: Float, label: Int) -> Float:
    """(C,) log ratio of the median displacement of every component to that of the scene.

    Args:
        far: (N,) displacement relative to the camera (`displacement`).
        label: (N,) index of the component.
    """
    median = np.array([np.median(far[label == c]) for c in range(int(label.max()) + 1)])
    median = np.maximum(median, LEAST_DISPLACEMENT)
    return np.asarray(np.log(median / median[SCENE]))


def displacement(soup: Soup, ray: Float, label: Int) -> Float:
    """(N,) how far anchors move relative to the camera, which turns as the scene does.

    Args:
        soup: Planes and motions.
        ray: (N, 3) rays of the anchors.
        label: (N,) index of the component.
    """
    point = soup.points(ray)
    first = int(np.argmax(label == SCENE))
    moved = np.einsum("nij,nj->ni", soup.R, point) + soup.translation - point @ soup.R[first].T
    return np.linalg.norm(moved, axis=1)
