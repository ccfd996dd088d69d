"""Pictures as people have them: no intrinsics, flows of other programs with their confidence."""

from __future__ import annotations

import json
import warnings

import cv2
import numpy as np
import pytest
from helpers_files import write_flo
from PIL import ExifTags, Image

from soup_nlp.cli.main import main
from soup_nlp.config.problem import make_problem
from soup_nlp.data.formats.cameras import GUESS, GUESS_SIGMA, estimated_cameras
from soup_nlp.data.formats.images import DataWarning, read_image
from soup_nlp.data.formats.map_files import read_flow
from soup_nlp.data.pair import Pair
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.errors import ConfigError, DataError

pytestmark = pytest.mark.slow

SIZE = (160, 120)


def camera_of(path, fov=None):
    return estimated_cameras([path], [read_image(path, turn=True)], fov)[0][0]


def picture(path, tags=None):
    image = Image.new("RGB", SIZE)
    exif = image.getexif()
    exif.get_ifd(ExifTags.IFD.Exif).update(tags or {})
    image.save(path, exif=exif)
    return path


@pytest.mark.parametrize(
    ("tags", "focal"),
    [
        ({ExifTags.Base.FocalLengthIn35mmFilm: 43}, 43 / 36 * 160),
        # 5 mm of a sensor of 8 mm, stored ten times as large
        (
            {
                ExifTags.Base.FocalLength: 5.0,
                ExifTags.Base.FocalPlaneXResolution: 2000.0,
                ExifTags.Base.FocalPlaneResolutionUnit: 3,
                ExifTags.Base.ExifImageWidth: 1600,
            },
            100.0,
        ),
        ({ExifTags.Base.FocalLength: 5.0}, GUESS * 160),
        ({}, GUESS * 160),
    ],
)
def test_focal_length_comes_from_exif_or_a_stated_guess(tags, focal, tmp_path):
    path = picture(tmp_path / "a.jpg", tags)
    said = "EXIF" if focal != GUESS * 160 else "1.2 times the longer side.*--fov"
    with pytest.warns(DataWarning, match=said):
        K = camera_of(path)
    with pytest.warns(DataWarning, match=said):
        pair = Pair(path, path)
    assert pair.focal_sigma == (0.0 if "EXIF" in said else GUESS_SIGMA)
    assert K[0, 0] == pytest.approx(focal)
    assert K[1, 1] == K[0, 0]
    assert K[:2, 2].tolist() == [79.5, 59.5]


def test_a_field_of_view_is_taken_without_a_word(tmp_path):
    path = picture(tmp_path / "a.jpg", {ExifTags.Base.FocalLengthIn35mmFilm: 43})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert camera_of(path, 90.0)[0, 0] == pytest.approx(80.0)
    with pytest.raises(ConfigError, match="0 to 180"):
        camera_of(path, 180.0)


def stored_turned(path, image, orientation):
    """A file that viewers show as `image` because its EXIF orientation turns it back."""
    back = {1: None, 2: 0, 3: 3, 4: 1, 5: 5, 6: 2, 7: 6, 8: 4}[orientation]
    stored = Image.fromarray(image)
    stored = stored if back is None else stored.transpose(Image.Transpose(back))
    exif = stored.getexif()
    exif[ExifTags.Base.Orientation] = orientation
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 43
    stored.save(path, exif=exif)


@pytest.mark.parametrize("suffix", ["png", "tif"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_photo_is_turned_as_its_exif_says(orientation, suffix, tmp_path):
    image = np.random.default_rng(0).integers(0, 256, (120, 160, 3), np.uint8)
    for name in "ab":
        stored_turned(tmp_path / f"{name}.{suffix}", image, orientation)
    source = {"kind": "files", "ref": f"a.{suffix}", "next": f"b.{suffix}"}
    pair = make_problem({"input": {**source, "fov": 90}, "base": str(tmp_path)}).load_pair()
    assert (pair.image_ref == image).all()
    assert (pair.image_next == image).all()
    # 90 degrees over the 160 columns that are shown, principal point in the middle of them
    np.testing.assert_allclose(pair.K_ref, [[80, 0, 79.5], [0, 80, 59.5], [0, 0, 1]])
    assert pair.focal_sigma == 0
    # axes of a given camera are unclear
    given = {"input": {**source, "intrinsics": [200, 200, 79.5, 59.5]}, "base": str(tmp_path)}
    if orientation == 1:
        assert (make_problem(given).load_pair().image_ref == image).all()
    else:
        with pytest.raises(DataError, match="stored turned"):
            make_problem(given).load_pair()


def test_a_turned_photo_has_the_focal_length_as_shown(tmp_path):
    image = np.zeros((160, 120, 3), np.uint8)
    stored_turned(tmp_path / "a.jpg", image, 6)
    with pytest.warns(DataWarning, match="EXIF"):
        K = camera_of(tmp_path / "a.jpg")
    f = 43 / 36 * 160
    np.testing.assert_allclose(K, [[f, 0, 59.5], [0, f, 79.5], [0, 0, 1]])


@pytest.fixture(scope="module")
def orbit(tmp_path_factory):
    """A rendered pair as files, its flow in both directions, half of it marked unusable."""
    folder, pair = tmp_path_factory.mktemp("orbit"), render_scene("orbit", 0, *SIZE)
    for name, image in (("a", pair.image_ref), ("b", pair.image_next)):
        cv2.imwrite(str(folder / f"{name}.png"), image[..., ::-1])
    flow = pair.truth.flow.astype(np.float32)
    write_flo(folder / "forward.flo", flow)
    np.save(folder / "turned.npy", flow.transpose(2, 0, 1))
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


def problem(folder, **flow):
    source = {"kind": "files", "ref": "a.png", "next": "b.png", "fov": 60}
    return make_problem({"input": source, "flow": flow, "base": str(folder)})


def test_a_flow_with_two_planes_first_is_turned(orbit):
    assert (read_flow(orbit / "turned.npy") == read_flow(orbit / "forward.flo")).all()


def test_a_backward_flow_or_a_map_is_the_confidence(orbit):
    pair = problem(orbit).load_pair()

    def confidence(**besides):
        own = problem(orbit, source="forward.flo", **besides)
        assert set(besides.values()) <= {p.name for p in own.input_paths()}
        return own.flow.load(pair, own.path).confidence

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
    pair = problem(orbit).load_pair()

    def load(**flow):
        own = problem(orbit, **flow)
        return own.flow.load(pair, own.path)

    with pytest.raises(ConfigError, match="file of a flow only"):
        load(source="dis", backward="backward.flo")
    np.save(tmp_path / "small.npy", np.ones((3, 3)))
    np.save(tmp_path / "large.npy", np.full(SIZE[::-1], 2.0))
    np.save(tmp_path / "none.npy", np.zeros(SIZE[::-1]))
    for name, words in (
        ("small", "differ in size"),
        ("large", "out of range"),
        ("none", "0 everywhere"),
    ):
        with pytest.raises(DataError, match=words):
            load(source="forward.flo", confidence=str(tmp_path / f"{name}.npy"))


def test_two_pictures_are_enough(orbit, tmp_path, capsys):
    pair = ["--ref", str(orbit / "a.png"), "--next", str(orbit / "b.png")]
    flow = ["--flow", str(orbit / "forward.flo"), "--flow-confidence", str(orbit / "half.png")]
    small = ["--superpixels", "30", "--neighbours", "5", "--no-refine", "--json"]
    small += ["--set", "solver.presolve_iterations=5", "--set", "solver.max_iter=2"]
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
