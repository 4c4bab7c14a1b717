"""Growing fibers through the observations of all sweeps (sec. 4.2, Figure 7).

A fiber lies where the ribbons of several sweeps meet. From a seed the grower steps along it in both directions: what the way
so far foretells is compared with the observations of all cameras in a box around it (``_look``), and the bent line that fits
them best (``_fit``: place, direction and curvature at once) gives the next point.

Departures from the paper, whose own growing is in ``paper.py``:
* Observations are weighted: less the farther they are from the ribbon's middle, the farther from the expected angle and the
  farther from the plane of focus. In a dense lock the box of a hair holds its neighbours as well.
* Offsets and angles are fitted together, along a line that may bend, and with what is foretold as a prior.
* The clearest fibers come first: several passes over the seeds, each content with less evidence. A camera is evidence, up to
  1, by how well it agrees, how sharply it sees the hair, whether the hair is sharpest where it should be, and how much of what it
  sees no other curve stands on; the evidence of a point is that of the best range of adjacent cameras (``_visible_range``).

Seeds are grown in batches that do not depend on the number of threads: every seed of a batch grows on the observations that
earlier batches left, then the curves are accepted in a fixed order, most evidence first, unless much of what they stand on
was taken by one before; what is refused is tried again in the next pass. The result is the same for any number of threads.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from .features import (
    ANGLE_STEPS,
    BLOCK_PX,
    STRIP_PX,
    USED,
    Index,
    cell_range,
    frames_between,
    image_of,
    run_of,
    strength_of,
)
from .geometry import project, slope, to_image, to_pixel, turn, turn_back
from .progress import Progress, silent
from .stops import Stop

_turn, _turn_back, _slope, _to_pixel, _to_image, _project = (
    njit(turn), njit(turn_back), njit(slope), njit(to_pixel), njit(to_image), njit(project),
)  # fmt: skip
BATCH = 64  # seeds grown against the same observations; part of the result, not of the machine
MAX_HITS = 1024  # features that one step looks at, for each camera
PLACE_PX, ANGLE_RAD = 0.22, 0.0436  # errors of one observation across the hair and of its angle (2.5 degrees)
TWIST_RAD = 0.0698  # a camera that sees the hair turned by more than this (4 degrees) is no evidence for it
SHARE_POWER = 0.1  # of the share of its observations that a camera has: many that see a little tell more than one that sees all
DEEP, FOCUS = 2.3, 0.5  # of sigma_focus: how far along a ribbon a camera's depth is looked for, and how well it must agree
UNSEEN = 0.1  # evidence that a camera costs which sees no hair where it should be
SPREAD_PX = (0.18, 0.3)  # of a hair's observations across it; a camera whose observations spread by the second more tells nothing
OBSERVED_TOGETHER = 17.0  # observations of one camera in a step that err alike: rows and frames that see the same


@dataclass(frozen=True)
class GrowParams:
    """Section 4.2 and Table 1; pixels are those of the channel plane."""

    step_mm: float = 0.1  # h
    cone_deg: float = 1.5  # omega: largest turn in one step, beyond the one that the curvature foretells
    max_correction_px: float = 0.5  # gamma: largest correction in one step
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


class _Box(NamedTuple):
    """GrowParams in mm and radians, as the kernels take it."""

    step: float
    cone_cos: float
    cone_sin: float
    gamma: float
    half: tuple[float, float, float]
    min_cameras: int
    bridge: int
    max_points: int
    pixel: float
    sigma: float
    agree: float
    claim: float
    shared: float
    sigma_angle: float
    sigma_focus: float
    deep: float  # reach along the ribbon, and how far off focus a camera may see a hair to be half believed
    focus: float
    min_support: float
    full_support: float
    min_evidence: float
    min_seed_cameras: int
    fade: float  # of what a point foretells, a step
    prior: tuple[float, float, float]  # weight of what is foretold, in observations: of place, direction (mm²), curvature (mm⁴)


def _box(params: GrowParams, index: Index) -> _Box:
    pitch_mm, cone = index.pitch, np.radians(params.cone_deg)
    frame_mm = np.median(np.abs(np.diff(index.positions)))
    # rows times frames of a hair upright in the image; 0.8 is the mean of the other two weights on a true hair
    full_support = 0.8 * params.box_px[0] * np.sqrt(2 * np.pi) * params.sigma_focus_mm / frame_mm
    return _Box(
        step=params.step_mm,
        cone_cos=float(np.cos(cone)),
        cone_sin=float(np.sin(cone)),
        gamma=params.max_correction_px * pitch_mm,
        half=tuple(0.5 * px * pitch_mm for px in params.box_px),
        min_cameras=params.min_cameras,
        bridge=round(params.bridge_mm / params.step_mm),
        max_points=int(0.5 * params.max_length_mm / params.step_mm),
        pixel=pitch_mm,
        sigma=params.sigma_px * pitch_mm,
        agree=params.agree_px * pitch_mm,
        claim=params.claim_px * pitch_mm,
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


# ---- one camera's view of a point of a hair --------------------------------------------------------------------------


@njit(cache=True, nogil=True, fastmath=True)
def _sees(index, k, u, v, w):
    """Whether the point (u', v', w) of camera k's frame comes into focus inside its photographs."""
    positions = index.positions[index.first_position[k] : index.first_position[k + 1]]
    col, row = _to_pixel(u, v, index.pitch, index.axis_col, index.axis_row)
    return positions[0] <= w <= positions[-1] and 0 <= col <= index.columns - 1 and 0 <= row <= index.rows - 1


@njit(cache=True, nogil=True, fastmath=True)
def _hair_frame(index, k, p, g):
    """Camera k's frame of a hair at p (3,) along g (3,): the point, g, s and t as rows of (4, 3), and the angle of the hair
    in the image. s is the slope of the ribbon made perpendicular to g, t the normal of the ribbon (sec. 4.2)."""
    frame = np.empty((4, 3))
    frame[0] = _turn(p[0], p[1], p[2], index.cos[k], index.sin[k])
    frame[1] = _turn(g[0], g[1], g[2], index.cos[k], index.sin[k])
    sx, sy, sz = _slope(frame[0, 0], frame[0, 1], index.distance)
    along = sx * frame[1, 0] + sy * frame[1, 1] + sz * frame[1, 2]
    sx, sy, sz = sx - along * frame[1, 0], sy - along * frame[1, 1], sz - along * frame[1, 2]
    size = np.sqrt(sx * sx + sy * sy + sz * sz)
    frame[2] = sx / size, sy / size, sz / size
    frame[3] = np.cross(frame[1], frame[2])
    # how the image of the point moves as it slides along the hair, at focus: d(u, v) = (g_u + u/l g_w, g_v + v/l g_w)
    du = frame[1, 0] + frame[0, 0] / index.distance * frame[1, 2]
    dv = frame[1, 1] + frame[0, 1] / index.distance * frame[1, 2]
    return frame, np.arctan2(dv, du), np.hypot(du, dv)


@njit(cache=True, nogil=True, fastmath=True)
def _gather(index, k, frame, angle, bend, sag, box, hits, count):
    """Observations of camera k in the box of a hair; returns the rows of hits (n, 8) there are now, filled from ``count`` on with
    along, across (mm), turn (rad), weight, depth (mm), strength weighted by turn, how free it is of other curves, and its number.

    bend, sag: curvature of the hair towards t and towards s (1/mm). What the hair itself bends away is taken from across, turn
    and depth. Observations deeper than half[1] have no weight, but tell how deep the camera sees the hair.
    Bound by cache misses: a few dozen runs of 8-byte features.
    """
    half = box.half
    reach = np.abs(frame[1]) * half[0] + np.abs(frame[2]) * box.deep + np.abs(frame[3]) * half[2]
    first_frame, last_frame = frames_between(index, k, frame[0, 2] - reach[2], frame[0, 2] + reach[2])
    s0, s1, b0, b1 = cell_range(index, frame[0, 0], frame[0, 1], reach[0], reach[1])
    gate = 2.2 * box.sigma_angle
    for strip in range(s0, s1):
        for block in range(b0, b1):
            start, stop = run_of(index, k, strip, block, first_frame, last_frame)
            for i in range(start, stop):
                u, v = image_of(index, i, strip, block)
                x, y = u - frame[0, 0], v - frame[0, 1]
                z = index.positions[index.first_position[k] + index.frame[i]] - frame[0, 2]
                along = frame[1, 0] * x + frame[1, 1] * y + frame[1, 2] * z
                across = frame[3, 0] * x + frame[3, 1] * y + frame[3, 2] * z - 0.5 * bend * along * along
                if abs(across) > half[2] or abs(along) > half[0]:
                    continue
                depth = frame[2, 0] * x + frame[2, 1] * y + frame[2, 2] * z - 0.5 * sag * along * along
                if abs(depth) > box.deep:
                    continue
                # s looks at the camera and t = g x s, so a hair that turns counterclockwise in the image leans away from t
                off = index.angle[i] * (np.pi / ANGLE_STEPS) - angle + bend * along
                off -= np.pi * np.round(off / np.pi)
                if abs(off) > gate:
                    continue
                if count == len(hits):
                    return count
                # biweights of the width of Gaussians of these sigmas: no exp, and nothing from far away
                y, z = off / box.sigma_angle, depth / box.sigma_focus
                y, z = max(1 - 0.207 * y * y, 0.0), max(1 - 0.207 * z * z, 0.0) if abs(depth) <= half[1] else 0.0
                free = box.shared if index.strength[i] >= USED else 1.0
                hits[count, 0], hits[count, 1], hits[count, 2] = along, across, off
                hits[count, 3], hits[count, 4], hits[count, 5], hits[count, 6] = (
                    y * y * z * z * free,
                    depth,
                    y * y * strength_of(index.strength[i]),
                    free,
                )
                hits[count, 7] = i
                count += 1
    return count


class _View(NamedTuple):
    """What the cameras say of a point: arrays over the sweeps."""

    hits: np.ndarray  # (n, 8) observations, as ``_gather`` tells
    ends: np.ndarray  # (S + 1,) int64: where each camera's observations begin
    across: np.ndarray  # (S, 3) t of each ribbon, object frame
    full: np.ndarray  # (S,) weight of the observations of a hair in full view; 0 for a camera that cannot see it
    told: np.ndarray  # (S,) what each camera's observations are worth as evidence, 0 to 1


@njit(cache=True, nogil=True)
def _new_view(cameras):
    return _View(np.empty((cameras * MAX_HITS, 8)), np.zeros(cameras + 1, np.int64), np.zeros((cameras, 3)), np.zeros(cameras), np.zeros(cameras))


@njit(cache=True, nogil=True, fastmath=True)
def _look(index, p, g, bend, box, view):
    """Gather every camera's observations of a hair at p along g that bends by the curvature vector ``bend`` (3,) 1/mm.
    Returns how many cameras could see it."""
    could = count = 0
    for k in range(len(index.cos)):
        view.ends[k] = count
        view.full[k] = 0.0
        frame, angle, size = _hair_frame(index, k, p, g)
        if not _sees(index, k, frame[0, 0], frame[0, 1], frame[0, 2]):
            continue
        could += 1
        if size < 0.2:  # the hair points at the camera
            continue
        tx, ty, tz = _turn_back(frame[3, 0], frame[3, 1], frame[3, 2], index.cos[k], index.sin[k])
        view.across[k] = tx, ty, tz
        view.full[k] = max(size, 0.3) * box.full_support
        sx, sy, sz = _turn_back(frame[2, 0], frame[2, 1], frame[2, 2], index.cos[k], index.sin[k])
        towards = bend[0] * tx + bend[1] * ty + bend[2] * tz, bend[0] * sx + bend[1] * sy + bend[2] * sz
        count = _gather(index, k, frame, angle, towards[0], towards[1], box, view.hits, count)
    view.ends[len(index.cos)] = count
    return could


# ---- the hair that fits ----------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True, fastmath=True)
def _visible_range(view, around):
    """The evidence of the adjacent cameras that have most: a hair is seen from one range of angles, and a chance meeting of
    the ribbons of other hairs from here and there. Each camera of the range that could see the hair costs ``UNSEEN``.
    ``around``: the cameras in the order of their angles, the first follows the last."""
    total = run = best = lull = worst = 0.0
    for k in around:
        worth = view.told[k] - UNSEEN if view.full[k] > 0 else 0.0
        total += worth
        run = max(run + worth, 0.0)
        best = max(best, run)
        lull = min(lull + worth, 0.0)
        worst = min(worst, lull)
    return max(best, total - worst)


@njit(cache=True, nogil=True, fastmath=True)
def _fit(view, around, g, box, wide, prior):
    """The bent line that the observations of ``view`` support: (cameras that agree, evidence, place, direction, curvature).

    The last three are vectors (3,) perpendicular to g by which the hair differs from the one looked for: at the way ``a``
    along g it lies at place + direction a + curvature a^2 / 2. Weighted least squares over the offsets and the angles of all
    observations at once (eq. 3 made longer), three times: each observation counts less the farther it lies from the hair of
    the time before, and so does a camera as a whole. ``wide`` is the width of that weight in sigma; ``prior`` holds place,
    direction and curvature to what was looked for.
    """
    cameras = len(view.told)
    ax, ay = _perpendicular(g)
    theta = np.zeros(6)
    m, b = np.empty((6, 6)), np.empty(6)
    lever = (PLACE_PX * box.pixel / ANGLE_RAD) ** 2
    spoke = 0
    for trial in range(4):
        m[:] = 0.0
        b[:] = 0.0
        for c in range(6):
            m[c, c] = prior[c // 2]
            b[c] = 0.0
        spoke = 0
        narrow, deepest = 1 / (wide * box.sigma), 1 / box.deep
        for k in range(cameras):
            view.told[k] = 0.0
            if view.ends[k + 1] == view.ends[k]:
                continue
            t = view.across[k]
            tx, ty = t[0] * ax[0] + t[1] * ax[1] + t[2] * ax[2], t[0] * ay[0] + t[1] * ay[1] + t[2] * ay[2]
            o0, o1, o2 = theta[0] * tx + theta[1] * ty, theta[2] * tx + theta[3] * ty, theta[4] * tx + theta[5] * ty
            s0 = s1 = s2 = s3 = s4 = r0 = r1 = r2 = l0 = l1 = rest = rest2 = whole = free = deep = 0.0
            for i in range(view.ends[k], view.ends[k + 1]):
                a, across, off, w = view.hits[i, 0], view.hits[i, 1], view.hits[i, 2], view.hits[i, 3]
                left = across - (o0 + a * (o1 + 0.5 * a * o2))
                x = left * narrow
                x = 1 - 0.207 * x * x
                if x <= 0:
                    continue
                w *= x * x
                wa, waa = w * a, w * a * a
                if trial == 3:
                    z = view.hits[i, 4] * deepest
                    z = view.hits[i, 5] * x * x * max(1 - z * z, 0.0) ** 2
                    whole += z
                    z *= view.hits[i, 6]
                    free += z
                    deep += z * view.hits[i, 4]
                s0 += w
                s1 += wa
                s2 += waa
                s3 += waa * a
                s4 += waa * a * a
                rest += w * left
                rest2 += w * left * left
                r0 += w * across
                r1 += wa * across
                r2 += waa * across
                l0 -= w * off
                l1 -= wa * off
            share = s0 / view.full[k]
            if share < box.min_support:
                continue
            far = rest / s0 / (wide * box.agree)
            agree = max(1 - far * far, 0.0) ** 2
            if agree == 0:
                continue
            twist = (o1 + (o2 * s1 - l0) / s0) / TWIST_RAD
            spoke += 1
            if trial == 3:
                spread = np.sqrt(max(rest2 / s0 - (rest / s0) ** 2, 0.0)) / (wide * box.pixel)
                sharp = min(max(1 - (spread - SPREAD_PX[0]) / SPREAD_PX[1], 0.1), 1.2)
                astray = deep / max(free, 1e-30) / box.focus
                own = free / max(whole, 1e-30)
                told = min(share, 1.0) ** SHARE_POWER * agree * max(1 - twist * twist, 0.0) ** 2 * sharp
                view.told[k] = told * own / (1 + astray * astray) ** 2
            # rows of the normal matrix: place, direction, curvature along t
            block = (s0, s1, 0.5 * s2, s2 + lever * s0, 0.5 * s3 + lever * s1, 0.25 * s4 + lever * s2)
            right = (r0, r1 + lever * l0, 0.5 * r2 + lever * l1)
            for c in range(3):
                for d in range(3):
                    e = block[d if c == 0 else (c if d == 0 else c + d + 1)]
                    m[2 * c, 2 * d] += agree * e * tx * tx
                    m[2 * c, 2 * d + 1] += agree * e * tx * ty
                    m[2 * c + 1, 2 * d] += agree * e * ty * tx
                    m[2 * c + 1, 2 * d + 1] += agree * e * ty * ty
                b[2 * c] += agree * right[c] * tx
                b[2 * c + 1] += agree * right[c] * ty
        if spoke == 0 or trial == 3:
            break
        _cholesky_solve(m, b, theta)
    return spoke, _visible_range(view, around), theta[0] * ax + theta[1] * ay, theta[2] * ax + theta[3] * ay, theta[4] * ax + theta[5] * ay


@njit(cache=True, nogil=True, fastmath=True)
def _perpendicular(g):
    """Two unit vectors (3,) that make a right-handed frame with the unit vector g."""
    x = np.zeros(3)
    x[np.argmin(np.abs(g))] = 1.0
    x -= g * (g[0] * x[0] + g[1] * x[1] + g[2] * x[2])
    x /= np.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
    return x, np.cross(g, x)


@njit(cache=True, nogil=True, fastmath=True)
def _cholesky_solve(m, b, x):
    """Solve m x = b for a symmetric positive definite m (n, n), which is overwritten."""
    n = len(b)
    for i in range(n):
        for j in range(i + 1):
            s = m[i, j]
            for k in range(j):
                s -= m[i, k] * m[j, k]
            m[i, j] = np.sqrt(max(s, 1e-12)) if i == j else s / m[j, j]
    for i in range(n):
        s = b[i]
        for k in range(i):
            s -= m[i, k] * x[k]
        x[i] = s / m[i, i]
    for i in range(n - 1, -1, -1):
        s = x[i]
        for k in range(i + 1, n):
            s -= m[k, i] * x[k]
        x[i] = s / m[i, i]


# ---- Figure 7 --------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True, fastmath=True)
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


@njit(cache=True, nogil=True, fastmath=True)
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


@njit(cache=True, nogil=True, fastmath=True)
def _bounded(q, bound):
    """q (3,), no longer than bound."""
    size = np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2)
    return q * (bound / size) if size > bound else q


@njit(cache=True, nogil=True, fastmath=True)
def _unit(g):
    return g / np.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])


@njit(cache=True, nogil=True, fastmath=True)
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
    g = _unit(g / total)
    bend /= total
    return p / total, g, bend - g * (g[0] * bend[0] + g[1] * bend[1] + g[2] * bend[2])


@njit(cache=True, nogil=True, fastmath=True)
def _grow_end(index, box, view, state, evidence, filled, sign):
    """Grow on from state (n, 9), of which the first ``filled`` rows are there: points, tangents (turned by ``sign``) and
    curvatures; fills it and evidence (n,). Returns (points there are now, Stop)."""
    kept, unseen = filled, 0
    for count in range(filled, len(state)):
        p, g, bend = _foretell(state, evidence, count, sign, box)
        could = _look(index, p, g, bend, box, view)
        if could < box.min_cameras:
            return kept, Stop.LEFT_VOLUME.value
        spoke, seen, place, way, curve = _fit(view, index.around, g, box, 1.0, box.prior)
        if spoke >= box.min_cameras and seen >= box.min_evidence:
            p = p + _bounded(place, box.gamma)
            g = _within_cone(_unit(g + way), g, box)
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


@njit(cache=True, nogil=True, fastmath=True)
def _snap(index, p, g, least, box, view):
    """Draw a seed onto the centreline: (evidence, p, g, curvature). It must come to rest with enough cameras, else evidence
    is less than ``least``."""
    start, bend = p.copy(), np.zeros(3)
    moved = evidence = 0.0
    loose = (0.01 * box.prior[0], 0.01 * box.prior[1], box.prior[2])
    for trial in range(5):
        _look(index, p, g, bend, box, view)
        # from the middle of a cell the hair may be far
        spoke, evidence, place, way, curve = _fit(view, index.around, g, box, 4.0 if trial == 0 else (2.0 if trial == 1 else 1.0), loose)
        if spoke < box.min_seed_cameras or evidence < least:
            return min(evidence, 0.99 * least), p, g, bend
        p = p + _bounded(place, 2 * box.half[2])
        g = _unit(g + way)
        if trial > 1:
            bend = bend + curve
        moved = np.sqrt(np.sum(place**2))
        if np.sqrt(np.sum((p - start) ** 2)) > 3 * box.half[2]:
            return 0.0, p, g, bend
    return evidence if moved < 2 * box.gamma else 0.0, p, g, bend


@njit(cache=True, nogil=True)
def _grow_seeds(index, seeds, directions, least, box, state, evidence, begin, end, stops, strength):
    """Grow every seed of enough evidence on the same observations. Curve b is state[b, begin[b]:end[b]], the seed in the
    middle of the row; strength[b] is the seed's evidence."""
    middle = state.shape[1] // 2
    view = _new_view(len(index.cos))
    for b in range(len(seeds)):
        begin[b] = end[b] = middle
        strength[b], p, g, bend = _snap(index, seeds[b], directions[b], least, box, view)
        if strength[b] < least:
            continue
        state[b, middle, :3], state[b, middle, 3:6], state[b, middle, 6:], evidence[b, middle] = p, g, bend, strength[b]
        ahead, stops[b, 1] = _grow_end(index, box, view, state[b, middle:], evidence[b, middle:], 1, 1.0)
        last = middle + ahead - 1
        back, stops[b, 0] = _grow_end(index, box, view, state[b, last::-1], evidence[b, last::-1], ahead, -1.0)
        begin[b], end[b] = last + 1 - back, last + 1


@njit(cache=True, nogil=True, fastmath=True)
def _claim(index, points, box, take):
    """(observations of a curve (n, 3) still there, observations in all); with ``take`` they are used up (REMOVE-FEATURES)."""
    there = total = 0
    reach_focus = 2.5 * box.sigma_focus
    for j in range(len(points)):
        tangent = points[min(j + 1, len(points) - 1)] - points[max(j - 1, 0)]
        tangent /= np.sqrt(np.sum(tangent**2)) + 1e-30
        for k in range(len(index.cos)):
            frame, angle, size = _hair_frame(index, k, points[j], tangent)
            if size < 0.2 or not _sees(index, k, frame[0, 0], frame[0, 1], frame[0, 2]):
                continue
            reach = np.abs(frame[1]) * box.step * 0.5 + np.abs(frame[2]) * reach_focus + np.abs(frame[3]) * box.claim
            first_frame, last_frame = frames_between(index, k, frame[0, 2] - reach[2], frame[0, 2] + reach[2])
            s0, s1, b0, b1 = cell_range(index, frame[0, 0], frame[0, 1], reach[0], reach[1])
            for strip in range(s0, s1):
                for block in range(b0, b1):
                    start, stop = run_of(index, k, strip, block, first_frame, last_frame)
                    for i in range(start, stop):
                        u, v = image_of(index, i, strip, block)
                        x, y = u - frame[0, 0], v - frame[0, 1]
                        z = index.positions[index.first_position[k] + index.frame[i]] - frame[0, 2]
                        if abs(frame[3, 0] * x + frame[3, 1] * y + frame[3, 2] * z) > box.claim:
                            continue
                        if abs(frame[1, 0] * x + frame[1, 1] * y + frame[1, 2] * z) > 0.5 * box.step:
                            continue
                        if abs(frame[2, 0] * x + frame[2, 1] * y + frame[2, 2] * z) > reach_focus:
                            continue
                        off = index.angle[i] * (np.pi / ANGLE_STEPS) - angle
                        off -= np.pi * np.round(off / np.pi)
                        if abs(off) > 2.2 * box.sigma_angle:
                            continue
                        total += 1
                        there += index.strength[i] < USED
                        if take:
                            index.strength[i] |= USED
    return there, total


# ---- seeds -----------------------------------------------------------------------------------------------------------


class _Grid(NamedTuple):
    low: np.ndarray  # (3,) mm
    cell: float
    shape: tuple[int, int, int]


@njit(cache=True, nogil=True)
def _raster(index, grid, masks):
    """Set bit k of every cell of masks (nx, ny, nz) in which sweep k has a feature."""
    for k in range(len(index.cos)):
        frames = index.first_position[k + 1] - index.first_position[k]
        strips, blocks = index.columns // STRIP_PX + 1, index.rows // BLOCK_PX + 1
        for strip in range(strips):
            for block in range(blocks):
                start, stop = run_of(index, k, strip, block, 0, frames)
                for i in range(start, stop):
                    u, v = image_of(index, i, strip, block)
                    d = index.positions[index.first_position[k] + index.frame[i]]
                    x, y, z = _turn_back(u, v, d, index.cos[k], index.sin[k])
                    a, b, c = int((x - grid.low[0]) / grid.cell), int((y - grid.low[1]) / grid.cell), int((z - grid.low[2]) / grid.cell)
                    if 0 <= a < masks.shape[0] and 0 <= b < masks.shape[1] and 0 <= c < masks.shape[2]:
                        masks[a, b, c] |= np.uint64(1) << np.uint64(k % 64)


@njit(cache=True, nogil=True)
def _bits(masks):
    counts = np.empty(masks.shape, np.uint8)
    flat, out = masks.reshape(-1), counts.reshape(-1)
    for i in range(len(flat)):
        n, m = 0, flat[i]
        while m:
            m &= m - np.uint64(1)
            n += 1
        out[i] = n
    return counts


@njit(cache=True, nogil=True)
def _seed_directions(index, centres, cell, least, directions, cameras):
    """Per cell: how many sweeps still have features in it, and the direction that their mean orientations agree on."""
    for c in range(len(centres)):
        normals, weights = np.zeros((len(index.cos), 3)), np.zeros(len(index.cos))
        cameras[c] = 0
        for k in range(len(index.cos)):
            u0, v0, w0 = _turn(centres[c, 0], centres[c, 1], centres[c, 2], index.cos[k], index.sin[k])
            first_frame, last_frame = frames_between(index, k, w0 - cell, w0 + cell)
            s0, s1, b0, b1 = cell_range(index, u0, v0, 0.75 * cell, 0.75 * cell)
            re = im = 0.0
            for strip in range(s0, s1):
                for block in range(b0, b1):
                    start, stop = run_of(index, k, strip, block, first_frame, last_frame)
                    for i in range(start, stop):
                        if index.strength[i] >= USED:
                            continue
                        u, v = image_of(index, i, strip, block)
                        if abs(u - u0) > 0.75 * cell or abs(v - v0) > 0.75 * cell:
                            continue
                        double = index.angle[i] * (2 * np.pi / ANGLE_STEPS)
                        re += np.cos(double)
                        im += np.sin(double)
            size = np.hypot(re, im)
            if size < 1.0:
                continue
            cameras[c] += 1
            angle = 0.5 * np.arctan2(im, re)
            sx, sy, sz = _slope(u0, v0, index.distance)
            ou, ov = np.cos(angle), np.sin(angle)
            n = np.array((ov * sz, -ou * sz, ou * sy - ov * sx))
            n /= np.sqrt(np.sum(n**2))
            normals[k] = _turn_back(n[0], n[1], n[2], index.cos[k], index.sin[k])
            weights[k] = 1.0
        if cameras[c] < least:
            continue
        guess = np.array((0.1, 1.0, 0.05))
        directions[c] = solve_direction(normals, weights, guess / np.sqrt(np.sum(guess**2)))


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
    """Places where a fiber may begin, most promising first."""

    centres: np.ndarray  # (n, 3) mm
    bound: np.ndarray  # (n,) the most evidence that each can have: as many as cameras recorded it, and what was found there; falls


def find_seeds(index: Index, params: GrowParams) -> Seeds:
    """The cells that at least ``min_seed_cameras`` sweeps recorded, most angles first."""
    grid = _seed_grid(index, params)
    masks = np.zeros(grid.shape, np.uint64)
    _raster(index, grid, masks)
    counts = _bits(masks)
    cells = np.flatnonzero(counts.ravel() >= params.min_seed_cameras)
    found = counts.ravel()[cells]
    shuffled = np.random.default_rng(0).permutation(len(cells))  # neighbours in a batch would grow the same fiber
    order = shuffled[np.argsort(-found[shuffled].astype(int), kind="stable")]
    where = np.stack(np.unravel_index(cells[order], grid.shape), -1)
    return Seeds(grid.low + (where + 0.5) * grid.cell, counts.ravel()[cells[order]].astype(float))


# ---- the whole -------------------------------------------------------------------------------------------------------


def grow(index: Index, params: GrowParams, workers: int = 1, progress: Progress = silent, seeds: Seeds | None = None) -> Grown:
    """Every fiber that the observations support, on ``workers`` threads. Uses up ``index.strength``.

    seeds: where to begin; what is found there lowers their bound, so that growing again looks at the rest. None: all there are.

    Deterministic: the same index and parameters give the same curves in the same order, whatever the number of threads.
    """
    box = _box(params, index)
    seeds = seeds or find_seeds(index, params)
    store = _BatchStore.of(BATCH, 2 * min(box.max_points, _longest(index, params)) + 1)
    curves: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    with ThreadPoolExecutor(workers) as pool:
        for number, share in enumerate(params.seed_evidence):
            least = share * params.min_evidence
            promising = np.flatnonzero(seeds.bound >= least)
            for first in range(0, len(promising), BATCH):
                progress("growing", number + first / max(len(promising), 1), len(params.seed_evidence))
                chosen = promising[first : first + BATCH]
                seeds.bound[chosen] = _grow_batch(pool, index, seeds.centres[chosen], least, params, box, store)
                curves += _accept(index, store, len(chosen), params.mean_share * least, params, box)
    progress("growing", len(params.seed_evidence), len(params.seed_evidence))
    return _flat(curves, len(seeds.centres))


def _grow_batch(pool: ThreadPoolExecutor, index: Index, seeds: np.ndarray, least: float, params: GrowParams, box: _Box, store: "_BatchStore"):
    """Grow the seeds (b, 3) of a batch into ``store``; returns their evidence (b,)."""

    def work(part: slice) -> None:
        directions, cameras = np.zeros((len(seeds[part]), 3)), np.zeros(len(seeds[part]), np.int64)
        _seed_directions(index, seeds[part], params.seed_cell_mm, params.min_seed_cameras, directions, cameras)
        store.strength[part] = 0
        store.begin[part] = store.end[part] = 0
        good = cameras >= params.min_seed_cameras
        rows = np.arange(part.start, part.stop)[good]
        for row, direction in zip(rows, directions[good], strict=True):
            one = slice(row, row + 1)
            _grow_seeds(index, seeds[one], direction[None], least, box, *store.part(one))

    _in_parts(pool, 8, len(seeds), work)
    return store.strength[: len(seeds)].copy()


def _in_parts(pool: ThreadPoolExecutor, size: int, count: int, work) -> None:
    """Call work(slice) for slices of ``size`` that cover range(count); the kernels let go of the interpreter's lock."""
    for _ in pool.map(work, [slice(i, min(i + size, count)) for i in range(0, count, size)]):
        pass


def _longest(index: Index, params: GrowParams) -> int:
    """Steps of the longest fiber worth making room for: ten times the height of the captured volume."""
    return int(10 * index.rows * index.pitch / params.step_mm) + 10


@dataclass(frozen=True)
class _BatchStore:
    """Room for the curves of a batch, made once."""

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

    def part(self, s: slice):
        return self.state[s], self.evidence[s], self.begin[s], self.end[s], self.stops[s], self.strength[s]

    def curve(self, b: int):
        """Copies of the points, the evidence and the stops of curve b."""
        row = slice(self.begin[b], self.end[b])
        return self.state[b, row, :3].copy(), self.evidence[b, row].copy(), self.stops[b].copy()


def _accept(index, store: _BatchStore, count: int, least: float, params: GrowParams, box: _Box):
    """The curves of a batch that are long enough, have evidence and stand on observations of their own; most evidence first."""
    accepted = []
    long = [b for b in range(count) if (store.end[b] - store.begin[b] - 1) * params.step_mm >= params.min_length_mm]
    for curve in sorted((store.curve(b) for b in long), key=lambda c: -float(c[1].sum())):
        points, evidence, _ = curve
        there, total = _claim(index, points, box, False)
        if there < params.min_own * total or total == 0 or evidence.mean() < least:
            continue
        _claim(index, points, box, True)
        accepted.append(curve)
    return accepted


def _flat(curves, tried: int) -> Grown:
    if not curves:
        return Grown(np.zeros((0, 3), np.float32), np.zeros(1, np.int64), np.zeros(0, np.float32), np.zeros((0, 2), np.uint8), tried)
    points, evidence, stops = zip(*curves, strict=True)
    offsets = np.concatenate([[0], np.cumsum([len(p) for p in points])]).astype(np.int64)
    return Grown(np.concatenate(points).astype(np.float32), offsets, np.concatenate(evidence), np.stack(stops), tried)
