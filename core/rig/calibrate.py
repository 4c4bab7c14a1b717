"""What is wrong with a rig, from what its photographs show: fibers must coincide across angles.

The errors of the rig are solved together with the fibers (a bundle adjustment). A point of a fiber may move in the two
directions perpendicular to the fiber; each sweep says by how much its observations lie off the point across the line of
sight, to a fraction of a pixel, and along it, to some hundredths of a millimetre. One linear system ties these to the motion
of the points and to the rig; the points are eliminated one by one (Schur complement), and a small system is left.

What the photographs cannot tell is fixed: the first sweep's angle is right by definition, heights are told by
``axis_row_px``, and distances by the stage that moves the camera, through depth from focus.

Depth from focus is off where other hairs are near: a hair that others half cover is seen sharpest behind its true place, and
blurred light of neighbours before it moves the best contrast towards them. Where a hair bends away from the camera, what is
seen of it over a short length lies behind the point. These biases are in the system as unknowns of their own, in proportion
to how faint the hair is, to how the hair around it is shared between before and behind, and to its curvature.
"""

import json
import tomllib
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numba import njit

from ..capture import Capture
from ..errors import StrandscopeError
from ..files import atomic

FORMAT, VERSION = "strandscope-calibration", 1
RIG = ("axis", "tilt", "tilt_towards", "focus", "scale")  # unknowns of the whole rig: mm, rad, rad, mm, parts
BIASES = 3  # and of depth from focus: by crowding, by faintness (mm), by curvature (mm²)
FIRST_SWEEP = len(RIG) + BIASES  # place of the first sweep's angle (rad) among the unknowns
TUKEY = 4.0  # observations this many robust deviations off are not heard
TOLD_BY_TARGETS = ("pitch_parts", "travel_deg", "travel_up_deg", "k1_per_mm2", "k2_per_mm4")  # errors that older files lack
OF_THE_FRAME = ("axis_col_px", "axis_row_px", "aperture_cone_deg")  # stated optics that differ where a photograph is cut out
LEAST_SIGMA_MM = 1e-6
LEAST_SIGHTINGS = 3  # of a point across the line of sight
SURE = 3.0  # an error of this many standard errors is one
SURE_SLIP = 5.0  # and a step of the turntable that slipped
ANGLE_FLOOR_DEG = 0.006  # errors of angles beyond what the sightings' scatter explains, on simulated locks
MOST_SLIPS = 6
BLOCK_PX = 16  # of pictures of the light
BOARD_SHARE, BOARD_BLUE = 0.03, 0.5  # of the blocks, the bluest, that are looked at for the board; the least blue of it
GAIN_FLOOR = 0.0005  # parts, by which reflections of the hair on the board change it


@dataclass(frozen=True)
class RigErrors:
    """By how much a rig is not as capture.json says: true minus stated.

    The plane of focus lies ``working_distance_mm`` farther from the lens than stated while the camera's field of view, an
    angle, is as stated, so that a pixel is wider on the plane of focus in the same proportion. Photographs tell this width;
    of a working distance that is wrong by itself they tell next to nothing.
    """

    axis_px: float = 0.0  # the axis is imaged this much farther right
    tilt_deg: float = 0.0  # its upper end leans to the right in the image
    tilt_towards_deg: float = 0.0  # and towards the camera
    focus_mm: float = 0.0  # planes of focus are this much nearer to the camera
    working_distance_mm: float = 0.0
    angles_deg: tuple[float, ...] = ()  # each sweep is turned this much too far; empty: none
    gains: tuple[tuple[float, ...], ...] = ()  # light of each photograph of each sweep, about 1; empty: all alike
    # what a printed target tells beside the rest, and hair does not
    pitch_parts: float = 0.0  # a pixel is wider by these parts of it than the working distance makes it
    travel_deg: float = 0.0  # the stage leads the camera to the right of its line of sight as it draws back
    travel_up_deg: float = 0.0  # and upwards
    k1_per_mm2: float = 0.0  # distortion, as Optics has it
    k2_per_mm4: float = 0.0

    def corrected(self, capture: Capture) -> Capture:
        """The capture with the optics, positions, angles and gains that it truly has. Raises StrandscopeError if it has other sweeps."""
        optics, distance = capture.optics, capture.optics.working_distance_mm + self.working_distance_mm
        optics = replace(
            optics,
            working_distance_mm=distance,
            pitch_mm=optics.pitch_mm * distance / optics.working_distance_mm * (1 + self.pitch_parts),
            axis_col_px=optics.axis_col_px + self.axis_px,
            tilt_deg=optics.tilt_deg + self.tilt_deg,
            tilt_towards_deg=optics.tilt_towards_deg + self.tilt_towards_deg,
            travel_deg=optics.travel_deg + self.travel_deg,
            travel_up_deg=optics.travel_up_deg + self.travel_up_deg,
            k1_per_mm2=optics.k1_per_mm2 + self.k1_per_mm2,
            k2_per_mm4=optics.k2_per_mm4 + self.k2_per_mm4,
        )
        angles = self.angles_deg or (0.0,) * len(capture.sweeps)
        gains = self.gains or tuple(sweep.gains for sweep in capture.sweeps)
        if len(angles) != len(capture.sweeps) or any(len(g) not in (0, len(s.files)) for g, s in zip(gains, capture.sweeps, strict=False)):
            raise StrandscopeError(f"{capture.folder}: has {len(capture.sweeps)} sweeps; the calibration was made for another capture")
        sweeps = tuple(
            replace(sweep, angle_deg=sweep.angle_deg + angle, positions_mm=tuple(d + self.focus_mm for d in sweep.positions_mm), gains=gain)
            for sweep, angle, gain in zip(capture.sweeps, angles, gains, strict=True)
        )
        turntable = capture.turntable and replace(capture.turntable, focus_mm=capture.turntable.focus_mm + self.focus_mm)
        return replace(capture, optics=optics, sweeps=sweeps, turntable=turntable)

    def plus(self, change: np.ndarray, capture: Capture) -> "RigErrors":
        """These errors of ``capture`` and a ``change`` (unknowns of ``solve``) found with the capture corrected by them."""
        optics = self.corrected(capture).optics
        angles = np.array(self.angles_deg or np.zeros(len(capture.sweeps))) + np.degrees(change[FIRST_SWEEP:])
        return replace(
            self,
            axis_px=float(self.axis_px + change[0] / optics.pitch_mm),
            tilt_deg=float(self.tilt_deg + np.degrees(change[1])),
            tilt_towards_deg=float(self.tilt_towards_deg + np.degrees(change[2])),
            focus_mm=float(self.focus_mm + change[3]),
            working_distance_mm=float(optics.working_distance_mm * (1 + change[4]) - capture.optics.working_distance_mm),
            angles_deg=tuple(float(a) for a in angles),
        )


# ---- the solver ------------------------------------------------------------------------------------------------------


class Sightings(NamedTuple):
    """How observations lie off points of fibers: R rows, those of one point together.

    Seen from its ``sweep``, the point lies at ``at`` (u', v', w) in the frame of the rotation axis, and its observations lie
    off it by ``off`` mm in the direction ``way`` of that frame: in the image, or along the line of sight if ``depth``.
    """

    point: np.ndarray  # (R,) int64, ascending
    sweep: np.ndarray  # (R,) int64
    depth: np.ndarray  # (R,) bool
    off: np.ndarray  # (R,) mm
    way: np.ndarray  # (R, 3) unit
    at: np.ndarray  # (R, 3) mm
    moved: np.ndarray  # (R, 2): what moving the point by 1 mm in either direction perpendicular to the fiber is along ``way``
    crowd: np.ndarray  # (R,) hair around it, before minus behind, -1 … 1
    faint: np.ndarray  # (R,) how much weaker than the clearest hair it is, logarithm
    bend: np.ndarray  # (R,) 1/mm: curvature of the fiber along ``way``


@dataclass(frozen=True)
class Solution:
    """One step towards the true rig."""

    change: np.ndarray  # (8 + sweeps,): what to add to the errors known so far, in the order of RIG, biases, sweeps
    covariance: np.ndarray  # (8 + sweeps, 8 + sweeps)
    points: np.ndarray  # (P,) numbers of the points that were seen
    moves: np.ndarray  # (P, 2) mm: where they go, perpendicular to the fiber
    across_mm: float  # robust standard deviation of what is left, across the line of sight
    depth_mm: float  # and in depth


def solve(sightings: Sightings, sweeps: int, *, tukey: float = TUKEY, biased: bool = True, iterations: int = 15) -> Solution:
    """The errors of the rig by which the sightings agree best, and their covariance. Robust: observations off by ``tukey``
    standard deviations are not heard (Tukey's biweight). Unless ``biased``, depth from focus is taken as it is.

    Raises StrandscopeError where the sightings are too few.
    """
    seen = np.bincount(sightings.point[~sightings.depth], minlength=int(sightings.point.max(initial=-1)) + 1) >= LEAST_SIGHTINGS
    s = Sightings(*(column[seen[sightings.point]] for column in sightings))
    count, kind = FIRST_SWEEP + sweeps, s.depth.astype(np.int64)
    if len(s.point) < 20 * count or not s.depth.any():
        raise StrandscopeError(f"{len(s.point)} sightings of fibers are too few to find {count} errors of a rig; expected {20 * count} or more")
    starts = np.flatnonzero(np.r_[True, np.diff(s.point) != 0, True])
    jacobian = _jacobian(s)
    if not biased:
        jacobian[:, len(RIG) : FIRST_SWEEP] = 0
    rows = (starts, s.sweep, s.moved, s.off, jacobian)
    weight = 1 / np.array([_spread(s.off[kind == 0]), _spread(s.off[kind == 1])])[kind] ** 2
    # the points' own motion takes up scatter across the line of sight, where it is told so much better than in depth
    across = np.count_nonzero(kind == 0)
    fitted = np.array([np.sqrt(across / max(across - 2 * (len(starts) - 1), 1)), 1.0])
    for _ in range(iterations):
        normal, right = _eliminate(*rows, weight, count)
        free = np.setdiff1d(np.flatnonzero(np.diag(normal) > 0), FIRST_SWEEP)
        scale = np.sqrt(np.diag(normal)[free])  # the unknowns have units of their own
        inverse = np.linalg.pinv(normal[np.ix_(free, free)] / np.outer(scale, scale), rcond=1e-12, hermitian=True) / np.outer(scale, scale)
        change = np.zeros(count)
        change[free] = inverse @ right[free]
        left, moves = _residuals(*rows, weight, change)
        sigma = fitted * np.array([_spread(left[kind == 0]), _spread(left[kind == 1])])
        weight = np.clip(1 - (left / (tukey * sigma[kind])) ** 2, 0, None) ** 2 / sigma[kind] ** 2
    covariance = np.zeros((count, count))
    covariance[np.ix_(free, free)] = inverse
    return Solution(change, covariance, s.point[starts[:-1]], moves, float(sigma[0]), float(sigma[1]))


def _spread(values: np.ndarray) -> float:
    """Robust standard deviation about 0."""
    return max(1.4826 * float(np.median(np.abs(values))), LEAST_SIGMA_MM) if len(values) else 1.0


def _jacobian(s: Sightings) -> np.ndarray:
    """(R, 9): by how much the offset of a row grows with each unknown of RIG, each bias, and the angle of its sweep."""
    u, v, w = s.at.T
    zero, one = np.zeros_like(u), np.ones_like(u)
    moves = [(-one, zero, zero), (-v, u, zero), (zero, w, -v), (zero, zero, one), (u, v, zero), (-w, zero, u)]
    rig = [(s.way * np.stack(move, axis=1)).sum(axis=1) for move in moves]
    return np.stack([*rig[:-1], -(s.depth * s.crowd), -(s.depth * s.faint), -(s.depth * s.bend), rig[-1]], axis=1)


@njit(cache=True, nogil=True)
def _eliminate(starts, sweep, moved, off, jacobian, weight, count):
    """Normal matrix (count, count) and right side (count,) of the rig alone, each point's own motion eliminated."""
    shared = jacobian.shape[1] - 1
    normal, right = np.zeros((count, count)), np.zeros(count)
    mixed = np.empty((2, count))
    for p in range(len(starts) - 1):
        mixed[:] = 0.0
        a = b = c = x = y = 0.0
        for r in range(starts[p], starts[p + 1]):
            m0, m1, k = moved[r, 0], moved[r, 1], shared + sweep[r]
            a += weight[r] * m0 * m0
            b += weight[r] * m0 * m1
            c += weight[r] * m1 * m1
            x += weight[r] * m0 * off[r]
            y += weight[r] * m1 * off[r]
            for i in range(shared + 1):
                at = i if i < shared else k
                mixed[0, at] += weight[r] * m0 * jacobian[r, i]
                mixed[1, at] += weight[r] * m1 * jacobian[r, i]
                right[at] -= weight[r] * jacobian[r, i] * off[r]
                for j in range(shared + 1):
                    normal[at, j if j < shared else k] += weight[r] * jacobian[r, i] * jacobian[r, j]
        aa, bb, cc = _inverse(a, b, c)
        for i in range(count):
            if mixed[0, i] == 0 and mixed[1, i] == 0:
                continue
            e, f = aa * mixed[0, i] + bb * mixed[1, i], bb * mixed[0, i] + cc * mixed[1, i]
            right[i] += e * x + f * y
            for j in range(count):
                normal[i, j] -= e * mixed[0, j] + f * mixed[1, j]
    return normal, right


@njit(cache=True, nogil=True)
def _inverse(a, b, c):
    """The inverse of ((a, b), (b, c)), held up where it is all but singular."""
    ridge = 1e-9 * (a + c) + 1e-12
    a, c = a + ridge, c + ridge
    size = a * c - b * b
    return c / size, -b / size, a / size


@njit(cache=True, nogil=True)
def _residuals(starts, sweep, moved, off, jacobian, weight, change):
    """What is left (R,) of the offsets when the rig is changed and every point has moved to its best place; the moves (P, 2)."""
    shared = jacobian.shape[1] - 1
    left, moves = np.empty(len(off)), np.empty((len(starts) - 1, 2))
    for p in range(len(starts) - 1):
        a = b = c = x = y = 0.0
        for r in range(starts[p], starts[p + 1]):
            left[r] = off[r] + jacobian[r, shared] * change[shared + sweep[r]]
            for i in range(shared):
                left[r] += jacobian[r, i] * change[i]
            m0, m1 = moved[r, 0], moved[r, 1]
            a += weight[r] * m0 * m0
            b += weight[r] * m0 * m1
            c += weight[r] * m1 * m1
            x += weight[r] * m0 * left[r]
            y += weight[r] * m1 * left[r]
        aa, bb, cc = _inverse(a, b, c)
        moves[p] = aa * x + bb * y, bb * x + cc * y
        for r in range(starts[p], starts[p + 1]):
            left[r] -= moved[r, 0] * moves[p, 0] + moved[r, 1] * moves[p, 1]
    return left, moves


# ---- steps of the turntable ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Slip:
    """A step of the turntable that went wrong once: sweep ``sweep`` and all later ones are turned ``angle_deg`` too far."""

    sweep: int
    angle_deg: float
    error_deg: float


def turns(angles_deg: np.ndarray, covariance: np.ndarray) -> tuple[tuple[float, float], list[Slip]]:
    """What the errors of the sweeps' angles (n,), with covariance (n, n) in square degrees, have in common: by how much every
    step turns too far, with its standard error, and the steps that slipped. The first angle is 0 by definition.

    A slip or a slope is taken in, the better first, while it is sure by ``SURE_SLIP`` standard errors: many are tried, and the
    errors of neighbouring sweeps, which see the same hair, go together.
    """
    count = len(angles_deg)
    k = np.arange(count)
    # the first sweep is as uncertain as the others: its error is a shift of all others
    inverse = np.linalg.inv(covariance + (ANGLE_FLOOR_DEG**2) * np.eye(count))
    candidates = {0: (k - k.mean()) / max(count - 1, 1), **{i: (k >= i).astype(float) for i in range(1, count)}}
    chosen: list[int] = []
    enough = SURE_SLIP**2
    _, chi = _weighted_fit(angles_deg, inverse, [])
    while len(chosen) < min(count - 2, MOST_SLIPS):
        trials = {i: _weighted_fit(angles_deg, inverse, [candidates[j] for j in [*chosen, i]])[1] for i in candidates if i not in chosen}
        best = min(trials, key=trials.get)
        if chi - trials[best] < enough:
            break
        chi = trials[best]
        chosen.append(best)
    chosen = [i for i in chosen if _needed(i, chosen, candidates, angles_deg, inverse, chi, enough)]
    (values, spread), _ = _weighted_fit(angles_deg, inverse, [candidates[i] for i in chosen])
    found = dict(zip(chosen, zip(values[1:], spread[1:], strict=True), strict=True))
    slope_deg = found.pop(0, (0.0, 0.0))
    every = tuple(float(x) / max(count - 1, 1) for x in slope_deg)
    return every, [Slip(int(i), float(a), float(e)) for i, (a, e) in sorted(found.items())]


def _needed(i, chosen, candidates, angles, inverse, chi, enough) -> bool:
    rest = [candidates[j] for j in chosen if j != i]
    return _weighted_fit(angles, inverse, rest)[1] - chi >= enough


def _weighted_fit(angles, inverse, columns):
    """((values, standard errors), chi squared) of a fit of a constant and the columns."""
    design = np.stack([np.ones(len(angles)), *columns], axis=1)
    covariance = np.linalg.inv(design.T @ inverse @ design)
    values = covariance @ (design.T @ inverse @ angles)
    left = angles - design @ values
    return (values, np.sqrt(np.diag(covariance))), float(left @ inverse @ left)


# ---- light -----------------------------------------------------------------------------------------------------------


def light(planes: np.ndarray) -> np.ndarray:
    """Mean light of blocks of a photograph: planes (3, H, W) -> (3, h, w) float32; what is left at the border is left out."""
    rows, columns = (n // BLOCK_PX for n in planes.shape[1:])
    blocks = planes[:, : rows * BLOCK_PX, : columns * BLOCK_PX].reshape(len(planes), rows, BLOCK_PX, columns, BLOCK_PX)
    return blocks.mean(axis=(2, 4)).astype(np.float32)


def gains(stack: np.ndarray) -> tuple[np.ndarray, float]:
    """Gain (J,) of each photograph of a sweep, 1 on average, from their light (J, 3, h, w) red, green, blue; and the standard
    error of its drift from the first to the last. The error is infinite, and the gains 1, where no board is seen.

    The board stays as it is while the focus moves. It is where the picture is bluest in every photograph and keeps its colour,
    which a gain does not change.
    """
    light = stack.reshape(len(stack), 3, -1).astype(np.float64)
    total = light.sum(axis=1)
    color = light / np.maximum(total[:, None], 1e-9)
    blue = color[:, 2].min(axis=0)
    bluest = np.argsort(-blue, kind="stable")[: max(int(BOARD_SHARE * len(blue)), 4)]
    changes = color[:, :, bluest].std(axis=0).sum(axis=0)
    board = bluest[(changes <= 2 * changes.min()) & (blue[bluest] > BOARD_BLUE)]
    if len(board) < 2 or len(stack) < 3:
        return np.ones(len(stack)), np.inf
    ratio = total[:, board] / total[:, board].mean(axis=0)
    gain = np.median(ratio, axis=1)
    slopes = np.polyfit(np.linspace(-0.5, 0.5, len(stack)), ratio, 1)[0]
    return gain / gain.mean(), float(1.25 * np.std(slopes, ddof=1) / np.sqrt(len(board)))


def drift(gain: np.ndarray) -> float:
    """By how much the light grows from the first to the last photograph, in parts."""
    return float(np.polyfit(np.linspace(-0.5, 0.5, len(gain)), gain, 1)[0]) if len(gain) > 1 else 0.0


# ---- what was found, as a file ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Calibration:
    """The errors of the rig that took a capture, with their standard errors."""

    capture: str  # its name
    errors: RigErrors
    uncertain: RigErrors  # standard errors, field by field
    every_step_deg: tuple[float, float]  # by how much every step of the turntable turns too far, and its standard error
    slips: tuple[Slip, ...]  # steps that went wrong once
    drifts: tuple[tuple[float, float], ...]  # of the light in each sweep, parts, with standard error (infinite: no board seen)
    across_mm: float  # robust standard deviation that is left in the image
    depth_mm: float  # and in depth
    points: int  # of fibers that were seen


def describe(calibration: Calibration) -> list[tuple[str, str] | None]:
    """Rows (name, value with its error and meaning) for people; an error that is not sure is said to be none."""
    errors, uncertain = calibration.errors, calibration.uncertain

    def row(name, value, error, form, unit, meaning):
        sure = "" if abs(value) >= SURE * error else "; none that is sure"
        return name, f"{value:+{form}} ± {error:{form}} {unit}  {meaning}{sure}"

    rows = [
        row("axis", errors.axis_px, uncertain.axis_px, ".3f", "px", "to the right"),
        row("tilt", errors.tilt_deg, uncertain.tilt_deg, ".4f", "°", "its upper end to the right"),
        row("tilt towards", errors.tilt_towards_deg, uncertain.tilt_towards_deg, ".4f", "°", "its upper end towards the camera"),
        row("focus", errors.focus_mm, uncertain.focus_mm, ".4f", "mm", "towards the camera"),
        row("working distance", errors.working_distance_mm, uncertain.working_distance_mm, ".2f", "mm", "with the camera's field of view as stated"),
    ]
    rows += [(name, f"{value:+{form}} {unit}  as the target told") for name, value, form, unit in of_lens(errors) if value]
    if calibration.every_step_deg != (0.0, 0.0):
        rows.append(row("every step", *calibration.every_step_deg, ".4f", "°", "too far"))
    rows += [row(f"step to sweep {s.sweep}", s.angle_deg, s.error_deg, ".4f", "°", "too far, once") for s in calibration.slips]
    off, known = np.array(errors.angles_deg), np.array(uncertain.angles_deg)
    rows.append(("sweeps", f"{off.min():+.4f} … {off.max():+.4f} °, each ± {np.median(known[1:] if len(known) > 1 else known):.4f}"))
    told = [(value, error) for value, error in calibration.drifts if np.isfinite(error)]
    if told:
        value, error = np.mean([v for v, _ in told]), np.sqrt(np.sum([e**2 for _, e in told])) / len(told)
        rows.append(
            row("gain", 100 * value, 100 * max(error, GAIN_FLOOR), ".2f", "%", "from the first to the last photograph of a sweep, on average")
        )
    else:
        rows.append(("gain", "not told: no blue board is seen in the photographs"))
    rows += [
        None,
        (
            "left over",
            f"{1000 * calibration.across_mm:.1f} µm in the image, {1000 * calibration.depth_mm:.0f} µm in depth, at {calibration.points} points",
        ),
    ]
    return rows


def of_lens(errors: RigErrors) -> list[tuple[str, float, str, str]]:
    """(name, value, format, unit) of the errors that only a printed target tells."""
    return [
        ("pitch", 100 * errors.pitch_parts, ".3f", "%"),
        ("travel", errors.travel_deg, ".4f", "°"),
        ("travel up", errors.travel_up_deg, ".4f", "°"),
        ("distortion k1", errors.k1_per_mm2, ".3g", "1/mm²"),
        ("distortion k2", errors.k2_per_mm4, ".3g", "1/mm⁴"),
    ]


def save_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration as JSON, or TOML if the file's name ends so, atomically."""
    drifts = [[value, error if np.isfinite(error) else -1.0] for value, error in calibration.drifts]
    write_calibration(path, asdict(calibration) | {"drifts": drifts})


def write_calibration(path: Path, told: dict) -> None:
    """Write what a calibration tells, with its ``errors`` those of RigErrors, as JSON, or TOML if the file's name ends so, atomically."""
    head = {"format": FORMAT, "version": VERSION, **told}
    if Path(path).suffix == ".toml":
        import tomli_w

        text = tomli_w.dumps(head)
    else:
        text = json.dumps(head, indent=1) + "\n"
    with atomic(path) as part:
        part.write_text(text, encoding="utf-8")


def load_errors(path: Path) -> RigErrors:
    """The errors of a rig from a calibration file. Raises StrandscopeError, naming file and field, for one that is damaged."""
    path = Path(path)
    errors = read_calibration(path).get("errors")
    if not isinstance(errors, dict):
        raise StrandscopeError(f"{path}: errors is missing; expected a table of the rig's errors")
    told = {name: errors.get(name, default if name in TOLD_BY_TARGETS else None) for name, default in asdict(RigErrors()).items()}
    return RigErrors(**{name: _checked(path, f"errors.{name}", told[name], default) for name, default in asdict(RigErrors()).items()})


def read_calibration(path: Path) -> dict:
    """What a calibration file holds. Raises StrandscopeError where it is none."""
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
        head = tomllib.loads(text) if path.suffix == ".toml" else json.loads(text)
    except FileNotFoundError as error:
        raise StrandscopeError(f"{path}: not found; expected a calibration (`strandscope calibrate` makes one)") from error
    except (ValueError, RecursionError) as error:
        raise StrandscopeError(f"{path}: not a calibration: {error}") from error
    if not isinstance(head, dict) or head.get("format") != FORMAT or head.get("version") != VERSION:
        raise StrandscopeError(f'{path}: not a calibration; expected "format": "{FORMAT}", "version": {VERSION}')
    return head


def calibrated(path: Path, capture: Capture) -> Capture:
    """``capture`` as the rig of a calibration file truly took it.

    Errors are true minus stated: a calibration that says for which stated optics it was made, as one from a printed target does, holds
    for captures that state the same. Raises StrandscopeError for others, and for a file that is damaged.
    """
    errors, stated = load_errors(path), read_calibration(path).get("stated")
    for name, value in (stated if isinstance(stated, dict) else {}).items():
        own = getattr(capture.optics, name, None)
        if isinstance(own, float) and name not in OF_THE_FRAME and abs(own - _checked(path, f"stated.{name}", value, 0.0)) > 1e-6 * abs(own):
            raise StrandscopeError(
                f"{path}: was made for a rig stated with {name} {value:g}; {capture.folder} states {own:g}: import or capture it with the optics "
                "that the target was photographed with, or leave --calibration away if it was captured with the calibration already"
            )
    return errors.corrected(capture)


def _checked(path: Path, name: str, value, default):
    """A number, a list of numbers or a list of lists, as the field has it."""
    if isinstance(default, float):
        if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e6:
            return float(value)
        raise StrandscopeError(f"{path}: {name} is {value!r}; expected a number")
    if not isinstance(value, list):
        raise StrandscopeError(f"{path}: {name} is {value!r}; expected a list")
    inner = () if name.endswith("gains") else 0.0
    return tuple(_checked(path, f"{name}[{i}]" if inner == 0.0 else name.replace("gains", f"gain[{i}]"), v, inner) for i, v in enumerate(value))
