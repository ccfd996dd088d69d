"""KITTI stereo/flow 2012 and scene flow 2015, Virtual KITTI 1 and 2, MPI Sintel, TUM RGB-D."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BeforeValidator

from soup_nlp.arrays import Float
from soup_nlp.data.datasets.folders import Folder, PairInput, Resolve, make_pair
from soup_nlp.data.formats.camera_files import check_intrinsics, number, read_cam, read_intrinsics
from soup_nlp.data.formats.cameras import written
from soup_nlp.data.formats.images import decode, read_mask, warn
from soup_nlp.data.formats.map_files import (
    KITTI_DISPARITY,
    read_depth,
    read_depth_png16,
    read_flow,
    read_vkitti_depth,
    read_vkitti_flow,
)
from soup_nlp.data.pair import Pair, Truth, check_size
from soup_nlp.errors import DataError
from soup_nlp.geometry.camera import intrinsics
from soup_nlp.schema.section import Index, Positive, Whole
from soup_nlp.storage.files import PathLike, read_text

_KITTI = {
    "kitti2012": ("image_0", "calib", ("P0:", "P1:"), "disp_occ"),
    "kitti2015": ("image_2", "calib_cam_to_cam", ("P_rect_02:", "P_rect_03:"), "disp_occ_0"),
}
"""Folders of images and calibration, rows of the projections, folder of disparities."""
KITTI_LAYOUT = (
    "training/{0}/NNNNNN_10.png and _11.png, training/{1}/NNNNNN.txt (rows {2[0]} {2[1]}); optional"
    " {3}, flow_occ, obj_map with NNNNNN_10.png"
)

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

SINTEL_LAYOUT = (
    "training/{clean,final,albedo}/SCENE/frame_NNNN.png; optional "
    "camdata_left/SCENE/frame_NNNN.cam, depth/SCENE/frame_NNNN.dpt, "
    "flow/SCENE/frame_NNNN.flo, invalid/SCENE/frame_NNNN.png"
)
DEFAULT_SCENE = "alley_1"
"""Scene of Sintel whose camera is assumed; that of other scenes differs (some have 1120 pixels)."""

TUM_SCALE = 5000.0
"""Values per metre of a TUM RGB-D depth image."""

TUM_LAYOUT = "rgb.txt, depth.txt, rgb/*.png, depth/*.png, optional K.txt or camera.txt"
TUM_SLACK = 0.02
"""Largest time between a colour image and its depth image, seconds."""

CAMERAS = {
    "Virtual KITTI 1": (725.0, 725.0, 620.5, 187.0),
    DEFAULT_SCENE: (688.00006, 688.00006, 511.5, 217.5),
    "freiburg1": (517.3, 516.5, 318.6, 255.3),
    "freiburg2": (520.9, 521.0, 325.1, 249.7),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
    "TUM RGB-D": (525.0, 525.0, 319.5, 239.5),
}
"""fx, fy, cx, cy, pixels, of data sets, scenes or sensors, for folders without a camera file."""


def assumed_camera(name: str, where: Path, missing: str, doubt: str = "") -> Float:
    """A camera of `CAMERAS`, with a warning."""
    K = intrinsics(*CAMERAS[name])
    warn(where, f"{missing}; assumed: fx,fy,cx,cy {written(K)} of {name}{doubt}")
    return K


def _pair_number(index: object) -> str:
    if isinstance(index, bool) or not re.fullmatch(r"[0-9]{1,6}", str(index)):
        raise ValueError("1 to 6 digits, such as 27 or '000027'")
    return f"{int(str(index)):06d}"


def read_rows(path: PathLike, names: Sequence[str], count: int) -> Float:
    """The rows of a calibration file with these names, such as "P0:", as (len(names), count)."""
    lines = [line.split() for line in read_text(path, "calibration file").splitlines()]
    out = []
    for name in names:
        head = name.split()
        rows = [line[len(head) :] for line in lines if line[: len(head)] == head]
        row = [number(word, name, path) for word in (rows[0] if rows else [])]
        if len(row) != count or not np.isfinite(row).all():
            others = [line[0] for line in lines if line]
            raise DataError(
                f"calibration file lacks the numbers of {name}",
                where=path,
                found=" ".join(rows[0]) if rows else f"lines {', '.join(others[:20])}",
                expected=f"a line '{name} ...' with {count} finite numbers",
            )
        out.append(row)
    return np.array(out)


class KittiInput(PairInput):
    """KITTI 2012 (grey camera 0) or 2015 (colour camera 2): frames 10 and 11 of a sequence.

    Depth is f B / disparity. The objects of the obj_map of 2015 are components; 0 is static.
    """

    kind: Literal["kitti2012", "kitti2015"]
    """Kind of input."""
    root: str
    """Folder that holds training/."""
    index: Annotated[str, BeforeValidator(_pair_number)]
    """Number of the pair, such as 138 or "000138"."""

    def load(self, path: Resolve) -> Pair:
        """See `PairInput`."""
        names, calib, projections, disparities = _KITTI[self.kind]
        folder = Folder(path(self.root), KITTI_LAYOUT.format(*_KITTI[self.kind]), "training")
        images = [folder.need(f"{names}/{self.index}_{k}.png") for k in (10, 11)]
        calibration = folder.need(f"{calib}/{self.index}.txt")
        left, right = read_rows(calibration, projections, 12).reshape(2, 3, 4)
        K = left[:, :3].copy()
        baseline = float(left[0, 3] / left[0, 0] - right[0, 3] / right[0, 0])
        if not baseline > 0:
            raise DataError(
                "calibration gives no baseline between the stereo cameras",
                where=calibration,
                found=f"{baseline:g} m",
                expected="a positive length (0.53 to 0.55 m in KITTI)",
            )
        file = f"{{}}/{self.index}_10.png".format
        disparity = folder.read(read_depth_png16, file(disparities), scale=KITTI_DISPARITY)
        objects = folder.read(decode, file("obj_map"), what="object map")
        truth = Truth(
            depth_ref=None if disparity is None else K[0, 0] * baseline / disparity,
            flow=folder.read(read_flow, file("flow_occ")),
            components=None if objects is None else objects.astype(np.int32),
        )
        return make_pair(images, [K, K], truth)


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
        folder, numbers = Folder(path(self.root), layout), (self.frame, self.frame + self.step)

        def file(pattern: str, number: int) -> str:
            name = pattern.format(self.scene, self.variation, number)
            if "*" not in pattern:
                return name
            head, tail = name.split("/", 1)
            return f"{max((p.name for p in folder.path.glob(head)), default=head)}/{tail}"

        images = [folder.need(file(image, number)) for number in numbers]
        if self.kind == "vkitti1":
            missing = "Virtual KITTI 1 has no file of its camera"
            K = assumed_camera("Virtual KITTI 1", folder.path, missing, ", for 1242 x 375")
            cameras = [K, K]
        else:
            table = folder.need(f"{self.scene}/{self.variation}/intrinsic.txt")
            rows = read_rows(table, [f"{number} 0" for number in numbers], 4)
            cameras = [check_intrinsics(intrinsics(*row), table) for row in rows]
        depths = [folder.read(read_vkitti_depth, file(depth, number)) for number in numbers]
        flows = [file(flow, self.frame)] if self.step == 1 else []
        truth = Truth(depths[0], depths[1], folder.read(read_vkitti_flow, *flows))
        return make_pair(images, cameras, truth)


class SintelInput(SceneFrames):
    """MPI Sintel with its depth and camera extension; depth is in the scene's unit.

    Pixels of the mask `invalid` have no true flow. Without `camdata_left` the camera is
    that of `DEFAULT_SCENE`, with a warning.
    """

    kind: Literal["sintel"]
    """Kind of input."""
    render: Literal["clean", "final", "albedo"] = "clean"
    """Rendering pass."""

    def load(self, path: Resolve) -> Pair:
        """See `PairInput`."""
        folder = Folder(path(self.root), SINTEL_LAYOUT, "training")
        names = [f"{self.scene}/frame_{k:04d}" for k in (self.frame, self.frame + self.step)]
        images = [folder.need(f"{self.render}/{name}.png") for name in names]
        depths = [folder.read(read_depth, f"depth/{name}.dpt") for name in names]
        cameras = [folder.read(read_cam, f"camdata_left/{name}.cam") for name in names]
        absent = [name for name, K in zip(names, cameras, strict=True) if K is None]
        if absent:
            doubt = f", which may be wrong for {self.scene}" * (self.scene != DEFAULT_SCENE)
            file = folder.path / "camdata_left" / f"{absent[0]}.cam"
            missing = "no such camera file (camdata_left comes with Sintel's depth training data)"
            default = assumed_camera(DEFAULT_SCENE, file, missing, doubt)
            cameras = [default if K is None else K for K in cameras]
        flow = invalid = None
        if self.step == 1:
            flow = folder.read(read_flow, f"flow/{names[0]}.flo")
            invalid = folder.read(read_mask, f"invalid/{names[0]}.png")
        if flow is not None and invalid is not None:
            where = folder.path / f"invalid/{names[0]}.png"
            check_size("mask and flow", invalid.shape, flow.shape, where)
            flow[invalid] = np.nan
        return make_pair(images, cameras, Truth(depths[0], depths[1], flow))


class TumInput(PairInput):
    """TUM RGB-D, official layout, depth in metres.

    `rgb.txt` and `depth.txt` list time stamps and files; a depth image belongs to a colour image
    within 20 ms. Without `K.txt` or `camera.txt` the intrinsics are those published for the sensor
    in the name of the folder (freiburg1, 2 or 3), else 525, 525, 319.5, 239.5; lens distortion is
    not removed.
    """

    kind: Literal["tum"]
    """Kind of input."""
    path: str
    """Folder of the sequence."""
    frame: Index = 0
    """Index of the reference image in rgb.txt."""
    step: Whole = 1
    """Distance of the next image."""
    depth_scale: Positive | None = None
    """Values per metre of the depth images; null for the 5000 of TUM, with a warning."""

    def load(self, path: Resolve) -> Pair:
        """See `PairInput`."""
        folder = Folder(path(self.path), TUM_LAYOUT)
        images = _tum_list(folder.need("rgb.txt"))
        depths = folder.read(_tum_list, "depth.txt") or []
        numbers = self.frame, self.frame + self.step
        if numbers[1] >= len(images):
            what, where = "frame is not in the sequence", folder.path / "rgb.txt"
            raise DataError(what, where=where, found=numbers[1], expected=f"0 to {len(images) - 1}")
        K = folder.read(read_intrinsics, "K.txt", "camera.txt")
        if K is None:
            sensor = re.search(r"freiburg[123]", str(folder.path.resolve()))
            missing = "neither K.txt nor camera.txt beside rgb.txt"
            K = assumed_camera(sensor.group() if sensor else "TUM RGB-D", folder.path, missing)
        maps = []
        for time, _ in (images[k] for k in numbers):
            near = sorted((abs(at - time), name) for at, name in depths)[:1]
            best = [name for gap, name in near if gap <= TUM_SLACK]
            maps.append(folder.read(read_depth, *best, scale=self.depth_scale, usual=TUM_SCALE))
        files = [folder.need(images[k][1]) for k in numbers]
        return make_pair(files, [K, K], Truth(maps[0], maps[1]))


def _tum_list(path: Path) -> list[tuple[float, str]]:
    """(time stamp in seconds, name of a file) of each line."""
    lines = [line.split() for line in read_text(path, "file list").splitlines()]
    try:
        return [(float(w[0]), w[1]) for w in lines if w and not w[0].startswith("#")]
    except (ValueError, IndexError) as error:
        what, expected = "file list is not understood", "lines 'timestamp file'"
        raise DataError(what, where=path, found=error, expected=expected) from None
