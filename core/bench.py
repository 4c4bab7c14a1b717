"""How fast the stages are beside what a user would otherwise take, all in one run on one machine.

The ways to do one thing take turns (A B C, A B C, …), so that whatever else the machine does hits all alike, and are compared round by
round. Each uses one thread: photographs and seeds are what the stages spread over cores. All run once beforehand, which compiles them,
and their answers are compared. Beside the time on the clock stands that of the processor, which a busy machine distorts less.

How near a kernel is to its bound is told by the bytes it must move and the flops it must do at least, at the rates at which this machine
copies a big array and multiplies big matrices in the same run.
"""

import os
import platform
import sys
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from .bench_clock import Rates, machine_rates, measure
from .bench_inputs import STAGES, BenchParams
from .bench_stages import contests_of
from .errors import StrandscopeError
from .files import atomic
from .progress import Progress, silent

BUSY = 0.9  # of the time on the clock: less on the processor means that others had it
VERSIONS = {"numpy": "numpy", "numba": "numba", "scipy": "scipy", "scikit-image": "skimage", "rawpy": "rawpy", "OpenCV": "cv2"}


def bench(params: BenchParams | None = None, progress: Progress = silent) -> dict:
    """Measure, and return all that was measured: what ``describe`` and ``plot`` show, and JSON can hold.

    Raises StrandscopeError for a stage of an unknown name. Answers that differ are told in the report; ``expect_same`` raises then.
    """
    params = params or BenchParams()

    unknown = [stage for stage in params.stages if stage not in STAGES]
    if unknown:
        raise StrandscopeError(f"stage is {unknown[0]!r}; expected one of {', '.join(STAGES)}")
    results, left_out = [], []
    with TemporaryDirectory(prefix="strandscope-") as folder:
        rates = machine_rates()
        for stage in params.stages:
            progress(stage, 0, 1)
            contests, missing = contests_of(stage, params, Path(folder))
            left_out += [text for text in missing if text not in left_out]
            for number, contest in enumerate(contests):
                results.append(measure(contest, params.rounds, params.seconds, _part(progress, stage, number, len(contests))))
                rates = Rates(*map(max, rates, machine_rates()))
    for result in results:
        result["bound"] |= _bound(result, rates)
    return {"machine": machine(), "rates": rates._asdict(), "params": asdict(params), "contests": results, "left_out": left_out}


def _bound(result: dict, rates: Rates) -> dict:
    """The least time, what limits it, and its part of the time that ours takes of the processor."""
    least = {"memory": result["bound"]["moved_bytes"] / rates.copied_bytes, "flops": result["bound"]["flops"] / rates.flops}
    limit = max(least, key=least.get)
    share = least[limit] / max(float(np.median(result["ours"]["processor_seconds"])), 1e-9)
    return {"limit": limit, "seconds": least[limit], "share": share}


def _part(progress: Progress, stage: str, number: int, parts: int) -> Progress:
    """Progress of one of several measurements of a stage."""
    return lambda _, done, total: progress(stage, number + done / total, parts)


# ---- the machine -----------------------------------------------------------------------------------------------------


def machine() -> dict:
    """What it was measured on: no names but those of programs."""
    versions = {name: sys.modules[module].__version__ for name, module in VERSIONS.items() if sys.modules.get(module)}
    return {"cores": os.cpu_count(), "architecture": platform.machine(), "system": platform.system(), "python": platform.python_version()} | versions


# ---- what came of it -------------------------------------------------------------------------------------------------


def expect_same(report: dict) -> None:
    """Raise StrandscopeError if any answer was farther from ours than it may be."""
    wrong = [
        f"{contest['stage']}, {way['name']}: {_check_text(check)}"
        for contest in report["contests"]
        for way in (contest["ours"], *contest["others"])
        for check in way["checks"]
        if not check["same"]
    ]
    if wrong:
        raise StrandscopeError(f"the answers differ, so the times do not compare: {'; '.join(wrong)}")


def describe(report: dict) -> list[tuple[str, str] | None]:
    """The report as rows of names and values."""
    told, rates = report["machine"], report["rates"]
    versions = ", ".join(f"{name} {told[name]}" for name in VERSIONS if name in told)
    rows = [
        ("machine", f"{told['cores']} cores, {told['system']} {told['architecture']}; Python {told['python']}, {versions}"),
        ("one thread", f"copies {rates['copied_bytes'] / 1e9:.1f} GB/s (read and written), does {rates['flops'] / 1e9:.0f} Gflop/s (sgemm)"),
    ]
    for contest in report["contests"]:
        rows += [None, (contest["stage"], f"{contest['what']}; each on one thread, {len(contest['ours']['seconds'])} rounds")]
        rows.append((f"  {contest['ours']['name']}", f"{_time_text(contest, contest['ours'])}; {_bound_text(contest)}"))
        rows += [("", _check_line(check)) for check in contest["ours"]["checks"]]
        for way in contest["others"]:
            ratio, other = way["ratio"], way["processor_ratio"]
            spread = f"{ratio['median']:.3g} × ours (quartiles {ratio['low']:.3g} to {ratio['high']:.3g}; of the processor {other['median']:.3g})"
            rows.append((f"  {way['name']}", f"{_time_text(contest, way)}; {spread}"))
            rows += [("", _check_line(check)) for check in way["checks"]]
        rows += [("", note) for note in contest["notes"]]
    share = busy(report)
    notes = (
        [f"The machine was busy: these had a processor {100 * share:.0f} % of the time. Ratios of the processor are the surer ones."]
        if share < BUSY
        else []
    )
    notes += report["left_out"]
    return rows + ([None] + [("note", note) for note in notes] if notes else [])


def busy(report: dict) -> float:
    """Part of the time on the clock for which the ways had a processor; 1 if none was measured."""
    ways = [way for contest in report["contests"] for way in (contest["ours"], *contest["others"])]
    clock, processor = (sum(sum(way[name]) for way in ways) for name in ("seconds", "processor_seconds"))
    return processor / clock if clock else 1.0


def _time_text(contest: dict, way: dict) -> str:
    return _seconds_text(float(np.median(way["seconds"])) / contest["count"])


def _bound_text(contest: dict) -> str:
    bound = contest["bound"]
    least = _seconds_text(bound["seconds"] / contest["count"])
    return f"at best {least} ({bound['limit']}: {bound['why']}), reaches {100 * bound['share']:.2g} % of its bound"


def _seconds_text(seconds: float) -> str:
    size, unit = next((size, unit) for size, unit in ((1.0, "s"), (1e-3, "ms"), (0.0, "µs")) if seconds >= size)
    return f"{seconds / (size or 1e-6):.3g} {unit}"


def _check_line(check: dict) -> str:
    return f"{'same' if check['same'] else 'DIFFERS'}: {_check_text(check)}"


def _check_text(check: dict) -> str:
    unit = f" {check['unit']}" if check["unit"] else ""
    return f"{check['what']} {check['apart']:.3g}{unit} (at most {check['allowed']:.3g})"


def named_ratios(report: dict) -> dict[str, dict]:
    """The ratio of every other way, by a name of its own."""
    named = {}
    for contest in report["contests"]:
        kind = contest["ours"]["name"].partition(", ")[2]
        for way in contest["others"]:
            named[f"{contest['stage']}{f' ({kind})' if kind else ''}: {way['name']}"] = way["ratio"]
    return named


def plot(report: dict, path: Path) -> None:
    """Draw how many times longer the other ways take, with the quartiles, on a logarithmic scale; a PNG."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from .figures import ACCENT, DPI, INK, STYLE

    bars = named_ratios(report)
    if not bars:
        raise StrandscopeError(f"{path}: there is nothing to draw; no other way was measured")
    places = np.arange(len(bars))
    median, low, high = (np.array([ratio[key] for ratio in bars.values()]) for key in ("median", "low", "high"))
    with rc_context(STYLE):
        figure = Figure((7.5, 0.9 + 0.34 * len(bars)), dpi=DPI, layout="constrained")
        axes = figure.add_subplot(xscale="log", xlabel="time of the other way, in parts of ours (median and quartiles)")
        axes.barh(places, median, tick_label=list(bars), color=ACCENT, xerr=(median - low, high - median), error_kw={"ecolor": INK, "capsize": 2})
        for place, value, end in zip(places, median, high, strict=True):
            axes.annotate(f"  {value:.3g} ×", (max(value, end), place), va="center")
        axes.axvline(1.0, color=INK, linewidth=0.8)
        axes.set_xlim(min(0.5, 0.8 * median.min()), 4.0 * max(high.max(), 1.0))
        axes.invert_yaxis()
        with atomic(path) as part:
            FigureCanvasAgg(figure).print_png(part)
