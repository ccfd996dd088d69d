"""Page and gate of `bench speed`: tables, growth exponents, ratios to a committed baseline."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.stats import linregress

from soup_nlp.bench.processes import machine
from soup_nlp.bench.speed import speed_cell
from soup_nlp.bench.study import failures, figure, markdown, page_text, save
from soup_nlp.errors import DataError
from soup_nlp.storage.files import read_json

PHASES = (
    "load", "flow", "segmentation", "start", "weights",
    "build", "functions", "linear algebra", "evaluation", "output",
)  # fmt: skip
"""Stages of a run; build, functions and linear algebra are the NLP."""
OUTSIDE = ("flow", "segmentation", "start", "weights", "evaluation", "output")
"""All stages but the NLP and the loading or rendering of the frames."""
RUN = {"sequence": "pair", "n": "N", "k": "K"}
COLUMNS = {
    "cpu.nlp": ("CPU s", ".1f"),
    "wall.nlp": ("wall s", ".1f"),
    "iterations": ("its", ".0f"),
    "energy_start.total": ("E start", ".2f"),
    "energy.total": ("E", ".3f"),
    "reference.energy.total": ("E LM", ".3f"),
    "energy_to_reference": ("E / LM", ".4f"),
    "time_to_reference": ("CPU / LM", ".2f"),
    "reference.iterations": ("LM its", ".0f"),
    "errors.start": ("MRE start", ".4f"),
    "errors.solution": ("MRE", ".4f"),
    "reference.mre": ("MRE LM", ".4f"),
    "residuals.dual_infeasibility": ("dual inf.", ".1e"),
    "residuals.nlp_infeasibility": ("constraints", ".1e"),
    "sizes.hessian_nonzeros": ("nnz H", ".0f"),
    "GB": ("GB", ".2f"),
    "outside": ("outside, CPU s", ".1f"),
    "status": ("status", ""),
}
"""Title and format of every column of the main table, by column of the frame."""
COSTS = {
    "cpu.nlp": "NLP, CPU s",
    "cpu an iteration": "CPU s an iteration",
    "outside": "outside the NLP, CPU s",
    "sizes.hessian_nonzeros": "Hessian nonzeros",
    "GB": "peak memory",
}
"""Costs whose growth with N is fitted."""
NOTE = (
    "CPU s and wall s: the whole NLP. LM: Levenberg-Marquardt on the manifold with reweighting,"
    " from the same start on the same smoothing widths, in the same process. E: exact energy. MRE"
    " after median scale, no cap. dual inf., constraints: recomputed at Ipopt's answer. GB: peak of"
    " the process before LM runs. Outside: flow, segmentation, start, weights, evaluation, output"
    " with every picture, point cloud and HDF5. Wall times of a shared machine vary with its load;"
    " CPU times less so. One thread."
)
LIMITS: Mapping[str, tuple[float, float]] = {
    "iterations": (1.3, 3.0),
    "energy": (1.005, 0.0),
    "energy_to_reference": (1.005, 0.0),
    "nonzeros": (1.01, 0.0),
    "time_to_reference": (1.5, 0.0),
    "not converged": (1.0, 0.0),
}
"""(factor, addition) by name of a value: a value above factor x baseline + addition fails.
Iterations and energies may change a little, since rounding differs between machines. Times are
compared relative to the reference solver in the same process, so that the machine cancels out."""
VERSION = 4


def with_costs(frame: pd.DataFrame) -> pd.DataFrame:
    """The good rows of a frame with the costs and ratios that tables and gate need."""
    if "cpu.nlp" not in frame:
        return frame.iloc[:0]
    out = frame[frame["ok"].eq(True)].copy()
    out["outside"] = out.reindex(columns=[f"cpu.{s}" for s in OUTSIDE]).astype(float).sum(axis=1)
    out["GB"] = out["peak_bytes"].astype(float) / 2**30
    out["cpu an iteration"] = out["cpu.nlp"] / out["iterations"].clip(lower=1)
    out["energy_to_reference"] = out["energy.total"] / out["reference.energy.total"]
    out["time_to_reference"] = out["cpu.nlp"] / out["reference.cpu_seconds"]
    return out


class Growth(NamedTuple):
    """Fit of cost = factor N^exponent; `error` is the standard error of the exponent."""

    exponent: float
    error: float

    def __str__(self) -> str:
        return f"{self.exponent:.2f}" + ("" if np.isnan(self.error) else f" ± {self.error:.2f}")


def fit(sizes: Sequence[float], costs: Sequence[float]) -> Growth | None:
    """Least squares of log cost over log N; None with fewer than two different sizes."""
    n, c = np.asarray(sizes, float), np.asarray(costs, float)
    x, y = np.log(n[c > 0]), np.log(c[c > 0])
    # actual numbers of superpixels differ a little between seeds of one size
    if not len(x) or np.ptp(x) < 0.2:
        return None
    line = linregress(x, y)
    return Growth(float(line.slope), float(line.stderr) if len(x) > 2 else np.nan)


def growth(frame: pd.DataFrame) -> pd.DataFrame:
    """Growth of every cost by pair and K."""
    lines = []
    for (scene, k), group in frame.groupby(["sequence", "k"]):
        fits = {title: fit(group["n"], group[column]) for column, title in COSTS.items()}
        if any(fits.values()):
            texts = {title: "-" if f is None else str(f) for title, f in fits.items()}
            lines.append({"pair": scene, "K": str(k), **texts})
    return pd.DataFrame(lines, columns=["pair", "K", *COSTS.values()]).set_index(["pair", "K"])


def speed_page(frame: pd.DataFrame) -> str:
    """The page of all rows."""
    good = with_costs(frame)
    lines = ["# Speed and growth", "", _conclusion(good), ""]
    if len(good):
        index = pd.MultiIndex.from_frame(good[list(RUN)].rename(columns=RUN))
        main = good.reindex(columns=list(COLUMNS)).set_axis(index)
        forms = dict(COLUMNS.values())
        lines += markdown(main.rename(columns={c: t for c, (t, _) in COLUMNS.items()}), forms)
        lines += ["", NOTE, "", "## Growth: cost = factor N^p", "", *markdown(growth(good))]
        stages = good.reindex(columns=[f"wall.{p}" for p in PHASES]).set_axis(list(PHASES), axis=1)
        lines += ["", "## Wall seconds by stage", ""]
        lines += markdown(stages.astype(float).set_axis(index), dict.fromkeys(PHASES, ".2f"))
    facts = {"date": date.today(), **machine()}.items()
    lines += ["", "## Machine", "", *(f"- {k}: {v}" for k, v in facts)]
    return page_text([*lines, *failures(frame)])


def _conclusion(frame: pd.DataFrame) -> str:
    """Summary of the table in sentences."""
    if frame.empty:
        return "No run ended with a result."
    large = frame[frame["n"] > 0.8 * frame["n"].max()]
    costs, energies, times = (
        f"{values.min():.{digits}f} to {values.max():.{digits}f}"
        for values, digits in (
            (large["cpu.nlp"], 1),
            (frame["energy_to_reference"], 4),
            (frame["time_to_reference"], 2),
        )
    )
    return (
        f"{int(frame['converged'].sum())} of {len(frame)} runs converged to their tolerance."
        f" With the most superpixels (about {large['n'].max()}) the NLP takes {costs} CPU s"
        f" ({len(large)} runs). Its energy is {energies} times that of Levenberg-Marquardt on the"
        f" same smoothing, its CPU time {times} times."
    )


def plot_growth(path: Path, frame: pd.DataFrame) -> None:
    """CPU seconds of NLP, reference solver and other stages, and peak memory, over N (log-log)."""
    picture = figure(11, 4)
    left, right = picture.subplots(1, 2)
    good = with_costs(frame)
    groups = good.sort_values("n").groupby(["sequence", "k"]) if len(good) else ()
    for index, ((scene, k), group) in enumerate(groups):
        style = {"color": f"C{index % 10}"}
        slope = fit(group["n"], group["cpu.nlp"])
        label = f"{scene}, K {k}" + (f": N^{slope.exponent:.2f}" if slope else "")
        left.loglog(group["n"], group["cpu.nlp"], "o-", label=label, **style)
        left.loglog(group["n"], group["outside"], ".:", alpha=0.6, **style)
        left.loglog(group["n"], group["reference.cpu_seconds"], "x", alpha=0.7, **style)
        right.loglog(group["n"], group["GB"], "o-", **style)
    left.set(xlabel="superpixels N", ylabel="CPU s")
    left.set_title("NLP (o), reference solver (x), all stages outside (.)", fontsize=10)
    right.set(xlabel="superpixels N", ylabel="GB", title="peak memory")
    if len(good):
        left.legend(fontsize=8)
    save(picture, path)


def values(frame: pd.DataFrame) -> dict[str, dict[str, float]]:
    """The values that the gate compares, by key of the run."""
    good = with_costs(frame)
    nonzeros = good.reindex(columns=["sizes.hessian_nonzeros", "sizes.jacobian_nonzeros"])
    table = pd.DataFrame(
        {
            "key": good["key"],
            "iterations": good.get("iterations"),
            "energy": good.get("energy.total"),
            "nonzeros": nonzeros.astype(float).sum(axis=1),
            "energy_to_reference": good.get("energy_to_reference"),
            "time_to_reference": good.get("time_to_reference"),
            "not converged": 1.0 - good.get("converged", pd.Series(dtype=float)).astype(float),
        }
    )
    return {r.pop("key"): {k: float(v) for k, v in r.items()} for r in table.to_dict("records")}


def baseline(frame: pd.DataFrame, settings: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Contents of a baseline file.

    Raises:
        DataError: a run failed.
    """
    found = values(frame)
    keys = [speed_cell(**own).identity()["key"] for own in settings]
    bad = [key for key in keys if key not in found]
    if bad or not keys:
        raise DataError("no baseline of runs that failed", found=", ".join(bad) or "no run")
    runs = [{"settings": dict(s), "values": found[k]} for s, k in zip(settings, keys, strict=True)]
    return {"version": VERSION, "machine": machine(), "runs": runs}


def read_baseline(path: Path) -> list[tuple[dict[str, Any], dict[str, float]]]:
    """Settings and values of the runs of a baseline.

    Raises:
        DataError: the file is missing or no baseline.
    """
    try:
        tree = read_json(path, "baseline")
        if tree["version"] != VERSION:
            raise ValueError(f"version {tree['version']}")
        return [(dict(run["settings"]), dict(run["values"])) for run in tree["runs"]]
    except (DataError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            "not a baseline of bench speed",
            where=path,
            found=error,
            expected=f"JSON of version {VERSION}",
            hint="soup-nlp bench speed --scenes street --superpixels 250 --write-baseline FILE",
        ) from error


def check(
    frame: pd.DataFrame, runs: Sequence[tuple[Mapping[str, Any], Mapping[str, float]]]
) -> pd.DataFrame:
    """Every value of every run of a baseline: run, value, old, new, limit, ok.

    A failed or missing run has one line, which is not ok.
    """
    found, lines = values(frame), []
    for settings, old in runs:
        key = speed_cell(**settings).identity()["key"]
        if key not in found:
            lines.append((key, "run", 1.0, np.nan, 1.0, False))
            continue
        for name, (factor, addition) in LIMITS.items():
            new, limit = found[key][name], factor * old[name] + addition
            lines.append((key, name, old[name], new, limit, new <= limit))
    return pd.DataFrame(lines, columns=["run", "value", "old", "new", "limit", "ok"])
