"""Looks at photographs as they come: what is wrong is told while it can be mended.

Light that is clipped or too faint, sweeps in which nothing comes into focus or the hair goes on beyond their end, light that
drifts, hair that moved. Each warning says what to do.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy import ndimage

from ..files import atomic
from ..raw import reduced
from .calibrate import BLOCK_PX, BOARD_SHARE, drift, gains, light

WHITE_NEAR = 0.98  # of white: clipped, in spite of noise and of white levels that are a little off
FINE_PX = (0.8, 1.6)  # sigmas of the band in which what is in focus differs most from what is not
COMPARED_PX = 350  # rows of a picture that is compared for motion: of larger ones, pixels are averaged
TILE_PX = 96  # of the pictures that are compared for motion
LEAST_TEXTURE = 1e-4  # mean square of the gradient along a direction, over the light's, that tells motion along it
SAME_HUE = 0.01  # of the share of blue: the same board
SURE = 5.0  # motion of so many standard errors is one


@dataclass(frozen=True)
class WatchParams:
    """When something is told."""

    clipped: float = 0.002  # share of pixels at white
    faint: float = 0.08  # of white: the brightest hundredth is darker
    contrast: float = 1.5  # sharpest photograph of a sweep over its least sharp: less, and nothing came into focus
    unsharp: float = 0.12  # and no photograph with so little sharpness has anything in focus
    open_end: float = 0.6  # of the way from least to most sharp, at the ends of a sweep: the hair goes on there
    light_drift: float = 0.02  # parts, within a sweep
    light_change: float = 0.04  # parts, from the first sweep
    moved_px: float = 0.5  # of a channel plane


@dataclass(frozen=True)
class Sight:
    """What one photograph shows."""

    clipped: float  # share of pixels where a colour is at white
    bright: float  # the brightest hundredth reaches this in its brightest colour, 1 at white
    sharpness: float  # see ``sharpness``
    light: np.ndarray  # (3, h, w) of blocks, see calibrate.light

    def record(self) -> dict:
        """Its numbers, for a logbook."""
        return {"clipped": round(self.clipped, 5), "bright": round(self.bright, 4), "sharpness": round(self.sharpness, 5)}


def look(planes: np.ndarray) -> Sight:
    """What the channel planes R, G, B (3, H, W) of a photograph show."""
    brightest = planes.max(axis=0)
    block = min(BLOCK_PX, *planes.shape[1:])
    blocks = light(planes) if block == BLOCK_PX else planes.mean(axis=(1, 2), keepdims=True)
    return Sight(float((brightest > WHITE_NEAR).mean()), float(np.percentile(brightest[::2, ::2], 99)), sharpness(planes[0]), blocks)


def sharpness(plane: np.ndarray) -> float:
    """How much fine detail a plane (H, W) has: the strongest 2 % of a band of some pixels' width, over the mean light.

    It is largest where the focus is best, does not change with the exposure, and needs no knowledge of what is seen: for
    focusing and framing, and to tell whether anything is in focus.
    """
    fine = ndimage.gaussian_filter(plane, FINE_PX[0]) - ndimage.gaussian_filter(plane, FINE_PX[1])
    return float(np.percentile(np.abs(fine[::2, ::2]), 98) / max(float(plane.mean()), 1e-4))


def write_picture(path: Path, planes: np.ndarray, widest_px: int = 800) -> None:
    """Channel planes R, G, B (3, H, W), or one plane (H, W), as a small picture for people (.png, .jpg); atomically."""
    from PIL import Image

    seen = reduced(planes if planes.ndim == 3 else planes[None], -(-planes.shape[-1] // widest_px))
    numbers = np.clip(255 * np.clip(seen, 0, 1) ** (1 / 2.2) + 0.5, 0, 255).astype(np.uint8)
    with atomic(path) as part:
        Image.fromarray(np.moveaxis(numbers, 0, -1) if len(numbers) == 3 else numbers[0]).save(part)


@dataclass(frozen=True)
class Motion:
    """By how much tiles of a picture moved, each along the direction that it tells best and, where it can, across that."""

    moved_px: np.ndarray  # (n, 2) right, down
    sigma_px: np.ndarray  # (n,) standard error along the direction that is told best
    at_px: np.ndarray  # (n, 2) column, row of their middles

    def largest(self) -> tuple[float, tuple[float, float]] | None:
        """The largest motion that is sure, in pixels, and its place (column, row); None where there is no tile to tell."""
        if not len(self.moved_px):
            return None
        length = np.hypot(*self.moved_px.T)
        k = int(length.argmax())
        return float(length[k]), (float(self.at_px[k, 0]), float(self.at_px[k, 1]))


def motion(before: np.ndarray, after: np.ndarray, iterations: int = 5) -> Motion:
    """By how much each tile of a plane (H, W) moved from ``before`` to ``after``, apart from a change of the light.

    Least squares on the gradient (Lucas and Kanade 1981), in turns with shifting the picture back. It works on blurred pictures,
    too, whose noise is far below their shades; a few pixels of motion are found. A direction along which a tile has too little
    detail, as along hair, is left out, and so is motion that is not sure.
    """
    smooth = 1.5
    first, second = (ndimage.gaussian_filter(p.astype(np.float64), smooth) for p in (before, after))
    second = ndimage.spline_filter(second)
    moved, sigmas, places = [], [], []
    inner = (slice(2, -2), slice(2, -2))
    for rows, columns in _tiles(first.shape):
        a, shift = first[rows, columns], np.zeros(2)
        for _ in range(iterations):
            b = _shifted(second, rows, columns, shift)
            b *= (a * b).sum() / max((b * b).sum(), 1e-12)
            gy, gx = np.gradient((a + b) / 2)
            g = np.stack([gx[inner].ravel(), gy[inner].ravel()])
            strengths, directions = np.linalg.eigh(g @ g.T)  # ascending
            told = strengths > LEAST_TEXTURE * a.mean() ** 2 * g.shape[1]
            if not told.any():
                break
            difference = (a - b)[inner].ravel()
            parts = np.where(told, directions.T @ (g @ difference) / strengths, 0.0)
            shift -= np.clip(directions @ parts, -4, 4)
        else:
            left = difference - (directions @ parts) @ g
            # noise that a Gaussian has smoothed is alike over 4 π smooth² pixels
            error = np.sqrt(left.var() * 4 * math.pi * smooth**2 / strengths)
            along = directions.T @ -shift
            moved.append(directions @ np.where(told & (np.abs(along) > SURE * error), along, 0.0))
            sigmas.append(error[1])
            places.append(((columns.start + columns.stop - 1) / 2, (rows.start + rows.stop - 1) / 2))
    return Motion(np.reshape(moved, (-1, 2)), np.array(sigmas), np.reshape(places, (-1, 2)))


def _tiles(shape: tuple[int, int]) -> Iterator[tuple[slice, slice]]:
    """Places that cover a picture, of about TILE_PX, with what is needed at the rim to shift them."""
    for size in (min(TILE_PX, n) for n in shape):
        if size < 24:
            return
    cuts = [np.linspace(4, n - 4, max(round((n - 8) / TILE_PX), 1) + 1).astype(int) for n in shape]
    for top, bottom in zip(cuts[0][:-1], cuts[0][1:], strict=True):
        for left, right in zip(cuts[1][:-1], cuts[1][1:], strict=True):
            yield slice(int(top), int(bottom)), slice(int(left), int(right))


def _shifted(picture: np.ndarray, rows: slice, columns: slice, shift: np.ndarray) -> np.ndarray:
    """A tile of a picture, given by its cubic splines, that was moved by ``shift`` (right, down)."""
    y, x = np.mgrid[rows, columns].astype(np.float64)
    return ndimage.map_coordinates(picture, [y - shift[1], x - shift[0]], order=3, mode="nearest", prefilter=False)


@dataclass
class Watch:
    """Remembers the photographs of a sweep, and tells what is wrong when it is seen first."""

    params: WatchParams = WatchParams()
    pitch_mm: float = 1 / 35
    sweep: int | None = None
    sights: dict[int, Sight] = field(default_factory=dict)
    positions_mm: dict[int, float] = field(default_factory=dict)
    first: np.ndarray | None = None  # red of the first photograph of the sweep
    board: tuple[float, float] | None = None  # light of the board in the first sweep, and how blue it was
    told: set[str] = field(default_factory=set)

    def photograph(self, sweep: int, frame: int, position_mm: float, planes: np.ndarray) -> tuple[Sight, list[str]]:
        """A photograph of a sweep came, channel planes (3, H, W). What it shows, and warnings."""
        if sweep != self.sweep:
            self.sweep, self.sights, self.positions_mm, self.first = sweep, {}, {}, None
            self.told -= {"clipped", "faint"}
        sight = look(planes)
        self.sights[frame], self.positions_mm[frame] = sight, position_mm
        if frame == 0:
            self.first = planes[0].copy()
        return sight, [words for key, words in self._of_one(sight) if not (key in self.told or self.told.add(key))]

    def _of_one(self, sight: Sight) -> Iterator[tuple[str, str]]:
        p = self.params
        if sight.clipped > p.clipped:
            yield (
                "clipped",
                (f"{100 * sight.clipped:.1f} % of the photograph is at white, which is lost: use a shorter shutter time, or less light"),
            )
        if sight.bright < p.faint:
            yield (
                "faint",
                (
                    f"the photograph is faint: its brightest hundredth is at {100 * sight.bright:.1f} % of white; is the light on, the lens cap off? "
                    "Else use a longer shutter time"
                ),
            )

    def check(self, planes: np.ndarray) -> list[str]:
        """A check photograph came, at the position of the first of the sweep, after its last. Warnings."""
        if self.first is None or self.first.shape != planes[0].shape:
            return []
        by = max(min(planes.shape[1:]) // COMPARED_PX, 1)
        found = motion(reduced(self.first, by), reduced(planes[0], by)).largest()
        if found is None or by * found[0] <= self.params.moved_px:
            return []
        moved, column, row = by * found[0], by * found[1][0], by * found[1][1]
        rows, columns = planes.shape[1:]
        where = f"{('upper', 'middle', 'lower')[min(int(3 * row / rows), 2)]} {('left', 'middle', 'right')[min(int(3 * column / columns), 2)]}"
        return [
            f"the hair moved by {moved:.1f} px ({moved * self.pitch_mm:.2f} mm) during sweep {self.sweep}, most at the {where} of the picture: "
            f"keep drafts and steps away, and repeat the sweep (--repeat-sweep {self.sweep})"
        ]

    def sweep_done(self, expected: int) -> list[str]:
        """All ``expected`` photographs of the sweep are there, or those of this run. Warnings about the whole."""
        warnings = []
        if len(self.sights) == expected >= 5:
            warnings += self._focus()
        if len(self.sights) == expected >= 3:
            warnings += self._light()
        return warnings

    def _focus(self) -> list[str]:
        p, frames = self.params, sorted(self.sights)
        sharp = np.array([self.sights[frame].sharpness for frame in frames])
        low, high = float(np.percentile(sharp, 10)), float(sharp.max())
        if high < min(p.contrast * low, p.unsharp):
            span = f"{self.positions_mm[frames[0]]:g} … {self.positions_mm[frames[-1]]:g} mm"
            return [
                f"nothing came into focus in sweep {self.sweep}: does the range, {span}, "
                "hold the hair, does the stage carry the camera, and is the lens at manual focus?"
            ]
        ends = ((frames[0], "first"), (frames[-1], "last"))
        return [
            f"sweep {self.sweep} has hair in focus in its {name} photograph, at {self.positions_mm[frame]:g} mm: let the range go farther there"
            for frame, name in ends
            if (self.sights[frame].sharpness - low) > p.open_end * (high - low)
        ]

    def _light(self) -> list[str]:
        p, stack = self.params, np.stack([self.sights[frame].light for frame in sorted(self.sights)])
        gain, error = gains(stack)
        change = drift(gain)
        warnings = []
        if math.isfinite(error) and abs(change) > max(p.light_drift, 3 * error):
            warnings.append(
                f"the light changed by {100 * change:+.1f} % during sweep {self.sweep}: let the lamps warm up, and keep daylight out "
                "(`strandscope calibrate` takes such a drift out again)"
            )
        mean = np.median(stack, axis=0).reshape(3, -1)
        blue = mean[2] / np.maximum(mean.sum(axis=0), 1e-9)
        board = np.argsort(-blue)[: max(int(BOARD_SHARE * len(blue)), 4)]
        level, hue = float(mean[:, board].sum(axis=0).mean()), float(blue[board].mean())
        if self.board is None:
            self.board = (level, hue)
            return warnings
        level = level / self.board[0]
        same = abs(hue - self.board[1]) < SAME_HUE  # else hair is before it
        if same and abs(level - 1) > p.light_change and "light" not in self.told:
            self.told.add("light")
            change = f"{100 * (level - 1):+.1f} %"
            warnings.append(
                f"the light of sweep {self.sweep} differs by {change} from that of the first: has a lamp changed, or the "
                "camera's exposure? Put it right, and repeat the sweep"
            )
        return warnings
