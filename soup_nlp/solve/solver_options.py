"""Options of the solver: stages, tolerances, limits."""

from collections.abc import Mapping
from typing import Annotated

from pydantic import Field

from soup_nlp.errors import ConfigError
from soup_nlp.model.formulation import Coordinates
from soup_nlp.schema.section import Count, NonNegative, Positive, Section, Tolerance

ITERATIONS = 60
"""Default iteration limit of the stages before the constrained NLP."""


def refuse_libraries(section: object, where: str) -> None:
    """Raise ConfigError for options of Ipopt by which a file could load code or write files."""
    ipopt = section.get("ipopt") if isinstance(section, Mapping) else None
    for key, value in ipopt.items() if isinstance(ipopt, Mapping) else ():
        if str(key).endswith("lib") or str(key) in ("option_file_name", "output_file"):
            raise ConfigError(
                "a problem file must not name a library or a file of Ipopt",
                where=f"{where}, key solver.ipopt.{key}",
                found=value,
                expected="options of numbers and words",
                hint=f"leave it out; --set solver.ipopt.{key}=PATH is your own word",
            )


class SolverOptions(Section):
    """Stages of a solve (`solve.presolve`, then the constrained NLP); eps are smoothing widths in
    the energy's units (pixels by default)."""

    coordinates: Coordinates = "tangent"
    """Variables of the presolve. matrix: those of the constrained NLP, on which Ipopt then iterates
    from the initialisation, at 2 to 40 times the cost (docs/solving.md)."""
    presolve_eps: Annotated[tuple[Positive, ...], Field(strict=False, min_length=1)] = (
        0.3,
        0.03,
        0.01,
    )
    """Smoothing widths of the stages with the majorant Hessian, decreasing."""
    presolve_iterations: Count = ITERATIONS
    """Iteration limit of each of these stages and of the Gauss-Newton ones; with 0 Ipopt solves the
    constrained NLP at the final smoothing at once."""
    eps: Tolerance = 0.01
    """Smoothing of the constrained NLP."""
    max_iter: Count = 10
    """Iteration limit of the constrained NLP. From a minimum of the presolve it takes next to none;
    from elsewhere it finds none, and each of them takes seconds."""
    max_seconds: Tolerance = 600.0
    """CPU time of this process that all stages together may take."""
    ipopt: dict[str, bool | int | float | str] = Field(default_factory=dict)
    """Further Ipopt options of the constrained NLP."""


class Stages(SolverOptions):
    """SolverOptions with what is no option of a problem."""

    stagnation: NonNegative = 1e-3
    """Relative change of f that ends a majorant stage if it occurs twice in a row; Gauss-Newton
    stages end at a tenth of it and less."""
    untruncated: bool = False
    """The presolve also runs a second strategy, which truncates E_arap only at its end, and the
    result with the lower energy is taken: where all surfaces bend."""
    presolve_tol: Tolerance = 1e-8
    """Dual infeasibility that ends the stages before the constrained NLP."""
    exact_iterations: Count = 100
    """Iteration limit of the stage with the exact Hessian, at `eps`; 0 omits it and those of
    Gauss-Newton."""
    tol: Tolerance = 1e-6
    """Tolerance of the constrained NLP."""
