"""Delete constraint rows and bounds, widen verdicts: `python tests/tools/constraint_mutants.py`.

A mutant is one change in a copy of the package. The fast tests of `ROWS_AND_BOUNDS` or `VERDICTS`
have to fail; the table says which test saw it. The exit code is the number of mutants that survive.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]


class Mutant(NamedTuple):
    """One change: `old` becomes `new` in a module of the package."""

    what: str
    module: str
    old: str
    new: str


PROGRAMS, TERMS = "model/programs.py", "model/terms.py"
IPOPT = "solve/ipopt.py"
FREE = "lower=-1e9, upper=1e9"
ROWS = "for c in range(3) for r in range(c + 1)"
ROWS_AND_BOUNDS = ("tests/model/test_constraints.py",)
DELETED = [
    *[
        Mutant(f"so3 without ({r}, {c})", TERMS, ROWS, f"{ROWS} if (r, c) != ({r}, {c})")
        for c in range(3)
        for r in range(c + 1)
    ],
    Mutant("so3 not held", PROGRAMS, "terms.so3(v), every, lower=0.0, upper=0.0",
           f"terms.so3(v), every, {FREE}"),
    Mutant("normal not held", PROGRAMS, "terms.unit_normal(v), every, lower=0.0, upper=0.0",
           f"terms.unit_normal(v), every, {FREE}"),
    Mutant("normal at most 1", PROGRAMS, "terms.unit_normal(v), every, lower=0.0",
           "terms.unit_normal(v), every, lower=-1e9"),
    Mutant("visible without the anchor", TERMS, "for j in range(count)])",
           "for j in range(1, count)])"),
    Mutant("visible without the last rim ray", TERMS, "for j in range(count)])",
           "for j in range(count - 1)])"),
    Mutant("visible down to 0", PROGRAMS, "lower=form.min_facing", "lower=0.0"),
    Mutant("visible without depth_ratio", PROGRAMS, "data.visibility_ray(form.depth_ratio)",
           "data.visibility_ray(1e9)"),
    Mutant("simplex not held", PROGRAMS, '"simplex", x, body, every, lower=1.0, upper=1.0',
           f'"simplex", x, body, every, {FREE}'),
    Mutant("simplex at most 1", PROGRAMS, '"simplex", x, body, every, lower=1.0',
           '"simplex", x, body, every, lower=0'),
    Mutant("unit not held", PROGRAMS, '"unit", x, body, every, lower=1.0, upper=1.0',
           f'"unit", x, body, every, {FREE}'),
    Mutant("translation not held", PROGRAMS, "body, index, lower=0.0, upper=0.0",
           f"body, index, {FREE}"),
    Mutant("lam > 0", PROGRAMS, "lbx[np.arange(n) * stride] = MIN_SCALE", "pass"),
    Mutant("d > 0", PROGRAMS, "lbx[np.arange(n) * stride + 4] = MIN_SCALE", "pass"),
    Mutant("tau > 0", PROGRAMS, "lbx[layout.tau] = 1e-8", "pass"),
    Mutant("presolve: simplex", PROGRAMS, "value, index, lower=1.0, upper=1.0",
           f"value, index, {FREE}"),
    Mutant("presolve: visible", PROGRAMS, "        lower=0.0,\n        upper=np.inf",
           "        lower=-1e9,\n        upper=np.inf"),
    Mutant("presolve: a rim ray", PROGRAMS, "for j in range(count)])",
           "for j in range(count - 1)])"),
    Mutant("presolve: lam > 0", PROGRAMS, "lower[:, 0] = 1e-3", "pass"),
    Mutant("presolve: box of slopes", PROGRAMS, "lower[:, 1:3], upper[:, 1:3] =", "_ ="),
    *[
        Mutant(f"Ipopt without {name}", IPOPT, '("lbx", "ubx", "lbg", "ubg")',
               str(tuple(b for b in ("lbx", "ubx", "lbg", "ubg") if b != name)))
        for name in ("lbx", "ubx", "lbg", "ubg")
    ],
    Mutant("Ipopt stops at 1e-4", IPOPT, '"constr_viol_tol": 1e-9', '"constr_viol_tol": 1e-4'),
]  # fmt: skip
KINDS, KKT = "geometry/constraints.py", "solve/kkt.py"
VERDICTS = ("tests/geometry/test_soup_constraints.py", "tests/solve/test_verdicts.py")
WIDENED = [
    Mutant("limit of so3", KINDS, '"entry of R\'R", 1e-8', '"entry of R\'R", 1e-2'),
    Mutant("limit of det", KINDS, '"det R", 1e-8', '"det R", 1e-2'),
    Mutant("limit of the simplex", KINDS, '"sum of all lam", 1e-10', '"sum of all lam", 1e-3'),
    Mutant("limit of visibility", KINDS, '"-n . r, rays with z = 1", 1e-6',
           '"-n . r, rays with z = 1", 1e-3'),
    Mutant("absolute determinant", KINDS, "np.abs(np.linalg.det(R) - 1)",
           "np.abs(np.abs(np.linalg.det(R)) - 1)"),
    Mutant("visibility at the anchor only", KINDS, "(min_facing - facing).max(axis=1)",
           "(min_facing - facing)[:, 0]"),
    Mutant("limits of a stored result", "report/check.py", "ABSOLUTE, k.limit, k.note",
           "ABSOLUTE, 1e6 * k.limit, k.note"),
    Mutant("no Constraints_Violated", "solve/stages.py", "status=UNMET if broken else stage.status",
           "status=stage.status"),
    Mutant("converged though violated", "solve/stages.py", "stage.converged and not broken",
           "stage.converged"),
    Mutant("complementarity of bounds only", KKT, ", (g, nlp.lbg, nlp.ubg, lam_g))", ",)"),
    Mutant("sign of the rim's multipliers", KKT, "= -rim / facing", "= rim / facing"),
    Mutant("slack of verification", "export/verify.py", "SLACK = 10.0", "SLACK = 1000.0"),
    Mutant("feasible to 1e-3", "export/verify.py", "FEASIBLE = 1e-6", "FEASIBLE = 1e-3"),
    Mutant("check of a .sol: to 1e-3", "export/foreign.py", "k, v, FEASIBLE", "k, v, 1e-3"),
    Mutant("check of a .sol: a soup to 1e-3", "export/foreign.py", "limit=FEASIBLE", "limit=1e-3"),
    Mutant("energy above the start", "export/verify.py", "ENERGY_SLACK = 1e-3",
           "ENERGY_SLACK = 1.0"),
    Mutant("check of a .sol: feasible is enough", "cli/results.py", "NOT_STATIONARY = 3",
           "NOT_STATIONARY = 0"),
]  # fmt: skip
MUTANTS = [
    *((mutant, ROWS_AND_BOUNDS) for mutant in DELETED),
    *((mutant, VERDICTS) for mutant in WIDENED),
]


def copied(place: Path) -> Path:
    """A copy of the package and its tests, to be changed."""
    for name in ("soup_nlp", "tests", "problems"):
        shutil.copytree(ROOT / name, place / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", place)
    return place


def killer(root: Path, module: Path, text: str, *tests: str) -> str:
    """The first fast test that fails where a module of a copy has another text; "" if none does."""
    before = module.read_text()
    module.write_text(text)
    words = ["-m", "pytest", "-x", "-q", "-m", "not slow", "-p", "no:cacheprovider", *tests]
    surroundings = {"PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(
            [sys.executable, *words],
            cwd=root,
            env=os.environ | surroundings,
            capture_output=True,
            text=True,
            check=False,
            timeout=900,
        )
    except subprocess.TimeoutExpired:
        return "endless"
    finally:
        module.write_text(before)
    found = re.search(r"^FAILED \S+::(\S+)", done.stdout, re.M)
    return found[1] if found else "" if done.returncode == 0 else "does not run"


def main() -> int:
    """Print a row per mutant."""
    alive = 0
    with tempfile.TemporaryDirectory(prefix="soup_mutants_") as place:
        root = copied(Path(place))
        for mutant, tests in MUTANTS:
            module = root / "soup_nlp" / mutant.module
            text = module.read_text()
            if text.count(mutant.old) != 1:
                raise SystemExit(f"{mutant.what}: {mutant.module} has not one {mutant.old!r}")
            text = text.replace(mutant.old, mutant.new)
            found = killer(root, module, text, *tests)
            alive += not found
            print(f"{mutant.what:<34} {found or 'SURVIVES'}", flush=True)
    print(f"{len(MUTANTS) - alive} of {len(MUTANTS)} killed")
    return alive


if __name__ == "__main__":
    sys.exit(main())
