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

    def reduced(self, by: int) -> "Optics":
        """Those of photographs of which ``by`` times ``by`` pixels have become one."""
        col, row = ((px - 0.5 * (by - 1)) / by for px in (self.axis_col_px, self.axis_row_px))
        return replace(self, pitch_mm=by * self.pitch_mm, axis_col_px=col, axis_row_px=row)


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


def object_points(points_mm, angle_deg):
    """points_mm (..., 3) of the camera frame at a turntable angle -> (..., 3) of the object frame, mm."""
    theta = np.radians(angle_deg)
    return np.stack(turn_back(*np.moveaxis(np.asarray(points_mm), -1, 0), np.cos(theta), np.sin(theta)), axis=-1)


def pixels(points_mm, angle_deg, focus_mm, optics):
    """Where points (..., 3) mm of the object frame appear in a photograph: (..., 3) of column, row (px) and w (mm)."""
    u, v, w = np.moveaxis(camera_points(points_mm, angle_deg, optics), -1, 0)
    u, v = project(u, v, w, focus_mm, optics.working_distance_mm)
    return np.stack([*to_pixel(u, v, optics.pitch_mm, optics.axis_col_px, optics.axis_row_px), w], axis=-1)
