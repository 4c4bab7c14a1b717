"""Axes and signs, against numbers worked out by hand and against the laws they must obey."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import njit

from strandscope.core import geometry
from strandscope.core.geometry import Optics, camera_points, object_points, pixels, project, slope, tilt, tilt_back, tilt_of, to_image, to_pixel

MM = st.floats(-40, 40)
OPTICS = Optics(working_distance_mm=330.0, pitch_mm=1 / 35, axis_col_px=1096.5, axis_row_px=731.0, aperture_cone_deg=10.0)


@pytest.mark.parametrize(
    ("point", "angle_deg", "expected"),
    [
        ((1, 2, 3), 0, (1, 2, 3)),
        ((0, 0, 1), 90, (1, 0, 0)),  # what was nearest to the camera has turned to its right
        ((1, 0, 0), 90, (0, 0, -1)),  # and what was right, to the far side
        ((1, 5, 0), 180, (-1, 5, 0)),
        ((2, 0, 2), 45, (2 * np.sqrt(2), 0, 0)),
    ],
)
def test_the_turntable_turns_right_handed_about_y(point, angle_deg, expected):
    np.testing.assert_allclose(camera_points(point, angle_deg), expected, atol=1e-12)


@given(st.tuples(MM, MM, MM), st.floats(-720, 720))
def test_turning_back_undoes_turning_and_keeps_lengths(point, angle_deg):
    turned = camera_points(point, angle_deg)
    np.testing.assert_allclose(object_points(turned, angle_deg), point, atol=1e-9)
    assert np.linalg.norm(turned) == pytest.approx(np.linalg.norm(point), abs=1e-9)


@pytest.mark.parametrize(
    ("point", "expected"),
    [
        ((0, 10, 0), (10 * np.sin(0.02), 10 * np.cos(0.02), 0)),  # the upper end of the axis leans to the right
        ((3, 0, 0), (3 * np.cos(0.02), -3 * np.sin(0.02), 0)),
        ((0, 0, 5), (0, 0, 5)),
    ],
)
def test_an_axis_may_lean_to_the_right(point, expected):
    np.testing.assert_allclose(camera_points(point, 0, replace(OPTICS, tilt_deg=np.degrees(0.02))), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("point", "expected"),
    [
        ((0, 10, 0), (0, 10 * np.cos(0.02), 10 * np.sin(0.02))),  # the upper end of the axis leans towards the camera
        ((0, 0, 5), (0, -5 * np.sin(0.02), 5 * np.cos(0.02))),
        ((3, 0, 0), (3, 0, 0)),
    ],
)
def test_an_axis_may_lean_towards_the_camera(point, expected):
    np.testing.assert_allclose(camera_points(point, 0, replace(OPTICS, tilt_towards_deg=np.degrees(0.02))), expected, atol=1e-12)


@given(MM, MM, MM, st.floats(-5, 5), st.floats(-5, 5))
def test_tilting_back_undoes_tilting(u, v, w, right_deg, towards_deg):
    how = tilt_of(replace(OPTICS, tilt_deg=right_deg, tilt_towards_deg=towards_deg))
    np.testing.assert_allclose(tilt_back(*tilt(u, v, w, *how), *how), (u, v, w), atol=1e-9)


@given(MM, MM, MM)
def test_a_point_in_focus_is_where_it_appears(u, v, d):
    assert project(u, v, d, d, 330.0) == pytest.approx((u, v))


def test_perspective_by_hand():
    # 10 mm nearer than the plane of focus, which is 330 mm from the lens: 320 mm, seen larger by 330 / 320
    assert project(3.2, -6.4, 10.0, 0.0, 330.0) == pytest.approx((3.3, -6.6))
    assert project(3.2, -6.4, 15.0, 5.0, 330.0) == pytest.approx((3.3, -6.6))


@given(MM, MM, MM)
def test_slope_is_how_the_image_moves_with_the_camera(u, v, d):
    step = 1e-4
    ahead, behind = (np.array(project(u, v, d, d + side * step, 330.0)) for side in (1, -1))
    np.testing.assert_allclose((ahead - behind) / (2 * step), slope(u, v, 330.0)[:2], atol=1e-6)
    assert slope(u, v, 330.0)[2] == 1.0


SHAPE = (1462, 2193)
BENT = replace(OPTICS, travel_deg=0.3, travel_up_deg=-0.2, k1_per_mm2=8e-6, k2_per_mm4=-1e-9)


@given(st.floats(0, 2192), st.floats(0, 1461), st.floats(-40, 40))
def test_what_is_set_right_goes_back_to_where_it_was_photographed(col, row, d):
    there = geometry.set_right(col, row, d, BENT, SHAPE)
    assert geometry.as_photographed(*there, d, BENT, SHAPE) == pytest.approx((col, row), abs=1e-5)


def test_distortion_by_hand():
    # 700 px right of the middle: 20 mm, k1 r² = 0.0004: it belongs 0.28 px farther out
    optics = replace(OPTICS, k1_per_mm2=1e-6)
    assert geometry.set_right(1096.0 + 700, 730.5, 0.0, optics, SHAPE) == pytest.approx((1096.0 + 700.28, 730.5))
    assert geometry.set_right(1096.0, 730.5 - 700, 0.0, optics, SHAPE) == pytest.approx((1096.0, 730.5 - 700.28))


def test_a_stage_that_leads_the_camera_to_the_right_shows_things_farther_left():
    aside = replace(OPTICS, travel_deg=np.degrees(np.arctan(0.01)), travel_up_deg=np.degrees(np.arctan(0.02)))
    point = np.array([[3.0, 1.0, 10.0]])  # in focus at d = 10, where the camera is 0.1 mm to the right and 0.2 mm up: 3.5 px and 7 px
    seen, ideal = pixels(point, 0.0, 10.0, aside, SHAPE)[0], pixels(point, 0.0, 10.0, OPTICS, SHAPE)[0]
    np.testing.assert_allclose(seen - ideal, (-3.5, 7.0, 0.0), atol=1e-9)
    assert geometry.set_right(seen[0], seen[1], 10.0, aside, SHAPE) == pytest.approx(tuple(ideal[:2]))


def test_optics_of_reduced_photographs_bend_the_same_light():
    small = BENT.reduced(3)
    col, row = geometry.set_right(1900.0, 200.0, 5.0, BENT, SHAPE)
    less = geometry.set_right((1900.0 - 1) / 3, (200.0 - 1) / 3, 5.0, small, (1462 // 3, 2193 // 3))
    assert less == pytest.approx(((col - 1) / 3, (row - 1) / 3), abs=0.02)  # the middle is where it was, to half a pixel that was cut off


def test_right_is_up_the_columns_and_up_is_down_the_rows():
    assert to_pixel(1.0, 0.0, 1 / 35, 100.0, 50.0) == pytest.approx((135.0, 50.0))
    assert to_pixel(0.0, 1.0, 1 / 35, 100.0, 50.0) == pytest.approx((100.0, 15.0))


@given(st.floats(-10, 3000), st.floats(-10, 3000))
def test_pixels_and_millimetres_are_inverse(col, row):
    assert to_pixel(*to_image(col, row, 1 / 35, 1096.5, 731.0), 1 / 35, 1096.5, 731.0) == pytest.approx((col, row), abs=1e-9)


def test_a_point_on_the_axis_keeps_its_column_while_the_turntable_turns():
    seen = [pixels([[0.0, 4.0, 0.0]], angle, 0.0, OPTICS)[0] for angle in range(0, 360, 15)]
    np.testing.assert_allclose(seen, np.tile([1096.5, 731.0 - 140.0, 0.0], (24, 1)), atol=1e-9)


def test_arrays_of_any_shape_agree_with_single_points():
    points = np.random.default_rng(0).normal(size=(2, 3, 3))
    whole = pixels(points, 30.0, 1.5, OPTICS)
    for i, j in np.ndindex(2, 3):
        np.testing.assert_allclose(whole[i, j], pixels(points[i, j], 30.0, 1.5, OPTICS))


def test_kernels_compile_the_same_formulas():
    assert njit(geometry.turn)(1.0, 2.0, 3.0, 0.6, 0.8) == pytest.approx(geometry.turn(1.0, 2.0, 3.0, 0.6, 0.8))
    assert njit(geometry.turn_back)(1.0, 2.0, 3.0, 0.6, 0.8) == pytest.approx(geometry.turn_back(1.0, 2.0, 3.0, 0.6, 0.8))
    assert njit(geometry.project)(1.0, 2.0, 3.0, 0.5, 330.0) == pytest.approx(project(1.0, 2.0, 3.0, 0.5, 330.0))
