"""The printed verdict: what was found comes first, what concerns the solver only on request."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from soup_nlp.evaluation.confidence import MOST_SIGMA
from soup_nlp.pipeline.record import FullSize
from soup_nlp.report import findings
from soup_nlp.report.verdict import exit_code
from soup_nlp.start.camera_error import CameraError
from soup_nlp.start.regions import FIXED, SCENE


def seen(run, confidence=None, focal=0.0, camera=None):
    """A run with another confidence of the flow, an unsure focal length, an error of the camera."""
    flow = run.pair.flow
    flow = flow if confidence is None else replace(flow, confidence=confidence)
    errors = {camera: CameraError(camera, 0.1, 0.01, 9.0)} if camera else {}
    evidence = replace(run.confidence.evidence, errors=errors)
    pair = replace(run.pair, flow=flow, focal_sigma=focal)
    return replace(run, pair=pair, confidence=replace(run.confidence, evidence=evidence))


def unsure(run, sigma=1.2, **start):
    """A run with another start whose depth is drawn where sigma (H, W) or a number is large."""
    sure = run.confidence
    sigma = np.broadcast_to(sigma, sure.sigma.shape).astype(float)
    kind = np.where(sigma > MOST_SIGMA, 2, 0).astype(np.uint8)
    sure = replace(sure, sigma=sigma, kind=kind)
    return replace(run, confidence=sure, start=replace(run.start, **start))


def without_parallax(run):
    """A run whose flow a turn alone explains as well."""
    return replace(run, start=replace(run.start, parallax=np.zeros(len(run))))


def told(run):
    """The line of hints, or "" for none."""
    return "".join(findings.hints(run))


def test_hints_name_what_would_help(small_run):
    start, labels = small_run.start, small_run.segmentation.labels
    sure = unsure(small_run, 0.05)
    assert told(sure) == ""
    flat = without_parallax(small_run)
    assert "moves aside" in told(unsure(flat))
    assert told(unsure(flat, 0.05)) == ""
    tenth = np.where(np.arange(labels.size).reshape(labels.shape) < labels.size // 10, 1.2, 0.05)
    assert "frames farther apart in time" in told(unsure(flat, tenth))
    same = replace(small_run.pair, flow=replace(small_run.pair.flow, uv=0 * small_run.pair.flow.uv))
    for run, says in ((unsure(small_run), True), (sure, False)):
        assert ("these two are nearly the same" in told(replace(run, pair=same))) == says
    assert "moves aside" in told(unsure(small_run, 0.05, at_rest=True))
    moving = (start.component != SCENE)[labels]
    assert "--depth-prior" in told(unsure(small_run, np.where(moving, 1.2, 0.05)))
    whole = np.ones_like(start.unexplained)
    assert "--depth-prior" in told(unsure(small_run, tenth, unexplained=whole))
    assert "a watermark" in told(unsure(small_run, origin=np.full_like(start.origin, FIXED)))
    assert "--fov" not in told(seen(unsure(small_run), focal=0.1))
    assert "--fov" in told(seen(unsure(small_run), focal=0.3))
    blind = seen(sure, np.zeros_like(small_run.pair.flow.confidence))
    assert told(blind) == "a better flow (--flow)"


def test_proposed_intrinsics_are_those_of_the_images_as_given(small_run):
    wrong = seen(small_run, camera="focal length")
    height, width = small_run.pair.size
    twice = FullSize(np.ones((2 * height, 2 * width)), np.ones((1, 1)), None)
    focal = []
    for run in (wrong, replace(wrong, full=twice)):
        (told,) = findings.hints(run)
        fx, fy = map(float, re.search(r"--intrinsics ([\d.]+),([\d.]+)", told).groups())
        assert fx == fy
        focal.append(fx)
    assert focal[0] == pytest.approx(small_run.pair.K_ref[0, 0] * np.exp(0.1), rel=1e-3)
    assert focal[1] == pytest.approx(2 * focal[0], rel=1e-3)


def test_frames_without_a_common_scene_are_told_nothing_else(small_run):
    """Where hardly any flow is usable, its parallax, camera and motion are no evidence."""
    few = np.zeros_like(small_run.pair.flow.confidence)
    few[:5] = 1.0
    nothing = without_parallax(unsure(small_run))
    for camera in (None, "zoom between the frames"):
        found = told(seen(nothing, few, 0.4, camera))
        assert found.endswith("closer in time: hardly anything is in both")
    assert "moves aside" in told(seen(nothing, np.ones_like(few)))
    for confidence, expected in ((few, True), (np.ones_like(few), False)):
        camera = findings.found_words(seen(nothing, confidence))[0]
        assert camera.endswith("(hardly any flow is usable)") == expected


@pytest.mark.parametrize(
    ("changes", "code", "part"),
    [
        ({}, 0, "solved"),
        ({"status": "Interrupted", "solved": False}, 1, "interrupted"),
        ({"status": "Time_Limit", "solved": False}, 1, "did not converge (Time_Limit)"),
        ({"drawn": 0.51}, 1, "51% of the image is drawn: nothing tells its depth"),
        ({"mre": 0.3}, 1, "above the expected 0.2"),
    ],
)
def test_the_exit_code_has_a_reason(changes, code, part, monkeypatch):
    outcome = {"status": "Solve_Succeeded", "solved": True, "drawn": 0.1, "mre": 0.1} | changes
    shares = {"measured": 0.0, "inferred": 0.0, "drawn": outcome["drawn"], "median_sigma": 0.1}
    monkeypatch.setattr("soup_nlp.report.verdict.certainty", lambda run: shares)
    expected = SimpleNamespace(mre_at_most=0.2)
    fake = SimpleNamespace(
        refined=None,
        solution=SimpleNamespace(status=outcome["status"]),
        solved=outcome["solved"],
        good=outcome["solved"] and outcome["drawn"] <= 0.5,
        metrics={"solution": SimpleNamespace(mre=outcome["mre"])},
        problem=SimpleNamespace(expected=expected),
    )
    result = exit_code(fake, 0.2)
    assert result[0] == code
    assert part in result[1]


def test_a_wrong_camera_may_look_like_motion(small_run):
    told = findings.found_words(seen(small_run, camera="lens distortion"))
    words = "the flow suggests an error of lens distortion, which may look like such motion"
    assert [line for line in told if line not in findings.found_words(small_run)] == [words]
    moving = [k for k, line in enumerate(told) if "moves by itself" in line]
    assert told.index(words) > moving[-1]
