"""The check tolerates rounding of an energy that should be zero."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from soup_nlp.config.problem import dump_problem
from soup_nlp.data.pair import Flow, Pair
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.geometry.camera import pixel_grid, project, rays
from soup_nlp.pipeline.record import Run
from soup_nlp.pipeline.run import solve_pair
from soup_nlp.report.check import check_folder
from soup_nlp.report.folder import prepare_folder, write_folder

pytestmark = pytest.mark.slow

# the flow is exact, and the images show nothing that contradicts it
OPTIONS = {"segmentation": {"superpixels": 50, "neighbours": 8}, "refine": {"photo": 0.0}}


def one_plane() -> Pair:
    """A plane and a motion with an exact flow, so that E is zero up to rounding."""
    shot = render_scene("orbit", 0, 320, 160)
    uv = pixel_grid(*shot.size)
    ray = rays(shot.K_ref, uv)
    points = (2.0 / (ray @ [-0.1, -0.2, 0.97]))[..., None] * ray
    turn = cv2.Rodrigues(np.array([0.01, 0.02, -0.005]))[0]
    flow = project(shot.K_next, points @ turn.T + [0.2, 0.02, 0.1]) - uv
    sure = np.ones(shot.size, np.float32)
    grey = np.full_like(shot.image_ref, 128)
    return Pair(grey, grey, shot.K_ref, shot.K_next, Flow(flow, sure, "exact"))


@pytest.fixture(scope="module")
def run() -> Run:
    # a slanted plane has relief, which E_prior charges
    return solve_pair(one_plane(), energy={"weights": {"prior": 0.0}}, **OPTIONS)


def test_an_energy_of_rounding_size_passes_the_check(run, tmp_path):
    write_folder(prepare_folder(tmp_path), run, dump_problem(run.problem), "")
    assert run.energy["total"] < 1e-9
    assert [row.name for row in check_folder(tmp_path).rows if not row.ok] == []
    path = tmp_path / "summary.json"
    claims = json.loads(Path(path).read_text())
    # 1e-7 is far below a pixel, but no rounding of coordinates up to 320
    for off, expected in ((3e-11, []), (1e-7, ["energy solution proj"])):
        claims["energy"]["solution"]["proj"] += off
        path.write_text(json.dumps(claims))
        wrong = [row.name for row in check_folder(tmp_path).rows if not row.ok]
        # whatever is changed in the file differs from its copy in result.h5
        assert [name for name in wrong if name != "entries of summary.json"] == expected
