"""Putting pieces together, on curves that are drawn: ends that meet, doubles, chains, rivals."""

import numpy as np
import pytest

from strandscope.core.joining import Curve, Meeting, bridged, chains, end_of, leading_to, meetings, misfit, once, paired, part, passings, turned
from strandscope.core.stops import Stop

STEP_MM, PLACE_MM, TURN_DEG = 0.1, (0.02, 0.02), (2.0, 4.0)


def straight(start, stop, x=0.0, evidence=4.0) -> Curve:
    """A curve along y, a step apart."""
    y = np.arange(start, stop + 1e-9, STEP_MM)
    stops = Stop.UNOBSERVED.value, Stop.LEFT_VOLUME.value
    return Curve(np.stack([np.full(len(y), x), y, np.zeros(len(y))], axis=1), np.full(len(y), evidence), stops)


def arc(radius, start, stop) -> Curve:
    """A part of a circle, between two ways along it."""
    s = np.arange(start, stop + 1e-9, STEP_MM)
    points = radius * np.stack([1 - np.cos(s / radius), np.sin(s / radius), 0 * s], axis=1)
    return Curve(points, np.full(len(s), 4.0), (0, 0))


def meet(curves, within_mm=3.0):
    return meetings(curves, within_mm, PLACE_MM, TURN_DEG, 25.0)


def test_ends_of_one_line_meet():
    found = meet([straight(0, 2), turned(straight(3, 5)), straight(3, 5, x=1.0)])
    assert [m.ends for m in found] == [(1, 3)]
    assert found[0].gap_mm == pytest.approx(1.0)
    assert found[0].misfit == pytest.approx(0, abs=1e-9)


def test_an_even_bend_over_the_gap_costs_only_the_turn():
    """Of 1 mm on a circle of 10 mm an end straight on misses the other by nothing in the middle, and turns by 5.7 degrees."""
    gap, radius = 1.0, 10.0
    found = meet([arc(radius, 0, 2), arc(radius, 2 + gap, 5)])
    assert np.sqrt(found[0].misfit) == pytest.approx(np.degrees(gap / radius) / (TURN_DEG[0] + TURN_DEG[1] * gap), rel=0.05)


def test_ends_that_look_away_or_belong_to_one_curve_do_not_meet():
    assert meet([straight(0, 2), straight(1.5, 4, x=0.3)]) == []
    ring = np.linspace(0.2, 2 * np.pi - 0.2, 60)
    circle = Curve(np.stack([np.cos(ring), np.sin(ring), 0 * ring], axis=1), np.ones(60), (0, 0))
    assert meet([circle, straight(20, 22)]) == []


@pytest.mark.parametrize(("beside_mm", "gap_mm"), [(0.03, 0.5), (0.1, 1.5)])
def test_misfit_counts_what_is_expected_as_one(beside_mm, gap_mm):
    way = np.array([0.0, 1.0, 0.0])
    told = misfit(np.zeros(3), way, np.array([beside_mm, gap_mm, 0.0]), -way, PLACE_MM, TURN_DEG)
    assert np.sqrt(told) == pytest.approx(beside_mm / (PLACE_MM[0] + PLACE_MM[1] * np.hypot(beside_mm, gap_mm)), rel=1e-6)


def test_the_likeliest_pairs_come_first_and_rivals_stay_apart():
    pairs = [Meeting(ends, 0.5, 1.0) for ends in ((1, 2), (1, 4), (5, 6), (7, 8), (8, 9))]
    assert paired(pairs, [5.0, 2.0, 3.0, 4.0, 3.5], 1.0, 1.0) == {1: 2, 2: 1, 5: 6, 6: 5}
    assert paired(pairs, [5.0, 2.0, 0.5, 4.0, 3.5], 1.0, 0.1) == {1: 2, 2: 1, 7: 8, 8: 7}


def test_chains_go_through_all_parts_whichever_way_they_lie():
    whole = chains([straight(0, 2), turned(straight(3, 5)), straight(6, 8), straight(0, 1, x=2.0)], {1: 3, 3: 1, 2: 4, 4: 2}, STEP_MM)
    assert len(whole) == 2
    joined = max(whole, key=lambda c: len(c.points))
    y = joined.points[:, 1] if joined.points[0, 1] < 1 else joined.points[::-1, 1]
    np.testing.assert_allclose(y, np.arange(0, 8.01, STEP_MM), atol=1e-6)
    assert np.abs(joined.points[:, 0]).max() < 1e-9
    assert len(joined.points) == len(joined.evidence)


def test_a_ring_of_pairs_becomes_one_curve():
    assert len(chains([straight(0, 2), straight(3, 5)], {1: 2, 2: 1, 3: 0, 0: 3}, STEP_MM)) == 1


def test_a_bridge_has_no_evidence_and_bends_evenly():
    radius = 5.0
    one = bridged([arc(radius, 0, 2), arc(radius, 3, 5)], STEP_MM)
    assert np.count_nonzero(one.evidence == 0) == 9
    centre = np.array([radius, 0.0, 0.0])
    assert np.abs(np.linalg.norm(one.points - centre, axis=1) - radius).max() < 0.003
    assert np.linalg.norm(np.diff(one.points, axis=0), axis=1) == pytest.approx(STEP_MM, rel=0.15)


def test_ends_that_touch_are_not_doubled():
    one = bridged([straight(0, 2), straight(2, 4)], STEP_MM)
    assert len(one.points) == 41
    assert one.stops == (Stop.UNOBSERVED.value, Stop.LEFT_VOLUME.value)


def test_doubles_go_and_overlaps_are_cut():
    kept = once([straight(0, 4, evidence=5.0), straight(1, 3, x=0.02, evidence=2.0), straight(3, 6, x=0.03), straight(0, 4, x=0.1)], 0.04, STEP_MM)
    assert [len(c.points) for c in kept] == [41, pytest.approx(21, abs=1), 41]
    assert kept[1].points[:, 1].min() > 3.9
    assert once([], 0.04, STEP_MM) == []


def test_curves_that_cross_are_no_doubles():
    level = straight(0, 4)
    crossing = Curve(level.points[:, [1, 0, 2]] - [2.0, -2.0, 0.0], level.evidence, (0, 0))
    assert [len(c.points) for c in once([level, crossing], 0.04, STEP_MM)] == [41, 41]


def test_a_part_keeps_what_it_had_and_stops_where_it_was_cut():
    curve = straight(0, 4)
    assert part(curve, 0, 41) is curve
    assert part(curve, 0, 20).stops == (Stop.UNOBSERVED.value, Stop.UNOBSERVED.value)
    assert part(curve, 20, 41).stops == curve.stops
    assert turned(curve).stops == curve.stops[::-1]
    assert leading_to([curve], 0).points[-1, 1] == 0
    place, way = end_of(curve.points)
    np.testing.assert_allclose([*place, *way], [0, 4, 0, 0, 1, 0], atol=1e-9)


def test_an_end_beside_another_curve_may_claim_the_rest_of_it():
    piece, other = straight(0, 2), straight(0.5, 4, x=0.1)
    (found,) = passings([piece, other], 0.2, 20.0, 8)
    assert (found.end, found.other, found.onward) == (1, 1, True)
    assert other.points[found.at, 1] == pytest.approx(2.0)
    (found,) = passings([piece, turned(other)], 0.2, 20.0, 8)
    assert not found.onward


def test_ends_that_are_far_turned_or_near_the_others_end_claim_nothing():
    piece = straight(0, 2)
    level = Curve(straight(0, 4).points[:, [1, 0, 2]] + [-2.0, 2.0, 0.0], np.ones(41), (0, 0))
    assert passings([piece, straight(0.5, 4, x=0.3)], 0.2, 20.0, 8) == []
    assert passings([piece, level], 0.2, 20.0, 8) == []
    assert passings([piece, straight(1.5, 4, x=0.1)], 0.2, 20.0, 8) == []
