"""Pairs of a batch or a chain: each is solved into a folder of its own, with a row in one file."""

import warnings
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Required

import psutil
from typing_extensions import TypedDict

from soup_nlp.config.problem import Problem
from soup_nlp.data.formats.images import DataWarning
from soup_nlp.errors import SoupError
from soup_nlp.pipeline.case import solve_bytes
from soup_nlp.report.folder import run
from soup_nlp.report.verdict import exit_code
from soup_nlp.storage.each import Row, failed, read_rows
from soup_nlp.storage.files import fits, is_file
from soup_nlp.storage.folders import read_sums
from soup_nlp.storage.versions import code_version

PAIRS = "pairs"
"""Folder with the results of the pairs."""
ROWS = "pairs.jsonl"
"""Every row that was ever made; the last one of a pair describes its folder."""


class Stored(TypedDict, total=False):
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
    last = {row["key"]: row for row in read_rows(folder / ROWS) if fits(row, Stored)}
    same = {
        name: last[name]
        for name, own in heads.items()
        if name in last and own.items() <= last[name].items()
    }
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
