"""What the documents tell to do works: recipes, examples, notebooks."""

import json
import re
import runpy
import shutil
import textwrap
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
import pytest
from pydantic import Field

from soup_nlp.cli.main import main
from soup_nlp.config.problem import Problem
from soup_nlp.data.flow.sources import resolve_flow
from soup_nlp.data.inputs import Input, PairInput, PriorOptions, Resolve
from soup_nlp.data.pair import Pair
from soup_nlp.geometry.camera import intrinsics
from soup_nlp.pipeline.case import prepare
from soup_nlp.report.check import check_folder

pytestmark = pytest.mark.usefixtures("simple_starts")

ROOT = Path(__file__).resolve().parents[1]

# --- the recipes of docs/adding.md -------------------------------------------------------------


class NpzInput(PairInput):
    """Two images and a camera in one .npz file."""

    kind: Literal["npz"]
    """Kind of input."""
    path: str
    """The file."""

    def load(self, path: Resolve) -> Pair:
        """The pair; `path` resolves the names of files."""
        with np.load(path(self.path)) as arrays:
            return Pair(arrays["ref"], arrays["next"], arrays["K"], arrays["K"])


class WiderProblem(Problem):
    """A problem file with one more kind of input."""

    input: Annotated[Input | NpzInput, Field(discriminator="kind")]
    """What to solve, by its kind."""


def test_the_recipe_of_a_term_shows_the_code():
    recipe = (ROOT / "docs" / "adding.md").read_text().split("\n## ")[1]
    source = "".join(path.read_text() for path in (ROOT / "soup_nlp" / "model").glob("*.py"))
    shown = re.findall(r"```python\n(.*?)\n *```", recipe, re.DOTALL)
    assert len(shown) == 5
    for block in map(textwrap.dedent, shown):
        assert block in source or textwrap.indent(block, "    ") in source


@pytest.mark.slow
def test_the_excerpt_of_check_has_the_energies_of_the_export(tmp_path):
    command = re.search(r"^soup-nlp (export orbit .*)$", (ROOT / "README.md").read_text(), re.M)
    assert main(command[1].replace("out/orbit", str(tmp_path)).split()) == 0
    energy = json.loads((tmp_path / "manifest.json").read_text())["exact_energy_at_start"]
    shown = re.search(r"^ +of the solution: (.*)$", (ROOT / "docs" / "using.md").read_text(), re.M)
    words = shown[1].split()
    # a start at the presolve's answer is the solution up to the solver's tolerance
    for name, value in zip(words[::2], map(float, words[1::2]), strict=True):
        assert energy[name] == pytest.approx(value, rel=1e-3), name


@pytest.mark.slow
def test_a_dataset_is_a_section_that_loads_itself(tmp_path):
    rng = np.random.default_rng(0)
    wide = rng.integers(0, 255, (48, 68, 3), dtype=np.uint8)
    np.savez(
        tmp_path / "pair.npz", ref=wide[:, 4:], next=wide[:, :-4], K=intrinsics(60, 60, 31.5, 23.5)
    )
    raw = {
        "input": {"kind": "npz", "path": "pair.npz"},
        "base": str(tmp_path),
        "segmentation": {"superpixels": 12, "neighbours": 4},
    }
    problem = WiderProblem(**raw)
    assert problem.input_paths()[0] == tmp_path / "pair.npz"
    case = prepare(problem)
    assert case.pair.size == (48, 64)
    assert len(case) > 4


@pytest.fixture
def networks(tmp_path, monkeypatch):
    """The networks of docs/networks.py in an empty folder."""
    pytest.importorskip("onnx", reason="no onnx")
    pytest.importorskip("onnxruntime", reason="no onnxruntime")
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(ROOT / "docs/networks.py"))


@pytest.mark.usefixtures("networks")
def test_a_network_is_any_onnx_file():
    rng = np.random.default_rng(0)
    wide = cv2.GaussianBlur(rng.integers(0, 255, (80, 101, 3), dtype=np.uint8), (0, 0), 3)
    pair = Pair(wide[:, 1:], wide[:, :-1], *[intrinsics(90, 90, 50, 40)] * 2)
    flow = resolve_flow(pair, "lk.onnx")
    inside = flow.uv[20:-20, 20:-20]
    # linear in the displacement to first order only
    np.testing.assert_allclose(np.median(inside, axis=(0, 1)), [1, 0], atol=0.1)
    assert np.median(flow.confidence) > 0.9


@pytest.mark.usefixtures("networks")
def test_a_depth_prior_may_be_an_onnx_file():
    image = np.zeros((50, 60, 3), np.uint8)
    pair = Pair(image, image, *[intrinsics(90, 90, 50, 40)] * 2)
    found = PriorOptions(source="ramp.onnx").load(pair, Path).depth_prior
    assert found.shape == (50, 60)
    # lower is nearer
    np.testing.assert_allclose(np.diff(found, axis=0), found[1, 0] - found[0, 0], rtol=1e-3)
    assert found[1, 0] > found[0, 0] > 0


# --- notebooks -----------------------------------------------------------------------------------

NOTEBOOKS = ROOT / "docs/notebooks"


@pytest.fixture
def pyplot():
    """Matplotlib draws into memory; figures are closed afterwards."""
    import matplotlib.pyplot as plt  # takes a second, which fast tests need not wait for

    backend = plt.get_backend()
    plt.switch_backend("Agg")
    yield plt
    plt.close("all")
    plt.switch_backend(backend)


@pytest.mark.slow
def test_a_pair_becomes_pictures(pyplot):
    names = runpy.run_path(str(NOTEBOOKS / "pair_to_pictures.py"))
    assert names["run"].solution.residuals["so3"] < 1e-8
    assert names["score"].mre < 0.15
    assert len(pyplot.get_fignums()) == 1


@pytest.mark.slow
def test_a_file_becomes_depth_by_another_solver(pyplot, monkeypatch):
    # POUNCE need not be here; CasADi's Ipopt is
    which = shutil.which

    def without_pounce(name: str, *rest, **more) -> str | None:
        return None if "pounce" in name else which(name, *rest, **more)

    monkeypatch.setattr("shutil.which", without_pounce)
    names = runpy.run_path(str(NOTEBOOKS / "other_solver.py"))
    result = names["result"]
    assert check_folder(result).ok
    assert (result / "depth_ref.png").stat().st_size > 0
    assert len(pyplot.get_fignums()) == 1
