"""The task that a solver gets, and the answer that it returns."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from soup_nlp.export.verify import Limits
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.layout import MatrixLayout
from soup_nlp.model.nlp import NLP

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Task:
    """One NLP for one solver.

    Attributes:
        nlp: With the exact Hessian.
        gauss_newton: The same NLP with the Gauss-Newton Hessian.
        layout: Of both.
        soup: Start.
        data, weights, form: Of the energy (for the reference solver, which takes no NLP).
        limits: Time, iterations, tolerance, memory.
        folder: Scratch folder of this run.
    """

    nlp: NLP
    gauss_newton: NLP
    layout: MatrixLayout
    soup: Soup
    data: EnergyData
    weights: Weights
    form: Formulation
    limits: Limits
    folder: Path


@dataclass(frozen=True)
class Answer:
    """The answer of a solver.

    Attributes:
        x: (nx,) point, or None where it returned none.
        lam_g: (ng,) multipliers, or None.
        status: In the words of the solver.
        claimed: It claims an optimum.
        iterations: Outer iterations, -1 where it does not say.
        seconds: CPU time of set-up and solve.
        curve: (k, 2) seconds and exact energy, of solvers that record it themselves.
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

    Runs are limited and compared by it: wall time is that of the machine's other work as well.
    """
    return sum(os.times()[:4])


WALL = 20.0
"""Wall seconds that a CPU second may take before a run is ended: other work may be on the machine,
and a program that waits uses none."""
Solver = Callable[[Task], Answer]


@dataclass
class Trace:
    """Iterates as they happen, on disk, so that a killed solver leaves them behind.

    Args:
        path: File of float64 records (seconds, x).
        nx: Variables.
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
        """(k,) seconds and (k, nx) iterates; a record cut short is left out."""
        flat = np.fromfile(self.path) if self.path.is_file() else np.zeros(0)
        width = self.nx + 1
        records = flat[: len(flat) // width * width].reshape(-1, width)
        return records[:, 0], records[:, 1:]
