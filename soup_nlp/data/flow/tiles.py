"""Flow of small surfaces that move farther than a coarse-to-fine search follows.

At the coarse scales at which a large displacement is small, a small surface has vanished. Tiles of
the image without usable flow are therefore searched for in the next image, each by itself. The
matches become flow only where several tests agree, since a wrong flow costs more than none: a match
is distinct and mutual, neighbouring tiles agree, the flow that begins at their displacement closes
its round trip on most of their area, and it ends where no flow known before ends. This last test
rejects what is hidden in the next image: what looks like it there is mostly explained already.
"""

from collections.abc import Callable

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from soup_nlp.arrays import FloatMap, Image
from soup_nlp.data.flow.consistency import confidence_of, round_trip_error, sampled
from soup_nlp.geometry.graph import connected

LEAST_SHRINK, SEARCH_SIDE = 2, 768
"""The images are searched at half their size, or smaller: at most at this longer side, pixels."""
TILE, STEP = 24, 6
"""Side of a tile and distance between tiles, pixels of the shrunk images."""
REACH = 0.25
"""Largest displacement along either axis that is tried, longer sides of the image."""
CONTRAST = 5.0
"""Least standard deviation of a tile, grey levels."""
PEAK, DISTINCT, BESIDE = 0.8, 0.1, 4
"""Least normalised cross-correlation of a match, and by how much it must exceed the correlation at
all displacements that differ by more than `BESIDE` pixels along an axis."""
MUTUAL, AGREE = 1.0, 3.0
"""Largest round-trip error of a match, and largest difference between the displacements of
neighbouring tiles of one surface, shrunk pixels."""
GROUP = 6
"""Least number of tiles of a surface."""
CONFIRMED = 2 / 3
"""Least share of the surface's pixels without usable flow at which the new flow is usable."""

_USABLE = 0.5  # confidence of a usable flow
_CLOSED = 5  # side of the square that closes gaps between the ends of a flow, pixels


def with_tiles(
    ref: Image,
    nxt: Image,
    match: Callable[[Image, Image], tuple[FloatMap, FloatMap]],
    flow: FloatMap,
    gap: FloatMap,
) -> tuple[FloatMap, FloatMap]:
    """A flow, completed by that of surfaces whose tiles match far away.

    Args:
        ref: (H, W) grey reference image.
        nxt: (H', W') grey next image.
        match: The flow method, which gives the flow in both directions.
        flow: (H, W, 2) flow, pixels.
        gap: (H, W) its round-trip error, pixels.

    Returns:
        (H, W, 2) flow and (H, W) its round-trip error, both in pixels.
    """
    confidence = confidence_of(gap)
    lost = confidence <= _USABLE
    shrink = max(LEAST_SHRINK, -(-max(ref.shape) // SEARCH_SIDE))
    surfaces = _surfaces(_matched(ref, nxt, lost, shrink))
    if not surfaces:
        return flow, gap
    taken = _ends(flow, ~lost, nxt.shape)
    flow, gap = flow.copy(), gap.copy()
    for surface in sorted(surfaces, key=len, reverse=True):
        corners = surface[:, :2] * shrink
        shift = np.rint(np.median(surface[:, 2:], axis=0) * shrink).astype(int)
        here, there = _windows(corners, TILE * shrink, shift, ref.shape, nxt.shape)
        new, back = match(np.ascontiguousarray(ref[here]), np.ascontiguousarray(nxt[there]))
        new_gap = round_trip_error(new, back)
        new = new + shift.astype(np.float32)
        new_confidence = confidence_of(new_gap)
        y, x = (np.asarray(p, np.float32) for p in np.mgrid[here])
        free = sampled(taken, x + new[..., 0], y + new[..., 1]) < 0.5
        found = lost[here] & free & (new_confidence > confidence[here])
        area = np.zeros(ref.shape, bool)
        for u, v in corners:
            area[v : v + TILE * shrink, u : u + TILE * shrink] = True
        area &= lost
        if (found & (new_confidence > _USABLE))[area[here]].sum() < CONFIRMED * area.sum():
            continue
        flow[here][found], gap[here][found] = new[found], new_gap[found]
        confidence[here][found] = new_confidence[found]
        # the next surface is compared with this one
        lost = confidence <= _USABLE
        taken = _ends(flow, ~lost, nxt.shape)
    return flow, gap


def _matched(ref: Image, nxt: Image, lost: NDArray[np.bool_], shrink: int) -> NDArray[np.int_]:
    """(n, 4) corners (u, v) and displacements of tiles with a match, shrunk pixels."""
    scale, kind = 1 / shrink, cv2.INTER_AREA
    a, b = (cv2.resize(image, None, fx=scale, fy=scale, interpolation=kind) for image in (ref, nxt))
    share = cv2.resize(lost.astype(np.float32), a.shape[::-1], interpolation=kind)
    reach = int(REACH * max(a.shape))
    out = []
    for v in range(0, a.shape[0] - TILE + 1, STEP):
        for u in range(0, a.shape[1] - TILE + 1, STEP):
            tile = slice(v, v + TILE), slice(u, u + TILE)
            if share[tile].mean() < 0.5 or a[tile].std() < CONTRAST:
                continue
            x, y, peak, second = _best(b, a[tile], u, v, reach)
            if peak < PEAK or peak - second < DISTINCT:
                continue
            back_x, back_y, *_ = _best(a, b[y : y + TILE, x : x + TILE], x, y, reach)
            if np.hypot(back_x - u, back_y - v) <= MUTUAL:
                out.append((u, v, x - u, y - v))
    return np.array(out, int).reshape(-1, 4)


def _best(image: Image, tile: Image, u: int, v: int, reach: int) -> tuple[int, int, float, float]:
    """Corner of the best match of a tile near (u, v), its correlation, and the best one elsewhere.

    The correlation is -1 where the image has no room for the tile.
    """
    rows, columns = (
        slice(min(max(0, at - reach), end), max(0, min(end, at + TILE + reach)))
        for at, end in zip((v, u), image.shape, strict=True)
    )
    region = image[rows, columns]
    if min(region.shape) < TILE:
        return u, v, -1.0, -1.0
    correlation = cv2.matchTemplate(region, tile, cv2.TM_CCOEFF_NORMED)
    _, peak, _, (x, y) = cv2.minMaxLoc(correlation)
    near = slice(max(0, y - BESIDE), y + BESIDE + 1), slice(max(0, x - BESIDE), x + BESIDE + 1)
    correlation[near] = -1.0
    return columns.start + x, rows.start + y, peak, float(correlation.max())


def _surfaces(matches: NDArray[np.int_]) -> list[NDArray[np.int_]]:
    """Groups of overlapping or touching tiles with similar displacements (`AGREE`)."""
    if len(matches) < GROUP:
        return []
    tree = scipy.spatial.cKDTree(matches[:, :2])
    links = tree.query_pairs(TILE // 2, p=np.inf, output_type="ndarray")
    gap = np.linalg.norm(np.diff(matches[links, 2:], axis=1)[:, 0], axis=1)
    label = connected(links[gap <= AGREE], len(matches))
    groups = [matches[label == i] for i in range(label.max() + 1)]
    return [group for group in groups if len(group) >= GROUP]


def _ends(flow: FloatMap, usable: NDArray[np.bool_], shape: tuple[int, ...]) -> FloatMap:
    """(H', W') map of the next image, 1 where a usable flow ends and 0 elsewhere."""
    v, u = np.nonzero(usable)
    x, y = np.rint(flow[usable] + np.stack([u, v], axis=-1)).astype(int).T
    ends = np.zeros(shape, np.float32)
    ends[y.clip(0, shape[0] - 1), x.clip(0, shape[1] - 1)] = 1.0
    square = np.ones((_CLOSED, _CLOSED), np.uint8)
    return np.asarray(cv2.morphologyEx(ends, cv2.MORPH_CLOSE, square), np.float32)


def _windows(
    corners: NDArray[np.int_],
    side: int,
    shift: NDArray[np.int_],
    shape: tuple[int, ...],
    next_shape: tuple[int, ...],
) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Rows and columns around tiles with a margin, in both images before and after a shift."""
    size, next_size = np.array(shape[::-1]), np.array(next_shape[::-1])
    low = np.maximum(np.maximum(corners.min(axis=0) - side // 2, 0), -shift)
    high = np.minimum(corners.max(axis=0) + side + side // 2, np.minimum(size, next_size - shift))
    here, there = (
        tuple(slice(a, b) for a, b in zip((low + move)[::-1], (high + move)[::-1]))
        for move in (0 * shift, shift)
    )
    return here, there
