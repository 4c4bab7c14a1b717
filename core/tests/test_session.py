"""A capture in which everything goes wrong still ends with each planned photograph once, and a logbook that agrees with the files."""

import json
import threading
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from strandscope.core.capture import load_capture
from strandscope.core.errors import StrandscopeError
from strandscope.core.raw import write_dng
from strandscope.core.rig import attach, session
from strandscope.core.rig.attach import ABORT, PAUSE, REPEAT, RESUME, Orders
from strandscope.core.rig.camera import CameraAsleep, CameraGone
from strandscope.core.rig.logbook import Logbook, read
from strandscope.core.rig.plan import Place, Plan, turntable_plan
from strandscope.core.rig.session import RunStopped, SessionParams, run
from strandscope.core.rig.stage import PositionLost, StageAlarm, StageLost
from strandscope.core.rig.wiring import StageConfig
from strandscope.core.virtual_rig import VirtualCamera, VirtualCameraConfig, read_stamp, stamped

PLAN = Plan(angles_deg=(0.0, 120.0), first_mm=-0.2, step_mm=0.2, count=3, settle_s=0.0, shutter_s=0.001, bytes_each=8000)
QUICK = SessionParams(retry_s=0.0, patience_s=5.0, reserve_bytes=0)


class SteadyStage:
    """A stage in memory that goes where it is told; faults are raised by what is asked next."""

    known, config = True, StageConfig()

    def __init__(self):
        self.at, self.faults, self.asked = Place(0.0, 0.0), [], []

    def home(self):
        return self._do("home", Place(0.0, -5.0))

    def recover(self, _timeout_s=600.0):
        self._do("recover", self.at)
        return True

    def position(self):
        return self._do("position", self.at)

    def move_to(self, angle_deg, position_mm, *, approach_deg, approach_mm, settle_s):
        assert (approach_deg, approach_mm, settle_s) == (PLAN.approach_deg, PLAN.approach_mm, 0.0)
        return self._do("move_to", Place(angle_deg, position_mm))

    def _do(self, what, to):
        self.asked.append(what)
        for fault in self.faults:
            if fault[0] == what:
                self.faults.remove(fault)
                raise fault[1]
        self.at = to
        return to


@dataclass
class World:
    """The machine below the stage in memory."""

    stage: SteadyStage

    def place(self):
        return self.stage.at

    def moved(self, _begin, _end):
        return False


class FaultyCamera(VirtualCamera):
    """A camera that stamps its photographs, and does what ``faults`` says at some of its shots."""

    def __init__(self, stage):
        super().__init__(stamped(), World(stage), VirtualCameraConfig(time_factor=1e6))
        self.faults, self.safe_files, self.prepared = {}, [], 0

    def prepare(self, settings):
        self.prepared += 1
        return super().prepare(settings)

    def capture(self, exposure, folder):
        fault = self.faults.pop(len(self.shots) + 1, None)
        if isinstance(fault, Exception):
            self.shots.append((0.0, 0.0))
            raise fault
        captured = super().capture(exposure, folder)
        if fault:
            fault(captured.path)
        return captured

    def safe(self, captured):
        self.safe_files.append(captured.name)


@pytest.fixture
def rig():
    stage = SteadyStage()
    return stage, FaultyCamera(stage)


def expect_whole(folder: Path, *plans: Plan) -> None:
    """Each planned photograph is there once, shows what was planned, and the logbook agrees with the files."""
    records, damaged = read((folder / session.LOGBOOK).read_bytes())
    story = session.replay(records)
    assert not damaged
    planned = {session.key(e): e for plan in plans for e in plan.exposures()}
    assert set(story.safe) == set(planned)
    assert not list(session.verify(folder, story))
    files = {record["file"] for record in story.safe.values()}
    assert len(files) == len({record["sha256"] for record in story.safe.values()}) == len(planned)
    for key, exposure in planned.items():
        stamp = read_stamp(folder / story.safe[key]["file"])
        assert not stamp.moving
        assert stamp.place == pytest.approx(exposure.place, abs=0.0011)
    on_disk = {p.relative_to(folder).as_posix() for p in folder.rglob("*.dng") if "aside" not in p.parts}
    assert on_disk == files


def test_a_plan_is_taken_and_reads_as_a_capture(tmp_path, rig):
    stage, camera = rig
    events = []
    assert run(PLAN, stage, camera, tmp_path, params=QUICK, events=events.append) == tmp_path / "capture.json"
    expect_whole(tmp_path, PLAN)
    capture = load_capture(tmp_path)
    assert [s.angle_deg for s in capture.sweeps] == [0.0, 120.0]
    assert capture.sweeps[0].positions_mm == PLAN.positions_mm
    assert (capture.optics.axis_col_px, capture.optics.axis_row_px) == (15.5, 11.5)
    assert capture.shape == (24, 32)
    assert len(camera.safe_files) == len(PLAN)  # the card is told of each
    told = [json.loads(line) for line in (tmp_path / session.EVENTS).read_text().splitlines()]
    assert told == events
    states = [e["state"] for e in told if e["event"] == "capture"]
    assert states[0] == "connecting"
    assert states[-1] == "done"
    assert told[-1]["done"] == told[-1]["total"] == 8
    assert attach.status(tmp_path)["state"] == "done"
    assert not attach.status(tmp_path)["running"]


def test_a_listener_that_is_gone_does_not_end_a_capture(tmp_path, rig):
    def gone(*_told):
        raise BrokenPipeError

    run(PLAN, *rig, tmp_path, params=QUICK, events=gone, progress=gone)
    expect_whole(tmp_path, PLAN)


def test_a_turntable_sequence_joins_the_sweeps(tmp_path, rig):
    table = replace(turntable_plan(3, shutter_s=0.001, bytes_each=8000), settle_s=0.0)
    run(PLAN, *rig, tmp_path, params=QUICK)
    run(table, *rig, tmp_path, params=QUICK)
    expect_whole(tmp_path, PLAN, table)
    stills = load_capture(tmp_path).turntable
    assert stills.angles_deg == (0.0, 120.0, 240.0)
    assert stills.f_number == 16.0


@pytest.mark.parametrize("cut", range(0, 40, 3))
def test_a_run_that_ends_anywhere_is_gone_on_with(tmp_path, rig, cut, monkeypatch):
    """The program ends at the nth thing it does to the disk, or between two; nothing that came before is taken again."""
    stage, camera = rig
    steps = iter(range(10_000))

    def ending(function):
        def ends(*arguments, **fields):
            if next(steps) == cut:
                raise SystemExit  # not caught by anything
            return function(*arguments, **fields)

        return ends

    with monkeypatch.context() as patch:
        patch.setattr(Logbook, "write", ending(Logbook.write))
        patch.setattr(session.os, "replace", ending(session.os.replace))
        patch.setattr(session, "sync_folder", ending(session.sync_folder))
        with pytest.raises(SystemExit):
            run(PLAN, stage, camera, tmp_path, params=QUICK)
    before = session.replay(read((tmp_path / session.LOGBOOK).read_bytes())[0]).safe
    shots = len(camera.shots)
    run(PLAN, stage, camera, tmp_path, params=QUICK)
    expect_whole(tmp_path, PLAN)
    assert len(camera.shots) - shots == len(PLAN) - len(before)


@pytest.mark.parametrize("damage", ["cut", "empty", "other size", "overexposed", "twice", "garbage"])
def test_a_photograph_that_is_not_as_it_should_be_is_taken_again(tmp_path, rig, damage):
    stage, camera = rig
    first = tmp_path / "sweep_000/img_0000.dng"

    def spoil(path):
        match damage:
            case "cut":
                path.write_bytes(path.read_bytes()[:-500])
            case "empty":
                path.write_bytes(b"")
            case "other size":
                write_dng(path, np.full((40, 64), 700, np.uint16), 512, 15871)
            case "overexposed":
                other = VirtualCamera(camera.photographer, camera.world, camera.config)
                other.settings = replace(camera.settings, shutter_s=0.1)
                other.expose(path)
            case "twice":
                path.write_bytes(first.read_bytes())
            case "garbage":
                path.write_bytes(np.random.default_rng(1).bytes(5000))

    camera.faults = {3: spoil, 5: spoil}
    told = []
    run(PLAN, stage, camera, tmp_path, params=QUICK, events=lambda e: told.append(e.get("message", "")))
    expect_whole(tmp_path, PLAN)
    assert len(camera.shots) == len(PLAN) + 2
    assert sum("trying again" in line for line in told) == 2
    assert len(list((tmp_path / session.ASIDE).iterdir())) == 2  # kept, out of the way


def test_a_camera_that_only_gives_damage_is_not_asked_for_ever(tmp_path, rig):
    stage, camera = rig
    camera.faults = {n: lambda path: path.write_bytes(b"II*\0") for n in range(3, 100)}
    with pytest.raises(StrandscopeError, match="LibRaw cannot read"):
        run(PLAN, stage, camera, tmp_path, params=QUICK)
    assert len(camera.shots) == 2 + QUICK.attempts
    camera.faults = {}
    run(None, stage, camera, tmp_path, params=QUICK)  # the folder knows the plan
    expect_whole(tmp_path, PLAN)


@pytest.mark.parametrize(
    ("where", "fault"),
    [
        ("move_to", StageLost("cable")),
        ("position", StageLost("cable, after the exposure")),
        ("move_to", StageAlarm("soft limit", 2)),
        ("position", PositionLost("restarted")),
        ("recover", StageLost("still gone")),
        ("home", StageLost("gone at once")),
    ],
)
def test_a_controller_that_goes_away_is_waited_for(tmp_path, rig, where, fault):
    stage, camera = rig
    stage.faults = [(where, fault)] if where != "recover" else [("move_to", StageLost("gone")), (where, fault), (where, fault)]
    run(PLAN, stage, camera, tmp_path, params=QUICK)
    expect_whole(tmp_path, PLAN)
    assert "recover" in stage.asked
    assert stage.asked.count("home") == (2 if isinstance(fault, StageAlarm) else 1)  # after an alarm, in any case
    if where == "position":  # the exposure was made, and is not trusted
        assert len(camera.shots) == len(PLAN) + 1


def test_a_stage_that_moved_during_an_exposure_spoils_it(tmp_path, rig):
    stage, camera = rig

    def nudge(_path):
        stage.at = Place(stage.at.angle_deg, stage.at.position_mm + 0.02)

    camera.faults = {4: nudge}
    run(PLAN, stage, camera, tmp_path, params=QUICK)
    expect_whole(tmp_path, PLAN)
    assert len(camera.shots) == len(PLAN) + 1


@pytest.mark.parametrize("fault", [CameraGone("unplugged"), CameraAsleep("asleep")])
def test_a_camera_that_goes_away_is_waited_for(tmp_path, rig, fault):
    stage, camera = rig
    camera.faults = {2: fault, 3: fault, 6: fault}
    run(PLAN, stage, camera, tmp_path, params=QUICK)
    expect_whole(tmp_path, PLAN)


def test_patience_ends(tmp_path, rig):
    stage, camera = rig
    now = iter(np.arange(0, 1e6, 0.5))
    camera.faults = {n: CameraGone("unplugged") for n in range(2, 10_000)}
    told = []
    with pytest.raises(CameraGone):
        run(PLAN, stage, camera, tmp_path, params=replace(QUICK, patience_s=60.0), clock=lambda: float(next(now)), events=told.append)
    assert 10 < len(camera.shots) < 100
    assert sum("unplugged; trying" in event.get("message", "") for event in told) == 1  # said once
    assert attach.status(tmp_path)["state"] == "failed"


def test_a_full_disk_is_waited_for_and_said_before(tmp_path, rig, monkeypatch):
    stage, camera = rig
    rooms = iter([10**9, 10**9, 10**9, 100, 100])
    monkeypatch.setattr(session, "_free", lambda _folder: next(rooms, 10**9))
    told = []
    run(PLAN, stage, camera, tmp_path, params=QUICK, events=lambda e: told.append(e.get("message", "")))
    expect_whole(tmp_path, PLAN)
    assert any("free some space" in line for line in told)
    monkeypatch.setattr(session, "_free", lambda _folder: 20_000)
    with pytest.raises(StrandscopeError, match=r"0\.0 GB are free"):
        run(PLAN, stage, camera, tmp_path / "other", params=QUICK)
    assert len(camera.shots) == len(PLAN)


def test_pause_abort_and_repeat_by_another_process(tmp_path, rig):
    stage, camera = rig
    with pytest.raises(StrandscopeError, match="no capture is running"):
        attach.order(tmp_path, PAUSE)

    def ordered(*orders):
        return lambda _path: [attach.order(tmp_path, *what[:1], **dict(what[1:])) for what in orders]

    camera.faults = {5: ordered((PAUSE,), (REPEAT, ("sweep", 0)), (RESUME,)), 9: ordered((ABORT,))}
    with pytest.raises(RunStopped, match=r"goes on"):
        run(PLAN, stage, camera, tmp_path, params=QUICK)
    assert attach.status(tmp_path)["state"] == "stopped"
    assert len(camera.shots) == 9
    run(None, stage, camera, tmp_path, params=QUICK)
    expect_whole(tmp_path, PLAN)
    assert len(camera.shots) == len(PLAN) + 4  # sweep 0 was complete, with its check
    run(None, stage, camera, tmp_path, params=QUICK, repeat=(1,))
    expect_whole(tmp_path, PLAN)
    assert len(camera.shots) == len(PLAN) + 8


def test_a_paused_run_takes_nothing_until_it_is_resumed(tmp_path, rig):
    stage, camera = rig
    orders, paused = Orders(), threading.Event()
    camera.faults = {2: lambda _path: orders.add(PAUSE)}
    thread = threading.Thread(target=run, args=(PLAN, stage, camera, tmp_path), kwargs={
        "params": QUICK, "orders": orders, "events": lambda e: paused.set() if e.get("state") == "paused" else None})  # fmt: skip
    thread.start()
    assert paused.wait(20)
    assert attach.status(tmp_path)["running"]
    assert len(camera.shots) == 2
    with pytest.raises(StrandscopeError, match="another run takes this capture"):
        run(PLAN, stage, camera, tmp_path, params=QUICK)
    orders.add(RESUME)
    thread.join(20)
    expect_whole(tmp_path, PLAN)


def test_another_plan_does_not_go_into_the_same_folder(tmp_path, rig):
    run(PLAN, *rig, tmp_path, params=QUICK)
    with pytest.raises(StrandscopeError, match="count 3, not 4"):
        run(replace(PLAN, count=4), *rig, tmp_path, params=QUICK)
    with pytest.raises(StrandscopeError, match="expected a plan"):
        run(None, *rig, tmp_path / "other", params=QUICK)


@pytest.mark.parametrize("damage", ["gone", "shorter", "changed"])
def test_photographs_that_changed_since_are_taken_again(tmp_path, rig, damage):
    stage, camera = rig
    run(PLAN, stage, camera, tmp_path, params=QUICK)
    path = tmp_path / "sweep_001/img_0001.dng"
    data = path.read_bytes()
    match damage:
        case "gone":
            path.unlink()
        case "shorter":
            path.write_bytes(data[:-1])
        case "changed":
            path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    run(PLAN, stage, camera, tmp_path, params=QUICK)
    expect_whole(tmp_path, PLAN)
    assert len(camera.shots) == len(PLAN) + 1


def test_a_logbook_survives_what_happens_to_its_last_line_and_to_one_in_the_middle(tmp_path, rig):
    stage, camera = rig
    run(PLAN, stage, camera, tmp_path, params=QUICK)
    path = tmp_path / session.LOGBOOK
    lines = path.read_bytes().splitlines(keepends=True)
    middle = next(i for i, line in enumerate(lines) if b'"what": "safe"' in line)
    damaged = bytearray(lines[middle])
    damaged[len(damaged) // 2] ^= 4
    path.write_bytes(b"".join([*lines[:middle], bytes(damaged), *lines[middle + 1 :]]) + lines[-1][:-7])
    told = []
    run(PLAN, stage, camera, tmp_path, params=QUICK, events=lambda e: told.append(e.get("message", "")))
    assert len(camera.shots) == len(PLAN) + 1
    assert any("is damaged" in line for line in told)
    records, bad = read(path.read_bytes())
    assert bad == [middle + 1]
    assert [r["n"] for r in records] == sorted({r["n"] for r in records})


def test_a_line_that_could_not_be_written_whole_spoils_no_other(tmp_path, monkeypatch):
    """The disk is full in the middle of a line, and what was written of it can be taken back, or cannot."""
    with Logbook(tmp_path / "book") as book:
        book.write("one", text="ä")
        real = book._file
        for stuck in (False, True):

            class Full:
                def __getattr__(self, name):
                    return getattr(real, name)

                def write(self, data):
                    if len(data) < 40:
                        raise OSError(28, "no space")
                    return real.write(data[:20])

                def truncate(self, size, stuck=stuck):
                    if stuck:
                        raise OSError(28, "no space")
                    return real.truncate(size)

            monkeypatch.setattr(book, "_file", Full())
            with pytest.raises(StrandscopeError, match="disk is full"):
                book.write("lost", text="x" * 30)
            monkeypatch.setattr(book, "_file", real)
            book.write("next")
    with Logbook(tmp_path / "book") as again:
        assert [record["what"] for record in again.records] == ["one", "next", "next"]
        assert [record["n"] for record in again.records] == [1, 2, 3]
        assert again.damaged == [3]
