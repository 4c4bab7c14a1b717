"""What is known beforehand: drawn lines with their place and angle, and the observations of curves given in space.

The projection is written here a second time, from the definition of axes and signs and not from ``core.geometry``, so that
a sign that is wrong there, or in a kernel, does not cancel out.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import erf

from strandscope.core.features import SweepFeatures, pack
from strandscope.core.geometry import Optics
from strandscope.core.ridges import Ridges

SHAPE = (210, 150)  # rows and columns of a channel plane: 6.0 x 4.3 mm
OPTICS = Optics(working_distance_mm=330.0, pitch_mm=1 / 35, axis_col_px=74.5, axis_row_px=104.5, aperture_cone_deg=10.0)
POSITIONS_MM = np.linspace(-2.0, 2.0, 21)  # d of a sweep


# ---- lines in a photograph -------------------------------------------------------------------------------------------


def drawn_line(shape, angle, through, width_px=2.8, blur_px=0.5, height=0.2, samples=4, rounded=False) -> np.ndarray:
    """A bar of light on black, (H, W) float64: ``width_px`` wide, blurred by a Gaussian, averaged over each pixel's square.

    angle: from +u (right) towards +v (up), rad. through: (column, row) of a point on its middle, pixel centres at integers.
    rounded: as bright as a lit cylinder is, which is dark at its rims; else evenly bright.
    """
    fine = (np.arange(samples) + 0.5) / samples - 0.5
    col = (np.arange(shape[1])[:, None] + fine).ravel()
    row = (np.arange(shape[0])[:, None] + fine).ravel()
    x = across(angle, through, col, row[:, None])
    place = np.arange(-4 * width_px - 8 * blur_px, 4 * width_px + 8 * blur_px, 0.01)
    # distance from the middle to the edges, as seen by the Gaussian; a rounded bar is a stack of even ones
    layers = np.sqrt(1 - ((np.arange(16) + 0.5) / 16) ** 2) if rounded else np.ones(1)
    reach, edge = layers[:, None] * width_px / 2, np.sqrt(2) * blur_px
    profile = np.mean(0.5 * (erf((place + reach) / edge) - erf((place - reach) / edge)), axis=0)
    light = np.interp(x, place, profile, left=0.0, right=0.0)
    return height * light.reshape(shape[0], samples, shape[1], samples).mean(axis=(1, 3))


def across(angle, through, col, row):
    """Signed distance (px) of pixels from a line; rows run down and v runs up."""
    return -(col - through[0]) * np.sin(angle) - (row - through[1]) * np.cos(angle)


def along(angle, through, col, row):
    """Place (px) of pixels along a line."""
    return (col - through[0]) * np.cos(angle) - (row - through[1]) * np.sin(angle)


def turn_between(a, b):
    """Smallest turn (rad, signed) from orientation b to a; orientations repeat after pi."""
    off = np.asarray(a) - b
    return off - np.pi * np.round(off / np.pi)


# ---- curves in space -------------------------------------------------------------------------------------------------


def line(at=(0.3, 0.0, -0.2), way=(0.1, 1.0, 0.15), half_mm=4.0) -> np.ndarray:
    """A straight fiber: points (n, 3) mm, 5 um apart, around ``at``."""
    way = np.asarray(way) / np.linalg.norm(way)
    return np.asarray(at) + np.arange(-half_mm, half_mm, 0.005)[:, None] * way


def helix(radius_mm=1.2, pitch_mm=20.0, right_handed=True, half_mm=4.0) -> np.ndarray:
    """A helix about +y. Right-handed: it turns from +z towards +x, as the turntable does, while it rises."""
    y = np.arange(-half_mm, half_mm, 0.004)
    turned = 2 * np.pi * y / pitch_mm * (1 if right_handed else -1)
    return np.stack([radius_mm * np.sin(turned), y, radius_mm * np.cos(turned)], axis=1)


def wave(height_mm=0.15, length_mm=8.0, half_mm=4.0) -> np.ndarray:
    """A fiber that swings about a slanted line; bends by at most 5.3 degrees a mm, a third of what the cone allows."""
    y = np.arange(-half_mm, half_mm, 0.004)
    swing = height_mm * np.sin(2 * np.pi * y / length_mm)
    return np.stack([0.2 + swing, y, -0.3 + 0.2 * y + 0.5 * swing], axis=1)


@dataclass(frozen=True)
class Seen:
    """How curves are observed."""

    angles: int = 12
    turn_deg: float = 360.0  # over which they lie evenly
    noise_px: float = 0.2  # of a feature's position, each of column and row
    noise_deg: float = 2.0
    reach_mm: float = 0.5  # a feature is seen this far from the plane of focus
    clutter: int = 0  # features a sweep that belong to nothing
    share: float = 1.0  # of the features that are kept
    seed: int = 0
    distance_mm: float = 330.0  # of the lens from the plane of focus
    breadths: tuple[float, ...] = ()  # of the ridges of each curve, with an error of 0.3 each; none: all 0

    @property
    def optics(self) -> Optics:
        return replace(OPTICS, working_distance_mm=self.distance_mm)


def in_camera(points_mm, angle_deg):
    """(u', v', w) of points (n, 3): the turntable turns the hair right-handed about +y by the angle."""
    theta = np.radians(angle_deg)
    x, y, z = np.asarray(points_mm, float).T
    return x * np.cos(theta) + z * np.sin(theta), y, -x * np.sin(theta) + z * np.cos(theta)


def observe(curves, seen: Seen = Seen(), hidden=lambda points_mm, _sweep: np.zeros(len(points_mm), bool)) -> list[SweepFeatures]:
    """The features of curves, a list of (n, 3) mm, from each of the angles.

    A photograph at d gives, of every point with |w - d| <= reach, one feature a row that the image crosses, or a column
    where it lies flat. hidden(points, sweep) (n,) bool: the points of a curve that this sweep does not see.
    """
    rng = np.random.default_rng(seen.seed)
    return [_sweep(curves, k, seen, hidden, rng) for k in range(seen.angles)]


def _sweep(curves, k, seen, hidden, rng) -> SweepFeatures:
    angle_deg = seen.turn_deg * k / seen.angles
    photographs = []
    for d in POSITIONS_MM:
        found, clutter = [_crossings(c, ~hidden(c, k), angle_deg, d, seen) for c in curves], _clutter(seen, rng)
        breadth = np.repeat([*seen.breadths, 0.0] if seen.breadths else np.zeros(len(curves) + 1), [f.shape[1] for f in (*found, clutter)])
        col, row, angle, strength = np.concatenate([*found, clutter], axis=1)
        col, row = col + rng.normal(0, seen.noise_px, len(col)), row + rng.normal(0, seen.noise_px, len(col))
        angle = (angle + np.radians(rng.normal(0, seen.noise_deg, len(col)))) % np.pi
        inside = (col >= 0) & (col <= SHAPE[1] - 1) & (row >= 0) & (row <= SHAPE[0] - 1) & (rng.random(len(col)) < seen.share)
        if seen.breadths:
            breadth = breadth + rng.normal(0, 0.3, len(breadth))
        photographs.append(Ridges(*(np.float32(a[inside]) for a in (col, row, angle, strength, breadth))))
    return pack(angle_deg, POSITIONS_MM, SHAPE, photographs)


def _clutter(seen, rng):
    low, high = (0, 0, 0, 0.2), (SHAPE[1] - 1, SHAPE[0] - 1, np.pi, 1)
    return rng.uniform(low, high, (seen.clutter // len(POSITIONS_MM), 4)).T


def _crossings(points, shown, angle_deg, d, seen):
    """(4, m): column, row, angle and strength of a curve in the photograph at d."""
    u, v, w = in_camera(points, angle_deg)
    scale = seen.distance_mm / (seen.distance_mm + d - w)
    col, row = OPTICS.axis_col_px + u * scale / OPTICS.pitch_mm, OPTICS.axis_row_px - v * scale / OPTICS.pitch_mm
    steps_col, steps_row = np.diff(col), np.diff(row)
    steep = np.abs(steps_row) >= np.abs(steps_col)
    counted = np.where(steep, row[:-1], col[:-1])
    step = np.where(steep, steps_row, steps_col)
    crossed = np.where(step > 0, np.ceil(counted), np.floor(counted))
    t = (crossed - counted) / np.where(step == 0, np.inf, step)
    at = np.flatnonzero((t < 1) & (step != 0) & (np.abs(w[:-1] - d) <= seen.reach_mm) & shown[:-1])
    t, off = t[at], (w[at] - d) / 0.3
    return np.stack(
        [col[at] + t * steps_col[at], row[at] + t * steps_row[at], np.arctan2(-steps_row[at], steps_col[at]) % np.pi, 0.5 * np.exp(-0.5 * off**2)]
    )


def densely(points) -> np.ndarray:
    """The polyline of points (n, 3), with forty points a segment."""
    at = np.linspace(0, len(points) - 1, 40 * (len(points) - 1) + 1)
    return np.stack([np.interp(at, np.arange(len(points)), x) for x in np.asarray(points, float).T], axis=1)


def in_volume(points_mm, seen: Seen, at_least=3) -> np.ndarray:
    """(n,) bool: points that at least three sweeps have in their field and in their range of focus."""
    count = np.zeros(len(points_mm), int)
    for k in range(seen.angles):
        u, v, w = in_camera(points_mm, seen.turn_deg * k / seen.angles)
        col, row = OPTICS.axis_col_px + u / OPTICS.pitch_mm, OPTICS.axis_row_px - v / OPTICS.pitch_mm
        count += (col >= 0) & (col <= SHAPE[1] - 1) & (row >= 0) & (row <= SHAPE[0] - 1) & (w >= POSITIONS_MM[0]) & (w <= POSITIONS_MM[-1])
    return count >= at_least
