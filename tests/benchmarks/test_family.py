"""The SOUP family: names, the same bytes on every processor, index, answers, runs of solvers."""

import inspect
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.__main__ import main
from benchmarks.family.frozen import load_frozen
from benchmarks.family.instances import (
    BITS,
    FORMULATIONS,
    SCENES,
    SIZES,
    STANDARD,
    VERSION,
    Instance,
    build_instance,
    case_of,
    parse_name,
    rounded,
    select,
)
from benchmarks.family.write import check_sol, published, write_family
from benchmarks.solvers import cost_table, frame_of_runs, profile
from soup_nlp.errors import ConfigError
from soup_nlp.export.symbolic import make_oracle
from soup_nlp.storage.each import read_rows

pytestmark = pytest.mark.slow

OTHER = "unit-translation/smooth"


# --- names ---------------------------------------------------------------------------------------


def test_a_name_says_which_instance_it_is():
    one = Instance("street", OTHER, 250, "cold")
    assert one.name == "SOUP-street-unit-translation-smooth-N250-cold"
    assert parse_name(one.name) == one
    assert parse_name(one.problem).start == "easy"
    every = select(SIZES, SCENES, [*FORMULATIONS])
    assert len({i.name for i in every}) == len(every)
    assert all(parse_name(i.name) == i for i in every[::17])
    # the gauge has a dash of its own
    standard = Instance("orbit", STANDARD, 250, "hard")
    assert parse_name(standard.name) == standard
    for wrong in ("SOUP-moon-unit-offset-smooth-N100-easy", "SOUP-street-smooth-N100-easy", "x"):
        with pytest.raises(ConfigError, match="SOUP-SCENE"):
            parse_name(wrong)


# --- the same bytes ------------------------------------------------------------------------------


def test_rounding_takes_last_bits_away():
    rng = np.random.default_rng(0)
    values = rng.normal(size=4000) * 10.0 ** rng.integers(-4, 4, 4000)
    out = rounded(values)
    assert (rounded(values * (1 + 4e-16)) == out).all()
    assert (rounded(out) == out).all()
    assert (np.abs(out / values - 1)[np.abs(values) > 1e-2] < 2.0 ** (1 - BITS)).all()
    # numbers that are short stay, from whichever side they come
    exact = np.array([0.0, 1.0, -1.0, 0.5, 435.5, -0.375])
    for nudge in (0.0, 1e-15, -1e-15):
        assert (rounded(exact + nudge) == exact).all()
    assert rounded(np.array([np.inf, -np.inf])).tolist() == [np.inf, -np.inf]


def digests(file: str) -> list[str]:
    """SHA-256 of an instance that is published, then of other formulations and starts."""
    from pathlib import Path

    from benchmarks.family.frozen import load_frozen
    from benchmarks.family.instances import build_instance, case_of
    from soup_nlp.export.nl import write_nl

    record = load_frozen("street", 100)
    case = case_of(record)
    chosen = [
        *(("unit-offset", "hard"), ("unit-offset", "best")),
        *(("unit-translation", "cold"), ("tangent", "easy")),
    ]
    nlps = (build_instance(case, record, f"{f}/smooth", x)[0] for f, x in chosen)
    return [write_nl(Path(file), nlp).sha256 for nlp in nlps]


def test_two_processors_make_the_published_bytes(tmp_path):
    file = str(tmp_path / "x.nl")
    here = digests(file)
    program = f"{inspect.getsource(digests)}\nprint(*digests({file!r}))"
    # numpy's own loops without vector instructions beyond the baseline as well
    old = {"OPENBLAS_CORETYPE": "Nehalem", "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4"}
    ended = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", program],
        env={**os.environ, "OMP_NUM_THREADS": "1", **old},
        capture_output=True,
        text=True,
        check=True,
    )
    assert ended.stdout.split() == here
    assert here[0] == published()["sha256"][Instance("street", STANDARD, 100, "hard").name]


def test_the_start_does_not_change_the_program():
    record = load_frozen("orbit", 100)
    case = case_of(record)
    starts = [build_instance(case, record, "tangent/smooth", s)[:2] for s in ("hard", "cold")]
    (first, layout), (other, same) = starts
    assert np.array_equal(make_oracle(other)[1], make_oracle(first)[1])
    assert np.array_equal(same.R0, layout.R0)
    # and the best known point is that of the matrices
    best = [build_instance(case, record, f, "best")[0] for f in ("tangent/smooth", STANDARD)]
    f, m = (p.value(p.x0) for p in best)
    assert f == pytest.approx(m, rel=1e-9)


# --- the folder ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The instances of the smallest record of one scene, and one of another formulation."""
    out, lines = tmp_path_factory.mktemp("set"), []
    chosen = select([100], ["orbit"], [STANDARD]) + select([100], ["orbit"], [OTHER], ["hard"])
    write_family(out, chosen, lines.append)
    assert len(lines) == len(chosen) == 4
    return out


def test_the_index_says_what_problem_sets_say(folder):
    index = json.loads((folder / "index.json").read_text())
    assert (index["set"], index["version"]) == ("SOUP", VERSION)
    entries = {e["name"]: e for e in index["instances"]}
    easy = entries["SOUP-orbit-unit-offset-smooth-N100-easy"]
    n = easy["superpixels"]
    assert easy["variables"] == 16 * n
    assert easy["constraints"] == 16 * n + 1
    assert [e["published"] for e in entries.values()] == [True, True, True, None]
    other = entries["SOUP-orbit-unit-translation-smooth-N100-hard"]
    assert other["variables"] > easy["variables"]
    # the three starts are one problem
    starts = [entries[f"SOUP-orbit-unit-offset-smooth-N100-{s}"] for s in ("hard", "cold")]
    assert starts[1]["objective_at_start"] > 2 * starts[0]["objective_at_start"]
    assert starts[0]["best_known"] == easy["best_known"]
    assert "CC BY 4.0" in (folder / "LICENSE.txt").read_text()
    assert easy["sha256"][:16] in (folder / "README.md").read_text()


@pytest.mark.parametrize(
    "text", ["{}", "[]", '{"instances": 5}', '{"instances": [{"name": "x"}]}', '{"instances": [1]}']
)
def test_a_damaged_index_is_refused(text, tmp_path, capsys):
    (tmp_path / "index.json").write_text(text)
    assert main(["solvers", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "index of the family" in capsys.readouterr().err


def test_a_best_point_is_read_back_as_an_answer(folder):
    text, good = check_sol(folder / "SOUP-orbit-unit-offset-smooth-N100.sol")
    assert good
    assert "gap +0.00e+00" in text
    assert float(text.split("primal")[1].split()[0]) < 1e-14


def test_an_answer_off_the_constraints_is_told(folder, tmp_path, capsys):
    text = (folder / "SOUP-orbit-unit-offset-smooth-N100.sol").read_text().splitlines()
    # the point is the last of the numbers
    last = next(k for k, line in enumerate(text) if line.startswith("objno")) - 1
    text[last] = repr(float(text[last]) + 0.5)
    path = tmp_path / "SOUP-orbit-unit-offset-smooth-N100-hard.sol"
    path.write_text("\n".join(text) + "\n")
    assert main(["check", str(path)]) == 1
    assert "not verified" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["mine.txt", ".hidden"])
def test_other_files_are_not_overwritten(name, tmp_path, capsys):
    (tmp_path / name).write_text("mine")
    assert main(["family", str(tmp_path), "--sizes", "100"]) == 2
    assert "holds other files" in capsys.readouterr().err
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


# --- runs of solvers ------------------------------------------------------------------------------

STUB = "SOUP-orbit-unit-offset-smooth-N100"


def row(solver: str, start: str, objective: float, cpu: float = 1.0, verified: bool = True) -> dict:
    return {
        "problem": f"orbit {start}", "superpixels": 100, "formulation": "f", "identity": 4,
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


@pytest.mark.usefixtures("one_process")
def test_a_solver_of_ones_own_is_a_command_line(folder, tmp_path, monkeypatch, capsys):
    """The recipe of docs/adding.md: a program that reads .nl, found by its name on the PATH."""
    program = tmp_path / "mine"
    program.write_text(PROGRAM.format(python=sys.executable))
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    # an index of one instance
    few = Path(shutil.copytree(folder, tmp_path / "set"))
    index = json.loads((few / "index.json").read_text())
    index["instances"] = [e for e in index["instances"] if e["name"] == f"{STUB}-hard"]
    (few / "index.json").write_text(json.dumps(index))
    out = tmp_path / "out"
    # a false claim is no verified run
    words = ["solvers", str(few), "-o", str(out), "--solvers", "mine fast=1"]
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
