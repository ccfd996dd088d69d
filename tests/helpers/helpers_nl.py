"""Textbook problems of kernels, plain SX problems as .nl files, and files as CasADi reads them."""

from collections.abc import Sequence
from functools import cached_property, partial
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from soup_nlp.export.nl import NLFile, write_nl
from soup_nlp.model.kernel import Group, Kernel
from soup_nlp.model.nlp import NLP


def plain_nlp(name: str, groups: Sequence[Group], x0: ArrayLike, **given: object) -> NLP:
    """A textbook problem of kernels: free and without parameters, unless fields of NLP are given.

    Bounds may be single numbers; names may be lists.
    """
    x0 = np.asarray(x0, float)
    rows = max((int(g.rows.max(initial=-1)) + 1 for g in groups), default=0)
    free = {"lbx": -np.inf, "ubx": np.inf, "lbg": -np.inf, "ubg": np.inf}
    bounds = {}
    for side, bound in free.items():
        count = rows if side.endswith("g") else len(x0)
        bounds[side] = np.broadcast_to(np.asarray(given.pop(side, bound), float), count)
    lists = {
        f"{v}_names": given.pop(f"{v}_names", [f"{v}[{i}]" for i in range(n)])
        for v, n in (("x", len(x0)), ("g", rows))
    }
    names = {key: partial(list, words) for key, words in lists.items()}
    rest = {"theta": {}, "hessian_kind": "exact", **given}
    return NLP(name, tuple(groups), x0, **bounds, **names, **rest)


def write_sx_nl(path: Path, problem: dict[str, ca.SX], **given: object) -> NLFile:
    """Write a problem in the form of nlpsol as one kernel with one row; see `plain_nlp`."""
    x, f, g = problem["x"], problem["f"], problem.get("g", ca.SX(0, 1))
    n, m, none = x.numel(), g.numel(), ca.SX(0, 1)
    kernel = Kernel("nlp", x, none, none, objective=f, constraints=g if m else None)
    groups = [Group(kernel, np.arange(n)[None], np.zeros((1, 0)), np.arange(m)[None])]
    return write_nl(path, plain_nlp("plain", groups, **{"x0": np.zeros(n), **given}))


def defined_variables(file: NLFile) -> list[int]:
    """Those of the header by use: both, rows, objective (several), one row, the objective only."""
    return [int(word) for word in file.path.read_text().splitlines()[9].split("\t")[0].split()]


class ReadBack:
    """A .nl file as CasADi reads it: sizes, bounds, start and derivatives of its own."""

    def __init__(self, path: Path) -> None:
        builder = ca.NlpBuilder()
        builder.import_nl(str(path), {})
        self.x0 = np.array(builder.x_init)
        self.lbx, self.ubx = np.array(builder.x_lb), np.array(builder.x_ub)
        self.lbg, self.ubg = np.array(builder.g_lb), np.array(builder.g_ub)
        x = ca.vertcat(*builder.x)
        f, g = builder.f, ca.vertcat(*builder.g)
        # SX is quicker to differentiate
        plain = ca.Function("nl", [x], [f, ca.densify(g)]).expand()
        s = ca.SX.sym("x", x.numel())
        lam_f, lam_g = ca.SX.sym("lam_f"), ca.SX.sym("lam_g", g.numel())
        f, g = plain(s)
        self._inputs = [s, lam_f, lam_g]
        self._lagrangian = lam_f * f + (ca.dot(lam_g, g) if g.numel() else 0)
        self.values = ca.Function("v", [s], [f, g, ca.gradient(f, s), ca.jacobian(g, s)])

    @cached_property
    def hess(self) -> ca.Function:
        """The Lagrangian's Hessian at (x, lam_f, lam_g) times a vector: sooner built than whole."""
        x, v = self._inputs[0], ca.SX.sym("v", self._inputs[0].numel())
        return ca.Function(
            "h", [*self._inputs, v], [ca.jtimes(ca.gradient(self._lagrangian, x), x, v)]
        )


def close(actual: object, expected: object) -> None:
    """Equal to 1e-12 of the largest number."""
    a = np.asarray(actual, float)
    b = np.asarray(expected, float).reshape(a.shape)
    assert np.isfinite(a).all()
    assert np.abs(a - b).max(initial=0.0) <= 1e-12 * max(1.0, np.abs(b).max(initial=0.0))
