"""From grown pieces to fibers: each curve is fitted to all of its observations at once, loses the ends that nothing supports,
and is joined to the piece of the same fiber beyond a place where it could not be seen.

A curve is a smoothing spline in its plain form: a point every step, tied to the observations of every camera, with a price on
the change of its curvature (Whittaker 1923), which is the price that makes the observations likeliest.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from scipy.interpolate import CubicHermiteSpline
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.spatial import cKDTree

from .features import USED, Index
from .geometry import turn_back
from .grow import MAX_HITS, Grown, GrowParams, _Box, _box, _claim, _fit, _gather, _grow_end, _hair_frame, _look, _new_view, _sees, find_seeds, grow
from .progress import Progress, silent
from .stops import Stop

_turn_back = njit(turn_back)
JERKS_PER_MM2 = tuple(0.015 * 2.0**i for i in range(9))  # change of curvature a mm, at random each step, from straight hair to tight curls
GROWING_SHARE = 0.6  # of the time of a round
BEND_PX = 3.6  # sigma along the hair of what places a ridge, hair's width and slab included: it sees a bend from inside
STIFF = 10.0  # cameras: what holds a point in its place along the hair


@dataclass(frozen=True)
class RefineParams:
    """How curves are grown in rounds, fitted, cut and joined."""

    rounds: int = 3  # of the fit: ties are found anew where the curve has moved
    slab_px: float = 0.2  # error of what one camera says of one step of a curve, rows and frames that err alike included
    near_mm: float = 0.6  # evidence of a point is that of this length around it
    step_evidence: tuple[float, float, float] = (2.5, 1.5, 0.8)  # evidence that a step needs in the rounds of ``trace``
    new_evidence: float = 0.4  # no new curve is begun in a round that asks for less
    join_cost: float = 6.0  # misfit of two ends, squared, in units of the next two
    join_mm: float = 1.5  # longest gap over which two pieces are joined
    join_place: tuple[float, float] = (0.02, 0.02)  # mm, and mm a mm of gap: how well two ends must meet in the middle of it
    join_turn_deg: tuple[float, float] = (2.0, 4.0)  # and a mm of gap: how well their directions must agree
    same_mm: float = 0.04  # closer than this to a better curve, along it, a curve is the same hair
    min_length_mm: float = 1.5  # shorter curves are taken for chance
    mean_evidence: tuple[float, float] = (1.3, 1.5)  # and those that have less evidence than the first, and less than this many mm of it


@dataclass(frozen=True)
class Curve:
    """One curve while it is being refined."""

    points: np.ndarray  # (n, 3) mm, a step apart
    evidence: np.ndarray  # (n,)
    stops: tuple[int, int]  # why either end stopped
    fitted: bool = False  # nothing has changed since the last fit


# ---- the fit ---------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True, fastmath=True)
def _tie(index, points, box, normal, right):
    """What the cameras say of each point (n, 3): the sums normal (n, 3, 3) and right (n, 3) of its least squares, in cameras
    that see it fully. Observations are those within half a step along the hair; their place is that of the hair's image
    averaged along it, which lies by half the curvature times BEND_PX squared inside a bend."""
    n = len(points)
    reach = min(4, (n - 1) // 2)
    inside = 0.5 * (BEND_PX * index.pitch) ** 2
    hits = np.empty((MAX_HITS, 4))
    for j in range(n):
        g = points[min(j + 1, n - 1)] - points[max(j - 1, 0)]
        g /= np.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
        bend = np.zeros(3)
        if reach > 0:
            m = min(max(j, reach), n - 1 - reach)
            bend = (points[m + reach] + points[m - reach] - 2 * points[m]) / (reach * box.step) ** 2
        for c in range(3):  # a point is not to slide along its hair
            right[j, c] = 0.0
            for d in range(3):
                normal[j, c, d] = STIFF * g[c] * g[d]
        for k in range(len(index.cos)):
            frame, angle, size = _hair_frame(index, k, points[j], g)
            if size < 0.2 or not _sees(index, k, frame[0, 0], frame[0, 1], frame[0, 2]):
                continue
            count = _gather(index, k, frame, angle, 0.0, box, hits, 0)
            s = r = 0.0
            for i in range(count):
                x = hits[i, 1] / box.sigma
                x = max(1 - 0.207 * x * x, 0.0)
                w = hits[i, 3] * x * x
                s += w
                r += w * hits[i, 1]
            if s < 1e-6:
                continue
            share, t = min(s / box.full_support, 1.0), np.empty(3)
            t[0], t[1], t[2] = _turn_back(frame[3, 0], frame[3, 1], frame[3, 2], index.cos[k], index.sin[k])
            place = r / s - inside * (t[0] * bend[0] + t[1] * bend[1] + t[2] * bend[2]) / (size * size)
            for c in range(3):
                right[j, c] += share * place * t[c]
                for d in range(3):
                    normal[j, c, d] += share * t[c] * t[d]


def smoothed(points: np.ndarray, normal: np.ndarray, right: np.ndarray, price: float) -> tuple[np.ndarray, float]:
    """points (n, 3) moved to the least of: what ``normal`` (n, 3, 3) and ``right`` (n, 3) say of each point's move, and
    ``price`` times the square of the third differences of the moved curve; and the logarithm of how likely such ties are
    if that is the price, but for a constant. normal and right in units of the ties' own errors. A banded system, O(n).
    """
    n = len(points)
    if n < 4:
        return points, 0.0
    third = np.array([-1.0, 3.0, -3.0, 1.0])
    bands, pull = np.zeros((10, 3 * n)), right.copy()
    for c in range(3):
        for d in range(c, 3):
            bands[9 - (d - c), d::3] = normal[:, c, d]
    jump = np.diff(points, 3, axis=0)
    for a in range(4):
        pull[a : n - 3 + a] -= price * third[a] * jump
        for b in range(a, 4):
            bands[9 - 3 * (b - a), 3 * b : 3 * (n - 3 + b)] += price * third[a] * third[b]
    bands[9] += 1e-9 + 1e-13 * price  # a hair that nothing ties is still held somewhere
    factor = cholesky_banded(bands)
    move = cho_solve_banded((factor, False), pull.reshape(-1)).reshape(n, 3)
    misfit = np.einsum("ni,nij,nj", move, normal, move) - 2 * np.sum(right * move) + price * np.sum(np.diff(points + move, 3, axis=0) ** 2)
    likely = 1.5 * (n - 3) * np.log(price) - np.log(factor[9]).sum() - 0.5 * misfit
    return points + move, float(likely)


def _fitted(index: Index, points: np.ndarray, box: _Box, params: RefineParams) -> np.ndarray:
    """Points (n, 3) of a curve fitted to its observations, as stiff as these make likely (empirical Bayes)."""
    normal, right = np.empty((len(points), 3, 3)), np.empty((len(points), 3))
    error = params.slab_px * index.pitch
    for _ in range(params.rounds):
        _tie(index, points, box, normal, right)
        fits = [smoothed(points, normal / error**2, right / error**2, (box.step**3 * jerk) ** -2) for jerk in JERKS_PER_MM2]
        points = np.ascontiguousarray(max(fits, key=lambda fit: fit[1])[0])
    return points


@njit(cache=True, nogil=True, fastmath=True)
def _weigh(index, points, box, evidence):
    """Evidence (n,) of each point (n, 3) of a curve that is already where it should be."""
    n = len(points)
    view, free = _new_view(len(index.cos)), (1e9, 1e9, 1e9)
    for j in range(n):
        a, b = max(j - 2, 0), min(j + 2, n - 1)
        m = (a + b) // 2
        g = points[min(j + 1, n - 1)] - points[max(j - 1, 0)]
        g /= np.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
        half = 0.5 * (b - a) * box.step
        bend = (points[a] + points[b] - 2 * points[m]) / (half * half) if b - a == 4 else np.zeros(3)
        bend -= g * (g[0] * bend[0] + g[1] * bend[1] + g[2] * bend[2])
        _look(index, points[j], g, bend, box, view)
        _, evidence[j], _, _, _ = _fit(view, index.around, g, box, 1.0, free)


# ---- growing on ------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True, fastmath=True)
def _grow_on(index, points, box, state, evidence):
    """Grow on from the last of points (n, 3); fills state (m, 9) and evidence (m,), which begin with the points' own last
    ones. Returns (rows of the points', rows there are, Stop)."""
    n = len(points)
    known = min(20, n)
    for i in range(known):
        j = n - known + i
        a, b = max(j - 2, 0), min(j + 2, n - 1)
        m = (a + b) // 2
        g = points[b] - points[a]
        size = np.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
        one, two = points[b] - points[m], points[m] - points[a]
        l1, l2 = np.sqrt(np.sum(one**2)), np.sqrt(np.sum(two**2))
        state[i, :3], state[i, 3:6] = points[j], g / size
        state[i, 6:] = (one / l1 - two / l2) / (0.5 * (l1 + l2)) if b - a == 4 else np.zeros(3)
        if b - a < 4 and i > 1 and j > 1:  # at the end itself the middle of a chord says nothing of the direction
            bend = state[i - 1, 6:].copy()
            state[i, 6:] = bend
            way = state[i - 1, 3:6] + box.step * bend
            state[i, 3:6] = way / np.sqrt(np.sum(way**2))
        evidence[i] = 4.0
    filled, stop = _grow_end(index, box, _new_view(len(index.cos)), state, evidence, known, 1.0)
    return known, filled, stop


# ---- the whole -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Work:
    """What all the steps below need."""

    index: Index
    params: RefineParams
    box: _Box  # as for growing
    slab: _Box  # half a step to either side
    near: _Box  # the length over which evidence is weighed
    each: Callable  # each(function, items): a list, on all threads


def trace(index: Index, grow_params: GrowParams, params: RefineParams, workers: int = 1, progress: Progress = silent) -> Grown:
    """The fibers that the observations support, in rounds: the clearest hair first, so that what it stands on is out of the way
    of the rest. Each round grows curves on what is left, then refines all of them and grows them on.

    The same for any number of ``workers``: each curve is fitted alone, and what compares curves runs in a fixed order.
    """
    curves: list[Curve] = []
    seeds = find_seeds(index, grow_params)
    for number, evidence in enumerate(params.step_evidence):
        told = _part_of(progress, number, len(params.step_evidence))
        growing = replace(grow_params, min_evidence=evidence)
        with ThreadPoolExecutor(workers) as pool:
            work = _work(index, params, growing, lambda function, items, pool=pool: list(pool.map(function, items)))
            if evidence >= params.new_evidence:
                _mark(curves, work)
                curves = curves + _curves(grow(index, growing, workers, told, seeds))
            for i, stage in enumerate(STAGES):
                told("growing", 1 + i / len(STAGES) * (1 / GROWING_SHARE - 1), 1)
                index.strength[:] &= USED - 1
                curves = stage(curves, work)
            curves = _keep(curves, work)
    progress("growing", 1, 1)
    return _flat(curves, len(seeds.centres))


def _part_of(progress: Progress, number: int, rounds: int) -> Progress:
    """Progress of the growing of one round as part of all."""
    return lambda stage, done, total: progress(stage, number + GROWING_SHARE * done / max(total, 1), rounds)


def _work(index: Index, params: RefineParams, grow_params: GrowParams, each: Callable) -> _Work:
    box = _box(grow_params, index)
    wide = 1.5 * index.pitch
    slab, near = (mm / (2 * box.half[0]) for mm in (box.step, params.near_mm))  # of the length of the box
    return _Work(
        index=index,
        params=params,
        box=box,
        slab=box._replace(half=(0.5 * box.step, box.half[1], wide), full_support=slab * box.full_support),
        near=box._replace(half=(0.5 * params.near_mm, box.half[1], wide), full_support=near * box.full_support),
        each=each,
    )


def _curves(grown: Grown) -> list[Curve]:
    pairs = zip(grown.offsets[:-1], grown.offsets[1:], grown.stops, strict=True)
    return [Curve(grown.points_mm[a:b].astype(float), grown.evidence[a:b].astype(float), tuple(map(int, s))) for a, b, s in pairs]


def _mark(curves: list[Curve], work: _Work) -> None:
    """Mark the observations that curves stand on as used, and no others."""
    work.index.strength[:] &= USED - 1
    for curve in curves:
        _claim(work.index, curve.points, work.box, True)


def _fit_all(curves: list[Curve], work: _Work) -> list[Curve]:
    def one(curve: Curve) -> Curve:
        if curve.fitted:
            return curve
        points = _fitted(work.index, np.ascontiguousarray(curve.points), work.slab, work.params)
        evidence = np.empty(len(points))
        _weigh(work.index, points, work.near, evidence)
        return Curve(points, evidence, curve.stops, fitted=True)

    return work.each(one, curves)


def _cut_all(curves: list[Curve], work: _Work) -> list[Curve]:
    """Cut off ends that have less evidence than their steps need."""
    out = []
    for curve in curves:
        surplus = np.concatenate([[0.0], np.cumsum(curve.evidence - work.box.min_evidence)])
        low = np.minimum.accumulate(surplus)
        last = int(np.argmax(surplus - low))
        first = int(np.argmin(surplus[: last + 1]))
        if last - first >= 4:
            out.append(_part(curve, first, last))
    return out


def _part(curve: Curve, a: int, b: int) -> Curve:
    if b - a == len(curve.points):
        return curve
    stops = (curve.stops[0] if a == 0 else Stop.UNOBSERVED.value, curve.stops[1] if b == len(curve.points) else Stop.UNOBSERVED.value)
    return Curve(curve.points[a:b], curve.evidence[a:b], stops)


def _tangents(points: np.ndarray) -> np.ndarray:
    way = np.gradient(points, axis=0)
    return way / np.linalg.norm(way, axis=1, keepdims=True)


def _once(curves: list[Curve], work: _Work) -> list[Curve]:
    """Leave out of each curve what runs along a curve with more evidence: its ends are cut, or it goes."""
    order = sorted(range(len(curves)), key=lambda i: -float(curves[i].evidence.sum()))
    rank = np.empty(len(curves), int)
    rank[order] = np.arange(len(curves))
    if not curves:
        return []
    points, ways = np.concatenate([c.points for c in curves]), np.concatenate([_tangents(c.points) for c in curves])
    owner = np.repeat(np.arange(len(curves)), [len(c.points) for c in curves])
    same = np.zeros(len(points), bool)
    reach = np.hypot(work.params.same_mm, 0.5 * work.box.step)
    for a, b in cKDTree(points).query_pairs(reach):
        if owner[a] != owner[b] and abs(ways[a] @ ways[b]) > 0.98:
            off = points[a] - points[b]
            if np.linalg.norm(off - ways[a] * (off @ ways[a])) < work.params.same_mm:
                same[a if rank[owner[a]] > rank[owner[b]] else b] = True
    out = []
    starts = np.r_[0, np.cumsum([len(c.points) for c in curves])]
    for i, curve in enumerate(curves):
        own = np.flatnonzero(~same[starts[i] : starts[i + 1]])
        if len(own) >= 4 and len(own) > 0.3 * len(curve.points):
            out.append(_part(curve, own[0], own[-1] + 1))
    return out


def _ends(curves: list[Curve]) -> tuple[np.ndarray, np.ndarray]:
    """Places and outward directions (2 M, 3) of the ends of M curves, first and last in turn."""
    place, way = np.empty((2 * len(curves), 3)), np.empty((2 * len(curves), 3))
    for i, curve in enumerate(curves):
        p = curve.points
        for e, q in enumerate((p[::-1], p)):
            back = q[-min(7, len(q)) :]
            t = np.arange(len(back)) - (len(back) - 1)
            slope = np.polyfit(t, back, 2)[1] if len(back) > 4 else back[-1] - back[0]
            place[2 * i + e], way[2 * i + e] = back[-1], slope / np.linalg.norm(slope)
    return place, way


def _join(curves: list[Curve], work: _Work) -> list[Curve]:
    """Join the ends that meet: best pairs first, each end once, over gaps in which each end carried on straight to the middle
    finds the other. (A bend that is even over the gap moves both alike.)"""
    if len(curves) < 2:
        return curves
    params = work.params
    place, way = _ends(curves)
    found = []
    for a, b in sorted(cKDTree(place).query_pairs(params.join_mm)):
        if a // 2 == b // 2:
            continue
        gap = place[b] - place[a]
        size = np.linalg.norm(gap)
        if size > 0.15 and (gap @ way[a] < 0.7 * size or -gap @ way[b] < 0.7 * size):
            continue
        miss = gap - 0.5 * size * (way[a] - way[b])
        mean = way[a] - way[b]
        mean /= np.linalg.norm(mean) + 1e-12
        miss = np.linalg.norm(miss - mean * (miss @ mean))
        turned = np.degrees(np.arccos(np.clip(-way[a] @ way[b], -1, 1)))
        cost = (miss / (params.join_place[0] + params.join_place[1] * size)) ** 2
        cost += (turned / (params.join_turn_deg[0] + params.join_turn_deg[1] * size)) ** 2
        if cost < params.join_cost + 4:
            found.append((cost + size, a, b, cost))
    best: dict[int, list[float]] = {}
    for _, a, b, cost in found:
        best.setdefault(a, []).append(cost)
        best.setdefault(b, []).append(cost)
    partner: dict[int, int] = {}
    for _, a, b, cost in sorted(found):
        alone = all(sum(c < cost + 3 for c in best[e]) < 2 for e in (a, b))  # nothing else fits nearly as well
        if cost < params.join_cost and alone and a not in partner and b not in partner:
            partner[a], partner[b] = b, a
    return _chains(curves, partner, work.box.step)


def _chains(curves: list[Curve], partner: dict[int, int], step: float) -> list[Curve]:
    """Curves put together at the ends (2 i the first, 2 i + 1 the last of curve i) that ``partner`` pairs."""
    done, out = set(), []
    heads = [e for e in range(2 * len(curves)) if e not in partner]
    for head in heads + sorted(partner):  # what is left after the open ends are closed rings
        if head // 2 in done:
            continue
        parts, end = [], head
        while end is not None and end // 2 not in done:
            done.add(end // 2)
            parts.append(curves[end // 2] if end % 2 == 0 else _reversed(curves[end // 2]))
            end = partner.get(end ^ 1)
        out.append(parts[0] if len(parts) == 1 else _bridged(parts, step))
    return out


def _reversed(curve: Curve) -> Curve:
    return Curve(np.ascontiguousarray(curve.points[::-1]), curve.evidence[::-1], curve.stops[::-1], curve.fitted)


def _bridged(parts: list[Curve], step: float) -> Curve:
    """One curve of many, with points a step apart over the gaps between them."""
    points, evidence = [parts[0].points], [parts[0].evidence]
    for curve in parts[1:]:
        a, b = points[-1], curve.points
        gap = np.linalg.norm(b[0] - a[-1])
        count = max(round(gap / step), 1)
        if gap < 0.5 * step:  # they touch
            b, curve = b[1:], Curve(curve.points[1:], curve.evidence[1:], curve.stops)
        elif count > 1:
            ways = [_tangents(a)[-1], _tangents(b)[0]]
            points.append(CubicHermiteSpline([0, gap], [a[-1], b[0]], ways)(gap * np.arange(1, count) / count))
            evidence.append(np.zeros(count - 1))
        points.append(b)
        evidence.append(curve.evidence)
    return Curve(np.concatenate(points), np.concatenate(evidence), (parts[0].stops[0], parts[-1].stops[1]))


def _extend(curves: list[Curve], work: _Work) -> list[Curve]:
    """Grow on from both ends, on what no curve stands on."""
    _mark(curves, work)
    room = int(10 * work.index.rows * work.index.pitch / work.box.step) + 30

    def one(curve: Curve) -> Curve:
        points, evidence, stops = curve.points, curve.evidence, list(curve.stops)
        for end in (1, 0):
            if stops[end] != Stop.LEFT_VOLUME and len(points) >= 8:
                state, more = np.empty((room, 9)), np.empty(room, np.float32)
                known, filled, stop = _grow_on(work.index, np.ascontiguousarray(points), work.box, state, more)
                points, evidence = np.concatenate([points, state[known:filled, :3]]), np.concatenate([evidence, more[known:filled]])
                stops[end] = int(stop)
            points, evidence = points[::-1], evidence[::-1]
        return Curve(points, evidence, tuple(stops)) if len(points) > len(curve.points) else curve

    return work.each(one, curves)


def _keep(curves: list[Curve], work: _Work) -> list[Curve]:
    """Without those that may be chance: a short curve needs more evidence than a long one."""
    least, extra = work.params.mean_evidence
    lengths = [(len(c.points) - 1) * work.box.step for c in curves]
    return [
        c
        for c, length in zip(curves, lengths, strict=True)
        if length >= work.params.min_length_mm and c.evidence.mean() >= least * (1 + extra / length)
    ]


_TIDY = (_fit_all, _cut_all, _once, _join, _fit_all)
STAGES = (*_TIDY, _extend, *_TIDY)  # of a round


def _flat(curves: list[Curve], tried: int) -> Grown:
    if not curves:
        return Grown(np.zeros((0, 3), np.float32), np.zeros(1, np.int64), np.zeros(0, np.float32), np.zeros((0, 2), np.uint8), tried)
    offsets = np.concatenate([[0], np.cumsum([len(c.points) for c in curves])]).astype(np.int64)
    return Grown(
        np.concatenate([c.points for c in curves]).astype(np.float32),
        offsets,
        np.concatenate([c.evidence for c in curves]).astype(np.float32),
        np.array([c.stops for c in curves], np.uint8),
        tried,
    )
