"""Assembly of an NLP's functions: every kernel mapped over its table, scattered into place."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from soup_nlp.arrays import Float, Int
from soup_nlp.model.compile import compile_functions
from soup_nlp.model.kernel import Group


class Entries(NamedTuple):
    """Where the nonzeros of a set of elements stand.

    Attributes:
        rows, columns: (E, k) or (k,).
    """

    rows: NDArray[np.integer]
    columns: NDArray[np.integer]


class Pattern(NamedTuple):
    """Union of the nonzeros of many elements.

    Attributes:
        shape: Of the matrix.
        rows, columns: Of every nonzero, by columns.
        places: For each set of elements, where its nonzeros stand, element by element.
    """

    shape: tuple[int, int]
    rows: Int
    columns: Int
    places: list[NDArray[np.integer]]

    @classmethod
    def of(cls, shape: tuple[int, int], sets: Sequence[Entries]) -> Pattern:
        """Of the nonzeros of each set of elements."""
        # half as many bytes are ranked in half the time
        kind = np.int32 if shape[0] * shape[1] < 2**31 else np.int64
        sizes = [e.rows.size for e in sets]
        ends = np.cumsum(sizes[:-1], dtype=int)
        every: NDArray[np.integer] = np.empty(sum(sizes), kind)
        for own, e in zip(np.split(every, ends), sets):
            np.multiply(e.columns.ravel(), shape[0], dtype=kind, out=own)
            own += e.rows.ravel()
        unique, place = ranked(every)
        columns, rows = np.divmod(unique.astype(np.int64), shape[0])
        return cls(shape, rows, columns, np.split(place, ends))

    def sparsity(self) -> ca.Sparsity:
        """For CasADi."""
        return ca.Sparsity(*self.shape, self._start().tolist(), self.rows.tolist(), True)

    def filled(self, nonzeros: Float) -> sparse.csc_matrix:
        """The matrix with these nonzeros."""
        return sparse.csc_matrix((nonzeros, self.rows, self._start()), self.shape)

    def _start(self) -> Int:
        """First nonzero of every column, and their number."""
        return np.searchsorted(self.columns, np.arange(self.shape[1] + 1))


def ranked(keys: NDArray[np.integer]) -> tuple[NDArray[np.integer], NDArray[np.int32]]:
    """`np.unique(keys, return_inverse=True)`, two to four times as fast on keys nearly in order;
    overwrites the keys."""
    order = np.argsort(keys, kind="stable")
    place = np.empty(len(keys), np.int32)
    keys[:] = keys[order]
    new = np.ones(len(keys), bool)
    np.not_equal(keys[1:], keys[:-1], out=new[1:])
    place[order] = np.cumsum(new, dtype=np.int32) - 1
    return keys[new], place


def jacobian_entries(group: Group) -> Entries:
    """Nonzeros of a group's elements in g's Jacobian."""
    r, c = group.kernel.jacobian_pattern()
    return Entries(group.table.rows[:, r], group.table.index[:, c])


def _sum_into(size: int, index: Int, local: ca.MX) -> ca.MX:
    """(size,) sums of local entries at their places: out[index[j]] += local[j].

    It is the transposed derivative of `out -> out[index]`, which CasADi runs as one loop. A
    constant 0/1 matrix takes twenty times as long to build and twice as long to apply.
    """
    out = ca.MX.sym("out", size)
    return ca.jtimes(out[_constant(index)], out, local, True)


def _constant(index: Int) -> list[int]:
    return index.astype(np.int64).ravel().tolist()


class Assembled(NamedTuple):
    """What a solver calls, apart from the Hessian.

    Attributes:
        oracle: (x, p) -> f, g.
        grad_f: (x, p) -> f, gradient.
        jac_g: (x, p) -> g, Jacobian (ng x nx sparse).
    """

    oracle: ca.Function
    grad_f: ca.Function
    jac_g: ca.Function


def assemble_functions(
    groups: Sequence[Group], nx: int, ng: int, thetas: int, compiled: bool = True
) -> Assembled:
    """Map every kernel over its table and scatter its results.

    Args:
        groups: Kernels and tables, none of them empty.
        nx: Variables.
        ng: Constraints.
        thetas: Shared parameters, which lead p; the data of every group follow.
        compiled: Use the C compiler where there is one.
    """
    made = [g.kernel.first_order() for g in groups]
    made = _compiled(made) if compiled else made
    symbols = _symbols(nx, ng, thetas + sum(g.table.data.size for g in groups))
    x, p, *_ = symbols
    local = _mapped(groups, made, thetas, symbols)
    f = ca.MX(0.0)
    grad = ca.MX.zeros(nx)
    g = ca.MX.zeros(ng)
    constrained = [(grp, v) for grp, v in zip(groups, local) if "con" in v]
    for group, values in zip(groups, local):
        if "f" in values:
            f += ca.sum1(values["f"])
            grad += _sum_into(nx, group.table.index, values["grad"])
        if "con" in values:
            g += _sum_into(ng, group.table.rows, values["con"])
    pattern = Pattern.of((ng, nx), [jacobian_entries(group) for group, _ in constrained])
    jac = _matrix(pattern, [v["jac"] for _, v in constrained])
    return Assembled(
        oracle=ca.Function("nlp", [x, p], [f, g], ["x", "p"], ["f", "g"]),
        grad_f=ca.Function("nlp_grad_f", [x, p], [f, grad], ["x", "p"], ["f", "grad_f_x"]),
        jac_g=ca.Function("nlp_jac_g", [x, p], [g, jac], ["x", "p"], ["g", "jac_g_x"]),
    )


def assemble_hessian(
    groups: Sequence[Group],
    pattern: Pattern,
    ng: int,
    thetas: int,
    hessian: str,
    compiled: bool = True,
) -> ca.Function:
    """(x, p, lam_f, lam_g) -> upper triangle of the Lagrangian's Hessian.

    Args:
        groups: Kernels and tables, none of them empty.
        pattern: From `hessian_pattern`.
        ng: Constraints.
        thetas: Shared parameters, which lead p.
        hessian: One of kernel.HESSIANS.
        compiled: Use the C compiler where there is one.
    """
    second = [g.kernel.second_order(hessian) for g in groups]
    made = [{"hess": h} if h else {} for h in second]
    nx = pattern.shape[0]
    symbols = _symbols(nx, ng, thetas + sum(g.table.data.size for g in groups))
    local = _mapped(groups, _compiled(made) if compiled else made, thetas, symbols)
    entries = [v["hess"] for v in local if "hess" in v]
    return ca.Function(
        "nlp_hess_l",
        list(symbols),
        [_matrix(pattern, entries)],
        ["x", "p", "lam_f", "lam_g"],
        ["triu_hess_gamma_x_x"],
    )


def _symbols(nx: int, ng: int, np_: int) -> tuple[ca.MX, ca.MX, ca.MX, ca.MX]:
    """x, p, lam_f, lam_g."""
    sizes = {"x": nx, "p": np_, "lam_f": 1, "lam_g": ng}
    x, p, lam_f, lam_g = (ca.MX.sym(name, size) for name, size in sizes.items())
    return x, p, lam_f, lam_g


def _compiled(made: list[dict[str, ca.Function]]) -> list[dict[str, ca.Function]]:
    out = []
    for functions in made:
        # one library per kernel: the cache then still holds the kernels that did not change
        fast = compile_functions(list(functions.values())) if functions else {}
        out.append({k: fast[f.name()] for k, f in functions.items()})
    return out


def _mapped(
    groups: Sequence[Group],
    made: list[dict[str, ca.Function]],
    thetas: int,
    symbols: tuple[ca.MX, ca.MX, ca.MX, ca.MX],
) -> list[dict[str, ca.MX]]:
    """Every group's functions over its table, element by element in one column."""
    x, p, lam_f, lam_g = symbols
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
                rows = _constant(group.table.rows)
                lam_c = ca.reshape(lam_g[rows], -1, size) if rows else ca.MX(0, size)
                extra = [ca.repmat(lam_f, 1, size), lam_c]
            values[key] = ca.vec(function.map(size)(*args, *extra))
        out.append(values)
    return out


def _matrix(pattern: Pattern, local: list[ca.MX]) -> ca.MX:
    if not local:
        return ca.MX(*pattern.shape)
    places = np.concatenate(pattern.places)
    return ca.MX(pattern.sparsity(), _sum_into(len(pattern.rows), places, ca.vertcat(*local)))
