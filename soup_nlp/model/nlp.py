"""The NLP record: kernels, tables, bounds; its functions are made when first asked for."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Self

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
    _known: dict[str, Terms] = field(default_factory=dict, init=False)

    # --- numbers: what Ipopt and all reports are computed with ---

    def value(self, x: Float, theta: Float | None = None) -> float:
        """f at x (nx,); theta (nt,) of another smoothing."""
        return float(self._sum("f", x, theta)[0])

    def gradient(self, x: Float, theta: Float | None = None) -> Float:
        """Gradient of f (nx,)."""
        return self._sum("grad", x, theta)

    def constraints(self, x: Float, theta: Float | None = None) -> Float:
        """g (ng,)."""
        return self._sum("con", x, theta)

    def jacobian_nonzeros(self, x: Float, theta: Float | None = None) -> Float:
        """Nonzeros of g's Jacobian, in the order of `jacobian_pattern`."""
        return self._sum("jac", x, theta)

    def jacobian(self, x: Float) -> sparse.csr_matrix:
        """(ng, nx) Jacobian of g."""
        return self.jacobian_pattern.filled(self.jacobian_nonzeros(x)).tocsr()

    def hessian_nonzeros(
        self, x: Float, lam_g: Float, lam_f: float = 1.0, theta: Float | None = None
    ) -> Float:
        """Nonzeros of the upper triangle of `lam_f f + lam_g . g`, in the order of
        `hessian_pattern`."""
        return self._sum("hess", x, theta, lam_f, lam_g)

    def hessian(
        self, x: Float, lam_g: Float, lam_f: float = 1.0, theta: Float | None = None
    ) -> sparse.csc_matrix:
        """(nx, nx) Hessian of `lam_f f + lam_g . g`, both triangles."""
        upper = self.hessian_pattern.filled(self.hessian_nonzeros(x, lam_g, lam_f, theta))
        return sparse.csc_matrix(upper + sparse.triu(upper, 1).T)

    def _sum(
        self,
        key: str,
        x: Float,
        theta: Float | None,
        lam_f: float = 1.0,
        lam_g: Float | None = None,
    ) -> Float:
        """The sum of a key of `_terms` at x; ValueError for a vector of another length."""
        theta = self.thetas() if theta is None else theta
        given = _vector("x", x, self.nx), _vector("theta", theta, len(self.theta))
        lam_g = lam_g if lam_g is None else _vector("lam_g", lam_g, self.ng)
        size, summands, target = self._terms(key)
        entries, at = np.empty(len(target)), 0
        for term in summands:
            end = at + term.entries
            term.evaluate(entries[at:end], *given, lam_f, lam_g)
            at = end
        # the last one is of what fills the last blocks
        return np.asarray(np.bincount(target, entries, size + 1)[:size], float)

    def _terms(self, key: str) -> Terms:
        """Terms of "f", "grad", "con", "jac" or "hess", made when first asked for: a start at a KKT
        point does not need the Hessian."""
        if key not in self._known:
            size, places = self._places(key)
            first, kind = key != "hess", self.hessian_kind
            kernels = [g.kernel for g in self.groups]
            functions = [k.first_order() if first else k.second_order(kind) for k in kernels]
            every = zip(self.groups, functions, places)
            own = [(Vectors(f[key], group), at) for group, f, at in every if key in f]
            target = [term.ordered(at, size) for term, at in own]
            none: NDArray[np.integer] = np.zeros(0, np.int64)
            self._known[key] = size, [term for term, _ in own], np.concatenate([none, *target])
        return self._known[key]

    def _places(self, key: str) -> tuple[int, Sequence[NDArray[np.integer]]]:
        """Size of a sum, and where (E, k) it adds the entries of every group."""
        if key == "f":
            return 1, [np.zeros((len(g), 1), int) for g in self.groups]
        if key == "grad":
            return self.nx, [g.index for g in self.groups]
        if key == "con":
            return self.ng, [g.rows for g in self.groups]
        pattern = self.jacobian_pattern if key == "jac" else self.hessian_pattern
        return len(pattern.rows), pattern.places

    def evaluated(self) -> Self:
        """The same, with all its functions made now, so that later timings exclude it."""
        for key in ("f", "grad", "con", "jac", "hess"):
            self._terms(key)
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
            "jacobian_nonzeros": len(self.jacobian_pattern.rows),
            "hessian_nonzeros": len(self.hessian_pattern.rows),
        }

    def __str__(self) -> str:
        sizes = self.sizes()
        lines = [f"NLP {self.name}: {self.nx} variables, {self.ng} constraints"]
        cells = {"Jacobian": self.nx * self.ng, "Hessian": self.nx * (self.nx + 1) // 2}
        for label, cell_count in cells.items():
            nnz = sizes[f"{label.lower()}_nonzeros"]
            share = nnz / cell_count if cell_count else 0.0
            lines.append(f"  {label:<11} {nnz:>9} nonzeros, {share:.3%} of {cell_count}")
        lines.append(f"  Hessian kind: {self.hessian_kind}")
        lines += [f"  {g.kernel.name:<12} {len(g):>7} x {g.kernel}" for g in self.groups]
        return "\n".join(lines)

    __repr__ = __str__


def _vector(name: str, values: Float, size: int) -> Float:
    """A contiguous vector of a length."""
    if len(values) != size:
        raise ValueError(f"{name} has {len(values)} entries, expected {size}")
    return np.ascontiguousarray(values, dtype=float)
