"""What is wrong with a rig, from photographs of a printed target: a flat board of squares and markers (ChArUco) on the rotation axis.

The board is turned to some angles, and at each the plane of focus is swept through it, as for hair. Of every corner between squares the
photographs tell two things: where it appears, to some hundredths of a pixel, and at which position it is sharpest, to some hundredths of a
millimetre. The board is flat and of a known size, but hangs anyhow: not quite on the axis, leaning, twisted. Its place is solved for
together with the optics, by robust least squares with the formulas of geometry.py. OpenCV finds corners, and does nothing else.

What each is told by: the pitch by the squares' size; the working distance by how the board's perspective changes when it is turned; the axis
by the circles that corners run on; the focus by the depth at which corners are sharpest against the depth at which the circles have them;
the stage's travel by how the picture of the board moves while the plane of focus goes through it; distortion by straight rows of corners.
Where the optical axis meets the image cannot be told from where it does not: across the columns it is a turn of the board, and along the
rows a lean towards the camera, but for the depth from focus. The fit is free in that (``centre``), and then depth alone tells the lean.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from .. import geometry
from ..errors import StrandscopeError
from ..geometry import Optics

LEAST_CORNERS = 8  # that a fit is tried with
LEAST_SPREAD_DEG = 20.0  # between the first angle and the last
TUKEY = 4.5  # observations this many robust deviations off are not heard
LEAST_SIGMA_PX, LEAST_SIGMA_MM = 0.005, 0.002
ANGLE_PRIOR_DEG = 0.2  # the turntable turns as stated, within this
BLURS = 4  # groups of observations by how much they are blurred; each has a scatter of its own
FACING_DEG = (0.0, -25.0, 25.0, -50.0, 50.0)  # how far from facing the camera the board may be, on average, to begin with
THINNED, ROUGH_ROUNDS, ROUNDS = 600, 4, 6
DOUBTED = 0.15  # from this share of what follows on, a turntable or a stage that goes the other way is thought of
WRONG_PX, WRONG_MM = 2.0, 2.0  # what may be left in the image and in depth; from this on the rig is another than was thought


class Corners(NamedTuple):
    """Corners of the target in all photographs, N, and the depths at which they are sharpest, M."""

    sweep: np.ndarray  # (N,) int64
    corner: np.ndarray  # (N,) int64
    position_mm: np.ndarray  # (N,) of the photograph, as stated
    col: np.ndarray  # (N,) px
    row: np.ndarray  # (N,) px
    focus_sweep: np.ndarray  # (M,) int64
    focus_corner: np.ndarray  # (M,) int64
    focus_mm: np.ndarray  # (M,) stated position at which it is sharpest
    focus_col: np.ndarray  # (M,) px there
    focus_row: np.ndarray  # (M,) px
    angles_deg: np.ndarray  # (sweeps,) as stated; those of the photographs at a small aperture follow those of the sweeps
    swept: int  # how many are sweeps


# ---- where the unknowns have the corners ---------------------------------------------------------------------------------------------------------

# what is solved for, with how far off it may be before anything is seen; the angles of the sweeps follow
UNKNOWNS = {
    "turn": np.inf, "nod": np.inf, "roll": np.inf,  # rad: how the board hangs, about y, x, z
    "x": np.inf, "y": np.inf, "z": np.inf,  # mm: where its middle is
    "axis": np.inf, "tilt": 0.1, "tilt_towards": 0.1,  # px, rad
    "focus": np.inf, "distance": 0.2, "pitch": np.inf,  # mm, parts, parts
    "travel": 0.05, "travel_up": 0.05,  # rad
    "k1": 0.05, "k2": 0.05,  # parts at the corner of the image
    "centre": 1.0,  # mm: where the optical axis meets the image, above axis_row_px
    "bowl": 1.0,  # mm: by how much farther towards the camera the corner of the image is in focus than its middle
}  # fmt: skip
FIRST_ANGLE = len(UNKNOWNS)
FOCUS, _CENTRE, _BOWL = (list(UNKNOWNS).index(name) for name in ("focus", "centre", "bowl"))


class Model(NamedTuple):
    """What stays while the unknowns are solved for."""

    corners: Corners
    board_mm: np.ndarray  # (n, 2)
    stated: Optics
    shape: tuple[int, int]

    @property
    def half_mm(self) -> float:
        """From the middle of the image to its corner, as stated."""
        return 0.5 * float(np.hypot(*self.shape)) * self.stated.pitch_mm


def optics_of(x: np.ndarray, model: Model) -> Optics:
    """The optics that the unknowns stand for."""
    a, stated = dict(zip(UNKNOWNS, x, strict=False)), model.stated
    return replace(
        stated,
        working_distance_mm=stated.working_distance_mm * (1 + a["distance"]),
        pitch_mm=stated.pitch_mm * (1 + a["pitch"]),
        axis_col_px=stated.axis_col_px + a["axis"],
        tilt_deg=float(np.degrees(a["tilt"])),
        tilt_towards_deg=float(np.degrees(a["tilt_towards"])),
        travel_deg=float(np.degrees(a["travel"])),
        travel_up_deg=float(np.degrees(a["travel_up"])),
        k1_per_mm2=a["k1"] / model.half_mm**2,
        k2_per_mm4=a["k2"] / model.half_mm**4,
    )


def rotation(turn: float, nod: float, roll: float) -> np.ndarray:
    """(3, 3): rolled about z, then nodding about x, then turned about y, as the turntable turns. Angles in rad."""
    (ct, cn, cr), (st, sn, sr) = np.cos([turn, nod, roll]), np.sin([turn, nod, roll])
    return (
        np.array([[ct, 0, st], [0, 1, 0], [-st, 0, ct]])
        @ np.array([[1, 0, 0], [0, cn, -sn], [0, sn, cn]])
        @ np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    )


def _camera(x: np.ndarray, model: Model, optics: Optics, corner: np.ndarray, sweep: np.ndarray) -> tuple[np.ndarray, ...]:
    """(u', v', w) of corners of the board in sweeps, mm of the camera's frame."""
    board = model.board_mm[corner]
    points = board @ rotation(*x[:3])[:, :2].T + x[3:6]
    theta = np.radians(model.corners.angles_deg[sweep]) + x[FIRST_ANGLE:][sweep]
    return geometry.tilt(*geometry.turn(*points.T, np.cos(theta), np.sin(theta)), *geometry.tilt_of(optics))


def appear(x: np.ndarray, model: Model, corner: np.ndarray, sweep: np.ndarray, position_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where photographs show corners (N,) of the board in sweeps at stated positions: (N, 2) of column, row, and w (N,) mm."""
    optics = optics_of(x, model)
    (col, row), w = _undistorted(x, model, optics, corner, sweep, position_mm)
    return np.stack(geometry.as_photographed(col, row, 0.0, _still(optics), model.shape), axis=-1), w


def _undistorted(x, model, optics, corner, sweep, position_mm):
    """(column, row) (N,) and w (N,) of corners as a lens without distortion would show them."""
    u, v, w = _camera(x, model, optics, corner, sweep)
    d = position_mm + x[FOCUS]
    right, up = geometry.travelled(optics, d)
    u, v = geometry.project(u - right, v - up - x[_CENTRE], w, d, optics.working_distance_mm)
    return geometry.to_pixel(u, v + x[_CENTRE], optics.pitch_mm, optics.axis_col_px, optics.axis_row_px), w


def _still(optics: Optics) -> Optics:
    """Optics of which only the distortion is left for ``set_right``: the stage's travel is in the perspective already."""
    return replace(optics, travel_deg=0.0, travel_up_deg=0.0)


def misses(x: np.ndarray, model: Model) -> tuple[np.ndarray, np.ndarray]:
    """By how much corners are seen off where the unknowns have them: (N, 2) px, and (M,) mm in depth."""
    seen, optics = model.corners, optics_of(x, model)
    (col, row), _ = _undistorted(x, model, optics, seen.corner, seen.sweep, seen.position_mm)
    at_col, at_row = geometry.set_right(seen.col, seen.row, 0.0, _still(optics), model.shape)
    w = _camera(x, model, optics, seen.focus_corner, seen.focus_sweep)[2]
    middle = (np.array(model.shape[::-1]) - 1) / 2
    rim = np.hypot(seen.focus_col - middle[0], seen.focus_row - middle[1]) * model.stated.pitch_mm / model.half_mm
    return np.stack([at_col - col, at_row - row], axis=-1), seen.focus_mm + x[FOCUS] + x[_BOWL] * rim**2 - w


@dataclass(frozen=True)
class Fit:
    """The unknowns at which the corners agree best."""

    x: np.ndarray  # (18 + sweeps,) in the order of UNKNOWNS, then the angles, rad
    covariance: np.ndarray
    left_px: float  # robust standard deviation of what is left, of corners near the plane of focus
    left_mm: float  # and in depth
    heard: float  # share of the observations that agree

    @property
    def wrong(self) -> float:
        """More than 1 where this is not how the corners were seen: a board that is turned the other way looks alike but for its depths."""
        return max(self.left_px / WRONG_PX, self.left_mm / WRONG_MM)

    @property
    def doubt(self) -> float:
        """The same, more by the image: what moves away instead of nearer is seen there, by little."""
        return 4 * self.left_px / WRONG_PX + self.left_mm / WRONG_MM


def fit(model: Model, start: np.ndarray, rounds: int = ROUNDS, steps: int = 20) -> Fit:
    """Robust least squares: Tukey's biweight, scatter by how blurred a corner is. Corners of an angle stay where they are from photograph
    to photograph, and so does what is wrong with how they are seen: the covariance takes them together."""
    from scipy.optimize import least_squares
    from threadpoolctl import threadpool_limits

    prior = np.r_[list(UNKNOWNS.values()), np.full(len(start) - FIRST_ANGLE, np.radians(ANGLE_PRIOR_DEG))]
    x = np.asarray(start, float)
    for _ in range(rounds):
        off_px, off_mm = misses(x, model)
        blur = _blur_groups(x, model)
        sigma_px = np.array([max(_spread(off_px[blur == g]), LEAST_SIGMA_PX) for g in range(BLURS + 1)])[blur]
        sigma_mm = max(_spread(off_mm), LEAST_SIGMA_MM)
        weight_px = _biweight(np.hypot(*off_px.T) / (np.sqrt(2) * sigma_px)) / sigma_px
        weight_mm = _biweight(off_mm / sigma_mm) / sigma_mm

        def residuals(x, weight_px=weight_px, weight_mm=weight_mm):
            off_px, off_mm = misses(x, model)
            return np.concatenate([(off_px * weight_px[:, None]).ravel(), off_mm * weight_mm, x / prior])

        with threadpool_limits(1, "blas"):  # the matrices are slim: threads would wait for each other, for seconds on a busy machine
            solved = least_squares(residuals, x, x_scale="jac", method="trf", max_nfev=steps)
        x = solved.x
    off_px, off_mm = misses(x, model)
    left_px = _spread(off_px[blur == 0]) if np.any(blur == 0) else _spread(off_px)
    return Fit(x, _covariance(solved, model), left_px, _spread(off_mm), float(np.mean(np.r_[weight_px, weight_mm] > 0)))


def _blur_groups(x: np.ndarray, model: Model) -> np.ndarray:
    """Number (N,) of the group of each observation by its distance from the plane of focus, a quarter each; those at a small aperture are
    a group of their own."""
    seen = model.corners
    w = _camera(x, model, optics_of(x, model), seen.corner, seen.sweep)[2]
    off = np.abs(seen.position_mm + x[FOCUS] - w)
    swept = seen.sweep < seen.swept
    edges = np.quantile(off[swept], np.arange(1, BLURS) / BLURS) if swept.any() else np.zeros(BLURS - 1)
    return np.where(swept, np.searchsorted(edges, off), BLURS)


def _biweight(t: np.ndarray) -> np.ndarray:
    """Square root of Tukey's weight of residuals of t robust deviations."""
    return np.clip(1 - (t / TUKEY) ** 2, 0, None)


def _spread(values: np.ndarray) -> float:
    """Robust standard deviation about 0."""
    return 1.4826 * float(np.median(np.abs(values))) if np.size(values) else 0.0


def _covariance(solved, model: Model) -> np.ndarray:
    """That of the unknowns, by the scatter of the observations of each corner at each angle together."""
    seen, rows = model.corners, 2 * len(model.corners.col)
    scale = np.linalg.norm(solved.jac, axis=0)
    jacobian = solved.jac / scale
    inverse = np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-14, hermitian=True)
    group = np.r_[np.repeat(seen.sweep * len(model.board_mm) + seen.corner, 2), -1 - np.arange(len(seen.focus_mm))]
    _, group = np.unique(group, return_inverse=True)
    told = rows + len(seen.focus_mm)
    scores = np.zeros((group.max() + 1, len(scale)))
    np.add.at(scores, group, jacobian[:told] * solved.fun[:told, None])
    prior = jacobian[told:]
    return inverse @ (scores.T @ scores + prior.T @ prior) @ inverse / np.outer(scale, scale)


def begin(model: Model, where: str) -> Fit:
    """A first fit, from no knowledge of how the board hangs. Raises StrandscopeError where the angles do not suffice, and for a turntable or
    a stage that goes the other way."""
    corners = model.corners
    angles = corners.angles_deg[np.unique(corners.sweep)]
    if np.ptp(angles) < LEAST_SPREAD_DEG:
        raise StrandscopeError(
            f"{where}: the target is seen at angles of {angles.min():g}° to {angles.max():g}°; expected {LEAST_SPREAD_DEG:g}° or more between"
        )
    rough = _rough(model)
    if rough.wrong > DOUBTED:
        others = {"the turntable turns": _rough(_turned(model)), "the stage moves": _rough(_backwards(model))}
        others["turntable and stage both go"] = _rough(_turned(_backwards(model)))
        best = min(others, key=lambda what: others[what].doubt)
        if others[best].doubt < 0.4 * rough.doubt:
            raise StrandscopeError(f"{where}: {best} the other way than the capture says; change the sign where the rig is configured")
    return rough


def solve(model: Model, start: np.ndarray, where: str) -> Fit:
    """The fit to all corners. Raises StrandscopeError where they do not suffice, and where no rig explains them."""
    corners = model.corners
    if len(corners.focus_mm) < LEAST_CORNERS:
        raise StrandscopeError(
            f"{where}: only {len(corners.focus_mm)} corners come into focus and leave it again; expected {LEAST_CORNERS} or more: "
            "sweep on until all of the board has been sharp, in steps of 1 mm or less"
        )
    found = fit(model, start)
    if found.wrong > 1 or found.heard < 0.5:
        raise StrandscopeError(
            f"{where}: corners lie {found.left_px:.1f} px and {found.left_mm:.1f} mm in depth off any rig that was tried: is the board "
            "flat, did it stand still while the stage moved, and are angles and positions right?"
        )
    return found


def _turned(model: Model) -> Model:
    return model._replace(corners=model.corners._replace(angles_deg=-model.corners.angles_deg))


def _backwards(model: Model) -> Model:
    return model._replace(corners=model.corners._replace(position_mm=-model.corners.position_mm, focus_mm=-model.corners.focus_mm))


def _rough(model: Model) -> Fit:
    """The best of fits to some of the corners, from boards that face the camera at several angles."""
    seen = model.corners
    some = np.linspace(0, len(seen.col) - 1, min(THINNED, len(seen.col))).astype(int)
    few = np.linspace(0, len(seen.focus_mm) - 1, min(THINNED // 4, len(seen.focus_mm))).astype(int)
    chosen = {name: getattr(seen, name)[few if name.startswith("focus") else some] for name in Corners._fields[:10]}
    thinned = model._replace(corners=seen._replace(**chosen))
    best = None
    for facing in FACING_DEG:
        tried = fit(thinned, _start(thinned, facing), ROUGH_ROUNDS, steps=10)
        if best is None or tried.wrong < best.wrong:
            best = tried
        if best.wrong < 0.7:
            break
    return best


def _start(model: Model, facing_deg: float) -> np.ndarray:
    """Unknowns to start from: the rig as stated, and a board that is turned by ``facing_deg`` at the middle of the angles."""
    seen, x = model.corners, np.zeros(FIRST_ANGLE + len(model.corners.angles_deg))
    middle = float(np.median(seen.angles_deg[seen.sweep]))
    near = np.abs(seen.angles_deg[seen.sweep] - middle)
    own = near == near.min()
    design = np.column_stack([model.board_mm[seen.corner[own]], np.ones(own.sum())])
    affine = np.linalg.lstsq(design, np.stack([seen.col[own], seen.row[own]], axis=-1), rcond=None)[0]
    x[0] = np.radians(facing_deg - middle)
    x[2] = np.arctan2(-affine[0, 1], affine[0, 0])
    x[4] = (model.stated.axis_row_px - affine[2, 1]) * model.stated.pitch_mm
    x[FOCUS] = -float(np.median(seen.focus_mm))
    return x
