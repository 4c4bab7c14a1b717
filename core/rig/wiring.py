"""How a rig is wired: what the controller's axes and outputs are, and whether its settings are good for it."""

import math
from dataclasses import dataclass, fields
from pathlib import Path

from ..errors import StrandscopeError
from . import grbl
from .plan import Place, Plan, read_table

LETTERS = "XYZABCUVW"  # of axes, in the order in which reports tell them


@dataclass(frozen=True)
class StageConfig:
    """How the rig is wired. A *unit* is what the controller takes for a millimetre.

    A position is ``(machine - focus_origin) * focus_mm_per_unit``, an angle likewise; a negative scale turns an axis around.
    Raises StrandscopeError naming a field that is wrong.
    """

    url: str = "/dev/ttyUSB0"
    baud: int = 115200
    focus_axis: str = "X"
    focus_mm_per_unit: float = 1.0
    focus_origin: float = 0.0  # units: the machine coordinate at which the plane of focus is on the rotation axis
    focus_feed: float = 300.0  # units a minute
    turntable_axis: str = "auto"  # A if the controller has it, else Y
    turntable_deg_per_unit: float = 1.0
    turntable_origin: float = 0.0  # units: the machine coordinate of angle 0
    turntable_feed: float = 1800.0  # units a minute
    homing: bool = True  # switches find the position; without, the stage stands on its mark when the controller is switched on
    turntable_homes: bool = True  # false: the turntable has no switch, and stands where it last stood
    shutter_on: str = "M8"  # closes the shutter line: M8/M9 of the coolant, M3 S1000/M5 of the spindle, M64 P0/M65 P0 of a port
    shutter_off: str = "M9"
    shutter_inverted: bool = False  # the relay closes on "off"
    poll_s: float = 0.15  # between questions for the status
    silent_s: float = 3.0  # without an answer: the controller is gone
    welcome_s: float = 4.0  # for a controller to start after its port was opened
    home_s: float = 300.0  # for homing, and for motions that somebody else has begun
    slack: float = 2.0  # a motion may take so many times as long as reckoned,
    slack_s: float = 10.0  # and so much longer

    def __post_init__(self):
        for f in fields(self):
            if wrong := _wrong(f.name, getattr(self, f.name)):
                raise StrandscopeError(f"stage: {f.name} is {getattr(self, f.name)!r}; expected {wrong}")
        if self.focus_axis == self.turntable_axis:
            raise StrandscopeError(f"stage: turntable_axis is {self.turntable_axis!r}, as focus_axis is; expected another axis")

    def shutter(self, on: bool) -> list[str]:
        """The lines that switch the shutter line."""
        return [line.strip() for line in (self.shutter_on if on != self.shutter_inverted else self.shutter_off).split("\n")]


def load_stage(path: Path) -> StageConfig:
    """Read the table ``stage`` of a TOML file; what is not there has its default. Raises StrandscopeError naming file and field."""
    values, known = read_table(path, "stage"), [f.name for f in fields(StageConfig)]
    for name in values:
        if name not in known:
            raise StrandscopeError(f"{path}: stage.{name} is not a field; expected one of {', '.join(known)}")
    try:
        return StageConfig(**values)
    except StrandscopeError as error:
        raise StrandscopeError(f"{path}: {error}") from error


# ---- settings --------------------------------------------------------------------------------------------------------


def units_of(place: Place, config: StageConfig) -> tuple[float, float]:
    """Machine coordinates of turntable and focus axis at a place."""
    return (
        place.angle_deg / config.turntable_deg_per_unit + config.turntable_origin,
        place.position_mm / config.focus_mm_per_unit + config.focus_origin,
    )


def complaints(settings: dict[int, str], config: StageConfig, turntable_axis: str, plan: Plan | None = None) -> list[str]:
    """What in a controller's settings (``$$``, by number) is not good for a rig, or for a plan, and what to set; empty if all is."""
    said = []
    flag = lambda number: int(value_of(settings, number) or 0) & (255 if number == 20 else 1)  # noqa: E731 ($20 may be a mask of axes)
    if value_of(settings, 1) is not None and value_of(settings, 1) < 255:
        said.append(f"$1={settings[1]}: the motors are switched off when they stand, and the stage drifts; set $1=255")
    if config.homing and not flag(22):
        said.append("$22=0: homing is off; set $22=1, or homing = false for a rig without switches")
    if config.homing and not flag(20):
        said.append("$20=0: nothing keeps the stage from running into its ends; set $20=1 (soft limits)")
    if flag(32) and "M3" in config.shutter_on.upper():
        said.append("$32=1: in laser mode the spindle's output, the shutter, is on only while the stage moves; set $32=0")
    reach = [units_of(place, config) for place in plan.reach] if plan else None
    for i, (name, axis, feed, unit) in enumerate(
        (("turntable", turntable_axis, config.turntable_feed, "°"), ("focus stage", config.focus_axis, config.focus_feed, "mm"))
    ):
        n = LETTERS.index(axis)
        steps, rate, travel = (value_of(settings, group + n) for group in (100, 110, 130))
        scale = abs(config.turntable_deg_per_unit if i == 0 else config.focus_mm_per_unit)
        if steps is not None and not 0.1 <= steps <= 100_000:
            said.append(f"${100 + n}={settings[100 + n]}: steps per unit of {axis}, the {name}; set what motor, microsteps and screw or gear give")
        elif steps is not None and plan and i == 1 and 1 / steps * scale > plan.step_mm / 4 and plan.count > 1:
            said.append(
                f"${100 + n}={settings[100 + n]}: one step of {axis} is {1 / steps * scale:.3g} mm, too coarse for photographs every "
                f"{plan.step_mm:g} mm; use microsteps or a finer screw"
            )
        if rate is not None and rate < feed:
            said.append(
                f"${110 + n}={settings[110 + n]}: {axis}, the {name}, may go at {rate:g} a minute, and {feed:g} are asked for; set one of them"
            )
        if rate and steps and rate / 60 * steps > 200_000:
            said.append(
                f"${110 + n}={settings[110 + n]}: {rate / 60 * steps:.0f} steps a second of {axis} are more than a controller makes; set less"
            )
        if reach is None or not travel:
            continue
        low, high = sorted((reach[0][i], reach[1][i]))
        if high - low > travel + 1e-6:
            said.append(f"${130 + n}={settings[130 + n]}: {axis}, the {name}, has {travel:g} {unit} of travel, and the plan needs {high - low:g}")
        elif flag(20) and not ((-travel <= low and high <= 0) or (low >= 0 and high <= travel)):
            said.append(
                f"with soft limits, {axis}, the {name}, goes from {-travel:g} to 0 (${130 + n}), and the plan from {low:g} to {high:g}; "
                f"set {'turntable' if i == 0 else 'focus'}_origin so that it lies inside"
            )
    return said


def value_of(settings: dict[int, str], number: int) -> float | None:
    """The number in a setting, None where there is none."""
    try:
        value = float(settings[number].split(" ")[0])
    except (KeyError, ValueError):
        return None
    return value if math.isfinite(value) else None


def _wrong(name: str, value) -> str:
    """What a field of the configuration must be, empty if it is that."""
    number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    match name:
        case "url":
            return "" if isinstance(value, str) and value else "a port, such as /dev/ttyUSB0, COM3 or socket://host:port"
        case "baud":
            return "" if isinstance(value, int) and not isinstance(value, bool) and value > 0 else "bits a second, such as 115200"
        case "focus_axis":
            return "" if isinstance(value, str) and value in set(LETTERS) else f"one of {', '.join(LETTERS)}"
        case "turntable_axis":
            return "" if isinstance(value, str) and value in {*LETTERS, "auto"} else f'"auto" or one of {", ".join(LETTERS)}'
        case "homing" | "turntable_homes" | "shutter_inverted":
            return "" if isinstance(value, bool) else "true or false"
        case "shutter_on" | "shutter_off":
            try:
                good = isinstance(value, str) and all(line.strip() and grbl.encode(line.strip()) for line in value.split("\n"))
            except ValueError:
                good = False
            return "" if good else "a command such as M8"
        case "focus_mm_per_unit" | "turntable_deg_per_unit":
            return "" if number and value != 0 else "a number other than 0"
        case "focus_origin" | "turntable_origin":
            return "" if number else "a number"
    return "" if number and value > 0 else "a number more than 0"
