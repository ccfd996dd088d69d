"""Superpixel Soup as a nonlinear program: dense 3D of a dynamic scene from two frames."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from soup_nlp.batches.run import batch
    from soup_nlp.config.problem import Problem, load_problem, make_problem
    from soup_nlp.data.pair import Flow, Pair, Truth
    from soup_nlp.errors import SoupError
    from soup_nlp.evaluation.scoring import evaluate
    from soup_nlp.export.symbolic import nlp
    from soup_nlp.geometry.constraints import constraints
    from soup_nlp.geometry.soup import Reconstruction, Soup
    from soup_nlp.report.folder import WritableRun as Run
    from soup_nlp.report.folder import run, solve_pair
    from soup_nlp.report.result import Result
    from soup_nlp.sequence.folder import load
    from soup_nlp.sequence.solve import solve_chain as chain
    from soup_nlp.storage.versions import __version__

__all__ = [
    "Flow",
    "Pair",
    "Problem",
    "Reconstruction",
    "Result",
    "Run",
    "Soup",
    "SoupError",
    "Truth",
    "__version__",
    "batch",
    "chain",
    "constraints",
    "evaluate",
    "load",
    "load_problem",
    "make_problem",
    "nlp",
    "run",
    "solve_pair",
]

_HOMES = {
    "Flow": "data.pair",
    "Pair": "data.pair",
    "Problem": "config.problem",
    "Reconstruction": "geometry.soup",
    "Result": "report.result",
    "Run": "report.folder:WritableRun",
    "Soup": "geometry.soup",
    "SoupError": "errors",
    "Truth": "data.pair",
    "__version__": "storage.versions",
    "batch": "batches.run",
    "chain": "sequence.solve:solve_chain",
    "constraints": "geometry.constraints",
    "evaluate": "evaluation.scoring",
    "load": "sequence.folder",
    "load_problem": "config.problem",
    "make_problem": "config.problem",
    "nlp": "export.symbolic",
    "run": "report.folder",
    "solve_pair": "report.folder",
}
"""Module of every public name, and its name there if it is another one; imported on first use."""


def __getattr__(name: str) -> Any:
    """A public name, from its module."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home, _, attribute = _HOMES[name].partition(":")
    value = getattr(import_module(f"{__name__}.{home}"), attribute or name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The public names."""
    return sorted(__all__)
