"""A rig as a file describes it, and a capture with it: what the command line and the panel call.

The TOML file has the tables ``plan``, ``stage``, ``camera`` and ``optics``. A capture keeps its own in ``rig/rig.toml``, so that
it is gone on with by naming its folder alone.
"""

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path

from ..errors import StrandscopeError
from ..progress import Progress, silent
from . import desk
from .attach import RIG, Orders, Setup, duration
from .camera import CableConfig, Camera, CameraError, GphotoConfig, cable_camera, gphoto_camera
from .plan import CHECK, Plan, load_plan, read_table, save_plan
from .session import SessionParams, run
from .stage import Stage
from .watch import sharpness, write_picture
from .wiring import StageConfig, load_stage

USB, CABLE = "usb", "cable"
FILE = f"{RIG}/rig.toml"


@dataclass(frozen=True)
class CameraConfig:
    """Which camera, and how it is spoken to."""

    kind: str = USB  # through libgphoto2; or "cable": fired by the controller, its photographs appear in a folder
    folder: str = ""  # where they appear, for a cable
    usb: GphotoConfig = field(default_factory=GphotoConfig)
    cable: CableConfig = field(default_factory=CableConfig)


@dataclass(frozen=True)
class Rig:
    """All that a file says of a rig."""

    plan: Plan = field(default_factory=Plan)
    stage: StageConfig = field(default_factory=StageConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    setup: Setup = field(default_factory=Setup)


def load_rig(path: Path) -> Rig:
    """A rig from a TOML file; what is not there has its default. Raises StrandscopeError naming file and field."""
    path = Path(path)
    camera = read_table(path, "camera")
    kind, folder = camera.pop("kind", USB), camera.pop("folder", "")
    if kind not in (USB, CABLE):
        raise StrandscopeError(f'{path}: camera.kind is {kind!r}; expected "{USB}" or "{CABLE}"')
    if not isinstance(folder, str) or (kind == CABLE) != bool(folder):
        expected = "the folder in which the camera's photographs appear" if kind == CABLE else f'none, but with kind "{CABLE}"'
        raise StrandscopeError(f"{path}: camera.folder is {folder!r}; expected {expected}")
    way = {USB: "usb", CABLE: "cable"}[kind]
    config = replace(CameraConfig(kind, folder), **{way: _filled(path, "camera", camera, GphotoConfig() if kind == USB else CableConfig())})
    return Rig(load_plan(path), load_stage(path), config, _filled(path, "optics", read_table(path, "optics"), Setup()))


def save_rig(path: Path, rig: Rig) -> None:
    """Write a rig, atomically, so that ``load_rig`` reads it."""
    camera = {"kind": rig.camera.kind} | asdict(rig.camera.usb if rig.camera.kind == USB else rig.camera.cable)
    if rig.camera.kind == CABLE:
        camera["folder"] = rig.camera.folder
    optics = {name: value for name, value in asdict(rig.setup).items() if value is not None}
    save_plan(path, rig.plan, stage=asdict(rig.stage), camera=camera, optics=optics)


def changed(rig: Rig, port: str | None = None, watched: Path | None = None, name: str | None = None) -> Rig:
    """The rig with another port, the folder that a camera on a cable delivers to, another name of what is photographed."""
    if port:
        rig = replace(rig, stage=replace(rig.stage, url=port))
    if watched:
        rig = replace(rig, camera=replace(rig.camera, kind=CABLE, folder=str(Path(watched).resolve())))
    return replace(rig, setup=replace(rig.setup, name=name)) if name else rig


def describe(plan: Plan) -> list[tuple[str, str]]:
    """Rows (name, value) for people: what a plan costs."""
    checks = sum(e.kind == CHECK for e in plan.exposures())
    angles = plan.angles_deg
    return [
        ("photographs", f"{len(plan)}, of which {checks} are checks" if checks else f"{len(plan)}"),
        ("angles", f"{len(angles)}, from {min(angles):g}° to {max(angles):g}°"),
        ("positions", f"{plan.count}, from {plan.first_mm:g} mm to {plan.last_mm:g} mm"),
        ("time", duration(plan.duration_s())),
        ("disk", f"{plan.disk_bytes() / 1e9:.1f} GB"),
    ]


def open_camera(config: CameraConfig, stage: Stage) -> Camera:
    """The camera of a rig, not connected yet. Raises StrandscopeError where libgphoto2 is needed and not installed."""
    if config.kind == CABLE:
        return cable_camera(stage, Path(config.folder).expanduser(), config.cable)
    return gphoto_camera(config.usb)


def capture(
    rig: Rig,
    folder: Path,
    params: SessionParams | None = None,
    *,
    repeat: tuple[int, ...] = (),
    orders: Orders | None = None,
    progress: Progress = silent,
    events: Callable[[dict], None] = lambda _event: None,
) -> Path:
    """Take a capture with a rig, or go on with it. Returns the path of capture.json; raises as ``session.run`` does, and StageLost
    where no controller answers."""
    folder = Path(folder)
    save_rig(folder / FILE, rig)
    with Stage.open(rig.stage, lambda line: events({"event": "note", "message": line})) as stage:
        for line in stage.complaints(rig.plan):
            events({"event": "warning", "message": line})
        camera = open_camera(rig.camera, stage)
        try:
            listeners = {"orders": orders, "progress": progress, "events": events}
            return run(rig.plan, stage, camera, folder, rig.setup, params or SessionParams(), repeat=repeat, **listeners)
        finally:
            camera.close()


def by_hand(rig: Rig, commands: Iterable[str], picture: Path, events: Callable[[dict], None]) -> None:
    """Move a rig by commands, a line each, and show what its camera sees; see ``desk``. Raises StageLost where no controller answers."""
    with Stage.open(rig.stage) as stage:
        desk.attend(stage, lambda: open_camera(rig.camera, stage), rig.plan, commands, picture, events)


def live(camera: Camera, picture: Path, events: Callable[[dict], None], stop: Callable[[], bool] = lambda: False) -> None:
    """Show what the camera sees, for framing and focusing, until ``stop``: the picture in a file, its sharpness as an event each.

    Raises CameraError where the camera has no live picture.
    """
    if not hasattr(camera, "preview"):
        raise CameraError("a camera on a cable has no live picture here; frame and focus on its own screen")
    while not stop():
        seen = camera.preview()
        write_picture(picture, seen)
        number = round(sharpness(seen), 4)
        events({"event": "live", "sharpness": number, "picture": str(picture), "message": f"sharpness {number:.4f}"})


def _filled(path: Path, table: str, values: dict, start):
    """A dataclass with the values of a table, each of the type that it has at first; None stands for a number."""
    known = {f.name: getattr(start, f.name) for f in fields(start)}
    for name, value in values.items():
        if name not in known:
            raise StrandscopeError(f"{path}: {table}.{name} is not a field; expected one of {', '.join(known)}")
        expected = {str: "text", bool: "true or false"}.get(type(known[name]), "a number")
        if {str: "text", bool: "true or false", int: "a number", float: "a number"}.get(type(value)) != expected:
            raise StrandscopeError(f"{path}: {table}.{name} is {value!r}; expected {expected}")
    return replace(start, **values)
