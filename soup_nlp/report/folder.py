"""Result folders: that of a run, which writes and draws itself, and those of many pairs."""

import os
import shutil
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import wraps
from pathlib import Path
from typing import ParamSpec, Required

import numpy as np
import psutil
from PIL.Image import Image
from typing_extensions import TypedDict

from soup_nlp.arrays import AnyFloat
from soup_nlp.config.problem import Problem, dump_problem
from soup_nlp.data.formats.images import DataWarning
from soup_nlp.errors import DataError, SoupError
from soup_nlp.pipeline import run as pipeline
from soup_nlp.pipeline.case import solve_bytes
from soup_nlp.pipeline.record import Run
from soup_nlp.report.chain import Chain
from soup_nlp.report.figures import shown, write_depth_png16, write_png
from soup_nlp.report.formats import check_formats, write_formats
from soup_nlp.report.layout import LAYOUT
from soup_nlp.report.page import page
from soup_nlp.report.pictures import overview, pictures
from soup_nlp.report.result import PAGE, result_of
from soup_nlp.report.verdict import exit_code, facts, summary
from soup_nlp.storage.each import Row, failed, read_rows
from soup_nlp.storage.files import as_path, fits, is_file, write_json, write_text
from soup_nlp.storage.folders import claim, read_sums, staged
from soup_nlp.storage.store import write_h5
from soup_nlp.storage.versions import code_version

FILES = (
    *("config.yaml", "result.h5", "summary.json", "log.txt", "ipopt.log"),
    *("depth_ref.png", "depth_next.png", "depth_ref_colour.png", "overview.png", PAGE),
    *("trajectory.tum", "points_ref.ply", "points_next.ply"),
)
"""Files of a result folder."""
FULL = ("depth_ref_full.png", "depth_next_full.png")
"""Further ones of a pair that was solved at a smaller size than that of its images."""
FAILED = "failed.log"
"""Log of a solve that failed; the next result removes it."""
PAIRS = "pairs"
"""Folder with the results of the pairs."""
ROWS = "pairs.jsonl"
"""Every row that was ever made; the last one of a pair describes its folder."""


def prepare_folder(
    folder: str | Path, inputs: Iterable[Path] = (), overwrite: bool = False, subject: str = ""
) -> Path:
    """Check that a result can be written into a folder, before anything is computed.

    `inputs` are files and folders of the problem, which may not lie in it; for `overwrite`,
    `subject` and errors see `storage.folders.claim`.
    """
    folder = as_path(folder, "output folder")
    # realpath, unlike resolve, accepts a link to itself
    here = Path(os.path.realpath(folder))
    for source in inputs:
        if here in (source, source.parent):
            raise DataError(
                "an input lies in the output folder",
                where=folder,
                found=source.name,
                expected="a folder of its own: depth and flow of a result would pass for truth",
                hint="choose another --out",
            )
    return claim(folder, (*FILES, *FULL, FAILED), overwrite, subject)


def write_folder(
    folder: Path,
    run: Run,
    log: str | Callable[[list[str]], str],
    verdict: str | None = None,
    ipopt_log: Path | None = None,
    formats: Sequence[str] = (),
    overwrite: bool = False,
) -> list[str]:
    """Write every file of a run and return their names.

    An earlier result is replaced when the new one is complete.

    Args:
        folder: Prepared folder.
        run: The run.
        log: Text of the log, or a function that makes it from the names of the other files.
        verdict: Verdict for summary.json and the page; None for `facts`.
        ipopt_log: Log file of Ipopt.
        formats: Further formats, see `formats.FORMATS`.
        overwrite: Overwrite files that the program did not make.
    """
    config = dump_problem(run.problem)
    with staged(folder, True, overwrite, run.problem.subject) as new:
        if ipopt_log is not None and ipopt_log.is_file():
            shutil.copy(ipopt_log, new / "ipopt.log")
        write_text(new / "config.yaml", config)
        words = facts(run) if verdict is None else verdict
        contents = {**summary(run), "verdict": words.splitlines()}
        result = result_of(run, contents)
        chain, rec = Chain.of(result), run.reconstruction
        drawn = pictures(chain)
        depths: dict[str, AnyFloat] = {"ref": rec.depth_ref, "next": rec.depth_next}
        if run.full is not None:
            depths |= {"ref_full": run.full.depth_ref, "next_full": run.full.depth_next}
        scales = {
            name: write_depth_png16(new / f"depth_{name}.png", z) for name, z in depths.items()
        }
        write_png(new / "depth_ref_colour.png", drawn["depth_ref"].image)
        write_png(new / "overview.png", overview(drawn, result.title))
        write_formats(new, chain, ("tum", "ply", *formats))
        if run.problem.output.page:
            write_text(new / PAGE, page(chain, drawn))
        write_json(new / "summary.json", {**contents, "depth_png_scale": scales})
        about = {"name": run.problem.name, "config": config}
        unit = {"truth": result.metre_unit}
        rows = {k: row._replace(unit=unit.get(row.unit, row.unit)) for k, row in LAYOUT.items()}
        write_h5(new / "result.h5", result.tree, about, rows)
        names = {path.name for path in new.iterdir()} | {"log.txt"}
        files = [name for name in FILES if name in names] + sorted(names.difference(FILES))
        write_text(new / "log.txt", log if isinstance(log, str) else log(files))
    return files


def write_failure(folder: Path, log: str, ipopt_log: Path, overwrite: bool = False) -> None:
    """Write the log of a failed solve, followed by that of Ipopt; an earlier result is kept."""
    with suppress(OSError):
        log += ipopt_log.read_text(encoding="utf-8", errors="replace")
    with staged(folder, overwrite=overwrite) as new:
        write_text(new / FAILED, log)


# --- the run that Python gets --------------------------------------------------------------------

Params = ParamSpec("Params")


@dataclass(frozen=True, eq=False, repr=False)
class WritableRun(Run):
    """A run with its result folder and its overview."""

    def save(
        self, folder: str | Path, formats: Sequence[str] = (), overwrite: bool = False
    ) -> list[str]:
        """Write a result folder, as `soup-nlp solve` does; returns the names of its files.

        Args:
            folder: A new or empty folder, or that of an earlier result.
            formats: Further files for other programs: "glb", "colmap", "npy", "pfm", "rrd" ...
            overwrite: Overwrite files that the program did not make.

        Raises:
            ConfigError: a format is not known.
            DataError: the folder cannot be written, or holds what is not to be overwritten.
        """
        none = formats is None or (isinstance(formats, list | tuple) and not formats)
        names = [] if none else check_formats(formats)
        in_memory = self.problem.input.kind == "memory"
        inputs = [] if in_memory else self.problem.input_paths()
        target = prepare_folder(folder, inputs, overwrite, self.problem.subject)
        return write_folder(target, self, f"{self}\n", formats=names, overwrite=overwrite)

    def plot(self) -> Image:
        """The overview as a picture: notebooks show it, `.save` writes it."""
        return result_of(self, summary(self)).plot()

    def _repr_html_(self) -> str:
        return shown(str(self), np.asarray(self.plot()))


def _writable(solve: Callable[Params, Run]) -> Callable[Params, WritableRun]:
    """The same function with a `WritableRun` as its result."""

    @wraps(solve)
    def solved(*args: Params.args, **options: Params.kwargs) -> WritableRun:
        done = solve(*args, **options)
        return WritableRun(**{field.name: getattr(done, field.name) for field in fields(done)})

    return solved


run, solve_pair = _writable(pipeline.run), _writable(pipeline.solve_pair)


# --- pairs of a batch or a chain: each in a folder of its own, with a row in one file -------------


class StoredRow(TypedDict, total=False):
    """What is read back of a row."""

    key: Required[str]
    error: str | None
    exit_code: int
    reason: str
    mre: float | None
    constant: float | None
    drawn: float | None
    seconds: float
    cpu_seconds: float
    peak_bytes: float
    superpixels: int
    result: str


def head(problem: Problem) -> Row:
    """What a row says of a pair before it is solved: if all of it is the same, so is the result."""
    own = {"key": problem.name, "pair": problem.name, "seed": problem.seed}
    return {**own, "identity": problem.identity(), "code": code_version()}


def kept_rows(folder: Path, heads: Mapping[str, Row]) -> dict[str, Row]:
    """Rows of the pairs that have been solved, or have failed, with the same input and code."""
    last = {row["key"]: row for row in read_rows(folder / ROWS) if fits(row, StoredRow)}
    same = {k: last[k] for k, own in heads.items() if own.items() <= last.get(k, {}).items()}
    # a command that was killed may have replaced a result before it wrote the row
    stored = {name: _result(folder / PAIRS / name) for name in same}
    return {k: row for k, row in same.items() if failed(row) or stored[k] == row.get("result", "")}


def _result(place: Path) -> str | None:
    """What the list of a result folder says of its arrays: a hash, or "" for none."""
    sums = read_sums(place)
    known = sums.files.get("result.h5", "") if sums else ""
    return known if is_file(place / "result.h5") else None


def places(names: Iterable[str]) -> list[str]:
    """Names below the folders of pairs, for `claim`: no file or link may be in their way."""
    # nothing is called so
    return [f"{PAIRS}/{name}/-" for name in names]


def fitting(workers: int, problems: Iterable[Problem]) -> int:
    """How many of some workers have room in the free memory, whichever problems they solve."""
    needs = 1.0
    for problem in problems if workers > 1 else ():
        # an image that cannot be read is an error of its row
        with suppress(SoupError):
            needs = max(needs, sum(solve_bytes(problem, problem.load_pair()).values()))
    return max(1, min(workers, int(psutil.virtual_memory().available / needs)))


def solve_into(problem: Problem, folder: Path) -> Row:
    """Solve a pair into its folder below the one of all pairs."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        solved = run(problem)
        solved.save(place := folder / PAIRS / problem.name)
    code, why = exit_code(solved, problem.expected.mre_at_most)
    texts = [str(w.message) for w in caught if issubclass(w.category, DataWarning)]
    scores = {name: m.mre for name, m in solved.metrics.items()}
    return {
        "exit_code": code,
        "reason": why,
        "converged": solved.solution.converged,
        "components": len(solved.components),
        "mre": scores.get("solution"),
        "constant": scores.get("constant"),
        "drawn": solved.confidence.share("drawn"),
        "superpixels": len(solved),
        "result": _result(place),
        "warnings": [*dict.fromkeys(texts)],
    }
