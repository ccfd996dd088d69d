"""What every test file shares."""

import gc
import hashlib
import pickle
import re
from collections.abc import Callable, Iterator
from functools import lru_cache, wraps
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

import benchmarks.everyday  # noqa: F401, makes its scenes known
from soup_nlp.cli.main import main
from soup_nlp.config.problem import make_problem
from soup_nlp.data import inputs
from soup_nlp.data.flow import sources
from soup_nlp.data.scenes import catalogue
from soup_nlp.evaluation import confidence, evidence
from soup_nlp.pipeline import case as pipeline_case
from soup_nlp.pipeline.case import prepare
from soup_nlp.pipeline.record import Case, Run
from soup_nlp.pipeline.run import make_run, skipped
from soup_nlp.start import camera_error
from soup_nlp.storage import each as jobs

# drawn cases are the same in every run, without a time limit on a busy machine
settings.register_profile("fixed", derandomize=True, deadline=None, max_examples=40)
settings.load_profile("fixed")

SHARED_DATA = Path(__file__).resolve().parents[1] / ".." / "shared" / "data"


def once(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, computed once for the same arguments; every call gets a copy of the result."""
    known: dict[bytes, bytes] = {}

    @wraps(function)
    def call(*arguments: Any, **options: Any) -> Any:
        key = hashlib.sha256(pickle.dumps((arguments, options))).digest()
        if key not in known:
            known[key] = pickle.dumps(function(*arguments, **options))
        return pickle.loads(known[key])

    return call


# what many tests want is computed once: test files import these functions later. Tests of the
# flow, of the start and of the evidence itself call the modules where they are defined
inputs.render_scene = catalogue.render_scene = lru_cache(maxsize=128)(catalogue.render_scene)
sources.dis_flow, pipeline_case.propose = once(sources.dis_flow), once(pipeline_case.propose)
pipeline_case.segment = once(pipeline_case.segment)
pipeline_case.follow_flow = once(pipeline_case.follow_flow)
confidence.evidence, evidence.camera_errors = map(
    once, (evidence.evidence, camera_error.camera_errors)
)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Files of slow tests alone are not even imported where slow tests are left out."""
    if config.option.markexpr == "not slow" and collection_path.suffix == ".py":
        text = collection_path.read_text(encoding="utf-8")
        return True if re.search(r"^pytestmark = \[?\s*pytest\.mark\.slow", text, re.M) else None
    return None


SLOWEST = (
    *("test_walkthrough", "test_bending", "test_batches", "test_sequence", "test_family"),
    *("test_recipes", "test_given_depth", "test_evidence", "test_odd_inputs", "test_compare"),
    *("test_no_parallax", "test_solve", "test_stop", "test_scenes", "test_symbolic"),
)
ORDER = {name: number for number, name in enumerate(SLOWEST)}


def pytest_configure(config: pytest.Config) -> None:
    """Several workers take files in their order here, not those of many tests first."""
    config.option.loadscopereorder = False


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The slowest files come first, so that no worker has one left at the end."""
    items.sort(key=lambda item: ORDER.get(item.path.stem, len(ORDER)))


def pytest_collection_finish() -> None:
    """Modules and test items live to the end: the collector need not visit them again.

    It runs less often than by default, since kernels' instructions are many tuples without cycles.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 10, 5)


@lru_cache
def room(seed: int) -> Case:
    """Sixty superpixels of a rendered room."""
    scene = {"kind": "scene", "scene": "room", "seed": seed, "width": 256, "height": 128}
    return prepare(make_problem({"input": scene, "segmentation": {"superpixels": 60}}))


@pytest.fixture(scope="session")
def small_room() -> Case:
    """A room in which something moves by itself."""
    return room(0)


@pytest.fixture(scope="session")
def small_run(small_room: Case) -> Run:
    """The start of that room as a run: every record is there, nothing was solved."""
    return make_run(small_room, skipped(small_room))


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run a command line, which must end with code 2; returns its message."""

    def run(*words: object) -> str:
        capsys.readouterr()
        assert main([*map(str, words)]) == 2
        return capsys.readouterr().err

    return run


@pytest.fixture(scope="module")
def simple_starts() -> Iterator[None]:
    """One start of a pair, and one kind of error of its camera, in the tests of a module.

    For what is done with results, whose time is mostly that of the starts.
    """
    kind = "zoom between the frames"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline_case, "STARTS", 1)
        patch.setattr(camera_error, "ERROR_KINDS", {kind: camera_error.ERROR_KINDS[kind]})
        # not what is known of all kinds
        patch.setattr(evidence, "camera_errors", once(camera_error.camera_errors))
        patch.setattr(confidence, "evidence", once(evidence.evidence))
        yield


@pytest.fixture
def one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Jobs run in this process and without limits, as a new one takes seconds to begin."""
    monkeypatch.setattr(jobs, "_in_processes", lambda works, *_: jobs.each(works))
    monkeypatch.setattr("soup_nlp.export.compare.limit_process", lambda *_: None)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the real pairs; tests that use it carry `pytest.mark.shared`."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"the real pairs are not here: no folder {SHARED_DATA.resolve()}")
    return SHARED_DATA.resolve()
