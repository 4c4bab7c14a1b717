"""Hull and carving against shapes whose inside is known: the photographs' blueness and the features are traced here."""

import itertools

import numba
import numpy as np
import pytest

from strandscope.core.capture import Sweep
from strandscope.core.errors import StrandscopeError
from strandscope.core.geometry import Optics, camera_points, object_points
from strandscope.core.hull import (
    Grid,
    HullParams,
    blueness,
    carve,
    carved_inside,
    empty_blueness,
    empty_rays,
    grid_of,
    hull_inside,
    occupancy,
    otsu,
    visual_hull,
)

# A near lens and an image whose axis is not in the middle, so that mirrored or unperspective formulas show.
OPTICS = Optics(working_distance_mm=60.0, pitch_mm=0.125, axis_col_px=41.5, axis_row_px=35.5, aperture_cone_deg=10.0)
ROWS, COLS = 72, 88
PARAMS = HullParams(voxel_mm=0.25, block_px=4, empty_share=0.5, thicken_mm=0.0, clearance_mm=0.6, blur_mm=0.25)
GRID = Grid.around((-4.5, -4.0, -4.5), (4.5, 4.0, 4.5), PARAMS.voxel_mm)
ANGLES = np.arange(0.0, 360.0, 30.0)
POSITIONS = np.arange(-4.5, 4.6, 0.5)
BOARD, HAIR = 0.62, 0.25


def off_axis_ball(points):
    return np.linalg.norm(points - np.array([1.5, 1.0, -2.0]), axis=-1) < 1.2


def notched_post(points):
    """A post of radius 3 along y with a wedge cut from its axis outwards: cameras see into it, no silhouette shows it."""
    x, y, z = np.moveaxis(points, -1, 0)
    wedge = np.abs(np.arctan2(z - 1.0, -(x - 0.7))) < np.radians(38)
    return (np.hypot(x, z) < 3.0) & (np.abs(y) < 2.5) & ~wedge


def centres(grid=GRID):
    return np.stack(np.meshgrid(*(grid.centres(a) for a in range(3)), indexing="ij"), axis=-1)


def rays(targets, far_mm, step_mm=0.2):
    """Points (..., n) along the cone's rays through each target of the camera frame (..., 3), far_mm each way."""
    along = np.arange(-far_mm, far_mm + step_mm / 2, step_mm)
    wide = np.tan(np.radians(OPTICS.aperture_cone_deg / 2)) * 0.7
    for across in ((0, 0), (wide, 0), (-wide, 0), (0, wide), (0, -wide)):
        centre = -targets[..., :2] / OPTICS.working_distance_mm  # the ray through the middle of the lens
        slope = np.concatenate([centre + across, np.ones((*targets.shape[:-1], 1))], axis=-1)
        yield targets[..., None, :] + along[:, None] * slope[..., None, :]


def photographed(shape):
    """Sweeps (angle, positions, stack) of blueness of an opaque shape before the board."""
    block = PARAMS.block_px
    rows, cols = np.meshgrid(np.arange(ROWS // block), np.arange(COLS // block), indexing="ij")
    u = ((cols + 0.5) * block - 0.5 - OPTICS.axis_col_px) * OPTICS.pitch_mm
    v = (OPTICS.axis_row_px - ((rows + 0.5) * block - 0.5)) * OPTICS.pitch_mm
    for angle in ANGLES:
        focus = np.stack(np.broadcast_arrays(u, v, POSITIONS[:, None, None]), axis=-1)
        clear = np.mean([~shape(object_points(ray, angle)).any(axis=-1) for ray in rays(focus, 9.0, 0.35)], axis=0)
        yield angle, POSITIONS, np.round((HAIR + (BOARD - HAIR) * clear) * 255).astype(np.uint8)


def observed(shape, step_mm=0.2):
    """Features (angle, u, v, d): points of the surface of an opaque shape to which the way from the lens is free."""
    fine = Grid.around((-4.0, -3.5, -4.0), (4.0, 3.5, 4.0), step_mm)
    solid = shape(centres(fine))
    shell = solid & ~np.all([np.roll(solid, s, a) for a in range(3) for s in (-1, 1)], axis=0)
    points = centres(fine)[shell]
    for angle in ANGLES:
        place = camera_points(points, angle)
        toward = np.concatenate([-place[:, :2] / OPTICS.working_distance_mm, np.ones((len(place), 1))], axis=1)
        along = np.arange(2 * step_mm, 9.0, step_mm)
        free = ~shape(object_points(place[:, None] + along[:, None] * toward[:, None], angle)).any(axis=1)
        yield angle, *place[free].T


def iou(a, b):
    return (a & b).sum() / (a | b).sum()


# ---- grid ------------------------------------------------------------------------------------------------------------


def test_grid_places_cells_and_covers_the_box():
    grid = Grid.around((-1.0, 0.0, 2.0), (1.05, 0.5, 3.0), 0.1)
    assert grid.shape == (21, 5, 10)
    assert np.allclose(grid.to_cells([grid.centres(0)[3], grid.centres(1)[2], grid.centres(2)[9]]), (3.5, 2.5, 9.5))
    assert np.allclose(grid.to_mm(grid.to_cells([0.3, 0.2, 2.7])), (0.3, 0.2, 2.7))
    assert np.all(np.asarray(grid.origin_mm) <= (-1.0, 0.0, 2.0))
    assert np.all(grid.high_mm >= (1.05, 0.5, 3.0))


def test_the_paper_captures_a_cylinder_60_mm_high():
    optics = Optics(330.0, 1 / 35, 1096.0, 1050.0, 10.0)
    sweeps = [Sweep(a, tuple(np.arange(-32.0, 32.1, 0.2)), ()) for a in (0.0, 15.0)]
    grid = grid_of(optics, (2100, 2300), sweeps, 0.2)
    assert grid.shape == (320, 300, 320)
    assert grid.high_mm[1] == pytest.approx(30.0, abs=0.05)


@pytest.mark.parametrize(("low", "high", "voxel"), [((0, 0, 0), (1, 0, 1), 0.1), ((0, 0, 0), (1, 1, 1), 0.0), ((0, 0, 0), (1, np.inf, 1), 0.1)])
def test_grid_refuses_nothing(low, high, voxel):
    with pytest.raises(StrandscopeError, match="expected more than"):
        Grid.around(low, high, voxel)


def test_no_sweeps_are_an_error():
    with pytest.raises(StrandscopeError, match="expected sweeps"):
        grid_of(OPTICS, (ROWS, COLS), [], 0.2)
    with pytest.raises(StrandscopeError, match="expected at least one"):
        visual_hull([], OPTICS, GRID)


# ---- blueness --------------------------------------------------------------------------------------------------------


def test_blueness_is_the_share_of_blue_of_each_block():
    planes = np.zeros((3, 20, 27), np.float32)
    planes[:] = np.array([0.2, 0.2, 0.1])[:, None, None]
    planes[:, 8:16, 16:24] = np.array([0.05, 0.05, 0.3])[:, None, None]
    blue = blueness(planes, HullParams(block_px=8, dark=0.0))
    assert blue.shape == (3, 4)
    expected = np.full((3, 4), 0.2)
    expected[1, 2] = 0.75
    assert np.abs(blue / 255 - expected).max() <= 0.5 / 255 + 1e-6


def test_blueness_does_not_depend_on_exposure_and_is_none_in_the_dark():
    rng = np.random.default_rng(1)
    planes = rng.uniform(0.2, 0.4, (3, 32, 32)).astype(np.float32)
    plain = HullParams(dark=0.0)
    assert np.abs(blueness(planes, plain).astype(int) - blueness(planes * np.float32(0.1), plain)).max() <= 1
    noise = rng.normal(0.0, 0.002, (3, 64, 64)).astype(np.float32)  # read noise around black, some of it below
    assert blueness(noise).max() < 0.2 * 255


def test_blueness_wants_three_planes():
    with pytest.raises(StrandscopeError, match="expected \\(3, rows, columns\\)"):
        blueness(np.zeros((1, 8, 8), np.float32))


# ---- visual hull -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ball_sweeps():
    return list(photographed(off_axis_ball))


def test_hull_of_a_ball_lies_where_the_ball_is(ball_sweeps):
    inside = hull_inside(visual_hull(ball_sweeps, OPTICS, GRID, PARAMS), GRID, PARAMS)
    assert iou(inside, off_axis_ball(centres())) > 0.75  # blocks of 0.5 mm on a ball of 2.4 mm
    assert np.linalg.norm(centres()[inside].mean(axis=0) - (1.5, 1.0, -2.0)) < 0.1


def test_hull_of_a_mirrored_capture_is_elsewhere(ball_sweeps):
    truth = off_axis_ball(centres())
    turned = [(-angle, d, stack) for angle, d, stack in ball_sweeps]
    upside_down = [(angle, d, stack[:, ::-1]) for angle, d, stack in ball_sweeps]
    for wrong in (turned, upside_down):
        assert iou(hull_inside(visual_hull(wrong, OPTICS, GRID, PARAMS), GRID, PARAMS), truth) < 0.3


@pytest.mark.parametrize("angle", [0.0, 40.0, 200.0])
def test_a_block_speaks_about_its_own_place_only(angle):
    stack = np.zeros((len(POSITIONS), ROWS // 4, COLS // 4), np.uint8)
    frame, row, col = 13, 5, 14
    stack[frame, row, col] = 200
    highest = visual_hull([(angle, POSITIONS, stack)], OPTICS, GRID, PARAMS)
    u = (col * 4 + 1.5 - OPTICS.axis_col_px) * OPTICS.pitch_mm
    v = (OPTICS.axis_row_px - row * 4 - 1.5) * OPTICS.pitch_mm
    blue = centres()[np.nan_to_num(highest) > 0.3]
    assert 2 <= len(blue) <= 30
    assert np.linalg.norm(blue - object_points([u, v, POSITIONS[frame]], angle), axis=1).max() < 0.6  # a block and half a step
    assert np.linalg.norm(blue.mean(axis=0) - object_points([u, v, POSITIONS[frame]], angle)) < 0.2


def test_hull_does_not_depend_on_the_order_of_photographs_or_threads(ball_sweeps):
    threads = numba.get_num_threads()
    plain = visual_hull(ball_sweeps, OPTICS, GRID, PARAMS)
    reversed_sweeps = [(angle, d[::-1], stack[::-1]) for angle, d, stack in ball_sweeps]
    assert np.array_equal(plain, visual_hull(reversed_sweeps, OPTICS, GRID, PARAMS), equal_nan=True)
    try:
        numba.set_num_threads(1)
        assert np.array_equal(plain, visual_hull(ball_sweeps, OPTICS, GRID, PARAMS), equal_nan=True)
    finally:
        numba.set_num_threads(threads)


def test_a_voxel_out_of_every_picture_is_nothing(ball_sweeps):
    wide = Grid.around((-9.0, -4.0, -9.0), (9.0, 4.0, 9.0), 0.5)
    highest = visual_hull(ball_sweeps, OPTICS, wide, PARAMS)
    radius = np.hypot(centres(wide)[..., 0], centres(wide)[..., 2])
    assert np.all(np.isnan(highest[radius > 7.0]))
    assert not np.any(np.isnan(highest[radius < 4.0]))
    assert not hull_inside(highest, wide, PARAMS)[np.isnan(highest)].any()


def test_hull_wants_a_picture_for_each_position():
    with pytest.raises(StrandscopeError, match="sweep at 15°"):
        visual_hull([(15.0, POSITIONS, np.zeros((3, 4, 5), np.uint8))], OPTICS, GRID, PARAMS)


@pytest.mark.parametrize("board_share", [0.02, 0.2, 0.5, 0.9])
def test_threshold_lies_between_hair_and_board_however_little_board_is_seen(board_share):
    rng = np.random.default_rng(2)
    board = rng.random(200_000) < board_share
    values = np.where(board, rng.normal(0.62, 0.01, board.shape), rng.normal(0.27, 0.04, board.shape)).astype(np.float32)
    assert empty_blueness(values, HullParams(empty_share=0.5)) == pytest.approx(0.445, abs=0.02)


def test_without_contrast_nothing_is_empty():
    values = np.random.default_rng(3).normal(0.3, 0.01, 10_000).astype(np.float32)
    assert empty_blueness(values) == np.inf
    assert empty_blueness(np.full(10, 0.3, np.float32)) == np.inf


def test_otsu_parts_two_kinds():
    assert otsu(np.array([])) is None
    assert 1.0 < otsu(np.r_[np.full(30, 1.0), np.full(5, 9.0)]) < 9.0


# ---- carving ---------------------------------------------------------------------------------------------------------


def cells_by_sampling(start, end, grid, steps=200_000):
    """Oracle: the cells that dense samples of a segment fall into; ends in mm of the object frame."""
    cells = np.floor(grid.to_cells(start + np.linspace(0, 1, steps)[:, None] * (end - start))).astype(int)
    cells = cells[np.all((cells >= 0) & (cells < grid.shape), axis=1)]
    return {tuple(c) for c in np.unique(cells, axis=0)} if len(cells) else set()


def test_ray_passes_the_cells_that_sampling_finds():
    grid, params = Grid.around((-2, -2, -2), (2, 1.5, 2), 0.25), HullParams(clearance_mm=0.0)
    rng = np.random.default_rng(4)
    for n in range(24):
        angle, (u, v, d) = rng.uniform(0, 360), rng.uniform(-3.0, 3.0, 3)  # some start outside the grid
        start = object_points([u, v, d], angle)
        if np.all((grid.to_cells(start) >= 0) & (grid.to_cells(start) < grid.shape)):
            start = grid.to_mm(np.floor(grid.to_cells(start)) + 0.5)  # rays are merged at the voxel's centre
        lens = object_points([0.0, 0.0, camera_points(start, angle)[2] + OPTICS.working_distance_mm], angle)
        counts = carve([(angle, [u], [v], [d])], OPTICS, grid, params)
        traced = {tuple(c) for c in np.argwhere(counts)}
        sampled = cells_by_sampling(start, lens, grid)
        assert counts.max(initial=0) <= 1
        assert sampled <= traced, n
        assert len(traced - sampled) <= 1, n  # a corner cut shorter than the samples' spacing


def test_rays_meet_in_the_lens_and_not_at_infinity():
    counts = carve([(0.0, [3.0], [3.0], [-4.0])], OPTICS, GRID, PARAMS)
    front = counts[:, :, -1]
    (i,), (j,) = np.nonzero(front)
    expected = 3.0 * (1 - (GRID.centres(2)[-1] + 4.0) / OPTICS.working_distance_mm)  # 2.6: more than a voxel from 3
    assert GRID.centres(0)[i] == pytest.approx(expected, abs=0.26)
    assert GRID.centres(1)[j] == pytest.approx(expected, abs=0.26)
    assert not counts[tuple(np.floor(GRID.to_cells([3.0, 3.0, 4.4])).astype(int))]


@pytest.mark.parametrize(("angle", "towards"), [(0.0, (0, 0, 1)), (90.0, (-1, 0, 0)), (180.0, (0, 0, -1)), (270.0, (1, 0, 0))])
def test_rays_run_towards_the_camera(angle, towards):
    counts = carve([(angle, [0.05], [0.05], [0.05])], OPTICS, GRID, PARAMS)
    ends = centres()[counts > 0]
    assert (ends @ np.array(towards)).max() > 4.0
    assert (ends @ np.array(towards)).min() > 0.0
    assert np.abs(ends - (ends @ np.array(towards))[:, None] * np.array(towards)).max() < 0.3


def test_features_of_a_voxel_count_each_and_clearance_spares_the_fiber():
    place = [np.full(7, 0.1), np.full(7, 0.1), np.full(7, -2.0)]
    counts = carve([(0.0, *place), (0.0, *place)], OPTICS, GRID, HullParams(clearance_mm=1.0))
    along = counts[18, 16]
    assert np.all(along[GRID.centres(2) < -1.2] == 0)
    assert np.all(along[GRID.centres(2) > -0.8] == 14)


def test_carving_does_not_depend_on_threads():
    features = list(observed(notched_post, 0.4))
    threads = numba.get_num_threads()
    many = carve(features, OPTICS, GRID, PARAMS)
    try:
        numba.set_num_threads(1)
        assert np.array_equal(many, carve(features, OPTICS, GRID, PARAMS))
    finally:
        numba.set_num_threads(threads)


def test_no_features_carve_nothing():
    counts = carve([(0.0, [], [], [])], OPTICS, GRID, PARAMS)
    assert counts.shape == GRID.shape
    assert not counts.any()
    assert empty_rays(counts, np.ones(GRID.shape, bool)) == np.inf


def test_features_of_unequal_length_are_an_error():
    with pytest.raises(StrandscopeError, match="expected three of"):
        carve([(0.0, [1.0], [1.0, 2.0], [1.0])], OPTICS, GRID, PARAMS)


# ---- the combination -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def post():
    blue = visual_hull(photographed(notched_post), OPTICS, GRID, PARAMS)
    rays = carve(observed(notched_post), OPTICS, GRID, PARAMS)
    hull = hull_inside(blue, GRID, PARAMS)
    return notched_post(centres()), hull, carved_inside(rays, hull, GRID, PARAMS), occupancy(blue, rays, GRID, PARAMS)


def test_carving_opens_the_notch_that_the_hull_closes(post):
    truth, hull, carved, density = post
    x, y, z = np.moveaxis(centres(), -1, 0)
    notch = (np.hypot(x, z) < 2.6) & (np.abs(y) < 1.5) & ~truth & (x < -0.4)
    deep = truth & (np.hypot(x - 1.4, z + 0.4) < 0.8) & (np.abs(y) < 2)
    assert hull[notch].mean() > 0.5
    assert carved[notch].mean() < 0.2
    assert (density[notch] > 0.5).mean() < 0.25
    assert density[deep].min() > 0.9


def test_the_combination_is_nearer_the_truth_than_either(post):
    truth, hull, carved, density = post
    alone, both = max(iou(hull, truth), iou(carved, truth)), iou(density > 0.5, truth)
    assert both > 0.8
    assert both > alone + 0.02
    assert carved[~hull].any()  # empty space that no ray passes, taken away by the hull alone


def test_density_is_fractional_with_a_smooth_edge(post):
    density = post[3]
    assert density.dtype == np.float32
    assert density.min() >= 0.0
    assert density.max() <= 1.0 + 1e-6
    assert all(np.abs(np.diff(density, axis=a)).max() < 0.6 for a in range(3))


def test_a_volume_of_another_grid_is_an_error():
    other = np.zeros((2, 3, 4), np.float32)
    for call in (lambda: hull_inside(other, GRID), lambda: carved_inside(other, other > 0, GRID)):
        with pytest.raises(StrandscopeError, match="expected the grid's"):
            call()


def test_thin_hair_is_thickened():
    blue = np.full(GRID.shape, 0.6, np.float32)
    blue[18, :, 18] = 0.25
    inside = hull_inside(blue, GRID, HullParams(empty_blueness=0.45, thicken_mm=0.3))
    assert inside.sum() == 5 * GRID.shape[1]  # the column and its four neighbours at 0.25 mm
    assert all(inside[18 + i, 5, 18 + k] == (abs(i) + abs(k) <= 1) for i, k in itertools.product((-1, 0, 1), repeat=2))
