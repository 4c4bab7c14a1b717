"""Bad input through the command line: a non-zero exit, one line with file, place and what was expected, nothing half-written."""

import json
import os
import subprocess
import sys
from contextlib import suppress

import numpy as np
import pytest

from strandscope.core.cli import run
from strandscope.core.raw import write_dng
from strandscope.core.strands import Strands, offsets_of, save_strands

from .conftest import BLACK, WHITE

PHOTOGRAPH = "sweep_002/img_0003.dng"


def edit(capture, change):
    head = json.loads((capture / "capture.json").read_text())
    change(head)
    (capture / "capture.json").write_text(json.dumps(head))


def cut_short(capture):
    path = capture / PHOTOGRAPH
    path.write_bytes(path.read_bytes()[:-2000])
    return PHOTOGRAPH, "cut short"


def missing(capture):
    (capture / PHOTOGRAPH).unlink()
    return "capture.json: the sweep at 180° lists 5 files, 4 are there", PHOTOGRAPH


def other_size(capture):
    for i in range(5):
        write_dng(capture / f"sweep_002/img_{i:04d}.dng", np.full((80, 100), 900, np.uint16), BLACK, WHITE)
    return "sweep_002/img_000", "expected"


def wrong_field(capture):
    edit(capture, lambda head: head["optics"].update(pitch_mm="wide"))
    return "capture.json: optics.pitch_mm is wide", "expected a number"


def missing_field(capture):
    edit(capture, lambda head: head["sweeps"][1].pop("angle_deg"))
    return "capture.json: sweeps[1].angle_deg is missing", "expected"


def empty_folder(capture):
    for path in sorted(capture.rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()
    return "capture.json: not found", "expected a capture folder"


def upwards(capture):
    edit(capture, lambda head: head["sweeps"][0]["files"].__setitem__(4, "../capture/sweep_000/img_0004.dng"))
    return "capture.json: sweeps[0].files[4] is ../capture", "expected a path inside"


def no_json(capture):
    (capture / "capture.json").write_text('{"format": ')
    return "capture.json: not valid JSON", ""


SPOILS = [cut_short, missing, other_size, wrong_field, missing_field, empty_folder, upwards, no_json]


def state(folder):
    return {p.relative_to(folder): (p.read_bytes() if p.is_file() else None) for p in folder.rglob("*")}


def one_line(capsys):
    err = capsys.readouterr().err
    assert len(err.splitlines()) == 1, err
    assert err.startswith("strandscope: ")
    return err


@pytest.mark.parametrize(("spoil", "workers"), [*((spoil, "1") for spoil in SPOILS), (cut_short, "2"), (other_size, "2")])
def test_reconstruct_says_what_is_wrong_with_a_capture(noise_capture, tmp_path, capsys, spoil, workers):
    said = spoil(noise_capture)
    before = state(noise_capture)
    out = tmp_path / "out/strands.npz"
    # the paper's method estimates nothing beforehand, so that damage is met by the workers
    argv = ["reconstruct", noise_capture, "-o", out, "--method", "paper", "--no-infill", "--workers", workers, "--progress", "none"]
    assert run([str(a) for a in argv]) == 1
    err = one_line(capsys)
    for part in said:
        assert part in err
    assert not out.exists()
    assert not list(tmp_path.rglob("*.part*"))
    assert state(noise_capture) == before


@pytest.fixture
def strands_file(tmp_path):
    points = np.stack([np.zeros(9), np.linspace(-0.5, 0.5, 9), np.zeros(9)], axis=1).astype(np.float32)
    ones = np.ones(9, np.float32)
    save_strands(tmp_path / "good.npz", Strands(points, offsets_of([9]), 0.04 * ones, np.zeros(1, np.uint8), ones))
    return tmp_path / "good.npz"


@pytest.mark.parametrize("spoil", [s for s in SPOILS if s not in (cut_short, other_size)])
def test_overlay_says_what_is_wrong_with_a_capture(noise_capture, tmp_path, capsys, spoil, strands_file):
    said = spoil(noise_capture)
    assert run(["overlay", str(noise_capture), str(strands_file), "-o", str(tmp_path / "o.png"), "--progress", "none"]) == 1
    err = one_line(capsys)
    for part in said:
        assert part in err
    assert not list(tmp_path.glob("*.p*g*"))


def test_overlay_names_a_photograph_that_is_cut_short(noise_capture, tmp_path, capsys, strands_file):
    cut_short(noise_capture)
    argv = ["overlay", noise_capture, strands_file, "-o", tmp_path / "o.png", "--sweep", "2", "--position", "0.2", "--progress", "none"]
    assert run([str(a) for a in argv]) == 1
    err = one_line(capsys)
    assert PHOTOGRAPH in err
    assert "cut short" in err
    assert not list(tmp_path.glob("*.p*"))


@pytest.mark.parametrize("verb", ["stats", "score", "overlay"])
@pytest.mark.parametrize("spoil", ["nan", "cut", "text", "none"])
def test_a_bad_strands_file_is_named(noise_capture, tmp_path, capsys, verb, spoil, strands_file):
    bad = tmp_path / "bad.npz"
    if spoil == "nan":
        arrays = dict(np.load(strands_file))
        arrays["points"][3, 1] = np.nan
        np.savez(bad, **arrays)
    elif spoil == "cut":
        bad.write_bytes(strands_file.read_bytes()[:200])
    elif spoil == "text":
        bad.write_text("no strands")
    argv = {
        "stats": ["stats", bad, "--json", tmp_path / "out.json"],
        "score": ["score", bad, tmp_path / "truth.npz", "--json", tmp_path / "out.json"],
        "overlay": ["overlay", noise_capture, bad, "-o", tmp_path / "out.png"],
    }[verb]
    assert run([str(a) for a in argv]) == 1
    err = one_line(capsys)
    said = {"nan": "points[3, 1] is nan; expected finite", "cut": "not a complete .npz", "text": "not a complete .npz", "none": "not found"}
    assert f"bad.npz: {said[spoil]}" in err
    assert not list(tmp_path.glob("*out*"))


def test_import_of_an_empty_folder(tmp_path, capsys):
    (tmp_path / "photos").mkdir()
    assert run(["import", str(tmp_path / "photos"), "-o", str(tmp_path / "lock"), "--step-mm", "0.2"]) == 1
    assert "no photographs found there; expected" in one_line(capsys)
    assert not (tmp_path / "lock").exists()


# ---- a full disk ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def full_disk(tmp_path):
    """A folder on a file system of its own without a free byte. Skips the test where this user may not mount one."""
    folder = tmp_path / "full disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(folder)]
    if os.name != "posix" or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("cannot mount a small disk here")
    try:
        with suppress(OSError), open(folder / "filler", "wb", buffering=0) as filler:
            while filler.write(bytes(512)):
                pass
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def writing_verbs(capture, strands, folder):
    """A command line a verb that writes into a folder."""
    return {
        "import": ["import", capture, "-o", folder / "lock", "--first-mm", "-0.4", "--step-mm", "0.2"],
        "overlay": ["overlay", capture, strands, "-o", folder / "o.png"],
        "stats": ["stats", strands, "--json", folder / "s.json"],
        "reconstruct": ["reconstruct", capture, "-o", folder / "s.npz", "--preset", "straight", "--no-infill", "--workers", "1"],
    }


@pytest.mark.parametrize("verb", ["import", "overlay", "stats", "reconstruct"])
def test_a_full_disk(noise_capture, strands_file, full_disk, capsys, verb):
    argv = writing_verbs(noise_capture, strands_file, full_disk)[verb]
    assert run([*map(str, argv), "--progress", "none"]) == 1
    err = one_line(capsys)
    assert str(full_disk) in err
    assert "the disk is full" in err
    assert [path.name for path in full_disk.rglob("*") if path.is_file()] == ["filler"]


@pytest.mark.parametrize("verb", ["import", "stats"])
def test_a_disk_that_takes_no_more_bytes(noise_capture, strands_file, tmp_path, verb):
    pytest.importorskip("resource")  # a limit on the size of files stands for the disk where none can be mounted
    argv = writing_verbs(noise_capture, strands_file, tmp_path / "out")[verb]
    argv += ["--copy"] if verb == "import" else []
    code = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0)); from strandscope.core.cli import run; sys.exit(run(sys.argv[1:]))"
    )
    result = subprocess.run([sys.executable, "-c", code, *map(str, argv), "--progress", "none"], capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert len(result.stderr.splitlines()) == 1, result.stderr
    assert "the disk is full" in result.stderr
    assert not [path for path in (tmp_path / "out").rglob("*") if path.is_file()]
