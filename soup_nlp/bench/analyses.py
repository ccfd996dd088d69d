"""The paper's analyses: one change at a time over a list of pairs, a table and a plot each."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

from soup_nlp.bench.accuracy import Measure, measure_pair, pair_job
from soup_nlp.bench.analyses_measures import VIEWS, measure_energy, measure_flow, measure_view
from soup_nlp.bench.analyses_report import (
    plot_energy,
    plot_flow,
    plot_variants,
    text_energy,
    text_flow,
    text_variants,
)
from soup_nlp.bench.rows import Say, Where, measure_all
from soup_nlp.bench.suites import Listing
from soup_nlp.errors import ConfigError
from soup_nlp.report.folder import prepare_folder
from soup_nlp.storage.atomic import write_text

Overrides = tuple[str, ...]


@dataclass(frozen=True)
class Analysis:
    """What is changed.

    Attributes:
        name: On the command line.
        text: What it asks.
        variants: Overrides by the name of a variant, in the order of tables.
        axis: Label of the variants.
        numeric: The variants are numbers, drawn on an axis.
        true_flow_only: Only pairs with a true flow.
        function: What measures a pair.
    """

    name: str
    text: str
    variants: Mapping[str, Overrides]
    axis: str
    numeric: bool = False
    true_flow_only: bool = False
    function: Measure = measure_pair


def _over(key: str, values: Sequence[object]) -> dict[str, Overrides]:
    return {str(v): (f"{key}={v}",) for v in values}


def _without(*terms: str) -> Overrides:
    # where surfaces bend, weights of their own are in force
    return tuple(f"energy.{w}.{t}=0.0" for t in terms for w in ("weights", "bending.weights"))


_ALL = (
    Analysis(
        "ablation",
        "what each term of the energy adds (the paper's ablation table)",
        {
            "arap": _without("proj", "cont", "orient", "prior"),
            "+ proj": _without("cont", "orient", "prior"),
            "+ cont": _without("orient", "prior"),
            "+ orient": _without("prior"),
            "+ prior": (),
        },
        "terms",
    ),
    Analysis(
        "superpixels",
        "number of superpixels, 100 to 2,000",
        _over("segmentation.superpixels", (100, 250, 500, 1000, 2000)),
        "superpixels",
        numeric=True,
    ),
    Analysis(
        "neighbours",
        "K of the K-NN graph, 4 to 20",
        _over("segmentation.neighbours", (4, 8, 12, 15, 20)),
        "K",
        numeric=True,
    ),
    Analysis(
        "pattern",
        "SLIC against a regular grid, with borders that follow the flow and without",
        {
            f"{method}{words}": (f"segmentation.method={method}", *over)
            for method in ("slic", "grid")
            for words, over in (("", ()), (", image alone", ("segmentation.follow_flow_px=null",)))
        },
        "superpixels",
    ),
    Analysis(
        "flow",
        "flow source: true, DIS, and the truth with noise of 0.1 to 2 pixels",
        _over(
            "flow.source",
            ("truth", *(f"truth+noise:{px}" for px in ("0.1", "0.5", "1", "2")), "dis"),
        ),
        "flow",
        true_flow_only=True,
    ),
    Analysis(
        "stages",
        "the NLP only, the refinement only, and both",
        {
            "NLP": ("refine.enabled=false",),
            "refinement": ("refine.enabled=true", "refine.from_start=true"),
            "both": ("refine.enabled=true", "refine.from_start=false"),
        },
        "stages",
    ),
    Analysis(
        "flows",
        "error of the flow itself by source, with and without robust re-weighting (no solve)",
        {
            "dis": ("flow.source=dis",),
            "dis, reweighted 0.5": ("flow.source=dis", "flow.reweight_px=0.5"),
            "dis, reweighted 0.25": ("flow.source=dis", "flow.reweight_px=0.25"),
            "rlof": ("flow.source=rlof",),
            "rlof, reweighted 0.25": ("flow.source=rlof", "flow.reweight_px=0.25"),
        },
        "flow",
        true_flow_only=True,
        function=measure_flow,
    ),
    Analysis(
        "views",
        "the same pairs mirrored and cropped: how much a figure on one pair depends on chance",
        dict.fromkeys(VIEWS, ()),
        "view",
        function=measure_view,
    ),
    Analysis(
        "energy",
        "energy at the truth against the solution, by term; solves that start from the truth",
        {"": ()},
        "",
        function=measure_energy,
    ),
)
ANALYSES: Mapping[str, Analysis] = MappingProxyType({a.name: a for a in _ALL})
"""Analyses by name."""


def run_analysis(
    name: str,
    listings: Sequence[Listing],
    out: Path,
    overrides: Overrides = (),
    where: Where | None = None,
    *,
    values: Sequence[str] | None = None,
    presets: Sequence[str] = (),
    say: Say | None = None,
    any_code: bool = False,
) -> Path:
    """Measure every variant on every pair and write OUT/NAME.md, .png and .jsonl.

    Args:
        name: One of `ANALYSES`.
        listings: Pairs.
        out: Folder.
        overrides: Of every problem; a variant's own come after them.
        where: Processes or cluster.
        values: Only these variants; of a numeric analysis other values as well.
        presets: Metric conventions instead of the suites' own, the main one first.
        say: Progress.
        any_code: Also take stored rows of other code versions.

    Returns:
        The table's file.

    Raises:
        ConfigError: there is no such analysis or variant, a value is wrong, no pair is left, or
            conventions are given where no depth is scored.
    """
    analysis = _chosen(_known(name), values)
    listed = [i for listing in listings for i in listing.items]
    items = [i for i in listed if i.flow == "truth" or not analysis.true_flow_only]
    if not items:
        raise ConfigError(
            "no pair is left for the analysis",
            where=name,
            found=f"flow {', '.join(dict.fromkeys(i.flow for i in listed))}" if listed else None,
            expected="pairs listed with their true flow" if listed else None,
            hint="give --flow truth" if listed else None,
        )
    if presets:
        if analysis.function is measure_flow:
            raise ConfigError("analysis has no depth to score", where=name, found=presets[0])
        items = [i.scored_by(tuple(presets)) for i in items]
    for own in analysis.variants.values():
        # a wrong value ends here, not as a failed row a pair
        items[0].problem((*overrides, *own))
    prepare_folder(out)
    jobs = [
        pair_job(item, (*overrides, *own), variant, measure=analysis.function)
        for item in items
        for variant, own in analysis.variants.items()
    ]
    rows = measure_all(jobs, out / f"{name}.jsonl", where, say=say, any_code=any_code)
    note = f"Overrides of every pair: {', '.join(f'`{o}`' for o in overrides) or 'none'}."
    text = {"energy": text_energy, "flows": text_flow}.get(name, text_variants)
    write_text(out / f"{name}.md", text(analysis.name, analysis.text, rows, note))
    picture = out / f"{name}.png"
    if name == "energy":
        plot_energy(picture, rows)
    elif name == "flows":
        plot_flow(picture, rows)
    else:
        plot_variants(picture, analysis.axis, analysis.text, rows, analysis.numeric)
    return out / f"{name}.md"


def split_values(name: str, text: str) -> list[str]:
    """Variants of a comma-separated list; a name with commas in it is one, the longest first.

    Raises:
        ConfigError: there is no such analysis, or a value is empty.
    """
    names = _known(name).variants
    words, out = [w.strip() for w in text.split(",")], []
    while words:
        ends = range(len(words), 1, -1)
        take = next((k for k in ends if ", ".join(words[:k]) in names), 1)
        out.append(", ".join(words[:take]))
        words = words[take:]
    if "" in out:
        raise ConfigError(
            "a value is empty", where="--values", found=repr(text), expected=", ".join(names)
        )
    return out


def _known(name: str) -> Analysis:
    if name not in ANALYSES:
        raise ConfigError("unknown analysis", found=name, expected=", ".join(ANALYSES))
    return ANALYSES[name]


def _number(text: str) -> bool:
    """Whether a value has a place on the axis of a plot."""
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _chosen(analysis: Analysis, values: Sequence[str] | None) -> Analysis:
    if not values:
        return analysis
    variants = dict(analysis.variants)
    if analysis.numeric:
        wrong = [v for v in values if not _number(v)]
        if wrong:
            raise ConfigError(
                "value is no number", where=analysis.name, found=wrong[0], expected="100,250"
            )
        key = next(iter(variants.values()))[0].partition("=")[0]
        return replace(analysis, variants=_over(key, values))
    if analysis.name == "flow":
        return replace(analysis, variants=_over("flow.source", values))
    wrong = [v for v in values if v not in variants]
    if wrong:
        raise ConfigError("unknown variant", found=wrong[0], expected=", ".join(variants))
    return replace(analysis, variants={v: variants[v] for v in values})
