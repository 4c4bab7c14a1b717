"""Where hair is, for hair whose surface is known: single fibers, full and hollow cylinders, cores that cameras do and do not see into."""

import numba
import numpy as np
import pytest

from strandscope.core.advection import captured_density
from strandscope.core.errors import StrandscopeError
from strandscope.core.grid import Grid, occupied
from strandscope.core.inside import InsideParams, surface_distance

GRID = Grid.around((-5.0, -1.5, -5.0), (5.0, 1.5, 5.0), 0.25)
ANGLES = np.arange(24) * 15.0
PARAMS = InsideParams()
FAR = PARAMS.about_mm + 2 * PARAMS.edge_mm  # the distance is told up to this far outside
CENTRES = np.stack(np.meshgrid(*(GRID.centres(a) for a in range(3)), indexing="ij"), axis=-1)
RADIUS = np.hypot(CENTRES[..., 0], CENTRES[..., 2])
NO_BOUNDS = np.zeros(GRID.shape, np.float32)


@pytest.fixture(autouse=True)
def one_thread():
    """The views are so small that threads that wait for each other would take most of the time."""
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    yield
    numba.set_num_threads(threads)


def within(radius_mm):
    return (radius_mm > RADIUS).astype(np.float32)


def vertical(where, step_mm=0.125):
    """Vertical hair through (x, z) of where (n, 2), beyond both bounds of the grid -> points, offsets."""
    y = np.arange(-2.4375, 2.5, step_mm)
    points = np.stack(np.broadcast_arrays(where[:, :1], y, where[:, 1:]), axis=-1)
    return points.reshape(-1, 3), np.arange(len(where) + 1) * len(y)


def ring(inner_mm, outer_mm, per_mm2):
    """Where (n, 2) even hair stands between two radii."""
    side = np.arange(-outer_mm - 0.5, outer_mm + 0.5, per_mm2**-0.5)
    where = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    radius = np.hypot(*where.T)
    return where[(radius >= inner_mm) & (radius <= outer_mm)]


def surface(where, bounds=NO_BOUNDS, diameter_mm=0.08, params=None):
    points, offsets = vertical(np.asarray(where, float))
    return surface_distance(points, captured_density(points, offsets, GRID), bounds, diameter_mm, GRID, ANGLES, params)


def test_about_one_fiber_the_surface_is_a_tube():
    distance = surface([(0.3, -0.4)])
    away = np.hypot(CENTRES[..., 0] - 0.3, CENTRES[..., 2] + 0.4)
    assert distance.dtype == np.float32
    assert np.abs(distance - (PARAMS.about_mm - np.minimum(away, FAR))).max() < 0.03  # points stand 0.125 mm apart


def test_the_nearest_fiber_tells():
    where = [(-1.0, 0.0), (1.5, 1.0), (2.0, -3.0)]
    apart = np.maximum.reduce([surface([at]) for at in where])
    assert np.allclose(surface(where), apart, atol=1e-6)


def test_a_full_cylinder_of_hair_has_its_surface_about_its_outermost_hair():
    distance = surface(ring(0, 3.0, 9.0), within(3.0))
    off = distance - (3.0 + PARAMS.about_mm - RADIUS)
    near = np.abs(RADIUS - 3.5) < 0.5
    assert np.abs(off)[near].max() < 0.33  # hair stands that far apart: its rim is as rough
    assert np.abs(off)[near].mean() < 0.15
    assert distance[RADIUS < 3.0].min() > 0.2


def test_a_core_that_no_camera_sees_is_inside():
    hair, bounds = ring(2.0, 3.5, 25.0), within(4.0)
    assert surface(hair)[RADIUS < 1.0].max() < -0.4  # the captured hair alone is hollow
    distance = surface(hair, bounds)
    assert distance[RADIUS < 2.0].min() > 0.0
    assert np.abs(distance - (4.0 - RADIUS))[np.abs(RADIUS - 4.0) < 0.3].max() < 0.35  # its surface is that of the captured hair as before
    assert np.array_equal(np.sign(distance)[RADIUS > 3.5], np.sign(surface(hair))[RADIUS > 3.5])


def test_a_core_that_cameras_see_into_is_hollow():
    hair, bounds = ring(2.5, 3.5, 1.0), within(4.0)
    distance = surface(hair, bounds)
    assert np.allclose(distance, surface(hair), atol=1e-6)
    assert distance[RADIUS < 1.5].max() < 0.0


def test_a_volume_that_is_too_wide_is_not_hair_where_cameras_see():
    distance = surface(ring(1.0, 2.0, 36.0), within(4.5))
    assert distance[(RADIUS > 2.8) & (RADIUS < 4.5)].max() < 0.0


def test_near_the_bounds_is_air_even_where_no_camera_sees():
    hair, bounds = ring(2.8, 3.5, 36.0), within(4.0) - within(1.0)  # a hole that the volume tells of, and that no camera sees into
    near, deep = (RADIUS > 1.15) & (RADIUS < 1.6), (RADIUS > 2.0) & (RADIUS < 3.5)
    distance = surface(hair, bounds, params=InsideParams(air_mm=0.8))
    assert distance[near].max() < 0.0
    assert distance[deep].min() > 0.0
    trusted = surface(hair, bounds, params=InsideParams(air_mm=0.0))
    assert trusted[near].min() > 0.0
    assert trusted[RADIUS < 0.8].max() < 0.0


def test_the_volume_goes_on_beyond_the_ends_of_the_grid():
    distance = surface(ring(2.0, 3.5, 25.0), within(4.0))
    assert np.abs(distance - distance[:, 6:7])[RADIUS < 3.5].max() < 0.02


def test_how_deep_the_core_lies_is_told():
    hair, bounds = ring(2.2, 3.5, 30.0), within(4.0)
    distance = surface(hair, bounds)
    depth = distance[20, 6, 20]
    assert depth > 1.5  # mm from the surface of what is trusted, at the axis
    line = distance[20:, 6, 20]
    steps = np.diff(line)
    assert np.all(np.abs(steps) < 2.2 * GRID.voxel_mm)  # a distance changes by what one moves; both kinds together by a little more


def test_occupancy_is_a_smooth_step_about_the_surface():
    assert occupied(np.zeros(3)) == pytest.approx(0.5)
    place = np.linspace(-1, 1, 401)
    share = occupied(place, 0.4)
    assert share.dtype == np.float32
    assert np.all(np.diff(share) >= 0)
    assert np.all(share[place <= -0.2] == 0)
    assert np.all(share[place >= 0.2001] == 1)
    assert share + share[::-1] == pytest.approx(np.ones(401), abs=1e-6)
    assert np.gradient(share, place).max() == pytest.approx(1.5 / 0.4, rel=0.01)


def test_bounds_of_another_shape_are_an_error_in_words():
    points, offsets = vertical(np.zeros((1, 2)))
    density = captured_density(points, offsets, GRID)
    with pytest.raises(StrandscopeError, match="the bounding volume has shape"):
        surface_distance(points, density, NO_BOUNDS[1:], 0.08, GRID, ANGLES)
    with pytest.raises(StrandscopeError, match="the density has shape"):
        surface_distance(points, density[1:], NO_BOUNDS, 0.08, GRID, ANGLES)
