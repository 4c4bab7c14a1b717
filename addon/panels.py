"""The tab "Strandscope" in the sidebar of the 3D viewport."""

import textwrap

import bpy

from . import hair, rig

_CHARACTERS = 0.14  # of text that fit in a pixel of width, at a scale of the interface of 1


class Tab:
    """Where the panels are."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Strandscope"


def text(layout, context, text: str, icon: str = "NONE") -> None:
    """Lines of text, wrapped to the width of the sidebar."""
    scale = context.preferences.system.ui_scale
    width = max(int(_CHARACTERS * context.region.width / scale) - 4, 16)
    column = layout.column(align=True)
    column.scale_y = 0.8
    for line in text.splitlines():
        for part in textwrap.wrap(line, width) or [""]:
            column.label(text=part, icon=icon)
            icon = "BLANK1" if icon != "NONE" else "NONE"


def _job(layout, context) -> None:
    """The running job: how far it is, how long it takes, and the way to stop it."""
    job = context.window_manager.strandscope_job
    column = layout.column(align=True)
    row = column.row(align=True)
    row.progress(factor=job.fraction, type="BAR", text=f"{job.stage} {100 * job.fraction:.0f} %" if job.fraction else f"{job.stage} …")
    row.operator("strandscope.cancel", text="", icon="X")
    if job.remaining:
        column.label(text=job.remaining, icon="TIME")


class STRANDSCOPE_PT_capture(Tab, bpy.types.Panel):
    bl_label = "Capture"

    def draw(self, context):
        layout, settings = self.layout, context.scene.strandscope
        layout.prop(settings, "capture_path", text="", placeholder="Folder of a capture")
        if settings.capture_error:
            box = layout.box()
            box.alert = True
            text(box, context, settings.capture_error, icon="ERROR")
        elif settings.capture_name:
            column = layout.column()
            text(column, context, settings.capture_name, icon="OUTLINER_OB_CURVES")
            text(column, context, settings.capture_facts, icon="BLANK1")
        elif not rig.desk.running:
            layout.operator("strandscope.import_capture", icon="IMPORT")


class STRANDSCOPE_PT_reconstruct(Tab, bpy.types.Panel):
    bl_label = "Reconstruct"

    def draw(self, context):
        layout, settings = self.layout, context.scene.strandscope
        layout.use_property_split = True
        layout.use_property_decorate = False
        column = layout.column()
        column.prop(settings, "preset")
        column.prop(settings, "infill")
        column.prop(settings, "output_path")
        job = context.window_manager.strandscope_job
        if job.running and job.title in ("Reconstruction", "Volume"):
            _job(layout, context)
        else:
            layout.operator("strandscope.reconstruct", icon="STRANDS")
            layout.operator("strandscope.show_volume", icon="VOLUME_DATA")


class STRANDSCOPE_PT_hair(Tab, bpy.types.Panel):
    bl_label = "Hair"

    def draw(self, context):
        layout, active = self.layout, context.object
        layout.operator("strandscope.import_strands", icon="IMPORT")
        if not hair.is_hair(active):
            return
        text(layout, context, hair.describe(active), icon="OUTLINER_OB_CURVES")
        inputs = hair.switches(active)
        if inputs:
            row = layout.row(align=True)
            for name, switch in zip(("Captured", "Infill"), inputs, strict=True):
                row.prop(switch, "value", text=name, toggle=True)
        if context.scene.render.engine == "CYCLES" and hair.is_small_for_cycles(active):
            column = layout.column(align=True)
            text(column, context, "Too thin for Cycles at this scale", icon="INFO")
            column.operator("strandscope.enlarge", icon="FULLSCREEN_ENTER")


class STRANDSCOPE_PT_compare(Tab, bpy.types.Panel):
    bl_label = "Compare"

    def draw(self, context):
        layout, settings = self.layout, context.scene.strandscope
        layout.use_property_split = True
        layout.use_property_decorate = False
        column = layout.column(align=True)
        for name in ("angles", "size", "samples"):
            column.prop(settings, name)
        job = context.window_manager.strandscope_job
        if job.running and job.title == "Comparison":
            _job(layout, context)
        else:
            row = layout.row(align=True)
            row.operator("strandscope.compare", icon="RENDER_STILL")
            row.operator("strandscope.open_comparison", text="", icon="WINDOW")


_CLASSES = (STRANDSCOPE_PT_capture, STRANDSCOPE_PT_reconstruct, STRANDSCOPE_PT_hair, STRANDSCOPE_PT_compare)


def register():
    for cls in _CLASSES:
        bpy.utils.register_class(cls)


def unregister():
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
