"""Which way hair runs at a place, told by the curves around it, and how a single hair departs from that.

Neighbours count by their distance, and only those that run roughly the same way, so that wisps that cross are kept apart.
Where a place has no curves near it, a field carried in from outside (``advection.direction_field``) says the way.

How a hair departs from its neighbours is kept as two numbers a point: the parts of its direction along two axes that are
carried along the way without turning about it. The same two numbers on another way make another hair of the same kind.
"""

from typing import NamedTuple

import numpy as np
from numba import njit, prange

REACH = 2.5  # standard deviations from which on a neighbour does not count
ALIKE = 0.8  # cosine of the angle within which a neighbour runs the same way
FIELD_WEIGHT = 0.05  # of the field beside the neighbours, in points of neighbours at no distance


class Flow(NamedTuple):
    """What tells the way: K points of curves in cubes of the reach, and the field for where there are none."""

    points: np.ndarray  # (K, 3) mm, sorted by cube
    tangents: np.ndarray  # (K, 3) unit
    curves: np.ndarray  # (K,) int64: the curve of each
    starts: np.ndarray  # (cubes + 1,) int64: the points of each cube
    low: np.ndarray  # (3,) mm: corner of the cubes
    shape: np.ndarray  # (3,) int64
    sigma_mm: float
    step_mm: float  # between points of a curve
    field: np.ndarray  # (nx, ny, nz, 3) float32
    origin: np.ndarray  # (3,) mm: corner of the field
    voxel_mm: float


def tangents_of(points_mm: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Unit directions (N, 3) of curves of points (N, 3), by the neighbours of each point; every curve has two points or more."""
    points = np.asarray(points_mm, np.float64)
    first, last = (np.repeat(ends, np.diff(offsets)) for ends in (offsets[:-1], offsets[1:] - 1))
    i = np.arange(len(points))
    way = points[np.minimum(i + 1, last)] - points[np.maximum(i - 1, first)]
    return way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12)


def flow(points_mm: np.ndarray, offsets: np.ndarray, sigma_mm: float, field: np.ndarray, origin_mm, voxel_mm: float) -> Flow:
    """The flow of curves: points (N, 3) mm, about evenly spaced, and the field (nx, ny, nz, 3) for where they are far."""
    points = np.asarray(points_mm, np.float64)
    tangents = tangents_of(points, offsets)
    curves = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    size = REACH * sigma_mm
    low = points.min(axis=0) - 1e-6
    shape = (np.floor((points.max(axis=0) - low) / size) + 1).astype(np.int64)
    cubes = np.ravel_multi_index(tuple(np.floor((points - low) / size).astype(np.int64).T), tuple(shape))
    order = np.argsort(cubes, kind="stable")
    starts = np.searchsorted(cubes[order], np.arange(np.prod(shape) + 1))
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)[curves[1:] == curves[:-1]]
    field = np.ascontiguousarray(field, np.float32)
    told = points[order], tangents[order], curves[order], starts, low, shape, float(sigma_mm), float(np.median(steps))
    return Flow(*told, field, np.asarray(origin_mm, np.float64), float(voxel_mm))


@njit(cache=True, nogil=True)
def voxel_of(x, y, z, origin, voxel_mm, shape):
    """Indices (i, j, k) of the voxel of a grid at (x, y, z) mm; beyond the grid, of the nearest."""
    i = min(max(int((x - origin[0]) / voxel_mm), 0), shape[0] - 1)
    j = min(max(int((y - origin[1]) / voxel_mm), 0), shape[1] - 1)
    k = min(max(int((z - origin[2]) / voxel_mm), 0), shape[2] - 1)
    return i, j, k


@njit(cache=True, nogil=True)
def way_at(flow, x, y, z, tx, ty, tz, own):
    """Unit direction of the hair at (x, y, z) mm that runs as (tx, ty, tz) does, and how near the nearest curve passes, squared.

    own: a curve that does not count, or -1. Where nothing tells the direction, it is kept.
    """
    size = REACH * flow.sigma_mm
    i, j, k = int(np.floor((x - flow.low[0]) / size)), int(np.floor((y - flow.low[1]) / size)), int(np.floor((z - flow.low[2]) / size))
    nx, ny, nz = flow.shape
    sharp, nearest = -0.5 / flow.sigma_mm**2, np.inf
    sx, sy, sz = 0.0, 0.0, 0.0
    for a in range(max(i - 1, 0), min(i + 2, nx)):
        for b in range(max(j - 1, 0), min(j + 2, ny)):
            row = (a * ny + b) * nz
            left, right = max(k - 1, 0), min(k + 2, nz)
            if left >= right:
                continue
            for n in range(flow.starts[row + left], flow.starts[row + right]):
                dx, dy, dz = flow.points[n, 0] - x, flow.points[n, 1] - y, flow.points[n, 2] - z
                square = dx * dx + dy * dy + dz * dz
                if square > size * size or flow.curves[n] == own:
                    continue
                beside = dx * flow.tangents[n, 0] + dy * flow.tangents[n, 1] + dz * flow.tangents[n, 2]
                nearest = min(nearest, square - min(beside * beside, 0.25 * flow.step_mm**2))
                along = flow.tangents[n, 0] * tx + flow.tangents[n, 1] * ty + flow.tangents[n, 2] * tz
                if abs(along) < ALIKE:
                    continue
                weight = np.exp(sharp * square)
                if along < 0.0:
                    weight = -weight
                sx += weight * flow.tangents[n, 0]
                sy += weight * flow.tangents[n, 1]
                sz += weight * flow.tangents[n, 2]
    vector = flow.field[voxel_of(x, y, z, flow.origin, flow.voxel_mm, flow.field.shape)]
    weight = FIELD_WEIGHT
    if vector[0] * tx + vector[1] * ty + vector[2] * tz < 0.0:
        weight = -weight
    sx += weight * vector[0]
    sy += weight * vector[1]
    sz += weight * vector[2]
    length = np.sqrt(sx * sx + sy * sy + sz * sz)
    if length < 1e-6:
        return tx, ty, tz, nearest
    return sx / length, sy / length, sz / length, nearest


@njit(cache=True, nogil=True)
def across(fx, fy, fz, ax, ay, az):
    """The unit vector nearest to (ax, ay, az) at right angles to the unit vector (fx, fy, fz): an axis carried along the way."""
    along = ax * fx + ay * fy + az * fz
    ax, ay, az = ax - along * fx, ay - along * fy, az - along * fz
    length = np.sqrt(ax * ax + ay * ay + az * az)
    if length < 1e-6:  # it lay along the way: any other will do
        ax, ay, az = (1.0 - fx * fx, -fx * fy, -fx * fz) if abs(fx) < 0.7 else (-fx * fy, 1.0 - fy * fy, -fy * fz)
        length = np.sqrt(ax * ax + ay * ay + az * az)
    return ax / length, ay / length, az / length


@njit(cache=True, nogil=True, parallel=True)
def _departures(flow, points, tangents, offsets, out):
    for c in prange(len(offsets) - 1):
        ax, ay, az = 1.0, 0.0, 0.0
        for n in range(offsets[c], offsets[c + 1]):
            tx, ty, tz = tangents[n]
            fx, fy, fz, _ = way_at(flow, points[n, 0], points[n, 1], points[n, 2], tx, ty, tz, c)
            ax, ay, az = across(fx, fy, fz, ax, ay, az)
            bx, by, bz = fy * az - fz * ay, fz * ax - fx * az, fx * ay - fy * ax
            out[n, 0] = tx * ax + ty * ay + tz * az
            out[n, 1] = tx * bx + ty * by + tz * bz


def departures(flow: Flow, points_mm: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """How the curves that the flow is made from depart from their neighbours: (N, 2), parts of unit directions across the way."""
    points = np.ascontiguousarray(points_mm, np.float64)
    out = np.zeros((len(points), 2))
    _departures(flow, points, tangents_of(points, offsets), np.ascontiguousarray(offsets, np.int64), out)
    return out
