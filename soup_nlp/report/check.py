"""Check of a result folder: its claims are recomputed from its arrays by independent code."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from soup_nlp.arrays import Image, Mask
from soup_nlp.errors import DataError, printable, repr_of
from soup_nlp.evaluate import recompute, recompute_data, recompute_files
from soup_nlp.evaluate.scoring import DEPTHS, SURE
from soup_nlp.report.check_arrays import require_layout
from soup_nlp.report.check_files import file_claims
from soup_nlp.report.claim import ABSOLUTE, HASHED, RECOMPUTED, RELATIVE, Claim, number, same
from soup_nlp.solve.ipopt import GOOD
from soup_nlp.solve.kkt import LIMITS
from soup_nlp.storage.files import as_path, parse_yaml, read_json, read_text
from soup_nlp.storage.folders import recover
from soup_nlp.storage.h5_files import DIGEST, read_attrs, read_digest, read_h5
from soup_nlp.storage.store import require

Entries: TypeAlias = Mapping[str, Any]
Images: TypeAlias = tuple[Image, Image]
TERMS = ("arap", "proj", "cont", "orient", "prior")
ROUNDINGS = 16
"""Error of a pixel coordinate after projection into both frames, in units of machine precision."""
LEFT = (
    "dual infeasibility and complementarity, which need the model's derivatives",
    "images, flow, labels, truth, multipliers, times, logs, colours (as written only)",
)
"""Contents of a result that the check does not recompute."""


@dataclass(frozen=True)
class CheckReport:
    """Claims that were checked, and descriptions of what was not."""

    rows: tuple[Claim, ...]
    left: tuple[str, ...] = LEFT

    @property
    def ok(self) -> bool:
        """Whether every claim holds."""
        return all(r.ok for r in self.rows)

    def __str__(self) -> str:
        head = f"     {'claim':<34} {'claimed':>13} {'found':>13} {'limit':>9}  how"
        counts = {how: sum(r.how == how for r in self.rows) for how in (RECOMPUTED, HASHED)}
        lines = [
            f"     {counts[RECOMPUTED]} claims are recomputed from the arrays",
            f"     {counts[HASHED]} are compared with the SHA-256 or the copy in result.h5",
            *(f"     left: {text}" for text in self.left),
        ]
        return "\n".join([head, *map(str, self.rows), *lines])


def check_folder(folder: str | Path, images: Images | None = None) -> CheckReport:
    """Recompute energy, constraints, depth, metrics and files of a result folder.

    Args:
        folder: Result folder.
        images: The two images, (H, W, 3) or (H, W) uint8; without them E_photo of the refinement
            is not recomputed.

    Raises:
        DataError: a file, a claim or an array is missing or malformed.
    """
    folder = as_path(folder, "result folder")
    if images is not None:
        _require_images(images)
    recover(folder)
    claims = read_json(folder / "summary.json", "summary.json")
    path = folder / "result.h5"
    tree, attrs = read_h5(path), read_attrs(path)
    config = read_text(folder / "config.yaml", "config.yaml")
    try:
        settings = parse_yaml(str(attrs["config"]))
        require_layout(tree)
        rows = tuple(_rows(folder, claims, tree, attrs, settings, config, images))
    except KeyError as error:
        raise DataError("result lacks a claim or an array", where=folder, found=error) from error
    except (ValueError, IndexError, TypeError, AttributeError, ArithmeticError) as error:
        raise DataError(
            "claims and arrays of a result do not fit together", where=folder, found=error
        ) from error
    except (np.linalg.LinAlgError, MemoryError) as error:
        raise DataError("arrays of a result cannot be used", where=folder, found=error) from error
    photo = "photo" in ((claims.get("refinement") or {}).get("end") or {})
    unseen = ("E_photo of the refinement: the images of config.yaml are not at hand",)
    return CheckReport(rows, LEFT + (unseen if photo and images is None else ()))


def _require_images(images: object) -> None:
    """Raise DataError unless these are two images."""
    two = images if isinstance(images, list | tuple) and len(images) == 2 else (None,)
    if any(getattr(image, "dtype", None) != np.uint8 for image in two):
        raise DataError(
            "images are of another kind",
            found=printable(repr_of(images), 60),
            expected="two arrays (H, W, 3) or (H, W), uint8",
        )


def _rows(
    folder: Path,
    claims: Entries,
    tree: Entries,
    attrs: Entries,
    settings: Entries,
    config: str,
    images: Images | None,
) -> Iterator[Claim]:
    yield from _labels(claims, attrs, config)
    weights = {k: float(v) for k, v in tree["weights"].items()}
    yield from _weights(tree, settings["energy"], weights)
    for name, gap in recompute_data.data_errors(tree, settings).items():
        yield Claim(f"data {name}", 0.0, gap, RELATIVE, gap <= RELATIVE)
    slack = _rounding(tree, weights)
    for which in ("start", "nlp", "solution"):
        found = recompute.energy(_state(tree, which), tree["energy"], weights)
        for term, value in found.items():
            # a term may be the rounding error of the sum that it belongs to
            claimed = claims["energy"][which][term]
            yield same(f"energy {which} {term}", claimed, value, of=found["total"], absolute=slack)
    if claims["converged"]:
        before, after = (float(claims["energy"][k]["total"]) for k in ("start", "nlp"))
        ok = after <= before * (1 + RELATIVE) + slack
        yield Claim("energy falls", before, after, before, ok)
    yield from _rounds(claims, slack)
    yield from _refined(claims, tree, settings, weights, slack, images)
    yield from _constraints(claims, tree, weights)
    yield from _depths(tree)
    yield from _metrics(tree, claims["metrics"])
    yield from file_claims(folder, claims, tree)
    # results of earlier versions have none
    if DIGEST in attrs:
        good = attrs[DIGEST] == read_digest(folder / "result.h5")
        yield Claim("contents of result.h5 as written", 1.0, float(good), 0.0, good, how=HASHED)


def _weights(tree: Entries, form: Entries, weights: Mapping[str, float]) -> Iterator[Claim]:
    """Claims that the stored weights are those of the problem."""
    own = form["weights"]
    if recompute_data.bends_where(tree, form).all():
        own = dict(form["bending"]["weights"])
        # given for 1,000 superpixels
        own["orient"] *= len(tree["start"]["component"]) / 1000
    for key in TERMS:
        yield same(f"weight {key}", own[key], weights[key])


def _rounding(tree: Entries, weights: Mapping[str, float]) -> float:
    """Absolute rounding error of an energy.

    E sums differences of numbers as large as pixel coordinates and focal lengths, so its error is
    their machine precision times the number of superpixels.
    """
    e = tree["energy"]
    used = np.abs(e["pixel_target"][e["pixel_weight"] > 0])
    size = max(float(used.max(initial=1.0)), float(np.abs(e["K_next"]).max()))
    factor = max(1.0, *(float(weights[term]) for term in TERMS))
    return ROUNDINGS * float(np.finfo(float).eps) * len(e["anchor_ray"]) * size * factor


def _rounds(claims: Entries, slack: float) -> Iterator[Claim]:
    """Claims that E does not increase between rounds and is not below its lower bounds."""
    refinement = claims.get("refinement")
    if not refinement or not refinement["rounds"]:
        return
    rounds = refinement["rounds"]
    path = [refinement["begin"], *(r["energy"] for r in rounds), refinement["end"]]
    totals = np.array([float(e["total"]) for e in path])
    rise = float(np.diff(totals).max())
    within = RELATIVE * abs(totals[0]) + slack
    yield Claim("no round raises E", 0.0, rise, 0.0, rise <= within)
    under = max(float(r["bound"]) - float(r["mrf_energy"]) for r in rounds)
    yield Claim("no choice below its bound", 0.0, under, 0.0, under <= within)
    if not refinement["polish_gain"]:
        yield same("last round is delivered", totals[-2], totals[-1], absolute=slack)


def _refined(
    claims: Entries,
    tree: Entries,
    settings: Entries,
    weights: Mapping[str, float],
    slack: float,
    images: Images | None,
) -> Iterator[Claim]:
    """Claims about the first and last objective of the refinement; E_photo needs the images."""
    refinement = claims.get("refinement")
    if not refinement:
        return
    own = dict(weights)
    if "photo" in refinement["end"]:
        own["proj"] *= float(settings["refine"]["photo_proj"])
        sigma = float(settings["refine"]["photo_sigma_proj"])
        own["sigma_proj"] = min(own["sigma_proj"], sigma)
    for word, which, key in (("unrefined", "nlp", "begin"), ("refined", "solution", "end")):
        claimed, state = refinement[key], _state(tree, which)
        found = recompute.energy(state, tree["energy"], own)
        found["total"] += number(claimed.get("photo", 0.0))
        for term, value in found.items():
            of = found["total"]
            yield same(f"{word} {term}", claimed[term], value, of=of, absolute=slack)
        if "photo" in claimed and images is not None:
            factor = float(settings["refine"]["photo"])
            seen = recompute_files.photo(state, tree, factor, *images)
            value = number(claimed["photo"])
            ok = abs(value - seen.energy) <= seen.within
            yield Claim(f"{word} photo", value, seen.energy, seen.within / seen.energy, ok)


def _labels(claims: Entries, attrs: Entries, config: str) -> Iterator[Claim]:
    """Claims that summary.json, config.yaml and result.h5 agree; 1 is agreement."""
    pairs = {
        "status": claims["status"] == attrs["status"],
        "converged": bool(claims["converged"]) == (attrs["status"] in GOOD),
        "delivered": claims["delivered"] == attrs["delivered"],
        "problem hash": claims["problem_hash"] == attrs["problem_hash"],
        "seed": claims["seed"] == attrs["seed"],
        "config.yaml": config == attrs["config"],
    }
    for name, ok in pairs.items():
        yield Claim(f"{name} as in result.h5", 1.0, float(ok), 0.0, ok)


def _state(tree: Entries, which: str) -> dict[str, recompute.Float]:
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


def _constraints(claims: Entries, tree: Entries, weights: Mapping[str, float]) -> Iterator[Claim]:
    rim, facing = require(tree, "energy/rim_ray"), weights["min_facing"]

    def satisfied(which: str, key: str, limits: Mapping[str, float]) -> Iterator[Claim]:
        """Claims about the constraints of one soup."""
        found = recompute.constraints(_state(tree, which), rim, facing)
        for name, limit in limits.items():
            value, claimed = float(found[name].max()), number(claims[key][name])
            ok = value <= limit and abs(value - claimed) <= 1e-3 * value + ABSOLUTE
            worst = int(found[name].argmax()) if name != "simplex" and value > 0 else -1
            yield Claim(f"{which} {name}", claimed, value, limit, bool(ok), worst)

    yield from satisfied("solution", "residuals", LIMITS)
    if claims["status"] == "Skipped":
        return
    yield from satisfied("nlp", "nlp_residuals", LIMITS)
    # the limit of Ipopt's answer is the claimed violation
    within = float(claims["residuals"]["nlp_infeasibility"]) * (1 + 1e-6) + ABSOLUTE
    own = dict.fromkeys(("so3", "normal", "simplex"), within)
    yield from satisfied("answer", "answer_residuals", own)
    if claims["delivered"] == "constrained NLP":
        a, b = _state(tree, "answer"), _state(tree, "nlp")
        gap = max(float(np.abs(a[k] - b[k]).max()) for k in ("n", "R"))
        # the gauge decides the unit of length and how a distance is split into lam and d
        ratio = (a["lam"] * a["d"]) / (b["lam"] * b["d"])
        gap = max(gap, float(np.abs(ratio / ratio.mean() - 1).max()))
        limit = 10 * within + RELATIVE
        yield Claim("nlp is Ipopt's answer", 0.0, gap, limit, gap <= limit)


def _depths(tree: Entries) -> Iterator[Claim]:
    """Claims that the stored depth maps follow from the stored planes and motions."""
    labels = require(tree, "segmentation/labels")
    K_ref, K_next = require(tree, "input/K_ref"), require(tree, "input/K_next")
    for which in ("solution", "nlp", "start"):
        if DEPTHS[which] in tree["depth"]:
            depth = require(tree, f"depth/{DEPTHS[which]}")
            z = recompute.depth_map(_state(tree, which), labels, K_ref)
            yield _same_depth(which, depth, z, np.zeros(z.shape, bool))
    depth = require(tree, "depth/next")
    state = _state(tree, "solution")
    z, doubt = recompute.next_depth_map(state, labels, K_ref, K_next, depth.shape)
    yield _same_depth("next", depth, z, doubt)


def _same_depth(which: str, depth: recompute.Float, z: recompute.Float, doubt: Mask) -> Claim:
    """Claim that a stored depth map equals the recomputed one, except at the pixels `doubt`."""
    # a pixel exactly at the horizon may fall on either side
    one = (np.isfinite(depth) != np.isfinite(z)) & ~doubt
    both = np.isfinite(depth) & np.isfinite(z) & ~doubt
    lost = float(one.sum() / max((~doubt).sum(), 1))
    off = float(np.abs(z[both] / depth[both] - 1).max(initial=0.0))
    notes = []
    if lost > 1e-4:
        notes.append(f"{lost:.1%} of the pixels are known in one only")
    if doubt.mean() > 1e-3:
        notes.append(f"{doubt.mean():.1%} of the pixels are not compared: rounding decides")
    ok = off <= RELATIVE and lost <= 1e-4
    return Claim(f"depth map {which}", 0.0, off, RELATIVE, ok, note="; ".join(notes))


def _metrics(tree: Entries, claims: Entries) -> Iterator[Claim]:
    """Claims that the scores follow from the stored depth maps and the stored truth."""
    constant = float("nan")
    # the skill of the others needs the score of the constant depth
    for name in sorted(claims, key=lambda k: k != "constant"):
        claim = claims[name]
        found = recompute.scores(*_compared(tree, name), claim["scale_rule"], claim["cap"])
        if name == "constant":
            constant = found.get("mre", constant)
        if "skill" in claim and constant > 0:
            found["skill"] = 1 - found.get("mre", np.nan) / constant
        yield same(f"mre {name}", claim["mre"], found.get("mre", np.nan))
        others = [same(key, claim[key], value) for key, value in found.items() if key != "mre"]
        bad = [row for row in others if not row.ok]
        note = ", ".join(f"{r.name} is {r.found:.6g}, not {r.claimed:.6g}" for r in bad)
        count = float(len(others))
        yield Claim(f"other scores {name}", count, count - len(bad), 0.0, not bad, note=note)


def _compared(tree: Entries, name: str) -> tuple[recompute.Float, recompute.Float]:
    """Estimate and truth of a row of metrics."""
    if name == "solution_next":
        return require(tree, "depth/next"), require(tree, "truth/depth_next")
    sure = SURE.get(name)
    stored = "ref" if name == "constant" or sure else DEPTHS[name]
    z, unsure = require(tree, f"depth/{stored}"), require(tree, "depth/sigma_ref")
    if "depth_ref" in tree["truth"]:
        gt = require(tree, "truth/depth_ref")
    else:
        unsure, _ = recompute.at_points(unsure, require(tree, "truth/points"))
        z, gt = recompute.at_points(z, require(tree, "truth/points"))
    if sure:
        true = np.isfinite(gt) & (gt > 0) & np.isfinite(unsure)
        gt = np.where(unsure <= np.quantile(unsure[true], sure), gt, np.nan)
    return (np.ones_like(gt) if name == "constant" else z), gt
