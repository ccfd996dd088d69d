"""What a problem file says about the start."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class StartOptions:
    """How the start is made.

    Attributes:
        samples: Pixels per superpixel.
        dominant: Dominant motions looked for.
        threshold_px: Inlier distance of a dominant motion.
        smoothness: Pixels that a border between motions must gain, where the flow does not jump.
        min_parallax_px: Below this the depth of a superpixel is borrowed.
        rounds: Rounds of proposals from unexplained pieces, and from neighbours.
        unexplained_px: A superpixel whose error is below this has no need of another motion.
        pieces: At most this many unexplained pieces are looked at in a round.
        piece_size: A piece has at least this many superpixels.
        bending: Surfaces are taken to bend where more than this share of the superpixels moves
            otherwise than most of its own surface; 1 for never.
        tear_px: Where the flow of two neighbours differs by more, a surface ends.
        upright: The image's columns run down: bodies stand on what is below them. Off, a body is
            scaled to touch whatever it touches first.
        seed: Of sampling and RANSAC.
    """

    samples: int = 40
    dominant: int = 5
    threshold_px: float = 1.0
    smoothness: float = 0.5
    min_parallax_px: float = 0.25
    rounds: int = 3
    unexplained_px: float = 0.1
    pieces: int = 6
    piece_size: int = 4
    bending: float = 0.25
    tear_px: float = 1.0
    upright: bool = True
    seed: int = 0
