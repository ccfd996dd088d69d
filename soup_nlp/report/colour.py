"""Depth, error, flow, normals and superpixels in colour, (H, W, 3) uint8 RGB.

Unknown values are grey, which none of the colour scales contains; unusable flow is black.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import AnyFloat, Image, Mask

UNKNOWN = 150
"""Grey level of unknown values."""

VIVID = (
    *((255, 127, 14), (44, 160, 44), (214, 39, 40), (148, 103, 189), (140, 86, 75)),
    *((227, 119, 194), (188, 189, 34), (23, 190, 207), (31, 119, 180)),
)
"""Colours of tab10 without its grey, which means unknown."""

PALE = 0.35
"""Share of its colour that the depth of a guess keeps; the rest is white."""
LEAST_RANGE = 1.1
"""Least ratio of the two ends of a colour scale of depth.

Bending papers have a relief of 7 to 27 %, guesses without parallax mostly one of 0 to 5 %.
"""


def depth_range(depth: AnyFloat) -> tuple[float, float]:
    """(near, far) of the colour scale of a depth map: its 2nd and 98th percentile.

    They are at least a tenth apart, so that a nearly constant depth has nearly one colour.

    Args:
        depth: (H, W) z; values that are not finite or not positive are left out.

    Returns:
        near < far, in the unit of the depth; (1, 2) if no depth is known.
    """
    z = np.asarray(depth, np.float64)
    z = z[np.isfinite(z) & (z > 0)]
    if z.size == 0:
        return 1.0, 2.0
    near, far = (float(x) for x in np.percentile(z, (2.0, 98.0)))
    if far < near * LEAST_RANGE:
        middle, half = np.sqrt(near * far), np.sqrt(LEAST_RANGE)
        near, far = float(middle / half), float(middle * half)
    return near, far


def colourise_depth(depth: AnyFloat, near: float, far: float, guess: Mask | bool = False) -> Image:
    """Depth in colour by even steps of 1/z: near is red, far is blue; pale where it is a guess.

    Args:
        depth: (H, W) z; grey where not finite or not positive.
        near: Depth of the near end.
        far: Depth of the far end.
        guess: (H, W) True where the depth is a guess.
    """
    z = np.asarray(depth, np.float64)
    known = np.isfinite(z) & (z > 0)
    safe = np.clip(np.where(known, z, near), near, far)
    colours = _paint((1 / safe - 1 / far) / (1 / near - 1 / far), known, "turbo")
    colours[known & guess] = 255 - PALE * (255 - colours[known & guess])
    return colours


def component_colours(count: int) -> Image:
    """(count, 3) colours of components: slate for the first, vivid colours for the others."""
    vivid = np.array(VIVID, float)
    turns = np.arange(max(count - 1, 0))
    faded = 0.75 ** (turns // len(vivid))[:, None]
    return np.vstack([[[126, 150, 190]], vivid[turns % len(vivid)] * faded]).astype(np.uint8)[
        :count
    ]


def colourise_shares(values: AnyFloat, limit: float, name: str) -> Image:
    """Numbers (H, W) from 0 to a limit and above in a map of OpenCV, grey where not finite."""
    known = np.isfinite(values)
    return _paint(np.clip(np.where(known, values, 0.0) / limit, 0.0, 1.0), known, name)


def _paint(level: NDArray[np.float64], known: Mask, name: str) -> Image:
    """(H, W, 3) colours of levels (H, W) in [0, 1] by a map of OpenCV, grey where not known."""
    steps = (level * 255).round().astype(np.uint8)
    out = cv2.applyColorMap(steps, getattr(cv2, f"COLORMAP_{name.upper()}"))[..., ::-1]
    return np.where(known[..., None], out, np.uint8(UNKNOWN))


def flow_limit(uv: AnyFloat) -> float:
    """Length, pixels, of full saturation of a flow (H, W, 2), NaN where unknown.

    It is the longest, but at most 1.5 times the 99th percentile.
    """
    length = np.hypot(uv[..., 0], uv[..., 1])
    length = length[np.isfinite(length)]
    if not length.size:
        return 1.0
    return max(float(min(length.max(), 1.5 * np.percentile(length, 99))), 1e-6)


def colourise_flow(uv: AnyFloat, limit: float) -> Image:
    """Flow (H, W, 2) in colour: hue is direction, red to the right; white is no motion.

    Colours are full from the length `limit`, pixels; black where the flow is not finite.
    """
    known: Mask = np.asarray(np.isfinite(uv).all(axis=2))
    u, v = np.moveaxis(np.where(known[..., None], uv, 0.0), 2, 0)
    hue = np.degrees(np.arctan2(v, u)) % 360
    length = np.minimum(np.hypot(u, v) / limit, 1.0)
    hsv = np.stack([hue, length, known], axis=2).astype(np.float32)
    return np.asarray(np.rint(255 * cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)), np.uint8)


def colourise_normals(n_map: AnyFloat) -> Image:
    """Unit normals (H, W, 3) in colour: (x, -y, -z) from [-1, 1] to RGB, grey where not finite."""
    known: Mask = np.asarray(np.isfinite(n_map).all(axis=2))
    signed = np.where(known[:, :, None], n_map, 0.0) * np.array([1.0, -1.0, -1.0])
    out = ((np.clip(signed, -1, 1) + 1) * 127.5).round().astype(np.uint8)
    out[~known] = UNKNOWN
    return np.asarray(out)


def draw_superpixels(image: Image, labels: NDArray[np.integer]) -> Image:
    """The (H, W, 3) image with the boundaries of the labels (H, W) in yellow, one pixel wide."""
    edge = np.zeros(labels.shape, bool)
    edge[:, :-1] |= labels[:, :-1] != labels[:, 1:]
    edge[:-1] |= labels[:-1] != labels[1:]
    out = image.copy()
    out[edge] = (255, 255, 0)
    return out
