"""The stage and the turntable: motions over a serial line to a controller that runs GRBL 1.1 or grblHAL.

A position counts as reached when the controller has acknowledged every line, among them a ``G4`` that it only answers once it
stands, and then reports Idle *there*, twice alike. All motions are in machine coordinates (``G53``), so that an offset that
somebody has set moves nothing. A cable that is pulled shows as an error of the port or as silence, and is ``StageLost`` at once;
``Stage.recover`` goes on from there.

pyserial opens the port: any of its URLs will do (``/dev/ttyUSB0``, ``COM3``, ``socket://host:port``, ``rfc2217://host:port``).
"""

import contextlib
import re
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

from ..errors import StrandscopeError
from . import grbl
from .grbl import Alarm, Error, Feedback, Garbage, Lines, Ok, Report, Setting, Track, Welcome, follow
from .plan import Lash, Place, Plan, approach
from .wiring import LETTERS, StageConfig, complaints, units_of, value_of

ROUNDING = 0.0011  # units: reports have three decimals, and the firmware counts in single precision
RESETS = 4  # until one is heard
RESENDS = 3  # of lines that were refused because a jog had not ended, or were lost in a start
GRACE_S = 0.5  # after an expected start, in which another welcome is no news
CANCEL_S = 0.5  # that a jog may go on after a hold before it is told to end
LOST_AFTER = 8  # reports of one place, and no answer, after noise: the answer was lost
QUICK_ASKS = 6  # questions that follow the answer at once, when a place is to be confirmed
ALL, ALARMS, NOTHING = "all", "alarms", "nothing"  # what a wait heeds: everything, alarms that are called out, nothing


class StageError(StrandscopeError):
    """The stage cannot do what it was asked for."""


class StageLate(StageError):
    """The controller answers, but what was waited for did not happen in time."""


class StageLost(StageError):
    """Nothing is heard of the controller any more: a cable, a port, its power. ``Stage.recover`` connects again."""


class PositionLost(StageError):
    """The controller no longer knows where the stage is. ``Stage.home`` finds out."""


class StageStopped(StageError):
    """What was waited for was ended by ``Stage.stop`` or ``Stage.reset`` of another thread."""


class StageRefused(StageError):
    """The controller answered ``error:code`` to a line."""

    def __init__(self, message: str, code: int):
        super().__init__(message)
        self.code = code


class StageAlarm(StageError):
    """The controller has stopped for an alarm; 0 if it does not say which. ``Stage.recover`` takes it back, and homes if it must."""

    def __init__(self, message: str, code: int):
        super().__init__(message)
        self.code = code


@dataclass(frozen=True)
class Status:
    """What the controller last said of itself."""

    state: str  # one of grbl.STATES
    substate: int | None
    place: Place | None  # None while no report has told one
    machine: tuple[float, ...] | None  # units, one an axis
    pins: str  # inputs that are triggered: X Y Z A switches, D door, H hold, R reset, S start
    known: bool  # whether ``place`` is true: found by switches, and nothing has happened since
    garbage: int  # lines so far that made no sense

    @property
    def moving(self) -> bool:
        return self.state in grbl.MOVING

    @property
    def paused(self) -> bool:
        return self.state in grbl.PAUSED


@dataclass
class _Sent:
    """A line on its way, and what came back."""

    line: str
    length: int
    answer: Ok | Error | Welcome | None = None


class _Wire:
    """An open port, every failure of which is StageLost."""

    def __init__(self, url: str, baud: int):
        import serial

        self.url, self._lock = url, threading.Lock()
        self._failures = (OSError, serial.SerialException, TypeError, AttributeError)  # the last two: closed by another thread meanwhile
        with contextlib.suppress(ImportError):
            import termios

            self._failures += (termios.error,)
        try:
            self._port = serial.serial_for_url(url, baudrate=baud, timeout=0.01, write_timeout=2.0, do_not_open=True)
            if "://" not in url:
                self._port.exclusive = True
            self._port.open()
        except (*self._failures, ValueError) as error:
            raise StageLost(f"{url}: cannot be opened ({error}); is the controller on, its cable in, and no other program using it?") from error

    def read(self, wait_s: float) -> bytes:
        """What has come; waits so long for the first of it."""
        try:
            if self._port.timeout != wait_s:
                self._port.timeout = wait_s
            data = self._port.read(1)
            while data and len(data) < 4096 and (more := self._port.in_waiting):
                data += self._port.read(more)
            return data
        except self._failures as error:
            raise self._gone(error) from error

    def write(self, data: bytes) -> None:
        try:
            with self._lock:
                self._port.write(data)
        except self._failures as error:
            raise self._gone(error) from error

    def close(self) -> None:
        inner = getattr(self._port, "_socket", None)
        with contextlib.suppress(*self._failures):
            self._port.close()
        if inner:
            inner.close()  # pyserial leaves it open where the other end is gone

    def _gone(self, error: Exception) -> StageLost:
        return StageLost(f"{self.url}: the connection is gone ({error}); look at the cable and the controller's power")


class Stage:
    """A controller that is connected. ``hold``, ``resume``, ``stop`` and ``reset`` may be called while another thread waits for a
    motion; everything else waits its turn."""

    def __init__(self, config: StageConfig, tell: Callable[[str], None] | None = None):
        self.config, self.tell = config, tell or (lambda _message: None)
        self._lock = threading.RLock()
        self._wire: _Wire | None = None
        self._settings: dict[int, str] = {}
        self._window = grbl.RX_BYTES - 1  # bytes of lines that may be on their way
        self._axes_count = 3
        self._known = self._homed_once = False
        self._shift = {"turntable": 0.0, "focus": 0.0}  # units, of an axis that no switch can find again
        self._rest: Place | None = None  # where it last stood for certain
        self._turning = False  # the turntable was sent off and has not been seen to arrive
        self._feeds: set[int] = set()  # that the controller was given: after a restart it knows none
        self._lash = Lash()
        self._stop = self._reset_asked = False
        self._garbage = 0
        self._forget()

    @classmethod
    def open(cls, config: StageConfig, tell: Callable[[str], None] | None = None) -> "Stage":
        """Connect, reset the controller gently and read its settings. The position is not known before ``home``.

        Raises StageLost where no controller answers, StageError where it reports inches or lacks an axis.
        """
        stage = cls(config, tell)
        try:
            stage._connect()
            if not stage._welcomes:
                stage._quiet_reset()
            stage._learn()
        except BaseException:
            stage.close()
            raise
        return stage

    def __enter__(self) -> "Stage":
        return self

    def __exit__(self, *_error) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the port. What moves moves on."""
        wire, self._wire = self._wire, None
        if wire:
            wire.close()

    # ---- asking ------------------------------------------------------------------------------------------------------

    def status(self) -> Status:
        """Ask for a report. After an alarm that silences GRBL, what is known without asking. Raises StageLost."""
        with self._lock:
            before = self._reports
            answered = lambda: self._reports > before or self._alarm in grbl.CRITICAL  # noqa: E731
            self._wait(answered, "a status report", self.config.silent_s + 1, heed=NOTHING, quick=True)
            track = self._track
            return Status(track.state, track.substate, self._place(), track.machine, track.pins, self._known, self._garbage)

    def position(self) -> Place:
        """Where the rig is; of one that stands, as two reports say it. Raises PositionLost if that is not known."""
        with self._lock:
            self._must_know()
            self._fresh()
            told = lambda: self._track.alike >= (1 if self._track.state in grbl.MOVING else 2)  # noqa: E731
            self._wait(told, "two reports of one place", self.config.slack_s, quick=True)
            return self._place()

    def settings(self) -> dict[int, str]:
        """The controller's settings (``$$``) by number, read anew where it stands, else as they last were."""
        with self._lock:
            if self.status().state in ("Idle", "Alarm") and self._alarm not in grbl.CRITICAL:
                self._read_settings()
            return dict(self._settings)

    def complaints(self, plan: Plan | None = None) -> list[str]:
        """What is wrong with the controller's settings, by themselves and for a plan, and what to set."""
        return complaints(self._settings, self.config, self._turntable_axis, plan)

    @property
    def known(self) -> bool:
        """Whether the position is known."""
        return self._known

    @property
    def garbage(self) -> int:
        """Lines so far that made no sense: more than a few tell of a bad cable."""
        return self._garbage

    # ---- moving ------------------------------------------------------------------------------------------------------

    def home(self) -> Place:
        """Find the position with the switches; returns it. Without switches the stage stands on its mark, where the controller was
        switched on.

        Raises StageAlarm (no switch found, …), StageRefused (homing is not enabled), PositionLost where nothing can find it again.
        """
        with self._lock:
            self._known = False
            if self.config.homing:
                self._leave_critical()
                self._settle_down()
                self._alarm = None
                self._exchange(["$H"], self.config.home_s, "homing", heed=ALARMS, silence=True)
            elif self._homed_once:
                raise PositionLost(
                    f"{self.config.url}: the position is lost, and there is no switch to find it; put the stage on its mark by hand, "
                    "switch the controller off and on, and begin anew"
                )
            else:
                self.unlock()
            self._stand()
            self._lash = Lash()
            if self.config.homing and not self.config.turntable_homes:
                self._find_turntable()
            self._arrived()
            self._mark()
            return self._rest

    def assume(self, place: Place) -> None:
        """The rig stands here, as somebody has seen: for axes without switches. Raises StageError while it moves."""
        with self._lock:
            self._leave_critical()
            if self.status().state == "Alarm":
                self.unlock()
            self._stand()
            self._shift = {"turntable": 0.0, "focus": 0.0}
            stands = self._units(place)
            self._shift = {name: self._machine(axis) - units for (name, axis), units in zip(self._axes.items(), stands, strict=True)}
            self._lash = Lash()
            self._arrived()
            self._mark()

    def move_to(self, angle_deg: float, position_mm: float, *, approach_deg: float = 0.0, approach_mm: float = 0.0, settle_s: float = 0.0) -> Place:
        """Go there, each axis arriving from below having gone up at least its approach, and wait until it has stood ``settle_s``.

        Returns where the controller says it stands, within half a step. While it is held (``hold``, or a button) time does not
        count. Raises PositionLost before homing, StageAlarm, StageRefused, StageLost, StageLate, StageStopped, and StageError where
        it came to stand elsewhere twice.
        """
        with self._lock:
            to, tolerances = Place(float(angle_deg), float(position_mm)), self._tolerances()
            for _ in range(2):
                self._must_know()
                here = self._stand()
                at = Place(*(t if abs(a - t) <= near else a for a, t, near in zip(here, to, tolerances, strict=True)))
                legs, lash = approach(at, to, self._lash, Place(approach_deg, approach_mm))
                self._lash = Lash()
                lines, seconds = self._motion(at, legs, settle_s)
                self._exchange(lines, seconds * self.config.slack + self.config.slack_s, f"the stage to reach {_words(to)}")
                here = self._stand()
                if all(abs(a - t) <= near for a, t, near in zip(here, to, tolerances, strict=True)):
                    self._lash = lash
                    self._arrived()
                    return here
                self.tell(f"the stage stands at {_words(here)} and was sent to {_words(to)}; it is sent once more")
            raise StageError(f"{self.config.url}: the stage stands at {_words(here)} and was sent to {_words(to)}; look at the cable, and home")

    def jog(self, angle_deg: float = 0.0, position_mm: float = 0.0, feed: float | None = None) -> None:
        """Start to move by so much, at ``feed`` units a minute, and return. ``cancel_jog`` ends it, ``wait`` waits for its end.

        Needs no homing. Raises StageRefused where it would leave the travel, StageAlarm while an alarm is on.
        """
        with self._lock:
            self._stand()
            self._lash = Lash()
            config = self.config
            for axis, units, usual in (
                (self._turntable_axis, angle_deg / config.turntable_deg_per_unit, config.turntable_feed),
                (config.focus_axis, position_mm / config.focus_mm_per_unit, config.focus_feed),
            ):
                if units:
                    self._turning = self._turning or axis == self._turntable_axis
                    self._exchange([f"$J=G91G21{axis}{units:.4f}F{feed or usual:.0f}"], config.slack_s, "the jog to start")

    def cancel_jog(self) -> Place | None:
        """End a jog; returns where it came to stand, None where the position is not known."""
        with self._lock:
            for _ in range(3):  # a jog that has only just begun may not hear it
                self._now(grbl.CANCEL_JOG)
                with contextlib.suppress(StageLate):
                    place = self.wait(1.0 + 6 * self.config.poll_s)
                    self._now(grbl.RESUME)  # one that ended just then leaves GRBL Idle, but deaf to lines until it is resumed
                    return place
            return self.wait()

    def wait(self, timeout_s: float | None = None) -> Place | None:
        """Wait until it stands; returns where, None where the position is not known. Raises StageLate."""
        with self._lock:
            self._stand(timeout_s)
            if self._known:
                self._arrived()
            return self._rest if self._known else None

    def hold(self) -> None:
        """Feed hold: slow down and halt, keeping the position; of a jog, its end. Returns when it stands, or at once if another
        thread is waiting for the motion."""
        self._now(grbl.HOLD)
        self._if_free(self._halted, "the stage to halt")

    def resume(self) -> None:
        """Go on after a hold."""
        self._now(grbl.RESUME)
        self._if_free(lambda: self._track.state not in ("", *grbl.PAUSED), "the stage to go on; is the safety door open?")

    def stop(self) -> None:
        """End every motion and keep the position: hold, then reset once it stands. Another thread's wait ends with StageStopped."""
        self._stop = True
        self._now(grbl.HOLD)
        if self._lock.acquire(blocking=False):
            try:
                self._stop = False
                self._quiet_reset()
            finally:
                self._lock.release()

    def reset(self) -> None:
        """Reset at once (0x18). Where it moved, the position is lost. Another thread's wait ends with StageStopped."""
        if not self._lock.acquire(blocking=False):
            self._reset_asked = True
            self._now(grbl.RESET)
            return
        try:
            self._reset()
        finally:
            self._lock.release()

    def unlock(self) -> None:
        """Take back an alarm (``$X``). The position is as well known as before.

        Raises StageRefused where the firmware wants to be homed, or a door to be closed first.
        """
        with self._lock:
            self._leave_critical()
            self._alarm = None
            self._exchange(["$X"], self.config.slack_s, "the alarm to be taken back", heed=NOTHING)
            self._fresh()
            self._wait(lambda: self._track.state not in ("", "Alarm"), "the alarm to end", self.config.slack_s, heed=NOTHING, quick=True)
            self._mark()

    # ---- the shutter line --------------------------------------------------------------------------------------------

    def output(self, on: bool) -> None:
        """Switch the shutter line once the stage stands. Returns when the controller has done it."""
        with self._lock:
            self._stand()
            self._exchange(["G4P0", *self.config.shutter(on)], self.config.slack_s, "the shutter line to switch")

    def pulse(self, seconds: float) -> None:
        """Close the shutter line for so long, timed by the controller, once the stage stands."""
        with self._lock:
            self._stand()
            lines = ["G4P0", *self.config.shutter(True), f"G4P{seconds:.3f}", *self.config.shutter(False)]
            self._exchange(lines, seconds * self.config.slack + self.config.slack_s, "the shutter line to switch", again=False)

    # ---- after something went wrong ----------------------------------------------------------------------------------

    def recover(self, timeout_s: float = 600.0, home: bool = True) -> bool:
        """Connect again as often as it takes, take back an alarm, and home if the position is lost. Returns whether it was kept.

        It is kept where the controller proves not to have restarted: it has not said its welcome, is in no alarm that loses it,
        and still knows a feed rate that it was given, which a restart forgets. Raises StageLost after ``timeout_s``,
        PositionLost (with ``home=False``, or where nothing can find it again), StageAlarm and StageRefused of homing.
        """
        with self._lock:
            self._stop = self._reset_asked = False
            end, said = time.monotonic() + timeout_s, ""
            while True:
                try:
                    self._known = self._again()
                    self._learn()
                    break
                except StageLost as error:
                    self.close()
                    if time.monotonic() > end:
                        raise StageLost(f"{error}; gave up after {timeout_s:g} s") from error
                    if str(error) != said:
                        said = str(error)
                        self.tell(said)
                    time.sleep(min(0.5, 2 * self.config.poll_s))
            self._restarted = False
            if self._known and (self._track.state == "Alarm" or self._alarm is not None):
                try:
                    self.unlock()
                except StageRefused:
                    self._known = False
            if self._known:
                self._stand()
                self._arrived()
                return True
            if not home:
                raise PositionLost(f"{self.config.url}: the controller is there, but no longer knows its position; home it")
            self.tell("the controller no longer knows its position; it is homed")
            self.home()
            return False

    def _again(self) -> bool:
        """A controller that answers; returns whether the position is still known. Raises StageLost."""
        if self._wire is not None:
            if self._alarm in grbl.CRITICAL:
                self._leave_critical()
            else:
                self._settle_down()
                self._quiet_reset()
            return self._known
        known = self._known
        self._connect()
        if self._welcomes or not known or (self._alarm is not None and self._alarm not in grbl.POSITION_KEPT):
            return False
        self._known = True
        self._wait(lambda: self._track.state, "a status report", self.config.silent_s + 1, heed=NOTHING)
        if self._track.state in grbl.PAUSED:  # no restarted controller is in a hold with a motion before it
            self._quiet_reset()
            return self._known
        self._wait(lambda: self._track.state not in ("Run", "Jog", "Home"), "the motion to end", self.config.home_s, heed=NOTHING)
        return self._track.state in ("Idle", "Alarm") and self._modal_feed() in self._feeds and not self._welcomes

    def _modal_feed(self) -> float | None:
        """The feed rate that the parser remembers (``$G``). Asked twice: the first may end half a line of the last connection."""
        for _ in range(2):
            self._feedback.clear()
            with contextlib.suppress(StageRefused):
                self._exchange(["$G"], self.config.silent_s, "the parser's state", heed=NOTHING)
        modes = [message.text for message in self._feedback if message.tag == "GC"]
        found = re.search(r"\bF(\d+(?:\.\d+)?)", modes[-1]) if modes else None
        return float(found[1]) if found else None

    # ---- connecting --------------------------------------------------------------------------------------------------

    def _forget(self) -> None:
        """Nothing has been heard over this connection."""
        self._incoming, self._track = Lines(), Track()
        self._sent: deque[_Sent] = deque()
        self._feedback: list[Feedback] = []
        self._alarm: int | None = None
        self._restarted = False
        self._welcomes = self._reports = 0
        self._heard = self._asked = self._expected = time.monotonic()
        self._jogged = 0.0  # since when a jog goes on that should end

    def _connect(self) -> None:
        """Open the port and wait for a sign of life: the welcome of a controller that restarts when its port is opened, or the
        report of one that does not. One that is silent may be in an alarm that only a reset ends."""
        self.close()
        self._forget()
        self._wire = _Wire(self.config.url, self.config.baud)
        try:
            alive = lambda: self._welcomes or self._reports  # noqa: E731
            self._wait(alive, "a controller", self.config.welcome_s, heed=NOTHING, silence=True)
        except StageLate:
            self._now(grbl.RESET)
            try:
                self._wait(lambda: self._welcomes, "a controller", self.config.welcome_s, heed=NOTHING, silence=True, ask=False)
            except StageLate:
                self.close()
                raise StageLost(
                    f"{self.config.url}: nothing that speaks GRBL answers at {self.config.baud} baud; is the controller on, and this its port?"
                ) from None
        self._expected = time.monotonic()

    def _quiet_reset(self) -> None:
        """Reset without losing the position: halt first. Half a line that a program before us has left is gone then."""
        if self._alarm not in grbl.CRITICAL:
            self._fresh()
            self._wait(lambda: self._track.state, "a status report", self.config.silent_s + 1, heed=NOTHING, quick=True)
            if self._track.state in ("Run", "Jog", *grbl.PAUSED):
                self._now(grbl.HOLD)
                with contextlib.suppress(StageLate):
                    self._wait(self._halted, "the stage to halt", self.config.slack_s, heed=NOTHING)
        self._reset()

    def _reset(self) -> None:
        before, welcomes = self._track.state, self._welcomes
        alarm, self._alarm = self._alarm, None
        self._sent.clear()
        self._expected = time.monotonic() + RESETS * (self.config.welcome_s + 1.0)
        started = lambda: self._welcomes > welcomes  # noqa: E731
        for sent in range(1, RESETS + 1):  # GRBL does not hear one in the half second in which it calls out a critical alarm
            self._now(grbl.RESET)
            try:
                self._wait(started, "the controller to start again", self.config.welcome_s, heed=NOTHING, silence=True, ask=False)
                break
            except StageLate:
                if sent == RESETS:
                    raise
        self._expected = time.monotonic() + (1.0 if sent > 1 else 0.0)  # each that was heard has its welcome
        self._reset_asked = self._stop = self._restarted = False
        self._fresh()
        self._wait(lambda: self._track.state, "a status report", self.config.silent_s + 1, heed=NOTHING, quick=True)
        newly_locked = self._track.state == "Alarm" and before != "Alarm"
        if any(a is not None and a not in grbl.POSITION_KEPT for a in (alarm, self._alarm)) or before in grbl.MOVING or newly_locked:
            self._known = False
        self._lash = Lash()
        self._alarm = None
        self._mark()

    def _mark(self) -> None:
        """Give the controller a feed rate: as long as it knows one, it has not restarted."""
        if self._known and self._track.state == "Idle":
            self._exchange([f"F{max(round(self.config.focus_feed), 1)}"], self.config.slack_s, "the controller to answer", heed=NOTHING)

    def _leave_critical(self) -> None:
        if self._alarm in grbl.CRITICAL:
            with contextlib.suppress(StageLate):  # it says when it will hear
                ready = lambda: any("Reset" in message.text for message in self._feedback)  # noqa: E731
                self._wait(ready, "the controller", 1.0, heed=NOTHING, silence=True, ask=False)
            self._reset()

    def _settle_down(self) -> None:
        """After an alarm that resets by itself, the welcome is still to come."""
        if self._alarm is not None and self._alarm not in grbl.CRITICAL and not self._restarted:
            self._expected = time.monotonic() + 2.0
            with contextlib.suppress(StageLate):
                self._wait(lambda: self._restarted or (self._track.state == "Alarm" and self._track.alike), "the controller", 2.0, heed=NOTHING)
        self._restarted = False

    def _learn(self) -> None:
        """Read settings and options, and refuse what would make nonsense of positions."""
        self._wait(lambda: self._track.state in ("Idle", "Alarm", "Check"), "the controller to be ready", self.config.slack_s, heed=NOTHING)
        self._read_settings()
        self._feedback.clear()
        with contextlib.suppress(StageRefused):
            self._exchange(["$I"], self.config.slack_s, "the firmware's name", heed=NOTHING)
        for message in self._feedback:
            sizes = message.text.split(",")
            if message.tag == "OPT" and len(sizes) >= 3 and sizes[2].isdigit() and int(sizes[2]) > 1:
                self._window = min(int(sizes[2]), 1024) - 1
        if self._settings.get(13, "0").strip() == "1":
            raise StageError(f"{self.config.url}: the controller reports inches; set $13=0")
        self._wait(lambda: self._track.machine is not None, "a report with a position", self.config.home_s, heed=NOTHING)
        self._axes_count = len(self._track.machine)
        letters = LETTERS[: self._axes_count]
        for axis in (self.config.focus_axis, self._turntable_axis):
            if axis not in letters:
                raise StageError(
                    f"{self.config.url}: the controller has no axis {axis}, only {', '.join(letters)}; name another in the rig's settings"
                )

    def _read_settings(self) -> None:
        self._settings = {}
        self._exchange(["$$"], self.config.slack_s, "the settings", heed=NOTHING)

    # ---- speaking ----------------------------------------------------------------------------------------------------

    def _now(self, byte: bytes) -> None:
        """Send a real-time command."""
        self._connected().write(byte)

    def _connected(self) -> _Wire:
        if self._wire is None:
            raise StageLost(f"{self.config.url}: not connected; recover first")
        return self._wire

    def _exchange(self, lines: list[str], timeout_s: float, what: str, heed: str = ALL, silence: bool = False, again: bool = True) -> None:
        """Send lines and wait until each is answered. Those that a jog before them has locked out are sent again, and, with
        ``again``, all if an answer was lost.

        Raises StageRefused for the first that is refused.
        """
        for _ in range(RESENDS):
            sent = self._stream(lines, timeout_s, what, heed, silence)
            if any(s.answer is None or isinstance(s.answer, Welcome) for s in sent):  # lost to noise, or in a start that was expected
                if not again:
                    break
                continue
            refused = [s for s in sent if isinstance(s.answer, Error)]
            if not refused:
                return
            first = refused[0]
            if first.answer.code not in (8, 9) or first is not sent[0] or not self._idle_again():
                raise StageRefused(
                    f"{self.config.url}: {first.line} was refused: {grbl.error_in_words(first.answer.code, first.answer.text)}", first.answer.code
                )
        raise StageLate(f"{self.config.url}: no answer came through, waiting for {what}; {self._condition()}")

    def _stream(self, lines: list[str], timeout_s: float, what: str, heed: str, silence: bool) -> list[_Sent]:
        """Send lines, never more of them at a time than the controller's buffer holds (character counting)."""
        waiting, sent, garbage, nudged = deque(lines), [], self._garbage, False
        self._sent.clear()

        def done() -> bool:
            nonlocal nudged
            while waiting and (not self._sent or sum(s.length for s in self._sent) + len(waiting[0]) + 1 <= self._window):
                data = grbl.encode(waiting[0])
                sent.append(_Sent(waiting.popleft(), len(data)))
                self._sent.append(sent[-1])
                self._connected().write(data)
                if feed := re.fullmatch(r"(?:G53G1.*)?F(\d+)", sent[-1].line):
                    self._feeds.add(int(feed[1]))
            stuck = self._track.alike >= LOST_AFTER and self._track.state in ("Idle", "Alarm", "Check")
            if stuck and self._sent and not nudged:  # Idle, but deaf: see cancel_jog. Does nothing else where nothing is held
                nudged = True
                self._now(grbl.RESUME)
            lost = stuck and self._garbage > garbage
            return not waiting and (not self._sent or lost)

        self._wait(done, what, timeout_s, heed=heed, silence=silence)
        self._sent.clear()
        return sent

    def _idle_again(self) -> bool:
        """Whether what locks the controller ends by itself, and has: a jog does, an alarm does not."""
        self._fresh()
        self._wait(lambda: self._track.state not in ("", "Jog", "Run", "Home"), "the jog to end", self.config.home_s, heed=ALARMS)
        return self._track.state == "Idle"

    def _motion(self, at: Place, legs: list[Place], settle_s: float) -> tuple[list[str], float]:
        """Lines that go from place to place and then wait, and about how many seconds they take. Each axis moves by itself: their
        units have nothing in common, and a feed along both would mean nothing."""
        lines, seconds, here = ["G21G90G94"], settle_s, self._units(at)
        feeds = (self.config.turntable_feed, self.config.focus_feed)
        for leg in legs:
            to = self._units(leg)
            for axis, a, t, feed in zip(self._axes.values(), here, to, feeds, strict=True):
                if a != t:
                    lines.append(f"G53G1{axis}{t:.4f}F{max(round(feed), 1)}")
                    rate = min(feed, self._setting(110, axis) or feed)
                    ramp = rate / 60 / (self._setting(120, axis) or 10.0)
                    seconds += abs(t - a) / rate * 60 + ramp
                    self._turning = self._turning or axis == self._turntable_axis
            here = to
        return [*lines, f"G4P{settle_s:.3f}"], seconds

    # ---- hearing -----------------------------------------------------------------------------------------------------

    def _wait(
        self, done: Callable, what: str, timeout_s: float, *, heed: str = ALL, silence: bool = False, ask: bool = True, quick: bool = False
    ) -> None:
        """Listen, asking for the status now and then, until ``done``. While the stage is held, time does not count, and while it is
        seen to move, ``slack_s`` are always left.

        ``silence``: the controller need not answer questions meanwhile. ``quick``: ask again as soon as it has answered, a few
        times. Raises StageLate, StageLost, and what ``_heed`` does.
        """
        start = last = time.monotonic()
        end, asks, answered, told, place = start + timeout_s, 0, -1, False, self._track.machine
        while True:
            now = time.monotonic()
            if heed == ALL and self._track.state in grbl.PAUSED:
                end += now - last
                if not told:
                    told = True
                    self.tell("the safety door is open" if self._track.state == "Door" else "the stage is held; resume to go on")
            last = now
            if self._track.machine != place and self._track.state in grbl.MOVING:
                place, end = self._track.machine, max(end, now + min(timeout_s, self.config.slack_s))
            self._heed(heed, what)
            if done():
                return
            if now > end:
                raise StageLate(f"{self.config.url}: waited {now - start:.1f} s for {what}; {self._condition()}")
            if not silence and now - max(self._heard, start) > self.config.silent_s and self._alarm not in grbl.CRITICAL:
                self.close()
                raise StageLost(f"{self.config.url}: no answer for {self.config.silent_s:g} s, waiting for {what}; look at cable and power")
            soon = quick and asks < QUICK_ASKS and self._reports != answered
            if ask and (soon or now - self._asked >= self.config.poll_s):
                asks, answered, self._asked = asks + 1, self._reports, now
                self._now(grbl.STATUS)
            self._listen(min(self.config.poll_s / 2, 0.02))

    def _heed(self, heed: str, what: str) -> None:
        """Raise what has happened that ends a wait."""
        if heed == NOTHING:
            return
        if self._reset_asked:
            if self._restarted:
                self._restarted = self._reset_asked = self._known = False
                self._alarm = None
                raise StageStopped(f"{self.config.url}: the controller was reset, waiting for {what}; home")
            return
        if self._restarted and self._alarm is None:
            self._restarted = self._known = False
            raise PositionLost(f"{self.config.url}: the controller has restarted by itself, waiting for {what}; look at its power, and home")
        if self._alarm is not None:
            code, text = self._alarm, ""
        elif heed == ALL and self._track.state == "Alarm":
            code, text = self._track.substate or 0, "the controller is locked"
        else:
            code = None
        if code is not None:
            if code not in grbl.POSITION_KEPT:
                self._known = False
            raise StageAlarm(f"{self.config.url}: waiting for {what}: {grbl.alarm_in_words(code, text)}", code)
        if self._stop and (heed == ALARMS or self._halted()):
            self._stop = False
            if heed == ALARMS:  # homing heeds nothing but a reset
                self._reset()
                self._known = False
            else:
                self._quiet_reset()
            raise StageStopped(f"{self.config.url}: stopped, waiting for {what}")

    def _listen(self, wait_s: float) -> None:
        try:
            data = self._connected().read(wait_s)
        except StageLost:
            self.close()
            raise
        for line in self._incoming.feed(data):
            self._hear(grbl.parse_line(line))

    def _hear(self, message: grbl.Message) -> None:
        self._track = follow(self._track, message)
        if not isinstance(message, Garbage):
            self._heard = time.monotonic()
        match message:
            case Ok() | Error():
                if self._sent and self._alarm is None:  # after an alarm GRBL answers ok to the line that it has not done
                    self._sent.popleft().answer = message
            case Alarm():
                self._alarm = message.code
                self._feedback.clear()
            case Welcome():
                self._welcomes += 1
                self._restarted = self._reset_asked or time.monotonic() > self._expected + GRACE_S
                for sent in self._sent:
                    sent.answer = message
                self._sent.clear()
            case Report():
                self._reports += 1
            case Setting():
                self._settings[message.number] = message.value
            case Feedback():
                self._feedback.append(message)
            case Garbage():
                self._garbage += 1

    def _fresh(self) -> None:
        """What was reported so far is no longer news."""
        self._track = replace(self._track, state="", substate=None, alike=0)

    def _if_free(self, done: Callable, what: str) -> None:
        """Wait, unless another thread does; it will see."""
        if self._lock.acquire(blocking=False):
            try:
                self._fresh()
                self._wait(lambda: done() or self._alarm is not None, what, self.config.slack_s, heed=NOTHING)
            finally:
                self._lock.release()

    # ---- where it is -------------------------------------------------------------------------------------------------

    def _stand(self, timeout_s: float | None = None) -> Place:
        """Wait until two reports in a row say Idle at one place; returns it."""
        self._fresh()
        standing = lambda: self._track.standing is not None  # noqa: E731
        self._wait(standing, "the stage to stand", self.config.home_s if timeout_s is None else timeout_s, quick=True)
        return self._place()

    @property
    def _held(self) -> bool:
        """Whether a hold has come to its end: with a motion before it, but standing."""
        track = self._track
        ended = track.substate == 0 or (track.state == "Door" and track.substate == 1) or (track.substate is None and track.alike >= 2)
        return track.state in grbl.PAUSED and ended

    def _halted(self) -> bool:
        """Whether a hold, or what came of it, is over. A jog, which GRBL ends by it, grblHAL only ends when told to."""
        if self._track.state == "Jog":
            self._jogged = self._jogged or time.monotonic()
            if time.monotonic() - self._jogged > CANCEL_S:
                self._jogged = 0.0
                self._now(grbl.CANCEL_JOG)
        else:
            self._jogged = 0.0
        return self._held or self._track.state in ("Idle", "Alarm", "Check", "Sleep")

    def _must_know(self) -> None:
        if not self._known:
            raise PositionLost(f"{self.config.url}: the position is not known; home first")

    def _arrived(self) -> None:
        self._rest, self._turning, self._known, self._homed_once = self._place(), False, True, True

    def _find_turntable(self) -> None:
        """A turntable without a switch stands where it last stood, whatever the controller counts now."""
        if self._rest is None:
            return
        if self._turning:
            raise PositionLost(
                f"{self.config.url}: the turntable was turning when it was lost, and has no switch; turn it to its mark by hand, and say so (assume)"
            )
        config = self.config
        stands = self._rest.angle_deg / config.turntable_deg_per_unit + config.turntable_origin
        self._shift["turntable"] = self._machine(self._turntable_axis) - stands

    @property
    def _turntable_axis(self) -> str:
        return self.config.turntable_axis if self.config.turntable_axis != "auto" else "A" if self._axes_count > 3 else "Y"

    @property
    def _axes(self) -> dict[str, str]:
        """The controller's letters, in the order of a Place."""
        return {"turntable": self._turntable_axis, "focus": self.config.focus_axis}

    def _machine(self, axis: str) -> float:
        return self._track.machine[LETTERS.index(axis)]

    def _place(self) -> Place | None:
        machine = self._track.machine
        if machine is None or max(LETTERS.index(axis) for axis in self._axes.values()) >= len(machine):
            return None
        config = self.config
        angle = (self._machine(self._turntable_axis) - self._shift["turntable"] - config.turntable_origin) * config.turntable_deg_per_unit
        position = (self._machine(config.focus_axis) - self._shift["focus"] - config.focus_origin) * config.focus_mm_per_unit
        return Place(round(angle, 6), round(position, 6))

    def _units(self, place: Place) -> tuple[float, float]:
        """Machine coordinates of turntable and focus axis."""
        turntable, focus = units_of(place, self.config)
        return turntable + self._shift["turntable"], focus + self._shift["focus"]

    def _setting(self, group: int, axis: str) -> float | None:
        return value_of(self._settings, group + LETTERS.index(axis))

    def _tolerances(self) -> Place:
        """Half a step of each axis, as reports tell it: degrees and mm."""
        halves = []
        for axis in self._axes.values():
            steps = self._setting(100, axis)
            halves.append(0.5 / steps + ROUNDING if steps else 0.01)
        return Place(halves[0] * abs(self.config.turntable_deg_per_unit), halves[1] * abs(self.config.focus_mm_per_unit))

    def _condition(self) -> str:
        """The last that was heard, in words."""
        place = self._place() if self._known else None
        where = f" at {_words(place)}" if place else ""
        noise = f"; {self._garbage} lines made no sense (a bad cable?)" if self._garbage else ""
        return f"the controller says {self._track.state or 'nothing'}{where}{noise}"


def _words(place: Place) -> str:
    return f"{place.angle_deg:.3f}°, {place.position_mm:.3f} mm"
