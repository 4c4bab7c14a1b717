"""Curvature, torsion and their wavelengths on helices, waves and circles, which are known in closed form."""

import numpy as np
import pytest

from strandscope.core.bends import BendParams, bends, evenly, spectrum

from .known import helix


def flat(curves):
    """A list of (n, 3) -> points, offsets."""
    return np.concatenate(curves), np.concatenate([[0], np.cumsum([len(c) for c in curves])])


def turned(points, seed):
    """Points in another frame."""
    return points @ np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]


@pytest.mark.parametrize(("radius", "pitch"), [(1.2, 20.0), (3.0, 24.0), (0.3, 16.0)])
def test_a_helix_bends_and_turns_as_its_formula_says(radius, pitch):
    """κ = R / (R² + b²), τ = b / (R² + b²), b the rise for each radian. The windows take off what the module states: up to 3 % of τ."""
    rise = pitch / (2 * np.pi)
    square = radius**2 + rise**2
    curves = [helix(radius, pitch, hand, half_mm=15) for hand in (True, False)]
    found = bends(*flat([curves[0], curves[1], curves[1][::-1]]), BendParams(least_per_mm=0.01))
    known = ~np.isnan(found.torsion_per_mm)
    np.testing.assert_allclose(found.curvature_per_mm[~np.isnan(found.curvature_per_mm)], radius / square, rtol=0.01)
    hand = np.repeat([1, -1, -1], np.diff(found.offsets))  # the other way along, it is still of the same hand
    np.testing.assert_allclose(found.torsion_per_mm[known], (hand * rise / square)[known], rtol=0.03)
    assert known.mean() > 0.85


@pytest.mark.parametrize("right_handed", [True, False])
def test_the_power_of_a_helix_lies_at_its_turn_and_at_its_hand(right_handed):
    """The bend of a helix goes round once in 2π / τ of arc length; all of its power is at that wavelength and on one side."""
    coil = helix(0.5, 6.0, right_handed, half_mm=60)
    rise = 6.0 / (2 * np.pi)
    found = bends(*flat([coil]))
    power = spectrum(found.bend_per_mm, found.offsets, 0.1, 32.0)
    assert power.peak_mm == pytest.approx(2 * np.pi * (0.25 + rise**2) / rise, rel=0.01)
    strong, weak = (power.right, power.left) if right_handed else (power.left, power.right)
    assert strong.sum() > 1e3 * weak.sum()  # the rest is what taking off the mean leaves
    variance = (0.5 / (0.25 + rise**2)) ** 2
    apart = np.diff(1 / power.wavelength_mm).mean()
    assert power.power.sum() * apart == pytest.approx(variance, rel=0.02)  # Parseval


def test_a_plane_wave_has_its_wavelength_however_it_lies():
    x = np.arange(0, 80, 0.02)
    waved = np.stack([x, 0.05 * np.sin(2 * np.pi * x / 5.0), 0 * x], axis=1)
    for seed in range(3):
        found = bends(*flat([turned(waved, seed)]))
        power = spectrum(found.bend_per_mm, found.offsets, 0.1, 40.0)
        assert power.peak_mm == pytest.approx(5.0, rel=0.01)
        np.testing.assert_allclose(power.right.sum(), power.left.sum(), rtol=0.05)  # a plane wave has no hand


def test_a_straight_line_has_no_curvature_and_no_torsion():
    found = bends(*flat([np.linspace([0, 0, 0], [3, 4, 0], 7)]))
    inner = ~np.isnan(found.curvature_per_mm)
    assert inner.sum() == 51 - 20
    np.testing.assert_allclose(found.curvature_per_mm[inner], 0, atol=1e-12)
    assert np.all(np.isnan(found.torsion_per_mm))


def test_errors_of_points_become_curvature_as_stated():
    rng = np.random.default_rng(1)
    x = np.arange(0, 200.05, 0.1)
    lines = [np.stack([x, rng.normal(0, 1e-3, len(x)), rng.normal(0, 1e-3, len(x))], axis=1) for _ in range(5)]
    found = bends(*flat(lines))
    rms = np.sqrt(np.nanmean(np.abs(found.bend_per_mm) ** 2) / 2)  # of each of the two parts
    assert rms == pytest.approx(0.0048, rel=0.1)


def test_samples_lie_at_even_arc_lengths():
    points, offsets = flat([helix(1.0, 5.0, half_mm=3), np.array([[0, 0, 0], [0, 0.04, 0]]), np.array([[0, 0, 0], [0, 1, 0], [0, 1.55, 0]])])
    even, starts = evenly(points, offsets, 0.1)
    assert np.diff(starts)[1] == 0
    np.testing.assert_allclose(even[starts[2] :, 1], np.arange(0.025, 1.55, 0.1), atol=1e-9)
    gaps = np.linalg.norm(np.diff(even[: starts[1]], axis=0), axis=1)
    np.testing.assert_allclose(gaps, 0.1, rtol=1e-3)
    even, starts = evenly(points, offsets, 0.1, ends=True)
    np.testing.assert_array_equal(even[starts[:-1]], points[offsets[:-1]])
    np.testing.assert_allclose(even[starts[1:] - 1], points[offsets[1:] - 1], atol=1e-12)
    assert np.diff(starts)[1] == 2


def test_segments_do_not_run_from_curve_to_curve_nor_over_gaps():
    """Two curves with different constants: any segment over both would have power; so would one over the gap."""
    signal = np.concatenate([np.full(100, 1.0), np.full(100, 5.0)])
    signal[[150, 160]] = np.nan
    keep = np.ones(200, bool)
    found = spectrum(signal, np.array([0, 100, 200]), 0.1, 3.0, keep)
    assert found.segments == 5 + 2 + 1  # runs of 100, 50 and 39 samples; segments of 30, 15 apart
    np.testing.assert_allclose(found.power, 0, atol=1e-20)
    nothing = spectrum(signal, np.array([0, 100, 200]), 0.1, 20.0)
    assert nothing.segments == 0
    assert np.isnan(nothing.peak_mm)


def test_no_curves_have_no_bends():
    found = bends(np.empty((0, 3)), np.zeros(1, np.int64))
    assert len(found.curvature_per_mm) == 0
    assert spectrum(found.bend_per_mm, found.offsets, 0.1, 4.0).segments == 0
