"""The same pairs mirrored and cropped: how far a figure on one pair is luck."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

from soup_nlp.bench.accuracy import Job, Row, measure
from soup_nlp.bench.pair_views import cropped, mirrored
from soup_nlp.data.pair import Pair

VIEWS: Mapping[str, Callable[[Pair], Pair] | None] = MappingProxyType(
    {
        "as it is": None,
        "mirrored": mirrored,
        "cropped 7x5": lambda pair: cropped(pair, 7, 5),
        "cropped 25x17": lambda pair: cropped(pair, 16, 11, 9, 6),
        "mirrored and cropped 7x5": lambda pair: mirrored(cropped(pair, 7, 5)),
        "mirrored and cropped 25x17": lambda pair: mirrored(cropped(pair, 16, 11, 9, 6)),
    }
)
"""What is made of a pair, by the name of a variant; columns x rows that are cut off."""


def measure_view(job: Job) -> Row:
    """One pair, changed as its variant says."""
    return measure(job, VIEWS[job.variant])
