"""Files of flow, depth, cameras and images: golden bytes, real and malformed files."""

import struct
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers_files import npy, npz, put, raises, write_dpt
from PIL import Image

from soup_nlp.data.datasets import benchmarks
from soup_nlp.data.formats import camera_files
from soup_nlp.data.formats import map_files as fmt
from soup_nlp.data.formats.images import DataWarning, read_image, read_mask
from soup_nlp.data.pair import Pair

# --- malformed files ----------------------------------------------------------------------------


def stored(path: Path, content: bytes | str | np.ndarray) -> Path:
    """A file of these bytes, or of an image, whose format is the suffix."""
    if isinstance(content, np.ndarray):
        cv2.imwrite(str(path), content)
        return path
    return put(path, content if isinstance(content, bytes) else content.encode())


def sized(width: int, height: int, count: int) -> bytes:
    """A .flo or .dpt file with a body of `count` bytes."""
    return b"PIEH" + struct.pack("<ii", width, height) + bytes(count)


COLUMNS = "frame cameraID K[0,0] K[1,1] K[0,2] K[1,2]"
READERS = {
    ".flo": fmt.read_flow,
    ".dpt": fmt.read_depth,
    "flow": fmt.read_flow,
    "depth": partial(fmt.read_depth, scale=1000.0),
    "cam": camera_files.read_cam,
    "camera": camera_files.read_intrinsics,
    "kitti": partial(benchmarks.read_rows, names=["P0:"], count=12),
    "vkitti": partial(benchmarks.read_rows, names=["0 0"], count=4),
    "image": read_image,
}
MALFORMED = [
    *(
        (suffix, f"a{suffix}", content, match)
        for suffix, size in ((".flo", 96), (".dpt", 48))
        for content, match in (
            (b"", "is empty"),
            (b"PIEX" + bytes(16), "wrong magic number"),
            (b"PIEH\x01", "truncated"),
            (sized(4, 3, size - 1), "truncated"),
            (sized(4, 3, size + 1), "left over"),
            (sized(0, 3, 0), "impossible size"),
            (sized(-4, 3, size), "impossible size"),
            (sized(2**31 - 1, 2**31 - 1, 0), "impossible size"),
        )
    ),
    ("flow", "a.png", np.zeros((4, 4, 3), np.uint8), "uint8 with 3 channel"),
    ("flow", "a.png", np.zeros((4, 4), np.uint16), "uint16 with 1 channel"),
    ("flow", "a.png", np.full((8, 9, 3), (2**15, 2**15, 1), np.uint16), "channels exchanged"),
    ("flow", "a.tiff", "", r"unknown suffix[\s\S]*\.flo, \.png, \.npy"),
    ("flow", "a.npy", npy(["x"]), "does not hold numbers"),
    ("flow", "a.npy", npy(np.ones((3, 4, 2)))[:-9], "no readable array"),
    ("flow", "a.npy", npy(np.ones((3, 4, 2))) + b"x", "left over"),
    ("flow", "a.npy", npy(np.zeros((3, 4))), "wrong shape"),
    ("depth", "a.npy", npy(np.zeros((2, 2, 1))), "wrong shape"),
    ("depth", "a.npy", npy(np.ones((1, 5, 6))), r"wrong shape[\s\S]*numpy\.squeeze"),
    ("depth", "a.npy", npy(-np.ones((5, 6))), r"negative everywhere[\s\S]*give its negative"),
    ("depth", "a.npz", b"PK", "no readable array"),
    ("depth", "a.npz", npz(a=np.ones((2, 2)), b=np.ones((2, 2))), r"one map[\s\S]*a \(2, 2\), b"),
    ("depth", "a.npz", npz(depth=np.ones(2)), "wrong shape"),
    ("depth", "a.png", np.zeros((4, 4), np.uint8), "16-bit PNG with 1 channel"),
    ("depth", "a.pfm", b"PF\n1 1\n-1.0\n" + bytes(12), "damaged header"),
    ("depth", "a.pfm", b"P5\n1 1\n255\n0", "damaged header"),
    ("depth", "a.pfm", b"Pf\n1 1\n0\n" + bytes(4), "damaged header"),
    ("depth", "a.pfm", b"Pf\n1 1\n1e1e\n" + bytes(4), "damaged header"),
    ("depth", "a.pfm", b"Pf\n0 1\n-1\n", "impossible size"),
    ("depth", "a.pfm", b"Pf\n2 2\n-1\n" + bytes(15), "truncated"),
    ("cam", "a.cam", b"PIEH" + bytes(100), "truncated"),
    ("cam", "a.cam", bytes(172), "wrong magic"),
    ("cam", "a.cam", b"PIEH" + bytes(168), "positive fx and fy"),
    ("camera", "K.txt", "80 80 47.5 31.5 640 480", "wrong number of values"),
    ("camera", "K.txt", "481.2 0 319.5\n0 -480 239.5\n0 0 1\n", "fy without its sign"),
    ("camera", "K.txt", "688 0 5 1 688 2 0 0 1", "no camera matrix"),
    ("kitti", "calib.txt", "1 2 3", "lacks the numbers of P0:"),
    ("kitti", "calib.txt", "P1: 1 2", r"numbers of P0:[\s\S]*found: lines P1:"),
    ("kitti", "calib.txt", "P0: 1 2 x", "not a number"),
    ("kitti", "calib.txt", "P0: 1 2 3", r"numbers of P0:[\s\S]*found: 1 2 3[\s\S]*12 finite"),
    ("kitti", "calib.txt", "P0:" + 12 * " nan", r"numbers of P0:[\s\S]*12 finite"),
    ("vkitti", "a.txt", "frame K[0,0]\n0 1\n", "lacks the numbers of 0 0"),
    ("vkitti", "a.txt", f"{COLUMNS}\n0 0 725 x 620.5 187\n", "not a number"),
    ("vkitti", "a.txt", f"{COLUMNS}\n0 1 7 7 6 1\n\n0 0 7\n", r"of 0 0[\s\S]*found: 7[\s\S]*4 fin"),
    ("image", "a.png", b"not an image at all", r"cannot be decoded[\s\S]*not an i"),
    ("image", "a.tiff", np.zeros((4, 4), np.float32), "neither 8-bit nor 16-bit"),
]


def test_a_malformed_file_is_refused(tmp_path: Path) -> None:
    for kind, name, content, match in MALFORMED:
        with raises(match) as caught:
            READERS[kind](stored(tmp_path / name, content))
        assert name in str(caught.value)


def test_missing_file_names_its_neighbours(tmp_path: Path) -> None:
    put(tmp_path / "flow_0.flo", b"x")
    (tmp_path / "flow_2.flo").mkdir()
    for name, match in {
        "flow_1.flo": r"flow file is missing[\s\S]*flow_0\.flo",
        "nowhere/a.flo": r"folder .* does not exist",
        "flow_2.flo": "cannot be read",
    }.items():
        with raises(match):
            fmt.read_flow(tmp_path / name)
    for name in ("\ud800.png", "a\0b.png"):
        with raises("not named by a path"):
            read_image(name)
        with raises("not named by a path"):
            Pair(name, name, fov=60)


@pytest.mark.parametrize("scale", [0, -1, np.nan, np.inf])
def test_a_scale_of_depth_is_positive(scale: float, tmp_path: Path) -> None:
    with raises("scale must be positive"):
        fmt.read_depth_png16(tmp_path / "a.png", scale)


# --- flow ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("mark", [np.nan, np.inf, -np.inf, 1.1e9, -2e9])
def test_flo_golden_bytes_and_unknown_flow(tmp_path: Path, mark: float) -> None:
    flow = np.array([[[1, mark], [1.5, -2]]], "<f4")
    # capital letters are a suffix, too
    golden = struct.pack("<fii", 202021.25, 2, 1) + flow.tobytes()
    for name, content in (("A.FLO", golden), ("a.npy", npy(flow))):
        read = fmt.read_flow(put(tmp_path / name, content))
        np.testing.assert_array_equal(read, [[[np.nan, np.nan], [1.5, -2]]])


# --- depth --------------------------------------------------------------------------------------


def test_unknown_depth(tmp_path: Path) -> None:
    depth = np.array([[1.0, 0.0, -1.0, np.inf, np.nan]])
    np.save(tmp_path / "a.npy", depth)
    write_dpt(tmp_path / "a.dpt", depth)
    put(tmp_path / "a.pfm", b"Pf\n5 1\n-1\n" + depth.astype("<f4").tobytes())
    for name in ("a.npy", "a.dpt", "a.pfm"):
        out = fmt.read_depth(tmp_path / name)
        assert out.dtype == np.float64
        np.testing.assert_array_equal(out, [[1.0] + [np.nan] * 4])


@pytest.mark.parametrize(("scale", "order"), [(b"-1.0", "<f4"), (b"1", ">f4"), (b"-3.5e-1", "<f4")])
@pytest.mark.parametrize("comment", [b"# made by a program\n", b"# one\n# two\r\n", b""])
def test_pfm_golden_bytes(tmp_path: Path, scale: bytes, order: str, comment: bytes) -> None:
    rows = np.array([[1, 2, 3], [4, 5, 6]], order)
    head = b"Pf\n" + comment + b"3 2\n" + comment + scale + b"\n"
    path = put(tmp_path / "a.pfm", head + rows[::-1].tobytes())
    np.testing.assert_array_equal(fmt.read_depth(path), rows)


def test_a_prior_is_read_from_more_files_than_a_depth(tmp_path: Path) -> None:
    depth = np.array([[1.0, 2.0], [0.0, 200.0]])
    known = np.where(depth > 0, depth, np.nan)
    np.savez(tmp_path / "a.npz", depth=depth, K=np.eye(3))
    np.savez(tmp_path / "b.npz", depth)
    for name in ("a.npz", "b.npz"):
        np.testing.assert_array_equal(fmt.read_depth(tmp_path / name), known)
        np.testing.assert_array_equal(fmt.prior_of(tmp_path / name), known)
    grey = depth.astype(np.uint8)
    for name, image in (("a.png", grey), ("b.png", np.dstack([grey] * 3))):
        with pytest.warns(DataWarning, match=r"8 bits has 4 different values; assumed: its grey"):
            out = fmt.prior_of(stored(tmp_path / name, image))
        np.testing.assert_array_equal(out, known)
    deep = stored(tmp_path / "c.png", depth.astype(np.uint16))
    np.testing.assert_array_equal(fmt.prior_of(deep), known)
    colour = stored(tmp_path / "d.png", np.dstack([grey, grey, grey + 1]))
    for path, match in ((colour, "16-bit PNG with 1 channel"), (tmp_path / "none.png", "missing")):
        with raises(match):
            fmt.prior_of(path)


def test_kitti_disparity_and_vkitti_depth(tmp_path: Path) -> None:
    path = stored(tmp_path / "a.png", np.array([[0, 256, 65534, 65535]], np.uint16))
    disparity = fmt.read_depth_png16(path, fmt.KITTI_DISPARITY)
    np.testing.assert_array_equal(disparity, [[np.nan, 1.0, 65534 / 256, 65535 / 256]])
    np.testing.assert_array_equal(fmt.read_vkitti_depth(path), [[np.nan, 2.56, 655.34, np.nan]])


# --- images -------------------------------------------------------------------------------------


def test_image_kinds(tmp_path: Path) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (6, 5, 3)).astype(np.uint8)
    bgr, path = rgb[:, :, ::-1], tmp_path / "a.png"
    grey = np.repeat(rgb[:, :, :1], 3, axis=2)
    with_alpha = np.dstack([bgr, np.zeros((6, 5), np.uint8)])
    for content, image in ((bgr, rgb), (with_alpha, rgb), (rgb[:, :, 0], grey)):
        np.testing.assert_array_equal(read_image(stored(path, content)), image)
    # a format that OpenCV does not read
    Image.fromarray(rgb).save(tmp_path / "a.pcx")
    np.testing.assert_array_equal(read_image(tmp_path / "a.pcx"), rgb)
    out = read_image(stored(path, bgr.astype(np.uint16) * 257), white=65535)
    np.testing.assert_array_equal(out, rgb)
    assert out.dtype == np.uint8
    assert out.flags.c_contiguous


def test_mask(tmp_path: Path) -> None:
    path = stored(tmp_path / "m.png", np.array([[0, 127, 128, 255]], np.uint8))
    assert read_mask(path).tolist() == [[False, False, True, True]]
