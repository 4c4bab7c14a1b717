"""What a program in a terminal, or another program that started it, gets to see of the work: bars, lines, or JSON events."""

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

MODES = ("auto", "rich", "json", "none")
EVENT_INTERVAL_S = 0.1  # between two events of one stage; the first and the last always come
STOP_GRACE_S = 10.0  # how long an interrupted run may take to tidy up


class Reporter:
    """A progress callback that says nothing, and the base of those that do. Results still go to stdout."""

    def __init__(self):
        self._started = {}  # stage -> (time, done) of its first report
        self._moving = {}  # stage -> (time, done) of the first that got further: what came before was getting ready

    def __call__(self, stage: str, done: float, total: float) -> None:
        """``done`` of ``total`` units of ``stage`` are finished."""

    def show(self, text: str) -> None:
        """A result for the reader, on stdout."""
        print(text, flush=True)

    def note(self, text: str) -> None:
        """What a reader should know while the work goes on; one line on stderr."""
        print(f"strandscope: {text}", file=sys.stderr, flush=True)

    def event(self, event: dict) -> None:
        """What work that others can attach to tells of itself; its messages are notes."""
        if event.get("message"):
            self.note(event["message"])

    def done(self, output: Path) -> None:
        """The work succeeded, and what came of it is at ``output``."""

    def failed(self, message: str) -> None:
        """The work failed; one line on stderr."""
        print(f"strandscope: {message}", file=sys.stderr, flush=True)

    def close(self) -> None:
        """No more reports will come."""

    def _rate(self, stage: str, done: float) -> float:
        """Units of the stage a second since the first was ready, 0 while unknown."""
        now = time.monotonic()
        if done <= self._started.setdefault(stage, (now, done))[1]:
            return 0.0
        since, first = self._moving.setdefault(stage, (now, done))
        return (done - first) / (now - since) if now > since else 0.0


class Lines(Reporter):
    """One line on stderr when a stage is complete: for log files."""

    def __init__(self):
        super().__init__()
        self._complete = set()

    def __call__(self, stage, done, total):
        self._rate(stage, done)
        if done >= total and stage not in self._complete:
            self._complete.add(stage)
            print(f"{stage}: done in {time.monotonic() - self._started[stage][0]:.1f} s", file=sys.stderr, flush=True)


class Bars(Reporter):
    """A bar a stage on stderr, with rate and remaining time."""

    def __init__(self):
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

        super().__init__()
        name, rate = TextColumn("{task.description}"), TextColumn("{task.fields[rate]}", justify="right")
        left = TextColumn("left,")
        columns = (name, BarColumn(), TaskProgressColumn(), rate, TimeRemainingColumn(), left, TimeElapsedColumn(), TextColumn("so far"))
        self._bars = Progress(*columns, console=Console(stderr=True), redirect_stdout=False, redirect_stderr=False)
        self._tasks = {}

    def __call__(self, stage, done, total):
        if stage not in self._tasks:
            self._bars.start()
            self._tasks[stage] = self._bars.add_task(stage, rate="")
        self._bars.update(self._tasks[stage], completed=done, total=total, rate=_rate_text(self._rate(stage, done)))

    def show(self, text):
        self._bars.stop()
        super().show(text)

    def note(self, text):
        self._bars.console.print(f"strandscope: {text}", highlight=False, markup=False, soft_wrap=True)

    def failed(self, message):
        self._bars.stop()
        super().failed(message)

    def close(self):
        self._bars.stop()


class Events(Reporter):
    """One JSON object a line on stdout, for programs: progress, done, error. Nothing else is printed there."""

    def __init__(self):
        super().__init__()
        self._last = {}  # stage -> time of its last event

    def __call__(self, stage, done, total):
        now, rate = time.monotonic(), self._rate(stage, done)
        if 0 < done < total and now - self._last.get(stage, 0.0) < EVENT_INTERVAL_S:
            return
        self._last[stage] = now
        remaining = round((total - done) / rate, 1) if rate > 0 else None
        self._print(event="progress", stage=stage, done=done, total=total, remaining_s=remaining)

    def show(self, text):
        """Left out: a program reads files and events."""

    def note(self, text):
        self._print(event="note", message=text)

    def event(self, event):
        self._print(**event)

    def done(self, output):
        self._print(event="done", output=str(output))

    def failed(self, message):
        self._print(event="error", message=message)
        super().failed(message)

    @staticmethod
    def _print(**event):
        print(json.dumps(event), flush=True)


def reporter(mode: str) -> Reporter:
    """The reporter of a mode of ``MODES``. "auto" draws bars on a terminal and writes a line a stage elsewhere."""
    if mode == "json":
        return Events()
    if mode == "rich" or (mode == "auto" and sys.stderr.isatty()):
        return Bars()
    return Lines() if mode == "auto" else Reporter()


def table(rows) -> str:
    """(name, value) pairs, or None for a blank line, as aligned text."""
    width = max((len(row[0]) for row in rows if row), default=0)
    return "\n".join(f"{row[0]:<{width}}  {row[1]}" if row else "" for row in rows)


@contextmanager
def interruptible() -> Iterator[None]:
    """A polite request to end (SIGTERM) interrupts as Ctrl-C does, so that half-written files are removed."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, signal.default_int_handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)  # None: not of Python, as in Blender


@contextmanager
def stops_politely(stop: Callable[[], None], note: Callable[[str], None]) -> Iterator[None]:
    """The first Ctrl-C, or request to end, calls ``stop``, which must be quick; a second one interrupts."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handler(_number, _frame):
        for number in before:
            signal.signal(number, signal.default_int_handler)
        stop()
        note("ending after this photograph; once more: at once")

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number in before:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, signal.SIG_DFL if old is None else old)


def stop_with_parent() -> None:
    """Interrupt this program as Ctrl-C does when its standard input closes: the program that started it is gone."""

    def watch():
        try:
            while os.read(0, 1024):
                pass
        except OSError:
            pass
        if hasattr(signal, "pthread_kill"):  # wakes the main thread from whatever it waits for
            signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
        else:
            signal.raise_signal(signal.SIGINT)
        time.sleep(STOP_GRACE_S)
        os._exit(130)

    threading.Thread(target=watch, name="stop with parent", daemon=True).start()


def _rate_text(rate: float) -> str:
    if rate <= 0:
        return ""
    return f"{rate:.3g}/s" if rate < 1000 else f"{rate:,.0f}/s"
