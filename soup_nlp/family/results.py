"""Results of solvers on the family in a solver-independent form, and their verification."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from soup_nlp.export.program import make_program, orders
from soup_nlp.export.residuals import Kind, kind
from soup_nlp.export.sol import Sol, read_sol
from soup_nlp.export.verify import Limits, Residuals, examine, violations
from soup_nlp.family.frozen import load_frozen
from soup_nlp.family.instances import VERSION, build_instance, case_of, parse_name
from soup_nlp.storage.store import write_json

FEASIBLE = 1e-6
"""Largest violation of a verified point."""
TOLERANCE = 1e-4
"""Dual infeasibility and complementarity that `compare` asks for; ten times that is verified."""


@dataclass(frozen=True)
class Verdict:
    """Recomputed values of a solver's point for an instance.

    Attributes:
        sol: Contents of the .sol file.
        objective: Objective at the point.
        best: Best known objective.
        residuals: Unscaled KKT residuals.
        kinds: Violations of bounds and rows.
        n: Number of variables.
        m: Number of rows.
    """

    sol: Sol
    objective: float
    best: float
    residuals: Residuals
    kinds: list[Kind]
    n: int
    m: int

    @property
    def verified(self) -> bool:
        """Whether the point is feasible with small KKT residuals."""
        r = self.residuals
        return r.primal <= FEASIBLE and r.within(Limits(tol=TOLERANCE))

    def __str__(self) -> str:
        r, gap = self.residuals, (self.objective - self.best) / abs(self.best)
        said = self.sol.headline or "no message"
        word = "verified" if self.verified else "not verified"
        return "\n".join(
            [
                f"solver      {said} ({self.sol.status}, code {self.sol.code}): {word}",
                f"objective   {self.objective:.9g}, best known {self.best:.9g}, gap {gap:+.2e}",
                f"residuals   primal {r.primal:.1e}  dual {r.dual:.1e}  complementarity"
                f" {r.complementarity:.1e}  (unscaled; multipliers: {r.multipliers})",
            ]
        )


def check_sol(path: Path) -> Verdict:
    """Read `<name>.sol`, the answer to the instance of that name, and recompute its values.

    The instance is built again; the .nl file is not used.

    Raises:
        ConfigError: the name is not one of the family.
        ExportError: the file cannot be read.
    """
    instance = parse_name(path.stem)
    record = load_frozen(instance.scene, instance.size)
    case = case_of(record)
    nlp = build_instance(case, record, instance.formulation, instance.start)[0]
    best = build_instance(case, record, instance.formulation, "best")[0].x0
    program = make_program(nlp.groups, nlp.nx, nlp.ng, nlp.p[: len(nlp.theta)])
    sol = read_sol(path, *orders(program))
    with np.errstate(all="ignore"):
        return Verdict(
            sol,
            nlp.value(sol.x),
            nlp.value(best),
            examine(nlp, sol.x, sol.lam_g).residuals,
            [kind(k, v, FEASIBLE, False) for k, v in violations(nlp, sol.x).items()],
            nlp.nx,
            nlp.ng,
        )


def write_results(path: Path, rows: list[dict[str, Any]], note: dict[str, Any]) -> None:
    """Write results, whole or not at all.

    `note` has entries that hold for all rows, such as machine and limits.
    """
    write_json(path, {"set": "SOUP", "version": VERSION, **note, "results": rows})
