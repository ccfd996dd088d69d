"""AMPL's .sol format, and the multipliers and residuals with which answers are verified."""

import subprocess
from types import SimpleNamespace

import numpy as np
import pytest
from helpers_model import PAPER, Tiny
from scipy import sparse

from benchmarks.family.sol import write_sol
from soup_nlp.errors import ExportError
from soup_nlp.export import verify
from soup_nlp.export.nl import write_nl
from soup_nlp.export.sol import read_sol
from soup_nlp.export.solvers import find_program
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
    path = tmp_path / "a.sol"
    path.write_text(TEXT)
    sol = read_sol(path, ORDER, ROWS)
    assert sol.message == "solver 1.0: optimal"
    assert (sol.code, sol.solved, sol.status) == (0, True, "solved")
    # file: variable 2 is 10, variable 0 is 20, variable 1 is 30
    assert sol.x.tolist() == [20, 30, 10]
    assert sol.lam_g.tolist() == [-0.25, 1.5]
    # with a tolerance and without duals
    path.write_text("Options\n5\n1\n1\n3\n2\n0\n3\n3\n1e-6\n1\n2\n3\nobjno 0 400\n")
    sol = read_sol(path, ORDER, ROWS)
    assert sol.x.tolist() == [2, 3, 1]
    assert (sol.lam_g, sol.status, sol.solved) == (None, "limit", False)
    path.write_text(TEXT.partition("objno")[0])
    sol = read_sol(path, ORDER, ROWS)
    assert (sol.code, sol.status, sol.solved) == (-1, "unknown", False)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("Options", "Optionen", "ends early"),
        (TEXT[TEXT.index("20") :], "", "ends early"),
        ("objno 0 0", "objno", "objno, objective, code"),
        ("\n30\n", "\nthirty\n", "line 17"),
        ("\n2\n2\n3\n3\n", "\n2\n2\n4\n4\n", "another problem"),
        ("\n2\n2\n3\n3\n", "\n2\n2\n3\n0\n", "no point"),
        ("\n30\n", "\nnan\n", "not finite"),
        ("objno 0 0", "objno 0 abc", "objno"),
        ("objno 0 0", f"objno 0 {'9' * 5000}", "objno"),
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
    with pytest.raises(ExportError, match="is missing"):
        read_sol(tmp_path / "none.sol", ORDER, ROWS)


@pytest.mark.slow
def test_multipliers_of_a_foreign_optimum(tmp_path):
    pounce = find_program("pounce")
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
    # as good from the point alone; no multipliers make another point stationary
    for x, most in ((sol.x, 1e-4), (sol.x + 0.01, 1e-2)):
        lam = least_squares_multipliers(nlp, x)
        off = max(optimality(nlp, x, bound_multipliers(nlp, x, lam), lam).values())
        assert (off < most) == (x is sol.x)


# --- multipliers and residuals of answers, names of an export -------------------------------------


def program(gradient, jacobian, g, **bounds):
    """A program that is given by its numbers at a point."""
    n = len(gradient)
    every = {"lbx": np.full(n, -np.inf), "ubx": np.full(n, np.inf), **bounds}
    return SimpleNamespace(
        gradient=lambda x: np.array(gradient),
        jacobian=lambda x: sparse.csr_matrix(jacobian),
        constraints=lambda x: np.array(g),
        ng=len(g),
        **{k: np.array(v, float) for k, v in every.items()},
    )


NEAR, BEYOND = 0.5 * verify.ACTIVE, 2 * verify.ACTIVE


@pytest.mark.parametrize(
    ("gradient", "g", "lower", "upper", "expected"),
    [
        # grad f + lam = 0: a lower bound pushes with lam < 0, an upper one with lam > 0
        ([3, -4, -5, 6], [1, 2, 1, 2], 1, 2, [-3, 4, 0, 0]),
        # rows near a bound of 0 are active
        ([1, -1, 1, -1], [NEAR, -NEAR, BEYOND, -BEYOND], 0, 0, [-1, 1, 0, 0]),
    ],
)
def test_only_active_bounds_give_multipliers_of_their_sign(gradient, g, lower, upper, expected):
    """Rows have a lower and an upper bound in turn."""
    sides = {"lbg": [lower, -np.inf] * 2, "ubg": [np.inf, upper] * 2}
    # a row whose multiplier would have the wrong sign leaves the others' values alone
    nlp = program(np.array(gradient, float), np.eye(4) + np.eye(4, k=-2), g, **sides)
    lam = verify.least_squares_multipliers(nlp, np.zeros(4))
    np.testing.assert_allclose(lam, expected, atol=1e-9)


def test_a_variable_at_its_bound_takes_the_whole_gradient():
    """One at each bound, one in the middle of a distance 4 to the bound that it is pushed to."""
    none = {"jacobian": np.zeros((1, 3)), "g": [0.0]}
    nlp = program([-2.0, 3.0, -5.0], **none, lbx=[-1.0, 2.0, 0.0], ubx=[3.0, 9.0, 8.0])
    lam = verify.bound_multipliers(nlp, np.array([3.0, 2.0, 4.0]), np.zeros(1))
    np.testing.assert_allclose(lam, [2.0, -3.0, 1.0], rtol=1e-15)


@pytest.mark.parametrize(
    ("message", "read"),
    [("two\n\nlines", "two\nlines"), ("one\n Options\ntwo", 'one\n"Options"\ntwo')],
)
@pytest.mark.parametrize("lam", [None, np.array([0.1, -1 / 3])])
def test_written_files_read_back(message, read, lam, tmp_path):
    x = np.random.default_rng(0).normal(size=3)
    write_sol(tmp_path / "a.sol", x, lam, ORDER, ROWS, message, 402)
    sol = read_sol(tmp_path / "a.sol", ORDER, ROWS)
    assert np.array_equal(sol.x, x)
    assert np.array_equal(sol.lam_g, lam)
    assert (sol.message, sol.code) == (read, 402)
