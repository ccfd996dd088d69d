"""Lines of the verdict on the depth: flow, parallax, components, what to try."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from soup_nlp.report.limits import SHARE, USABLE

if TYPE_CHECKING:
    from soup_nlp.pipeline.record import Run

FAST = 0.05
"""Median length of the flow, relative to the image's width, above which motion is fast."""


def depth_words(run: Run, shares: Mapping[str, float]) -> list[str]:
    """Lines of the verdict: usable flow, parallax, moving components, what to try."""
    assert run.pair.flow is not None
    usable = float((run.pair.flow.confidence > 0).mean())
    sure, main = run.confidence.evidence, int(np.argmax(np.bincount(run.start.component)))
    lines = [f"flow usable at {usable:.0%} of the pixels, noise {sure.noise:.2f} px"]
    if np.isfinite(sure.turn[main]):
        lines.append(
            f"error of the flow of the largest component: {sure.turn[main]:.2f} px by a turn alone,"
            f" {sure.constant[main]:.2f} px at a constant depth, {sure.solution[main]:.2f} px here"
        )
    if run.given is not None:
        lines.append(str(run.given))
    if run.start.at_rest:
        lines.append("the camera stands still or only turns: depth is a guess")
    elif run.start.bends.all():
        lines.append("surfaces bend: their relief is weakly determined")
    elif run.start.bending:
        share = float(run.start.bends[run.segmentation.labels].mean())
        lines.append(f"{share:.0%} of the image bends: its relief is weakly determined")
    moving = [part.pixels / run.segmentation.labels.size for part in run.components.members[1:]]
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
        length = np.linalg.norm(run.pair.flow.uv, axis=-1)[run.pair.flow.confidence > 0]
        fast = len(length) and np.median(length) > FAST * run.pair.size[1]
        hints.append("frames closer in time" if fast else "a better flow (--flow)")
    if shares["rest"] > 0.5:
        hints.append("frames between which the camera moves aside, not only turns")
    elif shares["flat"] >= SHARE:
        hints.append("frames farther apart in time")
    if hints:
        lines.append(f"try {'; '.join(hints)}")
    return lines
