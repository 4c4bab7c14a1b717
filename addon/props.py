"""What the panel shows and keeps: settings of a scene, the state of a running job, preferences."""

import contextlib
from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, PointerProperty, StringProperty

from ..core.capture import Capture, load_capture
from ..core.errors import StrandscopeError
from ..core.rig import attach
from ..core.rig.plan import Plan, load_plan

ROOT = __package__.rpartition(".")[0]  # of the extension: the key of its preferences

PRESETS = (
    ("auto", "Automatic", "Estimate the settings from the photographs"),
    ("straight", "Straight", "The paper's settings for straight hair"),
    ("wavy", "Wavy", "The paper's settings for wavy hair"),
    ("curls", "Curls", "The paper's settings for curls"),
)


def _capture_changed(settings, _context):
    """Read the capture that the user chose, and keep what the panel says about it."""
    settings.capture_name = settings.capture_facts = settings.capture_error = ""
    if not settings.capture_path:
        return
    try:
        capture = load_capture(settings.capture_folder)
        facts = _facts(capture)
    except StrandscopeError as error:
        settings.capture_error = str(error)
        return
    settings.capture_name, settings.capture_facts = capture.name, facts
    settings.output_path = str(_results(capture) / "strands.npz")


def _facts(capture: Capture) -> str:
    """Lines that tell a capture from others."""
    count = sum(len(sweep.files) for sweep in capture.sweeps)
    height, width = capture.shape
    pitch = capture.optics.pitch_mm
    lines = [
        f"{len(capture.sweeps)} sweep{'s' if len(capture.sweeps) != 1 else ''}, {count} photographs",
        f"{width} × {height} pixels, {width * pitch:.1f} × {height * pitch:.1f} mm",
    ]
    return "\n".join(lines)


def _results(capture: Capture) -> Path:
    """The folder for what is made of a capture: never in it."""
    chosen = preferences(bpy.context).output_folder
    return (Path(bpy.path.abspath(chosen)) if chosen else capture.folder.parent) / f"{capture.folder.name}_results"


class STRANDSCOPE_PG_settings(bpy.types.PropertyGroup):
    """Of a scene: what to work on, and how."""

    capture_path: StringProperty(
        name="Folder", subtype="DIR_PATH", update=_capture_changed, description="Folder of a capture: photographs and their capture.json"
    )
    capture_name: StringProperty()
    capture_facts: StringProperty()
    capture_error: StringProperty()
    preset: EnumProperty(name="Hair", items=PRESETS, description="How the hair falls")
    infill: BoolProperty(name="Infill", default=True, description="Add hairs inside, where no camera sees, that follow those around them")
    output_path: StringProperty(name="Output", subtype="FILE_PATH", description="The strands file to write (.npz)")
    angles: IntProperty(name="Angles", default=4, min=1, max=360, description="Photographs to compare with, evenly around the hair")
    size: IntProperty(name="Size", default=360, min=16, max=8192, subtype="PIXEL", description="Pixels along the longer side of a picture")
    samples: IntProperty(name="Samples", default=16, min=1, max=4096, description="Rays a pixel: more take longer and have less grain")
    comparison: StringProperty(description="The picture that was rendered last")

    @property
    def capture_folder(self) -> Path:
        return Path(bpy.path.abspath(self.capture_path))

    @property
    def output_file(self) -> Path:
        return Path(bpy.path.abspath(self.output_path))


def _kind_changed(rig, context):
    _rig_changed(rig, context)
    rig.planned = False


def _rig_changed(rig, _context):
    """Read the plan of the rig file that the user chose."""
    rig.file_error = ""
    if rig.kind != "FILE" or not rig.file:
        return
    try:
        rig.take(load_plan(rig.file_path))
    except StrandscopeError as error:
        rig.file_error = str(error)


def _folder_changed(rig, _context):
    """How far the capture in the folder is, if there is one."""
    rig.begun, rig.complete = "", False
    if not rig.folder:
        return
    with contextlib.suppress(StrandscopeError):  # there is none yet
        told = attach.status(rig.folder_path)
        rig.begun = f"{told['done']} of {told['total']} photographs are there"
        rig.complete = told["done"] == told["total"]


def _port_names(_rig, _context, _typed):
    from . import rig

    return [(url, words) for url, words in rig.desk.ports]


class STRANDSCOPE_PG_rig(bpy.types.PropertyGroup):
    """Of a scene: which rig takes the photographs, and of what."""

    kind: EnumProperty(
        name="Rig",
        items=(
            ("FILE", "Real", "A camera on a stage, and a turntable, on a controller"),
            ("VIRTUAL", "Virtual", "A simulated controller and camera, and a simulated lock of hair"),
        ),
        update=_kind_changed,
    )
    file: StringProperty(name="Rig File", subtype="FILE_PATH", update=_rig_changed, description="What the rig is made of, and a plan (.toml)")
    file_error: StringProperty()
    port: StringProperty(
        name="Port", search=_port_names, search_options={"SUGGESTION"}, description="Address of the controller. Empty: that of the rig file"
    )
    style: EnumProperty(name="Hair", items=PRESETS[1:], description="How the virtual hair falls")
    scale: EnumProperty(
        name="Size",
        items=(("tiny", "Tiny", "A minute"), ("small", "Small", "Minutes"), ("medium", "Medium", "An hour")),
        description="Of the virtual lock",
    )
    speed: FloatProperty(name="Speed", default=20, min=1, max=100, description="The virtual rig's time passes so many times as fast")
    turn_deg: EnumProperty(name="Turn", items=[(n, f"{n}°", f"Turn by {n}°") for n in ("0.1", "1", "15", "90")], default="15")
    jog_mm: EnumProperty(name="Step", items=[(n, f"{n} mm", f"Move by {n} mm") for n in ("0.02", "0.2", "1", "5", "20")], default="1")
    planned: BoolProperty(description="The fields below hold the plan of the rig")
    angles: IntProperty(name="Angles", default=24, min=1, max=3600, description="Sweeps, evenly around")
    near_mm: FloatProperty(
        name="Near Side", default=37.5, precision=2, step=10, description="Where sweeps end: the plane of focus is so far in front of the axis, in mm"
    )
    far_mm: FloatProperty(name="Far Side", default=-37.5, precision=2, step=10, description="Where sweeps begin: behind the axis, in mm")
    step_mm: FloatProperty(name="Step", default=0.2, min=0.001, max=100, precision=3, step=1, description="From each photograph to the next, in mm")
    shutter_s: FloatProperty(name="Shutter", default=0.25, min=0.0001, max=600, precision=4, step=1, description="How long it is open, in seconds")
    f_number: FloatProperty(name="Aperture", default=2.8, min=0.5, max=64, precision=1, description="The f-number")
    iso: IntProperty(name="ISO", default=100, min=1, max=1_000_000)
    check_shots: BoolProperty(
        name="Checks", default=True, description="Take the first photograph of each sweep again at its end: it tells whether the hair has moved"
    )
    folder: StringProperty(
        name="Folder", subtype="DIR_PATH", update=_folder_changed, description="For the photographs: a new one, or one to go on with"
    )
    begun: StringProperty()
    complete: BoolProperty()
    name: StringProperty(name="Name", description="What is photographed. Empty: the folder's name")
    sweep: IntProperty(name="Sweep", min=0, description="The sweep to take again")

    @property
    def file_path(self) -> Path | None:
        return Path(bpy.path.abspath(self.file)) if self.file else None

    @property
    def folder_path(self) -> Path:
        return Path(bpy.path.abspath(self.folder)).resolve()

    def take(self, plan: Plan) -> None:
        """Show a plan in the fields."""
        self.angles, self.far_mm, self.near_mm, self.step_mm = len(plan.angles_deg), plan.first_mm, plan.last_mm, plan.step_mm
        self.shutter_s, self.f_number, self.iso, self.check_shots = plan.shutter_s, plan.f_number, plan.iso, plan.check_shots
        self.planned = True


class STRANDSCOPE_PG_job(bpy.types.PropertyGroup):
    """Of the window manager: the job that is running, for the panel."""

    running: BoolProperty()
    stop: BoolProperty()
    title: StringProperty()
    stage: StringProperty()
    fraction: FloatProperty(min=0, max=1)
    remaining: StringProperty()

    def begin(self, title: str) -> None:
        self.running, self.stop, self.title, self.stage, self.fraction, self.remaining = True, False, title, "Starting", 0.0, ""

    def show(self, stage: str, fraction: float, remaining_s: float | None, stopping: bool) -> None:
        self.stage = "Stopping" if stopping else stage[:1].upper() + stage[1:]
        self.fraction, self.remaining = fraction, "" if remaining_s is None or stopping else duration_left(remaining_s)

    def end(self) -> None:
        self.running = self.stop = False


class STRANDSCOPE_AP_preferences(bpy.types.AddonPreferences):
    """Of the user, for all files."""

    bl_idname = ROOT

    output_folder: StringProperty(name="Results", subtype="DIR_PATH", description="Folder for what is made of captures. Empty: beside the capture")
    workers: IntProperty(name="Processor Cores", default=0, min=0, max=256, description="Cores to use at work; 0 uses all")
    memory_gb: FloatProperty(name="Memory", default=6.0, min=0.5, soft_max=64, precision=1, description="Memory to use at most, in GB")

    def draw(self, _context):
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        column = layout.column()
        column.prop(self, "output_folder", placeholder="Beside the capture")
        column.prop(self, "workers", text="Processor Cores (0 for all)")
        column.prop(self, "memory_gb", text="Memory (GB)")


class _Defaults:
    """Preferences where the extension is not enabled as one, as in tests."""

    output_folder, workers, memory_gb = "", 0, 6.0


def preferences(context):
    """The user's preferences of this extension."""
    addon = context.preferences.addons.get(ROOT)
    return addon.preferences if addon and addon.preferences else _Defaults


def duration_left(seconds: float) -> str:
    """How long something still takes, in words."""
    if seconds < 90:
        return f"{max(round(seconds), 1)} s left"
    return f"{round(seconds / 60)} min left" if seconds < 5400 else f"{seconds / 3600:.1f} h left"


_CLASSES = (STRANDSCOPE_PG_settings, STRANDSCOPE_PG_rig, STRANDSCOPE_PG_job, STRANDSCOPE_AP_preferences)


def register():
    for cls in _CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.strandscope = PointerProperty(type=STRANDSCOPE_PG_settings)
    bpy.types.Scene.strandscope_rig = PointerProperty(type=STRANDSCOPE_PG_rig)
    bpy.types.WindowManager.strandscope_job = PointerProperty(type=STRANDSCOPE_PG_job, options={"SKIP_SAVE"})


def unregister():
    del bpy.types.WindowManager.strandscope_job
    del bpy.types.Scene.strandscope_rig
    del bpy.types.Scene.strandscope
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
