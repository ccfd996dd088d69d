"""Layout of a stored result: one table of the arrays of result.h5, from which it is written, read
and checked, and the entries of summary.json that are read back."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, NotRequired, Self

import numpy as np
from typing_extensions import TypedDict

from soup_nlp.arrays import Float
from soup_nlp.errors import DataError
from soup_nlp.evaluation.metrics import DepthMetrics
from soup_nlp.evaluation.scoring import DEPTHS
from soup_nlp.pipeline.record import Run
from soup_nlp.storage.files import as_path, read_json
from soup_nlp.storage.store import ReadTree, parse_table, read_h5, require, row_of

TABLE = """
input/image_ref           1     H,W,3   reference image, 8-bit RGB
input/image_next          1     H,W,3   next image, 8-bit RGB
input/K_ref               px    3,3     intrinsics of the reference frame
input/K_next              px    3,3     intrinsics of the next frame
input/flow                px    H,W,2   flow from reference to next
input/confidence          1     H,W     of the flow, 0 is unused

segmentation/labels       1     H,W     superpixel of every pixel
segmentation/anchors      px    N,2     centroids (u, v)
segmentation/sizes        px    N       pixels of every superpixel
segmentation/knn          1     N,K     nearest anchors, nearest first
segmentation/edge_multiplicity  1  L    directions of the K-NN edges, the first L of energy/edges
segmentation/boundary     px    P,B,2   sampled shared boundary points (u, v)
segmentation/boundary_length  px  P     shared boundary before sampling
segmentation/pair_weight  1     P       w4 of the pairs, of the image alone
segmentation/rim          px    N,V,2   extreme pixels (u, v) by direction

energy/K_next             px    3,3     intrinsics of the next frame
energy/anchor_ray         1     N,3     ray of every anchor, third component 1
energy/radius             1     N       largest distance of a rim pixel from the anchor, ray units
energy/pixel_ray          1     N,S,3   rays of the sampled pixels of E_proj
energy/pixel_target       px    N,S,2   where the flow brings the sampled pixels
energy/pixel_weight       1     N,S     confidence x usable share / sample size; 0 drops a pixel
energy/edges              1     E,2     edges i < k of the K-NN graph
energy/edge_weight        1     E       w1 = w2 of both directions, less between two components
energy/prior_weight       1     E       weight of E_prior: flow noise / K for each direction
energy/prior_relief       1     E       relative difference of 1/z that costs nothing in E_prior
energy/depth_weight       1     E       weight of E_depth, 0 without a depth prior
energy/depth_change       1     E       difference of log depth by the depth prior
energy/order_weight       1     P       weight of E_order, > 0 where the second covers the first
energy/order_step         1     P       relative step of inverse depth that E_order asks for
energy/edge_unit          1     E       length unit of an edge, see local_units
energy/rotation_scale     1     E       factor of |R_i - R_k|
energy/pairs              1     P,2     neighbours i < k that share boundary
energy/boundary_ray       1     P,B,3   rays of the sampled shared boundary points
energy/pair_weight        1     P       w4 of both directions, less where a component is hidden
energy/pair_factor        1     P       sqrt(boundary length / B): stands for the whole boundary
energy/pair_unit          1     P       length unit of a pair, see local_units
energy/orient_weight      1     P       weight of E_orient: 2 directions, other where regions bend
energy/orient_turn        1     P,3     difference of normals that costs nothing in E_orient
energy/rim_ray            1     N,V,3   rays where visibility is imposed, the anchor first
energy/share              1     N       weights c of the length unit sum_i c_i D_i = 1
energy/local_units        1     -       units are shares of the depths of two anchors, power mean -4
energy/arap_at_anchors    1     -       motion difference at the anchors, not at the camera

weights/sigma_proj        px    -       weight sigma_proj
weights/min_facing        1     -       visibility: -n . r >= c
weights/depth_ratio       1     -       depth at a rim pixel is at most this x the anchor's
weights/*                 1     -       weight *

start|solution|nlp|answer/lam  1  N     scales, on the simplex
start|solution|nlp|answer/n  1  N,3     unit normals that face the camera
start|solution|nlp|answer/d  soup  N    plane offsets; lam d is the plane's distance
start|solution|nlp|answer/R  1  N,3,3   rotations, next_from_ref
start|solution|nlp|answer/t  soup  N,3  translations; lam t is next_from_ref

start/error               px    N       mean re-projection error
start/parallax            px    N       displacement that the translation causes
start/interpolated        1     N       plane or motion from neighbours
start/motion              1     N       dominant motion, -1 for its own
start/component           1     N       rigid component, which has one scale
start/part                1     N       what moves as one, also before a camera at rest
start/surface             1     N       region without a flow discontinuity
start/origin              1     N       what gives its component a scale: 0 it is the scene, \
1 contact below, 2 outline, 3 nothing, 4 ground, 5 fixed in image, 6 given depth, 7 occlusion, \
8 too fast
start/bends               1     N       in a region with the energy for surfaces that bend
start/unexplained         1     N       no motion explains the flow, or it bends although it jumps
start/bending             1     -       a region bends
start/at_rest             1     -       the camera is taken to be at rest, or to turn only
start/noise               px    -       median error of the flow; if all bends, of affine flows

multipliers/lam_x         1     X       of the bounds of the variables, in the order of the NLP
multipliers/lam_g_*       1     G       of the constraints *, in the order of the NLP

iterations/*/obj          1     I       objective of the solver's form, by iteration
iterations/*/inf_pr       1     I       largest constraint violation, by iteration
iterations/*/inf_du       1     I       largest dual infeasibility, scaled by Ipopt, by iteration
iterations/*/mu           1     I       barrier parameter, by iteration
iterations/*/d_norm       1     I       largest entry of the step, by iteration
iterations/*/regularization_size  1  I  inertia correction, by iteration
iterations/*/alpha_pr     1     I       step size, variables, by iteration
iterations/*/alpha_du     1     I       step size, multipliers, by iteration
iterations/*/ls_trials    1     I       trial points of the line search, by iteration

depth/ref                 soup  H,W     z of the reference frame, NaN if none
depth/next                soup  H,W     z of the next frame, NaN if none
depth/detail              1     H,W     log z of the reference frame relative to the planes
depth/shrinkage           1     N       part of the detail: of what is drawn, towards its neighbours
depth/ground              1/soup  3     the ground: its product with a ray is an inverse depth; or 0
depth/start_ref           soup  H,W     the start's z, reference frame
depth/rigid_ref           translations  H,W  z by one rigid motion, reference frame
depth/nlp_ref             soup  H,W     the NLP's z, reference frame
depth/sigma_ref           1     H,W     standard deviation of log z, global scale left out
depth/sigma_next          1     H,W     the same of the next frame, NaN where nothing is seen

confidence/plane          1     N,3,3   marginal covariance of relative inverse depth at the \
anchor and of its slopes over the radius, not calibrated
confidence/spread         1     H,W     standard deviation of log z by the marginals, not calibrated
confidence/kind           1     H,W     by what z is known: 0 measured, 1 inferred, 2 drawn
confidence/own_sigma      1     N       sigma of a superpixel without errors that neighbours share
confidence/component_sigma  1   C       standard deviation of a rigid component's log scale

components/of_superpixel  1     N       what moves as one in the solution; 0 is the background
components/motion         soup  C,4,4   next_from_ref, the camera's motion included
components/residual_px    px    C       median distance from where the superpixels' motions lead
components/interpolated   1     C       share of the pixels whose depth is that of neighbours

truth/depth_ref           truth  H,W    true z of the reference frame, NaN where unknown
truth/depth_next          truth  H,W    true z of the next frame, NaN where unknown
truth/flow                px    H,W,2   true flow, NaN where unknown
truth/components          1     H,W     component of a reference pixel, -1 for none
truth/motions             truth  B,4,4  next_from_ref of each component
truth/scene_flow          truth  H,W,3  true X' - X, each in its own frame's camera
truth/points              truth  M,3    sparse truth: u and v in px, z in the unit of length
"""
"""Path, unit, axes and description of every array, see `parse_table`.

"soup" and "truth" are the units of length of the reconstruction and of the truth.
"""
LAYOUT = parse_table(TABLE)
"""Rows of `TABLE` by path."""
INDICES = ("segmentation/labels", "segmentation/knn", "energy/edges", "energy/pairs")
"""Arrays of superpixels, 0 to N - 1."""
SHARED = ("N", "E", "P", "H", "W")
"""Axes with one size in all arrays: superpixels, edges, pairs, rows and columns."""
FREE = ("depth/next", "depth/sigma_next", "input/image_next", "truth/depth_next")
"""Maps of the next frame, whose size may differ."""


def _listed(values: Mapping[str, Any], prefix: str = "") -> ReadTree:
    """The arrays and numbers of nested mappings that `TABLE` names; None is left out."""
    out: ReadTree = {}
    for name, value in values.items():
        path = f"{prefix}{name}"
        if isinstance(value, Mapping):
            out[name] = _listed(value, f"{path}/")
        elif value is not None and row_of(LAYOUT, path) is not None:
            number = isinstance(value, bool | int | float)
            out[name] = np.asarray(np.float64(value) if number else value)
    return out


def result_tree(run: Run) -> ReadTree:
    """Every array of a run that `TABLE` names."""
    pair, rec, sure = run.pair, run.reconstruction, run.confidence
    form, parts = run.formulation(), run.components
    limits = {"min_facing": form.min_facing, "depth_ratio": form.depth_ratio}
    assert pair.flow is not None
    arrays = {
        "input": {**vars(pair), "flow": pair.flow.uv, "confidence": pair.flow.confidence},
        "segmentation": vars(run.segmentation),
        "energy": run.data.arrays(),
        "weights": {**vars(run.weights), **limits},
        "start": {**vars(run.start.soup), **vars(run.start), "bending": run.start.bending},
        "solution": vars(run.soup),
        "nlp": vars(run.solution.soup),
        "answer": vars(run.answer),
        "multipliers": run.solution.multipliers,
        "iterations": {
            f"{k:02d}_{re.sub('[ /]', '_', stage.name)}": stage.history
            for k, stage in enumerate(run.solution.stages)
        },
        "depth": {
            "ref": rec.depth_ref,
            "next": rec.depth_next,
            "detail": rec.detail,
            "shrinkage": run.shrinkage,
            "ground": run.ground,
            **{DEPTHS[name]: run.depth_maps.get(name) for name in ("start", "rigid", "nlp")},
            "sigma_ref": rec.sigma_ref,
            "sigma_next": rec.sigma_next,
        },
        "confidence": vars(sure),
        "components": {
            "of_superpixel": parts.of_superpixel,
            "motion": [c.motion.matrix for c in parts],
            "residual_px": [c.residual_px for c in parts],
            "interpolated": [c.interpolated for c in parts],
        },
        "truth": {} if pair.truth is None else vars(pair.truth),
    }
    return _listed(arrays)


def require_layout(tree: ReadTree) -> None:
    """DataError unless every stored array fits its row of `TABLE`: axes, type, range of indices."""
    # of the shared axes, as the first array has them
    sizes: dict[str, int] = {}
    for path, row in LAYOUT.items():
        group, _, name = path.partition("/")
        values = tree.get(group, {})
        if not isinstance(values, Mapping):
            raise _wrong(group, "an array", "a group")
        if name not in values:
            continue
        value, axes = values[name], row.axes.split(",") if row.axes else []
        if isinstance(value, Mapping) or value.dtype.kind not in "biuf":
            raise _wrong(path, "a group or text", "numbers")
        if "/image_" in path and value.dtype != np.uint8:
            raise _wrong(path, value.dtype, "uint8")
        if len(axes) != value.ndim:
            raise _wrong(path, value.shape, f"axes ({row.axes})")
        for axis, size in zip(axes, value.shape, strict=True):
            expected = int(axis) if axis.isdigit() else size
            if axis in SHARED and path not in FREE:
                expected = sizes.setdefault(axis, size)
            if size != expected or (axis in ("H", "W") and not size):
                raise _wrong(path, value.shape, f"({row.axes}) with {axis} = {expected}")
    last = sizes.get("N", 0) - 1
    for path in INDICES:
        group, name = path.split("/")
        index = tree.get(group, {}).get(name, np.zeros(0, int))
        if index.dtype.kind not in "iu" or ((index < 0) | (index > last)).any():
            raise _wrong(path, "other values", f"whole numbers from 0 to {last}")


Number = float | None
"""A number in JSON, where null stands for one that is not finite."""
_ENTRIES = {f.name: Number for f in fields(DepthMetrics)} | {"scale_rule": str, "n_pixels": int}
Scores: Any = TypedDict("Scores", {**_ENTRIES, "skill": NotRequired[Number]})  # type: ignore[misc]
"""Scores of a depth map, a `DepthMetrics`, and its skill."""


class Shares(TypedDict):
    """Shares of the image, see `verdict.certainty`."""

    measured: float
    inferred: float
    drawn: float
    median_sigma: Number


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
    certainty: Shares
    verdict: list[str]


@dataclass(frozen=True)
class Stored:
    """Contents of a result folder: entries of summary.json, arrays of result.h5."""

    folder: Path
    claims: Mapping[str, Any]
    tree: ReadTree

    @classmethod
    def read(cls, folder: str | Path) -> Self:
        """Those of a folder; DataError if it holds no result whose arrays fit `TABLE`."""
        folder = as_path(folder, "result folder")
        tree = read_h5(folder / "result.h5")
        claims = read_json(folder / "summary.json", "summary.json", Summary)
        require_layout(tree)
        return cls(folder, claims, tree)

    def soup(self, which: str) -> dict[str, Float]:
        """Arrays of a soup; DataError if one is missing."""
        keys = ("lam", "n", "d", "R", "t")
        return {k: np.asarray(require(self.tree, f"{which}/{k}"), float) for k in keys}


def _wrong(path: str, found: object, expected: str) -> DataError:
    what, where = "array of a result does not fit the others", f"result.h5, {path}"
    return DataError(what, where=where, found=found, expected=expected)
