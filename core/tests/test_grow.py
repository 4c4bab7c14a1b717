"""Growing against curves that are known: what comes out lies on them, covers them, and nothing else comes out."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from strandscope.core.features import USED, build_index
from strandscope.core.grow import GrowParams, Stop, box_of, claims_of, grow, solve_direction
from strandscope.core.look import claimed
from strandscope.core.refine import _weigh

from .known import OPTICS, Seen, densely, helix, in_volume, line, observe, wave

# A camera gives the mean place of the observations in a box 1.14 mm along the hair. On a hair of curvature k that mean lies
# k 1.14^2 / 24 beside the centreline: 5 um for these helices and waves (k up to 0.10 / mm). A thousand observations of 0.2 px
# (5.7 um) add less than 1 um, the weighting of the ends of the box the rest. Measured: 5 to 7 um, 9 um with the paper's weights.
ON_CURVE_MM = 0.012
# Straight hair has no such error. Truth is given by points 5 um apart, which adds up to 2.5 um.
ON_LINE_MM = 0.005
# A point every 0.1 mm: half of it, and the most that a curve may lie beside.
COVERED_MM = 0.07


def curves_of(grown) -> list[np.ndarray]:
    return [grown.points_mm[a:b].astype(float) for a, b in zip(grown.offsets[:-1], grown.offsets[1:], strict=True)]


def grown_from(curves, seen=Seen(), params=GrowParams(), **hidden):  # noqa: B008
    return grow(build_index(observe(curves, seen, **hidden), seen.optics), params)


def farthest(truth, points) -> float:
    """The largest distance (mm) of points (n, 3) from a curve."""
    return float(cKDTree(truth).query(points)[0].max())


def covered(truth, found, seen) -> float:
    """Share of a curve inside the volume that has the curve ``found`` (n, 3) near it."""
    return float((cKDTree(densely(found)).query(truth[in_volume(truth, seen)])[0] < COVERED_MM).mean())


def length(points) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def assert_each_found_once(truths, grown, seen, tolerance_mm=ON_CURVE_MM, share=0.95):
    """One curve a fiber, each wholly on its own fiber (so none has changed over to another), and most of it found."""
    found = curves_of(grown)
    assert len(found) == len(truths), [len(f) for f in found]
    owners = [int(np.argmin([farthest(t, f) for t in truths])) for f in found]
    assert sorted(owners) == list(range(len(truths)))
    for owner, points in zip(owners, found, strict=True):
        assert farthest(truths[owner], points) < tolerance_mm
        assert covered(truths[owner], points, seen) >= share


# ---- one fiber -------------------------------------------------------------------------------------------------------

SLANTED = line(way=(1, 1, 0.3))
HALF_TURN = Seen(turn_deg=180)  # errors of the image's column do not cancel between opposite cameras


@pytest.mark.parametrize(
    ("truth", "seen", "tolerance_mm"),
    [
        (line(), Seen(angles=24), ON_LINE_MM),
        (line(), HALF_TURN, ON_LINE_MM),
        (SLANTED, HALF_TURN, ON_LINE_MM),
        (helix(), Seen(), ON_CURVE_MM),
        (helix(), HALF_TURN, ON_CURVE_MM),
        (helix(right_handed=False), Seen(seed=1), ON_CURVE_MM),
        (wave(), Seen(angles=24, seed=2), ON_CURVE_MM),
        (wave(), Seen(seed=3), ON_CURVE_MM),
    ],
)
def test_a_fiber_is_found_from_end_to_end_where_it_is(truth, seen, tolerance_mm):
    grown = grown_from([truth], seen)
    assert_each_found_once([truth], grown, seen, tolerance_mm)
    assert np.all(grown.stops == Stop.LEFT_VOLUME)


@pytest.mark.parametrize("truth", [line(way=(1, 1, 0.8)), helix(radius_mm=1.5, pitch_mm=12.0), line(at=(1.5, 0, 0.5), way=(0.1, 1, 0.6))])
def test_perspective_is_that_of_the_lens(truth):
    """A lens at 12 mm sees 2 mm from the axis as slanted as the edge of a full photograph, 40 mm wide, is seen from 330 mm, and
    more: 9 degrees. Ribbons and planes that lean the wrong way do not meet in the fiber."""
    seen = Seen(distance_mm=12.0, noise_px=0.1, noise_deg=1.0)
    assert_each_found_once([truth], grown_from([truth], seen), seen, 2 * ON_CURVE_MM)


@pytest.mark.parametrize("right_handed", [True, False])
def test_a_helix_keeps_its_hand(right_handed):
    points = curves_of(grown_from([helix(right_handed=right_handed)]))[0]
    points = points[np.argsort(points[:, 1])]
    turned = np.unwrap(np.arctan2(points[:, 0], points[:, 2]))  # from +z towards +x, as the turntable turns
    rate = np.polyfit(points[:, 1], turned, 1)[0]
    assert rate == pytest.approx((1 if right_handed else -1) * 2 * np.pi / 20.0, rel=0.02)
    assert farthest(helix(right_handed=not right_handed), points) > 0.5


def test_steps_have_the_length_asked_for_and_do_not_fold():
    params = GrowParams(step_mm=0.15)
    points = curves_of(grown_from([helix()], Seen(), params))[0]
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    # a step and a correction across it of at most gamma, half a pixel: 0.5 / 35 mm
    assert np.all((steps > 0.149) & (steps < np.hypot(0.15, 2 * 0.5 / 35)))
    assert np.abs(np.diff(np.sign(np.diff(points[:, 1])))).max() == 0


def test_a_fiber_that_every_camera_sees_only_in_parts():
    def hidden(points, sweep):  # 0.9 mm seen, 0.6 mm not, at other heights for each camera
        return (points[:, 1] + 0.37 * sweep) % 1.5 > 0.9

    assert_each_found_once([helix()], grown_from([helix()], Seen(), hidden=hidden), Seen())


def test_a_fiber_that_half_of_the_cameras_do_not_see():
    def hidden(points, sweep):
        return np.full(len(points), sweep >= 6)

    assert_each_found_once([wave()], grown_from([wave()], Seen(), hidden=hidden), Seen())


# ---- several fibers --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("apart_mm", [0.08, 0.2])
@pytest.mark.parametrize("angles", [12, 24])
def test_fibers_that_cross_do_not_exchange(apart_mm, angles):
    """At 20 degrees, one in front of the other: touching, and not."""
    truths = [line((0, 0, 0), (0.18, 1, 0)), line((0, 0, apart_mm), (-0.18, 1, 0))]
    seen = Seen(angles=angles, seed=4)
    assert_each_found_once(truths, grown_from(truths, seen), seen)


@pytest.mark.parametrize("angles", [12, 24])
def test_fibers_side_by_side_are_two_and_have_no_ghosts(angles):
    """0.15 mm apart, 5 px. Where a ribbon of one meets ribbons of the other, a few cameras agree on hair that is not there."""
    truths = [line((0.1, 0, 0), (0, 1, 0.1)), line((0.25, 0, 0), (0, 1, 0.1))]
    seen = Seen(angles=angles, seed=5)
    assert_each_found_once(truths, grown_from(truths, seen), seen)


def test_clutter_alone_makes_no_hair():
    """4000 features a sweep in 210 x 150 x 21 pixels, as many as 27 fibers would give."""
    assert len(curves_of(grown_from([], Seen(clutter=4000)))) == 0


def test_hair_is_found_in_clutter():
    truths = [line(), helix()]
    seen = Seen(clutter=2000, seed=6)
    assert_each_found_once(truths, grown_from(truths, seen), seen)


def test_nothing_is_found_in_nothing():
    grown = grown_from([])
    assert (len(grown.points_mm), len(grown.stops), grown.offsets.tolist()) == (0, 0, [0])


# ---- where it ends ---------------------------------------------------------------------------------------------------


def unseen_between(low_mm, high_mm):
    return lambda points, sweep: (points[:, 1] > low_mm) & (points[:, 1] < high_mm)  # noqa: ARG005


def test_a_gap_of_half_a_millimetre_is_bridged():
    assert_each_found_once([line()], grown_from([line()], hidden=unseen_between(-0.25, 0.25)), Seen())


def test_a_gap_of_three_millimetres_is_not():
    params = GrowParams(min_length_mm=1.0)
    grown = grown_from([line()], params=params, hidden=unseen_between(-1.5, 1.5))
    found = sorted(curves_of(grown), key=lambda points: points[0, 1])
    assert len(found) == 2
    # observations in the box reach half of its length, 0.57 mm, beyond their end
    assert found[0][:, 1].max() < -1.5 + 0.65
    assert found[1][:, 1].min() > 1.5 - 0.65
    assert all(farthest(line(), points) < ON_CURVE_MM for points in found)


def test_each_end_tells_why_it_is_one():
    grown = grown_from([line()], hidden=unseen_between(-9, -1.2))
    points = curves_of(grown)[0]
    low, high = (0, 1) if points[0, 1] < points[-1, 1] else (1, 0)
    assert grown.stops[0, low] == Stop.UNOBSERVED
    assert grown.stops[0, high] == Stop.LEFT_VOLUME
    assert points[:, 1].min() == pytest.approx(-1.2, abs=0.65)
    assert points[:, 1].max() > 2.9


def test_a_curve_is_no_longer_than_allowed():
    params = GrowParams(max_length_mm=3.0)
    grown = grown_from([line()], params=params)
    found = curves_of(grown)
    assert max(map(length, found)) == pytest.approx(3.0, abs=0.21)  # a step
    assert Stop.TOO_LONG in grown.stops


def test_hair_shorter_than_the_least_length_is_left_out():
    short = line(half_mm=0.4)
    # at either end a box of 0.57 mm sees half of what it should
    assert len(curves_of(grown_from([short], params=GrowParams(min_length_mm=2.0)))) == 0
    assert len(curves_of(grown_from([short], params=GrowParams(min_length_mm=0.5)))) == 1


def test_what_is_found_is_used_up():
    index = build_index(observe([line(), helix()]), OPTICS)
    assert len(curves_of(grow(index, GrowParams()))) == 2
    assert len(curves_of(grow(index, GrowParams()))) == 0


# ---- evidence --------------------------------------------------------------------------------------------------------


def evidence_at(sweeps, place, taken=()):
    """Mean evidence over 1 mm of an upright line through ``place``; ``taken``: curves whose observations are used up."""
    index, points = build_index(sweeps, OPTICS), np.asarray(place) + np.arange(-0.5, 0.51, 0.1)[:, None] * np.array([0.0, 1.0, 0.0])
    box, evidence = box_of(GrowParams(), index), np.empty(len(points))
    for curve in taken:
        index.strength[claimed(index, curve[::20], claims_of(GrowParams(), box))] |= USED
    _weigh(index, points, box, evidence)
    return evidence.mean()


def upright(x=0.0, z=0.0):
    return line((x, 0, z), (0, 1, 0), 3.0)


def test_a_camera_that_sees_a_hair_sharpest_elsewhere_is_less_evidence():
    """Of three hairs 0.4 mm from a place, each before or behind it for one camera: their ribbons meet there, out of focus."""
    angles = np.radians([30.0, 60.0, 90.0])
    around = [upright(-0.4 * np.sin(a), 0.4 * np.cos(a)) for a in angles]
    seen = Seen(angles=12)
    true, chance = evidence_at(observe([upright()], seen), (0, 0, 0)), evidence_at(observe(around, seen), (0, 0, 0))
    assert true > 8  # of 12 cameras
    # three cameras and the three opposite ones see a ribbon there; each is half believed at 0.15 mm
    assert chance < 0.3


def test_what_another_curve_stands_on_is_less_evidence():
    sweeps = observe([upright()], Seen(angles=12))
    assert evidence_at(sweeps, (0, 0, 0), [upright()]) < 0.2 * evidence_at(sweeps, (0, 0, 0))


# ---- the same every time ---------------------------------------------------------------------------------------------


def test_the_number_of_workers_does_not_change_a_byte():
    truths = [line(), helix(), wave(), line((-0.8, 0, 0.6), (-0.2, 1, 0))]
    sweeps = observe(truths, Seen(clutter=1500, seed=7))
    first, *others = (grow(build_index(sweeps, OPTICS), GrowParams(), workers) for workers in (1, 2, 3))
    assert len(first.offsets) > 4
    for other in others:
        for name in ("points_mm", "offsets", "stops"):
            assert getattr(other, name).tobytes() == getattr(first, name).tobytes()


def test_progress_may_cancel():
    def cancel(stage, done, total):  # noqa: ARG001
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        grow(build_index(observe([line()]), OPTICS), GrowParams(), 2, cancel)


def test_progress_goes_forward_and_ends():
    told = []
    grow(build_index(observe([line()]), OPTICS), GrowParams(), 1, lambda stage, done, total: told.append((stage, done / total)))
    assert {stage for stage, _ in told} == {"growing"}
    shares = [share for _, share in told]
    assert shares == sorted(shares)
    assert 0 <= shares[0] <= shares[-1] == 1


# ---- the direction of a seed ----------------------------------------------------------------------------------


def unit(rows):
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)


def test_direction_is_the_last_singular_vector():
    rng = np.random.default_rng(8)
    for _ in range(100):
        g = unit(rng.normal(size=3))
        normals = unit(np.cross(g, unit(rng.normal(size=(12, 3))))) + rng.normal(0, 0.05, (12, 3))
        weights = rng.uniform(0.2, 3, 12) * (rng.random(12) < 0.8)
        wanted = np.linalg.svd(np.sqrt(weights)[:, None] * normals)[2][-1]
        for guess in (g, -g, unit(g + 0.3 * rng.normal(size=3))):
            found = solve_direction(normals, weights, guess)
            # four steps of inverse iteration, each shrinking the error by the ratio of eigenvalues, here below 0.1
            assert np.abs(found - wanted * np.sign(wanted @ guess)).max() < 1e-3
            assert np.linalg.norm(found) == pytest.approx(1, abs=1e-9)
