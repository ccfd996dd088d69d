"""Check of a result folder: a table of claims, how each is recomputed, and its tolerance.

Energy, constraints, depth and scores are recomputed from the arrays by `evaluate.recompute`, which
shares no code with the solver. Every file is compared with the SHA-256 of it when it was written.
"""

from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from soup_nlp.arrays import Float, Int
from soup_nlp.errors import DataError
from soup_nlp.evaluation import recompute
from soup_nlp.evaluation.confidence import KINDS
from soup_nlp.evaluation.scoring import DEPTHS, SURE
from soup_nlp.geometry.constraints import constraints
from soup_nlp.report.layout import Stored
from soup_nlp.storage.files import is_file
from soup_nlp.storage.folders import SUMS, digest_of, read_sums
from soup_nlp.storage.store import require

RELATIVE, ABSOLUTE = 1e-9, 1e-12
"""Rounding of a recomputed number: relative to it or to its sum, and absolute."""
ROUNDINGS = 16
"""Error of a pixel coordinate after projection into both frames, in units of machine precision."""
LOST = 1e-4
"""Share of the pixels that may lie on either side of a horizon."""
OF_ROWS = ("so3", "normal", "simplex")
"""Kinds of constraint that are rows of the NLP as they are."""
RECOMPUTED, WRITTEN = "recomputed", "as written"
MISFITS = (LookupError, ValueError, TypeError, AttributeError, ArithmeticError, MemoryError)
"""Errors of claims and arrays that are missing or do not fit together."""
LEFT = (
    "dual infeasibility and complementarity, which need the model's derivatives",
    "whether images, flow, labels, truth, data of the energy, multipliers and E_photo are right",
)
"""Contents of a result that are compared as written only."""


@dataclass(frozen=True)
class Claim:
    """One claim of a result folder.

    `claimed` and `found`, the recomputed value, differ by `tolerance` at most, and `found` is at
    most `most`, the limit of a constraint. Of an agreement they are 1, or 0 where it fails. `how`
    is RECOMPUTED or WRITTEN.
    """

    name: str
    claimed: float
    found: float
    tolerance: float = 0.0
    most: float = np.inf
    note: str = ""
    how: str = RECOMPUTED

    @property
    def ok(self) -> bool:
        """Whether the claim holds; two numbers that are not finite agree."""
        both = np.isnan(self.claimed) and np.isnan(self.found)
        near = both or abs(self.claimed - self.found) <= self.tolerance
        return bool(near and not self.found > self.most)

    def __str__(self) -> str:
        return (
            f"{'ok  ' if self.ok else 'FAIL'} {self.name:<34} {self.claimed:>13.6g}"
            f" {self.found:>13.6g} {self.tolerance:>9.1e}  {self.how}{'  ' * bool(self.note)}"
            f"{self.note}"
        )


@dataclass(frozen=True)
class CheckReport:
    """Claims that were checked."""

    rows: tuple[Claim, ...]

    @property
    def ok(self) -> bool:
        """Whether every claim holds."""
        return all(r.ok for r in self.rows)

    def __str__(self) -> str:
        head = f"     {'claim':<34} {'claimed':>13} {'found':>13} {'tolerance':>9}  how"
        written = sum(r.how == WRITTEN for r in self.rows)
        lines = [f"     {len(self.rows) - written} claims are recomputed from the arrays"]
        if written:
            lines.append(f"     {written} are compared with their SHA-256 in {SUMS}")
        return "\n".join([head, *map(str, self.rows), *lines, *(f"     left: {x}" for x in LEFT)])


def check_folder(folder: str | Path) -> CheckReport:
    """Recompute energy, constraints, depth and scores of a result, and compare everything else.

    A file, a claim or an array that is missing or malformed is a DataError.
    """
    stored = Stored.read(folder)
    try:
        checks = (_energies, _constraints, _depths, _scores)
        found = [claim for check in checks for claim in check(stored)]
        return CheckReport((*found, *written(stored.folder, {"summary.json", "result.h5"})))
    except MISFITS as error:
        lacks = isinstance(error, KeyError)
        what = "lacks a claim or an array" if lacks else "has claims and arrays that do not fit"
        raise DataError(f"result {what}", where=stored.folder, found=error) from error


def _number(value: Any) -> float:
    """A claim as a number; null in JSON stands for one that is not finite."""
    return float("nan") if value is None else float(value)


def _energies(r: Stored) -> Iterator[Claim]:
    """Exact E by term of start, NLP and solution, from planes, motions and pixels."""
    e, weights = r.tree["energy"], {k: float(v) for k, v in r.tree["weights"].items()}
    # E sums differences of numbers as large as pixel coordinates and focal lengths
    used = np.abs(e["pixel_target"][e["pixel_weight"] > 0])
    size = max(float(used.max(initial=1.0)), float(np.abs(e["K_next"]).max()))
    slack = ROUNDINGS * float(np.finfo(float).eps) * len(e["anchor_ray"]) * size
    for which in ("start", "nlp", "solution"):
        found, claimed = recompute.energy(r.soup(which), e, weights), r.claims["energy"][which]
        factor = max(1.0, *(weights[term] for term in found if term != "total"))
        tolerance = RELATIVE * abs(found["total"]) + slack * factor
        for term, value in found.items():
            yield Claim(f"energy {which} {term}", _number(claimed[term]), value, tolerance)


def _constraints(r: Stored) -> Iterator[Claim]:
    """Largest violation of every kind, of the solution, the NLP's soup and Ipopt's answer."""
    rim, facing = require(r.tree, "energy/rim_ray"), float(r.tree["weights"]["min_facing"])
    claimed, within = {"solution": r.claims["residuals"]}, 0.0
    if r.claims["status"] != "Skipped":
        claimed |= {which: r.claims[f"{which}_residuals"] for which in ("nlp", "answer")}
        within = float(r.claims["residuals"]["nlp_infeasibility"]) * (1 + 1e-6) + ABSOLUTE
    for which, claims in claimed.items():
        found = list(constraints(r.soup(which), rim, facing).values())
        if which == "answer":
            # its limit is the claimed violation, for what Ipopt's rows say of it
            found = [replace(k, limit=within) for k in found if k.name in OF_ROWS]
        for k in found:
            value, claim = k.largest, _number(claims[k.name])
            yield Claim(f"{which} {k.name}", claim, value, 1e-3 * value + ABSOLUTE, k.limit, k.note)
    if r.claims["delivered"] == "constrained NLP":
        a, b = r.soup("answer"), r.soup("nlp")
        # the gauge decides the unit of length and how a distance is split into lam and d
        ratio = (a["lam"] * a["d"]) / (b["lam"] * b["d"])
        gaps = [np.abs(a[k] - b[k]).max() for k in ("n", "R")]
        gap = float(max(*gaps, np.abs(ratio / ratio.mean() - 1).max()))
        yield Claim("nlp is Ipopt's answer", 0.0, gap, 10 * within + RELATIVE)


def _depths(r: Stored) -> Iterator[Claim]:
    """Largest relative difference of the depth maps of the reference frame from the planes, that of
    the solution with its detail."""
    labels, K = require(r.tree, "segmentation/labels"), require(r.tree, "input/K_ref")
    for which in ("solution", "nlp", "start"):
        if DEPTHS[which] not in r.tree["depth"]:
            continue
        depth = require(r.tree, f"depth/{DEPTHS[which]}")
        z = recompute.depth_map(r.soup(which), labels, K)
        if which == "solution" and "detail" in r.tree["depth"]:
            z = z * np.exp(_beside(r.tree, r.soup(which), labels))
        both = np.isfinite(depth) & np.isfinite(z)
        off, note = float(np.abs(z[both] / depth[both] - 1).max(initial=0.0)), ""
        lost = float((np.isfinite(depth) != np.isfinite(z)).mean())
        if lost > LOST:
            off, note = 1.0, f"{lost:.1%} of the pixels are known in one only"
        yield Claim(f"depth map {which}", 0.0, off, RELATIVE, note=note)


def _beside(tree: Mapping[str, Any], soup: recompute.State, labels: Int) -> Float:
    """(H, W) log depth relative to the planes: by the flow, and of what is drawn."""
    out = np.zeros(labels.shape)
    if not tree["start"]["at_rest"]:
        used = (tree["start"]["bends"] == 0) & tree["energy"]["pixel_weight"].any(axis=1)
        out = recompute.detail(soup, labels, tree["input"], used)
    # earlier results have none
    if "shrinkage" in tree["depth"]:
        drawn = tree["confidence"]["kind"] == KINDS.index("drawn")
        parts = tree["energy"], tree["segmentation"], labels, tree["confidence"]["own_sigma"]
        out = out + recompute.shrinkage(soup, *parts, drawn)
    if "ground" in tree["depth"]:
        measured = tree["confidence"]["kind"] == KINDS.index("measured")
        given = tree["input"]["K_ref"], tree["depth"]["ground"], tree["depth"]["sigma_ref"]
        out = np.where(measured, out, recompute.ground(soup, labels, *given, out))
    return out


def _scores(r: Stored) -> Iterator[Claim]:
    """Errors of the stored depth maps against the stored truth, after the claimed scale rule."""
    constant = np.nan
    # the skill of the others needs the score of the constant depth
    for name in sorted(r.claims["metrics"], key=lambda k: k != "constant"):
        claim = r.claims["metrics"][name]
        scores = recompute.scores(*_compared(r.tree, name), claim["scale_rule"], claim["cap"])
        found = {"mre": np.nan, **scores}
        constant = found["mre"] if name == "constant" else constant
        if "skill" in claim and constant > 0:
            found["skill"] = 1 - found["mre"] / constant
        slack = {k: RELATIVE * abs(v) + ABSOLUTE for k, v in found.items()}
        first, *rows = [Claim(k, _number(claim[k]), v, slack[k]) for k, v in found.items()]
        yield replace(first, name=f"mre {name}")
        note = ", ".join(f"{c.name} is {c.found:.6g}" for c in rows if not c.ok)
        right = float(sum(c.ok for c in rows))
        yield Claim(f"other scores {name}", float(len(rows)), right, note=note)


def _compared(tree: Mapping[str, Any], name: str) -> tuple[Float, Float]:
    """Estimate and truth of a row of scores."""
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


def written(folder: Path, needed: Set[str]) -> Iterator[Claim]:
    """Every file of a folder's list, which must have the needed ones, by its SHA-256."""
    sums = read_sums(folder)
    files = sums.files if sums else {}
    if not needed <= files.keys():
        note = f"no SHA-256 of this result: {SUMS} is missing or damaged"
        yield Claim("files as written", 1.0, 0.0, note=note, how=WRITTEN)
    for name, digest in sorted(files.items()):
        note = "missing"
        if is_file(folder / name):
            note = "" if digest_of(folder / name) == digest else "changed"
        yield Claim(f"{name} as written", 1.0, float(not note), note=note, how=WRITTEN)
