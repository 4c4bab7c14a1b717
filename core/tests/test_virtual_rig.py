"""A virtual capture from plan to strands: the driver and the session of a real rig, down to the bytes on the serial line."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from skimage.io import imread

from strandscope.core.capture import load_capture
from strandscope.core.cli import run as strandscope
from strandscope.core.errors import StrandscopeError
from strandscope.core.raw import read_header, read_planes
from strandscope.core.rig import attach, logbook, operate, session
from strandscope.core.rig.camera import CableConfig, CameraSettings, cable_camera, settings_of
from strandscope.core.rig.controller import ControllerConfig, stage_config, start_controller
from strandscope.core.rig.operate import CameraConfig, Rig, load_rig, save_rig
from strandscope.core.rig.plan import Place, Plan, turntable_plan
from strandscope.core.rig.session import SessionParams, Setup
from strandscope.core.rig.wiring import StageConfig
from strandscope.core.rig_faults import FaultParams, Tether
from strandscope.core.simulate import Scale, SimulateParams, simulate
from strandscope.core.virtual_rig import (
    VirtualCamera,
    VirtualParams,
    hair_in,
    photographer,
    read_stamp,
    virtual_capture,
    virtual_plan,
    virtual_studio,
)

HAIR = SimulateParams(scale=Scale(60, 50, 3, 0.4, 6, 0.6, 2), seed=3)
FAST = VirtualParams(HAIR, speed=60.0)


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    folder = tmp_path_factory.mktemp("virtual")
    events = []
    assert virtual_capture(folder, FAST, events=events.append) == folder / "capture.json"
    return folder, events


def test_the_photographs_are_those_of_the_simulation_but_for_noise(taken, tmp_path):
    """As ``simulate`` takes them: the same places, the same hair, the same light."""
    folder, _ = taken
    expected, found = simulate(tmp_path / "simulated", HAIR), load_capture(folder)
    assert [s.angle_deg for s in found.sweeps] == [s.angle_deg for s in expected.sweeps]
    assert found.optics == expected.optics
    for ours, theirs in zip(found.sweeps, expected.sweeps, strict=True):
        assert ours.positions_mm == pytest.approx(theirs.positions_mm)
        for a, b in zip(ours.files, theirs.files, strict=True):
            difference = found.planes(a, "RGB") - expected.planes(b, "RGB")
            assert np.sqrt((difference**2).mean()) < 0.03  # noise and grain of two photographs; another place differs by more
    off = found.planes(found.sweeps[0].files[0], "RGB") - expected.planes(expected.sweeps[1].files[0], "RGB")
    assert np.sqrt((off**2).mean()) > 0.06


def test_truth_and_exposure_come_with_them(taken):
    folder, events = taken
    capture = load_capture(folder)
    with np.load(capture.truth_path) as truth:
        assert truth["visibility"].shape[1] == len(capture.sweeps)
    header = read_header(folder / capture.sweeps[0].files[0])
    assert header.shutter_s == pytest.approx(0.125)
    assert header.f_number == pytest.approx(2.8)
    warnings = [e["message"] for e in events if e["event"] == "warning"]
    assert all("let the range go farther" in line for line in warnings)  # of this lock, which is thicker than the range
    assert hair_in(folder) == HAIR
    assert imread(folder / session.LAST).shape == (60, 50, 3)


def test_another_lock_does_not_go_into_the_same_folder(taken):
    folder, _ = taken
    with pytest.raises(StrandscopeError, match="seed 3, not 4"):
        virtual_capture(folder, replace(FAST, hair=replace(HAIR, seed=4)))


def test_a_small_aperture_shows_more_depth():
    take = photographer(virtual_studio(HAIR))
    place = Place(0.0, 6.0)
    opened, stopped = (take(place, CameraSettings(1.0, f, 100), 1, False).astype(float) for f in (2.8, 16.0))
    assert stopped[::2, ::2].std() > 1.3 * opened[::2, ::2].std()


def test_the_live_picture_tells_where_the_focus_is_best(tmp_path):
    """Moved through the hair, the number is highest inside of it."""

    class Moved:
        def __init__(self):
            self.at = iter(np.linspace(-4.0, 4.0, 9))

        def place(self):
            return Place(0.0, float(next(self.at)))

    told = []
    camera = VirtualCamera(photographer(virtual_studio(HAIR)), Moved())
    operate.live(camera, tmp_path / "live.png", told.append, lambda: len(told) == 9)
    assert np.argmax([event["sharpness"] for event in told]) == 4
    assert imread(tmp_path / "live.png").shape == (60, 50)
    with pytest.raises(StrandscopeError, match="own screen"):
        operate.live(cable_camera(None, tmp_path), tmp_path / "live.png", told.append)


def test_a_rig_is_kept_as_it_was_written(tmp_path):
    rig = Rig(Plan(count=7), StageConfig(url="socket://rig:23", turntable_axis="Y"), setup=Setup("switch", axis_col_px=12.0))
    cable = operate.changed(rig, "COM3", tmp_path / "photos", "other")
    for each in (rig, cable):
        save_rig(tmp_path / "rig.toml", each)
        assert load_rig(tmp_path / "rig.toml") == each
    assert cable.camera.folder == str(tmp_path / "photos")
    assert cable.stage.url == "COM3"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[camera]\nkind = "film"', 'camera.kind is \'film\'; expected "usb" or "cable"'),
        ('[camera]\nkind = "cable"', "camera.folder is ''; expected the folder"),
        ("[camera]\nmodel = 3", "camera.model is 3; expected text"),
        ("[camera]\npulse_s = 1", "camera.pulse_s is not a field"),
        ('[optics]\npitch_mm = "wide"', "optics.pitch_mm is 'wide'; expected a number"),
        ("[optics]\nzoom = 1", "optics.zoom is not a field"),
    ],
)
def test_what_is_wrong_in_a_rigs_file_is_named(tmp_path, text, said):
    (tmp_path / "rig.toml").write_text(text)
    with pytest.raises(StrandscopeError) as error:
        load_rig(tmp_path / "rig.toml")
    assert said in str(error.value)


def test_a_rig_with_a_camera_on_a_cable_takes_its_plan_and_its_turntable_sequence(tmp_path):
    """As a person does it: a file, a port, a folder that the photographs appear in; then the same folder with another plan."""
    plan = Plan(angles_deg=(0.0, 45.0), first_mm=-0.2, step_mm=0.2, count=3, settle_s=0.05, shutter_s=0.2, bytes_each=8000)
    table = turntable_plan(4, settle_s=0.05, shutter_s=0.2, bytes_each=8000)
    config, quick = ControllerConfig(time_factor=40.0), CableConfig(pulse_s=0.2, wait_s=2.0, quiet_s=0.02, poll_s=0.005)
    with start_controller(config, "tcp") as controller:
        rig = Rig(plan, stage_config(controller.url, config), CameraConfig("cable", str(tmp_path / "watched"), cable=quick), Setup("switch"))
        tether = Tether(tmp_path, controller, rig.stage, FaultParams(plan=plan, speed=40.0))
        tether.start()
        told = []
        for each in (plan, table):
            tether.camera.settings = settings_of(each)
            done = operate.capture(replace(rig, plan=each), tmp_path / "switch", SessionParams(reserve_bytes=0), events=told.append)
        tether.stop()
        assert not any(controller.moved(*shot) for shot in tether.shots)
    capture = load_capture(done)
    assert capture.name == "switch"
    assert [len(s.files) for s in capture.sweeps] == [3, 3]
    for files, places in (
        *((s.files, [Place(s.angle_deg, d) for d in s.positions_mm]) for s in capture.sweeps),
        (capture.turntable.files, [Place(a, 0.0) for a in table.angles_deg]),
    ):
        for file, place in zip(files, places, strict=True):
            assert read_stamp(tmp_path / "switch" / file).place == pytest.approx(place, abs=0.0011)
    assert any("set on the camera itself" in e.get("message", "") for e in told)
    assert len(tether.shots) == len(plan) + len(table) + 2  # and a test shot a run
    assert load_rig(tmp_path / "switch" / operate.FILE) == replace(rig, plan=table)


def test_the_plan_of_a_virtual_rig_is_that_of_the_simulation():
    plan = virtual_plan(SimulateParams(scale="tiny"))
    assert (len(plan.angles_deg), plan.count, plan.first_mm) == (16, 19, -1.8)


# ---- the command line ------------------------------------------------------------------------------------------------


def test_what_a_plan_costs_is_told_without_a_rig(tmp_path, capsys):
    (tmp_path / "plan.toml").write_text("[plan]\nangles = 12\ncount = 100\n")
    assert strandscope(["capture", str(tmp_path / "plan.toml"), "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert "1212, of which 12 are checks" in said
    assert "45 min" in said


def test_a_folder_without_a_capture_and_one_without_a_run_are_told(tmp_path, capsys):
    assert strandscope(["capture", "--status", str(tmp_path)]) == 1
    assert strandscope(["capture", "--pause", "-o", str(tmp_path)]) == 1
    assert strandscope(["capture", "-o", str(tmp_path / "new")]) == 1
    assert strandscope(["capture"]) == 2
    said = capsys.readouterr().err
    assert "holds no capture of a rig" in said
    assert "no capture is running" in said


def program(*arguments, **how) -> subprocess.Popen:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    command = [sys.executable, "-P", "-m", "strandscope", "capture", *map(str, arguments)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **how)


def until(folder: Path, wanted, child: subprocess.Popen) -> dict:
    """What ``--status`` tells, as soon as it is as wanted."""
    for _ in range(600):
        if (folder / session.LOGBOOK).exists() and wanted(told := attach.status(folder)):
            return told
        assert child.poll() is None, child.communicate()
        time.sleep(0.05)
    raise AssertionError("it never came to that")


@pytest.mark.skipif(os.name != "posix", reason="there, a program cannot be sent Ctrl-C")
def test_ctrl_c_ends_a_capture_after_its_photograph_and_the_same_command_goes_on(tmp_path):
    folder = tmp_path / "lock"
    first = program("--virtual", "-o", folder, "--speed", 10)
    until(folder, lambda told: told["done"] >= 3, first)
    first.send_signal(signal.SIGINT)
    _, said = first.communicate(timeout=30)
    assert first.returncode == 130
    assert "goes on" in said
    before = session.replay(logbook.read((folder / session.LOGBOOK).read_bytes())[0]).safe
    assert len(before) >= 3
    second = program("-o", folder, "--speed", 60, "--progress", "json")
    until(folder, lambda told: told["running"] and told["done"] > len(before), second)
    assert strandscope(["capture", "--pause", str(folder)]) == 0
    done = until(folder, lambda told: told["state"] == "paused", second)["done"]
    assert strandscope(["capture", "--resume", "-o", str(folder)]) == 0
    until(folder, lambda told: told["done"] > done, second)
    assert strandscope(["capture", "--abort", "-o", str(folder)]) == 0
    out, _ = second.communicate(timeout=30)
    assert second.returncode == 130
    events = [json.loads(line) for line in out.splitlines() if line.startswith("{")]
    assert {"progress", "capture", "note"} <= {event["event"] for event in events}
    assert [e["state"] for e in events if e["event"] == "capture"][-1] == "stopped"
    for record in before.values():  # nothing was taken again
        assert session.replay(logbook.read((folder / session.LOGBOOK).read_bytes())[0]).safe[attach.key_of(record)] == record
        assert read_planes(folder / record["file"]).shape == (1, 180, 150)
