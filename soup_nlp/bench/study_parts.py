"""Studies of two parts: components cut off by the lower image border, and TRW-S."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from unittest import mock

import numpy as np
from scipy.spatial import cKDTree

from soup_nlp.bench.pair_views import cropped
from soup_nlp.bench.studies import Study, number, setting
from soup_nlp.config.problem import make_problem
from soup_nlp.mrf.levels import colours
from soup_nlp.mrf.trws import solve_trws
from soup_nlp.pipeline.run import run
from soup_nlp.storage.rows import Row

CROPPED = 0.3
"""Share of the rows that the study of components crops at the bottom."""
BORDER_RULE = "soup_nlp.start.components.nearer_where_cut_off"
"""Function that the study of components replaces in order to switch its rule off."""
ERRORS = ("start, contact", "NLP, contact", "start", "NLP")
NODES, LABELS, NEIGHBOURS, ITERATIONS = 1000, 50, 15, 10
"""Sizes of the TRW-S problem: those of a refinement with the default options."""


def measure_cut_off(scene: str, seed: int, superpixels: int, **size: int) -> Row:
    """MRE of start and NLP on a pair without its lower rows, without and with the border rule."""
    raw = {
        "input": {"kind": "scene", "scene": scene, "seed": seed, **size},
        "segmentation": {"superpixels": superpixels},
        "refine": {"enabled": False},
    }
    problem = make_problem(raw)
    whole = problem.load_pair()
    pair = replace(cropped(whole, 0, 0, 0, int(CROPPED * whole.image_ref.shape[0])), flow=None)
    assert pair.truth is not None
    assert pair.truth.components is not None
    with mock.patch(BORDER_RULE, lambda soup, label, log_scale, *rest: 0 * log_scale):
        contact = run(problem, pair=pair).metrics
    shipped = run(problem, pair=pair).metrics
    last = pair.truth.components[-1]
    errors = [m[name].mre for m in (contact, shipped) for name in ("start", "solution")]
    return {"cut": len(np.unique(last[last > 0])), **dict(zip(ERRORS, errors, strict=True))}


def _means(rows: Sequence[Row]) -> list[str]:
    lines = []
    for scene in dict.fromkeys(r["settings"]["scene"] for r in rows):
        own = [r for r in rows if r["settings"]["scene"] == scene]
        means = (f"{np.mean([r[name] for r in own]):.4f}" for name in ERRORS)
        lines.append(f"| {scene}, mean |  | {' | '.join(means)} |")
    return lines


CUT_OFF = Study(
    "cut_off",
    f"MRE (median scale, no cap) of rendered pairs without the lower {CROPPED:.0%} of their"
    " rows, by contact alone and as shipped: what the lower border cuts off is nearer than what"
    " it touches"
    " (`start.components`). DIS flow, {superpixels} superpixels, NLP without refinement.",
    measure_cut_off,
    {
        "pair, seed": lambda r: f"{r['settings']['scene']}, {r['settings']['seed']}",
        "components cut off": number("cut"),
        **{name: number(name, ".4f") for name in ERRORS},
    },
    _means,
)


def measure_trws(dtype: str) -> Row:
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
        max_iter=ITERATIONS,
        gap=-1.0,
        stagnation=-1.0,
        callback=lambda *_: stamps.append(time.perf_counter()),
    )
    each = 1e3 * np.diff(stamps)
    return {
        "edges": len(edges),
        "levels": int(colours(NODES, edges).max()) + 1,
        "median": float(np.median(each)),
        "least": float(each.min()),
        "bound": result.lower_bound,
        "energy": result.energy,
    }


TRWS = Study(
    "trws",
    f"TRW-S at {NODES} nodes and {LABELS} labels, {ITERATIONS} iterations.",
    measure_trws,
    {
        "precision": setting("dtype"),
        "edges": number("edges"),
        "levels": number("levels"),
        "ms an iteration": number("median", ".1f"),
        "least": number("least", ".1f"),
        "MiB": lambda r: f"{r['peak_bytes'] / 2**20:.0f}",
        "bound": number("bound", ".4f"),
        "energy": number("energy", ".4f"),
    },
)
