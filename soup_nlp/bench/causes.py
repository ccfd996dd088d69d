"""Where the depth error of a pair sits: pixels with a right flow, a wrong flow, and none.

Where the flow is right and nothing moves by itself, depth is also triangulated from the same flow
with the true motion of the camera. Where the solution is as good as that, only a better flow helps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from soup_nlp.arrays import Float, Mask
from soup_nlp.bench.analyses_report import page_head
from soup_nlp.bench.suite_pairs import Item
from soup_nlp.bench.tables import columns, failures, figure, page_text, pair_names, save, show
from soup_nlp.bench.truth import moves_by_itself
from soup_nlp.data.pair import Pair
from soup_nlp.errors import DataError
from soup_nlp.evaluate.protocols import preset
from soup_nlp.geometry.camera import pixel_grid, rays
from soup_nlp.pipeline.run import run
from soup_nlp.refine.anchored import fit_motion
from soup_nlp.start.epipolar import Motion, triangulate
from soup_nlp.storage.rows import Row

RIGHT_PX = 2.0
"""Largest error of a right flow, pixels."""
SURE = 0.5
"""Confidence from which a flow counts as known."""
MOST = 1.0
"""Relative errors of triangulated depths count at most this much."""
KINDS = {"right": "flow right", "wrong": "flow wrong", "none": "no flow"}
"""Names of what the flow is."""
SAMPLES = 20_000
"""Pixels to which the true motion of the camera is fitted."""


def measure_causes(item: Item, overrides: tuple[str, ...] = (), variant: str = "") -> Row:
    """MRE of a pair by what the flow is there, and that of the true motion with the same flow.

    Raises:
        DataError: the pair has no dense true depth and true flow.
    """
    result = run(item.problem(overrides))
    pair, truth = result.pair, result.pair.truth
    if truth is None or truth.depth_ref is None or truth.flow is None or pair.flow is None:
        raise DataError("pair has no dense true depth and true flow", where=pair.name)
    gt, z = truth.depth_ref, result.reconstruction.depth_ref
    rule = preset(item.presets[0])
    known = rule.mask(gt) & np.isfinite(gt) & np.isfinite(truth.flow).all(axis=2) & np.isfinite(z)
    error = np.abs(z * rule.score(z, gt).scale / np.where(known, gt, np.nan) - 1)
    gap = np.linalg.norm(pair.flow.uv - truth.flow, axis=2)
    sure = pair.flow.confidence > SURE
    kinds = {
        "right": known & sure & (gap <= RIGHT_PX),
        "wrong": known & sure & (gap > RIGHT_PX),
        "none": known & ~sure,
    }
    count = int(known.sum())
    rest = kinds["right"] & ~_moving(pair)
    triangulated = np.minimum(_triangulated(pair, rest), MOST)[rest]
    return {
        "status": result.solution.status,
        "good": result.solved,
        "metrics": {},
        "causes": {
            "mre": float(error[known].mean()),
            "share": {k: float(m.sum() / count) for k, m in kinds.items()},
            "part": {k: float(error[m].sum() / count) for k, m in kinds.items()},
            "noise_px": float(np.median(gap[kinds["right"]])),
            "static": [float(np.minimum(error, MOST)[rest].mean()), float(np.median(error[rest]))],
            "triangulated": [float(triangulated.mean()), float(np.median(triangulated))],
        },
    }


def _moving(pair: Pair) -> Mask:
    """(H, W) True where a component moves by itself."""
    assert pair.truth is not None
    label = pair.truth.components
    if label is None:
        return np.zeros(pair.size, bool)
    return np.asarray((label > 0) & moves_by_itself(pair.truth)[label])


def _triangulated(pair: Pair, rest: Mask) -> Float:
    """(H, W) relative error of depths triangulated under the camera's true motion.

    The motion is fitted to the true depth and the true flow of static pixels `rest`, and the flow
    of the pair is triangulated with it.
    """
    assert pair.truth is not None
    assert pair.flow is not None
    gt, true = pair.truth.depth_ref, pair.truth.flow
    assert gt is not None
    assert true is not None
    uv = pixel_grid(*pair.size)
    at = np.flatnonzero(rest)
    at = at[:: max(1, len(at) // SAMPLES)]
    r, q = rays(pair.K_ref, uv), rays(pair.K_next, uv + np.where(rest[..., None], true, 0.0))
    X = (gt[..., None] * r).reshape(-1, 3)[at]
    focal = float(pair.K_next[0, 0])
    begin = np.eye(3), np.array([0.0, 0.0, -1e-3 * float(np.median(X[:, 2]))])
    R, T = fit_motion(*begin, X, q.reshape(-1, 3)[at], np.ones(len(at)), focal, rounds=50)
    length = float(np.linalg.norm(T))
    seen = rays(pair.K_next, uv + pair.flow.uv).reshape(-1, 3)
    z, _ = triangulate(Motion(R, T / length), r.reshape(-1, 3), seen)
    z = np.where(z > 0, length * z, np.inf).reshape(pair.size)
    with np.errstate(invalid="ignore"):
        return np.abs(z / np.where(rest, gt, np.nan) - 1)


def text_causes(name: str, text: str, rows: Sequence[Row], note: str = "") -> str:
    """The page of the analysis."""
    good = [row for row in rows if row.get("ok")]
    names = dict(zip(map(id, good), pair_names(good), strict=True))

    def parts(row: Row, kind: str) -> str:
        own = row["causes"]
        return f"{own['share'][kind]:.0%}: {own['part'][kind]:.4f}"

    cells: dict[str, Callable[[Row], str]] = {
        "pair": lambda row: names[id(row)],
        "MRE": lambda row: show(row["causes"]["mre"]),
        **{words: partial(parts, kind=kind) for kind, words in KINDS.items()},
        "error of a right flow, px": lambda row: show(row["causes"]["noise_px"], ".3f"),
        "static, right flow: solution": lambda row: "{:.4f} ({:.4f})".format(
            *row["causes"]["static"]
        ),
        "the same flow, true motion": lambda row: "{:.4f} ({:.4f})".format(
            *row["causes"]["triangulated"]
        ),
    }
    lines = [
        "Columns of the flow: share of the true pixels, and their part of the MRE. A flow is right"
        f" within {RIGHT_PX:g} px where its confidence is above {SURE:g}. The last two columns:"
        " mean (median) error of the static pixels with a right flow, where errors above"
        f" {MOST:g} count as {MOST:g}. The last one triangulates every pixel with the true motion"
        " of the camera.",
        "",
        *columns(cells, good),
    ]
    return page_text([*page_head(name, text, rows, note), *lines, *failures(rows)])


def plot_causes(path: Path, rows: Sequence[Row]) -> None:
    """MRE of every pair as a bar, in parts by what the flow is there."""
    good = [row for row in rows if row.get("ok")]
    picture = figure(max(5.0, 0.9 * len(good)), 4)
    ax = picture.add_subplot()
    base = np.zeros(len(good))
    for kind, words in KINDS.items():
        part = np.array([row["causes"]["part"][kind] for row in good])
        ax.bar(range(len(good)), part, bottom=base, label=words)
        base += part
    ax.set_xticks(range(len(good)), pair_names(good), rotation=40, ha="right")
    ax.set_ylabel("part of the MRE")
    ax.legend()
    save(picture, path)
