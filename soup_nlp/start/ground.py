"""Nothing that is seen lies below the ground.

A thing without usable flow (it leaves the image, it is dark, it moves too fast) takes its depth
from whatever is beside it, and a component that touches nothing known from its outline: both may
end far below the road. In an upright image a level plane that much of the scene lies on, and next
to nothing below, bounds the depth of all that is seen below the horizon.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from soup_nlp.geometry.soup import Soup

Float = NDArray[np.float64]
Int = NDArray[np.int64]

LEVEL = 0.92
"""Least cosine between the normal of the ground and the vertical of the image."""
ON, BELOW = 0.05, 0.2
"""Relative gap of inverse depth up to which a superpixel lies on the ground, and from which on it
lies below."""
LEAST_ON, MOST_BELOW = 0.1, 0.05
"""Shares of what is well known that lie on the ground at least, and below it at most."""
TRIALS = 500
"""Planes through three superpixels that are tried."""


def ground(mu: Float, ray: Float, weight: Float, known: NDArray[np.bool_], seed: int) -> Float:
    """(N,) inverse depth of the ground on every ray; 0 above the horizon and where there is none.

    Args:
        mu: (N,) inverse depth at the anchors.
        ray: (N, 3) their rays.
        weight: (N,) area of every superpixel.
        known: (N,) which depths are known well.
        seed: Of the planes that are tried.
    """
    none = np.zeros(len(mu))
    at = np.flatnonzero(known)
    if len(at) < 20:
        return none
    # inverse depth of a plane is linear in the ray; (x, y, 1) . p with p along the normal
    low = at[ray[at, 1] > np.quantile(ray[at, 1], 0.4)]
    if len(low) < 3:
        return none
    three = np.random.default_rng(seed).choice(low, (TRIALS, 3))
    three = three[np.abs(np.linalg.det(ray[three])) > 1e-6]
    planes = np.linalg.solve(ray[three], mu[three][..., None])[..., 0]
    planes = planes[planes[:, 1] > LEVEL * np.linalg.norm(planes, axis=1)]
    if not len(planes):
        return none

    def on(planes: Float) -> NDArray[np.bool_]:
        there = planes @ ray[at].T
        return np.asarray((there > 0) & (np.abs(mu[at] - there) < ON * np.abs(there)))

    best = planes[np.argmax(on(planes) @ weight[at])]
    for _ in range(3):
        own = at[on(best)]
        root = np.sqrt(weight[own]) / mu[own]
        best = np.linalg.lstsq(ray[own] * root[:, None], mu[own] * root)[0]
    there = ray @ best
    below = (there > 0) & (mu < (1 - BELOW) * there)
    total = weight[at].sum()
    if weight[at][on(best)].sum() < LEAST_ON * total:
        return none
    if weight[known & below].sum() > MOST_BELOW * total:
        return none
    return np.maximum(there, 0.0)


def above_ground(
    soup: Soup, ray: Float, weight: Float, known: NDArray[np.bool_], component: Int, seed: int
) -> tuple[Soup, NDArray[np.bool_]]:
    """The soup with what is not known well, or moves by itself, lifted to the ground.

    A component that lies below with most of its area becomes nearer as a whole, with its
    translation. Other superpixels of the scene itself keep their translation, which they share.

    Args:
        soup: Start, its components scaled.
        ray: (N, 3) rays of the anchors.
        weight: (N,) area of every superpixel.
        known: (N,) which depths are known well, of the largest component.
        component: (N,) group that moves as one.
        seed: Of the search for the ground.

    Returns:
        The soup, and (N,) which belong to a component that was lifted as a whole.
    """
    mu = 1 / soup.depth_at(ray)
    floor = ground(mu, ray, weight, known, seed)
    scene = component == np.argmax(np.bincount(component))
    lam, t = soup.lam.copy(), soup.t.copy()
    lifted = np.zeros(len(mu), bool)

    def below() -> NDArray[np.bool_]:
        return np.asarray(mu * soup.lam / lam < (1 - BELOW) * floor)

    for c in np.unique(component[below() & ~scene]):
        own = np.flatnonzero((component == c) & (floor > 0))
        under = own[below()[own]]
        if weight[under].sum() > 0.5 * weight[component == c].sum():
            lam[component == c] *= np.median(mu[under] / floor[under])
            lifted |= component == c
    left = below() & ~known
    factor = mu[left] * soup.lam[left] / lam[left] / floor[left]
    lam[left] *= factor
    t[left & scene] /= factor[scene[left], None]
    return Soup(lam, soup.n, soup.d, soup.R, t), lifted
