"""The analysis `rules`: effect of every rule of initialisation and energy, by family."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np

from soup_nlp.bench.analyses_report import by_pair, lines_by_pair, page_head
from soup_nlp.bench.tables import (
    failures,
    figure,
    main_metric,
    page_text,
    save,
    show,
    table,
    titles,
)
from soup_nlp.storage.rows import Row

SHIPPED = "shipped"
"""Name of the variant with all rules."""
NO_CHANGE = 0.01
"""Relative changes of a family's MRE up to this are not listed."""


def in_both(key: str, value: str) -> tuple[str, ...]:
    """Overrides of a weight for rigid and for bending surfaces."""
    return tuple(f"energy.{w}.{key}={value}" for w in ("weights", "bending.weights"))


RULES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        SHIPPED: (),
        "energy of bending surfaces": ("start.bending_price=4",),
        "camera at rest": ("start.at_rest=1",),
        "E_prior": in_both("prior", "0"),
        "E_prior holds what is over the ground": ("energy.prior_ground=null",),
        "E_arap weak across components": ("energy.arap_across=1",),
        "E_arap truncated": in_both("sigma_arap", ".inf"),
        "E_cont weak at occlusions": ("energy.cont_occluded=1",),
        "contact below": ("start.upright=false",),
        "ground": ("start.ground=false",),
        "flow behind a still layer": ("flow.see_through=false",),
        "second strategy of the presolve": ("energy.bending.untruncated=false",),
        "borders follow the flow": ("segmentation.follow_flow_px=null",),
    }
)
"""Overrides that switch a rule off, by name of the rule."""


def _changes(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Relative change of the MRE by rule and family: geometric mean over the pairs."""
    _, pairs = by_pair(rows, titles(rows))
    logs: dict[str, dict[str, list[float]]] = {}
    for own in pairs.values():
        shipped = main_metric(own[SHIPPED])
        for rule, row in own.items():
            without = main_metric(row)
            if rule != SHIPPED and shipped and without:
                family = logs.setdefault(rule, {}).setdefault(str(row["sequence"]), [])
                family.append(float(np.log(shipped / without)))
    return {
        rule: {family: float(np.expm1(np.mean(v))) for family, v in families.items()}
        for rule, families in logs.items()
    }


def text_rules(name: str, text: str, rows: Sequence[Row], note: str = "") -> str:
    """Page of the analysis: families that gain or lose by a rule, changes, MRE of every pair."""
    changes = _changes(rows)
    families = list(dict.fromkeys(f for own in changes.values() for f in own))
    summary, detail = [], []
    for rule, own in changes.items():
        better = sorted((c, f) for f, c in own.items() if c < -NO_CHANGE)
        worse = sorted(((c, f) for f, c in own.items() if c > NO_CHANGE), reverse=True)
        total = float(np.expm1(np.mean(np.log1p(list(own.values())))))
        summary.append(
            [
                *(rule, f"`{' '.join(RULES.get(rule, ()))}`", f"{total:+.1%}"),
                ", ".join(f"{f} {c:+.0%}" for c, f in better) or "-",
                ", ".join(f"{f} {c:+.0%}" for c, f in worse) or "-",
            ]
        )
        detail.append([rule, *(show(own.get(f), "+.1%") for f in families)])
    about = (
        "Change of the MRE that a rule brings: everything as shipped against the same without it;"
        " negative is better. Geometric means over the pairs of a family, and over the families."
        f" Changes up to {NO_CHANGE:.0%} are left out of the lists."
    )
    head = ["rule", "without", "all families", "better", "worse"]
    lines = [*page_head(name, text, rows, note), about, "", *table(head, summary), ""]
    lines += ["## By family", "", *table(["rule", *families], detail), ""]
    variants, _ = by_pair(rows, titles(rows))
    entries = lines_by_pair(rows, main_metric)
    lines += ["## MRE without each rule", "", *table(["pair, flow", *variants], entries), ""]
    return page_text([*lines, *failures(rows)])


def plot_rules(path: Path, rows: Sequence[Row]) -> None:
    """Heat map of the change of the MRE by rule and family."""
    changes = _changes(rows)
    families = list(dict.fromkeys(f for own in changes.values() for f in own))
    value = np.array([[own.get(f, np.nan) for f in families] for own in changes.values()])
    value = 100 * value.reshape(len(changes), len(families))
    picture = figure(2.5 + 0.55 * len(families), 1.8 + 0.38 * len(changes))
    ax = picture.add_subplot()
    shown = ax.imshow(value, cmap="RdBu_r", vmin=-50, vmax=50, aspect="auto")
    for (row, column), v in np.ndenumerate(value):
        if np.isfinite(v) and abs(v) >= 100 * NO_CHANGE:
            colour = "white" if abs(v) > 30 else "black"
            ax.text(column, row, f"{v:+.0f}", ha="center", va="center", color=colour, fontsize=8)
    ax.set_xticks(range(len(families)), families, rotation=45, ha="right")
    ax.set_yticks(range(len(changes)), list(changes))
    ax.set_title("Change of the MRE by each rule, per cent (blue: better with it)")
    picture.colorbar(shown, ax=ax, label="%")
    save(picture, path)
