"""Python has what the command line has: cameras, images, progress, scores, stored results."""

import pickle
import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from PIL.Image import open as open_image

import soup_nlp
from soup_nlp.cli.main import main
from soup_nlp.config.problem import Problem, SegmentationOptions, load_problem
from soup_nlp.data.formats.cameras import GUESS_SIGMA
from soup_nlp.data.formats.images import DataWarning
from soup_nlp.data.inputs import pair_hash
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.errors import ConfigError, DataError
from soup_nlp.pipeline.run import ProblemKeys
from soup_nlp.report.check import check_folder

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("simple_starts")]

SMALL = {"superpixels": 12, "neighbours": 4}


@pytest.fixture(scope="module")
def run() -> soup_nlp.Run:
    pair = render_scene("orbit", 0, 96, 72)
    options = {"segmentation": SMALL, "flow": {"source": "truth"}, "refine": {"enabled": False}}
    short = {"presolve_eps": [0.3], "presolve_iterations": 3, "max_iter": 2}
    return soup_nlp.solve_pair(pair, **options, solver=short)


@pytest.fixture(scope="module")
def saved(run, tmp_path_factory) -> tuple[Path, list[str]]:
    """The folder that the run makes of itself, and the names of its files."""
    out = tmp_path_factory.mktemp("saved") / "out"
    return out, run.save(out, formats=["npy", "tum"])


def test_flow_of_a_batch_says_how_to_take_it_out():
    with pytest.raises(DataError, match=r"\(1, 2, 48, 64\)(?s:.*)flow\[0\]"):
        soup_nlp.Flow(np.zeros((1, 2, 48, 64)))


def test_editors_know_every_key_of_a_problem():
    assert set(ProblemKeys.__annotations__) == set(Problem.model_fields) - {"base", "input", "name"}


def test_options_raise_the_errors_of_the_program():
    with pytest.raises(soup_nlp.SoupError, match="did you mean superpixels"):
        SegmentationOptions(superpixel=80)
    with pytest.raises(ConfigError, match="value does not fit"):
        SegmentationOptions(superpixels="many")


@pytest.mark.parametrize(
    ("key", "said"),
    [("sead", "did you mean seed"), ("input", "follows from the images"), ("name", "follows from")],
)
def test_a_key_that_solve_pair_does_not_take_is_refused(key, said):
    with pytest.raises(ConfigError, match=said):
        soup_nlp.solve_pair(render_scene("orbit", 0, 64, 48), **{key: {}})


def test_depth_is_scored_from_run_array_or_stored_result(run, saved):
    truth = run.pair.truth.depth_ref
    stored = soup_nlp.load(saved[0])
    for result in (run, run.reconstruction.depth_ref, stored, saved[0]):
        scores = soup_nlp.evaluate(result, truth)
        assert scores["solution"].mre == pytest.approx(run.metrics["solution"].mre, rel=1e-12)
    assert soup_nlp.evaluate(run, truth.astype(np.float32)).keys() == {
        "solution", "start", "rigid", "constant",
    }  # fmt: skip
    assert soup_nlp.evaluate(run, truth / 3 + 1, scale="affine")["solution"].rmse == pytest.approx(
        soup_nlp.evaluate(run, truth, scale="affine")["solution"].rmse / 3
    )
    assert "<img" in stored._repr_html_()
    overview = np.asarray(open_image(saved[0] / "overview.png"))
    np.testing.assert_array_equal(run.plot(), overview)
    assert (np.asarray(stored.plot()) == overview).mean() > 0.99
    with pytest.raises(DataError, match="depth is no array of its kind"):
        soup_nlp.evaluate(None, truth)
    with pytest.raises(DataError, match="differ in size"):
        soup_nlp.evaluate(run, truth[1:])


def test_a_stored_result_has_the_arrays_of_its_run(run, saved, tmp_path):
    stored = soup_nlp.load(str(saved[0]))
    for name in ("depth_ref", "depth_next", "points_next", "sigma_ref"):
        computed, loaded = (getattr(x.reconstruction, name) for x in (run, stored))
        np.testing.assert_allclose(loaded, computed, rtol=1e-9)
    np.testing.assert_allclose(stored.camera.matrix, run.camera.matrix, atol=1e-12)
    assert stored.metrics["solution"] == run.metrics["solution"]
    assert stored.summary["converged"] == run.solution.converged
    shown = run._repr_html_()
    assert shown.startswith("<pre>")
    assert 'alt="overview"' in shown
    with pytest.raises(DataError, match="result file is missing"):
        soup_nlp.load(tmp_path)


# --- a pair in memory: its problem holds a hash of it and cannot be solved again


def test_the_hash_is_that_of_the_pair(run):
    pair = render_scene("orbit", 0, 96, 72)
    assert run.problem.input.kind == "memory"
    assert run.problem.input.hash == pair_hash(pair)
    turned = replace(pair, image_next=np.ascontiguousarray(pair.image_next[::-1]))
    longer = replace(pair, K_next=pair.K_next * [[1.1], [1], [1]])
    assert len({pair_hash(p) for p in (pair, turned, longer, run.pair)}) == 4
    assert pair_hash(replace(pair, name="other", truth=None)) == pair_hash(pair)


def test_its_config_cannot_be_solved_again(run, saved, tmp_path, refused):
    config = saved[0] / "config.yaml"
    assert load_problem(config).digest() == run.problem.digest()
    said = refused("solve", config, "--out", tmp_path / "new")
    assert "in memory" in said
    assert run.problem.input.hash in said
    assert not (tmp_path / "new").exists()


def test_a_run_survives_a_pickle(run):
    again = pickle.loads(pickle.dumps(run))
    assert again.problem == run.problem
    assert again.energy == run.energy
    np.testing.assert_array_equal(again.reconstruction.depth_ref, run.reconstruction.depth_ref)


def test_a_run_saves_itself_and_is_converted(run, saved, tmp_path, capsys):
    out, other = shutil.copytree(saved[0], tmp_path / "out"), tmp_path / "other"
    files = saved[1]
    assert set(files) >= {"result.h5", "points_ref.ply", "trajectory.tum", "depth_ref.npy"}
    assert all((out / name).exists() for name in files)
    assert check_folder(out).ok
    assert main(["convert", str(out), "--to", "npy,tum, glb,colmap", "-o", str(other)]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert f"{other / 'mesh_next.glb'}" in printed
    # the folder has the data of the run
    for name in ("trajectory.tum", "depth_ref.npy", "depth_next.npy"):
        assert (other / name).read_bytes() == (out / name).read_bytes(), name
    position = np.loadtxt(out / "trajectory.tum")[1, 1:4]
    np.testing.assert_allclose(position, run.camera.centre, atol=1e-8)
    note = out / "colmap" / "notes.txt"
    note.parent.mkdir()
    note.write_text("mine")
    assert main(["convert", str(out), "--to", "colmap"]) == 0
    assert note.read_text() == "mine"
    assert (out / "colmap" / "sparse" / "0" / "points3D.txt").is_file()


def test_what_cannot_be_converted_is_refused(saved, tmp_path, refused):
    out, foreign = shutil.copytree(saved[0], tmp_path / "out"), tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "mesh_ref.glb").write_text("mine")
    (out / "depth_ref.npy").write_text("mine")
    (out / "points_ref.ply").write_text("mine")
    for arguments, said in (
        ([out, "--to", "glb", "--out", foreign], "files"),
        ([out, "--to", "npy"], "files"),
        ([out, "--to", "ply"], "files"),
        ([out, "--to", "obj"], "unknown format"),
        ([out, "--to", ","], "unknown format, or none"),
        ([out, "--to", ""], "an argument is empty"),
        ([foreign, "--to", "glb"], "result"),
    ):
        assert said in refused("convert", *arguments)
    for kept in (foreign / "mesh_ref.glb", out / "depth_ref.npy", out / "points_ref.ply"):
        assert kept.read_text() == "mine"
    with h5py.File(out / "result.h5", "a") as file:
        del file["input/image_ref"]
    assert "input/image_ref" in refused("convert", out, "--to", "glb")


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
