"""Delete each constraint row and each bound of the NLP: `python tests/tools/constraint_mutants.py`.

A mutant is one change in a copy of the package. The fast tests of `test_constraints.py` have to
fail; the table says which test saw it. The exit code is the number of mutants that survive.
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
BUILDER, IPOPT, NORMS = "model/builder.py", "solve/ipopt.py", "model/norms.py"
FREE = "lower=-1e9, upper=1e9"
ROWS = "for c in range(3) for r in range(c + 1)"
MUTANTS = [
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
    Mutant("epigraph rows not held", BUILDER, 'f"epigraph_{norm}", 0.0,',
           'f"epigraph_{norm}", -1e9,'),
    Mutant("epigraph without eps", NORMS, "slack**2 - square - norm.eps**2", "slack**2 - square"),
    Mutant("slack >= 0", BUILDER, 'Block(f"s_{norm}", 0.0,', 'Block(f"s_{norm}", -np.inf,'),
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


def copied(place: Path) -> Path:
    """A copy of the package and its tests, to be changed."""
    for name in ("soup_nlp", "tests", "problems"):
        shutil.copytree(ROOT / name, place / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", place)
    return place


def killer(root: Path, module: Path, text: str, tests: str) -> str:
    """The first fast test that fails where a module of a copy has another text; "" if none does."""
    before = module.read_text()
    module.write_text(text)
    words = ["-m", "pytest", "-x", "-q", "-m", "not slow", "-p", "no:cacheprovider", tests]
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
        for mutant in MUTANTS:
            module = root / "soup_nlp" / mutant.module
            text = module.read_text()
            if text.count(mutant.old) != 1:
                raise SystemExit(f"{mutant.what}: {mutant.module} has not one {mutant.old!r}")
            text = text.replace(mutant.old, mutant.new)
            found = killer(root, module, text, "tests/model/test_constraints.py")
            alive += not found
            print(f"{mutant.what:<34} {found or 'SURVIVES'}", flush=True)
    print(f"{len(MUTANTS) - alive} of {len(MUTANTS)} killed")
    return alive


if __name__ == "__main__":
    sys.exit(main())
