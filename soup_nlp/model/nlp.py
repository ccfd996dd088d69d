"""The NLP record and its assembly from kernels and tables."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from soup_nlp.errors import ModelError
from soup_nlp.model.compile import compile_functions
from soup_nlp.model.kernel import HESSIANS, Group

Float = NDArray[np.float64]


@dataclass(frozen=True)
class NLP:
    """min f(x, p) subject to lbg <= g(x, p) <= ubg, lbx <= x <= ubx.

    Attributes:
        name: For reports.
        groups: Kernels and tables that f and g are the sums of.
        x0, lbx, ubx: (nx,) start and bounds.
        lbg, ubg: (ng,) constraint bounds.
        p: (np,) parameter values: theta, then the data of every group, element by element.
        theta: Names of the leading entries of p.
        oracle: (x, p) -> f, g.
        grad_f: (x, p) -> f, gradient.
        jac_g: (x, p) -> g, Jacobian (ng x nx sparse).
        hess_lag: (x, p, lam_f, lam_g) -> upper triangle of the Lagrangian's Hessian.
        hessian: Kind of that Hessian (kernel.HESSIANS).
        x_names, g_names: Functions that make the readable names, on demand.
        build_seconds: Time to assemble, compile_seconds of which in the C compiler.
    """

    name: str
    groups: tuple[Group, ...]
    x0: Float
    lbx: Float
    ubx: Float
    lbg: Float
    ubg: Float
    p: Float
    theta: tuple[str, ...]
    oracle: ca.Function
    grad_f: ca.Function
    jac_g: ca.Function
    hess_lag: ca.Function
    hessian: str
    x_names: Callable[[], list[str]]
    g_names: Callable[[], list[str]]
    build_seconds: float
    compile_seconds: float

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
        return int(self.jac_g.nnz_out(1))

    @property
    def nnzh(self) -> int:
        """Nonzeros of the Hessian's upper triangle."""
        return int(self.hess_lag.nnz_out(0))

    def with_theta(self, **values: float) -> Float:
        """p with other theta entries."""
        p = self.p.copy()
        for name, value in values.items():
            if name not in self.theta:
                raise ModelError("unknown parameter", found=name, expected=", ".join(self.theta))
            p[self.theta.index(name)] = value
        return p

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
        lines.append(f"  Hessian kind: {self.hessian}; built in {self.build_seconds:.2f} s")
        lines += [f"  {g.kernel.name:<12} {g.size:>7} x {g.kernel}" for g in self.groups]
        return "\n".join(lines)


def _bound_bars(label: str, lower: Float, upper: Float) -> list[str]:
    lo, up = np.isfinite(lower), np.isfinite(upper)
    fixed = lo & up & (lower == upper)
    kinds = {
        "free": ~lo & ~up,
        "lower": lo & ~up,
        "upper": ~lo & up,
        "range": lo & up & ~fixed,
        "fixed": fixed,
    }
    total = max(1, len(lower))
    out = []
    for kind, mask in kinds.items():
        count = int(mask.sum())
        if count:
            bar = "#" * max(1, round(20 * count / total))
            out.append(f"  {label:<11} {kind:<6} {bar:<20} {count}")
    return out


def _pattern(
    shape: tuple[int, int], rows: list[NDArray[np.int64]], columns: list[NDArray[np.int64]]
) -> tuple[ca.Sparsity, list[NDArray[np.int64]]]:
    """Sparsity of the union of triplets, and where each group's triplets stand in it."""
    key = [c * shape[0] + r for r, c in zip(rows, columns)]
    unique, place = np.unique(np.concatenate(key), return_inverse=True)
    column_start = np.searchsorted(unique, np.arange(shape[1] + 1) * shape[0])
    pattern = ca.Sparsity(
        shape[0], shape[1], column_start.tolist(), (unique % shape[0]).tolist(), True
    )
    return pattern, np.split(place.ravel(), np.cumsum([len(k) for k in key])[:-1])


def _sum_into(size: int, index: NDArray[np.int64], local: ca.MX) -> ca.MX:
    """(size,) sums of local entries at their places: out[index[j]] += local[j].

    It is the transposed derivative of `out -> out[index]`, which CasADi runs as one loop; a
    constant 0/1 matrix times `local` takes twenty times as long to make and twice to apply.
    """
    out = ca.MX.sym("out", size)
    return ca.jtimes(out[_constant(index)], out, local, True)


def _constant(index: NDArray[np.int64]) -> list[int]:
    return index.astype(np.int64).ravel().tolist()


def assemble(
    name: str,
    groups: tuple[Group, ...],
    *,
    x0: Float,
    lbx: Float,
    ubx: Float,
    lbg: Float,
    ubg: Float,
    theta: Mapping[str, float],
    hessian: str,
    x_names: Callable[[], list[str]],
    g_names: Callable[[], list[str]],
    compiled: bool = True,
) -> NLP:
    """Build the NLP's functions: map every kernel over its table, scatter by constant matrices.

    Args:
        name: For reports.
        groups: Kernels and tables.
        x0: (nx,) start.
        lbx: (nx,) lower bounds of x.
        ubx: (nx,) upper bounds of x.
        lbg: (ng,) lower bounds of g.
        ubg: (ng,) upper bounds of g.
        theta: Values of the shared parameters, in the kernels' order.
        hessian: "exact", "gauss-newton" (positive semidefinite objective part, no constraint
            curvature) or "gauss-newton+constraints".
        x_names: Makes the variables' names.
        g_names: Makes the constraints' names.
        compiled: Use the C compiler where there is one.
    """
    if hessian not in HESSIANS:
        raise ModelError("unknown Hessian", found=hessian, expected=", ".join(HESSIANS))
    begin = time.perf_counter()
    groups = tuple(g for g in groups if g.size)
    nx, ng = len(x0), len(lbg)
    made = [g.kernel.functions(hessian) for g in groups]
    compile_begin = time.perf_counter()
    made = _compiled(made) if compiled else made
    compile_seconds = time.perf_counter() - compile_begin

    symbols = _symbols(nx, ng, len(theta) + sum(g.table.data.size for g in groups))
    x, p = symbols[:2]
    local = _mapped(groups, made, len(theta), *symbols)
    f = ca.MX(0.0)
    grad = ca.MX.zeros(nx)
    g = ca.MX.zeros(ng)
    objective = [(grp, v) for grp, v in zip(groups, local) if "f" in v]
    constrained = [(grp, v) for grp, v in zip(groups, local) if "con" in v]
    for group, values in objective:
        f += ca.sum1(values["f"])
        grad += _sum_into(nx, group.table.index, values["grad"])
    for group, values in constrained:
        g += _sum_into(ng, group.table.rows, values["con"])

    jac = ca.MX(ng, nx)
    if constrained:
        rows, columns = [], []
        for group, _ in constrained:
            r, c = group.kernel.jacobian_pattern()
            rows.append(group.table.rows[:, r].ravel())
            columns.append(group.table.index[:, c].ravel())
        pattern, places = _pattern((ng, nx), rows, columns)
        entries = ca.vertcat(*(v["jac"] for _, v in constrained))
        jac = ca.MX(pattern, _sum_into(pattern.nnz(), np.concatenate(places), entries))

    data = [grp.table.data.ravel() for grp in groups]
    return NLP(
        name=name,
        groups=groups,
        x0=x0,
        lbx=lbx,
        ubx=ubx,
        lbg=lbg,
        ubg=ubg,
        p=np.concatenate([np.array(list(theta.values()), float), *data]),
        theta=tuple(theta),
        oracle=ca.Function("nlp", [x, p], [f, g], ["x", "p"], ["f", "g"]),
        grad_f=ca.Function("nlp_grad_f", [x, p], [f, grad], ["x", "p"], ["f", "grad_f_x"]),
        jac_g=ca.Function("nlp_jac_g", [x, p], [g, jac], ["x", "p"], ["g", "jac_g_x"]),
        hess_lag=_hessian(groups, local, hessian, *symbols),
        hessian=hessian,
        x_names=x_names,
        g_names=g_names,
        build_seconds=time.perf_counter() - begin,
        compile_seconds=compile_seconds,
    )


def other_hessian(nlp: NLP, hessian: str, compiled: bool = True) -> ca.Function:
    """An NLP's `hess_lag` of another kind, without assembling the rest of it again.

    Args:
        nlp: The NLP.
        hessian: One of HESSIANS.
        compiled: Use the C compiler where there is one.
    """
    made = [g.kernel.functions(hessian) for g in nlp.groups]
    made = [{k: f for k, f in functions.items() if k == "hess"} for functions in made]
    symbols = _symbols(nlp.nx, nlp.ng, len(nlp.p))
    local = _mapped(nlp.groups, _compiled(made) if compiled else made, len(nlp.theta), *symbols)
    return _hessian(nlp.groups, local, hessian, *symbols)


def _symbols(nx: int, ng: int, np_: int) -> tuple[ca.MX, ca.MX, ca.MX, ca.MX]:
    """x, p, lam_f, lam_g."""
    return ca.MX.sym("x", nx), ca.MX.sym("p", np_), ca.MX.sym("lam_f"), ca.MX.sym("lam_g", ng)


def _compiled(made: list[dict[str, ca.Function]]) -> list[dict[str, ca.Function]]:
    fast = compile_functions([f for functions in made for f in functions.values()])
    return [{k: fast[f.name()] for k, f in functions.items()} for functions in made]


def _mapped(
    groups: tuple[Group, ...],
    made: list[dict[str, ca.Function]],
    thetas: int,
    x: ca.MX,
    p: ca.MX,
    lam_f: ca.MX,
    lam_g: ca.MX,
) -> list[dict[str, ca.MX]]:
    """Every group's functions over its table, element by element in one column."""
    th, offset = p[:thetas], thetas
    out: list[dict[str, ca.MX]] = []
    for group, functions in zip(groups, made):
        size, np_ = group.table.data.shape
        xe = ca.reshape(x[_constant(group.table.index)], group.kernel.nx, size)
        pe = ca.reshape(p[offset : offset + size * np_], np_, size)
        offset += size * np_
        args = [xe, pe, ca.repmat(th, 1, size)]
        values = {}
        for key, function in functions.items():
            extra = []
            if key == "hess":
                nc = group.kernel.nc
                lam_c = (
                    ca.reshape(lam_g[_constant(group.table.rows)], nc, size)
                    if nc
                    else ca.MX(0, size)
                )
                extra = [ca.repmat(lam_f, 1, size), lam_c]
            values[key] = ca.vec(function.map(size)(*args, *extra))
        out.append(values)
    return out


def _hessian(
    groups: tuple[Group, ...],
    local: list[dict[str, ca.MX]],
    hessian: str,
    x: ca.MX,
    p: ca.MX,
    lam_f: ca.MX,
    lam_g: ca.MX,
) -> ca.Function:
    """(x, p, lam_f, lam_g) -> upper triangle of the Lagrangian's Hessian."""
    nx = x.numel()
    hess = ca.MX(nx, nx)
    curved = [(grp, v) for grp, v in zip(groups, local) if "hess" in v]
    if curved:
        rows, columns = [], []
        for group, _ in curved:
            r, c = group.kernel.hessian_pattern(hessian)
            a, b = group.table.index[:, r].ravel(), group.table.index[:, c].ravel()
            rows.append(np.minimum(a, b))
            columns.append(np.maximum(a, b))
        pattern, places = _pattern((nx, nx), rows, columns)
        entries = ca.vertcat(*(v["hess"] for _, v in curved))
        hess = ca.MX(pattern, _sum_into(pattern.nnz(), np.concatenate(places), entries))
    return ca.Function(
        "nlp_hess_l",
        [x, p, lam_f, lam_g],
        [hess],
        ["x", "p", "lam_f", "lam_g"],
        ["triu_hess_gamma_x_x"],
    )


def to_scipy(matrix: ca.DM) -> sparse.csc_matrix:
    """scipy's CSC matrix of a CasADi one."""
    return matrix.sparse()
