"""Files for other programs, read back by other programs."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from helpers_result import BOARD_Z, CAMERA, WALL_Z, K, board, small_result, toy_pairs
from PIL import Image
from scipy.spatial.transform import Rotation

from soup_nlp.data.formats.map_files import read_depth
from soup_nlp.errors import DataError
from soup_nlp.report.chain import Chain
from soup_nlp.report.formats import FORMATS, write_formats
from soup_nlp.report.models import fuse, surface_mesh, write_ply
from soup_nlp.report.result import Result
from soup_nlp.sequence.links import make_chain

FLOAT32 = 1e-6
"""Relative rounding of what files hold in single precision."""


@pytest.fixture(scope="module")
def result() -> Result:
    return small_result()


def around_board(width: int) -> np.ndarray:
    """Where the board is, grown by some pixels."""
    return cv2.dilate(board().astype(np.uint8), np.ones((2 * width + 1,) * 2)) > 0


def test_clouds_leave_out_jumps_and_what_is_hidden(result):
    inside = cv2.erode(board().astype(np.uint8), np.ones((3, 3))) > 0
    at_jump = around_board(1) & ~inside
    # the corners of the grown outline touch the board by no side
    cross = cv2.dilate(board().astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3)))
    assert not result.sure[at_jump & (cross > 0)].any()
    assert result.sure[inside].all()
    # the camera goes ahead: the border leaves the image; the board hides wall beside it
    uv = np.stack(np.meshgrid(np.arange(80), np.arange(60)), axis=2) + result.reconstruction.flow
    out = ((uv < -0.5) | (uv > [79.5, 59.5])).any(axis=2)
    assert out.any()
    assert not result.sure[out].any()
    left = result.sure & ~out & ~around_board(10)
    assert left.sum() == (~out & ~around_board(10)).sum()


@pytest.mark.parametrize("frame", [0, 1])
def test_ply_is_read_by_trimesh(tmp_path, result, frame):
    names = write_formats(tmp_path, Chain.of(result), ["ply"])
    assert names == ["points_ref.ply", "points_next.ply"]
    path = tmp_path / ("points_ref.ply", "points_next.ply")[frame]
    cloud = trimesh.load(path)
    seen = Chain.of(result)[frame]
    keep, rec = seen.sure, result.reconstruction
    # of the next frame, what it shows of the sure pixels, in the axes of the first camera
    source = np.arange(60 * 80).reshape(60, 80) if frame == 0 else rec.source_next
    np.testing.assert_array_equal(keep, (source >= 0) & result.sure.ravel()[source])
    assert keep.sum() == pytest.approx(result.sure.sum(), rel=0.1)
    own = (rec.points_ref, CAMERA.inverse(rec.points_next))[frame].reshape(-1, 3)[source[keep]]
    # a point is in the middle of its pixel: up to a pixel aside at a depth of 4
    aside = (0, 4 / K[0, 0])[frame]
    np.testing.assert_allclose(cloud.vertices, own, rtol=FLOAT32, atol=1e-6 + 1.1 * aside)
    np.testing.assert_array_equal(cloud.colors[:, :3], result.images[frame][keep])
    raw = cloud.metadata["_ply_raw"]["vertex"]["data"]
    mine = board().ravel()[source[keep]]
    np.testing.assert_array_equal(raw["component"], mine)
    np.testing.assert_allclose(
        raw["sigma_log_depth"], result.sigma.ravel()[source[keep]], rtol=FLOAT32
    )
    normals = np.stack([raw[name] for name in ("nx", "ny", "nz")], axis=1)
    # the wall does not turn
    np.testing.assert_allclose(normals[~mine], [[0, 0, -1.0]] * (~mine).sum(), atol=1e-6)
    head = path.read_bytes().split(b"end_header")[0].decode()
    assert "unit: soup unit" in head
    assert "about 10 m" in head
    assert "the first frame's camera, x right, y down, z ahead" in head


@pytest.mark.parametrize("frame", [0, 1])
def test_glb_is_read_by_trimesh(tmp_path, result, frame):
    write_formats(tmp_path, Chain.of(result), ["glb"])
    scene = trimesh.load(tmp_path / ("mesh_ref.glb", "mesh_next.glb")[frame])
    assert scene.metadata["unit"] == result.unit
    (mesh,) = scene.geometry.values()
    vertices, faces, pixels = surface_mesh(Chain.of(result)[frame])
    # glTF: x right, y up, the camera looks along -z
    np.testing.assert_allclose(mesh.vertices, vertices * [1, -1, -1], rtol=FLOAT32, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, faces)
    assert (mesh.vertices[:, 2] < 0).all()
    top_left = np.argmin(pixels.sum(axis=1))
    assert mesh.vertices[top_left, 0] < 0 < mesh.vertices[top_left, 1]
    # counter-clockwise from the camera: normals towards it
    eye = Chain.of(result)[frame].pose.t * [1, -1, -1]
    assert (np.sum(mesh.face_normals * (mesh.triangles_center - eye), axis=1) < 0).all()
    # every vertex has the colour of its pixel; the gradient is 4 levels a pixel, JPEG a few
    colour = mesh.visual.material.baseColorTexture.convert("RGB")
    texture = np.asarray(colour, float)
    at = mesh.visual.uv * [80, -60] + [0, 60] - 0.5
    u, v = np.rint(at).astype(int).T
    np.testing.assert_allclose(np.stack([u, v], 1), pixels)
    gap = np.abs(texture[v, u] - result.images[frame][v, u])
    assert np.median(gap) < 5
    assert gap.max() < 40


def test_meshes_have_no_curtains(result):
    vertices, faces, _ = surface_mesh(Chain.of(result)[0])
    depth = vertices[:, 2][faces]
    np.testing.assert_allclose(depth, depth[:, :1].repeat(3, axis=1))
    np.testing.assert_allclose(np.unique(depth.round(9)), [BOARD_Z, WALL_Z])
    # all cells but those that the outline of the board passes
    assert len(faces) == 2 * (59 * 79 - (2 * (41 + 21) - 4))


@pytest.mark.slow
def test_colmap_models_are_read_by_pycolmap(tmp_path, result):
    pycolmap = pytest.importorskip("pycolmap")
    write_formats(tmp_path, Chain.of(result), ["colmap"])
    model = pycolmap.Reconstruction(str(tmp_path / "colmap" / "sparse" / "0"))
    assert {image.name for image in model.images.values()} == {"ref.png", "next.png"}
    wall = result.sure & ~board()
    assert model.num_points3D() == wall.sum()
    for image in model.images.values():
        second = image.name == "next.png"
        # the first pixel's centre is (0.5, 0.5) there
        np.testing.assert_allclose(image.camera.calibration_matrix()[:2, 2], K[:2, 2] + 0.5)
        pose = image.cam_from_world().matrix()
        np.testing.assert_allclose(pose, (CAMERA.matrix if second else np.eye(4))[:3], atol=1e-9)
        # at the outline of the board, a pixel may be its
        assert wall.sum() >= image.num_points3D > 0.99 * wall.sum()
        gaps = [
            np.linalg.norm(image.project_point(model.points3D[p.point3D_id].xyz) - p.xy)
            for p in image.points2D
        ]
        # pixels are written with 6 digits, points with 9
        assert max(gaps) < 1e-3
    for name in ("ref.png", "next.png"):
        mask = cv2.imread(str(tmp_path / "colmap" / "masks" / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
        assert set(np.unique(mask)) == {0, 255}
        # the board comes nearer
        share = (mask == 0).mean() / board().mean()
        assert (0.999 < share < 1.001) if name == "ref.png" else (1.0 < share < 1.3)


def test_cameras_with_skew_have_no_colmap_model(tmp_path, result):
    skewed = K.copy()
    skewed[0, 1] = 2
    tree = {"input": {**result.tree["input"], "K_next": skewed}}
    with pytest.raises(DataError, match="skew"):
        write_formats(tmp_path, Chain.of(replace(result, tree=tree)), ["colmap"])


def test_maps_are_read_by_numpy_opencv_and_pillow(tmp_path, result):
    names = write_formats(tmp_path, Chain.of(result), ["npy", "pfm", "masks", "flow"])
    assert set(names) == {p.name for p in tmp_path.iterdir()}
    for name, depth in zip(("ref", "next"), result.depths):
        known = np.isfinite(depth)
        found = np.load(tmp_path / f"depth_{name}.npy")
        np.testing.assert_array_equal(found, depth.astype(np.float32))
        found = cv2.imread(str(tmp_path / f"depth_{name}.pfm"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(found, np.where(known, depth, np.inf).astype(np.float32))
        np.testing.assert_array_equal(
            read_depth(tmp_path / f"depth_{name}.pfm")[known], found[known]
        )
        labels, moving = (
            np.asarray(Image.open(tmp_path / f"{k}_{name}.png")) for k in ("components", "moving")
        )
        assert labels.dtype == moving.dtype == np.uint8
        np.testing.assert_array_equal(moving, 255 * (labels > 0))
        # the board comes nearer
        assert (moving > 0).mean() == pytest.approx(board().mean(), rel=0.3 * (name == "next"))
    uv = cv2.readOpticalFlow(str(tmp_path / "flow_ref.flo"))
    np.testing.assert_array_equal(uv, result.flow.astype(np.float32))
    np.testing.assert_array_equal(np.loadtxt(tmp_path / "K.txt"), K)
    np.testing.assert_array_equal(np.load(tmp_path / "sigma_ref.npy"), np.float32(result.sigma))


@pytest.mark.slow
def test_recordings_are_read_by_rerun(tmp_path, result):
    chunk = pytest.importorskip("rerun.chunk", reason="needs rerun-sdk (extra: rerun)")
    write_formats(tmp_path, Chain.of(result), ["rrd"])
    rows: dict[str, int] = {}
    for part in chunk.RrdReader(str(tmp_path / "scene.rrd")).stream():
        rows[str(part.entity_path)] = rows.get(str(part.entity_path), 0) + part.num_rows
    both = ("background", "component_1", "camera/image/depth", "camera/image/rgb")
    assert [rows.get(f"/world/{name}") for name in both] == [2] * 4


def test_the_path_of_a_pair_is_ref_from_camera(tmp_path, result):
    names = write_formats(tmp_path, Chain.of(result), ["tum", "kitti"])
    assert names == ["trajectory.tum", "poses.txt"]
    first, second = np.loadtxt(tmp_path / "trajectory.tum")
    np.testing.assert_allclose(first, [0, 0, 0, 0, 0, 0, 0, 1])
    np.testing.assert_allclose(second[1:4], CAMERA.centre, atol=1e-8)
    found = Rotation.from_quat(second[4:]).as_matrix()
    np.testing.assert_allclose(found, CAMERA.R.T, atol=1e-8)
    first, second = np.loadtxt(tmp_path / "poses.txt").reshape(2, 3, 4)
    np.testing.assert_allclose(first, np.eye(4)[:3])
    np.testing.assert_allclose(second, np.linalg.inv(CAMERA.matrix)[:3], atol=1e-8)


def test_transforms_project_points_where_the_cameras_see_them(tmp_path, result):
    write_formats(tmp_path, Chain.of(result), ["transforms"])
    told = json.loads((tmp_path / "transforms" / "transforms.json").read_text())
    rec, start = result.reconstruction, np.array([10, 30])
    # on the wall, y up
    point = np.array([*rec.points_ref[30, 10] * [1, -1, -1], 1])
    for frame, at in zip(told["frames"], (start, start + rec.flow[30, 10]), strict=True):
        x, y, z, _ = np.linalg.inv(frame["transform_matrix"]) @ point
        uv = frame["fl_x"] * x / -z + frame["cx"], frame["fl_y"] * -y / -z + frame["cy"]
        np.testing.assert_allclose(uv, at + 0.5, atol=1e-6)
        image = np.asarray(Image.open(tmp_path / "transforms" / frame["file_path"]))
        assert image.shape == (60, 80, 3)
        mask = np.asarray(Image.open(tmp_path / "transforms" / frame["mask_path"]))
        assert 0.5 < (mask == 255).mean() < 0.9


@pytest.mark.slow
def test_a_chain_has_every_format_of_a_pair(tmp_path):
    chain = make_chain(toy_pairs())
    formats = [name for name in FORMATS if name != "rrd"]
    names = write_formats(tmp_path, chain, formats)
    assert {name.partition("/")[0] for name in names} == {p.name for p in tmp_path.iterdir()}
    for k in range(3):
        found = np.load(tmp_path / "depth" / f"{k:04d}.npy")
        np.testing.assert_array_equal(found, chain.depth(k).astype(np.float32))
        cloud = trimesh.load(tmp_path / "points" / f"{k:04d}.ply")
        mesh = trimesh.load(tmp_path / "mesh" / f"{k:04d}.glb")
        # in the first camera's axes, y up in meshes
        middle = np.median(cloud.vertices, axis=0)
        found = np.median(mesh.to_geometry().vertices, axis=0) * [1, -1, -1]
        np.testing.assert_allclose(found, middle, atol=0.3)
    assert len(trimesh.load(tmp_path / "scene.ply").vertices) == len(fuse(chain))
    for name in ("poses.txt", "trajectory.tum"):
        assert len(np.loadtxt(tmp_path / name)) == 3


def test_unknown_points_of_a_map_are_dropped(tmp_path):
    xyz = np.ones((2, 3, 3))
    xyz[0, 1, 2] = np.nan
    xyz[1, 2, 0] = np.inf
    xyz[1, 1, 0] = 1e300  # not a float32
    rgb = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)
    assert write_ply(tmp_path / "a.ply", xyz, rgb) == 3
    np.testing.assert_array_equal(trimesh.load(tmp_path / "a.ply").colors[:, 0], [0, 6, 9])
    # a cloud without points is a file
    assert write_ply(tmp_path / "a.ply", np.zeros((0, 3)), np.zeros((0, 3), np.uint8)) == 0
    assert (tmp_path / "a.ply").read_bytes().endswith(b"\nend_header\n")
