"""Infill of locks that are known: hair cut short goes on, gaps are closed, hidden cores are filled, and all of it is one fiber with what was seen."""

from itertools import pairwise
from typing import NamedTuple

import numba
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from strandscope.core.advection import AdvectionParams, captured_density
from strandscope.core.apart import ApartParams
from strandscope.core.errors import StrandscopeError
from strandscope.core.hidden import EVIDENCE, found_share, seen_from
from strandscope.core.hull import Grid
from strandscope.core.infill import Captured, Infill, InfillParams, as_smooth_as, infill
from strandscope.core.neighbours import nearest_other
from strandscope.core.stops import Stop

GRID = Grid.around((-3.0, -6.0, -3.0), (3.0, 6.0, 3.0), 0.5)
CENTRES = np.stack(np.meshgrid(*(GRID.centres(a) for a in range(3)), indexing="ij"), axis=-1)
INSIDE = (2.7 - np.hypot(CENTRES[..., 0], CENTRES[..., 2])).astype(np.float32)  # distance to the surface of a lock of radius 2.7
OPEN_TO_LIGHT = np.ones(GRID.shape, np.float32)  # share of the rays that pass
DARK_CORE = np.where(np.hypot(CENTRES[..., 0], CENTRES[..., 2]) < 1.4, 0.0, 1.0).astype(np.float32)
ANGLES = np.arange(24) * 15.0
STEP, RADIUS = 0.2, 0.04  # mm
HEIGHTS = np.arange(-5.9, 5.95, STEP)
OPEN, LEFT = int(Stop.UNOBSERVED), int(Stop.LEFT_VOLUME)


class Lock(NamedTuple):
    """Hair that is known, what was captured of it, and the infill."""

    full: list  # (n, 3) each
    captured: Captured
    filled: Infill


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """The locks are so small that threads that wait for each other would take most of the time."""
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    yield
    numba.set_num_threads(threads)


# ---- locks that are known --------------------------------------------------------------------------------------------


def flat(curves):
    """A list of (n, 3) -> points, offsets."""
    return np.concatenate(curves), np.concatenate([[0], np.cumsum([len(c) for c in curves])]).astype(np.int64)


def places(count, seed):
    """Where (count, 2) hair stands in a circle of radius 2.2, 0.15 mm apart or more."""
    rng, where = np.random.default_rng(seed), np.empty((0, 2))
    while len(where) < count:
        at = rng.uniform(-2.2, 2.2, 2)
        if np.hypot(*at) < 2.2 and np.all(np.hypot(*(where - at).T) > 0.15):
            where = np.concatenate([where, [at]])
    return where


def straight(count=60, seed=0, lean=(0.1, 0.05)):
    return [np.stack([x + lean[0] * HEIGHTS, HEIGHTS, z + lean[1] * HEIGHTS], axis=1) for x, z in 0.75 * places(count, seed)]


def wavy(count=60, seed=0, height_mm=0.05):
    rng = np.random.default_rng(seed)
    phase, length = rng.uniform(0, 2 * np.pi, (count, 2)), rng.uniform(3, 5, count)
    waves = 2 * np.pi * HEIGHTS[:, None, None] / length[:, None] + phase
    return [np.stack([x + height_mm * np.sin(p[:, 0]), HEIGHTS, z + height_mm * np.sin(p[:, 1])], axis=1) for (x, z), p in _with(waves, count, seed)]


def _with(waves, count, seed):
    return zip(places(count, seed), np.moveaxis(waves, 1, 0), strict=True)


def twisted(count=60, seed=0, pitch_mm=30.0):
    turn = 2 * np.pi * HEIGHTS / pitch_mm
    cos, sin = np.cos(turn), np.sin(turn)
    return [np.stack([x * cos + z * sin, HEIGHTS, -x * sin + z * cos], axis=1) for x, z in places(count, seed)]


def told(pieces, stops, full):
    """What a capture tells of pieces, if the cameras see into the whole lock as ``seen_from`` says."""
    points, offsets = flat(pieces)
    seen = seen_from(gaussian_filter(captured_density(*flat(full), GRID), 0.3), 2 * RADIUS, GRID, ANGLES)
    evidence = map_coordinates(seen, (GRID.to_cells(points) - 0.5).T, order=1, mode="nearest") / EVIDENCE
    return Captured(points, offsets, np.full(len(points), RADIUS), np.full(len(points), 0.003), evidence, np.array(stops))


def cut_short(full, share=0.4, seed=1):
    """A share of the hair ends somewhere in the middle half, where none begins that it could be linked with; some curves run the other way."""
    rng, pieces, stops = np.random.default_rng(seed), [], []
    for curve in full:
        cut = rng.random() < share
        pieces.append(curve[: rng.integers(15, 45)] if cut else curve)
        stops.append([LEFT, OPEN if cut else LEFT])
        if rng.random() < 0.5:
            pieces[-1], stops[-1] = pieces[-1][::-1], stops[-1][::-1]
    return told(pieces, stops, full)


def with_gaps(full, points, share=0.4, seed=1):
    """So many points are missing in the middle of a share of the hair: -> captured, pairs of curves that are one fiber."""
    rng, pieces, stops, pairs = np.random.default_rng(seed), [], [], []
    for curve in full:
        if rng.random() < share:
            at = rng.integers(20, 30)
            pairs.append((len(pieces), len(pieces) + 1))
            pieces += [curve[:at], curve[at + points :]]
            stops += [[LEFT, OPEN], [OPEN, LEFT]]
        else:
            pieces.append(curve)
            stops.append([LEFT, LEFT])
    return told(pieces, stops, full), pairs


def hollow(full, seed=1):
    """Every hair is found or not as a whole, by how many cameras see it."""
    seen = seen_from(gaussian_filter(captured_density(*flat(full), GRID), 0.3), 2 * RADIUS, GRID, ANGLES)
    rng = np.random.default_rng(seed)
    share = [found_share(map_coordinates(seen, (GRID.to_cells(c) - 0.5).T, order=1, mode="nearest")).mean() for c in full]
    found = [curve for curve, chance in zip(full, share, strict=True) if rng.random() < chance]
    return told(found, [[LEFT, LEFT]] * len(found), full)


def fill(captured, through=OPEN_TO_LIGHT, **params):
    return infill(captured, INSIDE, through, GRID, ANGLES, InfillParams(**params))


@pytest.fixture(scope="module", params=[straight, wavy, twisted], ids=lambda kind: kind.__name__)
def lock(request) -> Lock:
    full = request.param()
    captured = cut_short(full)
    return Lock(full, captured, fill(captured))


# ---- what is asked of it ---------------------------------------------------------------------------------------------


def crossings(points, offsets):
    """How many curves cross each of 23 horizontal planes."""
    inner = np.delete(np.arange(len(points) - 1), offsets[1:-1] - 1)
    a, b = points[inner, 1], points[inner + 1, 1]
    return np.array([np.sum((np.minimum(a, b) < y) & (y <= np.maximum(a, b))) for y in np.linspace(-5.5, 5.5, 23)])


def together(captured, filled):
    return np.concatenate([captured.points_mm, filled.points_mm]), np.concatenate([captured.offsets, captured.offsets[-1] + filled.offsets[1:]])


def tip(points, offsets, end):
    """The points (n, 3) of a curve, from one of its ends on."""
    curve = points[offsets[end // 2] : offsets[end // 2 + 1]]
    return curve[::-1] if end % 2 else curve


def strand_of(filled, k):
    return filled.points_mm[filled.offsets[k] : filled.offsets[k + 1]]


def fiber_of(captured, filled):
    """The fiber (captured + filled curves,) of each, by the joins."""
    count = len(captured.offsets) + len(filled.offsets) - 2
    pieces = filled.joins // 2
    return connected_components(coo_array((np.ones(len(pieces)), pieces.T), shape=(count, count)), directed=False)[1]


def unjoined(captured, filled):
    """Whole fibers: numbers of the strands that no join names."""
    count = len(captured.offsets) - 1
    return np.setdiff1d(np.arange(len(filled.offsets) - 1), filled.joins.ravel() // 2 - count)


# ---- continuations ---------------------------------------------------------------------------------------------------


def test_every_open_end_is_continued_once_and_no_other(lock):
    open_ends = np.flatnonzero(lock.captured.stops.ravel() == OPEN)
    joined = lock.filled.joins.ravel()
    assert len(np.unique(joined)) == len(joined)
    assert set(joined[joined < 2 * (len(lock.captured.offsets) - 1)].tolist()) == set(open_ends.tolist())


def test_a_continuation_begins_a_step_behind_its_end_and_runs_on(lock):
    points, offsets = together(lock.captured, lock.filled)
    turns = []
    for end, other in lock.filled.joins:
        one, two = tip(points, offsets, end), tip(points, offsets, other)
        assert np.linalg.norm(two[0] - one[0]) == pytest.approx(STEP, abs=0.05)
        into, onward = one[0] - one[2], two[2] - two[0]
        turns.append(np.degrees(np.arccos(np.clip(np.dot(into, onward) / np.linalg.norm(into) / np.linalg.norm(onward), -1, 1))))
    assert np.median(turns) < 8.0
    assert max(turns) < 30.0


def test_continuations_run_to_the_bounds(lock):
    points, offsets = together(lock.captured, lock.filled)
    for _, other in lock.filled.joins:
        last = tip(points, offsets, other ^ 1)[0]
        assert abs(last[1]) > 6.0 - 2 * STEP or np.hypot(last[0], last[2]) > 3.0 - 2 * STEP


def test_as_many_fibers_cross_each_plane_as_in_truth(lock):
    ratio = crossings(*together(lock.captured, lock.filled)) / len(lock.full)
    assert np.abs(ratio - 1).max() < 0.1
    assert crossings(lock.captured.points_mm, lock.captured.offsets).min() < 0.85 * len(lock.full)


def test_infill_runs_as_the_hair_about_it(lock):
    truth, offsets = flat(lock.full)
    count = len(offsets) - 1
    all_points, all_offsets = (
        np.concatenate([lock.filled.points_mm, truth]),
        np.concatenate([lock.filled.offsets, lock.filled.offsets[-1] + offsets[1:]]),
    )
    strands = len(lock.filled.offsets) - 1
    near = nearest_other(all_points, all_offsets, np.inf, np.arange(strands + count) >= strands, np.arange(strands + count) < strands)
    angle = np.degrees(near.angle[: len(lock.filled.points_mm)])
    assert np.mean(angle) < 6.0  # of waves that swing by up to 6° and of directions told by 60 hairs
    assert np.mean(near.distance_mm[: len(angle)]) < 0.3  # in the lock: hair stands 0.5 mm apart


def test_straight_hair_goes_on_straight():
    filled = fill(cut_short(straight()))
    lean = np.array([0.1, 1, 0.05]) / np.linalg.norm([0.1, 1, 0.05])
    ways = np.array([filled.points_mm[b - 1] - filled.points_mm[a] for a, b in pairwise(filled.offsets)])
    across = np.linalg.norm(np.cross(ways, lean), axis=1) / np.linalg.norm(ways, axis=1)
    assert np.degrees(np.arcsin(across)).max() < 2.0  # over 3 to 9 mm; some make way for others


def test_strands_are_what_they_say(lock):
    filled = lock.filled
    assert filled.points_mm.dtype == filled.radius_mm.dtype == np.float32
    assert filled.offsets.dtype == filled.joins.dtype == np.int64
    assert filled.joins.shape[1] == 2
    assert filled.radius_mm.shape == (len(filled.points_mm),)
    assert np.isfinite(filled.points_mm).all()
    assert np.diff(filled.offsets).min() >= 2
    assert filled.offsets[-1] == len(filled.points_mm)
    steps = np.delete(np.linalg.norm(np.diff(filled.points_mm, axis=0), axis=1), filled.offsets[1:-1] - 1)
    assert steps == pytest.approx(STEP, abs=0.05)
    assert np.hypot(filled.points_mm[:, 0], filled.points_mm[:, 2]).max() < 3.0 + 0.1
    assert np.abs(filled.points_mm[:, 1]).max() < 6.0 + 0.1


def test_no_strand_runs_through_another(lock):
    points, offsets = together(lock.captured, lock.filled)
    near = nearest_other(points, offsets, 1.0)
    fiber, own = fiber_of(lock.captured, lock.filled), np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    through = (near.distance_mm < 0.9 * 2 * RADIUS) & (near.curve >= 0) & (fiber[near.curve] != fiber[own])
    assert through[len(lock.captured.points_mm) :].mean() <= 0.001


def test_what_was_captured_is_not_changed():
    captured = cut_short(wavy())
    copies = [np.array(values) for values in captured]
    fill(captured)
    assert all(np.array_equal(a, b) for a, b in zip(captured, copies, strict=True))


# ---- links -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "points",
    [
        1,
        2,
        4,
        6,
    ],
)
@pytest.mark.parametrize("kind", [straight, twisted])
def test_gaps_are_closed_and_both_sides_are_one_fiber(kind, points):
    full = kind()
    captured, pairs = with_gaps(full, points)
    filled = fill(captured)
    fiber = fiber_of(captured, filled)
    whole = sum(fiber[one] == fiber[other] for one, other in pairs)
    assert whole > 0.85 * len(pairs)
    assert len(np.unique(fiber)) == pytest.approx(len(full), rel=0.1)
    assert np.abs(crossings(*together(captured, filled)) / len(full) - 1).max() < 0.1


def test_pieces_that_run_past_each_other_are_one_fiber():
    full, pieces, stops = straight(30), [], []
    for k, curve in enumerate(full):
        pieces += [curve[:30], curve[28:] + np.array([0.01, 0.0, 0.0])] if k < 6 else [curve]
        stops += [[LEFT, OPEN], [OPEN, LEFT]] if k < 6 else [[LEFT, LEFT]]
    captured = told(pieces, stops, full)
    fiber = fiber_of(captured, fill(captured))
    assert sum(fiber[2 * k] == fiber[2 * k + 1] for k in range(6)) >= 5


# ---- whole hidden fibers ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def core() -> Lock:
    full = wavy(160, height_mm=0.03)
    captured = hollow(full)
    return Lock(full, captured, fill(captured, DARK_CORE))


def test_a_hidden_core_is_filled_with_as_many_fibers_as_are_missing(core):
    found, added = len(core.captured.offsets) - 1, len(core.filled.offsets) - 1
    assert found < 0.93 * len(core.full)
    assert found + added == pytest.approx(len(core.full), rel=0.1)
    assert len(core.filled.joins) == 0
    assert np.abs(crossings(*together(core.captured, core.filled)) / len(core.full) - 1).max() < 0.1
    assert np.median(np.hypot(core.filled.points_mm[:, 0], core.filled.points_mm[:, 2])) < 1.1  # half of the lock's radius


def test_whole_fibers_run_from_bound_to_bound(core):
    for k in range(len(core.filled.offsets) - 1):
        strand = strand_of(core.filled, k)
        assert np.abs(strand[[0, -1], 1]).min() > 6.0 - 2 * STEP or np.hypot(strand[:, 0], strand[:, 2]).max() > 3.0 - 2 * STEP


@pytest.mark.parametrize("count", [0, 1, 7])
def test_a_count_that_is_given_is_that_of_whole_fibers(count):
    captured = cut_short(wavy())
    filled = fill(captured, count=count)
    assert len(unjoined(captured, filled)) == count
    assert len(filled.joins) == (captured.stops == OPEN).sum()


def test_thin_hair_that_was_found_whole_needs_no_infill():
    full = wavy(40)
    filled = fill(told(full, [[LEFT, LEFT]] * 40, full))
    assert (len(filled.points_mm), filled.offsets.tolist(), filled.joins.shape) == (0, [0], (0, 2))
    assert filled.points_mm.shape == (0, 3)


def test_radii_are_those_of_the_fiber_or_of_captured_ones():
    captured = cut_short(wavy())
    thickness = np.random.default_rng(4).choice([0.03, 0.035, 0.05], len(captured.offsets) - 1)
    captured = captured._replace(radius_mm=np.repeat(thickness, np.diff(captured.offsets)))
    filled = fill(captured, count=10)
    count = len(thickness)
    radius = filled.radius_mm[filled.offsets[:-1]]
    assert np.array_equal(np.repeat(radius, np.diff(filled.offsets)), filled.radius_mm)
    for end, other in filled.joins:
        assert radius[other // 2 - count] == pytest.approx(thickness[end // 2], rel=1e-5)
    assert set(np.round(radius.astype(float), 5).tolist()) <= {0.03, 0.035, 0.05}


# ---- the same again --------------------------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_strands_on_any_number_of_threads():
    captured = cut_short(wavy(30))

    def few(seed=0):  # of all that threads wait for each other in
        params = InfillParams(count=5, seed=seed, apart=ApartParams(rounds=10, smooth_rounds=5), advection=AdvectionParams(cycles=1))
        return infill(captured, INSIDE, OPEN_TO_LIGHT, GRID, ANGLES[::8], params)

    one, again, other = few(), few(), few(seed=1)
    numba.set_num_threads(min(2, numba.config.NUMBA_NUM_THREADS))
    two = few()
    numba.set_num_threads(1)
    for a, b, c in zip(one, again, two, strict=True):
        assert a.tobytes() == b.tobytes() == c.tobytes()
    assert len(other.offsets) == len(one.offsets)
    assert other.points_mm.tobytes() != one.points_mm.tobytes()


def test_progress_is_told_to_the_end():
    said = []
    infill(cut_short(straight(20)), INSIDE, OPEN_TO_LIGHT, GRID, ANGLES, InfillParams(count=0), lambda *event: said.append(event))
    names, done, of = zip(*said, strict=True)
    assert set(names) == {"infill"}
    assert list(done) == sorted(done)
    assert done[-1] == of[-1]


GOOD = Captured(
    np.concatenate([np.stack([0 * HEIGHTS + k, HEIGHTS, 0 * HEIGHTS], axis=1) for k in (0, 1)]),
    np.array([0, 60, 120]),
    np.full(120, RADIUS),
    np.full(120, 0.003),
    np.full(120, 10.0),
    np.full((2, 2), LEFT),
)


@pytest.mark.parametrize(
    ("change", "distance", "words"),
    [
        ({"points_mm": np.empty((0, 3)), "offsets": [0]}, INSIDE, "no captured curves"),
        ({"points_mm": GOOD.points_mm[:, :2]}, INSIDE, "no captured curves"),
        ({"offsets": [0, 60, 119]}, INSIDE, "no captured curves"),
        ({"offsets": [0, 119, 120]}, INSIDE, "2 points or more"),
        pytest.param({"offsets": [2, 60, 120]}, INSIDE, "no captured curves"),
        ({"radius_mm": np.full(2, RADIUS)}, INSIDE, r"radius_mm has shape \(2,\); expected \(120,\)"),
        ({"error_mm": np.zeros(119)}, INSIDE, "error_mm has shape"),
        ({"evidence": np.zeros((120, 1))}, INSIDE, "evidence has shape"),
        ({"stops": np.zeros(4)}, INSIDE, r"stops has shape \(4,\); expected \(2, 2\)"),
        ({}, INSIDE[1:], "the distance to the surface has shape"),
        ({}, 0 * INSIDE - 1, "no voxel lies inside"),
        ({"points_mm": GOOD.points_mm + 100}, INSIDE, "no captured curve runs through the volume"),
    ],
)
def test_bad_input_is_an_error_in_words(change, distance, words):
    with pytest.raises(StrandscopeError, match=words) as error:
        infill(GOOD._replace(**change), distance, OPEN_TO_LIGHT, GRID, ANGLES)
    assert len(str(error.value).splitlines()) == 1


# ---- smoothing -------------------------------------------------------------------------------------------------------


def roughness(curves):
    """Mean third difference over 0.4 mm: how fast curvature changes."""
    return np.mean(np.concatenate([np.linalg.norm(c[6:] - 3 * c[4:-2] + 3 * c[2:-4] - c[:-6], axis=1) for c in curves]))


def test_rough_strands_become_as_smooth_as_what_was_captured():
    smooth = wavy(20)
    rng = np.random.default_rng(5)
    rough = [c + rng.normal(0, 0.01, c.shape) for c in wavy(20, seed=1)]
    done = as_smooth_as(*flat(smooth), rough, [np.empty((0, 3))] * 20, STEP)
    assert roughness(rough) > 2 * roughness(smooth)
    assert roughness(done) == pytest.approx(roughness(smooth), rel=0.35)
    assert max(np.abs(a - b).max() for a, b in zip(done, rough, strict=True)) < 0.06
    for a, b in zip(done, rough, strict=True):
        assert np.allclose(a[[0, -1]], b[[0, -1]], atol=1e-9)  # ends that are free keep their place


def test_strands_that_are_smooth_stay():
    strands = straight(5)
    done = as_smooth_as(*flat(wavy(20)), strands, [np.empty((0, 3))] * 5, STEP)
    assert all(np.array_equal(a, b) for a, b in zip(done, strands, strict=True))


def test_a_strand_is_smoothed_with_what_is_before_it():
    line = HEIGHTS[:, None] * [0.0, 1.0, 0.0]
    kinked = line[30:] + np.array([0.05, 0.0, 0.0])
    rng = np.random.default_rng(6)
    others = [c + rng.normal(0, 0.02, c.shape) for c in straight(5)]
    done = as_smooth_as(*flat(straight(20)), [kinked, *others], [line[18:30]] + [np.empty((0, 3))] * 5, STEP)[0]
    assert done.shape == kinked.shape
    assert 0.0 < done[0, 0] < 0.045  # drawn towards the curve that it goes on behind
    assert done[-1] == pytest.approx(kinked[-1])
