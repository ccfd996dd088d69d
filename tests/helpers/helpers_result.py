"""A small result by hand: a wall, and a board before it that moves by itself."""

from dataclasses import replace

import numpy as np

from soup_nlp.evaluation.metrics import depth_metrics
from soup_nlp.geometry.camera import intrinsics
from soup_nlp.geometry.components import find_components
from soup_nlp.geometry.graph import build_segmentation
from soup_nlp.geometry.rotation import RigidMotion, exp
from soup_nlp.geometry.soup import Soup, reconstruct
from soup_nlp.report.result import Result

K = intrinsics(100.0, 100.0, 39.5, 29.5)
CAMERA = RigidMotion(exp([0.0, 0.01, 0.0]), np.array([0.05, 0.02, -0.1]))
BOARD = RigidMotion(exp([0.0, 0.0, 0.05]), np.array([-0.1, 0.0, -0.1]))
"""next_from_ref."""
WALL_Z, BOARD_Z = 4.0, 2.0
CERTAINTY = {"measured": 1.0, "inferred": 0.0, "drawn": 0.0, "median_sigma": 0.07}
"""The shares of `report.verdict.certainty`."""
START = {"bends": np.zeros(12), "interpolated": np.zeros(12), "parallax": np.full(12, 5.0)}
START |= {"origin": np.where(np.isin(np.arange(12), (5, 6)), 1, 0)}


def board() -> np.ndarray:
    """(60, 80) where the board is."""
    out = np.zeros((60, 80), bool)
    out[20:40, 20:60] = True
    return out


def small_result() -> Result:
    """60 x 80 pixels in 12 superpixels of 20 x 20, all planes parallel to the image."""
    v, u = np.mgrid[0:60, 0:80]
    labels = (4 * (v // 20) + u // 20).astype(np.int32)
    image = np.stack([3 * u, 4 * v, 200 - u - v], axis=2).astype(np.uint8)
    seg = build_segmentation(labels, image, neighbours=3)
    mine = np.isin(np.arange(12), (5, 6))
    motions = [BOARD if m else CAMERA for m in mine]
    R, t = (np.array([getattr(m, name) for m in motions]) for name in ("R", "t"))
    soup = Soup(np.ones(12), np.tile([0.0, 0.0, -1.0], (12, 1)), np.where(mine, 2.0, 4.0), R, t)
    flow = {"flow": np.zeros((60, 80, 2)), "confidence": (u / 100).astype(np.float32)}
    pair = {"image_ref": image, "image_next": image[::-1].copy(), "K_ref": K, "K_next": K}
    return Result(
        tree={"input": {**pair, **flow}, "start": START, "truth": {}},
        summary={"name": "board", "certainty": CERTAINTY},
        reconstruction=replace(reconstruct(soup, labels, K, K), sigma_ref=0.001 * (u + v)),
        components=find_components(soup, seg, mine.astype(int), K, K),
        metrics={"solution": depth_metrics(1.0, 10.0)},
        kind=np.zeros((60, 80), np.uint8),
    )


def toy_pairs() -> list[Result]:
    """Two pairs of frames 0, 1, 2; the wall comes nearer by CAMERA, and units differ by 2."""
    first = small_result()
    # seen from frame 1 the scene is the next frame of the first pair
    depth, second = first.depths[1], first.scaled(0.5)
    known, source = np.isfinite(depth), second.reconstruction.source_next
    lost = (source < 0) | ~known.ravel()[source]
    rec = replace(
        second.reconstruction,
        depth_ref=0.5 * depth,
        depth_next=np.where(lost, np.nan, second.depths[1]),
        labels=first.in_next(first.labels, 0),
        source_next=np.where(lost, -1, source),
        sigma_ref=np.where(known, second.sigma, np.nan),
    )
    parts = replace(second.components, of_pixel=first.in_next(first.components.of_pixel, 0))
    return [first, replace(second, reconstruction=rec, components=parts)]
