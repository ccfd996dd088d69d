"""Profiles and records of runs of solvers; a solver of one's own on the set."""

import json
import os
import sys

import pytest

from benchmarks.__main__ import main
from benchmarks.family.instances import STANDARD, VERSION, select
from benchmarks.family.write import write_family
from benchmarks.solvers import cost_table, frame_of_runs, profile
from soup_nlp.storage.each import read_rows

pytestmark = pytest.mark.slow

STUB = "SOUP-room-unit-offset-smooth-N100"


def row(solver: str, start: str, objective: float, cpu: float = 1.0, verified: bool = True) -> dict:
    return {
        "problem": f"room {start}", "superpixels": 100, "formulation": "f", "identity": 4,
        "solver": solver, "start": start, "name": f"{STUB}-{start}", "best_known": 4.0,
        "objective": objective, "cpu": cpu, "verified": verified, "claimed": True, "n": 7, "m": 3,
        "status": "ok", "iterations": 3, "primal": 0.0, "dual": 0.0, "complementarity": 0.0,
    }  # fmt: skip


ROWS = [
    row("one", "hard", 4.0), row("two", "hard", 3.0, 2.0), row("three", "hard", 1.0, 0.1, False),
    row("one", "cold", 4.0, 6.0), row("two", "cold", 4.0, 3.0),
]  # fmt: skip


def test_profiles_by_hand():
    cost = cost_table(frame_of_runs(ROWS), "cpu")
    assert (len(cost), list(cost)) == (2, ["one", "three", "two"])
    share = profile(cost)
    assert share.index.tolist() == [1, 2]
    # each wins one problem; both solve all within twice the best; a false claim solves none
    assert share.to_numpy().tolist() == [[0.5, 0, 0.5], [1, 0, 1]]
    share = profile(cost_table(frame_of_runs(ROWS), "objective"))
    assert share.index.tolist() == [1, 4 / 3]
    assert share.to_numpy().tolist() == [[0.5, 0, 1], [1, 0, 1]]
    # nothing is solved
    share = profile(cost_table(frame_of_runs(ROWS[2:3]), "cpu"))
    assert share.index.tolist() == [1]
    assert share.to_numpy().tolist() == [[0]]


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


def test_a_solver_of_ones_own_is_a_command_line(tmp_path, monkeypatch, capsys):
    """The recipe of docs/adding.md: a program that reads .nl, found by its name on the PATH."""
    program = tmp_path / "mine"
    program.write_text(PROGRAM.format(python=sys.executable))
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    write_family(tmp_path / "set", select([100], ["orbit"], [STANDARD], ["hard"]), str)
    out = tmp_path / "out"
    # a false claim is no verified run
    words = ["solvers", str(tmp_path / "set"), "-o", str(out), "--solvers", "mine fast=1"]
    assert main(words) == 1
    assert "claim is FALSE" in capsys.readouterr().out
    stored = json.loads((out / "results.json").read_text())
    assert (stored["set"], stored["version"]) == ("SOUP", VERSION)
    (result,) = stored["results"]
    assert result["status"] == "mine with fast=1"
    assert (result["claimed"], result["verified"]) == (True, False)
    assert result["dual"] > 1e-2
    (row,) = read_rows(out / "runs.jsonl")
    # its point is the start, as read from its file
    assert row["energy"] == pytest.approx(row["energy_start"], rel=1e-12)
    for name in ("README.md", "profiles.png", "runs.jsonl"):
        assert (out / name).stat().st_size > 0
