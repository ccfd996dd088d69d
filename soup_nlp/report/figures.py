"""Pictures with titles and legends as PNG, alone and in a grid; 16-bit depth maps.

Every writer raises `DataError` if the file cannot be written.
"""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from html import escape
from importlib.resources import files
from io import BytesIO

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pil
from PIL import ImageDraw, ImageFont

from soup_nlp.arrays import AnyFloat, Image
from soup_nlp.errors import printable
from soup_nlp.storage.files import PathLike, write_bytes

_DPI = 100
_HEAD, _CAPTION, _LEGEND, _GAP = 42, 28, 32, 8
"""Height of the title, a caption and a legend, and space between panels, in pixels."""


@dataclass(frozen=True)
class Legend:
    """Colours (1, M, 3) uint8 from left to right, and their meaning.

    `texts` are at even steps from end to end, or one for each of the M classes.
    """

    colours: Image
    texts: tuple[str, ...]

    @property
    def of_classes(self) -> bool:
        """Whether every colour has a text of its own."""
        return len(self.texts) == self.colours.shape[1]


@dataclass(frozen=True)
class Picture:
    """A picture of a result.

    Attributes:
        name: Stem of its file.
        title: Title.
        image: (H, W, 3) uint8 RGB.
        legend: Meaning of the colours; None for photographs.
    """

    name: str
    title: str
    image: Image
    legend: Legend | None = None


def strip(panels: Sequence[Picture], title: str, columns: int = 3, panel_width: int = 420) -> Image:
    """(H, W, 3) uint8: titled pictures with their legends in a grid, under a title.

    Panels keep their aspect ratio.
    `columns` is the largest number of panels in a row, `panel_width` is in pixels.
    """
    columns = min(columns, len(panels))
    rows = [panels[k : k + columns] for k in range(0, len(panels), columns)]
    heights = [
        max(_height(p, panel_width) + _LEGEND * (p.legend is not None) for p in row) for row in rows
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
    if panel.legend is None:
        return
    _place(sheet, panel.legend.colours, left, top + tall + 5, width, 10)
    texts, last = panel.legend.texts, len(panel.legend.texts) - 1
    for k, text in enumerate(texts):
        side, x = "l" if k == 0 else "r" if k == last else "m", left + width * k / max(last, 1)
        if panel.legend.of_classes:
            side, x = "m", left + width * (k + 0.5) / len(texts)
        _write(sheet, x, top + tall + 24, text, width / len(texts) - 4, points=8, side=side)


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


def shown(text: str, image: Image) -> str:
    """A text and a picture in HTML, for notebooks."""
    data = BytesIO()
    Pil.fromarray(image).save(data, format="png")
    source = f"data:image/png;base64,{base64.b64encode(data.getvalue()).decode()}"
    return f'<pre>{escape(text)}</pre><img alt="overview" style="max-width:100%" src="{source}">'


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
