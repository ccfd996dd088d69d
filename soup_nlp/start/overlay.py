"""Regions that stand still in the image of a moving camera: bonnet, logo, text, dirt on the lens.

They are fixed to the camera, or move as it does, so that their flow shows neither depth nor the
camera's motion. A distant region stands still as well, but its depth under the camera's motion
explains that. The flow of a fixed region contradicts every depth.
"""

import numpy as np

from soup_nlp.arrays import Float, Mask
from soup_nlp.start.components import connected_labels
from soup_nlp.start.labelling import PIECE_SIZE, dominant
from soup_nlp.start.views import FlowFit

STILL_PX = 1.0
"""Mean displacement up to which a superpixel may stand still, pixels: it may reflect movers."""
CONTRADICTED_PX = 0.5
"""Least error of the best depth, pixels, beside the displacement."""
LEAST_SCENE = 0.6
"""Least share of the superpixels that the camera's motion explains; below it, the
still part may be the scene."""
LEAST_STILL = 0.5
"""Least share of still superpixels in a piece with continuous flow."""


def fixed_to_camera(flow: FlowFit) -> tuple[Mask, Float]:
    """(N,) True where the image stands still, which the camera's motion contradicts.

    Nothing does between frames with different intrinsics.

    Returns:
        The mask, and (N,) the mean displacement of every superpixel, pixels.
    """
    seg, views, usable = flow.seg, flow.views, flow.views.usable
    none, shift = np.zeros(len(seg), bool), views.distance(views.ray)
    may = usable & (shift < STILL_PX)
    if may.sum() < PIECE_SIZE or not np.array_equal(flow.K_ref, flow.K_next):
        return none, shift
    camera = dominant(flow.without(may | ~usable))
    error = views.fit([camera]).penalised()[:, 0]
    if (error[usable] < CONTRADICTED_PX).sum() < LEAST_SCENE * usable.sum():
        return none, shift
    may &= error - shift > CONTRADICTED_PX
    moves = ~usable | (error > CONTRADICTED_PX)
    continuous = flow.jump < flow.options.discontinuity_px
    piece = connected_labels(moves[seg.pairs].all(axis=1) & continuous, seg)
    count, still_count = (np.bincount(piece, m, minlength=len(seg)) for m in (usable & moves, may))
    mostly = (still_count >= PIECE_SIZE) & (still_count >= LEAST_STILL * count)
    return may & mostly[piece], shift
