"""Known hair has to be hair: fibers of true width that nowhere run through each other, and bend as fibers do."""

from dataclasses import replace

import numpy as np
import pytest

from strandscope.core.errors import StrandscopeError
from strandscope.core.groom import STYLES, Groom, GroomParams, clearance, curvature, groom

SMALL = GroomParams(fibers=30, lock_radius_mm=1.4, half_height_mm=4.0)


def locks():
    return [pytest.param(replace(SMALL, style=style), seed, id=f"{style}-{seed}") for style in STYLES for seed in (0, 1)]


@pytest.mark.parametrize(("params", "seed"), locks())
def test_no_two_fibers_overlap(params, seed):
    assert clearance(groom(params, np.random.default_rng(seed))) > 0


def test_clearance_is_that_of_all_pairs():
    """Against every pair of densely sampled points, which cannot come closer than the curves do."""
    lock = groom(replace(SMALL, fibers=8), np.random.default_rng(2))
    fiber = np.repeat(np.arange(8), np.diff(lock.offsets))
    distance = np.linalg.norm(lock.points_mm[:, None] - lock.points_mm, axis=2) - lock.radii_mm[fiber][:, None] - lock.radii_mm[fiber]
    nearest = distance[fiber[:, None] != fiber].min()
    assert nearest - 0.03 < clearance(lock) <= nearest + 1e-9  # 0.1 mm between points, at fibers 0.08 mm apart


def test_clearance_of_fibers_that_run_through_each_other_is_negative():
    y = np.linspace(-1, 1, 21)
    straight, leaning = np.stack([0 * y, y, 0 * y], -1), np.stack([0.3 * y, y, 0 * y], -1)
    crossed = Groom(np.concatenate([straight, leaning]), np.array([0, 21, 42]), np.array([0.04, 0.04]))
    assert clearance(crossed) == pytest.approx(-0.08, abs=1e-6)


@pytest.mark.parametrize(("params", "seed"), locks())
def test_fibers_are_smooth_and_sampled_densely(params, seed):
    """A radius of curvature under 0.5 mm is a kink; chords of the points stay within a micrometre of the curve."""
    lock = groom(params, np.random.default_rng(seed))
    for i in range(len(lock)):
        steps = np.linalg.norm(np.diff(lock[i], axis=0), axis=1)
        bend = curvature(lock[i])
        assert bend.max() < 2.0
        assert steps.max() <= 0.1 + 1e-9
        assert (bend * np.maximum(steps[1:], steps[:-1]) ** 2 / 8).max() < 1e-3
        assert np.abs(np.diff(bend) / steps[1:-1]).max() < 8.0  # 1/mm²: curvature comes and goes over some tenths of a millimetre


@pytest.mark.parametrize("style", STYLES)
def test_fibers_have_the_widths_asked_for_and_cross_the_whole_height(style):
    lock = groom(replace(SMALL, style=style), np.random.default_rng(3))
    assert len(lock) == 30
    assert lock.radii_mm.min() >= 0.03
    assert lock.radii_mm.max() <= 0.05
    for i in range(len(lock)):
        assert lock[i][:, 1].min() <= -3.95
        assert lock[i][:, 1].max() >= 3.95


def test_curls_turn_around_and_straight_hair_does_not():
    """How far the direction of a fiber turns about the vertical, per height."""

    def turning(style):
        lock = groom(replace(SMALL, style=style, lock_radius_mm=2.0), np.random.default_rng(4))
        tangents = [np.diff(lock[i], axis=0) for i in range(len(lock))]
        return np.median([np.ptp(np.unwrap(np.arctan2(t[:, 2], t[:, 0]))) for t in tangents]), np.median(np.abs(np.concatenate(tangents)[:, 1]))

    turn, _ = turning("curls")
    assert turn > 1.5 * np.pi
    assert np.median([curvature(c).mean() for c in [groom(SMALL, np.random.default_rng(4))[0]]]) < 0.3


def test_some_fibers_leave_the_lock():
    lock = groom(replace(SMALL, flyaway_share=0.2), np.random.default_rng(5))
    kept = groom(replace(SMALL, flyaway_share=0.0), np.random.default_rng(5))
    far = [max(np.hypot(g[i][:, 0], g[i][:, 2]).max() for i in range(len(g))) for g in (lock, kept)]
    assert far[0] > 0.9 * SMALL.lock_radius_mm


def test_the_same_seed_gives_the_same_lock():
    first, again, other = (groom(SMALL, np.random.default_rng(seed)) for seed in (6, 6, 7))
    assert np.array_equal(first.points_mm, again.points_mm)
    assert not np.array_equal(first.radii_mm, other.radii_mm)


@pytest.mark.parametrize(
    ("change", "word"),
    [({"style": "afro"}, "style"), ({"fibers": 0}, "fibers"), ({"fibers": 5000}, "room"), ({"diameter_mm": (0.1, 0.06)}, "diameter_mm")],
)
def test_impossible_locks_are_refused_in_words(change, word):
    with pytest.raises(StrandscopeError, match=word):
        groom(replace(SMALL, **change), np.random.default_rng(0))
