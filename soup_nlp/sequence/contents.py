"""What chain.json holds, as far as it is read back."""

from typing import Annotated

from annotated_types import Len
from pydantic import NonNegativeInt
from typing_extensions import TypedDict

Two = Annotated[list[NonNegativeInt], Len(2, 2)]
"""Frames of a pair, or two pairs."""
Row = Annotated[list[float], Len(4, 4)]


class Scaled(TypedDict):
    """A pair of consecutive frames."""

    pair: Two
    scale: float


class Linked(TypedDict):
    """A link between two pairs, see `report.chain.Link`."""

    pairs: Two
    ratio: float
    spread: float
    pixels: int
    bridge: bool
    flagged: bool


class Tracked(TypedDict):
    """A component that is followed."""

    path: dict[str, list[float]]


class TrueLink(TypedDict):
    """A link by the truth."""

    pairs: Two
    true: float


class PathError(TypedDict):
    """Error of the camera's path."""

    share: float
    ate: float
    rpe: float
    rpe_degrees: float


class Score(TypedDict):
    """Errors against the truth, see `sequence.score.score`."""

    scale: float
    mre_own_scale: float
    mre_one_scale: float
    cost: float
    links: list[TrueLink]
    path: PathError | None


class Contents(TypedDict):
    """Contents of chain.json."""

    name: str
    unit: str
    sources: list[str]
    scales: Annotated[list[Scaled], Len(1)]
    links: list[Linked]
    tracks: list[Tracked]
    world_from_camera: list[Annotated[list[Row], Len(4, 4)]]
    score: Score | None
