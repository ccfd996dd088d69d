"""The factors of sigma: fitted to the errors of solved pairs, families left out in turn."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.optimize import minimize

from benchmarks.scores import sigma_scores
from benchmarks.table import markdown, panels, provenance, save
from soup_nlp.arrays import Float
from soup_nlp.evaluation.confidence import FACTORS, sigma_of
from soup_nlp.storage.each import Row

HEAVY = 4.0
"""Error, in sigma, from which it counts linearly: a few pixels that a wrong motion misses by far
would widen all of sigma."""
PULL = 1e-3
"""Loss by the squared change of the logarithm of a factor."""
SCORES = ("nll", "flat", "within1", "within2", "sure_wrong", "right_unsure", "ause")
"""Scores of sigma in the table of families, see `benchmarks.scores.sigma_scores`."""


def loss(error: Float, sigma: Float) -> float:
    """Mean negative log likelihood, errors beyond `HEAVY` sigma linear."""
    q = np.abs(error) / sigma
    return float(np.mean(np.where(q < HEAVY, q**2 / 2, HEAVY * q - HEAVY**2 / 2) + np.log(sigma)))


Pairs = dict[str, list[tuple[Float, dict[str, Float]]]]
"""Errors and terms of the pairs of every family."""


def pairs_of(frame: pd.DataFrame) -> Pairs:
    """Errors and terms of the rows that were measured with DIS flow, by family."""
    out: Pairs = {}
    columns = [column for column in frame if column.startswith("pixels.terms.")]
    for _, row in frame[frame["ok"].eq(True) & frame["flow"].eq("dis")].iterrows():
        terms = {name.removeprefix("pixels.terms."): np.array(row[name]) for name in columns}
        out.setdefault(row["family"], []).append((np.array(row["pixels.error"]), terms))
    return out


def mean_loss(pairs: Pairs, factor: Mapping[str, float]) -> float:
    """Mean over families of the mean over their pairs."""
    means = [np.mean([loss(e, sigma_of(t, factor)) for e, t in p]) for p in pairs.values()]
    return float(np.mean(means))


def fitted(pairs: Pairs) -> dict[str, float]:
    """The factors of least mean loss, from today's."""
    names, first = list(FACTORS), np.log(list(FACTORS.values()))

    def value(x: Float) -> float:
        # what no pair tells stays as it is
        pull = PULL * float(np.sum((x - first) ** 2))
        return mean_loss(pairs, dict(zip(names, np.exp(x), strict=True))) + pull

    bounds, options = [(-7.0, 3.0)] * len(first), {"maxiter": 4, "ftol": 1e-3, "xtol": 1e-2}
    best = minimize(value, first, method="Powell", bounds=bounds, options=options)
    return dict(zip(names, np.exp(best.x).tolist(), strict=True))


def family_scores(pairs: Pairs, factors: Mapping[str, Mapping[str, float]]) -> list[Row]:
    """Mean scores of sigma by family, each with its own factors."""
    rows = []
    for family, own in pairs.items():
        scores = [sigma_scores(e, sigma_of(t, factors[family])) for e, t in own]
        tenths = np.mean([s["reliability"] for s in scores], axis=0).tolist()
        table = pd.DataFrame(scores)[list(SCORES)].astype(float).mean()
        rows.append({"family": family, **table, "reliability": tenths})
    return rows


def sigma_page(page: Path, frame: pd.DataFrame) -> str:
    """The page of the fit; its picture and a CSV file by family are written beside it.

    It has today's factors, those of all families and the range of those with a family left out, and
    scores with today's factors and with those of all other families, of families and their mean.
    """
    pairs = pairs_of(frame)
    every = fitted(pairs)
    others = {
        left: fitted({name: p for name, p in pairs.items() if name != left or len(pairs) == 1})
        for left in pairs
    }
    fits = pd.DataFrame({"today": FACTORS, "all families": every})
    fits["least"], fits["most"] = (pd.DataFrame(others).agg(how, axis=1) for how in ("min", "max"))
    before = family_scores(pairs, dict.fromkeys(pairs, FACTORS))
    after = family_scores(pairs, others)
    plot_reliability(page.with_suffix(".png"), {"today": before, "of the other families": after})
    blocks = [
        "# Factors of sigma",
        f"{sum(map(len, pairs.values()))} pairs of {len(pairs)} families; {provenance(frame)}. Loss"
        f" of today's factors {mean_loss(pairs, FACTORS):.4f}, of those of all families"
        f" {mean_loss(pairs, every):.4f}. Least and most: with one family left out.",
        markdown(fits.rename_axis("factor"), ".3f"),
    ]
    table = pd.DataFrame(before).set_index("family")[list(SCORES)]
    table["nll, left out"] = pd.DataFrame(after).set_index("family")["nll"]
    by_family = page.with_suffix(".csv")
    table.to_csv(by_family, float_format="%.3f")
    about = (
        "By today's factors; nll, left out: by those fitted to the other families."
        f" [{by_family.name}]({by_family.name}) has every family."
    )
    mean = table.agg(["mean"]).rename_axis("family")
    blocks += ["## Scores", about, markdown(mean, ".3f")]
    blocks.append(f"![Reliability of sigma by family]({page.stem}.png)")
    return "\n\n".join(blocks) + "\n"


def plot_reliability(path: Path, sides: Mapping[str, list[Row]]) -> None:
    """Root mean square error of log depth by sigma, a curve for every family, in two panels."""
    out, axes = panels(1, len(sides), 5.0, 5.0, sharey=True)
    for ax, (title, rows) in zip(axes.flat, sides.items(), strict=True):
        for k, row in enumerate(rows):
            sigma, error = np.array(row["reliability"]).T
            style = ("-", "--", ":")[k // 10 % 3]
            ax.loglog(sigma, np.maximum(error, 1e-4), style, lw=1, label=row["family"])
        ax.plot((0.003, 2), (0.003, 2), color="black", lw=0.8)
        ax.set(xlim=(0.003, 2), ylim=(0.001, 3), xlabel="sigma", title=f"factors: {title}")
    axes[0, 0].set_ylabel("RMS error of log depth")
    axes[0, -1].legend(fontsize=5, ncols=2)
    save(out, path)
