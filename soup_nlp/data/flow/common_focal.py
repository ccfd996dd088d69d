"""Frames of different focal lengths, in pixels: flow methods need both at one scale."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from soup_nlp.data.formats.images import DataWarning
from soup_nlp.data.pair import Flow, Pair
from soup_nlp.data.working_size import resized, resized_flow, scaled_camera

ALIKE = 1.1
"""Largest ratio of two focal lengths of which flow methods find displacements reliably."""
FEW = 0.2
"""Share of usable pixels below which the focal lengths are doubted."""


def at_common_focal(pair: Pair) -> Pair:
    """The pair with one image reduced to the focal lengths of the other one.

    The finer one is reduced, since a blurred image shifts against a sharp one. It is the same pair
    if the focal lengths differ by less than a tenth.
    """
    ratio = np.diag(pair.K_next)[1::-1] / np.diag(pair.K_ref)[1::-1]
    if 1 / ALIKE <= np.sqrt(ratio.prod()) <= ALIKE:
        return pair
    shapes = np.array([pair.image_ref.shape[:2], pair.image_next.shape[:2]])
    factors = np.minimum([ratio, 1 / ratio], 1.0)
    sizes = np.maximum(1, np.rint(shapes * factors)).astype(int)
    (ref, following), cameras = sizes, (pair.K_ref, pair.K_next)
    K_ref, K_next = (scaled_camera(*own) for own in zip(cameras, shapes, sizes))
    images = resized(pair.image_ref, ref), resized(pair.image_next, following)
    return replace(
        pair,
        image_ref=images[0],
        image_next=images[1],
        K_ref=K_ref,
        K_next=K_next,
        flow=None,
        truth=None,
    )


def in_own_pixels(flow: Flow, near: Pair, pair: Pair, compute: Callable[[Pair], Flow]) -> Flow:
    """The flow of `near`, which is `at_common_focal(pair)`, in the pixels of both frames.

    Where hardly any of it is usable, but the images match as they are, that flow (of `compute`) is
    taken.

    Warns:
        DataWarning: the images match as they are, which the focal lengths contradict.
    """
    found = resized_flow(flow, near, pair)
    if _usable(found) >= FEW:
        return found
    plain = compute(pair)
    if _usable(plain) < 2 * FEW:
        return found
    warnings.warn(
        f"the images match as they are ({_usable(plain):.0%} of the pixels), but not at their focal"
        f" lengths, {pair.K_ref[0, 0]:g} and {pair.K_next[0, 0]:g} px ({_usable(found):.0%}): these"
        " are probably wrong",
        DataWarning,
        stacklevel=2,
    )
    return plain


def _usable(flow: Flow) -> float:
    return float((flow.confidence > 0).mean())
