"""The page of a suite: tables by pair, family and dataset, with their protocol; a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from soup_nlp.bench.accuracy import BASELINES, METHODS
from soup_nlp.bench.study import (
    failures,
    main_metric,
    markdown,
    page_text,
    panels,
    provenance,
    save,
    titled,
)
from soup_nlp.evaluate.metrics import ERRORS
from soup_nlp.evaluate.protocols import preset

SURENESS = ("AUSE", "guess", "within 1", "within 2")
"""Columns on sigma."""


def write_suite(page: Path, frame: pd.DataFrame, note: str = "") -> None:
    """Write the page of the rows of one suite, and its picture beside it."""
    picture = _plot_sparsification(page.with_suffix(".png"), frame)
    page.write_text(suite_page(page.stem, frame, note, picture), encoding="utf-8")


def suite_page(name: str, frame: pd.DataFrame, note: str = "", picture: bool = False) -> str:
    """The page of the rows of one suite, with or without its picture."""
    good = frame[frame["ok"].eq(True)].copy()
    scored = good[good["mre"].notna()]
    settings = ", ".join(sorted(frame["settings"].astype(str).unique()))
    lines = [f"# Accuracy on {name}", "", note, "", _verdict(good, scored, len(frame)), ""]
    lines += [f"{provenance(frame)}; settings {settings} (one a flow source).", ""]
    for convention in dict.fromkeys(p for presets in scored["presets"] for p in presets):
        lines += _convention(convention, scored)
    lines += [*_families(scored), *_better_baselines(scored)]
    for convention, group in scored.groupby("main", sort=False):
        lines += _details(str(convention), group)
    if picture:
        lines += ["## Sigma", "", f"![Sparsification by sigma, by family]({name}.png)", ""]
    return page_text([*lines[:-1], *failures(frame)])


def _verdict(good: pd.DataFrame, scored: pd.DataFrame, total: int) -> str:
    beaten = beating(scored)["title"].nunique()
    return (
        f"{len(good)} of {total} pairs measured, {int(good.get('good', scored['ok']).sum())}"
        f" converged. The solution beats every baseline on {len(scored) - beaten} of {len(scored)}"
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
    better = beating(frame)
    if better.empty:
        return []
    better["difference"] = better["theirs"] - better["mre"]
    columns = {
        "main": ("convention", ""),
        "baseline": ("baseline", ""),
        "theirs": ("its MRE", ".4f"),
        "mre": ("the solution's", ".4f"),
        "pixels": ("its pixels", ".1%"),
        "difference": ("difference", "+.4f"),
    }
    text = "The solution's MRE is on the pixels that the baseline has a depth for."
    lines = titled(better.set_axis(pd.Index(better["title"], name="pair, flow")), columns)
    return ["## Baselines that are better", "", text, "", *lines, ""]


def _convention(name: str, frame: pd.DataFrame) -> list[str]:
    """Tables of the MRE of every method under one convention, by pair, sequence and dataset."""
    columns = {f"metrics.{name}.{m}.mre": m for m in METHODS}
    columns |= {f"metrics.{name}.solution.{k}": k for k in ("skill", "coverage")}
    scored = frame[frame[f"metrics.{name}.solution.mre"].notna()]
    keys = ["suite", "sequence", "flow", "title"]
    numbers = scored[[c for c in columns if c in scored]].astype(float).rename(columns=columns)
    numbers = numbers.dropna(axis=1, how="all")
    text = preset(name).text
    lines = [f"## MRE, {preset(name)}", "", f"{text[0].upper()}{text[1:]}.", ""]
    lines += markdown(numbers.set_axis(pd.Index(scored["title"], name="pair, flow")))
    for level, by in (("sequence", keys[:3]), ("dataset", ["suite", "flow"])):
        groups = pd.concat([scored[keys], numbers], axis=1).groupby(by, sort=False)
        if 0 < groups.ngroups < len(scored):
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
    shown = frame[["sequence", "flow", "title", "mre", "constant"]].copy()
    shown["median"] = main_metric(frame, name="median_relative")
    shown["d<1.25"] = main_metric(frame, name="delta1")
    shown["skill"] = main_metric(frame, name="skill")
    for column, name in {"moving.mre": "MRE moving", "moving.rest": "MRE of the rest"}.items():
        shown[name] = frame[column].astype(float) if column in frame else np.nan
    shown[list(SURENESS)] = _sureness(frame)
    groups = shown.groupby(["sequence", "flow"], sort=False)
    means = groups[[c for c in shown.columns if c not in ("sequence", "flow", "title")]].mean()
    means.insert(0, "pairs", groups.size())
    means["worst pair"] = [shown.loc[i, "title"] for i in groups["mre"].idxmax()]
    text = (
        "Means over the pairs, each under its own convention. Moving: pixels that move by"
        " themselves, where a mask or the true motion is known. AUSE: area between the"
        " sparsification curve of sigma and the oracle's, over the MRE; 0 is perfect, 0.8 to 1 is"
        " chance. Guess: share of the image. Within k: share of the pixels whose log depth is"
        " within k sigma."
    )
    return ["## By family", "", text, "", *markdown(means, _forms(means)), ""]


def _sureness(frame: pd.DataFrame) -> pd.DataFrame:
    """SURENESS by row; "within" of a row has the shares within one and within two sigma."""
    out = frame.reindex(columns=["sparsification.ause", "guess"]).astype(float)
    for k in (0, 1):
        values = [v[k] if isinstance(v, list) else np.nan for v in frame.get("within", [])]
        out[f"within {k + 1}"] = values or np.nan
    return out.set_axis(list(SURENESS), axis=1)


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
    out[list(SURENESS)] = _sureness(frame).to_numpy()
    out["status"], out["s"] = frame["status"].to_numpy(), frame["cpu_seconds"].to_numpy()
    forms = dict.fromkeys(out.columns, ".4f") | {"s": ".0f"}
    return [f"## The solution, {preset(convention)}", "", *markdown(out, forms), ""]


def _plot_sparsification(path: Path, frame: pd.DataFrame) -> bool:
    """Sparsification curves of sigma and of the oracle, a panel for each family; False if none.

    Rows with the true flow are left out where there are others.
    """
    shown = frame[frame.get("sparsification.ause", pd.Series(np.nan, frame.index)).notna()]
    computed = shown[~shown["flow"].str.startswith("truth")]
    families = (computed if len(computed) else shown).groupby("sequence", sort=False)
    if not len(families):
        return False
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
    return True
