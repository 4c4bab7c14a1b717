"""Where hair is, seen or not: about every captured curve, and in the core of the bounding volume that the cameras do not see into.

The volume that hull and carving leave (``hull.occupancy``) is the hair with some air around it, since a fiber is thinner
than what either can tell. Where the cameras see, the captured curves tell where hair is much more sharply; only deeper in
the volume, where they see little, it has to be trusted. The result is signed: a distance to the surface, made into 0…1.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.spatial import cKDTree

from .grid import EDGE_MM, Grid
from .hidden import seen_from


@dataclass(frozen=True)
class InsideParams:
    """Parameters of the occupancy. Lengths in mm."""

    about_mm: float = 0.5  # hair is taken to fill what is this near to a fiber
    air_mm: float = 0.8  # depth in the bounding volume up to which it may be air
    core_seen_by: float = 6.0  # angles, from which on the curves tell all there is
    edge_mm: float = EDGE_MM  # over which the occupancy falls from 1 to 0
    view_blur_mm: float = 0.15  # of the density that hides


def surface_distance(
    points_mm: np.ndarray, density: np.ndarray, bounds: np.ndarray, diameter_mm: float, grid: Grid, angles_deg, params: InsideParams | None = None
) -> np.ndarray:
    """Signed distance (nx, ny, nz) float32 mm of each voxel to the surface of the hair, above 0 inside; far from it, no nearer than it is.

    points_mm (N, 3): along the captured curves, nearer to each other than a voxel; density (nx, ny, nz) mm/mm³ of these, of fibers of
    that diameter; bounds (nx, ny, nz), 0…1: of ``hull.occupancy``.
    """
    params = params or InsideParams()
    centres = np.stack(np.meshgrid(*(grid.centres(axis) for axis in range(3)), indexing="ij"), axis=-1).reshape(-1, 3)
    far = params.about_mm + 2 * params.edge_mm
    near = cKDTree(points_mm).query(centres, distance_upper_bound=far, workers=-1)[0].reshape(grid.shape)
    about = params.about_mm - np.minimum(near, far)
    seen = seen_from(gaussian_filter(density, params.view_blur_mm / grid.voxel_mm), diameter_mm, grid, angles_deg)
    solid = grid.check(bounds, "the bounding volume") > 0.5
    deep = distance_transform_edt(np.pad(solid, 1, mode="edge"))[1:-1, 1:-1, 1:-1] * grid.voxel_mm  # the volume goes on beyond its bounds
    core = (deep > params.air_mm) & (seen < params.core_seen_by)
    into = distance_transform_edt(core) - distance_transform_edt(~core) if core.any() else np.full(grid.shape, -np.inf)
    return np.maximum(about, np.clip((into + np.where(core, -0.5, 0.5)) * grid.voxel_mm, -far, None)).astype(np.float32)
