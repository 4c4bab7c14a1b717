"""Features without photographs: of the hair that is there, as a filter would find it, and the same every time."""

import json

import numpy as np
import pytest

from strandscope.core.capture import features_path, load_capture
from strandscope.core.compare import load_truth, score
from strandscope.core.errors import StrandscopeError
from strandscope.core.features import load_features, unpack
from strandscope.core.geometry import camera_points
from strandscope.core.hull import HullParams
from strandscope.core.pipeline import find_features, preset, reconstruct, resolve
from strandscope.core.progress import silent
from strandscope.core.simulate import SimulateParams, simulate
from strandscope.core.simulate_features import FOLDER, ObserveParams, simulate_features

PARAMS = SimulateParams(style="wavy", scale="tiny", fibers=12, seed=5)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return simulate_features(tmp_path_factory.mktemp("features") / "lock", PARAMS)


def test_a_feature_lies_on_a_hair_in_focus(capture):
    truth = np.load(capture.truth_path)
    sweep = load_features(features_path(capture.folder / FOLDER, 3))
    u, v, d, _ = unpack(sweep, capture.optics)
    points = camera_points(truth["points"].astype(float), capture.sweeps[3].angle_deg)
    share = 0
    for i in np.random.default_rng(0).choice(len(sweep), 300, replace=False):
        near = np.hypot(points[:, 0] - u[i], points[:, 1] - v[i]) < 0.12  # points are up to 0.1 mm apart; a third of a degree at 0.5 mm
        share += near.any() and np.abs(points[near, 2] - d[i]).min() < 1.1
    # spurious runs are 3 of 13, and perspective moves what is 1 mm out of focus 2 mm from the axis by 6 um
    assert share > 0.72 * 300


def test_what_is_hidden_leaves_fewer_features(capture):
    truth, observe = np.load(capture.truth_path), ObserveParams()
    seen = truth["visibility"].astype(float)
    # a piece is found about as long as its strength is over the least: none where nothing of the aperture sees it
    assert observe.strength * np.quantile(seen, 0.05) < observe.least
    counts = [len(load_features(features_path(capture.folder / FOLDER, k))) for k in range(len(capture.sweeps))]
    # mm of hair that half the aperture sees, times 35 rows a mm, in the photographs in which a strong one is found, and what is spurious
    photographs = 2 * observe.focus_mm * np.sqrt(2 * np.log(observe.strength / observe.least)) / PARAMS.step_mm
    wanted = (seen > 0.5).sum(axis=0) * 0.1 * 35 * photographs * (1 + observe.spurious)
    assert np.sum(counts) == pytest.approx(wanted.sum(), rel=0.3)


def test_as_many_as_the_filter_finds_in_photographs(capture, tmp_path):
    """Within a third: the filter is another piece of hair, with light and shadow."""
    photographs = simulate(tmp_path / "lock", PARAMS)
    parameters = resolve(photographs, preset())
    found = find_features(photographs, tmp_path / "work", parameters, 2, silent)
    made = [load_features(features_path(capture.folder / FOLDER, k)) for k in range(len(capture.sweeps))]
    assert sum(map(len, made)) == pytest.approx(sum(map(len, found)), rel=0.35)


def test_fibers_and_infill_grow_from_features_alone(capture, tmp_path):
    strands = reconstruct(capture.folder, tmp_path / "strands.npz", preset(), workers=2)
    told = score(strands, load_truth(capture.truth_path))
    assert told["recall"] > 0.97
    assert told["precision"] > 0.98
    assert not list(capture.folder.rglob("*.dng"))


def test_the_same_whatever_the_number_of_threads_and_kept_when_it_is_there(capture, tmp_path):
    again = simulate_features(tmp_path / "lock", PARAMS, workers=1)
    for path in sorted((capture.folder / FOLDER).iterdir()):
        assert (again.folder / FOLDER / path.name).read_bytes() == path.read_bytes(), path.name
    kept = features_path(capture.folder / FOLDER, 0)
    changed = kept.stat().st_mtime_ns
    simulate_features(capture.folder, PARAMS)
    assert kept.stat().st_mtime_ns == changed
    with pytest.raises(StrandscopeError, match="holds a simulation with seed 5, not 6"):
        simulate_features(capture.folder, SimulateParams(style="wavy", scale="tiny", fibers=12, seed=6))


def test_a_run_that_was_cut_short_goes_on(capture, tmp_path):
    def cancel(stage, done, _total):
        if stage == "features" and done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_features(tmp_path / "lock", PARAMS, progress=cancel)
    assert not (tmp_path / "lock" / "capture.json").is_file()
    again = simulate_features(tmp_path / "lock", PARAMS)
    for k in range(len(capture.sweeps)):
        assert features_path(again.folder / FOLDER, k).read_bytes() == features_path(capture.folder / FOLDER, k).read_bytes()


def test_features_that_are_missing_are_named(capture, tmp_path):
    head = json.loads((capture.folder / "capture.json").read_text())
    (tmp_path / "features").mkdir()
    (tmp_path / "capture.json").write_text(json.dumps(head))
    with pytest.raises(StrandscopeError, match=r"missing sweep_000\.features"):
        load_capture(tmp_path)
    assert load_capture(capture.folder).shape == (180, 150)
    assert HullParams().block_px == 8
