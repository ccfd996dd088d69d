"""The commands and programs of the README and of the guides run as printed, from top to bottom.

Every page starts in an empty folder with the files that a reader brings. Only sizes differ: what a
command solves has few superpixels and small images.
"""

import re
import shlex
import shutil
import subprocess
import sys
import webbrowser
from pathlib import Path

import numpy as np
import pytest
from helpers_files import write_pair

from benchmarks import __main__ as benchmarks
from soup_nlp.cli.main import main
from soup_nlp.config.problem import Problem
from soup_nlp.data.scenes.catalogue import render_scene

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("simple_starts")]

ROOT = Path(__file__).resolve().parents[1]
BLOCK = re.compile(r"^```(sh|python)\n(.*?)^```", re.MULTILINE | re.DOTALL)
PAGES = [
    "README.md",
    *(f"docs/{name}.md" for name in ("using", "python", "networks", "depth_prior", "family")),
]
INSTALLATION = {"pip", "make"}
"""Programs of an installation, which `.ci/run` uses."""
SOLVES = {"solve", "demo", "chain"}
"""Commands that write their result and end with 1 where most of a small image is drawn."""


def small(tree):
    """The sections of a problem file with small sizes."""
    segmentation = {**tree.get("segmentation", {})}
    segmentation["superpixels"] = min(segmentation.get("superpixels", 30), 30)
    sizes = {"max_size": 0.01, "segmentation": segmentation}
    if isinstance(tree.get("input"), dict) and tree["input"].get("kind") == "scene":
        sizes["input"] = {**tree["input"], "width": 128, "height": 64}
    return {**tree, **sizes}


@pytest.fixture
def reader(tmp_path, monkeypatch):
    """An empty folder with the reader's own files."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(webbrowser, "open", lambda address: True)
    (tmp_path / "clip").mkdir()
    for frame in (1, 0):
        pair = render_scene("orbit", width=128, height=64, frame=frame)
        write_pair(tmp_path / "clip", pair, [f"{frame}", f"{frame + 1}"])
    np.save("prior.npy", pair.truth.depth_ref)
    for name, frame in (("a", 0), ("b", 1)):
        shutil.copy(tmp_path / "clip" / f"{frame}.png", tmp_path / f"{name}.png")


def run_line(words):
    """Run one command line; returns its exit code."""
    if words[0] == "soup-nlp":
        return main(words[1:])
    if words[:3] == ["python", "-m", "benchmarks"]:
        return benchmarks.main(words[3:])
    if words[0] == "python":
        return subprocess.run([sys.executable, ROOT / words[1]], check=False).returncode
    beside = str(Path(sys.executable).parent)
    program = shutil.which(words[0], path=beside) or shutil.which(words[0])
    if program is None:
        pytest.skip(f"no {words[0]}")
    return subprocess.run([program, *words[1:]], check=False).returncode


@pytest.mark.usefixtures("reader", "one_process")
@pytest.mark.parametrize("page", PAGES)
def test_a_page_runs_as_printed(page, monkeypatch):
    # the instances of the family are small, and come from records of their size
    if page != "docs/family.md":
        validate = Problem.model_validate
        monkeypatch.setattr(Problem, "model_validate", lambda tree: validate(small(tree)))
    if page == "docs/networks.md":
        for package in ("onnx", "onnxruntime"):
            pytest.importorskip(package, reason=f"no {package}")
    names = {}
    for language, block in BLOCK.findall((ROOT / page).read_text(encoding="utf-8")):
        if language == "python":
            exec(block, names)
            continue
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if words and words[0] not in INSTALLATION:
                assert run_line(words) <= (len(words) > 1 and words[1] in SOLVES), line
