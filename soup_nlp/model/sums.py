"""An NLP's sums as numpy arrays: value, gradient, constraints and Hessian.

Every kernel is summed over its table: by vectorised machine code (`lanes`) where a C compiler is
found, else by numpy (`vectors`). Ipopt calls these; the exports take the functions of `assemble`,
which are CasADi's.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float
from soup_nlp.model.kernel import Table
from soup_nlp.model.lanes import Lanes, NoLanesError, Summed, compile_lanes
from soup_nlp.model.mapped import Mapped
from soup_nlp.model.vectors import Vectors

if TYPE_CHECKING:
    from soup_nlp.model.nlp import NLP

log = logging.getLogger(__name__)


class Timer(dict[str, float]):
    """Wall time spent in a Sums, seconds."""

    def __init__(self) -> None:
        super().__init__(dict.fromkeys(("f", "grad_f", "jac_g", "hess_lag"), 0.0))

    @contextmanager
    def of(self, what: str) -> Iterator[None]:
        """Add the time of a `with` block."""
        begin = time.perf_counter()
        yield
        self[what] += time.perf_counter() - begin


class Sums:
    """f, g and their derivatives.

    Attributes:
        theta: Values of the NLP's leading parameters; may be set to others.
        jacobian: Pattern of g's Jacobian.
        seconds: Spent in "f", "grad_f", "jac_g" (with g) and "hess_lag".
        vectorised: Whether machine code on vectors of elements does all of it.
    """

    def __init__(self, nlp: NLP, first_order: bool = True, second_order: bool = False) -> None:
        """Compile the kernels, or take them from the cache.

        Args:
            nlp: The NLP.
            first_order: With f, g and their first derivatives.
            second_order: With the Hessian of the NLP's kind.
        """
        self.theta, self.seconds = nlp.thetas(), Timer()
        self._nonzeros = len(nlp.hessian_pattern.rows) if second_order else 0
        self._sizes = nlp.nx, nlp.ng, len(nlp.theta)
        self.jacobian = nlp.jacobian_pattern
        jacobian_places = iter(self.jacobian.places)
        hessian_places = iter(nlp.hessian_pattern.places if second_order else ())
        self._terms: dict[str, list[Summed | Vectors | Mapped]] = {}
        self.vectorised = nlp.compiled
        for group in nlp.groups:
            functions = dict(group.kernel.first_order()) if first_order else {}
            size = group.size
            place = {
                "f": np.zeros((size, 1), int),
                "grad": group.table.index,
                "con": group.table.rows,
            }
            if "jac" in functions:
                place["jac"] = next(jacobian_places).reshape(size, -1)
            if second_order:
                hessian, upper = group.kernel.second_order(nlp.hessian), next(hessian_places)
                if hessian:
                    functions["hess"], place["hess"] = hessian, upper.reshape(size, -1)
            for key, term in self._summed(group.table, functions, place).items():
                self._terms.setdefault(key, []).append(term)

    def _summed(
        self, table: Table, functions: dict[str, ca.Function], place: dict[str, NDArray[np.integer]]
    ) -> dict[str, Summed | Vectors | Mapped]:
        """Functions of one kernel over its table, by the fastest way there is.

        Args:
            table: The kernel's table.
            functions: By key.
            place: (E, entries) where each entry is added.
        """
        if self.vectorised:
            try:
                # one library per kernel: the cache then still holds the kernels that did not change
                library = compile_lanes(list(functions.values()))
                lanes = Lanes.of(table)
                return {
                    key: Summed.of(library, f, lanes, place[key], self._size(key))
                    for key, f in functions.items()
                }
            except NoLanesError as error:
                self.vectorised = False
                log.info(
                    "no machine code on vectors: %s; kernels run in numpy, and a solve takes about"
                    " a quarter longer (a C compiler on the PATH, gcc or clang, is used)",
                    error,
                )
        return {key: interpreted(f, table, place[key]) for key, f in functions.items()}

    def _size(self, key: str) -> int:
        nx, ng, _ = self._sizes
        sizes = {"f": 1, "grad": nx, "con": ng, "jac": len(self.jacobian.rows)}
        return sizes.get(key, self._nonzeros)

    def _sum(self, key: str, x: Float, lam_g: Float | None = None, lam_f: float = 1.0) -> Float:
        nx, ng, thetas = self._sizes
        x, lam = _vector("x", x, nx), lam_g if lam_g is None else _vector("lam_g", lam_g, ng)
        theta = _vector("theta", self.theta, thetas)
        # one entry more, for what fills the last block of lanes
        out = np.zeros(self._size(key) + 1)
        for term in self._terms.get(key, []):
            term.add(out, x, theta, lam_f, lam)
        return out[:-1]

    def value(self, x: Float) -> float:
        """f at x (nx,)."""
        with self.seconds.of("f"):
            return float(self._sum("f", x)[0])

    def gradient(self, x: Float) -> Float:
        """Gradient of f (nx,)."""
        with self.seconds.of("grad_f"):
            return self._sum("grad", x)

    def constraints(self, x: Float) -> tuple[Float, Float]:
        """g (ng,) and the nonzeros of its Jacobian, in the order of `jacobian`."""
        with self.seconds.of("jac_g"):
            return self._sum("con", x), self._sum("jac", x)

    def hessian(self, x: Float, lam_g: Float, lam_f: float = 1.0) -> Float:
        """Nonzeros of the Hessian of `lam_f f + lam_g . g`, as in `nlp.hessian_pattern`."""
        with self.seconds.of("hess_lag"):
            return self._sum("hess", x, lam_g, lam_f)


def interpreted(
    function: ca.Function, table: Table, place: NDArray[np.integer]
) -> Vectors | Mapped:
    """A function over a table without a compiler: in numpy, or else in CasADi."""
    try:
        return Vectors(function, table, place)
    except NoLanesError:
        return Mapped(function, table, place)


def _vector(name: str, values: Float, size: int) -> Float:
    """A contiguous vector whose length is checked, since machine code does not see lengths.

    Raises:
        ValueError: Another length.
    """
    if len(values) != size:
        raise ValueError(f"{name} has {len(values)} entries, expected {size}")
    return np.ascontiguousarray(values, dtype=float)
