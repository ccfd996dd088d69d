"""Flows, superpixels and planes for tests of the initialisation."""

from typing import Any

import numpy as np
from helpers_model import corner_scene, cut_by_part, motion, with_true_flow
from numpy.typing import NDArray

from soup_nlp.data.flow.sources import flow_from_truth
from soup_nlp.data.pair import Pair
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.data.scenes.raycast import render
from soup_nlp.geometry import camera
from soup_nlp.geometry.graph import Segmentation, build_segmentation
from soup_nlp.geometry.soup import Soup
from soup_nlp.geometry.superpixels import segment
from soup_nlp.start.views import FlowFit, SeededStart, Views

Float = NDArray[np.float64]


CORNER_K = camera.intrinsics(180.0, 180.0, 95.5, 71.5)
CAMERA, WEDGE = motion((0.5, -1.5, 0.3), (0.35, 0.05, 0.1)), motion((0, 3, 0), (-0.15, 0.02, 0.1))
"""Intrinsics and motions of `corner`."""


def corner(
    camera_motion: Float = CAMERA, wedge: Float | None = None, count: int = 48
) -> tuple[Pair, Segmentation, NDArray[np.bool_]]:
    """A corner of a room, with a wedge that moves, at 192 x 144 pixels.

    Returns:
        The pair with its exact flow, superpixels cut along the outlines of planes, and which of
        them lie on one plane.
    """
    scene = corner_scene(camera_motion, wedge, turn=10)
    pair = with_true_flow(render(scene, CORNER_K, 144, 192))
    labels, pure = cut_by_part(scene, pair, count)
    return pair, build_segmentation(labels, pair.image_ref, neighbours=10), pure


def squares(rows: int, columns: int, side: int = 8, neighbours: int = 4) -> Segmentation:
    """A black image in square superpixels of `side` pixels, numbered by rows."""
    labels = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    labels = labels.repeat(side, axis=0).repeat(side, axis=1)
    return build_segmentation(labels, np.zeros((*labels.shape, 3), np.uint8), neighbours)


def facing(z: Float, T: Float) -> Soup:
    """Planes parallel to the image at depths z (N,) with translations T (3,) or (N, 3)."""
    n = len(z)
    normal, still = np.tile([0.0, 0.0, -1.0], (n, 1)), np.tile(np.eye(3), (n, 1, 1))
    return Soup(np.full(n, 1 / n), normal, n * z, still, np.broadcast_to(n * T, (n, 3)))


def rendered(
    scene: str, seed: int, width: int, height: int, count: int
) -> tuple[Pair, Segmentation]:
    """A rendered pair with its true flow as a solve sees it, in about `count` superpixels."""
    pair = render_scene(scene, seed, width, height)
    labels = segment(pair.image_ref, count)
    return pair.with_flow(flow_from_truth(pair)), build_segmentation(labels, pair.image_ref)


def fitted(pair: Pair, seg: Segmentation, **options: Any) -> FlowFit:
    """The flow of a pair in superpixels, with options of the start."""
    return FlowFit.of(seg, pair.flow, pair.K_ref, pair.K_next, SeededStart(**options))


def flow_of(
    seg: Segmentation,
    jump: np.ndarray | float = 0.0,
    usable: np.ndarray | None = None,
    K: np.ndarray | None = None,
    **options: bool,
) -> FlowFit:
    """A flow that jumps by (P,) pixels, known in the superpixels `usable` (N,); all without it."""
    n = len(seg)
    K = np.eye(3) if K is None else K
    weight = np.ones((n, 1)) if usable is None else usable[:, None].astype(float)
    anchor, none = camera.rays(K, seg.anchors), np.zeros(n)
    views = Views(anchor[:, None], anchor[:, None], weight, anchor, np.ones(n), np.ones(2))
    jump = np.broadcast_to(jump, len(seg.pairs))
    affine, own = np.zeros((n, 3, 2)), SeededStart(**options)
    return FlowFit(seg, K, K, own, views, none > 0, affine, none, weight[:, 0], jump)
