"""Contents of summary.json: status, energies, scores, and shares of the image by certainty."""

from __future__ import annotations

from typing import Any

import numpy as np

from soup_nlp.arrays import Mask
from soup_nlp.evaluate.confidence import MOST_SIGMA
from soup_nlp.evaluate.metrics import component_overlaps, skill
from soup_nlp.geometry.surface import hidden
from soup_nlp.pipeline.record import Run
from soup_nlp.solve.kkt import constraint_residuals
from soup_nlp.start.components import FIXED, TIES
from soup_nlp.storage.versions import versions

_ROUND = (
    *("energy", "mrf_energy", "bound", "gap", "taken", "moved", "ties", "iterations", "status"),
    *("seconds", "proposed", "accepted"),
)
"""Entries of a round of the refinement in summary.json."""


def summary(run: Run) -> dict[str, Any]:
    """Contents of summary.json; the keys are stable."""
    s = run.solution
    constant = run.metrics["constant"].mre if "constant" in run.metrics else np.nan
    facing = run.problem.formulation.min_facing
    return {
        "name": run.problem.name,
        "problem_hash": run.problem.digest(),
        "status": s.status,
        "converged": s.converged,
        "delivered": run.delivered,
        "energy_by_stage": dict(s.ends)
        | ({"refinement": run.energy["total"]} if run.refined is not None else {}),
        "energy": {"start": s.energy_start, "nlp": s.energy, "solution": run.energy},
        "residuals": run.residuals,
        "nlp_residuals": constraint_residuals(s.soup, run.data.rim_ray, facing),
        "answer_residuals": constraint_residuals(run.answer, run.data.rim_ray, facing),
        "refinement": refinement_summary(run),
        "metrics": {
            # the constant depth is scored on the reference frame only
            k: m.as_dict() | ({} if k == "solution_next" else {"skill": skill(m.mre, constant)})
            for k, m in run.metrics.items()
        },
        "components": _components(run),
        "expected": run.problem.expected.model_dump(),
        "seconds": run.seconds,
        "iterations": {stage.name: stage.iterations for stage in s.stages},
        "sizes": {
            "superpixels": len(run.segmentation),
            "knn_edges": len(run.segmentation.edges),
            "neighbour_pairs": len(run.segmentation.pairs),
            "width": run.pair.size[1],
            "height": run.pair.size[0],
            **s.nlp,
        },
        "full_size": _full_size(run),
        "start": {
            "motions": len(run.start.motions),
            "borrowed": int(run.start.borrowed.sum()),
            "median_error_px": float(np.median(run.start.error)),
        },
        "certainty": certainty(run),
        "evidence": run.confidence.evidence.rows(),
        **({} if run.given is None else {"depth_prior": run.given.as_dict()}),
        "flow": str(run.pair.flow),
        "versions": versions(),
        "seed": run.problem.seed,
    }


def _full_size(run: Run) -> dict[str, Any] | None:
    """Size and score of the depth at the size of the images; None if it was solved at that size."""
    if run.full is None:
        return None
    height, width = run.full.depth_ref.shape
    scores = run.full.metrics
    return {"width": width, "height": height, "metrics": scores and scores.as_dict()}


def _components(run: Run) -> dict[str, Any]:
    """Number of components, and their overlap with the true ones."""
    truth = run.pair.truth
    out: dict[str, Any] = {"count": len(run.components)}
    if truth is not None and truth.components is not None:
        found = component_overlaps(run.components.of_pixel, truth.components)
        out["truth"] = {str(k): {"component": c, "iou": iou} for k, (c, iou) in found.items()}
    return out


def refinement_summary(run: Run) -> dict[str, Any] | None:
    """Results of the refinement by round; None if it was disabled."""
    r = run.refined
    if r is None:
        return None
    return {
        "status": r.status,
        "seconds": r.seconds,
        "contradicted": r.contradicted,
        "start": r.energy_start,
        "begin": r.energy_begin,
        "end": r.energy,
        "rounds": [{key: getattr(one, key) for key in _ROUND} for one in r.rounds],
    }


def certainty(run: Run) -> dict[str, float]:
    """Shares of the image for summary.json and the verdict.

    Returns:
        "determined": share with a sigma of log depth of at most `MOST_SIGMA`; the sum of "flow"
        (pixels of the largest component), "contact" and "outline" (pixels of other components, by
        the source of their scale), and with a depth prior "given" (depth or scale are the
        prior's). "guess": the rest; the sum of "rest" (the camera is at rest or
        only turns), "fixed" (stands still in the image though the camera moves, such as the bonnet
        of its car), "unseen" (no usable flow, or hidden in the next frame), "flat" (of a
        component without evidence of depth, see `Evidence.guess`), "scale" (of a component whose
        scale alone is as uncertain as that) and "weak" (anything else). "median_sigma": median of
        the determined pixels.
    """
    sigma = run.confidence.sigma
    labels, start = run.segmentation.labels, run.start
    sure = sigma <= MOST_SIGMA
    tie = start.tie[labels]
    assert run.pair.flow is not None
    unseen = (run.pair.flow.confidence <= 0) | hidden(run.reconstruction)
    rest, fixed = np.full(labels.shape, start.at_rest), tie == FIXED
    flat = run.confidence.evidence.guess[start.component][labels]
    loose = run.confidence.scale[labels] > MOST_SIGMA
    guess, left = {}, ~sure
    reasons = {"rest": rest, "fixed": fixed, "unseen": unseen, "flat": flat, "scale": loose}
    for name, mask in reasons.items():
        guess[name] = left & mask
        left = left & ~mask

    def share(mask: Mask) -> float:
        return float(mask.mean())

    given = np.zeros(len(start.soup), bool) if run.given is None else run.given.held
    by_flow = sure & ~given[labels]
    return {
        "determined": share(sure),
        "flow": share(by_flow & (tie == TIES.index("reference"))),
        "contact": share(by_flow & (tie == TIES.index("contact below"))),
        "outline": share(by_flow & (tie > TIES.index("contact below"))),
        **({} if run.given is None else {"given": share(sure & given[labels])}),
        "guess": share(~sure),
        **{name: share(mask) for name, mask in guess.items()},
        "weak": share(left),
        "median_sigma": float(np.median(sigma[sure])) if sure.any() else float("nan"),
    }
