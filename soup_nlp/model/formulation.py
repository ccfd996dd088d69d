"""How the energy is written for a solver: gauge, Hessian, smoothing."""

from typing import Annotated, Literal

from pydantic import Field

from soup_nlp.model.kernel import Hessian
from soup_nlp.model.layout import Gauge
from soup_nlp.schema.section import MOST, NonNegative, Section, Share


class FormulationOptions(Section):
    """Formulation of the NLP for a solver."""

    gauge: Gauge = "unit-offset"
    """unit-offset or unit-translation."""
    min_facing: Annotated[float, Field(ge=0, le=0.5)] = 1e-3
    """Visibility: lower bound c of -n . r; with 0 the depth at a rim pixel has no bound either."""


Coordinates = Literal["matrix", "tangent"]
"""matrix: rotations, normals, scales and translations with their constraints. tangent: nine
coordinates per superpixel about the proposal, in which SO(3) and unit normals hold."""


UNBOUNDED = 1e6
"""Of `depth_ratio`: no bound."""


class Formulation(FormulationOptions):
    """A formulation with what belongs to a stage of the solver: smoothing, coordinates, Hessian."""

    hessian: Hessian = "exact"
    """exact, gauss-newton or gauss-newton+constraints."""
    theta: Share = 0.9
    """Share of curvature along a residual that the Gauss-Newton Hessian leaves out."""
    ridge: NonNegative = 1e-2
    """Added to the Gauss-Newton Hessian's diagonal."""
    depth_ratio: Annotated[float, Field(ge=1.01, le=MOST)] = 5.0
    """Depth at a rim pixel is at most this many times the anchor's (1 leaves one plane only)."""
    coordinates: Coordinates = "matrix"
    """matrix or tangent; a gauge is of matrices only."""
    eps: NonNegative = 1e-2
    """Smoothing of lengths and rotations, in the energy's unit (pixels by default)."""
    eps_pixel: NonNegative = 1e-2
    """Smoothing of re-projection errors, pixels."""
