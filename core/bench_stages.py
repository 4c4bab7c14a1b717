"""The contests of ``bench``: of each stage ours, and what a user would take otherwise, on the same input."""

import importlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numba import njit
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import cg

from .bench_clock import Check, Contest, Least, Way
from .bench_inputs import BenchParams, Ring, mosaic, plane, ring, surface_directions, write_lossless_dng
from .features import ANGLE_STEPS, Index, KdTree, box_query, pack, pixels, unpack
from .geometry import slope, turn, turn_back
from .grow import GrowParams, box_of
from .laplace import KNOWN, OUTSIDE, UNKNOWN, laplace_fill
from .look import BOW, GATE, Box, fit, look, new_view, unit
from .raw import read_planes
from .ridges import BINS, RidgeParams, Ridges, Strokes, detect, estimate, gabor_bank, strokes
from .simulate import BLACK, WHITE

NO_OPENCV = "OpenCV is not installed, so it was left out; to compare with it, run: pip install opencv-python-headless"
BIN_DEG = 180 / BINS
UPRIGHT_DEG = 8.0  # hairs that one filter for upright ones should see
SCALES_PX = (1.0,)  # of sato: one, which suits hair 3 px wide; each more takes as long again
TESTED = 50  # places at which features are compared
FLOPS_A_HIT = 170  # to place a feature (26) and to add it to the sums of ``fit`` (36) four times
BYTES_A_FEATURE = 8


def contests_of(stage: str, params: BenchParams, folder: Path) -> tuple[list[Contest], list[str]]:
    """The contests of one of STAGES, and what was left out of them for want of a library. Files go to ``folder``."""
    make = {"ridges": _ridges, "decode": _decode, "growing": _growing, "directions": _directions, "index": _index}[stage]
    return make(params, folder)


def library(module: str):
    """A library that only this program needs, or None where it is not installed."""
    try:
        return importlib.import_module(module)
    except ImportError:
        return None


# ---- ridges ----------------------------------------------------------------------------------------------------------


def _ridges(params: BenchParams, _folder: Path) -> tuple[list[Contest], list[str]]:
    from skimage.filters import gabor, sato

    photograph, cv2 = plane(params.rows, params.columns, params.seed), library("cv2")
    ours, papers = (estimate([photograph], RidgeParams(operator=operator, reduce=1)) for operator in ("oriented", "paper"))
    what = f"a photograph of {params.columns} x {params.rows} pixels to ridges"
    others = [
        Way("scikit-image, sato", partial(sato, photograph, sigmas=SCALES_PX, black_ridges=False), partial(_bright_at_ridges, "sato")),
        Way(
            "scikit-image, gabor, 1 of 32",
            lambda: gabor(photograph, frequency=1 / 3, theta=0, sigma_x=1, sigma_y=1)[0],
            _bright_at_upright,
        ),
    ]
    if cv2:
        others.insert(0, Way("OpenCV, 32 filters", partial(_opencv_bank, cv2, photograph, gabor_bank()), _same_angles))
    note = "The others give a response a pixel and no ridges: no maxima, no runs, no place below a pixel. The photograph's offset is known."
    contests = [
        Contest("ridges", what, Way("ours", partial(detect, photograph, ours)), others, _stroked(photograph, strokes(ours.across_px)), notes=[note])
    ]
    if cv2:
        same_bins = Way("OpenCV, 32 filters", partial(_opencv_bank, cv2, photograph, gabor_bank()), _same_bins)
        way = Way("ours, operator of the paper", partial(detect, photograph, papers))
        contests.append(Contest("ridges", f"{what}, by the paper's filters", way, [same_bins], _bounded(photograph)))
    return contests, [] if cv2 else [NO_OPENCV]


def _bounded(photograph: np.ndarray) -> Least:
    """What the paper's operator takes at every pixel: two passes of a blur of nine pixels (13 each), and the bound on its peak (about 60)."""
    return Least(4 * photograph.nbytes, 86.0 * photograph.size, "a blur and a bound at every pixel")


def _stroked(photograph: np.ndarray, marks: Strokes) -> Least:
    """What the strokes at every pixel take: second differences across four axes, averaged along them (45), and of each stroke a
    product and a maximum, and three more for each pair of places."""
    flops = 45 + 2 * len(marks.axis) + 3 * np.count_nonzero(marks.weight[:, 1:])
    return Least(5 * photograph.nbytes, float(photograph.size * flops), f"{len(marks.axis)} strokes at every pixel")


def _opencv_bank(cv2, photograph: np.ndarray, bank: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Blur, 32 filters, and at every pixel the strongest: its number (H, W) uint8 and its answer (H, W) float32."""
    blurred = cv2.GaussianBlur(photograph, (9, 9), 1.0, borderType=cv2.BORDER_REFLECT)
    best, number = cv2.filter2D(blurred, cv2.CV_32F, bank[0]), np.zeros(photograph.shape, np.uint8)
    for k in range(1, len(bank)):
        answer = cv2.filter2D(blurred, cv2.CV_32F, bank[k])
        stronger = cv2.compare(answer, best, cv2.CMP_GT)
        cv2.copyTo(answer, stronger, best)
        cv2.copyTo(np.full(photograph.shape, k, np.uint8), stronger, number)
    return number, best


def _at(found: Ridges) -> tuple[np.ndarray, np.ndarray]:
    return np.rint(found.row).astype(int), np.rint(found.col).astype(int)


def _same_angles(found: Ridges, theirs) -> list[Check]:
    off = np.degrees(found.angle) - theirs[0][_at(found)] * BIN_DEG
    off = np.abs((off + 90) % 180 - 90)
    return [Check(f"angle at {len(off)} ridges, median", float(np.median(off)), BIN_DEG, "deg")]


def _same_bins(found: Ridges, theirs) -> list[Check]:
    """The strongest filter is the same, but where two answer alike."""
    bins = np.rint(np.degrees(found.angle) / BIN_DEG).astype(int) % BINS
    off = (bins - theirs[0][_at(found)] + BINS // 2) % BINS - BINS // 2
    return [Check(f"share of {len(off)} ridges whose strongest filter is another", float(np.mean(off != 0)), 0.02)]


def _bright_at_ridges(what: str, found: Ridges, answer: np.ndarray) -> list[Check]:
    """Another filter answers where ours finds ridges: hardly one of these is in the darker half of its picture."""
    share = float(np.mean(answer[_at(found)] < np.median(answer)))
    return [Check(f"share of {len(found.col)} ridges where {what} answers less than its median", share, 0.05)]


def _bright_at_upright(found: Ridges, answer: np.ndarray) -> list[Check]:
    upright = np.abs(np.degrees(found.angle) - 90) < UPRIGHT_DEG
    return _bright_at_ridges("gabor", Ridges(*(a[upright] for a in vars(found).values())), answer)


# ---- decoding --------------------------------------------------------------------------------------------------------


def _decode(params: BenchParams, folder: Path) -> tuple[list[Contest], list[str]]:
    path, pixels_of = folder / "photograph.dng", mosaic(params.rows, params.columns, params.seed)
    size = write_lossless_dng(path, pixels_of)
    written = plane(params.rows, params.columns, params.seed)
    what = f"a lossless-JPEG DNG of {pixels_of.size / 1e6:.1f} million pixels, {size / 1e6:.1f} MB, to its red plane"
    ours = Way("ours", lambda: read_planes(path, "R")[0], lambda found, _: [_equal("red plane and what was written", found, written)])
    theirs = Way("LibRaw (rawpy)", partial(_libraw, path), lambda found, other: [_equal("red planes", found, other)])
    return [Contest("decode", what, ours, [theirs], Least(size + written.nbytes, 0.0, "the file and the plane"))], []


def _libraw(path: Path) -> np.ndarray:
    """The red plane (H, W) float32, as a user of rawpy reads it."""
    import rawpy

    with rawpy.imread(str(path)) as photograph:
        red = photograph.raw_image_visible[::2, ::2]
        return (red.astype(np.float32) - np.float32(BLACK)) / np.float32(WHITE - BLACK)


def _equal(what: str, a: np.ndarray, b: np.ndarray) -> Check:
    apart = float(np.abs(a - b).max()) if a.shape == b.shape else np.inf
    return Check(f"largest difference of {what}", apart, 0.0)


# ---- growing ---------------------------------------------------------------------------------------------------------


def _growing(params: BenchParams, _folder: Path) -> tuple[list[Contest], list[str]]:
    lock = ring(params.ring)
    box = box_of(GrowParams(), lock.index)
    trees = [KdTree(sweep, lock.optics) for sweep in lock.sweeps]
    angles = [sweep.angle * (np.pi / ANGLE_STEPS) for sweep in lock.sweeps]
    turns = [(np.cos(t), np.sin(t)) for t in np.radians([sweep.angle_deg for sweep in lock.sweeps])]
    hits = _found_by_ours(lock.index, lock.points_mm, lock.ways, box)
    count, many, cameras = len(lock.points_mm), len(lock.index.col), len(lock.sweeps)

    def theirs():
        return np.array([_plain_step(trees, angles, turns, lock, p, g, box)[0] for p, g in zip(lock.points_mm, lock.ways, strict=True)])

    def compare(found, other):
        plainly = [np.concatenate(_plain_step(trees, angles, turns, lock, p, g, box)[1]) for p, g in _first(lock)]
        turned = _between_deg(found, other)
        return [
            _found_alike(hits, plainly),
            Check(f"directions, median ({_truths(lock, found, other)})", float(np.median(turned)), 1.0, "deg"),
        ]

    least = len(np.concatenate(hits)) / len(hits) * count
    why = f"the {least / count:.0f} features in its boxes"
    what = f"one step of growing, {cameras} cameras, {many / 1e6:.1f} million features ({count} steps a round)"
    ours = Way("ours", partial(_steps, lock.index, lock.points_mm, lock.ways, box))
    others = [Way("scipy cKDTree and numpy", theirs, compare)]
    notes = ["Ours fits place, direction and curvature to all features, three times over; the other solves for the direction alone, once."]
    return [Contest("growing", what, ours, others, Least(BYTES_A_FEATURE * least, FLOPS_A_HIT * least, why), count, notes)], []


def _first(lock: Ring):
    return zip(lock.points_mm[:TESTED], lock.ways[:TESTED], strict=True)


@njit(nogil=True)  # not cached: a stale one would measure a kernel of yesterday
def _steps(index, points, ways, box):
    """One look and one fit at each place (n, 3): the directions (n, 3) that are found."""
    view, found = new_view(len(index.cos)), np.empty_like(ways)
    for i in range(len(points)):
        look(index, points[i], ways[i], np.zeros(3), box, view)
        _, _, _, way, _ = fit(view, index.around, ways[i], box, 1.0, box.prior)
        found[i] = unit(ways[i] + way)
    return found


def _found_by_ours(index: Index, points: np.ndarray, ways: np.ndarray, box: Box) -> list[np.ndarray]:
    """Features that ``look`` takes at the first TESTED places, of all cameras."""
    view, found = new_view(len(index.cos)), []
    for p, g in zip(points[:TESTED], ways[:TESTED], strict=True):
        look(index, p, g, np.zeros(3), box, view)
        found.append(view.hits.number[: view.ends[-1]].copy())
    return found


def _plain_step(trees: Sequence[KdTree], angles, turns, lock: Ring, p: np.ndarray, g: np.ndarray, box: Box):
    """Figure 7 with scipy and numpy: the direction (3,) that is perpendicular to the mean normals of all cameras, weighted as ours, and
    the features (n,) that each has in the box. In the box is what lies there and is turned like the hair."""
    half = np.array([box.half[0], box.deep, box.half[2]])
    reach, normals, found = np.linalg.norm(half), [], []
    for k, (tree, angle, (cos, sin)) in enumerate(zip(trees, angles, turns, strict=True)):
        (pu, pv, _), (gu, gv, gw) = turn(*p, cos, sin), turn(*g, cos, sin)
        su, sv, _ = slope(pu, pv, lock.optics.working_distance_mm)
        s = np.array(turn_back(su, sv, 1.0, cos, sin))
        across = s - (s @ g) * g
        across /= np.linalg.norm(across)
        axes = np.stack([g, across, np.cross(g, across)])
        near = np.array(tree.tree.query_ball_point(p, reach), np.int64)
        placed = (tree.points_mm[near] - p) @ axes.T
        inside = np.all(np.abs(placed) <= half, axis=1)
        near, placed = near[inside], placed[inside]
        expected = np.arctan2(gv - sv * gw, gu - su * gw)
        off = angle[near] - expected
        off -= np.pi * np.round(off / np.pi)
        like = np.abs(off) <= GATE * box.sigma_angle
        found.append(near[like] + lock.index.first[k])
        weight = _near(off, box.sigma_angle) * _near(placed[:, 1], box.sigma_focus) * _near(placed[:, 2], box.sigma)
        if weight[like].sum() > 0:
            turned = expected + np.average(off[like], weights=weight[like])
            ou, ov = np.cos(turned), np.sin(turned)
            normal = np.array(turn_back(ov, -ou, ou * sv - ov * su, cos, sin))
            normals.append(normal * (np.sqrt(weight[like].sum()) / np.linalg.norm(normal)))
    if len(normals) < 2:
        return g, found
    way = np.linalg.svd(np.array(normals))[2][2]
    return (way if way @ g > 0 else -way), found


def _near(off: np.ndarray, sigma: float) -> np.ndarray:
    """Weights as ``look`` and ``fit`` give them, about those of a Gaussian."""
    return np.maximum(1 - BOW * (off / sigma) ** 2, 0) ** 2


def _found_alike(found: Sequence[np.ndarray], other: Sequence[np.ndarray]) -> Check:
    """Numbers of features that two ways find in the same boxes; a feature on the wall of one may be in or out."""
    apart = sum(len(np.setxor1d(a, b)) for a, b in zip(found, other, strict=True))
    there = sum(len(np.union1d(a, b)) for a, b in zip(found, other, strict=True))
    return Check(f"share of {there} features in {len(found)} boxes that only one finds", apart / max(there, 1), 0.002)


def _between_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip(np.sum(a * b, axis=1), -1, 1)))


def _truths(lock: Ring, found: np.ndarray, other: np.ndarray) -> str:
    ours, theirs = (np.median(_between_deg(a, lock.true_ways)) for a in (found, other))
    return f"from the true ones ours is {ours:.2g}, the other {theirs:.2g}"


# ---- directions ------------------------------------------------------------------------------------------------------


def _directions(params: BenchParams, _folder: Path) -> tuple[list[Contest], list[str]]:
    values, kinds = surface_directions(params.grid, params.seed)
    unknown = kinds == UNKNOWN
    matrix, right = laplace_system(values, kinds)
    filled = laplace_fill(values, kinds, params.cycles, 0.0)
    residual = right - matrix @ filled[unknown].astype(np.float64)
    wanted = np.linalg.norm(residual, axis=0)
    single, right_single = matrix.astype(np.float32), right.astype(np.float32)
    inverse = diags_array((1.0 / matrix.diagonal()).astype(np.float32), format="csr")

    def theirs():
        parts = [cg(single, right_single[:, c], rtol=0.0, atol=wanted[c], M=inverse, maxiter=20000)[0] for c in range(3)]
        return np.stack(parts, -1)

    def compare(ours, other):
        size = np.linalg.norm(right - matrix @ other.astype(np.float64)) / np.linalg.norm(wanted)
        off = np.sqrt(np.mean(np.sum((ours[unknown] - other) ** 2, axis=1)))
        return [
            Check("residual of the other in parts of ours", float(size), 1.5),
            Check("fields, root mean square, of directions 1 long", float(off), 0.01),
        ]

    cells = int(unknown.sum())
    worked = 3 * cells * 8 / 7  # coarser grids have an eighth each
    moved = (4 * 13 + 105 * params.cycles) * worked  # sweeps before; in each cycle two, what is between grids, and the gradients
    what = f"Laplace's equation in {cells / 1e6:.2g} million of {'x'.join(map(str, params.grid))} cells, 3 components, to the same residual"
    least = Least(moved, (4 * 8 + 50 * params.cycles) * worked, f"{moved / (3 * cells):.0f} bytes a cell and component")
    relative = np.linalg.norm(wanted) / np.linalg.norm(right)
    notes = [f"Both stop at {relative:.1e} of the right-hand side. Making the matrix is not counted; ours needs none."]
    ours = Way("ours, gradients with multigrid", lambda: laplace_fill(values, kinds, params.cycles, 0.0))
    return [Contest("directions", what, ours, [Way("scipy cg, Jacobi, float32", theirs, compare)], least, notes=notes)], []


def laplace_system(values: np.ndarray, kinds: np.ndarray):
    """The equations that ``laplace_fill`` solves, of the n UNKNOWN cells: a sparse (n, n) matrix and right-hand sides (n, c) float64."""
    number = np.full(kinds.shape, -1)
    unknown = kinds == UNKNOWN
    number[unknown] = np.arange(np.count_nonzero(unknown))
    rows, cols, count, right = [], [], np.zeros(kinds.shape), np.zeros(values.shape)
    for axis in range(3):
        low, high = (tuple(slice(*cut) if a == axis else slice(None) for a in range(3)) for cut in ((0, -1), (1, None)))
        for here, there in ((low, high), (high, low)):
            count[here] += kinds[there] != OUTSIDE
            right[here] += np.where((kinds[there] == KNOWN)[..., None], values[there], 0)
            both = unknown[here] & unknown[there]
            rows.append(number[here][both])
            cols.append(number[there][both])
    rows, cols, size = np.concatenate(rows), np.concatenate(cols), np.count_nonzero(unknown)
    off = coo_array((np.full(len(rows), -1.0), (rows.astype(np.int32), cols.astype(np.int32))), (size, size)).tocsr()
    return (diags_array(count[unknown], format="csr") + off).tocsr(), right[unknown]


# ---- the index -------------------------------------------------------------------------------------------------------


def _index(params: BenchParams, _folder: Path) -> tuple[list[Contest], list[str]]:
    lock = ring(params.ring)
    sweep, box = lock.sweeps[0], box_of(GrowParams(), lock.index)
    photographs, tree = _photographs(sweep), KdTree(sweep, lock.optics)
    extents = 2 * np.array([box.half[0], box.deep, box.half[2]])
    axes = [_axes(g) for g in lock.ways]

    def same_features(found, _other):
        points = np.stack(unpack(found, lock.optics))
        return [Check("features in order", float(np.abs(points - np.stack(unpack(sweep, lock.optics))).max()), 2e-3)]

    def query(one):
        return [one(p, a, extents) for p, a in zip(lock.points_mm, axes, strict=True)]

    many = len(sweep)
    building = Contest(
        "index",
        f"sorting the {many / 1e6:.2g} million features of a sweep",
        Way("ours, cells", lambda: pack(sweep.angle_deg, sweep.positions_mm, sweep.shape, photographs), lambda found, _: same_features(found, None)),
        [Way("scipy cKDTree", lambda: KdTree(sweep, lock.optics))],
        Least(many * (20 + BYTES_A_FEATURE + 1), 0.0, "ridges read, features written"),
    )
    looking = Contest(
        "index",
        f"one oriented box of one sweep ({len(axes)} boxes a round)",
        Way("ours, box_query", lambda: query(partial(box_query, lock.index, 0))),
        [Way("scipy cKDTree, box_query", lambda: query(tree.box_query), lambda found, other: [_found_alike(found, other)])],
        Least(BYTES_A_FEATURE * sum(map(len, query(tree.box_query))), 0.0, "the features in the box"),
        len(axes),
        ["Both are called from Python, a box at a time; growing calls its kernel for all cameras at once."],
    )
    return [building, looking], []


def _photographs(sweep) -> list[Ridges]:
    """The ridges of each photograph of a sweep that was packed."""
    col, row = pixels(sweep)
    told = col, row, sweep.angle * (np.pi / ANGLE_STEPS), np.full(len(col), 0.1), np.zeros(len(col))
    order = np.argsort(sweep.frame, kind="stable")
    parts = np.split(order, np.searchsorted(sweep.frame[order], np.arange(1, len(sweep.positions_mm))))
    return [Ridges(*(np.float32(a[part]) for a in told)) for part in parts]


def _axes(g: np.ndarray) -> np.ndarray:
    """Unit rows (3, 3), g the first."""
    s = np.cross(g, [1.0, 0.0, 0.0])
    s /= np.linalg.norm(s)
    return np.stack([g, s, np.cross(g, s)])
