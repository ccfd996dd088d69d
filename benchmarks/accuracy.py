"""The page of a suite: by family and half; a table by pair, a picture; two suites compared."""

from pathlib import Path

import numpy as np
import pandas as pd

from benchmarks.scores import METHODS
from benchmarks.suites import HALF_B
from benchmarks.table import (
    geometric,
    markdown,
    mre_of,
    numbers,
    page_text,
    panels,
    provenance,
    save,
)
from soup_nlp.errors import DataError

BASELINES = ("unorganised", "rigid", "rigid_filled", "constant")
"""Depth maps that the solution is compared with."""
ERROR_COLUMNS = {
    "metrics.solution.mre": "MRE",
    "metrics.solution.median_relative": "median",
    "seen.mre": "seen",
    "seen.rest": "not seen",
    "seen.share": "share seen",
    "moving.mre": "moving",
    "moving.rest": "rest",
}
"""Titles of the errors by family, by column of the frame."""
SIGMA_COLUMNS = {
    "sigma.nll": "NLL",
    "sigma.flat": "flat",
    "sigma.within1": "within 1",
    "sigma.within2": "within 2",
    "sigma.sure_wrong": "sure and wrong",
    "sigma.wrong_sure": "wrong and sure",
    "sigma.right_unsure": "right but unsure",
    "sigma.ause": "AUSE",
    "drawn": "drawn",
}
"""Titles of the columns on sigma."""
SIGMA_BY_PAIR = ("NLL", "within 1", "within 2", "sure and wrong", "AUSE", "drawn")
"""Those of the table by pair."""
PAIR = ["pair", "flow"]
"""Columns that identify a row of the table by pair."""
ABOUT = (
    "MRE after one median scale per image, without a cap. results/accuracy/README.md says what all"
    " columns are."
)


def suite_page(page: Path, frame: pd.DataFrame, note: str = "") -> str:
    """The page of the rows of one suite; its table by pair and its picture are written beside it.

    The table is a CSV file: pair, flow, family, MRE of every method, CPU seconds, scores of sigma.
    """
    good = frame[frame["ok"].eq(True)]
    scored = good[mre_of(good).notna()]
    settings = ", ".join(sorted(frame["settings"].astype(str).unique()))
    open_ends = ", ".join(good["title"][~numbers(good, "good").gt(0)]) or "none"
    verdict = (
        f"{len(good)} of {len(frame)} pairs measured; not converged: {open_ends}. The solution"
        f" beats every baseline on {int(_best(scored).sum())} of {len(scored)} (MRE; the baseline"
        " `rigid` on the pixels where it has a depth)."
    )
    about = f"{provenance(frame)}; settings {settings} (one a flow source)."
    blocks = [f"# Accuracy on {page.stem}", note, verdict, about]
    if len(scored):
        table = page.with_suffix(".csv")
        _by_pair(scored).to_csv(table, float_format="%.4f")
        blocks.append(f"[The table by pair]({table.name}). {ABOUT}")
        blocks += ["## By half", _halves(scored)]
        blocks += ["## By family", _by_family(scored)]
        if plot_sigma(page.with_suffix(".png"), frame):
            blocks.append(f"![Sparsification by sigma, and its reliability]({page.stem}.png)")
    return page_text(blocks, frame)


def _best(frame: pd.DataFrame) -> pd.Series:
    out = pd.Series(True, frame.index)
    for baseline in BASELINES:
        own = "solution_rigid" if baseline == "rigid" else "solution"
        out &= ~(mre_of(frame, baseline) <= mre_of(frame, own).fillna(mre_of(frame)))
    return out


def _by_pair(frame: pd.DataFrame) -> pd.DataFrame:
    """Family, MRE of every method but the filled rigid depth, CPU seconds and scores of sigma."""
    table = pd.DataFrame({m: mre_of(frame, m) for m in METHODS if m != "rigid_filled"})
    table["CPU s"] = frame["cpu_seconds"].astype(float).round().astype(int)
    for column, title in SIGMA_COLUMNS.items():
        if title in SIGMA_BY_PAIR:
            table[title] = numbers(frame, column)
    table.insert(0, "family", frame["family"])
    return table.set_index(pd.MultiIndex.from_frame(frame[PAIR])).dropna(axis=1, how="all")


def _by_family(frame: pd.DataFrame) -> str:
    table = pd.DataFrame({title: numbers(frame, c) for c, title in ERROR_COLUMNS.items()})
    groups = table.dropna(axis=1, how="all").groupby([frame["family"], frame["flow"]], sort=False)
    means = groups.mean()
    means.insert(0, "pairs", groups.size())
    return markdown(means)


def _halves(frame: pd.DataFrame) -> str:
    """Table of geometric means over families by half and flow, and of means of sigma's columns."""
    shown = {"metrics.solution.mre": "MRE", "metrics.constant.mre": "constant"}
    columns = shown | SIGMA_COLUMNS
    table = pd.DataFrame({title: numbers(frame, column) for column, title in columns.items()})
    families = table.groupby([frame["family"], frame["flow"]]).mean().reset_index()
    half = families["family"].isin(HALF_B).map({True: "B", False: "A"}).rename("half")
    groups = families.groupby([half, "flow"])
    means = groups[list(table)].mean()
    for title in shown.values():
        means[title] = groups[title].agg(geometric)
    means.insert(0, "families", groups.size())
    return markdown(means)


def plot_sigma(path: Path, frame: pd.DataFrame) -> bool:
    """Sparsification curves by family, and the reliability of sigma; False without any sigma.

    Rows with the true flow are left out where there are others.
    """
    shown = frame[numbers(frame, "sigma.ause").notna()]
    computed = shown[~shown["flow"].str.startswith("truth")]
    families = (computed if len(computed) else shown).groupby("family", sort=False)
    if not len(families):
        return False
    columns = min(6, families.ngroups + 1)
    out, axes = panels(-(-(families.ngroups + 1) // columns), columns, 2.4, 2.2)
    reliable, *others = axes.flat[::-1]
    for ax in others[: len(others) - families.ngroups]:
        ax.set_axis_off()
    for ax, (family, group) in zip(axes.flat, families, strict=False):
        for curve in group["sigma.curve"]:
            kept, by_sigma, oracle = np.array(curve)
            ax.plot(100 * (1 - kept), by_sigma / by_sigma[0], color="#4477aa", lw=1)
            ax.plot(100 * (1 - kept), oracle / by_sigma[0], color="#bbbbbb", lw=1)
        ax.axhline(1.0, color="#cc6677", lw=0.8, ls="--")
        ax.set(ylim=(0, 1.3), xlim=(0, 100))
        ax.set_title(str(family), fontsize=8)
        # of pairs with few pixels there are fewer tenths
        tenths = [k for k in group["sigma.reliability"] if len(k) == 10] or [[[1, 1]]]
        mean = np.mean(tenths, axis=0)
        reliable.loglog(mean[:, 0], mean[:, 1], lw=0.8)
    reliable.plot((0.003, 3), (0.003, 3), color="black", lw=0.8, ls="--")
    reliable.set_title("reliability: RMS error of log depth by sigma", fontsize=6)
    out.supxlabel("most uncertain % removed", fontsize=8)
    out.supylabel("MRE of the rest / MRE", fontsize=8)
    out.suptitle("Sparsification: sigma (blue), oracle (grey), chance (dashed)", fontsize=9)
    save(out, path)
    return True


# --- two suites compared ------------------------------------------------------------------------


def read_pages(path: Path) -> pd.DataFrame:
    """The table by pair of a page, or of all pages of a folder: `pair` and `flow` are the index."""
    files = sorted(path.glob("*.csv")) if path.is_dir() else [path.with_suffix(".csv")]
    tables = [pd.read_csv(file, dtype={"pair": str}) for file in files if file.is_file()]
    tables = [table for table in tables if "pair" in table]
    if not tables:
        raise DataError("no table by pair is there", where=path, expected="pages of `accuracy`")
    return pd.concat(tables).drop_duplicates(PAIR).set_index(PAIR)


def comparison(before: pd.DataFrame, after: pd.DataFrame) -> str:
    """Ratios of the MRE by family and half, after over before, on the pairs that both have.

    A family's ratio is the geometric mean of its pairs; a half's is that of its families.
    """
    both = after.index.intersection(before.index, sort=False)
    if both.empty:
        raise DataError("the pages have no pair in common")
    old, new = before.loc[both], after.loc[both]
    table = pd.DataFrame({"before": old["solution"], "after": new["solution"]})
    table["ratio"] = table["after"] / table["before"]
    table["NLL before"], table["NLL after"] = old.get("NLL"), new.get("NLL")
    groups = table.groupby([new["family"], "flow"], sort=False)
    families = groups.mean()
    families["ratio"] = groups["ratio"].agg(geometric)
    families.insert(0, "pairs", groups.size())
    half = families.index.get_level_values(0).isin(HALF_B)
    lines = []
    for name, part in (("A", ~half), ("B", half), ("A and B", half | True)):
        for which, ratios in families[part].groupby(level="flow")["ratio"]:
            worse, better = int((ratios > 1.1).sum()), int((ratios < 0.9).sum())
            mean = f"{geometric(ratios):.4f} over {len(ratios)}"
            lines.append(
                f"- half {name}, {which}: {mean}; worse by 10 %: {worse}, better: {better}"
            )
    shown = markdown(families.dropna(axis=1, how="all"))
    return "\n".join([shown, "", "Geometric mean of the ratios:", *lines])
