"""How far each captured point may lie from the true centreline: its expected error, calibrated on locks that are known.

Three things add up, as squares: what the fit does not know (the covariance of the smoothing spline), what it has wrong where
hair bends (a filter that is long along a hair sees a bend from inside), and the chance that the curve follows another
hair (which falls with the evidence, and is higher among hairs that bend and cross).
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit
from scipy.linalg import cholesky_banded

from .features import Index
from .grow import GrowParams
from .refine import JERKS_PER_MM2, RefineParams, _tie, _work, smoothed

THIRD = np.array([-1.0, 3.0, -3.0, 1.0])
SURE_MM = 0.02  # confidence is the chance to lie this near to a centreline
BEND_MM = 0.4  # to either side: the length over which curvature is measured


@dataclass(frozen=True)
class ErrorParams:
    """Weights of the three parts: those that tell the distances best in three dense locks that are known, one of another
    renderer (straight, wavy, curls): the least mean |log(distance / expected error)|, and medians that agree."""

    fit: float = 1.04  # of the root of the covariance's trace across the hair
    bend_mm2: float = 0.0005  # of the curvature at the point (1/mm)
    astray_mm: float = 0.0170  # error that the lack of evidence makes in straight hair
    astray_mm2: float = 0.3475  # and, added as squares, in bent hair: of the curve's mean curvature (1/mm)
    least_evidence: float = 0.36  # added to the evidence
    power: float = 1.81  # of the evidence, with which these two fall


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


def covariance(normal: np.ndarray, price: float) -> np.ndarray:
    """Covariance (n, 3, 3) of each point that ``refine.smoothed`` gives for ties ``normal`` (n, 3, 3) and ``price``: the
    blocks on the diagonal of the inverse of its matrix. n >= 4."""
    n = len(normal)
    bands = np.zeros((10, 3 * n))
    for c in range(3):
        for d in range(c, 3):
            bands[9 - (d - c), d::3] = normal[:, c, d]
    for a in range(4):
        for b in range(a, 4):
            bands[9 - 3 * (b - a), 3 * b : 3 * (n - 3 + b)] += price * THIRD[a] * THIRD[b]
    bands[9] += 1e-9
    return diagonal_blocks(cholesky_banded(bands))


def spread(index: Index, points: np.ndarray, grow_params: GrowParams, params: RefineParams) -> np.ndarray:
    """Standard deviation (n,) mm across the hair of each point (n, 3), n >= 4, of a curve that was fitted to the
    observations, at the stiffness that these make likeliest."""
    work = _work(index, params, grow_params, map)
    normal, right = np.empty((len(points), 3, 3)), np.empty((len(points), 3))
    _tie(index, points, work.slab, normal, right)
    error = params.slab_px * index.pitch
    normal, right = normal / error**2, right / error**2
    prices = [(work.box.step**3 * jerk) ** -2 for jerk in JERKS_PER_MM2]
    likely = [smoothed(points, normal, right, price)[1] for price in prices]
    found = covariance(normal, prices[int(np.argmax(likely))])
    way = np.gradient(points, axis=0)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    along = np.einsum("ni,nij,nj->n", way, found, way)
    return np.sqrt(np.maximum(np.trace(found, axis1=1, axis2=2) - along, 0.0))


def curvature(points: np.ndarray, half: int) -> np.ndarray:
    """Curvature (n,) 1/mm of a curve of points (n, 3), from each and those ``half`` places before and after; that of the
    nearest inner point at the ends, and over what there is in a shorter curve. n >= 3."""
    half = min(half, (len(points) - 1) // 2)
    one, two = points[half:-half] - points[: -2 * half], points[2 * half :] - points[half:-half]
    inner = np.linalg.norm(two - one, axis=1) / np.linalg.norm(0.5 * (one + two), axis=1) ** 2
    return np.pad(inner, half, mode="edge")


def combined(spread_mm: np.ndarray, curvature_per_mm: np.ndarray, evidence: np.ndarray, params: ErrorParams) -> np.ndarray:
    """Expected error (n,) mm of the points of one curve: the distance to the centreline that half of such points keep."""
    astray = np.hypot(params.astray_mm, params.astray_mm2 * curvature_per_mm.mean())
    astray = astray / (np.maximum(evidence, 0.0) + params.least_evidence) ** params.power
    return np.sqrt((params.fit * spread_mm) ** 2 + (params.bend_mm2 * curvature_per_mm) ** 2 + astray**2)


def expected_error(
    index: Index,
    grow_params: GrowParams,
    refine_params: RefineParams,
    points_mm: np.ndarray,
    offsets: np.ndarray,
    evidence: np.ndarray,
    workers: int = 1,
    params: ErrorParams | None = None,
) -> np.ndarray:
    """Expected error (N,) float32 mm of points_mm (N, 3) on the curves that ``refine.trace`` found, with their evidence (N,):
    among points with an expected error of e, half lie within e of a true centreline. NaN on curves of fewer than 4 points.

    The observations that curves stand on must not be marked as used, as ``trace`` leaves them. The same for any number of
    ``workers``.
    """
    half = max(round(BEND_MM / grow_params.step_mm), 1)

    def one(ends: tuple[int, int]) -> np.ndarray:
        points = np.ascontiguousarray(points_mm[slice(*ends)], float)
        if len(points) < 4:
            return np.full(len(points), np.nan)
        known = spread(index, points, grow_params, refine_params), curvature(points, half), evidence[slice(*ends)]
        return combined(*known, params or ErrorParams())

    with ThreadPoolExecutor(workers) as pool:
        parts = list(pool.map(one, pairwise(offsets)))
    return np.concatenate([*parts, np.zeros(0)]).astype(np.float32)


def confidence(error_mm: np.ndarray) -> np.ndarray:
    """Confidence (N,) float32 of points with an expected error (N,) mm: the chance to lie within SURE_MM of a true centreline,
    1 / (1 + (error / SURE_MM)²). That is 1/2 at an expected error of SURE_MM, and 0 where the error is not known (NaN).

    On the three locks of ``ErrorParams`` on average 98, 88, 67 and 48 of 100 points with an expected error of 4, 7, 13 and 22 µm lay so near;
    the formula says 96, 89, 71 and 45.
    """
    chance = 1 / (1 + (np.asarray(error_mm, float) / SURE_MM) ** 2)
    return np.where(np.isnan(chance), 0, chance).astype(np.float32)
