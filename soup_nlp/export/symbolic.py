"""The NLP of a problem for `casadi.nlpsol`: symbols, bounds, start, derivatives."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float
from soup_nlp.config.problem import Problem, load_problem
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.formulation import Coordinates
from soup_nlp.model.kernel import Hessian
from soup_nlp.model.layout import Layout
from soup_nlp.model.nlp import NLP
from soup_nlp.pipeline.case import prepare
from soup_nlp.pipeline.record import Case
from soup_nlp.solve.functions import Functions


@dataclass(frozen=True, eq=False)
class SymbolicNLP:
    """min f(x, p) subject to lbg <= g(x, p) <= ubg, lbx <= x <= ubx, in CasADi's words.

    Attributes:
        case: Images, flow, superpixels, initialisation and energy.
        record: Kernels, tables, bounds and names.
        layout: Turns x into soups.
        x: (nx,) variables.
        p: (nt,) parameters: smoothing widths, theta and ridge.
        f: The smoothed energy, an expression of x and p.
        g: (ng,) constraints, expressions of x and p.
        functions: The same functions in machine code.
    """

    case: Case
    record: NLP
    layout: Layout
    x: ca.MX
    p: ca.MX
    f: ca.MX
    g: ca.MX
    functions: Functions

    @property
    def problem(self) -> dict[str, ca.MX]:
        """x, p, f, g: the third argument of `nlpsol`."""
        return {"x": self.x, "p": self.p, "f": self.f, "g": self.g}

    @property
    def derivatives(self) -> dict[str, ca.Function]:
        """Options of `nlpsol` that spare it the derivation, while this object exists."""
        return self.functions.derivatives

    @property
    def start(self) -> dict[str, Float]:
        """x0, p and the bounds: what the solver is called with."""
        names = ("x0", "lbx", "ubx", "lbg", "ubg")
        return {"p": self.parameters(), **{name: getattr(self.record, name) for name in names}}

    def parameters(self, **theta: float) -> Float:
        """(nt,) values of p with other smoothing: `eps`, `eps_pixel` (pixels), `theta`, `ridge`.

        Raises:
            ModelError: another name.
        """
        return self.record.thetas(**theta)

    def soup(self, x: ca.DM | Float) -> Soup:
        """Planes and motions of a point."""
        return self.layout.unpack(np.asarray(x, float).ravel())


def nlp(
    problem: str | Path | Problem,
    *,
    superpixels: int | None = None,
    overrides: Sequence[str] = (),
    coordinates: Coordinates = "matrix",
    hessian: Hessian = "exact",
    presolve: bool = False,
) -> SymbolicNLP:
    """The NLP of a problem, for `casadi.nlpsol` and its plug-ins.

    Args:
        problem: Name or file of a problem, or a loaded one.
        superpixels: N.
        overrides: `a.b=value`, as after `--set`.
        coordinates: "matrix": the constrained NLP (SO(3), unit normals, simplex, visibility);
            "tangent": nine coordinates per superpixel about the initialisation, in which the first
            two hold by construction; the program that `export --coordinates tangent` writes.
        hessian: Of `derivatives`; "gauss-newton" is a majorant where its theta is 0.
        presolve: Start at the presolve's answer instead of the initialisation.

    Raises:
        SoupError: the problem cannot be prepared.
    """
    if not isinstance(problem, Problem):
        more = () if superpixels is None else (f"segmentation.superpixels={superpixels}",)
        problem = load_problem(problem, [*overrides, *more])
    case = prepare(problem, presolve)
    record, layout = case.nlp(case.formulation(hessian=hessian, coordinates=coordinates))
    x, p = ca.MX.sym("x", record.nx), ca.MX.sym("p", len(record.theta))
    oracle, values = make_oracle(record)
    f, g = oracle(x, ca.vertcat(p, values[len(record.theta) :]))
    return SymbolicNLP(case, record, layout, x, p, f, g, Functions(record))


def make_oracle(nlp: NLP) -> tuple[ca.Function, Float]:
    """The sum of an NLP's kernels over their tables as a function (x, p) -> f, g.

    With it come the (np,) values of p: theta, then the data of every group, by elements. Its
    evaluation is slow, as every call copies them; `NLP.value` and the others are fast.
    """
    values = np.concatenate([nlp.thetas(), *(g.data.ravel() for g in nlp.groups)])
    x, p = ca.MX.sym("x", nlp.nx), ca.MX.sym("p", len(values))
    at = len(nlp.theta)
    theta, f = p[:at], ca.MX(0.0)
    rows, local = list[NDArray[np.integer]](), list[ca.MX]()
    for group in nlp.groups:
        size, width = group.data.shape
        data = ca.reshape(p[at : at + size * width], width, size)
        at += size * width
        own = ca.reshape(x[group.index.ravel().tolist()], group.kernel.nx, size)
        given = own, data, ca.repmat(theta, 1, size)
        functions = group.kernel.first_order()
        if "f" in functions:
            f += ca.sum2(functions["f"].map(size)(*given))
        if "con" in functions:
            rows.append(group.rows.ravel())
            local.append(ca.vec(functions["con"].map(size)(*given)))
    g = ca.MX.zeros(nlp.ng)
    if local:
        # out[rows] += local is the transposed derivative of out -> out[rows], which CasADi runs as
        # one loop; a constant 0/1 matrix takes twenty times as long to build
        out = ca.MX.sym("out", nlp.ng)
        g = ca.jtimes(out[np.concatenate(rows).tolist()], out, ca.vertcat(*local), True)
    return ca.Function("nlp", [x, p], [f, g], ["x", "p"], ["f", "g"]), values
