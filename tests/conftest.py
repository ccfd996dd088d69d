"""What every test file shares."""

import gc
from functools import lru_cache
from pathlib import Path

import pytest
from hypothesis import settings

from soup_nlp.config.problem import make_problem
from soup_nlp.data import inputs
from soup_nlp.data.scenes import catalogue
from soup_nlp.pipeline.case import prepare
from soup_nlp.pipeline.record import Case, Run
from soup_nlp.pipeline.run import make_run, skipped

# drawn cases are the same in every run, without a time limit on a busy machine
settings.register_profile("fixed", derandomize=True, deadline=None)
settings.load_profile("fixed")

SHARED_DATA = Path(__file__).resolve().parents[1] / ".." / "shared" / "data"


# a scene that many tests want is rendered once: test files import this function later
inputs.render_scene = catalogue.render_scene = lru_cache(maxsize=32)(catalogue.render_scene)


def pytest_collection_finish() -> None:
    """Modules and test items live to the end: the collector need not visit them again."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the real pairs; tests that use it carry `pytest.mark.shared`."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"the real pairs are not here: no folder {SHARED_DATA.resolve()}")
    return SHARED_DATA.resolve()


@lru_cache
def room(seed: int) -> Case:
    """Sixty superpixels of a rendered room."""
    scene = {"kind": "scene", "scene": "room", "seed": seed, "width": 256, "height": 128}
    return prepare(make_problem({"input": scene, "segmentation": {"superpixels": 60}}))


@pytest.fixture(scope="session")
def small_room() -> Case:
    """A room in which something moves by itself."""
    return room(3)


@pytest.fixture(scope="session")
def small_run(small_room: Case) -> Run:
    """The start of that room as a run: every record is there, nothing was solved."""
    return make_run(small_room, skipped(small_room))
