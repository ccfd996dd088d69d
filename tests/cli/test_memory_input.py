"""Pairs in memory: the problem of a run holds a hash of the pair and cannot be solved again."""

from __future__ import annotations

import json
import pickle
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from matplotlib.image import imread

from soup_nlp.cli.main import main
from soup_nlp.config.problem import load_problem
from soup_nlp.data.inputs import pair_hash
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.errors import ConfigError
from soup_nlp.pipeline.record import Run
from soup_nlp.report.check import check_folder
from soup_nlp.report.folder import solve_pair

pytestmark = pytest.mark.slow

SMALL = {
    "segmentation": {"superpixels": 30, "neighbours": 5},
    "flow": {"source": "truth"},
    "refine": {"enabled": False},
}


@pytest.fixture(scope="module")
def run() -> Run:
    return solve_pair(render_scene("orbit", 0, 128, 96), **SMALL)


@pytest.fixture(scope="module")
def saved(run, tmp_path_factory) -> tuple[Path, list[str]]:
    """The folder that the run makes of itself, and the names of its files."""
    out = tmp_path_factory.mktemp("saved") / "out"
    return out, run.save(out, formats=["npy", "motions"])


def test_the_hash_is_that_of_the_pair(run):
    pair = render_scene("orbit", 0, 128, 96)
    assert run.problem.input.kind == "memory"
    assert run.problem.input.hash == pair_hash(pair)
    turned = replace(pair, image_next=np.ascontiguousarray(pair.image_next[::-1]))
    longer = replace(pair, K_next=pair.K_next * [[1.1], [1], [1]])
    assert len({pair_hash(p) for p in (pair, turned, longer, run.pair)}) == 4
    assert pair_hash(replace(pair, name="other", truth=None)) == pair_hash(pair)


def test_its_config_cannot_be_solved_again(run, saved, tmp_path, capsys):
    out, _ = saved
    problem = load_problem(out / "config.yaml")
    assert problem.digest() == run.problem.digest()
    with pytest.raises(ConfigError, match="in memory"):
        problem.load_pair()
    assert main(["solve", str(out / "config.yaml"), "--out", str(tmp_path / "new")]) == 2
    assert run.problem.input.hash in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_a_run_survives_a_pickle(run):
    again = pickle.loads(pickle.dumps(run))
    assert again.problem == run.problem
    assert again.energy == run.energy
    np.testing.assert_array_equal(again.reconstruction.depth_ref, run.reconstruction.depth_ref)


def test_arrays_of_truth_and_history_are_described(run, saved):
    with h5py.File(saved[0] / "result.h5") as file:
        stored = file["truth/scene_flow"]
        np.testing.assert_array_equal(stored[:], run.pair.truth.scene_flow)
        assert stored.attrs["units"] == run.pair.truth.unit
        for name, stage in file["iterations"].items():
            assert "barrier" in stage["mu"].attrs["description"], name
            assert "inertia" in stage["regularization_size"].attrs["description"], name


def test_a_run_prints_itself_in_five_lines(run):
    lines = repr(run).splitlines()
    assert len(lines) == 5
    assert max(map(len, lines)) <= 110
    assert f"MRE {run.metrics['solution'].mre:.4f}" in repr(run)
    records = run.pair, run.segmentation, run.start, run.solution, run.soup, run.reconstruction
    for record in (*records, run.components, run.camera, run.data):
        assert len(repr(record)) < 300, type(record)


def test_a_run_saves_itself_and_is_converted(run, saved, tmp_path, capsys):
    out, other = shutil.copytree(saved[0], tmp_path / "out"), tmp_path / "other"
    files = saved[1]
    assert set(files) >= {"result.h5", "points_ref.ply", "motions.json", "depth_ref.npy"}
    assert all((out / name).exists() for name in files)
    assert check_folder(out).ok
    assert main(["convert", str(out), "--to", "npy,motions, glb,colmap", "-o", str(other)]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert f"{other / 'mesh_next.glb'}" in printed
    # the folder has the data of the run
    for name in ("motions.json", "trajectory.tum", "depth_ref.npy", "depth_next.npy"):
        assert (other / name).read_bytes() == (out / name).read_bytes(), name
    told = json.loads((out / "motions.json").read_text())
    np.testing.assert_array_equal(told["camera"]["next_from_ref"], run.camera.matrix)
    assert main(["convert", str(out), "--to", "colmap"]) == 0
    assert (out / "colmap" / "sparse" / "0" / "points3D.txt").is_file()


def test_a_run_plots_its_overview(run, saved, tmp_path):
    run.plot().save(tmp_path / "a.png")
    shown, written = imread(tmp_path / "a.png"), imread(saved[0] / "overview.png")
    np.testing.assert_array_equal(shown[..., :3], written[..., :3])


def test_what_cannot_be_converted_is_refused(saved, tmp_path, capsys):
    out, foreign = shutil.copytree(saved[0], tmp_path / "out"), tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "mesh_ref.glb").write_text("mine")
    for arguments, said in (
        ([str(out), "--to", "glb", "--out", str(foreign)], "files"),
        ([str(out), "--to", "obj"], "unknown format"),
        ([str(out), "--to", ","], "no format"),
        ([str(out), "--to", ""], "an argument is empty"),
        ([str(foreign), "--to", "glb"], "result"),
    ):
        assert main(["convert", *arguments]) == 2
        assert said in capsys.readouterr().err
    assert (foreign / "mesh_ref.glb").read_text() == "mine"
    with h5py.File(out / "result.h5", "a") as file:
        del file["input/image_ref"]
    assert main(["convert", str(out), "--to", "glb"]) == 2
    assert "input/image_ref" in capsys.readouterr().err
