"""Pieces of curves: which are doubles, which belong to one fiber, and how they are put together.

Nothing here looks at observations; ``refine.py`` does, and asks.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial import cKDTree

from .stops import Stop

AHEAD, TOUCHING_MM = 0.7, 0.15  # cosine within which two ends look at each other, unless they are so near
PAIRS = 200_000  # that are compared together
END_MM = 0.6  # of a curve that tells the direction of its end


@dataclass(frozen=True)
class Curve:
    """One curve while it is being refined."""

    points: np.ndarray  # (n, 3) mm, a step apart
    evidence: np.ndarray  # (n,)
    stops: tuple[int, int]  # why either end stopped
    fitted: bool = False  # nothing has changed since the last fit


@dataclass(frozen=True)
class Meeting:
    """Two ends that may be of one fiber. End 2 i is the first point of curve i, 2 i + 1 its last."""

    ends: tuple[int, int]
    gap_mm: float
    misfit: float  # squared: how far each end, carried on straight to the middle, misses the other in place and direction


def part(curve: Curve, a: int, b: int) -> Curve:
    """Points a … b - 1 of a curve."""
    if b - a == len(curve.points):
        return curve
    stops = (curve.stops[0] if a == 0 else Stop.UNOBSERVED.value, curve.stops[1] if b == len(curve.points) else Stop.UNOBSERVED.value)
    return Curve(np.ascontiguousarray(curve.points[a:b]), curve.evidence[a:b], stops)


def turned(curve: Curve) -> Curve:
    """The curve the other way round."""
    return Curve(np.ascontiguousarray(curve.points[::-1]), curve.evidence[::-1], curve.stops[::-1], curve.fitted)


def leading_to(curves: Sequence[Curve], end: int) -> Curve:
    """The curve of an end, turned so that this end is its last point."""
    return curves[end // 2] if end % 2 else turned(curves[end // 2])


def tangents(points: np.ndarray) -> np.ndarray:
    """Unit directions (n, 3) of a curve of points (n, 3)."""
    way = np.gradient(points, axis=0)
    return way / np.linalg.norm(way, axis=1, keepdims=True)


def once(curves: Sequence[Curve], same_mm: float, step_mm: float) -> list[Curve]:
    """Leave out of each curve what runs along a curve with more evidence, nearer than same_mm: its ends are cut, or it goes."""
    if not curves:
        return []
    order = sorted(range(len(curves)), key=lambda i: -float(curves[i].evidence.sum()))
    rank = np.empty(len(curves), int)
    rank[order] = np.arange(len(curves))
    points, ways = np.concatenate([c.points for c in curves]), np.concatenate([tangents(c.points) for c in curves])
    owner = np.repeat(np.arange(len(curves)), [len(c.points) for c in curves])
    same = np.zeros(len(points), bool)
    pairs = cKDTree(points).query_pairs(np.hypot(same_mm, 0.5 * step_mm), output_type="ndarray")
    one, other = pairs.T
    apart = (owner[one] != owner[other]) & (np.abs((ways[one] * ways[other]).sum(axis=1)) > 0.98)
    off = points[one] - points[other]
    off -= ways[one] * (off * ways[one]).sum(axis=1, keepdims=True)
    near = apart & (np.linalg.norm(off, axis=1) < same_mm)
    less = rank[owner[one]] > rank[owner[other]]
    same[np.where(less, one, other)[near]] = True
    out = []
    starts = np.r_[0, np.cumsum([len(c.points) for c in curves])]
    for i, curve in enumerate(curves):
        own = np.flatnonzero(~same[starts[i] : starts[i + 1]])
        if len(own) >= 4 and len(own) > 0.3 * len(curve.points):
            out.append(part(curve, own[0], own[-1] + 1))
    return out


def end_of(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Place and outward unit direction of the last of points (n, 3)."""
    count = max(round(END_MM / np.linalg.norm(points[-1] - points[-2])), 2) + 1
    back = points[-min(count, len(points)) :]
    slope = _parabola_slope(len(back)) @ back if len(back) > 3 else back[-1] - back[0]
    return back[-1], slope / np.linalg.norm(slope)


@lru_cache
def _parabola_slope(count: int) -> np.ndarray:
    """Weights (count,) that give the slope at the last of so many places of the parabola that fits them best."""
    return np.linalg.pinv(np.vander(np.arange(1 - count, 1), 3))[1]


def misfit(place_a, way_a, place_b, way_b, place_mm: tuple[float, float], turn_deg: tuple[float, float]) -> np.ndarray:
    """How ill two ends, with outward directions, go together, squared: (...) of vectors (..., 3). Each is carried on straight to the
    middle of the gap, since a bend that is even over the gap moves both alike; place_mm and turn_deg are what is expected, and
    as much more a mm of gap."""
    gap, mean = place_b - place_a, way_a - way_b
    size = np.linalg.norm(gap, axis=-1)
    miss = gap - 0.5 * size[..., None] * mean
    mean = mean / (np.linalg.norm(mean, axis=-1) + 1e-12)[..., None]
    miss = np.linalg.norm(miss - mean * np.sum(miss * mean, axis=-1)[..., None], axis=-1)
    bent = np.degrees(np.arccos(np.clip(-np.sum(way_a * way_b, axis=-1), -1, 1)))
    return (miss / (place_mm[0] + place_mm[1] * size)) ** 2 + (bent / (turn_deg[0] + turn_deg[1] * size)) ** 2


def meetings(curves: Sequence[Curve], within_mm: float, place_mm, turn_deg, most: float) -> list[Meeting]:
    """The pairs of ends of different curves that look at each other over a gap, with a misfit up to ``most``; in a fixed order."""
    if len(curves) < 2:
        return []
    places, ways = (np.array(a) for a in zip(*(end_of(leading_to(curves, e).points) for e in range(2 * len(curves))), strict=True))
    pairs = cKDTree(places).query_pairs(within_mm, output_type="ndarray")
    pairs = pairs[np.lexsort(pairs.T[::-1])]
    pairs = pairs[pairs[:, 0] // 2 != pairs[:, 1] // 2]
    found = []
    for some in np.array_split(pairs, len(pairs) // PAIRS + 1):
        a, b = some.T
        gap = places[b] - places[a]
        size = np.linalg.norm(gap, axis=1)
        ahead = np.minimum(np.sum(gap * ways[a], axis=1), -np.sum(gap * ways[b], axis=1)) >= AHEAD * size
        ill = misfit(places[a], ways[a], places[b], ways[b], place_mm, turn_deg)
        good = (ahead | (size <= TOUCHING_MM)) & (ill <= most)
        found += [Meeting((int(i), int(j)), float(s), float(m)) for i, j, s, m in zip(a[good], b[good], size[good], ill[good], strict=True)]
    return found


def paired(meetings: Sequence[Meeting], worth: Sequence[float], least: float, margin: float) -> dict[int, int]:
    """Which ends to join: those worth most first, each end once, down to ``least``; none that has a rival worth nearly as much."""
    rivals: dict[int, list[float]] = {}
    for meeting, w in zip(meetings, worth, strict=True):
        for end in meeting.ends:
            rivals.setdefault(end, []).append(w)
    partner: dict[int, int] = {}
    for w, (a, b) in sorted(((w, m.ends) for m, w in zip(meetings, worth, strict=True)), key=lambda pair: (-pair[0], pair[1])):
        alone = all(sum(r > w - margin for r in rivals[end]) < 2 for end in (a, b))
        if w > least and alone and a not in partner and b not in partner:
            partner[a], partner[b] = b, a
    return partner


def chains(curves: Sequence[Curve], partner: dict[int, int], step_mm: float) -> list[Curve]:
    """Curves put together at the ends that ``partner`` pairs."""
    done, out = set(), []
    heads = [e for e in range(2 * len(curves)) if e not in partner]
    for head in heads + sorted(partner):  # what is left after the open ends are closed rings
        if head // 2 in done:
            continue
        parts, end = [], head
        while end is not None and end // 2 not in done:
            done.add(end // 2)
            parts.append(leading_to(curves, end ^ 1))
            end = partner.get(end ^ 1)
        out.append(parts[0] if len(parts) == 1 else bridged(parts, step_mm))
    return out


def bridged(parts: Sequence[Curve], step_mm: float) -> Curve:
    """One curve of many, with points a step apart over the gaps between them."""
    points, evidence = [parts[0].points], [parts[0].evidence]
    for curve in parts[1:]:
        a, b = points[-1], curve.points
        gap = np.linalg.norm(b[0] - a[-1])
        count = max(round(gap / step_mm), 1)
        if gap < 0.5 * step_mm:  # they touch
            b, curve = b[1:], Curve(curve.points[1:], curve.evidence[1:], curve.stops)
        elif count > 1:
            ways = [tangents(a)[-1], tangents(b)[0]]
            points.append(CubicHermiteSpline([0, gap], [a[-1], b[0]], ways)(gap * np.arange(1, count) / count))
            evidence.append(np.zeros(count - 1))
        points.append(b)
        evidence.append(curve.evidence)
    return Curve(np.concatenate(points), np.concatenate(evidence), (parts[0].stops[0], parts[-1].stops[1]))


@dataclass(frozen=True)
class Passing:
    """An end of a curve beside another curve that runs the same way: perhaps what lies beyond on that one is of the same fiber."""

    end: int  # 2 i is the first point of curve i, 2 i + 1 its last
    other: int  # number of the other curve
    at: int  # its point beside the end
    onward: bool  # the end points at the later points of the other curve


def passings(curves: Sequence[Curve], within_mm: float, turn_deg: float, inner: int) -> list[Passing]:
    """Where an end lies within_mm from a point of another curve, ``inner`` points or more from that one's ends, and turned by no
    more than turn_deg; in a fixed order."""
    if len(curves) < 2:
        return []
    places, ways = (np.array(a) for a in zip(*(end_of(leading_to(curves, e).points) for e in range(2 * len(curves))), strict=True))
    points, lengths = np.concatenate([c.points for c in curves]), np.array([len(c.points) for c in curves])
    owner, starts = np.repeat(np.arange(len(curves)), lengths), np.r_[0, np.cumsum(lengths)]
    balls = cKDTree(points).query_ball_point(places, within_mm)
    end, near = np.repeat(np.arange(len(places)), [len(ball) for ball in balls]), np.concatenate([*balls, []]).astype(np.int64)
    order = np.lexsort((near, np.linalg.norm(points[near] - places[end], axis=1), owner[near], end))
    end, near, other = end[order], near[order], owner[near[order]]
    nearest = np.r_[True, (np.diff(end) != 0) | (np.diff(other) != 0)][: len(end)]  # of each other curve
    at = near - starts[other]
    good = nearest & (other != end // 2) & (at >= max(inner, 2)) & (at < lengths[other] - max(inner, 2))
    end, near, other, at = end[good], near[good], other[good], at[good]
    along = points[near + 2] - points[near - 2]
    turn = np.sum(along * ways[end], axis=1) / np.linalg.norm(along, axis=1)
    held = np.abs(turn) >= np.cos(np.radians(turn_deg))
    return [Passing(int(e), int(o), int(p), bool(t > 0)) for e, o, p, t in zip(end[held], other[held], at[held], turn[held], strict=True)]
