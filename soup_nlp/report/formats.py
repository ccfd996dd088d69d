"""Files for other programs, by the name of their format, and the motions of a result."""

import io
import struct
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from soup_nlp.errors import ConfigError, optional, printable, repr_of
from soup_nlp.geometry.motion import RigidMotion
from soup_nlp.geometry.rotation import log
from soup_nlp.report.chain import AXES, Chain
from soup_nlp.report.figures import depth_png_scale, encode_png, write_depth_png16
from soup_nlp.report.models import write_cloud, write_colmap, write_fused, write_glb, write_views
from soup_nlp.report.result import Result
from soup_nlp.storage.files import write_bytes, write_json, write_text

CONVENTIONS = {
    "axes": f"of a camera: {AXES}",
    "next_from_ref": "4x4, by rows: X_next = next_from_ref X_ref, each in its own camera;"
    " of a component it includes the motion of the camera",
    "own_motion": "what a component does by itself, in the reference camera's coordinates",
    "quaternion_xyzw": "of the rotation, scalar last",
    "rotation_deg": "axis times angle, degrees",
    "label": "value in components/of_superpixel of result.h5; 0 is the background",
    "residual_px": "median distance in the next image from the motions of the superpixels",
    "borrowed": "share of its pixels whose depth is that of neighbours",
    "scale": "of a component that moves by itself, no flow determines it",
}
"""Meaning of the entries of motions.json."""

Number: TypeAlias = Callable[[Path, Chain, int], object]
"""Writes the file of a frame, or of a pair, by its number."""
Whole: TypeAlias = Callable[[Path, Chain], object]
"""Writes one file or folder of a chain, or of a pair as one."""


class Format(NamedTuple):
    """Writers of the files of a format, by name.

    Attributes:
        text: Description.
        frames: Of each frame: points.ply is points_ref.ply of a pair, points/0000.ply of a chain.
        pairs: Of each pair: flow.flo of a pair, flow/0000.flo of a chain.
        whole: Once.
        chain: Once, of more than one pair.
    """

    text: str
    frames: Mapping[str, Number] = {}
    pairs: Mapping[str, Number] = {}
    whole: Mapping[str, Whole] = {}
    chain: Mapping[str, Whole] = {}

    def write(self, folder: Path, chain: Chain) -> list[str]:
        """Write the files into an existing folder and return their names."""
        files = list[str]()
        for writers, of_pairs in (self.frames, False), (self.pairs, True):
            for file, write in writers.items():
                for k, name in enumerate(_numbered(file, chain, of_pairs)):
                    (folder / name).parent.mkdir(exist_ok=True)
                    write(folder / name, chain, k)
                    files.append(name)
        for file, write_all in {**self.whole, **({} if chain.single else self.chain)}.items():
            write_all(folder / file, chain)
            files.append(file)
        return files


def _numbered(file: str, chain: Chain, of_pairs: bool) -> list[str]:
    stem, suffix = file.split(".")
    if chain.single:
        return [file] if of_pairs else [f"{stem}_{frame}.{suffix}" for frame in chain.names]
    return [f"{stem}/{frame}.{suffix}" for frame in chain.names[: -1 if of_pairs else None]]


def _write_npy(path: Path, values: NDArray[np.floating]) -> None:
    packed = io.BytesIO()
    np.save(packed, values.astype(np.float32))
    write_bytes(path, packed.getvalue())


def _write_pfm(path: Path, chain: Chain, k: int) -> None:
    """Write a depth map as portable float map, little endian, rows upwards; inf where unknown."""
    z = chain[k].depth
    z = np.where(np.isfinite(z) & (z > 0), z, np.inf).astype("<f4")
    header = f"Pf\n{z.shape[1]} {z.shape[0]}\n-1\n"
    write_bytes(path, header.encode("ascii") + z[::-1].tobytes())


def _write_flo(path: Path, chain: Chain, k: int) -> None:
    """Write the flow of a pair as Middlebury .flo; 1e10 where unknown."""
    uv = np.nan_to_num(chain.pairs[k].flow, nan=1e10).astype("<f4")
    write_bytes(path, b"PIEH" + struct.pack("<ii", uv.shape[1], uv.shape[0]) + uv.tobytes())


def _write_labels(path: Path, chain: Chain, k: int) -> None:
    """Write the components of a frame as grey PNG, of 8 bits where they suffice; unknown is 0."""
    labels = np.maximum(chain[k].components, 0)
    encode_png(path, labels.astype(np.uint8 if labels.max() < 256 else np.uint16))


def _write_moving(path: Path, chain: Chain, k: int) -> None:
    """Write what moves by itself as grey PNG, 255 where it does."""
    encode_png(path, np.where(chain[k].components > 0, 255, 0).astype(np.uint8))


def write_depths(folder: Path, chain: Chain) -> float:
    """Write depth maps as 16-bit PNG; returns the values per unit, the same for all."""
    scale = depth_png_scale(chain.depths)
    frames = {"depth.png": lambda path, _, k: write_depth_png16(path, chain[k].depth, scale)}
    Format("", frames).write(folder, chain)
    return scale


def _write_cameras(path: Path, chain: Chain) -> None:
    """Write the intrinsics of all frames, 3 x 3; of one alone where they have the same."""
    cameras = [np.array(frame.K) for frame in chain]
    same = all(np.array_equal(cameras[0], K) for K in cameras)
    rows = np.concatenate(cameras[:1] if same else cameras)
    write_text(path, "".join(" ".join(f"{x:.17g}" for x in row) + "\n" for row in rows))


def _write_kitti(path: Path, chain: Chain) -> None:
    """Write world_from_camera of every frame, the first 3 rows in one line (KITTI odometry)."""
    rows = (" ".join(f"{x:.9g}" for x in p.matrix[:3].ravel()) for p in chain.world_from_camera)
    write_text(path, "\n".join(rows) + "\n")


def write_tum(path: Path, chain: Chain) -> None:
    """Write world_from_camera of every frame in the format of the TUM benchmark."""
    lines = [
        "# timestamp tx ty tz qx qy qz qw: position and orientation of the camera in the first"
        " frame's camera coordinates",
        printable(f"# axes: {AXES}; timestamp: frame number; unit: {chain.unit}"),
    ]
    for k, pose in enumerate(chain.world_from_camera):
        lines.append(f"{k} " + " ".join(f"{x:.9g}" for x in (*pose.t, *pose.quaternion)))
    write_text(path, "\n".join(lines) + "\n")


def _write_transforms(folder: Path, chain: Chain) -> None:
    """Write images, masks and transforms.json, as NeRF programs read them.

    Poses are world_from_camera with y up, looking along -z; pixel (0, 0) has its centre at 0.5.
    """
    write_views(folder, chain)
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    frames = [
        {
            "file_path": f"images/{frame.name}.png",
            "mask_path": f"masks/{frame.name}.png.png",
            "transform_matrix": flip @ frame.pose.matrix @ flip,
            **dict(zip(("w", "h"), frame.depth.shape[::-1])),
            **dict(zip(("fl_x", "fl_y"), frame.K.diagonal())),
            **dict(zip(("cx", "cy"), frame.K[:2, 2] + 0.5)),
        }
        for frame in chain
    ]
    about = {"camera_model": "PINHOLE", "unit": chain.unit}
    write_json(folder / "transforms.json", {**about, "frames": frames})


def _write_recording(path: Path, chain: Chain) -> None:
    """Write images, depth, cameras, points and components of all frames, on a timeline `frame`.

    The world is the first camera (x right, y down, z ahead); the static scene does not move.

    Raises:
        ConfigError: the package rerun-sdk is not installed.
    """
    rr = optional("rerun", "rerun")
    out = rr.RecordingStream("soup_nlp")
    out.save(path)
    out.log("world", rr.ViewCoordinates.RDF, static=True)
    for number, frame in enumerate(chain):
        out.set_time("frame", sequence=number)
        pose, size = frame.pose, frame.depth.shape[::-1]
        out.log("world/camera", rr.Transform3D(translation=pose.t, mat3x3=pose.R))
        camera = rr.Pinhole(image_from_camera=frame.K, resolution=size)
        out.log("world/camera/image", camera)
        out.log("world/camera/image/rgb", rr.Image(frame.image).compress(jpeg_quality=92))
        depth = rr.DepthImage(np.nan_to_num(frame.depth).astype(np.float32), meter=1.0)
        out.log("world/camera/image/depth", depth)
        k, side = chain.seen(number)
        pair = chain.pairs[k]
        for part in pair.components:
            chosen, track = pair.sure & (pair.components.of_pixel == part.label), chain.tracks[k]
            name = f"component_{track[part.label]}" if part.label else "background"
            places = pose(pair.points[side][chosen])
            out.log(f"world/{name}", rr.Points3D(places, colors=pair.images[0][chosen]))
    out.flush()
    out.disconnect()


def motions(result: Result) -> dict[str, Any]:
    """Contents of motions.json."""
    parts = result.components
    camera = parts.camera
    return {
        "name": result.name,
        "unit": result.unit,
        "conventions": CONVENTIONS,
        "camera": {**_motion(camera), "position_in_ref": camera.centre},
        "components": [
            {
                "label": part.label,
                "background": part.label == 0,
                "superpixels": part.superpixels,
                "pixels": part.pixels,
                "share": part.pixels / parts.of_pixel.size,
                "centre_ref": part.centre,
                "centre_next": part.motion(part.centre),
                **_motion(part.motion),
                "own_motion": {
                    **_turn(parts.own_motion(part.label)),
                    "matrix": parts.own_motion(part.label).matrix,
                    "displacement": parts.own_motion(part.label)(part.centre) - part.centre,
                },
                "residual_px": part.residual_px,
                "borrowed": part.borrowed,
            }
            for part in parts
        ],
    }


def _motion(motion: RigidMotion) -> dict[str, Any]:
    return {"next_from_ref": motion.matrix, "translation": motion.t, **_turn(motion)}


def _turn(motion: RigidMotion) -> dict[str, Any]:
    return {"rotation_deg": np.degrees(log(motion.R)), "quaternion_xyzw": motion.quaternion}


FORMATS = {
    "ply": Format(
        "point clouds with normals, confidence, component; of a chain also its static scene as one",
        frames={"points.ply": write_cloud},
        chain={"scene.ply": write_fused},
    ),
    "glb": Format("textured meshes, glTF 2.0", frames={"mesh.glb": write_glb}),
    "colmap": Format(
        "COLMAP's text model, images, masks of what moves", whole={"colmap": write_colmap}
    ),
    "transforms": Format(
        "transforms.json with images and masks", whole={"transforms": _write_transforms}
    ),
    "npy": Format(
        "depth and sigma as float32 arrays, K.txt",
        frames={
            "depth.npy": lambda path, chain, k: _write_npy(path, chain[k].depth),
            "sigma.npy": lambda path, chain, k: _write_npy(path, chain[k].sigma),
        },
        whole={"K.txt": _write_cameras},
    ),
    "pfm": Format("depth as portable float maps", frames={"depth.pfm": _write_pfm}),
    "masks": Format(
        "labels of the components, and 255 where something moves by itself",
        frames={"components.png": _write_labels, "moving.png": _write_moving},
    ),
    "flow": Format("the flow that was used, .flo", pairs={"flow.flo": _write_flo}),
    "kitti": Format("camera poses as in KITTI odometry", whole={"poses.txt": _write_kitti}),
    "rrd": Format(
        "a recording for the Rerun viewer (extra: rerun)", whole={"scene.rrd": _write_recording}
    ),
    "motions": Format(
        "motions of the components (.json) and the camera's trajectory (TUM)",
        pairs={"motions.json": lambda path, chain, k: write_json(path, motions(chain.pairs[k]))},
        whole={"trajectory.tum": write_tum},
    ),
}
"""Every format by its name."""


def check_formats(names: Sequence[str]) -> list[str]:
    """Check names of formats and return them without repetitions.

    Raises:
        ConfigError: a name is unknown, there is no name, or it is not a list of names.
    """
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        raise ConfigError(
            "formats are no list of names",
            found=printable(repr_of(names), 60),
            expected=f"a list of {', '.join(FORMATS)}",
        )
    wrong = [name for name in names if name not in FORMATS]
    if wrong or not names:
        raise ConfigError(
            "unknown format" if wrong else "no format is named",
            found=", ".join(map(repr, wrong)) or None,
            expected=", ".join(FORMATS),
        )
    return list(dict.fromkeys(names))


def write_formats(folder: Path, chain: Chain, names: Sequence[str]) -> list[str]:
    """Write a chain, or a pair as one, in several formats into an existing folder.

    Returns:
        Names of the files and folders that were written.

    Raises:
        ConfigError: a format is not known.
        DataError: a file cannot be written, or a package is missing.
    """
    return [file for name in check_formats(names) for file in FORMATS[name].write(folder, chain)]
