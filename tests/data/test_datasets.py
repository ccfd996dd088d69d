"""Dataset layouts as tiny files in a temporary folder, and real pairs if available."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers_files import put, raises, write_cam, write_dpt, write_flo, write_kitti_flow

from soup_nlp.config.problem import make_problem
from soup_nlp.data.datasets.benchmarks import CAMERAS
from soup_nlp.data.formats.images import DataWarning
from soup_nlp.data.formats.map_files import KITTI_DISPARITY, read_depth_png16
from soup_nlp.errors import ConfigError

H, W = 6, 9
K = np.array([[100.0, 0.0, 4.0], [0.0, 110.0, 3.0], [0.0, 0.0, 1.0]])


def picture(path: Path, values: int | np.ndarray) -> None:
    """An image file of these values, or of the noise of a seed, below folders that it makes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(values, int):
        values = np.random.default_rng(values).integers(0, 256, (H, W, 3)).astype(np.uint8)
    cv2.imwrite(str(path), values)


def png16(path: Path, values: np.ndarray) -> None:
    picture(path, values.astype(np.uint16))


def load(kind: str, where: Path, **options: object):
    """The pair of an input at a folder."""
    key = "path" if kind in ("folder", "tum") else "root"
    source = {} if kind == "motorcycle" else {key: str(where)}
    return make_problem({"input": {"kind": kind, **source, **options}}).input.load(Path)


def refuses(match: str, kind: str, where: Path, **options: object) -> None:
    """Expect that an input cannot be loaded, with a message that matches."""
    with raises(match):
        load(kind, where, **options)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    picture(tmp_path / "pair" / "frame_0.png", 0)
    picture(tmp_path / "pair" / "frame_1.png", 1)
    np.savetxt(tmp_path / "pair" / "K.txt", K)
    return tmp_path / "pair"


# --- plain folder -------------------------------------------------------------------------------


def test_folder_minimal(folder: Path) -> None:
    pair = load("folder", folder)
    assert (pair.name, pair.size, pair.truth, pair.flow) == ("pair", (H, W), None, None)
    np.testing.assert_array_equal(pair.K_next, K)


def test_folder_with_everything(folder: Path) -> None:
    (folder / "K_next.txt").write_text("90 91 4 3")
    png16(folder / "depth.png", np.full((H, W), 1500))
    write_dpt(folder / "depth_next.dpt", np.full((H, W), 2.5))
    write_flo(folder / "flow.flo", np.full((H, W, 2), np.nan))
    moving = np.zeros((H, W), np.uint8)
    moving[:2, :2] = moving[4:, 4:] = 255
    picture(folder / "moving.png", moving)
    xyz = np.array([[1.0, 2.0, 550.0], [1.0, 2.0, np.nan]])
    np.savez(folder / "points.npz", uv_0=np.array([[3.5, 2.5], [1, 1]]), xyz_mm_0=xyz)
    pair = load("folder", folder, depth_scale=1000.0)
    truth = pair.truth
    assert pair.K_next[1, 1] == 91
    assert truth.depth_ref[0, 0] == 1.5
    assert truth.depth_next[0, 0] == 2.5
    assert np.isnan(truth.flow).all()
    # the static scene and two connected regions
    assert sorted(np.bincount(truth.components.ravel())) == [4, 10, H * W - 14]
    np.testing.assert_allclose(truth.points, [[3.5, 2.5, 0.55]])
    millimetres = load("folder", folder, depth_scale=1.0, unit="mm").truth
    assert millimetres.unit == "mm"
    np.testing.assert_allclose(millimetres.points, [[3.5, 2.5, 550.0]])
    # an array goes before a picture
    np.save(folder / "depth.npy", np.full((H, W), 7.0))
    assert load("folder", folder).truth.depth_ref[0, 0] == 7.0


@pytest.mark.parametrize("name", ["frame_0.png", "frame_1.png", "K.txt"])
def test_folder_missing(folder: Path, name: str) -> None:
    (folder / name).unlink()
    refuses(rf"dataset is missing[\s\S]*{name}[\s\S]*expected: frame_0\.png", "folder", folder)
    refuses("dataset folder is missing", "folder", folder / "nowhere")


def test_folder_bad_truth(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for arrays, unit, match in [
        ({}, "m", "lacks an array"),
        ({"xyz_mm_0": np.zeros((3, 3))}, "m", "wrong shape"),
        ({"xyz_mm_0": np.ones((2, 3))}, "feet", "millimetres"),
        ({"xyz_mm_0": np.ones((2, 3), complex)}, "m", r"points.npz, xyz_mm_0[\s\S]*complex"),
    ]:
        np.savez(folder / "points.npz", uv_0=np.zeros((2, 2)), **arrays)
        refuses(match, "folder", folder, unit=unit)
    with monkeypatch.context() as m, raises("at most 32 are read"):
        m.setattr("soup_nlp.data.formats.map_files.MAX_PIXELS", 1)
        load("folder", folder)
    (folder / "points.npz").write_bytes(b"PK no zip")
    refuses("no readable array", "folder", folder)
    np.save(folder / "depth.npy", np.ones((H, W + 1)))
    (folder / "points.npz").unlink()
    refuses("truth and reference image differ in size", "folder", folder)


# --- KITTI --------------------------------------------------------------------------------------


KITTI = {
    "kitti2012": ("image_0", "calib", "P0", "P1", "disp_occ"),
    "kitti2015": ("image_2", "calib_cam_to_cam", "P_rect_02", "P_rect_03", "disp_occ_0"),
}
CALIBRATION = "time: 09-Jan\n{}: 100 0 4 5 0 100 3 0 0 0 1 0\n{}: 100 0 4 -49 0 100 3 0 0 0 1 0\n"


def kitti(root: Path, kind: str) -> Path:
    images, calibration, left, right, disparities = KITTI[kind]
    for k in (10, 11):
        picture(root / "training" / images / f"000007_{k}.png", k)
    text = CALIBRATION.format(left, right).encode()
    put(root / "training" / calibration / "000007.txt", text)
    disparity = np.full((H, W), 10 * 256)
    disparity[0, 0] = 0
    flow = np.ones((H, W, 2))
    flow[0, 0] = np.nan
    png16(root / "training" / disparities / "000007_10.png", disparity)
    write_kitti_flow(root / "training" / "flow_occ" / "000007_10.png", flow)
    return root


@pytest.mark.parametrize("below", ["", "training"])
@pytest.mark.parametrize("index", ["7", "000007"])
@pytest.mark.parametrize("kind", KITTI)
def test_kitti(tmp_path: Path, kind: str, below: str, index: str) -> None:
    root = kitti(tmp_path, kind)
    pair = load(kind, root / below, index=index)
    truth = pair.truth
    assert pair.K_ref[0, 2] == 4.0
    assert np.isnan(truth.depth_ref[0, 0])
    np.testing.assert_allclose(truth.depth_ref[1:], 54 / 10)
    assert np.isnan(truth.flow[0, 0]).all()
    assert (truth.flow[1:] == 1).all()
    assert truth.depth_next is truth.components is None
    picture(root / "training" / "obj_map" / "000007_10.png", np.eye(H, W, dtype=np.uint8))
    assert load(kind, root, index="7").truth.components.sum() == H


@pytest.mark.parametrize("kind", KITTI)
def test_kitti_errors(tmp_path: Path, kind: str) -> None:
    root = kitti(tmp_path, kind)
    images, calibration, left, right, _ = KITTI[kind]
    missing = rf"000008_10\.png[\s\S]*expected: training/{images}[\s\S]*{calibration}"
    refuses(missing, kind, root, index="8")
    for index in ("seven", "-7", ""):
        with pytest.raises(ConfigError, match=r"input\.index[\s\S]*such as 27 or '000027'"):
            load(kind, root, index=index)
    for text, match in {
        CALIBRATION.format(left, "P9"): f"lacks the numbers of {right}:",
        f"{left}: 1 2 3\n{right}: 1 2 3\n": f"lacks the numbers of {left}:",
        CALIBRATION.format(left, right).replace("-49", "5"): "no baseline",
    }.items():
        put(root / "training" / calibration / "000007.txt", text.encode())
        refuses(match, kind, root, index="7")
    refuses(r"has no training|has no image_0|nothing", kind, tmp_path / "nowhere", index="7")


# --- Virtual KITTI ------------------------------------------------------------------------------


def vkitti_flow(path: Path) -> None:
    bgr = np.full((H, W, 3), (65535, 0, 65535))
    bgr[0, 0] = 0
    png16(path, bgr)


def test_vkitti1(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(CAMERAS, "Virtual KITTI 1", (725, 725, 4, 2.5))
    for number in (0, 1):
        name = f"0001/clone/{number:05d}.png"
        picture(tmp_path / "vkitti_1.3.1_rgb" / name, number)
        png16(tmp_path / "vkitti_1.3.1_depthgt" / name, np.full((H, W), 1234))
    vkitti_flow(tmp_path / "vkitti_1.3.1_flowgt" / "0001/clone/00000.png")
    with pytest.warns(DataWarning, match="assumed: fx,fy,cx,cy 725.* for 1242 x 375"):
        pair = load("vkitti1", tmp_path, scene="0001", frame=0)
    np.testing.assert_allclose(pair.truth.depth_next, 12.34)
    assert np.isnan(pair.truth.flow[0, 0]).all()
    assert pair.truth.flow[1, 1].tolist() == [W - 1, 1 - H]
    assert pair.K_ref[0, 0] == 725
    refuses(r"00002\.png", "vkitti1", tmp_path, scene="0001", frame=1)
    refuses(r"vkitti_\*_rgb", "vkitti1", tmp_path / "vkitti_1.3.1_rgb", scene="0001", frame=1)


def test_vkitti2(tmp_path: Path) -> None:
    base = tmp_path / "Scene01" / "clone"
    for number in (3, 4):
        picture(base / "frames" / "rgb" / "Camera_0" / f"rgb_{number:05d}.jpg", number)
        png16(base / f"frames/depth/Camera_0/depth_{number:05d}.png", np.full((H, W), 65535))
    vkitti_flow(base / "frames" / "forwardFlow" / "Camera_0" / "flow_00003.png")
    rows = "frame cameraID K[0,0] K[1,1] K[0,2] K[1,2]\n3 0 725 725 4 2.5\n"
    (base / "intrinsic.txt").write_text(rows + "4 0 726 726 4 2.5\n")
    pair = load("vkitti2", tmp_path, scene="Scene01", frame=3)
    assert (pair.K_ref[0, 0], pair.K_next[0, 0]) == (725, 726)
    assert np.isnan(pair.truth.depth_ref).all()
    (base / "intrinsic.txt").write_text(rows)
    for match, more in (
        (r"lacks the numbers of 4 0", {}),
        (r"Scene01/clone has no|Scene01 has no fog", {"variation": "fog"}),
    ):
        refuses(match, "vkitti2", tmp_path, scene="Scene01", frame=3, **more)


# --- Sintel, TUM, Motorcycle --------------------------------------------------------------------


def test_sintel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(CAMERAS, "alley_1", (688, 688, 4, 2.5))
    base = tmp_path / "training"
    for scene in ("cave_2", "alley_1"):
        for number in (1, 2):
            picture(base / "final" / scene / f"frame_{number:04d}.png", number)
    cave = {"scene": "cave_2", "frame": 1, "render": "final"}
    with pytest.warns(DataWarning, match=r"cave_2/frame_0001\.cam.*alley_1"):
        pair = load("sintel", tmp_path, **cave)
    assert pair.K_ref[0, 0] == 688
    # the default camera is that of alley_1, but the warning still says that no file gives it
    with pytest.warns(
        DataWarning, match=r"camdata_left.*assumed: fx,fy,cx,cy 688,688,4,2.5 of alley_1$"
    ):
        assert load("sintel", tmp_path, scene="alley_1", frame=1, render="final").K_ref[0, 0] == 688
    for number, focal in ((1, 100.0), (2, 120.0)):
        name = f"cave_2/frame_{number:04d}"
        camera = np.array([[focal, 0, 4.0], [0, focal, 3.0], [0, 0, 1]])
        write_cam(base / "camdata_left" / f"{name}.cam", camera)
        write_dpt(base / "depth" / f"{name}.dpt", np.full((H, W), focal))
    write_flo(base / "flow" / "cave_2" / "frame_0001.flo", np.zeros((H, W, 2)))
    mask = np.zeros((H, W), np.uint8)
    mask[0, 5] = 255
    picture(base / "invalid" / "cave_2" / "frame_0001.png", mask)
    pair = load("sintel", tmp_path, **cave)
    truth = pair.truth
    assert (pair.K_ref[0, 0], pair.K_next[0, 0]) == (100.0, 120.0)
    assert truth.depth_next[0, 0] == 120.0
    np.testing.assert_array_equal(np.isnan(truth.flow).all(axis=2), mask > 0)
    picture(base / "invalid" / "cave_2" / "frame_0001.png", mask[1:])
    refuses("mask and flow differ in size", "sintel", tmp_path, **cave)
    refuses(r"clean/cave_2|has no clean", "sintel", tmp_path, scene="cave_2", frame=1)


def test_tum(tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(CAMERAS, "freiburg3", (535.4, 539.2, 4, 2.5))
    monkeypatch.setitem(CAMERAS, "TUM RGB-D", (525, 525, 4, 2.5))
    root = tmp_path / "rgbd_dataset_freiburg3_x"
    for k in range(3):
        picture(root / "rgb" / f"{k}.png", k)
        png16(root / "depth" / f"{k}.png", np.full((H, W), 5000 * (k + 1)))
    (root / "rgb.txt").write_text("# colour\n1.00 rgb/0.png\n1.03 rgb/1.png\n1.06 rgb/2.png\n")
    (root / "depth.txt").write_text("1.001 depth/0.png\n1.2 depth/1.png\n1.055 depth/2.png\n")
    with pytest.warns(DataWarning, match=r"assumed: fx,fy,cx,cy 535.4,539.2,4,2.5 of freiburg3"):
        pair = load("tum", root, frame=0, step=2, depth_scale=5000.0)
    assert pair.K_ref[0, 0] == 535.4
    np.testing.assert_array_equal(pair.truth.depth_ref, 1.0)
    np.testing.assert_array_equal(pair.truth.depth_next, 3.0)
    (root / "camera.txt").write_text("90 91 4 3")
    pair_1 = load("tum", root, frame=1, depth_scale=1000.0)
    assert pair_1.truth.depth_ref is None
    assert pair_1.truth.depth_next[0, 0] == 15
    assert (pair_1.K_ref[0, 0], pair_1.K_next[1, 1]) == (90, 91)
    with pytest.warns(DataWarning, match="depth is not given; assumed: 5000 values"):
        assert load("tum", root).truth.depth_ref[0, 0] == 1
    (root / "camera.txt").rename(root / "K.txt")
    assert load("tum", root, depth_scale=5000.0).K_ref[0, 0] == 90
    (root / "K.txt").unlink()
    other = root.rename(tmp_path / "other")
    with pytest.warns(DataWarning, match="assumed: .* of TUM RGB-D"):
        assert load("tum", other, depth_scale=5000.0).K_ref[0, 0] == 525
    other.rename(root)
    (root / "K.txt").write_text("90 91 4 3")
    refuses(r"not in the sequence[\s\S]*0 to 2", "tum", root, frame=2, depth_scale=5000.0)
    (root / "rgb" / "1.png").unlink()
    refuses(r"1\.png", "tum", root, depth_scale=5000.0)
    (root / "rgb.txt").write_text("1.0\n")
    refuses("file list is not understood", "tum", root, depth_scale=5000.0)
    refuses(r"rgb\.txt[\s\S]*expected: rgb\.txt, depth\.txt", "tum", folder)


def test_motorcycle_geometry(monkeypatch: pytest.MonkeyPatch) -> None:
    image = np.zeros((4, 40, 3), np.uint8)
    disparity = np.full((4, 40), 5.0, np.float32)
    disparity[0, 0], disparity[0, 1] = np.inf, 0.0
    monkeypatch.setattr("skimage.data.stereo_motorcycle", lambda: (image, image, disparity))
    pair = load("motorcycle", Path())
    truth = pair.truth
    assert np.isnan(truth.depth_ref[0, :2]).all()
    v, u = np.mgrid[:4, :40].astype(float)
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(pair.K_ref).T
    moved = rays * truth.depth_ref[..., None] + truth.scene_flow
    image_of = moved @ pair.K_next.T
    flow = image_of[..., :2] / image_of[..., 2:] - np.stack([u, v], -1)
    np.testing.assert_allclose(flow, truth.flow, atol=1e-9)


@pytest.mark.slow
@pytest.mark.shared
def test_real_pairs(shared_data: Path) -> None:
    pair = load("kitti2012", shared_data / "kitti2012", index="27")
    depth = pair.truth.depth_ref
    disparity = read_depth_png16(
        shared_data / "kitti2012" / "training" / "disp_occ" / "000027_10.png", KITTI_DISPARITY
    )
    finite = np.isfinite(disparity)
    np.testing.assert_array_equal(np.isfinite(depth), finite)
    np.testing.assert_allclose(depth[finite] * disparity[finite], 718.856 * 0.53717, rtol=1e-4)
    with pytest.warns(DataWarning, match="688,688"):
        sintel = load("sintel", shared_data / "sintel", scene="alley_1", frame=2)
    with pytest.warns(DataWarning, match="688,688"):
        far = load("sintel", shared_data / "sintel", scene="alley_1", frame=20, step=5)
    assert str(sintel.truth) == "Truth(flow; m)"
    assert "depth_ref" in str(far)
    driving = load("folder", shared_data / "driving_synthetic")
    assert "depth_ref, flow" in str(driving)
    paper = load("folder", shared_data / "kinect_paper" / "pair_049")
    assert 0.3 < np.median(paper.truth.points[:, 2]) < 1.0
    desk = load("folder", shared_data / "tum_fr1", depth_scale=5000.0).truth
    assert 0.5 < np.nanmedian(desk.depth_ref) < 3.0
