"""How the energy is written for a solver: gauge, norm, truncation, Hessian, smoothing."""

from __future__ import annotations

from dataclasses import dataclass

from soup_nlp.model.layout import Gauge
from soup_nlp.model.norms import NormForm, TruncationForm


@dataclass(frozen=True)
class Formulation:
    """How the energy is written for a solver.

    Attributes:
        gauge: "unit-offset", "unit-translation" or "free".
        norm: "smooth" (sqrt(|v|^2 + eps^2) - eps) or "epigraph" (slack s in the objective as
            s - eps, |v|^2 + eps^2 <= s^2): one minimum; with eps = 0 the latter is the exact norm,
            but has no independent gradients where a norm is 0.
        truncation: "smooth" or "lifted" (z in [0, 1], exact).
        hessian: "exact", "gauss-newton" or "gauss-newton+constraints".
        eps: Smoothing of lengths and rotations, in the energy's unit (pixels by default).
        eps_pixel: Smoothing of re-projection errors, pixels.
        theta: Share of curvature along a residual that the Gauss-Newton Hessian leaves out.
        ridge: Added to the Gauss-Newton Hessian's diagonal.
        min_facing: Visibility: lower bound c of -n . r.
        depth_ratio: Depth at a rim pixel is at most this many times the anchor's.
        compiled: Compile kernels where a C compiler is found.
    """

    gauge: Gauge = "unit-offset"
    norm: NormForm = "smooth"
    truncation: TruncationForm = "smooth"
    hessian: str = "exact"
    eps: float = 1e-2
    eps_pixel: float = 1e-2
    theta: float = 0.9
    ridge: float = 1e-2
    min_facing: float = 1e-3
    depth_ratio: float = 5.0
    compiled: bool = True
