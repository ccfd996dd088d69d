"""Comparison of solvers: isolation, verification, resuming, profiles; real solvers, tiny soup."""

from __future__ import annotations

import json
import os
import signal
import time
from dataclasses import asdict, replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from helpers_model import PAPER, Tiny

from soup_nlp.bench.processes import isolated
from soup_nlp.bench.solvers.page import frame_of_runs
from soup_nlp.bench.solvers.page import page as page_of
from soup_nlp.bench.solvers.plugins import PLUGINS
from soup_nlp.bench.solvers.profiles import cost_table, draw_curves, draw_profiles, profile
from soup_nlp.bench.solvers.registry import available, find_solver
from soup_nlp.bench.solvers.runner import compare
from soup_nlp.bench.solvers.task import Answer, Task, Trace
from soup_nlp.cli.main import main
from soup_nlp.errors import SolverError
from soup_nlp.export.verify import Limits, examine
from soup_nlp.model.formulation import Formulation

pytestmark = pytest.mark.slow

PROBLEMS = Path(__file__).parents[2] / "problems"
MANY = 1 << 30
LABEL = {
    "problem": "tiny",
    "problem_hash": "0",
    "superpixels": 12,
    "formulation": "unit-offset/smooth",
    "start": "proposal",
    "energy_limit": np.finfo(float).max,
}


@pytest.fixture(scope="module")
def task(tmp_path_factory) -> Task:
    tiny = Tiny(neighbours=2, samples=3, boundary_samples=1)
    # wide smoothing: with 0.2 the way from a cold start is so long that rounding decides its end
    # (a length of 1, which is the focal length in pixels)
    wide = float(tiny.data.K_next[0, 0])
    form = Formulation(hessian="exact", eps=wide, eps_pixel=1.0, compiled=False)
    nlp, layout = tiny.nlp(PAPER, form)
    other, _ = tiny.nlp(PAPER, form.replace(hessian="gauss-newton+constraints"))
    limits = Limits(seconds=20, iterations=200, tol=1e-5)
    folder = tmp_path_factory.mktemp("task")
    return Task(nlp, other, layout, tiny.soup, tiny.data, PAPER, form, limits, folder)


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


# --- isolation -----------------------------------------------------------------------------------


def test_a_function_returns_from_its_process(tmp_path):
    here = os.getpid()
    ended = isolated(lambda: (os.getpid(), np.arange(3)), tmp_path, 20, MANY)
    assert ended.how == "returned"
    assert ended.value[0] != here
    assert ended.value[1].tolist() == [0, 1, 2]
    assert ended.peak_bytes > 0


def test_crashes_are_answers(tmp_path):
    assert isolated(die, tmp_path, 20, MANY).how == "crashed: SIGKILL"
    assert isolated(lambda: os._exit(3), tmp_path, 20, MANY).how == "crashed: exit code 3"

    def bad() -> None:
        raise ValueError("no such option")

    ended = isolated(bad, tmp_path, 20, MANY)
    assert (ended.how, ended.value) == ("raised", "ValueError: no such option")


def test_time_and_memory_are_limited(tmp_path, monkeypatch):
    monkeypatch.setattr("soup_nlp.bench.processes.GRACE", 0.2)
    assert isolated(lambda: time.sleep(60), tmp_path, 0.1, MANY).how == "killed: time"
    ended = isolated(lambda: np.ones(10**9), tmp_path, 20, MANY)
    assert ended.how == "killed: memory"
    # an answer of an earlier run is not taken for this one's
    assert isolated(die, tmp_path, 20, MANY).value is None


def test_a_trace_survives_a_kill(tmp_path):
    trace = Trace(tmp_path / "trace", 2)
    assert trace.read()[1].shape == (0, 2)

    def work() -> None:
        trace.add(np.array([1.0, 2.0]))
        trace.add(np.array([3.0, 4.0]))
        with trace.path.open("ab") as file:
            file.write(b"half")
        die()

    isolated(work, tmp_path, 20, MANY)
    seconds, points = trace.read()
    assert points.tolist() == [[1, 2], [3, 4]]
    assert (np.diff(seconds) >= 0).all()


# --- solvers and verification --------------------------------------------------------------------


@pytest.mark.parametrize("name", ["ipopt-tuned", "fatrop", "pounce"])
def test_solvers_reach_a_verified_point(name, task, tmp_path):
    if name not in available():
        pytest.skip(f"{name} is not installed")
    rows = compare(
        [(LABEL, lambda folder: replace(task, folder=folder))],
        [name], task.limits, tmp_path / "runs.jsonl", tmp_path, lambda line: None,
    )  # fmt: skip
    row = rows[0]
    assert row["how"] == "returned", row["status"]
    assert row["verified"], row
    assert row["status"] != "Time_Limit"
    assert row["energy"] < row["energy_start"]
    assert row["curve"][-1][1] == pytest.approx(row["energy"])


def test_a_claim_with_the_gauss_newton_hessian_is_true(task, tmp_path):
    # whether it converges in 200 iterations depends on rounding; what it claims must hold
    rows = compare(
        [(LABEL, lambda folder: replace(task, folder=folder))],
        ["ipopt-soup"], task.limits, tmp_path / "runs.jsonl", tmp_path, lambda line: None,
    )  # fmt: skip
    assert rows[0]["how"] == "returned", rows[0]["status"]
    assert rows[0]["iterations"] > 10
    assert rows[0]["verified"] == rows[0]["claimed"]


def test_a_false_claim_is_seen(task, tmp_path, monkeypatch):
    def liar(given: Task) -> Answer:
        return Answer(given.nlp.x0 + 1e-3, None, "optimal!", True, 1, 0.5)

    monkeypatch.setattr("soup_nlp.bench.solvers.runner.find_solver", lambda name: liar)
    rows = compare(
        [(LABEL, lambda folder: replace(task, folder=folder))],
        ["liar"], task.limits, tmp_path / "runs.jsonl", tmp_path, lambda line: None,
    )  # fmt: skip
    assert rows[0]["claimed"]
    assert not rows[0]["verified"]
    assert rows[0]["primal"] > 1e-4
    assert "| liar | 1 | 1 | 0 | 0 of 1 |" in page(rows)
    assert "not always those of liar" in page(rows)


def test_residuals_of_known_points(task):
    nlp = task.nlp
    start = examine(nlp, nlp.x0, None).residuals
    assert start.primal < 1e-9
    assert start.dual > 1e-2
    assert not start.within(task.limits)
    # multipliers that are not numbers are not used
    found = examine(nlp, nlp.x0, np.full(nlp.ng, np.nan)).residuals
    assert found.multipliers == "least squares"


def test_runs_resume_and_a_cut_line_is_run_again(task, tmp_path, monkeypatch):
    calls = []

    def solver(given: Task) -> Answer:
        return Answer(given.nlp.x0, None, "start", False, 0, 0.1)

    def find(name: str) -> object:
        calls.append(name)
        return solver

    monkeypatch.setattr("soup_nlp.bench.solvers.runner.find_solver", find)
    path = tmp_path / "runs.jsonl"
    args = [(LABEL, lambda folder: replace(task, folder=folder))]

    def go(names: list[str], limits: Limits) -> int:
        return len(compare(args, names, limits, path, tmp_path, lambda line: None))

    assert go(["a", "b"], task.limits) == 2
    assert go(["a", "b", "c"], task.limits) == 3
    assert calls == ["a", "b", "c"]
    text = path.read_text()
    path.write_text(text[:-20])
    assert go(["a", "b", "c"], task.limits) == 3
    assert calls == ["a", "b", "c", "c"]
    # other limits, other runs
    assert go(["a"], replace(task.limits, tol=1e-3)) == 1
    assert calls == ["a", "b", "c", "c", "a"]


def test_names_of_solvers(tmp_path):
    with pytest.raises(SolverError, match="not here"):
        find_solver("knitro_that_is_not_installed")
    assert set(available()) >= {n for n, r in PLUGINS.items() if ca.has_nlpsol(r.library)}
    program = tmp_path / "mine"
    program.write_text("#!/bin/sh\ncp answer.sol soup.sol\n")
    program.chmod(0o755)
    assert callable(find_solver(str(program)))


# --- profiles ------------------------------------------------------------------------------------


def row(problem: str, solver: str, seconds: float, energy: float, verified: bool = True) -> dict:
    return {
        "problem": problem, "superpixels": 10, "formulation": "f", "solver": solver,
        "seconds": seconds, "energy": energy, "verified": verified, "claimed": True,
        "energy_start": 9.0, "curve": [[0.1, 5.0], [seconds, energy]], "iterations": 3,
        "cpu_seconds": 1.0, "peak_bytes": 1 << 20, "status": "a | b", "machine": "m",
        "versions": {"casadi": "3"}, "code": "1", "problem_hash": "0", "start": "presolve",
        "limits": asdict(Limits()),
    }  # fmt: skip


def page(rows: list[dict]) -> str:
    return page_of(frame_of_runs(rows))


ROWS = [
    row("a", "one", 1.0, 4.0), row("a", "two", 2.0, 3.0), row("a", "three", 0.1, 1.0, False),
    row("b", "one", 6.0, 4.0), row("b", "two", 3.0, 4.0),
]  # fmt: skip


def test_profiles_by_hand():
    cost = cost_table(frame_of_runs(ROWS), "seconds")
    assert (len(cost), list(cost)) == (2, ["one", "three", "two"])
    share = profile(cost)
    assert share.index.tolist() == [1, 2]
    # each wins one problem; both solve all within twice the best; a false claim solves none
    assert share.to_numpy().tolist() == [[0.5, 0, 0.5], [1, 0, 1]]
    share = profile(cost_table(frame_of_runs(ROWS), "energy"))
    assert share.index.tolist() == [1, 4 / 3]
    assert share.to_numpy().tolist() == [[0.5, 0, 1], [1, 0, 1]]


def test_profile_of_nothing_solved():
    failed = [row("a", "one", 1.0, 2.0, False)]
    share = profile(cost_table(frame_of_runs(failed), "seconds"))
    assert share.index.tolist() == [1]
    assert share.to_numpy().tolist() == [[0]]
    assert "none is verified" in page(failed)


def test_page_and_pictures(tmp_path):
    text = page(ROWS)
    assert text.index("**2 problems") < text.index("## Confirmation") < text.index("## Limits")
    assert "a / b" in text
    frame = frame_of_runs(ROWS)
    draw_profiles(tmp_path / "p.png", {"": frame}, ("seconds", "energy"))
    draw_curves(tmp_path / "c.png", frame)
    assert (tmp_path / "p.png").stat().st_size > 5000
    assert (tmp_path / "c.png").stat().st_size > 5000


def test_command(tmp_path, capsys):
    words = [
        "compare", str(PROBLEMS / "orbit.yaml"), "-o", str(tmp_path), "--superpixels", "12",
        "--solvers", "ipopt-soup", "--seconds", "20", "--presolve", "--set", "input.width=96",
        "--set", "input.height=64", "--set", "flow.source=truth",
        "--set", "segmentation.neighbours=4", "--set", "energy.pixel_samples=4",
    ]  # fmt: skip
    assert main(words) == 0
    rows = [json.loads(x) for x in (tmp_path / "runs.jsonl").read_text().splitlines()]
    assert rows[0]["verified"]
    assert "1 verified" in capsys.readouterr().out
    for name in ("README.md", "profile.png", "curves.png"):
        assert (tmp_path / name).stat().st_size > 0
    assert main([*words, "--tol", "-1"]) == 2
    assert main(["compare", str(PROBLEMS / "orbit.yaml"), "--solvers", "nothing"]) == 2
