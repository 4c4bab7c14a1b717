"""The paper's fiber growing as it is written (sec. 4.2, Figure 7): the reference that ours is compared with.

From a seed a hair is grown in both directions: each camera gives the mean orientation of its features at the point
(FIND-ORIENTATIONS), the direction that fits them best is taken (SOLVE-DIRECTION), a step is made, and the new point is moved
to where the ribbons of all cameras meet (SOLVE-CORRECTION). Every observation in a box counts the same. A hair that is long
enough is kept, and the observations that it was fitted to are deleted (REMOVE-FEATURES). Seeds are the cells of a grid over
the volume, at any time the one in which most cameras still have features.

What the paper leaves open is a parameter whose comment says so. Two things are done otherwise and give the same: the grid
covers the whole volume, one bit a camera and cell, so that no cube has to travel through it; and features are found through
cells of each camera's own (u, v, d) in place of a kd-tree.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from .features import ANGLE_STEPS, BLOCK_PX, STRIP_PX, USED, Index, cell_range, frames_between, image_of, run_of
from .geometry import slope, to_image, to_pixel, turn, turn_back
from .grow import Grown
from .progress import Progress, silent
from .stops import Stop

_turn, _turn_back, _slope, _to_pixel = njit(turn), njit(turn_back), njit(slope), njit(to_pixel)
CELLS_A_CALL = 256  # seeds looked at between two reports of progress


@dataclass(frozen=True)
class PaperParams:
    """Section 4.2 and Table 1; pixels are those of the channel plane."""

    step_mm: float = 0.1  # h
    cone_deg: float = 1.5  # omega: largest turn in one step
    max_correction_px: float = 0.5  # gamma: largest correction in one step
    box_px: tuple[float, float, float] = (40.0, 30.0, 8.0)  # a_g, a_s, a_t: full extents along the hair, the slope, across
    near_focus_mm: float = 0.1  # a_s of FIND-ORIENTATIONS, full extent
    min_cameras: int = 3  # m: cameras that a step needs
    min_seed_cameras: int = 4  # cameras that a seed needs
    seed_cell_mm: float = 0.2  # width of a cell of the grid; not given
    bridge_mm: float = 0.5  # how far a hair goes on straight unobserved: "briefly"
    min_length_mm: float = 5.0  # of a hair that is kept; "a few centimetres" of its locks, which are five times as tall as a lock of 12 mm
    gate_deg: float = 12.0  # observations turned farther from the hair's image are left out; "can also restrict", width not given
    remove_px: float = 8.0  # extent across of the box in which features are deleted: a_t, that in which they were fitted
    radius_mm: float = 0.04  # given to every hair


class _Box(NamedTuple):
    """PaperParams in mm and radians, as the kernels take it."""

    step: float
    cone_cos: float
    cone_sin: float
    gamma: float
    half: tuple[float, float, float]  # half extents of the box of SOLVE-CORRECTION
    half_near: tuple[float, float, float]  # of FIND-ORIENTATIONS
    half_removed: tuple[float, float, float]  # of REMOVE-FEATURES
    gate_cos: float  # of twice the angle
    min_cameras: int
    min_seed_cameras: int
    bridge: int  # steps
    min_points: int


class _Grid(NamedTuple):
    low: np.ndarray  # (3,) mm, corner of the first cell
    cell: float  # mm
    shape: tuple[int, int, int]


def grow_paper(index: Index, params: PaperParams, progress: Progress = silent) -> Grown:
    """Every hair that the paper's method finds, in the order in which they were found. Uses up ``index.strength``.

    ``evidence`` of a point is the number of cameras that saw it. On one thread, since each hair changes what the next can
    stand on; the same index and parameters give the same curves.
    """
    box, grid = _box(params, index), _grid(index, params.seed_cell_mm)
    masks = np.zeros(grid.shape, np.uint64)
    _raster(index, grid, masks)
    counts = np.bitwise_count(masks).ravel()
    seeds = np.flatnonzero(counts >= box.min_seed_cameras)
    counts = counts[seeds].astype(np.int64)
    room = 2 * int(10 * index.rows * index.pitch / box.step) + 1  # ten times the height of the image, in either direction
    points, evidence, stops = np.empty((room, 3)), np.empty(room, np.float32), np.zeros(2, np.uint8)
    curves, tried = [], 0
    for level in range(counts.max(initial=0), box.min_seed_cameras - 1, -1):
        chosen, at = np.flatnonzero(counts == level), 0
        while at < len(chosen):
            at, begin, end, grown = _next_hair(index, grid, seeds, counts, chosen, at, level, box, points, evidence, stops)
            tried += grown
            if end > begin:
                curves.append((points[begin:end].copy(), evidence[begin:end].copy(), stops.copy()))
            progress("growing", len(seeds) - int(np.count_nonzero(counts)), len(seeds))
    progress("growing", len(seeds), len(seeds))
    offsets = np.concatenate([[0], np.cumsum([len(p) for p, _, _ in curves])]).astype(np.int64)
    found, seen, ends = (np.concatenate([c[i].reshape(-1, *shape) for c in curves] or [np.zeros((0, *shape))])
                         for i, shape in enumerate([(3,), (), (2,)]))  # fmt: skip
    return Grown(found.astype(np.float32), offsets, seen.astype(np.float32), ends.astype(np.uint8), tried)


def _box(params: PaperParams, index: Index) -> _Box:
    along, ahead, across = (0.5 * px * index.pitch for px in params.box_px)
    cone = np.radians(params.cone_deg)
    return _Box(
        step=params.step_mm,
        cone_cos=float(np.cos(cone)),
        cone_sin=float(np.sin(cone)),
        gamma=params.max_correction_px * index.pitch,
        half=(along, ahead, across),
        half_near=(along, 0.5 * params.near_focus_mm, across),
        half_removed=(along, ahead, 0.5 * params.remove_px * index.pitch),
        gate_cos=float(np.cos(2 * np.radians(min(params.gate_deg, 90.0)))),
        min_cameras=params.min_cameras,
        min_seed_cameras=params.min_seed_cameras,
        bridge=round(params.bridge_mm / params.step_mm),
        min_points=round(params.min_length_mm / params.step_mm) + 1,
    )


# ---- observations near a point of a hair -----------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _sees(index, k, u, v, w):
    """Whether the point (u, v, w) of camera k's frame comes into focus inside its photographs."""
    positions = index.positions[index.first_position[k] : index.first_position[k + 1]]
    col, row = _to_pixel(u, v, index.pitch, index.axis_col, index.axis_row)
    return positions[0] <= w <= positions[-1] and 0 <= col <= index.columns - 1 and 0 <= row <= index.rows - 1


@njit(cache=True, nogil=True)
def _axes(index, k, p, g):
    """A point p (3,) and the axes g, s, t of its box in camera k's frame, as rows of (4, 3): s is the slope of the ribbon
    made perpendicular to g, t the normal of both."""
    axes = np.empty((4, 3))
    axes[0] = _turn(p[0], p[1], p[2], index.cos[k], index.sin[k])
    axes[1] = _turn(g[0], g[1], g[2], index.cos[k], index.sin[k])
    axes[2] = _slope(axes[0, 0], axes[0, 1], index.distance)
    axes[2] -= np.sum(axes[1] * axes[2]) * axes[1]
    axes[2] /= np.sqrt(np.sum(axes[2] ** 2)) + 1e-12
    axes[3] = np.cross(axes[1], axes[2])
    return axes


@njit(cache=True, nogil=True)
def _in_box(index, k, axes, half, gate_cos, take):
    """Camera k's observations in a box: (number, sum of their places across in mm, sums of cos and sin of twice their
    angles). With ``take`` they are deleted. Bound by cache misses: a few dozen runs of 8-byte features."""
    reach_u, reach_v, reach_w = np.abs(axes[1]) * half[0] + np.abs(axes[2]) * half[1] + np.abs(axes[3]) * half[2]
    first_frame, last_frame = frames_between(index, k, axes[0, 2] - reach_w, axes[0, 2] + reach_w)
    count, offset, re, im = 0, 0.0, 0.0, 0.0
    if first_frame == last_frame:
        return count, offset, re, im
    # how the image of the point moves as it slides along the hair: (g_u + u/l g_w, g_v + v/l g_w), and twice its angle
    du = axes[1, 0] + axes[0, 0] / index.distance * axes[1, 2]
    dv = axes[1, 1] + axes[0, 1] / index.distance * axes[1, 2]
    size = du * du + dv * dv + 1e-12
    cos2, sin2 = (du * du - dv * dv) / size, 2 * du * dv / size
    positions = index.positions[index.first_position[k] :]
    s0, s1, b0, b1 = cell_range(index, axes[0, 0], axes[0, 1], reach_u, reach_v)
    for strip in range(s0, s1):
        for block in range(b0, b1):
            start, stop = run_of(index, k, strip, block, first_frame, last_frame)
            for i in range(start, stop):
                u, v = image_of(index, i, strip, block)
                x, y, z = u - axes[0, 0], v - axes[0, 1], positions[index.frame[i]] - axes[0, 2]
                across = axes[3, 0] * x + axes[3, 1] * y + axes[3, 2] * z
                if abs(across) > half[2] or index.strength[i] >= USED:
                    continue
                if abs(axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z) > half[0]:
                    continue
                if abs(axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z) > half[1]:
                    continue
                double = index.angle[i] * (2 * np.pi / ANGLE_STEPS)
                c, s = np.cos(double), np.sin(double)
                if c * cos2 + s * sin2 < gate_cos:
                    continue
                count, offset, re, im = count + 1, offset + across, re + c, im + s
                if take:
                    index.strength[i] |= USED
    return count, offset, re, im


@njit(cache=True, nogil=True)
def _normal(index, k, u, v, re, im):
    """Unit normal (3,), object frame, of the plane through camera k and the line through its image point (u, v) that has the
    mean orientation given by the sums of cos and sin of twice the angle (n_k of "direction estimation")."""
    angle = 0.5 * np.arctan2(im, re)
    sx, sy, sz = _slope(u, v, index.distance)  # the ray from the point to the lens
    ou, ov = np.cos(angle), np.sin(angle)
    nx, ny, nz = ov * sz, -ou * sz, ou * sy - ov * sx
    size = np.sqrt(nx * nx + ny * ny + nz * nz)
    return _turn_back(nx / size, ny / size, nz / size, index.cos[k], index.sin[k])


# ---- Figure 7 --------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def find_orientations(index, p, g, box, normals):
    """Fill normals (m, 3) with the planes in which the cameras that have p (3,) near focus see the hair lie, g (3,) being
    its direction so far. Returns (m, cameras that have the point in their field)."""
    m = could = 0
    for k in range(len(index.cos)):
        axes = _axes(index, k, p, g)
        if not _sees(index, k, axes[0, 0], axes[0, 1], axes[0, 2]):
            continue
        could += 1
        count, _, re, im = _in_box(index, k, axes, box.half_near, box.gate_cos, False)
        if count:
            normals[m] = _normal(index, k, axes[0, 0], axes[0, 1], re, im)
            m += 1
    return m, could


@njit(cache=True, nogil=True)
def solve_direction(normals, g):
    """The unit direction (3,) that is most nearly perpendicular to all normals (m, 3), in the least squares; its sign is that
    nearer to g. The eigenvector of the smallest eigenvalue of N^T N, which is the last right singular vector of N."""
    _, vectors = np.linalg.eigh(normals.T @ normals)
    x = np.ascontiguousarray(vectors[:, 0])
    return x if np.sum(x * g) >= 0 else -x


@njit(cache=True, nogil=True)
def solve_correction(index, p, g, box):
    """The offset (3,) perpendicular to g that moves p to the common middle of the ribbons: eq. 3, a row t_k . q = t_k . (x_i - p)
    for each observation x_i in the boxes. Zero where the cameras that have any do not tell."""
    aa = ab = bb = at = bt = 0.0
    x = np.zeros(3)
    x[np.argmin(np.abs(g))] = 1.0
    x -= np.sum(x * g) * g
    x /= np.sqrt(np.sum(x**2))
    y = np.cross(g, x)
    for k in range(len(index.cos)):
        axes = _axes(index, k, p, g)
        if not _sees(index, k, axes[0, 0], axes[0, 1], axes[0, 2]):
            continue
        count, offset, _, _ = _in_box(index, k, axes, box.half, box.gate_cos, False)
        t = np.array(_turn_back(axes[3, 0], axes[3, 1], axes[3, 2], index.cos[k], index.sin[k]))
        a, b = np.sum(t * x), np.sum(t * y)
        aa, ab, bb = aa + count * a * a, ab + count * a * b, bb + count * b * b
        at, bt = at + offset * a, bt + offset * b
    det = aa * bb - ab * ab
    if det <= 1e-6 * (aa + bb) ** 2:
        return np.zeros(3)
    return x * ((bb * at - ab * bt) / det) + y * ((aa * bt - ab * at) / det)


@njit(cache=True, nogil=True)
def _within_cone(new, old, box):
    """``new`` turned back to the rim of the cone of omega around ``old`` where it lies outside (unit vectors)."""
    c = np.sum(new * old)
    if c >= box.cone_cos:
        return new
    side = new - c * old
    return box.cone_cos * old + (box.cone_sin / (np.sqrt(np.sum(side**2)) + 1e-12)) * side


@njit(cache=True, nogil=True)
def _shortened(q, bound):
    """q (3,), no longer than bound."""
    size = np.sqrt(np.sum(q**2))
    return q * (bound / size) if size > bound else q


@njit(cache=True, nogil=True)
def grow_hair(index, p, g, box, points, evidence):
    """GROW-HAIR in one direction from p along g, without the seed: fills points (n, 3), evidence (n,); returns (points kept, Stop)."""
    normals = np.empty((len(index.cos), 3))
    kept = unseen = 0
    m, _ = find_orientations(index, p, g, box, normals)
    for k in range(len(points)):
        if m >= box.min_cameras:
            g = _within_cone(solve_direction(normals[:m], g), g, box)
        p = p + box.step * g
        if m >= box.min_cameras:
            p = p + _shortened(solve_correction(index, p, g, box), box.gamma)
        m, could = find_orientations(index, p, g, box, normals)
        if could < box.min_cameras:
            return kept, Stop.LEFT_VOLUME.value
        points[k], evidence[k] = p, m
        unseen = 0 if m >= box.min_cameras else unseen + 1
        if unseen > box.bridge:
            return kept, Stop.UNOBSERVED.value
        if unseen == 0:
            kept = k + 1
    return kept, Stop.TOO_LONG.value


@njit(cache=True, nogil=True)
def remove_features(index, points, box):
    """Delete the observations that a hair (n, 3) was fitted to; returns how many there were."""
    removed = 0
    for j in range(len(points)):
        g = points[min(j + 1, len(points) - 1)] - points[max(j - 1, 0)]
        g /= np.sqrt(np.sum(g**2)) + 1e-12
        for k in range(len(index.cos)):
            axes = _axes(index, k, points[j], g)
            if _sees(index, k, axes[0, 0], axes[0, 1], axes[0, 2]):
                removed += _in_box(index, k, axes, box.half_removed, box.gate_cos, True)[0]
    return removed


# ---- seeds -----------------------------------------------------------------------------------------------------------


def _grid(index: Index, cell_mm: float) -> _Grid:
    """The cells of the captured volume: every point that a sweep can have in focus."""
    corners = np.array([(c, r) for c in (0, index.columns - 1) for r in (0, index.rows - 1)], float)
    u, v = to_image(corners[:, 0], corners[:, 1], index.pitch, index.axis_col, index.axis_row)
    reach = float(np.hypot(np.abs(u).max(), np.abs(index.positions).max()))
    low, high = np.array([-reach, v.min(), -reach]), np.array([reach, v.max(), reach])
    return _Grid(low, cell_mm, tuple(int(n) for n in np.ceil((high - low) / cell_mm) + 1))


@njit(cache=True, nogil=True)
def _cell_of(index, grid, k, i, strip, block):
    """Cell of the grid (a, b, c) in which feature i of camera k lies."""
    u, v = image_of(index, i, strip, block)
    d = index.positions[index.first_position[k] + index.frame[i]]
    x, y, z = _turn_back(u, v, d, index.cos[k], index.sin[k])
    return int((x - grid.low[0]) // grid.cell), int((y - grid.low[1]) // grid.cell), int((z - grid.low[2]) // grid.cell)


@njit(cache=True, nogil=True)
def _raster(index, grid, masks):
    """Set bit k of every cell of masks (nx, ny, nz) in which camera k has a feature."""
    for k in range(len(index.cos)):
        frames = index.first_position[k + 1] - index.first_position[k]
        for strip in range(index.columns // STRIP_PX + 1):
            for block in range(index.rows // BLOCK_PX + 1):
                start, stop = run_of(index, k, strip, block, 0, frames)
                for i in range(start, stop):
                    a, b, c = _cell_of(index, grid, k, i, strip, block)
                    if 0 <= a < masks.shape[0] and 0 <= b < masks.shape[1] and 0 <= c < masks.shape[2]:
                        masks[a, b, c] |= np.uint64(1) << np.uint64(k % 64)


@njit(cache=True, nogil=True)
def _seed(index, grid, number, normals):
    """The cell of a number: its middle (3,), and how many cameras still have features in it, their planes in normals (m, 3)."""
    cell = (number // (grid.shape[1] * grid.shape[2]), number // grid.shape[2] % grid.shape[1], number % grid.shape[2])
    p = grid.low + (np.array(cell) + 0.5) * grid.cell
    m = 0
    for k in range(len(index.cos)):
        u, v, w = _turn(p[0], p[1], p[2], index.cos[k], index.sin[k])
        aside = 0.5 * grid.cell * (abs(index.cos[k]) + abs(index.sin[k])) + 1e-9
        first_frame, last_frame = frames_between(index, k, w - aside, w + aside)
        s0, s1, b0, b1 = cell_range(index, u, v, aside, 0.5 * grid.cell + 1e-9)
        count, re, im = 0, 0.0, 0.0
        for strip in range(s0, s1):
            for block in range(b0, b1):
                start, stop = run_of(index, k, strip, block, first_frame, last_frame)
                for i in range(start, stop):
                    if index.strength[i] < USED and _cell_of(index, grid, k, i, strip, block) == cell:
                        double = index.angle[i] * (2 * np.pi / ANGLE_STEPS)
                        count, re, im = count + 1, re + np.cos(double), im + np.sin(double)
        if count:
            normals[m] = _normal(index, k, u, v, re, im)
            m += 1
    return p, m


@njit(cache=True, nogil=True)
def _next_hair(index, grid, seeds, counts, chosen, at, level, box, points, evidence, stops):
    """Try the seeds chosen[at:], all of ``level`` cameras when last looked at, until one gives a hair.

    A seed that has lost cameras goes to the level that it has now; one that gives no hair is done with (0). Returns (place
    to go on at, begin and end of the hair in points, seeds grown); no hair: begin = end.
    """
    normals = np.empty((len(index.cos), 3))
    middle, grown = len(points) // 2, 0
    up = np.array((0.0, 1.0, 0.0))
    for n in range(at, min(at + CELLS_A_CALL, len(chosen))):
        p, m = _seed(index, grid, seeds[chosen[n]], normals)
        if m < level:
            counts[chosen[n]] = m if m >= box.min_seed_cameras else 0
            continue
        grown += 1
        g = solve_direction(normals[:m], up)
        p = p + solve_correction(index, p, g, box)
        points[middle], evidence[middle] = p, m
        ahead, stops[1] = grow_hair(index, p, g, box, points[middle + 1 :], evidence[middle + 1 :])
        back, stops[0] = grow_hair(index, p, -g, box, points[middle - 1 :: -1], evidence[middle - 1 :: -1])
        begin, end = middle - back, middle + 1 + ahead
        if end - begin >= box.min_points and remove_features(index, points[begin:end], box):
            return n, begin, end, grown  # other hairs may pass through the cell
        counts[chosen[n]] = 0
    return min(at + CELLS_A_CALL, len(chosen)), 0, 0, grown
