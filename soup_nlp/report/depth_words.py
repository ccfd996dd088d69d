"""Lines of the verdict on the depth: flow, parallax, components, what to try."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from soup_nlp.report.limits import SHARE, USABLE

if TYPE_CHECKING:
    from soup_nlp.pipeline.record import Run

STILL = 0.3
"""Other frames are recommended if a larger share of the image has no parallax."""


def depth_words(run: Run, shares: Mapping[str, float]) -> list[str]:
    """Lines of the verdict: usable flow, parallax, moving components, what to try."""
    assert run.pair.flow is not None
    usable = float((run.pair.flow.confidence > 0).mean())
    lines = [f"flow usable at {usable:.0%} of the pixels"]
    if run.start.at_rest:
        lines.append("the camera is at rest or turns only: depth is a guess")
    elif run.start.bends.all():
        lines.append("surfaces bend: their relief is weakly determined")
    else:
        if run.start.bending:
            share = float(run.start.bends[run.segmentation.labels].mean())
            lines.append(f"{share:.0%} of the image bends: its relief is weakly determined")
        pixels = np.sort(run.start.parallax[run.segmentation.labels].ravel())
        lines[0] += f", median parallax {pixels[len(pixels) // 2]:.3g} px"
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
        hints.append("a better flow (--flow), or frames closer in time")
    if shares["still"] >= STILL:
        hints.append("frames further apart: the camera has to move, not to turn alone")
    if hints:
        lines.append(f"try {'; '.join(hints)}")
    return lines
