"""Superpixel Soup as a nonlinear program: dense 3D of a dynamic scene from two frames."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from soup_nlp.batches.run import batch as batch
    from soup_nlp.config.problem import Problem as Problem
    from soup_nlp.config.problem import load_problem as load_problem
    from soup_nlp.config.problem import make_problem as make_problem
    from soup_nlp.data.pair import Flow as Flow
    from soup_nlp.data.pair import Pair as Pair
    from soup_nlp.data.pair import Truth as Truth
    from soup_nlp.errors import SoupError as SoupError
    from soup_nlp.evaluation.scoring import evaluate as evaluate
    from soup_nlp.export.symbolic import nlp as nlp
    from soup_nlp.geometry.constraints import constraints as constraints
    from soup_nlp.geometry.soup import Reconstruction as Reconstruction
    from soup_nlp.geometry.soup import Soup as Soup
    from soup_nlp.report.folder import WritableRun
    from soup_nlp.report.folder import run as run
    from soup_nlp.report.folder import solve_pair as solve_pair
    from soup_nlp.report.result import Result as Result
    from soup_nlp.sequence.folder import load as load
    from soup_nlp.sequence.solve import solve_chain
    from soup_nlp.storage.versions import __version__ as __version__

    Run = WritableRun
    chain = solve_chain

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

__all__ = sorted(_HOMES)


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
    return __all__
