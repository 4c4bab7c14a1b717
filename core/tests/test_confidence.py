"""Expected errors against what is known: exact covariances, errors that come out as foretold, more where less is seen."""

import numpy as np
import pytest
from scipy.linalg import cholesky_banded
from scipy.spatial import cKDTree

from strandscope.core.confidence import SURE_MM, ErrorParams, combined, confidence, covariance, curvature, diagonal_blocks, expected_error, spread
from strandscope.core.features import build_index
from strandscope.core.grow import GrowParams
from strandscope.core.refine import RefineParams, smoothed, trace

from .known import Seen, helix, line, observe, wave


def ties(count, seed=0) -> np.ndarray:
    """Normal matrices (count, 3, 3) of points that are seen well from some sides and badly from others."""
    sides = np.random.default_rng(seed).normal(size=(count, 3, 2))
    return sides @ sides.swapaxes(1, 2) + 0.01 * np.eye(3)


def dense(normal, price) -> np.ndarray:
    """The matrix (3 n, 3 n) of ``refine.smoothed``, written out."""
    n = len(normal)
    third = np.diff(np.eye(n), 3, axis=0)
    matrix = np.kron(price * third.T @ third, np.eye(3))
    for i in range(n):
        matrix[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += normal[i]
    return matrix


@pytest.mark.parametrize(("count", "price"), [(4, 1.0), (5, 100.0), (40, 0.01), (40, 30.0), (120, 3000.0)])
def test_the_covariance_is_the_inverse(count, price):
    normal = ties(count)
    inverse = np.linalg.inv(dense(normal, price))
    expected = np.stack([inverse[i : i + 3, i : i + 3] for i in range(0, 3 * count, 3)])
    np.testing.assert_allclose(covariance(normal, price), expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("width", [2, 5, 9])
def test_blocks_of_any_band(width):
    matrix = sum(np.diag(np.full(30 - k, 1.0 / (1 + k)), k) for k in range(width + 1))
    matrix = matrix + matrix.T + 4 * np.eye(30)
    bands = np.zeros((width + 1, 30))
    for k in range(width + 1):
        bands[width - k, k:] = np.diag(matrix, k)
    inverse = np.linalg.inv(matrix)
    np.testing.assert_allclose(diagonal_blocks(cholesky_banded(bands))[4], inverse[12:15, 12:15], atol=1e-12)


def test_fits_err_as_much_as_their_covariance_says():
    """Curves drawn from what the fit takes for granted: third differences at random, ties with errors of their own size."""
    rng, price, count, runs = np.random.default_rng(2), 4.0, 40, 400
    normal = ties(count, 5)
    root = np.linalg.cholesky(normal)
    errors = np.empty((runs, count, 3))
    for run in range(runs):
        truth = np.cumsum(np.cumsum(np.cumsum(rng.normal(0, price**-0.5, (count, 3)), axis=0), axis=0), axis=0)
        said = np.einsum("nij,nj->ni", normal, truth) + np.einsum("nij,nj->ni", root, rng.normal(size=(count, 3)))
        errors[run] = smoothed(np.zeros((count, 3)), normal, said, price)[0] - truth
    foretold = np.trace(covariance(normal, price), axis1=1, axis2=2)
    # the mean of 400 squares of errors in two or three directions is known to some 5 %
    np.testing.assert_allclose((errors**2).sum(axis=2).mean(axis=0), foretold, rtol=0.25)
    assert (errors**2).sum(axis=2).mean() == pytest.approx(foretold.mean(), rel=0.05)


def test_curvature_of_curves_that_are_known():
    def even(points):
        return points[::25]  # 0.1 mm of a helix of 4 um a point in height

    np.testing.assert_allclose(curvature(even(line()), 4), 0, atol=1e-9)
    radius, rise = 0.5, 10 / (2 * np.pi)
    np.testing.assert_allclose(curvature(even(helix(radius, 10.0)), 4), radius / (radius**2 + rise**2), rtol=0.01)
    short = even(helix(radius, 10.0))[:5]
    np.testing.assert_allclose(curvature(short, 4), radius / (radius**2 + rise**2), rtol=0.01)


def test_each_part_adds_to_the_error():
    params = ErrorParams()

    def error(spread_mm=0.002, bend=0.1, evidence=5.0):
        return float(combined(np.array([spread_mm]), np.array([bend]), np.array([evidence]), params)[0])

    assert error(spread_mm=0.004) > error() < error(bend=0.3)
    told = [error(evidence=e) for e in (-0.3, 0.0, 1.0, 5.0, 20.0)]
    assert told[0] == told[1]  # evidence against a hair is as none
    assert np.all(np.diff(told[1:]) < 0)
    assert error(evidence=1e9) == pytest.approx(np.hypot(params.fit * 0.002, params.bend_mm2 * 0.1))


def test_confidence_is_a_chance_that_falls_with_the_error():
    error = np.array([0.0, 0.001, 0.01, SURE_MM, 0.1, np.inf])
    found = confidence(error)
    assert (found[0], found[3], found[5]) == (1.0, 0.5, 0.0)
    assert np.all(np.diff(found) < 0)
    assert confidence(np.array([np.nan]))[0] == 0.0
    assert found.dtype == np.float32


# ---- on observations -------------------------------------------------------------------------------------------------


def errors_of(truths, seen, workers=1, **hidden):
    """Points, distances to the nearest of the truths and expected errors of all that was traced."""
    index = build_index(observe(truths, seen, **hidden), seen.optics)
    grown = trace(index, GrowParams(), RefineParams(), workers)
    told = expected_error(index, GrowParams(), RefineParams(), grown.points_mm, grown.offsets, grown.evidence, workers)
    return grown.points_mm, cKDTree(np.concatenate(truths)).query(grown.points_mm)[0], told


def test_what_fewer_cameras_see_errs_more_and_is_told_so():
    """The upper halves of six hairs are hidden from three cameras of four."""

    def hidden(points, sweep):
        return (points[:, 1] > 0) & (sweep % 4 > 0)

    middles = [(x, 0.0, z) for x in (-0.8, 0.0, 0.8) for z in (-0.4, 0.5)]
    points, _, told = errors_of([line(at, (0, 1, 0)) for at in middles], Seen(angles=24, seed=1), hidden=hidden)
    off = np.min([np.hypot(points[:, 0] - x, points[:, 2] - z) for x, _, z in middles], axis=0)
    upper, lower = points[:, 1] > 0.5, points[:, 1] < -0.5
    assert upper.sum() > 60
    assert np.median(told[upper]) > 2 * np.median(told[lower])
    assert np.median(off[upper]) > 1.3 * np.median(off[lower])  # twice, from a quarter of the cameras


def test_where_nothing_is_seen_the_error_is_largest():
    """Over a gap of 1.2 mm, in its middle."""
    points, _, told = errors_of([line()], Seen(), hidden=lambda points, _sweep: np.abs(points[:, 1]) < 0.6)
    gap, seen = np.abs(points[:, 1]) < 0.2, np.abs(points[:, 1]) > 1.5
    assert told[gap].min() > 10 * np.median(told[seen])


def test_the_number_of_workers_does_not_change_a_byte():
    truths = [line(), helix(), wave()]
    one, two = (errors_of(truths, Seen(seed=7), workers)[2] for workers in (1, 2))
    assert one.dtype == np.float32
    assert np.all(one > 0)
    assert one.tobytes() == two.tobytes()


def test_noise_of_the_ties_scales_the_spread():
    """Twice the error of a tie, with the stiffness that goes with it, is up to twice the spread, and no less than it was."""
    seen = Seen(angles=12)
    index = build_index(observe([line()], seen), seen.optics)
    points = np.ascontiguousarray(line()[::20][10:-10], float)
    small, large = (np.median(spread(index, points, GrowParams(), RefineParams(slab_px=px))) for px in (0.2, 0.4))
    assert 1.5 < large / small < 2.001


def test_no_curves_have_no_errors():
    index = build_index(observe([line()], Seen()), Seen().optics)
    none = expected_error(index, GrowParams(), RefineParams(), np.zeros((0, 3), np.float32), np.zeros(1, np.int64), np.zeros(0, np.float32))
    assert none.shape == (0,)
