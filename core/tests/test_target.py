"""A printed target: the PDF that is printed, corners in photographs of it, and the rig that they tell, against rigs that are known."""

import importlib.util
import json
import re
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from strandscope.core.capture import load_capture
from strandscope.core.cli import run
from strandscope.core.compare import load_truth, score
from strandscope.core.errors import StrandscopeError
from strandscope.core.geometry import Optics
from strandscope.core.pipeline import preset, reconstruct
from strandscope.core.rig.calibrate import RigErrors, calibrated, load_errors, read_calibration, write_calibration
from strandscope.core.rig.target import Target, depth_from_focus, find_corners, measure_corners
from strandscope.core.rig.target_calibrate import calibrate_by_target, summed_up
from strandscope.core.rig.target_fit import FIRST_ANGLE, UNKNOWNS, Corners, Model, appear, begin, optics_of, rotation, solve
from strandscope.core.rig.target_pdf import print_target
from strandscope.core.rig.target_words import describe, warnings
from strandscope.core.simulate import Misalignment, SimulateParams
from strandscope.core.simulate_features import simulate_features
from strandscope.core.simulate_target import Mounting, TargetParams, photograph, picture, plan, simulate_target

needs_opencv = pytest.mark.skipif(importlib.util.find_spec("cv2") is None, reason="needs OpenCV (the extra `calibrate`)")
ASSET = Path(__file__).resolve().parents[2] / "assets" / "target.pdf"
TARGET, SHAPE = Target(), (365, 548)
STATED = Optics(working_distance_mm=330.0, pitch_mm=4 / 35, axis_col_px=273.5, axis_row_px=182.0, aperture_cone_deg=10.0)
WRONG = Misalignment(
    axis_px=5.0, tilt_deg=0.3, tilt_towards_deg=-0.3, focus_mm=0.5, pitch_parts=0.005, travel_deg=0.25, travel_up_deg=-0.15, k1_per_mm2=3e-6
)


# ---- the print -------------------------------------------------------------------------------------------------------


def drawn(pdf: bytes):
    """(rectangles (n, 4) of x, y, width, height, lines (n, 4) from and to) of a PDF, in mm by its own scale."""
    text = pdf.decode("ascii")
    scale = float(re.search(r"([\d.]+) 0 0 [\d.]+ 0 0 cm", text)[1]) * 25.4 / 72
    rectangles = scale * np.array([[float(x) for x in m] for m in re.findall(r"([\d.-]+) ([\d.-]+) ([\d.-]+) ([\d.-]+) re", text)])
    return rectangles, scale * np.array([[float(x) for x in m] for m in re.findall(r"([\d.-]+) ([\d.-]+) m ([\d.-]+) ([\d.-]+) l S", text)])


@needs_opencv
def test_opencv_finds_every_corner_of_the_print_in_its_place(tmp_path):
    print_target(tmp_path / "target.pdf", TARGET)
    rectangles, _ = drawn((tmp_path / "target.pdf").read_bytes())
    dots = 600 / 25.4
    page = np.ones((round(297 * dots), round(210 * dots)), np.float32)
    for x, y, width, height in rectangles * dots:
        page[round(297 * dots - y - height) : round(297 * dots - y), round(x) : round(x + width)] = 0
    found = find_corners(page, TARGET)
    assert sorted(found.corner) == list(range(len(TARGET.corners_mm)))
    place = np.stack([(found.col + 0.5) / dots, 297 - (found.row + 0.5) / dots], axis=-1)
    off = place - TARGET.corners_mm[found.corner]
    np.testing.assert_allclose(off, np.broadcast_to(off.mean(axis=0), off.shape), atol=0.04)  # a dot is 0.042 mm


@needs_opencv
def test_the_print_says_its_size_and_has_rulers_of_100_mm(tmp_path):
    print_target(tmp_path / "target.pdf", TARGET.of_squares(8.0))
    pdf = (tmp_path / "target.pdf").read_bytes()
    assert b"14 x 10 squares of 8.00 mm: 112.00 mm wide, 80.00 mm high" in pdf
    assert b"--ruler-mm" in pdf
    rectangles, lines = drawn(pdf)
    corner = rectangles[:, :2].min(axis=0), (rectangles[:, :2] + rectangles[:, 2:]).max(axis=0)
    np.testing.assert_allclose(corner[1] - corner[0], (112, 80), atol=1e-3)
    long = np.abs(lines[:, 2:] - lines[:, :2])
    assert sorted(map(tuple, np.round(long[long.max(axis=1) > 50], 3))) == [(0.0, 100.0), (100.0, 0.0)]


@needs_opencv
def test_the_target_that_ships_is_the_one_that_is_printed(tmp_path):
    if not ASSET.is_file():
        pytest.skip("not in a working copy")
    assert run(["calibrate", "--print-target", str(tmp_path / "target.pdf")]) == 0
    assert (tmp_path / "target.pdf").read_bytes() == ASSET.read_bytes()


@needs_opencv
def test_a_target_larger_than_the_page_is_refused(tmp_path):
    with pytest.raises(StrandscopeError, match="does not fit"):
        print_target(tmp_path / "target.pdf", TARGET.of_squares(14.0))


# ---- corners ---------------------------------------------------------------------------------------------------------


def board_at(position_mm, mounting, optics=STATED, angle=0.0):
    """A photograph of the board without noise, and where its corners are (n, 2) px."""
    texel = STATED.pitch_mm / 3
    plane = photograph(picture(TARGET, texel), texel, mounting, optics, angle, position_mm, SHAPE)
    x = np.zeros(FIRST_ANGLE + 1)
    x[:6] = *np.radians([mounting.facing_deg, -mounting.lean_deg, mounting.roll_deg]), mounting.right_mm, mounting.up_mm, mounting.before_mm
    every = np.arange(len(TARGET.corners_mm))
    none = Corners(*[np.zeros(0)] * 10, np.array([angle]), 1)
    model = Model(none, TARGET.corners_mm, optics, SHAPE)
    return plane, appear(x, model, every, 0 * every, np.full(len(every), position_mm))[0]


@needs_opencv
@pytest.mark.parametrize("before_mm", [0.0, 2.5, -4.0])
def test_a_corner_keeps_its_place_when_it_is_blurred(before_mm):
    """At 4 mm from the plane of focus the blur is 6 px wide, the white rim of a marker 9 px."""
    plane, where = board_at(0.0, Mounting(before_mm=before_mm))
    seen = measure_corners(plane, np.arange(len(where)), where + 0.7, np.array([7, 7]))
    assert len(seen.corner) > 60
    off = np.stack([seen.col, seen.row], axis=-1) - where[seen.corner]
    assert np.abs(off.mean(axis=0)).max() < 0.03
    assert np.sqrt(np.mean(off**2)) < 0.12


@needs_opencv
def test_markers_tell_which_corner_is_which():
    plane, where = board_at(0.0, Mounting(roll_deg=170.0))  # upside down
    seen = find_corners(plane, TARGET)
    assert len(seen.corner) > 60
    assert np.abs(np.stack([seen.col, seen.row], axis=-1) - where[seen.corner]).max() < 1
    assert not len(find_corners(np.zeros(SHAPE, np.float32), TARGET).corner)


@pytest.mark.parametrize("at", [0.0, 0.31, -0.77])
@pytest.mark.parametrize("step", [0.5, 1.0])
def test_depth_from_focus_is_where_blur_is_least(at, step):
    d = np.arange(-6, 6.1, step)
    blur = 3.0 * (d - at) * 330 / (330 + d - at)
    assert depth_from_focus(d, (1.5 + blur**2) ** -0.5, 330.0) == pytest.approx(at, abs=0.002)
    assert np.isnan(depth_from_focus(d[d > at], ((1.5 + blur**2) ** -0.5)[d > at], 330.0))  # it does not come into focus here


# ---- the fit ---------------------------------------------------------------------------------------------------------

ANGLES = np.array([-40.0, -25.0, -10.0, 5.0, 20.0, 35.0])


def told_by(wrong: RigErrors, seed=0, noise_px=0.05, noise_mm=0.02, strays=0.0, angles=ANGLES, off_deg=0.0, facing_deg=2.0, shape=SHAPE):
    """The corners that a rig with known errors would show of a board that hangs askew, with noise."""
    rng, stated = np.random.default_rng(seed), STATED
    model = Model(Corners(*[np.zeros(0)] * 10, angles, len(angles)), TARGET.corners_mm, stated, shape)
    half, x = model.half_mm, np.zeros(FIRST_ANGLE + len(angles))
    value = {
        "turn": np.radians(facing_deg), "nod": 0.01, "roll": -0.02, "x": 0.7, "y": -0.4, "z": 1.1,
        "axis": wrong.axis_px, "tilt": np.radians(wrong.tilt_deg), "tilt_towards": np.radians(wrong.tilt_towards_deg), "focus": wrong.focus_mm,
        "distance": wrong.working_distance_mm / 330, "pitch": (1 + wrong.working_distance_mm / 330) * (1 + wrong.pitch_parts) - 1,
        "travel": np.radians(wrong.travel_deg), "travel_up": np.radians(wrong.travel_up_deg),
        "k1": wrong.k1_per_mm2 * half**2, "k2": wrong.k2_per_mm4 * half**4,
    }  # fmt: skip
    x[:FIRST_ANGLE] = [value.get(name, 0.0) for name in UNKNOWNS]
    x[FIRST_ANGLE:] = np.radians(off_deg)
    n, positions = len(TARGET.corners_mm), np.arange(-26.0, 27.0, 2.0)
    sweep, corner, position = (a.ravel() for a in np.meshgrid(np.arange(len(angles)), np.arange(n), positions, indexing="ij"))
    place, w = appear(x, model, corner, sweep, position)
    inside = np.all((place > 8) & (place < np.array(shape[::-1]) - 9), axis=1) & (np.abs(position + wrong.focus_mm - w) < 3.5)
    sweep, corner, position, place = sweep[inside], corner[inside], position[inside], place[inside]
    place += rng.normal(0, noise_px, place.shape)
    stray = rng.random(len(place)) < strays
    place[stray] += rng.normal(0, 5, (stray.sum(), 2))
    focus_sweep, focus_corner = (a.ravel() for a in np.meshgrid(np.arange(len(angles)), np.arange(n), indexing="ij"))
    at, w = appear(x, model, focus_corner, focus_sweep, np.zeros(len(focus_corner)))
    inside = np.all((at > 8) & (at < np.array(shape[::-1]) - 9), axis=1)
    depth = w[inside] - wrong.focus_mm + rng.normal(0, noise_mm, inside.sum())
    corners = Corners(sweep, corner, position, *place.T, focus_sweep[inside], focus_corner[inside], depth, *at[inside].T, angles, len(angles))
    return model._replace(corners=corners), x


def found_in(model):
    start = begin(model, "board")
    return solve(model, start.x, "board")


SMALL = RigErrors(5.0, 0.3, -0.2, 0.5, 3.0, (), (), 0.004, 0.25, -0.1, 3e-6, 0.0)


def test_known_errors_are_found_and_their_uncertainty_is_true():
    """Pulls over several draws have a spread of about 1."""
    pulls = []
    for seed in range(4):
        model, true = told_by(SMALL, seed=seed)
        found = found_in(model)
        spread = np.sqrt(np.diag(found.covariance))
        own = [i for i, name in enumerate(UNKNOWNS) if name not in ("turn",)]
        pulls.append(((found.x - true) / spread)[own])
        assert found.left_px == pytest.approx(0.05, rel=0.15)
    assert 0.6 < np.sqrt(np.mean(np.square(pulls))) < 1.5
    assert optics_of(found.x, model).pitch_mm == pytest.approx(STATED.pitch_mm * (1 + 3 / 330) * 1.004, rel=1e-4)


def test_strays_are_not_heard():
    model, true = told_by(SMALL, strays=0.1)
    found = found_in(model)
    names = list(UNKNOWNS)
    for name, most in (("axis", 0.05), ("tilt", 2e-4), ("focus", 0.01), ("pitch", 1e-4), ("travel", 2e-4)):
        assert abs(found.x[names.index(name)] - true[names.index(name)]) < most, name
    assert found.heard < 0.93


@pytest.mark.parametrize("facing_deg", [-60.0, 35.0, 140.0])
def test_a_board_may_face_the_camera_at_any_angle(facing_deg):
    model, true = told_by(SMALL, angles=ANGLES - facing_deg, facing_deg=facing_deg)
    found = found_in(model)
    assert np.degrees(found.x[0]) % 360 == pytest.approx(facing_deg % 360, abs=0.2)
    assert found.x[list(UNKNOWNS).index("axis")] == pytest.approx(true[list(UNKNOWNS).index("axis")], abs=0.05)


def test_an_angle_that_the_turntable_missed_is_told():
    model, _ = told_by(SMALL, off_deg=np.array([0, 0, 0, 0.12, 0, 0]))
    found = found_in(model)
    told = summed_up(found, model, capture_of(model), TARGET)
    off = np.array(told.turns_deg)
    np.testing.assert_allclose(off[:, 1], np.array([0, 0, 0, 0.12, 0, 0]) - 0.02, atol=0.01)
    assert any("at 5° the turntable is turned" in text for text in warnings(told))


def test_what_goes_the_other_way_is_said():
    model, _ = told_by(SMALL)
    with pytest.raises(StrandscopeError, match="turntable turns the other way"):
        begin(model._replace(corners=model.corners._replace(angles_deg=-ANGLES)), "board")
    back = model.corners._replace(position_mm=-model.corners.position_mm, focus_mm=-model.corners.focus_mm)
    with pytest.raises(StrandscopeError, match="stage moves the other way"):
        begin(model._replace(corners=back), "board")


def test_too_little_is_refused():
    model, _ = told_by(SMALL, angles=np.array([0.0, 10.0]))
    with pytest.raises(StrandscopeError, match="20° or more"):
        begin(model, "board")
    model, true = told_by(SMALL)
    none = {name: getattr(model.corners, name)[:3] for name in Corners._fields if name.startswith("focus")}
    with pytest.raises(StrandscopeError, match="steps of 1 mm or less"):
        solve(model._replace(corners=model.corners._replace(**none)), true, "board")
    scattered = model.corners._replace(col=np.random.default_rng(0).uniform(0, 500, len(model.corners.col)))
    with pytest.raises(StrandscopeError, match="is the board flat"):
        solve(model._replace(corners=scattered), true, "board")


def test_the_board_turns_as_the_turntable_does():
    np.testing.assert_allclose(rotation(np.pi / 2, 0, 0) @ (0, 0, 1), (1, 0, 0), atol=1e-12)
    np.testing.assert_allclose(rotation(0, 0, np.pi / 2) @ (1, 0, 0), (0, 1, 0), atol=1e-12)
    np.testing.assert_allclose(rotation(0, 0.1, 0) @ (0, 1, 0), (0, np.cos(0.1), np.sin(0.1)), atol=1e-12)  # nodding: its top comes forward


# ---- words -----------------------------------------------------------------------------------------------------------


def capture_of(model):
    params = TargetParams(angles_deg=tuple(model.corners.angles_deg)).reduced(4)
    return replace(plan("out", params), optics=STATED)


def words_for(**wrong):
    model, _ = told_by(replace(RigErrors(), **wrong), noise_px=0.02, noise_mm=0.01)
    return warnings(summed_up(found_in(model), model, capture_of(model), TARGET))


def test_a_rig_that_is_nearly_aligned_needs_no_screw():
    assert words_for(axis_px=5.0, tilt_deg=0.3, focus_mm=0.5, pitch_parts=0.005) == []


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"axis_px": 40.0}, "4.6 mm right of the middle of the image: move the turntable to the left"),
        ({"tilt_deg": 0.9}, "0.90° to the right in the image: loosen the lens collar and turn the camera clockwise"),
        ({"tilt_deg": -0.9}, "turn the camera counterclockwise"),
        ({"tilt_towards_deg": 1.0}, "down at the axis: point the lens up"),
        (
            {"travel_deg": 1.0},
            "to the right of its line of sight as it draws back: loosen the camera's screw on the stage and turn the lens to the le",
        ),
        ({"travel_up_deg": -1.0}, "down as it draws back: tip the lens up"),
        ({"focus_mm": -1.5}, "1.50 mm farther from the camera than the stage says"),
        ({"pitch_parts": 0.05}, "8.33 px wide, stated as 8.75 px"),
        ({"working_distance_mm": 20.0}, "350 mm, stated as 330 mm"),
    ],
)
def test_each_misalignment_has_its_screw(wrong, said):
    assert any(said in text for text in words_for(**wrong)), words_for(**wrong)


# ---- from photographs ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    """A capture of the target by a rig that is off in all ways, a quarter of the pixels each way."""
    if importlib.util.find_spec("cv2") is None:
        pytest.skip("needs OpenCV (the extra `calibrate`)")
    out = tmp_path_factory.mktemp("target") / "board"
    params = TargetParams(angles_deg=(-35.0, -15.0, 5.0, 30.0), step_mm=1.5, beyond_mm=4.0, misalignment=WRONG, rays=32)
    simulate_target(out, params.reduced(4))
    return out


@pytest.fixture(scope="module")
def told(board):
    return calibrate_by_target(board, board.parent / "rig.json")


def test_known_errors_are_found_in_photographs(told):
    """Each to 5 % of the error or to 0.2 px, whichever is more; 0.2 px of a width is told over half the image, of a depth by the blur."""
    errors, half_px = told.errors, 274
    assert errors.axis_px == pytest.approx(WRONG.axis_px, abs=0.2)
    assert errors.tilt_deg == pytest.approx(WRONG.tilt_deg, abs=max(0.05 * 0.3, np.degrees(0.2 / half_px)))
    assert errors.tilt_towards_deg == pytest.approx(WRONG.tilt_towards_deg, abs=max(0.05 * 0.3, np.degrees(0.2 / half_px)))
    assert errors.focus_mm == pytest.approx(WRONG.focus_mm, rel=0.05)
    assert told.optics.pitch_mm / told.stated.pitch_mm - 1 == pytest.approx(WRONG.pitch_parts, rel=0.05)
    assert errors.travel_deg == pytest.approx(WRONG.travel_deg, rel=0.05)
    assert errors.travel_up_deg == pytest.approx(WRONG.travel_up_deg, abs=0.02)
    assert told.distortion_px[0] == pytest.approx(-1.39, rel=0.05)  # k1 r² at the corner, 37.6 mm from the middle
    assert abs(errors.working_distance_mm) < 2
    assert told.left_px < 0.15


def test_the_file_corrects_a_capture_that_states_the_same(told, board):
    capture, path = load_capture(board), board.parent / "rig.json"
    assert load_errors(path) == told.errors
    right = calibrated(path, capture)
    assert right.optics.pitch_mm == pytest.approx(told.optics.pitch_mm)
    assert right.optics.k1_per_mm2 == told.errors.k1_per_mm2
    assert right.sweeps[0].positions_mm[0] == pytest.approx(capture.sweeps[0].positions_mm[0] + told.errors.focus_mm)
    with pytest.raises(StrandscopeError, match="stated with pitch_mm"):
        calibrated(path, replace(capture, optics=replace(STATED, pitch_mm=1 / 35)))
    with pytest.raises(StrandscopeError, match="captured with the calibration already"):
        calibrated(path, right)
    assert json.loads(path.read_text())["told_by"] == "target"


def test_a_capture_that_is_corrected_scores_as_one_of_an_aligned_rig(tmp_path):
    """Hair seen by a rig that is off in all ways, with 2.5 px of distortion at the corner of its small image."""
    wrong = replace(WRONG, tilt_towards_deg=0.3, k1_per_mm2=5e-4)
    size = SimulateParams(style="wavy", scale="tiny", fibers=8, seed=3)
    aligned = simulate_features(tmp_path / "aligned", size)
    crooked = simulate_features(tmp_path / "crooked", replace(size, misalignment=wrong))
    found = replace(wrong.errors(crooked), angles_deg=(), gains=())
    write_calibration(tmp_path / "rig.json", {"errors": asdict(found), "stated": asdict(crooked.optics)})
    params = replace(preset(), infill=None)
    runs = {"aligned": (aligned, None), "left": (crooked, None), "corrected": (crooked, tmp_path / "rig.json")}
    told = {}
    for name, (capture, calibration) in runs.items():
        strands = reconstruct(capture.folder, tmp_path / f"{name}.npz", params, calibration=calibration)
        told[name] = score(strands, load_truth(capture.truth_path))
    assert told["corrected"]["recall"] > told["aligned"]["recall"] - 0.02
    assert told["corrected"]["precision"] > told["aligned"]["precision"] - 0.01
    assert told["corrected"]["pos_err_um"]["mean"] < 1.3 * told["aligned"]["pos_err_um"]["mean"]
    assert told["left"]["recall"] < told["aligned"]["recall"] - 0.1
    assert told["left"]["pos_err_um"]["mean"] > 3 * told["aligned"]["pos_err_um"]["mean"]


def test_the_command_line_tells_and_warns(board, tmp_path, capsys):
    assert run(["calibrate", str(board), "--target", "--ruler-mm", "99", "-o", str(tmp_path / "rig.toml"), "--progress", "none"]) == 0
    out, err = capsys.readouterr()
    assert "axis" in out
    optics = read_calibration(tmp_path / "rig.toml")["optics"]
    assert optics["pitch_mm"] / STATED.pitch_mm == pytest.approx(0.99 * 1.005, abs=5e-4)  # a print 1 % small makes pixels 1 % narrower
    assert "screw" not in err


def test_people_are_told_what_a_pixel_is(told):
    rows = dict(row for row in describe(told) if row)
    assert re.fullmatch(r"0\.\d+ px \(\d+\.\d µm\) in the image, \d+ µm in depth", rows["left over"])
    assert "px a mm" in rows["pitch"]
    assert set(rows) >= {"axis", "tilt", "tilt towards", "focus", "working distance", "travel", "distortion", "turntable"}


@needs_opencv
def test_photographs_of_something_else_are_refused(noise_capture, tmp_path):
    with pytest.raises(StrandscopeError, match="0 corners of the target"):
        calibrate_by_target(noise_capture, tmp_path / "rig.json")
    assert not (tmp_path / "rig.json").exists()


def test_without_opencv_it_is_said_how_to_install_it(monkeypatch, noise_capture, tmp_path):
    monkeypatch.setitem(sys.modules, "cv2", None)
    for work in (lambda: calibrate_by_target(noise_capture, None), lambda: print_target(tmp_path / "t.pdf", TARGET)):
        with pytest.raises(StrandscopeError, match=r"pip install 'strandscope\[calibrate\]'"):
            work()


@pytest.mark.parametrize(
    "argv",
    [
        ["calibrate", "lock"],
        ["calibrate", "lock", "--target", "--from-features", "-o", "rig.json"],
        ["calibrate", "--target", "-o", "rig.json"],
        ["calibrate", "lock", "--target"],
        ["calibrate", "lock", "--target", "--start", "a.json", "-o", "rig.json"],
        ["calibrate", "lock", "--print-target", "a.pdf"],
    ],
)
def test_wrong_use_is_said(argv):
    assert run(argv) == 2
