"""Depth maps that are scored: solution, earlier stages, baselines with the same flow."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.evaluate.baselines import fill_nearest
from soup_nlp.geometry.soup import Soup, reconstruct
from soup_nlp.pipeline.record import Run

METHODS: Mapping[str, str] = MappingProxyType(
    {
        "solution": "what the product delivers",
        "solution_90": "the same, on the 90 % of the true pixels where sigma is least",
        "solution_70": "the same, on 70 %",
        "nlp": "the NLP alone, before refinement",
        "start": "the start: shared motions, scales by contact",
        "unorganised": "independent superpixels: each with a translation of length 1, no assembly",
        "solution_rigid": "the solution, only where one rigid motion has a depth",
        "rigid": "one rigid motion, triangulated; only where it has a depth",
        "rigid_filled": "the same, holes filled from the nearest pixel",
        "constant": "a constant depth",
    }
)
"""Descriptions of the depth maps, in the order of the tables."""

BASELINES = ("unorganised", "rigid", "rigid_filled", "constant")
"""Depth maps that the solution is compared with."""


def unorganised(soup: Soup) -> Soup:
    """The soup before assembly: the scale of every superpixel makes its translation have length 1.

    Two views determine each plane and motion up to a scale, so this is the result of independent
    superpixels. Superpixels at rest keep their scale.
    """
    length = np.linalg.norm(soup.translation, axis=1)
    tiny = 1e-9 * max(float(length.max(initial=0.0)), 1e-300)
    unit = np.where(length > tiny, length, 1.0)
    return Soup(soup.lam / unit, soup.n, soup.d, soup.R, soup.t)


def depth_maps(run: Run) -> dict[str, Float]:
    """(H, W) depths of the reference frame by method, for a run whose pair has a truth of depth.

    "nlp" is present if the NLP was refined, the rigid ones if a motion fits, and "constant" if
    there is a truth.
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
    truth = run.pair.truth
    if truth is not None and (truth.depth_ref is not None or truth.points is not None):
        out["constant"] = np.ones(pair.size)
    return out
