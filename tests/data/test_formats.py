"""Flow and depth files: golden bytes, round trips, malformed files."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers_files import put, raises, write_dpt, write_flo, write_kitti_flow, write_pfm
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from soup_nlp.data.formats import map_files as fmt
from soup_nlp.data.formats.camera_files import read_kitti_projections

many = settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
shapes = st.tuples(st.integers(1, 7), st.integers(1, 7))


def floats(low: float, high: float) -> st.SearchStrategy[np.ndarray]:
    return shapes.flatmap(
        lambda s: hnp.arrays(np.float32, s, elements=st.floats(low, high, width=32))
    )


def flows(low: float, high: float) -> st.SearchStrategy[np.ndarray]:
    number = st.floats(low, high, width=32)
    return shapes.flatmap(lambda s: hnp.arrays(np.float32, (*s, 2), elements=number))


# --- .flo ---------------------------------------------------------------------------------------


def test_flo_golden_bytes(tmp_path: Path) -> None:
    golden = struct.pack("<fii4f", 202021.25, 2, 1, 1.5, -2.0, 1e10, 0.0)
    assert golden[:4] == b"PIEH"
    flow = fmt.read_flow(put(tmp_path / "a.flo", golden))
    np.testing.assert_array_equal(flow, [[[1.5, -2.0], [np.nan, np.nan]]])


@pytest.mark.shared
def test_real_files(shared_data: Path, tmp_path: Path) -> None:
    """A header of 1024 x 436 and the values that are read are the bytes of the file."""
    header, sintel = struct.pack("<4sii", b"PIEH", 1024, 436), shared_data / "sintel" / "training"
    for path, read in (
        (sintel / "flow" / "alley_1" / "frame_0002.flo", fmt.read_flow),
        (sintel / "depth" / "alley_1" / "frame_0020.dpt", fmt.read_depth),
    ):
        values = read(path)
        assert values.shape[:2] == (436, 1024)
        assert path.read_bytes() == header + values.astype("<f4").tobytes()
    folder = shared_data / "kitti2012" / "training"
    flow = fmt.read_flow(folder / "flow_occ" / "000027_10.png")
    write_kitti_flow(tmp_path / "a.png", flow)
    np.testing.assert_array_equal(fmt.read_flow(tmp_path / "a.png"), flow)
    (projection,) = read_kitti_projections(folder / "calib" / "000027.txt", ["P1"])
    assert projection[0, 3] == -386.1448


@many
@given(flow=flows(-1e9, 1e9))
def test_flo_round_trip(tmp_path: Path, flow: np.ndarray) -> None:
    write_flo(tmp_path / "a.flo", flow)
    np.testing.assert_array_equal(fmt.read_flow(tmp_path / "a.flo"), flow)


@pytest.mark.parametrize("mark", [np.nan, np.inf, -np.inf, 1.1e9, -2e9])
def test_flo_unknown(tmp_path: Path, mark: float) -> None:
    body = struct.pack("<fii4f", 202021.25, 2, 1, 1.0, mark, 1.0, 1.0)
    flow = fmt.read_flow(put(tmp_path / "a.flo", body))
    assert np.isnan(flow[0, 0]).all()
    assert np.isfinite(flow[0, 1]).all()


def sized(width: int, height: int, count: int) -> bytes:
    """A .flo or .dpt file with a body of `count` bytes."""
    return b"PIEH" + struct.pack("<ii", width, height) + bytes(count)


@pytest.mark.parametrize(
    ("name", "content", "match"),
    [
        ("a.flo", b"", "is empty"),
        ("a.flo", b"PIEX" + bytes(16), "wrong magic number"),
        ("a.flo", b"PIEH\x01", "truncated"),
        ("a.flo", sized(4, 3, 95), "truncated"),
        ("a.flo", sized(4, 3, 97), "left over"),
        ("a.flo", sized(0, 3, 0), "impossible size"),
        ("a.flo", sized(-4, 3, 96), "impossible size"),
        ("a.flo", sized(2**31 - 1, 2**31 - 1, 0), "impossible size"),
        ("a.dpt", b"", "is empty"),
        ("a.dpt", b"PIEX" + bytes(16), "wrong magic number"),
        ("a.dpt", b"PIEH\x01", "truncated"),
        ("a.dpt", sized(4, 3, 47), "truncated"),
        ("a.dpt", sized(4, 3, 49), "left over"),
        ("a.dpt", sized(0, 3, 0), "impossible size"),
        ("a.dpt", sized(-4, 3, 48), "impossible size"),
        ("a.dpt", sized(2**31 - 1, 2**31 - 1, 0), "impossible size"),
        ("a.pfm", b"PF\n1 1\n-1.0\n" + bytes(12), "in colour"),
        ("a.pfm", b"P5\n1 1\n255\n0", "damaged header"),
        ("a.pfm", b"Pf\n1 1\n0\n" + bytes(4), "damaged header"),
        ("a.pfm", b"Pf\n1 1\n1e1e\n" + bytes(4), "damaged header"),
        ("a.pfm", b"Pf\n0 1\n-1\n", "impossible size"),
        ("a.pfm", b"Pf\n2 2\n-1\n" + bytes(15), "truncated"),
    ],
)
def test_a_malformed_file_is_refused(name: str, content: bytes, match: str, tmp_path: Path) -> None:
    read = fmt.read_flow if name == "a.flo" else fmt.read_depth
    with raises(match) as caught:
        read(put(tmp_path / name, content))
    assert name in str(caught.value)


def test_missing_file_names_its_neighbours(tmp_path: Path) -> None:
    put(tmp_path / "flow_0.flo", b"x")
    with raises(r"flow file is missing[\s\S]*flow_0\.flo"):
        fmt.read_flow(tmp_path / "flow_1.flo")
    with raises(r"folder .* does not exist"):
        fmt.read_flow(tmp_path / "nowhere" / "a.flo")
    (tmp_path / "flow_2.flo").mkdir()
    with raises("cannot be read"):
        fmt.read_flow(tmp_path / "flow_2.flo")


# --- flow in PNG --------------------------------------------------------------------------------


def test_kitti_flow_channel_order(tmp_path: Path) -> None:
    rgb = np.array([[[2**15 + 64, 2**15 - 128, 1], [1, 2, 0]]], np.uint16)
    cv2.imwrite(str(tmp_path / "a.png"), rgb[:, :, ::-1])
    flow = fmt.read_flow(tmp_path / "a.png")
    np.testing.assert_array_equal(flow, [[[1.0, -2.0], [np.nan, np.nan]]])


@many
@given(flow=flows(-512, 511.875))
def test_kitti_flow_round_trip(tmp_path: Path, flow: np.ndarray) -> None:
    flow[0, 0] = np.nan
    write_kitti_flow(tmp_path / "a.png", flow)
    np.testing.assert_allclose(fmt.read_flow(tmp_path / "a.png"), flow, atol=1 / 128, rtol=0)


def test_kitti_flow_rejects_8_bit(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((4, 4, 3), np.uint8))
    with raises(r"uint8 with 3 channel"):
        fmt.read_flow(tmp_path / "a.png")
    cv2.imwrite(str(tmp_path / "b.png"), np.zeros((4, 4), np.uint16))
    with raises(r"uint16 with 1 channel"):
        fmt.read_flow(tmp_path / "b.png")


def test_vkitti_flow(tmp_path: Path) -> None:
    height, width = 5, 11
    flow = np.zeros((height, width, 2))
    flow[..., 0], flow[..., 1] = 3.0, -1.5
    code = np.rint((flow / [width - 1, height - 1] + 1) / 2 * 65535)
    bgr = np.dstack([np.ones((height, width)), code[..., 1], code[..., 0]]).astype(np.uint16)
    bgr[0, 0, 0] = 0
    cv2.imwrite(str(tmp_path / "a.png"), bgr)
    back = fmt.read_vkitti_flow(tmp_path / "a.png")
    assert np.isnan(back[0, 0]).all()
    np.testing.assert_allclose(back[1:], flow[1:], atol=2 * (width - 1) / 65535)


def test_read_flow_npy_and_suffixes(tmp_path: Path) -> None:
    flow = np.ones((3, 4, 2))
    flow[0, 0, 1] = np.inf
    flow[0, 1, 0] = 1e10
    np.save(tmp_path / "a.npy", flow)
    back = fmt.read_flow(tmp_path / "a.npy")
    assert np.isnan(back[0, :2]).all()
    assert (back[1:] == 1).all()
    write_flo(tmp_path / "A.FLO", flow[1:])
    assert (fmt.read_flow(tmp_path / "A.FLO") == 1).all()
    with raises(r"unknown suffix[\s\S]*\.flo, \.png, \.npy"):
        fmt.read_flow(tmp_path / "a.tiff")
    np.save(tmp_path / "b.npy", np.array(["x"]))
    with raises("does not hold numbers"):
        fmt.read_flow(tmp_path / "b.npy")
    whole = (tmp_path / "a.npy").read_bytes()
    for content, match in ((whole[:-9], "not a readable .npy"), (whole + b"x", "left over")):
        with raises(match):
            fmt.read_flow(put(tmp_path / "c.npy", content))
    np.save(tmp_path / "d.npy", np.zeros((3, 4)))
    with raises("wrong shape"):
        fmt.read_flow(tmp_path / "d.npy")


# --- depth --------------------------------------------------------------------------------------


@many
@given(depth=floats(0.0009765625, 1e6))
def test_dpt_and_pfm_round_trip(tmp_path: Path, depth: np.ndarray) -> None:
    write_dpt(tmp_path / "a.dpt", depth)
    np.testing.assert_array_equal(fmt.read_depth(tmp_path / "a.dpt"), depth)
    for scale in ("-1.0", "1.0"):
        write_pfm(tmp_path / "a.pfm", depth, scale)
        np.testing.assert_array_equal(fmt.read_depth(tmp_path / "a.pfm"), depth)


@many
@given(
    code=shapes.flatmap(lambda s: hnp.arrays(np.uint16, s)),
    scale=st.sampled_from([100, 256, 1000, 5000.0]),
)
def test_png16_values(tmp_path: Path, code: np.ndarray, scale: float) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), code)
    depth = fmt.read_depth_png16(tmp_path / "a.png", scale)
    np.testing.assert_array_equal(np.isnan(depth), code == 0)
    np.testing.assert_allclose(depth[code > 0], code[code > 0] / scale)
    np.testing.assert_array_equal(fmt.read_depth(tmp_path / "a.png", scale), depth)


def test_depth_unknown_values(tmp_path: Path) -> None:
    depth = np.array([[1.0, 0.0, -1.0, np.inf, np.nan]])
    np.save(tmp_path / "a.npy", depth)
    write_dpt(tmp_path / "a.dpt", depth)
    write_pfm(tmp_path / "a.pfm", depth)
    for name in ("a.npy", "a.dpt", "a.pfm"):
        out = fmt.read_depth(tmp_path / name)
        assert out.dtype == np.float64
        np.testing.assert_array_equal(out, [[1.0] + [np.nan] * 4])


@pytest.mark.parametrize(("scale", "order"), [(b"-1.0", "<f4"), (b"1", ">f4"), (b"-3.5e-1", "<f4")])
def test_pfm_golden_bytes(tmp_path: Path, scale: bytes, order: str) -> None:
    rows = np.array([[1, 2, 3], [4, 5, 6]], order)
    path = put(tmp_path / "a.pfm", b"Pf\n3 2\n" + scale + b"\n" + rows[::-1].tobytes())
    np.testing.assert_array_equal(fmt.read_pfm(path), rows)


@pytest.mark.parametrize("comment", [b"# made by a program\n", b"# one\n# two\r\n", b""])
def test_a_pfm_with_comments_is_read(comment: bytes, tmp_path: Path) -> None:
    depth = np.arange(1, 13, dtype=np.float32).reshape(3, 4)
    write_pfm(tmp_path / "a.pfm", depth)
    content = (tmp_path / "a.pfm").read_bytes()
    for line in (b"Pf\n", b"4 3\n"):
        head, tail = content.split(line, 1)
        (tmp_path / "a.pfm").write_bytes(head + line + comment + tail)
        np.testing.assert_array_equal(fmt.read_depth(tmp_path / "a.pfm"), depth)


def test_png16_errors(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((4, 4), np.uint8))
    with raises("16-bit PNG with 1 channel"):
        fmt.read_depth(tmp_path / "a.png", 1000.0)
    for scale in (0, -1, np.nan, np.inf):
        with raises("scale must be positive"):
            fmt.read_depth_png16(tmp_path / "a.png", scale)
    np.save(tmp_path / "c.npy", np.zeros((2, 2, 1)))
    with raises("wrong shape"):
        fmt.read_depth(tmp_path / "c.npy")


def test_kitti_disparity_and_vkitti_depth(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.array([[0, 256, 384, 65535]], np.uint16))
    disparity = fmt.read_depth_png16(tmp_path / "a.png", fmt.KITTI_DISPARITY)
    np.testing.assert_array_equal(disparity, [[np.nan, 1.0, 1.5, 65535 / 256]])
    depth = fmt.read_vkitti_depth(tmp_path / "a.png")
    np.testing.assert_array_equal(depth, [[np.nan, 2.56, 3.84, np.nan]])
