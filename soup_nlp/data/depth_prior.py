"""Depth priors: a depth of the reference frame from elsewhere, of a file or a network."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.data.accept import prior_of
from soup_nlp.data.flow.learned import learned_map
from soup_nlp.data.flow.sources import is_network
from soup_nlp.data.pair import Pair
from soup_nlp.errors import DataError
from soup_nlp.schema.section import Section

SAME_SHAPE = 0.02
"""Largest relative difference of the aspect ratios of a prior and its image."""


class PriorOptions(Section):
    """A depth prior of the reference frame."""

    source: str | None = None
    """File of a depth (.npy .pfm .dpt, 16-bit .png) or of a network (.onnx); null for no prior."""
    kind: Literal["metric", "relative", "inverse", "ordinal"] | None = None
    """Values: depth in the unit of length, depth up to scale, inverse depth up to scale and shift,
    or numbers that only rise with depth; null to find out by the flow, else depth up to scale."""

    def load(self, pair: Pair, path: Callable[[str], Path]) -> Pair:
        """The pair with the prior of the source, if there is one.

        Args:
            pair: Images.
            path: Resolves the name of a file.

        Raises:
            DataError: the file is damaged, or its map has another shape than the image.
        """
        if self.source is None:
            return pair
        name = str(path(self.source))
        network = is_network(name)
        found = prior_of(learned_map(name, pair.image_ref) if network else name)
        return replace(pair, depth_prior=resized_prior(found, pair, name))


def resized_prior(prior: Float, pair: Pair, where: str) -> Float:
    """A prior (H, W) of any size at that of the reference image.

    Raises:
        DataError: its aspect ratio differs from that of the image, or nothing is known.
    """
    height, width = pair.size
    if abs(np.log(prior.shape[1] * height / (prior.shape[0] * width))) > SAME_SHAPE:
        raise DataError(
            "depth prior and reference image differ in shape",
            where=where,
            found=f"{prior.shape[1]}x{prior.shape[0]} for an image of {width}x{height}",
            expected="a map of the whole image, at any size",
        )
    if not np.isfinite(prior).any():
        raise DataError("depth prior is unknown everywhere", where=where)
    if prior.shape == pair.size:
        return prior
    return np.asarray(cv2.resize(prior, (width, height), interpolation=cv2.INTER_NEAREST_EXACT))
