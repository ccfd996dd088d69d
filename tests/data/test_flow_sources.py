"""Flow sources beside DIS: noise, networks, wrong units, other focal lengths, still layers."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers_files import grey_texture, write_flo

from soup_nlp.config.problem import make_problem
from soup_nlp.data.flow.dis import dis_flow
from soup_nlp.data.flow.layers import without_still_layer
from soup_nlp.data.flow.sources import FlowOptions, flow_from_truth, is_named, resolve_flow
from soup_nlp.data.network import learned_flow
from soup_nlp.data.pair import Flow, Pair
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.data.working_size import at_common_focal, resized_flow, scaled_camera
from soup_nlp.errors import DataError
from soup_nlp.pipeline.case import see_through, with_flow


@pytest.fixture(scope="module")
def pair():
    return render_scene("street", 0, 160, 96)


def test_noise_has_its_size_and_correlation_length(pair):
    true = flow_from_truth(pair)
    flow = resolve_flow(pair, "truth+noise:0.5")
    gap = flow.uv - true.uv
    assert gap.std() == pytest.approx(0.5, rel=0.05)
    near = np.corrcoef(gap[:, :-2, 0].ravel(), gap[:, 2:, 0].ravel())[0, 1]
    far = np.corrcoef(gap[:, :-60, 0].ravel(), gap[:, 60:, 0].ravel())[0, 1]
    assert near > 0.8
    assert abs(far) < 0.4
    assert np.array_equal(resolve_flow(pair, "truth+noise:0").uv, true.uv)
    assert np.array_equal(resolve_flow(pair, "truth+noise:0.5").uv, flow.uv)
    assert np.array_equal(FlowOptions(source="truth+noise:0.5").load(pair, Path).uv, flow.uv)
    with pytest.raises(DataError, match="number of pixels"):
        resolve_flow(pair, "truth+noise:much")
    assert is_named("dis")
    assert not is_named("flow.flo")


@pytest.mark.slow
def test_black_bars_have_no_confidence(pair):
    above, left = 16, 24

    def coded(image):
        frame = cv2.copyMakeBorder(image, above, 8, left, 0, cv2.BORDER_CONSTANT)
        data = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, 50])[1]
        return cv2.imdecode(data, cv2.IMREAD_COLOR)

    frames = coded(pair.image_ref), coded(pair.image_next)
    flow = resolve_flow(Pair(*frames, pair.K_ref, pair.K_next), "dis")
    inside = np.s_[above : 96 + above, left:]
    assert flow.confidence[inside].mean() > 0.5
    bar = np.ones(flow.confidence.shape, bool)
    bar[inside] = False
    assert flow.confidence[bar].max() == 0.0
    # dark in one of the frames only
    night = pair.image_ref.copy()
    night[:30] = 0
    whole = resolve_flow(Pair(night, pair.image_next, pair.K_ref, pair.K_next), "dis")
    assert whole.confidence[:30].max() > 0.0


@pytest.fixture(scope="module")
def onnx():
    pytest.importorskip("onnxruntime", reason="onnxruntime is not installed (extra onnx)")
    return pytest.importorskip("onnx", reason="onnx, which writes the test's network, is missing")


def tiny_network(onnx, path, size=("h", "w"), stacked=False, gain=2.0, word="255", flat=False):
    """A network whose flow is gain x the mean difference of the images, at half their size."""
    from onnx import parser

    height, width = size
    weights = ", ".join([*["-{0}"] * 12, *["{0}"] * 12] * 2).format(f"{gain / 12:.9g}")
    one, two = (f"float[1, {channels}, {height}, {width}]" for channels in (3, 6))
    inputs, join = f"{one} a, {one} b", "x = Concat <axis = 1> (a, b)"
    text = f"""<ir_version: 8, opset_import: ["" : 13], metadata_props: ["input_range" : "{word}"]>
    tiny ({f"{two} x" if stacked else inputs}) => (float{"[1, n]" if flat else "[1, 2, u, v]"} out)
    <float[2, 6, 2, 2] w = {{{weights}}}>
    {{ {"" if stacked else join} flow = Conv <strides = [2, 2]> (x, w)
       out = {"Flatten" if flat else "Identity"} (flow) }}"""
    onnx.save(parser.parse_model(text), str(path))
    return path


@pytest.mark.parametrize("stacked", [False, True])
@pytest.mark.parametrize("size", [("h", "w"), (48, 64)])
def test_onnx_network(onnx, tmp_path, stacked, size):
    first = np.full((90, 130, 3), 100, np.uint8)
    second = np.full((90, 130, 3), 101, np.uint8)
    path = tiny_network(onnx, tmp_path / "tiny.onnx", size, stacked)
    flow = learned_flow(str(path), first, second)
    # a difference of one grey level is two pixels of the images that the network saw
    scale = np.array([1.0, 1.0]) if size[0] == "h" else np.array([130 / 64, 90 / 48])
    np.testing.assert_allclose(flow.uv[20, 20], 2.0 * scale, rtol=1e-4)
    assert flow.uv.shape == (90, 130, 2)
    # the backward flow has the opposite sign: all pixels but those at the edge are consistent
    assert flow.confidence[:72, :112].min() > 0.99
    assert flow.source == "tiny.onnx"


def test_onnx_input_range_and_bad_networks(onnx, tmp_path, pair):
    first, second = (np.full((64, 64, 3), g, np.uint8) for g in (0, 51))
    path = tmp_path / "a.onnx"
    for word, expected in (("unit", 2.0), ("signed", 4.0)):
        tiny_network(onnx, path, word=word, gain=10.0)
        np.testing.assert_allclose(learned_flow(str(path), first, second).uv[5, 5], expected, 1e-4)
    with pytest.raises(DataError, match="two RGB images"):
        learned_flow(str(path), first, second[:32])
    for options, match in (({"word": "percent"}, "input range"), ({"flat": True}, "gives no flow")):
        tiny_network(onnx, path, **options)
        with pytest.raises(DataError, match=match):
            learned_flow(str(path), first, second)
    (tmp_path / "no.onnx").write_bytes(b"not a network")
    for name, match in (("no.onnx", "no network"), ("absent.onnx", "missing")):
        with pytest.raises(DataError, match=match):
            resolve_flow(pair, str(tmp_path / name))
    unknown = learned_flow(str(tiny_network(onnx, path, gain=1e38)), first, second)
    assert (unknown.uv == 0).all()
    assert (unknown.confidence == 0).all()


# --- frames of other focal lengths ---------------------------------------------------------------


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_frames_of_other_focal_lengths_have_a_flow(factor: float) -> None:
    pair = render_scene("orbit", 0, 256, 108)
    size = round(256 * factor), round(108 * factor)
    image = cv2.resize(pair.image_next, size, interpolation=cv2.INTER_AREA)
    K = scaled_camera(pair.K_next, (108, 256), size[::-1])
    # a depth prior has the size of the reference image, which may be reduced
    zoomed = Pair(pair.image_ref, image, pair.K_ref, K, depth_prior=np.ones((108, 256)))
    flow = FlowOptions().load(zoomed, Path)
    equal = FlowOptions().load(pair, Path)
    at = np.stack(np.meshgrid(np.arange(256), np.arange(108)), axis=-1)
    # pixel centres are at whole numbers
    true = (at + pair.truth.flow + 0.5) * np.divide(size, (256, 108)) - 0.5 - at
    use = flow.confidence > 0
    assert use.mean() > 0.9 * (equal.confidence > 0).mean()
    # a third of the resolution costs a third of a pixel at most
    assert np.median(np.linalg.norm(flow.uv - true, axis=2)[use]) < 0.2


def test_flow_of_reduced_frames_is_not_mixed_at_edges() -> None:
    images = [np.zeros((16, 20, 3), np.uint8), np.zeros((8, 10, 3), np.uint8)]
    fine = Pair(images[0], images[1], (20, 20, 9.5, 7.5), (10, 10, 4.5, 3.5))
    near = at_common_focal(fine)
    assert near.size == (8, 10)
    np.testing.assert_allclose(near.K_ref, near.K_next)
    uv = np.zeros((8, 10, 2))
    uv[:, 5:] = 3, -1
    flow = resized_flow(Flow(uv), near, fine)
    at = np.stack(np.meshgrid(np.arange(20), np.arange(16)), axis=-1)
    # displacement in pixels of the next image, which are twice as wide as those of the reference
    shift = at + flow.uv - ((at + 0.5) / 2 - 0.5)
    np.testing.assert_allclose(shift[:, :10], 0, atol=1e-6)
    np.testing.assert_allclose(shift[:, 10:], np.broadcast_to((3, -1), (16, 10, 2)), atol=1e-6)


# --- flow is plausible or refused ----------------------------------------------------------------


def test_flows_that_do_not_fit_name_their_cause(tmp_path: Path) -> None:
    pair = render_scene("orbit", 0, 256, 108)
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


@pytest.mark.slow
def test_a_backward_flow_is_compared_with_the_images_too(tmp_path: Path) -> None:
    pair = render_scene("orbit", 0, 256, 108)
    back = dis_flow(pair.image_next, pair.image_ref).uv
    write_flo(tmp_path / "f.flo", pair.truth.flow)
    options = FlowOptions(source="f.flo", backward="b.flo")
    write_flo(tmp_path / "b.flo", back)
    assert (options.load(pair, lambda name: tmp_path / name).confidence > 0).mean() > 0.7
    for change in (-1.0, 0.5, 1 / 256):
        write_flo(tmp_path / "b.flo", change * back)
        with pytest.raises(DataError, match=r"does not fit the images[\s\S]*b\.flo"):
            options.load(pair, lambda name: tmp_path / name)


# --- a layer that stands still --------------------------------------------------------------------

WIDTH, HEIGHT = 512, 218
BEHIND = np.s_[130:205, 150:400]
"""Part of the image, mostly road, that the static layer covers."""


def given(pair: Pair, still: bool, source: str = "dis") -> Pair:
    """The true flow, but zero with full confidence behind the layer."""
    uv = np.nan_to_num(pair.truth.flow).astype(np.float32)
    sure = np.isfinite(pair.truth.flow).all(axis=2).astype(np.float32)
    if still:
        uv[BEHIND], sure[BEHIND] = 0.0, 1.0
    return pair.with_flow(Flow(uv, sure, source))


def covered(image: np.ndarray) -> np.ndarray:
    """The image with a reflection of more contrast than the road."""
    out = image.astype(float)
    layer = grey_texture(HEIGHT, WIDTH, seed=5)[..., None]
    out[BEHIND] = 0.5 * out[BEHIND] + 0.5 * layer[BEHIND]
    return np.rint(out).astype(np.uint8)


@pytest.fixture(scope="module")
def street() -> Pair:
    return render_scene("street", 0, WIDTH, HEIGHT)


@pytest.fixture(scope="module")
def reflecting(street: Pair) -> Pair:
    images = covered(street.image_ref), covered(street.image_next)
    return replace(street, image_ref=images[0], image_next=images[1])


def test_a_static_layer_is_removed_from_the_images():
    layer, other = (np.dstack([grey_texture(60, 80, seed)] * 3) for seed in (0, 1))
    for image in without_still_layer(layer, layer):
        assert image.std() == 0
    for image, original in zip(without_still_layer(layer, other), (layer, other)):
        # a random derivative shares its sign with another half of the time
        assert 0.5 * original.std() < image.std() < original.std()


@pytest.mark.slow
def test_the_road_moves_behind_a_reflection(reflecting: Pair):
    reflected = given(reflecting, still=True)
    seen = see_through(reflected)
    assert seen.source == "dis"
    true = reflecting.truth.flow[BEHIND]
    error = np.linalg.norm(seen.uv[BEHIND] - true, axis=2)
    moved = np.linalg.norm(true, axis=2) > 4
    sure = seen.confidence[BEHIND] > 0.3
    assert np.mean(moved) > 0.5
    # without the correction, all of these pixels are wrong by more than 4 at full confidence
    assert np.mean(error[moved & sure] < 2.0) > 0.8
    assert np.mean(sure[moved]) > 0.25
    # moving pixels outside the static layer keep their flow
    above = np.s_[20:90, 100:400]
    assert np.mean((seen.uv == reflected.flow.uv)[above]) > 0.95


@pytest.mark.slow
def test_images_without_a_layer_are_left_alone(street: Pair):
    assert see_through(given(street, still=False)) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("source", "options", "searched"),
    [("truth", {}, False), ("dis", {"consistency": False}, False), ("dis", {}, True)],
)
def test_only_computed_flow_is_searched_again(reflecting, monkeypatch, source, options, searched):
    """It is, unless an option disables it; a flow that the pair has is taken as it is."""
    memory = {"input": {"kind": "memory", "hash": "0"}}
    reflected = given(reflecting, still=True, source=source)
    monkeypatch.setattr(FlowOptions, "load", lambda *_: reflected.flow)
    problem = make_problem({**memory, "flow": options})
    loaded = with_flow(problem, reflecting, reflecting)
    assert bool((loaded.flow.uv[BEHIND] == 0).all()) is not searched
    assert with_flow(problem, loaded, loaded) is loaded
