"""Which other curves pass near the points of a curve: how far away, at what angle, and where on them.

Curves are polylines; distances are exact, to the nearest place of a segment and not to the nearest point. All segments lie in a
grid of cells, cut so that each part is at most half a cell long; a point looks at its own cell first, then at the cells around it,
ring after ring, until what it has found is nearer than anything farther out can be. Each point is on its own and ties go to the
curve with the lower number, so neither the number of threads nor the size of the cells has a say in the result.
"""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numba import get_num_threads, njit

from .errors import StrandscopeError

_MOST_CELLS = 2**24  # of the grid: 64 MB
_PART = 0.5  # of a cell's edge: longer segments stand in the grid in parts
_PIECE = 4096  # points that a thread takes at a time
_NONE = -1


class Nearest(NamedTuple):
    """For each of N points the nearest place on another curve."""

    distance_mm: np.ndarray  # (N,) float64: to its centreline; inf where there is none within reach
    angle: np.ndarray  # (N,) float64, 0 … pi/2 rad: between the two directions, head and tail alike; NaN where there is none
    curve: np.ndarray  # (N,) int64: number of the other curve, -1 where there is none
    segment: np.ndarray  # (N,) int64: the place lies between the points with this number and the next, -1 where there is none
    share: np.ndarray  # (N,) float64, 0 … 1: how far along that segment


class Pairs(NamedTuple):
    """P pairs of a point and another curve within its reach, ordered by point, then by curve: each curve stands once, with its nearest place."""

    point: np.ndarray  # (P,) int64
    curve: np.ndarray  # (P,) int64
    distance_mm: np.ndarray  # (P,) float64
    angle: np.ndarray  # (P,) float64, 0 … pi/2 rad


def nearest_other(
    points_mm: np.ndarray, offsets: np.ndarray, reach_mm: float, among: np.ndarray | None = None, asking: np.ndarray | None = None
) -> Nearest:
    """The nearest other curve of each point of curves, within a distance.

    points_mm (N, 3), offsets (M + 1,): the curves, each with at least 2 points. reach_mm: how far to look; np.inf is allowed and
    slow where a point is far from all else. among (M,) bool: the curves that count as neighbours; None: all. asking: the curves whose
    points ask (M,) bool, or the points that ask (N,) bool, while others find nothing; None: all.

    A curve is never its own neighbour, so that one that comes back to itself does not find itself. The direction at a point is that of
    the chord between the points before and after it, and on a segment it goes over evenly from that of one end to that of the other.
    Raises StrandscopeError for shapes that do not fit, and points that are not finite.
    """
    points, offsets, among, asking = _checked(points_mm, offsets, reach_mm, among, asking)
    grid, curve_of, tangents = _gridded(points, offsets, among), _curve_of(offsets), _tangents(points, offsets)

    def work(low, high):
        return _nearest(low, high, points, tangents, curve_of, asking, float(reach_mm), *grid)

    distance, angle, segment, share = _in_pieces(work, 0, len(points))
    return Nearest(distance, angle, np.where(segment == _NONE, _NONE, curve_of[segment]), segment, share)


def pairs_within(
    points_mm: np.ndarray, offsets: np.ndarray, reach_mm: float, among: np.ndarray | None = None, asking: np.ndarray | None = None
) -> Pairs:
    """Every other curve that comes within a distance of each point of curves; arguments and errors as of ``nearest_other``.

    32 bytes a pair, and up to twice as much again while it works: with hair as dense as ρ fibers per mm², expect π ρ reach² pairs a point.
    """
    parts = list(pairs_in_turn(points_mm, offsets, reach_mm, among, asking))
    return Pairs(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def pairs_in_turn(
    points_mm: np.ndarray,
    offsets: np.ndarray,
    reach_mm: float,
    among: np.ndarray | None = None,
    asking: np.ndarray | None = None,
    at_a_time: int = 16 * _PIECE,
) -> Iterator[Pairs]:
    """The same pairs, those of so many points at a time; with at least one part, which may be empty."""
    points, offsets, among, asking = _checked(points_mm, offsets, reach_mm, among, asking)
    grid, curve_of, tangents = _gridded(points, offsets, among), _curve_of(offsets), _tangents(points, offsets)

    def work(low, high):
        return _pairs(low, high, points, tangents, curve_of, asking, float(reach_mm), *grid, len(among))

    for low in range(0, max(len(points), 1), at_a_time):
        yield Pairs(*_in_pieces(work, low, min(low + at_a_time, len(points))))


def _checked(points_mm, offsets, reach_mm, among, asking):
    """The arrays as the kernels want them; asking (N,)."""
    points, offsets = np.ascontiguousarray(points_mm, np.float64), np.ascontiguousarray(offsets, np.int64)
    if points.ndim != 2 or points.shape[1] != 3 or not np.all(np.isfinite(points)):
        raise StrandscopeError(f"neighbours: points have shape {points.shape}; expected (N, 3), all finite")
    if offsets.ndim != 1 or len(offsets) < 1 or offsets[0] != 0 or offsets[-1] != len(points) or np.any(np.diff(offsets) < 2):
        raise StrandscopeError(f"neighbours: offsets do not fit {len(points)} points; expected 0 … {len(points)}, each curve with at least 2 points")
    if not reach_mm > 0:
        raise StrandscopeError(f"neighbours: reach_mm is {reach_mm}; expected more than 0")
    sizes = np.diff(offsets)
    among = np.ones(len(sizes), bool) if among is None else np.ascontiguousarray(among, bool)
    asking = np.ones(len(points), bool) if asking is None else np.ascontiguousarray(asking, bool)
    if among.shape != (len(sizes),):
        raise StrandscopeError(f"neighbours: among has shape {among.shape}; expected one value a curve ({len(sizes)},)")
    if asking.shape not in ((len(sizes),), (len(points),)):
        raise StrandscopeError(f"neighbours: asking has shape {asking.shape}; expected one value a curve ({len(sizes)},) or a point ({len(points)},)")
    return points, offsets, among, asking if len(asking) == len(points) else np.repeat(asking, sizes)


def _curve_of(offsets):
    """Number (N,) int64 of each point's curve; of a segment's, that of its first point."""
    return np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))


def _in_pieces(work, start, end):
    """The arrays that ``work`` (low, high) returns for pieces of points start … end - 1, joined in order; a thread takes a piece at a time."""
    if end - start <= _PIECE:
        return work(start, end)
    bounds = [*range(start, end, _PIECE), end]
    with ThreadPoolExecutor(get_num_threads()) as threads:
        pieces = list(threads.map(lambda ends: work(*ends), pairwise(bounds)))
    return [np.concatenate(arrays) for arrays in zip(*pieces, strict=True)]


@njit(cache=True, nogil=True)
def _tangents(points, offsets):
    """Unit directions (N, 3) at points; 0 where the points before and after are the same."""
    tangents = np.empty_like(points)
    for c in range(len(offsets) - 1):
        first, last = offsets[c], offsets[c + 1] - 1
        for i in range(first, last + 1):
            a, b = max(i - 1, first), min(i + 1, last)
            x, y, z = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
            length = np.sqrt(x * x + y * y + z * z)
            scale = 1.0 / length if length > 0.0 else 0.0
            tangents[i, 0], tangents[i, 1], tangents[i, 2] = x * scale, y * scale, z * scale
    return tangents


# ---- the grid --------------------------------------------------------------------------------------------------------


def _gridded(points, offsets, among):
    """(low corner (3,), cell's edge, shape (3,), how far a part reaches from its middle, first (cells + 1,), parts' segments (P,))
    of the segments of the curves that count. The cell's edge is the spacing of parallel hair of the same length in the same volume."""
    inner = np.ones(len(points), bool)
    inner[offsets[1:] - 1] = False
    segments = np.flatnonzero(inner & np.repeat(among, np.diff(offsets)))
    low = points.min(axis=0) if len(points) else np.zeros(3)
    extent = np.ptp(points, axis=0) if len(points) else np.ones(3)
    extent = np.maximum(extent, max(0.01 * extent.max(), 1e-6))
    length = max(float(np.linalg.norm(points[segments + 1] - points[segments], axis=1).sum()), 1e-6)
    volume = float(np.prod(extent))
    for _ in range(2):  # the second time with the volume of the cells that hold hair
        cell = np.sqrt(volume / length)
        while np.prod(np.floor(extent / cell) + 1) > _MOST_CELLS:
            cell *= 1.25
        shape = np.floor(extent / cell).astype(np.int64) + 1
        first, parts, slack = _sorted_parts(points, segments, low, cell, shape)
        volume = max(np.count_nonzero(np.diff(first)) * cell**3, 1e-18)
    return low, cell, shape, slack, first, parts


@njit(cache=True, nogil=True)
def _sorted_parts(points, segments, low, cell, shape):
    """Segments by the cells in which the middles of their parts lie: first (cells + 1,), segments (P,); and half the longest part."""
    first = np.zeros(shape[0] * shape[1] * shape[2] + 1, np.int32)
    slack = 0.0
    for turn in range(2):  # count, then fill from the end of each cell
        if turn == 1:
            for k in range(len(first) - 1):
                first[k + 1] += first[k]
            parts = np.empty(first[-1], np.int32)
        for s in range(len(segments) - 1, -1, -1):
            a = segments[s]
            x, y, z = points[a + 1, 0] - points[a, 0], points[a + 1, 1] - points[a, 1], points[a + 1, 2] - points[a, 2]
            length = np.sqrt(x * x + y * y + z * z)
            count = max(int(np.ceil(length / (_PART * cell))), 1)
            slack = max(slack, 0.5 * length / count)
            for k in range(count - 1, -1, -1):
                t = (k + 0.5) / count
                i = _cell_of(points[a, 0] + t * x - low[0], cell, shape[0])
                j = _cell_of(points[a, 1] + t * y - low[1], cell, shape[1])
                m = (i * shape[1] + j) * shape[2] + _cell_of(points[a, 2] + t * z - low[2], cell, shape[2])
                if turn == 0:
                    first[m] += 1
                else:
                    first[m] -= 1
                    parts[first[m]] = a
    return first, parts, slack


@njit(cache=True, nogil=True, inline="always")
def _cell_of(place, cell, count):
    return min(max(int(place / cell), 0), count - 1)


# ---- kernels: bound by the parts of some ten cells that each point looks at, which are in the cache for the points before and after ----


@njit(cache=True, nogil=True)
def _beside(points, p, a):
    """(squared distance, share) of the place on segment a nearest to point p."""
    x, y, z = points[a + 1, 0] - points[a, 0], points[a + 1, 1] - points[a, 1], points[a + 1, 2] - points[a, 2]
    u, v, w = points[p, 0] - points[a, 0], points[p, 1] - points[a, 1], points[p, 2] - points[a, 2]
    square = x * x + y * y + z * z
    t = min(max((u * x + v * y + w * z) / square, 0.0), 1.0) if square > 0.0 else 0.0
    u, v, w = u - t * x, v - t * y, w - t * z
    return u * u + v * v + w * w, t


@njit(cache=True, nogil=True)
def _angle(tangents, p, a, t):
    """Angle between the directions at point p and at share t of segment a, head and tail alike; NaN where there is none."""
    u, v, w = tangents[p]
    x = (1.0 - t) * tangents[a, 0] + t * tangents[a + 1, 0]
    y = (1.0 - t) * tangents[a, 1] + t * tangents[a + 1, 1]
    z = (1.0 - t) * tangents[a, 2] + t * tangents[a + 1, 2]
    if u * u + v * v + w * w == 0.0 or x * x + y * y + z * z == 0.0:
        return np.nan
    i, j, k = v * z - w * y, w * x - u * z, u * y - v * x
    return np.arctan2(np.sqrt(i * i + j * j + k * k), abs(u * x + v * y + w * z))


@njit(cache=True, nogil=True, inline="always")
def _outside(place, index, cell):
    """How far a place, along one axis, is from a cell: 0 inside it."""
    return max(max(index * cell - place, place - (index + 1) * cell), 0.0)


@njit(cache=True, nogil=True)
def _nearest(start, end, points, tangents, curve_of, asking, reach, low, cell, shape, slack, first, parts):
    """(distance, angle, segment, share), each (end - start,), of ``Nearest`` for those points."""
    count = end - start
    distance, angle, share = np.full(count, np.inf), np.full(count, np.nan), np.full(count, np.nan)
    segment = np.full(count, _NONE, np.int64)
    for p in range(start, end):
        own = curve_of[p]
        if not asking[p]:
            continue
        x, y, z = points[p, 0] - low[0], points[p, 1] - low[1], points[p, 2] - low[2]
        i0, j0, k0 = _cell_of(x, cell, shape[0]), _cell_of(y, cell, shape[1]), _cell_of(z, cell, shape[2])
        best, found, at = reach * reach, _NONE, 0.0
        rings = max(max(max(i0, shape[0] - 1 - i0), max(j0, shape[1] - 1 - j0)), max(k0, shape[2] - 1 - k0))
        for ring in range(rings + 1):
            gap = (ring - 1) * cell - slack
            if gap > 0.0 and gap * gap > best:
                break
            for i in range(max(i0 - ring, 0), min(i0 + ring, shape[0] - 1) + 1):
                off_i = _outside(x, i, cell)
                for j in range(max(j0 - ring, 0), min(j0 + ring, shape[1] - 1) + 1):
                    off_j = _outside(y, j, cell)
                    rim = abs(i - i0) == ring or abs(j - j0) == ring
                    step = 1 if rim or ring == 0 else 2 * ring  # inside the ring only its two ends are new
                    for k in range(k0 - ring, k0 + ring + 1, step):
                        if k < 0 or k >= shape[2]:
                            continue
                        m = (i * shape[1] + j) * shape[2] + k
                        if first[m] == first[m + 1]:
                            continue
                        off_k = _outside(z, k, cell)
                        off = np.sqrt(off_i * off_i + off_j * off_j + off_k * off_k) - slack
                        if off > 0.0 and off * off > best:
                            continue
                        for n in range(first[m], first[m + 1]):
                            a = parts[n]
                            if curve_of[a] == own:
                                continue
                            square, t = _beside(points, p, a)
                            if square < best or (square == best and (found == _NONE or a < found)):
                                best, found, at = square, a, t
        if found != _NONE:
            distance[p - start], segment[p - start], share[p - start] = np.sqrt(best), found, at
            angle[p - start] = _angle(tangents, p, found, at)
    return distance, angle, segment, share


@njit(cache=True, nogil=True)
def _pairs(start, end, points, tangents, curve_of, asking, reach, low, cell, shape, slack, first, parts, curves):
    """(point, curve, distance, angle), each (P,), of ``Pairs`` for points start … end - 1; curves: their number."""
    point, other, distance, angle = np.empty(1024, np.int64), np.empty(1024, np.int64), np.empty(1024), np.empty(1024)
    slot = np.full(curves, _NONE, np.int64)  # of each curve among those found for the point at hand
    found, nearest, segment, at = np.empty(curves, np.int64), np.empty(curves), np.empty(curves, np.int64), np.empty(curves)
    total, wide = 0, reach + slack
    for p in range(start, end):
        own, near = curve_of[p], 0
        if not asking[p]:
            continue
        x, y, z = points[p, 0] - low[0], points[p, 1] - low[1], points[p, 2] - low[2]
        for i in range(_cell_of(x - wide, cell, shape[0]), _cell_of(x + wide, cell, shape[0]) + 1):
            off_i = _outside(x, i, cell)
            for j in range(_cell_of(y - wide, cell, shape[1]), _cell_of(y + wide, cell, shape[1]) + 1):
                off_j = _outside(y, j, cell)
                for k in range(_cell_of(z - wide, cell, shape[2]), _cell_of(z + wide, cell, shape[2]) + 1):
                    m = (i * shape[1] + j) * shape[2] + k
                    off_k = _outside(z, k, cell)
                    if first[m] == first[m + 1] or off_i * off_i + off_j * off_j + off_k * off_k > wide * wide:
                        continue
                    for n in range(first[m], first[m + 1]):
                        a = parts[n]
                        c = curve_of[a]
                        if c == own:
                            continue
                        square, t = _beside(points, p, a)
                        if square > reach * reach:
                            continue
                        s = slot[c]
                        if s == _NONE:
                            slot[c], found[near], nearest[near], segment[near], at[near] = near, c, square, a, t
                            near += 1
                        elif square < nearest[s] or (square == nearest[s] and a < segment[s]):
                            nearest[s], segment[s], at[s] = square, a, t
        while total + near > len(point):
            point, other = np.concatenate((point, np.empty_like(point))), np.concatenate((other, np.empty_like(other)))
            distance, angle = np.concatenate((distance, np.empty_like(distance))), np.concatenate((angle, np.empty_like(angle)))
        for s in np.argsort(found[:near]):
            point[total], other[total], distance[total] = p, found[s], np.sqrt(nearest[s])
            angle[total] = _angle(tangents, p, segment[s], at[s])
            slot[found[s]] = _NONE
            total += 1
    return point[:total], other[:total], distance[:total], angle[:total]
