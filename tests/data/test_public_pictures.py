"""Pictures of the kinds on public trackers: bytes behind them, metadata, more than 8 bits."""

from __future__ import annotations

import re
import struct
import warnings
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers_photos import load, photo, photos, said, texture
from PIL import Image, features

from soup_nlp.data.formats.cameras import GUESS_SIGMA
from soup_nlp.data.formats.images import DataWarning, read_image, read_images
from soup_nlp.data.pair import Pair
from soup_nlp.errors import DataError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return photos(tmp_path)


# --- bytes behind the end of a picture -----------------------------------------------------------


@pytest.mark.parametrize("kind", ["jpg", "progressive", "png"])
def test_bytes_behind_a_picture_do_not_matter(kind: str, tmp_path: Path) -> None:
    path = tmp_path / ("a.png" if kind == "png" else "a.jpg")
    Image.fromarray(texture()).save(path, **({"progressive": True} if kind[0] == "p" else {}))
    content, right = path.read_bytes(), read_image(path)
    random = np.random.default_rng(1)
    # scans, ends, a second picture, a chunk of PNG, a film
    tails = [b"\xff\xda\0\0", b"\xff\xd9\xff\xda", content, b"IDAT", b"\0\0\0\x18ftypmp42"]
    for tail in [*tails, *(random.bytes(2000) for _ in range(10))]:
        path.write_bytes(content + tail)
        np.testing.assert_array_equal(read_image(path), right)
    for share in (0.3, 0.9):
        path.write_bytes(content[: int(share * len(content))])
        with pytest.raises(DataError, match="is truncated"):
            read_image(path)


# --- metadata never ends a run -------------------------------------------------------------------


def with_chunk(png: bytes, kind: bytes, data: bytes) -> bytes:
    """A PNG with a further chunk behind its header."""
    chunk = struct.pack(">I", len(data)) + kind + data
    return png[:33] + chunk + struct.pack(">I", zlib.crc32(kind + data)) + png[33:]


@pytest.mark.parametrize("data", [b"\0\0\x11\0no TIFF", b"II*\0\xff\xff\xff\x7f", b""])
def test_malformed_exif_is_a_warning(data: bytes, folder: Path) -> None:
    png = (folder / "a.png").read_bytes()
    (folder / "a.png").write_bytes(with_chunk(png, b"eXIf", data))
    pair, text = said(folder)
    assert "EXIF is malformed" in text or data != b"\0\0\x11\0no TIFF"
    assert pair.K_ref[0, 0] == pytest.approx(1.2 * 96)


@pytest.mark.parametrize("kind", [b"MPF\0nonsense", b"ICC_PROFILE\0\x01\x01nonsense"])
def test_other_malformed_metadata_is_ignored(kind: bytes, folder: Path) -> None:
    Image.fromarray(texture()).save(folder / "a.jpg")
    content = (folder / "a.jpg").read_bytes()
    segment = b"\xff\xe2" + struct.pack(">H", len(kind) + 2) + kind
    (folder / "a.jpg").write_bytes(content[:2] + segment + content[2:])
    pair, text = said(folder, "a.jpg")
    assert text.count("\n") == 0
    assert pair.image_ref.shape == (64, 96, 3)


def test_exif_of_other_types_is_ignored(folder: Path) -> None:
    photo(folder / "a.tif", FocalLength=(1, 0), FocalPlaneXResolution=(0, 0))  # type: ignore[arg-type]
    assert said(folder, "a.tif")[0].K_ref[0, 0] == pytest.approx(1.2 * 96)


SENSOR = {"FocalPlaneXResolution": 4438.36, "FocalPlaneResolutionUnit": 2}


@pytest.mark.parametrize(
    ("tags", "focal", "word"),
    [
        # 135 mm for a picture that was reduced to 96 pixels: the sensor would be 0.5 mm wide
        ({"FocalLength": 135.0, **SENSOR, "ExifImageWidth": 96}, 1.2, "times the longer side"),
        # the same at 640 pixels with a lens that small sensors do not have
        ({"FocalLength": 18.0, **SENSOR, "ExifImageWidth": 640}, 1.2, "times the longer side"),
        # a picture of the whole sensor, 22.25 mm
        ({"FocalLength": 18.0, **SENSOR, "ExifImageWidth": 3888}, 18 / 22.25, "from EXIF"),
        # a cropped picture has other sides than EXIF
        (
            {"FocalLength": 18.0, **SENSOR, "ExifImageWidth": 3888, "ExifImageHeight": 1000},
            1.2,
            "times the longer side",
        ),
        ({"FocalLengthIn35mmFilm": 9000}, 1.2, "0.2 degrees of view.* is implausible"),
        ({"FocalLengthIn35mmFilm": 1}, 1.2, "is implausible"),
        # 5 mm before a sensor of 8 mm, EXIF of a picture ten times as large, resolution per cm
        (
            {
                "FocalLength": 5.0,
                "FocalPlaneXResolution": 1200.0,
                "FocalPlaneResolutionUnit": 3,
                "ExifImageWidth": 960,
            },
            5 / 8,
            "from EXIF",
        ),
        # millimetres without the width of the sensor determine nothing
        ({"FocalLength": 5.0}, 1.2, "1.2 times the longer side.*--fov"),
    ],
)
def test_a_plausible_focal_length_of_exif_is_taken(
    tags: dict[str, float], focal: float, word: str, tmp_path: Path
) -> None:
    for name in "ab":
        photo(tmp_path / f"{name}.jpg", **tags)
    pair, text = said(tmp_path, "a.jpg", "b.jpg")
    assert re.search(word, text)
    assert pair.K_ref[0, 0] == pytest.approx(focal * 96, rel=1e-3)
    with warnings.catch_warnings(action="ignore", category=DataWarning):
        made = Pair(tmp_path / "a.jpg", tmp_path / "b.jpg")
    sigma = 0.0 if word == "from EXIF" else GUESS_SIGMA
    assert made.focal_sigma == pair.focal_sigma == sigma


# --- pictures of more than 8 bits ----------------------------------------------------------------


@pytest.mark.parametrize(("low", "high"), [(28000, 30040), (0, 4095), (100, 60000), (16000, 65535)])
def test_16_bits_are_stretched_to_their_values(low: int, high: int, tmp_path: Path) -> None:
    ramp = np.linspace(0, 1, 96 * 64).reshape(64, 96)
    # both frames are stretched alike; a broken pixel does not change the stretch
    for name, values in (("a", ramp), ("b", 0.5 * ramp)):
        image = np.rint(low + (high - low) * values).astype(np.uint16)
        image[5, 5] = 65535
        cv2.imwrite(str(tmp_path / f"{name}.png"), image)
    with pytest.warns(DataWarning, match=f"16 bit, values {low} to 65535.*become black to white"):
        first, second = read_images([tmp_path / "a.png", tmp_path / "b.png"])
    assert first.min() == 0
    assert (first == 255).mean() == pytest.approx(0.01, abs=0.003)
    # half of the value, up to the outer percentiles and rounding
    usual = (ramp > 0.1) & (ramp < 0.9)
    np.testing.assert_allclose(second[..., 0][usual], first[..., 0][usual] / 2, atol=3)
    stretched = read_image(tmp_path / "a.png", white=high)
    assert stretched[-1, -1, 0] == 255
    assert stretched[0, 0, 0] == round(255 * low / high)
    # brighter than white
    assert stretched[5, 5, 0] == 255


@pytest.mark.skipif(not features.check("avif"), reason="this Pillow writes no AVIF")
@pytest.mark.parametrize("turned", [1, 6, 3])
@pytest.mark.filterwarnings("ignore:.*no intrinsics")
def test_avif_is_turned_by_exif(turned: int, tmp_path: Path) -> None:
    photo(tmp_path / "a.avif", turned=turned)
    photo(tmp_path / "a.jpg", turned=turned)
    pair = load(tmp_path, "a.avif", "a.jpg")
    assert pair.image_ref.shape == pair.image_next.shape
    difference = pair.image_ref.astype(int) - pair.image_next
    # both are compressed
    assert np.abs(difference).mean() < 8


@pytest.mark.parametrize("brand", [b"heic", b"mif1", b"crx "])
def test_heic_gives_an_error_with_a_hint(brand: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x18ftyp" + brand + bytes(100))
    with pytest.raises(DataError, match="convert it to PNG or JPEG first") as caught:
        read_image(tmp_path / "a.heic")
    assert "damaged" not in str(caught.value)
