"""A capture of a printed target -> what is wrong with the rig that took it."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from .. import geometry
from ..capture import Capture, load_capture
from ..errors import StrandscopeError
from ..geometry import Optics
from ..progress import Progress, silent
from .calibrate import RigErrors, write_calibration
from .target import Seen, Target, depth_from_focus, find_corners, measure_corners, opencv
from .target_fit import FIRST_ANGLE, FOCUS, LEAST_CORNERS, UNKNOWNS, Corners, Fit, Model, appear, begin, optics_of, solve

WINDOW = 0.8  # of the white rim of a marker: what is looked at around a corner, each way
# what the scatter of corners does not explain, found on simulated boards: depth from focus of a print, edges of squares under distortion
FLOOR_MM, FLOOR_RIM_PX = 0.003, 0.03
BLURRED = 0.35  # radius of the blur of corners that are measured, in white rims of a marker
STOPPED = 5.0  # times as far from the plane of focus, for photographs at a small aperture


# ---- corners in a capture --------------------------------------------------------------------------------------------


def look(capture: Capture, target: Target, progress: Progress = silent, workers: int = 1) -> tuple[Model, Fit]:
    """Find the corners of the target in every photograph of a capture, and the depth of each from focus; also the rig as it follows from those
    that can be told by the markers beside them. Photographs at a small aperture (``turntable``) tell of places, too, and of no depth.

    First markers are read, which tells where the board is; then all corners are looked for where it must have them, blurred ones too.
    Raises StrandscopeError where there are too few.
    """
    opencv().setNumThreads(1)  # photographs are what is shared out
    shots = [(k, d, file) for k, sweep in enumerate(capture.sweeps) for d, file in zip(sweep.positions_mm, sweep.files, strict=True)]
    angles = [sweep.angle_deg for sweep in capture.sweeps]
    if table := capture.turntable:
        shots += [(len(angles) + i, table.focus_mm, file) for i, file in enumerate(table.files)]
        angles += table.angles_deg
    angles, swept, where = np.array(angles), len(capture.sweeps), str(capture.folder)

    def over(stage, work):
        seen = []
        with ThreadPoolExecutor(max(workers, 1)) as pool:
            for found in _in_order(pool, lambda shot: work(capture.planes(shot[2])[0], *shot[:2]), shots, 2 * max(workers, 1)):
                seen.append(found)
                progress(stage, len(seen), len(shots))
        counts = [len(s.corner) for s in seen]
        sweep, position = (np.repeat([shot[i] for shot in shots], counts) for i in (0, 1))
        return sweep, position, *(np.concatenate([getattr(s, name) for s in seen]) for name in Seen._fields)

    sweep, position, corner, col, row, _ = over("reading markers", lambda plane, _k, _d: find_corners(plane, target))
    if len(corner) < 20 * LEAST_CORNERS:
        raise StrandscopeError(
            f"{where}: {len(corner)} corners of the target are seen in {len(shots)} photographs; expected {20 * LEAST_CORNERS} or more: "
            f"is it a target of {target.columns} x {target.rows} squares, in focus, and evenly lit?"
        )
    told = Corners(sweep, corner, position, col, row, *_middles(sweep, corner, position, col, row, swept), angles, swept)
    model = Model(told, target.corners_mm, capture.optics.ideal(), capture.shape)
    rough = begin(model, where)
    reach = BLURRED * (target.square_mm - target.marker_mm) / 2 / np.tan(np.radians(capture.optics.aperture_cone_deg) / 2)
    rim, every = WINDOW * (target.square_mm - target.marker_mm) / 2 / target.square_mm, np.arange(len(target.corners_mm))

    def measure(plane, k, d):
        place, w = appear(rough.x, model, every, np.full(len(every), k), np.full(len(every), d))
        near = np.abs(w - d - rough.x[FOCUS]) < (reach if k < swept else STOPPED * reach)
        grid = place.reshape(target.rows - 1, target.columns - 1, 2)
        half = rim * np.maximum(np.abs(np.diff(grid, axis=1)).mean(axis=(0, 1)), np.abs(np.diff(grid, axis=0)).mean(axis=(0, 1)))
        return measure_corners(plane, every[near], place[near], half)

    sweep, position, corner, col, row, sharp = over("measuring corners", measure)
    depths = _depths(sweep, corner, position, col, row, sharp, swept, capture.optics.working_distance_mm)
    corners = Corners(sweep, corner, position, col, row, *depths, angles, swept)
    return model._replace(corners=corners), rough


def _in_order(pool: ThreadPoolExecutor, work, items: list, ahead: int) -> Iterator:
    """Results of ``work`` in order; only some are begun ahead, so that photographs do not pile up."""
    running = []
    for item in items:
        running.append(pool.submit(work, item))
        if len(running) >= ahead:
            yield running.pop(0).result()
    for future in running:
        yield future.result()


def _middles(sweep, corner, position, col, row, swept: int):
    """(sweep, corner, position, column, row), arrays (M,): the middle of the positions at which markers beside a corner can be read."""
    found = []
    for own in _by_corner(sweep, corner, position):
        if sweep[own[0]] < swept:
            found.append((sweep[own[0]], corner[own[0]], np.median(position[own]), np.median(col[own]), np.median(row[own])))
    return _columns(found)


def _depths(sweep, corner, position, col, row, sharp, swept: int, distance: float):
    """(sweep, corner, position, column, row), arrays (M,), at which corners of the first ``swept`` sweeps are sharpest."""
    found = []
    for own in _by_corner(sweep, corner, position):
        if sweep[own[0]] < swept and len(own) >= 4:
            d = depth_from_focus(position[own], sharp[own], distance)
            if np.isfinite(d):
                found.append((sweep[own[0]], corner[own[0]], d, np.interp(d, position[own], col[own]), np.interp(d, position[own], row[own])))
    return _columns(found)


def _by_corner(sweep, corner, position) -> Iterator[np.ndarray]:
    """The numbers of the observations of each corner at each angle, by position."""
    order = np.lexsort((position, corner, sweep))
    change = (np.diff(sweep[order]) != 0) | (np.diff(corner[order]) != 0)
    yield from np.split(order, np.flatnonzero(change) + 1)


def _columns(rows: list) -> tuple[np.ndarray, ...]:
    k, corner, d, col, row = np.array(rows, float).reshape(-1, 5).T
    return k.astype(np.int64), corner.astype(np.int64), d, col, row


# ---- what was found --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TargetCalibration:
    """What a printed target tells of a rig, with standard errors."""

    capture: str  # name of the capture of the target
    stated: Optics
    optics: Optics  # as found
    errors: RigErrors  # true minus stated
    uncertain: RigErrors  # standard errors, field by field
    pitch_mm: tuple[float, float]  # of a channel plane, and its standard error
    distortion_px: tuple[float, float]  # at the corner of the image, outwards (barrel: less than 0), and its standard error
    bowl_mm: tuple[float, float]  # by how much nearer to the camera the corner of the image is in focus, and its standard error
    turns_deg: tuple[tuple[float, float, float], ...]  # stated angle, by how much it is turned too far, standard error
    board: dict[str, float]  # how it hangs: facing_deg, lean_deg, roll_deg, right_mm, up_mm, before_mm
    middle_px: tuple[float, float]  # column and row of the middle of the image
    left_px: float  # robust standard deviation that is left, of corners near the plane of focus
    left_mm: float  # and in depth
    corners: int  # that were seen, in all photographs
    photographs: int
    square_mm: float


def summed_up(found: Fit, model: Model, capture: Capture, target: Target) -> TargetCalibration:
    """What a fit says of the rig."""
    optics, stated, half = optics_of(found.x, model), capture.optics, model.half_mm
    distance, pitch = stated.working_distance_mm, stated.pitch_mm

    def told(function, floor: float = 0.0) -> tuple[float, float]:
        """A function of the unknowns by name, and its standard error, ``floor`` at least."""
        spread = np.sqrt(np.diag(found.covariance))
        step = 1e-3 * spread * np.eye(len(spread))
        value, *moved = (function(dict(zip(UNKNOWNS, x, strict=False))) for x in (found.x, *(found.x + step), *(found.x - step)))
        slope = (np.array(moved[: len(step)]) - moved[len(step) :]) / np.maximum(2e-3 * spread, 1e-300)
        return float(value), float(np.sqrt(max(slope @ found.covariance @ slope, 0) + floor**2))

    rows = {
        "axis_px": told(lambda a: a["axis"]),
        "tilt_deg": told(lambda a: np.degrees(a["tilt"]) - stated.tilt_deg),
        "tilt_towards_deg": told(lambda a: np.degrees(a["tilt_towards"]) - stated.tilt_towards_deg),
        "focus_mm": told(lambda a: a["focus"], FLOOR_MM),
        "working_distance_mm": told(lambda a: distance * a["distance"]),
        "pitch_parts": told(lambda a: (1 + a["pitch"]) / (1 + a["distance"]) - 1),
        "travel_deg": told(lambda a: np.degrees(a["travel"]) - stated.travel_deg),
        "travel_up_deg": told(lambda a: np.degrees(a["travel_up"]) - stated.travel_up_deg),
        "k1_per_mm2": told(lambda a: a["k1"] / half**2 - stated.k1_per_mm2),
        "k2_per_mm4": told(lambda a: a["k2"] / half**4 - stated.k2_per_mm4),
    }
    errors, uncertain = (RigErrors(**{name: row[i] for name, row in rows.items()}) for i in (0, 1))
    rim = told(lambda a: (geometry.distort(half, 0.0, a["k1"] / half**2, a["k2"] / half**4)[0] - half) / pitch, FLOOR_RIM_PX)
    turns = _turns(found, model)
    facing, lean, roll = (float(a) for a in np.degrees(found.x[:3]))
    right, up, before = (float(a) for a in found.x[3:6])
    hangs = {"facing_deg": facing, "lean_deg": -lean, "roll_deg": roll, "right_mm": right, "up_mm": up, "before_mm": before}
    return TargetCalibration(
        capture=capture.name,
        stated=stated,
        optics=optics,
        errors=errors,
        uncertain=uncertain,
        pitch_mm=told(lambda a: pitch * (1 + a["pitch"])),
        distortion_px=rim,
        bowl_mm=told(lambda a: a["bowl"]),
        turns_deg=turns,
        board=hangs,
        middle_px=((model.shape[1] - 1) / 2, (model.shape[0] - 1) / 2),
        left_px=found.left_px,
        left_mm=found.left_mm,
        corners=len(model.corners.col),
        photographs=sum(len(s.files) for s in capture.sweeps) + (len(capture.turntable.files) if capture.turntable else 0),
        square_mm=target.square_mm,
    )


def _turns(found: Fit, model: Model) -> tuple[tuple[float, float, float], ...]:
    """(stated angle, how much too far, standard error) of each angle, in degrees. That all are too far is how the board hangs: 0 on average."""
    used = np.unique(model.corners.sweep)
    middle = np.eye(len(used)) - 1 / len(used)
    off = middle @ found.x[FIRST_ANGLE:][used]
    spread = np.sqrt(np.diag(middle @ found.covariance[FIRST_ANGLE:, FIRST_ANGLE:][np.ix_(used, used)] @ middle))
    return tuple((float(a), float(o), float(s)) for a, o, s in zip(model.corners.angles_deg[used], np.degrees(off), np.degrees(spread), strict=True))


def calibrate_by_target(
    capture_path: Path, out: Path | None, target: Target | None = None, *, progress: Progress = silent, workers: int = 1
) -> TargetCalibration:
    """Find what is wrong with a rig from a capture of a printed target; writes it to ``out`` (.json, .toml) and returns it.

    Raises CaptureError for a capture that cannot be read, StrandscopeError without OpenCV, where the target is not seen well enough to
    tell, and where no rig explains what is seen.
    """
    opencv()
    target, capture = target or Target(), load_capture(capture_path)
    if capture.features:
        raise StrandscopeError(f"{capture.folder}: has features in place of photographs; expected photographs of a printed target")
    model, rough = look(capture, target, progress, workers)
    progress("fitting the rig", 0, 1)
    found = solve(model, rough.x, str(capture.folder))
    progress("fitting the rig", 1, 1)
    calibration = summed_up(found, model, capture, target)
    if out is not None:
        save_target_calibration(out, calibration)
    return calibration


def save_target_calibration(path: Path, calibration: TargetCalibration) -> None:
    """Write what a target told as a calibration file that `reconstruct --calibration` reads."""
    write_calibration(path, {"told_by": "target", **asdict(calibration)})
