"""Camera files of common tools: the right value, or a refusal that says expected and try."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from helpers_files import npy, npz

from soup_nlp.data.formats.camera_files import read_camera
from soup_nlp.errors import DataError

RIGHT = (256.0, 257.0, 159.5, 119.5)
ROWS = "256, 0, 159.5, 0, 257, 119.5, 0, 0, 1"
COLUMNS = "256, 0, 0, 0, 257, 0, 159.5, 119.5, 1"
K = np.array([[256, 0, 159.5], [0, 257, 119.5], [0, 0, 1]])
FOUR = "fx: 256\nfy: 257\ncx: 159.5\ncy: 119.5\n"
GROUP = {"fx": 256, "fy": 257, "cx": 159.5, "cy": 119.5}
KALIBR = "  camera_model: {}\n  distortion_model: {}\n  distortion_coeffs: {}\n  intrinsics: {}\n"
LIST = "[256, 257, 159.5, 119.5]"


def opencv(name: str, values: str, rows: int) -> str:
    body = f"   rows: {rows}\n   cols: 3\n   dt: d\n   data: [ {values} ]\n"
    return f"{name}: !!opencv-matrix\n{body}"


READ: dict[str, tuple[str | bytes, list[float]]] = {
    "four numbers": ("256 257 159.5 119.5", []),
    "rows": ("# camera\n256 0 159.5\n0 257 119.5\n0 0 1\n", []),
    "columns": (COLUMNS, []),
    "exponents": ("2.56e2 +257 1.595E+02 119.5", []),
    "4x4": ("256 0 159.5 0\n0 257 119.5 0\n0 0 1 0\n0 0 0 1", []),
    "MATLAB": ("K = [256 0 159.5; 0 257 119.5; 0 0 1];  % pixels", []),
    "with distortion": ("256 257 159.5 119.5 0.1 -0.2 0 0.001 0.3", [0.1, -0.2, 0, 0.001, 0.3]),
    "names": (FOUR, []),
    "equal signs": ("fx=256, fy=257, cx=159.5, cy=119.5", []),
    "one row of names": ("fx 256 fy 257 cx 159.5 cy 119.5", []),
    "head row": ("fx,fy,cx,cy\n256,257,159.5,119.5\n", []),
    "INI": ("[camera]\nfx = 256\nfy = 257\ncx = 159.5\ncy = 119.5\nk1 = -0.3\n", [-0.3]),
    "twice the same": (FOUR + "fx: 256.0", []),
    "ROS 1": (
        f"image_width: 320\ncamera_name: a\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: [{ROWS}]"
        "\ndistortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n"
        "  data: [-0.3, 0.1, 0, 0, 0]\nrectification_matrix:\n  rows: 3\n  cols: 3\n"
        "  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nprojection_matrix:\n  rows: 3\n  cols: 4\n"
        "  data: [250, 0, 160, 0, 0, 250, 120, 0, 0, 0, 1, 0]\n",
        [-0.3, 0.1],
    ),
    "ROS 2": (f"header:\n  frame_id: c\nk: [{ROWS}]\nd: [0.1, 0, 0, 0, 0]\np: [250]", [0.1]),
    "ROS 2 messages": (
        2 * "header:\n  stamp:\n    sec: 1\nk:\n- 256.0\n- 0.0\n- 159.5\n- 0.0\n- 257.0\n- 119.5\n"
        "- 0.0\n- 0.0\n- 1.0\nd: []\n---\n",
        [],
    ),
    "oST": (
        "# oST version 5.0\n[image]\nwidth\n320\nheight\n240\n[narrow_stereo]\ncamera matrix\n"
        "256 0 159.5\n0 257 119.5\n0 0 1\n\ndistortion\n-0.3 0.1 0 0 0\n\nrectification\n1 0 0\n"
        "0 1 0\n0 0 1\n\nprojection\n250 0 160 0\n0 250 120 0\n0 0 1 0\n",
        [-0.3, 0.1],
    ),
    "OpenCV": (
        "%YAML:1.0\n---\n" + opencv("camera_matrix", ROWS, 3)
        + opencv("distortion_coefficients", "0.1, 0., 0., 0., 0.", 5),
        [0.1],
    ),
    "ORB-SLAM": (
        '%YAML:1.0\nCamera.type: "PinHole"\nCamera.fx: 256\nCamera.fy: 257\nCamera.cx: 159.5\n'
        "Camera.cy: 119.5\nCamera.k1: 0.\nCamera.fps: 30\nViewer.ViewpointF: 500\nThDepth: 35.0\n",
        [],
    ),
    "EuRoC": (
        "sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [0, -1, 0, 3, 1, 0, 0, 0, 0, 0,"
        f" 1, 0, 0, 0, 0, 1]\nrate_hz: 20\nintrinsics: {LIST} #fu, fv, cu, cv\ncamera_model:"
        " pinhole\ndistortion_model: radial-tangential\ndistortion_coefficients: [0, 0, 0, 0]\n",
        [],
    ),
    "two alike": (
        "".join(f"cam{k}:\n" + KALIBR.format("pinhole", "none", [], LIST) for k in (0, 1)),
        [],
    ),
    "basalt": (
        json.dumps({"value0": {"intrinsics": [{"camera_type": "pinhole", "intrinsics": GROUP}]}}),
        [],
    ),
    "nerfstudio": (
        json.dumps(
            {"fl_x": 256, "fl_y": 257, "cx": 159.5, "cy": 119.5, "k1": 0, "camera_model": "OPENCV",
             "frames": [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}]}
        ),
        [],
    ),
    "Open3D": (
        json.dumps({"width": 320, "intrinsic_matrix": K.T.ravel().tolist()}),
        [],
    ),
    "twelve coefficients": (FOUR + f"distortion: {[0.1] * 12}", [0.1] * 12),
    "no fisheye": (json.dumps({**GROUP, "is_fisheye": False, "fisheye": {"k1": 0}}), []),
    "no distortion": (FOUR + "focal_length: 4.2 mm\ndistortion: null", []),
    "RealSense": (
        json.dumps({"fx": 256, "fy": 257, "ppx": 159.5, "ppy": 119.5,
                    "model": "distortion.inverse_brown_conrady", "coeffs": [0, 0, 0, 0, 0]}),
        [],
    ),
    "Bouguet": ("fc: [256, 257]\ncc: [159.5, 119.5]\nkc: [0.1, 0, 0, 0, 0]\nalpha_c: 0", [0.1]),
    "COLMAP OPENCV": ("1 OPENCV 320 240 256 257 160 120 0.1 0.2 0 0.01", [0.1, 0.2, 0, 0.01]),
    "KITTI odometry": (
        "".join(f"P{k}: 256 0 159.5 {-k} 0 257 119.5 0 0 0 1 0\n" for k in range(4))
        + "Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n",
        [],
    ),
    "UTF-16": (FOUR.encode("utf-16"), []),
    "UTF-8 with a mark": (FOUR.encode("utf-8-sig"), []),
    ".npy numbers": (npy(RIGHT), []),
    ".npz": (npz(mtx=K, dist=np.array([[0.1, 0, 0, 0, 0]]), rvecs=np.ones((5, 3))), [0.1]),
}  # fmt: skip


@pytest.mark.parametrize("name", READ)
def test_a_camera_is_read(name: str, tmp_path: Path) -> None:
    content, lens = READ[name]
    path = tmp_path / "camera"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    matrix, distortion = read_camera(path)
    np.testing.assert_array_equal(matrix, K)
    np.testing.assert_allclose(distortion, lens)


REFUSED: dict[str, tuple[str | bytes, str]] = {
    "ORB-SLAM3 stereo": (
        "".join(
            f"Camera{k}.fx: {f}\nCamera{k}.fy: {f}\nCamera{k}.cx: 159.5\nCamera{k}.cy: 119.5\n"
            for k, f in ((1, 256), (2, 300))
        ),
        r"2 cameras[\s\S]*Camera1: 256,256,159.5,119.5; Camera2: 300,[\s\S]*--intrinsics 256,256,",
    ),
    "two in INI": (
        "[LEFT_CAM]\n" + FOUR.replace(":", "=") + "[RIGHT_CAM]\n" + FOUR.replace("256", "300"),
        "2 cameras[\\s\\S]*LEFT_CAM: [\\s\\S]*RIGHT_CAM: ",
    ),
    "Middlebury": (
        "cam0=[256 0 159.5; 0 257 119.5; 0 0 1]\ncam1=[256 0 190; 0 257 119.5; 0 0 1]\ndoffs=30",
        r"2 cameras[\s\S]*cam0: [\s\S]*cam1: ",
    ),
    "two of COLMAP": (
        "1 PINHOLE 320 240 256 257 160 120\n2 SIMPLE_PINHOLE 320 240 256 160 120",
        "2 cameras[\\s\\S]*camera 1: [\\s\\S]*camera 2: ",
    ),
    "a frame each": (
        json.dumps({"frames": [{"fl_x": f, "fl_y": f, "cx": 1, "cy": 2} for f in (256, 300)]}),
        "2 cameras",
    ),
    "other distortion": (
        "".join(
            f"cam{k}:\n" + KALIBR.format("pinhole", "radtan", [k, 0, 0, 0], LIST) for k in (0, 1)
        ),
        r"distortion[\s\S]*0 and 1",
    ),
    "twice": (FOUR + "fx: 300", r"fx is given twice[\s\S]*256 and 300"),
    "twice in JSON": ('{"fx": 256, "fx": 300, "fy": 1, "cx": 1, "cy": 1}', "fx is given twice"),
    "EUCM parameters": (json.dumps({**GROUP, "alpha": 0.6, "beta": 1.1}), "another model"),
    "ORB-SLAM3 fisheye": (FOUR + 'Camera.type: "KannalaBrandt8"', "another model"),
    "OpenSfM": (json.dumps({"v2": {"projection_type": "spherical", **GROUP}}), "another model"),
    "COLMAP fisheye": ("1 OPENCV_FISHEYE 320 240 256 257 160 120 0 0 0 0", "another model"),
    "COLMAP of other length": ("1 OPENCV 320 240 256 257 160 120 0.1", "5 parameters"),
    "instant-ngp fisheye": (json.dumps({**GROUP, "is_fisheye": True}), "another model"),
    "Mei": ("model_type: MEI\nmirror_parameters:\n  xi: 0.9\n" + FOUR, "another model"),
    "other distortion model": (FOUR + "distortion_model: division\nk1: 0.1", "another model"),
    "k of two": (json.dumps({**GROUP, "k": [0.1, 0.2]}), "of another model"),
    "D1": ("M1: [256, 0, 1, 0, 256, 1, 0, 0, 1]\nD1: [.1, 0, 0, 0]\nD2: [.2, 0, 0, 0]", "unclear"),
    "k0": (FOUR + "k0: 0.1", "of another model"),
    "nested": (json.dumps({**GROUP, "lens": {"distortion": {"a": 0.1}}}), "of another model"),
    "inverse": (
        json.dumps({**GROUP, "model": "inverse_brown_conrady", "coeffs": [0.1, 0, 0, 0, 0]}),
        "of another model",
    ),
    "decimal commas without names": ("256,5 256,5 59,5 19,5", r"'256,5'[\s\S]*decimal comma"),
    "empty": ("fx:\nfy: 1\ncx: 1\ncy: 1", "fx is not one number"),
    "two points": (FOUR.replace("256", "1.2.3"), r"'1\.2\.3'"),
    "a unit in lines": ("fx = 4.2 mm\nfy = 4.2 mm\ncx = 1\ncy = 1", "not one|not a number"),
    "two numbers": (FOUR.replace("256", "[256, 257]"), "fx is not one number"),
    "NaN distortion": (FOUR + "k1: .nan", "distortion k1 is unclear"),
    "NaN distortion without names": ("256 257 159.5 119.5 0.1 nan", "wrong number of values"),
    "infinite": (json.dumps({**GROUP, "fx": float("inf")}), "no camera matrix"),
    "negative": (json.dumps({**GROUP, "fx": -1}), "no camera matrix"),
    "half a camera": ("fx: 256\ncx: 1", "lacks fy and cy"),
    "a field of view": ('{"camera_angle_x": 0.6911112070083618, "frames": []}', "--fov 39.60"),
    "no camera": ("width: 320\nheight: 240", r"no camera[\s\S]*width, height"),
    "damaged JSON": ('{"fx": 256, "fy": 257, "cx": 159.5, "cy"', "damaged JSON"),
    "nested deeply": ("[" * 100_000, "kind"),
    "XML": ("<?xml version='1.0'?><opencv_storage></opencv_storage>", "XML"),
    "empty file": ("", "is empty"),
    "binary": (b"\x80\x04\x95\x00\x00", "not text"),
    "other .npy": (npy(np.ones(3)), "wrong number of values"),
    "prose": ("the camera of my phone", "no camera"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_camera_is_refused(name: str, tmp_path: Path) -> None:
    content, match = REFUSED[name]
    path = tmp_path / "camera"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(DataError) as caught:
        read_camera(path)
    text = str(caught.value)
    assert re.search(match, text), text
    assert "\n  expected: " in text
    assert "\n  try: " in text
