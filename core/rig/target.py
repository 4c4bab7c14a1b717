"""A printed target, a flat board of squares and markers (ChArUco), and its corners in a photograph. OpenCV finds them, and does nothing else."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ..errors import StrandscopeError

MISSING = "a printed target needs OpenCV, which is not installed; install it with: pip install 'strandscope[calibrate]'"
MODULES = 6  # of a marker, its black border included
LEAST_PEAK = 0.2  # of the best sharpness, down to which photographs tell where a corner is in focus


@dataclass(frozen=True)
class Target:
    """A ChArUco board: squares in turn black and white, and in each white one a marker that says which it is."""

    columns: int = 14  # squares
    rows: int = 10
    square_mm: float = 5.0
    marker_mm: float = 3.0
    dictionary: str = "DICT_4X4_100"

    def of_squares(self, square_mm: float) -> "Target":
        """The same, larger or smaller."""
        return replace(self, square_mm=square_mm, marker_mm=self.marker_mm * square_mm / self.square_mm)

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height."""
        return self.columns * self.square_mm, self.rows * self.square_mm

    @property
    def corners_mm(self) -> np.ndarray:
        """Corners between four squares (n, 2): x to the right and y up, from the middle; in the order of OpenCV."""
        x, y = np.meshgrid(np.arange(1, self.columns), np.arange(1, self.rows))
        width, height = self.size_mm
        return np.stack([x.ravel() * self.square_mm - width / 2, height / 2 - y.ravel() * self.square_mm], axis=-1)

    def black_mm(self) -> np.ndarray:
        """All that is black, as rectangles (n, 4) of left, bottom, right, top, mm from the middle. Raises StrandscopeError without OpenCV."""
        cv2 = opencv()
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        width, height = self.size_mm
        found, number, module = [], 0, self.marker_mm / MODULES
        for row in range(self.rows):
            for column in range(self.columns):
                left, top = column * self.square_mm - width / 2, height / 2 - row * self.square_mm
                if (row + column) % 2 == 0:
                    found.append((left, top - self.square_mm, left + self.square_mm, top))
                    continue
                bits = cv2.aruco.generateImageMarker(markers, number, MODULES) == 0
                rim, number = (self.square_mm - self.marker_mm) / 2, number + 1
                for down, line in enumerate(bits):
                    ends = np.flatnonzero(np.diff(np.r_[False, line, False]))
                    y = top - rim - down * module
                    found += [(left + rim + a * module, y - module, left + rim + b * module, y) for a, b in ends.reshape(-1, 2)]
        return np.array(found)

    @cached_property
    def detector(self):
        """OpenCV's detector of this board. Raises StrandscopeError without OpenCV."""
        cv2 = opencv()
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        board = cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_mm, self.marker_mm, markers)
        return cv2.aruco.CharucoDetector(board)


def opencv():
    """The module cv2. Raises StrandscopeError that says how to install it."""
    try:
        import cv2
    except ImportError as error:
        raise StrandscopeError(MISSING) from error
    return cv2


# ---- corners in a photograph -----------------------------------------------------------------------------------------


class Seen(NamedTuple):
    """Corners in a photograph."""

    corner: np.ndarray  # (n,) int64: which, as Target.corners_mm has them
    col: np.ndarray  # (n,) px
    row: np.ndarray  # (n,) px
    sharp: np.ndarray  # (n,) energy of the gradient around it, relative to its light


def find_corners(plane: np.ndarray, target: Target) -> Seen:
    """The corners of a target that are near a marker sharp enough to be read, in a channel plane (H, W), to a pixel or better."""
    low, high = np.percentile(plane[::4, ::4], [1, 99])
    eight = np.clip((plane - low) * (255 / max(high - low, 1e-6)), 0, 255).astype(np.uint8)
    found, names, _, _ = target.detector.detectBoard(eight)
    if names is None:
        return Seen(np.zeros(0, np.int64), *np.zeros((3, 0)))
    where = found.reshape(-1, 2).astype(np.float64)
    return Seen(names.ravel().astype(np.int64), where[:, 0], where[:, 1], np.ones(len(where)))


def measure_corners(plane: np.ndarray, corner: np.ndarray, where: np.ndarray, half: np.ndarray) -> Seen:
    """Corners (n,) of a target in a channel plane (H, W) near the pixels ``where`` (n, 2), blurred as they may be: to a fraction of a pixel,
    and how sharp they are. half (2,): what is looked at, each way, in columns and rows.

    A corner looks the same when it is turned by half a turn, and so does its blur: it stays in the middle.
    """
    cv2 = opencv()
    half = np.maximum(np.rint(half).astype(int), 3)
    inside = np.all((where > half + 2) & (where < np.array(plane.shape[::-1]) - half - 3), axis=1)
    corner, where = corner[inside], where[inside].astype(np.float32)
    if not len(corner):
        return Seen(corner, *np.zeros((3, 0)))
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 40, 0.001)
    fine = cv2.cornerSubPix(np.ascontiguousarray(plane, np.float32), where.reshape(-1, 1, 2).copy(), tuple(int(h) for h in half), (-1, -1), stop)
    fine = fine.reshape(-1, 2)
    kept = np.all(np.abs(fine - where) < 0.6 * half, axis=1)
    corner, fine = corner[kept], fine[kept].astype(np.float64)
    return Seen(corner, fine[:, 0], fine[:, 1], np.array([_sharpness(plane, *place, *half) for place in fine]))


def _sharpness(plane: np.ndarray, col: float, row: float, half_col: int, half_row: int) -> float:
    """Mean square of the gradient in a window, over the square of the mean light there, which blur does not change."""
    c, r = round(col), round(row)
    patch = plane[r - half_row - 1 : r + half_row + 2, c - half_col - 1 : c + half_col + 2].astype(np.float64)
    right = 0.5 * (patch[1:-1, 2:] - patch[1:-1, :-2])
    down = 0.5 * (patch[2:, 1:-1] - patch[:-2, 1:-1])
    return float((right**2 + down**2).mean() / max(patch.mean(), 1e-6) ** 2)


def depth_from_focus(positions_mm: np.ndarray, sharp: np.ndarray, working_distance_mm: float) -> float:
    """The position at which a corner is sharpest, from its sharpness (n,) at some; NaN where they do not enclose it.

    The energy of the gradient over an edge that is blurred over a radius R goes with 1/R, so that 1/sharp² is a parabola over R, which is
    in proportion to (d - w) l / (l + d - w), the pixel's own blur being its least value.
    """
    best = int(np.argmax(sharp))
    near = sharp >= LEAST_PEAK * sharp[best]
    middle, distance = positions_mm[best], working_distance_mm
    if near.sum() < 4 or not 0 < np.flatnonzero(near).searchsorted(best) < near.sum() - 1:
        return np.nan
    t, y = (positions_mm[near] - middle) * distance / (distance + positions_mm[near] - middle), (sharp[best] / sharp[near]) ** 2
    a, b, _ = np.polyfit(t, y, 2, w=1 / y)
    vertex = -b / (2 * a) if a > 0 else np.nan
    return float(middle + vertex / (1 - vertex / distance)) if t.min() < vertex < t.max() else np.nan
