"""Superpixel Soup as a nonlinear program: dense 3D of a dynamic scene from two frames."""

from soup_nlp.config.problem import Problem, load_problem, make_problem
from soup_nlp.data.pair import Flow, Pair, Truth
from soup_nlp.errors import SoupError
from soup_nlp.evaluate.scoring import evaluate
from soup_nlp.geometry.soup import Reconstruction, Soup
from soup_nlp.pipeline import Run, run, solve_pair
from soup_nlp.storage.versions import __version__

__all__ = [
    "Flow",
    "Pair",
    "Problem",
    "Reconstruction",
    "Run",
    "Soup",
    "SoupError",
    "Truth",
    "__version__",
    "evaluate",
    "load_problem",
    "make_problem",
    "run",
    "solve_pair",
]
