"""Random search for better default options, with two checks of the result.

Trial 0 is the default. The first half of the trials covers the ranges evenly (scrambled Sobol
sequence); the others vary the best trial so far with a decreasing radius. Two checks follow: one
family of pairs at a time is held out of the choice, and the best trials are scored on validation
pairs. The same seed, pairs and code give the same trials, and an interrupted search can be
continued.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import qmc

from soup_nlp.arrays import Float
from soup_nlp.bench.accuracy import Measure, measure_pair, pair_job
from soup_nlp.bench.suite_pairs import Item
from soup_nlp.bench.tables import energy_ratio, main_metric
from soup_nlp.errors import ConfigError
from soup_nlp.storage.rows import MeasureRows, Row, measure_all

FAILED_LOSS = math.log(3.0)
"""Loss of a failed pair: that of an error three times that of a constant depth."""
MIN_MRE = 2e-3
"""MRE below which the loss does not decrease any further."""
MAX_ENERGY_RATIO = 1.10
"""E(truth) / E(solution) above which a penalty is added to the loss."""
LOSS_ALLOWED = 0.05
"""Largest relative increase of the MRE of a held-out family."""


@dataclass(frozen=True)
class Parameter:
    """An option (dotted key) with its range (low, high) or its choices, as YAML.

    `kind` is the scale of the range: "log", "linear", "int" or "choice".
    """

    key: str
    kind: str
    values: tuple[str, ...]

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
    """Parse key=log:LOW:HIGH, key=linear:LOW:HIGH, key=int:LOW:HIGH or key=choice:A:B.

    Raises:
        ConfigError: the text has none of these forms.
    """
    key, _, rest = text.partition("=")
    kind, *values = rest.split(":")
    try:
        if kind == "choice":
            good = len(values) >= 2
        else:
            low, high = (float(v) for v in values)
            good = kind in ("linear", "int", "log") and low < high and (kind != "log" or low > 0)
    except ValueError:
        good = False
    if not good or not key:
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
"""Parameters that are varied by default. The weight of E_proj is 1, since only ratios matter."""


@dataclass(frozen=True)
class Trial:
    """A configuration and its rows, one for each pair.

    `unit` (P,) is its position in the unit cube. The default is t000, without overrides and with a
    position of NaN.
    """

    name: str
    overrides: tuple[str, ...]
    unit: Float = field(repr=False)
    rows: tuple[Row, ...] = field(default=(), repr=False)

    @property
    def loss(self) -> float:
        """Mean loss of the rows; lower is better."""
        return float(np.mean([loss(r) for r in self.rows])) if self.rows else math.inf


def error(row: Row) -> float:
    """ln(MRE / MRE of a constant depth), at most `FAILED_LOSS`, which is that of a failed pair.

    With the logarithm, halving the error counts the same on easy and on hard pairs.
    """
    own, constant = main_metric(row), main_metric(row, method="constant")
    if own is None or constant is None:
        return FAILED_LOSS
    return min(math.log(max(own, MIN_MRE) / max(constant, MIN_MRE)), FAILED_LOSS)


def loss(row: Row) -> float:
    """Loss of a pair: its `error` plus a penalty if the energy is lower at the solution.

    If the row has E(truth), the penalty is ln(E(truth) / E(solution) / 1.1), at least 0: a minimum
    far from the truth shows a wrong model even if this start ends near the truth.
    """
    if main_metric(row) is None:
        return FAILED_LOSS
    return error(row) + max(0.0, math.log((energy_ratio(row) or 1.0) / MAX_ENERGY_RATIO))


class LeftOut(NamedTuple):
    """A held-out family of pairs, the best trial on all other families, and its change of the MRE.

    The change is that of the geometric mean over the held-out family, relative to the default.
    """

    family: str
    trial: str
    change: float


def leave_one_family_out(trials: Sequence[Trial]) -> tuple[LeftOut, ...]:
    """Hold out every family (sequence of rows) in turn; () if there is only one family.

    Args:
        trials: Trials with rows of the same pairs, the default first.
    """
    families = dict.fromkeys(r["sequence"] for r in trials[0].rows)
    if len(families) < 2:
        return ()

    def without(family: str, trial: Trial) -> float:
        return float(np.mean([loss(r) for r in trial.rows if r["sequence"] != family]))

    def within(family: str, trial: Trial) -> float:
        return float(np.mean([error(r) for r in trial.rows if r["sequence"] == family]))

    chosen = {f: min(trials, key=partial(without, f)) for f in families}
    return tuple(
        LeftOut(f, t.name, math.expm1(within(f, t) - within(f, trials[0])))
        for f, t in chosen.items()
    )


def accepted(left_out: Sequence[LeftOut]) -> bool:
    """Whether the held-out families gain in total and none loses more than `LOSS_ALLOWED`."""
    changes = [f.change for f in left_out]
    return bool(changes) and np.log1p(changes).sum() < 0 and max(changes) <= LOSS_ALLOWED


@dataclass(frozen=True)
class Found:
    """Result of a search: all trials on training pairs, the best ones on validation pairs."""

    space: tuple[Parameter, ...]
    train: tuple[Trial, ...]
    validation: tuple[Trial, ...]

    @property
    def best(self) -> Trial:
        """The trial with the least loss on the training pairs."""
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
    measure_rows: MeasureRows = measure_all,
    measure: Measure = measure_pair,
) -> Found:
    """Search and validate.

    Args:
        space: Parameters that are varied.
        train: Training pairs.
        validation: Validation pairs; none of them may be a training pair.
        path: JSON-lines file of rows.
        trials: Number of configurations beside the default.
        finalists: Number of best trials that are validated beside the default.
        seed: Seed of the trials.
        overrides: Overrides of every problem; those of a trial come after them.
        measure_rows: Measures the jobs; `measure_all` with its options.
        measure: Makes the row of a pair.

    Raises:
        ConfigError: there is no training pair, a pair is in both sets, or a parameter is wrong.
    """
    _check(space, train, validation)

    def scored(trial: Trial, items: Sequence[Item]) -> Trial:
        whole = (*overrides, *trial.overrides)
        jobs = [pair_job(i, whole, trial.name, measure=measure) for i in items]
        return replace(trial, rows=tuple(measure_rows(jobs, path)))

    first = Trial("t000", (), np.full(len(space), np.nan))
    done = [scored(first, train)]
    # the first half of the trials covers the space evenly
    half = max(1, (trials + 1) // 2)
    sampler = qmc.Sobol(len(space), scramble=True, rng=np.random.default_rng(seed))
    even = sampler.random_base2((half - 1).bit_length())[:half]
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


def _next(k: int, trials: int, even: Float, done: Sequence[Trial], seed: int) -> Float:
    """Position of trial k: evenly spread at first, later near the best trial so far."""
    if k <= len(even):
        return np.asarray(even[k - 1])
    rng = np.random.default_rng([seed, k])
    best = min((t for t in done if np.isfinite(t.unit).all()), key=lambda t: t.loss)
    share = (k - len(even)) / max(1, trials - len(even))
    radius = 0.3 * (1 - share) + 0.05
    step = rng.normal(0, radius, len(best.unit)) * (rng.random(len(best.unit)) < 0.5)
    moved = best.unit + step
    # reflect at the ends of the range
    return np.asarray(1 - np.abs(1 - np.abs(moved) % 2))


def split(
    items: Sequence[Item], seeds: Sequence[int], validation_seeds: Sequence[int]
) -> tuple[list[Item], list[Item]]:
    """(training, validation) pairs: rendered scenes by seed, real pairs alternately by name.

    All flows of a pair are in the same set.
    """
    real = sorted({i.name for i in items if "seed" not in i.input})
    train: list[Item] = []
    validation: list[Item] = []
    for item in items:
        seed = item.input.get("seed")
        if seed in validation_seeds or (seed is None and real.index(item.name) % 2):
            validation.append(item)
        elif seed is None or seed in seeds:
            train.append(item)
    return train, validation
