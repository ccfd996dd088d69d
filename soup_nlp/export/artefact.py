"""The NLP of a problem as a folder of files, and a foreign solver's answer as a result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soup_nlp.config.problem import dump_problem, load_problem
from soup_nlp.errors import ConfigError, ExportError
from soup_nlp.export.bundles import FORMATS, write_casadi, write_start_h5
from soup_nlp.export.manifest import (
    MANIFEST,
    NORMS,
    STUB,
    TRUNCATIONS,
    kept_best,
    read_manifest,
    remove_stale,
)
from soup_nlp.export.names import readable_names
from soup_nlp.export.nl import write_nl
from soup_nlp.export.residuals import EQUATIONS, Kind, kind, residual_table
from soup_nlp.export.sol import Sol, read_sol
from soup_nlp.export.verify import ENERGY_SLACK, Limits, examine, violations
from soup_nlp.model import oracle
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.layout import GAUGES, MatrixLayout
from soup_nlp.model.nlp import NLP
from soup_nlp.pipeline import Case, Run, make_run, prepare
from soup_nlp.solve.ipopt import Stage
from soup_nlp.solve.kkt import residuals
from soup_nlp.solve.stages import Solution
from soup_nlp.storage.atomic import write_text
from soup_nlp.storage.store import write_json
from soup_nlp.storage.versions import versions

Float = NDArray[np.float64]

SAME = 1e-7
"""Relative difference of the objective at which an export is no longer the problem at hand."""
KKT_LIMIT = 1e-6
"""Largest violation of a constraint that a verified answer may have."""
LIMITS = Limits()
"""Of the other KKT residuals of a verified answer: those of `compare` as it comes."""


def parse_formulation(text: str) -> dict[str, str]:
    """`gauge/norm/truncation`, shorter where the rest is as in the problem file.

    Raises:
        ConfigError: a word is not one of the choices.
    """
    kinds = (("gauge", GAUGES), ("norm", NORMS), ("truncation", TRUNCATIONS))
    words = [w.strip() for w in text.split("/")]
    if len(words) > len(kinds):
        raise ConfigError(
            "too many words", where="--formulation", found=text, expected="gauge/norm/truncation"
        )
    for word, (key, choices) in zip(words, kinds):
        if word not in choices:
            raise ConfigError(
                f"unknown {key}", where="--formulation", found=word, expected=", ".join(choices)
            )
    return {key: word for word, (key, _) in zip(words, kinds)}


def form_label(form: Formulation) -> str:
    """`gauge/norm/truncation`."""
    return f"{form.gauge}/{form.norm}/{form.truncation}"


def export_case(
    case: Case,
    form: Formulation,
    folder: Path,
    formats: Sequence[str] = ("nl",),
    presolved: bool = False,
) -> dict[str, Any]:
    """Write soup.nl with names, problem.yaml and manifest.json into an existing folder.

    Files of an earlier export there that this one does not write are removed.

    Args:
        case: Problem with its start.
        form: Gauge, norm and truncation; the Hessian that the files carry is exact.
        folder: Where the files go.
        formats: Of FORMATS; nl is always written, and soup.h5 with casadi as well.
        presolved: The case starts at the presolve's answer (for the manifest).

    Returns:
        The manifest.

    Raises:
        ConfigError: unknown format.
        ExportError: the NLP cannot be written.
    """
    for word in formats:
        if word not in FORMATS:
            raise ConfigError(
                "unknown format", where="--format", found=word, expected=", ".join(FORMATS)
            )
    form = form.replace(hessian="exact", compiled=False)
    nlp, layout = case.nlp(form)
    names = readable_names(nlp, layout)
    file = write_nl(folder / f"{STUB}.nl", nlp, names=names)
    files = [f"{STUB}.nl", f"{STUB}.col", f"{STUB}.row"]
    best = kept_best(folder, file.sha256)
    remove_stale(folder, files)
    if "casadi" in formats:
        files += write_casadi(folder, nlp)
    write_text(folder / "problem.yaml", dump_problem(case.problem))
    manifest: dict[str, Any] = {
        "name": case.problem.name,
        "problem_hash": case.problem.digest(),
        "versions": versions(),
        "formulation": {k: getattr(form, k) for k in ("gauge", "norm", "truncation")},
        "smoothing": {"eps": form.eps, "eps_pixel": form.eps_pixel},
        "start": "presolve" if presolved else "proposal",
        "sizes": {
            "superpixels": len(case),
            "knn_edges": len(case.segmentation.edges),
            "neighbour_pairs": len(case.segmentation.pairs),
            **nlp.sizes(),
            "gradient_nonzeros": file.gradient_nonzeros,
            "nonlinear_rows": file.nonlinear_rows,
            "nonlinear_variables": dict(zip(("rows", "objective", "both"), file.nonlinear)),
            "defined_variables": sum(file.defined),
        },
        "nl": {"file": f"{STUB}.nl", "bytes": file.size, "sha256": file.sha256},
        "objective_at_start": float(nlp.oracle(nlp.x0, nlp.p)[0]),
        "exact_energy_at_start": oracle.energy(case.soup, case.data, case.weights),
        "fingerprint": _fingerprint(case, nlp, layout),
        "best_known": best,
        "files": files,
    }
    # the functions are of no use without parameters, start and bounds
    if "h5" in formats or "casadi" in formats:
        attrs = {k: manifest[k] for k in ("name", "problem_hash", "formulation", "smoothing")}
        write_start_h5(folder / f"{STUB}.h5", nlp, names, attrs)
        manifest["files"].append(f"{STUB}.h5")
    write_json(folder / MANIFEST, manifest)
    return manifest


def _fingerprint(case: Case, nlp: NLP, layout: MatrixLayout) -> dict[str, float]:
    """f and |g| at the proposal with every slack and switch at 1/2."""
    x = np.full(nlp.nx, 0.5)
    x[: layout.size] = layout.pack(case.start.soup)
    f, g = nlp.oracle(x, nlp.p)
    return {"objective": float(f), "constraints": float(np.linalg.norm(np.asarray(g)))}


@dataclass(frozen=True)
class Imported:
    """A foreign answer, made a run.

    Attributes:
        run: As `pipeline.run` returns it; "converged" means claimed and verified.
        sol: What the solver wrote.
        manifest: Of the export, best_known renewed.
        violations: Of bounds (nx,) and rows (ng,) by the point as it is.
    """

    run: Run
    sol: Sol
    manifest: Mapping[str, Any]
    violations: Mapping[str, Float]


def import_sol(folder: str | Path, sol: str | Path, renew: bool = True) -> Imported:
    """Read a .sol for an exported problem; energy and residuals are recomputed.

    The multipliers are the solver's, or the least-squares ones where these balance better; those
    of the bounds are what point and multipliers imply.

    Args:
        folder: Exported folder.
        sol: The solver's file.
        renew: Write a better verified answer into the manifest's best_known.

    Raises:
        ExportError: a file is missing or does not belong to the other.
        SoupError: the problem's input cannot be used.
    """
    folder = Path(folder)
    manifest = read_manifest(folder)
    case = prepare(load_problem(folder / "problem.yaml"))
    form = case.formulation(
        **manifest["formulation"], **manifest["smoothing"], hessian="exact", compiled=False
    )
    nlp, layout = case.nlp(form)
    for key, value in _fingerprint(case, nlp, layout).items():
        then = float(manifest["fingerprint"][key])
        if abs(value - then) > SAME * max(1.0, abs(then)):
            raise ExportError(
                "problem is not the one that was exported",
                where=folder,
                found=f"{key} {value!r}",
                expected=repr(then),
                hint="its images, its problem.yaml or the program have changed; export again",
            )
    answer = read_sol(sol, *_orders(folder, nlp, layout))
    # a point may be anything: what cannot be computed is infinite or NaN, and never verified
    with np.errstate(all="ignore"):
        run = foreign_run(case, form, nlp, layout, answer, source=Path(sol).name)
    best = manifest["best_known"]
    energy = run.solution.energy["total"]
    if renew and run.solution.converged and (best is None or energy < best["exact_energy"]):
        message = answer.message.splitlines()[0] if answer.message else Path(sol).name
        manifest["best_known"] = {
            "objective": run.solution.stages[-1].objective,
            "exact_energy": energy,
            "found_by": message,
        }
        write_json(folder / MANIFEST, manifest)
    return Imported(run, answer, manifest, violations(nlp, answer.x))


def sol_table(imported: Imported) -> list[Kind]:
    """Residuals by kind of a foreign answer as it is, before it is retracted."""
    run = imported.run
    state = {k: getattr(run.answer, k) for k in ("lam", "n", "d", "R", "t")}
    limits = dict.fromkeys(EQUATIONS, KKT_LIMIT)
    facing = run.problem.formulation.min_facing
    with np.errstate(all="ignore"):
        rows = residual_table(state, run.data.rim_ray, facing, limits)
    return rows + [kind(k, v, KKT_LIMIT, False) for k, v in imported.violations.items()]


def _orders(folder: Path, nlp: NLP, layout: MatrixLayout) -> tuple[Any, Any]:
    """Order of the file, from its names."""
    out = []
    for suffix, names in zip((".col", ".row"), readable_names(nlp, layout)):
        path = (folder / STUB).with_suffix(suffix)
        place = {name: k for k, name in enumerate(names)}
        try:
            lines = path.read_text(encoding="utf-8").split()[: len(names)]
            order = np.array([place[name] for name in lines], np.int64)
        except (OSError, ValueError, KeyError) as error:
            raise ExportError("names of the file cannot be used", where=path, found=error) from None
        if len(np.unique(order)) != len(names):
            raise ExportError(
                "names of the file are not complete",
                where=path,
                found=len(np.unique(order)),
                expected=len(names),
            )
        out.append(order)
    return out[0], out[1]


def foreign_run(
    case: Case, form: Formulation, nlp: NLP, layout: MatrixLayout, answer: Sol, source: str
) -> Run:
    """A run whose solution is a foreign solver's answer; nothing that it says is believed.

    It converged when success is claimed, the recomputed KKT residuals are within LIMITS and
    KKT_LIMIT, and the exact energy is not above the proposal's.
    """
    found = examine(nlp, answer.x, answer.lam_g)
    r = found.residuals
    f = nlp.oracle(answer.x, nlp.p)[0]
    own = layout.unpack(answer.x)
    soup = own.retracted()
    start, energy = (oracle.energy(s, case.data, case.weights) for s in (case.start.soup, soup))
    good = (
        answer.solved
        and r.within(LIMITS)
        and r.primal <= KKT_LIMIT
        and energy["total"] <= (1 + ENERGY_SLACK) * start["total"]
    )
    off = f"violation {r.primal:.1e}, dual {r.dual:.1e}, compl. {r.complementarity:.1e}"
    status = "Solve_Succeeded" if good else f"{answer.status}, {off}"
    stage = Stage(
        name=source,
        status=status,
        converged=good,
        x=answer.x,
        lam_x=found.lam_x,
        lam_g=found.lam_g,
        objective=float(f),
        iterations=0,
        seconds=0.0,
        history={},
        calls={},
    )
    parts = {
        f"lam_g_{group.kernel.name}": found.lam_g[np.unique(group.table.rows)]
        for group in nlp.groups
        if group.kernel.nc
    }
    solution = Solution(
        soup=soup,
        status=status,
        converged=good,
        stages=(stage,),
        energy_start=start,
        energy=energy,
        residuals=residuals(nlp, soup, stage, case.data, form.min_facing),
        multipliers={"lam_x": found.lam_x, **parts},
        nlp=nlp.sizes(),
        description=str(nlp),
        seconds={},
    )
    chosen = {k: getattr(form, k) for k in ("gauge", "norm", "truncation")}
    problem = case.problem.replace(formulation=case.problem.formulation.replace(**chosen))
    return make_run(replace(case, problem=problem), solution, own, "constrained NLP")
