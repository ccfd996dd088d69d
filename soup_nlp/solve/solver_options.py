"""Options of the solver: stages, tolerances, limits."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from soup_nlp.schema.section import Count, NonNegative, Positive, Section, Tolerance, Whole


class SolverOptions(Section):
    """Stages of a solve; eps are smoothing widths in the energy's units (pixels by default).

    The presolve descends on the tangent (`solve.descent`): reweighted with smaller and smaller
    smoothing until the energy stagnates, since that quadratic model lies above every norm and
    full steps descend; then with the exact Hessian, which converges quadratically. Ipopt takes
    the constrained NLP from there, its multipliers included.
    """

    presolve: bool = True
    """Run the tangent presolve; off, Ipopt alone solves the problem, see `continuation`."""
    continuation: bool = True
    """Without the presolve: Ipopt narrows the smoothing by `presolve_eps` with the majorant Hessian
    before it takes the exact one, in the presolve's coordinates; off, it starts with the
    constrained NLP at the final smoothing."""
    presolve_eps: Annotated[tuple[Positive, ...], Field(strict=False, min_length=1)] = (
        0.3,
        0.03,
        0.01,
    )
    """Continuation of the reweighted phases, large to small."""
    presolve_iterations: Whole = 60
    """Limit of each of them."""
    stagnation: NonNegative = 1e-3
    """They end at this relative change of f, twice in a row; the last at a hundredth."""
    untruncated: bool = False
    """The reweighted phases also run with a second strategy, which truncates E_arap only at its
    end, and the result with the lower energy is taken; always on where surfaces bend."""
    polish_iterations: Count = 100
    """Limit of the phase with the exact Hessian, at `eps`; 0 leaves it out."""
    presolve_tol: Tolerance = 1e-6
    """Dual infeasibility that ends the presolve."""
    eps: Tolerance = 0.01
    """Smoothing of the constrained NLP."""
    max_iter: Count = 30
    """Iteration limit of the constrained NLP; 0 leaves Ipopt's continuation out as well."""
    far_iterations: Count = 5
    """Its limit as well where the polish ended far from a minimum: from there Ipopt finds none
    either, and its iterations, of several factorisations each, take seconds."""
    tol: Tolerance = 1e-6
    """Tolerance of the constrained NLP."""
    max_seconds: Tolerance = 600.0
    """Time limit of all stages together."""
    ipopt: dict[str, bool | int | float | str] = Field(default_factory=dict)
    """Further Ipopt options of the constrained NLP."""
