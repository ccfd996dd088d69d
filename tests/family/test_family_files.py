"""Files beside the instances: what solvers reached, CasADi's form, the runner in one file."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from functools import partial

import casadi as ca
import numpy as np
import pytest
from freeze_family import record_of

from soup_nlp.bench.solvers import runner
from soup_nlp.cli.main import main
from soup_nlp.config.problem import make_problem
from soup_nlp.family import run_solver
from soup_nlp.family.instances import STANDARD
from soup_nlp.family.write import _reached
from soup_nlp.pipeline.case import prepare

pytestmark = pytest.mark.slow

STUB = "SOUP-room-unit-offset-smooth-N100"


def test_what_solvers_reached_is_said_by_start():
    entry = {
        "short": "SOUP-orbit-os-100h",
        "best_known": {"objective": 10.0},
        "runs": {
            "a": [10.0, 2.0, 25.0, True],
            "b": [12.5, 25.1, 25.0, False],
            "c": [None, 3, 25, 0],
        },
    }
    *_, row = _reached([entry, {"runs": {}}])
    assert row == (
        "| SOUP-orbit-os-100h | **+0 %**, 2 of 25 s | +25 %, 25.1 of 25 s | no point, 3 of 25 s |"
    )
    assert _reached([{"runs": {}}]) == []


def test_casadis_form_is_read_back(folder):
    text = (folder / f"{STUB}.casadi").read_text()
    data = ca.StringDeserializer(text)
    nlp, *vectors = [data.unpack() for _ in range(8)]
    lbx, ubx, lbg, ubg, *starts = (np.array(v).ravel() for v in vectors)
    index = json.loads((folder / "index.json").read_text())["instances"]
    own = [e for e in index if e["formulation"] == STANDARD]
    for entry, x0 in zip(own, starts, strict=True):
        assert float(nlp(x0)[0]) == pytest.approx(entry["objective_at_start"], rel=1e-8)
        assert (lbx <= x0).all() & (x0 <= ubx).all()
    g = np.array(nlp(starts[0])[1]).ravel()
    assert ((g >= lbg - 1e-4) & (g <= ubg + 1e-4)).all()


@pytest.mark.parametrize(("move", "word"), [(0.0, "converged"), (1e-3, "WRONG")])
def test_the_runner_judges_an_answer(move, word, folder, tmp_path, capsys):
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    # a solver that returns the best known point, or one off the constraints, and claims success
    program = tmp_path / "mine"
    program.write_text(
        f"#!{sys.executable}\n"
        "import sys\n"
        f"text = open('{STUB}.sol').read().splitlines()\n"
        "first = text.index('Options') + 9\n"
        f"text[first] = repr(float(text[first]) + {move})\n"
        "open(sys.argv[1] + '.sol', 'w').write('\\n'.join(text) + '\\n')\n"
    )
    program.chmod(0o755)
    words = [f"{program} fast=1", "unit-offset", "hard", "--folder", str(tmp_path)]
    assert run_solver.main(words) == (word == "WRONG")
    out = capsys.readouterr().out
    assert f"SOUP-room-os-100h        {word}" in out
    assert f"1 {word}" in out


def test_the_runner_knows_limits_and_other_minima(tmp_path):
    point = run_solver.Point("", 0, np.zeros(0), np.zeros(1))
    judged = partial(run_solver.verdict, best=10.0, near=1e-4)
    assert judged(None, 1.0, 0.0, 0.0) == "stopped"
    assert judged(replace(point, code=400), 10.0, 0.0, 0.0) == "stopped"
    assert judged(point, 10.0005, 1e-9, 1e-8) == "converged"
    assert judged(point, 11.0, 1e-9, 1e-8) == "differs"
    assert judged(point, 10.0, 1e-3, 0.0) == "WRONG"
    assert judged(point, 10.0, 0.0, 0.1) == "WRONG"
    # without multipliers the point has to be feasible
    assert judged(point, 11.0, 0.0, float("nan")) == "differs"
    (tmp_path / "x.sol").write_text("cut off\n\nOptions\n3\n")
    assert run_solver.read_point(tmp_path / "x.sol") is None


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
