"""How time and memory grow with what a capture is made of: photographs, fibers, how dense these stand; and with the workers.

Captures of several sizes are simulated, and each stage runs on each of them, in a process of its own, once a round. The rounds go
through all sizes one after another, so that whatever else the machine does hits all alike. Every measurement is written as soon as it
is there; a run that was interrupted goes on after the last.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from math import pi, sqrt
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .bench import machine
from .errors import StrandscopeError
from .files import atomic
from .growth_stages import STAGES, STRANDS, Job, Lock, make, measure
from .progress import Progress, silent

RESULT, PICTURE, CAPTURES = "growth.json", "growth.png", "captures"
WARM, WARM_PHOTOGRAPHS = Lock(6, 0.8, 60, 8), Lock(6, 0.8, 60, 2, photographed=True)
QUANTITIES = {"seconds": "time (s)", "memory_bytes": "memory beyond the program's (MB)"}
LEAST_BYTES = 1_000_000  # below this, memory is that of a program, not of its data
AXES = {
    "photographs": "photographs",
    "fibers": "fibers, equally dense",
    "density": "fibers a mm², in the same volume",
    "features": "millions of features, of all these",
    "workers": "workers",
}


@dataclass(frozen=True)
class GrowthParams:
    """What to measure. All locks but those of ``density`` are as dense as ``per_mm2`` says; one of ``base_fibers`` and ``base_sweeps``
    is where ``density``, ``sweeps`` and ``workers`` begin from."""

    stages: tuple[str, ...] = STAGES
    base_fibers: int = 50
    base_sweeps: int = 24
    fibers: tuple[int, ...] = (25, 50, 100, 200)
    density: tuple[int, ...] = (25, 50, 100, 200)  # fibers in the volume of the base
    sweeps: tuple[int, ...] = (6, 12, 24, 48)
    photographed: tuple[int, ...] = (2, 4, 8, 16)  # sweeps of photographs for the filter
    workers: tuple[int, ...] = (1, 2)
    rounds: int = 3
    per_mm2: float = 4.0  # fibers across a lock, as in the simulated locks of other measurements
    rows: int = 140  # of a channel plane: 4 mm
    photographed_rows: int = 300
    photographed_fibers: int = 100
    style: str = "straight"
    seed: int = 0


QUICK = GrowthParams(
    base_fibers=6, base_sweeps=8, fibers=(6, 12), density=(6, 12), sweeps=(8, 16), photographed=(1, 2), workers=(1, 2), rounds=1,
    rows=60, photographed_rows=60, photographed_fibers=6,
)  # fmt: skip


class Case(NamedTuple):
    """One stage on one capture."""

    stage: str
    lock: Lock
    sweeps: int
    workers: int

    @property
    def key(self) -> str:
        return f"{self.stage}, {self.lock.name}, {self.sweeps} sweeps, {self.workers} workers"


class Fit(NamedTuple):
    """``y = slope · x``, by the mean of the logarithms, and the exponent of the power law that fits best (None for a single x)."""

    slope: float
    exponent: float | None


def grow_out(folder: Path, params: GrowthParams | None = None, progress: Progress = silent) -> dict:
    """Measure all that ``params`` ask for, in ``folder``, and return what was measured: what ``describe`` and ``plot`` show.

    Raises StrandscopeError where the folder has measurements of other parameters or of another machine, for wrong parameters, and where
    a stage fails; what ``progress`` raises ends the run.
    """
    params, folder = params or GrowthParams(), Path(folder)
    _check(params)
    report = _kept(folder, params)
    todo = [(case, i) for i in range(params.rounds) for case in cases(params) if len(report["measured"].get(case.key, ())) <= i]
    if not todo:
        return report
    captures = _captures(folder / CAPTURES, params, progress)
    for done, (case, _) in enumerate(todo):

        def tick(done=done):
            progress("measuring", done, len(todo))

        tick()
        report["measured"].setdefault(case.key, []).append(_measured(case, captures, tick))
        _write(folder / RESULT, report)
    progress("measuring", len(todo), len(todo))
    return report


def cases(params: GrowthParams) -> list[Case]:
    """All that is to be measured, each once, small before large; growing before the infill that begins from its curves."""
    found = [case for axis in AXES for stage in params.stages for _, case in _on_axis(axis, stage, params)]
    return sorted(dict.fromkeys(found), key=lambda case: (STAGES.index(case.stage), case.sweeps, case.lock.fibers, case.workers))


def _on_axis(axis: str, stage: str, params: GrowthParams) -> Iterator[tuple[float, Case]]:
    """The cases of one stage along one axis, and the axis' value; of photographs and features, which are known only afterwards, another
    that tells the cases apart."""
    one, base_radius = min(params.workers), _radius_mm(params.base_fibers, params)
    base = Lock(params.base_fibers, base_radius, params.rows, params.base_sweeps)
    if stage == "filter":  # sees neither fibers nor their density, but pixels
        photographed = Lock(
            params.photographed_fibers, _radius_mm(params.photographed_fibers, params), params.photographed_rows, max(params.photographed), True
        )
        if axis == "photographs":
            yield from ((n, Case(stage, photographed, n, one)) for n in params.photographed)
        elif axis == "workers":
            yield from ((n, Case(stage, photographed, photographed.sweeps, n)) for n in params.workers)
    elif axis == "photographs":
        yield from ((n, Case(stage, Lock(base.fibers, base.radius_mm, base.rows, n), n, one)) for n in params.sweeps)
    elif axis == "fibers":
        yield from ((n, Case(stage, Lock(n, _radius_mm(n, params), base.rows, base.sweeps), base.sweeps, one)) for n in params.fibers)
    elif axis == "density":
        across_mm2 = pi * base_radius**2
        yield from ((n / across_mm2, Case(stage, Lock(n, base_radius, base.rows, base.sweeps), base.sweeps, one)) for n in params.density)
    elif axis == "features":
        sizes = [case for other in ("photographs", "fibers", "density") for _, case in _on_axis(other, stage, params)]
        yield from enumerate(dict.fromkeys(sizes))
    elif stage != "index":  # which one thread builds
        yield from ((n, Case(stage, base, base.sweeps, n)) for n in params.workers)


def _radius_mm(fibers: int, params: GrowthParams) -> float:
    return sqrt(fibers / (pi * params.per_mm2))


def _check(params: GrowthParams) -> None:
    for stage in params.stages:
        if stage not in STAGES:
            raise StrandscopeError(f"stage is {stage!r}; expected one of {', '.join(STAGES)}")
    if params.rounds < 1 or not params.workers or min(params.workers) < 1:
        raise StrandscopeError(f"rounds are {params.rounds}, workers {params.workers}; expected 1 or more of each")
    try:
        import resource  # noqa: F401
    except ImportError:
        raise StrandscopeError("this system does not tell how much memory a process took at most; expected Linux or macOS") from None


def _captures(folder: Path, params: GrowthParams, progress: Progress) -> dict[Lock, Path]:
    """The captures of all cases, and the small ones that a process begins with, for which everything is compiled."""
    locks = list(dict.fromkeys([WARM, WARM_PHOTOGRAPHS, *(case.lock for case in cases(params))]))
    captures = {}
    for done, lock in enumerate(locks):

        def inside(_stage, part, total, done=done):
            progress("simulating", done + part / total / 3, len(locks))  # of three steps

        captures[lock] = make(folder, lock, params.style, params.seed, max(params.workers), inside)
    progress("simulating", len(locks), len(locks))
    for done, stage in enumerate(STAGES):

        def tick(done=done):
            progress("compiling", done, len(STAGES))

        tick()
        warm = captures[WARM_PHOTOGRAPHS if stage == "filter" else WARM]
        measure(Job(stage, warm, warm, WARM.sweeps, 1), tick)
    progress("compiling", len(STAGES), len(STAGES))
    return captures


def _measured(case: Case, captures: dict[Lock, Path], tick) -> dict:
    warm = captures[WARM_PHOTOGRAPHS if case.stage == "filter" else WARM]
    job = Job(case.stage, warm, captures[case.lock], case.sweeps, case.workers)
    if case.stage == "infill" and not (job.capture / STRANDS).is_file():
        measure(job._replace(stage="growing"), tick)
    return measure(job, tick)


# ---- what is kept ----------------------------------------------------------------------------------------------------


def _kept(folder: Path, params: GrowthParams) -> dict:
    """The report of a run before, or a new one. More rounds than before may be asked for, nothing else."""
    asked = json.loads(json.dumps({"params": asdict(params), "machine": machine()}))
    try:
        found = json.loads((folder / RESULT).read_text(encoding="utf-8"))
        for part in ("machine", "params"):
            for name, value in asked[part].items():
                if name != "rounds" and found[part].get(name) != value:
                    told = f"measurements with {name} {found[part].get(name)}, not {value}"
                    raise StrandscopeError(f"{folder / RESULT}: holds {told}; expected the same, or another folder")
        return asked | {"measured": found["measured"]}
    except FileNotFoundError:
        return asked | {"measured": {}}
    except (ValueError, KeyError, AttributeError, NotADirectoryError) as error:
        raise StrandscopeError(f"{folder / RESULT}: is not what a run before wrote ({error}); expected another folder") from error


def _write(path: Path, report: dict) -> None:
    with atomic(path) as part:
        part.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


# ---- what came of it -------------------------------------------------------------------------------------------------


class Series(NamedTuple):
    """A stage along an axis: the axis' values (n,), the median of the rounds (n,) of each quantity, and all rounds of each point."""

    stage: str
    x: np.ndarray
    median: dict[str, np.ndarray]
    rounds: dict[str, list[list[float]]]


def series(report: dict, params: GrowthParams, axis: str) -> list[Series]:
    """What was measured along an axis of ``AXES``; stages that do not depend on it, or were not measured, are left out."""
    found = []
    for stage in params.stages:
        points = [(x, report["measured"][case.key]) for x, case in _on_axis(axis, stage, params) if case.key in report["measured"]]
        if not points:
            continue
        if axis in ("photographs", "features"):
            points = [(rounds[0][axis] / (1e6 if axis == "features" else 1), rounds) for _, rounds in points]
        points.sort(key=lambda point: point[0])
        rounds = {
            "seconds": [[one["seconds"] for one in point] for _, point in points],
            "memory_bytes": [[max(one["peak_bytes"] - one["program_bytes"], LEAST_BYTES) for one in point] for _, point in points],
        }
        median = {name: np.array([np.median(point) for point in values]) for name, values in rounds.items()}
        found.append(Series(stage, np.array([x for x, _ in points], float), median, rounds))
    return found


def fit(x: np.ndarray, y: np.ndarray) -> Fit:
    """The line through the origin and the power law through positive points x (n,), y (n,), both by least squares of logarithms."""
    log_x, log_y = np.log(x), np.log(y)
    exponent = float(np.polyfit(log_x, log_y, 1)[0]) if len(np.unique(x)) > 1 else None
    return Fit(float(np.exp(np.mean(log_y - log_x))), exponent)


def describe(report: dict, params: GrowthParams) -> list[tuple[str, str] | None]:
    """The report as rows of names and values."""
    rows = []
    for axis, label in AXES.items():
        told = [(f"  {one.stage}", _row_text(one)) for one in series(report, params, axis)]
        rows += [None, (label, ""), *told] if told else []
    return rows[1:]


def _row_text(one: Series) -> str:
    ends = [f"{_number(one.x[0])} to {_number(one.x[-1])}"]
    for name, size, unit in (("seconds", 1, "s"), ("memory_bytes", 1e6, "MB")):
        y = one.median[name] / size
        ends.append(f"{y[0]:.3g} to {y[-1]:.3g} {unit}{_power(fit(one.x, y), ', as x to the ')}")
    return "; ".join(ends)


def _number(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.2g}" if value < 10 else f"{value:.3g}"


def _power(found: Fit, before: str) -> str:
    return "" if found.exponent is None else f"{before}{found.exponent:.2f}"


def plot(report: dict, params: GrowthParams, path: Path) -> None:
    """Draw time and memory along each axis, both logarithmic: there, a line through the origin rises with one slope wherever it begins."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from .figures import DPI, METHODS, STYLE

    axes_of = {axis: found for axis in AXES if (found := series(report, params, axis))}
    if not axes_of:
        raise StrandscopeError(f"{path}: there is nothing to draw; nothing was measured")
    colors = dict(zip(STAGES, METHODS, strict=True))
    with rc_context(STYLE):
        figure = Figure((3.3 * len(axes_of), 6.6), dpi=DPI, layout="constrained")
        grid = figure.subplots(len(QUANTITIES), len(axes_of), squeeze=False)
        for row, (quantity, label) in zip(grid, QUANTITIES.items(), strict=True):
            for axes, (axis, found) in zip(row, axes_of.items(), strict=True):
                for one in found:
                    _draw(axes, one, quantity, axis, colors[one.stage])
                _finish(axes, found)
                axes.set_xlabel(AXES[axis])
            row[0].set_ylabel(label)
        with atomic(path) as part:
            FigureCanvasAgg(figure).print_png(part)


def _draw(axes, one: Series, quantity: str, axis: str, color: str) -> None:
    """All rounds, faint; their medians; and what would be linear: a line through the origin, or for workers all sharing the work evenly
    (of memory: as much as with one)."""
    size = 1e6 if quantity == "memory_bytes" else 1
    y = one.median[quantity] / size
    found = fit(one.x, y)
    for x, points in zip(one.x, one.rounds[quantity], strict=True):
        axes.plot([x] * len(points), np.array(points) / size, ".", color=color, alpha=0.4, markersize=4)
    axes.plot(one.x, y, "o", color=color, markersize=5, label=f"{one.stage}{_power(found, ', exponent ')}")
    ends = np.array([one.x.min(), one.x.max()])
    if axis == "workers":
        first = y[np.argmin(one.x)]
        line = first * ends[0] / ends if quantity == "seconds" else np.full(2, first)
    else:
        line = found.slope * ends
    axes.plot(ends, line, "--", color=color, linewidth=0.9)


def _finish(axes, found: Sequence[Series]) -> None:
    """Logarithmic, ticks at what was measured, and room for the legend above the points."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter, NullLocator

    axes.set(xscale="log", yscale="log")
    ticks = []
    for x in np.unique(np.concatenate([one.x for one in found])):
        ticks += [x] if not ticks or x > 1.45 * ticks[-1] else []
    axes.xaxis.set_major_locator(FixedLocator(ticks))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _number(value)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    x_low, x_high = (end(np.concatenate([one.x for one in found])) for end in (np.min, np.max))
    axes.set_xlim(x_low / 1.3, x_high * 1.3)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high * (high / low) ** (0.11 * len(found) + 0.06))
    axes.legend(loc="upper left", borderpad=0.2, handletextpad=0.2)
