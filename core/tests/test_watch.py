"""What is wrong with photographs of known hair is told, and nothing else."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from strandscope.core.rig.camera import CameraSettings
from strandscope.core.rig.plan import Place
from strandscope.core.rig.watch import Watch, look, motion, sharpness
from strandscope.core.simulate import BLACK, WHITE, Scale, SimulateParams, Studio
from strandscope.core.virtual_rig import photographer, virtual_studio

OPEN = CameraSettings(0.1, 2.8, 100)
POSITIONS = tuple(np.round(np.linspace(-2.4, 2.4, 9), 3))


@cache
def studio() -> Studio:
    return virtual_studio(SimulateParams(scale=Scale(180, 150, 4, 1.8, 24, 1.0, 0)))


def taken(focus_mm: float, number: int = 1, moved_mm: float = 0.0, light: float = 1.0) -> np.ndarray:
    """Channel planes (3, H, W) of the lock, which has been moved to the right."""
    hair = replace(studio().hair, points_mm=studio().hair.points_mm + np.array([moved_mm, 0.0, 0.0]))
    mosaic = photographer(replace(studio(), hair=hair))(Place(0.0, focus_mm), OPEN, number, False).astype(np.float32)
    mosaic = light * (mosaic - BLACK) / (WHITE - BLACK)
    return np.clip(np.stack([mosaic[::2, ::2], (mosaic[::2, 1::2] + mosaic[1::2, ::2]) / 2, mosaic[1::2, 1::2]]), 0, 1)


def sweep(watch: Watch, number: int, positions=POSITIONS, light=lambda _i: 1.0) -> list[str]:
    """All that is told while a sweep is photographed."""
    told = []
    for i, focus in enumerate(positions):
        told += watch.photograph(number, i, focus, taken(focus, number * 100 + i, light=light(i)))[1]
    return told + watch.sweep_done(len(positions))


def test_sharpness_is_highest_in_focus_and_does_not_change_with_the_light():
    sharp = [sharpness(taken(focus)[0]) for focus in POSITIONS]
    assert abs(POSITIONS[int(np.argmax(sharp))]) < 1.0  # inside the lock
    assert max(sharp) > 3 * min(sharp)
    planes = taken(0.0)
    assert sharpness(0.3 * planes[0]) == pytest.approx(sharpness(planes[0]), rel=1e-3)


def test_nothing_is_told_of_a_sweep_that_is_as_it_should_be():
    watch = Watch()
    assert sweep(watch, 0) == []
    assert watch.check(taken(POSITIONS[0], 77)) == []


@pytest.mark.parametrize(("light", "word"), [(2.6, "at white"), (0.12, "faint")])
def test_wrong_exposure_is_told_once_a_sweep(light, word):
    watch = Watch()
    told = sweep(watch, 0, POSITIONS, lambda _i: light) + sweep(watch, 1, POSITIONS, lambda _i: light)
    assert sum(word in line for line in told) == 2


def test_a_sweep_without_focus_and_one_that_ends_inside_the_hair_are_told():
    assert any("nothing came into focus" in line for line in sweep(Watch(), 0, tuple(np.linspace(-30.0, -26.0, 9))))
    told = sweep(Watch(), 0, POSITIONS[4:])
    assert any("in its first photograph" in line for line in told)
    assert not any("in its last" in line for line in told)


def test_light_that_drifts_or_has_changed_is_told():
    watch = Watch()
    sweep(watch, 0)
    told = sweep(watch, 1, light=lambda i: 1 + 0.06 * i / (len(POSITIONS) - 1))
    assert any("the light changed by +" in line for line in told)
    watch = Watch()
    sweep(watch, 0)
    assert any("differs by -1" in line for line in sweep(watch, 1, light=lambda _i: 0.88))


@pytest.mark.parametrize("focus_mm", [-1.8, -4.0, -8.0])
@pytest.mark.parametrize("moved_px", [0.0, 1.0, 3.0])
def test_motion_of_hair_is_measured_in_focus_and_out_of_it(focus_mm, moved_px):
    """Blurred hair is seen up to a fifth larger; a change of light is none."""
    found = motion(taken(focus_mm, 1)[0], taken(focus_mm, 2, moved_px / 35, light=0.9)[0]).largest()[0]
    assert found == pytest.approx(moved_px, abs=0.1 + 0.25 * moved_px)


def test_hair_that_moved_is_told_with_the_sweep_to_repeat():
    watch = Watch()
    sweep(watch, 3)
    assert watch.check(taken(POSITIONS[0], 5, moved_mm=0.005)) == []
    (told,) = watch.check(taken(POSITIONS[0], 5, moved_mm=0.06))
    assert "--repeat-sweep 3" in told


def test_what_is_seen_is_noted_in_plain_numbers():
    record = look(taken(0.0)).record()
    assert set(record) == {"clipped", "bright", "sharpness"}
    assert all(isinstance(value, float) for value in record.values())
