"""Refining against curves that are known: fits lie closer, ends and gaps are where they should be, pieces become fibers."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from strandscope.core.features import build_index
from strandscope.core.grow import GrowParams, grow
from strandscope.core.refine import RefineParams, smoothed, trace

from .known import OPTICS, Seen, helix, in_volume, line, observe, wave

# An observation errs by 0.2 px in column and row, 5.7 um; some 100 of them tie each point of a curve.
ON_CURVE_MM = 0.003


def curves_of(grown) -> list[np.ndarray]:
    return [grown.points_mm[a:b].astype(float) for a, b in zip(grown.offsets[:-1], grown.offsets[1:], strict=True)]


def traced(curves, seen=Seen(), params=RefineParams(), workers=1, **hidden):  # noqa: B008
    return trace(build_index(observe(curves, seen, **hidden), seen.optics), GrowParams(), params, workers)


def distances(truth, points) -> np.ndarray:
    return cKDTree(truth).query(points)[0]


@pytest.mark.parametrize(
    ("truth", "seen"),
    [(line(), Seen()), (line(way=(1, 1, 0.3)), Seen()), (wave(), Seen(seed=3)), (helix(), Seen()), (helix(right_handed=False), Seen(angles=24))],
)
def test_a_fiber_is_one_curve_on_its_centreline(truth, seen):
    found = curves_of(traced([truth], seen))
    assert len(found) == 1
    off = distances(truth, found[0])
    assert off.mean() < ON_CURVE_MM
    assert off.max() < 4 * ON_CURVE_MM
    inside = truth[in_volume(truth, seen)]
    assert (distances(found[0], inside) < 0.07).mean() > 0.95


def test_fits_lie_closer_than_what_was_grown():
    """At the bends of a helix as tight as a curl: 1 mm across, 0.14 / mm."""
    truth, seen = helix(radius_mm=0.5, pitch_mm=10.0), Seen(noise_px=0.4)
    sweeps = observe([truth], seen)
    grown, fitted = (
        curves_of(f(build_index(sweeps, OPTICS)))[0] for f in (lambda i: grow(i, GrowParams()), lambda i: trace(i, GrowParams(), RefineParams()))
    )
    assert distances(truth, fitted).mean() < 0.9 * distances(truth, grown).mean()


def test_a_gap_that_no_camera_sees_is_joined_over():
    """1.2 mm, twice as long as growing goes on unobserved; the two pieces are one fiber."""
    for truth in (line(), wave()):
        found = curves_of(traced([truth], hidden=lambda points, _sweep: np.abs(points[:, 1]) < 0.6))
        assert len(found) == 1
        inside = np.abs(found[0][:, 1]) < 0.6
        assert inside.sum() > 8
        # over a gap the curve is carried on evenly: for this wave, whose bend turns over in the gap, off by some 20 um
        assert distances(truth, found[0][inside]).max() < 0.03


def test_ends_that_do_not_meet_are_not_joined():
    """Two fibers, one above, one below, 0.3 mm beside each other where they end."""
    upper, lower = line((0.0, 0, 0), (0, 1, 0)), line((0.3, 0, 0), (0, 1, 0))
    found = curves_of(traced([upper[upper[:, 1] > 0.5], lower[lower[:, 1] < -0.5]]))
    assert len(found) == 2
    owners = sorted(int(distances(upper, points).mean() > 0.1) for points in found)
    assert owners == [0, 1]


def test_an_end_is_not_carried_on_past_the_hair():
    points = curves_of(traced([line()], hidden=lambda points, _sweep: points[:, 1] < -1.2))[0]
    # evidence of a point is that of 0.6 mm around it; half of it is enough
    assert points[:, 1].min() == pytest.approx(-1.2, abs=0.35)


@pytest.mark.parametrize("apart_mm", [0.08, 0.2])
def test_fibers_that_cross_do_not_exchange(apart_mm):
    truths = [line((0, 0, 0), (0.18, 1, 0)), line((0, 0, apart_mm), (-0.18, 1, 0))]
    found = curves_of(traced(truths, Seen(angles=24, seed=4)))
    assert len(found) == 2
    assert sorted(int(np.argmin([distances(t, points).max() for t in truths])) for points in found) == [0, 1]
    assert max(min(distances(t, points).max() for t in truths) for points in found) < 0.02


def test_clutter_alone_makes_no_hair():
    assert len(curves_of(traced([], Seen(clutter=4000)))) == 0


def test_the_number_of_workers_does_not_change_a_byte():
    truths = [line(), helix(), wave(), line((-0.8, 0, 0.6), (-0.2, 1, 0))]
    seen = Seen(clutter=1500, seed=7)
    one, two = (traced(truths, seen, workers=workers) for workers in (1, 2))
    assert len(one.offsets) > 4
    for name in ("points_mm", "offsets", "evidence", "stops"):
        assert getattr(one, name).tobytes() == getattr(two, name).tobytes()


def test_progress_goes_forward_and_ends():
    told = []
    trace(build_index(observe([line()]), OPTICS), GrowParams(), RefineParams(), 1, lambda _stage, done, total: told.append(done / total))
    assert told == sorted(told)
    assert told[-1] == 1


# ---- the smoother ----------------------------------------------------------------------------------------------------


def ties(count, weight=1.0):
    return np.repeat(weight * np.eye(3)[None], count, axis=0)


def test_what_has_no_third_difference_is_kept():
    t = np.arange(30.0)[:, None]
    parabola = np.concatenate([t, 0.3 * t**2, 1 - 0.1 * t - 0.02 * t**2], axis=1)
    moved, _ = smoothed(parabola, ties(30), np.zeros((30, 3)), 100.0)
    assert np.abs(moved - parabola).max() < 1e-9


def test_the_smoother_is_the_least_of_its_two_prices():
    rng = np.random.default_rng(2)
    points, pull = rng.normal(size=(12, 3)), rng.normal(size=(12, 3))
    weights = np.einsum("nij,nkj->nik", *(2 * [rng.normal(size=(12, 3, 3))])) + 0.1 * np.eye(3)
    third = np.zeros((9, 12))
    for i in range(9):
        third[i, i : i + 4] = -1, 3, -3, 1
    matrix = np.zeros((36, 36))
    for i in range(12):
        matrix[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = weights[i]
    roughness = np.kron(third.T @ third, np.eye(3))
    wanted = points + np.linalg.solve(matrix + 0.7 * roughness, pull.ravel() - 0.7 * roughness @ points.ravel()).reshape(12, 3)
    assert np.abs(smoothed(points, weights, pull, 0.7)[0] - wanted).max() < 1e-6


def test_a_place_without_ties_is_carried_on_evenly():
    t = np.linspace(0, 3, 31)[:, None]
    curve = np.concatenate([t, 0.2 * t**2, 0 * t], axis=1)
    bent = curve.copy()
    bent[12:18, 1] += 0.3
    free = ties(31)
    free[12:18] = 0.0
    assert np.abs(smoothed(bent, free, np.zeros((31, 3)), 1.0)[0] - curve).max() < 0.02


@pytest.mark.parametrize("jerk", [0.02, 0.2, 2.0])
def test_the_likeliest_price_is_that_of_the_curve(jerk):
    """Third differences at random of a known size, places known to 0.1: the likeliest of prices a factor 4 apart is the true one."""
    rng = np.random.default_rng(3)
    truth = np.cumsum(np.cumsum(np.cumsum(rng.normal(0, jerk, (300, 3)), axis=0), axis=0), axis=0)
    seen = truth + rng.normal(0, 0.1, truth.shape)
    prices = [(jerk * 4.0**i) ** -2.0 for i in range(-2, 3)]
    likely = [smoothed(seen, ties(300, 100.0), np.zeros((300, 3)), price)[1] for price in prices]
    assert np.argmax(likely) == 2
