"""The captures on which it is measured how cost grows, and one measurement: a stage, run once in a process of its own.

A process first runs its stage on a very small capture, which loads what is compiled. Then it reads what the stage needs, and the time
and the memory of the stage alone are taken.
"""

import multiprocessing
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from threadpoolctl import threadpool_limits

from .capture import Capture, features_path, load_capture
from .confidence import expected_error
from .errors import StrandscopeError
from .features import build_index, load_features
from .pipeline import captured_strands, end_with_parent, find_features, infill_strands, measured, preset, resolve, work_folder
from .progress import Progress, silent
from .refine import trace
from .simulate import Scale, SimulateParams, simulate
from .simulate_features import simulate_features
from .strands import load_strands, save_strands

STAGES = ("filter", "index", "growing", "infill")
POLL_S = 0.1
MARGIN_MM = 0.5  # that a capture shows around its lock
STRANDS = "strands.npz"  # in a capture, of its growing; the infill begins from them


@dataclass(frozen=True)
class Lock:
    """Hair to measure on."""

    fibers: int
    radius_mm: float
    rows: int  # of the channel plane: how tall
    sweeps: int
    photographed: bool = False  # photographs for the filter; else features

    @property
    def name(self) -> str:
        """Of its folder."""
        return f"{'photographs' if self.photographed else 'features'}-{self.fibers}-{self.radius_mm:.2f}mm-{self.rows}-{self.sweeps}"


class Job(NamedTuple):
    """What a process is to measure."""

    stage: str  # one of STAGES
    warm: Path  # capture to run it on beforehand
    capture: Path
    sweeps: int  # to take of the capture, the first ones
    workers: int


def make(folder: Path, lock: Lock, style: str, seed: int, workers: int = 0, progress: Progress = silent) -> Path:
    """The capture of a lock, in ``folder``, made if it is not there. Returns its folder."""
    half_mm = lock.radius_mm + MARGIN_MM
    pitch_mm = SimulateParams.pitch_mm
    scale = Scale(lock.rows, round(2 * half_mm / pitch_mm), lock.sweeps, half_mm, lock.fibers, lock.radius_mm, 0)
    work = simulate if lock.photographed else simulate_features
    return work(Path(folder) / lock.name, SimulateParams(style, scale, seed=seed), progress=progress, workers=workers).folder


def measure(job: Job, tick: Callable[[], None] = lambda: None) -> dict:
    """Run the job in a process of its own and return what it took; ``tick`` is called while it runs, and may raise to cancel it.

    ``seconds`` on the clock and ``processor_seconds`` of all its processes; ``peak_bytes`` of memory at most and ``program_bytes`` before
    the stage read anything; and ``photographs``, ``features``, ``curves``. Raises StrandscopeError where it fails.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_run, args=(job, theirs))
    process.start()
    theirs.close()
    try:
        while not ours.poll(POLL_S):
            tick()
        answer = ours.recv()
    except EOFError:
        process.join()
        raise StrandscopeError(
            f"{job.capture}: measuring the stage {job.stage} ended with code {process.exitcode}; is there memory enough?"
        ) from None
    finally:
        if sys.exc_info()[0]:
            process.kill()
        process.join()
        ours.close()
    if isinstance(answer, StrandscopeError):
        raise answer
    return answer


# ---- in the process --------------------------------------------------------------------------------------------------


def _run(job: Job, answer: Connection) -> None:
    """Measure, and send the numbers or what is wrong."""
    end_with_parent()
    try:
        answer.send(_measured(job))
    except StrandscopeError as error:
        answer.send(error)


def _measured(job: Job) -> dict:
    with TemporaryDirectory(prefix="strandscope-") as scratch, threadpool_limits(job.workers):
        stage = _STAGES[job.stage]
        stage(load_capture(job.warm), Path(scratch) / "warm", job.workers)[0]()
        program_bytes = _resident_bytes()
        capture = load_capture(job.capture)
        capture = replace(capture, sweeps=capture.sweeps[: job.sweeps])
        run, keep = stage(capture, Path(scratch) / "run", job.workers)
        clock, processor = time.perf_counter(), _processor_seconds()
        result = run()
        clock, processor = time.perf_counter() - clock, _processor_seconds() - processor
        peak_bytes = _peak_bytes(job.workers)
        told = {"seconds": clock, "processor_seconds": processor, "peak_bytes": peak_bytes, "program_bytes": program_bytes}
        return told | {"photographs": sum(len(sweep.files) for sweep in capture.sweeps)} | keep(result)


def _filter(capture: Capture, scratch: Path, workers: int) -> tuple[Callable, Callable]:
    parameters = resolve(capture, preset())
    return lambda: find_features(capture, scratch, parameters, workers, silent), lambda sweeps: {"features": sum(map(len, sweeps))}


def _index(capture: Capture, _scratch: Path, _workers: int) -> tuple[Callable, Callable]:
    sweeps = _sweeps(capture)
    return lambda: build_index(sweeps, capture.optics), lambda _: {"features": sum(map(len, sweeps))}


def _growing(capture: Capture, _scratch: Path, workers: int) -> tuple[Callable, Callable]:
    """Curves, what error they are expected to have, and their radius."""
    parameters, sweeps = resolve(capture, preset()), _sweeps(capture)
    index = build_index(sweeps, capture.optics)

    def run():
        grown = trace(index, parameters.grow, parameters.refine, workers, silent)
        curves = grown.points_mm, grown.offsets
        error = expected_error(index, parameters.grow, parameters.refine, *curves, grown.evidence, workers)
        return captured_strands(grown, error, measured(index, sweeps, *curves, parameters.grow, parameters.refine, parameters.radius, workers), {})

    def keep(strands):
        if not (capture.folder / STRANDS).is_file():
            save_strands(capture.folder / STRANDS, strands)
        return {"features": sum(map(len, sweeps)), "curves": len(strands)}

    return run, keep


def _infill(capture: Capture, _scratch: Path, workers: int) -> tuple[Callable, Callable]:
    """Hull, carving, directions and the curves of the inside."""
    parameters, sweeps, strands = resolve(capture, preset()), _sweeps(capture), load_strands(capture.folder / STRANDS)
    work = work_folder(capture, capture.folder, parameters)
    return (
        lambda: infill_strands(capture, work, sweeps, strands, parameters, workers, silent),
        lambda filled: {"features": sum(map(len, sweeps)), "curves": len(filled)},
    )


_STAGES = dict(zip(STAGES, (_filter, _index, _growing, _infill), strict=True))


def _sweeps(capture: Capture) -> list:
    return [load_features(features_path(capture.folder / capture.features, i)) for i in range(len(capture.sweeps))]


def _processor_seconds() -> float:
    """Of this process and of those that it waited for."""
    import resource

    return sum(t.ru_utime + t.ru_stime for t in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)))


def _resident_bytes() -> int:
    """Memory in use now, where the system tells; from here on the peak is counted anew. Else the peak so far."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
        return _proc_bytes("VmRSS")
    except OSError:
        return _peak_bytes(1)


def _peak_bytes(workers: int) -> int:
    """Memory at most: of this process, and of as many as the largest that it waited for as there are workers, for they run at once.

    Linux tells of this process what it took since it began its program; getrusage tells what the one that started it took, if more.
    """
    import resource

    unit = 1 if sys.platform == "darwin" else 1024
    own, child = (resource.getrusage(who).ru_maxrss * unit for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    with suppress(OSError):
        own = _proc_bytes("VmHWM")
    return own + (workers * child if workers > 1 else 0)


def _proc_bytes(name: str) -> int:
    lines = Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{name}:"))
