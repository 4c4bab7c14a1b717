"""Simulated photographs have to be those of a thin lens: known points are sharp at the right d, and at the right place."""

import json
import math
import shutil
from dataclasses import replace

import numpy as np
import pytest

from strandscope.core import simulate as module
from strandscope.core.capture import load_capture
from strandscope.core.errors import StrandscopeError
from strandscope.core.geometry import Optics, camera_points, object_points, pixels
from strandscope.core.groom import Groom, GroomParams, groom
from strandscope.core.simulate import (
    BLACK,
    MISALIGNED,
    WHITE,
    Misalignment,
    Samples,
    Scale,
    Shade,
    SimulateParams,
    aperture_radius_mm,
    aperture_rays,
    as_photographed,
    board,
    drawing,
    expose,
    lens,
    lens_count,
    photograph,
    prepare,
    samples,
    simulate,
    visibility,
)

OPTICS = Optics(330.0, 1 / 35, 149.5, 99.5, 10.0)
SHAPE = (200, 300)
NIGHT = np.zeros((4, *SHAPE), np.float32)


def fibers(*ends, radius_mm=0.04):
    """Straight fibers from point to point, mm, each a Groom's curve of 200 points."""
    curves = [np.linspace(a, b, 200) for a, b in ends]
    return Groom(np.concatenate(curves), np.arange(len(ends) + 1) * 200, np.full(len(ends), radius_mm))


def flat(lock, angle_deg, brightness=1.0, optics=None):
    """A drawing in which each fiber has one brightness."""
    hair = prepare(lock, np.random.default_rng(0))
    color = np.broadcast_to(np.broadcast_to(brightness, len(lock))[hair.fiber, None], (len(hair.fiber), 3))
    return drawing(hair, angle_deg, Shade(color.astype(np.float32), np.zeros(len(hair.fiber), np.float32)), optics)


def take(drawn, focus_mm, depth_mm=1.0, optics=OPTICS, seed=0, count=None):
    """A photograph without noise or background."""
    disc = lens(count or lens_count(optics, depth_mm), aperture_radius_mm(optics), SHAPE[0] + 1, np.random.default_rng(seed))
    return photograph(drawn, NIGHT, optics, focus_mm, disc)


def through(point, direction, length_mm=3.0):
    direction = np.array(direction) / np.linalg.norm(direction)
    return point - length_mm * direction, point + length_mm * direction


CASES = [  # a point of the camera frame, off axis, a direction, and the turntable's angle
    ((1.5, -0.8, 1.7), (0.1, 1.0, 0.0), 0.0),
    ((-2.6, 1.2, -2.2), (-0.3, 1.0, 0.05), 0.0),
    ((3.0, 1.5, 2.0), (0.2, 1.0, 0.0), 35.0),
    ((-3.1, -1.6, 3.4), (1.0, 0.9, 0.0), 140.0),
    ((2.2, -1.8, -3.0), (1.0, 0.15, 0.0), 265.0),
]


@pytest.mark.parametrize(("seen", "direction", "angle"), CASES)
def test_a_fiber_is_sharpest_at_its_own_d(seen, direction, angle):
    """Contrast around the projected point against d, an isolated fiber; the peak by a parabola, within 0.05 mm."""
    seen, direction = np.array(seen), np.array(direction, float)
    point, ends = object_points(seen, angle), [object_points(p, angle) for p in through(seen, direction)]
    drawn = flat(fibers(ends), angle)
    offsets = np.arange(-0.6, 0.61, 0.2) + 0.03  # no photograph is exactly in focus
    sharpness = []
    for offset in offsets:
        focus = seen[2] + offset
        col, row, _ = pixels(point, angle, focus, OPTICS)
        red = take(drawn, focus, count=96)[0]
        patch = red[round(row) - 8 : round(row) + 9, round(col) - 8 : round(col) + 9]
        sharpness.append(sum((g**2).sum() for g in np.gradient(patch)))
    best = int(np.argmax(sharpness))
    before, peak, after = sharpness[best - 1 : best + 2]
    found = offsets[best] + 0.2 * 0.5 * (before - after) / (before - 2 * peak + after)
    assert abs(found) < 0.05


@pytest.mark.parametrize(("seen", "direction", "angle"), CASES)
@pytest.mark.parametrize("site", range(4))
def test_a_fiber_in_focus_lies_where_its_projection_says(seen, direction, angle, site):
    """The centre of light around the projected point, weighed by a soft window, on each site of the mosaic: 0.03 px."""
    seen, direction = np.array(seen), np.array(direction, float)
    ends = [object_points(p, angle) for p in through(seen, direction)]
    plane = take(flat(fibers(ends), angle), seen[2], count=128)[site]
    col, row, _ = pixels(object_points(seen, angle), angle, seen[2], OPTICS)
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    x, y = columns + (site % 2) / 2 - col, rows + (site // 2) / 2 - row
    normal = np.array([direction[1], direction[0]]) / np.hypot(*direction[:2])  # across the fiber, rows downward
    along = -x * normal[1] + y * normal[0]
    across = x * normal[0] + y * normal[1]
    weight = plane * np.exp(-0.5 * (along / 3) ** 2) * (np.abs(across) < 6)
    assert abs((weight * across).sum() / weight.sum()) < 0.03


def test_points_far_from_focus_keep_the_place_of_their_perspective():
    """The middle of a blurred fiber, 3 mm before and behind the plane of focus, at the corner of the image."""
    for w in (-3.0, 3.0):
        seen = np.array([3.2, 1.5, w])
        plane = take(flat(fibers(through(seen, (0, 1.0, 0))), 0.0), 0.0, count=256)[0]
        col, row, _ = pixels(seen, 0.0, 0.0, OPTICS)
        profile = plane[round(row) - 3 : round(row) + 4].sum(axis=0)
        assert np.average(np.arange(SHAPE[1]), weights=profile) == pytest.approx(col, abs=0.15)


@pytest.mark.parametrize("w", [-4.0, -2.0, -1.0, 1.0, 2.0, 4.0])
def test_blur_grows_as_the_aperture_predicts(w):
    """A disc of radius b has a standard deviation of b / 2 along any line; b = A |w - d| / (l + d - w)."""
    fiber = flat(fibers(through(np.array([0.0, 0.0, w]), (0, 1.0, 0), 5.0)), 0.0)
    deviations = []
    for focus in (w, 0.0):
        profile = take(fiber, focus, count=256)[0][90:110].sum(axis=0)
        columns = np.arange(SHAPE[1])
        mean = np.average(columns, weights=profile)
        deviations.append(np.sqrt(np.average((columns - mean) ** 2, weights=profile)))
    blur_px = aperture_radius_mm(OPTICS) * abs(w) / (330 - w) / OPTICS.pitch_mm
    assert np.sqrt(deviations[1] ** 2 - deviations[0] ** 2) == pytest.approx(blur_px / 2, rel=0.02)


@pytest.mark.parametrize("lean", [0.05, 0.4, 1.5])
@pytest.mark.parametrize("depth", [2.0, 6.0])
def test_a_blurred_fiber_shows_no_copies_of_itself(depth, lean):
    """Its profile is the projection of a disc, for any shift of the points on the lens and with as many as a capture uses.

    What differs is grain, not streaks: the longer the stretch, the less of it. Relative to the peak of the blurred profile.
    """
    fiber = flat(fibers(through(np.array([0.0, 0.0, -depth]), (lean, 1.0, 0), 6.0)), 0.0)
    blur_px = aperture_radius_mm(OPTICS) * depth / (330 + depth) / OPTICS.pitch_mm
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    across = ((columns - OPTICS.axis_col_px) + (rows - OPTICS.axis_row_px) * lean) / np.hypot(1, lean)  # rows go down
    along = ((rows - OPTICS.axis_row_px) - (columns - OPTICS.axis_col_px) * lean) / np.hypot(1, lean)
    for length, tolerance in ((9, 0.2), (72, 0.07)):
        off = []
        for seed in range(5):
            red = take(fiber, 0.0, depth, seed=seed)[0]
            near = (np.abs(along) < length / 2) & (np.abs(across) < 0.8 * blur_px)
            bins = np.round(across[near]).astype(int)
            profile = np.array([red[near][bins == b].mean() for b in np.unique(bins)])
            expected = np.array([np.sqrt(1 - (across[near][bins == b] / blur_px) ** 2).mean() for b in np.unique(bins)])
            off.append(profile / expected * expected.sum() / profile.sum() - 1)
        assert np.sqrt(np.mean(np.concatenate(off) ** 2)) < tolerance


def test_points_of_the_lens_are_even_over_the_disc_in_every_row():
    disc = lens(400, 2.0, 30, np.random.default_rng(0))
    for row in (0, 7, 29):
        points = disc.points(row)
        radius = np.linalg.norm(points, axis=1)
        assert radius.max() <= 2.0
        assert np.abs(points.mean(axis=0)).max() < 0.02
        assert [(radius < r).mean() for r in (0.5, 1.0, 1.5)] == pytest.approx([1 / 16, 1 / 4, 9 / 16], abs=0.02)


def blocked_share(distance_mm, radius_mm):
    """The part of the cone that an endless fiber across its middle takes away."""
    cone = aperture_radius_mm(OPTICS) * distance_mm / 330.0
    x = np.linspace(-1, 1, 20001)
    chord = np.sqrt(1 - x**2)
    return chord[np.abs(x) * cone < radius_mm].sum() / chord.sum()


@pytest.mark.parametrize("distance", [1.0, 2.0, 4.0])
def test_a_fiber_in_front_takes_its_share_of_the_cone(distance):
    """A black fiber before a white one in focus: the middle of the latter loses the share that the former covers."""
    behind, before = through(np.zeros(3), (1.0, 0, 0)), through(np.array([0, 0, distance]), (0, 1.0, 0))
    lock = fibers(behind, before)
    alone = take(flat(lock, 0.0, (1.0, 0.0)), 0.0, count=512)[0]
    open_view = take(flat(fibers(behind), 0.0), 0.0, count=512)[0]
    middle = np.s_[99:101, 149:151]
    share = blocked_share(distance, 0.04)
    assert 1 - alone[middle].mean() / open_view[middle].mean() == pytest.approx(share, abs=0.02)
    at = Samples(np.zeros((1, 3)), np.array([[1.0, 0, 0]]), np.zeros(1, np.int32))
    assert visibility(prepare(lock, np.random.default_rng(0)), at, OPTICS, 0.0, rays=512)[0] == pytest.approx(1 - share, abs=0.02)


def test_a_fiber_behind_hides_nothing():
    front, back = through(np.zeros(3), (1.0, 0, 0)), through(np.array([0, 0, -2.0]), (0, 1.0, 0))
    alone, both = (take(flat(lock, 0.0, light), 0.0)[0] for lock, light in ((fibers(front), 1.0), (fibers(front, back), (1.0, 0.0))))
    assert np.allclose(alone, both, atol=1e-6)


def test_a_fiber_has_its_true_width():
    """Light of a flat fiber across a row: width over pitch, times the mean brightness across it."""
    red = take(flat(fibers(through(np.zeros(3), (0, 1.0, 0), 4.0)), 0.0), 0.0, count=256)[0]
    mean = np.mean(0.25 + 0.75 * np.sqrt(1 - np.linspace(-1, 1, 10001) ** 2))
    assert red[80:120].sum(axis=1).mean() == pytest.approx(0.08 / OPTICS.pitch_mm * mean, rel=0.01)


@pytest.mark.parametrize("direction", [(0.0, 0.02, 1.0), (0.3, 0.3, 1.0)])
def test_a_fiber_that_points_at_the_camera_has_no_gaps(direction):
    red = take(flat(fibers(through(np.array([1.0, 0.5, 0.0]), direction, 1.0)), 0.0), 0.0, count=128)[0]
    col, row, _ = pixels(np.array([1.0, 0.5, 0.0]), 0.0, 0.0, OPTICS)
    assert red[round(row), round(col)] > 0.3


# ---- visibility ------------------------------------------------------------------------------------------------------


def brute_visibility(lock, at, angle_deg, rays):
    """Every ray against every segment of every other fiber: blocked where they pass closer than the radius."""
    points, ends = camera_points(at.points_mm, angle_deg), camera_points(lock.points_mm, angle_deg)
    fiber = np.repeat(np.arange(len(lock)), np.diff(lock.offsets))
    start = np.flatnonzero(np.diff(fiber) == 0)
    a, d = ends[start], ends[start + 1] - ends[start]
    open_rays = np.zeros(len(points))
    for k, point in enumerate(points):
        for u, v in rays:
            ray = np.array([u, v, point[2] + OPTICS.working_distance_mm]) - point
            ray *= 30 / OPTICS.working_distance_mm  # no hair is farther
            s, t = closest(point, ray, a, d)
            gap = np.linalg.norm(point + s[:, None] * ray - a - t[:, None] * d, axis=1)
            blocked = (gap < lock.radii_mm[fiber[start]]) & (fiber[start] != at.strand[k])
            open_rays[k] += not blocked.any()
    return open_rays / len(rays)


def closest(p, e, a, d):
    """Places s on the segment p + s e and t on the segments a + t d, in 0 … 1, where they come closest."""
    r = p - a
    ee, dd, ed, er, dr = e @ e, (d * d).sum(1), d @ e, r @ e, (d * r).sum(1)
    s = np.clip((ed * dr - er * dd) / np.maximum(ee * dd - ed**2, 1e-12), 0, 1)
    t = np.clip((ed * s + dr) / dd, 0, 1)
    return np.clip((ed * t - er) / ee, 0, 1), t


@pytest.mark.parametrize("angle", [0.0, 75.0])
def test_visibility_is_that_of_every_ray_against_every_fiber(angle):
    lock = groom(GroomParams(fibers=24, lock_radius_mm=1.0, half_height_mm=2.5), np.random.default_rng(1))
    hair = prepare(lock, np.random.default_rng(0))
    every = samples(lock, 3.0, 1.0)
    pick = np.random.default_rng(2).choice(len(every.points_mm), 60, replace=False)
    at = Samples(every.points_mm[pick], every.tangents[pick], every.strand[pick])
    fast = visibility(hair, at, OPTICS, angle, rays=64)
    slow = brute_visibility(lock, at, angle, aperture_rays(OPTICS, 64).points(0))
    assert np.ptp(slow) > 0.5  # some seen, some hidden
    assert np.abs(fast - slow).mean() < 0.02  # a ray that grazes a fiber falls either way: pixels of 14 µm
    assert abs((fast - slow).mean()) < 0.01
    assert np.abs(fast - slow).max() < 0.15


def test_samples_stand_each_tenth_of_a_millimetre_on_the_fiber_inside_the_volume():
    lock = groom(GroomParams(style="curls", fibers=12, lock_radius_mm=1.5, half_height_mm=3.0), np.random.default_rng(1))
    at = samples(lock, 1.2, 2.0)
    assert np.hypot(at.points_mm[:, 0], at.points_mm[:, 2]).max() <= 1.2
    assert np.abs(at.points_mm[:, 1]).max() <= 2.0
    steps = np.diff(at.points_mm, axis=0)[np.diff(at.strand) == 0]
    size = np.linalg.norm(steps, axis=1)
    near = size < 0.15  # the rest left the volume and came back
    assert size[near] == pytest.approx(0.1, abs=0.002)
    along = at.tangents[:-1][np.diff(at.strand) == 0][near]
    assert (np.einsum("ij,ij->i", along, steps[near]) / size[near]).min() > 0.99
    assert np.allclose(np.linalg.norm(at.tangents, axis=1), 1)


# ---- the sensor ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("light", [0.0, 0.05, 0.3, 0.8])
def test_noise_is_shot_noise_and_read_noise(light):
    """Variance of electrons = mean + read noise², in 14-bit numbers; 3 sigma of the estimate from 160,000 pixels."""
    full_well, read = 20000.0, 8.0
    mosaic = expose(np.full((4, 200, 200), light, np.float32), full_well, read, np.random.default_rng(0)).astype(float)
    per_electron = (WHITE - BLACK) / full_well
    expected = (light * full_well + read**2) * per_electron**2 + 1 / 12
    assert mosaic.mean() == pytest.approx(BLACK + light * (WHITE - BLACK), abs=4 * math.sqrt(expected / mosaic.size))
    assert mosaic.var() == pytest.approx(expected, rel=3 * math.sqrt(2 / mosaic.size))


def test_each_colour_stands_on_its_site():
    planes = np.arange(4, dtype=np.float32)[:, None, None] * 0.1 + np.full((4, 3, 5), 0.2, np.float32)
    mosaic = expose(planes, 1e12, 0.0, np.random.default_rng(0))
    numbers = np.rint(BLACK + np.array([0.2, 0.3, 0.4, 0.5]) * (WHITE - BLACK))
    assert mosaic.shape == (6, 10)
    for site, number in enumerate(numbers):
        assert np.abs(mosaic[site // 2 :: 2, site % 2 :: 2] - number).max() <= 1


def test_light_beyond_white_is_white_and_below_black_is_cut_at_zero():
    mosaic = expose(np.full((4, 2, 2), 3.0, np.float32), 1000.0, 5.0, np.random.default_rng(0))
    assert (mosaic == WHITE).all()


# ---- a whole capture -------------------------------------------------------------------------------------------------

SPECK = Scale(rows=40, columns=70, angles=3, half_range_mm=0.8, fibers=5, lock_radius_mm=0.5, turntable=2)
PARAMS = SimulateParams(style="wavy", scale="speck", seed=5)


@pytest.fixture(autouse=True)
def speck(monkeypatch):
    monkeypatch.setitem(module.SCALES, "speck", SPECK)


def contents(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture
def done(tmp_path):
    out = tmp_path / "speck"
    simulate(out, PARAMS, workers=1)
    return out


def test_the_capture_is_whole_and_says_what_it_is(done):
    capture = load_capture(done)
    assert [s.angle_deg for s in capture.sweeps] == [0, 120, 240]
    assert capture.sweeps[0].positions_mm == pytest.approx([-0.8, -0.6, -0.4, -0.2, 0, 0.2, 0.4, 0.6, 0.8])
    assert capture.shape == (40, 70)
    assert (capture.optics.axis_col_px, capture.optics.axis_row_px) == (34.5, 19.5)
    assert capture.unknown["simulation"]["seed"] == 5
    assert all((done / f).is_file() for f in capture.turntable.files)
    assert all(p.min() > 0 and p.max() < 1 for p in [capture.planes(capture.sweeps[0].files[2], "RGB")])


def test_the_truth_is_as_the_format_says(done):
    truth = np.load(done / "truth.npz")
    kinds = {
        "points": "f4", "offsets": "i8", "radii": "f4",
        "sample_points": "f4", "sample_tangents": "f4", "sample_strand": "i4", "visibility": "f2",
    }  # fmt: skip
    assert {k: truth[k].dtype.str[1:] for k in truth.files} == kinds
    count = len(truth["sample_points"])
    assert count > 20
    assert truth["visibility"].shape == (count, 3)
    assert truth["offsets"][-1] == len(truth["points"])
    assert len(truth["radii"]) == len(truth["offsets"]) - 1 == 5
    assert truth["visibility"].min() >= 0
    assert truth["visibility"].max() == 1
    # every sample appears in the image in focus, at every angle, at a position that the camera takes
    capture = load_capture(done)
    for angle in np.arange(0, 360, 15):
        w = camera_points(truth["sample_points"], angle)[:, 2]
        seen = np.stack([pixels(p, angle, d, capture.optics) for p, d in zip(truth["sample_points"], w, strict=True)])
        assert (seen[:, 0] >= 0).all()
        assert (seen[:, 0] <= 69).all()
        assert (seen[:, 1] >= 0).all()
        assert (seen[:, 1] <= 39).all()
        assert np.abs(w).max() <= 0.8


def test_libraw_reads_the_very_numbers(done, tmp_path):
    import rawpy

    rng = np.random.default_rng(0)
    mosaic = expose(rng.random((4, 40, 70), np.float32), 1000.0, 5.0, rng)
    module.write_dng(tmp_path / "one.dng", mosaic, BLACK, WHITE)
    for path in (tmp_path / "one.dng", done / "sweep_000/img_0000.dng"):
        with rawpy.imread(str(path)) as raw:
            found = raw.raw_image_visible.copy()
            assert (raw.black_level_per_channel[0], raw.white_level) == (BLACK, WHITE)
            assert raw.raw_pattern.tolist() == [[0, 1], [3, 2]]
        if path.name == "one.dng":
            assert np.array_equal(found, mosaic)
        assert found.shape == (80, 140)


def test_the_same_seed_gives_the_same_bytes_for_any_number_of_threads(done, tmp_path):
    simulate(tmp_path / "again", PARAMS, workers=3)
    assert contents(tmp_path / "again") == contents(done)
    simulate(tmp_path / "other", replace(PARAMS, seed=6), workers=2)
    assert contents(tmp_path / "other")["sweep_000/img_0000.dng"] != contents(done)["sweep_000/img_0000.dng"]


class Cancelled(Exception):
    pass


def test_an_interrupted_run_goes_on_where_it_stopped(done, tmp_path):
    out = tmp_path / "stopped"

    def stop(stage, count, total):
        if stage == "photographs" and count >= total / 2:
            raise Cancelled

    with pytest.raises(Cancelled):
        simulate(out, PARAMS, stop, workers=1)
    assert not (out / "capture.json").exists()
    (out / "sweep_000" / ".img_0009.123.part.dng").write_bytes(b"left by a run that was killed")
    taken = {p: p.stat().st_mtime_ns for p in out.rglob("img_*.dng")}
    assert 0 < len(taken) < 29
    simulate(out, PARAMS, workers=2)
    assert all(p.stat().st_mtime_ns == time for p, time in taken.items())
    assert contents(out) == contents(done)


def test_a_finished_capture_is_left_as_it_is(done):
    before = {p: p.stat().st_mtime_ns for p in done.rglob("*")}
    simulate(done, PARAMS)
    assert {p: p.stat().st_mtime_ns for p in done.rglob("*")} == before


def test_another_folder_is_not_touched(tmp_path, done):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(StrandscopeError, match="mine: holds files that no simulation made"):
        simulate(tmp_path / "mine", PARAMS)
    assert contents(tmp_path / "mine") == {"letter.txt": b"dear"}
    with pytest.raises(StrandscopeError, match=r"letter\.txt: is a file"):
        simulate(tmp_path / "mine" / "letter.txt", PARAMS)
    with pytest.raises(StrandscopeError, match="simulation with seed 5, not 6"):
        simulate(done, replace(PARAMS, seed=6))
    (done / "simulation.json").write_text(json.dumps([1]))
    with pytest.raises(StrandscopeError, match="another folder"):
        simulate(done, PARAMS)


@pytest.mark.parametrize("change", [{"style": "afro"}, {"scale": "vast"}, {"fibers": 0}])
def test_wrong_parameters_leave_no_folder(tmp_path, change):
    with pytest.raises(StrandscopeError, match=next(iter(change))):
        simulate(tmp_path / "out", replace(PARAMS, **change))
    assert not (tmp_path / "out").exists()


def test_the_paper_scale_is_that_of_the_paper():
    capture = module.plan("out", SimulateParams(scale="paper"))
    assert sum(len(s.files) for s in capture.sweeps) == 9024
    assert (capture.sweeps[0].positions_mm[0], capture.sweeps[0].positions_mm[-1]) == (-37.5, 37.5)
    assert aperture_radius_mm(capture.optics) == pytest.approx(28.87, abs=0.01)
    assert module.stopped_cone_deg(SimulateParams(), 16.0) == pytest.approx(1.754, abs=0.001)


def test_the_board_is_blue_and_hair_stands_out_in_red():
    for look in module.LOOKS.values():
        red, green, _, blue = board(OPTICS, SHAPE, look).mean(axis=(1, 2))
        assert blue > 2 * red
        assert blue > green
        assert look.hair[0] > look.hair[1] > look.hair[2]


# ---- a rig that is not as stated -------------------------------------------------------------------------------------


def test_the_misalignment_of_the_command_line_is_the_one_documented():
    capture = module.plan("out", SimulateParams(scale="tiny"))
    errors = MISALIGNED.errors(capture)
    assert (errors.axis_px, errors.tilt_deg, errors.tilt_towards_deg, errors.focus_mm, errors.working_distance_mm) == (3, 0.2, 0.2, 0.2, 2)
    assert errors.angles_deg == (0.0,) * 8 + (0.1,) * 8  # one step slips, and all later sweeps are off
    np.testing.assert_allclose(errors.gains, np.tile(np.linspace(0.975, 1.025, 19), (16, 1)))
    assert Misalignment(every_step_deg=0.1).errors(capture).angles_deg == pytest.approx(0.1 * np.arange(16))


def test_a_misaligned_rig_sees_a_fiber_where_its_true_optics_put_it():
    """The photograph is made with the true optics: the crest of a fiber lies where they say, and not where the stated ones do."""
    capture = replace(module.plan("out", SimulateParams(scale="tiny")), optics=OPTICS)
    rig = replace(MISALIGNED, tilt_deg=2.0, tilt_towards_deg=-1.0).errors(capture).corrected(capture)
    angle, lock = rig.sweeps[9].angle_deg, fibers(((0.6, -4, 0.3), (0.9, 4, 0.5)))
    leaning = flat(lock, angle, optics=rig.optics)
    for row in (20, 100, 180):
        place = pixels(lock.points_mm, angle, 0.0, rig.optics)
        at = int(np.argmin(np.abs(place[:, 1] - row)))
        red = take(leaning, place[at, 2], optics=rig.optics)[0]
        seen = pixels(lock.points_mm[at], angle, place[at, 2], rig.optics)
        line = red[round(seen[1])]
        crest = (line * np.arange(len(line))).sum() / line.sum()
        assert crest == pytest.approx(seen[0], abs=0.3)
    assert abs(pixels(lock.points_mm, capture.sweeps[9].angle_deg, 0.0, OPTICS) - place)[:, 0].max() > 2


def test_a_lens_that_distorts_and_a_stage_that_leads_aside_move_the_photograph():
    """A fiber near the right edge, photographed at d = 3: its crest lies where the geometry says, 3 px off where a straight rig has it."""
    bent = replace(OPTICS, travel_deg=-0.8, travel_up_deg=0.2, k1_per_mm2=-2e-3)
    lock = fibers(((2.6, -4, 3.0), (2.6, 4, 3.0)))
    straight = flat(lock, 0.0)
    drawn = as_photographed(straight, bent, 3.0, SHAPE)
    assert as_photographed(straight, OPTICS, 3.0, SHAPE) is straight
    red = take(drawn, 3.0)[0]
    place = pixels(lock.points_mm, 0.0, 3.0, bent, SHAPE)
    for row in (15, SHAPE[0] // 2, SHAPE[0] - 15):
        seen = place[np.argmin(np.abs(place[:, 1] - row))]
        line = red[round(seen[1])]
        assert (line * np.arange(len(line))).sum() / line.sum() == pytest.approx(seen[0], abs=0.1)
    assert np.abs(pixels(lock.points_mm, 0.0, 3.0, OPTICS) - place)[:, 0].max() > 2


def test_a_simulation_from_before_there_were_as_many_errors_is_kept(tmp_path, done):
    old = tmp_path / "old"
    shutil.copytree(done, old)
    asked = json.loads((old / module.JOURNAL).read_text())
    del asked["misalignment"]["k1_per_mm2"], asked["misalignment"]["pitch_parts"]
    (old / module.JOURNAL).write_text(json.dumps(asked))
    before = (old / "capture.json").stat().st_mtime_ns
    simulate(old, PARAMS, workers=2)
    assert (old / "capture.json").stat().st_mtime_ns == before


def test_stated_and_true_rig_differ_in_the_photographs_alone(tmp_path, done):
    crooked = replace(PARAMS, misalignment=MISALIGNED)
    simulate(tmp_path / "crooked", crooked, workers=2)
    there, here = load_capture(tmp_path / "crooked"), load_capture(done)
    assert (there.optics, [s.angle_deg for s in there.sweeps]) == (here.optics, [s.angle_deg for s in here.sweeps])
    assert there.unknown["simulation"]["misalignment"]["axis_px"] == 3
    truths = [np.load(folder / "truth.npz") for folder in (tmp_path / "crooked", done)]
    assert all(np.array_equal(truths[0][name], truths[1][name]) for name in truths[0].files if name != "visibility")
    # light drifts by 5 %: the board's corner, far from the hair, in the first and the last photograph of a sweep
    first, last = (there.planes(there.sweeps[1].files[i], "B")[0, :6, :6].mean() for i in (0, -1))
    assert last / first == pytest.approx(1.025 / 0.975, abs=0.01)
