"""Cameras: one that libgphoto2 talks to, and any other by a shutter cable and the folder that its photographs appear in.

A photograph is handed over as a file of its own under a temporary name. What is on the card, or in the folder, is deleted only
after the session has said that its copy is safe.
"""

import math
import os
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ..errors import CaptureError, StrandscopeError
from ..files import explain, sha256
from ..raw import LINEAR_SUFFIXES, RAW_SUFFIXES, read_header
from .plan import Exposure, Plan

Tell = Callable[[str], None]  # takes a line for people


class CameraError(StrandscopeError):
    """The camera did not do what was asked."""


class CameraGone(CameraError):
    """Nothing answers: off, unplugged, or held by another program."""


class CameraAsleep(CameraError):
    """The camera is there but does not photograph now: it sleeps, is busy, or its battery or card is at its end."""


class PhotographLate(CameraError):
    """The shutter was fired and no photograph came in time. The same exposure may be taken again where the stage stands."""


@dataclass(frozen=True)
class CameraSettings:
    """What the camera is set to for all photographs of a plan."""

    shutter_s: float
    f_number: float
    iso: float
    raw: bool = True  # raw files; processed ones are not linear


def settings_of(plan: Plan) -> CameraSettings:
    """The settings that a plan asks for."""
    return CameraSettings(plan.shutter_s, plan.f_number, plan.iso)


@dataclass(frozen=True)
class CapturedFile:
    """A photograph on disk, not yet looked at."""

    path: Path  # under a temporary name
    name: str  # what the camera calls it
    origin: Any = None  # where the camera still has it; for ``safe``


class Camera(Protocol):
    """What a session asks of a camera. All raise CameraError with what is wrong and what to do."""

    tell: Tell  # takes what people should know while it works

    def prepare(self, settings: CameraSettings) -> list[str]:
        """Connect, and set what can be set. Returns lines for people: what was set, and what they must set themselves."""

    def check(self) -> list[str]:
        """Be ready to photograph, connecting again where need be. Returns warnings, as of a battery that is low."""

    def capture(self, exposure: Exposure, folder: Path) -> CapturedFile:
        """Take one photograph, and return when all its bytes are in ``folder`` under a temporary name."""

    def safe(self, captured: CapturedFile) -> None:
        """The photograph is safe; the camera's own copy may be deleted."""

    def close(self) -> None:
        """Let go of the camera."""


def temporary(folder: Path, exposure: Exposure, suffix: str) -> Path:
    """Where the bytes of an exposure go until they are known to be good."""
    return folder / f".{exposure.kind}_{exposure.sweep:03d}_{exposure.frame:04d}.part{suffix.lower()}"


# ---- libgphoto2 ------------------------------------------------------------------------------------------------------

# What makers call the same thing; the first that a body has is used.
APERTURE = ("aperture", "f-number")
SHUTTER = ("shutterspeed", "shutterspeed2", "exptime")
ISO = ("iso", "isospeed")
QUALITY = ("imageformat", "imagequality")
MODE = ("autoexposuremode", "expprogram", "exposuremode")
FOCUS = ("focusmode", "autofocus", "focusmode2")
BATTERY = ("batterylevel",)
TARGET = ("capturetarget",)
MOST_EVENTS = 50
LOW_BATTERY = 25  # percent
NEAR_STOPS, FAR_STOPS = 0.2, 0.75  # a choice this far from what was asked is said, or refused


@dataclass(frozen=True)
class GphotoConfig:
    """How a camera is used through libgphoto2."""

    model: str = ""  # a part of its name, where several are connected
    keep_on_card: bool = False  # do not delete photographs on the card once they are safe
    wait_s: float = 30.0  # for the second file of bodies that write two


def find_cameras() -> list[tuple[str, str]]:
    """(model, port) of the cameras that libgphoto2 sees. Raises StrandscopeError where it is not installed."""
    gp = _gphoto2()
    found = gp.Camera.autodetect()
    return [(found.get_name(i), found.get_value(i)) for i in range(found.count())]


class GphotoCamera:
    """A camera through libgphoto2; see ``Camera``."""

    def __init__(self, config: GphotoConfig = GphotoConfig(), tell: Tell = lambda _line: None):
        self.config, self.tell = config, tell
        self._gp = _gphoto2()
        self._camera = None
        self._settings: CameraSettings | None = None

    def prepare(self, settings: CameraSettings) -> list[str]:
        self._settings = settings
        self._connect()
        return self._set_up(settings)

    def check(self) -> list[str]:
        if self._camera is None:
            self._connect()
            if self._settings:
                for line in self._set_up(self._settings):
                    self.tell(line)
        battery = _value(self._offered(), BATTERY)
        percent = re.match(r"\s*(\d+)\s*%", battery or "")
        if (percent and int(percent[1]) <= LOW_BATTERY) or (battery or "").strip().lower() in ("low", "empty"):
            return [f"the camera's battery is at {battery}; a capture takes hours: use its mains adapter"]
        return []

    def capture(self, exposure: Exposure, folder: Path) -> CapturedFile:
        if self._camera is None:
            self._connect()
        raw = self._settings is None or self._settings.raw
        with self._explained("photographing"):
            self._drain()
            places = [self._camera.capture(self._gp.GP_CAPTURE_IMAGE)]
            if raw and Path(places[0].name).suffix.lower() in (".jpg", ".jpeg"):  # one of two, where a body is set to write both
                places += self._more_files()
            place = next((p for p in places if Path(p.name).suffix.lower() in RAW_SUFFIXES), places[0])
            part = temporary(folder, exposure, Path(place.name).suffix)
            file = self._camera.file_get(place.folder, place.name, self._gp.GP_FILE_TYPE_NORMAL)
            data = file.get_data_and_size()  # belongs to ``file``, which must outlive it
            _write(part, memoryview(data))
            del data
        return CapturedFile(part, place.name, tuple((p.folder, p.name) for p in places))

    def safe(self, captured: CapturedFile) -> None:
        if self.config.keep_on_card:
            return
        for folder, name in captured.origin:
            try:
                self._camera.file_delete(folder, name)
            except self._gp.GPhoto2Error as error:  # it stays, which harms nobody until the card is full
                self.tell(f"{name} could not be deleted on the camera's card ({error}); see that the card has room")

    def preview(self) -> np.ndarray:
        """The live picture (rows, columns) float32, 0…1, of green, as the camera renders it: for framing, not for measuring."""
        if self._camera is None:
            self._connect()
        with self._explained("showing its live picture"):
            file = self._camera.capture_preview()
            data = bytes(memoryview(file.get_data_and_size()))
        from skimage.io import imread

        picture = imread(data, plugin="imageio")
        return np.asarray(picture[..., 1] if picture.ndim == 3 else picture, np.float32) / 255

    def close(self) -> None:
        camera, self._camera = self._camera, None
        if camera is not None:
            try:
                camera.exit()
            except self._gp.GPhoto2Error:  # it is gone already
                return

    def _connect(self) -> None:
        self.close()
        found = find_cameras()
        fitting = [(model, port) for model, port in found if self.config.model.lower() in model.lower()]
        if not fitting:
            seen = ", ".join(model for model, _ in found) or "none"
            wanted = f" {self.config.model!r}" if self.config.model else ""
            raise CameraGone(f"no camera{wanted} was found (found: {seen}); switch it on, check its USB cable, and close programs that use it")
        gp, (model, port) = self._gp, fitting[0]
        with self._explained(f"connecting to {model}"):
            ports, kinds = gp.PortInfoList(), gp.CameraAbilitiesList()
            ports.load()
            kinds.load()
            camera = gp.Camera()
            camera.set_port_info(ports[ports.lookup_path(port)])
            camera.set_abilities(kinds[kinds.lookup_model(model)])
            camera.init()
            self._camera = camera

    def _set_up(self, settings: CameraSettings) -> list[str]:
        config, lines = self._offered(), []
        mode = _value(config, MODE)
        if mode is not None and mode.strip().lower() not in ("m", "manual", "bulb"):
            raise CameraError(f"the camera is in mode {mode!r}; turn its dial to M (manual), so that no photograph differs in exposure")
        for what, names, asked, read in (
            ("aperture", APERTURE, settings.f_number, read_f_number),
            ("shutter", SHUTTER, settings.shutter_s, read_shutter_s),
            ("ISO", ISO, settings.iso, read_iso),
        ):
            widget = _find(config, names)
            if widget is None:
                lines.append(f"{what}: the camera does not let it be set; set it on the camera itself ({asked:g})")
            else:
                lines.append(f"{what}: {self._choose(widget, what, asked, read)}")
        if settings.raw:
            lines.append(self._choose_raw(_find(config, QUALITY)))
        for names, wanted in ((TARGET, ("Memory card", "card")), (FOCUS, ("Manual", "MF", "Off"))):
            widget = _find(config, names)
            choice = next((c for w in wanted for c in _choices(widget) if c.lower() == w.lower()), None)
            if choice:
                self._set(widget, choice)
            elif names is FOCUS:
                lines.append("focus: switch the lens to manual focus (MF)")
        return lines

    def _choose(self, widget, what: str, asked: float, read: Callable[[str], float | None]) -> str:
        choice, stops = nearest_choice(_choices(widget), asked, read)
        if choice is None or stops > FAR_STOPS:
            offered = ", ".join(_choices(widget)) or "nothing"
            raise CameraError(f"{what} {asked:g} cannot be set; the camera offers {offered}. Change the plan, or the lens")
        self._set(widget, choice)
        return choice if stops <= NEAR_STOPS else f"{choice}, the nearest to {asked:g} of {', '.join(_choices(widget))}"

    def _choose_raw(self, widget) -> str:
        choice = raw_choice(_choices(widget))
        if choice is None:
            offered = ", ".join(_choices(widget)) or "nothing"
            return f"quality: the camera offers {offered}; set it to raw on the camera itself"
        self._set(widget, choice)
        return f"quality: {choice}"

    def _set(self, widget, choice: str) -> None:
        if widget.get_readonly():
            if str(widget.get_value()) != choice:
                raise CameraError(f"the camera does not let {widget.get_label()} be set from here; set it to {choice} on the camera itself")
            return
        with self._explained(f"setting {widget.get_label()} to {choice}"):
            widget.set_value(choice)
            self._camera.set_single_config(widget.get_name(), widget)

    @contextmanager
    def _explained(self, doing: str) -> Iterator[None]:
        """What libgphoto2 raises inside is raised as a CameraError in words; a camera that is gone is let go of."""
        gp = self._gp
        try:
            yield
        except gp.GPhoto2Error as error:
            code, what = error.code, f"{doing}: the camera says {error.string!r}"
            if code == gp.GP_ERROR_NO_SPACE:
                raise CameraAsleep(f"{what}; its card is full: change or empty it") from error
            if code == gp.GP_ERROR_NOT_SUPPORTED:
                raise CameraError(f"{what}; this body cannot do that through libgphoto2: use a shutter cable and a watched folder") from error
            self.close()
            if code == gp.GP_ERROR_IO_USB_CLAIM:
                raise CameraGone(f"{what}; another program holds it (a photo importer, the file manager's mount): close it there") from error
            if code in (gp.GP_ERROR_TIMEOUT, gp.GP_ERROR_CAMERA_BUSY):
                raise CameraAsleep(f"{what}; wake it, and switch its automatic power-off off") from error
            raise CameraGone(f"{what} ({code}); is it switched on, awake, and its cable plugged in?") from error

    def _offered(self):
        with self._explained("asking for its settings"):
            return self._camera.get_config()

    def _drain(self) -> None:
        """Take what the camera still has to say of earlier photographs, so that it is not taken for news of the next."""
        for _ in range(MOST_EVENTS):
            if self._camera.wait_for_event(1)[0] == self._gp.GP_EVENT_TIMEOUT:
                return

    def _more_files(self) -> list:
        """Further files of the last photograph."""
        more, until = [], time.monotonic() + self.config.wait_s
        while time.monotonic() < until:
            kind, what = self._camera.wait_for_event(300)
            if kind == self._gp.GP_EVENT_FILE_ADDED:
                more.append(what)
            elif kind in (self._gp.GP_EVENT_TIMEOUT, self._gp.GP_EVENT_CAPTURE_COMPLETE):
                break
        return more


def gphoto_camera(config: GphotoConfig = GphotoConfig(), tell: Tell = lambda _line: None) -> GphotoCamera:
    """A camera through libgphoto2, not connected yet. Raises StrandscopeError where it is not installed."""
    return GphotoCamera(config, tell)


def nearest_choice(choices: list[str], asked: float, read: Callable[[str], float | None]) -> tuple[str | None, float]:
    """Which of a body's choices is nearest to a number, and how far it is from that in stops (factors of two); (None, inf) for none."""
    numbers = [(abs(math.log2(value / asked)), choice) for choice in choices if (value := read(choice))]
    off, choice = min(numbers, default=(math.inf, None), key=lambda pair: pair[0])
    return choice, off * (2 if read is read_f_number else 1)


def raw_choice(choices: list[str]) -> str | None:
    """The choice that gives raw files and nothing else, or else raw files beside others; None where there is none."""
    raw = [c for c in choices if re.search(r"\b(c?raw|nef|arw|cr\d|rw2|dng)\b", c, re.IGNORECASE)]  # not mRAW and sRAW, which are smaller
    both = [c for c in raw if re.search(r"jpe?g|fine|basic|norm|\+", c, re.IGNORECASE)]
    return next(iter(sorted((c for c in raw if c not in both), key=lambda c: "craw" in c.lower()) + both), None)


def read_f_number(choice: str) -> float | None:
    """The number of 'f/2.8', 'F2.8' or '2.8'."""
    match = re.fullmatch(r"\s*(?:f\s*/?\s*)?(\d+(?:[.,]\d+)?)\s*", choice, re.IGNORECASE)
    return float(match[1].replace(",", ".")) if match else None


def read_shutter_s(choice: str) -> float | None:
    """Seconds of '1/60', '0.0100s', '2', '1.3"'; None for bulb and time."""
    match = re.fullmatch(r'\s*(\d+(?:\.\d+)?)(?:\s*/\s*(\d+(?:\.\d+)?))?\s*(?:s|sec|")?\s*', choice, re.IGNORECASE)
    if not match or (match[2] and float(match[2]) == 0):
        return None
    return float(match[1]) / float(match[2] or 1)


def read_iso(choice: str) -> float | None:
    """The number of 'ISO 200' or '200'; None for automatic ones."""
    match = re.fullmatch(r"\s*(?:iso)?\s*(\d+)\s*", choice, re.IGNORECASE)
    return float(match[1]) if match else None


def _gphoto2():
    try:
        import gphoto2
    except ImportError as error:
        how = 'install it with `pip install "strandscope[camera]"`' if sys.platform != "win32" else "which does not exist for Windows"
        raise StrandscopeError(
            f"to talk to the camera, libgphoto2 is needed (the Python package gphoto2); {how}, or use a shutter cable and a watched folder"
        ) from error
    return gphoto2


def _find(config, names: tuple[str, ...]):
    """The first widget that a body has of some names, None for none."""
    found = {}

    def walk(widget):
        if widget.count_children():
            for i in range(widget.count_children()):
                walk(widget.get_child(i))
        else:
            found.setdefault(widget.get_name(), widget)

    walk(config)
    return next((found[name] for name in names if name in found), None)


def _value(config, names: tuple[str, ...]) -> str | None:
    widget = _find(config, names)
    return None if widget is None else str(widget.get_value())


def _choices(widget) -> list[str]:
    if widget is None:
        return []
    try:
        return [widget.get_choice(i) for i in range(widget.count_choices())]
    except Exception:  # the library raises its own error for a widget that has no choices
        return []


# ---- a shutter cable and a watched folder ----------------------------------------------------------------------------


MOST_SHOTS = 5  # for one exposure, before it is told that something is wrong
NUMBER_TURN = 5000  # numbers that fall by more have begun anew
CLOCK_S = 2.5  # what a clock that tells whole seconds may be off


@dataclass(frozen=True)
class CableConfig:
    """How a camera is fired through an output of the controller, and how its photographs are found."""

    pulse_s: float = 0.2  # how long the output is on
    wait_s: float = 20.0  # for a photograph, beyond the time that the shutter is open
    late_s: float = 30.0  # for one that is late, before the stage goes on
    quiet_s: float = 0.5  # nothing else appears for as long after a photograph
    poll_s: float = 0.1
    delete_originals: bool = False  # in the folder, once the session's copy is safe


class Shutter(Protocol):
    """The shutter line of a controller, as ``Stage`` has it."""

    def pulse(self, seconds: float) -> None:
        """On, and off again by itself after ``seconds``, whatever becomes of the connection."""

    def output(self, on: bool) -> None: ...


class CableCamera:
    """Any camera with a remote socket; see ``Camera``. Files that appear in a folder are matched to exposures.

    A shot is fired only when none is outstanding, so the one file that appears next is its photograph. Where a shot gave no file
    in time, it may still come. Shots of one exposure are all as good, since the stage stands; before the next exposure is fired,
    what is outstanding is waited for, and after that the first file is not trusted: it is left alone, and the shot repeated. So
    are several files where one was expected, and the first file of a run: an earlier one may have ended between shot and file. A
    file is none that has the bytes of an earlier one, a number before it, or a time before the shot.
    """

    def __init__(self, shutter: Shutter, watched: Path, config: CableConfig = CableConfig(), tell: Tell = lambda _line: None):
        """``watched`` is the folder of the tethering software."""
        self.shutter, self.watched, self.config, self.tell = shutter, Path(watched), config, tell
        self._pulsing = False  # a pulse was begun and is not known to have ended
        self._settings: CameraSettings | None = None
        self._known: set[Path] | None = None  # files that were looked at, or were there before
        self._hashes: set[str] = set()
        self._numbers: dict[str, int] = {}  # the last number of names that are alike
        self._ahead_s: float | None = None  # of the camera's clock
        self._shot: tuple | None = None  # which exposure the outstanding shots are of
        self._outstanding = 0
        self._incomplete: list[Path] = []  # new files that are still being written
        self._lost = 1  # shots that were given up, perhaps by an earlier run, and may still give a file

    def prepare(self, settings: CameraSettings) -> list[str]:
        self._settings = settings
        self.check()
        asked = f"manual mode, {_seconds(settings.shutter_s)}, f/{settings.f_number:g}, ISO {settings.iso:g}, raw, manual focus"
        return [f"set on the camera itself: {asked}; its photographs must appear in {self.watched}"]

    def check(self) -> list[str]:
        if not self.watched.is_dir():
            raise CameraGone(f"{self.watched}: the folder of the camera's photographs is not there; start the tethering software, or mount the card")
        if self._known is None:
            self._known = set(self._listed())
        if self._pulsing:
            self.shutter.output(False)
            self._pulsing = False
        return []

    def capture(self, exposure: Exposure, folder: Path) -> CapturedFile:
        self.check()
        asked = (exposure.kind, exposure.sweep, exposure.frame)
        if self._shot != asked:
            self._settle()
            self._shot = asked
        for _ in range(MOST_SHOTS):
            if path := self._shoot():
                break
        else:
            raise PhotographLate(f"files keep coming to {self.watched} that no shot was fired for; does another program, or a person, photograph?")
        part = temporary(folder, exposure, path.suffix)
        try:
            shutil.copyfile(path, part)
        except OSError as error:
            raise explain(error, part) from error
        return CapturedFile(part, path.name, path)

    def safe(self, captured: CapturedFile) -> None:
        if self.config.delete_originals:
            try:
                captured.origin.unlink(missing_ok=True)
            except OSError as error:
                self.tell(f"{captured.origin} could not be deleted ({error.strerror}); see that the disk has room")

    def close(self) -> None:
        """Nothing is held."""

    def _shoot(self) -> Path | None:
        """Fire once; the photograph, or None if there is no telling which it is. Raises PhotographLate where none comes in time."""
        self._ignore(self._new(), "came without a shot")
        fired_at = time.time()
        self._outstanding += 1
        self._pulsing = True
        self.shutter.pulse(self.config.pulse_s)
        self._pulsing = False
        files = self._wait(self.config.wait_s + (self._settings.shutter_s if self._settings else 0.0), at_least=1)
        if not files:
            raise PhotographLate(
                f"no photograph came to {self.watched} within {self.config.wait_s:g} s of the shot; is the shutter cable in, the camera awake "
                "(automatic power-off), the tethering software running, and the card not full?"
            )
        late = [path for path in files if self._is_late(path, fired_at)]
        self._ignore(late, "is of an earlier shot, by its number or its time")
        files = [path for path in files if path not in late]
        if self._lost or len(files) > self._outstanding:
            self._ignore(files, "may be of an earlier shot; another is taken")
            self._lost = max(self._lost - len(files), 0)
            self._outstanding = 0
            return None
        if not files:
            return None
        self._outstanding -= len(files)
        self._ignore(files[:-1], "is one more of the same exposure")
        if (taken := _taken(files[-1])) is not None and self._ahead_s is None:
            self._ahead_s = taken - fired_at
        return files[-1]

    def _settle(self) -> None:
        """Before another exposure: wait for what the shots of the last one still owe."""
        if self._outstanding:
            self.tell(f"waiting up to {self.config.late_s:g} s for photographs that are late ({self._outstanding})")
            files = self._wait(self.config.late_s, at_least=self._outstanding)
            self._ignore(files, "came late; the exposure has another")
            self._lost += max(self._outstanding - len(files), 0)
        self._outstanding = 0

    def _wait(self, wait_s: float, at_least: int) -> list[Path]:
        """New photographs in the order they were taken: when ``at_least`` so many are there and nothing more came for a while, or what
        there is after ``wait_s``. Then a file that is still incomplete is given up."""
        until, quiet_at, files = time.monotonic() + wait_s, -np.inf, []
        while True:
            fresh = self._new()
            files += fresh
            now = time.monotonic()
            if fresh:
                quiet_at = now + self.config.quiet_s
            if now >= until or (len(files) >= at_least and now >= quiet_at and not self._incomplete):
                break
            time.sleep(self.config.poll_s)
        self._ignore(self._incomplete, "stays incomplete or cannot be read")
        self._known.update(self._incomplete)
        self._outstanding = max(self._outstanding - len(self._incomplete), 0)
        return sorted(files, key=_order)

    def _new(self) -> list[Path]:
        """Photographs that have come and are complete: their size stands still, and their header can be read. Copies are left alone."""
        listed = [path for path in self._listed() if path not in self._known]
        sizes = [_size(path) for path in listed]
        if listed:
            time.sleep(self.config.poll_s)
        complete = [path for path, size in zip(listed, sizes, strict=True) if size and _size(path) == size and _readable(path)]
        self._incomplete = [path for path in listed if path not in complete]
        self._known.update(complete)
        own = []
        for path in complete:
            digest = sha256(path)
            if digest in self._hashes:
                self._ignore([path], "has the bytes of an earlier photograph")
            else:
                self._hashes.add(digest)
                own.append(path)
        return own

    def _is_late(self, path: Path, fired_at: float) -> bool:
        """Whether a file is of an earlier shot, by the number in its name or by the camera's clock, which tells whole seconds."""
        name, number = _numbered(path)
        before = self._numbers.get(name)
        if number is not None:
            if before is not None and 0 <= before - number < NUMBER_TURN:  # a camera begins at 1 again after 9999
                return True
            self._numbers[name] = number
        taken = _taken(path)
        return taken is not None and self._ahead_s is not None and taken < fired_at + self._ahead_s - CLOCK_S

    def _ignore(self, files: list[Path], why: str) -> None:
        for path in files:
            self.tell(f"{path.name} {why}; it is left alone")

    def _listed(self) -> list[Path]:
        try:
            names = sorted(os.listdir(self.watched))
        except OSError as error:
            raise CameraGone(f"{self.watched}: {error.strerror}; start the tethering software, or mount the card") from error
        return [self.watched / n for n in names if not n.startswith(".") and Path(n).suffix.lower() in RAW_SUFFIXES | LINEAR_SUFFIXES]


def cable_camera(shutter: Shutter, watched: Path, config: CableConfig = CableConfig(), tell: Tell = lambda _line: None) -> CableCamera:
    """A camera that a controller's output fires (``shutter``: a Stage) and whose photographs appear in the folder ``watched``."""
    return CableCamera(shutter, watched, config, tell)


def _order(path: Path) -> tuple:
    """By the time in the file, then by the numbers in its name."""
    return _taken(path) or 0.0, [int(n) for n in re.findall(r"\d+", path.stem)], path.name


def _taken(path: Path) -> float | None:
    try:
        taken = read_header(path).taken
    except CaptureError:
        return None
    return None if taken is None else taken[0]


def _numbered(path: Path) -> tuple[str, int | None]:
    """A file's name without its last number, and that number."""
    match = re.fullmatch(r"(.*?)(\d+)(\D*)", path.name)
    return (match[1] + match[3], int(match[2])) if match else (path.name, None)


def _readable(path: Path) -> bool:
    try:
        read_header(path)
    except CaptureError:
        return False
    return True


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


def _write(path: Path, data) -> None:
    try:
        path.write_bytes(data)
    except OSError as error:
        raise explain(error, path) from error


def _seconds(value: float) -> str:
    return f"1/{1 / value:.0f} s" if 0 < value < 0.5 else f"{value:g} s"
