"""The smoothing spline in its plain form: a point every step, each tied to what was observed of it, with a price on the change of
curvature (Whittaker 1923). Its fit, how likely it is, and what it does not know.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

BEND_MM = 0.4  # to either side: the length over which a curvature is told


@njit(cache=True, nogil=True)
def steps_of(length_mm, step_mm):
    """How many steps are nearest to a length, one at least."""
    return max(round(length_mm / step_mm), 1)


class Stiffness(NamedTuple):
    """How a curve bends before anything is known of it, told by the second differences of its points, which are its curvature
    times the step squared: each is ``memory`` times the one before and something new."""

    price: float  # one over the variance of what is new
    memory: float = 1.0
    first: float = 0.0  # one over the variance of a second difference; 0: anything

    @property
    def changes(self) -> tuple[float, float, float, float]:
        """What is new, as a sum over four points."""
        return -self.memory, 1 + 2 * self.memory, -2 - self.memory, 1.0


def stiffness(step_mm: float, jerk_per_mm2: float, bend_per_mm: float = np.inf) -> Stiffness:
    """That of a curve whose curvature changes at random by ``jerk`` times the step in each step, and is about ``bend`` in the long
    run, each for one of the two directions across it."""
    new = min(step_mm * jerk_per_mm2 / bend_per_mm, 0.95) ** 2  # share of the variance
    change = step_mm * jerk_per_mm2 if new == 0 else bend_per_mm * np.sqrt(new)
    return Stiffness((step_mm**2 * change) ** -2, np.sqrt(1 - new), (step_mm**2 * bend_per_mm) ** -2)


BAND = 9  # elements of the matrix of a fit below its diagonal: three points of three coordinates


def smoothed(points: np.ndarray, normal: np.ndarray, right: np.ndarray, stiff: Stiffness) -> tuple[np.ndarray, float]:
    """points (n, 3) moved to the least of: what ``normal`` (n, 3, 3) and ``right`` (n, 3) say of each point's move, and what its
    bends cost; and the logarithm of how likely such ties are if it is so stiff, but for a constant. normal and right in units of
    the ties' own errors. A banded system, O(n); LAPACK's way to solve it takes five times as long, most of it to be called.
    """
    n = len(points)
    if n < 4:
        return points, 0.0
    moved, log_det, misfit = _smoothed(np.ascontiguousarray(points), normal, right, stiff.price, stiff.first, np.array(stiff.changes))
    return moved, 1.5 * (n - 3) * np.log(stiff.price) + 1.5 * np.log(stiff.first or 1.0) - log_det - 0.5 * misfit


def covariance(normal: np.ndarray, stiff: Stiffness) -> np.ndarray:
    """Covariance (n, 3, 3) of each point that ``smoothed`` gives for ties ``normal`` (n, 3, 3): the blocks on the diagonal of the
    inverse of its matrix. n >= 4."""
    return diagonal_blocks(_factored(normal, stiff.price, stiff.first, np.array(stiff.changes)))


@njit(cache=True, nogil=True)
def _smoothed(points, normal, right, price, first, changes):
    """(moved points (n, 3), half the logarithm of the determinant, misfit) of ``smoothed``."""
    n = len(points)
    move, start = right.copy(), (1.0, -2.0, 1.0)
    for c in range(3):
        for t in range(n - 3):
            new = price * _new(points, t, c, changes)
            for a in range(4):
                move[t + a, c] -= changes[a] * new
        bend = first * (points[0, c] - 2 * points[1, c] + points[2, c])
        for a in range(3):
            move[a, c] -= start[a] * bend
    lower = _factored(normal, price, first, changes)
    _solve(lower, move.reshape(-1))
    moved, misfit = points + move, 0.0
    for c in range(3):
        for t in range(n - 3):
            misfit += price * _new(moved, t, c, changes) ** 2
        misfit += first * (moved[0, c] - 2 * moved[1, c] + moved[2, c]) ** 2
        for j in range(n):
            held = normal[j, c, 0] * move[j, 0] + normal[j, c, 1] * move[j, 1] + normal[j, c, 2] * move[j, 2]
            misfit += move[j, c] * (held - 2 * right[j, c])
    return moved, np.log(lower[:, 0]).sum(), misfit


@njit(cache=True, nogil=True)
def _new(points, t, c, changes):
    """What is new in the second differences of coordinate c at point t."""
    return changes[0] * points[t, c] + changes[1] * points[t + 1, c] + changes[2] * points[t + 2, c] + changes[3] * points[t + 3, c]


@njit(cache=True, nogil=True)
def _factored(normal, price, first, changes):
    """L of L Lᵀ, the matrix of ties normal (n, 3, 3) and what bends cost: lower (3 n, BAND + 1), [i, k] the element (i, i - k)."""
    n, start = len(normal), (1.0, -2.0, 1.0)
    lower = np.zeros((3 * n, BAND + 1))
    for j in range(n):
        for c in range(3):
            for d in range(c + 1):
                lower[3 * j + c, c - d] = normal[j, c, d]
            lower[3 * j + c, 0] += 1e-9 + 1e-13 * price  # a hair that nothing ties is still held somewhere
    for t in range(n - 3):
        for a in range(4):
            for b in range(a, 4):
                for c in range(3):
                    lower[3 * (t + b) + c, 3 * (b - a)] += price * changes[a] * changes[b]
    for a in range(3):
        for b in range(a, 3):
            for c in range(3):
                lower[3 * b + c, 3 * (b - a)] += first * start[a] * start[b]
    for i in range(3 * n):
        for k in range(min(i, BAND), -1, -1):
            j = i - k
            total = lower[i, k]
            for m in range(1, min(BAND - k, j) + 1):
                total -= lower[i, k + m] * lower[j, m]
            lower[i, k] = total / lower[j, 0] if k else np.sqrt(total)
    return lower


@njit(cache=True, nogil=True)
def _solve(lower, x):
    """x (3 n,) replaced by the solution of L Lᵀ y = x."""
    size = len(x)
    for i in range(size):
        for k in range(1, min(i, BAND) + 1):
            x[i] -= lower[i, k] * x[i - k]
        x[i] /= lower[i, 0]
    for i in range(size - 1, -1, -1):
        for k in range(1, min(size - 1 - i, BAND) + 1):
            x[i] -= lower[i + k, k] * x[i + k]
        x[i] /= lower[i, 0]


def across(covariances: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Standard deviation (n,) across a curve of points (n, 3) from their covariances (n, 3, 3)."""
    way = np.gradient(points, axis=0)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    along = np.einsum("ni,nij,nj->n", way, covariances, way)
    return np.sqrt(np.maximum(np.trace(covariances, axis1=1, axis2=2) - along, 0.0))


@njit(cache=True, nogil=True)
def diagonal_blocks(lower):
    """The 3 x 3 blocks (n, 3, 3) on the diagonal of the inverse of a matrix A = L Lᵀ, without the rest of the inverse.

    lower (3 n, b + 1): [i, k] the element (i, i - k) of L. From the last row upwards, each row of the inverse inside the band
    follows from those below it (Takahashi, Fagan and Chen 1973): b² operations a row, b >= 2.
    """
    size, width = len(lower), lower.shape[1] - 1
    inverse = np.zeros((size, width + 1))  # [i, k]: the element (i, i + k)
    for i in range(size - 1, -1, -1):
        last = min(width, size - 1 - i)
        for k in range(last, -1, -1):
            total = 1.0 / lower[i, 0] if k == 0 else 0.0
            for m in range(1, last + 1):
                total -= lower[i + m, m] * (inverse[i + m, k - m] if k >= m else inverse[i + k, m - k])
            inverse[i, k] = total / lower[i, 0]
    blocks = np.empty((size // 3, 3, 3))
    for j in range(len(blocks)):
        for c in range(3):
            for d in range(3):
                blocks[j, c, d] = inverse[3 * j + min(c, d), abs(c - d)]
    return blocks
