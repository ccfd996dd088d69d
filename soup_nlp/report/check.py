"""Claims of a result folder recomputed from its arrays, with code of its own.

Nothing of `soup_nlp.model` or `soup_nlp.solve` is used: the energy is written a third time here,
straight from the equations, so that a mistake in the model cannot confirm itself.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soup_nlp.errors import DataError
from soup_nlp.report.metrics import depth_metrics, sample_at_points
from soup_nlp.report.store import read_h5, require

Float = NDArray[np.float64]

LIMITS = {"so3": 1e-8, "normal": 1e-8, "simplex": 1e-10, "positive": 0.0, "det": 1e-8}


@dataclass(frozen=True)
class Row:
    """One claim.

    Attributes:
        name: What is claimed.
        claimed: Value in summary.json.
        found: Value recomputed from the arrays.
        limit: Largest allowed found value (constraints) or relative difference (numbers).
        ok: Whether the claim holds.
        worst: Superpixel with the largest residual, -1 where there is none.
    """

    name: str
    claimed: float
    found: float
    limit: float
    ok: bool
    worst: int = -1

    def __str__(self) -> str:
        where = f"  superpixel {self.worst}" if self.worst >= 0 else ""
        mark = "ok  " if self.ok else "FAIL"
        return f"{mark} {self.name:<24} {self.claimed:>13.6g} {self.found:>13.6g}" + (
            f" {self.limit:>9.1e}{where}"
        )


@dataclass(frozen=True)
class CheckReport:
    """All rows of a check."""

    rows: tuple[Row, ...]

    @property
    def ok(self) -> bool:
        """Every claim holds."""
        return all(r.ok for r in self.rows)

    def __str__(self) -> str:
        head = f"     {'claim':<24} {'claimed':>13} {'recomputed':>13} {'limit':>9}"
        return "\n".join([head, *map(str, self.rows)])


def check_folder(folder: str | Path) -> CheckReport:
    """Recompute energy, constraints and metrics of a result folder.

    Raises:
        DataError: a file or array is missing.
    """
    folder = Path(folder)
    try:
        claims = json.loads((folder / "summary.json").read_text())
    except (OSError, ValueError) as error:
        raise DataError(
            "summary.json cannot be read", where=folder, found=str(error), hint="run solve first"
        ) from error
    tree = read_h5(folder / "result.h5")
    rows: list[Row] = []
    for which in ("start", "solution"):
        found = _energy(_state(tree, which), tree)
        for term, value in found.items():
            claimed = float(claims["energy"][which][term])
            ok = abs(value - claimed) <= 1e-9 * max(1.0, abs(value))
            rows.append(Row(f"energy {which} {term}", claimed, value, 1e-9, ok))
    rows += _constraints(_state(tree, "solution"), tree, claims["residuals"])
    rows += _depth(tree)
    rows += _metrics(tree, claims["metrics"])
    if claims["converged"]:
        start, end = (float(claims["energy"][k]["total"]) for k in ("start", "solution"))
        rows.append(Row("energy falls", end, end - start, 0.0, end <= start))
    return CheckReport(tuple(rows))


State = Mapping[str, Float]


def _state(tree: Mapping[str, Any], which: str) -> State:
    names = ("lam", "n", "d", "R", "t")
    return {k: np.asarray(require(tree, f"{which}/{k}"), float) for k in names}


def _lift(s: State, ray: Float, who: NDArray[np.int64]) -> tuple[Float, Float]:
    """Points in both frames of rays (M, ..., 3) on the planes of superpixels who (M,)."""
    more = (slice(None),) + (None,) * (ray.ndim - 2)
    facing = -(s["n"][who][(*more, slice(None))] * ray).sum(-1)
    X = ((s["lam"] * s["d"])[who][more] / facing)[..., None] * ray
    T = (s["lam"][:, None] * s["t"])[who]
    Y = np.matmul(X.reshape(len(who), -1, 3), np.swapaxes(s["R"][who], 1, 2)) + T[:, None]
    return X, Y.reshape(X.shape)


def _energy(s: State, tree: Mapping[str, Any]) -> dict[str, float]:
    e = {k: np.asarray(v) for k, v in tree["energy"].items()}
    w = {k: float(np.asarray(v)) for k, v in tree["weights"].items()}
    ray, every = e["anchor_ray"], np.arange(len(s["lam"]))
    A, B = _lift(s, ray[:, None], every)
    A, B = A[:, 0], B[:, 0]
    T = s["lam"][:, None] * s["t"]
    scene = float((e["share"] * s["lam"] * s["d"]).sum())

    def unit(pairs: NDArray[np.int64]) -> Float:
        if bool(e["local_units"]):
            return A[pairs, 2].mean(axis=1)
        return np.full(len(pairs), scene)

    i, k = e["edges"].T
    length = unit(e["edges"]) * e["edge_unit"]
    dR = s["R"][i] - s["R"][k]
    shift = T[i] - T[k]
    if bool(e["arap_at_anchors"]):
        shift = shift + np.einsum("eij,ej->ei", dR, (A[i] + A[k]) / 2)
    parts = (
        float(e["rotation_scale"]) * np.sqrt((dR**2).sum((1, 2))),
        np.sqrt((shift**2).sum(1)) / length,
        np.abs(np.sqrt(((A[i] - A[k]) ** 2).sum(1)) - np.sqrt(((B[i] - B[k]) ** 2).sum(1)))
        / length,
    )
    arap = float((e["edge_weight"] * sum(np.minimum(p, w["sigma_arap"]) for p in parts)).sum())

    _, moved = _lift(s, e["pixel_ray"], every)
    image = moved @ e["K_next"].T
    miss = image[..., :2] / image[..., 2:] - e["pixel_target"]
    miss = np.minimum(np.sqrt((miss**2).sum(-1)), w["sigma_proj"])
    proj = float((e["pixel_weight"] * miss).sum())

    cont = orient = 0.0
    if len(e["pairs"]):
        i, k = e["pairs"].T
        Xi, Yi = _lift(s, e["boundary_ray"], i)
        Xk, Yk = _lift(s, e["boundary_ray"], k)
        factor = e["pair_factor"] / (unit(e["pairs"]) * e["pair_unit"])
        before = factor * np.sqrt(((Xi - Xk) ** 2).sum((1, 2)))
        after = factor * np.sqrt(((Yi - Yk) ** 2).sum((1, 2)))
        gap = np.minimum(before, w["sigma_cont_ref"]) + np.minimum(after, w["sigma_cont"])
        cont = float((e["pair_weight"] * gap).sum())
        turn = np.abs(1 - (s["n"][i] * s["n"][k]).sum(1))
        orient = float((e["pair_count"] * np.minimum(turn, w["sigma_orient"])).sum())
    terms = {
        "arap": w["arap"] * arap,
        "proj": w["proj"] * proj,
        "cont": w["cont"] * cont,
        "orient": w["orient"] * orient,
    }
    return {"total": sum(terms.values()), **terms}


def _constraints(s: State, tree: Mapping[str, Any], claims: Mapping[str, float]) -> list[Row]:
    n = len(s["lam"])
    gram = np.einsum("nji,njk->nik", s["R"], s["R"]) - np.eye(3)
    facing = -(s["n"][:, None] * require(tree, "energy/rim_ray")).sum(-1)
    low = float(np.asarray(require(tree, "weights/min_facing")))
    # Ipopt keeps inequalities to its own constraint tolerance
    limits = {**LIMITS, "visible": 1e-6}
    each = {
        "so3": np.abs(gram).reshape(n, -1).max(1),
        "normal": np.abs((s["n"] ** 2).sum(1) - 1),
        "positive": np.maximum(0.0, -np.minimum(s["lam"], s["d"])),
        "det": np.abs(np.linalg.det(s["R"]) - 1),
        "visible": np.maximum(0.0, (low - facing).max(1)),
    }
    rows = []
    for name, value in each.items():
        found, claimed = float(value.max()), float(claims[name])
        same = abs(found - claimed) <= 1e-12 + 1e-3 * abs(found)
        ok = found <= limits[name] and same
        rows.append(
            Row(f"constraint {name}", claimed, found, limits[name], ok, int(value.argmax()))
        )
    total = float(abs(s["lam"].sum() - 1))
    claimed = float(claims["simplex"])
    rows.append(Row("constraint simplex", claimed, total, LIMITS["simplex"], total <= 1e-10))
    return rows


def _depth(tree: Mapping[str, Any]) -> list[Row]:
    """The stored depth map is the one of the stored planes."""
    s, labels = _state(tree, "solution"), require(tree, "segmentation/labels")
    K, depth = require(tree, "input/K_ref"), require(tree, "depth/ref")
    v, u = np.mgrid[0 : labels.shape[0], 0 : labels.shape[1]]
    ray = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T
    with np.errstate(divide="ignore", invalid="ignore"):
        z = (s["lam"] * s["d"])[labels] / -(s["n"][labels] * ray).sum(-1)
    known = np.isfinite(depth)
    off = float(np.abs(z[known] / depth[known] - 1).max(initial=0.0))
    return [Row("depth map", 0.0, off, 1e-9, off <= 1e-9)]


def _metrics(tree: Mapping[str, Any], claims: Mapping[str, Any]) -> list[Row]:
    rows = []
    truth = tree.get("truth", {})
    for name, key in (("solution", "ref"), ("start", "start_ref")):
        if name not in claims:
            continue
        claim, depth = claims[name], require(tree, f"depth/{key}")
        if "depth_ref" in truth:
            estimate, gt = depth, truth["depth_ref"]
        else:
            estimate, gt = sample_at_points(depth, truth["points"])
        found = depth_metrics(estimate, gt, scale=claim["scale_rule"], cap=claim["cap"]).mre
        claimed = float(claim["mre"])
        ok = abs(found - claimed) <= 1e-9 * max(1.0, found)
        rows.append(Row(f"mre {name}", claimed, found, 1e-9, ok))
    return rows
