"""Long work in a child process: started, listened to, stopped. One mechanism for every job, blocking or modal.

The child speaks one JSON line an event on stdout; all else that it says goes to a log file. It stops by itself when its
stdin closes, so it does not outlive Blender. A thread reads its lines; it never touches bpy.
"""

import contextlib
import importlib.util
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import bpy

from ..core.errors import StrandscopeError
from ..core.files import explain
from .props import ROOT

WORKER = Path(__file__).resolve().parent.parent / "worker.py"
STOP_S = 1.0  # from the polite request to end to the other kind
TICK_S = 0.1


@dataclass(frozen=True)
class Command:
    """What a child shall do: the arguments of `strandscope`, a title for people, where its log goes."""

    title: str
    arguments: tuple[str, ...]
    log: Path
    renders: bool = False  # needs bpy: runs in a Blender in the background


@dataclass(frozen=True)
class Result:
    """How a job ended: the file that it made, or what went wrong, or neither if it was stopped."""

    output: Path | None = None
    error: str | None = None


class Job:
    """A child process at work. ``poll`` it until there is a ``Result``."""

    def __init__(self, command: Command, argv: list[str] | None = None):
        """Start it. argv: in place of the worker's own, for tests. Raises StrandscopeError if it cannot be started."""
        self.command = command
        self.stage, self.fraction, self.remaining_s = "starting", 0.0, None
        self._events: queue.SimpleQueue[dict] = queue.SimpleQueue()
        self._output = self._error = self._stop_at = None
        group = {"start_new_session": True} if os.name == "posix" else {"creationflags": subprocess.CREATE_NO_WINDOW}
        try:
            command.log.parent.mkdir(parents=True, exist_ok=True)
            command.log.write_bytes(b"")
            with open(command.log, "ab") as log:  # appended to by the child and by the reader
                self._process = subprocess.Popen(
                    argv or child_argv(command), env=child_environment(), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, **group
                )
        except OSError as error:
            raise explain(error, Path(error.filename or command.log)) from error
        self._reader = threading.Thread(target=self._read, name=command.title, daemon=True)
        self._reader.start()

    def poll(self) -> Result | None:
        """Take in what the child said since the last call; its result once it has ended."""
        if self._stop_at is not None and time.monotonic() > self._stop_at:
            self._signal(kill=True)
        ended = self._process.poll() is not None and not self._reader.is_alive()
        while not self._events.empty():
            self._take(self._events.get())
        if not ended:
            return None
        self._process.stdin.close()
        self._process.stdout.close()
        if self._stop_at is not None:
            return Result()
        if self._process.returncode == 0 and self._output:
            return Result(output=Path(self._output))
        return Result(error=self._error or self._crash())

    def wait(self) -> Result:
        """Block until it has ended."""
        while (result := self.poll()) is None:
            time.sleep(TICK_S / 2)
        return result

    def stop(self) -> None:
        """Ask the child to end; ``poll`` ends it by force when it has not after ``STOP_S``."""
        if self._stop_at is None:
            self._stop_at = time.monotonic() + STOP_S
            self._signal(kill=False)

    @property
    def stopping(self) -> bool:
        return self._stop_at is not None

    def _signal(self, kill: bool) -> None:
        if self._process.poll() is not None:
            return
        if os.name == "posix":  # with the pool of processes that it may have started
            os.killpg(self._process.pid, signal.SIGKILL if kill else signal.SIGTERM)
        elif kill:
            self._process.kill()
        else:
            self._process.stdin.close()  # Windows has no polite request; the child watches this

    def _read(self) -> None:
        with open(self.command.log, "ab", buffering=0) as log:
            for line in self._process.stdout:
                event = _event(line)
                if event is None:
                    log.write(line)
                else:
                    self._events.put(event)

    def _take(self, event: dict) -> None:
        kind = event.get("event")
        if kind == "progress":
            self.stage, self.remaining_s = str(event["stage"]), event.get("remaining_s")
            self.fraction = min(max(event["done"] / event["total"], 0.0), 1.0) if event["total"] else 0.0
        elif kind == "done":
            self._output = event["output"]
        elif kind == "error":
            self._error = event["message"]

    def _crash(self) -> str:
        code = self._process.returncode
        how = f"exit code {code}"
        if code < 0:
            how = f"signal {signal.Signals(-code).name}" if -code in {s.value for s in signal.Signals} else f"signal {-code}"
        return f"{self.command.title} ended unexpectedly while {self.stage} ({how}); what it said is in {self.command.log}"


def child_argv(command: Command) -> list[str]:
    """The child's command line: Blender's own Python, or Blender itself without its window where there is rendering."""
    arguments = ["--progress", "json", "--stop-with-parent", *command.arguments]
    if command.renders and bpy.app.binary_path:
        start = [bpy.app.binary_path, "--background", "--factory-startup", "--python-use-system-env", "--python-exit-code", "1"]
        return [*start, "--python", str(WORKER), "--", *arguments]
    return [sys.executable, "-P", str(WORKER), *arguments]


def child_environment() -> dict[str, str]:
    """Ours, with the way to the packages that this extension brings, and a place for compiled kernels."""
    environment = {k: v for k, v in os.environ.items() if k not in {"PYTHONHOME", "PYTHONSTARTUP"}}
    found = importlib.util.find_spec("numba")
    if found is None or found.origin is None:
        raise StrandscopeError("numba, which came with this extension, is not there; install the extension again")
    environment["PYTHONPATH"] = str(Path(found.origin).parent.parent)
    environment["PYTHONDONTWRITEBYTECODE"] = "1"
    with contextlib.suppress(ValueError):  # where this runs from its repository, not installed as an extension
        environment["NUMBA_CACHE_DIR"] = bpy.utils.extension_path_user(ROOT, path="numba", create=True)
    return environment


def _event(line: bytes) -> dict | None:
    if not line.startswith(b'{"event"'):
        return None
    try:
        return json.loads(line)
    except ValueError:
        return None


class JobOperator:
    """An operator whose work is a job: ``execute`` waits for it, ``invoke`` shows it in the panel and lets Blender live.

    Needs ``command(context)``, which may raise StrandscopeError, and ``finish(context, output)``.
    """

    def execute(self, context):
        try:
            return self._end(context, Job(self.command(context)).wait())
        except StrandscopeError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}

    def invoke(self, context, _event):
        if bpy.app.background:
            return self.execute(context)
        try:
            self._job = Job(self.command(context))
        except StrandscopeError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        context.window_manager.strandscope_job.begin(self._job.command.title)
        self._timer = context.window_manager.event_timer_add(TICK_S, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        state = context.window_manager.strandscope_job
        if state.stop or (event.type == "ESC" and event.value == "PRESS"):
            self._job.stop()
        if event.type != "TIMER":
            return {"RUNNING_MODAL"} if event.type == "ESC" else {"PASS_THROUGH"}
        result = self._job.poll()
        state.show(self._job.stage, self._job.fraction, self._job.remaining_s, self._job.stopping)
        redraw(context)
        if result is None:
            return {"PASS_THROUGH"}
        self._release(context)
        return self._end(context, result)

    def cancel(self, context):
        """Blender closes, or opens another file."""
        self._job.stop()
        self._job.wait()
        self._release(context)

    def _release(self, context):
        context.window_manager.event_timer_remove(self._timer)
        context.window_manager.strandscope_job.end()
        redraw(context)

    def _end(self, context, result: Result):
        if result.output is None:
            self.report({"ERROR"} if result.error else {"INFO"}, result.error or "Stopped")
            return {"CANCELLED"}
        try:
            self.finish(context, result.output)
        except StrandscopeError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}


def redraw(context) -> None:
    """Have the 3D viewports drawn again, sidebars included."""
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()
