"""Blender files and renderings, made without a window."""

import dataclasses
import os
import shutil
import subprocess

import bpy
import numpy as np
import pytest
from PIL import Image

from strandscope.addon import hair, rig_scene, turntable
from strandscope.addon.cli import run_all
from strandscope.core.capture import Turntable
from strandscope.core.errors import StrandscopeError, StrandsError

QUICK = {"angles": 2, "size": 32, "samples": 1}


def test_blend_holds_the_hair_and_nothing_else(tmp_path, strands, strands_file, capture):
    out = turntable.blend(strands_file, tmp_path / "out" / "hair.blend", capture)
    bpy.ops.wm.read_homefile(use_empty=False, use_factory_startup=True)
    bpy.ops.wm.open_mainfile(filepath=str(out))
    assert sorted(o.name for o in bpy.data.objects) == ["Background", "Camera", "Soft light", "Turntable", "a test"]
    assert [scene.name for scene in bpy.data.scenes] == ["Strandscope"]
    assert sorted(m.name for m in bpy.data.materials) == ["Background", "Strandscope Hair"]
    found = bpy.data.objects["a test"]
    np.testing.assert_array_max_ulp(hair.strands_of(found).points_mm, strands.points_mm, maxulp=1)
    assert found.parent == bpy.data.objects["Turntable"]
    scene = bpy.context.scene
    shown_mm = np.array(found.dimensions) * scene.unit_settings.scale_length * 1000
    np.testing.assert_allclose(shown_mm[2], np.ptp(strands.points_mm[:, 1]), rtol=0.2)  # with the hair's radius
    assert scene.camera == bpy.data.objects["Camera"]
    assert (scene.render.resolution_x, scene.render.resolution_y) == (32, 24)
    assert (scene.render.engine, scene.view_settings.view_transform) == ("CYCLES", "Standard")
    assert [path.name for path in out.parent.iterdir()] == ["hair.blend"]  # no part, no backup


def test_blend_has_the_hair_in_view(tmp_path, strands, strands_file):
    bpy.ops.wm.open_mainfile(filepath=str(turntable.blend(strands_file, tmp_path / "hair.blend")))
    space = next(a.spaces.active for a in bpy.data.screens["Layout"].areas if a.type == "VIEW_3D")
    extent = np.linalg.norm(np.ptp(strands.points_mm, axis=0)) * rig_scene.UNITS_PER_MM
    assert extent < space.region_3d.view_distance < 3 * extent
    assert space.clip_start < extent / 10
    assert space.show_region_ui


def test_blend_of_bad_strands_leaves_nothing(tmp_path, strands):
    bad = strands.points_mm.copy()
    bad[3, 1] = np.nan
    np.savez(tmp_path / "bad.npz", points=bad, offsets=strands.offsets)
    with pytest.raises(StrandsError, match="points"):
        turntable.blend(tmp_path / "bad.npz", tmp_path / "out" / "hair.blend")
    assert not (tmp_path / "out").exists()


@pytest.fixture
def small_disk(tmp_path):
    """A function that gives a folder on a file system with so many bytes free. Skips the test where this user may not mount one."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=400k", "tmpfs", str(disk)]
    if os.name != "posix" or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("cannot mount a small disk here")

    def with_free(count):
        (disk / "filler").write_bytes(bytes(shutil.disk_usage(disk).free - count // 4096 * 4096))
        return disk

    yield with_free
    subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.parametrize("free", [0, 8192, 300_000])
def test_blend_on_a_full_disk_leaves_nothing(small_disk, strands_file, free):
    disk = small_disk(free)
    with pytest.raises(StrandscopeError, match=r"hair\.blend: the disk is full"):
        turntable.blend(strands_file, disk / "hair.blend")
    assert [path.name for path in disk.iterdir()] == ["filler"]


def test_frames_on_a_full_disk_are_not_torn(small_disk, strands, capture):
    disk = small_disk(16_384)
    with pytest.raises(StrandscopeError, match=r"render_000\.exr: the disk is full"):
        turntable.render_turntable(capture, strands, disk / "t.png", **QUICK)
    assert sorted(path.name for path in disk.rglob("*")) == ["filler", "frames.json", "t_frames"]


def test_blend_wants_a_blend(tmp_path, strands_file):
    with pytest.raises(StrandscopeError, match=r"\.blend"):
        turntable.blend(strands_file, tmp_path / "hair.obj")


def test_shots_of_sweeps_are_focused_on_the_axis(capture):
    chosen = turntable.shots(capture, 3)
    assert [shot.angle_deg for shot in chosen] == [0.0, 90.0, 215.0]
    assert {shot.focus_mm for shot in chosen} == {0.1}
    assert {shot.cone_deg for shot in chosen} == {10.0}
    assert len(turntable.shots(capture, 9)) == 3


def test_shots_prefer_the_turntable_sequence(capture):
    files = tuple(f"turntable/{i}.dng" for i in range(8))
    table = Turntable(16.0, files, tuple(45.0 * i for i in range(8)), 0.5)
    chosen = turntable.shots(dataclasses.replace(capture, turntable=table), 4)
    assert [shot.angle_deg for shot in chosen] == [0, 90, 180, 270]
    assert {shot.focus_mm for shot in chosen} == {0.5}
    assert {round(shot.cone_deg, 2) for shot in chosen} == {1.75}  # f/16 in place of the f/2.8 that has 10 degrees


def test_turntable_picture_and_frames(tmp_path, capture, strands):
    heard = []
    picture = turntable.render_turntable(capture, strands, tmp_path / "out", **QUICK, progress=lambda *event: heard.append(event))
    assert picture == tmp_path / "out" / "turntable.png"
    assert sorted(path.name for path in picture.parent.glob("*.png")) == ["render_000.png", "render_001.png", "turntable.png"]
    with Image.open(picture) as both, Image.open(tmp_path / "out" / "render_000.png") as one:
        assert both.width > 2 * 32
        frame = np.asarray(one).astype(int)
    assert frame.shape == (24, 32, 3)
    assert (frame[:, 0, 2] > frame[:, 0, 0]).all()  # the photograph's blue is behind the hair
    assert heard[-1][1:] == (2, 2)
    assert [done for _, done, _ in heard] == sorted(done for _, done, _ in heard)


def test_turntable_leaves_the_open_file_alone(tmp_path, capture, strands):
    kept = hair.add_hair(strands, "mine")
    before = {name: len(getattr(bpy.data, name)) for name in turntable._KINDS}
    turntable.render_turntable(capture, strands, tmp_path / "picture.png", **QUICK)
    assert {name: len(getattr(bpy.data, name)) for name in turntable._KINDS} == before
    assert kept.name == "mine"


def test_turntable_keeps_its_frames_and_goes_on(tmp_path, capture, strands):
    turntable.render_turntable(capture, strands, tmp_path / "a.png", **QUICK)
    first, second = (tmp_path / "a_frames" / f"render_00{i}.exr" for i in range(2))
    content = second.read_bytes()
    stamp = first.stat().st_mtime_ns
    second.unlink()
    turntable.render_turntable(capture, strands, tmp_path / "a.png", **QUICK)
    assert first.stat().st_mtime_ns == stamp
    assert len(second.read_bytes()) == len(content)
    turntable.render_turntable(capture, strands, tmp_path / "a.png", **(QUICK | {"samples": 2}))
    assert first.stat().st_mtime_ns != stamp  # of other settings


def test_parts_of_the_frames_come_to_the_same_as_all_at_once(tmp_path, capture, strands):
    together, apart = tmp_path / "together", tmp_path / "apart"
    whole = turntable.render_turntable(capture, strands, together, **QUICK)
    for part in ((1, 2), (2, 2)):
        assert turntable.render_turntable(capture, strands, apart, **QUICK, part=part) == apart
    assert sorted(path.name for path in apart.glob("*.exr")) == ["render_000.exr", "render_001.exr"]
    assert not (apart / "turntable.png").exists()
    kept = [path.stat().st_mtime_ns for path in sorted(apart.glob("*.exr"))]
    picture = turntable.render_turntable(capture, strands, apart, **QUICK)
    assert [path.stat().st_mtime_ns for path in sorted(apart.glob("*.exr"))] == kept
    with Image.open(picture) as found, Image.open(whole) as wanted:
        assert found.size == wanted.size
        np.testing.assert_allclose(np.asarray(found, float), np.asarray(wanted, float), atol=2)


def test_more_parts_than_frames_leave_some_nothing_to_do(tmp_path, capture, strands):
    turntable.render_turntable(capture, strands, tmp_path, **QUICK, part=(3, 3))
    assert not list(tmp_path.glob("*.exr"))


@pytest.mark.parametrize("part", ["0/2", "3/2", "1", "a/b"])
def test_a_part_that_is_none_is_told(part, capsys):
    assert run_all(["turntable", "lock", "strands.npz", "out", "--part", part]) == 2
    assert "expected I/N, as in 2/4" in capsys.readouterr().err


def test_turntable_can_be_stopped(tmp_path, capture, strands):
    def stop(_stage, done, _total):
        if done >= 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        turntable.render_turntable(capture, strands, tmp_path / "a.png", **QUICK, progress=stop)
    assert sorted(path.name for path in (tmp_path / "a_frames").iterdir()) == ["frames.json", "render_000.exr"]
    assert not bpy.app.handlers.render_stats
    assert not (tmp_path / "a.png").exists()
