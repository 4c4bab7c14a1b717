"""How good a result is: its curves against known hair, and drawn back onto the photographs they came from (Figure 14)."""

import colorsys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from .capture import Capture
from .errors import StrandscopeError, StrandsError
from .files import atomic
from .geometry import Optics, camera_points, pixels
from .ridges import RidgeParams, estimate, response
from .strands import INFILL, Strands, load_arrays, offsets_of

SAMPLE_MM = 0.1  # spacing at which reconstructed length is judged
TRUTH_MM = 0.02  # spacing at which true centrelines are searched
SEEN = 0.5  # share of the aperture's rays from which on a point counts as visible from an angle
SEEN_ANGLES = 4  # angles from which on a point counts as visible
ANGLE_BINS = (0, 1, 4, 8, 12, 16)
SIGMA_MM, SWITCH_COST = 0.04, 12.0  # of the assignment of a curve to fibers: spread of distances, price of a change
REACH = 1.25  # fibers farther than this times the tolerance are not considered
ERROR_EDGES_UM = tuple(round(10 ** (k / 2), 1) for k in range(5))  # bins of expected error: half decades
ON_FIBER_MM, FOLLOWED_MM = 0.3, 0.5  # shortest run that counts as being on a fiber, and as following it

SHARP_MM = 0.1  # blur, a hair's width, up to which a point counts as in focus
FRONT_MM, CELL_MM = 0.3, 0.15  # a curve this far behind another in a square of this size is taken as hidden
PANEL_PX = 840  # a photograph is enlarged by a whole factor until it is at least as wide or tall as this
SMOOTH = 3  # samples a pixel and axis when lines are drawn
CAPTION_PX = 26
INFILL_COLOR = (150, 150, 150)


@dataclass(frozen=True)
class Truth:
    """Hair that is known, and which of it the sweeps can see."""

    points_mm: np.ndarray  # (N, 3), object frame
    offsets: np.ndarray  # (M + 1,)
    sample_points_mm: np.ndarray  # (K, 3), each 0.1 mm inside the captured volume
    visibility: np.ndarray  # (K, sweeps), share of the aperture's rays that reach the point


@dataclass(frozen=True)
class _Lines:
    """Curves at an even spacing, with unit tangents."""

    points: np.ndarray  # (N, 3)
    tangents: np.ndarray  # (N, 3)
    offsets: np.ndarray  # (M + 1,)

    @property
    def curve(self) -> np.ndarray:
        """Number (N,) of the curve of each point."""
        return np.repeat(np.arange(len(self.offsets) - 1), np.diff(self.offsets))


def load_truth(path: Path) -> Truth:
    """Read a truth file. Raises StrandsError, naming the array, for a damaged one."""
    arrays = load_arrays(path, ("points", "offsets", "sample_points", "visibility"))
    truth = Truth(*(np.asarray(arrays[name]) for name in ("points", "offsets", "sample_points", "visibility")))
    offsets, samples = truth.offsets, len(truth.sample_points_mm) if truth.sample_points_mm.ndim else 0
    for name, good, expected in (
        ("points", truth.points_mm.ndim == 2 and truth.points_mm.shape[1] == 3 and np.isfinite(truth.points_mm).all(), "finite numbers (N, 3)"),
        ("offsets", offsets.ndim == 1 and len(offsets) and np.issubdtype(offsets.dtype, np.integer), "integers (M + 1,)"),
        ("offsets", offsets.ndim == 1 and len(offsets) and offsets[0] == 0 and offsets[-1] == len(truth.points_mm), "0 … the number of points"),
        ("offsets", bool(np.all(np.diff(offsets) >= 0)), "numbers in order"),
        ("sample_points", truth.sample_points_mm.shape == (samples, 3) and np.isfinite(truth.sample_points_mm).all(), "finite numbers (K, 3)"),
        ("visibility", truth.visibility.ndim == 2 and len(truth.visibility) == samples, f"one row a sample ({samples}, sweeps)"),
    ):
        if not good:
            raise StrandsError(f"{path}: {name} does not fit; expected {expected}")
    return truth


def score(strands: Strands, truth: Truth, tolerance_mm: float = 0.1) -> dict:
    """How much of the true hair the captured curves found, and how well they lie. The infill is left out.

    recall: share of true samples visible from 4 or more angles that lie within tolerance_mm of a curve; recall_all: of
    all samples; recall_by_visible_angles: binned, as (share, number of samples). precision: share of reconstructed
    length within tolerance_mm of a true centreline; precision_in_volume: of the length inside the captured cylinder.
    pos_err_um, dir_err_deg: distance and angle to the nearest true centreline where within tolerance_mm (mean, median,
    p95). fragments_per_matched_hair: curves that follow a true fiber for 0.5 mm or more, mean over the matched_hairs.
    identity_switch_fraction: share of the curves_following a fiber that lie on two or more of them for 0.3 mm each, by
    the most probable assignment along the curve; identity_switch_raw: by the nearest fiber at each sample;
    switches_per_100mm: changes of fiber by the assignment, per 100 mm of curve. calibration, where the strands have expected
    errors: for bins of it, the number of points and the medians of expected error and distance to a true centreline (µm).
    """
    captured = strands.captured
    fine = _lines(captured.points_mm, captured.offsets, TRUTH_MM)
    found = _lines(captured.points_mm, captured.offsets, SAMPLE_MM)
    fibers = _lines(truth.points_mm, truth.offsets, TRUTH_MM)
    report = {"n_curves": len(captured), "n_gt_strands": len(truth.offsets) - 1, "gt_samples": len(truth.sample_points_mm)}
    report |= _recall(fine, truth, tolerance_mm)
    report["length_mm"] = float((len(found.points) - np.count_nonzero(np.diff(found.offsets))) * SAMPLE_MM)
    if len(found.points) == 0 or len(fibers.points) == 0:
        return report | {"precision": 0.0, "f1": 0.0}
    distance, tangent, fiber = _nearest(fibers, found.points)
    near = distance <= tolerance_mm
    report |= _precision(found, truth, near)
    both = report["precision"] + report["recall"]
    report["f1"] = 2 * report["precision"] * report["recall"] / both if both > 0 else 0.0
    if near.any():
        report["pos_err_um"] = _spread(1000 * distance[near])
        report["dir_err_deg"] = _spread(np.degrees(np.arccos(np.clip(np.abs((found.tangents[near] * tangent[near]).sum(1)), 0, 1))))
    if captured.error_mm is not None:
        report["calibration"] = _calibration(captured.error_mm, _nearest(fibers, captured.points_mm.astype(float))[0])
    raw = np.where(near, fiber, -1)
    return report | _identity(found, _assign(found, fibers, tolerance_mm), raw, report["length_mm"])


def summary(report: dict) -> list[tuple[str, str]]:
    """The figures of a score as rows (name, value with its meaning) for people."""

    def figure(value, form, meaning):
        return f"{value:{form}} {meaning}" if value is not None else "-"

    rows = [
        (
            "recall",
            figure(report["recall"], ".3f", f"of {report['gt_samples_visible']} points on hair that is visible from {SEEN_ANGLES} or more angles"),
        ),
        ("recall, all", figure(report["recall_all"], ".3f", f"of all {report['gt_samples']} points")),
        ("precision", figure(report["precision"], ".3f", f"of {report['length_mm']:.0f} mm of curve")),
        ("F1", figure(report["f1"], ".3f", "")),
    ]
    if "pos_err_um" in report:
        position, direction = report["pos_err_um"], report["dir_err_deg"]
        rows.append(("position error", f"{position['mean']:.1f} µm (median {position['median']:.1f}, 95 % below {position['p95']:.1f})"))
        rows.append(("direction error", f"{direction['mean']:.2f}° (median {direction['median']:.2f}, 95 % below {direction['p95']:.2f})"))
    if "matched_hairs" in report:
        rows.append(("hairs found", f"{report['matched_hairs']} of {report['n_gt_strands']}, by {report['n_curves']} curves"))
        rows.append(("pieces a hair", figure(report["fragments_per_matched_hair"], ".2f", "")))
        rows.append(("switches", figure(report["identity_switch_fraction"], ".3f", "of the curves jump from one hair to another")))
    for told in report.get("calibration", []):
        measured = f"measured {told['measured_um']:.2g} (medians of {told['points']} points)"
        span = f"{told['from_um']:g} µm or more" if told["to_um"] is None else f"{told['from_um']:g} to {told['to_um']:g} µm"
        rows.append((f"error {span}", f"expected {told['expected_um']:.2g} µm, {measured}"))
    bins = report["recall_by_visible_angles"].items()
    rows += [(f"recall, {name} angles", figure(share, ".3f", f"of {count} points")) for name, (share, count) in bins if count]
    return [(name, value.rstrip()) for name, value in rows]


def _recall(fine: _Lines, truth: Truth, tolerance_mm: float) -> dict:
    angles = (truth.visibility.astype(float) >= SEEN).sum(axis=1)
    hit = _nearest(fine, truth.sample_points_mm.astype(float))[0] <= tolerance_mm
    visible = angles >= SEEN_ANGLES
    ends = (*ANGLE_BINS, truth.visibility.shape[1] + 1)
    bins = {f"{a}-{b - 1}": hit[(angles >= a) & (angles < b)] for a, b in pairwise(ends)}
    return {
        "gt_samples_visible": int(visible.sum()),
        "recall": float(hit[visible].mean()) if visible.any() else 0.0,
        "recall_all": float(hit.mean()) if len(hit) else 0.0,
        "recall_by_visible_angles": {name: [float(hits.mean()) if len(hits) else None, len(hits)] for name, hits in bins.items()},
    }


def _precision(found: _Lines, truth: Truth, near: np.ndarray) -> dict:
    def reach(points):  # of the cylinder about y, as tall as wide, that holds the points
        return np.maximum(np.abs(points[:, 1]), np.hypot(points[:, 0], points[:, 2]))

    inside = reach(found.points) <= reach(truth.sample_points_mm.astype(float)).max(initial=0.0) + 0.05
    return {"precision": float(near.mean()), "precision_in_volume": float(near[inside].mean()) if inside.any() else 0.0}


def _calibration(error_mm: np.ndarray, distance_mm: np.ndarray) -> list[dict]:
    """How expected errors (N,) and distances (N,) agree, a record for each bin that has points; those without error are left out."""
    error, distance = 1000 * error_mm[np.isfinite(error_mm)].astype(float), 1000 * distance_mm[np.isfinite(error_mm)]
    place, table = np.digitize(error, ERROR_EDGES_UM), []
    for k, (low, high) in enumerate(pairwise((0.0, *ERROR_EDGES_UM, None))):
        if (here := place == k).any():
            medians = {"expected_um": float(np.median(error[here])), "measured_um": float(np.median(distance[here]))}
            table.append({"from_um": low, "to_um": high, "points": int(here.sum())} | medians)
    return table


def _identity(found: _Lines, assigned: np.ndarray, raw: np.ndarray, length_mm: float) -> dict:
    """Pieces and jumps. assigned, raw (N,): number of the fiber that each sample lies on, -1 for none."""
    curve = found.curve
    starts = np.flatnonzero(np.r_[True, (np.diff(assigned) != 0) | (np.diff(curve) != 0)])
    run_length = np.diff(np.r_[starts, len(assigned)]) * SAMPLE_MM
    long = (assigned[starts] >= 0) & (run_length >= ON_FIBER_MM - 1e-9)
    run_curve, run_fiber, run_length = curve[starts][long], assigned[starts][long], run_length[long]
    changes = int(((np.diff(run_curve) == 0) & (np.diff(run_fiber) != 0)).sum())
    pair, place = np.unique(np.stack([run_curve, run_fiber], axis=1), axis=0, return_inverse=True)
    followed = pair[np.bincount(place.ravel(), run_length, len(pair)) >= FOLLOWED_MM - 1e-9]
    pieces = np.unique(followed[:, 1], return_counts=True)[1]
    following, fibers_each = np.unique(pair[:, 0], return_counts=True)
    raw_pairs = np.unique(np.stack([curve, raw], axis=1)[raw >= 0], axis=0)
    raw_each = np.bincount(raw_pairs[:, 0], minlength=len(found.offsets) - 1)[following]
    return {
        "curves_following": len(following),
        "matched_hairs": len(pieces),
        "fragments_per_matched_hair": float(pieces.mean()) if len(pieces) else None,
        "identity_switch_fraction": float((fibers_each > 1).mean()) if len(following) else None,
        "identity_switch_raw": float((raw_each > 1).mean()) if len(following) else None,
        "switches_per_100mm": float(100 * changes / max(length_mm, 1e-9)),
    }


def _spread(values: np.ndarray) -> dict:
    return {"mean": float(values.mean()), "median": float(np.median(values)), "p95": float(np.percentile(values, 95))}


# ---- curves at an even spacing, nearest points, assignment -------------------------------------------------------------


def _lines(points_mm: np.ndarray, offsets: np.ndarray, spacing_mm: float) -> _Lines:
    """Curves of points (N, 3) at a spacing near spacing_mm that divides each evenly; curves of no length are empty."""
    points, sizes = _resample(np.ascontiguousarray(points_mm, np.float64), np.asarray(offsets, np.int64), spacing_mm)
    offsets = offsets_of(sizes)
    first, last = (np.repeat(ends, sizes) for ends in (offsets[:-1], offsets[1:] - 1))
    i = np.arange(len(points))
    chord = points[np.minimum(i + 1, last)] - points[np.maximum(i - 1, first)]
    return _Lines(points, chord / (np.linalg.norm(chord, axis=1, keepdims=True) + 1e-12), offsets)


@njit(cache=True)
def _resample(points, offsets, spacing):
    """Points (n, 3) and number of points (M,) of curves resampled evenly by arc length."""
    arc = np.zeros(len(points))
    sizes = np.zeros(len(offsets) - 1, np.int64)
    for c in range(len(sizes)):
        for i in range(offsets[c] + 1, offsets[c + 1]):
            arc[i] = arc[i - 1] + np.sqrt(((points[i] - points[i - 1]) ** 2).sum())
        if offsets[c + 1] > offsets[c] and arc[offsets[c + 1] - 1] > 1e-12:
            sizes[c] = max(int(np.rint(arc[offsets[c + 1] - 1] / spacing)), 1) + 1
    even = np.empty((sizes.sum(), 3))
    k = 0
    for c in range(len(sizes)):
        i, total = offsets[c], arc[offsets[c + 1] - 1]
        for j in range(sizes[c]):
            s = total * j / (sizes[c] - 1)
            while i < offsets[c + 1] - 2 and arc[i + 1] < s:
                i += 1
            step = arc[i + 1] - arc[i]
            t = min(max((s - arc[i]) / step, 0.0), 1.0) if step > 0.0 else 0.0
            even[k] = points[i] + t * (points[i + 1] - points[i])
            k += 1
    return even, sizes


def _nearest(lines: _Lines, points: np.ndarray):
    """Distance (K,), unit tangent (K, 3) and number (K,) of the curve nearest to points (K, 3); inf, 0, -1 without curves."""
    if len(lines.points) == 0:
        return np.full(len(points), np.inf), np.zeros((len(points), 3)), np.full(len(points), -1)
    curve = lines.curve
    distance, i = cKDTree(lines.points).query(points, workers=-1)
    best = distance.copy()
    for start in (i - 1, i):  # the segments before and after the nearest point
        a = np.clip(start, 0, len(lines.points) - 2)
        edge = lines.points[a + 1] - lines.points[a]
        t = np.clip(((points - lines.points[a]) * edge).sum(1) / np.maximum((edge**2).sum(1), 1e-18), 0, 1)
        beside = np.linalg.norm(points - lines.points[a] - t[:, None] * edge, axis=1)
        same = (curve[a] == curve[i]) & (curve[a + 1] == curve[i])
        best = np.where(same & (beside < best), beside, best)
    return best, lines.tangents[i], curve[i]


def _assign(found: _Lines, fibers: _Lines, tolerance_mm: float) -> np.ndarray:
    """Number (N,) of the fiber that each sample most probably lies on, -1 for none, each curve taken as a whole.

    A Viterbi path: a sample on a fiber costs (distance / SIGMA_MM)^2, on none as much as at the tolerance; a change of
    fiber costs SWITCH_COST, half of it to or from none. So a curve between two touching fibers does not flicker.
    """
    rows, fiber, distance = _pairs(found.points, fibers, REACH * tolerance_mm)
    starts = np.searchsorted(rows, np.arange(len(found.points) + 1))
    return _viterbi(found.offsets, starts, fiber, (distance / SIGMA_MM) ** 2, (tolerance_mm / SIGMA_MM) ** 2, SWITCH_COST)


def _pairs(points, fibers: _Lines, reach_mm: float, chunk: int = 20_000):
    """Sample (P,), fiber (P,) and distance (P,) of all fibers within reach of each sample, samples in order."""
    tree, curve, parts = cKDTree(fibers.points), fibers.curve, []
    for first in range(0, len(points), chunk):
        pairs = cKDTree(points[first : first + chunk]).sparse_distance_matrix(tree, reach_mm, output_type="ndarray")
        sample, fiber = pairs["i"] + first, curve[pairs["j"]]
        order = np.lexsort((pairs["v"], fiber, sample))
        sample, fiber, distance = sample[order], fiber[order], pairs["v"][order]
        nearest = np.r_[True, (np.diff(sample) != 0) | (np.diff(fiber) != 0)][: len(sample)]
        parts.append((sample[nearest], fiber[nearest], distance[nearest]))
    return (np.concatenate(column) for column in zip(*parts, strict=True))


@njit(cache=True)
def _viterbi(offsets, starts, fiber, cost, no_fiber, switch):
    """Fiber (N,) of each sample. Sample i has the candidates starts[i]:starts[i + 1] of fiber and cost."""
    path = np.full(offsets[-1], -1, np.int64)
    for c in range(len(offsets) - 1):
        first, n = offsets[c], offsets[c + 1] - offsets[c]
        if n == 0 or starts[first] == starts[first + n]:
            continue
        names = np.unique(fiber[starts[first] : starts[first + n]])
        none = len(names)
        emission = np.full((n, none + 1), 1.5 * no_fiber)  # a fiber out of reach costs more than none
        emission[:, none] = no_fiber
        for i in range(n):
            for k in range(starts[first + i], starts[first + i + 1]):
                name = np.searchsorted(names, fiber[k])
                emission[i, name] = min(emission[i, name], cost[k])
        total = emission[0].copy()
        back = np.zeros((n, none + 1), np.int64)
        for i in range(1, n):
            best, cheapest = 0, np.inf
            for s in range(none + 1):
                leave = total[s] + (0.5 * switch if s < none else 0.0)
                if leave < cheapest:
                    best, cheapest = s, leave
            for s in range(none + 1):
                via = cheapest + (0.5 * switch if s < none else 0.0)
                back[i, s] = s if total[s] <= via else best
                total[s] = min(total[s], via) + emission[i, s]
        s = np.argmin(total)
        for i in range(n - 1, -1, -1):
            if s < none:
                path[first + i] = names[s]
            s = back[i, s]
    return path


# ---- curves drawn back onto a photograph (Figure 14) ---------------------------------------------------------------------


@dataclass(frozen=True)
class Shot:
    """A photograph of a capture, by number."""

    sweep: int
    photograph: int


def depth_of_field_mm(optics: Optics) -> float:
    """Extent along w, around the plane of focus, in which the cone of rays is narrower than a hair (the paper's 1.2 mm)."""
    return SHARP_MM / np.tan(np.radians(optics.aperture_cone_deg / 2))


def choose_shot(
    capture: Capture, strands: Strands, sweep: int | None = None, angle_deg: float | None = None, position_mm: float | None = None
) -> Shot:
    """The photograph with the most curve in focus and in front, among those of a sweep (by number from 0, or nearest angle)
    and nearest to a position where these are given. Raises StrandscopeError for a sweep that is not there."""
    if sweep is not None and not 0 <= sweep < len(capture.sweeps):
        raise StrandscopeError(f"{capture.folder}: there is no sweep {sweep}; expected 0 … {len(capture.sweeps) - 1}")
    if sweep is None and angle_deg is not None:
        away = [abs((s.angle_deg - angle_deg + 180) % 360 - 180) for s in capture.sweeps]
        sweep = int(np.argmin(away))
    best, most = Shot(0 if sweep is None else sweep, 0), -1
    half = depth_of_field_mm(capture.optics) / 2
    for k in range(len(capture.sweeps)) if sweep is None else [sweep]:
        positions = np.asarray(capture.sweeps[k].positions_mm)
        depth = np.sort(_foremost(camera_points(strands.points_mm, capture.sweeps[k].angle_deg, capture.optics)))
        in_focus = np.searchsorted(depth, positions + half) - np.searchsorted(depth, positions - half)
        i = int(np.argmax(in_focus) if position_mm is None else np.argmin(np.abs(positions - position_mm)))
        if in_focus[i] > most:
            best, most = Shot(k, i), in_focus[i]
    return best


def _foremost(points_mm: np.ndarray) -> np.ndarray:
    """w (n,) of the points (N, 3) of a camera frame with no other more than FRONT_MM before them, in squares of CELL_MM."""
    square = np.floor(points_mm[:, :2] / CELL_MM).astype(np.int64)
    _, cell = np.unique(square, axis=0, return_inverse=True)
    front = np.full(cell.max(initial=-1) + 1, -np.inf)
    np.maximum.at(front, cell, points_mm[:, 2])
    return points_mm[points_mm[:, 2] > front[cell] - FRONT_MM, 2]


def in_focus(capture: Capture, strands: Strands, shot: Shot) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (S, 2, 2) of the ends (column, row) of all segments within the depth of field, and their curves (S,)."""
    sweep = capture.sweeps[shot.sweep]
    d, optics = sweep.positions_mm[shot.photograph], capture.optics
    *pixel, w = pixels(strands.points_mm, sweep.angle_deg, d, optics, capture.shape).T
    pixel = np.stack(pixel, axis=1)
    curve = np.repeat(np.arange(len(strands)), np.diff(strands.offsets))
    sharp = np.abs(w - d) <= depth_of_field_mm(optics) / 2
    keep = sharp[:-1] & sharp[1:] & (curve[:-1] == curve[1:])
    return np.stack([pixel[:-1][keep], pixel[1:][keep]], axis=1), curve[:-1][keep]


def overlay(capture: Capture, strands: Strands, shot: Shot, out: Path, color_by: str = "strand") -> str:
    """Write a picture (.png): a photograph, its ridges, and the curves in focus drawn over it, side by side.

    The ridges are those that the strands were grown from, if their provenance tells. color_by: "strand" gives each curve a
    colour of its own; "kind" tells captured from infill. Returns the caption. Raises CaptureError for a photograph that
    cannot be read, StrandscopeError for a picture that cannot be written.
    """
    from PIL import Image

    if Path(out).suffix.lower() != ".png":
        raise StrandscopeError(f"{out}: the picture's name must end in .png")
    sweep = capture.sweeps[shot.sweep]
    file = sweep.files[shot.photograph]
    planes = capture.planes(file, "RGB")
    zoom = max(1, -(-PANEL_PX // max(planes.shape[1:])))
    segments, curve = in_focus(capture, strands, shot)
    caption = f"{file}: sweep {shot.sweep} at {sweep.angle_deg:g}°, d = {sweep.positions_mm[shot.photograph]:g} mm"
    count = f"{len(np.unique(curve))} of {len(strands)} curves in focus (within {depth_of_field_mm(capture.optics):.1f} mm)"
    photograph = _enlarge(_developed(planes), zoom)
    crests = response(planes[0], _ridge_params(strands, planes[0]))
    shown = (255 * np.sqrt(np.clip(crests / max(float(np.percentile(crests[crests > 0], 99)) if (crests > 0).any() else 1.0, 1e-6), 0, 1))).astype(
        np.uint8
    )
    gray = photograph.convert("L").point(lambda x: x // 2).convert("RGB")
    drawn = _draw(gray, segments, _colors(strands, color_by)[curve], zoom)
    panels = [(photograph, caption), (_enlarge(shown, zoom).convert("RGB"), "ridges"), (drawn, count)]
    width, height = photograph.size
    picture = Image.new("RGB", (3 * width + 2 * 4, height + CAPTION_PX), (24, 24, 24))
    for k, (panel, text) in enumerate(panels):
        picture.paste(panel, (k * (width + 4), 0))
        _write(picture, (k * (width + 4) + 6, height + 4), text)
    with atomic(out) as part:
        picture.save(part)
    return f"{caption}; {count}"


def _ridge_params(strands: Strands, plane: np.ndarray) -> RidgeParams:
    """The parameters of the ridges that strands were grown from, else the usual ones for a plane."""
    try:
        return RidgeParams(**strands.provenance["parameters"]["ridges"])
    except (KeyError, TypeError):
        return estimate([plane], RidgeParams())


def _developed(planes: np.ndarray) -> np.ndarray:
    """Linear planes (3, H, W) -> (H, W, 3) uint8 for the eye: the brightest half percent is white, gamma 2.2."""
    light = np.clip(planes / max(float(np.percentile(planes, 99.5)), 1e-6), 0, 1) ** (1 / 2.2)
    return (255 * np.moveaxis(light, 0, -1) + 0.5).astype(np.uint8)


def _enlarge(pixels: np.ndarray, zoom: int):
    from PIL import Image

    image = Image.fromarray(pixels)
    return image.resize((image.width * zoom, image.height * zoom), Image.Resampling.BICUBIC)


def _colors(strands: Strands, color_by: str) -> np.ndarray:
    """RGB (M, 3) uint8 of each curve: hues a golden angle apart, infill gray."""
    hues = [colorsys.hsv_to_rgb(i * 0.618034 % 1.0 if color_by == "strand" else 0.11, 0.75, 1.0) for i in range(len(strands))]
    colors = (255 * np.array(hues).reshape(-1, 3)).astype(np.uint8)
    colors[strands.kind == INFILL] = INFILL_COLOR
    return colors


def _draw(image, segments: np.ndarray, colors: np.ndarray, zoom: int):
    """The image with segments (S, 2, 2) of a channel plane's pixels drawn over it, in colors (S, 3), anti-aliased."""
    from PIL import Image, ImageDraw

    layer = Image.new("RGBA", (image.width * SMOOTH, image.height * SMOOTH))
    pen = ImageDraw.Draw(layer)
    for ends, color in zip((segments + 0.5) * zoom * SMOOTH, colors, strict=True):
        pen.line([*map(tuple, ends)], fill=(*color.tolist(), 255), width=round(1.5 * SMOOTH))
    layer = layer.resize(image.size, Image.Resampling.BOX)
    return Image.alpha_composite(image.convert("RGBA"), layer).convert("RGB")


def _write(image, where: tuple[int, int], text: str) -> None:
    from PIL import ImageDraw, ImageFont

    ImageDraw.Draw(image).text(where, text, fill=(220, 220, 220), font=ImageFont.load_default(14))
