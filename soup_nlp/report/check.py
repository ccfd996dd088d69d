"""Claims of a result folder, each recomputed from its arrays with code of its own."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from soup_nlp.errors import DataError
from soup_nlp.evaluate import recompute
from soup_nlp.storage.store import read_attrs, read_h5, require

LIMITS = {
    "so3": 1e-8,
    "normal": 1e-8,
    "simplex": 1e-10,
    "positive": 0.0,
    "det": 1e-8,
    # Ipopt keeps inequalities to its own tolerance
    "visible": 1e-6,
}
"""Largest violation that a delivered soup may have."""

GOOD = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
DEPTHS = {"solution": "ref", "nlp": "nlp_ref", "start": "start_ref", "rigid": "rigid_ref"}
RELATIVE = 1e-9
ABSOLUTE = 1e-12
ROUNDINGS = 16
"""Of machine precision, that a pixel coordinate may be off after its way through both frames."""
NOT_CHECKED = "dual infeasibility and complementarity need the model's derivatives: not rechecked"


@dataclass(frozen=True)
class Row:
    """One claim.

    Attributes:
        name: What is claimed.
        claimed: Value in summary.json.
        found: Value recomputed from the arrays.
        limit: Largest allowed found value (constraints) or difference (numbers, relative).
        ok: Whether the claim holds.
        worst: Superpixel with the largest residual, -1 where there is none.
        note: More about it.
    """

    name: str
    claimed: float
    found: float
    limit: float
    ok: bool
    worst: int = -1
    note: str = ""

    def __str__(self) -> str:
        where = f"  superpixel {self.worst}" if self.worst >= 0 else ""
        return (
            f"{'ok  ' if self.ok else 'FAIL'} {self.name:<28} {self.claimed:>13.6g}"
            f" {self.found:>13.6g} {self.limit:>9.1e}{where}{'  ' if self.note else ''}{self.note}"
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
        head = f"     {'claim':<28} {'claimed':>13} {'recomputed':>13} {'limit':>9}"
        return "\n".join([head, *map(str, self.rows), f"     {NOT_CHECKED}"])


def check_folder(folder: str | Path) -> CheckReport:
    """Recompute energy, constraints, depth and metrics of a result folder.

    Args:
        folder: Result folder.

    Raises:
        DataError: a file, a claim or an array is missing or not what it should be.
    """
    folder = Path(folder)
    claims = _claims(folder)
    path = folder / "result.h5"
    tree, attrs = read_h5(path), read_attrs(path)
    try:
        return CheckReport(tuple(_rows(folder, claims, tree, attrs)))
    except KeyError as error:
        raise DataError("result lacks a claim or an array", where=folder, found=error) from error
    except (ValueError, IndexError, TypeError, AttributeError, np.linalg.LinAlgError) as error:
        raise DataError(
            "claims and arrays of a result do not fit together", where=folder, found=error
        ) from error


def _claims(folder: Path) -> dict[str, Any]:
    try:
        claims = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(
            "summary.json cannot be read", where=folder, found=error, hint="run solve first"
        ) from error
    if not isinstance(claims, dict):
        raise DataError("summary.json holds no claims", where=folder, found=type(claims).__name__)
    return claims


def _rows(
    folder: Path, claims: Mapping[str, Any], tree: Mapping[str, Any], attrs: Mapping[str, Any]
) -> Iterator[Row]:
    config = (folder / "config.yaml").read_text(encoding="utf-8")
    yield from _labels(claims, attrs, config)
    settings = yaml.safe_load(str(attrs["config"]))
    weights = {k: float(v) for k, v in tree["weights"].items()}
    own = settings["energy"]["weights"]
    if settings["energy"]["units"] == "pixel" and bool(tree["start"].get("bending", False)):
        own = dict(settings["energy"]["bending"]["weights"])
        # there it is that of 1,000 superpixels
        own["orient"] *= len(tree["start"]["component"]) / 1000
    for key in ("arap", "proj", "cont", "orient"):
        yield _same(f"weight {key}", own[key], weights[key])
    for name, gap in recompute.data_errors(tree, settings).items():
        yield Row(f"data {name}", 0.0, gap, RELATIVE, gap <= RELATIVE)
    slack = _rounding(tree, weights)
    for which in ("start", "nlp", "solution"):
        found = recompute.energy(_state(tree, which), tree["energy"], weights)
        for term, value in found.items():
            # a term that cancels to nothing is rounding of the sum it belongs to
            claimed = claims["energy"][which][term]
            yield _same(f"energy {which} {term}", claimed, value, of=found["total"], absolute=slack)
    if claims["converged"]:
        before, after = (float(claims["energy"][k]["total"]) for k in ("start", "solution"))
        ok = after <= before * (1 + RELATIVE) + slack
        yield Row("energy falls", before, after, before, ok)
    yield from _rounds(claims, slack)
    yield from _constraints(claims, tree, weights)
    yield from _depth(tree)
    yield _next_depth(tree)
    yield from _metrics(tree, claims["metrics"])


def _rounding(tree: Mapping[str, Any], weights: Mapping[str, float]) -> float:
    """What rounding may leave of an energy that should be zero.

    E sums one number per superpixel, each a difference of numbers that grow with pixel coordinates
    and focal lengths: it is known to machine precision of these, not of itself.
    """
    e = tree["energy"]
    used = np.abs(e["pixel_target"][e["pixel_weight"] > 0])
    size = max(float(used.max(initial=1.0)), float(np.abs(e["K_next"]).max()))
    factor = max(1.0, *(float(weights[term]) for term in ("arap", "proj", "cont", "orient")))
    return ROUNDINGS * float(np.finfo(float).eps) * len(e["anchor_ray"]) * size * factor


def _rounds(claims: Mapping[str, Any], slack: float) -> Iterator[Row]:
    """E never rises from round to round, and no round claims less than its lower bound."""
    refinement = claims.get("refinement")
    if not refinement or not refinement["rounds"]:
        return
    rounds = refinement["rounds"]
    path = [refinement["begin"], *(r["energy"] for r in rounds), claims["energy"]["solution"]]
    totals = np.array([float(e["total"]) for e in path])
    rise = float(np.diff(totals).max())
    within = RELATIVE * abs(totals[0]) + slack
    yield Row("no round raises E", 0.0, rise, 0.0, rise <= within)
    under = max(float(r["bound"]) - float(r["mrf_energy"]) for r in rounds)
    yield Row("no choice below its bound", 0.0, under, 0.0, under <= within)
    if not refinement["polish_gain"]:
        yield _same("last round is delivered", totals[-2], totals[-1], absolute=slack)


def _number(value: Any) -> float:
    """A claim as a number; JSON has null for what is not finite."""
    return float("nan") if value is None else float(value)


def _same(
    name: str, claimed: Any, found: float, of: float = 0.0, absolute: float = ABSOLUTE
) -> Row:
    """A claim that must equal what was found, to rounding of it, of the sum `of`, or `absolute`."""
    value = _number(claimed)
    gap = abs(value - found)
    ok = gap <= RELATIVE * max(abs(found), abs(of)) + absolute or (
        np.isnan(value) and np.isnan(found)
    )
    return Row(name, value, found, RELATIVE, bool(ok))


def _labels(claims: Mapping[str, Any], attrs: Mapping[str, Any], config: str) -> Iterator[Row]:
    """What the three files say in words must agree; 1 is agreement."""
    pairs = {
        "status": claims["status"] == attrs["status"],
        "converged": bool(claims["converged"]) == (attrs["status"] in GOOD),
        "delivered": claims["delivered"] == attrs["delivered"],
        "problem hash": claims["problem_hash"] == attrs["problem_hash"],
        "seed": claims["seed"] == attrs["seed"],
        "config.yaml": config == attrs["config"],
    }
    for name, ok in pairs.items():
        yield Row(f"{name} as in result.h5", 1.0, float(ok), 0.0, ok)


def _state(tree: Mapping[str, Any], which: str) -> dict[str, recompute.Float]:
    """The arrays of a soup.

    Raises:
        DataError: one is missing or has the wrong shape.
    """
    n = len(require(tree, f"{which}/lam"))
    shapes = {"lam": (n,), "n": (n, 3), "d": (n,), "R": (n, 3, 3), "t": (n, 3)}
    out = {}
    for key, shape in shapes.items():
        out[key] = np.asarray(require(tree, f"{which}/{key}"), float)
        if out[key].shape != shape:
            raise DataError(
                "array of a soup has the wrong shape",
                where=f"{which}/{key}",
                found=out[key].shape,
                expected=shape,
            )
    return out


def _constraints(
    claims: Mapping[str, Any], tree: Mapping[str, Any], weights: Mapping[str, float]
) -> Iterator[Row]:
    if claims["status"] == "Skipped":
        yield from _satisfied(claims, tree, weights, "solution", "residuals", LIMITS)
        return
    # Ipopt's answer may violate its constraints by as much as it says, the delivered soup by less
    own = float(claims["residuals"]["nlp_infeasibility"])
    within = own * (1 + 1e-6) + ABSOLUTE
    for which, key, limits in (
        ("solution", "residuals", LIMITS),
        ("nlp", "nlp_residuals", LIMITS),
        ("answer", "answer_residuals", dict.fromkeys(("so3", "normal", "simplex"), within)),
    ):
        yield from _satisfied(claims, tree, weights, which, key, limits)
    if claims["delivered"] == "constrained NLP":
        a, b = _state(tree, "answer"), _state(tree, "nlp")
        gap = max(float(np.abs(a[k] - b[k]).max()) for k in ("n", "R"))
        gap = max(gap, float(np.abs(a["lam"] / b["lam"] - 1).max()))
        limit = 10 * within + RELATIVE
        yield Row("nlp is Ipopt's answer", 0.0, gap, limit, gap <= limit)


def _satisfied(
    claims: Mapping[str, Any],
    tree: Mapping[str, Any],
    weights: Mapping[str, float],
    which: str,
    key: str,
    limits: Mapping[str, float],
) -> Iterator[Row]:
    """Constraints of one soup, and what is claimed of them."""
    rim = require(tree, "energy/rim_ray")
    found = recompute.constraints(_state(tree, which), rim, weights["min_facing"])
    for name, limit in limits.items():
        value, claimed = float(found[name].max()), _number(claims[key][name])
        ok = value <= limit and abs(value - claimed) <= 1e-3 * value + ABSOLUTE
        worst = int(found[name].argmax()) if name != "simplex" and value > 0 else -1
        yield Row(f"{which} {name}", claimed, value, limit, bool(ok), worst)


def _depth(tree: Mapping[str, Any]) -> Iterator[Row]:
    """The stored depth maps are those of the stored planes."""
    labels, K = require(tree, "segmentation/labels"), require(tree, "input/K_ref")
    for which, key in (("solution", "ref"), ("nlp", "nlp_ref"), ("start", "start_ref")):
        if key not in tree["depth"]:
            continue
        depth = require(tree, f"depth/{key}")
        z = recompute.depth_map(_state(tree, which), labels, K)
        known = np.isfinite(depth) & np.isfinite(z)
        # a pixel exactly at the horizon may fall on either side
        lost = float((np.isfinite(depth) != np.isfinite(z)).mean())
        off = float(np.abs(z[known] / depth[known] - 1).max(initial=0.0))
        ok = off <= RELATIVE and lost <= 1e-4
        note = "" if lost <= 1e-4 else f"{lost:.1%} of the pixels are known in one only"
        yield Row(f"depth map {which}", 0.0, off, RELATIVE, ok, note=note)


def _next_depth(tree: Mapping[str, Any]) -> Row:
    """The stored depth of the next frame is where the stored planes and motions bring the first."""
    depth = require(tree, "depth/next")
    K_ref, K_next = require(tree, "input/K_ref"), require(tree, "input/K_next")
    labels = require(tree, "segmentation/labels")
    z, doubt = recompute.next_depth_map(
        _state(tree, "solution"), labels, K_ref, K_next, (depth.shape[0], depth.shape[1])
    )
    sure = ~doubt
    known = sure & np.isfinite(depth) & np.isfinite(z)
    lost = float((np.isfinite(depth) != np.isfinite(z))[sure].mean()) if sure.any() else 0.0
    off = float(np.abs(z[known] / depth[known] - 1).max(initial=0.0))
    notes = {
        f"{lost:.1%} of the pixels are known in one only": lost > 1e-4,
        f"{doubt.mean():.1%} of the pixels hang on a rounding, not compared": doubt.mean() > 1e-3,
    }
    note = "; ".join(text for text, on in notes.items() if on)
    return Row("depth map next", 0.0, off, RELATIVE, off <= RELATIVE and lost <= 1e-4, note=note)


def _metrics(tree: Mapping[str, Any], claims: Mapping[str, Any]) -> Iterator[Row]:
    truth = tree.get("truth", {})
    constant = float("nan")
    for name in ("constant", *(k for k in claims if k != "constant")):
        if name not in claims:
            continue
        claim = claims[name]
        z, gt = _compared(tree, truth, name)
        found = recompute.scores(z, gt, claim["scale_rule"], claim["cap"])
        if name == "constant":
            constant = found.get("mre", constant)
        if "skill" in claim and constant > 0:
            found["skill"] = 1 - found.get("mre", np.nan) / constant
        yield _same(f"mre {name}", claim["mre"], found.get("mre", np.nan))
        others = [_same(key, claim[key], value) for key, value in found.items() if key != "mre"]
        bad = [row for row in others if not row.ok]
        note = ", ".join(f"{r.name} is {r.found:.6g}, not {r.claimed:.6g}" for r in bad)
        count = float(len(others))
        yield Row(f"other scores {name}", count, count - len(bad), 0.0, not bad, note=note)


def _compared(
    tree: Mapping[str, Any], truth: Mapping[str, Any], name: str
) -> tuple[recompute.Float, recompute.Float]:
    """Estimate and truth that a row of metrics is about."""
    if name == "solution_next":
        return require(tree, "depth/next"), require(tree, "truth/depth_next")
    if name == "constant":
        z = np.ones_like(require(tree, "depth/ref"))
    else:
        z = require(tree, f"depth/{DEPTHS[name]}")
    if "depth_ref" in truth:
        return z, truth["depth_ref"]
    estimate, gt = recompute.at_points(z, require(tree, "truth/points"))
    return (np.ones_like(gt), gt) if name == "constant" else (estimate, gt)
