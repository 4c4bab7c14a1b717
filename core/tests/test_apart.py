"""Strands pushed apart: none runs through another afterwards, what is held stays, captured hair stands still, all stay smooth."""

from itertools import pairwise

import numba
import numpy as np
import pytest

from strandscope.core.apart import ApartParams, Tubes, push_apart
from strandscope.core.neighbours import nearest_other

RADIUS = 0.04  # mm
STEP = 0.2


@pytest.fixture(autouse=True)
def one_thread():
    """The bundles are so small that threads that wait for each other would take most of the time."""
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    yield
    numba.set_num_threads(threads)


def line(at, way=(0.0, 1.0, 0.0), half_mm=4.0):
    way = np.asarray(way) / np.linalg.norm(way)
    return np.asarray(at) + np.arange(-half_mm, half_mm + 1e-9, STEP)[:, None] * way


def tubes(curves, radius_mm=RADIUS, first=0):
    """Curves, a list of (n, 3), each a fiber of its own from the number ``first`` on."""
    offsets = np.concatenate([[0], np.cumsum([len(c) for c in curves])]).astype(np.int64)
    points = np.concatenate([np.empty((0, 3)), *curves])
    return Tubes(points, offsets, np.broadcast_to(np.asarray(radius_mm, float), len(curves)).copy(), np.arange(first, first + len(curves)))


NOTHING = tubes([])


def pushed(moving, still=NOTHING, held=None, params=None):
    held = np.zeros((len(moving.radii), 2), bool) if held is None else np.array(held, bool)
    return push_apart(moving, still, held, params)


def room(points, moving, still=NOTHING):
    """The least (distance of two centrelines) − (sum of their radii), exact to a micron."""
    fine = []
    for some, offsets in ((points, moving.offsets), (still.points, still.offsets)):
        for a, b in pairwise(offsets):
            at = np.linspace(0, b - a - 1, 20 * (b - a - 1) + 1)
            fine.append(np.stack([np.interp(at, np.arange(b - a), x) for x in some[a:b].T], axis=1))
    offsets = np.concatenate([[0], np.cumsum([len(c) for c in fine])])
    radii = np.repeat(np.concatenate([moving.radii, still.radii]), np.diff(offsets))
    other = np.concatenate([moving.radii, still.radii])
    near = nearest_other(np.concatenate(fine), offsets, 1.0)
    found = near.curve >= 0
    return np.min((near.distance_mm - radii - other[near.curve])[found], initial=np.inf)


def sharpest_turn(points, offsets):
    """The largest angle between two steps, degrees."""
    worst = 0.0
    for a, b in pairwise(offsets):
        steps = np.diff(points[a:b], axis=0)
        steps /= np.linalg.norm(steps, axis=1, keepdims=True)
        worst = max(worst, np.degrees(np.arccos(np.clip(np.sum(steps[1:] * steps[:-1], axis=1), -1, 1))).max())
    return worst


def bundle(seed=0, spacing_mm=0.07, side=5, lean=0.01, half_mm=3.0):
    """Hair that is too near to each other by an eighth, and leans so that some of it crosses."""
    rng = np.random.default_rng(seed)
    where = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2) * spacing_mm
    return [line((x, 0, z), (rng.normal(0, lean), 1, rng.normal(0, lean)), half_mm) for x, z in where]


# ---- two strands -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle_deg", [0, 2, 10, 40, 90])
@pytest.mark.parametrize("gap_mm", [0.001, 0.03])
def test_two_strands_that_run_through_each_other_make_way_by_half_each(angle_deg, gap_mm):
    turn = np.radians(angle_deg)
    moving = tubes([line((0, 0, 0)), line((0, 0, gap_mm), (np.sin(turn), np.cos(turn), 0))])
    after = pushed(moving)
    assert room(after, moving) > 0
    way = after - moving.points
    one, other = way[: moving.offsets[1]], way[moving.offsets[1] :]
    most = np.abs(way).max()
    assert most < 2 * (2 * RADIUS + ApartParams().clearance_mm - gap_mm)
    assert np.abs(one[:, 2]).max() == pytest.approx(np.abs(other[:, 2]).max(), rel=0.02)
    assert one[:, 2].min() < 0 < other[:, 2].max()
    assert sharpest_turn(after, moving.offsets) < 5.0  # 0.08 mm over a length of 0.6: 0.2 a mm, 2.6° a step
    if angle_deg > 30:
        assert np.abs(way[[0, moving.offsets[1] - 1, moving.offsets[1], -1]]).max() < 1e-3  # far from where they cross


def test_a_strand_makes_all_the_way_for_one_that_stands_still():
    still, moving = tubes([line((0, 0, 0))]), tubes([line((0, 0, 0.02), (0.6, 0.8, 0))], first=1)
    before = still.points.copy()
    after = pushed(moving, still)
    assert room(after, moving, still) > 0
    assert np.array_equal(still.points, before)
    assert np.abs(after - moving.points).max() == pytest.approx(2 * RADIUS + ApartParams().clearance_mm - 0.02, rel=0.5)
    assert sharpest_turn(after, moving.offsets) < 5.0


@pytest.mark.parametrize(
    "other",
    [line((0, 0, 0), (0.6, 0.8, 0)), line((0.013, 0.05, 0), (0.6, 0.8, 0)), line((0, 0, 0))],
    ids=["at a point", "inside segments", "all along"],
)
def test_strands_that_meet_exactly_make_way_too(other):
    moving = tubes([line((0, 0, 0)), other])
    assert room(pushed(moving), moving) > 0


def test_what_has_room_stays_where_it_is():
    moving = tubes([line((0, 0, 0)), line((0, 0, 0.02), (1, 1, 0)), line((5, 0, 0)), line((5.09, 0, 0))])
    after = pushed(moving)
    assert np.array_equal(after[moving.offsets[2] :], moving.points[moving.offsets[2] :])
    alone = tubes([line((0, 0, 0))])
    assert np.array_equal(pushed(alone), alone.points)


def test_pieces_of_one_fiber_do_not_push_each_other():
    moving = tubes([line((0, 0, 0)), line((0, 0, 0.02))])._replace(fibers=np.array([3, 3]))
    assert np.array_equal(pushed(moving), moving.points)
    still = tubes([line((0, 0, 0))], first=3)
    assert np.array_equal(pushed(tubes([line((0, 0, 0.02))], first=3), still), line((0, 0, 0.02)))
    assert not np.array_equal(pushed(tubes([line((0, 0, 0.02))], first=2), still), line((0, 0, 0.02)))


def test_thick_hair_needs_more_room():
    moving = tubes([line((0, 0, 0)), line((0, 0, 0.05), (1, 1, 0)), line((3, 0, 0)), line((3, 0, 0.05), (1, 1, 0))], [0.02, 0.025, 0.06, 0.05])
    after = pushed(moving)
    assert room(after, moving) > 0
    way = np.linalg.norm(after - moving.points, axis=1)
    assert way[: moving.offsets[2]].max() < 1e-3
    assert way[moving.offsets[2] :].max() > 0.02


# ---- bundles ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 1])
def test_a_bundle_that_is_too_tight_widens(seed):
    moving = tubes(bundle(seed))
    assert room(moving.points, moving) < -0.05
    after = pushed(moving)
    assert room(after, moving) > 0
    assert np.linalg.norm(after - moving.points, axis=1).max() < 0.2
    assert sharpest_turn(after, moving.offsets) < 6.0
    sizes = np.linalg.norm(np.diff(after, axis=0), axis=1)
    assert np.delete(sizes, moving.offsets[1:-1] - 1) == pytest.approx(STEP, abs=0.03)


def test_strands_make_way_in_captured_hair_that_stands_still():
    side = np.arange(5) * 0.24
    still = tubes([line((x, 0, z), half_mm=3.0) for x in side for z in side])
    rng = np.random.default_rng(2)
    moving = tubes([line((x, 0, z), (*rng.normal(0, 0.01, 1), 1, 0), 3.0) for x, z in rng.uniform(0.1, 0.86, (8, 2))], first=25)
    assert room(moving.points, moving, still) < -0.03
    before = still.points.copy()
    after = pushed(moving, still)
    assert room(after, moving, still) > 0
    assert np.array_equal(still.points, before)


def test_what_is_given_is_not_changed():
    moving, still = tubes(bundle()[:6]), tubes([line((0, 0, 0.02))], first=6)
    copies = [array.copy() for array in (*moving, *still)]
    pushed(moving, still)
    assert all(np.array_equal(a, b) for a, b in zip((*moving, *still), copies, strict=True))


def test_the_result_does_not_depend_on_the_number_of_threads():
    moving, still = tubes(bundle()), tubes([line((0.1, 0, 0.1), (0.02, 1, 0))], first=25)
    params = ApartParams(rounds=40, smooth_rounds=20)
    one = pushed(moving, still, params=params)
    numba.set_num_threads(min(2, numba.config.NUMBA_NUM_THREADS))
    assert pushed(moving, still, params=params).tobytes() == one.tobytes()


def test_where_there_is_no_room_all_stays_finite():
    moving = tubes([line((0, 0, 1e-4 * k), (0, 1, 1e-3 * k), 2.0) for k in range(30)])
    after = pushed(moving, params=ApartParams(rounds=40))
    assert np.isfinite(after).all()
    assert np.abs(after - moving.points).max() < 3.0


def test_nothing_to_move():
    assert pushed(NOTHING, tubes([line((0, 0, 0))])).shape == (0, 3)
    moving = tubes(bundle()[:4])
    assert np.array_equal(pushed(moving, params=ApartParams(rounds=0)), moving.points)


# ---- ends that are held ----------------------------------------------------------------------------------------------


def test_held_ends_keep_their_place():
    moving = tubes([line((0, 0, 0)), line((0, 0, 0.02))])
    after = pushed(moving, held=[[True, True], [True, False]])
    ends = [0, moving.offsets[1] - 1, moving.offsets[1]]
    assert np.abs(after - moving.points)[ends].max() < 1e-9


def test_a_strand_makes_way_behind_an_end_that_is_held():
    still, moving = tubes([line((0, 0, 0))]), tubes([line((0, 0, 0.02))], first=1)
    after = pushed(moving, still, [[True, False]])
    way = np.linalg.norm(after - moving.points, axis=1)
    assert np.all(way[10:] > 2 * RADIUS - 0.02)  # 2 mm from there it is as free as any
    apart = np.linalg.norm(after[:, [0, 2]], axis=1)
    assert np.all(apart[5:] > 2 * RADIUS)
    assert sharpest_turn(after, moving.offsets) < 8.0


def test_crossings_far_from_held_ends_are_solved_as_if_none_were_held():
    moving = tubes([line((0, 0, 0)), line((0, 0, 0.02), (0.6, 0.8, 0))])
    after = pushed(moving, held=np.ones((2, 2), bool))
    assert room(after, moving) > 0
    assert np.allclose(after, pushed(moving), atol=2e-3)
    ends = np.r_[moving.offsets[:-1], moving.offsets[1:] - 1]
    assert np.abs(after - moving.points)[ends].max() < 1e-4
