"""How many cameras see into hair of known density, in closed form and against a plain integration; and hair that none of them found."""

import numba
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from strandscope.core.errors import StrandscopeError
from strandscope.core.hidden import CLEAR, EVIDENCE, FOUND, SEEN_BY, SOFT, found_share, hidden, seen_from
from strandscope.core.hull import Grid

DIAMETER = 0.08  # mm
GRID = Grid.around((-5.0, -0.5, -5.0), (5.0, 0.5, 5.0), 0.25)
ANGLES = np.arange(24) * 15.0


@pytest.fixture(autouse=True)
def one_thread():
    """The views are so small that threads that wait for each other would take most of the time."""
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    yield
    numba.set_num_threads(threads)


def centres(grid=GRID):
    return np.stack(np.meshgrid(*(grid.centres(a) for a in range(3)), indexing="ij"), axis=-1)


RADIUS = np.hypot(centres()[..., 0], centres()[..., 2])


def cylinder(radius_mm=4.0, per_mm2=6.0, core_mm=0.0, core_per_mm2=0.0):
    """(nx, ny, nz) mm/mm³: hair of even density about the axis, and a core of another; its rim is as sharp as a voxel."""
    share = np.clip((radius_mm - RADIUS) / GRID.voxel_mm + 0.5, 0, 1)
    return (share * np.where(core_mm > RADIUS, core_per_mm2, per_mm2)).astype(np.float32)


def sees(light):
    """Whether an angle sees a place that so much of its light comes from, 0 … 1, by definition."""
    return 1 / (1 + np.exp((CLEAR - np.asarray(light)) / SOFT))


def lumps(seed=1, scale=20.0):
    """Smooth density without any symmetry."""
    rng = np.random.default_rng(seed)
    total = np.zeros(GRID.shape)
    for at, size in zip(rng.uniform(-3, 3, (12, 3)) * (1, 0.1, 1), rng.uniform(0.6, 1.5, 12), strict=True):
        total += np.exp(-0.5 * np.sum((centres() - at) ** 2, axis=-1) / size**2)
    return (scale * total / total.max()).astype(np.float32)


# ---- seen from -------------------------------------------------------------------------------------------------------


def test_without_hair_every_angle_sees_every_place():
    assert seen_from(np.zeros(GRID.shape, np.float32), DIAMETER, GRID, ANGLES) == pytest.approx(np.full(GRID.shape, 24 * sees(1.0)))


@pytest.mark.parametrize(("angle_deg", "axis", "towards"), [(0, 2, 1), (180, 2, -1), (90, 0, -1), (270, 0, 1)])
def test_a_slab_dims_what_is_behind_it_as_beer_and_lambert_tell(angle_deg, axis, towards):
    per_mm2, half_mm = 8.0, 2.0
    w = towards * centres()[..., axis]  # towards the camera: w = −x sin + z cos
    density = np.where(np.abs(w) < half_mm, per_mm2, 0.0).astype(np.float32)
    found = seen_from(density, DIAMETER, GRID, [angle_deg])
    depth_mm = half_mm - np.clip(w, -half_mm, half_mm)
    aside = np.abs(centres()[..., 2 - axis]) < 4.5  # rays beyond the grid's rim pass beside the slab
    assert np.abs(found - sees(np.exp(-per_mm2 * DIAMETER * depth_mm)))[aside].max() < 0.03  # a third of a voxel at the steepest
    assert found[w > 2.5].min() > 0.99
    assert found[aside & (w < -2.5)].max() < 0.02


@pytest.mark.parametrize("angle_deg", [0, 17, 45, 101, 200, 333])
def test_a_cylinder_in_closed_form_from_any_angle(angle_deg):
    radius_mm, per_mm2 = 3.0, 4.0
    theta = np.radians(angle_deg)
    x, z = centres()[..., 0], centres()[..., 2]
    u, w = x * np.cos(theta) + z * np.sin(theta), -x * np.sin(theta) + z * np.cos(theta)
    chord = np.sqrt(np.maximum(radius_mm**2 - u**2, 0))
    depth = per_mm2 * DIAMETER * np.clip(chord - w, 0, 2 * chord)
    found = seen_from(cylinder(radius_mm, per_mm2), DIAMETER, GRID, [angle_deg])
    error = np.abs(found - sees(np.exp(-depth)))[np.hypot(u, w) < 4.5]
    rim = np.abs(np.abs(u[np.hypot(u, w) < 4.5]) - radius_mm) < 1.5 * GRID.voxel_mm  # there a chord begins at once
    assert error[~rim].max() < 0.1  # at the steepest, that is what half a voxel of hair takes away
    assert error.mean() < 0.01


def test_the_kernel_agrees_with_a_plain_integration():
    density, rng = lumps(), np.random.default_rng(2)
    picked = rng.integers(0, GRID.shape, (60, 3))
    at = centres()[tuple(picked.T)]
    expected = np.zeros(len(at))
    step = 0.02
    for theta in np.radians(ANGLES[::3] + 4.0):
        ahead = np.arange(0.5 * step, 15.0, step)[:, None] * np.array([-np.sin(theta), 0.0, np.cos(theta)])
        cells = GRID.to_cells(at[:, None] + ahead) - 0.5
        light = np.exp(-DIAMETER * step * map_coordinates(density, np.moveaxis(cells, -1, 0), order=1, mode="constant").sum(axis=1))
        expected += sees(light)
    found = seen_from(density, DIAMETER, GRID, ANGLES[::3] + 4.0)[tuple(picked.T)]
    assert np.ptp(expected) > 3
    assert np.abs(found - expected).max() < 0.15  # of 8 angles


def test_hair_and_cameras_turned_together_see_the_same():
    density = lumps()
    found = seen_from(density, DIAMETER, GRID, ANGLES[:3] + 7.0)
    # right-handed about +y, as the turntable turns: z towards x, (x, z) -> (z, −x), and the cameras that follow look from 90° less
    turned = np.ascontiguousarray(np.rot90(density, 1, axes=(2, 0)))
    assert turned[3, 2, 30] == density[39 - 30, 2, 3]
    again = seen_from(turned, DIAMETER, GRID, ANGLES[:3] + 7.0 - 90.0)
    back = np.rot90(again, -1, axes=(2, 0))
    other = np.rot90(seen_from(turned, DIAMETER, GRID, ANGLES[:3] + 7.0 + 90.0), -1, axes=(2, 0))
    errors = np.abs(back - found).max(), np.abs(other - found).max()
    assert min(errors) < 1e-3
    assert max(errors) > 0.5


def test_layers_do_not_dim_each_other():
    density = lumps()
    alone = np.zeros_like(density)
    alone[:, 1] = density[:, 1]
    both, one = seen_from(density, DIAMETER, GRID, ANGLES[:4]), seen_from(alone, DIAMETER, GRID, ANGLES[:4])
    assert np.array_equal(both[:, 1], one[:, 1])
    assert one[:, 2] == pytest.approx(np.full_like(one[:, 2], 4 * sees(1.0)))


def test_angles_add_up_and_more_hair_is_seen_less():
    density = lumps()
    both = seen_from(density, DIAMETER, GRID, ANGLES[:6])
    assert both == pytest.approx(seen_from(density, DIAMETER, GRID, ANGLES[:2]) + seen_from(density, DIAMETER, GRID, ANGLES[2:6]), abs=1e-5)
    assert np.all(seen_from(2 * density, DIAMETER, GRID, ANGLES[:6]) <= both + 1e-6)
    assert seen_from(density, 2 * DIAMETER, GRID, ANGLES[:6]) == pytest.approx(seen_from(2 * density, DIAMETER, GRID, ANGLES[:6]), abs=1e-5)


def test_what_is_seen_does_not_depend_on_the_number_of_threads():
    one = seen_from(lumps(), DIAMETER, GRID, ANGLES[:6])
    numba.set_num_threads(min(2, numba.config.NUMBA_NUM_THREADS))
    assert seen_from(lumps(), DIAMETER, GRID, ANGLES[:6]).tobytes() == one.tobytes()


def test_more_is_found_where_more_angles_see():
    assert np.all(np.diff(SEEN_BY) > 0)
    share = found_share(np.linspace(0, 30, 200))
    assert np.all(np.diff(share) >= 0)
    assert (share[0], share[-1]) == (pytest.approx(FOUND[0]), pytest.approx(FOUND[-1]))
    assert np.all((share > 0) & (share < 1))


# ---- hidden ----------------------------------------------------------------------------------------------------------

DARK, OPEN = np.zeros(GRID.shape, np.float32), np.ones(GRID.shape, np.float32)  # shares of the rays that pass
BODY = cylinder(per_mm2=1.0)


def rays_through(*layers):
    """Rays of what is found that pass each voxel, as a share of those in the open, in closed form. layers: (radius, fibers per mm²) of
    cylinders that add up. An angle finds hair at an optical depth t as ``sees`` tells, so that of a depth from t on as much is found as the
    integral of that over t."""
    depths = np.linspace(0, 20, 4001)
    found = np.r_[0.0, np.cumsum(sees(np.exp(-0.5 * (depths[1:] + depths[:-1]))) * np.diff(depths))]
    total = np.zeros(GRID.shape)
    for theta in np.radians(ANGLES):
        u = centres()[..., 0] * np.cos(theta) + centres()[..., 2] * np.sin(theta)
        w = -centres()[..., 0] * np.sin(theta) + centres()[..., 2] * np.cos(theta)
        here, behind = np.zeros(GRID.shape), np.zeros(GRID.shape)
        for radius_mm, per_mm2 in layers:
            half = np.sqrt(np.maximum(radius_mm**2 - u**2, 0))
            here += per_mm2 * DIAMETER * np.clip(half - w, 0, 2 * half)
            behind += per_mm2 * DIAMETER * 2 * half
        total += np.interp(behind, depths, found) - np.interp(here, depths, found)
    air = total[layers[0][0] + 0.5 < RADIUS]
    return (total / np.median(air[air > 0])).astype(np.float32)


def looked_at(true, through, body=BODY):
    """What was found of known hair, if the cameras see as ``seen_from`` tells: the found density, the estimate of what was not."""
    seen = seen_from(true, DIAMETER, GRID, ANGLES)
    found = true * found_share(seen)
    points = np.flatnonzero(np.random.default_rng(3).random(true.size) < 0.1 * found.ravel() / found.max())
    at = centres().reshape(-1, 3)[points]
    return found, hidden(found, body, through, DIAMETER, GRID, ANGLES, at, seen.ravel()[points] / EVIDENCE)


@pytest.mark.parametrize("per_mm2", [4.0, 6.0, 8.0])
def test_a_dark_body_as_dense_within_as_without_is_made_whole(per_mm2):
    true = cylinder(per_mm2=per_mm2)
    found, estimate = looked_at(true, DARK)
    assert (found + estimate.missing).sum() == pytest.approx(true.sum(), rel=0.1)
    assert found.sum() < 0.97 * true.sum()
    core = RADIUS < 1.5
    assert estimate.missing[core].mean() == pytest.approx((true - found)[core].mean(), rel=0.2)
    assert estimate.missing.dtype == estimate.found.dtype == np.float32
    assert np.abs(estimate.found - found_share(seen_from(true, DIAMETER, GRID, ANGLES)))[RADIUS < 3.5].max() < 0.12
    assert estimate.missing[RADIUS > 4.3].max() == 0.0  # there is no body


@pytest.mark.parametrize("per_mm2", [4.0, 6.0, 8.0])
def test_hair_that_its_own_rays_tell_of_is_made_whole(per_mm2):
    true = cylinder(per_mm2=per_mm2)
    found, estimate = looked_at(true, rays_through((4.0, per_mm2)))
    assert (found + estimate.missing).sum() == pytest.approx(true.sum(), rel=0.1)
    assert (found + estimate.missing).max() < 1.5 * per_mm2


def test_a_denser_core_hides_more():
    cores = []
    for core in (0.5, 5.0, 9.0):
        estimate = looked_at(cylinder(core_mm=2.0, core_per_mm2=core), rays_through((4.0, 6.0), (2.0, core - 6.0)))[1]
        cores.append(estimate.missing[RADIUS < 1.5].mean())
    assert cores[0] < 0.1
    assert cores[0] < cores[1] < cores[2]


def test_hair_that_rays_pass_is_not_missing():
    true = cylinder(per_mm2=6.0)
    assert looked_at(true, OPEN)[1].missing.sum() == 0.0
    thin = cylinder(per_mm2=2.0)  # at least 14 of 24 angles see its middle
    assert looked_at(thin, rays_through((4.0, 2.0)))[1].missing.sum() < 0.01 * thin.sum()
    hollow = cylinder(core_mm=2.0)
    assert looked_at(hollow, rays_through((4.0, 6.0), (2.0, -6.0)))[1].missing.sum() < 0.02 * hollow.sum()


def test_a_core_without_any_found_hair_that_is_dark_is_as_dense_as_the_shell():
    ring = cylinder(core_mm=2.0)
    estimate = hidden(ring, BODY, np.where(RADIUS < 2, 0, 1), DIAMETER, GRID, ANGLES, np.empty((0, 3)), np.empty(0))
    assert estimate.missing[RADIUS < 1.2].mean() == pytest.approx(6.0, rel=0.05)
    assert estimate.missing[RADIUS > 2.8].max() < 0.05


def test_in_the_light_nothing_is_made_up_whatever_the_evidence():
    true = cylinder()
    nowhere = centres()[(RADIUS > 4.8)]
    for at, evidence in ((nowhere, np.full(len(nowhere), 12.0)), (centres().reshape(-1, 3), np.zeros(true.size)), (np.empty((0, 3)), np.empty(0))):
        estimate = hidden(true, BODY, OPEN, DIAMETER, GRID, ANGLES, at, evidence)
        assert not estimate.missing.any()
        assert estimate.found == pytest.approx(found_share(seen_from(true, DIAMETER, GRID, ANGLES)), abs=0.15)


def test_no_body_no_hidden_hair():
    assert not looked_at(cylinder(), DARK, body=DARK)[1].missing.any()


def test_volumes_of_another_shape_are_an_error_in_words():
    good, points = cylinder(), (np.zeros((1, 3)), np.ones(1))
    with pytest.raises(StrandscopeError, match="the density has shape"):
        seen_from(good[1:], DIAMETER, GRID, ANGLES)
    with pytest.raises(StrandscopeError, match="the body has shape"):
        hidden(good, good[:, 1:], OPEN, DIAMETER, GRID, ANGLES, *points)
    with pytest.raises(StrandscopeError, match="the share of rays has shape"):
        hidden(good, good, OPEN[1:], DIAMETER, GRID, ANGLES, *points)
