"""Cubes of the object frame, and what fills them. Importing it costs next to nothing: Blender's side does."""

from dataclasses import dataclass

import numpy as np

from .errors import StrandscopeError

EDGE_MM = 0.4  # over which the occupancy falls from 1 to 0


@dataclass(frozen=True)
class Grid:
    """Cubes of the object frame; cell (i, j, k) spans origin + (i…i+1, j…j+1, k…k+1) voxel edges along x, y, z."""

    origin_mm: tuple[float, float, float]
    voxel_mm: float
    shape: tuple[int, int, int]

    @classmethod
    def around(cls, low_mm, high_mm, voxel_mm: float) -> "Grid":
        """The grid of whole voxels about the middle of a box that covers it. Raises StrandscopeError for an empty box."""
        low, high = np.asarray(low_mm, float), np.asarray(high_mm, float)
        if not voxel_mm > 0:
            raise StrandscopeError(f"voxel_mm is {voxel_mm}; expected more than 0")
        if not (np.all(np.isfinite(high - low)) and np.all(high > low)):
            raise StrandscopeError(f"the volume spans {low.tolist()} to {high.tolist()} mm; expected more than nothing along x, y and z")
        shape = np.maximum(np.ceil((high - low) / voxel_mm - 1e-6), 1).astype(int)
        origin = (low + high - shape * voxel_mm) / 2
        return cls(tuple(origin.tolist()), float(voxel_mm), tuple(shape.tolist()))

    @property
    def high_mm(self) -> np.ndarray:
        """The far corner (3,)."""
        return np.asarray(self.origin_mm) + np.asarray(self.shape) * self.voxel_mm

    def to_cells(self, points_mm) -> np.ndarray:
        """Points (..., 3) mm -> in voxel edges from the corner (..., 3): the floor is the index, centres lie at .5."""
        return (np.asarray(points_mm, float) - self.origin_mm) / self.voxel_mm

    def to_mm(self, cells) -> np.ndarray:
        """The inverse of ``to_cells``."""
        return np.asarray(cells, float) * self.voxel_mm + self.origin_mm

    def centres(self, axis: int) -> np.ndarray:
        """Coordinates (n,) mm of the voxels' centres along one axis."""
        return self.origin_mm[axis] + (np.arange(self.shape[axis]) + 0.5) * self.voxel_mm

    def check(self, volume: np.ndarray, name: str) -> np.ndarray:
        """The volume, or StrandscopeError where its shape is not the grid's."""
        if np.shape(volume)[:3] != self.shape:
            raise StrandscopeError(f"{name} has shape {np.shape(volume)}; expected the grid's {self.shape}")
        return volume


def occupied(distance_mm: np.ndarray, edge_mm: float = EDGE_MM) -> np.ndarray:
    """Occupancy (nx, ny, nz) float32 of 0…1 for an ``inside.surface_distance``: 0.5 at the surface, a smooth step over edge_mm."""
    share = np.clip(0.5 + np.asarray(distance_mm) / edge_mm, 0.0, 1.0)
    return (share * share * (3.0 - 2.0 * share)).astype(np.float32)
