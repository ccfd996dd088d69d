"""The NLP record: kernels, tables, bounds; its functions are assembled when first asked for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from scipy import sparse

from soup_nlp.arrays import Float
from soup_nlp.errors import ModelError
from soup_nlp.model.assemble import (
    Assembled,
    Pattern,
    assemble_functions,
    assemble_hessian,
    jacobian_entries,
)
from soup_nlp.model.blocks import hessian_pattern
from soup_nlp.model.kernel import Group, Hessian
from soup_nlp.model.sums import Sums


@dataclass(frozen=True)
class NLP:
    """min f(x, p) subject to lbg <= g(x, p) <= ubg, lbx <= x <= ubx.

    Attributes:
        name: For reports.
        groups: Kernels and tables that f and g are the sums of, none of them empty.
        x0, lbx, ubx: (nx,) start and bounds.
        lbg, ubg: (ng,) constraint bounds.
        theta: Values of the parameters that all kernels share, by name in the kernels' order.
        hessian: Kind of the Hessian (kernel.HESSIANS).
        x_names, g_names: Functions that make the readable names, on demand.
        compiled: Use the C compiler where there is one.
    """

    name: str
    groups: tuple[Group, ...]
    x0: Float
    lbx: Float
    ubx: Float
    lbg: Float
    ubg: Float
    theta: Mapping[str, float]
    hessian: Hessian
    x_names: Callable[[], list[str]]
    g_names: Callable[[], list[str]]
    compiled: bool = True

    @cached_property
    def p(self) -> Float:
        """(np,) parameter values: theta, then the data of every group, element by element."""
        data = [g.table.data.ravel() for g in self.groups]
        return np.concatenate([np.array(list(self.theta.values()), float), *data])

    @cached_property
    def functions(self) -> Assembled:
        """What a solver calls but the Hessian; assembled (a second) by the first access."""
        return assemble_functions(self.groups, self.nx, self.ng, len(self.theta), self.compiled)

    @cached_property
    def sums(self) -> Sums:
        """f, g and their first derivatives as numpy arrays, at the NLP's own theta."""
        return Sums(self)

    @cached_property
    def jacobian_pattern(self) -> Pattern:
        """Of g's Jacobian; places for every group with constraints."""
        with_rows = [jacobian_entries(g) for g in self.groups if g.kernel.nc]
        return Pattern.of((self.ng, self.nx), with_rows)

    @cached_property
    def hessian_pattern(self) -> Pattern:
        """Of the Hessian's upper triangle; places for every group."""
        return hessian_pattern(self.groups, self.nx, self.hessian)

    @cached_property
    def hessian_nonzeros(self) -> Pattern:
        """`hessian_pattern` without places, a third of the work."""
        return hessian_pattern(self.groups, self.nx, self.hessian, placed=False)

    @cached_property
    def hess_lag(self) -> ca.Function:
        """(x, p, lam_f, lam_g) -> upper triangle of the Lagrangian's Hessian; by itself, since
        assembling it takes seconds at real sizes."""
        sizes = self.ng, len(self.theta)
        pattern = self.hessian_pattern
        return assemble_hessian(self.groups, pattern, *sizes, self.hessian, self.compiled)

    def assembled(self) -> NLP:
        """The same, with all its functions assembled now, so that later timings exclude it."""
        _ = self.functions, self.hess_lag
        return self

    @property
    def oracle(self) -> ca.Function:
        """(x, p) -> f, g."""
        return self.functions.oracle

    @property
    def grad_f(self) -> ca.Function:
        """(x, p) -> f, gradient."""
        return self.functions.grad_f

    @property
    def jac_g(self) -> ca.Function:
        """(x, p) -> g, Jacobian (ng x nx sparse)."""
        return self.functions.jac_g

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
        return len(self.hessian_nonzeros.rows)

    def with_theta(self, **values: float) -> Float:
        """p with other theta entries."""
        p = self.p.copy()
        p[: len(self.theta)] = self.thetas(**values)
        return p

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
        lines += _bound_bars("variables", self.lbx, self.ubx)
        lines += _bound_bars("constraints", self.lbg, self.ubg)
        for label, nnz, cells in (
            ("Jacobian", self.nnzj, self.nx * self.ng),
            ("Hessian", self.nnzh, self.nx * (self.nx + 1) // 2),
        ):
            share = nnz / cells if cells else 0.0
            lines.append(f"  {label:<11} {nnz:>9} nonzeros, {share:.3%} of {cells}")
        lines.append(f"  Hessian kind: {self.hessian}")
        lines += [f"  {g.kernel.name:<12} {g.size:>7} x {g.kernel}" for g in self.groups]
        return "\n".join(lines)

    __repr__ = __str__


def _bound_bars(label: str, lower: Float, upper: Float) -> list[str]:
    """A line with a bar for every kind of bound that occurs."""
    lo, up = np.isfinite(lower), np.isfinite(upper)
    fixed = lo & up & (lower == upper)
    kinds = {
        "free": ~lo & ~up,
        "lower": lo & ~up,
        "upper": ~lo & up,
        "range": lo & up & ~fixed,
        "fixed": fixed,
    }
    counts = {kind: int(mask.sum()) for kind, mask in kinds.items() if mask.any()}
    bars = {kind: "#" * max(1, round(20 * c / len(lower))) for kind, c in counts.items()}
    return [f"  {label:<11} {kind:<6} {bars[kind]:<20} {c}" for kind, c in counts.items()]


def to_scipy(matrix: ca.DM) -> sparse.csc_matrix:
    """scipy's CSC matrix of a CasADi one."""
    return matrix.sparse()
