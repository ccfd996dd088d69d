"""Kernels and tables of an NLP, collected with its slack variables and constraint rows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from soup_nlp.model.elements import Element
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.kernel import Group, Kernel, Table
from soup_nlp.model.nlp import NLP, assemble
from soup_nlp.model.norms import solver_form
from soup_nlp.model.superpixel import View

Float = NDArray[np.float64]
Int = NDArray[np.int64]

THETA = ("eps", "eps_pixel", "theta", "ridge")
"""Names of the numbers that an NLP lets change without a new build."""


@dataclass
class Builder:
    """Collects groups, slack variables and constraint rows.

    Attributes:
        form: Norm, truncation, Hessian and smoothing.
        nx: Variables so far.
        ng: Constraint rows so far.
    """

    form: Formulation
    nx: int
    ng: int = 0

    def __post_init__(self) -> None:
        self.groups: list[Group] = []
        self.x_extra: list[tuple[str, Float, Float]] = []
        self.lbg: list[Float] = []
        self.ubg: list[Float] = []
        self.g_blocks: list[tuple[str, Int]] = []
        self.x_blocks: list[tuple[str, Int]] = []
        self.theta = ca.SX.sym("theta", len(THETA))

    def new_variables(self, label: str, count: int, lower: float, upper: float) -> Int:
        """Indices of `count` fresh variables with bounds."""
        index = self.nx + np.arange(count)
        self.nx += count
        self.x_extra.append((label, np.full(count, lower), np.full(count, upper)))
        self.x_blocks.append((label, np.arange(count)))
        return index

    def new_rows(self, label: str, count: int, lower: float, upper: float) -> Int:
        """Indices of `count` fresh constraint rows with bounds."""
        index = self.ng + np.arange(count)
        self.ng += count
        self.lbg.append(np.full(count, lower))
        self.ubg.append(np.full(count, upper))
        self.g_blocks.append((label, np.arange(count)))
        return index

    def add_norms(self, name: str, element: Element, view: Callable[..., View], own: int) -> None:
        """Add an energy term: kernel of its norms in solver form, and its table.

        Args:
            name: Of the kernel.
            element: Data columns, superpixel indices and the norms.
            view: Makes a View of local variables (own,) and the data row, by position.
            own: Variables per superpixel.
        """
        size = len(element.index)
        if not size:
            return
        x = ca.SX.sym("x", own * element.arity)
        row = {k: ca.SX.sym(k, c) for k, c in element.fields.items()}
        views = [view(x[own * a : own * (a + 1)], row, a) for a in range(element.arity)]
        norms = element.norms(views, row, self.theta[0], self.theta[1])
        slacks: list[ca.SX | None] = []
        switches: list[ca.SX | None] = []
        local, index = [x], [element.index]
        for norm in norms:
            slack = switch = None
            if self.form.norm == "epigraph" and norm.kind == "norm":
                slack = ca.SX.sym(f"s_{norm.name}")
                local.append(slack)
                index.append(self.new_variables(f"s_{norm.name}", size, 0.0, np.inf)[:, None])
            if self.form.truncation == "lifted" and norm.sigma is not None:
                switch = ca.SX.sym(f"z_{norm.name}")
                local.append(switch)
                index.append(self.new_variables(f"z_{norm.name}", size, 0.0, 1.0)[:, None])
            slacks.append(slack)
            switches.append(switch)
        everything = ca.vertcat(*local)
        forms = [
            solver_form(norm, everything, self.theta[2], s, z)
            for norm, s, z in zip(norms, slacks, switches)
        ]
        cons = [f.constraint for f in forms if f.constraint is not None]
        rows = np.zeros((size, 0), np.int64)
        for norm, f in zip(norms, forms):
            if f.constraint is not None:
                fresh = self.new_rows(f"epigraph_{norm.name}", size, 0.0, np.inf)
                rows = np.concatenate([rows, fresh[:, None]], axis=1)
        kernel = Kernel(
            name,
            everything,
            ca.vertcat(*row.values()),
            self.theta,
            objective=sum((f.objective for f in forms), ca.SX(0)),
            constraints=ca.vertcat(*cons) if cons else None,
            curvature=sum((f.curvature for f in forms), ca.SX(0)),
            exact=sum((n.exact() for n in norms), ca.SX(0)),
        )
        data = np.column_stack([element.columns[k].reshape(size, -1) for k in element.fields])
        self.groups.append(Group(kernel, Table(np.concatenate(index, axis=1), data, rows)))

    def add_constraint(
        self, name: str, x: ca.SX, row: ca.SX, body: ca.SX, index: Int, data: Float, rows: Int
    ) -> None:
        """Add a constraint kernel with its table.

        Args:
            name: Of the kernel.
            x: (k,) symbols of the variables.
            row: (m,) symbols of the data.
            body: (r,) constraints.
            index: (E, k) variables of every element.
            data: (E, m) data of every element.
            rows: (E, r) constraint rows of every element.
        """
        kernel = Kernel(name, x, row, self.theta, constraints=body)
        self.groups.append(Group(kernel, Table(index, data, rows)))

    def add_ridge(self, metric: Float) -> None:
        """Zero objective whose stand-in Hessian is ridge x metric on the diagonal.

        Args:
            metric: (n,) squared inverse length of a natural step of the first n variables.
        """
        x, m = ca.SX.sym("x"), ca.SX.sym("metric")
        kernel = Kernel("ridge", x, m, self.theta, objective=0 * x, curvature=self.theta[3] * m)
        self.groups.append(Group(kernel, Table(np.arange(len(metric))[:, None], metric[:, None])))

    def finish(
        self, name: str, x0: Float, lbx: Float, ubx: Float, own: int, names: Callable[[], list[str]]
    ) -> NLP:
        """The NLP of everything that was added, its slack variables at their best values.

        Args:
            name: Of the NLP.
            x0: (nx,) start; what is beyond `own` does not matter.
            lbx: (nx,) lower bounds; what is beyond `own` does not matter.
            ubx: (nx,) upper bounds; what is beyond `own` does not matter.
            own: Number of variables that are no slack variables.
            names: Makes the names of those.
        """
        offset = own
        for _, lower, upper in self.x_extra:
            lbx[offset : offset + len(lower)] = lower
            ubx[offset : offset + len(upper)] = upper
            offset += len(lower)
        f = self.form
        nlp = assemble(
            name,
            tuple(self.groups),
            x0=np.clip(x0, lbx, ubx),
            lbx=lbx,
            ubx=ubx,
            lbg=np.concatenate(self.lbg),
            ubg=np.concatenate(self.ubg),
            theta=dict(zip(THETA, (f.eps, f.eps_pixel, f.theta, f.ridge))),
            hessian=f.hessian,
            x_names=lambda: _names(names(), self.x_blocks),
            g_names=partial(_names, [], self.g_blocks),
            compiled=f.compiled,
        )
        return _with_slacks(nlp, own)


def _names(own: list[str], blocks: list[tuple[str, Int]]) -> list[str]:
    return own + [f"{label}[{i}]" for label, index in blocks for i in index]


def _with_slacks(nlp: NLP, own: int) -> NLP:
    """Start slack variables at the norms' values and switches where they are optimal."""
    if nlp.nx == own:
        return nlp
    x0 = nlp.x0.copy()
    for group in nlp.groups:
        kernel, table = group.kernel, group.table
        extra = np.flatnonzero(table.index[0] >= own)
        if not len(extra):
            continue
        _fill(kernel, table, extra, x0, nlp.p[: len(nlp.theta)])
    return replace(nlp, x0=x0)


def _fill(kernel: Kernel, table: Table, extra: Int, x0: Float, theta: Float) -> None:
    """Best values of a kernel's slack variables and switches, written into x0."""
    size = len(table)
    th = np.repeat(theta[:, None], size, axis=1)
    slacks = [j for j in extra if kernel.x[int(j)].name().startswith("s_")]
    switches = [j for j in extra if kernel.x[int(j)].name().startswith("z_")]
    if slacks and kernel.constraints is not None:
        # constraint is s^2 - |v|^2 - eps^2, so at s = 0 its negative is s^2 at the best s
        con = ca.Function("c", [kernel.x, kernel.row, kernel.theta], [kernel.constraints])
        local = x0[table.index].copy()
        local[:, slacks] = 0.0
        value = np.asarray(con.map(size)(local.T, table.data.T, th)).reshape(len(slacks), size)
        for j, v in zip(slacks, value):
            x0[table.index[:, j]] = np.sqrt(np.maximum(-v, 1e-12))
    if switches and kernel.objective is not None:
        # the objective is linear in a switch: its slope says which end is better
        slope = ca.gradient(kernel.objective, kernel.x)
        fun = ca.Function("s", [kernel.x, kernel.row, kernel.theta], [slope])
        value = np.asarray(fun.map(size)(x0[table.index].T, table.data.T, th))
        for j in switches:
            x0[table.index[:, j]] = np.where(value[j] < 0, 0.99, 0.01)
