"""Files for other programs, by the name of their format, and the motions of a result."""

import io
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from soup_nlp.errors import ConfigError, DataError, printable, repr_of
from soup_nlp.geometry.motion import RigidMotion
from soup_nlp.geometry.rotation import log
from soup_nlp.report.figures import write_clipped_depth_png16
from soup_nlp.report.models import AXES, write_cloud, write_colmap, write_glb
from soup_nlp.report.result import FRAMES, Result
from soup_nlp.storage.files import write_bytes, write_json, write_text

CONVENTIONS = {
    "axes": f"of a camera: {AXES}",
    "matrix": "row-major 4x4 of homogeneous points: X_next = next_from_ref X_ref",
    "next_from_ref": "moves points from the reference camera's coordinates to the next camera's;"
    " of a component it includes the motion of the camera",
    "own_motion": "what a component does by itself, in the reference camera's coordinates:"
    " inverse(camera.next_from_ref) component.next_from_ref",
    "quaternion_xyzw": "of the rotation, scalar last",
    "rotation_deg": "rotation vector: axis times angle, degrees",
    "position_in_ref": "where the next camera is, in the reference camera's coordinates",
    "label": "value in components/of_superpixel of result.h5; 0 is the background",
    "residual_px": "median distance in the next image between this one motion and those of the"
    " superpixels; large where the component is not rigid",
    "borrowed": "share of its pixels whose depth is a guess from neighbours",
    "scale": "a component that moves by itself has a scale of its own, which no flow determines:"
    " its translation is as good as its depth",
}
"""Meaning of the entries of motions.json."""

Writer = Callable[[Path, Result], list[str]]
"""Writes files into a folder and returns their names."""


def _both_frames(pattern: str, write: Callable[[Path, Result, int], object]) -> Writer:
    """Writer of one file for each frame; `pattern` has {} for the name of the frame."""

    def writer(folder: Path, result: Result) -> list[str]:
        names = [pattern.format(frame) for frame in FRAMES]
        for k, name in enumerate(names):
            write(folder / name, result, k)
        return names

    return writer


def _write_npy(path: Path, result: Result, frame: int) -> None:
    """Write a depth map as float32 .npy; NaN where unknown."""
    packed = io.BytesIO()
    np.save(packed, result.depths[frame].astype(np.float32))
    write_bytes(path, packed.getvalue())


def _write_pfm(path: Path, result: Result, frame: int) -> None:
    """Write a depth map as portable float map, little endian, rows upwards; inf where unknown."""
    z = result.depths[frame]
    z = np.where(np.isfinite(z) & (z > 0), z, np.inf).astype("<f4")
    header = f"Pf\n{z.shape[1]} {z.shape[0]}\n-1\n"
    write_bytes(path, header.encode("ascii") + z[::-1].tobytes())


def _colmap(folder: Path, result: Result) -> list[str]:
    write_colmap(folder / "colmap", result)
    return ["colmap"]


def _png(folder: Path, result: Result) -> list[str]:
    names = [f"depth_{frame}.png" for frame in FRAMES]
    scale = {
        frame: write_clipped_depth_png16(folder / name, depth)
        for frame, name, depth in zip(FRAMES, names, result.depths)
    }
    write_json(folder / "depth_png.json", {"values_per_unit": scale, "unit": result.unit})
    return [*names, "depth_png.json"]


def _rrd(folder: Path, result: Result) -> list[str]:
    """Write images, depth, cameras, points and components of both frames, on a timeline `frame`.

    The world is the reference camera (x right, y down, z ahead); the static scene does not move.

    Raises:
        DataError: the package rerun-sdk is not installed.
    """
    try:
        import rerun as rr
    except ImportError as error:
        raise DataError(
            "recordings need the package rerun-sdk",
            where=folder,
            hint="pip install 'soup-nlp[rerun]'",
        ) from error
    poses = np.eye(4), result.components.camera.inverse.matrix
    out = rr.RecordingStream("soup_nlp")
    out.save(folder / "scene.rrd")
    out.log("world", rr.ViewCoordinates.RDF, static=True)
    for frame in (0, 1):
        out.set_time("frame", sequence=frame)
        pose, image = poses[frame], result.images[frame]
        camera = rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3])
        out.log("world/camera", camera)
        size = [image.shape[1], image.shape[0]]
        out.log(
            "world/camera/image", rr.Pinhole(image_from_camera=result.K[frame], resolution=size)
        )
        out.log("world/camera/image/rgb", rr.Image(image).compress(jpeg_quality=92))
        depth = np.nan_to_num(result.depths[frame]).astype(np.float32)
        out.log("world/camera/image/depth", rr.DepthImage(depth, meter=1.0))
        points = result.points[frame] @ pose[:3, :3].T + pose[:3, 3]
        of_pixel = result.components.of_pixel
        for part in result.components:
            chosen = result.sure & (of_pixel == part.label)
            name = "background" if part.label == 0 else f"component_{part.label}"
            cloud = rr.Points3D(points[chosen], colors=result.images[0][chosen])
            out.log(f"world/{name}", cloud)
    out.flush()
    out.disconnect()
    return ["scene.rrd"]


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


def trajectory(result: Result) -> str:
    """Poses of the camera in the format of the TUM benchmark, ref_from_camera, frames 0 and 1."""
    still = RigidMotion(np.eye(3), np.zeros(3))
    lines = [
        "# timestamp tx ty tz qx qy qz qw: position and orientation of the camera in the"
        " reference frame's camera coordinates",
        f"# axes: {AXES}; timestamp: frame number; unit: {result.unit}",
    ]
    return tum_text(lines, (still, result.components.camera.inverse))


def tum_text(comments: Sequence[str], poses: Sequence[RigidMotion]) -> str:
    """Poses in the format of the TUM benchmark, below some comments."""
    lines = [
        f"{k} " + " ".join(f"{x:.9g}" for x in (*pose.t, *pose.quaternion))
        for k, pose in enumerate(poses)
    ]
    return "\n".join([*comments, *lines]) + "\n"


def _motion(motion: RigidMotion) -> dict[str, Any]:
    return {"next_from_ref": motion.matrix, "translation": motion.t, **_turn(motion)}


def _turn(motion: RigidMotion) -> dict[str, Any]:
    return {"rotation_deg": np.degrees(log(motion.R)), "quaternion_xyzw": motion.quaternion}


def _motions(folder: Path, result: Result) -> list[str]:
    write_json(folder / "motions.json", motions(result))
    write_text(folder / "trajectory.tum", trajectory(result))
    return ["motions.json", "trajectory.tum"]


FORMATS: Mapping[str, tuple[Writer, str]] = {
    "ply": (
        _both_frames("points_{}.ply", write_cloud),
        "point clouds with normals, confidence and component",
    ),
    "glb": (_both_frames("mesh_{}.glb", write_glb), "textured meshes, glTF 2.0"),
    "colmap": (_colmap, "COLMAP's text model with images and masks of what moves"),
    "npy": (_both_frames("depth_{}.npy", _write_npy), "depth as float32 arrays"),
    "pfm": (_both_frames("depth_{}.pfm", _write_pfm), "depth as portable float maps"),
    "png": (_png, "depth as 16-bit PNG"),
    "rrd": (_rrd, "a recording for the Rerun viewer (extra: rerun)"),
    "motions": (_motions, "motions.json and the camera's trajectory (TUM)"),
}
"""Writer and description of every format."""


def check_formats(
    names: Sequence[str], known: Collection[str] = FORMATS, hint: str | None = None
) -> list[str]:
    """Check names of formats and return them without repetitions.

    Raises:
        ConfigError: a name is unknown, there is no name, or it is not a list of names.
    """
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        raise ConfigError(
            "formats are no list of names",
            found=printable(repr_of(names), 60),
            expected=f"a list of {', '.join(known)}",
        )
    wrong = [name for name in names if name not in known]
    if wrong or not names:
        raise ConfigError(
            "unknown format" if wrong else "no format is named",
            found=", ".join(map(repr, wrong)) or None,
            expected=", ".join(known),
            hint=hint,
        )
    return list(dict.fromkeys(names))


def write_formats(folder: Path, result: Result, names: Sequence[str]) -> list[str]:
    """Write a result in several formats into an existing folder.

    Returns:
        Names of the files and folders that were written.

    Raises:
        ConfigError: a format is not known.
        DataError: a file cannot be written, or a package is missing.
    """
    return [file for name in check_formats(names) for file in FORMATS[name][0](folder, result)]
