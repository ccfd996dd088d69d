"""What a run found, how sure that is, what limits it and what to try, in words."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.evaluate.confidence import MOST_SIGMA
from soup_nlp.pipeline.record import Run
from soup_nlp.report.result import Result
from soup_nlp.start.components import largest

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
LISTED = 5
"""Number of moving components that are listed."""
WAYS = (("to the right", "to the left"), ("down", "up"), ("ahead", "back"))
"""Directions of the axes of a camera."""


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


def found_words(run: Run) -> list[str]:
    """Motion of the camera and of the large components, bending, size, depth prior."""
    start, parts, labels = run.start, run.components, run.segmentation.labels
    turn = f"by {parts.camera.angle:.2f} degrees"

    def shift(label: int, vector: Float) -> str:
        unsure = run.confidence.sigma[parts.of_pixel == label] > MOST_SIGMA
        words = " (a guess, as its distance is)" if unsure.mean() > 0.5 else ""
        return f"by {_shift(run, vector)}{words}"

    if start.at_rest:
        lines = [f"the camera stands still or only turns, {turn}: depth is a guess"]
    elif start.bends.all():
        lines = ["surfaces bend: their relief is weakly determined"]
    else:
        lines = [f"the camera moves {shift(0, parts.camera.centre)} and turns {turn}"]
        if start.bending:
            share = float(start.bends[labels].mean())
            lines.append(f"{share:.0%} of the image bends: its relief is weakly determined")
    shares = {part.label: part.pixels / labels.size for part in parts.members[1:]}
    large = [label for label, share in shares.items() if share >= SHARE / 5]
    for label in large[:LISTED]:
        centre = parts[label].centre
        moved = shift(label, parts.own_motion(label)(centre) - centre)
        lines.append(f"{shares[label]:.0%} of the image moves by itself, {moved}")
    rest = len(shares) - len(large[:LISTED])
    if rest:
        most = max(share for label, share in shares.items() if label not in large[:LISTED])
        size = "below 1%" if most < SHARE / 5 else f"at most {most:.0%}"
        kind = "more components" if large else "components that move by themselves"
        lines.append(f"{kind}: {rest} ({size} of the image{' each' * (rest > 1)})")
    if run.given is not None:
        lines.append(str(run.given))
    if run.full is not None:
        (height, width), (h, w) = run.full.depth_ref.shape, run.pair.size
        scored = "" if run.full.metrics is None else f": MRE {run.full.metrics.mre:.4f}"
        lines.append(f"solved at {w}x{h}, brought to {width}x{height}{scored}")
    return lines


def _shift(run: Run, shift: Float) -> str:
    """Length and main direction of a displacement (3,) in the reference camera's axes.

    The length is in the unit of the truth, or relative to the median depth without a truth.
    """
    axis = int(np.argmax(np.abs(shift)))
    length, score = float(np.linalg.norm(shift)), run.metrics.get("solution")
    if score is not None and np.isfinite(score.scale) and run.pair.truth is not None:
        size = f"{score.scale * length:.3g} {run.pair.truth.unit}"
    else:
        size = (
            f"{length / float(np.nanmedian(run.reconstruction.depth_ref)):.1%} of the median depth"
        )
    return f"{size} {WAYS[axis][int(shift[axis] < 0)]}"


def flow_words(run: Run) -> list[str]:
    """Usable flow, and how well simpler explanations than depth fit it."""
    sure, main = run.confidence.evidence, largest(run.start.component)
    assert run.pair.flow is not None
    lines = [f"usable at {run.pair.flow.usable:.0%} of the pixels, noise {sure.noise:.2f} px"]
    if np.isfinite(sure.turn[main]):
        lines.append(
            f"error of the largest component: {sure.turn[main]:.2f} px by a turn alone,"
            f" {sure.constant[main]:.2f} px at a constant depth, {sure.solution[main]:.2f} px here"
        )
    return lines


def hints(run: Run, shares: Mapping[str, float]) -> list[str]:
    """What would give a better depth; `shares` are those of `certainty`."""
    flow, out = run.pair.flow, []
    assert flow is not None
    if flow.usable < USABLE:
        length = np.linalg.norm(flow.uv, axis=-1)[flow.confidence > 0]
        fast = len(length) and np.median(length) > FAST * run.pair.size[1]
        out.append("frames closer in time" if fast else "a better flow (--flow)")
    if shares["rest"] > 0.5:
        out.append("frames between which the camera moves aside, not only turns")
    elif shares["flat"] >= SHARE:
        out.append("frames farther apart in time")
    if shares["scale"] >= SHARE:
        out.append("a depth from elsewhere (--depth-prior) for what moves")
    return ["; ".join(out)] if out else []


def limits(result: Result) -> list[str]:
    """Sentences on the limits of a result and on what to try; at least one."""
    s, shares, parts = result.summary, result.summary.get("certainty", {}), result.components
    usable = float(np.mean(result.flow_confidence > 0))
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
