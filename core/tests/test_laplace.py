"""Laplace's equation against fields whose solution is known, and against a plain solver."""

import numba
import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg

from strandscope.core.laplace import KNOWN, OUTSIDE, UNKNOWN, laplace_fill


def solved_plainly(values, kinds):
    """Oracle: one sparse linear system a component, solved directly."""
    number = np.full(kinds.shape, -1)
    unknown = np.argwhere(kinds == UNKNOWN)
    number[tuple(unknown.T)] = np.arange(len(unknown))
    matrix, right = scipy.sparse.lil_matrix((len(unknown), len(unknown))), np.zeros((len(unknown), values.shape[-1]))
    for row, cell in enumerate(unknown):
        for step in np.concatenate([np.eye(3, dtype=int), -np.eye(3, dtype=int)]):
            other = tuple(cell + step)
            if min(other) < 0 or any(np.array(other) >= kinds.shape) or kinds[other] == OUTSIDE:
                continue
            matrix[row, row] += 1
            if kinds[other] == UNKNOWN:
                matrix[row, number[other]] -= 1
            else:
                right[row] += values[other]
    out = values.astype(float).copy()
    solve = scipy.sparse.linalg.factorized(matrix.tocsc())
    out[kinds == UNKNOWN] = np.stack([solve(right[:, c]) for c in range(values.shape[-1])], axis=1)
    return out


def test_linear_field_is_reproduced():
    shape = (33, 20, 27)
    field = np.stack(np.meshgrid(*(np.linspace(-1, 1, n) for n in shape), indexing="ij"), axis=-1).astype(np.float32)
    kinds = np.full(shape, KNOWN, np.uint8)
    kinds[1:-1, 1:-1, 1:-1] = UNKNOWN
    holes = np.where(kinds[..., None] == KNOWN, field, np.float32(7.0))  # what stands in unknown cells must not matter
    assert np.abs(laplace_fill(holes, kinds, cycles=40, tolerance=1e-6) - field).max() < 1e-4


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_solution_is_that_of_the_plain_solver(seed):
    rng = np.random.default_rng(seed)
    shape = (19, 22, 17)  # odd sizes, more than one level
    kinds = np.where(rng.random(shape) < 0.01, KNOWN, UNKNOWN).astype(np.uint8)
    kinds[: rng.integers(3, 7), 10:] = OUTSIDE
    kinds[9:11, 9:, 3:9] = OUTSIDE  # a wall in the midst
    values = rng.normal(size=(*shape, 2)).astype(np.float32)
    solved = laplace_fill(values, kinds, cycles=40, tolerance=1e-6)
    assert np.array_equal(solved[kinds == KNOWN], values[kinds == KNOWN])
    assert np.abs(solved - solved_plainly(values, kinds))[kinds == UNKNOWN].max() < 1e-3


def test_few_cycles_are_enough_for_directions():
    kinds = np.full((40, 40, 40), UNKNOWN, np.uint8)
    kinds[[0, -1]] = KNOWN
    values = np.zeros((40, 40, 40, 1), np.float32)
    values[-1] = 1.0
    exact = np.linspace(0, 1, 40)[:, None, None, None]
    assert np.abs(laplace_fill(values, kinds) - exact).max() < 0.01


def scattered(shape, share, seed=0):
    """Random values, known in a share of the cells, with a part that is none of it."""
    rng = np.random.default_rng(seed)
    kinds = np.where(rng.random(shape) < share, KNOWN, UNKNOWN).astype(np.uint8)
    kinds[: shape[0] // 4, shape[1] // 2 :] = OUTSIDE
    return rng.normal(size=(*shape, 1)).astype(np.float32), kinds


def residual(u, kinds):
    """Largest difference of an UNKNOWN cell from the mean of the neighbours that take part."""
    there = np.pad(kinds != OUTSIDE, 1)
    padded = np.where(there, np.pad(u, 1), 0.0)
    total, count = np.zeros(u.shape), np.zeros(u.shape)
    for axis in range(3):
        for step in (-1, 1):
            total += np.roll(padded, step, axis)[1:-1, 1:-1, 1:-1]
            count += np.roll(there, step, axis)[1:-1, 1:-1, 1:-1]
    return np.abs(total / np.maximum(count, 1) - u)[(kinds == UNKNOWN) & (count > 0)].max()


@pytest.mark.parametrize("share", [0.0005, 0.01, 0.2])
def test_each_cycle_leaves_less_than_half_of_the_residual(share):
    values, kinds = scattered((70, 45, 61), share)
    left = [residual(laplace_fill(values, kinds, cycles, 0.0)[..., 0], kinds) for cycles in (0, 6)]
    assert left[1] < 0.5**6 * left[0]


def test_stops_at_the_tolerance():
    values, kinds = scattered((40, 41, 42), 0.01)
    assert 1e-5 < residual(laplace_fill(values, kinds, 40, 1e-3)[..., 0], kinds) < 2e-3


def test_cells_that_nothing_known_reaches_do_no_harm():
    values, kinds = scattered((20, 20, 20), 0.05)
    kinds[12:, 12:, 12:] = UNKNOWN
    kinds[11, 11:, 11:] = kinds[11:, 11, 11:] = kinds[11:, 11:, 11] = OUTSIDE
    kinds[3, 3, 3], kinds[[2, 4], 3, 3], kinds[3, [2, 4], 3], kinds[3, 3, [2, 4]] = UNKNOWN, OUTSIDE, OUTSIDE, OUTSIDE  # alone
    solved = laplace_fill(values, kinds)
    assert np.ptp(solved[12:, 12:, 12:]) < 1e-3
    assert residual(solved[..., 0], kinds) < 2e-5


def test_nothing_known_and_nothing_unknown():
    values = np.ones((5, 6, 7, 3), np.float32)
    assert np.all(laplace_fill(values, np.full((5, 6, 7), UNKNOWN, np.uint8)) == 0)
    assert np.array_equal(laplace_fill(values, np.full((5, 6, 7), KNOWN, np.uint8)), values)
    assert np.all(laplace_fill(values, np.full((5, 6, 7), OUTSIDE, np.uint8)) == 0)


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one processor")
def test_same_bytes_for_any_number_of_threads():
    values, kinds = scattered((80, 40, 50), 0.01)
    before = numba.get_num_threads()
    try:
        solved = []
        for threads in (1, 2):
            numba.set_num_threads(threads)
            solved.append(laplace_fill(values, kinds, 5, 0.0))
    finally:
        numba.set_num_threads(before)
    assert np.array_equal(*solved)
