"""The reader of AMPL's .sol format, and multipliers of a foreign optimum."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers_model import PAPER, Tiny

from soup_nlp.errors import ExportError
from soup_nlp.export.nl import write_nl
from soup_nlp.export.sol import read_sol, write_sol
from soup_nlp.export.verify import bound_multipliers, least_squares_multipliers
from soup_nlp.model.formulation import Formulation
from soup_nlp.solve.kkt import optimality

ORDER = np.array([2, 0, 1])
ROWS = np.array([1, 0])
TEXT = """
solver 1.0: optimal

Options
3
1
1
0
2
2
3
3
-1.5
0.25
10
20
30
objno 0 0
suffix 4 2 13 0 0
ipopt_zL_out
0 0.5
2 0.125
suffix 4 1 13 0 0
ipopt_zU_out
1 -4
suffix 0 1 7 6 1
status
basic
1 3
"""


def test_a_file_is_read_into_the_order_of_the_problem(tmp_path):
    (tmp_path / "a.sol").write_text(TEXT)
    sol = read_sol(tmp_path / "a.sol", ORDER, ROWS)
    assert sol.message == "solver 1.0: optimal"
    assert (sol.code, sol.solved, sol.status) == (0, True, "solved")
    # file: variable 2 is 10, variable 0 is 20, variable 1 is 30
    assert sol.x.tolist() == [20, 30, 10]
    assert sol.lam_g.tolist() == [-0.25, 1.5]


def test_a_file_with_a_tolerance_and_without_duals(tmp_path):
    head = "Options\n5\n1\n1\n3\n2\n0\n3\n3\n1e-6\n1\n2\n3\nobjno 0 400\n"
    (tmp_path / "a.sol").write_text(head)
    sol = read_sol(tmp_path / "a.sol", ORDER, ROWS)
    assert sol.x.tolist() == [2, 3, 1]
    assert sol.lam_g is None
    assert (sol.status, sol.solved) == ("limit", False)


def test_written_files_read_back(tmp_path):
    rng = np.random.default_rng(0)
    x, lam = rng.normal(size=3), rng.normal(size=2)
    write_sol(tmp_path / "a.sol", x, lam, ORDER, ROWS, "two\n\nlines", 402)
    sol = read_sol(tmp_path / "a.sol", ORDER, ROWS)
    assert np.array_equal(sol.x, x)
    assert np.array_equal(sol.lam_g, lam)
    assert (sol.message, sol.code) == ("two\nlines", 402)
    write_sol(tmp_path / "a.sol", x, None, ORDER, ROWS)
    assert read_sol(tmp_path / "a.sol", ORDER, ROWS).lam_g is None


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("Options", "Optionen", "ends early"),
        ("objno 0 0", "objno", "objno, objective, code"),
        ("\n30\n", "\nthirty\n", "line 17"),
        ("\n2\n2\n3\n3\n", "\n2\n2\n4\n4\n", "another problem"),
        ("\n2\n2\n3\n3\n", "\n2\n2\n3\n0\n", "no point"),
        ("\n30\n", "\nnan\n", "not finite"),
        ("objno 0 0", "objno 0 abc", "objno"),
        *[("Options\n3\n", f"Options\n{count}\n", "a.sol") for count in ("nan", "-3", "1e300")],
        ("\n2\n2\n3\n3\n", "\n2\n2\n3.5\n3\n", "a.sol"),
        *[("-1.5\n", f"{value}\n", "not finite") for value in ("nan", "inf")],
    ],
)
def test_wrong_files_are_refused(tmp_path, old, new, said):
    assert old in TEXT
    (tmp_path / "a.sol").write_text(TEXT.replace(old, new))
    with pytest.raises(ExportError, match=said):
        read_sol(tmp_path / "a.sol", ORDER, ROWS)


def test_missing_and_truncated_files_are_refused(tmp_path):
    with pytest.raises(ExportError, match="is missing"):
        read_sol(tmp_path / "none.sol", ORDER, ROWS)
    (tmp_path / "a.sol").write_text(TEXT[: TEXT.index("20")])
    with pytest.raises(ExportError, match="ends early"):
        read_sol(tmp_path / "a.sol", ORDER, ROWS)


@pytest.mark.slow
def test_multipliers_of_a_foreign_optimum(tmp_path):
    pounce = shutil.which("pounce") or shutil.which(str(Path(sys.executable).parent / "pounce"))
    if pounce is None:
        pytest.skip("pounce (pounce-solver) is not installed")
    tiny = Tiny(neighbours=2, samples=1, boundary_samples=1)
    wide = 0.2 * float(tiny.data.K_next[0, 0])
    nlp, _ = tiny.nlp(PAPER, Formulation(hessian="exact", eps=wide, eps_pixel=0.2))
    file = write_nl(tmp_path / "soup.nl", nlp)
    command = [pounce, str(file.path), "tol=1e-8", "print_level=0"]
    subprocess.run(command, check=True, capture_output=True)
    sol = read_sol(tmp_path / "soup.sol", file.variables, file.rows)
    assert sol.solved
    # AMPL's sign is the opposite of CasADi's: the wrong one does not balance
    own, wrong = (bound_multipliers(nlp, sol.x, sign * sol.lam_g) for sign in (1, -1))
    assert max(optimality(nlp, sol.x, own, sol.lam_g).values()) < 1e-6
    assert max(optimality(nlp, sol.x, wrong, -sol.lam_g).values()) > 1e-3
    # without any multipliers: as good, from the point alone
    lam = least_squares_multipliers(nlp, sol.x)
    assert max(optimality(nlp, sol.x, bound_multipliers(nlp, sol.x, lam), lam).values()) < 1e-4
    # and no multipliers make another point stationary
    away = sol.x + 0.01
    lam = least_squares_multipliers(nlp, away)
    assert max(optimality(nlp, away, bound_multipliers(nlp, away, lam), lam).values()) > 1e-2


def test_a_message_with_the_word_options_is_read_back(tmp_path):
    write_sol(tmp_path / "a.sol", np.ones(3), None, ORDER, ROWS, "one\n Options\ntwo", 0)
    assert read_sol(tmp_path / "a.sol", ORDER, ROWS).message == 'one\n"Options"\ntwo'
