"""Comparison of solvers: isolation, verification, resuming; real solvers on a tiny soup."""

import os
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from helpers_model import PAPER, Tiny
from helpers_rows import threads

from soup_nlp.bench.processes import isolated
from soup_nlp.bench.solvers import runner
from soup_nlp.bench.solvers.page import frame_of_runs, page
from soup_nlp.bench.solvers.plugins import PLUGINS, Answer, Task
from soup_nlp.bench.solvers.runner import available, compare, executable, find_solver
from soup_nlp.errors import DataError, SolverError
from soup_nlp.export.sol import write_sol
from soup_nlp.export.verify import Limits, examine, violations
from soup_nlp.model.formulation import Formulation
from soup_nlp.storage.rows import ONE_THREAD, read_rows

pytestmark = pytest.mark.slow

MANY = 1 << 30
LABEL = {
    "problem": "tiny",
    "problem_hash": "0",
    "superpixels": 4,
    "formulation": "unit-offset/smooth",
    "start": "proposal",
    "energy_limit": np.finfo(float).max,
}
Solve = Callable[[Task], Answer]


def make_task(**form: str) -> Task:
    tiny = Tiny(neighbours=2, samples=3, boundary_samples=1, superpixels=4)
    # wide smoothing: with 0.2 the way from a cold start is so long that rounding decides its end
    # (a length of 1, which is the focal length in pixels)
    wide = float(tiny.data.K_next[0, 0])
    style = Formulation(hessian="exact", eps=wide, eps_pixel=1.0, compiled=False, **form)
    limits = Limits(seconds=20, iterations=200, tol=1e-5)
    return Task(*tiny.nlp(PAPER, style), tiny.soup, tiny.data, PAPER, style, limits)


@pytest.fixture(scope="module")
def task() -> Task:
    return make_task()


@pytest.fixture(scope="module")
def exact(task) -> Answer:
    """The answer of a solver that converges."""
    return find_solver("ipopt-tuned")(task)


def run(task: Task, names: list[str], folder: Path, say=lambda line: None, after=None) -> list:
    return compare(
        [(LABEL, lambda: task)], names, task.limits, folder / "r.jsonl", folder / "s", say, after
    )


@pytest.fixture
def stub(monkeypatch) -> Callable[[Solve], list[str]]:
    """Takes a function as the only solver; returns the list of the names that are looked up."""

    def take(solver: Solve) -> list[str]:
        names: list[str] = []
        monkeypatch.setattr(runner, "find_solver", lambda name: names.append(name) or solver)
        return names

    return take


def program(folder: Path, text: str) -> Path:
    path = folder / "my solver"
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


# --- isolation -----------------------------------------------------------------------------------


def test_a_function_returns_from_its_process(tmp_path):
    ended = isolated(lambda: (os.getpid(), np.arange(3)), tmp_path, 20, MANY)
    assert ended.how == "returned"
    assert ended.value[0] != os.getpid()
    assert ended.value[1].tolist() == [0, 1, 2]
    assert ended.peak_bytes > 0


def test_processes_and_plugins_have_one_thread(tmp_path, monkeypatch):
    for name in ONE_THREAD:
        monkeypatch.delenv(name, raising=False)
    assert isolated(threads, tmp_path, 20, MANY).value == ["1"] * 4
    seen = []
    monkeypatch.setattr(ca, "has_nlpsol", lambda library: seen.append(threads()))
    available()
    assert seen == [["1"] * 4] * len(PLUGINS)
    assert threads() == [None] * 4


def test_crashes_and_errors_are_answers(tmp_path):
    assert isolated(lambda: os._exit(3), tmp_path, 20, MANY).how == "crashed: exit code 3"

    def bad() -> None:
        raise SolverError("no licence", where="server", found="expired", hint="ask for one")

    ended = isolated(bad, tmp_path, 20, MANY)
    assert (ended.how, ended.value) == ("raised", "SolverError: no licence, found expired")
    ended = isolated(lambda: int("no"), tmp_path, 20, MANY)
    assert ended.how == "raised"
    assert ended.value.startswith("ValueError: invalid literal")
    ended = isolated(lambda: os.kill(os.getpid(), signal.SIGKILL), tmp_path, 20, MANY)
    words = "killed by SIGKILL, perhaps out of memory"
    assert (ended.how, ended.value) == ("crashed: SIGKILL", words)


def test_time_and_memory_are_limited(tmp_path, monkeypatch):
    monkeypatch.setattr("soup_nlp.bench.processes.GRACE", 0.2)
    ended = isolated(lambda: time.sleep(60), tmp_path, 0.1, MANY)
    assert (ended.how, ended.value) == ("killed: time", "wall time limit of 0.1 s reached")
    # the system counts whole seconds, one more than the limit
    ended = isolated(lambda: sum(iter(int, 1)), tmp_path, 600, MANY, cpu_seconds=0.0)
    assert (ended.how, ended.value) == ("killed: time", "CPU limit of 0 s reached")
    assert isolated(lambda: np.ones(10**9), tmp_path, 20, MANY).how == "killed: memory"


# --- solvers -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["ipopt-tuned", "fatrop", "pounce", "uno"])
def test_solvers_reach_a_verified_point(name, task, tmp_path):
    if name not in available():
        pytest.skip(f"{name} is not installed")
    (row,) = run(task, [name], tmp_path)
    assert row["how"] == "returned", row["status"]
    assert row["verified"], row
    assert row["status"] != "Time_Limit"
    assert row["energy"] < row["energy_start"]


def test_a_claim_with_the_gauss_newton_hessian_is_true(task, tmp_path):
    # whether it converges in 200 iterations depends on rounding; its claims must hold
    (row,) = run(task, ["ipopt-soup"], tmp_path)
    assert row["how"] == "returned", row["status"]
    assert row["iterations"] > 10
    assert row["verified"] == row["claimed"]


def test_a_soup_becomes_a_point_of_the_epigraph_form():
    task = make_task(norm="epigraph")
    x = task.point(replace(task.soup, t=1.1 * task.soup.t))
    size = task.layout.size
    assert np.abs(x[size:] - task.nlp.x0[size:]).max() > 1e-3
    assert violations(task.nlp, x)["rows"].max() < 1e-6
    # with the slack variables of the start it is off the constraints
    stale = np.concatenate([x[:size], task.nlp.x0[size:]])
    assert violations(task.nlp, stale)["rows"].max() > 1e-3
    assert examine(task.nlp, x, None).primal < 1e-6


def test_names_of_solvers(tmp_path):
    with pytest.raises(SolverError, match="not here"):
        find_solver("knitro_that_is_not_installed")
    assert set(available()) >= {n for n, r in PLUGINS.items() if ca.has_nlpsol(r.library)}
    assert callable(find_solver(str(program(tmp_path, "exit 0"))))


def test_a_program_runs_in_a_folder_of_its_own(task, tmp_path, monkeypatch):
    mine = program(tmp_path, "exit 3")
    monkeypatch.chdir(tmp_path)
    for name in (str(mine), f"./{mine.name}"):
        (row,) = run(task, [name], tmp_path / str(len(name)))
        assert (row["solver"], row["how"], row["iterations"]) == (name, "raised", -1)
        assert row["status"] == "SolverError: solver wrote no .sol, found exit 3"
    # nothing of the runs beside the program
    assert not list(tmp_path.glob("*.log"))
    # an answer to an earlier problem is not read
    order = np.arange(task.nlp.nx), np.arange(task.nlp.ng)
    write_sol(tmp_path / "soup.sol", task.nlp.x0, None, *order, "earlier", 0)
    with pytest.raises(SolverError, match="wrote no"):
        executable(str(mine), task)


def test_a_program_that_only_waits_has_no_answer(task, tmp_path, monkeypatch):
    # it uses no CPU time, so that wall time ends it
    monkeypatch.setattr("soup_nlp.bench.solvers.plugins.WALL_PER_CPU", 1.0)
    mine = program(tmp_path, "exec sleep 30")
    (row,) = run(replace(task, limits=replace(task.limits, seconds=1.0)), [str(mine)], tmp_path)
    assert row["status"] == "Time_Limit"
    assert not row["claimed"]
    assert not {"energy", "primal", "dual", "complementarity"} & set(row)


@pytest.mark.parametrize(
    ("script", "status"),
    [
        # the system kills what ignores the limit
        ("trap '' XCPU; while :; do :; done", "CPU limit of 0 s reached"),
        ("kill -s KILL $$", "killed by SIGKILL, perhaps out of memory"),
        ("kill -s SEGV $$", "killed by SIGSEGV"),
    ],
)
def test_a_signal_that_ends_a_program_is_named(script, status, task, tmp_path, monkeypatch):
    # wall time ends no program
    monkeypatch.setattr("soup_nlp.bench.processes.GRACE", 600.0)
    monkeypatch.setattr("soup_nlp.bench.solvers.plugins.WALL_PER_CPU", 600.0)
    mine, seconds = program(tmp_path, script), 0.0 if "while" in script else 20.0
    (row,) = run(replace(task, limits=replace(task.limits, seconds=seconds)), [str(mine)], tmp_path)
    assert (row["status"], row["claimed"], row["verified"]) == (status, False, False)


# --- verification --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("says", "seconds", "claimed", "verified"),
    [
        (True, 19.0, True, True),
        (False, 19.0, False, True),
        # after the time limit
        (True, 21.0, False, False),
    ],
)
def test_one_tolerance_decides_within_the_limit(
    says, seconds, claimed, verified, exact, task, tmp_path, stub, monkeypatch
):
    stub(lambda solved_task: replace(exact, claimed=says))
    monkeypatch.setattr(runner, "clock", iter([0.0, seconds]).__next__)
    (row,) = run(task, ["some"], tmp_path)
    assert (row["claimed"], row["verified"], row["seconds"]) == (claimed, verified, seconds)
    assert row["status"].startswith("over the time limit") == (seconds > 20)


# --- rows ----------------------------------------------------------------------------------------


def test_runs_resume_and_a_cut_line_is_run_again(task, tmp_path, stub):
    calls = stub(lambda solved_task: Answer(solved_task.nlp.x0, None, "start", False, 0))

    def go(*names: str, with_task: Task = task) -> int:
        return len(run(with_task, list(names), tmp_path))

    assert go("a", "b", "a") == 2
    assert go("a", "b", "c") == 3
    assert calls == ["a", "b", "c"]
    path = tmp_path / "r.jsonl"
    path.write_text(path.read_text()[:-20])
    assert go("a", "b", "c") == 3
    assert calls == ["a", "b", "c", "c"]
    # other limits, other runs
    assert go("a", with_task=replace(task, limits=replace(task.limits, tol=1e-3))) == 1
    assert calls == ["a", "b", "c", "c", "a"]


def test_an_error_is_a_row_and_others_go_on(exact, task, tmp_path, stub):
    stub(lambda solved_task: exact)

    def broken() -> Task:
        raise DataError("pair cannot be prepared", where="image", found="nothing")

    def compared(*tasks: Callable[[], Task]) -> list:
        labelled = [({**LABEL, "problem": f"p{k}"}, make) for k, make in enumerate(tasks)]
        folders = tmp_path / "r.jsonl", tmp_path / "s"
        return compare(labelled, ["a"], task.limits, *folders, lambda line: None)

    bad, good = compared(broken, lambda: task)
    assert "pair cannot be prepared" in bad["error"]
    assert bad["status"] == "DataError: pair cannot be prepared, where: image, found: nothing"
    assert (bad["claimed"], bad["verified"]) == (False, False)
    assert good["verified"]
    frame = frame_of_runs([bad, good])
    assert "pair cannot be prepared" in page(frame.assign(code="1"))
    # an error is no measurement
    assert [row["how"] for row in compared(lambda: task, lambda: task)] == ["returned"] * 2
    assert [row["how"] for row in read_rows(tmp_path / "r.jsonl")] == ["raised"] + ["returned"] * 2


def test_rows_are_told_after_every_run_and_names_before(exact, task, tmp_path, stub):
    stub(lambda solved_task: exact)
    seen: list[int] = []
    said: list[str] = []
    run(task, ["a", "b"], tmp_path, said.append, lambda rows: seen.append(len(rows)))
    assert seen == [1, 2]
    assert [line.split()[-3] for line in said[::2]] == ["a", "b"]
