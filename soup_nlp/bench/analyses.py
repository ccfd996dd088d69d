"""Analyses: the same pairs measured under several variants of the options; a table and a plot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

from soup_nlp.bench import analyses_report as reports
from soup_nlp.bench.accuracy import Measure, measure_pair, pair_job
from soup_nlp.bench.analyses_measures import VIEWS, measure_energy, measure_flow, measure_view
from soup_nlp.bench.causes import measure_causes, plot_causes, text_causes
from soup_nlp.bench.confidence import measure_confidence, plot_confidence, text_confidence
from soup_nlp.bench.rules import RULES, SHIPPED, in_both, plot_rules, text_rules
from soup_nlp.bench.suite_pairs import Item
from soup_nlp.bench.suites import Listing
from soup_nlp.errors import ConfigError
from soup_nlp.storage.atomic import write_text
from soup_nlp.storage.folders import claim, staged
from soup_nlp.storage.rows import MeasureRows, Row, measure_all

Overrides = tuple[str, ...]

NOISE_PX = ("0.1", "0.5", "1", "2")
"""Standard deviations of the noise on true flow, pixels."""


@dataclass(frozen=True)
class Analysis:
    """An analysis.

    Attributes:
        name: On the command line.
        text: Description.
        variants: Overrides by name of a variant, in the order of the tables.
        axis: Axis label of the variants.
        base: Variant that others are compared with; it is always measured.
        free: Option of the variants, if the user may ask for other values of it.
        numeric: The variants are numbers, drawn on a numeric axis.
        true_flow_only: Only pairs with a true flow are used.
        function: Measures a pair.
        page: Makes the page from name, text, rows and a note.
        plot: Draws the rows into a file; None draws the MRE over the variants.
    """

    name: str
    text: str
    variants: Mapping[str, Overrides]
    axis: str = ""
    base: str = ""
    free: str = ""
    numeric: bool = False
    true_flow_only: bool = False
    function: Measure = measure_pair
    page: Callable[[str, str, Sequence[Row], str], str] = reports.text_variants
    plot: Callable[[Path, Sequence[Row]], None] | None = None


def _over(key: str, values: Sequence[object]) -> dict[str, Overrides]:
    return {str(v): (f"{key}={v}",) for v in values}


def _numbers(name: str, text: str, values: Sequence[int]) -> Analysis:
    key = f"segmentation.{name}"
    return Analysis(name, text, _over(key, values), name, free=key, numeric=True)


def _without(*terms: str) -> Overrides:
    return tuple(o for t in terms for o in in_both(t, "0.0"))


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
    _numbers("superpixels", "number of superpixels, 100 to 2,000", (100, 250, 500, 1000, 2000)),
    _numbers("neighbours", "K of the K-NN graph, 4 to 20", (4, 8, 12, 15, 20)),
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
        _over("flow.source", ["truth", *(f"truth+noise:{px}" for px in NOISE_PX), "dis"]),
        "flow",
        free="flow.source",
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
        true_flow_only=True,
        function=measure_flow,
        page=reports.text_flow,
        plot=reports.plot_flow,
    ),
    Analysis(
        "causes",
        "where the depth error with DIS sits, and what the true motion makes of the same flow",
        {"dis": ("flow.source=dis",)},
        true_flow_only=True,
        function=measure_causes,
        page=text_causes,
        plot=plot_causes,
    ),
    Analysis(
        "views",
        "the same pairs mirrored, backwards and cropped: does a figure hold on pairs not chosen on",
        dict.fromkeys(VIEWS, ()),
        "view",
        function=measure_view,
    ),
    Analysis(
        "confidence",
        "how well sigma of log depth tells large errors from small ones, and its calibration",
        {"": ()},
        function=measure_confidence,
        page=text_confidence,
        plot=plot_confidence,
    ),
    Analysis(
        "rules",
        "what every rule of the start and the energy brings, by family",
        RULES,
        base=SHIPPED,
        page=text_rules,
        plot=plot_rules,
    ),
    Analysis(
        "energy",
        "energy at the truth against the solution, by term; solves that start from the truth",
        {"": ()},
        function=measure_energy,
        page=reports.text_energy,
        plot=reports.plot_energy,
    ),
)
ANALYSES: Mapping[str, Analysis] = MappingProxyType({a.name: a for a in _ALL})
"""Analyses by name."""


def run_analysis(
    name: str,
    listings: Sequence[Listing],
    out: Path,
    overrides: Overrides = (),
    measure_rows: MeasureRows = measure_all,
    *,
    values: Sequence[str] | None = None,
    presets: Sequence[str] = (),
    overwrite: bool = False,
) -> Path:
    """Measure every variant on every pair and write OUT/NAME.md, .png and .jsonl.

    Args:
        name: One of `ANALYSES`.
        listings: Pairs.
        out: Folder.
        overrides: Overrides of every problem; those of a variant come after them.
        measure_rows: Measures the jobs; `measure_all` with its options.
        values: Names of the variants to measure, or values of the option `free`; None for all.
        presets: Metric conventions instead of those of the suites, the main one first.
        overwrite: Overwrite files that the program did not make.

    Returns:
        The table's file.

    Raises:
        ConfigError: the analysis or a variant is unknown, a value is wrong, no pair is left, or
            conventions are given for an analysis that scores no depth.
    """
    analysis = _restricted(_analysis(name), values)
    items = _items(analysis, listings, presets)
    for own in analysis.variants.values():
        # reports a wrong value here instead of in a failed row for every pair
        items[0].problem((*overrides, *own))
    claim(out, (f"{name}.md", f"{name}.png"), overwrite)
    jobs = [
        pair_job(item, (*overrides, *own), variant, measure=analysis.function)
        for item in items
        for variant, own in analysis.variants.items()
    ]
    rows = measure_rows(jobs, out / f"{name}.jsonl")
    note = f"Overrides of every pair: {', '.join(f'`{o}`' for o in overrides) or 'none'}."
    with staged(out) as new:
        write_text(new / f"{name}.md", analysis.page(name, analysis.text, rows, note))
        picture = new / f"{name}.png"
        if analysis.plot is not None:
            analysis.plot(picture, rows)
        else:
            reports.plot_variants(picture, analysis.axis, analysis.text, rows, analysis.numeric)
    return out / f"{name}.md"


def _items(analysis: Analysis, listings: Sequence[Listing], presets: Sequence[str]) -> list[Item]:
    """The pairs that an analysis can use, under the given conventions."""
    listed = [i for listing in listings for i in listing.items]
    items = [i for i in listed if i.flow == "truth" or not analysis.true_flow_only]
    if not items:
        raise ConfigError(
            "no pair is left for the analysis",
            where=analysis.name,
            found=f"flow {', '.join(dict.fromkeys(i.flow for i in listed))}" if listed else None,
            expected="pairs listed with their true flow" if listed else None,
            hint="give --flow truth" if listed else None,
        )
    if presets and analysis.function is measure_flow:
        raise ConfigError("analysis has no depth to score", where=analysis.name, found=presets[0])
    return [i.scored_by(presets) for i in items]


def split_values(name: str, text: str) -> list[str]:
    """Variants of a comma-separated list; names that contain commas are recognised.

    Raises:
        ConfigError: there is no such analysis, or a value is empty.
    """
    names = _analysis(name).variants
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


def _analysis(name: str) -> Analysis:
    if name not in ANALYSES:
        raise ConfigError("unknown analysis", found=name, expected=", ".join(ANALYSES))
    return ANALYSES[name]


def _restricted(analysis: Analysis, values: Sequence[str] | None) -> Analysis:
    """The analysis restricted to these variants, or with these values of its option `free`."""
    if not values:
        return analysis
    if analysis.free:
        return replace(analysis, variants=_over(analysis.free, values))
    variants = analysis.variants
    wrong = [v for v in values if v not in variants]
    if wrong:
        raise ConfigError("unknown variant", found=wrong[0], expected=", ".join(variants))
    wanted = [analysis.base, *values] if analysis.base else values
    return replace(analysis, variants={v: variants[v] for v in wanted})
