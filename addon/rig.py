"""The rig beside Blender: a child process that moves it by hand, and the capture, which is nobody's child and outlives Blender.

Both speak in lines of JSON. ``tick`` takes in what they said; a timer calls it, or whoever waits. Nothing here touches bpy's data.
"""

import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import bpy

from ..core.errors import StrandscopeError
from ..core.files import explain
from ..core.rig import attach
from ..core.rig.plan import CHECK, Plan, read_table, save_plan
from . import jobs
from .props import ROOT

ASKED = f"{attach.RIG}/asked.toml"  # the plan as the panel gave it to a run
BUSY_S, IDLE_S = 0.2, 1.0  # between two ticks
WAIT_S = 120.0  # for the rig to do what a script asks for
END_S = 5.0  # for it to halt and let go of the port
MOST_WARNINGS = 200


@dataclass(frozen=True)
class Place:
    """Where the rig stands."""

    angle_deg: float
    position_mm: float


class Hand(jobs.Job):
    """The process that moves the rig: what it said last, and the way to tell it what to do."""

    def __init__(self, command: jobs.Command):
        """Connect. Raises StrandscopeError where the process cannot be started."""
        self.state, self.known, self.place, self.message = "connecting", False, None, ""
        self.plan: Plan | None = None
        self.camera, self.can_see = "", False  # what is wrong with the camera, whether it has a live picture
        self.live, self.picture, self.sharpness, self.best = False, None, 0.0, 0.0
        self.warnings: list[str] = []
        self.answers: list[str | None] = []  # to each command in turn: what went wrong
        self.asked: list[str] = []
        self.ending = False
        super().__init__(command, [sys.executable, "-P", str(jobs.WORKER), "--progress", "json", *command.arguments])

    @property
    def connected(self) -> bool:
        return self.plan is not None and not self.ending

    @property
    def busy(self) -> str:
        """The command that it has not answered yet."""
        return self.asked[len(self.answers)] if len(self.answers) < len(self.asked) else ""

    def say(self, command: str) -> None:
        """Have it do something; see ``core.rig.desk``."""
        self.asked.append(command)
        self.message = ""
        if command == "live on":
            self.live, self.best = True, 0.0
        if command == "live off":
            self.live = False
        with contextlib.suppress(OSError, ValueError):  # it has ended, which ``poll`` tells
            self._process.stdin.write(command.encode() + b"\n")
            self._process.stdin.flush()

    def end(self) -> None:
        """Halt the rig, and let go of it."""
        if not self.ending:
            self.ending, self._stop_at = True, time.monotonic() + END_S
            with contextlib.suppress(OSError, ValueError):
                self._process.stdin.close()

    def _take(self, event: dict) -> None:
        match event.get("event"):
            case "rig":
                self.state, self.known = event["state"], event.get("known", self.known)
                if "angle_deg" in event:
                    self.place = Place(event["angle_deg"], event["position_mm"])
                if self.state == "lost":
                    self.message = event["message"]
            case "plan":
                self.plan = _plan(event)
            case "answer":
                self.answers.append(event["error"])
                self.message = event["error"] or ""
            case "camera":
                self.can_see, self.camera = event["live"], event.get("error", "")
            case "live":
                self.picture, self.sharpness = Path(event["picture"]), event["sharpness"]
                self.best = max(self.best, self.sharpness)
            case "warning":
                self.live = self.live and "live picture" not in event["message"]
                self.warnings.append(event["message"])
            case _:
                super()._take(event)


class Run:
    """A capture in a folder, as it is seen from here: begun by this Blender, or by another program."""

    def __init__(self, folder: Path, argv: list[str] | None = None):
        """``argv``: start it; None looks on at one that is running. Raises StrandscopeError where it cannot be started."""
        self.folder, self.process = Path(folder), None
        self.told: dict = {}
        self.warnings: list[str] = []
        self.handed_over = False  # that it has ended was shown in the scene
        self._follower = attach.Follower(folder, skip=argv is not None)
        if argv is not None:
            self.process = _launch(self.folder, argv)
        self.running, self.error = True, ""

    @property
    def state(self) -> str:
        return self.told.get("state", "starting" if self.running else "failed")

    @property
    def message(self) -> str:
        """Why it waits, or has ended."""
        return self.error or (self.told.get("message", "") if self.state in ("waiting", "failed", "stopped") else "")

    @property
    def picture(self) -> Path:
        """The last photograph, small."""
        return self.folder / attach.LAST

    def poll(self) -> bool:
        """Take in what it told. Whether that was anything new."""
        lives = attach.runs(self.folder) or (self.process is not None and self.process.poll() is None)
        anew, events = self._follower.read()  # after that question: what it told last is not missed
        if anew:
            self.warnings = []
        for event in events:
            if event.get("event") == "capture":
                self.told = event
            elif event.get("event") == "warning" and len(self.warnings) < MOST_WARNINGS:
                self.warnings.append(event["message"])
        changed = bool(anew or events) or lives != self.running
        if self.running and not lives:
            self.error = "" if self.state in ("done", "stopped") else self._last_words()
        self.running = lives
        return changed

    def order(self, what: str, **fields) -> None:
        """Ask for a pause, to go on, to end, for a sweep anew. Raises StrandscopeError where it does not run any more."""
        attach.order(self.folder, what, **fields)

    def _last_words(self) -> str:
        if self.state == "failed" and self.told.get("message"):
            return self.told["message"]
        return attach.last_words(self.folder) or "the program ended in the middle; start it again, and it goes on"


@dataclass
class Desk:
    """What this Blender holds of the rig; properties cannot hold it."""

    hand: Hand | None = None
    run: Run | None = None
    then: Callable[[], Run] | None = None  # begins when the hand has let go of the rig
    ports: list[tuple[str, str]] = field(default_factory=list)
    seeking: "_Ports | None" = None
    error: str = ""  # with which a connection or a start failed

    @property
    def running(self) -> bool:
        return self.then is not None or (self.run is not None and self.run.running)


desk = Desk()


class _Ports(jobs.Job):
    """The process that lists serial ports."""

    def __init__(self):
        command = jobs.Command("Looking for ports", (), scratch() / "ports.log")
        super().__init__(command, [sys.executable, "-P", str(jobs.WORKER), "--progress", "json", "rig", "--ports"])

    def _take(self, event: dict) -> None:
        if event.get("event") == "ports":
            desk.ports = [tuple(port) for port in event["ports"]]
        else:
            super()._take(event)


# ---- what goes on ----------------------------------------------------------------------------------------------------


def connect(arguments: list[str]) -> None:
    """Begin to connect. Raises StrandscopeError where no process can be started."""
    desk.error = ""
    picture = ("--picture", str(scratch() / "live.png"))
    desk.hand = Hand(jobs.Command("Rig", ("rig", *arguments, *picture), scratch() / "rig.log"))


def disconnect() -> None:
    if desk.hand:
        desk.hand.end()


def seek_ports() -> None:
    """Begin to look which serial ports there are."""
    desk.seeking = desk.seeking or _Ports()


def start(folder: Path, arguments: list[str]) -> None:
    """Begin a capture as soon as the rig is let go of; it goes on when Blender is closed."""
    argv = [sys.executable, "-P", str(jobs.WORKER), "--progress", "json", "capture", *arguments, "-o", str(folder)]
    desk.error, desk.run = "", None
    desk.then = lambda: Run(folder, argv)
    disconnect()
    tick()


def look_on(folder: Path) -> bool:
    """Attach to the capture that is running in a folder. Whether there is one."""
    if not attach.runs(folder):
        return False
    desk.run = Run(folder)
    desk.run.poll()
    return True


def tick(*folders: Path) -> bool:
    """Take in what the processes said; attach to a capture that runs in one of the folders. Whether anything has changed."""
    changed = False
    if desk.seeking and desk.seeking.poll() is not None:
        desk.seeking, changed = None, True
    if desk.hand:
        before = _seen(desk.hand)
        result = desk.hand.poll()
        if result is not None:
            desk.error = "" if desk.hand.ending else (result.error or "the rig is not connected any more")
            desk.hand = None
        changed = changed or result is not None or _seen(desk.hand) != before
    if desk.then and desk.hand is None:
        begin, desk.then, changed = desk.then, None, True
        try:
            desk.run = begin()
            remember(desk.run.folder)
        except StrandscopeError as error:
            desk.error = str(error)
    if desk.run:
        changed = desk.run.poll() or changed
    for folder in folders:
        changed = (not desk.running and look_on(folder)) or changed
    return changed


def wait(done: Callable[[], bool], seconds: float = WAIT_S) -> None:
    """Tick until it is so. Raises StrandscopeError after so many seconds."""
    end = time.monotonic() + seconds
    while not done():
        if time.monotonic() > end:
            raise StrandscopeError(f"the rig has not answered for {seconds:.0f} s")
        time.sleep(jobs.TICK_S / 2)
        tick()


def release() -> None:
    """Let go of everything: the rig halts, a capture goes on."""
    if desk.hand:
        desk.hand.end()
        desk.hand.wait()
    if desk.seeking:
        desk.seeking.wait()
    if desk.run and desk.run.process:
        desk.run.process.returncode = 0  # it is nobody's child from here on
    desk.hand = desk.run = desk.then = desk.seeking = None
    desk.ports, desk.error = [], ""


# ---- plans -----------------------------------------------------------------------------------------------------------


def with_fields(base: Plan, angles: int, far_mm: float, near_mm: float, step_mm: float, **others) -> Plan:
    """A plan with other angles, positions and settings; raises StrandscopeError for what cannot be."""
    if base.kind != "turntable" and not near_mm > far_mm:
        raise StrandscopeError(f"the near side is at {near_mm:g} mm, the far side at {far_mm:g} mm; expected near above far")
    turns = base.angles_deg if len(base.angles_deg) == angles else tuple(360.0 * k / angles for k in range(angles))
    count = round((near_mm - far_mm) / step_mm) + 1
    if base.kind == "turntable":
        count = base.count
    return replace(base, angles_deg=turns, first_mm=round(far_mm, 6), step_mm=round(step_mm, 6), count=count, **others)


@lru_cache(8)
def cost(plan: Plan) -> tuple[str, float, int]:
    """What a plan takes: photographs, in words, seconds, and bytes."""
    checks = sum(exposure.kind == CHECK for exposure in plan.exposures())
    photographs = f"{len(plan) - checks:,} photographs".replace(",", " ") + (f" and {checks} checks" if checks else "")
    return photographs, plan.duration_s(), plan.disk_bytes()


def free_bytes(folder: Path) -> int | None:
    """Room on the disk of a folder that need not be there yet; None where nobody knows."""
    for place in (folder, *folder.parents):
        with contextlib.suppress(OSError):
            return shutil.disk_usage(place).free
    return None


def holds_capture(folder: Path) -> bool:
    """Whether a capture of a rig was begun in a folder."""
    return (folder / attach.LOGBOOK).is_file()


def write_asked(folder: Path, plan: Plan, file: Path | None, port: str, name: str) -> Path:
    """What a run shall do, as a file in its folder. Raises StrandscopeError where the rig's file is wrong, or the disk full."""
    tables = {table: read_table(file, table) for table in ("stage", "camera", "optics")} if file else {"stage": {}, "optics": {}}
    if port:
        tables["stage"]["url"] = port
    if name:
        tables["optics"]["name"] = name
    save_plan(folder / ASKED, plan, **tables)
    return folder / ASKED


# ---- remembering -----------------------------------------------------------------------------------------------------


def scratch() -> Path:
    """A folder of the user's for logs and live pictures."""
    with contextlib.suppress(ValueError):  # where this runs from its repository, not installed as an extension
        return Path(bpy.utils.extension_path_user(ROOT, path="rig", create=True))
    folder = Path(tempfile.gettempdir()) / f"strandscope-{os.getuid() if hasattr(os, 'getuid') else os.environ.get('USERNAME', '')}"
    folder.mkdir(mode=0o700, exist_ok=True)
    return folder


def remember(folder: Path) -> None:
    """Note where a capture runs, for a Blender that is started while it does."""
    with contextlib.suppress(OSError):
        (scratch() / "last_run.json").write_text(json.dumps({"folder": str(folder)}), encoding="utf-8")


def remembered() -> list[Path]:
    """Where the last capture was begun, if there was one."""
    try:
        return [Path(json.loads((scratch() / "last_run.json").read_text(encoding="utf-8"))["folder"])]
    except (OSError, ValueError, KeyError, TypeError):
        return []


def _launch(folder: Path, argv: list[str]) -> subprocess.Popen:
    """A process of its own: it has no terminal, hears none of our signals, and lives on when Blender ends."""
    group = {"start_new_session": True}
    if os.name != "posix":
        group = {"creationflags": subprocess.CREATE_NO_WINDOW | subprocess.CREATE_NEW_PROCESS_GROUP}
    log = folder / attach.SAID
    try:
        log.parent.mkdir(parents=True, exist_ok=True)
        with open(log, "wb") as said:
            environment = jobs.child_environment()
            return subprocess.Popen(argv, env=environment, stdin=subprocess.DEVNULL, stdout=said, stderr=subprocess.STDOUT, **group)
    except OSError as error:
        raise explain(error, log) from error


def _plan(told: dict) -> Plan:
    fields = {name: tuple(value) if isinstance(value, list) else value for name, value in told.items() if name != "event"}
    return Plan(**fields)


def _seen(hand: Hand | None):
    """What of a hand the panel shows."""
    return hand and (hand.state, hand.known, hand.place, hand.message, hand.camera, hand.can_see, hand.sharpness, len(hand.warnings), hand.busy,
                     hand.connected)  # fmt: skip
