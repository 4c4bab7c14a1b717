"""Where hair is, as a reconstruction keeps it, and as it is found again from the capture and the strands alone."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from strandscope.core.cli import run
from strandscope.core.errors import StrandscopeError
from strandscope.core.pipeline import find_volume, preset, reconstruct, volume_path
from strandscope.core.strands import INFILL, load_strands, save_strands
from strandscope.core.volume import load_volume


@pytest.fixture(scope="module")
def kept(lock, tmp_path_factory):
    """The folder of a capture, and the strands of a run with infill."""
    out = tmp_path_factory.mktemp("kept") / "s.npz"
    reconstruct(lock[0], out, preset())
    return lock[0], out


@pytest.fixture
def copied(kept, tmp_path):
    """The same in a folder of the test's own."""
    shutil.copytree(kept[1].parent, tmp_path / "out")
    return kept[0], tmp_path / "out" / "s.npz"


def never(*_args, **_more):
    raise AssertionError


def test_it_is_kept_beside_the_strands_and_never_in_the_capture(kept):
    folder, out = kept
    assert volume_path(out) == out.parent / "s.work" / "volume.npz"
    assert volume_path(out).is_file()
    assert not list(folder.rglob("volume.npz"))
    volume = load_volume(volume_path(out))
    points = load_strands(out).captured.points_mm
    cells = np.floor(volume.grid.to_cells(points)).astype(int)
    within = np.all((cells >= 0) & (cells < volume.grid.shape), axis=1)
    assert within.mean() > 0.9
    assert volume.density[tuple(cells[within].T)].min() > 0.5  # where a hair was found is hair
    assert volume.density.min() == 0
    assert np.abs(volume.vertices_mm).max() <= np.abs([volume.grid.origin_mm, volume.grid.high_mm]).max() + 1e-4


def test_it_is_shown_without_finding_it_again(copied, monkeypatch):
    monkeypatch.setattr("strandscope.core.pipeline.make_volume", never)
    volume = find_volume(copied[0], copied[1])
    assert volume.made_from == load_volume(volume_path(copied[1])).made_from
    find_volume("not needed", copied[1])


def test_found_again_it_is_the_same(copied):
    folder, out = copied
    path = volume_path(out)
    before = path.read_bytes()
    for damage in (path.unlink, lambda: path.write_bytes(before[:999])):
        damage()
        find_volume(folder, out)
        assert path.read_bytes() == before
    strands = load_strands(out)
    save_strands(out, strands.select(strands.kind != INFILL))  # the infill does not tell where hair is
    find_volume("not needed", out)


def test_of_other_curves_or_parameters_it_is_another(copied, monkeypatch):
    folder, out = copied
    strands, before = load_strands(out), load_volume(volume_path(out))
    wide = json.loads(json.dumps(strands.provenance))
    wide["parameters"]["inside"]["about_mm"] = 0.8
    save_strands(out, replace(strands, provenance=wide))
    volume = find_volume(folder, out)
    assert volume.made_from != before.made_from
    assert volume.density.sum() > 1.3 * before.density.sum()
    save_strands(out, replace(strands, points_mm=strands.points_mm + np.float32(0.01)))
    monkeypatch.setattr("strandscope.core.pipeline.make_volume", never)
    with pytest.raises(AssertionError):
        find_volume(folder, out)


def test_without_captured_curves_there_is_nothing_to_tell(copied):
    strands = load_strands(copied[1])
    save_strands(copied[1], replace(strands, kind=np.full_like(strands.kind, INFILL)))
    with pytest.raises(StrandscopeError, match="holds no captured curve"):
        find_volume(*copied)


def test_the_verb_writes_each_format(copied, capfd):
    folder, out = copied
    assert run(["volume", str(folder), str(out), "--progress", "json"]) == 0
    assert json.loads(capfd.readouterr().out.splitlines()[-1]) == {"event": "done", "output": str(volume_path(out))}
    for name, begins in (("a.vdb", b" BDV"), ("a.ply", b"ply\n"), ("a.npz", b"PK")):
        assert run(["volume", str(folder), str(out), "-o", str(out.parent / name)]) == 0
        assert (out.parent / name).read_bytes().startswith(begins)
    assert run(["volume", str(folder), str(out), "-o", str(out.parent / "a.obj")]) == 2
    assert not (out.parent / "a.obj").exists()
