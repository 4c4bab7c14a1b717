"""A rig moved by hand: commands in order, ``stop`` before all, a cable that is pulled; against the simulated controller."""

import queue
import threading
import time
from dataclasses import dataclass, field

import numpy as np
import pytest

from strandscope.core.cli import run as strandscope
from strandscope.core.errors import StrandscopeError
from strandscope.core.rig import desk
from strandscope.core.rig.controller import ControllerConfig, stage_config, start_controller
from strandscope.core.rig.plan import Plan
from strandscope.core.rig.stage import Stage

CONFIG = ControllerConfig(time_factor=20)


class Eye:
    """A camera that sees noise."""

    def prepare(self, _settings):
        return ["ready"]

    def check(self):
        return ["its battery is low"]

    def preview(self):
        return np.random.default_rng(0).random((20, 30), np.float32)

    def close(self):
        """Nothing is held."""


@dataclass
class Attended:
    """A desk at work in a thread."""

    controller: object
    commands: queue.Queue = field(default_factory=queue.Queue)
    told: list = field(default_factory=list)

    def say(self, line: str) -> None:
        self.commands.put(line)

    def until(self, wanted, seconds: float = 20.0) -> dict:
        """The first event that is as wanted, whenever it was told."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            found = next((event for event in list(self.told) if wanted(event)), None)
            if found:
                return found
            time.sleep(0.01)
        pytest.fail(f"not told: {self.told[-5:]}")

    def answer(self, line: str) -> str | None:
        """What came of a command."""
        return self.until(lambda e: e["event"] == "answer" and e["to"] == line)["error"]


@pytest.fixture
def attended(tmp_path):
    with start_controller(CONFIG) as controller, Stage.open(stage_config(controller.url, CONFIG)) as stage:
        at = Attended(controller)
        work = (stage, Eye, Plan(count=3), iter(at.commands.get, "end"), tmp_path / "live.png", at.told.append)
        thread = threading.Thread(target=desk.attend, args=work)
        thread.start()
        yield at
        at.say("end")
        thread.join(20)
        assert not thread.is_alive()


def state(name: str):
    return lambda event: event["event"] == "rig" and event["state"] == name


def test_commands_are_done_in_order(attended, tmp_path):
    for line in ("jog 1", "home", "go 10 2", "turn -3", "jog -0.5", "fly", "jog far", "jog 500"):
        attended.say(line)
    assert "alarm" in attended.answer("jog 1") or "locked" in attended.answer("jog 1")
    assert [attended.answer(line) for line in ("home", "go 10 2", "turn -3", "jog -0.5")] == [None] * 4
    assert "expected one of home" in attended.answer("fly")
    assert "not a number" in attended.answer("jog far")
    assert "travel" in attended.answer("jog 500")
    place = attended.controller.place(stage_config("simulated", CONFIG))
    assert place == pytest.approx((7, 1.5), abs=0.01)
    last = [event for event in attended.told if event["event"] == "rig"][-1]
    assert (last["angle_deg"], last["position_mm"], last["known"]) == (pytest.approx(7, abs=0.01), pytest.approx(1.5, abs=0.01), True)
    attended.say("live on")
    live = attended.until(lambda event: event["event"] == "live")
    assert live["sharpness"] > 0
    assert (tmp_path / "live.png").is_file()
    assert attended.until(lambda event: event["event"] == "warning")["message"] == "its battery is low"
    assert attended.told[0]["count"] == 3  # the plan, before all


def test_stop_goes_before_all_and_keeps_the_position(attended):
    attended.say("home")
    assert attended.answer("home") is None
    for line in ("go 0 0", "jog 1"):
        attended.say(line)
    attended.until(state("moving"))
    attended.say("stop")
    assert "stopped" in attended.answer("go 0 0")
    assert "before it began" in attended.answer("jog 1")
    assert attended.answer("stop") is None
    attended.say("turn -5")
    assert attended.answer("turn -5") is None
    assert [event for event in attended.told if event["event"] == "rig"][-1]["known"]
    attended.say("jog -30")
    time.sleep(0.1)
    attended.say("stop")
    assert attended.answer("jog -30") is None
    assert not attended.controller.moving


def test_a_cable_that_is_pulled_is_waited_for(attended):
    attended.say("home")
    assert attended.answer("home") is None
    attended.controller.pull_cable()
    attended.until(state("lost"))
    seen = len(attended.told)
    attended.controller.plug_in()
    attended.until(lambda event: event["event"] == "rig" and event["state"] == "idle" and event in attended.told[seen:])
    attended.say("jog -1")
    assert attended.answer("jog -1") is None


def test_without_a_camera_the_stage_can_be_moved(tmp_path):
    def nothing():
        raise StrandscopeError("no camera was found")

    told = []
    with start_controller(CONFIG) as controller, Stage.open(stage_config(controller.url, CONFIG)) as stage:
        desk.attend(stage, nothing, Plan(), iter(["home", "live on", "quit"]), tmp_path / "live.png", told.append)
    assert {"event": "camera", "live": False, "error": "no camera was found"} in told
    assert [event["error"] for event in told if event["event"] == "answer"] == [None, None]


def test_who_names_no_rig_is_told(capsys, tmp_path):
    assert strandscope(["rig", "--port", str(tmp_path / "none")]) == 1
    assert "cannot be opened" in capsys.readouterr().err
    assert strandscope(["rig", "--ports"]) == 0
