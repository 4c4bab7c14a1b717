"""The nearest other curve against trying all of them, and against hair whose distances and angles are known."""

import numba
import numpy as np
import pytest

from strandscope.core.errors import StrandscopeError
from strandscope.core.neighbours import nearest_other, pairs_in_turn, pairs_within


def flat(curves):
    """A list of (n, 3) -> points, offsets."""
    return np.concatenate(curves), np.concatenate([[0], np.cumsum([len(c) for c in curves])])


def wandering(count, seed, step=0.12):
    """Curves of 2 to 30 points that wander, with steps of very different lengths."""
    rng = np.random.default_rng(seed)
    curves = []
    for _ in range(count):
        way = rng.normal(size=3) + rng.normal(scale=0.3, size=(rng.integers(2, 31), 3))
        curves.append(rng.uniform(-4, 4, 3) + np.cumsum(step * rng.lognormal(0, 1, (len(way), 1)) * way, axis=0))
    return flat(curves)


def directions(points, offsets):
    """Unit directions (N, 3): those of the chords between the points before and after."""
    i, curve = np.arange(len(points)), np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    chord = points[np.minimum(i + 1, offsets[curve + 1] - 1)] - points[np.maximum(i - 1, offsets[curve])]
    return chord / np.linalg.norm(chord, axis=1, keepdims=True)


def tried_all(points, offsets):
    """(distance, angle), each (N, M), of every point to the nearest place on every curve: all segments tried; inf for its own curve."""
    tangents, count = directions(points, offsets), len(offsets) - 1
    distance, angle = np.full((len(points), count), np.inf), np.full((len(points), count), np.nan)
    for c in range(count):
        first, last = offsets[c], offsets[c + 1]
        for p in (*range(first), *range(last, len(points))):
            edges, off = np.diff(points[first:last], axis=0), points[p] - points[first : last - 1]
            t = np.clip((off * edges).sum(1) / (edges**2).sum(1), 0, 1)
            away = np.linalg.norm(off - t[:, None] * edges, axis=1)
            a = int(np.argmin(away))
            way = (1 - t[a]) * tangents[first + a] + t[a] * tangents[first + a + 1]
            distance[p, c] = away[a]
            angle[p, c] = np.arccos(min(abs(np.dot(tangents[p], way / np.linalg.norm(way))), 1))
    return distance, angle


@pytest.mark.parametrize("reach_mm", [0.4, 3.0, np.inf])
def test_the_nearest_is_that_of_trying_all(reach_mm):
    points, offsets = wandering(25, seed=3)
    curve = np.repeat(np.arange(25), np.diff(offsets))
    near, (distances, angles) = nearest_other(points, offsets, reach_mm), tried_all(points, offsets)
    expected, row = np.argmin(distances, axis=1), np.arange(len(points))
    found = distances[row, expected] <= reach_mm
    assert found.all() if np.isinf(reach_mm) else 0 < found.sum() < len(points)
    np.testing.assert_array_equal(near.curve, np.where(found, expected, -1))
    np.testing.assert_allclose(near.distance_mm, np.where(found, distances[row, expected], np.inf), atol=1e-12)
    np.testing.assert_allclose(near.angle, np.where(found, angles[row, expected], np.nan), atol=1e-6)
    a, t = near.segment[found], near.share[found, None]
    assert np.all(near.segment[~found] == -1)
    np.testing.assert_array_equal(curve[a], curve[a + 1])
    foot = points[a] + t * (points[a + 1] - points[a])
    np.testing.assert_allclose(np.linalg.norm(foot - points[found], axis=1), near.distance_mm[found], atol=1e-12)


def test_all_within_reach_are_those_of_trying_all():
    points, offsets = wandering(25, seed=5)
    pairs, (distances, angles) = pairs_within(points, offsets, 1.5), tried_all(points, offsets)
    point, other = np.nonzero(distances <= 1.5)
    assert len(point) > 300
    np.testing.assert_array_equal(pairs.point, point)
    np.testing.assert_array_equal(pairs.curve, other)
    np.testing.assert_allclose(pairs.distance_mm, distances[point, other], atol=1e-12)
    np.testing.assert_allclose(pairs.angle, angles[point, other], atol=1e-6)
    parts = list(pairs_in_turn(points, offsets, 1.5, at_a_time=7))
    assert len(parts) == -(-len(points) // 7)
    for whole, joined in zip(pairs, (np.concatenate(arrays) for arrays in zip(*parts, strict=True)), strict=True):
        np.testing.assert_array_equal(whole, joined)


def test_long_segments_are_as_near_as_short_ones():
    """Two points a curve, many cells apart; the same curves with points every 0.05 mm have the same distances."""
    rng = np.random.default_rng(2)
    ends = rng.uniform(-20, 20, (200, 2, 3))
    fine = [np.linspace(a, b, 2 + int(np.linalg.norm(b - a) / 0.05)) for a, b in ends]
    coarse, dense = nearest_other(*flat(list(ends)), 50.0), nearest_other(*flat(fine), 50.0)
    firsts = flat(fine)[1][:-1]
    np.testing.assert_allclose(coarse.distance_mm[::2], dense.distance_mm[firsts], atol=1e-9)
    np.testing.assert_array_equal(coarse.curve[::2], dense.curve[firsts])


def test_a_segment_is_found_where_only_its_end_comes_within_reach():
    """Short curves ask, those of two points far apart are asked; as near as a formula says."""
    rng = np.random.default_rng(6)
    first, at = rng.uniform(-8, 8, (200, 3)), rng.uniform(-6, 6, (2000, 3))
    way = rng.normal(size=(200, 3))
    ends = np.stack([first, first + 1.2 * way / np.linalg.norm(way, axis=1, keepdims=True)], axis=1)
    short = np.stack([at, at + 0.01 * rng.normal(size=at.shape)], axis=1)
    is_long = np.arange(2200) < 200
    pairs = pairs_within(*flat([*ends, *short]), 1.0, among=is_long, asking=~is_long)
    edge, off = ends[:, 1] - ends[:, 0], short.reshape(-1, 1, 3) - ends[:, 0]
    t = np.clip((off * edge).sum(2) / (edge**2).sum(1), 0, 1)
    distance = np.linalg.norm(off - t[..., None] * edge, axis=2)
    point, curve = np.nonzero(distance <= 1.0)
    assert len(point) > 1000
    np.testing.assert_array_equal(pairs.point - 400, point)
    np.testing.assert_array_equal(pairs.curve, curve)
    np.testing.assert_allclose(pairs.distance_mm, distance[point, curve], atol=1e-12)


def test_only_curves_that_count_are_neighbours_and_only_those_that_ask_are_told():
    heights = np.linspace(0, 5, 11)
    points, offsets = flat([np.stack([np.full(11, x), heights, np.zeros(11)], axis=1) for x in (0.0, 0.1, 0.3, 0.7)])
    near = nearest_other(points, offsets, 2.0, among=np.array([False, False, True, True]), asking=np.array([True, False, True, False]))
    np.testing.assert_allclose(near.distance_mm.reshape(4, 11), np.broadcast_to([[0.3], [np.inf], [0.4], [np.inf]], (4, 11)))
    np.testing.assert_array_equal(near.curve.reshape(4, 11)[:, 0], [2, -1, 3, -1])
    some = np.arange(44) % 3 == 0
    np.testing.assert_array_equal(
        nearest_other(points, offsets, 2.0, asking=some).curve, np.where(some, nearest_other(points, offsets, 2.0).curve, -1)
    )
    pairs = pairs_within(points, offsets, 0.35, among=np.array([True, True, True, False]))
    assert set(zip(pairs.point // 11, pairs.curve, strict=True)) == {(0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1)}


def test_angles_have_neither_head_nor_tail():
    heights = np.linspace(-5, 5, 101)[:, None]
    for degrees in (0.0, 0.01, 30.0, 89.0):
        way = np.array([0, np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
        for sign in (1, -1):
            points, offsets = flat([heights * [0, 1, 0], [0.2, 0, 0] + sign * heights * way])
            assert np.degrees(nearest_other(points, offsets, 1.0).angle[50]) == pytest.approx(degrees, abs=1e-9)


def test_a_curve_is_no_neighbour_of_itself():
    turn = np.linspace(0, 20 * np.pi, 2000)
    coil = np.stack([np.cos(turn), 0.02 * turn, np.sin(turn)], axis=1)  # comes within 0.13 mm of itself
    near = nearest_other(*flat([coil, coil + np.array([9, 0, 0])]), 20.0)
    assert near.distance_mm.min() == pytest.approx(7.0, abs=0.01)
    assert np.all(np.isinf(nearest_other(coil, np.array([0, 2000]), 20.0).distance_mm))


def test_ties_and_threads_change_nothing():
    heights = np.linspace(0, 3, 31)
    where = [(x, z) for x in range(12) for z in range(12)]
    points, offsets = flat(
        [np.stack([np.full(31, x), heights, np.full(31, z)], axis=1) for x, z in where]
    )  # 4464 points; four neighbours, equally near
    before = numba.get_num_threads()
    results = []
    try:
        for threads in (1, before):
            numba.set_num_threads(threads)
            results.append((nearest_other(points, offsets, 2.0), pairs_within(points, offsets, 1.1)))
    finally:
        numba.set_num_threads(before)
    for one, many in zip(*results, strict=True):
        for a, b in zip(one, many, strict=True):
            np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(results[0][0].distance_mm, 1.0)
    corner = results[0][0].curve.reshape(144, 31)[0]
    np.testing.assert_array_equal(corner, 1)  # of curves 1 and 12, the lower number


def test_points_that_lie_on_each_other_have_no_direction():
    points, offsets = flat([np.zeros((2, 3)), np.array([[0.1, 0, 0], [0.1, 1, 0]])])
    near = nearest_other(points, offsets, 1.0)
    np.testing.assert_array_equal(near.distance_mm[:3], 0.1)
    assert np.isinf(near.distance_mm[3])  # hypot(0.1, 1)
    assert np.all(np.isnan(near.angle))


def test_no_curves_have_no_neighbours():
    empty = np.empty((0, 3)), np.zeros(1, np.int64)
    assert len(nearest_other(*empty, 1.0).distance_mm) == 0
    assert len(pairs_within(*empty, 1.0).point) == 0


@pytest.mark.parametrize(
    ("points", "offsets", "reach", "among", "said"),
    [
        (np.zeros((4, 2)), [0, 4], 1.0, None, "shape"),
        (np.full((4, 3), np.nan), [0, 4], 1.0, None, "finite"),
        (np.zeros((4, 3)), [0, 3], 1.0, None, "offsets"),
        (np.zeros((4, 3)), [0, 3, 4], 1.0, None, "at least 2"),
        (np.zeros((4, 3)), [0, 4], 0.0, None, "reach_mm"),
        (np.zeros((4, 3)), [0, 4], 1.0, [True, True], "among"),
    ],
)
def test_what_does_not_fit_is_named(points, offsets, reach, among, said):
    with pytest.raises(StrandscopeError, match=said):
        nearest_other(points, np.array(offsets), reach, among=among)
