"""How good the methods are on known hair, in one table: locks are simulated, reconstructed without a parameter, and scored.

Beside the locks of a folder, ``results`` has a folder for each lock and method, with the strands and their score. What is
there is kept.
"""

import json
import shutil
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from .capture import FILE_NAME, Capture, load_capture
from .compare import load_truth, score
from .errors import StrandscopeError
from .files import atomic
from .pipeline import preset, reconstruct
from .progress import Progress, silent
from .simulate import SimulateParams, plan, simulate

METHODS = {"ours": "strandscope", "paper": "paper"}  # as the table names them: as the pipeline does
RESULTS = "results"
ROOM = 2 * 10**9  # bytes of the disk that are left free
BINS = ((4, 8), (8, 12), (12, 16), (16, None))  # visible angles by which recall is told
HEADINGS = ("lock", "fibers", "method", "recall", "4–7", "8–11", "12–15", "16+", "precision", "µm", "°", "pieces", "switches %", "curves", "s")
WANTED = ("wanted", "", "", "≥ .970", "", "", "", "", "≥ .990", "≤ 6", "≤ 0.50", "≤ 1.20", "≤ 1.0", "", "")


@dataclass(frozen=True)
class AccuracyParams:
    """Which locks and methods to measure."""

    styles: tuple[str, ...] = ("straight", "wavy", "curls")
    fibers: tuple[int, ...] = (160, 340, 600)
    methods: tuple[str, ...] = ("ours", "paper")  # of METHODS
    captures: tuple[Path, ...] = ()  # more captures, with their truth
    scale: str = "medium"  # of the simulated locks: 12 mm
    seed: int = 1


@dataclass(frozen=True)
class Lock:
    """Hair to measure on. ``params``: how to simulate the capture where it is missing; None: it is there."""

    name: str
    capture: Path
    params: SimulateParams | None = None


def measure(folder: Path, params: AccuracyParams, workers: int = 1, again: str | None = None, progress: Progress = silent) -> Iterator[dict]:
    """Yield a row for every lock and method, as soon as it is known; each holds lock, style, fibers, method, seconds, score.

    A score that is newer than the lock and was made with the same parameters is kept. again: "growing" makes new ones from
    what a run before left of its filtering, "all" from the photographs; captures are always kept. ``seconds`` is what a
    reconstruction took, of the ``whole`` if no run before left anything. Raises StrandscopeError for a lock of other
    parameters, or without truth, or too small a disk; and what ``simulate`` and ``reconstruct`` raise.
    """
    unknown = set(params.methods) - set(METHODS)
    if unknown:
        raise StrandscopeError(f"method is {sorted(unknown)[0]!r}; expected one of {', '.join(METHODS)}")
    folder = Path(folder)
    listed = locks(folder, params)
    _check_room(folder, listed)
    for lock in listed:
        if not (lock.capture / FILE_NAME).is_file() and lock.params:
            simulate(lock.capture, lock.params, _named(progress, lock.name), workers)
        capture = load_capture(lock.capture)
        _check(lock, capture)
        for method in params.methods:
            yield _row(folder / RESULTS, lock, capture, method, workers, again, _named(progress, f"{lock.name}, {method}"))


def locks(folder: Path, params: AccuracyParams) -> list[Lock]:
    """The locks that ``params`` ask for, simulated ones in ``folder`` first, sparse before dense."""
    simulated = [
        Lock(f"{style}_{count}", folder / f"{style}_{count}", SimulateParams(style=style, scale=params.scale, fibers=count, seed=params.seed))
        for count in params.fibers
        for style in params.styles
    ]
    return simulated + [Lock(Path(path).resolve().name, Path(path)) for path in params.captures]


def table(rows: Sequence[dict]) -> str:
    """The rows as one table, aligned for the eye and in Markdown, with what is wanted of ours in the last line."""
    lines = [HEADINGS, None, *map(_cells, rows), WANTED]
    widths = [max(len(line[i]) for line in lines if line) for i in range(len(HEADINGS))]
    return "\n".join(_line(line or ["-" * w for w in widths], widths) for line in lines)


def save(folder: Path, rows: Sequence[dict]) -> list[Path]:
    """Write the rows to accuracy.json and the table to accuracy.md in ``folder``; returns both."""
    written = []
    for name, text in (("accuracy.json", json.dumps(rows, indent=1)), ("accuracy.md", table(rows))):
        written.append(Path(folder) / name)
        with atomic(written[-1]) as part:
            part.write_text(text + "\n", encoding="utf-8")
    return written


# ---- one lock, one method --------------------------------------------------------------------------------------------


def _row(results: Path, lock: Lock, capture: Capture, method: str, workers: int, again: str | None, progress: Progress) -> dict:
    """The row of a lock and a method: read, if it still holds, else measured."""
    place = results / f"{lock.name}-{method}"
    kept = place / "score.json"
    parameters = replace(preset("auto", METHODS[method]), infill=None)
    asked = json.loads(json.dumps({"capture": str(capture.folder.resolve()), "parameters": asdict(parameters)}))
    made = max(path.stat().st_mtime for path in (capture.folder / FILE_NAME, capture.truth_path))
    if not again and kept.is_file() and kept.stat().st_mtime > made:
        row = json.loads(kept.read_text(encoding="utf-8"))
        if row["asked"] == asked:
            return row
    if again == "all":
        shutil.rmtree(place, ignore_errors=True)
    whole, began = not place.exists(), time.perf_counter()
    strands = reconstruct(capture.folder, place / "strands.npz", parameters, workers=workers, progress=progress)
    seconds = time.perf_counter() - began
    style, fibers = (lock.params.style, lock.params.fibers) if lock.params else (lock.name, None)
    report = score(strands, load_truth(capture.truth_path))
    row = {"lock": lock.name, "style": style, "fibers": fibers or report["n_gt_strands"], "method": method, "seconds": seconds, "whole": whole}
    row |= {"score": report, "asked": asked}
    with atomic(kept) as part:
        part.write_text(json.dumps(row, indent=1) + "\n", encoding="utf-8")
    return row


def _check(lock: Lock, capture: Capture) -> None:
    """Raise StrandscopeError where a capture has no truth, or was simulated with other parameters than its name says."""
    if capture.truth_path is None or not capture.truth_path.is_file():
        raise StrandscopeError(f"{capture.folder}: has no truth to score against; expected a simulated capture")
    if lock.params:
        found = asdict(SimulateParams()) | capture.unknown.get("simulation", {})  # a capture may be older than a parameter
        for name, value in json.loads(json.dumps(asdict(lock.params))).items():
            if found[name] != value:
                raise StrandscopeError(f"{capture.folder}: was simulated with {name} {found[name]}, not {value}; expected another folder")


def _check_room(folder: Path, listed: Sequence[Lock]) -> None:
    """Raise StrandscopeError where the disk has no room for the captures that are missing."""
    needed = sum(_bytes(lock) for lock in listed if lock.params and not (lock.capture / FILE_NAME).is_file())
    there = next(path for path in (folder.resolve(), *folder.resolve().parents) if path.is_dir())
    free = shutil.disk_usage(there).free
    if needed and needed + ROOM > free:
        raise StrandscopeError(f"{folder}: the captures need {needed / 1e9:.1f} GB, the disk has {free / 1e9:.1f}; expected {ROOM / 1e9:.0f} more")


def _bytes(lock: Lock) -> int:
    """Size of the photographs of a simulated capture: mosaics of 16 bit."""
    scale, capture = lock.params.size, plan(lock.capture, lock.params)
    return (sum(len(sweep.files) for sweep in capture.sweeps) + scale.turntable) * 8 * scale.rows * scale.columns


def _named(progress: Progress, name: str) -> Progress:
    """Progress that says of which lock and method it is."""
    return lambda stage, done, total: progress(f"{name}: {stage}", done, total)


# ---- the table -------------------------------------------------------------------------------------------------------


def _cells(row: dict) -> tuple[str, ...]:
    report = row["score"]
    position, direction = (report.get(name, {}).get("mean") for name in ("pos_err_um", "dir_err_deg"))
    switches = report.get("identity_switch_fraction")
    return (
        row["style"],
        str(row["fibers"]),
        row["method"],
        _share(report["recall"]),
        *(_share(_recall(report, low, high)) for low, high in BINS),
        _share(report["precision"]),
        _number(position, ".1f"),
        _number(direction, ".2f"),
        _number(report.get("fragments_per_matched_hair"), ".2f"),
        _number(None if switches is None else 100 * switches, ".1f"),
        str(report["n_curves"]),
        f"{row['seconds']:.0f}" if row["whole"] else f"({row['seconds']:.0f})",
    )


def _recall(report: dict, low: int, high: int | None) -> float | None:
    """Recall of the points visible from low … high - 1 angles; None if there are none."""
    name = f"{low}-{'' if high is None else high - 1}"
    return next(
        (share for key, (share, _) in report["recall_by_visible_angles"].items() if key == name or (high is None and key.startswith(name))), None
    )


def _share(value: float | None) -> str:
    return _number(value, ".3f").removeprefix("0")


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else f"{value:{form}}"


def _line(cells: Sequence[str], widths: Sequence[int]) -> str:
    """A row of a Markdown table; words to the left, numbers to the right."""
    return "| " + " | ".join(c.ljust(w) if i in (0, 2) else c.rjust(w) for i, (c, w) in enumerate(zip(cells, widths, strict=True))) + " |"
