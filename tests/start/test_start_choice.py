"""Who takes which motion, by made-up errors: what is asked of a motion, a component, a
neighbour."""

from dataclasses import dataclass

import numpy as np
import pytest
from helpers_model import plane_pose, plane_world
from helpers_start import CAMERA, fitted, flow_of, squares

from soup_nlp.arrays import Mask
from soup_nlp.data.pair import Pair
from soup_nlp.geometry import camera, rotation
from soup_nlp.geometry.graph import Segmentation, build_segmentation
from soup_nlp.geometry.plane import PlaneFit
from soup_nlp.geometry.superpixels import segment
from soup_nlp.start import choice as choosing
from soup_nlp.start import merge as gathering
from soup_nlp.start import propose as proposing
from soup_nlp.start.choice import (
    PIECE_SIZE,
    UNEXPLAINED_PX,
    Choice,
    of_pieces,
    select,
)
from soup_nlp.start.components import (
    borrow,
)
from soup_nlp.start.epipolar import Motion
from soup_nlp.start.propose import propose
from soup_nlp.start.start_options import SeededStart
from soup_nlp.start.views import USABLE, FlowFit, Views

OPTIONS = SeededStart()
PER_RADIAN = 10.0
"""Pixels of error by which a motion misses, per radian of its turn."""


@dataclass
class Turns:
    """Replaces views; superpixels turn about the optical axis by known angles (N,)."""

    true: np.ndarray
    weight: np.ndarray | None = None
    focal = np.array([100.0, 100.0])

    def __post_init__(self) -> None:
        n = len(self.true)
        self.ray = self.target = np.zeros((n, 4, 3))
        self.anchor = np.tile([0.0, 0.0, 1.0], (n, 1))
        self.weight = np.ones((n, 4)) if self.weight is None else self.weight

    def planes(self, R: np.ndarray) -> PlaneFit:
        miss = PER_RADIAN * np.abs(rotation.log(R)[..., 2] - self.true[:, None])
        one = np.ones(miss.shape)
        return PlaneFit(one, np.zeros((*miss.shape, 2)), miss, one)

    def fit(self, motions: list[Motion], label: np.ndarray | None = None) -> PlaneFit:
        R = np.stack([m.R for m in motions])
        whole = np.broadcast_to(R, (len(self.true), *R.shape))
        return self.planes(whole if label is None else R[label][:, None])

    def subset(self, at: np.ndarray) -> "Turns":
        return Turns(self.true[at])

    matches = Views.matches

    @property
    def usable(self) -> np.ndarray:
        return self.weight.mean(axis=1) > USABLE


def flow_of_turns(
    views: Turns,
    seg: Segmentation,
    jump: np.ndarray | float = 0.0,
    shift: np.ndarray | float = 0.0,
) -> FlowFit:
    """The flow of superpixels that turn, whose anchors move by pixels (N, 2) and jump by (P,)."""
    fit = np.zeros((len(seg), 3, 2))
    fit[:, 0] = shift
    return flow_of(seg, jump)._replace(views=views, fit=fit)


def turn(angle: float | np.ndarray) -> np.ndarray:
    return rotation.exp(np.asarray(angle)[..., None] * np.array([0.0, 0.0, 1.0]))


def taken(views: Turns, angle: np.ndarray) -> Choice:
    """Superpixels that turn by angles (N,)."""
    angles, label = np.unique(angle, return_inverse=True)
    return Choice.of(views, turning(*angles), label, 0.05)


def turning(*angles: float) -> list[Motion]:
    return [Motion(turn(angle), np.array([1.0, 0.0, 0.0])) for angle in angles]


@pytest.mark.parametrize(("error", "kept"), [(0.0, True), (0.05, False)])
def test_a_small_motion_counts_where_the_flow_is_exact(error, kept):
    """A block leaves 0.1 px: more than three median errors of exact flow, less than 0.15 px."""
    seg = squares(6, 10)
    block = seg.anchors[:, 0] > 48
    views = Turns(np.where(block, 0.1 / PER_RADIAN, 0.0))
    angle = np.where(block, 0.1 + error, error) / PER_RADIAN
    choice, _ = gathering.earned(flow_of_turns(views, seg), taken(views, angle))
    np.testing.assert_array_equal(choice.label, block.astype(int) * kept)


# --- motions that are worth having ---------------------------------------------------------------


@pytest.mark.parametrize("missing", [0, 1])
def test_a_motion_needs_a_piece_of_superpixels(missing):
    members = np.arange(30) < PIECE_SIZE - missing
    cost = np.where(np.stack([members, ~members], axis=1), 2.0, 0.0)
    assert select(cost, 0.05) == ([0] if missing else [0, 1])


@pytest.mark.parametrize(("confidence", "trusted"), [(1.0, True), (0.1, False)])
def test_pieces_of_untrusted_flow_have_no_motion(monkeypatch, confidence, trusted):
    seg = squares(4, 6)
    odd = seg.anchors[:, 0] > 24
    views = Turns(np.zeros(24), np.where(odd[:, None], confidence, 1.0) * np.ones((24, 4)))
    monkeypatch.setattr(choosing, "estimate", lambda *a: Motion(np.eye(3), np.array([0, 1.0, 0])))
    cost = np.where(odd, 3.0, 0.0)[:, None]
    assert bool(of_pieces(flow_of_turns(views, seg), cost, 0.05)) == trusted


# --- components ----------------------------------------------------------------------------------


def offered(monkeypatch, *angles: float) -> None:
    """Make these turns the candidate motions."""
    monkeypatch.setattr(gathering, "candidates", lambda *a: turning(*angles))


@pytest.mark.parametrize("enough", [True, False])
def test_a_contradicted_motion_is_not_the_components(monkeypatch, enough):
    seg = squares(6, 10)
    column = (seg.anchors[:, 0] // 8).astype(int)
    component = column >= 6
    agree = np.flatnonzero(component)
    needed = int(np.ceil(gathering.AGREE * len(agree)))
    agree = agree[: needed + 1 if enough else needed - 1]
    true = np.where(component, 0.5, 0.0)
    true[agree] = 0.2
    views = Turns(true)
    # two motions explain the flow
    before = taken(views, true)
    offered(monkeypatch, 0.2)
    jump = np.where(seg.across(component), 10.0, 0.0)
    after = gathering.gather(flow_of_turns(views, seg, jump), before)
    assert (after.label[~component] == 0).all()
    if enough:
        assert (after.label[agree] > 0).all()
        assert len(np.unique(after.label[agree])) == 1
    else:
        np.testing.assert_array_equal(after.label, before.label)


def test_components_with_a_gap_in_their_discontinuity_are_parted_there(monkeypatch):
    """No motion explains both: the smaller jump between them is the outline then."""
    seg = squares(6, 10)
    column = (seg.anchors[:, 0] // 8).astype(int)
    component = np.where(column >= 8, 2, np.where(column >= 6, 1, 0))
    true = np.array([0.0, 0.3, -0.3])[component]
    views = Turns(true)
    # two motions in each, both wrong
    before = taken(views, true + np.where(seg.anchors[:, 1] < 24, 0.02, 0.03) * (component > 0))
    offered(monkeypatch, 0.3, -0.3)
    least, most = gathering.DISCONTINUITIES[-1], gathering.DISCONTINUITIES[0]
    assert least < most
    between = 0.5 * (least + most) * OPTIONS.discontinuity_px
    jump = np.where(seg.across(component), between, 0.0)
    jump[seg.across(component > 0)] = 10.0
    after = gathering.gather(flow_of_turns(views, seg, jump), before)
    for b in (1, 2):
        assert len(np.unique(after.label[component == b])) == 1
        assert after.error[component == b].max() < 1e-9
        assert (after.label[component == b] > 0).all()
    assert len(np.unique(after.label)) == 3


def test_one_of_a_component_goes_with_its_neighbours():
    """By itself it prefers the main motion, by less than the price of its outline."""
    seg = squares(4, 9)
    right = seg.anchors[:, 0] > 48
    odd = np.argmax(seg.anchors @ [1.0, 0.1])
    assert right[odd]
    true = np.where(right, 0.2, 0.0)
    true[odd] = 0.09
    views = Turns(true)
    label = np.where(right, 1, 0)
    label[odd] = 0
    before = taken(views, np.where(label == 1, 0.2, 0.0))
    jump = np.where(seg.across(right), 10.0, 0.0)
    after = gathering.gather(flow_of_turns(views, seg, jump), before)
    np.testing.assert_array_equal(after.label, right)


def test_the_main_motion_wins_between_equal_ones():
    seg = squares(4, 9)
    right = seg.anchors[:, 0] > 48
    # the other motion is better by a fifth of the least unexplained error
    middle = 0.1 + 0.1 * UNEXPLAINED_PX / PER_RADIAN
    views = Turns(np.where(right, middle, 0.0))
    before = taken(views, np.where(right, 0.2, 0.0))
    jump = np.full(len(seg.pairs), 10.0)
    after = gathering.gather(flow_of_turns(views, seg, jump), before)
    assert (after.label == 0).all()
    # where it is clearly better it stays
    views = Turns(np.where(right, 0.12, 0.0))
    before = taken(views, np.where(right, 0.2, 0.0))
    after = gathering.gather(flow_of_turns(views, seg, jump), before)
    np.testing.assert_array_equal(after.label, right)


# --- depths --------------------------------------------------------------------------------------


def test_one_wild_neighbour_does_not_decide_a_borrowed_depth():
    seg = squares(3, 3)
    mu = np.full(9, 0.5)
    mu[1], mu[4] = 50.0, 0.01
    weak = np.arange(9) == 4
    for wild in (50.0, 1e-3):
        mu[1] = wild
        new, _ = borrow(mu, np.zeros((9, 2)), np.zeros(9, int), weak, seg)
        assert new[4] == 0.5
        np.testing.assert_array_equal(new[~weak], mu[~weak])


K = camera.intrinsics(50.0, 50.0, 27.5, 19.5)
AHEAD = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def plane() -> tuple[Pair, Segmentation]:
    """A plane before a camera that moves by `CAMERA`."""
    pair = plane_world(plane_pose(3.0, yaw=20), CAMERA, 96, 72)
    labels = segment(pair.image_ref, 30, "grid")
    return pair, build_segmentation(labels, pair.image_ref, neighbours=8)


def test_motions_that_are_hardly_different_do_not_mix(plane, monkeypatch):
    """One motion is off by a hundredth of a pixel: in any order, all take the exact motion."""
    pair, seg = plane
    exact = Motion(CAMERA[:3, :3], CAMERA[:3, 3] / np.linalg.norm(CAMERA[:3, 3]))
    near = Motion(turn(4e-4) @ exact.R, exact.t)
    monkeypatch.setattr(choosing, "of_pieces", lambda *a: [])
    monkeypatch.setattr(proposing, "settle", lambda flow, choice: choice)

    def taken(motion: Motion, *motions: Motion) -> np.ndarray:
        result = list(motions), np.zeros(len(seg), bool)
        monkeypatch.setattr(proposing, "surface_motions", lambda *a: result)
        start = propose(fitted(pair, seg))
        return np.abs(start.soup.R - motion.R).max(axis=(1, 2)) < 1e-9

    assert taken(exact, near, exact).all()
    assert taken(exact, exact, near).all()
    far = Motion(turn(2e-2) @ exact.R, exact.t)
    assert not taken(far, far, exact).any()


def test_only_a_piece_with_usable_flow_moves():
    seg = squares(4, 8)
    component = np.zeros(32, int)
    component[[2, 3]] = 1  # usable
    component[[4, 5]] = 2  # not, but beside the first
    component[[16, 17]] = 3  # not
    component[[22, 23]] = 1  # the first motion again, without usable flow
    component[[28, 29]] = 4  # not, but of a kind that stays
    weight = np.where(np.isin(component, (0, 1)), 1.0, 0.2)
    weight[[22, 23]] = 0.2
    views = Turns(np.zeros(32), np.repeat(weight[:, None], 4, axis=1))
    part = proposing.moving_parts(flow_of_turns(views, seg), component, component == 4)
    expected = np.where(np.isin(np.arange(32), (16, 17, 22, 23)), 0, component)
    np.testing.assert_array_equal(part, expected)


def test_pieces_that_no_motion_explains_have_four_superpixels_and_confident_flow():
    seg = squares(2, 12)
    column = (seg.anchors[:, 0] // 8).astype(int)
    usable, residual = np.ones(len(seg), bool), np.full(len(seg), 0.05)

    def found(columns: list[int], error: float, component: np.ndarray = 0 * column) -> Mask:
        bad = np.isin(column, columns)
        errors = np.where(bad, error, 0.05)
        flow = flow_of(seg, usable=usable)._replace(residual=residual)
        return gathering.unexplained(flow, errors, component, 0.1)

    np.testing.assert_array_equal(found([3, 4], 0.36), np.isin(column, [3, 4]))
    assert not found([3, 4], 0.34).any()
    # single columns have two superpixels, and outlines of components separate pieces
    assert not found([3, 5], 0.36).any()
    assert not found([3, 4], 0.36, (column > 3).astype(int)).any()
    # neither mixtures of flows nor an uncertain flow is a motion
    residual[column == 3] = 0.1
    assert not found([3, 4], 0.36).any()
    residual[:], usable[column == 3] = 0.05, False
    assert not found([3, 4], 0.36).any()


@pytest.mark.parametrize(
    ("shift", "own_error", "size", "mixed"),
    [
        (2.0, 0.0, 2, True),  # between the flows of both sides
        (5.0, 0.0, 2, False),  # beyond them
        (5.0, 0.5, 2, True),  # a little beyond, its own motion explains it badly
        (9.0, 0.5, 2, False),
        (2.0, 0.0, 12, False),  # too large
    ],
)
def test_a_mixture_of_two_flows_does_not_move(shift, own_error, size, mixed):
    """Eight rows move by 0, eight by 4 px; a piece in the middle column turns by itself."""
    seg = squares(16, 32)
    row, column = (seg.anchors // 8).astype(int).T[::-1]
    piece = np.isin(row, (7, 8)) & (abs(column - 16) < size / 4)
    views = Turns(np.where(piece, 0.1, 0.0))
    choice = taken(views, np.where(piece, 0.1 - own_error / PER_RADIAN, 0.0))
    flow = np.zeros((len(seg), 2))
    flow[:, 0] = np.where(piece, shift, np.where(row < 8, 0.0, 4.0))
    still = gathering.unmoved(flow_of_turns(views, seg, shift=flow), choice, piece.astype(int))
    np.testing.assert_array_equal(still, piece & mixed)


@pytest.mark.parametrize(("gain", "moves"), [(0.04, False), (0.06, True)])
def test_a_motion_that_explains_little_more_is_dropped(gain, moves):
    """The noise of the flow is 0.05 px."""
    seg = squares(16, 32)
    row, column = (seg.anchors // 8).astype(int).T[::-1]
    piece = (row < 8) & (column < 8)
    views = Turns(np.where(piece, gain / PER_RADIAN, 0.0))
    choice = taken(views, np.where(piece, gain / PER_RADIAN, 0.0))
    flow = np.where(piece, 9.0, 0.0)[:, None] * [1.0, 0.0]
    still = gathering.unmoved(flow_of_turns(views, seg, shift=flow), choice, piece.astype(int))
    np.testing.assert_array_equal(still, piece & (not moves))
