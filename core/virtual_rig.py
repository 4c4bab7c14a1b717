"""A camera for those who have none: it photographs simulated hair as it stands on the simulated stage.

Where the stage is, it asks the machine that the controller's simulator moves, not the program that sends the commands: what the
session believes and what the photographs show are independent of each other, as they are on a real rig.
"""

import json
import os
import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import datetime
from functools import lru_cache
from pathlib import Path
from typing import Protocol

import numpy as np

from .capture import Capture, Sweep
from .files import explain
from .geometry import Optics
from .groom import Groom, groom
from .progress import Progress, silent
from .raw import Shot, read_planes, write_dng
from .rig import desk
from .rig.attach import RIG, Orders, Setup
from .rig.camera import CameraSettings, CapturedFile, Tell, temporary
from .rig.controller import Controller, ControllerConfig, stage_config, start_controller
from .rig.plan import SWEEP, Exposure, Place, Plan
from .rig.session import SessionParams, run
from .rig.stage import Stage
from .rig.wiring import StageConfig
from .simulate import BLACK, JOURNAL, WHITE, Drawing, Scale, SimulateParams, Studio, begin, lock_params, prepare, studio, take_truth

HAIR = f"{RIG}/virtual"
Photographer = Callable[[Place, CameraSettings, int, bool], np.ndarray]
"""Place, settings, number of the shot, and whether the stage moved meanwhile -> mosaic (2H, 2W) uint16."""
STAMP = 6  # numbers in the first row of a stamped photograph
BASE = 10_000


@dataclass(frozen=True)
class VirtualCameraConfig:
    """How the virtual camera behaves."""

    time_factor: float = 1.0  # its shutter is open for so many times less
    seed: int = 0


class World(Protocol):
    """The machine as it truly is."""

    def place(self) -> Place:
        """Where it stands."""

    def moved(self, begin: float, end: float) -> bool:
        """Whether it moved between two times of ``time.monotonic()``."""


@dataclass(frozen=True)
class SimulatedWorld:
    """The machine that a simulated controller moves."""

    controller: Controller
    config: StageConfig

    def place(self) -> Place:
        return self.controller.place(self.config)

    def moved(self, begin: float, end: float) -> bool:
        return self.controller.moved(begin, end)


class VirtualCamera:
    """A camera that renders what it sees; see ``rig.camera.Camera``."""

    def __init__(self, photographer: Photographer, world: World, config: VirtualCameraConfig = VirtualCameraConfig()):
        self.photographer, self.world, self.config = photographer, world, config
        self.tell: Tell = lambda _line: None
        self.settings = CameraSettings(0.25, 2.8, 100)
        self.shots: list[tuple[float, float]] = []  # when the shutter was open, in time.monotonic()

    def prepare(self, settings: CameraSettings) -> list[str]:
        self.settings = settings
        return [f"virtual camera: 1/{1 / settings.shutter_s:g} s, f/{settings.f_number:g}, ISO {settings.iso:g}"]

    def check(self) -> list[str]:
        return []

    def capture(self, exposure: Exposure, folder: Path) -> CapturedFile:
        path = temporary(folder, exposure, ".dng")
        self.expose(path)
        return CapturedFile(path, f"VIRT{len(self.shots):04d}.DNG")

    def expose(self, path: Path) -> None:
        """Open the shutter now, and leave the photograph in ``path``."""
        taken, begin, place = datetime.now(), time.monotonic(), self.world.place()
        time.sleep(self.settings.shutter_s / self.config.time_factor)
        end, number = time.monotonic(), len(self.shots) + 1
        self.shots.append((begin, end))
        moved = self.world.moved(begin, end)
        mosaic = self.photographer(place, self.settings, number, moved)
        if moved:  # it shows both places
            other = self.photographer(self.world.place(), self.settings, number, moved)
            mosaic = ((mosaic.astype(np.uint32) + other) // 2).astype(np.uint16)
        try:
            write_dng(path, mosaic, BLACK, WHITE, Shot(taken, self.settings.shutter_s, self.settings.f_number))
        except OSError as error:
            raise explain(error, path) from error

    def preview(self) -> np.ndarray:
        """The live picture (H, W) float32 of green: what is seen now."""
        mosaic = self.photographer(self.world.place(), self.settings, len(self.shots), False)
        return (mosaic[::2, 1::2].astype(np.float32) - BLACK) / (WHITE - BLACK)

    def safe(self, captured: CapturedFile) -> None:
        """It has no card."""

    def close(self) -> None:
        """Nothing is held."""


def photographer(camera: Studio) -> Photographer:
    """Photographs of a studio's hair at any place; the hair is turned and shaded once an angle."""
    lock, turned = threading.Lock(), lru_cache(4)(camera.at)

    def take(place: Place, settings: CameraSettings, number: int, _moved: bool) -> np.ndarray:
        with lock:
            drawn: Drawing = turned(round(place.angle_deg, 3))
        rng = np.random.default_rng([camera.params.seed, 3, number, round(1000 * place.angle_deg) % 2**32, round(1000 * place.position_mm) % 2**32])
        return camera.mosaic(drawn, place.position_mm, settings.f_number, rng)

    return take


def virtual_studio(params: SimulateParams, lock: Groom | None = None) -> Studio:
    """Simulated hair (``lock``, or that of ``params``), ready to be photographed through optics that are as they should be."""
    scale = params.size
    optics = Optics(params.working_distance_mm, params.pitch_mm, (scale.columns - 1) / 2, (scale.rows - 1) / 2, params.aperture_cone_deg)
    lock = lock or groom(lock_params(params), np.random.default_rng([params.seed, 0]))
    hair = prepare(lock, np.random.default_rng([params.seed, 1]))
    return studio(params, optics, hair)


def virtual_plan(params: SimulateParams) -> Plan:
    """The plan that photographs all of the simulated hair, as ``simulate`` does: with a camera that is quick."""
    scale = params.size
    count = round(2 * scale.half_range_mm / params.step_mm) + 1
    first = -round((count - 1) / 2 * params.step_mm, 6)
    angles = tuple(360.0 * k / scale.angles for k in range(scale.angles))
    size = 8 * scale.rows * scale.columns + 1000
    quick = {"settle_s": 0.1, "shutter_s": 0.125, "transfer_s": 0.1, "f_number": params.open_f_number, "bytes_each": size}
    return Plan(angles_deg=angles, first_mm=first, step_mm=params.step_mm, count=count, **quick)


def virtual_setup(params: SimulateParams) -> Setup:
    """What capture.json says of the virtual optics."""
    optics = {"working_distance_mm": params.working_distance_mm, "pitch_mm": params.pitch_mm, "aperture_cone_deg": params.aperture_cone_deg}
    return Setup(f"virtual {params.style} hair, seed {params.seed}", **optics)


@dataclass(frozen=True)
class VirtualParams:
    """A virtual rig: which hair hangs on it, and how fast its time goes."""

    hair: SimulateParams = field(default_factory=lambda: SimulateParams(scale="tiny"))
    speed: float = 20.0  # its time passes so many times as fast


def virtual_capture(
    folder: Path,
    params: VirtualParams = VirtualParams(),
    plan: Plan | None = None,
    session: SessionParams | None = None,
    *,
    repeat: tuple[int, ...] = (),
    orders: Orders | None = None,
    progress: Progress = silent,
    events: Callable[[dict], None] = lambda _event: None,
) -> Path:
    """Take a capture of simulated hair with the driver and the session of a real one, its controller being a simulator's process.

    ``plan`` None photographs all of the hair. ``truth.npz`` tells afterwards where the hair is. Raises as ``rig.session.run``.
    """
    folder, plan = Path(folder), plan or virtual_plan(params.hair)
    begin(folder / HAIR, params.hair)  # another hair does not go into the same folder
    lock = groom(lock_params(params.hair), np.random.default_rng([params.hair.seed, 0]))
    camera_of = virtual_studio(params.hair, lock)
    _truth(folder, plan, params.hair, lock, camera_of, progress)
    config = ControllerConfig(time_factor=params.speed)
    with start_controller(config) as controller:
        place = stage_config(controller.url, config)
        with Stage.open(place, lambda line: events({"event": "note", "message": line})) as stage:
            camera = VirtualCamera(photographer(camera_of), SimulatedWorld(controller, place), VirtualCameraConfig(params.speed))
            listeners = {"orders": orders, "progress": progress, "events": events}
            return run(plan, stage, camera, folder, virtual_setup(params.hair), session or SessionParams(), repeat=repeat, **listeners)


def virtual_by_hand(params: VirtualParams, plan: Plan | None, commands: Iterable[str], picture: Path, events: Callable[[dict], None]) -> None:
    """Move a virtual rig by commands, as ``rig.operate.by_hand`` moves a real one."""
    config = ControllerConfig(time_factor=params.speed)
    with start_controller(config) as controller:
        place = stage_config(controller.url, config)

        def camera() -> VirtualCamera:
            hair = photographer(virtual_studio(params.hair))
            return VirtualCamera(hair, SimulatedWorld(controller, place), VirtualCameraConfig(params.speed))

        with Stage.open(place) as stage:
            desk.attend(stage, camera, plan or virtual_plan(params.hair), commands, picture, events)


def hair_in(folder: Path) -> SimulateParams | None:
    """The hair that a virtual capture in ``folder`` photographs, None where there is none."""
    try:
        told = json.loads((Path(folder) / HAIR / JOURNAL).read_text(encoding="utf-8"))
        scale = told["scale"] if isinstance(told["scale"], str) else Scale(**told["scale"])
        return SimulateParams(told["style"], scale, told["fibers"], told["seed"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _truth(folder: Path, plan: Plan, params: SimulateParams, lock: Groom, camera: Studio, progress: Progress) -> None:
    sweeps = tuple(Sweep(angle, plan.positions_mm, ()) for angle in plan.angles_deg)
    capture = Capture(folder, "", camera.optics, sweeps, truth="truth.npz")
    if plan.kind == SWEEP and not capture.truth_path.is_file():
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            take_truth(capture, lock, camera.hair, params, progress, pool)


# ---- photographs that tell where they were taken ---------------------------------------------------------------------


@dataclass(frozen=True)
class Stamp:
    """What a stamped photograph says of itself."""

    place: Place
    moving: bool


def stamped(rows: int = 24, columns: int = 32, seed: int | None = None) -> Photographer:
    """Photographs (2 rows, 2 columns) of noise that say in their first row where the machine truly was: to prove captures with."""
    noise = np.random.default_rng(seed)

    def take(place: Place, _settings: CameraSettings, number: int, moved: bool) -> np.ndarray:
        mosaic = noise.integers(BLACK, BLACK + 3000, (2 * rows, 2 * columns)).astype(np.uint16)
        angle, position = round(1000 * place.angle_deg) + BASE * BASE // 2, round(1000 * place.position_mm) + BASE * BASE // 2
        values = [*divmod(angle, BASE), *divmod(position, BASE), int(moved), number % BASE]
        mosaic[0, : 2 * STAMP : 2] = np.array(values) + BLACK
        return mosaic

    return take


def read_stamp(path: Path) -> Stamp:
    """What a stamped photograph says. Raises CaptureError where it cannot be read."""
    red = read_planes(path, "R")[0, 0, :STAMP]
    n = [round(float(value) * (WHITE - BLACK)) for value in red]
    whole = BASE * BASE // 2
    return Stamp(Place((n[0] * BASE + n[1] - whole) / 1000, (n[2] * BASE + n[3] - whole) / 1000), bool(n[4]))
