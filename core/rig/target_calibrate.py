"""A capture of a printed target -> what is wrong with the rig that took it, in numbers and in words."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from .. import geometry
from ..capture import Capture, load_capture
from ..errors import StrandscopeError
from ..geometry import Optics
from ..progress import Progress, silent
from .calibrate import SURE, RigErrors, write_calibration
from .target import Seen, Target, depth_from_focus, find_corners, measure_corners, opencv
from .target_fit import FIRST_ANGLE, FOCUS, LEAST_CORNERS, UNKNOWNS, Corners, Fit, Model, appear, begin, optics_of, solve

WINDOW = 0.8  # of the white rim of a marker: what is looked at around a corner, each way
BLURRED = 0.35  # radius of the blur of corners that are measured, in white rims of a marker
STOPPED = 5.0  # times as far from the plane of focus, for photographs at a small aperture


# ---- corners in a capture --------------------------------------------------------------------------------------------


def look(capture: Capture, target: Target, progress: Progress = silent, workers: int = 1) -> tuple[Model, Fit]:
    """Find the corners of the target in every photograph of a capture, and the depth of each from focus; also the rig as it follows from those
    that can be told by the markers beside them. Photographs at a small aperture (``turntable``) tell of places, too, and of no depth.

    First markers are read, which tells where the board is; then all corners are looked for where it must have them, blurred ones too.
    Raises StrandscopeError where there are too few.
    """
    opencv()
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
    x, names = found.x, list(UNKNOWNS)
    optics = optics_of(x, model)
    spread = dict(zip(names, np.sqrt(np.diag(found.covariance)), strict=False))
    value = dict(zip(names, x, strict=False))

    def error_of(function) -> float:
        """Standard error of a function of the unknowns."""
        steps = np.sqrt(np.diag(found.covariance)) * 1e-3
        slope = np.array([(function(x + s * e) - function(x - s * e)) / (2 * s) if s else 0.0 for s, e in zip(steps, np.eye(len(x)), strict=True)])
        return float(np.sqrt(max(slope @ found.covariance @ slope, 0)))

    def parts(x):
        distance, pitch = x[names.index("distance")], x[names.index("pitch")]
        return (1 + pitch) / (1 + distance) - 1

    def rim(x):
        """How far outwards the lens puts what belongs to the corner of the image, px."""
        half = model.half_mm
        return (
            geometry.distort(half, 0.0, x[names.index("k1")] / half**2, x[names.index("k2")] / half**4)[0] / model.stated.pitch_mm
            - half / model.stated.pitch_mm
        )

    distance = capture.optics.working_distance_mm
    errors = RigErrors(
        axis_px=float(value["axis"]),
        tilt_deg=optics.tilt_deg,
        tilt_towards_deg=optics.tilt_towards_deg,
        focus_mm=float(value["focus"]),
        working_distance_mm=float(distance * value["distance"]),
        pitch_parts=float(parts(x)),
        travel_deg=optics.travel_deg,
        travel_up_deg=optics.travel_up_deg,
        k1_per_mm2=float(optics.k1_per_mm2),
        k2_per_mm4=float(optics.k2_per_mm4),
    )
    uncertain = RigErrors(
        axis_px=float(spread["axis"]),
        tilt_deg=float(np.degrees(spread["tilt"])),
        tilt_towards_deg=float(np.degrees(spread["tilt_towards"])),
        focus_mm=float(spread["focus"]),
        working_distance_mm=float(distance * spread["distance"]),
        pitch_parts=error_of(parts),
        travel_deg=float(np.degrees(spread["travel"])),
        travel_up_deg=float(np.degrees(spread["travel_up"])),
        k1_per_mm2=float(spread["k1"] / model.half_mm**2),
        k2_per_mm4=float(spread["k2"] / model.half_mm**4),
    )
    stated = capture.optics  # what was stated of lean, travel and distortion was not used in finding them
    for name in ("tilt_deg", "tilt_towards_deg", "travel_deg", "travel_up_deg", "k1_per_mm2", "k2_per_mm4"):
        errors = replace(errors, **{name: getattr(errors, name) - getattr(stated, name)})
    used = np.unique(model.corners.sweep)
    turned = np.degrees(np.stack([x[FIRST_ANGLE:], np.sqrt(np.diag(found.covariance))[FIRST_ANGLE:]], axis=-1))[used]
    turns = tuple((float(a), float(t), float(s)) for a, (t, s) in zip(model.corners.angles_deg[used], turned, strict=True))
    facing, lean, roll = (float(a) for a in np.degrees(x[:3]))
    hangs = {"facing_deg": facing, "lean_deg": -lean, "roll_deg": roll, "right_mm": float(x[3]), "up_mm": float(x[4]), "before_mm": float(x[5])}
    return TargetCalibration(
        capture=capture.name,
        stated=stated,
        optics=optics,
        errors=errors,
        uncertain=uncertain,
        pitch_mm=(float(optics.pitch_mm), float(stated.pitch_mm * spread["pitch"])),
        distortion_px=(float(rim(x)), error_of(rim)),
        bowl_mm=(float(value["bowl"]), float(spread["bowl"])),
        turns_deg=turns,
        board=hangs,
        middle_px=((model.shape[1] - 1) / 2, (model.shape[0] - 1) / 2),
        left_px=found.left_px,
        left_mm=found.left_mm,
        corners=len(model.corners.col),
        photographs=sum(len(s.files) for s in capture.sweeps) + (len(capture.turntable.files) if capture.turntable else 0),
        square_mm=target.square_mm,
    )


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


# ---- in words --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Alignment:
    """How far off the paper's alignments a rig may be before someone should turn a screw. What is below is corrected by numbers."""

    axis_mm: float = 2.0  # from the middle of the image
    tilt_deg: float = 0.5  # of the axis in the image, and towards the camera
    travel_deg: float = 0.5  # between the stage and the line of sight
    focus_mm: float = 1.0
    distance_parts: float = 0.03
    pitch_parts: float = 0.03
    distortion_px: float = 8.0
    bowl_mm: float = 0.6
    turn_deg: float = 0.05
    left_px: float = 0.3


def warnings(found: TargetCalibration, allowed: Alignment = Alignment()) -> list[str]:
    """What should be set right on the rig itself, and which screw does it; empty for one that is well aligned."""
    optics, stated, told = found.optics, found.stated, []

    def warn(value: float, error: float, most: float, text: str) -> None:
        if abs(value) > most and abs(value) > SURE * error:
            told.append(text)

    right_mm = (optics.axis_col_px - found.middle_px[0]) * optics.pitch_mm
    side, other = ("right", "left") if right_mm > 0 else ("left", "right")
    warn(
        right_mm,
        0.0,
        allowed.axis_mm,
        f"the axis is {abs(right_mm):.1f} mm {side} of the middle of the image: move the turntable to the {other} by that, or the camera to the {side}",
    )
    way = "clockwise" if optics.tilt_deg > 0 else "counterclockwise"
    warn(
        optics.tilt_deg,
        found.uncertain.tilt_deg,
        allowed.tilt_deg,
        f"the axis leans {abs(optics.tilt_deg):.2f}° to the {'right' if optics.tilt_deg > 0 else 'left'} in the image: loosen the camera's collar and turn it {way} by that, seen from behind it, or level the turntable",
    )
    way = "down at it: point the lens up" if optics.tilt_towards_deg > 0 else "up at it: point the lens down"
    warn(
        optics.tilt_towards_deg,
        found.uncertain.tilt_towards_deg,
        allowed.tilt_deg,
        f"the camera looks {abs(optics.tilt_towards_deg):.2f}° {way} by that (the screw under the camera plate), or level the turntable",
    )
    way = "left" if optics.travel_deg > 0 else "right"
    warn(
        optics.travel_deg,
        found.uncertain.travel_deg,
        allowed.travel_deg,
        f"the stage leads the camera {abs(optics.travel_deg):.2f}° off its line of sight as it draws back: loosen the camera on the stage and turn the lens to the {way} by that",
    )
    way = "down" if optics.travel_up_deg > 0 else "up"
    warn(
        optics.travel_up_deg,
        found.uncertain.travel_up_deg,
        allowed.travel_deg,
        f"the stage leads the camera {abs(optics.travel_up_deg):.2f}° {'up' if optics.travel_up_deg > 0 else 'down'} as it draws back: tip the lens {way} by that on the stage, or level the stage",
    )
    way = "towards" if found.errors.focus_mm > 0 else "away from"
    warn(
        found.errors.focus_mm,
        found.uncertain.focus_mm,
        allowed.focus_mm,
        f"the plane of focus is {abs(found.errors.focus_mm):.2f} mm {'nearer to' if way == 'towards' else 'farther from'} the camera than the stage says: set the stage's zero anew by that, or turn the focus ring back and tape it",
    )
    off = optics.working_distance_mm / stated.working_distance_mm - 1
    warn(
        off,
        found.uncertain.working_distance_mm / stated.working_distance_mm,
        allowed.distance_parts,
        f"the working distance is {optics.working_distance_mm:.0f} mm, stated {stated.working_distance_mm:.0f}: correct the statement, or turn the focus ring",
    )
    off = optics.pitch_mm / stated.pitch_mm - 1
    warn(
        off,
        found.pitch_mm[1] / stated.pitch_mm,
        allowed.pitch_parts,
        f"a millimetre is {1 / optics.pitch_mm:.2f} px, stated {1 / stated.pitch_mm:.2f}: correct the statement, or turn the focus ring and set the distance anew",
    )
    warn(
        found.distortion_px[0],
        found.distortion_px[1],
        allowed.distortion_px,
        f"the lens distorts by {abs(found.distortion_px[0]):.1f} px at the corner of the image: it is corrected, but a macro lens should do better",
    )
    warn(
        found.bowl_mm[0],
        found.bowl_mm[1],
        allowed.bowl_mm,
        f"the corners of the image are in focus {abs(found.bowl_mm[0]):.2f} mm {'before' if found.bowl_mm[0] > 0 else 'behind'} its middle, which is not corrected: keep the hair in the middle, or close the aperture",
    )
    for angle, turned, error in found.turns_deg:
        warn(
            turned,
            error,
            allowed.turn_deg,
            f"the turntable is turned {turned:+.3f}° too far at {angle:g}°: check its degrees per step, its belt and that it always turns the same way",
        )
    if found.left_px > allowed.left_px:
        told.append(f"corners lie {found.left_px:.2f} px off what was found: is the print flat (glued to glass), and did all stand still?")
    return told


def describe(found: TargetCalibration) -> list[tuple[str, str] | None]:
    """Rows (name, value with its error and meaning) for people; an error that is not sure is said to be none."""
    errors, uncertain, pitch = found.errors, found.uncertain, found.optics.pitch_mm

    def row(name, value, error, form, unit, meaning):
        sure = "" if abs(value) >= SURE * error else "; none that is sure"
        return name, f"{value:+{form}} ± {error:{form}} {unit}  {meaning}{sure}"

    off = 100 * (pitch / found.stated.pitch_mm - 1)
    turned = np.array(found.turns_deg)
    return [
        row("axis", errors.axis_px, uncertain.axis_px, ".3f", "px", f"to the right, {errors.axis_px * pitch:+.4f} mm"),
        row("tilt", errors.tilt_deg, uncertain.tilt_deg, ".4f", "°", "its upper end to the right"),
        row("tilt towards", errors.tilt_towards_deg, uncertain.tilt_towards_deg, ".4f", "°", "its upper end towards the camera"),
        row("focus", errors.focus_mm, uncertain.focus_mm, ".4f", "mm", "towards the camera"),
        row("working distance", errors.working_distance_mm, uncertain.working_distance_mm, ".2f", "mm", "farther from the lens"),
        row("pitch", off, 100 * found.pitch_mm[1] / pitch, ".4f", "%", f"wider: {pitch:.7f} mm, {1 / pitch:.4f} px a mm"),
        row("travel", errors.travel_deg, uncertain.travel_deg, ".4f", "°", "the stage leads to the right"),
        row("travel up", errors.travel_up_deg, uncertain.travel_up_deg, ".4f", "°", "and upwards"),
        row(
            "distortion",
            *found.distortion_px,
            ".2f",
            "px",
            f"outwards at the corner of the image (k1 {errors.k1_per_mm2:.3g} 1/mm², k2 {errors.k2_per_mm4:.3g} 1/mm⁴)",
        ),
        row("bowl", *found.bowl_mm, ".3f", "mm", "the corner of the image is in focus before its middle; not corrected"),
        ("turntable", f"{turned[:, 1].min():+.4f} … {turned[:, 1].max():+.4f} °, each ± {np.median(turned[:, 2]):.4f}"),
        (
            "board",
            "{facing_deg:+.2f}° turned, leaning {lean_deg:.2f}° back, rolled {roll_deg:+.2f}°, {right_mm:+.2f} mm right of the axis, {before_mm:+.2f} mm before it".format(
                **found.board
            ),
        ),
        None,
        (
            "left over",
            f"{found.left_px:.3f} px, {1000 * found.left_px * pitch:.1f} µm, in the image, {1000 * found.left_mm:.0f} µm in depth; {found.corners} corners in {found.photographs} photographs",
        ),
    ]
