"""An NLP as CasADi's graph: every kernel mapped over its table, its results added up in place.

It is what the exports write and what `soup_nlp.nlp` gives to `nlpsol`. Its evaluation is slow, as
the data of all tables are parameters that every call copies; `NLP.value` and the others are fast.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from soup_nlp.model.kernel import Pattern
from soup_nlp.model.nlp import NLP


class Graph:
    """Functions of an NLP, made when first asked for.

    Attributes:
        p: (np,) values of the parameters: theta, then the data of every group, by elements.
    """

    def __init__(self, nlp: NLP) -> None:
        self._nlp, self._first = nlp, [g.kernel.first_order() for g in nlp.groups]
        self.p = np.concatenate([nlp.thetas(), *(g.data.ravel() for g in nlp.groups)])
        sizes = {"x": nlp.nx, "p": len(self.p), "lam_g": nlp.ng, "lam_f": 1}
        self._x, self._p, self._lam_g, self._lam_f = (ca.MX.sym(*size) for size in sizes.items())

    @cached_property
    def oracle(self) -> ca.Function:
        """(x, p) -> f, g."""
        return self._function("nlp", {"f": self._f, "g": self._g})

    @cached_property
    def grad_f(self) -> ca.Function:
        """(x, p) -> f, gradient."""
        local = self._local("grad", self._first)
        places = [g.index for g, v in zip(self._nlp.groups, self._first) if "grad" in v]
        return self._function(
            "nlp_grad_f", {"f": self._f, "grad_f_x": _sum(self._x.numel(), places, local)}
        )

    @cached_property
    def jac_g(self) -> ca.Function:
        """(x, p) -> g, Jacobian (ng x nx sparse)."""
        jac = _matrix(self._nlp.jacobian_pattern, self._local("jac", self._first))
        return self._function("nlp_jac_g", {"g": self._g, "jac_g_x": jac})

    @cached_property
    def hess_lag(self) -> ca.Function:
        """(x, p, lam_f, lam_g) -> upper triangle of the Lagrangian's Hessian."""
        nlp = self._nlp
        second = [g.kernel.second_order(nlp.hessian_kind) for g in nlp.groups]
        local = self._local("hess", second)
        symbols = [self._x, self._p, self._lam_f, self._lam_g]
        names = ["x", "p", "lam_f", "lam_g"], ["triu_hess_gamma_x_x"]
        return ca.Function("nlp_hess_l", symbols, [_matrix(nlp.hessian_pattern, local)], *names)

    @cached_property
    def _f(self) -> ca.MX:
        return sum((ca.sum1(v) for v in self._local("f", self._first)), ca.MX(0.0))

    @cached_property
    def _g(self) -> ca.MX:
        places = [g.rows for g, v in zip(self._nlp.groups, self._first) if "con" in v]
        return _sum(self._lam_g.numel(), places, self._local("con", self._first))

    def _function(self, name: str, outputs: Mapping[str, ca.MX]) -> ca.Function:
        return ca.Function(
            name, [self._x, self._p], list(outputs.values()), ["x", "p"], list(outputs)
        )

    def _local(self, key: str, functions: Sequence[Mapping[str, ca.Function]]) -> list[ca.MX]:
        """A function of every group that has it over its table, element by element."""
        at, out = len(self._nlp.theta), []
        theta = self._p[:at]
        for group, own_functions in zip(self._nlp.groups, functions):
            size, width = group.data.shape
            data = ca.reshape(self._p[at : at + size * width], width, size)
            at += size * width
            if key not in own_functions:
                continue
            x = ca.reshape(self._x[_list(group.index)], group.kernel.nx, size)
            given = [x, data, ca.repmat(theta, 1, size)]
            if key == "hess":
                rows = _list(group.rows)
                lam_c = ca.reshape(self._lam_g[rows], -1, size) if rows else ca.MX(0, size)
                given += [ca.repmat(self._lam_f, 1, size), lam_c]
            out.append(ca.vec(own_functions[key].map(size)(*given).nz[:]))
        return out


def _sum(size: int, places: Sequence[NDArray[np.integer]], local: Sequence[ca.MX]) -> ca.MX:
    """(size,) sums of local entries at their places: out[places[j]] += local[j].

    It is the transposed derivative of `out -> out[places]`, which CasADi runs as one loop. A
    constant 0/1 matrix takes twenty times as long to build and twice as long to apply.
    """
    out = ca.MX.sym("out", size)
    if not local:
        return ca.MX.zeros(size)
    every = np.concatenate([p.ravel() for p in places])
    return ca.jtimes(out[_list(every)], out, ca.vertcat(*local), True)


def _list(index: NDArray[np.integer]) -> list[int]:
    return index.astype(np.int64).ravel().tolist()


def _matrix(pattern: Pattern, local: Sequence[ca.MX]) -> ca.MX:
    if not local:
        return ca.MX(*pattern.shape)
    return ca.MX(pattern.sparsity(), _sum(len(pattern.rows), pattern.places, local))
