"""Flow of small surfaces that move far: found where right, refused where it would be a guess."""

import cv2
import numpy as np
import pytest
from test_flow import match, texture

from soup_nlp.data.flow import dis, tiles
from soup_nlp.data.flow.tiles import with_tiles

SIZE = (240, 360)
START, END, RADIUS = np.array([80, 160]), np.array([170, 70]), 40


def disk(centre: np.ndarray) -> np.ndarray:
    v, u = np.mgrid[0 : SIZE[0], 0 : SIZE[1]]
    return np.hypot(u - centre[0], v - centre[1]) < RADIUS


def frames(surface: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A disk of a surface at `START`, then at `END`, on a background that moves by (2, 1)."""
    back = texture(SIZE[0] + 1, SIZE[1] + 2, 1)
    moved = np.roll(surface, tuple((END - START)[::-1]), axis=(0, 1))
    first = np.where(disk(START), surface, back[1:, 2:])
    return first, np.where(disk(END), moved, back[:-1, :-2])


def completed(
    ref: np.ndarray, nxt: np.ndarray, lost: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The completed flow of the background's motion, its round-trip error, and what is new."""
    flow = np.full((*SIZE, 2), (2.0, 1.0), np.float32)
    gap = np.where(lost, np.inf, 0.0).astype(np.float32)
    new, new_gap = with_tiles(ref, nxt, match, flow, gap)
    return new, new_gap, (new != flow).any(axis=-1)


@pytest.mark.parametrize("searched", [False, True])
def test_a_small_surface_that_moves_far_has_flow_by_its_tiles_only(monkeypatch, searched):
    if not searched:
        monkeypatch.setattr(dis, "with_tiles", lambda *a: a[3:])
    first, second = (np.dstack([image] * 3) for image in frames(texture(*SIZE, 2)))
    flow = dis.dis_flow(first, second)
    right = np.linalg.norm(flow.uv - (END - START), axis=-1) < 1
    share = (right & (flow.confidence > 0.5))[disk(START)].mean()
    assert share > 0.5 if searched else share < 0.1
    # the background keeps its flow
    near = cv2.dilate((disk(START) | disk(END)).astype(np.uint8), np.ones((41, 41))) > 0
    assert np.median(np.linalg.norm(flow.uv - (2, 1), axis=-1)[~near]) < 0.2


@pytest.mark.parametrize("claimed", [False, True])
def test_no_flow_ends_where_another_usable_flow_ends(claimed):
    ref, nxt = frames(texture(*SIZE, 2))
    lost = disk(START) if claimed else disk(START) | disk(END)
    flow, gap, new = completed(ref, nxt, lost)
    if claimed:
        assert not new.any()
        return
    assert new[disk(START)].mean() > 0.5
    # confidence is a mean over a window, so that pixels beside the lost ones are lost as well
    assert not (new & ~(cv2.dilate(lost.astype(np.uint8), np.ones((41, 41))) > 0)).any()
    assert np.abs(flow - (END - START))[new & disk(START)].max(axis=-1).mean() < 0.5
    assert np.isfinite(gap[new]).all()


def test_a_surface_that_is_hidden_in_the_next_image_has_no_flow():
    ref, _ = frames(texture(*SIZE, 2))
    nxt = texture(SIZE[0] + 1, SIZE[1] + 2, 1)[:-1, :-2]
    _, _, new = completed(ref, nxt, disk(START))
    assert not new.any()


def test_a_repeated_texture_has_no_flow(monkeypatch):
    """Bars that look alike: some displacement fits as well as the right one."""
    u = np.arange(SIZE[1])
    bars = 127 + 100 * np.sin(u / 4) + 0.05 * texture(*SIZE, 2)
    ref = np.rint(bars).astype(np.uint8)
    nxt, lost = np.roll(ref, 50, axis=1), np.ones(SIZE, bool)
    assert not completed(ref, nxt, lost)[2].any()
    monkeypatch.setattr(tiles, "DISTINCT", 0.0)
    assert completed(ref, nxt, lost)[2].any()


def test_a_flow_that_is_usable_on_little_of_its_tiles_is_refused(monkeypatch):
    monkeypatch.setattr(tiles, "CONFIRMED", 1.01)
    _, _, new = completed(*frames(texture(*SIZE, 2)), disk(START) | disk(END))
    assert not new.any()


def test_two_surfaces_do_not_move_to_one_place(monkeypatch):
    """Two disks look like the one of the next image; each alone would get a flow."""
    monkeypatch.setattr(tiles, "MUTUAL", np.inf)
    twin = START + np.array([170, 0])
    ref, nxt = frames(texture(*SIZE, 2))
    moved = np.roll(ref, tuple((twin - START)[::-1]), axis=(0, 1))
    both = np.where(disk(twin), moved, ref)
    places = disk(START), disk(twin)
    for alone in places:
        assert completed(both, nxt, alone | disk(END))[2][alone].mean() > 0.5
    _, _, new = completed(both, nxt, places[0] | places[1] | disk(END))
    assert sorted(new[place].mean() > 0.5 for place in places) == [False, True]


@pytest.mark.parametrize(("noise", "match"), [(0.6, True), (1.0, False)])
def test_a_tile_matches_what_looks_nearly_like_it(noise, match):
    """With independent texture in it, the next image correlates by 1 / sqrt(1 + noise^2)."""
    ref, other = (texture(*SIZE, seed).astype(float) for seed in (2, 7))
    nxt = np.roll(ref, (20, 60), axis=(0, 1)) + noise * (other - 128)
    ref, nxt = (np.rint(image / 2 + 64).astype(np.uint8) for image in (ref, nxt))
    matches = tiles._matched(ref, nxt, np.ones(SIZE, bool), 2)
    # correlations of 0.86 and 0.71: nearly all of 330 tiles, or nearly none
    assert len(matches) > 320 if match else len(matches) < 10
    assert (matches[:, 2:] == (30, 10)).all() or not match


def test_of_tiles_that_match_one_place_only_one_is_mutual():
    ref, nxt = frames(texture(*SIZE, 2))
    # a multiple of the distance of tiles, so that tiles of both disks match the same places
    twin = START + np.array([14 * tiles.STEP * 2, 0])
    both = np.where(disk(twin), np.roll(ref, tuple((twin - START)[::-1]), axis=(0, 1)), ref)
    matches = tiles._matched(both, nxt, disk(START) | disk(twin), 2)
    ends = np.unique(matches[:, :2] + matches[:, 2:], axis=0)
    assert 10 < len(matches) == len(ends)


@pytest.mark.parametrize(("change", "count"), [(2, 1), (4, 2)])
def test_tiles_of_one_surface_have_similar_displacements(change, count):
    u = tiles.STEP * np.arange(2 * tiles.GROUP)
    shift = np.where(np.arange(len(u)) < tiles.GROUP, 30, 30 + change)
    matches = np.column_stack([u, 0 * u, shift, 0 * u])
    assert [len(group) for group in tiles._surfaces(matches)] == [len(u) // count] * count


def test_images_of_other_sizes():
    """Tiles for which the next image has no room match nowhere."""
    ref = texture(*SIZE, 2)
    gap = np.full(SIZE, np.inf, np.float32)
    flow = np.zeros((*SIZE, 2), np.float32)
    for nxt in (texture(60, 90, 3), texture(20, 30, 3)):
        same, _ = with_tiles(ref, nxt, match, flow, gap)
        np.testing.assert_array_equal(same, flow)
