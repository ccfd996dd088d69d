"""Search for better default options by Optuna; every family tests what all others choose.

Trial t000 is the default. The same pairs and code give the same trials, and an interrupted
search can be continued.
"""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from soup_nlp.bench.accuracy import measure_pair
from soup_nlp.bench.study import (
    Cell,
    Item,
    Overrides,
    markdown,
    measure_cells,
    metric,
    page_text,
    pivot,
    provenance,
)
from soup_nlp.errors import ConfigError
from soup_nlp.storage.rows import MeasureRows, measure_all

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
    """Optuna's distributions of KEY=log|linear|int:LOW:HIGH, by key.

    Raises:
        ConfigError: a text does not have this form.
    """
    from optuna.distributions import FloatDistribution, IntDistribution

    makers = {
        "log": lambda a, b: FloatDistribution(float(a), float(b), log=True),
        "linear": lambda a, b: FloatDistribution(float(a), float(b)),
        "int": lambda a, b: IntDistribution(int(a), int(b)),
    }
    out: dict[str, BaseDistribution] = {}
    for text in texts:
        try:
            key, _, spec = text.partition("=")
            kind, low, high = spec.split(":")
            out[key] = makers[kind](low, high)
            if not key or not float(low) < float(high):
                raise ValueError(text)
        except (KeyError, ValueError) as error:
            expected = "energy.weights.cont=log:1e-5:1e-3, or KEY=linear|int:LOW:HIGH"
            raise ConfigError(
                "not a parameter to search", where="--param", found=text, expected=expected
            ) from error
    return out


def as_yaml(value: float) -> str:
    """A suggested value as YAML, floats with four digits."""
    return json.dumps(value if isinstance(value, int) else float(f"{value:.4g}"))


def pair_loss(frame: pd.DataFrame) -> pd.Series:
    """ln(MRE / MRE of a constant depth) of every row, at most FAILED_LOSS, the loss of a failure.

    With the logarithm, halving the error counts the same on easy and on hard pairs.
    """
    constant = metric(frame, "constant").clip(lower=MIN_MRE)
    loss = np.log(frame["mre"].clip(lower=MIN_MRE) / constant)
    good = frame["ok"].eq(True)
    return loss.where(good).fillna(FAILED_LOSS).clip(upper=FAILED_LOSS)


def search(
    space: Space,
    items: Sequence[Item],
    path: Path,
    measure_rows: MeasureRows = measure_all,
    trials: int = 24,
    overrides: Overrides = (),
) -> pd.DataFrame:
    """Measure trials that Optuna's TPE sampler suggests.

    Args:
        space: Parameters that are varied.
        items: Pairs.
        path: JSON-lines file of rows.
        measure_rows: `storage.rows.measure_all` with its options.
        trials: Number of configurations beside the default.
        overrides: Overrides of every problem; those of a trial come after them.

    Returns:
        The frame of all rows: "variant" is the trial, "loss" is the pair's loss, "settings" the
        overrides of the trial as text.

    Raises:
        ConfigError: a parameter is wrong.
    """
    for key, distribution in space.items():
        for value in (distribution.low, distribution.high):
            items[0].problem([f"{key}={as_yaml(value)}"])
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=0))
    frames = []
    for k in range(trials + 1):
        trial = study.ask(dict(space)) if k else None
        chosen = {} if trial is None else trial.params
        settings = tuple(f"{key}={as_yaml(v)}" for key, v in chosen.items())
        cells = [Cell(i, (*overrides, *settings), f"t{k:03d}") for i in items]
        frame = measure_cells(cells, measure_pair, path, measure_rows)
        frame["loss"] = pair_loss(frame)
        frame["settings"] = " ".join(f"`{o}`" for o in settings) or "-"
        frames.append(frame)
        if trial is not None:
            study.tell(trial, float(frame["loss"].mean()))
    return pd.concat(frames, ignore_index=True)


def leave_one_family_out(frame: pd.DataFrame) -> pd.DataFrame:
    """Hold out every family (sequence) in turn; empty if there is only one.

    Returns:
        By family: "trial", the best trial on all other families, and "change", the relative change
        of the geometric mean MRE over the held-out family against the default.
    """
    losses = frame.groupby(["variant", "sequence"])["loss"].agg(["sum", "size"])
    sums, sizes = losses["sum"].unstack(), losses["size"].unstack()
    lines = {}
    for family in sums.columns if len(sums.columns) > 1 else []:
        others = sums.drop(columns=family).sum(axis=1) / sizes.drop(columns=family).sum(axis=1)
        within, trial = sums[family] / sizes[family], str(others.idxmin())
        lines[family] = {"trial": trial, "change": math.expm1(within[trial] - within[DEFAULT])}
    out = pd.DataFrame.from_dict(lines, orient="index", columns=["trial", "change"])
    return out.rename_axis("family left out")


def accepted(left_out: pd.DataFrame) -> bool:
    """Whether the held-out families gain in total and none loses more than LOSS_ALLOWED."""
    change = left_out["change"].astype(float)
    return len(change) > 0 and np.log1p(change).sum() < 0 and change.max() <= LOSS_ALLOWED


def search_page(frame: pd.DataFrame, space: Sequence[str], command: str) -> str:
    """Page of a search: trials, one family left out at a time, every pair."""
    groups = frame.groupby("variant")
    trials = groups.agg(score=("loss", "mean"), mre=("mre", "mean"), settings=("settings", "first"))
    trials.insert(2, "failed", groups["ok"].agg(lambda ok: str(int(ok.ne(True).sum()))))
    trials = trials.sort_values("score", kind="stable").rename_axis("trial")
    trials = trials.rename(columns={"mre": "mean MRE"})
    best = str(trials.index[0])
    blocks = [
        "# Search for defaults",
        f"{len(trials) - 1} trials; the best is {best}: {trials['score'][best]:.3f} against"
        f" {trials['score'][DEFAULT]:.3f} of the default.",
        f"{provenance(frame)}.",
        f"    {command}",
        "Score: mean over pairs of ln(MRE / MRE of a constant depth), MRE at"
        f" least {MIN_MRE:g}; {FAILED_LOSS:.2f} for a pair that fails. Lower is"
        " better; -0.69 is half the error of a constant depth.",
        "## What was varied",
        "\n".join(f"- `{text}`" for text in space),
        "## Trials",
        markdown(trials.head(TOP), ".3f"),
    ]
    left_out = leave_one_family_out(frame)
    if len(left_out):
        blocks += [
            "## One family left out at a time",
            "MRE of the trial that the other families choose against the default. A change of"
            f" defaults must gain together and lose at most {LOSS_ALLOWED:.0%} on any:"
            f" {'met' if accepted(left_out) else 'not met'}.",
            markdown(left_out, {"change": "+.1%"}),
        ]
    both = frame[frame["variant"].isin([DEFAULT, best])]
    return page_text([*blocks, "## By pair, MRE", markdown(pivot(both, average=False))], frame)
