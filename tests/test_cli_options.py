"""Options of `solve` that go, or do not go, with a problem file."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from soup_nlp.cli import main
from soup_nlp.data.formats import write_flo
from soup_nlp.data.scenes import render_scene

ORBIT = str(Path(__file__).parent.parent / "problems" / "orbit.yaml")
SMALL = [
    "--set", "input.width=160", "--set", "input.height=120", "--set", "refine.enabled=false",
    "--set", "segmentation.superpixels=30", "--set", "segmentation.neighbours=5",
    "--set", "solver.presolve_iterations=10", "--set", "solver.max_iter=2",
]  # fmt: skip


@pytest.mark.parametrize(
    "option", [("--depth", "truth.npy"), ("--intrinsics-next", "1,1,0,0"), ("--ref", "a.png")]
)
def test_options_of_a_pair_do_not_go_with_a_problem_file(option, tmp_path, capsys):
    assert main(["solve", ORBIT, "--out", str(tmp_path / "out"), *option]) == 2
    error = capsys.readouterr().err
    assert option[0] in error
    assert not (tmp_path / "out").exists()


def test_a_flow_goes_with_a_problem_file(tmp_path, monkeypatch):
    flow = render_scene("orbit", 0, 160, 120).truth.flow.astype(np.float32)
    write_flo(tmp_path / "own flow.flo", flow)
    monkeypatch.chdir(tmp_path)
    args = ["solve", ORBIT, "--out", "out", "-q", "--flow", "own flow.flo", *SMALL]
    assert main(args) in (0, 1)
    assert "own flow.flo" in json.loads((tmp_path / "out" / "summary.json").read_text())["flow"]
