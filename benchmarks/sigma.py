"""The factors of sigma: fitted to the errors of solved pairs, families left out in turn."""

from collections.abc import Mapping

import numpy as np
import pandas as pd
from scipy.optimize import minimize

from benchmarks.scores import solved
from benchmarks.table import Cell, markdown
from soup_nlp.arrays import Float
from soup_nlp.evaluation.confidence import DRAWN, PRIOR, SHARES, with_prior
from soup_nlp.evaluation.scoring import at_truth
from soup_nlp.storage.each import Row

PIXELS = 500
"""Pixels with truth of a pair that count, drawn at random."""
HEAVY = 4.0
"""Error, in sigma, from which it counts linearly: a few pixels that a wrong motion misses by far
would widen all of sigma."""
PULL = 1e-3
"""Loss by the squared change of the logarithm of a factor."""
FACTORS = {**SHARES, "drawn": DRAWN, "prior": PRIOR}
"""Today's constants of sigma, by name."""


def measure_terms(cell: Cell) -> Row:
    """Errors of log depth after the median scale, and terms of sigma, at pixels of one pair."""
    run = solved(cell)
    truth, sure = run.pair.truth, run.confidence
    assert truth is not None
    z, gt = at_truth(truth, run.reconstruction.depth_ref)
    at = np.flatnonzero((np.isfinite(gt) & np.isfinite(z) & (gt > 0) & (z > 0)).ravel())
    at = np.random.default_rng(0).permutation(at)[:PIXELS]
    z, gt = z.ravel()[at], gt.ravel()[at]
    maps = {name: term / SHARES[name] for name, term in sure.terms.items()}
    maps["drawn"] = (sure.sigma == DRAWN).astype(float)
    terms = {name: at_truth(truth, value)[0].ravel()[at] for name, value in maps.items()}
    error = np.log(z * np.median(gt / z) / gt)
    return {
        "error": np.round(error, 5).tolist(),
        "terms": {name: np.round(np.minimum(v, 1e4), 5).tolist() for name, v in terms.items()},
    }


def sigma_of(terms: Mapping[str, Float], factor: Mapping[str, float]) -> Float:
    """Sigma by terms and factors, as `soup_nlp.evaluation.confidence` adds them up."""
    squares = np.sum([(factor[name] * terms[name]) ** 2 for name in SHARES], axis=0)
    known = with_prior(np.sqrt(squares), factor["prior"])
    return np.where(terms["drawn"] > 0, factor["drawn"], known)


def loss(error: Float, sigma: Float) -> float:
    """Mean negative log likelihood, errors beyond `HEAVY` sigma linear."""
    q = np.abs(error) / sigma
    return float(np.mean(np.where(q < HEAVY, q**2 / 2, HEAVY * q - HEAVY**2 / 2) + np.log(sigma)))


Pairs = dict[str, list[tuple[Float, dict[str, Float]]]]
"""Errors and terms of the pairs of every family."""


def pairs_of(frame: pd.DataFrame) -> Pairs:
    """Errors and terms of the rows that were measured, by family."""
    out: Pairs = {}
    for _, row in frame[frame["ok"].eq(True)].iterrows():
        terms = {name: np.array(row[f"terms.{name}"]) for name in (*SHARES, "drawn")}
        out.setdefault(row["family"], []).append((np.array(row["error"]), terms))
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


def sigma_page(frame: pd.DataFrame) -> str:
    """Today's factors, those of all families, and those with each left out with its loss."""
    pairs = pairs_of(frame)
    every = fitted(pairs)
    rows = {"today": {**FACTORS, "loss": mean_loss(pairs, FACTORS)}}
    rows["all families"] = {**every, "loss": mean_loss(pairs, every)}
    for family in pairs if len(pairs) > 1 else ():
        others = fitted({name: p for name, p in pairs.items() if name != family})
        alone = {family: pairs[family]}
        now = {"loss of it": mean_loss(alone, others), "by today's": mean_loss(alone, FACTORS)}
        rows[f"without {family}"] = {**others, **now}
    table = pd.DataFrame(rows).T.rename_axis("fit")
    return f"# Factors of sigma\n\n{markdown(table, '.3f')}\n"
