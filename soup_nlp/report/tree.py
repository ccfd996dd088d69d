"""What result.h5 holds: every array of a run with its unit and a sentence on it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from soup_nlp.geometry.soup import Soup
from soup_nlp.solve.ipopt import Stage
from soup_nlp.storage.store import Array, Tree

if TYPE_CHECKING:
    from soup_nlp.pipeline.run import Run

# name: unit, shape, sentence
_ENERGY: Mapping[str, tuple[str, str, str]] = {
    "K_next": ("px", "3,3", "intrinsics of the next frame"),
    "anchor_ray": ("1", "N,3", "ray of every anchor, third component 1"),
    "radius": ("1", "N", "largest distance of a rim pixel from the anchor, in ray units"),
    "pixel_ray": ("1", "N,S,3", "rays of the sampled pixels of E_proj"),
    "pixel_target": ("px", "N,S,2", "where the flow brings the sampled pixels"),
    "pixel_weight": ("1", "N,S", "confidence x usable share / sample size; 0 drops a pixel"),
    "edges": ("1", "E,2", "K-NN edges i < k"),
    "edge_weight": ("1", "E", "w1 = w2, both directions folded, less between two components"),
    "edge_unit": ("1", "E", "length unit of an edge, see local_units"),
    "rotation_scale": ("1", "", "factor of |R_i - R_k|"),
    "pairs": ("1", "P,2", "neighbours i < k that share boundary"),
    "boundary_ray": ("1", "P,B,3", "rays of the sampled shared boundary points"),
    "pair_weight": ("1", "P", "w4, both directions folded, less where one component hides another"),
    "pair_factor": ("1", "P", "sqrt(boundary length / B): stands for the whole boundary"),
    "pair_unit": ("1", "P", "length unit of a pair, see local_units"),
    "orient_weight": ("1", "P", "weight of E_orient: 2 directed pairs, less where the flow tears"),
    "rim_ray": ("1", "N,V,3", "rays where visibility is imposed, the anchor first"),
    "share": ("1", "N", "weights c of the length unit sum_i c_i D_i = 1"),
    "local_units": ("1", "", "units are shares of the depths of two anchors, power mean -4"),
    "arap_at_anchors": ("1", "", "motion difference at the anchors, not at the camera"),
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
_DESCENT = {
    "obj": "objective of the phase",
    "inf_pr": "0: the tangent has no constraint to violate",
    "inf_du": "largest dual infeasibility",
    "mu": "largest complementarity of rim visibility",
    "regularization_size": "median damping of the superpixels",
    "alpha_pr": "smallest step size of a superpixel",
}
"""History of a phase of the presolve, which keeps the keys of Ipopt's."""
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
_TRUTH = {
    "depth_ref": ("H,W", "true z of the reference frame, NaN where unknown"),
    "depth_next": ("H,W", "true z of the next frame, NaN where unknown"),
    "flow": ("H,W,2", "true flow, NaN where unknown"),
    "occluded": ("H,W", "reference pixel is not visible in the next frame"),
    "components": ("H,W", "component of a reference pixel, -1 for none"),
    "motions": ("B,4,4", "next_from_ref of each component"),
    "scene_flow": ("H,W,3", "true X' - X, each in its own frame's camera, NaN where unknown"),
    "points": ("M,3", "sparse truth: u and v in px, z in the unit of length"),
}
_TRUTH_UNITS = {"flow": "px", "occluded": "1", "components": "1"}


def result_tree(run: Run) -> Tree:
    """Every array of a run, as `store.write_h5` takes it."""
    pair, rec = run.pair, run.reconstruction
    assert pair.flow is not None
    depth = {
        "ref": Array(rec.depth_ref, "soup", "z of the reference frame, NaN if none", "H,W"),
        "next": Array(rec.depth_next, "soup", "z of the next frame, NaN if none", "H,W"),
        "start_ref": Array(
            run.start_reconstruction.depth_ref, "soup", "the start's z, reference frame", "H,W"
        ),
    }
    if run.rigid is not None:
        depth["rigid_ref"] = Array(
            run.rigid.depth, "translations", "z by one rigid motion, reference frame", "H,W"
        )
    if run.nlp_reconstruction is not None:
        nlp = run.nlp_reconstruction.depth_ref
        depth["nlp_ref"] = Array(nlp, "soup", "the NLP's z, reference frame", "H,W")
    return {
        "input": {
            "K_ref": Array(pair.K_ref, "px", "intrinsics of the reference frame", "3,3"),
            "K_next": Array(pair.K_next, "px", "intrinsics of the next frame", "3,3"),
            "flow": Array(pair.flow.uv, "px", "flow from reference to next", "H,W,2"),
            "confidence": Array(pair.flow.confidence, "1", "of the flow, 0 is unused", "H,W"),
        },
        "segmentation": _segmentation(run),
        "energy": {
            key: Array(value, *_described(_ENERGY, key, "EnergyData"))
            for key, value in run.data.arrays().items()
        },
        "weights": _weights(run),
        "start": {
            **_soup(run.start.soup),
            "error": Array(run.start.error, "px", "mean re-projection error", "N"),
            "parallax": Array(run.start.parallax, "px", "by which the translation moves", "N"),
            "borrowed": Array(run.start.borrowed, "1", "plane or motion from neighbours", "N"),
            "motion": Array(run.start.motion, "1", "dominant motion, -1 for its own", "N"),
            "component": Array(run.start.component, "1", "group that seems to move as one", "N"),
            "surface": Array(run.start.surface, "1", "group within which no flow tears", "N"),
            "bending_share": Array(
                np.float64(run.start.bending_share), "1", "moves otherwise than most of its surface"
            ),
            "bending": Array(np.float64(run.start.bending), "1", "surfaces are taken to bend"),
        },
        "solution": _soup(run.soup),
        "nlp": _soup(run.solution.soup),
        "refine": _refine(run),
        "answer": _soup(run.answer),
        "multipliers": {
            key: Array(
                value,
                "1",
                "of the bounds of the variables, in the order of the NLP"
                if key == "lam_x"
                else f"of the constraints {key.removeprefix('lam_g_')}, in the order of the NLP",
                "X" if key == "lam_x" else "G",
            )
            for key, value in run.solution.multipliers.items()
        },
        "iterations": {
            f"{k:02d}_{stage.name.replace(' ', '_').replace('/', '_')}": {
                key: Array(value, "1", f"{_history(stage).get(key, key)}, by iteration", "I")
                for key, value in stage.history.items()
            }
            for k, stage in enumerate(run.solution.stages)
        },
        "depth": depth,
        "truth": _truth(run),
    }


def _history(stage: Stage) -> Mapping[str, str]:
    """What the history of a stage is about."""
    return _DESCENT if stage.name.startswith("presolve") else _IPOPT


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
    }


def _described(
    table: Mapping[str, tuple[str, str, str]], key: str, record: str
) -> tuple[str, str, str]:
    """(unit, sentence, shape) in the order of `Array`."""
    unit, shape, sentence = table.get(key, ("1", "", f"{record}.{key}"))
    return unit, sentence, shape


def _soup(soup: Soup) -> dict[str, Array]:
    return {
        "lam": Array(soup.lam, "1", "scales, on the simplex", "N"),
        "n": Array(soup.n, "1", "unit normals that face the camera", "N,3"),
        "d": Array(soup.d, "soup", "plane offsets; lam d is the plane's distance", "N"),
        "R": Array(soup.R, "1", "rotations, next_from_ref", "N,3,3"),
        "t": Array(soup.t, "soup", "translations; lam t is next_from_ref", "N,3"),
    }


def _segmentation(run: Run) -> dict[str, Array]:
    s = run.segmentation
    return {
        "labels": Array(s.labels, "1", "superpixel of every pixel", "H,W"),
        "anchors": Array(s.anchors, "px", "centroids (u, v)", "N,2"),
        "sizes": Array(s.sizes, "px", "pixels of every superpixel", "N"),
        "radius": Array(s.radius, "px", "root mean square distance from the anchor", "N"),
        "knn": Array(s.knn, "1", "nearest anchors, nearest first", "N,K"),
        "edge_multiplicity": Array(
            s.edge_multiplicity, "1", "directions in which an edge of energy/edges occurs", "E"
        ),
        "boundary": Array(s.boundary, "px", "sampled shared boundary points (u, v)", "P,B,2"),
        "boundary_length": Array(s.boundary_length, "px", "shared boundary before sampling", "P"),
        "pair_weight": Array(s.pair_weight, "1", "w4 of the pairs, of the image alone", "P"),
        "rim": Array(s.rim, "px", "extreme pixels (u, v) by direction", "N,V,2"),
    }


def _weights(run: Run) -> dict[str, Array]:
    out = {
        key: Array(np.float64(value), "px" if key == "sigma_proj" else "1", f"weight {key}")
        for key, value in vars(run.weights).items()
    }
    form = run.problem.formulation
    out["min_facing"] = Array(np.float64(form.min_facing), "1", "visibility: -n . r >= c")
    out["depth_ratio"] = Array(
        np.float64(form.depth_ratio), "1", "depth at a rim pixel is at most this x the anchor's"
    )
    return out


def _truth(run: Run) -> dict[str, Array]:
    truth = run.pair.truth
    if truth is None:
        return {}
    known = {k: getattr(truth, k) for k in _TRUTH if getattr(truth, k) is not None}
    return {
        k: Array(v, _TRUTH_UNITS.get(k, truth.unit), _TRUTH[k][1], _TRUTH[k][0])
        for k, v in known.items()
    }
