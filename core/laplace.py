"""Laplace's equation on a grid of cells, of which some are known and some take no part: directions carried into empty hair (sec. 4.3).

Conjugate gradients with a V-cycle of multigrid before each step. The V-cycle alone gains little where single voxels are known, since
a coarser grid does not see them well; the gradients then need few steps. Fields have a rim of one cell, which stays 0, as OUTSIDE
cells do: the sum of the six neighbours is then that of those that take part, and a row of cells is one loop without a branch.
"""

from typing import NamedTuple

import numpy as np
from numba import njit, prange

UNKNOWN, KNOWN, OUTSIDE = 0, 1, 2  # cells: to solve, given, no part of it (no flux into it)
_FEW_CELLS = 4096  # a grid this small is solved by plain sweeps
_SWEEPS_OF_FEW = 30
_START_SWEEPS = 4
_SLAB = 16  # slices of the grid that are relaxed one after the other


class _Level(NamedTuple):
    """A grid; arrays (nx + 2, ny + 2, nz + 2) with the rim."""

    kinds: np.ndarray  # uint8
    count: np.ndarray  # uint8: neighbours that take part of an UNKNOWN cell, else 0
    span: np.ndarray  # (nx + 2, ny + 2, 2) int32: the first UNKNOWN cell of a row, and the one after the last


def laplace_fill(values: np.ndarray, kinds: np.ndarray, cycles: int = 12, tolerance: float = 1e-5) -> np.ndarray:
    """Solve Laplace's equation for each component: values (nx, ny, nz, c) float32 -> the same with UNKNOWN cells solved.

    kinds (nx, ny, nz) uint8: KNOWN cells keep their values and are the boundary condition; through the faces towards
    OUTSIDE cells and the grid's border nothing flows. At most so many V-cycles, until the residual is nowhere above the tolerance (of the
    mean of six neighbours minus the cell). Cells that no KNOWN one is connected with become alike, whatever it is.
    """
    levels = [_level(np.pad(np.asarray(kinds, np.uint8), 1, constant_values=OUTSIDE))]
    while levels[-1].kinds.size > _FEW_CELLS:
        levels.append(_level(_coarser_kinds(levels[-1].kinds)))
    filled, (u, *rooms) = np.empty(values.shape, np.float32), np.zeros((5, *levels[0].kinds.shape), np.float32)
    inner = u[1:-1, 1:-1, 1:-1]
    for c in range(filled.shape[3]):
        inner[:] = np.where(kinds == KNOWN, values[..., c], 0)
        _start(u, levels, rooms[0])
        _climb(u, levels, cycles, tolerance, rooms)
        filled[..., c] = inner
    return filled


def _climb(u, levels, cycles, tolerance, rooms):
    """Conjugate gradients (Polak and Ribière's, for the V-cycle is not symmetric) on the UNKNOWN cells of u; rooms: four arrays like it,
    0 where no cell is UNKNOWN."""
    count, span = levels[0].count, levels[0].span
    residual, correction, way, image = rooms
    steep = 1.0
    if _flow(u, count, span, residual) <= tolerance:
        return
    for cycle in range(cycles):
        _v_cycle(correction, residual, levels, 0)
        along, lately = _products(correction, residual, image, span)
        _turn(way, correction, np.float32(lately / steep if cycle else 0.0), span)  # without what the last way has told already
        steep = _apply(way, count, span, image)
        if not steep > 0:
            return
        if _move(u, residual, way, image, np.float32(along / steep), span) <= tolerance:
            return


def _start(u, levels, nothing):
    """Coarse to fine: the means of the known values, solved on the coarser grid, are the first guess of the finer one. ``nothing``: an
    array like u, which becomes 0."""
    if len(levels) > 1:
        coarse = _coarser_values(u, levels[0].kinds, levels[1].kinds)
        _start(coarse, levels[1:], np.empty_like(coarse))
        _prolong(coarse, levels[1].kinds, levels[0].count, levels[0].span, u)
    nothing[:] = 0
    for _ in range(_START_SWEEPS if len(levels) > 1 else 2 * _SWEEPS_OF_FEW):
        _relax(u, nothing, levels[0].count, levels[0].span, True)


def _v_cycle(u, wanted, levels, number):
    """One V-cycle from 0 for count · cell − Σ neighbours = wanted; fills u."""
    level = levels[number]
    u[:] = 0
    _relax(u, wanted, level.count, level.span, True)
    if number + 1 == len(levels):
        for sweep in range(2 * _SWEEPS_OF_FEW):
            _relax(u, wanted, level.count, level.span, sweep % 2 == 1)
        return
    below = levels[number + 1]
    coarse = _coarser_residual(u, wanted, level.count, level.span, below.count)
    correction = np.zeros_like(coarse)
    _v_cycle(correction, coarse, levels, number + 1)
    _prolong(correction, below.kinds, level.count, level.span, u)
    _relax(u, wanted, level.count, level.span, False)


# ---- grids -----------------------------------------------------------------------------------------------------------


def _level(kinds) -> _Level:
    count, span = np.zeros(kinds.shape, np.uint8), np.zeros((*kinds.shape[:2], 2), np.int32)
    _count(kinds, count, span)
    return _Level(kinds, count, span)


@njit(cache=True, nogil=True, parallel=True)
def _count(kinds, count, span):
    nx, ny, nz = kinds.shape
    for i in prange(1, nx - 1):
        for j in range(1, ny - 1):
            for k in range(1, nz - 1):
                if kinds[i, j, k] != UNKNOWN:
                    continue
                n = (kinds[i - 1, j, k] != OUTSIDE) + (kinds[i + 1, j, k] != OUTSIDE) + (kinds[i, j - 1, k] != OUTSIDE)
                n += (kinds[i, j + 1, k] != OUTSIDE) + (kinds[i, j, k - 1] != OUTSIDE) + (kinds[i, j, k + 1] != OUTSIDE)
                if n == 0:
                    continue
                count[i, j, k] = n
                if span[i, j, 1] == 0:
                    span[i, j, 0] = k
                span[i, j, 1] = k + 1


@njit(cache=True, nogil=True)
def _children(i, size):
    """The first of the cells that a coarser cell i holds, and the one after the last, in a grid of ``size`` with its rim."""
    return 2 * i - 1, min(2 * i + 1, size - 1)


@njit(cache=True, nogil=True, parallel=True)
def _coarser_kinds(kinds):
    """Half as many cells each way: KNOWN where any of the eight is, else the cycles diverge; OUTSIDE where all are."""
    nx, ny, nz = kinds.shape
    out = np.full(((nx - 1) // 2 + 2, (ny - 1) // 2 + 2, (nz - 1) // 2 + 2), OUTSIDE, np.uint8)
    for i in prange(1, out.shape[0] - 1):
        for j in range(1, out.shape[1] - 1):
            for k in range(1, out.shape[2] - 1):
                kind, (a0, a1), (b0, b1), (c0, c1) = OUTSIDE, _children(i, nx), _children(j, ny), _children(k, nz)
                for a in range(a0, a1):
                    for b in range(b0, b1):
                        for c in range(c0, c1):
                            if kinds[a, b, c] == KNOWN:
                                kind = KNOWN
                            elif kinds[a, b, c] == UNKNOWN and kind == OUTSIDE:
                                kind = UNKNOWN
                out[i, j, k] = kind
    return out


@njit(cache=True, nogil=True, parallel=True)
def _coarser_values(u, kinds, coarse_kinds):
    """Means of the KNOWN children."""
    nx, ny, nz = u.shape
    out = np.zeros(coarse_kinds.shape, np.float32)
    for i in prange(1, out.shape[0] - 1):
        for j in range(1, out.shape[1] - 1):
            for k in range(1, out.shape[2] - 1):
                if coarse_kinds[i, j, k] != KNOWN:
                    continue
                count, total, (a0, a1), (b0, b1), (c0, c1) = 0, np.float32(0), _children(i, nx), _children(j, ny), _children(k, nz)
                for a in range(a0, a1):
                    for b in range(b0, b1):
                        for c in range(c0, c1):
                            if kinds[a, b, c] == KNOWN:
                                count += 1
                                total += u[a, b, c]
                out[i, j, k] = total / np.float32(count)
    return out


@njit(cache=True, nogil=True, parallel=True)
def _coarser_residual(u, wanted, count, span, coarse_count):
    """Four times the mean of the children's wanted − (count · cell − Σ neighbours): a cell twice as wide bends a quarter as much."""
    nx, ny, nz = u.shape
    out = np.zeros(coarse_count.shape, np.float32)
    for i in prange(1, out.shape[0] - 1):
        total, row = np.empty(nz + 1, np.float32), np.empty(nz, np.float32)
        a0, a1 = _children(i, nx)
        for j in range(1, out.shape[1] - 1):
            b0, b1 = _children(j, ny)
            total[:] = 0
            for a in range(a0, a1):
                for b in range(b0, b1):
                    first, stop = span[a, b]
                    _row_flow(u, count, a, b, first, stop, row)
                    into, of, ask = total[first:stop], row[: stop - first], wanted[a, b, first:stop]
                    for k in range(len(into)):
                        into[k] += of[k] + ask[k]
            line, some = out[i, j], coarse_count[i, j]
            for k in range(1, len(line) - 1):
                line[k] = np.float32(0.5) * (total[2 * k - 1] + total[2 * k]) if some[k] else np.float32(0)
    return out


@njit(cache=True, nogil=True, parallel=True)
def _prolong(coarse, coarse_kinds, count, span, u):
    """Add the trilinear interpolation of the coarse cells that take part to the UNKNOWN fine ones."""
    f32, one = np.float32, np.uint64(1)
    (nx, ny, nz), (my, mz) = u.shape, coarse.shape[1:]
    f, some, c, kinds = u.reshape(-1), count.reshape(-1), coarse.reshape(-1), coarse_kinds.reshape(-1)
    for i in prange(1, nx - 1):
        values, shares, mean = np.empty(mz, np.float32), np.empty(mz, np.float32), np.zeros(2 * mz, np.float32)
        i0 = (i + 1) // 2
        i1 = i0 - 1 if i % 2 else i0 + 1
        for j in range(1, ny - 1):
            first, stop = span[i, j]
            if first == stop:
                continue
            j0 = (j + 1) // 2
            j1 = j0 - 1 if j % 2 else j0 + 1
            values[:] = 0
            shares[:] = f32(1e-6)  # none is divided by 0
            for a, b, weight in ((i0, j0, f32(0.5625)), (i0, j1, f32(0.1875)), (i1, j0, f32(0.1875)), (i1, j1, f32(0.0625))):
                o = np.uint64((a * my + b) * mz)
                for k in range(np.uint64(mz)):
                    values[k] += weight * c[o + k]
                    shares[k] += weight if kinds[o + k] != OUTSIDE else f32(0)
            for k in range(one, np.uint64(mz) - one):  # cell k holds 2 k − 1 and 2 k; that of the cell they are in counts three times
                mean[2 * k - one] = (f32(3) * values[k] + values[k - one]) / (f32(3) * shares[k] + shares[k - one])
                mean[2 * k] = (f32(3) * values[k] + values[k + one]) / (f32(3) * shares[k] + shares[k + one])
            o, at = np.uint64((i * ny + j) * nz + first), np.uint64(first)
            for k in range(np.uint64(stop - first)):
                f[o + k] += mean[at + k] if some[o + k] else f32(0)


# ---- sweeps ----------------------------------------------------------------------------------------------------------
#
# What bounds these is memory: arrays are read in the order in which they lie, rows told by where they begin in the flat array, the
# number of neighbours is a byte, and loops read few arrays at once, else the compiler does not make vectors of them.


@njit(cache=True, nogil=True, parallel=True)
def _relax(u, wanted, count, span, forward):
    """Put the mean of its neighbours (and what is wanted) into each cell, row after row, the cells of a row at once.

    Every second slab of slices goes first, then the others: so the result does not depend on which thread does what.
    """
    inner = len(u) - 2
    slabs = (inner + _SLAB - 1) // _SLAB
    for half in range(2):
        parity = half if forward else 1 - half
        for s in prange((slabs + 1 - parity) // 2):
            first = 1 + (2 * s + parity) * _SLAB
            _relax_slab(u, wanted, count, span, first, min(first + _SLAB, inner + 1), forward)


@njit(cache=True, nogil=True)
def _relax_slab(u, wanted, count, span, begin, end, forward):
    ny, nz = u.shape[1:]
    f, ask, some, row = u.reshape(-1), wanted.reshape(-1), count.reshape(-1), np.empty(nz, np.float32)
    slice_, line, one, f32 = np.uint64(ny * nz), np.uint64(nz), np.uint64(1), np.float32
    for at in range((end - begin) * (ny - 2)):
        step = at if forward else (end - begin) * (ny - 2) - 1 - at
        i, j = begin + step // (ny - 2), 1 + step % (ny - 2)
        first, stop = span[i, j]
        o, n = np.uint64((i * ny + j) * nz + first), np.uint64(stop - first)
        for k in range(n):
            row[k] = f[o + k - slice_] + f[o + k + slice_] + (f[o + k - line] + f[o + k + line])
        for k in range(n):
            m = f32(some[o + k])
            mean = (row[k] + (f[o + k - one] + f[o + k + one]) + ask[o + k]) / max(m, f32(1))
            row[k] = mean if m > 0 else f[o + k]
        for k in range(n):
            f[o + k] = row[k]


@njit(cache=True, nogil=True)
def _row_flow(u, count, i, j, first, stop, row):
    """row[: stop − first] = Σ neighbours − count · cell of UNKNOWN cells, 0 of others."""
    ny, nz = u.shape[1:]
    f, some = u.reshape(-1), count.reshape(-1)
    slice_, line, one, f32 = np.uint64(ny * nz), np.uint64(nz), np.uint64(1), np.float32
    o, n = np.uint64((i * ny + j) * nz + first), np.uint64(stop - first)
    for k in range(n):
        row[k] = f[o + k - slice_] + f[o + k + slice_] + (f[o + k - line] + f[o + k + line])
    for k in range(n):
        m = f32(some[o + k])
        flow = row[k] + (f[o + k - one] + f[o + k + one]) - m * f[o + k]
        row[k] = flow if m > 0 else f32(0)


# ---- gradients -------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True, parallel=True)
def _flow(u, count, span, out):
    """Fill out with Σ neighbours − count · cell of UNKNOWN cells; returns the largest size, a sixth of it."""
    nx, ny, nz = u.shape
    largest, into = np.zeros(nx, np.float32), out.reshape(-1)
    for i in prange(1, nx - 1):
        row, most = np.empty(nz, np.float32), np.zeros(nz, np.float32)
        for j in range(1, ny - 1):
            first, stop = span[i, j]
            _row_flow(u, count, i, j, first, stop, row)
            o = np.uint64((i * ny + j) * nz + first)
            for k in range(np.uint64(stop - first)):
                into[o + k] = row[k]
            _larger(into, o, stop - first, most)
        largest[i] = most.max()
    return largest.max() / 6


@njit(cache=True, nogil=True)
def _larger(values, o, n, most):
    """most[k] = the larger of it and of the size of values[o + k]."""
    for k in range(np.uint64(n)):
        size = abs(values[o + k])
        most[k] = size if size > most[k] else most[k]


@njit(cache=True, nogil=True, parallel=True)
def _products(one, two, three, span):
    """(one · two, one · three)."""
    nx, ny, nz = one.shape
    a, b, c, sums = one.reshape(-1), two.reshape(-1), three.reshape(-1), np.zeros((nx, 2))
    for i in prange(1, nx - 1):
        with_two, with_three = np.zeros(nz), np.zeros(nz)
        for j in range(1, ny - 1):
            first, stop = span[i, j]
            o, n = np.uint64((i * ny + j) * nz + first), np.uint64(stop - first)
            for k in range(n):
                with_two[k] += np.float64(a[o + k] * b[o + k])
            for k in range(n):
                with_three[k] += np.float64(a[o + k] * c[o + k])
        sums[i, 0], sums[i, 1] = with_two.sum(), with_three.sum()
    return sums[:, 0].sum(), sums[:, 1].sum()


@njit(cache=True, nogil=True, parallel=True)
def _turn(way, correction, back, span):
    """way = correction + back · way."""
    nx, ny, nz = way.shape
    a, b = way.reshape(-1), correction.reshape(-1)
    for i in prange(1, nx - 1):
        for j in range(1, ny - 1):
            first, stop = span[i, j]
            o = np.uint64((i * ny + j) * nz + first)
            for k in range(np.uint64(stop - first)):
                a[o + k] = b[o + k] + back * a[o + k]


@njit(cache=True, nogil=True, parallel=True)
def _apply(way, count, span, image):
    """Fill image with Σ neighbours − count · cell of UNKNOWN cells of way; returns − way · image."""
    nx, ny, nz = way.shape
    a, into, sums = way.reshape(-1), image.reshape(-1), np.zeros(nx)
    for i in prange(1, nx - 1):
        row, total = np.empty(nz, np.float32), np.zeros(nz)
        for j in range(1, ny - 1):
            first, stop = span[i, j]
            _row_flow(way, count, i, j, first, stop, row)
            o, n = np.uint64((i * ny + j) * nz + first), np.uint64(stop - first)
            for k in range(n):
                into[o + k] = row[k]
            for k in range(n):
                total[k] -= np.float64(a[o + k] * row[k])
        sums[i] = total.sum()
    return sums.sum()


@njit(cache=True, nogil=True, parallel=True)
def _move(u, residual, way, image, size, span):
    """Go so far along way, and change the residual by it; returns the largest residual, a sixth of it."""
    nx, ny, nz = u.shape
    a, b, c, d, largest = u.reshape(-1), residual.reshape(-1), way.reshape(-1), image.reshape(-1), np.zeros(nx, np.float32)
    for i in prange(1, nx - 1):
        most = np.zeros(nz, np.float32)
        for j in range(1, ny - 1):
            first, stop = span[i, j]
            o, n = np.uint64((i * ny + j) * nz + first), np.uint64(stop - first)
            for k in range(n):
                a[o + k] += size * c[o + k]
            for k in range(n):
                b[o + k] += size * d[o + k]
            _larger(b, o, n, most)
        largest[i] = most.max()
    return largest.max() / 6
