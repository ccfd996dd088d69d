"""KITTI stereo/flow 2012 and scene flow 2015, Virtual KITTI 1 and 2, MPI Sintel, in metres."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import AfterValidator

from soup_nlp.arrays import Float, Mask
from soup_nlp.data.datasets.layout import (
    PairInput,
    Resolve,
    make_pair,
    need,
    need_folder,
    read_if,
    training_folder,
)
from soup_nlp.data.flow.consistency import leaves
from soup_nlp.data.formats.camera_files import (
    read_cam,
    read_kitti_projections,
    read_vkitti2_intrinsics,
)
from soup_nlp.data.formats.images import assumed, decode, read_mask
from soup_nlp.data.formats.map_files import (
    KITTI_DISPARITY,
    read_depth_png16,
    read_dpt,
    read_flo,
    read_kitti_flow,
    read_vkitti_depth,
    read_vkitti_flow,
)
from soup_nlp.data.pair import Pair, Truth, check_size
from soup_nlp.errors import DataError
from soup_nlp.geometry.camera import intrinsics
from soup_nlp.schema.section import Index, Whole
from soup_nlp.storage.files import is_file


class _Kitti(NamedTuple):
    """Folders and names of one KITTI benchmark."""

    images: str
    calibration: str
    projections: tuple[str, str]
    disparity: str

    @property
    def layout(self) -> str:
        """Its files, for messages."""
        return (
            f"training/{self.images}/NNNNNN_10.png and _11.png, training/{self.calibration}/"
            f"NNNNNN.txt ({', '.join(self.projections)}); optional {self.disparity}, flow_occ,"
            " flow_noc, obj_map with NNNNNN_10.png"
        )


_KITTI = {
    "kitti2012": _Kitti("image_0", "calib", ("P0", "P1"), "disp_occ"),
    "kitti2015": _Kitti("image_2", "calib_cam_to_cam", ("P_rect_02", "P_rect_03"), "disp_occ_0"),
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

SINTEL_LAYOUT = (
    "training/{clean,final,albedo}/SCENE/frame_NNNN.png; optional "
    "camdata_left/SCENE/frame_NNNN.cam, depth/SCENE/frame_NNNN.dpt, "
    "flow/SCENE/frame_NNNN.flo, occlusions/SCENE/frame_NNNN.png, invalid/SCENE/frame_NNNN.png"
)
DEFAULT_CAMERA = (688.00006, 688.00006, 511.5, 217.5)
"""fx, fy, cx, cy of `DEFAULT_SCENE`, pixels; other scenes differ (some have 1120)."""
DEFAULT_SCENE = "alley_1"


def _is_pair_number(index: str) -> str:
    if not re.fullmatch(r"[0-9]{1,6}", index):
        raise ValueError("1 to 6 digits, such as '27' or '000027'")
    return index


class KittiInput(PairInput):
    """KITTI 2012 (grey camera 0) or 2015 (colour camera 2): frames 10 and 11 of a sequence.

    Depth is f B / disparity. A pixel is occluded where the flow is known but absent from flow_noc.
    The moving objects of the obj_map of 2015 are components; 0 is the static scene.
    """

    kind: Literal["kitti2012", "kitti2015"]
    """Kind of input."""
    root: str
    """Folder that holds training/."""
    index: Annotated[str, AfterValidator(_is_pair_number)]
    """Six digits in quotes, such as "000138"."""

    def load(self, path: Resolve) -> Pair:
        """See `PairInput`."""
        kitti = _KITTI[self.kind]
        base = training_folder(path(self.root), kitti.layout)
        name = f"{int(self.index):06d}"
        images = [need(base / kitti.images / f"{name}_{k}.png", kitti.layout) for k in (10, 11)]
        calibration = need(base / kitti.calibration / f"{name}.txt", kitti.layout)
        left, right = read_kitti_projections(calibration, kitti.projections)
        K = left[:, :3].copy()
        baseline = float(left[0, 3] / left[0, 0] - right[0, 3] / right[0, 0])
        if not baseline > 0:
            raise DataError(
                "calibration gives no baseline between the stereo cameras",
                where=calibration,
                found=f"{baseline:g} m",
                expected="a positive length (0.53 to 0.55 m in KITTI)",
            )
        kinds = kitti.disparity, "flow_occ", "flow_noc", "obj_map"
        files = [base / kind / f"{name}_10.png" for kind in kinds]
        disparity = read_if(read_depth_png16, files[0], KITTI_DISPARITY)
        flow, visible = (read_if(read_kitti_flow, file) for file in files[1:3])
        occluded = None
        if flow is not None and visible is not None:
            check_size("flow_noc and flow_occ", visible.shape, flow.shape, files[2])
            occluded = np.isfinite(flow[:, :, 0]) & ~np.isfinite(visible[:, :, 0])
        objects = read_if(decode, files[3], "object map")
        truth = Truth(
            depth_ref=None if disparity is None else K[0, 0] * baseline / disparity,
            flow=flow,
            occluded=occluded,
            components=None if objects is None else objects.astype(np.int32),
        )
        return make_pair(images, [K, K], truth, f"{self.kind}_{name}")


class SceneFrames(PairInput):
    """Base of the inputs of two frames of a named scene."""

    root: str
    """Root folder of the dataset."""
    scene: str
    """Such as alley_1 of Sintel, "0001" (Virtual KITTI 1) or Scene01 (2)."""
    frame: Index
    """Number of the reference frame as in its file name; the first of Sintel is 1."""
    step: Whole = 1
    """Distance of the next frame; a true flow exists for 1 only."""


class VkittiInput(SceneFrames):
    """Virtual KITTI 1 (scene is the world, such as "0001") or 2 (left camera); no depth of the sky.

    The root holds vkitti_1.3.1_rgb and, for truth, _depthgt and _flowgt (1), or Scene01 and so on
    (2).
    """

    kind: Literal["vkitti1", "vkitti2"]
    """Kind of input."""
    variation: str = "clone"
    """Weather or camera variation."""

    def load(self, path: Resolve) -> Pair:
        """See `PairInput`."""
        image, depth, flow = _VKITTI[self.kind]
        layout = f"{image}; optional {depth}, {flow}"
        layout = layout.replace("{:05d}", "NNNNN").format(*["SCENE", "VARIATION"] * 3)
        root = need_folder(path(self.root), layout)

        def file(pattern: str, number: int) -> Path:
            head, tail = pattern.format(self.scene, self.variation, number).split("/", 1)
            return max(root.glob(head), default=root / head) / tail

        numbers = (self.frame, self.frame + self.step)
        images = [need(file(image, number), layout) for number in numbers]
        if self.kind == "vkitti1":
            cameras = [intrinsics(*VKITTI1_CAMERA)] * 2
            assumed(root, "Virtual KITTI 1 has no file of its camera", VKITTI1_TEXT)
        else:
            table = need(root / self.scene / self.variation / "intrinsic.txt", layout)
            cameras = read_vkitti2_intrinsics(table, numbers)
        truth = Truth(
            depth_ref=read_if(read_vkitti_depth, file(depth, numbers[0])),
            depth_next=read_if(read_vkitti_depth, file(depth, numbers[1])),
            flow=read_if(read_vkitti_flow, file(flow, self.frame) if self.step == 1 else None),
        )
        name = f"{self.kind}_{self.scene}_{self.variation}_{self.frame:05d}"
        return make_pair(images, cameras, truth, name)


class SintelInput(SceneFrames):
    """MPI Sintel with its depth and camera extension; depth is in the scene's unit.

    A pixel is occluded by the occlusion mask, or if its flow leaves the image; pixels of the mask
    `invalid` have no true flow. Without `camdata_left` the camera is `DEFAULT_CAMERA`, with a
    warning.
    """

    kind: Literal["sintel"]
    """Kind of input."""
    render: Literal["clean", "final", "albedo"] = "clean"
    """Rendering pass."""

    def load(self, path: Resolve) -> Pair:
        """See `PairInput`."""
        base = training_folder(path(self.root), SINTEL_LAYOUT)
        names = [f"{self.scene}/frame_{k:04d}" for k in (self.frame, self.frame + self.step)]
        images = [need(base / self.render / f"{name}.png", SINTEL_LAYOUT) for name in names]
        depths = [read_if(read_dpt, base / "depth" / f"{name}.dpt") for name in names]
        flow, occluded = _sintel_flow(base, names[0]) if self.step == 1 else (None, None)
        files = [base / "camdata_left" / f"{name}.cam" for name in names]
        absent = [file for file in files if not is_file(file)]
        if absent:
            doubt = f", which may be wrong for {self.scene}" * (self.scene != DEFAULT_SCENE)
            assumed(
                absent[0],
                "no such camera file (camdata_left comes with Sintel's depth training data)",
                f"the focal length of {DEFAULT_SCENE}, {DEFAULT_CAMERA[0]:g} pixels{doubt}",
            )
        cameras = [intrinsics(*DEFAULT_CAMERA) if f in absent else read_cam(f) for f in files]
        truth = Truth(depths[0], depths[1], flow, occluded)
        return make_pair(images, cameras, truth, f"sintel_{self.scene}_{self.frame:04d}")


def _sintel_flow(base: Path, name: str) -> tuple[Float | None, Mask | None]:
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
