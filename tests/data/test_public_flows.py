"""Flow of the kinds on public trackers: between focal lengths, in wrong units, exchanged."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers_files import write_flo, write_kitti_flow

from soup_nlp.data.flow.dis import dis_flow
from soup_nlp.data.flow.sources import FlowOptions, resolve_flow
from soup_nlp.data.formats.images import DataWarning
from soup_nlp.data.formats.map_files import read_flow
from soup_nlp.data.pair import Flow, Pair
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.data.working_size import at_common_focal, resized_flow, scaled_camera
from soup_nlp.errors import DataError

# --- frames of other focal lengths ---------------------------------------------------------------


@pytest.mark.parametrize("factor", [0.5, 2.0, 1 / 3])
def test_frames_of_other_focal_lengths_have_a_flow(factor: float) -> None:
    pair = render_scene("orbit", 0, 256, 108)
    size = round(256 * factor), round(108 * factor)
    image = cv2.resize(pair.image_next, size, interpolation=cv2.INTER_AREA)
    K = scaled_camera(pair.K_next, (108, 256), size[::-1])
    found = FlowOptions().load(Pair(pair.image_ref, image, pair.K_ref, K), Path)
    equal = FlowOptions().load(pair, Path)
    assert pair.truth is not None
    at = np.stack(np.meshgrid(np.arange(256), np.arange(108)), axis=-1)
    # pixel centres are at whole numbers
    true = (at + pair.truth.flow + 0.5) * np.divide(size, (256, 108)) - 0.5 - at
    use = found.confidence > 0
    assert use.mean() > 0.9 * (equal.confidence > 0).mean()
    # a third of the resolution costs a third of a pixel at most
    assert np.median(np.linalg.norm(found.uv - true, axis=2)[use]) < 0.2


def test_flow_of_reduced_frames_is_not_mixed_at_edges() -> None:
    images = [np.zeros((16, 20, 3), np.uint8), np.zeros((8, 10, 3), np.uint8)]
    fine = Pair(images[0], images[1], (20, 20, 9.5, 7.5), (10, 10, 4.5, 3.5))
    near = at_common_focal(fine)
    assert near.size == (8, 10)
    np.testing.assert_allclose(near.K_ref, near.K_next)
    uv = np.zeros((8, 10, 2))
    uv[:, 5:] = 3, -1
    found = resized_flow(Flow(uv), near, fine)
    at = np.stack(np.meshgrid(np.arange(20), np.arange(16)), axis=-1)
    # displacement in pixels of the next image, of which a pixel has two of the reference image
    shift = at + found.uv - ((at + 0.5) / 2 - 0.5)
    np.testing.assert_allclose(shift[:, :10], 0, atol=1e-6)
    np.testing.assert_allclose(shift[:, 10:], np.broadcast_to((3, -1), (16, 10, 2)), atol=1e-6)


def test_focal_lengths_that_the_images_contradict_are_said() -> None:
    pair = render_scene("orbit", 0, 256, 108)
    K = pair.K_next * [[3, 1, 1], [1, 3, 1], [1, 1, 1]]
    with pytest.warns(DataWarning, match="not at their focal lengths.*probably wrong"):
        found = FlowOptions().load(Pair(pair.image_ref, pair.image_next, pair.K_ref, K), Path)
    np.testing.assert_array_equal(found.uv, FlowOptions().load(pair, Path).uv)


# --- flow is plausible or refused ----------------------------------------------------------------


def test_flows_that_do_not_fit_name_their_cause(tmp_path: Path) -> None:
    pair = render_scene("orbit", 0, 256, 108)
    assert pair.truth is not None
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
    write_flo(path, 0 * true)
    with pytest.warns(DataWarning, match="hardly better than no flow"):
        resolve_flow(pair, str(path))
    write_flo(path, true[::2, ::2])
    with pytest.raises(DataError, match="differ in size"):
        resolve_flow(pair, str(path))


@pytest.mark.parametrize("change", [-1.0, 0.5, 1 / 256])
def test_a_backward_flow_is_compared_with_the_images_too(change: float, tmp_path: Path) -> None:
    pair = render_scene("orbit", 0, 256, 108)
    back = dis_flow(pair.image_next, pair.image_ref).uv
    write_flo(tmp_path / "f.flo", pair.truth.flow)  # type: ignore[union-attr]
    options = FlowOptions(source="f.flo", backward="b.flo")
    write_flo(tmp_path / "b.flo", back)
    assert (options.load(pair, lambda name: tmp_path / name).confidence > 0).mean() > 0.7
    write_flo(tmp_path / "b.flo", change * back)
    with pytest.raises(DataError, match=r"does not fit the images[\s\S]*b\.flo"):
        options.load(pair, lambda name: tmp_path / name)


def test_a_kitti_flow_with_exchanged_channels_is_refused(tmp_path: Path) -> None:
    write_kitti_flow(tmp_path / "f.png", np.full((8, 9, 2), [3.0, 1.0]))
    assert read_flow(tmp_path / "f.png")[0, 0].tolist() == [3, 1]
    stored = cv2.imread(str(tmp_path / "f.png"), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(tmp_path / "f.png"), stored[..., ::-1])
    with pytest.raises(DataError, match="channels exchanged"):
        read_flow(tmp_path / "f.png")
