"""MPI Sintel (Butler et al., ECCV 2012) with its depth and camera extension."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from soup_nlp.arrays import Mask
from soup_nlp.data.datasets.layout import make_pair, need, read_if, training_folder
from soup_nlp.data.flow.consistency import leaves
from soup_nlp.data.formats.camera_files import read_cam
from soup_nlp.data.formats.images import assumed, read_mask
from soup_nlp.data.formats.map_files import read_dpt, read_flo
from soup_nlp.data.pair import Float, Pair, Truth, check_size
from soup_nlp.geometry.camera import intrinsics
from soup_nlp.storage.files import PathLike, is_file

LAYOUT = (
    "training/{clean,final,albedo}/SCENE/frame_NNNN.png; optional "
    "camdata_left/SCENE/frame_NNNN.cam, depth/SCENE/frame_NNNN.dpt, "
    "flow/SCENE/frame_NNNN.flo, occlusions/SCENE/frame_NNNN.png, invalid/SCENE/frame_NNNN.png"
)

DEFAULT_CAMERA = (688.00006, 688.00006, 511.5, 217.5)
"""fx, fy, cx, cy of `DEFAULT_SCENE`, pixels; other scenes differ (some have 1120)."""

DEFAULT_SCENE = "alley_1"


def load_sintel(
    root: PathLike, scene: str, frame: int, render: str = "clean", step: int = 1
) -> Pair:
    """Load a pair of MPI Sintel; depth is in the scene's unit (metres by its authors).

    Args:
        root: The dataset (with or without its folder `training`).
        scene: For example "alley_1".
        frame: Number of the reference frame as in its file name (the first is 1).
        render: Render pass, "clean", "final" or "albedo".
        step: Distance of the next frame; a true flow exists for 1 only.

    Returns:
        Pair with the truth of the existing files. `occluded` is the occlusion mask and all pixels
        whose flow leaves the image; pixels of the mask `invalid` have no true flow. Without
        `camdata_left` the camera is `DEFAULT_CAMERA`.

    Raises:
        DataError: an image is missing, or a file is malformed or has a wrong size.

    Warns:
        DataWarning: there is no camera file.
    """
    base = training_folder(root, LAYOUT)
    names = [f"{scene}/frame_{number:04d}" for number in (frame, frame + step)]
    images = [need(base / render / f"{name}.png", LAYOUT) for name in names]
    depths = [read_if(read_dpt, base / "depth" / f"{name}.dpt") for name in names]
    flow, occluded = _flow_truth(base, names[0]) if step == 1 else (None, None)
    return make_pair(
        images,
        _cameras([base / "camdata_left" / f"{name}.cam" for name in names], scene),
        Truth(depths[0], depths[1], flow, occluded),
        f"sintel_{scene}_{frame:04d}",
    )


def _flow_truth(base: Path, name: str) -> tuple[Float | None, Mask | None]:
    """True flow and occlusion of a frame; None without their files."""
    flow = read_if(read_flo, base / "flow" / f"{name}.flo")
    files = [base / kind / f"{name}.png" for kind in ("occlusions", "invalid")]
    occluded, invalid = (read_if(read_mask, file) for file in files)
    if flow is None:
        return None, occluded
    for mask, file in zip((occluded, invalid), files, strict=True):
        if mask is not None:
            check_size("mask and flow", mask.shape, flow.shape, file)
    if occluded is not None:
        occluded |= np.isfinite(flow[:, :, 0]) & leaves(flow, flow.shape[:2])
    if invalid is not None:
        flow[invalid] = np.nan
    return flow, occluded


def _cameras(paths: list[Path], scene: str) -> list[Float]:
    """Intrinsics of the frames; `DEFAULT_CAMERA` with a warning if a file is missing."""
    absent = [path for path in paths if not is_file(path)]
    if absent:
        doubt = "" if scene == DEFAULT_SCENE else f", which may be wrong for {scene}"
        assumed(
            absent[0],
            "no such camera file (camdata_left comes with Sintel's depth training data)",
            f"the focal length of {DEFAULT_SCENE}, {DEFAULT_CAMERA[0]:g} pixels{doubt}",
        )
    return [intrinsics(*DEFAULT_CAMERA) if p in absent else read_cam(p) for p in paths]
