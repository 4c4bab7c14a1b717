"""Which captured curves are parts of one fiber whose middle no camera sees.

A hair is taken as a curve whose curvature wanders: it keeps its value over some length and has some spread, both measured
on the captured curves. From one open end on, place, direction and curvature are then known less and less, as in a Kalman
filter; two ends are linked where they meet more probably than any two ends would by chance.
"""

from dataclasses import dataclass
from math import lgamma
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from .stops import Stop


@dataclass(frozen=True)
class LinkParams:
    """Parameters of the links. Lengths in mm."""

    longest_mm: float = 10.0  # gap that is linked
    usual_mm: float = 3.0  # gap that is expected
    least_score: float = -6.0  # log of how much more probable a link is than chance
    error_factor: float = 1.8  # of what is told as the error of a point: what it is in truth, at places that few cameras see
    unsure_mm: float = 0.4  # of a curve before an open end, which may lean towards a neighbour: it does not tell where the hair goes
    end_error_mm: float = 0.03  # where that begins
    end_decay_mm: float = 0.5  # by which that falls along the curve
    least_error_mm: float = 0.004  # of a point


class Bends(NamedTuple):
    """How the curvature of a hair wanders: its spread in each direction across the hair, and how far it is kept."""

    spread: float  # 1/mm
    kept_mm: float


class Link(NamedTuple):
    """Two open ends of one fiber. End 2 c is the first point of curve c, 2 c + 1 its last."""

    ends: tuple[int, int]
    length_mm: float  # of the hair between them; below 0 where they run past each other
    score: float


FIT = 3  # points either side that curvature is fitted to
FIRST_MM, LAST_MM = 1.4, 10.0  # lags at which its autocovariance is read: nearer, the same points' errors tell twice
_KEPT_MM = (0.5, 20.0)
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)
_BACK = np.array([1.0, -1.0, 1.0])  # a state seen the other way: the direction turns round
_SLOPE = 0.2  # of hair that has nothing to do with an end, either way across it
_UNKNOWN_ERROR_MM = 0.02  # of a point whose error is not known: two thirds of a pixel
_USED = 25  # points of a curve that tell the state of its end
_LEANING_MM = 0.03  # added to the errors of points where only the way of an end is wanted
_TOLD_BY = 4  # points by which the way of a curve's end is told
_FREEDOM = 4.0  # degrees of, of how far ends miss each other
_CROWD_MM = 1.0  # about an end, in which ends are counted
_AHEAD = 0.3  # cosine: what an end may be linked with lies ahead of it


def bends(points_mm: np.ndarray, offsets: np.ndarray) -> Bends:
    """Measure how curvature wanders, on curves (N, 3) mm of evenly spaced points: by its autocovariance, from a lag on at which the errors
    of points no longer tell to where it has faded. Without curves long enough: slight bends."""
    points, offsets = np.ascontiguousarray(points_mm, np.float64), np.ascontiguousarray(offsets, np.int64)
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    inside = np.delete(steps, offsets[1:-1] - 1) if len(offsets) > 2 else steps
    step = float(np.median(inside)) if len(inside) else 0.0
    if step <= 0:
        return Bends(0.05, 2.0)
    first = max(round(FIRST_MM / step), 1)
    covariance = _autocovariance(points, offsets, step, max(round(LAST_MM / step), first + 1))[first:]
    if not covariance[0] > 0:
        return Bends(0.05, 2.0)
    faded = np.flatnonzero(covariance <= 0)
    until = faded[0] if len(faded) else len(covariance)
    kept = float(np.clip(covariance[:until].sum() * step / covariance[0], *_KEPT_MM))
    return Bends(float(np.sqrt(0.5 * covariance[0] * np.exp(first * step / kept))), kept)


@njit(cache=True, nogil=True)
def _autocovariance(points, offsets, step, lags):
    """Autocovariance (lags,) of the curvature vectors, 0 where no curve is as long."""
    sums, counts = np.zeros(lags), np.zeros(lags)
    reach = np.arange(-FIT, FIT + 1).astype(np.float64)
    weights = reach**2 - np.mean(reach**2)  # second derivative of the parabola of least squares
    weights /= 0.5 * np.sum(weights * reach**2) * step * step
    for c in range(len(offsets) - 1):
        size = offsets[c + 1] - offsets[c] - 2 * FIT
        if size < 1:
            continue
        curvature = np.zeros((size, 3))
        for n in range(size):
            for m in range(2 * FIT + 1):
                curvature[n] += weights[m] * points[offsets[c] + n + m]
        for lag in range(min(lags, size)):
            for n in range(size - lag):
                sums[lag] += np.sum(curvature[n] * curvature[n + lag])
            counts[lag] += size - lag
    return sums / np.maximum(counts, 1.0)


def find_links(
    points_mm: np.ndarray,
    offsets: np.ndarray,
    error_mm: np.ndarray,
    stops: np.ndarray,
    params: LinkParams | None = None,
    wander: Bends | None = None,
) -> tuple[list[Link], np.ndarray]:
    """The links between open ends, each end in one at most, the surest first; and the open ends that are left (k,).

    points_mm (N, 3), offsets (M + 1,): captured curves; error_mm (N,): what is expected of each point, NaN where it is not known;
    stops (M, 2): of ``Stop``; wander: of ``bends`` of the curves, if it is known. An end is open unless its curve left the volume there.
    """
    params = params or LinkParams()
    points, offsets = np.asarray(points_mm, np.float64), np.asarray(offsets, np.int64)
    wander = wander or bends(points, offsets)
    open_ends = np.flatnonzero(np.asarray(stops).ravel() != Stop.LEFT_VOLUME)
    if len(open_ends) < 2:
        return [], open_ends
    pieces = [_leading(points, error_mm, offsets, end) for end in open_ends]
    states = [_state(*_sure(*piece, params), wander, params) for piece in pieces]
    mean, spread = np.stack([s[0] for s in states]), np.stack([s[1] for s in states])
    one, other = _candidates(mean, open_ends, params)
    crowd = _crowd(mean[:, 0])
    both = [_scores(mean, spread, *way, wander, crowd, params) for way in ((one, other), (other, one))]
    score, length = (0.5 * (a + b) for a, b in zip(*both, strict=True))
    tips = np.stack([piece[-1] for piece, _ in pieces])
    length -= np.sum((tips[one] - mean[one, 0]) * mean[one, 1], axis=1) + np.sum((tips[other] - mean[other, 0]) * mean[other, 1], axis=1)
    links, used = [], np.zeros(len(open_ends), bool)
    for k in np.lexsort((other, one, -score)):
        if score[k] < params.least_score:
            break
        if not (used[one[k]] or used[other[k]]):
            used[[one[k], other[k]]] = True
            links.append(Link((int(open_ends[one[k]]), int(open_ends[other[k]])), float(length[k]), float(score[k])))
    return links, open_ends[~used]


def ways_on(
    points_mm: np.ndarray, offsets: np.ndarray, error_mm: np.ndarray, ends: np.ndarray, params: LinkParams | None = None, wander: Bends | None = None
) -> np.ndarray:
    """Unit directions (k, 3) in which hair goes on beyond open ends (k,), told by all of the curve that its bends let tell: the last
    points lean towards neighbours. wander: of ``bends`` of the curves, if it is known."""
    params = params or LinkParams()
    points, offsets = np.asarray(points_mm, np.float64), np.asarray(offsets, np.int64)
    wander = wander or bends(points, offsets)
    pieces = [_leading(points, error_mm, offsets, end) for end in ends]
    ways = np.array([_state(piece, error + _LEANING_MM, wander, params)[0][1] for piece, error in pieces]).reshape(-1, 3)
    return ways / np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-12)


def up_to(offsets: np.ndarray, end: int, most: int) -> np.ndarray:
    """The points (n,) of the curve of an end, from far away up to it, ``most`` of them at most."""
    first, last = offsets[end // 2], offsets[end // 2 + 1]
    return np.arange(max(first, last - most), last) if end % 2 else np.arange(first, min(first + most, last))[::-1]


def _leading(points, error_mm, offsets, end):
    """The points (n, 3) and errors (n,) of the curve of an end, from far away up to it, no more than tell its state."""
    which = up_to(offsets, end, _USED)
    return points[which], np.nan_to_num(np.asarray(error_mm, np.float64)[which], nan=_UNKNOWN_ERROR_MM)


def _sure(points, error, params):
    """Points (n, 3) and errors (n,) of a curve up to where it begins to be unsure of its end; of a short one, the first half."""
    left = np.r_[np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)[::-1])[::-1], 0.0]
    size = max(int(np.sum(left >= params.unsure_mm)), (len(points) + 1) // 2, min(3, len(points)))
    return points[:size], error[:size]


def _state(points, error, wander, params):
    """Place, direction and curvature (3, 3) at the last of points (n, 3), and how surely (3, 3), the same along x, y and z."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    left = np.r_[np.cumsum(steps[::-1])[::-1], 0.0]
    variance = np.maximum(params.error_factor * error, params.least_error_mm) ** 2 + (params.end_error_mm * np.exp(-left / params.end_decay_mm)) ** 2
    ahead = points[min(3, len(points) - 1)] - points[0]
    mean = np.stack([points[0], ahead / max(np.linalg.norm(ahead), 1e-12), np.zeros(3)])
    spread = np.diag([variance[0], 0.3**2, wander.spread**2])
    carry, noise = _carried(np.maximum(steps, 1e-6), wander)
    for n in range(1, len(points)):
        mean, spread = carry[n - 1] @ mean, carry[n - 1] @ spread @ carry[n - 1].T + noise[n - 1]
        gain = spread[:, 0] / (spread[0, 0] + variance[n])
        mean, spread = mean + gain[:, None] * (points[n] - mean[0]), spread - np.outer(gain, spread[0])
    return mean, spread


def _carried(length, wander):
    """What becomes of (place, direction, curvature) over lengths (n,) mm: matrices (n, 3, 3), and covariances (n, 3, 3) of what is added.

    Curvature is an Ornstein-Uhlenbeck process; direction and place are its first and second integral.
    """
    kept = wander.kept_mm

    def kernel(length):
        fade = np.exp(-length / kept)
        turned = kept * (1 - fade)
        return kept * (length - turned), turned, fade

    carry = np.zeros((*length.shape, 3, 3))
    carry[..., 0, 0] = carry[..., 1, 1] = 1.0
    carry[..., 0, 1] = length
    carry[..., 0, 2], carry[..., 1, 2], carry[..., 2, 2] = kernel(length)
    pulse = np.stack(kernel(0.5 * length[..., None] * (_NODES + 1)), axis=-2)  # (n, 3, nodes)
    weight = 0.5 * length[..., None] * _WEIGHTS * (2 * wander.spread**2 / kept)
    return carry, (pulse * weight[..., None, :]) @ np.swapaxes(pulse, -1, -2)


def _crowd(places):
    """How many open ends there are about each (n,), in 1/mm³."""
    around = cKDTree(places).query_ball_point(places, _CROWD_MM, return_length=True)
    return around / (4 / 3 * np.pi * _CROWD_MM**3)


def _candidates(mean, open_ends, params):
    """Pairs of ends (k,), (k,) of different curves that lie ahead of each other."""
    pairs = cKDTree(mean[:, 0]).query_pairs(params.longest_mm, output_type="ndarray").reshape(-1, 2)
    one, other = pairs.T
    gap = mean[other, 0] - mean[one, 0]
    length = np.linalg.norm(gap, axis=1)
    ahead, back = np.sum(mean[one, 1] * gap, axis=1), -np.sum(mean[other, 1] * gap, axis=1)
    good = (open_ends[one] // 2 != open_ends[other] // 2) & (ahead > _AHEAD * length) & (back > _AHEAD * length)
    return one[good], other[good]


def _scores(mean, spread, one, other, wander, per_mm3, params):
    """Log of how much more probable it is that pairs of ends (k,) are of one fiber than that they meet by chance, and the length between."""
    here, there = mean[one], mean[other] * _BACK[:, None]
    there_spread = spread[other] * np.outer(_BACK, _BACK)
    length = np.linalg.norm(there[:, 0] - here[:, 0], axis=1)
    for _ in range(4):  # until the end lies abreast of what was carried there
        carry, noise = _carried(np.maximum(length, 0.02), wander)
        come = carry @ here
        length = np.clip(length + np.sum((there[:, 0] - come[:, 0]) * come[:, 1], axis=1), 0.02, 2 * params.longest_mm)
    carry, noise = _carried(length, wander)
    come = carry @ here
    axes = _axes(there[:, 1])  # (k, 3, 2)
    miss = (come - there) @ axes  # (k, 3, 2)
    total = carry @ spread[one] @ np.swapaxes(carry, -1, -2) + noise + there_spread
    squares = np.sum(miss * np.linalg.solve(total, miss), axis=(1, 2))
    link = _student(squares) - np.linalg.slogdet(total)[1] - length / params.usual_mm - np.log(params.usual_mm)
    slope, bend = here[:, 1:2] @ axes, there[:, 2:3] @ axes
    chance = np.log(np.maximum(per_mm3[one], per_mm3[other])) - 0.5 * np.sum(slope**2, axis=(1, 2)) / _SLOPE**2 - np.log(2 * np.pi * _SLOPE**2)
    chance = chance - 0.5 * np.sum(bend**2, axis=(1, 2)) / wander.spread**2 - np.log(2 * np.pi * wander.spread**2)
    against = np.sum(come[:, 1] * there[:, 1], axis=1) < _AHEAD
    return np.where(against | (length > 1.5 * params.longest_mm), -np.inf, link - chance), length


def _student(squares):
    """Log density of Student's distribution in six dimensions, but for its scale: curves go astray at their ends more often than Gauss's says."""
    whole = 0.5 * (_FREEDOM + 6)
    return lgamma(whole) - lgamma(0.5 * _FREEDOM) - 3 * np.log(_FREEDOM * np.pi) - whole * np.log1p(squares / _FREEDOM)


def _axes(tangents):
    """Two unit vectors (k, 3, 2) at right angles to unit vectors (k, 3)."""
    helper = np.where(np.abs(tangents[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(tangents, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(tangents, first)], axis=-1)


def bridge(
    points_mm: np.ndarray,
    offsets: np.ndarray,
    error_mm: np.ndarray,
    link: Link,
    step_mm: float,
    params: LinkParams | None = None,
    wander: Bends | None = None,
) -> np.ndarray:
    """The points (n, 3) mm between the two ends of a link, about step_mm apart, without the ends themselves; n may be 0.

    A quintic that has place, direction and curvature of both ends. wander: of ``bends`` of the curves, if it is known.
    """
    params = params or LinkParams()
    points, offsets = np.asarray(points_mm, np.float64), np.asarray(offsets, np.int64)
    here, there = (_leading(points, error_mm, offsets, end)[0] for end in link.ends)
    gap = there[-1] - here[-1]
    ways = [piece[-1] - piece[max(len(piece) - 1 - _TOLD_BY, 0)] for piece in (here, there)]
    if link.length_mm <= step_mm or np.sum(gap * ways[0]) <= 0 or np.sum(gap * ways[1]) >= 0:
        return np.empty((0, 3))
    wander = wander or bends(points, offsets)
    states = [_state(piece, np.zeros(len(piece)), wander, params)[0] for piece in (here, there)]
    states[0][0], states[1][0] = here[-1], there[-1]
    length = max(float(np.linalg.norm(gap)), link.length_mm)
    count = max(round(length / step_mm) - 1, 0)
    t = (np.arange(count) + 1) / (count + 1)
    return _quintic(states[0], states[1] * _BACK[:, None], length, t)


def _quintic(here, there, length, t):
    """Points (n, 3) at parameters t (n,) of 0…1 between two states (3, 3) of place, direction and curvature."""
    scale = np.array([1.0, length, length**2])[:, None]
    a, b = here * scale, there * scale
    c = np.zeros((6, 3))
    c[0], c[1], c[2] = a[0], a[1], 0.5 * a[2]
    left = np.stack([b[0] - c[:3].sum(axis=0), b[1] - c[1] - 2 * c[2], b[2] - 2 * c[2]])
    c[3:] = np.linalg.solve(np.array([[1.0, 1.0, 1.0], [3.0, 4.0, 5.0], [6.0, 12.0, 20.0]]), left)
    return np.polynomial.polynomial.polyval(t, c).T
