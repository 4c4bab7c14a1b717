"""The way of hair where it is known: parallel hair, helices, wisps that cross; and how far a hair departs from its neighbours."""

from itertools import pairwise

import numba
import numpy as np
import pytest

from strandscope.core.flow import across, departures, flow, tangents_of, way_at

NO_FIELD = np.zeros((1, 1, 1, 3), np.float32)
STEP = 0.1  # mm, between points of a curve


def flat(curves):
    """A list of (n, 3) -> points, offsets."""
    return np.concatenate(curves), np.concatenate([[0], np.cumsum([len(c) for c in curves])])


def unit(way):
    return np.asarray(way, float) / np.linalg.norm(way)


def lines(way, where, half_mm=3.0):
    """Straight hair along way (3,) through where (n, 3)."""
    along = np.arange(-half_mm, half_mm, STEP)[:, None] * unit(way)
    return [np.asarray(at) + along for at in where]


def told(curves, sigma_mm=0.5, field=NO_FIELD, origin=(0.0, 0.0, 0.0), voxel_mm=1.0):
    return flow(*flat(curves), sigma_mm, field, np.asarray(origin), voxel_mm)


def asked(streams, at, way, own=-1):
    """Direction (3,) at a place for hair that runs as ``way``, and the distance of the nearest curve, mm."""
    *found, square = way_at(streams, *map(float, at), *unit(way), own)
    return np.array(found), np.sqrt(square)


def degrees(a, b):
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), np.dot(a, b)))


def reversed_some(curves, seed=0):
    rng = np.random.default_rng(seed)
    return [curve[:: rng.choice([-1, 1])] for curve in curves]


def helices(pitch_mm=8.0, spacing_mm=0.3):
    turn = np.arange(-np.pi, np.pi, 0.05)
    curves = []
    for radius in np.arange(0.9, 3.0, spacing_mm):
        for phase in np.arange(0, 2 * np.pi, spacing_mm / radius):
            curves.append(np.stack([radius * np.cos(turn + phase), turn / (2 * np.pi) * pitch_mm, radius * np.sin(turn + phase)], axis=1))
    return curves


# ---- tangents --------------------------------------------------------------------------------------------------------


def test_tangents_are_unit_and_do_not_run_from_curve_to_curve():
    curves = [*lines((1, 2, 3), [(0, 0, 0)]), *lines((0, 0, 1), [(50, 0, 0)]), *lines((-1, 0, 0), [(0, -50, 0)], half_mm=0.1)]
    tangents = tangents_of(*flat(curves))
    expected = np.repeat([unit((1, 2, 3)), (0, 0, 1), (-1, 0, 0)], [len(c) for c in curves], axis=0)
    assert np.allclose(tangents, expected, atol=1e-9)


def test_tangents_of_a_helix_are_those_of_its_derivative():
    turn = np.arange(0, 4 * np.pi, 0.05)
    curve = np.stack([2 * np.cos(turn), 1.5 * turn, 2 * np.sin(turn)], axis=1)
    expected = np.stack([-2 * np.sin(turn), np.full_like(turn, 1.5), 2 * np.cos(turn)], axis=1) / 2.5
    assert np.abs(tangents_of(*flat([curve])) - expected)[1:-1].max() < 1e-3  # a chord over two steps of 0.05 rad


# ---- the way ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("asking", [(0, 1, 0.2), (0, -1, -0.2)])
def test_parallel_hair_tells_its_direction_headed_as_asked(asking):
    way = unit((0.3, 1, -0.2))
    rng = np.random.default_rng(1)
    curves = reversed_some(lines(way, rng.uniform(-1, 1, (80, 3)) * (1, 0, 1)))
    for at in rng.uniform(-0.7, 0.7, (20, 3)):
        found, _ = asked(told(curves), at, asking)
        assert np.allclose(found, way * np.sign(asking[1]), atol=1e-6)


def test_between_helices_the_way_is_that_of_the_helix_through_the_place():
    pitch = 8.0
    streams = told(reversed_some(helices(pitch)), sigma_mm=0.4)
    rng = np.random.default_rng(2)
    for radius, turn in zip(rng.uniform(1.5, 2.3, 30), rng.uniform(0, 2 * np.pi, 30), strict=True):
        at = (radius * np.cos(turn), rng.uniform(-2, 2), radius * np.sin(turn))
        expected = unit((-radius * np.sin(turn), pitch / (2 * np.pi), radius * np.cos(turn)))
        found, _ = asked(streams, at, expected + rng.normal(0, 0.15, 3))
        assert degrees(found, expected) < 4.0  # the mean over two neighbours' distances of a way that turns


def test_where_a_curve_turns_the_nearer_neighbour_counts_more():
    curves = [*lines((0, 1, 0), [(-0.5, 0, 0)]), *lines((0.5, 1, 0), [(0.5, 0, 0)])]
    slopes = [asked(told(curves), (x, 0, 0), (0.2, 1, 0))[0][0] for x in np.linspace(-0.4, 0.4, 9)]
    assert np.all(np.diff(slopes) > 0)
    assert slopes[0] < 0.1
    assert slopes[-1] > 0.35  # of 0.447


@pytest.mark.parametrize("angle_deg", [50, 70, 90])
def test_wisps_that_cross_are_kept_apart(angle_deg):
    one, other = (0.0, 1.0, 0.0), (np.sin(np.radians(angle_deg)), np.cos(np.radians(angle_deg)), 0.0)
    rng = np.random.default_rng(3)
    mixed = [*lines(one, rng.uniform(-1, 1, (60, 3)) * (1, 0, 1)), *lines(other, rng.uniform(-1, 1, (60, 3)) * (1, 1, 1))]
    streams = told(reversed_some(mixed))
    for at in rng.uniform(-0.3, 0.3, (10, 3)):
        for way in (one, other):
            assert degrees(asked(streams, at, way)[0], way) < 1e-3


def test_the_own_curve_is_left_out():
    curves = [*lines((0, 1, 0), [(0, 0, 0)]), *lines((0.4, 1, 0), [(0.6, 0, 0)])]
    both, _ = asked(told(curves), (0, 0, 0), (0, 1, 0))
    others, nearest = asked(told(curves), (0, 0, 0), (0, 1, 0), own=0)
    assert degrees(both, (0, 1, 0)) < 12
    assert degrees(others, unit((0.4, 1, 0))) < 1e-4
    assert nearest == pytest.approx(0.6 * np.cos(np.arctan(0.4)), abs=1e-3)
    alone, nearest = asked(told(curves[:1]), (0, 0, 0), (0.1, 1, 0), own=0)
    assert np.allclose(alone, unit((0.1, 1, 0)))
    assert nearest == np.inf


def test_the_nearest_curve_is_told_by_its_line_and_not_by_its_points():
    way = unit((0.2, 1, 0.1))
    streams = told(lines(way, [(0.0, 0.0, 0.0)]))
    rng = np.random.default_rng(4)
    for at in rng.uniform(-0.6, 0.6, (50, 3)):
        _, nearest = asked(streams, at, way)
        assert nearest == pytest.approx(np.linalg.norm(np.cross(at, way)), abs=1e-6)
    _, crossing = asked(streams, (0.3, 0.0, 0.0), (1, 0, 0))
    assert crossing == pytest.approx(0.3 * np.linalg.norm(np.cross((1, 0, 0), way)), abs=1e-6)  # also of hair that runs elsewhere


def test_far_from_hair_the_field_tells_and_beside_hair_it_hardly_does():
    low = np.array([-8.0, -8.0, -8.0])
    field = np.zeros((16, 16, 16, 3), np.float32)
    field[:8, ..., 2] = 1.0
    streams = told(lines((0, 1, 0), [(-2, 0, 0), (-1.6, 0, 0), (2, 0, 0)]), field=field, origin=low)
    for sign in (1, -1):
        far, nearest = asked(streams, (-6, 0, 0), (0.3, 0.1, sign * 0.2))
        assert np.allclose(far, (0, 0, sign))
        assert nearest == np.inf
    beside, _ = asked(streams, (-1.8, 0, 0), (0, 1, 0.2))
    assert 0 < degrees(beside, (0, 1, 0)) < 2.0
    nowhere, _ = asked(streams, (6, 0, 0), (0.6, 0, 0.8))
    assert np.allclose(nowhere, (0.6, 0, 0.8))


def test_places_beyond_the_curves_and_the_field_are_answered():
    streams = told(lines((0, 1, 0), [(0, 0, 0)]))
    for at in ((1e3, 0, 0), (-1e3, 0, 0), (0, 1e3, 0), (0, -1e3, -1e3)):
        found, nearest = asked(streams, at, (0, 0, 1))
        assert np.allclose(found, (0, 0, 1))
        assert nearest == np.inf


# ---- departures ------------------------------------------------------------------------------------------------------


def test_across_is_the_nearest_unit_vector_at_right_angles():
    rng = np.random.default_rng(5)
    for _ in range(50):
        way, axis = unit(rng.normal(size=3)), unit(rng.normal(size=3))
        found = np.array(across(*way, *axis))
        assert np.linalg.norm(found) == pytest.approx(1)
        assert np.dot(found, way) == pytest.approx(0, abs=1e-12)
        assert np.dot(found, axis) == pytest.approx(np.linalg.norm(np.cross(way, axis)))


@pytest.mark.parametrize("way", [(1, 0, 0), (0, 1, 0), (0, 0, -1), (0.8, 0.6, 0), (0.6, 0, 0.8)])
def test_across_the_way_itself_is_any_other_unit_vector(way):
    found = np.array(across(*map(float, way), *map(float, way)))
    assert np.dot(found, way) == pytest.approx(0, abs=1e-9)
    assert np.linalg.norm(found) == pytest.approx(1)


def straight_about(curve):
    """The curve, and straight vertical hair all about it."""
    where = [(x, 0, z) for x in np.arange(-0.8, 0.81, 0.4) for z in np.arange(-0.8, 0.81, 0.4)]
    return flat([curve, *lines((0, 1, 0), where, half_mm=4.0)])


def test_departures_of_a_wave_are_its_slope():
    y = np.arange(-3.0, 3.0, STEP)
    height, length = 0.1, 3.0
    curve = np.stack([height * np.sin(2 * np.pi * y / length), y, 0.5 * height * np.cos(2 * np.pi * y / length)], axis=1)
    points, offsets = straight_about(curve)
    found = departures(flow(points, offsets, 0.4, NO_FIELD, np.zeros(3), 1.0), points, offsets)
    slope = 2 * np.pi * height / length * np.stack([np.cos(2 * np.pi * y / length), -0.5 * np.sin(2 * np.pi * y / length)], axis=1)
    expected = slope / np.sqrt(1 + np.sum(slope**2, axis=1, keepdims=True))
    inner = found[2 : len(y) - 2]
    assert np.abs(inner[:, 0] - expected[2:-2, 0]).max() < 0.005  # the first axis lies along x, and is carried along y
    assert np.abs(np.abs(inner[:, 1]) - np.abs(expected[2:-2, 1])).max() < 0.005
    assert np.abs(found[len(y) :]).max() < 0.06  # the neighbours see the wave only as one among many


def test_departures_of_a_coil_turn_as_often_as_it_does():
    y = np.arange(-3.0, 3.0, STEP)
    turn = 2 * np.pi * y / 1.5
    curve = np.stack([0.1 * np.cos(turn), y, 0.1 * np.sin(turn)], axis=1)
    points, offsets = straight_about(curve)
    found = departures(flow(points, offsets, 0.4, NO_FIELD, np.zeros(3), 1.0), points, offsets)[2 : len(y) - 2]
    slope = 2 * np.pi * 0.1 / 1.5
    assert np.hypot(*found.T) == pytest.approx(np.full(len(found), slope / np.hypot(1, slope)), abs=0.02)
    turned = np.unwrap(np.arctan2(found[:, 1], found[:, 0]))
    assert abs(turned[-1] - turned[0]) == pytest.approx((len(found) - 1) * STEP * 2 * np.pi / 1.5, rel=0.03)


def test_how_far_a_hair_departs_does_not_depend_on_where_it_begins():
    rng = np.random.default_rng(6)
    curves = [c + 0.05 * np.sin(3 * c[:, 1:2] + rng.uniform(0, 6)) for c in lines((0, 1, 0), rng.uniform(-1, 1, (40, 3)) * (1, 0, 1))]
    found = []
    for some in (curves, reversed_some(curves)):
        points, offsets = flat(some)
        size = np.hypot(*departures(flow(points, offsets, 0.4, NO_FIELD, np.zeros(3), 1.0), points, offsets).T)
        found.append([np.sort(size[a:b]) for a, b in pairwise(offsets)])
    assert np.allclose(*found, atol=1e-9)


def test_departures_are_the_same_on_any_number_of_threads():
    points, offsets = flat(helices(spacing_mm=0.5))
    streams = flow(points, offsets, 0.5, NO_FIELD, np.zeros(3), 1.0)
    threads, many = numba.get_num_threads(), departures(streams, points, offsets)
    try:
        numba.set_num_threads(1)
        one = departures(streams, points, offsets)
    finally:
        numba.set_num_threads(threads)
    assert one.tobytes() == many.tobytes()
