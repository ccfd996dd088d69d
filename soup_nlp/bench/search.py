"""Search for better default options by Optuna, with two checks of the result.

Trial t000 is the default. Two checks follow the search: one family of pairs at a time is held out
of the choice, and the best trials are scored on validation pairs. The same seed, pairs and code
give the same trials, and an interrupted search can be continued.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from soup_nlp.bench.accuracy import measure_pair
from soup_nlp.bench.study import (
    Cell,
    Measure,
    Overrides,
    failures,
    main_metric,
    markdown,
    measure_cells,
    page_text,
    provenance,
)
from soup_nlp.bench.suites import Item
from soup_nlp.errors import ConfigError
from soup_nlp.storage.rows import MeasureRows

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

FAILED_LOSS = math.log(3.0)
"""Loss of a failed pair: that of an error three times that of a constant depth."""
MIN_MRE = 2e-3
"""MRE below which the loss does not decrease any further."""
LOSS_ALLOWED = 0.05
"""Largest relative increase of the MRE of a held-out family."""
TOP = 10
"""Number of trials in the table."""
DEFAULT_SPACE = (
    "energy.weights.arap=log:0.02:1.0",
    "energy.weights.cont=log:3e-5:3e-3",
    "energy.weights.orient=log:5e-4:5e-2",
    "energy.weights.sigma_arap=log:0.3:5.0",
    "energy.weights.sigma_cont=log:0.3:5.0",
    "segmentation.neighbours=int:8:20",
    "start.smoothness=log:0.1:2.0",
)
"""Parameters that are varied by default. The weight of E_proj is 1, since only ratios matter."""
DEFAULT = "t000"

Space = Mapping[str, "BaseDistribution"]


def parse_space(texts: Sequence[str]) -> Space:
    """Optuna's distributions of KEY=log|linear|int:LOW:HIGH and KEY=choice:A:B, by key.

    Raises:
        ConfigError: a text has none of these forms, or Optuna is not installed.
    """
    try:
        from optuna import distributions as known
    except ImportError as error:
        hint = "pip install 'soup-nlp[bench]'"
        raise ConfigError("bench search needs optuna", hint=hint) from error
    makers = {
        "log": lambda a, b: known.FloatDistribution(float(a), float(b), log=True),
        "linear": lambda a, b: known.FloatDistribution(float(a), float(b)),
        "int": lambda a, b: known.IntDistribution(int(a), int(b)),
        "choice": lambda a, b, *more: known.CategoricalDistribution((a, b, *more)),
    }
    out: dict[str, BaseDistribution] = {}
    for text in texts:
        key, _, rest = text.partition("=")
        kind, *values = rest.split(":")
        try:
            out[key] = makers[kind](*values)
            good = bool(key) and (kind == "choice" or float(values[0]) < float(values[1]))
        except (KeyError, TypeError, ValueError):
            good = False
        if not good:
            raise ConfigError(
                "not a parameter to search",
                where="--param",
                found=text,
                expected="energy.weights.cont=log:1e-5:1e-3; KEY=linear|int:LOW:HIGH, choice:A:B",
            )
    return out


def as_yaml(value: Any) -> str:
    """A suggested value as YAML, floats with four digits."""
    if not isinstance(value, float):
        return str(value)
    text = f"{value:.4g}"
    return text if "." in text or "e" in text else f"{text}.0"


def pair_loss(frame: pd.DataFrame) -> pd.Series:
    """ln(MRE / MRE of a constant depth) of every row, at most FAILED_LOSS, that of a failed pair.

    With the logarithm, halving the error counts the same on easy and on hard pairs.
    """
    constant = main_metric(frame, "constant").clip(lower=MIN_MRE)
    loss = np.log(frame["mre"].clip(lower=MIN_MRE) / constant)
    good = frame["ok"].eq(True)
    return loss.where(good).fillna(FAILED_LOSS).clip(upper=FAILED_LOSS)


def search(
    space: Space,
    train: Sequence[Item],
    validation: Sequence[Item],
    path: Path,
    measure_rows: MeasureRows,
    *,
    trials: int = 24,
    finalists: int = 3,
    seed: int = 0,
    overrides: Overrides = (),
    measure: Measure = measure_pair,
) -> pd.DataFrame:
    """Search and validate.

    Args:
        space: Parameters that are varied.
        train: Training pairs.
        validation: Validation pairs; none of them may be a training pair.
        path: JSON-lines file of rows.
        measure_rows: `storage.rows.measure_all` with its options.
        trials: Number of configurations beside the default.
        finalists: Number of best trials that are validated beside the default.
        seed: Seed of the sampler.
        overrides: Overrides of every problem; those of a trial come after them.
        measure: Makes the row of a pair.

    Returns:
        The frame of all rows: "variant" is the trial, "side" is "train" or "validation", "loss"
        that of the pair, "settings" the overrides of the trial as text.

    Raises:
        ConfigError: there is no training pair, a pair is in both sets, or a parameter is wrong.
    """
    _check(space, train, validation)
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed))
    chosen: dict[str, Overrides] = {DEFAULT: ()}
    frames = []

    def scored(name: str, items: Sequence[Item], side: str) -> float:
        cells = [Cell(i, (*overrides, *chosen[name]), name) for i in items]
        frame = measure_cells(cells, measure, path, measure_rows)
        frame["side"], frame["loss"] = side, pair_loss(frame)
        frame["settings"] = " ".join(f"`{o}`" for o in chosen[name]) or "-"
        frames.append(frame)
        return float(frame["loss"].mean())

    losses = {DEFAULT: scored(DEFAULT, train, "train")}
    for k in range(1, trials + 1):
        trial, name = study.ask(dict(space)), f"t{k:03d}"
        chosen[name] = tuple(f"{key}={as_yaml(v)}" for key, v in trial.params.items())
        losses[name] = scored(name, train, "train")
        study.tell(trial, losses[name])
    best = sorted(list(losses)[1:], key=lambda name: losses[name])[:finalists]
    for name in [DEFAULT, *best] if validation else []:
        scored(name, validation, "validation")
    return pd.concat(frames, ignore_index=True)


def _check(space: Space, train: Sequence[Item], validation: Sequence[Item]) -> None:
    if not train:
        raise ConfigError("no training pair", where="search")
    both = {(i.suite, i.name) for i in train} & {(i.suite, i.name) for i in validation}
    if both:
        raise ConfigError("a pair both trains and validates", found="/".join(min(both)))
    for key, distribution in space.items():
        ends = getattr(distribution, "choices", None) or (distribution.low, distribution.high)
        for value in ends:
            train[0].problem([f"{key}={as_yaml(value)}"])


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


def leave_one_family_out(frame: pd.DataFrame) -> pd.DataFrame:
    """Hold out every family (sequence) in turn; empty if there is only one.

    Returns:
        By family: "trial", the best one on all other families, and "change", that of the geometric
        mean of the MRE over the held-out family, relative to the default.
    """
    train = frame[frame["side"] == "train"]
    losses = train.groupby(["variant", "sequence"])["loss"].agg(["sum", "size"])
    sums, sizes = losses["sum"].unstack(), losses["size"].unstack()
    lines = {}
    for family in sums.columns if len(sums.columns) > 1 else []:
        others = sums.drop(columns=family).sum(axis=1) / sizes.drop(columns=family).sum(axis=1)
        within = sums[family] / sizes[family]
        trial = str(others.idxmin())
        lines[family] = {"trial": trial, "change": math.expm1(within[trial] - within[DEFAULT])}
    out = pd.DataFrame.from_dict(lines, orient="index", columns=["trial", "change"])
    return out.rename_axis("family left out")


def accepted(left_out: pd.DataFrame) -> bool:
    """Whether the held-out families gain in total and none loses more than LOSS_ALLOWED."""
    change = left_out["change"].astype(float)
    return len(change) > 0 and np.log1p(change).sum() < 0 and change.max() <= LOSS_ALLOWED


def search_page(frame: pd.DataFrame, space: Sequence[str], command: str) -> str:
    """Page of a search: verdict, trials, one family left out at a time, every pair."""
    train = _trials(frame[frame["side"] == "train"])
    validated = _trials(frame[frame["side"] == "validation"])
    best = str(train.index[0])
    loss, default = train["score"][best], train["score"][DEFAULT]
    verdict = (
        f"{len(train) - 1} trials; the best on the training pairs is {best}: {loss:.3f} against"
        f" {default:.3f} of the default."
    )
    if best != DEFAULT and len(validated):
        after, before = validated["score"][best], validated["score"][DEFAULT]
        word = "holds" if after < before else "does not hold"
        verdict += f" On the validation pairs {after:.3f} against {before:.3f}: the gain {word}."
    score = (
        "Score: mean over pairs of ln(MRE / MRE of a constant depth), MRE under the pair's own"
        f" convention and at least {MIN_MRE:g}; {FAILED_LOSS:.2f} for a pair that fails. Lower is"
        " better; -0.69 is half the error of a constant depth."
    )
    lines = ["# Search for defaults", "", verdict, "", f"{provenance(frame)}.", ""]
    lines += [f"    {command}", "", score, "", "## What was varied", ""]
    lines += [*(f"- `{text}`" for text in space), "", "## Trials on the training pairs", ""]
    lines += [*markdown(train.head(TOP), ".3f"), ""]
    left_out = leave_one_family_out(frame)
    if len(left_out):
        met = "met" if accepted(left_out) else "not met"
        about = (
            "MRE of the trial that the other families choose against the default. A change of"
            f" defaults must gain together and lose at most {LOSS_ALLOWED:.0%} on any: {met}."
        )
        lines += ["## One family left out at a time", "", about, ""]
        lines += [*markdown(left_out, {"change": "+.1%"}), ""]
    if len(validated):
        lines += ["## Validation pairs", "", *markdown(validated, ".3f"), ""]
    both = frame[frame["variant"].isin([DEFAULT, best])]
    pairs = both.pivot(index=["title", "side"], columns="variant", values="mre").astype(float)
    lines += ["## By pair, MRE", "", *markdown(pairs.reset_index("side"))]
    return page_text([*lines, *failures(frame)])


def _trials(frame: pd.DataFrame) -> pd.DataFrame:
    """Score, mean MRE, failures and settings by trial, the best first."""
    groups = frame.groupby("variant")
    table = pd.DataFrame(
        {
            "score": groups["loss"].mean(),
            "mean MRE": groups["mre"].mean(),
            "failed": groups["ok"].agg(lambda ok: str(int(ok.ne(True).sum()))),
            "settings": groups["settings"].first(),
        }
    )
    return table.sort_values("score", kind="stable").rename_axis("trial")
