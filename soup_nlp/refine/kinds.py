"""Kinds of proposal: their shares of a round and the step sizes of the walks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from soup_nlp.arrays import Float

WALKS = ("walk_plane", "walk_motion", "walk_pivot", "walk_scale", "walk_all")
COMMON = ("common_motion",)
BORROWED = (
    "neighbour_plane",
    "neighbour_motion",
    "neighbour_both",
    "neighbour_refit",
    "own_refit",
    "dominant",
    "mean",
)
KINDS = ("current", "kept", *WALKS, *COMMON, *BORROWED)
"""Kinds of proposal by number."""
SHARES: Mapping[str, float] = {
    "walk_plane": 3,
    "walk_motion": 3,
    "walk_pivot": 2,
    "walk_scale": 3,
    "walk_all": 2,
    "common_motion": 2,
    "neighbour_plane": 3,
    "neighbour_motion": 3,
    "neighbour_both": 5,
    "neighbour_refit": 2,
    "own_refit": 1,
    "dominant": 3,
    "mean": 3,
}
"""Proposals by kind in the first round, relative."""
FEW = ("own_refit",)
"""Kinds with at most one proposal, because they are deterministic."""


@dataclass
class Spread:
    """Step sizes of the walks: log-normal, centred where accepted steps were found.

    A step of a walk is drawn as `px x N(0, 1)` in every coordinate with px log-normal, so that
    large and small steps are tried at once.

    Attributes:
        centre: By kind of walk, log of the usual step, pixels.
        width: Standard deviation of log px.
        shrink: Factor per round on walks of which nothing is accepted.
    """

    centre: dict[str, float] = field(
        default_factory=lambda: {k: float(np.log(0.5)) for k in (*WALKS, *COMMON)}
    )
    width: float = 1.2
    shrink: float = 0.7

    def draw(self, kind: str, shape: tuple[int, ...], rng: np.random.Generator) -> Float:
        """Steps in pixels."""
        return np.asarray(np.exp(self.centre[kind] + self.width * rng.standard_normal(shape)))

    def learn(self, kind: str, accepted: Float) -> None:
        """Move the centre to the accepted steps (M,), pixels or NaN; shrink it without any."""
        accepted = accepted[np.isfinite(accepted)]
        if accepted.size >= 3:
            self.centre[kind] += 0.7 * (float(np.log(accepted).mean()) - self.centre[kind])
        else:
            self.centre[kind] += float(np.log(self.shrink))


def counts(shares: Mapping[str, float], total: int, near: int) -> dict[str, int]:
    """`total` proposals split by shares, largest remainders first, within the limits of each kind.

    Args:
        shares: By kind.
        total: Number of proposals.
        near: Neighbours of a superpixel.
    """
    most = {
        k: 1 if k in FEW else near if k.startswith("neighbour") or k == "mean" else total
        for k in shares
    }
    whole = sum(shares.values())
    exact = {k: min(total * v / whole, most[k]) for k, v in shares.items()}
    out = {k: int(v) for k, v in exact.items()}
    for k in sorted(exact, key=lambda k: out[k] - exact[k]):
        if sum(out.values()) < total and out[k] < most[k]:
            out[k] += 1
    out["walk_all"] += total - sum(out.values())
    return out


def relearn(
    shares: dict[str, float], proposed: Mapping[str, int], accepted: Mapping[str, int]
) -> None:
    """Increase the shares of kinds whose proposals were accepted, decrease the others."""
    rate = {k: accepted[k] / max(1, proposed[k]) for k in shares}
    mean = sum(rate.values()) / len(rate)
    if mean > 0:
        whole = sum(SHARES[k] for k in shares) / len(shares)
        for k in shares:
            # every kind keeps half of its usual share: it may succeed in a later round
            wanted = 0.5 * SHARES[k] + 0.5 * whole * min(rate[k] / mean, 3.0)
            shares[k] += 0.5 * (wanted - shares[k])
