"""Pictures with titles and legends as PNG, alone and as an overview; 16-bit depth maps.

Every writer raises `DataError` if the file cannot be written.
"""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from importlib.resources import files
from io import BytesIO

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pil
from PIL import ImageDraw, ImageFont

from soup_nlp.arrays import AnyFloat, Image
from soup_nlp.errors import printable
from soup_nlp.report.pictures import Bar, Picture, Swatches, Wheel
from soup_nlp.storage.files import PathLike, write_bytes

_DPI = 100
_HEAD, _CAPTION, _GAP = 42, 28, 8
"""Height of the title, height of a caption, and space between panels, in pixels."""
_LEGEND = {type(None): 0, Bar: 32, Swatches: 24, Wheel: 62}
"""Height of a legend by its type, pixels."""
_SPARE = ("depth_start", "normals")
"""Panels that an overview leaves out, in this order, to fill its last row."""


def strip(panels: Sequence[Picture], title: str, columns: int = 3, panel_width: int = 420) -> Image:
    """(H, W, 3) uint8: titled pictures with their legends in a grid, under a title.

    Panels keep their aspect ratio.
    `columns` is the largest number of panels in a row, `panel_width` is in pixels.
    """
    columns = min(columns, len(panels))
    rows = [panels[k : k + columns] for k in range(0, len(panels), columns)]
    heights = [
        max(_height(p, panel_width) for p in row) + max(_LEGEND[type(p.legend)] for p in row)
        for row in rows
    ]
    head = _HEAD if title else _GAP
    size = columns * (panel_width + _GAP) + _GAP, head + sum(heights)
    sheet = Pil.new("RGB", (size[0], size[1] + len(rows) * (_CAPTION + _GAP)), "white")
    _write(sheet, _GAP, head // 2, title, size[0] - 2 * _GAP, points=13)
    top = head
    for row, height in zip(rows, heights, strict=True):
        for k, panel in enumerate(row):
            _draw_panel(sheet, panel, _GAP + k * (panel_width + _GAP), top, panel_width)
        top += height + _CAPTION + _GAP
    return np.array(sheet)


def write_picture(path: PathLike, picture: Picture) -> None:
    """Write a picture at its own size with its title above and its legend below, as PNG."""
    # titles need a width of 500 pixels
    write_png(path, strip([picture], "", panel_width=max(picture.image.shape[1], 500)))


def _height(picture: Picture, width: int) -> int:
    """Height in pixels of a picture that is drawn with some width."""
    return max(1, round(width * picture.image.shape[0] / picture.image.shape[1]))


def _draw_panel(sheet: Pil.Image, panel: Picture, left: int, top: int, width: int) -> None:
    """Draw title, picture and legend of a panel from its upper left corner, all in pixels."""
    _write(sheet, left, top + _CAPTION // 2, panel.title, width)
    top, tall = top + _CAPTION, _height(panel, width)
    # makes white panels visible on white paper
    frame = left - 1, top - 1, left + width, top + tall
    ImageDraw.Draw(sheet).rectangle(frame, outline="#999999")
    _place(sheet, panel.image, left, top, width, tall)
    bottom = top + tall
    if isinstance(panel.legend, Bar):
        _draw_bar(sheet, panel.legend, left, bottom, width)
    elif isinstance(panel.legend, Swatches):
        _draw_swatches(sheet, panel.legend, left, bottom, width)
    elif isinstance(panel.legend, Wheel):
        size = 52
        _place(sheet, panel.legend.image, left, bottom + 5, size, size)
        x, room = left + size + 10, width - size - 10
        _write(sheet, x, bottom + 5 + size // 2, panel.legend.text, room, points=8)


def _draw_bar(sheet: Pil.Image, bar: Bar, left: int, bottom: int, width: int) -> None:
    _place(sheet, bar.colours, left, bottom + 5, width, 10)
    last = len(bar.texts) - 1
    for k, text in enumerate(bar.texts):
        side = "l" if k == 0 else "r" if k == last else "m"
        _write(sheet, left + width * k / last, bottom + 24, text, points=8, side=side)


def _draw_swatches(sheet: Pil.Image, key: Swatches, left: int, bottom: int, width: int) -> None:
    x, y, last = float(left), bottom + 13, len(key.entries) - 1
    for i, (colour, name) in enumerate(key.entries):
        end = x + 16 + _font(8).getlength(name)
        # room for the dots where more follow
        if end + (20 if i < last else 0) > left + width:
            _write(sheet, x, y, "...", points=8)
            break
        ImageDraw.Draw(sheet).rectangle((x, y - 5, x + 11, y + 4), fill=colour)
        _write(sheet, x + 16, y, name, points=8)
        x = end + 15


@lru_cache(maxsize=100)
def _font(points: float) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which has more letters than the font that comes with Pillow."""
    file = files("soup_nlp.report") / "font" / "DejaVuSans.ttf"
    return ImageFont.truetype(BytesIO(file.read_bytes()), points * _DPI / 72)


def _write(
    sheet: Pil.Image,
    x: float,
    y: float,
    text: str,
    room: float = np.inf,
    *,
    points: float = 10,
    side: str = "l",
) -> None:
    """Draw text with its left end, middle or right end (`side`) at (x, y), shrunk to `room`."""
    text = printable(text)  # Pillow measures no lines
    wide = _font(points).getlength(text)
    font = _font(points * min(1.0, room / max(wide, 1.0)))
    ImageDraw.Draw(sheet).text((x, y), text, fill="black", font=font, anchor=f"{side}m")


def _place(sheet: Pil.Image, image: Image, left: int, top: int, width: int, height: int) -> None:
    """Draw an image in a rectangle."""
    # INTER_AREA keeps enlarged pixels rectangles of one colour
    scaled = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    sheet.paste(Pil.fromarray(scaled), (left, top))


def overview(drawn: Mapping[str, Picture], title: str) -> Image:
    """The pictures of a result in a grid of three columns.

    `_SPARE` ones are left out if they would leave a row incomplete.
    """
    panels = dict(drawn)
    for name in _SPARE:
        if len(panels) % 3:
            panels.pop(name, None)
    return strip([*panels.values()], title)


def write_png(path: PathLike, rgb: Image) -> None:
    """Write an (H, W, 3) uint8 RGB image as PNG."""
    encode_png(path, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))


def depth_png_scale(depth: AnyFloat) -> float:
    """Largest power of two at which the 99.9th percentile of the known depths fits 16 bits."""
    known = np.isfinite(depth) & (depth > 0)
    far = float(np.percentile(depth[known], 99.9)) if known.any() else 1.0
    return float(2.0 ** np.floor(np.log2(65535.0) - np.log2(far)))


def write_depth_png16(path: PathLike, depth: AnyFloat, scale: float | None = None) -> float:
    """Write a depth map as 16-bit PNG: value = round(depth * scale), at least 1.

    0 stands for what is unknown, or farther than 65535 can say: no depth is clipped.

    Args:
        path: File to write; its folder must exist.
        depth: (H, W) z; unknown where not finite or not positive.
        scale: Values per unit of depth, such as 256 (KITTI) or 1000 (millimetres of metres); None
            for `depth_png_scale`.

    Returns:
        The scale, which a reader needs: depth = value / scale.
    """
    z = np.asarray(depth, np.float64)
    scale = depth_png_scale(z) if scale is None else float(scale)
    with np.errstate(invalid="ignore"):
        value = np.round(z * scale)
        fits = (z > 0) & (value <= 65535)
    encode_png(path, np.where(fits, np.maximum(value, 1), 0).astype(np.uint16))
    return scale


def encode_png(path: PathLike, array: NDArray[np.generic]) -> None:
    """Write an array (H, W) of uint8 or uint16, or (H, W, 3) BGR, as PNG."""
    # files are a third smaller than at the default level
    _, data = cv2.imencode(".png", array, [cv2.IMWRITE_PNG_COMPRESSION, 2])
    write_bytes(path, data.tobytes())
