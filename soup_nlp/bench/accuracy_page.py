"""The page of a suite: tables by pair, family and dataset, with their protocol; a picture."""

from pathlib import Path

import numpy as np
import pandas as pd

from soup_nlp.bench.accuracy import BASELINES, METHODS
from soup_nlp.bench.study import markdown, metric, page_text, panels, provenance, save, titled
from soup_nlp.evaluate.metrics import ERRORS

SURENESS = ["AUSE", "guess", "within 1", "within 2"]
"""Columns on sigma."""
ABOUT_FAMILIES = (
    "Means over the pairs. Moving: pixels that move by themselves,"
    " where a mask or the true motion is known. AUSE: area between the sparsification curve of"
    " sigma and the oracle's, over the MRE; 0 is perfect, 0.8 to 1 is chance. Guess: share of the"
    " image. Within k: share of the pixels whose log depth is within k sigma."
)
BETTER = {
    "baseline": ("baseline", ""),
    "theirs": ("its MRE", ".4f"),
    "mre": ("the solution's", ".4f"),
    "pixels": ("its pixels", ".1%"),
    "difference": ("difference", "+.4f"),
}
"""Columns of the table of baselines that are better."""
DETAILS = {
    "flow_error.mean": "flow EPE px",
    "scene_flow.mean": "3D EPE",
    "scene_flow.mean_truth_length": "of length",
    "bending_share": "bending",
}
"""Titles of further columns of the solution's errors, by column of the frame."""


def write_suite(page: Path, frame: pd.DataFrame, note: str = "") -> None:
    """Write the page of the rows of one suite, and its picture beside it."""
    picture = _plot_sparsification(page.with_suffix(".png"), frame)
    page.write_text(suite_page(page.stem, frame, note, picture), encoding="utf-8")


def suite_page(name: str, frame: pd.DataFrame, note: str = "", picture: bool = False) -> str:
    """The page of the rows of one suite, with or without its picture."""
    good = frame[frame["ok"].eq(True)]
    scored = good[good["mre"].notna()].copy()
    scored[SURENESS[:2]] = scored.reindex(columns=["sparsification.ause", "guess"]).astype(float)
    for k in (0, 1):
        within = [v[k] if isinstance(v, list) else np.nan for v in scored.get("within", [])]
        scored[f"within {k + 1}"] = within or np.nan
    settings = ", ".join(sorted(frame["settings"].astype(str).unique()))
    beaten = beating(scored)["title"].nunique()
    verdict = (
        f"{len(good)} of {len(frame)} pairs measured, {int(good.get('good', good['ok']).sum())}"
        f" converged. The solution beats every baseline on {len(scored) - beaten} of {len(scored)}"
        " (MRE)."
    )
    about = f"{provenance(frame)}; settings {settings} (one a flow source)."
    blocks = [f"# Accuracy on {name}", note, verdict, about]
    if len(scored):
        title = "## MRE, one median scale per image, no cap"
        blocks += [title, _by_pair(scored), *_families(scored)]
        blocks += [*_better_baselines(scored), "## The solution", _details(scored)]
    if picture:
        blocks += ["## Sigma", f"![Sparsification by sigma, by family]({name}.png)"]
    return page_text(blocks, frame)


def beating(frame: pd.DataFrame) -> pd.DataFrame:
    """Baselines that are not worse than the solution: title, baseline, its MRE, the solution's.

    The baseline `rigid` is compared on the pixels where it has a depth.
    """
    parts = []
    for baseline in BASELINES:
        part = frame[["title"]].assign(baseline=baseline, mre=frame["mre"])
        if baseline == "rigid":
            part["mre"] = metric(frame, "solution_rigid").fillna(frame["mre"])
        part["theirs"] = metric(frame, baseline)
        part["pixels"] = metric(frame, baseline, "coverage")
        parts.append(part[part["theirs"] <= part["mre"]])
    return pd.concat(parts, ignore_index=True)


def _better_baselines(frame: pd.DataFrame) -> list[str]:
    better = beating(frame)
    if better.empty:
        return []
    better["difference"] = better["theirs"] - better["mre"]
    text = "The solution's MRE is on the pixels that the baseline has a depth for."
    return ["## Baselines that are better", text, titled(better.set_axis(_pairs(better)), BETTER)]


def _pairs(frame: pd.DataFrame) -> pd.Index:
    """Title of pair and flow of every row, as the index of a table."""
    return pd.Index(frame["title"], name="pair, flow")


def _by_pair(frame: pd.DataFrame) -> str:
    """Table of the MRE of every method."""
    columns = {m: metric(frame, m) for m in METHODS}
    columns |= {k: metric(frame, name=k) for k in ("skill", "coverage")}
    numbers = pd.DataFrame(columns).dropna(axis=1, how="all")
    return markdown(numbers.set_axis(_pairs(frame)))


def _families(frame: pd.DataFrame) -> list[str]:
    """Table of the solution by family (sequence) and flow: means, moving pixels, worst pair."""
    by = ["sequence", "flow"]
    shown = frame[[*by, "mre", "constant"]].copy()
    for title, name in {"median": "median_relative", "d<1.25": "delta1", "skill": "skill"}.items():
        shown[title] = metric(frame, name=name)
    for title, column in {"MRE moving": "moving.mre", "MRE of the rest": "moving.rest"}.items():
        shown[title] = frame[column].astype(float) if column in frame else np.nan
    groups = pd.concat([shown, frame[SURENESS]], axis=1).groupby(by, sort=False)
    if groups.ngroups < 2:
        return []
    worst = frame["title"][groups["mre"].idxmax()].set_axis(groups["mre"].max().index)
    means = groups.mean().assign(**{"worst pair": worst})
    means.insert(0, "pairs", groups.size())
    forms = {str(c): "" if c == "pairs" else ".4f" for c in means}
    return ["## By family", ABOUT_FAMILIES, markdown(means, forms)]


def _details(frame: pd.DataFrame) -> str:
    """Table of the solution's other errors, flow error, scene flow, sigma and seconds."""
    heads = ("median", "SqRel", "RMSE", "log-RMSE", "d<1.25", "d<1.25^2", "d<1.25^3")
    errors = zip(heads, ERRORS[1:], strict=True)
    out = pd.DataFrame({head: metric(frame, name=name) for head, name in errors})
    for column, head in DETAILS.items():
        if column in frame:
            out[head] = frame[column].astype(float)
    out[SURENESS] = frame[SURENESS]
    out[["status", "s"]] = frame[["status", "cpu_seconds"]]
    forms = dict.fromkeys(out.columns, ".4f") | {"s": ".0f"}
    return markdown(out.set_axis(_pairs(frame)), forms)


def _plot_sparsification(path: Path, frame: pd.DataFrame) -> bool:
    """Sparsification curves of sigma and of the oracle, a panel for each family; False if none.

    Rows with the true flow are left out where there are others.
    """
    shown = frame[frame.get("sparsification.ause", pd.Series(np.nan, frame.index)).notna()]
    computed = shown[~shown["flow"].str.startswith("truth")]
    families = (computed if len(computed) else shown).groupby("sequence", sort=False)
    if not len(families):
        return False
    columns = min(4, families.ngroups)
    out, axes = panels(-(-families.ngroups // columns), columns, 3.0, 2.4)
    for ax in axes.flat[families.ngroups :]:
        ax.set_axis_off()
    for ax, (family, group) in zip(axes.flat, families, strict=False):
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
