"""What a capture will photograph: angles × positions as frozen data that iterates into exposures, and what they cost.

The paper (sec. 5) photographs a sweep of 376 positions, 5 a millimetre over 75 mm, from each of 24 angles. A second plan turns
the hair once in front of a small aperture: the turntable sequence, used for validation.
"""

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import NamedTuple

from ..errors import StrandscopeError
from ..files import atomic, toml_tables

SWEEP, TURNTABLE, CHECK = "sweep", "turntable", "check"
MOST_EXPOSURES = 1_000_000


class Place(NamedTuple):
    """Where the rig stands: angle of the turntable, and d of the plane of focus."""

    angle_deg: float
    position_mm: float


@dataclass(frozen=True)
class Exposure:
    """One photograph. ``index`` counts all of the plan, ``frame`` those of a sweep."""

    index: int
    sweep: int
    frame: int
    angle_deg: float
    position_mm: float  # d of the plane of focus: from the rotation axis, positive towards the camera
    kind: str  # "sweep", "turntable", or "check": the first of the sweep once more, to see whether hair or light have changed

    @property
    def place(self) -> Place:
        return Place(self.angle_deg, self.position_mm)


@dataclass(frozen=True)
class Plan:
    """Angles × positions, and how each photograph is taken. Raises StrandscopeError, naming the field, for what cannot be."""

    kind: str = SWEEP  # or "turntable"
    angles_deg: tuple[float, ...] = tuple(15.0 * k for k in range(24))
    first_mm: float = -37.5  # d of the first photograph of a sweep,
    step_mm: float = 0.2  # from one to the next, more than 0: the stage goes up,
    count: int = 376  # and how many of them
    settle_s: float = 0.3  # from the end of a motion until nothing trembles
    approach_mm: float = 0.5  # every position is reached from below, from at least this far: the screw's backlash is taken up
    approach_deg: float = 2.0  # and every angle likewise
    shutter_s: float = 0.25
    f_number: float = 2.8
    iso: int = 100
    bytes_each: int = 16_000_000  # of a raw file, for the estimate
    transfer_s: float = 1.5  # that the camera needs between photographs, for the estimate
    check_shots: bool = True  # the first photograph of each sweep is taken once more at its end

    def __post_init__(self):
        for f in fields(self):
            wrong = _wrong(f.name, getattr(self, f.name))
            if wrong:
                raise StrandscopeError(f"plan: {f.name} is {_shown(getattr(self, f.name))}; expected {wrong}")
        object.__setattr__(self, "angles_deg", tuple(float(a) for a in self.angles_deg))
        if len(self) > MOST_EXPOSURES:
            raise StrandscopeError(f"plan: {len(self)} photographs; expected at most {MOST_EXPOSURES}")

    def exposures(self) -> Iterator[Exposure]:
        """All photographs in the order in which they are taken."""
        index = 0
        for sweep, angle in enumerate(self.angles_deg):
            for frame, position in enumerate(self._frames):
                kind = CHECK if frame == self.count else self.kind
                yield Exposure(index, sweep, frame, angle, position, kind)
                index += 1

    def __iter__(self) -> Iterator[Exposure]:
        return self.exposures()

    def __len__(self) -> int:
        return len(self.angles_deg) * (self.count + self._checks)

    @property
    def positions_mm(self) -> tuple[float, ...]:
        """(count,) d of the photographs of a sweep."""
        return tuple(round(self.first_mm + self.step_mm * i, 9) for i in range(self.count))

    @property
    def last_mm(self) -> float:
        return self.positions_mm[-1]

    @property
    def reach(self) -> tuple[Place, Place]:
        """The least and the most angle and position that the rig must be able to go to, approaches included."""
        least = Place(min(self.angles_deg) - self.approach_deg, self.first_mm - self.approach_mm)
        return least, Place(max(self.angles_deg), self.last_mm)

    def moves(self, here: Place | None = None) -> Iterator[tuple[list[Place], Exposure]]:
        """Each exposure with the places to go to before it, the last of which is its own. From ``here``, or from below."""
        lash = Lash()
        at = here or Place(self.angles_deg[0] - self.approach_deg, self.first_mm - self.approach_mm)
        for exposure in self.exposures():
            legs, lash = approach(at, exposure.place, lash, Place(self.approach_deg, self.approach_mm))
            at = exposure.place
            yield legs, exposure

    def duration_s(self, speed_mm_s: float = 5.0, speed_deg_s: float = 30.0, overhead_s: float = 0.1, start: int = 0) -> float:
        """Seconds from exposure ``start`` to the end: motions at these speeds, with ``overhead_s`` each to start and stop,
        settling, shutter and transfer."""
        total, at = 0.0, None
        for legs, exposure in self.moves():
            if exposure.index >= start:
                for leg in legs:
                    if at is not None and leg != at:
                        total += abs(leg.angle_deg - at.angle_deg) / speed_deg_s + abs(leg.position_mm - at.position_mm) / speed_mm_s + overhead_s
                    at = leg
                total += self.settle_s + self.shutter_s + self.transfer_s
            at = exposure.place
        return total

    def disk_bytes(self, start: int = 0) -> int:
        """Bytes that the photographs from exposure ``start`` on take."""
        return max(len(self) - start, 0) * self.bytes_each

    @property
    def _checks(self) -> int:
        return int(self.check_shots and self.count > 1)

    @property
    def _frames(self) -> tuple[float, ...]:
        return self.positions_mm + self.positions_mm[:1] * self._checks


def turntable_plan(angles: int = 360, position_mm: float = 0.0, **others) -> Plan:
    """The turntable sequence: ``angles`` photographs around the hair with a small aperture, focused on the axis."""
    small = {"f_number": 16.0, "shutter_s": 2.0, "check_shots": False} | others
    turns = tuple(360.0 * k / angles for k in range(angles))
    return Plan(kind=TURNTABLE, angles_deg=turns, first_mm=position_mm, count=1, **small)


def bracketed(plan: Plan, near_mm: float, far_mm: float, margin_mm: float = 1.0) -> Plan:
    """The plan with as many positions, a step apart, as cover the hair from ``far_mm`` (behind the axis, negative) to ``near_mm``
    and a margin on both sides. Raises StrandscopeError where near is behind far."""
    if not far_mm <= near_mm:
        raise StrandscopeError(f"plan: the near side of the hair is at {near_mm:g} mm, the far side at {far_mm:g} mm; expected near above far")
    steps = math.ceil((near_mm - far_mm + 2 * margin_mm) / plan.step_mm - 1e-6)
    middle = (near_mm + far_mm) / 2
    return replace(plan, first_mm=round(middle - steps * plan.step_mm / 2, 6), count=steps + 1)


# ---- backlash --------------------------------------------------------------------------------------------------------


class Lash(NamedTuple):
    """How far each axis has gone up since it last went down: so much play of its screw or gear is taken up."""

    angle_deg: float = 0.0
    position_mm: float = 0.0


def approach(at: Place, to: Place, lash: Lash, least: Place) -> tuple[list[Place], Lash]:
    """The places to go to so that each axis arrives from below having gone up ``least``, and the lash taken up then.

    One leg where the play is taken up on the way, two where an axis must first go below its target. An axis that is at its
    target with its play taken up does not move.
    """
    below, taken = [], []
    for a, t, l, n in zip(at, to, lash, least, strict=True):  # noqa: E741
        if (t == a and l >= n) or (t > a and l + t - a >= n) or n <= 0:
            below.append(a)
            taken.append(l + t - a if t >= a else 0.0)
        else:
            below.append(t - n)
            taken.append(n)
    first = Place(*below)
    return ([to] if first == at else [first, to]), Lash(*taken)


# ---- files -----------------------------------------------------------------------------------------------------------


def save_plan(path: Path, plan: Plan, **tables: dict) -> None:
    """Write a plan as the table ``plan`` of a TOML file, atomically; other tables go beside it."""
    import tomli_w

    with atomic(Path(path)) as part:
        part.write_text(tomli_w.dumps({"plan": asdict(plan)} | tables), encoding="utf-8")


def load_plan(path: Path) -> Plan:
    """Read the table ``plan`` of a TOML file; what is not there has its default. Other tables are for other readers.

    ``angles = 24`` stands for so many angles evenly around. Raises StrandscopeError naming file and field for one that is
    unknown or wrong.
    """
    values = read_table(path, "plan")
    if "angles" in values:
        angles = values.pop("angles")
        if "angles_deg" in values or not _whole(angles) or not 1 <= angles <= 3600:
            raise StrandscopeError(f"{path}: plan.angles is {_shown(angles)}; expected a count from 1 to 3600, and no angles_deg beside it")
        values["angles_deg"] = [360.0 * k / angles for k in range(angles)]
    known = {f.name: f for f in fields(Plan)}
    for name, value in values.items():
        if name not in known:
            raise StrandscopeError(f"{path}: plan.{name} is not a field of a plan; expected one of angles, {', '.join(known)}")
        if wrong := _wrong(name, tuple(value) if isinstance(value, list) else value):
            raise StrandscopeError(f"{path}: plan.{name} is {_shown(value)}; expected {wrong}")
    start = turntable_plan() if values.get("kind") == TURNTABLE else Plan()
    try:
        return replace(start, **{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})
    except StrandscopeError as error:
        raise StrandscopeError(f"{path}: {error}") from error


def read_table(path: Path, name: str) -> dict:
    """One table of a TOML file, empty if it is not there. Raises StrandscopeError for a file that is not there or not TOML."""
    try:
        tables = toml_tables(path, f"a table [{name}]")
    except OSError as error:
        raise StrandscopeError(f"{path}: cannot be read ({error.strerror})") from error
    for key, value in tables.items():
        if not isinstance(value, dict):
            raise StrandscopeError(f"{path}: {key} stands outside of any table; expected it below a line such as [{name}]")
    return dict(tables.get(name, {}))


def _wrong(name: str, value) -> str:
    """What a field must be, empty if it is that."""
    match name:
        case "kind":
            return "" if value in (SWEEP, TURNTABLE) else f'"{SWEEP}" or "{TURNTABLE}"'
        case "angles_deg":
            good = isinstance(value, tuple) and value and all(_number(a) and abs(a) <= 3600 for a in value)
            return "" if good and len(set(value)) == len(value) else "degrees, at least one, none twice"
        case "check_shots":
            return "" if isinstance(value, bool) else "true or false"
        case "first_mm":
            return "" if _number(value) and abs(value) <= 10_000 else "millimetres"
        case "count":
            return "" if _whole(value) and 1 <= value <= 100_000 else "a whole number from 1 to 100000"
        case "iso" | "bytes_each":
            return "" if _whole(value) and value > 0 else "a whole number more than 0"
        case "step_mm" | "shutter_s" | "f_number":
            return "" if _number(value) and 0 < value <= 1000 else "a number more than 0, at most 1000"
    return "" if _number(value) and 0 <= value <= 1000 else "a number from 0 to 1000"


def _number(value) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _whole(value) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _shown(value) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}…"
