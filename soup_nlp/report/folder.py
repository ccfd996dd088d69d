"""The result folder; every file is written whole or not at all."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from soup_nlp.data.datasets.layout import MARK, is_result
from soup_nlp.data.pair import Pair
from soup_nlp.errors import DataError
from soup_nlp.evaluate.metrics import component_overlaps, skill
from soup_nlp.report.certainty import certainty
from soup_nlp.report.figures import overview, write_clipped_depth_png16, write_picture
from soup_nlp.report.formats import write_formats
from soup_nlp.report.page import page
from soup_nlp.report.pictures import Picture, pictures
from soup_nlp.report.result import result_of
from soup_nlp.report.shown import PAGE, of_folder, of_run
from soup_nlp.report.tree import attributes, result_tree
from soup_nlp.report.verdict import facts
from soup_nlp.solve.kkt import constraint_residuals
from soup_nlp.storage.atomic import write_text
from soup_nlp.storage.store import write_h5, write_json
from soup_nlp.storage.versions import versions

if TYPE_CHECKING:
    from soup_nlp.pipeline.run import Run

FULL = {"ref_full": "depth_ref_full.png", "next_full": "depth_next_full.png"}
"""Depth at the images' own size, where a pair was solved at a smaller one (`max_size`)."""

FILES = (
    "config.yaml",
    "result.h5",
    "summary.json",
    "log.txt",
    "ipopt.log",
    "depth_ref.png",
    "depth_next.png",
    "depth_ref_colour.png",
    "depth_next_colour.png",
    "superpixels.png",
    "components.png",
    "flow.png",
    "flow_confidence.png",
    "normals.png",
    "confidence.png",
    "error.png",
    "overview.png",
    PAGE,
    "motions.json",
    "trajectory.tum",
    "points_ref.ply",
    "points_next.ply",
)
"""Files of a result folder; error.png is there with dense truth only, confidence.png where the
uncertainty of the depth is known."""

PICTURES = {
    "depth_ref": "depth_ref_colour.png",
    "depth_next": "depth_next_colour.png",
    **{
        name: f"{name}.png"
        for name in (
            "superpixels",
            "components",
            "flow",
            "flow_confidence",
            "normals",
            "confidence",
            "error",
        )
    },
}
"""Files of the pictures that are written alone, by name."""

_ROUND = (
    "energy",
    "mrf_energy",
    "bound",
    "gap",
    "taken",
    "moved",
    "ties",
    "iterations",
    "status",
    "seconds",
    "proposed",
    "accepted",
)
"""Entries of a round of the refinement in summary.json."""


def prepare_folder(folder: str | Path, inputs: Iterable[Path] | None = None) -> Path:
    """Make the output folder and check that it can be written.

    Args:
        folder: The folder.
        inputs: Files and folders of the problem that is solved into it, see `input_paths`; neither
            these nor files that no solve has written are overwritten. None checks neither.

    Raises:
        DataError: it cannot be written, or holds what is not to be overwritten.
    """
    folder = Path(folder)
    if inputs is not None:
        _refuse_overwriting(folder, inputs)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        if inputs is not None:
            (folder / MARK).touch()
        # Ipopt appends to its log, stage by stage
        (folder / "ipopt.log").unlink(missing_ok=True)
    except OSError as error:
        raise DataError(
            "output folder cannot be written",
            where=folder,
            found=error.strerror,
            hint="choose another --out",
        ) from error
    return folder


def _refuse_overwriting(folder: Path, inputs: Iterable[Path]) -> None:
    """Raise DataError where a result would overwrite, or lie among, its inputs or foreign files."""

    def refuse(what: str, expected: str, found: str | None = None) -> DataError:
        return DataError(
            what, where=folder, found=found, expected=expected, hint="choose another --out"
        )

    for place in inputs:
        if place == folder.resolve():
            raise refuse(
                "output folder is the input's folder",
                "a folder of its own: depth and flow of a result would pass for truth",
            )
        if place.parent == folder.resolve() and place.name in (*FILES, *FULL.values()):
            raise refuse(
                "an input would be overwritten by the result",
                "a folder that holds none of the inputs under the name of a result's file",
                place.name,
            )
    own = (*FILES, *FULL.values())
    found = [] if is_result(folder) else [name for name in own if (folder / name).exists()]
    if found:
        raise refuse(
            "output folder holds files that would be overwritten and are of no earlier result",
            "a new or empty folder, or that of an earlier result",
            ", ".join(found),
        )


def write_folder(
    folder: Path, run: Run, config: str, log: str, verdict: str | None = None
) -> list[str]:
    """Write every file of a run, summary.json last: where it exists, the others are complete.

    The summary.json of an earlier result is removed first.

    Args:
        folder: Prepared folder.
        run: The run.
        config: Merged problem as YAML.
        log: Lines of the log.
        verdict: What the page shows as printed; None for `facts`.

    Returns:
        Names of the files.

    Raises:
        DataError: a file cannot be written.
    """
    (folder / "summary.json").unlink(missing_ok=True)
    write_text(folder / "config.yaml", config)
    write_text(folder / "log.txt", log)
    write_h5(folder / "result.h5", result_tree(run), attributes(run, config))
    told = summary(run)
    shown = of_run(run, told, facts(run) if verdict is None else verdict)
    drawn = pictures(shown)
    scales = _pictures(folder, run, drawn)
    write_formats(folder, result_of(run), ("motions", "ply"))
    if run.problem.output.page:
        write_text(folder / PAGE, page(shown, drawn))
    else:
        (folder / PAGE).unlink(missing_ok=True)
    write_json(folder / "summary.json", {**told, "depth_png_scale": scales})
    return [name for name in (*FILES, *FULL.values()) if (folder / name).is_file()]


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
        "energy": {"start": s.energy_start, "nlp": s.energy, "solution": run.energy},
        "residuals": run.residuals,
        "nlp_residuals": constraint_residuals(s.soup, run.data.rim_ray, facing),
        "answer_residuals": constraint_residuals(run.answer, run.data.rim_ray, facing),
        "refinement": _refinement(run),
        "metrics": {
            # the next frame has a constant depth of its own
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
        "flow": str(run.pair.flow),
        "versions": versions(),
        "seed": run.problem.seed,
    }


def _full_size(run: Run) -> dict[str, Any] | None:
    """Size and score of the depth at the images' own size; None where that was solved."""
    if run.full is None:
        return None
    height, width = run.full.depth_ref.shape
    scores = run.full.metrics
    return {"width": width, "height": height, "metrics": scores and scores.as_dict()}


def _components(run: Run) -> dict[str, Any]:
    """How many components there are, and how they overlap with the true ones."""
    truth = run.pair.truth
    out: dict[str, Any] = {"count": len(run.components)}
    if truth is not None and truth.components is not None:
        found = component_overlaps(run.components.of_pixel, truth.components)
        out["truth"] = {str(k): {"component": c, "iou": iou} for k, (c, iou) in found.items()}
    return out


def _refinement(run: Run) -> dict[str, Any] | None:
    """Progress of the refinement by round; None where it was off."""
    r = run.refined
    if r is None:
        return None
    return {
        "status": r.status,
        "polish_gain": r.polish_gain,
        "seconds": r.seconds,
        "begin": r.energy_begin,
        "end": r.energy,
        "rounds": [{key: getattr(one, key) for key in _ROUND} for one in r.rounds],
    }


def _pictures(folder: Path, run: Run, drawn: Mapping[str, Picture]) -> dict[str, float]:
    """Write the pictures; values per unit of length of the two 16-bit depth maps."""
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
        else:
            (folder / file).unlink(missing_ok=True)
    overview(folder / "overview.png", drawn, run.problem.name)
    return scales


def renew_page(folder: Path, pair: Pair | None = None) -> Path:
    """Make the page of a result folder from its arrays; what else is there stays as it is.

    Args:
        folder: A result folder, of an earlier version too.
        pair: Its input, see `of_folder`.

    Returns:
        The page.

    Raises:
        DataError: the folder holds no result, or cannot be written.
    """
    shown = of_folder(folder, pair)
    try:
        text = page(shown, pictures(shown))
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise DataError(
            "result lacks what a page shows", where=folder, found=repr(error), hint="solve it again"
        ) from error
    write_text(folder / PAGE, text)
    return folder / PAGE
