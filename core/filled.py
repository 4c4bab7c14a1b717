"""How good an infill is, against hair that is known: how much of it there is, where, which way it runs, whether it can be told from hair."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from .compare import SAMPLE_MM, TRUTH_MM, Truth, _lines, _nearest
from .errors import StrandscopeError
from .strands import CAPTURED, INFILL, Strands, clip, concatenate, fibers

FOUND_MM = 0.1  # a true fiber this near a captured curve is found there
HULL_MM = 0.5  # the true hull: what is this near a true fiber
PLANES = 41  # horizontal planes on which fibers are counted
DENSITY_MM = 1.0  # cells of the comparison of density
LEAST_MM = 1.0  # hidden pieces shorter than this are not judged
CURVATURE_MM = 0.5  # either side of a point, over which its curvature is told
OVERLAP = 0.9  # of the sum of radii: nearer centrelines run through each other
NEIGHBOURS_MM = 2.0  # a nearest neighbour is looked for that far


def fill_score(strands: Strands, truth: Truth, seed: int = 0) -> dict:
    """Compare captured curves and infill with the truth, in the cylinder that the truth's samples tell.

    crossings: fibers that cross horizontal planes, found / true, over all planes and at the worst; density_correlation: of length in
    cubes of DENSITY_MM that hold hair; infill_direction_deg: mean and median angle to the nearest true fiber; infill_inside: share of its
    length within HULL_MM of a true fiber, infill_inside_wide: within 2 HULL_MM; overlapping: shares of the infill's and of all length
    where another strand's centreline is nearer than OVERLAP of the sum of radii; told_apart: share that a classifier gets right, told to
    part the infill's pieces from hidden true pieces by the distances to their nearest neighbours, curvature and parallelism (None
    without scikit-learn); pieces and hidden_pieces: how many there were of each.
    Raises StrandscopeError without infill.
    """
    added = strands.select(strands.kind == INFILL)
    if not len(added):
        raise StrandscopeError("the strands have no infill to judge; expected some of kind 1")
    samples = np.asarray(truth.sample_points_mm, float)
    reach, height = float(np.hypot(samples[:, 0], samples[:, 2]).max()), float(np.abs(samples[:, 1]).max())

    def inside(points):
        return (np.hypot(points[:, 0], points[:, 2]) <= reach) & (np.abs(points[:, 1]) <= height)

    centres = _lines(truth.points_mm, truth.offsets, TRUTH_MM)
    lines = _lines(strands.points_mm, strands.offsets, SAMPLE_MM)
    kind = strands.kind[lines.curve]
    within = inside(lines.points)
    fill = within & (kind == INFILL)
    distance, tangent, _ = _nearest(centres, lines.points[fill])
    angle = np.degrees(np.arccos(np.clip(np.abs(np.sum(lines.tangents[fill] * tangent, axis=1)), 0, 1)))
    true = _lines(truth.points_mm, truth.offsets, SAMPLE_MM)
    report = {
        "infill_mm": float(np.sum(fill) * SAMPLE_MM),
        "captured_mm": float(np.sum(within & (kind == CAPTURED)) * SAMPLE_MM),
        "true_mm": float(np.sum(inside(true.points)) * SAMPLE_MM),
        "crossings": _crossings(lines, true, inside, height),
        "density_correlation": _density_correlation(lines.points[within], true.points[inside(true.points)], reach, height),
        "infill_direction_deg": {"mean": float(angle.mean()), "median": float(np.median(angle))} if len(angle) else {},
        "infill_inside": float(np.mean(distance <= HULL_MM)) if len(angle) else 1.0,
        "infill_inside_wide": float(np.mean(distance <= 2 * HULL_MM)) if len(angle) else 1.0,
    }
    report |= _overlapping(strands, lines, fill, within)
    return report | _told_apart(strands, lines, true, inside, seed)


def fill_summary(report: dict) -> list[tuple[str, str]]:
    """The figures of a ``fill_score`` as rows (name, value with its meaning) for people."""
    crossing, angle = report["crossings"], report["infill_direction_deg"]
    told = report["told_apart"]
    apart = "not known: pip install scikit-learn, and ten pieces of each" if told is None else f"{told:.3f} right (0.5 is by chance)"
    return [
        ("infill", f"{report['infill_mm']:.0f} mm beside {report['captured_mm']:.0f} mm captured; {report['true_mm']:.0f} mm are there"),
        (
            "crossing a plane",
            f"{crossing['ratio']:.3f} of the {crossing['true']:.0f} there are (least {crossing['least']:.2f}, most {crossing['most']:.2f})",
        ),
        ("density", f"{report['density_correlation']:.3f} correlation with what is there, in cubes of {DENSITY_MM:g} mm"),
        ("infill's direction", f"{angle['mean']:.1f}° off the nearest hair (median {angle['median']:.1f})" if angle else "-"),
        (
            "infill inside",
            f"{report['infill_inside']:.4f} within {HULL_MM:g} mm of a hair, {report['infill_inside_wide']:.4f} within {2 * HULL_MM:g}",
        ),
        ("infill in other hair", f"{report['overlapping_infill']:.4f} of its length; of all length {report['overlapping_all']:.4f}"),
        ("infill told from hair", f"{apart}, {report['pieces']} pieces and {report['hidden_pieces']} hidden ones"),
    ]


def parted(hair: Strands, captured: Strands) -> Strands:
    """True hair in two kinds: CAPTURED, the pieces within FOUND_MM of a captured curve, and INFILL, those that are hidden."""
    fine = _lines(captured.points_mm, captured.offsets, TRUTH_MM)
    beyond = _nearest(fine, hair.points_mm)[0] - FOUND_MM
    found, hidden = clip(hair, -beyond)[0], clip(hair, beyond)[0]
    return concatenate([replace(found, kind=np.zeros_like(found.kind)), replace(hidden, kind=np.full_like(hidden.kind, INFILL))], hair.provenance)


def _crossings(lines, true, inside, height):
    planes = np.linspace(-0.95 * height, 0.95 * height, PLANES)
    counts = []
    for some in (lines, true):
        a, b = some.points[:-1], some.points[1:]
        same = (some.curve[:-1] == some.curve[1:]) & inside(a) & inside(b)
        low, high = np.minimum(a[same, 1], b[same, 1]), np.maximum(a[same, 1], b[same, 1])
        counts.append([int(np.sum((low < y) & (y <= high))) for y in planes])
    found, known = np.array(counts, float)
    ratio = found / np.maximum(known, 1)
    return {"ratio": float(found.sum() / max(known.sum(), 1)), "least": float(ratio.min()), "most": float(ratio.max()), "true": float(known.mean())}


def _density_correlation(found, known, reach, height):
    edges = [np.arange(-r, r + DENSITY_MM, DENSITY_MM) for r in (reach, height, reach)]
    counts = [np.histogramdd(points, edges)[0].ravel() for points in (found, known)]
    some = (counts[0] > 0) | (counts[1] > 0)
    return float(np.corrcoef(counts[0][some], counts[1][some])[0, 1])


def _overlapping(strands, lines, fill, within):
    radius = np.add.reduceat(strands.radius_mm.astype(float), strands.offsets[:-1]) / np.diff(strands.offsets)
    distance, _, other = _neighbours(lines.points, lines.tangents, lines.curve, lines, lines.curve, NEIGHBOURS_MM / 4)
    close = (other >= 0) & (distance < OVERLAP * (radius[lines.curve] + radius[np.maximum(other, 0)]))
    return {"overlapping_infill": float(close[fill].mean()) if fill.any() else 0.0, "overlapping_all": float(close[within].mean())}


def _neighbours(points, tangents, group, lines, groups, reach_mm):
    """Distance (inf: none within reach), angle in degrees, and curve (-1: none) of the nearest point of ``lines`` that is of another group."""
    tree = cKDTree(lines.points)
    distance, angle, curve = np.full(len(points), np.inf), np.full(len(points), np.nan), np.full(len(points), -1)
    left, k = np.arange(len(points)), 16
    while len(left):
        k = min(k, len(lines.points))
        d, i = tree.query(points[left], k=k, distance_upper_bound=reach_mm, workers=-1)
        other = np.isfinite(d) & (groups[np.minimum(i, len(lines.points) - 1)] != group[left, None])
        first = other.argmax(axis=1)
        rows = np.arange(len(left))
        got = other[rows, first]
        to = i[rows, first][got]
        here = left[got]
        gap = points[here] - lines.points[to]
        along = np.clip(np.sum(gap * lines.tangents[to], axis=1, keepdims=True), -SAMPLE_MM / 2, SAMPLE_MM / 2)  # on the segments beside it
        gap -= along * lines.tangents[to]
        distance[here], curve[here] = np.linalg.norm(gap, axis=1), lines.curve[to]
        angle[here] = np.degrees(np.arccos(np.clip(np.abs(np.sum(tangents[here] * lines.tangents[to], axis=1)), 0, 1)))
        full = ~got & np.isfinite(d[:, -1])
        left = left[full] if k < len(lines.points) else left[:0]
        k *= 4
    return distance, angle, curve


# ---- told apart ------------------------------------------------------------------------------------------------------


def _told_apart(strands, lines, true, inside, seed):
    captured = strands.captured
    fine = _lines(captured.points_mm, captured.offsets, TRUTH_MM)
    hidden = (_nearest(fine, true.points)[0] > FOUND_MM) & inside(true.points)
    fill = inside(lines.points) & (strands.kind[lines.curve] == INFILL)
    of_truth = _pieces(true, hidden, np.arange(len(true.offsets) - 1), true)
    of_fill = _pieces(lines, fill, fibers(strands), lines)
    report = {"pieces": len(of_fill), "hidden_pieces": len(of_truth)}
    return report | {"told_apart": _classified(of_fill, of_truth, seed)}


def _pieces(lines, chosen, numbers, among):
    """Features (n, 8) of the runs of chosen points of at least LEAST_MM: nearest neighbours' distances, parallelism, curvature."""
    edges = np.flatnonzero(np.diff(np.r_[0, chosen.astype(np.int8), 0]))
    runs = [
        (a, b) for start, end in zip(edges[::2], edges[1::2], strict=True) for a, b in pairwise([start, *_breaks(lines.offsets, start, end), end])
    ]
    runs = [(a, b) for a, b in runs if (b - a) * SAMPLE_MM >= LEAST_MM]
    if not runs:
        return np.empty((0, 8))
    which = np.concatenate([np.arange(a, b) for a, b in runs])
    group = numbers[lines.curve]
    distance, angle, _ = _neighbours(lines.points[which], lines.tangents[which], group[which], among, group, NEIGHBOURS_MM)
    bend = _curvature(lines)[which]
    rows, at = [], 0
    for a, b in runs:
        part = slice(at, at + b - a)
        at += b - a
        d, angles, bends = np.minimum(distance[part], NEIGHBOURS_MM), angle[part][np.isfinite(angle[part])], bend[part][np.isfinite(bend[part])]
        angles, bends = (values if len(values) else np.zeros(1) for values in (angles, bends))
        rows.append([d.mean(), d.min(), d.std(), angles.mean(), angles.std(), bends.mean(), bends.std(), np.median(d)])
    return np.array(rows)


def _breaks(offsets, start, end):
    return offsets[np.searchsorted(offsets, start, side="right") : np.searchsorted(offsets, end)]


def _curvature(lines):
    """Curvature (N,) 1/mm by points CURVATURE_MM either side; NaN near the ends."""
    step = round(CURVATURE_MM / SAMPLE_MM)
    out = np.full(len(lines.points), np.nan)
    i = np.arange(step, len(lines.points) - step)
    i = i[(lines.curve[i - step] == lines.curve[i]) & (lines.curve[i + step] == lines.curve[i])]
    a, b = lines.points[i] - lines.points[i - step], lines.points[i + step] - lines.points[i]
    area = np.linalg.norm(np.cross(a, b), axis=1)
    out[i] = 2 * area / np.maximum(np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1) * np.linalg.norm(a + b, axis=1), 1e-12)
    return out


def _classified(some, others, seed):
    """Share right of a random forest in five-fold cross-validation, both kinds counted alike; None where it cannot be told."""
    try:
        from sklearn.ensemble import RandomForestClassifier
        from sklearn.model_selection import StratifiedKFold, cross_val_predict
    except ImportError:
        return None
    if min(len(some), len(others)) < 10:
        return None
    x, y = np.concatenate([some, others]), np.r_[np.ones(len(some)), np.zeros(len(others))]
    forest = RandomForestClassifier(300, min_samples_leaf=3, class_weight="balanced", random_state=seed, n_jobs=2)
    told = cross_val_predict(forest, x, y, cv=StratifiedKFold(5, shuffle=True, random_state=seed))
    return float(np.mean([np.mean(told[y == k] == k) for k in (0, 1)]))
