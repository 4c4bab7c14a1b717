"""Captures that many tests look at: one of noise, small enough to be made anew for each test, and a lock that has been reconstructed."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from strandscope.core.pipeline import preset, reconstruct
from strandscope.core.raw import write_dng
from strandscope.core.simulate import SimulateParams
from strandscope.core.simulate_features import simulate_features

BLACK, WHITE = 512, 15871
CAPTURED_ONLY = replace(preset(), infill=None)


@pytest.fixture
def noise_capture(tmp_path) -> Path:
    """A whole capture of 4 sweeps x 5 photographs, 64 x 48 pixels a channel plane, of nothing but noise."""
    return make_capture(tmp_path / "capture")


def make_capture(folder: Path) -> Path:
    rng = np.random.default_rng(7)
    sweeps = []
    for k in range(4):
        files = [f"sweep_{k:03d}/img_{i:04d}.dng" for i in range(5)]
        for file in files:
            write_dng(folder / file, rng.integers(BLACK, 4000, (96, 128), np.uint16), BLACK, WHITE)
        sweeps.append({"angle_deg": 90.0 * k, "first_mm": -0.4, "step_mm": 0.2, "files": files})
    optics = {"working_distance_mm": 330.0, "pitch_mm": 1 / 35, "axis_col_px": 31.5, "axis_row_px": 23.5, "aperture_cone_deg": 10.0}
    head = {"format": "strandscope-capture", "version": 1, "name": "noise", "optics": optics, "sweeps": sweeps}
    (folder / "capture.json").write_text(json.dumps(head))
    return folder


@pytest.fixture(scope="session")
def lock(tmp_path_factory) -> tuple[Path, bytes]:
    """A capture that comes with features, and the bytes of a run alone that nothing disturbs."""
    folder = tmp_path_factory.mktemp("features")
    simulate_features(folder / "lock", SimulateParams(style="wavy", scale="tiny", fibers=6, seed=5))
    reconstruct(folder / "lock", folder / "whole.npz", CAPTURED_ONLY)
    return folder / "lock", (folder / "whole.npz").read_bytes()
