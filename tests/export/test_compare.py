"""Comparison of solvers: limits, verification, resuming, the table; real solvers on a tiny soup."""

import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from helpers_files import sets
from helpers_model import PAPER, Tiny

from benchmarks.family.sol import write_sol
from soup_nlp.cli import problems as command
from soup_nlp.cli.main import main
from soup_nlp.config.problem import load_problem
from soup_nlp.errors import DataError, SolverError
from soup_nlp.export.compare import compare, limit_process, page, verified
from soup_nlp.export.solvers import Answer, Task, available, executable, find_solver
from soup_nlp.export.verify import Limits
from soup_nlp.model.formulation import Formulation
from soup_nlp.storage.each import each, read_rows

pytestmark = pytest.mark.usefixtures("simple_starts")

LABEL = {
    "problem": "tiny",
    "identity": "0",
    "superpixels": 4,
    "formulation": "unit-offset",
    "start": "proposal",
    "energy_limit": np.finfo(float).max,
}
LIMITS = Limits(seconds=20, iterations=200, tol=1e-5)


def make_task(limits: Limits = LIMITS) -> Task:
    tiny = Tiny(neighbours=2, samples=3, boundary_samples=1, superpixels=4)
    # wide smoothing: with 0.2 the way from a cold start is so long that rounding decides its end
    # (a length of 1, which is the focal length in pixels)
    wide = float(tiny.data.K_next[0, 0])
    style = Formulation(hessian="exact", eps=wide, eps_pixel=1.0)
    return Task(*tiny.nlp(PAPER, style), tiny.soup, tiny.data, PAPER, style, limits)


@pytest.fixture(scope="module")
def task() -> Task:
    return make_task()


def run(names: list[str], folder: Path, limits: Limits = LIMITS, make=make_task) -> list:
    return compare([(LABEL, make)], names, limits, folder / "r.jsonl", lambda line: None)


def program(folder: Path, text: str) -> Path:
    path = folder / "my solver"
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


# --- limits --------------------------------------------------------------------------------------


def limited(limits: Limits, work: Callable[[], object]) -> dict:
    limit_process(limits, sum(os.times()[:4]))
    work()
    return {}


@pytest.mark.slow
def test_time_and_memory_are_limited():
    small = replace(LIMITS, seconds=0.0, memory=1 << 30)
    jobs = {
        "memory": partial(limited, small, partial(np.ones, 10**9)),
        # the system counts whole seconds, one more than the limit
        "time": partial(limited, small, lambda: sum(iter(int, 1))),
    }
    rows = dict(each(jobs, fresh=True))
    assert "MemoryError" in rows["memory"]["error"]
    assert "SIGXCPU" in rows["time"]["error"]


# --- solvers -------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ipopt-tuned", "ipopt-adaptive", "pounce"])
def test_solvers_reach_a_verified_point(name, tmp_path, request):
    if name not in available():
        pytest.skip(f"{name} is not installed")
    # one of them in a process with limits
    if name != "ipopt-tuned":
        request.getfixturevalue("one_process")
    (row,) = run([name], tmp_path)
    assert row["verified"], row
    assert row["status"] != "Time_Limit"
    assert row["energy"] < row["energy_start"]
    assert row["peak_bytes"] > 1e7


def test_names_of_solvers(tmp_path):
    with pytest.raises(SolverError, match="not here"):
        find_solver("knitro_that_is_not_installed")
    assert set(available()) >= {"ipopt", "ipopt-adaptive", "ipopt-tuned", "soup-nlp"}
    assert callable(find_solver(str(program(tmp_path, "exit 0"))))


@pytest.mark.slow
def test_a_program_runs_in_a_folder_of_its_own(task, tmp_path, monkeypatch):
    mine = program(tmp_path, "exit 3")
    monkeypatch.chdir(tmp_path)
    (row,) = run([str(mine)], tmp_path)
    assert row["error"].startswith("SolverError: solver wrote no .sol")
    assert row["solver"] == str(mine)
    # nothing of the run beside the program
    assert not list(tmp_path.glob("*.log"))
    # an answer to an earlier problem is not read
    order = np.arange(task.nlp.nx), np.arange(task.nlp.ng)
    write_sol(tmp_path / "soup.sol", task.nlp.x0, None, *order, "earlier", 0)
    with pytest.raises(SolverError, match="wrote no"):
        executable(str(mine), task)
    assert executable(str(program(tmp_path, "kill -s SEGV $$")), task).status == "killed by SIGSEGV"


def test_a_program_that_only_waits_has_no_answer(task, tmp_path, monkeypatch):
    # it uses no CPU time, so that wall time ends it
    monkeypatch.setattr("soup_nlp.export.solvers.WALL_PER_CPU", 0.2)
    monkeypatch.chdir(tmp_path)
    mine = program(tmp_path, "exec sleep 30")
    answer = executable(str(mine), replace(task, limits=replace(LIMITS, seconds=1.0)))
    assert (answer.status, answer.x, answer.claimed) == ("Time_Limit", None, False)


# --- verification --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def exact(task) -> Answer:
    """The answer of a solver that converges."""
    return find_solver("ipopt-tuned")(task)


@pytest.mark.parametrize(
    ("says", "seconds", "claimed", "good"),
    [
        (True, 19.0, True, True),
        (False, 19.0, False, True),
        # after the time limit
        (True, 21.0, False, False),
    ],
)
def test_one_tolerance_decides_within_the_limit(says, seconds, claimed, good, exact, task):
    row = verified(task, replace(exact, claimed=says), seconds, np.inf)
    assert (row["claimed"], row["verified"], row["cpu"]) == (claimed, good, seconds)
    assert row["status"].startswith("over the time limit") == (seconds > 20)


def test_false_claims_are_told(exact, task):
    nothing = verified(task, Answer(None, None, "gone", True), 1.0, np.inf)
    assert (nothing["claimed"], nothing["verified"]) == (False, False)
    for x in (task.nlp.x0, np.full(task.nlp.nx, np.nan), 2 * exact.x):
        row = verified(task, Answer(x, None, "fine", True), 1.0, np.inf)
        assert (row["claimed"], row["verified"]) == (True, False)
    # a worse energy than the start's is no solution, however stationary
    energy = verified(task, exact, 1.0, np.inf)["energy"]
    assert not verified(task, exact, 1.0, 0.9 * energy)["verified"]


# --- rows and the page ---------------------------------------------------------------------------


def quick(limits: Limits) -> Task:
    raise DataError("pair cannot be prepared", where="image", found="nothing")


@pytest.mark.slow
@pytest.mark.usefixtures("one_process")
def test_runs_resume_and_an_error_is_a_row(tmp_path):
    assert [row["solver"] for row in run(["ipopt-tuned"], tmp_path)] == ["ipopt-tuned"]
    first = (tmp_path / "r.jsonl").read_text()
    run(["ipopt-tuned"], tmp_path)
    assert (tmp_path / "r.jsonl").read_text() == first
    # other limits, other runs; an error is no measurement
    for _ in range(2):
        (row,) = run(["ipopt-tuned"], tmp_path, replace(LIMITS, tol=1e-3), quick)
        assert "pair cannot be prepared" in row["error"]
    rows = read_rows(tmp_path / "r.jsonl")
    assert len(rows) == 3
    text = page([row | LABEL for row in rows], LIMITS)
    assert "| tiny | 4 | unit-offset | ipopt-tuned | yes |" in text
    assert "where: image, found:" in text
    assert "3 runs: 1 verified.** Verified runs by solver: ipopt-tuned 1." in text


SMALL = sets(
    "input.width=96 input.height=64 flow.source=truth segmentation.neighbours=4"
    " energy.pixel_samples=4 segmentation.superpixels=12"
)


def test_files_are_read_before_anything_runs(tmp_path, capsys):
    words = ["-o", str(tmp_path), "--solvers", "soup-nlp,soup-nlp", "--seconds", "5", *SMALL]
    assert main(["compare", "orbit", "orbitt.yaml", *words]) == 2
    assert main(["compare", "orbit", *words, "--set", "segmentation.superpixels=0"]) == 2
    assert "superpixels" in capsys.readouterr().err
    assert main(["compare", "orbit", *words, "--seconds", "-1"]) == 2
    assert main(["compare", "orbit", *words, "--solvers", "nothing"]) == 2
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.usefixtures("one_process")
def test_an_interrupted_comparison_has_a_page_and_goes_on(tmp_path, monkeypatch, capsys):
    pages = []

    def second_is_interrupted(rows, limits):
        pages.append(len(rows))
        if len(pages) == 2:
            raise KeyboardInterrupt
        return page(rows, limits)

    monkeypatch.setattr(command, "page", second_is_interrupted)
    out = tmp_path / "out"
    words = ["compare", "orbit", "--solvers", "ipopt-tuned,soup-nlp", "--seconds", "20"]
    # the first solver need not converge
    words += ["--iterations", "30", "-o", str(out), *SMALL]
    assert main(words) == 130
    assert "1 runs" in (out / "README.md").read_text()
    assert "the runs that were finished are kept" in capsys.readouterr().err
    first, _ = read_rows(out / "runs.jsonl")
    assert np.isfinite(first["energy"])
    # a file that was replaced makes another task
    assert first["identity"] == load_problem("orbit", SMALL[1::2]).identity()
    assert main(words) == 0
    assert "2 runs" in (out / "README.md").read_text()
    # the solve of the package is verified
    same, package = read_rows(out / "runs.jsonl")
    assert same == first
    assert package["verified"]
