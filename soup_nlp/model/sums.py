"""An NLP's sums as numpy arrays: value, gradient, constraints and Hessians of several kinds.

The same numbers by two ways: kernels on vectors of elements (`lanes`) where a C compiler is, else
the NLP's CasADi functions. Ipopt and exports take the functions; the presolve, which evaluates a
hundred times as often, takes these.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple, Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from soup_nlp.model.assemble import Entries, Pattern, hessian_entries, jacobian_entries
from soup_nlp.model.buffered import Buffered
from soup_nlp.model.kernel import Group
from soup_nlp.model.lanes import Lanes, NoLanesError, Summed, compile_lanes, in_lanes, summing
from soup_nlp.model.nlp import NLP

Float = NDArray[np.float64]
Int = NDArray[np.int64]

log = logging.getLogger(__name__)

_NOTHING = np.zeros(0, np.int64), np.zeros(0, np.int64)


class Timer(dict[str, float]):
    """Wall time in what a Sums does, seconds."""

    def __init__(self) -> None:
        super().__init__(dict.fromkeys(("f", "grad_f", "jac_g", "hess_lag"), 0.0))

    @contextmanager
    def of(self, what: str) -> Iterator[None]:
        """Add the time of a `with` block."""
        begin = time.perf_counter()
        yield
        self[what] += time.perf_counter() - begin


class Sums(Protocol):
    """f, g and their derivatives.

    Attributes:
        theta: Values of the NLP's leading parameters; may be set to others.
        jacobian: Of g; its places do not matter.
        upper: Union of the Hessians' upper triangles and of what the caller wants besides, whose
            places are the last.
        seconds: Spent in "f", "grad_f", "jac_g" (with g) and "hess_lag".
    """

    theta: Float
    jacobian: Pattern
    upper: Pattern
    seconds: Timer

    def value(self, x: Float) -> float:
        """f at x (nx,)."""
        ...

    def gradient(self, x: Float) -> Float:
        """Gradient of f (nx,)."""
        ...

    def constraints(self, x: Float) -> tuple[Float, Float]:
        """g (ng,) and the nonzeros of its Jacobian, in the order of `jacobian`."""
        ...

    def hessian(self, kind: str, x: Float, lam_g: Float, lam_f: float = 1.0) -> Float:
        """Nonzeros of the Hessian of `lam_f f + lam_g . g`, in the order of `upper`."""
        ...


def make_sums(
    nlp: NLP,
    hessians: Sequence[str],
    besides: tuple[Int, Int] | None = None,
    first_order: bool = True,
) -> Sums:
    """The sums of an NLP by the fastest way there is.

    Args:
        nlp: The NLP.
        hessians: Kinds of Hessian (kernel.HESSIANS); not empty.
        besides: Rows and columns of further nonzeros of the upper triangle.
        first_order: False where Hessians alone are wanted.
    """
    if nlp.compiled:
        try:
            return LaneSums(nlp, hessians, besides, first_order)
        except NoLanesError as error:
            log.info("no machine code on vectors: %s", error)
    return FunctionSums(nlp, hessians, besides)


class FunctionSums:
    """Sums by the NLP's CasADi functions."""

    def __init__(
        self, nlp: NLP, hessians: Sequence[str], besides: tuple[Int, Int] | None = None
    ) -> None:
        """Assemble them; arguments as of `make_sums`."""
        self.theta, self.seconds = nlp.p[: len(nlp.theta)], Timer()
        functions = {
            kind: nlp.hess_lag if kind == nlp.hessian else nlp.other_hessian(kind)
            for kind in hessians
        }
        self._p = nlp.p.copy()
        x, p = nlp.oracle.mx_in()
        self._f = Buffered(ca.Function("f", [x, p], [nlp.oracle(x, p)[0]]))
        self._gradient, self._rows = Buffered(nlp.grad_f), Buffered(nlp.jac_g)
        self._hessian = {kind: Buffered(h) for kind, h in functions.items()}
        self.jacobian = Pattern.of((nlp.ng, nlp.nx), [_entries(nlp.jac_g.sparsity_out(1))])
        own = [_entries(h.sparsity_out(0)) for h in functions.values()]
        self.upper = Pattern.of((nlp.nx, nlp.nx), [*own, Entries(*(besides or _NOTHING))])
        self._places = dict(zip(functions, self.upper.places))

    def _parameters(self) -> Float:
        self._p[: len(self.theta)] = self.theta
        return self._p

    def value(self, x: Float) -> float:
        """See Sums."""
        with self.seconds.of("f"):
            return float(self._f(x, self._parameters())[0][0])

    def gradient(self, x: Float) -> Float:
        """See Sums."""
        with self.seconds.of("grad_f"):
            return self._gradient(x, self._parameters())[1].copy()

    def constraints(self, x: Float) -> tuple[Float, Float]:
        """See Sums."""
        with self.seconds.of("jac_g"):
            g, jacobian = self._rows(x, self._parameters())
            return g.copy(), jacobian.copy()

    def hessian(self, kind: str, x: Float, lam_g: Float, lam_f: float = 1.0) -> Float:
        """See Sums."""
        with self.seconds.of("hess_lag"):
            out = np.zeros(len(self.upper.rows))
            out[self._places[kind]] = self._hessian[kind](x, self._parameters(), lam_f, lam_g)[0]
            return out


class LaneSums:
    """Sums by kernels on vectors of elements."""

    def __init__(
        self,
        nlp: NLP,
        hessians: Sequence[str],
        besides: tuple[Int, Int] | None = None,
        first_order: bool = True,
    ) -> None:
        """Compile them or take them from the cache.

        Args:
            nlp: See `make_sums`.
            hessians: See `make_sums`.
            besides: See `make_sums`.
            first_order: See `make_sums`.

        Raises:
            NoLanesError: That is not possible here.
        """
        self.theta, self.seconds = nlp.p[: len(nlp.theta)], Timer()
        self._sizes = nlp.nx, nlp.ng, len(nlp.theta)
        nx, ng = nlp.nx, nlp.ng
        made: list[dict[str, ca.Function]] = []
        for group in nlp.groups:
            functions = group.kernel.first_order() if first_order else {}
            for k, kind in enumerate(hessians):
                hessian = group.kernel.second_order(kind, str(k))
                functions |= {kind: hessian} if hessian else {}
            made.append(functions)
        unions = [
            _union(group, [k for k in hessians if k in functions])
            for group, functions in zip(nlp.groups, made)
        ]
        with_rows = [g for g, functions in zip(nlp.groups, made) if "jac" in functions]
        self.jacobian = Pattern.of((ng, nx), [jacobian_entries(g) for g in with_rows])
        if list(hessians) == [nlp.hessian] and besides is None:
            self.upper = nlp.hessian_pattern
        else:
            every = [u.entries for u in unions]
            self.upper = Pattern.of((nx, nx), [*every, Entries(*(besides or _NOTHING))])
        jacobian_places = iter(self.jacobian.places)
        self._terms: dict[str, list[Summed]] = {}
        for group, functions, union, upper in zip(nlp.groups, made, unions, self.upper.places):
            # a library for every kernel, so that another of one leaves the others in the cache
            library = compile_lanes(list(functions.values()))
            table, size = group.table, group.size
            lanes = Lanes.of(table)
            place = {"f": np.zeros((size, 1)), "grad": table.index, "con": table.rows}
            if "jac" in functions:
                place["jac"] = next(jacobian_places).reshape(size, -1)
            for kind, which in union.parts.items():
                place[kind] = upper.reshape(size, -1)[:, which]
            for key, function in functions.items():
                where = in_lanes(place[key], np.int32, fill=self._size(key))
                term = Summed(summing(library, function), lanes, where)
                self._terms.setdefault(key, []).append(term)

    def _size(self, key: str) -> int:
        nx, ng, _ = self._sizes
        sizes = {"f": 1, "grad": nx, "con": ng, "jac": len(self.jacobian.rows)}
        return sizes.get(key, len(self.upper.rows))

    def _sum(self, key: str, x: Float, lam_g: Float | None = None, lam_f: float = 1.0) -> Float:
        nx, ng, thetas = self._sizes
        x, lam = _vector("x", x, nx), lam_g if lam_g is None else _vector("lam_g", lam_g, ng)
        theta = _vector("theta", self.theta, thetas)
        # one entry more, for what fills the last block
        out = np.zeros(self._size(key) + 1)
        for term in self._terms.get(key, []):
            term.add(out, x, theta, lam_f, lam)
        return out[:-1]

    def value(self, x: Float) -> float:
        """See Sums."""
        with self.seconds.of("f"):
            return float(self._sum("f", x)[0])

    def gradient(self, x: Float) -> Float:
        """See Sums."""
        with self.seconds.of("grad_f"):
            return self._sum("grad", x)

    def constraints(self, x: Float) -> tuple[Float, Float]:
        """See Sums."""
        with self.seconds.of("jac_g"):
            return self._sum("con", x), self._sum("jac", x)

    def hessian(self, kind: str, x: Float, lam_g: Float, lam_f: float = 1.0) -> Float:
        """See Sums."""
        with self.seconds.of("hess_lag"):
            return self._sum(kind, x, lam_g, lam_f)


def _vector(name: str, values: Float, size: int) -> Float:
    """What C may read; machine code sees no lengths.

    Raises:
        ValueError: Another length.
    """
    if len(values) != size:
        raise ValueError(f"{name} has {len(values)} entries, expected {size}")
    return np.ascontiguousarray(values, dtype=float)


class _Union(NamedTuple):
    """Nonzeros of an element's Hessians of several kinds.

    Attributes:
        entries: Where they stand, k an element.
        parts: Which of the k are in each kind, in its storage order.
    """

    entries: Entries
    parts: dict[str, NDArray[np.integer]]


def _union(group: Group, kinds: Sequence[str]) -> _Union:
    local = [group.kernel.hessian_pattern(kind) for kind in kinds]
    if not local:
        none = np.zeros((group.size, 0), np.int64)
        return _Union(Entries(none, none), {})
    union = Pattern.of((group.kernel.nx, group.kernel.nx), [Entries(*own) for own in local])
    entries = hessian_entries(group, (union.rows, union.columns))
    return _Union(entries, dict(zip(kinds, union.places)))


def _entries(pattern: ca.Sparsity) -> Entries:
    row, column = pattern.get_triplet()
    return Entries(np.asarray(row, np.int64), np.asarray(column, np.int64))
