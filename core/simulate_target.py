"""Photographs of a printed target on a rig whose errors are known: to try the calibration of a rig on, and to test it.

The board is seen through a thin lens, as hair in ``simulate.py``: the mean over points on the lens, so that blur and perspective follow.
From each point of the lens a pixel looks at one point of a picture of the board that is finer than the photograph. The lens distorts, the
stage leads the camera aside, the axis leans, as the rig's errors say.
"""

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
from numba import njit

from . import geometry
from .capture import Capture, Sweep, Turntable, load_capture, save_capture
from .geometry import Optics
from .progress import Progress, silent
from .raw import write_dng
from .rig.target import Target
from .rig.target_fit import rotation
from .simulate import BLACK, WHITE, Misalignment, SimulateParams, aperture_radius_mm, begin, each_of, expose, stopped_cone_deg

MARGIN_MM = 4.0  # of white paper around the board
INK, PAPER, ROOM = 0.03, 0.62, 0.015  # light of black, white, and of what stands behind
_FINER = 3  # texels of the print a pixel


@dataclass(frozen=True)
class Mounting:
    """How the board hangs: nobody mounts it quite right."""

    facing_deg: float = 1.5  # turned about the axis
    lean_deg: float = 0.7  # its upper edge back
    roll_deg: float = -1.0  # in its own plane, counterclockwise
    right_mm: float = 0.8  # of the axis, its middle
    up_mm: float = -0.5
    before_mm: float = 1.2


@dataclass(frozen=True)
class TargetParams:
    """What to photograph: angles of the turntable and positions of the stage, as the rig's owner states them."""

    angles_deg: tuple[float, ...] = (-45.0, -30.0, -15.0, 0.0, 15.0, 30.0, 45.0)
    step_mm: float = 1.0
    beyond_mm: float = 5.0  # how far each sweep goes on, on both sides, when all of the board has been sharp
    stopped_deg: tuple[float, ...] = ()  # angles of photographs at a small aperture
    rows: int = 1462
    columns: int = 2193
    pitch_mm: float = 1 / 35
    working_distance_mm: float = 330.0
    aperture_cone_deg: float = 10.0
    full_well_e: float = 15000.0
    read_noise_e: float = 6.0
    rays: int = 64  # points of the lens and of the pixel that light is gathered from
    misalignment: Misalignment = field(default_factory=Misalignment)
    mounting: Mounting = field(default_factory=Mounting)
    seed: int = 0

    def reduced(self, by: int) -> "TargetParams":
        """The same with pixels ``by`` times as wide: photographs of the same board, sooner."""
        return replace(self, rows=self.rows // by, columns=self.columns // by, pitch_mm=by * self.pitch_mm)


def plan(out: Path, params: TargetParams) -> Capture:
    """The capture that ``params`` will give, as its owner states it."""
    p = params
    optics = Optics(p.working_distance_mm, p.pitch_mm, (p.columns - 1) / 2, (p.rows - 1) / 2, p.aperture_cone_deg)
    sweeps = tuple(_sweep(p, k, float(angle)) for k, angle in enumerate(p.angles_deg))
    stopped = tuple(f"turntable/img_{i:03d}.dng" for i in range(len(p.stopped_deg)))
    return Capture(Path(out), "printed target", optics, sweeps, Turntable(16.0, stopped, p.stopped_deg, 0.0) if stopped else None)


def _sweep(params: TargetParams, number: int, angle_deg: float) -> Sweep:
    """Positions evenly about the axis, as far as what the image shows of the board reaches in depth, and some way on."""
    deep = 0.5 * params.columns * params.pitch_mm * abs(math.sin(math.radians(angle_deg))) + params.beyond_mm
    half = math.ceil(deep / params.step_mm)
    positions = tuple(round(i * params.step_mm, 6) for i in range(-half, half + 1))
    return Sweep(angle_deg, positions, tuple(f"sweep_{number:03d}/img_{j:04d}.dng" for j in range(len(positions))))


def simulate_target(out: Path, params: TargetParams, target: Target | None = None, progress: Progress = silent, workers: int = 0) -> Capture:
    """Photograph a printed target: a capture in the folder ``out``; returns it as it was read back.

    A run that was interrupted goes on where it stopped; ``workers`` threads (0: one a core) do not change a byte. Raises StrandscopeError
    where ``out`` holds something else, and without OpenCV.
    """
    out, target = Path(out), target or Target()
    capture = plan(out, params)
    if begin(out, params, {"target": asdict(target)}):
        return load_capture(out)
    rig = params.misalignment.errors(capture).corrected(capture)
    texel_mm = params.pitch_mm / _FINER
    texture, shots = picture(target, texel_mm), []
    for sweep in rig.sweeps:
        shots += [(sweep.angle_deg, d, file, rig.optics, gain) for d, file, gain in zip(sweep.positions_mm, sweep.files, sweep.gains, strict=True)]
    if table := rig.turntable:
        stopped = replace(rig.optics, aperture_cone_deg=stopped_cone_deg(SimulateParams(aperture_cone_deg=params.aperture_cone_deg)))
        shots += [(angle, table.focus_mm, file, stopped, 1.0) for angle, file in zip(table.angles_deg, table.files, strict=True)]

    def take(number):
        angle, focus, file, optics, gain = shots[number]
        rng = np.random.default_rng([params.seed, 4, number])
        plane = photograph(texture, texel_mm, params.mounting, optics, angle, focus, (params.rows, params.columns), params.rays)
        planes = np.broadcast_to(plane * np.float32(gain), (4, *plane.shape))  # a grey board, and colours that are not told apart
        write_dng(out / file, expose(planes, params.full_well_e, params.read_noise_e, rng), BLACK, WHITE)

    missing = [i for i, shot in enumerate(shots) if not (out / shot[2]).is_file()]
    with ThreadPoolExecutor(workers or os.cpu_count()) as pool:
        for done, _ in enumerate(each_of(pool, take, missing), len(shots) - len(missing) + 1):
            progress("photographs", done, len(shots))
    save_capture(replace(capture, unknown={"simulation": asdict(params)}))
    return load_capture(out)


def picture(target: Target, texel_mm: float) -> np.ndarray:
    """The print with its white margin (rows, columns) uint8: 0 where it is black, 255 where it is white. Rows run down."""
    wide, high = (math.ceil((size + 2 * MARGIN_MM) / texel_mm) for size in target.size_mm)
    ink = np.zeros((high, wide), np.float32)
    for left, bottom, right, top in target.black_mm() / texel_mm:  # the board's middle is the picture's
        columns, across = _covered(wide / 2 + left, wide / 2 + right)
        rows, down = _covered(high / 2 - top, high / 2 - bottom)
        ink[rows, columns] += np.outer(down, across).astype(np.float32)
    return np.rint(255 * (1 - ink)).astype(np.uint8)


def _covered(low: float, high: float) -> tuple[slice, np.ndarray]:
    """The cells that an interval touches, and how much of each."""
    first, last = math.floor(low), math.ceil(high)
    edges = np.arange(first, last + 1)
    return slice(first, last), np.minimum(edges[1:], high) - np.maximum(edges[:-1], low)


def photograph(
    texture: np.ndarray,
    texel_mm: float,
    mounting: Mounting,
    optics: Optics,
    angle_deg: float,
    focus_mm: float,
    shape: tuple[int, int],
    rays: int = 64,
) -> np.ndarray:
    """The light (rows, columns) float32 of a board with the ``texture``, at an angle of the turntable and a position of the plane of focus."""
    m = mounting
    axes = rotation(*np.radians([m.facing_deg, -m.lean_deg, m.roll_deg]))
    place = geometry.camera_points(np.array([m.right_mm, m.up_mm, m.before_mm]), angle_deg, optics)
    x, y, normal = (geometry.camera_points(axis, angle_deg, optics) for axis in axes.T)
    view = (optics.working_distance_mm, optics.pitch_mm, optics.axis_col_px, optics.axis_row_px, focus_mm, optics.k1_per_mm2, optics.k2_per_mm4)
    led = geometry.travelled(optics, focus_mm)
    plane = np.empty(shape, np.float32)
    _photograph(plane, texture, texel_mm, place, x, y, normal, view, led, _points(rays) * aperture_radius_mm(optics), _jitter(rays))
    return plane


def _points(count: int) -> np.ndarray:
    """Points (n, 2) evenly on the unit disc: a golden spiral, and each with the one opposite, so that blur shifts nothing."""
    i = np.arange(count // 2)
    radius, turn = np.sqrt((i + 0.5) / (count // 2)), i * np.pi * (3 - np.sqrt(5))
    half = np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=-1)
    return np.concatenate([half, -half])


def _jitter(count: int) -> np.ndarray:
    """Places (n, 2) in a pixel, -0.5 … 0.5, evenly, each with the one opposite."""
    i, plastic = np.arange(count // 2), 1.32471795724474602596
    half = np.stack([(0.5 + i / plastic) % 1.0, (0.5 + i / plastic**2) % 1.0], axis=-1) - 0.5
    return np.concatenate([half, -half])


_straighten, _to_image = njit(geometry.straighten), njit(geometry.to_image)


@njit(cache=True, nogil=True, error_model="numpy")
def _photograph(plane, texture, texel, place, ex, ey, normal, view, led, points, jitter):
    """Fill plane (rows, columns). Bound by arithmetic and by looking up the texture: some 8 ns a ray."""
    distance, pitch, axis_col, axis_row, focus, k1, k2 = view
    rows, columns = plane.shape
    high, wide = texture.shape
    middle_col, middle_row, half_wide, half_high = (columns - 1) / 2, (rows - 1) / 2, 0.5 * wide, 0.5 * high
    from_w = distance + focus - place[2]
    for r in range(rows):
        for c in range(columns):
            x, y = _straighten((c - middle_col) * pitch, (r - middle_row) * pitch, k1, k2)
            u, v = _to_image(middle_col + x / pitch, middle_row + y / pitch, pitch, axis_col, axis_row)
            u, v = u + led[0] - place[0], v + led[1] - place[1]
            spin = 2 * np.pi * ((0.754877666 * c + 0.569840296 * r) % 1.0)  # of the lens's points, another in every pixel
            cosine, sine = np.cos(spin), np.sin(spin)
            total = 0.0
            for i in range(len(points)):
                from_u = led[0] - place[0] + cosine * points[i, 0] - sine * points[i, 1]
                from_v = led[1] - place[1] + sine * points[i, 0] + cosine * points[i, 1]
                along_u, along_v = u + jitter[i, 0] * pitch - from_u, v + jitter[i, 1] * pitch - from_v
                t = normal[2] * distance - normal[0] * along_u - normal[1] * along_v
                t = (normal[0] * from_u + normal[1] * from_v + normal[2] * from_w) / t
                at_u, at_v, at_w = from_u + t * along_u, from_v + t * along_v, from_w - t * distance
                column = half_wide + (ex[0] * at_u + ex[1] * at_v + ex[2] * at_w) / texel
                row = half_high - (ey[0] * at_u + ey[1] * at_v + ey[2] * at_w) / texel
                if 0 <= column < wide and 0 <= row < high:
                    total += INK + texture[int(row), int(column)] * ((PAPER - INK) / 255)
                else:
                    total += ROOM
            plane[r, c] = total / len(points)
