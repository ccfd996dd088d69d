"""Inputs that people feed such programs: the kinds of public trackers, with variants."""

from __future__ import annotations

import re
import struct
import warnings
import zlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers_files import write_flo, write_kitti_flow, write_pfm
from PIL import ExifTags, Image, features

from soup_nlp.config.problem import make_problem
from soup_nlp.data.datasets.folders import TumInput
from soup_nlp.data.flow.dis import dis_flow
from soup_nlp.data.flow.sources import FlowOptions, resolve_flow
from soup_nlp.data.formats.camera_files import read_camera, read_intrinsics
from soup_nlp.data.formats.images import DataWarning, read_image, read_images
from soup_nlp.data.formats.map_files import read_depth, read_flow
from soup_nlp.data.pair import Flow, Pair
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.data.working_size import at_common_focal, resized_flow, scaled_camera
from soup_nlp.errors import ConfigError, DataError
from soup_nlp.pipeline.run import solve_pair

SIZE = (96, 64)  # width, height
MIDDLE = (47.5, 31.5)
EXIF, IFD = ExifTags.Base, ExifTags.IFD.Exif


def texture(width: int = SIZE[0], height: int = SIZE[1], seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 256, (height, width, 3)).astype(np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 1.5))


def photo(path: Path, image: np.ndarray | None = None, turned: int = 1, **tags: float) -> Path:
    """A picture with EXIF; `tags` are those of the camera."""
    picture = Image.fromarray(texture() if image is None else image)
    exif = picture.getexif()
    exif[EXIF.Orientation] = turned
    exif.get_ifd(IFD).update({EXIF[name]: value for name, value in tags.items()})
    picture.save(path, exif=exif)
    return path


def load(folder: Path, ref: str = "a.png", following: str = "b.png", **keys: object) -> Pair:
    source = {"kind": "files", "ref": ref, "next": following, **keys}
    return make_problem({"input": source, "base": str(folder)}).load_pair()


def said(*args: object, **keys: object) -> tuple[Pair, str]:
    """A loaded pair and its warnings, all of which are about data."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        pair = load(*args, **keys)  # type: ignore[arg-type]
    assert {w.category for w in caught} <= {DataWarning}
    return pair, "\n".join(str(w.message) for w in caught)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for k, name in enumerate("ab"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), texture(seed=k))
    return tmp_path


# --- 1 bytes behind the end of a picture ---------------------------------------------------------


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


# --- 2 metadata never ends a run -----------------------------------------------------------------


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
        # 135 mm of a picture that was reduced to 96 pixels: its sensor would measure 0.5 mm
        ({"FocalLength": 135.0, **SENSOR, "ExifImageWidth": 96}, 1.2, "times the longer side"),
        # the same at 640 pixels with a lens that small sensors do not have
        ({"FocalLength": 18.0, **SENSOR, "ExifImageWidth": 640}, 1.2, "times the longer side"),
        # of the whole sensor: 22.25 mm
        ({"FocalLength": 18.0, **SENSOR, "ExifImageWidth": 3888}, 18 / 22.25, "from EXIF"),
        # of a crop: it has other sides
        (
            {"FocalLength": 18.0, **SENSOR, "ExifImageWidth": 3888, "ExifImageHeight": 1000},
            1.2,
            "times the longer side",
        ),
        ({"FocalLengthIn35mmFilm": 9000}, 1.2, "0.2 degrees of view.* is implausible"),
        ({"FocalLengthIn35mmFilm": 1}, 1.2, "is implausible"),
    ],
)
def test_an_absurd_focal_length_is_ignored(
    tags: dict[str, float], focal: float, word: str, tmp_path: Path
) -> None:
    for name in "ab":
        photo(tmp_path / f"{name}.jpg", **tags)
    pair, text = said(tmp_path, "a.jpg", "b.jpg")
    assert re.search(word, text)
    assert pair.K_ref[0, 0] == pytest.approx(focal * 96, rel=1e-3)


# --- 3 every frame has its own camera ------------------------------------------------------------


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
        # without EXIF the lens is the other frame's
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


@pytest.mark.parametrize("factor", [0.5, 2.0, 1 / 3])
def test_frames_of_other_focal_lengths_have_a_flow(factor: float) -> None:
    pair = render_scene("orbit", 0, 256, 108)
    size = round(256 * factor), round(108 * factor)
    image = cv2.resize(pair.image_next, size, interpolation=cv2.INTER_AREA)
    K = scaled_camera(pair.K_next, (108, 256), size[::-1])
    found = FlowOptions().load(Pair(pair.image_ref, image, pair.K_ref, K), Path)
    equal = FlowOptions().load(pair, Path)
    assert pair.truth is not None
    at = np.stack(np.meshgrid(np.arange(256), np.arange(108)), axis=-1)
    # pixel centres are at whole numbers
    true = (at + pair.truth.flow + 0.5) * np.divide(size, (256, 108)) - 0.5 - at
    use = found.confidence > 0
    assert use.mean() > 0.9 * (equal.confidence > 0).mean()
    # a third of the resolution costs a third of a pixel at most
    assert np.median(np.linalg.norm(found.uv - true, axis=2)[use]) < 0.2


def test_flow_of_reduced_frames_is_not_mixed_at_edges() -> None:
    images = [np.zeros((16, 20, 3), np.uint8), np.zeros((8, 10, 3), np.uint8)]
    fine = Pair(images[0], images[1], (20, 20, 9.5, 7.5), (10, 10, 4.5, 3.5))
    near = at_common_focal(fine)
    assert near.size == (8, 10)
    np.testing.assert_allclose(near.K_ref, near.K_next)
    uv = np.zeros((8, 10, 2))
    uv[:, 5:] = 3, -1
    found = resized_flow(Flow(uv), near, fine)
    at = np.stack(np.meshgrid(np.arange(20), np.arange(16)), axis=-1)
    # displacement in pixels of the next image, of which a pixel has two of the reference image
    shift = at + found.uv - ((at + 0.5) / 2 - 0.5)
    np.testing.assert_allclose(shift[:, :10], 0, atol=1e-6)
    np.testing.assert_allclose(shift[:, 10:], np.broadcast_to((3, -1), (16, 10, 2)), atol=1e-6)


def test_focal_lengths_that_the_images_contradict_are_said() -> None:
    pair = render_scene("orbit", 0, 256, 108)
    K = pair.K_next * [[3, 1, 1], [1, 3, 1], [1, 1, 1]]
    with pytest.warns(DataWarning, match="not at their focal lengths.*probably wrong"):
        found = FlowOptions().load(Pair(pair.image_ref, pair.image_next, pair.K_ref, K), Path)
    np.testing.assert_array_equal(found.uv, FlowOptions().load(pair, Path).uv)


# --- 4 implausible intrinsics --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "outside", "cause", "fits"),
    [
        ((240, 240, 143.5, 95.5), True, "an image of 288 x 192", "80,80,47.5,31.5"),
        ((40, 40, 23.5, 15.5), False, "an image of 48 x 32", "80,80,47.5,31.5"),
        ((80, 160, 47.5, 63.5), False, "an image of 96 x 128", "80,80,47.5,31.5"),
        ((80, 80, 31.5, 47.5), False, "cx and cy are exchanged", "80,80,47.5,31.5"),
        ((80, 80, 33, 44), False, "cx and cy are exchanged", "80,80,44,33"),
        ((80, 47.5, 80, 31.5), False, "the order is fx cx fy cy", "80,80,47.5,31.5"),
        ((300, 47.5, 300, 31.5), True, "the order is fx cx fy cy", "300,300,47.5,31.5"),
        ((80, 120, 47.5, 31.5), False, "a crop, or a wrong file", "80,80,47.5,31.5"),
        ((80, 80, -3, 31.5), True, "a crop, or a wrong file", "80,80,47.5,31.5"),
        ((80, 80, 47.5, 60), False, "a crop, or a wrong file", "80,80,47.5,31.5"),
    ],
)
def test_implausible_intrinsics_name_their_cause(
    given: tuple[float, ...], outside: bool, cause: str, fits: str, folder: Path
) -> None:
    if outside:
        with pytest.raises(DataError, match="principal point is outside") as caught:
            load(folder, intrinsics=[*given])
        text = str(caught.value)
        _, other = said(folder, intrinsics=[*given], cropped=True)
        assert "middle" not in other
    else:
        pair, text = said(folder, intrinsics=[*given])
        np.testing.assert_array_equal(pair.K_ref[:2, 2], given[2:])
    assert cause in text
    assert f"{fits} would fit" in text


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


def test_plausible_intrinsics_are_taken_without_a_word(folder: Path) -> None:
    for four in ((80, 80, 47.5, 31.5), (80, 90, 40, 38), (500, 500, 55, 31)):
        assert said(folder, intrinsics=[*four])[1] == ""
    # the middle of the next frame is another one
    with pytest.warns(DataWarning, match=r"b\.png.*far from the middle"):
        load(folder, intrinsics=[80, 80, 47.5, 31.5], intrinsics_next=[80, 80, 20, 31.5])


LENS = (0.3, -0.9, 0.01, -0.004, 0.2)


@pytest.mark.parametrize(
    "text",
    [
        "80 81 47.5 31.5 0.3 -0.9 0.01 -0.004 0.2",
        "80, 0, 47.5\n0, 81, 31.5\n0, 0, 1\n0.3, -0.9, 0.01, -0.004, 0.2",
        "fx: 80\nfy: 81\ncx: 47.5\ncy: 31.5\nk1: 0.3\nk2: -0.9\np1: 1e-2\np2: -0.004\nk3: 0.2",
        '{"fx": 80, "fy": 81, "cx": 47.5, "cy": 31.5, "k1": 0.3, "k2": -0.9, "p1": 0.01,'
        ' "p2": -0.004, "k3": 0.2}',
        "%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
        "   data: [80., 0., 47.5, 0., 81., 31.5, 0., 0., 1.]\n"
        "distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 5\n   dt: d\n"
        "   data: [0.3, -0.9, 0.01, -0.004, 0.2]\n",
        "image_width: 96\nK: [80, 0, 47.5, 0, 81, 31.5, 0, 0, 1]\n"
        "D: [0.3, -0.9, 0.01, -0.004, 0.2]\ndistortion_model: plumb_bob\n",
    ],
)
def test_distortion_is_named_or_removed(text: str, folder: Path) -> None:
    (folder / "camera.txt").write_text(text)
    K, distortion = read_camera(folder / "camera.txt")
    np.testing.assert_allclose(distortion, LENS)
    np.testing.assert_allclose(K, [[80, 0, 47.5], [0, 81, 31.5], [0, 0, 1]])
    with pytest.raises(DataError, match=r"distortion[\s\S]*k1 0\.3[\s\S]*--undistort"):
        load(folder, intrinsics="camera.txt")
    pair = load(folder, intrinsics="camera.txt", undistort=True)
    # a pixel shows what the distorted image has where OpenCV projects its ray
    u, v = 60, 20
    ray = np.linalg.inv(pair.K_ref) @ [u, v, 1.0]
    at, _ = cv2.projectPoints(ray[None], np.zeros(3), np.zeros(3), K, np.array(LENS))
    x, y = (np.full((1, 1), c, np.float32) for c in at.ravel())
    image = read_image(folder / "a.png")
    seen = cv2.remap(image, x, y, cv2.INTER_LINEAR)[0, 0]
    # OpenCV rounds places to 1/32 pixel
    np.testing.assert_allclose(pair.image_ref[v, u], seen, atol=4)


def test_undistortion_needs_the_file_of_a_camera_and_no_truth(folder: Path) -> None:
    (folder / "K.txt").write_text("80 80 47.5 31.5 0.1")
    np.save(folder / "d.npy", np.ones((64, 96)))
    for keys in (
        {"intrinsics": [80.0, 80.0, 47.5, 31.5]},
        {"intrinsics": "K.txt", "depth": "d.npy"},
    ):
        with pytest.raises(ConfigError, match="cannot be undistorted"):
            load(folder, undistort=True, **keys)


def test_lenses_that_are_not_distorted_or_of_another_model(folder: Path) -> None:
    (folder / "K.txt").write_text("80 80 47.5 31.5 0 0 0 0 0")
    assert read_intrinsics(folder / "K.txt")[0, 0] == 80
    (folder / "K.yaml").write_text("camera_model: equidistant\nK: [1, 0, 0, 0, 1, 0, 0, 0, 1]")
    with pytest.raises(DataError, match="fisheye"):
        read_intrinsics(folder / "K.yaml")
    (folder / "K.txt").write_text("80 80 47.5 31.5 640 480")
    with pytest.raises(DataError, match="wrong number of values"):
        read_intrinsics(folder / "K.txt")


# --- 5 layouts beside the one --------------------------------------------------------------------


def tum(folder: Path, **options):
    return TumInput(kind="tum", path=str(folder), **options).load(Path)


@pytest.mark.parametrize("name", ["K.txt", "camera.txt", None])
def test_tum_format_of_other_sensors(name: str | None, tmp_path: Path) -> None:
    (tmp_path / "rgb").mkdir()
    for k in range(2):
        # the middle of the default camera of TUM
        cv2.imwrite(str(tmp_path / "rgb" / f"{k}.png"), texture(640, 480, k))
    (tmp_path / "rgb.txt").write_text("0.0 rgb/0.png\n0.1 rgb/1.png\n")
    if name is None:
        with pytest.warns(DataWarning, match="assumed: the intrinsics of the default camera"):
            assert tum(tmp_path).K_ref[0, 0] == 525
        return
    (tmp_path / name).write_text("# fx fy cx cy\n542.8 542.6 315.6 237.8\n")
    assert tum(tmp_path).K_next[0, 0] == 542.8
    # the scale of depth is said too
    cv2.imwrite(str(tmp_path / "d.png"), np.full((480, 640), 1000, np.uint16))
    (tmp_path / "depth.txt").write_text("0.0 d.png\n")
    with pytest.warns(DataWarning, match="depth is not given; assumed: 5000 values"):
        assert tum(tmp_path).truth.depth_ref[0, 0] == 0.2
    assert (
        TumInput(kind="tum", path=str(tmp_path), depth_scale=1000.0)
        .load(Path)
        .truth.depth_ref[0, 0]
        == 1
    )
    # a camera whose y axis points up
    (tmp_path / name).write_text("481.2 0 319.5\n0 -480 239.5\n0 0 1\n")
    with pytest.raises(DataError, match="fy without its sign"):
        tum(tmp_path)


@pytest.mark.parametrize("kind", ["files", "folder"])
def test_the_scale_of_depth_is_given_or_said(kind: str, folder: Path) -> None:
    for k, name in enumerate("ab"):
        (folder / f"{name}.png").rename(folder / f"frame_{k}.png")
    (folder / "K.txt").write_text("80 80 47.5 31.5")
    cv2.imwrite(str(folder / "depth_0.png"), np.full((64, 96), 2000, np.uint16))
    source = {"kind": kind, "path": str(folder)}
    if kind == "files":
        names = {"ref": "frame_0.png", "next": "frame_1.png", "depth": "depth_0.png"}
        source = {"kind": kind, "intrinsics": "K.txt", **names}
    for scale, depth in ((None, 2.0), (1000.0, 2.0), (256.0, 2000 / 256)):
        problem = make_problem({"input": {**source, "depth_scale": scale}, "base": str(folder)})
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            truth = problem.load_pair().truth
        assert truth is not None
        assert truth.depth_ref is not None
        assert truth.depth_ref[0, 0] == depth
        words = ["assumed: 1000 values per unit" in str(w.message) for w in caught]
        assert words == [True] * (scale is None)


# --- 7 pictures of more than 8 bits --------------------------------------------------------------


@pytest.mark.parametrize(("low", "high"), [(28000, 30040), (0, 4095), (100, 60000), (16000, 65535)])
def test_16_bits_are_stretched_to_their_values(low: int, high: int, tmp_path: Path) -> None:
    ramp = np.linspace(0, 1, 96 * 64).reshape(64, 96)
    # both frames have one stretch, which a broken pixel does not change
    for name, values in (("a", ramp), ("b", 0.5 * ramp)):
        image = np.rint(low + (high - low) * values).astype(np.uint16)
        image[5, 5] = 65535
        cv2.imwrite(str(tmp_path / f"{name}.png"), image)
    with pytest.warns(DataWarning, match=f"16 bit, values {low} to 65535.*become black to white"):
        first, second = read_images([tmp_path / "a.png", tmp_path / "b.png"])
    assert first.min() == 0
    assert (first == 255).mean() == pytest.approx(0.01, abs=0.003)
    # half of the value, up to the outermost per cent and rounding
    usual = (ramp > 0.1) & (ramp < 0.9)
    np.testing.assert_allclose(second[..., 0][usual], first[..., 0][usual] / 2, atol=3)
    given = read_image(tmp_path / "a.png", white=high)
    assert given[-1, -1, 0] == 255
    assert given[0, 0, 0] == round(255 * low / high)


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
def test_heic_is_to_be_converted(brand: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x18ftyp" + brand + bytes(100))
    with pytest.raises(DataError, match="convert it to PNG or JPEG first") as caught:
        read_image(tmp_path / "a.heic")
    assert "damaged" not in str(caught.value)


# --- 8 flow is plausible or refused --------------------------------------------------------------


def test_flows_that_do_not_fit_name_their_cause(tmp_path: Path) -> None:
    pair = render_scene("orbit", 0, 256, 108)
    assert pair.truth is not None
    true, path = pair.truth.flow, tmp_path / "f.flo"
    write_flo(path, true)
    np.testing.assert_allclose(resolve_flow(pair, str(path)).uv, true, rtol=1e-6)
    wrong = {
        "u and v exchanged": true[..., ::-1],
        "other direction": -true,
        "times the image's size": true / [256, 108],
        "times half the image's size": true / [128, 54],
        "times 2": true / 2,
        "times 0.667": true * 1.5,
        "axis may point up": true * [1, -1],
        "worse than no flow": np.random.default_rng(0).normal(0, 20, true.shape),
        "is it of these two images": true - [512, 0],
    }
    for words, flow in wrong.items():
        write_flo(path, flow)
        with pytest.raises(DataError, match=words):
            resolve_flow(pair, str(path))
    write_flo(path, 0 * true)
    with pytest.warns(DataWarning, match="hardly better than no flow"):
        resolve_flow(pair, str(path))
    write_flo(path, true[::2, ::2])
    with pytest.raises(DataError, match="differ in size"):
        resolve_flow(pair, str(path))


@pytest.mark.parametrize("change", [-1.0, 0.5, 1 / 256])
def test_a_backward_flow_is_compared_with_the_images_too(change: float, tmp_path: Path) -> None:
    pair = render_scene("orbit", 0, 256, 108)
    back = dis_flow(pair.image_next, pair.image_ref).uv
    write_flo(tmp_path / "f.flo", pair.truth.flow)  # type: ignore[union-attr]
    options = FlowOptions(source="f.flo", backward="b.flo")
    write_flo(tmp_path / "b.flo", back)
    assert (options.load(pair, lambda name: tmp_path / name).confidence > 0).mean() > 0.7
    write_flo(tmp_path / "b.flo", change * back)
    with pytest.raises(DataError, match=r"does not fit the images[\s\S]*b\.flo"):
        options.load(pair, lambda name: tmp_path / name)


def test_a_kitti_flow_with_exchanged_channels_is_refused(tmp_path: Path) -> None:
    write_kitti_flow(tmp_path / "f.png", np.full((8, 9, 2), [3.0, 1.0]))
    assert read_flow(tmp_path / "f.png")[0, 0].tolist() == [3, 1]
    stored = cv2.imread(str(tmp_path / "f.png"), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(tmp_path / "f.png"), stored[..., ::-1])
    with pytest.raises(DataError, match="channels exchanged"):
        read_flow(tmp_path / "f.png")


@pytest.mark.parametrize("comment", [b"# made by a program\n", b"# one\n# two\r\n", b""])
def test_a_pfm_with_comments_is_read(comment: bytes, tmp_path: Path) -> None:
    depth = np.arange(1, 13, dtype=np.float32).reshape(3, 4)
    write_pfm(tmp_path / "a.pfm", depth)
    content = (tmp_path / "a.pfm").read_bytes()
    for place in (b"Pf\n", b"4 3\n"):
        head, tail = content.split(place, 1)
        (tmp_path / "a.pfm").write_bytes(head + place + comment + tail)
        np.testing.assert_array_equal(read_depth(tmp_path / "a.pfm"), depth)
