"""A controller for those who have none: a process that speaks GRBL 1.1 or grblHAL behind a pseudo-terminal or a TCP port.

It has what a driver can stumble over: the time that motions take, the planner's and the receive buffer's limits, feed hold, jogs,
homing, soft limits, alarms after which nothing but a reset is heard, and a memory of where the stage *really* stands, which no
counter changes. Faults come on demand: a pulled cable, noise, silence, an alarm, a power cut. It logs when it moved and when it
switched its outputs, so that a test can say whether anything moved while a shutter was open.

``start_controller`` starts one; ``python -m strandscope.core.rig.controller --help`` does from a shell. What it does is written
after GRBL's interface document and what its firmware was seen to do. Feeds are not blended: each motion starts and ends at rest.
"""

import argparse
import contextlib
import errno
import json
import math
import os
import random
import re
import select
import socket
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from ..errors import StrandscopeError
from . import grbl
from .plan import Place
from .stage import StageConfig

GRBL, GRBLHAL = "grbl", "grblhal"
PLANNER_BLOCKS = {GRBL: 15, GRBLHAL: 35}
RX_BYTES = {GRBL: 128, GRBLHAL: 1024}
LINE_BYTES = {GRBL: 80, GRBLHAL: 257}
ALARM_DELAY_S = {GRBL: 0.5, GRBLHAL: 0.1}  # in which the firmware does nothing else
LOCATE_S = 0.6  # of homing, beyond the way to the switch
SLIP_S = 0.004  # a motor that is stopped dead runs on for so long, unseen
MAX_LINEAR = 90.0  # mm of travel,
MAX_ROTARY = 400.0  # and degrees
TICK_S, IDLE_S = 0.002, 0.02  # of real time between two looks at the port

_LINEAR = {100: 400.0, 110: 900.0, 120: 60.0, 130: MAX_LINEAR}
_ROTARY = {100: 40.0, 110: 3600.0, 120: 400.0, 130: MAX_ROTARY}
_COMMON = {
    0: 10,
    1: 255,
    2: 0,
    3: 0,
    4: 0,
    5: 0,
    6: 0,
    11: 0.01,
    12: 0.002,
    13: 0,
    20: 1,
    21: 0,
    22: 1,
    23: 0,
    24: 100.0,
    25: 3600.0,
    26: 25,
    27: 1.0,
}
_SPINDLE = {30: 1000.0, 31: 0.0, 32: 0}


@dataclass(frozen=True)
class ControllerConfig:
    """What is simulated. Seconds are the controller's own; ``time_factor`` of them pass in one of the clock's."""

    firmware: str = GRBL  # three axes, the turntable on Y; or grblhal: four, on A
    time_factor: float = 1.0
    settings: dict[int, float] = field(default_factory=dict)  # other than the usual ones
    switches: str = "XYZA"  # axes that have a switch
    at: dict[str, float] = field(default_factory=dict)  # where axes stand at first: units below their switch, negative
    resets_on_open: bool = False  # as an Arduino does, which a serial adapter resets
    boot_s: float = 1.5  # from power or that reset to the welcome
    seed: int = 0  # of noise


def stage_config(url: str, config: ControllerConfig | None = None, **others) -> StageConfig:
    """The configuration of a stage on this controller, that can go 40 mm and 370° around the middle of its travel."""
    factor = (config or ControllerConfig()).time_factor
    quick = {"poll_s": max(0.15 / factor, 0.004), "welcome_s": max(4.0 / factor, 1.5), "silent_s": max(3.0 / factor, 1.0)}
    return StageConfig(**{"url": url, "focus_origin": -MAX_LINEAR / 2, "turntable_origin": 15.0 - MAX_ROTARY} | quick | others)


# ---- motions ---------------------------------------------------------------------------------------------------------


@dataclass
class _Block:
    """A straight motion, or the rest of one. Runs through ``phases`` of (seconds, acceleration)."""

    start: dict[str, float]
    target: dict[str, float]
    speed: float  # units a second along the way
    acceleration: float
    done: float = 0.0  # units along the way
    velocity: float = 0.0
    phases: list[list[float]] = field(default_factory=list)

    @property
    def length(self) -> float:
        return math.dist(list(self.start.values()), list(self.target.values()))

    def go(self) -> None:
        """Speed up from what it has, and stop at the end."""
        left, a, v = max(self.length - self.done, 0.0), self.acceleration, self.velocity
        peak = max(min(self.speed, math.sqrt(a * left + v * v / 2)), v)
        ramps = (peak * peak - v * v + peak * peak) / (2 * a)
        self.phases = [[(peak - v) / a, a], [max(left - ramps, 0.0) / peak if peak else 0.0, 0.0], [peak / a, -a]]

    def halt(self) -> None:
        self.phases = [[self.velocity / self.acceleration, -self.acceleration]]

    def advance(self, seconds: float) -> float:
        """Run on; returns the seconds that were left over when the phases were at their end."""
        while self.phases and seconds > 0:
            phase = self.phases[0]
            dt = min(seconds, phase[0])
            self.done += self.velocity * dt + phase[1] * dt * dt / 2
            self.velocity = max(self.velocity + phase[1] * dt, 0.0)
            phase[0] -= dt
            seconds -= dt
            if phase[0] <= 1e-12:
                self.phases.pop(0)
        return seconds

    @property
    def left_s(self) -> float:
        return sum(phase[0] for phase in self.phases)

    @property
    def at(self) -> dict[str, float]:
        share = min(self.done / self.length, 1.0) if self.length else 1.0
        return {axis: s + share * (self.target[axis] - s) for axis, s in self.start.items()}


class _Abort(Exception):
    """The line that runs is given up: the controller is reset."""


# ---- the firmware ----------------------------------------------------------------------------------------------------


class Machine:
    """The firmware and the rig below it, without a port: bytes in, bytes out, at times (seconds, its own) that are handed in."""

    def __init__(self, config: ControllerConfig):
        self.config, self.hal = config, config.firmware == GRBLHAL
        self.axes = "XYZA" if self.hal else "XYZ"
        self.turntable = "A" if self.hal else "Y"
        self.settings = self._defaults() | {int(k): v for k, v in config.settings.items()}
        self.now = 0.0
        # where the axes really are, in units below their switch; the counter may differ
        self.truth = {axis: config.at.get(axis, -self.settings[130 + i] / 3) for i, axis in enumerate(self.axes)}
        self.motions: list[list[float]] = []  # begin and end of each; the last may run
        self.outputs: list[tuple[float, str, bool]] = []
        self.exposing: dict[str, bool] = {}
        self.alarm_next: int | None = None  # what the next homing fails with
        self.out = bytearray()
        self.owes_ok = False
        self._power_up(0.0)

    # ---- from outside ----

    def receive(self, data: bytes) -> None:
        """Bytes from the host: real-time commands are acted on, others wait for their line's end."""
        if self.now < self.boots_until:
            return
        for byte in data:
            char = bytes([byte])
            if char == grbl.STATUS:
                self.asked = True
            elif char == grbl.RESET:
                self.reset()
            elif char == grbl.HOLD:
                self._hold()
            elif char == grbl.RESUME:
                self._resume()
            elif char == grbl.CANCEL_JOG:
                if self.hal:
                    self.rx.clear()  # lines that it has not begun are dropped, in whatever state
                if self.state == "Jog":
                    self._hold(cancel=True)
            elif byte >= 0x80:
                continue
            elif len(self.rx) < RX_BYTES[self.config.firmware]:
                self.rx.append(byte)

    def advance(self, now: float) -> bytes:
        """Let time pass; returns what it says meanwhile."""
        while True:
            self._work()
            step = min(now, self._next_event())
            dt, self.now = max(step - self.now, 0.0), max(step, self.now)
            self._move(dt)
            if self.now >= now and not self._ready():
                break
        said, self.out = bytes(self.out), bytearray()
        return said

    def power_cycle(self) -> None:
        """Off and on: all is forgotten but the settings."""
        self._stop_dead()
        self.out.clear()
        self._power_up(self.config.boot_s)

    def alarm(self, code: int) -> None:
        """An alarm out of the blue; 8 and 9 come of the next homing."""
        if code in (6, 7, 8, 9):
            self.alarm_next = code
            return
        self._stop_dead()
        self._raise_alarm(code)

    def reset(self) -> None:
        """0x18, or the reset button. Not heard while a critical alarm is being called out."""
        if self.critical and self.now < self.busy_until:
            return
        if self.state in ("Run", "Jog", "Home") or self.block_halting:
            self._stop_dead()
            self._say(f"ALARM:{6 if self.homing else 3}")
            self.state = "Alarm"
        elif self.state != "Alarm":
            self.state = "Idle"
        if self.critical and self.owes_ok:
            self._say("ok")  # GRBL says so of the line that it has not done
        self._start_anew()

    @property
    def moving(self) -> bool:
        return bool(self.motions and len(self.motions[-1]) == 1)

    @property
    def counter(self) -> dict[str, float]:
        """Machine coordinates, as the controller counts them."""
        return {axis: round(self.truth[axis] + self.offset[axis], 9) for axis in self.axes}

    # ---- starting ----

    def _defaults(self) -> dict[int, float]:
        values = dict(_COMMON) | dict(_SPINDLE) | {10: 511 if self.hal else 1}
        for i, axis in enumerate(self.axes):
            values |= {group + i: value for group, value in (_ROTARY if axis == self.turntable else _LINEAR).items()}
        return values

    def _power_up(self, boot_s: float) -> None:
        self.boots_until = self.now + boot_s
        self.booting = True
        self.offset = {axis: -self.truth[axis] for axis in self.axes}  # it counts from 0
        self.state = "Alarm" if self.settings[22] else "Idle"
        self.g54 = dict.fromkeys(self.axes, 0.0)
        self._clear()

    def _start_anew(self) -> None:
        self._clear()
        self._welcome()

    def _clear(self) -> None:
        self.rx, self.task, self.waits = bytearray(), None, None
        self.blocks: deque[_Block] = deque()
        self.block_halting = self.held = self.deaf = self.stopping = self.homing = self.critical = self.tells_to_reset = self.asked = False
        self.busy_until = self.now
        self.modal = {"motion": "G0", "distance": "G90", "units": "G21", "feed": 0.0}
        self.g92 = dict.fromkeys(self.axes, 0.0)
        self.wco_in = self.ov_in = 0
        for name in list(self.exposing):
            self._switch(name, False)

    def _welcome(self) -> None:
        self.booting = False
        self._say("")
        self._say("GrblHAL 1.1f ['$' or '$HELP' for help]" if self.hal else "Grbl 1.1h ['$' for help]")
        if self.state == "Alarm":
            self._say("[MSG:'$H'|'$X' to unlock]")

    def _say(self, line: str) -> None:
        self.out += line.encode("ascii") + b"\r\n"

    # ---- moving ----

    def _next_event(self) -> float:
        if self.booting:
            return self.boots_until
        events = [self.busy_until]
        if self.blocks and self.moving:
            events.append(self.now + self.blocks[0].left_s)
        if isinstance(self.waits, float):
            events.append(self.waits)
        return min((event for event in events if event > self.now), default=math.inf)

    def _move(self, dt: float) -> None:
        if not (self.blocks and self.moving):
            return
        block = self.blocks[0]
        left = block.advance(dt)
        for axis, value in block.at.items():
            self._place(axis, value - self.offset[axis])
        if block.phases:
            return
        if self.block_halting:
            self.block_halting, self.held = False, True
            self._ends(self.now - left)
            if self.state == "Jog":
                self.blocks.clear()
                self.held, self.state = False, "Idle"
            elif block.length - block.done < 1e-9:
                self.blocks.popleft()
        else:
            for axis, value in block.target.items():
                self._place(axis, value - self.offset[axis])
            self.blocks.popleft()
            if self.blocks:
                self.blocks[0].go()
            else:
                self._ends(self.now - left)
                if self.state in ("Run", "Jog"):
                    self.state = "Idle"

    def _place(self, axis: str, value: float) -> None:
        """An axis goes to a true place, or stalls at the end of its travel."""
        travel = self.settings[130 + self.axes.index(axis)]
        stalls = min(max(value, -travel - 1.0), 0.0) if axis in self.config.switches else value
        if stalls != value:
            self.offset[axis] += value - stalls
            if self.settings[21] and not self.homing:
                self.truth[axis] = stalls
                self.alarm(1)
        self.truth[axis] = stalls

    def _begins(self) -> None:
        if not self.moving:
            self.motions.append([self.now])

    def _ends(self, when: float) -> None:
        if self.moving:
            self.motions[-1].append(when)

    def _stop_dead(self) -> None:
        """Motors that are stopped at once slip: the counter no longer says where they are."""
        if self.moving and self.blocks:
            block = self.blocks[0]
            for axis, s in block.start.items():
                slip = (block.target[axis] - s) / (block.length or 1.0) * block.velocity * SLIP_S
                self.truth[axis] += slip
                self.offset[axis] -= slip
        self._ends(self.now)
        self.blocks.clear()

    def _hold(self, cancel: bool = False) -> None:
        if self.hal and self.state == "Jog" and not cancel:
            return  # grblHAL ends jogs by their own command only
        if self.state == "Idle":
            self.state, self.held = "Hold", True
        elif self.state in ("Run", "Jog") and self.blocks and self.moving and not self.block_halting:
            self.blocks[0].halt()
            self.block_halting = True
            self.state = "Hold" if self.state == "Run" else "Jog"

    def _resume(self) -> None:
        self.deaf = False
        if self.state == "Hold" and self.held:
            self.held, self.state = False, "Idle"
            self._cycle()

    def _cycle(self) -> None:
        """Begin with what is planned."""
        if self.blocks and self.state == "Idle":
            self.state = "Run"
            self.blocks[0].go()
            self._begins()

    # ---- the main loop ----

    def _ready(self) -> bool:
        """Whether there is work that needs no time to pass."""
        if self.booting or self.now < self.busy_until:
            return False
        if self.asked and (self.hal or not (self.homing or self.critical)):
            return True
        if self.critical or self.deaf or (not self.stopping and (self.state == "Hold" or self.block_halting)):
            return False
        return self._goes_on() if self.task else b"\n" in self.rx or b"\r" in self.rx

    def _goes_on(self) -> bool:
        waits = self.waits
        return waits is None or (self.now >= waits if isinstance(waits, float) else waits())

    def _work(self) -> None:
        """All that needs no time to pass."""
        if self.booting:
            if self.now >= self.boots_until:
                self._welcome()
            else:
                return
        if self.tells_to_reset and self.now >= self.busy_until:
            self.tells_to_reset = False
            self._say("[MSG:Reset to continue]")
        while self._ready():
            if self.asked:
                self.asked = False
                self._report()
            elif self.task:
                self._run()
            else:
                self._take_line()
            if not self.task and b"\n" not in self.rx:
                self._cycle()

    def _take_line(self) -> None:
        end = min(i for i in (self.rx.find(b"\n"), self.rx.find(b"\r")) if i >= 0)
        raw, self.rx = bytes(self.rx[:end]), self.rx[end + 1 :]
        self.task = self._line(raw)
        self._run()

    def _run(self) -> None:
        try:
            self.waits = next(self.task)
        except StopIteration as ended:
            self.task = self.waits = None
            self._say("ok" if not ended.value else f"error:{ended.value}")
        except _Abort:
            self.task = self.waits = None

    def _line(self, raw: bytes) -> Generator:
        """One line. Yields what it waits for: a time, or a condition; returns the error's code, 0 for ok."""
        if len(raw) >= LINE_BYTES[self.config.firmware]:
            return 11
        text = re.sub(r"\([^)]*\)?|;.*|[\x00-\x20/]", "", raw.decode("latin-1")).upper()
        if not text:
            return 0
        if text.startswith("$"):
            return (yield from self._system(text))
        if self.state in ("Alarm", "Jog"):
            return 9
        return (yield from self._block(text))

    def _sync(self) -> Iterator[Callable[[], bool]]:
        """Wait until all motions are done."""
        self._cycle()
        if self.blocks:
            yield lambda: not self.blocks and self.state != "Hold"

    # ---- lines that begin with $ ----

    def _system(self, text: str) -> Generator:
        if text == "$":
            self._say("[HLP:$$ $# $G $I $N $x=val $Nx=line $J=line $SLP $C $X $H ~ ! ? ctrl-x]")
        elif text == "$$":
            if self.state in ("Run", "Hold"):
                return 8
            for number in sorted(self.settings):
                value = self.settings[number]
                self._say(f"${number}={value:.3f}" if isinstance(value, float) else f"${number}={value}")
        elif text == "$G":
            feed = f"{self.modal['feed']:.0f}"
            extra = " G49 G98 G50" if self.hal else ""
            lit = "M8" if self.exposing.get("coolant") else "M9"
            turning = "M3" if self.exposing.get("spindle") else "M5"
            modal = f"{self.modal['motion']} G54 G17 {self.modal['units']} {self.modal['distance']} G94"
            self._say(f"[GC:{modal}{extra} {turning} {lit} T0 F{feed} S0]")
        elif text.startswith("$J="):
            return self._jog(text[3:])
        elif text == "$X":
            if self.state == "Alarm":
                self._say("[MSG:Caution: Unlocked]")
                self.state = "Idle"
        elif self.state not in ("Idle", "Alarm"):
            return 8
        elif text == "$H":
            return (yield from self._home())
        elif text == "$I":
            self._say("[VER:1.1f.20240123:]" if self.hal else "[VER:1.1h.20190825:]")
            sizes = f"{PLANNER_BLOCKS[self.config.firmware]},{RX_BYTES[self.config.firmware]}"
            self._say(f"[OPT:VNMGL,{sizes},{len(self.axes)},0]" if self.hal else f"[OPT:V,{sizes}]")
            if self.hal:
                self._say("[FIRMWARE:grblHAL]")
        elif text == "$#":
            zeros = ",".join(["0.000"] * len(self.axes))
            for n in range(54, 60):
                self._say(f"[G{n}:{self._numbers(self.g54) if n == 54 else zeros}]")
            self._say(f"[G92:{self._numbers(self.g92)}]")
            self._say("[TLO:0.000]")
            self._say(f"[PRB:{zeros}:0]")
        elif text == "$N":
            self._say("$N0=")
            self._say("$N1=")
        elif text == "$SLP":
            self._say("[MSG:Sleeping]")
            self.state = "Alarm"
        elif found := re.fullmatch(r"\$(\d+)=(-?\d+(?:\.\d*)?)", text):
            number, value = int(found[1]), float(found[2])
            if number not in self.settings:
                return 53 if self.hal else 3
            self.settings[number] = value if isinstance(self.settings[number], float) else int(value)
        else:
            return 3
        return 0

    def _home(self) -> Generator:
        if not self.settings[22]:
            return 5
        self.homing, self.state = True, "Home"
        self._begins()
        seek, pull_off = self.settings[25] / 60, self.settings[27]
        if self.hal:
            yield self.now + 0.1
        start, began = dict(self.truth), self.now
        ends = {}
        for i, axis in enumerate(self.axes):
            travel = self.settings[130 + i]
            ends[axis] = -travel if int(self.settings[23]) >> i & 1 else 0.0
        axes = [axis for axis in self.axes if axis in self.config.switches]
        ways = [abs(start[axis] - ends[axis]) for axis in axes]
        seconds = max(ways, default=0.0) / seek
        while self.now < began + seconds:
            share = (self.now - began) / seconds
            self.truth |= {axis: start[axis] + share * (ends[axis] - start[axis]) for axis in axes}
            yield min(self.now + 0.05, began + seconds)
        yield self.now + LOCATE_S
        failed, self.alarm_next = self.alarm_next, None
        self._ends(self.now)
        self.homing = False
        for axis in axes:
            inward = pull_off if ends[axis] < 0 else -pull_off
            self.truth[axis] = ends[axis] + inward
            self.offset[axis] = 0.0
        if failed:
            self._raise_alarm(failed)
            self._say("ok")  # GRBL says so before it starts anew
            self._start_anew()
            raise _Abort
        self.state = "Idle"
        return 0

    def _jog(self, text: str) -> int:
        if self.state not in ("Idle", "Jog"):
            return 8
        words = _words(text)
        if words is None:
            return 1
        codes = {f"{letter}{value:g}" for letter, value in words if letter in "GM"}
        if codes - {"G90", "G91", "G20", "G21", "G53"}:
            return 16
        axes = {letter: value for letter, value in words if letter in "XYZABC"}
        if any(letter not in self.axes for letter in axes):
            return 20
        feed = next((value for letter, value in words if letter == "F"), 0.0)
        if not axes:
            return 26
        if feed <= 0:
            return 22
        scale = 25.4 if "G20" in codes or (self.modal["units"] == "G20" and "G21" not in codes) else 1.0
        here = self._planned()
        target = dict(here)
        for axis, value in axes.items():
            if "G91" in codes or (self.modal["distance"] == "G91" and "G90" not in codes and "G53" not in codes):
                target[axis] += value * scale
            else:
                target[axis] = value * scale + (0.0 if "G53" in codes else self.g54[axis] + self.g92[axis])
        if self._outside(target):
            return 15
        self._plan(here, target, feed * scale)
        if self.state == "Idle" and self.blocks:
            self.state = "Jog"
            self.blocks[0].go()
            self._begins()
        return 0

    # ---- G-code ----

    def _block(self, text: str) -> Generator:
        words = _words(text)
        if words is None:
            return 1
        if any(math.isnan(value) for _, value in words):
            return 2
        letters = [letter for letter, _ in words if letter not in "GM"]
        if len(set(letters)) != len(letters):
            return 25
        values = {letter: value for letter, value in words if letter not in "GM"}
        if any(letter in "XYZABCUVW" and letter not in self.axes for letter in values) or any(letter in "DEHOQ" for letter in values):
            return 20
        codes = [f"{letter}{value:g}" for letter, value in words if letter in "GM"]
        ports = {"M62", "M63", "M64", "M65"} if self.hal else set()
        known = {"G0", "G1", "G4", "G10", "G17", "G20", "G21", "G40", "G49", "G53", "G54", "G90", "G91", "G92", "G94"}
        known |= {"M0", "M2", "M3", "M4", "M5", "M8", "M9", "M30"} | ports
        if any(code not in known for code in codes):
            return 20
        for group in (("G0", "G1"), ("G90", "G91"), ("G20", "G21"), ("M3", "M4", "M5"), ("G4", "G10", "G53", "G92")):
            if sum(code in group for code in codes) > 1:
                return 21
        modal = dict(self.modal)
        for code in codes:
            for name, group in (("motion", ("G0", "G1")), ("distance", ("G90", "G91")), ("units", ("G20", "G21"))):
                if code in group:
                    modal[name] = code
        scale = 25.4 if modal["units"] == "G20" else 1.0
        if "F" in values:
            if values["F"] < 0:
                return 4
            modal["feed"] = values["F"] * scale
        axes = {axis: values[axis] * scale for axis in self.axes if axis in values}
        if "G4" in codes:
            if "P" not in values:
                return 28
            self.modal = modal
            yield from self._sync()
            if values["P"] > 0:
                yield self.now + values["P"]
            return 0
        if ports & set(codes) and "P" not in values:
            return 28
        if "G10" in codes:
            self.modal, self.wco_in = modal, 0
            self.g54 |= axes
            return 0
        if "G92" in codes:
            here = self._planned()
            self.modal, self.wco_in = modal, 0
            self.g92 |= {axis: here[axis] - self.g54[axis] - value for axis, value in axes.items()}
            return 0
        if any(code in ("G0", "G1") for code in codes) and not axes and "G53" in codes:
            return 26
        if axes and modal["motion"] == "G1" and modal["feed"] <= 0:
            return 22
        self.modal = modal
        for name, on, off in (("spindle", ("M3", "M4"), ("M5",)), ("coolant", ("M8",), ("M9",))):
            for code in codes:
                if code in on or code in off:
                    yield from self._sync()
                    self._switch(name, code in on)
        for code in ports & set(codes):
            yield from self._sync()
            self._switch(f"port {values['P']:.0f}", code in ("M62", "M64"))
        if axes:
            yield from self._travel(axes, modal, "G53" in codes)
        return 0

    def _travel(self, axes: dict[str, float], modal: dict, machine: bool) -> Generator:
        here = self._planned()
        target = dict(here)
        for axis, value in axes.items():
            if machine:
                target[axis] = value
            elif modal["distance"] == "G91":
                target[axis] += value
            else:
                target[axis] = value + self.g54[axis] + self.g92[axis]
        if self._outside(target):
            if self.state == "Run":
                self.stopping = True
                self._hold()
                yield lambda: not self.block_halting
            self._ends(self.now)
            self.blocks.clear()
            self._raise_alarm(2)
            raise _Abort
        while len(self.blocks) >= PLANNER_BLOCKS[self.config.firmware]:
            self._cycle()
            yield lambda: len(self.blocks) < PLANNER_BLOCKS[self.config.firmware]
        self._plan(here, target, modal["feed"] if modal["motion"] == "G1" else math.inf)

    def _planned(self) -> dict[str, float]:
        return dict(self.blocks[-1].target) if self.blocks else self.counter

    def _plan(self, here: dict[str, float], target: dict[str, float], feed: float) -> None:
        steps = {axis: self.settings[100 + i] for i, axis in enumerate(self.axes)}
        target = {axis: round(value * steps[axis]) / steps[axis] if value != here[axis] else here[axis] for axis, value in target.items()}
        length = math.dist(list(here.values()), list(target.values()))
        if length < 1e-9:
            return
        speed, acceleration = feed / 60, math.inf
        for i, axis in enumerate(self.axes):
            share = abs(target[axis] - here[axis]) / length
            if share:
                speed = min(speed, self.settings[110 + i] / 60 / share)
                acceleration = min(acceleration, self.settings[120 + i] / share)
        self.blocks.append(_Block(here, target, speed, acceleration))

    def _outside(self, target: dict[str, float]) -> bool:
        return bool(self.settings[20]) and any(not -self.settings[130 + i] <= target[axis] <= 0 for i, axis in enumerate(self.axes))

    # ---- saying ----

    def _raise_alarm(self, code: int) -> None:
        self.state, self.held, self.block_halting, self.stopping = "Alarm", False, False, False
        self.owes_ok = self.task is not None
        self.task = self.waits = None
        self._say(f"ALARM:{code}")
        self.busy_until = self.now + ALARM_DELAY_S[self.config.firmware]
        if code in grbl.CRITICAL:
            self.critical = self.tells_to_reset = True

    def _switch(self, name: str, on: bool) -> None:
        if self.exposing.get(name, False) != on:
            self.exposing[name] = on
            self.outputs.append((self.now, name, on))

    def _numbers(self, values: dict[str, float]) -> str:
        return ",".join(f"{values[axis] + 0.0:.3f}" for axis in self.axes)

    def _report(self) -> None:
        mask = int(self.settings[10])
        state = f"Hold:{0 if self.held else 1}" if self.state == "Hold" else self.state
        machine, wco = self.counter, {axis: self.g54[axis] + self.g92[axis] for axis in self.axes}
        if mask & 1:
            parts = [state, f"MPos:{self._numbers(machine)}"]
        else:
            parts = [state, f"WPos:{self._numbers({axis: machine[axis] - wco[axis] for axis in self.axes})}"]
        if mask & 2:
            free = PLANNER_BLOCKS[self.config.firmware] - len(self.blocks)
            parts.append(f"Bf:{free},{RX_BYTES[self.config.firmware] - len(self.rx)}")
        speed = self.blocks[0].velocity * 60 if self.blocks and self.moving else 0.0
        parts.append(f"FS:{speed:.0f},0")
        pulled = [axis for axis in self.axes if axis in self.config.switches and self.truth[axis] >= 0]
        if pulled:
            parts.append(f"Pn:{''.join(pulled)}")
        if self.wco_in <= 0:
            self.wco_in = 30 if self.moving else 10
            self.ov_in = max(self.ov_in, 1)
            parts.append(f"WCO:{self._numbers(wco)}")
        elif self.ov_in <= 0:
            self.ov_in = 20 if self.moving else 10
            lit = ("S" if self.exposing.get("spindle") else "") + ("F" if self.exposing.get("coolant") else "")
            parts += ["Ov:100,100,100", *([f"A:{lit}"] if lit else [])]
        self.wco_in, self.ov_in = self.wco_in - 1, self.ov_in - 1
        self._say(f"<{'|'.join(parts)}>")


def _words(text: str) -> list[tuple[str, float]] | None:
    """Letters and numbers of a line, None if it is not made of them; a number that is none is NaN."""
    if not re.fullmatch(r"(?:[A-Z][^A-Z]*)+", text):
        return None
    words = []
    for letter, digits in re.findall(r"([A-Z])([^A-Z]*)", text):
        good = re.fullmatch(r"[+-]?(?:\d+\.?\d*|\.\d+)", digits)
        words.append((letter, float(digits) if good else math.nan))
    return words


# ---- a process behind a port -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Controller:
    """A controller that runs in a process of its own. It outlives the one that started it; whoever has these can go on with it."""

    url: str  # what a Stage opens
    control: int  # TCP port on this machine, over which faults are asked for
    pid: int

    def __enter__(self) -> "Controller":
        return self

    def __exit__(self, *_error) -> None:
        self.end()

    def end(self) -> None:
        """End the process."""
        with contextlib.suppress(StrandscopeError):
            self._ask("end")
        if os.name == "posix":
            with contextlib.suppress(ChildProcessError):  # it may be another's child
                os.waitpid(self.pid, 0)

    def pull_cable(self) -> None:
        """The port vanishes; the controller runs on."""
        self._ask("pull_cable")

    def plug_in(self) -> None:
        self._ask("plug_in")

    def power_cycle(self) -> None:
        """Its power fails and comes back: it starts anew, and no longer knows where the stage is."""
        self._ask("power_cycle")

    def alarm(self, code: int) -> None:
        """Raise an alarm; 6 to 9 of the next homing."""
        self._ask("alarm", code=code)

    def press(self, button: str) -> None:
        """A button on the controller: "hold", "resume" or "reset"."""
        self._ask("press", button=button)

    def deafen(self) -> None:
        """It hears no lines until it is resumed, and says Idle: as GRBL where a jog is cancelled just when it ends."""
        self._ask("deafen")

    def garbage(self, count: int = 40) -> None:
        """So many random bytes are put before what it says next."""
        self._ask("garbage", count=count)

    def noise(self, rate: float) -> None:
        """From now on each byte that it says is lost or changed with this probability."""
        self._ask("noise", rate=rate)

    def silence(self, seconds: float) -> None:
        """For so long, of the clock, nothing gets through in either direction."""
        self._ask("silence", seconds=seconds)

    @property
    def state(self) -> dict:
        """``state`` in GRBL's words, ``moving``, ``counter`` (what it counts) and ``truth`` (units from the switch) of each axis,
        ``outputs`` that are on."""
        return self._ask("state")

    @property
    def moving(self) -> bool:
        return self.state["moving"]

    def place(self, config: StageConfig) -> Place:
        """Where the rig really stands."""
        truth = self.state["truth"]
        turntable = config.turntable_axis if config.turntable_axis != "auto" else "A" if "A" in truth else "Y"
        angle = (truth[turntable] - config.turntable_origin) * config.turntable_deg_per_unit
        return Place(angle, (truth[config.focus_axis] - config.focus_origin) * config.focus_mm_per_unit)

    def moved(self, begin: float, end: float) -> bool:
        """Whether it moved at any instant between two of ``time.monotonic()``; also where ``end`` was in another process."""
        return self._ask("moved", begin=begin, end=end)["moved"]

    def motions(self) -> list[tuple[float, float]]:
        """Begin and end of each motion so far, as ``time.monotonic()`` tells time; of one that runs, until now."""
        return [tuple(motion) for motion in self._ask("motions")["motions"]]

    def switched(self) -> list[tuple[float, str, bool]]:
        """When (``time.monotonic()``) each output was switched, which, and whether on."""
        return [tuple(event) for event in self._ask("outputs")["outputs"]]

    def _ask(self, what: str, **arguments) -> dict:
        try:
            with socket.create_connection(("127.0.0.1", self.control), timeout=10.0) as connection:
                connection.sendall(json.dumps({"do": what} | arguments).encode() + b"\n")
                answer = connection.makefile("rb").readline()
        except OSError as error:
            raise StrandscopeError(f"the simulated controller at {self.url} does not run any more ({error})") from error
        return json.loads(answer) if answer else {}


def start_controller(config: ControllerConfig | None = None, transport: str = "", linger_s: float = 120.0) -> Controller:
    """Start a controller in a process of its own; ``transport`` is "pty" (a serial port; not on Windows) or "tcp"; the
    first that there is.

    It ends by ``end()``, or when nobody has spoken to it for ``linger_s``. Raises StrandscopeError where it does not start.
    """
    config, transport = config or ControllerConfig(), transport or ("pty" if _has_ptys() else "tcp")
    code = (
        "import runpy, sys; runpy.run_path(sys.argv.pop(1), run_name='worker'); "
        "from strandscope.core.rig.controller import main; sys.exit(main(sys.argv[1:]))"
    )
    worker = Path(__file__).resolve().parents[2] / "worker.py"
    command = [sys.executable, "-c", code, str(worker), f"--{transport}", "--linger", str(linger_s), "--config", json.dumps(asdict(config))]
    group = {"start_new_session": True} if os.name == "posix" else {"creationflags": subprocess.CREATE_NO_WINDOW}
    child = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **group)
    line = child.stdout.readline()
    if not line:
        raise StrandscopeError(f"the simulated controller did not start: {child.communicate()[1].decode(errors='replace')[-500:]}")
    child.stdout.close()
    child.stderr.close()
    child.returncode = 0  # it is nobody's child from here on: it outlives us, and we do not wait for it
    return Controller(**json.loads(line))


def _has_ptys() -> bool:
    """Whether the system gives out pseudo-terminals: Windows does not, nor do some containers."""
    try:
        for handle in os.openpty():
            os.close(handle)
    except (AttributeError, OSError):
        return False
    return True


class _Port:
    """What the host sees: a port that can be pulled out and plugged in again."""

    url = ""
    opened = False  # since it was last looked at

    connected = False

    def plug_in(self) -> None: ...
    def pull(self) -> None: ...
    def end(self) -> None: ...
    def read(self) -> bytes: ...
    def write(self, data: bytes) -> None: ...
    def fileno(self) -> int: ...


class _Pty(_Port):
    """A pseudo-terminal, under a name that stays."""

    def __init__(self):
        self._folder = tempfile.mkdtemp(prefix="strandscope-")
        self.url = str(Path(self._folder) / "tty")
        self._master, self._open = -1, False
        self.plug_in()

    def plug_in(self) -> None:
        import tty

        if self._master >= 0:
            return
        self._master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        os.symlink(os.ttyname(slave), self.url)
        os.close(slave)
        self._open = False

    def pull(self) -> None:
        if self._master >= 0:
            os.unlink(self.url)
            os.close(self._master)
        self._master = -1

    def end(self) -> None:
        self.pull()
        os.rmdir(self._folder)

    def read(self) -> bytes:
        if self._master < 0:
            return b""
        try:
            data = os.read(self._master, 4096)
            is_open = data != b""
        except OSError as error:
            data, is_open = b"", error.errno != errno.EIO  # or there is nothing to read just now
        self.opened, self._open = self.opened or (is_open and not self._open), is_open
        return data

    def write(self, data: bytes) -> None:
        if self._master >= 0 and self._open:
            with contextlib.suppress(OSError):
                os.write(self._master, data)

    @property
    def connected(self) -> bool:
        return self._master >= 0 and self._open

    def fileno(self) -> int:
        return self._master


class _Tcp(_Port):
    """A TCP port on this machine."""

    def __init__(self):
        self._listener = self._client = None
        self._number = 0
        self.plug_in()
        self.url = f"socket://127.0.0.1:{self._number}"

    def plug_in(self) -> None:
        if self._listener:
            return
        self._listener = socket.create_server(("127.0.0.1", self._number))
        self._listener.setblocking(False)
        self._number = self._listener.getsockname()[1]

    def pull(self) -> None:
        for end in (self._client, self._listener):
            if end:
                end.close()
        self._listener = self._client = None

    def end(self) -> None:
        self.pull()

    def read(self) -> bytes:
        if self._listener:
            with contextlib.suppress(BlockingIOError):
                client, _ = self._listener.accept()
                client.setblocking(False)
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                if self._client:
                    self._client.close()
                self._client, self.opened = client, True
        if not self._client:
            return b""
        try:
            data = self._client.recv(4096)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._client.close()
            self._client = None
        return data

    def write(self, data: bytes) -> None:
        if self._client:
            with contextlib.suppress(OSError):
                self._client.sendall(data)

    @property
    def connected(self) -> bool:
        return self._client is not None

    def fileno(self) -> int:
        return self._client.fileno()


class _Server:
    """The machine, its port, and the control port, in one loop."""

    def __init__(self, config: ControllerConfig, port: _Port, linger_s: float):
        self.machine, self.port, self.config, self.linger_s = Machine(config), port, config, linger_s
        self.began = time.monotonic()
        self.random = random.Random(config.seed)
        self.rate, self.mute_until, self.junk = 0.0, 0.0, b""
        self.control = socket.create_server(("127.0.0.1", 0))
        self.spoken, self.ended = self.began, False

    def run(self) -> None:
        while not self.ended:
            self._pass()
            busy = self.port.connected or self.machine.moving or self.machine.task
            looked_at = [self.control, *([self.port] if self.port.connected else [])]
            if self.control in select.select(looked_at, [], [], TICK_S if busy else IDLE_S)[0]:
                self._control()
                self.spoken = time.monotonic()
            if self.port.connected:
                self.spoken = time.monotonic()
            self.ended = self.ended or time.monotonic() - self.spoken > self.linger_s
        self.port.end()
        self.control.close()

    def wall(self, seconds: float) -> float:
        """The clock's time at one of the machine's."""
        return self.began + seconds / self.config.time_factor

    def _pass(self) -> None:
        wall = time.monotonic()
        now = (wall - self.began) * self.config.time_factor
        data = self.port.read()
        if self.port.opened:
            self.port.opened = False
            if self.config.resets_on_open:
                self.machine.advance(now)
                self.machine.power_cycle()
        said = self.machine.advance(now)
        if wall < self.mute_until:
            return
        if data:
            self.machine.receive(data)
            said += self.machine.advance(now)
        if said:
            said, self.junk = self.junk + said, b""
            self.port.write(self._noisy(said) if self.rate else said)

    def _noisy(self, data: bytes) -> bytes:
        out = bytearray()
        for byte in data:
            if self.random.random() >= self.rate:
                out.append(byte)
            elif self.random.random() < 0.5:
                out.append(byte ^ 1 << self.random.randrange(8))
        return bytes(out)

    def _control(self) -> None:
        connection, _ = self.control.accept()
        with connection:
            connection.settimeout(1.0)
            with contextlib.suppress(OSError, ValueError):
                asked = json.loads(connection.makefile("rb").readline())
                self._pass()
                answer = getattr(self, f"_do_{asked.pop('do')}")(**asked)
                connection.sendall(json.dumps(answer or {}).encode() + b"\n")

    def _do_end(self) -> None:
        self.ended = True

    def _do_pull_cable(self) -> None:
        self.port.pull()

    def _do_plug_in(self) -> None:
        self.port.plug_in()

    def _do_power_cycle(self) -> None:
        self.machine.power_cycle()

    def _do_alarm(self, code: int) -> None:
        self.machine.alarm(code)

    def _do_deafen(self) -> None:
        self.machine.deaf = True

    def _do_press(self, button: str) -> None:
        self.machine.receive({"hold": grbl.HOLD, "resume": grbl.RESUME, "reset": grbl.RESET}[button])

    def _do_garbage(self, count: int) -> None:
        self.junk += self.random.randbytes(count)

    def _do_noise(self, rate: float) -> None:
        self.rate = rate

    def _do_silence(self, seconds: float) -> None:
        self.mute_until = time.monotonic() + seconds

    def _do_state(self) -> dict:
        machine = self.machine
        outputs = [name for name, on in machine.exposing.items() if on]
        return {"state": machine.state, "moving": machine.moving, "counter": machine.counter, "truth": machine.truth, "outputs": outputs}

    def _do_motions(self) -> dict:
        return {"motions": [[self.wall(motion[0]), self.wall([*motion, self.machine.now][1])] for motion in self.machine.motions]}

    def _do_moved(self, begin: float, end: float) -> dict:
        motions = reversed(self._do_motions()["motions"])  # the latest first: they are asked about most
        for a, b in motions:
            if a < end and b > begin:
                return {"moved": True}
            if b < begin:
                break
        return {"moved": False}

    def _do_outputs(self) -> dict:
        return {"outputs": [[self.wall(when), name, on] for when, name, on in self.machine.outputs]}


def main(argv: list[str] | None = None) -> int:
    """``python -m strandscope.core.rig.controller``: run one until it is ended. Its first line says how to reach it, as JSON."""
    parser = argparse.ArgumentParser(prog="controller", description="A simulated GRBL controller, as a serial port or on TCP.")
    parser.add_argument("--pty", action="store_true", help="a pseudo-terminal (the default, but on Windows)")
    parser.add_argument("--tcp", action="store_true", help="a TCP port on this machine")
    parser.add_argument("--firmware", choices=(GRBL, GRBLHAL), help="three axes, or four")
    parser.add_argument("--factor", type=float, help="run so many times as fast")
    parser.add_argument("--linger", type=float, default=math.inf, help="end when nobody has spoken to it for so many seconds")
    parser.add_argument("--config", default="{}", help="all of the configuration, as JSON")
    told = parser.parse_args(argv)
    given = json.loads(told.config)
    given["settings"] = {int(number): value for number, value in given.get("settings", {}).items()}
    config = ControllerConfig(**given)
    config = replace(config, firmware=told.firmware or config.firmware, time_factor=told.factor or config.time_factor)
    server = _Server(config, _Tcp() if told.tcp or os.name != "posix" else _Pty(), told.linger)
    print(json.dumps({"url": server.port.url, "control": server.control.getsockname()[1], "pid": os.getpid()}), flush=True)
    with contextlib.suppress(KeyboardInterrupt):
        server.run()
    return 0


if __name__ == "__main__":
    sys.exit(main())
