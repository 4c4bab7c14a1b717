"""Long work: reconstruction, the volume and the comparison, each a job in a child process."""

from pathlib import Path

import bpy

from ...core.errors import StrandscopeError
from ...core.strands import load_strands, save_strands
from ...core.volume import load_volume
from .. import hair, pictures, volume
from ..jobs import Command, JobOperator
from ..props import preferences
from .bring_in import look_at, show_strands


def _idle(cls, context) -> bool:
    if context.window_manager.strandscope_job.running:
        cls.poll_message_set("Another job is running; wait for it, or cancel it")
        return False
    return True


def _captured(cls, context) -> bool:
    settings = context.scene.strandscope
    if settings.capture_name:
        return True
    cls.poll_message_set("The capture cannot be read, see above" if settings.capture_error else "Choose a capture first")
    return False


class STRANDSCOPE_OT_reconstruct(JobOperator, bpy.types.Operator):
    """Find the hairs in the photographs, write them to the output file, and add them to the scene. Esc stops"""

    bl_idname = "strandscope.reconstruct"
    bl_label = "Reconstruct"
    bl_options = {"UNDO"}

    @classmethod
    def poll(cls, context):
        return _idle(cls, context) and _captured(cls, context)

    def command(self, context) -> Command:
        settings, user, out = context.scene.strandscope, preferences(context), context.scene.strandscope.output_file
        if not settings.output_path or out.suffix != ".npz":
            raise StrandscopeError(f"{settings.output_path or 'Output'}: expected a strands file to write, with a name that ends in .npz")
        arguments = ["reconstruct", settings.capture_folder, "-o", out, "--preset", settings.preset, "--memory", f"{user.memory_gb:.1f}GB"]
        if user.workers:
            arguments += ["--workers", user.workers]
        if not settings.infill:
            arguments.append("--no-infill")
        return Command("Reconstruction", tuple(map(str, arguments)), out.with_suffix(".log"))

    def finish(self, context, output: Path) -> None:
        strands = load_strands(output)
        show_strands(context, strands, str(strands.provenance.get("capture") or context.scene.strandscope.capture_name)[:60])
        self.report({"INFO"}, f"{len(strands)} strands, also in {output}")


class STRANDSCOPE_OT_show_volume(JobOperator, bpy.types.Operator):
    """Show where hair is, inside and between the curves of the output file, as a volume and as a surface. Esc stops"""

    bl_idname = "strandscope.show_volume"
    bl_label = "Show the Volume"
    bl_options = {"UNDO"}

    @classmethod
    def poll(cls, context):
        if not _idle(cls, context) or not _captured(cls, context):
            return False
        if not context.scene.strandscope.output_file.is_file():
            cls.poll_message_set("Reconstruct first: there is no output file yet")
            return False
        return True

    def command(self, context) -> Command:
        settings, user, out = context.scene.strandscope, preferences(context), context.scene.strandscope.output_file
        arguments = ["volume", settings.capture_folder, out]
        if user.workers:
            arguments += ["--workers", user.workers]
        return Command("Volume", tuple(map(str, arguments)), out.with_name(f"{out.stem}_volume.log"))

    def finish(self, context, output: Path) -> None:
        path = output.parent.with_suffix(".vdb")  # beside the strands, as is the folder that it was kept in
        made = volume.add_volume(load_volume(output), path, context.scene.strandscope.capture_name[:50], context.collection)
        look_at(context, made)
        self.report({"INFO"}, f"The volume is in {made[0].data.filepath}")


class STRANDSCOPE_OT_compare(JobOperator, bpy.types.Operator):
    """Render the active hair as the photographs show it, and set both side by side in one picture. Esc stops"""

    bl_idname = "strandscope.compare"
    bl_label = "Render Comparison"

    @classmethod
    def poll(cls, context):
        if not _idle(cls, context) or not _captured(cls, context):
            return False
        if not hair.is_hair(context.object):
            cls.poll_message_set("Select hair that Strandscope made: reconstruct or import it")
            return False
        return True

    def command(self, context) -> Command:
        settings = context.scene.strandscope
        folder = settings.output_file.parent / "comparison"
        strands = folder / "strands.npz"
        save_strands(strands, hair.strands_of(context.object))
        arguments = ("turntable", settings.capture_folder, strands, folder, "--angles", settings.angles, "--size", settings.size,
                     "--samples", settings.samples)  # fmt: skip
        return Command("Comparison", tuple(map(str, arguments)), folder / "turntable.log", renders=True)

    def finish(self, context, output: Path) -> None:
        context.scene.strandscope.comparison = str(output)
        self.report({"INFO"}, f"The comparison is in {output}")


class STRANDSCOPE_OT_open_comparison(bpy.types.Operator):
    """Show the picture that was rendered last, in a window of its own"""

    bl_idname = "strandscope.open_comparison"
    bl_label = "Open Picture"

    @classmethod
    def poll(cls, context):
        cls.poll_message_set("Render a comparison first")
        return bool(context.scene.strandscope.comparison)

    def execute(self, context):
        try:
            pictures.show(context, Path(context.scene.strandscope.comparison))
        except RuntimeError as error:
            self.report({"ERROR"}, " ".join(str(error).split()))
            return {"CANCELLED"}
        return {"FINISHED"}


class STRANDSCOPE_OT_cancel(bpy.types.Operator):
    """Stop the job that is running; what it has done so far is kept, and the next run goes on from there"""

    bl_idname = "strandscope.cancel"
    bl_label = "Cancel"

    def execute(self, context):
        context.window_manager.strandscope_job.stop = True
        return {"FINISHED"}


CLASSES = (STRANDSCOPE_OT_reconstruct, STRANDSCOPE_OT_show_volume, STRANDSCOPE_OT_compare, STRANDSCOPE_OT_open_comparison, STRANDSCOPE_OT_cancel)
