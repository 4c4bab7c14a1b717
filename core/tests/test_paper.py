"""The paper's growing, on curves that are known. What it does in dense hair is measured by ``core.accuracy``, not here."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from strandscope.core.features import USED, build_index
from strandscope.core.paper import PaperParams, grow_paper, solve_direction
from strandscope.core.stops import Stop

from .known import Seen, helix, in_volume, line, observe, wave

# The mean of a box 1.14 mm long lies k 1.14^2 / 24 beside a hair of curvature k (5 um for these), noise adds a few: as for
# ``grow``, whose weights keep the ends of the box from adding what they add here.
ON_CURVE_MM = 0.015
COVERED_MM = 0.07  # a point every 0.1 mm: half of it, and the most that a curve may lie beside


def grown_from(curves, seen=Seen(), params=PaperParams()):  # noqa: B008
    index = build_index(observe(curves, seen), seen.optics)
    return index, grow_paper(index, params)


def curves_of(grown):
    return [grown.points_mm[a:b].astype(float) for a, b in zip(grown.offsets[:-1], grown.offsets[1:], strict=True)]


def assert_found(truth, points, seen):
    assert cKDTree(truth).query(points)[0].max() < ON_CURVE_MM
    inside = truth[in_volume(truth, seen)]
    assert (cKDTree(points).query(inside)[0] < COVERED_MM).mean() >= 0.95


@pytest.mark.parametrize("truth", [line(), line(way=(0.5, 1, 0.3)), helix(), helix(right_handed=False), wave()])
@pytest.mark.parametrize("seen", [Seen(), Seen(turn_deg=180)])  # on half a turn errors of opposite cameras do not cancel
def test_a_fiber_is_found_from_end_to_end_and_once(truth, seen):
    index, grown = grown_from([truth], seen)
    assert len(grown.offsets) == 2
    assert_found(truth, curves_of(grown)[0], seen)
    assert np.all(grown.stops == Stop.LEFT_VOLUME)
    assert np.all(grown.evidence <= 12)  # cameras
    assert np.median(grown.evidence) >= 5  # a frame comes every 0.2 mm: half of the cameras have one within 0.05 mm
    assert (index.strength >= USED).mean() > 0.84  # they lie up to 0.5 mm out of focus, the box ends at 15 px, 0.43 mm


def test_fibers_that_no_box_joins_are_found_each():
    truths = [line(at=(-0.8, 0, 0.5)), line(at=(0.7, 0, -0.6), way=(-0.1, 1, 0.2)), helix(radius_mm=1.6)]
    _, grown = grown_from(truths)
    found = curves_of(grown)
    assert len(found) == 3
    owners = [int(np.argmin([cKDTree(t).query(points)[0].max() for t in truths])) for points in found]
    assert sorted(owners) == [0, 1, 2]
    for owner, points in zip(owners, found, strict=True):
        assert_found(truths[owner], points, Seen())


def test_a_fiber_shorter_than_asked_for_is_not_kept_and_keeps_its_features():
    short = line(half_mm=1.6)  # the boxes reach 0.57 mm beyond either end
    index, grown = grown_from([short])
    assert len(grown.offsets) == 1
    assert not (index.strength >= USED).any()
    _, grown = grown_from([short], params=PaperParams(min_length_mm=3.0))
    assert len(grown.offsets) == 2
    assert np.all(grown.stops == Stop.UNOBSERVED)


def test_a_gap_is_bridged_if_it_is_brief():
    """The boxes reach 0.57 mm beyond their middle: a gap of 1.4 mm leaves 0.26 mm unobserved, one of 2.4 mm leaves 1.26 mm."""
    whole = line(way=(0.1, 1, 0.1))
    for gap, pieces in ((1.4, 1), (2.4, 2)):
        parts = [whole[whole[:, 1] > gap / 2], whole[whole[:, 1] < -gap / 2]]
        index = build_index(observe(parts, Seen()), Seen().optics)
        grown = grow_paper(index, PaperParams(min_length_mm=1.2))
        assert len(grown.offsets) - 1 == pieces, gap


def test_observations_turned_away_are_left_out():
    """Features across the hair, one for three of its own: as many pull to either side, but they turn the mean orientation."""
    crossing = [line(at=(0.3, y, -0.2), way=(1, 0.4, 0.2), half_mm=0.25) for y in np.arange(-2.5, 2.6, 0.5)]
    _, gated = grown_from([line(), *crossing])
    points = curves_of(gated)[0]
    assert cKDTree(line()).query(points)[0].max() < ON_CURVE_MM
    _, open_to_all = grown_from([line(), *crossing], params=replace(PaperParams(), gate_deg=90.0))
    worst = max((cKDTree(line()).query(p)[0].max() for p in curves_of(open_to_all)), default=np.inf)
    assert worst > 2 * ON_CURVE_MM


def test_nothing_gives_no_curves():
    _, grown = grown_from([line()], replace(Seen(), share=0.0))
    assert len(grown.offsets) == 1
    assert grown.points_mm.shape == (0, 3)
    assert grown.tried == 0


def test_the_same_features_give_the_same_curves():
    again = [grown_from([helix(), line()], Seen(clutter=3000))[1] for _ in range(2)]
    assert np.array_equal(again[0].points_mm, again[1].points_mm)
    assert np.array_equal(again[0].stops, again[1].stops)


def test_the_direction_is_the_last_singular_vector():
    rng = np.random.default_rng(3)
    g = np.array((0.2, -0.9, 0.4)) / np.linalg.norm((0.2, -0.9, 0.4))
    normals = np.cross(rng.normal(size=(9, 3)), g) + rng.normal(0, 0.05, (9, 3))
    last = np.linalg.svd(normals)[2][-1]
    for near in (g, -g):
        found = solve_direction(normals, near)
        assert found @ near > 0
        assert abs(found @ last) == pytest.approx(1, abs=1e-12)
