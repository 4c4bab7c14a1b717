"""The smoothing spline in its plain form: a point every step, each tied to what was observed of it, with a price on the change of
curvature (Whittaker 1923). Its fit, how likely it is, and what it does not know.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.linalg import cho_solve_banded, cholesky_banded


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


def smoothed(points: np.ndarray, normal: np.ndarray, right: np.ndarray, stiff: Stiffness) -> tuple[np.ndarray, float]:
    """points (n, 3) moved to the least of: what ``normal`` (n, 3, 3) and ``right`` (n, 3) say of each point's move, and what its
    bends cost; and the logarithm of how likely such ties are if it is so stiff, but for a constant. normal and right in units of
    the ties' own errors. A banded system, O(n).
    """
    n = len(points)
    if n < 4:
        return points, 0.0
    pull, bends = right.copy(), np.diff(points, 2, axis=0)
    new = bends[1:] - stiff.memory * bends[:-1]
    for a, change in enumerate(stiff.changes):
        pull[a : n - 3 + a] -= stiff.price * change * new
    for a, change in enumerate((1.0, -2.0, 1.0)):
        pull[a] -= stiff.first * change * bends[0]
    factor = cholesky_banded(_bands(normal, stiff))
    move = cho_solve_banded((factor, False), pull.reshape(-1)).reshape(n, 3)
    bends = np.diff(points + move, 2, axis=0)
    cost = stiff.price * np.sum((bends[1:] - stiff.memory * bends[:-1]) ** 2) + stiff.first * np.sum(bends[0] ** 2)
    misfit = np.einsum("ni,nij,nj", move, normal, move) - 2 * np.sum(right * move) + cost
    likely = 1.5 * (n - 3) * np.log(stiff.price) + 1.5 * np.log(stiff.first or 1.0) - np.log(factor[9]).sum() - 0.5 * misfit
    return points + move, float(likely)


def covariance(normal: np.ndarray, stiff: Stiffness) -> np.ndarray:
    """Covariance (n, 3, 3) of each point that ``smoothed`` gives for ties ``normal`` (n, 3, 3): the blocks on the diagonal of the
    inverse of its matrix. n >= 4."""
    return diagonal_blocks(cholesky_banded(_bands(normal, stiff)))


def across(covariances: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Standard deviation (n,) across a curve of points (n, 3) from their covariances (n, 3, 3)."""
    way = np.gradient(points, axis=0)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    along = np.einsum("ni,nij,nj->n", way, covariances, way)
    return np.sqrt(np.maximum(np.trace(covariances, axis1=1, axis2=2) - along, 0.0))


def _bands(normal: np.ndarray, stiff: Stiffness) -> np.ndarray:
    """The matrix (10, 3 n) of ties normal (n, 3, 3) and what bends cost, upper banded."""
    n = len(normal)
    bands = np.zeros((10, 3 * n))
    for c in range(3):
        for d in range(c, 3):
            bands[9 - (d - c), d::3] = normal[:, c, d]
    changes, start = stiff.changes, (1.0, -2.0, 1.0)
    for a in range(4):
        for b in range(a, 4):
            bands[9 - 3 * (b - a), 3 * b : 3 * (n - 3 + b)] += stiff.price * changes[a] * changes[b]
    for a in range(3):
        for b in range(a, 3):
            bands[9 - 3 * (b - a), 3 * b : 3 * b + 3] += stiff.first * start[a] * start[b]
    bands[9] += 1e-9 + 1e-13 * stiff.price  # a hair that nothing ties is still held somewhere
    return bands


@njit(cache=True, nogil=True)
def diagonal_blocks(factor: np.ndarray) -> np.ndarray:
    """The 3 x 3 blocks (n, 3, 3) on the diagonal of the inverse of a matrix A = Uᵀ U, without the rest of the inverse.

    factor (b + 1, 3 n): U, upper banded as ``scipy.linalg.cholesky_banded`` gives it. From the last row upwards, each row of
    the inverse inside the band follows from those below it (Takahashi, Fagan and Chen 1973): b² operations a row, b >= 2.
    """
    width, size = factor.shape[0] - 1, factor.shape[1]
    inverse = np.zeros((size, width + 1))  # [i, k]: the element (i, i + k)
    for i in range(size - 1, -1, -1):
        last = min(width, size - 1 - i)
        for k in range(last, -1, -1):
            total = 1.0 / factor[width, i] if k == 0 else 0.0
            for m in range(1, last + 1):
                total -= factor[width - m, i + m] * (inverse[i + m, k - m] if k >= m else inverse[i + k, m - k])
            inverse[i, k] = total / factor[width, i]
    blocks = np.empty((size // 3, 3, 3))
    for j in range(len(blocks)):
        for c in range(3):
            for d in range(3):
                blocks[j, c, d] = inverse[3 * j + min(c, d), abs(c - d)]
    return blocks
