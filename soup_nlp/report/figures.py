"""Depth, flow, normals and labels in colour; pictures with titles and legends; 16-bit depth maps.

Unknown values are grey, which none of the colour scales contains; unusable flow is black. Every
writer raises `DataError` if the file cannot be written.
"""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from html import escape
from importlib.resources import files
from io import BytesIO
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pil
from PIL import ImageDraw, ImageFont

from soup_nlp.arrays import AnyFloat, Image, Mask
from soup_nlp.errors import printable
from soup_nlp.storage.files import PathLike, write_bytes

UNKNOWN = 150
"""Grey level of unknown values."""
VIVID = (
    *((255, 127, 14), (44, 160, 44), (214, 39, 40), (148, 103, 189), (140, 86, 75)),
    *((227, 119, 194), (188, 189, 34), (23, 190, 207), (31, 119, 180)),
)
"""Colours of tab10 without its grey, which means unknown."""
PALE = 0.35
"""Share of its colour that drawn depth keeps; the rest is white."""
LEAST_RANGE = 1.1
"""Least ratio of the two ends of a colour scale of depth: bending papers have a relief of 7 to
27 %, drawn depth mostly one of 0 to 5 %."""


def depth_range(depth: AnyFloat) -> tuple[float, float]:
    """(near, far) of the colour scale of a depth map: its 2nd and 98th percentile.

    They are at least a tenth apart, so that a nearly constant depth has nearly one colour; (1, 2)
    if no depth is known.
    """
    z = np.asarray(depth, np.float64)
    z = z[np.isfinite(z) & (z > 0)]
    if z.size == 0:
        return 1.0, 2.0
    near, far = np.percentile(z, (2.0, 98.0))
    if far < near * LEAST_RANGE:
        middle, half = np.sqrt(near * far), np.sqrt(LEAST_RANGE)
        near, far = middle / half, middle * half
    return float(near), float(far)


def colourise_depth(depth: AnyFloat, near: float, far: float, drawn: Mask | bool = False) -> Image:
    """Depth (H, W) in colour by even steps of 1/z: near is red, far is blue, what is drawn is pale.

    It is grey where not finite or not positive.
    """
    z = np.asarray(depth, np.float64)
    known = np.isfinite(z) & (z > 0)
    safe = np.clip(np.where(known, z, near), near, far)
    colours = _paint((1 / safe - 1 / far) / (1 / near - 1 / far), known, "turbo")
    colours[known & drawn] = 255 - PALE * (255 - colours[known & drawn])
    return colours


def component_colours(count: int) -> Image:
    """(count, 3) colours of components: slate for the first, vivid colours for the others."""
    vivid, turns = np.array(VIVID, float), np.arange(count)
    faded = 0.75 ** (turns // len(vivid))[:, None]
    colours = np.vstack([[[126, 150, 190]], vivid[turns % len(vivid)] * faded])
    return colours[:count].astype(np.uint8)


def colourise_shares(values: AnyFloat, limit: float, name: str) -> Image:
    """Numbers (H, W) from 0 to a limit and above in a map of OpenCV, grey where not finite."""
    known = np.isfinite(values)
    return _paint(np.clip(np.where(known, values, 0.0) / limit, 0.0, 1.0), known, name)


def _paint(level: NDArray[np.float64], known: Mask, name: str) -> Image:
    """(H, W, 3) colours of levels (H, W) in [0, 1]."""
    steps = (level * 255).round().astype(np.uint8)
    out = cv2.applyColorMap(steps, getattr(cv2, f"COLORMAP_{name.upper()}"))[..., ::-1]
    return np.where(known[..., None], out, np.uint8(UNKNOWN))


def flow_limit(uv: AnyFloat) -> float:
    """Length, pixels, of full saturation of a flow (H, W, 2), NaN where unknown.

    It is the longest, but at most 1.5 times the 99th percentile.
    """
    length = np.hypot(uv[..., 0], uv[..., 1])
    length = length[np.isfinite(length)]
    if not length.size:
        return 1.0
    return max(float(min(length.max(), 1.5 * np.percentile(length, 99))), 1e-6)


def colourise_flow(uv: AnyFloat, limit: float) -> Image:
    """Flow (H, W, 2) in colour: hue is direction, red to the right; white is no motion.

    Colours are full from the length `limit`, pixels; black where the flow is not finite.
    """
    known: Mask = np.asarray(np.isfinite(uv).all(axis=2))
    u, v = np.moveaxis(np.where(known[..., None], uv, 0.0), 2, 0)
    hue = np.degrees(np.arctan2(v, u)) % 360
    length = np.minimum(np.hypot(u, v) / limit, 1.0)
    hsv = np.stack([hue, length, known], axis=2).astype(np.float32)
    return np.asarray(np.rint(255 * cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)), np.uint8)


def colourise_normals(n_map: AnyFloat) -> Image:
    """Unit normals (H, W, 3) in colour: (x, -y, -z) from [-1, 1] to RGB, grey where not finite."""
    known = np.isfinite(n_map).all(axis=2, keepdims=True)
    signed = np.where(known, n_map, 0.0) * [1.0, -1.0, -1.0]
    out = ((np.clip(signed, -1, 1) + 1) * 127.5).round().astype(np.uint8)
    return np.where(known, out, np.uint8(UNKNOWN))


def draw_superpixels(image: Image, labels: NDArray[np.integer]) -> Image:
    """The (H, W, 3) image with the boundaries of the labels (H, W) in yellow, one pixel wide."""
    edge = np.zeros(labels.shape, bool)
    edge[:, :-1] |= labels[:, :-1] != labels[:, 1:]
    edge[:-1] |= labels[:-1] != labels[1:]
    out = image.copy()
    out[edge] = (255, 255, 0)
    return out


# --- pictures with titles and legends -------------------------------------------------------------

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
    """A picture (H, W, 3) uint8 RGB of a result; `legend` is None for photographs."""

    title: str
    image: Image
    legend: Legend | None = None


def depth_legend(near: float, far: float, unit: str = "") -> Legend:
    """Legend of depths with five values; both ends name the unit."""
    first, *middle, last = (f"{z:.3g}" for z in 1 / np.linspace(1 / far, 1 / near, 5))
    colours = colourise_depth(1 / np.linspace(1 / far, 1 / near, 128)[None], near, far)
    return Legend(colours, (first + unit, *middle, last + unit))


def strip(panels: Sequence[Picture], title: str, columns: int = 3, panel_width: int = 420) -> Image:
    """(H, W, 3) uint8: titled pictures with their legends in a grid, under a title."""
    columns = min(columns, len(panels))
    rows = [panels[k : k + columns] for k in range(0, len(panels), columns)]
    tall = [[_height(p, panel_width) + _LEGEND * (p.legend is not None) for p in r] for r in rows]
    heights = [_CAPTION + max(row) + _GAP for row in tall]
    top, width = _HEAD if title else _GAP, columns * (panel_width + _GAP) + _GAP
    sheet = Pil.new("RGB", (width, top + sum(heights)), "white")
    _write(sheet, _GAP, top // 2, title, width - 2 * _GAP, points=13)
    for row, height in zip(rows, heights, strict=True):
        for k, panel in enumerate(row):
            _draw_panel(sheet, panel, _GAP + k * (panel_width + _GAP), top, panel_width)
        top += height
    return np.array(sheet)


def _height(picture: Picture, width: int) -> int:
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
    room: float,
    points: float = 10,
    side: str = "l",
) -> None:
    """Draw text with its left end, middle or right end (`side`) at (x, y), shrunk to `room`."""
    text = printable(text)  # Pillow measures no lines
    wide = _font(points).getlength(text)
    font = _font(points * min(1.0, room / max(wide, 1.0)))
    ImageDraw.Draw(sheet).text((x, y), text, fill="black", font=font, anchor=f"{side}m")


def _place(sheet: Pil.Image, image: Image, left: int, top: int, width: int, height: int) -> None:
    # INTER_AREA keeps enlarged pixels rectangles of one colour
    scaled = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    sheet.paste(Pil.fromarray(scaled), (left, top))


def data_url(image: Image, kind: str, **options: Any) -> str:
    """An image as an address that holds it, encoded by Pillow with some options."""
    data = BytesIO()
    Pil.fromarray(image).save(data, kind, **options)
    return f"data:image/{kind};base64,{base64.b64encode(data.getvalue()).decode()}"


def shown(text: str, image: Image) -> str:
    """A text and a picture in HTML, for notebooks."""
    source = data_url(image, "png")
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
    """Write a depth map (H, W) as 16-bit PNG: value = round(depth * scale), at least 1.

    0 stands for what is unknown (not finite or not positive), or farther than 65535 can say: no
    depth is clipped. Without a `scale`, in values per unit of depth, it is `depth_png_scale`.
    Returns the scale, which a reader needs: depth = value / scale.
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
