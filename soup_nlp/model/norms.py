"""Un-squared norms and truncations in the forms that a solver can take.

A term of the energy is a sum of `weight * ((1 - leak) min(|vector|, sigma) + leak |vector|)`. The
exact sum is the energy that is reported; a solver gets a smooth or an epigraph form.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import casadi as ca

NormForm = Literal["smooth", "epigraph"]
Kind = Literal["norm", "half_square"]


@dataclass(frozen=True)
class Norm:
    """One robust norm `weight * ((1 - leak) min(|vector|, sigma) + leak |vector|)` of a kernel.

    Attributes:
        name: For the names of its slack variables and constraints.
        weight: Scalar expression.
        vector: Column expression.
        eps: Smoothing length of |.| in the vector's unit (a parameter of the NLP).
        sigma: Truncation, or None when there is none.
        leak: Share that is not truncated.
        kind: "norm" for |v|; "half_square" for |v|^2 / 2, smooth as it is.
    """

    name: str
    weight: ca.SX
    vector: ca.SX
    eps: ca.SX
    sigma: ca.SX | None = None
    kind: Kind = "norm"
    leak: ca.SX | float = 0.0


class Form(NamedTuple):
    """A norm in solver form: objective, its positive semidefinite majorant over the kernel's
    variables, and the epigraph's constraint `>= 0`, if any."""

    objective: ca.SX
    curvature: ca.SX
    constraint: ca.SX | None = None


def smooth_min(y: ca.SX, sigma: ca.SX, width: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Smooth `min(y, sigma)` that is 0 at y = 0, and its derivative in (0, 1).

    `(y + sigma - sqrt((y - sigma)^2 + width^2)) / 2`, shifted by its value at 0.
    """
    root = ca.sqrt((y - sigma) ** 2 + width**2)
    at_zero = (sigma - ca.sqrt(sigma**2 + width**2)) / 2
    return (y + sigma - root) / 2 - at_zero, (1 - (y - sigma) / root) / 2


def _corner(eps: ca.SX, sigma: ca.SX) -> ca.SX:
    """Width of a truncation's corner; one as sharp as eps would be as stiff as the norm itself."""
    return ca.fmax(eps, 0.3 * sigma)


def solver_form(norm: Norm, x: ca.SX, theta: ca.SX, slack: ca.SX | None) -> Form:
    """The norm as a solver sees it.

    Args:
        norm: The robust norm.
        x: All local variables of the kernel, the slack among them.
        theta: Share of the curvature along the residual that is removed (0: reweighted least
            squares, 1: Newton's; see docs/solving.md).
        slack: Variable s >= 0 of the epigraph form, None for the smooth form.
    """
    v = norm.vector
    J = ca.jacobian(v, x)
    square = ca.dot(v, v)
    constraint = None
    if norm.kind == "half_square":
        y, dy = square / 2, ca.SX(1.0)
        outer = ca.mtimes(J.T, J)
    elif slack is not None:
        # the smooth norm's own epigraph: both have one solution, and eps = 0 is the exact norm
        y, dy = slack - norm.eps, ca.SX(1.0)
        outer = ca.SX(x.numel(), x.numel())
        constraint = slack**2 - square - norm.eps**2
    else:
        root = ca.sqrt(square + norm.eps**2)
        y, dy = root - norm.eps, 1 / root
        along = ca.mtimes(J.T, v / root)
        if norm.sigma is not None:
            # near its corner a truncated norm is concave along the residual: there only the full
            # reweighted curvature still bounds it from above
            theta = theta * smooth_min(y, norm.sigma, _corner(norm.eps, norm.sigma))[1] ** 2
        outer = ca.mtimes(J.T, J) - theta * ca.mtimes(along, along.T)
    value, slope = y, ca.SX(1.0)
    if norm.sigma is not None:
        value, slope = smooth_min(y, norm.sigma, _corner(norm.eps, norm.sigma))
        value, slope = (1 - norm.leak) * value + norm.leak * y, norm.leak + (1 - norm.leak) * slope
    return Form(norm.weight * value, norm.weight * slope * dy * outer, constraint)
