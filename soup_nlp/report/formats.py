"""Files for other programs, by the name of their format; each is written from frames."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np

from soup_nlp.errors import ConfigError, optional, printable, repr_of
from soup_nlp.report.chain import AXES, Chain, Frame
from soup_nlp.report.figures import encode_png
from soup_nlp.report.models import write_colmap, write_fused, write_glb, write_points, write_views
from soup_nlp.storage.files import write_bytes, write_json

OfFrame: TypeAlias = Callable[[Path, Frame], object]
OfChain: TypeAlias = Callable[[Path, Chain], object]


class Format(NamedTuple):
    """Description of a format, and writers of its files and folders by name.

    Those of `frames` are written for each frame: points.ply is points_ref.ply of a pair, and
    points/0000.ply of a chain; those of `pairs` for each but the last. Those of `whole` are written
    once, and those of `chain` once if there is more than one pair.
    """

    text: str
    frames: Mapping[str, OfFrame] = {}
    pairs: Mapping[str, OfFrame] = {}
    whole: Mapping[str, OfChain] = {}
    chain: Mapping[str, OfChain] = {}


def write_formats(folder: Path, chain: Chain, names: Sequence[str]) -> list[str]:
    """Write a chain, or a pair as one, in several formats into an existing folder.

    Returns the names of the files and folders that were written.
    """
    chosen, files = [FORMATS[name] for name in check_formats(names)], list[str]()
    for frame in chain:
        for one in chosen:
            # the last frame has no flow
            pairs = {} if frame.flow is None else one.pairs
            for file, write in {**one.frames, **pairs}.items():
                stem, suffix = file.split(".")
                files.append(f"{stem}{'_' if chain.single else '/'}{frame.name}.{suffix}")
                (folder / files[-1]).parent.mkdir(exist_ok=True)
                write(folder / files[-1], frame)
    for one in chosen:
        for file, write_all in {**one.whole, **({} if chain.single else one.chain)}.items():
            write_all(folder / file, chain)
            files.append(file)
    return files


def check_formats(names: Sequence[str]) -> list[str]:
    """Check names of formats and return them without repetitions; ConfigError for unknown ones."""
    known = isinstance(names, list | tuple) and all(
        isinstance(name, str) and name in FORMATS for name in names
    )
    if not known or not names:
        raise ConfigError(
            "unknown format, or none",
            found=printable(repr_of(names), 60),
            expected=f"a list of {', '.join(FORMATS)}",
        )
    return list(dict.fromkeys(names))


def _write_pfm(path: Path, frame: Frame) -> None:
    """Portable float map, little endian, rows upwards; inf where unknown."""
    z = np.where(np.isfinite(frame.depth) & (frame.depth > 0), frame.depth, np.inf).astype("<f4")
    header = f"Pf\n{z.shape[1]} {z.shape[0]}\n-1\n"
    write_bytes(path, header.encode("ascii") + z[::-1].tobytes())


def _write_flo(path: Path, frame: Frame) -> None:
    """Middlebury .flo; 1e10 where unknown."""
    assert frame.flow is not None
    uv = np.nan_to_num(frame.flow, nan=1e10).astype("<f4")
    write_bytes(path, b"PIEH" + np.array(uv.shape[1::-1], "<i4").tobytes() + uv.tobytes())


def _write_labels(path: Path, frame: Frame) -> None:
    """8 bits where they suffice; unknown is 0."""
    labels = np.maximum(frame.components, 0)
    encode_png(path, labels.astype(np.uint8 if labels.max() < 256 else np.uint16))


def _write_moving(path: Path, frame: Frame) -> None:
    encode_png(path, np.where(frame.components > 0, 255, 0).astype(np.uint8))


def _write_cameras(path: Path, chain: Chain) -> None:
    """Intrinsics of all frames, 3 x 3; of one alone where they have the same."""
    cameras = [np.array(frame.K) for frame in chain]
    same = all(np.array_equal(cameras[0], K) for K in cameras)
    np.savetxt(path, np.concatenate(cameras[:1] if same else cameras), "%.17g")


def _write_kitti(path: Path, chain: Chain) -> None:
    """world_from_camera of every frame, the first 3 rows in one line (KITTI odometry)."""
    np.savetxt(path, [pose.matrix[:3].ravel() for pose in chain.world_from_camera], "%.9g")


def _write_tum(path: Path, chain: Chain) -> None:
    """world_from_camera of every frame in the format of the TUM benchmark."""
    about = (
        "timestamp tx ty tz qx qy qz qw: position and orientation of the camera in the first"
        " frame's camera coordinates\n"
        + printable(f"axes: {AXES}; timestamp: frame number; unit: {chain.unit}")
    )
    rows = [(k, *pose.t, *pose.quaternion) for k, pose in enumerate(chain.world_from_camera)]
    np.savetxt(path, rows, "%.9g", header=about, encoding="utf-8")


def _write_transforms(folder: Path, chain: Chain) -> None:
    """Images, masks and transforms.json, as NeRF programs read them.

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
    """Images, depth, cameras, points and components of all frames, on a timeline `frame`."""
    rr = optional("rerun", "rerun")
    out = rr.RecordingStream("soup_nlp")
    out.save(path)
    out.log("world", rr.ViewCoordinates.RDF, static=True)
    for number, frame in enumerate(chain):
        out.set_time("frame", sequence=number)
        out.log("world/camera", rr.Transform3D(translation=frame.pose.t, mat3x3=frame.pose.R))
        camera = rr.Pinhole(image_from_camera=frame.K, resolution=frame.depth.shape[::-1])
        out.log("world/camera/image", camera)
        out.log("world/camera/image/rgb", rr.Image(frame.image).compress(jpeg_quality=92))
        depth = rr.DepthImage(np.nan_to_num(frame.depth).astype(np.float32), meter=1.0)
        out.log("world/camera/image/depth", depth)
        for track in np.unique(frame.components[frame.sure]).tolist():
            chosen = frame.sure & (frame.components == track)
            places = rr.Points3D(frame.points[chosen], colors=frame.image[chosen])
            out.log(f"world/{f'component_{track}' if track else 'background'}", places)
    out.flush()
    out.disconnect()


FORMATS = {
    "ply": Format(
        "point clouds with normals and components; of a chain also its static scene as one",
        frames={"points.ply": write_points},
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
            "depth.npy": lambda path, frame: np.save(path, frame.depth.astype(np.float32)),
            "sigma.npy": lambda path, frame: np.save(path, frame.sigma.astype(np.float32)),
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
    "tum": Format("camera poses as in TUM RGB-D", whole={"trajectory.tum": _write_tum}),
    "rrd": Format(
        "a recording for the Rerun viewer (extra: rerun)", whole={"scene.rrd": _write_recording}
    ),
}
"""Every format by its name."""
