"""Folders of results and chains: read, checked, shown and converted; that of a chain written."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, NotRequired

import numpy as np
from annotated_types import Len
from typing_extensions import TypedDict

from soup_nlp.errors import DataError
from soup_nlp.report.chain import AXES, Chain, Lazy
from soup_nlp.report.check import CheckReport, Claim, check_folder, written
from soup_nlp.report.figures import depth_png_scale, write_depth_png16
from soup_nlp.report.folder import PAIRS, ROWS
from soup_nlp.report.formats import check_formats, write_formats
from soup_nlp.report.page import page
from soup_nlp.report.result import PAGE, Result
from soup_nlp.report.result import load as load_pair
from soup_nlp.sequence.frames import pair_name
from soup_nlp.sequence.links import make_chain
from soup_nlp.sequence.score import chain_lines, score
from soup_nlp.storage.each import failed, read_rows
from soup_nlp.storage.files import as_path, is_file, read_json, write_json, write_text
from soup_nlp.storage.folders import staged

CHAIN = "chain.json"
"""File that makes a folder that of a chain."""
KEPT = ("input", "start", "truth", "solution", "weights", "energy")
"""Groups of arrays of a pair that a chain needs."""
DEPTH_TOLERANCE = 1e-6
"""Largest relative difference of stored scales and poses from recomputed ones."""
SINGLE = CHAIN, "trajectory.tum", PAGE
"""Files of a chain that are not made for each frame."""


def is_chain(folder: Path) -> bool:
    """Whether a folder is that of a chain, which is a DataError if it is not finished."""
    if is_file(folder / CHAIN) or not is_file(folder / ROWS):
        return is_file(folder / CHAIN)
    rows = {str(row.get("key")): row for row in read_rows(folder / ROWS)}
    broken = sorted(key for key, row in rows.items() if failed(row))
    raise DataError(
        "chain is not finished",
        where=folder,
        found=f"pairs in {PAIRS}/: {len(rows)}, failed: {', '.join(broken) or 'none'}",
        expected=f"{CHAIN}, written when every pair is solved",
        hint="the same soup-nlp chain command goes on where it stopped",
    )


def load(folder: str | Path) -> Result | Chain:
    """A result of `solve`, `import` or `Run.save`, or a chain: depth, points, sigma, motions.

    `reconstruction`, `components`, `camera` and `metrics` of a result are those of the `Run`. A
    folder that holds neither, or a damaged one, is a DataError.
    """
    folder = as_path(folder, "result folder")
    return read_chain(folder) if is_chain(folder) else load_pair(folder)


def read_chain(folder: Path) -> Chain:
    """The chain of a folder, made again from its pairs; DataError if one is missing or damaged."""
    contents = read_json(folder / CHAIN, CHAIN, Contents)
    return make_chain(read_pairs(folder, len(contents["scales"])), contents)


def read_pairs(folder: Path, count: int) -> Lazy[Result]:
    """The pairs of a chain's folder, each read when it is needed, with the arrays `KEPT`."""

    def read(k: int) -> Result:
        pair = load_pair(folder / PAIRS / pair_name(k))
        return replace(pair, tree={name: pair.tree[name] for name in KEPT if name in pair.tree})

    return Lazy(read, count)


def check(folder: Path) -> CheckReport:
    """Recompute every claim of a result, or of the pairs of a chain with its scales and poses."""
    if not is_chain(folder):
        return check_folder(folder)
    chain, claims = read_chain(folder), []
    for k in range(len(chain.pairs)):
        right = float(check_folder(folder / PAIRS / pair_name(k)).ok)
        claims.append(Claim(f"pair {pair_name(k)}: every claim", 1.0, right))
    poses = np.array([m.matrix for m in chain.world_from_camera])
    scales = [row["scale"] for row in chain.summary["scales"]]
    for name, stored, found in (
        ("scales by the pairs", scales, chain.scales),
        ("camera poses by pairs and scales", chain.summary["world_from_camera"], poses),
    ):
        # null in JSON becomes NaN, which is no rounding error
        claimed = np.array(stored, float)
        gap = float(np.abs(claimed - found).max()) if claimed.shape == found.shape else np.inf
        tolerance = DEPTH_TOLERANCE * float(np.abs(found).max(initial=1.0))
        claims.append(Claim(name, 0.0, np.nan_to_num(gap, nan=np.inf), tolerance))
    return CheckReport((*claims, *written(folder, {*chain_files(len(chain))})))


def chain_of(folder: Path) -> Chain:
    """The chain of a folder, or its result as a chain of two frames."""
    found = load(folder)
    return Chain.of(found) if isinstance(found, Result) else found


def convert(
    folder: Path, formats: Sequence[str], out: Path | None = None, overwrite: bool = False
) -> list[str]:
    """Write the result or the chain of a folder in `formats.FORMATS`; returns names of the files.

    They go into the same folder unless `out` is another one; files that the program did not make
    are overwritten with `overwrite` only.
    """
    names, chain = check_formats(formats), chain_of(folder)
    with staged(folder if out is None else out, overwrite=overwrite) as new:
        return write_formats(new, chain, names)


def renew_page(folder: Path) -> None:
    """Make the page of a result or a chain again, unless it was changed."""
    found = chain_of(folder)
    with staged(folder) as new:
        try:
            write_text(new / PAGE, page(found))
        except (KeyError, ValueError, IndexError, TypeError) as error:
            lacks, hint = "result lacks what a page shows", "solve it again"
            raise DataError(lacks, where=folder, found=repr(error), hint=hint) from error


def chain_files(count: int) -> list[str]:
    """Files of a chain of `count` frames."""
    return [*SINGLE, *(f"depth/{k:04d}.png" for k in range(count))]


def write_chain(folder: Path, chain: Chain, name: str, sources: Sequence[str]) -> Chain:
    """Write every file of a chain, `chain_files`, into an existing folder.

    `sources` are the paths or descriptions of the frames. Returns the chain with the contents of
    its chain.json.
    """
    scale = depth_png_scale(chain.depths)
    (folder / "depth").mkdir(exist_ok=True)
    for frame in chain:
        write_depth_png16(folder / "depth" / f"{frame.name}.png", frame.depth, scale)
    contents = {"name": name, "sources": list(sources), **summary(chain)}
    contents |= {"depth_png_scale": scale, "score": score(chain)}
    chain = replace(chain, summary=contents)
    contents["verdict"] = chain_lines(chain)
    write_json(folder / CHAIN, contents)
    write_formats(folder, chain, ["tum"])
    write_text(folder / PAGE, page(chain))
    return chain


def summary(chain: Chain) -> dict[str, Any]:
    """Scales, links, poses and tracks as plain values."""
    return {
        "frames": len(chain),
        "unit": chain.unit,
        "world": f"the first frame's camera: {AXES}",
        "scales": [{"pair": [k, k + 1], "scale": scale} for k, scale in enumerate(chain.scales)],
        "links": [
            {
                "pairs": [k.first, k.second],
                "ratio": float(np.exp(k.log_ratio)),
                **{name: getattr(k, name) for name in ("spread", "pixels", "bridge", "flagged")},
            }
            for k in chain.links
        ],
        "certainty": chain.certainty,
        "world_from_camera": [m.matrix for m in chain.world_from_camera],
        "tracks": [{"track": track, "path": path} for track, path in sorted(chain.paths.items())],
    }


# --- what chain.json holds, as far as it is read back -----------------------------------------

Row = Annotated[list[float], Len(4, 4)]


class Scaled(TypedDict):
    """A pair of consecutive frames."""

    scale: float


class Score(TypedDict):
    """Errors against the truth, see `sequence.score.score`."""

    scale: float
    mre_one_scale: float


class Contents(TypedDict):
    """Contents of chain.json."""

    name: str
    sources: list[str]
    scales: Annotated[list[Scaled], Len(1)]
    world_from_camera: list[Annotated[list[Row], Len(4, 4)]]
    score: Score | None
    verdict: NotRequired[list[str]]
