"""Page and pictures of a comparison of solvers from artificial rows; its command."""

from dataclasses import asdict

import numpy as np
import pytest
from helpers_files import sets

from soup_nlp.bench.solvers import runner
from soup_nlp.bench.solvers.page import (
    _draw_profile,
    by_start,
    cost_table,
    draw_profiles,
    frame_of_runs,
    neutral,
    profile,
    reached,
    summary,
)
from soup_nlp.bench.solvers.page import page as page_of
from soup_nlp.bench.study import panels
from soup_nlp.cli.main import main
from soup_nlp.export.verify import Limits
from soup_nlp.storage.rows import read_rows

pytestmark = pytest.mark.slow

SMALL = sets(
    "input.width=96 input.height=64 flow.source=truth segmentation.neighbours=4"
    " energy.pixel_samples=4 segmentation.superpixels=12"
)


def row(
    problem: str,
    solver: str,
    seconds: float,
    energy: float,
    verified: bool = True,
    **fields: object,
) -> dict:
    return {
        "problem": problem, "superpixels": 10, "formulation": "f", "solver": solver,
        "seconds": seconds, "energy": energy, "verified": verified, "claimed": True,
        "energy_start": 9.0, "iterations": 3,
        "cpu_seconds": 1.0, "wall_seconds": 9.0, "peak_bytes": 1 << 20, "status": "a | b",
        "machine": "m", "versions": {"casadi": "3"}, "code": "1", "problem_hash": "0",
        "start": "easy", "primal": 0.0, "limits": asdict(Limits()), **fields,
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
    # nothing is solved
    share = profile(cost_table(frame_of_runs(ROWS[2:3]), "seconds"))
    assert share.index.tolist() == [1]
    assert share.to_numpy().tolist() == [[0]]


def test_a_profile_names_the_solvers_that_solve_nothing():
    axes = panels(1, 1, 4, 3)[1][0, 0]
    _draw_profile(axes, "seconds", 2, profile(cost_table(frame_of_runs(ROWS), "seconds")))
    told = [text.get_text() for text in axes.get_legend().get_texts()]
    assert told == ["one", "two", "none by three"]


def test_a_picture_of_runs_with_and_without_a_verified_one(tmp_path):
    groups = {"some": frame_of_runs(ROWS), "none": frame_of_runs(ROWS[2:3])}
    draw_profiles(tmp_path / "p.png", groups, ("seconds", "energy"))
    assert (tmp_path / "p.png").stat().st_size > 5000


def test_a_page_has_problems_solvers_and_runs():
    text = page(ROWS)
    assert "**2 problems, 3 solvers, 5 runs: 4 verified.**" in text
    assert "one 2, two 2." in text
    assert "4 of 5; not always those of three." in text
    assert text.index("**2 problems") < text.index("## Confirmation") < text.index("## Limits")
    assert "a / b" in text
    assert "| a | 10 | f | 9 | 4 | 3 | (1) |" in text
    assert "| b | 10 | f | 9 | 4 | 4 | - |" in text
    # one of another content
    other = row("b", "two", 9.0, 2.0) | {"problem_hash": "1"}
    assert "**3 problems" in page([*ROWS, other])
    cost = cost_table(frame_of_runs([*ROWS, other]), "seconds")
    assert np.isfinite(cost).sum(axis=1).tolist() == [2, 2, 1]
    assert "Verified problems by solver: none." in page(ROWS[2:3])
    # a solver without an answer
    nothing = {k: v for k, v in ROWS[0].items() if k not in ("energy", "primal")}
    text = page([nothing | {"verified": False, "claimed": False}])
    assert "| a | 10 | f | one | no | - | 9 | - |" in text


def test_runs_that_begin_at_a_solution_are_headed_confirmation():
    text = page([row(start, "one", 1.0, 4.0) | {"start": start} for start in ("hard", "easy")])
    first, second = text.index("## By run"), text.index("## Confirmation")
    assert first < text.index("| hard |", first) < second < text.index("| easy |", second)


# --- runs on the SOUP family ---------------------------------------------------------------------

STUB = "SOUP-room-unit-offset-smooth-N100"


def family_row(solver: str, start: str, objective: float, verified: bool = True) -> dict:
    return row(
        f"room {start}", solver, 1.0, objective, verified,
        superpixels=100, objective=objective, start=start, name=f"{STUB}-{start}",
        best_known=4.0, n=7, m=3, cpu_seconds=3.0 if solver == "two" else 1.0,
    )  # fmt: skip


OF_FAMILY = [
    family_row("one", "easy", 4.0), family_row("two", "easy", 4.0001),
    family_row("three", "easy", 3.0, False),
    family_row("one", "hard", 5.0), family_row("two", "hard", 4.0003),
]  # fmt: skip


def test_a_minimum_is_reached_when_it_is_verified_and_near():
    assert reached(frame_of_runs(OF_FAMILY)).tolist() == [True, True, False, False, True]
    # a lower objective than the best known one is reached as well
    assert reached(frame_of_runs([family_row("one", "easy", 3.0)])).all()
    entry = summary(frame_of_runs(OF_FAMILY))[STUB]
    runs = entry.pop("runs")
    assert entry == {"tried_by": ["one", "two", "three"], "reached_by": ["one", "two"]}
    assert runs["easy"]["two"] == [4.0001, 3.0, 60.0, True]
    assert runs["hard"] == {"one": [5.0, 1.0, 60.0, True], "two": [4.0003, 3.0, 60.0, True]}


def test_rows_belong_to_a_start_and_a_size(tmp_path):
    frame = frame_of_runs(OF_FAMILY)
    assert list(by_start(frame)) == ["confirmation, N = 100", "hard, N = 100"]
    text = page_of(frame)
    assert "| one | 1 of 1 (1), 1.0 s | 1 of 1 (0), 1.0 s |" in text
    assert "| three | 0 of 1 (0) | - |" in text
    assert text.index("## By start and size") < text.index("## By run")
    draw_profiles(tmp_path / "p.png", by_start(frame), ("cpu_seconds", "objective"))
    assert (tmp_path / "p.png").stat().st_size > 5000
    plain = neutral(frame)[0]
    # the fields that the README of the set asks for
    assert {"solver", "name", "n", "m", "status", "objective", "iterations", "time"} <= plain.keys()
    assert (plain["time"], plain["wall_time"], plain["reached"]) == (1.0, 9.0, True)


# --- the command ---------------------------------------------------------------------------------


def test_files_are_read_before_anything_runs(tmp_path, capsys):
    words = ["-o", str(tmp_path), "--solvers", "soup-nlp,soup-nlp", "--seconds", "5", *SMALL]
    assert main(["compare", "orbit", "orbitt.yaml", *words]) == 2
    assert main(["compare", "orbit", *words, "--set", "segmentation.superpixels=0"]) == 2
    assert "superpixels" in capsys.readouterr().err
    assert main(["compare", "orbit", *words, "--seconds", "-1"]) == 2
    assert main(["compare", "orbit", *words, "--solvers", "nothing"]) == 2
    assert not list(tmp_path.iterdir())


def test_an_interrupted_comparison_has_a_page_and_goes_on(tmp_path, monkeypatch, capsys):
    isolated, done = runner.isolated, []

    def second_is_interrupted(*args, **kwargs):
        if len(done) == 1:
            raise KeyboardInterrupt
        done.append(isolated(*args, **kwargs))
        return done[-1]

    monkeypatch.setattr(runner, "isolated", second_is_interrupted)
    out = tmp_path / "out"
    words = ["compare", "orbit", "--solvers", "ipopt-tuned,soup-nlp", "--seconds", "20"]
    # the first solver need not converge
    words += ["--iterations", "30", "-o", str(out), *SMALL]
    assert main(words) == 130
    assert "1 runs" in (out / "README.md").read_text()
    assert (out / "profile.png").stat().st_size > 0
    assert "the runs that were finished are kept" in capsys.readouterr().err
    (first,) = read_rows(out / "runs.jsonl")
    assert np.isfinite(first["energy"])
    monkeypatch.setattr(runner, "isolated", isolated)
    assert main(words) == 0
    assert "2 runs" in (out / "README.md").read_text()
    # the solve of the package is verified
    same, package = read_rows(out / "runs.jsonl")
    assert same == first
    assert package["verified"]
    verified = first["verified"] + package["verified"]
    assert f"2 runs: {verified} verified" in capsys.readouterr().out
