"""Files of a chain: depth and clouds in one scale, trajectories, a table, a page and a video."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from soup_nlp.arrays import Image
from soup_nlp.report.colour import colourise_depth, depth_range
from soup_nlp.report.figures import depth_png_scale, write_clipped_depth_png16
from soup_nlp.report.formats import tum_text
from soup_nlp.report.ply_glb import AXES, write_ply
from soup_nlp.sequence.animation import RATE
from soup_nlp.sequence.chain import Chain
from soup_nlp.sequence.page import chain_page
from soup_nlp.sequence.score import score
from soup_nlp.sequence.stored import read_chain, write_fused
from soup_nlp.storage.atomic import write_bytes, write_text
from soup_nlp.storage.folders import scratch, staged
from soup_nlp.storage.store import write_json

CHAIN_PAGE = "chain.html"
SINGLE = "chain.json", "trajectory.tum", "depth.mp4", CHAIN_PAGE, "scene.ply"
"""Files of a chain that are not made for each frame."""
POINTS = 100_000
"""Largest number of points in the cloud of a frame."""
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
    write_text(folder / "trajectory.tum", trajectory(chain))
    write_fused(folder, chain, contents)
    pictures, text = _page(chain, contents)
    write_video(folder / "depth.mp4", pictures)
    write_text(folder / CHAIN_PAGE, text)


def renew_chain_page(folder: Path) -> Path:
    """Make the page of a chain's folder again; returns its file."""
    _, text = _page(*read_chain(folder))
    with staged(folder, overwrite=True) as new:
        write_text(new / CHAIN_PAGE, text)
    return folder / CHAIN_PAGE


def _page(chain: Chain, contents: dict[str, Any]) -> tuple[list[Image], str]:
    """Images of all frames above their depth in colour, and the page."""
    frames = range(len(chain))
    depths, shown = [chain.depth(k) for k in frames], [chain.image(k) for k in frames]
    span = depth_range(np.concatenate([z.ravel()[::7] for z in depths]))
    pictures = [colourise_depth(z, *span) for z in depths]
    text = chain_page(chain, contents, shown, pictures, span)
    return [np.vstack(both) for both in zip(shown, pictures)], text


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
        "world_from_camera": [m.matrix for m in chain.world_from_camera],
        "tracks": [
            {"track": t, "path": chain.path(t), "pixels": pixels(chain, t)}
            for t in chain.track_numbers
        ],
    }


def pixels(chain: Chain, track: int) -> dict[int, int]:
    """Pixels of a track by frame."""
    return {
        k: chain.pairs[k].result.components[label].pixels
        for k in range(len(chain.pairs))
        if (label := chain.label(k, track)) is not None
    }


def trajectory(chain: Chain) -> str:
    """Poses of the camera in the format of the TUM benchmark, world_from_camera."""
    head = f"# timestamp tx ty tz qx qy qz qw; timestamp: frame number; unit: {UNIT}"
    return tum_text([head], chain.world_from_camera)


def write_video(path: Path, pictures: list[Image]) -> None:
    """Write pictures as MPEG-4 of the first one's size."""
    height, width = pictures[0].shape[:2]
    # encoders need even sides
    size = width - width % 2, height - height % 2
    # OpenCV needs a name in UTF-8
    with scratch() as place:
        made = place / "video.mp4"
        coder = cv2.VideoWriter.fourcc(*"mp4v")
        video = cv2.VideoWriter(str(made), coder, RATE, size)
        for picture in pictures:
            # the encoder would drop frames of another size
            same = picture.shape[:2] == (height, width)
            shown = picture[: size[1], : size[0]] if same else cv2.resize(picture, size)
            video.write(cv2.cvtColor(shown, cv2.COLOR_RGB2BGR))
        video.release()
        write_bytes(path, made.read_bytes())


def _cloud(path: Path, chain: Chain, frame: int, name: str) -> None:
    """Write the points of a frame in world coordinates, subsampled."""
    result = chain.pairs[frame].result
    step = max(1, int(np.ceil(np.sqrt(result.sure.sum() / POINTS))))
    keep = np.zeros_like(result.sure)
    keep[::step, ::step] = result.sure[::step, ::step]
    tracks = np.array([chain.tracks[frame][k] for k in range(len(result.components))])
    normals = result.normals[0][keep] @ chain.world_from_camera[frame].R.T
    comments = [
        f"{name}: frame {frame}",
        f"frame: the first frame's camera, {AXES}",
        f"unit: {UNIT}",
        "track: what moves by itself, 0 is the static scene",
    ]
    scalars = {"track": tracks[result.components.of_pixel[keep]]}
    write_ply(path, chain.points(frame)[keep], result.images[0][keep], normals, scalars, comments)
