"""Hair for the inside that no camera sees, such that what was captured goes on in it.

Three kinds of strands are added, in this order. *Links* between two captured curves that are parts of one fiber; their
middle is hidden. *Continuations* of captured curves that end where they are hidden, to the bounds of the volume. *Whole*
hidden fibers, as many as the density of what was captured tells to be missing. The last two run along their neighbours
(``flow``), and depart from them as a captured hair elsewhere departs from its own; of some that a strand could be, one
that the cameras are likely to have missed is taken (``hidden``). Then all are pushed apart (``apart``).
"""

from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numba import njit, prange
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from .advection import AdvectionParams, captured_density, direction_field, uniform
from .apart import ApartParams, Tubes, push_apart
from .errors import StrandscopeError
from .flow import Flow, across, departures, flow, voxel_of, way_at
from .grid import Grid, occupied
from .hidden import hidden
from .joins import fibers_of
from .links import LinkParams, bends, bridge, find_links, up_to, ways_on
from .progress import Progress, silent


@dataclass(frozen=True)
class InfillParams:
    """Parameters of the infill. Lengths in mm."""

    method: str = "strandscope"  # or "paper": plain advection (``advection.advect``)
    count: int | None = None  # whole hidden fibers to add; None: as many as are missing by the density of the captured ones
    step_mm: float = 0.2  # between points
    seed: int = 0
    tries: int = 16  # continuations of which one is taken
    whole_tries: int = 2  # and whole fibers
    flow_mm: float = 0.5  # standard deviation of the distance at which neighbours tell the way
    hidden_mm: float = 1.0  # length over which hair is found or not as a whole
    density_mm: float = 0.4  # standard deviation of the blur of what is still missing
    air_mm: float = 0.4  # depth below the surface of the occupancy at which the hair itself begins
    air_cost: float = 3.0  # a mm outside the hull, in logs of probability
    meeting_cost: float = 6.0  # a mm that runs through a captured curve
    least_new_mm: float = 2.0  # a whole hidden fiber that would be shorter is none
    links: LinkParams = field(default_factory=LinkParams)
    apart: ApartParams = field(default_factory=ApartParams)
    advection: AdvectionParams = field(default_factory=AdvectionParams)


class Infill(NamedTuple):
    """M strands of N points, and how they and the captured curves go on in each other."""

    points_mm: np.ndarray  # (N, 3) float32, object frame
    offsets: np.ndarray  # (M + 1,) int64
    radius_mm: np.ndarray  # (N,) float32
    joins: np.ndarray  # (J, 2) int64: ends of one fiber; 2 c, 2 c + 1: first and last point of curve c, captured ones first


class Captured(NamedTuple):
    """What was captured: M curves of N points."""

    points_mm: np.ndarray  # (N, 3)
    offsets: np.ndarray  # (M + 1,)
    radius_mm: np.ndarray  # (N,)
    error_mm: np.ndarray  # (N,) expected, NaN where it is not known
    evidence: np.ndarray  # (N,): cameras that saw the point
    stops: np.ndarray  # (M, 2) of Stop


def infill(
    captured: Captured,
    distance_mm: np.ndarray,
    through: np.ndarray,
    grid: Grid,
    angles_deg: np.ndarray,
    params: InfillParams | None = None,
    progress: Progress = silent,
) -> Infill:
    """Strands for what no camera sees. distance_mm (nx, ny, nz): of ``inside.surface_distance``; through (nx, ny, nz): of
    ``hull.free_share``; angles_deg (a,): of the sweeps.

    The same input gives the same strands, whatever the number of threads. Raises StrandscopeError without captured curves, where the
    volume is empty, and for wrong shapes.
    """
    params = params or InfillParams()
    points, offsets, radii = _checked(captured, distance_mm, grid)
    occupancy, body = occupied(distance_mm), occupied(distance_mm - params.air_mm, params.air_mm)
    progress("infill", 0, _STEPS)
    field_ = direction_field(points, offsets, grid, occupancy, params.advection)
    progress("infill", 1, _STEPS)
    density, diameter = captured_density(points, offsets, grid), 2 * float(radii.mean())
    unseen = hidden(density, body, through, diameter, grid, angles_deg, points, np.asarray(captured.evidence, float))
    progress("infill", 2, _STEPS)
    streams, course = _course(points, offsets, diameter, field_, unseen.found, occupancy, grid, params)
    wander = bends(points, offsets)
    links, open_ends = find_links(points, offsets, captured.error_mm, captured.stops, params.links, wander)
    strands = [bridge(points, offsets, captured.error_mm, link, params.step_mm, params.links, wander) for link in links]
    ends = [link.ends for link in links] + [(int(end), -1) for end in open_ends]
    progress("infill", 3, _STEPS)
    ways = ways_on(points, offsets, captured.error_mm, open_ends, params.links, wander)
    continued = _continue(open_ends, ways, points, streams, course, params)
    progress("infill", 4, _STEPS)
    whole = _whole(unseen.missing, strands + continued, streams, course, grid, params)
    progress("infill", 5, _STEPS)
    before = [points[up_to(offsets, end, _PAD)] for end in open_ends] + [np.empty((0, 3))] * len(whole)
    strands += as_smooth_as(points, offsets, continued + whole, before, params.step_mm)
    filled = _gathered(strands, ends + [(-1, -1)] * (len(strands) - len(ends)), points, offsets, radii, params)
    progress("infill", _STEPS, _STEPS)
    return filled


_STEPS = 6


_PAD = 12  # points of a captured curve that tell how a strand is smoothed behind it
_SMOOTHINGS_MM = np.array([0.0, 0.15, 0.3, 0.45, 0.6, 0.8, 1.0, 1.3])
_BEND_MM = 0.5  # over which curvature and its change are told


def as_smooth_as(points: np.ndarray, offsets: np.ndarray, strands: list, before: list, step_mm: float) -> list:
    """The strands, smoothed until they are no rougher than the curves (N, 3) are: the way that neighbours tell is rough, and what a
    captured hair departs from it has that roughness in it too. before: the points that each strand goes on behind, or none."""
    wanted = _roughness([points[a:b] for a, b in pairwise(offsets)], step_mm)
    rough = []
    for sigma in _SMOOTHINGS_MM:
        smooth = [_smoothed(strand, some, sigma / step_mm) for strand, some in zip(strands, before, strict=True)]
        rough.append(_roughness(smooth, step_mm))
        if rough[-1] <= wanted:
            break
    sigma = np.interp(-wanted, -np.minimum.accumulate(rough), _SMOOTHINGS_MM[: len(rough)])
    return [_smoothed(strand, some, sigma / step_mm) for strand, some in zip(strands, before, strict=True)]


def _smoothed(strand, before, sigma):
    """A strand (n, 3) smoothed along itself, sigma in points, as the end of what is before it; its free ends keep their place."""
    if sigma <= 0 or len(strand) < 2:
        return strand
    path = np.concatenate([before, strand])
    reach = min(len(path) - 1, int(np.ceil(4 * sigma)))
    low, high = 2 * path[0] - path[reach:0:-1], 2 * path[-1] - path[-2 : -reach - 2 : -1]
    return gaussian_filter1d(np.concatenate([low, path, high]), sigma, axis=0)[reach + len(before) : reach + len(path)]


def _roughness(curves, step_mm):
    """Mean change of the curvature vector (1/mm²) along curves of points a step apart, over _BEND_MM."""
    k, total, count = max(round(_BEND_MM / step_mm), 1), 0.0, 0
    for curve in curves:
        if len(curve) > 3 * k:
            change = curve[3 * k :] - 3 * curve[2 * k : -k] + 3 * curve[k : -2 * k] - curve[: -3 * k]
            total += float(np.sum(np.linalg.norm(change, axis=1))) / (k * step_mm) ** 3
            count += len(change)
    return total / max(count, 1)


def _checked(captured, distance_mm, grid):
    """Contiguous points (N, 3) float64, offsets (M + 1,) int64, mean radius (M,) of each curve."""
    points, offsets = np.ascontiguousarray(captured.points_mm, np.float64), np.ascontiguousarray(captured.offsets, np.int64)
    if (
        points.ndim != 2
        or points.shape[1:] != (3,)
        or len(offsets) < 2
        or offsets[0] != 0
        or offsets[-1] != len(points)
        or np.any(np.diff(offsets) < 2)
    ):
        raise StrandscopeError(
            f"infill: no captured curves (points {points.shape}, offsets {offsets.shape}); expected some, of 2 points or more each"
        )
    for name, values, shape in (
        ("radius_mm", captured.radius_mm, (len(points),)),
        ("error_mm", captured.error_mm, (len(points),)),
        ("evidence", captured.evidence, (len(points),)),
        ("stops", captured.stops, (len(offsets) - 1, 2)),
    ):
        if np.shape(values) != shape:
            raise StrandscopeError(f"infill: {name} has shape {np.shape(values)}; expected {shape}")
    if not np.any(grid.check(distance_mm, "the distance to the surface") > 0):
        raise StrandscopeError("infill: no voxel lies inside the hair; expected a hull with an inside (look at the blueness threshold)")
    return points, offsets, np.add.reduceat(np.asarray(captured.radius_mm, np.float64), offsets[:-1]) / np.diff(offsets)


# ---- one strand ------------------------------------------------------------------------------------------------------


class _Course(NamedTuple):
    """All that the way of a strand depends on."""

    departures: np.ndarray  # (N, 2) of the captured curves
    offsets: np.ndarray  # (M + 1,)
    cost: np.ndarray  # (nx, ny, nz) float32: -log of how probable it is that a mm of hair there was not found
    origin: np.ndarray  # (3,) mm, of the voxels
    voxel_mm: float
    reach_mm: float  # radius of the captured volume about the axis
    bottom_mm: float
    top_mm: float
    step_mm: float
    apart_mm: float  # distance from a captured curve from which on a strand does not meet it
    meeting_cost: float
    seed: int


_LOOK_BACK = 3  # points before an end at which a departure is compared too
_DONORS = 48  # captured places that are compared
_LEAST_LEFT = 10  # points that a donor has ahead
_FADE_MM = 1.0  # by which what a donor departs differently fades


def _course(points, offsets, diameter, field_, found, occupancy, grid, params) -> tuple[Flow, _Course]:
    streams = flow(points, offsets, params.flow_mm, field_, grid.origin_mm, grid.voxel_mm)
    cost = -np.log(np.maximum(1.0 - found, 1e-3)) / params.hidden_mm
    cost += params.air_cost * np.clip(1.0 - 2.0 * occupancy, 0.0, 1.0)
    low, high = np.asarray(grid.origin_mm), grid.high_mm
    reach = float(min(-low[0], high[0], -low[2], high[2]))
    return streams, _Course(
        departures(streams, points, offsets),
        offsets,
        np.ascontiguousarray(cost, np.float32),
        low.astype(float),
        grid.voxel_mm,
        max(reach, grid.voxel_mm),
        float(low[1]),
        float(high[1]),
        params.step_mm,
        diameter,
        params.meeting_cost,
        params.seed,
    )


@njit(cache=True, nogil=True)
def _donor(course, number, turn, a, b, back_a, back_b, first):
    """A place of a captured curve whose departures are like (a, b) here and (back_a, back_b) some points back, once turned about the way:
    its point, +1 or -1 for the way along its curve, and cosine and sine of the turn. first: nothing is to be matched."""
    best, at, way, cos, sin = np.inf, -1, 1, 1.0, 0.0
    total = course.offsets[-1]
    for n in range(_DONORS):
        point = min(int(uniform(course.seed, number, 8 * (turn * _DONORS + n) + 1) * total), total - 1)
        curve = np.searchsorted(course.offsets, point, side="right") - 1
        step = 1 if uniform(course.seed, number, 8 * (turn * _DONORS + n) + 2) < 0.5 else -1
        ahead = course.offsets[curve + 1] - 1 - point if step > 0 else point - course.offsets[curve]
        behind = point - course.offsets[curve] if step > 0 else course.offsets[curve + 1] - 1 - point
        if ahead < _LEAST_LEFT or behind < _LOOK_BACK:
            continue
        angle = 2 * np.pi * uniform(course.seed, number, 8 * (turn * _DONORS + n) + 3)
        if first:
            return point, step, np.cos(angle), np.sin(angle)
        p, q = course.departures[point]
        p2, q2 = course.departures[point - step * _LOOK_BACK]
        if step < 0:
            p, p2 = -p, -p2  # the way turns round, and one axis across it with it
        cross, dot = p * b - q * a + p2 * back_b - q2 * back_a, p * a + q * b + p2 * back_a + q2 * back_b
        length = np.sqrt(cross * cross + dot * dot)
        c, s = (dot / length, cross / length) if length > 1e-12 else (np.cos(angle), np.sin(angle))
        miss = (c * p - s * q - a) ** 2 + (s * p + c * q - b) ** 2 + (c * p2 - s * q2 - back_a) ** 2 + (s * p2 + c * q2 - back_b) ** 2
        if miss < best:
            best, at, way, cos, sin = miss, point, step, c, s
    return at, way, cos, sin


def _longest(course):
    """Points of a strand at most, so that one that goes round in circles ends."""
    return int(np.ceil(4 * (2 * course.reach_mm + course.top_mm - course.bottom_mm) / course.step_mm))


@njit(cache=True, nogil=True)
def _departure(course, at, way, cos, sin):
    """How the donor departs at a point of its, along its curve (way 1) or against it (-1), turned about the way."""
    p, q = course.departures[at]
    if way < 0:
        p = -p  # the way turns round, and one axis across it with it
    return cos * p - sin * q, sin * p + cos * q


@njit(cache=True, nogil=True)
def _inside(course, x, y, z):
    return x * x + z * z <= course.reach_mm**2 and course.bottom_mm <= y <= course.top_mm


@njit(cache=True, nogil=True)
def _cost_at(course, x, y, z):
    return course.cost[voxel_of(x, y, z, course.origin, course.voxel_mm, course.cost.shape)]


@njit(cache=True, nogil=True)
def _run(streams, course, number, own, x, y, z, tx, ty, tz, known, back, out):
    """Points of a strand on from (x, y, z) that runs as (tx, ty, tz), into out (n, 3): how many, and what they cost.

    known: whether the strand goes on from a curve, which then departs there from its neighbours as its direction tells, and departed by
    ``back`` (2,) some points before, in axes of the way there.
    """
    fx, fy, fz, _ = way_at(streams, x, y, z, tx, ty, tz, own)
    ax, ay, az = across(fx, fy, fz, 1.0, 0.0, 0.0)
    bx, by, bz = fy * az - fz * ay, fz * ax - fx * az, fx * ay - fy * ax
    a, b = tx * ax + ty * ay + tz * az, tx * bx + ty * by + tz * bz
    turns = 0
    at, way, cos, sin = _donor(course, number, turns, a, b, back[0], back[1], not known)
    if at < 0:
        at, way, cos, sin = 0, 1, 0.0, 0.0  # no curve is long enough to tell: none departs
    donor_a, donor_b = _departure(course, at, way, cos, sin)
    off_a, off_b = (a - donor_a, b - donor_b) if known else (0.0, 0.0)
    fade = np.exp(-course.step_mm / _FADE_MM)
    cost = 0.0
    last_a, last_b = np.zeros(_LOOK_BACK + 1), np.zeros(_LOOK_BACK + 1)
    for n in range(len(out)):
        curve = np.searchsorted(course.offsets, at, side="right") - 1
        onward = at + way
        if onward < course.offsets[curve] or onward >= course.offsets[curve + 1]:
            turns += 1
            old = n - 1 - _LOOK_BACK
            was = (last_a[old % (_LOOK_BACK + 1)], last_b[old % (_LOOK_BACK + 1)]) if old >= 0 else (a, b)
            found, way2, cos2, sin2 = _donor(course, number, turns, a, b, was[0], was[1], False)
            if found >= 0:
                at, way, cos, sin = found, way2, cos2, sin2
                donor_a, donor_b = _departure(course, at, way, cos, sin)
                off_a, off_b = a - donor_a, b - donor_b
                onward = at + way
            else:
                onward = at
        at = onward
        donor_a, donor_b = _departure(course, at, way, cos, sin)
        off_a *= fade
        off_b *= fade
        next_a, next_b = donor_a + off_a, donor_b + off_b
        half_a, half_b = 0.5 * (a + next_a), 0.5 * (b + next_b)
        along = np.sqrt(max(1.0 - half_a * half_a - half_b * half_b, 0.04))
        dx, dy, dz = along * fx + half_a * ax + half_b * bx, along * fy + half_a * ay + half_b * by, along * fz + half_a * az + half_b * bz
        mx, my, mz = x + 0.5 * course.step_mm * dx, y + 0.5 * course.step_mm * dy, z + 0.5 * course.step_mm * dz
        fx, fy, fz, square = way_at(streams, mx, my, mz, dx, dy, dz, own)
        ax, ay, az = across(fx, fy, fz, ax, ay, az)
        bx, by, bz = fy * az - fz * ay, fz * ax - fx * az, fx * ay - fy * ax
        dx, dy, dz = along * fx + half_a * ax + half_b * bx, along * fy + half_a * ay + half_b * by, along * fz + half_a * az + half_b * bz
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        x, y, z = x + course.step_mm * dx / length, y + course.step_mm * dy / length, z + course.step_mm * dz / length
        a, b = next_a, next_b
        last_a[n % (_LOOK_BACK + 1)], last_b[n % (_LOOK_BACK + 1)] = a, b
        if not _inside(course, x, y, z):
            return n, cost
        out[n, 0], out[n, 1], out[n, 2] = x, y, z
        cost += course.step_mm * _cost_at(course, x, y, z)
        if square < course.apart_mm**2:
            cost += course.step_mm * course.meeting_cost * (1.0 - np.sqrt(square) / course.apart_mm)
    return len(out), cost


# ---- continuations ---------------------------------------------------------------------------------------------------


def _continue(open_ends, ways, points, streams, course, params):
    """Strands (n, 3) on from each open end; n may be 0."""
    ends = np.asarray(open_ends, np.int64)
    out = np.zeros((len(ends), _longest(course), 3), np.float32)
    sizes = np.zeros(len(ends), np.int64)
    _continue_all(streams, course, ends, ways, points, params.tries, out, sizes)
    return [out[n, : sizes[n]].astype(np.float64) for n in range(len(ends))]


@njit(cache=True, nogil=True, parallel=True)
def _continue_all(streams, course, ends, ways, points, tries, out, sizes):
    for n in prange(len(ends)):
        curve, side = ends[n] // 2, ends[n] % 2
        first, last = course.offsets[curve], course.offsets[curve + 1]
        size = min(last - first, 2 * _LOOK_BACK + 1)
        before = np.empty((size, 3))
        for m in range(size):
            before[m] = points[last - size + m] if side == 1 else points[first + size - 1 - m]
        best = np.inf
        room = np.zeros((out.shape[1], 3))
        for k in range(tries):
            number = ends[n] * tries + k
            size, cost = _go_on(streams, course, number, curve, before, ways[n], room)
            cost += np.log(-np.log(uniform(course.seed, number, 0) + 1e-12) + 1e-12)  # Gumbel's: one is drawn by its probability
            if cost < best:
                best = cost
                sizes[n] = size
                out[n, :size] = room[:size]


@njit(cache=True, nogil=True)
def _go_on(streams, course, number, own, before, way, out):
    """Points of a strand that goes on the unit direction ``way`` (3,) behind the last of ``before`` (k, 3), into out (n, 3): how many, and
    what they cost."""
    last = len(before) - 1
    reach = min(_LOOK_BACK, last)
    tip, behind, further = before[last], before[last - reach], before[max(last - 2 * reach, 0)]
    tx, ty, tz = way
    back = np.zeros(2)
    bx, by, bz = behind[0] - further[0], behind[1] - further[1], behind[2] - further[2]
    length = np.sqrt(bx * bx + by * by + bz * bz)
    if length > 1e-9:
        fx, fy, fz, _ = way_at(streams, behind[0], behind[1], behind[2], tx, ty, tz, own)
        ax, ay, az = across(fx, fy, fz, 1.0, 0.0, 0.0)
        back[0] = (bx * ax + by * ay + bz * az) / length
        back[1] = (bx * (fy * az - fz * ay) + by * (fz * ax - fx * az) + bz * (fx * ay - fy * ax)) / length
    return _run(streams, course, number, own, tip[0], tip[1], tip[2], tx, ty, tz, True, back, out)


# ---- whole fibers ----------------------------------------------------------------------------------------------------

_PARTS = 16  # in which whole fibers are added; each sees what those before have filled


def _whole(missing, strands, streams, course, grid, params):
    """Strands (n, 3) for whole fibers that were not found, from bound to bound of the volume, where hair is still missing."""
    sigma, whole, by_count = params.density_mm / grid.voxel_mm, [], params.count is not None
    left = missing - gaussian_filter(_density_of(strands, grid), sigma, mode="constant")
    for part in range(_PARTS):
        wanted = ((params.count - len(whole)) if by_count else float(left.sum()) * grid.voxel_mm**3) / (_PARTS - part)
        if wanted <= 0:
            break
        cells = np.flatnonzero(left.ravel() > 0) if np.any(left > 0) else np.arange(left.size)
        weights = np.cumsum(np.maximum(left.ravel()[cells], 1e-6), dtype=np.float64)
        more = _some_whole(wanted, by_count, len(whole), cells, weights, streams, course, grid, params)
        whole += more
        left = left - gaussian_filter(_density_of(more, grid), sigma, mode="constant")
    return whole


def _density_of(strands, grid):
    sizes = [len(strand) for strand in strands]
    if not sum(sizes):
        return np.zeros(grid.shape, np.float32)
    return captured_density(np.concatenate(strands), np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64), grid)


def _some_whole(wanted, by_count, before, cells, weights, streams, course, grid, params):
    """Whole fibers until ``wanted`` of them, or of mm, are there."""
    whole, done = [], 0.0
    guess = int(np.ceil(wanted)) if by_count else int(np.ceil(wanted / max(course.top_mm - course.bottom_mm, 1e-6)))
    for turn in range(8):
        size = max(guess - len(whole), 1)
        first = _WHOLE + (before + len(whole)) * params.whole_tries + turn * 1_000_003
        out, sizes = np.zeros((size, 2 * _longest(course), 3)), np.zeros(size, np.int64)
        _try_whole(streams, course, first, cells, weights, np.asarray(grid.shape), params.whole_tries, out, sizes)
        for strand, length in zip(out, sizes, strict=True):
            if length * course.step_mm < params.least_new_mm:
                continue
            gain = 1.0 if by_count else length * course.step_mm
            if done + (0.5 * gain if not by_count else 0.0) >= wanted:
                return whole
            whole.append(strand[:length].copy())
            done += gain
    return whole


_WHOLE = 1_000_000_007  # from this number on, draws are those of whole fibers


@njit(cache=True, nogil=True, parallel=True)
def _try_whole(streams, course, first, cells, weights, shape, tries, out, sizes):
    for n in prange(len(out)):
        best = np.inf
        room = np.zeros((out.shape[1], 3))
        nothing = np.zeros(2)
        for k in range(tries):
            number = first + n * tries + k
            index = min(np.searchsorted(weights, uniform(course.seed, number, 11) * weights[-1], side="right"), len(cells) - 1)
            cell = cells[index]
            i, j, k3 = cell // (shape[1] * shape[2]), cell // shape[2] % shape[1], cell % shape[2]
            x = course.origin[0] + (i + uniform(course.seed, number, 12)) * course.voxel_mm
            y = course.origin[1] + (j + uniform(course.seed, number, 13)) * course.voxel_mm
            z = course.origin[2] + (k3 + uniform(course.seed, number, 14)) * course.voxel_mm
            if not _inside(course, x, y, z):
                continue
            tx, ty, tz = _field_at(streams, x, y, z)
            half = out.shape[1] // 2
            ahead, cost = _run(streams, course, number, -1, x, y, z, tx, ty, tz, False, nothing, room[:half])
            if ahead < 2 * _LOOK_BACK + 1:
                continue
            before = np.empty((2 * _LOOK_BACK + 1, 3))
            before[2 * _LOOK_BACK, 0], before[2 * _LOOK_BACK, 1], before[2 * _LOOK_BACK, 2] = x, y, z
            for m in range(2 * _LOOK_BACK):
                before[m] = room[2 * _LOOK_BACK - 1 - m]
            way = before[2 * _LOOK_BACK] - before[_LOOK_BACK]
            way /= np.sqrt(np.sum(way * way))
            behind, more = _go_on(streams, course, number + 500_000_003, -1, before, way, room[half:])
            size = ahead + behind + 1
            cost = (cost + more) / (size * course.step_mm) * (course.top_mm - course.bottom_mm)
            cost += np.log(-np.log(uniform(course.seed, number, 0) + 1e-12) + 1e-12)
            if cost < best and size > 1:
                best = cost
                sizes[n] = size
                for m in range(behind):
                    out[n, m] = room[half + behind - 1 - m]
                out[n, behind, 0], out[n, behind, 1], out[n, behind, 2] = x, y, z
                for m in range(ahead):
                    out[n, behind + 1 + m] = room[m]


@njit(cache=True, nogil=True)
def _field_at(streams, x, y, z):
    vector = streams.field[voxel_of(x, y, z, streams.origin, streams.voxel_mm, streams.field.shape)]
    length = np.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
    if length < 1e-6:
        return 0.0, -1.0, 0.0
    return vector[0] / length, vector[1] / length, vector[2] / length


# ---- together --------------------------------------------------------------------------------------------------------


def _gathered(strands, from_ends, points, offsets, radii, params) -> Infill:
    """The strands pushed apart, without those of fewer than two points, and all joins: of ends that a strand links, or that meet."""
    count = len(offsets) - 1
    meeting = [ends for strand, ends in zip(strands, from_ends, strict=True) if len(strand) < 2 and min(ends) >= 0]
    keep = [k for k, strand in enumerate(strands) if len(strand) >= 2]
    strands, from_ends = [strands[k] for k in keep], [from_ends[k] for k in keep]
    radius = np.array([_radius(ends, radii, params.seed, k) for k, ends in enumerate(from_ends)])
    sizes = np.array([len(strand) for strand in strands], np.int64)
    starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    together = np.concatenate(strands) if strands else np.empty((0, 3))
    joined = [(end, 2 * (count + k) + side) for k, ends in enumerate(from_ends) for side, end in enumerate(ends) if end >= 0]
    joins = np.array(joined + meeting, np.int64).reshape(-1, 2)
    fiber = fibers_of(joins, count + len(strands))
    together = _pushed(together, starts, radius, fiber, from_ends, points, offsets, radii, params)
    return Infill(together.astype(np.float32), starts, np.repeat(radius, sizes).astype(np.float32), joins)


def _pushed(together, starts, radius, fiber, from_ends, points, offsets, radii, params):
    """The points of the strands after pushing apart; the ends that they go on from are held."""
    count = len(radii)
    held = np.array([[end >= 0 for end in ends] for ends in from_ends], bool).reshape(-1, 2)
    tips = [[points[up_to(offsets, end, 1)] if end >= 0 else np.empty((0, 3)) for end in ends] for ends in from_ends]
    pieces = []
    for k, (first, last) in enumerate(tips):
        pieces += [first, together[starts[k] : starts[k + 1]], last]
    sizes = np.diff(starts) + held.sum(axis=1)
    moving = Tubes(np.concatenate(pieces or [together]), np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64), radius, fiber[count:])
    after = push_apart(moving, Tubes(points, offsets, radii, fiber[:count]), held, params.apart)
    ours = np.ones(len(after), bool)
    ours[moving.offsets[:-1][held[:, 0]]] = ours[moving.offsets[1:][held[:, 1]] - 1] = False
    return after[ours]


def _radius(ends, radii, seed, number):
    """That of the fiber which it belongs to, else of a captured one drawn at random."""
    known = [radii[end // 2] for end in ends if end >= 0]
    return float(np.mean(known)) if known else float(radii[min(int(uniform(seed, number, 5) * len(radii)), len(radii) - 1)])
