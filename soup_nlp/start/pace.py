"""Components that their scales by contact make too fast come nearer.

What hangs in the air covers a surface behind it and touches nothing in front of it.
"""

from dataclasses import replace

import numpy as np

from soup_nlp.arrays import Float, Int
from soup_nlp.geometry.soup import Soup
from soup_nlp.start.components import FIXED, SCENE, TOO_FAST
from soup_nlp.start.views import FlowFit

UNKNOWN = np.log(100.0)
"""If motion and contact differ by more, in logarithms, the camera is taken to be at rest."""
PACE, UNCARRIED = 0.7, 0.2
"""Standard deviation of the log displacement of components that stand on what is below them,
relative to the scene, and share of the components that do not: they hang in the air."""
LEAST_DISPLACEMENT = 1e-12
"""Displacements count as at least this, so that their ratio is finite."""


def nearer_where_fast(flow: FlowFit, soup: Soup, label: Int, tie: Int) -> tuple[Soup, Int]:
    """The soup and ties (N,) with components nearer that their scales make too fast.

    Contact places what hangs in the air on the surface behind it, too far, so that it moves too far
    as well. Its depth is then between that by contact and that at
    which it moves as far as the scene. The probability q that contact is wrong follows from the log
    pace x (`log_pace`), which is normal where contact is right and uniform up to `UNKNOWN` where it
    is wrong:

        q = UNCARRIED / UNKNOWN / (UNCARRIED / UNKNOWN + (1 - UNCARRIED) N(x; 0, PACE^2))

    The median of the log factor is 0 for q up to 1/2, and
    x (q - 1/2) / q beyond. Beyond `UNKNOWN` the camera is taken to be at rest.

    Args:
        flow: The flow of every superpixel.
        soup: Start, its components scaled.
        label: (N,) index of the component.
        tie: (N,) origin of its scale, an index of `TIES`.
    """
    pace = log_pace(displacement(soup, flow.views.anchor, label), label)[label]
    right = np.exp(-0.5 * (pace / PACE) ** 2) / (PACE * np.sqrt(2 * np.pi))
    wrong = UNCARRIED / UNKNOWN
    too_fast = wrong > (1 - UNCARRIED) * right
    q = wrong / (wrong + (1 - UNCARRIED) * right)
    placed = np.isin(tie, (FIXED, TOO_FAST)) | (label == SCENE)
    may = (pace > 0) & (pace < UNKNOWN) & ~placed
    nearer = np.where(may, np.maximum(q - 0.5, 0.0) / q * pace, 0.0)
    tie = np.where(may & too_fast, TOO_FAST, tie)
    return replace(soup, lam=soup.lam * np.exp(-nearer)), tie


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
