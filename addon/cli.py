"""The verbs that need Blender: ``blend`` and ``turntable``, in the program ``strandscope`` and in ``blender --command``."""

import importlib.util
import re

import click

from ..core.capture import load_capture
from ..core.cli import PATH, common, main_group, run
from ..core.errors import StrandscopeError
from ..core.strands import load_strands

NO_BLENDER = 'Blender is not here; run this as `blender --command strandscope …`, or install Blender for Python: pip install "bpy==5.2.*"'


class Part(click.ParamType):
    """I/N, as two numbers."""

    name = "I/N"

    def convert(self, value, param, ctx):
        if not isinstance(value, str):
            return value
        match = re.fullmatch(r"(\d+)/(\d+)", value)
        if not match or not 1 <= int(match[1]) <= int(match[2]):
            self.fail(f"{value!r} is no part; expected I/N, as in 2/4", param, ctx)
        return int(match[1]), int(match[2])


@click.command(short_help="Make a Blender file of the curves.")
@click.argument("strands", type=PATH)
@click.argument("out", type=PATH, metavar="OUT.blend")
@click.option("--capture", type=PATH, help="A capture folder: the camera of the scene then sees what its photographs show.")
@common
@click.pass_obj
def blend(session, strands, out, capture):
    """Make a Blender file of a strands file: hair curves in real size, a hair material, and a scene like the capture rig.

    The scene has the camera, the soft light, a blue background, and a turntable that turns the hair once in 120 frames.

    \b
    Example:
      strandscope blend out/strands.npz out/lock.blend --capture lock
    """
    _turntable().blend(strands, out, load_capture(capture) if capture else None)
    session.report.done(out)


@click.command(short_help="Render the curves beside the photographs.")
@click.argument("capture", type=PATH)
@click.argument("strands", type=PATH)
@click.argument("out", type=PATH)
@click.option("--angles", type=click.IntRange(1), default=4, show_default=True, help="Photographs to compare with, evenly around the hair.")
@click.option("--size", type=click.IntRange(16), default=360, show_default=True, metavar="PX", help="Pixels along the longer side of a picture.")
@click.option("--samples", type=click.IntRange(1), default=16, show_default=True, help="Rays a pixel: more take longer and have less grain.")
@click.option("--part", type=Part(), help="Render the I-th of N parts of the pictures only, and compare nothing: for N machines at once.")
@common
@click.pass_obj
def turntable(session, capture, strands, out, angles, size, samples, part):
    """Render the curves of a strands file as the photographs of CAPTURE show the hair, and set both side by side.

    OUT is the picture to write (.png), or a folder for the picture and all its frames. It compares with the capture's
    turntable photographs; a capture without them lends those of its sweeps that are focused on the axis. The exposure is
    matched. Frames that are there already are kept, so an interrupted run continues, and machines can share the work: first each
    with its --part, the first part before the others, then one of them without.

    \b
    Example:
      strandscope turntable lock out/strands.npz out/turntable.png --angles 6
    """
    photographs, curves = load_capture(capture), load_strands(strands)
    session.report.done(_turntable().render_turntable(photographs, curves, out, angles, size, samples, session.report, part))


def full_group() -> click.Group:
    """All verbs: those of the core, and those that need Blender."""
    group = click.Group(**_same_as(main_group))
    for command in (*main_group.commands.values(), blend, turntable):
        group.add_command(command)
    return group


def run_all(argv: list[str]) -> int:
    """Run one command line with all verbs; returns its exit code."""
    return run([str(argument) for argument in argv], full_group())


def _same_as(group: click.Group) -> dict:
    kept = ("name", "help", "params", "context_settings", "callback", "epilog", "short_help", "no_args_is_help", "invoke_without_command")
    return {name: getattr(group, name) for name in kept}


def _turntable():
    """The module that works in Blender. Raises StrandscopeError, with what to do, where there is no Blender."""
    if importlib.util.find_spec("bpy") is None:
        raise StrandscopeError(NO_BLENDER)
    from . import turntable as module

    return module
