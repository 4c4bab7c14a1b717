"""Infill against fields whose solution is known: linear and harmonic ones, helices, parallel hair with a hollow core."""

from itertools import pairwise

import numba
import numpy as np
import pytest

from strandscope.core.advection import AdvectionParams, advect, captured_density, curve_signs, direction_field, missing_density
from strandscope.core.errors import StrandscopeError
from strandscope.core.hull import Grid

GRID = Grid.around((-3.0, -3.0, -3.0), (3.0, 3.0, 3.0), 0.25)
EVERYWHERE = np.ones(GRID.shape, np.float32)


def centres(grid=GRID):
    return np.stack(np.meshgrid(*(grid.centres(a) for a in range(3)), indexing="ij"), axis=-1)


def flat(curves):
    """A list of (n, 3) -> points, offsets."""
    return np.concatenate(curves), np.concatenate([[0], np.cumsum([len(c) for c in curves])])


def parallel_hair(where, step_mm=0.1):
    """Vertical hair through (x, z) of where (n, 2)."""
    y = np.arange(-2.95, 2.96, step_mm)
    return flat([np.stack([np.full_like(y, x), y, np.full_like(y, z)], axis=1) for x, z in where])


def helices(pitch_mm=6.0):
    """Concentric helices about y that fill the cylinder of radius 2.8, of one pitch."""
    turn = np.linspace(-np.pi, np.pi, 200)
    curves = []
    for radius in np.arange(0.3, 2.9, 0.25):
        for phase in np.arange(0, 2 * np.pi, 0.25 / radius):
            curves.append(np.stack([radius * np.cos(turn + phase), turn / (2 * np.pi) * pitch_mm, radius * np.sin(turn + phase)], axis=1))
    return flat(curves)


def reverse_some(points, offsets, seed=0):
    rng = np.random.default_rng(seed)
    return np.concatenate([points[a:b][:: rng.choice([-1, 1])] for a, b in pairwise(offsets)])


# ---- directions ------------------------------------------------------------------------------------------------------


def test_directions_do_not_depend_on_where_a_curve_begins():
    points, offsets = helices()
    field = direction_field(points, offsets, GRID)
    assert np.allclose(field, direction_field(reverse_some(points, offsets), offsets, GRID), atol=1e-5)


def test_neighbours_run_the_same_way_even_where_hair_lies_flat():
    rng = np.random.default_rng(5)
    x = np.linspace(-2.9, 2.9, 60)
    curves = [np.stack([x, y + rng.normal(0, 0.02) * x, np.full_like(x, z)], axis=1) for y, z in rng.uniform(-2, 2, (60, 2))]
    points, offsets = flat(curves)
    headings = np.sign(points[offsets[1:] - 1] - points[offsets[:-1]])[:, 0] * curve_signs(points, offsets, GRID)
    assert abs(headings.sum()) == len(headings)


def test_field_is_the_mean_tangent_and_fills_the_gap():
    rng = np.random.default_rng(6)
    where = rng.uniform(-2.9, 2.9, (300, 2))
    points, offsets = parallel_hair(where[np.hypot(*where.T) > 1.2])
    points = points @ np.array([[1, 0, 0], [0.2, 1, 0], [0, 0, 1]])  # all lean the same way
    field = direction_field(points, offsets, GRID, EVERYWHERE)
    expected = -np.array([0.2, 1, 0]) / np.hypot(0.2, 1)
    assert np.abs(field - expected).max() < 0.01


def test_solving_is_bounded_to_a_margin():
    points, offsets = parallel_hair([(0.0, 0.0)])
    field = direction_field(points, offsets, GRID, None, AdvectionParams(margin_mm=1.0))
    size = np.linalg.norm(field, axis=-1)
    radius = np.maximum(np.abs(centres()[..., 0]), np.abs(centres()[..., 2]))
    assert np.all(size[radius > 1.5] == 0)
    assert np.all(size[(radius < 0.8)] > 0.99)


# ---- strands ---------------------------------------------------------------------------------------------------------


def test_infill_follows_a_helix():
    pitch = 6.0
    points, offsets = helices(pitch)
    grown = advect(points, offsets, np.full(len(offsets) - 1, 0.04), EVERYWHERE, GRID, AdvectionParams(count=40, step_mm=0.05))
    assert len(grown.offsets) == 41
    for a, b in pairwise(grown.offsets):
        x, y, z = grown.points_mm[a:b].T
        radius = np.hypot(x, z)
        if not 1.0 < np.median(radius) < 2.5:
            continue  # near the axis a voxel holds many directions, beyond the helices there are none
        middle = np.abs(y) < 2.5
        assert np.ptp(radius[middle]) < 0.12  # half a voxel over a turn
        turn = np.unwrap(np.arctan2(z, x))[middle]
        assert np.polyfit(turn, y[middle], 1)[0] == pytest.approx(pitch / (2 * np.pi), rel=0.04)


def test_steps_have_the_step_length_and_strands_reach_the_bounds():
    points, offsets = parallel_hair([(x, z) for x in (-1.0, 1.0) for z in (-1.0, 1.0)])
    grown = advect(points, offsets, np.full(4, 0.04), EVERYWHERE, GRID, AdvectionParams(count=20, step_mm=0.1))
    steps = np.linalg.norm(np.diff(grown.points_mm, axis=0), axis=1)
    steps = np.delete(steps, grown.offsets[1:-1] - 1)
    assert np.allclose(steps, 0.1, atol=1e-4)
    ends = np.abs(grown.points_mm[np.r_[grown.offsets[:-1], grown.offsets[1:] - 1], 1])
    assert ends.min() > 2.89
    assert ends.max() <= 3.0


def test_a_strand_that_leaves_the_hull_is_dropped():
    x = np.linspace(-2.95, 2.95, 60)
    points, offsets = flat([np.stack([x, np.full_like(x, y), np.full_like(x, z)], axis=1) for y in (-1, 0, 1) for z in (-1, 0, 1)])
    half = np.where(centres()[..., 0] < 0, 1.0, 0.0).astype(np.float32)
    strict = advect(points, offsets, np.full(9, 0.04), half, GRID, AdvectionParams(count=10, min_mean_density=0.6, max_failures=5))
    assert strict.accepted == len(strict.offsets) - 1 == 0
    assert strict.rejected >= 50
    lenient = advect(points, offsets, np.full(9, 0.04), half, GRID, AdvectionParams(count=10, min_mean_density=0.4))
    assert (lenient.accepted, lenient.rejected) == (10, 0)


def hollow_lock(seed=7, per_mm2=9.0):
    """Hair of known density in a cylinder of radius 2.4, captured beyond 1.2: where (n, 2), which was captured."""
    rng = np.random.default_rng(seed)
    side = np.arange(-3.0, 3.0, per_mm2**-0.5)
    where = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2) + rng.uniform(-0.08, 0.08, (len(side) ** 2, 2))
    radius = np.hypot(*where.T)
    return where[radius < 2.4], (radius > 1.2)[radius < 2.4]


def test_hollow_core_is_filled_to_the_density_around_it():
    where, seen = hollow_lock()
    points, offsets = parallel_hair(where[seen])
    occupancy = (np.hypot(centres()[..., 0], centres()[..., 2]) < 2.4).astype(np.float32)
    grown = advect(points, offsets, np.full(seen.sum(), 0.04), occupancy, GRID)
    hidden = (~seen).sum()
    assert hidden * 0.75 < grown.accepted < hidden * 1.35  # 41 strands hidden
    radius = np.hypot(grown.points_mm[:, 0], grown.points_mm[:, 2])
    assert (radius < 1.6).mean() > 0.8


def test_densities_are_fibers_per_square_mm():
    where, _ = hollow_lock(per_mm2=9.0)
    points, offsets = parallel_hair(where)
    density = captured_density(points, offsets, GRID)
    length = len(where) * 5.9
    assert density.sum() * GRID.voxel_mm**3 == pytest.approx(length, rel=1e-3)
    radius = np.hypot(centres()[..., 0], centres()[..., 2])
    assert density[radius < 1.8].mean() == pytest.approx(9.0, rel=0.1)
    missing = missing_density(density, (radius < 2.4).astype(np.float32), GRID)
    assert missing.sum() < 0.25 * density.sum()  # hair fluctuates, and full is a high quantile
    assert missing[radius >= 2.4].max() == 0.0


def test_the_same_seed_gives_the_same_strands_on_any_number_of_threads():
    points, offsets = helices()
    radii = np.random.default_rng(8).uniform(0.03, 0.05, len(offsets) - 1)
    arguments = points, offsets, radii, EVERYWHERE, GRID
    threads = numba.get_num_threads()
    many = advect(*arguments, AdvectionParams(count=30))
    try:
        numba.set_num_threads(1)
        one = advect(*arguments, AdvectionParams(count=30))
    finally:
        numba.set_num_threads(threads)
    assert all(np.array_equal(a, b) for a, b in zip(many, one, strict=True))
    other = advect(*arguments, AdvectionParams(count=30, seed=1))
    assert len(other.offsets) == len(many.offsets)
    assert not np.array_equal(other.points_mm[other.offsets[:-1]], many.points_mm[many.offsets[:-1]])


def test_radius_is_that_of_a_captured_curve():
    points, offsets = parallel_hair([(-1.0, 0.0), (1.0, 0.0)])
    per_point = np.repeat([0.03, 0.05], np.diff(offsets))
    for radii in (np.array([0.03, 0.05]), per_point):
        grown = advect(points, offsets, radii, EVERYWHERE, GRID, AdvectionParams(count=40))
        assert grown.radius_mm.shape == (len(grown.points_mm),)
        assert grown.radius_mm.dtype == grown.points_mm.dtype == np.float32
        first = grown.radius_mm[grown.offsets[:-1]]
        assert set(np.round(first, 4).tolist()) == {np.float32(0.03).round(4).item(), np.float32(0.05).round(4).item()}


def test_no_strands_where_none_are_wanted():
    points, offsets = parallel_hair([(0.0, 0.0)])
    none = advect(points, offsets, [0.04], EVERYWHERE, GRID, AdvectionParams(count=0))
    assert len(none.points_mm) == 0
    assert none.offsets.tolist() == [0]


def test_progress_is_told_to_the_end():
    told = []
    points, offsets = parallel_hair([(0.0, 0.0)])
    advect(points, offsets, [0.04], EVERYWHERE, GRID, AdvectionParams(count=5), lambda *event: told.append(event))
    assert told[-1] == ("infill", 5, 5)


@pytest.mark.parametrize(
    ("points", "offsets", "radii", "occupancy", "words"),
    [
        (np.empty((0, 3)), [0], [], EVERYWHERE, "no captured curves"),
        (np.zeros((4, 3)), [0, 3], [0.04], EVERYWHERE, "offsets do not fit 4 points"),
        (np.zeros((4, 3)), [0, 4], [0.04, 0.04], EVERYWHERE, "radii have shape"),
        (np.zeros((4, 3)), [0, 4], [0.04], 0 * EVERYWHERE, "occupancy is below 0.5 everywhere"),
        (np.zeros((4, 3)), [0, 4], [0.04], EVERYWHERE[1:], "expected the grid's"),
        (np.full((4, 3), 9.0) * [[1], [2], [3], [4]], [0, 4], [0.04], EVERYWHERE, "no captured curve runs through the volume"),
    ],
)
def test_bad_input_is_an_error_in_words(points, offsets, radii, occupancy, words):
    with pytest.raises(StrandscopeError, match=words):
        advect(points, offsets, radii, occupancy, GRID)
