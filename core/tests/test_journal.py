"""A run that is cut short anywhere goes on behind what it has found, and ends with the bytes of an undisturbed one."""

import sys

import numpy as np
import pytest

from strandscope.core import journal as journals
from strandscope.core.errors import StrandscopeError
from strandscope.core.features import build_index
from strandscope.core.grow import GrowParams
from strandscope.core.journal import Journal
from strandscope.core.pipeline import reconstruct
from strandscope.core.refine import RefineParams, trace

from .conftest import CAPTURED_ONLY
from .known import OPTICS, Seen, helix, line, observe, wave

RECORDS = [{"numbers": np.arange(5)}, {"none": np.zeros((0, 3))}, {"numbers": np.float32([[0.5]])}]


def written(path, records=RECORDS, made_from="these"):
    """A journal of records; returns where each of them ends."""
    ends = []
    with Journal(path, made_from) as journal:
        for record in records:
            journal.write("some", **record)
            ends.append(path.stat().st_size)
    return ends


def read(path, made_from="these"):
    with Journal(path, made_from) as journal:
        return list(iter(lambda: journal.next("some"), None))


def same(told, records):
    return len(told) == len(records) and all(np.array_equal(a[name], b[name]) for a, b in zip(told, records, strict=True) for name in b)


# ---- the file --------------------------------------------------------------------------------------------------------


def test_torn_anywhere_the_whole_records_before_are_there(tmp_path):
    path = tmp_path / "a.journal"
    ends = written(path)
    whole = path.read_bytes()
    around = [end + i for end in ends for i in range(-20, 20)]
    for cut in sorted({*range(0, len(whole), 3), *around} & {*range(len(whole))}):
        path.write_bytes(whole[:cut])
        assert same(read(path), RECORDS[: sum(end <= cut for end in ends)])
        if cut % 60 == 0:  # and it is written on behind them
            kept = len(read(path))
            with Journal(path, "these") as journal:
                while journal.next("some"):
                    pass
                journal.write("some", **RECORDS[2])
            assert same(read(path), [*RECORDS[:kept], RECORDS[2]])


@pytest.mark.parametrize("tail", [b"\0" * 100, b"\xff" * 100, b"\0\0\0\x01"], ids=["zeros", "ones", "short"])
def test_what_a_crash_leaves_behind_the_last_record_is_cut_off(tmp_path, tail):
    path = tmp_path / "a.journal"
    end = written(path)[-1]
    with open(path, "ab") as file:
        file.write(tail)
    assert same(read(path), RECORDS)
    assert path.stat().st_size == end


def test_a_byte_that_changed_ends_it_there(tmp_path):
    path = tmp_path / "a.journal"
    ends = written(path)
    data = bytearray(path.read_bytes())
    data[ends[0] + 40] ^= 1
    path.write_bytes(data)
    assert same(read(path), RECORDS[:1])


def test_a_journal_of_something_else_is_discarded(tmp_path):
    path = tmp_path / "a.journal"
    written(path)
    assert read(path, "others") == []
    assert read(path) == []


def test_what_is_read_comes_in_order_and_by_kind(tmp_path):
    path = tmp_path / "a.journal"
    with Journal(path, "these") as journal:
        for kind in ("cells", "batches", "curves"):
            journal.write(kind, numbers=np.arange(3))
    with Journal(path, "these") as journal:
        assert journal.next("batches") is None
        assert journal.ahead("curves")
        assert journal.next("cells")
        assert journal.next("curves") is None
        journal.write("curves", numbers=np.arange(2))  # something else than before: what followed is void
        assert journal.next("batches") is None
    with Journal(path, "these") as journal:
        assert len(journal.next("cells")["numbers"]) == 3
        assert len(journal.next("curves")["numbers"]) == 2
        assert not journal.ahead("curves")


def test_where_it_cannot_be_written_that_is_said(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(StrandscopeError, match="a\\.journal: "):
        Journal(tmp_path / "file" / "a.journal", "these")


@pytest.mark.skipif(sys.platform == "win32", reason="there is no limit to set")
def test_a_full_disk_is_said(tmp_path):
    import resource
    import signal

    path = tmp_path / "a.journal"
    end = written(path)[-1]
    limits, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (end + 60, limits[1]))
        with Journal(path, "these") as journal:
            while journal.next("some"):
                pass
            with pytest.raises(StrandscopeError, match="the disk is full"):
                journal.write("some", **RECORDS[0])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert same(read(path), RECORDS)  # the part that found room is no record


# ---- growing ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sweeps():
    truths = [line(), helix(), wave(), line((-0.8, 0, 0.6), (-0.2, 1, 0)), line((0.5, 0, -0.25), (0.05, 1, 0.15))]
    return observe(truths, Seen(clutter=1500, seed=7))


class Cut(Exception):
    pass


def grown(sweeps, path=None, stop=None):
    """The bytes of all curves, and how often progress was told; raises Cut when that is ``stop`` times."""
    count = 0

    def progress(_stage, _done, _total):
        nonlocal count
        if count == stop:
            raise Cut
        count += 1

    index = build_index(sweeps, OPTICS)
    if path is None:
        found = trace(index, GrowParams(), RefineParams(), 1, progress)
    else:
        with Journal(path, "these") as journal:
            found = trace(index, GrowParams(), RefineParams(), 1, progress, journal=journal)
    assert len(found.offsets) > 4
    return b"".join(getattr(found, name).tobytes() for name in ("points_mm", "offsets", "evidence", "stops")), count, found.tried


@pytest.fixture(scope="module")
def alone(sweeps):
    return grown(sweeps)


@pytest.mark.parametrize("every_s", [0.0, journals.EVERY_S])
def test_growing_that_is_cut_short_again_and_again_ends_with_the_same_bytes(sweeps, alone, tmp_path, monkeypatch, every_s):
    monkeypatch.setattr(journals, "EVERY_S", every_s)
    path, told = tmp_path / "a.journal", alone[1]
    for stop in np.random.default_rng(1).choice(told, 12, replace=False):
        with pytest.raises(Cut):
            grown(sweeps, path, stop)
    assert grown(sweeps, path)[0::2] == alone[0::2]
    assert grown(sweeps, path)[0::2] == alone[0::2]  # all of it from the journal


def test_growing_goes_on_from_a_journal_that_is_torn_at_any_record(sweeps, alone, tmp_path, monkeypatch):
    monkeypatch.setattr(journals, "EVERY_S", 0.0)
    path = tmp_path / "a.journal"
    assert grown(sweeps, path)[0::2] == alone[0::2]
    whole = path.read_bytes()
    for cut in np.random.default_rng(2).integers(len(whole), size=8):
        path.write_bytes(whole[:cut])
        assert grown(sweeps, path)[0::2] == alone[0::2]
        assert path.read_bytes()[:cut] == whole[:cut]  # what was found was not found again


# ---- a whole run -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.05, 0.5, 0.9])
def test_a_capture_of_features_keeps_its_folder_and_the_journal_lies_beside_the_output(lock, tmp_path, share):
    capture, whole = lock
    before = sorted(capture.rglob("*"))

    def cut(stage, done, total):
        if stage == "growing" and done >= share * total:
            raise Cut

    for _ in range(2):
        with pytest.raises(Cut):
            reconstruct(capture, tmp_path / "s.npz", CAPTURED_ONLY, progress=cut)
    assert [path.name for path in (tmp_path / "s.work").iterdir()] == ["growing.journal"]
    reconstruct(capture, tmp_path / "s.npz", CAPTURED_ONLY, workers=2)
    assert (tmp_path / "s.npz").read_bytes() == whole
    assert [path.name for path in tmp_path.iterdir()] == ["s.npz"]
    assert sorted(capture.rglob("*")) == before
