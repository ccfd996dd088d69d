"""Search for defaults: what is varied in which range, scored how, on which pairs; repeatable.

Trial 0 is the default. The first trials fill the ranges evenly (scrambled Sobol sequence), the
others vary the best so far with a radius that shrinks. The best few are then scored on pairs that
had no part in the choice. The same seed, pairs and code give the same trials, and rows that are
already measured are not measured again, so a stopped search goes on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from soup_nlp.bench.accuracy import Measure, measure_pair, pair_job
from soup_nlp.bench.rows import Row, Say, Where, measure_all
from soup_nlp.bench.suite_pairs import Item
from soup_nlp.bench.tables import energy_ratio, main_metric
from soup_nlp.errors import ConfigError

Float = NDArray[np.float64]

FAILED = math.log(3.0)
"""Loss of a pair that failed: as if it were three times worse than a constant depth."""

LEAST = 2e-3
"""MRE below which a pair is not worth more."""

ABOVE = 1.10
"""E(truth) / E(solution) up to which nothing is charged."""


@dataclass(frozen=True)
class Parameter:
    """One setting and its range.

    Attributes:
        key: Dotted, as in a problem file.
        kind: "log", "linear", "int" or "choice".
        values: (low, high), or the choices as YAML.
    """

    key: str
    kind: str
    values: tuple[str, ...]

    def __str__(self) -> str:
        if self.kind == "choice":
            return f"{self.key} in {{{', '.join(self.values)}}}"
        return f"{self.key} in [{self.values[0]}, {self.values[1]}], {self.kind}"

    def at(self, x: float) -> str:
        """The value at a share x of the range, in [0, 1], as YAML."""
        if self.kind == "choice":
            return self.values[min(int(x * len(self.values)), len(self.values) - 1)]
        low, high = (float(v) for v in self.values)
        if self.kind == "log":
            return _number(low * (high / low) ** x)
        if self.kind == "int":
            return str(min(int(low + x * (high - low + 1)), int(high)))
        return _number(low + x * (high - low))


def _number(value: float) -> str:
    """A float as YAML reads it back as a float."""
    text = f"{value:.4g}"
    return text if "." in text or "e" in text else f"{text}.0"


def parameter(text: str) -> Parameter:
    """A parameter of a text: key=log:LOW:HIGH, key=linear:LOW:HIGH, key=int:.. or key=choice:A:B.

    Raises:
        ConfigError: it is none.
    """
    key, _, rest = text.partition("=")
    kind, *values = rest.split(":")
    good = bool(key) and kind in ("log", "linear", "int", "choice")
    if good and kind == "choice":
        good = len(values) >= 2
    elif good:
        try:
            low, high = (float(v) for v in values)
            good = low < high and (kind != "log" or low > 0)
        except ValueError:
            good = False
    if not good:
        raise ConfigError(
            "not a parameter to search",
            where="--param",
            found=text,
            expected="energy.weights.cont=log:1e-5:1e-3, or KEY=linear|int:LOW:HIGH, choice:A:B",
        )
    return Parameter(key, kind, tuple(values))


DEFAULT_SPACE = tuple(
    parameter(text)
    for text in (
        "energy.weights.arap=log:0.02:1.0",
        "energy.weights.cont=log:3e-5:3e-3",
        "energy.weights.orient=log:5e-4:5e-2",
        "energy.weights.sigma_arap=log:0.3:5.0",
        "energy.weights.sigma_cont=log:0.3:5.0",
        "energy.weights.sigma_proj=choice:.inf:5.0:2.0",
        "energy.arap_at_anchors=choice:false:true",
        "segmentation.beta=log:0.005:0.1",
        "segmentation.beta_colour=log:0.3:10.0",
        "segmentation.neighbours=int:8:20",
        "start.smoothness=log:0.1:2.0",
        "flow.reweight_px=choice:null:0.5:0.25",
        "flow.dis.tau=log:0.5:2.0",
    )
)
"""What is varied where nothing else is asked for. E_proj has weight 1: only ratios matter."""


@dataclass(frozen=True)
class Trial:
    """One configuration.

    Attributes:
        name: t000 is the default.
        overrides: Of every problem; () for the default.
        unit: (P,) place in the unit cube; NaN for the default.
        rows: One a pair.
    """

    name: str
    overrides: tuple[str, ...]
    unit: Float = field(repr=False)
    rows: tuple[Row, ...] = field(default=(), repr=False)

    @property
    def loss(self) -> float:
        """Score over its rows, lower is better."""
        return float(np.mean([loss(r) for r in self.rows])) if self.rows else math.inf


def loss(row: Row) -> float:
    """How bad a pair is: ln(MRE / MRE of a constant depth), and what the energy prefers to truth.

    The logarithm makes a pair that is twice as good count the same on easy and hard pairs. Where
    the truth has a soup, ln of E(truth) / E(solution) beyond 1.1 is added: a minimum far from the
    truth is a wrong model even where this start happens to end well.
    """
    if not row.get("ok"):
        return FAILED
    own, constant = main_metric(row), main_metric(row, method="constant")
    if own is None or constant is None:
        return FAILED
    value = min(math.log(max(own, LEAST) / max(constant, LEAST)), FAILED)
    ratio = energy_ratio(row)
    if ratio is not None and ratio > ABOVE:
        value += math.log(ratio / ABOVE)
    return value


@dataclass(frozen=True)
class Found:
    """A finished search.

    Attributes:
        space: Parameters.
        train: Trials with their rows on the training pairs, in order.
        validation: The default and the best trials with their rows on the validation pairs.
    """

    space: tuple[Parameter, ...]
    train: tuple[Trial, ...]
    validation: tuple[Trial, ...]

    @property
    def best(self) -> Trial:
        """The best on the training pairs."""
        return min(self.train, key=lambda t: t.loss)


def search(
    space: Sequence[Parameter],
    train: Sequence[Item],
    validation: Sequence[Item],
    path: Path,
    *,
    trials: int = 24,
    finalists: int = 3,
    seed: int = 0,
    overrides: tuple[str, ...] = (),
    where: Where | None = None,
    say: Say | None = None,
    any_code: bool = False,
    measure: Measure = measure_pair,
) -> Found:
    """Search and validate.

    Args:
        space: What is varied.
        train: Pairs that choose.
        validation: Pairs that check; none of them may be among the former.
        path: JSON-lines file of rows.
        trials: Configurations beside the default.
        finalists: So many of the best are validated, and the default.
        seed: Of the trials.
        overrides: Of every problem; trials come after them.
        where: Processes or cluster.
        say: Progress.
        any_code: Also take stored rows of other code versions.
        measure: Makes the row of a pair.

    Raises:
        ConfigError: pairs are missing or stand on both sides, a parameter is wrong, or no trial
            is to be validated.
    """
    if finalists < 1:
        raise ConfigError("no finalist", where="search", found=finalists, expected="at least 1")
    _check(space, train, validation)

    def scored(trial: Trial, items: Sequence[Item]) -> Trial:
        whole = (*overrides, *trial.overrides)
        jobs = [pair_job(i, whole, trial.name, measure=measure) for i in items]
        rows = measure_all(jobs, path, where, say=say, any_code=any_code)
        return Trial(trial.name, trial.overrides, trial.unit, tuple(rows))

    first = Trial("t000", (), np.full(len(space), np.nan))
    done = [scored(first, train)]
    even = _even(len(space), trials, seed)
    for k in range(1, trials + 1):
        unit = _next(k, trials, even, done, seed)
        names = tuple(f"{p.key}={p.at(x)}" for p, x in zip(space, unit, strict=True))
        done.append(scored(Trial(f"t{k:03d}", names, unit), train))
    best = sorted(done[1:], key=lambda t: t.loss)[:finalists]
    checked = [scored(t, validation) for t in [done[0], *best]] if validation else []
    return Found(tuple(space), tuple(done), tuple(checked))


def _check(space: Sequence[Parameter], train: Sequence[Item], validation: Sequence[Item]) -> None:
    if not train:
        raise ConfigError("no training pair", where="search")
    both = {(i.suite, i.name) for i in train} & {(i.suite, i.name) for i in validation}
    if both:
        raise ConfigError("a pair both trains and validates", found="/".join(min(both)))
    for p in space:
        for x in (0.0, 1.0):
            train[0].problem([f"{p.key}={p.at(x)}"])


def _even(dimensions: int, trials: int, seed: int) -> Float:
    """Half of the trials, spread evenly."""
    sampler = qmc.Sobol(dimensions, scramble=True, rng=np.random.default_rng(seed))
    count = max(1, (trials + 1) // 2)
    return np.asarray(sampler.random(1 << (count - 1).bit_length())[:count])


def _next(k: int, trials: int, even: Float, done: Sequence[Trial], seed: int) -> Float:
    """Place of trial k: even first, then near the best of those so far."""
    if k <= len(even):
        return np.asarray(even[k - 1])
    rng = np.random.default_rng([seed, k])
    best = min((t for t in done if np.isfinite(t.unit).all()), key=lambda t: t.loss)
    share = (k - len(even)) / max(1, trials - len(even))
    radius = 0.3 * (1 - share) + 0.05
    step = rng.normal(0, radius, len(best.unit)) * (rng.random(len(best.unit)) < 0.5)
    moved = best.unit + step
    # reflected at the ends of the range
    return np.asarray(1 - np.abs(1 - np.abs(moved) % 2))


def split(
    items: Sequence[Item], seeds: Sequence[int], validation_seeds: Sequence[int]
) -> tuple[list[Item], list[Item]]:
    """(training, validation) pairs: rendered scenes by seed, real pairs alternately by name.

    All flows of a pair are on one side.
    """
    real = sorted({i.name for i in items if "seed" not in i.input})
    odd = set(real[1::2])

    def among(item: Item, own_seeds: Sequence[int], names: set[str]) -> bool:
        seed = item.input.get("seed")
        return item.name in names if seed is None else seed in own_seeds

    train_seeds = [s for s in seeds if s not in validation_seeds]
    train = [i for i in items if among(i, train_seeds, set(real) - odd)]
    return train, [i for i in items if among(i, validation_seeds, odd)]
