"""The page of a search: parameters, ranges, score, trials and validation."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from soup_nlp.bench.tables import (
    columns,
    energy_ratio,
    main_metric,
    mean,
    page_text,
    provenance,
    show,
    table,
    titles,
)
from soup_nlp.bench.tuning import (
    FAILED_LOSS,
    LOSS_ALLOWED,
    MAX_ENERGY_RATIO,
    MIN_MRE,
    Found,
    Parameter,
    Trial,
    accepted,
    leave_one_family_out,
    loss,
)
from soup_nlp.storage.rows import Row

TOP = 10
"""Number of trials in the table."""


def text_search(found: Found, command: str) -> str:
    """Markdown of a search."""
    best, default = found.best, found.train[0]
    own = {t.name: t for t in found.validation}
    rows = [r for t in found.train for r in t.rows]
    score = (
        "Mean over pairs of ln(MRE / MRE of a constant depth), MRE under the pair's own convention"
        f" and at least {MIN_MRE:g}; plus ln(E(truth) / E(solution) / {MAX_ENERGY_RATIO:g}) where"
        f" the truth has a soup and that is positive; {FAILED_LOSS:.2f} for a pair that fails."
        " Lower is better; -0.69 is half the error of a constant depth."
    )
    top = sorted(found.train, key=lambda t: t.loss)[:TOP]
    sections = {
        "Score": [score],
        "What was varied": _varied(found, best),
        "Trials on the training pairs": _trials(top, default),
        "One family left out at a time": _left_out(found),
        "Validation pairs": _trials(found.validation, default) if own else [],
        "By pair": _by_pair("train", default.rows, best.rows),
    }
    if own:
        sections["By pair"] += ["", *_by_pair("validation", own["t000"].rows, own[best.name].rows)]
    lines = [
        "# Search for defaults",
        "",
        _verdict(found),
        "",
        f"{provenance(rows)}.",
        "",
        f"    {command}",
    ]
    for title, text in sections.items():
        if text:
            lines += ["", f"## {title}", "", *text]
    return page_text(lines)


def _verdict(found: Found) -> str:
    best, default = found.best, found.train[0]
    text = (
        f"{len(found.train) - 1} trials; the best on the training pairs is {best.name}:"
        f" {best.loss:.3f} against {default.loss:.3f} of the default."
    )
    if not found.validation:
        return f"{text} Nothing was validated."
    if best.name == default.name:
        return f"{text} The default stays."
    before, own = ({t.name: t.loss for t in found.validation}[t.name] for t in (default, best))
    held = "holds" if own < before else "does not hold"
    return f"{text} On the validation pairs {own:.3f} against {before:.3f}: the gain {held}."


def _left_out(found: Found) -> list[str]:
    """Table: for every family, the trial chosen by the other families and the change it makes."""
    families = leave_one_family_out(found.train)
    if not families:
        return []
    changes = [f.change for f in families]
    whole = np.expm1(np.mean(np.log1p(changes)))
    text = (
        "Every family in turn has no part in the choice; MRE (geometric mean of the family) of the"
        f" trial that the others choose against the default. Together {whole:+.1%}, the worst"
        f" {max(changes):+.1%}; a change of defaults must gain together and lose at most"
        f" {LOSS_ALLOWED:.0%} on any family: {'met' if accepted(families) else 'not met'}."
    )
    lines = [[f.family, f.trial, f"{f.change:+.1%}"] for f in families]
    return [text, "", *table(["family left out", "chosen by the others", "change of MRE"], lines)]


def _varied(found: Found, best: Trial) -> list[str]:
    """Table: range and best value of every parameter."""
    chosen = dict(o.split("=", 1) for o in best.overrides)
    cells: dict[str, Callable[[Parameter], str]] = {
        "setting": lambda p: f"`{p.key}`",
        "scale": lambda p: p.kind,
        "range": lambda p: (", " if p.kind == "choice" else " to ").join(p.values),
        "best trial": lambda p: chosen.get(p.key, "default"),
    }
    return columns(cells, found.space)


def _trials(trials: Sequence[Trial], default: Trial) -> list[str]:
    cells: dict[str, Callable[[Trial], str]] = {
        "trial": lambda t: t.name if t.name != default.name else f"{t.name} (default)",
        "score": lambda t: f"{t.loss:.3f}",
        "mean MRE": lambda t: show(mean(main_metric(r) for r in t.rows)),
        "E truth / solution": lambda t: show(
            mean(energy_ratio(r) for r in t.rows if r.get("ok")), ".2f"
        ),
        "failed": lambda t: str(sum(not r.get("ok") for r in t.rows)),
        "settings": lambda t: " ".join(f"`{o}`" for o in t.overrides) or "-",
    }
    return columns(cells, trials)


def _by_pair(side: str, before: Sequence[Row], after: Sequence[Row]) -> list[str]:
    entries = [
        [
            *(title, side, show(main_metric(old, method="constant"))),
            *(show(main_metric(r)) for r in (old, new)),
            *(f"{loss(r):.3f}" for r in (old, new)),
        ]
        for title, old, new in zip(titles(before), before, after, strict=True)
    ]
    head = ["pair, flow", "side", "constant", "MRE default", "MRE best", "score default", "best"]
    return table(head, entries)
