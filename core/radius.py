"""How thick each fiber is, told by how broad its ridges are in the photographs.

Breadth is the answer of a filter for broader hair over that for finer hair, and grows with the logarithm of the radius. It also
depends on how the light falls, which is much the same for all fibers of a capture, so that fibers are compared with each other
better than with a ruler. Both are weighed against what is known of human hair before.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit

from .features import BREADTHS, Index, SweepFeatures, breadth_of, strength_of
from .grow import GrowParams
from .look import BOW, Box, chord, gather, hair_frame, new_hits, shows
from .refine import RefineParams, _work


@dataclass(frozen=True)
class RadiusParams:
    """What breadth says of a radius, told on simulated locks of three styles, and what is known before."""

    usual_mm: float = 0.04  # of human hair
    spread: float = 0.15  # of the logarithm of the radius, among fibers as among people
    breadth: float = 0.235  # of a fiber of 1.4 pixels radius
    slope: float = 0.52  # of the breadth, a factor of e in the radius
    light: float = 0.3  # error of the mean of a capture: hair that shines looks finer
    fiber: tuple[float, float] = (0.13, 0.6)  # error of one fiber, and of one step of it, beside that


@njit(cache=True, nogil=True)
def _tally(index, k, breadth, points, box, tally):
    """Add the breadths of what sweep k sees of a curve (n, 3) to tally (BREADTHS,), each by its weight and strength squared."""
    hits = new_hits(1)
    for j in range(len(points)):
        frame = hair_frame(index, k, points[j], chord(points, j))
        if not shows(index, k, frame):
            continue
        for i in range(gather(index, k, frame, 0.0, 0.0, box, hits, 0)):
            x = hits.across[i] / box.sigma
            x = max(1 - BOW * x * x, 0.0)
            n = hits.number[i]
            tally[breadth[n - index.first[k]]] += hits.weight[i] * x * x * strength_of(index.strength[n]) ** 2


def breadths(index: Index, sweeps: Sequence[SweepFeatures], points_mm: np.ndarray, offsets: np.ndarray, box: Box, workers: int = 1) -> np.ndarray:
    """Median breadth (M,) of the ridges along each curve of points_mm (N, 3), NaN where there are none. One sweep's breadths are in
    memory at a time, and nothing of it depends on the number of ``workers``."""
    curves = [np.ascontiguousarray(points_mm[a:b], float) for a, b in pairwise(offsets)]
    tallies = np.zeros((len(curves), BREADTHS))
    with ThreadPoolExecutor(workers) as pool:
        for k, sweep in enumerate(sweeps):
            breadth = np.asarray(sweep.breadth)
            list(pool.map(lambda curve, tally, k=k, breadth=breadth: _tally(index, k, breadth, curve, box, tally), curves, tallies))
    total = tallies.sum(axis=1)
    median = breadth_of(np.argmax(np.cumsum(tallies, axis=1) >= 0.5 * total[:, None], axis=1))
    return np.where(total > 0, median, np.nan)


def radii(breadth: np.ndarray, lengths: np.ndarray, pitch_mm: float, params: RadiusParams) -> np.ndarray:
    """Radius (M,) mm of fibers of a breadth (M,), told over ``lengths`` (M,) in steps: the likeliest, with all that may be wrong."""
    told = (breadth - params.breadth) / params.slope + np.log(1.4 * pitch_mm / params.usual_mm)  # logarithm, beside the usual
    if not np.isfinite(told).any():
        return np.full(len(breadth), params.usual_mm)
    known = params.spread**2
    middle = np.nanmedian(told)
    error = params.fiber[0] ** 2 + params.fiber[1] ** 2 / np.maximum(lengths, 1)
    apart = np.where(np.isfinite(told), known / (known + error) * (told - middle), 0.0)
    return params.usual_mm * np.exp(known / (known + params.light**2) * middle + apart)


def measured(
    index: Index,
    sweeps: Sequence[SweepFeatures],
    points_mm: np.ndarray,
    offsets: np.ndarray,
    grow_params: GrowParams,
    refine_params: RefineParams,
    params: RadiusParams,
    workers: int = 1,
) -> np.ndarray:
    """Radius (N,) float32 mm of the points of curves that ``refine.trace`` found, one radius a curve."""
    found = breadths(index, sweeps, points_mm, offsets, _work(index, refine_params, grow_params).slab, workers)
    lengths = np.diff(offsets)
    return np.repeat(radii(found, lengths, index.pitch, params), lengths).astype(np.float32)
