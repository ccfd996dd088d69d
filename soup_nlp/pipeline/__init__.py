"""From a problem to a run: prepare, solve, refine, evaluate."""

from soup_nlp.pipeline.case import prepare
from soup_nlp.pipeline.record import Case, Run
from soup_nlp.pipeline.run import make_run, run, solve_pair

__all__ = ["Case", "Run", "make_run", "prepare", "run", "solve_pair"]
