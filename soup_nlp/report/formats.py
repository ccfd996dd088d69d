"""Files for other programs, by the name of their format."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from soup_nlp.errors import ConfigError, printable, repr_of
from soup_nlp.report.colmap import write_colmap
from soup_nlp.report.figures import write_clipped_depth_png16
from soup_nlp.report.mesh import write_glb
from soup_nlp.report.motions import motions, trajectory
from soup_nlp.report.pointcloud import write_cloud
from soup_nlp.report.rerun_file import write_rrd
from soup_nlp.report.result import FRAMES, Result
from soup_nlp.storage.atomic import write_bytes, write_text
from soup_nlp.storage.store import write_json

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
    (folder / "colmap").mkdir(exist_ok=True)
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
    write_rrd(folder / "scene.rrd", result)
    return ["scene.rrd"]


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


def write_formats(folder: Path, result: Result, names: Sequence[str]) -> list[str]:
    """Write a result in several formats into an existing folder.

    Returns:
        Names of the files and folders that were written.

    Raises:
        ConfigError: a format is not known.
        DataError: a file cannot be written, or a package is missing.
    """
    return [file for name in check_formats(names) for file in FORMATS[name][0](folder, result)]
