"""Expected errors against what is known: errors that come out as foretold, more where less is seen."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from strandscope.core.confidence import SURE_MM, ErrorParams, combined, confidence, curvature, expected_error, spread
from strandscope.core.features import build_index
from strandscope.core.grow import GrowParams
from strandscope.core.refine import RefineParams, trace

from .known import Seen, helix, line, observe, wave


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
