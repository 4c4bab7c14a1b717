"""From grown pieces to fibers: each curve is fitted to all of its observations at once, loses the ends that nothing supports,
and is joined to the piece of the same fiber beyond a place where it could not be seen.

A curve is a smoothing spline (``spline.py``): a point every step, tied to the observations of every camera, as stiff as makes the
observations likeliest. What compares curves with each other is in ``joining.py``.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from .crew import Threads
from .features import Index
from .geometry import turn_back
from .grow import Grown, GrowParams, box_of, claim, claims_of, find_seeds, grow, grow_end
from .joining import Curve, Meeting, Passing, bridged, chains, end_of, leading_to, meetings, once, paired, part, passings, turned
from .journal import Unwritten
from .look import BOW, Box, chord, fit, gather, hair_frame, look, new_hits, new_view, shows
from .progress import Progress, silent
from .spline import BEND_MM, Stiffness, across, covariance, smoothed, steps_of, stiffness
from .stops import Stop

_turn_back = njit(turn_back)
JERKS_PER_MM2 = tuple(0.015 * 2.0**i for i in range(9))  # change of curvature a mm, at random each step, from straight hair to tight curls
SLAB_MM = 0.1
GROWING_SHARE = 0.6  # of the time of a round
BEND_PX = 3.6  # sigma along the hair of what places a ridge, hair's width and slab included: it sees a bend from inside
JOIN_PART_MM, JOIN_BESIDE_MM = 4.0, 0.2  # of either curve that a join looks at, and of the end itself
CHORD_MM, KNOWN_MM = 0.2, 2.0  # to either side: what gives a point its direction; and the end of a curve that tells where it goes on
STRAIGHT = 1e-3  # 1/mm: hair is taken for no straighter
UNCROSS_MM, UNCROSS_DEG = 0.2, 20.0  # how near an end must be to another curve to claim the rest of it, and how much turned
UNCROSS_INNER_MM = 1.2  # to either side of the nearest point, where one is the weakest of the other curve
UNCROSS_EDGE_MM = 0.2  # left out of either where they are put together
SHORT_MM = 0.8  # pieces shorter than this tell no direction
LEAST_DIP = 0.3  # evidence: less is not told apart
STIFF = 10.0  # cameras: what holds a point in its place along the hair


@dataclass(frozen=True)
class RefineParams:
    """How curves are grown in rounds, fitted, cut and joined."""

    rounds: int = 3  # of the fit: ties are found anew where the curve has moved
    slab_px: float = 0.2  # error of what one camera says of SLAB_MM of a curve, rows and frames that err alike included
    fit_sigma: tuple[float, float] = (0.4, 0.2)  # weight of an observation in a fit, by its way across the hair (px) and from focus (mm)
    near_mm: float = 0.6  # evidence of a point is that of this length around it
    step_evidence: tuple[float, float, float] = (1.5, 0.8, 0.3)  # evidence that a step needs in the rounds of ``trace``
    bent_evidence: tuple[float, float] = (7.0, 0.7)  # and at least in bent hair: by its curvature (1/mm), up to the second
    new_evidence: float = 0.2  # no new curve is begun in a round that asks for less
    join_mm: float = 2.5  # longest gap over which two pieces are joined
    join_misfit: float = 25.0  # of two ends, squared, in units of the next two: none above is looked at
    join_place: tuple[float, float] = (0.02, 0.02)  # mm, and mm a mm of gap: how well two ends must meet in the middle of it
    join_turn_deg: tuple[float, float] = (2.0, 4.0)  # and a mm of gap: how well their directions must agree
    join_odds: tuple[float, float, float, float] = (3.1, 1.1, 0.8, 1.0)  # that two ends are of one fiber, logarithm: without more; less for
    # each mm of gap, less for the root of the misfit, more for the mean evidence between them
    join_least: float = 1.0  # odds that a join needs
    join_margin: float = 1.0  # by which it must be likelier than any other of the same end
    uncross: float = 2.5  # times more evidence that a way needs to take the place of another
    carry_mm: float = 0.4  # curves are carried on beyond their ends by this, where their error is less than
    carry_error_mm: float = 0.015
    apart_mm: float = 0.06  # and other curves are not nearer than this: hairs are 0.06 mm thick or more
    same_mm: float = 0.04  # closer than this to a better curve, along it, a curve is the same hair
    min_length_mm: float = 0.8  # shorter curves are taken for chance
    mean_evidence: tuple[float, float] = (0.8, 1.5)  # and those that have less evidence than the first, and less than this many mm of it


# ---- the fit ---------------------------------------------------------------------------------------------------------


class Seen(NamedTuple):
    """What S cameras see of a curve of n points: observations within half a step along the hair of each."""

    across: np.ndarray  # (h,) float32 mm, of each observation
    weight: np.ndarray  # (h,) float32
    ends: np.ndarray  # (n S + 1,) int64: where those of each point and camera begin
    ribbon: np.ndarray  # (n, S, 3) t, across the ribbon of the camera
    thin: np.ndarray  # (n, S) square of how long a mm of hair is in the image


@njit(cache=True, nogil=True)
def _seen(index, points, box):
    """What the cameras see (Seen) of a curve of points (n, 3). A move of less than what the weights reach needs no new look."""
    n, cameras = len(points), len(index.cos)
    hits, count = new_hits(1), 0
    across, weight = np.empty(128 * n, np.float32), np.empty(128 * n, np.float32)
    ends, ribbon, thin = np.zeros(n * cameras + 1, np.int64), np.zeros((n, cameras, 3)), np.ones((n, cameras))
    for j in range(n):
        g = chord(points, j)
        for k in range(cameras):
            frame, found = hair_frame(index, k, points[j], g), 0
            if shows(index, k, frame):
                found = gather(index, k, frame, 0.0, 0.0, box, hits, 0)
                ribbon[j, k] = _turn_back(frame.t[0], frame.t[1], frame.t[2], index.cos[k], index.sin[k])
                thin[j, k] = frame.size * frame.size
            if count + found > len(across):
                more = np.empty((2, 2 * (count + found)), np.float32)
                more[0, :count], more[1, :count] = across[:count], weight[:count]
                across, weight = more[0], more[1]
            across[count : count + found], weight[count : count + found] = hits.across[:found], hits.weight[:found]
            count += found
            ends[j * cameras + k + 1] = count
    return Seen(across[:count].copy(), weight[:count].copy(), ends, ribbon, thin)


@njit(cache=True, nogil=True)
def _tie(seen, points, move, box, normal, right):
    """What the cameras say of each point (n, 3), moved by ``move`` (n, 3) since they were asked: the sums normal (n, 3, 3) and
    right (n, 3) of its least squares, in cameras that see it fully. The place of an observation is that of the hair's image
    averaged along it, which lies by half the curvature times BEND_PX squared inside a bend."""
    n, cameras, f32 = len(points), seen.ribbon.shape[1], np.float32
    reach = min(steps_of(BEND_MM, box.step), (n - 1) // 2)
    inside = 0.5 * (BEND_PX * box.pixel) ** 2
    over, bow, one, none = f32(1 / box.sigma), f32(BOW), f32(1), f32(0)
    for j in range(n):
        g = chord(points, j)
        bend = np.zeros(3)
        if reach > 0:
            m = min(max(j, reach), n - 1 - reach)
            bend = (points[m + reach] + points[m - reach] - 2 * points[m]) / (reach * box.step) ** 2
        for c in range(3):  # a point is not to slide along its hair
            right[j, c] = 0.0
            for d in range(3):
                normal[j, c, d] = STIFF * g[c] * g[d]
        for k in range(cameras):
            first, last = seen.ends[j * cameras + k], seen.ends[j * cameras + k + 1]
            if first == last:
                continue
            t = seen.ribbon[j, k]
            moved = f32(t[0] * move[j, 0] + t[1] * move[j, 1] + t[2] * move[j, 2])
            offs, weights, s, r = seen.across[first:last], seen.weight[first:last], none, none
            for i in range(len(offs)):
                off = offs[i] - moved
                x = off * over
                x = max(one - bow * x * x, none)
                w = weights[i] * x * x
                s += w
                r += w * off
            if s < 1e-6:
                continue
            share = min(np.float64(s) / box.full_support, 1.0)
            place = np.float64(r) / np.float64(s) - inside * (t[0] * bend[0] + t[1] * bend[1] + t[2] * bend[2]) / seen.thin[j, k]
            for c in range(3):
                right[j, c] += share * place * t[c]
                for d in range(3):
                    normal[j, c, d] += share * t[c] * t[d]


class Ties(NamedTuple):
    """What holds a curve of n points in its place, in units of the errors of what the cameras say."""

    normal: np.ndarray  # (n, 3, 3)
    right: np.ndarray  # (n, 3)
    stiff: Stiffness  # the likeliest


def _tied(seen: Seen, points: np.ndarray, move: np.ndarray, box: Box, params: RefineParams, stiffs: Sequence[Stiffness], start: int):
    """The Ties of points (n, 3), the points that fit them best, and which of ``stiffs`` is the likeliest, found upwards or
    downwards from number ``start``."""
    normal, right = np.empty((len(points), 3, 3)), np.empty((len(points), 3))
    _tie(seen, points, move, box, normal, right)
    error = params.slab_px * box.pixel * np.sqrt(SLAB_MM / box.step)
    normal, right = normal / error**2, right / error**2
    fits = {start: smoothed(points, normal, right, stiffs[start])}
    best = start
    for way in (1, -1):
        while 0 <= best + way < len(stiffs):
            if best + way not in fits:
                fits[best + way] = smoothed(points, normal, right, stiffs[best + way])
            if fits[best + way][1] <= fits[best][1]:
                break
            best += way
    return Ties(normal, right, stiffs[best]), fits[best][0], best


def _fit(index: Index, points: np.ndarray, box: Box, params: RefineParams, bend: float) -> tuple[np.ndarray, Ties]:
    """Points (n, 3) of a curve fitted to its observations, as stiff as these make likely (empirical Bayes), and the Ties of the last
    round; ``bend`` is the curvature (1/mm) of the hair at large."""
    stiffs = [stiffness(box.step, jerk, bend) for jerk in JERKS_PER_MM2]
    begun, best = np.ascontiguousarray(points), len(stiffs) // 2
    seen = _seen(index, begun, box)
    points = begun
    for _ in range(params.rounds):
        held, points, best = _tied(seen, points, points - begun, box, params, stiffs, best)
    return np.ascontiguousarray(points), held


def ties(index: Index, points: np.ndarray, box: Box, params: RefineParams, bend: float) -> Ties:
    """What holds the points (n, 3) of a curve in their place, where they are."""
    return _fit(index, points, box, replace(params, rounds=1), bend)[1]


def _fitted(index: Index, points: np.ndarray, box: Box, params: RefineParams, bend: float) -> np.ndarray:
    """The points of ``_fit``."""
    return _fit(index, points, box, params, bend)[0]


def _bends(points: np.ndarray, step_mm: float) -> np.ndarray:
    """Squares (m,) of the curvature (1/mm) of a curve of points (n, 3) in one direction across it, over BEND_MM to either side, at
    all points that have as much."""
    half = steps_of(BEND_MM, step_mm)
    if len(points) <= 2 * half:
        return np.zeros(0)
    bends = points[2 * half :] + points[: -2 * half] - 2 * points[half:-half]
    return 0.5 * np.sum(bends**2, axis=1) / (half * step_mm) ** 4


def bend_at_large(curves: Iterable[tuple[np.ndarray, np.ndarray]], step_mm: float) -> float:
    """Curvature (1/mm) of the hair in one direction across it, root mean square, where it is seen well; of curves as points (n, 3) and
    evidence (n,)."""
    half, bends, seen = steps_of(BEND_MM, step_mm), [np.zeros(0)], [np.zeros(0)]
    for points, evidence in curves:
        bends.append(_bends(points, step_mm))
        seen.append(evidence[half : half + len(bends[-1])])
    bends, seen = np.concatenate(bends), np.concatenate(seen)
    return max(float(np.sqrt(bends[seen >= np.median(seen)].mean())), STRAIGHT) if len(bends) else np.inf


@njit(cache=True, nogil=True)
def _weigh(index, points, box, evidence):
    """Evidence (n,) of each point (n, 3) of a curve that is already where it should be."""
    n = len(points)
    view, free, reach = new_view(len(index.cos)), (1e9, 1e9, 1e9), steps_of(CHORD_MM, box.step)
    for j in range(n):
        if j % 2 == 1 and j < n - 1:  # the boxes of neighbours share two thirds
            continue
        a, b = max(j - reach, 0), min(j + reach, n - 1)
        m = (a + b) // 2
        g = chord(points, j)
        half = 0.5 * (b - a) * box.step
        bend = (points[a] + points[b] - 2 * points[m]) / (half * half) if b - a == 2 * reach else np.zeros(3)
        bend -= g * (g[0] * bend[0] + g[1] * bend[1] + g[2] * bend[2])
        look(index, points[j], g, bend, box, view)
        _, evidence[j], _, _, _ = fit(view, index.around, g, box, 1.0, free)
    for j in range(1, n - 1, 2):
        evidence[j] = 0.5 * (evidence[j - 1] + evidence[j + 1])


# ---- growing on ------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _grow_on(index, points, box, state, evidence):
    """Grow on from the last of points (n, 3); fills state (m, 9) and evidence (m,), which begin with the points' own last
    ones. Returns (rows of the points', rows there are, Stop)."""
    n = len(points)
    known, reach = min(steps_of(KNOWN_MM, box.step), n), steps_of(CHORD_MM, box.step)
    for i in range(known):
        j = n - known + i
        a, b = max(j - reach, 0), min(j + reach, n - 1)
        m = (a + b) // 2
        g = points[b] - points[a]
        size = np.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
        one, two = points[b] - points[m], points[m] - points[a]
        l1, l2 = np.sqrt(np.sum(one**2)), np.sqrt(np.sum(two**2))
        state[i, :3], state[i, 3:6] = points[j], g / size
        state[i, 6:] = (one / l1 - two / l2) / (0.5 * (l1 + l2)) if b - a == 2 * reach else np.zeros(3)
        if b - a < 2 * reach and i > 1 and j > 1:  # at the end itself the middle of a chord says nothing of the direction
            bend = state[i - 1, 6:].copy()
            state[i, 6:] = bend
            way = state[i - 1, 3:6] + box.step * bend
            state[i, 3:6] = way / np.sqrt(np.sum(way**2))
        evidence[i] = 4.0
    filled, stop = grow_end(index, box, new_view(len(index.cos)), state, evidence, known, 1.0)
    return known, filled, stop


# ---- the whole -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Work:
    """What all the steps below need."""

    index: Index
    params: RefineParams
    box: Box  # as for growing
    slab: Box  # half a step to either side
    near: Box  # the length over which evidence is weighed
    claims: Box  # what a step uses up
    crew: Threads  # who looks at many curves
    memo: dict = field(default_factory=dict)  # what was told of curves that have not changed since: {(*key, *ids): (curves, told)}


def _remembered(work: _Work, keys: Sequence[tuple], of: Sequence[tuple[Curve, ...]], function: Callable, items: Sequence, *arguments) -> list:
    """function(index, item, *arguments) of every item, or what it was for these very curves and key before. How the hair bends at
    large may have changed a little since then."""
    keys = [(*key, *map(id, curves)) for key, curves in zip(keys, of, strict=True)]
    new = [i for i, key in enumerate(keys) if key not in work.memo]
    for i, told in zip(new, work.crew.each(function, [items[i] for i in new], *arguments), strict=True):
        work.memo[keys[i]] = of[i], told  # the curves, so that no other gets their id
    return [work.memo[key][1] for key in keys]


def trace(
    index: Index,
    grow_params: GrowParams,
    params: RefineParams,
    workers: int = 1,
    progress: Progress = silent,
    crew: Threads | None = None,
    journal: Unwritten | None = None,
) -> Grown:
    """The fibers that the observations support, in rounds: the clearest hair first, so that what it stands on is out of the way
    of the rest. Each round grows curves on what is left, then refines all of them and grows them on.

    The same for any number of ``workers`` or whatever ``crew`` there is in their place: each curve is fitted alone, and what compares
    curves runs in a fixed order. It goes on behind what the ``journal`` of an earlier run holds.
    """
    curves: list[Curve] = []
    memo: dict = {}
    seeds = find_seeds(index, grow_params)
    pages = _Pages(journal or Unwritten(), memo)
    for number, evidence in enumerate(params.step_evidence):
        told = _part_of(progress, number, len(params.step_evidence))
        if curves:  # what bends is foretold less well, and meets more by chance
            bent = bend_at_large(((c.points, c.evidence) for c in curves), grow_params.step_mm)
            evidence = max(evidence, min(params.bent_evidence[0] * bent, params.bent_evidence[1]))
        growing = replace(grow_params, min_evidence=evidence)
        with Threads(index, workers) if crew is None else nullcontext(crew) as hands:
            work = _work(index, params, growing, hands, memo)
            if evidence >= params.new_evidence:
                if not pages.ahead:  # else an earlier run has seen all that is grown here
                    _mark(curves, work)
                curves = curves + _curves(grow(index, growing, workers, told, seeds, hands, pages.journal))
            for i, stage in enumerate(STAGES):
                told("growing", 1 + i / len(STAGES) * (1 / GROWING_SHARE - 1), 1)
                curves = pages.stage(stage, curves, work)
            curves = _keep(curves, work)
            alive = set(map(id, curves))
            for key in [key for key, (told_of, _) in memo.items() if not alive.issuperset(map(id, told_of))]:
                del memo[key]
            if number == len(params.step_evidence) - 1:
                curves = pages.stage(_carry_on, curves, work)
    progress("growing", 1, 1)
    return _flat(curves, sum(len(cells) for cells, _ in seeds.tried))


def _part_of(progress: Progress, number: int, rounds: int) -> Progress:
    """Progress of the growing of one round as part of all."""
    return lambda stage, done, total: progress(stage, number + GROWING_SHARE * done / max(total, 1), rounds)


def _work(index: Index, params: RefineParams, grow_params: GrowParams, crew: Threads | None = None, memo: dict | None = None) -> _Work:
    box, fit = box_of(grow_params, index), box_of(replace(grow_params, sigma_px=params.fit_sigma[0], sigma_focus_mm=params.fit_sigma[1]), index)
    wide = 1.5 * index.pitch
    slab, near = (mm / (2 * box.half[0]) for mm in (box.step, params.near_mm))  # of the length of the box
    return _Work(
        index=index,
        params=params,
        box=box,
        slab=fit._replace(half=(0.5 * box.step, box.half[1], wide), deep=box.half[1], full_support=slab * fit.full_support),
        near=box._replace(half=(0.5 * params.near_mm, box.half[1], wide), full_support=near * box.full_support),
        claims=claims_of(grow_params, box),
        crew=crew or Threads(index),
        memo={} if memo is None else memo,
    )


def _curves(grown: Grown) -> list[Curve]:
    pairs = zip(grown.offsets[:-1], grown.offsets[1:], grown.stops, strict=True)
    return [Curve(grown.points_mm[a:b].astype(float), grown.evidence[a:b].astype(float), tuple(map(int, s))) for a, b, s in pairs]


def _mark(curves: list[Curve], work: _Work) -> None:
    """Mark the observations that curves stand on as used, and no others."""
    work.crew.free()
    of = [(curve,) for curve in curves]
    for numbers in _remembered(work, [("claimed",)] * len(of), of, claim, [curve.points for curve in curves], work.claims):
        work.crew.use(numbers)


def _at_large(curves: list[Curve], work: _Work) -> float:
    return bend_at_large(((c.points, c.evidence) for c in curves), work.box.step)


def _fit_all(curves: list[Curve], work: _Work) -> list[Curve]:
    changed = [i for i, curve in enumerate(curves) if not curve.fitted]
    fits = work.crew.each(_fit_one, [curves[i] for i in changed], work.slab, work.near, work.params, _at_large(curves, work))
    out = list(curves)
    for i, curve in zip(changed, fits, strict=True):
        out[i] = curve
    return out


def _fit_one(index: Index, curve: Curve, slab: Box, near: Box, params: RefineParams, bend: float) -> Curve:
    points = _fitted(index, np.ascontiguousarray(curve.points), slab, params, bend)
    evidence = np.empty(len(points))
    _weigh(index, points, near, evidence)
    return Curve(points, evidence, curve.stops, fitted=True)


def _cut_all(curves: list[Curve], work: _Work) -> list[Curve]:
    """Cut off ends that have less evidence than their steps need."""
    out, least = [], steps_of(BEND_MM, work.box.step)
    for curve in curves:
        surplus = np.concatenate([[0.0], np.cumsum(curve.evidence - work.box.min_evidence)])
        low = np.minimum.accumulate(surplus)
        last = int(np.argmax(surplus - low))
        first = int(np.argmin(surplus[: last + 1]))
        if last - first >= least:
            out.append(part(curve, first, last))
    return out


def _once(curves: list[Curve], work: _Work) -> list[Curve]:
    return once(curves, work.params.same_mm, work.box.step)


def _join(curves: list[Curve], work: _Work) -> list[Curve]:
    """Join the ends that are of one fiber: the likeliest pairs first, each end once."""
    params, bend = work.params, _at_large(curves, work)
    found = meetings(curves, params.join_mm, params.join_place, params.join_turn_deg, params.join_misfit)

    of = [tuple(curves[end // 2] for end in meeting.ends) for meeting in found]
    keys = [("between", meeting.ends[0] % 2, meeting.ends[1] % 2, 0) for meeting in found]
    both = [_both(curves, meeting, steps_of(JOIN_PART_MM, work.box.step)) for meeting in found]
    told = _remembered(work, keys, of, _between, both, work.slab, work.near, params, bend)
    worth = [_join_worth(meeting, evidence, params) for meeting, evidence in zip(found, told, strict=True)]
    return chains(curves, paired(found, worth, params.join_least, params.join_margin), work.box.step)


def _join_worth(meeting: Meeting, evidence: float, params: RefineParams) -> float:
    """How likely two ends are of one fiber, as the logarithm of the odds."""
    even, gap, ill, seen = params.join_odds
    return even - gap * meeting.gap_mm - ill * np.sqrt(meeting.misfit) + seen * min(evidence, 2.0)


def _both(curves: list[Curve], meeting: Meeting, most: int) -> tuple[Curve, Curve]:
    """The two curves of a meeting, the second turned, and ``most`` points of each on the side where they meet."""
    one, other = leading_to(curves, meeting.ends[0]), turned(leading_to(curves, meeting.ends[1]))
    return part(one, max(len(one.points) - most, 0), len(one.points)), part(other, 0, min(most, len(other.points)))


def _between(index: Index, parts: tuple[Curve, Curve], slab: Box, near: Box, params: RefineParams, bend: float) -> float:
    """Mean evidence over the gap between two curves, and JOIN_BESIDE_MM to either side, of the one curve that fits both."""
    beside = steps_of(JOIN_BESIDE_MM, near.step)
    points = _fitted(index, np.ascontiguousarray(bridged(parts, near.step).points), slab, params, bend)
    first, last = len(parts[0].points) - beside, len(points) - len(parts[1].points) + beside
    evidence = np.empty(len(points))
    _weigh(index, points, near, evidence)
    return float(evidence[max(first, 0) : last].mean())


def _uncross(curves: list[Curve], work: _Work) -> list[Curve]:
    """Where a curve left its fiber for one beside it, and a piece of that one ends there: give the piece what is its own. The weakest
    point of the way that this makes must have more evidence than that of the way there is, by a factor of ``uncross``."""
    bend = _at_large(curves, work)
    found = passings(curves, UNCROSS_MM, UNCROSS_DEG, steps_of(UNCROSS_INNER_MM, work.box.step))

    of = [(curves[passing.end // 2], curves[passing.other]) for passing in found]
    keys = [("exchanged", passing.end % 2, passing.at, int(passing.onward)) for passing in found]
    items = [_beside(curves, passing) for passing in found]
    tried = _remembered(work, keys, of, _exchanged, items, work.slab, work.near, work.params, bend)
    taken: set[int] = set()
    out = list(curves)
    for number in sorted(range(len(found)), key=lambda i: (-tried[i][0], i)):
        pair = {found[number].end // 2, found[number].other}
        if tried[number][0] > work.params.uncross and not pair & taken:
            taken |= pair
            out[found[number].end // 2], out[found[number].other] = tried[number][1:]
    return out


def _beside(curves: list[Curve], passing: Passing) -> tuple[Curve, Curve, int]:
    """The curve that ends, the other one turned the same way, and its point beside the end."""
    own, other = leading_to(curves, passing.end), curves[passing.other]
    return (own, other, passing.at) if passing.onward else (own, turned(other), len(other.points) - 1 - passing.at)


def _exchanged(index: Index, item: tuple[Curve, Curve, int], slab: Box, near: Box, params: RefineParams, bend: float):
    """(how many times more evidence the weakest point has, the piece with what lies beyond on the other curve, what is left of
    that one), if the other curve is cut where it has least evidence near the end of the piece; 0 where that cannot be. No curves
    unless it is worth it."""
    own, other, at = item
    inner, most, edge = (steps_of(mm, near.step) for mm in (UNCROSS_INNER_MM, JOIN_PART_MM, UNCROSS_EDGE_MM))
    around = slice(at - inner + edge, at + inner - edge + 1)
    dip = around.start + int(np.argmin(other.evidence[around]))
    own, before, beyond = part(own, 0, len(own.points) - edge), part(other, 0, dip), part(other, dip + edge + 1, len(other.points))
    if min(map(len, (own.points, before.points, beyond.points))) < steps_of(SHORT_MM, near.step):
        return 0.0, None, None
    forward = beyond.points[0] - own.points[-1]
    if forward @ end_of(own.points)[1] < 0.5 * np.linalg.norm(forward):
        return 0.0, None, None
    both = bridged([own, beyond], near.step)
    before_it, after_it = (min(len(c.points), most) for c in (own, beyond))
    middle = both.points[len(own.points) - before_it : len(both.points) - len(beyond.points) + after_it]
    points, evidence = _fitted(index, np.ascontiguousarray(middle), slab, params, bend), np.empty(len(middle))
    _weigh(index, points, near, evidence)
    weakest = evidence[max(before_it - 2 * edge, 0) : len(points) - after_it + 2 * edge].min()
    times = float(weakest / max(other.evidence[dip], LEAST_DIP))
    return (times, both, before) if times > params.uncross else (times, None, None)


def _carry_on(curves: list[Curve], work: _Work) -> list[Curve]:
    """Carry curves on a little beyond their ends, where nothing supports them, as far as it is known where they go: a hair does not
    end where it is not seen any more. What is carried on has no evidence, and keeps away from other hairs, which are as thick."""
    params, bend = work.params, _at_large(curves, work)
    count, short = round(params.carry_mm / work.box.step), steps_of(SHORT_MM, work.box.step)
    known = 2 * steps_of(0.5, work.box.step) + 1
    if not curves:
        return curves
    tree, owner = cKDTree(np.concatenate([c.points for c in curves])), np.repeat(np.arange(len(curves)), [len(c.points) for c in curves])

    def one(number: int) -> Curve:
        curve = curves[number]
        points, evidence = np.ascontiguousarray(curve.points), curve.evidence
        ends = [0 if stop == Stop.LEFT_VOLUME or len(points) < 1.5 * short else count for stop in curve.stops]
        if any(ends):
            normal, right, stiff = ties(work.index, points, work.slab, params, bend)
            inner = slice(ends[0], ends[0] + len(points))
            points = np.concatenate([_onward(points[::-1][-known:], ends[0])[::-1], points, _onward(points[-known:], ends[1])])
            normal, right = np.pad(normal, (ends, (0, 0), (0, 0))), np.pad(right, (ends, (0, 0)))
            points = smoothed(points, normal, right, stiff)[0]
            error = across(covariance(normal, stiff), points)
            error[1:-1] = np.where(np.arange(1, len(points) - 1) < inner.start, 0.5 * (error[1:-1] + error[2:]), 0.5 * (error[1:-1] + error[:-2]))
            good = error < params.carry_error_mm
            good &= np.array([all(owner[near] == number) for near in tree.query_ball_point(points, params.apart_mm)])
            first = inner.start - int(np.cumprod(good[: inner.start][::-1]).sum())
            last = inner.stop + int(np.cumprod(good[inner.stop :]).sum())
            points, evidence = np.ascontiguousarray(points[first:last]), np.pad(evidence, ends)[first:last]
        if len(points) == len(curve.points) and curve.fitted:
            return curve
        return Curve(_fitted(work.index, points, work.slab, params, bend), evidence, curve.stops, fitted=True)

    return work.crew.here(one, range(len(curves)))


def _onward(points: np.ndarray, count: int) -> np.ndarray:
    """``count`` points that carry a curve on with the curvature of its end; a start for the fit."""
    step = np.arange(1, count + 1)[:, None]
    half = (len(points) - 1) // 2
    bend = (points[-1] + points[-1 - 2 * half] - 2 * points[-1 - half]) / half**2
    way = (points[-1] - points[-1 - half]) / half + 0.5 * half * bend
    return points[-1] + step * way + 0.5 * step**2 * bend


def _extend(curves: list[Curve], work: _Work) -> list[Curve]:
    """Grow on from both ends, on what no curve stands on."""
    _mark(curves, work)
    longer = work.crew.each(_extended, curves, work.box)
    return [more or curve for more, curve in zip(longer, curves, strict=True)]


def _extended(index: Index, curve: Curve, box: Box) -> Curve | None:
    """A curve grown on, if it grows."""
    short, room = steps_of(SHORT_MM, box.step), int(10 * index.rows * index.pitch / box.step) + 30
    points, evidence, stops = curve.points, curve.evidence, list(curve.stops)
    for end in (1, 0):
        if stops[end] != Stop.LEFT_VOLUME and len(points) >= short:
            state, more = np.empty((room, 9)), np.empty(room, np.float32)
            known, filled, stop = _grow_on(index, np.ascontiguousarray(points), box, state, more)
            points, evidence = np.concatenate([points, state[known:filled, :3]]), np.concatenate([evidence, more[known:filled]])
            stops[end] = int(stop)
        points, evidence = points[::-1], evidence[::-1]
    return Curve(points, evidence, tuple(stops)) if len(points) > len(curve.points) else None


def _keep(curves: list[Curve], work: _Work) -> list[Curve]:
    """Without those that may be chance: a short curve needs more evidence than a long one."""
    least, extra = work.params.mean_evidence
    lengths = [(len(c.points) - 1) * work.box.step for c in curves]
    return [
        c
        for c, length in zip(curves, lengths, strict=True)
        if length >= work.params.min_length_mm and c.evidence.mean() >= least * (1 + extra / length)
    ]


_TIDY = (_fit_all, _cut_all, _once, _uncross, _join, _fit_all)
STAGES = (*_TIDY, _extend, *_TIDY)  # of a round


class _Pages:
    """The curves after each stage, in a journal. A record holds the curves that the one before it has not, and what is remembered."""

    def __init__(self, journal: Unwritten, memo: dict):
        self.journal, self.memo = journal, memo
        self.table: list[Curve] = []  # curves of the last record

    @property
    def ahead(self) -> bool:
        """Whether an earlier run came to another stage."""
        return self.journal.ahead("curves")

    def stage(self, stage: Callable, curves: list[Curve], work: _Work) -> list[Curve]:
        """The curves after a stage, with no observation used up before it; or what they were."""
        told = self.journal.next("curves")
        if told is not None:
            return self._read(told)
        work.crew.free()
        curves = [_settled(curve) for curve in stage(curves, work)]
        if self.journal.kept:
            self._write(curves)
        return curves

    def _write(self, curves: list[Curve]) -> None:
        alive = set(map(id, curves))
        kept = [(key, of, told) for key, (of, told) in self.memo.items() if key[0] in _TOLD and alive.issuperset(map(id, of))]
        exchanged = [curve for _, _, told in kept if isinstance(told, tuple) for curve in told[1:] if curve is not None]
        before, table = {id(curve): i for i, curve in enumerate(self.table)}, list({id(curve): curve for curve in (*curves, *exchanged)}.values())
        number = {id(curve): i for i, curve in enumerate(table)}
        new = [curve for curve in table if id(curve) not in before]
        rows = []
        for key, of, told in kept:
            made = [-1 if curve is None else number[id(curve)] for curve in (told[1:] if isinstance(told, tuple) else (None, None))]
            rows.append([_TOLD.index(key[0]), *key[1:4], *(number[id(curve)] for curve in of), *made])
        self.journal.write(
            "curves",
            count=np.array(len(curves)),
            known=np.array([before.get(id(curve), -1) for curve in table], np.int64),
            sizes=np.array([len(curve.points) for curve in new], np.int64),
            points=np.concatenate([np.zeros((0, 3)), *(curve.points for curve in new)]),
            evidence=np.concatenate([np.zeros(0), *(curve.evidence for curve in new)]),
            ends=np.array([(*curve.stops, curve.fitted) for curve in new], np.uint8).reshape(-1, 3),
            remembered=np.array(rows, np.int64).reshape(-1, 8),
            told=np.array([told[0] if isinstance(told, tuple) else told for _, _, told in kept], np.float64),
        )
        self.table = table

    def _read(self, told: Mapping) -> list[Curve]:
        offsets = np.concatenate([[0], np.cumsum(told["sizes"])])
        new = (
            Curve(told["points"][a:b], told["evidence"][a:b], (int(first), int(last)), bool(fitted))
            for (a, b), (first, last, fitted) in zip(pairwise(offsets), told["ends"], strict=True)
        )
        self.table = [next(new) if i < 0 else self.table[i] for i in told["known"]]
        self.memo.clear()
        for (name, *key, one, two, own, other), value in zip(told["remembered"].tolist(), told["told"].tolist(), strict=True):
            made = [None if i < 0 else self.table[i] for i in (own, other)]
            of = self.table[one], self.table[two]
            self.memo[(_TOLD[name], *key, *map(id, of))] = of, value if _TOLD[name] == "between" else (value, *made)
        return self.table[: int(told["count"])]


_TOLD = ("between", "exchanged")  # what is remembered that depends on more than the curves


def _settled(curve: Curve) -> Curve:
    """The curve with arrays that lie in memory as they do when they are read from a file: sums depend on it."""
    if curve.points.flags.c_contiguous and curve.evidence.flags.c_contiguous:
        return curve
    return replace(curve, points=np.ascontiguousarray(curve.points), evidence=np.ascontiguousarray(curve.evidence))


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
