"""A sequence solved from Python: `soup_nlp.chain`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from soup_nlp.data.accept import ImageLike, image_of, is_path
from soup_nlp.errors import DataError
from soup_nlp.report.figures import write_png
from soup_nlp.sequence.chain import Chain, make_chain
from soup_nlp.sequence.frames import FileFrames, check_sequence, find_images
from soup_nlp.sequence.pairs import solve_pairs
from soup_nlp.sequence.write import chain_files, write_chain
from soup_nlp.storage.files import as_path
from soup_nlp.storage.folders import claim, staged


def solve_chain(
    frames: str | Path | Sequence[ImageLike],
    out: str | Path,
    *,
    intrinsics: Sequence[float] | str | None = None,
    fov: float | None = None,
    overrides: Sequence[str] = (),
    workers: int = 1,
    overwrite: bool = False,
) -> Chain:
    """Solve consecutive frames as pairs, put them on one scale, and write the chain's folder.

    A call that was interrupted goes on where it stopped.

    Args:
        frames: Folder or pattern of images, or a list of files, arrays or PIL images.
        out: Folder of the chain, as `soup-nlp chain` writes it.
        intrinsics: fx, fy, cx, cy in pixels, or a file; None for `fov`, EXIF, or a guess.
        fov: Horizontal field of view, degrees.
        overrides: Keys of a problem file, such as `["segmentation.superpixels=500"]`.
        workers: Processes; with more than one, a script needs `if __name__ == "__main__":`.
        overwrite: Replace the result of another sequence.

    Raises:
        DataError: the frames are no sequence, one is damaged, or the folder holds the result of
            another one.
        SolverError: a pair cannot be solved; the others are kept.
    """
    folder = as_path(out, "output folder")
    if isinstance(frames, str | Path):
        images = find_images(Path(frames))
        check_sequence(images)
        subject = f"sequence {Path(frames).absolute()}"
    else:
        subject = f"sequence of {len(frames)} images for {folder.absolute()}"
        images = _files(frames, folder)
    claim(folder, chain_files(len(images)), overwrite, subject)
    camera: dict[str, Any] = {"fov": fov} if fov is not None else {}
    if intrinsics is not None:
        camera = {"intrinsics": intrinsics if isinstance(intrinsics, str) else [*intrinsics]}
    found = FileFrames(tuple(path.absolute() for path in images), camera)
    found.check()
    which = [(k, k + 1) for k in range(len(found) - 1)]
    chain = make_chain(solve_pairs(found, which, folder, overrides, workers))
    with staged(folder, whole=True, overwrite=overwrite, subject=subject) as new:
        write_chain(new, chain, folder.name, [found.source(k) for k in range(len(found))])
    return chain


def _files(frames: Sequence[ImageLike], folder: Path) -> list[Path]:
    """Files of images; arrays are written into the folder of the chain."""
    if len(frames) < 2:
        raise DataError("a sequence needs two images at least", found=len(frames))
    if all(is_path(frame) for frame in frames):
        return [as_path(frame, "image") for frame in frames]
    names = [f"{k:04d}.png" for k in range(len(frames))]
    with staged(folder / "frames", whole=True) as new:
        for name, frame in zip(names, frames):
            write_png(new / name, image_of(frame, f"frame {name}"))
    return [folder / "frames" / name for name in names]
