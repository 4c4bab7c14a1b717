"""The part of the tab that takes photographs with a rig: below "Capture", since that is what comes of it."""

import bpy

from ..core.errors import StrandscopeError
from . import pictures, rig
from .operators.rig import plan_of
from .panels import Tab, text
from .props import duration_left

PICTURE = 8.5  # size, in heights of a button
SHOWN = 2  # warnings at a time
STATES = {  # of a rig that is moved by hand
    "connecting": ("Connecting …", "SORTTIME"),
    "homing": ("Homing …", "HOME"),
    "moving": ("Moving …", "DRIVER_TRANSFORM"),
    "held": ("Held", "PAUSE"),
    "door": ("The safety door is open", "ERROR"),
    "lost": ("No answer", "UNLINKED"),
}
RUNS = {  # of a capture
    "starting": "Starting",
    "connecting": "Connecting",
    "homing": "Homing",
    "paused": "Paused: do not touch the hair",
    "waiting": "Waiting",
    "done": "All photographs are there",
    "stopped": "Ended, as asked",
    "failed": "Failed",
}


def _split(layout):
    layout.use_property_split = True
    layout.use_property_decorate = False
    return layout.column()


def _alert(layout, context, words: str, icon: str = "ERROR") -> None:
    box = layout.box()
    box.alert = True
    text(box, context, _sentence(words), icon=icon)


def _sentence(words: str) -> str:
    """With a capital, where it does not begin with a name of a file or a port."""
    return words[:1].upper() + words[1:] if words.split(" ")[0].isalpha() else words


def _warnings(layout, context, warnings: list[str]) -> None:
    """The last few of them."""
    if not warnings:
        return
    box = layout.box()
    column = box.column()
    for line in reversed(warnings[-SHOWN:]):
        text(column, context, _sentence(line), icon="ERROR")
    if len(warnings) > SHOWN:
        text(column, context, f"and {len(warnings) - SHOWN} before", icon="BLANK1")


class _Below(Tab):
    bl_parent_id = "STRANDSCOPE_PT_capture"


class STRANDSCOPE_PT_rig(_Below, bpy.types.Panel):
    bl_label = "Rig"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, _context):
        return not rig.desk.running

    def draw(self, context):
        layout, hand = self.layout, rig.desk.hand
        if hand is None:
            self._disconnected(layout, context)
        else:
            self._connected(layout, context, hand)

    def _disconnected(self, layout, context):
        settings = context.scene.strandscope_rig
        layout.row().prop(settings, "kind", expand=True)
        column = _split(layout.column())
        if settings.kind == "FILE":
            column.prop(settings, "file", placeholder="rig.toml")
            row = column.row(align=True)
            row.prop(settings, "port", placeholder="Of the rig file")
            row.operator("strandscope.rig_ports", text="", icon="FILE_REFRESH")
            if settings.file_error:
                _alert(layout, context, settings.file_error)
        else:
            column.prop(settings, "style")
            column.prop(settings, "scale")
        if rig.desk.error:
            _alert(layout, context, rig.desk.error)
        layout.operator("strandscope.rig_connect", icon="LINKED")

    def _connected(self, layout, context, hand):
        row = layout.row(align=True)
        where = "Not homed"
        if hand.known and hand.place:
            where = f"{hand.place.angle_deg:.2f}°      {hand.place.position_mm:.2f} mm"
        state = "connecting" if not hand.connected else "homing" if hand.busy == "home" else hand.state
        words, icon = STATES.get(state, (where, "LINKED"))
        if state == "alarm":
            words, icon = "Locked: home it", "LOCKED"
        if state == "moving" and hand.known and hand.place:
            words = where
        row.label(text=words, icon=icon)
        row.operator("strandscope.rig_disconnect", text="", icon="X")
        if hand.message:
            _alert(layout, context, hand.message)
        if not hand.connected:
            return
        moves = state in ("homing", "moving") or hand.busy not in ("", "live on", "live off")
        row = layout.row(align=True)
        row.scale_y = 1.3
        if moves:
            row.alert = True
            row.operator("strandscope.rig_stop", icon="CANCEL")
        else:
            row.operator("strandscope.rig_home", icon="HOME")
            if state == "alarm":
                row.operator("strandscope.rig_unlock", icon="UNLOCKED")
        settings = context.scene.strandscope_rig
        column = layout.column(align=True)
        for axis, prop, name in (("FOCUS", "jog_mm", "Focus"), ("TURN", "turn_deg", "Turn")):
            row = column.split(factor=0.25, align=True)
            row.label(text=name)
            row = row.row(align=True)
            for way, arrow in ((-1, "TRIA_LEFT"), (1, "TRIA_RIGHT")):
                jog = row.operator("strandscope.rig_jog", text="", icon=arrow)
                jog.axis, jog.way = axis, way
                if way < 0:
                    row.prop(settings, prop, text="")
        row = column.split(factor=0.25, align=True)
        row.label(text="Go to")
        row = row.row(align=True)
        for to, name in (("FAR", "Far"), ("AXIS", "Axis"), ("NEAR", "Near"), ("FRONT", "0°")):
            row.operator("strandscope.rig_go", text=name).to = to
        _warnings(layout, context, hand.warnings)


class STRANDSCOPE_PT_frame(_Below, bpy.types.Panel):
    bl_label = "Frame and Focus"

    @classmethod
    def poll(cls, _context):
        return not rig.desk.running and rig.desk.hand is not None and rig.desk.hand.connected

    def draw(self, context):
        layout, hand = self.layout, rig.desk.hand
        row = layout.row(align=True)
        row.operator("strandscope.rig_live", icon="PAUSE" if hand.live else "PLAY", depress=hand.live)
        row.operator("strandscope.rig_picture", text="", icon="WINDOW")
        if hand.camera:
            _alert(layout, context, hand.camera, icon="CAMERA_DATA")
        shown = pictures.icon(hand.picture)
        if shown:
            column = layout.column(align=True)
            column.template_icon(shown, scale=PICTURE)
            share = hand.sharpness / hand.best if hand.best else 0.0
            column.progress(factor=share, type="BAR", text=f"Sharpness {1000 * hand.sharpness:.1f}, best {1000 * hand.best:.1f}")
        settings = context.scene.strandscope_rig
        column = _split(layout.column())
        for side, prop, name in (("FAR", "far_mm", "Far (mm)"), ("NEAR", "near_mm", "Near (mm)")):
            row = column.row(align=True)
            row.prop(settings, prop, text=name)
            row.operator("strandscope.rig_mark", text="", icon="EYEDROPPER").side = side


class STRANDSCOPE_PT_plan(_Below, bpy.types.Panel):
    bl_label = "Plan"

    @classmethod
    def poll(cls, context):
        connected = rig.desk.hand is not None and rig.desk.hand.connected
        return not rig.desk.running and connected and not context.scene.strandscope_rig.begun

    def draw(self, context):
        layout, settings = self.layout, context.scene.strandscope_rig
        column = _split(layout.column())
        column.prop(settings, "angles")
        column.prop(settings, "step_mm", text="Step (mm)")
        column.separator(factor=0.5)
        column.prop(settings, "shutter_s", text="Shutter (s)")
        column.prop(settings, "f_number", text="Aperture f/")
        column.prop(settings, "iso")
        column.prop(settings, "check_shots")
        try:
            photographs, seconds, size = rig.cost(plan_of(context))
        except StrandscopeError as error:
            _alert(layout, context, str(error))
            return
        column = layout.column(align=True)
        text(column, context, photographs, icon="RENDERLAYERS")
        pace = settings.speed if settings.kind == "VIRTUAL" else 1.0
        text(column, context, rig.attach.duration(seconds / pace), icon="TIME")
        free = rig.free_bytes(settings.folder_path if settings.folder else rig.scratch())
        row = column.column()
        row.alert = free is not None and free < size
        text(row, context, f"{_size(size)}" + (f" of {_size(free)} free" if free is not None else ""), icon="DISK_DRIVE")


class STRANDSCOPE_PT_photographs(_Below, bpy.types.Panel):
    bl_label = "Photographs"

    @classmethod
    def poll(cls, context):
        connected = rig.desk.hand is not None and rig.desk.hand.connected
        return connected or rig.desk.running or rig.desk.run is not None or bool(context.scene.strandscope_rig.begun)

    def draw(self, context):
        layout, settings, run = self.layout, context.scene.strandscope_rig, rig.desk.run
        if rig.desk.running or run:
            self._run(layout, context, run)
        if rig.desk.running:
            return
        column = _split(layout.column())
        column.prop(settings, "folder", placeholder="A new folder")
        if settings.begun:
            text(column, context, settings.begun, icon="CHECKMARK" if settings.complete else "INFO")
        elif settings.kind == "FILE":
            column.prop(settings, "name", placeholder="Of the folder")
        if settings.kind == "VIRTUAL" and not settings.complete:
            column.prop(settings, "speed")
        row = layout.row()
        row.scale_y = 1.3
        if not (settings.begun and settings.complete):
            row.operator("strandscope.rig_start", text="Continue Capture" if settings.begun else "Start Capture", icon="RENDER_ANIMATION")
        if settings.begun:
            _repeat(layout, settings)

    def _run(self, layout, context, run):
        told = run.told if run else {}
        state = run.state if run else "starting"
        done, total = told.get("done", 0), told.get("total", 0)
        failed = run is not None and not run.running and state not in ("done", "stopped")
        head = layout.row(align=True)
        if run and not run.running:
            label = head.row()
            label.alert = failed
            icon = {"done": "CHECKMARK", "stopped": "SNAP_FACE"}.get(state, "ERROR")
            label.label(text=RUNS.get(state, "Ended in the middle"), icon=icon)
            head.operator("strandscope.rig_dismiss", text="", icon="X", emboss=False)
        else:
            head.progress(factor=done / total if total else 0.0, type="BAR", text=f"{done} of {total}" if total else f"{RUNS[state]} …")
        if rig.desk.running:
            self._progress(layout, told, state)
        if failed or state == "waiting":
            _alert(layout, context, run.message)
        shown = pictures.icon(run.picture) if run else 0
        if shown:
            column = layout.column(align=True)
            column.template_icon(shown, scale=PICTURE)
            row = column.row(align=True)
            row.label(text=_photograph(told))
            row.operator("strandscope.rig_picture", text="", icon="WINDOW", emboss=False)
        if run:
            _warnings(layout, context, run.warnings)
        if not rig.desk.running:
            layout.separator()
            return
        row = layout.row(align=True)
        if state == "paused":
            row.operator("strandscope.rig_order", text="Resume", icon="PLAY").what = "resume"
        else:
            row.operator("strandscope.rig_order", text="Pause", icon="PAUSE").what = "pause"
        row.operator("strandscope.rig_order", text="End", icon="CANCEL").what = "abort"
        _repeat(layout, context.scene.strandscope_rig)
        text(layout.column(), context, "You can use Blender meanwhile, or close it", icon="INFO")

    def _progress(self, layout, told, state):
        column = layout.column(align=True)
        if state in RUNS and told.get("total"):
            column.label(text=RUNS[state], icon="PAUSE" if state == "paused" else "SORTTIME")
        elif "sweep" in told:
            column.label(text=f"Sweep {told['sweep']} at {told['angle_deg']:g}°", icon="FILE_REFRESH")
        if told.get("remaining_s") and state != "waiting":
            column.label(text=duration_left(told["remaining_s"]), icon="TIME")


def _repeat(layout, settings) -> None:
    row = layout.row(align=True)
    row.prop(settings, "sweep")
    row.operator("strandscope.rig_repeat", text="Repeat", icon="LOOP_BACK")


def _photograph(told: dict) -> str:
    if "frame" not in told:
        return ""
    return f"{told['angle_deg']:g}°, {told['position_mm']:.2f} mm"


def _size(count: float) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.0f} MB"


CLASSES = (STRANDSCOPE_PT_rig, STRANDSCOPE_PT_frame, STRANDSCOPE_PT_plan, STRANDSCOPE_PT_photographs)


def register():
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister():
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
