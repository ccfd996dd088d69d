"""Confidence of a flow from its forward-backward consistency, and plausibility of imported flows.

Imported flows that do not belong to their images, or are in other units, are detected: the next
image is warped by the flow. With a correct flow, the warped image differs from the reference image
at most half as much as without a flow (16 pairs, rendered and real); with a wrong flow, as much or
more.
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, FloatMap, Image
from soup_nlp.data.pair import Flow, Pair
from soup_nlp.errors import DataError
from soup_nlp.geometry.camera import pixel_grid

SUPPORT = 15
"""Side of the window over which the round-trip error is averaged, pixels: a wrong flow may be
consistent at a single pixel, but rarely in a whole window."""
SURE = 0.5
"""Confidence above which a flow counts as right."""
LIMIT, MOST = 3.0, 5.0
"""Round-trip error, pixels, above which a flow is not used: its confidence would be 0.0001; and
largest error that counts in the mean of a window."""


def round_trip_error(forward: FloatMap, backward: FloatMap) -> FloatMap:
    """(H, W) distance of each pixel to its image under the forward, then the backward flow, pixels.

    It is infinite where the forward flow (H, W, 2) leaves the second image, or where it or the
    backward flow (H', W', 2) is not finite.
    """
    pixel = pixel_grid(*forward.shape[:2])
    target = pixel + forward
    # False for NaN
    fits = (target >= 0) & (target <= np.subtract(backward.shape[1::-1], 1))
    inside = np.asarray(fits.all(axis=2))
    at = np.where(inside[..., None], target, 0.0).astype(np.float32)
    gap = at + sampled(backward, at[..., 0], at[..., 1]) - pixel.astype(np.float32)
    error = np.hypot(gap[..., 0], gap[..., 1])
    error[~inside | ~np.isfinite(error)] = np.inf
    return np.asarray(error, dtype=np.float32)


def sampled(image: NDArray[Any], x: FloatMap, y: FloatMap) -> FloatMap:
    """(H, W) or (H, W, C) values of an image at pixels (x, y) of (H, W); the border repeats."""
    values = np.ascontiguousarray(image, dtype=np.float32)
    kind, border = cv2.INTER_LINEAR, cv2.BORDER_REPLICATE
    return np.asarray(cv2.remap(values, x, y, kind, borderMode=border))


def confidence_of(gap: FloatMap, support: int = SUPPORT) -> FloatMap:
    """(H, W) confidence in [0, 1] of a round-trip error.

    With e the error and E the larger of e and the mean of min(e, `MOST`) over a window of `support`
    pixels (odd), the confidence is `exp(-E^2)`, E in pixels, and 0 where E > `LIMIT`.
    """
    gap = np.maximum(gap, cv2.blur(np.minimum(gap, MOST), (support, support)))
    confidence = np.exp(-np.square(np.minimum(gap, LIMIT)), dtype=np.float32)
    confidence[~(gap <= LIMIT)] = 0.0
    return np.asarray(confidence, dtype=np.float32)


BETTER, FLAT = 0.8, 0.02
"""Ratio of two photometric errors below which the changed flow is clearly better, and photometric
error, standard deviations of grey, below which images agree with every flow."""
MOST_PIXELS = 250_000
"""Largest number of pixels that are compared."""


def check_flow(flow: Flow, pair: Pair, *, backward: bool = False) -> None:
    """Compare the images of a pair along a flow that was not computed here.

    It is a DataError if it is in another order, direction or unit, leads out of the image, or is
    worse than no flow. One from the next to the reference image, `backward`, may be wrong in parts,
    which the round trip finds.
    """
    if backward:
        pair = Pair(pair.image_next, pair.image_ref, pair.K_next, pair.K_ref)
    step = 1 + int(np.sqrt(flow.confidence.size / MOST_PIXELS))
    height, width = pair.size
    v, u = (x.astype(np.float32) for x in np.mgrid[0:height:step, 0:width:step])
    uv, usable = flow.uv[::step, ::step], flow.confidence[::step, ::step] > 0
    ref, following = _grey(pair.image_ref)[::step, ::step], _grey(pair.image_next)

    def differences(uv: FloatMap | Float) -> FloatMap:
        """Difference of every pixel and its target; NaN where unknown or outside."""
        x, y = (np.asarray(p + uv[..., k], np.float32) for k, p in enumerate((u, v)))
        inside = (x >= 0) & (y >= 0) & (x < following.shape[1]) & (y < following.shape[0])
        gap = np.minimum(np.abs(sampled(following, x, y) - ref), 1.0)
        return np.where(usable & inside, gap, np.nan)

    def mean(of: FloatMap, other: FloatMap) -> float:
        """Mean over the pixels that have both differences; infinite if these are few."""
        both = np.isfinite(of) & np.isfinite(other)
        return float(of[both].mean()) if both.sum() > 0.2 * usable.sum() else np.inf

    along = differences(uv)
    # without motion a pixel keeps its ray
    A = (pair.K_next @ np.linalg.inv(pair.K_ref))[:2]
    at = np.stack([u, v], axis=-1)
    without = differences(at @ A[:, :2].T + A[:, 2] - at)
    problem, hint, least = "", "", BETTER
    if not backward and mean(without, without) < BETTER * mean(along, along):
        problem = "flow does not fit the images: it is worse than no flow"
        hint = "is it of these two images, in this order, in pixels?"
    for cause, changed in _changes(uv, pair).items():
        new = differences(changed)
        # a pixel that leaves the image along either flow is not compared
        both = [(mean(new, old), mean(old, new)) for old in (along, without)]
        relative = max((a / b if b > FLAT else 1.0 for a, b in both if a < np.inf), default=np.inf)
        if relative < least:
            problem, hint, least = "flow does not fit the images", f"it does {cause}", relative
    if problem:
        raise DataError(
            problem,
            where=flow.source,
            found=f"difference of the images {mean(along, along):.3f} along the flow,"
            f" {mean(without, without):.3f} without a flow",
            expected="displacements (u right, v down) in pixels, to the other image",
            hint=hint,
        )


def _grey(image: Image) -> FloatMap:
    """(H, W) blurred grey values in standard deviations from their mean."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    grey = cv2.GaussianBlur(grey, (0, 0), 2.0)
    return np.asarray((grey - grey.mean()) / max(float(grey.std()), 1.0), np.float32)


def _changes(uv: FloatMap, pair: Pair) -> dict[str, FloatMap | Float]:
    """Flows that would be right if the imported flow had one of the usual mistakes."""
    size = np.array(pair.size[::-1], np.float64)
    return {
        "with its channels u and v exchanged": uv[..., ::-1],
        "with both signs changed: it may be of the other direction (backward)": -uv,
        "with the sign of v changed: its axis may point up": uv * [1.0, -1.0],
        "times the image's size: it may be relative to it": uv * size,
        "times half the image's size: it may be relative to it": uv * size / 2,
        **{
            f"times {x:.3g}: it may be of another resolution": uv * x
            for x in (1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 2, 2, 3, 4)
        },
    }
