"""Pairs of a batch, as problems: a table, a folder or pattern, a data set, mappings."""

import csv
import glob
import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from soup_nlp.config.problem import Problem, load_problem, make_problem, title
from soup_nlp.errors import DataError, expect
from soup_nlp.storage.files import as_path, is_file, read_text

Source = str | Path | Sequence[Problem | Mapping[str, Any] | str | Path]
"""pairs.csv, a folder, a pattern or DATASET:DIR; or a list of problems, their files or folders."""

KITTI = {"kitti2012": "image_0", "kitti2015": "image_2"}
DATASETS = (*KITTI, "sintel")
"""Data sets whose pairs are found: all that have both frames."""
TABLE = "a first line with names of columns: ref and next, or problem; name, intrinsics, depth ..."


def problems_of(pairs: Source, overrides: Sequence[str] = ()) -> dict[str, Problem]:
    """Problems by name, which is that of their folder; SoupError if there is none, or one is wrong.

    A table has a line for each pair. Its columns are `problem` (a problem file), or `ref` and
    `next` with the other keys of two image files (`intrinsics`, `fov`, `depth`, ...), or any dotted
    key of a problem file (`flow.source`, `segmentation.superpixels`); `name` is optional.
    """
    found = list(_listed(pairs, overrides))
    if not found:
        raise DataError(
            "no pair is there",
            where=pairs if isinstance(pairs, str | Path) else "pairs",
            expected="a folder of folders with frame_0 and frame_1 or of problem files",
        )
    named: dict[str, Problem] = {}
    for problem in found:
        # another pair of the same name gets a number
        name, k = problem.name, 2
        while name in named:
            name, k = f"{problem.name}-{k}", k + 1
        named[name] = problem.replace(name=name)
    return named


def _listed(pairs: Source, overrides: Sequence[str]) -> Iterator[Problem]:
    if not isinstance(pairs, str | Path):
        expect(pairs, (list, tuple), "pairs", "a list of problems, or of files")
        for pair in pairs:
            yield _one(pair, overrides)
        return
    dataset, _, folder = str(pairs).partition(":")
    path = as_path(pairs, "pairs", home=True)
    if dataset in DATASETS and folder:
        raws = _dataset(dataset, as_path(folder, "data set", home=True))
        yield from (make_problem(raw, overrides, where=str(pairs)) for raw in raws)
    elif path.suffix == ".csv":
        yield from _table(path, overrides)
    elif path.is_dir():
        yield from (_one(inner, overrides) for inner in sorted(path.iterdir()) if _is_pair(inner))
    else:
        yield from (_one(name, overrides) for name in sorted(glob.glob(str(path))))


def _is_pair(path: Path) -> bool:
    return path.suffix in (".yaml", ".yml") or (path.is_dir() and any(path.glob("frame_0.*")))


def _one(pair: Problem | Mapping[str, Any] | str | Path, overrides: Sequence[str]) -> Problem:
    """The problem of a mapping, of a problem file, or of a folder with a pair."""
    if isinstance(pair, Problem):
        changed = pair.model_dump(exclude_unset=True)
        return make_problem(changed, overrides, where=pair.name) if overrides else pair
    if isinstance(pair, Mapping):
        return make_problem(pair, overrides, where="pairs")
    path = as_path(pair, "pair", home=True)
    if path.is_dir():
        raw = {"name": title(path.name), "input": {"kind": "folder", "path": str(path.absolute())}}
        return make_problem(raw, overrides, where=str(path))
    return load_problem(path, overrides)


def _table(path: Path, overrides: Sequence[str]) -> Iterator[Problem]:
    """Problems of the lines of a table."""
    reader = csv.DictReader(io.StringIO(read_text(path, "table of pairs").lstrip("\ufeff")))
    heads = set(reader.fieldnames or ())
    if not ({"ref", "next"} <= heads or "problem" in heads or "input.kind" in heads):
        raise DataError(
            "table has no pairs", where=path, found=", ".join(heads) or None, expected=TABLE
        )
    base = path.absolute().parent
    for number, line in enumerate(reader, 2):
        where = f"{path}, line {number}"
        cells = {k: v.strip() for k, v in line.items() if k is not None and v and v.strip()}
        if None in line:
            raise DataError("line has more cells than columns", where=where, expected=TABLE)
        name, problem = cells.pop("name", None), cells.pop("problem", None)
        changes = [f"name={title(name)}"] if name else []
        changes += [
            f"{k if '.' in k or k in Problem.model_fields else f'input.{k}'}={v}"
            for k, v in cells.items()
        ]
        if problem is not None:
            yield load_problem(base / problem, [*overrides, *changes])
            continue
        if "ref" not in cells or "next" not in cells:
            raise DataError("line names no pair", where=where, found=cells, expected=TABLE)
        label = "-".join(Path(cells["ref"]).with_suffix("").parts[-2:])
        raw = {"name": title(label), "input": {"kind": "files"}, "base": str(base)}
        yield make_problem(raw, [*overrides, *changes], where=where)


def _dataset(name: str, root: Path) -> Iterator[dict[str, Any]]:
    """Inputs of all pairs of a data set whose two frames are there."""
    base = root / "training" if (root / "training").is_dir() else root
    source = {"kind": name, "root": str(root.absolute())}
    if name in KITTI:
        for image in sorted((base / KITTI[name]).glob("*_10.png")):
            index = image.name.removesuffix("_10.png")
            if is_file(image.with_name(f"{index}_11.png")):
                yield {"name": index, "input": {**source, "index": index}}
        return
    for image in sorted((base / "clean").glob("*/frame_*.png")):
        scene, frame = image.parent.name, int(image.stem.removeprefix("frame_"))
        if is_file(image.with_name(f"frame_{frame + 1:04d}.png")):
            pair = {**source, "scene": scene, "frame": frame}
            yield {"name": f"{scene}-{frame:04d}", "input": pair}
