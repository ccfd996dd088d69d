"""The result folder: every file whole or not at all, whatever the solve ended with."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from soup_nlp.errors import DataError
from soup_nlp.geometry.soup import Soup
from soup_nlp.report.atomic import atomic_path
from soup_nlp.report.figures import (
    colourise_depth,
    colourise_error,
    colourise_flow,
    depth_range,
    draw_superpixels,
    overview,
    write_depth_png16,
    write_png,
)
from soup_nlp.report.pointcloud import write_ply
from soup_nlp.report.store import Array, versions, write_h5, write_json

if TYPE_CHECKING:
    from soup_nlp.pipeline import Run


def prepare_folder(folder: str | Path) -> Path:
    """Make the output folder and prove that it can be written.

    Raises:
        DataError: it cannot.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".probe"
        probe.write_text("")
        probe.unlink()
    except OSError as error:
        raise DataError(
            "output folder cannot be written",
            where=folder,
            found=error.strerror,
            hint="choose another --out",
        ) from error
    return folder


def write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(text)


def write_folder(folder: Path, run: Run, config: str, log: str) -> list[str]:
    """Write every file of a run.

    Args:
        folder: Prepared folder.
        run: The run.
        config: Merged problem as YAML.
        log: Lines said during the run.

    Returns:
        Names of the files.
    """
    write_text(folder / "config.yaml", config)
    write_text(folder / "log.txt", log)
    write_h5(folder / "result.h5", _tree(run), _attributes(run, config))
    write_json(folder / "summary.json", summary(run))
    _pictures(folder, run)
    rec, image = run.reconstruction, run.pair.image_ref
    ok = np.isfinite(rec.depth_ref)
    write_ply(folder / "points_ref.ply", rec.points_ref[ok], image[ok])
    write_ply(folder / "points_next.ply", rec.points_next[ok], image[ok])
    return sorted(p.name for p in folder.iterdir() if p.is_file())


def summary(run: Run) -> dict[str, Any]:
    """What summary.json holds; the keys are stable."""
    s = run.solution
    return {
        "name": run.problem.name,
        "problem_hash": run.problem.digest(),
        "status": s.status,
        "converged": s.converged,
        "energy": {"start": dict(s.energy_start), "solution": dict(s.energy)},
        "residuals": dict(s.residuals),
        "metrics": {k: m.as_dict() for k, m in run.metrics.items()},
        "expected": run.problem.expected.model_dump(),
        "seconds": dict(run.seconds),
        "iterations": {st.name: st.iterations for st in s.stages},
        "sizes": {
            "superpixels": len(run.segmentation),
            "knn_edges": len(run.segmentation.edges),
            "neighbour_pairs": len(run.segmentation.pairs),
            "width": run.pair.size[1],
            "height": run.pair.size[0],
            **s.nlp,
        },
        "start": {
            "motions": len(run.start.motions),
            "borrowed": int(run.start.borrowed.sum()),
            "median_error_px": float(np.median(run.start.error)),
        },
        "flow": str(run.pair.flow),
        "versions": versions(),
        "seed": run.problem.seed,
    }


def _attributes(run: Run, config: str) -> dict[str, Any]:
    return {
        "name": run.problem.name,
        "problem_hash": run.problem.digest(),
        "seed": run.problem.seed,
        "status": run.solution.status,
        "config": config,
        "nlp": run.solution.description,
    }


def _soup(soup: Soup) -> dict[str, Array]:
    return {
        "lam": Array(soup.lam, "1", "scales on the simplex", "S"),
        "n": Array(soup.n, "1", "unit normals facing the camera", "S 3"),
        "d": Array(soup.d, "soup", "plane offsets before scaling", "S"),
        "R": Array(soup.R, "1", "rotations next_from_ref", "S 3 3"),
        "t": Array(soup.t, "soup", "translations before scaling", "S 3"),
    }


def _tree(run: Run) -> dict[str, Any]:
    pair, seg, start, rec = run.pair, run.segmentation, run.start, run.reconstruction
    assert pair.flow is not None
    truth: dict[str, Array] = {}
    if pair.truth is not None:
        unit = pair.truth.unit
        for name in ("depth_ref", "depth_next", "flow", "occluded", "bodies", "motions", "points"):
            value = getattr(pair.truth, name)
            if value is not None:
                truth[name] = Array(value, "px" if name == "flow" else unit, f"true {name}")
    history = {
        f"{k:02d}_{stage.name.replace(' ', '_')}": {
            key: Array(value, "1", f"Ipopt's {key} by iteration", "I")
            for key, value in stage.history.items()
        }
        for k, stage in enumerate(run.solution.stages)
    }
    multipliers = {
        k: Array(v, "1", "multipliers, positive at upper bounds")
        for k, v in run.solution.multipliers.items()
    }
    weights = {k: Array(np.float64(v), "1", f"weight {k}") for k, v in run.weights.__dict__.items()}
    form = run.problem.formulation.model_dump()
    weights["min_facing"] = Array(np.float64(form["min_facing"]), "1", "visibility bound c")
    weights["depth_ratio"] = Array(np.float64(form["depth_ratio"]), "1", "depth bound of a rim")
    return {
        "input": {
            "K_ref": Array(pair.K_ref, "px", "intrinsics of the reference frame", "3 3"),
            "K_next": Array(pair.K_next, "px", "intrinsics of the next frame", "3 3"),
            "flow": Array(pair.flow.uv, "px", "flow from reference to next", "H W 2"),
            "confidence": Array(pair.flow.confidence, "1", "flow confidence", "H W"),
        },
        "segmentation": {
            "labels": Array(seg.labels, "1", "superpixel of every pixel", "H W"),
            "anchors": Array(seg.anchors, "px", "centroids (u, v)", "S 2"),
            "sizes": Array(seg.sizes, "px", "pixels per superpixel", "S"),
            "knn": Array(seg.knn, "1", "K nearest anchors", "S K"),
            "edge_multiplicity": Array(seg.edge_multiplicity, "1", "directions of an edge", "E"),
            "boundary": Array(seg.boundary, "px", "sampled shared boundary", "P B 2"),
            "boundary_length": Array(seg.boundary_length, "px", "shared boundary pixels", "P"),
        },
        "energy": {
            k: Array(v, "see EnergyData", f"EnergyData.{k}") for k, v in run.data.arrays().items()
        },
        "weights": weights,
        "start": {
            **_soup(start.soup),
            "error": Array(start.error, "px", "re-projection error", "S"),
            "parallax": Array(start.parallax, "px", "parallax of the anchor", "S"),
            "borrowed": Array(start.borrowed, "1", "plane or motion from neighbours", "S"),
            "motion": Array(start.motion, "1", "dominant motion, -1 own", "S"),
        },
        "solution": _soup(run.soup),
        "multipliers": multipliers,
        "iterations": history,
        "depth": {
            "ref": Array(rec.depth_ref, "soup", "z of the reference frame", "H W"),
            "next": Array(rec.depth_next, "soup", "z of the next frame", "H W"),
            "start_ref": Array(run.start_reconstruction.depth_ref, "soup", "start's z", "H W"),
        },
        "truth": truth,
    }


def _pictures(folder: Path, run: Run) -> None:
    rec, pair, labels = run.reconstruction, run.pair, run.segmentation.labels
    for name, depth in (("ref", rec.depth_ref), ("next", rec.depth_next)):
        write_depth_png16(folder / f"depth_{name}.png", depth)
        near, far = depth_range(rec.depth_ref)
        write_png(folder / f"depth_{name}_colour.png", colourise_depth(depth, near, far))
    write_png(folder / "superpixels.png", draw_superpixels(pair.image_ref, labels))
    assert pair.flow is not None
    write_png(folder / "flow.png", colourise_flow(pair.flow.uv.astype(float)))
    metrics: Mapping[str, Any] = run.metrics
    truth = pair.truth.depth_ref if pair.truth is not None else None
    if truth is not None and "solution" in metrics:
        error = np.abs(rec.depth_ref * metrics["solution"].scale - truth) / truth
        write_png(folder / "error.png", colourise_error(error))
    overview(
        folder / "overview.png",
        pair,
        labels=labels,
        depths={"start": run.start_reconstruction.depth_ref, "solution": rec.depth_ref},
        normals=run.soup.n[labels],
        title=run.problem.name,
    )
