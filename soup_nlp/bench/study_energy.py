"""Studies of the energy: contribution of NLP and refinement, other methods, formulations."""

from __future__ import annotations

import itertools
import resource
import time
from collections.abc import Callable
from dataclasses import replace

from soup_nlp.bench.accuracy import scores
from soup_nlp.bench.analyses_measures import refined
from soup_nlp.bench.reference_solver import EPS, levenberg_marquardt
from soup_nlp.bench.speed import REFERENCE_ITERATIONS, problem_of
from soup_nlp.bench.studies import Cells, Study, number, setting
from soup_nlp.bench.suite_pairs import RENDERED
from soup_nlp.config.problem import make_problem
from soup_nlp.geometry.soup import Soup
from soup_nlp.pipeline.case import Case, prepare
from soup_nlp.pipeline.run import run
from soup_nlp.solve.stages import solve_soup
from soup_nlp.storage.rows import Row


def measure_refine(scene: str, superpixels: int) -> Row:
    """Solve a scene by the refinement alone, and by the NLP followed by the refinement."""
    source = {"kind": "scene", "scene": scene} if scene in RENDERED else {"kind": scene}
    runs, gib = [], []
    # the run with less memory first, since the peak of a process never falls
    for from_start in ("true", "false"):
        changes = [f"segmentation.superpixels={superpixels}", f"refine.from_start={from_start}"]
        runs.append(run(make_problem({"name": scene, "input": source}, changes)))
        gib.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20)
    alone, both = runs
    row = scores(both)
    after = both.refined
    assert after is not None
    totals = [after.energy_begin["total"], *(r.energy["total"] for r in after.rounds)]
    mre = {name: m["mre"] for name, m in row["metrics"]["paper"].items()}
    energy = {name: e["total"] for name, e in row["energy"].items()}
    only = scores(alone)
    return {
        "status": row["status"],
        "energy": energy | {"refinement": only["energy"]["solution"]["total"]},
        "mre": mre | {"refinement": only["metrics"]["paper"]["solution"]["mre"]},
        "gap": after.rounds[-1].gap / after.rounds[-1].mrf_energy,
        "monotone": all(b <= a for a, b in itertools.pairwise(totals)),
        "refine_seconds": after.seconds,
        "gib": gib[::-1],
    }


def _by_method(key: str, form: str, heads: tuple[str, ...]) -> Cells:
    """Columns of the start, of each half alone, and of both halves."""

    def cell(name: str) -> Callable[[Row], str]:
        return lambda row: format(row[key][name], form)

    names = "start", "refinement", "nlp", "solution"
    return {head: cell(name) for head, name in zip(heads, names, strict=True)}


HALVES = ("refinement only", "NLP only", "both")
REFINE = Study(
    "table",
    "Flow by DIS, {superpixels} superpixels wanted, K = 15, 50 particles, at most 10 rounds; MRE"
    " after median scale, no cap. Both = NLP, then refinement. The gap is how far the choice of"
    " the last round can be from the best one among its particles. Seconds: wall time of the"
    " refinement of both; memory: peak of the whole process, with and without the NLP.",
    measure_refine,
    {
        "scene": setting("scene"),
        **_by_method("energy", ".2f", ("E start", *HALVES)),
        "below NLP": lambda r: f"{1 - r['energy']['solution'] / r['energy']['nlp']:.1%}",
        "gap": number("gap", ".2%"),
        "monotone": lambda r: "yes" if r["monotone"] else "NO",
        **_by_method("mre", ".5f", ("MRE start", *(f"MRE {h}" for h in HALVES))),
        "seconds": number("refine_seconds", ".0f"),
        "GiB": lambda r: " / ".join(f"{gib:.2f}" for gib in r["gib"]),
        "NLP": number("status"),
    },
)

METHODS = {
    "NLP as shipped": None,
    "NLP from 0.1": 0.1,
    "NLP from 1": 1.0,
    "LM from 0.3": 0.3,
    "LM from 1": 1.0,
}
"""First smoothing width by method, pixels; the widths of EPS below it follow."""


def measure_methods(scene: str, superpixels: int, neighbours: int, seed: int, refine: bool) -> Row:
    """Exact energies of every method from one start, before and after refinement."""
    case = prepare(problem_of(scene, superpixels, neighbours, seed))
    solved = [_solved(case, method) for method in METHODS]
    out: Row = {"superpixels": len(case), "before": [energy for _, energy in solved]}
    if refine:
        own = case.problem, case.formulation()
        after = [refined(*own, soup, case.data, case.weights) for soup, _ in solved]
        out["after"] = [r.energy["total"] for r in after]
    return out


def _solved(case: Case, method: str) -> tuple[Soup, float]:
    """Soup and exact energy of a method from the start of the case."""
    own = case.soup, case.data, case.weights, case.formulation()
    first = METHODS[method]
    eps = case.options.presolve_eps if first is None else EPS[EPS.index(first) :]
    if method.startswith("NLP"):
        s = solve_soup(*own, case.options.replace(presolve_eps=eps))
        return s.soup, s.energy["total"]
    r = levenberg_marquardt(*own, eps=eps, iterations=REFERENCE_ITERATIONS)
    return r.soup, r.energy["total"]


def _method(place: int) -> Callable[[Row], str]:
    keys = "before", "after"
    return lambda row: " -> ".join(f"{row[k][place]:.2f}" for k in keys if k in row)


def _to_least(key: str) -> Callable[[Row], str]:
    return lambda row: f"{row[key][0] / min(row[key]):.4f}"


METHODS_UNREFINED = Study(
    "methods_unrefined",
    "Exact energy E by method and first smoothing width (px) from one start. LM: on-manifold"
    " Levenberg-Marquardt. DIS flow, K = {neighbours}.",
    measure_methods,
    {
        "pair, seed": lambda r: f"{r['settings']['scene']}, {r['settings']['seed']}",
        "N": number("superpixels"),
        **{name: _method(k) for k, name in enumerate(METHODS)},
        "shipped / least": _to_least("before"),
    },
)
METHODS_REFINED = replace(
    METHODS_UNREFINED,
    name="methods",
    note=METHODS_UNREFINED.note.replace(
        "one start.", "one start, and what the refinement as shipped makes of it."
    ),
    cells={**METHODS_UNREFINED.cells, "both refined": _to_least("after")},
)

FORMULATION_LIMITS = {"max_iter": 300, "far_iterations": 300, "max_seconds": 240.0}
"""Limits of the solver for every formulation."""


def measure_formulation(
    scene: str, superpixels: int, norm: str, truncation: str, gauge: str
) -> Row:
    """Solve one formulation of the constrained NLP from the answer of the presolve."""
    raw = {
        "input": {"kind": "scene", "scene": scene},
        "segmentation": {"superpixels": superpixels},
        "flow": {"source": "truth"},
    }
    case = prepare(make_problem(raw))
    options = case.options.replace(**FORMULATION_LIMITS)
    form = case.formulation().replace(gauge=gauge, norm=norm, truncation=truncation)
    begin = time.process_time()
    s = solve_soup(case.soup, case.data, case.weights, form, options)
    return {
        "status": s.status.replace("_", " "),
        "presolve": sum(stage.iterations for stage in s.stages[:-1]),
        "nlp": s.stages[-1].iterations,
        "solve_cpu": time.process_time() - begin,
        "energy": s.energy["total"],
        **s.residuals,
    }


FORMULATIONS = Study(
    "formulations",
    "{scene}, true flow, {superpixels} superpixels wanted; constrained NLP to 1e-6 from the same"
    f" presolve, at most {FORMULATION_LIMITS['max_iter']} iterations.",
    measure_formulation,
    {
        **{name: setting(name) for name in ("gauge", "norm", "truncation")},
        "status": number("status"),
        "presolve its": number("presolve"),
        "NLP its": number("nlp"),
        "CPU s": number("solve_cpu", ".1f"),
        "E": number("energy", ".4f"),
        "dual infeasibility": number("dual_infeasibility", ".1e"),
        "SO(3)": number("so3", ".1e"),
        "violation": number("nlp_infeasibility", ".1e"),
        "complementarity": number("complementarity", ".1e"),
    },
)
