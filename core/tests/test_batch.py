"""Many captures: each has its own file, what is done is left alone, and one that fails stops nothing."""

import json
import shutil
from dataclasses import replace

import pytest

from strandscope.core.batch import batch, names, read_list
from strandscope.core.cli import run
from strandscope.core.errors import StrandscopeError
from strandscope.core.grow import GrowParams
from strandscope.core.pipeline import reconstruct
from strandscope.core.simulate import SimulateParams
from strandscope.core.simulate_features import simulate_features
from strandscope.core.strands import load_strands

from .conftest import CAPTURED_ONLY


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("features")
    for name, seed in (("one", 1), ("two", 2)):
        simulate_features(folder / name / "lock", SimulateParams(style="wavy", scale="tiny", fibers=2, seed=seed))
    return folder


@pytest.fixture
def locks(simulated, tmp_path):
    """Two captures of one name, and one whose features are damaged."""
    shutil.copytree(simulated, tmp_path / "locks")
    shutil.copytree(simulated / "one/lock", tmp_path / "locks/broken")
    features = next((tmp_path / "locks/broken").rglob("*.features"))
    features.write_bytes(features.read_bytes()[:1000])
    return [tmp_path / "locks" / name for name in ("one/lock", "broken", "two/lock")]


def test_a_capture_that_fails_does_not_stop_the_others_and_what_is_done_is_kept(locks, tmp_path):
    said, told = [], []
    first = list(batch(locks, tmp_path / "out", CAPTURED_ONLY, progress=lambda _stage, done, total: told.append(done / total), tell=said.append))
    assert [bool(outcome.error) for outcome in first] == [False, True, False]
    assert "not a whole features file" in first[1].error
    assert told == sorted(told)
    assert (told[0], told[-1]) == (0, 1)
    assert len(said) == 3
    outputs = [tmp_path / "out" / name for name in ("lock.npz", "two-lock.npz")]
    for path, outcome, capture in zip(outputs, first[::2], locks[::2], strict=True):
        assert outcome.output == str(path)
        assert outcome.strands == len(load_strands(path))
        reconstruct(capture, tmp_path / "alone.npz", CAPTURED_ONLY)
        assert path.read_bytes() == (tmp_path / "alone.npz").read_bytes()

    times = [path.stat().st_mtime_ns for path in outputs]
    second = list(batch(locks, tmp_path / "out", CAPTURED_ONLY))
    assert [outcome.kept for outcome in second] == [True, False, True]
    assert [outcome.strands for outcome in second] == [outcome.strands for outcome in first]
    assert [path.stat().st_mtime_ns for path in outputs] == times

    outputs[0].unlink()
    longer = replace(CAPTURED_ONLY, grow=replace(GrowParams(), min_length_mm=0.9))
    assert [outcome.kept for outcome in batch(locks[2:], tmp_path / "out", CAPTURED_ONLY)] == [True]
    assert [outcome.kept for outcome in batch(locks[2:], tmp_path / "out", longer)] == [False]
    assert [outcome.kept for outcome in batch(locks[:1], tmp_path / "out", CAPTURED_ONLY)] == [False]
    features = next(locks[0].rglob("*.features"))
    features.touch()
    assert [outcome.kept for outcome in batch(locks[:1], tmp_path / "out", CAPTURED_ONLY)] == [False]


def test_progress_may_cancel_all(locks, tmp_path):
    class Cut(Exception):
        pass

    def cut(_stage, done, _total):
        if done > 0.6:
            raise Cut

    with pytest.raises(Cut):
        list(batch(locks, tmp_path / "out", CAPTURED_ONLY, progress=cut))


def test_the_verb_tells_people_and_programs_and_ends_with_1_if_one_failed(locks, tmp_path, capsys):
    (tmp_path / "list.txt").write_text("# the bad one\nlocks/broken\n\nlocks/nowhere  # nor is this\n", encoding="utf-8")
    argv = ["batch", str(locks[0]), "-o", str(tmp_path / "out"), "--no-infill", "--progress", "none"]
    assert run([*argv, "--list", str(tmp_path / "list.txt"), "--json", str(tmp_path / "told.json")]) == 1
    out, err = capsys.readouterr()
    rows = out.splitlines()
    assert rows[0].split() == ["capture", "strands", "minutes"]
    assert [row.split()[0] for row in rows[1:]] == [str(path) for path in (locks[0], locks[1], tmp_path / "locks/nowhere")]
    assert err.splitlines()[-1] == "strandscope: 2 of 3 captures failed"
    told = json.loads((tmp_path / "told.json").read_text(encoding="utf-8"))
    assert told["failed"] == 2
    assert [bool(row["error"]) for row in told["captures"]] == [False, True, True]
    assert run(argv) == 0
    assert "kept from before" in capsys.readouterr().out


def test_no_two_captures_get_one_name(tmp_path):
    captures = [tmp_path / path for path in ("a/lock", "b/lock", "b/Lock", "b/lock/capture.json", "b/lock/few.json", "c/few", "a/../a/lock")]
    named = names(captures, {})
    assert list(named.values())[:2] == ["lock", "b-lock"]
    assert len({name.lower() for name in named.values()}) == len(named)
    assert len(named) == 6  # the last is the first
    # names that were given stay, whatever comes with them
    again = names(reversed(captures), {name: capture for capture, name in named.items()})
    assert again == named
    assert names([tmp_path / "z/lock"], {"lock": str(tmp_path / "a/lock")}) == {str(tmp_path / "z/lock"): "z-lock"}


def test_a_list_that_cannot_be_read_is_named(tmp_path):
    with pytest.raises(StrandscopeError, match=r"list\.txt: cannot be read"):
        read_list(tmp_path / "list.txt")
