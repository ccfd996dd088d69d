"""Files beside the instances: what solvers reached; a solver of one's own."""

import json
import os
import sys

import pytest

from soup_nlp.bench.solvers import runner
from soup_nlp.cli.main import main
from soup_nlp.family.instances import VERSION
from soup_nlp.family.write import _reached
from soup_nlp.storage.rows import read_rows

pytestmark = pytest.mark.slow

STUB = "SOUP-room-unit-offset-smooth-N100"


def test_what_solvers_reached_is_said_by_start():
    entry = {
        "name": "SOUP-orbit-unit-offset-smooth-N100-hard",
        "best_known": {"objective": 10.0},
        "runs": {
            "a": [10.0, 2.0, 25.0, True],
            "b": [12.5, 25.1, 25.0, False],
            "c": [None, 3, 25, 0],
        },
    }
    *_, row = _reached([entry, {"runs": {}}])
    assert row == (
        "| SOUP-orbit-unit-offset-smooth-N100-hard | **+0 %**, 2 of 25 s | +25 %, 25.1 of 25 s"
        " | no point, 3 of 25 s |"
    )
    assert _reached([{"runs": {}}]) == []


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


def test_a_solver_of_ones_own_is_a_command_line(record, tmp_path, monkeypatch, capsys):
    """The recipe of docs/adding.md: a program that reads .nl, found by its name on the PATH."""
    program = tmp_path / "mine"
    program.write_text(PROGRAM.format(python=sys.executable))
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setattr(runner, "load_frozen", lambda scene, size: record)
    entry = {"name": f"{STUB}-hard", "best_known": {"objective": 1.0}}
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "index.json").write_text(json.dumps({"instances": [entry]}))
    out = tmp_path / "out"
    words = ["compare", str(tmp_path / "set"), "-o", str(out), "--solvers", "mine fast=1"]
    # a false claim is no verified run
    assert main(words) == 1
    assert "-" in capsys.readouterr().out
    stored = json.loads((out / "results.json").read_text())
    assert (stored["set"], stored["version"]) == ("SOUP", VERSION)
    (result,) = stored["results"]
    assert result["status"] == "mine with fast=1"
    assert result["claimed"]
    assert not result["verified"]
    assert result["dual"] > 1e-2
    (row,) = read_rows(out / "runs.jsonl")
    # its point is the start, as read from its file
    assert row["energy"] == pytest.approx(row["energy_start"], rel=1e-12)
    for name in ("README.md", "profiles.png", "reached.json", "runs.jsonl"):
        assert (out / name).stat().st_size > 0
