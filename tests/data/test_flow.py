"""Flow sources: DIS with its confidence, files, truth, plug-ins."""

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from helpers_files import grey_texture, raises, write_flo, write_kitti_flow
from hypothesis import given, settings
from hypothesis import strategies as st

from soup_nlp.data.datasets.benchmarks import KittiInput
from soup_nlp.data.flow import dis
from soup_nlp.data.flow.consistency import confidence_of, round_trip_error
from soup_nlp.data.flow.dis import dominant_homographies, guided_flow
from soup_nlp.data.flow.sources import dis_flow, flow_sources, resolve_flow
from soup_nlp.data.pair import Flow, Pair, Truth

K = np.array([[100.0, 0.0, 40.0], [0.0, 100.0, 30.0], [0.0, 0.0, 1.0]])


def shifted(height: int, width: int, du: int, dv: int) -> tuple[np.ndarray, np.ndarray]:
    """Two windows of one texture; a pixel of the first is at (u + du, v + dv) in the second."""
    big = grey_texture(height + 40, width + 40)
    first = big[20 : 20 + height, 20 : 20 + width]
    second = big[20 - dv : 20 - dv + height, 20 - du : 20 - du + width]
    return np.dstack([first] * 3), np.dstack([second] * 3)


def pair_of(truth: Truth | None = None, size: tuple[int, int] = (60, 80)) -> Pair:
    first, second = shifted(*size, 3, 1)
    return Pair(first, second, K, K, truth=truth, name="test")


SIDES, SHIFTS = st.integers(16, 90), st.integers(-3, 3)


@pytest.mark.slow
@settings(max_examples=15)
@given(SIDES, SIDES, SHIFTS, SHIFTS)
def test_dis_finds_a_shift_at_any_size(height: int, width: int, du: int, dv: int) -> None:
    flow = dis_flow(*shifted(height, width, du, dv))
    assert flow.uv.shape == (height, width, 2)
    assert flow.uv.dtype == flow.confidence.dtype == np.float32
    assert flow.confidence.min() >= 0
    assert flow.confidence.max() <= 1
    # the targets of these pixels are in the image
    error = np.linalg.norm(flow.uv - [du, dv], axis=2)[4:-4, 4:-4]
    assert np.median(error) < 0.1


@pytest.mark.parametrize(("gain", "offset"), [(0.6, 60), (0.8, -10)])
def test_dis_survives_a_change_of_exposure(gain: float, offset: float) -> None:
    first, second = shifted(80, 100, 4, -2)
    second = np.clip(second * gain + offset, 0, 255).astype(np.uint8)
    flow = dis_flow(first, second)
    trusted = flow.confidence > 0.5
    assert trusted.mean() > 0.6
    assert np.median(np.linalg.norm(flow.uv - [4, -2], axis=2)[trusted]) < 0.2


@pytest.mark.parametrize("level", [0, 7, 255])
def test_dis_without_contrast(level: int) -> None:
    flat = np.full((40, 50, 3), level, np.uint8)
    for a, b in ((flat, flat), (flat, np.dstack([grey_texture(40, 50)] * 3))):
        flow = dis_flow(a, b)
        assert not flow.uv.any()
        assert not flow.confidence.any()


def test_dis_confidence_drops_where_nothing_matches() -> None:
    first, second = shifted(90, 120, 4, -2)
    second = second.copy()
    second[30:60, 40:80] = np.dstack([grey_texture(30, 40, seed=5)] * 3)
    flow, alike = dis_flow(first, second), dis_flow(first, second, consistency=False)
    assert flow.confidence[35:55, 45:70].mean() < 0.7 * flow.confidence[65:85, 20:100].mean()
    # without consistency, all vectors within the image have the same weight
    np.testing.assert_array_equal(alike.uv, flow.uv)
    assert set(np.unique(alike.confidence)) == {0, 1}
    assert not alike.confidence[:, 118:].any()
    assert alike.confidence[35:55, 45:70].all()


def test_a_consistent_round_trip_gives_confidence() -> None:
    forward = np.zeros((40, 60, 2), np.float32)
    forward[..., 0] = 2.0
    backward = -forward
    backward[:, 30:] = -1.5, 10.0
    error = round_trip_error(forward, backward)
    np.testing.assert_allclose(error[:, :28], 0.0)
    np.testing.assert_allclose(error[:, 28:58], np.hypot(0.5, 10.0))
    # pixels whose flow leaves the image or is unknown have no confidence
    forward[0, 0] = np.nan
    error = round_trip_error(forward, -forward)
    assert np.isinf(error[:, 58:]).all()
    assert np.isinf(error[0, 0])
    confidence = confidence_of(round_trip_error(forward, backward))
    assert confidence[10:30, 5:20].min() == pytest.approx(1.0)
    assert confidence[:, 40:].max() == confidence[0, 0] == 0.0
    # a pixel without backward flow affects its neighbourhood alone
    forward, backward = np.zeros((2, 40, 60, 2), np.float32)
    backward[20, 30] = np.nan
    gap = round_trip_error(forward, backward)
    assert np.isinf(gap[20, 30])
    assert not np.isnan(gap).any()
    assert (confidence_of(gap, support=5) == 1).mean() > 0.98


def test_flows_of_files_and_of_the_truth(tmp_path: Path) -> None:
    uv = np.full((60, 80, 2), [3.0, 1.0])
    uv[1, 2, 0] = np.nan
    pair = pair_of(Truth(flow=uv))
    write_flo(tmp_path / "a.flo", uv)
    write_kitti_flow(tmp_path / "a.png", uv)
    for source in ("truth", str(tmp_path / "a.flo"), str(tmp_path / "a.png")):
        flow = resolve_flow(pair, source)
        assert flow.source == Path(source).name
        assert flow.confidence.sum() == 60 * 80 - 1
        assert flow.confidence[1, 2] == 0
        assert flow.uv[1, 2].tolist() == [0, 0]
        assert flow.uv[0, 0].tolist() == [3, 1]
    assert np.isnan(pair.truth.flow[1, 2, 0])
    write_flo(tmp_path / "small.flo", uv[:4, :5])
    write_flo(tmp_path / "unknown.flo", np.full((4, 5, 2), np.nan))
    for name, match in {
        "small.flo": r"differ in size[\s\S]*\(4, 5[\s\S]*\(60, 80\)",
        "unknown.flo": "every pixel as unknown",
        "other.flo": "flow file is missing",
    }.items():
        with raises(match):
            resolve_flow(pair, str(tmp_path / name))
    for truth in (None, Truth(depth_ref=np.ones((60, 80)))):
        with raises("no true flow"):
            resolve_flow(pair_of(truth), "truth")


def test_a_larger_next_image_is_searched_as_a_whole() -> None:
    noise = np.random.default_rng(1).integers(0, 256, (96, 400, 3), np.uint8)
    wide = cv2.GaussianBlur(noise, (0, 0), 2)
    # what leaves the size of the reference image is still in the next one
    flow = resolve_flow(Pair(wide[:, 100:260], wide[:, 88:300], K, K), "dis")
    assert flow.confidence[:, 150:].mean() > 0.9
    np.testing.assert_allclose(np.median(flow.uv[:, 150:], axis=(0, 1)), [12, 0], atol=0.1)


PLUGINS = SimpleNamespace(
    mine=lambda first, _: Flow(np.full((*first.shape[:2], 2), 3.0, np.float32), source="mine"),
    cropped=lambda first, _: Flow(np.zeros((*first[1:].shape[:2], 2), np.float32)),
    array=lambda first, _: np.full((*first.shape[:2], 2), 3.0),
    nothing=lambda first, _: None,
    broken=lambda first, _: first.weights,
)


def test_a_flow_source_is_an_entry_point(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The recipe of docs/adding.md: an installed package declares the functions above."""
    info = tmp_path / "flows-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: flows\nVersion: 1.0\n")
    points = [f"{name} = {__name__}:PLUGINS.{name}" for name in (*vars(PLUGINS), "absent")]
    (info / "entry_points.txt").write_text("\n".join(["[soup_nlp.flow]", *points]))
    monkeypatch.syspath_prepend(tmp_path)
    assert flow_sources().keys() >= {*vars(PLUGINS), "absent"}
    pair = pair_of()
    for name in ("mine", "array"):
        flow = resolve_flow(pair, name)
        assert flow.source == name
        assert (flow.uv == 3.0).all()
    for name, match in [
        ("cropped", "differ in size"),
        ("nothing", r"flow is no array[\s\S]*where: nothing"),
        ("broken", r"plug-in failed[\s\S]*AttributeError: .*weights"),
        ("absent", r"plug-in failed[\s\S]*AttributeError"),
        ("unheard", r"dis, truth, .*SIGMA, absent, array, broken, cropped, mine, nothing, or the"),
    ]:
        with raises(match):
            resolve_flow(pair, name)


# --- flow under dominant homographies -------------------------------------------------------------


HEIGHT, WIDTH = 200, 360
# the road of a driving camera: displacements grow towards the bottom of the image
ROAD = np.array([[1.0, 0.12, -20.0], [0.0, 1.28, -10.0], [0.0, 1.4e-3, 1.0]])


def truth(H: np.ndarray) -> np.ndarray:
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH].astype(float)
    p = np.stack([u, v, np.ones_like(u)], axis=-1) @ H.T
    return p[..., :2] / p[..., 2:] - np.stack([u, v], axis=-1)


def images(H: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    first = np.ascontiguousarray(np.dstack([grey_texture(HEIGHT, WIDTH, seed=2)] * 3))
    return first, cv2.warpPerspective(first, H, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT)


def match(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Flow of two grey images in both directions."""
    method = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    method.setFinestScale(0)
    return method.calc(first, second, None), method.calc(second, first, None)


def test_a_first_flow_that_is_half_wrong_is_completed(monkeypatch):
    """The first flow is right on the left only; under its homography it is right everywhere."""
    first, second = images(ROAD)
    true = truth(ROAD)
    ref, nxt = first[..., 0], second[..., 0]
    left_half = np.arange(WIDTH)[None, :] < WIDTH // 2
    forward = np.where(left_half[..., None], true, 0.0).astype(np.float32)
    backward = np.full((HEIGHT, WIDTH, 2), 50.0, np.float32)
    back = truth(np.linalg.inv(ROAD))
    backward[:, : WIDTH // 2] = back[:, : WIDTH // 2]

    flow, gap = guided_flow(ref, nxt, match, forward, backward)
    at = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1) + true
    inside = ((at > 8) & (at < [WIDTH - 9, HEIGHT - 9])).all(axis=-1)
    right = inside & ~left_half
    right[:, : WIDTH // 2 + 20] = False
    assert right.sum() > 3000
    error = np.linalg.norm(flow - true, axis=-1)
    assert np.median(error[right]) < 0.2
    assert np.median(confidence_of(gap)[right]) > 0.8
    # pixels whose target is outside the next image are never certain
    outside = ((at < -0.5) | (at > [WIDTH - 0.5, HEIGHT - 0.5])).any(axis=-1)
    assert outside.any()
    assert confidence_of(gap)[outside & ~left_half].max(initial=0.0) < 0.5
    # no homography: the first flow is returned
    monkeypatch.setattr(dis, "PLANES", 0)
    same, _ = guided_flow(ref, nxt, match, forward, backward)
    np.testing.assert_array_equal(same, forward)


@pytest.mark.parametrize(("error", "taken"), [(0.2, False), (0.8, True)])
def test_a_guided_flow_must_be_better_by_a_margin(monkeypatch, error, taken):
    """Images without contrast: only the round trip counts, and it is exact for the new flow."""
    shape = (60, 80)
    grey = np.full(shape, 128, np.uint8)

    def constant(u: float) -> np.ndarray:
        return np.full((*shape, 2), (u, 0.0), np.float32)

    def match(a, b):
        return constant(0.1), constant(-0.1)

    monkeypatch.setattr(dis, "dominant_homographies", lambda *a: [np.eye(3)])
    monkeypatch.setattr(dis, "MARGIN", 0.5)
    first, back = constant(0.0), constant(error)
    flow, gap = guided_flow(grey, grey, match, first, back)
    inside = (slice(20, 40), slice(20, 60))
    np.testing.assert_allclose(flow[inside][..., 0], 0.1 if taken else 0.0, atol=1e-6)
    np.testing.assert_allclose(gap[inside], 0.0 if taken else error, atol=1e-4)


def test_dis_images_of_different_size() -> None:
    first, second = shifted(64, 90, 2, 0)
    flow = dis_flow(first, second[:, :70])
    assert flow.uv.shape == (64, 90, 2)
    assert not flow.confidence[:, 72:].any()
    assert (flow.confidence[10:-10, 10:60] > 0.5).mean() > 0.9


@pytest.mark.slow
@pytest.mark.shared
def test_dis_on_kitti(shared_data: Path) -> None:
    whole = KittiInput(kind="kitti2012", root=str(shared_data / "kitti2012"), index="27").load(Path)
    middle = np.s_[:, 350:-350]
    flow = dis_flow(whole.image_ref[middle], whole.image_next[middle])
    error = np.linalg.norm(flow.uv - whole.truth.flow[middle], axis=2)
    finite = np.isfinite(error)
    assert np.median(error[finite]) < 0.4
    assert (error[finite] > 3).mean() < 0.25
    sure = finite & (flow.confidence > 0.5)
    assert sure.sum() > 0.7 * finite.sum()
    assert (error[sure] > 3).mean() < 0.05
    # the surer the flow, the smaller its error
    surer = np.digitize(flow.confidence, [0.0, 0.25, 0.5, 0.75, 0.9], right=True)
    medians = [np.median(error[finite & (surer == k)]) for k in range(6)]
    assert medians == sorted(medians, reverse=True)


def test_homographies_are_recovered_one_after_the_other():
    left = np.arange(WIDTH) < WIDTH // 3
    shift = np.array([[1.0, 0, 3], [0, 1, -2], [0, 0, 1]])
    flow = np.where(left[None, :, None], truth(shift), truth(ROAD)).astype(np.float32)
    homographies = dominant_homographies(flow, np.ones((HEIGHT, WIDTH), np.float32), 4)
    assert len(homographies) == 2
    for H, true in zip(homographies, (ROAD, shift)):
        np.testing.assert_allclose(H / H[2, 2], true, atol=1e-3, rtol=1e-3)
    assert dominant_homographies(flow, np.zeros((HEIGHT, WIDTH), np.float32), 4) == []
    assert len(dominant_homographies(flow, np.ones((HEIGHT, WIDTH), np.float32), 1)) == 1


@pytest.mark.slow
@pytest.mark.parametrize(("planes", "least", "most"), [(0, 0.0, 0.3), (4, 0.7, 1.0)])
def test_only_homographies_find_large_displacements(planes, least, most, monkeypatch):
    monkeypatch.setattr(dis, "PLANES", planes)
    fast = 2 * ROAD - np.eye(3)
    flow = dis.dis_flow(*images(fast))
    right = np.linalg.norm(flow.uv - truth(fast), axis=-1) < 1
    assert least <= (right & (flow.confidence > 0.5)).mean() <= most
