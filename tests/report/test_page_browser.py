"""report.html in a real browser: it loads, draws, moves and recolours."""

import base64
from itertools import combinations, pairwise

import cv2
import numpy as np
import pytest
import trimesh
from helpers_chromium import Chromium, find_chromium
from helpers_result import toy_pairs

from soup_nlp.report.chain import Chain
from soup_nlp.report.page import MODES, page
from soup_nlp.report.result import result_of
from soup_nlp.report.verdict import summary
from soup_nlp.sequence.folder import write_chain
from soup_nlp.sequence.links import make_chain

CHROMIUM = find_chromium()
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on the PATH (Debian: chromium)"),
]
BACKGROUND = (0x20, 0x26, 0x2E)


@pytest.fixture(scope="module")
def shown(small_run):
    return result_of(small_run, {**summary(small_run), "verdict": ["verdict"]})


@pytest.fixture(scope="module")
def opened(shown, tmp_path_factory):
    """The page of a run, once it is ready."""
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(page(Chain.of(shown)), encoding="utf-8")
    assert CHROMIUM is not None
    chromium = Chromium(CHROMIUM, 1000, 1000)
    chromium.open(path.resolve().as_uri())
    yield chromium
    chromium.close()


@pytest.fixture
def browser(opened):
    """The page as the reference camera sees it at first; no test leaves an error in its log."""
    opened.value("soupView.setMode('image_ref'); soupView.setTime(0); soupView.setFar(1e9)")
    opened.value("soupView.setLeast(0); soupView.setView('reference')")
    yield opened
    assert opened.log == []


def canvas(browser):
    """Pixels of the 3D view without overlays, as numbers with a sign."""
    browser.value("document.querySelector('.hint').style.visibility = 'hidden'")
    x, y, width, height = browser.value(
        "(() => { const r = document.getElementById('canvas').getBoundingClientRect();"
        " return [r.left, r.top, r.width, r.height].map(Math.round); })()"
    )
    return browser.screenshot()[y : y + height, x : x + width].astype(np.int16)


def drawn(image):
    """Share of the pixels that are not background."""
    return float((np.abs(image - BACKGROUND).max(axis=2) > 8).mean())


def apart(a, b):
    """Share of the pixels that differ, of every third row and column."""
    return float((np.abs(a[::3, ::3] - b[::3, ::3]).max(axis=2) > 8).mean())


def test_it_loads_without_an_error_and_fetches_nothing(browser):
    assert browser.value("document.body.dataset.ready") == "yes"
    assert browser.value("document.getElementById('message').textContent") == ""
    assert drawn(canvas(browser)) > 0.2
    assert [r for r in browser.requests if not r.startswith("file:")] == []
    assert len(browser.requests) == 1


def test_the_view_of_the_reference_camera_is_the_reference_image(browser, small_run):
    browser.value("document.getElementById('cameras').click()")
    browser.value("document.getElementById('paths').click()")
    found = canvas(browser)
    height, width = found.shape[:2]
    K, image = small_run.pair.K_ref, small_run.pair.image_ref
    # the view's focal length in pixels of the canvas; it looks along the axis of the camera
    focal = height / 2 / np.tan(np.radians(browser.value("soupView.eye.fov")) / 2)
    M = np.array([
        [focal / K[0, 0], 0, width / 2 - 0.5 - focal * K[0, 2] / K[0, 0]],
        [0, focal / K[1, 1], height / 2 - 0.5 - focal * K[1, 2] / K[1, 1]],
    ])  # fmt: skip
    want = cv2.warpAffine(image, M, (width, height)).astype(float)
    inside = cv2.warpAffine(np.ones(image.shape[:2]), M, (width, height)) > 0.999
    whole = inside & (np.abs(found - BACKGROUND).max(axis=2) > 8)
    # no holes, not even where the surface is cut
    assert whole.sum() > 0.98 * inside.sum()
    gap = np.abs(found - want).max(axis=2)[whole]
    # JPEG at quality 90 and two ways of interpolating
    assert np.median(gap) < 6
    assert (gap > 40).mean() < 0.03


def test_time_moves_the_scene(browser):
    images = []
    for time in (0, 0.5, 1, 0):
        browser.value(f"soupView.setTime({time})")
        images.append(canvas(browser))
    start, middle, end, again = images
    # the background rests
    assert 0.01 < apart(start, end) < 0.5
    assert apart(start, middle) > 0.003
    assert apart(middle, end) > 0.003
    np.testing.assert_array_equal(start, again)


def test_every_mode_has_its_own_colours_and_legend(browser):
    assert browser.value("soupView.modes") == list(MODES)
    images = {}
    for name in MODES:
        browser.value(f"soupView.setMode('{name}')")
        images[name] = canvas(browser)
        assert drawn(images[name]) > 0.2, name
        pressed = browser.value("document.querySelector('#modes .on').value")
        assert pressed == name
        legend = browser.value("document.getElementById('mode-legend').innerHTML")
        assert bool(legend) == (name not in ("image_ref", "superpixels"))
    for a, b in combinations(images, 2):
        assert apart(images[a], images[b]) > 0.01, (a, b)


def test_a_click_tells_depth_sigma_and_component(browser, small_run, shown):
    width = small_run.pair.size[1]
    # the middle of the view is the principal point
    u, v = (round(x) for x in small_run.pair.K_ref[:2, 2])
    found = browser.value(
        "(() => { const c = document.getElementById('canvas');"
        " return soupView.pick(c.clientWidth / 2, c.clientHeight / 2); })()"
    )
    assert abs(found % width - u) <= 2
    assert abs(found // width - v) <= 2
    browser.value(f"soupView.tell({found})")
    said = browser.value("document.getElementById('picked').textContent")
    z = shown.metre * small_run.reconstruction.depth_ref[found // width, found % width]
    assert f"depth {z:.4g}"[:9] in said
    assert "sigma" in said
    assert "superpixel" in said
    browser.value("soupView.tell(-1)")
    assert "No point" in browser.value("document.getElementById('picked').textContent")


@pytest.mark.parametrize("points", [False, True])
def test_what_is_shown_is_saved_for_other_viewers(browser, small_run, shown, tmp_path, points):
    browser.value("soupView.setTime(1)")
    turn = "document.getElementById('points').click()" if points else "null"
    browser.value(turn)
    text = browser.value(
        "soupView.glb().arrayBuffer().then((b) => btoa([...new Uint8Array(b)]"
        ".map((c) => String.fromCharCode(c)).join('')))"
    )
    browser.value(turn)
    (tmp_path / "a.glb").write_bytes(base64.b64decode(text))
    (found,) = trimesh.load(tmp_path / "a.glb").geometry.values()
    assert isinstance(found, trimesh.PointCloud if points else trimesh.Trimesh)
    own = shown.metre * small_run.reconstruction.points_ref.reshape(-1, 3)
    assert len(found.vertices) > 0.5 * len(own)
    # the scene at time 1 in the reference camera's axes, y up
    depth = np.median(-found.vertices[:, 2])
    assert depth == pytest.approx(np.median(own[:, 2]), rel=0.05)
    colours = found.colors if points else found.visual.vertex_colors
    assert np.std(colours[:, :3]) > 10


def test_a_console_error_would_be_seen(browser):
    browser.value("console.error('planted')")
    browser.value("setTimeout(() => { throw new Error('thrown'); })")
    browser.value("new Promise(done => setTimeout(done, 20))")
    assert "planted" in browser.log[0]
    assert "thrown" in browser.log[1]
    browser.log.clear()


def test_the_page_of_a_chain_opens(opened, tmp_path):
    chain = make_chain(toy_pairs())
    write_chain(tmp_path, chain, "toy & co", ["a.png", "b.png", "<b>c.png"])
    before = len(opened.requests)
    opened.open((tmp_path / "report.html").as_uri())
    assert opened.value("document.querySelector('h1').textContent") == "toy & co"
    shots = []
    for time in (0, 1.5, 2):
        opened.value(f"soupView.setTime({time})")
        shots.append(opened.screenshot())
        assert opened.value("document.querySelector('#gallery img').naturalWidth") == 80
    assert all((a != b).mean() > 0.01 for a, b in pairwise(shots))
    now = "document.getElementById('now').textContent"
    assert opened.value(now) == "<b>c.png, time 2 of 2; 0 % drawn"
    # the other pair adds its static points to what is shown and saved
    size, alone = "soupView.ply().size", opened.value("soupView.ply().size")
    opened.value("document.getElementById('all').click()")
    opened.wait(f"{size} > 1.5 * {alone}")
    assert "b.png, pixel (40, 30)" in opened.value(
        "soupView.tell(80 * 30 + 40), document.getElementById('picked').textContent"
    )
    assert opened.log == []
    assert [r for r in opened.requests[before:] if not r.startswith("file:")] == []
