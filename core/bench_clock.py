"""A clock for several ways to do the same: they take turns, one thread each, and their answers are compared."""

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numba
import numpy as np
from threadpoolctl import threadpool_limits

from .progress import Progress, silent

LEAST_ROUNDS = 3


class Check(NamedTuple):
    """How far two answers are apart."""

    what: str  # is compared
    apart: float
    allowed: float
    unit: str = ""

    @property
    def same(self) -> bool:
        return bool(self.apart <= self.allowed)


class Way(NamedTuple):
    """One way to do it. ``compare(ours, its)`` tells how far its answer is from ours."""

    name: str
    run: Callable[[], Any]
    compare: Callable[[Any, Any], Sequence[Check]] | None = None


class Least(NamedTuple):
    """What must be done at least, of one run, and why."""

    moved_bytes: float
    flops: float
    why: str


class Contest(NamedTuple):
    """Ours and other ways to do the same ``count`` things."""

    stage: str
    what: str
    ours: Way
    others: Sequence[Way]
    least: Least
    count: int = 1
    notes: Sequence[str] = ()


class Rates(NamedTuple):
    """What one thread of this machine can do a second."""

    copied_bytes: float  # read and written
    flops: float  # of float32


def measure(contest: Contest, most: int, seconds: float, progress: Progress = silent) -> dict:
    """The times of every way in up to ``most`` rounds, fewer if these take ``seconds``, and how the answers compare; for JSON."""
    ways = [contest.ours, *contest.others]
    with one_thread():
        answers = [way.run() for way in ways]
        checks = [[*way.compare(answers[0], answer)] if way.compare else [] for way, answer in zip(ways, answers, strict=True)]
        del answers
        rounds, began = [], time.perf_counter()
        while len(rounds) < most and (len(rounds) < LEAST_ROUNDS or time.perf_counter() - began < seconds):
            progress(contest.stage, len(rounds), most)
            rounds.append([_timed(way.run) for way in ways])
    progress(contest.stage, most, most)
    clock, processor = np.moveaxis(np.array(rounds), -1, 0)  # each (rounds, ways)
    told = []
    for i, way in enumerate(ways):
        told.append({"name": way.name, "seconds": clock[:, i].tolist(), "processor_seconds": processor[:, i].tolist()})
        told[i]["checks"] = [check._asdict() | {"apart": float(check.apart), "same": check.same} for check in checks[i]]
        if i:
            told[i]["ratio"] = _quartiles(clock[:, i] / clock[:, 0])
            told[i]["processor_ratio"] = _quartiles(processor[:, i] / np.maximum(processor[:, 0], 1e-9))
    result = {"stage": contest.stage, "what": contest.what, "count": contest.count, "threads": 1, "notes": [*contest.notes]}
    return result | {"ours": told[0], "others": told[1:], "bound": contest.least._asdict()}


def _timed(run: Callable[[], Any]) -> tuple[float, float]:
    """Seconds on the clock and of the processor, all threads together."""
    clock, processor = time.perf_counter(), time.process_time()
    run()
    return time.perf_counter() - clock, time.process_time() - processor


def _quartiles(ratios: np.ndarray) -> dict:
    low, median, high = np.quantile(ratios, [0.25, 0.5, 0.75]).tolist()
    return {"low": low, "median": median, "high": high}


@contextmanager
def one_thread() -> Iterator[None]:
    """Everything that is loaded uses one thread: BLAS, OpenMP, numba, OpenCV."""
    cv2 = sys.modules.get("cv2")
    before, before_cv = numba.get_num_threads(), cv2.getNumThreads() if cv2 else 0
    numba.set_num_threads(1)
    if cv2:
        cv2.setNumThreads(1)
    try:
        with threadpool_limits(limits=1):
            yield
    finally:
        numba.set_num_threads(before)
        if cv2:
            cv2.setNumThreads(before_cv)


def machine_rates(copied: int = 1 << 26, size: int = 1024, tries: int = 5) -> Rates:
    """From copying an array of so many bytes and multiplying matrices (size, size). The best of some tries, by the time of the processor:
    what the machine can do, not what others leave of it."""
    source = np.ones(copied // 4, np.float32)
    target = np.empty_like(source)
    a = np.random.default_rng(0).random((size,) * 2, np.float32)
    with one_thread():
        a @ a
        copies, products = zip(*((_timed(lambda: np.copyto(target, source))[1], _timed(lambda: a @ a)[1]) for _ in range(tries)), strict=True)
    return Rates(2 * source.nbytes / max(min(copies), 1e-6), 2 * size**3 / max(min(products), 1e-6))
