"""Hair with known centrelines: a lock of straight, wavy or curled fibers in which no two run through each other.

Fibers hang along y, in clumps that follow a guide, with some flyaways. Each is a uniform cubic B-spline, so that it is
smooth whatever is done to its control points; where fibers overlap, the control points are pushed apart.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from .errors import StrandscopeError

STYLES = ("straight", "wavy", "curls")


@dataclass(frozen=True)
class GroomParams:
    """What lock to make. Lengths in mm."""

    style: str = "straight"  # one of STYLES
    fibers: int = 340
    lock_radius_mm: float = 4.6  # most fibers stay within it
    half_height_mm: float = 10.0  # fibers run from y = -half_height to +half_height
    diameter_mm: tuple[float, float] = (0.06, 0.10)  # thinnest and thickest fiber
    clump_fibers: tuple[int, int] = (4, 30)  # fibers of the smallest and of the largest clump
    flyaway_share: float = 0.03  # of fibers that leave the lock
    clearance_mm: float = 0.006  # air that is left between fibers that were pushed apart
    knot_mm: float = 1.0  # between the control points of a fiber; bounds its curvature
    spacing_mm: float = 0.1  # between points of the result, at most
    chord_error_mm: float = 0.0008  # a chord of the result stays this close to the smooth curve
    rounds: int = 4000  # of pushing apart, at most
    overlap_mm: float = 0.0  # that may be left between two fibers; the last of it takes the longest


@dataclass(frozen=True)
class Groom:
    """M fibers of N points. Fiber i is ``points_mm[offsets[i]:offsets[i + 1]]``, a circular cylinder along them."""

    points_mm: np.ndarray  # (N, 3) float64, object frame, along the centrelines
    offsets: np.ndarray  # (M + 1,) int64
    radii_mm: np.ndarray  # (M,) float64

    def __len__(self) -> int:
        return len(self.radii_mm)

    def __getitem__(self, i: int) -> np.ndarray:
        """Points (n, 3) of fiber i, mm."""
        return self.points_mm[self.offsets[i] : self.offsets[i + 1]]


def groom(params: GroomParams, rng: np.random.Generator) -> Groom:
    """A lock of hair; the same parameters and generator give the same lock.

    Raises StrandscopeError for parameters that no lock has, and where so many fibers do not fit.
    """
    _check(params)
    low, high = params.diameter_mm
    radii = rng.uniform(low, high, params.fibers) / 2
    controls = _controls(params, rng)
    controls = _push_apart(controls, radii, params)
    points, offsets = _sample(controls, params)
    return Groom(points, offsets, radii)


def clearance(groom: Groom) -> float:
    """The smallest distance between the surfaces of two fibers, mm, at most 0.1; negative where they overlap."""
    first, second = _near_segments(groom.points_mm, groom.offsets, 2 * groom.radii_mm.max() + 0.1)
    fiber = np.repeat(np.arange(len(groom)), np.diff(groom.offsets))
    distance = _segment_distances(groom.points_mm, first, second) - groom.radii_mm[fiber[first]] - groom.radii_mm[fiber[second]]
    return float(min(distance.min(initial=0.1), 0.1))


def curvature(points_mm: np.ndarray) -> np.ndarray:
    """Curvature (n - 2,) 1/mm at the inner points of a curve (n, 3) mm: that of the circle through three neighbours."""
    a, b = np.diff(points_mm[:-1], axis=0), np.diff(points_mm[1:], axis=0)
    area = np.linalg.norm(np.cross(a, b), axis=1)
    return 2 * area / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1) * np.linalg.norm(a + b, axis=1))


def _check(params: GroomParams) -> None:
    low, high = params.diameter_mm
    if params.style not in STYLES:
        raise StrandscopeError(f"style is {params.style!r}; expected one of {', '.join(STYLES)}")
    if params.fibers < 1:
        raise StrandscopeError(f"fibers is {params.fibers}; expected 1 or more")
    if not 0 < low <= high:
        raise StrandscopeError(f"diameter_mm is {low:g}, {high:g}; expected the smaller one first, both more than 0")
    room = 0.5 * np.pi * params.lock_radius_mm**2 / (np.pi * (high / 2 + params.clearance_mm) ** 2)
    if params.fibers > room:
        raise StrandscopeError(f"fibers is {params.fibers}; a lock of radius {params.lock_radius_mm:g} mm has room for {int(room)}")


# ---- the shape, before fibers are pushed apart -----------------------------------------------------------------------


def _controls(params: GroomParams, rng) -> np.ndarray:
    """Control points (M, n, 3) of all fibers, mm; fibers may overlap."""
    count = int(np.ceil(2 * params.half_height_mm / params.knot_mm)) + 4
    y = (np.arange(count) - (count - 1) / 2) * params.knot_mm
    members = _clumps(params, rng)
    loose = rng.random(params.fibers) < params.flyaway_share
    curl = _curl(params, rng)
    sizes = np.bincount(members)
    centres = _centres(sizes, params, rng)
    guides = np.stack([centre + _guide(y, curl, params, rng) for centre in centres])  # (clumps, n, 2) of x, z
    spread = np.stack([_spread(y, size, params, rng) for size in sizes])  # (clumps, n) mm
    place = _disc(params.fibers, rng)  # of each fiber in its clump, in radii of the clump
    twist = np.stack([_wander(y, 0.3, (8, 30), rng)[:, 0] for _ in guides])  # radians: a clump turns about its guide
    xz = np.empty((params.fibers, count, 2))
    for i, clump in enumerate(members):
        angle = twist[clump]
        turned = np.stack([place[i, 0] * np.cos(angle) - place[i, 1] * np.sin(angle), place[i, 0] * np.sin(angle) + place[i, 1] * np.cos(angle)], -1)
        xz[i] = guides[clump] + spread[clump][:, None] * turned + _wander(y, 0.06, (3, 14), rng)
        if loose[i]:
            xz[i] += _leaving(y, params, rng)
    return np.stack([xz[..., 0], np.broadcast_to(y, xz.shape[:2]), xz[..., 1]], axis=-1)


def _clumps(params: GroomParams, rng) -> np.ndarray:
    """The clump (M,) of each fiber; sizes between those of the parameters, small ones more often."""
    low, high = params.clump_fibers
    members = []
    while len(members) < params.fibers:
        size = round(low * (high / low) ** rng.random())
        members += [members[-1] + 1 if members else 0] * size
    return np.array(members[: params.fibers])


def _centres(sizes: np.ndarray, params: GroomParams, rng) -> np.ndarray:
    """Where the clumps (C,) hang in the lock, (C, 2) mm: a sunflower of them, in disorder, that leaves room at the rim."""
    order = rng.permutation(len(sizes))
    around = 2 * np.pi * rng.random() + order * np.pi * (3 - np.sqrt(5))
    room = params.lock_radius_mm * np.sqrt(sizes / params.fibers)
    radius = np.sqrt((order + rng.random(len(sizes))) / len(sizes)) * np.maximum(params.lock_radius_mm - 0.7 * room, 0)
    radius *= {"straight": 1.0, "wavy": 0.9, "curls": 0.65}[params.style]  # waves and ringlets reach out by themselves
    return np.stack([radius * np.cos(around), radius * np.sin(around)], axis=-1)


def _disc(count: int, rng) -> np.ndarray:
    """Points (count, 2) spread evenly at random over the unit disc."""
    radius, angle = np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


def _wander(y: np.ndarray, slope: float, wavelengths_mm: tuple[float, float], rng) -> np.ndarray:
    """A smooth random path (n, 2) over heights y (n,): waves of random length whose slope has this rms in x and in z."""
    low, high = wavelengths_mm
    length = low * (high / low) ** rng.random((4, 1, 2))
    phase = 2 * np.pi * rng.random((4, 1, 2))
    amplitude = slope * length / (2 * np.pi) * np.sqrt(2 / 4)
    return np.sum(amplitude * np.sin(2 * np.pi * y[:, None] / length + phase), axis=0)


def _spread(y: np.ndarray, size: int, params: GroomParams, rng) -> np.ndarray:
    """Radius (n,) mm of a clump of ``size`` fibers along y: closed here, opened there."""
    packed = params.diameter_mm[1] * np.sqrt(size)
    room = params.lock_radius_mm * np.sqrt(size / params.fibers)
    shut, wide = max(0.6 * room, 1.1 * packed), max(1.2 * room, 1.6 * packed)
    opening = 0.5 + 0.5 * np.sin(2 * np.pi * (y / rng.uniform(12, 40) + rng.random()))
    return shut + (wide - shut) * opening


@dataclass(frozen=True)
class _Curl:
    """What the clumps of a lock that was waved or curled have in common; neighbours nest as they lay on one iron."""

    radius_mm: float
    turn_mm: float  # height of one wave or turn
    phase: float
    towards: float  # the direction of a wave, radians
    turning: int  # +1 or -1, the hand of a ringlet


def _curl(params: GroomParams, rng) -> _Curl:
    wavy = params.style == "wavy"
    radius = min(0.75, 0.3 * params.lock_radius_mm) if wavy else np.clip(0.45 * params.lock_radius_mm, 0.8, 4.0)
    turn = rng.uniform(8, 11) if wavy else radius * rng.uniform(5.0, 6.5)
    return _Curl(radius, turn, 2 * np.pi * rng.random(), 2 * np.pi * rng.random(), int(rng.choice([-1, 1])))


def _guide(y: np.ndarray, curl: _Curl, params: GroomParams, rng) -> np.ndarray:
    """x, z (n, 2) mm of a clump's guide about its centre, over the heights y (n,)."""
    if params.style == "straight":
        return _wander(y, 0.06, (10, 40), rng)
    size = curl.radius_mm * rng.uniform(0.8, 1.2)
    phase = 2 * np.pi * y / (curl.turn_mm * rng.uniform(0.95, 1.05)) + curl.phase + rng.normal(0, 0.4)
    phase = phase + _wander(y, 0.06, (8, 20), rng)[:, 0]
    if params.style == "wavy":
        wave = size * np.stack([np.cos(curl.towards) * np.cos(phase), np.sin(curl.towards) * np.cos(phase + 0.6)], -1)
        return wave + _wander(y, 0.05, (10, 30), rng)
    ringlet = size * np.stack([np.cos(phase), curl.turning * np.sin(phase)], -1)
    return ringlet + _wander(y, 0.04, (10, 30), rng)


def _leaving(y: np.ndarray, params: GroomParams, rng) -> np.ndarray:
    """What is added (n, 2) mm to a fiber that leaves the lock somewhere, and may come back."""
    towards = 2 * np.pi * rng.random()
    far = params.lock_radius_mm * rng.uniform(0.4, 0.9)
    width = rng.uniform(0.5, 1.0) * max(params.half_height_mm, 2 * far)
    bump = far / (1 + ((y - rng.uniform(-0.5, 0.5) * params.half_height_mm) / width * 2) ** 2)
    return bump[:, None] * np.array([np.cos(towards), np.sin(towards)]) + _wander(y, 0.12, (4, 16), rng)


# ---- B-splines -------------------------------------------------------------------------------------------------------


def _weights(t: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """First control point (k,) and four weights (k, 4) of a uniform cubic B-spline of ``count`` controls; t 0 … count - 3."""
    first = np.minimum(t.astype(np.int64), count - 4)
    f = t - first
    return first, np.stack([(1 - f) ** 3, 3 * f**3 - 6 * f**2 + 4, -3 * f**3 + 3 * f**2 + 3 * f + 1, f**3], axis=-1) / 6


def _evaluate(controls: np.ndarray, first: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Points (M, k, 3) of M splines (M, n, 3) at k places."""
    return sum(weights[:, i, None] * controls[:, first + i] for i in range(4))


def _sample(controls: np.ndarray, params: GroomParams) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) and offsets (M + 1,) along the splines, dense enough for ``spacing_mm`` and ``chord_error_mm``."""
    count = controls.shape[1]
    second = np.linalg.norm(np.diff(controls, 2, axis=1), axis=2).max(axis=1)  # |p''| of a spline is at most this
    speed = np.linalg.norm(np.diff(controls, axis=1), axis=2).max(axis=1)
    steps = np.ceil((count - 3) * np.maximum(speed / params.spacing_mm, np.sqrt(second / (8 * params.chord_error_mm)))).astype(int)
    curves = [_evaluate(c[None], *_weights(np.linspace(0, count - 3, n + 1), count))[0] for c, n in zip(controls, steps, strict=True)]
    return np.concatenate(curves), np.concatenate([[0], np.cumsum(steps + 1)]).astype(np.int64)


# ---- pushing apart ---------------------------------------------------------------------------------------------------


def _push_apart(controls: np.ndarray, radii: np.ndarray, params: GroomParams) -> np.ndarray:
    """Control points (M, n, 3) near the given ones for which all fibers keep ``clearance_mm``.

    Each overlap moves the control points around it by their share in the curve; in the first rounds the displacement is
    smoothed along the fiber, so that fibers make way over a length and do not bend around each other.
    """
    fibers, count = controls.shape[:2]
    places = np.linspace(0, count - 3, (count - 3) * _pieces(controls, params) + 1)
    first, weights = _weights(places, count)
    offsets = np.arange(fibers + 1) * len(places)
    enough = params.clearance_mm + params.overlap_mm if params.overlap_mm > 0 else 0.5 * params.clearance_mm
    start, built, skin = controls, None, 0.06
    for turn in range(params.rounds):
        points = _evaluate(controls, first, weights).reshape(-1, 3)
        if built is None or np.abs(points - built).max() > skin / 4:
            near = _near_segments(points, offsets, 2 * radii.max() + params.clearance_mm + skin)
            built = points
        moves, worst = _moves(points, *near, len(places), radii, params.clearance_mm, first, weights, fibers, count)
        if worst <= enough:
            return controls
        controls = controls + moves
        if turn < 100:
            shift = controls - start
            shift[:, 1:-1] += 0.1 * (1 - turn / 100) * (shift[:, 2:] - 2 * shift[:, 1:-1] + shift[:, :-2])
            controls = start + shift
    if worst <= 0.8 * params.clearance_mm:
        return controls
    raise StrandscopeError(
        f"fibers is {fibers}: after {params.rounds} rounds of pushing apart, two still overlap by {worst - params.clearance_mm:.3f} mm; "
        f"expected fewer fibers, or a lock wider than {params.lock_radius_mm:g} mm"
    )


def _pieces(controls: np.ndarray, params: GroomParams) -> int:
    """Segments a knot while fibers are pushed apart: short enough that chords stray little, were all as bent as the most bent."""
    second = np.linalg.norm(np.diff(controls, 2, axis=1), axis=2).max()
    return int(np.ceil(max(params.knot_mm / 0.2, np.sqrt(second / (8 * 0.25 * params.clearance_mm)))))


def _near_segments(points: np.ndarray, offsets: np.ndarray, reach_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of segments (k,), (k,), named by their first points, that are closer than ``reach_mm`` to each other.

    Of one fiber, only pairs that are far along it count.
    """
    start = np.setdiff1d(np.arange(len(points) - 1), offsets[1:-1] - 1)
    middle = (points[start] + points[start + 1]) / 2
    longest = np.linalg.norm(points[start + 1] - points[start], axis=1).max()
    pairs = cKDTree(middle).query_pairs(reach_mm + longest, output_type="ndarray")
    first, second = start[pairs].T if len(pairs) else (np.zeros(0, np.int64),) * 2
    fiber = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    far = (fiber[first] != fiber[second]) | (np.abs(first - second) * longest > 4.0)
    first, second = first[far], second[far]
    close = _segment_distances(points, first, second) < reach_mm
    first, second = first[close], second[close]
    order = np.lexsort((second, first))  # the tree's order is its own affair
    return first[order], second[order]


@njit(cache=True, nogil=True)
def closest(points, i, j):
    """Places s, t in 0 … 1 on the segments i and j where they come closest, and the gap (x, y, z) from j to i there."""
    dx, dy, dz = points[i + 1, 0] - points[i, 0], points[i + 1, 1] - points[i, 1], points[i + 1, 2] - points[i, 2]
    ex, ey, ez = points[j + 1, 0] - points[j, 0], points[j + 1, 1] - points[j, 1], points[j + 1, 2] - points[j, 2]
    rx, ry, rz = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2]
    a, b, c = dx * dx + dy * dy + dz * dz, dx * ex + dy * ey + dz * ez, dx * rx + dy * ry + dz * rz
    f, g = ex * ex + ey * ey + ez * ez, ex * rx + ey * ry + ez * rz
    det = a * f - b * b
    s = min(max((b * g - c * f) / det, 0.0), 1.0) if det > 1e-12 * a * f else 0.5
    t = min(max((b * s + g) / f, 0.0), 1.0)
    s = min(max((b * t - c) / a, 0.0), 1.0)
    return s, t, rx + s * dx - t * ex, ry + s * dy - t * ey, rz + s * dz - t * ez


@njit(cache=True, nogil=True)
def _segment_distances(points, first, second):
    """Distance (k,) mm between pairs of segments."""
    distance = np.empty(len(first))
    for k in range(len(first)):
        _, _, x, y, z = closest(points, first[k], second[k])
        distance[k] = np.sqrt(x * x + y * y + z * z)
    return distance


@njit(cache=True, nogil=True)
def _moves(points, first, second, per_fiber, radii, clearance, knot, weights, fibers, count):
    """Moves (M, n, 3) of the control points that part the overlapping pairs, and the worst overlap in mm."""
    moves, share = np.zeros((fibers, count, 3)), np.zeros((fibers, count))
    worst = 0.0
    for k in range(len(first)):
        i, j = first[k], second[k]
        a, b = i // per_fiber, j // per_fiber
        s, t, x, y, z = closest(points, i, j)
        square, needed = x * x + y * y + z * z, radii[a] + radii[b] + clearance
        if square >= needed * needed:
            continue
        distance = np.sqrt(square)
        missing = needed - distance
        worst = max(worst, missing)
        if distance < 1e-6:  # the centrelines meet: any way out will do
            x, y, z, distance = 1.0, 0.0, 0.5, 1.118
        push = 0.5 * missing / distance
        for side in range(2):
            fiber, place = (a, i % per_fiber + int(s > 0.5)) if side == 0 else (b, j % per_fiber + int(t > 0.5))
            signed = push if side == 0 else -push
            for c in range(4):
                w = weights[place, c]
                n = knot[place] + c
                moves[fiber, n, 0] += w * signed * x
                moves[fiber, n, 1] += w * signed * y
                moves[fiber, n, 2] += w * signed * z
                share[fiber, n] += w
    for a in range(fibers):
        for c in range(count):
            if share[a, c] > 0:
                for axis in range(3):
                    moves[a, c, axis] *= 1.5 / max(share[a, c], 0.66)
    return moves, worst
