"""A camera for those who have none: it photographs simulated hair as it stands on the simulated stage.

Where the stage is, it asks the machine that the controller's simulator moves, not the program that sends the commands: what the
session believes and what the photographs show are independent of each other, as they are on a real rig.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache
from pathlib import Path

import numpy as np

from .files import explain
from .geometry import Optics
from .groom import groom
from .raw import Shot, read_planes, write_dng
from .rig.camera import CameraSettings, CapturedFile, Tell, temporary
from .rig.plan import Exposure, Place, Plan
from .rig.session import Setup
from .simulate import BLACK, WHITE, Drawing, SimulateParams, Studio, lock_params, prepare, studio

Where = Callable[[], tuple[Place, bool]]  # where the machine truly is, and whether it moves
Photographer = Callable[[Place, CameraSettings, int], np.ndarray]  # place, settings, number of the shot -> mosaic (2H, 2W) uint16
STAMP = 6  # numbers in the first row of a stamped photograph
BASE = 10_000


@dataclass(frozen=True)
class VirtualCameraConfig:
    """How the virtual camera behaves."""

    time_factor: float = 1.0  # its shutter is open for so many times less
    seed: int = 0


class VirtualCamera:
    """A camera that renders what it sees; see ``rig.camera.Camera``."""

    def __init__(self, photographer: Photographer, where: Where, config: VirtualCameraConfig = VirtualCameraConfig()):
        self.photographer, self.where, self.config = photographer, where, config
        self.tell: Tell = lambda _line: None
        self.settings = CameraSettings(0.25, 2.8, 100)
        self.shots = 0
        self.moved = 0  # photographs during which the stage moved

    def prepare(self, settings: CameraSettings) -> list[str]:
        self.settings = settings
        return [f"virtual camera: 1/{1 / settings.shutter_s:g} s, f/{settings.f_number:g}, ISO {settings.iso:g}"]

    def check(self) -> list[str]:
        return []

    def capture(self, exposure: Exposure, folder: Path) -> CapturedFile:
        path = temporary(folder, exposure, ".dng")
        self.expose(path)
        return CapturedFile(path, f"VIRT{self.shots:04d}.DNG")

    def expose(self, path: Path) -> None:
        """Open the shutter now, and leave the photograph in ``path``."""
        self.shots += 1
        taken = datetime.now()
        begin, moves = self.where()
        time.sleep(self.settings.shutter_s / self.config.time_factor)
        end, still_moves = self.where()
        mosaic = self.photographer(begin, self.settings, self.shots)
        if moves or still_moves or begin != end:
            self.moved += 1
            mosaic = ((mosaic.astype(np.uint32) + self.photographer(end, self.settings, self.shots)) // 2).astype(np.uint16)
        try:
            write_dng(path, mosaic, BLACK, WHITE, Shot(taken, self.settings.shutter_s, self.settings.f_number))
        except OSError as error:
            raise explain(error, path) from error

    def preview(self) -> np.ndarray:
        """The live picture (H, W) float32 of green: what is seen now."""
        place, _ = self.where()
        mosaic = self.photographer(place, self.settings, self.shots)
        return (mosaic[::2, 1::2].astype(np.float32) - BLACK) / (WHITE - BLACK)

    def safe(self, captured: CapturedFile) -> None:
        """It has no card."""

    def close(self) -> None:
        """Nothing is held."""


def photographer(camera: Studio) -> Photographer:
    """Photographs of a studio's hair at any place; the hair is turned and shaded once an angle."""
    lock, turned = threading.Lock(), lru_cache(4)(camera.at)

    def take(place: Place, settings: CameraSettings, number: int) -> np.ndarray:
        with lock:
            drawn: Drawing = turned(round(place.angle_deg, 3))
        rng = np.random.default_rng([camera.params.seed, 3, number, round(1000 * place.angle_deg) % 2**32, round(1000 * place.position_mm) % 2**32])
        return camera.mosaic(drawn, place.position_mm, settings.f_number, rng)

    return take


def virtual_studio(params: SimulateParams) -> Studio:
    """Simulated hair, ready to be photographed through optics that are as they should be."""
    scale = params.size
    optics = Optics(params.working_distance_mm, params.pitch_mm, (scale.columns - 1) / 2, (scale.rows - 1) / 2, params.aperture_cone_deg)
    hair = prepare(groom(lock_params(params), np.random.default_rng([params.seed, 0])), np.random.default_rng([params.seed, 1]))
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


# ---- photographs that tell where they were taken ---------------------------------------------------------------------


@dataclass(frozen=True)
class Stamp:
    """What a stamped photograph says of itself."""

    place: Place
    moving: bool


def stamped(where: Where, rows: int = 24, columns: int = 32, seed: int | None = None) -> Photographer:
    """Photographs (2 rows, 2 columns) of noise that say in their first row where the machine truly was: to prove captures with.

    ``where`` is asked at the time of the shot, whether it moves.
    """
    noise = np.random.default_rng(seed)

    def take(place: Place, _settings: CameraSettings, number: int) -> np.ndarray:
        mosaic = noise.integers(BLACK, BLACK + 3000, (2 * rows, 2 * columns)).astype(np.uint16)
        angle, position = round(1000 * place.angle_deg) + BASE * BASE // 2, round(1000 * place.position_mm) + BASE * BASE // 2
        values = [*divmod(angle, BASE), *divmod(position, BASE), int(where()[1]), number % BASE]
        mosaic[0, : 2 * STAMP : 2] = np.array(values) + BLACK
        return mosaic

    return take


def read_stamp(path: Path) -> Stamp:
    """What a stamped photograph says. Raises CaptureError where it cannot be read."""
    red = read_planes(path, "R")[0, 0, :STAMP]
    n = [round(float(value) * (WHITE - BLACK)) for value in red]
    whole = BASE * BASE // 2
    return Stamp(Place((n[0] * BASE + n[1] - whole) / 1000, (n[2] * BASE + n[3] - whole) / 1000), bool(n[4]))
