"""The result folder; it is written whole or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from soup_nlp.errors import DataError
from soup_nlp.evaluate.metrics import component_overlaps, skill
from soup_nlp.pipeline.record import Run
from soup_nlp.report.certainty import certainty
from soup_nlp.report.figures import overview, write_clipped_depth_png16, write_picture
from soup_nlp.report.formats import write_formats
from soup_nlp.report.page import page
from soup_nlp.report.pictures import Picture, pictures
from soup_nlp.report.record import RECORD, extended, record_of
from soup_nlp.report.result import PAGE, load, result_of
from soup_nlp.report.tree import attributes, result_tree
from soup_nlp.report.verdict import facts
from soup_nlp.solve.kkt import constraint_residuals
from soup_nlp.storage.atomic import write_text
from soup_nlp.storage.files import as_path
from soup_nlp.storage.folders import claim, staged
from soup_nlp.storage.store import write_h5, write_json
from soup_nlp.storage.versions import versions

FULL = {"ref_full": "depth_ref_full.png", "next_full": "depth_next_full.png"}
"""Files of the depth at the size of the images, for a pair that was solved at a smaller size."""

FILES = (
    *("config.yaml", "result.h5", "summary.json", "log.txt", "ipopt.log"),
    *("depth_ref.png", "depth_next.png", "depth_ref_colour.png", "depth_next_colour.png"),
    *("superpixels.png", "components.png", "flow.png", "flow_confidence.png", "normals.png"),
    *("confidence.png", "error.png", "overview.png", PAGE, "motions.json", "trajectory.tum"),
    *("points_ref.ply", "points_next.ply"),
)
"""Files of a result folder. error.png needs a dense truth, confidence.png a known uncertainty."""

PICTURES = {name: f"{name}_colour.png" for name in ("depth_ref", "depth_next")} | {
    name: f"{name}.png"
    for name in (
        *("superpixels", "components", "flow", "flow_confidence", "normals", "confidence"),
        "error",
    )
}
"""Files of the pictures that are also written alone, by name of the picture."""

FAILED = "failed.log"
"""Log of a solve that failed; the next result removes it."""

_ROUND = (
    *("energy", "mrf_energy", "bound", "gap", "taken", "moved", "ties", "iterations", "status"),
    *("seconds", "proposed", "accepted"),
)
"""Entries of a round of the refinement in summary.json."""


def prepare_folder(
    folder: str | Path,
    inputs: Iterable[Path] | None = None,
    overwrite: bool = False,
    subject: str = "",
) -> Path:
    """Make the folder of a result and check that it can be written.

    Args:
        folder: The folder.
        inputs: Input files and folders of the problem, which are never overwritten.
        overwrite: Overwrite files that the program did not make, and the result of another subject.
        subject: `Problem.subject`.

    Raises:
        DataError: the folder cannot be written, or holds a file that must not be overwritten.
    """
    folder = as_path(folder, "output folder")
    if inputs is not None:
        _keep_inputs(folder, inputs)
    return claim(folder, (*FILES, *FULL.values(), FAILED), overwrite, subject)


def _keep_inputs(folder: Path, inputs: Iterable[Path]) -> None:
    """Raise DataError if a result would overwrite its inputs or be in the same folder."""

    def refuse(what: str, expected: str, found: str | None = None) -> DataError:
        return DataError(
            what, where=folder, found=found, expected=expected, hint="choose another --out"
        )

    # realpath, unlike resolve, accepts a link to itself
    here = Path(os.path.realpath(folder))
    for place in inputs:
        if place == here:
            raise refuse(
                "output folder is the input's folder",
                "a folder of its own: depth and flow of a result would pass for truth",
            )
        if place.parent == here and place.name in (*FILES, *FULL.values()):
            raise refuse(
                "an input would be overwritten by the result",
                "a folder that holds none of the inputs under the name of a result's file",
                place.name,
            )


def write_folder(
    folder: Path,
    run: Run,
    config: str,
    log: str | Callable[[list[str]], str],
    verdict: str | None = None,
    ipopt_log: Path | None = None,
    formats: Sequence[str] = (),
) -> list[str]:
    """Write every file of a run; an earlier result is replaced when the new one is complete.

    Args:
        folder: Prepared folder.
        run: The run.
        config: Merged problem as YAML.
        log: Text of the log, or a function that makes it from the names of the other files.
        verdict: Verdict on the page; None for `facts`.
        ipopt_log: Log file of Ipopt.
        formats: Further formats, see `formats.FORMATS`.

    Returns:
        Names of the files.

    Raises:
        DataError: a file cannot be written.
    """
    with staged(folder, whole=True, subject=run.problem.subject) as new:
        if ipopt_log is not None and ipopt_log.is_file():
            shutil.copy(ipopt_log, new / "ipopt.log")
        _write_files(new, run, config, verdict, formats)
        names = {path.name for path in new.iterdir()} | {"log.txt", "result.h5"}
        files = [name for name in FILES if name in names] + sorted(names.difference(FILES))
        write_text(new / "log.txt", log if isinstance(log, str) else log(files))
        # written last, since it holds the hashes of the others
        tree = {**result_tree(run), RECORD: record_of(new)}
        write_h5(new / "result.h5", tree, attributes(run, config))
    return files


def write_failure(folder: Path, log: str, ipopt_log: Path) -> None:
    """Write the log of a failed solve, followed by that of Ipopt; an earlier result is kept."""
    with suppress(OSError):
        log += ipopt_log.read_text(encoding="utf-8", errors="replace")
    with staged(folder) as new:
        write_text(new / FAILED, log)


def _write_files(
    folder: Path, run: Run, config: str, verdict: str | None, formats: Sequence[str]
) -> None:
    """Every file of a run but its logs and result.h5."""
    write_text(folder / "config.yaml", config)
    contents = summary(run)
    result = result_of(run, contents, facts(run) if verdict is None else verdict)
    drawn = pictures(result)
    scales = _pictures(folder, run, drawn)
    write_formats(folder, result, ("motions", "ply", *formats))
    if run.problem.output.page:
        write_text(folder / PAGE, page(result, drawn))
    write_json(folder / "summary.json", {**contents, "depth_png_scale": scales})


def summary(run: Run) -> dict[str, Any]:
    """Contents of summary.json; the keys are stable."""
    s = run.solution
    constant = run.metrics["constant"].mre if "constant" in run.metrics else np.nan
    facing = run.problem.formulation.min_facing
    return {
        "name": run.problem.name,
        "problem_hash": run.problem.digest(),
        "status": s.status,
        "converged": s.converged,
        "delivered": run.delivered,
        "energy_by_stage": dict(s.ends)
        | ({"refinement": run.energy["total"]} if run.refined is not None else {}),
        "energy": {"start": s.energy_start, "nlp": s.energy, "solution": run.energy},
        "residuals": run.residuals,
        "nlp_residuals": constraint_residuals(s.soup, run.data.rim_ray, facing),
        "answer_residuals": constraint_residuals(run.answer, run.data.rim_ray, facing),
        "refinement": _refinement(run),
        "metrics": {
            # the constant depth is scored on the reference frame only
            k: m.as_dict() | ({} if k == "solution_next" else {"skill": skill(m.mre, constant)})
            for k, m in run.metrics.items()
        },
        "components": _components(run),
        "expected": run.problem.expected.model_dump(),
        "seconds": run.seconds,
        "iterations": {stage.name: stage.iterations for stage in s.stages},
        "sizes": {
            "superpixels": len(run.segmentation),
            "knn_edges": len(run.segmentation.edges),
            "neighbour_pairs": len(run.segmentation.pairs),
            "width": run.pair.size[1],
            "height": run.pair.size[0],
            **s.nlp,
        },
        "full_size": _full_size(run),
        "start": {
            "motions": len(run.start.motions),
            "borrowed": int(run.start.borrowed.sum()),
            "median_error_px": float(np.median(run.start.error)),
        },
        "certainty": certainty(run),
        "evidence": run.confidence.evidence.rows(),
        **({} if run.given is None else {"depth_prior": run.given.as_dict()}),
        "flow": str(run.pair.flow),
        "versions": versions(),
        "seed": run.problem.seed,
    }


def _full_size(run: Run) -> dict[str, Any] | None:
    """Size and score of the depth at the size of the images; None if it was solved at that size."""
    if run.full is None:
        return None
    height, width = run.full.depth_ref.shape
    scores = run.full.metrics
    return {"width": width, "height": height, "metrics": scores and scores.as_dict()}


def _components(run: Run) -> dict[str, Any]:
    """Number of components, and their overlap with the true ones."""
    truth = run.pair.truth
    out: dict[str, Any] = {"count": len(run.components)}
    if truth is not None and truth.components is not None:
        found = component_overlaps(run.components.of_pixel, truth.components)
        out["truth"] = {str(k): {"component": c, "iou": iou} for k, (c, iou) in found.items()}
    return out


def _refinement(run: Run) -> dict[str, Any] | None:
    """Results of the refinement by round; None if it was disabled."""
    r = run.refined
    if r is None:
        return None
    return {
        "status": r.status,
        "seconds": r.seconds,
        "contradicted": r.contradicted,
        "start": r.energy_start,
        "begin": r.energy_begin,
        "end": r.energy,
        "rounds": [{key: getattr(one, key) for key in _ROUND} for one in r.rounds],
    }


def _pictures(folder: Path, run: Run, drawn: Mapping[str, Picture]) -> dict[str, float]:
    """Write the pictures; returns the values per unit of length of the 16-bit depth maps."""
    rec = run.reconstruction
    scales = {
        name: write_clipped_depth_png16(folder / f"depth_{name}.png", depth)
        for name, depth in (("ref", rec.depth_ref), ("next", rec.depth_next))
    }
    for name, file in FULL.items():
        (folder / file).unlink(missing_ok=True)
        if run.full is not None:
            depth = getattr(run.full, f"depth_{name.removesuffix('_full')}")
            scales[name] = write_clipped_depth_png16(folder / file, depth)
    for name, file in PICTURES.items():
        if name in drawn:
            write_picture(folder / file, drawn[name])
    overview(folder / "overview.png", drawn, run.problem.name)
    return scales


def renew_page(folder: Path) -> Path:
    """Make the page of a result folder again from its arrays; returns the file of the page.

    Args:
        folder: Result folder.

    Raises:
        DataError: the folder holds no result, or cannot be written.
    """
    result = load(folder)
    try:
        text = page(result, pictures(result))
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise DataError(
            "result lacks what a page shows", where=folder, found=repr(error), hint="solve it again"
        ) from error
    with extended(folder, overwrite=True) as new:
        write_text(new / PAGE, text)
    return folder / PAGE
