"""Overviews of a result for reports, panel by panel, and images written as PNG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from soup_nlp.data.pair import Flow, Pair
from soup_nlp.errors import DataError
from soup_nlp.evaluate.metrics import depth_metrics, sample_at_points
from soup_nlp.report.colour import (
    ERROR_LIMIT,
    Image,
    colourise_depth,
    colourise_error,
    colourise_flow,
    colourise_normals,
    depth_range,
    draw_superpixels,
)
from soup_nlp.storage.atomic import PathLike, atomic_path, write_bytes

Float = NDArray[np.floating]
Bar = tuple[Image, str, str]
"""Colour bar of a panel: (1, M, 3) colours, text at their left end, text at their right end."""
Panel = tuple[str, Image] | tuple[str, Image, Bar]
"""Caption, (H, W, 3) uint8 RGB picture and, where colours are numbers, their bar."""

_DPI = 100
_FRAME = 0.6  # points
_BAR_HEIGHT, _CAPTION, _GAP = 0.2, 0.28, 0.08  # inches


def overview_strip(
    path: PathLike, panels: Sequence[Panel], title: str, columns: int = 3, panel_width: float = 4.2
) -> None:
    """Write a PNG of captioned panels in a grid, under a title.

    Panels keep their aspect; a row is as high as its highest panel. No global state of matplotlib
    is touched, so it may run in any thread.

    Args:
        path: PNG file to write; its folder must exist.
        panels: (caption, (H, W, 3) uint8 RGB[, colour bar]) in reading order.
        title: Above the panels; "" for none.
        columns: Largest number of panels in a row.
        panel_width: Width of a panel, inches at 100 dpi.

    Raises:
        DataError: the folder cannot be written.
    """
    columns = min(columns, len(panels))
    rows = [panels[k : k + columns] for k in range(0, len(panels), columns)]
    # layout in inches, from the top
    head = 0.42 if title else _GAP
    heights = [
        panel_width * max(panel[1].shape[0] / panel[1].shape[1] for panel in row)
        + _BAR_HEIGHT * any(len(panel) == 3 for panel in row)
        for row in rows
    ]
    width = columns * (panel_width + _GAP) + _GAP
    height = head + sum(h + _CAPTION + _GAP for h in heights)
    figure = Figure(figsize=(width, height), dpi=_DPI, facecolor="white")
    FigureCanvasAgg(figure)
    _write(figure, _GAP, height - 0.5 * head, title, fontsize=13, weight="bold")
    top = height - head
    for row, row_height in zip(rows, heights, strict=True):
        for k, panel in enumerate(row):
            _draw_panel(figure, panel, _GAP + k * (panel_width + _GAP), top, panel_width)
        top -= row_height + _CAPTION + _GAP
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", dpi=_DPI)


def _draw_panel(figure: Figure, panel: Panel, left: float, top: float, width: float) -> None:
    """Caption, picture and colour bar of a panel; inches from the lower left corner."""
    caption, image = panel[0], panel[1]
    _write(figure, left, top - 0.5 * _CAPTION, caption)
    tall = width * image.shape[0] / image.shape[1]
    bottom = top - _CAPTION - tall
    axes = _axes(figure, left, bottom, width, tall)
    axes.imshow(image, interpolation="antialiased", aspect="auto")
    axes.set(xticks=[], yticks=[])
    # so that a white panel is seen on white paper
    for side in axes.spines.values():
        side.set(linewidth=_FRAME, color="0.6")
    if len(panel) == 3:
        colours, low, high = panel[2]
        middle = bottom - 0.5 * _BAR_HEIGHT
        _write(figure, left, middle, low, fontsize=8)
        _write(figure, left + width, middle, high, fontsize=8, ha="right")
        axes = _axes(figure, left + 0.45, bottom - _BAR_HEIGHT + 0.05, width - 0.9, 0.1)
        axes.imshow(colours, interpolation="nearest", aspect="auto")
        axes.set_axis_off()


def _write(figure: Figure, x: float, y: float, text: str, **style: Any) -> None:
    """Text as it is, without mathematics, at (x, y) inches."""
    wide, tall = figure.get_size_inches()
    figure.text(x / wide, y / tall, text, va="center", parse_math=False, **style)


def _axes(figure: Figure, left: float, bottom: float, width: float, height: float) -> Axes:
    """Axes at a rectangle in inches."""
    wide, tall = figure.get_size_inches()
    return figure.add_axes((left / wide, bottom / tall, width / wide, height / tall))


def overview(
    path: PathLike,
    pair: Pair,
    labels: NDArray[np.integer],
    depths: Mapping[str, Float],
    normals: Float,
    title: str,
) -> None:
    """Write the overview of a result: input, superpixels, flow, depths, truth, error, normals.

    The depths share one colour range, that of the truth (without one, of the last of them), to
    which each is scaled by the median ratio; a caption holds the MRE by that rule and the coverage.
    The error shown is that of the last depth.

    Args:
        path: PNG file to write; its folder must exist.
        pair: Images, flow and truth (dense, or sparse points: an MRE without a picture).
        labels: (H, W) superpixels.
        depths: (H, W) z by stage, in order, such as "start", "solution", "refined".
        normals: (H, W, 3) unit normals.
        title: Above the panels.

    Raises:
        DataError: the folder cannot be written.
    """
    panels: list[Panel] = [("reference frame", pair.image_ref), ("next frame", pair.image_next)]
    count = f"{np.unique(labels).size} superpixels"
    panels.append((count, draw_superpixels(pair.image_ref, labels)))
    if pair.flow is not None:
        panels.append((f"flow ({pair.flow.source})", flow_picture(pair.flow)))
        sure = np.clip(pair.flow.confidence, 0, 1).astype(np.float64)
        grey = np.repeat((255 * sure).round().astype(np.uint8)[:, :, None], 3, axis=2)
        panels.append((f"confidence, {np.mean(sure > 0):.0%} above 0 (black)", grey))
    panels += _depth_panels(pair, depths)
    panels.append(("normals", colourise_normals(normals)))
    overview_strip(path, panels, title)


def flow_picture(flow: Flow) -> Image:
    """A flow in colour, black where it has no confidence."""
    sure = (flow.confidence > 0)[..., None]
    return colourise_flow(np.where(sure, flow.uv.astype(np.float64), np.nan))


def _depth_panels(pair: Pair, depths: Mapping[str, Float]) -> list[Panel]:
    """Panels of the depths on one scale, of the true depth and of the relative error."""
    truth = pair.truth.depth_ref if pair.truth is not None else None
    common = truth if truth is not None else [*depths.values()][-1]
    maps = {name: _scaled(pair, z, common) for name, z in depths.items()}
    near, far = depth_range(common if truth is not None else [*maps.values()][-1][0])
    levels = 1 / np.linspace(1 / far, 1 / near, 64)[None]
    bar = (colourise_depth(levels, near, far), f"{far:.3g}", f"{near:.3g}")
    out: list[Panel] = [
        (f"{name}{score}", colourise_depth(z, near, far), bar) for name, (z, score) in maps.items()
    ]
    if pair.truth is not None and truth is not None:
        out.append((f"true depth ({pair.truth.unit})", colourise_depth(truth, near, far), bar))
        for name, (z, _) in [*maps.items()][-1:]:
            known = (truth > 0) & (z > 0)
            error = np.full(truth.shape, np.nan)
            error[known] = np.abs(truth[known] - z[known]) / truth[known]
            shown = colourise_error(np.linspace(0, ERROR_LIMIT, 64)[None])
            bar = (shown, "0", f"{ERROR_LIMIT:g}")
            out.append((f"relative error, {name}", colourise_error(error), bar))
    return out


def _scaled(pair: Pair, depth: Float, common: Float) -> tuple[Float, str]:
    """A depth times its median ratio to the truth (to `common` without one), and its score."""
    z = np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)
    known = pair.truth is not None and pair.truth.depth_ref is not None
    estimate, target = z, common
    if not known and pair.truth is not None and pair.truth.points is not None:
        estimate, target = sample_at_points(z, pair.truth.points)
        known = True
    if not (np.isfinite(target) & (target > 0)).any():
        return z, ""
    m = depth_metrics(estimate, target)
    score = f", MRE {m.mre:.3f} ({m.scale_rule}), coverage {m.coverage:.0%}" if known else ""
    return (z * m.scale if m.n_pixels else z), score


def write_png(path: PathLike, rgb: Image) -> None:
    """Write an (H, W, 3) uint8 RGB image as PNG, whole or not at all.

    Raises:
        DataError: the folder cannot be written.
    """
    _encode(path, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))


def write_clipped_depth_png16(path: PathLike, depth: Float, scale: float | None = None) -> float:
    """Write a depth map as 16-bit PNG: value = round(depth * scale), 0 where unknown.

    A known depth is at least 1 in the file; what exceeds 65535 is written as 65535.

    Args:
        path: File to write; its folder must exist.
        depth: (H, W) z; unknown where not finite or not positive.
        scale: Values per unit of depth, such as 256 (KITTI) or 1000 (millimetres of metres). None
            takes the largest power of two at which the 99.9th percentile of the depth fits.

    Returns:
        The scale, which a reader needs: depth = value / scale.

    Raises:
        DataError: the folder cannot be written.
    """
    z = np.asarray(depth, np.float64)
    known = np.isfinite(z) & (z > 0)
    if scale is None:
        far = float(np.percentile(z[known], 99.9)) if known.any() else 1.0
        scale = float(2.0 ** np.floor(np.log2(65535.0) - np.log2(far)))
    value = np.clip(np.round(np.where(known, z, 0.0) * scale), 1, 65535)
    _encode(path, np.where(known, value, 0).astype(np.uint16))
    return float(scale)


def _encode(path: PathLike, array: NDArray[np.generic]) -> None:
    good, data = cv2.imencode(".png", array)
    if not good:
        raise DataError("image cannot be encoded as PNG", where=path, found=array.shape)
    write_bytes(path, data.tobytes())
