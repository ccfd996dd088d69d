"""The check recomputes the depth of the next frame."""

from __future__ import annotations

from dataclasses import replace

import h5py
import numpy as np
import pytest

from soup_nlp.config.problem import dump_problem
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.evaluate import recompute
from soup_nlp.geometry.soup import Soup, reconstruct
from soup_nlp.pipeline.record import Run
from soup_nlp.pipeline.run import solve_pair
from soup_nlp.report.check import check_folder
from soup_nlp.report.folder import prepare_folder, write_folder

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def run() -> Run:
    """Moving components, which cause occlusions and, with an approaching camera, gaps."""
    return solve_pair(
        render_scene("street", 0, 192, 128),
        segmentation={"superpixels": 60, "neighbours": 6},
        flow={"source": "truth"},
        refine={"enabled": False},
    )


def test_the_recomputed_depth_is_that_of_the_reconstruction(run):
    pair, labels = run.pair, run.segmentation.labels
    for size in ((128, 192), (100, 150)):
        z, doubt = recompute.next_depth_map(vars(run.soup), labels, pair.K_ref, pair.K_next, size)
        own = reconstruct(run.soup, labels, pair.K_ref, pair.K_next, size).depth_next
        np.testing.assert_allclose(z[~doubt], own[~doubt], rtol=1e-9)
        assert doubt.mean() < 0.01
        # both steps of the rule are at work
        assert 0 < np.isnan(own).mean() < 0.5


@pytest.mark.parametrize("shift", [0.5, 1.0])
def test_targets_on_a_pixel_border_are_left_out(run, shift):
    """With a shift of half a pixel every target may be rounded either way, else none."""
    labels, K = np.zeros((20, 30), np.int32), np.diag([25.0, 25.0, 1.0])
    one = Soup(
        np.ones(1), np.array([[0, 0, -1.0]]), np.ones(1), np.eye(3)[None],
        np.array([[shift / 25, 0, 0]]),
    )  # fmt: skip
    z, doubt = recompute.next_depth_map(vars(one), labels, K, K, (20, 30))
    own = reconstruct(one, labels, K, K).depth_next
    np.testing.assert_allclose(z[~doubt], own[~doubt], rtol=1e-9)
    assert doubt[:, 2:-2].all() == (shift == 0.5)
    assert not doubt[:, 2:].any() or shift == 0.5


def test_a_changed_depth_map_fails_the_check(run, tmp_path):
    write_folder(prepare_folder(tmp_path), run, dump_problem(run.problem), "")
    assert check_folder(tmp_path).ok
    for change in (1 + 1e-6, np.nan):
        with h5py.File(tmp_path / "result.h5", "a") as file:
            kept = file["depth/next"][:]
            # a NaN or two may be a matter of rounding, a block is not
            file["depth/next"][60:70, 60:90] = kept[60:70, 60:90] * change
        bad = [row.name for row in check_folder(tmp_path).rows if not row.ok]
        assert "depth map next" in bad
        with h5py.File(tmp_path / "result.h5", "a") as file:
            file["depth/next"][...] = kept
    assert check_folder(tmp_path).ok


def test_a_mirrored_depth_map_fails_the_check(run, tmp_path):
    moved = replace(run.reconstruction, depth_next=run.reconstruction.depth_next[:, ::-1])
    write_folder(
        prepare_folder(tmp_path), replace(run, reconstruction=moved), dump_problem(run.problem), ""
    )
    assert any(row.name == "depth map next" and not row.ok for row in check_folder(tmp_path).rows)
