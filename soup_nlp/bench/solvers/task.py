"""Task and answer of a solver, and the trace of its iterates."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.export.verify import Limits
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.layout import MatrixLayout, TangentLayout
from soup_nlp.model.matrix import build_matrix_nlp
from soup_nlp.model.nlp import NLP
from soup_nlp.model.tangent_nlp import build_tangent_nlp


@dataclass(frozen=True)
class Task:
    """An NLP for a solver.

    Attributes:
        nlp: The NLP with the exact Hessian.
        gauss_newton: The same NLP with the Gauss-Newton Hessian.
        layout: Layout of both.
        soup: Start.
        data, weights, form: Energy and formulation, for the reference solver, which takes no NLP.
        limits: Limits of time, iterations, tolerance and memory.
        folder: Scratch folder of the run.
    """

    nlp: NLP
    gauss_newton: NLP
    layout: MatrixLayout | TangentLayout
    soup: Soup
    data: EnergyData
    weights: Weights
    form: Formulation
    limits: Limits
    folder: Path

    def point(self, soup: Soup) -> Float:
        """(nx,) vector of a soup, slack variables and switches at their best values."""
        energy = soup, self.data, self.weights, self.form
        if isinstance(self.layout, TangentLayout):
            nlp, _ = build_tangent_nlp(*energy, layout=self.layout)
        else:
            nlp, _ = build_matrix_nlp(*energy)
        return np.concatenate([self.layout.pack(soup), nlp.x0[self.layout.size :]])


@dataclass(frozen=True)
class Answer:
    """The answer of a solver.

    Attributes:
        x: (nx,) point, or None if the solver returned none.
        lam_g: (ng,) multipliers, or None.
        status: Status text of the solver.
        claimed: Whether the solver claims an optimum.
        iterations: Outer iterations, -1 if unknown.
        seconds: CPU time of set-up and solve.
        curve: (k, 2) seconds and exact energy, from solvers that record it themselves.
    """

    x: Float | None
    lam_g: Float | None
    status: str
    claimed: bool
    iterations: int
    seconds: float
    curve: Float | None = None


def clock() -> float:
    """CPU seconds of this process and of its children that have ended.

    Limits and comparisons use CPU time, since wall time depends on other work of the machine.
    """
    return sum(os.times()[:4])


WALL_PER_CPU = 8.0
"""Limit of the wall time relative to that of the CPU time: other work may slow a run down, and a
program that waits uses no CPU time."""
Solver = Callable[[Task], Answer]


@dataclass
class Trace:
    """File of the iterates of a solver, written at once so that it survives a killed solver.

    Args:
        path: File of float64 records (seconds, x).
        nx: Number of variables.
    """

    path: Path
    nx: int
    begin: float = field(default_factory=clock)

    def add(self, x: Float) -> None:
        """Append an iterate with the time since the trace began."""
        record = np.concatenate([[clock() - self.begin], np.asarray(x, float).ravel()])
        with self.path.open("ab") as file:
            file.write(record.tobytes())

    def read(self) -> tuple[Float, Float]:
        """(k,) seconds and (k, nx) iterates, without an incomplete last record."""
        flat = np.fromfile(self.path) if self.path.is_file() else np.zeros(0)
        width = self.nx + 1
        records = flat[: len(flat) // width * width].reshape(-1, width)
        return records[:, 0], records[:, 1:]
