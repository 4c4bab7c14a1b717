"""How hair lies together: density, neighbours, bends, clumps, flyaways; what was captured, the infill, and known hair side by side.

docs/statistics.md says what each number means. Every number is a mean over length: curves are sampled at an even arc length and each
sample counts once, so that a hair in ten pieces counts as much as a whole one. Samples outside the region are left out, but the hair
there still stands beside those inside.
"""

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.fft import irfft2, rfft2
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from .bends import BendParams, Spectrum, bends, evenly, spectrum
from .errors import StrandscopeError, StrandsError
from .neighbours import Pairs, nearest_other, pairs_in_turn
from .progress import Progress, silent
from .strands import CAPTURED, INFILL, Strands, check, lengths, load_arrays, load_strands

CAPTURED_NAME, INFILL_NAME, ALL_NAME, BESIDE_NAME = "captured", "infill", "captured and infill", "beside"
CLUMP_CLASSES = (1, 2, 3, 5, 9, 17, 33)  # smallest size of each class of clumps; 1 is a fiber on its own
_ANGLES = 360  # bins of 0.25° of the angle between neighbours
_MOST_PLANES = 64
_WINDOW_PX = 400  # across the hair, at most
_HISTOGRAM_BINS = 48


@dataclass(frozen=True)
class StatisticsParams:
    """What is taken as near, parallel, together and alone. Lengths in mm."""

    step_mm: float = 0.2  # between samples along a curve
    plane_mm: float = 0.5  # between horizontal planes; more where the hair is taller than 64 of them
    cell_mm: float = 1.0  # edge of the squares of a plane in which fibers are counted
    gap_mm: float = 1.0  # a hollow that a circle of this radius does not fit in belongs to the hair
    reach_mm: float = 1.5  # how far neighbours are looked at
    bin_mm: float = 0.05  # of their distance
    around_mm: float = 1.0  # radius within which other curves are counted for the density at a fiber
    clump_radii: float = 8.0  # distance of two centrelines in sums of radii, up to which they may be of one clump
    clump_deg: float = 15.0  # and their angle
    clump_share: float = 0.7  # and the share of the shorter one for which that must hold
    clump_mm: float = 5.0  # and the length for which it must hold at least; shorter pieces are of no clump
    flyaway_density: float = 0.15  # of the median density at fibers, below which a fiber has left the others
    flyaway_mm: float = 2.0  # in one go, from which on it is a flyaway
    touching: float = 0.9  # of the sum of radii: nearer than this, two fibers run through each other
    bends: BendParams = field(default_factory=BendParams)
    segment_mm: float | None = None  # of the spectra; None: what half of the curves hold, of 4, 6, 8, 12, … 64


@dataclass(frozen=True)
class Region:
    """Where samples count: between two heights, and within a distance of the turntable's axis."""

    low_mm: float
    high_mm: float
    radius_mm: float = np.inf

    def holds(self, points_mm: np.ndarray) -> np.ndarray:
        """(N,) bool of points (N, 3)."""
        points = np.asarray(points_mm, float)
        return (points[:, 1] >= self.low_mm) & (points[:, 1] <= self.high_mm) & (np.hypot(points[:, 0], points[:, 2]) <= self.radius_mm)


class _Raw(NamedTuple):
    """What was measured of one set of curves, before it is told by a few numbers."""

    curves: int
    length_mm: float
    samples: dict[str, np.ndarray]  # values of each quantity, as they were sampled
    counted: dict  # what is told as it is


# ---- reading ---------------------------------------------------------------------------------------------------------


def load_hair(path: Path) -> Strands:
    """Read a strands file, or the hair of a truth file as captured strands. Raises StrandsError, naming the array, for bad ones."""
    arrays = load_arrays(path, ("points", "offsets"))
    if "radii" not in arrays:
        return load_strands(path)
    points, offsets, radii = (np.asarray(arrays[name]) for name in ("points", "offsets", "radii"))
    if offsets.ndim != 1 or radii.shape != (max(len(offsets) - 1, 0),):
        raise StrandsError(f"{path}: radii is {radii.shape}; expected one value a curve ({max(len(np.atleast_1d(offsets)) - 1, 0)},)")
    sizes = np.diff(offsets)
    whole = np.all(sizes >= 0) and sizes.sum() == len(points)
    radius = np.repeat(radii, sizes) if whole else np.zeros(0)  # what is not whole is told by ``check``
    hair = Strands(points, offsets, radius.astype(np.float32), np.full(len(radii), CAPTURED, np.uint8), np.ones(len(radius), np.float32))
    check(hair, path)
    return hair


# ---- all numbers -----------------------------------------------------------------------------------------------------


def side_by_side(
    strands: Strands,
    beside: Strands | None = None,
    inside_mm: tuple[float, float] | None = None,
    radius_mm: float | None = None,
    params: StatisticsParams | None = None,
    progress: Progress = silent,
) -> dict:
    """All statistics of the captured curves, the infill, and both, and of other hair beside them, as numbers that JSON can hold.

    inside_mm: the heights between which samples count; None: all that the strands span. radius_mm: the distance from the axis up to which
    they count; None: any, and with other hair beside it, the greatest that the strands have. Raises StrandscopeError where nothing lies
    there.
    """
    params = params or StatisticsParams()
    region = _region(strands, beside, inside_mm, radius_mm)
    hairs = [(strands, {CAPTURED_NAME: CAPTURED, INFILL_NAME: INFILL}, ALL_NAME)]
    if beside is not None:
        hairs.append((replace(beside, kind=np.zeros(len(beside), np.uint8)), {BESIDE_NAME: CAPTURED}, None))
    if not np.any(region.holds(strands.points_mm)):
        raise StrandscopeError(f"no hair lies between the heights {region.low_mm:g} and {region.high_mm:g} mm; expected some of the strands there")
    params = replace(params, segment_mm=params.segment_mm or _segment_length(strands, region, params))
    raws = {}
    for hair, kinds, both in hairs:
        raws |= _measure(hair, kinds, both, region, params, progress)
    return {
        "region": {"low_mm": region.low_mm, "high_mm": region.high_mm, "radius_mm": region.radius_mm if np.isfinite(region.radius_mm) else None},
        "parameters": asdict(params),
        "sets": _told(raws),
    }


def _region(strands: Strands, beside: Strands | None, inside_mm, radius_mm) -> Region:
    points = np.asarray(strands.points_mm, float)
    low, high = inside_mm or ((float(points[:, 1].min()), float(points[:, 1].max())) if len(points) else (0.0, 0.0))
    if inside_mm and not low < high:
        raise StrandscopeError(f"the heights to look between are {low:g} and {high:g} mm; expected the lower one first")
    if radius_mm is None:
        radius_mm = np.inf if beside is None or not len(points) else float(np.hypot(points[:, 0], points[:, 2]).max())
    return Region(float(low), float(high), float(radius_mm))


def _segment_length(strands: Strands, region: Region, params: StatisticsParams) -> float:
    """The longest of 4, 6, 8, 12, … 64 mm that the inner part of half of the curves holds, by length inside the region."""
    captured = strands.captured if len(strands.captured) else strands
    even, offsets = evenly(captured.points_mm, captured.offsets, params.bends.step_mm)
    curve = np.repeat(np.arange(len(captured)), np.diff(offsets))
    inside = np.bincount(curve[region.holds(even)], minlength=len(captured)) * params.bends.step_mm
    median = float(np.median(inside[inside > 0])) if np.any(inside > 0) else 0.0
    room = median - 2 * max(params.bends.curvature_mm, params.bends.torsion_mm)
    lengths_mm = [4.0 * 2**k * part for k in range(5) for part in (1.0, 1.5)][:9]
    return max((length for length in lengths_mm if length <= room), default=lengths_mm[0])


def _measure(hair: Strands, kinds: dict[str, int], both: str | None, region: Region, params: StatisticsParams, progress: Progress) -> dict[str, _Raw]:
    """The raw numbers of each kind that is there, by name, and of both kinds together where there are two."""
    step = params.step_mm
    points, offsets = evenly(hair.points_mm, hair.offsets, step, ends=True)
    sampled = _Sampled(points, offsets, np.repeat(np.arange(len(hair)), np.diff(offsets)), region.holds(points))
    radius = np.add.reduceat(hair.radius_mm.astype(float), hair.offsets[:-1]) / np.diff(hair.offsets)
    here = {name: hair.kind == kind for name, kind in kinds.items() if np.any(hair.kind == kind)}
    if both and len(here) > 1:
        here[both] = np.ones(len(hair), bool)
    group = hair.kind.astype(int)
    progress("statistics", 0, 4)
    planes = _planes(hair, group, region, params)
    progress("statistics", 1, 4)
    near = nearest_other(points, offsets, np.inf, asking=sampled.inside)
    progress("statistics", 2, 4)
    crowd = _crowd(sampled, radius, group, params)
    progress("statistics", 3, 4)
    clump, away = _clumps(sampled, radius, crowd, step, params), _flyaways(sampled, crowd.density, step, params)
    inside_mm = np.bincount(sampled.curve[sampled.inside], _shares(hair, sampled)[sampled.inside], len(hair))
    bent = bends(hair.points_mm, hair.offsets, params.bends)
    bent_curve, bent_inside = np.repeat(np.arange(len(hair)), np.diff(bent.offsets)), region.holds(bent.points_mm)
    raws = {}
    for name, members in here.items():
        groups = np.unique(group[members])
        mine = sampled.inside & members[sampled.curve]
        found = mine & (near.curve >= 0)
        sums = radius[sampled.curve[found]] + radius[near.curve[found]]
        fibers = members & (inside_mm > 0)
        along = bent_inside & members[bent_curve]
        samples = {
            "density_per_mm2": planes.density(groups),
            "density_at_fibers_per_mm2": crowd.density[mine],
            "nearest_mm": near.distance_mm[found],
            "nearest_radii": near.distance_mm[found] / sums,
            "nearest_deg": np.degrees(near.angle[found][np.isfinite(near.angle[found])]),
            "curvature_per_mm": bent.curvature_per_mm[along & np.isfinite(bent.curvature_per_mm)],
            "torsion_per_mm": bent.torsion_per_mm[along & np.isfinite(bent.torsion_per_mm)],
            "radius_mm": radius[sampled.curve[mine]],
        }
        counted = {
            "planes": planes.told(groups),
            "running_through_others": _mean(near.distance_mm[found] < params.touching * sums),
            "pair_correlation": planes.correlation(groups),
            "parallelism": _parallelism(crowd.angles[groups].sum(axis=0), params),
            "bending_enough_for_torsion": _mean(np.isfinite(bent.torsion_per_mm[along & _told_torsion(bent, params)])),
            "spectra": _spectra(bent, along, params),
            "clumps": _clump_numbers(clump[members & (inside_mm >= params.clump_mm)]),
            "flyaways": {"share_of_curves": _mean(away.curves[fibers]), "share_of_length": _mean(away.samples[mine])},
        }
        raws[name] = _Raw(int(fibers.sum()), float(inside_mm[members].sum()), samples, counted)
    progress("statistics", 4, 4)
    return raws


def _shares(hair: Strands, sampled: "_Sampled") -> np.ndarray:
    """Length (n,) mm that each sample stands for: half of the way to the one before and to the one after."""
    sizes = np.diff(sampled.offsets)
    share = np.repeat(lengths(hair.points_mm, hair.offsets) / (sizes - 1), sizes)
    share[sampled.offsets[:-1]] *= 0.5
    share[sampled.offsets[1:] - 1] *= 0.5
    return share


def _told_torsion(bent, params):
    """Samples (N,) bool so far from the ends of their curves that a torsion could be told."""
    sizes, half = np.diff(bent.offsets), round(params.bends.torsion_mm / params.bends.step_mm)
    number = np.arange(bent.offsets[-1]) - np.repeat(bent.offsets[:-1], sizes)
    return (number >= half) & (number < np.repeat(sizes, sizes) - half)


class _Sampled(NamedTuple):
    """Curves at an even arc length."""

    points: np.ndarray  # (n, 3)
    offsets: np.ndarray  # (M + 1,)
    curve: np.ndarray  # (n,)
    inside: np.ndarray  # (n,) bool: in the region


# ---- horizontal planes: density, pair correlation --------------------------------------------------------------------


@dataclass
class _Planes:
    """What was counted on horizontal planes, for each of the two kinds."""

    heights_mm: np.ndarray  # (H,)
    area_mm2: np.ndarray  # (H,) of the window
    crossings: np.ndarray  # (2, H)
    cells: np.ndarray  # (2, C) fibers per mm² in the squares of all planes
    cell_area_mm2: np.ndarray  # (C,)
    bin_mm: float
    pairs: np.ndarray  # (2, R) of a fiber of this kind and any other, by distance
    expected: np.ndarray  # (2, R) the same if they did not know of each other

    def density(self, groups) -> np.ndarray:
        return self.cells[groups].sum(axis=0)

    def told(self, groups) -> dict:
        area, count = self.area_mm2, self.crossings[groups].sum(axis=0)
        return {
            "mean_per_mm2": float(count.sum() / area.sum()) if area.sum() else None,
            "heights_mm": self.heights_mm.tolist(),
            "crossings": count.tolist(),
            "area_mm2": area.tolist(),
        }

    def correlation(self, groups) -> dict:
        pairs, expected = self.pairs[groups].sum(axis=0), self.expected[groups].sum(axis=0)
        return {
            "distance_mm": ((np.arange(len(pairs)) + 0.5) * self.bin_mm).tolist(),
            "g": [float(p / e) if e > 0 else None for p, e in zip(pairs, expected, strict=True)],
        }


def _planes(hair: Strands, group: np.ndarray, region: Region, params: StatisticsParams) -> _Planes:
    count = int(np.clip(round((region.high_mm - region.low_mm) / params.plane_mm), 1, _MOST_PLANES))
    step = max((region.high_mm - region.low_mm) / count, 1e-6)
    heights = region.low_mm + (np.arange(count) + 0.5) * step
    plane, place, curve = _crossings(hair, heights[0], step, count)
    edges = np.arange(round(params.reach_mm / params.bin_mm) + 1) * params.bin_mm
    area, crossings = np.zeros(count), np.zeros((2, count), int)
    pairs, expected = np.zeros((2, len(edges) - 1)), np.zeros((2, len(edges) - 1))
    cells, cell_areas = [np.zeros((2, 0))], [np.zeros(0)]
    for k in range(count):
        here = plane == k
        window = _Window.around(place[here], region, params)
        if window is None:
            continue
        inside = window.holds(place[here])
        at, kind = place[here][inside], group[curve[here][inside]]
        area[k] = window.area_mm2
        crossings[:, k] = np.bincount(kind, minlength=2)[:2]
        counts, areas = window.cells(at, kind, params.cell_mm)
        cells.append(counts / areas)
        cell_areas.append(areas)
        if len(at) < 2 or area[k] == 0:
            continue
        tree, chance = cKDTree(at), window.chance(edges) * (len(at) - 1) / area[k]
        for g in np.unique(kind):
            mine = at[kind == g]
            pairs[g] += np.diff(cKDTree(mine).count_neighbors(tree, edges))
            expected[g] += len(mine) / area[k] * chance
    return _Planes(heights, area, crossings, np.concatenate(cells, axis=1), np.concatenate(cell_areas), params.bin_mm, pairs, expected)


def _crossings(hair: Strands, first_mm: float, step_mm: float, count: int):
    """Plane (K,), place (K, 2) x, z and curve (K,) of each crossing of a curve and a horizontal plane."""
    points = np.asarray(hair.points_mm, float)
    level = (points[:, 1] - first_mm) / step_mm
    floor = np.floor(level).astype(np.int64)
    inner = np.ones(len(points), bool)
    inner[hair.offsets[1:] - 1] = False
    a = np.flatnonzero(inner & (np.concatenate([np.diff(floor), [0]]) != 0))
    low, high = np.minimum(floor[a], floor[a + 1]), np.maximum(floor[a], floor[a + 1])
    times = high - low
    segment = np.repeat(a, times)
    plane = np.repeat(low + 1, times) + np.arange(times.sum()) - np.repeat(np.cumsum(times) - times, times)
    share = ((plane - level[segment]) / (level[segment + 1] - level[segment]))[:, None]
    place = points[segment][:, [0, 2]] * (1 - share) + points[segment + 1][:, [0, 2]] * share
    curve = np.repeat(np.arange(len(hair)), np.diff(hair.offsets))[segment]
    good = (plane >= 0) & (plane < count)
    return plane[good], place[good], curve[good]


@dataclass
class _Window:
    """The part of a plane that belongs to the hair, as a picture of it."""

    low: np.ndarray  # (2,) mm: corner of pixel 0, 0
    pixel_mm: float
    mask: np.ndarray  # (w, h) bool

    @classmethod
    def around(cls, place: np.ndarray, region: Region, params: StatisticsParams) -> "_Window | None":
        """Places (K, 2) widened by gap_mm and narrowed again, but for half the spacing of fibers: what each has to its side. The spacing
        is that of the places in the window without that margin. None without places in the region."""
        off = np.hypot(*place.T)
        if not np.any(off <= region.radius_mm):
            return None
        place = place[off <= region.radius_mm + 2 * params.gap_mm]  # a hollow at the region's rim may have its other side outside
        pixel = max(0.1 * min(params.gap_mm, 1.0), float(np.ptp(place, axis=0).max()) / _WINDOW_PX)
        rim = params.gap_mm + 3 * pixel
        low = np.floor((place.min(axis=0) - rim) / pixel) * pixel
        shape = np.ceil((place.max(axis=0) + rim - low) / pixel).astype(int) + 1
        empty = np.ones(shape, bool)
        empty[tuple(((place - low) / pixel).astype(int).T)] = False
        far = distance_transform_edt(empty) * pixel > params.gap_mm
        depth = distance_transform_edt(~far) * pixel  # of what was widened, below its rim
        core = max(np.count_nonzero(depth > params.gap_mm - 0.5 * pixel) * pixel**2, len(place) * pixel**2)
        margin = min(0.5 * np.sqrt(core / len(place)), params.gap_mm)
        margin = min(0.5 * np.sqrt(np.count_nonzero(depth > params.gap_mm - margin) * pixel**2 / len(place)), params.gap_mm)
        mask = (depth > params.gap_mm - margin) | ~empty
        x, z = (low[k] + (np.arange(shape[k]) + 0.5) * pixel for k in range(2))
        return cls(low, pixel, mask & (np.hypot(x[:, None], z) <= region.radius_mm))

    @property
    def area_mm2(self) -> float:
        return float(np.count_nonzero(self.mask)) * self.pixel_mm**2

    def holds(self, place: np.ndarray) -> np.ndarray:
        """(K,) bool of places (K, 2)."""
        cell = ((place - self.low) / self.pixel_mm).astype(int)
        good = np.all((cell >= 0) & (cell < self.mask.shape), axis=1)
        return good & self.mask[tuple(np.where(good[:, None], cell, 0).T)]

    def cells(self, place: np.ndarray, kind: np.ndarray, edge_mm: float) -> tuple[np.ndarray, np.ndarray]:
        """Fibers (2, C) of each kind and area (C,) mm² of the squares of which the window holds at least half."""
        x, z = np.nonzero(self.mask)
        centre = self.low + (np.stack([x, z], axis=1) + 0.5) * self.pixel_mm
        square, number, size = np.unique(np.floor(centre / edge_mm).astype(int), axis=0, return_inverse=True, return_counts=True)
        of_pixel = np.full(self.mask.shape, -1)
        of_pixel[x, z] = number.ravel()
        mine = of_pixel[tuple(((place - self.low) / self.pixel_mm).astype(int).T)]
        counts = np.stack([np.bincount(mine[kind == g], minlength=len(square)) for g in (0, 1)])
        area = size * self.pixel_mm**2
        enough = area >= 0.5 * edge_mm**2
        return counts[:, enough].astype(float), area[enough]

    def chance(self, edges: np.ndarray) -> np.ndarray:
        """(R,) mm⁴: ∫ 2 π r γ(r) dr over each bin of distance, γ(r) the mean area that the window shares with itself moved by r (the set
        covariance, Stoyan and Stoyan 1994). Times two densities it is how many pairs independent places would make."""
        shape = [2 * n for n in self.mask.shape]
        image = rfft2(self.mask.astype(np.float32), shape, workers=-1)
        shared = irfft2(image * np.conj(image), shape, workers=-1)
        reach = min(int(np.ceil(edges[-1] / self.pixel_mm)) + 2, min(self.mask.shape))
        lag = np.arange(-reach, reach + 1)
        distance = np.hypot(lag[:, None], lag).ravel()
        ring = np.rint(distance).astype(int)
        mean = np.bincount(ring, shared[lag[:, None], lag].ravel()) / np.bincount(ring)
        at = np.bincount(ring, distance) / np.bincount(ring)
        r = 0.5 * (edges[1:] + edges[:-1])
        return np.interp(r / self.pixel_mm, at, mean) * self.pixel_mm**2 * np.pi * (edges[1:] ** 2 - edges[:-1] ** 2)


# ---- neighbours of fibers: parallelism, density, clumps, flyaways ----------------------------------------------------


class _Crowd(NamedTuple):
    """What was counted of all neighbours within reach."""

    density: np.ndarray  # (n,) fibers per mm² at each sample in the region
    angles: np.ndarray  # (2, R, A) pairs by kind of the fiber, distance and angle
    bound: np.ndarray  # (K, 3) int: two curves, and the samples of the first that lie in a clump with the second


def _crowd(sampled: _Sampled, radius: np.ndarray, group: np.ndarray, params: StatisticsParams) -> _Crowd:
    """A curve passes within R of a point with the chance ρ π R², whatever its direction, where ρ is the length of hair per volume; so the
    number of those that do tells ρ: the fibers per mm² across the hair."""
    far = max(params.reach_mm, params.around_mm, 2 * params.clump_radii * radius.max(initial=0.0))
    bins = round(params.reach_mm / params.bin_mm)
    density = np.zeros(len(sampled.points))
    angles = np.zeros((2, bins, _ANGLES), np.int64)
    couples, times = np.zeros(0, np.int64), np.zeros(0)
    for pairs in pairs_in_turn(sampled.points, sampled.offsets, far, asking=sampled.inside):
        density += np.bincount(pairs.point[pairs.distance_mm <= params.around_mm], minlength=len(density))
        pairs = Pairs(*(array[np.isfinite(pairs.angle)] for array in pairs))
        own = sampled.curve[pairs.point]
        place = (pairs.distance_mm / params.bin_mm).astype(int)
        told = place < bins
        turn = np.minimum(pairs.angle / (0.5 * np.pi) * _ANGLES, _ANGLES - 1).astype(int)
        number = (group[own[told]] * bins + place[told]) * _ANGLES + turn[told]
        angles += np.bincount(number, minlength=angles.size).reshape(angles.shape)
        touch = params.clump_radii * (radius[own] + radius[pairs.curve])
        near = (pairs.distance_mm <= touch) & (pairs.angle <= np.radians(params.clump_deg))
        couples, place = np.unique(np.concatenate([couples, own[near] * len(group) + pairs.curve[near]]), return_inverse=True)
        times = np.bincount(place, np.concatenate([times, np.ones(np.count_nonzero(near))]), len(couples))
    bound = np.stack([couples // max(len(group), 1), couples % max(len(group), 1), times.astype(np.int64)], axis=1)
    return _Crowd(density / (np.pi * params.around_mm**2), angles, bound)


def _parallelism(angles: np.ndarray, params: StatisticsParams) -> dict:
    """Quartiles of the angle between neighbours by their distance, of counts (R, A)."""
    edges = np.linspace(0, 90, _ANGLES + 1)
    quartiles = {"p25_deg": 0.25, "median_deg": 0.5, "p75_deg": 0.75}
    told = {name: [] for name in quartiles}
    for counts in angles:
        total = np.concatenate([[0], np.cumsum(counts)])
        for name, share in quartiles.items():
            told[name].append(float(np.interp(share * total[-1], total, edges)) if total[-1] >= 10 else None)
    return {"distance_mm": ((np.arange(len(angles)) + 0.5) * params.bin_mm).tolist()} | told


def _clumps(sampled: _Sampled, radius: np.ndarray, crowd: _Crowd, step: float, params: StatisticsParams) -> np.ndarray:
    """Size (M,) of the clump of each curve, 1 where it is on its own."""
    count = len(radius)
    length = np.bincount(sampled.curve[sampled.inside], minlength=count)
    first, second, near = crowd.bound.T
    together = near >= np.maximum(params.clump_share * np.minimum(length[first], length[second]), params.clump_mm / step)
    graph = coo_array((np.ones(together.sum(), bool), (first[together], second[together])), shape=(count, count))
    clump = connected_components(graph, directed=False)[1] if count else np.zeros(0, int)
    return np.bincount(clump, length > 0, minlength=1)[clump].astype(int) if count else clump


class _Away(NamedTuple):
    curves: np.ndarray  # (M,) bool: flyaways
    samples: np.ndarray  # (n,) bool: where a curve has left the others


def _flyaways(sampled: _Sampled, density: np.ndarray, step: float, params: StatisticsParams) -> _Away:
    inside = sampled.inside
    lonely = inside & (density < params.flyaway_density * np.median(density[inside])) if inside.any() else inside
    starts = np.flatnonzero(np.diff(sampled.curve, prepend=-1) != 0) if len(inside) else np.zeros(0, int)
    breaks = np.unique(np.concatenate([starts, np.flatnonzero(np.diff(lonely.astype(int), prepend=0) != 0), [len(lonely)]]))
    low, size = breaks[:-1], np.diff(breaks)
    count = len(sampled.offsets) - 1
    length = np.bincount(sampled.curve[inside], minlength=count)
    runs = lonely[low] & (size >= np.minimum(params.flyaway_mm / step, np.maximum(0.5 * length[sampled.curve[low]], 1))) if len(low) else low > 0
    curves = np.zeros(count, bool)
    curves[sampled.curve[low[runs]]] = True
    return _Away(curves, lonely)


def _clump_numbers(size: np.ndarray) -> dict:
    """size (F,): that of the clump of each fiber."""
    place = np.searchsorted(CLUMP_CLASSES, size, side="right") - 1
    return {
        "curves": len(size),
        "share_in_clumps": _mean(size >= 3),
        "median_size": float(np.median(size)) if len(size) else None,
        "largest": int(size.max(initial=0)),
        "size_from": list(CLUMP_CLASSES),
        "share": (np.bincount(place, minlength=len(CLUMP_CLASSES)) / max(len(size), 1)).tolist(),
    }


# ---- spectra ---------------------------------------------------------------------------------------------------------


def _spectra(bent, along: np.ndarray, params: StatisticsParams) -> dict:
    """Those of the bend and of the torsion; the torsion fades to 0 where the curve hardly bends, so that it can be told everywhere."""
    least, step = params.bends.least_per_mm, params.bends.step_mm
    square = np.nan_to_num(bent.curvature_per_mm) ** 2
    faded = np.where(_told_torsion(bent, params), np.nan_to_num(bent.torsion_per_mm) * square / (square + least**2), np.nan)
    return {
        "curvature": _spectrum_numbers(spectrum(bent.bend_per_mm, bent.offsets, step, params.segment_mm, along), 2 * params.bends.curvature_mm),
        "torsion": _spectrum_numbers(spectrum(faded, bent.offsets, step, params.segment_mm, along), 2 * params.bends.torsion_mm),
    }


def _spectrum_numbers(found: Spectrum, shortest_mm: float) -> dict:
    """Of the wavelengths that the smoothing leaves."""
    kept = found.wavelength_mm >= shortest_mm - 1e-9
    cut = Spectrum(found.wavelength_mm[kept], found.right[kept], found.left[kept], found.segments)
    total = float(cut.power.sum())
    return {
        "wavelength_mm": cut.wavelength_mm.tolist(),
        "power": [_number(value) for value in cut.power],
        "right_handed": float(cut.right.sum() / total) if total > 0 else None,
        "peak_mm": _number(cut.peak_mm),
        "segments": cut.segments,
    }


# ---- told by a few numbers -------------------------------------------------------------------------------------------


def _told(raws: dict[str, _Raw]) -> dict:
    """Each set by percentiles, and histograms whose bins are the same for all sets."""
    names = next(iter(raws.values())).samples
    edges = {name: _edges([raw.samples[name] for raw in raws.values()], name) for name in names}
    sets = {}
    for name, raw in raws.items():
        told = {key: _percentiles(values) | _histogram(values, edges[key]) for key, values in raw.samples.items()}
        sets[name] = {"curves": raw.curves, "length_mm": raw.length_mm} | told | raw.counted
    return sets


def _edges(sets: list[np.ndarray], name: str) -> np.ndarray:
    """From 0, or for the torsion from as far below, to what 99 % of every set stay below; radii from the least to the greatest."""
    filled = [values for values in sets if len(values)] or [np.ones(1)]
    if name == "radius_mm":
        low, high = min(v.min() for v in filled), max(v.max() for v in filled)
        return np.linspace(low - 1e-4, high + 1e-4, _HISTOGRAM_BINS // 2 + 1)
    high = max(max(float(np.percentile(np.abs(values), 98 if name == "torsion_per_mm" else 99)) for values in filled), 1e-6)
    if name == "density_per_mm2":  # of whole fibers in a square: finer bins would show that
        return np.arange(0.0, max(high, 3.0) + 1.0, max(1.0, round(high / 24))) - 0.5
    return np.linspace(-high if name == "torsion_per_mm" else 0.0, high, _HISTOGRAM_BINS + 1)


def _percentiles(values: np.ndarray) -> dict:
    names = {"p5": 5, "p25": 25, "median": 50, "p75": 75, "p95": 95}
    if not len(values):
        return {"samples": 0, "mean": None} | dict.fromkeys(names)
    return {"samples": len(values), "mean": float(values.mean())} | {name: float(np.percentile(values, p)) for name, p in names.items()}


def _histogram(values: np.ndarray, edges: np.ndarray) -> dict:
    """Share of the samples per unit; what lies beyond the last edge is missing from the sum."""
    counts = np.histogram(values, edges)[0]
    return {"edges": edges.tolist(), "share_per_unit": (counts / (max(len(values), 1) * np.diff(edges))).tolist()}


def _mean(values: np.ndarray) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def describe(report: dict, beside: str | None = None) -> list[tuple[str, str]]:
    """The numbers of ``side_by_side`` as rows (name, values side by side) for people; beside: what the other hair is called."""
    sets = report["sets"]

    def row(name, form):
        cells = []
        for numbers in sets.values():
            try:
                cells.append(form(numbers))
            except TypeError:  # None: there is no such number
                cells.append("-")
        return name, cells

    def spread(key, digits, unit=""):
        return lambda s: f"{s[key]['median']:.{digits}f} ({s[key]['p5']:.{digits}f} to {s[key]['p95']:.{digits}f}){unit}"

    def share(value):
        return f"{100 * value:.1f} %"

    def wavelength(s):
        peak = s["spectra"]["curvature"]["peak_mm"]
        return f"{peak:.1f} mm{' or longer' if peak >= 0.99 * report['parameters']['segment_mm'] else ''}"

    rows = [
        ("", [beside or name if name == BESIDE_NAME else name for name in sets]),
        row("curves", lambda s: f"{s['curves']}, {s['length_mm']:.0f} mm"),
        row("density, fibers per mm²", lambda s: f"{s['planes']['mean_per_mm2']:.2f}"),
        row("… in squares", spread("density_per_mm2", 1)),
        row("… around a fiber", spread("density_at_fibers_per_mm2", 1)),
        row("nearest neighbour, mm", spread("nearest_mm", 3)),
        row("… in sums of radii", spread("nearest_radii", 1)),
        row("… its angle, °", spread("nearest_deg", 1)),
        row("running through another", lambda s: share(s["running_through_others"])),
        row("curvature, 1/mm", spread("curvature_per_mm", 3)),
        row("… strongest wavelength", wavelength),
        row("torsion, rad/mm", spread("torsion_per_mm", 2)),
        row("in clumps of 3 or more", lambda s: f"{share(s['clumps']['share_in_clumps'])}, at most {s['clumps']['largest']}"),
        row("flyaways", lambda s: f"{share(s['flyaways']['share_of_curves'])}, {share(s['flyaways']['share_of_length'])} of length"),
        row(
            "radius, µm", lambda s: f"{1000 * s['radius_mm']['median']:.1f} ({1000 * s['radius_mm']['p5']:.1f} to {1000 * s['radius_mm']['p95']:.1f})"
        ),
    ]
    widths = [max(len(cells[k]) for _, cells in rows) + 2 for k in range(len(sets))]
    return [(name, "".join(f"{cell:<{width}}" for cell, width in zip(cells, widths, strict=True)).rstrip()) for name, cells in rows]
