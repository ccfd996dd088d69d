"""Max-product particle belief propagation: the discrete optimisation of the paper (Sec. 4.4.2).

Every round draws particles around the current soup, writes the exact energy over them as a pairwise
MRF, finds a labelling of low energy with TRW-S, and continues from it. The current belief is
always particle 0 and a labelling is accepted only if it lowers the exact energy (`objective`),
which therefore never rises. Feasibility holds by construction: rotations by the exponential map,
normals on the sphere, positive distances, visibility by an infinite cost, the simplex by the free
global scale.

With one global length unit (`local_units` off) the unit `u = sum_i c_i D_i` couples everything.
The MRF then has u fixed and its first-order change in the unary costs; the comparison of rounds
is with the exact energy, at sum(lam) = 1.

TRW-S starts every round with messages of zero, because nearly all of its labels are new.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float
from soup_nlp.geometry.plane import tilt_to_camera
from soup_nlp.geometry.soup import Soup
from soup_nlp.model import oracle
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.mrf.trws import solve_trws
from soup_nlp.refine.particles import (
    NEIGHBOURS,
    WALKS,
    PairCosts,
    Particles,
    Proposer,
    counts,
    feasible,
    neighbours,
    unary_costs,
)
from soup_nlp.refine.photometric import Photometric
from soup_nlp.refine.records import Refined, RefineOptions, Round
from soup_nlp.storage.progress import Progress, Watch

TRWS_ITERATIONS, TRWS_GAP = 15, 1e-4
"""Most iterations of TRW-S in a round, and the relative gap at which it stops earlier."""
CONTRADICTED = 0.06
"""Share of superpixels whose flow the images contradict, below which there is one round: on such
pairs four rounds give the same MRE as one."""


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

    With images the energy is that of `objective`, and there is only one round where they contradict
    the flow of few superpixels.

    Args:
        soup: Current belief. Planes that break visibility are first tilted until they do not.
        data: Numbers of the energy.
        weights: Its constants.
        options: Rounds, particles, limits.
        start: The initialisation, whose objective is reported too; None for `soup`.
        photo: Photometric term; None for the flow alone.
        seed: Seed of all draws.
        min_facing: Visibility, as in the constrained NLP.
        depth_ratio: The same.
        watch: Listener of the iterations of TRW-S, stop event and log; a stop keeps the best soup.

    Returns:
        The best soup, normalised to sum(lam) = 1, and the record of the rounds.
    """
    begin = time.perf_counter()
    rays = data.visibility_ray(depth_ratio)
    best = tilt_to_camera(soup, data.anchor_ray, rays, min_facing)
    best = best.normalised(data.share).retracted()
    energy = objective(best, data, weights, photo)
    before = energy if start is None else objective(start, data, weights, photo)
    o = options or RefineOptions()
    rounds = Rounds(best, energy, data, weights, o, photo, (rays, min_facing), seed)
    status = rounds.run(watch or Watch(), time.process_time() + o.max_seconds)
    contradicted = 0 if photo is None else int(photo.contradicted.sum())
    ends, seconds = (before, energy, rounds.energy), time.perf_counter() - begin
    return Refined(rounds.best, *ends, tuple(rounds.done), status, seconds, contradicted)


def objective(
    soup: Soup, data: EnergyData, weights: Weights, photo: Photometric | None = None
) -> Mapping[str, float]:
    """Objective of the refinement by term: E; with images also E_photo, and a weaker E_proj where
    they contradict the flow (`Photometric.costs_of_flow`)."""
    E = oracle.energy(soup, data, weights)
    if photo is None:
        return E
    proj = float(photo.costs_of_flow(Particles.of(soup), data, weights)[0].sum())
    e_photo = photo.energy(soup)
    total = E["total"] - E["proj"] + proj + e_photo
    return {**E, "proj": proj, "total": total, "photo": e_photo}


def length_slope(soup: Soup, data: EnergyData, weights: Weights) -> float:
    """`-dE / d log u`: by how much E rises when the scene's length unit shrinks, all else fixed."""
    h = 1e-4
    units = [{k: getattr(data, k) * s for k in ("edge_unit", "pair_unit")} for s in (1 + h, 1 - h)]
    up, down = (oracle.energy(soup, replace(data, **u), weights)["total"] for u in units)
    return (down - up) / (2 * h)


@dataclass
class Rounds:
    """The rounds of a refinement.

    Attributes:
        best: Soup of the lowest energy so far; at first the soup to begin with.
        energy: Its energy by term, see `objective`.
        visibility: (N, V, 3) rays where visibility is imposed, and the least facing there.
        done: Rounds that have ended.

    The others are arguments of `refine_soup`.
    """

    best: Soup
    energy: Mapping[str, float]
    data: EnergyData
    weights: Weights
    options: RefineOptions
    photo: Photometric | None
    visibility: tuple[Float, float]
    seed: int
    done: list[Round] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.pairs = PairCosts(self.data, self.weights)
        near = neighbours(self.pairs.edges, self.data.anchor_ray)
        self.proposer = Proposer(self.data, near, self.seed)

    def run(self, watch: Watch, deadline: float) -> str:
        """Run all rounds until a time of `time.process_time`; returns the status of `Refined`."""
        o, photo, slow, interrupted = self.options, self.photo, False, False
        agreed = photo is not None and photo.contradicted.mean() < CONTRADICTED
        most = min(1, o.rounds) if agreed else o.rounds

        def over() -> bool:
            return watch.stop.is_set() or time.process_time() > deadline

        def follow(mark: float, k: int, bound: float, energy: float, least: float) -> bool:
            """Report an iteration of TRW-S; returns whether to stop after it."""
            if watch.listener:
                stage, seconds = f"refine {len(self.done) + 1}", time.perf_counter() - mark
                watch.listener(Progress(stage, k - 1, least, 0.0, seconds))
            return over()

        while len(self.done) < most and not (slow or interrupted or over()):
            before = self.energy["total"]
            self.done.append(self._round(follow))
            # TRW-S answers Ctrl-C too with the best labels so far
            interrupted = self.done[-1].status == "interrupted" and time.process_time() <= deadline
            watch.say(f"refine {len(self.done)}: {self.done[-1]}")
            slow = before - self.energy["total"] < o.stagnation * abs(before)
        if interrupted or watch.stop.is_set():
            return "interrupted"
        if slow:
            return "stagnated"
        if len(self.done) < most:
            return "time limit"
        return "agreed" if most < o.rounds else "rounds"

    def costs(self, p: Particles) -> tuple[Float, NDArray[np.floating]]:
        """The exact energy over particles as a pairwise MRF: unary costs, infinite for those that
        are infeasible, and pairwise ones."""
        data, best, photo = self.data, self.best, self.photo
        flow = photo.costs_of_flow if photo else unary_costs
        unary, allowed = flow(p, data, self.weights)
        unit = float(np.sum(data.share * best.distance))
        if not data.local_units:
            slope = length_slope(best, data, self.weights)
            unary -= slope * data.share[:, None] * (p.D - best.distance[:, None]) / unit
        if photo is not None:
            unary += photo.costs(p, photo.unit(best))
        allowed &= feasible(p, *self.visibility)
        unary[~allowed] = np.inf
        # the current belief is allowed even where it violates a constraint
        forbidden = ~np.isfinite(unary[:, 0])
        if forbidden.any():
            exact = self.weights.proj * oracle.values("proj", best, data, self.weights)
            unary[forbidden, 0] = np.minimum(exact, 1e9)[forbidden]
        # single precision suffices: a choice is taken only where the exact energy falls
        return unary, self.pairs.tables(p, unit, np.float32)

    def _draw(self) -> Particles:
        """The current belief and proposals."""
        parts = [Particles.of(self.best)]
        shares = WALKS if self.options.proposals == "walks" else {**WALKS, **NEIGHBOURS}
        remaining = max(0, self.options.particles - 1)
        near = self.proposer.near.shape[1]
        for kind, count in counts(shares, remaining, near).items():
            if count:
                parts.append(self.proposer.propose(self.best, kind, count))
        return parts[0].joined(*parts[1:])

    def _round(self, follow: Callable[..., bool]) -> Round:
        """Draw particles, choose among them, and go on from the choice if its energy is lower."""
        mark, data = time.perf_counter(), self.data
        p = self._draw()
        unary, pairwise = self.costs(p)
        result = solve_trws(
            unary,
            self.pairs.edges,
            pairwise,
            max_iter=TRWS_ITERATIONS,
            gap=TRWS_GAP,
            init_labels=np.zeros(len(unary), np.int64),
            callback=partial(follow, mark),
        )
        new = p.soup(result.labels, data.share).retracted()
        energy = objective(new, data, self.weights, self.photo)
        taken = energy["total"] < self.energy["total"]
        labels = result.labels if taken else np.zeros_like(result.labels)
        if taken:
            self.best, self.energy = new, energy
        return Round(
            energy=dict(self.energy),
            mrf_energy=result.energy,
            bound=result.lower_bound,
            iterations=result.iterations,
            status=result.status,
            taken=taken,
            moved=int((labels > 0).sum()),
            seconds=time.perf_counter() - mark,
        )
