"""Ridges: where an in-focus hair stands in a photograph, and how it is turned (sec. 4.1).

Two operators give the same records:

``paper``     Jakob et al. as written: blur by a Gaussian, orientation from a bank of Gabor filters, a maximum of the blurred
              photograph across that orientation, its relative height M' = (M - Mmax) / (Mmax + c), hysteresis.
``oriented``  Ours: a bank of line filters, narrow across the hair and long along it, and the maximum and the thresholds are
              those of the filter's own response, over the light around it. Clutter from the hairs beside and behind limits
              detection in photographs of little grain, and a narrow filter keeps it out; a long one averages grain away.
              What is kept are runs: ridge pixels each of which continues the one before in place and angle, and whose
              mean strength over the length of the run is enough. Grain and rungs between hairs are strong only shortly;
              half hidden hair is weak for a long way.

Both give the position along the normal and the angle between the bins of the bank. Angles are those of the hair in the
image, from +u (right) towards +v (up), in [0, pi).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy import ndimage
from threadpoolctl import ThreadpoolController

from .lanes import LANES, add_backwards, subtract_backwards
from .raw import reduced

BINS = 32  # orientations of a bank, over 180 degrees
LEAST_PX = 100  # of a photograph's sides: it is not reduced any further
LIGHT_PX, LIGHT_BLOCK = 8.0, 4  # sigma of the Gaussian that tells the light around a pixel; it is told for blocks
BATCH = 256  # pixels of which a bank is asked at once
STROKE_LOSS = 0.85  # least answer to a ridge of the strokes that say where one may be, in parts of that of the filters that seek it
LIGHT_TO_OFFSET = 2.0  # c of the oriented operator, in parts of the light around clear hairs
GRAIN_TO_OFFSET = 50.0  # and in standard deviations of the grain
BROAD = 0.5  # breadth of hair that is twice as wide as the filters: it is still found; twice that is not
BRIGHT = 0.6  # of the light of a photograph's brightest places: where its grain is measured
TURNED_LOSS = 0.5  # answer of a long filter that is a bin or two off, in parts of the right one's
BESIDE_PX, TURN_DEG = 0.8, 20.0  # how far the next pixel of a run may lie beside the way of one, and be turned


@dataclass(frozen=True)
class RidgeParams:
    """What counts as a ridge. Lengths in pixels of the channel plane, light in parts of white."""

    operator: str = "oriented"  # or "paper"
    reduce: int | None = None  # pixels each way that are averaged to one before all else, where hair is wide; None: estimated
    low: float = 0.011  # strength of a ridge pixel that may be part of a run (paper: that continues a ridge)
    high: float = 0.022  # mean strength of a run (paper: strength that begins a ridge)
    run_px: int = 7  # oriented: ridge pixels in a run
    offset: float | None = None  # c: light added to the denominator, so that grain in the dark makes no ridges; None: estimated
    blur_px: float = 1.0  # paper: sigma of the Gaussian before all else
    across_px: float = 0.6  # oriented: sigma of the line filter across the hair
    seek_px: float = 3.0  # oriented: sigma along the hair of the line filter that seeks crests, at every pixel and angle
    along_px: float = 6.0  # oriented: sigma along the hair of those that tell a crest's strength and angle
    turn_px: float = 0.9  # oriented: sigma across of the filter that measures the angle; a narrow one misjudges upright hair


@dataclass(frozen=True)
class Ridges:
    """Ridge pixels of one photograph: arrays (n,) float32 in pixels, radians and parts."""

    col: np.ndarray
    row: np.ndarray
    angle: np.ndarray  # of the hair, from +u towards +v, [0, pi)
    strength: np.ndarray
    breadth: np.ndarray  # logarithm of the answer of a filter for broader hair over that for finer hair; paper: 0


def estimate(planes: Sequence[np.ndarray], params: RidgeParams) -> RidgeParams:
    """``params`` with the reduction and the offset c that suit a capture, where they are not given.

    planes: some photographs' channel planes (H, W). They are reduced as long as hair stays twice as broad as the filters are made for.
    The offset is in proportion to the light around the clearest hairs, and to the grain of the photographs: a capture twice as
    bright gives the same ridges. Grain is that of bright places: it grows with light, and there may be much background. The factors
    are those that leave less than one false ridge in 10,000 pixels of blurred hair on two dense locks, one with six times the grain
    of the other.
    """
    reduce = params.reduce or 1
    told = _clearest([reduced(plane, reduce) for plane in planes], params)
    while params.reduce is None and min(planes[0].shape) >= 2 * reduce * LEAST_PX:
        smaller = _clearest([reduced(plane, 2 * reduce) for plane in planes], params)
        if smaller.breadth < BROAD:
            break
        reduce, told = 2 * reduce, smaller
    offset = params.offset
    if offset is None:
        offset = LIGHT_TO_OFFSET * told.light + GRAIN_TO_OFFSET * told.grain
    return replace(params, reduce=reduce, offset=float(offset))


class _Clearest(NamedTuple):
    """What the clearest hairs of some photographs are like."""

    breadth: float
    light: float  # around them
    grain: float


def _clearest(planes: Sequence[np.ndarray], params: RidgeParams) -> _Clearest:
    breadths, light, top = [], [], []
    for plane in planes:
        crests = _measure(plane, replace(params, offset=float(plane.mean())))
        around = ndimage.gaussian_filter(plane, LIGHT_PX)
        strength, breadth = _spread(crests, crests.strength, plane.shape), _spread(crests, crests.breadth, plane.shape)
        clear = strength >= np.quantile(strength, 0.995)
        breadths.append(breadth[clear])
        light.append(around[clear])
        top.append(np.quantile(around, 0.99))
    grain = [noise(plane, plane_top) for plane, plane_top in zip(planes, top, strict=True) if plane_top >= BRIGHT * max(top)]
    return _Clearest(float(np.median(np.concatenate(breadths))), float(np.median(np.concatenate(light))), float(np.median(grain)))


def noise(plane: np.ndarray, top: float) -> float:
    """Standard deviation of the grain of a plane (H, W) where it is bright, ``top`` being the light of its brightest places:
    from the median size of what a smooth surface has not, its mixed second difference (Immerkaer 1996)."""
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]]) / 6.0
    bright = ndimage.gaussian_filter(plane, LIGHT_PX) >= BRIGHT * top
    return float(1.4826 * np.median(np.abs(ndimage.convolve(plane, mask))[bright]))


def detect(plane: np.ndarray, params: RidgeParams) -> Ridges:
    """The ridges of a channel plane (H, W) float32, linear, 0 at black and 1 at white; sorted by row, then column.

    Each is one pixel wide; col and row are moved along the normal to the crest.
    """
    crests = _measure(plane, params)
    kept = np.flatnonzero(_kept(crests, plane.shape, params))
    row, col, strength, angle, shift, breadth = (a[kept] for a in crests)
    # the normal of a hair at `angle` is (-sin, cos) in (u, v); rows run down, v runs up
    return Ridges(col - shift * np.sin(angle), row - shift * np.cos(angle), angle, strength, breadth)


def response(plane: np.ndarray, params: RidgeParams) -> np.ndarray:
    """Strength (H, W) float32 of the ridge at each pixel of a channel plane (H, W), 0 where there is none; for pictures."""
    crests = _measure(plane, params)
    return _spread(crests, np.where(_kept(crests, plane.shape, params), crests.strength, np.float32(0)), plane.shape)


class _Crests(NamedTuple):
    """Pixels of a photograph that may be ridges, (n,) float32 each, by row, then column; ``shift`` is along the normal in px."""

    row: np.ndarray
    col: np.ndarray
    strength: np.ndarray
    angle: np.ndarray
    shift: np.ndarray
    breadth: np.ndarray


def _spread(crests: _Crests, values: np.ndarray, shape) -> np.ndarray:
    """A plane (H, W) float32 of the crests' values (n,), 0 elsewhere."""
    plane = np.zeros(shape, np.float32)
    plane[crests.row.astype(np.intp), crests.col.astype(np.intp)] = values
    return plane


def _kept(crests: _Crests, shape, params: RidgeParams) -> np.ndarray:
    """Which crests are ridges: (n,) bool."""
    row, col = crests.row.astype(np.int32), crests.col.astype(np.int32)
    begins = np.searchsorted(row, np.arange(shape[0] + 1))
    if params.operator == "paper":
        return _hysteresis(row, col, begins, crests.strength, params.high)
    along = np.stack([np.cos(crests.angle), np.sin(crests.angle)], axis=1)
    return _runs(row, col, begins, crests.strength, along, crests.shift, params.high, params.run_px)


def _measure(plane, params) -> _Crests:
    plane = np.ascontiguousarray(plane, np.float32)
    if params.offset is None:
        params = estimate([plane], replace(params, reduce=1))
    find = _papers_crests if params.operator == "paper" else _oriented_crests
    with _blas().limit(limits=1):  # a few hundred pixels are too little for two threads, which wait for each other
        return _Crests(*find(plane, params))


@lru_cache(maxsize=1)
def _blas() -> ThreadpoolController:
    return ThreadpoolController()


def _papers_crests(plane, params):
    bank = gabor_bank()
    blurred = _blurred(plane, _gaussian(params.blur_px))
    return _relative_peaks(blurred, _folded(bank), bank.shape[1] // 2, np.float32(params.offset), np.float32(params.low))


def _oriented_crests(plane, params):
    even, odd = line_banks(params.across_px, params.seek_px)
    narrow, wide = (line_banks(across_px, params.along_px)[0] for across_px in (params.across_px, params.turn_px))
    marks = strokes(params.across_px)
    half, long = even.shape[1] // 2, narrow.shape[1] // 2
    rim = max(half, long, 6 * marks.apart)
    banks = _folded(even), _folded(odd), _folded(narrow), _folded(wide)
    found = _line_peaks(plane, marks, banks, half, long, rim, _light_around(plane), np.float32(params.offset), np.float32(params.low))
    row, col, strength, angle, step, broad, best = found
    # the way to the crest along the normal of the bin, told along that of the angle
    return row, col, strength, angle, step * np.cos(best * np.float32(np.pi / BINS) - angle), np.log(broad)


def _gaussian(sigma_px: float) -> np.ndarray:
    """The middle and the right half of a Gaussian that ends at 4 sigma, (n,) float32, as scipy's filter has it."""
    half = np.exp(-0.5 * (np.arange(int(4 * sigma_px + 0.5) + 1) / sigma_px) ** 2)
    return (half / (2 * half.sum() - half[0])).astype(np.float32)


def _light_around(plane):
    """Light around blocks of LIGHT_BLOCK pixels of a plane (H, W): (h, w) float32."""
    return ndimage.gaussian_filter(_blocks(plane), LIGHT_PX / LIGHT_BLOCK)


# ---- banks -----------------------------------------------------------------------------------------------------------


def _rotated_grid(half: int):
    """For each bin: coordinates across and along a hair at that angle, (BINS, 2 half + 1, 2 half + 1); rows run down."""
    angle = (np.arange(BINS) * np.pi / BINS)[:, None, None]
    v, u = np.mgrid[half : -half - 1 : -1, -half : half + 1]
    return -u * np.sin(angle) + v * np.cos(angle), u * np.cos(angle) + v * np.sin(angle)


@lru_cache(maxsize=4)
def gabor_bank(sigma_px: float = 1.0, wavelength_px: float = 3.0, half: int = 3) -> np.ndarray:
    """The paper's 32 Gabor filters 7x7 (eq. 1), (32, 7, 7) float32, for hairs at k 180/32 degrees.

    Made zero-mean: as written their mean varies with the angle, which turns hairs on a bright background.
    """
    across, along = _rotated_grid(half)
    bank = np.exp(-(across**2 + along**2) / (2 * sigma_px**2)) * np.cos(2 * np.pi * across / wavelength_px)
    return (bank - bank.mean(axis=(1, 2), keepdims=True)).astype(np.float32)


@lru_cache(maxsize=8)
def line_banks(across_px: float, along_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Line filters for hairs at k 180/32 degrees: minus the second, and the first derivative across, of a long Gaussian.

    Two arrays (32, k, k) float32. The even one is zero-mean and scaled so that a line of that very profile and height 1
    gives 1; the odd one shares the scale, so odd / even is the way to the crest in pixels (Steger 1998, sec. 2).
    """
    across, along = _rotated_grid(int(np.ceil(1.5 * max(along_px, 2.0 * across_px))))
    envelope = np.exp(-(across**2) / (2 * across_px**2) - along**2 / (2 * along_px**2))
    even = envelope * (1 - across**2 / across_px**2) / across_px**2
    even -= even.mean(axis=(1, 2), keepdims=True)
    odd = envelope * across / across_px**2
    scale = np.sum(even * np.exp(-(across**2) / (2 * across_px**2)), axis=(1, 2), keepdims=True)
    return (even / scale).astype(np.float32), (odd / scale).astype(np.float32)


# ---- strokes ---------------------------------------------------------------------------------------------------------


class Strokes(NamedTuple):
    """Coarse line filters that share nearly all of their work, for every pixel.

    The light's second differences across one of four axes (those of rows, columns and diagonals) are averaged over three pixels
    along it; a stroke adds two pairs of such places to the middle one, which makes it long and turns it a little.
    """

    apart: int  # px between neighbours in all of this
    axis: np.ndarray  # (n,) number of the axis
    place: np.ndarray  # (n, 2, 2) row and column of one of each pair, in px
    weight: np.ndarray  # (n, 3) float32 of the middle and the pairs; a line of the profile and height 1 gives 1


ALONG = ((0, 1), (-1, 1), (1, 0), (1, 1))  # row and column of the next pixel along each axis
ASIDE = 0.8  # weight of the pixels before and after
# pairs of places (column, row, weight) of strokes from along the rows to 27 degrees, and from there to the diagonal
SLIGHT = (((2, 0, 0.8), (4, 0, 0.45)), ((2, 0, 0.8), (4, 1, 0.45)), ((3, 1, 0.7),), ((2, 1, 0.8), (4, 2, 0.45)))
STEEP = (((2, 1, 0.65),), ((2, 2, 0.65),))
MADE_FOR_PX = 0.6  # sigma of the line across which the strokes' places are whole pixels


@lru_cache(maxsize=4)
def strokes(across_px: float) -> Strokes:
    """The twenty strokes for lines of a profile of that sigma."""
    apart = max(1, round(across_px / MADE_FOR_PX))
    turned = {}  # by axis and places, so that what is alike appears once
    for pairs, axes in [(pairs, (0, 2)) for pairs in SLIGHT] + [(pairs, (1, 3)) for pairs in STEEP]:
        for side in (-1, 1):
            flat = [(side * row, col, weight) for col, row, weight in pairs]
            upright = [(side * col, row, weight) for col, row, weight in pairs]
            near = axes if axes[0] == 0 else (axes[side > 0],) * 2
            for axis, places in zip(near, (flat, upright), strict=True):
                turned.setdefault((axis, frozenset((abs(r), abs(c), r * c) for r, c, _ in places)), places)
    found = [_stroke(axis, places, apart, across_px) for (axis, _), places in sorted(turned.items(), key=lambda item: item[0][0])]
    axis, place, weight = (np.array(a) for a in zip(*found, strict=True))
    return Strokes(apart, axis, place, weight.astype(np.float32))


def _stroke(axis, places, apart, across_px):
    """(axis, places (2, 2), weights (3,)) of one stroke; the weights are those with which a line at its angle answers 1."""
    weights = [1.0, *(weight for *_, weight in places)] + [0.0] * (2 - len(places))
    places = [(apart * row, apart * col) for row, col, _ in places] + [(0, 0)] * (2 - len(places))
    half = 6 * apart
    across, _ = _rotated_grid(half)
    impulse = np.zeros((2 * half + 1, 2 * half + 1))
    impulse[half, half] = 1
    answers = np.sum(stroke_answer(impulse, axis, places, weights, apart) * np.exp(-(across**2) / (2 * across_px**2)), axis=(1, 2))
    return axis, places, np.array(weights) / answers.max()


def stroke_answer(plane: np.ndarray, axis: int, places, weights, apart: int) -> np.ndarray:
    """The answer (H, W) of one stroke to a plane (H, W), plainly: what the kernel below does for all of them at once."""

    def both(image, row, col):
        return ndimage.shift(image, (row, col), order=0) + ndimage.shift(image, (-row, -col), order=0)

    across = [ALONG[(axis + 2) % 4]] if axis % 2 == 0 else [(0, 1), (1, 0), ALONG[(axis + 2) % 4]]
    bend = sum(plane - 0.5 * both(plane, apart * row, apart * col) for row, col in across)
    bend = bend + ASIDE * both(bend, apart * ALONG[axis][0], apart * ALONG[axis][1])
    return weights[0] * bend + sum(w * both(bend, *place) for w, place in zip(weights[1:], places, strict=True))


# ---- kernels ---------------------------------------------------------------------------------------------------------
#
# What bounds the oriented operator. Twenty strokes are some 180 flops a pixel, eight pixels at once, and tell the quarter of the pixels
# (where hair is dense) at which a hair may be. There the patch of 11 x 11 is folded, pixels at +(j, i) and -(j, i) being added, which
# halves the work, and the 32 filters are one matrix product for BATCH of them, 3904 flops each at the speed of sgemm: a quarter of the
# time. A tenth of the pixels are crests, and there the patch is one of 19 x 19 and five filters or so are asked: a fifth.
#
# The paper's operator need not ask where no direction can have a peak of the least height; see ``_may_peak``. The blur and this
# bound, at every pixel, are about half of its time.


def _folded(bank: np.ndarray) -> np.ndarray:
    """The first half of each filter of a bank (B, k, k), even or odd, and its middle, which a folded patch has twice: (B, n) float32.

    n is a multiple of 4 LANES, which is what ``_dot`` does at once; what is added has no weight.
    """
    half = (bank.shape[1] * bank.shape[2]) // 2 + 1
    rows = bank.reshape(len(bank), -1)[:, :half].copy()
    rows[:, -1] /= 2
    return np.pad(rows, ((0, 0), (0, -half % (4 * LANES))))


@njit(cache=True, nogil=True)
def _fold_patch(flat, width, y, x, half, patches, at):
    """Write to patches (n,), at ``at``, the upper half of the patch around a pixel of a plane (``flat`` (H W), W wide), k = 2 half + 1
    pixels wide, plus the lower half turned by 180 degrees, (k k + 1) / 2 pixels. Up to 2 LANES behind these are written over."""
    size = 2 * half + 1
    first, last = (y - half) * width + x - half, (y + half) * width + x + half
    for j in range(half + 1):
        for i in range(0, size if j < half else half + 1, LANES):
            add_backwards(patches, at + j * size + i, flat, first + j * width + i, last - j * width - i)


@njit(cache=True, nogil=True)
def _fold_patch_odd(flat, width, y, x, half, patches, at):
    """As ``_fold_patch``, minus the lower half."""
    size = 2 * half + 1
    first, last = (y - half) * width + x - half, (y + half) * width + x + half
    for j in range(half + 1):
        for i in range(0, size if j < half else half + 1, LANES):
            subtract_backwards(patches, at + j * size + i, flat, first + j * width + i, last - j * width - i)


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _dot(a, b):
    total = np.float32(0)
    for t in range(len(a)):
        total += a[t] * b[t]
    return total


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _dots(a, b, c, d):
    """The products of a with b, c and d."""
    one, two, three = np.float32(0), np.float32(0), np.float32(0)
    for t in range(len(a)):
        one += a[t] * b[t]
        two += a[t] * c[t]
        three += a[t] * d[t]
    return one, two, three


@njit(cache=True, nogil=True)
def _climbed(patch, bank, best):
    """(bin, answers of the bin before, of it, and of the next) of the strongest of folded filters (B, n) on a folded patch (n,),
    climbing from bin ``best`` for four bins at most."""
    bins = len(bank)
    left, middle, right = _dots(patch, bank[(best - 1) % bins], bank[best], bank[(best + 1) % bins])
    for _ in range(4):
        if left > middle and left >= right:
            best = (best - 1) % bins
            left, middle, right = _dot(patch, bank[(best - 1) % bins]), left, middle
        elif right > middle:
            best = (best + 1) % bins
            left, middle, right = middle, right, _dot(patch, bank[(best + 1) % bins])
        else:
            break
    return best, left, middle, right


@njit(cache=True, nogil=True)
def _turned(best, fraction, bins):
    """Angle of the hair in [0, pi) between the bins."""
    phi = (best + fraction) * np.pi / bins
    if phi < 0:
        return phi + np.pi
    return phi - np.pi if phi >= np.pi else phi


class _Asked(NamedTuple):
    """Room for what a bank (B, n) is asked at once."""

    patches: np.ndarray  # (BATCH n,) and some float32, folded
    answers: np.ndarray  # (B, BATCH) float32
    best: np.ndarray  # (BATCH,) int32, bin of the greatest
    top: np.ndarray  # (BATCH,) float32, which is that


@njit(cache=True, nogil=True)
def _scratch(bank):
    patches, answers = np.zeros(BATCH * bank.shape[1] + 2 * LANES, np.float32), np.empty((len(bank), BATCH), np.float32)
    return _Asked(patches, answers, np.empty(BATCH, np.int32), np.empty(BATCH, np.float32))


@njit(cache=True, nogil=True)
def _ask(plane, rows, cols, bank, half, asked):
    """Answers of all filters of a folded bank (B, n), 2 half + 1 pixels wide, at up to BATCH pixels of a plane, to ``asked``."""
    flat, width, taps = plane.ravel(), plane.shape[1], bank.shape[1]
    for i in range(len(rows)):
        _fold_patch(flat, width, rows[i], cols[i], half, asked.patches, i * taps)
    np.dot(bank, asked.patches[: BATCH * taps].reshape(BATCH, taps).T, asked.answers)
    best, top = asked.best, asked.top
    best[:] = 0
    top[:] = asked.answers[0]
    for b in range(1, len(bank)):
        answer, number = asked.answers[b], np.int32(b)
        for i in range(BATCH):
            best[i] = number if answer[i] > top[i] else best[i]
            top[i] = max(top[i], answer[i])


# ---- light -----------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _blocks(plane):
    """Means of blocks of LIGHT_BLOCK x LIGHT_BLOCK pixels of a plane (H, W): (h, w) float32."""
    height, width = plane.shape[0] // LIGHT_BLOCK, plane.shape[1] // LIGHT_BLOCK
    means, sums = np.empty((height, width), np.float32), np.empty(width * LIGHT_BLOCK, np.float32)
    for j in range(height):
        sums[:] = 0
        for row in plane[j * LIGHT_BLOCK : (j + 1) * LIGHT_BLOCK, : len(sums)]:
            for x in range(len(sums)):
                sums[x] += row[x]
        for i in range(width):
            total = np.float32(0)
            for x in range(i * LIGHT_BLOCK, (i + 1) * LIGHT_BLOCK):
                total += sums[x]
            means[j, i] = total / np.float32(LIGHT_BLOCK * LIGHT_BLOCK)
    return means


@njit(cache=True, nogil=True)
def _between(count, blocks):
    """For each of ``count`` pixels the block (of ``blocks``) whose middle is before it, and how far it is on the way to the next."""
    before, part = np.empty(count, np.int64), np.empty(count, np.float32)
    for x in range(count):
        at = min(max((x + np.float32(0.5)) / LIGHT_BLOCK - np.float32(0.5), np.float32(0)), np.float32(blocks - 1))
        before[x] = min(int(at), max(blocks - 2, 0))
        part[x] = np.float32(at - before[x])
    return before, part


@njit(cache=True, nogil=True)
def _light_row(light, y, rows, cols, blended, row):
    """Fill row (W,) with the light at row y of a photograph between the middles of its blocks, light (h, w); ``blended`` (w,) is scratch."""
    before, part = rows
    j, share = before[y], part[y]
    upper, lower = light[j], light[min(j + 1, len(light) - 1)]
    for i in range(len(blended)):
        blended[i] = upper[i] + share * (lower[i] - upper[i])
    before, part = cols
    last = len(blended) - 1
    for x in range(len(row)):
        i = before[x]
        row[x] = blended[i] + part[x] * (blended[min(i + 1, last)] - blended[i])


# ---- the oriented operator -------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _cross_row(plane, y, apart, crosses):
    """Second differences across the diagonals at row y, and to both are added those along rows and columns: crosses (2, W), first
    those across the diagonal that rises."""
    inner = plane.shape[1] - 2 * apart
    row, above, below = plane[y], plane[y - apart], plane[y + apart]
    m, w, e = row[apart : apart + inner], row[:inner], row[2 * apart : 2 * apart + inner]
    n, nw, ne = above[apart : apart + inner], above[:inner], above[2 * apart : 2 * apart + inner]
    s, sw, se = below[apart : apart + inner], below[:inner], below[2 * apart : 2 * apart + inner]
    half, three = np.float32(0.5), np.float32(3)
    one, other = crosses[0][apart : apart + inner], crosses[1][apart : apart + inner]
    for x in range(inner):
        cross = three * m[x] - half * (w[x] + e[x] + n[x] + s[x])
        one[x] = cross - half * (nw[x] + se[x])
        other[x] = cross - half * (sw[x] + ne[x])


@njit(cache=True, nogil=True)
def _bend_row(plane, y, apart, crosses, bends):
    """Second differences across the four axes at row y, averaged along them: bends (4, W). crosses: (3, 2, W), what ``_cross_row``
    tells of the rows before, at and after."""
    inner = plane.shape[1] - 2 * apart
    row, above, below = plane[y], plane[y - apart], plane[y + apart]
    m, w, e = row[apart : apart + inner], row[:inner], row[2 * apart : 2 * apart + inner]
    n, nw, ne = above[apart : apart + inner], above[:inner], above[2 * apart : 2 * apart + inner]
    s, sw, se = below[apart : apart + inner], below[:inner], below[2 * apart : 2 * apart + inner]
    half, aside = np.float32(0.5), np.float32(ASIDE)
    along_row, along_col = bends[0][apart : apart + inner], bends[2][apart : apart + inner]
    for x in range(inner):
        edges, upright, flat = nw[x] + ne[x] + sw[x] + se[x], n[x] + s[x], w[x] + e[x]
        along_row[x] = m[x] - half * upright + aside * (flat - half * edges)
        along_col[x] = m[x] - half * flat + aside * (upright - half * edges)
    before, here, after = crosses
    middle = here[0][apart : apart + inner]
    up, down, bend = before[0][2 * apart : 2 * apart + inner], after[0][:inner], bends[1][apart : apart + inner]
    for x in range(inner):
        bend[x] = middle[x] + aside * (up[x] + down[x])
    middle = here[1][apart : apart + inner]
    up, down, bend = before[1][:inner], after[1][2 * apart : 2 * apart + inner], bends[3][apart : apart + inner]
    for x in range(inner):
        bend[x] = middle[x] + aside * (up[x] + down[x])


@njit(cache=True, nogil=True)
def _add_stroke(top, middle, a, b, w, w1, higher):
    """higher (n,) = top (n,) or, where that is more, the answer of a stroke of one pair of places."""
    for x in range(len(higher)):
        higher[x] = max(top[x], w * middle[x] + w1 * (a[x] + b[x]))


@njit(cache=True, nogil=True)
def _add_long_stroke(top, middle, a, b, c, d, w, w1, w2, higher):
    """The same for two pairs."""
    for x in range(len(higher)):
        higher[x] = max(top[x], w * middle[x] + w1 * (a[x] + b[x]) + w2 * (c[x] + d[x]))


@njit(cache=True, nogil=True)
def _boldest(bends, y, marks, rim, top, higher):
    """The greatest answer of the strokes on row y for the columns that are ``rim`` from either side: top (n,) or, after an odd number
    of strokes, higher (n,).

    bends: (R, 4, W), those of row r at r % R.
    """
    ring, width = len(bends), bends.shape[2]
    first, last = rim, width - rim
    top[:] = 0
    for number in range(len(marks.axis)):
        axis, place, weight = marks.axis[number], marks.place[number], marks.weight[number]
        row, col = place[0, 0], place[0, 1]
        middle = bends[y % ring, axis, first:last]
        a, b = bends[(y + row) % ring, axis, first + col : last + col], bends[(y - row) % ring, axis, first - col : last - col]
        if weight[2] == 0:
            _add_stroke(top, middle, a, b, weight[0], weight[1], higher)
        else:
            row, col = place[1, 0], place[1, 1]
            c, d = bends[(y + row) % ring, axis, first + col : last + col], bends[(y - row) % ring, axis, first - col : last - col]
            _add_long_stroke(top, middle, a, b, c, d, weight[0], weight[1], weight[2], higher)
        top, higher = higher, top
    return top


@njit(cache=True, nogil=True)
def _line_peaks(plane, marks, banks, half, long, rim, light, offset, low):
    """Crests of the line filters' response over (offset + light): (7, n) row, column, strength, angle, the way to the
    crest along the normal of a bin, breadth (no logarithm), and that bin.

    Strokes (``marks``) say where there may be one; there longer filters (2 half + 1 pixels wide) seek it, and where it is, yet longer
    ones (2 long + 1) tell its strength and angle: ``banks`` are these, see ``_crests_among``. light (h, w): that around blocks of
    LIGHT_BLOCK pixels.
    """
    height, width = plane.shape
    apart, inner = marks.apart, max(width - 2 * rim, 0)
    ring = 8 * apart + 1
    crosses, bends = np.zeros((2 * apart + 1, 2, width), np.float32), np.zeros((ring, 4, width), np.float32)
    room, lit, blended = np.empty((2, inner), np.float32), np.empty(width, np.float32), np.empty(light.shape[1], np.float32)
    rows_between, cols_between = _between(height, light.shape[0]), _between(width, light.shape[1])
    asked, rows, cols, below = 0, np.empty(BATCH + width, np.int64), np.empty(BATCH + width, np.int64), np.empty(BATCH + width, np.float32)
    seek, odd, narrow, _ = banks
    phi = np.arange(BINS) * np.pi / BINS
    steep = np.maximum(np.abs(np.sin(phi)), np.abs(np.cos(phi))).astype(np.float32)
    scratch = steep, _scratch(seek), np.zeros(odd.shape[1] + 2 * LANES, np.float32), np.zeros(narrow.shape[1] + 2 * LANES, np.float32)
    found, count = np.empty((7, max(height - 2 * rim, 0) * inner), np.float32), 0  # memory is taken as it is written
    crossed, bent = rim - 5 * apart, rim - 4 * apart  # rows before these have been
    for y in range(rim, height - rim):
        while bent <= y + 4 * apart:
            while crossed <= bent + apart:
                _cross_row(plane, crossed, apart, crosses[crossed % len(crosses)])
                crossed += 1
            around = crosses[(bent - apart) % len(crosses)], crosses[bent % len(crosses)], crosses[(bent + apart) % len(crosses)]
            _bend_row(plane, bent, apart, around, bends[bent % ring])
            bent += 1
        top = _boldest(bends, y, marks, rim, room[0], room[1])
        _light_row(light, y, rows_between, cols_between, blended, lit)
        before, least = asked, np.float32(STROKE_LOSS) * low
        for x in range(inner):
            cols[asked] = rim + x
            asked += top[x] >= least * (offset + lit[rim + x])
        for i in range(before, asked):
            rows[i], below[i] = y, offset + lit[cols[i]]
        done = 0
        while asked - done >= BATCH or (y == height - rim - 1 and done < asked):
            some = min(asked - done, BATCH)
            count = _crests_among(
                plane, rows[done : done + some], cols[done : done + some], below[done : done + some], banks, half, long, low, scratch, found, count
            )
            done += some
        for i in range(done, asked):
            rows[i - done], cols[i - done], below[i - done] = rows[i], cols[i], below[i]
        asked -= done
    return found[:, :count]


@njit(cache=True, nogil=True)
def _crests_among(plane, rows, cols, below, banks, half, long, low, scratch, found, count):
    """Write to found (7, n), after the ``count`` that are there, the crests among some pixels; returns how many there are then.

    below: offset + light at each. banks, all folded: ``seek`` and ``odd`` find crests, ``narrow`` tells their strength, ``wide`` their angle.
    """
    seek, odd, narrow, wide = banks
    flat, width = plane.ravel(), plane.shape[1]
    steep, asked, odd_room, long_room = scratch
    odd_patch, long_patch = odd_room[: odd.shape[1]], long_room[: narrow.shape[1]]
    _ask(plane, rows, cols, seek, half, asked)
    for i in range(len(rows)):
        y, x, b, value, least = rows[i], cols[i], asked.best[i], asked.top[i], low * below[i]
        if value < least:
            continue
        _fold_patch_odd(flat, width, y, x, half, odd_room, 0)
        step = _dot(odd_patch, odd[b]) / value
        if abs(step) * steep[b] > 0.6:  # the crest belongs to another pixel
            continue
        _fold_patch(flat, width, y, x, long, long_room, 0)
        if _dot(long_patch, narrow[b]) < TURNED_LOSS * least:
            continue
        turned, left, middle, right = _climbed(long_patch, wide, b)
        fraction = np.float32(0)
        if middle > left and middle > right:  # else it is still climbing
            fraction = np.float32(0.5) * (left - right) / (left - 2 * middle + right)
        value = _dot(long_patch, narrow[turned])
        strength = value / below[i]
        if value < least or strength < low:
            continue
        found[0, count], found[1, count], found[2, count], found[3, count] = y, x, strength, _turned(turned, fraction, BINS)
        found[4, count], found[5, count], found[6, count] = step, max(middle, np.float32(0.1) * value) / value, b
        count += 1
    return count


@njit(cache=True, nogil=True)
def _runs(row, col, begins, strength, along, shift, high, length):
    """Crests on a run of ``length`` whose mean strength is >= high: (n,) bool. A run that ends early counts 0 for what it lacks;
    each crest of it continues the one before, as ``_links`` tells."""
    links = _links(row, col, begins, strength, along, shift)
    keep = np.zeros(len(row), np.bool_)
    run = np.empty(length, np.int64)
    for start in range(len(row)):
        for side in range(2):
            i, ahead, count, total = start, side, 0, 0.0
            while True:
                run[count] = i
                total += strength[i]
                count += 1
                following = links[i, ahead]
                if count == length or following < 0:
                    break
                if along[i, 0] * along[following, 0] + along[i, 1] * along[following, 1] < 0:  # told the other way round
                    ahead = 1 - ahead
                i = following
            if total >= high * length:
                for i in run[:count]:
                    keep[i] = True
    return keep


@njit(cache=True, nogil=True)
def _links(row, col, begins, strength, along, shift):
    """For each crest (n,) the one that continues it along its angle and the one against it: (n, 2), -1 where none does.

    Of the eight neighbours, the strongest whose crest lies ahead, turned by no more than TURN_DEG, where neither lies
    farther than BESIDE_PX beside the line through the other; the nearer to that line, the better. begins: where rows begin.
    """
    links = np.full((len(row), 2), -1, np.int64)
    least = np.float32(np.cos(np.radians(TURN_DEG)))
    best, at = np.zeros(2, np.float32), np.zeros(3, np.int64)
    for y in range(len(begins) - 1):
        first, last = max(y - 1, 0), min(y + 1, len(begins) - 2)
        for j in range(first, last + 1):
            at[j - first] = begins[j]
        for i in range(begins[y], begins[y + 1]):
            best[:] = 0
            for j in range(first, last + 1):
                while at[j - first] < begins[j + 1] and col[at[j - first]] < col[i] - 1:
                    at[j - first] += 1
                for other in range(at[j - first], min(at[j - first] + 3, begins[j + 1])):
                    if other == i or col[other] > col[i] + 1 or abs(along[i, 0] * along[other, 0] + along[i, 1] * along[other, 1]) < least:
                        continue
                    # from crest to crest
                    u = np.float32(col[other] - col[i]) - shift[other] * along[other, 1] + shift[i] * along[i, 1]
                    v = np.float32(y - j) + shift[other] * along[other, 0] - shift[i] * along[i, 0]
                    ahead = u * along[i, 0] + v * along[i, 1]
                    beside = max(abs(v * along[i, 0] - u * along[i, 1]), abs(v * along[other, 0] - u * along[other, 1]))
                    if abs(ahead) < 0.5 or beside > BESIDE_PX:
                        continue
                    side = 0 if ahead > 0 else 1
                    worth = strength[other] * (1 - np.float32(0.5 / BESIDE_PX) * beside)
                    if worth > best[side]:
                        best[side], links[i, side] = worth, other
    return links


# ---- the operator of the paper ---------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _mirrored(i, count):
    """Place in [0, count) of what a plane mirrored at its ends has at i."""
    i %= 2 * count
    return min(i, 2 * count - 1 - i)


@njit(cache=True, nogil=True)
def _blurred(plane, weights):
    """A plane (H, W) convolved each way with a symmetric filter, the middle and right half of which is weights (n,); mirrored at the rim."""
    height, width = plane.shape
    reach = len(weights) - 1
    blurred, line = np.empty((height, width), np.float32), np.empty(width + 2 * reach, np.float32)
    for y in range(height):
        row, inner = plane[y], line[reach : reach + width]
        for x in range(width):
            inner[x] = weights[0] * row[x]
        for k in range(1, reach + 1):
            above, below, weight = plane[_mirrored(y - k, height)], plane[_mirrored(y + k, height)], weights[k]
            for x in range(width):
                inner[x] += weight * (above[x] + below[x])
        for k in range(1, reach + 1):
            line[reach - k], line[reach + width - 1 + k] = inner[_mirrored(-k, width)], inner[_mirrored(width - 1 + k, width)]
        into = blurred[y]
        for x in range(width):
            into[x] = weights[0] * inner[x]
        for k in range(1, reach + 1):
            left, right, weight = line[reach - k : reach - k + width], line[reach + k : reach + k + width], weights[k]
            for x in range(width):
                into[x] += weight * (left[x] + right[x])
    return blurred


@njit(cache=True, nogil=True)
def _may_peak(blurred, y, offset, low, may):
    """Where on row y of a blurred plane there may be a relative peak M' >= low across any angle whatever: may (W - 2,) uint8.

    M' >= low says that M1 and M2, the light a pixel away on either side, are both at most t = (M - low c) / (1 + low), and so is
    their mean. As the angle turns by a quarter, that mean less M is f h + g v + k d: h, v and d are the means of the opposite
    neighbours in the row, the column and on one diagonal, less M; with a and b the sine and cosine, f = a - a b, g = b - a b, k = a b.
    It is looked up at every eighth of pi. Between two of these, a function differs from its chord by at most (pi/8)^2 / 8 times its
    greatest second derivative, which is 2 for each of f, g and k: so the mean is nowhere less than its least chord - 0.0386 (|h| + |v| +
    |d|). And as bilinear interpolation lies between its pixels, one of the three neighbours on either side must be at most t.
    """
    inner = blurred.shape[1] - 2
    row, above, below = blurred[y], blurred[y - 1], blurred[y + 1]
    m, w, e = row[1 : 1 + inner], row[:inner], row[2 : 2 + inner]
    n, nw, ne = above[1 : 1 + inner], above[:inner], above[2 : 2 + inner]
    s, sw, se = below[1 : 1 + inner], below[:inner], below[2 : 2 + inner]
    part, less = np.float32(1 / (1 + low)), np.float32(low * offset / (1 + low))
    sine, cosine = np.sin(np.pi / 8), np.cos(np.pi / 8)
    small, large, both, quarter = (
        np.float32(sine * (1 - cosine)),
        np.float32(cosine * (1 - sine)),
        np.float32(sine * cosine),
        np.float32(np.sqrt(0.5) - 0.5),
    )
    half, bow, rounding = np.float32(0.5), np.float32(1.001 * np.pi**2 / 256), np.float32(4e-6)
    for x in range(inner):
        most = part * m[x] - less + rounding * abs(m[x])
        h, v = half * (w[x] + e[x]) - m[x], half * (n[x] + s[x]) - m[x]
        d, r = half * (nw[x] + se[x]) - m[x], half * (sw[x] + ne[x]) - m[x]
        straight, cross = min(h, v), min(small * h + large * v, large * h + small * v)
        middle = quarter * (h + v)
        size = abs(h) + abs(v)
        falls = min(min(straight, cross + both * d), middle + half * d) - bow * (size + abs(d))
        rises = min(min(straight, cross + both * r), middle + half * r) - bow * (size + abs(r))
        falling = max(max(min(min(n[x], w[x]), nw[x]), min(min(s[x], e[x]), se[x])), m[x] + falls)
        rising = max(max(min(min(n[x], e[x]), ne[x]), min(min(s[x], w[x]), sw[x])), m[x] + rises)
        may[x] = min(falling, rising) <= most


@njit(cache=True, nogil=True)
def _bilinear(image, y, x):
    y0, x0 = int(np.floor(y)), int(np.floor(x))
    fy, fx = np.float32(y - y0), np.float32(x - x0)
    top = image[y0, x0] + fx * (image[y0, x0 + 1] - image[y0, x0])
    low = image[y0 + 1, x0] + fx * (image[y0 + 1, x0 + 1] - image[y0 + 1, x0])
    return top + fy * (low - top)


@njit(cache=True, nogil=True)
def _relative_peaks(blurred, filters, half, offset, low):
    """Crests by the paper's relative peak M' of a blurred plane (H, W): row, column, strength, angle, shift and breadth (not told, 0),
    (n,) each. filters: folded."""
    height, width = blurred.shape
    may = np.empty(max(width - 2, 0), np.uint8)
    asked, rows, cols = 0, np.empty(BATCH + width, np.int64), np.empty(BATCH + width, np.int64)
    scratch = _scratch(filters)
    found, count = np.empty((6, max(height - 2 * half, 0) * max(width - 2 * half, 0)), np.float32), 0  # memory is taken as it is written
    for y in range(half, height - half):
        _may_peak(blurred, y, offset, low, may)
        before = asked
        for x in range(half, width - half):
            cols[asked] = x
            asked += may[x - 1]
        rows[before:asked] = y
        done = 0
        while asked - done >= BATCH or (y == height - half - 1 and done < asked):
            some = min(asked - done, BATCH)
            count = _peaks_among(blurred, rows[done : done + some], cols[done : done + some], filters, half, offset, low, scratch, found, count)
            done += some
        for i in range(done, asked):
            rows[i - done], cols[i - done] = rows[i], cols[i]
        asked -= done
    return found[0, :count], found[1, :count], found[2, :count], found[3, :count], found[4, :count], found[5, :count]


@njit(cache=True, nogil=True)
def _peaks_among(blurred, rows, cols, filters, half, offset, low, scratch, found, count):
    """Write to found (6, n), after the ``count`` that are there, the crests among some pixels; returns how many there are then."""
    answers, best = scratch.answers, scratch.best
    bins = len(filters)
    _ask(blurred, rows, cols, filters, half, scratch)
    for i in range(len(rows)):
        y, x, b = rows[i], cols[i], best[i]
        left, right = answers[b - 1 if b else bins - 1, i], answers[b + 1 if b + 1 < bins else 0, i]
        bend = left - 2 * answers[b, i] + right
        fraction = np.float32(0.5) * (left - right) / bend if bend < 0 else np.float32(0)
        phi = _turned(b, fraction, bins)
        du, dv = -np.sin(phi), np.cos(phi)
        m = blurred[y, x]
        m1, m2 = _bilinear(blurred, y - dv, x + du), _bilinear(blurred, y + dv, x - du)
        below = max(m1, m2)
        if below + offset <= 0 or m - below < low * (below + offset):
            continue
        strength = (m - below) / (below + offset)
        if strength < low:
            continue
        found[0, count], found[1, count], found[2, count], found[3, count] = y, x, strength, phi
        found[4, count], found[5, count] = np.float32(0.5) * (m1 - m2) / (2 * m - m1 - m2), 0
        count += 1
    return count


@njit(cache=True, nogil=True)
def _hysteresis(row, col, begins, strength, high):
    """Crests that hang together (8 neighbours) with one >= high: (n,) bool. begins: where rows begin."""
    parent = np.arange(len(row))
    for y in range(len(begins) - 1):
        above = begins[y - 1] if y else 0
        for i in range(begins[y], begins[y + 1]):
            if i > begins[y] and col[i - 1] == col[i] - 1:
                parent[_root(parent, i)] = _root(parent, i - 1)
            while above < begins[y] and col[above] < col[i] - 1:
                above += 1
            for other in range(above, min(above + 3, begins[y])):
                if col[other] <= col[i] + 1:
                    parent[_root(parent, i)] = _root(parent, other)
    strong = np.zeros(len(row), np.bool_)
    for i in range(len(row)):
        if strength[i] >= high:
            strong[_root(parent, i)] = True
    keep = np.empty(len(row), np.bool_)
    for i in range(len(row)):
        keep[i] = strong[_root(parent, i)]
    return keep


@njit(cache=True, nogil=True)
def _root(parent, i):
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i
