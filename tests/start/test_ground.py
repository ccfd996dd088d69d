"""Nothing lies below the ground, and nothing floats above it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers_model import flow_of

from soup_nlp.geometry.camera import rays
from soup_nlp.geometry.graph import Segmentation, build_segmentation
from soup_nlp.geometry.soup import Soup
from soup_nlp.start.ground import above_ground, floating, ground, off_ground
from soup_nlp.start.scene import scene_first

HIGH, FAR = 1.5, 30.0
"""Height of the camera, and distance of a wall."""


@pytest.fixture
def scene() -> tuple[np.ndarray, np.ndarray]:
    """Rays of a grid, and the depth of a road that ends at a wall."""
    v, u = np.mgrid[-0.4:0.4:20j, -0.8:0.8:30j]
    ray = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3)
    Z = np.where(ray[:, 1] > HIGH / FAR, HIGH / np.maximum(ray[:, 1], 1e-6), FAR)
    return ray, Z


def facing(Z: np.ndarray) -> Soup:
    """Planes parallel to the image at these depths, all with the same translation."""
    n = np.tile([0.0, 0.0, -1.0], (len(Z), 1))
    R = np.broadcast_to(np.eye(3), (len(Z), 3, 3))
    return Soup(Z, n, np.ones(len(Z)), R, np.array([0.0, 0.0, -1.0]) / Z[:, None])


def lift(ray, Z, reliable, component):
    reliable = reliable & (component == 0)
    floor = ground(1 / Z, ray, np.ones(len(Z)), reliable, 0)
    return above_ground(facing(Z), ray, np.ones(len(Z)), reliable, component, floor)


def test_unknown_depth_comes_up_to_the_road(scene):
    ray, Z = scene
    lost = (ray[:, 1] > 0.2) & (ray[:, 0] > 0.5)
    assert 0.02 < lost.mean() < 0.2
    depth = np.where(lost, 40.0, Z)
    soup, lifted = lift(ray, depth, ~lost, np.zeros(len(Z), int))
    np.testing.assert_allclose(soup.depth_at(ray), Z, rtol=1e-9)
    # the scene keeps its motion
    np.testing.assert_allclose(soup.translation, facing(depth).translation, rtol=1e-12)
    assert not lifted.any()


def test_a_component_is_lifted_as_one(scene):
    """Its shape stays, and its flow too: translation and depth change by the same factor."""
    ray, Z = scene
    car = (ray[:, 1] > 0.2) & (ray[:, 0] > 0.5)
    depth = np.where(car, 40.0 + ray[:, 0], Z)
    soup, lifted = lift(ray, depth, ~car, car.astype(int))
    np.testing.assert_array_equal(lifted, car)
    ratio = soup.depth_at(ray) / depth
    translation = soup.translation[:, 2] / facing(depth).translation[:, 2]
    np.testing.assert_allclose(ratio, translation, rtol=1e-9)
    # one factor, except for parts that would still lie below
    common = np.median(Z[car] / depth[car])
    assert np.isclose(ratio[car], common).mean() > 0.5
    assert (soup.depth_at(ray)[car] < Z[car] / 0.8 * (1 + 1e-9)).all()


@pytest.mark.parametrize("why", ["below", "steep", "nothing level"])
def test_without_a_ground_nothing_moves(scene, why):
    ray, Z = scene
    reliable = np.ones(len(Z), bool)
    if why == "below":
        # a table: an eighth of the reliable area is the floor beside it
        Z = np.where((ray[:, 1] > 0.1) & (ray[:, 0] > 0.4), 2 * Z, Z)
    elif why == "steep":
        Z = 5 / (1 + 0.8 * ray[:, 1])
    else:
        Z = np.random.default_rng(0).uniform(3, 30, len(Z))
    assert (ground(1 / Z, ray, np.ones(len(Z)), reliable, 0) == 0).all()


def test_reliable_depth_stays_below(scene):
    """A ditch with reliable depth is kept."""
    ray, Z = scene
    ditch = (ray[:, 1] > 0.3) & (np.abs(ray[:, 0]) < 0.1)
    assert 0 < ditch.mean() < 0.05
    depth = np.where(ditch, 1.5 * Z, Z)
    soup, _ = lift(ray, depth, np.ones(len(Z), bool), np.zeros(len(Z), int))
    np.testing.assert_allclose(soup.depth_at(ray), depth, rtol=1e-12)


def street(car: float) -> tuple[Segmentation, np.ndarray, np.ndarray, np.ndarray]:
    """Segmentation, camera, rays and depth of a road with a car `car` times as far as it stands."""
    side, rows, columns = 8, 20, 30
    labels = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    labels = labels.repeat(side, axis=0).repeat(side, axis=1)
    height, width = labels.shape
    K = np.array([[150.0, 0, width / 2], [0, 150.0, height / 2], [0, 0, 1]])
    image = np.full((height, width, 3), 128, np.uint8)
    seg = build_segmentation(labels, image, 8)
    ray = rays(K, seg.anchors)
    Z = np.where(ray[:, 1] > HIGH / FAR, HIGH / np.maximum(ray[:, 1], 1e-6), FAR)
    row, column = np.divmod(np.arange(rows * columns), columns)
    body = (row >= 9) & (row <= 13) & (column >= 10) & (column <= 14)
    foot = HIGH / ((14 * side - height / 2) / 150)
    Z = np.where(body, car * foot, Z)
    return seg, K, ray, Z


@pytest.mark.parametrize("car", [0.5, 1.0])
def test_a_floating_region_is_found_with_its_distance(car):
    seg, K, ray, Z = street(car)
    body = np.isclose(Z, Z[13 * 30 + 12])
    floor = ground(1 / Z, ray, np.ones(len(Z)), ~body, 0)
    assert floor.any()
    regions = floating(facing(Z), seg, K, floor, np.zeros(len(Z), int))
    if car == 1.0:
        # the car stands on the ground, and so does the wall
        assert regions == []
        return
    assert len(regions) == 1
    region, farther = regions[0]
    np.testing.assert_array_equal(region, body)
    # up to the spacing of the sampled rows of the boundary
    assert farther == pytest.approx(1 / car, rel=0.1)
    # relative to a camera that moves by (0, 0, 1), it would climb by a fifth of its way
    soup = facing(Z)
    hangs = replace(soup, t=soup.t + np.where(body, 0.1 / Z, 0.0)[:, None] * [0.0, 1.0, 0.0])
    assert floating(hangs, seg, K, floor, np.zeros(len(Z), int)) == []


@pytest.mark.parametrize("car", [0.8, 1.0, 2.0])
@pytest.mark.parametrize("road", [0, 1])
def test_the_distance_of_a_region_from_the_ground_is_told(car, road):
    """Whether it is too near or too far, and whichever component the ground is."""
    seg, K, _, Z = street(car)
    row, column = np.divmod(np.arange(len(Z)), 30)
    body = (row >= 9) & (row <= 13) & (column >= 10) & (column <= 14)
    component = np.where(body, 1 - road, road)
    reliable = np.ones(len(Z), bool)
    off = off_ground(facing(Z), seg, K, component, reliable, 0)
    np.testing.assert_allclose(off[body], -np.log(car), atol=0.02)
    # the wall is the scene, and the road no region
    np.testing.assert_allclose(off[~body], 0.0, atol=1e-12)
    assert (off_ground(facing(Z), seg, K, component, reliable & body, 0) == 0).all()


def test_superpixels_that_join_region_and_ground_do_not_count():
    """They contain pixels of both, and their planes face down from one to the other."""
    seg, K, _, Z = street(0.8)
    row, column = np.divmod(np.arange(len(Z)), 30)
    body = (row >= 9) & (row <= 13) & (column >= 10) & (column <= 14)
    joins, near = body & (row == 13), Z[body][0]
    top, bottom = (rays(K, np.array([[0.0, v]]))[0, 1] for v in (13 * 8 - 0.5, 14 * 8 - 0.5))
    along = np.array([bottom * near / 0.8 - top * near, near / 0.8 - near])
    normal = np.array([0.0, along[1], -along[0]]) / np.linalg.norm(along)
    soup = facing(Z)
    n, d = soup.n.copy(), soup.d.copy()
    n[joins], d[joins] = normal, -(normal[1] * top + normal[2])
    soup = Soup(np.where(joins, near, soup.lam), n, d, soup.R, soup.t)
    off = off_ground(soup, seg, K, body.astype(int), np.ones(len(Z), bool), 0)
    np.testing.assert_allclose(off[body], -np.log(0.8), atol=0.03)


def test_a_quarter_of_the_image_may_be_a_resting_table():
    seg, K, ray, Z = street(1.0)
    row, column = np.divmod(np.arange(len(Z)), 30)
    table = (row >= 4) & (row <= 16) & (column >= 5) & (column <= 24)
    assert table.mean() > 0.25
    Z = np.where(table, 0.5 * HIGH / ray[17 * 30, 1], Z)
    reliable = np.ones(len(Z), bool)
    off = off_ground(facing(Z), seg, K, np.zeros(len(Z), int), reliable, 0)
    assert (off == 0).all()
    # what moves is no table
    off = off_ground(facing(Z), seg, K, table.astype(int), reliable, 0)
    np.testing.assert_allclose(off[table], np.log(2), atol=0.1)


@pytest.mark.parametrize(
    ("sky", "road", "reference"),
    # vehicles between these rows of 20 are larger than the road on which they stand; what the lower
    # border cuts off stands on nothing, and a large sky, which stands on the vehicles, stays
    [(3, 12, 2), (3, 20, 1), (11, 14, 0)],
)
def test_the_scene_is_the_ground_below_the_largest_component(sky, road, reference):
    seg, K, _, Z = street(1.0)
    row = np.arange(len(Z)) // 30
    label = np.digitize(row, [sky, road])
    flow, none, sure = flow_of(seg, K=K), np.zeros(len(Z), bool), np.ones(len(Z), bool)

    def first(soup, **options):
        found = scene_first(flow_of(seg, K=K, **options), soup, sure, label, none)
        # the others keep their order
        left = found != 0
        assert (np.diff(found[left][np.argsort(label[left], kind="stable")]) >= 0).all()
        (mine,) = np.unique(label[~left])
        return mine

    largest = int(np.argmax(np.bincount(label)))
    assert first(facing(Z)) == reference
    # a wall is no ground, and the vertical has to be known
    assert first(facing(np.full(len(Z), FAR))) == largest
    assert first(facing(Z), upright=False) == largest
    # nothing stands on what is fixed in the image
    fixed = scene_first(flow, facing(Z), sure, label, label == 2)
    assert (label[fixed == 0] == np.argmax(np.bincount(label[label < 2]))).all()
