"""Answers of other solvers to exported problems, verified and returned as runs."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.config.problem import load_problem
from soup_nlp.errors import ExportError
from soup_nlp.export.artefact import fingerprint, read_manifest
from soup_nlp.export.program import file_orders
from soup_nlp.export.sol import Sol, read_sol
from soup_nlp.export.verify import ENERGY_SLACK, FEASIBLE, Residuals, examine, violations
from soup_nlp.geometry.constraints import Kind, constraints, kind
from soup_nlp.model import oracle
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.layout import Layout, MatrixLayout
from soup_nlp.model.nlp import NLP
from soup_nlp.pipeline.case import prepare
from soup_nlp.pipeline.record import Case, Run
from soup_nlp.pipeline.run import make_run
from soup_nlp.solve.ipopt import Stage
from soup_nlp.solve.kkt import residuals
from soup_nlp.solve.stages import Solution, multipliers
from soup_nlp.storage.files import as_path

SAME = 1e-7
"""Largest relative difference of the fingerprints of an export and of the present problem."""


@dataclass(frozen=True)
class Imported:
    """Answer of another solver as a run.

    Attributes:
        run: A run as `pipeline.run` returns it; "converged" means claimed and verified.
        sol: Contents of the .sol file.
        manifest: Manifest of the export.
        violations: Violations of bounds (nx,) and rows (ng,).
        residuals: KKT residuals of the answer.
    """

    run: Run
    sol: Sol
    manifest: Mapping[str, Any]
    violations: Mapping[str, Float]
    residuals: Residuals

    def __str__(self) -> str:
        """Message of the solver, and whether recomputed energy and residuals confirm its claim."""
        s, sol = self.run.solution, self.sol
        word = "verified" if s.converged else "not verified" if sol.solved else "no success claimed"
        terms = "  ".join(f"{k} {v:.5g}" for k, v in s.energy.items() if k != "total")
        # start of the solver, which after a presolve is not the proposal
        start = self.manifest["exact_energy_at_start"]["total"]
        return (
            f"{sol}: {word}\n"
            f"energy      start {start:.6g}  solution {s.energy['total']:.6g}\n"
            f"{'':<12}of the solution: {terms}\n"
            f"residuals   {'  '.join(f'{k} {v:.1e}' for k, v in s.residuals.items())}"
        )


def import_sol(folder: str | Path, sol: str | Path) -> Imported:
    """Read a .sol file for the problem of an exported folder; recompute energy and residuals.

    Raises:
        ExportError: a file is missing, or the files do not belong together.
        SoupError: the input of the problem cannot be used.
    """
    folder = as_path(folder, "exported folder", error=ExportError)
    manifest = read_manifest(folder)
    case = prepare(load_problem(folder / "problem.yaml", solved=False))
    form = case.formulation(coordinates=manifest["coordinates"], hessian="exact")
    nlp, layout = case.nlp(form)
    for then, now in zip(manifest["fingerprint"], fingerprint(case, nlp, layout), strict=True):
        if abs(now - then) > SAME * max(1.0, abs(then)):
            raise ExportError(
                "problem is not the one that was exported",
                where=folder,
                found=f"f or |g| {now!r}",
                expected=repr(then),
                hint="its images, its problem.yaml or the program have changed; export again",
            )
    more = manifest.get("lifted", 0)
    answer = read_sol(sol, *file_orders(nlp, more > 0), more)
    # values at an arbitrary point may be infinite or NaN; such an answer is not verified
    with np.errstate(all="ignore"):
        r = examine(nlp, answer.x, answer.lam_g)
        run = _run(case, form, nlp, layout, answer, r, Path(sol).name)
    return Imported(run, answer, manifest, violations(nlp, answer.x), r)


def sol_table(imported: Imported) -> list[Kind]:
    """Residuals of an answer by kind of constraint, before its retraction."""
    run = imported.run
    found = constraints(run.answer, run.data.rim_ray, run.problem.formulation.min_facing)
    rows = [replace(row, limit=FEASIBLE) for row in found.values()]
    return rows + [kind(k, v, FEASIBLE) for k, v in imported.violations.items()]


def _run(
    case: Case, form: Formulation, nlp: NLP, layout: Layout, answer: Sol, r: Residuals, name: str
) -> Run:
    """A run whose solution is the answer of another solver.

    It has converged if the solver claims success, the recomputed KKT residuals are those of an
    optimum, and the exact energy is not above that of the proposal.
    """
    point = layout.unpack(answer.x)
    soup = point.retracted()
    start, energy = (oracle.energy(s, case.data, case.weights) for s in (case.start.soup, soup))
    good = answer.solved and r.optimal and energy["total"] <= (1 + ENERGY_SLACK) * start["total"]
    off = f"violation {r.primal:.1e}, dual {r.dual:.1e}, compl. {r.complementarity:.1e}"
    status = "Solve_Succeeded" if good else f"{answer.status}, {off}"
    stage = Stage(name, status, good, answer.x, r.lam_x, r.lam_g, nlp.value(answer.x))
    # a run holds its last iterate in matrices
    matrices = MatrixLayout(case.data.share, form.gauge).pack(point)
    solution = Solution(
        soup=soup,
        status=status,
        converged=good,
        stages=(replace(stage, x=matrices),),
        energy_start=start,
        energy=energy,
        residuals=residuals(nlp, soup, stage, case.data, form.min_facing),
        multipliers=multipliers(nlp, stage),
        nlp=nlp.sizes(),
    )
    return make_run(case, solution)
