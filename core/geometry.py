"""Axes, signs and units: how a point on a hair, a photograph and a pixel belong together. Stands here and nowhere else.

Object frame (mm, right-handed): y is the axis of the turntable, up. At turntable angle 0 the camera is on the +z side and
looks along -z; image right is +u, image up is +v, and (0, 0) is where the optical axis meets the image. The turntable
turns the hair by theta, right-handed about +y. d is the signed distance from the axis to the plane of focus, positive
towards the camera; the lens is at w = d + l. Image coordinates are mm on the plane of focus.

The functions of single coordinates are written for floats and arrays alike, so that numba kernels compile these very
functions (``njit(turn)``) and no formula is written twice. Sections and equations are those of Jakob et al. 2009; its
section 3 and eq. (2) differ by a mirror, ours is eq. (2) with w = -z_paper.
"""

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Optics:
    """What ties a channel plane (one Bayer channel at half resolution) to millimetres."""

    working_distance_mm: float  # l: lens to plane of focus
    pitch_mm: float  # width of a pixel of the channel plane, on the plane of focus
    axis_col_px: float  # column of the rotation axis, pixel centres at integers
    axis_row_px: float  # row where the optical axis meets the image
    aperture_cone_deg: float  # full angle of the cone of rays that meet in a point of the plane of focus
    tilt_deg: float = 0.0  # how far the upper end of the rotation axis leans to the right in the image
    tilt_towards_deg: float = 0.0  # and how far towards the camera
    travel_deg: float = 0.0  # the stage leads the camera to the right of the line of sight by this as it draws back (d grows)
    travel_up_deg: float = 0.0  # and upwards
    k1_per_mm2: float = 0.0  # distortion: a pixel r mm from the middle of the image belongs 1 + k1 r² + k2 r⁴ times as far from it
    k2_per_mm4: float = 0.0

    def reduced(self, by: int) -> "Optics":
        """Those of photographs of which ``by`` times ``by`` pixels have become one."""
        col, row = ((px - 0.5 * (by - 1)) / by for px in (self.axis_col_px, self.axis_row_px))
        return replace(self, pitch_mm=by * self.pitch_mm, axis_col_px=col, axis_row_px=row)

    @property
    def displaces(self) -> bool:
        """Whether photographs show things aside of where an ideal lens on a stage along its line of sight would."""
        return any((self.travel_deg, self.travel_up_deg, self.k1_per_mm2, self.k2_per_mm4))

    def ideal(self) -> "Optics":
        """Those of a rig that neither leans nor distorts: under them pixels are what photographs show, not set right."""
        return replace(self, tilt_deg=0.0, tilt_towards_deg=0.0, travel_deg=0.0, travel_up_deg=0.0, k1_per_mm2=0.0, k2_per_mm4=0.0)


# ---- single coordinates: floats or arrays, also compiled into kernels ------------------------------------------------


def turn(x, y, z, cos_theta, sin_theta):
    """Object frame -> camera frame (u', v', w): the hair turned by theta, w towards the camera. mm."""
    return x * cos_theta + z * sin_theta, y, z * cos_theta - x * sin_theta


def turn_back(u, v, w, cos_theta, sin_theta):
    """Camera frame (u', v', w) -> object frame (x, y, z), the inverse of ``turn``. mm."""
    return u * cos_theta - w * sin_theta, v, u * sin_theta + w * cos_theta


def tilt(u, v, w, cos_right, sin_right, cos_towards, sin_towards):
    """Frame of the rotation axis -> camera frame, where the axis leans: its upper end towards the camera, then to the right.
    Both turns are about the point where the optical axis meets the rotation axis. mm."""
    v, w = v * cos_towards - w * sin_towards, w * cos_towards + v * sin_towards
    return u * cos_right + v * sin_right, v * cos_right - u * sin_right, w


def tilt_back(u, v, w, cos_right, sin_right, cos_towards, sin_towards):
    """Camera frame -> frame of the rotation axis, the inverse of ``tilt``. mm."""
    u, v = u * cos_right - v * sin_right, v * cos_right + u * sin_right
    return u, v * cos_towards + w * sin_towards, w * cos_towards - v * sin_towards


def project(u, v, w, focus_mm, working_distance_mm):
    """Camera frame (u', v', w) -> image (u, v) in mm on the plane of focus at d = focus_mm (eq. 2)."""
    scale = working_distance_mm / (working_distance_mm + focus_mm - w)
    return u * scale, v * scale


def slope(u, v, working_distance_mm):
    """s = (du/dd, dv/dd, 1): how the image of a point in focus moves with the camera, in (u, v, d) (sec. 4.2)."""
    return -u / working_distance_mm, -v / working_distance_mm, 1.0


def to_pixel(u, v, pitch_mm, axis_col_px, axis_row_px):
    """Image mm -> (column, row) of the channel plane, pixel centres at integers."""
    return axis_col_px + u / pitch_mm, axis_row_px - v / pitch_mm


def to_image(col, row, pitch_mm, axis_col_px, axis_row_px):
    """(column, row) of the channel plane -> image (u, v) in mm on the plane of focus."""
    return (col - axis_col_px) * pitch_mm, (axis_row_px - row) * pitch_mm


def straighten(x, y, k1, k2):
    """Where a point of the image, mm from its middle, belongs without the lens's distortion (the radial terms of Brown 1971, sec. 2)."""
    square = x * x + y * y
    scale = 1.0 + square * (k1 + square * k2)
    return x * scale, y * scale


def distort(x, y, k1, k2):
    """Where the lens puts a point of the image, mm from its middle: the inverse of ``straighten``, to 1e-9 for distortions up to a tenth."""
    at_x, at_y = x, y
    for _ in range(12):
        square = at_x * at_x + at_y * at_y
        scale = 1.0 + square * (k1 + square * k2)
        at_x, at_y = x / scale, y / scale
    return at_x, at_y


# ---- whole arrays ----------------------------------------------------------------------------------------------------


def camera_points(points_mm, angle_deg, optics=None):
    """points_mm (..., 3) of the object frame -> (..., 3) of the camera frame at a turntable angle, mm.

    Without ``optics`` the axis stands upright; with them it leans as they say.
    """
    theta = np.radians(angle_deg)
    turned = turn(*np.moveaxis(np.asarray(points_mm), -1, 0), np.cos(theta), np.sin(theta))
    return np.stack(tilt(*turned, *tilt_of(optics)) if optics is not None else turned, axis=-1)


def tilt_of(optics):
    """(cos, sin) of the tilt to the right and (cos, sin) of the tilt towards the camera, as ``tilt`` takes them."""
    right, towards = np.radians([optics.tilt_deg, optics.tilt_towards_deg])
    return np.cos(right), np.sin(right), np.cos(towards), np.sin(towards)


def travelled(optics, focus_mm):
    """How far right and up (mm) the stage has led the camera off its line of sight where the plane of focus is at d = focus_mm."""
    return np.tan(np.radians(optics.travel_deg)) * focus_mm, np.tan(np.radians(optics.travel_up_deg)) * focus_mm


def set_right(col, row, focus_mm, optics, shape):
    """Pixels of a photograph of ``shape`` (rows, columns) -> (column, row) where a lens that does not distort, on a stage that moves
    along its line of sight, would have put what is in focus."""
    middle_col, middle_row, pitch = (shape[1] - 1) / 2, (shape[0] - 1) / 2, optics.pitch_mm
    x, y = straighten((col - middle_col) * pitch, (row - middle_row) * pitch, optics.k1_per_mm2, optics.k2_per_mm4)
    right, up = travelled(optics, focus_mm)
    return middle_col + (x + right) / pitch, middle_row + (y - up) / pitch


def as_photographed(col, row, focus_mm, optics, shape):
    """Where a photograph of ``shape`` (rows, columns) shows what belongs to a pixel: the inverse of ``set_right``."""
    middle_col, middle_row, pitch = (shape[1] - 1) / 2, (shape[0] - 1) / 2, optics.pitch_mm
    right, up = travelled(optics, focus_mm)
    x, y = distort((col - middle_col) * pitch - right, (row - middle_row) * pitch + up, optics.k1_per_mm2, optics.k2_per_mm4)
    return middle_col + x / pitch, middle_row + y / pitch


def object_points(points_mm, angle_deg):
    """points_mm (..., 3) of the camera frame at a turntable angle -> (..., 3) of the object frame, mm."""
    theta = np.radians(angle_deg)
    return np.stack(turn_back(*np.moveaxis(np.asarray(points_mm), -1, 0), np.cos(theta), np.sin(theta)), axis=-1)


def pixels(points_mm, angle_deg, focus_mm, optics, shape=None):
    """Where points (..., 3) mm of the object frame appear in a photograph: (..., 3) of column, row (px) and w (mm).

    With its ``shape`` (rows, columns), that is as the lens and the stage of ``optics`` show what is near the plane of focus.
    """
    u, v, w = np.moveaxis(camera_points(points_mm, angle_deg, optics), -1, 0)
    u, v = project(u, v, w, focus_mm, optics.working_distance_mm)
    col, row = to_pixel(u, v, optics.pitch_mm, optics.axis_col_px, optics.axis_row_px)
    if shape is not None:
        col, row = as_photographed(col, row, focus_mm, optics, shape)
    return np.stack([col, row, w], axis=-1)
