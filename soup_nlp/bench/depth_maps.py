"""Depth maps that are scored: solution, stages before it, and baselines with the same flow."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from soup_nlp.bench.piecewise_planar import fit_planes, plane_depth, points_as_map
from soup_nlp.evaluate.baselines import fill_nearest
from soup_nlp.geometry.soup import Soup, reconstruct

if TYPE_CHECKING:
    from soup_nlp.pipeline.run import Run

Float = NDArray[np.float64]

METHODS: Mapping[str, str] = MappingProxyType(
    {
        "solution": "what the product delivers",
        "nlp": "the NLP alone, before refinement",
        "start": "the start: shared motions, scales by contact",
        "unorganised": "independent superpixels: each with a translation of length 1, no assembly",
        "solution_rigid": "the solution, only where one rigid motion has a depth",
        "rigid": "one rigid motion, triangulated; only where it has a depth",
        "rigid_filled": "the same, holes filled from the nearest pixel",
        "plane": "the best single plane (fitted to the whole truth)",
        "constant": "a constant depth",
        "floor": "superpixel floor: true planes in these superpixels",
    }
)
"""Depth maps that are scored, in the order of tables."""

BASELINES = ("unorganised", "rigid", "rigid_filled", "plane", "constant")
"""Those that the solution has to beat."""

SPARSE = 4.0
"""True pixels per superpixel below which the superpixel floor is meaningless."""


def unorganised(soup: Soup) -> Soup:
    """The soup before assembly: every superpixel in units of its own translation.

    From two views each plane and motion is known up to its own scale; with |t_i| = 1 for all, what
    is left is what independent superpixels give. Superpixels at rest keep their scale.
    """
    length = np.linalg.norm(soup.translation, axis=1)
    tiny = 1e-9 * max(float(length.max(initial=0.0)), 1e-300)
    unit = np.where(length > tiny, length, 1.0)
    return Soup(soup.lam / unit, soup.n, soup.d, soup.R, soup.t)


def depth_maps(run: Run) -> dict[str, Float]:
    """(H, W) depths of the reference frame by method, for a run whose pair has a truth of depth.

    "nlp" is there where the NLP was refined, the rigid ones where a motion fits, "floor" where the
    truth is dense enough. "plane" and "floor" are fitted to every true pixel, also where a
    convention leaves some out by a cap or a crop: there another fit may be better.
    """
    pair, seg = run.pair, run.segmentation
    labels = seg.labels
    out = {"solution": run.reconstruction.depth_ref}
    if run.nlp_reconstruction is not None:
        out["nlp"] = run.nlp_reconstruction.depth_ref
    out["start"] = run.start_reconstruction.depth_ref
    alone = reconstruct(unorganised(run.start.soup), labels, pair.K_ref, pair.K_next)
    out["unorganised"] = alone.depth_ref
    if run.rigid is not None:
        there = np.isfinite(run.rigid)
        out["solution_rigid"] = np.where(there, run.reconstruction.depth_ref, np.nan)
        out["rigid"] = run.rigid
        if np.isfinite(run.rigid).any():
            out["rigid_filled"] = fill_nearest(run.rigid)
    truth = true_depth(run)
    if truth is None:
        return out
    whole = np.zeros(labels.shape, np.int32)
    out["plane"] = plane_depth(fit_planes(whole, truth, pair.K_ref), whole, pair.K_ref)
    out["constant"] = np.ones(pair.size)
    if np.count_nonzero(np.isfinite(truth)) >= SPARSE * len(seg):
        out["floor"] = plane_depth(fit_planes(labels, truth, pair.K_ref), labels, pair.K_ref)
    return out


def true_depth(run: Run) -> Float | None:
    """(H, W) true depth; sparse points at their nearest pixels; None where nothing is known."""
    truth = run.pair.truth
    if truth is None:
        return None
    if truth.depth_ref is not None:
        known = np.isfinite(truth.depth_ref) & (truth.depth_ref > 0)
        return np.where(known, truth.depth_ref, np.nan) if known.any() else None
    if truth.points is None:
        return None
    sparse = points_as_map(truth.points, run.pair.size)
    return sparse if np.isfinite(sparse).any() else None
