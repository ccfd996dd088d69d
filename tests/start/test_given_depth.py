"""A depth prior counts where the flow confirms it, and decides what the flow leaves open."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from helpers_start import fitted, rendered
from scipy import ndimage

import soup_nlp
from soup_nlp.config.problem import make_problem
from soup_nlp.data.inputs import PriorOptions, pair_with_prior
from soup_nlp.data.pair import Pair
from soup_nlp.errors import ConfigError, DataError
from soup_nlp.geometry.graph import Segmentation
from soup_nlp.geometry.soup import reconstruct
from soup_nlp.geometry.superpixels import Labels, segment
from soup_nlp.pipeline import case as pipeline_case
from soup_nlp.pipeline.case import prepare
from soup_nlp.pipeline.run import make_run
from soup_nlp.report.verdict import summary
from soup_nlp.start import prior_evidence
from soup_nlp.start.given_depth import GivenDepth, _slopes, by_prior
from soup_nlp.start.prior_evidence import EXPLAINED, LEAST_MARGIN, edge_margin, judged
from soup_nlp.start.propose import Start, propose
from soup_nlp.start.regions import ORIGINS

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("simple_starts")]

WAVE = np.sin(np.mgrid[0:240, 0:320] / 40.0).prod(axis=0)
"""A smooth map that is independent of the scene."""


class Seen:
    """A small scene with true flow, its start, and starts by priors."""

    def __init__(self, scene: str, seed: int = 0) -> None:
        self.pair, self.seg = rendered(scene, seed, 320, 240, 150)
        self.fitted = fitted(self.pair, self.seg)
        self.start: Start = propose(self.fitted)
        self.depth = self.pair.truth.depth_ref
        self.anchor = self.fitted.views.anchor

    def by(self, prior: np.ndarray, kind: str | None = None) -> tuple[Start, GivenDepth]:
        start_data = self.start, replace(self.pair, depth_prior=prior), self.fitted
        return by_prior(*start_data, judged(*start_data, kind))

    def error(self, start: Start) -> np.ndarray:
        """(N,) log depth of the anchors less the true one, one scale left out."""
        u, v = np.rint(self.seg.anchors).astype(int).T
        gap = np.log(start.soup.depth_at(self.anchor) / self.depth[v, u])
        return gap - np.median(gap)


@pytest.fixture(scope="module")
def swing() -> Seen:
    return Seen("swing")


@pytest.fixture(scope="module")
def pan() -> Seen:
    return Seen("pan")


def test_a_confirmed_prior_gives_a_swinging_object_its_scale(swing):
    before = np.abs(swing.error(swing.start)).mean()
    start, given = swing.by(swing.depth * np.exp(0.1 * WAVE))
    assert given.evidence.kind == "relative"
    assert given.evidence.explained > EXPLAINED
    assert np.abs(swing.error(start)).mean() < 0.5 * before
    assert ORIGINS.index("given depth") in start.origin


def test_inverse_depth_with_a_shift_is_found(swing):
    start, given = swing.by(0.05 + 1 / swing.depth)
    assert given.evidence.kind == "inverse"
    assert np.abs(swing.error(start)).mean() < 0.1


def test_planes_lean_as_the_given_depth_does_inside_superpixels(pan):
    """They are twice as near to it as level planes."""
    labels, K = pan.seg.labels, pan.pair.K_ref
    start, given = pan.by(pan.depth)
    planes = reconstruct(start.soup, labels, K, K, labels.shape).depth_ref / pan.depth
    flat = np.exp(given.log_depth)[labels] / pan.depth
    leaning, level = (np.abs(np.log(z / np.median(z))).mean() for z in (planes, flat))
    assert leaning < 0.5 * level
    # 1 / Z falls to the left by a quarter per ray unit
    inclined = 1 / (1 + 0.25 * (np.arange(320) - K[0, 2]) / K[0, 0]) * np.ones((240, 1))
    slope = _slopes(1 / inclined, pan.pair, pan.seg)
    expected = 0.25 / (1 + 0.25 * pan.anchor[:, 0])
    np.testing.assert_allclose(slope[:, 0], expected, rtol=1e-3)
    np.testing.assert_allclose(slope[:, 1], 0, atol=1e-3)


def test_a_prior_scales_objects_beside_a_determined_background():
    """It moves the background by less than its own error, and has the steps at outlines."""
    road = Seen("street")
    start, given = road.by(road.depth * np.exp(0.4 * WAVE))
    assert given.evidence.determined
    assert given.evidence.ratio > 0.1
    assert given.evidence.explained > EXPLAINED
    main = start.component == np.bincount(start.component).argmax()
    firm = main & ~given.from_prior
    assert (main & given.from_prior).any()
    assert given.from_prior[~main].all()
    assert (start.origin[~main] == ORIGINS.index("given depth")).all()
    assert ORIGINS.index("given depth") not in start.origin[main]
    # objects have the scale of the prior, the background keeps its shape by the flow
    apart = given.log_depth - np.log(start.soup.depth_at(road.anchor))
    apart -= np.median(apart[firm])
    for c in np.unique(start.component[~main]):
        assert abs(np.median(apart[start.component == c])) < 0.02
    assert np.abs(apart[firm]).max() > 0.05
    assert np.abs(road.error(start))[firm].mean() < 0.25 * np.abs(0.4 * WAVE).mean()


@pytest.mark.parametrize(
    ("scene", "wrong"),
    [
        ("swing", "constant"), ("swing", "unknown"), ("swing", "pixels"),
        # without parallax, edges of the image alone contradict it
        ("pan", "smooth"), ("pan", "upside down"),
    ],
)  # fmt: skip
def test_a_wrong_prior_changes_nothing(scene, wrong, request):
    seen = request.getfixturevalue(scene)
    prior = {
        "constant": np.full(seen.depth.shape, 3.0),
        "smooth": np.exp(WAVE),
        "upside down": seen.depth[::-1, ::-1],
        "unknown": np.full(seen.depth.shape, np.nan),
        "pixels": np.exp(np.random.default_rng(4).normal(0, 0.5, seen.depth.shape)),
    }[wrong]
    start, given = seen.by(prior)
    assert start is seen.start
    assert not given.evidence.used
    assert np.isinf(given.sigma).all()
    assert "not used" in str(given.evidence)


def test_before_a_camera_that_turns_a_prior_is_unsure(pan):
    assert pan.start.at_rest
    start, given = pan.by(pan.depth)
    assert np.isnan(given.evidence.ratio)
    assert given.from_prior.all()
    assert (given.sigma > 0.25).all()
    assert np.abs(pan.error(start)).mean() < 0.1 < np.abs(pan.error(pan.start)).mean()
    # the flow is the same at both depths
    moved = [s.soup.moved(s.soup.points(pan.anchor)) for s in (start, pan.start)]
    first, second = (m[:, :2] / m[:, 2:] for m in moved)
    np.testing.assert_allclose(first, second, atol=1e-9)


def test_ordinal_values_count_by_their_order_alone(pan):
    (start, given), (_, other) = (pan.by(v, "ordinal") for v in (pan.depth, np.exp(pan.depth)))
    assert given.evidence.kind == "ordinal"
    assert given.evidence.used
    np.testing.assert_allclose(given.log_depth, other.log_depth, atol=0.02)
    assert 0.4 < np.std(given.log_depth) < 0.55  # the spread of a usual scene
    assert np.abs(pan.error(start)).mean() < np.abs(pan.error(pan.start)).mean()


def test_steps_on_image_edges_tell_a_map_of_it(monkeypatch):
    known: dict[tuple[bytes, int], Labels] = {}

    def once(picture: np.ndarray, count: int) -> Labels:
        """The superpixels of a picture, which all maps share."""
        key = picture.tobytes(), count
        if key not in known:
            known[key] = segment(picture, count)
        return known[key]

    monkeypatch.setattr(prior_evidence, "segment", once)
    rng = np.random.default_rng(0)
    image, depth = np.full((120, 160, 3), 90, np.uint8), np.full((120, 160), 5.0)
    for _ in range(12):
        x, y, w, h = rng.integers(0, [130, 90, 40, 40])
        image[y : y + h + 9, x : x + w + 9] = rng.integers(0, 255, 3)
        depth[y : y + h + 9, x : x + w + 9] = rng.uniform(1, 5)
    log = np.log(depth)
    assert edge_margin(log, image) > LEAST_MARGIN
    # what is so blurred follows the edges, but the superpixels hardly better than by chance
    for width in (1.5, 3.5):
        assert edge_margin(cv2.GaussianBlur(log, (0, 0), width), image) > LEAST_MARGIN
    assert edge_margin(np.roll(log, (31, 47), axis=(0, 1)), image) <= LEAST_MARGIN
    assert edge_margin(np.ones_like(log), image) <= LEAST_MARGIN


# --- files -------------------------------------------------------------------------------------


def test_a_prior_of_another_size_is_brought_to_the_image(tmp_path, swing):
    np.save(tmp_path / "half.npy", swing.depth[::2, ::2])
    pair = PriorOptions(source="half.npy").load(swing.pair, lambda name: tmp_path / name)
    assert pair.depth_prior.shape == swing.pair.size
    assert np.median(np.abs(np.log(pair.depth_prior / swing.depth))) < 0.02
    assert PriorOptions().load(swing.pair, lambda name: tmp_path / name) is swing.pair
    cv2.imwrite(str(tmp_path / "d.png"), np.rint(1000 * swing.depth).astype(np.uint16))
    pair = PriorOptions(source="d.png").load(swing.pair, lambda name: tmp_path / name)
    np.testing.assert_allclose(pair.depth_prior / 1000, swing.depth, rtol=1e-2)


def test_a_prior_that_cannot_be_one_is_refused(swing):
    with pytest.raises(DataError, match="differ in shape"):
        pair_with_prior(swing.pair, swing.depth[:, :100], "a file")
    with pytest.raises(DataError, match="unknown everywhere"):
        pair_with_prior(swing.pair, np.full((24, 32), np.nan), "a file")
    with pytest.raises(ConfigError, match="no source"):
        soup_nlp.solve_pair(swing.pair, depth_prior={"kind": "inverse"})
    with pytest.raises(DataError, match="wrong shape"):
        Pair(swing.pair.image_ref, swing.pair.image_next, fov=60, depth_prior=np.zeros((2, 2, 2)))


# --- whole solves ------------------------------------------------------------------------------


def test_the_prior_is_in_the_energy_and_in_sigma(pan, swing):
    options = {"segmentation": {"superpixels": 60}, "refine": {"enabled": False}}
    # the start has it already
    options["solver"] = {"presolve_iterations": 0, "max_iter": 2}
    none = soup_nlp.solve_pair(swing.pair, **options)
    assert "depth" not in none.energy
    assert none.given is None
    assert "depth_prior" not in summary(none)
    with_it = soup_nlp.solve_pair(swing.pair, prior_ref=swing.depth, **options)
    assert with_it.energy["depth"] > 0
    assert with_it.metrics["solution"].mre < 0.7 * none.metrics["solution"].mre
    assert with_it.given.from_prior.mean() > 0.05
    kind = with_it.confidence.kind[with_it.given.from_prior[with_it.segmentation.labels]]
    assert (kind > 0).all()
    assert summary(with_it)["depth_prior"]["used"]
    # a wrong prior changes neither the program nor energy and sigma of its solution
    problem = make_problem({"input": {"kind": "motorcycle"}, **options})
    case = prepare(problem, pair=replace(swing.pair, depth_prior=np.exp(WAVE)))
    for name, values in vars(case.data).items():
        np.testing.assert_array_equal(values, getattr(none.data, name), err_msg=name)
    for values, before in zip(vars(case.start.soup).values(), vars(none.start.soup).values()):
        np.testing.assert_array_equal(values, before)
    wrong = make_run(case, none.solution)
    assert wrong.energy == none.energy
    assert np.array_equal(wrong.confidence.sigma, none.confidence.sigma)
    guess = soup_nlp.solve_pair(pan.pair, prior_ref=pan.depth, **options)
    assert guess.metrics["solution"].mre < 0.1
    assert guess.confidence.share("inferred") == 1.0


def across_steps(seg: Segmentation, depth: np.ndarray) -> float:
    """Share of pixels whose depth is off the median of their superpixel by more than 20 %."""
    middle = ndimage.median(depth, seg.labels, np.arange(len(seg)))
    return float((np.abs(np.log(depth / middle[seg.labels])) > 0.2).mean())


def test_superpixels_end_at_steps_of_an_unconfirmed_prior(pan, swing):
    def cut(seen: Seen, prior: np.ndarray | None) -> Segmentation:
        raw = {"input": {"kind": "motorcycle"}, "segmentation": {"superpixels": 80}}
        return prepare(make_problem(raw), pair=replace(seen.pair, depth_prior=prior)).segmentation

    before, after = cut(pan, None), cut(pan, pan.depth)
    assert across_steps(after, pan.depth) < 0.5 * across_steps(before, pan.depth)
    wrong = cut(pan, np.exp(WAVE))
    np.testing.assert_array_equal(wrong.labels, before.labels)
    # the flow has ended them where it confirms the prior
    np.testing.assert_array_equal(cut(swing, swing.depth).labels, cut(swing, None).labels)


def test_evidence_for_a_prior_is_independent_of_superpixel_count(swing, monkeypatch):
    monkeypatch.setattr(pipeline_case, "JUDGED_PIECES", 80)
    numbers = []
    for count in (80, 120):
        raw = {"input": {"kind": "motorcycle"}, "segmentation": {"superpixels": count}}
        pair = replace(swing.pair, depth_prior=swing.depth * np.exp(0.2 * WAVE))
        given = prepare(make_problem(raw), pair=pair).given
        numbers.append(given.as_dict() | {"held": None})
        assert len(given.from_prior) > 0.9 * count
    assert numbers[0] == numbers[1]
