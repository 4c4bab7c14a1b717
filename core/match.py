"""Where the observations of each sweep lie beside curves that are known already: what a calibration is made from."""

from typing import NamedTuple

import numpy as np
from numba import njit

from .features import ANGLE_STEPS, Index, cell_range, frames_between, image_of, run_of, strength_of
from .geometry import slope, to_pixel, turn
from .rig.calibrate import Sightings

_turn, _slope, _to_pixel = njit(turn), njit(slope), njit(to_pixel)
ROUNDS = 10  # of a window that moves with the observations in it
MAX_HITS = 2048  # observations of a sweep that one point looks at
CLEAR = 0.6  # share of the sightings that are too faint to tell a depth
CLEAREST = 0.98  # quantile of the strengths that faintness is told from
CROWD_MM = (1.0, 3.0)  # how far to the sides, and before and behind, hair is looked for that disturbs the depth
OWN_MM = (0.06, 0.6)  # the hair itself, as far
COLUMNS = 15


class Reach(NamedTuple):
    """Which observations belong to a point of a curve, half extents. The window begins at ``first`` and narrows."""

    along_mm: float
    across_mm: float
    depth_mm: float
    first_across_mm: float
    first_depth_mm: float
    angle: float  # rad
    least: int  # observations that make a sighting


def sides_of(tangents: np.ndarray) -> np.ndarray:
    """Two unit directions (n, 2, 3) perpendicular to unit tangents (n, 3) and to each other."""
    first = np.cross(tangents, np.where(np.abs(tangents[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]]))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(tangents, first)], axis=1)


def sightings(index: Index, points_mm: np.ndarray, tangents: np.ndarray, bends: np.ndarray, reach: Reach, towards: float = 0.0) -> Sightings:
    """How the observations of every sweep lie off points (n, 3) of curves with unit tangents (n, 3) and curvature vectors ``bends``
    (n, 3), 1/mm, towards the centre of curvature; object frame.

    One sighting in the image where a sweep has observations enough, and one in depth where they are clear as well. ``moved``
    is told for the directions of ``sides_of``. towards: the tilt of the axis towards the camera (rad), of which features were
    set upright while they kept their d.
    """
    rows = np.empty((len(points_mm) * len(index.cos) * 2, COLUMNS))
    points, along = (np.ascontiguousarray(a, np.float64) for a in (points_mm, tangents))
    sides = sides_of(along)
    rows = rows[: _sightings(index, points, along, sides, reach, np.sin(towards), rows)]
    depth, peak = rows[:, 2] > 0, rows[:, 12]
    clear, clearest = np.quantile(peak[depth], (CLEAR, CLEAREST)) if depth.any() else (0.0, 1.0)
    rows = rows[~depth | (peak >= clear)]
    before, behind = rows[:, 13], rows[:, 14]
    crowd = (before - behind) / (before + behind + 0.1 * np.sum(before + behind) / max(len(rows), 1) + 1e-12)
    faint = np.log(clearest / np.maximum(rows[:, 12], 1e-9))
    point, sweep = (rows[:, i].astype(np.int64) for i in (0, 1))
    bend = (np.einsum("pi,psi->ps", bends, sides)[point] * rows[:, 10:12]).sum(axis=1)
    return Sightings(point, sweep, rows[:, 2] > 0, rows[:, 3], rows[:, 4:7], rows[:, 7:10], rows[:, 10:12], crowd, faint, bend)


@njit(cache=True, nogil=True)
def _sightings(index, points, tangents, sides, reach, lean, rows):
    """Fill rows (R, 15): point, sweep, depth, off, way (3), at (3), moved (2), peak, hair before and behind; returns their number."""
    hits = np.empty((MAX_HITS, 3))
    ways = np.empty((3, 3))
    count = 0
    for p in range(len(points)):
        for k in range(len(index.cos)):
            u, v, w = _turn(points[p, 0], points[p, 1], points[p, 2], index.cos[k], index.sin[k])
            positions = index.positions[index.first_position[k] : index.first_position[k + 1]]
            col, row = _to_pixel(u, v, index.pitch, index.axis_col, index.axis_row)
            if not (positions[0] <= w <= positions[-1] and 0 <= col <= index.columns - 1 and 0 <= row <= index.rows - 1):
                continue
            ways[0] = _turn(tangents[p, 0], tangents[p, 1], tangents[p, 2], index.cos[k], index.sin[k])
            # how the image of the point moves as it slides along the hair
            du, dv = ways[0, 0] + u / index.distance * ways[0, 2], ways[0, 1] + v / index.distance * ways[0, 2]
            if np.hypot(du, dv) < 0.5:  # the hair points at the camera
                continue
            sx, sy, sz = _slope(u, v, index.distance)
            along = sx * ways[0, 0] + sy * ways[0, 1] + sz * ways[0, 2]
            sx, sy, sz = sx - along * ways[0, 0], sy - along * ways[0, 1], sz - along * ways[0, 2]
            size = np.sqrt(sx * sx + sy * sy + sz * sz)
            ways[1] = sx / size, sy / size, sz / size
            ways[2] = np.cross(ways[0], ways[1])
            place = np.array((u, v, w))
            found = _hits(index, k, place, ways, np.arctan2(dv, du), reach, hits)
            if found < reach.least:
                continue
            across, depth, peak, heard = _centre(hits, found, reach)
            if heard < reach.least:
                continue
            depth = _sharpest(hits, found, reach, across, depth)
            # told by where the point is, not by where it seems to be: that would choose among the errors
            whole = positions[0] + 1.5 * reach.depth_mm <= w <= positions[-1] - 1.5 * reach.depth_mm
            before = behind = 0.0
            if whole and not np.isnan(depth):
                before, behind = _crowd(index, k, place)
            for kind in range(2 if whole and not np.isnan(depth) else 1):
                way, off = ways[2 - kind].copy(), depth - lean * v * ways[1, 2]
                if kind == 0:
                    # the line of sight passes the point this far off in the image. Its lean is left out of the equations: it would
                    # tell the focus and the scale by hundredths of a micrometre, which is more than ridges are good for
                    size = np.hypot(way[0], way[1])
                    way[0], way[1], way[2] = way[0] / size, way[1] / size, 0.0
                    off = across / size
                rows[count, 0], rows[count, 1], rows[count, 2], rows[count, 3] = p, k, kind, off
                rows[count, 4:7] = way
                rows[count, 7:10] = place
                for s in range(2):
                    x, y, z = _turn(sides[p, s, 0], sides[p, s, 1], sides[p, s, 2], index.cos[k], index.sin[k])
                    rows[count, 10 + s] = way[0] * x + way[1] * y + way[2] * z
                rows[count, 12], rows[count, 13], rows[count, 14] = peak, before, behind
                count += 1
    return count


@njit(cache=True, nogil=True)
def _crowd(index, k, place):
    """Strength of the observations of sweep k to the sides of a point, (before it, behind it); its own are left out."""
    half, deep = CROWD_MM
    height = 3.5 * index.pitch
    first_frame, last_frame = frames_between(index, k, place[2] - deep, place[2] + deep)
    s0, s1, b0, b1 = cell_range(index, place[0], place[1], half, height)
    before = behind = 0.0
    for strip in range(s0, s1):
        for block in range(b0, b1):
            start, stop = run_of(index, k, strip, block, first_frame, last_frame)
            for i in range(start, stop):
                u, v = image_of(index, i, strip, block)
                x, z = abs(u - place[0]), index.positions[index.first_position[k] + index.frame[i]] - place[2]
                if x > half or abs(v - place[1]) > height or (x < OWN_MM[0] and abs(z) < OWN_MM[1]):
                    continue
                near = (1 - (x / half) ** 2) * strength_of(index.strength[i])
                before += near * (z > 0)
                behind += near * (z <= 0)
    return before, behind


@njit(cache=True, nogil=True)
def _hits(index, k, place, ways, angle, reach, hits):
    """Observations of sweep k about a point: hits (n, 3) receives across, depth (mm) and strength; returns their number.

    place (3,) and ways (3, 3), rows along the hair, along the ribbon and across it, in the frame of the sweep.
    """
    half_across, half_depth = 2 * reach.first_across_mm, 2 * reach.first_depth_mm  # room for the window to move
    size = np.abs(ways[0]) * reach.along_mm + np.abs(ways[1]) * half_depth + np.abs(ways[2]) * half_across
    first_frame, last_frame = frames_between(index, k, place[2] - size[2], place[2] + size[2])
    s0, s1, b0, b1 = cell_range(index, place[0], place[1], size[0], size[1])
    count = 0
    for strip in range(s0, s1):
        for block in range(b0, b1):
            start, stop = run_of(index, k, strip, block, first_frame, last_frame)
            for i in range(start, stop):
                u, v = image_of(index, i, strip, block)
                x, y = u - place[0], v - place[1]
                z = index.positions[index.first_position[k] + index.frame[i]] - place[2]
                across = ways[2, 0] * x + ways[2, 1] * y + ways[2, 2] * z
                depth = ways[1, 0] * x + ways[1, 1] * y + ways[1, 2] * z
                if abs(across) > half_across or abs(depth) > half_depth:
                    continue
                if abs(ways[0, 0] * x + ways[0, 1] * y + ways[0, 2] * z) > reach.along_mm:
                    continue
                off = index.angle[i] * (np.pi / ANGLE_STEPS) - angle
                if abs(off - np.pi * np.round(off / np.pi)) > reach.angle or count == len(hits):
                    continue
                hits[count] = across, depth, strength_of(index.strength[i])
                count += 1
    return count


@njit(cache=True, nogil=True)
def _centre(hits, count, reach):
    """(across, depth, peak strength, observations) of a streak: where they are densest, by a window that moves and narrows."""
    across = depth = peak = 0.0
    heard = 0
    for trial in range(ROUNDS):
        narrow = min(2.0 * trial / ROUNDS, 1.0)
        half_across = reach.first_across_mm + narrow * (reach.across_mm - reach.first_across_mm)
        half_depth = reach.first_depth_mm + narrow * (reach.depth_mm - reach.first_depth_mm)
        w = wa = wd = peak = 0.0
        heard = 0
        for i in range(count):
            x, y = (hits[i, 0] - across) / half_across, (hits[i, 1] - depth) / half_depth
            near = max(1 - x * x, 0.0) * max(1 - y * y, 0.0)
            weight = near * near * hits[i, 2]
            w += weight
            wa += weight * hits[i, 0]
            wd += weight * hits[i, 1]
            if near > 0:
                peak = max(peak, hits[i, 2])
                heard += 1
        if w < 1e-12:
            return 0.0, 0.0, 0.0, 0
        across, depth = wa / w, wd / w
    return across, depth, peak, heard


@njit(cache=True, nogil=True)
def _sharpest(hits, count, reach, across, depth):
    """Where in depth (mm) a streak is strongest: the vertex of a parabola through the logarithm of its strength; nan for none.

    Unlike their mean, it does not move with observations that are missing or belong to neighbours. Robust: four rounds of
    least squares, then four that do not hear what is off.
    """
    sigma = 1.0
    fit = np.zeros(3)
    basis, matrix, right = np.ones(3), np.empty((3, 3)), np.empty(3)
    for trial in range(8):
        matrix[:], right[:] = 0.0, 0.0
        total = left = 0.0
        for i in range(count):
            x, z = (hits[i, 0] - across) / reach.across_mm, (hits[i, 1] - depth) / reach.depth_mm
            near = max(1 - x * x, 0.0) * np.sqrt(max(1 - z * z, 0.0)) * hits[i, 2] ** 2
            if near == 0:
                continue
            basis[1], basis[2] = hits[i, 1], hits[i, 1] ** 2
            level = np.log(hits[i, 2])
            off = level - basis @ fit
            total += near
            left += near * abs(off)
            if trial > 3:
                near *= max(1 - (off / (3 * sigma)) ** 2, 0.0) ** 2
            for j in range(3):
                right[j] += near * basis[j] * level
                for k in range(3):
                    matrix[j, k] += near * basis[j] * basis[k]
        if total == 0 or np.linalg.det(matrix / total) < 1e-9:
            return np.nan
        if trial > 2:
            sigma = max(1.25 * left / total, 0.05)
        fit = np.linalg.solve(matrix, right)
        if fit[2] > -0.5:
            return np.nan
        depth = -fit[1] / (2 * fit[2])
        if abs(depth) > 2 * reach.first_depth_mm:
            return np.nan
    return depth
