"""Ctrl-C in every stage of `solve`: message, exit code, and no incomplete folder."""

import json
import os
import shutil
import signal
from pathlib import Path

import pytest
from helpers_files import sets

from soup_nlp.cli import main as cli
from soup_nlp.cli import solve as solve_module
from soup_nlp.config.problem import load_problem
from soup_nlp.data.flow.sources import FlowOptions
from soup_nlp.data.inputs import SceneInput
from soup_nlp.errors import StoppedError
from soup_nlp.pipeline import case as cases
from soup_nlp.pipeline.run import run
from soup_nlp.report import folder as folders
from soup_nlp.storage.folders import SUMS
from soup_nlp.storage.progress import interruptible

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("simple_starts")]

SMALL = sets(
    "input.width=96 input.height=72 flow.source=truth segmentation.superpixels=12"
    " segmentation.neighbours=4 refine.enabled=false solver.presolve_eps=[0.3]"
)


@pytest.fixture(autouse=True)
def heard():
    """Ctrl-C is heard: it is ignored where the tests run in the background of a shell."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def solve(out: Path) -> int:
    return cli.main(["solve", "orbit", "--out", str(out), "-q", *SMALL])


@pytest.fixture(scope="module")
def solved(tmp_path_factory) -> Path:
    """A result folder; to be copied."""
    out = tmp_path_factory.mktemp("solved")
    assert solve(out) == 0
    return out


@pytest.fixture
def earlier(solved, tmp_path) -> Path:
    """A folder that holds a result already."""
    return Path(shutil.copytree(solved, tmp_path / "out"))


def ctrl_c(times: int = 1, number: int = signal.SIGINT) -> None:
    for _ in range(times):
        os.kill(os.getpid(), number)


@pytest.mark.parametrize(
    ("owner", "stage"), [(SceneInput, "load"), (FlowOptions, "load"), (cases, "build_segmentation")]
)
def test_before_a_start_it_ends_at_once(owner, stage, tmp_path, monkeypatch, capfd):
    """Also where a library turns the interrupt into another error."""

    def interrupted(*args, **kwargs):
        try:
            ctrl_c()
        except KeyboardInterrupt:
            if owner is not cases:
                raise
            raise SystemError("error return without exception set") from None
        raise AssertionError("the stage went on")

    monkeypatch.setattr(owner, stage, interrupted)
    assert solve(tmp_path / "out") == 130
    error = capfd.readouterr().err
    assert "interrupt received" in error
    assert "before there was a start" in error
    assert sorted(os.listdir(tmp_path / "out")) == [SUMS, folders.FAILED]
    assert "interrupted" in (tmp_path / "out" / folders.FAILED).read_text()
    # also where a command has no answer to signals of its own
    assert cli.main(["export", "orbit", "-o", str(tmp_path / "export"), *SMALL]) == 130
    assert "bug" not in capfd.readouterr().err


@pytest.mark.parametrize(
    ("words", "owner"),
    [("batch problems/orbit.yaml", "batches.run"), ("chain scene:orbit", "sequence.solve")],
)
def test_an_interrupt_says_what_is_kept(words, owner, tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(f"soup_nlp.{owner}.each", lambda *_, **__: ctrl_c())
    assert cli.main([*words.split(), "-o", str(tmp_path / "out"), "-q", *SMALL[4:]]) == 130
    error = capfd.readouterr().err
    assert "are kept" in error
    assert "the same command goes on" in error
    assert "no result" not in error


LOG = solve_module.options.SolveLog


@pytest.mark.parametrize(
    ("owner", "at", "times", "number"),
    [
        (cases, "propose", 1, signal.SIGINT),
        (cases, "propose", 2, signal.SIGINT),
        (LOG, "iteration", 1, signal.SIGTERM),
        (LOG, "iteration", 2, signal.SIGTERM),
    ],
)
def test_once_there_is_a_start_the_best_iterate_is_written(
    owner, at, times, number, earlier, monkeypatch, capfd
):
    """After one signal; two of them leave the earlier result, with a message."""
    before, original = (earlier / "result.h5").read_bytes(), getattr(owner, at)
    handler = signal.getsignal(number)
    sent = iter([lambda: ctrl_c(times, number)])
    monkeypatch.setattr(owner, at, lambda *args: (next(sent, int)(), original(*args))[1])
    assert solve(earlier) == (1 if times == 1 else 130)
    error = capfd.readouterr().err
    assert "interrupt received" in error
    assert ("no result is written" in error) == (times == 2)
    assert signal.getsignal(number) is handler
    summary = json.loads((earlier / "summary.json").read_text())
    assert (summary["status"] == "Interrupted") == (times == 1)
    energy = {name: terms["total"] for name, terms in summary["energy"].items()}
    # the start itself may be kept, known to rounding
    assert energy["solution"] <= energy["start"] * (1 + 1e-9)
    assert all((earlier / name).is_file() for name in folders.FILES)
    assert ((earlier / "result.h5").read_bytes() == before) == (times == 2)
    assert (earlier / folders.FAILED).is_file() == (times == 2)
    assert cli.main(["check", str(earlier)]) == 0


def test_files_that_are_being_written_are_written(earlier, monkeypatch, capfd):
    original, seen = folders.write_h5, []

    def interrupted(*args):
        seen.append((earlier / "summary.json").exists())
        ctrl_c(3)
        original(*args)

    monkeypatch.setattr(folders, "write_h5", interrupted)
    assert solve(earlier) == 0
    # the earlier result stays until the new one is whole
    assert seen == [True]
    assert all((earlier / name).is_file() for name in folders.FILES)
    assert "files are being written" in capfd.readouterr().err


def test_a_second_signal_while_the_first_is_handled_ends_at_once(monkeypatch):
    guard, calls = interruptible(), []

    def second() -> None:
        calls.append(1)
        assert len(calls) == 1, "the real set would wait for itself"
        guard.handle(signal.SIGINT, None)

    monkeypatch.setattr(guard.event, "set", second)
    with pytest.raises(KeyboardInterrupt):
        guard.handle(signal.SIGINT, None)


def test_a_run_of_python_says_it_too():
    problem = load_problem("orbit", [word for word in SMALL if word != "--set"])
    with interruptible() as stop:
        ctrl_c()
        with pytest.raises(StoppedError, match="load"):
            run(problem, stop=stop)
        with pytest.raises(KeyboardInterrupt):
            ctrl_c()
