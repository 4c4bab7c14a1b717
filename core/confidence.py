"""How far each captured point may lie from the true centreline: its expected error, calibrated on locks that are known.

Three things add up, as squares: what the fit does not know (the covariance of the smoothing spline), what it has wrong where
hair bends (a filter that is long along a hair sees a bend from inside), and the chance that the curve follows another
hair (which falls with the evidence, and is higher among hairs that bend and cross).
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from .features import Index
from .grow import GrowParams
from .refine import RefineParams, _work, bend_at_large, ties
from .spline import BEND_MM, across, covariance, steps_of

SURE_MM = 0.02  # confidence is the chance to lie this near to a centreline


@dataclass(frozen=True)
class ErrorParams:
    """Weights of the three parts: those that tell the distances best in four dense locks that are known, one of another
    renderer (straight, wavy and curls are simulated): the least mean |log(distance / expected error)|, and medians that agree."""

    fit: float = 0.81  # of the root of the covariance's trace across the hair
    bend_mm2: float = 0.0018  # of the curvature at the point (1/mm)
    astray_mm: float = 0.407  # error that the lack of evidence makes in straight hair
    astray_mm2: float = 1.51  # and, added as squares, in bent hair: of the curve's mean curvature (1/mm)
    least_evidence: float = 3.45  # added to the evidence
    power: float = 2.45  # of the evidence, with which these two fall


def spread(index: Index, points: np.ndarray, grow_params: GrowParams, params: RefineParams, bend: float = np.inf) -> np.ndarray:
    """Standard deviation (n,) mm across the hair of each point (n, 3), n >= 4, of a curve that was fitted to the
    observations, at the stiffness that these make likeliest in hair of a curvature of ``bend`` (1/mm) at large."""
    normal, _, stiff = ties(index, points, _work(index, params, grow_params).slab, params, bend)
    return across(covariance(normal, stiff), points)


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
    half = steps_of(BEND_MM, grow_params.step_mm)
    bend = bend_at_large(((points_mm[a:b], evidence[a:b]) for a, b in pairwise(offsets)), grow_params.step_mm)

    def one(ends: tuple[int, int]) -> np.ndarray:
        points = np.ascontiguousarray(points_mm[slice(*ends)], float)
        if len(points) < 4:
            return np.full(len(points), np.nan)
        known = spread(index, points, grow_params, refine_params, bend), curvature(points, half), _supported(evidence[slice(*ends)])
        return combined(*known, params or ErrorParams())

    with ThreadPoolExecutor(workers) as pool:
        parts = list(pool.map(one, pairwise(offsets)))
    return np.concatenate([*parts, np.zeros(0)]).astype(np.float32)


def _supported(evidence: np.ndarray) -> np.ndarray:
    """Evidence (n,) of a curve; what is carried on beyond its ends, and has none, has that of the last point before."""
    seen = np.flatnonzero(evidence > 0)
    return evidence[np.clip(np.arange(len(evidence)), seen[0], seen[-1])] if len(seen) else evidence


def confidence(error_mm: np.ndarray) -> np.ndarray:
    """Confidence (N,) float32 of points with an expected error (N,) mm: the chance to lie within SURE_MM of a true centreline,
    1 / (1 + (error / SURE_MM)²). That is 1/2 at an expected error of SURE_MM, and 0 where the error is not known (NaN).

    On the locks of ``ErrorParams`` on average 99, 90, 68 and 49 of 100 points with an expected error of 4, 7, 12 and 15 µm lay so
    near; the formula says 96, 89, 75 and 63.
    """
    chance = 1 / (1 + (np.asarray(error_mm, float) / SURE_MM) ** 2)
    return np.where(np.isnan(chance), 0, chance).astype(np.float32)
