"""The observations of a sweep, packed, stored and found again (sec. 4.2: "oriented box query").

A feature is one ridge pixel of one photograph: u, v below a pixel, the frame (which gives d), the angle of the hair, its
strength. Eight bytes each, in an order that makes a box in (u, v, d) a few contiguous runs: cells of 32 columns and 16
rows, and in each of them the frames in order. In a sweep's own (u, v, d) the boxes of section 4.2 are nearly aligned with
the axes, because the camera looks along d; that is why each sweep has cells of its own and there is no tree.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from .capture import Sweep
from .errors import StrandscopeError
from .files import atomic
from .geometry import Optics, object_points, set_right, slope, tilt_back, tilt_of, to_image, to_pixel, turn
from .ridges import Ridges

STRIP_PX, BLOCK_PX = 32, 16  # columns and rows of a cell
COL_STEPS, ROW_STEPS = 65536 // STRIP_PX, 65536 // BLOCK_PX  # units of the stored column and row, a pixel
ANGLE_STEPS = 256  # units of the stored angle, over pi
STRENGTH_STEPS = 12.0  # units of the stored strength, a factor of e
STRENGTH_LEAST = 1e-3  # strength that is stored as 0
BREADTH_STEPS, BREADTHS = 128, 256  # units of the stored breadth, a factor of e, and how many are told apart
USED = 128  # added to the stored strength of a feature that a fiber has used up
_STRENGTHS = STRENGTH_LEAST * np.exp(np.arange(USED) / STRENGTH_STEPS)

_to_pixel, _to_image = njit(to_pixel), njit(to_image)


@dataclass(frozen=True)
class SweepFeatures:
    """The features of one sweep, sorted by cell. Arrays (n,), memory-mapped when read from a file."""

    angle_deg: float
    positions_mm: np.ndarray  # (frames,) float64, ascending: d of each frame
    shape: tuple[int, int]  # rows and columns of the channel plane
    cells: np.ndarray  # (strips * blocks * frames + 1,) int32: where each cell begins
    col: np.ndarray  # uint16: column within its strip, 1/2048 px
    row: np.ndarray  # uint16: row within its block, 1/4096 px
    frame: np.ndarray  # uint16
    angle: np.ndarray  # uint8: pi/256
    strength: np.ndarray  # uint8, logarithmic
    breadth: np.ndarray  # uint8: 1/BREADTH_STEPS from -1 on; not in the Index, since only radii need it

    def __len__(self) -> int:
        return len(self.col)


def grid_shape(shape: tuple[int, int]) -> tuple[int, int]:
    """(strips, blocks) of cells that cover a channel plane of ``shape`` rows and columns, crests moved off its rim included."""
    return shape[1] // STRIP_PX + 1, shape[0] // BLOCK_PX + 1


def pack(angle_deg: float, positions_mm: Sequence[float], shape: tuple[int, int], photographs: Sequence) -> SweepFeatures:
    """Sort the ridges of a sweep's photographs into cells. photographs: one with col, row, angle, strength, breadth (n,) a position."""
    order = np.argsort(positions_mm, kind="stable")
    found = [photographs[i] for i in order]
    frame = np.repeat(np.arange(len(found), dtype=np.uint16), [len(f.col) for f in found])
    col, row, angle, strength, breadth = (
        np.concatenate([getattr(f, name) for f in found] or [[]]).astype(np.float64) for name in ("col", "row", "angle", "strength", "breadth")
    )
    strips, blocks = grid_shape(shape)
    col, row = np.clip(col, 0, shape[1] - 1), np.clip(row, 0, shape[0] - 1)
    strip, block = (col // STRIP_PX).astype(np.int64), (row // BLOCK_PX).astype(np.int64)
    cell = (strip * blocks + block) * len(found) + frame
    order_in = np.argsort(cell, kind="stable")
    counts = np.bincount(cell, minlength=strips * blocks * len(found))
    level = np.rint(np.log(np.maximum(strength, STRENGTH_LEAST) / STRENGTH_LEAST) * STRENGTH_STEPS)
    return SweepFeatures(
        angle_deg=float(angle_deg),
        positions_mm=np.asarray(positions_mm, np.float64)[order],
        shape=tuple(int(n) for n in shape),
        cells=np.concatenate([[0], np.cumsum(counts)]).astype(np.int32),
        col=((col - strip * STRIP_PX) * COL_STEPS).astype(np.uint16)[order_in],
        row=((row - block * BLOCK_PX) * ROW_STEPS).astype(np.uint16)[order_in],
        frame=frame[order_in],
        angle=(np.rint(angle * (ANGLE_STEPS / np.pi)).astype(np.int64) % ANGLE_STEPS).astype(np.uint8)[order_in],
        strength=np.clip(level, 0, USED - 1).astype(np.uint8)[order_in],
        breadth=np.clip(np.rint((breadth + 1) * BREADTH_STEPS), 0, BREADTHS - 1).astype(np.uint8)[order_in],
    )


def pixels(features: SweepFeatures) -> tuple[np.ndarray, np.ndarray]:
    """(column, row) of every feature, two arrays (n,) float64."""
    cell = np.repeat(np.arange(len(features.cells) - 1) // len(features.positions_mm), np.diff(features.cells))
    _, blocks = grid_shape(features.shape)
    return (cell // blocks) * STRIP_PX + features.col / COL_STEPS, (cell % blocks) * BLOCK_PX + features.row / ROW_STEPS


def unpack(features: SweepFeatures, optics: Optics) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(u, v, d) mm and the angle of the hair (rad) of every feature, four arrays (n,) float32."""
    u, v = to_image(*pixels(features), optics.pitch_mm, optics.axis_col_px, optics.axis_row_px)
    d = features.positions_mm[features.frame]
    return tuple(np.asarray(a, np.float32) for a in (u, v, d, features.angle * (np.pi / ANGLE_STEPS)))


def upright(ridges: Ridges, focus_mm: float, optics: Optics, shape: tuple[int, int]) -> Ridges:
    """The ridges of a photograph at d = focus_mm as they would be if the axis stood upright, the stage moved along the line of sight
    and the lens did not distort; those that leave it are dropped.

    Features have their photograph's d, which a tilt towards the camera would change with their height. They are moved along
    the line of sight instead, back to that d: what is left of the tilt is a shift in depth, 0.02 mm for 0.2 degrees 6 mm above
    the middle, where a hair is in focus for 0.9 mm.
    """
    if optics == optics.ideal():
        return ridges
    view = (optics.pitch_mm, optics.axis_col_px, optics.axis_row_px)
    col, row, angle = _set_right(ridges, focus_mm, optics, shape)
    u, v = to_image(col, row, *view)
    u, v, d = tilt_back(u, v, focus_mm, *tilt_of(optics))
    along_u, along_v, _ = slope(u, v, optics.working_distance_mm)
    col, row = to_pixel(u + (focus_mm - d) * along_u, v + (focus_mm - d) * along_v, *view)
    inside = (col >= 0) & (col <= shape[1] - 1) & (row >= 0) & (row <= shape[0] - 1)
    angle = (angle + np.radians(optics.tilt_deg)) % np.pi  # a hair along the axis becomes upright
    return Ridges(*(np.asarray(a, np.float32)[inside] for a in (col, row, angle, ridges.strength, ridges.breadth)))


def _set_right(ridges: Ridges, focus_mm: float, optics: Optics, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Column, row and angle (n,) of ridges without distortion and the stage's travel aside."""
    col, row, angle = (np.asarray(a, np.float64) for a in (ridges.col, ridges.row, ridges.angle))
    if not optics.displaces:
        return col, row, angle
    if optics.k1_per_mm2 == 0 and optics.k2_per_mm4 == 0:
        return *set_right(col, row, focus_mm, optics, shape), angle
    col_on, row_on = set_right(col + 0.5 * np.cos(angle), row - 0.5 * np.sin(angle), focus_mm, optics, shape)
    col_back, row_back = set_right(col - 0.5 * np.cos(angle), row + 0.5 * np.sin(angle), focus_mm, optics, shape)
    return *set_right(col, row, focus_mm, optics, shape), np.arctan2(row_back - row_on, col_on - col_back)


def breadth_of(stored):
    """Breadth of the ``stored`` one."""
    return stored / BREADTH_STEPS - 1


def seen_by(features: SweepFeatures, sweep: Sweep, optics: Optics) -> SweepFeatures:
    """Features that were stored as the photographs show them, for a rig whose angle, positions and lean are known better.

    sweep.positions_mm are those of the photographs in the order of the capture, as when the features were stored.
    """
    positions = np.sort(np.asarray(sweep.positions_mm, np.float64))
    if optics == optics.ideal():
        return replace(features, angle_deg=sweep.angle_deg, positions_mm=positions)
    col, row = pixels(features)
    angle = features.angle * (np.pi / ANGLE_STEPS)
    strength, breadth = STRENGTH_LEAST * np.exp(features.strength / STRENGTH_STEPS), breadth_of(features.breadth)
    told = col, row, angle, strength, breadth
    order = np.argsort(features.frame, kind="stable")
    ends = np.searchsorted(features.frame[order], np.arange(len(positions) + 1))
    frames = (order[a:b] for a, b in pairwise(ends))
    found = [upright(Ridges(*(a[i] for a in told)), d, optics, features.shape) for i, d in zip(frames, positions, strict=True)]
    return pack(sweep.angle_deg, positions, features.shape, found)


# ---- one file a sweep ------------------------------------------------------------------------------------------------

RECORDS = ("positions_mm", "cells", "col", "row", "frame", "angle", "strength", "breadth")


def save_features(path: Path, features: SweepFeatures) -> None:
    """Write one sweep as .npy arrays one after the other in one file (a header of angle and shape first), atomically."""
    with atomic(path) as part, open(part, "wb") as file:
        np.save(file, np.array([features.angle_deg, *features.shape], np.float64))
        for name in RECORDS:
            np.save(file, getattr(features, name))


def load_features(path: Path) -> SweepFeatures:
    """Memory-map a sweep's file. Raises StrandscopeError where it is not whole."""
    arrays = []
    try:
        with open(path, "rb") as file:
            for _ in range(1 + len(RECORDS)):
                version = np.lib.format.read_magic(file)
                read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
                shape, _, dtype = read(file)
                begin, count = file.tell(), int(np.prod(shape))
                arrays.append(np.asarray(np.memmap(file, dtype, "r", begin, shape)) if count else np.zeros(shape, dtype))
                file.seek(begin + count * dtype.itemsize)
    except (OSError, ValueError, EOFError) as error:
        raise StrandscopeError(f"{path}: not a whole features file ({error}); delete it and run again") from error
    angle_deg, rows, columns = arrays[0]
    return SweepFeatures(float(angle_deg), arrays[1], (int(rows), int(columns)), *arrays[2:])


# ---- all sweeps, for growing -----------------------------------------------------------------------------------------


class Index(NamedTuple):
    """All sweeps in memory, as kernels take them: 8 bytes a feature and the cells. A ``strength`` of USED or more is a feature used up."""

    col: np.ndarray
    row: np.ndarray
    frame: np.ndarray
    angle: np.ndarray
    strength: np.ndarray
    cells: np.ndarray  # int32, of all sweeps one after the other, counting from the sweep's first feature
    first: np.ndarray  # (sweeps + 1,) int64: first feature of each sweep
    first_cell: np.ndarray  # (sweeps + 1,) int64
    positions: np.ndarray  # float64, of all sweeps
    positions_f32: np.ndarray  # the same, for kernels that look at many features
    first_position: np.ndarray  # (sweeps + 1,) int64
    cos: np.ndarray  # (sweeps,) of the turntable angle
    sin: np.ndarray
    around: np.ndarray  # (sweeps,) int64: the sweeps in the order of their angles
    rows: int
    columns: int
    pitch: float
    axis_col: float
    axis_row: float
    distance: float  # l, mm


def build_index(sweeps: Sequence[SweepFeatures], optics: Optics) -> Index:
    """Join the sweeps into one Index. Raises StrandscopeError unless all have photographs of one size."""
    if len({sweep.shape for sweep in sweeps}) != 1:
        raise StrandscopeError(f"sweeps have photographs of {len({s.shape for s in sweeps})} sizes; expected one")
    join = {name: np.concatenate([getattr(s, name) for s in sweeps]) for name in ("col", "row", "frame", "angle", "strength", "cells")}
    theta = np.radians([s.angle_deg for s in sweeps])
    return Index(
        **join,
        first=_starts([len(s) for s in sweeps]),
        first_cell=_starts([len(s.cells) for s in sweeps]),
        positions=np.concatenate([s.positions_mm for s in sweeps]),
        positions_f32=np.concatenate([s.positions_mm for s in sweeps]).astype(np.float32),
        first_position=_starts([len(s.positions_mm) for s in sweeps]),
        cos=np.cos(theta),
        sin=np.sin(theta),
        around=np.argsort(theta % (2 * np.pi), kind="stable"),
        rows=sweeps[0].shape[0],
        columns=sweeps[0].shape[1],
        pitch=optics.pitch_mm,
        axis_col=optics.axis_col_px,
        axis_row=optics.axis_row_px,
        distance=optics.working_distance_mm,
    )


def _starts(sizes) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)


@njit(cache=True, nogil=True)
def strength_of(level):
    """Strength of the stored ``level``, used up or not."""
    return _STRENGTHS[level & (USED - 1)]


@njit(cache=True, nogil=True)
def frames_between(index, k, low_mm, high_mm):
    """The frames [a, b) of sweep k whose d lies in [low_mm, high_mm]."""
    positions = index.positions[index.first_position[k] : index.first_position[k + 1]]
    return np.searchsorted(positions, low_mm, "left"), np.searchsorted(positions, high_mm, "right")


@njit(cache=True, nogil=True)
def cell_range(index, u, v, half_u, half_v):
    """Strips [a, b) and blocks [c, d) of cells that a rectangle (mm, half extents) around (u, v) touches."""
    col, row = _to_pixel(u, v, index.pitch, index.axis_col, index.axis_row)
    half_col, half_row = half_u / index.pitch, half_v / index.pitch
    strips, blocks = index.columns // STRIP_PX + 1, index.rows // BLOCK_PX + 1
    first_strip = max(int(np.floor((col - half_col) / STRIP_PX)), 0)
    last_strip = min(int(np.floor((col + half_col) / STRIP_PX)) + 1, strips)
    first_block = max(int(np.floor((row - half_row) / BLOCK_PX)), 0)
    last_block = min(int(np.floor((row + half_row) / BLOCK_PX)) + 1, blocks)
    return first_strip, last_strip, first_block, last_block


@njit(cache=True, nogil=True)
def run_of(index, k, strip, block, first_frame, last_frame):
    """Features [a, b) of sweep k in one column of cells and the frames [first_frame, last_frame)."""
    frames = index.first_position[k + 1] - index.first_position[k]
    cell = index.first_cell[k] + (strip * (index.rows // BLOCK_PX + 1) + block) * frames
    return index.first[k] + index.cells[cell + first_frame], index.first[k] + index.cells[cell + last_frame]


@njit(cache=True, nogil=True)
def image_of(index, i, strip, block):
    """(u, v) mm of feature i, which lies in the given strip and block."""
    col, row = strip * STRIP_PX + index.col[i] / COL_STEPS, block * BLOCK_PX + index.row[i] / ROW_STEPS
    return _to_image(col, row, index.pitch, index.axis_col, index.axis_row)


@njit(cache=True, nogil=True)
def _box_hits(index, k, centre, axes, half, hits):
    """Write the features of sweep k in an oriented box of the camera frame into hits; returns their number."""
    reach = np.zeros(3)
    for a in range(3):
        for b in range(3):
            reach[b] += abs(axes[a, b]) * half[a]
    first_frame, last_frame = frames_between(index, k, centre[2] - reach[2], centre[2] + reach[2])
    s0, s1, b0, b1 = cell_range(index, centre[0], centre[1], reach[0], reach[1])
    count = 0
    for strip in range(s0, s1):
        for block in range(b0, b1):
            start, stop = run_of(index, k, strip, block, first_frame, last_frame)
            for i in range(start, stop):
                u, v = image_of(index, i, strip, block)
                x, y, z = u - centre[0], v - centre[1], index.positions[index.first_position[k] + index.frame[i]] - centre[2]
                inside = index.strength[i] < USED
                for a in range(3):
                    inside = inside and abs(axes[a, 0] * x + axes[a, 1] * y + axes[a, 2] * z) <= half[a]
                if inside:
                    if count < len(hits):
                        hits[count] = i
                    count += 1
    return count


def box_query(index: Index, sweep: int, centre_mm: np.ndarray, axes: np.ndarray, extents_mm: np.ndarray) -> np.ndarray:
    """Features (k,) int64 of one sweep in an oriented box, ascending. centre_mm (3,), axes (3, 3) unit rows, of the object frame;
    extents_mm (3,) full. Features that have been used up are left out."""
    centre, axes = (np.stack(turn(*np.asarray(a, float).T, index.cos[sweep], index.sin[sweep]), -1) for a in (centre_mm, axes))
    half = np.asarray(extents_mm, float) / 2
    hits = np.empty(4096, np.int64)
    count = _box_hits(index, sweep, centre, axes, half, hits)
    if count > len(hits):
        hits = np.empty(count, np.int64)
        _box_hits(index, sweep, centre, axes, half, hits)
    return np.sort(hits[:count])


class KdTree:
    """The paper's way: all features of a sweep in object space in a kd-tree. The plain version, and the oracle of ``box_query``."""

    def __init__(self, features: SweepFeatures, optics: Optics):
        u, v, d, _ = unpack(features, optics)
        self.points_mm = object_points(np.stack([u, v, d], -1).astype(float), features.angle_deg)
        self.tree = cKDTree(self.points_mm)

    def box_query(self, centre_mm: np.ndarray, axes: np.ndarray, extents_mm: np.ndarray) -> np.ndarray:
        """Features (k,) of the sweep in an oriented box of the object frame; as the function of that name."""
        half = np.asarray(extents_mm, float) / 2
        near = np.sort(self.tree.query_ball_point(centre_mm, np.linalg.norm(half))).astype(np.int64)
        inside = np.all(np.abs((self.points_mm[near] - centre_mm) @ np.asarray(axes).T) <= half, axis=1)
        return near[inside]
