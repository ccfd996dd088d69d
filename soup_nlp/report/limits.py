"""Sentences on what limits a result: flow, parallax, guesses, components, convergence."""

from __future__ import annotations

import numpy as np

from soup_nlp.report.certainty import guess_words
from soup_nlp.report.result import Result

USABLE = 0.8
"""Share of usable flow below which the flow counts as a limit."""
SHARE = 0.05
"""Share of the image above which a limit is mentioned."""


def limits(shown: Result) -> list[str]:
    """Sentences on the limits of a result and on what to try; at least one."""
    found = [*_convergence(shown), *_flow(shown), *_parallax(shown), *_parts(shown)]
    return found or ["Nothing stands out: flow, parallax and convergence are good."]


def _convergence(shown: Result) -> list[str]:
    s = shown.summary
    if s["converged"] or s["status"] == "Skipped":
        return []
    return [f"The NLP did not converge ({s['status']}): try a larger solver.max_iter."]


def _flow(shown: Result) -> list[str]:
    """Unusable flow, and pixels that leave the image."""
    share = float((np.asarray(shown.array("input/confidence")) > 0).mean())
    if share >= USABLE:
        return []
    return [
        f"The flow is usable at {share:.0%} of the pixels; the rest takes its depth from its"
        " surroundings. Try a better flow (flow.source)."
    ]


def _parallax(shown: Result) -> list[str]:
    """Superpixels whose depth the images hardly determine."""
    if shown.at_rest:
        return [
            "The flow is that of a camera that stands still or only turns: images from one place"
            " hold no depth. What is shown is a guess. Try frames between which the camera moves"
            " aside."
        ]
    if shown.bending:
        return [
            "Surfaces are taken to bend: without one rigid motion depth follows from the surfaces'"
            " own stretching, and relief is weakly determined."
        ]
    pixels = np.asarray(shown.tree["segmentation"]["sizes"], float)
    bends = float(pixels[shown.bends].sum() / pixels.sum())
    out = []
    if bends:
        out.append(
            f"{bends:.0%} of the image bends: its depth follows from the surface's own stretching,"
            " and its scale from contact."
        )
    shares = shown.summary.get("certainty", {})
    if shares.get("guess", 0.0) >= SHARE:
        guess = guess_words(shares, " of the image")
        out.append(f"{guess}. What is shown there follows from the neighbours.")
    if shares.get("flat", 0.0) >= SHARE:
        out.append(
            f"{shares['flat']:.0%} of the image lies in components whose flow a turn alone or a"
            " constant depth explains nearly as well as depth does. Try frames farther apart in"
            " time."
        )
    return out


def _parts(shown: Result) -> list[str]:
    """Components whose scale only follows from contact."""
    parts = shown.components
    if len(parts) == 1:
        return []
    pixels = shown.labels.size
    moving = 1 - parts.background.pixels / pixels
    some = "1 component" if len(parts) == 2 else f"{len(parts) - 1} components"
    return [
        f"The scale of {some} beside the background ({moving:.1%} of the image) follows not from"
        " the images but from what it stands on or touches."
    ]
