"""What a problem file says about the initialisation."""

from __future__ import annotations

from typing import Literal

from soup_nlp.schema.section import Count, NonNegative, Samples, Section, Seed, Whole


class StartOptions(Section):
    """How the initialisation is made."""

    method: Literal["shared", "homography"] = "shared"
    """shared (motions of the whole image, one of them for every superpixel) or homography (the
    paper's: epipolar geometry and homography of every superpixel, all scales alike)."""
    motion_neighbours: Count = 15
    """With homography: nearest neighbours whose flow helps to find the motion of a superpixel, as
    the paper has it for small ones; with 0 its own homography is decomposed."""
    samples: Samples = 40
    """Pixels per superpixel."""
    dominant: Whole = 5
    """Dominant motions looked for."""
    threshold_px: NonNegative = 1.0
    """Inlier distance of a motion, pixels."""
    smoothness: NonNegative = 0.5
    """Pixels that a border between motions must gain, where the flow does not jump."""
    min_parallax_px: NonNegative = 0.25
    """Below this the depth of a superpixel is borrowed from its neighbours."""
    rounds: Count = 3
    """Rounds of proposals from unexplained pieces, and from neighbours."""
    unexplained_px: NonNegative = 0.1
    """A superpixel whose error is below this has no need of another motion."""
    pieces: Whole = 6
    """At most this many unexplained pieces are looked at in a round."""
    piece_size: Whole = 4
    """A piece has at least this many superpixels."""
    bending: NonNegative = 0.18
    """Surfaces are taken to bend where more than this share of the superpixels moves otherwise
    than most of its own surface; 1 for never."""
    at_rest: NonNegative = 0.7
    """The camera is taken to be at rest, or to turn only, where more than this share of the usable
    pixels has no parallax: depth starts constant, as where surfaces bend; 1 for never."""
    discontinuity_px: NonNegative = 1.0
    """Where the flow of two neighbours differs by more, a surface ends."""
    upright: bool = True
    """The image's columns run down: components stand on what is below them. Off, a component is
    scaled to touch whatever it touches first."""
    ground: bool = True
    """In an upright image nothing lies below a level plane that much of the scene lies on: what has
    no depth of its own, and components, are lifted to it; what floats above it comes down."""


class SeededStart(StartOptions):
    """The same with the seed, which a problem has once for all its stages."""

    seed: Seed = 0
    """Of sampling and RANSAC."""
