"""Flow sources beside DIS: noise, networks."""

from __future__ import annotations

import numpy as np
import pytest

from soup_nlp.config.problem import make_problem
from soup_nlp.data.flow.consistency import checked_flow
from soup_nlp.data.flow.learned import learned_flow
from soup_nlp.data.flow.sources import add_noise, flow_from_truth, is_named, resolve_flow
from soup_nlp.data.pair import Flow
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.errors import DataError


@pytest.fixture(scope="module")
def pair():
    return render_scene("street", 0, 160, 96)


def error(flow: Flow, pair) -> np.ndarray:
    return np.linalg.norm(flow.uv - pair.truth.flow, axis=2)


def test_checked_flow_trusts_what_the_way_back_confirms():
    forward = np.zeros((40, 60, 2), np.float32)
    forward[..., 0] = 2.0
    backward = -forward
    backward[:, 30:, 1] = 10.0
    flow = checked_flow(forward, backward, "x")
    assert flow.confidence[10:30, 5:20].min() == pytest.approx(1.0)
    assert flow.confidence[:, 40:].max() == 0.0
    # what leaves the image has no confidence
    assert checked_flow(forward, -forward, "x").confidence[:, 58:].max() == 0.0
    forward[3, 3] = np.nan
    assert np.isfinite(checked_flow(forward, backward, "x").uv).all()


def test_noise_has_its_size_and_correlation_length(pair):
    true = flow_from_truth(pair)
    flow = add_noise(true, 0.5)
    gap = flow.uv - true.uv
    assert gap.std() == pytest.approx(0.5, rel=0.05)
    near = np.corrcoef(gap[:, :-2, 0].ravel(), gap[:, 2:, 0].ravel())[0, 1]
    far = np.corrcoef(gap[:, :-60, 0].ravel(), gap[:, 60:, 0].ravel())[0, 1]
    assert near > 0.8
    assert abs(far) < 0.4
    white = add_noise(true, 0.5, correlation=0.0).uv - true.uv
    assert abs(np.corrcoef(white[:, :-2, 0].ravel(), white[:, 2:, 0].ravel())[0, 1]) < 0.1
    assert np.array_equal(add_noise(true, 0.0).uv, true.uv)
    assert np.array_equal(add_noise(true, 1.0).uv, add_noise(true, 1.0).uv)


def test_a_problem_can_ask_for_noise(pair):
    raw = {"input": {"kind": "scene", "scene": "street", "width": 160, "height": 96}}
    for level in ("0.5", "1"):
        problem = make_problem({**raw, "flow": {"source": f"truth+noise:{level}"}})
        assert error(problem.flow.load(pair, problem.path), pair).mean() > 0.5 * float(level)
    with pytest.raises(DataError, match="number of pixels"):
        resolve_flow(pair, "truth+noise:much")
    assert is_named("dis")
    assert not is_named("flow.flo")


@pytest.fixture(scope="module")
def onnx():
    pytest.importorskip("onnxruntime", reason="onnxruntime is not installed (extra onnx)")
    return pytest.importorskip("onnx", reason="onnx, which writes the test's network, is missing")


def tiny_network(onnx, path, size=(None, None), stacked=False, gain=2.0, word=None, flows=1):
    """A network whose flow is gain x the mean difference of the images, at half their size."""
    from onnx import TensorProto, helper

    def image(name, channels):
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, channels, *size])

    kernel = np.zeros((2, 6, 2, 2), np.float32)
    kernel[:, :3], kernel[:, 3:] = -gain / 12, gain / 12
    weights = helper.make_tensor("w", TensorProto.FLOAT, kernel.shape, kernel.ravel())
    nodes = [helper.make_node("Conv", ["x", "w"], ["flow"], strides=[2, 2])]
    inputs = [image("x", 6)]
    if not stacked:
        nodes.insert(0, helper.make_node("Concat", ["a", "b"], ["x"], axis=1))
        inputs = [image("a", 3), image("b", 3)]
    out = [helper.make_tensor_value_info("flow", TensorProto.FLOAT, [1, 2, None, None])]
    if flows == 0:
        nodes.append(helper.make_node("Flatten", ["flow"], ["flat"]))
        out = [helper.make_tensor_value_info("flat", TensorProto.FLOAT, [1, None])]
    graph = helper.make_graph(nodes, "tiny", inputs, out, [weights])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    if word:
        entry = model.metadata_props.add()
        entry.key, entry.value = "input_range", word
    onnx.save(model, str(path))
    return path


@pytest.mark.parametrize("stacked", [False, True])
@pytest.mark.parametrize("size", [(None, None), (48, 64)])
def test_onnx_network(onnx, tmp_path, stacked, size):
    first = np.full((90, 130, 3), 100, np.uint8)
    second = np.full((90, 130, 3), 101, np.uint8)
    path = tiny_network(onnx, tmp_path / "tiny.onnx", size, stacked)
    flow = learned_flow(str(path), first, second)
    # a difference of one grey level is two pixels of the images that the network saw
    scale = np.array([1.0, 1.0]) if size[0] is None else np.array([130 / 64, 90 / 48])
    np.testing.assert_allclose(flow.uv[20, 20], 2.0 * scale, rtol=1e-4)
    assert flow.uv.shape == (90, 130, 2)
    # the way back has the opposite sign: all but the edge is consistent
    assert flow.confidence[:72, :112].min() > 0.99
    assert flow.source == "tiny.onnx"


def test_onnx_input_range_and_bad_networks(onnx, tmp_path, pair):
    first, second = (np.full((64, 64, 3), g, np.uint8) for g in (0, 51))
    unit = tiny_network(onnx, tmp_path / "unit.onnx", word="unit", gain=10.0)
    np.testing.assert_allclose(learned_flow(str(unit), first, second).uv[5, 5], 2.0, rtol=1e-4)
    signed = tiny_network(onnx, tmp_path / "signed.onnx", word="signed", gain=10.0)
    np.testing.assert_allclose(learned_flow(str(signed), first, second).uv[5, 5], 4.0, rtol=1e-4)
    for name, options, match in [
        ("word", {"word": "percent"}, "input range"),
        ("flat", {"flows": 0}, "gives no flow"),
    ]:
        path = tiny_network(onnx, tmp_path / f"{name}.onnx", **options)
        with pytest.raises(DataError, match=match):
            learned_flow(str(path), first, second)
    (tmp_path / "no.onnx").write_bytes(b"not a network")
    with pytest.raises(DataError, match="no network"):
        resolve_flow(pair, str(tmp_path / "no.onnx"))
    with pytest.raises(DataError, match="missing"):
        resolve_flow(pair, str(tmp_path / "absent.onnx"))
    with pytest.raises(DataError, match="two RGB images"):
        learned_flow(str(unit), first, second[:32])
