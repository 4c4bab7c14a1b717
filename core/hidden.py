"""What the cameras can see of a place inside hair, judged by the hair that is known: how many angles see it, what of it is found.

Hair in the way dims what is behind it as mist does: by its density times its diameter along the ray (Beer and Lambert). An
angle sees a place if half of its light or more comes through. Of hair that few angles see, few is found; where hair is
found, one can therefore tell how much there is, and where none can be found, that it is not known.
"""

from typing import NamedTuple

import numpy as np
from numba import njit, prange
from scipy.ndimage import gaussian_filter, map_coordinates

from .grid import Grid

CLEAR, SOFT = 0.5, 0.08  # share of the light from which on an angle sees a place, and how sharply
SEEN_BY = np.array([0.0, 0.3, 0.6, 1.0, 1.5, 2.1, 3.0, 4.0, 5.2, 7.0, 9.5, 13.0])
FOUND = np.array([0.03, 0.12, 0.38, 0.62, 0.76, 0.84, 0.9, 0.92, 0.94, 0.965, 0.985, 0.995])  # of hair that so many angles see; simulated locks
FULL = 0.75  # quantile of the density where hair was found: hair that is whole
DARK, DARKEST = 0.1, 0.05  # share of the rays in the open: where fewer pass, hair is in the way; where far fewer, it is hair that nobody sees
HALF_SEEN = (1.5, 5.0)  # captured places that so many angles should see tell by how many did what else is in the way
EVIDENCE = 0.85  # angles that see a place, for each that has seen a hair there; simulated locks
SHARES = np.array([0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0])  # of a full inside that are tried; where none explains what is seen, it is full


def seen_from(density: np.ndarray, diameter_mm: float, grid: Grid, angles_deg: np.ndarray) -> np.ndarray:
    """How many of the angles see each voxel: (nx, ny, nz) float32. density (nx, ny, nz) mm/mm³, of fibers of that diameter.

    Rays are taken as parallel: over the hair, the aperture's cone spreads by about as much as density is known.
    """
    extinction = np.ascontiguousarray(np.transpose(grid.check(density, "the density"), (0, 2, 1)) * diameter_mm, np.float32)
    x, z = grid.centres(0).astype(np.float64), grid.centres(2).astype(np.float64)
    seen = np.zeros(extinction.shape, np.float32)
    for angle in np.radians(np.asarray(angles_deg, np.float64)):
        _see_through(extinction, x, z, grid.voxel_mm, np.cos(angle), np.sin(angle), seen)
    return np.ascontiguousarray(np.transpose(seen, (0, 2, 1)))


def found_share(seen: np.ndarray) -> np.ndarray:
    """The share of hair that is found, float32, where ``seen`` angles see it."""
    return np.interp(seen, SEEN_BY, FOUND).astype(np.float32)


class Hidden(NamedTuple):
    """What was not found, and how well each voxel is seen."""

    missing: np.ndarray  # (nx, ny, nz) float32, mm/mm³
    found: np.ndarray  # (nx, ny, nz) float32: the share of hair that is found there


def hidden(
    density: np.ndarray,
    body: np.ndarray,
    through: np.ndarray,
    diameter_mm: float,
    grid: Grid,
    angles_deg: np.ndarray,
    points_mm: np.ndarray,
    evidence: np.ndarray,
    blur_mm: float = 0.5,
    view_blur_mm: float = 0.15,
) -> Hidden:
    """Estimate the hair that was not found, where little light passes.

    density (nx, ny, nz) mm/mm³: of what was found; body (nx, ny, nz), 0…1: where hair stands, without air about it; through (nx, ny, nz):
    rays that pass, as a share of those in the open (``hull.free_share``); points_mm (N, 3) and evidence (N,): captured points, and the
    cameras that saw each.

    Two estimates, of which the larger holds at each voxel. Where the body is darkest, hair is as dense as where all of it is found. And
    were the dark body full, few angles would see its inside; of that hidden hair, as much is there as hides the captured points as much
    as they were found hidden: the found hair alone would let more cameras see them.
    """
    body = np.asarray(grid.check(body, "the body"), np.float32)
    grid.check(through, "the share of rays")
    whole = _full(density, body, blur_mm / grid.voxel_mm)

    def seen(hair):
        return seen_from(gaussian_filter(hair, view_blur_mm / grid.voxel_mm), diameter_mm, grid, angles_deg)

    def dark(below):
        return gaussian_filter(np.clip(1.5 - through / below, 0.0, 1.0).astype(np.float32), _DARK_BLUR_MM / grid.voxel_mm)

    empty = np.maximum(whole * body * dark(DARKEST) - gaussian_filter(density, _EMPTY_BLUR_MM / grid.voxel_mm), 0.0)
    behind = whole * body * dark(DARK) * (1.0 - found_share(seen(np.maximum(whole * body, density))))
    cells = (grid.to_cells(points_mm) - 0.5).T

    def seen_by(share):
        return map_coordinates(seen(density + np.float32(share) * behind), cells, order=1, mode="nearest")

    missing = np.maximum(np.float32(_share(seen_by, evidence)) * behind, empty).astype(np.float32)
    return Hidden(missing, found_share(seen(density + missing)))


def _share(seen_by, evidence):
    """The share of SHARES by which the captured points are seen by as many angles as they were; seen_by: by how many (N,), for a share."""
    at = seen_by(0.0)
    told = (at > HALF_SEEN[0]) & (at < HALF_SEEN[1]) & (evidence > 0)
    if not told.any():
        return 0.0
    ratios = []
    for share in SHARES:
        at = at if share == 0.0 else seen_by(share)
        ratios.append(float(at[told].sum() / evidence[told].sum()))
        if ratios[-1] <= EVIDENCE:
            return np.interp(-EVIDENCE, -np.array(ratios), SHARES[: len(ratios)])
    return 1.0


_DARK_BLUR_MM, _EMPTY_BLUR_MM = 0.2, 0.3  # of what is dark; of the density beside which the body is empty


def _full(density, body, sigma):
    """How dense hair is where most of it was found: a high quantile of the blurred density in the body."""
    local = gaussian_filter(density, sigma, mode="constant") / np.maximum(gaussian_filter(body, sigma, mode="constant"), 0.2)
    some = local[(body > 0.5) & (local > 0)]
    return np.float32(np.quantile(some, FULL)) if len(some) else np.float32(0.0)


@njit(cache=True, nogil=True, parallel=True)
def _see_through(extinction, x, z, voxel, cos, sin, seen):
    """Add one angle's view. In a grid turned to the camera, extinction is summed along w; both ways are bilinear in x and z."""
    nx, nz, ny = extinction.shape
    middle_x, middle_z = 0.5 * (x[0] + x[-1]), 0.5 * (z[0] + z[-1])
    reach = 0.5 * np.hypot(x[-1] - x[0] + voxel, z[-1] - z[0] + voxel)
    size = int(np.ceil(2.0 * reach / voxel)) + 1
    start = -0.5 * (size - 1) * voxel
    depth = np.zeros((size, size, ny), np.float32)  # by u and w: optical depth from the voxel's middle on towards the camera
    for a in prange(size):
        u = start + a * voxel
        line = np.zeros(ny, np.float32)
        here = np.zeros(ny, np.float32)
        for b in range(size - 1, -1, -1):
            w = start + b * voxel
            i = (middle_x + u * cos - w * sin - x[0]) / voxel
            k = (middle_z + u * sin + w * cos - z[0]) / voxel
            i0, k0 = int(np.floor(i)), int(np.floor(k))
            here[:] = 0.0
            for corner in range(4):
                p, q = i0 + (corner & 1), k0 + (corner >> 1)
                if 0 <= p < nx and 0 <= q < nz:
                    share = np.float32((1.0 - abs(i - p)) * (1.0 - abs(k - q)))
                    for j in range(ny):
                        here[j] += share * extinction[p, q, j]
            for j in range(ny):
                depth[a, b, j] = line[j] + np.float32(0.5 * voxel) * here[j]
                line[j] += np.float32(voxel) * here[j]
    for i in prange(nx):
        through = np.zeros(ny, np.float32)
        for k in range(nz):
            u = (x[i] - middle_x) * cos + (z[k] - middle_z) * sin
            w = -(x[i] - middle_x) * sin + (z[k] - middle_z) * cos
            a, b = (u - start) / voxel, (w - start) / voxel
            a0, b0 = min(int(a), size - 2), min(int(b), size - 2)
            through[:] = 0.0
            for corner in range(4):
                p, q = a0 + (corner & 1), b0 + (corner >> 1)
                share = np.float32((1.0 - abs(a - p)) * (1.0 - abs(b - q)))
                for j in range(ny):
                    through[j] += share * depth[p, q, j]
            for j in range(ny):
                seen[i, k, j] += np.float32(1.0) / (np.float32(1.0) + np.exp((np.float32(CLEAR) - np.exp(-through[j])) / np.float32(SOFT)))
