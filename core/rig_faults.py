"""Captures to which everything happens that can, and a proof of what is left of them.

A trial is a virtual capture: the session in a process of its own, the controller's simulator in another, and, for a camera on a
cable, tethering software. Faults come at random moments: the cable is pulled, the process killed, the controller raises an alarm,
loses its power or says garbage, photographs are late, cut short or of another shot, the disk is full. Who runs the trial does
what a person would: plugs the cable in, and starts the same run again. Then every planned photograph must be there once and
whole, as the logbook says, taken where the plan says by the machine's own account, and never while it moved.
"""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

from .capture import load_capture
from .errors import CaptureError, StrandscopeError
from .progress import Progress, silent
from .rig import logbook, session
from .rig.camera import CableCamera, CableConfig, CameraSettings, CapturedFile
from .rig.controller import GRBL, GRBLHAL, Controller, ControllerConfig, stage_config, start_controller
from .rig.plan import Exposure, Plan
from .rig.session import SessionParams
from .rig.stage import Stage
from .rig.wiring import StageConfig
from .virtual_rig import SimulatedWorld, VirtualCamera, VirtualCameraConfig, read_stamp, stamped

WORKER = Path(__file__).resolve().parent.parent / "worker.py"
OF_CONTROLLER = ("cable", "alarm", "garbage", "noise", "silence", "power", "reset button", "hold button")
OF_CAMERA = ("slow", "cut short", "wrong order")  # that is: late, or another shot's bytes
OF_COMPUTER = ("kill", "disk full") if os.name == "posix" else ("kill",)
FAULTS = OF_CONTROLLER + OF_CAMERA + OF_COMPUTER
MOST_STARTS = 12  # of the session in a trial, before it counts as failed
HOME_S = 15.0  # for homing, which takes less than a second at the speed of the trials
TRIAL_S = 120.0  # a trial takes no longer
NEAR_MM, NEAR_DEG = 0.0051, 0.021  # where a photograph was taken, and where it should have been


@dataclass(frozen=True)
class FaultParams:
    """How the trials are made."""

    faults: int = 200  # in all
    a_trial: int = 5  # of them
    seed: int = 0
    speed: float = 40.0  # the virtual rig's time goes so many times as fast
    plan: Plan = field(
        default_factory=lambda: Plan(
            angles_deg=(0.0, 90.0, 180.0, 270.0), first_mm=-0.6, step_mm=0.3, count=5, settle_s=0.1, shutter_s=0.2, bytes_each=8000
        )
    )


@dataclass(frozen=True)
class Trial:
    """What came of a capture with faults."""

    seed: int
    kind: str  # firmware, port and camera
    faults: tuple[str, ...]
    starts: int  # of the session's process
    shots: int  # of the shutter, of which the capture needs as many as are planned
    moved: int  # of them, while the machine moved
    seconds: float
    wrong: tuple[str, ...]  # what is not as it should be; empty: proven


def trials(folder: Path, params: FaultParams, progress: Progress = silent) -> Iterator[Trial]:
    """Make captures in ``folder`` until all faults have been injected; those that are proven are removed again."""
    rng, injected, number = random.Random(params.seed), 0, 0
    while injected < params.faults:
        faults = tuple(FAULTS[(injected + i) % len(FAULTS)] for i in range(min(params.a_trial, params.faults - injected)))
        injected += len(faults)
        seed = params.seed * 100_000 + number
        trial = attempt(Path(folder) / f"{seed:06d}", seed, tuple(rng.sample(faults, len(faults))), params)
        number += 1
        progress("faults", injected, params.faults)
        yield trial


def attempt(folder: Path, seed: int, faults: tuple[str, ...], params: FaultParams) -> Trial:
    """One capture with faults in their order, at random moments; the folder is removed if all is proven."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    rng, begun = random.Random(seed), time.monotonic()
    cable, firmware = rng.random() < 0.5, rng.choice((GRBL, GRBLHAL))
    transport = rng.choice(("pty", "tcp")) if os.name == "posix" else "tcp"
    config = ControllerConfig(firmware, params.speed, resets_on_open=rng.random() < 0.3, seed=seed)
    with start_controller(config, transport) as controller:
        rig = _Trial(folder, controller, stage_config(controller.url, config, home_s=HOME_S), cable, params, rng)
        wrong = rig.run(faults)
        shots = rig.shots()
        moved = sum(controller.moved(begin, end) for begin, end in shots)
    wrong += prove(folder / "capture", params.plan)
    wrong += [f"{moved} exposures while the stage moved"] if moved else []
    kind = f"{firmware}, {transport}{', restarts when opened' if config.resets_on_open else ''}, camera on {'cable' if cable else 'USB'}"
    if not wrong:
        shutil.rmtree(folder)
    return Trial(seed, kind, faults, rig.starts, len(shots), moved, time.monotonic() - begun, tuple(wrong))


def prove(folder: Path, plan: Plan) -> list[str]:
    """What is wrong with a capture of stamped photographs; empty if every planned one is there once, whole, as the logbook says, and
    shows the place that was planned."""
    try:
        records, damaged = logbook.read((folder / session.LOGBOOK).read_bytes())
        capture = load_capture(folder)
    except (OSError, StrandscopeError) as error:
        return [str(error)]
    story = session.replay(records)
    planned = {session.key(e): e for e in plan.exposures()}
    wrong = [f"line {line} of the logbook is damaged" for line in damaged]
    wrong += [f"{key} is not safe" for key in planned if key not in story.safe] + [
        f"{key} was not planned" for key in story.safe if key not in planned
    ]
    wrong += [words for _, words in session.verify(folder, story)]
    files, hashes = [r["file"] for r in story.safe.values()], [r["sha256"] for r in story.safe.values()]
    if not len(set(files)) == len(set(hashes)) == len(files):
        wrong.append("a photograph is there twice")
    there = {p.relative_to(folder).as_posix() for p in folder.rglob("*.dng") if folder / session.ASIDE not in p.parents}
    wrong += [f"{name} is there, and not in the logbook" for name in sorted(there - set(files))]
    for key, record in story.safe.items():
        try:
            stamp = read_stamp(folder / record["file"])
        except CaptureError as error:
            wrong.append(str(error))
            continue
        exposure = planned.get(key)
        if exposure and (
            stamp.moving
            or abs(stamp.place.angle_deg - exposure.angle_deg) > NEAR_DEG
            or abs(stamp.place.position_mm - exposure.position_mm) > NEAR_MM
        ):
            wrong.append(f"{record['file']} was taken at {stamp.place}{', moving' if stamp.moving else ''}; planned {exposure.place}")
    listed = [f for s in capture.sweeps for f in s.files]
    expected = [session.file_name(e, ".dng") for e in plan.exposures() if e.kind == plan.kind]
    if listed != expected:
        wrong.append(f"capture.json lists {len(listed)} photographs; expected {len(expected)} in the plan's order")
    return wrong


def describe(done: list[Trial]) -> list[tuple[str, str] | None]:
    """Rows (name, value) for people: a line a trial, and the sums."""
    rows: list = [
        (f"seed {t.seed}", f"{'; '.join(t.wrong) or 'proven'}   {', '.join(t.faults)}   ({t.kind}; {t.starts} starts, {t.shots} shots)") for t in done
    ]
    counts = {name: sum(t.faults.count(name) for t in done) for name in FAULTS}
    return [
        *rows,
        None,
        ("faults", f"{sum(counts.values())}: " + ", ".join(f"{n} {name}" for name, n in counts.items())),
        ("captures", f"{len(done)}, of which {sum(not t.wrong for t in done)} are proven"),
        ("shots", f"{sum(t.shots for t in done)}, of which {sum(t.moved for t in done)} while the stage moved"),
    ]


# ---- who runs a trial ------------------------------------------------------------------------------------------------


class _Trial:
    """The world around a session: starts it, breaks things, puts them right."""

    def __init__(self, folder, controller: Controller, config: StageConfig, cable: bool, params: FaultParams, rng: random.Random):
        self.folder, self.controller, self.config, self.params, self.rng = folder, controller, config, params, rng
        self.starts, self.child, self.paused = 0, None, False
        self.tether = Tether(folder, controller, config, params) if cable else None
        told = {
            "folder": str(folder), "controller": asdict(controller), "stage": asdict(config), "cable": cable,
            "plan": asdict(params.plan), "speed": params.speed,
        }  # fmt: skip
        (folder / "session.json").write_text(json.dumps(told), encoding="utf-8")

    def run(self, faults: tuple[str, ...]) -> list[str]:
        """Run the session to its end, with all faults on its way. What went wrong with that."""
        total, until = len(self.params.plan), time.monotonic() + TRIAL_S
        after = sorted(self.rng.randrange(0, total - 1) for _ in faults)
        left = list(zip(after, faults, strict=True))
        if self.tether:
            self.tether.start()
        try:
            while True:
                if self.child is None or self.child.poll() is not None:
                    if self.child is not None and self.child.returncode == 0:
                        if not left and not (self.folder / "camera").exists():
                            return []
                        (self.folder / "repeat").write_text(str(self.rng.randrange(len(self.params.plan.angles_deg))))  # faults are left
                        left = [(self._safe() + 1 + i, fault) for i, (_, fault) in enumerate(left)]
                    if self.starts == MOST_STARTS:
                        return [f"the session ended {MOST_STARTS} times: {self._said()}"]
                    self._start()
                if time.monotonic() > until:
                    return [f"not done after {TRIAL_S:g} s: {self._said()}"]
                if left and self._safe() >= left[0][0]:
                    time.sleep(self.rng.uniform(0, 0.15))
                    self._inject(left.pop(0)[1])
                time.sleep(0.005)
        finally:
            if self.child and self.child.poll() is None:
                self.child.kill()
                self.child.wait()
            if self.tether:
                self.tether.stop()

    def shots(self) -> list[tuple[float, float]]:
        """When the shutter was open."""
        if self.tether:
            return self.tether.shots
        log = self.folder / "shots.jsonl"
        return [tuple(json.loads(line)) for line in log.read_text().splitlines() if line.endswith("]")] if log.exists() else []

    def _start(self) -> None:
        code = (
            "import runpy, sys; runpy.run_path(sys.argv.pop(1), run_name='worker'); "
            "from strandscope.core.rig_faults import take; sys.exit(take(sys.argv[1]))"
        )
        with open(self.folder / "said.txt", "ab") as said:
            self.child = subprocess.Popen([sys.executable, "-c", code, str(WORKER), str(self.folder)], stdout=said, stderr=said)
        self.starts += 1

    def _said(self) -> str:
        lines = (self.folder / "said.txt").read_text(errors="replace").splitlines()
        return lines[-1] if lines else "nothing"

    def _safe(self) -> int:
        """How many photographs the logbook has as safe, counted in its bytes."""
        path = self.folder / "capture" / session.LOGBOOK
        return path.read_bytes().count(b'"what": "safe"') if path.exists() else 0

    def _inject(self, fault: str) -> None:
        match fault:
            case "cable":
                self.controller.pull_cable()
                time.sleep(self.rng.uniform(0.05, 0.5))
                self.controller.plug_in()
            case "alarm":
                self.controller.alarm(self.rng.choice((1, 2, 3)))
            case "garbage":
                for _ in range(5):
                    self.controller.garbage(self.rng.randrange(1, 200))
                    time.sleep(0.02)
            case "noise":
                self.controller.noise(0.02)
                time.sleep(self.rng.uniform(0.1, 0.5))
                self.controller.noise(0.0)
            case "silence":
                self.controller.silence(self.rng.uniform(0.1, 2.5))
            case "power":
                self.controller.power_cycle()
            case "reset button":
                self.controller.press("reset")
            case "hold button":
                self.controller.press("hold")
                time.sleep(self.rng.uniform(0.05, 0.4))
                self.controller.press("resume")
            case "kill":
                self.child.send_signal(signal.SIGKILL if os.name == "posix" else signal.SIGTERM)
                self.child.wait()
            case "disk full":
                (self.folder / "full").touch()
                time.sleep(self.rng.uniform(0.1, 0.5))
                (self.folder / "full").unlink()
            case _:
                until = time.monotonic() + 5.0
                while (self.folder / "camera").exists() and time.monotonic() < until:  # the one before has not been yet
                    time.sleep(0.01)
                (self.folder / "camera").write_text(fault)


class Tether(threading.Thread):
    """A camera on the controller's output, and the software that brings its photographs to a folder."""

    def __init__(self, folder: Path, controller: Controller, config: StageConfig, params: FaultParams):
        """``folder`` gets the folder ``watched``, and may hold a file ``camera`` with the fault of the next photograph."""
        super().__init__(name="tether", daemon=True)
        self.folder, self.controller, self.ended = folder, controller, threading.Event()
        self.watched = folder / "watched"
        self.watched.mkdir()
        self.camera = VirtualCamera(stamped(), SimulatedWorld(controller, config), VirtualCameraConfig(params.speed))
        self.camera.settings = CameraSettings(params.plan.shutter_s, params.plan.f_number, params.plan.iso)
        self.timers: list[threading.Timer] = []
        self.held_back: Path | None = None

    @property
    def shots(self) -> list[tuple[float, float]]:
        return list(self.camera.shots)

    def run(self) -> None:
        seen = 0
        while not self.ended.wait(0.002):
            switched = [when for when, _, on in self.controller.switched() if on]
            for _ in switched[seen:]:
                self._photograph()
            seen = len(switched)

    def stop(self) -> None:
        self.ended.set()
        self.join()
        for timer in self.timers:
            timer.join()

    def _photograph(self) -> None:
        number = len(self.camera.shots) + 1
        new = self.watched / f".{number:04d}.dng"
        self.camera.expose(new)
        path, fault = self.watched / f"DSC_{number:04d}.dng", _once(self.folder / "camera")
        match fault:
            case "slow":  # beyond all waiting, half the time
                self._later(0.3 + 1.2 * (number % 2), new, path)
            case "cut short":
                data = new.read_bytes()
                path.write_bytes(data[: len(data) * (number % 3) // 3])
                if number % 2:
                    self._later(0.2, new, path)
            case "wrong order":  # it comes with the next
                self.held_back = new
                return
            case _:
                os.replace(new, path)
        if self.held_back:
            os.replace(self.held_back, self.watched / f"DSC_{self.held_back.name.lstrip('.')}")
            self.held_back = None

    def _later(self, seconds: float, new: Path, path: Path) -> None:
        self.timers.append(threading.Timer(seconds, os.replace, (new, path)))
        self.timers[-1].start()


def _once(path: Path) -> str:
    """What a file says, which is then removed; empty where there is none."""
    try:
        text = path.read_text()
        path.unlink()
    except OSError:
        return ""
    return text


# ---- the session's process -------------------------------------------------------------------------------------------


def take(folder: str) -> int:
    """Take the capture of a trial, in this process; returns its exit code."""
    told = json.loads((Path(folder) / "session.json").read_text(encoding="utf-8"))
    plan = Plan(**{name: tuple(value) if isinstance(value, list) else value for name, value in told["plan"].items()})
    controller, config = Controller(**told["controller"]), StageConfig(**told["stage"])
    repeat = tuple(int(text) for text in [_once(Path(folder) / "repeat")] if text)
    params = SessionParams(patience_s=30.0, retry_s=0.05, attempts=6, reserve_bytes=0)
    if os.name == "posix":
        threading.Thread(target=_fill_disk, args=(Path(folder) / "full",), daemon=True).start()
    try:
        with Stage.open(config) as stage:
            if told["cable"]:
                quick = CableConfig(pulse_s=0.2, wait_s=0.5, late_s=0.4, quiet_s=0.03, poll_s=0.005)
                camera = CableCamera(stage, Path(folder) / "watched", quick)
            else:
                camera = _FaultyCamera(Path(folder), SimulatedWorld(controller, config), told["speed"])
            session.run(plan, stage, camera, Path(folder) / "capture", params=params, repeat=repeat)
    except StrandscopeError as error:
        print(f"{type(error).__name__}: {error}")
        return 1
    return 0


class _FaultyCamera(VirtualCamera):
    """A camera on USB with the faults that are asked for. Its shots are noted in a file."""

    def __init__(self, folder: Path, world: SimulatedWorld, speed: float):
        super().__init__(stamped(), world, VirtualCameraConfig(speed))
        self.folder, self.last = folder, b""

    def capture(self, exposure: Exposure, folder: Path) -> CapturedFile:
        captured = super().capture(exposure, folder)
        with open(self.folder / "shots.jsonl", "a") as log:
            log.write(json.dumps(self.shots[-1]) + "\n")
        data = captured.path.read_bytes()
        match _once(self.folder / "camera"):
            case "slow":
                time.sleep(0.7)
            case "cut short":
                captured.path.write_bytes(data[: len(data) * (len(self.shots) % 3) // 3])
            case "wrong order":
                captured.path.write_bytes(self.last or data)
        self.last = data
        return captured


def _fill_disk(full: Path) -> None:
    """While a file is there, nothing that is longer than a little can be written: as on a disk that is full."""
    import resource

    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    was = False
    while True:
        now = full.exists()
        if now != was:
            resource.setrlimit(resource.RLIMIT_FSIZE, (2000 if now else hard, hard))
            was = now
        time.sleep(0.01)


def main(argv: list[str] | None = None) -> int:
    """``python -m strandscope.core.rig_faults FOLDER``: inject faults, and print what came of them. 1 if a capture is not proven."""
    import argparse

    parser = argparse.ArgumentParser(prog="rig_faults", description="Virtual captures with faults, and a proof of what is left of them.")
    parser.add_argument("folder", type=Path, help="where captures are made; those that are not proven stay there")
    parser.add_argument("--faults", type=int, default=FaultParams.faults, help="how many, in all")
    parser.add_argument("--seed", type=int, default=0, help="another number gives other moments")
    given = parser.parse_args(argv)
    done = []
    for trial in trials(given.folder, FaultParams(given.faults, seed=given.seed)):
        done.append(trial)
        name, what = describe([trial])[0]
        print(f"{name}  {what}", flush=True)
    print("\n".join(f"{name:<10}{what}" for name, what in describe(done)[-3:]))
    return int(any(trial.wrong for trial in done))


if __name__ == "__main__":
    sys.exit(main())
