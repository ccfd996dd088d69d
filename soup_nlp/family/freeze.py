"""Makes the records of a new version of the family: the part that searches and iterates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from soup_nlp.config.problem import Problem, dump_problem, make_problem
from soup_nlp.family.frozen import Frozen, encoded, save_frozen
from soup_nlp.family.instances import case_of
from soup_nlp.pipeline.case import Case, prepare
from soup_nlp.solve.stages import solve_soup


def family_problem(scene: str, size: int) -> Problem:
    """The problem of a scene and size: rendered, true flow, the defaults of the package."""
    source = {"kind": "scene", "scene": scene, "seed": 0, "width": 1024, "height": 436}
    return make_problem(
        {
            "name": scene,
            "input": source,
            "segmentation": {"superpixels": size},
            "flow": {"source": "truth"},
            "solver": {"presolve_tol": 1e-8, "tol": 1e-8, "max_iter": 60},
        }
    )


def freeze(scene: str, size: int, path: Path, say: Callable[[str], None]) -> None:
    """Segment, propose and solve a scene at a size, and write its record."""
    problem = family_problem(scene, size)
    proposed = record_of(prepare(problem, log=say))
    # the minimum of the numbers that the record leads to
    case = case_of(proposed)
    own = case.data, case.weights, case.formulation(), case.options
    answer = solve_soup(case.soup, *own, say=say)
    say(str(answer))
    save_frozen(path, replace(proposed, minimum=encoded(answer.soup)))


def record_of(case: Case) -> Frozen:
    """The record of a case whose best known point is still the proposal."""
    start = case.start
    proposal = encoded(start.soup).astype(np.float32).astype(float)
    return Frozen(
        text=dump_problem(case.problem),
        labels=case.segmentation.labels,
        component=start.component,
        surface=start.surface,
        error=start.error.astype(np.float32).astype(float),
        bending=start.bending,
        proposal=proposal,
        minimum=proposal,
    )
