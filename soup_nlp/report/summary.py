"""What a run found and how sure that is, as numbers: summary.json and the shares of the verdict."""

from dataclasses import fields
from typing import Any, Literal, NotRequired

import numpy as np
from typing_extensions import TypedDict

from soup_nlp.evaluation.confidence import KINDS
from soup_nlp.evaluation.metrics import DepthMetrics, component_overlaps, skill
from soup_nlp.geometry.constraints import constraints
from soup_nlp.pipeline.record import Run
from soup_nlp.storage.versions import versions

_ROUND = (
    *("energy", "mrf_energy", "bound", "gap", "taken", "moved", "iterations", "status"),
    *("seconds", "proposed", "accepted"),
)
"""Entries of a round of the refinement in summary.json."""

Number = float | None
"""A number in JSON, where null stands for one that is not finite."""
_OTHERS = {"scale_rule": str, "n_pixels": int}
Scores: Any = TypedDict(  # type: ignore[misc]
    "Scores",
    {f.name: _OTHERS.get(f.name, Number) for f in fields(DepthMetrics)}
    | {"skill": NotRequired[Number]},
)
"""Scores of a depth map, a `DepthMetrics`, and its skill."""


class Shares(TypedDict):
    """Shares of the image, see `certainty`."""

    measured: float
    inferred: float
    drawn: float
    median_sigma: Number


class Sizes(TypedDict):
    """Sizes of the problem."""

    superpixels: int


class Summary(TypedDict):
    """Entries of summary.json that are read back."""

    name: str
    status: str
    converged: bool
    delivered: str
    energy: dict[Literal["start", "nlp", "solution"], dict[str, Number]]
    residuals: dict[str, Number]
    nlp_residuals: dict[str, Number]
    answer_residuals: dict[str, Number]
    metrics: dict[str, Scores]
    truth_unit: str | None
    seconds: dict[str, float]
    sizes: Sizes
    certainty: Shares
    verdict: list[str]


def summary(run: Run) -> dict[str, Any]:
    """Contents of summary.json; the keys are stable."""
    s, r, full, truth = run.solution, run.refined, run.full, run.pair.truth
    constant = run.metrics["constant"].mre if "constant" in run.metrics else np.nan
    facing = run.problem.formulation.min_facing
    components: dict[str, Any] = {"count": len(run.components)}
    if truth is not None and truth.components is not None:
        overlaps = component_overlaps(run.components.of_pixel, truth.components)
        components["truth"] = {
            str(k): {"component": c, "iou": iou} for k, (c, iou) in overlaps.items()
        }
    return {
        "name": run.problem.name,
        "problem_hash": run.problem.digest(),
        "status": s.status,
        "converged": s.converged,
        "delivered": run.delivered,
        "energy_by_stage": dict(s.ends)
        | ({} if r is None else {"refinement": run.energy["total"]}),
        "energy": {"start": s.energy_start, "nlp": s.energy, "solution": run.energy},
        "residuals": run.residuals,
        "nlp_residuals": constraints(s.soup, run.data.rim_ray, facing).largest,
        "answer_residuals": constraints(run.answer, run.data.rim_ray, facing).largest,
        "refinement": None
        if r is None
        else {
            "status": r.status,
            "seconds": r.seconds,
            "contradicted": r.contradicted,
            "start": r.energy_start,
            "begin": r.energy_begin,
            "end": r.energy,
            "rounds": [{key: getattr(one, key) for key in _ROUND} for one in r.rounds],
        },
        "metrics": {
            # the constant depth is scored on the reference frame only
            k: vars(m) | ({} if k == "solution_next" else {"skill": skill(m.mre, constant)})
            for k, m in run.metrics.items()
        },
        "truth_unit": None if truth is None else truth.unit,
        "components": components,
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
        "full_size": None
        if full is None
        else {
            "width": full.depth_ref.shape[1],
            "height": full.depth_ref.shape[0],
            "metrics": full.metrics and vars(full.metrics),
        },
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
        "focal_sigma": run.pair.focal_sigma,
        "camera_error": run.confidence.evidence.camera,
    }


def certainty(run: Run) -> dict[str, float]:
    """Shares of the image by `KINDS` of its depth, and "median_sigma" of what is measured."""
    sure = run.confidence
    sigma = sure.sigma[sure.kind == KINDS.index("measured")]
    middle = float(np.median(sigma)) if sigma.size else float("nan")
    return {**{kind: sure.share(kind) for kind in KINDS}, "median_sigma": middle}
