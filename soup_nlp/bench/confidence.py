"""The analysis of confidence: sparsification against single cues, and calibration by family."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.bench.suite_pairs import Item
from soup_nlp.bench.tables import (
    code_versions,
    failures,
    figure,
    mean,
    page_text,
    provenance,
    save,
    show,
    table,
    titles,
)
from soup_nlp.errors import DataError
from soup_nlp.evaluate.confidence import (
    BENDING_FACTOR,
    FACTOR,
    LARGEST,
    SIGMA_PRIOR,
    calibrated,
    confidence,
    scale_by_contact,
    with_prior,
)
from soup_nlp.evaluate.information import Information, information, spread_in_image
from soup_nlp.evaluate.metrics import true_pixels
from soup_nlp.evaluate.scoring import at_truth
from soup_nlp.evaluate.sparsification import coverage, sparsification
from soup_nlp.pipeline.record import Run
from soup_nlp.pipeline.run import run
from soup_nlp.refine.costs import Particles
from soup_nlp.refine.photometric import photometric_term
from soup_nlp.storage.rows import Row

CUES = {
    "sigma": "sigma as delivered",
    "own": "the same information, but of each superpixel's own block alone",
    "residual": "re-projection error of the start",
    "misfit": "distance of the flow from the one that the solution induces",
    "flow": "1 - flow confidence",
    "parallax": "(1 - flow confidence) / parallax",
    "photo": "photometric disagreement of the solution (census)",
    "particles": "spread of the last particles by their min-marginals in TRW-S",
}
"""Descriptions of the uncertainties that are compared."""
SAMPLE_PIXELS = 400
"""Number of pixels of a pair that the calibration of other families uses."""
SHARE_WITHIN = 0.76
"""Share of the pixels whose error is within one sigma after calibration."""
MAX_ADDED = 0.05
"""Pixels of which more is added in squares are not used for the calibration."""
MIN_PARALLAX = 0.1
"""Smallest parallax that the cue "parallax" divides by, pixels."""


def measure_confidence(item: Item, overrides: tuple[str, ...] = (), variant: str = "") -> Row:
    """Sparsification of every cue and coverage of sigma on one pair.

    Raises:
        DataError: the pair has no true depth.
    """
    result = run(item.problem(overrides))
    truth = result.pair.truth
    if truth is None or (truth.depth_ref is None and truth.points is None):
        raise DataError("pair has no true depth", where=item.key)
    begin = time.process_time()
    assert result.pair.flow is not None
    energy = result.data, result.weights, result.problem.formulation
    rec = result.reconstruction
    confidence(rec, result.pair, result.start, *energy)
    seconds = time.process_time() - begin
    z, gt = at_truth(truth, rec.depth_ref)
    true = true_pixels(gt, None) & np.isfinite(z)
    scaled, gt = z[true] * float(np.median(gt[true] / z[true])), gt[true]

    def chosen(image: Float) -> Float:
        return at_truth(truth, image)[0][true]

    relative, log = np.abs(scaled - gt) / gt, np.abs(np.log(scaled / gt))
    cues = {name: chosen(image) for name, image in _cues(result).items()}
    found = {name: sparsification(relative, cue) for name, cue in cues.items()}
    sure = result.confidence
    misfit = sure.misfit[rec.labels]
    bends = result.start.bends[rec.labels]
    whole = calibrated(sure.spread, sure.noise, misfit, np.inf, bends)
    unit = chosen(whole / np.where(bends, BENDING_FACTOR, FACTOR))
    scale = chosen(scale_by_contact(sure.marginals, result.start)[rec.labels])
    # what is added in squares to the factor times the unit
    added = np.minimum(np.hypot(SIGMA_PRIOR * sure.still, scale), LARGEST)
    sample = log, unit, added, chosen(bends.astype(float))
    picked = np.linspace(0, len(log) - 1, min(SAMPLE_PIXELS, len(log))).astype(int)
    own = found["sigma"]
    return {
        "status": result.solution.status,
        "good": result.solved,
        "metrics": {},
        "confidence": {
            "mre": float(relative.mean()),
            **{name: result.metrics[name].mre for name in ("solution_90", "solution_70")},
            "ause": {name: one.ause for name, one in found.items()},
            "within": coverage(log, cues["sigma"]),
            "guess": sure.guessed,
            "noise": sure.noise,
            "seconds": seconds,
            "curve": [own.kept.tolist(), own.error.tolist(), own.oracle.tolist()],
            "sample": np.stack(sample)[:, picked].round(6).tolist(),
        },
    }


def _cues(result: Run) -> dict[str, Float]:
    """(H, W) uncertainties by the names of CUES."""
    labels, start, pair = result.segmentation.labels, result.start, result.pair
    assert pair.flow is not None
    doubt = 1.0 - pair.flow.confidence.astype(float)
    out = {
        "sigma": result.confidence.sigma,
        "own": _own_block(result),
        "residual": start.error[labels],
        "misfit": result.confidence.misfit[labels],
        "flow": doubt,
        "parallax": (0.02 + doubt) / np.maximum(start.parallax, MIN_PARALLAX)[labels],
    }
    if result.refined and result.refined.rounds:
        out["particles"] = result.refined.rounds[-1].spread[labels]
    photo = photometric_term(pair, labels, result.soup, result.problem.refine)
    if photo is not None:
        out["photo"] = photo.costs(Particles.of(result.soup), photo.unit(result.soup))[:, 0][labels]
    return out


def _own_block(result: Run) -> Float:
    """(H, W) conditional standard deviation of a superpixel while all others are fixed."""
    info: Information = information(
        result.soup, result.data, result.weights, result.problem.formulation
    )
    n = len(result.soup)
    at = np.arange(9 * n).reshape(n, 9)
    blocks = np.asarray(info.matrix[at.repeat(9), np.tile(at, 9).ravel()]).reshape(n, 9, 9)
    plane = np.linalg.pinv(blocks, rcond=1e-12, hermitian=True)[:, :3, :3]
    return spread_in_image(info, plane, result.segmentation.labels, result.pair.K_ref)


def left_out_factors(rows: Sequence[Row]) -> dict[str, tuple[tuple[float, ...], float, float]]:
    """Calibration factors of every family from all others, and the coverage of 1 and 2 sigma.

    Bending regions have a factor of their own, from bending regions of the others. A family is left
    out for whose regions the others have none.
    """
    samples = [(r["sequence"], np.array(r["confidence"]["sample"])) for r in rows]
    by_family: dict[str, list[tuple[float, float]]] = {}
    factors: dict[str, tuple[float, ...]] = {}
    for family, (log, unit, added, bends) in samples:
        others = [sample for name, sample in samples if name != family]
        kinds, which = np.unique(bends > 0.5, return_inverse=True)
        found = [_factor(others, bool(kind)) for kind in kinds]
        known = tuple(f for f in found if f is not None)
        if len(known) < len(found):
            continue
        factors[family], factor = known, np.array(known)[which]
        one, two = coverage(log, with_prior(np.hypot(factor * unit, added)))
        by_family.setdefault(family, []).append((one, two))
    return {
        name: (factors[name], *np.mean(several, axis=0).tolist())
        for name, several in by_family.items()
    }


def _factor(samples: Sequence[Float], bending: bool) -> float | None:
    """The factor with which SHARE_WITHIN of the pixels lie within one sigma; None without any."""
    alike = []
    for log, unit, added, bends in samples:
        # sigma of mostly static images does not depend on the factor
        use = ((bends > 0.5) == bending) & (added < MAX_ADDED)
        if use.any():
            needed = np.sqrt(np.maximum(log**2 - added**2, 0.0))[use] / unit[use]
            # quantiles, so that every pair has the same weight
            alike.append(np.quantile(needed, np.linspace(0, 1, 101)))
    return float(np.quantile(np.concatenate(alike), SHARE_WITHIN)) if alike else None


def text_confidence(name: str, text: str, rows: Sequence[Row], note: str = "") -> str:
    """Page of the analysis: tables by pair and by family."""
    good = [r for r in rows if r.get("confidence")]
    lines = [
        f"# Analysis: {name}",
        "",
        f"{text[0].upper()}{text[1:]}. {note}",
        "",
        provenance(rows),
        "",
    ]
    lines += [
        "AUSE / MRE is the area between the sparsification curve and the oracle's, over the mean"
        " relative error: 0 is perfect, 0.8 to 1 is chance. Within k: share of the pixels whose"
        " log depth is within k sigma, one median scale a pair.",
        "",
    ]
    used = [c for c in CUES if any(c in r["confidence"]["ause"] for r in good)]
    head = ["pair", "flow", "MRE", "surest 90 %", "surest 70 %"]
    head += [*(f"AUSE {c}" for c in used), "within 1", "within 2", "guess", "CPU s"]
    lines += table(head, [_line(n, r, used) for n, r in zip(titles(good), good, strict=True)])
    lines += ["", *(f"- {c}: {CUES[c]}" for c in used), "", "## By family", ""]
    lines += [
        f"The factor of sigma, shipped as {FACTOR:g} ({BENDING_FACTOR:g} where surfaces bend), is"
        f" chosen for each family on regions of the same kind of all others, so that"
        f" {SHARE_WITHIN:.0%} of their pixels lie within one sigma; every pair counts alike.",
        "",
    ]
    lines += table(*_families(good, used))
    return page_text([*lines, "", *failures(rows), code_versions(rows)])


def _line(title: str, row: Row, used: Sequence[str]) -> list[str]:
    c: Mapping[str, Any] = row["confidence"]
    return [
        title,
        row["flow"],
        *(show(c[k]) for k in ("mre", "solution_90", "solution_70")),
        *(show(c["ause"].get(k), ".3f") for k in used),
        *(show(k, ".2f") for k in c["within"]),
        show(c["guess"], ".1%"),
        show(c["seconds"], ".1f"),
    ]


def _families(good: Sequence[Row], used: Sequence[str]) -> tuple[list[str], list[list[str]]]:
    """Head and lines of the table by family; the last line has the means over the families."""
    factors, lines, numbers = left_out_factors(good), [], []
    for family in dict.fromkeys(r["sequence"] for r in good):
        own = [r["confidence"] for r in good if r["sequence"] == family]
        area = [mean([c["ause"].get(k) for c in own]) for k in used]
        within = [float(np.mean([c["within"][k] for c in own])) for k in (0, 1)]
        chosen, *left = factors.get(family, ((), None, None))
        numbers.append([*area, *within, *left])
        shown = ", ".join(show(f, ".1f") for f in chosen) or show(None)
        lines.append([f"{family} ({len(own)})", *_shown(numbers[-1], len(used)), shown])
    last = [mean(column) for column in zip(*numbers)]
    lines.append([f"mean of {len(numbers)} families", *_shown(last, len(used)), ""])
    head = ["family (pairs)", *(f"AUSE {c}" for c in used), "within 1", "within 2"]
    return [*head, "left out: within 1", "left out: within 2", "factors of the others"], lines


def _shown(numbers: Sequence[Any], areas: int) -> list[str]:
    return [show(v, ".3f" if k < areas else ".2f") for k, v in enumerate(numbers)]


def plot_confidence(path: Path, rows: Sequence[Row]) -> None:
    """Sparsification curves of sigma and of the oracle, one panel for each family."""
    good = [r for r in rows if r.get("confidence")]
    families = list(dict.fromkeys(r["sequence"] for r in good))
    across = min(4, max(1, len(families)))
    down = -(-len(families) // across)
    out = figure(3.0 * across, 2.4 * down)
    axes = out.subplots(down, across, squeeze=False)
    for ax in axes.ravel()[len(families) :]:
        ax.set_visible(False)
    for ax, family in zip(axes.ravel(), families):
        for row in (r for r in good if r["sequence"] == family):
            kept, own, best = np.array(row["confidence"]["curve"])
            whole = row["confidence"]["mre"]
            ax.plot(100 * (1 - kept), own / whole, color="#4477aa", lw=1)
            ax.plot(100 * (1 - kept), best / whole, color="#bbbbbb", lw=1)
        ax.axhline(1.0, color="#cc6677", lw=0.8, ls="--")
        ax.set(title=family, ylim=(0, 1.3), xlim=(0, 100))
        ax.title.set_fontsize(9)
    for ax in axes[-1]:
        ax.set_xlabel("most uncertain % removed")
    for ax in axes[:, 0]:
        ax.set_ylabel("MRE of the rest / MRE")
    out.suptitle("Sparsification: sigma (blue), oracle (grey), chance (dashed)", fontsize=10)
    save(out, path)
