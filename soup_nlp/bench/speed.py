"""`bench speed`: seconds, energy and memory of solves by stage, over N, K and the image size."""

import time
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import pandas as pd

from soup_nlp.bench.accuracy import scores
from soup_nlp.bench.processes import machine
from soup_nlp.bench.study import Cell, Item, metric, page_text, provenance, titled
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
RUN = {"pair": "pair", "n": "N", "k": "K"}
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
    "whole": ("whole, s", ".0f"),
    "status": ("status", ""),
}
"""Title and format of every column of the main table, by column of the frame."""
NOTE = (
    "CPU s and wall s: the whole NLP. E: exact energy. MRE after median scale, no cap. dual inf.,"
    " constraints: recomputed at Ipopt's answer. GB: peak of the process. Outside: flow,"
    " segmentation, start, evaluation, output with every picture, point cloud and HDF5. Whole: wall"
    " seconds from the images to the files, refinement included where it is on. Wall times of a"
    " shared machine vary with its load; CPU times less so. One thread."
)


# --- the measurement ------------------------------------------------------------------------------


def timed_pairs(
    scenes: Sequence[str],
    seeds: Sequence[int],
    widths: Sequence[int] = (1024,),
    pairs: Sequence[str] = (),
    data: Path | None = None,
) -> list[Item]:
    """Rendered scenes and the motorcycle, then named pairs of the suite shared, with DIS flow."""
    sizes = [Options(("dis",), width, tuple(seeds)) for width in widths]
    rendered = [i for size in sizes for i in list_suite("rendered", None, size)]
    items = [i for i in rendered if i.sequence in scenes]
    items += [MOTORCYCLE] * (MOTORCYCLE.name in scenes)
    return items + (
        list_suite("shared", data, Options(("dis",), only=tuple(pairs))) if pairs else []
    )


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
    functions = sum(s.evaluating for s in solution.stages)
    stages = sum(s.seconds for s in solution.stages)
    return {
        "build": max(0.0, wall - stages),
        "functions": functions,
        "linear algebra": max(0.0, stages - functions),
    }


# --- the page ---------------------------------------------------------------------------------


def with_costs(frame: pd.DataFrame) -> pd.DataFrame:
    """The good rows of a frame with the costs that the tables need."""
    if "cpu.nlp" not in frame:
        return frame.iloc[:0]
    out = frame[frame["ok"].eq(True)].copy()
    out["outside"] = out.reindex(columns=[f"cpu.{s}" for s in OUTSIDE]).astype(float).sum(axis=1)
    out["start"], out["GB"] = metric(out, "start"), out["peak_bytes"].astype(float) / 2**30
    stages = [f"stages.{s}" for s in (*OUTSIDE, "nlp", "refine")]
    out["whole"] = out.reindex(columns=stages).astype(float).sum(axis=1)
    return out


def speed_page(frame: pd.DataFrame) -> str:
    """Markdown page of the rows: runs, seconds by stage, machine."""
    good = with_costs(frame)
    blocks = ["# Speed", f"{provenance(frame)}."]
    if len(good):
        runs = good.set_axis(pd.MultiIndex.from_frame(good[list(RUN)].rename(columns=RUN)))
        blocks += [titled(runs, COLUMNS), NOTE]
        stages = {f"stages.{phase}": (phase, ".2f") for phase in PHASES}
        blocks += ["## Wall seconds by stage", titled(runs, stages)]
    blocks += ["## Machine", "\n".join(f"- {k}: {v}" for k, v in machine().items())]
    return page_text(blocks, frame)
