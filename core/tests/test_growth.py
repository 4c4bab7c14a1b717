"""How cost grows: everything is measured once, what was measured is kept, and fits are those of known laws. No test looks at a time."""

import json
import multiprocessing
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from strandscope.core import cli, growth
from strandscope.core.errors import StrandscopeError
from strandscope.core.growth import AXES, PICTURE, QUICK, RESULT, GrowthParams, cases, describe, fit, grow_out, plot, series
from strandscope.core.growth_stages import STAGES, Job, measure
from strandscope.core.terminal import table

pytest.importorskip("resource", reason="this system does not tell how much memory a process took at most")

TINY = replace(QUICK, density=(6,), sweeps=(8,), workers=(1,))
NUMBERS = {"seconds", "processor_seconds", "peak_bytes", "program_bytes", "photographs", "features"}


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """The folder, and the report."""
    folder = tmp_path_factory.mktemp("growth")
    return folder, grow_out(folder, TINY)


@pytest.fixture
def pretended(monkeypatch):
    """Nothing is simulated or run; a stage takes 10 ns a feature, of which there are 1000 a fiber and sweep. The keys that were asked for."""
    asked = []

    def measured(case, _captures, tick):
        tick()
        asked.append(case.key)
        features = 1000 * case.lock.fibers * case.sweeps
        memory = {"peak_bytes": 10**8 + 100 * features, "program_bytes": 10**8}
        took = 1e-8 * features / case.workers
        return {"seconds": took, "processor_seconds": took, "photographs": 10 * case.sweeps, "features": features} | memory

    monkeypatch.setattr(growth, "_captures", lambda *_: {})
    monkeypatch.setattr(growth, "_measured", measured)
    return asked


def test_every_stage_is_measured_on_every_capture_in_positive_numbers(measured):
    folder, report = measured
    assert set(report["measured"]) == {case.key for case in cases(TINY)}
    assert {case.stage for case in cases(TINY)} == set(STAGES)
    for key, rounds in report["measured"].items():
        assert len(rounds) == TINY.rounds
        assert all(set(one) >= NUMBERS and all(number > 0 for number in one.values()) for one in rounds), key
        assert all(one["peak_bytes"] >= one["program_bytes"] for one in rounds), key
    assert json.loads((folder / RESULT).read_text()) == report


def test_twice_the_fibers_leave_more_features_and_twice_the_photographs_are_filtered(measured):
    report = measured[1]
    for stage in STAGES[1:]:
        few, many = (report["measured"][case.key][0]["features"] for case in cases(TINY) if case.stage == stage)
        assert many > 1.3 * few  # hair that stands behind other hair leaves less
    first, second = series(report, TINY, "photographs")[0].x
    assert second == 2 * first


def test_a_run_that_is_complete_measures_nothing_more(measured, monkeypatch):
    folder, report = measured
    monkeypatch.setattr(growth, "measure", lambda *_: pytest.fail("measured again"))
    assert grow_out(folder, TINY) == report


def test_what_is_wrong_in_the_process_is_told(tmp_path):
    with pytest.raises(StrandscopeError, match="nowhere"):
        measure(Job("index", tmp_path / "nowhere", tmp_path / "nowhere", 1, 1))


def test_a_measurement_that_is_cancelled_leaves_no_process(tmp_path):
    def cancel():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        measure(Job("index", tmp_path, tmp_path, 1, 1), cancel)
    assert not multiprocessing.active_children()


def test_an_interrupted_run_goes_on_after_its_last_measurement(tmp_path, pretended):
    whole = {case.key for case in cases(QUICK)}

    def stop(stage, done, _total):
        if stage == "measuring" and done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        grow_out(tmp_path, QUICK, stop)
    first = json.loads((tmp_path / RESULT).read_text())["measured"]
    assert len(first) == 5
    report = grow_out(tmp_path, QUICK)
    assert sorted(pretended) == sorted(whole)
    assert set(report["measured"]) == whole


def test_more_rounds_are_added_to_those_before(tmp_path, pretended):
    grow_out(tmp_path, QUICK)
    report = grow_out(tmp_path, replace(QUICK, rounds=3))
    assert len(pretended) == 3 * len(cases(QUICK))
    assert {len(rounds) for rounds in report["measured"].values()} == {3}


@pytest.mark.usefixtures("pretended")
def test_measurements_of_something_else_are_not_added_to(tmp_path):
    grow_out(tmp_path, QUICK)
    with pytest.raises(StrandscopeError, match=r"growth\.json: holds measurements with seed 0, not 1; expected the same, or another folder"):
        grow_out(tmp_path, replace(QUICK, seed=1))
    kept = json.loads((tmp_path / RESULT).read_text())
    (tmp_path / RESULT).write_text(json.dumps(kept | {"machine": kept["machine"] | {"cores": 1000}}))
    with pytest.raises(StrandscopeError, match="cores 1000"):
        grow_out(tmp_path, QUICK)
    (tmp_path / RESULT).write_text("{")
    with pytest.raises(StrandscopeError, match=r"growth\.json: is not what a run before wrote"):
        grow_out(tmp_path, QUICK)


@pytest.mark.parametrize(("change", "message"), [({"stages": ("cutting",)}, "'cutting'; expected one of"), ({"workers": (0,)}, "1 or more")])
def test_wrong_parameters_are_told(tmp_path, change, message):
    with pytest.raises(StrandscopeError, match=message):
        grow_out(tmp_path, replace(QUICK, **change))


@pytest.mark.parametrize("exponent", [0.0, 1.0, 1.7])
def test_the_exponent_is_that_of_the_law(exponent):
    x = np.array([1.0, 2, 5, 30])
    assert fit(x, 3 * x**exponent).exponent == pytest.approx(exponent, abs=1e-9)
    assert fit(x, 3 * x).slope == pytest.approx(3)
    assert fit(x[:1], x[:1]).exponent is None


@pytest.mark.usefixtures("pretended")
def test_what_is_linear_is_told_as_linear(tmp_path):
    params = GrowthParams(rounds=2)
    report = grow_out(tmp_path, params)
    wanted = {"photographs": 1, "fibers": 1, "density": 1, "features": 1, "workers": -1}
    for axis in AXES:
        for one in series(report, params, axis):
            assert fit(one.x, one.median["seconds"]).exponent == pytest.approx(wanted[axis])
    density = series(report, params, "density")[0]
    assert density.x[params.density.index(params.base_fibers)] == pytest.approx(params.per_mm2)
    text = table(describe(report, params))
    assert all(label in text for label in AXES.values())
    assert text.count("as x to the 1.00") > 10


def test_one_worker_and_one_size_can_be_drawn(measured, tmp_path):
    plot(measured[1], TINY, tmp_path / PICTURE)
    with Image.open(tmp_path / PICTURE) as picture:
        assert len(np.unique(np.asarray(picture.convert("L")))) > 10


def test_nothing_to_draw_is_told(tmp_path):
    with pytest.raises(StrandscopeError, match="nothing to draw"):
        plot({"measured": {}}, TINY, tmp_path / PICTURE)


def test_the_command_line_leaves_measurements_and_plot(tmp_path, pretended, capsys):
    assert cli.run(["growth", str(tmp_path / "out"), "--quick", "--workers", "1,3"]) == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == {RESULT, PICTURE}
    assert any("3 workers" in key for key in pretended)
    assert "fibers, equally dense" in capsys.readouterr().out
