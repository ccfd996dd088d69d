"""Folder of a chain: written, read, checked, and converted for other programs.

It holds depth and clouds in one scale, trajectories, a table, a page and a video.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from shlex import quote
from typing import Any

import cv2
import numpy as np

from soup_nlp.arrays import Float, Image
from soup_nlp.errors import DataError
from soup_nlp.report.check import CheckReport, Claim, check_folder
from soup_nlp.report.figures import depth_png_scale, write_clipped_depth_png16
from soup_nlp.report.formats import check_formats, tum_text
from soup_nlp.report.models import AXES, thinned, write_model, write_ply
from soup_nlp.sequence.chain import Chain, make_chain, read_pair
from soup_nlp.sequence.fused import fuse, projected
from soup_nlp.sequence.page import RATE, chain_page, depth_pictures, write_animation
from soup_nlp.sequence.score import certainty, score
from soup_nlp.storage.files import as_path, is_file, read_json, write_bytes, write_json, write_text
from soup_nlp.storage.folders import staged
from soup_nlp.storage.rows import failed, read_rows
from soup_nlp.storage.system import scratch

CHAIN = "chain.json"
"""File that makes a folder that of a chain."""
ROWS = "pairs.jsonl"
"""File with a row for each pair of a sequence."""
SAME = 1e-6
"""Largest relative difference of stored scales and poses from recomputed ones."""
COLMAP_POINTS = 60_000
"""Largest number of points of a COLMAP model."""
VISIBLE = 0.03
"""A point is visible in a frame if log depths of point and frame differ by less than this."""


def is_chain(folder: Path) -> bool:
    """Whether a folder is that of a chain.

    Raises:
        DataError: it is, but the chain is not finished.
    """
    if is_file(folder / CHAIN) or not is_file(folder / ROWS):
        return is_file(folder / CHAIN)
    rows = {str(row.get("key")): row for row in read_rows(folder / ROWS)}
    broken = sorted(key for key, row in rows.items() if failed(row))
    stored = sorted(key for key in rows if is_file(folder / "pairs" / key / "result.h5"))
    solved = [key for key in stored if key not in broken]
    hint = "the same soup-nlp chain command goes on where it stopped"
    if solved:
        hint += f"; soup-nlp view {quote(str(folder / 'pairs' / solved[0]))} shows a single pair"
    raise DataError(
        "chain is not finished",
        where=folder,
        found=f"pairs solved: {_some(solved)}; failed: {_some(broken)}",
        expected=f"{CHAIN}, written when every pair is solved",
        hint=hint,
    )


def _some(names: Sequence[str]) -> str:
    """The number of some names, and the first ones."""
    more = " ..." if len(names) > 6 else ""
    return f"{len(names)} ({', '.join(names[:6])}{more})" if names else "none"


def read_chain(folder: Path) -> tuple[Chain, dict[str, Any]]:
    """The chain of a folder, made again from its pairs, and the contents of chain.json.

    Raises:
        DataError: a pair is missing or damaged.
    """
    folder = as_path(folder, "folder of a chain")
    contents = read_json(folder / CHAIN, CHAIN)
    try:
        count = int(contents["frames"])
        over = [(int(a), int(b)) for a, b in contents.get("over", ())]
    except (KeyError, TypeError, ValueError) as error:
        raise DataError("chain.json cannot be read", where=folder, found=error) from error
    solved = [
        read_pair(a, b, folder / "pairs" / f"{a:03d}_{b:03d}")
        for a, b in [*((k, k + 1) for k in range(count - 1)), *over]
    ]
    return make_chain(solved[: count - 1], solved[count - 1 :]), contents


def check_chain(folder: Path) -> CheckReport:
    """Recompute every claim of the pairs of a chain, and its scales and poses from the pairs."""
    chain, contents = read_chain(folder)
    claims = []
    for pair in (folder / "pairs" / f"{p.first:03d}_{p.second:03d}" for p in chain.pairs):
        right = float(check_folder(pair).ok)
        claims.append(Claim(f"pair {pair.name}: every claim", 1.0, right))
    poses = np.array([m.matrix for m in chain.world_from_camera])
    arrays: Mapping[str, tuple[Any, Float]] = {
        "scales by the pairs": ([row["scale"] for row in contents["scales"]], chain.scales),
        "camera poses by pairs and scales": (contents["world_from_camera"], poses),
    }
    for name, (stored, found) in arrays.items():
        # null in JSON becomes NaN, which is no rounding error
        claimed = np.array(stored, float)
        gap = float(np.abs(claimed - found).max()) if claimed.shape == found.shape else np.inf
        tolerance = SAME * float(np.abs(found).max(initial=1.0))
        claims.append(Claim(name, 0.0, np.nan_to_num(gap, nan=np.inf), tolerance))
    return CheckReport(tuple(claims))


def write_fused(path: Path, chain: Chain, contents: Mapping[str, Any]) -> None:
    """The static scene of all frames as one cloud."""
    cloud = fuse(chain)
    title = f"{contents['name']}: static scene of {len(chain)} frames, one point per voxel"
    note = "sigma_log_depth: of the frame that the point is from; guesses are left out"
    comments = [title, f"frame: {WORLD}", f"unit: {contents['unit']}", note]
    scalars = {"sigma_log_depth": cloud["sigma"], "frame": cloud["label"]}
    write_ply(path, cloud["points"], cloud["colours"], None, scalars, comments)


def _write_colmap(folder: Path, chain: Chain, contents: Mapping[str, Any]) -> None:
    """COLMAP's model of the sequence: all frames and the fused cloud."""
    cloud = fuse(chain, COLMAP_POINTS)
    frames, seen = range(len(chain)), []
    for k in frames:
        inside, v, u, z = projected(chain, cloud["points"], k)
        with np.errstate(invalid="ignore", divide="ignore"):
            near = np.abs(np.log(z / chain.depth(k)[v, u])) < VISIBLE
        at = np.flatnonzero(inside & near)
        seen.append((at, np.stack([u[at], v[at]], 1).astype(float)))
    write_model(
        folder,
        [f"{k:04d}.png" for k in frames],
        [chain.image(k) for k in frames],
        [chain.camera(k) for k in frames],
        [pose.inverse for pose in chain.world_from_camera],
        [chain.labels(k) > 0 for k in frames],
        (cloud["points"], cloud["colours"]),
        seen,
        f"{contents['name']}; unit: {contents['unit']}",
    )


FORMATS: Mapping[str, tuple[str, Callable[[Path, Chain, Mapping[str, Any]], None]]] = {
    "ply": ("scene.ply", write_fused),
    "glb": ("scene.glb", write_animation),
    "colmap": ("colmap", _write_colmap),
}
"""Name and writer of the formats of a chain beside trajectory.tum and its clouds by frame."""


def convert_chain(
    folder: Path, names: Sequence[str], out: Path | None = None, overwrite: bool = False
) -> list[str]:
    """Write a chain for other programs; returns the names of the files.

    Raises:
        ConfigError: a format is not one of a chain.
    """
    hint = "formats of single pairs: soup-nlp convert DIR/pairs/000_001 --to ..."
    chosen = [FORMATS[name] for name in check_formats(names, FORMATS, hint)]
    chain, contents = read_chain(folder)
    with staged(folder if out is None else out, overwrite=overwrite) as new:
        for name, write in chosen:
            write(new / name, chain, contents)
        return [name for name, _ in chosen]


CHAIN_PAGE = "chain.html"
SINGLE = "chain.json", "trajectory.tum", "depth.mp4", CHAIN_PAGE, "scene.ply"
"""Files of a chain that are not made for each frame."""
POINTS = 100_000
"""Largest number of points in the cloud of a frame."""
WORLD = f"the first frame's camera, {AXES}"
UNIT = "the first pair's soup unit (free scale: its planes are at mean distance 1)"


def chain_files(count: int) -> list[str]:
    """Names of the files of a chain of `count` frames."""
    clouds = [f"points/{k:04d}.ply" for k in range(count - 1)]
    return [*SINGLE, *(f"depth/{k:04d}.png" for k in range(count)), *clouds]


def write_chain(
    folder: Path,
    chain: Chain,
    name: str,
    sources: Sequence[str],
    over: Sequence[tuple[int, int]] = (),
) -> None:
    """Write every file of a chain, `chain_files`, into an existing folder.

    Args:
        folder: The folder.
        chain: The chain.
        name: Name of the sequence.
        sources: Path or description of every frame.
        over: Frames of the further pairs that link the chain.
    """
    (folder / "depth").mkdir(exist_ok=True)
    (folder / "points").mkdir(exist_ok=True)
    depths = [chain.depth(k) for k in range(len(chain))]
    scale = depth_png_scale(np.concatenate([z.ravel() for z in depths]))
    for k, z in enumerate(depths):
        write_clipped_depth_png16(folder / "depth" / f"{k:04d}.png", z, scale)
    for k in range(len(chain.pairs)):
        _cloud(folder / "points" / f"{k:04d}.ply", chain, k, name)
    contents = {"name": name, "sources": list(sources), "over": list(over), **summary(chain)}
    contents |= {"depth_png_scale": scale, "score": score(chain)}
    write_json(folder / "chain.json", contents)
    head = f"# timestamp tx ty tz qx qy qz qw; timestamp: frame number; unit: {UNIT}"
    write_text(folder / "trajectory.tum", tum_text([head], chain.world_from_camera))
    write_fused(folder / "scene.ply", chain, contents)
    pictures, _ = depth_pictures(chain)
    write_video(
        folder / "depth.mp4",
        [np.vstack([chain.image(k), picture]) for k, picture in enumerate(pictures)],
    )
    write_text(folder / CHAIN_PAGE, chain_page(chain, contents))


def renew_chain_page(folder: Path) -> Path:
    """Make the page of a chain's folder again; returns its file."""
    text = chain_page(*read_chain(folder))
    with staged(folder, overwrite=True) as new:
        write_text(new / CHAIN_PAGE, text)
    return folder / CHAIN_PAGE


def summary(chain: Chain) -> dict[str, Any]:
    """Scales, links, poses and tracks as plain values."""
    return {
        "frames": len(chain),
        "unit": UNIT,
        "world": f"the first frame's camera: {AXES}",
        "scales": [
            {"pair": [p.first, p.second], "scale": s, "parallax_px": p.parallax_px}
            for p, s in zip(chain.pairs, chain.scales)
        ],
        "links": [
            {
                "pairs": [k.first, k.second],
                "ratio": float(np.exp(k.log_ratio)),
                "spread": k.spread,
                "pixels": k.pixels,
                "bridge": k.bridge,
                "flagged": k.flagged,
            }
            for k in chain.links
        ],
        "certainty": certainty(chain),
        "world_from_camera": [m.matrix for m in chain.world_from_camera],
        "tracks": [
            {
                "track": track,
                "path": chain.path(track),
                "pixels": {k: part.pixels for k, part in chain.members(track).items()},
            }
            for track in chain.track_numbers
        ],
    }


def write_video(path: Path, pictures: list[Image]) -> None:
    """Write pictures of one size as MPEG-4."""
    height, width = pictures[0].shape[:2]
    # encoders need even sides
    size = width - width % 2, height - height % 2
    # OpenCV needs a name in UTF-8
    with scratch() as folder:
        file = folder / "video.mp4"
        coder = cv2.VideoWriter.fourcc(*"mp4v")
        video = cv2.VideoWriter(str(file), coder, RATE, size)
        for picture in pictures:
            video.write(cv2.cvtColor(picture[: size[1], : size[0]], cv2.COLOR_RGB2BGR))
        video.release()
        write_bytes(path, file.read_bytes())


def _cloud(path: Path, chain: Chain, frame: int, name: str) -> None:
    """Write the points of a frame in world coordinates, subsampled."""
    result = chain.pairs[frame].result
    keep = thinned(result.sure, POINTS)
    tracks = np.array([chain.tracks[frame][k] for k in range(len(result.components))])
    normals = result.normals[0][keep] @ chain.world_from_camera[frame].R.T
    note = "track: what moves by itself, 0 is the static scene"
    comments = [f"{name}: frame {frame}", f"frame: {WORLD}", f"unit: {UNIT}", note]
    scalars = {"track": tracks[result.components.of_pixel[keep]]}
    write_ply(path, chain.points(frame)[keep], result.images[0][keep], normals, scalars, comments)
