"""Kernels and tables of an NLP, collected with its slack variables and constraint rows."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np

from soup_nlp.arrays import Float, Int
from soup_nlp.model.elements import Element, Norms
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.kernel import Group, Kernel
from soup_nlp.model.layout import Layout
from soup_nlp.model.nlp import NLP
from soup_nlp.model.norms import NormForm, solver_form
from soup_nlp.model.superpixel import View

THETA = ("eps", "eps_pixel", "theta", "ridge")
"""Names of the numbers that an NLP lets change without a new build."""
_SYMBOLS = ca.SX.sym("theta", len(THETA))
"""One for all kernels, so that they serve every NLP."""


class Block(NamedTuple):
    """Consecutive variables or constraint rows of one kind.

    Attributes:
        label: Of the kind.
        lower, upper: Bounds of each.
        superpixels: (M, a) of each, for its name; a = 0 where that is the label alone.
    """

    label: str
    lower: float
    upper: float
    superpixels: Int


def _bounds(blocks: list[Block]) -> tuple[Float, Float]:
    """Lower and upper bounds of all blocks, in their order."""
    count = [len(b.superpixels) for b in blocks]
    return np.repeat([b.lower for b in blocks], count), np.repeat([b.upper for b in blocks], count)


def _names(blocks: list[Block]) -> list[str]:
    """`label[i]` or `label[i,k]`; `label[i,3]` for the third of several of a superpixel."""
    out = []
    for block in blocks:
        places = [",".join(map(str, row)) for row in block.superpixels.tolist()]
        several, seen = len(set(places)) < len(places), Counter[str]()
        for place in places:
            seen[place] += 1
            inside = f"{place},{seen[place]}" if several else place
            out.append(f"{block.label}[{inside}]" if inside else block.label)
    return out


@dataclass
class Builder:
    """Collects groups, slack variables and constraint rows.

    Attributes:
        form: Norm, Hessian and smoothing.
        layout: Of the variables before the slack variables.
        view: Makes a View of a superpixel's variables, the data row, its position in the element
            and the option.
        option: Gauge or chart.
    """

    form: Formulation
    layout: Layout
    view: Callable[..., View]
    option: str
    groups: list[Group] = field(default_factory=list)
    slacks: list[Block] = field(default_factory=list)
    rows: list[Block] = field(default_factory=list)

    def add_norms(self, name: str, element: Element) -> None:
        """Add an energy term: kernel of its norms in solver form, and its table."""
        size, arity = element.superpixels.shape
        if not size:
            return
        fields, layout = tuple(element.fields.items()), self.layout
        term = name, element.norms, fields, arity, self.view, self.option, layout.stride
        kernel, slacks = _kernel(*term, self.form.norm)
        index, rows = [layout.of(i) for i in element.superpixels.T], []
        for norm in slacks:
            slack = Block(f"s_{norm}", 0.0, np.inf, element.superpixels)
            index.append(layout.size + _added(self.slacks, slack)[:, None])
            row = Block(f"epigraph_{norm}", 0.0, np.inf, element.superpixels)
            rows.append(_added(self.rows, row))
        data = np.column_stack([c.reshape(size, -1) for c in element.columns.values()])
        own = np.concatenate(index, axis=1), data, np.array(rows, np.int64).reshape(-1, size).T
        self.groups.append(Group(kernel, *own))

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
        own = np.zeros((1, 0), int) if total else np.repeat(np.arange(size), count)[:, None]
        block = Block(name.removeprefix("t_"), lower, upper, own)
        rows = np.broadcast_to(_added(self.rows, block).reshape(-1, count), (size, count))
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
        """The NLP of everything that was added, its slack variables at their best values.

        In the names of variables and rows the first index is the superpixel; for an edge or a
        neighbour pair the first two are its two superpixels. A further index counts from 1: the
        rows of R'R = I in the order 11 12 22 13 23 33, rim rays (in matrix coordinates 1 is the
        anchor), or sampled pixels.

        Args:
            name: Of the NLP.
            x0, lbx, ubx: Start and bounds of the layout's variables.
        """
        lower, upper = _bounds(self.slacks)
        lbx, ubx = np.concatenate([lbx, lower]), np.concatenate([ubx, upper])
        lbg, ubg = _bounds(self.rows)
        f = self.form
        nlp = NLP(
            name,
            tuple(self.groups),
            x0=np.clip(np.concatenate([x0, 0.0 * lower]), lbx, ubx),
            lbx=lbx,
            ubx=ubx,
            lbg=lbg,
            ubg=ubg,
            theta=dict(zip(THETA, (f.eps, f.eps_pixel, f.theta, f.ridge))),
            hessian_kind=f.hessian,
            x_names=lambda: self.layout.names() + _names(self.slacks),
            g_names=lambda: _names(self.rows),
        )
        if not self.slacks:
            return nlp
        slack, row = nlp.slacks()
        best = nlp.x0.copy()
        # a row is s^2 - |v|^2 - eps^2, so at s = 0 its negative is s^2 at the best s
        best[slack] = np.sqrt(np.maximum(-nlp.constraints(nlp.x0)[row], 1e-12))
        return replace(nlp, x0=best)


def _added(blocks: list[Block], block: Block) -> Int:
    """Append a block; the numbers of its variables or rows among those of all blocks."""
    first = sum(len(b.superpixels) for b in blocks)
    blocks.append(block)
    return first + np.arange(len(block.superpixels))


@lru_cache(maxsize=200)
def _kernel(
    name: str,
    norms: Norms,
    fields: tuple[tuple[str, int], ...],
    arity: int,
    view: Callable[..., View],
    option: str,
    stride: int,
    norm: NormForm,
) -> tuple[Kernel, list[str]]:
    """Kernel of a term's norms in solver form, made once, and the names of norms with a slack."""
    x = ca.SX.sym("x", stride * arity)
    row = {k: ca.SX.sym(k, c) for k, c in fields}
    views = [view(v, row, a, option) for a, v in enumerate(ca.vertsplit(x, stride))]
    norms_of_term = norms(views, row, _SYMBOLS[0], _SYMBOLS[1])
    named = [n.name for n in norms_of_term if norm == "epigraph" and n.kind == "norm"]
    slacks = {k: ca.SX.sym(f"s_{k}") for k in named}
    local = ca.vertcat(x, *slacks.values())
    forms = [solver_form(n, local, _SYMBOLS[2], slacks.get(n.name)) for n in norms_of_term]
    kernel = Kernel(
        name,
        local,
        ca.vertcat(*row.values()),
        _SYMBOLS,
        objective=sum((f.objective for f in forms), ca.SX(0)),
        constraints=ca.vertcat(*(f.constraint for f in forms if f.constraint is not None))
        if slacks
        else None,
        curvature=sum((f.curvature for f in forms), ca.SX(0)),
    )
    return kernel, named
