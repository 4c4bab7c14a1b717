"""The table of accuracy: what is measured is what is scored, and what was measured is kept as long as it holds."""

import json
import os
import shutil
from dataclasses import replace

import pytest

from strandscope.core import accuracy, simulate
from strandscope.core.accuracy import HEADINGS, AccuracyParams, measure, save, table
from strandscope.core.compare import load_truth, score
from strandscope.core.errors import StrandscopeError
from strandscope.core.strands import load_strands

PARAMS = AccuracyParams(styles=("straight",), fibers=(3,), methods=("ours",), scale="pinch")


@pytest.fixture(scope="module", autouse=True)
def small():
    """Locks 3.4 mm high of a few fibers."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(simulate.SCALES, "pinch", simulate.Scale(120, 90, 8, 1.2, 3, 0.6, 1))
        yield


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    folder = tmp_path_factory.mktemp("locks")
    return folder, list(measure(folder, PARAMS))


def test_a_row_holds_the_score_of_its_strands(measured):
    folder, (row,) = measured
    assert (row["lock"], row["style"], row["fibers"], row["method"]) == ("straight_3", "straight", 3, "ours")
    strands = load_strands(folder / "results" / "straight_3-ours" / "strands.npz")
    assert row["score"] == json.loads(json.dumps(score(strands, load_truth(folder / "straight_3" / "truth.npz"))))
    assert row["score"]["recall"] > 0.5
    assert row["whole"]
    assert row["seconds"] > 0


def stamps(folder):
    return {p: p.stat().st_mtime_ns for p in folder.rglob("*") if p.is_file()}


def test_a_second_run_does_nothing(measured):
    folder, rows = measured
    before = stamps(folder)
    assert list(measure(folder, PARAMS)) == rows
    assert stamps(folder) == before


def test_a_score_older_than_its_truth_is_made_again(measured):
    folder, (row,) = measured
    kept = folder / "results" / "straight_3-ours" / "score.json"
    os.utime(kept, ns=(0, 0))
    (again,) = measure(folder, PARAMS)
    assert kept.stat().st_mtime_ns > (folder / "straight_3" / "truth.npz").stat().st_mtime_ns
    assert again["score"] == row["score"]
    assert not again["whole"]  # the ridges were there


@pytest.mark.parametrize(("again", "whole"), [("growing", False), ("all", True)])
def test_again_measures_anew_on_the_same_photographs(measured, again, whole):
    folder, (row,) = measured
    photographs = stamps(folder / "straight_3")
    (new,) = measure(folder, PARAMS, again=again)
    assert new["score"] == row["score"]
    assert new["whole"] == whole
    assert stamps(folder / "straight_3") == photographs


def test_more_captures_become_rows_named_after_their_folder(measured, tmp_path):
    folder, (row,) = measured
    other = shutil.copytree(folder / "straight_3", tmp_path / "known")
    rows = list(measure(folder, replace(PARAMS, captures=(other,))))
    assert [(r["lock"], r["style"], r["fibers"]) for r in rows] == [("straight_3", "straight", 3), ("known", "known", 3)]
    assert rows[1]["score"] == row["score"]
    (other / "truth.npz").unlink()
    with pytest.raises(StrandscopeError, match="known: has no truth"):
        list(measure(folder, replace(PARAMS, captures=(other,)), again="all"))


def test_a_lock_of_other_parameters_is_not_taken_for_what_was_asked(measured):
    with pytest.raises(StrandscopeError, match=r"straight_3: was simulated with seed 1, not 2"):
        list(measure(measured[0], replace(PARAMS, seed=2)))


def test_a_disk_too_small_is_told_before_anything_is_made(tmp_path, monkeypatch):
    monkeypatch.setattr(accuracy, "ROOM", 10**18)
    with pytest.raises(StrandscopeError, match="GB, the disk has"):
        list(measure(tmp_path / "new", PARAMS))
    assert not (tmp_path / "new").exists()


def test_an_unknown_method_is_told(tmp_path):
    with pytest.raises(StrandscopeError, match="method is 'magic'; expected one of ours, paper"):
        list(measure(tmp_path, replace(PARAMS, methods=("magic",))))


def test_the_table_says_what_was_measured(measured, tmp_path):
    _, (row,) = measured
    bins = {"0-0": [None, 0], "1-3": [0.1, 9], "4-7": [0.2, 9], "8-11": [0.4, 9], "12-15": [0.6, 9], "16-24": [1.0, 9]}
    known = {"recall": 0.9712, "recall_by_visible_angles": bins, "precision": 0.995, "n_curves": 31, "fragments_per_matched_hair": 1.034,
             "identity_switch_fraction": 0.0123, "pos_err_um": {"mean": 5.44}, "dir_err_deg": {"mean": 0.456}}  # fmt: skip
    rows = [row | {"score": known, "seconds": 61.4}]
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in table(rows).splitlines()]
    assert lines[0] == list(HEADINGS)
    expected = ["straight", "3", "ours", ".971", ".200", ".400", ".600", "1.000", ".995", "5.4", "0.46", "1.03", "1.2", "31", "61"]
    assert lines[2] == expected
    assert len({len(line) for line in table(rows).splitlines()}) == 1
    as_json, as_markdown = save(tmp_path, rows)
    assert json.loads(as_json.read_text(encoding="utf-8"))[0]["score"] == json.loads(json.dumps(known))
    assert as_markdown.read_text(encoding="utf-8").strip() == table(rows)
