"""An NLP's sums as numpy arrays: value, gradient, constraints and Hessians of several kinds.

Every kernel is summed over its table: by vectorised machine code (`lanes`) where a C compiler is
found, else by numpy (`vectors`). The presolve and Ipopt take these; the exports take the functions
of `assemble`, which are CasADi's.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.model.assemble import Entries, Pattern
from soup_nlp.model.blocks import Elements, pattern_of
from soup_nlp.model.kernel import Group, Table
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
        upper: Union of the Hessians' upper triangles and of what the caller wants besides, whose
            places are the last.
        seconds: Spent in "f", "grad_f", "jac_g" (with g) and "hess_lag".
        vectorised: Whether machine code on vectors of elements does all of it.
    """

    def __init__(
        self,
        nlp: NLP,
        hessians: Sequence[str],
        besides: Elements | None = None,
        first_order: bool = True,
    ) -> None:
        """Compile the kernels, or take them from the cache.

        Args:
            nlp: The NLP.
            hessians: Kinds of Hessian (kernel.HESSIANS).
            besides: Elements with further nonzeros.
            first_order: False where Hessians alone are wanted.
        """
        self.theta, self.seconds = nlp.thetas(), Timer()
        self._sizes = nlp.nx, nlp.ng, len(nlp.theta)
        made: list[dict[str, ca.Function]] = []
        for group in nlp.groups:
            functions = dict(group.kernel.first_order()) if first_order else {}
            for k, kind in enumerate(hessians):
                hessian = group.kernel.second_order(kind, str(k))
                functions |= {kind: hessian} if hessian else {}
            made.append(functions)
        unions = [
            _union(group, [k for k in hessians if k in functions])
            for group, functions in zip(nlp.groups, made)
        ]
        self.jacobian = nlp.jacobian_pattern
        if list(hessians) == [nlp.hessian] and besides is None:
            self.upper = nlp.hessian_pattern
        else:
            every = [u.elements for u in unions]
            self.upper = pattern_of(nlp.nx, every if besides is None else [*every, besides])
        jacobian_places = iter(self.jacobian.places)
        self._terms: dict[str, list[Summed | Vectors | Mapped]] = {}
        self._some: dict[str, list[Summed]] = {}
        self._kept: Int | None = None
        self.vectorised = nlp.compiled
        for group, functions, union, upper in zip(nlp.groups, made, unions, self.upper.places):
            size = group.size
            place = {
                "f": np.zeros((size, 1), int),
                "grad": group.table.index,
                "con": group.table.rows,
            }
            if "jac" in functions:
                place["jac"] = next(jacobian_places).reshape(size, -1)
            for kind, which in union.parts.items():
                place[kind] = upper.reshape(size, -1)[:, which]
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

    def only(self, some: Mask | None, kept: Int | None = None) -> None:
        """Sum f, its gradient and Hessians only over the elements that some variables are in.

        Without machine code they are still summed over all elements.

        Args:
            some: (nx,) these variables; None for all.
            kept: The nonzeros of Hessians that are returned; None for all.
        """
        self._some, self._kept = {}, kept
        if some is None or not self.vectorised:
            return
        new = np.arange(len(self.upper.rows) + 1, dtype=np.int32)
        if kept is not None:
            new[:] = len(kept)
            new[kept] = np.arange(len(kept))
        # the functions of a kernel share its table; what fills the last block remains dropped
        taken: dict[int, tuple[Int, Lanes]] = {}
        for key in self._terms.keys() - {"con", "jac"}:
            self._some[key] = []
            for term in self._terms[key]:
                assert isinstance(term, Summed)
                whole = term.lanes
                if id(whole) not in taken:
                    blocks = whole.touched(some)
                    taken[id(whole)] = blocks, whole.taken(blocks)
                blocks, lanes = taken[id(whole)]
                place = term.place[blocks]
                place = place if key in ("f", "grad") else new[place]
                self._some[key].append(Summed(term.call, lanes, place))

    def _size(self, key: str) -> int:
        nx, ng, _ = self._sizes
        sizes = {"f": 1, "grad": nx, "con": ng, "jac": len(self.jacobian.rows)}
        kept = self._kept if key in self._some else None
        return sizes.get(key, len(self.upper.rows if kept is None else kept))

    def _sum(self, key: str, x: Float, lam_g: Float | None = None, lam_f: float = 1.0) -> Float:
        nx, ng, thetas = self._sizes
        x, lam = _vector("x", x, nx), lam_g if lam_g is None else _vector("lam_g", lam_g, ng)
        theta = _vector("theta", self.theta, thetas)
        # one entry more, for what fills the last block of lanes
        out = np.zeros(self._size(key) + 1)
        for term in self._some[key] if key in self._some else self._terms.get(key, []):
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

    def hessian(self, kind: str, x: Float, lam_g: Float, lam_f: float = 1.0) -> Float:
        """Nonzeros of the Hessian of `lam_f f + lam_g . g`, in the order of `upper`."""
        with self.seconds.of("hess_lag"):
            out = self._sum(kind, x, lam_g, lam_f)
            return out if self._kept is None or kind in self._some else out[self._kept]


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


class _Union(NamedTuple):
    """Nonzeros of an element's Hessians of several kinds.

    Attributes:
        elements: The elements with k nonzeros each.
        parts: Which of the k are in each kind, in its storage order.
    """

    elements: Elements
    parts: dict[str, NDArray[np.integer]]


def _union(group: Group, kinds: Sequence[str]) -> _Union:
    local = [group.kernel.hessian_pattern(kind) for kind in kinds]
    union = Pattern.of((group.kernel.nx, group.kernel.nx), [Entries(*own) for own in local])
    elements = Elements(group.table.index, union.rows, union.columns)
    return _Union(elements, dict(zip(kinds, union.places)))
