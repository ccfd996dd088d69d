"""KITTI stereo/flow 2012 and scene flow 2015, Virtual KITTI 1 and 2. Lengths are metres."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from soup_nlp.arrays import Mask
from soup_nlp.data.datasets.layout import make_pair, need, need_folder, read_if, training_folder
from soup_nlp.data.formats.camera_files import read_kitti_projections, read_vkitti2_intrinsics
from soup_nlp.data.formats.images import assumed, decode
from soup_nlp.data.formats.map_files import (
    KITTI_DISPARITY,
    read_depth_png16,
    read_kitti_flow,
    read_vkitti_depth,
    read_vkitti_flow,
)
from soup_nlp.data.pair import Float, Pair, Truth, check_size
from soup_nlp.errors import DataError
from soup_nlp.geometry.camera import intrinsics, pixel_grid, rays
from soup_nlp.storage.files import PathLike


class _Kitti(NamedTuple):
    """Folders and names of one KITTI benchmark; {} stands for occ or noc."""

    images: str
    calibration: str
    projections: tuple[str, str]
    disparities: tuple[str, str]
    layout: str


_KITTI = {
    "kitti2012": _Kitti(
        "image_0",
        "calib",
        ("P0", "P1"),
        ("disp_{}", "none"),
        "training/image_0/NNNNNN_10.png and _11.png, training/calib/NNNNNN.txt (P0, P1); optional "
        "disp_occ, disp_noc, flow_occ, flow_noc with NNNNNN_10.png",
    ),
    "kitti2015": _Kitti(
        "image_2",
        "calib_cam_to_cam",
        ("P_rect_02", "P_rect_03"),
        ("disp_{}_0", "disp_{}_1"),
        "training/image_2/NNNNNN_10.png and _11.png, training/calib_cam_to_cam/NNNNNN.txt "
        "(P_rect_02, P_rect_03); optional disp_occ_0, disp_occ_1, flow_occ, flow_noc, obj_map with "
        "NNNNNN_10.png",
    ),
}

_VKITTI = {
    "vkitti1": (
        "vkitti_*_rgb/{}/{}/{:05d}.png",
        "vkitti_*_depthgt/{}/{}/{:05d}.png",
        "vkitti_*_flowgt/{}/{}/{:05d}.png",
    ),
    "vkitti2": (
        "{}/{}/frames/rgb/Camera_0/rgb_{:05d}.jpg",
        "{}/{}/frames/depth/Camera_0/depth_{:05d}.png",
        "{}/{}/frames/forwardFlow/Camera_0/flow_{:05d}.png",
    ),
}
"""Paths of image, depth and flow; {} stands for scene, variation and frame, * for a version."""

VKITTI1_CAMERA = (725.0, 725.0, 620.5, 187.0)
"""fx, fy, cx, cy of every Virtual KITTI 1 image, pixels."""
VKITTI1_TEXT = "fx,fy,cx,cy 725,725,620.5,187, of its images of 1242 x 375"


def load_kitti(benchmark: str, root: PathLike, index: int | str, occ: bool = True) -> Pair:
    """Load a pair of KITTI: frames 10 and 11 of a sequence.

    Depth is f B / disparity. disp_occ_1 of 2015 has the disparity of the second frame at the pixels
    of the first, so with the flow it gives the scene flow, not a depth map of the next frame.

    Args:
        benchmark: "kitti2012" (grey camera 0) or "kitti2015" (colour camera 2).
        root: The dataset (with or without its folder `training`).
        index: Number of the pair, e.g. 27 or "000027".
        occ: Use the truth with occluded pixels (*_occ), else without (*_noc).

    Returns:
        Pair with the truth of the existing files: semi-dense depth and flow; `occluded` is True
        where the flow is known but absent from flow_noc; in 2015 also scene flow, and the moving
        objects of obj_map as components (0 is the static scene).

    Raises:
        DataError: an image or the calibration is missing, or a file is malformed.
    """
    own = _KITTI[benchmark]
    base = training_folder(root, own.layout)
    try:
        stem, suffix = f"{int(index):06d}", "occ" if occ else "noc"
    except ValueError:
        raise DataError(
            "KITTI pair index is not a number", found=repr(index), expected="e.g. 27 or '000027'"
        ) from None
    name = f"{stem}_10.png"
    images = [need(base / own.images / f"{stem}_{k}.png", own.layout) for k in (10, 11)]
    calibration = need(base / own.calibration / f"{stem}.txt", own.layout)
    left, right = read_kitti_projections(calibration, own.projections)
    K = left[:, :3].copy()
    focal_baseline = K[0, 0] * _baseline(left, right, calibration)
    disparities = (
        read_if(read_depth_png16, base / folder.format(suffix) / name, KITTI_DISPARITY)
        for folder in own.disparities
    )
    depth, depth_after = (None if d is None else focal_baseline / d for d in disparities)
    objects = read_if(decode, base / "obj_map" / name, "object map")
    flow, occluded = _kitti_flow(base, name, suffix)
    truth = Truth(
        depth_ref=depth,
        flow=flow,
        occluded=occluded,
        components=None if objects is None else objects.astype(np.int32),
        scene_flow=_scene_flow(K, depth, depth_after, flow, f"{base}, pair {stem}"),
    )
    return make_pair(images, [K, K], truth, f"{benchmark}_{stem}")


def _baseline(left: Float, right: Float, path: Path) -> float:
    """Baseline of two rectified projections (3, 4), metres."""
    baseline = float(left[0, 3] / left[0, 0] - right[0, 3] / right[0, 0])
    if not baseline > 0:
        raise DataError(
            "calibration gives no baseline between the stereo cameras",
            where=path,
            found=f"{baseline:g} m",
            expected="a positive length (0.53 to 0.55 m in KITTI)",
        )
    return baseline


def _kitti_flow(base: Path, name: str, suffix: str) -> tuple[Float | None, Mask | None]:
    """True flow, and where it is known but not in the non-occluded version."""
    flow = read_if(read_kitti_flow, base / f"flow_{suffix}" / name)
    visible_file = base / "flow_noc" / name
    visible = None if flow is None else read_if(read_kitti_flow, visible_file)
    if flow is None or visible is None:
        return flow, None
    check_size("flow_noc and flow_occ", visible.shape, flow.shape, visible_file)
    return flow, np.isfinite(flow[:, :, 0]) & ~np.isfinite(visible[:, :, 0])


def _scene_flow(
    K: Float, depth: Float | None, depth_after: Float | None, flow: Float | None, where: str
) -> Float | None:
    """(H, W, 3) difference of the points of a pixel, metres, where all three parts are known."""
    if depth is None or depth_after is None or flow is None:
        return None
    for disparity in (depth, depth_after):
        check_size("disparity and flow", disparity.shape, flow.shape, where)
    uv = pixel_grid(*depth.shape)
    return np.asarray(
        rays(K, uv + flow) * depth_after[:, :, None] - rays(K, uv) * depth[:, :, None]
    )


def load_vkitti(
    benchmark: str, root: PathLike, scene: str, frame: int, variation: str = "clone", step: int = 1
) -> Pair:
    """Load a pair of Virtual KITTI.

    Args:
        benchmark: "vkitti1", or "vkitti2" (left camera).
        root: Folder that holds vkitti_1.3.1_rgb and, for truth, _depthgt and _flowgt (1), or
            Scene01 and so on (2).
        scene: For example "0001" (1) or "Scene01" (2).
        frame: Number of the reference frame (the first is 0).
        variation: For example "clone", "fog".
        step: Distance of the next frame; a true flow exists for 1 only.

    Returns:
        Pair with depth of both frames and flow, if the files exist; the sky is unknown.

    Raises:
        DataError: an image or the intrinsics are missing, or a file is malformed.
    """
    image, depth, flow = _VKITTI[benchmark]
    layout = f"{image}; optional {depth}, {flow}"
    layout = layout.replace("{:05d}", "NNNNN").format(*["SCENE", "VARIATION"] * 3)
    root = need_folder(root, layout)

    def path(pattern: str, number: int) -> Path:
        head, rest = pattern.format(scene, variation, number).split("/", 1)
        return max(root.glob(head), default=root / head) / rest

    numbers = (frame, frame + step)
    images = [need(path(image, number), layout) for number in numbers]
    if benchmark == "vkitti1":
        cameras = [intrinsics(*VKITTI1_CAMERA)] * 2
        assumed(root, "Virtual KITTI 1 has no file of its camera", VKITTI1_TEXT)
    else:
        table = need(root / scene / variation / "intrinsic.txt", layout)
        cameras = read_vkitti2_intrinsics(table, numbers)
    truth = Truth(
        depth_ref=read_if(read_vkitti_depth, path(depth, frame)),
        depth_next=read_if(read_vkitti_depth, path(depth, frame + step)),
        flow=read_if(read_vkitti_flow, path(flow, frame) if step == 1 else None),
    )
    return make_pair(images, cameras, truth, f"{benchmark}_{scene}_{variation}_{frame:05d}")
