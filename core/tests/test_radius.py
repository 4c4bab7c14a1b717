"""Radii against what is known: broad ridges are thick hair, and little evidence changes little."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from strandscope.core.features import build_index
from strandscope.core.grow import GrowParams
from strandscope.core.radius import RadiusParams, measured, radii
from strandscope.core.refine import RefineParams, trace
from strandscope.core.ridges import RidgeParams, detect

from .known import OPTICS, Seen, drawn_line, line, observe

PARAMS = RadiusParams()
PITCH = 1 / 35


def test_the_breadth_of_a_drawn_hair_grows_with_its_width():
    breadth = []
    for width_px in (1.8, 2.4, 3.0, 3.8, 5.0):
        plane = drawn_line((80, 80), 1.2, (39.6, 40.3), width_px, rounded=True).astype(np.float32)
        breadth.append(float(np.median(detect(plane, RidgeParams(offset=0.2)).breadth)))
    assert np.all(np.diff(breadth) > 0.05)


def test_a_fiber_as_broad_as_usual_is_as_thick_as_usual():
    found = radii(np.full(5, PARAMS.breadth), np.full(5, 100), PARAMS.usual_mm / 1.4, PARAMS)
    assert found == pytest.approx(PARAMS.usual_mm)


def test_fibers_are_compared_with_each_other_better_than_with_a_ruler():
    """Broader by a factor of e in the radius: much of it is believed of one fiber, and little of all."""
    lengths = np.full(9, 1000)
    breadth = np.full(9, PARAMS.breadth)
    one, all_of_them = breadth.copy(), breadth + PARAMS.slope
    one[4] += PARAMS.slope
    pitch = PARAMS.usual_mm / 1.4
    told_one = np.log(radii(one, lengths, pitch, PARAMS) / PARAMS.usual_mm)
    told_all = np.log(radii(all_of_them, lengths, pitch, PARAMS) / PARAMS.usual_mm)
    assert told_one[[0, 8]] == pytest.approx(0)
    assert 0.4 < told_one[4] < 1
    assert np.ptp(told_all) == pytest.approx(0)
    assert 0.1 < told_all[0] < 0.4


def test_a_short_piece_tells_less_and_one_that_is_not_seen_nothing():
    breadth = PARAMS.breadth + np.array([0, 0, 0, PARAMS.slope, PARAMS.slope, np.nan])
    found = np.log(radii(breadth, np.array([50, 50, 50, 100, 10, 10]), PARAMS.usual_mm / 1.4, PARAMS) / PARAMS.usual_mm)
    assert found[3] > 1.2 * found[4] > 0
    assert found[5] == pytest.approx(found[0])
    assert radii(np.array([np.nan]), np.array([10]), PITCH, PARAMS) == pytest.approx(PARAMS.usual_mm)
    assert radii(np.zeros(0), np.zeros(0, int), PITCH, PARAMS).shape == (0,)


def test_the_thicker_of_two_hairs_is_found_thicker_whatever_the_number_of_threads():
    truths = [line(), line(at=(-0.6, 0, 0.4), way=(0.1, 1, -0.1))]
    seen = Seen(breadths=(PARAMS.breadth - 0.1, PARAMS.breadth + 0.1))
    sweeps = observe(truths, seen)
    index = build_index(sweeps, OPTICS)
    grown = trace(index, GrowParams(), RefineParams())
    one, two = (measured(index, sweeps, grown.points_mm, grown.offsets, GrowParams(), RefineParams(), PARAMS, workers) for workers in (1, 2))
    np.testing.assert_array_equal(one, two)
    assert one.dtype == np.float32
    nearest = np.argmin([cKDTree(t).query(grown.points_mm)[0] for t in truths], axis=0)
    ratio = one[nearest == 1].mean() / one[nearest == 0].mean()
    # 0.2 of breadth is a factor of exp(0.2 / slope) = 1.47; half of its logarithm or more is believed
    assert 1.2 < ratio < 1.47
