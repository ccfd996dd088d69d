"""The study of confidence: sparsification by sigma, and calibration of sigma by family."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from soup_nlp.arrays import Float
from soup_nlp.bench.accuracy import pixel_errors, scores, solved
from soup_nlp.bench.study import (
    Overrides,
    Study,
    failures,
    markdown,
    page_text,
    panels,
    provenance,
    save,
)
from soup_nlp.bench.suite_pairs import Item
from soup_nlp.errors import DataError
from soup_nlp.evaluate.confidence import (
    BENDING_FACTOR,
    FACTOR,
    calibrated,
    confidence,
    with_prior,
)
from soup_nlp.evaluate.metrics import true_pixels
from soup_nlp.evaluate.scoring import at_truth
from soup_nlp.evaluate.sparsification import coverage, sparsification
from soup_nlp.pipeline.record import Run
from soup_nlp.storage.rows import Row

SAMPLE_PIXELS = 400
"""Number of pixels of a pair that the calibration of other families uses."""
SHARE_WITHIN = 0.76
"""Share of the pixels whose error is within one sigma after calibration."""
MAX_ADDED = 0.05
"""Pixels of which more is added in squares are not used for the calibration."""


def measure_confidence(item: Item, overrides: Overrides = (), folder: Path | None = None) -> Row:
    """The row of `measure_pair` with the sparsification curve and a sample for the calibration.

    Raises:
        DataError: the pair has no true depth.
    """
    result = solved(item, overrides, folder)
    errors = pixel_errors(result)
    if errors is None:
        raise DataError("pair has no true depth", where=item.key)
    relative, log, sigma = errors
    begin = time.process_time()
    energy = result.data, result.weights, result.problem.formulation
    confidence(result.reconstruction, result.pair, result.start, *energy)
    seconds = time.process_time() - begin
    curve = sparsification(relative, sigma)
    sample = np.stack([log, *_calibration(result)])
    picked = np.linspace(0, len(log) - 1, min(SAMPLE_PIXELS, len(log))).astype(int)
    row = scores(result, item.presets)
    return row | {
        "confidence": {
            "mre": float(relative.mean()),
            **{name: result.metrics[name].mre for name in ("solution_90", "solution_70")},
            "ause": {"sigma": curve.ause},
            "within": row["within"],
            "guess": row["guess"],
            "noise": result.confidence.noise,
            "seconds": seconds,
            "curve": [curve.kept.tolist(), curve.error.tolist(), curve.oracle.tolist()],
            "sample": sample[:, picked].round(6).tolist(),
        },
    }


def _calibration(result: Run) -> tuple[Float, Float, Float]:
    """(M,) sigma before its factor, what is added in squares, whether the surface bends."""
    truth, rec, sure = result.pair.truth, result.reconstruction, result.confidence
    assert truth is not None
    z, gt = at_truth(truth, rec.depth_ref)
    true = true_pixels(gt, None) & np.isfinite(z)
    bends = result.start.bends[rec.labels]
    whole = calibrated(sure.spread, sure.noise, sure.misfit[rec.labels], np.inf, bends)
    images = whole / np.where(bends, BENDING_FACTOR, FACTOR), sure.added, bends.astype(float)
    unit, added, bending = (at_truth(truth, image)[0][true] for image in images)
    return unit, added, bending


def left_out_factors(
    frame: pd.DataFrame,
) -> dict[str, tuple[tuple[float, ...], float, float]]:
    """Calibration factors of every family from all others, and the coverage of 1 and 2 sigma.

    Bending regions have a factor of their own, from bending regions of the others. A family is left
    out for whose regions the others have none.
    """
    both = zip(frame["sequence"], frame["confidence.sample"], strict=True)
    samples = [(family, np.array(sample)) for family, sample in both]
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


COLUMNS = {
    "confidence.mre": "MRE",
    "confidence.solution_90": "surest 90 %",
    "confidence.solution_70": "surest 70 %",
    "confidence.ause.sigma": "AUSE",
    "within 1": "within 1",
    "within 2": "within 2",
    "confidence.guess": "guess",
    "confidence.seconds": "CPU s",
}
"""Titles of the columns of the page."""


def confidence_page(study: Study, frame: pd.DataFrame, note: str = "") -> str:
    """Page of the study: tables by pair and by family."""
    good = _known(frame)
    head = f"{study.text[0].upper()}{study.text[1:]}. {note} {provenance(frame)}."
    if good.empty:
        return page_text(["# Study: confidence", "", head, *failures(frame)])
    table = good[list(COLUMNS)].astype(float).rename(columns=COLUMNS)
    by_pair = table.set_axis(pd.Index(good["title"], name="pair, flow"))
    by_family = table.assign(family=good["sequence"]).groupby("family", sort=False).mean()
    factors = left_out_factors(good)
    for k, name in enumerate(("left out: within 1", "left out: within 2")):
        by_family[name] = [factors[f][k + 1] if f in factors else np.nan for f in by_family.index]
    by_family.loc[f"mean of {len(by_family)} families"] = by_family.mean()
    by_family["factors of the others"] = [
        ", ".join(f"{v:.1f}" for v in factors[f][0]) if f in factors else "-"
        for f in by_family.index
    ]
    forms = {c: ".4f" if c in ("MRE", "surest 90 %", "surest 70 %") else ".2f" for c in by_family}
    return page_text(
        [
            "# Study: confidence",
            "",
            head,
            "",
            "AUSE is the area between the sparsification curve and the oracle's, over the mean"
            " relative error: 0 is perfect, 0.8 to 1 is chance. Within k: share of the pixels whose"
            " log depth is within k sigma, one median scale a pair.",
            "",
            *markdown(by_pair, forms),
            "",
            "## By family",
            "",
            f"The factor of sigma, shipped as {FACTOR:g} ({BENDING_FACTOR:g} where surfaces bend),"
            " is chosen for each family on regions of the same kind of all others, so that"
            f" {SHARE_WITHIN:.0%} of their pixels lie within one sigma; every pair counts alike.",
            "",
            *markdown(by_family, forms),
            *failures(frame),
        ]
    )


def _known(frame: pd.DataFrame) -> pd.DataFrame:
    """The rows that have a sparsification curve."""
    if "confidence.within" not in frame:
        return frame.iloc[:0]
    good = frame[frame["confidence.within"].notna()].copy()
    for k in (0, 1):
        good[f"within {k + 1}"] = [v[k] for v in good["confidence.within"]]
    return good


def plot_confidence(path: Path, frame: pd.DataFrame) -> None:
    """Sparsification curves of sigma and of the oracle, one panel for each family."""
    good = _known(frame)
    families = good.groupby("sequence", sort=False)
    out, axes = panels(families.ngroups, 4, 3.0, 2.4)
    for ax, (family, group) in zip(axes, families, strict=True):
        for curve, whole in zip(group["confidence.curve"], group["confidence.mre"], strict=True):
            kept, by_sigma, oracle = np.array(curve)
            ax.plot(100 * (1 - kept), by_sigma / whole, color="#4477aa", lw=1)
            ax.plot(100 * (1 - kept), oracle / whole, color="#bbbbbb", lw=1)
        ax.axhline(1.0, color="#cc6677", lw=0.8, ls="--")
        ax.set(ylim=(0, 1.3), xlim=(0, 100))
        ax.set_title(str(family), fontsize=9)
    out.supxlabel("most uncertain % removed")
    out.supylabel("MRE of the rest / MRE")
    out.suptitle("Sparsification: sigma (blue), oracle (grey), chance (dashed)", fontsize=10)
    save(out, path)
