"""Close-ups of infills, as small as can be."""

from dataclasses import replace

import bpy
import numpy as np
import pytest
from PIL import Image

from strandscope.addon import turntable
from strandscope.addon.closeup import CloseupParams, Row, render_closeups
from strandscope.core.strands import save_strands

SIZE = 32


@pytest.fixture
def row(tmp_path, strands):
    """The truth is all strands; of these, an infill by the paper that has none, and one that has them all."""
    save_strands(tmp_path / "paper.npz", strands.captured)
    save_strands(tmp_path / "ours.npz", replace(strands, joins=np.array([[1, 4]])))
    radii = strands.radius_mm[strands.offsets[:-1]]
    samples = strands.points_mm[np.abs(strands.points_mm[:, 1]) < 0.4]
    truth = {"points": strands.points_mm, "offsets": strands.offsets, "radii": radii, "sample_points": samples}
    np.savez(tmp_path / "truth.npz", **truth, visibility=np.ones((len(samples), 3)))
    return Row("hair", *(tmp_path / f"{name}.npz" for name in ("truth", "paper", "ours")))


def tiles(path, count=4):
    with Image.open(path) as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(float)
    step = (pixels.shape[1] - SIZE) // (count - 1)
    return [pixels[:SIZE, k * step : k * step + SIZE] for k in range(count)]


@pytest.mark.parametrize("section", [{}, {"slab_mm": 0.4, "tilt_deg": 90.0}])
def test_what_is_the_same_hair_looks_the_same_and_nothing_is_left_behind(tmp_path, row, section):
    before = {name: len(getattr(bpy.data, name)) for name in turntable._KINDS}
    out = render_closeups([row], tmp_path / "out.png", CloseupParams(1.2, 1.2, SIZE, 4, **section))
    captured, paper, ours, truth = tiles(out)
    assert captured.std() > 5  # there is hair, and a background
    np.testing.assert_array_equal(captured, paper)  # of the same curves
    assert np.abs(ours - captured).mean() > 2  # another third of the hair
    assert np.abs(ours - truth).mean() < np.abs(captured - truth).mean()
    if section:
        orange = [np.sum(tile[..., 0] > 1.5 * tile[..., 2] + 40) for tile in (captured, ours, truth)]
        assert orange[0] == 0
        assert min(orange[1:]) > 0
    assert {name: len(getattr(bpy.data, name)) for name in turntable._KINDS} == before
