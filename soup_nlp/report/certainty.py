"""Shares of the image whose depth is determined, and by what, and shares that are a guess."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from soup_nlp.arrays import Mask
from soup_nlp.evaluate.confidence import MOST_SIGMA, scale_by_contact
from soup_nlp.geometry.surface import hidden
from soup_nlp.start.components import FIXED, TIES, displacement

if TYPE_CHECKING:
    from soup_nlp.pipeline.record import Run

WORDS = {
    "flow": "by flow and parallax",
    "contact": "with the scale of a contact",
    "outline": "with the scale of an outline",
    "given": "by the given depth",
    "fixed": "stands still in the image while the camera moves",
    "unseen": "no usable flow",
    "rest": "the camera only turns or stands still",
    "flat": "a turn alone or a constant depth explains the flow nearly as well",
    "scale": "with a scale that contact hardly determines",
    "weak": "little information",
}


GUESSES = ("rest", "fixed", "unseen", "flat", "scale", "weak")
"""Reasons of guesses, each where those before it do not hold."""


def certainty(run: Run) -> dict[str, float]:
    """Shares of the image for summary.json and the verdict.

    Returns:
        "determined": share with a sigma of log depth of at most `MOST_SIGMA`; the sum of "flow"
        (pixels of the largest component), "contact" and "outline" (pixels of other components, by
        the source of their scale), and with a depth prior "given" (depth or scale are the
        prior's). "guess": the rest; the sum of "rest" (the camera is at rest or
        only turns), "fixed" (stands still in the image though the camera moves, such as the bonnet
        of its car), "unseen" (no usable flow, or hidden in the next frame), "flat" (of a
        component without evidence of depth, see `Evidence.guess`), "scale" (of a component whose
        scale alone is that uncertain) and "weak". "median_sigma": median over the determined
        pixels.
    """
    sigma = run.confidence.sigma
    labels, start = run.segmentation.labels, run.start
    sure = sigma <= MOST_SIGMA
    tie = start.tie[labels]
    assert run.pair.flow is not None
    unseen = (run.pair.flow.confidence <= 0) | hidden(run.reconstruction)
    rest, fixed = np.full(labels.shape, start.at_rest), tie == FIXED
    flat = run.confidence.evidence.guess[start.component][labels]
    sizes = run.segmentation.sizes
    far = displacement(run.soup, run.data.anchor_ray, start.component)
    scale = scale_by_contact(run.confidence.marginals, start, sizes, far, run.given)
    loose = scale[labels] > MOST_SIGMA
    guess, left = {}, ~sure
    reasons = {"rest": rest, "fixed": fixed, "unseen": unseen, "flat": flat, "scale": loose}
    for name, mask in reasons.items():
        guess[name] = left & mask
        left = left & ~mask

    def share(mask: Mask) -> float:
        return float(mask.mean())

    given = np.zeros(len(sizes), bool) if run.given is None else run.given.held
    own = sure & ~given[labels]
    return {
        "determined": share(sure),
        "flow": share(own & (tie == TIES.index("reference"))),
        "contact": share(own & (tie == TIES.index("contact below"))),
        "outline": share(own & (tie > TIES.index("contact below"))),
        **({} if run.given is None else {"given": share(sure & given[labels])}),
        "guess": share(~sure),
        **{name: share(mask) for name, mask in guess.items()},
        "weak": share(left),
        "median_sigma": float(np.median(sigma[sure])) if sure.any() else float("nan"),
    }


def certainty_lines(found: Mapping[str, float]) -> list[str]:
    """The shares as sentences on the determined part and on the guess."""
    lines = []
    if found["determined"] >= 0.005:
        lines.append(
            f"{found['determined']:.0%} of the image is determined, half of it to"
            f" {found['median_sigma']:.1%} (1 sigma):"
            f" {_parts(found, ('flow', 'contact', 'outline', 'given'))}"
        )
    if found["guess"] >= 0.005:
        lines.append(guess_words(found))
    return lines


def guess_reason(found: Mapping[str, float]) -> str:
    """The reason of the largest part of the guess."""
    return WORDS[max(GUESSES, key=lambda name: found.get(name, 0.0))]


def guess_words(found: Mapping[str, float], of: str = "") -> str:
    """Sentence on the share that is a guess and the reasons."""
    return (
        f"{found['guess']:.0%}{of} is a guess (sigma above {MOST_SIGMA:.0%}):"
        f" {_parts(found, GUESSES)}"
    )


def _parts(found: Mapping[str, float], names: tuple[str, ...]) -> str:
    return ", ".join(f"{found[k]:.0%} {WORDS[k]}" for k in names if found.get(k, 0.0) >= 0.005)
