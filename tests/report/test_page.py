"""report.html: its contents, and that any result folder can make it."""

import base64
import json
import re
import shutil
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

from soup_nlp.cli.main import main
from soup_nlp.geometry.camera import pixel_grid, rays
from soup_nlp.geometry.rotation import exp
from soup_nlp.geometry.soup import reconstruct
from soup_nlp.geometry.surface import whole_cells
from soup_nlp.report.chain import Chain
from soup_nlp.report.findings import drawn_line
from soup_nlp.report.folder import write_folder
from soup_nlp.report.page import MODES, make_pair, page
from soup_nlp.report.pictures import pictures
from soup_nlp.report.result import result_of
from soup_nlp.report.verdict import summary


@pytest.fixture(scope="module")
def small_run(small_run):
    """The run with detail."""
    rec, pair = small_run.reconstruction, small_run.pair
    # as the page rounds it
    detail = np.round(0.05 * np.sin(pixel_grid(*pair.size)[..., 0]), 3)
    fine = reconstruct(rec.soup, rec.labels, pair.K_ref, pair.K_next, detail=detail)
    return replace(small_run, reconstruction=replace(fine, sigma_ref=rec.sigma_ref))


@pytest.fixture(scope="module")
def shown(small_run):
    return result_of(small_run, {**summary(small_run), "verdict": ["status  <fine> & dandy"]})


@pytest.fixture(scope="module")
def text(shown):
    return page(Chain.of(shown))


def data_of(text):
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    return json.loads(found[1])


def unpack(packed, kind, shape):
    return np.frombuffer(zlib.decompress(base64.b64decode(packed)), kind).reshape(shape)


@pytest.fixture(scope="module")
def written(small_run, tmp_path_factory):
    """A result folder."""
    out = tmp_path_factory.mktemp("written")
    write_folder(out, small_run, "log\n")
    return out


@pytest.fixture
def folder(written, tmp_path):
    """A copy of it."""
    return Path(shutil.copytree(written, tmp_path / "result"))


@pytest.mark.slow
def test_the_page_is_one_file_that_fetches_nothing(text):
    addresses = set(re.findall(r'(?:src|href)="([^"]{0,20})', text))
    assert addresses
    assert all(address.startswith("data:") for address in addresses)
    # the only address is a name of the drawing library, which nobody fetches
    assert set(re.findall(r"https?://[^\s\"'`)]+", text)) == {"http://www.w3.org/1999/xhtml"}
    assert not re.search(
        r"\bimport\s*\(|\bfetch\(|XMLHttpRequest\(|url\(", text.split("</style>")[0]
    )
    assert "Three.js Authors" in text
    assert text.count("<script") == text.count("</script>") == 3
    assert len(text) < 2e6
    assert "status  &lt;fine&gt; &amp; dandy" in text
    assert [name for name, _ in data_of(text)["modes"]] == list(MODES)
    assert [*data_of(text)["pairs"][0]["pictures"]][:5] == [
        "image_ref", "image_next", "superpixels", "components", "flow",
    ]  # fmt: skip
    assert re.search(r"full colour = [\d.]+ px", text)


def test_planes_and_motions_rebuild_both_frames(text, small_run):
    """The data of the page reproduce the reconstruction."""
    data, run = data_of(text), small_run
    s, pose_next = data["pairs"][0], np.array(data["cameras"][0][1])
    scale, n = run.metrics["solution"].scale, len(run.soup)
    labels = unpack(s["labels"], "<u2", run.segmentation.labels.shape)
    np.testing.assert_array_equal(labels, run.segmentation.labels)
    np.testing.assert_allclose(pose_next[:3, 3], scale * run.camera.centre, rtol=1e-9)
    planes = unpack(s["planes"], "<f4", (n, 3)).astype(float)
    ray = rays(np.array(s["K"]), pixel_grid(*labels.shape))
    detail = unpack(s["detail"], "<i2", labels.shape) / 1000
    points = ray * (np.exp(detail) / np.einsum("hwc,hwc->hw", planes[labels], ray))[..., None]
    # single precision, about 1e-7, grows where a plane is seen at a small angle
    np.testing.assert_allclose(points[..., 2], scale * run.reconstruction.depth_ref, rtol=1e-4)
    for name, pose in (("motionCamera", np.eye(4)), ("motion", pose_next)):
        w, pivot, shift = (
            unpack(s[name], "<f4", (n, 9))
            .astype(float)
            .reshape(n, 3, 3)[labels]
            .transpose(2, 0, 1, 3)
        )
        moved = np.einsum("hwij,hwj->hwi", exp(w), points - pivot) + pivot + shift
        want = scale * run.reconstruction.points_next @ pose[:3, :3].T + pose[:3, 3]
        far = np.linalg.norm(want, axis=-1, keepdims=True)
        np.testing.assert_allclose(moved / far, want / far, atol=1e-4)


def test_curtains_are_cut(shown, small_run):
    """Cells within one superpixel are kept; cells across components are removed."""
    labels, found = small_run.segmentation.labels, small_run.components
    # the superpixels of the left half as a component of their own
    half = (small_run.segmentation.anchors[:, 0] < 128).astype(np.int32)
    members = (found[0], replace(found[0], label=1))
    two = replace(found, of_superpixel=half, of_pixel=half[labels], members=members)
    known = np.isfinite(small_run.reconstruction.depth_ref)
    surface = whole_cells(*replace(shown, components=two).surface, known)

    def alike(values):
        cells = sliding_window_view(values, (2, 2))
        return (cells == cells[..., :1, :1]).all(axis=(2, 3))

    whole, inside, part = known[:-1, :-1] & alike(known), alike(labels), alike(half[labels])
    assert surface[inside & whole].all()
    assert not surface[~whole | ~part].any()
    # and the surface goes on where planes meet
    assert surface[~inside & part].mean() > 0.5


def test_large_images_are_thinned(shown):
    scene = make_pair(Chain.of(shown), 0, 256 * 128 / 8)
    assert scene["step"] == 3
    assert scene["labels"].shape == (43, 86)
    bits = np.unpackbits(scene["surface"], bitorder="little", count=42 * 85)
    assert 0.5 < bits.mean() < 1


@pytest.mark.slow
def test_a_folder_makes_the_same_page_again(folder, capsys):
    written = (folder / "report.html").read_text()
    assert main(["view", str(folder), "--renew", "--no-open"]) == 0
    assert f"{folder}/report.html" in capsys.readouterr().out
    assert (folder / "report.html").read_text() == written


@pytest.mark.slow
def test_the_page_can_be_left_out(small_run, folder):
    problem = small_run.problem.replace(output={"page": False})
    assert problem.digest() == small_run.problem.digest()
    files = write_folder(folder, replace(small_run, problem=problem), "")
    assert "report.html" not in files
    assert not (folder / "report.html").exists()
    assert "overview.png" in files


@pytest.mark.parametrize(("share", "said"), [(0.004, None), (0.3, "30%"), (1.0, "100%")])
def test_page_pictures_and_overview_begin_with_what_is_drawn(share, said, shown):
    shares = {**shown.summary["certainty"], "drawn": share}
    kind = np.zeros(shown.labels.size, np.uint8)
    kind[: round(share * kind.size)] = 2
    kind = kind.reshape(shown.labels.shape)
    one = replace(shown, summary={**shown.summary, "certainty": shares}, kind=kind)
    drawn = pictures(Chain.of(one))
    depth, header = drawn["depth_ref"].title, page(Chain.of(one), drawn).partition("</header>")[0]
    sentence = drawn_line(shares)
    assert sentence.startswith(f"{said} of the image is drawn") == bool(said)
    assert depth.endswith(f"; pale = drawn ({said})") == bool(said)
    # two frames show the same, where both see it
    pale = [drawn[name].image.min(axis=2) >= 165 for name in ("depth_ref", "depth_next")]
    for mask, frame in zip(pale, Chain.of(one), strict=True):
        assert mask[frame.drawn].all()
    assert pale[0].mean() == pytest.approx(share, abs=0.05)
    assert (f"<p><strong>{sentence}</strong> &middot; " in header) == bool(said)
    assert one.title == (f"{one.name}: {sentence}" if said else one.name)
