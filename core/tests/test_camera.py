"""Cameras: choices of settings, libgphoto2's own virtual camera, and a watched folder in which everything comes wrong."""

import builtins
import importlib.util
import itertools
import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from strandscope.core.errors import StrandscopeError
from strandscope.core.raw import write_dng
from strandscope.core.rig import camera
from strandscope.core.rig.camera import CableConfig, CameraError, CameraGone, CameraSettings, PhotographLate, cable_camera
from strandscope.core.rig.plan import Exposure

SETTINGS = CameraSettings(0.01, 2.8, 100)
FAST = CableConfig(pulse_s=0.0, wait_s=0.4, late_s=0.3, quiet_s=0.05, poll_s=0.005)


# ---- settings by the names that a body offers ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("choices", "asked", "read", "chosen"),
    [
        (["f/2.8", "f/3.5", "f/4"], 2.8, camera.read_f_number, "f/2.8"),
        (["2.8", "3.2", "4"], 3.4, camera.read_f_number, "3.2"),
        (["F 5,6", "F 8,0"], 8.0, camera.read_f_number, "F 8,0"),
        (["bulb", "30", "1/60", "1/50", "1/4"], 0.25, camera.read_shutter_s, "1/4"),
        (["0.0100s", "0.0050s", "Bulb"], 1 / 160, camera.read_shutter_s, "0.0050s"),
        (['1.3"', "1/2", "10/13"], 0.77, camera.read_shutter_s, "10/13"),
        (["Auto", "100", "200"], 160.0, camera.read_iso, "200"),
    ],
)
def test_the_nearest_choice_is_taken(choices, asked, read, chosen):
    assert camera.nearest_choice(choices, asked, read)[0] == chosen


def test_stops_are_counted_alike_for_all_settings():
    assert camera.nearest_choice(["f/4"], 2.0, camera.read_f_number)[1] == pytest.approx(2.0)
    assert camera.nearest_choice(["1/50"], 1 / 200, camera.read_shutter_s)[1] == pytest.approx(2.0)
    assert camera.nearest_choice(["Auto"], 100, camera.read_iso) == (None, np.inf)


@pytest.mark.parametrize(
    ("choices", "chosen"),
    [
        (["Large Fine JPEG", "RAW + Large Fine JPEG", "mRAW", "cRAW", "RAW"], "RAW"),
        (["JPEG Basic", "NEF (Raw)", "NEF+Fine"], "NEF (Raw)"),
        (["RAW+JPEG", "JPEG"], "RAW+JPEG"),
        (["JPEG Fine"], None),
    ],
)
def test_raw_files_alone_are_preferred(choices, chosen):
    assert camera.raw_choice(choices) == chosen


# ---- libgphoto2 ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("call", [camera.gphoto_camera, camera.find_cameras])
def test_without_libgphoto2_it_is_said_how_to_get_it(call, monkeypatch):
    real = builtins.__import__

    def without(name, *arguments, **fields):
        if name == "gphoto2":
            raise ImportError(name)
        return real(name, *arguments, **fields)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(StrandscopeError, match=r"strandscope\[camera\]" if sys.platform != "win32" else "watched folder"):
        call()


GPHOTO = """
import json, os, sys
from pathlib import Path
folder = Path(sys.argv[1])
os.environ["VCAMERADIR"] = str(folder / "card")
from strandscope.core.raw import read_planes
from strandscope.core.rig import camera, session
from strandscope.core.rig.plan import Place, Plan
from strandscope.core.virtual_rig import read_stamp

card = folder / "card" / "a.jpg"
says = {"found": camera.find_cameras(), "told": []}
body = camera.gphoto_camera(tell=says["told"].append)
says["prepared"] = body.prepare(camera.CameraSettings(0.01, 3.4, 100))
config = body._offered()
says["set"] = [camera._value(config, names) for names in (camera.APERTURE, camera.SHUTTER, camera.TARGET)]
says["check"] = body.check()
try:
    body.prepare(camera.CameraSettings(0.01, 90.0, 100))
except camera.CameraError as error:
    says["refused"] = str(error)
try:
    body.preview()
except camera.CameraError as error:
    says["preview"] = str(error)


class Stage:
    at = Place(0.0, 0.0)

    def home(self):
        return self.at

    def position(self):
        return self.at

    def move_to(self, angle_deg, position_mm, **_approach):
        self.at = Place(angle_deg, position_mm)
        number = round(angle_deg / 90) * 4 + round(position_mm / 0.2)
        card.write_bytes((folder / "shots" / f"{number}.dng").read_bytes())  # what it serves next
        return self.at


plan = Plan(angles_deg=(0.0, 90.0), first_mm=0.0, step_mm=0.2, count=4, settle_s=0.0, shutter_s=0.01, check_shots=False, bytes_each=9000)
deleted = []
real = camera.GphotoCamera.safe
camera.GphotoCamera.safe = lambda self, captured: (deleted.append(captured.name), real(self, captured))
session.run(plan, Stage(), body, folder / "capture", params=session.SessionParams(reserve_bytes=0))
says["deleted"] = deleted
says["left"] = [body._camera.folder_list_files(p).count() for p in ("/store_00010001/DCIM/100GPHOT", "/store_00010001/DCIM/101GPHOT")]
body.close()
try:
    camera.gphoto_camera(camera.GphotoConfig(model="Leica")).prepare(camera.CameraSettings(0.01, 2.8, 100))
except camera.CameraGone as error:
    says["other"] = str(error)
print(json.dumps(says))
"""


@pytest.mark.skipif(importlib.util.find_spec("gphoto2") is None, reason="libgphoto2's binding is not here")
def test_libgphoto2s_virtual_camera_is_set_photographs_a_plan_and_empties_its_card(tmp_path):
    (tmp_path / "card").mkdir()
    (tmp_path / "shots").mkdir()
    rng = np.random.default_rng(4)
    for number in range(8):
        write_dng(tmp_path / "shots" / f"{number}.dng", rng.integers(600, 9000, (48, 64), np.uint16), 512, 15871)
    (tmp_path / "card" / "a.jpg").write_bytes((tmp_path / "shots" / "0.dng").read_bytes())
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    done = subprocess.run([sys.executable, "-P", "-c", GPHOTO, str(tmp_path)], capture_output=True, text=True, env=environment, timeout=120)
    assert done.returncode == 0, done.stderr
    says = json.loads(done.stdout.splitlines()[-1])
    assert says["found"] == [["Nikon DSC D750", "usb:001,001"]]
    assert says["set"] == ["f/3.5", "0.0100s", "Memory card"]
    assert any("ISO" in line and "set it on the camera itself" in line for line in says["prepared"])
    assert says["check"] == []
    assert "the camera offers f/2.8, f/3.5" in says["refused"]
    assert "cannot do that" in says["preview"]
    assert "no camera 'Leica' was found (found: Nikon DSC D750)" in says["other"]
    for number in range(8):
        name = f"sweep_{number // 4:03d}/img_{number % 4:04d}.jpg"
        assert (tmp_path / "capture" / name).read_bytes() == (tmp_path / "shots" / f"{number}.dng").read_bytes()
    assert len(says["deleted"]) == 8
    assert sum(says["left"]) <= 1  # what the card came with
    assert not says["told"]


# ---- a shutter cable and a watched folder ----------------------------------------------------------------------------


class Tether:
    """Tethering software: each shot leaves a file, now or later, as it is told for each shot."""

    def __init__(self, folder: Path):
        self.folder, self.number, self.how, self.timers = folder, 100, {}, []
        self.shots, self.values = 0, {}
        self.now, self.fired = 0, {}  # the exposure that is taken; of which each shot was
        folder.mkdir()

    def output(self, on: bool) -> None:
        """It is off already."""
        assert not on

    def pulse(self, _seconds: float) -> None:
        self.shots += 1
        self.fired[self.shots] = self.now
        self.number += 1
        how = self.how.get(self.shots, {})
        if how.get("lost"):
            return
        name, data = f"DSC_{self.number:04d}.dng", self.photograph(self.shots)
        if how.get("copy"):
            name, data = f"copy of DSC_{self.number - 1:04d}.dng", self.values[self.shots - 1]
        self.values[self.shots] = data
        if how.get("late"):
            self.later(how["late"], self.folder / name, data)
        elif how.get("parts"):
            (self.folder / name).write_bytes(data[: len(data) // 2])
            if how["parts"] > 0:
                self.later(how["parts"], self.folder / name, data)
        else:
            (self.folder / name).write_bytes(data)
        for extra in range(how.get("extra", 0)):
            self.number += 1
            (self.folder / f"DSC_{self.number:04d}.dng").write_bytes(self.photograph(1000 + extra))

    def later(self, seconds: float, path: Path, data: bytes) -> None:
        self.timers.append(threading.Timer(seconds, path.write_bytes, (data,)))
        self.timers[-1].start()

    def photograph(self, shot: int) -> bytes:
        path = self.folder / ".new.dng"
        write_dng(path, np.random.default_rng(shot).integers(600, 4000, (24, 32), np.uint16), 512, 15871)
        data = path.read_bytes()
        path.unlink()
        return data


class Dead:
    """A shutter line that leads nowhere."""

    def pulse(self, _seconds: float) -> None:
        """Nothing happens."""


@pytest.fixture
def tether(tmp_path):
    tether = Tether(tmp_path / "tether")
    yield tether
    for timer in tether.timers:
        timer.join()


def shoot(body, tether, tmp_path, count=4) -> list[int]:
    """Photograph a row of exposures; the numbers of the shots that were kept for each."""
    kept = []
    for frame in range(count):
        for attempt in itertools.count():
            try:
                captured = body.capture(Exposure(frame, 0, frame, 0.0, 0.2 * frame, "sweep"), tmp_path)
                break
            except PhotographLate:
                assert attempt < 4
        data = captured.path.read_bytes()
        kept.append(next(shot for shot, value in tether.values.items() if value == data))
        body.safe(captured)
    return kept


def test_the_first_shot_of_a_run_is_a_test_and_each_other_one_is_kept(tether, tmp_path):
    (tether.folder / "DSC_0001.dng").write_bytes(tether.photograph(0))  # of yesterday
    body = cable_camera(tether, tether.folder, FAST)
    assert "set on the camera itself" in body.prepare(SETTINGS)[0]
    assert shoot(body, tether, tmp_path) == [2, 3, 4, 5]


@pytest.mark.parametrize(
    "how",
    [
        {3: {"lost": True}},
        {3: {"late": 0.2}},  # within the time that is waited
        {3: {"late": 0.6}},  # after it: the shot has been repeated
        {3: {"late": 0.9}},  # when the next exposure is taken
        {3: {"late": 0.5}, 4: {"late": 0.3}},
        {3: {"parts": 0.1}},
        {3: {"parts": -1}},  # stays half a file
        {3: {"copy": True}},
        {3: {"extra": 1}},
        {2: {"lost": True}, 3: {"lost": True}, 5: {"extra": 2}},
    ],
)
def test_whatever_comes_wrong_every_exposure_has_a_photograph_of_its_own_shots(tether, tmp_path, how):
    """A shot is one of the exposure that it was fired for: noted when it is fired."""
    tether.how = how
    body = cable_camera(tether, tether.folder, FAST)
    body.prepare(SETTINGS)
    for frame in range(4):
        tether.now = frame
        for _ in range(5):
            try:
                captured = body.capture(Exposure(frame, 0, frame, 0.0, 0.2 * frame, "sweep"), tmp_path)
                break
            except PhotographLate:
                continue
        else:
            raise AssertionError("no photograph")
        data = captured.path.read_bytes()
        shots = [shot for shot, value in tether.values.items() if value == data]
        assert {tether.fired[shot] for shot in shots} == {frame}


def test_originals_go_only_when_asked_for_and_safe(tether, tmp_path):
    body = cable_camera(tether, tether.folder, FAST)
    body.prepare(SETTINGS)
    shoot(body, tether, tmp_path, 2)
    assert len(list(tether.folder.glob("*.dng"))) == 3
    body = cable_camera(tether, tether.folder, CableConfig(**{**vars(FAST), "delete_originals": True}))
    body.prepare(SETTINGS)
    captured = body.capture(Exposure(0, 0, 0, 0.0, 0.0, "sweep"), tmp_path)
    assert captured.origin.exists()
    body.safe(captured)
    assert not captured.origin.exists()


def test_a_folder_that_is_not_there_and_a_shutter_that_does_not_fire_are_told(tether, tmp_path):
    with pytest.raises(CameraGone, match="start the tethering software"):
        cable_camera(tether, tmp_path / "nowhere", FAST).prepare(SETTINGS)
    body = cable_camera(Dead(), tether.folder, FAST)
    body.prepare(SETTINGS)
    with pytest.raises(CameraError, match="is the shutter cable in"):
        body.capture(Exposure(0, 0, 0, 0.0, 0.0, "sweep"), tmp_path)
