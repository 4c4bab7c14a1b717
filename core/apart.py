"""Strands that no longer run through each other or through captured hair: pushed apart over a length, so that they stay smooth.

Captured curves stand still. Where two segments are nearer than their radii allow, a strand is pushed by what is missing (by
half of it, if both can move), and makes way with a part of its length about the place, less and less towards an end that is held.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit, prange

from .groom import closest

_HELD = 0.3  # of a free point's way, below which a point near an end that is held is not pushed


@dataclass(frozen=True)
class ApartParams:
    """Parameters of the pushing apart. Lengths in mm."""

    rounds: int = 300  # at most
    clearance_mm: float = 0.003  # air between fibers that were pushed apart
    along_mm: float = 0.6  # standard deviation of the length of strand that makes way
    smooth_rounds: int = 200  # in which what was pushed is smoothed along the strand, less and less
    smoothing: float = 0.3  # share by which a point's way is drawn to the mean of its neighbours' at first
    held_mm: float = 0.2  # from an end that is held, a strand can make way no sooner than after about this
    settled_mm: float = 2e-5  # a round that moves no point by more is the last
    skin_mm: float = 0.1  # neighbours are looked for this much farther off, so that they serve for some rounds


class Tubes(NamedTuple):
    """Curves with a radius each: segment n lies between points n and n + 1 where these are of one curve."""

    points: np.ndarray  # (N, 3) float64 mm
    offsets: np.ndarray  # (M + 1,) int64
    radii: np.ndarray  # (M,) float64 mm
    fibers: np.ndarray  # (M,) int64: curves of one fiber do not push each other


def push_apart(moving: Tubes, still: Tubes, held: np.ndarray, params: ApartParams | None = None) -> np.ndarray:
    """Points (N, 3) of the moving tubes after they have made way for each other and for those that stand still.

    held (M, 2) bool: which ends of the moving ones keep their place. The same input gives the same points, whatever the number of
    threads. Where there is no room, overlaps are left.
    """
    params = params or ApartParams()
    if len(moving.offsets) < 2:
        return moving.points.copy()
    points = moving.points.copy()
    yields = _yielding(points, moving.offsets, np.asarray(held, bool), params.held_mm)
    step = float(np.median(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    kernel = _kernel(params.along_mm / max(step, 1e-6))
    size, radii = len(points), np.concatenate([np.repeat(t.radii, np.diff(t.offsets)) for t in (moving, still)])
    first_of = moving.offsets[:-1] - np.arange(len(moving.offsets) - 1)
    built, start = None, points.copy()
    for turn in range(params.rounds):
        if built is None or np.abs(points - built).max() > 0.25 * params.skin_mm:
            built = points.copy()
            near, starts, first = _neighbourhood(points, moving, still, params)
            pushes = np.empty((len(first), 8))
        _pushes(np.concatenate([points, still.points]), radii, near, starts, first, size, params.clearance_mm, pushes)
        moved = _make_way(points, moving.offsets, first_of, pushes, kernel, yields)
        if turn < params.smooth_rounds:
            _smooth(points, start, moving.offsets, yields, params.smoothing * (1.0 - turn / params.smooth_rounds))
        elif moved < params.settled_mm:
            break
    return points


def _yielding(points, offsets, held, held_mm):
    """How freely each point (N,) can move: 0 at a held end, 1 far from it."""
    free = np.ones(len(points))
    for c, (one, other) in enumerate(held):
        if one or other:
            part = slice(offsets[c], offsets[c + 1])
            arc = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(points[part], axis=0), axis=1))]
            for is_held, away in ((one, arc), (other, arc[-1] - arc)):
                if is_held:
                    free[part] *= 1.0 - np.exp(-(away**2) / (2 * held_mm**2))
    return free


def _kernel(sigma):
    reach = int(np.ceil(3 * sigma))
    return np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(sigma, 1e-6)) ** 2)  # 1 in the middle: one push moves by all that is missing


def _neighbourhood(points, moving, still, params):
    """For each segment of the moving tubes those of all tubes that are near: (K,) their first points, those of the still tubes counted on
    behind the moving ones; starts (S + 1,); first points (S,) of the segments."""
    every = np.concatenate([points, still.points])
    offsets = np.concatenate([moving.offsets, moving.offsets[-1] + still.offsets[1:]])
    radii, fibers = np.concatenate([moving.radii, still.radii]), np.concatenate([moving.fibers, still.fibers])
    curve = np.repeat(np.arange(len(radii)), np.diff(offsets))
    first = np.flatnonzero(curve[:-1] == curve[1:])
    middle = 0.5 * (every[first] + every[first + 1])
    longest = float(np.linalg.norm(every[first + 1] - every[first], axis=1).max())
    reach = 2 * float(radii.max()) + params.clearance_mm + params.skin_mm
    cell = reach + longest
    low = middle.min(axis=0)
    shape = (np.floor((middle.max(axis=0) - low) / cell) + 1).astype(np.int64)
    cells = np.ravel_multi_index(tuple(np.floor((middle - low) / cell).astype(np.int64).T), tuple(shape))
    order = np.argsort(cells, kind="stable")
    begins = np.searchsorted(cells[order], np.arange(np.prod(shape) + 1))
    ours = first[first < len(points)]
    counts = np.zeros(len(ours) + 1, np.int64)
    nothing = np.empty(0, np.int64)
    _near(every, middle[: len(ours)], ours, first[order], middle[order], begins, low, cell, shape, fibers[curve], reach, counts, nothing)
    starts = np.cumsum(counts)
    near = np.empty(starts[-1], np.int64)
    _near(every, middle[: len(ours)], ours, first[order], middle[order], begins, low, cell, shape, fibers[curve], reach, starts, near)
    return near, starts, ours


@njit(cache=True, nogil=True, parallel=True)
def _near(points, middle, ours, firsts, middles, begins, low, cell, shape, fibers, reach, starts, near):
    """Count the near segments of each of ours into starts[1:], or, with room in near, note them from starts on."""
    nx, ny, nz = shape
    for n in prange(len(ours)):
        x, y, z = middle[n]
        i, j, k = int((x - low[0]) / cell), int((y - low[1]) / cell), int((z - low[2]) / cell)
        half = 0.5 * np.sqrt(np.sum((points[ours[n] + 1] - points[ours[n]]) ** 2))
        found = 0
        for a in range(max(i - 1, 0), min(i + 2, nx)):
            for b in range(max(j - 1, 0), min(j + 2, ny)):
                row = (a * ny + b) * nz
                for m in range(begins[row + max(k - 1, 0)], begins[row + min(k + 2, nz)]):
                    other = firsts[m]
                    if fibers[other] == fibers[ours[n]]:
                        continue
                    square = (middles[m, 0] - x) ** 2 + (middles[m, 1] - y) ** 2 + (middles[m, 2] - z) ** 2
                    far = reach + half + 0.5 * np.sqrt(np.sum((points[other + 1] - points[other]) ** 2))
                    if square > far * far:
                        continue
                    if len(near):
                        near[starts[n] + found] = other
                    found += 1
        if not len(near):
            starts[n + 1] = found


@njit(cache=True, nogil=True, parallel=True)
def _pushes(points, radii, near, starts, first, ours, clearance, out):
    """For each of our segments the pushes on its two points, (n, 8): sum and weight of each. ``ours``: how many of the points can move."""
    for n in prange(len(first)):
        i = first[n]
        out[n] = 0.0
        for m in range(starts[n], starts[n + 1]):
            j = near[m]
            s, _, x, y, z = closest(points, i, j)
            square, needed = x * x + y * y + z * z, radii[i] + radii[j] + clearance
            if square >= needed * needed:
                continue
            if square < 1e-12:  # they meet: any way across both parts them, the same for both but for its sign
                x, y, z = _across_both(points, min(i, j), max(i, j))
                turn = 1e-6 if i < j else -1e-6
                x, y, z, square = turn * x, turn * y, turn * z, 1e-12
            distance = np.sqrt(square)
            push = (needed - distance) / distance * (0.5 if j < ours else 1.0)
            for at, share in ((0, 1.0 - s), (4, s)):
                out[n, at] += share * push * x
                out[n, at + 1] += share * push * y
                out[n, at + 2] += share * push * z
                out[n, at + 3] += share


@njit(cache=True, nogil=True)
def _across_both(points, i, j):
    """A unit vector at right angles to segments i and j."""
    a, b = points[i + 1] - points[i], points[j + 1] - points[j]
    c = np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
    if np.sum(c * c) < 1e-8 * np.sum(a * a) * np.sum(b * b):  # parallel
        c = np.array([-a[1], a[0], 0.0]) if abs(a[2]) < 0.9 * np.sqrt(np.sum(a * a)) else np.array([0.0, -a[2], a[1]])
    c /= np.sqrt(np.sum(c * c))
    return c[0], c[1], c[2]


@njit(cache=True, nogil=True, parallel=True)
def _make_way(points, offsets, first_of, pushes, kernel, free):
    """Move the points by the mean push on each, spread along its curve; returns the largest move. first_of (M,): a curve's first segment."""
    reach = len(kernel) // 2
    largest = np.zeros(len(offsets) - 1)
    for c in prange(len(offsets) - 1):
        low, size = offsets[c], offsets[c + 1] - offsets[c]
        push, pushed = np.zeros((size, 3)), np.zeros(size)
        some = False
        for n in range(size):
            if free[low + n] < _HELD:  # what it could make way by is too little: its neighbours would be pushed for ever
                continue
            weight = 0.0
            for side in range(2):
                segment = n - side
                if segment < 0 or segment >= size - 1:
                    continue
                told = pushes[first_of[c] + segment]
                weight += told[4 * side + 3]
                for a in range(3):
                    push[n, a] += told[4 * side + a]
            if weight > 0.0:
                some = True
                pushed[n] = min(weight, 1.0)
                for a in range(3):
                    push[n, a] /= max(weight, 1.0)
        if not some:
            continue
        for n in range(size):
            x, y, z, weight = 0.0, 0.0, 0.0, 0.0
            for m in range(max(n - reach, 0), min(n + reach + 1, size)):
                share = kernel[m - n + reach]
                x += share * push[m, 0]
                y += share * push[m, 1]
                z += share * push[m, 2]
                weight += share * pushed[m]
            share = free[low + n] / max(weight, 1.0)
            points[low + n, 0] += share * x
            points[low + n, 1] += share * y
            points[low + n, 2] += share * z
            largest[c] = max(largest[c], share * np.sqrt(x * x + y * y + z * z))
    return largest.max()


@njit(cache=True, nogil=True, parallel=True)
def _smooth(points, start, offsets, free, share):
    """Draw the way of each point from its start towards the mean way of its two neighbours."""
    for c in prange(len(offsets) - 1):
        low, high = offsets[c], offsets[c + 1]
        if high - low < 3:
            continue
        for a in range(3):
            before = points[low, a] - start[low, a]
            here = points[low + 1, a] - start[low + 1, a]
            points[low, a] += free[low] * share * (here - before)
            for n in range(low + 1, high - 1):
                after = points[n + 1, a] - start[n + 1, a]
                points[n, a] += free[n] * share * (0.5 * (before + after) - here)
                before, here = here, after
            points[high - 1, a] += free[high - 1] * share * (before - here)
