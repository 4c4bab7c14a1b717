"""Where the hair is, to be kept and shown: as a volume (OpenVDB), as a mesh of its surface, and all that it was made from.

Importing it costs little: Blender's side reads the files.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .errors import StrandscopeError
from .files import atomic
from .grid import Grid, occupied
from .strands import load_arrays
from .vdb import write_vdb

SUFFIXES = (".vdb", ".ply", ".npz")
DENSITY = "density"  # the grid's name, which Blender's materials look for


@dataclass(frozen=True)
class Volume:
    """What the cameras and the curves tell of each voxel, and the surface of the hair by both."""

    grid: Grid
    blueness: np.ndarray  # (nx, ny, nz) float32: of ``hull.visual_hull``
    rays: np.ndarray  # (nx, ny, nz) uint32: of ``hull.carve``
    distance_mm: np.ndarray  # (nx, ny, nz) float32: of ``inside.surface_distance``, above 0 inside
    edge_mm: float  # over which the occupancy falls from 1 to 0
    vertices_mm: np.ndarray  # (V, 3) float32: of ``surface``
    faces: np.ndarray  # (F, 3) int32
    made_from: str = ""  # a digest of the curves and parameters

    @property
    def density(self) -> np.ndarray:
        """Occupancy (nx, ny, nz) float32, 0…1: 0.5 at the surface."""
        return occupied(self.distance_mm, self.edge_mm)


def surface(distance_mm: np.ndarray, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """The surface distance_mm = 0, (nx, ny, nz) above 0 inside: vertices (V, 3) float32 mm and triangles (F, 3) int32 that face outwards.

    It is closed where the grid ends. Nothing inside gives no triangle. By marching cubes (Lewiner et al. 2003).
    """
    grid.check(distance_mm, "the distance")
    if not np.any(distance_mm > 0):
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)
    from skimage.measure import marching_cubes

    inside = [np.flatnonzero(np.any(distance_mm > 0, axis=tuple({0, 1, 2} - {axis}))) for axis in range(3)]
    first = np.array([max(found[0] - 1, 0) for found in inside])
    cut = distance_mm[tuple(slice(max(found[0] - 1, 0), found[-1] + 2) for found in inside)]
    closed = -np.abs(np.pad(cut, 1, mode="edge"))  # where the grid ends, the surface is halfway to the next voxel
    closed[1:-1, 1:-1, 1:-1] = cut
    vertices, faces, _, _ = marching_cubes(closed, 0.0, allow_degenerate=False)
    return grid.to_mm(vertices + (first - 0.5)).astype(np.float32), faces[:, ::-1].astype(np.int32)


# ---- files -----------------------------------------------------------------------------------------------------------


def save_volume(path: Path, volume: Volume) -> None:
    """Write a volume file (.npz), atomically; the same volume gives the same bytes."""
    with atomic(path) as part:
        np.savez_compressed(
            part,
            origin_mm=np.asarray(volume.grid.origin_mm, np.float64),
            voxel_mm=np.float64(volume.grid.voxel_mm),
            blueness=volume.blueness.astype(np.float32),
            rays=volume.rays.astype(np.uint32),
            distance_mm=volume.distance_mm.astype(np.float32),
            edge_mm=np.float64(volume.edge_mm),
            vertices_mm=volume.vertices_mm.astype(np.float32),
            faces=volume.faces.astype(np.int32),
            made_from=np.array(volume.made_from),
        )


def load_volume(path: Path) -> Volume:
    """Read a volume file. Raises StrandscopeError, naming the array, for one that is missing, damaged or does not fit together."""
    names = ("origin_mm", "voxel_mm", "blueness", "rays", "distance_mm", "edge_mm", "vertices_mm", "faces", "made_from")
    arrays = load_arrays(path, names)
    distance, origin = arrays["distance_mm"], arrays["origin_mm"]
    for name, good, expected in (
        ("distance_mm", distance.ndim == 3, "shape (nx, ny, nz)"),
        ("origin_mm", origin.shape == (3,), "shape (3,)"),
        *((name, arrays[name].shape == distance.shape, f"that of distance_mm, {distance.shape}") for name in ("blueness", "rays")),
        *((name, arrays[name].ndim == 2 and arrays[name].shape[1] == 3, "shape (n, 3)") for name in ("vertices_mm", "faces")),
    ):
        if not good:
            raise StrandscopeError(f"{path}: {name} has shape {arrays[name].shape}; expected {expected}")
    return Volume(
        grid=Grid(tuple(origin.tolist()), float(arrays["voxel_mm"]), distance.shape),
        edge_mm=float(arrays["edge_mm"]),
        made_from=str(arrays["made_from"]),
        **{name: arrays[name] for name in ("blueness", "rays", "distance_mm", "vertices_mm", "faces")},
    )


def write_volume(path: Path, volume: Volume) -> None:
    """Write a volume in the format of the file's ending: the occupancy (.vdb), the surface (.ply) or all there is (.npz).

    Lengths are mm of the object frame. Raises StrandscopeError for another ending.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".vdb":
        write_vdb(path, {DENSITY: volume.density}, centres(volume.grid))
    elif suffix == ".ply":
        write_ply(path, volume.vertices_mm, volume.faces)
    elif suffix == ".npz":
        save_volume(path, volume)
    else:
        raise StrandscopeError(f"{path}: cannot be written as {suffix or 'a file without ending'}; expected one of {', '.join(SUFFIXES)}")


def centres(grid: Grid) -> np.ndarray:
    """The matrix (4, 4) from the indices (i, j, k, 1) of a voxel to its centre, mm, columns of points."""
    matrix = np.diag([grid.voxel_mm] * 3 + [1.0])
    matrix[:3, 3] = grid.to_mm([0.5, 0.5, 0.5])
    return matrix


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Write a mesh as a binary PLY file, atomically. vertices (V, 3), faces (F, 3) whole numbers."""
    head = (
        f"ply\nformat binary_little_endian 1.0\ncomment Strandscope, mm\nelement vertex {len(vertices)}\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    with atomic(path) as part:
        part.write_bytes(head.encode() + np.asarray(vertices, "<f4").tobytes() + rows.tobytes())
