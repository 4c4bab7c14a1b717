"""Growing fibers through the observations of all sweeps (sec. 4.2, Figure 7).

A fiber lies where the ribbons of several sweeps meet. From a seed the grower steps along it in both directions: what the way
so far foretells is compared with the observations of all cameras in a box around it (``look``), and the bent line that fits
them best (``fit``: place, direction and curvature at once) gives the next point.

Departures from the paper, whose own growing is in ``paper.py``:
* Observations are weighted: less the farther they are from the ribbon's middle, the farther from the expected angle and the
  farther from the plane of focus. In a dense lock the box of a hair holds its neighbours as well.
* Offsets and angles are fitted together, along a line that may bend, and with what is foretold as a prior.
* The clearest fibers come first: several passes over the seeds, each content with less evidence. A camera is evidence, up to
  1, by how well it agrees, how sharply it sees the hair, whether the hair is sharpest where it should be, and how much of what it
  sees no other curve stands on; the evidence of a point is that of the best range of adjacent cameras (``visible_range``).

Seeds are grown in batches that do not depend on the number of threads: every seed of a batch grows on the observations that
earlier batches left, then the curves are accepted in a fixed order, most evidence first, unless much of what they stand on
was taken by one before; what is refused is tried again in the next pass. The result is the same for any number of threads.
"""

from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numba import njit

from .crew import Threads
from .features import ANGLE_STEPS, BLOCK_PX, COL_STEPS, ROW_STEPS, STRIP_PX, USED, Index, cell_range, frames_between, image_of, run_of
from .geometry import slope, to_image, turn, turn_back
from .journal import Unwritten
from .look import GATE, LEAST_SIZE, PLACE_PX, UNSEEN, Box, claimed, fit, hair_frame, look, new_view, perpendicular, unit
from .progress import Progress, silent
from .stops import Stop

_turn, _turn_back, _slope, _to_image = njit(turn), njit(turn_back), njit(slope), njit(to_image)
_DOUBLE_COS, _DOUBLE_SIN = (f(np.arange(ANGLE_STEPS) * (2 * np.pi / ANGLE_STEPS)) for f in (np.cos, np.sin))  # of twice a stored angle
IN_CELL = 256  # observations of a camera in a cell that are looked at
SEEN_AT_ALL = 3  # observations of a camera in a seed's cell
H_MM = 0.1  # h of Table 1, for which omega and gamma are told
RECORDED, SEEN_BY = 3, 4  # features by which a sweep records a cell, and sweeps that must
PROMISED = (0.66, 0.71, 0.7)  # evidence of a seed for each camera that sees something like it, for each of their shares, and for each camera
# that meets others; 3 in 100 have more
MET, OF_PX, MET_WITHIN = 11, 3, 2  # squares each way in which cameras meet, a pixel wide; parts of a pixel that offsets are told in; and how many
# of these a ribbon may be off
SEEN_TOGETHER, LEAST_MET = 2, 2.5  # features of a camera that meets others, and cameras that must
PHASES = 8  # groups of layers of cells in which seeds are tried
FAR_FIRST = (0, 4, 2, 6, 1, 5, 3, 7)  # the order of the groups
RASTERED = 4  # parts in which layers are counted
BATCH = 64  # seeds grown against the same observations; part of the result, not of the machine
PART = 8  # of them that are grown together
DEEP, FOCUS = 2.3, 0.5  # of sigma_focus: how far along a ribbon a camera's depth is looked for, and how well it must agree
OBSERVED_TOGETHER = 17.0  # observations of one camera in a step that err alike: rows and frames that see the same


@dataclass(frozen=True)
class GrowParams:
    """Section 4.2 and Table 1; pixels are those of the channel plane."""

    step_mm: float = 0.2  # twice the h of Table 1: as good, in half the time
    cone_deg: float = 1.5  # omega: largest turn in H_MM, beyond the one that the curvature foretells
    max_correction_px: float = 0.5  # gamma: largest correction in H_MM
    box_px: tuple[float, float, float] = (40.0, 30.0, 8.0)  # a_g, a_s, a_t: full extents along the hair, the slope, across
    min_cameras: int = 3  # m: cameras that a step needs
    bridge_mm: float = 0.5  # how far a hair is continued where it is not observed
    min_own: float = 0.45  # share of the observations of a curve that no curve before has used up
    min_evidence: float = 1.2  # evidence that a step needs
    seed_evidence: tuple[float, float, float] = (2.2, 1.5, 1.2)  # of a seed in each pass, in parts of what a step needs
    mean_share: float = 0.6  # of it that a curve needs on average
    min_seed_cameras: int = 4  # angles that a seed cell must have recorded
    seed_cell_mm: float = 0.2
    min_length_mm: float = 0.8  # shorter curves are taken for chance
    max_length_mm: float = 400.0
    sigma_px: float = 0.5  # weight across the ribbon
    agree_px: float = 0.7  # a camera whose ribbon passes farther from where the others meet is not heard
    claim_px: float = 0.6  # observations this near to a curve are used up by it
    shared_weight: float = 0.02  # of an observation that another curve has used up: hairs cross in every photograph
    sigma_deg: float = 3.0  # weight by angle; 2.2 of it is the gate
    sigma_focus_mm: float = 0.3  # weight by distance from the plane of focus
    min_support: float = 0.06  # a camera speaks when it has this share of the observations of a hair in full view
    memory_mm: float = 0.5  # the way grown that foretells the next step fades over this length
    foretold: tuple[float, float, float] = (0.02, 2.0, 0.2)  # trust in what is foretold: place (mm), direction (deg), curvature (1/mm)


@dataclass(frozen=True)
class Grown:
    """M captured curves of N points, flat."""

    points_mm: np.ndarray  # (N, 3) float32
    offsets: np.ndarray  # (M + 1,) int64
    evidence: np.ndarray  # (N,) float32: cameras that saw the point, each by the share of a free view that it had
    stops: np.ndarray  # (M, 2) uint8: Stop of either end
    tried: int  # seeds looked at


def box_of(params: GrowParams, index: Index) -> Box:
    """What growing looks at."""
    pitch_mm, cone = index.pitch, np.radians(params.cone_deg * params.step_mm / H_MM)
    frame_mm = np.median(np.abs(np.diff(index.positions)))
    # rows times frames of a hair upright in the image; 0.8 is the mean of the other two weights on a true hair
    full_support = 0.8 * params.box_px[0] * np.sqrt(2 * np.pi) * params.sigma_focus_mm / frame_mm
    return Box(
        step=params.step_mm,
        cone_cos=float(np.cos(cone)),
        cone_sin=float(np.sin(cone)),
        gamma=params.max_correction_px * pitch_mm * params.step_mm / H_MM,
        half=tuple(0.5 * px * pitch_mm for px in params.box_px),
        min_cameras=params.min_cameras,
        bridge=round(params.bridge_mm / params.step_mm),
        max_points=int(0.5 * params.max_length_mm / params.step_mm),
        pixel=pitch_mm,
        sigma=params.sigma_px * pitch_mm,
        agree=params.agree_px * pitch_mm,
        shared=params.shared_weight,
        sigma_angle=float(np.radians(params.sigma_deg)),
        sigma_focus=params.sigma_focus_mm,
        deep=DEEP * params.sigma_focus_mm,
        focus=FOCUS * params.sigma_focus_mm,
        min_support=params.min_support,
        full_support=full_support,
        min_evidence=params.min_evidence,
        min_seed_cameras=params.min_seed_cameras,
        fade=float(np.exp(-params.step_mm / params.memory_mm)),
        prior=tuple(
            OBSERVED_TOGETHER * (PLACE_PX * pitch_mm / sigma) ** 2
            for sigma in (params.foretold[0], np.radians(params.foretold[1]), params.foretold[2])
        ),
    )


def claims_of(params: GrowParams, box: Box) -> Box:
    """What belongs to one step of a curve."""
    reach = 2.5 * params.sigma_focus_mm
    return box._replace(half=(0.5 * box.step, reach, params.claim_px * box.pixel), deep=reach)


# ---- Figure 7 --------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def solve_direction(normals, weights, g):
    """The unit direction (3,) with normals (S, 3) . direction = 0 in the least squares, nearest in sign to g.

    The eigenvector of the smallest eigenvalue of sum w n n^T (the paper's last right singular vector), by inverse iteration.
    """
    m = np.zeros((3, 3))
    for k in range(len(weights)):
        if weights[k] > 0:
            n = normals[k]
            for a in range(3):
                for b in range(3):
                    m[a, b] += weights[k] * n[a] * n[b]
    ridge = 1e-9 * (m[0, 0] + m[1, 1] + m[2, 2]) + 1e-30
    for a in range(3):
        m[a, a] += ridge
    c0, c1, c2 = np.cross(m[1], m[2]), np.cross(m[2], m[0]), np.cross(m[0], m[1])  # columns of the adjugate
    x = g.copy()
    for _ in range(4):
        x = c0 * x[0] + c1 * x[1] + c2 * x[2]
        x /= np.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
    return x if x[0] * g[0] + x[1] * g[1] + x[2] * g[2] > 0 else -x


@njit(cache=True, nogil=True)
def _within_cone(new, old, box):
    """``new`` turned back to the rim of the cone of omega around ``old`` where it lies outside (unit vectors)."""
    c = new[0] * old[0] + new[1] * old[1] + new[2] * old[2]
    if c >= box.cone_cos:
        return new
    side = new - c * old
    size = np.sqrt(side[0] ** 2 + side[1] ** 2 + side[2] ** 2)
    if size < 1e-12:
        return old
    return box.cone_cos * old + (box.cone_sin / size) * side


@njit(cache=True, nogil=True)
def _bounded(q, bound):
    """q (3,), no longer than bound."""
    size = np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2)
    return q * (bound / size) if size > bound else q


@njit(cache=True, nogil=True)
def _foretell(state, evidence, filled, sign, box):
    """Where the hair will be one step on: (p, g, curvature vector), each (3,).

    From each of the last points the hair is carried on by its place, direction and curvature there; the mean of these,
    the last ones counting most. state (n, 9): points, tangents (turned by ``sign``), curvatures.
    """
    p, g, bend = np.zeros(3), np.zeros(3), np.zeros(3)
    total, fade = 0.0, 1.0
    for j in range(filled - 1, max(filled - 21, -1), -1):
        a, w = (filled - j) * box.step, fade * (evidence[j] + 1e-6)
        fade *= box.fade
        total += w
        for c in range(3):
            x, t, k = state[j, c], sign * state[j, 3 + c], state[j, 6 + c]
            p[c] += w * (x + a * (t + 0.5 * a * k))
            g[c] += w * (t + a * k)
            bend[c] += w * k
    g = unit(g / total)
    bend /= total
    return p / total, g, bend - g * (g[0] * bend[0] + g[1] * bend[1] + g[2] * bend[2])


@njit(cache=True, nogil=True)
def grow_end(index, box, view, state, evidence, filled, sign):
    """Grow on from state (n, 9), of which the first ``filled`` rows are there: points, tangents (turned by ``sign``) and
    curvatures; fills it and evidence (n,). Returns (points there are now, Stop)."""
    kept, unseen = filled, 0
    for count in range(filled, len(state)):
        p, g, bend = _foretell(state, evidence, count, sign, box)
        could = look(index, p, g, bend, box, view)
        if could < box.min_cameras:
            return kept, Stop.LEFT_VOLUME.value
        spoke, seen, place, way, curve = fit(view, index.around, g, box, 1.0, box.prior)
        if spoke >= box.min_cameras and seen >= box.min_evidence:
            p = p + _bounded(place, box.gamma)
            g = _within_cone(unit(g + way), g, box)
            bend = bend + curve
            unseen = 0
        else:
            unseen += 1
            seen = 0.0
            if unseen > box.bridge:
                return kept, Stop.UNOBSERVED.value
        state[count, :3], state[count, 3:6], state[count, 6:], evidence[count] = p, sign * g, bend, seen
        if unseen == 0:
            kept = count + 1
    return kept, Stop.TOO_LONG.value


@njit(cache=True, nogil=True)
def _snap(index, p, g, least, box, view):
    """Draw a seed onto the centreline: (evidence, p, g, curvature). It must come to rest with enough cameras, else evidence
    is less than ``least``."""
    start, bend = p.copy(), np.zeros(3)
    moved = evidence = 0.0
    loose = (0.01 * box.prior[0], 0.01 * box.prior[1], box.prior[2])
    for trial in range(5):
        look(index, p, g, bend, box, view)
        # from the middle of a cell the hair may be far
        spoke, evidence, place, way, curve = fit(view, index.around, g, box, 4.0 if trial == 0 else (2.0 if trial == 1 else 1.0), loose)
        if spoke < box.min_seed_cameras or evidence < least:
            return min(evidence, 0.99 * least), p, g, bend
        p = p + _bounded(place, 2 * box.half[2])
        g = unit(g + way)
        if trial > 1:
            bend = bend + curve
        moved = np.sqrt(np.sum(place**2))
        if np.sqrt(np.sum((p - start) ** 2)) > 3 * box.half[2]:
            return 0.0, p, g, bend
    return evidence if moved < 2 * box.gamma else 0.0, p, g, bend


# ---- seeds -----------------------------------------------------------------------------------------------------------


class _Grid(NamedTuple):
    low: np.ndarray  # (3,) mm
    cell: float
    shape: tuple[int, int, int]


@njit(cache=True, nogil=True)
def _crossed(index, grid, number, block):
    """Whether a block of rows has a part in one of the layers of ``number``."""
    _, low = _to_image(0.0, float((block + 1) * BLOCK_PX), index.pitch, index.axis_col, index.axis_row)
    _, high = _to_image(0.0, float(block * BLOCK_PX), index.pitch, index.axis_col, index.axis_row)
    first, last = int((low - grid.low[1]) / grid.cell), int((high - grid.low[1]) / grid.cell)
    return np.any(number[max(first, 0) : last + 1] >= 0)


@njit(cache=True, nogil=True)
def _raster(index, grid, number, least, sweeps):
    """How many sweeps have ``least`` features or more that no curve stands on, in each cell of some layers of the grid: sweeps
    (layers, nx, nz) uint8, begun with zeros. number (ny,): which of these layers each one of the grid is, or -1."""
    count = np.empty(sweeps.shape, np.uint8)
    strips, blocks = index.columns // STRIP_PX + 1, index.rows // BLOCK_PX + 1
    for k in range(len(index.cos)):
        count[:] = 0
        frames = index.first_position[k + 1] - index.first_position[k]
        for strip in range(strips):
            for block in range(blocks):
                start, stop = run_of(index, k, strip, block, 0, frames)
                if not _crossed(index, grid, number, block):
                    continue
                for i in range(start, stop):
                    u, v = image_of(index, i, strip, block)
                    b = number[min(max(int((v - grid.low[1]) / grid.cell), 0), len(number) - 1)]
                    if b < 0 or index.strength[i] >= USED:
                        continue
                    d = index.positions[index.first_position[k] + index.frame[i]]
                    x, _, z = _turn_back(u, v, d, index.cos[k], index.sin[k])
                    a, c = int((x - grid.low[0]) / grid.cell), int((z - grid.low[2]) / grid.cell)
                    if 0 <= a < count.shape[1] and 0 <= c < count.shape[2] and count[b, a, c] < least:
                        count[b, a, c] += 1
                        if count[b, a, c] == least:
                            sweeps[b, a, c] += 1


class _Cell(NamedTuple):
    """What S sweeps have in a cell of the grid: room for it."""

    angles: np.ndarray  # (S, IN_CELL) uint8
    places: np.ndarray  # (S, IN_CELL, 3) float32: from the middle of the cell, mm in the camera's (u, v, d)
    free: np.ndarray  # (S, IN_CELL) uint8: whether no curve stands on it
    count: np.ndarray  # (S,) int64
    normals: np.ndarray  # (S, 3)
    weights: np.ndarray  # (S,)
    meeting: np.ndarray  # (MET, MET) uint32: the sweeps, a bit each, with ribbons of unused features through each square across a hair
    passed: np.ndarray  # (3 MET OF_PX,) uint8: how many of one sweep's lie at each offset across its ribbons


@njit(cache=True, nogil=True)
def _new_cell(cameras):
    return _Cell(
        np.empty((cameras, IN_CELL), np.uint8),
        np.empty((cameras, IN_CELL, 3), np.float32),
        np.empty((cameras, IN_CELL), np.uint8),
        np.zeros(cameras, np.int64),
        np.zeros((cameras, 3)),
        np.zeros(cameras),
        np.zeros((MET, MET), np.uint32),
        np.zeros(3 * MET * OF_PX, np.uint8),
    )


@njit(cache=True, nogil=True)
def _seed_direction(index, centre, size, least, cell):
    """The direction (3,) that the mean orientations of the sweeps with unused features in a cell agree on, and how many these are;
    no direction where they are fewer than ``least``. What is in the cell is left in ``cell``."""
    half, cameras = 0.75 * size, 0
    unit_col, unit_row = index.pitch / COL_STEPS, index.pitch / ROW_STEPS
    for k in range(len(index.cos)):
        cell.count[k], cell.weights[k] = 0, 0.0
        u0, v0, w0 = _turn(centre[0], centre[1], centre[2], index.cos[k], index.sin[k])
        first_frame, last_frame = frames_between(index, k, w0 - size, w0 + size)
        s0, s1, b0, b1 = cell_range(index, u0, v0, half, half)
        re = im = 0.0
        count = 0
        for strip in range(s0, s1):
            for block in range(b0, b1):
                start, stop = run_of(index, k, strip, block, first_frame, last_frame)
                x, y = _to_image(float(strip * STRIP_PX), float(block * BLOCK_PX), index.pitch, index.axis_col, index.axis_row)
                low_col, high_col = (u0 - half - x) / unit_col, (u0 + half - x) / unit_col
                low_row, high_row = (y - v0 - half) / unit_row, (y - v0 + half) / unit_row
                for i in range(start, stop):
                    if (low_col <= index.col[i]) & (index.col[i] <= high_col) & (low_row <= index.row[i]) & (index.row[i] <= high_row):
                        angle, free = index.angle[i], index.strength[i] < USED
                        if count < IN_CELL:
                            cell.angles[k, count], cell.free[k, count] = angle, free
                            cell.places[k, count, 0] = x + unit_col * index.col[i] - u0
                            cell.places[k, count, 1] = y - unit_row * index.row[i] - v0
                            cell.places[k, count, 2] = index.positions[index.first_position[k] + index.frame[i]] - w0
                            count += 1
                        if free:
                            re += _DOUBLE_COS[angle]
                            im += _DOUBLE_SIN[angle]
        cell.count[k] = count
        if np.hypot(re, im) < 1.0:
            continue
        cameras += 1
        angle = 0.5 * np.arctan2(im, re)
        sx, sy, sz = _slope(u0, v0, index.distance)
        ou, ov = np.cos(angle), np.sin(angle)
        cell.normals[k] = _turn_back(ov * sz, -ou * sz, ou * sy - ov * sx, index.cos[k], index.sin[k])
        cell.normals[k] /= np.sqrt(np.sum(cell.normals[k] ** 2))
        cell.weights[k] = 1.0
    if cameras < least:
        return np.zeros(3), cameras
    return solve_direction(cell.normals, cell.weights, unit(np.array((0.1, 1.0, 0.05)))), cameras


@njit(cache=True, nogil=True)
def _promise(index, centre, direction, gate, cell):
    """The most evidence that a hair through a cell along a direction may have: by the cameras that see something turned like it in
    the cell, by the shares of this that no curve stands on, and by how many of these meet in one place. A tenth of the time that
    looking at it takes."""
    agreeing = shares = 0.0
    ax, ay = perpendicular(direction)
    cell.meeting[:] = 0
    for k in range(len(index.cos)):
        if cell.count[k] == 0:
            continue
        frame = hair_frame(index, k, centre, direction)
        if frame.size < LEAST_SIZE:
            continue
        tx, ty, tz = _turn_back(frame.t[0], frame.t[1], frame.t[2], index.cos[k], index.sin[k])
        cell.passed[:] = 0
        free = there = 0
        for i in range(cell.count[k]):
            off = cell.angles[k, i] * (np.pi / ANGLE_STEPS) - frame.angle
            off -= np.pi * np.floor(off * (1 / np.pi) + 0.5)
            if abs(off) > gate:
                continue
            there += 1
            if cell.free[k, i]:
                free += 1
                place = cell.places[k, i]
                across = (frame.t[0] * place[0] + frame.t[1] * place[1] + frame.t[2] * place[2]) / index.pitch
                _pass(cell.passed, across)
        agreeing += free >= SEEN_AT_ALL
        shares += free / max(there, 1)
        if free >= SEEN_TOGETHER:
            _meet(cell.meeting, cell.passed, k, tx * ax[0] + ty * ax[1] + tz * ax[2], tx * ay[0] + ty * ay[1] + tz * ay[2])
    most = min(agreeing * PROMISED[0], shares * PROMISED[1])
    met = _most_met(cell.meeting, index.around) if most > 0 else 0.0
    return min(most, met * PROMISED[2]) if met >= LEAST_MET else 0.0


@njit(cache=True, nogil=True)
def _pass(passed, across):
    """Count a ribbon of one sweep that passes by ``across`` pixels, and as it may be off."""
    at = len(passed) // 2 + int(np.floor(across * OF_PX + 0.5))
    for i in range(max(at - MET_WITHIN, 0), min(at + MET_WITHIN + 1, len(passed))):
        passed[i] += 1


@njit(cache=True, nogil=True)
def _meet(meeting, passed, k, tx, ty):
    """Enter sweep k, whose ribbons are perpendicular to (tx, ty), in the squares across the hair, a pixel each, that they pass."""
    bit, middle = np.uint32(1) << np.uint32(k), MET // 2
    for a in range(MET):
        for b in range(MET):
            at = len(passed) // 2 + int(np.floor(((a - middle) * tx + (b - middle) * ty) * OF_PX + 0.5))
            if passed[at] >= SEEN_TOGETHER:
                meeting[a, b] |= bit


@njit(cache=True, nogil=True)
def _most_met(meeting, around):
    """The most cameras of one range of adjacent ones that meet in a square, less UNSEEN for each other one in the range."""
    best = 0.0
    for a in range(MET):
        for b in range(MET):
            sweeps = meeting[a, b]
            if sweeps == 0:
                continue
            total = run = most = lull = worst = 0.0
            for k in around:
                worth = 1.0 if (sweeps >> np.uint32(k)) & np.uint32(1) else -UNSEEN
                total += worth
                run = max(run + worth, 0.0)
                most = max(most, run)
                lull = min(lull + worth, 0.0)
                worst = min(worst, lull)
            best = max(best, most, total - worst)
    return best


@njit(cache=True, nogil=True)
def _grow_seeds(index, seeds, cell, least, box, state, evidence, begin, end, stops, strength):
    """Grow every seed (n, 3) of enough evidence on the same observations. Curve b is state[b, begin[b]:end[b]], the seed in the
    middle of the row; strength[b] is the evidence of the seed, or what it may have at most."""
    middle = state.shape[1] // 2
    view, inside = new_view(len(index.cos)), _new_cell(len(index.cos))
    for b in range(len(seeds)):
        begin[b] = end[b] = middle
        strength[b] = 0.0
        direction, cameras = _seed_direction(index, seeds[b], cell, box.min_seed_cameras, inside)
        if cameras < box.min_seed_cameras:
            continue
        strength[b] = _promise(index, seeds[b], direction, GATE * box.sigma_angle, inside)
        if strength[b] < least:
            continue
        strength[b], p, g, bend = _snap(index, seeds[b], direction, least, box, view)
        if strength[b] < least:
            continue
        state[b, middle, :3], state[b, middle, 3:6], state[b, middle, 6:], evidence[b, middle] = p, g, bend, strength[b]
        ahead, stops[b, 1] = grow_end(index, box, view, state[b, middle:], evidence[b, middle:], 1, 1.0)
        last = middle + ahead - 1
        back, stops[b, 0] = grow_end(index, box, view, state[b, last::-1], evidence[b, last::-1], ahead, -1.0)
        begin[b], end[b] = last + 1 - back, last + 1


def _seed_grid(index: Index, params: GrowParams) -> _Grid:
    """The cells of the captured volume: every point that a sweep can have in focus."""
    corners = np.array([(c, r) for c in (0, index.columns - 1) for r in (0, index.rows - 1)], float)
    u, v = to_image(corners[:, 0], corners[:, 1], index.pitch, index.axis_col, index.axis_row)
    reach = float(np.hypot(np.abs(u).max(), np.abs(index.positions).max()))
    low, high = np.array([-reach, v.min(), -reach]), np.array([reach, v.max(), reach])
    shape = tuple(int(np.ceil(n)) for n in (high - low) / params.seed_cell_mm)
    return _Grid(low, params.seed_cell_mm, shape)


@dataclass(frozen=True)
class Seeds:
    """Places where a fiber may begin: cells of a grid. Its layers are tried in PHASES, those of one phase far apart, and what is free is
    counted anew for each: a fiber crosses many layers, and what it stands on is used up by then."""

    grid: _Grid
    tried: list[tuple[np.ndarray, np.ndarray]]  # of each phase: the cells (n,) that were tried, ascending, and the evidence (n,) found

    def promising(self, pool: ThreadPoolExecutor, index: Index, phase: int, least: float) -> np.ndarray:
        """The cells (n,) int64 of a phase that may have evidence of ``least``, by the features that no curve stands on yet and by
        what was found there before; most promising first."""
        cells, bound = self._free(pool, index, phase, max(least / PROMISED[0], SEEN_BY))
        known, found = self.tried[phase]
        if len(known):
            at = np.minimum(np.searchsorted(known, cells), len(known) - 1)
            bound = np.where(known[at] == cells, np.minimum(found[at], bound), bound)
        cells, bound = cells[bound >= least], bound[bound >= least]
        shuffled = np.random.default_rng(0).permutation(len(cells))  # neighbours in a batch would grow the same fiber
        return cells[shuffled[np.argsort(-bound[shuffled], kind="stable")]]

    def _free(self, pool: ThreadPoolExecutor, index: Index, phase: int, least: float) -> tuple[np.ndarray, np.ndarray]:
        """The cells (n,) of a phase in which at least so many sweeps have something free, ascending, and the evidence that may have."""
        (nx, ny, nz), layers = self.grid.shape, self._layers(phase)

        def work(part: slice) -> tuple[np.ndarray, np.ndarray]:
            number = np.full(ny, -1)
            number[layers[part]] = np.arange(len(layers[part]))
            sweeps = np.zeros((len(layers[part]), nx, nz), np.uint8)
            _raster(index, self.grid, number, RECORDED, sweeps)
            at = np.flatnonzero(sweeps >= least)
            return layers[part][at // (nx * nz)] * (nx * nz) + at % (nx * nz), PROMISED[0] * sweeps.ravel()[at]

        size = max(-(-len(layers) // RASTERED), 1)
        parts = list(pool.map(work, [slice(i, i + size) for i in range(0, len(layers), size)]))
        return tuple(np.concatenate([part[i] for part in parts] or [np.zeros(0, int)]) for i in range(2))

    def _layers(self, phase: int) -> np.ndarray:
        return np.arange(phase, self.grid.shape[1], PHASES)

    def centres(self, cells: np.ndarray) -> np.ndarray:
        """Middles (n, 3) mm of cells (n,)."""
        nx, _, nz = self.grid.shape
        layer, rest = np.divmod(cells, nx * nz)
        return self.grid.low + (np.stack([rest // nz, layer, rest % nz], -1) + 0.5) * self.grid.cell

    def tell(self, phase: int, cells: np.ndarray, found: np.ndarray) -> None:
        """Remember the evidence found (n,) in cells (n,) of a phase."""
        known, before = self.tried[phase]
        cells, found = np.concatenate([cells, known]), np.concatenate([found, before])
        cells, first = np.unique(cells, return_index=True)
        self.tried[phase] = cells, found[first]


def find_seeds(index: Index, params: GrowParams) -> Seeds:
    """Seeds of which none has been tried."""
    return Seeds(_seed_grid(index, params), [(np.zeros(0, np.int64), np.zeros(0)) for _ in range(PHASES)])


# ---- the whole -------------------------------------------------------------------------------------------------------


def grow(
    index: Index,
    params: GrowParams,
    workers: int = 1,
    progress: Progress = silent,
    seeds: Seeds | None = None,
    crew: Threads | None = None,
    journal: Unwritten | None = None,
) -> Grown:
    """Every fiber that the observations support, on ``workers`` threads or by a ``crew``. Uses up ``index.strength``.

    seeds: where to begin; what is found there lowers their bound, so that growing again looks at the rest. None: all there are.
    journal: what an earlier run found, and where to note what is found now.

    Deterministic: the same index and parameters give the same curves in the same order, whatever the number of threads.
    """
    box = box_of(params, index)
    claims = claims_of(params, box)
    seeds = seeds or find_seeds(index, params)
    curves: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    tried, steps = 0, len(params.seed_evidence) * PHASES
    with Threads(index, workers) if crew is None else nullcontext(crew) as crew:
        notes = _Notes(journal or Unwritten(), crew, claims)
        for number, share in enumerate(params.seed_evidence):
            least = max(share * params.min_evidence, 1e-6)
            for step, phase in enumerate(FAR_FIRST):
                cells = notes.cells(lambda phase=phase, least=least: seeds.promising(crew.pool, index, phase, least))
                found, first, ahead = [], 0, 1
                while first < len(cells):
                    progress("growing", number * PHASES + step + first / len(cells), steps)
                    told = notes.earlier()
                    if told is None:
                        told = _grow_batches(crew, seeds.centres(cells[first : first + ahead * BATCH]), least, params, box, claims)
                        ahead = -(-len(told[0]) // BATCH) if told[1] else min(2 * ahead, crew.ahead)
                        notes.add(*told)
                    found.append(told[0])
                    curves += told[1]
                    first += len(told[0])
                notes.write()
                seeds.tell(phase, cells, np.concatenate([*found, np.zeros(0)]))
                tried += len(cells)
    progress("growing", steps, steps)
    return _flat(curves, tried)


class _Notes:
    """What is told to a journal while growing, and taken from it where an earlier run came as far: the cells of each phase, then the
    evidence of its seeds and the curves that were accepted, some batches a record. Observations are marked as used up once
    something is to be looked at."""

    def __init__(self, journal: Unwritten, crew: Threads, claims: Box):
        self.journal, self.crew, self.claims = journal, crew, claims
        self.unmarked: list[np.ndarray] = []  # points (n, 3) of curves of the earlier run
        self.found: list[np.ndarray] = []
        self.curves: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def cells(self, tell) -> np.ndarray:
        """tell(), or what it was."""
        told = self.journal.next("cells")
        if told is None:
            self._mark()
            cells = tell()
            self.journal.write("cells", cells=cells)
            return cells
        return told["cells"]

    def earlier(self):
        """The evidence (n,) of some of the next seeds and the curves accepted from them, as an earlier run found them, or None."""
        told = self.journal.next("batches")
        if told is None:
            self._mark()
            return None
        offsets = np.concatenate([[0], np.cumsum(told["sizes"])])
        points, evidence = ([told[name][a:b] for a, b in pairwise(offsets)] for name in ("points", "evidence"))
        self.unmarked += points
        return told["found"], list(zip(points, evidence, told["stops"], strict=True))

    def add(self, found: np.ndarray, curves: list) -> None:
        """Note what came of some batches; it is written now and then."""
        self.found.append(found)
        self.curves += curves
        if self.journal.due:
            self.write()

    def write(self) -> None:
        """Write what was noted."""
        if self.found:
            flat = _flat(self.curves, 0)
            points = np.concatenate([np.zeros((0, 3)), *(points for points, _, _ in self.curves)])
            sizes = np.diff(flat.offsets)
            self.journal.write("batches", found=np.concatenate(self.found), points=points, sizes=sizes, evidence=flat.evidence, stops=flat.stops)
        self.found, self.curves = [], []

    def _mark(self) -> None:
        for numbers in self.crew.each(claim, self.unmarked, self.claims):
            self.crew.use(numbers)
        self.unmarked = []


def _grow_batches(crew: Threads, seeds: np.ndarray, least: float, params: GrowParams, box: Box, claims: Box):
    """Grow seeds (n, 3), some batches of them, against the same observations: the evidence (m,) of those up to the end of the first
    batch that changes what is used up, and the curves that were accepted from it."""
    parts = [seeds[i : i + PART] for i in range(0, len(seeds), PART)]
    grown = crew.each(_grow_part, parts, least, params, box, claims, _longest(crew.index, params))
    found, accepted = [], []
    for first in range(0, len(parts), BATCH // PART):
        batch = grown[first : first + BATCH // PART]
        found += [strength for strength, _ in batch]
        accepted = _accept(crew, [curve for _, curves in batch for curve in curves], params)
        if accepted:
            break
    return np.concatenate(found), accepted


def _grow_part(index: Index, seeds: np.ndarray, least: float, params: GrowParams, box: Box, claims: Box, longest: int):
    """The evidence (b,) of seeds (b, 3), and of each curve from them that is long enough and has evidence: points (n, 3), evidence
    (n,), stops (2,), and the numbers of the observations that it stands on."""
    store = _BatchStore.of(len(seeds), 2 * min(box.max_points, longest) + 1)
    _grow_seeds(index, seeds, params.seed_cell_mm, least, box, store.state, store.evidence, store.begin, store.end, store.stops, store.strength)
    long = np.flatnonzero((store.end - store.begin - 1) * params.step_mm >= params.min_length_mm)
    curves = [curve for curve in map(store.curve, long) if curve[1].mean() >= params.mean_share * least]
    return store.strength, [(*curve, claimed(index, curve[0], claims)) for curve in curves]


def claim(index: Index, points: np.ndarray, claims: Box) -> np.ndarray:
    """Numbers (m,) of the observations that a curve of points (n, 3) stands on."""
    return claimed(index, np.ascontiguousarray(points), claims)


def _longest(index: Index, params: GrowParams) -> int:
    """Steps of the longest fiber worth making room for: ten times the height of the captured volume."""
    return int(10 * index.rows * index.pitch / params.step_mm) + 10


@dataclass(frozen=True)
class _BatchStore:
    """Room for the curves of some seeds."""

    state: np.ndarray
    evidence: np.ndarray
    begin: np.ndarray
    end: np.ndarray
    stops: np.ndarray
    strength: np.ndarray

    @classmethod
    def of(cls, seeds: int, points: int) -> "_BatchStore":
        counts = [np.zeros(seeds, np.int64) for _ in range(2)]
        return cls(np.empty((seeds, points, 9)), np.empty((seeds, points), np.float32), *counts, np.zeros((seeds, 2), np.uint8), np.zeros(seeds))

    def curve(self, b: int):
        """Copies of the points, the evidence and the stops of curve b."""
        row = slice(self.begin[b], self.end[b])
        return self.state[b, row, :3].copy(), self.evidence[b, row].copy(), self.stops[b].copy()


def _accept(crew: Threads, curves: list, params: GrowParams) -> list:
    """The curves of a batch that stand on observations of their own; most evidence first. What they stand on is used up
    (REMOVE-FEATURES)."""
    accepted = []
    for *curve, numbers in sorted(curves, key=lambda curve: -float(curve[1].sum())):
        there = np.count_nonzero(crew.index.strength[numbers] < USED)
        if there > 0 and there >= params.min_own * len(numbers):
            crew.use(numbers)
            accepted.append(tuple(curve))
    return accepted


def _flat(curves, tried: int) -> Grown:
    if not curves:
        return Grown(np.zeros((0, 3), np.float32), np.zeros(1, np.int64), np.zeros(0, np.float32), np.zeros((0, 2), np.uint8), tried)
    points, evidence, stops = zip(*curves, strict=True)
    offsets = np.concatenate([[0], np.cumsum([len(p) for p in points])]).astype(np.int64)
    return Grown(np.concatenate(points).astype(np.float32), offsets, np.concatenate(evidence), np.stack(stops), tried)
