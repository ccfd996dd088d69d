"""Options of the refinement, and the records of its rounds."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from soup_nlp.geometry.soup import Soup
from soup_nlp.schema.section import Count, NonNegative, Section, Tolerance


class RefineOptions(Section):
    """Discrete refinement after the NLP."""

    enabled: bool = True
    """Refine at all."""
    from_start: bool = False
    """Refine the start: the NLP is skipped."""
    rounds: Count = 4
    """Most rounds of particles."""
    particles: Annotated[int, Field(ge=2, le=1_000)] = 50
    """Labels of every superpixel, the current belief among them."""
    proposals: Literal["all", "walks"] = "all"
    """all, or walks: steps around the current belief alone, to any depth, as in the paper."""
    stagnation: NonNegative = 1e-2
    """Stop after a round that lowers the objective by less than this share; 0: never."""
    photo: NonNegative = 10.0
    """Factor of E_photo, which measures how far the images contradict a superpixel's homography;
    0 leaves the images out."""
    detail: bool = True
    """Give the pixels of rigid superpixels the depth of their own flow beside the plane, and move
    superpixels that are drawn towards their neighbours."""
    max_seconds: Tolerance = 300.0
    """CPU time of this process that the rounds together may take."""


@dataclass(frozen=True)
class Round:
    """Record of one round.

    Attributes:
        energy: Objective (`mppbp.objective`) by term after the round.
        mrf_energy: Energy of the chosen labels in the MRF.
        bound: TRW-S's lower bound on every choice among these particles.
        iterations: Iterations of TRW-S.
        status: Status of TRW-S.
        taken: Whether the choice lowered E; if not, the belief stays.
        moved: Superpixels that left their current belief.
        seconds: Wall time.
    """

    energy: Mapping[str, float]
    mrf_energy: float
    bound: float
    iterations: int
    status: str
    taken: bool
    moved: int
    seconds: float

    def __str__(self) -> str:
        return (
            f"E {self.energy['total']:.6g}, bound {self.bound:.6g}, gap {self.gap:.3g},"
            f" {self.moved} moved, {self.iterations} iterations, {self.seconds:.1f} s"
        )

    __repr__ = __str__

    @property
    def gap(self) -> float:
        """Largest excess energy of the choice over the best one among these particles."""
        return self.mrf_energy - self.bound


@dataclass(frozen=True, eq=False)
class Refined:
    """Result of the refinement.

    Attributes:
        soup: Best soup.
        energy_start: Objective (`mppbp.objective`) by term of the initialisation.
        energy_begin: Objective before the first round.
        energy: Objective of `soup`.
        rounds: Every round.
        status: "rounds" (all of them), "agreed" (one round: the images contradict the flow hardly
            anywhere), "stagnated", "interrupted" or "time limit".
        seconds: Wall time.
        contradicted: Superpixels whose flow the images contradict; E rises only there.
    """

    soup: Soup
    energy_start: Mapping[str, float]
    energy_begin: Mapping[str, float]
    energy: Mapping[str, float]
    rounds: tuple[Round, ...]
    status: str
    seconds: float
    contradicted: int = 0

    def __str__(self) -> str:
        gap = f", gap {self.rounds[-1].gap:.3g}" if self.rounds else ""
        return (
            f"Refined({self.status}, objective {self.energy_begin['total']:.5g} ->"
            f" {self.energy['total']:.5g} in {len(self.rounds)} rounds{gap}, {self.seconds:.1f} s)"
        )

    __repr__ = __str__
