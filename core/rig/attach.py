"""A run as other processes see it: how far it is, what it tells, what it is asked for. Light: it looks at no photograph.

A run appends what it tells to ``rig/events.jsonl``, reads what is asked of it from ``rig/orders.jsonl``, keeps the last photograph
in ``rig/last.png``, and holds ``rig/lock`` as long as it lives. Who looks on may come and go.
"""

import json
from collections import deque
from dataclasses import dataclass, fields
from pathlib import Path

from ..errors import StrandscopeError
from ..files import explain, is_held
from . import logbook
from .plan import TURNTABLE, Plan

RIG = "rig"
LOGBOOK, EVENTS, ORDERS = f"{RIG}/logbook.jsonl", f"{RIG}/events.jsonl", f"{RIG}/orders.jsonl"
LOCK = f"{RIG}/lock"
SAID = f"{RIG}/run.log"  # what a run that the panel started prints
LAST = f"{RIG}/last.png"  # the last photograph, small, for those who watch
PAUSE, RESUME, ABORT, REPEAT = "pause", "resume", "abort", "repeat"

Key = tuple[str, int, int]  # kind, sweep, frame of an exposure


@dataclass(frozen=True)
class Setup:
    """What capture.json says of the optics, beside the photographs; ``axis_*`` None: the middle of a photograph."""

    name: str = ""  # empty: the folder's
    working_distance_mm: float = 330.0
    pitch_mm: float = 1 / 35
    axis_col_px: float | None = None
    axis_row_px: float | None = None
    aperture_cone_deg: float = 10.0


class Orders:
    """What a run is asked to do: by this process (``add``, from any thread or signal handler), or by lines in a file."""

    def __init__(self):
        self._own: deque[dict] = deque()
        self._file: Path | None = None
        self._read = 0

    def add(self, what: str, **fields) -> None:
        self._own.append({"order": what, **fields})

    def listen(self, path: Path) -> None:
        """Also take the orders that are written to a file from now on."""
        self._file, self._read = path, path.stat().st_size if path.exists() else 0

    def take(self) -> list[dict]:
        """The orders since the last call."""
        orders = [self._own.popleft() for _ in range(len(self._own))]
        if self._file and self._file.exists():
            with open(self._file, "rb") as file:
                file.seek(self._read)
                data = file.read()
            whole = data[: data.rfind(b"\n") + 1]
            self._read += len(whole)
            orders += _events(whole)
        return orders


class Follower:
    """What the run in a folder tells, from the beginning of ``rig/events.jsonl`` on, a piece at a time."""

    def __init__(self, folder: Path, skip: bool = False):
        """``skip``: what the last run told is no news."""
        self._path, self._read, self._first = Path(folder) / EVENTS, 0, b""
        if skip:
            self.read()

    def read(self) -> tuple[bool, list[dict]]:
        """Whether another run has begun since the last call, and the events since then, or of it."""
        try:
            with open(self._path, "rb") as file:
                first = file.readline()
                anew = first != self._first and first.endswith(b"\n")
                if anew:
                    self._read, self._first = 0, first
                file.seek(self._read)
                data = file.read() if self._first else b""
        except OSError:
            return False, []
        whole = data[: data.rfind(b"\n") + 1]
        self._read += len(whole)
        return anew, _events(whole)


def last_words(folder: Path) -> str:
    """The error with which the run in a folder ended, empty where it told none; of runs that print to ``rig/run.log``."""
    try:
        data = (Path(folder) / SAID).read_bytes()
    except OSError:
        return ""
    errors = [event["message"] for event in _events(data) if event.get("event") == "error"]
    if errors:
        return errors[-1]
    lines = data.decode(errors="replace").strip().splitlines()
    return lines[-1] if lines and not lines[-1].startswith("{") else ""


def order(folder: Path, what: str, **fields) -> None:
    """Ask the run that takes the capture in ``folder`` to pause, resume, abort, or repeat a sweep. Raises StrandscopeError where none runs."""
    folder = Path(folder)
    if not is_held(folder / LOCK):
        raise StrandscopeError(f"{folder}: no capture is running there; `strandscope capture -o {folder}` goes on with it")
    try:
        with open(folder / ORDERS, "ab") as file:
            file.write(json.dumps({"order": what, **fields}).encode() + b"\n")
    except OSError as error:
        raise explain(error, folder / ORDERS) from error


def status(folder: Path) -> dict:
    """What a capture's run said last, with ``running``, and ``done`` of ``total`` photographs that are safe. Raises StrandscopeError
    where there is no capture."""
    folder = Path(folder)
    try:
        records, _ = logbook.read((folder / LOGBOOK).read_bytes())
    except OSError as error:
        raise StrandscopeError(f"{folder}: holds no capture of a rig; expected {LOGBOOK} in it") from error
    story = replay(records)
    last = {}
    if (folder / EVENTS).exists():
        told = [event for event in _events((folder / EVENTS).read_bytes()) if event.get("event") == "capture"]
        last = told[-1] if told else {}
    running = is_held(folder / LOCK)
    if not running and last.get("state") not in ("done", "stopped", "failed", None):
        last = {**last, "state": "ended", "message": "the program ended in the middle; go on with the same command"}
    total = sum(len(plan) for plan in story.plans.values())
    return {**last, "event": "capture", "running": running, "done": len(story.safe), "total": total}


def runs(folder: Path) -> bool:
    """Whether a run takes the capture in ``folder`` now."""
    return is_held(Path(folder) / LOCK)


def describe(told: dict) -> list[tuple[str, str]]:
    """Rows (name, value) for people of what ``status`` tells."""
    rows = [("photographs", f"{told['done']} of {told['total']} safe"), ("state", told.get("state", "begun") if told["running"] else "no run")]
    if not told["running"] and "state" in told:
        rows.append(("last run", told["state"]))
    if "sweep" in told:
        rows.append(("last", f"{told['kind']} {told['sweep']}, photograph {told['frame']}, at {told['angle_deg']:g}°, {told['position_mm']:g} mm"))
    if told["running"] and "remaining_s" in told:
        rows.append(("remaining", duration(told["remaining_s"])))
    if told.get("message"):
        rows.append(("said", told["message"]))
    return rows


def duration(seconds: float) -> str:
    """Hours and minutes, or minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{minutes} min {rest:02d} s"


# ---- what the logbook says -------------------------------------------------------------------------------------------


@dataclass
class Story:
    """What the records of a logbook amount to."""

    plans: dict[str, Plan]  # by kind
    setup: Setup
    safe: dict[Key, dict]  # the record of each photograph that is proven safe


def replay(records: list[dict]) -> Story:
    """What a logbook says, read from its beginning."""
    story = Story({}, Setup(), {})
    for record in records:
        match record["what"]:
            case "plan":
                story.plans[record["plan"]["kind"]] = _dataclass(Plan, record["plan"])
                story.setup = _dataclass(Setup, record["setup"])
            case "safe":
                story.safe[key_of(record)] = record
            case "undone":
                story.safe.pop(key_of(record), None)
            case "repeat":
                for key in [key for key in story.safe if key[0] != TURNTABLE and key[1] == record["sweep"]]:
                    del story.safe[key]
    return story


def plan_in(folder: Path) -> Plan | None:
    """The plan that a capture in ``folder`` is gone on with: the first that has photographs missing; None where there is none."""
    try:
        records, _ = logbook.read((Path(folder) / LOGBOOK).read_bytes())
    except OSError:
        return None
    return open_plan(replay(records))


def open_plan(story: Story) -> Plan | None:
    """The first plan of which photographs are missing, else the first; None where there is none."""
    missing = (p for p in story.plans.values() if any((e.kind, e.sweep, e.frame) not in story.safe for e in p.exposures()))
    return next(missing, next(iter(story.plans.values()), None))


def key_of(record: dict) -> Key:
    """What names the exposure that a record is about."""
    return record["kind"], record["sweep"], record["frame"]


def _dataclass(kind, values: dict):
    """A dataclass out of JSON: fields that it does not have are left out, lists become tuples."""
    names = {f.name for f in fields(kind)}
    return kind(**{name: tuple(value) if isinstance(value, list) else value for name, value in values.items() if name in names})


def _events(data: bytes) -> list[dict]:
    """Lines of JSON; what is none, such as a last one that is being written, is left out."""
    events = []
    for line in data.splitlines():
        try:
            event = json.loads(line)
        except ValueError:
            continue
        if isinstance(event, dict):
            events.append(event)
    return events
