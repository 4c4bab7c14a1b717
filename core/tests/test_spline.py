"""The smoothing spline against its matrix written out, and against curves drawn from what it takes for granted."""

import numpy as np
import pytest
from scipy.linalg import cholesky_banded

from strandscope.core.spline import Stiffness, across, covariance, diagonal_blocks, smoothed, stiffness

STIFF = [Stiffness(1.0), Stiffness(100.0), Stiffness(0.01), Stiffness(30.0, 0.9, 5.0), Stiffness(3000.0, 0.99, 60.0)]


def even_ties(count, weight=1.0):
    return np.repeat(weight * np.eye(3)[None], count, axis=0)


def ties(count, seed=0) -> np.ndarray:
    """Normal matrices (count, 3, 3) of points that are seen well from some sides and badly from others."""
    sides = np.random.default_rng(seed).normal(size=(count, 3, 2))
    return sides @ sides.swapaxes(1, 2) + 0.01 * np.eye(3)


def bending(count, stiff) -> np.ndarray:
    """The matrix (count, count) of what bends cost in one direction, written out."""
    second = np.diff(np.eye(count), 2, axis=0)
    new = second[1:] - stiff.memory * second[:-1]
    return stiff.price * new.T @ new + stiff.first * np.outer(second[0], second[0])


def dense(normal, stiff) -> np.ndarray:
    """The matrix (3 n, 3 n) of ``smoothed``, written out."""
    matrix = np.kron(bending(len(normal), stiff), np.eye(3))
    for i in range(len(normal)):
        matrix[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += normal[i]
    return matrix


def drawn(count, stiff, rng) -> np.ndarray:
    """A curve (count, 3) that bends as ``stiff`` says, from rest."""
    bends = np.zeros((count, 3))
    for i in range(count):
        bends[i] = stiff.memory * bends[i - 1] + rng.normal(0, stiff.price**-0.5, 3) if i else rng.normal(0, stiff.first**-0.5, 3)
    return np.cumsum(np.cumsum(bends, axis=0), axis=0)


def test_what_has_no_third_difference_is_kept():
    t = np.arange(30.0)[:, None]
    parabola = np.concatenate([t, 0.3 * t**2, 1 - 0.1 * t - 0.02 * t**2], axis=1)
    moved, _ = smoothed(parabola, even_ties(30), np.zeros((30, 3)), Stiffness(100.0))
    assert np.abs(moved - parabola).max() < 1e-9


@pytest.mark.parametrize("stiff", STIFF)
def test_the_smoother_is_the_least_of_its_two_prices(stiff):
    rng = np.random.default_rng(2)
    points, pull = rng.normal(size=(12, 3)), rng.normal(size=(12, 3))
    weights = np.einsum("nij,nkj->nik", *(2 * [rng.normal(size=(12, 3, 3))])) + 0.1 * np.eye(3)
    away = np.kron(bending(12, stiff), np.eye(3)) @ points.ravel()
    wanted = points + np.linalg.solve(dense(weights, stiff), pull.ravel() - away).reshape(12, 3)
    assert np.abs(smoothed(points, weights, pull, stiff)[0] - wanted).max() < 1e-6


def test_a_place_without_ties_is_carried_on_evenly():
    t = np.linspace(0, 3, 31)[:, None]
    curve = np.concatenate([t, 0.2 * t**2, 0 * t], axis=1)
    bent = curve.copy()
    bent[12:18, 1] += 0.3
    free = even_ties(31)
    free[12:18] = 0.0
    assert np.abs(smoothed(bent, free, np.zeros((31, 3)), Stiffness(1.0))[0] - curve).max() < 0.02


@pytest.mark.parametrize("jerk", [0.02, 0.2, 2.0])
def test_the_likeliest_price_is_that_of_the_curve(jerk):
    """Third differences at random of a known size, places known to 0.1: the likeliest of prices a factor 4 apart is the true one."""
    rng = np.random.default_rng(3)
    truth = np.cumsum(np.cumsum(np.cumsum(rng.normal(0, jerk, (300, 3)), axis=0), axis=0), axis=0)
    seen = truth + rng.normal(0, 0.1, truth.shape)
    prices = [(jerk * 4.0**i) ** -2.0 for i in range(-2, 3)]
    likely = [smoothed(seen, even_ties(300, 100.0), np.zeros((300, 3)), Stiffness(price))[1] for price in prices]
    assert np.argmax(likely) == 2


@pytest.mark.parametrize("jerk", [0.05, 0.2])
def test_the_likeliest_stiffness_is_that_of_the_hair(jerk):
    """Points 0.1 mm apart, known to 5 um, of hair whose curvature is 0.1 / mm in the long run."""
    rng, choices = np.random.default_rng(4), [jerk * 4.0**i for i in range(-2, 3)]
    truth = drawn(600, stiffness(0.1, jerk, 0.1), rng)
    seen = truth + rng.normal(0, 0.005, truth.shape)
    likely = [smoothed(seen, even_ties(600, 0.005**-2), np.zeros((600, 3)), stiffness(0.1, j, 0.1))[1] for j in choices]
    assert np.argmax(likely) == 2


def test_stiffness_tells_curvature_in_the_long_run():
    step, jerk, bend = 0.1, 0.05, 0.08
    stiff = stiffness(step, jerk, bend)
    new, long_run = stiff.price**-0.5 / step**2, stiff.first**-0.5 / step**2
    assert new == pytest.approx(jerk * step, rel=0.01)
    assert long_run == pytest.approx(bend)
    assert new**2 == pytest.approx((1 - stiff.memory**2) * long_run**2)  # what is forgotten is made up for
    assert stiffness(step, jerk) == Stiffness(pytest.approx((step**3 * jerk) ** -2), 1.0, 0.0)


@pytest.mark.parametrize("stiff", STIFF)
@pytest.mark.parametrize("count", [4, 5, 40, 120])
def test_the_covariance_is_the_inverse(count, stiff):
    normal = ties(count)
    inverse = np.linalg.inv(dense(normal, stiff))
    expected = np.stack([inverse[i : i + 3, i : i + 3] for i in range(0, 3 * count, 3)])
    np.testing.assert_allclose(covariance(normal, stiff), expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("width", [2, 5, 9])
def test_blocks_of_any_band(width):
    matrix = sum(np.diag(np.full(30 - k, 1.0 / (1 + k)), k) for k in range(width + 1))
    matrix = matrix + matrix.T + 4 * np.eye(30)
    bands = np.zeros((width + 1, 30))
    for k in range(width + 1):
        bands[width - k, k:] = np.diag(matrix, k)
    inverse = np.linalg.inv(matrix)
    np.testing.assert_allclose(diagonal_blocks(np.ascontiguousarray(cholesky_banded(bands)[::-1].T))[4], inverse[12:15, 12:15], atol=1e-12)


@pytest.mark.parametrize("stiff", [Stiffness(4.0, 1.0, 4.0), Stiffness(4.0, 0.8, 1.44)])
def test_fits_err_as_much_as_their_covariance_says(stiff):
    """Curves drawn from what the fit takes for granted, ties with errors of their own size."""
    rng, count, runs = np.random.default_rng(2), 40, 400
    normal = ties(count, 5)
    root = np.linalg.cholesky(normal)
    errors = np.empty((runs, count, 3))
    for run in range(runs):
        truth = drawn(count, stiff, rng)
        said = np.einsum("nij,nj->ni", normal, truth) + np.einsum("nij,nj->ni", root, rng.normal(size=(count, 3)))
        errors[run] = smoothed(np.zeros((count, 3)), normal, said, stiff)[0] - truth
    foretold = np.trace(covariance(normal, stiff), axis1=1, axis2=2)
    # the mean of 400 squares of errors in two or three directions is known to some 5 %
    np.testing.assert_allclose((errors**2).sum(axis=2).mean(axis=0), foretold, rtol=0.25)
    assert (errors**2).sum(axis=2).mean() == pytest.approx(foretold.mean(), rel=0.05)


def test_across_leaves_out_what_is_along():
    points = np.arange(10.0)[:, None] * np.array([0.0, 1.0, 0.0])
    spread = np.repeat(np.diag([4.0, 100.0, 9.0])[None], 10, axis=0)
    np.testing.assert_allclose(across(spread, points), np.sqrt(13.0))
