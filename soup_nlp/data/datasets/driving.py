"""KITTI stereo/flow 2012 and scene flow 2015, Virtual KITTI 1 and 2. Lengths are metres."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from soup_nlp.data.datasets.layout import need, need_folder, optional, truth_or_none
from soup_nlp.data.formats.camera_files import (
    calib_entry,
    read_kitti_calib,
    read_vkitti2_intrinsics,
    vkitti1_intrinsics,
)
from soup_nlp.data.formats.depth_files import read_kitti_disparity, read_vkitti_depth
from soup_nlp.data.formats.flow_files import read_kitti_flow, read_vkitti_flow
from soup_nlp.data.formats.images import PathLike, decode, read_image
from soup_nlp.data.pair import Pair, Truth
from soup_nlp.errors import DataError

Float = NDArray[np.float64]

KITTI2012_LAYOUT = (
    "training/image_0/NNNNNN_10.png and _11.png, training/calib/NNNNNN.txt (P0, P1); optional "
    "disp_occ, disp_noc, flow_occ, flow_noc with NNNNNN_10.png"
)
KITTI2015_LAYOUT = (
    "training/image_2/NNNNNN_10.png and _11.png, training/calib_cam_to_cam/NNNNNN.txt (P_rect_02, "
    "P_rect_03); optional disp_occ_0, disp_occ_1, flow_occ, flow_noc, obj_map with NNNNNN_10.png"
)
VKITTI1_LAYOUT = (
    "vkitti_*_rgb/WORLD/VARIATION/NNNNN.png; optional vkitti_*_depthgt, vkitti_*_flowgt likewise"
)
VKITTI2_LAYOUT = (
    "SCENE/VARIATION/intrinsic.txt, SCENE/VARIATION/frames/rgb/Camera_C/rgb_NNNNN.jpg; optional "
    "frames/depth/Camera_C/depth_NNNNN.png, frames/forwardFlow/Camera_C/flow_NNNNN.png"
)


def _kitti_base(root: PathLike, layout: str) -> Path:
    root = need_folder(root, layout)
    return root / "training" if (root / "training").is_dir() else root


def _kitti_flow(
    base: Path, name: str, suffix: str
) -> tuple[Float | None, NDArray[np.bool_] | None]:
    """True flow, and where it is known but not in the non-occluded version."""
    file = optional(base / f"flow_{suffix}" / name)
    if file is None:
        return None, None
    flow = read_kitti_flow(file).astype(np.float64)
    visible_file = optional(base / "flow_noc" / name)
    if visible_file is None:
        return flow, None
    visible = np.isfinite(read_kitti_flow(visible_file)[:, :, 0])
    if visible.shape != flow.shape[:2]:
        raise DataError(
            "flow_occ and flow_noc differ in size",
            where=visible_file,
            found=visible.shape,
            expected=flow.shape[:2],
        )
    return flow, np.isfinite(flow[:, :, 0]) & ~visible


def _baseline(P_left: Float, P_right: Float, path: Path) -> float:
    """Baseline of two rectified projections, metres."""
    baseline = float(P_left[0, 3] / P_left[0, 0] - P_right[0, 3] / P_right[0, 0])
    if not baseline > 0:
        raise DataError(
            "calibration gives no baseline between the stereo cameras",
            where=path,
            found=f"{baseline:g} m",
            expected="a positive length (0.53 to 0.55 m in KITTI)",
        )
    return baseline


def load_kitti2012(root: PathLike, index: int | str, occ: bool = True) -> Pair:
    """Load a pair of KITTI stereo/flow 2012 (grey camera 0, frames 10 and 11).

    Depth is f B / disparity with B = -P1[0, 3] / f from the calibration.

    Args:
        root: The dataset (with or without its folder `training`).
        index: Number of the pair, e.g. 27 or "000027".
        occ: Take the truth that includes occluded pixels (disp_occ, flow_occ); else *_noc.

    Returns:
        Pair with semi-dense depth and flow truth where the files exist. `occluded` marks pixels
        whose flow is known but absent from flow_noc; False elsewhere, also where nothing is known.

    Raises:
        DataError: an image or the calibration is missing, or a file is wrong for its format.
    """
    base = _kitti_base(root, KITTI2012_LAYOUT)
    stem, suffix = _stem(index), "occ" if occ else "noc"
    image_ref, image_next = [
        read_image(need(base / "image_0" / f"{stem}_{k}.png", KITTI2012_LAYOUT)) for k in (10, 11)
    ]
    calib_file = need(base / "calib" / f"{stem}.txt", KITTI2012_LAYOUT)
    calib = read_kitti_calib(calib_file)
    P0, P1 = (calib_entry(calib, name, (3, 4), calib_file) for name in ("P0", "P1"))
    K = P0[:, :3].copy()
    disparity_file = optional(base / f"disp_{suffix}" / f"{stem}_10.png")
    flow, occluded = _kitti_flow(base, f"{stem}_10.png", suffix)
    depth = None
    if disparity_file is not None:
        depth = K[0, 0] * _baseline(P0, P1, calib_file) / read_kitti_disparity(disparity_file)
    truth = Truth(depth_ref=depth, flow=flow, occluded=occluded)
    return Pair(
        image_ref, image_next, K, K.copy(), truth=truth_or_none(truth), name=f"kitti2012_{stem}"
    )


def load_kitti2015(root: PathLike, index: int | str, occ: bool = True) -> Pair:
    """Load a pair of KITTI scene flow 2015 (colour camera 2, frames 10 and 11).

    Depth is f B / disparity. disp_occ_1 holds the second frame's disparity at the pixels of the
    first, so with the flow it gives the true scene flow, not a depth map of the next frame.

    Args:
        root: The dataset (with or without its folder `training`).
        index: Number of the pair, e.g. 8 or "000008".
        occ: Take the truth that includes occluded pixels; else *_noc.

    Returns:
        Pair with the truth whose files exist: depth, flow, occluded (as `load_kitti2012`), scene
        flow, and the moving objects of obj_map as components (0 is the static scene).

    Raises:
        DataError: an image or the calibration is missing, or a file is wrong for its format.
    """
    base = _kitti_base(root, KITTI2015_LAYOUT)
    stem, suffix = _stem(index), "occ" if occ else "noc"
    name = f"{stem}_10.png"
    image_ref, image_next = [
        read_image(need(base / "image_2" / f"{stem}_{k}.png", KITTI2015_LAYOUT)) for k in (10, 11)
    ]
    calib_file = need(base / "calib_cam_to_cam" / f"{stem}.txt", KITTI2015_LAYOUT)
    calib = read_kitti_calib(calib_file)
    P2, P3 = (calib_entry(calib, key, (3, 4), calib_file) for key in ("P_rect_02", "P_rect_03"))
    K = P2[:, :3].copy()
    fB = K[0, 0] * _baseline(P2, P3, calib_file)
    files = [optional(base / f"disp_{suffix}_{k}" / name) for k in (0, 1)]
    depth, depth_after = (fB / read_kitti_disparity(f) if f else None for f in files)
    flow, occluded = _kitti_flow(base, name, suffix)
    scene_flow = None
    if depth is not None and depth_after is not None and flow is not None:
        if not depth.shape == depth_after.shape == flow.shape[:2]:
            raise DataError(
                "disparities and flow differ in size",
                where=f"{base}, pair {stem}",
                found=f"{depth.shape}, {depth_after.shape}, {flow.shape[:2]}",
            )
        v, u = np.mgrid[: depth.shape[0], : depth.shape[1]].astype(np.float64)
        before = _backproject(K, u, v, depth)
        scene_flow = _backproject(K, u + flow[:, :, 0], v + flow[:, :, 1], depth_after) - before
    objects = optional(base / "obj_map" / name)
    truth = Truth(
        depth_ref=depth,
        flow=flow,
        occluded=occluded,
        components=decode(objects, "object map").astype(np.int32) if objects else None,
        scene_flow=scene_flow,
    )
    return Pair(
        image_ref, image_next, K, K.copy(), truth=truth_or_none(truth), name=f"kitti2015_{stem}"
    )


def _backproject(K: Float, u: Float, v: Float, z: Float) -> Float:
    """(H, W, 3) points of pixels (u, v) at depth z."""
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(K).T
    return np.asarray(rays * z[:, :, None])


def _stem(index: int | str) -> str:
    """The six digits of a KITTI file name."""
    try:
        return f"{int(index):06d}"
    except ValueError:
        raise DataError(
            "KITTI pair index is not a number", found=repr(index), expected="e.g. 27 or '000027'"
        ) from None


def load_vkitti1(
    root: PathLike, world: str, frame: int, variation: str = "clone", step: int = 1
) -> Pair:
    """Load a pair of Virtual KITTI 1.

    Args:
        root: Folder that holds vkitti_1.3.1_rgb and, for truth, _depthgt and _flowgt.
        world: For example "0001".
        frame: Number of the reference frame (the first is 0).
        variation: For example "clone", "fog".
        step: Distance of the next frame; truth flow exists for 1 only.

    Returns:
        Pair with depth of both frames and flow where the files exist; sky is unknown.

    Raises:
        DataError: an image is missing, or a file is wrong for its format or its image.
    """
    root = need_folder(root, VKITTI1_LAYOUT)
    parts = {part: _vkitti1_part(root, part) for part in ("rgb", "depthgt", "flowgt")}
    names = [f"{world}/{variation}/{number:05d}.png" for number in (frame, frame + step)]
    image_ref, image_next = [
        read_image(need(parts["rgb"] / name, VKITTI1_LAYOUT)) for name in names
    ]
    depths = [optional(parts["depthgt"] / name) for name in names]
    flow = optional(parts["flowgt"] / names[0]) if step == 1 else None
    K = vkitti1_intrinsics()
    return Pair(
        image_ref,
        image_next,
        K,
        K.copy(),
        truth=_vkitti_truth(depths, flow),
        name=f"vkitti1_{world}_{variation}_{frame:05d}",
    )


def _vkitti1_part(root: Path, part: str) -> Path:
    """The folder of one archive, of any version."""
    found = sorted(root.glob(f"vkitti_*_{part}"))
    return found[-1] if found else root / f"vkitti_1.3.1_{part}"


def _vkitti_truth(depths: list[Path | None], flow: Path | None) -> Truth | None:
    return truth_or_none(
        Truth(
            depth_ref=read_vkitti_depth(depths[0]) if depths[0] else None,
            depth_next=read_vkitti_depth(depths[1]) if depths[1] else None,
            flow=read_vkitti_flow(flow).astype(np.float64) if flow else None,
        )
    )


def load_vkitti2(
    root: PathLike,
    scene: str,
    frame: int,
    variation: str = "clone",
    camera: int = 0,
    step: int = 1,
) -> Pair:
    """Load a pair of Virtual KITTI 2.

    Args:
        root: Folder that holds Scene01 and so on.
        scene: For example "Scene01".
        frame: Number of the reference frame (the first is 0).
        variation: For example "clone", "fog".
        camera: 0 (left) or 1 (right).
        step: Distance of the next frame; truth flow exists for 1 only.

    Returns:
        Pair with depth of both frames and flow where the files exist; sky is unknown.

    Raises:
        DataError: an image, intrinsic.txt or a row of it is missing, or a file is wrong.
    """
    base = need_folder(root, VKITTI2_LAYOUT) / scene / variation
    numbers = (frame, frame + step)

    def path(kind: str, stem: str, number: int, suffix: str) -> Path:
        return base / "frames" / kind / f"Camera_{camera}" / f"{stem}_{number:05d}{suffix}"

    image_ref, image_next = [
        read_image(need(path("rgb", "rgb", n, ".jpg"), VKITTI2_LAYOUT)) for n in numbers
    ]
    table_file = need(base / "intrinsic.txt", VKITTI2_LAYOUT)
    table = read_vkitti2_intrinsics(table_file)
    for number in numbers:
        if (number, camera) not in table:
            raise DataError(
                "intrinsics of the frame are missing",
                where=table_file,
                found=f"{len(table)} rows",
                expected=f"a row of frame {number}, camera {camera}",
            )
    depths = [optional(path("depth", "depth", n, ".png")) for n in numbers]
    flow = optional(path("forwardFlow", "flow", frame, ".png")) if step == 1 else None
    return Pair(
        image_ref,
        image_next,
        table[frame, camera],
        table[frame + step, camera],
        truth=_vkitti_truth(depths, flow),
        name=f"vkitti2_{scene}_{variation}_{frame:05d}",
    )
