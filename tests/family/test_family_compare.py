"""Solvers on the SOUP family: rows by start and size, results, a solver of the user."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict

import numpy as np
import pytest

from soup_nlp.bench.solvers import runner
from soup_nlp.bench.solvers.page import by_start, frame_of_runs, neutral, page, reached, summary
from soup_nlp.bench.solvers.profiles import draw_curves, draw_profiles
from soup_nlp.cli.main import main
from soup_nlp.config.problem import make_problem
from soup_nlp.export.verify import Limits
from soup_nlp.family.instances import record_of
from soup_nlp.pipeline.case import prepare

STUB = "SOUP-room-unit-offset-smooth-N100"


def row(solver: str, start: str, objective: float, verified: bool = True, cpu: float = 1.0) -> dict:
    return {
        "problem": f"room {start}", "superpixels": 100, "formulation": "f", "solver": solver,
        "seconds": 1.0, "wall_seconds": 9.0, "energy": objective, "verified": verified,
        "objective": objective,
        "claimed": True, "energy_start": 9.0, "curve": [], "iterations": 3, "cpu_seconds": cpu,
        "peak_bytes": 1 << 20, "status": "optimal", "machine": "m", "versions": {"casadi": "3"},
        "code": "1", "problem_hash": "0", "start": start, "limits": asdict(Limits()),
        "name": f"{STUB}-{start}", "best_known": 4.0, "n": 7, "m": 3,
    }  # fmt: skip


ROWS = [
    row("one", "easy", 4.0), row("two", "easy", 4.0001, cpu=3.0), row("three", "easy", 3.0, False),
    row("one", "hard", 5.0), row("two", "hard", 4.0003),
]  # fmt: skip


def test_a_minimum_is_reached_when_it_is_verified_and_near():
    assert reached(frame_of_runs(ROWS)).tolist() == [True, True, False, False, True]
    # lower than what was known is reached as well
    assert reached(frame_of_runs([row("one", "easy", 3.0)])).all()
    found = summary(frame_of_runs(ROWS))[STUB]
    runs = found.pop("runs")
    assert found == {"tried_by": ["one", "two", "three"], "reached_by": ["one", "two"]}
    assert runs["easy"]["two"] == [4.0001, 3.0, 60.0, True]
    assert runs["hard"] == {"one": [5.0, 1.0, 60.0, True], "two": [4.0003, 1.0, 60.0, True]}


def test_rows_belong_to_a_start_and_a_size(tmp_path):
    frame = frame_of_runs(ROWS)
    assert list(by_start(frame)) == ["confirmation, N = 100", "hard, N = 100"]
    text = page(frame, family=True)
    assert "| one | 1 of 1 (1), 1.0 s | 1 of 1 (0), 1.0 s |" in text
    assert "| three | 0 of 1 (0) | - |" in text
    assert text.index("## By start and size") < text.index("## By run")
    draw_profiles(tmp_path / "p.png", by_start(frame), ("cpu_seconds", "objective"))
    assert (tmp_path / "p.png").stat().st_size > 5000
    plain = neutral(frame)[0]
    # what the README of the set asks for
    assert {"solver", "name", "n", "m", "status", "objective", "iterations", "time"} <= plain.keys()
    assert (plain["time"], plain["wall_time"], plain["reached"]) == (1.0, 9.0, True)


PROGRAM = """#!{python}
# a solver that knows one iteration: it returns the start, and claims that it is optimal
import sys
stub, flag, *options = sys.argv[1:]
assert flag == "-AMPL"
lines = open(stub + ".nl").read().split("\\n")
n, m = map(int, lines[1].split()[:2])
first = lines.index(f"x{{n}}") + 1
values = [line.split()[1] for line in lines[first : first + n]]
head = ["mine with " + " ".join(options), "", "Options", "3", "0", "1", "0", m, 0, n, n]
open(stub + ".sol", "w").write("\\n".join(map(str, [*head, *values, "objno 0 0"])) + "\\n")
"""


@pytest.mark.slow
def test_a_solver_of_ones_own_is_a_command_line(tmp_path, monkeypatch, capsys):
    program = tmp_path / "mine"
    program.write_text(PROGRAM.format(python=sys.executable))
    program.chmod(0o755)
    scene = {"kind": "scene", "scene": "room", "seed": 1, "width": 128, "height": 64}
    own = {
        "input": scene,
        "segmentation": {"superpixels": 20, "neighbours": 4},
        "energy": {"pixel_samples": 4},
        "flow": {"source": "truth"},
    }
    record = record_of(prepare(make_problem(own)))
    monkeypatch.setattr(runner, "load_frozen", lambda scene, size: record)
    entry = {"name": f"{STUB}-hard", "best_known": {"objective": 1.0}}
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "index.json").write_text(json.dumps({"instances": [entry]}))
    out = tmp_path / "out"
    words = ["compare", str(tmp_path / "set"), "-o", str(out), "--solvers", f"{program} fast=1"]
    # a false claim is no verified run
    assert main(words) == 1
    assert "-" in capsys.readouterr().out
    result = json.loads((out / "results.json").read_text())["results"][0]
    assert result["status"] == "mine with fast=1"
    assert result["claimed"]
    assert not result["verified"]
    assert result["dual"] > 1e-2
    for name in ("README.md", "profiles.png", "reached.json", "runs.jsonl"):
        assert (out / name).stat().st_size > 0


def test_curves_of_equal_times_are_drawn(tmp_path):
    """Two times that differ by rounding only leave no room for automatic limits."""
    for times in ([0.1, np.nextafter(0.1, 1)], [0.0, 0.0], [2.0]):
        row = {
            "problem": "room hard",
            "problem_hash": "0",
            "superpixels": 100,
            "formulation": "unit-offset/smooth",
            "solver": "mine",
            "energy_start": 2.0,
            "claimed": False,
            "status": "x",
            "iterations": 1,
            "peak_bytes": 0,
            "energy": 1.0,
            "seconds": times[-1],
            "verified": False,
            "curve": [[t, 1.5] for t in times],
        }
        draw_curves(tmp_path / "curves.png", frame_of_runs([row]))
        assert (tmp_path / "curves.png").stat().st_size
