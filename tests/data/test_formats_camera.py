"""Camera files and images: golden bytes, round trips, malformed files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers_files import put, raises, write_cam

from soup_nlp.data.formats import camera_files as fmt
from soup_nlp.data.formats.images import read_image, read_mask

# --- cameras ------------------------------------------------------------------------------------

K = np.array([[688.0, 0.0, 511.5], [0.0, 688.5, 217.5], [0.0, 0.0, 1.0]])


def test_cam(tmp_path: Path) -> None:
    write_cam(tmp_path / "a.cam", K)
    np.testing.assert_array_equal(fmt.read_cam(tmp_path / "a.cam"), K)
    for content, match in [
        (b"PIEH" + bytes(100), "truncated"),
        (bytes(172), "wrong magic"),
        (b"PIEH" + bytes(168), "focal lengths must be positive"),
    ]:
        with raises(match):
            fmt.read_cam(put(tmp_path / "b.cam", content))


def test_intrinsics_text(tmp_path: Path) -> None:
    path = tmp_path / "K.txt"
    path.write_text("# camera\n688, 0, 511.5\n0 688.5 217.5\n0 0 1\n")
    np.testing.assert_array_equal(fmt.read_intrinsics(path), K)
    path.write_text("688 688.5 511.5 217.5")
    np.testing.assert_array_equal(fmt.read_intrinsics(path), K)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("1 2 3", "wrong number of values"),
        ("688 f 1 2", "not a number"),
        ("-688 688 1 2", "must be positive"),
        ("nan 688 1 2", "not finite"),
        ("688 0 5 1 688 2 0 0 1", "upper triangular"),
    ],
)
def test_intrinsics_errors(tmp_path: Path, text: str, match: str) -> None:
    (tmp_path / "K.txt").write_text(text)
    with raises(match):
        fmt.read_intrinsics(tmp_path / "K.txt")


def test_intrinsics_binary(tmp_path: Path) -> None:
    with raises("is not text"):
        fmt.read_intrinsics(put(tmp_path / "K.txt", b"\xff\xfe\x00\x81"))


def test_kitti_projections(tmp_path: Path) -> None:
    path = tmp_path / "calib.txt"
    path.write_text(
        "calib_time: 09-Jan-2012 13:57:47\ncorner_dist: 9.950000e-02\n"
        "K_00: 1 2 3 4 5 6 7 8 9\n\nP_rect_00: 1 2 3 4 5 6 7 8 9 10 11 12\nT_00: 1 2 3\n"
    )
    (projection,) = fmt.read_kitti_projections(path, ["P_rect_00"])
    np.testing.assert_array_equal(projection, np.arange(1, 13).reshape(3, 4))
    for text, match in [
        ("1 2 3", "lacks P0"),
        ("P1: 1 2", "lacks P0[\\s\\S]*found: P1"),
        ("P0: 1 2 x", "not a number"),
        ("P0: 1 2 3", "no projection[\\s\\S]*3 numbers"),
        ("P0:" + 12 * " nan", "no projection[\\s\\S]*0 of them finite"),
    ]:
        path.write_text(text)
        with raises(match):
            fmt.read_kitti_projections(path, ["P0"])


def test_vkitti_intrinsics(tmp_path: Path) -> None:
    path = tmp_path / "intrinsic.txt"
    head = "frame cameraID K[0,0] K[1,1] K[0,2] K[1,2]"
    path.write_text(f"{head}\n0 0 725 726 620.5 187\n0 1 7 7 6 1\n1 0 730 730 6 1\n\n2 0 725\n")
    first, second = fmt.read_vkitti2_intrinsics(path, (0, 1))
    np.testing.assert_array_equal(first, [[725, 0, 620.5], [0, 726, 187], [0, 0, 1]])
    assert second[0, 0] == 730
    for missing in (2, 3):
        with raises(f"3 complete rows[\\s\\S]*a row of frame {missing}"):
            fmt.read_vkitti2_intrinsics(path, (0, missing))
    path.write_text("frame K[0,0]\n0 1\n")
    with raises("lacks columns"):
        fmt.read_vkitti2_intrinsics(path, (0,))
    path.write_text(f"{head}\n0 0 725 x 620.5 187\n")
    with raises("not a number"):
        fmt.read_vkitti2_intrinsics(path, (0,))


# --- images -------------------------------------------------------------------------------------


def test_image_kinds(tmp_path: Path) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (6, 5, 3)).astype(np.uint8)
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), rgb[:, :, ::-1])
    np.testing.assert_array_equal(read_image(path), rgb)
    rgba = np.dstack([rgb[:, :, ::-1], np.zeros((6, 5), np.uint8)])
    cv2.imwrite(str(path), rgba)
    np.testing.assert_array_equal(read_image(path), rgb)
    cv2.imwrite(str(path), rgb[:, :, 0])
    np.testing.assert_array_equal(read_image(path), np.repeat(rgb[:, :, :1], 3, axis=2))
    cv2.imwrite(str(path), rgb[:, :, ::-1].astype(np.uint16) * 257)
    out = read_image(path, white=65535)
    np.testing.assert_array_equal(out, rgb)
    assert out.dtype == np.uint8
    assert out.flags.c_contiguous


def test_image_errors(tmp_path: Path) -> None:
    with raises("image is missing"):
        read_image(tmp_path / "none.png")
    with raises(r"cannot be decoded[\s\S]*not an i"):
        read_image(put(tmp_path / "a.png", b"not an image at all"))
    cv2.imwrite(str(tmp_path / "f.tiff"), np.zeros((4, 4), np.float32))
    with raises("neither 8-bit nor 16-bit"):
        read_image(tmp_path / "f.tiff")


def test_mask(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "m.png"), np.array([[0, 127, 128, 255]], np.uint8))
    assert read_mask(tmp_path / "m.png").tolist() == [[False, False, True, True]]
