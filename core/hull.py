"""Where the hair is: visual hull, space carving and their combination (Jakob et al. 2009, sec. 4.3).

Two volumes say where no hair can be. The visual hull: a photograph as blue as the board at a point in focus shows that
the point is empty. Space carving: a feature could only be seen because little lies between it and the camera. The hull
sees empty space that no feature lies behind, the carving sees into hollows that the hull closes; a voxel is taken as
occupied where neither says that it is empty.

The photographs come in as pictures of relative blueness, one number a block of pixels, made once by ``blueness`` while
a photograph is decoded anyway. Relative means: a share of the light, so that neither lamp nor exposure matters.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numba import get_num_threads, njit, prange
from scipy.ndimage import gaussian_filter

from .capture import Sweep
from .errors import StrandscopeError
from .geometry import Optics, project, to_image, to_pixel, turn, turn_back
from .grid import Grid

_turn, _turn_back, _project, _to_pixel = njit(turn), njit(turn_back), njit(project), njit(to_pixel)
_BLUENESS_STEPS = 255.0  # a relative blueness of 0…1 as uint8
_LEAST_CONTRAST = 0.06  # of relative blueness between board and hair
_DARK_CORE = 0.05  # rays in the core of dense hair, as a share of those in the open
_MAX_TRACING_PARTS = 4  # each part counts its rays in a volume of its own


@dataclass(frozen=True)
class HullParams:
    """Parameters of the hull, the carving and their combination."""

    voxel_mm: float = 0.2  # edge of a voxel
    block_px: int = 8  # pixels of the channel plane that become one number of blueness, each way
    dark: float = 0.005  # of white level: what makes the blueness of a pixel without light 0 and not noise
    empty_blueness: float | None = None  # relative blueness from which a voxel is empty; None: found from the images
    empty_share: float = 0.65  # where that lies when found: 0 the hair's blueness, 1 the board's
    thicken_mm: float = 0.3  # a voxel this near to one that the hull keeps is kept: a fiber is thinner than a block
    empty_rays: float | None = None  # rays through a voxel from which it is empty; None: found from the counts
    clearance_mm: float = 1.2  # a ray says nothing this near its feature, the paper's depth of field (the paper: 0)
    min_views: float = 0.5  # share of the sweeps that must have a voxel in focus, else nothing is said and it is empty
    blur_mm: float = 0.4  # standard deviation of the blur that makes fractional densities


def grid_of(optics: Optics, image_shape: tuple[int, int], sweeps: Iterable[Sweep], voxel_mm: float) -> Grid:
    """The box about the captured volume: the cylinder about the turntable's axis that the sweeps together see in focus.

    image_shape: rows and columns of a channel plane. A point at radius r is in the picture and in the sweep at some
    angle where |u| and |d| reach r. Raises StrandscopeError without sweeps.
    """
    rows, cols = image_shape
    left, top = to_image(-0.5, -0.5, optics.pitch_mm, optics.axis_col_px, optics.axis_row_px)
    right, bottom = to_image(cols - 0.5, rows - 0.5, optics.pitch_mm, optics.axis_col_px, optics.axis_row_px)
    reach = [np.abs(sweep.positions_mm).max() for sweep in sweeps]
    if not reach:
        raise StrandscopeError("the capture has no positions of the camera; expected sweeps of photographs")
    radius = min(max(-left, right), min(reach))
    return Grid.around((-radius, bottom, -radius), (radius, top, radius), voxel_mm)


# ---- blueness --------------------------------------------------------------------------------------------------------


def blueness(planes: np.ndarray, params: HullParams | None = None) -> np.ndarray:
    """Relative blueness B / (R + G + B) of blocks of one photograph: planes (3, H, W) float32 -> (h, w) uint8, 255 = 1.

    Block (i, j) is the mean of block_px × block_px pixels, less at the lower and right border. A small constant in the
    denominator lets the blueness fall to 0 in the dark: what sends no light is no evidence of the board.
    """
    params = params or HullParams()
    if planes.ndim != 3 or planes.shape[0] != 3:
        raise StrandscopeError(f"a photograph has planes of shape {planes.shape}; expected (3, rows, columns) of R, G, B")
    _, rows, cols = planes.shape
    out = np.empty((-(-rows // params.block_px), -(-cols // params.block_px)), np.uint8)
    _blueness(planes, params.block_px, np.float32(params.dark), out)
    return out


@njit(cache=True, nogil=True)
def _blueness(planes, block, dark, out):  # bound by reading planes: rows are added up first, which vectorises
    _, rows, cols = planes.shape
    lines = np.empty((3, cols), np.float32)
    for i in range(out.shape[0]):
        last = min((i + 1) * block, rows)
        for c in range(3):
            lines[c] = planes[c, i * block]
            for row in range(i * block + 1, last):
                lines[c] += planes[c, row]
        for j in range(out.shape[1]):
            end = min((j + 1) * block, cols)
            red, green, blue = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for col in range(j * block, end):
                red += lines[0, col]
                green += lines[1, col]
                blue += lines[2, col]
            pixels = (last - i * block) * (end - j * block)
            red, green, blue = max(red, np.float32(0.0)), max(green, np.float32(0.0)), max(blue, np.float32(0.0))
            share = blue / (red + green + blue + dark * pixels)
            out[i, j] = np.uint8(min(share * _BLUENESS_STEPS + 0.5, _BLUENESS_STEPS)) if share > 0 else np.uint8(0)


# ---- visual hull -----------------------------------------------------------------------------------------------------


def visual_hull(sweeps: Iterable, optics: Optics, grid: Grid, params: HullParams | None = None) -> np.ndarray:
    """Highest relative blueness at each voxel while it was in focus: (nx, ny, nz) float32, NaN where seldom in focus.

    sweeps: (angle_deg, positions_mm (n,), stack (n, h, w) uint8 of ``blueness``) each. Only the photograph nearest in
    focus speaks about a voxel: the light came through a wide cone, so nothing is said along the ray (sec. 4.3). A voxel
    that less than min_views of the sweeps have in focus and in the picture is NaN.
    Raises StrandscopeError for a stack that does not fit its positions, and without sweeps.
    """
    params = params or HullParams()
    highest = np.zeros(grid.shape, np.float32)
    views = np.zeros(grid.shape, np.uint16)
    count = 0
    for angle_deg, positions_mm, stack in sweeps:
        positions, stack = np.asarray(positions_mm, np.float64), np.asarray(stack)
        if stack.ndim != 3 or stack.dtype != np.uint8 or len(stack) != len(positions) or not len(stack):
            raise StrandscopeError(
                f"sweep at {angle_deg:g}°: the blueness has shape {stack.shape} of {stack.dtype}, positions {len(positions)}; "
                "expected (positions, h, w) of uint8"
            )
        order = np.argsort(positions, kind="stable").astype(np.int64)
        _see(stack, positions[order], order, np.radians(angle_deg), _optics(optics), params.block_px, *_cells(grid), highest, views)
        count += 1
    if not count:
        raise StrandscopeError("the visual hull has no sweeps to look at; expected at least one")
    highest[views < max(params.min_views * count, 1)] = np.nan
    return highest


@njit(cache=True, nogil=True, parallel=True)
def _see(stack, positions, order, theta, optics, block, origin, voxel, highest, views):
    """One sweep's evidence: bilinear in the picture of the frame nearest to the voxel's w. Bound by reading the stack."""
    lens, pitch, axis_col, axis_row = optics
    cos, sin = np.cos(theta), np.sin(theta)
    nx, ny, nz = highest.shape
    n, h, w = stack.shape
    reach = 0.5 * (positions[-1] - positions[0]) / (n - 1) if n > 1 else voxel  # the ends of a sweep see half a step further
    reach += 1e-9
    for i in prange(nx):
        x = origin[0] + (i + 0.5) * voxel
        for k in range(nz):
            z = origin[2] + (k + 0.5) * voxel
            u, _, depth = _turn(x, 0.0, z, cos, sin)
            if depth < positions[0] - reach or depth > positions[-1] + reach:
                continue
            frame = min(np.searchsorted(positions, depth), n - 1)
            if frame > 0 and depth - positions[frame - 1] < positions[frame] - depth:
                frame -= 1
            picture, focus = stack[order[frame]], positions[frame]
            image_u, per_mm = _project(u, 1.0, depth, focus, lens)
            col = (_to_pixel(image_u, 0.0, pitch, axis_col, axis_row)[0] - 0.5 * (block - 1)) / block
            if col < -0.5 or col > w - 0.5:
                continue
            left = min(max(int(np.floor(col)), 0), max(w - 2, 0))
            right = min(left + 1, w - 1)
            share_x = min(max(col - left, 0.0), 1.0)
            for j in range(ny):
                y = origin[1] + (j + 0.5) * voxel
                row = (_to_pixel(0.0, y * per_mm, pitch, axis_col, axis_row)[1] - 0.5 * (block - 1)) / block
                if row < -0.5 or row > h - 0.5:
                    continue
                top = min(max(int(np.floor(row)), 0), max(h - 2, 0))
                below = min(top + 1, h - 1)
                share_y = min(max(row - top, 0.0), 1.0)
                upper = picture[top, left] * (1.0 - share_x) + picture[top, right] * share_x
                lower = picture[below, left] * (1.0 - share_x) + picture[below, right] * share_x
                value = (upper * (1.0 - share_y) + lower * share_y) / 255.0
                highest[i, j, k] = max(highest[i, j, k], np.float32(value))
                views[i, j, k] += 1


def _optics(optics: Optics) -> tuple[float, float, float, float]:
    return optics.working_distance_mm, optics.pitch_mm, optics.axis_col_px, optics.axis_row_px


def _cells(grid: Grid) -> tuple[np.ndarray, float]:
    return np.asarray(grid.origin_mm, np.float64), grid.voxel_mm


# ---- space carving ---------------------------------------------------------------------------------------------------


def carve(features: Iterable, optics: Optics, grid: Grid, params: HullParams | None = None) -> np.ndarray:
    """How many features were seen through each voxel: (nx, ny, nz) uint32 (sec. 4.3).

    features: (angle_deg, u_mm, v_mm, d_mm) of each sweep, arrays (n,) each. Each feature's ray runs from its place to
    the lens at w = d + l, and counts once in every voxel that it passes, from clearance_mm before the feature on: a
    fiber is found over the whole depth of field, so a ray from the far end of the chain would carve the fiber itself.
    Features that start in one voxel of one sweep share one ray, from the voxel's centre, with their number as its
    weight. The counts are whole numbers, so they do not depend on the number of threads.
    """
    params = params or HullParams()
    lens_mm, skip = optics.working_distance_mm, params.clearance_mm / optics.working_distance_mm
    parts = max(1, min(get_num_threads(), _MAX_TRACING_PARTS))
    counts = np.zeros((parts, *grid.shape), np.uint32)
    starts = np.zeros(grid.shape, np.uint32)
    for angle_deg, u_mm, v_mm, d_mm in features:
        theta = np.radians(float(angle_deg))
        u, v, d = (np.ascontiguousarray(c, np.float32) for c in (u_mm, v_mm, d_mm))
        if not u.shape == v.shape == d.shape or u.ndim != 1:
            raise StrandscopeError(f"sweep at {angle_deg:g}°: features of shapes {u.shape}, {v.shape}, {d.shape}; expected three of (n,)")
        outside = _gather(u, v, d, np.cos(theta), np.sin(theta), *_cells(grid), starts)
        _trace_outside(u, v, d, outside, np.cos(theta), np.sin(theta), lens_mm, skip, *_cells(grid), counts[0])
        cells = np.flatnonzero(starts)
        _trace_cells(cells, starts.ravel(), np.cos(theta), np.sin(theta), lens_mm, skip, *_cells(grid), counts)
        starts.ravel()[cells] = 0
    for part in counts[1:]:
        counts[0] += part
    return counts[0]


@njit(cache=True, nogil=True)
def _gather(u, v, d, cos, sin, origin, voxel, starts):
    """Add each feature to the count of its voxel; returns the indices of those outside the grid."""
    nx, ny, nz = starts.shape
    outside = np.empty(len(u), np.int64)
    found = 0
    for n in range(len(u)):
        x, y, z = _turn_back(u[n], v[n], d[n], cos, sin)
        i = np.floor((x - origin[0]) / voxel)
        j = np.floor((y - origin[1]) / voxel)
        k = np.floor((z - origin[2]) / voxel)
        if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
            starts[int(i), int(j), int(k)] += np.uint32(1)
        else:
            outside[found] = n
            found += 1
    return outside[:found].copy()


@njit(cache=True, nogil=True)
def _trace_outside(u, v, d, which, cos, sin, lens_mm, skip, origin, voxel, counts):
    for n in which:
        x, y, z = _turn_back(u[n], v[n], d[n], cos, sin)
        lens_x, lens_y, lens_z = _turn_back(0.0, 0.0, d[n] + lens_mm, cos, sin)
        _trace(
            (x - origin[0]) / voxel,
            (y - origin[1]) / voxel,
            (z - origin[2]) / voxel,
            (lens_x - origin[0]) / voxel,
            (lens_y - origin[1]) / voxel,
            (lens_z - origin[2]) / voxel,
            skip,
            np.uint32(1),
            counts,
        )


@njit(cache=True, nogil=True, parallel=True)
def _trace_cells(cells, weights, cos, sin, lens_mm, skip, origin, voxel, counts):  # bound by cache misses in counts
    parts, _, ny, nz = counts.shape
    for part in prange(parts):
        for c in range(part * len(cells) // parts, (part + 1) * len(cells) // parts):
            cell = cells[c]
            i, j, k = cell // (ny * nz) + 0.5, cell // nz % ny + 0.5, cell % nz + 0.5
            _, _, w = _turn(origin[0] + i * voxel, 0.0, origin[2] + k * voxel, cos, sin)
            x, y, z = _turn_back(0.0, 0.0, w + lens_mm, cos, sin)
            _trace(i, j, k, (x - origin[0]) / voxel, (y - origin[1]) / voxel, (z - origin[2]) / voxel, skip, weights[cell], counts[part])


@njit(cache=True, nogil=True)
def _trace(x0, y0, z0, x1, y1, z1, enter, weight, counts):
    """Add weight to every cell that a segment passes beyond the share ``enter`` of it (Amanatides and Woo 1987).

    The ends are in cell units; each cell is counted once.
    """
    nx, ny, nz = counts.shape
    dx, dy, dz = x1 - x0, y1 - y0, z1 - z0
    leave = 1.0
    for start, step, size in ((x0, dx, nx), (y0, dy, ny), (z0, dz, nz)):  # clip to the grid
        if step == 0.0:
            if start < 0.0 or start >= size:
                return
            continue
        near, far = -start / step, (size - start) / step
        enter, leave = max(enter, min(near, far)), min(leave, max(near, far))
    if enter >= leave:
        return
    i = min(max(int(np.floor(x0 + enter * dx)), 0), nx - 1)
    j = min(max(int(np.floor(y0 + enter * dy)), 0), ny - 1)
    k = min(max(int(np.floor(z0 + enter * dz)), 0), nz - 1)
    step_i, step_j, step_k = (1 if dx > 0 else -1), (1 if dy > 0 else -1), (1 if dz > 0 else -1)
    each_x = abs(1.0 / dx) if dx != 0.0 else np.inf
    each_y = abs(1.0 / dy) if dy != 0.0 else np.inf
    each_z = abs(1.0 / dz) if dz != 0.0 else np.inf
    next_x = (i + (dx > 0) - x0) / dx if dx != 0.0 else np.inf
    next_y = (j + (dy > 0) - y0) / dy if dy != 0.0 else np.inf
    next_z = (k + (dz > 0) - z0) / dz if dz != 0.0 else np.inf
    while True:
        counts[i, j, k] += weight
        if next_x <= next_y and next_x <= next_z:
            if next_x >= leave:
                return
            i += step_i
            next_x += each_x
            if i < 0 or i >= nx:
                return
        elif next_y <= next_z:
            if next_y >= leave:
                return
            j += step_j
            next_y += each_y
            if j < 0 or j >= ny:
                return
        else:
            if next_z >= leave:
                return
            k += step_k
            next_z += each_z
            if k < 0 or k >= nz:
                return


# ---- the combination -------------------------------------------------------------------------------------------------


def occupancy(max_blueness: np.ndarray, ray_count: np.ndarray, grid: Grid, params: HullParams | None = None) -> np.ndarray:
    """Fractional density (nx, ny, nz) float32, 0…1, with a smooth edge: carved volume, stencilled by the hull, blurred.

    max_blueness: of ``visual_hull``; ray_count: of ``carve`` (sec. 4.3, Fig. 9). 0.5 is the surface.
    """
    params = params or HullParams()
    hull = hull_inside(max_blueness, grid, params)
    inside = hull & carved_inside(ray_count, hull, grid, params)
    return gaussian_filter(inside.astype(np.float32), params.blur_mm / grid.voxel_mm, mode="nearest", truncate=3.0)


def hull_inside(max_blueness: np.ndarray, grid: Grid, params: HullParams | None = None) -> np.ndarray:
    """Which voxels the visual hull keeps: (nx, ny, nz) bool, nowhere as blue as the board, thickened by thicken_mm."""
    params = params or HullParams()
    grid.check(max_blueness, "the blueness")
    threshold = empty_blueness(max_blueness, params) if params.empty_blueness is None else params.empty_blueness
    inside = max_blueness < threshold  # NaN, never in focus, is not inside
    if params.thicken_mm > 0 and inside.any():
        inside = _thickened(inside, _ball(params.thicken_mm / grid.voxel_mm))
    return inside & np.isfinite(max_blueness)


def _ball(radius: float) -> np.ndarray:
    """Steps (n, 3) to all cells whose centres are at most radius cells away."""
    reach = np.arange(-int(radius + 1), int(radius + 1) + 1)
    steps = np.stack(np.meshgrid(reach, reach, reach, indexing="ij"), axis=-1).reshape(-1, 3)
    return steps[np.sum(steps**2, axis=1) <= (radius + 1e-6) ** 2]


@njit(cache=True, nogil=True, parallel=True)
def _thickened(inside, steps):
    nx, ny, nz = inside.shape
    out = inside.copy()
    for i in prange(nx):
        for j in range(ny):
            for k in range(nz):
                for n in range(len(steps)):
                    if out[i, j, k]:
                        break
                    a, b, c = i + steps[n, 0], j + steps[n, 1], k + steps[n, 2]
                    out[i, j, k] = 0 <= a < nx and 0 <= b < ny and 0 <= c < nz and inside[a, b, c]
    return out


def carved_inside(ray_count: np.ndarray, hull: np.ndarray, grid: Grid, params: HullParams | None = None) -> np.ndarray:
    """Which voxels the carving keeps: (nx, ny, nz) bool, those with few rays through them. hull: of ``hull_inside``."""
    params = params or HullParams()
    grid.check(ray_count, "the ray count")
    return ray_count < (empty_rays(ray_count, hull) if params.empty_rays is None else params.empty_rays)


def empty_blueness(max_blueness: np.ndarray, params: HullParams | None = None) -> float:
    """The relative blueness from which a voxel is empty, between that of the hair and that of the board.

    Otsu's threshold parts the voxels into two kinds, and their medians are the two bluenesses, so that it matters
    little how much board there is beside the hair. Infinite (nothing is empty) where all voxels are as good as alike.
    """
    params = params or HullParams()
    values = max_blueness[np.isfinite(max_blueness)]
    parted = otsu(values)
    if parted is None:
        return np.inf
    hair, board = np.median(values[values < parted]), np.median(values[values >= parted])
    if board - hair < _LEAST_CONTRAST:
        return np.inf
    return float(hair + params.empty_share * (board - hair))


def empty_rays(ray_count: np.ndarray, hull: np.ndarray) -> float:
    """The number of rays from which a voxel is empty, judged by the voxels outside the hull, which are empty for sure.

    Dense hair lets next to no rays into its core: then the voxels inside the hull are of two kinds, dark core and lit
    hollow, and Otsu's threshold parts them. Loose hair lets rays through everywhere: then only a voxel with more rays
    than nine in ten empty ones is taken as empty. Infinite where there is nothing to judge by.
    """
    outside = ray_count[~hull & (ray_count > 0)]
    if not len(outside) or not hull.any():
        return np.inf
    parted = otsu(np.sqrt(ray_count[hull], dtype=np.float32))
    if parted is not None:
        core = ray_count[hull & (ray_count < parted**2)]
        if len(core) and np.mean(core) < _DARK_CORE * np.median(outside):
            return float(parted**2)
    return float(np.quantile(outside, 0.9))


def free_share(ray_count: np.ndarray, open_air: np.ndarray) -> np.ndarray:
    """Rays through each voxel as a share of those that pass where nothing is in the way: (nx, ny, nz) float32.

    ray_count: of ``carve``; open_air (nx, ny, nz) bool: voxels outside the hair. The number of rays depends on how much hair there is to be
    seen and how well it is found; what it is in the open tells how many could have passed.
    """
    outside = ray_count[open_air & (ray_count > 0)]
    return (ray_count / max(float(np.median(outside)) if len(outside) else 0.0, 1.0)).astype(np.float32)


def otsu(values: np.ndarray, bins: int = 256) -> float | None:
    """Otsu's threshold of values (n,): the one with the greatest variance between the two kinds; None if all are equal."""
    if not len(values) or values.min() == values.max():
        return None
    counts, edges = np.histogram(values, bins)
    centres = (edges[:-1] + edges[1:]) / 2
    below, sums = np.cumsum(counts)[:-1], np.cumsum(counts * centres)[:-1]
    above, rest = len(values) - below, np.sum(counts * centres) - sums
    between = below * above * (sums / np.maximum(below, 1) - rest / np.maximum(above, 1)) ** 2
    best = np.flatnonzero(between == between.max())
    return float((edges[best[0] + 1] + edges[best[-1] + 1]) / 2)
