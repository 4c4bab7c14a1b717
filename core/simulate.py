"""Photographs of known hair: a groom seen through a thin lens, written as a capture with its truth.

A photograph is the mean over points on the lens. From each, all fibers are drawn as opaque cylinders of their true
radius by an exact perspective whose plane w = d stays in place, with hidden surfaces removed and with a shift of its own
below a pixel. Occlusion within the cone of rays, blur, perspective and smooth edges follow from that; nothing is blurred
afterwards.

A pixel of one colour gathers light over a whole cell of the mosaic, as behind the blur filter of such sensors.
"""

import json
import math
import os
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numba import njit

from . import geometry
from .capture import FILE_NAME, Capture, Sweep, Turntable, load_capture, save_capture
from .errors import StrandscopeError
from .files import atomic, explain
from .geometry import Optics
from .groom import STYLES, Groom, GroomParams, curvature, groom
from .progress import Progress, silent
from .raw import write_dng
from .rig.calibrate import RigErrors

BLACK, WHITE = 512, 15871  # of the sensor, 14 bit
JOURNAL = "simulation.json"  # what was asked for, to know whether a run can be continued
REVISION = 3  # raise it when the same parameters give other photographs
_SITES = ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2))  # of the RGGB cell: row, column, colour
_PROFILE = 256  # brightnesses across a fiber that are told apart
_EDGE = 32  # columns beside an image, so that a row of a fiber is drawn whole
_FINEST = 2**25 - 1024  # depths that are told apart
_MOST = 2**22 - 1  # segments


@dataclass(frozen=True)
class Scale:
    """How large a capture is: seconds or hours."""

    rows: int  # of a channel plane
    columns: int
    angles: int  # sweeps, evenly around
    half_range_mm: float  # the camera goes from d = -half_range to +half_range
    fibers: int
    lock_radius_mm: float
    turntable: int  # photographs of the validation sequence


SCALES = {
    "tiny": Scale(180, 150, 16, 1.8, 24, 1.5, 4),  # seconds
    "small": Scale(300, 240, 24, 3.0, 100, 2.8, 8),  # a minute
    "medium": Scale(420, 420, 24, 6.0, 340, 5.2, 24),  # minutes: a lock of 11 mm in 12 mm
    "slab": Scale(180, 420, 24, 6.0, 340, 5.2, 0),  # the middle 5 mm of that, to measure many locks
    "paper": Scale(1462, 2193, 24, 37.5, 3000, 18.0, 360),  # hours: the capture of the paper, sec. 3
}


@dataclass(frozen=True)
class Misalignment:
    """What is wrong with the rig that takes the photographs; capture.json keeps what its owner believes. Meaning and signs are
    those of ``RigErrors``."""

    axis_px: float = 0.0
    tilt_deg: float = 0.0
    tilt_towards_deg: float = 0.0
    focus_mm: float = 0.0
    working_distance_mm: float = 0.0
    turntable_step_deg: float = 0.0  # the step in the middle turns this much too far, once: all later sweeps are off
    every_step_deg: float = 0.0  # every step turns this much too far
    gain_drift: float = 0.0  # in each sweep the photographs gain this much light from the first to the last, in parts
    pitch_parts: float = 0.0
    travel_deg: float = 0.0
    travel_up_deg: float = 0.0
    k1_per_mm2: float = 0.0
    k2_per_mm4: float = 0.0

    def errors(self, capture: Capture) -> RigErrors:
        """The same for the sweeps of a capture."""
        k = np.arange(len(capture.sweeps))
        angles = self.every_step_deg * k + self.turntable_step_deg * (k >= len(k) // 2)
        gains = tuple(tuple(1 + self.gain_drift * np.linspace(-0.5, 0.5, len(sweep.files))) for sweep in capture.sweeps)
        rig = (self.axis_px, self.tilt_deg, self.tilt_towards_deg, self.focus_mm, self.working_distance_mm)
        lens = (self.pitch_parts, self.travel_deg, self.travel_up_deg, self.k1_per_mm2, self.k2_per_mm4)
        return RigErrors(*rig, tuple(float(a) for a in angles), gains, *lens)


# A rig that was set up with care and never checked.
MISALIGNED = Misalignment(3.0, 0.2, 0.2, 0.2, 2.0, 0.1, 0.0, 0.05)


@dataclass(frozen=True)
class SimulateParams:
    """What to simulate. The optics are those of sec. 3; the same parameters give the same bytes."""

    style: str = "straight"  # one of groom.STYLES
    scale: str | Scale = "small"  # one of SCALES, or a size of its own
    fibers: int | None = None  # None: as many as the scale has
    seed: int = 0
    working_distance_mm: float = 330.0
    pitch_mm: float = 1 / 35
    aperture_cone_deg: float = 10.0
    step_mm: float = 0.2  # between photographs of a sweep
    full_well_e: float = 15000.0  # electrons at white level: sets the shot noise
    read_noise_e: float = 6.0  # electrons, rms
    exposure: float = 0.75  # of white: what the brightest hundredth of the hair reaches in red
    open_f_number: float = 2.8  # the f-number at which the aperture has the cone above
    turntable_f_number: float = 16.0
    misalignment: Misalignment = Misalignment()

    @property
    def size(self) -> Scale:
        """The scale itself, where it has a name."""
        return self.scale if isinstance(self.scale, Scale) else SCALES[self.scale]


@dataclass(frozen=True)
class Look:
    """Colours of hair and background, linear R, G, B of the sensor relative to white."""

    hair: tuple[float, float, float]  # light that enters the fiber and comes back
    shine: float  # of the white highlight, relative to it
    depth: float  # how much of the light its own cross-section of hair takes away, about 1
    board: tuple[float, float, float] = (0.045, 0.085, 0.23)


LOOKS = {
    "straight": Look((0.60, 0.39, 0.21), 0.9, 1.0),  # medium brown
    "wavy": Look((0.80, 0.62, 0.38), 0.6, 0.7),  # blond
    "curls": Look((0.40, 0.25, 0.14), 1.4, 1.2),  # dark brown
}


# ---- the lens --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Lens:
    """The points on the lens disc from which the hair is drawn, n times; in each drawing every row has a point of its own.

    In row r, drawing i is seen from v = v_mm[i] and u = chord * (2 * frac(phase[i] + turn[r]) - 1), with chord the disc's half
    width at that v. The points of a row are a golden-ratio lattice on the disc, even in number and in every direction; the
    next row has another turn of it, so that a blurred fiber leaves no copies of itself that run along with it, and turns of
    neighbouring rows fill each other's gaps, so that little is left of the grain over the length of a filter for ridges.
    """

    radius_mm: float
    phase: np.ndarray  # (n,) 0 … 1
    v_mm: np.ndarray  # (n,)
    shift_px: np.ndarray  # (n, 2) of the whole photograph, columns and rows, -0.5 … 0.5
    turn: np.ndarray  # (rows,) 0 … 1

    def points(self, row: int) -> np.ndarray:
        """The points (n, 2) u, v in mm from which a row is seen."""
        chord = np.sqrt(np.maximum(self.radius_mm**2 - self.v_mm**2, 0))
        return np.stack([chord * (2 * ((self.phase + self.turn[row]) % 1.0) - 1), self.v_mm], axis=-1)


def lens(count: int, radius_mm: float, rows: int, rng) -> Lens:
    """``count`` points on a lens disc for an image of ``rows``; shifted by ``rng``, so that no two photographs repeat a pattern."""
    i, golden, plastic = np.arange(count), (np.sqrt(5) - 1) / 2, 1.32471795724474602596
    v = np.linspace(-1, 1, 20001)
    share = 0.5 + (v * np.sqrt(1 - v * v) + np.arcsin(v)) / np.pi  # of the disc below v
    v = np.interp((i + rng.random()) / count, share, v)
    shift = (np.stack([i / plastic, i / plastic**2], axis=-1) + rng.random(2)) % 1.0 - 0.5
    turn = (np.arange(rows) / plastic + rng.random()) % 1.0
    return Lens(radius_mm, (i * golden + rng.random()) % 1.0, radius_mm * v, shift, turn)


def aperture_radius_mm(optics: Optics) -> float:
    """Radius of the lens whose cone of rays has the full angle ``aperture_cone_deg``."""
    return optics.working_distance_mm * math.tan(math.radians(optics.aperture_cone_deg) / 2)


def lens_count(optics: Optics, depth_mm: float) -> int:
    """How many points on the lens make a fiber ``depth_mm`` out of focus an even blur.

    Four times the width of its blur in pixels: a fiber, 2 to 4 px wide, is then met by some 12 of them in each pixel, and by
    others in the next row. What is left is grain of about 0.5 % of white in dense hair, not twice the shot noise; more than
    160 are not needed for any blur, since the wider it is, the less a single fiber counts.
    """
    blur_px = 2 * aperture_radius_mm(optics) * depth_mm / (optics.working_distance_mm * optics.pitch_mm)
    return int(np.clip(4 * blur_px, 56, 160))


# ---- hair, ready to be drawn -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Hair:
    """Straight pieces of fibers in the object frame, with what it takes to shade them."""

    points_mm: np.ndarray  # (V, 3) float64
    tangents: np.ndarray  # (V, 3) unit
    radius_mm: np.ndarray  # (V,)
    fiber: np.ndarray  # (V,) int32
    tint: np.ndarray  # (V,) brightness of its own, about 1
    segments: np.ndarray  # (S,) int64: segment k joins points segments[k] and segments[k] + 1


def prepare(groom: Groom, rng, chord_error_mm: float = 0.0015) -> Hair:
    """Leave out points of a groom that a chord passes within ``chord_error_mm``, and give each fiber a tint of its own."""
    kept, tints, tangents = [], [], []
    for i in range(len(groom)):
        points = groom[i]
        keep = _thin(points, chord_error_mm)
        along = np.gradient(points, axis=0)[keep]
        tangents.append(along / np.linalg.norm(along, axis=1, keepdims=True))
        kept.append(keep + groom.offsets[i])
        tints.append(rng.lognormal(0, 0.2) * (1 + 0.06 * _texture(points[keep, 1], rng)))
    fiber = np.repeat(np.arange(len(groom), dtype=np.int32), [len(k) for k in kept])
    kept = np.concatenate(kept)
    segments = np.flatnonzero(np.diff(fiber) == 0)
    return Hair(groom.points_mm[kept], np.concatenate(tangents), groom.radii_mm[fiber], fiber, np.concatenate(tints), segments)


def _thin(points: np.ndarray, chord_error_mm: float, longest_mm: float = 0.6) -> np.ndarray:
    """Indices of points (n, 3) to keep, both ends included: the denser the more the curve bends there."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    bend = np.pad(curvature(points), 1, mode="edge") if len(points) > 2 else np.zeros(len(points))
    bend = np.maximum(np.maximum(bend, np.r_[bend[1:], 0]), np.r_[0, bend[:-1]])
    pieces = np.r_[0, np.cumsum(steps * np.maximum(np.sqrt(bend[:-1] / (8 * chord_error_mm)), 1 / longest_mm))]
    count = max(int(np.ceil(pieces[-1])), 1)
    return np.unique(np.searchsorted(pieces, np.linspace(0, pieces[-1], count + 1) - 1e-9).clip(0, len(points) - 1))


def _texture(y: np.ndarray, rng) -> np.ndarray:
    """Slow random changes along a fiber, rms about 1."""
    lengths, phases = rng.uniform(0.6, 4.0, 5), rng.uniform(0, 2 * np.pi, 5)
    return np.sin(2 * np.pi * y[:, None] / lengths + phases).sum(axis=1) * np.sqrt(2 / 5)


# ---- light -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Shade:
    """Light from each point of the hair towards the camera at one turntable angle."""

    color: np.ndarray  # (V, 3) float32, where a fiber faces the camera
    shine: np.ndarray  # (V,) float32: share of the highlight in it, 0 … 1


def light_directions() -> np.ndarray:
    """Unit directions (9, 3) in the camera frame to the parts of a soft light of 60° by 60° behind the camera, sec. 3."""
    at = np.tan(np.radians([-20.0, 0.0, 20.0]))
    directions = np.array([[x, y, 1.0] for y in at for x in at])
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


@dataclass(frozen=True)
class Density:
    """How much hair is where: a grid of its cross-section in mm² a mm³, object frame."""

    values: np.ndarray  # (nx, ny, nz) float32
    low_mm: np.ndarray  # (3,) corner of the grid
    cell_mm: float


def density(hair: Hair, cell_mm: float = 0.3) -> Density:
    """Cross-section of fibers a volume, from the midpoints of their segments."""
    a, b = hair.points_mm[hair.segments], hair.points_mm[hair.segments + 1]
    low = hair.points_mm.min(axis=0) - 2 * cell_mm
    shape = np.ceil((hair.points_mm.max(axis=0) + 2 * cell_mm - low) / cell_mm).astype(int) + 1
    area = 2 * hair.radius_mm[hair.segments] * np.linalg.norm(b - a, axis=1)
    cells = ((a + b) / 2 - low) / cell_mm
    grid = np.zeros(shape)
    base = np.floor(cells - 0.5).astype(int)
    part = cells - 0.5 - base
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, part, 1 - part), axis=1)
        np.add.at(grid, tuple((base + corner).T), area * weight)
    return Density((grid / cell_mm**3).astype(np.float32), low, cell_mm)


def shade(hair: Hair, fog: Density, look: Look, angle_deg: float, working_distance_mm: float) -> Shade:
    """Light from the hair towards a camera at ``angle_deg``: a diffuse part by the sine of the angle between light and
    fiber, two highlights along the fiber, and less of all where hair stands before the light."""
    directions = light_directions()
    through = _through(hair.points_mm, fog.values, fog.low_mm, fog.cell_mm, geometry.object_points(directions, angle_deg), look.depth)
    where = geometry.camera_points(hair.points_mm, angle_deg)
    tangents = geometry.camera_points(hair.tangents, angle_deg)
    view = np.array([0.0, 0.0, working_distance_mm]) - where
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    sin_view = np.einsum("vi,vi->v", tangents, view)
    diffuse, first, second = np.zeros((3, len(where)))
    for direction, open_share in zip(directions, through.T, strict=True):
        sin_light = tangents @ direction  # sines of the inclinations to the plane across the fiber
        half = (np.arcsin(np.clip(sin_light, -1, 1)) + np.arcsin(np.clip(sin_view, -1, 1))) / 2
        diffuse += open_share * np.sqrt(np.clip(1 - sin_light**2, 0, 1))
        first += open_share * np.exp(-0.5 * ((half + np.radians(3)) / np.radians(7)) ** 2)  # off the cuticle, whose scales tilt
        second += open_share * np.exp(-0.5 * ((half - np.radians(4.5)) / np.radians(11)) ** 2)  # through the fiber and back
    count = len(directions)
    hair_color = np.array(look.hair)
    body = (0.62 * diffuse / count)[:, None] * hair_color + (0.5 * second / count)[:, None] * hair_color**1.5
    white = look.shine * hair_color[0] * first / count
    color = hair.tint[:, None] * body + white[:, None]
    return Shade(color.astype(np.float32), (white / color[:, 0]).astype(np.float32))


@njit(cache=True, nogil=True)
def _through(points, grid, low, cell, directions, depth):
    """Share of light (V, L) that reaches points from directions (L, 3) through the grid of hair; depth scales its toll."""
    result = np.empty((len(points), len(directions)))
    nx, ny, nz = grid.shape
    for v in range(len(points)):
        for k in range(len(directions)):
            total = 0.0
            travelled = 1.2 * cell  # the fiber itself and its nearest neighbours are seen, not guessed
            while True:
                x = (points[v, 0] + travelled * directions[k, 0] - low[0]) / cell
                y = (points[v, 1] + travelled * directions[k, 1] - low[1]) / cell
                z = (points[v, 2] + travelled * directions[k, 2] - low[2]) / cell
                if not (0 <= x < nx and 0 <= y < ny and 0 <= z < nz):
                    break
                total += grid[int(x), int(y), int(z)]
                travelled += cell
            toll = total * cell
            result[v, k] = 0.9 * math.exp(-depth * toll) + 0.1 * math.exp(-0.25 * depth * toll)  # the rest was scattered on
    return result


def profiles() -> np.ndarray:
    """Brightness (2, 256) float32 across a fiber, from its middle to its edge in steps of q²: of its body and its highlight."""
    cosine = np.sqrt(1 - (np.arange(_PROFILE) + 0.5) / _PROFILE)
    return np.stack([0.25 + 0.75 * cosine, cosine**4]).astype(np.float32)


def board(optics: Optics, shape: tuple[int, int], look: Look) -> np.ndarray:
    """The blue board behind the hair (4, rows, columns), one plane a site of the mosaic: far out of focus, lit from above."""
    planes = np.empty((4, *shape), np.float32)
    for plane, (down, right, color) in zip(planes, _SITES, strict=True):
        rows, columns = np.mgrid[: shape[0], : shape[1]]
        u, v = geometry.to_image(columns + right / 2, rows + down / 2, optics.pitch_mm, optics.axis_col_px, optics.axis_row_px)
        plane[:] = look.board[color] * (1 + 0.004 * v - 0.0015 * u - 0.0001 * (u * u + v * v))
    return planes


# ---- the photograph --------------------------------------------------------------------------------------------------

_project = njit(geometry.project, inline="always")
_to_pixel = njit(geometry.to_pixel, inline="always")


@dataclass(frozen=True)
class Drawing:
    """Segments in the camera frame at one turntable angle, from top to bottom, so that drawing stays in the cache."""

    ends: np.ndarray  # (S, 7) float32: u', v', w of both ends, radius; mm
    strand: np.ndarray  # (S,) int32
    colors: np.ndarray  # (S, 7) float32: R, G, B of its first end, share of the highlight, what R, G, B change to the other end
    span_mm: np.ndarray  # (2,) float32: all that is seen is in between, in w


def drawing(hair: Hair, angle_deg: float, shaded: Shade | None = None, optics: Optics | None = None) -> Drawing:
    """The hair turned by an angle, ready to be drawn; without ``shaded`` it is black, without ``optics`` the axis is upright.
    Raises StrandscopeError for too much hair."""
    if len(hair.segments) > _MOST:
        raise StrandscopeError(f"the hair has {len(hair.segments)} straight pieces; expected {_MOST} at most: fewer or shorter fibers")
    where = geometry.camera_points(hair.points_mm, angle_deg, optics)
    order = hair.segments[np.argsort(-where[hair.segments, 1], kind="stable")]
    ends = np.column_stack([where[order], where[order + 1], hair.radius_mm[order]]).astype(np.float32)
    colors = np.zeros((len(order), 7), np.float32)
    if shaded is not None:
        colors[:] = np.column_stack([shaded.color[order], shaded.shine[order], shaded.color[order + 1] - shaded.color[order]])
    thick = 4 * hair.radius_mm.max()
    span = np.array([where[:, 2].min() - thick, where[:, 2].max() + thick], np.float32)
    return Drawing(ends, hair.fiber[order], colors, span)


def as_photographed(drawn: Drawing, optics: Optics, focus_mm: float, shape: tuple[int, int]) -> Drawing:
    """What is drawn as a photograph of ``shape`` (rows, columns) at d = focus_mm has it, where the lens distorts and the stage leads the
    camera off its line of sight. A point moves along the plane of its depth, so that the middle of its blur is where it belongs."""
    if not optics.displaces:
        return drawn
    ends = drawn.ends.astype(np.float64)
    right, up = geometry.travelled(optics, focus_mm)
    left_mm, top_mm = (optics.axis_col_px - (shape[1] - 1) / 2) * optics.pitch_mm, (optics.axis_row_px - (shape[0] - 1) / 2) * optics.pitch_mm
    for u, v, w in (ends.T[:3], ends.T[3:6]):
        scale = optics.working_distance_mm / (optics.working_distance_mm + focus_mm - w)
        x, y = geometry.distort(left_mm + (u - right) * scale, top_mm - (v - up) * scale, optics.k1_per_mm2, optics.k2_per_mm4)
        u[:], v[:] = (x - left_mm) / scale, (top_mm - y) / scale
    return replace(drawn, ends=ends.astype(np.float32))


def photograph(hair: Drawing, background: np.ndarray, optics: Optics, focus_mm: float, through: Lens) -> np.ndarray:
    """The light (4, rows, columns) float32 on the sites R, G, G, B of the mosaic's cells, without noise.

    background (4, rows, columns) is what stands behind the hair; the lens has a turn for each of rows + 1. Plane R has its
    pixel centres at integers, the others lie half a pixel to the right, below, or both.
    """
    planes = background.astype(np.float32)
    view = (np.float32(focus_mm), np.float32(optics.working_distance_mm), np.float32(optics.pitch_mm))
    axis = (np.float32(optics.axis_col_px), np.float32(optics.axis_row_px))
    _photograph(hair.ends, hair.colors, planes, background, *_lens_arrays(through), view, axis, hair.span_mm, profiles())
    return planes


def _lens_arrays(through: Lens) -> tuple[np.ndarray, np.ndarray]:
    """A lens for the kernels, float32: (n, 5) of phase, half chord, v, shift in columns and in rows; turn (rows,)."""
    chord = np.sqrt(np.maximum(through.radius_mm**2 - through.v_mm**2, 0))
    return np.column_stack([through.phase, chord, through.v_mm, through.shift_px]).astype(np.float32), through.turn.astype(np.float32)


@njit(cache=True, nogil=True, error_model="numpy")
def _draw(ends, point, turn, view, axis, span, nearest):
    """Draw all segments as seen from points of the lens, one a row, into nearest (rows, _EDGE + columns + _EDGE) int64.

    Entry (r, _EDGE + c) looks along the ray through column c, row r of the plane of focus, both shifted by point[3:]. It
    becomes 0 where no fiber is, else a number that grows with the nearness of the surface there, so that the larger of two
    is the one to be seen: from the high bits, 25 of w between the ends of ``span`` (mm), 22 of the segment, 8 of the place
    along it, 8 of q² across it. Bound by arithmetic: the place of a segment in its rows and a row's pixels go through
    vectors, some 25 ns a row of a segment.
    """
    nearest[:] = 0
    rows, columns = nearest.shape[0], nearest.shape[1] - 2 * _EDGE
    focus, distance, pitch = view
    half_of, one, two = np.float32(0.5), np.float32(1), np.float32(2)
    chord, lens_v, per_pitch = point[1], point[2], one / pitch
    axis_col, axis_row = axis[0] - point[3], axis[1] - point[4]
    fine = np.float32(_FINEST) / (span[1] - span[0])
    lens_u = np.zeros(rows + 8, np.float32)
    for r in range(rows):
        part = point[0] + turn[r]
        lens_u[r] = chord * (two * (part - one if part >= one else part) - one)
    first, places = np.empty((2, rows + 8), np.int32)
    begin, step, high = np.empty((3, rows + 8), np.float32)
    for k in range(len(ends)):
        w0, w1, radius = ends[k, 2], ends[k, 5], ends[k, 6]
        # Seen from (L_u, L_v) a point appears at L + project(point - L), which is project(point) + L (1 - scale).
        u0, v0 = _project(ends[k, 0], ends[k, 1] - lens_v, w0, focus, distance)
        u1, v1 = _project(ends[k, 3], ends[k, 4] - lens_v, w1, focus, distance)
        c0, r0 = _to_pixel(u0, lens_v + v0, pitch, axis_col, axis_row)
        c1, r1 = _to_pixel(u1, lens_v + v1, pitch, axis_col, axis_row)
        sway0 = (focus - w0) / (distance + focus - w0) * per_pitch  # px a mm of L_u
        sway1 = (focus - w1) / (distance + focus - w1) * per_pitch
        half = radius * per_pitch * distance / (distance + focus - half_of * (w0 + w1))  # of its width, px
        reach = chord * max(abs(sway0), abs(sway1)) + np.float32(3) * half
        outside = max(r0, r1) < -reach or min(r0, r1) > rows + reach
        if outside or max(c0, c1) + reach < 0 or min(c0, c1) - reach > columns:
            continue
        dr, dc, dw, swing = r1 - r0, c1 - c0, w1 - w0, sway1 - sway0
        deep, low, tag = dw * per_pitch, (w0 - span[0]) * fine, k << 16
        if abs(dr) < max(abs(dc) + chord * abs(swing), half_of * abs(deep)):
            _draw_level(tag, c0, r0, low, dc, dr, dw * fine, deep, sway0, swing, half, radius * fine, chord, lens_u, nearest)
            continue
        # Upright: each row between the ends belongs to this segment alone, so that neighbours join without a gap.
        per_dr, per_half, dlow = one / dr, one / half, dw * fine
        bulge = radius * fine * math.sqrt(one + (deep * per_dr) ** 2)
        top = max(math.ceil(min(r0, r1)), 0)
        count = min(math.ceil(max(r0, r1)), rows) - top
        for j in range(8 * ((count + 7) // 8)):  # whole vectors
            r = top + j
            t, lean = (np.float32(r) - r0) * per_dr, dc + lens_u[r] * swing
            centre = c0 + lens_u[r] * sway0 + t * lean
            across = math.sqrt(one + (lean * per_dr) ** 2)
            left = np.ceil(centre - half * across)
            across = per_half / across
            first[j], begin[j], step[j] = np.int32(left), (left - centre) * across, across
            high[j], places[j] = low + t * dlow, np.int32(t * np.float32(255)) << 8
        wide = 8 * math.ceil((np.float32(2.9) * half + one) / np.float32(8))  # it leans by 45° at most
        for j in range(count):
            place = first[j] + _EDGE
            if place < 0 or place + wide > nearest.shape[1]:
                continue
            pixels = nearest[top + j, place : place + wide]
            start, by, height, name = begin[j], step[j], high[j], tag + places[j]
            for i in range(wide):
                q = start + np.float32(np.int32(i)) * by
                q = q * q
                near = np.int64(np.int32(height + bulge * math.sqrt(max(one - q, np.float32(0)))))
                number = (near << 38) + (name + np.int64(np.int32(q * np.float32(256))))
                pixels[i] = max(pixels[i], number if q < one else 0)


@njit(cache=True, nogil=True, error_model="numpy")
def _draw_level(tag, at0, r0, low, along, dr, dlow, deep, sway0, swing, half, radius, chord, lens_u, nearest):
    """Draw a segment that lies level in the image or points at the camera: pixels nearer than ``half`` to its line.

    It is drawn on beyond its ends by half its width, over its neighbours, so that no gap opens between them.
    """
    zero, one, more, per_half = np.float32(0), np.float32(1), half + np.float32(0.1), np.float32(1) / half
    tall = math.sqrt(half * half + more * more)  # a corner is this far from its end
    wide = 8 * math.ceil((abs(along) + chord * abs(swing) + tall + tall + one) / np.float32(8))
    for r in range(max(math.ceil(min(r0, r0 + dr) - tall), 0), min(math.floor(max(r0, r0 + dr) + tall) + 1, len(nearest))):
        c0, dc = at0 + lens_u[r] * sway0, along + lens_u[r] * swing
        length = math.sqrt(dc * dc + dr * dr) + np.float32(1e-4)
        per_length = one / length
        tc, tr, y = dc * per_length, dr * per_length, np.float32(r) - r0
        bulge = radius * min(math.sqrt(one + (deep * per_length) ** 2), np.float32(4))
        left = math.floor(min(c0, c0 + dc) - tall) + _EDGE
        begin, end = max(left, 0), min(left + wide, nearest.shape[1])
        if begin >= end:
            continue
        pixels, x0 = nearest[r, begin:end], np.float32(begin - _EDGE) - c0
        for i in range(len(pixels)):
            x = x0 + np.float32(np.int32(i))
            s, across = x * tc + y * tr, (x * tr - y * tc) * per_half
            t, q = min(max(s * per_length, zero), one), across * across
            near = np.int64(np.int32(low + t * dlow + bulge * math.sqrt(max(one - q, zero))))
            number = (near << 38) + (tag + np.int64((np.int32(t * np.float32(255)) << 8) + np.int32(q * np.float32(256))))
            pixels[i] = max(pixels[i], number if (q < one) & (s > -more) & (s < length + more) else 0)


@njit(cache=True, nogil=True, error_model="numpy")
def _photograph(ends, colors, planes, background, points, turn, view, axis, span, across):
    """Add to planes (4, rows, columns), per point of the lens, what the hair there differs from the background."""
    rows, columns = planes.shape[1:]
    nearest = np.empty((rows + 1, columns + 1 + 2 * _EDGE), np.int64)
    light = np.empty((rows + 1, columns + 1, 4), np.float32)
    share = np.float32(1 / len(points))
    # The ray of entry (r, c) meets the plane of focus at (r, c) + shift: within half a pixel of the red site of cell (r, c),
    # and of the sites half a pixel further of cell (r, c), or of the one before, if the shift is negative.
    for before_r in range(2):
        for before_c in range(2):
            light[:] = 0
            for i in range(len(points)):
                if before_c == int(points[i, 3] < 0) and before_r == int(points[i, 4] < 0):
                    _draw(ends, points[i], turn, view, axis, span, nearest)
                    _light(nearest, colors, across, light)
            for r in range(rows):
                for c in range(columns):
                    for site in range(4):
                        down, right, color = _SITES[site]
                        r1, c1 = r + down * before_r, c + right * before_c
                        planes[site, r, c] += share * (light[r1, c1, color] - light[r1, c1, 3] * background[site, r, c])


@njit(cache=True, nogil=True, error_model="numpy")
def _light(nearest, colors, across, light):
    """Add the light of what is nearest to light (rows, columns, 4): R, G, B, and 1 where there is hair."""
    for r in range(nearest.shape[0]):
        for c in range(nearest.shape[1] - 2 * _EDGE):
            number = nearest[r, _EDGE + c]
            if number == 0:
                continue
            k, t, q = (number >> 16) & _MOST, np.float32((number >> 8) & 255) / np.float32(255), number & 255
            bright = across[0, q] + colors[k, 3] * (across[1, q] - across[0, q])
            for color in range(3):
                light[r, c, color] += bright * (colors[k, color] + t * colors[k, 4 + color])
            light[r, c, 3] += np.float32(1)


def expose(planes: np.ndarray, full_well_e: float, read_noise_e: float, rng) -> np.ndarray:
    """The mosaic (2H, 2W) uint16, RGGB, that a sensor makes of light (4, H, W), 1 at white: shot noise, read noise, 14 bit."""
    electrons = np.maximum(planes, 0) * np.float32(full_well_e)
    noisy = electrons + np.sqrt(electrons + np.float32(read_noise_e**2)) * rng.standard_normal(planes.shape, np.float32)
    numbers = np.rint(BLACK + noisy * np.float32((WHITE - BLACK) / full_well_e)).clip(0, WHITE).astype(np.uint16)
    mosaic = np.empty((2 * planes.shape[1], 2 * planes.shape[2]), np.uint16)
    for plane, (down, right, _) in zip(numbers, _SITES, strict=True):
        mosaic[down::2, right::2] = plane
    return mosaic


# ---- truth -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Samples:
    """Points each 0.1 mm along the fibers, inside the volume that every sweep sees."""

    points_mm: np.ndarray  # (K, 3) float64, object frame
    tangents: np.ndarray  # (K, 3) unit
    strand: np.ndarray  # (K,) int32


def samples(groom: Groom, radius_mm: float, half_height_mm: float, step_mm: float = 0.1) -> Samples:
    """Points inside the cylinder about the y axis that is inside the image and the sweep's range at every angle."""
    points, tangents, strands = [], [], []
    for i in range(len(groom)):
        curve = groom[i]
        s = np.r_[0, np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))]
        at = np.arange(step_mm / 2, s[-1], step_mm)
        place = np.stack([np.interp(at, s, x) for x in curve.T], axis=-1)
        along = np.stack([np.interp(at, s, x) for x in np.gradient(curve, s, axis=0).T], axis=-1)
        inside = (np.hypot(place[:, 0], place[:, 2]) <= radius_mm) & (np.abs(place[:, 1]) <= half_height_mm)
        points.append(place[inside])
        tangents.append(along[inside] / np.linalg.norm(along[inside], axis=1, keepdims=True))
        strands.append(np.full(inside.sum(), i, np.int32))
    return Samples(np.concatenate(points), np.concatenate(tangents), np.concatenate(strands))


def visibility(hair: Hair, at: Samples, optics: Optics, angle_deg: float, rays: int = 32, slab_mm: float = 2.0, finer: int = 2) -> np.ndarray:
    """Fraction (K,) of the aperture's rays that reach each sample, in focus, unoccluded by other fibers.

    For each slab of depths the hair is drawn from points of the lens at ``finer`` times the resolution of the photographs, which
    tells what stands before each sample. A fiber hides itself only where it comes back in front, as a curl does.
    """
    where = geometry.camera_points(at.points_mm, angle_deg, optics)
    seen = np.zeros(len(where))
    if not len(where):
        return seen
    drawn = drawing(hair, angle_deg, optics=optics)
    pitch = optics.pitch_mm / finer
    slab = np.floor(where[:, 2] / slab_mm)
    for level in np.unique(slab):
        chosen = np.flatnonzero(slab == level)
        points = where[chosen]
        # by how much the lens and the perspective move what lies at the rim of the slab
        shift = 0.5 * slab_mm * (aperture_radius_mm(optics) + np.abs(points[:, :2]).max()) / (optics.working_distance_mm - slab_mm)
        low, high = points[:, :2].min(axis=0) - 0.4 - shift, points[:, :2].max(axis=0) + 0.4 + shift
        rows, columns = np.ceil((high - low)[::-1] / pitch).astype(int) + 1
        view = (np.float32((level + 0.5) * slab_mm), np.float32(optics.working_distance_mm), np.float32(pitch))
        axis = (np.float32(-low[0] / pitch), np.float32(high[1] / pitch))
        spots, turn = _lens_arrays(aperture_rays(optics, rays, rows))
        hair_at = drawn.ends, drawn.strand, drawn.span_mm
        seen[chosen] = _visible(*hair_at, spots, turn, points.astype(np.float32), at.strand[chosen], view, axis, (rows, columns))
    return seen


def aperture_rays(optics: Optics, rays: int, rows: int = 1) -> Lens:
    """The points of the lens from which visibility is told: the same ones for every row."""
    through = lens(rays, aperture_radius_mm(optics), rows, np.random.default_rng(0))
    return replace(through, turn=np.zeros(rows))


@njit(cache=True, nogil=True, error_model="numpy")
def _visible(ends, strand, span, spots, turn, points, own, view, axis, shape):
    """Fraction (K,) of points of the lens from which points (K, 3) of the camera frame on strands own (K,) are seen."""
    nearest = np.empty((shape[0], shape[1] + 2 * _EDGE), np.int64)
    count = np.zeros(len(points))
    coarse = (span[1] - span[0]) / np.float32(_FINEST)
    for i in range(len(spots)):
        _draw(ends, spots[i], turn, view, axis, span, nearest)
        lens_u, lens_v = spots[i, 1] * (np.float32(2) * spots[i, 0] - np.float32(1)), spots[i, 2]
        for k in range(len(points)):
            w = points[k, 2]
            u, v = _project(points[k, 0] - lens_u, points[k, 1] - lens_v, w, view[0], view[1])
            c, r = _to_pixel(lens_u + u, lens_v + v, view[2], axis[0] - spots[i, 3], axis[1] - spots[i, 4])
            found = nearest[round(r), _EDGE + round(c)]
            nearer = span[0] + np.float32(found >> 38) * coarse - w
            itself = found == 0 or (strand[(found >> 16) & _MOST] == own[k] and nearer < 0.5)
            count[k] += 1.0 if itself or nearer <= 0 else 0.0
    return count / len(spots)


# ---- a whole capture -------------------------------------------------------------------------------------------------


def plan(out: Path, params: SimulateParams) -> Capture:
    """The capture that ``params`` will give, before a photograph is taken. Raises StrandscopeError for a wrong parameter."""
    if not isinstance(params.scale, Scale) and params.scale not in SCALES:
        raise StrandscopeError(f"scale is {params.scale!r}; expected one of {', '.join(SCALES)}")
    if params.style not in STYLES:
        raise StrandscopeError(f"style is {params.style!r}; expected one of {', '.join(STYLES)}")
    if params.fibers is not None and params.fibers < 1:
        raise StrandscopeError(f"fibers is {params.fibers}; expected 1 or more")
    scale = params.size
    optics = Optics(params.working_distance_mm, params.pitch_mm, (scale.columns - 1) / 2, (scale.rows - 1) / 2, params.aperture_cone_deg)
    count = round(2 * scale.half_range_mm / params.step_mm) + 1
    positions = tuple(round((i - (count - 1) / 2) * params.step_mm, 6) for i in range(count))
    angles = np.arange(scale.angles) * 360 / scale.angles
    sweeps = tuple(Sweep(float(angle), positions, tuple(f"sweep_{i:03d}/img_{j:04d}.dng" for j in range(count))) for i, angle in enumerate(angles))
    turns = tuple(float(i * 360 / scale.turntable) for i in range(scale.turntable))
    stills = Turntable(params.turntable_f_number, tuple(f"turntable/img_{i:03d}.dng" for i in range(scale.turntable)), turns, 0.0)
    name = f"simulated {params.style} hair, {params.fibers or scale.fibers} fibers, seed {params.seed}"
    return Capture(Path(out), name, optics, sweeps, stills if turns else None, "truth.npz")


def simulate(out: Path, params: SimulateParams, progress: Progress = silent, workers: int = 0) -> Capture:
    """Photograph known hair: a capture in the folder ``out``, with its truth. Returns it as it was read back.

    A run that was interrupted goes on where it stopped; ``capture.json`` is written last. ``workers`` threads (0: one a
    core) do not change a byte. Raises StrandscopeError where ``out`` holds something else, or a parameter is wrong.
    """
    out = Path(out)
    capture = plan(out, params)
    if begin(out, params):
        return load_capture(out)
    progress("groom", 0, 1)
    lock = groom(lock_params(params), np.random.default_rng([params.seed, 0]))
    progress("groom", 1, 1)
    hair = prepare(lock, np.random.default_rng([params.seed, 1]))
    with ThreadPoolExecutor((workers or os.cpu_count()) + 1) as pool:  # one more, since writing waits for the disk
        rig = params.misalignment.errors(capture).corrected(capture)
        _photographs(rig, hair, params, progress, pool)
        if not capture.truth_path.is_file():
            take_truth(rig, lock, hair, params, progress, pool)
    save_capture(replace(capture, unknown={"simulation": asdict(params)}))
    return load_capture(out)


def lock_params(params: SimulateParams) -> GroomParams:
    """The lock that fits the scale: it goes on above and below the image, as far as blurred hair is seen."""
    scale = params.size
    half_height = scale.rows / 2 * params.pitch_mm
    beyond = 1.5 + 0.25 * scale.lock_radius_mm + 0.1 * half_height
    return GroomParams(params.style, params.fibers or scale.fibers, scale.lock_radius_mm, half_height + beyond)


def begin(out: Path, params: SimulateParams, more: dict | None = None) -> bool:
    """Make the folder ready; true if the capture is already there. ``more``: what else was asked for. Raises StrandscopeError where the
    folder holds something else."""
    journal = out / JOURNAL
    asked = json.loads(json.dumps({"revision": REVISION, **asdict(params), **(more or {})}))
    try:
        if out.exists() and not out.is_dir():
            raise StrandscopeError(f"{out}: is a file; expected a new or empty folder for the capture")
        if not out.is_dir() or not any(out.iterdir()):
            with atomic(journal) as part:
                part.write_text(json.dumps(asked, indent=1), encoding="utf-8")
            return False
        if not journal.is_file():
            raise StrandscopeError(f"{out}: holds files that no simulation made; expected a new or empty folder for the capture")
        found = json.loads(journal.read_text(encoding="utf-8"))
        if isinstance(found, dict) and isinstance(found.get("misalignment"), dict):  # one made before there were as many errors
            found["misalignment"] = asdict(Misalignment()) | found["misalignment"]
    except OSError as error:
        raise explain(error, out) from error
    except ValueError as error:
        raise StrandscopeError(f"{journal}: not valid JSON ({error}); expected the parameters of a simulation") from error
    for name in [*asked, *(found if isinstance(found, dict) else ())]:
        value = asked.get(name, "missing")
        if not isinstance(found, dict) or found.get(name, "missing") != value:
            was = found.get(name, "missing") if isinstance(found, dict) else found
            raise StrandscopeError(f"{out}: holds a simulation with {name} {was}, not {value}; expected the same parameters, or another folder")
    for left in out.rglob(".*.part*"):  # of a run that was killed
        left.unlink(missing_ok=True)
    return (out / FILE_NAME).is_file()


@dataclass(frozen=True)
class Studio:
    """Known hair before its board and light, to be photographed at any angle and focus."""

    params: SimulateParams
    optics: Optics
    hair: Hair
    fog: Density
    background: np.ndarray  # (4, rows, columns) of the board
    gain: float  # of the exposure
    reach_mm: float  # few fibers fly off farther

    def at(self, angle_deg: float) -> Drawing:
        """The hair turned by an angle, shaded; it serves for all photographs there."""
        shaded = shade(self.hair, self.fog, LOOKS[self.params.style], angle_deg, self.optics.working_distance_mm)
        return drawing(self.hair, angle_deg, replace(shaded, color=shaded.color * np.float32(self.gain)), self.optics)

    def mosaic(self, drawn: Drawing, focus_mm: float, f_number: float, rng, brighter: float = 1.0) -> np.ndarray:
        """The mosaic (2 rows, 2 columns) uint16 that the camera takes at a focus and an aperture; ``brighter`` is its gain."""
        through = replace(self.optics, aperture_cone_deg=stopped_cone_deg(self.params, f_number))
        disc = lens(lens_count(through, self.reach_mm + abs(focus_mm)), aperture_radius_mm(through), len(self.background[0]) + 1, rng)
        seen = as_photographed(drawn, through, focus_mm, self.background.shape[1:])
        planes = photograph(seen, self.background, through, focus_mm, disc)
        return expose(planes * np.float32(brighter), self.params.full_well_e, self.params.read_noise_e, rng)


def studio(params: SimulateParams, optics: Optics, hair: Hair) -> Studio:
    """Board, light and exposure for hair."""
    look, fog = LOOKS[params.style], density(hair)
    reach = float(np.percentile(np.hypot(hair.points_mm[:, 0], hair.points_mm[:, 2]), 99))
    background = board(optics, (params.size.rows, params.size.columns), look)
    return Studio(params, optics, hair, fog, background, _gain(hair, fog, look, params), reach)


def _photographs(capture: Capture, hair: Hair, params: SimulateParams, progress: Progress, pool: ThreadPoolExecutor) -> None:
    """Take all photographs that are not there yet."""
    camera, opened = studio(params, capture.optics, hair), params.open_f_number
    sequences = [(s.angle_deg, d, f, opened, g) for s in capture.sweeps for d, f, g in zip(s.positions_mm, s.files, s.gains, strict=True)]
    if stills := capture.turntable:
        sequences += [(a, stills.focus_mm, f, params.turntable_f_number, 1.0) for a, f in zip(stills.angles_deg, stills.files, strict=True)]
    by_angle: dict[float, list] = {}
    for number, (angle, *shot) in enumerate(sequences):
        by_angle.setdefault(angle, []).append((number, *shot))
    done = 0
    for angle, shots in by_angle.items():
        missing = [shot for shot in shots if not (capture.folder / shot[2]).is_file()]
        done += len(shots) - len(missing)
        if not missing:
            continue
        drawn = camera.at(angle)

        def take(shot, drawn=drawn):
            number, focus, file, f_number, brighter = shot
            rng = np.random.default_rng([params.seed, 2, number])
            write_dng(capture.folder / file, camera.mosaic(drawn, focus, f_number, rng, brighter), BLACK, WHITE)

        for _ in each_of(pool, take, missing):
            done += 1
            progress("photographs", done, len(sequences))


def each_of(pool: ThreadPoolExecutor, work, items):
    """Results of ``work(item)`` as they come; what was not begun is dropped when one fails or the caller gives up."""
    futures = [pool.submit(work, item) for item in items]
    try:
        for future in as_completed(futures):
            yield future.result()
    finally:
        for future in futures:
            future.cancel()


def stopped_cone_deg(params: SimulateParams, f_number: float) -> float:
    """Full angle of the cone at an f-number; the radius of the aperture goes with 1 / f-number."""
    if f_number == params.open_f_number:
        return params.aperture_cone_deg
    tangent = math.tan(math.radians(params.aperture_cone_deg) / 2) * params.open_f_number / f_number
    return math.degrees(2 * math.atan(tangent))


def _gain(hair: Hair, fog: Density, look: Look, params: SimulateParams) -> float:
    """The exposure: the brightest hundredth of the hair, seen from four sides, comes to ``params.exposure`` in red."""
    shades = [shade(hair, fog, look, angle, params.working_distance_mm).color[:, 0] for angle in (0.0, 90.0, 180.0, 270.0)]
    return params.exposure / float(np.percentile(np.concatenate(shades), 99))


def take_truth(capture: Capture, lock: Groom, hair: Hair, params: SimulateParams, progress: Progress, pool: ThreadPoolExecutor) -> None:
    """truth.npz: the fibers, samples of them inside the captured volume, and how much of the aperture sees each."""
    at = samples(lock, *seen_volume(params))
    seen = np.zeros((len(at.points_mm), len(capture.sweeps)), np.float16)

    def look(k):
        seen[:, k] = visibility(hair, at, capture.optics, capture.sweeps[k].angle_deg)

    for done, _ in enumerate(each_of(pool, look, range(len(capture.sweeps)))):
        progress("truth", done + 1, len(capture.sweeps))
    write_truth(capture, lock, at, seen)


def seen_volume(params: SimulateParams) -> tuple[float, float]:
    """Radius and half height (mm) of the cylinder that every sweep sees, less a margin."""
    scale, pitch, margin = params.size, params.pitch_mm, 0.1
    return min((scale.columns - 1) / 2 * pitch, scale.half_range_mm) - margin, (scale.rows - 1) / 2 * pitch - margin


def write_truth(capture: Capture, lock: Groom, at: Samples, seen: np.ndarray) -> None:
    """truth.npz of fibers, of samples of them, and of how much of the aperture of each sweep sees these (K, sweeps)."""
    arrays = {
        "points": lock.points_mm.astype(np.float32),
        "offsets": lock.offsets.astype(np.int64),
        "radii": lock.radii_mm.astype(np.float32),
        "sample_points": at.points_mm.astype(np.float32),
        "sample_tangents": at.tangents.astype(np.float32),
        "sample_strand": at.strand,
        "visibility": seen,
    }
    with atomic(capture.truth_path) as part:
        np.savez_compressed(part, **arrays)
