"""The page of a suite and of a study: tables by pair, family and dataset, with their protocol."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from soup_nlp.bench.accuracy import BASELINES, METHODS
from soup_nlp.bench.published import ABLATION, GRID_AGAINST_SLIC, PROTOCOL, SOURCE, published
from soup_nlp.bench.study import (
    Study,
    failures,
    main_metric,
    markdown,
    page_text,
    panels,
    pivot,
    plot_lines,
    provenance,
    save,
    show,
    table,
    titled,
)
from soup_nlp.evaluate.metrics import ERRORS
from soup_nlp.evaluate.protocols import preset
from soup_nlp.evaluate.scoring import SURE

MEASURES = {
    "mre": ("MRE", ".4f"),
    "median": ("Median relative error", ".4f"),
    "cpu_seconds": ("CPU seconds (shared machines count too)", ".1f"),
    "energy.solution.total": ("Exact energy of the solution", ".1f"),
}
"""Title and format of every table of a study, by column."""
CONFIDENCE = (
    "AUSE is the area between the sparsification curve and the oracle's, over the mean relative"
    " error: 0 is perfect, 0.8 to 1 is chance. Within k: share of the pixels whose log depth is"
    " within k sigma, one median scale a pair. Guess: share of the image."
)


def suite_page(title: str, frame: pd.DataFrame, note: str = "") -> str:
    """The page of the rows of one suite."""
    good = frame[frame["ok"].eq(True)].copy()
    known = good[good["mre"].notna()]
    settings = ", ".join(sorted(frame["settings"].astype(str).unique()))
    lines = [f"# {title}", "", note, "", _verdict(good, known, len(frame)), ""]
    lines += [f"{provenance(frame)}; settings {settings} (one a flow source).", ""]
    for name in dict.fromkeys(p for presets in known["presets"] for p in presets):
        lines += _convention(name, known)
    lines += [*_families(known), *_better_baselines(known)]
    for name, group in known.groupby("main", sort=False):
        lines += _details(str(name), group)
    for suite, group in known.groupby("suite", sort=False):
        lines += _published(str(suite), group)
    return page_text([*lines[:-1], *failures(frame)])


def _verdict(good: pd.DataFrame, known: pd.DataFrame, total: int) -> str:
    beaten = beating(known)["title"].nunique()
    return (
        f"{len(good)} of {total} pairs measured, {int(good.get('good', known['ok']).sum())}"
        f" converged. The solution beats every baseline on {len(known) - beaten} of {len(known)}"
        " (MRE, each pair's own convention)."
    )


def beating(frame: pd.DataFrame) -> pd.DataFrame:
    """Baselines that are not worse than the solution: title, baseline, its MRE, the solution's.

    The baseline `rigid` is compared on the pixels where it has a depth.
    """
    parts = []
    for baseline in BASELINES:
        part = frame[["title", "main"]].assign(baseline=baseline, mre=frame["mre"])
        if baseline == "rigid":
            part["mre"] = main_metric(frame, "solution_rigid").fillna(frame["mre"])
        part["theirs"] = main_metric(frame, baseline)
        part["pixels"] = main_metric(frame, baseline, "coverage")
        parts.append(part[part["theirs"] <= part["mre"]])
    return pd.concat(parts, ignore_index=True)


def _better_baselines(frame: pd.DataFrame) -> list[str]:
    found = beating(frame)
    if found.empty:
        return []
    found["difference"] = found["theirs"] - found["mre"]
    columns = {
        "main": ("convention", ""),
        "baseline": ("baseline", ""),
        "theirs": ("its MRE", ".4f"),
        "mre": ("the solution's", ".4f"),
        "pixels": ("its pixels", ".1%"),
        "difference": ("difference", "+.4f"),
    }
    text = "The solution's MRE is on the pixels that the baseline has a depth for."
    lines = titled(found.set_axis(pd.Index(found["title"], name="pair, flow")), columns)
    return ["## Baselines that are better", "", text, "", *lines, ""]


def _convention(name: str, frame: pd.DataFrame) -> list[str]:
    """Tables of the MRE of every method under one convention, by pair, sequence and dataset."""
    columns = {f"metrics.{name}.{m}.mre": m for m in METHODS}
    columns |= {f"metrics.{name}.solution.{k}": k for k in ("skill", "coverage")}
    known = frame[frame[f"metrics.{name}.solution.mre"].notna()]
    keys = ["suite", "sequence", "flow", "title"]
    numbers = known[[c for c in columns if c in known]].astype(float).rename(columns=columns)
    numbers = numbers.dropna(axis=1, how="all")
    text = preset(name).text
    lines = [f"## MRE, {preset(name)}", "", f"{text[0].upper()}{text[1:]}.", ""]
    lines += markdown(numbers.set_axis(pd.Index(known["title"], name="pair, flow")))
    for level, by in (("sequence", keys[:3]), ("dataset", ["suite", "flow"])):
        groups = pd.concat([known[keys], numbers], axis=1).groupby(by, sort=False)
        if 0 < groups.ngroups < len(known):
            means = groups[list(numbers.columns)].mean()
            means.insert(0, "pairs", groups.size())
            lines += ["", f"Mean per {level}:", "", *markdown(means, _forms(means))]
    return [*lines, ""]


def _forms(frame: pd.DataFrame) -> dict[str, str]:
    """Formats of a table: counts as they are, all other numbers with four digits."""
    return {str(c): "" if str(c).endswith("pairs") else ".4f" for c in frame.columns}


def _families(frame: pd.DataFrame) -> list[str]:
    """Table of the solution by family (sequence) and flow: means, moving pixels, worst pair."""
    if frame.groupby(["sequence", "flow"]).ngroups < 2:
        return []
    own = frame[["sequence", "flow", "title", "mre", "constant"]].copy()
    own["median"] = main_metric(frame, name="median_relative")
    own["d<1.25"] = main_metric(frame, name="delta1")
    own["skill"] = main_metric(frame, name="skill")
    for column, name in {"moving.mre": "MRE moving", "moving.rest": "MRE of the rest"}.items():
        own[name] = frame[column].astype(float) if column in frame else np.nan
    own["guess"], own["within 1"], own["within 2"] = _sure(frame)
    groups = own.groupby(["sequence", "flow"], sort=False)
    means = groups[[c for c in own.columns if c not in ("sequence", "flow", "title")]].mean()
    means.insert(0, "pairs", groups.size())
    means["worst pair"] = [own.loc[i, "title"] for i in groups["mre"].idxmax()]
    text = (
        "Means over the pairs, each under its own convention. Moving: pixels that move by"
        " themselves, where a mask or the true motion is known. Guess: share of the image. Within"
        " k: share of the pixels whose log depth is within k sigma."
    )
    return ["## By family", "", text, "", *markdown(means, _forms(means)), ""]


def _sure(frame: pd.DataFrame) -> tuple[pd.Series, pd.Series, pd.Series]:
    """Share of guesses, and shares of the pixels within one and within two sigma, by row."""
    guess, within = (frame.get(c, pd.Series(np.nan, frame.index)) for c in ("guess", "within"))
    one, two = ([v[k] if isinstance(v, list) else np.nan for v in within] for k in (0, 1))
    return guess.astype(float), pd.Series(one, frame.index), pd.Series(two, frame.index)


def _details(convention: str, frame: pd.DataFrame) -> list[str]:
    """Table of the solution's other errors, flow error, scene flow, sigma and seconds."""
    out = pd.DataFrame(index=pd.Index(frame["title"], name="pair, flow"))
    heads = ("median", "SqRel", "RMSE", "log-RMSE", "d<1.25", "d<1.25^2", "d<1.25^3")
    for head, name in zip(heads, ERRORS[1:], strict=True):
        out[head] = main_metric(frame, name=name).to_numpy()
    for column, head in {
        "flow_error.mean": "flow EPE px",
        "scene_flow.mean": "3D EPE",
        "scene_flow.mean_truth_length": "of length",
        "bending_share": "bending",
    }.items():
        if column in frame:
            out[head] = frame[column].astype(float).to_numpy()
    for head, values in zip(("guess", "within 1", "within 2"), _sure(frame), strict=True):
        out[head] = values.to_numpy()
    out["status"], out["s"] = frame["status"].to_numpy(), frame["cpu_seconds"].to_numpy()
    forms = dict.fromkeys(out.columns, ".4f") | {"s": ".0f"}
    return [f"## The solution, {preset(convention)}", "", *markdown(out, forms), ""]


def _published(suite: str, frame: pd.DataFrame) -> list[str]:
    """Published numbers of a dataset beside the measured means."""
    numbers, about = published(suite)
    if not numbers:
        return []
    lines = [[f"{m} (published)", show(v)] for m, v in numbers.items()]
    for (flow, name), group in frame.groupby(["flow", "main"], sort=False):
        count = f"{len(group)} pair{'' if len(group) == 1 else 's'}"
        text = f"this program, flow {flow}, {name}, {count} (measured)"
        lines.append([text, show(float(group["mre"].mean()))])
    text = f"Published rows are copied, not measured: {SOURCE}. {PROTOCOL}. {about}."
    head = f"## {suite} beside published numbers"
    return [head, "", *table(["method", "MRE"], lines), "", text, ""]


def study_page(name: str, study: Study, frame: pd.DataFrame, note: str = "") -> str:
    """Page of a study: a table for each measure with pairs as lines and variants as columns."""
    used = "; ".join(str(preset(p)) for p in frame["main"].unique())
    lines = [f"# Study: {name}", "", f"{study.text[0].upper()}{study.text[1:]}. {note}", ""]
    lines += [f"{provenance(frame)}. Depth of the reference frame; {used}.", ""]
    frame = frame.assign(median=main_metric(frame, name="median_relative"))
    for column, (title, form) in MEASURES.items():
        if column in frame:
            lines += [f"## {title}", "", *markdown(pivot(frame, column), form), ""]
    lines += published_lines(name)
    return page_text([*lines, *failures(frame)])


def published_lines(study: str) -> list[str]:
    """The paper's numbers of a study; none for most."""
    copied = f"Copied, not measured: {SOURCE}."
    if study == "ablation":
        lines = [[f"{k} (published)", *(show(v) for v in row)] for k, row in ABLATION.items()]
        head = ["sequence", "arap", "+ proj", "+ cont", "+ orient"]
        return ["## Published MRE", "", *table(head, lines), "", copied, ""]
    if study == "pattern":
        both = ", ".join(f"{k} {v:.4f}" for k, v in GRID_AGAINST_SLIC.items())
        return [f"Published for one frame with 1,000 superpixels: {both}. {copied}", ""]
    return []


def confidence_page(study: Study, frame: pd.DataFrame, note: str = "") -> str:
    """Page of the study of sigma: tables by pair and by family."""
    head = f"{study.text[0].upper()}{study.text[1:]}. {note} {provenance(frame)}."
    lines = ["# Study: confidence", "", head, ""]
    good = _with_curve(frame)
    if len(good):
        table = pd.DataFrame({"MRE": good["mre"]})
        for name in SURE:
            table[name.replace("solution_", "surest ") + " %"] = main_metric(good, name)
        table["AUSE"] = good["sparsification.ause"].astype(float)
        table["guess"], table["within 1"], table["within 2"] = _sure(good)
        by_family = table.groupby(good["sequence"], sort=False).mean().rename_axis("family")
        by_family.loc[f"mean of {len(by_family)} families"] = by_family.mean()
        by_pair = table.set_axis(pd.Index(good["title"], name="pair, flow"))
        lines += [CONFIDENCE, "", *markdown(by_pair), "", "## By family", ""]
        lines += markdown(by_family)
    return page_text([*lines, *failures(frame)])


def _with_curve(frame: pd.DataFrame) -> pd.DataFrame:
    """The rows that have a sparsification curve."""
    known = "sparsification.ause" in frame
    return frame[frame["sparsification.ause"].notna()] if known else frame.iloc[:0]


def plot_confidence(path: Path, frame: pd.DataFrame) -> None:
    """Sparsification curves of sigma and of the oracle, one panel for each family."""
    families = _with_curve(frame).groupby("sequence", sort=False)
    out, axes = panels(families.ngroups, 4, 3.0, 2.4)
    for ax, (family, group) in zip(axes, families, strict=True):
        for curve in group["sparsification.curve"]:
            kept, by_sigma, oracle = np.array(curve)
            ax.plot(100 * (1 - kept), by_sigma / by_sigma[0], color="#4477aa", lw=1)
            ax.plot(100 * (1 - kept), oracle / by_sigma[0], color="#bbbbbb", lw=1)
        ax.axhline(1.0, color="#cc6677", lw=0.8, ls="--")
        ax.set(ylim=(0, 1.3), xlim=(0, 100))
        ax.set_title(str(family), fontsize=9)
    out.supxlabel("most uncertain % removed")
    out.supylabel("MRE of the rest / MRE")
    out.suptitle("Sparsification: sigma (blue), oracle (grey), chance (dashed)", fontsize=10)
    save(out, path)


def write_study(
    folder: Path, name: str, study: Study, frame: pd.DataFrame, note: str = ""
) -> Sequence[Path]:
    """Write the page and the picture of a study."""
    page, picture = folder / f"{name}.md", folder / f"{name}.png"
    if name == "confidence":
        text = confidence_page(study, frame, note)
        plot_confidence(picture, frame)
    else:
        text = study_page(name, study, frame, note)
        plot_lines(picture, {"": pivot(frame)}, name, study.text)
    page.write_text(text, encoding="utf-8")
    return page, picture
