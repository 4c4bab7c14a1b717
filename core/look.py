"""What the cameras see of a hair at a place: the observations of every sweep in the box of a hair (sec. 4.2), the line that fits them
best, and how much they are worth as evidence.

Everything that grows, refines or measures fibers looks through here, some hundred thousand times a lock, so it is made for speed:
places in the frame of the hair are linear in what features store, and are told for a run of cells at once.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from .features import ANGLE_STEPS, BLOCK_PX, COL_STEPS, ROW_STEPS, STRIP_PX, USED, cell_range, frames_between, run_of, strength_of
from .geometry import slope, to_image, to_pixel, turn, turn_back

_turn, _turn_back, _slope, _to_pixel, _to_image = njit(turn), njit(turn_back), njit(slope), njit(to_pixel), njit(to_image)
CHUNK = 256  # features that are looked at together
MAX_HITS = 1024  # observations that one camera has of a place
LANES = 16  # sums that are added up side by side
SETTLED = 0.1  # of sigma: a fit that moves by no more is the last but one
PLACE_PX, ANGLE_RAD = 0.22, 0.0436  # errors of one observation across the hair and of its angle (2.5 degrees)
TWIST_RAD = 0.0698  # a camera that sees the hair turned by more than this (4 degrees) is no evidence for it
SHARE_POWER = 0.1  # of the share of its observations that a camera has: many that see a little tell more than one that sees all
UNSEEN = 0.1  # evidence that a camera costs which sees no hair where it should be
SPREAD_PX = (0.18, 0.3)  # of a hair's observations across it; a camera whose observations spread by the second more tells nothing
LEAST_SIZE = 0.2  # of the image of a mm of hair, mm
GATE = 2.2  # of sigma_angle: observations turned by more belong to other hair
BOW = 0.207  # biweights (1 - BOW x^2)^2 are about as wide as Gaussians: no exp, and nothing from far away


class Box(NamedTuple):
    """What is looked at, and what counts, in mm and radians."""

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


# ---- one camera's view of a point of a hair --------------------------------------------------------------------------


class Frame(NamedTuple):
    """A hair at a point, as one camera has it, in (u', v', w)."""

    p: tuple[float, float, float]  # the point
    g: tuple[float, float, float]  # along the hair
    s: tuple[float, float, float]  # along the ribbon, perpendicular to g: its slope
    t: tuple[float, float, float]  # across the ribbon: g x s
    angle: float  # of the hair in the image, rad
    size: float  # how long a mm of hair is in the image, mm


@njit(cache=True, nogil=True)
def sees(index, k, u, v, w):
    """Whether the point (u', v', w) of camera k's frame comes into focus inside its photographs."""
    low, high = index.positions[index.first_position[k]], index.positions[index.first_position[k + 1] - 1]
    col, row = _to_pixel(u, v, index.pitch, index.axis_col, index.axis_row)
    return low <= w <= high and 0 <= col <= index.columns - 1 and 0 <= row <= index.rows - 1


@njit(cache=True, nogil=True)
def hair_frame(index, k, p, g):
    """Camera k's Frame of a hair at p (3,) along the unit vector g (3,)."""
    pu, pv, pw = _turn(p[0], p[1], p[2], index.cos[k], index.sin[k])
    gu, gv, gw = _turn(g[0], g[1], g[2], index.cos[k], index.sin[k])
    su, sv, sw = _slope(pu, pv, index.distance)
    along = su * gu + sv * gv + sw * gw
    su, sv, sw = su - along * gu, sv - along * gv, sw - along * gw
    over = 1 / np.sqrt(su * su + sv * sv + sw * sw)
    su, sv, sw = su * over, sv * over, sw * over
    t = gv * sw - gw * sv, gw * su - gu * sw, gu * sv - gv * su
    # how the image of the point moves as it slides along the hair, at focus: d(u, v) = (g_u + u/l g_w, g_v + v/l g_w)
    du, dv = gu + pu / index.distance * gw, gv + pv / index.distance * gw
    return Frame((pu, pv, pw), (gu, gv, gw), (su, sv, sw), t, np.arctan2(dv, du), np.hypot(du, dv))


@njit(cache=True, nogil=True)
def shows(index, k, frame):
    """Whether camera k shows a hair of this Frame: it comes into focus inside a photograph, and does not point at the camera."""
    return frame.size >= LEAST_SIZE and sees(index, k, frame.p[0], frame.p[1], frame.p[2])


class Hits(NamedTuple):
    """Observations of a hair by one camera after the other: arrays (n,) float32, and room to find them."""

    along: np.ndarray  # mm
    across: np.ndarray  # mm, less what the hair bends
    turn: np.ndarray  # rad, less what the hair bends
    depth: np.ndarray  # mm along the ribbon
    weight: np.ndarray
    strength: np.ndarray  # weighted by turn
    free: np.ndarray  # 1, or less where another curve has used it up
    number: np.ndarray  # int32, in the index
    near: np.ndarray  # (5 CHUNK,) of the features that are looked at: along, across, turn, depth, and first the position, then whether inside


@njit(cache=True, nogil=True)
def new_hits(cameras):
    """Room for the observations of so many cameras."""
    told = np.empty((7, cameras * MAX_HITS + LANES), np.float32)
    number, near = np.empty(cameras * MAX_HITS, np.int32), np.empty(5 * CHUNK, np.float32)
    return Hits(told[0], told[1], told[2], told[3], told[4], told[5], told[6], number, near)


@njit(cache=True, nogil=True)
def gather(index, k, frame, bend, sag, box, hits, count):
    """Observations of camera k in the box of a hair, into hits from ``count`` on; returns how many there are now.

    bend, sag: curvature of the hair towards t and towards s (1/mm). What the hair itself bends away is taken from across, turn
    and depth. Observations deeper than half[1] have no weight, but tell how deep the camera sees the hair.
    """
    (pu, pv, pw), (gu, gv, gw), (su, sv, sw), (tu, tv, tw) = frame.p, frame.g, frame.s, frame.t
    half, before = box.half, count
    reach_u = abs(gu) * half[0] + abs(su) * box.deep + abs(tu) * half[2]
    reach_v = abs(gv) * half[0] + abs(sv) * box.deep + abs(tv) * half[2]
    reach_w = abs(gw) * half[0] + abs(sw) * box.deep + abs(tw) * half[2]
    first_frame, last_frame = frames_between(index, k, pw - reach_w, pw + reach_w)
    s0, s1, b0, b1 = cell_range(index, pu, pv, reach_u, reach_v)
    # along, across and depth: a constant, and so much a unit of the stored column and row, and a mm of the position
    col, row = index.pitch / COL_STEPS, -index.pitch / ROW_STEPS
    along, across, depth = (gu * col, gv * row, gw), (tu * col, tv * row, tw), (su * col, sv * row, sw)
    limits = half[0], half[2], box.deep, GATE * box.sigma_angle
    positions = index.positions_f32[index.first_position[k] : index.first_position[k + 1]]
    stored, found = (index.col, index.row, index.frame, index.angle, index.strength), (hits.along, hits.across, hits.turn, hits.depth)
    for strip in range(s0, s1):
        for block in range(b0, b1):
            start, stop = run_of(index, k, strip, block, first_frame, last_frame)
            if start == stop:
                continue
            x, y = _to_image(float(strip * STRIP_PX), float(block * BLOCK_PX), index.pitch, index.axis_col, index.axis_row)
            x, y = x - pu, y - pv
            at = gu * x + gv * y - gw * pw, tu * x + tv * y - tw * pw, su * x + sv * y - sw * pw
            placing = at, along, across, depth, frame.angle, bend, sag, limits
            count = _taken(stored, start, stop, positions, placing, box.shared, hits.near, found, hits.strength, hits.free, hits.number, count)
    _weighted(box, hits, before, count)
    return count


@njit(cache=True, nogil=True)
def _taken(stored, start, stop, positions, placing, shared, near, found, h_strength, h_free, h_number, count):
    """Place features start … stop - 1 of a camera in the frame of a hair, and take those in the box; returns how many hits there are now.

    It is given the arrays that it needs and no more: a call takes as long as its arguments are many, and a run has some hundred features.
    """
    f32, size = np.float32, np.uint64(CHUNK)
    (cols, rows, frames, angles, levels), (h_along, h_across, h_turn, h_depth) = stored, found
    (a_at, t_at, d_at), along, across, depth, angle, bend, sag, limits = placing
    a_at, t_at, d_at = f32(a_at), f32(t_at), f32(d_at)
    a_col, a_row, a_pos = f32(along[0]), f32(along[1]), f32(along[2])
    t_col, t_row, t_pos = f32(across[0]), f32(across[1]), f32(across[2])
    d_col, d_row, d_pos = f32(depth[0]), f32(depth[1]), f32(depth[2])
    bent, half_bent, half_sagged = f32(bend), f32(0.5 * bend), f32(0.5 * sag)
    unit, turned, over, pi, half_turn = f32(np.pi / ANGLE_STEPS), f32(angle), f32(1 / np.pi), f32(np.pi), f32(0.5)
    long, wide, deep, gate = f32(limits[0]), f32(limits[1]), f32(limits[2]), f32(limits[3])
    first, end = np.uint64(start), np.uint64(stop)
    while first < end:
        many = min(end - first, size)
        for i in range(many):  # alone, since a look into a table keeps a loop from being done by vectors
            near[i + 4 * size] = positions[np.uint64(frames[first + i])]
        for i in range(many):
            c, r, p = f32(cols[first + i]), f32(rows[first + i]), near[i + 4 * size]
            a = a_at + a_col * c + a_row * r + a_pos * p
            t = t_at + t_col * c + t_row * r + t_pos * p - half_bent * a * a
            d = d_at + d_col * c + d_row * r + d_pos * p - half_sagged * a * a
            # s looks at the camera and t = g x s, so a hair that turns counterclockwise in the image leans away from t
            off = f32(angles[first + i]) * unit - turned + bent * a
            off -= pi * np.floor(off * over + half_turn)
            near[i], near[i + size], near[i + 2 * size], near[i + 3 * size] = a, t, off, d
            near[i + 4 * size] = f32(1) if (abs(a) <= long) & (abs(t) <= wide) & (abs(d) <= deep) & (abs(off) <= gate) else f32(0)
        for i in range(many):
            if near[i + 4 * size] > 0 and count < len(h_number):
                level = levels[first + i]
                h_along[count], h_across[count], h_turn[count], h_depth[count] = near[i], near[i + size], near[i + 2 * size], near[i + 3 * size]
                h_strength[count], h_free[count], h_number[count] = strength_of(level), shared if level >= USED else 1.0, first + i
                count += 1
        first += many
    return count


@njit(cache=True, nogil=True)
def _weighted(box, hits, start, stop):
    """Give the hits start … stop - 1 their weight, and their strength its part."""
    f32 = np.float32
    turns, depths, weights, strengths, frees = (
        hits.turn[start:stop],
        hits.depth[start:stop],
        hits.weight[start:stop],
        hits.strength[start:stop],
        hits.free[start:stop],
    )
    by_angle, by_focus, middle, bow, one, none = f32(1 / box.sigma_angle), f32(1 / box.sigma_focus), f32(box.half[1]), f32(BOW), f32(1), f32(0)
    for i in range(len(turns)):
        y, z = turns[i] * by_angle, depths[i] * by_focus
        y, z = max(one - bow * y * y, none), max(one - bow * z * z, none)
        z = z if abs(depths[i]) <= middle else none
        weights[i] = y * y * z * z * frees[i]
        strengths[i] = y * y * strengths[i]
    for i in range(stop, stop + LANES):  # ``_moments`` reads on
        hits.along[i] = hits.across[i] = hits.turn[i] = hits.weight[i] = none


class View(NamedTuple):
    """What the cameras say of a point: arrays over the sweeps."""

    hits: Hits
    ends: np.ndarray  # (S + 1,) int64: where each camera's observations begin
    across: np.ndarray  # (S, 3) t of each ribbon, object frame
    full: np.ndarray  # (S,) weight of the observations of a hair in full view; 0 for a camera that cannot see it
    told: np.ndarray  # (S,) what each camera's observations are worth as evidence, 0 to 1


@njit(cache=True, nogil=True)
def new_view(cameras):
    """Room for a View by so many cameras."""
    return View(new_hits(cameras), np.zeros(cameras + 1, np.int64), np.zeros((cameras, 3)), np.zeros(cameras), np.zeros(cameras))


@njit(cache=True, nogil=True)
def look(index, p, g, bend, box, view):
    """Gather every camera's observations of a hair at p along g that bends by the curvature vector ``bend`` (3,) 1/mm.
    Returns how many cameras could see it."""
    could = count = 0
    for k in range(len(index.cos)):
        view.ends[k] = count
        view.full[k] = 0.0
        frame = hair_frame(index, k, p, g)
        if not sees(index, k, frame.p[0], frame.p[1], frame.p[2]):
            continue
        could += 1
        if frame.size < LEAST_SIZE:  # the hair points at the camera
            continue
        tx, ty, tz = _turn_back(frame.t[0], frame.t[1], frame.t[2], index.cos[k], index.sin[k])
        sx, sy, sz = _turn_back(frame.s[0], frame.s[1], frame.s[2], index.cos[k], index.sin[k])
        view.across[k, 0], view.across[k, 1], view.across[k, 2] = tx, ty, tz
        view.full[k] = max(frame.size, 0.3) * box.full_support
        towards = bend[0] * tx + bend[1] * ty + bend[2] * tz, bend[0] * sx + bend[1] * sy + bend[2] * sz
        count = gather(index, k, frame, towards[0], towards[1], box, view.hits, count)
    view.ends[len(index.cos)] = count
    return could


# ---- the hair that fits ----------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def visible_range(view, around):
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


@njit(cache=True, nogil=True)
def _moments(hits, start, stop, o0, o1, o2, narrow, sums):
    """Fill sums (12 LANES,) with sums over the observations start … stop - 1 of one camera, each by its weight and how near it lies to
    the line o0 + a (o1 + a o2 / 2): of a^0 … a^4, across a^0 … a^2, minus turn a^0 and a^1, what is left of across, and its square.

    Added up in LANES, since a compiler may not change the order of a sum by itself; the first of each twelve lanes is all of it then.
    """
    f32, n = np.float32, LANES
    alongs, offs, turns, weights, end = hits.along, hits.across, hits.turn, hits.weight, np.uint64(stop)
    o0, o1, o2, narrow, bow, one, none = f32(o0), f32(o1), f32(0.5 * o2), f32(narrow), f32(BOW), f32(1), f32(0)
    sums[:] = none
    for first in range(np.uint64(start), end, np.uint64(n)):
        left_over = f32(end - first)
        for i in range(n):
            a, across, off = alongs[first + i], offs[first + i], turns[first + i]
            left = across - (o0 + a * (o1 + a * o2))
            x = left * narrow
            x = max(one - bow * x * x, none)
            w = weights[first + i] * x * x * (one if f32(i) < left_over else none)  # a choice of numbers is made by vectors
            wa = w * a
            waa = wa * a
            waaa = waa * a
            rest = w * left
            sums[i] += w
            sums[n + i] += wa
            sums[2 * n + i] += waa
            sums[3 * n + i] += waaa
            sums[4 * n + i] += waaa * a
            sums[5 * n + i] += w * across
            sums[6 * n + i] += wa * across
            sums[7 * n + i] += waa * across
            sums[8 * n + i] -= w * off
            sums[9 * n + i] -= wa * off
            sums[10 * n + i] += rest
            sums[11 * n + i] += rest * left
    for c in range(12):
        o = c * n
        for i in range(n // 2):
            sums[o + i] += sums[o + n // 2 + i]
        for i in range(n // 4):
            sums[o + i] += sums[o + n // 4 + i]
        sums[o] = (sums[o] + sums[o + 1]) + (sums[o + 2] + sums[o + 3])


@njit(cache=True, nogil=True)
def _depth_of(hits, start, stop, o0, o1, o2, narrow, deepest):
    """Strength of the observations start … stop - 1 of one camera near the line, that of those no other curve has, and this times depth."""
    f32 = np.float32
    alongs, offs, depths = hits.along[start:stop], hits.across[start:stop], hits.depth[start:stop]
    strengths, frees = hits.strength[start:stop], hits.free[start:stop]
    o0, o1, o2, narrow, deepest, bow, one, none = f32(o0), f32(o1), f32(0.5 * o2), f32(narrow), f32(deepest), f32(BOW), f32(1), f32(0)
    whole = free = deep = none
    for i in range(len(alongs)):
        a = alongs[i]
        x, z = (offs[i] - (o0 + a * (o1 + a * o2))) * narrow, depths[i] * deepest
        x, z = max(one - bow * x * x, none), max(one - z * z, none)
        z = strengths[i] * x * x * z * z
        whole += z
        z *= frees[i]
        free += z
        deep += z * depths[i]
    return np.float64(whole), np.float64(free), np.float64(deep)


@njit(cache=True, nogil=True)
def fit(view, around, g, box, wide, prior):
    """The bent line that the observations of ``view`` support: (cameras that agree, evidence, place, direction, curvature).

    The last three are vectors (3,) perpendicular to g by which the hair differs from the one looked for: at the way ``a``
    along g it lies at place + direction a + curvature a^2 / 2. Weighted least squares over the offsets and the angles of all
    observations at once (eq. 3 made longer), three times at most: each observation counts less the farther it lies from the hair
    of the time before, and so does a camera as a whole. ``wide`` is the width of that weight in sigma; ``prior`` holds place,
    direction and curvature to what was looked for.
    """
    cameras, n, f64 = len(view.told), LANES, np.float64
    ax, ay = perpendicular(g)
    theta, before, sums = np.zeros(6), np.zeros(6), np.empty(12 * LANES, np.float32)
    m, b = np.empty((6, 6)), np.empty(6)
    lever = (PLACE_PX * box.pixel / ANGLE_RAD) ** 2
    spoke, last = 0, False
    for trial in range(4):
        last |= trial == 3
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
            _moments(view.hits, view.ends[k], view.ends[k + 1], o0, o1, o2, narrow, sums)
            s0, s1, s2, s3, s4 = f64(sums[0]), f64(sums[n]), f64(sums[2 * n]), f64(sums[3 * n]), f64(sums[4 * n])
            r0, r1, r2, l0, l1 = f64(sums[5 * n]), f64(sums[6 * n]), f64(sums[7 * n]), f64(sums[8 * n]), f64(sums[9 * n])
            rest, rest2 = f64(sums[10 * n]), f64(sums[11 * n])
            share = s0 / view.full[k]
            if share < box.min_support:
                continue
            far = rest / s0 / (wide * box.agree)
            agree = max(1 - far * far, 0.0) ** 2
            if agree == 0:
                continue
            twist = (o1 + (o2 * s1 - l0) / s0) / TWIST_RAD
            spoke += 1
            if last:
                spread = np.sqrt(max(rest2 / s0 - (rest / s0) ** 2, 0.0)) / (wide * box.pixel)
                sharp = min(max(1 - (spread - SPREAD_PX[0]) / SPREAD_PX[1], 0.1), 1.2)
                whole, free, deep = _depth_of(view.hits, view.ends[k], view.ends[k + 1], o0, o1, o2, narrow, deepest)
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
        if spoke == 0 or last:
            break
        before[:] = theta
        _cholesky_solve(m, b, theta)
        before -= theta
        last = _far(before, box.half[0]) < SETTLED * wide * box.sigma
    return spoke, visible_range(view, around), theta[0] * ax + theta[1] * ay, theta[2] * ax + theta[3] * ay, theta[4] * ax + theta[5] * ay


@njit(cache=True, nogil=True)
def _far(theta, reach):
    """How far apart two lines of which the ``theta`` differ by (6,) may be, within ``reach`` to either side."""
    x, y = (
        abs(theta[0]) + reach * (abs(theta[2]) + 0.5 * reach * abs(theta[4])),
        abs(theta[1]) + reach * (abs(theta[3]) + 0.5 * reach * abs(theta[5])),
    )
    return np.hypot(x, y)


@njit(cache=True, nogil=True)
def perpendicular(g):
    """Two unit vectors (3,) that make a right-handed frame with the unit vector g."""
    x = np.zeros(3)
    x[np.argmin(np.abs(g))] = 1.0
    x -= g * (g[0] * x[0] + g[1] * x[1] + g[2] * x[2])
    x /= np.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
    return x, np.cross(g, x)


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def unit(g):
    """g (3,), 1 long."""
    return g / np.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])


@njit(cache=True, nogil=True)
def chord(points, j):
    """Unit direction (3,) of a curve of points (n, 3) at point j."""
    return unit(points[min(j + 1, len(points) - 1)] - points[max(j - 1, 0)])


# ---- what a curve stands on ------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def claimed(index, points, box):
    """Numbers (n,) int32 of the observations that a curve of points (m, 3) stands on, used up or not."""
    hits, count = new_hits(1), 0
    numbers = np.empty(64 * len(points), np.int32)
    for j in range(len(points)):
        g = chord(points, j)
        for k in range(len(index.cos)):
            frame = hair_frame(index, k, points[j], g)
            if not shows(index, k, frame):
                continue
            found = gather(index, k, frame, 0.0, 0.0, box, hits, 0)
            if count + found > len(numbers):
                more = np.empty(2 * (count + found), np.int32)
                more[:count] = numbers[:count]
                numbers = more
            numbers[count : count + found] = hits.number[:found]
            count += found
    return numbers[:count].copy()
