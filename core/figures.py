"""Pictures of a capture and of what was found in it: the data figures of the paper (2b, 2c, 3, 5, 6, 9, 10, 14), for any capture.

They show where errors come from: ridges that were missed, places that are off, depth, neighbours taken for one hair, ends
that came too early. All look at one place, by default at mid height amid hair that was found with much evidence.

In every picture a colour is an angle of the turntable, light adds up where features lie on each other, and an open circle
is a curve that was found.
"""

import colorsys
import html
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numba import njit
from scipy import ndimage
from scipy.spatial import cKDTree

from .capture import FILE_NAME, Capture, load_capture
from .compare import SEEN, SEEN_ANGLES, Truth, choose_shot, load_truth, overlay, score
from .errors import StrandscopeError
from .features import SweepFeatures, unpack
from .files import atomic
from .geometry import camera_points, object_points, to_image, to_pixel
from .grid import Grid
from .groom import Groom
from .hull import carved_inside, grid_of, hull_inside, occupancy
from .pipeline import Parameters, find_features, has_work_folder, kept_volume, made_with, make_volume, preset, reconstruct, resolve, work_folder
from .progress import Progress, silent
from .ridges import BINS, RidgeParams, detect, gabor_bank, line_banks, response
from .simulate import LOOKS, density, drawing, lens, photograph, prepare, shade
from .strands import INFILL, Strands, lengths, load_strands, offsets_of
from .volume import Volume

NAMES = {  # number in the paper -> file
    "2b": "figure_2b_row", "2c": "figure_2c_star", "3": "figure_3_ribbons", "5": "figure_5_filters", "6": "figure_6_fiber",
    "9": "figure_9_hull", "10": "figure_10_hair", "14": "figure_14_overlay", "recall": "recall",
}  # fmt: skip
DPI = 150
ALONG_DEPTH = np.array([[[1.0], [0.0]]])  # of the two sides of a patch, only the first
MANY_BYTES = 800_000
PAPER, INK, FAINT = "#181818", "#dcdcdc", "#8a8a8a"
FOUND, MISSED, ACCENT, TRUE = "#ffffff", "#ff4d4d", "#ff9a1f", "#5ad1ff"
METHODS = (ACCENT, TRUE, "#8fd14f", "#d58cff")
STYLE = {
    "figure.facecolor": PAPER, "savefig.facecolor": PAPER, "axes.facecolor": "#000000", "text.color": INK, "axes.labelcolor": INK,
    "axes.edgecolor": FAINT, "xtick.color": FAINT, "ytick.color": FAINT, "xtick.labelcolor": INK, "ytick.labelcolor": INK,
    "axes.linewidth": 0.6, "xtick.major.width": 0.6, "ytick.major.width": 0.6, "font.family": "DejaVu Sans", "font.size": 9,
    "axes.titlesize": 10, "axes.titlelocation": "left", "legend.frameon": False, "legend.fontsize": 8.5,
}  # fmt: skip
BAND_MM = 1.5  # features this far above and below the place are kept
NEAR_MM = 0.1  # a curve and a true fiber this near in a slice are the same hair
CROWD, CROWD_MM = 7, 1.0  # the place is chosen to have about so many curves this near: not one alone, nor more than can be told apart
AZIMUTH_DEG, ELEVATION_DEG = -55.0, 25.0  # of oblique views, the first from the chosen sweep's camera
STEEP_DEG = 40.0  # elevation from which the ribbons of one hair are told apart
OWN_MM, DEPTH_MM = 0.06, 0.6  # features this near to a curve, across and in depth, are of its own ribbons
HAIR_PX = 1000  # height of a drawing of the hair
HULL_AZIMUTH_DEG = 30.0
INFILL_TINT = np.array([0.45, 0.8, 1.6])
LENS_POINTS = 32  # from which it is drawn, each shifted below a pixel


@dataclass(frozen=True)
class FigureParams:
    """What the pictures look at; at most one of the first three is given. Lengths in mm."""

    at_mm: tuple[float, float, float] | None = None  # the place, object frame
    height_mm: float | None = None  # or its height; None: the middle of the photographs
    fiber: int | None = None  # or the number of the curve that it lies on, halfway
    sweep: int | None = None  # by number from 0; None: the one that sees the place best
    zoom_mm: float = 3.0  # width of close-ups, at most half of the volume's
    slab_mm: float = 0.1  # thickness of the slice of Fig. 2c
    block_mm: float = 1.4  # edge of the block of Fig. 3, length of the hair of Fig. 6
    tube_mm: float = 0.3  # features this near to the hair are shown in Fig. 6


@dataclass(frozen=True)
class Seen:
    """Features of several sweeps in the object frame."""

    points_mm: np.ndarray  # (n, 3) float32
    angle: np.ndarray  # (n,) float32 rad: of the hair in the image, from +u towards +v
    sweep: np.ndarray  # (n,) int32

    def __len__(self) -> int:
        return len(self.sweep)

    def select(self, keep: np.ndarray) -> "Seen":
        """The features for which keep (n,) is true."""
        return Seen(self.points_mm[keep], self.angle[keep], self.sweep[keep])


@dataclass(frozen=True)
class Scene:
    """All that the pictures are drawn from."""

    capture: Capture
    strands: Strands
    truth: Truth | None
    parameters: Parameters
    seen: Seen  # within BAND_MM of the place's height
    at_mm: np.ndarray  # (3,) the place
    fiber: int  # number of the curve it lies on
    sweep: int
    params: FigureParams

    @cached_property
    def captured(self) -> Strands:
        return self.strands.captured

    @cached_property
    def angles_deg(self) -> np.ndarray:
        return np.array([sweep.angle_deg for sweep in self.capture.sweeps])

    @cached_property
    def colors(self) -> np.ndarray:
        """RGB (sweeps, 3) 0…1 of each sweep, by its angle."""
        return np.array([colorsys.hsv_to_rgb(angle / 360 % 1, 0.85, 1.0) for angle in self.angles_deg])

    @cached_property
    def towards_camera(self) -> np.ndarray:
        """Unit directions (sweeps, 3), object frame, in which depth is uncertain."""
        return np.array([object_points([0.0, 0.0, 1.0], angle) for angle in self.angles_deg])

    @cached_property
    def rightwards(self) -> np.ndarray:
        """Unit directions (sweeps, 3), object frame, of +u."""
        return np.array([object_points([1.0, 0.0, 0.0], angle) for angle in self.angles_deg])

    @cached_property
    def steps_mm(self) -> np.ndarray:
        """Distance (sweeps,) from one photograph to the next."""
        return np.array([np.abs(np.diff(s.positions_mm)).mean() if len(s.positions_mm) > 1 else 0.2 for s in self.capture.sweeps])

    @property
    def azimuth_deg(self) -> float:
        """From which oblique views look: the ribbons of the chosen sweep are then seen from the side."""
        return float(self.angles_deg[self.sweep] + AZIMUTH_DEG)

    @cached_property
    def radius_mm(self) -> float:
        """Of the cylinder that all sweeps see in focus."""
        return float(self.grid.high_mm[0])

    @property
    def zoom_mm(self) -> float:
        return min(self.params.zoom_mm, self.radius_mm)

    @cached_property
    def grid(self) -> Grid:
        return grid_of(self.capture.optics, self.capture.shape, self.capture.sweeps, self.parameters.hull.voxel_mm)


def figures(
    capture_path: Path,
    out: Path,
    strands_path: Path | None = None,
    params: FigureParams = FigureParams(),
    *,
    only: Sequence[str] = (),
    workers: int = 1,
    memory_bytes: int = 6 * 10**9,
    progress: Progress = silent,
) -> Path:
    """Draw the pictures of a capture into the folder ``out``; returns the path of the page that shows them.

    strands_path: the curves to show. Without them ``out``/strands.npz is used, or made where it is missing or older than
    the capture. Features are taken from the folder that the reconstruction left beside its strands, or found anew.
    only: the names (of NAMES) of the pictures to draw, in place of all that the capture has.
    Raises StrandscopeError where a file cannot be read or written, or the place holds nothing to show.
    """
    out, capture = Path(out), load_capture(capture_path)
    names = [name for name in NAMES if (name in only or not only) and (name != "recall" or capture.truth)]
    if set(only) - set(names):
        raise StrandscopeError(f"{capture.folder}: has no figure {sorted(set(only) - set(names))[0]!r}; expected some of {', '.join(NAMES)}")
    if out.exists() and not out.is_dir():
        raise StrandscopeError(f"{out}: is a file; expected a folder for the pictures")
    truth = load_truth(capture.truth_path) if capture.truth else None
    if strands_path is None:
        strands_path = out / "strands.npz"
        if not (strands_path.is_file() and strands_path.stat().st_mtime > _changed(capture, Path(capture_path))):
            reconstruct(capture_path, strands_path, preset(), workers=workers, memory_bytes=memory_bytes, progress=progress)
    strands = load_strands(strands_path)
    if len(strands.captured) == 0:
        raise StrandscopeError(f"{strands_path}: holds no captured curve; expected one at least, to look at")
    parameters = resolve(capture, made_with(strands))
    capture = capture.reduced(parameters.ridges.reduce)
    beside = Path(strands_path) if has_work_folder(capture, Path(strands_path), parameters) else out / "strands.npz"
    work = work_folder(capture, beside, parameters)
    sweeps = find_features(capture, work, parameters, workers, progress)
    scene = look_at(capture, strands, truth, parameters, sweeps, params)

    def volume() -> Volume:
        kept = kept_volume(strands_path, strands, parameters)
        return kept or make_volume(capture, work, sweeps, strands.captured, parameters, workers, progress)

    draw: dict[str, Callable[[Path], str]] = {
        "2b": lambda path: row_figure(scene, path),
        "2c": lambda path: star_figure(scene, path),
        "3": lambda path: ribbons_figure(scene, path),
        "5": lambda path: filters_figure(scene, path),
        "6": lambda path: fiber_figure(scene, path),
        "9": lambda path: hull_figure(scene, volume(), path),
        "10": lambda path: hair_figure(scene, path),
        "14": lambda path: overlay_figure(scene, path),
        "recall": lambda path: recall_figure(scene, path),
    }
    shown = []
    for i, name in enumerate(names):
        progress("figures", i, len(names))
        path = out / f"{NAMES[name]}.png"
        shown.append((f"Figure {name}" if name != "recall" else "Recall", path.name, draw[name](path)))
    progress("figures", len(names), len(names))
    return _write_index(scene, Path(strands_path).name, shown, out / "index.html")


def _changed(capture: Capture, path: Path) -> float:
    """When a capture, read from ``path``, was changed last, in seconds."""
    files = [capture.folder / file for sweep in capture.sweeps for file in sweep.files]
    return max(os.stat(file).st_mtime for file in [path / FILE_NAME if path.is_dir() else path, *files])


# ---- the place -------------------------------------------------------------------------------------------------------


def look_at(
    capture: Capture, strands: Strands, truth: Truth | None, parameters: Parameters, sweeps: Sequence[SweepFeatures], params: FigureParams
) -> Scene:
    """Choose the place, the curve and the sweep, and gather the features around. Raises StrandscopeError for what is not there."""
    captured = strands.captured
    if params.sweep is not None and not 0 <= params.sweep < len(sweeps):
        raise StrandscopeError(f"{capture.folder}: there is no sweep {params.sweep}; expected 0 … {len(sweeps) - 1}")
    if truth is not None and truth.visibility.shape[1] != len(sweeps):
        raise StrandscopeError(f"{capture.truth_path}: visibility is of {truth.visibility.shape[1]} sweeps; expected the capture's {len(sweeps)}")
    if params.fiber is not None and not 0 <= params.fiber < len(captured):
        raise StrandscopeError(f"there is no captured curve {params.fiber}; expected 0 … {len(captured) - 1}")
    at, fiber = _place(capture, captured, params)
    seen = gather(capture, sweeps, at[1])
    near = np.linalg.norm(seen.points_mm - at, axis=1) < 0.3
    best = int(np.argmax(np.bincount(seen.sweep[near], minlength=len(sweeps))))
    return Scene(capture, strands, truth, parameters, seen, at, fiber, best if params.sweep is None else params.sweep, params)


def _place(capture: Capture, captured: Strands, params: FigureParams) -> tuple[np.ndarray, int]:
    """The place (3,) and the number of the captured curve that is nearest to it."""
    owner = np.repeat(np.arange(len(captured)), np.diff(captured.offsets))
    points = captured.points_mm.astype(float)
    if params.fiber is not None:
        curve = captured[params.fiber]
        return curve[len(curve) // 2].astype(float), params.fiber
    if params.at_mm is not None:
        return np.asarray(params.at_mm, float), int(owner[np.argmin(np.linalg.norm(points - params.at_mm, axis=1))])
    optics, rows = capture.optics, capture.shape[0]
    middle = to_image(0.0, (rows - 1) / 2, optics.pitch_mm, optics.axis_col_px, optics.axis_row_px)[1]
    height = middle if params.height_mm is None else params.height_mm
    places, curve = crossings(captured.points_mm, captured.offsets, height)
    if not len(places):
        raise StrandscopeError(f"no captured curve passes the height {height:g} mm; expected one between {_span(points[:, 1])} mm")
    sure = (np.add.reduceat(captured.confidence, captured.offsets[:-1]) / np.diff(captured.offsets))[curve]
    crowd = np.array([len(n) for n in cKDTree(places).query_ball_point(places, CROWD_MM)])
    best = int(np.lexsort((-sure, np.abs(crowd - CROWD), sure < np.median(sure)))[0])
    return np.array([places[best, 0], height, places[best, 2]]), int(curve[best])


def _span(values: np.ndarray) -> str:
    return f"{values.min():.1f} and {values.max():.1f}"


def crossings(points_mm: np.ndarray, offsets: np.ndarray, height_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Where curves pass the plane y = height_mm: points (k, 3) and the numbers (k,) of their curves."""
    above = points_mm[:, 1].astype(float) - height_mm
    curve = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    i = np.flatnonzero((np.signbit(above[:-1]) != np.signbit(above[1:])) & (curve[:-1] == curve[1:]))
    t = (above[i] / (above[i] - above[i + 1]))[:, None]
    return points_mm[i] * (1 - t) + points_mm[i + 1] * t, curve[i]


def gather(capture: Capture, sweeps: Sequence[SweepFeatures], height_mm: float) -> Seen:
    """The features of all sweeps within BAND_MM of a height."""
    parts = []
    for k, sweep in enumerate(sweeps):
        u, v, d, angle = unpack(sweep, capture.optics)
        near = np.abs(v - height_mm) <= BAND_MM
        points = object_points(np.stack([u[near], v[near], d[near]], axis=-1), sweep.angle_deg)
        parts.append(Seen(points.astype(np.float32), angle[near], np.full(np.count_nonzero(near), k, np.int32)))
    return Seen(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("points_mm", "angle", "sweep")))


@dataclass(frozen=True)
class Slice:
    """What passes a horizontal plane: curves, and where hair is known, true fibers; x and z in mm."""

    curves: np.ndarray  # (k, 2)
    false: np.ndarray  # (k,) bool: no true fiber is near
    fibers: np.ndarray  # (t, 2)
    found: np.ndarray  # (t,) bool: a curve is near
    visible: np.ndarray  # (t,) bool: from SEEN_ANGLES angles or more
    seen_from: np.ndarray  # (t, sweeps) bool


def slice_at(scene: Scene, height_mm: float) -> Slice:
    """The plane y = height_mm."""
    curves = crossings(scene.captured.points_mm, scene.captured.offsets, height_mm)[0][:, [0, 2]]
    if scene.truth is None:
        none = np.zeros(0, bool)
        return Slice(curves, np.zeros(len(curves), bool), np.zeros((0, 2)), none, none, np.zeros((0, len(scene.angles_deg)), bool))
    truth = scene.truth
    fibers = crossings(truth.points_mm, truth.offsets, height_mm)[0]
    distance, sample = cKDTree(truth.sample_points_mm.astype(float)).query(fibers, distance_upper_bound=2 * NEAR_MM)
    inside = np.isfinite(distance)  # else outside the volume that all sweeps see
    fibers, seen_from = fibers[inside][:, [0, 2]], truth.visibility[sample[inside]].astype(float) >= SEEN
    found = _nearest(curves, fibers) <= NEAR_MM
    every = crossings(truth.points_mm, truth.offsets, height_mm)[0][:, [0, 2]]
    return Slice(curves, _nearest(every, curves) > NEAR_MM, fibers, found, seen_from.sum(axis=1) >= SEEN_ANGLES, seen_from)


def _nearest(places: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distance (n,) from points (n, k) to the nearest of places, infinite where there is none."""
    return cKDTree(places).query(points)[0] if len(places) and len(points) else np.full(len(points), np.inf)


# ---- pictures of light -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Frame:
    """A rectangle of a plane, in mm, and the picture of it: square pixels, first row at the top."""

    left: float
    right: float
    bottom: float
    top: float
    width_px: int

    @property
    def pixel_mm(self) -> float:
        return (self.right - self.left) / self.width_px

    @property
    def height_px(self) -> int:
        return max(round((self.top - self.bottom) / self.pixel_mm), 1)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        return self.left, self.right, self.bottom, self.top

    def fill(self, centres, sides, light) -> np.ndarray:
        """The picture (H, W, 3) of parallelograms, each of which spreads its light (n, 3) evenly.

        centres (n, 2) and the two sides (n, 2, 2) in mm, x and y; a side may have no length. Light adds up.
        """
        picture = np.zeros((self.height_px, self.width_px, 3))
        if len(centres):
            scale = np.array([1.0, -1.0]) / self.pixel_mm
            _fill((centres - [self.left, self.top]) * scale, sides * scale, np.ascontiguousarray(light, float), picture)
        return picture


@njit(cache=True, nogil=True)
def _fill(centres, sides, light, picture):
    """Two points a pixel along both sides of each parallelogram; centres and sides in pixels."""
    height, width, _ = picture.shape
    for n in range(len(centres)):
        a = max(int(np.ceil(2.0 * np.hypot(sides[n, 0, 0], sides[n, 0, 1]))), 1)
        b = max(int(np.ceil(2.0 * np.hypot(sides[n, 1, 0], sides[n, 1, 1]))), 1)
        for i in range(a):
            for j in range(b):
                s, t = (i + 0.5) / a - 0.5, (j + 0.5) / b - 0.5
                column = int(np.floor(centres[n, 0] + s * sides[n, 0, 0] + t * sides[n, 1, 0]))
                row = int(np.floor(centres[n, 1] + s * sides[n, 0, 1] + t * sides[n, 1, 1]))
                if 0 <= row < height and 0 <= column < width:
                    for c in range(3):
                        picture[row, column, c] += light[n, c] / (a * b)


def _developed(light: np.ndarray, percentile: float = 80.0) -> np.ndarray:
    """Light (H, W, 3) without a scale -> colours 0…1; more light than ``percentile`` of the lit pixels have turns white."""
    light = ndimage.gaussian_filter(light, (0.6, 0.6, 0))
    bright = light.max(axis=-1)
    typical = np.percentile(bright[bright > 0], percentile) if (bright > 0).any() else 1.0
    return 1 - np.exp(-0.9 * light / typical)


def _patches(scene: Scene, features: Seen) -> np.ndarray:
    """The patch that each feature stands for, as two sides (n, 2, 3) in mm: a step along depth, a pixel along the hair."""
    depth = (scene.steps_mm[:, None] * scene.towards_camera)[features.sweep]
    upwards = np.array([0.0, 1.0, 0.0])
    along = np.cos(features.angle)[:, None] * scene.rightwards[features.sweep] + np.sin(features.angle)[:, None] * upwards
    return np.stack([depth, scene.capture.optics.pitch_mm * along], axis=1)


def _oblique(points_mm: np.ndarray, azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    """Points (..., 3) of the object frame as seen from the side and above: right, up, towards the eye; mm, without perspective."""
    u, v, w = np.moveaxis(camera_points(points_mm, azimuth_deg), -1, 0)
    cos, sin = np.cos(np.radians(elevation_deg)), np.sin(np.radians(elevation_deg))
    return np.stack([u, v * cos - w * sin, v * sin + w * cos], axis=-1)


# ---- figures on paper ------------------------------------------------------------------------------------------------


@contextmanager
def _page(path: Path, width_in: float, height_in: float) -> Iterator:
    """An empty figure in our style, which is written as PNG when it has been filled."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure((width_in, height_in), dpi=DPI, layout="constrained")
        yield figure
        with atomic(path) as part:
            FigureCanvasAgg(figure).print_png(part)
    _shrink(path)


def _shrink(path: Path) -> None:
    """Give a picture of many bytes a palette that keeps all hues: a third of the bytes, and hardly a difference to the eye."""
    from PIL import Image, ImageOps

    if path.stat().st_size < MANY_BYTES:
        return
    with Image.open(path) as opened:
        picture = opened.convert("RGB")
    few = ImageOps.posterize(picture.resize((picture.width // 3, picture.height // 3), Image.Resampling.NEAREST), 5)  # for the sake of time
    palette = few.quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=2)
    small = picture.quantize(palette=palette, dither=Image.Dither.NONE)
    with atomic(path) as part:
        small.save(part, optimize=True)


def _outlined(width: float) -> dict:
    """Keywords that set a mark off from what is behind it."""
    from matplotlib.patheffects import withStroke

    return {"path_effects": [withStroke(linewidth=width, foreground="black")]}


def _rings(axes, places: np.ndarray, size_pt: float, color: str = FOUND, **more) -> None:
    """Open circles at places (n, 2)."""
    axes.plot(*places.T, "o", markersize=size_pt, markerfacecolor="none", markeredgecolor=color, markeredgewidth=0.8, **_outlined(1.8), **more)


def _crosses(axes, places: np.ndarray, size_pt: float, color: str, mark: str = "+", **more) -> None:
    axes.plot(*places.T, mark, markersize=size_pt, color=color, markeredgewidth=0.9, **_outlined(1.9), **more)


def _bare(axes) -> None:
    """No ticks; for pictures that need no scale."""
    axes.set_xticks([])
    axes.set_yticks([])


def _key(figure, axes) -> None:
    """What the marks of some axes mean, below all, each kind once and as the first of them shows it."""
    handles = {label: handle for a in reversed(axes) for handle, label in zip(*a.get_legend_handles_labels(), strict=True)}
    if handles:
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=len(handles), labelcolor=INK)


# ---- 2b: one row of a sweep ------------------------------------------------------------------------------------------


def row_figure(scene: Scene, path: Path) -> str:
    """Light of one row of the photographs of a sweep, over u and d, without and with the features (Fig. 2b); returns a caption."""
    optics, sweep = scene.capture.optics, scene.capture.sweeps[scene.sweep]
    rows, columns = scene.capture.shape
    at = camera_points(scene.at_mm, sweep.angle_deg)
    row = int(np.clip(round(to_pixel(0.0, at[1], optics.pitch_mm, optics.axis_col_px, optics.axis_row_px)[1]), 0, rows - 1))
    height = to_image(0.0, row, optics.pitch_mm, optics.axis_col_px, optics.axis_row_px)[1]
    order = np.argsort(sweep.positions_mm)
    positions = np.asarray(sweep.positions_mm)[order]
    light = np.stack([scene.capture.planes(sweep.files[i])[0][row] for i in order])
    even = np.linspace(positions[0], positions[-1], len(positions))
    light = light[np.abs(positions - even[:, None]).argmin(axis=1)]
    light = np.clip(light / max(float(np.percentile(light, 99.7)), 1e-6), 0, 1) ** (1 / 2.2)
    left, right = to_image(np.array([-0.5, columns - 0.5]), 0.0, optics.pitch_mm, optics.axis_col_px, optics.axis_row_px)[0]
    half = scene.steps_mm[scene.sweep] / 2
    extent = (left, right, positions[-1] + half, positions[0] - half)  # d grows downwards, towards the camera

    features = scene.seen.select((scene.seen.sweep == scene.sweep) & (np.abs(scene.seen.points_mm[:, 1] - height) <= optics.pitch_mm / 2))
    u, _, d = camera_points(features.points_mm, sweep.angle_deg).T
    passing = slice_at(scene, height)
    curves, fibers = _seen_in(passing.curves, sweep.angle_deg), _seen_in(passing.fibers, sweep.angle_deg)
    seen = passing.seen_from[:, scene.sweep]
    zoom = scene.zoom_mm / 2
    middle = np.clip(at[[0, 2]], [left + zoom, extent[3] + zoom], [right - zoom, extent[2] - zoom])
    with _page(path, 10.0, 10.6) as figure:
        whole, whole_with, close, close_with = panels = figure.subplots(2, 2).ravel()
        for axes in panels:
            white = 1.0 if axes in (whole, close) else 1.8  # darker, for what is drawn over it
            axes.imshow(light, cmap="gray", extent=extent, aspect="equal", interpolation="nearest", vmin=0, vmax=white)
            axes.set(xlabel="u (mm)", ylabel="d (mm), camera below")
            shown = extent if axes in (whole, whole_with) else (middle[0] - zoom, middle[0] + zoom, middle[1] + zoom, middle[1] - zoom)
            axes.set(xlim=shown[:2], ylim=shown[2:])
        whole.set_title(f"light, row {row} (v = {_mm(height)} mm), {sweep.angle_deg:g}°")
        whole_with.set_title(f"with its {len(features)} features")
        close.set_title("close up")
        close_with.set_title("with features and the curves that pass")
        for axes in (whole, whole_with):
            axes.add_patch(_square(middle, zoom))
        whole_with.vlines(u, d - half, d + half, color=ACCENT, linewidth=0.8)
        close_with.vlines(u, d - half, d + half, color=ACCENT, linewidth=1.2, label="feature")
        _rings(close_with, curves, 9, label="curve")
        if scene.truth is not None:
            _crosses(close_with, fibers[seen], 5, TRUE, label="true fiber seen from this angle")
            _crosses(close_with, fibers[~seen], 5, "#b8b8b8", label="hidden from it")
        _key(figure, [close_with])
    return (
        f"Light of row {row} (v = {_mm(height)} mm) in all {len(positions)} photographs of sweep {scene.sweep} at {sweep.angle_deg:g}°, over u and "
        "the position d of the plane of focus: a hair is a short bright streak within a wide blur, and the features should mark its core."
    )


def _seen_in(places: np.ndarray, angle_deg: float) -> np.ndarray:
    """u and d (n, 2) of places x, z (n, 2) when they are in focus."""
    return camera_points(np.stack([places[:, 0], np.zeros(len(places)), places[:, 1]], axis=-1), angle_deg)[:, [0, 2]]


def _square(centre, half: float):
    """The outline of a close-up."""
    from matplotlib.patches import Rectangle

    return Rectangle(np.asarray(centre) - half, 2 * half, 2 * half, fill=False, edgecolor=INK, linewidth=0.8, linestyle=(0, (4, 3)))


# ---- 2c: the star ----------------------------------------------------------------------------------------------------


def star_figure(scene: Scene, path: Path) -> str:
    """Features of all sweeps in a thin horizontal slice, whole and close up (Fig. 2c); returns a caption."""
    height = scene.at_mm[1]
    features = scene.seen.select(np.abs(scene.seen.points_mm[:, 1] - height) <= scene.params.slab_mm / 2)
    passing = slice_at(scene, height)
    rim, zoom = 1.22 * scene.radius_mm, scene.zoom_mm / 2
    x, z = np.clip(scene.at_mm[[0, 2]], zoom - scene.radius_mm, scene.radius_mm - zoom)
    with _page(path, 14.0, 7.7) as figure:
        for axes, frame, size in zip(
            figure.subplots(1, 2),
            (Frame(-rim, rim, -rim, rim, 900), Frame(x - zoom, x + zoom, -z - zoom, -z + zoom, 900)),
            (1.8, 10.0),
            strict=True,
        ):
            picture = _developed(streaks(scene, features, frame))
            left, right, low, high = frame.extent
            axes.imshow(picture, extent=(left, right, -low, -high), interpolation="antialiased")
            axes.set(xlabel="x (mm)", ylabel="z (mm)", xlim=(left, right), ylim=(-low, -high))
            _marks(axes, passing, size)
        whole, close = figure.axes
        whole.set_title(f"slice at y = {_mm(height)} mm, {scene.params.slab_mm:g} mm thick, seen from above")
        close.set_title("close up")
        whole.add_patch(_square((x, z), zoom))
        _cameras(whole, scene)
        _key(figure, [close, whole])
    truth = ""
    if scene.truth is not None:
        visible, found = np.count_nonzero(passing.visible), np.count_nonzero(passing.visible & passing.found)
        truth = (
            f" Of {visible} true fibers visible from {SEEN_ANGLES} or more angles here, {found} have a curve within {NEAR_MM:g} mm; "
            f"{np.count_nonzero(passing.false)} of {len(passing.curves)} curves have no fiber there."
        )
    return (
        f"The {len(features)} features of all {len(scene.angles_deg)} sweeps in a slice at y = {_mm(height)} mm, coloured by where the camera stood "
        f"(dots on the rim): each sweep draws a streak towards its camera, and where the streaks of many sweeps cross, a hair passes.{truth}"
    )


def streaks(scene: Scene, features: Seen, frame: Frame) -> np.ndarray:
    """Light (H, W, 3) of features as streaks along depth, from above: x to the right, z down (the frame's y is -z)."""
    from_above = np.array([[1.0, 0.0], [0.0, 0.0], [0.0, -1.0]])
    sides = _patches(scene, features) * ALONG_DEPTH
    return frame.fill(features.points_mm @ from_above, sides @ from_above, scene.colors[features.sweep])


def _marks(axes, passing: Slice, size_pt: float) -> None:
    """Curves and true fibers in a slice, x and z; small ones without the fibers that were found, which would hide the curves."""
    _rings(axes, passing.curves[~passing.false], size_pt, label="curve")
    if passing.false.any():
        _rings(axes, passing.curves[passing.false], size_pt, MISSED, label="curve without a fiber")
    missed = passing.visible & ~passing.found
    hidden = ~passing.visible & ~passing.found
    if passing.found.any() and size_pt > 5:
        _crosses(axes, passing.fibers[passing.found], 0.55 * size_pt, FOUND, label="true fiber, found")
    if missed.any():
        _crosses(axes, passing.fibers[missed], max(0.7 * size_pt, 3), MISSED, "x", label="true fiber, missed")
    if hidden.any():
        _crosses(axes, passing.fibers[hidden], max(0.5 * size_pt, 2), FAINT, label=f"seen from fewer than {SEEN_ANGLES} angles")


def _cameras(axes, scene: Scene) -> None:
    """A dot on the rim of the slice where each camera stood, in its colour, and the angles of some."""
    x, _, z = 1.06 * scene.radius_mm * scene.towards_camera.T
    axes.scatter(x, z, s=22, c=scene.colors, zorder=3)
    for k in range(0, len(x), max(len(x) // 4, 1)):
        at = 1.08 * np.array([x[k], z[k]])
        axes.text(*at, f"{scene.angles_deg[k]:g}°", ha="center", va="center", fontsize=8, color=INK, **_outlined(2))


# ---- 3 and 6: ribbons ------------------------------------------------------------------------------------------------


def ribbons_figure(scene: Scene, path: Path) -> str:
    """The features of a block, from one angle, two and all, seen from the side and above (Fig. 3); returns a caption."""
    half = scene.params.block_mm / 2
    block = scene.seen.select(np.all(np.abs(scene.seen.points_mm - scene.at_mm) <= half, axis=1))
    counts = np.bincount(block.sweep, minlength=len(scene.angles_deg))
    across = np.abs(np.sin(np.radians(scene.angles_deg - scene.angles_deg[scene.sweep])))  # of two angles, 1 where they are 90° apart
    second = int(np.argmax(counts * across))
    chosen = [[scene.sweep], sorted({scene.sweep, second}), list(range(len(scene.angles_deg)))]
    reach = 1.62 * half
    frame = Frame(-reach, reach, -reach, reach, 620)
    with _page(path, 14.0, 5.2) as figure:
        for axes, sweeps in zip(figure.subplots(1, 3), chosen, strict=True):
            features = block.select(np.isin(block.sweep, sweeps))
            axes.imshow(_ribbons(scene, features, scene.at_mm, frame, ELEVATION_DEG), extent=frame.extent, interpolation="antialiased")
            _box(axes, half, scene.azimuth_deg)
            _bare(axes)
            axes.set_title(", ".join(f"{scene.angles_deg[k]:g}°" for k in sweeps) if len(sweeps) < 3 else f"all {len(sweeps)} angles")
    return (
        f"The features of a block of {2 * half:g} mm around the place, from one angle, from two and from all {len(scene.angles_deg)}: those of one "
        "hair and one angle form a ribbon that is edge-on to the camera, and hairs lie where ribbons of many angles cut each other."
    )


def _ribbons(scene: Scene, features: Seen, centre: np.ndarray, frame: Frame, elevation_deg: float) -> np.ndarray:
    """A picture (H, W, 3) of the features' patches from the side and above; the farther ones are darker."""
    places = _oblique(features.points_mm - centre, scene.azimuth_deg, elevation_deg)
    sides = _oblique(_patches(scene, features), scene.azimuth_deg, elevation_deg)
    fog = 0.6 + 0.4 * np.clip(places[:, 2:] / frame.top, -1, 1)
    return _developed(frame.fill(places[:, :2], sides[..., :2], scene.colors[features.sweep] * fog), 93)


def _box(axes, half: float, azimuth_deg: float) -> None:
    """The edges of a cube about the origin, in the oblique view, with its axes named."""
    corners = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) * half
    seen = _oblique(corners, azimuth_deg, ELEVATION_DEG)[:, :2]
    edges = [(i, j) for i in range(8) for j in range(i + 1, 8) if np.count_nonzero(corners[i] != corners[j]) == 1]
    for i, j in edges:
        axes.plot(*seen[[i, j]].T, color=FAINT, linewidth=0.7)
    for axis, name in enumerate("xyz"):
        middles = np.array([seen[[i, j]].mean(axis=0) for i, j in edges if corners[i, axis] != corners[j, axis]])
        at = 1.13 * middles[np.argmin(middles[:, 0] if name == "y" else middles[:, 1])]
        axes.text(*at, name if name == "y" else f"{name}, {2 * half:g} mm", ha="center", va="center", fontsize=8.5)


def fiber_figure(scene: Scene, path: Path) -> str:
    """The features around one curve, from the side, and looking along it (Fig. 6); returns a caption."""
    tube, half = scene.params.tube_mm, scene.params.block_mm / 2
    line, tangent = _piece(scene.captured[scene.fiber].astype(float), scene.at_mm, half)
    right, up = _across(tangent)
    reach = half + 2 * DEPTH_MM
    seen = scene.seen.select(np.all(np.abs(scene.seen.points_mm - scene.at_mm) < reach, axis=1))
    nearest = cKDTree(line).query(seen.points_mm)[1]
    offset = seen.points_mm - line[nearest]
    along, x, z = (np.einsum("ni,ni->n", offset, way[nearest]) for way in (tangent, right, up))
    across = np.einsum("ni,ni->n", offset, scene.rightwards[seen.sweep])  # of its ribbon, where the hair is upright
    beside = np.abs(along) < 0.05  # not beyond the ends
    own = seen.select(beside & (np.abs(across) <= OWN_MM) & (np.hypot(x, z) <= DEPTH_MM))
    around = beside & (np.hypot(x, z) <= 1.5 * tube)
    light = scene.colors[seen.sweep[around]]
    places = np.stack([x, -z], axis=-1)[around]
    frames = np.stack([right, -up], axis=-1)[nearest[around]]  # (n, 3, 2): from the object frame to the plane across the hair
    sides = _patches(scene, seen.select(around)) * ALONG_DEPTH @ frames
    centre, reach = line.mean(axis=0), 1.25 * half
    side, front = Frame(-reach, reach, -reach, reach, 800), Frame(-tube, tube, -tube, tube, 800)
    with _page(path, 13.0, 7.0) as figure:
        oblique, looking = figure.subplots(1, 2)
        oblique.imshow(_ribbons(scene, own, centre, side, STEEP_DEG), extent=side.extent, interpolation="antialiased")
        oblique.plot(*_oblique(line - centre, scene.azimuth_deg, STEEP_DEG).T[:2], color=FOUND, linewidth=2.2, **_outlined(4.5))
        _bare(oblique)
        oblique.plot([-0.95 * reach, -0.95 * reach + 0.2], [-0.95 * reach] * 2, color=INK, linewidth=2)
        oblique.text(-0.95 * reach, -0.93 * reach, "0.2 mm")
        oblique.set_title(f"curve {scene.fiber} and its ribbons")

        looking.imshow(_developed(front.fill(places, sides, light)), extent=(-tube, tube, tube, -tube), interpolation="antialiased")
        turn = np.linspace(0, 2 * np.pi, 100)
        radius = float(np.median(scene.captured.radius_mm))
        looking.plot(radius * np.cos(turn), radius * np.sin(turn), color=FOUND, linewidth=1.3, label="curve, with its radius", **_outlined(2.5))
        if scene.truth is not None:
            true = _beside(scene.truth, line, right, up)
            looking.plot(*true.T, color=TRUE, linewidth=1.4, label="the true fiber nearest to it", **_outlined(2.8))
        looking.set(xlabel="across the hair, along x (mm)", ylabel="across the hair, along z (mm)", xlim=(-tube, tube), ylim=(tube, -tube))
        looking.set_title("looking along the curve as if it were straight")
        _key(figure, [looking])
    return (
        f"The ribbons of {2 * half:g} mm of curve {scene.fiber} from the side, and all features within {tube:g} mm looking along the hair as if it "
        "were straight: the ribbons of all angles should cut each other in the curve; what passes beside it belongs to neighbours."
    )


def _piece(curve: np.ndarray, at_mm: np.ndarray, half: float, spacing_mm: float = 0.02) -> tuple[np.ndarray, np.ndarray]:
    """Points and unit tangents (m, 3) of the part of a curve (n, 3) within ``half`` along it from where it is nearest to a place."""
    s = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))]
    middle = s[np.argmin(np.linalg.norm(curve - at_mm, axis=1))]
    at = np.arange(max(middle - half, 0.0), min(middle + half, s[-1]), spacing_mm)
    line = np.stack([np.interp(at, s, x) for x in curve.T], axis=-1)
    smooth = ndimage.gaussian_filter1d(line, 0.1 / spacing_mm, axis=0, mode="nearest")  # steps of growing are no turns of the hair
    tangent = np.gradient(smooth, axis=0)
    return line, tangent / np.linalg.norm(tangent, axis=1, keepdims=True)


def _across(tangent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit directions (m, 3) across tangents (m, 3): as near to x as can be, and for a hair that rises, as near to z."""
    tangent = np.where(tangent.mean(axis=0)[1] < 0, -tangent, tangent)
    x = np.array([1.0, 0.0, 0.0]) if np.abs(tangent[:, 0]).max() < 0.9 else np.array([0.0, 0.0, 1.0])
    right = x - (tangent @ x)[:, None] * tangent
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return right, np.cross(right, tangent)


def _beside(truth: Truth, line: np.ndarray, right: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Where the true fiber that is nearest to most of a line (m, 3) passes it, seen along the line: (m, 2) mm."""
    fiber = np.repeat(np.arange(len(truth.offsets) - 1), np.diff(truth.offsets))
    nearest = fiber[cKDTree(truth.points_mm).query(line)[1]]
    best = int(np.bincount(nearest).argmax())
    points = truth.points_mm[truth.offsets[best] : truth.offsets[best + 1]].astype(float)
    s = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
    fine = np.stack([np.interp(np.arange(0, s[-1], 0.002), s, x) for x in points.T], axis=-1)
    offset = fine[cKDTree(fine).query(line)[1]] - line
    return np.stack([np.einsum("ni,ni->n", offset, right), np.einsum("ni,ni->n", offset, up)], axis=-1)


# ---- 5: filters ------------------------------------------------------------------------------------------------------


def filters_figure(scene: Scene, path: Path) -> str:
    """The filters, the ridges that they find and their angles on a piece of a photograph, ours above the paper's (Fig. 5); returns a caption."""
    optics, sweep = scene.capture.optics, scene.capture.sweeps[scene.sweep]
    u, v, w = camera_points(scene.at_mm, sweep.angle_deg)
    shot = int(np.argmin(np.abs(np.asarray(sweep.positions_mm) - w)))
    plane = scene.capture.planes(sweep.files[shot])[0]
    col, row = to_pixel(u, v, optics.pitch_mm, optics.axis_col_px, optics.axis_row_px)
    window = _window(plane.shape, row, col, scene.zoom_mm / optics.pitch_mm)
    used, papers = scene.parameters.ridges, preset("straight", "paper").ridges
    methods = [("used here", used)] + ([("the paper's", papers)] if used.operator != papers.operator else [])
    light = plane[window] / max(float(np.percentile(plane[window], 99.7)), 1e-6)
    with _page(path, 13.0, 3.55 * len(methods) + 0.2) as figure:
        for part, (name, params) in zip(np.atleast_1d(figure.subfigures(len(methods), 1)), methods, strict=True):
            bank = _bank(params)
            picture, filters, strength, angle = part.subplots(1, 4)
            picture.imshow(np.clip(light, 0, 1) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
            picture.set_title(f"photograph, {sweep.angle_deg:g}°, d = {sweep.positions_mm[shot]:g} mm")
            shown = _tiles([bank[k] for k in (0, BINS // 8, BINS // 4, 3 * BINS // 8)])
            filters.imshow(shown, cmap=_dark("berlin"), vmin=-np.nanmax(np.abs(shown)), vmax=np.nanmax(np.abs(shown)))
            filters.set_title(f"4 of {len(bank)} filters of {bank.shape[1]} × {bank.shape[2]} px, {name}")
            crests = response(plane, params)[window]
            strength.imshow(np.sqrt(crests), cmap="gray", vmin=0, vmax=np.sqrt(np.percentile(crests[crests > 0], 99)) if (crests > 0).any() else 1)
            strength.set_title("ridges")
            angle.imshow(_hues(plane, params)[window])
            angle.set_title("their angle")
            _wheel(angle)
            for axes in (picture, filters, strength, angle):
                _bare(axes)
    return (
        f"A piece of {scene.zoom_mm:.1f} mm of the photograph of sweep {scene.sweep} that is focused on the place, some of the filters that "
        "find hair in it, the ridges that are kept, and their angle as a hue: only what is in focus should give ridges, each one pixel wide."
    )


def _window(shape: tuple[int, int], row: float, col: float, size_px: float) -> tuple[slice, slice]:
    """Rows and columns of a square of a picture about a pixel, moved so that it is inside."""
    slices = []
    for at, length in zip((row, col), shape, strict=True):
        size = min(round(size_px), length)
        first = int(np.clip(round(at - size / 2), 0, length - size))
        slices.append(slice(first, first + size))
    return tuple(slices)


def _bank(params: RidgeParams) -> np.ndarray:
    """The filters (BINS, k, k) of an operator."""
    return gabor_bank() if params.operator == "paper" else line_banks(params.across_px, params.along_px)[0]


def _tiles(filters: list[np.ndarray]) -> np.ndarray:
    """Four filters (k, k) as two rows of two, with a gap of NaN."""
    gap = max(len(filters[0]) // 8, 1)
    a, b, c, d = (np.pad(f, gap, constant_values=np.nan) for f in filters)
    return np.block([[a, b], [c, d]])


def _hues(plane: np.ndarray, params: RidgeParams) -> np.ndarray:
    """The ridges of a plane (H, W) as a picture (H, W, 3), their angle as hue."""
    found = detect(plane, params)
    picture = np.zeros((*plane.shape, 3))
    row, col = (np.clip(np.rint(a).astype(int), 0, n - 1) for a, n in zip((found.row, found.col), plane.shape, strict=True))
    picture[row, col] = _hue(found.angle)
    return picture


def _hue(angle: np.ndarray) -> np.ndarray:
    """RGB (n, 3) of angles (n,) rad that repeat after pi; a hair that stands upright is red."""
    from matplotlib.colors import hsv_to_rgb

    turned = np.mod(np.asarray(angle) / np.pi - 0.5, 1.0)
    return hsv_to_rgb(np.stack([turned, np.full_like(turned, 0.85), np.ones_like(turned)], axis=-1))


def _dark(name: str):
    """A colour map that leaves NaN as dark as the page."""
    from matplotlib import colormaps

    return colormaps[name].with_extremes(bad=PAPER)


def _wheel(axes) -> None:
    """The key of hues: a half turn of short lines at their own angle, in a corner."""
    inset = axes.inset_axes([0.76, 0.02, 0.22, 0.12])
    inset.patch.set_alpha(0.75)
    for angle in np.linspace(0, np.pi, 37):
        x, y = np.cos(angle), np.sin(angle)
        inset.plot([0.45 * x, x], [0.45 * y, y], color=_hue(np.array([angle]))[0], linewidth=2)
    inset.set(xlim=(-1.15, 1.15), ylim=(-0.1, 1.15), aspect="equal")
    _bare(inset)


# ---- 9: hull, carving, both ------------------------------------------------------------------------------------------


def hull_figure(scene: Scene, volume: Volume, path: Path) -> str:
    """The visual hull, the carved volume, their combination and the occupancy, from outside and cut (Fig. 9); returns a caption."""
    grid, params, blueness, rays = volume.grid, scene.parameters.hull, volume.blueness, volume.rays
    hull = hull_inside(blueness, grid, params)
    soft = [ndimage.gaussian_filter(v.astype(np.float32), 0.8) for v in (hull, carved_inside(rays, hull, grid, params))]
    both = occupancy(blueness, rays, grid, params)
    solids = [("visual hull", soft[0]), ("space carving", soft[1]), ("both", both), ("with the curves", volume.density)]
    level = int(np.clip(grid.to_cells(scene.at_mm)[1], 0, grid.shape[1] - 1))
    places = slice_at(scene, scene.at_mm[1]).curves
    low, high = np.asarray(grid.origin_mm), grid.high_mm
    with _page(path, 14.6, 8.1) as figure:
        panels = figure.subplots(2, 4)
        for (name, solid), outside, cut in zip(solids, *panels, strict=True):
            outside.imshow(lit(solid, grid), cmap="bone", vmin=0, vmax=1.05)
            _bare(outside)
            outside.set_title(f"{name}, {np.count_nonzero(solid > 0.5) * grid.voxel_mm**3:.0f} mm³")
            cut.imshow(solid[:, level].T, cmap="bone", extent=(low[0], high[0], high[2], low[2]), interpolation="bilinear", vmin=0, vmax=1.6)
            cut.plot(*places.T, ".", markersize=2.5, color=ACCENT, markeredgewidth=0, label="curve")
            cut.set(xlabel="x (mm)", ylabel="z (mm)", title=f"cut at y = {_mm(scene.at_mm[1])} mm")
        _key(figure, [cut])
    return (
        "What is left where the blue board was never seen in focus (visual hull), where few rays of sight from features to their camera pass (space "
        "carving), and of both: the hull closes over hollows, the carving keeps what no ray crossed beside the hair. The last is where the infill "
        "grows: close about the curves, and of the volume before it only the core that few cameras see into."
    )


def _mm(value: float) -> str:
    """A length in mm with two decimals and never minus nothing."""
    return f"{round(float(value), 2) + 0.0:.2f}"


def lit(solid: np.ndarray, grid: Grid, size_px: int = 420) -> np.ndarray:
    """The surface solid = 0.5 in a soft light from the upper left, seen from the side and above: (H, W) 0…1, NaN beside it."""
    solid = np.pad(solid, 3)  # so that it has a surface where the grid ends
    centre, reach = (np.asarray(grid.origin_mm) + grid.high_mm) / 2, np.linalg.norm(grid.high_mm - grid.origin_mm) / 2
    step = 0.5 * grid.voxel_mm
    frame = Frame(-0.86 * reach, 0.86 * reach, -0.86 * reach, 0.86 * reach, size_px)
    side = (np.arange(size_px) + 0.5) * frame.pixel_mm
    u, v = (a.ravel() for a in np.meshgrid(frame.left + side, frame.top - side))
    eye = np.linalg.inv(_oblique(np.eye(3), HULL_AZIMUTH_DEG, ELEVATION_DEG))  # rows: right, up, towards the eye, object frame
    cells = grid.to_cells(centre + np.stack([u, v, np.full_like(u, reach)], axis=-1) @ eye) + 2.5
    into = -step / grid.voxel_mm * eye[2]
    before, depth = np.zeros(len(u)), np.full(len(u), np.nan)
    for i in range(int(2 * reach / step)):
        open_rays = np.flatnonzero(np.isnan(depth))
        value = ndimage.map_coordinates(solid, (cells[open_rays] + i * into).T, order=1, cval=0.0)
        hit = value > 0.5
        depth[open_rays[hit]] = i - (value[hit] - 0.5) / (value[hit] - before[open_rays[hit]])
        before[open_rays] = value
    hits = np.flatnonzero(np.isfinite(depth))
    where = cells[hits] + depth[hits, None] * into
    soft = ndimage.gaussian_filter(solid, 1.0)
    normal = -np.stack([ndimage.map_coordinates(g, where.T, order=1, mode="nearest") for g in np.gradient(soft)], axis=-1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-9
    light = np.array([-0.42, 0.55, 0.72]) @ eye
    shaded = np.full(len(u), np.nan)
    shaded[hits] = 0.3 + 0.7 * np.clip(normal @ light, 0, 1)
    return shaded.reshape(size_px, size_px)


# ---- 10: hair --------------------------------------------------------------------------------------------------------


def hair_figure(scene: Scene, path: Path) -> str:
    """The curves drawn as hair from the front, alone, with the infill, and with the infill told apart (Fig. 10); returns a caption."""
    captured, infill = scene.captured, scene.strands.select(scene.strands.kind == INFILL)
    shown = [(f"{len(captured)} captured curves", captured, None)]
    if len(infill):
        shown.append((f"with {len(infill)} of infill", scene.strands, None))
        shown.append(("infill in blue", scene.strands, INFILL_TINT))
    rows, columns = scene.capture.shape
    with _page(path, max(4.4 * len(shown) * columns / rows, 3.0), 4.8) as figure:
        for axes, (title, strands, tint) in zip(np.atleast_1d(figure.subplots(1, len(shown))), shown, strict=True):
            light = _drawn(strands, scene.capture, tint)
            if axes is figure.axes[0]:
                white = max(float(np.percentile(light[light.max(axis=-1) > 0.03], 99)), 1e-6) if (light > 0.03).any() else 1.0
            axes.imshow(np.clip(light / white, 0, 1) ** (1 / 2.2))
            axes.set_title(title)
            _bare(axes)
    more = " and with the infill, which continues them where no camera sees" if len(infill) else ""
    return f"The reconstructed curves at turntable angle 0°, drawn as hair in the light of the capture: alone{more}."


def _drawn(strands: Strands, capture: Capture, infill_tint: np.ndarray | None) -> np.ndarray:
    """Linear light (H, W, 3) of strands as the capture's camera sees them at angle 0°, all of them in focus."""
    optics, (rows, columns) = capture.optics, capture.shape
    zoom = HAIR_PX / rows
    optics = replace(optics, pitch_mm=optics.pitch_mm / zoom, axis_col_px=optics.axis_col_px * zoom, axis_row_px=optics.axis_row_px * zoom)
    shape = (HAIR_PX, max(round(columns * zoom), 1))
    rng = np.random.default_rng(0)
    hair = prepare(_groom(strands), rng)
    look = LOOKS["wavy"]
    shaded = shade(hair, density(hair), look, 0.0, optics.working_distance_mm)
    if infill_tint is not None:
        color = np.where((strands.kind == INFILL)[hair.fiber][:, None], shaded.color.mean(axis=1, keepdims=True) * infill_tint, shaded.color)
        shaded = replace(shaded, color=color.astype(np.float32))
    through = lens(LENS_POINTS, 0.0, shape[0] + 1, rng)  # a pinhole
    red, green, also, blue = photograph(drawing(hair, 0.0, shaded), np.zeros((4, *shape), np.float32), optics, 0.0, through)
    return np.stack([red, (green + also) / 2, blue], axis=-1)


def _groom(strands: Strands) -> Groom:
    """Strands as the simulator draws them: without points that repeat, and of one radius each."""
    points = strands.points_mm.astype(float)
    first = np.zeros(len(points), bool)
    first[strands.offsets[:-1]] = True
    keep = first | (np.r_[0.0, np.linalg.norm(np.diff(points, axis=0), axis=1)] > 1e-6)
    sizes = np.add.reduceat(keep, strands.offsets[:-1])
    keep &= np.repeat(sizes > 1, np.diff(strands.offsets))
    radii = np.add.reduceat(strands.radius_mm.astype(float), strands.offsets[:-1]) / np.diff(strands.offsets)
    return Groom(points[keep], offsets_of(np.where(sizes > 1, sizes, 0)), radii)


# ---- 14: curves on a photograph; recall ------------------------------------------------------------------------------


def overlay_figure(scene: Scene, path: Path) -> str:
    """A photograph, its ridges, and the curves that are in focus there (Fig. 14); returns a caption."""
    shot = choose_shot(scene.capture, scene.strands, scene.params.sweep)
    told = overlay(scene.capture, scene.strands, shot, path)
    _shrink(path)
    return f"The photograph {told}: most ridges should have a curve on them, and curves should lie on ridges."


def recall_figure(scene: Scene, path: Path) -> str:
    """How much of the known hair these strands found, by the number of angles that see it; returns a caption."""
    report = score(scene.strands, scene.truth)
    recall_plot(path, {"this reconstruction": report})
    return (
        f"How much of the known hair was found, by the number of angles that see it: {report['recall']:.3f} of what is visible from {SEEN_ANGLES} or "
        f"more; {report['precision']:.3f} of the length of curves is hair."
    )


def recall_plot(path: Path, scores: dict[str, dict]) -> None:
    """Write a plot (.png) of recall over the number of angles that see a point. scores: the results of ``compare.score``, by method.

    The bars tell how many true points there are in each bin of the first of them. Raises StrandscopeError without any.
    """
    if not scores:
        raise StrandscopeError(f"{path}: there are no scores to plot; expected at least one")
    bins = next(iter(scores.values()))["recall_by_visible_angles"]
    count = np.array([n for _, n in bins.values()])
    with _page(path, 7.2, 4.2) as figure:
        axes = figure.subplots()
        bars = axes.twinx()
        bars.set_facecolor(PAPER)
        bars.bar(range(len(bins)), count, width=0.86, color="#333333")
        bars.set(ylabel="true points (bars)", ylim=(0, 1.6 * max(count.max(), 1)))
        axes.set_zorder(bars.get_zorder() + 1)
        axes.patch.set_visible(False)
        for i, (name, report) in enumerate(scores.items()):
            shares = np.array([share if n else np.nan for share, n in report["recall_by_visible_angles"].values()], float)
            label = f"{name}: {report['recall']:.3f} from {SEEN_ANGLES} on"
            axes.plot(shares, "o-", color=METHODS[i % len(METHODS)], linewidth=1.8, markersize=5, label=label)
        axes.set(xlabel="angles that see the point", ylabel="recall", ylim=(0, 1.04))
        axes.set_xticks(range(len(bins)), [" – ".join(sorted(set(name.split("-")), key=int)) for name in bins])
        axes.grid(axis="y", color="#444444", linewidth=0.5)
        figure.legend(loc="outside upper left", labelcolor=INK, ncols=2)


# ---- the page --------------------------------------------------------------------------------------------------------

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>
body {{ background: {paper}; color: {ink}; font: 15px/1.5 sans-serif; max-width: 1500px; margin: 2em auto; padding: 0 1em }}
img {{ max-width: 100%; display: block }} figure {{ margin: 2.5em 0 }} figcaption {{ max-width: 62em; margin-top: .6em }}
</style></head><body>
<h1>{title}</h1>
<p>{summary}</p>
{figures}
</body></html>
"""
BLOCK = """<figure><a href="{file}"><img src="{file}" alt="{title}"></a>
<figcaption><b>{title}.</b> {text}</figcaption></figure>"""


def _write_index(scene: Scene, strands_name: str, shown: list[tuple[str, str, str]], path: Path) -> Path:
    """Write the page with all pictures; shown: (title, file, caption) each. Returns its path."""
    captured = scene.captured
    total, place = lengths(captured.points_mm, captured.offsets).sum(), ", ".join(map(_mm, scene.at_mm))
    summary = (
        f"{len(scene.angles_deg)} sweeps, {len(captured)} captured curves of {total:.0f} mm in {strands_name}. The close-ups look at curve "
        f"{scene.fiber} at x, y, z = {place} mm, and at sweep {scene.sweep}. A colour is an angle of the turntable; light adds up where features "
        "lie on each other; an open circle is a curve."
    )
    blocks = [BLOCK.format(file=file, title=html.escape(title), text=html.escape(text)) for title, file, text in shown]
    page = PAGE.format(title=html.escape(scene.capture.name), summary=html.escape(summary), figures="\n".join(blocks), paper=PAPER, ink=INK)
    with atomic(path) as part:
        part.write_text(page, encoding="utf-8")
    return path
