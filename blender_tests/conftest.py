"""An empty Blender file for each test, a capture and strands that are small enough to be made anew."""

from pathlib import Path

import bpy
import numpy as np
import pytest

import strandscope
from strandscope.core.capture import Capture, Sweep, save_capture
from strandscope.core.geometry import Optics
from strandscope.core.raw import write_dng
from strandscope.core.strands import CAPTURED, INFILL, Strands, offsets_of, save_strands

BLACK, WHITE = 512, 15871
HEIGHT, WIDTH = 24, 32  # of a channel plane


@pytest.fixture(autouse=True)
def empty_file():
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)


@pytest.fixture
def registered():
    strandscope.register()
    yield
    strandscope.unregister()


@pytest.fixture
def strands() -> Strands:
    """Nine upright wavy strands around the axis, a third of them infill, with radii and confidences of all kinds."""
    rng = np.random.default_rng(3)
    sizes = rng.integers(2, 40, 9)
    parts = []
    for size in sizes:
        x, z = rng.uniform(-0.4, 0.4, 2)
        y = np.linspace(-0.5, 0.5, size)
        parts.append(np.stack([x + 0.05 * np.sin(9 * y), y, z + 0.05 * np.cos(7 * y)], axis=1))
    count = int(sizes.sum())
    return Strands(
        points_mm=np.concatenate(parts).astype(np.float32),
        offsets=offsets_of(sizes),
        radius_mm=rng.uniform(0.02, 0.06, count).astype(np.float32),
        kind=np.where(np.arange(9) % 3 == 2, INFILL, CAPTURED).astype(np.uint8),
        confidence=rng.uniform(0, 1, count).astype(np.float32),
        stops=rng.integers(0, 6, (9, 2)).astype(np.uint8),
        error_mm=np.where(np.repeat(np.arange(9) % 3 == 2, sizes), np.nan, rng.uniform(0, 0.05, count)).astype(np.float32),
        provenance={"capture": "a test", "parameters": {"step_mm": 0.1}},
    )


@pytest.fixture
def strands_file(tmp_path, strands) -> Path:
    save_strands(tmp_path / "strands.npz", strands)
    return tmp_path / "strands.npz"


@pytest.fixture
def capture(tmp_path) -> Capture:
    """Three sweeps of two photographs of noise: reddish hair in the middle, blue background at the sides."""
    rng = np.random.default_rng(5)
    sweeps = []
    for k, angle_deg in enumerate((0.0, 90.0, 215.0)):
        files = tuple(f"sweep_{k}/{i}.dng" for i in range(2))
        for file in files:
            planes = np.where(abs(np.arange(WIDTH) - WIDTH / 2) < 8, np.array([[0.3], [0.2], [0.1]]), np.array([[0.05], [0.1], [0.2]]))
            mosaic = np.zeros((2 * HEIGHT, 2 * WIDTH))
            for site, plane in zip(((0, 0), (0, 1), (1, 0), (1, 1)), planes[[0, 1, 1, 2]], strict=True):
                mosaic[site[0] :: 2, site[1] :: 2] = plane
            noisy = BLACK + (WHITE - BLACK) * mosaic + rng.normal(0, 20, mosaic.shape)
            write_dng(tmp_path / "capture" / file, noisy.astype(np.uint16), BLACK, WHITE)
        sweeps.append(Sweep(angle_deg, (-0.2, 0.1), files))
    made = Capture(tmp_path / "capture", "tiny", Optics(330.0, 0.05, 15.5, 11.5, 10.0), tuple(sweeps))
    save_capture(made)
    return made
