"""The NLP record: kernels, tables, bounds; its functions are made when first asked for."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Self

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from soup_nlp.arrays import Float
from soup_nlp.errors import ModelError
from soup_nlp.model.kernel import Group, Hessian, Pattern, hessian_entries, jacobian_entries
from soup_nlp.model.operations import Vectors

Terms = tuple[int, list[Vectors], NDArray[np.integer]]
"""Size of a vector, functions of kernels over their tables, and where it adds up their entries."""


@dataclass(frozen=True)
class NLP:
    """min f(x, p) subject to lbg <= g(x, p) <= ubg, lbx <= x <= ubx.

    Attributes:
        name: For reports.
        groups: Kernels and tables that f and g are the sums of, none of them empty.
        x0, lbx, ubx: (nx,) start and bounds.
        lbg, ubg: (ng,) constraint bounds.
        theta: Values of the parameters that all kernels share, by name in the kernels' order.
        hessian_kind: Kind of the Hessian (kernel.HESSIANS).
        x_names, g_names: Functions that make the readable names, on demand.
    """

    name: str
    groups: tuple[Group, ...]
    x0: Float
    lbx: Float
    ubx: Float
    lbg: Float
    ubg: Float
    theta: Mapping[str, float]
    hessian_kind: Hessian
    x_names: Callable[[], list[str]]
    g_names: Callable[[], list[str]]

    # --- numbers: what Ipopt and all reports are computed with ---

    def value(self, x: Float, theta: Float | None = None) -> float:
        """f at x (nx,); theta (nt,) of another smoothing."""
        return float(self._sum(self._first["f"], x, theta)[0])

    def gradient(self, x: Float, theta: Float | None = None) -> Float:
        """Gradient of f (nx,)."""
        return self._sum(self._first["grad"], x, theta)

    def constraints(self, x: Float, theta: Float | None = None) -> Float:
        """g (ng,)."""
        return self._sum(self._first["con"], x, theta)

    def jacobian_nonzeros(self, x: Float, theta: Float | None = None) -> Float:
        """Nonzeros of g's Jacobian, in the order of `jacobian_pattern`."""
        return self._sum(self._first["jac"], x, theta)

    def jacobian(self, x: Float) -> sparse.csr_matrix:
        """(ng, nx) Jacobian of g."""
        return self.jacobian_pattern.filled(self.jacobian_nonzeros(x)).tocsr()

    def hessian_nonzeros(
        self, x: Float, lam_g: Float, lam_f: float = 1.0, theta: Float | None = None
    ) -> Float:
        """Nonzeros of the upper triangle of `lam_f f + lam_g . g`, in the order of
        `hessian_pattern`."""
        return self._sum(self._second["hess"], x, theta, lam_f, lam_g)

    def hessian(
        self, x: Float, lam_g: Float, lam_f: float = 1.0, theta: Float | None = None
    ) -> sparse.csc_matrix:
        """(nx, nx) Hessian of `lam_f f + lam_g . g`, both triangles."""
        upper = self.hessian_pattern.filled(self.hessian_nonzeros(x, lam_g, lam_f, theta))
        return sparse.csc_matrix(upper + sparse.triu(upper, 1).T)

    def _sum(
        self,
        terms: Terms,
        x: Float,
        theta: Float | None,
        lam_f: float = 1.0,
        lam_g: Float | None = None,
    ) -> Float:
        """The vector of the terms at x; the multipliers are for Hessians.

        Raises:
            ValueError: a vector has another length.
        """
        theta = self.thetas() if theta is None else theta
        given = _vector("x", x, self.nx), _vector("theta", theta, len(self.theta))
        lam_g = lam_g if lam_g is None else _vector("lam_g", lam_g, self.ng)
        size, summands, target = terms
        entries, at = np.empty(len(target)), 0
        for term in summands:
            end = at + term.entries
            term.evaluate(entries[at:end], *given, lam_f, lam_g)
            at = end
        # the last one is of what fills the last blocks
        return np.asarray(np.bincount(target, entries, size + 1)[:size], float)

    @cached_property
    def _first(self) -> Mapping[str, Terms]:
        """f, its gradient, g, its Jacobian."""
        groups = self.groups
        places = {
            "f": (1, [np.zeros((len(g), 1), int) for g in groups]),
            "grad": (self.nx, [g.index for g in groups]),
            "con": (self.ng, [g.rows for g in groups]),
            "jac": (self.nnzj, self.jacobian_pattern.places),
        }
        return self._terms([g.kernel.first_order() for g in groups], places)

    @cached_property
    def _second(self) -> Mapping[str, Terms]:
        """The Hessian, apart from the rest, since a start at a KKT point does not need it."""
        functions = [g.kernel.second_order(self.hessian_kind) for g in self.groups]
        return self._terms(functions, {"hess": (self.nnzh, self.hessian_pattern.places)})

    def _terms(
        self,
        functions: Sequence[Mapping[str, ca.Function]],
        places: Mapping[str, tuple[int, Sequence[NDArray[np.integer]]]],
    ) -> Mapping[str, Terms]:
        """Terms of sums, of functions of every group; `places` has the size of every sum, and where
        (E, k) the entries of every group are added."""
        out = dict[str, Terms]()
        for key, (size, targets) in places.items():
            every = zip(self.groups, functions, targets)
            own = [(Vectors(f[key], group), at) for group, f, at in every if key in f]
            target = [term.ordered(at, size) for term, at in own]
            none: NDArray[np.integer] = np.zeros(0, np.int64)
            out[key] = size, [term for term, _ in own], np.concatenate([none, *target])
        return out

    def evaluated(self) -> Self:
        """The same, with all its functions made now, so that later timings exclude it."""
        _ = self._first, self._second
        return self

    @cached_property
    def jacobian_pattern(self) -> Pattern:
        """Of g's Jacobian; places for every group."""
        return Pattern((self.ng, self.nx), partial(jacobian_entries, self.groups))

    @cached_property
    def hessian_pattern(self) -> Pattern:
        """Of the Hessian's upper triangle; places for every group."""
        entries = partial(hessian_entries, self.groups, self.hessian_kind)
        return Pattern((self.nx, self.nx), entries)

    @property
    def nx(self) -> int:
        """Variables."""
        return len(self.x0)

    @property
    def ng(self) -> int:
        """Constraints."""
        return len(self.lbg)

    @property
    def nnzj(self) -> int:
        """Nonzeros of the Jacobian."""
        return len(self.jacobian_pattern.rows)

    @property
    def nnzh(self) -> int:
        """Nonzeros of the Hessian's upper triangle."""
        return len(self.hessian_pattern.rows)

    def thetas(self, **values: float) -> Float:
        """(nt,) values of theta, with other ones for some of its entries."""
        for name in values.keys() - self.theta.keys():
            raise ModelError("unknown parameter", found=name, expected=", ".join(self.theta))
        return np.array(list({**self.theta, **values}.values()), float)

    def sizes(self) -> dict[str, int]:
        """Sizes with stable keys."""
        eq = int(np.sum(self.lbg == self.ubg))
        return {
            "variables": self.nx,
            "constraints": self.ng,
            "equalities": eq,
            "inequalities": self.ng - eq,
            "jacobian_nonzeros": self.nnzj,
            "hessian_nonzeros": self.nnzh,
        }

    def __str__(self) -> str:
        lines = [f"NLP {self.name}: {self.nx} variables, {self.ng} constraints"]
        for label, nnz, cells in (
            ("Jacobian", self.nnzj, self.nx * self.ng),
            ("Hessian", self.nnzh, self.nx * (self.nx + 1) // 2),
        ):
            share = nnz / cells if cells else 0.0
            lines.append(f"  {label:<11} {nnz:>9} nonzeros, {share:.3%} of {cells}")
        lines.append(f"  Hessian kind: {self.hessian_kind}")
        lines += [f"  {g.kernel.name:<12} {len(g):>7} x {g.kernel}" for g in self.groups]
        return "\n".join(lines)

    __repr__ = __str__


def _vector(name: str, values: Float, size: int) -> Float:
    """A contiguous vector of a length."""
    if len(values) != size:
        raise ValueError(f"{name} has {len(values)} entries, expected {size}")
    return np.ascontiguousarray(values, dtype=float)
