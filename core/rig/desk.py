"""A rig that is moved by hand, for framing and focusing: one command a line, answered in order, while events tell what it does.

    home | unlock | jog MM | turn DEG | go DEG MM | stop | shutter | live on | live off | quit

``stop`` is obeyed at once, whatever goes on, and drops what was asked for before it; so does the end of the commands, since who gave
them is gone. ``quit`` waits for what was asked for. A controller that goes away is waited for.
"""

import math
import queue
import threading
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

from ..errors import StrandscopeError
from .camera import Camera, settings_of
from .plan import Plan
from .stage import PositionLost, Stage, StageLost
from .watch import sharpness, write_picture

LOOK_S = 0.25  # between two looks at a stage that stands
FOLLOW_S = 0.1  # at one that moves
LIVE_S = 0.1  # between two live pictures, at least
PULSE_S = 0.2  # of the shutter line
COMMANDS = "home, unlock, jog MM, turn DEG, go DEG MM, stop, shutter, live on, live off, quit"
STATES = {"Idle": "idle", "Run": "moving", "Jog": "moving", "Home": "homing", "Hold": "held", "Door": "door", "Alarm": "alarm"}

Events = Callable[[dict], None]


def attend(stage: Stage, open_camera: Callable[[], Camera], plan: Plan, commands: Iterable[str], picture: Path, events: Events) -> None:
    """Obey commands until ``quit`` or their end. ``picture`` is where live pictures are written, again and again.

    Events are {"event": "rig", "state", "known", "angle_deg", "position_mm", "pins"}, {"event": "answer", "to", "error"} for each
    command, {"event": "live", "picture", "sharpness"}, and notes and warnings with a message.
    """
    desk = _Desk(stage, plan, picture, events)
    threads = [
        threading.Thread(target=desk.hear, args=(commands,), name="commands", daemon=True),
        threading.Thread(target=desk.watch, args=(open_camera,), name="live picture", daemon=True),
    ]
    stage.tell = lambda line: desk.tell(event="note", message=line)
    desk.tell(event="plan", **asdict(plan))
    for line in stage.complaints(plan):
        desk.tell(event="warning", message=line)
    for thread in threads:
        thread.start()
    try:
        desk.work()
    finally:
        desk.ended.set()
        threads[1].join(5.0)  # so that the camera is let go of


class _Desk:
    """What goes on: a thread hears commands, one does them, one shows the live picture."""

    def __init__(self, stage: Stage, plan: Plan, picture: Path, events: Events):
        self.stage, self.plan, self.picture, self._events = stage, plan, picture, events
        self.ended, self.stop, self.live = threading.Event(), threading.Event(), threading.Event()
        self._asked: queue.Queue[str | None] = queue.Queue()
        self._waits = False  # the stage is in a call that only ``Stage.stop`` ends
        self._said: dict = {}
        self._telling = threading.Lock()

    def tell(self, **event) -> None:
        with self._telling:
            self._events(event)

    # -- the threads

    def hear(self, commands: Iterable[str]) -> None:
        """Take commands as they come; ``stop`` goes before all others."""
        for line in commands:
            words = line.split()
            if words == ["quit"]:
                self._asked.put(None)
                return
            if words == ["stop"]:
                self._halt()
            if words:
                self._asked.put(" ".join(words))
        self._halt()
        self._asked.put(None)

    def work(self) -> None:
        """Do what is asked for, and tell how the stage is."""
        self._look()
        while True:
            try:
                line = self._asked.get(timeout=LOOK_S)
            except queue.Empty:
                self._guarded(self._look)
                continue
            if line is None:
                return
            error = self._guarded(lambda: self._do(line.split()))  # noqa: B023 (called at once)
            self._guarded(self._look)
            self.tell(event="answer", to=line, error=error)

    def watch(self, open_camera: Callable[[], Camera]) -> None:
        """Connect the camera, and show what it sees while that is wanted."""
        camera = None
        try:
            camera = open_camera()
            camera.tell = lambda line: self.tell(event="note", message=line)
            for line in camera.prepare(settings_of(self.plan)):
                self.tell(event="note", message=line)
            for line in camera.check():
                self.tell(event="warning", message=line)
            self.tell(event="camera", live=hasattr(camera, "preview"))
        except StrandscopeError as error:
            self.tell(event="camera", live=False, error=str(error))
        while not self.ended.wait(LIVE_S):
            if self.live.is_set() and camera is not None:
                try:
                    self._show(camera)
                except StrandscopeError as error:
                    self.live.clear()
                    self.tell(event="warning", message=str(error))
        if camera is not None:
            camera.close()

    # -- what they do

    def _halt(self) -> None:
        """Drop what was asked for, and end what goes on."""
        with suppress(queue.Empty):
            while True:
                dropped = self._asked.get_nowait()
                self.tell(event="answer", to=dropped, error="stopped before it began")
        self.stop.set()
        if self._waits:
            with suppress(StageLost):  # the thread that waits tells it
                self.stage.stop()

    def _do(self, words: list[str]) -> None:
        """Obey one command. Raises StrandscopeError."""
        stage = self.stage
        self.stop.clear()
        match words:
            case ["stop"]:
                if stage.status().moving:
                    stage.cancel_jog()
            case ["home"]:
                self._until_done("homing", stage.home)
            case ["unlock"]:
                stage.unlock()
            case ["jog", way]:
                self._jog(position_mm=_number(way))
            case ["turn", way]:
                self._jog(angle_deg=_number(way))
            case ["go", angle, position]:
                place, least = (_number(angle), _number(position)), {"approach_deg": self.plan.approach_deg, "approach_mm": self.plan.approach_mm}
                self._until_done("moving", lambda: stage.move_to(*place, **least))
            case ["shutter"]:
                stage.pulse(PULSE_S)
            case ["live", ("on" | "off") as how]:
                (self.live.set if how == "on" else self.live.clear)()
            case _:
                raise StrandscopeError(f"{' '.join(words)}: not a command; expected one of {COMMANDS}")

    def _until_done(self, state: str, what: Callable) -> None:
        """A call of the stage that takes its time, and that ``stop`` ends."""
        self._say(state=state, message=state)
        self._waits = True
        try:
            what()
        finally:
            self._waits = False

    def _jog(self, **way: float) -> None:
        self.stage.jog(**way)
        while self._look().moving:
            if self.stop.wait(FOLLOW_S):
                self.stage.cancel_jog()
                return

    def _look(self):
        """Ask how the stage is, and tell it if that is news."""
        status = self.stage.status()
        place = {} if status.place is None else {"angle_deg": status.place.angle_deg, "position_mm": status.place.position_mm}
        state = STATES.get(status.state, status.state.lower())
        words = f"{state} at {place['angle_deg']:.3f}°, {place['position_mm']:.3f} mm" if place and status.known else f"{state}, not homed"
        self._say(state=state, known=status.known, pins=status.pins, **place, message="" if status.moving else words)
        return status

    def _say(self, **state) -> None:
        if state != self._said:
            self._said = state
            self.tell(event="rig", **state)

    def _guarded(self, what: Callable) -> str | None:
        """Do it; what goes wrong is told, and returned in words. A controller that is gone is waited for."""
        try:
            what()
            return None
        except StageLost as error:
            self._say(state="lost", message=str(error))
            self._find_again()
            return str(error)
        except StrandscopeError as error:
            return str(error)

    def _find_again(self) -> None:
        while self._asked.empty():
            try:
                self.stage.recover(1.0, home=False)
                return
            except PositionLost:  # it is there
                return
            except StageLost:
                self.ended.wait(LOOK_S)
            except StrandscopeError as error:
                self.tell(event="warning", message=str(error))
                return

    def _show(self, camera: Camera) -> None:
        seen = camera.preview()
        write_picture(self.picture, seen)
        self.tell(event="live", picture=str(self.picture), sharpness=round(sharpness(seen), 4))


def ports() -> list[tuple[str, str]]:
    """(address, what it is) of the serial ports of this machine, those on USB first."""
    from serial.tools.list_ports import comports

    found = sorted(comports(), key=lambda port: (port.vid is None, port.device))
    return [(port.device, port.description if port.description not in ("n/a", "") else port.device) for port in found]


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise StrandscopeError(f"{text}: not a number; expected one of {COMMANDS}")
    return value
