"""Solves whose numbers do not matter."""

import pytest

from soup_nlp.cli import solve
from soup_nlp.config.problem import Problem
from soup_nlp.pipeline.record import Run


@pytest.fixture(scope="module")
def solves_once():
    """The command solves every problem of a module once; it writes a folder every time."""
    known: dict[tuple, Run] = {}
    run = solve.run_problem

    def run_once(problem: Problem, **rest: object) -> Run:
        key = problem.digest(), *problem.input_paths()
        known[key] = known.get(key) or run(problem, **rest)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(solve, "run_problem", run_once)
        yield
