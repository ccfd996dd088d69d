"""Pictures and cameras of the kinds on public trackers: metadata, 16 bits, intrinsics, lenses."""

import re
import struct
import warnings
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers_files import load, photo, said, texture
from PIL import Image

from soup_nlp.data.formats.cameras import GUESS_SIGMA
from soup_nlp.data.formats.images import DataWarning, read_image, read_images
from soup_nlp.data.pair import Pair
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.data.working_size import scaled_camera
from soup_nlp.errors import ConfigError, DataError
from soup_nlp.pipeline.run import solve_pair

MIDDLE = (47.5, 31.5)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for k, name in enumerate("ab"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), texture(seed=k))
    return tmp_path


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


TIFF = b"II*\0"
EXIF = [
    *(b"\0\0\x11\0no TIFF", b"", b"\xff\xfe" * 3000, bytes(range(256)) * 9),
    # cut off, far away, a loop, many directories
    *(TIFF, TIFF + b"\xff\xff\xff\x7f", TIFF + b"\x08\0\0\0" + struct.pack("<HI", 0, 8)),
    TIFF + b"\x08\0\0\0\xff\xff" + b"\x69\x87\x04\0\x01\0\0\0\x08\0\0\0" * 9,
]


@pytest.mark.parametrize("kind", ["png", "jpg"])
@pytest.mark.parametrize("data", EXIF)
def test_malformed_exif_is_a_warning(data: bytes, kind: str, folder: Path) -> None:
    with Image.open(folder / "a.png") as image:
        image.save(folder / f"x.{kind}", exif=b"Exif\0\0" + data)
    pair, text = said(folder, f"x.{kind}")
    assert "EXIF is malformed" in text or (data, kind) != (EXIF[0], "png")
    assert pair.K_ref[0, 0] == pytest.approx(1.2 * 96)


@pytest.mark.parametrize(
    ("tags", "focal", "word"),
    [
        ({"FocalLengthIn35mmFilm": 29}, 29 / 36, "from EXIF"),
        ({"FocalLengthIn35mmFilm": 9000}, 1.2, "0.2 degrees of view.* is implausible"),
        ({"FocalLengthIn35mmFilm": 1}, 1.2, "is implausible"),
        # millimetres without the width of the sensor determine nothing
        ({"FocalLength": 5.0}, 1.2, "1.2 times the longer side.*--fov"),
    ],
)
def test_a_plausible_focal_length_of_exif_is_taken(tags, focal, word, tmp_path: Path) -> None:
    for name in "ab":
        photo(tmp_path / f"{name}.jpg", **tags)
    pair, text = said(tmp_path, "a.jpg", "b.jpg")
    assert re.search(word, text)
    assert pair.K_ref[0, 0] == pytest.approx(focal * 96, rel=1e-3)
    with warnings.catch_warnings(action="ignore", category=DataWarning):
        made = Pair(tmp_path / "a.jpg", tmp_path / "b.jpg")
    sigma = 0.0 if word == "from EXIF" else GUESS_SIGMA
    assert made.focal_sigma == pair.focal_sigma == sigma


# --- pictures that are not what they seem --------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "tags"), [("a.tif", {50706: 1}), ("a.NEF", {}), ("a.tiff", {254: 1}), ("a.hdr", {})]
)
def test_a_raw_photo_is_refused(name: str, tags: dict[int, int], tmp_path: Path) -> None:
    path = tmp_path / name
    if path.suffix == ".hdr":
        cv2.imwrite(str(path), texture().astype(np.float32))
    else:
        Image.fromarray(texture()).save(path, "TIFF", tiffinfo=tags)
    with pytest.raises(DataError, match=r"raw or HDR photo[\s\S]*expected: [\s\S]*try: develop it"):
        read_image(path)


@pytest.mark.parametrize("kind", ["gif", "tif", "webp", "png"])
def test_the_first_of_several_pages_is_used(kind: str, tmp_path: Path) -> None:
    one, other = (Image.fromarray(texture(seed=k)).quantize(64).convert("RGB") for k in (1, 2))
    options = {"lossless": True} if kind == "webp" else {}
    one.save(tmp_path / f"a.{kind}", save_all=True, append_images=[other], **options)
    with pytest.warns(DataWarning, match=rf"a\.{kind}: holds 2 pages or frames; the first one"):
        image = read_image(tmp_path / f"a.{kind}")
    np.testing.assert_array_equal(image, np.asarray(one))


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.jpg", {}),
        ("b.jpg", {"progressive": True}),
        ("a.tif", {"compression": "tiff_lzw"}),
        ("b.tif", {"compression": "tiff_deflate"}),
        ("c.tif", {"compression": "jpeg"}),
    ],
)
def test_a_picture_damaged_inside_gives_a_warning(name, options, tmp_path: Path, capfd) -> None:
    path = tmp_path / name
    Image.fromarray(texture(320, 240)).save(path, **options)
    read_image(path)  # gives no warning
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 400] = np.random.default_rng(0).bytes(400).replace(b"\xff", b"0")
    path.write_bytes(content)
    with pytest.warns(DataWarning, match=rf"{re.escape(name)}: is damaged"):
        read_image(path)
    assert capfd.readouterr().err == ""


@pytest.mark.slow
def test_an_interlaced_picture_gives_a_warning(tmp_path: Path) -> None:
    pair = render_scene("orbit", 0, 320, 136)
    both = pair.image_ref.copy()
    both[1::2] = pair.image_next[1::2]
    for image, combed in ((pair.image_ref, False), (both, True)):
        Image.fromarray(image).save(tmp_path / "a.png")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            read_image(tmp_path / "a.png")
        assert ["looks interlaced" in str(w.message) for w in caught] == [True] * combed


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
    with pytest.warns(DataWarning, match="16 bit"):
        pair = Pair(tmp_path / "a.png", tmp_path / "b.png", fov=60)
    np.testing.assert_array_equal([pair.image_ref, pair.image_next], [first, second])
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


# --- every frame has its own camera --------------------------------------------------------------


def test_each_frame_has_its_own_camera(tmp_path: Path) -> None:
    photo(tmp_path / "wide.jpg", FocalLengthIn35mmFilm=26)
    photo(tmp_path / "turned.jpg", turned=6, FocalLengthIn35mmFilm=26)
    photo(tmp_path / "tele.jpg", FocalLengthIn35mmFilm=77)
    photo(tmp_path / "small.jpg", texture(48, 32), FocalLengthIn35mmFilm=26)
    Image.fromarray(texture(48, 32)).save(tmp_path / "plain.png")
    expected = {
        "wide.jpg": (26 / 36 * 96, *MIDDLE),
        "turned.jpg": (26 / 36 * 96, *MIDDLE[::-1]),
        "tele.jpg": (77 / 36 * 96, *MIDDLE),
        "small.jpg": (26 / 36 * 48, 23.5, 15.5),
        # a frame without EXIF gets the focal length of the other frame
        "plain.png": (26 / 36 * 48, 23.5, 15.5),
    }
    for name, numbers in expected.items():
        for fov in (None, 60.0):
            pair, text = said(tmp_path, "wide.jpg", name, fov=fov)
            scale = 1.0 if fov is None else 48 / np.tan(np.radians(30)) / (26 / 36 * 96)
            K = pair.K_next
            np.testing.assert_allclose((K[0, 0], *K[:2, 2]), np.multiply(numbers, [scale, 1, 1]))
            assert K[1, 1] == K[0, 0]
            assert (name in text) == (fov is None)
    with pytest.raises(ConfigError, match="0 to 180"):
        load(tmp_path, "wide.jpg", "tele.jpg", fov=180.0)
    assert "radians" in said(tmp_path, "wide.jpg", "wide.jpg", fov=1.1)[1]


# --- implausible intrinsics ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("camera", "outside", "cause", "fits"),
    [
        ((240, 240, 143.5, 95.5), True, "an image of 288 x 192", "80,80,47.5,31.5"),
        ((40, 40, 23.5, 15.5), False, "an image of 48 x 32", "80,80,47.5,31.5"),
        # a principal point that is not exactly in the middle of an image of twice the size
        ((160, 160, 98, 61), True, "an image of 197 x 123", "80,80,48.75,30.25"),
        ((80, 160, 47.5, 63.5), False, "an image of 96 x 128", "80,80,47.5,31.5"),
        ((80, 80, 31.5, 47.5), False, "cx and cy are exchanged", "80,80,47.5,31.5"),
        ((80, 80, 33, 44), False, "cx and cy are exchanged", "80,80,44,33"),
        ((80, 47.5, 80, 31.5), False, "the order is fx cx fy cy", "80,80,47.5,31.5"),
        ((300, 47.5, 300, 31.5), True, "the order is fx cx fy cy", "300,300,47.5,31.5"),
        ((80, 120, 47.5, 31.5), False, "a crop, or a wrong file", "80,80,47.5,31.5"),
        ((80, 80, -3, 31.5), True, "a crop, or a wrong file", "80,80,47.5,31.5"),
        ((80, 80, 47.5, 60), False, "a crop, or a wrong file", "80,80,47.5,31.5"),
        # in millimetres
        ((5, 5, 47.5, 31.5), False, "a focal length that is not in", "115.2,115.2,47.5,31.5"),
    ],
)
def test_implausible_intrinsics_name_their_cause(
    camera, outside, cause, fits, folder: Path
) -> None:
    if outside:
        with pytest.raises(DataError, match="principal point is outside") as caught:
            load(folder, intrinsics=[*camera])
        text = str(caught.value)
        _, other = said(folder, intrinsics=[*camera], cropped=True)
        assert "middle" not in other
    else:
        pair, text = said(folder, intrinsics=[*camera])
        np.testing.assert_array_equal(pair.K_ref[:2, 2], camera[2:])
    assert cause in text
    assert f"{fits} would fit" in text


def test_distortion_is_named_or_removed(folder: Path) -> None:
    K, lens = np.array([[80, 0, 47.5], [0, 81, 31.5], [0, 0, 1]]), (0.3, -0.9, 0.01, -0.004, 0.2)
    (folder / "camera.txt").write_text("80 81 47.5 31.5 0.3 -0.9 0.01 -0.004 0.2")
    with pytest.raises(DataError, match=r"distortion[\s\S]*k1 0\.3[\s\S]*--undistort"):
        load(folder, intrinsics="camera.txt")
    pair = load(folder, intrinsics="camera.txt", undistort=True)
    # a pixel has the colour of the distorted image at OpenCV's projection of its ray
    u, v = 60, 20
    ray = np.linalg.inv(pair.K_ref) @ [u, v, 1.0]
    at, _ = cv2.projectPoints(ray[None], np.zeros(3), np.zeros(3), K, np.array(lens))
    x, y = (np.full((1, 1), c, np.float32) for c in at.ravel())
    image = read_image(folder / "a.png")
    seen = cv2.remap(image, x, y, cv2.INTER_LINEAR)[0, 0]
    # OpenCV rounds positions to 1/32 pixel
    np.testing.assert_allclose(pair.image_ref[v, u], seen, atol=4)


# --- depth ---------------------------------------------------------------------------------------


def test_an_assumed_scale_of_depth_gives_a_warning(folder: Path) -> None:
    cv2.imwrite(str(folder / "d.png"), np.full((64, 96), 2000, np.uint16))
    camera = [80.0, 80.0, 47.5, 31.5]
    for scale, depth in ((None, 2.0), (1000.0, 2.0), (256.0, 2000 / 256)):
        pair, text = said(folder, intrinsics=camera, depth="d.png", depth_scale=scale)
        assert pair.truth.depth_ref[0, 0] == depth
        assert ("assumed: 1000 values per unit" in text) == (scale is None)


@pytest.mark.parametrize("factor", [257, 16])
def test_8_bits_beside_16_are_stretched_alike(factor: int, tmp_path: Path) -> None:
    image = np.clip(texture().astype(int), 40, 200)
    cv2.imwrite(str(tmp_path / "a.png"), image.astype(np.uint8))
    cv2.imwrite(str(tmp_path / "b.png"), (image * factor).astype(np.uint16))
    with pytest.warns(DataWarning, match="16 bit beside 8 bit"):
        eight, sixteen = read_images([tmp_path / "a.png", tmp_path / "b.png"])
    if factor == 257:
        np.testing.assert_array_equal(eight, sixteen)
    assert eight.max() == 255
    with warnings.catch_warnings(action="error"):
        eight, _ = read_images([tmp_path / "a.png", tmp_path / "b.png"], white=257 * 255)
    np.testing.assert_array_equal(eight, image[:, :, ::-1])


@pytest.mark.parametrize("brand", [b"heic", b"mif1", b"crx "])
def test_heic_gives_an_error_with_a_hint(brand: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x18ftyp" + brand + bytes(100))
    with pytest.raises(DataError, match="convert it to PNG or JPEG first") as caught:
        read_image(tmp_path / "a.heic")
    assert "damaged" not in str(caught.value)


def test_intrinsics_of_arrays_are_checked_too() -> None:
    pair = render_scene("orbit", 0, 128, 54)
    other = replace(pair, K_next=scaled_camera(pair.K_next, (54, 128), (135, 320)))
    with pytest.raises(DataError, match=r"principal point is outside[\s\S]*K_next[\s\S]*320 x 135"):
        solve_pair(other)
    half = replace(pair, K_ref=scaled_camera(pair.K_ref, (54, 128), (32, 76)))
    with (
        pytest.warns(DataWarning, match="K_ref, 128 x 54.*an image of 76 x 32"),
        pytest.raises(ConfigError),
    ):
        solve_pair(half, preset="none")
    with pytest.raises(ConfigError):
        solve_pair(other, preset="none", cropped=True)


def test_plausible_intrinsics_give_no_warning(folder: Path) -> None:
    for four in ((80, 80, 47.5, 31.5), (80, 90, 40, 38), (500, 500, 55, 31)):
        assert said(folder, intrinsics=[*four])[1] == ""
    # the principal point of the next frame is checked against its own middle
    with pytest.warns(DataWarning, match=r"b\.png.*far from the middle"):
        load(folder, intrinsics=[80, 80, 47.5, 31.5], intrinsics_next=[80, 80, 20, 31.5])


def test_undistortion_needs_the_file_of_a_camera_and_no_truth(folder: Path) -> None:
    (folder / "K.txt").write_text("80 80 47.5 31.5 0.1")
    np.save(folder / "d.npy", np.ones((64, 96)))
    for keys in (
        {"intrinsics": [80.0, 80.0, 47.5, 31.5]},
        {"intrinsics": "K.txt", "depth": "d.npy"},
    ):
        with pytest.raises(ConfigError, match="cannot be undistorted"):
            load(folder, undistort=True, **keys)
