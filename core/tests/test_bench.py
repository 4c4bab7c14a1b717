"""The comparison of speed: every stage runs, answers are compared, and what is wrong or missing is told. No test looks at a time."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest

from strandscope.core import bench as benchmark
from strandscope.core import bench_inputs, bench_stages, cli
from strandscope.core.bench import bench, describe, expect_same, named_ratios, plot
from strandscope.core.bench_clock import Check, Contest, Least, Rates, Way, machine_rates, measure
from strandscope.core.bench_inputs import STAGES, BenchParams, RingParams, lossless_jpeg, write_lossless_dng
from strandscope.core.errors import StrandscopeError
from strandscope.core.laplace import KNOWN, UNKNOWN, laplace_fill
from strandscope.core.terminal import table

TINY = BenchParams(rounds=3, seconds=0.0, rows=150, columns=180, ring=RingParams(6, 90, 1.0, 5), grid=(20, 18, 16))


@pytest.fixture(scope="module", autouse=True)
def rates():
    """What the machine can do is not looked at."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(benchmark, "machine_rates", lambda: Rates(2e10, 1e11))
        yield


@pytest.fixture(scope="module")
def report(rates):  # noqa: ARG001
    return bench(TINY)


@pytest.fixture
def tiny(monkeypatch):
    """The command line measures on little."""
    monkeypatch.setattr(benchmark, "BenchParams", lambda **given: replace(TINY, **given))


def checks_of(report):
    return [check for contest in report["contests"] for way in (contest["ours"], *contest["others"]) for check in way["checks"]]


def test_every_stage_is_measured_and_gives_the_same_answers(report):
    assert {contest["stage"] for contest in report["contests"]} == set(STAGES)
    for stage in STAGES:
        contests = [contest for contest in report["contests"] if contest["stage"] == stage]
        assert any(way["checks"] for contest in contests for way in contest["others"]), stage
    assert all(check["same"] for check in checks_of(report)), checks_of(report)
    expect_same(report)


def test_json_holds_all_times_ratios_bounds_and_the_machine_without_its_name(report, tmp_path):
    read = json.loads(json.dumps(report))
    assert {"cores", "numpy", "numba", "scipy", "scikit-image", "rawpy", "python"} <= set(read["machine"])
    assert set(read["rates"]) == {"copied_bytes", "flops"}
    for contest in read["contests"]:
        assert contest["threads"] == 1
        assert contest["bound"]["limit"] in ("memory", "flops")
        assert contest["bound"]["seconds"] > 0
        for way in (contest["ours"], *contest["others"]):
            assert len(way["seconds"]) == len(way["processor_seconds"]) == 3
        for way in contest["others"]:
            assert 0 < way["ratio"]["low"] <= way["ratio"]["median"] <= way["ratio"]["high"]
    assert "/" not in "".join(map(str, read["machine"].values()))
    assert str(tmp_path.parent) not in json.dumps(read)


def test_rates_are_those_of_a_machine():
    copied_bytes, flops = machine_rates(1 << 16, 64, 2)
    assert 0 < copied_bytes < np.inf
    assert 0 < flops < np.inf


def test_the_least_time_is_that_of_what_takes_longest(report):
    for contest in report["contests"]:
        bound = contest["bound"]
        assert bound["seconds"] == pytest.approx(max(bound["moved_bytes"] / 2e10, bound["flops"] / 1e11))


def test_ways_take_turns_after_one_round_that_is_not_counted():
    called = []
    ours, other = Way("ours", lambda: called.append("a")), Way("other", lambda: called.append("b"))
    result = measure(Contest("ridges", "nothing", ours, [other], Least(0, 0, "")), 4, 60.0)
    assert "".join(called) == "ab" * 5
    assert len(result["ours"]["seconds"]) == 4


@pytest.mark.usefixtures("tiny")
def test_a_wrong_answer_is_told_and_ends_with_an_error(monkeypatch, capsys, tmp_path):
    right = bench_stages.read_planes
    monkeypatch.setattr(bench_stages, "read_planes", lambda path, channels: right(path, channels) + np.float32(1e-6))
    assert cli.run(["bench", "--stages", "decode", "--json", str(tmp_path / "b.json"), "--progress", "none"]) == 1
    said = capsys.readouterr()
    assert "DIFFERS: largest difference of red planes" in said.out
    assert "the answers differ" in said.err
    assert "decode, LibRaw" in said.err
    assert not all(check["same"] for check in checks_of(json.loads((tmp_path / "b.json").read_text())))


@pytest.mark.parametrize("apart", [0.2, np.nan, np.inf])
def test_what_is_far_apart_or_no_number_is_not_the_same(apart):
    assert not Check("a field", apart, 0.1).same


@pytest.mark.usefixtures("tiny")
def test_a_missing_opencv_is_told_in_words(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "cv2", None)
    assert cli.run(["bench", "--stages", "ridges", "--progress", "none"]) == 0
    said = capsys.readouterr().out
    assert "OpenCV is not installed" in said
    assert "opencv-python-headless" in said
    assert "scikit-image, sato" in said


def test_opencv_and_the_paper_choose_the_same_filters(tmp_path):
    pytest.importorskip("cv2")
    contests, left_out = bench_stages.contests_of("ridges", TINY, tmp_path)
    assert not left_out
    assert [way.name for way in contests[1].others] == ["OpenCV, 32 filters"]


@pytest.mark.usefixtures("tiny")
def test_the_command_prints_a_table_and_draws(capsys, tmp_path):
    picture = tmp_path / "b.png"
    assert cli.run(["bench", "--stages", "index,decode", "--plot", str(picture), "--progress", "none"]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    said = capsys.readouterr().out
    assert "LibRaw (rawpy)" in said
    assert "× ours" in said
    assert "of its bound" in said


def test_a_report_of_few_rounds_on_a_busy_machine_says_so(report):
    way = {"seconds": [1.0], "processor_seconds": [0.5], "checks": [], "name": "ours"}
    contest = report["contests"][0] | {"ours": way, "others": []}
    assert "was busy" in table(describe(report | {"contests": [contest]}))


@pytest.mark.usefixtures("tiny")
def test_stages_are_known(capsys):
    assert cli.STAGES == STAGES
    with pytest.raises(StrandscopeError, match="expected one of ridges, decode"):
        bench(replace(TINY, stages=("painting",)))
    assert cli.run(["bench", "--stages", "painting"]) == 2
    assert "painting" in capsys.readouterr().err


def test_every_other_way_is_drawn(report):
    twice = report | {"contests": [*report["contests"], report["contests"][0] | {"ours": report["contests"][0]["ours"] | {"name": "ours, other"}}]}
    for told in (report, twice):
        assert len(named_ratios(told)) == sum(len(contest["others"]) for contest in told["contests"])


def test_nothing_to_draw_is_an_error(report, tmp_path):
    with pytest.raises(StrandscopeError, match="nothing to draw"):
        plot(report | {"contests": []}, tmp_path / "b.png")


# ---- what is measured on ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("high", [2, 60, 65536])
def test_the_lossless_raw_file_holds_its_pixels(tmp_path, high):
    import rawpy

    pixels = np.random.default_rng(high).integers(0, high, (34, 52), np.uint16)
    write_lossless_dng(tmp_path / "a.dng", pixels)
    with rawpy.imread(str(tmp_path / "a.dng")) as raw:
        np.testing.assert_array_equal(raw.raw_image_visible, pixels)


def test_the_lossless_stream_is_smaller_than_the_pixels():
    photograph = bench_inputs.mosaic(TINY.rows, TINY.columns, 0)
    assert len(lossless_jpeg(photograph)) < 0.75 * photograph.nbytes


def test_the_matrix_is_that_of_the_solver():
    values, kinds = bench_inputs.surface_directions((12, 10, 14), 3)
    matrix, right = bench_stages.laplace_system(values, kinds)
    solved = np.linalg.solve(matrix.toarray(), right)
    filled = laplace_fill(values, kinds, 40, 0.0)
    np.testing.assert_allclose(filled[kinds == UNKNOWN], solved, atol=1e-5)
    np.testing.assert_array_equal(filled[kinds == KNOWN], values[kinds == KNOWN])


def test_inputs_are_those_of_the_seed():
    made = [bench_inputs.mosaic.__wrapped__(40, 50, seed) for seed in (1, 1, 2)]
    np.testing.assert_array_equal(made[0], made[1])
    assert np.any(made[0] != made[2])
