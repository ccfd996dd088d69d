"""Layout of result.h5: unit, axes and description of every array of a run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np

from soup_nlp.pipeline.record import Run
from soup_nlp.solve.ipopt import Stage
from soup_nlp.storage.store import Array, Tree

Table: TypeAlias = Mapping[str, tuple[str, str, str]]
"""Unit, axes and description by name; "truth" stands for the unit of the truth."""

_INPUT: Table = {
    "image_ref": ("1", "H,W,3", "reference image, 8-bit RGB"),
    "image_next": ("1", "H,W,3", "next image, 8-bit RGB"),
    "K_ref": ("px", "3,3", "intrinsics of the reference frame"),
    "K_next": ("px", "3,3", "intrinsics of the next frame"),
    "flow": ("px", "H,W,2", "flow from reference to next"),
    "confidence": ("1", "H,W", "of the flow, 0 is unused"),
}
_SEGMENTATION: Table = {
    "labels": ("1", "H,W", "superpixel of every pixel"),
    "anchors": ("px", "N,2", "centroids (u, v)"),
    "sizes": ("px", "N", "pixels of every superpixel"),
    "radius": ("px", "N", "root mean square distance from the anchor"),
    "knn": ("1", "N,K", "nearest anchors, nearest first"),
    "edge_multiplicity": ("1", "E", "directions in which an edge of energy/edges occurs"),
    "boundary": ("px", "P,B,2", "sampled shared boundary points (u, v)"),
    "boundary_length": ("px", "P", "shared boundary before sampling"),
    "pair_weight": ("1", "P", "w4 of the pairs, of the image alone"),
    "rim": ("px", "N,V,2", "extreme pixels (u, v) by direction"),
}
_ENERGY: Table = {
    "K_next": ("px", "3,3", "intrinsics of the next frame"),
    "anchor_ray": ("1", "N,3", "ray of every anchor, third component 1"),
    "radius": ("1", "N", "largest distance of a rim pixel from the anchor, in ray units"),
    "pixel_ray": ("1", "N,S,3", "rays of the sampled pixels of E_proj"),
    "pixel_target": ("px", "N,S,2", "where the flow brings the sampled pixels"),
    "pixel_weight": ("1", "N,S", "confidence x usable share / sample size; 0 drops a pixel"),
    "edges": ("1", "E,2", "K-NN edges i < k"),
    "edge_weight": ("1", "E", "w1 = w2, both directions folded, less between two components"),
    "prior_weight": ("1", "E", "weight of E_prior: noise of the flow / K for each direction"),
    "prior_relief": (
        "1",
        "E",
        "relative difference of inverse depth that costs nothing in E_prior",
    ),
    "depth_weight": ("1", "E", "weight of E_depth, 0 without a depth prior"),
    "depth_change": ("1", "E", "difference of log depth by the depth prior"),
    "edge_unit": ("1", "E", "length unit of an edge, see local_units"),
    "rotation_scale": ("1", "E", "factor of |R_i - R_k|"),
    "pairs": ("1", "P,2", "neighbours i < k that share boundary"),
    "boundary_ray": ("1", "P,B,3", "rays of the sampled shared boundary points"),
    "pair_weight": ("1", "P", "w4, both directions folded, less where one component hides another"),
    "pair_factor": ("1", "P", "sqrt(boundary length / B): stands for the whole boundary"),
    "pair_unit": ("1", "P", "length unit of a pair, see local_units"),
    "orient_weight": ("1", "P", "weight of E_orient: 2 directions, other where regions bend"),
    "rim_ray": ("1", "N,V,3", "rays where visibility is imposed, the anchor first"),
    "share": ("1", "N", "weights c of the length unit sum_i c_i D_i = 1"),
    "local_units": ("1", "", "units are shares of the depths of two anchors, power mean -4"),
    "arap_at_anchors": ("1", "", "motion difference at the anchors, not at the camera"),
}
_START: Table = {
    "error": ("px", "N", "mean re-projection error"),
    "parallax": ("px", "N", "displacement that the translation causes"),
    "borrowed": ("1", "N", "plane or motion from neighbours"),
    "grounded": ("1", "N", "borrowed, and below the horizon of a known ground"),
    "motion": ("1", "N", "dominant motion, -1 for its own"),
    "component": ("1", "N", "rigid component"),
    "part": ("1", "N", "what moves as one: its component, or the largest one without usable flow"),
    "surface": ("1", "N", "region without a flow discontinuity"),
    "tie": (
        "1",
        "N",
        "what gives its component a scale: 0 largest, 1 contact below, 2 outline,"
        " 3 cut off below, 4 nothing, 5 ground, 6 fixed in the image, 7 given depth",
    ),
    "bends": ("1", "N", "in a region with the energy for surfaces that bend"),
    "bending": ("1", "", "a region bends"),
    "at_rest": ("1", "", "the camera is taken to be at rest, or to turn only"),
    "noise": ("px", "", "noise of the flow: median error; if all bends, that of affine flows"),
}
_SOUP: Table = {
    "lam": ("1", "N", "scales, on the simplex"),
    "n": ("1", "N,3", "unit normals that face the camera"),
    "d": ("soup", "N", "plane offsets; lam d is the plane's distance"),
    "R": ("1", "N,3,3", "rotations, next_from_ref"),
    "t": ("soup", "N,3", "translations; lam t is next_from_ref"),
}
_COMPONENTS: Table = {
    "of_superpixel": ("1", "N", "what moves as one in the solution; 0 is the background"),
    "motion": ("soup", "C,4,4", "next_from_ref of every component, the camera's motion included"),
    "residual_px": ("px", "C", "median distance from where the superpixels' own motions lead"),
    "borrowed": ("1", "C", "share of the pixels whose depth is a guess"),
}
_DEPTH: Table = {
    "ref": ("soup", "H,W", "z of the reference frame, NaN if none"),
    "next": ("soup", "H,W", "z of the next frame, NaN if none"),
    "start_ref": ("soup", "H,W", "the start's z, reference frame"),
    "rigid_ref": ("translations", "H,W", "z by one rigid motion, reference frame"),
    "nlp_ref": ("soup", "H,W", "the NLP's z, reference frame"),
    "sigma_ref": (
        "1",
        "H,W",
        "standard deviation of log z, reference frame, global scale left out",
    ),
    "sigma_next": ("1", "H,W", "the same of the next frame, NaN where nothing is seen"),
}
_CONFIDENCE: Table = {
    "plane": (
        "1",
        "N,3,3",
        "marginal covariance of relative inverse depth at the anchor and of its"
        " slopes over the radius, not calibrated",
    ),
    "spread": ("1", "H,W", "standard deviation of log z by the marginals, not calibrated"),
    "component_sigma": ("1", "C", "standard deviation of a rigid component's log scale"),
    "misfit": ("px", "N", "mean distance of the flow from the one that the answer induces"),
    "noise": ("px", "", "noise of the flow that the calibration uses"),
}
_IPOPT = {
    "obj": "objective of the solver's form",
    "inf_pr": "largest constraint violation",
    "inf_du": "largest dual infeasibility, scaled by Ipopt",
    "mu": "barrier parameter",
    "d_norm": "largest entry of the step",
    "regularization_size": "inertia correction",
    "alpha_pr": "step size, variables",
    "alpha_du": "step size, multipliers",
    "ls_trials": "trial points of the line search",
}
_ROUNDS = {
    "mrf_energy": "energy of the chosen labels in the MRF of the particles",
    "bound": "TRW-S's lower bound on every choice among the particles",
    "gap": "how far the choice can be from the best one among the particles",
    "moved": "superpixels that left their belief",
    "ties": "superpixels whose label was a tie when decoded",
    "iterations": "iterations of TRW-S",
    "taken": "whether the choice lowered the exact E",
    "seconds": "wall time",
}
_TRUTH: Table = {
    "depth_ref": ("truth", "H,W", "true z of the reference frame, NaN where unknown"),
    "depth_next": ("truth", "H,W", "true z of the next frame, NaN where unknown"),
    "flow": ("px", "H,W,2", "true flow, NaN where unknown"),
    "occluded": ("1", "H,W", "reference pixel is not visible in the next frame"),
    "components": ("1", "H,W", "component of a reference pixel, -1 for none"),
    "motions": ("truth", "B,4,4", "next_from_ref of each component"),
    "scene_flow": (
        "truth", "H,W,3", "true X' - X, each in its own frame's camera, NaN where unknown"
    ),
    "points": ("truth", "M,3", "sparse truth: u and v in px, z in the unit of length"),
}  # fmt: skip


LAYOUT: Mapping[str, Table] = {
    "input": _INPUT,
    "segmentation": _SEGMENTATION,
    "energy": _ENERGY,
    "start": {**_SOUP, **_START},
    "solution": _SOUP,
    "nlp": _SOUP,
    "answer": _SOUP,
    "depth": _DEPTH,
    "truth": _TRUTH,
}
"""Tables of the groups by name."""


def result_tree(run: Run) -> Tree:
    """Every array of a run, as `store.write_h5` takes it."""
    pair, rec, nlp = run.pair, run.reconstruction, run.nlp_reconstruction
    assert pair.flow is not None
    depth = {
        "ref": rec.depth_ref,
        "next": rec.depth_next,
        "start_ref": run.start_reconstruction.depth_ref,
        "rigid_ref": run.rigid,
        "nlp_ref": None if nlp is None else nlp.depth_ref,
        "sigma_ref": rec.sigma_ref,
        "sigma_next": rec.sigma_next,
    }
    sure = {
        "plane": run.confidence.marginals.plane,
        "spread": run.confidence.spread,
        "component_sigma": run.confidence.component_sigma,
        "misfit": run.confidence.misfit,
        "noise": np.float64(run.confidence.noise),
    }
    flow = {"flow": pair.flow.uv, "confidence": pair.flow.confidence}
    numbers = "bending", "at_rest", "noise"
    start = vars(run.start) | {name: np.float64(getattr(run.start, name)) for name in numbers}
    truth = pair.truth
    return {
        "input": _arrays(_INPUT, {**vars(pair), **flow}),
        "segmentation": _arrays(_SEGMENTATION, run.segmentation),
        "energy": _arrays(_ENERGY, run.data.arrays()),
        "weights": _weights(run),
        "start": _arrays(_SOUP, run.start.soup) | _arrays(_START, start),
        "solution": _arrays(_SOUP, run.soup),
        "nlp": _arrays(_SOUP, run.solution.soup),
        "refine": _refine(run),
        "answer": _arrays(_SOUP, run.answer),
        "multipliers": {
            key: Array(value, "1", *_constrained(key))
            for key, value in run.solution.multipliers.items()
        },
        "iterations": {
            f"{k:02d}_{stage.name.replace(' ', '_').replace('/', '_')}": _history(stage)
            for k, stage in enumerate(run.solution.stages)
        },
        "depth": _arrays(_DEPTH, depth),
        "confidence": _arrays(_CONFIDENCE, sure),
        "components": _arrays(_COMPONENTS, _components(run)),
        "truth": {} if truth is None else _arrays(_TRUTH, truth, truth.unit),
    }


def _arrays(table: Table, values: object, unit: str = "") -> dict[str, Array]:
    """Values of a record or mapping that a table describes, without None."""
    found = values if isinstance(values, Mapping) else vars(values)
    return {
        key: Array(found[key], unit if own == "truth" else own, text, axes)
        for key, (own, axes, text) in table.items()
        if found.get(key) is not None
    }


def _components(run: Run) -> dict[str, Any]:
    """Rigid components of the solution (C)."""
    found = run.components
    return {
        "of_superpixel": found.of_superpixel,
        "motion": np.stack([c.motion.matrix for c in found]),
        "residual_px": np.array([c.residual_px for c in found]),
        "borrowed": np.array([c.borrowed for c in found]),
    }


def _constrained(key: str) -> tuple[str, str]:
    """Description and axis of a vector of multipliers."""
    if key == "lam_x":
        return "of the bounds of the variables, in the order of the NLP", "X"
    return f"of the constraints {key.removeprefix('lam_g_')}, in the order of the NLP", "G"


def _history(stage: Stage) -> dict[str, Array]:
    """Progress of a stage by iteration."""
    return {
        key: Array(value, "1", f"{_IPOPT.get(key, key)}, by iteration", "I")
        for key, value in stage.history.items()
    }


def _refine(run: Run) -> dict[str, Array]:
    """The refinement by round (T) and kind of proposal (C)."""
    r = run.refined
    if r is None or not r.rounds:
        return {}
    kinds = ", ".join(r.rounds[0].proposed)
    out = {
        f"energy_{term}": Array(
            np.array([one.energy[term] for one in r.rounds]), "1", f"exact E, {term}, by round", "T"
        )
        for term in r.energy
    }
    for key, sentence in _ROUNDS.items():
        values = np.array([getattr(one, key) for one in r.rounds])
        out[key] = Array(values, "s" if key == "seconds" else "1", f"{sentence}, by round", "T")
    for key, sentence in (("proposed", "feasible particles"), ("accepted", "chosen particles")):
        table = np.array([list(getattr(one, key).values()) for one in r.rounds])
        out[key] = Array(table, "1", f"{sentence} by round and kind: {kinds}", "T,C")
    return out


def _weights(run: Run) -> dict[str, Array]:
    """Constants of the energy and of the visibility constraint."""
    form = run.problem.formulation
    out = {
        key: Array(np.float64(value), "px" if key == "sigma_proj" else "1", f"weight {key}")
        for key, value in vars(run.weights).items()
    }
    out["min_facing"] = Array(np.float64(form.min_facing), "1", "visibility: -n . r >= c")
    out["depth_ratio"] = Array(
        np.float64(form.depth_ratio), "1", "depth at a rim pixel is at most this x the anchor's"
    )
    return out


def attributes(run: Run, config: str) -> dict[str, Any]:
    """Root attributes of result.h5."""
    return {
        "name": run.problem.name,
        "problem_hash": run.problem.digest(),
        "seed": run.problem.seed,
        "status": run.solution.status,
        "converged": run.solution.converged,
        "delivered": run.delivered,
        "config": config,
        "nlp": run.solution.description,
        # None is left out
        "scale_to_truth": run.metrics["solution"].scale if "solution" in run.metrics else None,
        "truth_unit": None if run.pair.truth is None else run.pair.truth.unit,
    }
