"""Refining against curves that are known: fits lie closer, ends and gaps are where they should be, pieces become fibers."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from strandscope.core.features import build_index
from strandscope.core.grow import GrowParams, grow
from strandscope.core.joining import Curve, bridged
from strandscope.core.refine import RefineParams, _fit_all, _join, _uncross, _work, bend_at_large, trace

from .known import OPTICS, Seen, densely, helix, in_volume, line, observe, wave

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
    assert (distances(densely(found[0]), inside) < 0.07).mean() > 0.95


@pytest.mark.parametrize("pitch_mm", [10.0, 40.0])
def test_fits_lie_as_near_as_what_was_grown(pitch_mm):
    """A hair alone, as tight as a curl (0.14 / mm) and nearly straight: both are as near as the observations say, of which each place has
    some hundred with an error of 11 µm. The mean of some observations, since one differs from another."""
    truth, off_mm = helix(radius_mm=0.5, pitch_mm=pitch_mm), []
    for seed in range(4):
        sweeps = observe([truth], Seen(noise_px=0.4, seed=seed))
        grown, fitted = (
            curves_of(f(build_index(sweeps, OPTICS)))[0] for f in (lambda i: grow(i, GrowParams()), lambda i: trace(i, GrowParams(), RefineParams()))
        )
        off_mm.append((distances(truth, grown).mean(), distances(truth, fitted).mean()))
    before, after = np.mean(off_mm, axis=0)
    assert after < 1.15 * before
    assert after < 0.003


def test_a_gap_that_no_camera_sees_is_joined_over():
    """1.2 mm, twice as long as growing goes on unobserved; the two pieces are one fiber."""
    for truth in (line(), wave()):
        found = curves_of(traced([truth], hidden=lambda points, _sweep: np.abs(points[:, 1]) < 0.6))
        assert len(found) == 1
        inside = np.abs(found[0][:, 1]) < 0.6
        assert inside.sum() >= 5
        # over a gap the curve is carried on evenly: for this wave, whose bend turns over in the gap, off by some 20 um
        assert distances(truth, found[0][inside]).max() < 0.03


def test_ends_that_do_not_meet_are_not_joined():
    """Two fibers, one above, one below, 0.3 mm beside each other where they end."""
    upper, lower = line((0.0, 0, 0), (0, 1, 0)), line((0.3, 0, 0), (0, 1, 0))
    found = curves_of(traced([upper[upper[:, 1] > 0.5], lower[lower[:, 1] < -0.5]]))
    assert len(found) == 2
    owners = sorted(int(distances(upper, points).mean() > 0.1) for points in found)
    assert owners == [0, 1]


@pytest.mark.parametrize("carry_mm", [0.0, 0.3])
def test_a_curve_ends_a_little_past_the_hair_that_is_seen(carry_mm):
    points = curves_of(traced([line()], params=RefineParams(carry_mm=carry_mm), hidden=lambda points, _sweep: points[:, 1] < -1.2))[0]
    # evidence of a point is that of 0.6 mm around it; half of it is enough
    assert points[:, 1].min() == pytest.approx(-1.2 - carry_mm, abs=0.35)
    assert distances(line(), points).max() < 0.02


def test_a_curve_is_not_carried_on_into_another_hair():
    """A fiber is not seen any more some way before it would run into one that crosses its way; evidence reaches 0.3 mm on."""
    first, second = line((0, 0, 0), (0, 1, 0)), line((0, -1.2, 0), (1, 0, 0))
    found = curves_of(traced([first[first[:, 1] > -0.8], second], Seen(angles=24)))
    upright = min(found, key=lambda points: np.abs(points[:, 0]).max())
    assert distances(second, upright).min() > 0.05
    assert upright[:, 1].min() < -1.05


@pytest.mark.parametrize("apart_mm", [0.08, 0.2])
def test_fibers_that_cross_do_not_exchange(apart_mm):
    truths = [line((0, 0, 0), (0.18, 1, 0)), line((0, 0, apart_mm), (-0.18, 1, 0))]
    found = curves_of(traced(truths, Seen(angles=24, seed=4)))
    assert len(found) == 2
    assert sorted(int(np.argmin([distances(t, points).max() for t in truths])) for points in found) == [0, 1]
    assert max(min(distances(t, points).max() for t in truths) for points in found) < 0.02


def test_pieces_that_were_exchanged_go_back():
    """Two fibers cross 0.1 mm apart; one curve goes from the first over to the second, and a piece of either is left over."""
    first, second = (line((0, 0, z), (x, 1, 0))[::20] for z, x in ((0, 0.15), (0.1, -0.15)))
    index = build_index(observe([line((0, 0, 0), (0.15, 1, 0)), line((0, 0, 0.1), (-0.15, 1, 0))], Seen(angles=24)), OPTICS)
    work = _work(index, RefineParams(), GrowParams())
    parts = [first[20:39], first[42:60], second[20:39], second[42:60]]
    wrong = bridged([Curve(parts[0], np.full(19, 9.0), (0, 0)), Curve(parts[3], np.full(18, 9.0), (0, 0))], 0.1)
    curves = _fit_all([wrong, Curve(parts[1], np.full(18, 9.0), (0, 0)), Curve(parts[2], np.full(19, 9.0), (0, 0))], work)
    found = _join(_fit_all(_uncross(curves, work), work), work)
    worst = [min(distances(line((0, 0, z), (x, 1, 0)), c.points).max() for z, x in ((0, 0.15), (0.1, -0.15))) for c in found]
    assert max(worst) < 0.03


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


def test_the_curvature_at_large_is_that_of_what_is_seen_well():
    """A helix seen well, and a line seen badly whose points err by 20 um."""
    radius, rise = 0.5, 10 / (2 * np.pi)
    bent = helix(radius, 10.0)[::25]  # some 0.1 mm apart
    step = float(np.linalg.norm(np.diff(bent, axis=0), axis=1).mean())
    rough = line()[::20] + np.random.default_rng(0).normal(0, 0.02, (len(line()[::20]), 3))
    # in one of two directions across the hair, root mean square
    expected = radius / (radius**2 + rise**2) / np.sqrt(2)
    curves = [(bent, np.full(len(bent), 8.0)), (rough, np.full(len(rough), 1.0))]
    assert bend_at_large(curves, step) == pytest.approx(expected, rel=0.02)


def test_hair_without_a_bend_is_taken_for_nearly_straight():
    straight = np.arange(0, 3, 0.1)[:, None] * np.array([[0.0, 1.0, 0.0]])
    assert bend_at_large([(straight, np.ones(30))], 0.1) == pytest.approx(1e-3)
    assert bend_at_large([(straight[:5], np.ones(5))], 0.1) == np.inf  # too short to tell: anything
