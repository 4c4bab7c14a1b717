"""The rig in the panel: a virtual one, moved and photographing by the operators; the real processes, the real serial bytes."""

import json
import os
import signal
import subprocess
import sys
import time

import bpy
import pytest

import strandscope
from strandscope.addon import rig
from strandscope.addon.operators import rig as operators
from strandscope.core.errors import StrandscopeError
from strandscope.core.rig import attach
from strandscope.core.rig.plan import Plan, load_plan, save_plan, turntable_plan

ops = bpy.ops.strandscope


@pytest.fixture(autouse=True)
def scratch(tmp_path, monkeypatch):
    (tmp_path / "scratch").mkdir()
    monkeypatch.setattr(rig, "scratch", lambda: tmp_path / "scratch")


@pytest.fixture
def settings(registered):  # noqa: ARG001
    scene = bpy.context.scene.strandscope_rig
    scene.kind = "VIRTUAL"
    yield scene
    if rig.desk.run and attach.runs(rig.desk.run.folder):
        ops.rig_order(what="abort")


def tick_until(done, seconds=60.0):
    """Let the timer run by hand: there is none without a window."""
    end = time.monotonic() + seconds
    operators.catch_up()
    while not done():
        assert time.monotonic() < end, (rig.desk, rig.desk.run and rig.desk.run.told)
        time.sleep(0.02)
        operators.catch_up()


def quick(settings, angles=3):
    """A plan of the virtual rig that takes seconds."""
    settings.angles, settings.far_mm, settings.near_mm, settings.speed = angles, -0.4, 0.4, 40


def test_by_hand(settings):
    assert not ops.rig_home.poll()
    assert ops.rig_connect() == {"FINISHED"}
    assert (settings.angles, round(settings.near_mm, 3)) == (16, 1.8)  # the plan of the rig
    assert not ops.rig_connect.poll()
    assert not ops.rig_go.poll()  # nobody knows where it stands
    with pytest.raises(RuntimeError, match=r"alarm|lock|poll"):
        ops.rig_jog(axis="FOCUS", way=-1)
    assert ops.rig_home() == {"FINISHED"}
    assert rig.desk.hand.known
    ops.rig_go(to="AXIS")
    assert rig.desk.hand.place.position_mm == pytest.approx(0, abs=0.01)
    settings.jog_mm, settings.turn_deg = "5", "15"
    before = rig.desk.hand.place
    ops.rig_jog(axis="FOCUS", way=-1)
    ops.rig_jog(axis="TURN", way=-1)
    there = rig.desk.hand.place
    assert (there.angle_deg - before.angle_deg, there.position_mm - before.position_mm) == pytest.approx((-15, -5), abs=0.01)
    ops.rig_mark(side="FAR")
    assert settings.far_mm == pytest.approx(-5, abs=0.01)
    tick_until(lambda: rig.desk.hand.can_see)
    ops.rig_live()
    picture = rig.desk.hand.picture
    assert picture.is_file()
    assert 0 < rig.desk.hand.sharpness <= rig.desk.hand.best
    assert operators.picture() == picture
    assert ops.rig_picture() == {"FINISHED"}
    assert bpy.data.images[picture.name].size[0] > 16
    ops.rig_live()
    assert not rig.desk.hand.live
    ops.rig_disconnect()
    assert rig.desk.hand is None
    assert not ops.rig_disconnect.poll()


def test_stop_halts_what_goes_on(settings):
    ops.rig_connect()
    ops.rig_home()
    rig.desk.hand.say("go 0 0")
    tick_until(lambda: rig.desk.hand.state == "moving")
    assert not ops.rig_jog.poll()
    assert ops.rig_stop() == {"FINISHED"}
    assert "stopped" in rig.desk.hand.answers[-2]
    assert rig.desk.hand.known
    assert rig.desk.hand.place.angle_deg > 1
    settings.jog_mm = "20"
    ops.rig_go(to="AXIS")
    ops.rig_jog(axis="FOCUS", way=1)
    ops.rig_jog(axis="FOCUS", way=1)
    with pytest.raises(RuntimeError, match="leave the travel"):
        ops.rig_jog(axis="FOCUS", way=1)


def test_a_capture_from_plan_to_strands(settings, tmp_path):
    """All buttons of a run; Blender forgets it in between, and finds it again."""
    ops.rig_connect()
    quick(settings, angles=4)
    assert not ops.rig_start.poll()  # no folder
    settings.folder, settings.name = str(tmp_path / "lock"), "a lock"
    photographs, _, size = rig.cost(operators.plan_of(bpy.context))
    assert photographs == "20 photographs and 4 checks"
    assert size > 24 * 100_000
    assert ops.rig_start() == {"FINISHED"}
    assert rig.desk.hand is None  # the capture has the rig
    assert not ops.rig_connect.poll()
    tick_until(lambda: rig.desk.run.told.get("done", 0) >= 3)
    ops.rig_order(what="pause")
    assert rig.desk.run.state == "paused"
    done = rig.desk.run.told["done"]

    strandscope.unregister()  # Blender ends; the capture does not
    assert attach.runs(tmp_path / "lock")
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    strandscope.register()
    again = bpy.context.scene.strandscope_rig
    assert rig.desk.run is None
    tick_until(lambda: rig.desk.run is not None)
    assert (rig.desk.run.state, rig.desk.run.told["done"]) == ("paused", done)
    assert again.folder == str(tmp_path / "lock")
    again.sweep = 0
    ops.rig_repeat()
    ops.rig_order(what="resume")
    tick_until(lambda: not rig.desk.running)
    assert rig.desk.run.state == "done", (rig.desk.run.message, attach.last_words(tmp_path / "lock"))
    assert rig.desk.run.picture.is_file()
    assert again.begun == "24 of 24 photographs are there"
    assert not ops.rig_start.poll()
    assert bpy.context.scene.strandscope.capture_facts.startswith("4 sweeps, 20 photographs")  # ready to be reconstructed
    assert len(list((tmp_path / "lock" / "rig" / "aside").iterdir())) >= 1  # the sweep that was repeated
    ops.rig_dismiss()
    assert rig.desk.run is None


def test_a_capture_that_was_ended_or_killed_is_gone_on_with(settings, tmp_path):
    ops.rig_connect()
    quick(settings)
    settings.folder = str(tmp_path / "lock")
    ops.rig_start()
    tick_until(lambda: rig.desk.run.told.get("done", 0) >= 2)
    ops.rig_order(what="abort")
    tick_until(lambda: not rig.desk.running)
    assert rig.desk.run.state == "stopped"
    assert settings.begun
    assert ops.rig_start() == {"FINISHED"}  # without connecting: the folder knows all
    done = rig.desk.run.told["done"]
    tick_until(lambda: rig.desk.run.told["done"] > done)
    os.killpg(rig.desk.run.process.pid, signal.SIGKILL)
    tick_until(lambda: not rig.desk.running)
    assert "goes on" in rig.desk.run.message
    settings.speed = 100
    ops.rig_start()
    tick_until(lambda: not rig.desk.running)
    assert rig.desk.run.state == "done"


def test_what_keeps_a_capture_from_starting_is_told(settings, tmp_path):
    save_plan(tmp_path / "rig.toml", Plan(count=2), stage={"url": str(tmp_path / "no_port")}, camera={"kind": "cable", "folder": str(tmp_path)})
    settings.kind, settings.file = "FILE", str(tmp_path / "rig.toml")
    assert settings.file_error == ""
    with pytest.raises(RuntimeError, match="no_port: cannot be opened"):
        ops.rig_connect()
    assert "cannot be opened" in rig.desk.error
    settings.folder = str(tmp_path / "hair")
    assert not ops.rig_start.poll()
    rig.start(tmp_path / "hair", [str(tmp_path / "rig.toml")])
    with pytest.raises(StrandscopeError, match="cannot be opened"):
        operators.hear_of_start()


def test_a_rig_file_fills_the_plan(settings, tmp_path):
    save_plan(tmp_path / "rig.toml", Plan(angles_deg=(0.0, 45.0, 200.0), first_mm=-3, count=31, iso=200))
    settings.kind, settings.file = "FILE", str(tmp_path / "rig.toml")
    assert (settings.angles, settings.iso) == (3, 200)
    assert (settings.far_mm, settings.near_mm) == pytest.approx((-3, 3))
    (tmp_path / "rig.toml").write_text("[plan]\nangles = 0\n")
    settings.file = settings.file
    assert "plan.angles is 0" in settings.file_error
    assert not ops.rig_connect.poll()


def test_what_is_asked_of_a_run_is_what_the_fields_say(tmp_path):
    base = Plan(angles_deg=(0.0, 45.0, 200.0), first_mm=-3, count=31)
    assert rig.with_fields(base, 3, -3, 3, 0.2) == base
    other = rig.with_fields(base, 4, -1, 2, 0.1, iso=400)
    assert (other.angles_deg, other.count, other.last_mm, other.iso) == ((0.0, 90.0, 180.0, 270.0), 31, 2.0, 400)
    assert rig.with_fields(turntable_plan(), 360, 0, 0, 0.2).count == 1
    with pytest.raises(StrandscopeError, match="near above far"):
        rig.with_fields(base, 3, 1, -1, 0.2)
    save_plan(tmp_path / "rig.toml", base, stage={"focus_origin": -4.0}, camera={"kind": "usb"}, optics={"pitch_mm": 0.03})
    text = rig.write_asked(tmp_path / "hair", other, tmp_path / "rig.toml", "COM7", "a lock").read_text()
    assert load_plan(tmp_path / "hair" / rig.ASKED) == other
    assert all(part in text for part in ('url = "COM7"', "focus_origin = -4.0", 'name = "a lock"', "pitch_mm = 0.03"))


@pytest.mark.usefixtures("settings")
def test_ports_are_listed():
    assert ops.rig_ports() == {"FINISHED"}
    assert all(len(port) == 2 for port in rig.desk.ports)


@pytest.mark.usefixtures("settings")
def test_a_rig_that_crashes_is_told_and_can_be_connected_again():
    ops.rig_connect()
    rig.desk.hand._process.kill()
    tick_until(lambda: rig.desk.hand is None)
    assert "ended unexpectedly" in rig.desk.error
    ops.rig_connect()
    assert rig.desk.error == ""


def test_a_run_is_looked_on_at_from_its_events(tmp_path):
    """Warnings of a run that begins anew are its own; a half-written line waits."""
    events = tmp_path / attach.EVENTS
    events.parent.mkdir()
    events.write_text('{"event": "warning", "message": "old"}\n{"event": "capture", "state": "exposing", "done": 3, "to')
    run = rig.Run(tmp_path)
    run.poll()
    assert (run.warnings, run.told) == (["old"], {})
    events.write_text(
        '{"event": "note", "n": 1}\n' + json.dumps({"event": "capture", "state": "waiting", "done": 4, "total": 9, "message": "no cable"}) + "\n"
    )
    run.poll()
    assert (run.warnings, run.told["done"]) == ([], 4)
    assert not run.running
    assert "in the middle" in run.message


def test_blender_loads_nothing_heavy_for_it():
    program = "import bpy, sys, strandscope; strandscope.register(); print([n for n in ('scipy', 'numba', 'serial', 'gphoto2') if n in sys.modules])"
    job = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert job.stdout.splitlines()[-1] == "[]"
