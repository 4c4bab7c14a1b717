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

from .raw import reduced

BINS = 32  # orientations of a bank, over 180 degrees
LEAST_PX = 100  # of a photograph's sides: it is not reduced any further
LIGHT_PX, LIGHT_BLOCK = 8.0, 4  # sigma of the Gaussian that tells the light around a pixel; it is told for blocks
COARSE_PX, COARSE_EVERY = 1.5, 4  # sigma along the hair of the filters that say where one may be, and of how many bins one is asked
COARSE_LOSS = 0.5  # their least answer to a ridge, in parts of that of the filters that seek it
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
        strength, _, _, breadth = _measure(plane, replace(params, offset=float(plane.mean())))
        around = ndimage.gaussian_filter(plane, LIGHT_PX)
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
    strength, angle, shift, breadth = _measure(plane, params)
    rows, cols = np.nonzero(_kept(strength, angle, shift, params))
    angle, shift = angle[rows, cols], shift[rows, cols]
    # the normal of a hair at `angle` is (-sin, cos) in (u, v); rows run down, v runs up
    col, row = cols - shift * np.sin(angle), rows - shift * np.cos(angle)
    return Ridges(*(np.asarray(a, np.float32) for a in (col, row, angle, strength[rows, cols], breadth[rows, cols])))


def response(plane: np.ndarray, params: RidgeParams) -> np.ndarray:
    """Strength (H, W) float32 of the ridge at each pixel of a channel plane (H, W), 0 where there is none; for pictures."""
    strength, angle, shift, _ = _measure(plane, params)
    return np.where(_kept(strength, angle, shift, params), strength, 0).astype(np.float32)


def _kept(strength, angle, shift, params):
    """Which crests (H, W) are ridges, bool."""
    if params.operator == "paper":
        return _hysteresis(strength, params.low, params.high)
    return _runs(strength, angle, shift, params.low, params.high, params.run_px)


def _measure(plane, params):
    """(strength, angle, shift, breadth), each (H, W) float32; strength is 0 off the crests, shift is along the normal in px."""
    plane = np.ascontiguousarray(plane, np.float32)
    if params.offset is None:
        params = estimate([plane], replace(params, reduce=1))
    with _blas().limit(limits=1):  # a row is too little for two threads, which wait for each other ten times as long
        return _measure_alone(plane, params)


@lru_cache(maxsize=1)
def _blas() -> ThreadpoolController:
    return ThreadpoolController()


def _measure_alone(plane, params):
    if params.operator == "paper":
        blurred = ndimage.gaussian_filter(plane, params.blur_px, truncate=4.0)
        bank = gabor_bank()
        return _relative_peaks(blurred, _folded(bank), bank.shape[1] // 2, np.float32(params.offset), np.float32(params.low))
    even, odd = line_banks(params.across_px, params.seek_px)
    narrow, wide = (line_banks(across_px, params.along_px)[0] for across_px in (params.across_px, params.turn_px))
    coarse, _ = line_banks(params.across_px, COARSE_PX)
    banks = _folded(coarse[::COARSE_EVERY]), np.ascontiguousarray(_folded(even).T), odd, _folded(narrow), _folded(wide)
    return _line_peaks(plane, *banks, narrow.shape[1] // 2, _light_around(plane), np.float32(params.offset), np.float32(params.low))


def _light_around(plane):
    """Light around blocks of LIGHT_BLOCK pixels of a plane (H, W): (h, w) float32."""
    return ndimage.gaussian_filter(reduced(plane, LIGHT_BLOCK), LIGHT_PX / LIGHT_BLOCK)


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


# ---- kernels ---------------------------------------------------------------------------------------------------------
#
# A bank of even filters is one matrix product a row: the pixels at +(j, i) and -(j, i) are added first, which halves the
# work, and the (B, (k k + 1) / 2) filters times the (…, W) sums run at the speed of sgemm. Eight filters 7x7 for every pixel are
# 400 flops; that and the sums, 25 numbers a pixel written and read in the cache, are the bound of this stage. All 32 filters 11x11
# would be 3904; they are asked where the eight say that there may be a hair, and the long ones on crests.


def _folded(bank: np.ndarray) -> np.ndarray:
    """The first half of each even filter of a bank (B, k, k), centre last: (B, (k k + 1) / 2) float32."""
    half = (bank.shape[1] * bank.shape[2]) // 2 + 1
    return np.ascontiguousarray(bank.reshape(len(bank), -1)[:, :half])


@njit(cache=True, fastmath=True, nogil=True)
def _fold_row(image, y, half, sums):
    """sums[t] (W - 2 half) = pixels at offset t of a k x k patch, k = 2 half + 1, plus those opposite, around row y."""
    size = 2 * half + 1
    count = image.shape[1] - 2 * half
    for t in range(size * size // 2):
        j, i = t // size, t % size
        a, b = image[y - half + j, i : i + count], image[y + half - j, 2 * half - i : 2 * half - i + count]
        line = sums[t]
        for x in range(count):
            line[x] = a[x] + b[x]
    sums[size * size // 2] = image[y, half : half + count]


@njit(cache=True, fastmath=True, nogil=True)
def _strongest(values, x):
    """(bin, fraction of a bin, value) of the strongest of values (B, W) in column x, by a parabola."""
    bins = values.shape[0]
    best = 0
    for b in range(1, bins):
        if values[b, x] > values[best, x]:
            best = b
    left, right = values[best - 1 if best else bins - 1, x], values[best + 1 if best + 1 < bins else 0, x]
    bend = left - 2 * values[best, x] + right
    fraction = np.float32(0.5) * (left - right) / bend if bend < 0 else np.float32(0)
    return best, fraction, values[best, x]


@njit(cache=True, fastmath=True, nogil=True)
def _bilinear(image, y, x):
    y0, x0 = int(np.floor(y)), int(np.floor(x))
    fy, fx = np.float32(y - y0), np.float32(x - x0)
    top = image[y0, x0] + fx * (image[y0, x0 + 1] - image[y0, x0])
    low = image[y0 + 1, x0] + fx * (image[y0 + 1, x0 + 1] - image[y0 + 1, x0])
    return top + fy * (low - top)


@njit(cache=True, fastmath=True, nogil=True)
def _turned(best, fraction, bins):
    """Angle of the hair in [0, pi) between the bins, and the sign by which its normal turned over on the way there."""
    phi = (best + fraction) * np.pi / bins
    if phi < 0:
        return phi + np.pi, np.float32(-1)
    if phi >= np.pi:
        return phi - np.pi, np.float32(-1)
    return phi, np.float32(1)


@njit(cache=True, fastmath=True, nogil=True)
def _relative_peaks(blurred, filters, half, offset, low):
    """The paper's relative peak M' of a blurred plane (H, W) and the angle, shift and (not told) breadth of its crests; four (H, W) arrays."""
    height, width = blurred.shape
    strength = np.zeros((height, width), np.float32)
    angle, shift, breadth = np.zeros_like(strength), np.zeros_like(strength), np.zeros_like(strength)
    sums = np.empty((filters.shape[1], width - 2 * half), np.float32)
    values = np.empty((filters.shape[0], width - 2 * half), np.float32)
    for y in range(half, height - half):
        _fold_row(blurred, y, half, sums)
        np.dot(filters, sums, values)
        for x in range(half, width - half):
            best, fraction, _ = _strongest(values, x - half)
            phi, _ = _turned(best, fraction, filters.shape[0])
            du, dv = -np.sin(phi), np.cos(phi)
            m = blurred[y, x]
            m1, m2 = _bilinear(blurred, y - dv, x + du), _bilinear(blurred, y + dv, x - du)
            below = max(m1, m2)
            if below + offset <= 0 or m - below < low * (below + offset):
                continue
            strength[y, x] = (m - below) / (below + offset)
            angle[y, x] = phi
            shift[y, x] = np.float32(0.5) * (m1 - m2) / (2 * m - m1 - m2)
    return strength, angle, shift, breadth


@njit(cache=True, fastmath=True, nogil=True)
def _answer(plane, y, x, weights):
    """Response of one filter (k, k) at a pixel."""
    size = weights.shape[0]
    half = size // 2
    total = np.float32(0)
    for j in range(size):
        line, row = plane[y - half + j, x - half : x + half + 1], weights[j]
        for i in range(size):
            total += line[i] * row[i]
    return total


@njit(cache=True, fastmath=True, nogil=True)
def _fold_patch(image, y, x, half, patch):
    """patch[t] = pixel t of the k x k patch around a pixel, k = 2 half + 1, plus the one opposite; the centre last."""
    size = 2 * half + 1
    for j in range(half):
        a, b = image[y - half + j, x - half : x + half + 1], image[y + half - j, x - half : x + half + 1]
        for i in range(size):
            patch[j * size + i] = a[i] + b[size - 1 - i]
    for i in range(half):
        patch[half * size + i] = image[y, x - half + i] + image[y, x + half - i]
    patch[half * size + half] = image[y, x]


@njit(cache=True, fastmath=True, nogil=True)
def _dot(a, b):
    total = np.float32(0)
    for t in range(len(a)):
        total += a[t] * b[t]
    return total


@njit(cache=True, fastmath=True, nogil=True)
def _climbed(patch, bank, best):
    """(bin, answers of the bin before, of it, and of the next) of the strongest of folded filters (B, n) on a folded patch (n,),
    climbing from bin ``best`` for four bins at most."""
    bins = len(bank)
    left, middle, right = _dot(patch, bank[(best - 1) % bins]), _dot(patch, bank[best]), _dot(patch, bank[(best + 1) % bins])
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


@njit(cache=True, fastmath=True, nogil=True)
def _light_row(light, y, row):
    """Fill row (W,) with the light at row y of a photograph between the middles of its blocks, light (h, w)."""
    at = min(max((y + np.float32(0.5)) / LIGHT_BLOCK - np.float32(0.5), np.float32(0)), np.float32(light.shape[0] - 1))
    j = min(int(at), max(light.shape[0] - 2, 0))
    upper, lower, part = light[j], light[min(j + 1, light.shape[0] - 1)], np.float32(at - j)
    for x in range(len(row)):
        across = min(max((x + np.float32(0.5)) / LIGHT_BLOCK - np.float32(0.5), np.float32(0)), np.float32(light.shape[1] - 1))
        i = min(int(across), max(light.shape[1] - 2, 0))
        k, f = min(i + 1, light.shape[1] - 1), np.float32(across - i)
        one, two = upper[i] + part * (lower[i] - upper[i]), upper[k] + part * (lower[k] - upper[k])
        row[x] = one + f * (two - one)


@njit(cache=True, fastmath=True, nogil=True)
def _line_peaks(plane, coarse, filters, odd, narrow, wide, rim, light, offset, low):
    """Crests of the line filters' response over (offset + light), their angle, shift and breadth; four (H, W) arrays.

    A few filters that are short, and so answer to many angles, say where there may be one; there a bank of longer ones (``filters``)
    seeks it, and where it is, long filters tell its strength (``narrow``) and angle (``wide``). All banks but ``odd`` are folded, and
    ``filters`` turned, (n, BINS); rim is half the width of the long ones. light (h, w): that around blocks of LIGHT_BLOCK pixels.
    """
    height, width = plane.shape
    half, short = odd.shape[1] // 2, int(np.sqrt(2 * coarse.shape[1])) // 2
    strength = np.zeros((height, width), np.float32)
    angle, shift, breadth = np.zeros_like(strength), np.zeros_like(strength), np.zeros_like(strength)
    sums = np.empty((coarse.shape[1], width - 2 * short), np.float32)
    values = np.empty((coarse.shape[0], width - 2 * short), np.float32)
    top, least_of, lit = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
    cols, near, answers = np.empty(width, np.int32), np.empty((width, len(filters)), np.float32), np.empty((width, BINS), np.float32)
    patch = np.empty(narrow.shape[1], np.float32)
    for y in range(rim, height - rim):
        _fold_row(plane, y, short, sums)
        np.dot(coarse, sums, values)
        _light_row(light, y, lit)
        top[:] = 0
        for b in range(len(coarse)):
            line, into = values[b], top[short : width - short]
            for x in range(len(line)):
                into[x] = max(into[x], line[x])
        for x in range(width):
            least_of[x] = low * (offset + lit[x])
        asked = 0
        for x in range(rim, width - rim):
            if top[x] >= COARSE_LOSS * least_of[x]:
                cols[asked] = x
                _fold_patch(plane, y, x, half, near[asked])
                asked += 1
        if asked == 0:
            continue
        np.dot(near[:asked], filters, answers[:asked])
        for i in range(asked):
            x, best = cols[i], 0
            answer, least = answers[i], least_of[x]
            for b in range(1, BINS):
                if answer[b] > answer[best]:
                    best = b
            value = answer[best]
            if value < least:
                continue
            step = _answer(plane, y, x, odd[best]) / value
            phi = best * np.pi / BINS
            if abs(step) * max(abs(np.sin(phi)), abs(np.cos(phi))) > 0.6:  # the crest belongs to another pixel
                continue
            _fold_patch(plane, y, x, rim, patch)
            if _dot(patch, narrow[best]) < TURNED_LOSS * least:
                continue
            turned, left, middle, right = _climbed(patch, wide, best)
            fraction = np.float32(0)
            if middle > left and middle > right:  # else it is still climbing
                fraction = np.float32(0.5) * (left - right) / (left - 2 * middle + right)
            value = _dot(patch, narrow[turned])
            if value < least:
                continue
            angle[y, x], _ = _turned(turned, fraction, BINS)
            # the way to the crest along the normal of the bin, told along that of the angle
            strength[y, x] = value / (offset + lit[x])
            shift[y, x] = step * np.cos(phi - angle[y, x])
            breadth[y, x] = np.log(max(middle, np.float32(0.1) * value) / value)
    return strength, angle, shift, breadth


@njit(cache=True, nogil=True)
def _hysteresis(strength, low, high):
    """Pixels >= low that hang together (8 neighbours) with one >= high: (H, W) bool."""
    height, width = strength.shape
    keep = np.zeros((height, width), np.bool_)
    stack = np.empty(height * width, np.int64)
    for start in range(height * width):
        y, x = start // width, start % width
        if keep[y, x] or strength[y, x] < high:
            continue
        keep[y, x] = True
        stack[0] = start
        top = 1
        while top:
            top -= 1
            y, x = stack[top] // width, stack[top] % width
            for j in range(max(y - 1, 0), min(y + 2, height)):
                for i in range(max(x - 1, 0), min(x + 2, width)):
                    if not keep[j, i] and strength[j, i] >= low:
                        keep[j, i] = True
                        stack[top] = j * width + i
                        top += 1
    return keep


@njit(cache=True, nogil=True)
def _runs(strength, angle, shift, low, high, length):
    """Pixels >= low on a run of ``length`` whose mean strength is >= high: (H, W) bool. A run that ends early counts 0 for
    what it lacks; each pixel of it continues the one before, as ``_links`` tells."""
    rows, cols = np.nonzero(strength >= low)
    along_u, along_v = np.empty(len(rows), np.float32), np.empty(len(rows), np.float32)
    for i in range(len(rows)):
        phi = angle[rows[i], cols[i]]
        along_u[i], along_v[i] = np.cos(phi), np.sin(phi)
    links = _links(strength, shift, rows, cols, along_u, along_v)
    keep = np.zeros(strength.shape, np.bool_)
    run = np.empty(length, np.int64)
    for start in range(len(rows)):
        for side in range(2):
            i, ahead, count, total = start, side, 0, 0.0
            while True:
                run[count] = i
                total += strength[rows[i], cols[i]]
                count += 1
                following = links[i, ahead]
                if count == length or following < 0:
                    break
                if along_u[i] * along_u[following] + along_v[i] * along_v[following] < 0:  # told the other way round
                    ahead = 1 - ahead
                i = following
            if total >= high * length:
                for i in run[:count]:
                    keep[rows[i], cols[i]] = True
    return keep


@njit(cache=True, nogil=True)
def _links(strength, shift, rows, cols, along_u, along_v):
    """For each ridge pixel (n,) the one that continues it along its angle and the one against it: (n, 2), -1 where none does.

    Of the eight neighbours, the strongest whose crest lies ahead, turned by no more than TURN_DEG, where neither lies
    farther than BESIDE_PX beside the line through the other; the nearer to that line, the better.
    """
    height, width = strength.shape
    number = np.full((height, width), -1, np.int32)
    links = np.full((len(rows), 2), -1, np.int32)
    least = np.cos(np.radians(TURN_DEG))
    for i in range(len(rows)):
        number[rows[i], cols[i]] = i
    for i in range(len(rows)):
        y, x = rows[i], cols[i]
        best = np.zeros(2, np.float32)
        for j in range(max(y - 1, 0), min(y + 2, height)):
            for k in range(max(x - 1, 0), min(x + 2, width)):
                other = number[j, k]
                if other < 0 or other == i or abs(along_u[i] * along_u[other] + along_v[i] * along_v[other]) < least:
                    continue
                u = k - x - shift[j, k] * along_v[other] + shift[y, x] * along_v[i]  # from crest to crest
                v = y - j + shift[j, k] * along_u[other] - shift[y, x] * along_u[i]
                ahead = u * along_u[i] + v * along_v[i]
                beside = max(abs(v * along_u[i] - u * along_v[i]), abs(v * along_u[other] - u * along_v[other]))
                if abs(ahead) < 0.5 or beside > BESIDE_PX:
                    continue
                side = 0 if ahead > 0 else 1
                worth = strength[j, k] * (1 - 0.5 * beside / BESIDE_PX)
                if worth > best[side]:
                    best[side], links[i, side] = worth, other
    return links
