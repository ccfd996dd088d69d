"""Flows, superpixels and planes for tests of the initialisation."""

from typing import Any

import numpy as np
from helpers_model import GREY, motion, with_true_flow
from numpy.typing import NDArray
from scipy import ndimage

from soup_nlp.config.problem import Problem, make_problem
from soup_nlp.data.flow.sources import flow_from_truth
from soup_nlp.data.pair import Pair
from soup_nlp.data.scenes.catalogue import placed, render_scene
from soup_nlp.data.scenes.raycast import Body, Frame, Part, Scene, render
from soup_nlp.data.scenes.surfaces import Box, Plane
from soup_nlp.geometry import camera
from soup_nlp.geometry.graph import Segmentation, build_segmentation
from soup_nlp.geometry.soup import Soup
from soup_nlp.geometry.superpixels import segment, split_components
from soup_nlp.start.views import FlowFit, StartOptions, Views

Float = NDArray[np.float64]

CORNER_K = camera.intrinsics(180.0, 180.0, 95.5, 71.5)
CAMERA, WEDGE = motion((0.5, -1.5, 0.3), (0.35, 0.05, 0.1)), motion((0, 3, 0), (-0.15, 0.02, 0.1))
"""Intrinsics and motions of `corner`."""


def corner(
    camera_motion: Float = CAMERA, wedge: Float | None = None, count: int = 48
) -> tuple[Pair, Segmentation, NDArray[np.bool_]]:
    """Floor and two walls that meet in a corner, at 192 x 144 pixels.

    Args:
        camera_motion: (4, 4) next_from_ref of the room.
        wedge: Motion of a wedge of two planes, if there is one, before the camera moves.
        count: About how many superpixels, before they are cut along the outlines of planes.

    Returns:
        The pair with its exact flow, the superpixels, and which of them lie on one plane.
    """
    walls = [placed(0, 0, 6.0, yaw=35), placed(0, 0, 6.0, yaw=-45)]
    walls.append(placed(0, 0, 0.0, pitch=-90) @ placed(0, 0, -1.2))
    bodies = [Body(tuple(Part(Plane(), pose, GREY) for pose in walls))]
    if wedge is not None:
        half = Box((0.7, 0.8, 1e-6))
        poses = [placed(0, 0, 3.0, yaw=10 + 40 * s) @ placed(0.7 * s, 0, 0) for s in (-1, 1)]
        bodies.append(Body(tuple(Part(half, pose, GREY) for pose in poses), wedge))
    scene = Scene(tuple(bodies), np.eye(4), camera_motion)
    pair = with_true_flow(render(scene, CORNER_K, 144, 192))
    view = Frame(scene, CORNER_K, 0)
    part = view.trace(camera.pixel_grid(144, 192).reshape(-1, 2))[1].reshape(144, 192)
    cells = segment(pair.image_ref, count, "grid")
    labels = split_components(cells * len(view.parts) + part.astype(np.int32), 40)
    spread = ndimage.labeled_comprehension(
        part, labels, np.arange(labels.max() + 1), np.ptp, int, 0
    )
    return pair, build_segmentation(labels, pair.image_ref, neighbours=10), spread == 0


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


def scene_problem(
    scene: str, width: int, height: int, superpixels: int, *overrides: str, seed: int = 0
) -> Problem:
    """A rendered scene with its true flow."""
    source = {"kind": "scene", "scene": scene, "seed": seed, "width": width, "height": height}
    parts = {"flow": {"source": "truth"}, "segmentation": {"superpixels": superpixels}}
    return make_problem({"input": source, **parts}, overrides)


def fitted(pair: Pair, seg: Segmentation, seed: int = 0, **options: Any) -> FlowFit:
    """The flow of a pair in superpixels, with options of the start."""
    return FlowFit.of(seg, pair.flow, pair.K_ref, pair.K_next, StartOptions(**options), seed)


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
    affine, own = np.zeros((n, 3, 2)), StartOptions(**options)
    return FlowFit(seg, K, K, own, 0, views, none > 0, affine, none, weight[:, 0], jump)
