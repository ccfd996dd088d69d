"""Making of the records of a new version of the family by segmentation, proposal and solve."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from soup_nlp.config.problem import Problem, dump_problem, make_problem
from soup_nlp.family.frozen import Frozen, encoded, save_frozen
from soup_nlp.family.instances import case_of, rounded
from soup_nlp.model.layout import MatrixLayout
from soup_nlp.pipeline.case import Case, prepare
from soup_nlp.solve.stages import solve_soup
from soup_nlp.storage.progress import Watch


def family_problem(scene: str, size: int) -> Problem:
    """The problem of a rendered scene and size with true flow and default options."""
    source = {"kind": "scene", "scene": scene, "seed": 0, "width": 1024, "height": 436}
    return make_problem(
        {
            "name": scene,
            "input": source,
            "segmentation": {"superpixels": size},
            "flow": {"source": "truth"},
            # 0.2 pixels where surfaces bend, as in the records of all sizes, see `case_of`
            "energy": {"weights": {"prior": 0.0015}} if scene == "sheet" else {},
            "solver": {"presolve_tol": 1e-8, "tol": 1e-8, "max_iter": 60},
        }
    )


def freeze(scene: str, size: int, path: Path, say: Callable[[str], None]) -> None:
    """Segment, propose and solve a scene at a size, and write its record."""
    problem = family_problem(scene, size)
    proposed = record_of(prepare(problem, log=say))
    # solve the numbers of the record, which are rounded
    case = case_of(proposed)
    own = case.data, case.weights, case.formulation(), case.options
    solution = solve_soup(case.soup, *own, watch=Watch(say=say))
    say(str(solution))
    # Ipopt's answer, a minimum of the smoothed energy, even where the proposal is delivered, whose
    # exact energy may be lower with true flow
    answer = MatrixLayout(case.data.share, case.formulation().gauge).unpack(solution.stages[-1].x)
    save_frozen(path, replace(proposed, minimum=encoded(answer.retracted())))


def record_of(case: Case) -> Frozen:
    """The record of a case with the proposal as best known point."""
    start = case.start
    proposal = encoded(start.soup).astype(np.float32).astype(float)
    return Frozen(
        text=dump_problem(case.problem),
        labels=case.segmentation.labels,
        component=start.component,
        surface=start.surface,
        error=start.error.astype(np.float32).astype(float),
        bending=start.bending,
        pair_weight=case.segmentation.pair_weight,
        prior_weight=rounded(case.data.prior_weight),
        proposal=proposal,
        minimum=proposal,
    )
