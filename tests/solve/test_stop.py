"""A run that is stopped at any iteration, by any way, has a whole result."""

import os
import signal
import time
from collections import Counter
from functools import cache

import numpy as np
import pytest

import soup_nlp
from soup_nlp.config.problem import Problem, load_problem
from soup_nlp.report.folder import WritableRun
from soup_nlp.storage.progress import Progress, interruptible

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("simple_starts")]

SMALL = (
    "input.width=64 input.height=48 flow.source=truth segmentation.superpixels=10"
    " segmentation.neighbours=3 solver.presolve_iterations=2"
    " solver.presolve_eps=[0.3] refine.particles=4"
)


@cache
def problem() -> Problem:
    return load_problem("orbit", SMALL.split())


@cache
def iterations() -> tuple[str, ...]:
    """Stage of every iteration of the run that nothing stops."""
    seen: list[str] = []
    soup_nlp.run(problem(), listener=lambda p: seen.append(p.stage))
    return tuple(seen)


def stopped(way: str, last: int, monkeypatch) -> tuple[WritableRun, list[str]]:
    """The run that is stopped at an iteration, and the stages of its iterations."""
    clock, late, seen = time.process_time, 0.0, list[str]()

    def listen(progress: Progress) -> None:
        nonlocal late
        seen.append(progress.stage)
        if len(seen) > last and way == "time":
            # from here on, every iteration takes longer than any limit
            late += 1e9
        elif len(seen) == last + 1:
            # both set the event
            os.kill(os.getpid(), (signal.SIGINT, signal.SIGTERM)[last % 2])

    with interruptible() as event, monkeypatch.context() as patch:
        patch.setattr(time, "process_time", lambda: clock() + late)
        return soup_nlp.run(problem(), listener=listen, stop=event), seen


@pytest.mark.parametrize("way", ["signal", "time"])
def test_a_stop_at_every_iteration_leaves_a_result(way, monkeypatch):
    stages = {"majorant 0.3", "Gauss-Newton 0.9", "exact", "constrained NLP", "refine 1"}
    assert stages <= set(iterations())
    for last, stage in enumerate(iterations()):
        done, seen = stopped(way, last, monkeypatch)
        s, where = done.solution, f"iteration {last}, {stage}"
        # later stages begin, see the stop, and end
        assert max(Counter(seen[last + 1 :]).values(), default=0) <= 2, where
        if way != "time" and not stage.startswith("refine"):
            assert s.status == "Interrupted", where
        assert s.energy["total"] <= s.energy_start["total"] * (1 + 1e-9), where
        assert done.constraints.within(), where
        assert np.isfinite(done.reconstruction.depth_ref).any(), where
