"""Python has what the command line has: cameras, images, progress, scores, stored results."""

from __future__ import annotations

import subprocess
import sys
import warnings

import numpy as np
import pytest

import soup_nlp
from soup_nlp.config.problem import Problem, SegmentationOptions
from soup_nlp.data.formats.cameras import GUESS_SIGMA
from soup_nlp.data.formats.images import DataWarning
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.errors import ConfigError, DataError
from soup_nlp.pipeline.run import ProblemKeys

SMALL = {"superpixels": 12, "neighbours": 4}


@pytest.fixture(scope="module")
def run() -> soup_nlp.Run:
    pair = render_scene("orbit", 0, 96, 72)
    none = {"enabled": False}
    return soup_nlp.solve_pair(pair, segmentation=SMALL, flow={"source": "truth"}, refine=none)


def test_float_and_channels_first_images_are_the_same():
    image = render_scene("orbit", 0, 64, 48).image_ref
    for other in (image / 255.0, (image / 255.0).astype(np.float32), image.transpose(2, 0, 1)):
        pair = soup_nlp.Pair(other, image, (70, 70, 31, 24))
        np.testing.assert_array_equal(pair.image_ref, image)
    with pytest.raises(DataError, match=r"floats from 0 to 1(?s:.*)image / 255"):
        soup_nlp.Pair(image.astype(float), image, (70, 70, 31, 24))


def test_a_camera_is_a_field_of_view_or_guess():
    image = render_scene("orbit", 0, 64, 48).image_ref
    pair = soup_nlp.Pair(image, image, fov=90)
    assert pair.K_ref[0, 0] == pytest.approx(32)
    np.testing.assert_array_equal(pair.K_next, pair.K_ref)
    with pytest.warns(DataWarning, match="no intrinsics; focal length 77 px"):
        pair = soup_nlp.Pair(image, image)
    assert pair.focal_sigma == GUESS_SIGMA
    # a copy keeps it
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        other = pair.with_flow(soup_nlp.Flow(np.zeros((48, 64, 2), np.float32)))
    assert other.K_ref[0, 0] == pytest.approx(1.2 * 64)
    with pytest.raises(DataError, match="two cameras"):
        soup_nlp.Pair(image, image, (70, 70, 31, 24), fov=90)


def test_flow_of_a_batch_says_how_to_take_it_out():
    with pytest.raises(DataError, match=r"\(1, 2, 48, 64\)(?s:.*)flow\[0\]"):
        soup_nlp.Flow(np.zeros((1, 2, 48, 64)))


def test_truth_of_float32_is_no_warning():
    truth = soup_nlp.Truth(depth_ref=np.ones((4, 5), np.float32))
    assert truth.depth_ref.dtype == np.float64


def test_options_may_be_records_and_progress_is_reported(capsys):
    pair, seen = render_scene("orbit", 0, 64, 48), []
    options = {"segmentation": SegmentationOptions(**SMALL), "refine": {"enabled": False}}
    run = soup_nlp.solve_pair(pair, progress=seen.append, **options)
    assert len(run.segmentation) == 12
    assert {p.stage for p in seen} >= {"constrained NLP"}
    soup_nlp.solve_pair(pair, progress=True, **options)
    assert "evaluation" in capsys.readouterr().err


def test_editors_know_every_key_of_a_problem():
    assert set(ProblemKeys.__annotations__) == set(Problem.model_fields) - {"base", "input", "name"}


@pytest.mark.parametrize(
    ("key", "said"),
    [("sead", "did you mean seed"), ("input", "follows from the pair"), ("name", "follows from")],
)
def test_a_key_that_solve_pair_does_not_take_is_refused(key, said):
    with pytest.raises(ConfigError, match=said):
        soup_nlp.solve_pair(render_scene("orbit", 0, 64, 48), **{key: {}})


def test_depth_is_scored_from_run_array_or_stored_result(run, tmp_path):
    truth = run.pair.truth.depth_ref
    run.save(tmp_path / "out")
    stored = soup_nlp.load(tmp_path / "out")
    for result in (run, run.reconstruction.depth_ref, stored, tmp_path / "out"):
        scores = soup_nlp.evaluate(result, truth)
        assert scores["solution"].mre == pytest.approx(run.metrics["solution"].mre, rel=1e-12)
    assert soup_nlp.evaluate(run, truth.astype(np.float32)).keys() == {
        "solution", "start", "rigid", "constant",
    }  # fmt: skip
    with pytest.raises(DataError, match="depth is no map"):
        soup_nlp.evaluate(None, truth)
    with pytest.raises(DataError, match="differ in size"):
        soup_nlp.evaluate(run, truth[1:])


def test_a_stored_result_has_the_arrays_of_its_run(run, tmp_path):
    run.save(tmp_path / "out")
    stored = soup_nlp.load(str(tmp_path / "out"))
    for name in ("depth_ref", "depth_next", "points_next", "sigma_ref"):
        computed, loaded = (getattr(x.reconstruction, name) for x in (run, stored))
        np.testing.assert_allclose(loaded, computed, rtol=1e-9)
    np.testing.assert_allclose(stored.camera.matrix, run.camera.matrix, atol=1e-12)
    assert stored.metrics["solution"] == run.metrics["solution"]
    assert stored.summary["converged"] == run.solution.converged
    for shown in (run._repr_html_(), stored._repr_html_()):
        assert shown.startswith("<pre>")
        assert 'alt="overview"' in shown
    with pytest.raises(DataError, match="result file is missing"):
        soup_nlp.load(tmp_path)


def test_heavy_packages_of_pictures_are_imported_on_use():
    code = "import sys, soup_nlp.cli.solve; print([m for m in NAMES if m in sys.modules])"
    code = code.replace("NAMES", "('matplotlib', 'trimesh', 'pandas', 'skimage.segmentation')")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
