"""Pictures with titles and legends as PNG, alone and as an overview; 16-bit depth maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import BboxImage
from matplotlib.patches import Rectangle
from matplotlib.text import Text
from matplotlib.transforms import Bbox, TransformedBbox
from numpy.typing import NDArray

from soup_nlp.errors import DataError
from soup_nlp.report.colour import Image
from soup_nlp.report.pictures import Bar, Picture, Swatches, Wheel
from soup_nlp.storage.atomic import PathLike, atomic_path, write_bytes

Float = NDArray[np.floating]

_DPI = 100
_FRAME = 0.6  # points
_CAPTION, _GAP = 0.28, 0.08  # inches
_LEGEND = {Bar: 0.32, Swatches: 0.24, Wheel: 0.62}
"""Height of a legend, inches."""
_SPARE = ("depth_start", "normals")
"""Panels that an overview leaves out, in this order, where its last row would have gaps."""


def overview_strip(
    path: PathLike,
    panels: Sequence[Picture],
    title: str,
    columns: int = 3,
    panel_width: float = 4.2,
) -> None:
    """Write `strip_figure` as PNG.

    Args:
        path: PNG file to write; its folder must exist.
        panels: In reading order.
        title: Above the panels; "" for none.
        columns: Largest number of panels in a row.
        panel_width: Width of a panel, inches at 100 dpi.

    Raises:
        DataError: the folder cannot be written.
    """
    figure = strip_figure(panels, title, columns, panel_width)
    with atomic_path(path) as temporary:
        # half the time of the default level, and files a tenth larger
        figure.savefig(temporary, format="png", dpi=_DPI, pil_kwargs={"compress_level": 3})


def strip_figure(
    panels: Sequence[Picture], title: str, columns: int = 3, panel_width: float = 4.2
) -> Figure:
    """Titled pictures with their legends in a grid, under a title.

    Panels keep their aspect; a row is as high as its highest panel. No global state of matplotlib
    is touched, so it may run in any thread.

    Args:
        panels: In reading order.
        title: Above the panels; "" for none.
        columns: Largest number of panels in a row.
        panel_width: Width of a panel, inches at 100 dpi.
    """
    columns = min(columns, len(panels))
    rows = [panels[k : k + columns] for k in range(0, len(panels), columns)]
    # layout in inches, from the top
    head = 0.42 if title else _GAP
    heights = [
        panel_width * max(p.image.shape[0] / p.image.shape[1] for p in row)
        + max(_legend_height(p) for p in row)
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
    return figure


def write_picture(path: PathLike, picture: Picture) -> None:
    """Write a picture at its own size with its title above and its legend below, as PNG.

    Raises:
        DataError: the folder cannot be written.
    """
    # narrower than this a title does not fit
    width = max(picture.image.shape[1] / _DPI, 5.0)
    overview_strip(path, [picture], "", panel_width=width)


def _legend_height(picture: Picture) -> float:
    return 0.0 if picture.legend is None else _LEGEND[type(picture.legend)]


def _draw_panel(figure: Figure, panel: Picture, left: float, top: float, width: float) -> None:
    """Title, picture and legend of a panel; inches from the lower left corner."""
    image = panel.image
    text = _write(figure, left, top - 0.5 * _CAPTION, panel.title)
    _shrink(figure, text, width)
    tall = width * image.shape[0] / image.shape[1]
    bottom = top - _CAPTION - tall
    _place(figure, image, left, bottom, width, tall)
    # so that a white panel is seen on white paper
    frame = Rectangle((left, bottom), width, tall, fill=False, linewidth=_FRAME, edgecolor="0.6")
    frame.set_transform(figure.dpi_scale_trans)
    figure.add_artist(frame)
    if isinstance(panel.legend, Bar):
        _draw_bar(figure, panel.legend, left, bottom, width)
    elif isinstance(panel.legend, Swatches):
        _draw_swatches(figure, panel.legend, left, bottom, width)
    elif isinstance(panel.legend, Wheel):
        size = 0.52
        _place(figure, panel.legend.image, left, bottom - size - 0.05, size, size)
        x, y = left + size + 0.1, bottom - 0.5 * size - 0.05
        _shrink(figure, _write(figure, x, y, panel.legend.text, fontsize=8), width - size - 0.1)


def _draw_bar(figure: Figure, bar: Bar, left: float, bottom: float, width: float) -> None:
    _place(figure, bar.colours, left, bottom - 0.15, width, 0.1)
    last = len(bar.texts) - 1
    for k, text in enumerate(bar.texts):
        side = "left" if k == 0 else "right" if k == last else "center"
        _write(figure, left + width * k / last, bottom - 0.24, text, fontsize=8, ha=side)


def _draw_swatches(figure: Figure, key: Swatches, left: float, bottom: float, width: float) -> None:
    x, y = left, bottom - 0.13
    for colour, name in key.entries:
        swatch = _place(figure, np.array(colour, np.uint8)[None, None], x, y - 0.05, 0.12, 0.1)
        text = _write(figure, x + 0.16, y, name, fontsize=8)
        x += 0.16 + _wide(figure, text) + 0.15
        if x > left + width:
            text.set_visible(False)
            swatch.set_visible(False)
            break


def _wide(figure: Figure, text: Text) -> float:
    """Width of a text, inches."""
    return float(text.get_window_extent(figure.canvas.get_renderer()).width) / _DPI  # type: ignore[attr-defined]


def _shrink(figure: Figure, text: Text, width: float) -> None:
    """Make a text small enough for a width in inches."""
    found = _wide(figure, text)
    if found > width:
        # font sizes are rounded when drawn
        text.set_fontsize(float(text.get_fontsize()) * 0.96 * width / found)


def _write(figure: Figure, x: float, y: float, text: str, **style: Any) -> Text:
    """Text as it is, without mathematics, at (x, y) inches."""
    wide, tall = figure.get_size_inches()
    return figure.text(x / wide, y / tall, text, va="center", parse_math=False, **style)


def _place(
    figure: Figure, image: Image, left: float, bottom: float, width: float, height: float
) -> BboxImage:
    """An image in a rectangle, inches. Axes, with their ticks, take twenty times as long."""
    box = TransformedBbox(Bbox.from_bounds(left, bottom, width, height), figure.dpi_scale_trans)
    placed = BboxImage(box, interpolation="antialiased", origin="upper")
    placed.set_data(image)
    figure.add_artist(placed)
    return placed


def overview(path: PathLike, found: Mapping[str, Picture], title: str) -> None:
    """Write the overview of a result: its pictures in a grid of three columns without gaps.

    Args:
        path: PNG file to write; its folder must exist.
        found: See `pictures`.
        title: Above the panels.

    Raises:
        DataError: the folder cannot be written.
    """
    overview_strip(path, without_gaps(found), title)


def without_gaps(found: Mapping[str, Picture]) -> list[Picture]:
    """The pictures of an overview: without the spare ones that would leave a row open."""
    panels = dict(found)
    for name in _SPARE:
        if len(panels) % 3:
            panels.pop(name, None)
    return [*panels.values()]


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
