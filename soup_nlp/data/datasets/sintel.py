"""MPI Sintel (Butler et al., ECCV 2012) with its depth and camera extension."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from soup_nlp.data.datasets.layout import need, need_folder, optional, truth_or_none
from soup_nlp.data.flow.sources import leaves
from soup_nlp.data.formats.camera_files import intrinsics, read_cam
from soup_nlp.data.formats.depth_files import read_dpt
from soup_nlp.data.formats.flow_files import read_flo
from soup_nlp.data.formats.images import DataWarning, PathLike, read_image, read_mask
from soup_nlp.data.pair import Pair, Truth
from soup_nlp.errors import DataError

LAYOUT = (
    "training/{clean,final,albedo}/SCENE/frame_NNNN.png; optional "
    "camdata_left/SCENE/frame_NNNN.cam, depth/SCENE/frame_NNNN.dpt, "
    "flow/SCENE/frame_NNNN.flo, occlusions/SCENE/frame_NNNN.png, invalid/SCENE/frame_NNNN.png"
)

DEFAULT_CAMERA = (688.00006, 688.00006, 511.5, 217.5)
"""fx, fy, cx, cy of `DEFAULT_SCENE`, pixels. Other scenes have other focal lengths (some 1120)."""

DEFAULT_SCENE = "alley_1"


def load_sintel(
    root: PathLike,
    scene: str,
    frame: int,
    render: str = "clean",
    step: int = 1,
    K: NDArray[np.floating] | None = None,
) -> Pair:
    """Load a pair of MPI Sintel; depth is in the scene's unit (metres by its authors).

    Args:
        root: The dataset (with or without its folder `training`).
        scene: For example "alley_1".
        frame: Number of the reference frame as in its file name (the first is 1).
        render: Render pass, "clean", "final" or "albedo".
        step: Distance of the next frame; truth flow exists for 1 only.
        K: (3, 3) intrinsics of both frames, for a dataset without `camdata_left`. Without either,
            `DEFAULT_CAMERA` is taken, which is right for alley_1 but may be wrong elsewhere.

    Returns:
        Pair with the truth whose files exist. `occluded` is the occlusion mask and every pixel
        whose flow leaves the image; pixels of the mask `invalid` have no true flow.

    Raises:
        DataError: an image is missing, or a file is wrong for its format or its image.

    Warns:
        DataWarning: neither `K` nor a camera file is there, and the scene is not alley_1.
    """
    root = need_folder(root, LAYOUT)
    base = root / "training" if (root / "training").is_dir() else root
    names = [f"{scene}/frame_{number:04d}" for number in (frame, frame + step)]
    image_ref, image_next = (
        read_image(need(base / render / f"{name}.png", LAYOUT)) for name in names
    )
    if K is None:
        cameras = _cameras([base / "camdata_left" / f"{name}.cam" for name in names], scene)
    else:
        cameras = [np.asarray(K, dtype=np.float64)] * 2
    depths = [optional(base / "depth" / f"{name}.dpt") for name in names]
    flow_file = optional(base / "flow" / f"{names[0]}.flo") if step == 1 else None
    mask_file = optional(base / "occlusions" / f"{names[0]}.png") if step == 1 else None
    invalid_file = optional(base / "invalid" / f"{names[0]}.png") if step == 1 else None
    flow = read_flo(flow_file).astype(np.float64) if flow_file else None
    occluded = read_mask(mask_file) if mask_file else None
    if flow is not None and occluded is not None:
        _same_size(occluded, flow, mask_file)
        occluded |= np.isfinite(flow[:, :, 0]) & leaves(flow, image_next.shape[:2])
    if flow is not None and invalid_file is not None:
        invalid = read_mask(invalid_file)
        _same_size(invalid, flow, invalid_file)
        flow[invalid] = np.nan
    truth = Truth(
        depth_ref=read_dpt(depths[0]) if depths[0] else None,
        depth_next=read_dpt(depths[1]) if depths[1] else None,
        flow=flow,
        occluded=occluded,
    )
    return Pair(
        image_ref=image_ref,
        image_next=image_next,
        K_ref=cameras[0],
        K_next=cameras[1],
        truth=truth_or_none(truth),
        name=f"sintel_{scene}_{frame:04d}",
    )


def _cameras(paths: list[Path], scene: str) -> list[NDArray[np.float64]]:
    """Intrinsics of the frames; those of alley_1, with a warning elsewhere, where a file is not."""
    absent = [path for path in paths if not optional(path)]
    if absent and scene != DEFAULT_SCENE:
        warnings.warn(
            f"no camera file {absent[0]}: the focal length of {DEFAULT_SCENE} is taken,"
            f" {DEFAULT_CAMERA[0]:g} pixels, which may be wrong for {scene}; camdata_left comes"
            " with Sintel's depth training data",
            DataWarning,
            stacklevel=3,
        )
    return [intrinsics(*DEFAULT_CAMERA) if p in absent else read_cam(p)[0] for p in paths]


def _same_size(mask: NDArray[np.bool_], flow: NDArray[np.float64], path: Path | None) -> None:
    """Raise DataError unless a mask has the size of the flow."""
    if mask.shape != flow.shape[:2]:
        raise DataError(
            "mask and flow differ in size", where=path, found=mask.shape, expected=flow.shape[:2]
        )
