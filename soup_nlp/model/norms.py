"""Un-squared norms and truncations in the form that a solver can take.

A term of the energy is a sum of `weight * ((1 - leak) min(|vector|, sigma) + leak |vector|)`. The
exact sum is the energy that is reported; a solver gets `sqrt(|vector|^2 + eps^2) - eps` for a norm.
"""

from dataclasses import dataclass
from typing import Literal

import casadi as ca


@dataclass(frozen=True)
class Norm:
    """One robust norm `weight * ((1 - leak) min(|vector|, sigma) + leak |vector|)` of a kernel.

    Attributes:
        weight: Scalar expression.
        vector: Column expression.
        eps: Smoothing length of |.| in the vector's unit (a parameter of the NLP).
        sigma: Truncation, or None when there is none.
        leak: Share that is not truncated.
        kind: "norm" for |v|; "half_square" for |v|^2 / 2, smooth as it is.
    """

    weight: ca.SX
    vector: ca.SX
    eps: ca.SX
    sigma: ca.SX | None = None
    kind: Literal["norm", "half_square"] = "norm"
    leak: ca.SX | float = 0.0


def smooth_min(y: ca.SX, sigma: ca.SX, width: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Smooth `min(y, sigma)` that is 0 at y = 0, and its derivative in (0, 1).

    `(y + sigma - sqrt((y - sigma)^2 + width^2)) / 2`, shifted by its value at 0.
    """
    root = ca.sqrt((y - sigma) ** 2 + width**2)
    at_zero = (sigma - ca.sqrt(sigma**2 + width**2)) / 2
    return (y + sigma - root) / 2 - at_zero, (1 - (y - sigma) / root) / 2


def solver_form(norm: Norm, x: ca.SX, theta: ca.SX) -> tuple[ca.SX, ca.SX]:
    """The norm as a solver sees it, and its positive semidefinite majorant.

    The majorant is one over all local variables x of the kernel; `theta` is the share of the
    curvature along the residual that it leaves out (0: reweighted least squares, 1: Newton's; see
    docs/solving.md).
    """
    v = norm.vector
    J = ca.jacobian(v, x)
    square = ca.dot(v, v)
    root = ca.sqrt(square + norm.eps**2)
    half = norm.kind == "half_square"
    y, dy = (square / 2, ca.SX(1.0)) if half else (root - norm.eps, 1 / root)
    value, slope = y, ca.SX(1.0)
    if norm.sigma is not None:
        # a corner as sharp as eps would be as stiff as the norm itself
        cut, slope = smooth_min(y, norm.sigma, ca.fmax(norm.eps, 0.3 * norm.sigma))
        # near its corner a truncated norm is concave along the residual: there only the full
        # reweighted curvature still bounds it from above
        theta = theta * slope**2
        value, slope = (1 - norm.leak) * cut + norm.leak * y, norm.leak + (1 - norm.leak) * slope
    outer = ca.mtimes(J.T, J)
    if not half:
        along = ca.mtimes(J.T, v / root)
        outer = outer - theta * ca.mtimes(along, along.T)
    return norm.weight * value, norm.weight * slope * dy * outer
