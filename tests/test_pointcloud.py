from __future__ import annotations

import os

import numpy as np
import pytest

from soup_nlp.errors import DataError
from soup_nlp.report.pointcloud import points_from_depth, read_ply, write_ply


def cloud(m=50):
    rng = np.random.default_rng(1)
    xyz = rng.normal(size=(m, 3))
    rgb = rng.integers(0, 256, (m, 3)).astype(np.uint8)
    normals = rng.normal(size=(m, 3))
    return xyz, rgb, normals / np.linalg.norm(normals, axis=1, keepdims=True)


@pytest.mark.parametrize("with_normals", [False, True])
def test_round_trip(tmp_path, with_normals):
    xyz, rgb, normals = cloud()
    path = tmp_path / "a.ply"
    assert write_ply(path, xyz, rgb, normals if with_normals else None) == 50
    got_xyz, got_rgb, got_normals = read_ply(path)
    np.testing.assert_array_equal(got_xyz, xyz.astype(np.float32))
    np.testing.assert_array_equal(got_rgb, rgb)
    if with_normals:
        np.testing.assert_array_equal(got_normals, normals.astype(np.float32))
    else:
        assert got_normals is None


def test_bytes_of_one_point(tmp_path):
    write_ply(tmp_path / "a.ply", [[1.0, 2.0, 3.0]], np.array([[10, 20, 30]], np.uint8))
    header, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")
    assert header.decode().splitlines() == [
        "ply",
        "format binary_little_endian 1.0",
        "element vertex 1",
        "property float x",
        "property float y",
        "property float z",
        "property uchar red",
        "property uchar green",
        "property uchar blue",
    ]
    assert body == np.array([1, 2, 3], "<f4").tobytes() + bytes([10, 20, 30])


def test_unknown_points_of_a_map_are_dropped(tmp_path):
    xyz = np.ones((2, 3, 3))
    xyz[0, 1, 2] = np.nan
    xyz[1, 2, 0] = np.inf
    xyz[1, 1, 0] = 1e300  # not a float32
    rgb = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)
    assert write_ply(tmp_path / "a.ply", xyz, rgb) == 3
    _, colours, _ = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(colours[:, 0], [0, 6, 9])


def test_empty(tmp_path):
    assert write_ply(tmp_path / "a.ply", np.zeros((0, 3)), np.zeros((0, 3), np.uint8)) == 0
    assert read_ply(tmp_path / "a.ply")[0].shape == (0, 3)


def test_reads_other_number_types_and_elements(tmp_path):
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment hi\nelement vertex 1\nproperty double x\n"
        "property double y\nproperty double z\nelement face 0\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    (tmp_path / "a.ply").write_bytes(header.encode() + np.array([1, 2, 3], "<f8").tobytes())
    xyz, rgb, _ = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(xyz, [[1, 2, 3]])
    np.testing.assert_array_equal(rgb, [[255, 255, 255]])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rgb": np.zeros((50, 3))}, "8-bit"),
        ({"rgb": np.zeros((49, 3), np.uint8)}, "differ in length"),
        ({"normals": np.zeros((3, 3))}, "differ in length"),
        ({"xyz": np.zeros(3)}, "wrong shape"),
        ({"xyz": np.zeros((50, 2))}, "wrong shape"),
    ],
)
def test_bad_arrays_leave_the_old_file(tmp_path, change, words):
    xyz, rgb, _ = cloud()
    path = tmp_path / "a.ply"
    path.write_bytes(b"old")
    with pytest.raises(DataError, match=words):
        write_ply(path, **{"xyz": xyz, "rgb": rgb, **change})
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["a.ply"]


def test_bad_files(tmp_path):
    path = tmp_path / "a.ply"
    with pytest.raises(DataError, match="cannot read"):
        read_ply(path)
    xyz, rgb, _ = cloud()
    write_ply(path, xyz, rgb)
    good = path.read_bytes()
    for old, new, words in (
        (b"ply", b"obj", "not PLY"),
        (b"binary_little_endian", b"ascii", "another format"),
        (b"element vertex", b"element face", "start with vertices"),
        (b"property float x", b"property list uchar int x", "not supported"),
        (b"property float x\n", b"property float w\n", "no position"),
        (b"vertex 50", b"vertex 51", "shorter"),
    ):
        path.write_bytes(good.replace(old, new, 1))
        with pytest.raises(DataError, match=words):
            read_ply(path)


K = np.array([[2.0, 0.0, 1.0], [0.0, 4.0, 0.0], [0.0, 0.0, 1.0]])


def test_points_of_a_depth_map():
    z = np.array([[2.0, np.nan, 4.0], [-1.0, np.inf, 8.0]])
    image = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)
    xyz, rgb = points_from_depth(z, K, image)
    # (u, v) = (0, 0), (2, 0), (2, 1): rays (-1/2, 0, 1), (1/2, 0, 1), (1/2, 1/4, 1)
    np.testing.assert_allclose(xyz, [[-1, 0, 2], [2, 0, 4], [4, 2, 8]])
    np.testing.assert_array_equal(rgb[:, 0], [0, 6, 15])


def test_points_at_a_jump_of_depth_are_left_out(tmp_path):
    z = np.array([[1.0, 1.04, 2.0, 2.0], [1.0, 1.0, 2.05, np.nan]])
    image = np.zeros((2, 4, 3), np.uint8)
    kept = points_from_depth(z, K, image, max_edge=0.05)
    # columns 1 and 2 face a jump from 1 to 2; 2.0 beside an unknown pixel stays
    np.testing.assert_allclose(kept[0][:, 2], [1.0, 2.0, 1.0])
    assert len(points_from_depth(z, K, image, max_edge=2.0)[0]) == 7
    pair = np.array([[1.0, 1.0515]])  # a share of the nearer: 0.0515, of the farther: 0.049
    assert not len(points_from_depth(pair, K, image[:1, :2], max_edge=0.05)[0])
    assert write_ply(tmp_path / "a.ply", *kept) == 3
    empty = points_from_depth(np.full((2, 4), np.nan), K, image, max_edge=0.1)
    assert write_ply(tmp_path / "a.ply", *empty) == 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"depth": np.ones((2, 3))}, "do not fit"),
        ({"image": np.zeros((2, 4, 3))}, "do not fit"),
        ({"K": np.eye(4)}, "3x3"),
        ({"max_edge": 0.0}, "positive"),
        ({"max_edge": float("nan")}, "positive"),
    ],
)
def test_points_of_bad_arrays(change, words):
    good = {"depth": np.ones((2, 4)), "K": K, "image": np.zeros((2, 4, 3), np.uint8)}
    with pytest.raises(DataError, match=words):
        points_from_depth(**{**good, **change})
