"""A folder of existing sweeps -> a capture. Nothing in the source is changed, and capture.json is written last.

``find_*`` say which photograph belongs where, ``plan_import`` checks them all and makes the capture in memory,
``carry_out`` links or copies what must be and writes ``capture.json``.
"""

import csv
import os
import re
import shutil
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from .capture import FILE_NAME, Capture, Sweep, Turntable, load_capture, save_capture
from .errors import CaptureError, StrandscopeError
from .files import atomic, explain
from .geometry import Optics
from .progress import Progress, silent
from .raw import LINEAR_SUFFIXES, RAW_SUFFIXES, Mosaic, read_header, read_planes

SUFFIXES = RAW_SUFFIXES | LINEAR_SUFFIXES | {".npy"}
FIELDS = {"angle": r"([-+]?\d+(?:\.\d+)?)", "position": r"([-+]?\d+(?:\.\d+)?)", "index": r"(\d+)", "sweep": r"(\d+)"}
CSV_COLUMNS = ("file", "angle_deg", "position_mm")


@dataclass(frozen=True)
class Found:
    """The photographs of one sweep, in order, and what their names or the table say of them."""

    name: str
    files: tuple[Path, ...]
    angle_deg: float | None = None
    positions_mm: tuple[float, ...] | None = None


@dataclass(frozen=True)
class Source:
    """Where the photographs are, and how to tell the sweeps apart: by a pattern of names, a table, or else by subfolders."""

    folder: Path
    pattern: str | None = None
    table: Path | None = None
    by_time: bool = False  # in the order of taking, where the files tell it, and not of their names
    turntable: str | None = None  # subfolder with the photographs at a small aperture


@dataclass(frozen=True)
class Layout:
    """What the files themselves do not say. None: it is in the names, or the usual."""

    angles_deg: tuple[float, ...] | int | None = None  # of the sweeps in order, or their number, evenly around
    positions_mm: tuple[float, ...] | None = None  # of the photographs of each sweep
    first_mm: float | None = None  # or d of the first,
    step_mm: float | None = None  # and from each to the next
    name: str | None = None
    working_distance_mm: float = 330.0  # the paper's
    pitch_mm: float = 1 / 35
    axis_col_px: float | None = None  # None: the middle of the channel plane
    axis_row_px: float | None = None
    aperture_cone_deg: float = 10.0
    mosaic: Mosaic | None = None
    turntable_f_number: float = 16.0


@dataclass(frozen=True)
class Plan:
    """A capture that could be made: its description, and the source of each file (the same place, or elsewhere)."""

    capture: Capture
    sources: dict[str, Path]  # name in the capture -> photograph
    in_place: bool  # the photographs stay where they are
    shape: tuple[int, int]  # of a channel plane
    notes: tuple[str, ...]  # what was assumed or left out


# ---- which photographs, in which order ------------------------------------------------------------------------------------


def natural(path: Path) -> tuple:
    """Sort key under which img_2 comes before img_10."""
    return tuple((int(part), "") if part.isdigit() else (-1, part.lower()) for part in re.split(r"(\d+)", path.as_posix()))


def photographs(folder: Path, leave_out: tuple[Path, ...] = ()) -> list[Path]:
    """All photographs below a folder, in natural order, but for hidden ones and those below the folders to leave out.

    Raises CaptureError if it is no folder.
    """
    if not folder.is_dir():
        raise CaptureError(f"{folder}: is not a folder; expected one with photographs")
    files = (Path(top) / name for top, _, names in os.walk(folder) for name in names)
    visible = (f for f in files if not any(part.startswith(".") for part in f.relative_to(folder).parts))
    outside = (f for f in visible if not any(f.resolve().is_relative_to(other.resolve()) for other in leave_out))
    return sorted((f for f in outside if f.suffix.lower() in SUFFIXES), key=lambda f: natural(f.relative_to(folder)))


def find(source: Source, out: Path, layout: Layout, progress: Progress = silent) -> tuple[list[Found], tuple[Path, ...], list[str]]:
    """The sweeps of a source, its turntable photographs, and notes on what was assumed. A capture inside it is left out."""
    folder, notes = source.folder, []
    turntable_folder = folder / source.turntable if source.turntable else None
    turntable = tuple(photographs(turntable_folder)) if turntable_folder else ()
    if turntable_folder and not turntable:
        raise CaptureError(f"{turntable_folder}: no photographs found there; expected those of the turntable")
    if source.table:
        return find_by_table(folder, source.table), turntable, notes
    inside = out.resolve() != folder.resolve() and out.resolve().is_relative_to(folder.resolve())
    files = photographs(folder, tuple(f for f in (turntable_folder, out if inside else None) if f))
    if source.by_time:
        in_time = sort_by_time(files, progress)
        notes += ["the order is that of the names, as the files do not tell when they were taken"] if in_time is None else []
        files = in_time or files
    if source.pattern:
        return find_by_pattern(folder, files, source.pattern), turntable, notes
    sweeps = layout.angles_deg if isinstance(layout.angles_deg, int) else len(layout.angles_deg or ())
    return find_by_folder(folder, files, sweeps), turntable, notes


def find_by_folder(folder: Path, files: list[Path], sweeps: int | None = None) -> list[Found]:
    """Each subfolder is a sweep. Photographs that all lie in one folder are split into ``sweeps`` equal parts, in order."""
    groups: dict[Path, list[Path]] = {}
    for file in files:
        groups.setdefault(file.parent, []).append(file)
    if len(groups) == 1 and sweeps and sweeps > 1:
        size, rest = divmod(len(files), sweeps)
        if rest:
            raise CaptureError(f"{files[0].parent}: {len(files)} photographs cannot be {sweeps} sweeps of equal length; is one missing?")
        return [Found(f"part {k + 1}", tuple(files[k * size : (k + 1) * size])) for k in range(sweeps)]
    return [Found(_short(parent, folder), tuple(group)) for parent, group in groups.items()]


def find_by_pattern(folder: Path, files: list[Path], pattern: str) -> list[Found]:
    """Sweeps by a pattern of names such as "sweep_{angle}/img_{index}.cr2", relative to the folder; * stands for anything.

    {angle} (degrees), {sweep} (number) or else the subfolder tell the sweep; {position} (mm) or {index} the order in it.
    Raises CaptureError if no photograph fits.
    """
    expression, names = _expression(pattern)
    groups: dict = {}
    for file in files:
        match = expression.fullmatch(file.relative_to(folder).as_posix())
        if match:
            values = dict(zip(names, map(float, match.groups()), strict=True))
            key = values.get("angle", values.get("sweep", natural(file.parent)))
            groups.setdefault(key, []).append((values.get("position", values.get("index", 0.0)), values, file))
    if not groups:
        raise CaptureError(f"{folder}: none of {len(files)} photographs fits the pattern {pattern!r}, relative to that folder")
    found = []
    for key in sorted(groups):
        rows = sorted(groups[key], key=lambda row: (row[0], natural(row[2])))
        angles = {row[1].get("angle") for row in rows}
        positions = tuple(row[1]["position"] for row in rows) if "position" in names else None
        name = f"{key:g}°" if "angle" in names else _short(rows[0][2].parent, folder)
        found.append(Found(name, tuple(row[2] for row in rows), angles.pop() if len(angles) == 1 else None, positions))
    return found


def find_by_table(folder: Path, table: Path) -> list[Found]:
    """Sweeps by a CSV file with the columns file (relative to the folder), angle_deg and position_mm; one line a photograph.

    Raises CaptureError, naming the line, for a value that is missing or no number.
    """
    groups: dict[float, list] = {}
    try:
        with open(table, newline="", encoding="utf-8-sig") as lines:
            reader = csv.DictReader(lines, skipinitialspace=True)
            missing = [c for c in CSV_COLUMNS if c not in (reader.fieldnames or ())]
            if missing:
                raise CaptureError(f"{table}: line 1: the column {missing[0]} is missing; expected {', '.join(CSV_COLUMNS)}")
            for row in reader:
                angle, position = (_number(row[c], f"{table}: line {reader.line_num}: {c}") for c in CSV_COLUMNS[1:])
                if not row["file"]:
                    raise CaptureError(f"{table}: line {reader.line_num}: file is empty; expected a photograph's name")
                groups.setdefault(angle, []).append((position, folder / row["file"]))
    except OSError as error:
        raise explain(error, table) from error
    except UnicodeDecodeError as error:
        raise CaptureError(f"{table}: is not text in UTF-8; expected a table with {', '.join(CSV_COLUMNS)}") from error
    if not groups:
        raise CaptureError(f"{table}: lists no photograph; expected lines with {', '.join(CSV_COLUMNS)}")
    rows = {angle: sorted(group) for angle, group in sorted(groups.items())}
    return [Found(f"{a:g}°", tuple(f for _, f in group), a, tuple(p for p, _ in group)) for a, group in rows.items()]


def sort_by_time(files: list[Path], progress: Progress = silent) -> list[Path] | None:
    """Photographs in the order in which they were taken, by the time in the files; None if not all of them have it."""
    taken = []
    for i, file in enumerate(files):
        taken.append(read_header(file).taken)
        progress("reading times", i + 1, len(files))
    if not files or None in taken:
        return None
    return [file for _, _, file in sorted(zip(taken, map(natural, files), files, strict=True))]


def _short(parent: Path, folder: Path) -> str:
    return parent.relative_to(folder).as_posix() if parent != folder else parent.name


def _expression(pattern: str) -> tuple[re.Pattern, list[str]]:
    names, text = [], ""
    for part in re.split(r"(\{\w*\}|\*)", pattern.replace("\\", "/")):
        if part == "*":
            text += "[^/]*?"  # as little as possible, so that numbers are taken whole
        elif part.startswith("{"):
            if part[1:-1] not in FIELDS or part[1:-1] in names:
                raise StrandscopeError(f"the pattern {pattern!r} has {part}; expected each of {{{'}, {'.join(FIELDS)}}} at most once")
            names.append(part[1:-1])
            text += FIELDS[names[-1]]
        else:
            text += re.escape(part)
    return re.compile(text, re.IGNORECASE), names


def _number(text: str | None, where: str) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = float("nan")
    if not abs(value) < 1e9:
        raise CaptureError(f"{where} is {text!r}; expected a number")
    return value


# ---- the plan ---------------------------------------------------------------------------------------------------------------


def plan_import(source: Source, out: Path, layout: Layout, *, keep_in_place: bool = True, progress: Progress = silent) -> Plan:
    """Find and check all photographs (size, wholeness; the first of each sweep is decoded) and describe the capture in ``out``.

    keep_in_place: photographs that lie below ``out`` stay there. Raises CaptureError for what does not fit: nothing found,
    sweeps of other length or size, damaged files, equal angles; and for a capture that is there already.
    """
    folder = source.folder
    if (out / FILE_NAME).exists():
        raise CaptureError(f"{out / FILE_NAME}: is there already; choose another folder, or remove it first")
    found, turntable, notes = find(source, out, layout, progress)
    if not found:
        raise CaptureError(f"{folder}: no photographs found there; expected raw files, EXR, TIFF or .npy, a subfolder for each sweep")
    angles, angle_notes = _angles(found, layout, folder)
    positions, position_notes = _positions(found, layout, folder)
    files = [file for sweep in found for file in sweep.files] + list(turntable)
    _check_files(files, progress)
    shape = _check_planes(found, layout, progress)
    inside = out.resolve()
    in_place = keep_in_place and all(file.resolve().is_relative_to(inside) for file in files)
    names = [_names(sweep.files, f"sweep_{k:03d}", out, in_place) for k, sweep in enumerate(found)]
    turntable_names = _names(turntable, "turntable", out, in_place)
    sweeps = (Sweep(a, p, n) for a, p, n in zip(angles, positions, names, strict=True))
    capture = Capture(
        folder=out,
        name=layout.name or folder.resolve().name,
        optics=_optics(layout, shape),
        sweeps=tuple(sweeps),
        turntable=Turntable(layout.turntable_f_number, turntable_names, _around(len(turntable)), 0.0) if turntable else None,
        mosaic=layout.mosaic,
    )
    sources = dict(zip([n for group in names for n in group] + list(turntable_names), files, strict=True))
    return Plan(capture, sources, in_place, shape, (*notes, *angle_notes, *position_notes))


def _around(count: int) -> tuple[float, ...]:
    return tuple(360.0 * k / count for k in range(count))


def _angles(found: list[Found], layout: Layout, folder: Path) -> tuple[tuple[float, ...], list[str]]:
    given, notes = layout.angles_deg, []
    if given is None and all(sweep.angle_deg is not None for sweep in found):
        angles = tuple(sweep.angle_deg for sweep in found)
    elif given is None or isinstance(given, int):
        angles = _around(len(found))
        if given is None:
            notes.append(f"the angles: {len(found)} sweeps evenly over 360° (--angles says otherwise)")
        elif given != len(found):
            raise CaptureError(f"{folder}: {len(found)} sweeps found; expected {given}, as --angles says")
    elif len(given) == len(found):
        angles = given
    else:
        raise CaptureError(f"{folder}: {len(found)} sweeps found ({found[0].name} … {found[-1].name}); expected {len(given)}, as --angles says")
    twice = [a for a, n in Counter(round(a % 360, 6) % 360 for a in angles).items() if n > 1]
    if twice:
        raise CaptureError(f"{folder}: two sweeps are at {twice[0]:g}°; expected each angle once")
    return angles, notes


def _positions(found: list[Found], layout: Layout, folder: Path) -> tuple[list[tuple[float, ...]], list[str]]:
    notes = []
    if layout.positions_mm is not None:
        positions = [layout.positions_mm] * len(found)
    elif layout.step_mm is not None:
        usual = Counter(len(sweep.files) for sweep in found).most_common(1)[0][0]
        first = layout.first_mm
        if first is None:
            first = -layout.step_mm * (usual - 1) / 2
            notes.append(f"the first position: {first:g} mm, so that the sweeps are centred on the axis (--first-mm says otherwise)")
        positions = [tuple(round(first + layout.step_mm * i, 9) for i in range(usual))] * len(found)
    elif all(sweep.positions_mm is not None for sweep in found):
        positions = [sweep.positions_mm for sweep in found]
    else:
        raise CaptureError(
            f"{folder}: the positions are not known; expected --step-mm (and --first-mm), --positions, a {{position}} pattern or a CSV"
        )
    for sweep, places in zip(found, positions, strict=True):
        if len(places) != len(sweep.files):
            raise CaptureError(f"{folder}: sweep {sweep.name} has {len(sweep.files)} photographs; expected {len(places)}, one a position")
        if len(set(places)) != len(places):
            raise CaptureError(f"{folder}: sweep {sweep.name} has two photographs at one position; expected each position once")
    return positions, notes


def _check_files(files: list[Path], progress: Progress) -> None:
    """All of one size and kind, none twice, none cut short as far as their headers tell."""
    first, size = None, None
    for i, file in enumerate(files):
        header = read_header(file)
        size = size or (header.rows, header.cols)
        first = first or file
        if (header.rows, header.cols) != size:
            raise CaptureError(f"{file}: is {header.cols} x {header.rows} pixels; expected {size[1]} x {size[0]} as {first.name}, the first")
        if file.suffix.lower() != first.suffix.lower():
            raise CaptureError(f"{file}: is another kind of file; expected {first.suffix} as {first.name}, the first")
        progress("checking photographs", i + 1, len(files))
    twice = [file for file, n in Counter(files).items() if n > 1]
    if twice:
        raise CaptureError(f"{twice[0]}: is listed twice; expected each photograph once")


def _check_planes(found: list[Found], layout: Layout, progress: Progress) -> tuple[int, int]:
    for i, sweep in enumerate(found):
        shape = read_planes(sweep.files[0], "R", layout.mosaic).shape[1:]
        progress("decoding the first of each sweep", i + 1, len(found))
    return shape


def _optics(layout: Layout, shape: tuple[int, int]) -> Optics:
    return Optics(
        working_distance_mm=layout.working_distance_mm,
        pitch_mm=layout.pitch_mm,
        axis_col_px=(shape[1] - 1) / 2 if layout.axis_col_px is None else layout.axis_col_px,
        axis_row_px=(shape[0] - 1) / 2 if layout.axis_row_px is None else layout.axis_row_px,
        aperture_cone_deg=layout.aperture_cone_deg,
    )


def _names(files: tuple[Path, ...], subfolder: str, out: Path, in_place: bool) -> tuple[str, ...]:
    """Names in the capture: where the files are, or in a subfolder in their order, under their own names where these differ."""
    if in_place:
        return tuple(file.resolve().relative_to(out.resolve()).as_posix() for file in files)
    own = len({file.name.lower() for file in files}) == len(files)
    return tuple(f"{subfolder}/{file.name if own else f'{i:04d}{file.suffix}'}" for i, file in enumerate(files))


def describe(plan: Plan) -> list[tuple[str, str]]:
    """The plan as rows (name, value) for people."""
    sweeps, optics = plan.capture.sweeps, plan.capture.optics
    counts = sorted({len(s.files) for s in sweeps})
    places = sorted({p for s in sweeps for p in s.positions_mm})
    suffix = Path(sweeps[0].files[0]).suffix
    where = "stay where they are" if plan.in_place else "are linked, or copied, into the capture"
    rows = [
        ("found", f"{len(sweeps)} sweeps of {' to '.join(map(str, counts))} photographs ({suffix}); they {where}"),
        ("angles", f"{sweeps[0].angle_deg:g}° … {sweeps[-1].angle_deg:g}°"),
        ("positions", f"{places[0]:g} … {places[-1]:g} mm, from the axis to the plane of focus"),
        ("first, last", f"{plan.sources[sweeps[0].files[0]]}, {plan.sources[sweeps[-1].files[-1]]}"),
        ("channel plane", f"{plan.shape[1]} x {plan.shape[0]} pixels, {1 / optics.pitch_mm:.4g} to a millimetre"),
        ("axis", f"column {optics.axis_col_px:g}, row {optics.axis_row_px:g}"),
        ("lens", f"{optics.working_distance_mm:g} mm away, a cone of {optics.aperture_cone_deg:g}°"),
    ]
    if plan.capture.turntable:
        rows.append(("turntable", f"{len(plan.capture.turntable.files)} photographs at f/{plan.capture.turntable.f_number:g}"))
    return rows + [("assumed" if note.startswith("the ") else "note", note) for note in plan.notes]


def carry_out(plan: Plan, *, copy: bool = False, progress: Progress = silent) -> Path:
    """Make the capture; returns the path of its capture.json, which is written last. On failure nothing new is left.

    Photographs that do not stay in place are hard links where the disk allows it and copies elsewhere, or always copies.
    """
    made: list[Path] = []
    try:
        if not plan.in_place:
            for i, (name, source) in enumerate(plan.sources.items()):
                _bring(source, plan.capture.folder / name, copy, made)
                progress("bringing photographs", i + 1, len(plan.sources))
        path = save_capture(plan.capture)
        made.append(path)
        load_capture(path)
        return path
    except BaseException:
        for path in reversed(made):
            with suppress(OSError):  # a folder in which someone else has put something meanwhile
                path.rmdir() if path.is_dir() else path.unlink(missing_ok=True)
        raise


def _bring(source: Path, target: Path, copy: bool, made: list[Path]) -> None:
    if target.exists():
        raise CaptureError(f"{target}: is there already; choose an empty folder for the capture")
    try:
        missing = [p for p in (target.parent, *target.parent.parents) if not p.exists()]
        target.parent.mkdir(parents=True, exist_ok=True)
        made.extend(reversed(missing))
        if not copy:
            try:
                os.link(source.resolve(), target)
                made.append(target)
                return
            except OSError:  # another disk, or one without links
                pass
        with atomic(target) as part:
            shutil.copyfile(source, part)
        made.append(target)
    except OSError as error:
        raise explain(error, target) from error
