"""Pictures as people have them: turned by EXIF, flows of other programs with their confidence."""

import json

import cv2
import numpy as np
import pytest
from helpers_files import photo, sets, write_flo, write_pair
from PIL import Image

from soup_nlp.cli.main import main
from soup_nlp.config.problem import make_problem
from soup_nlp.data.pair import Pair
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.errors import ConfigError, DataError

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("simple_starts")]

SIZE = (160, 120)


BACK = {2: 0, 3: 3, 4: 1, 5: 5, 6: 2, 7: 6, 8: 4}
"""The transposition of Pillow that an EXIF orientation takes back."""


@pytest.mark.parametrize("suffix", ["png", "tif"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_photo_is_turned_as_its_exif_says(orientation, suffix, tmp_path):
    image = np.random.default_rng(0).integers(0, 256, (120, 160, 3), np.uint8)
    stored = Image.fromarray(image)
    if orientation in BACK:
        stored = stored.transpose(Image.Transpose(BACK[orientation]))
    for name in "ab":
        path = tmp_path / f"{name}.{suffix}"
        photo(path, np.asarray(stored), orientation, FocalLengthIn35mmFilm=43)
    source = {"kind": "files", "ref": f"a.{suffix}", "next": f"b.{suffix}"}
    pair = make_problem({"input": {**source, "fov": 90}, "base": str(tmp_path)}).load_pair()
    assert (pair.image_ref == image).all()
    assert (pair.image_next == image).all()
    # 90 degrees over the 160 columns that are shown, principal point in the middle of them
    np.testing.assert_allclose(pair.K_ref, [[80, 0, 79.5], [0, 80, 59.5], [0, 0, 1]])
    assert pair.focal_sigma == 0
    in_python = Pair(*(tmp_path / f"{name}.{suffix}" for name in "ab"), fov=90)
    assert (in_python.image_ref == image).all()
    assert (in_python.image_next == image).all()
    # axes of a given camera are unclear
    raw = {"input": {**source, "intrinsics": [200, 200, 79.5, 59.5]}, "base": str(tmp_path)}
    if orientation == 1:
        assert (make_problem(raw).load_pair().image_ref == image).all()
    else:
        with pytest.raises(DataError, match="stored turned"):
            make_problem(raw).load_pair()
        with pytest.raises(DataError, match="stored turned"):
            Pair(image, tmp_path / f"b.{suffix}", pair.K_ref)


@pytest.fixture(scope="module")
def orbit(tmp_path_factory):
    """A rendered pair as files, its flow in both directions, half of it marked unusable."""
    folder, pair = tmp_path_factory.mktemp("orbit"), render_scene("orbit", 0, *SIZE)
    write_pair(folder, pair)
    flow = pair.truth.flow.astype(np.float32)
    write_flo(folder / "forward.flo", flow)
    # wrong on the left by more than the largest error that is tolerated
    back = cv2.calcOpticalFlowFarneback(
        pair.image_next[..., 1], pair.image_ref[..., 1], None, 0.5, 3, 25, 3, 7, 1.5, 0
    )
    back[:, :60] += 30
    write_flo(folder / "backward.flo", back)
    half = np.full(SIZE[::-1], 255, np.uint8)
    half[:60] = 0
    cv2.imwrite(str(folder / "half.png"), half)
    np.save(folder / "half.npy", half / 255)
    return folder


def load_flow(folder, source="forward.flo", **besides):
    images = {"kind": "files", "ref": "a.png", "next": "b.png", "fov": 60}
    flow = {"source": source, **besides}
    problem = make_problem({"input": images, "flow": flow, "base": str(folder)})
    assert {folder / name for name in besides.values()} <= set(problem.input_paths())
    return problem.flow.load(problem.load_pair(), problem.path)


def test_a_backward_flow_or_a_map_is_the_confidence(orbit):
    def confidence(**besides):
        return load_flow(orbit, **besides).confidence

    assert (confidence() == 1).all()
    checked = confidence(backward="backward.flo")
    assert not checked[:, :30].any()
    assert np.median(checked[20:-20, 100:-20]) > 0.5
    for name in ("half.png", "half.npy"):
        assert not confidence(confidence=name)[:60].any()
        assert (confidence(confidence=name)[60:] == 1).all()
    both = confidence(backward="backward.flo", confidence="half.png")
    assert np.array_equal(both[60:], checked[60:])


def test_confidence_that_does_not_fit_is_refused(orbit, tmp_path):
    with pytest.raises(ConfigError, match="file of a flow only"):
        load_flow(orbit, "dis", backward="backward.flo")
    for values, words in (
        (np.ones((3, 3)), "differ in size"),
        (np.full(SIZE[::-1], 2.0), "out of range"),
        (np.zeros(SIZE[::-1]), "0 everywhere"),
    ):
        np.save(tmp_path / "map.npy", values)
        with pytest.raises(DataError, match=words):
            load_flow(orbit, confidence=str(tmp_path / "map.npy"))


def test_two_pictures_are_enough(orbit, tmp_path, capsys):
    pair = [str(orbit / "a.png"), str(orbit / "b.png")]
    flow = ["--flow", str(orbit / "forward.flo"), "--flow-confidence", str(orbit / "half.png")]
    small = ["--superpixels", "12", "--neighbours", "5", "--no-refine", "--json"]
    small += sets("solver.presolve_iterations=1 solver.presolve_eps=[0.3] solver.max_iter=1")
    small += sets("output.page=false")
    assert main(["solve", *pair, *flow, *small, "-o", str(tmp_path / "out")]) in (0, 1)
    told = capsys.readouterr()
    summary = json.loads(told.out)
    assert summary["sizes"]["knn_edges"] > 0
    assert summary["flow"].endswith("50.0% usable)")
    # a line a stage, none an iteration
    assert "1.2 times the longer side" in told.err
    stages = [line.split()[0] for line in told.err.splitlines() if " s  " in f"{line}  "]
    assert [s for s in stages if s in ("load", "flow", "nlp", "files")] == [
        "load", "flow", "nlp", "files",
    ]  # fmt: skip
    assert "majorant 0.3" not in told.err
    assert "majorant 0.3" in (tmp_path / "out" / "log.txt").read_text()
