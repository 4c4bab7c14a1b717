"""The extension's operators, as scripts and headless Blender call them."""

import bpy
import pytest

import strandscope
from strandscope.addon import hair

pytestmark = pytest.mark.usefixtures("registered")


@pytest.fixture
def settings():
    return bpy.context.scene.strandscope


def test_registers_again_and_again():
    for _ in range(2):
        strandscope.unregister()
        assert not hasattr(bpy.types.Scene, "strandscope")
        strandscope.register()
    assert hasattr(bpy.types, "STRANDSCOPE_PT_capture")


def test_import_capture_from_its_file(settings, capture):
    assert bpy.ops.strandscope.import_capture(filepath=str(capture.folder / "capture.json")) == {"FINISHED"}
    assert settings.capture_name == "tiny"
    assert settings.capture_facts == "3 sweeps, 6 photographs\n32 × 24 pixels, 1.6 × 1.2 mm"
    assert settings.output_path == str(capture.folder.parent / "capture_results" / "strands.npz")


def test_import_of_no_capture_says_what_was_expected(settings, tmp_path):
    with pytest.raises(RuntimeError, match=r"expected a capture folder"):
        bpy.ops.strandscope.import_capture(filepath=str(tmp_path))
    assert "expected a capture folder" in settings.capture_error
    assert not bpy.ops.strandscope.reconstruct.poll()


def test_a_damaged_photograph_is_told_at_once(settings, capture):
    first = capture.folder / capture.sweeps[0].files[0]
    first.write_bytes(first.read_bytes()[:200])
    settings.capture_path = str(capture.folder)
    assert str(first) in settings.capture_error
    assert not settings.capture_name


def test_import_strands(strands, strands_file):
    assert bpy.ops.strandscope.import_strands(filepath=str(strands_file)) == {"FINISHED"}
    new = bpy.context.object
    assert hair.is_hair(new)
    assert new.select_get()
    assert len(new.data.curves) == len(strands)
    assert new.data.materials[0].name == "Strandscope Hair"
    assert hair.describe(new).startswith("6 captured, 3 infill")


def test_hair_can_be_enlarged_for_cycles(strands_file):
    bpy.ops.strandscope.import_strands(filepath=str(strands_file))
    new = bpy.context.object
    assert hair.is_small_for_cycles(new)
    points = hair.strands_of(new).points_mm
    bpy.ops.strandscope.enlarge()
    bpy.context.view_layer.update()
    assert not hair.is_small_for_cycles(new)
    assert (hair.strands_of(new).points_mm == points).all()  # the data stay in real size


def test_import_of_damaged_strands_is_an_error(tmp_path):
    (tmp_path / "bad.npz").write_bytes(b"PK no zip")
    with pytest.raises(RuntimeError, match=r"bad\.npz"):
        bpy.ops.strandscope.import_strands(filepath=str(tmp_path / "bad.npz"))
    assert not bpy.data.objects


def test_reconstruct_hands_over_what_the_panel_says(settings, capture, tmp_path):
    """The command of the child, without running it."""
    from strandscope.addon.operators.work import STRANDSCOPE_OT_reconstruct

    settings.capture_path = str(capture.folder)
    settings.preset, settings.infill = "wavy", False
    command = STRANDSCOPE_OT_reconstruct.command(None, bpy.context)
    out = tmp_path / "capture_results" / "strands.npz"
    assert command.arguments == ("reconstruct", str(capture.folder), "-o", str(out), "--preset", "wavy", "--memory", "6.0GB", "--no-infill")
    assert command.log == out.with_suffix(".log")


def test_reconstruct_wants_a_name_for_its_output(settings, capture):
    settings.capture_path = str(capture.folder)
    settings.output_path = "strands.txt"
    with pytest.raises(RuntimeError, match=r"ends in \.npz"):
        bpy.ops.strandscope.reconstruct()


def test_compare(settings, capture, strands_file):
    assert not bpy.ops.strandscope.compare.poll()
    settings.capture_path = str(capture.folder)
    bpy.ops.strandscope.import_strands(filepath=str(strands_file))
    settings.angles, settings.size, settings.samples = 1, 16, 1
    assert bpy.ops.strandscope.compare() == {"FINISHED"}
    assert settings.comparison.endswith("turntable.png")
    assert bpy.ops.strandscope.open_comparison() == {"FINISHED"}
    assert bpy.data.images["turntable.png"].size[0] > 16


def test_nothing_starts_while_a_job_runs(settings, capture):
    settings.capture_path = str(capture.folder)
    job = bpy.context.window_manager.strandscope_job
    job.begin("Reconstruction")
    assert not bpy.ops.strandscope.reconstruct.poll()
    bpy.ops.strandscope.cancel()
    assert job.stop
    job.end()
    assert bpy.ops.strandscope.reconstruct.poll()
