"""Options of the solver: stages, tolerances, limits."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from soup_nlp.schema.section import Count, NonNegative, Positive, Section, Tolerance, Whole


class SolverOptions(Section):
    """Stages of a solve; eps are smoothing widths in the energy's units (pixels by default).

    The presolve is a descent in tangent coordinates (`solve.descent`). Its reweighted phases narrow
    the smoothing until the energy stagnates: their quadratic model lies above every norm, so that
    full steps descend. Its last phase uses the exact Hessian and converges quadratically. Without
    the presolve, Ipopt takes these steps (`solve.continuation`), with Gauss-Newton stages between
    the two. Ipopt then solves the constrained NLP from this point and its multipliers.
    """

    presolve: bool = True
    """A Newton method of this package takes the steps of all stages but the last; if false, Ipopt
    does."""
    continuation: bool = True
    """If false, and without `presolve`, Ipopt solves the constrained NLP at the final smoothing at
    once."""
    presolve_eps: Annotated[tuple[Positive, ...], Field(strict=False, min_length=1)] = (
        0.3,
        0.03,
        0.01,
    )
    """Smoothing widths of the stages with the majorant Hessian, decreasing."""
    presolve_iterations: Whole = 60
    """Iteration limit of each of these stages and of the Gauss-Newton ones."""
    stagnation: NonNegative = 1e-3
    """Relative change of f that ends a majorant stage if it occurs twice in a row; for Gauss-Newton
    stages a tenth and a thousandth of it."""
    untruncated: bool = False
    """The majorant stages also run with a second strategy, which truncates E_arap only at its
    end, and the result with the lower energy is taken; always on where surfaces bend."""
    polish_iterations: Count = 100
    """Iteration limit of the stage with the exact Hessian, at `eps`; 0 omits it and those of
    Gauss-Newton."""
    presolve_tol: Tolerance = 1e-7
    """Dual infeasibility that ends the stages before the constrained NLP."""
    eps: Tolerance = 0.01
    """Smoothing of the constrained NLP."""
    max_iter: Count = 30
    """Iteration limit of the constrained NLP; 0 omits Ipopt's continuation as well."""
    far_iterations: Count = 5
    """Iteration limit of the constrained NLP if the stages before it ended far from a minimum:
    Ipopt does not find one from there either, and each of its iterations takes seconds."""
    tol: Tolerance = 1e-6
    """Tolerance of the constrained NLP."""
    max_seconds: Tolerance = 600.0
    """Time limit of all stages together."""
    ipopt: dict[str, bool | int | float | str] = Field(default_factory=dict)
    """Further Ipopt options of the constrained NLP."""
