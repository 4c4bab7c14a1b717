"""Many captures one after the other: those that are done are left alone, and one that fails does not stop the others."""

import hashlib
import json
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from .capture import Capture, features_path, load_capture
from .cluster import unheard
from .errors import StrandscopeError
from .files import atomic, explain
from .pipeline import VERSION, Parameters, reconstruct
from .progress import Progress, silent

RECORD = "batch.json"  # in the folder: what each strands file was made from
SHARES = {"finding ridges": (0.0, 0.5), "growing": (0.5, 0.4)}  # where a stage begins in a reconstruction, and its share; the others come last
REST = (0.9, 0.1)


@dataclass(frozen=True)
class Outcome:
    """What became of one capture."""

    capture: str
    output: str
    strands: int = 0
    minutes: float = 0.0
    kept: bool = False  # it was done before
    error: str = ""


def batch(
    captures: Iterable[Path],
    folder: Path,
    parameters: Parameters,
    *,
    calibration: Path | None = None,
    progress: Progress = silent,
    tell: Callable[[str], None] = unheard,
    **limits,
) -> Iterator[Outcome]:
    """Reconstruct each capture into FOLDER/<its name>.npz; yields what became of it. ``limits`` are those of ``reconstruct``.

    A capture that was reconstructed there with these parameters, and has not changed since, is left alone. Two captures of one name
    get the names of the folders above them as well. What ``progress`` raises to cancel ends it.
    """
    folder, record = Path(folder), _load(Path(folder) / RECORD)
    named = names(captures, {name: entry["capture"] for name, entry in record.items()})
    for number, (path, name) in enumerate(named.items()):
        out, began, cancelled = folder / f"{name}.npz", time.monotonic(), []

        def overall(stage: str, done: float, total: float, number: int = number, cancelled: list = cancelled) -> None:
            first, share = SHARES.get(stage, REST)
            try:
                progress("reconstructing", number + first + share * done / max(total, 1), len(named))
            except Exception as error:
                cancelled.append(error)
                raise

        overall("finding ridges", 0, 1)
        try:
            digest = _made_from(load_capture(path), parameters, calibration)
            entry = record.get(name)
            if entry and entry["made_from"] == digest and _stamp(out) == entry["file"]:
                outcome = Outcome(path, str(out), entry["strands"], entry["minutes"], kept=True)
            else:
                strands = len(reconstruct(Path(path), out, parameters, calibration=calibration, progress=overall, tell=tell, **limits))
                outcome = Outcome(path, str(out), strands, (time.monotonic() - began) / 60)
                told = {"capture": path, "made_from": digest, "file": _stamp(out), "strands": strands, "minutes": outcome.minutes}
                record = _load(folder / RECORD) | {name: told}
                with atomic(folder / RECORD) as part:
                    part.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
        except Exception as error:
            if cancelled:
                raise
            outcome = Outcome(path, str(out), minutes=(time.monotonic() - began) / 60, error=_in_words(error))
        tell(f"{path}: {said(outcome)}")
        yield outcome
    progress("reconstructing", len(named), len(named))


def said(outcome: Outcome) -> str:
    """An outcome in words."""
    if outcome.error:
        return outcome.error
    return f"{outcome.output}, {outcome.strands} curves, " + ("kept from before" if outcome.kept else f"{outcome.minutes:.1f} minutes")


def table(outcomes: Sequence[Outcome]) -> str:
    """All outcomes as text, one a line."""
    wide = max([len(outcome.capture) for outcome in outcomes], default=0)
    lines = [f"{'capture':<{wide}}  strands  minutes"]
    for outcome in outcomes:
        told = f"{'-':>7}  {outcome.minutes:7.1f}  {outcome.error}" if outcome.error else f"{outcome.strands:7}  {outcome.minutes:7.1f}"
        lines.append(f"{outcome.capture:<{wide}}  {told}" + "  kept from before" * outcome.kept)
    return "\n".join(lines)


def report(outcomes: Sequence[Outcome]) -> dict:
    """All outcomes, for programs."""
    return {"captures": [asdict(outcome) for outcome in outcomes], "failed": sum(bool(outcome.error) for outcome in outcomes)}


def read_list(path: Path) -> list[Path]:
    """The captures that a text file lists, one a line, relative to the file; what follows # is left out. Raises StrandscopeError."""
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise StrandscopeError(f"{path}: cannot be read ({error}); expected a text file with a capture a line") from error
    return [Path(path).parent / line.strip() for line in (line.partition("#")[0] for line in lines) if line.strip()]


def names(captures: Iterable[Path], taken: dict[str, str]) -> dict[str, str]:
    """A name for the output of each capture (its whole path), those of one name told apart by the folders above them. ``taken``: names
    that have been given before, and the captures that have them, which keep them."""
    before = {capture: name for name, capture in taken.items()}
    used, named = {name.lower() for name in taken}, {}
    for capture in captures:
        path = Path(capture).resolve()
        if str(path) in named:
            continue
        own = path.parent if path.name == "capture.json" else path.with_suffix("") if path.suffix == ".json" else path
        parts = [part.strip("/\\:") for part in own.parts]
        choices = ["-".join(parts[-count:]) for count in range(1, len(parts) + 1)]
        free = (name for name in choices if name.lower() not in used)
        name = before.get(str(path)) or next(free, None) or f"{choices[-1]}-{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
        used.add(name.lower())
        named[str(path)] = name
    return named


def _made_from(capture: Capture, parameters: Parameters, calibration: Path | None) -> str:
    """A digest of all that a strands file depends on."""
    if capture.features:
        files = [features_path(capture.folder / capture.features, i) for i in range(len(capture.sweeps))]
    else:
        files = [capture.folder / file for sweep in capture.sweeps for file in sweep.files]
    told = {
        "version": VERSION,
        "capture": [capture.name, asdict(capture.optics), [asdict(sweep) for sweep in capture.sweeps]],
        "files": [_stamp(file) for file in files],
        "parameters": asdict(parameters),
        "calibration": hashlib.sha256(Path(calibration).read_bytes()).hexdigest() if calibration else None,
    }
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()


def _stamp(path: Path) -> list[int] | None:
    """Size and time of a file, None where it is not there."""
    try:
        stat = path.stat()
    except FileNotFoundError:
        return None
    return [stat.st_size, stat.st_mtime_ns]


def _load(path: Path) -> dict:
    """What is recorded of the strands files of a folder; nothing where the record is missing or no record."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        return {name: entry for name, entry in record.items() if {"capture", "made_from", "file", "strands", "minutes"} <= set(entry)}
    except (FileNotFoundError, ValueError, AttributeError, TypeError):
        return {}
    except OSError as error:
        raise explain(error, path) from error


def _in_words(error: Exception) -> str:
    """One line for an error that ended one reconstruction."""
    if isinstance(error, StrandscopeError):
        told = str(error)
    elif isinstance(error, OSError) and error.filename:
        told = str(explain(error, Path(error.filename)))
    elif isinstance(error, MemoryError):
        told = "there is not enough memory for it"
    else:
        told = f"an error in the program itself, {type(error).__name__}: {error}"
    return " ".join(told.splitlines())
