"""Components that the lower border cuts off, and time and memory of TRW-S."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
from scipy.spatial import cKDTree

from soup_nlp.bench.pair_views import cropped
from soup_nlp.bench.rows import Row, Say
from soup_nlp.bench.studies import made_on, run_study, settings_table
from soup_nlp.bench.tables import table
from soup_nlp.config.problem import make_problem
from soup_nlp.mrf.levels import colours
from soup_nlp.mrf.trws import solve_trws
from soup_nlp.pipeline.run import run

NEARER = "soup_nlp.start.components.nearer_where_cut_off"
"""What the study of components that are cut off switches off."""
CUT_OFF_HEAD = (
    "pair, seed",
    "components cut off",
    "start, contact",
    "NLP, contact",
    "start",
    "NLP",
)
NODES, LABELS, NEIGHBOURS = 1000, 50, 15
"""Sizes of the TRW-S study."""
TRWS_HEAD = ("precision", "edges", "levels", "ms an iteration", "least", "MiB", "bound", "energy")


def measure_cut_off(scene: str, seed: int, superpixels: int, lower: float) -> Row:
    """MRE of start and NLP on a pair without its lower rows, by contact alone and as shipped."""
    raw = {
        "input": {"kind": "scene", "scene": scene, "seed": seed},
        "segmentation": {"superpixels": superpixels},
        "refine": {"enabled": False},
    }
    problem = make_problem(raw)
    whole = problem.load_pair()
    pair = replace(cropped(whole, 0, 0, 0, int(lower * whole.image_ref.shape[0])), flow=None)
    assert pair.truth is not None
    assert pair.truth.components is not None
    with mock.patch(NEARER, lambda soup, label, log_scale, *rest: 0 * log_scale):
        contact = run(problem, pair=pair).metrics
    shipped = run(problem, pair=pair).metrics
    last = pair.truth.components[-1]
    return {
        "cut": len(np.unique(last[last > 0])),
        "mre": [m[name].mre for m in (contact, shipped) for name in ("start", "solution")],
    }


def study_cut_off(
    out: Path, seeds: Sequence[int], superpixels: int, lower: float, say: Say | None = None
) -> list[Row]:
    """Write OUT/cut_off.md."""
    note = (
        f"MRE (median scale, no cap) of rendered pairs without the lower {lower:.0%} of their"
        " rows, by contact alone and as shipped: what the lower border cuts off is nearer than what"
        f" it touches (`start.components`). DIS flow, {superpixels} superpixels, NLP without"
        f" refinement. {made_on()}"
    )

    def text(rows: Sequence[Row]) -> list[str]:
        lines = []
        for scene in ("street", "room"):
            own = [r for r in rows if r["settings"]["scene"] == scene]
            for r in own:
                errors = [f"{v:.4f}" for v in r["mre"]]
                lines.append([f"{scene}, {r['settings']['seed']}", str(r["cut"]), *errors])
            if own:
                means = np.mean([r["mre"] for r in own], axis=0)
                lines.append([f"{scene}, mean", "", *(f"{v:.4f}" for v in means)])
        return [note, "", *table(CUT_OFF_HEAD, lines)]

    settings = [
        {"scene": scene, "seed": seed, "superpixels": superpixels, "lower": lower}
        for scene in ("street", "room")
        for seed in seeds
    ]
    return run_study(out / "cut_off.md", settings, measure_cut_off, text, say)


def measure_trws(dtype: str, iterations: int) -> Row:
    """Levels, milliseconds an iteration, bound and energy of TRW-S on a random graph."""
    points = np.random.default_rng(0).random((NODES, 2))
    near = cKDTree(points).query(points, NEIGHBOURS + 1)[1][:, 1:]
    pairs = np.stack([np.repeat(np.arange(NODES), NEIGHBOURS), near.ravel()], axis=1)
    edges = np.unique(np.sort(pairs, axis=1), axis=0)
    rng = np.random.default_rng(1)
    unary = rng.random((NODES, LABELS))
    seed = rng.random((LABELS, LABELS)).astype(dtype)
    tables = seed * (1.0 + (np.arange(len(edges)) % 7)[:, None, None].astype(dtype))
    stamps: list[float] = []
    result = solve_trws(
        unary,
        edges,
        tables,
        dtype=np.dtype(dtype),
        max_iter=iterations,
        gap=-1.0,
        stagnation=-1.0,
        callback=lambda *_: stamps.append(time.perf_counter()),
    )
    each = 1e3 * np.diff(stamps)
    return {
        "edges": len(edges),
        "levels": int(colours(NODES, edges).max()) + 1,
        "milliseconds": [float(np.median(each)), float(each.min())],
        "bound": result.lower_bound,
        "energy": result.energy,
    }


def study_trws(out: Path, iterations: int, say: Say | None = None) -> list[Row]:
    """Write OUT/trws.md."""

    def cells(row: Row) -> list[str]:
        return [
            row["settings"]["dtype"],
            *(str(row[k]) for k in ("edges", "levels")),
            *(f"{ms:.1f}" for ms in row["milliseconds"]),
            f"{row['peak_bytes'] / 2**20:.0f}",
            *(f"{row[k]:.4f}" for k in ("bound", "energy")),
        ]

    note = f"TRW-S at {NODES} nodes and {LABELS} labels, {iterations} iterations. {made_on()}"
    settings = [{"dtype": dtype, "iterations": iterations} for dtype in ("float64", "float32")]
    text = settings_table(note, TRWS_HEAD, cells)
    return run_study(out / "trws.md", settings, measure_trws, text, say)
