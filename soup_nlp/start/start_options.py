"""Options of the initialisation in a problem file."""

from typing import Literal

from soup_nlp.schema.section import NonNegative, Section, Seed, Whole


class StartOptions(Section):
    """How the initialisation is made."""

    method: Literal["shared", "homography"] = "shared"
    """shared (every superpixel takes one of the motions of the whole image) or homography (the
    paper's: epipolar geometry and homography of every superpixel, equal scales)."""
    bending: bool = True
    """Whether surfaces may bend; if false, everything is rigid."""
    upright: bool = True
    """Whether the image is upright, so that components stand on what is below them. If false, a
    component is scaled by its whole outline."""
    ground: bool = True
    """Use the ground of an upright image, a level plane on which much of the scene lies: unreliable
    depths and components below it are lifted."""


HOMOGRAPHY = {"samples": 100, "threshold_px": 0.5}
"""Values of `SeededStart` for the paper's method."""


class SeededStart(StartOptions):
    """StartOptions with the seed, which a problem has once, and what is no option of a problem."""

    seed: Seed = 0
    """Seed of sampling."""
    samples: Whole = 40
    """Sampled pixels per superpixel."""
    threshold_px: NonNegative = 1.0
    """Inlier distance of a motion, pixels."""
    discontinuity_px: NonNegative = 1.0
    """Jump of the flow between two neighbours at which a surface ends, pixels."""
