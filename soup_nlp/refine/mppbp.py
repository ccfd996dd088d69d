"""Max-product particle belief propagation: the discrete optimisation of the paper (Sec. 4.4.2).

Every round draws particles around the current soup, writes the exact energy over them as a pairwise
MRF, finds a labelling of low energy with TRW-S, and continues from it. The current belief is
always particle 0 and a choice is taken only if the exact energy (`objective`) is lower: it never
rises. Feasibility holds by construction: rotations by the exponential map, normals on the sphere,
positive distances, visibility by an infinite cost, the simplex by the free global scale.

With one global length unit (`local_units` off) the unit `u = sum_i c_i D_i` couples everything.
The MRF then has u fixed and its first-order change in the unary costs; the comparison of rounds
is with the exact energy, at sum(lam) = 1.

TRW-S starts every round with messages of zero, because nearly all of its labels are new.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, Int
from soup_nlp.geometry.plane import tilt_to_camera
from soup_nlp.geometry.soup import Soup
from soup_nlp.model import oracle
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.mrf.trws import solve_trws
from soup_nlp.refine.anchored import Particles, neighbours
from soup_nlp.refine.costs import PairCosts, feasible, unary_costs
from soup_nlp.refine.particles import Proposals, Proposer
from soup_nlp.refine.photometric import Photometric, swept
from soup_nlp.refine.population import (
    COMMON,
    KINDS,
    SHARES,
    WALKS,
    conditional_costs,
    counts,
    diverse,
    relearn,
    spread_of,
    within_reach,
)
from soup_nlp.refine.records import Refined, RefineOptions, Round
from soup_nlp.storage.progress import Progress, Watch

CURRENT, KEPT = KINDS.index("current"), KINDS.index("kept")
KEPT_SHARE = 0.25
"""Share of the particles that stays for the next round."""
TRWS_ITERATIONS, TRWS_GAP = 15, 1e-4
"""Most iterations of TRW-S in a round, and the relative gap at which it stops earlier."""
DEPTH_REACH = 2.0
"""A proposed depth is at most this many times the upper quartile of the neighbours' depths, and at
least their lower quartile over this squared."""
SWEPT = 6
"""Planes swept over depth that every superpixel is offered, where images count."""
CONTRADICTED = 0.06
"""Share of superpixels whose flow the images contradict, below which there is one round: on such
pairs the MRE after four is that after one."""


def refine_soup(
    soup: Soup,
    data: EnergyData,
    weights: Weights,
    options: RefineOptions | None = None,
    *,
    start: Soup | None = None,
    photo: Photometric | None = None,
    seed: int = 0,
    min_facing: float = 1e-3,
    depth_ratio: float = 5.0,
    watch: Watch | None = None,
) -> Refined:
    """Lower the exact energy of a soup by particles; see the module.

    With images the energy is that of `objective`. Where they contradict the flow of more than a
    few superpixels, planes swept over depth under the commonest motions are among the particles of
    the first round; otherwise it is the only one.

    Args:
        soup: Current belief. Planes that break visibility are first tilted until they do not.
        data: Numbers of the energy.
        weights: Its constants.
        options: Rounds, particles, limits.
        start: The initialisation, whose objective is stated beside; None for `soup`.
        photo: Photometric term; None for the flow alone.
        seed: Of every draw.
        min_facing: Visibility, as in the constrained NLP.
        depth_ratio: The same.
        watch: Listener of the iterations of TRW-S, stop event and log; a stop keeps the best soup.

    Returns:
        The best soup, normalised to sum(lam) = 1, and what happened.
    """
    o = options or RefineOptions()
    begin = time.perf_counter()
    rays = data.visibility_ray(depth_ratio)
    best = (
        tilt_to_camera(soup, data.anchor_ray, rays, min_facing).normalised(data.share).retracted()
    )
    energy = objective(best, data, weights, photo)
    before = energy if start is None else objective(start, data, weights, photo)
    pair_costs = PairCosts(data, weights)
    proposer = Proposer(data, neighbours(pair_costs.edges, data.anchor_ray), seed)
    costs = _Costs(data, weights, photo, o, rays, min_facing, pair_costs, proposer.near)
    rounds = _Rounds(costs, proposer, watch or Watch(), best, energy, begin + o.max_seconds)
    if photo is not None and not rounds.agreed:
        rounds.kept = swept(best, *proposer.commonest(best, 2), data, photo, SWEPT)
    status, done = rounds.run(), tuple(rounds.done)
    return Refined(
        rounds.best,
        before,
        energy,
        rounds.energy,
        done,
        status,
        time.perf_counter() - begin,
        0 if photo is None else int(photo.contradicted.sum()),
    )


def objective(
    soup: Soup, data: EnergyData, weights: Weights, photo: Photometric | None = None
) -> Mapping[str, float]:
    """What the refinement minimises, by term: E; with images also E_photo.

    Where the images contradict the flow, E_proj is weaker (`Photometric.costs_of_flow`).

    Args:
        soup: State.
        data: Numbers of the energy.
        weights: Its constants.
        photo: Photometric term, if there is one.
    """
    own = oracle.energy(soup, data, weights)
    if photo is None:
        return own
    proj = float(photo.costs_of_flow(Particles.of(soup), data, weights)[0].sum())
    seen = photo.energy(soup)
    return {**own, "proj": proj, "total": own["total"] - own["proj"] + proj + seen, "photo": seen}


@dataclass(frozen=True)
class _Costs:
    """The exact energy over particles, as costs of a pairwise MRF.

    Attributes:
        data: Numbers of the energy.
        weights: Its constants.
        photo: Photometric term; None for the flow alone.
        options: Kinds of proposals: walks may reach any depth.
        rays: Where visibility is imposed, see `EnergyData.visibility_ray`.
        min_facing: Least facing there.
        pairs: Costs of pairs of particles.
        near: (N, K) neighbours of every superpixel.
    """

    data: EnergyData
    weights: Weights
    photo: Photometric | None
    options: RefineOptions
    rays: Float
    min_facing: float
    pairs: PairCosts
    near: Int

    def of(self, best: Soup, p: Particles) -> tuple[Float, NDArray[np.floating]]:
        """Unary and pairwise costs of particles; what is not feasible costs infinitely much."""
        data = self.data
        flow = self.photo.costs_of_flow if self.photo else unary_costs
        unary, ahead = flow(p, data, self.weights)
        unit = float(np.sum(data.share * best.distance))
        if not data.local_units:
            slope = length_slope(best, data, self.weights)
            unary -= slope * data.share[:, None] * (p.D - best.distance[:, None]) / unit
        if self.photo is not None:
            unary += self.photo.costs(p, self.photo.unit(best))
        allowed = ahead & feasible(p, self.rays, self.min_facing)
        if self.options.proposals != "walks":
            allowed &= within_reach(p, best, self.near, data.anchor_ray, DEPTH_REACH)
        unary[~allowed] = np.inf
        # the current belief is allowed even where it violates a constraint
        lost = ~np.isfinite(unary[:, 0])
        if lost.any():
            exact = self.weights.proj * oracle.reprojection(best, data, self.weights)
            unary[lost, 0] = np.minimum(exact, 1e9)[lost]
        # single precision suffices: a choice is taken only where the exact energy falls
        return unary, self.pairs.tables(p, unit, np.float32)


def length_slope(soup: Soup, data: EnergyData, weights: Weights) -> float:
    """`-dE / d log u`: by how much E rises when the scene's length unit shrinks, all else fixed."""
    h = 1e-4
    up, down = (
        oracle.energy(
            soup, replace(data, edge_unit=data.edge_unit * s, pair_unit=data.pair_unit * s), weights
        )["total"]
        for s in (1 + h, 1 - h)
    )
    return (down - up) / (2 * h)


class _Rounds:
    """The rounds of a refinement.

    Attributes:
        best: Soup of the lowest energy so far.
        energy: Its energy by term, see `objective`.
        kept: Particles that the next round uses besides its proposals.
        done: Rounds that have ended.
        agreed: Whether images and flow agree, so that one round is enough.
    """

    def __init__(
        self,
        costs: _Costs,
        proposer: Proposer,
        watch: Watch,
        best: Soup,
        energy: Mapping[str, float],
        deadline: float,
    ) -> None:
        """Draw nothing yet; `deadline` is a time of `time.perf_counter`."""
        self.costs, self.proposer, self.watch = costs, proposer, watch
        self.best, self.energy, self.deadline = best, energy, deadline
        walks_only = costs.options.proposals == "walks"
        self.shares = {k: v for k, v in SHARES.items() if not walks_only or k in WALKS}
        self.kept: Particles | None = None
        self.done: list[Round] = []
        photo = costs.photo
        self.agreed = photo is not None and photo.contradicted.mean() < CONTRADICTED

    def run(self) -> str:
        """Run all rounds; returns the status of `Refined`."""
        o, slow, interrupted = self.costs.options, False, False
        most = min(1, o.rounds) if self.agreed else o.rounds
        while len(self.done) < most and not (slow or interrupted or self._over()):
            before = self.energy["total"]
            interrupted = self._round()
            self.watch.say(f"refine {len(self.done)}: {self.done[-1]}")
            slow = before - self.energy["total"] < o.stagnation * abs(before)
        if interrupted or self.watch.stop.is_set():
            return "interrupted"
        if slow:
            return "stagnated"
        if len(self.done) < most:
            return "time limit"
        return "agreed" if most < o.rounds else "rounds"

    def _over(self) -> bool:
        """Whether the stop event is set or the time limit has passed."""
        return self.watch.stop.is_set() or time.perf_counter() > self.deadline

    def _draw(self) -> Proposals:
        """The current belief, the kept particles and new proposals, `particles` in all."""
        current, near = Particles.of(self.best), self.proposer.near
        fixed = current if self.kept is None else current.joined(self.kept)
        have = fixed.shape[1]
        count = counts(self.shares, max(0, self.costs.options.particles - have), near.shape[1])
        kind, step = np.full(have, KEPT), np.full((len(near), have), np.nan)
        kind[0] = CURRENT
        if not sum(count.values()):
            return Proposals(fixed, kind, step)
        new = self.proposer.propose(self.best, count)
        kinds, steps = np.concatenate([kind, new.kind]), np.hstack([step, new.step])
        return Proposals(fixed.joined(new.particles), kinds, steps)

    def _round(self) -> bool:
        """Run one round; returns whether TRW-S was interrupted, which ends the refinement."""
        mark, costs, o = time.perf_counter(), self.costs, self.costs.options
        drawn = self._draw()
        p, edges, none = drawn.particles, costs.pairs.edges, np.zeros(len(self.best), np.int64)
        unary, pairwise = costs.of(self.best, p)
        result = solve_trws(
            unary,
            edges,
            pairwise,
            max_iter=TRWS_ITERATIONS,
            gap=TRWS_GAP,
            dtype=pairwise.dtype,
            init_labels=none,
            polish=True,
            callback=partial(self._follow, mark),
        )
        # TRW-S answers Ctrl-C too with the best labels so far
        interrupted = result.status == "interrupted" and time.perf_counter() <= self.deadline
        new = p.soup(result.labels, costs.data.share).retracted()
        energy = objective(new, costs.data, costs.weights, costs.photo)
        taken = energy["total"] < self.energy["total"]
        labels = result.labels if taken else none
        if taken:
            self.best, self.energy = new, energy
        cost = conditional_costs(labels, unary, edges, pairwise)
        self.kept = p.take(diverse(p, labels, cost, round(KEPT_SHARE * o.particles), costs.data))
        proposed = _by_kind(drawn.kind, np.isfinite(unary).sum(axis=0))
        kind, step = drawn.kind[labels], drawn.step[np.arange(len(labels)), labels]
        accepted = _by_kind(kind, np.ones(len(labels), np.int64))
        done = Round(
            energy=dict(self.energy),
            mrf_energy=result.energy,
            bound=result.lower_bound,
            iterations=result.iterations,
            status=result.status,
            ties=result.ties,
            taken=taken,
            moved=int((labels > 0).sum()),
            proposed=proposed,
            accepted=accepted,
            seconds=time.perf_counter() - mark,
            spread=spread_of(p, result.min_marginals, costs.data.anchor_ray),
        )
        self.done.append(done)
        for name in (*WALKS, *COMMON):
            self.proposer.spread.learn(name, step[kind == KINDS.index(name)])
        relearn(self.shares, proposed, accepted)
        return interrupted

    def _follow(self, mark: float, k: int, bound: float, energy: float, least: float) -> bool:
        """Report an iteration of TRW-S; returns whether to stop after it."""
        if self.watch.listener:
            stage, seconds = f"refine {len(self.done) + 1}", time.perf_counter() - mark
            self.watch.listener(Progress(stage, k - 1, least, 0.0, seconds))
        return self._over()


def _by_kind(kind: Int, count: Int) -> dict[str, int]:
    """Sums of counts by kind."""
    total = np.bincount(kind, count, len(KINDS))
    return {k: int(total[c]) for c, k in enumerate(KINDS)}
