"""Superpixel Soup as a nonlinear program: dense 3D of a dynamic scene from two frames."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

# the room first: a later import of it would take the place of the function of the same name
import soup_nlp.evaluate  # noqa: F401

if TYPE_CHECKING:
    from pathlib import Path

    from soup_nlp.arrays import Float, Mask
    from soup_nlp.batches.run import batch
    from soup_nlp.config.problem import Problem, load_problem, make_problem
    from soup_nlp.data.pair import Flow, Pair, Truth
    from soup_nlp.errors import SoupError
    from soup_nlp.evaluate.metrics import DepthMetrics, Scale
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
    "load": "sequence.folder",
    "load_problem": "config.problem",
    "make_problem": "config.problem",
    "nlp": "export.symbolic",
    "run": "report.folder",
    "solve_pair": "report.folder",
}
"""Module of every public name, and its name there if it is another one; imported on first use."""


def evaluate(
    result: object,
    depth: str | Path | Float,
    *,
    scale: Scale = "median",
    cap: float | None = None,
    depth_scale: float | None = None,
    moving: str | Path | Mask | None = None,
) -> dict[str, DepthMetrics]:
    """Score a depth against the truth.

    Args:
        result: Result folder, `Run`, stored result, or depth of the reference frame (H, W).
        depth: True depth of the reference frame (H, W), or a file: .dpt, .npy, .pfm, 16-bit .png.
        scale: "median", "mre", "lsq", "affine" (scale and shift) or "none".
        cap: Truth beyond this depth is dropped, positive.
        depth_scale: Values per unit of length of a .png; None for 1000, with a warning.
        moving: (H, W) True where something moves by itself, or a picture that is not black there:
            "static" and "moving" are then scored by themselves, at the scale of all pixels.

    Returns:
        Metrics by "solution", "start", "nlp" and "rigid" (if known) and "constant".

    Raises:
        DataError: the cap is not positive, a file is missing, sizes differ, or the truth has no
            pixel.
    """
    from soup_nlp.evaluate import scoring

    return scoring.evaluate(
        result, depth, scale=scale, cap=cap, depth_scale=depth_scale, moving=moving
    )


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
