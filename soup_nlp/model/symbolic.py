"""An NLP as a CasADi function of all its data: the sum of its kernels over their tables.

This is what `soup_nlp.nlp` gives to `nlpsol`. Its evaluation is slow, as the data of all tables are
parameters that every call copies; `NLP.value` and the others are fast.
"""

from collections.abc import Sequence

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float
from soup_nlp.model.nlp import NLP


def make_oracle(nlp: NLP) -> tuple[ca.Function, Float]:
    """The function (x, p) -> f, g, and (np,) values of p: theta, then the data of every group, by
    elements."""
    values = np.concatenate([nlp.thetas(), *(g.data.ravel() for g in nlp.groups)])
    x, p = ca.MX.sym("x", nlp.nx), ca.MX.sym("p", len(values))
    at = len(nlp.theta)
    theta, f = p[:at], ca.MX(0.0)
    rows, local = list[NDArray[np.integer]](), list[ca.MX]()
    for group in nlp.groups:
        size, width = group.data.shape
        data = ca.reshape(p[at : at + size * width], width, size)
        at += size * width
        own = ca.reshape(x[_list(group.index)], group.kernel.nx, size)
        given = own, data, ca.repmat(theta, 1, size)
        functions = group.kernel.first_order()
        if "f" in functions:
            f += ca.sum2(functions["f"].map(size)(*given))
        if "con" in functions:
            rows.append(group.rows)
            local.append(ca.vec(functions["con"].map(size)(*given)))
    g = _sum(nlp.ng, rows, local)
    return ca.Function("nlp", [x, p], [f, g], ["x", "p"], ["f", "g"]), values


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
