"""A capture of hours: the plan is taken photograph by photograph, each one proven safe before the next, whatever happens.

The logbook says before each exposure what will be taken, and after it what came of it. A photograph is safe when LibRaw reads
it, its size and exposure are as expected, its bytes are those of no other, the controller said before and after it that the stage
stands at its place, it is on the disk under its name, and the logbook has its hash. A later run goes on at the first exposure of
which that is not so. ``capture.json`` is derived from the logbook.

A run tells each of its states as one line of JSON in ``rig/events.jsonl``, and obeys what other processes write to
``rig/orders.jsonl``. What is no photograph of the capture is never deleted, but put into ``rig/aside``.
"""

import hashlib
import json
import math
import os
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from statistics import median

import numpy as np

from ..capture import FILE_NAME, Capture, Sweep, Turntable, save_capture
from ..errors import CaptureError, StrandscopeError
from ..files import explain, only_one, sha256, sync_folder
from ..geometry import Optics
from ..progress import Progress, silent
from ..raw import Header, read_header, read_planes
from .attach import ABORT, EVENTS, LAST, LOCK, LOGBOOK, ORDERS, PAUSE, REPEAT, RESUME, RIG, Key, Orders, Setup, Story, open_plan, replay
from .camera import Camera, CameraAsleep, CameraError, CameraGone, CapturedFile, settings_of
from .logbook import Logbook
from .plan import CHECK, TURNTABLE, Exposure, Plan
from .stage import Place, PositionLost, Stage, StageAlarm, StageError, StageLost
from .watch import Sight, Watch, WatchParams, look, write_picture

ASIDE, INCOMING = f"{RIG}/aside", f"{RIG}/incoming"
LAST_EVERY_S = 1.0
STILL_MM, STILL_DEG = 0.005, 0.02  # nearer than this to its place the stage stands there
STOPS_OFF = 0.4  # an exposure that differs by more, in factors of two, is another
REMEMBERED = 100  # photographs from whose pace the remaining time is told


@dataclass(frozen=True)
class SessionParams:
    """How much trouble a run puts up with."""

    patience_s: float = 1800.0  # for a controller, a camera or a disk that is away; then the run ends, and can be gone on with
    retry_s: float = 2.0  # between two tries at that
    attempts: int = 4  # at an exposure that fails though all are there
    reserve_bytes: int = 200_000_000  # that stay free on the disk
    verify_last: int = 16  # photographs of an earlier run whose bytes are read again; of the others, the size
    watch: WatchParams = field(default_factory=WatchParams)


class PhotographDamaged(CameraError):
    """A photograph came that is not what it should be; it may be taken again."""


class DiskFull(StrandscopeError):
    """There is no room for the next photograph."""


COMES_BACK = (StageLost, PositionLost, CameraGone, CameraAsleep, DiskFull)  # by itself or by a hand: a cable, a power supply, room


class RunStopped(StrandscopeError):
    """The run ended because it was asked to; it can be gone on with."""


def key(exposure: Exposure) -> Key:
    """What names an exposure in a capture."""
    return exposure.kind, exposure.sweep, exposure.frame


def file_name(exposure: Exposure, suffix: str) -> str:
    """Where in the capture an exposure's photograph belongs."""
    if exposure.kind == CHECK:
        return f"{RIG}/checks/sweep_{exposure.sweep:03d}{suffix}"
    if exposure.kind == TURNTABLE:
        return f"turntable/img_{exposure.sweep:03d}{suffix}"
    return f"sweep_{exposure.sweep:03d}/img_{exposure.frame:04d}{suffix}"


def derive(folder: Path, story: Story) -> Capture | None:
    """capture.json from the logbook: all sweeps that are complete, and the turntable sequence if it is. None, and nothing written,
    where no sweep is complete."""
    sweeps, stills = [], None
    for kind, plan in story.plans.items():
        found = [[story.safe.get((kind, k, i)) for i in range(plan.count)] for k in range(len(plan.angles_deg))]
        files = [tuple(record["file"] for record in sweep) if all(sweep) else None for sweep in found]
        if kind == TURNTABLE:
            if all(files):
                stills = Turntable(plan.f_number, tuple(f for one in files for f in one), plan.angles_deg, plan.first_mm)
        else:
            sweeps += [Sweep(angle, plan.positions_mm, each) for angle, each in zip(plan.angles_deg, files, strict=True) if each]
    if not sweeps:
        return None
    first = next(record for record in story.safe.values() if record["kind"] not in (CHECK, TURNTABLE))
    rows, columns = first["plane"]
    s = story.setup
    col, row = (columns - 1) / 2 if s.axis_col_px is None else s.axis_col_px, (rows - 1) / 2 if s.axis_row_px is None else s.axis_row_px
    optics = Optics(s.working_distance_mm, s.pitch_mm, col, row, s.aperture_cone_deg)
    planned = sum(len(plan) for plan in story.plans.values())
    truth = "truth.npz" if (folder / "truth.npz").is_file() else None
    told = {"rig": {"logbook": LOGBOOK, "photographs": len(story.safe), "planned": planned}}
    capture = Capture(folder, s.name or folder.resolve().name, optics, tuple(sweeps), stills, truth, unknown=told)
    save_capture(capture)
    return capture


def verify(folder: Path, story: Story, last: int | None = None) -> Iterator[tuple[Key, str]]:
    """Photographs that the logbook has as safe and that are not as it says, with what is wrong. The bytes of the ``last`` so many are
    read (None: of all), of the others the size."""
    records = list(story.safe.items())
    for i, (key, record) in enumerate(records):
        path = folder / record["file"]
        if not path.is_file():
            yield key, f"{path}: the photograph is missing"
        elif path.stat().st_size != record["bytes"]:
            yield key, f"{path}: has {path.stat().st_size} bytes, the logbook says {record['bytes']}"
        elif (last is None or i >= len(records) - last) and sha256(path) != record["sha256"]:
            yield key, f"{path}: its bytes are not those that the logbook says"


# ---- a run -----------------------------------------------------------------------------------------------------------


def run(
    plan: Plan | None,
    stage: Stage,
    camera: Camera,
    folder: Path,
    setup: Setup | None = None,
    params: SessionParams = SessionParams(),
    *,
    repeat: tuple[int, ...] = (),
    orders: Orders | None = None,
    progress: Progress = silent,
    events: Callable[[dict], None] = lambda _event: None,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> Path:
    """Take the photographs of a plan that are not safe yet, and write ``capture.json``; returns its path.

    ``plan`` None goes on with what the folder holds; ``repeat`` are sweeps to take anew. ``events`` gets what is told, a dict each:
    {"event": "capture", "state": …, "done", "total", "remaining_s", …}, or "note" or "warning" with a "message". Raises RunStopped
    when asked to stop, and StrandscopeError for what patience does not help; both leave a capture that the same call goes on with.
    """
    folder = Path(folder)
    busy = f"{folder}: another run takes this capture; `strandscope capture --status -o {folder}` tells how far it is"
    with only_one(folder / LOCK, busy), Logbook(folder / LOGBOOK) as book:
        taken = _Run(plan, stage, camera, folder, setup, params, book, orders or Orders(), (progress, events), clock, sleep)
        try:
            return taken.take(repeat)
        except RunStopped as error:
            taken.end("stopped", str(error))
            raise
        except StrandscopeError as error:
            taken.end("failed", str(error))
            raise
        except KeyboardInterrupt:
            taken.end("stopped", "interrupted")
            raise
        finally:
            taken.close()


class _Run:
    """One run at work: what it knows, and the loop."""

    def __init__(self, plan, stage, camera, folder, setup, params, book, orders, listeners, clock, sleep):
        self.stage, self.camera, self.folder, self.params, self.book, self.orders = stage, camera, folder, params, book, orders
        self.progress, self.listener = listeners
        stage.tell = camera.tell = self.note
        self.clock, self.sleep = clock, sleep
        self.story = replay(book.records)
        self.plan = self._begin(plan, setup)
        self.exposures = list(self.plan.exposures())
        self.watch = Watch(params.watch, self.story.setup.pitch_mm)
        self.hashes = {record["sha256"]: key for key, record in self.story.safe.items()}
        self.pace: deque[float] = deque(maxlen=REMEMBERED)
        self.paused, self.shown = False, -math.inf
        self.ready = self.prepared = False
        self.failing: StrandscopeError | None = None  # the trouble that lasts, since when, and how often it was met
        self.failing_since, self.tries, self.said = 0.0, 0, ""
        self.now: Exposure | None = None
        self.pool, self.keeping = ThreadPoolExecutor(1), None  # makes a photograph safe while the stage goes to the next: exposure, future
        self._telling = threading.Lock()
        self._events = open(folder / EVENTS, "wb", buffering=0)  # noqa: SIM115

    def close(self) -> None:
        self.pool.shutdown()
        self._events.close()

    # -- the whole

    def take(self, repeat: tuple[int, ...]) -> Path:
        for line in self.book.damaged:
            self.warn(f"{self.book.path}: line {line} is damaged; the photograph that it was about is taken again")
        self.orders.listen(self.folder / ORDERS)
        self._tidy()
        for sweep in repeat:
            self._repeat(sweep)
        self._expect_room()
        self.book.write("run", exposures=len(self.exposures), safe=self._done)
        self.say("connecting")
        while True:
            begun = self.clock()
            exposure = next((e for e in self.exposures if key(e) not in self.story.safe and not self._in_hand(e)), None)
            try:
                self._obey()
                if exposure is None:
                    self._kept()
                    if self._done == len(self.exposures):
                        return self._finish()
                elif not self.ready:
                    self._get_ready()
                else:
                    self._photograph(exposure)
                    self.pace.append(self.clock() - begun)
            except (StageError, CameraError, DiskFull) as trouble:
                self._bear(trouble)

    def _in_hand(self, exposure: Exposure) -> bool:
        return self.keeping is not None and self.keeping[0] is exposure

    def _kept(self) -> None:
        """Wait until the last photograph is safe. Raises what kept it from being so."""
        if self.keeping:
            (_, future), self.keeping = self.keeping, None
            future.result()

    def _trouble_in_hand(self) -> StrandscopeError | None:
        """The same, but what is raised is returned."""
        try:
            self._kept()
        except (StageError, CameraError, DiskFull) as trouble:
            return trouble
        return None

    def _bear(self, trouble: StrandscopeError) -> None:
        """Tell trouble and wait a little, or raise it when patience is at its end."""
        met = [trouble, self._trouble_in_hand()]
        trouble = next((t for t in met if isinstance(t, StageError)), trouble)  # the stage has to be recovered in any case
        self.ready, now = False, self.clock()
        self.failing_since = now if self.tries == 0 else self.failing_since
        self.failing, self.tries = trouble, self.tries + 1
        waits = isinstance(trouble, COMES_BACK)
        again = self.tries > 1 and str(trouble) == self.said  # every few seconds, perhaps for half an hour
        with suppress(DiskFull):
            for each in () if again else met:
                if each:
                    self._note_down("trouble", message=str(each), kind=type(each).__name__)
        if (waits and now - self.failing_since > self.params.patience_s) or (not waits and self.tries >= self.params.attempts):
            raise trouble
        if not again:
            self.say("waiting", f"{trouble}; trying again")
        self.said = str(trouble)
        until = self.clock() + (self.params.retry_s if self.tries > 1 else 0.0)
        while self.clock() < until:
            self._obey()
            self.sleep(min(0.1, self.params.retry_s))

    def _get_ready(self) -> None:
        """Have the stage at a position that is known, and the camera set."""
        if self.failing is None:
            self.say("homing")
            self._note_down("homed", **_place(self.stage.home()))
        elif isinstance(self.failing, StageError):
            kept = self.stage.recover(self.params.retry_s)
            if kept and isinstance(self.failing, StageAlarm) and self.stage.config.homing:
                kept = False  # no plan asks for an alarm: what led to it may have moved the stage, whatever the controller counts
                self.stage.home()
            self._note_down("recovered", kept=kept, **_place(self.stage.position()))
            self.note("the controller is there again" + ("" if kept else ", homed"))
        if not self.prepared:
            for line in self.camera.prepare(settings_of(self.plan)):
                self.note(line)
            self.prepared = True
        for line in self.camera.check():
            self.warn(line)
        self.ready = True

    def _finish(self) -> Path:
        try:
            capture = derive(self.folder, self.story)
        except StrandscopeError as error:
            raise DiskFull(str(error)) from error
        damaged = [words for _, words in verify(self.folder, self.story, 0)]
        if damaged:
            raise StrandscopeError(f"{damaged[0]}; run the same command again, it is taken anew")
        self.end("done", "")
        if capture is None:
            return self.folder / LOGBOOK  # a turntable sequence alone, or checks
        return self.folder / FILE_NAME

    # -- one photograph

    def _photograph(self, exposure: Exposure) -> None:
        """Take one photograph and make it safe. Raises StageError, CameraError, DiskFull."""
        self.now = exposure
        self._expect_room_now()
        self.say("moving")
        p = self.plan
        place = self.stage.move_to(*exposure.place, approach_deg=p.approach_deg, approach_mm=p.approach_mm, settle_s=p.settle_s)
        self._expect_there(exposure, place, "arrived")
        self._kept()  # the one before
        what = dict(zip(("kind", "sweep", "frame"), key(exposure), strict=True))
        self._note_down("exposing", **what, **_place(place))
        self.say("exposing")
        incoming = self.folder / INCOMING
        try:
            incoming.mkdir(parents=True, exist_ok=True)
            captured = self.camera.capture(exposure, incoming)
        except OSError as error:
            raise DiskFull(str(explain(error, incoming))) from error
        except StrandscopeError as error:
            if isinstance(error.__cause__, OSError) and not isinstance(error, CameraError | StageError):
                raise DiskFull(str(error)) from error
            raise
        try:
            self._expect_there(exposure, self.stage.position(), "stood after the exposure")
        except BaseException:
            self._aside(captured.path, "not proven safe")
            raise
        self.keeping = exposure, self.pool.submit(self._make_safe, exposure, captured, what)

    def _make_safe(self, exposure: Exposure, captured: CapturedFile, what: dict) -> None:
        """Look at a photograph, keep it, and tell. Runs beside the motion to the next."""
        try:
            self._keep(exposure, captured, what)
        except BaseException:
            self._aside(captured.path, "not proven safe")
            raise
        self.failing, self.tries = None, 0
        self.camera.safe(captured)
        with self._telling, suppress(OSError):
            self.progress("photographs", self._done, len(self.exposures))
        self.say("safe", exposure=exposure)

    def _expect_there(self, exposure: Exposure, place: Place, how: str) -> None:
        off_deg, off_mm = abs(place.angle_deg - exposure.angle_deg), abs(place.position_mm - exposure.position_mm)
        if off_deg > STILL_DEG or off_mm > STILL_MM:
            raise PositionLost(
                f"the stage {how} at {place.angle_deg:g}°, {place.position_mm:g} mm in place of {exposure.angle_deg:g}°, {exposure.position_mm:g} mm"
            )

    def _keep(self, exposure: Exposure, captured: CapturedFile, what: dict) -> None:
        """Look at a photograph, give it its name, and write down that it is safe. Raises PhotographDamaged, DiskFull."""
        header, planes = self._looked_at(exposure, captured.path)
        try:
            with open(captured.path, "r+b") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
                os.fsync(file.fileno())
            other = self.hashes.get(digest)
            if other is not None and other != key(exposure):
                raise PhotographDamaged(f"{captured.name} has the very bytes of the photograph of {_words(other)}: the camera delivered it twice")
            name = file_name(exposure, captured.path.suffix)
            path = self.folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.exists():
                self._aside(path, "was there, and not proven safe")
            size = captured.path.stat().st_size
            os.replace(captured.path, path)
            sync_folder(path.parent)
        except OSError as error:
            raise DiskFull(str(explain(error, captured.path))) from error
        sight, warnings = self._seen(exposure, planes)
        exposed = {"rows": header.rows, "cols": header.cols, "shutter_s": header.shutter_s, "f_number": header.f_number, "iso": header.iso}
        told = {"file": name, "bytes": size, "sha256": digest, "camera": captured.name, "plane": list(planes.shape[1:]), **exposed, **sight.record()}
        record = self._note_down("safe", **what, **told)
        self.story.safe[key(exposure)] = record
        self.hashes[digest] = key(exposure)
        self._show(planes)
        if self._sweep_complete(exposure):
            warnings += self.watch.sweep_done(self.plan.count)
            with suppress(StrandscopeError):  # the disk is full: at the end it is written in any case
                derive(self.folder, self.story)
        for words in warnings:
            self.warn(words)

    def _looked_at(self, exposure: Exposure, path: Path) -> tuple[Header, np.ndarray]:
        """Header and channel planes of a photograph. Raises PhotographDamaged where it is not as it should be."""
        try:
            header, planes = read_header(path), read_planes(path, "RGB")
        except CaptureError as error:
            raise PhotographDamaged(str(error)) from error
        expected = next((r for r in self.story.safe.values() if (r["kind"] == TURNTABLE) == (exposure.kind == TURNTABLE)), None)
        if expected and (header.rows, header.cols) != (expected["rows"], expected["cols"]):
            was = f"{expected['cols']} x {expected['rows']}"
            raise PhotographDamaged(f"{path}: has {header.cols} x {header.rows} pixels, the others {was}; has the camera's image size been changed?")
        asked = {"shutter_s": self.plan.shutter_s} | ({name: expected[name] for name in ("f_number", "iso")} if expected else {})
        for name, value in asked.items():
            found = getattr(header, name)
            if found and value and abs(math.log2(found / value)) > STOPS_OFF:
                raise PhotographDamaged(f"{path}: {name} is {found:g}; expected {value:g}: is the camera in manual mode, and set as the plan says?")
        return header, planes

    def _seen(self, exposure: Exposure, planes: np.ndarray) -> tuple[Sight, list[str]]:
        self._resume_watch(exposure)
        if exposure.kind == CHECK:
            return look(planes), self.watch.check(planes)
        return self.watch.photograph(exposure.sweep, exposure.frame, exposure.position_mm, planes)

    def _show(self, planes: np.ndarray) -> None:
        if self.clock() - self.shown > LAST_EVERY_S:
            self.shown = self.clock()
            with suppress(StrandscopeError):  # the disk is full; that is told where it matters
                write_picture(self.folder / LAST, planes)

    def _sweep_complete(self, exposure: Exposure) -> bool:
        """Whether this was the last photograph of its sweep that was missing."""
        return all(key(e) in self.story.safe for e in self.exposures if e.sweep == exposure.sweep)

    def _resume_watch(self, exposure: Exposure) -> None:
        """Give the watch the first photograph of a sweep that an earlier run began."""
        if exposure.kind == TURNTABLE or self.watch.sweep == exposure.sweep or exposure.frame == 0:
            return
        first = self.story.safe.get((self.plan.kind, exposure.sweep, 0))
        if first:
            try:
                self.watch.photograph(exposure.sweep, 0, self.plan.first_mm, read_planes(self.folder / first["file"], "RGB"))
            except CaptureError as error:
                self.warn(str(error))

    # -- beginning, orders, room

    def _begin(self, plan: Plan | None, setup: Setup | None) -> Plan:
        """The plan to take, which is written down if it is new. Raises StrandscopeError where the folder holds another."""
        self._began = len(self.book.records)
        plans = self.story.plans
        if plan is None:
            if not plans:
                raise StrandscopeError(f"{self.folder}: holds no capture to go on with; expected a plan")
            return open_plan(self.story)
        before = plans.get(plan.kind)
        if before is not None:
            for f in fields(Plan):
                if f.name in ("angles_deg", "first_mm", "step_mm", "count", "check_shots") and getattr(before, f.name) != getattr(plan, f.name):
                    differs = f"{f.name} {getattr(before, f.name)}, not {getattr(plan, f.name)}"
                    raise StrandscopeError(f"{self.folder}: holds a capture whose plan has {differs}; expected the same plan, or another folder")
            if before == plan and setup in (None, self.story.setup):
                return plan
        setup = setup or self.story.setup
        self.book.write("plan", plan=asdict(plan), setup=asdict(setup))
        self.story.plans[plan.kind], self.story.setup = plan, setup
        return plan

    def _tidy(self) -> None:
        """Put aside what an earlier run left that is not proven safe, and take back what is no longer as it was."""
        for part in sorted((self.folder / INCOMING).glob(".*")):
            self._aside(part, "left by a run that ended in the middle")
        for lost, words in list(verify(self.folder, self.story, self.params.verify_last)):
            record = self.story.safe.pop(lost)
            self._note_down("undone", **dict(zip(("kind", "sweep", "frame"), lost, strict=True)), why=words)
            self.hashes.pop(record["sha256"], None)
            self.warn(f"{words}; it is taken again")
            self._aside(self.folder / record["file"], words)

    def _repeat(self, sweep: int) -> None:
        """Take a sweep anew; its photographs so far are put aside."""
        if not 0 <= sweep < len(self.plan.angles_deg) or self.plan.kind == TURNTABLE:
            self.warn(f"there is no sweep {sweep} to repeat; the plan has 0 to {len(self.plan.angles_deg) - 1}")
            return
        gone = [record for k, record in self.story.safe.items() if k[0] != TURNTABLE and k[1] == sweep]
        self._note_down("repeat", sweep=sweep)
        for record in gone:
            self._aside(self.folder / record["file"], f"sweep {sweep} is repeated")
            self.hashes.pop(record["sha256"], None)
        self.story = replay(self.book.records)
        self.watch.sweep = None
        self.note(f"sweep {sweep} is taken again; its {len(gone)} photographs so far are in {self.folder / ASIDE}")

    def _obey(self) -> None:
        """Do what was asked, and stay here while paused. Raises RunStopped."""
        while True:
            asked_for = self.orders.take()
            trouble = self._trouble_in_hand() if asked_for else None
            for asked in asked_for:
                what = asked.get("order")
                if what == ABORT:
                    safe = f"{self._done} of {len(self.exposures)} photographs safe"
                    raise RunStopped(f"stopped with {safe}; `strandscope capture -o {self.folder}` goes on")
                if what in (PAUSE, RESUME):
                    self.paused = what == PAUSE
                    self._note_down(what)
                    self.say("paused" if self.paused else "moving")
                    self.note("paused; do not touch the hair" if self.paused else "going on")
                elif what == REPEAT and isinstance(asked.get("sweep"), int):
                    self._repeat(asked["sweep"])
            if trouble:
                raise trouble
            if not self.paused:
                return
            self.sleep(0.05)

    def _expect_room(self) -> None:
        """Raise StrandscopeError if the disk has no room for what is still to come."""
        sizes = [record["bytes"] for record in self.story.safe.values()]
        each = sum(sizes) / len(sizes) if sizes else self.plan.bytes_each
        need = int((len(self.exposures) - self._done) * each) + self.params.reserve_bytes
        free = _free(self.folder)
        if free < need:
            needs = f"{_gb(free)} are free, the photographs to come need {_gb(need)}"
            raise StrandscopeError(f"{self.folder}: {needs}; free some space, or take another disk")

    def _expect_room_now(self) -> None:
        free, need = _free(self.folder), self.params.reserve_bytes + 2 * self.plan.bytes_each
        if free < need:
            raise DiskFull(f"{self.folder}: only {_gb(free)} are free; free some space, the capture then goes on by itself")

    # -- telling

    @property
    def _done(self) -> int:
        return sum(key(e) in self.story.safe for e in self.exposures)

    def _remaining_s(self) -> float:
        left = len(self.exposures) - self._done
        if self.pace:
            return median(self.pace) * left
        return self.plan.duration_s(start=len(self.exposures) - left) if left else 0.0

    def say(self, state: str, message: str = "", exposure: Exposure | None = None) -> None:
        """Tell where the run is."""
        where = {}
        if e := exposure or self.now:
            where = {"kind": e.kind, "sweep": e.sweep, "frame": e.frame, "angle_deg": e.angle_deg, "position_mm": e.position_mm}
            if key(e) in self.story.safe:
                record = self.story.safe[key(e)]
                where |= {"photograph": record["file"], "sharpness": record["sharpness"], "bright": record["bright"], "clipped": record["clipped"]}
        counts = {"done": self._done, "total": len(self.exposures), "remaining_s": round(self._remaining_s(), 1)}
        self._event(event="capture", state=state, **counts, **where, **({"message": message} if message else {}))

    def note(self, words: str) -> None:
        self._event(event="note", message=words)

    def _note_down(self, what: str, **fields) -> dict:
        """A record in the logbook. Raises DiskFull where it cannot be written."""
        try:
            return self.book.write(what, **fields)
        except StrandscopeError as error:
            raise DiskFull(str(error)) from error

    def warn(self, words: str) -> None:
        self._note_down("warning", message=words)
        self._event(event="warning", message=words)

    def end(self, state: str, message: str) -> None:
        try:
            self._trouble_in_hand()
            self.book.write("end", state=state, message=message)
            self.say(state, message)
        except StrandscopeError:
            return  # the disk is full: there is nothing more to be told there

    def _event(self, **event) -> None:
        event["time"] = round(time.time(), 3)
        with self._telling:
            with suppress(OSError):  # the disk is full; that is told where it matters
                self._events.write(json.dumps(event).encode() + b"\n")
            with suppress(OSError):  # who listened is gone; the hair still hangs there
                self.listener(event)

    def _aside(self, path: Path, why: str) -> None:
        """Put a file that is no photograph of the capture where it disturbs nobody."""
        if not path.exists():
            return
        number = sum(1 for _ in (self.folder / ASIDE).glob("*")) if (self.folder / ASIDE).is_dir() else 0
        to = self.folder / ASIDE / f"{number:04d}_{path.parent.name}_{path.name.lstrip('.')}"
        try:
            to.parent.mkdir(parents=True, exist_ok=True)
            os.replace(path, to)
            self.book.write("aside", file=str(path.relative_to(self.folder).as_posix()), to=to.name, why=why)
        except (OSError, StrandscopeError):  # a full disk: it stays, and the next run finds it
            return


def _place(place: Place | None) -> dict:
    return {} if place is None else {"angle_deg": place.angle_deg, "position_mm": place.position_mm}


def _words(key: Key) -> str:
    return f"{key[0]} {key[1]}, frame {key[2]}"


def _free(folder: Path) -> int:
    return shutil.disk_usage(folder).free


def _gb(size: float) -> str:
    return f"{size / 1e9:.1f} GB"
