"""The paper's hair for where no camera sees: directions carried inwards from the captured hair, and strands along them (sec. 4.3).

The tangents of the captured hair are averaged in voxels and extrapolated by Laplace's equation, one component at a
time. Strands start where the hull holds more hair than was captured, follow the directions both ways to the bounds of
the volume by the midpoint method, and are kept where they stay inside the hull. All is decided by the seed and the
number of the strand, so the result does not depend on the number of threads.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit, prange
from scipy.ndimage import find_objects, gaussian_filter, maximum_filter
from scipy.sparse import csr_array, diags_array, eye_array, kron
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from .errors import StrandscopeError
from .grid import Grid
from .laplace import KNOWN, OUTSIDE, UNKNOWN, laplace_fill
from .progress import Progress, silent


@dataclass(frozen=True)
class AdvectionParams:
    """Parameters of the field and of strands along it."""

    count: int | None = None  # strands to add; None: as many as fill the hull as densely as the captured hair fills its own part
    step_mm: float = 0.1  # of the advection and between points
    seed: int = 0
    min_mean_density: float = 0.8  # mean fractional density along a strand, below which it is dropped
    density_blur_mm: float = 0.5  # standard deviation of the blur of the captured hair's density
    full_quantile: float = 0.85  # of the captured density where there is captured hair: what counts as full
    margin_mm: float = 2.0  # directions are solved for that far around the hull and the captured hair
    cycles: int = 12  # V-cycles of ``laplace_fill`` at most
    tolerance: float = 1e-5  # of a component of the direction: the largest residual at which the solver stops
    max_failures: int = 20  # strands tried for each one wanted
    max_diagonals: float = 6.0  # longest strand, in diagonals of the grid, so that a closed loop ends


class Advected(NamedTuple):
    """M strands of N points, and how many were tried."""

    points_mm: np.ndarray  # (N, 3) float32, object frame
    offsets: np.ndarray  # (M + 1,) int64
    radius_mm: np.ndarray  # (N,) float32
    accepted: int
    rejected: int  # tried, and left the hull too far, or had no direction


def advect(
    points_mm: np.ndarray,
    offsets: np.ndarray,
    radii_mm: np.ndarray,
    occupancy: np.ndarray,
    grid: Grid,
    params: AdvectionParams | None = None,
    progress: Progress = silent,
) -> Advected:
    """Strands for the part of the hull that captured curves leave empty (sec. 4.3).

    points_mm (N, 3), offsets (M + 1,): captured curves; radii_mm: (M,) of curves or (N,) of points; occupancy
    (nx, ny, nz), 0…1, of ``hull.occupancy``. A strand takes the mean radius of a captured curve drawn at random.
    Raises StrandscopeError without captured curves, with an occupancy that is 0 everywhere, and for wrong shapes.
    """
    params = params or AdvectionParams()
    points, offsets, radii = _curves(points_mm, offsets, radii_mm)
    grid.check(occupancy, "the occupancy")
    if not np.any(occupancy > 0.5):
        raise StrandscopeError("infill: the occupancy is below 0.5 everywhere; expected a hull with an inside (look at the blueness threshold)")
    progress("directions", 0, 1)
    field = direction_field(points, offsets, grid, occupancy, params)
    progress("directions", 1, 1)
    captured = captured_density(points, offsets, grid)
    missing = missing_density(captured, occupancy, grid, params)
    wanted_mm = float(missing.sum()) * grid.voxel_mm**3
    if params.count == 0 or (params.count is None and wanted_mm <= 0):
        return Advected(np.empty((0, 3), np.float32), np.zeros(1, np.int64), np.empty(0, np.float32), 0, 0)
    if not np.any(missing > 0):
        missing = occupancy
    return _grow_until(wanted_mm, missing, field, np.ascontiguousarray(occupancy, np.float32), radii, grid, params, progress)


def _curves(points_mm, offsets, radii_mm):
    """Contiguous arrays: points (N, 3) float64, offsets (M + 1,) int64, mean radius (M,) of each curve."""
    points, offsets, radii = np.ascontiguousarray(points_mm, np.float64), np.ascontiguousarray(offsets, np.int64), np.asarray(radii_mm, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or offsets.ndim != 1 or len(offsets) < 2:
        raise StrandscopeError(f"infill: no captured curves (points {points.shape}, offsets {offsets.shape}); expected at least one to follow")
    if offsets[0] != 0 or offsets[-1] != len(points) or np.any(np.diff(offsets) < 2):
        raise StrandscopeError(f"infill: offsets do not fit {len(points)} points; expected 0 … {len(points)}, each curve with at least 2 points")
    if radii.shape not in ((len(points),), (len(offsets) - 1,)):
        raise StrandscopeError(f"infill: radii have shape {radii.shape}; expected one a point ({len(points)},) or a curve ({len(offsets) - 1},)")
    if len(radii) == len(points):
        radii = np.add.reduceat(radii, offsets[:-1]) / np.diff(offsets)
    return points, offsets, radii


# ---- densities -------------------------------------------------------------------------------------------------------


def captured_density(points_mm: np.ndarray, offsets: np.ndarray, grid: Grid) -> np.ndarray:
    """Length of captured hair per volume, (nx, ny, nz) float32 in mm/mm³, which is fibers per mm² across the hair."""
    cells, _, lengths = _pieces(points_mm, offsets, grid)
    density = np.bincount(cells, lengths, minlength=int(np.prod(grid.shape))).reshape(grid.shape)
    return (density / grid.voxel_mm**3).astype(np.float32)


def missing_density(captured: np.ndarray, occupancy: np.ndarray, grid: Grid, params: AdvectionParams | None = None) -> np.ndarray:
    """Hair that the hull should hold and the captured curves lack, (nx, ny, nz) float32 in mm/mm³, nowhere below 0.

    Full is a high quantile of the captured density inside the hull: where the cameras see well they capture nearly all.
    """
    params = params or AdvectionParams()
    sigma = params.density_blur_mm / grid.voxel_mm
    inside = np.asarray(occupancy, np.float32)
    blurred = gaussian_filter(captured, sigma, mode="constant")
    share = gaussian_filter((inside > 0.5).astype(np.float32), sigma, mode="constant")  # of the blur that lies in the hull
    local = blurred / np.maximum(share, 0.2)
    seen = local[(inside > 0.5) & (local > 0)]
    full = np.quantile(seen, params.full_quantile) if len(seen) else 0.0
    return np.maximum(full * inside - np.minimum(local, full) * (inside > 0), 0.0).astype(np.float32)


def _pieces(points_mm, offsets, grid):
    """Curves cut into pieces of at most half a voxel: voxel (K,) int64, curve (K,) int64, length (K,) mm; inside only."""
    cells, curves, lengths, _ = _cut(points_mm, offsets, np.asarray(grid.origin_mm), grid.voxel_mm, np.asarray(grid.shape))
    return cells, curves, lengths


@njit(cache=True, nogil=True)
def _cut(points, offsets, origin, voxel, shape):
    total = 0
    for c in range(len(offsets) - 1):
        for n in range(offsets[c], offsets[c + 1] - 1):
            total += max(1, int(np.ceil(np.sqrt(np.sum((points[n + 1] - points[n]) ** 2)) / (0.5 * voxel))))
    cells, curves = np.empty(total, np.int64), np.empty(total, np.int64)
    lengths, tangents = np.empty(total), np.empty((total, 3))
    found = 0
    for c in range(len(offsets) - 1):
        for n in range(offsets[c], offsets[c + 1] - 1):
            edge = points[n + 1] - points[n]
            length = np.sqrt(np.sum(edge**2))
            if length == 0.0:
                continue
            parts = max(1, int(np.ceil(length / (0.5 * voxel))))
            for part in range(parts):
                place = (points[n] + edge * ((part + 0.5) / parts) - origin) / voxel
                i, j, k = int(np.floor(place[0])), int(np.floor(place[1])), int(np.floor(place[2]))
                if 0 <= i < shape[0] and 0 <= j < shape[1] and 0 <= k < shape[2]:
                    cells[found] = (i * shape[1] + j) * shape[2] + k
                    curves[found] = c
                    lengths[found] = length / parts
                    tangents[found] = edge / length
                    found += 1
    return cells[:found], curves[:found], lengths[:found], tangents[:found]


# ---- directions ------------------------------------------------------------------------------------------------------


def direction_field(
    points_mm: np.ndarray, offsets: np.ndarray, grid: Grid, occupancy: np.ndarray | None = None, params: AdvectionParams | None = None
) -> np.ndarray:
    """Directions (nx, ny, nz, 3) float32: average tangents of captured curves, extrapolated into empty voxels (sec. 4.3).

    A voxel with hair gets the main direction of its tangents (the first eigenvector of Σ t tᵀ, for which a hair has
    neither head nor tail), headed as most of its curves are once these agree with their neighbours; it has length 1. The
    others are solved for, within margin_mm of the hair and of the hull (0 beyond); where sides disagree they are shorter.
    """
    params = params or AdvectionParams()
    points, offsets = np.ascontiguousarray(points_mm, np.float64), np.ascontiguousarray(offsets, np.int64)
    cells, curves, lengths, tangents = _cut(points, offsets, np.asarray(grid.origin_mm), grid.voxel_mm, np.asarray(grid.shape))
    if not len(cells):
        raise StrandscopeError("infill: no captured curve runs through the volume; expected some to take directions from")
    headed = tangents * curve_signs(points, offsets, grid)[curves][:, None]
    places, index = np.unique(cells, return_inverse=True)
    field = np.zeros((*grid.shape, 3), np.float32)
    field.reshape(-1, 3)[places] = _main_directions(index, len(places), headed, lengths)
    kinds = np.full(grid.shape, UNKNOWN, np.uint8)
    kinds.ravel()[places] = KNOWN
    near = kinds == KNOWN
    if occupancy is not None:
        near |= grid.check(occupancy, "the occupancy") > 0.0
    kinds[maximum_filter(near, 2 * int(np.ceil(params.margin_mm / grid.voxel_mm)) + 1) == 0] = OUTSIDE
    box = find_objects((kinds != OUTSIDE).view(np.int8))[0]
    field[box] = laplace_fill(field[box], kinds[box], params.cycles, params.tolerance)
    return field


def _main_directions(index, count, tangents, lengths):
    """First eigenvector of Σ t tᵀ of the tangents (K, 3) in each of count voxels, headed as Σ t. index (K,) -> (count, 3)."""
    tensors, sums = np.empty((count, 3, 3)), np.empty((count, 3))
    for a in range(3):
        sums[:, a] = np.bincount(index, lengths * tangents[:, a], count)
        for b in range(a, 3):
            tensors[:, a, b] = tensors[:, b, a] = np.bincount(index, lengths * tangents[:, a] * tangents[:, b], count)
    main = np.linalg.eigh(tensors)[1][:, :, 2]
    return main * np.where(np.sum(main * sums, axis=1) < 0, -1.0, 1.0)[:, None]


def curve_signs(points_mm: np.ndarray, offsets: np.ndarray, grid: Grid, reach_mm: float = 1.0) -> np.ndarray:
    """+1 or −1 (M,) for each curve, so that neighbouring curves run the same way, and all of them on the whole down, −y.

    Along a curve the heading is sure, also through curls; only whole curves are turned. Two curves are compared by the
    sum of products of their tangents where they pass the same cell of reach_mm, or at half weight cells that share a
    face. The surest comparisons decide first: a spanning tree of the largest sums carries the heading on.
    """
    points, offsets = np.ascontiguousarray(points_mm, np.float64), np.ascontiguousarray(offsets, np.int64)
    coarse = Grid.around(grid.origin_mm, grid.high_mm, max(reach_mm, grid.voxel_mm))
    cells, curves, lengths, tangents = _cut(points, offsets, np.asarray(coarse.origin_mm), coarse.voxel_mm, np.asarray(coarse.shape))
    count = len(offsets) - 1
    columns = (3 * cells[:, None] + np.arange(3)).ravel()
    passed = csr_array(((lengths[:, None] * tangents).ravel(), (np.repeat(curves, 3), columns)), (count, 3 * int(np.prod(coarse.shape))))
    alike = (passed @ _touching(coarse.shape) @ passed.T).tocsr()
    alike.eliminate_zeros()
    tree = alike.copy()
    tree.data = -np.abs(tree.data)
    tree = minimum_spanning_tree(tree)
    signs = np.ones(count)
    rises = points[offsets[1:] - 1, 1] - points[offsets[:-1], 1]
    _, groups = connected_components(tree, directed=False)
    for first in np.unique(groups, return_index=True)[1]:
        order, parents = breadth_first_order(tree, first, directed=False)
        for curve in order[1:]:
            signs[curve] = signs[parents[curve]] * np.sign(alike[curve, parents[curve]])
        if np.sum(signs[order] * rises[order]) > 0:
            signs[order] *= -1
    return signs


def _touching(shape):
    """Sparse (3 n, 3 n) of the n cells' three components: 1 for a cell itself, ½ for those that share a face with it."""
    lines = [diags_array([np.full(max(n - 1, 0), 0.5)] * 2, offsets=[-1, 1], shape=(n, n)) for n in shape]
    ones = [eye_array(n) for n in shape]
    faces = sum(kron(kron(lines[a] if a == 0 else ones[0], lines[1] if a == 1 else ones[1]), lines[2] if a == 2 else ones[2]) for a in range(3))
    return kron(faces + eye_array(int(np.prod(shape))), eye_array(3)).tocsr()


# ---- advection -------------------------------------------------------------------------------------------------------


def _grow_until(wanted_mm, density, field, occupancy, radii, grid, params, progress) -> Advected:
    """Try strands, a batch at a time, until enough (count, else wanted_mm of length) are accepted or the tries are used up."""
    by_count = params.count is not None
    wanted = float(params.count) if by_count else wanted_mm
    diagonal_mm = float(np.linalg.norm(grid.high_mm - grid.origin_mm))
    guess = int(np.ceil(wanted if by_count else wanted / diagonal_mm))
    flat = np.flatnonzero(density > 0)
    sampling = params.seed, flat, np.cumsum(density.ravel()[flat], dtype=np.float64), np.asarray(grid.shape)
    most_steps = max(int(params.max_diagonals * diagonal_mm / params.step_mm), 2)
    course = field, np.asarray(grid.origin_mm), grid.voxel_mm, params.step_mm, most_steps
    numbers, sizes, done, tried = [np.empty(0, np.int64)], [np.empty((0, 2), np.int64)], 0.0, 0
    while done < wanted and tried < guess * params.max_failures:
        batch = np.arange(tried, tried + max(guess // 2, 64))
        steps, mean = _try(batch, *sampling, *course, occupancy)
        good = (mean >= params.min_mean_density) & (steps.sum(axis=1) > 0)
        gain = np.cumsum(np.where(good, 1.0 if by_count else steps.sum(axis=1) * params.step_mm, 0.0))
        used = min(int(np.searchsorted(gain, wanted - done)) + 1, len(batch))
        numbers.append(batch[:used][good[:used]])
        sizes.append(steps[:used][good[:used]])
        done += float(gain[used - 1])
        tried += used
        progress("infill", min(done, wanted), wanted)
    numbers, sizes = np.concatenate(numbers), np.concatenate(sizes)
    offsets = np.concatenate([[0], np.cumsum(sizes.sum(axis=1) + 1)]).astype(np.int64)
    points = np.empty((offsets[-1], 3), np.float32)
    _write(numbers, *sampling, *course, sizes, offsets, points)
    chosen = radii[_draw(params.seed, numbers, len(radii))]
    return Advected(points, offsets, np.repeat(chosen, np.diff(offsets)).astype(np.float32), len(numbers), tried - len(numbers))


@njit(cache=True, nogil=True)
def uniform(seed, number, which):
    """A number of [0, 1) for the which-th draw of a strand: splitmix64 of seed, strand and draw."""
    state = np.uint64(seed) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(number) * np.uint64(0xD1B54A32D192ED03) + np.uint64(which + 1)
    for _ in range(2):
        state += np.uint64(0x9E3779B97F4A7C15)
        state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        state ^= state >> np.uint64(31)
    return (state >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@njit(cache=True, nogil=True)
def _draw(seed, numbers, size):
    """For each strand one of 0 … size − 1."""
    return np.array([int(uniform(seed, number, 4) * size) for number in numbers], np.int64)


@njit(cache=True, nogil=True)
def _start_of(number, seed, flat, cumulative, shape):
    """Where strand ``number`` starts, (3,) in cell units: a voxel by its density, a place in it evenly."""
    index = min(np.searchsorted(cumulative, uniform(seed, number, 0) * cumulative[-1], side="right"), len(flat) - 1)
    cell = flat[index]
    i, j, k = cell // (shape[1] * shape[2]), cell // shape[2] % shape[1], cell % shape[2]
    return i + uniform(seed, number, 1), j + uniform(seed, number, 2), k + uniform(seed, number, 3)


@njit(cache=True, nogil=True, parallel=True)
def _try(numbers, seed, flat, cumulative, shape, field, origin, voxel, step_mm, most_steps, occupancy):
    """Steps ahead and behind (n, 2) and the mean density along each strand (n,)."""
    steps, mean = np.zeros((len(numbers), 2), np.int64), np.zeros(len(numbers))
    nothing = np.empty((0, 3), np.float32)
    for n in prange(len(numbers)):
        x, y, z = _start_of(numbers[n], seed, flat, cumulative, shape)
        total = _sample(occupancy, x, y, z)
        for side in range(2):
            steps[n, side], passed = _follow(x, y, z, 1.0 - 2.0 * side, field, occupancy, step_mm / voxel, most_steps, nothing, 0, 0, origin, voxel)
            total += passed
        mean[n] = total / (1 + steps[n, 0] + steps[n, 1])
    return steps, mean


@njit(cache=True, nogil=True, parallel=True)
def _write(numbers, seed, flat, cumulative, shape, field, origin, voxel, step_mm, most_steps, steps, offsets, points):
    no_density = np.zeros((1, 1, 1), np.float32)
    for n in prange(len(numbers)):
        x, y, z = _start_of(numbers[n], seed, flat, cumulative, shape)
        middle = offsets[n] + steps[n, 1]
        points[middle, 0], points[middle, 1], points[middle, 2] = origin[0] + x * voxel, origin[1] + y * voxel, origin[2] + z * voxel
        _follow(x, y, z, 1.0, field, no_density, step_mm / voxel, most_steps, points, middle, 1, origin, voxel)
        _follow(x, y, z, -1.0, field, no_density, step_mm / voxel, most_steps, points, middle, -1, origin, voxel)


@njit(cache=True, nogil=True)
def _follow(x, y, z, heading, field, density, step, most_steps, points, at, stride, origin, voxel):
    """Midpoint steps from (x, y, z) in cell units until the next leaves the grid or has no direction.

    Returns their number and the sum of densities where they end; with a stride, each end is written to points, in mm.
    """
    nx, ny, nz, _ = field.shape
    i, j, k = int(x), int(y), int(z)
    tx, ty, tz = heading * field[i, j, k, 0], heading * field[i, j, k, 1], heading * field[i, j, k, 2]
    total = 0.0
    for count in range(most_steps):
        tx, ty, tz, sure = _direction(field, x, y, z, tx, ty, tz)
        if not sure:
            return count, total
        tx, ty, tz, sure = _direction(field, x + 0.5 * step * tx, y + 0.5 * step * ty, z + 0.5 * step * tz, tx, ty, tz)
        if not sure:
            return count, total
        x, y, z = x + step * tx, y + step * ty, z + step * tz
        if not (0.0 <= x < nx and 0.0 <= y < ny and 0.0 <= z < nz):
            return count, total
        total += _sample(density, x, y, z)
        if stride != 0:
            at += stride
            points[at, 0], points[at, 1], points[at, 2] = origin[0] + x * voxel, origin[1] + y * voxel, origin[2] + z * voxel
    return most_steps, total


@njit(cache=True, nogil=True)
def _corner(x, size):
    """The two cells whose centres lie around x, and the share of the second; beyond the outer centres the outer cell."""
    low = min(max(int(np.floor(x - 0.5)), 0), size - 1)
    return low, min(low + 1, size - 1), min(max(x - 0.5 - low, 0.0), 1.0)


@njit(cache=True, nogil=True)
def _direction(field, x, y, z, tx, ty, tz):
    """Unit direction at (x, y, z), trilinear, each of the eight turned to go with (tx, ty, tz) first; and whether there is one."""
    nx, ny, nz, _ = field.shape
    i0, i1, a = _corner(x, nx)
    j0, j1, b = _corner(y, ny)
    k0, k1, c = _corner(z, nz)
    sx, sy, sz = 0.0, 0.0, 0.0
    for corner in range(8):
        vector = field[i1 if corner & 4 else i0, j1 if corner & 2 else j0, k1 if corner & 1 else k0]
        weight = (a if corner & 4 else 1.0 - a) * (b if corner & 2 else 1.0 - b) * (c if corner & 1 else 1.0 - c)
        if vector[0] * tx + vector[1] * ty + vector[2] * tz < 0.0:
            weight = -weight
        sx += weight * vector[0]
        sy += weight * vector[1]
        sz += weight * vector[2]
    size = np.sqrt(sx * sx + sy * sy + sz * sz)
    if size < 1e-6:
        return tx, ty, tz, False
    return sx / size, sy / size, sz / size, True


@njit(cache=True, nogil=True)
def _sample(volume, x, y, z):
    """Trilinear value of a volume (nx, ny, nz) at (x, y, z) in cell units."""
    nx, ny, nz = volume.shape
    i0, i1, a = _corner(x, nx)
    j0, j1, b = _corner(y, ny)
    k0, k1, c = _corner(z, nz)
    near = (volume[i0, j0, k0] * (1 - c) + volume[i0, j0, k1] * c) * (1 - b) + (volume[i0, j1, k0] * (1 - c) + volume[i0, j1, k1] * c) * b
    far = (volume[i1, j0, k0] * (1 - c) + volume[i1, j0, k1] * c) * (1 - b) + (volume[i1, j1, k0] * (1 - c) + volume[i1, j1, k1] * c) * b
    return near * (1 - a) + far * a
