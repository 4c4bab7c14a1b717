"""``strandscope …``: each verb gathers its arguments, calls one function of the core, and says what came of it.

Heavy modules are imported inside the verbs, so that ``--help`` is instant. ``run`` is the one way in: it turns whatever
goes wrong into one line and an exit code.
"""

import json
import os
import re
import sys
import traceback
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import click

from . import terminal
from .errors import StrandscopeError
from .files import atomic, explain

PATH = click.Path(path_type=Path)
POSITIVE = click.FloatRange(min=0, min_open=True)
PRESETS = ("auto", "straight", "wavy", "curls")
STAGES = ("ridges", "decode", "growing", "directions", "index")  # of bench
FAILED, WRONG_USE, INTERRUPTED = 1, 2, 130


@dataclass
class Session:
    """What one run of the program was asked for beside its verb."""

    mode: str = "auto"
    debug: bool = False

    @cached_property
    def report(self) -> terminal.Reporter:
        """The progress callback to hand to the core; also ``show`` for results, and ``done`` for the finished file."""
        return terminal.reporter(self.mode)


def common(command):
    """Add the options that every verb understands. They may stand before the verb too."""
    for option in (
        click.option("--progress", type=click.Choice(terminal.MODES), expose_value=False, callback=_set_mode, is_eager=True,
                     help="How progress is shown: bars in a terminal (auto, rich), one JSON event a line on stdout, or none."),
        click.option("--stop-with-parent", is_flag=True, expose_value=False, callback=_set_stop, is_eager=True,
                     help="Stop when standard input closes; for programs that start this one."),
        click.option("--debug", is_flag=True, expose_value=False, callback=_set_debug, is_eager=True,
                     help="Show where in the program an error arose."),
    ):  # fmt: skip
        command = option(command)
    return command


def _set_mode(context, _parameter, mode):
    if mode:
        context.ensure_object(Session).mode = mode


def _set_debug(context, _parameter, debug):
    if debug:
        context.ensure_object(Session).debug = True


def _set_stop(_context, _parameter, stop):
    if stop:
        terminal.stop_with_parent()


def run(argv: list[str], group: click.Group | None = None) -> int:
    """Run one command line; returns its exit code: 0, 1 for what went wrong, 2 for wrong use, 130 when interrupted.

    Whatever goes wrong is one line on stderr, ``strandscope: …``. A traceback is shown with --debug only.
    """
    session, group = Session(), group or main_group
    try:
        with terminal.interruptible(), group.make_context("strandscope", list(argv), obj=session) as context:
            group.invoke(context)
        return 0
    except click.exceptions.Exit as end:  # --help and --version
        return end.exit_code
    except click.exceptions.NoArgsIsHelpError as error:
        print(error.format_message(), file=sys.stderr)
        return WRONG_USE
    except BrokenPipeError:  # the reader of our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except (Exception, KeyboardInterrupt) as error:
        if session.debug:
            traceback.print_exc()
        code, message = _explain(error)
        session.report.failed(" ".join(message.splitlines()))
        return code
    finally:
        session.report.close()


def _explain(error: BaseException) -> tuple[int, str]:
    """Exit code and the line that the user sees."""
    if isinstance(error, click.UsageError):
        path = error.ctx.command_path if error.ctx else "strandscope"
        return WRONG_USE, f"{error.format_message()} (see {path} --help)"
    if isinstance(error, KeyboardInterrupt | click.Abort):
        return INTERRUPTED, "stopped"
    if isinstance(error, StrandscopeError):
        return FAILED, str(error)
    if isinstance(error, OSError):
        return FAILED, str(explain(error, Path(error.filename))) if error.filename else str(error.strerror or error)
    if isinstance(error, MemoryError):
        return FAILED, "there is not enough memory for this; try fewer --workers or a smaller --memory"
    return FAILED, f"an error in the program itself, {type(error).__name__}: {error} (--debug shows where)"


def version() -> str:
    """The version of the package that this module is part of, under whatever name it was imported."""
    return sys.modules[__package__.rpartition(".")[0]].__version__


class Memory(click.ParamType):
    """An amount of memory such as 6GB or 800MB, in bytes (1 GB is 10^9 bytes)."""

    name = "amount"

    def convert(self, value, param, ctx):
        if isinstance(value, int):
            return value
        match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([kMGT]?)i?B?", value.strip(), re.IGNORECASE)
        if not match or float(match[1]) == 0:
            self.fail(f"{value!r} is no amount of memory; expected a number and a unit, as in 6GB", param, ctx)
        return int(float(match[1]) * 1000 ** " KMGT".index(match[2].upper() or " "))


class Numbers(click.ParamType):
    """FIRST:LAST:STEP (both ends included), or numbers with commas; with counts, a single whole number is a count (int)."""

    name = "numbers"

    def __init__(self, counts: bool = False):
        self.counts = counts

    def convert(self, value, param, ctx):
        if not isinstance(value, str):
            return value
        try:
            if self.counts and value.isdigit() and int(value) > 0:
                return int(value)
            if ":" in value:
                first, last, step = (float(part) for part in value.split(":"))
                count = round((last - first) / step) + 1
                if count < 1 or count > 1_000_000 or abs(first + (count - 1) * step - last) > 1e-6 * abs(step):
                    self.fail(f"{value!r}: no whole number of steps leads from {first:g} to {last:g}", param, ctx)
                return tuple(round(first + i * step, 9) for i in range(count))
            numbers = tuple(float(part) for part in value.split(",") if part.strip())
        except (ValueError, ZeroDivisionError, OverflowError):
            numbers = ()
        if not numbers or not all(abs(number) < 1e9 for number in numbers):
            self.fail(f"{value!r} is no list of numbers; expected FIRST:LAST:STEP or A,B,C", param, ctx)
        return numbers


class Words(click.ParamType):
    """Words, or whole numbers, with commas between them, each one of some choices if there are any."""

    name = "list"

    def __init__(self, kind: type = str, choices: tuple = ()):
        self.kind, self.choices = kind, choices

    def convert(self, value, param, ctx):
        if not isinstance(value, str):
            return value
        try:
            words = tuple(self.kind(part.strip()) for part in value.split(","))
        except ValueError:
            self.fail(f"{value!r} is no list of whole numbers; expected A,B,C", param, ctx)
        for word in words:
            if self.choices and word not in self.choices:
                self.fail(f"{word!r} is not one of {', '.join(self.choices)}", param, ctx)
        return words


class MosaicType(click.ParamType):
    """PATTERN:BLACK:WHITE of a bare mosaic."""

    name = "mosaic"

    def convert(self, value, param, ctx):
        from .raw import Mosaic

        match = re.fullmatch(r"([RGB]{4}):(\d+):(\d+)", value)
        if not match or sorted(match[1]) != list("BGGR") or not int(match[2]) < int(match[3]) <= 65535:
            self.fail(f"{value!r} does not describe a mosaic; expected PATTERN:BLACK:WHITE, as in RGGB:512:15871", param, ctx)
        return Mosaic(match[1], int(match[2]), int(match[3]))


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(version=version(), message="%(version)s")
@common
def main_group():
    """Capture a real lock of hair fiber by fiber, and bring it into Blender.

    Photographs of the hair go in (a capture), curves come out (a strands file). Try it without a camera:

    \b
      strandscope simulate lock --scale tiny
      strandscope reconstruct lock -o out/strands.npz
      strandscope score out/strands.npz lock/truth.npz
    """


@main_group.command(short_help="Photograph known hair: make a capture to try things on.")
@click.argument("out", type=PATH)
@click.option("--style", type=click.Choice(["straight", "wavy", "curls"]), default="straight", show_default=True, help="How the hair falls.")
@click.option(
    "--scale",
    type=click.Choice(["tiny", "small", "slab", "medium", "paper"]),
    default="small",
    show_default=True,
    help="Size of the photographs and number of sweeps: tiny takes seconds, paper takes hours.",
)
@click.option("--fibers", type=click.IntRange(1), help="Number of hairs, in place of the scale's own.")
@click.option("--seed", type=int, default=0, show_default=True, help="Another number gives another lock of the same kind.")
@click.option("--features-only", is_flag=True, help="No photographs, but what the filter would find in them: a whole capture in minutes.")
@click.option("--misaligned", is_flag=True, help="Photograph with a rig that is off in all of the following ways at once.")
@click.option("--axis-off-px", type=float, metavar="PX", help="The turntable's axis is this much right of where capture.json says.  [misaligned: 3]")
@click.option("--tilt-deg", type=float, metavar="DEG", help="The axis leans to the right in the image.  [misaligned: 0.2]")
@click.option("--tilt-towards-deg", type=float, metavar="DEG", help="The axis leans towards the camera.  [misaligned: 0.2]")
@click.option("--focus-off-mm", type=float, metavar="MM", help="The planes of focus are nearer to the camera.  [misaligned: 0.2]")
@click.option("--working-distance-off-mm", type=float, metavar="MM", help="The plane of focus is farther from the lens.  [misaligned: 2]")
@click.option("--turntable-step-off-deg", type=float, metavar="DEG", help="One step, in the middle, turns too far.  [misaligned: 0.1]")
@click.option("--every-step-off-deg", type=float, metavar="DEG", help="Every step turns too far.  [misaligned: 0]")
@click.option("--pitch-off", type=float, metavar="PARTS", help="A pixel is wider on the plane of focus.  [misaligned: 0]")
@click.option("--travel-deg", type=float, metavar="DEG", help="The stage leads the camera to the right of its line of sight.  [misaligned: 0]")
@click.option("--travel-up-deg", type=float, metavar="DEG", help="And upwards.  [misaligned: 0]")
@click.option("--distortion", type=float, metavar="K1", help="The lens distorts: k1, in 1/mm².  [misaligned: 0]")
@click.option("--gain-drift", type=float, metavar="PARTS", help="Photographs gain light from the first to the last of a sweep.  [misaligned: 0.05]")
@common
@click.pass_obj
def simulate(session, out, style, scale, fibers, seed, features_only, misaligned, **off):
    """Photograph hair that is known: make a capture in the folder OUT from simulated fibers.

    Leaves raw photographs (DNG), capture.json, and truth.npz, which says where every hair really is, so that a
    reconstruction can be scored. A run that was interrupted goes on where it stopped, and one that is complete is kept.

    \b
    Example:
      strandscope simulate lock --style wavy --scale tiny
      strandscope simulate crooked --scale tiny --misaligned
      strandscope simulate switch --scale paper --features-only
    """
    from . import simulate as simulator

    rig = simulator.MISALIGNED if misaligned else simulator.Misalignment()
    names = {"pitch_off": "pitch_parts", "distortion": "k1_per_mm2"}
    rig = replace(rig, **{names.get(name, name.replace("_off", "")): value for name, value in off.items() if value is not None})
    params = simulator.SimulateParams(style, scale, fibers, seed, misalignment=rig)
    if features_only:
        from .simulate_features import simulate_features

        simulate_features(out, params, progress=session.report)
    else:
        simulator.simulate(out, params, session.report)
    session.report.done(out)


@main_group.command("import", short_help="Turn a folder of photographs into a capture.")
@click.argument("folder", type=PATH)
@click.option("-o", "--output", "out", type=PATH, required=True, metavar="CAPTURE", help="The capture to make: a folder. It may be FOLDER itself.")
@click.option(
    "--pattern",
    help='How the photographs are named below FOLDER, as in "sweep_{angle}/img_{index}.cr2"; {angle}, {sweep}, '
    "{position} and {index} stand for numbers, * for anything.",
)
@click.option("--csv", "table", type=PATH, help="A table with the columns file, angle_deg, position_mm, in place of folders and patterns.")
@click.option(
    "--order",
    type=click.Choice(["name", "time"]),
    default="name",
    show_default=True,
    help="Put the photographs in the order of their names (img_2 before img_10), or of the time in the files (EXIF).",
)
@click.option(
    "--angles",
    type=Numbers(counts=True),
    help="Angles of the sweeps: FIRST:LAST:STEP, or A,B,C, or how many there are evenly around.  [default: evenly around]",
)
@click.option("--positions", type=Numbers(), help="Positions of the photographs of a sweep in mm: FIRST:LAST:STEP, or A,B,C.")
@click.option(
    "--first-mm",
    type=float,
    help="Position of the first photograph of each sweep: from the axis of the turntable to the plane of "
    "focus, positive towards the camera.  [default: sweeps are centred on the axis]",
)
@click.option("--step-mm", type=float, help="From each position to the next; negative if the camera moves away.")
@click.option("--working-distance-mm", type=POSITIVE, default=330.0, show_default=True, help="From the lens to the plane of focus.")
@click.option("--pitch-mm", type=POSITIVE, help="Width of a pixel of a channel plane (two of the sensor) on the plane of focus.  [default: 1/35]")
@click.option("--pixels-per-mm", type=POSITIVE, help="The same, the other way round.")
@click.option("--axis-col-px", type=float, help="Column of the turntable's axis in a channel plane.  [default: the middle]")
@click.option("--axis-row-px", type=float, help="Row where the optical axis meets a channel plane.  [default: the middle]")
@click.option("--cone-deg", type=POSITIVE, default=10.0, show_default=True, help="Full angle of the cone of rays through the lens.")
@click.option("--turntable", type=click.Path(), metavar="SUBFOLDER", help="Subfolder with photographs at a small aperture, evenly around.")
@click.option("--f-number", type=POSITIVE, default=16.0, show_default=True, help="Aperture of the turntable photographs.")
@click.option("--mosaic", type=MosaicType(), help="For bare .npy mosaics: PATTERN:BLACK:WHITE, as in RGGB:512:15871.")
@click.option("--name", help="What was photographed.  [default: the folder's name]")
@click.option(
    "--copy",
    is_flag=True,
    help="Always copy the photographs into CAPTURE; otherwise they stay where they are if they lie in it, or "
    "are hard links where the disk allows it.",
)
@click.option("--dry-run", is_flag=True, help="Check everything and say what was found, but write nothing.")
@common
@click.pass_obj
def import_(
    session,
    folder,
    out,
    pattern,
    table,
    order,
    angles,
    positions,
    first_mm,
    step_mm,
    working_distance_mm,
    pitch_mm,
    pixels_per_mm,
    axis_col_px,
    axis_row_px,
    cone_deg,
    turntable,
    f_number,
    mosaic,
    name,
    copy,
    dry_run,
):
    """Turn a folder of photographs into a capture, which `strandscope reconstruct` understands.

    FOLDER holds the sweeps: a subfolder for each angle of the turntable, with its photographs in the order of the camera's
    positions. Raw files of the camera are best; linear EXR and TIFF will do. All are checked first, and FOLDER is not changed.

    \b
    Examples:
      strandscope import photos -o lock --angles 0:345:15 --first-mm -37.5 --step-mm 0.2
      strandscope import photos -o lock --pattern "a{angle}/d{position}.nef" --pixels-per-mm 41.5
      strandscope import photos -o lock --csv log.csv --dry-run
    """  # fmt: skip
    from . import importer

    for pair in ((pattern, table, "--pattern", "--csv"), (pitch_mm, pixels_per_mm, "--pitch-mm", "--pixels-per-mm"),
                 (positions, step_mm, "--positions", "--step-mm")):  # fmt: skip
        if pair[0] is not None and pair[1] is not None:
            raise click.UsageError(f"{pair[2]} and {pair[3]} exclude each other")
    layout = importer.Layout(
        angles_deg=angles, positions_mm=positions, first_mm=first_mm, step_mm=step_mm, name=name,
        working_distance_mm=working_distance_mm, pitch_mm=pitch_mm or 1 / (pixels_per_mm or 35.0), axis_col_px=axis_col_px,
        axis_row_px=axis_row_px, aperture_cone_deg=cone_deg, mosaic=mosaic, turntable_f_number=f_number,
    )  # fmt: skip
    source = importer.Source(folder, pattern, table, order == "time", turntable)
    plan = importer.plan_import(source, out, layout, keep_in_place=not copy, progress=session.report)
    session.report.show(terminal.table(importer.describe(plan)))
    if dry_run:
        session.report.show("Nothing was written (--dry-run).")
    else:
        session.report.done(importer.carry_out(plan, copy=copy, progress=session.report))


def _of_reconstructing(command):
    """Add the options of a reconstruction."""
    for option in reversed((
        click.option("--preset", type=click.Choice(PRESETS), default="auto", show_default=True,
                     help="The paper's settings for a kind of hair; auto estimates them from the photographs."),
        click.option("--params", type=PATH, help="A TOML file with settings, in place of a preset."),
        click.option("--method", type=click.Choice(["strandscope", "paper"]), default="strandscope", show_default=True,
                     help="The paper's own filter and growing, or ours, which finds more."),
        click.option("--calibration", type=PATH, help="What is wrong with the rig, from `strandscope calibrate`; it is corrected."),
        click.option("--infill", type=click.IntRange(0), metavar="N", help="Number of hairs to add inside, where no camera sees."),
        click.option("--no-infill", is_flag=True, help="Captured hairs only."),
        click.option("--workers", type=click.IntRange(1), default=os.cpu_count(), help="Processor cores to use; all of them if not given."),
        click.option("--memory", type=Memory(), default="6GB", show_default=True,
                     help="Memory to use at most; a capture that needs more is refused."),
        click.option("--scheduler", metavar="tcp://HOST:PORT", help="Work on the Dask cluster of this scheduler, too (docs/cluster.md)."),
    )):  # fmt: skip
        command = option(command)
    return command


def _parameters(preset, params, method, infill, no_infill):
    """The parameters that the options of a reconstruction ask for."""
    if infill is not None and no_infill:
        raise click.UsageError("--infill and --no-infill exclude each other")
    from . import pipeline

    parameters = pipeline.read_toml(params) if params else pipeline.preset(preset, method)
    if no_infill:
        return replace(parameters, infill=None)
    return parameters if infill is None else replace(parameters, infill=replace(parameters.infill or pipeline.InfillParams(), count=infill))


@main_group.command(short_help="Photograph hair with a rig: hours, survived.")
@click.argument("plan", type=PATH, required=False, metavar="[PLAN.toml]")
@click.option("-o", "--output", "folder", type=PATH, metavar="CAPTURE", help="The capture to make, or to go on with: a folder.")
@click.option("--virtual", is_flag=True, help="With a simulated controller, camera and lock of hair.")
@click.option("--port", metavar="URL", help="Of the controller: /dev/ttyUSB0, COM3, socket://host:port, …  [default: that of the plan]")
@click.option("--watch", type=PATH, metavar="FOLDER", help="The controller fires the camera by cable; its photographs appear in this folder.")
@click.option("--name", help="What is photographed.  [default: the folder's name]")
@click.option("--repeat-sweep", "repeat", type=click.IntRange(0), multiple=True, metavar="N", help="Take sweep N anew; may be given again.")
@click.option("--patience", type=click.FloatRange(min=0), default=1800.0, show_default=True, metavar="S", help="Wait so long for what is away.")
@click.option("--status", "order", flag_value="status", help="Say how far the capture is, and end.")
@click.option("--pause", "order", flag_value="pause", help="Ask the run that takes CAPTURE to pause after this photograph.")
@click.option("--resume", "order", flag_value="resume", help="Ask it to go on.")
@click.option("--abort", "order", flag_value="abort", help="Ask it to end after this photograph; it can be gone on with.")
@click.option("--live", type=PATH, metavar="PICTURE.png", help="Show what the camera sees, again and again, and how sharp it is; for focusing.")
@click.option("--dry-run", is_flag=True, help="Say what the plan costs, and end.")
@click.option("--style", type=click.Choice(["straight", "wavy", "curls"]), default="straight", show_default=True, help="Virtual hair.")
@click.option("--scale", type=click.Choice(["tiny", "small", "medium"]), default="tiny", show_default=True, help="Size of the virtual capture.")
@click.option("--seed", type=int, default=0, show_default=True, help="Another number gives another virtual lock.")
@click.option("--speed", type=POSITIVE, default=20.0, show_default=True, help="The virtual rig's time goes so many times as fast.")
@common
@click.pass_obj
def capture(session, plan, folder, virtual, port, watch, name, repeat, patience, order, live, dry_run, style, scale, seed, speed):
    """Photograph hair with a rig: a camera on a stage, and a turntable, on a GRBL or grblHAL controller.

    PLAN.toml says what to photograph, and how the rig is wired; without it, the capture in CAPTURE is gone on with. Every
    photograph is proven safe before the next is taken, so a run may end in any way: run it again. Ctrl-C ends it after the
    photograph that is being taken, a second Ctrl-C at once.

    \b
    Examples:
      strandscope capture --virtual -o lock
      strandscope capture switch.toml -o switch --port /dev/ttyUSB0
      strandscope capture -o switch
      strandscope capture --pause -o switch
    """
    from .rig import attach, operate
    from .rig import session as runs

    report = session.report
    if order and folder is None:  # `capture --status FOLDER`
        plan, folder = None, plan
    if live:
        camera = operate.open_camera(operate.load_rig(plan).camera if plan else operate.CameraConfig())
        operate.live(camera, live, report.event)
    if folder is None and not dry_run:
        raise click.UsageError("missing option '-o': the folder of the capture")
    if order == "status":
        told = attach.status(folder)
        report.event(told)
        report.show(terminal.table(attach.describe(told)))
        return
    if order:
        attach.order(folder, order)
        return
    if repeat and not plan and attach.runs(folder):
        for sweep in repeat:
            attach.order(folder, attach.REPEAT, sweep=sweep)
        return
    params = runs.SessionParams(patience_s=patience)
    orders = attach.Orders()
    work = {"repeat": repeat, "orders": orders, "progress": report, "events": report.event}
    from . import virtual_rig

    hair = virtual_rig.hair_in(folder) if folder and not plan else None
    if virtual or hair:
        from .simulate import SimulateParams

        hair, begun = hair or SimulateParams(style, scale, seed=seed), attach.plan_in(folder) if folder else None
        rig = operate.Rig(plan=operate.load_rig(plan).plan if plan else begun or virtual_rig.virtual_plan(hair))
        take = partial(virtual_rig.virtual_capture, folder, virtual_rig.VirtualParams(hair, speed), rig.plan, params, **work)
    else:
        rig = operate.load_rig(plan) if plan else operate.load_rig(folder / operate.FILE) if folder else operate.Rig()
        rig = operate.changed(rig, port, watch, name)
        take = partial(operate.capture, rig, folder, params, **work)
    report.show(terminal.table(operate.describe(rig.plan)))
    if dry_run:
        return
    with terminal.stops_politely(lambda: orders.add(attach.ABORT), report.note):
        try:
            made = take()
        except runs.RunStopped as stopped:  # the run has said so
            raise click.exceptions.Exit(INTERRUPTED) from stopped
    report.done(made)


@main_group.command("rig", short_help="Move a rig by hand: home, jog, look.")
@click.argument("plan", type=PATH, required=False, metavar="[PLAN.toml]")
@click.option("--ports", is_flag=True, help="List this machine's serial ports, and end.")
@click.option("--virtual", is_flag=True, help="A simulated controller, camera and lock of hair.")
@click.option("--port", metavar="URL", help="Of the controller: /dev/ttyUSB0, COM3, socket://host:port, …  [default: that of the plan]")
@click.option("--picture", type=PATH, default=Path("live.png"), show_default=True, metavar="PICTURE.png", help="Where live pictures are written.")
@click.option("--style", type=click.Choice(["straight", "wavy", "curls"]), default="straight", show_default=True, help="Virtual hair.")
@click.option("--scale", type=click.Choice(["tiny", "small", "medium"]), default="tiny", show_default=True, help="Size of the virtual hair.")
@click.option("--seed", type=int, default=0, show_default=True, help="Another number gives another virtual lock.")
@click.option("--speed", type=POSITIVE, default=4.0, show_default=True, help="The virtual rig's time goes so many times as fast.")
@common
@click.pass_obj
def by_hand(session, plan, ports, virtual, port, picture, style, scale, seed, speed):
    """Move a rig by commands, one a line on standard input, and show what its camera sees; for framing and focusing.

    \b
    Commands:
      home         find the position with the switches      jog MM      move the focus by so much
      unlock       take back an alarm                       turn DEG    turn the turntable by so much
      stop         halt at once                             go DEG MM   go there
      live on|off  write the live picture again and again   shutter     fire the shutter cable
      quit         end

    \b
    Examples:
      strandscope rig --virtual
      strandscope rig switch.toml --port /dev/ttyUSB0
    """
    from .rig import desk, operate

    report = session.report
    if ports:
        found = desk.ports()
        report.event({"event": "ports", "ports": found})
        report.show(terminal.table(found) if found else "no serial port was found")
        return
    rig = operate.changed(operate.load_rig(plan) if plan else operate.Rig(), port)
    commands = iter(sys.stdin.readline, "")
    if virtual:
        from . import virtual_rig
        from .simulate import SimulateParams

        params = virtual_rig.VirtualParams(SimulateParams(style, scale, seed=seed), speed)
        virtual_rig.virtual_by_hand(params, rig.plan if plan else None, commands, picture, report.event)
    else:
        operate.by_hand(rig, commands, picture, report.event)


@main_group.command(short_help="Find the hairs in a capture, write them as curves.")
@click.argument("capture", type=PATH)
@click.option("-o", "--output", type=PATH, required=True, help="The strands file to write (.npz).")
@_of_reconstructing
@common
@click.pass_obj
def reconstruct(session, capture, output, preset, params, method, calibration, infill, no_infill, workers, memory, scheduler):
    """Find the hairs in the photographs of CAPTURE and write them as curves to a strands file.

    CAPTURE is a folder with capture.json in it (`strandscope import` makes one from photographs). What a run needs to
    continue after a crash is kept in a folder beside the output: run the same command again.

    \b
    Example:
      strandscope reconstruct lock -o out/strands.npz --preset straight --no-infill
    """
    from . import pipeline

    parameters = _parameters(preset, params, method, infill, no_infill)
    limits = {"workers": workers, "memory_bytes": memory, "progress": session.report, "scheduler": scheduler, "tell": session.report.note}
    strands = pipeline.reconstruct(capture, output, parameters, calibration=calibration, **limits)
    captured = len(strands.captured)
    session.report.show(f"{output}: {captured} captured curves, {len(strands) - captured} of infill")
    session.report.done(output)


@main_group.command(short_help="Reconstruct many captures, one after the other.")
@click.argument("captures", metavar="CAPTURE...", type=PATH, nargs=-1)
@click.option("-o", "--output", "folder", type=PATH, required=True, metavar="FOLDER", help="The folder for the strands files, one a capture.")
@click.option("--list", "listed", type=PATH, metavar="FILE", help="A text file with more captures, one a line.")
@click.option("--json", "json_file", type=PATH, help="Write what became of each capture to this file too.")
@_of_reconstructing
@common
@click.pass_obj
def batch(session, captures, folder, listed, json_file, preset, params, method, calibration, infill, no_infill, workers, memory, scheduler):
    """Find the hairs in each CAPTURE and write them to FOLDER, as <name of the capture>.npz.

    Captures that are done are left alone: those whose photographs and settings are the same as when their file in FOLDER was
    made. After one that fails it goes on with the next. At the end a table tells what became of each; the exit code is 1 if
    one failed. Run the same command again to go on after an interruption.

    \b
    Example:
      strandscope batch locks/* -o out --no-infill
      strandscope batch --list captures.txt -o out --json out/outcomes.json
    """
    from . import batch as many

    captures = [*captures, *(many.read_list(listed) if listed else [])]
    if not captures:
        raise click.UsageError("there is no CAPTURE, and --list has none; expected one or more")
    parameters, report = _parameters(preset, params, method, infill, no_infill), session.report
    limits = {"workers": workers, "memory_bytes": memory, "scheduler": scheduler}
    outcomes = list(many.batch(captures, folder, parameters, calibration=calibration, progress=report, tell=report.note, **limits))
    _hand_over(session, many.report(outcomes), many.table(outcomes), json_file)
    for outcome in outcomes:
        if not outcome.error:
            report.done(outcome.output)
    if failed := sum(bool(outcome.error) for outcome in outcomes):
        raise StrandscopeError(f"{failed} of {len(outcomes)} captures failed")


@main_group.command(short_help="Find what is wrong with the rig, from a printed target or from hair.")
@click.argument("capture", type=PATH, required=False)
@click.option("--target", is_flag=True, help="From a printed target: CAPTURE has photographs of it, at some angles and positions.")
@click.option("--from-features", is_flag=True, help="From the hair itself: fibers must coincide across angles.")
@click.option("-o", "--output", type=PATH, help="The calibration file to write (.json, .toml).")
@click.option("--print-target", type=PATH, metavar="OUT.pdf", help="Write the target to print, with rulers to check the print, and do nothing else.")
@click.option("--square-mm", type=POSITIVE, default=5.0, show_default=True, help="Width of a square of the target: for other fields of view.")
@click.option("--ruler-mm", type=POSITIVE, default=100.0, show_default=True, help="How long the target's ruler of 100 mm is as it was printed.")
@click.option("--start", type=PATH, metavar="RIG.json", help="With --from-features: begin with this calibration, as one from a target.")
@click.option("--params", type=PATH, help="A TOML file with settings of the filter and of growing.")
@click.option("--workers", type=click.IntRange(1), default=os.cpu_count(), help="Processor cores to use; all of them if not given.")
@click.option("--memory", type=Memory(), default="6GB", show_default=True, help="Memory to use at most; a capture that needs more is refused.")
@click.option("--scheduler", metavar="tcp://HOST:PORT", help="Find the ridges on the Dask cluster of this scheduler.")
@common
@click.pass_obj
def calibrate(session, capture, target, from_features, output, print_target, square_mm, ruler_mm, start, params, workers, memory, scheduler):
    """Find by how much the rig that took CAPTURE is not as its capture.json says.

    A printed target tells the pitch, the working distance, the place and the tilt of the turntable's axis, the focus, the direction of
    the stage, and the lens's distortion. Hair tells the axis, the tilt, the focus, the angle of each sweep and the gain of the
    photographs, and the working distance roughly. Each is told with its standard error. Hand the file to `reconstruct --calibration`;
    the capture itself is not changed. docs/calibration.md says how to print, mount and photograph the target.

    \b
    Example:
      strandscope calibrate --print-target target.pdf
      strandscope calibrate board --target -o out/rig.json
      strandscope calibrate lock --from-features --start out/rig.json -o out/lock.json
      strandscope reconstruct lock --calibration out/lock.json -o out/strands.npz
    """
    if print_target:
        if capture or target or from_features or output:
            raise click.UsageError("--print-target stands alone: it writes a PDF")
        from .rig import target as boards
        from .rig import target_pdf

        target_pdf.print_target(print_target, boards.Target().of_squares(square_mm))
        session.report.done(print_target)
        return
    if target == from_features:
        raise click.UsageError("expected one of --target and --from-features")
    if capture is None or output is None:
        raise click.UsageError("expected a CAPTURE, and -o with the file to write")
    if target:
        from .rig import target as boards
        from .rig import target_calibrate, target_words

        if start or params or scheduler:
            raise click.UsageError("--start, --params and --scheduler go with --from-features")
        board = boards.Target().of_squares(square_mm * ruler_mm / 100)
        told = target_calibrate.calibrate_by_target(capture, output, board, progress=session.report, workers=workers)
        session.report.show(terminal.table(target_words.describe(told)))
        for warning in target_words.warnings(told):
            session.report.note(warning)
        session.report.done(output)
        return
    from . import pipeline
    from .rig.calibrate import describe

    parameters = pipeline.read_toml(params) if params else pipeline.preset()
    limits = {"workers": workers, "memory_bytes": memory, "progress": session.report, "scheduler": scheduler, "tell": session.report.note}
    found = pipeline.calibrate(capture, output, parameters, start=start, **limits)
    session.report.show(terminal.table(describe(found)))
    session.report.done(output)


@main_group.command(short_help="Draw the curves back onto a photograph.")
@click.argument("capture", type=PATH)
@click.argument("strands", type=PATH)
@click.option("-o", "--output", type=PATH, required=True, help="The picture to write (.png).")
@click.option("--sweep", type=click.IntRange(0), metavar="K", help="Take a photograph of this sweep; the first is 0.")
@click.option("--angle", type=float, metavar="DEG", help="Take a photograph of the sweep nearest to this angle.")
@click.option("--position", type=float, metavar="MM", help="Take the photograph with its plane of focus nearest to this position.")
@click.option(
    "--color",
    type=click.Choice(["strand", "kind"]),
    default="strand",
    show_default=True,
    help="Each curve in a colour of its own, or captured hairs and infill told apart.",
)
@click.option("--calibration", type=PATH, help="What is wrong with the rig, if the curves were made with it.")
@common
@click.pass_obj
def overlay(session, capture, strands, output, sweep, angle, position, color, calibration):
    """Draw the curves of a strands file back onto a photograph of CAPTURE, to see whether they lie on the hairs.

    The picture shows the photograph, the ridges that were found in it, and the curves over the photograph. Only the parts of
    curves that are in focus there are drawn. Without further options it is the photograph with most of them.

    \b
    Example:
      strandscope overlay lock out/strands.npz -o out/overlay.png --angle 90
    """
    from . import compare
    from .capture import load_capture
    from .strands import load_strands

    if sweep is not None and angle is not None:
        raise click.UsageError("--sweep and --angle exclude each other")
    photographs, curves = load_capture(capture), load_strands(strands)
    if calibration:
        from .rig.calibrate import calibrated

        photographs = calibrated(calibration, photographs)
    shot = compare.choose_shot(photographs, curves, sweep, angle, position)
    session.report.show(compare.overlay(photographs, curves, shot, output, color))
    session.report.done(output)


@main_group.command(short_help="Draw what a capture shows, and where the curves are in it.")
@click.argument("capture", type=PATH)
@click.argument("out", type=PATH)
@click.option("--strands", type=PATH, metavar="STRANDS.npz", help="The curves to show.  [default: OUT/strands.npz, made if need be]")
@click.option("--height", type=float, metavar="MM", help="Look at this height.  [default: the middle of the photographs]")
@click.option("--at", type=Numbers(), metavar="X,Y,Z", help="Or at this place, in mm.")
@click.option("--fiber", type=click.IntRange(0), metavar="N", help="Or at the middle of this curve; the first is 0.")
@click.option("--sweep", type=click.IntRange(0), metavar="K", help="Show photographs of this sweep.  [default: the one that sees the place best]")
@click.option("--only", metavar="2b,2c,…", help="Draw these only: 2b, 2c, 3, 5, 6, 9, 10, 14, recall.")
@click.option("--zoom", type=POSITIVE, default=3.0, show_default=True, metavar="MM", help="Width of close-ups.")
@click.option("--workers", type=click.IntRange(1), default=os.cpu_count(), help="Processor cores to use; all of them if not given.")
@click.option("--memory", type=Memory(), default="6GB", show_default=True, help="Memory to use at most; a capture that needs more is refused.")
@common
@click.pass_obj
def figures(session, capture, out, strands, height, at, fiber, sweep, only, zoom, workers, memory):
    """Draw into the folder OUT what the photographs of CAPTURE show, and where the curves are in it.

    The figures are those of the paper: a row of a sweep (2b), the star of a slice (2c), ribbons (3, 6), filters (5), hull and
    carving (9), the hair (10), curves on a photograph (14). OUT/index.html shows them all and says what is seen. They look at
    one place: ridges that were missed, depth, neighbours taken for one hair can be told there.

    \b
    Example:
      strandscope figures lock out/figures --strands out/strands.npz --height 1.5
    """
    if sum(place is not None for place in (height, at, fiber)) > 1:
        raise click.UsageError("--height, --at and --fiber exclude each other")
    if at is not None and len(at) != 3:
        raise click.UsageError(f"--at has {len(at)} numbers; expected three, X,Y,Z")
    from .figures import FigureParams
    from .figures import figures as draw

    params = FigureParams(at_mm=at, height_mm=height, fiber=fiber, sweep=sweep, zoom_mm=zoom)
    chosen = [name.strip() for name in only.split(",")] if only else []
    page = draw(capture, out, strands, params, only=chosen, workers=workers, memory_bytes=memory, progress=session.report)
    session.report.done(page)


@main_group.command(short_help="Tell where the hair is, as a volume or as a mesh.")
@click.argument("capture", type=PATH)
@click.argument("strands", type=PATH)
@click.option("-o", "--output", type=PATH, help="The file to write: a volume (.vdb), a mesh (.ply), or all numbers (.npz).  [default: what is kept]")
@click.option("--calibration", type=PATH, help="What is wrong with the rig, if the curves were made with it.")
@click.option("--workers", type=click.IntRange(1), default=os.cpu_count(), help="Processor cores to use; all of them if not given.")
@common
@click.pass_obj
def volume(session, capture, strands, output, calibration, workers):
    """Tell where the hair of a strands file is, inside and between its curves: what the infill grows in.

    A voxel near a captured curve is hair, and so is the core of the volume that few cameras see into. A .vdb holds how much of
    each voxel is hair, 0 to 1, in the grid "density"; a .ply is the surface. Lengths are mm, y is up. It is kept in the folder
    beside STRANDS, where a reconstruction with infill leaves it too: to write it again takes a moment.

    \b
    Example:
      strandscope volume lock out/strands.npz -o out/hair.vdb
    """
    from . import pipeline
    from .volume import SUFFIXES, write_volume

    if output is not None and output.suffix.lower() not in SUFFIXES:
        raise click.UsageError(f"{output}: expected a name that ends in {', '.join(SUFFIXES)}")
    found = pipeline.find_volume(capture, strands, calibration=calibration, workers=workers, progress=session.report)
    if output is not None:
        write_volume(output, found)
    session.report.done(output or pipeline.volume_path(strands))


@main_group.command(short_help="Count and measure the hairs of a strands file.")
@click.argument("strands", type=PATH)
@click.option("--json", "json_file", type=PATH, help="Write the numbers to this file too.")
@click.option("--plots", type=PATH, metavar="F.png", help="Draw the distributions, captured and infill over each other.")
@click.option("--beside", type=PATH, metavar="OTHER.npz", help="Set other hair beside it: another strands file, or a truth.npz.")
@click.option("--inside", type=Numbers(), metavar="LOW,HIGH", help="Look between these two heights only, in mm.  [default: all]")
@common
@click.pass_obj
def stats(session, strands, json_file, plots, beside, inside):
    """Count and measure the hairs of a strands file, as the paper's results do, and how they lie together.

    Prints the number of curves, how many of them cross a horizontal plane on average, their lengths, and how many were
    captured and how many added inside. Below, for the captured ones and those added, side by side: density, distance and
    angle of the nearest neighbour, curvature, torsion, clumps, flyaways and radii, each as a median and, in parentheses,
    what 5 % stay below and above. docs/statistics.md says what each means.

    \b
    Example:
      strandscope stats out/strands.npz --json out/stats.json --plots out/stats.png
      strandscope stats out/strands.npz --beside lock/truth.npz --inside=-5,5
    """
    if inside is not None and len(inside) != 2:
        raise click.UsageError(f"--inside has {len(inside)} numbers; expected two, LOW,HIGH")
    from . import statistics_page
    from .statistics import describe, load_hair, side_by_side
    from .strands import describe as describe_counts
    from .strands import load_strands, statistics

    hair = load_strands(strands)
    numbers, rows = statistics(hair), []
    if len(hair):
        report = side_by_side(hair, load_hair(beside) if beside else None, inside, progress=session.report)
        numbers, rows = numbers | report, [None, *describe(report, beside and beside.name)]
        if plots:
            statistics_page.plot(report, plots, beside and beside.name)
            session.report.done(plots)
    _hand_over(session, numbers, terminal.table([*describe_counts(statistics(hair)), *rows]), json_file)


@main_group.command(short_help="Compare found hairs with the hairs that are there.")
@click.argument("strands", type=PATH)
@click.argument("truth", type=PATH)
@click.option("--tolerance-mm", type=POSITIVE, default=0.1, show_default=True, help="How near counts as found.")
@click.option("--json", "json_file", type=PATH, help="Write the numbers to this file too.")
@common
@click.pass_obj
def score(session, strands, truth, tolerance_mm, json_file):
    """Compare reconstructed hairs with the hairs that are known to be there.

    STRANDS is a strands file, TRUTH the truth.npz of a simulated capture. Recall: how much of the visible hair was found.
    Precision: how much of what was found is hair. Hairs that were added inside (infill) are left out of these, and told
    beside the hidden hairs in rows of their own.

    \b
    Example:
      strandscope score out/strands.npz lock/truth.npz
    """
    from .compare import load_truth, score, summary
    from .filled import fill_score, fill_summary
    from .strands import INFILL, load_strands

    hair, known = load_strands(strands), load_truth(truth)
    report = score(hair, known, tolerance_mm)
    rows = summary(report)
    if (hair.kind == INFILL).any():
        report["infill"] = fill_score(hair, known)
        rows += [None, *fill_summary(report["infill"])]
    _hand_over(session, report, terminal.table(rows), json_file)


@main_group.command(short_help="Measure the methods on simulated locks, in one table.")
@click.argument("folder", type=PATH)
@click.option("--styles", type=Words(choices=PRESETS[1:]), default="straight,wavy,curls", show_default=True, help="Kinds of hair to simulate.")
@click.option("--fibers", type=Words(int), default="160,340,600", show_default=True, help="Numbers of hairs in a lock.")
@click.option("--methods", type=Words(choices=("ours", "paper")), default="ours,paper", show_default=True, help="Methods to compare.")
@click.option(
    "--scale", type=click.Choice(["tiny", "small", "slab", "medium", "paper"]), default="medium", show_default=True, help="Size of the locks."
)
@click.option("--seed", type=int, default=1, show_default=True, help="Another number gives other locks of the same kinds.")
@click.option("--capture", "captures", type=PATH, multiple=True, help="Measure on this capture with its truth, too; may be given again.")
@click.option("--jobs", type=click.IntRange(1), default=os.cpu_count(), help="Processor cores to use; all of them if not given.")
@click.option("--again", type=click.Choice(["growing", "all"]), help="Do not keep scores: reconstruct from the ridges, or all anew.")
@common
@click.pass_obj
def accuracy(session, folder, styles, fibers, methods, scale, seed, captures, jobs, again):
    """Simulate locks of hair in FOLDER, reconstruct each without a setting, and print how well that went.

    Locks and scores that are there are kept, so that an interrupted run goes on where it stopped. The table is also written
    to accuracy.md and accuracy.json in FOLDER. The nine locks of the default need some 20 GB of disk, and hours.

    \b
    Example:
      strandscope accuracy locks --styles straight,curls --fibers 160 --capture demo/capture
    """
    from . import accuracy as harness

    params = harness.AccuracyParams(styles, fibers, methods, captures, scale, seed)
    rows = list(harness.measure(folder, params, jobs, again, session.report))
    session.report.show(harness.table(rows))
    for written in harness.save(folder, rows):
        session.report.done(written)


@main_group.command(short_help="Time the stages beside what one would use otherwise.")
@click.option("--stages", type=Words(choices=STAGES), default=",".join(STAGES), show_default=True, help="Stages to time.")
@click.option("--json", "json_file", type=PATH, help="Write all times, the ratios and the machine to this file too.")
@click.option("--plot", type=PATH, help="Draw the ratios (.png).")
@click.option("--rounds", type=click.IntRange(3), default=9, show_default=True, help="How often each is timed; less if it takes long.")
@common
@click.pass_obj
def bench(session, stages, json_file, plot, rounds):
    """Time the stages of a reconstruction beside what one would use otherwise, and compare the answers.

    OpenCV's filters and scikit-image's, LibRaw, scipy's cKDTree with numpy, scipy's conjugate gradients. They take turns on the
    same input, on one thread each; the result is how many times longer the others take, and how near ours is to what the
    machine can do. Takes some minutes and 1.3 GB of memory. Ends with an error if the answers differ.

    \b
    Example:
      strandscope bench --json out/bench.json --plot out/bench.png
      strandscope bench --stages ridges,decode
    """
    from . import bench as benchmark

    report = benchmark.bench(benchmark.BenchParams(stages=stages, rounds=rounds), session.report)
    if plot:
        benchmark.plot(report, plot)
        session.report.done(plot)
    _hand_over(session, report, terminal.table(benchmark.describe(report)), json_file)
    benchmark.expect_same(report)


@main_group.command(short_help="Measure how time and memory grow with the size of a capture.")
@click.argument("out", type=PATH)
@click.option("--rounds", type=click.IntRange(1), default=3, show_default=True, help="How often each is measured; the median is told.")
@click.option("--workers", type=Words(int), metavar="1,2,…", help="Numbers of workers to measure with.  [default: 1, 2, 4, … up to all cores]")
@click.option("--quick", is_flag=True, help="A few very small captures, once: to see that it works, not to learn from.")
@common
@click.pass_obj
def growth(session, out, rounds, workers, quick):
    """Measure how time and memory of each stage grow with photographs, fibers, their density, and workers.

    Simulates captures of several sizes in the folder OUT, and runs each stage on each of them in a process of its own. Leaves
    all measurements in OUT/growth.json, and a plot of them in OUT/growth.png, with what would be linear and the exponent of what
    is. Takes a quarter of an hour, and is of use only while the machine does little else. A run that was interrupted goes on
    where it stopped.

    \b
    Example:
      strandscope growth out/growth
    """
    from . import growth as harness

    counts = workers or tuple(2**i for i in range((os.cpu_count() or 1).bit_length()))
    params = replace(harness.QUICK if quick else harness.GrowthParams(rounds=rounds), workers=counts)
    report = harness.grow_out(out, params, session.report)
    session.report.done(out / harness.RESULT)
    harness.plot(report, params, out / harness.PICTURE)
    session.report.show(terminal.table(harness.describe(report, params)))
    session.report.done(out / harness.PICTURE)


def _hand_over(session: Session, numbers: dict, text: str, json_file: Path | None) -> None:
    """Numbers to a JSON file if one is wanted, their text to the reader."""
    if json_file:
        with atomic(json_file) as part:
            part.write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")
        session.report.done(json_file)
    session.report.show(text)
