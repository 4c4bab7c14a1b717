"""The parallel work of a reconstruction on a Dask cluster: photographs, and what growing does to many seeds and curves.

The program that reconstructs is the master. It makes all decisions, in the order in which it makes them alone, and only maps go to the
workers; so the result is the same whatever workers there are, and a lost worker's tasks are done again by another. Each worker
process keeps the index, built from the features files, and learns from a file that only grows which observations are used up.
"""

import logging
import os
import pickle
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .crew import Threads
from .errors import StrandscopeError
from .features import USED, Index, build_index, load_features
from .files import explain
from .geometry import Optics

CONNECT_S = 15.0  # until a scheduler that does not answer is given up
LOOK_S = 1.0  # between looks at whether there are workers
TELL_S, WAIT_S = 10.0, 900.0  # without any worker: until this is said, and until the run ends
KNOWN_S = 5.0  # how long the number of workers is taken for known
LAG_S = 30.0  # until what one machine writes is seen by another
IN_FLIGHT = 3  # photographs for each thread of the cluster that are on their way
TASKS = 2  # for each thread of the cluster, of the items of a map
SENT_BYTES = 4_000_000  # of a message to the scheduler


def unheard(_line: str) -> None:
    """For those who do not want to be told."""


class Cluster:
    """A connection to the scheduler of a Dask cluster. Raises StrandscopeError where there is none.

    files: what every worker must see; tell: is called with a line where the reader should know why nothing happens.
    """

    def __init__(self, scheduler: str, files: Sequence[Path], tell: Callable[[str], None] = unheard):
        try:
            import distributed
        except ImportError as error:
            raise StrandscopeError(f'{scheduler}: Dask is not installed; expected the extra "cluster" (pip install distributed)') from error
        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what goes wrong is told once, below
        self.address, self.files, self.tell = scheduler, tuple(str(Path(file).resolve()) for file in files), tell
        try:
            self._client = distributed.Client(scheduler, timeout=CONNECT_S, set_as_default=False)
        except Exception as error:  # what it raises depends on the address and the moment: AssertionError for tls without certificates
            raise StrandscopeError(f"{scheduler}: no scheduler answers there; expected the address of a `dask scheduler`, tcp://HOST:PORT") from error
        self._threads, self._counted, self._alone_since, self._told = 0, -np.inf, None, False

    def __enter__(self):
        return self

    def __exit__(self, *_error) -> None:
        self._client.close()

    def map(self, function: Callable, jobs: Iterable) -> Iterator:
        """function(job) of every job, in order, with a few on their way at a time. Leaving it early cancels them."""
        pending, jobs = deque(), iter(jobs)
        try:
            while True:
                while len(pending) < IN_FLIGHT * self.threads and (job := next(jobs, self)) is not self:
                    pending.append(self._client.submit(_in_worker, pickle.dumps((function, job)), self.files, versions(), pure=False))
                if not pending:
                    return
                yield self._results([pending[0]])[0]
                pending.popleft()
        finally:
            self._cancel(pending)

    def run(self, calls: Sequence[tuple], state: "State") -> list:
        """What pickled (function, items, arguments) give on the index of ``state``, a list each, in order."""
        futures, first = [], 0
        try:
            while first < len(calls):
                last, size = first + 1, len(calls[first])
                while last < len(calls) and (size := size + len(calls[last])) < SENT_BYTES:
                    last += 1
                futures += self._client.map(_at_index, calls[first:last], state=state, files=self.files, made_with=versions(), pure=False)
                first = last
            return self._results(futures)
        finally:
            self._cancel(futures)

    def forget(self) -> None:
        """Workers need the index no longer."""
        with suppress(Exception):
            self._client.run(_forget, wait=False)

    @property
    def threads(self) -> int:
        """Threads of all workers there are, one at least."""
        if time.monotonic() - self._counted > KNOWN_S:
            self._count()
        return max(self._threads, 1)

    def _results(self, futures: list) -> list:
        """The results of tasks, once all are there."""
        from distributed import CancelledError, KilledWorker, wait

        try:
            while True:
                try:
                    with self._client.as_current():
                        wait(futures, timeout=LOOK_S)
                    break
                except TimeoutError:
                    self._count()
            results = self._client.gather(futures)
            self._lonely(None)
            return results
        except CancelledError as error:
            raise self._gone() from error
        except KilledWorker as error:
            raise StrandscopeError(f"{self.address}: {error.last_worker.address}, like workers before it, ended in one task; see its log") from error

    def _count(self) -> None:
        """Look how many workers there are; say it if there have been none for a while, and end if there are none for long."""
        try:
            self._threads = sum(self._client.nthreads().values())
        except (OSError, ValueError) as error:
            raise self._gone() from error
        if self._client.status != "running":
            raise self._gone()
        self._counted = time.monotonic()
        if self._threads:
            self._lonely(None)
            return
        alone_s = self._counted - (self._alone_since or self._counted)
        self._lonely(self._alone_since or self._counted)
        if alone_s > WAIT_S:
            raise StrandscopeError(f"{self.address}: no worker for {WAIT_S / 60:g} minutes; start one (`dask worker {self.address}`), run again")
        if alone_s > TELL_S and not self._told:
            self.tell(f"{self.address}: there is no worker; waiting for one (`dask worker {self.address}`)")
            self._told = True

    def _lonely(self, since: float | None) -> None:
        """Since when there has been no worker; None: there is one."""
        self._alone_since = since
        if since is None and self._told:
            self.tell(f"{self.address}: a worker is there, the work goes on")
            self._told = False

    def _gone(self) -> StrandscopeError:
        return StrandscopeError(f"{self.address}: the scheduler does not answer any more; start it and run again, what was found is kept")

    def _cancel(self, futures: Iterable) -> None:
        left = [future for future in futures if not future.done()]
        if left:
            with suppress(Exception):
                self._client.cancel(left, force=True)


@dataclass(frozen=True)
class State:
    """Which observations of which index are used up, for a worker to make it so."""

    run: str  # of the master
    features: tuple[str, ...]  # files
    optics: Optics
    log: str  # the file that tells
    begin: int  # where what was used up is told whole
    end: int


class Hands(Threads):
    """The workers of a cluster in place of threads; ``here`` and what is looked at as a whole stay with the master's threads.

    features: the files that ``index`` was built from; log: a file of its own, which is removed in the end.
    """

    ahead = 16  # a map takes some 20 ms more than its work

    def __init__(self, cluster: Cluster, index: Index, count: int, features: Sequence[Path], optics: Optics, log: Path):
        super().__init__(index, count)
        self.cluster, self.log = cluster, Path(log).resolve()
        self._run, self._features, self._optics = uuid.uuid4().hex, tuple(str(Path(path).resolve()) for path in features), optics
        self._begin, self._end, self._anew = 0, 0, True
        self._fresh: list[np.ndarray] = []  # numbers that the file does not tell yet
        try:
            self.log.parent.mkdir(parents=True, exist_ok=True)
            self.log.write_bytes(b"")
        except OSError as error:
            raise explain(error, self.log) from error

    def __exit__(self, *error) -> None:
        super().__exit__(*error)
        self.cluster.forget()
        self.log.unlink(missing_ok=True)
        with suppress(OSError):
            self.log.parent.rmdir()  # where nothing else is left in it

    def each(self, function: Callable, items: Sequence, *arguments) -> list:
        if not items:
            return []
        count = min(len(items), TASKS * self.cluster.threads)
        results = [None] * len(items)
        calls = [pickle.dumps((function, items[i::count], arguments)) for i in range(count)]
        for i, told in enumerate(self.cluster.run(calls, self._told())):
            results[i::count] = told
        return results

    def free(self) -> None:
        super().free()
        self._fresh, self._anew = [], True

    def use(self, numbers: np.ndarray) -> None:
        super().use(numbers)
        self._fresh.append(numbers)

    def _told(self) -> State:
        """What workers must know, once it is written."""
        if self._anew:
            used = np.packbits(self.index.strength >= USED) if self._fresh else np.zeros(0, np.uint8)
            self._begin, self._end = self._end, self._append(used)
        elif self._fresh:
            self._end = self._append(np.concatenate(self._fresh))
        self._fresh, self._anew = [], False
        return State(self._run, self._features, self._optics, str(self.log), self._begin, self._end)

    def _append(self, told: np.ndarray) -> int:
        """Write an array at the end of the file; returns where it ends. Closed each time, which is when other machines see it."""
        try:
            with open(self.log, "ab") as file:
                np.save(file, told)
                return file.tell()
        except OSError as error:
            raise explain(error, self.log) from error


# ---- in a worker -----------------------------------------------------------------------------------------------------


def versions() -> dict[str, str]:
    """All that must be the same for the same bytes."""
    import platform

    import numba
    import scipy

    return {"Python": platform.python_version(), "numpy": np.__version__, "numba": numba.__version__, "scipy": scipy.__version__}


def _in_worker(call: bytes, files: tuple[str, ...], made_with: dict[str, str]):
    """function(job) in a worker that can do it."""
    _check(files, made_with)
    function, job = pickle.loads(call)
    return function(job)


def _at_index(call: bytes, state: State, files: tuple[str, ...], made_with: dict[str, str]) -> list:
    """function(index, item, *arguments) of some items, with what ``state`` says used up."""
    from distributed import get_worker

    _check(files, made_with)
    function, items, arguments = pickle.loads(call)
    held = get_worker().__dict__.setdefault("strandscope", _Held())
    index = held.index_of(state)
    return [function(index, item, *arguments) for item in items]


def _forget(dask_worker) -> None:
    dask_worker.__dict__.pop("strandscope", None)


def _check(files: tuple[str, ...], made_with: dict[str, str]) -> None:
    from distributed import get_worker

    for name, version in versions().items():
        if version != made_with[name]:
            raise StrandscopeError(f"{get_worker().address}: has {name} {version}; expected {made_with[name]} as here, for the same result")
    for file in files:
        if not os.path.exists(file):
            raise StrandscopeError(f"{file}: worker {get_worker().address} does not see it; expected capture and output where all workers do")


class _Held:
    """The index of a worker process, and how far it has read what is used up."""

    def __init__(self):
        self.lock, self.run, self.index, self.begin, self.at = threading.Lock(), "", None, -1, 0

    def index_of(self, state: State) -> Index:
        """The index with what ``state`` says used up. A state that is older than the one before is of a task that nobody waits for."""
        with self.lock:
            if self.run != state.run:
                self.index = None
                self.index = build_index([load_features(Path(path)) for path in state.features], state.optics)
                self.run, self.begin, self.at = state.run, -1, 0
            if (state.begin, state.end) < (self.begin, self.at):
                raise RuntimeError("this task is outdated")
            if state.begin != self.begin:
                self.index.strength[:] &= USED - 1
                self.begin = self.at = state.begin
            self._read(state)
            return self.index

    def _read(self, state: State) -> None:
        wait_until = time.monotonic() + LAG_S
        while self.at < state.end:
            if os.path.exists(state.log) and os.path.getsize(state.log) >= state.end:
                with open(state.log, "rb") as file:
                    file.seek(self.at)
                    while file.tell() < state.end:
                        told = np.load(file)
                        if told.dtype == np.uint8:
                            self.index.strength[np.flatnonzero(np.unpackbits(told, count=len(self.index.strength) if len(told) else 0))] |= USED
                        else:
                            self.index.strength[told] |= USED
                    self.at = file.tell()
            elif time.monotonic() > wait_until:
                raise StrandscopeError(f"{state.log}: a worker does not see it; expected the output where all workers see it")
            else:
                time.sleep(0.1)
