"""E_photo is its sum, depends on neither scale nor exposure, and corrects wrong flow."""

from dataclasses import replace

import numpy as np
import pytest
from helpers_files import grey_texture
from helpers_start import facing

from soup_nlp.data.census import census, census_at
from soup_nlp.data.pair import Flow, Pair
from soup_nlp.geometry import camera
from soup_nlp.geometry.graph import build_segmentation
from soup_nlp.geometry.soup import Soup
from soup_nlp.geometry.superpixels import segment
from soup_nlp.model import oracle
from soup_nlp.model.energy_data import build_energy_data
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.reweighting import in_pixels
from soup_nlp.refine.mppbp import objective, refine_soup
from soup_nlp.refine.particles import Particles
from soup_nlp.refine.photometric import BEHIND, SAMPLES, TAU, Photometric, photometric_term
from soup_nlp.refine.records import RefineOptions

HEIGHT, WIDTH = 60, 96
K = camera.intrinsics(80.0, 80.0, 47.5, 29.5)
NEAR, FAR, SHIFT = 1.0, 2.0, 0.1  # the near half moves by 8 px, the far one by 4
OPTIONS = RefineOptions(rounds=3, particles=20, photo=10.0)


class TwoPlanes:
    """A near plane on the right hides a strip of the far one; the camera moves to the left.

    The near plane covers columns 48 and more; in the next frame 56 and more. Columns 44 to 51 of
    the far plane come to 48 to 55 and stay in sight, as those right of them are hidden already.
    """

    def __init__(self) -> None:
        back, front = grey_texture(HEIGHT, WIDTH, 1), grey_texture(HEIGHT, WIDTH, 2)
        ref, nxt = back.copy(), np.roll(back, 4, axis=1)
        ref[:, 48:] = front[:, 48:]
        nxt[:, 56:] = front[:, 48:-8]
        grey = np.stack([ref, nxt]).astype(np.uint8)
        image, image_next = np.repeat(grey[..., None], 3, axis=3)
        self.pair = Pair(image, image_next, K, K)
        self.labels = segment(image, 40, "grid")
        self.seg = build_segmentation(self.labels, image, 6, boundary_samples=2)
        self.count = len(self.seg)
        self.near = self.seg.anchors[:, 0] > 47.5
        depth = np.where(self.near, NEAR, FAR)
        self.truth = self.soup(depth)
        uv = np.zeros((HEIGHT, WIDTH, 2), np.float32)
        uv[..., 0] = np.where(self.near, 8.0, 4.0)[self.labels]
        self.flow = Flow(uv, np.ones((HEIGHT, WIDTH), np.float32), "truth")

    def soup(self, depth: np.ndarray) -> Soup:
        return facing(depth, np.array([SHIFT, 0.0, 0.0]))

    def look(self, soup: Soup, **changes: float) -> Photometric:
        data, o = self.data(self.flow), OPTIONS.replace(**changes)
        photo = photometric_term(self.pair, self.labels, soup, data, o)
        assert photo is not None
        return photo

    def data(self, flow: Flow):
        data = build_energy_data(self.seg, flow, K, K, 16, 0)
        return in_pixels(data, self.truth, self.seg)


@pytest.fixture(scope="module")
def scene() -> TwoPlanes:
    return TwoPlanes()


def test_census_sees_structure_and_no_exposure():
    image = grey_texture(40, 50) // 2 + 40
    assert np.abs(census(np.full((40, 50), 90, np.uint8))).max() == 0
    np.testing.assert_allclose(census(image + 60), census(image), atol=1e-5)
    assert np.abs(census(image)).mean() > 0.2
    rgb = np.repeat(image[..., None], 3, axis=2)
    np.testing.assert_allclose(census(rgb), census(image), atol=1e-5)


def test_census_between_pixels_is_linear():
    layers = census(grey_texture(40, 50))
    v, u = np.mgrid[0:40, 0:49].astype(np.float32)
    np.testing.assert_allclose(census_at(layers, u, v), layers[:, :, :49], atol=1e-6)
    middle = (layers[:, :, :49] + layers[:, :, 1:]) / 2
    np.testing.assert_allclose(census_at(layers, u + 0.5, v), middle, atol=1e-4)
    # more rows than OpenCV takes at once
    tall = np.zeros((70_000, 1), np.float32)
    np.testing.assert_allclose(census_at(layers, tall + 3, tall + 5)[:, -1, 0], layers[:, 5, 3])


def test_costs_are_those_of_a_loop(scene):
    photo = scene.look(scene.truth, photo=7.0)
    wrong = scene.soup(np.where(scene.near, 1.25, 1.7))
    p = Particles.of(scene.truth).joined(Particles.of(wrong))
    costs = photo.costs(p, 1.0)
    ref, nxt = census(scene.pair.image_ref), census(scene.pair.image_next)
    for i in range(0, scene.count, 3):
        at = np.flatnonzero(scene.labels.ravel() == i)
        at = at[((np.arange(SAMPLES) + 0.5) / SAMPLES * len(at)).astype(int)]
        for c, depth in enumerate((scene.truth.distance[i], wrong.distance[i])):
            total = 0.0
            for v, u in zip(*np.divmod(at, WIDTH)):
                x = u + 80.0 * SHIFT / depth
                if x > WIDTH - 1 or depth >= BEHIND * photo.nearest[v, int(x + 0.5)]:
                    total += TAU
                    continue
                sampled = census_at(nxt, np.array([[x]]), np.array([[float(v)]]))[:, 0, 0]
                total += min(np.abs(sampled - ref[:, v, u]).sum() / 16.0, TAU)
            assert costs[i, c] == pytest.approx(7.0 * total / SAMPLES, abs=1e-3)


def test_energy_does_not_depend_on_scale(scene):
    photo = scene.look(scene.truth)
    t = scene.truth
    large = Soup(3 * t.lam, t.n, t.d, t.R, t.t)
    assert photo.energy(large) == pytest.approx(photo.energy(t), rel=1e-5)


def test_blocks_do_not_show(scene, monkeypatch):
    photo = scene.look(scene.truth)
    p = Particles.of(scene.truth).joined(Particles.of(scene.soup(np.full(scene.count, 1.4))))
    whole = photo.costs(p, 1.0)
    monkeypatch.setattr("soup_nlp.refine.photometric.BLOCK", 1)
    np.testing.assert_array_equal(photo.costs(p, 1.0), whole)


def test_weight_zero_leaves_the_images_out(scene):
    o = RefineOptions(photo=0)
    data = scene.data(scene.flow)
    assert photometric_term(scene.pair, scene.labels, scene.truth, data, o) is None


def test_images_repair_what_the_flow_says_wrongly(scene):
    # a patch of the far plane has the near one's flow, at full confidence
    lied = scene.flow.uv.copy()
    lied[20:40, 10:30, 0] = 8.0
    data, flow = scene.data(scene.flow), Flow(lied, scene.flow.confidence, "lie")
    bad = scene.data(flow)
    u, v = scene.seg.anchors.T
    patch = (u > 12) & (u < 28) & (v > 22) & (v < 38)
    depth = np.where(patch, NEAR, scene.truth.distance)
    start, w = scene.soup(depth), Weights()
    photo = scene.look(start)
    done = refine_soup(start, bad, w, OPTIONS, start=scene.truth, photo=photo, seed=0)
    totals = [done.energy_begin["total"], *(r.energy["total"] for r in done.rounds)]
    assert (np.diff(totals) <= 0).all()
    assert done.energy == objective(done.soup, bad, w, photo)
    assert done.energy_start == objective(scene.truth, bad, w, photo)
    scale = np.median(scene.truth.distance / done.soup.distance)
    error = np.abs(scale * done.soup.depth_at(data.anchor_ray) / scene.truth.distance - 1)
    assert error[patch].max() < 0.1
    alone = refine_soup(start, bad, w, OPTIONS, seed=0)
    scale = np.median(scene.truth.distance / alone.soup.distance)
    assert np.abs(scale * alone.soup.depth_at(data.anchor_ray)[patch] / FAR - 1).min() > 0.3


def test_the_objective_has_e_photo_and_a_weaker_e_proj_where_the_images_contradict(scene):
    data, w = scene.data(scene.flow), Weights(proj=2.0)
    contradicted = np.arange(scene.count) % 3 == 0
    photo = replace(scene.look(scene.truth), contradicted=contradicted)
    wrong = scene.soup(np.full(scene.count, 0.6 * FAR))
    full = 2.0 * oracle.values("proj", wrong, data, w)
    weak = 0.6 * oracle.values("proj", wrong, data, w.replace(sigma_proj=2.0))
    assert full.max() > 4.0
    expected = np.where(contradicted, weak, full)
    costs, _ = photo.costs_of_flow(Particles.of(wrong), data, w)
    np.testing.assert_allclose(costs[:, 0], expected, rtol=1e-12)
    E = oracle.energy(wrong, data, w)
    assert objective(wrong, data, w) == E
    terms = {**E, "proj": expected.sum(), "photo": photo.energy(wrong)}
    terms["total"] = sum(terms.values()) - E["total"]
    assert objective(wrong, data, w, photo) == pytest.approx(terms)


def test_images_contradict_where_a_soup_follows_a_wrong_flow(scene):
    data = scene.data(scene.flow)
    patch = np.zeros(scene.count, bool)
    patch[np.unique(scene.labels[20:40, 10:30])] = True
    wrong = scene.soup(np.where(patch, NEAR, scene.truth.distance))
    contradicted = scene.look(wrong).contradicted
    assert contradicted[patch].all()
    # apart from these, only superpixels that leave the view or are hidden
    u = scene.seg.anchors[:, 0]
    assert not contradicted[~patch & ((u < 38) | ((u > 58) & (u < 76)))].any()
    nothing = replace(data, pixel_weight=np.zeros_like(data.pixel_weight))
    assert not scene.look(wrong).disagreeing(wrong, nothing).any()


def test_one_round_is_enough_where_images_and_flow_agree(scene):
    data, w = scene.data(scene.flow), Weights()
    photo = scene.look(scene.truth)
    o = OPTIONS.replace(stagnation=0.0)
    for contradicted, end in ((False, ("agreed", 1, 0)), (True, ("rounds", 3, 40))):
        own = replace(photo, contradicted=np.full(40, contradicted))
        done = refine_soup(scene.truth, data, w, o, photo=own)
        assert (done.status, len(done.rounds), done.contradicted) == end
