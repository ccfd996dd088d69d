"""Kernels and tables of an NLP, collected with its constraint rows."""

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from functools import lru_cache

import casadi as ca
import numpy as np

from soup_nlp.arrays import Float, Int
from soup_nlp.model.elements import Element
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.kernel import Group, Kernel
from soup_nlp.model.layout import Layout
from soup_nlp.model.nlp import NLP
from soup_nlp.model.norms import Norm, solver_form
from soup_nlp.model.superpixel import View

THETA = ("eps", "eps_pixel", "theta", "ridge")
"""Names of the numbers that an NLP lets change without a new build."""
_SYMBOLS = ca.SX.sym("theta", len(THETA))
"""One for all kernels, so that they serve every NLP."""


@dataclass
class Builder:
    """Collects groups and constraint rows.

    Attributes:
        form: Hessian and smoothing.
        layout: Of the variables.
        view: Makes a View of a superpixel's variables, the data row, its position in the element
            and the option.
        option: Gauge or chart.
        groups: Kernels and tables.
        lbg, ubg: Bounds of the constraint rows.
        kinds: Of constraints: label, superpixels (0 where they share a row), rows of each.
    """

    form: Formulation
    layout: Layout
    view: Callable[..., View]
    option: str
    groups: list[Group] = field(default_factory=list)
    lbg: list[float] = field(default_factory=list)
    ubg: list[float] = field(default_factory=list)
    kinds: list[tuple[str, int, int]] = field(default_factory=list)

    def add_norms(self, name: str, element: Element) -> None:
        """Add an energy term: kernel of its norms in solver form, and its table."""
        size, arity = element.superpixels.shape
        if not size:
            return
        fields, layout = tuple(element.fields.items()), self.layout
        view = arity, self.view, self.option, layout.stride
        kernel = _kernel(name, element.norms, element.given, fields, *view)
        index = np.concatenate([layout.of(i) for i in element.superpixels.T], axis=1)
        data = np.column_stack([c.reshape(size, -1) for c in element.columns.values()])
        self.groups.append(Group(kernel, index, data, np.zeros((size, 0), np.int64)))

    def add_constraint(
        self,
        name: str,
        x: ca.SX,
        body: ca.SX,
        index: Int,
        *,
        lower: float,
        upper: float,
        row: ca.SX | None = None,
        data: Float | None = None,
        total: bool = False,
    ) -> None:
        """Add a constraint of every superpixel: kernel, table and rows.

        Args:
            name: Of the kernel; the rows are named without a prefix "t_".
            x: (k,) symbols of the variables, and `index` (N, k) the variables.
            body: (r,) constraints between `lower` and `upper`.
            row: (m,) symbols of the data, if there are any, and `data` (N, m) the numbers.
            total: Whether the superpixels add up to one row (r = 1).
        """
        size, count = len(index), body.numel()
        added = 1 if total else size * count
        numbers = len(self.lbg) + np.arange(added)
        rows = np.broadcast_to(numbers.reshape(-1, count), (size, count))
        self.lbg += [lower] * added
        self.ubg += [upper] * added
        self.kinds.append((name.removeprefix("t_"), 0 if total else size, count))
        symbols = ca.SX.sym("none", 0) if row is None else row
        kernel = Kernel(name, x, symbols, _SYMBOLS, constraints=body)
        data = np.zeros((size, 0)) if data is None else data
        self.groups.append(Group(kernel, index, data, rows))

    def add_ridge(self, metric: Float) -> None:
        """Zero objective whose majorant is ridge x metric on the diagonal: metric (n,) has squared
        inverse lengths of natural steps of the first n variables."""
        x, m = ca.SX.sym("x"), ca.SX.sym("metric")
        kernel = Kernel("ridge", x, m, _SYMBOLS, objective=0 * x, curvature=_SYMBOLS[3] * m)
        index, none = np.arange(len(metric))[:, None], np.zeros((len(metric), 0), np.int64)
        self.groups.append(Group(kernel, index, metric[:, None], none))

    def finish(self, name: str, x0: Float, lbx: Float, ubx: Float) -> NLP:
        """The NLP of everything that was added, from the start and bounds of its variables.

        In the names of variables and rows the first index is the superpixel. A further one counts
        from 1: the rows of R'R = I in the order 11 12 22 13 23 33, or rim rays (in matrix
        coordinates 1 is the anchor).
        """
        f = self.form
        return NLP(
            name,
            tuple(self.groups),
            x0=np.clip(x0, lbx, ubx),
            lbx=lbx,
            ubx=ubx,
            lbg=np.array(self.lbg),
            ubg=np.array(self.ubg),
            theta=dict(zip(THETA, (f.eps, f.eps_pixel, f.theta, f.ridge))),
            hessian_kind=f.hessian,
            x_names=self.layout.names,
            g_names=self._g_names,
        )

    def _g_names(self) -> list[str]:
        """`label`, `label[i]`, or `label[i,3]` for the third of several of a superpixel."""
        out = []
        for label, size, count in self.kinds:
            numbers = [f",{k + 1}" for k in range(count)] if count > 1 else [""]
            out += [f"{label}[{i}{k}]" for i in range(size) for k in numbers] or [label]
        return out


@lru_cache(maxsize=200)
def _kernel(
    name: str,
    norms: Callable[..., list[Norm]],
    given: tuple[Hashable, ...],
    fields: tuple[tuple[str, int], ...],
    arity: int,
    view: Callable[..., View],
    option: str,
    stride: int,
) -> Kernel:
    """Kernel of a term's norms in solver form, made once."""
    x = ca.SX.sym("x", stride * arity)
    row = {k: ca.SX.sym(k, c) for k, c in fields}
    views = [view(v, row, a, option) for a, v in enumerate(ca.vertsplit(x, stride))]
    made = norms(*views, {**row, "eps": _SYMBOLS[0], "eps_pixel": _SYMBOLS[1]}, *given)
    objective, curvature = (
        sum(parts, ca.SX(0)) for parts in zip(*(solver_form(n, x, _SYMBOLS[2]) for n in made))
    )
    data = ca.vertcat(*row.values())
    return Kernel(name, x, data, _SYMBOLS, objective=objective, curvature=curvature)
