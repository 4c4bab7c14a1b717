"""Captures and strands into Blender."""

from pathlib import Path

import bpy
from bpy.props import CollectionProperty, StringProperty
from bpy_extras.io_utils import ImportHelper

from ...core.capture import FILE_NAME
from ...core.errors import StrandscopeError
from ...core.strands import Strands, load_strands
from .. import hair, material


def show_strands(context, strands: Strands, name: str) -> bpy.types.Object:
    """Strands as a new hair object with its material, active and selected, and in view."""
    new = hair.add_hair(strands, name, context.collection)
    if len(bpy.data.hair_curves) == 1:  # the first hair of a file is shown as thick as it is, not as lines
        context.scene.render.hair_type = "STRIP"
    new.data.materials.append(bpy.data.materials.get(material.NAME) or material.hair_material())
    look_at(context, [new])
    return new


def look_at(context, objects: list[bpy.types.Object]) -> None:
    """Select these objects only, the first active, and bring them into view."""
    if context.object and context.object.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    for other in context.selected_objects:
        other.select_set(False)
    for each in objects:
        each.select_set(True)
    context.view_layer.objects.active = objects[0]
    _frame_selected(context)


def _frame_selected(context) -> None:
    """Bring what is selected into view in the viewport: hair in real size is small. Nothing happens without a window."""
    for area in context.screen.areas if context.screen and not bpy.app.background else ():
        region = next((region for region in area.regions if region.type == "WINDOW"), None)
        if area.type == "VIEW_3D" and region:
            with context.temp_override(area=area, region=region):
                bpy.ops.view3d.view_selected()
            space = area.spaces.active
            space.clip_start = min(space.clip_start, space.region_3d.view_distance / 20)
            return


class STRANDSCOPE_OT_import_capture(bpy.types.Operator, ImportHelper):
    """Choose a capture: photographs of hair, and the file that says how they were taken"""

    bl_idname = "strandscope.import_capture"
    bl_label = "Import Capture"
    bl_options = {"UNDO"}

    filename_ext = ".json"
    filter_glob: StringProperty(default=f"{FILE_NAME};*.json", options={"HIDDEN"})

    def execute(self, context):
        path = Path(self.filepath)
        settings = context.scene.strandscope
        settings.capture_path = str(path if path.is_dir() or path.suffix != ".json" else path.parent)
        if settings.capture_error:
            self.report({"ERROR"}, settings.capture_error)
            return {"CANCELLED"}
        self.report({"INFO"}, f"{settings.capture_name}: {settings.capture_facts.replace(chr(10), ', ')}")
        return {"FINISHED"}


class STRANDSCOPE_OT_import_strands(bpy.types.Operator, ImportHelper):
    """Import hair from a strands file, as one hair curves object in real size"""

    bl_idname = "strandscope.import_strands"
    bl_label = "Import Strands"
    bl_options = {"UNDO"}

    filename_ext = ".npz"
    filter_glob: StringProperty(default="*.npz", options={"HIDDEN"})
    directory: StringProperty(subtype="DIR_PATH", options={"SKIP_SAVE", "HIDDEN"})
    files: CollectionProperty(type=bpy.types.OperatorFileListElement, options={"SKIP_SAVE", "HIDDEN"})

    def execute(self, context):
        paths = [Path(self.directory, file.name) for file in self.files if file.name] or [Path(self.filepath)]
        try:
            for path in paths:
                strands = load_strands(path)
                show_strands(context, strands, str(strands.provenance.get("capture") or path.stem)[:60])
        except StrandscopeError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"{len(strands)} strands")
        return {"FINISHED"}

    def invoke(self, context, event):
        if self.files:  # dropped onto a window
            return self.execute(context)
        return super().invoke(context, event)


class STRANDSCOPE_OT_enlarge(bpy.types.Operator):
    """Show this hair 10 times larger, by its scale. Where one unit is a metre, Cycles cannot shade anything as thin as hair"""

    bl_idname = "strandscope.enlarge"
    bl_label = "Enlarge 10 Times"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        cls.poll_message_set("Select hair that Strandscope made")
        return hair.is_hair(context.object)

    def execute(self, context):
        context.object.scale = [10 * factor for factor in context.object.scale]
        return {"FINISHED"}


class STRANDSCOPE_FH_strands(bpy.types.FileHandler):
    """Strands files dropped onto a 3D viewport"""

    bl_idname = "STRANDSCOPE_FH_strands"
    bl_label = "Strandscope Strands"
    bl_import_operator = "strandscope.import_strands"
    bl_file_extensions = ".npz"

    @classmethod
    def poll_drop(cls, context):
        return context.area is not None and context.area.type == "VIEW_3D"


def menu(self, _context):
    self.layout.operator(STRANDSCOPE_OT_import_strands.bl_idname, text="Strandscope Strands (.npz)")
    self.layout.operator(STRANDSCOPE_OT_import_capture.bl_idname, text=f"Strandscope Capture ({FILE_NAME})")


CLASSES = (STRANDSCOPE_OT_import_capture, STRANDSCOPE_OT_import_strands, STRANDSCOPE_OT_enlarge, STRANDSCOPE_FH_strands)
