"""A capture on disk: ``capture.json`` <-> frozen dataclasses, and its photographs as channel planes.

A capture is a folder with ``capture.json`` and photographs; nothing in it is rewritten by a later stage.
"""

import json
import os
import re
from dataclasses import MISSING, asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np

from .errors import CaptureError
from .files import atomic
from .geometry import Optics
from .raw import Mosaic, read_planes, reduced

FORMAT, VERSION = "strandscope-capture", 1
FILE_NAME = "capture.json"


def features_path(folder: Path, i: int) -> Path:
    """Where a folder, of a run or of a capture without photographs, has the features of sweep i."""
    return folder / f"sweep_{i:03d}.features"


@dataclass(frozen=True)
class Sweep:
    """The photographs of one turntable angle, in the order of the camera's positions."""

    angle_deg: float
    positions_mm: tuple[float, ...]  # d of each photograph: rotation axis to plane of focus, positive towards the camera
    files: tuple[str, ...]  # relative to the capture's folder, forward slashes
    gains: tuple[float, ...] = ()  # of each photograph: it has this many times the light it should have; empty: all alike


@dataclass(frozen=True)
class Turntable:
    """The validation sequence: well focused photographs at a small aperture."""

    f_number: float
    files: tuple[str, ...]
    angles_deg: tuple[float, ...]
    focus_mm: float


@dataclass(frozen=True)
class Capture:
    """All that ``capture.json`` says. ``unknown`` keeps the fields that this version does not know."""

    folder: Path
    name: str
    optics: Optics
    sweeps: tuple[Sweep, ...]
    turntable: Turntable | None = None
    truth: str | None = None
    mosaic: Mosaic | None = None
    features: str | None = None  # folder with features in place of photographs, which need not be there
    unknown: dict = field(default_factory=dict)
    averaged_px: int = 1  # pixels of a photograph, each way, that are one here; not in the file

    def planes(self, file: str, channels: str = "R") -> np.ndarray:
        """Channel planes (len(channels), H, W) float32 of one photograph, black 0, white 1; its gain is taken out. Raises CaptureError."""
        planes = reduced(read_planes(self.folder / file, channels, self.mosaic), self.averaged_px)
        gain = self.gains.get(file, 1.0)
        return planes if gain == 1.0 else planes / np.float32(gain)

    def reduced(self, by: int) -> "Capture":
        """The same capture, of whose photographs ``by`` times ``by`` pixels are averaged to one."""
        return self if by == 1 else replace(self, averaged_px=self.averaged_px * by, optics=self.optics.reduced(by))

    @cached_property
    def gains(self) -> dict[str, float]:
        """Gain of each photograph that has one, by its file."""
        return {file: gain for sweep in self.sweeps for file, gain in zip(sweep.files, sweep.gains, strict=False)}

    @cached_property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a channel plane, read off the first photograph, or the first features."""
        if self.features:
            with open(features_path(self.folder / self.features, 0), "rb") as file:
                return tuple(int(n) for n in np.load(file)[1:])
        return self.planes(self.sweeps[0].files[0]).shape[1:]

    @property
    def truth_path(self) -> Path | None:
        return self.folder / self.truth if self.truth else None


def load_capture(path: Path) -> Capture:
    """Read a capture from its folder or its ``capture.json``.

    Raises CaptureError, naming file, field and what was expected, for a field that is missing or wrong, a path that
    leaves the folder, and a photograph that is not there.
    """
    path = Path(path)
    if path.is_dir():
        path = path / FILE_NAME
    if not path.is_file():
        raise CaptureError(f"{path}: not found; expected a capture folder with a {FILE_NAME} in it (`strandscope import` makes one)")
    try:
        head = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:  # also for bytes that are not UTF-8
        raise CaptureError(f"{path}: not valid JSON: {error}") from error
    return _Reader(path).capture(head)


def save_capture(capture: Capture) -> Path:
    """Write ``capture.json`` into the capture's folder, atomically; returns its path."""
    head = {"format": FORMAT, "version": VERSION, "name": capture.name, "optics": asdict(capture.optics)}
    head["sweeps"] = [_sweep_json(sweep) for sweep in capture.sweeps]
    for key in ("turntable", "mosaic"):
        if getattr(capture, key) is not None:
            head[key] = asdict(getattr(capture, key))
    for key in ("truth", "features"):
        if getattr(capture, key):
            head[key] = getattr(capture, key)
    path = capture.folder / FILE_NAME
    with atomic(path) as part:
        part.write_text(json.dumps(head | capture.unknown, indent=1), encoding="utf-8")
    return path


def _sweep_json(sweep: Sweep) -> dict:
    positions = np.asarray(sweep.positions_mm)
    step = round((positions[-1] - positions[0]) / max(len(positions) - 1, 1), 9)
    even = np.allclose(positions, positions[0] + step * np.arange(len(positions)), rtol=0, atol=1e-7)
    where = {"first_mm": float(positions[0]), "step_mm": float(step)} if even else {"positions_mm": list(sweep.positions_mm)}
    gains = {"gains": list(sweep.gains)} if sweep.gains else {}
    return {"angle_deg": sweep.angle_deg, **where, "files": list(sweep.files), **gains}


class _Reader:
    """Turns the JSON of one file into dataclasses; every complaint names the file and the field."""

    def __init__(self, path: Path):
        self.path = path

    def capture(self, head) -> Capture:
        self._expect(isinstance(head, dict), "the whole file", head, "an object")
        self._expect(head.get("format") == FORMAT, "format", head.get("format"), f'"{FORMAT}"')
        self._expect(head.get("version") == VERSION, "version", head.get("version"), f"{VERSION} (made by a newer Strandscope?)")
        optics = self._record(Optics, self._get(head, "optics", dict, "an object"), "optics")
        for name in ("working_distance_mm", "pitch_mm", "aperture_cone_deg"):
            self._expect(getattr(optics, name) > 0, f"optics.{name}", getattr(optics, name), "more than 0")
        sweeps = self._get(head, "sweeps", list, "a list of sweeps")
        self._expect(len(sweeps) > 0, "sweeps", sweeps, "at least one sweep")
        capture = Capture(
            folder=self.path.parent,
            name=str(head.get("name", self.path.parent.name)),
            optics=optics,
            sweeps=tuple(self._sweep(sweep, f"sweeps[{i}]") for i, sweep in enumerate(sweeps)),
            turntable=self._turntable(head["turntable"]) if head.get("turntable") else None,
            truth=self._file(head["truth"], "truth") if head.get("truth") else None,
            mosaic=self._mosaic(head["mosaic"]) if head.get("mosaic") else None,
            features=self._file(head["features"], "features") if head.get("features") else None,
            unknown={k: v for k, v in head.items() if k not in {"format", "version"} | {f.name for f in fields(Capture) if f.name != "averaged_px"}},
        )
        self._all_there(capture)
        return capture

    def _sweep(self, sweep, where: str) -> Sweep:
        self._expect(isinstance(sweep, dict), where, sweep, "an object")
        files = self._files(self._get(sweep, "files", list, "a list of file names", where), f"{where}.files")
        if "positions_mm" in sweep:
            positions = self._numbers(sweep["positions_mm"], f"{where}.positions_mm")
            self._expect(len(positions) == len(files), f"{where}.positions_mm", f"{len(positions)} numbers", f"{len(files)}, one a file")
        else:
            first, step = (self._number(self._get(sweep, k, object, "a number", where), f"{where}.{k}") for k in ("first_mm", "step_mm"))
            self._expect(step != 0 or len(files) == 1, f"{where}.step_mm", step, "a step other than 0")
            positions = tuple(first + step * i for i in range(len(files)))
        gains = self._numbers(sweep["gains"], f"{where}.gains") if "gains" in sweep else ()
        self._expect(len(gains) in (0, len(files)), f"{where}.gains", f"{len(gains)} numbers", f"{len(files)}, one a file")
        self._expect(all(gain > 0 for gain in gains), f"{where}.gains", list(gains), "numbers more than 0")
        return Sweep(self._number(self._get(sweep, "angle_deg", object, "degrees", where), f"{where}.angle_deg"), positions, files, gains)

    def _turntable(self, table) -> Turntable:
        self._expect(isinstance(table, dict), "turntable", table, "an object")
        files = self._files(self._get(table, "files", list, "a list of file names", "turntable"), "turntable.files")
        angles = self._numbers(self._get(table, "angles_deg", list, "degrees", "turntable"), "turntable.angles_deg")
        self._expect(len(angles) == len(files), "turntable.angles_deg", f"{len(angles)} angles", f"{len(files)}, one a file")
        f_number = self._number(self._get(table, "f_number", object, "a number", "turntable"), "turntable.f_number")
        return Turntable(f_number, files, angles, self._number(table.get("focus_mm", 0.0), "turntable.focus_mm"))

    def _mosaic(self, mosaic) -> Mosaic:
        self._expect(isinstance(mosaic, dict), "mosaic", mosaic, "an object")
        pattern = self._get(mosaic, "pattern", str, 'a pattern such as "RGGB"', "mosaic")
        self._expect(sorted(pattern) == list("BGGR"), "mosaic.pattern", pattern, 'a pattern such as "RGGB"')
        black, white = (self._number(self._get(mosaic, k, object, "a number", "mosaic"), f"mosaic.{k}") for k in ("black", "white"))
        self._expect(0 <= black < white <= 65535, "mosaic.white", white, f"more than black ({black:g}), at most 65535")
        return Mosaic(pattern, int(black), int(white))

    def _record(self, kind, values: dict, where: str):
        asked = [f.name for f in fields(kind) if f.name in values or f.default is MISSING]
        return kind(**{name: self._number(self._get(values, name, object, "a number", where), f"{where}.{name}") for name in asked})

    def _get(self, values: dict, name: str, kind: type, expected: str, where: str = ""):
        full = f"{where}.{name}" if where else name
        if name not in values:
            raise CaptureError(f"{self.path}: {full} is missing; expected {expected}")
        self._expect(isinstance(values[name], kind), full, values[name], expected)
        return values[name]

    def _number(self, value, where: str) -> float:
        good = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e12  # not NaN either
        self._expect(good, where, value, "a number")
        return float(value)

    def _numbers(self, values, where: str) -> tuple[float, ...]:
        self._expect(isinstance(values, list), where, values, "a list of numbers")
        return tuple(self._number(value, f"{where}[{i}]") for i, value in enumerate(values))

    def _files(self, names: list, where: str) -> tuple[str, ...]:
        self._expect(len(names) > 0, where, names, "at least one file")
        files = tuple(self._file(name, f"{where}[{i}]") for i, name in enumerate(names))
        self._expect(len(set(files)) == len(files), where, "a file listed twice", "each file once")
        return files

    def _file(self, name, where: str) -> str:
        expected = "a path inside the capture's folder, with forward slashes"
        self._expect(isinstance(name, str) and name != "", where, name, expected)
        self._expect(not re.search(r"[\x00-\x1f\x7f\ud800-\udfff]", name), where, name, expected)
        outside = ".." in PurePosixPath(name).parts or PurePosixPath(name).is_absolute() or PureWindowsPath(name).drive
        self._expect(not outside and "\\" not in name, where, name, expected)
        inside = (self.path.parent / name).resolve().is_relative_to(self.path.parent.resolve())
        self._expect(inside, where, name, f"{expected} (a link leads out of it)")
        return name

    def _all_there(self, capture: Capture) -> None:
        for i, sweep in enumerate(capture.sweeps):
            if capture.features:
                path = features_path(capture.folder / capture.features, i)
                if not path.is_file():
                    raise CaptureError(f"{self.path}: {len(capture.sweeps)} sweeps have features in place of photographs; missing {path.name}")
                continue
            missing = [name for name in sweep.files if not os.path.isfile(capture.folder / name)]  # False for a name that is too long, too
            if missing:
                raise CaptureError(
                    f"{self.path}: the sweep at {sweep.angle_deg:g}° lists {len(sweep.files)} files, "
                    f"{len(sweep.files) - len(missing)} are there; missing {missing[0]}"
                )

    def _expect(self, good: bool, where: str, found, expected: str) -> None:
        if not good:
            shown = found if isinstance(found, str) and found.isprintable() else json.dumps(found, default=str)
            raise CaptureError(f"{self.path}: {where} is {shown[:60]}; expected {expected}")
