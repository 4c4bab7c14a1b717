"""What a GRBL 1.1 or grblHAL controller says and is told: bytes to messages and back, and codes in words. No port is opened here.

Follows the interface document of GRBL 1.1 and what its firmware, and that of grblHAL, prints. A line that is not exactly of
one of their forms is ``Garbage``: a position must never be read out of a line that a bad cable has changed.
"""

import re
from dataclasses import dataclass, field, replace

# Real-time commands: single bytes that are acted on at once, outside of lines, and have no ``ok``.
STATUS, HOLD, RESUME, RESET, CANCEL_JOG = b"?", b"!", b"~", b"\x18", b"\x85"

RX_BYTES = 128  # of GRBL's receive buffer; grblHAL has 1024
LONGEST_LINE = 79  # characters a line of GRBL may have
LONGEST_ANSWER = 1024  # a line longer than this is no answer
STATES = ("Idle", "Run", "Hold", "Jog", "Home", "Alarm", "Check", "Door", "Sleep", "Tool")
MOVING = ("Run", "Jog", "Home")
PAUSED = ("Hold", "Door")


# ---- what the controller says ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Welcome:
    """The controller has just started, or was reset."""

    version: str


@dataclass(frozen=True)
class Ok:
    """A line was understood; a motion is planned by then, not done."""


@dataclass(frozen=True)
class Error:
    """A line was refused. The code is 0 where an old firmware answers in words."""

    code: int
    text: str = ""


@dataclass(frozen=True)
class Alarm:
    """The controller has stopped, and waits to be reset, unlocked or homed."""

    code: int
    text: str = ""


@dataclass(frozen=True)
class Setting:
    """``$number=value``."""

    number: int
    value: str


@dataclass(frozen=True)
class Feedback:
    """``[tag:text]``: a message, the parser's state, build options, offsets."""

    tag: str
    text: str


@dataclass(frozen=True)
class Startup:
    """A startup block that the controller has run by itself, ``>line:answer``."""

    line: str


@dataclass(frozen=True)
class Empty:
    """A line with nothing on it."""


@dataclass(frozen=True)
class Garbage:
    """Bytes that no controller says."""

    raw: bytes


@dataclass(frozen=True)
class Report:
    """A status report ``<…>``. Positions are in the controller's units, one an axis: machine coordinates, or work coordinates
    (machine minus ``offset``), whichever ``$10`` asks for. ``offset`` (WCO) and ``buffers`` come in some reports only."""

    state: str
    substate: int | None = None
    machine: tuple[float, ...] | None = None  # MPos
    work: tuple[float, ...] | None = None  # WPos
    offset: tuple[float, ...] | None = None  # WCO
    blocks_free: int | None = None  # Bf: of the planner,
    bytes_free: int | None = None  # and of the receive buffer
    feed: float | None = None  # F or FS
    overrides: tuple[int, ...] = ()  # Ov: feed, rapids, spindle, in percent
    pins: str = ""  # Pn: inputs that are triggered
    accessories: str = ""  # A: outputs that are on
    others: dict[str, str] = field(default_factory=dict, compare=False)  # fields of newer firmware


Message = Welcome | Ok | Error | Alarm | Report | Setting | Feedback | Startup | Empty | Garbage

_WELCOME = re.compile(r"Grbl(?:HAL)? (\d[\w.]*)(?: \[.*\])?", re.IGNORECASE)
_CODE = re.compile(r"(error|ALARM):(\d{1,3})")
_WORDS = re.compile(r"(error|ALARM): ([A-Za-z'$<>][ -~]*)")
_SETTING = re.compile(r"\$(\d{1,4})=([ -~]*?)(?:\s*\([^()]*\)?)?")
_STARTUP_SETTING = re.compile(r"\$N\d=[ -~]*")
_FEEDBACK = re.compile(r"\[([A-Za-z][\w.]*|[0-9.]+\w):?([ -~]*)\]")
_STARTUP = re.compile(r">([ -~]*)")
_REPORT = re.compile(r"<([A-Za-z]+)(?::(\d{1,3}))?((?:\|[^|<>]+)+)>")
_PLACE = re.compile(r"-?\d{1,6}\.\d{3,4}(?:,-?\d{1,6}\.\d{3,4}){1,8}")
_FEED = re.compile(r"\d{1,6}(?:\.\d{1,4})?(?:,-?\d{1,6}(?:\.\d{1,4})?){0,2}")
_COUNTS = re.compile(r"\d{1,6}(?:,\d{1,6})*")


def parse_line(line: bytes) -> Message:
    """What one line of the controller means, its end (``\\r\\n``) taken off or not. Never raises: what is not exactly of a form
    that GRBL 1.1 or grblHAL has is ``Garbage``."""
    raw = line.strip(b"\r\n")
    if not raw.strip(b" \t"):
        return Empty()
    if len(raw) > LONGEST_ANSWER or any(byte < 0x20 or byte > 0x7E for byte in raw):
        return Garbage(raw)
    text = raw.decode("ascii")
    if text == "ok":
        return Ok()
    if text[0] == "<":
        return _report(text) or Garbage(raw)
    if found := _CODE.fullmatch(text):
        return (Error if found[1] == "error" else Alarm)(int(found[2]))
    if found := _WORDS.fullmatch(text):
        return (Error if found[1] == "error" else Alarm)(0, found[2])
    if found := _SETTING.fullmatch(text):
        return Setting(int(found[1]), found[2])
    if found := _FEEDBACK.fullmatch(text):
        return Feedback(found[1], found[2])
    if found := _STARTUP.fullmatch(text):
        return Startup(found[1])
    if _STARTUP_SETTING.fullmatch(text):
        return Startup(text)
    if found := _WELCOME.fullmatch(text):
        return Welcome(found[1])
    return Garbage(raw)


def _report(text: str) -> Report | None:
    """A status report, None if any part of it is not as it must be."""
    found = _REPORT.fullmatch(text)
    if not found or found[1] not in STATES:
        return None
    values = {}
    for part in found[3][1:].split("|"):
        name, _, value = part.partition(":")
        if not re.fullmatch(r"[A-Za-z]\w*", name) or name in values:
            return None
        values[name] = value
    forms = {"MPos": _PLACE, "WPos": _PLACE, "WCO": _PLACE, "Bf": _COUNTS, "F": _FEED, "FS": _FEED, "Ov": _COUNTS}
    if any(name in values and not form.fullmatch(values[name]) for name, form in forms.items()):
        return None
    if ("MPos" in values) == ("WPos" in values) or ("F" in values and "FS" in values):
        return None
    places = {name: tuple(map(float, values[name].split(","))) for name in ("MPos", "WPos", "WCO") if name in values}
    buffers = [int(n) for n in values["Bf"].split(",")] if "Bf" in values else [None, None]
    overrides = tuple(int(n) for n in values["Ov"].split(",")) if "Ov" in values else ()
    if len({len(place) for place in places.values()}) != 1 or len(buffers) != 2 or len(overrides) not in (0, 3):
        return None
    feed = values.get("FS", values.get("F"))
    known = {*forms, "Pn", "A"}
    return Report(
        state=found[1],
        substate=int(found[2]) if found[2] else None,
        machine=places.get("MPos"),
        work=places.get("WPos"),
        offset=places.get("WCO"),
        blocks_free=buffers[0],
        bytes_free=buffers[1],
        feed=float(feed.split(",")[0]) if feed else None,
        overrides=overrides,
        pins=values.get("Pn", ""),
        accessories=values.get("A", ""),
        others={name: value for name, value in values.items() if name not in known},
    )


class Lines:
    """Bytes, in whatever pieces they come, to lines."""

    def __init__(self):
        self._rest = b""

    def feed(self, data: bytes) -> list[bytes]:
        """The lines that ``data`` completes. One that does not end is given out when it is too long for an answer."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > LONGEST_ANSWER:
            lines.append(self._rest)
            self._rest = b""
        return lines


# ---- where the machine is --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Track:
    """What is known of state and place after the messages so far. ``machine`` (n,) in the controller's units is None as long as
    it cannot be told: before the first report, and with work coordinates before their offset was heard twice alike."""

    state: str = ""
    substate: int | None = None
    machine: tuple[float, ...] | None = None
    offset: tuple[float, ...] | None = None
    told: tuple[float, ...] | None = None  # the last offset that was heard, perhaps not as it was said
    alike: int = 0  # whole reports of this state at this place, one after the other
    pins: str = ""
    feed: float | None = None

    @property
    def standing(self) -> tuple[float, ...] | None:
        """Where the machine stands, told twice with nothing else between."""
        return self.machine if self.state == "Idle" and self.alike >= 2 else None


def follow(track: Track, message: Message) -> Track:
    """The track after one more message. Garbage may have been a report that told another offset or place: it is told anew."""
    match message:
        case Report():
            told = message.offset or track.told
            offset = track.offset if message.offset is None else told if told == track.told else None
            machine = message.machine
            if message.work and offset and len(offset) == len(message.work):
                machine = tuple(w + o for w, o in zip(message.work, offset, strict=True))
            same = machine is not None and machine == track.machine and message.state == track.state and message.substate == track.substate
            return Track(
                message.state,
                message.substate,
                machine,
                offset,
                told,
                track.alike + 1 if same else int(machine is not None),
                message.pins,
                message.feed,
            )
        case Garbage():
            return replace(track, offset=None, alike=0)
        case Welcome():
            return Track()
        case Alarm():
            return replace(track, state="Alarm", substate=message.code, alike=0)
    return track


# ---- what it is told -------------------------------------------------------------------------------------------------


def encode(line: str) -> bytes:
    """A line as it is sent. Raises ValueError for one that the controller would take apart: too long, not ASCII, or with a
    real-time command in it."""
    if len(line) > LONGEST_LINE or not re.fullmatch(r"[A-Za-z0-9$#=.,:\-+ ]*", line):
        raise ValueError(f"not a line for a controller: {line!r}")
    return line.encode("ascii") + b"\n"


# ---- codes in words --------------------------------------------------------------------------------------------------

ERRORS = {
    1: ("a word of the line has no letter", "the cable may be disturbed: use a short shielded one, away from the motors"),
    2: ("a number is missing or malformed", "the cable may be disturbed: use a short shielded one, away from the motors"),
    3: ("the $ command is not known to this firmware", "use GRBL 1.1 or grblHAL"),
    4: ("a value is negative that must not be", "correct the setting"),
    5: ("homing is not enabled", "set $22=1 if the rig has switches, else homing = false in the rig's settings"),
    6: ("the step pulse is too short", "set $0=10"),
    7: ("stored settings could not be read and were replaced", "look at all settings ($$) and set them again"),
    8: ("the controller is busy with a motion", "wait until it stands"),
    9: ("motions are locked: after an alarm, or while jogging", "unlock or home, or wait until the jog ends"),
    10: ("soft limits need homing", "set $22=1 before $20=1"),
    11: ("the line is too long", "the cable may be disturbed: use a short shielded one"),
    12: ("steps would come faster than the controller can make them", "lower the maximum rate ($110…) or the steps per unit ($100…)"),
    13: ("the safety door is open", "close it"),
    14: ("a stored line is too long", "shorten it"),
    15: ("the jog would leave the travel", "jog less far, or correct the travel ($130…)"),
    16: ("not a jog that this firmware understands", "use GRBL 1.1 or grblHAL"),
    17: ("laser mode needs a spindle output that can be dimmed", "set $32=0"),
    18: ("the controller was reset", "go on when it is ready"),
    19: ("a value must be more than 0", "correct the setting"),
    20: ("a word that this firmware does not know", "an axis it does not have, or an output: choose others in the rig's settings"),
    21: ("two words of one line exclude each other", "the cable may be disturbed: use a short shielded one"),
    22: ("no feed rate was given", "give one above 0"),
    23: ("a number must be whole", "correct the command of the output"),
    24: ("two words of one line both need axes", "correct the command of the output"),
    25: ("a word is there twice", "the cable may be disturbed: use a short shielded one"),
    26: ("a motion names no axis", "the cable may be disturbed: use a short shielded one"),
    27: ("the line number is not valid", "the cable may be disturbed: use a short shielded one"),
    28: ("a value is missing", "correct the command of the output"),
    29: ("the coordinate system is not there", "use G54 to G59"),
    30: ("machine coordinates are for G0 and G1 only", "the cable may be disturbed: use a short shielded one"),
    31: ("axes are named where none are used", "the cable may be disturbed: use a short shielded one"),
    32: ("an arc names no axis of its plane", "the cable may be disturbed: use a short shielded one"),
    33: ("the target of the motion is not valid", "the cable may be disturbed: use a short shielded one"),
    34: ("the radius of an arc is not valid", "the cable may be disturbed: use a short shielded one"),
    35: ("an arc has no centre", "the cable may be disturbed: use a short shielded one"),
    36: ("a word is not used by anything in the line", "correct the command of the output"),
    37: ("the tool's length is for another axis", "correct the startup lines ($N)"),
    38: ("the tool is not there", "correct the startup lines ($N)"),
    39: ("a value is out of range", "correct the command of the output: is there such a port?"),
    40: ("a change of the tool is waited for", "reset the controller"),
    41: ("the spindle does not run", "correct the command of the output"),
    42: ("the plane is not valid", "correct the startup lines ($N)"),
    43: ("the feed rate is above what is allowed", "lower the feed in the rig's settings"),
    44: ("the spindle's speed is out of range", "correct the command of the output"),
    45: ("a switch at the end of the travel is pressed", "free it by hand, or home"),
    46: ("the machine must be homed first", "home it"),
    47: ("no tool is set", "correct the startup lines ($N)"),
    48: ("two values of one line exclude each other", "correct the command of the output"),
    49: ("the controller's self-test failed", "switch it off and on"),
    50: ("the emergency stop is pressed", "release it and reset"),
    51: ("a motor driver reports a fault", "look at motors and drivers, switch off and on"),
    52: ("the value of a setting is out of range", "correct the setting"),
    53: ("the setting is not there in this firmware", "leave it out"),
    54: ("the retraction is not valid", "correct the startup lines ($N)"),
    55: ("the axes cannot be homed together", "correct the order of homing ($44…)"),
    56: ("the coordinate system is locked", "unlock it in the settings"),
    60: ("the memory card could not be read", "the rig needs none"),
    70: ("a wireless device could not be started", "switch it off in the settings"),
    77: ("a password is asked for", "take it out of the controller's settings"),
    78: ("access was denied", "take the password out of the controller's settings"),
    79: ("not while the controller has stopped for an alarm", "reset it"),
}

ALARMS = {
    1: ("a switch at the end of the travel was hit, and the motors stopped at once", "free the stage and home"),
    2: ("the target is outside the travel that the soft limits allow", "shorten the plan, or correct travel ($130…) or origin"),
    3: ("it was reset while it moved", "home"),
    4: ("the probe is not as expected", "the rig needs none: look at what is wired to that input"),
    5: ("the probe did not touch anything", "the rig needs none: look at what is wired to that input"),
    6: ("it was reset while homing", "home again"),
    7: ("the safety door was opened while homing", "close it and home again"),
    8: ("the switch stayed pressed after the stage had backed off", "raise the pull-off ($27), or look at the switch and its wires"),
    9: ("no switch was found", "look at the switches, the direction of homing ($23) and the travel ($130…)"),
    10: ("the emergency stop was pressed", "release it, reset and home"),
    11: ("it must be homed first", "home"),
    12: ("a switch at the end of the travel is pressed", "free it and home"),
    13: ("the probe is protected", "look at what is wired to that input"),
    14: ("the spindle did not reach its speed", "the rig needs none: use another output for the shutter"),
    15: ("the second switch of an axis with two motors was not found", "look at the switches"),
    16: ("the self-test failed", "switch it off and on"),
    17: ("a motor driver reports a fault", "look at motors and drivers, switch off and on"),
    18: ("homing is not set up", "set the order of homing ($44…)"),
}

POSITION_KEPT = (2, 4, 5, 13)  # alarms after which the motors still are where the controller says
CRITICAL = (1, 2, 10, 17)  # after these only a reset is heard; GRBL does not even answer ?


def error_in_words(code: int, text: str = "") -> str:
    """What ``error:code`` means and what to do."""
    meaning, remedy = ERRORS.get(code, (text or "not known", "see the firmware's documentation"))
    return f"error {code}: {meaning}; {remedy}" if code else f"error: {meaning}; {remedy}"


def alarm_in_words(code: int, text: str = "") -> str:
    """What ``ALARM:code`` means and what to do."""
    meaning, remedy = ALARMS.get(code, (text or "it does not say which", "unlock or home"))
    return f"alarm {code}: {meaning}; {remedy}" if code else f"alarm: {meaning}; {remedy}"
