"""Options of the initialisation in a problem file."""

from __future__ import annotations

from typing import Literal

from soup_nlp.schema.section import Count, NonNegative, Samples, Section, Seed, Whole


class StartOptions(Section):
    """How the initialisation is made."""

    method: Literal["shared", "homography"] = "shared"
    """shared (every superpixel takes one of the motions of the whole image) or homography (the
    paper's: epipolar geometry and homography of every superpixel, equal scales)."""
    motion_neighbours: Count = 15
    """With homography: number of nearest neighbours whose flow is used for the motion of a
    superpixel, as in the paper for small ones; with 0 its own homography is decomposed."""
    samples: Samples = 40
    """Sampled pixels per superpixel."""
    dominant: Whole = 5
    """Largest number of dominant motions."""
    threshold_px: NonNegative = 1.0
    """Inlier distance of a motion, pixels."""
    smoothness: NonNegative = 0.5
    """Price of different motions of two neighbours with continuous flow, pixels."""
    min_parallax_px: NonNegative = 0.25
    """Parallax below which the depth of a superpixel is borrowed from its neighbours, pixels."""
    rounds: Count = 3
    """Rounds of candidate motions from unexplained pieces and from neighbours."""
    unexplained_px: NonNegative = 0.1
    """Error below which a superpixel does not look for another motion, pixels."""
    pieces: Whole = 6
    """Largest number of unexplained pieces that get candidate motions in a round."""
    piece_size: Whole = 4
    """Least number of superpixels of a piece."""
    bending: bool = True
    """Whether surfaces may bend (`start.regions`); if false, everything is rigid."""
    discontinuity_px: NonNegative = 1.0
    """Jump of the flow between two neighbours at which a surface ends, pixels."""
    upright: bool = True
    """Whether the image is upright, so that components stand on what is below them. If false, a
    component is scaled by its whole outline."""
    ground: bool = True
    """Use the ground of an upright image, a level plane on which much of the scene lies: unreliable
    depths and components below it are lifted, and regions that float above it are lowered."""


class SeededStart(StartOptions):
    """StartOptions with the seed, which a problem has once for all its stages."""

    seed: Seed = 0
    """Seed of sampling and RANSAC."""
