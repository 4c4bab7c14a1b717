"""The result: hair as many 3D curves, one flat array of points and the offsets at which the curves begin."""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from .errors import StrandsError
from .files import atomic
from .joins import fibers_of
from .stops import Stop

CAPTURED, INFILL = 0, 1  # the values of ``kind``


@dataclass(frozen=True)
class Strands:
    """M curves of N points. Curve i is ``points_mm[offsets[i]:offsets[i + 1]]``."""

    points_mm: np.ndarray  # (N, 3) float32, object frame
    offsets: np.ndarray  # (M + 1,) int64
    radius_mm: np.ndarray  # (N,) float32
    kind: np.ndarray  # (M,) uint8: CAPTURED or INFILL
    confidence: np.ndarray  # (N,) float32, 0 to 1
    stops: np.ndarray | None = None  # (M, 2) uint8: why either end of a curve stopped growing (``stops.Stop``), 0 unknown
    error_mm: np.ndarray | None = None  # (N,) float32: expected error (``confidence.expected_error``), NaN where it is not known
    evidence: np.ndarray | None = None  # (N,) float32: cameras that saw the point, each by the share of a free view that it had
    joins: np.ndarray | None = None  # (J, 2) int64: ends at which two curves are one fiber; 2 c: the first point of curve c, 2 c + 1: its last
    provenance: dict = field(default_factory=dict)  # capture's name, parameters, version

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def __getitem__(self, i: int) -> np.ndarray:
        """Points (n, 3) of curve i, mm."""
        return self.points_mm[self.offsets[i] : self.offsets[i + 1]]

    def select(self, keep: np.ndarray) -> "Strands":
        """The curves for which keep (M,) is true."""
        sizes = np.diff(self.offsets)
        points = np.repeat(keep, sizes)
        return replace(
            self,
            points_mm=self.points_mm[points],
            offsets=offsets_of(sizes[keep]),
            radius_mm=self.radius_mm[points],
            kind=self.kind[keep],
            confidence=self.confidence[points],
            stops=None if self.stops is None else self.stops[keep],
            error_mm=None if self.error_mm is None else self.error_mm[points],
            evidence=None if self.evidence is None else self.evidence[points],
            joins=None if self.joins is None else _kept(self.joins, keep),
        )

    @property
    def captured(self) -> "Strands":
        """The curves that were seen, without the infill."""
        return self.select(self.kind == CAPTURED)


def _kept(joins: np.ndarray, keep: np.ndarray) -> np.ndarray:
    """The joins between curves that are both kept, in their new numbers."""
    number = np.cumsum(keep) - 1
    both = joins[keep[joins // 2].all(axis=1)]
    return 2 * number[both // 2] + both % 2


def fibers(strands: Strands) -> np.ndarray:
    """For each curve (M,) int64 the number of the fiber that it is a piece of, as ``joins`` tell; without any, a fiber is a curve."""
    return fibers_of(np.empty((0, 2), np.int64) if strands.joins is None else strands.joins, len(strands))


def clip(strands: Strands, depth_mm: np.ndarray) -> tuple[Strands, np.ndarray]:
    """The pieces (m) of curves where depth_mm (N,), linear between points, is above 0, and the number (m,) of the curve that each is of.

    A piece ends where depth_mm is 0. Why curves ended, their errors, evidence and joins are not kept.
    """
    depth, last = np.asarray(depth_mm, float), len(strands.points_mm) - 1
    steps = np.delete(np.arange(last), strands.offsets[1:-1] - 1)  # each from a point to the next of its curve
    edges = steps[(depth[steps] > 0) != (depth[steps + 1] > 0)]
    inside = np.flatnonzero(depth > 0)
    place = np.r_[inside, edges + depth[edges] / (depth[edges] - depth[edges + 1])]  # in points and their fractions
    enters = np.r_[np.zeros(len(inside), bool), depth[edges] <= 0]
    order = np.lexsort((enters, place))  # where one piece ends and another begins, it ends first
    place, enters = place[order], enters[order]
    curve = np.searchsorted(strands.offsets, place.astype(int), side="right") - 1
    begins = enters | np.r_[True, np.diff(curve) != 0][: len(place)]
    sizes = np.bincount(np.cumsum(begins) - 1, minlength=0)
    long = sizes >= 2
    keep = np.repeat(long, sizes)
    low = place[keep].astype(int)
    share = place[keep] - low

    def between(values):
        weight = share.reshape(-1, *[1] * (values.ndim - 1))
        return ((1 - weight) * values[low] + weight * values[np.minimum(low + 1, last)]).astype(np.float32)

    of = curve[begins][long]
    return Strands(between(strands.points_mm), offsets_of(sizes[long]), between(strands.radius_mm), strands.kind[of], between(strands.confidence)), of


def offsets_of(sizes: np.ndarray) -> np.ndarray:
    """Offsets (M + 1,) int64 of curves with sizes (M,) points."""
    return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)


def lengths(points_mm: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Length (M,) of each curve, mm."""
    steps = np.r_[0.0, np.linalg.norm(np.diff(np.asarray(points_mm, float), axis=0), axis=1)]
    steps[np.asarray(offsets[:-1])[np.diff(offsets) > 0]] = 0.0
    total = np.r_[0.0, np.cumsum(steps)]
    return total[offsets[1:]] - total[offsets[:-1]]


def statistics(strands: Strands) -> dict:
    """The numbers that the paper's section 5 gives of a result: counts, lengths in mm, and the mean number of captured
    curves that cross a horizontal plane, over all planes between their lowest and highest point.

    Lengths and crossings are those of the captured curves; of the infill, count and total length.
    """
    captured = strands.captured
    length = lengths(captured.points_mm, captured.offsets)
    height = captured.points_mm[:, 1].astype(float)
    extent = float(np.ptp(height)) if len(captured) else 0.0
    starts = captured.offsets[:-1]
    spans = np.maximum.reduceat(height, starts) - np.minimum.reduceat(height, starts) if len(captured) else np.zeros(0)
    infill = strands.select(strands.kind == INFILL)
    errors = np.zeros(0) if captured.error_mm is None else captured.error_mm[np.isfinite(captured.error_mm)]
    return {
        "curves": len(captured),
        "mean_curves_crossing_a_horizontal_plane": float(spans.sum() / extent) if extent else 0.0,
        "height_mm": extent,
        "length_mm": {
            "total": float(length.sum()),
            "mean": float(length.mean()) if len(length) else 0.0,
            "median": float(np.median(length)) if len(length) else 0.0,
            "longest": float(length.max(initial=0.0)),
        },
        "ends": {stop.words: int(np.sum(captured.stops == stop)) for stop in Stop} if captured.stops is not None else {},
        "infill_curves": len(infill),
        "infill_length_mm": float(lengths(infill.points_mm, infill.offsets).sum()),
        "points": len(strands.points_mm),
        "mean_radius_mm": float(captured.radius_mm.mean()) if len(captured) else 0.0,
        "mean_confidence": float(captured.confidence.mean()) if len(captured) else 0.0,
        "expected_error_mm": {name: float(np.percentile(errors, p)) for name, p in (("median", 50), ("p95", 95))} if len(errors) else {},
    }


def describe(numbers: dict) -> list[tuple[str, str]]:
    """The numbers of ``statistics`` as rows (name, value) for people."""
    length, error = numbers["length_mm"], numbers["expected_error_mm"]
    crossing = f"{numbers['mean_curves_crossing_a_horizontal_plane']:.1f} on average, over a height of {numbers['height_mm']:.1f} mm"
    return [
        ("captured curves", f"{numbers['curves']}"),
        ("crossing a horizontal plane", crossing),
        ("length of a curve", f"{length['mean']:.1f} mm (median {length['median']:.1f}, longest {length['longest']:.1f})"),
        ("length of all", f"{length['total']:.0f} mm"),
        ("radius", f"{numbers['mean_radius_mm']:.4f} mm"),
        ("confidence", f"{numbers['mean_confidence']:.2f} of 1"),
        ("expected error", f"{1000 * error['median']:.1f} µm (median, 95 % below {1000 * error['p95']:.1f})" if error else "unknown"),
        ("ends of curves", ", ".join(f"{words}: {count}" for words, count in numbers["ends"].items() if count) or "unknown"),
        ("infill curves", f"{numbers['infill_curves']} ({numbers['infill_length_mm']:.0f} mm)"),
        ("points", f"{numbers['points']}"),
    ]


def concatenate(parts: list[Strands], provenance: dict) -> Strands:
    """All curves of the parts, in order."""
    return Strands(
        points_mm=np.concatenate([p.points_mm for p in parts]),
        offsets=offsets_of(np.concatenate([np.diff(p.offsets) for p in parts])),
        radius_mm=np.concatenate([p.radius_mm for p in parts]),
        kind=np.concatenate([p.kind for p in parts]),
        confidence=np.concatenate([p.confidence for p in parts]),
        stops=np.concatenate([np.zeros((len(p), 2), np.uint8) if p.stops is None else p.stops for p in parts]),
        error_mm=None if all(p.error_mm is None for p in parts) else np.concatenate([_errors(p) for p in parts]),
        evidence=None if all(p.evidence is None for p in parts) else np.concatenate([_evidence(p) for p in parts]),
        joins=None if all(p.joins is None for p in parts) else _joins(parts),
        provenance=provenance,
    )


def _evidence(strands: Strands) -> np.ndarray:
    return np.zeros(len(strands.points_mm), np.float32) if strands.evidence is None else strands.evidence


def _joins(parts: list[Strands]) -> np.ndarray:
    """The joins of all parts, in the numbers of their curves together."""
    before = np.concatenate([[0], np.cumsum([len(p) for p in parts])])
    return np.concatenate([p.joins + 2 * first for p, first in zip(parts, before[:-1], strict=True) if p.joins is not None])


def _errors(strands: Strands) -> np.ndarray:
    return np.full(len(strands.points_mm), np.nan, np.float32) if strands.error_mm is None else strands.error_mm


def save_strands(path: Path, strands: Strands) -> None:
    """Write a strands file (.npz), atomically; the same strands give the same bytes. Raises StrandsError for bad values."""
    check(strands, path)
    arrays = {
        "points": strands.points_mm.astype(np.float32),
        "offsets": strands.offsets.astype(np.int64),
        "radius": strands.radius_mm.astype(np.float32),
        "kind": strands.kind.astype(np.uint8),
        "confidence": strands.confidence.astype(np.float32),
        "stops": np.zeros((len(strands), 2), np.uint8) if strands.stops is None else strands.stops.astype(np.uint8),
        "provenance": np.array(json.dumps(strands.provenance, sort_keys=True)),
    }
    if strands.error_mm is not None:
        arrays["error"] = strands.error_mm.astype(np.float32)
    if strands.evidence is not None:
        arrays["evidence"] = strands.evidence.astype(np.float32)
    if strands.joins is not None:
        arrays["joins"] = strands.joins.astype(np.int64)
    with atomic(path) as part:
        np.savez(part, **arrays)  # numpy writes the zip's time stamps as 1980-01-01


def load_strands(path: Path) -> Strands:
    """Read a strands file. Raises StrandsError, naming the array, for anything but a whole and finite one."""
    arrays = load_arrays(path, ("points", "offsets"))
    points, offsets = arrays["points"], arrays["offsets"]
    count = len(points) if points.ndim else 0
    sizes = max(len(offsets) - 1, 0) if offsets.ndim else 0
    try:
        provenance = json.loads(str(arrays.get("provenance", "{}")))
    except json.JSONDecodeError as error:
        raise StrandsError(f"{path}: provenance is not valid JSON: {error}") from error
    strands = Strands(
        points_mm=points,
        offsets=offsets,
        radius_mm=arrays.get("radius", np.full(count, 0.04, np.float32)),
        kind=arrays.get("kind", np.zeros(sizes, np.uint8)),
        confidence=arrays.get("confidence", np.ones(count, np.float32)),
        stops=arrays.get("stops"),
        error_mm=arrays.get("error"),
        evidence=arrays.get("evidence"),
        joins=arrays.get("joins"),
        provenance=provenance,
    )
    check(strands, path)
    return strands


def load_arrays(path: Path, required: tuple[str, ...]) -> dict[str, np.ndarray]:
    """The arrays of an .npz file. Raises StrandsError where it is missing, damaged, or lacks a required array."""
    path = Path(path)
    if not path.is_file():
        raise StrandsError(f"{path}: not found; expected an .npz file")
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = dict(archive)
    except Exception as error:  # zipfile, zlib and numpy each raise their own for damaged files
        raise StrandsError(f"{path}: not a complete .npz file ({' '.join(str(error).split())})") from error
    missing = [name for name in required if name not in arrays]
    if missing:
        raise StrandsError(f"{path}: the array '{missing[0]}' is missing; found {', '.join(sorted(arrays)) or 'nothing'}")
    return arrays


def check(strands: Strands, path: Path) -> None:
    """Raise StrandsError, naming ``path`` and the array, unless shapes agree and every value is one that hair can have."""
    points, offsets = strands.points_mm, strands.offsets
    _expect(points.ndim == 2 and points.shape[1] == 3, path, "points", points.shape, "shape (N, 3)")
    _expect(offsets.ndim == 1 and len(offsets) > 0 and np.issubdtype(offsets.dtype, np.integer), path, "offsets", offsets.dtype, "integers (M + 1,)")
    good = offsets[0] == 0 and offsets[-1] == len(points) and bool(np.all(np.diff(offsets) >= 2))
    _expect(good, path, "offsets", "out of order", f"0 … {len(points)}, each curve with at least 2 points")
    for name, values in (("radius", strands.radius_mm), ("confidence", strands.confidence)):
        _expect(values.shape == (len(points),), path, name, values.shape, f"one value a point ({len(points)},)")
    _expect(strands.kind.shape == (len(strands),), path, "kind", strands.kind.shape, f"one value a curve ({len(strands)},)")
    if strands.stops is not None:
        _expect(strands.stops.shape == (len(strands), 2), path, "stops", strands.stops.shape, f"two values a curve ({len(strands)}, 2)")
    if strands.error_mm is not None:
        _expect(strands.error_mm.shape == (len(points),), path, "error", strands.error_mm.shape, f"one value a point ({len(points)},)")
        good = np.isnan(strands.error_mm) | ((strands.error_mm >= 0) & np.isfinite(strands.error_mm))
        _expect(bool(np.all(good)), path, "error", "outside its range", "0 mm or more, or NaN where it is not known")
    if strands.evidence is not None:
        _expect(strands.evidence.shape == (len(points),), path, "evidence", strands.evidence.shape, f"one value a point ({len(points)},)")
        good = bool(np.all(np.isfinite(strands.evidence) & (strands.evidence >= 0)))
        _expect(good, path, "evidence", "outside its range", "0 cameras or more")
    joins = strands.joins
    if joins is not None:
        _expect(joins.ndim == 2 and joins.shape[1] == 2 and np.issubdtype(joins.dtype, np.integer), path, "joins", joins.shape, "integers (J, 2)")
        good = not joins.size or (joins.min() >= 0 and joins.max() < 2 * len(strands) and np.unique(joins).size == joins.size)
        _expect(bool(good), path, "joins", "not of ends", f"0 … {2 * len(strands) - 1}, each end in one join at most")
    for name, values in (("points", points), ("radius", strands.radius_mm), ("confidence", strands.confidence)):
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            raise StrandsError(f"{path}: {name}{bad[0].tolist()} is {values[tuple(bad[0])]}; expected finite numbers ({len(bad)} are not)")
    _expect(bool(np.all(strands.radius_mm > 0)), path, "radius", "0 or less", "more than 0 mm")
    confidence = strands.confidence
    _expect(bool(np.all((confidence >= 0) & (confidence <= 1))), path, "confidence", "outside its range", "0 to 1")
    _expect(
        bool(np.all((strands.kind >= CAPTURED) & (strands.kind <= INFILL))),
        path,
        "kind",
        int(strands.kind.max(initial=0)),
        "0 (captured) or 1 (infill)",
    )


def _expect(good: bool, path: Path, name: str, found, expected: str) -> None:
    if not good:
        raise StrandsError(f"{path}: {name} is {found}; expected {expected}")
