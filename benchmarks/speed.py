"""Seconds, energy and memory of solves by stage, over N, K and the image size."""

import os
import platform
import time
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import pandas as pd
import psutil

from benchmarks.scores import scores
from benchmarks.suites import MOTORCYCLE, Options, list_suite
from benchmarks.table import Cell, page_text, provenance, titled
from soup_nlp import run
from soup_nlp.storage.each import Row, peak_bytes
from soup_nlp.storage.versions import versions

OUTSIDE = ("flow", "segmentation", "start", "evaluation", "output")
"""All stages but the NLP and the loading or rendering of the frames."""
RUN = {"pair": "pair", "n": "N", "k": "K"}
COLUMNS = {
    "cpu.nlp": ("CPU s", ".1f"),
    "each": ("iterations", ""),
    "energy.total": ("E", ".3f"),
    "metrics.solution.mre": ("MRE", ".4f"),
    "GB": ("GB", ".2f"),
    "outside": ("outside, CPU s", ".1f"),
    "whole": ("whole, CPU s", ".0f"),
    "status": ("status", ""),
}
"""Title and format of every column of the main table, by column of the frame."""
NOTE = (
    "CPU s: the whole NLP. Iterations: of every stage. E: exact energy. MRE after median scale, no"
    " cap. GB: peak of the process. Outside: flow, segmentation, start, evaluation, output with"
    " every picture, point cloud and HDF5. Whole: from the images to the files, refinement included"
    " where it is on. One thread."
)


def speed_cells(
    scenes: Sequence[str],
    seeds: Sequence[int],
    widths: Sequence[int],
    sizes: Sequence[int],
    neighbours: Sequence[int],
    overrides: Sequence[str] = (),
) -> list[Cell]:
    """Timed runs of rendered scenes and the motorcycle with DIS flow: the NLP without refinement.

    N = `sizes` and K = `neighbours` vary, small N first. A rendered scene has its seed in the solve
    as well.
    """
    options = [Options(("dis",), width, tuple(seeds)) for width in widths]
    rendered = [item for each in options for item in list_suite("rendered", None, each)]
    items = [i for i in rendered if i.family in scenes]
    items += [MOTORCYCLE] * (MOTORCYCLE.name in scenes)
    cells = []
    for n, k, item in product(sorted(sizes), sorted(neighbours), items):
        sections = f"segmentation.superpixels={n}", f"segmentation.neighbours={k}"
        seed = f"seed={item.input.get('seed', 0)}"
        changes = (*sections, seed, "refine.enabled=false", *overrides)
        cells.append(Cell(item, changes, f"N {n}, K {k}"))
    return cells


def measure_speed(cell: Cell) -> Row:
    """The scores of a run, and CPU and wall seconds of its stages."""
    cpu = {"": time.process_time()}

    def lap(stage: str) -> None:
        cpu[stage] = time.process_time() - sum(cpu.values())

    problem = cell.item.problem(cell.overrides)
    result = run(problem, on_stage=lap)
    solution = result.solution
    with TemporaryDirectory() as folder:
        result.save(Path(folder) / "result")
    lap("output")
    del cpu[""]
    return {
        "peak_bytes": peak_bytes(),
        **scores(result),
        "n": len(result),
        "k": problem.segmentation.neighbours,
        "sizes": solution.nlp,
        "cpu": cpu,
        "each": "+".join(str(s.iterations) for s in solution.stages),
        "energy": dict(solution.energy),
        "energy_start": dict(solution.energy_start),
        "residuals": dict(solution.residuals),
    }


def speed_page(page: Path, frame: pd.DataFrame) -> str:
    """Markdown page of the rows: runs, machine; CPU seconds by stage are a CSV file beside it."""
    good = frame[frame["ok"].eq(True)]
    blocks = ["# Speed", f"{provenance(frame)}. Solves without a status succeeded."]
    if len(good):
        cpu = good.filter(regex="^cpu[.]").astype(float)
        runs = good.assign(
            outside=cpu.reindex(columns=[f"cpu.{s}" for s in OUTSIDE]).sum(axis=1),
            whole=cpu.drop(columns="cpu.load").sum(axis=1),
            GB=good["peak_bytes"].astype(float) / 2**30,
        )
        # what all solves share is said by the overrides
        several = [name for name in RUN if name != "k" or good["k"].nunique() > 1]
        runs.index = pd.MultiIndex.from_frame(good[several].rename(columns=RUN))
        failed = good["status"].ne("Solve_Succeeded").any()
        shown = {name: form for name, form in COLUMNS.items() if failed or name != "status"}
        stages = page.with_suffix(".csv")
        cpu.rename(columns=lambda name: name.removeprefix("cpu.")).set_axis(runs.index).to_csv(
            stages, float_format="%.2f"
        )
        blocks += [titled(runs, shown), f"{NOTE} [{stages.name}]({stages.name}): by stage."]
    memory = f"{psutil.virtual_memory().total / 2**30:.0f} GB"
    facts = ", ".join(f"{k} {v}" for k, v in versions().items())
    machine = f"{os.cpu_count()} cores of {processor()}, {memory}, {platform.platform()}; {facts}."
    return page_text([*blocks, "## Machine", machine], frame)


def processor() -> str:
    """Name of the processor."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    names = (x.partition(":")[2].strip() for x in lines if x.startswith("model name"))
    return next(names, platform.processor() or platform.machine())
