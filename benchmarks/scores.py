"""The row of a pair: errors of the solution and of baselines, of what is seen, moves, of sigma."""

import math

import numpy as np
from scipy.ndimage import distance_transform_edt

from benchmarks.suites import SUITES
from benchmarks.table import Cell
from soup_nlp import Pair, Run, Soup, Truth, run
from soup_nlp.arrays import Float, Mask
from soup_nlp.errors import DataError
from soup_nlp.evaluation.confidence import LARGEST, MOST_SIGMA
from soup_nlp.evaluation.metrics import MEDIAN, UNSCALED, depth_metrics, skill
from soup_nlp.evaluation.scoring import at_truth, score_depths
from soup_nlp.geometry.soup import reconstruct
from soup_nlp.storage.each import Row

METHODS = (
    *("solution", "nlp", "start", "unorganised", "solution_rigid", "rigid", "rigid_filled"),
    "constant",
)
"""Depth maps in the order of the tables: what is delivered, the NLP alone, the start, independent
superpixels (each with a translation of length 1), the solution where one rigid motion has a depth,
that motion triangulated, the same with holes filled from the nearest pixel, a constant depth."""
SEEN = 0.5
"""Mean confidence of the flow of a superpixel up to which its pixels count as not seen."""
SURE = 0.10
"""Sigma below which a depth claims to be sure."""
RIGHT, WRONG = 0.10, 0.20
"""Relative errors up to which a depth is right, and above which it is wrong."""
STEPS, LAST = 50, 0.02
"""Points of a sparsification curve, and share of the pixels kept at the last one."""
PIXELS = 500
"""Pixels with truth of a pair, drawn at random, to which sigma is fitted."""


def measure_pair(cell: Cell) -> Row:
    """Solve and score one pair."""
    item = cell.item
    problem = item.problem(cell.overrides)
    pair = problem.load_pair()
    # do not solve a pair that cannot be scored
    if not has_depth(pair.truth):
        suite = SUITES[item.suite]
        raise DataError(
            "pair has no true depth",
            where=item.key,
            expected=suite.layout or None,
            hint=f"get it from {suite.source}" if suite.source else None,
        )
    result = run(problem, pair=pair)
    return {**scores(result), "pixels": pixels(result)}


def pixels(result: Run) -> Row:
    """Errors of log depth after the median scale, and terms of sigma, at pixels of one pair."""
    truth = result.pair.truth
    assert truth is not None
    z, gt = (v.ravel() for v in at_truth(truth, result.reconstruction.depth_ref))
    at = np.flatnonzero(np.isfinite(gt) & np.isfinite(z) & (gt > 0) & (z > 0))
    at = np.random.default_rng(0).permutation(at)[:PIXELS]
    error = np.log(z[at] * np.median(gt[at] / z[at]) / gt[at])
    terms = {k: at_truth(truth, v)[0].ravel()[at] for k, v in result.confidence.terms.items()}
    return {
        "error": np.round(error, 5).tolist(),
        "terms": {k: np.round(np.minimum(v, LARGEST), 5).tolist() for k, v in terms.items()},
    }


def scores(result: Run) -> Row:
    """Metrics by method, and what a run says of itself.

    Metrics are of every true pixel after one median scale, without a cap.
    """
    maps, truth, solution = depth_maps(result), result.pair.truth, result.solution
    row = {
        "status": solution.status,
        "good": result.solved,
        "stages": dict(result.seconds),
        "iterations": sum(stage.iterations for stage in solution.stages),
        "drawn": result.confidence.share("drawn"),
    }
    if truth is None or not has_depth(truth):
        return {**row, "metrics": {}}
    scored = score_depths(truth, maps)
    scale, constant = scored["solution"].scale, scored["constant"].mre
    kept = "mre", "median_relative", "delta1", "scale", "coverage"
    metrics = {
        method: {**{k: getattr(m, k) for k in kept}, "skill": skill(m.mre, constant)}
        for method, m in scored.items()
    }
    z, gt = at_truth(truth, result.reconstruction.depth_ref)
    sigma = result.reconstruction.sigma_ref
    counts = MEDIAN.mask(gt) & np.isfinite(z) & (z > 0)
    if counts.any() and sigma is not None:
        error = np.log(z[counts] * scale / gt[counts])
        row["sigma"] = sigma_scores(error, at_truth(truth, sigma)[0][counts])
    return {
        **row,
        "metrics": metrics,
        "seen": split(truth, maps["solution"], seen(result), scale),
        "moving": moving(result.pair, maps["solution"]),
    }


def has_depth(truth: Truth | None) -> bool:
    """Whether there is a depth to compare with."""
    if truth is None:
        return False
    if truth.depth_ref is not None:
        return MEDIAN.counts(truth.depth_ref)
    return truth.points is not None and MEDIAN.counts(truth.points[:, 2])


def sparsification(error: Float, uncertainty: Float) -> tuple[Float, float]:
    """Mean errors of the pixels that are kept when the most uncertain ones are removed.

    Ilg et al., "Uncertainty estimates and multi-hypotheses networks for optical flow", ECCV 2018.
    Pixels of equal uncertainty count with their mean error, because their order is arbitrary.

    Args:
        error: (M,) errors, not negative; M at least 1.
        uncertainty: (M,) larger where the error is expected to be larger.

    Returns:
        (3, STEPS) shares of the pixels from 1 down, mean error of that share with the least
        uncertainty, and of that with the least error; and the area between both over the mean
        error: 0 is perfect, about 1 is chance.
    """
    kept = np.linspace(1.0, LAST, STEPS)
    last = np.maximum((kept * len(error)).astype(int) - 1, 0)
    _, group = np.unique(uncertainty, return_inverse=True)
    tie_mean = np.bincount(group, error) / np.bincount(group)
    sums = np.cumsum(tie_mean[np.sort(group)]), np.cumsum(np.sort(error))
    mean_error, best = (total[last] / (last + 1) for total in sums)
    whole = float(error.mean())
    ause = float((mean_error - best).mean() / whole) if whole > 0 else 0.0
    return np.stack([kept, mean_error, best]), ause


def sigma_scores(error: Float, sigma: Float) -> Row:
    """How well sigma (M,) tells the errors of log depth (M,), both at true pixels.

    `ABOUT_SIGMA` in benchmarks/accuracy.py explains the scores. "curve" has (kept share, error,
    error of the oracle) of the sparsification, "reliability" (mean sigma, root mean square error)
    by tenths of the pixels by sigma.
    """
    relative = np.abs(np.expm1(error))
    curve, ause = sparsification(relative, sigma)
    right, wrong, sure = relative <= RIGHT, relative > WRONG, sigma < SURE
    rms = max(math.sqrt(float(np.mean(error**2))), 1e-12)
    tenths = np.array_split(np.argsort(sigma, kind="stable"), 10)
    within = [float(np.mean(np.abs(error) <= k * sigma)) for k in (1, 2)]
    return {
        "nll": float(np.mean(0.5 * (error / sigma) ** 2 + np.log(sigma))),
        "flat": 0.5 + math.log(rms),
        "within1": within[0],
        "within2": within[1],
        "sure_wrong": _share(wrong, sure),
        "wrong_sure": _share(sure, wrong),
        "right_unsure": _share(sigma > MOST_SIGMA, right),
        "ause": ause,
        "curve": np.round(curve, 5).tolist(),
        "reliability": [
            [float(np.mean(sigma[k])), math.sqrt(float(np.mean(error[k] ** 2)))]
            for k in tenths
            if len(k)
        ],
    }


def _share(what: Mask, among: Mask) -> float | None:
    """Share of some pixels that are of another kind; None where there are no such pixels."""
    return float(what[among].mean()) if among.any() else None


def seen(result: Run) -> Mask:
    """(H, W) True where the superpixel of a pixel has usable flow, see `SEEN`."""
    labels, flow = result.segmentation.labels, result.pair.flow
    # a run has a flow
    assert flow is not None
    flat = labels.ravel()
    mean = np.bincount(flat, flow.confidence.ravel()) / np.maximum(np.bincount(flat), 1)
    return np.asarray(mean[labels] > SEEN)


def split(truth: Truth, depth: Float, part: Mask, scale: float) -> Row:
    """MRE of a part of the pixels and of the rest, under the scale of all, and its share."""
    z, gt = at_truth(truth, depth)
    inside = at_truth(truth, part.astype(float))[0] > 0
    counts = MEDIAN.mask(gt) & np.isfinite(z)
    out: Row = {"share": _share(inside, counts)}
    for name, mask in (("mre", counts & inside), ("rest", counts & ~inside)):
        masked = np.where(mask, gt, np.nan)
        out[name] = depth_metrics(z * scale, masked, UNSCALED).mre if mask.any() else None
    return out


def moving(pair: Pair, depth: Float) -> Row | None:
    """Errors of a depth (H, W) where something moves by itself, see `split`, one median scale.

    Components move by themselves if their true motion is not that of the static scene, 0; without
    known motions, all do. None without such pixels, or without components and dense depth.
    """
    truth = pair.truth
    if truth is None or truth.components is None or truth.depth_ref is None:
        return None
    label = truth.components
    part = label > 0
    if truth.motions is not None:
        near = np.isclose(truth.motions, truth.motions[0], rtol=0, atol=1e-9).all(axis=(1, 2))
        part &= ~np.isin(label, np.flatnonzero(near))
    known = Truth(depth_ref=np.where(label >= 0, truth.depth_ref, np.nan))
    scale = depth_metrics(depth, truth.depth_ref).scale
    errors = split(known, depth, part, scale) if has_depth(known) else {"mre": None, "rest": None}
    return None if errors["mre"] is None or errors["rest"] is None else errors


def unorganised(soup: Soup) -> Soup:
    """The soup before assembly: the scale of every superpixel makes its translation have length 1.

    Two views determine each plane and motion up to a scale, so this is the result of independent
    superpixels. Superpixels at rest keep their scale.
    """
    length = np.linalg.norm(soup.translation, axis=1)
    tiny = 1e-9 * max(float(length.max(initial=0.0)), 1e-300)
    unit = np.where(length > tiny, length, 1.0)
    return Soup(soup.lam / unit, soup.n, soup.d, soup.R, soup.t)


def depth_maps(result: Run) -> dict[str, Float]:
    """(H, W) depths of the reference frame by method.

    "nlp" is present if the NLP was refined, and the rigid depths if a motion fits.
    """
    pair, labels = result.pair, result.segmentation.labels
    known = result.depth_maps
    out = {k: known[k] for k in ("solution", "nlp", "start") if k in known}
    alone = reconstruct(unorganised(result.start.soup), labels, pair.K_ref, pair.K_next)
    out["unorganised"] = alone.depth_ref
    rigid = known.get("rigid")
    if rigid is not None:
        unknown = ~np.isfinite(rigid)
        out["solution_rigid"] = np.where(unknown, np.nan, known["solution"])
        out["rigid"] = rigid
        if not unknown.all():
            nearest = distance_transform_edt(unknown, return_distances=False, return_indices=True)
            out["rigid_filled"] = rigid[tuple(nearest)]
    return out
