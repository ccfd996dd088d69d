from __future__ import annotations

import numpy as np
import pytest
from helpers_ply import read_ply

from soup_nlp.report.ply_glb import write_ply


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
