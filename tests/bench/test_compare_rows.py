"""Rows of the comparison: missing answers, late answers, identity of the problem."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from helpers_model import PAPER, Tiny
from test_compare import LABEL, MANY, PROBLEMS, ROWS, page, row

from soup_nlp.bench.processes import isolated
from soup_nlp.bench.solvers import runner
from soup_nlp.bench.solvers.page import conclusion, frame_of_runs
from soup_nlp.bench.solvers.profiles import _draw_profile, cost_table, draw_curves, draw_profiles
from soup_nlp.bench.solvers.registry import executable, find_solver, reference
from soup_nlp.bench.solvers.runner import compare
from soup_nlp.bench.solvers.task import Answer, Task
from soup_nlp.bench.study import figure
from soup_nlp.cli.main import main
from soup_nlp.config.problem import Problem
from soup_nlp.errors import DataError, SolverError
from soup_nlp.export.sol import write_sol
from soup_nlp.export.verify import Limits, examine, violations
from soup_nlp.model.formulation import Formulation
from soup_nlp.pipeline.case import Case, prepare

pytestmark = pytest.mark.slow

SMALL = [
    "--set", "input.width=96", "--set", "input.height=64", "--set", "flow.source=truth",
    "--set", "segmentation.neighbours=4", "--set", "energy.pixel_samples=4",
]  # fmt: skip


def make_task(folder: Path, **form: str) -> Task:
    tiny = Tiny(neighbours=2, samples=3, boundary_samples=1)
    # a length of 1 is the focal length in pixels
    wide = float(tiny.data.K_next[0, 0])
    style = Formulation(hessian="exact", eps=wide, eps_pixel=1.0, compiled=False, **form)
    nlp, layout = tiny.nlp(PAPER, style)
    limits = Limits(seconds=20, iterations=200, tol=1e-5)
    return Task(nlp, nlp, layout, tiny.soup, tiny.data, PAPER, style, limits, folder)


@pytest.fixture(scope="module")
def task(tmp_path_factory) -> Task:
    return make_task(tmp_path_factory.mktemp("task"))


def run(task: Task, names: list[str], folder: Path) -> list[dict]:
    made = [(LABEL, lambda where: replace(task, folder=where))]
    return compare(made, names, task.limits, folder / "r.jsonl", folder / "s", lambda line: None)


def program(folder: Path, text: str) -> Path:
    path = folder / "my solver"
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


# --- answers -------------------------------------------------------------------------------------


def test_the_start_is_no_answer_of_a_solver(task, tmp_path, monkeypatch):
    # a program that waits uses no CPU time, so that wall time ends it
    monkeypatch.setattr("soup_nlp.bench.solvers.registry.WALL_PER_CPU", 1.0)
    mine = program(tmp_path, "exec sleep 30")
    (found,) = run(replace(task, limits=replace(task.limits, seconds=1.0)), [str(mine)], tmp_path)
    assert found["status"] == "Time_Limit"
    assert not found["claimed"]
    assert not {"energy", "primal", "dual", "complementarity"} & set(found)
    assert not any("lowest exact energy" in line for line in conclusion(frame_of_runs([found])))
    assert "| - | - | - | - |" in page([found]).replace(f"{found['energy_start']:.6g}", "-")


def test_a_solver_named_by_path_has_its_own_folder(task, tmp_path, monkeypatch):
    mine = program(tmp_path, "exit 3")
    monkeypatch.chdir(tmp_path)
    for name in (str(mine), f"./{mine.name}"):
        (found,) = run(task, [name], tmp_path / str(len(name)))
        assert found["solver"] == name
        assert found["how"] == "raised"
        assert found["iterations"] == -1
        assert found["status"] == "SolverError: solver wrote no .sol, found exit 3"
    # nothing of the runs beside the program
    assert not list(tmp_path.glob("*.pickle"))


def test_an_old_answer_is_not_read_again(task, tmp_path):
    here = replace(task, folder=tmp_path)
    order = np.arange(task.nlp.nx), np.arange(task.nlp.ng)
    write_sol(tmp_path / "soup.sol", task.nlp.x0, None, *order, "earlier", 0)
    with pytest.raises(SolverError, match="wrote no"):
        executable(str(program(tmp_path, "exit 0")), here)


def test_a_solver_that_is_asked_for_twice_runs_once(task, tmp_path, monkeypatch):
    calls = []

    def find(name: str) -> Callable[[Task], Answer]:
        calls.append(name)
        return lambda given: Answer(given.nlp.x0, None, "start", False, 0, 0.1)

    monkeypatch.setattr("soup_nlp.bench.solvers.runner.find_solver", find)
    assert len(run(task, ["a", "a"], tmp_path)) == 1
    assert calls == ["a"]


def test_a_claim_after_the_limit_is_not_within_it(task, tmp_path, monkeypatch):
    exact = find_solver("ipopt-tuned")(replace(task, folder=tmp_path))
    rows = []
    for seconds in (19.0, 21.0):
        answer = replace(exact, seconds=seconds)
        monkeypatch.setattr(
            "soup_nlp.bench.solvers.runner.find_solver", lambda n, a=answer: lambda t: a
        )
        rows += run(task, ["slow"], tmp_path / str(seconds))
    assert [r["verified"] for r in rows] == [True, False]
    assert [r["claimed"] for r in rows] == [True, False]
    assert rows[1]["status"].startswith("over the time limit")


def test_a_reference_solver_returns_a_point_of_the_epigraph_form(tmp_path):
    task = make_task(tmp_path, norm="epigraph")
    task = replace(task, limits=replace(task.limits, seconds=2.0))
    x = reference(task).x
    assert x is not None
    size = task.layout.size
    assert np.abs(x[size:] - task.nlp.x0[size:]).max() > 1e-3
    assert violations(task.nlp, x)["rows"].max() < 1e-6
    # with the slack variables of the start it is off the constraints
    stale = np.concatenate([x[:size], task.nlp.x0[size:]])
    assert violations(task.nlp, stale)["rows"].max() > 1e-3
    assert examine(task.nlp, x, None).residuals.primal < 1e-6


def test_the_reason_of_a_failure_is_kept(tmp_path):
    def bad() -> None:
        raise SolverError("no licence", where="server", found="expired", hint="ask for one")

    assert isolated(bad, tmp_path, 20, MANY).value == "SolverError: no licence, found expired"


# --- problems ------------------------------------------------------------------------------------


def test_problems_of_one_name_are_told_apart():
    rows = [*ROWS, row("b", "two", 9.0, 2.0) | {"problem_hash": "1"}]
    cost = cost_table(frame_of_runs(rows), "seconds")
    assert [key[0] for key in cost.index] == ["a", "b", "b"]
    assert np.isfinite(cost).sum(axis=1).tolist() == [2, 2, 1]
    assert "**3 problems" in page(rows)


def test_pictures_of_nothing_verified_say_nothing(tmp_path):
    failed = [row("a", "one", 1.0, 2.0, False) | {"curve": []}]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        frame = frame_of_runs(failed)
        draw_profiles(tmp_path / "p.png", {"": frame}, ("seconds", "energy"))
        draw_curves(tmp_path / "c.png", frame)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c.png", "p.png"]


def test_a_profile_names_the_solvers_that_solve_nothing():
    axes = figure(4, 3).subplots()
    share = pd.DataFrame(
        [[1.0, 0.0, 0.0], [1.0, 0.5, 0.0]], index=[1.0, 2.0], columns=["one", "two", "three"]
    )
    _draw_profile(axes, "seconds", 2, share)
    told = [text.get_text() for text in axes.get_legend().get_texts()]
    assert told == ["one", "two", "none by three"]


def test_files_are_read_before_anything_runs(tmp_path, capsys):
    words = ["-o", str(tmp_path), "--solvers", "lm,lm", "--seconds", "5", *SMALL]
    orbit = str(PROBLEMS / "orbit.yaml")
    assert main(["compare", orbit, "orbitt.yaml", "--superpixels", "9", *words]) == 2
    assert main(["compare", orbit, "--superpixels", "9", "--superpixels", "0", *words]) == 2
    assert "superpixels" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_an_input_that_cannot_be_used_leaves_the_others_page(tmp_path, monkeypatch, capsys):
    calls = []

    def second_fails(problem: Problem, presolve: bool) -> Case:
        calls.append(problem)
        if len(calls) == 2:
            raise DataError("image is gone")
        return prepare(problem, presolve)

    monkeypatch.setattr("soup_nlp.cli.compare.prepare", second_fails)
    orbit = str(PROBLEMS / "orbit.yaml")
    words = ["--superpixels", "9", "--solvers", "lm,lm", "--seconds", "5", "--no-presolve"]
    out = tmp_path / "out"
    assert main(["compare", orbit, orbit, "-o", str(out), *words, *SMALL]) == 2
    assert "1 runs" in (out / "README.md").read_text()
    assert "image is gone" in capsys.readouterr().err


def test_a_problems_lowest_energy_is_of_its_own_runs():
    def row(problem: str, energy: float) -> dict[str, object]:
        label = {"problem": problem, "superpixels": 9, "formulation": "f", "solver": "s"}
        point = {"energy": energy, "primal": 0.0, "seconds": 1.0, "verified": True}
        return {**label, **point, "claimed": True, "problem_hash": problem, "start": "presolve"}

    text = "\n".join(conclusion(frame_of_runs([row("a", 1.0), row("b", 2.0)])))
    assert text.count("lowest exact energy of any run 1 by s") == 1
    assert text.count("lowest exact energy of any run 2 by s") == 1


def test_a_curve_has_the_first_and_the_last_iterate(monkeypatch):
    monkeypatch.setattr(runner, "_energy", lambda _, x: float(x[0]))
    for count in (1, 2, 500):
        at = np.arange(float(count))
        curve = runner._curve(None, at, at[:, None])
        assert curve[0] == [0, 0]
        assert curve[-1] == [count - 1, count - 1]
        assert len(curve) == min(count, runner.CURVE_POINTS)
    assert runner._curve(None, np.zeros(0), np.zeros((0, 1))) == []


def test_one_tolerance_decides_with_or_without_a_claim(task, tmp_path, monkeypatch):
    exact = find_solver("ipopt-tuned")(replace(task, folder=tmp_path))
    rows = []
    for claimed in (True, False):
        answer = replace(exact, claimed=claimed)
        monkeypatch.setattr(
            "soup_nlp.bench.solvers.runner.find_solver", lambda n, a=answer: lambda t: a
        )
        rows += run(task, ["some"], tmp_path / str(claimed))
    assert [r["verified"] for r in rows] == [True, True]
    assert [r["claimed"] for r in rows] == [True, False]
    text = page(rows)
    assert "| some | 2 | 1 | 2 | 1 of 1 |" in text


def test_runs_that_begin_at_a_solution_are_headed_confirmation(task, tmp_path, monkeypatch):
    answer = find_solver("ipopt-tuned")(replace(task, folder=tmp_path))
    monkeypatch.setattr("soup_nlp.bench.solvers.runner.find_solver", lambda n: lambda t: answer)
    (found,) = run(task, ["some"], tmp_path)
    text = page([{**found, "start": start, "problem": start} for start in ("hard", "easy")])
    first, second = text.index("## By run"), text.index("## Confirmation")
    assert first < text.index("| hard |") < second < text.index("| easy |")


def test_the_page_is_there_after_every_run(task, tmp_path, monkeypatch):
    answer = find_solver("ipopt-tuned")(replace(task, folder=tmp_path))
    seen: list[int] = []
    said: list[str] = []
    monkeypatch.setattr("soup_nlp.bench.solvers.runner.find_solver", lambda n: lambda t: answer)
    tasks = [(LABEL, lambda folder: replace(task, folder=folder))]
    path = tmp_path / "runs.jsonl"
    compare(
        tasks, ["a", "b"], task.limits, path, tmp_path, said.append, lambda r: seen.append(len(r))
    )
    assert seen == [1, 2]
    # the solver is named before it runs
    assert [line.split()[-3] for line in said[::2]] == ["a", "b"]
