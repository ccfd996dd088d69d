"""`bench speed`: seconds, energy and memory of solves by stage, and their growth with N."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import linregress

from soup_nlp.bench.accuracy import scores
from soup_nlp.bench.processes import machine
from soup_nlp.bench.study import Cell, Item, markdown, metric, page_text, provenance, titled
from soup_nlp.bench.suites import MOTORCYCLE, Options, list_suite
from soup_nlp.pipeline.run import run
from soup_nlp.report.folder import prepare_folder, write_folder
from soup_nlp.solve.stages import Solution
from soup_nlp.storage.rows import Row, peak_bytes
from soup_nlp.storage.system import scratch

OUTSIDE = ("flow", "segmentation", "start", "evaluation", "output")
"""All stages but the NLP and the loading or rendering of the frames."""
PHASES = ("load", *OUTSIDE[:3], "build", "functions", "linear algebra", *OUTSIDE[3:])
"""Stages of a run; build, functions and linear algebra are the NLP."""
RUN = {"sequence": "pair", "n": "N", "k": "K"}
COLUMNS = {
    "cpu.nlp": ("CPU s", ".1f"),
    "stages.nlp": ("wall s", ".1f"),
    "iterations": ("its", ".0f"),
    "each": ("its by stage", ""),
    "energy_start.total": ("E start", ".2f"),
    "energy.total": ("E", ".3f"),
    "start": ("MRE start", ".4f"),
    "mre": ("MRE", ".4f"),
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
    "CPU s and wall s: the whole NLP. E: exact energy. MRE after median scale, no cap. dual inf.,"
    " constraints: recomputed at Ipopt's answer. GB: peak of the process. Outside: flow,"
    " segmentation, start, evaluation, output with every picture, point cloud and HDF5. Wall times"
    " of a shared machine vary with its load; CPU times less so. One thread."
)


# --- the measurement ------------------------------------------------------------------------------


def timed_pairs(
    scenes: Sequence[str],
    seeds: Sequence[int],
    width: int = 1024,
    pairs: Sequence[str] = (),
    data: Path | None = None,
) -> list[Item]:
    """Rendered scenes and the motorcycle, then named pairs of the suite shared, with DIS flow."""
    rendered = list_suite("rendered", None, Options(("dis",), width, tuple(seeds)))
    items = [i for i in rendered if i.sequence in scenes]
    items += [MOTORCYCLE] * (MOTORCYCLE.name in scenes)
    named = list_suite("shared", data, Options(("dis",), only=tuple(pairs))) if pairs else []
    return items + [replace(pair, sequence=pair.name) for pair in named]


def speed_cells(
    items: Sequence[Item],
    sizes: Sequence[int],
    neighbours: Sequence[int],
    overrides: Sequence[str] = (),
) -> list[Cell]:
    """Timed runs of pairs over N and K, small N first: the NLP without refinement.

    A rendered scene has its seed in the solve as well.
    """
    return [
        Cell(
            item,
            (
                f"segmentation.superpixels={n}",
                f"segmentation.neighbours={k}",
                f"seed={item.input.get('seed', 0)}",
                "refine.enabled=false",
                *overrides,
            ),
            f"N {n}, K {k}",
        )
        for n, k, item in product(sorted(sizes), sorted(neighbours), items)
    ]


def measure_speed(cell: Cell) -> Row:
    """The scores of a run, and the cost of every stage.

    Returns:
        Entries of `accuracy.scores`, whose "stages" have "output" and the parts of "nlp" too, "cpu"
        seconds by stage, and "peak_bytes"; further numbers by the names of the solution.

    Raises:
        SoupError: the input cannot be used.
    """
    cpu, begin = {"": time.process_time()}, time.perf_counter()

    def lap(stage: str) -> None:
        cpu[stage] = time.process_time() - sum(cpu.values())

    problem = cell.item.problem(cell.overrides)
    result = run(problem, on_stage=lap)
    solution = result.solution
    with scratch() as folder:
        write_folder(prepare_folder(folder / "result"), result, "")
    lap("output")
    del cpu[""]
    spent, peak, row = time.perf_counter() - begin, peak_bytes(), scores(result)
    whole = sum(v for k, v in result.seconds.items() if not k.startswith("nlp_"))
    row["stages"] |= {**_parts(row["stages"]["nlp"], solution), "output": spent - whole}
    return {
        **row,
        "n": len(result),
        "k": problem.segmentation.neighbours,
        "sizes": solution.nlp,
        "cpu": cpu | {"nlp": sum(solution.cpu_seconds.values())},
        "each": " + ".join(str(s.iterations) for s in solution.stages),
        "energy": dict(solution.energy),
        "energy_start": dict(solution.energy_start),
        "residuals": dict(solution.residuals),
        "peak_bytes": peak,
    }


def _parts(wall: float, solution: Solution) -> dict[str, float]:
    """Wall seconds of the parts of the NLP; all time outside the stages counts as building."""
    functions = sum(sum(s.calls.values()) for s in solution.stages)
    stages = sum(s.seconds for s in solution.stages)
    return {
        "build": max(0.0, wall - stages),
        "functions": functions,
        "linear algebra": max(0.0, stages - functions),
    }


# --- the page ---------------------------------------------------------------------------------


def with_costs(frame: pd.DataFrame) -> pd.DataFrame:
    """The good rows of a frame with the costs and ratios that the tables need."""
    if "cpu.nlp" not in frame:
        return frame.iloc[:0]
    out = frame[frame["ok"].eq(True)].copy()
    out["outside"] = out.reindex(columns=[f"cpu.{s}" for s in OUTSIDE]).astype(float).sum(axis=1)
    out["start"], out["GB"] = metric(out, "start"), out["peak_bytes"].astype(float) / 2**30
    out["cpu an iteration"] = out["cpu.nlp"] / out["iterations"].clip(lower=1)
    return out


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """p of the fit log cost = log factor + p log N; NaN for sizes that hardly vary."""
    n, c = np.asarray(sizes, float), np.asarray(costs, float)
    x, y = np.log(n[c > 0]), np.log(c[c > 0])
    # actual numbers of superpixels differ a little between seeds of one size
    return float(linregress(x, y).slope) if len(x) and np.ptp(x) >= 0.2 else np.nan


def growth(frame: pd.DataFrame) -> pd.DataFrame:
    """Exponent of every cost by pair and K, for pairs that ran at several sizes."""
    lines = {
        (pair, str(k)): {t: exponent(group["n"], group[column]) for column, t in COSTS.items()}
        for (pair, k), group in frame.groupby(["sequence", "k"])
    }
    table = pd.DataFrame.from_dict(lines, orient="index", columns=list(COSTS.values()))
    return table.rename_axis(["pair", "K"] if lines else None).dropna(how="all")


def speed_page(frame: pd.DataFrame) -> str:
    """Markdown page of the rows: conclusion, runs, growth with N, seconds by stage, machine."""
    good = with_costs(frame)
    blocks = ["# Speed and growth", f"{provenance(frame)}."]
    if len(good):
        runs = good.set_axis(pd.MultiIndex.from_frame(good[list(RUN)].rename(columns=RUN)))
        blocks += [titled(runs, COLUMNS), NOTE]
        blocks += ["## Growth: cost = factor N^p", markdown(growth(good), ".2f")]
        stages = {f"stages.{phase}": (phase, ".2f") for phase in PHASES}
        blocks += ["## Wall seconds by stage", titled(runs, stages)]
    blocks += ["## Machine", "\n".join(f"- {k}: {v}" for k, v in machine().items())]
    return page_text(blocks, frame)
