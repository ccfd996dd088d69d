"""What a run says in words: the printed verdict, its tables, and the limits on the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from soup_nlp.evaluate.confidence import MOST_SIGMA
from soup_nlp.evaluate.metrics import DepthMetrics, skill
from soup_nlp.evaluate.scoring import SURE
from soup_nlp.pipeline.record import Run
from soup_nlp.report.result import PAGE, Result
from soup_nlp.report.summary import certainty, refinement_summary

STATUS = {
    "Solve_Succeeded": "converged to the tolerance",
    "Solved_To_Acceptable_Level": "converged to Ipopt's acceptable level",
    "Maximum_Iterations_Exceeded": "not converged: iteration limit, best iterate kept",
    "Time_Limit": "not converged: time limit, best iterate kept",
    "Constraints_Violated": "not converged: the answer breaks its constraints",
    "Skipped": "refined from the start, no NLP",
    "Interrupted": "interrupted, best iterate kept",
    "Infeasible_Problem_Detected": "not converged: no feasible point nearby, best iterate kept",
    "Error_In_Step_Computation": "not converged: no further step is found, best iterate kept",
    "Search_Direction_Becomes_Too_Small": "not converged: steps are of rounding size, best iterate"
    " kept",
    "Restoration_Failed": "not converged: feasibility could not be restored, best iterate kept",
}
TITLES = {
    **{name: f"surest {share:.0%}" for name, share in SURE.items()},
    "nlp": "NLP alone",
    "rigid": "one rigid motion",
    "constant": "constant depth",
    "solution_next": "next frame",
}
"""Rows of the table of scores; the others have their own names."""
STAGES = {"start": "start", "nlp": "NLP", "solution": "solution"}
"""Rows of the table of energies."""
DELIVERED = {
    "constrained NLP": "its answer, retracted to the constraints",
    "presolve": "the presolve's answer, whose exact energy is lower",
    "start": "the start",
}
OF_ANSWER = ("nlp_infeasibility", "dual_infeasibility", "complementarity")
"""Residuals that are those of Ipopt's answer; the others are those of the delivered soup."""
SHARES = {
    "flow": "by flow and parallax",
    "contact": "with the scale of a contact",
    "outline": "with the scale of an outline",
    "given": "by the given depth",
    "rest": "the camera only turns or stands still",
    "fixed": "stands still in the image while the camera moves",
    "unseen": "no usable flow",
    "flat": "a turn alone or a constant depth explains the flow nearly as well",
    "scale": "with a scale that contact hardly determines",
    "weak": "little information",
}
"""Words for the shares of `certainty`."""
GUESSES = ("rest", "fixed", "unseen", "flat", "scale", "weak")
"""Shares that are a guess."""
USABLE = 0.8
"""Share of usable flow below which the flow counts as a limit."""
SHARE = 0.05
"""Share of the image above which a limit is mentioned."""
FAST = 0.05
"""Median length of the flow, relative to the image's width, above which motion is fast."""

PAD = " " * 12


def verdict(run: Run, folder: Path, files: Sequence[str], limit: float | None = None) -> str:
    """Facts, files and next command; `limit` is the largest MRE that the problem file expects."""
    look = [f"look        soup-nlp view {folder}"] if PAGE in files else []
    lines = [f"files       {folder}/: {', '.join(files)}", *look]
    return "\n".join([facts(run, limit), *lines, f"next        soup-nlp check {folder}"])


def facts(run: Run, limit: float | None = None) -> str:
    """Status, energy, residuals, accuracy and times; `limit` is the largest expected MRE."""
    s, shares = run.solution, certainty(run)
    whole = {k: v for k, v in run.seconds.items() if not k.startswith("nlp_")}
    inner = {k[4:]: v for k, v in run.seconds.items() if k.startswith("nlp_")}
    delivered = {k: v for k, v in run.residuals.items() if k not in OF_ANSWER}
    answer = _numbers({k: s.residuals[k] for k in OF_ANSWER if k in s.residuals}, ".1e")
    sections = {
        "status": _status(run),
        "energy": _energies(run),
        "residuals": [_numbers(delivered, ".1e"), *[f"Ipopt's answer: {answer}"] * bool(answer)],
        "depth": depth_words(run, shares),
        "certainty": certainty_lines(shares),
        "accuracy": [protocol(run.metrics), *accuracy(run.metrics)] if run.metrics else [],
        "expected": [f"MRE at most {limit:g}: {'missed' if missed(run) else 'met'}"]
        if limit is not None and "solution" in run.metrics
        else [],
        "seconds": [
            f"{sum(whole.values()):.1f}: {_numbers(whole, '.1f')}",
            *[f"of nlp: {_numbers(inner, '.1f')}"] * bool(inner),
        ],
    }
    return "\n".join(
        (PAD if k else f"{title:<12}") + line
        for title, lines in sections.items()
        for k, line in enumerate(lines)
    )


def _numbers(values: Mapping[str, float], form: str) -> str:
    return "  ".join(f"{k} {v:{form}}" for k, v in values.items())


def _status(run: Run) -> list[str]:
    """Status in words, iterations, exact energy at the end of each stage, refinement."""
    s = run.solution
    lines = [
        f"{STATUS.get(s.status, f'not converged: {s.status}, best iterate kept')} ({s.status})"
    ]
    if s.far and not s.converged:
        lines.append(
            "the presolve ended far from a minimum: solver.far_iterations limits Ipopt there"
        )
    if s.stages:
        every = sum(stage.iterations for stage in s.stages)
        counted = f"constrained NLP {s.stages[-1].iterations} iterations of {every}"
        made = "refined" if run.refined else "delivered"
        lines.append(f"{counted}; {made}: {DELIVERED[run.delivered]}")
        ends = dict(s.ends) | ({} if run.refined is None else {"refinement": run.energy["total"]})
        found = "minimum found by Ipopt" if s.converged else "no minimum reached"
        stages = ", ".join(f"{k} {e:.5g}" for k, e in ends.items())
        lines.append(f"{found}: E {stages}" if ends else found)
    return lines + _refinement(run)


def _refinement(run: Run) -> list[str]:
    """Result of the refinement, and the gap of its last choice."""
    r = run.refined
    if r is None:
        return []
    if not r.rounds:
        return [f"refinement: {r.status} before its first round"]
    last, images = r.rounds[-1], "photo" in r.energy
    lines = [
        f"refinement {len(r.rounds)} round{'s' * (len(r.rounds) > 1)} ({r.status}):"
        f" E{' + E_photo' * images} {1 - r.energy['total'] / r.energy_begin['total']:.1%} lower;"
        f" the last choice is at most {max(last.gap, 0) / last.mrf_energy:.2%} above the best among"
        " its particles"
    ]
    if images:
        lines.append(
            f"the images contradict the flow at {r.contradicted} superpixels and outweigh it there:"
            " E may rise"
        )
    return lines


def energy_table(
    energy: Mapping[str, Mapping[str, Any]], refinement: Mapping[str, Any] | None
) -> tuple[list[str], dict[str, list[Any]]]:
    """Columns and rows (by title) of E by stage and term.

    The last column is what the refinement minimised, where that is not E.

    Args:
        energy: E by term and stage ("start", "nlp", "solution").
        refinement: Entry of summary.json; None without a refinement.
    """
    columns = list(energy["solution"])
    rows = {k: [energy[k].get(term) for term in columns] for k in STAGES if k in energy}
    if refinement and "photo" in refinement["end"]:
        columns.append("E + E_photo")
        for key, stage in zip(STAGES, ("start", "begin", "end"), strict=True):
            rows.get(key, []).append(refinement[stage]["total"])
    return columns, {STAGES[k]: row for k, row in rows.items()}


def _energies(run: Run) -> list[str]:
    s = run.solution
    energy = {"start": s.energy_start, "nlp": s.energy, "solution": run.energy}
    columns, rows = energy_table(energy, refinement_summary(run))
    if run.refined is None or not s.stages:
        del rows[STAGES["nlp"]]
    widths = [max(11, len(name) + 2) for name in columns]
    lines = [" " * 9 + "".join(f"{k:>{w}}" for k, w in zip(columns, widths))]
    for title, row in rows.items():
        lines.append(f"{title:<9}" + "".join(f"{x:>{w}.5g}" for x, w in zip(row, widths)))
    return lines


def protocol(metrics: Mapping[str, DepthMetrics]) -> str:
    """Scale rule and cap of the scores, in words."""
    first = next(iter(metrics.values()))
    cap = "no depth cap" if first.cap is None else f"depth cap {first.cap:g}"
    rule = "no scale" if first.scale_rule == "none" else f"one global {first.scale_rule} scale each"
    frame = "reference" if "constant" in metrics else "next"
    return f"depth of the {frame} frame, {rule}, {cap}"


def score_rows(metrics: Mapping[str, DepthMetrics]) -> list[tuple[str, DepthMetrics, float]]:
    """Title, scores and skill (NaN for the next frame) of solution, start and baselines."""
    worst = metrics["constant"].mre if "constant" in metrics else np.nan
    order = ("solution", *SURE, "nlp", "start", "rigid", "constant", "solution_next")
    return [
        (TITLES.get(k, k), m, np.nan if k == "solution_next" else skill(m.mre, worst))
        for k in order
        if (m := metrics.get(k)) is not None
    ]


def accuracy(metrics: Mapping[str, DepthMetrics]) -> list[str]:
    """Table of the scores; the next frame is listed where only that one has a truth."""
    listed = {k: m for k, m in metrics.items() if k != "solution_next" or "constant" not in metrics}
    return [
        f"{'':<17}{'MRE':>8}{'median':>9}{'skill':>8}{'coverage':>10}",
        *(
            f"{title:<17}{m.mre:>8.4f}{m.median_relative:>9.4f}"
            f"{'' if np.isnan(gain) else f'{gain:.3f}':>8}{m.coverage:>10.1%}"
            for title, m, gain in score_rows(listed)
        ),
    ]


def missed(run: Run) -> bool:
    """Whether the MRE is larger than the problem file expects."""
    limit = run.problem.expected.mre_at_most
    # NaN misses every limit
    return (
        limit is not None and "solution" in run.metrics and not run.metrics["solution"].mre <= limit
    )


def certainty_lines(shares: Mapping[str, float]) -> list[str]:
    """The shares of `certainty` as sentences on the determined part and on the guess."""
    lines = []
    if shares["determined"] >= 0.005:
        lines.append(
            f"{shares['determined']:.0%} of the image is determined, half of it to"
            f" {shares['median_sigma']:.1%} (1 sigma):"
            f" {_parts(shares, ('flow', 'contact', 'outline', 'given'))}"
        )
    return lines + ([guess_words(shares)] if shares["guess"] >= 0.005 else [])


def guess_reason(shares: Mapping[str, float]) -> str:
    """The reason of the largest part of the guess."""
    return SHARES[max(GUESSES, key=lambda name: shares.get(name, 0.0))]


def guess_words(shares: Mapping[str, float], of: str = "") -> str:
    """Sentence on the share that is a guess and the reasons."""
    reasons = _parts(shares, GUESSES)
    return f"{shares['guess']:.0%}{of} is a guess (sigma above {MOST_SIGMA:.0%}): {reasons}"


def _parts(shares: Mapping[str, float], names: tuple[str, ...]) -> str:
    return ", ".join(f"{shares[k]:.0%} {SHARES[k]}" for k in names if shares.get(k, 0.0) >= 0.005)


def depth_words(run: Run, shares: Mapping[str, float]) -> list[str]:
    """Lines of the verdict: usable flow, parallax, moving components, what to try."""
    flow, start, size = run.pair.flow, run.start, run.segmentation.labels.size
    assert flow is not None
    usable = float((flow.confidence > 0).mean())
    sure, main = run.confidence.evidence, int(np.argmax(np.bincount(start.component)))
    lines = [f"flow usable at {usable:.0%} of the pixels, noise {sure.noise:.2f} px"]
    if np.isfinite(sure.turn[main]):
        lines.append(
            f"error of the flow of the largest component: {sure.turn[main]:.2f} px by a turn alone,"
            f" {sure.constant[main]:.2f} px at a constant depth, {sure.solution[main]:.2f} px here"
        )
    if run.given is not None:
        lines.append(str(run.given))
    if start.at_rest:
        lines.append("the camera stands still or only turns: depth is a guess")
    elif start.bends.all():
        lines.append("surfaces bend: their relief is weakly determined")
    elif start.bending:
        share = float(start.bends[run.segmentation.labels].mean())
        lines.append(f"{share:.0%} of the image bends: its relief is weakly determined")
    moving = [part.pixels / size for part in run.components.members[1:]]
    large = [share for share in moving if share >= SHARE / 5]
    if moving:
        sizes = [f"{share:.0%}" for share in large]
        rest = [] if len(large) == len(moving) else ["below 1% the others" if large else "below 1%"]
        words = ", ".join([*sizes, *rest])
        lines.append(f"components beside the background: {len(moving)} ({words} of the image)")
    if run.full is not None:
        (height, width), (h, w) = run.full.depth_ref.shape, run.pair.size
        scored = "" if run.full.metrics is None else f": MRE {run.full.metrics.mre:.4f}"
        lines.append(f"solved at {w}x{h}, brought to {width}x{height}{scored}")
    hints = []
    if usable < USABLE:
        length = np.linalg.norm(flow.uv, axis=-1)[flow.confidence > 0]
        fast = len(length) and np.median(length) > FAST * run.pair.size[1]
        hints.append("frames closer in time" if fast else "a better flow (--flow)")
    if shares["rest"] > 0.5:
        hints.append("frames between which the camera moves aside, not only turns")
    elif shares["flat"] >= SHARE:
        hints.append("frames farther apart in time")
    return lines + ([f"try {'; '.join(hints)}"] if hints else [])


def limits(result: Result) -> list[str]:
    """Sentences on the limits of a result and on what to try; at least one."""
    s, shares, parts = result.summary, result.summary.get("certainty", {}), result.components
    usable = float((np.asarray(result.array("input/confidence")) > 0).mean())
    pixels = np.asarray(result.tree["segmentation"]["sizes"], float)
    bends = float(pixels[result.bends].sum() / pixels.sum())
    has_parallax = not result.at_rest and not result.bending
    guess, flat = shares.get("guess", 0.0), shares.get("flat", 0.0)
    some = "1 component" if len(parts) == 2 else f"{len(parts) - 1} components"
    moving = 1 - parts.background.pixels / result.labels.size
    sentences = (
        (
            not s["converged"] and s["status"] != "Skipped",
            f"The NLP did not converge ({s['status']}): try a larger solver.max_iter.",
        ),
        (
            usable < USABLE,
            f"The flow is usable at {usable:.0%} of the pixels; the rest takes its depth from its"
            " surroundings. Try a better flow (flow.source).",
        ),
        (
            result.at_rest,
            "The flow is that of a camera that stands still or only turns: images from one place"
            " hold no depth. What is shown is a guess. Try frames between which the camera moves"
            " aside.",
        ),
        (
            result.bending and not result.at_rest,
            "Surfaces are taken to bend: without one rigid motion depth follows from the surfaces'"
            " own stretching, and relief is weakly determined.",
        ),
        (
            has_parallax and bends > 0,
            f"{bends:.0%} of the image bends: its depth follows from the surface's own stretching,"
            " and its scale from contact.",
        ),
        (
            has_parallax and guess >= SHARE,
            f"{guess_words({'guess': guess, **shares}, ' of the image')}. What is shown there"
            " follows from the neighbours.",
        ),
        (
            has_parallax and flat >= SHARE,
            f"{flat:.0%} of the image lies in components whose flow a turn alone or a constant"
            " depth explains nearly as well as depth does. Try frames farther apart in time.",
        ),
        (
            len(parts) > 1,
            f"The scale of {some} beside the background ({moving:.1%} of the image) follows not"
            " from the images but from what it stands on or touches.",
        ),
    )
    good = "Nothing stands out: flow, parallax and convergence are good."
    return [text for holds, text in sentences if holds] or [good]
