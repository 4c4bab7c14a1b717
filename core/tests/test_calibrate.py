"""What is wrong with a rig: the errors that were put into synthetic observations are found, with uncertainties that mean something."""

import json
from dataclasses import astuple, replace

import numpy as np
import pytest

from strandscope.core.capture import Capture, Sweep
from strandscope.core.errors import StrandscopeError
from strandscope.core.features import build_index
from strandscope.core.geometry import camera_points
from strandscope.core.match import Reach, sides_of, sightings
from strandscope.core.pipeline import calibrate, preset
from strandscope.core.rig.calibrate import (
    FIRST_SWEEP,
    Calibration,
    RigErrors,
    Sightings,
    Slip,
    describe,
    drift,
    gains,
    light,
    load_errors,
    save_calibration,
    solve,
    turns,
)

from .known import OPTICS, POSITIONS_MM, Seen, helix, line, observe, wave

SWEEPS = 12
MANY = {"points": 6000, "across_mm": 0.0015, "depth_mm": 0.015}  # the noise of a tenth of each error is then some four standard errors
# axis, tilt, tilt towards, focus, scale; biases by crowding, faintness and curvature; angles: mm, rad, parts
WRONG = np.array([0.08, 0.0035, -0.0035, 0.2, 0.006, 0.015, 0.01, 0.02, *np.radians([0, 0, 0, 0, 0, 0, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1])])


def rig_sightings(wrong, seed=0, points=1500, across_mm=0.004, depth_mm=0.04, outliers=0.0) -> Sightings:
    """What a rig that is off by ``wrong`` makes of points on slanted fibers: written from the meaning of each error, not from the
    solver's equations. The points themselves are known badly, to 0.03 mm."""
    rng = np.random.default_rng(seed)
    where = rng.uniform((-2, -4, -2), (2, 4, 2), (points, 3))
    along = rng.normal((0, 1, 0), (0.2, 0, 0.2), (points, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    sides = sides_of(along)
    guessed = where + np.einsum("ps,psi->pi", rng.normal(0, 0.03, (points, 2)), sides)
    axis, tilt, towards, focus, scale, by_crowd, by_faint, by_bend, *turned = wrong
    rows = []
    for k in range(SWEEPS):
        stated = 360 * k / SWEEPS
        x, y, w = camera_points(where, stated + np.degrees(turned[k])).T
        y, w = y * np.cos(towards) - w * np.sin(towards), w * np.cos(towards) + y * np.sin(towards)
        x, y = x * np.cos(tilt) + y * np.sin(tilt), y * np.cos(tilt) - x * np.sin(tilt)
        # u is read with pixels that are too narrow and from an axis that is not there, d is told by a stage that is off
        told = np.stack([x / (1 + scale) + axis, y / (1 + scale), w - focus], axis=1)
        at, g = camera_points(guessed, stated), camera_points(along, stated)
        s = np.array([camera_points(side, stated) for side in (sides[:, 0], sides[:, 1])])
        crowd, faint = rng.uniform(-1, 1, points), rng.uniform(0, 1, points)
        across = np.stack([g[:, 1], -g[:, 0], np.zeros(points)], axis=1) / np.hypot(g[:, 0], g[:, 1])[:, None]
        deep = np.cross(g, across)
        deep *= np.sign(deep[:, 2:]) / np.linalg.norm(deep, axis=1, keepdims=True)
        bend = rng.uniform(-0.5, 0.5, points)
        bias = by_crowd * crowd + by_faint * faint + by_bend * bend
        for depth, way, noise in ((False, across, across_mm), (True, deep, depth_mm)):
            off = ((told - at) * way).sum(axis=1) + rng.normal(0, noise, points) + depth * bias
            stray = rng.random(points) < outliers
            off[stray] += rng.normal(0, 20 * noise, stray.sum())
            moved = np.stack([(way * side).sum(axis=1) for side in s], axis=1)
            seen = at[:, 2] > -0.5  # from the front only
            kept = np.flatnonzero(seen)
            rows.append(
                [
                    kept,
                    np.full(len(kept), k),
                    np.full(len(kept), depth),
                    off[kept],
                    way[kept],
                    at[kept],
                    moved[kept],
                    crowd[kept],
                    faint[kept],
                    bend[kept],
                ]
            )
    columns = [np.concatenate(c) for c in zip(*rows, strict=True)]
    order = np.argsort(columns[0], kind="stable")
    return Sightings(*(c[order] for c in columns))


def solved(wrong, **how):
    """The change after three rounds of solving, as the flow does; each round observes the rig as corrected so far."""
    total = np.zeros_like(wrong)
    for _ in range(3):
        left = wrong - total
        left[5:8] = wrong[5:8]
        found = solve(rig_sightings(left, **how), SWEEPS)
        total += found.change
        total[5:8] = found.change[5:8]
    return total, found


# ---- the solver ------------------------------------------------------------------------------------------------------


def test_every_error_is_found_to_a_tenth_of_its_size():
    total, _ = solved(WRONG, **MANY)
    wrong = WRONG != 0
    np.testing.assert_allclose(total[wrong], WRONG[wrong], atol=0, rtol=0.1)
    np.testing.assert_allclose(total[~wrong], 0, atol=0.1 * np.radians(0.1))


def test_errors_lie_within_their_uncertainty():
    """Over several draws of noise, the error in standard errors is about 1; 29 numbers a draw, correlated by the first sweep."""
    pulls = []
    for seed in range(6):
        found = solve(rig_sightings(0 * WRONG, seed=seed), SWEEPS)
        spread = np.sqrt(np.diag(found.covariance))
        assert spread[FIRST_SWEEP] == found.change[FIRST_SWEEP] == 0  # right by definition
        told = np.delete(np.arange(len(WRONG)), FIRST_SWEEP)
        pulls.append(found.change[told] / spread[told])
    # 1.0 to 1.2 was measured in several sets of 16 draws; the angles of a draw go together, so that a few draws scatter
    assert 0.7 < np.sqrt(np.mean(np.square(pulls))) < 1.4


def test_strays_do_not_pull():
    total, found = solved(WRONG, outliers=0.15, **MANY)
    np.testing.assert_allclose(total[:5], WRONG[:5], rtol=0.1)
    assert found.across_mm < 0.004  # a stray is off by 0.04 mm


def test_a_shift_of_the_first_sweep_is_one_of_all_others():
    """Angles are known relative to each other: a first sweep that is off turns the hair, and all other sweeps back."""
    wrong = 0 * WRONG
    wrong[FIRST_SWEEP] = np.radians(0.1)
    found = solve(rig_sightings(wrong, **MANY), SWEEPS)
    np.testing.assert_allclose(np.degrees(found.change[FIRST_SWEEP + 1 :]), -0.1, atol=0.01)


def test_too_little_is_refused():
    with pytest.raises(StrandscopeError, match="too few"):
        solve(rig_sightings(WRONG, points=20), SWEEPS)


# ---- from features ---------------------------------------------------------------------------------------------------


def curvature_of(curve):
    """Vectors (n, 3), 1/mm, of an evenly spaced curve."""
    along = np.gradient(curve, axis=0)
    step = np.linalg.norm(along, axis=1, keepdims=True)
    return np.gradient(along / step, axis=0) / step


def test_features_tell_what_is_wrong_with_what_was_stated():
    """Features of known curves, read with optics, angles and positions that are off. The curves are given a little beside."""
    curves = [line(), line((-1.2, 0, 0.4), (-0.2, 1, 0.1)), helix(1.1), helix(0.7, 14, False), wave(), line((0.9, 0, 1.0), (0.1, 1, -0.2))]
    sweeps = observe(curves, Seen(noise_px=0.15))
    slipped = [replace(s, angle_deg=s.angle_deg - 0.1 * (k >= 6), positions_mm=s.positions_mm - 0.1) for k, s in enumerate(sweeps)]
    stated = replace(
        OPTICS, axis_col_px=OPTICS.axis_col_px - 2, pitch_mm=OPTICS.pitch_mm / 1.006, working_distance_mm=OPTICS.working_distance_mm / 1.006
    )
    inner = [c[np.abs(c[:, 1]) < 2.5][::60] for c in curves]
    points = np.concatenate(inner) + np.array([0.01, 0, -0.01])
    along = np.concatenate([np.gradient(c, axis=0) for c in inner])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    bends = np.concatenate([curvature_of(c)[np.abs(c[:, 1]) < 2.5][::60] for c in curves])
    rig = RigErrors()
    capture = Capture(".", "known", stated, tuple(Sweep(s.angle_deg, tuple(s.positions_mm), tuple(map(str, range(21)))) for s in slipped))
    for reach_px in (4.0, 2.0, 1.5, 1.5):
        now = rig.corrected(capture)
        seen = [replace(s, angle_deg=n.angle_deg, positions_mm=np.array(n.positions_mm)) for s, n in zip(slipped, now.sweeps, strict=True)]
        pitch = now.optics.pitch_mm
        reach = Reach(0.2, 1.5 * pitch, 0.5, reach_px * pitch, 0.5, np.radians(9), 8)
        found = solve(sightings(build_index(seen, now.optics), points, along, bends, reach), SWEEPS)
        rig = rig.plus(found.change, capture)
    angles = np.array(rig.angles_deg)
    assert rig.axis_px == pytest.approx(2, abs=0.05)
    assert rig.focus_mm == pytest.approx(0.1, abs=0.01)
    assert rig.working_distance_mm == pytest.approx(OPTICS.working_distance_mm - stated.working_distance_mm, abs=0.4)
    assert rig.tilt_deg == pytest.approx(0, abs=0.02)
    assert rig.tilt_towards_deg == pytest.approx(0, abs=0.06)  # 6 curves, a third of the hair of a small lock
    np.testing.assert_allclose(angles - angles[:6].mean(), 0.1 * (np.arange(SWEEPS) >= 6), atol=0.03)
    assert len(POSITIONS_MM) == len(now.sweeps[0].positions_mm)


def test_noise_is_no_rig(noise_capture, tmp_path):
    with pytest.raises(StrandscopeError):
        calibrate(noise_capture, tmp_path / "rig.json", preset())
    assert not (tmp_path / "rig.json").exists()


# ---- the turntable ---------------------------------------------------------------------------------------------------


def noisy(angles, seed=0, error_deg=0.006):
    """Angles told relative to a first sweep that is as uncertain as the others."""
    rng = np.random.default_rng(seed)
    off = rng.normal(0, error_deg, len(angles))
    return np.asarray(angles) - angles[0] + off - off[0], np.eye(len(angles)) * error_deg**2


def test_a_step_that_slipped_is_told():
    every, slips = turns(*noisy(0.1 * (np.arange(24) >= 9)))
    assert every == (0.0, 0.0)
    assert [s.sweep for s in slips] == [9]
    assert slips[0].angle_deg == pytest.approx(0.1, abs=0.01)
    assert abs(slips[0].angle_deg - 0.1) < 4 * slips[0].error_deg


def test_steps_that_are_all_off_are_told():
    (every, error), slips = turns(*noisy(0.1 * np.arange(24)))
    assert every == pytest.approx(0.1, abs=0.002)
    assert abs(every - 0.1) < 4 * error
    assert slips == []


def test_two_slips_are_told_apart():
    k = np.arange(24)
    _, slips = turns(*noisy(0.1 * (k >= 5) - 0.08 * (k >= 17)))
    assert [s.sweep for s in slips] == [5, 17]
    np.testing.assert_allclose([s.angle_deg for s in slips], [0.1, -0.08], atol=0.012)


def test_a_sound_turntable_has_no_slips():
    """Noise alone is taken for a slip in few draws of many."""
    told = [turns(*noisy(np.zeros(24), seed)) for seed in range(40)]
    assert sum(bool(slips) or every != (0.0, 0.0) for every, slips in told) <= 2


# ---- light -----------------------------------------------------------------------------------------------------------


def swept_light(gain, board=True, seed=0):
    """Light (J, 3, 12, 10) of a blue board with brown hair before its middle, which blurs and sharpens."""
    rng = np.random.default_rng(seed)
    stack = np.empty((len(gain), 3, 12, 10))
    for j, g in enumerate(gain):
        cover = np.zeros((12, 10))
        cover[:, 2:8] = 0.4 + 0.3 * np.sin(j / 3 + np.arange(6))
        if not board:
            cover[:] = 0.8 + 0.1 * np.sin(j + np.arange(10))
        stack[j] = np.array([0.045, 0.085, 0.23])[:, None, None] * (1 - cover) + np.array([0.5, 0.33, 0.18])[:, None, None] * cover
        stack[j] = g * stack[j] * (1 + rng.normal(0, 0.001, stack[j].shape))
    return stack


def test_a_gain_that_drifts_is_read_off_the_board():
    gain = 1 + 0.05 * np.linspace(-0.5, 0.5, 31)
    found, error = gains(swept_light(gain))
    np.testing.assert_allclose(found, gain, atol=0.002)
    assert drift(found) == pytest.approx(0.05, abs=0.002)
    assert error < 0.002


def test_without_a_board_no_gain_is_told():
    found, error = gains(swept_light(np.linspace(0.9, 1.1, 31), board=False))
    assert np.isinf(error)
    np.testing.assert_array_equal(found, 1)


def test_light_is_the_mean_of_blocks():
    planes = np.random.default_rng(0).random((3, 40, 35)).astype(np.float32)
    blocks = light(planes)
    assert blocks.shape == (3, 2, 2)
    np.testing.assert_allclose(blocks[1, 1, 0], planes[1, 16:32, :16].mean(), rtol=1e-5)


# ---- the file --------------------------------------------------------------------------------------------------------

FOUND = RigErrors(3.0, 0.2, -0.2, 0.2, 2.0, (0.0, 0.1), ((0.99, 1.01), (1.0, 1.0)))


def a_calibration():
    known = RigErrors(0.01, 0.001, 0.005, 0.004, 0.2, (0.0, 0.01))
    return Calibration("lock", FOUND, known, (0.0, 0.0), (Slip(1, 0.1, 0.01),), ((0.02, 0.001), (0.0, np.inf)), 0.0035, 0.04, 100)


@pytest.mark.parametrize("name", ["rig.json", "rig.toml"])
def test_a_file_gives_back_the_errors(tmp_path, name):
    save_calibration(tmp_path / name, a_calibration())
    assert load_errors(tmp_path / name) == FOUND


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"format": "else"}, "format"),
        ({"errors": None}, "errors"),
        ({"errors": {"axis_px": "3"}}, "errors.axis_px"),
        ({"errors": {**FOUND.__dict__, "angles_deg": [0, None]}}, "errors.angles_deg"),
        ({"errors": {**FOUND.__dict__, "gains": [[1], 1]}}, "gain"),
    ],
)
def test_a_damaged_file_is_named_with_the_field(tmp_path, change, named):
    path = tmp_path / "rig.json"
    save_calibration(path, a_calibration())
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(StrandscopeError, match=named) as error:
        load_errors(path)
    assert "rig.json" in str(error.value)


def test_a_calibration_is_for_its_own_capture():
    sweeps = tuple(Sweep(float(k), (0.0, 0.2), ("a", "b")) for k in range(3))
    with pytest.raises(StrandscopeError, match="3 sweeps"):
        FOUND.corrected(Capture(".", "other", OPTICS, sweeps))


def test_corrections_are_true_minus_stated():
    sweeps = tuple(Sweep(30.0 * k, (0.0, 0.2), (f"a{k}", f"b{k}")) for k in range(2))
    rig = FOUND.corrected(Capture(".", "lock", OPTICS, sweeps))
    assert rig.optics.axis_col_px == OPTICS.axis_col_px + 3
    assert (rig.optics.tilt_deg, rig.optics.tilt_towards_deg) == (0.2, -0.2)
    assert rig.optics.working_distance_mm == 332
    assert rig.optics.pitch_mm / 332 == pytest.approx(OPTICS.pitch_mm / 330)  # the field of view stays
    assert [s.angle_deg for s in rig.sweeps] == [0.0, 30.1]
    assert rig.sweeps[1].positions_mm == (0.2, 0.4)
    assert rig.gains == {"a0": 0.99, "b0": 1.01, "a1": 1.0, "b1": 1.0}


def test_a_file_from_before_targets_has_no_distortion(tmp_path):
    save_calibration(tmp_path / "rig.json", a_calibration())
    head = json.loads((tmp_path / "rig.json").read_text())
    head["errors"] = {name: value for name, value in head["errors"].items() if name not in ("pitch_parts", "travel_deg", "travel_up_deg")}
    head["errors"].pop("k1_per_mm2")
    (tmp_path / "rig.json").write_text(json.dumps(head))
    assert load_errors(tmp_path / "rig.json") == FOUND


def test_what_a_target_tells_is_corrected_too():
    sweeps = tuple(Sweep(30.0 * k, (0.0, 0.2), (f"a{k}", f"b{k}")) for k in range(2))
    wrong = RigErrors(working_distance_mm=3.3, pitch_parts=0.005, travel_deg=0.2, travel_up_deg=-0.1, k1_per_mm2=2e-6, k2_per_mm4=1e-10)
    optics = wrong.corrected(Capture(".", "lock", OPTICS, sweeps)).optics
    assert optics.pitch_mm == pytest.approx(OPTICS.pitch_mm * (1 + 3.3 / OPTICS.working_distance_mm) * 1.005)
    assert (optics.travel_deg, optics.travel_up_deg, optics.k1_per_mm2, optics.k2_per_mm4) == (0.2, -0.1, 2e-6, 1e-10)


def test_a_change_found_later_leaves_what_the_target_told():
    sweeps = tuple(Sweep(30.0 * k, (0.0, 0.2), (f"a{k}", f"b{k}")) for k in range(2))
    begun = RigErrors(axis_px=1.0, working_distance_mm=1.0, pitch_parts=0.005, k1_per_mm2=2e-6)
    change = np.zeros(FIRST_SWEEP + 2)
    change[0], change[4] = 0.01, 0.001
    capture = Capture(".", "lock", OPTICS, sweeps)
    after = begun.plus(change, capture)
    assert (after.pitch_parts, after.k1_per_mm2) == (0.005, 2e-6)
    assert after.axis_px == pytest.approx(1.0 + 0.01 / begun.corrected(capture).optics.pitch_mm)
    pitches = [errors.corrected(capture).optics.pitch_mm for errors in (begun, after)]
    assert pitches[1] / pitches[0] == pytest.approx(1.001)


def test_people_are_told_every_error_and_what_is_none():
    rows = dict(row for row in describe(replace(a_calibration(), errors=replace(FOUND, focus_mm=0.001))) if row)
    assert rows["axis"].startswith("+3.000 ± 0.010 px")
    assert "none that is sure" in rows["focus"]
    assert "none that is sure" not in rows["working distance"]
    assert rows["step to sweep 1"].startswith("+0.1000 ± 0.0100 °")
    assert rows["gain"].startswith("+2.00 ±")
    assert "pitch" not in rows
    told = dict(row for row in describe(replace(a_calibration(), errors=replace(FOUND, pitch_parts=0.005, k1_per_mm2=3e-6))) if row)
    assert told["pitch"].startswith("+0.500 %")
    assert told["distortion k1"].startswith("+3e-06")
    assert len(astuple(FOUND)) == 12
