"""The record of a search: what was varied, in which range, scored how, with what result."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import spearmanr

from soup_nlp.bench.rows import Row
from soup_nlp.bench.tables import energy_ratio, joined, made, main_metric, mean, show, table, titles
from soup_nlp.bench.tuning import ABOVE, FAILED, LEAST, Found, Parameter, Trial, loss

TOP = 10
"""Trials that the record prints."""


def text_search(found: Found, command: str) -> str:
    """Markdown of a search.

    Args:
        found: The search.
        command: How it was started, so that it can be repeated.
    """
    best, default = found.best, found.train[0]
    rows = [r for t in found.train for r in t.rows]
    lines = [
        "# Search for defaults",
        "",
        _verdict(found),
        "",
        f"{made(rows)}.",
        "",
        f"    {command}",
        "",
        "## Score",
        "",
        "Mean over pairs of ln(MRE / MRE of a constant depth), MRE under the pair's own convention"
        f" and at least {LEAST:g}; plus ln(E(truth) / E(solution) / {ABOVE:g}) where the truth has"
        f" a soup and that is positive; {FAILED:.2f} for a pair that fails. Lower is better;"
        " -0.69 is half the error of a constant depth.",
        "",
        "## What was varied",
        "",
        *_varied(found, best),
        "",
        "## Trials on the training pairs",
        "",
        *_trials(sorted(found.train, key=lambda t: t.loss)[:TOP], default),
        "",
    ]
    if found.validation:
        lines += ["## Validation pairs", "", *_trials(found.validation, found.validation[0]), ""]
    lines += ["## By pair", "", *_by_pair("train", default.rows, best.rows)]
    if found.validation:
        own = {t.name: t for t in found.validation}
        lines += ["", *_by_pair("validation", own["t000"].rows, _winner(found).rows)]
    return joined(lines)


def _winner(found: Found) -> Trial:
    """The training's best, with its rows on the validation pairs."""
    own = {t.name: t for t in found.validation}
    return own[found.best.name]


def _verdict(found: Found) -> str:
    best, default = found.best, found.train[0]
    text = (
        f"{len(found.train) - 1} trials; the best on the training pairs is {best.name}:"
        f" {best.loss:.3f} against {default.loss:.3f} of the default."
    )
    if not found.validation:
        return f"{text} Nothing was validated."
    own = _winner(found)
    before = found.validation[0].loss
    held = "holds" if own.loss < before else "does not hold"
    if best.name == "t000":
        return f"{text} The default stays."
    return f"{text} On the validation pairs {own.loss:.3f} against {before:.3f}: the gain {held}."


def _varied(found: Found, best: Trial) -> list[str]:
    """Ranges, the best value, and how the score moves with each parameter."""
    tried = found.train[1:]
    chosen = dict(o.split("=", 1) for o in best.overrides)
    entries = [
        [
            f"`{p.key}`",
            p.kind,
            ", ".join(p.values) if p.kind == "choice" else f"{p.values[0]} to {p.values[1]}",
            chosen.get(p.key, "default"),
            _tendency(p, k, tried),
        ]
        for k, p in enumerate(found.space)
    ]
    head = ["setting", "scale", "range", "best trial", "rank correlation with the score"]
    return table(head, entries)


def _tendency(p: Parameter, k: int, tried: Sequence[Trial]) -> str:
    """Spearman's correlation of a setting and the loss; positive: larger is worse."""
    if len(tried) < 5:
        return "-"
    x = [t.unit[k] for t in tried]
    y = [t.loss for t in tried]
    if np.ptp(x) == 0 or np.ptp(y) == 0:
        return "-"
    return f"{float(spearmanr(x, y).statistic):+.2f}"


def _trials(trials: Sequence[Trial], default: Trial) -> list[str]:
    entries = []
    for t in trials:
        good = [r for r in t.rows if r.get("ok")]
        entries.append(
            [
                t.name if t.name != default.name else f"{t.name} (default)",
                f"{t.loss:.3f}",
                show(mean(main_metric(r) for r in good)),
                show(mean(energy_ratio(r) for r in good), ".2f"),
                str(len(t.rows) - len(good)),
                " ".join(f"`{o}`" for o in t.overrides) or "-",
            ]
        )
    return table(
        ["trial", "score", "mean MRE", "E truth / solution", "failed", "settings"], entries
    )


def _by_pair(side: str, before: Sequence[Row], after: Sequence[Row]) -> list[str]:
    own = {_name(r): r for r in after}
    entries = []
    for title, row in zip(titles(before), before, strict=True):
        other = own[_name(row)]
        entries.append(
            [
                *[title, side],
                show(main_metric(row, method="constant")),
                *[show(main_metric(r)) for r in (row, other)],
                *[f"{loss(r):.3f}" for r in (row, other)],
            ]
        )
    head = ["pair, flow", "side", "constant", "MRE default", "MRE best", "score default", "best"]
    return table(head, entries)


def _name(row: Row) -> str:
    return f"{row['suite']} {row['pair']} {row['flow']}"
