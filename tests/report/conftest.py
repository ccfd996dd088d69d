"""A run that every test of the room uses."""

import pytest

from soup_nlp.config.problem import make_problem
from soup_nlp.pipeline.case import prepare
from soup_nlp.pipeline.record import Run
from soup_nlp.pipeline.run import make_run, skipped


@pytest.fixture(scope="session")
def small_run() -> Run:
    """Sixty superpixels of a rendered room in which two things move by themselves."""
    scene = {"kind": "scene", "scene": "room", "seed": 5, "width": 256, "height": 128}
    case = prepare(make_problem({"input": scene, "segmentation": {"superpixels": 60}}))
    return make_run(case, skipped(case))
