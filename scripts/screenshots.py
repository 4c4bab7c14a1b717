"""The pictures of the panel in docs/rig.md, taken of a virtual rig at work in the full Blender, with the extension installed:

blender --window-geometry 0 0 1600 1200 --python scripts/screenshots.py -- docs

Under X11 ImageMagick photographs the screen, where it is installed; Blender itself, elsewhere, gives black pictures without a GPU.
"""

import importlib
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
from dataclasses import asdict
from pathlib import Path

import bpy

OUT = Path(sys.argv[sys.argv.index("--") + 1]).resolve() if "--" in sys.argv else Path("docs").resolve()
FOLDER = Path(tempfile.mkdtemp()) / "lock"
TAB = "Strandscope"
SCALE = 1.1  # of the interface
TABS_PX = 24  # width of the strip with the names of the tabs, at a scale of 1
EDGE_PX = 6  # of the area, below the region
DRAWN_S = 4.0  # for a software renderer to draw everything
WAIT_S = 120.0


def loaded(name: str):
    """A module of the extension, under whatever name it is installed."""
    package = next(module for module in sys.modules if module.endswith("strandscope.addon"))
    return importlib.import_module(f"{package}.{name}")


def loaded_core(name: str):
    """A module of the extension's core."""
    return importlib.import_module(f"{loaded('rig').attach.__package__.removesuffix('.rig')}.{name}")


def others():
    """The panels that are not of the rig."""
    panels = loaded("panels")
    return panels.STRANDSCOPE_PT_reconstruct, panels.STRANDSCOPE_PT_hair, panels.STRANDSCOPE_PT_compare


def states():
    """Bring the panel from state to state; yields names to photograph, and conditions to wait for."""
    rig, ops, settings = loaded("rig"), bpy.ops.strandscope, bpy.context.scene.strandscope_rig
    desk = rig.desk
    for cls in others():
        bpy.utils.unregister_class(cls)
    for cls in reversed(loaded("panels_rig").CLASSES):
        bpy.utils.unregister_class(cls)
    for cls in loaded("panels_rig").CLASSES:
        cls.bl_options = set()  # open
        bpy.utils.register_class(cls)
    settings.kind, settings.file = "FILE", str(rig_without_camera(FOLDER.parent / "rig.toml"))
    yield "disconnected"
    ops.rig_connect("INVOKE_DEFAULT")
    yield lambda: desk.hand.connected and desk.hand.place
    ops.rig_home("INVOKE_DEFAULT")
    yield lambda: desk.hand.state == "homing"
    yield "homing"
    yield lambda: desk.hand.known
    settings.folder = str(FOLDER.parent / "hair")
    ops.rig_start("INVOKE_DEFAULT")
    yield lambda: desk.run and desk.run.state == "waiting"
    yield "waiting"
    ops.rig_order("INVOKE_DEFAULT", what="abort")
    yield lambda: not desk.running
    ops.rig_dismiss()

    settings.kind = "VIRTUAL"
    rig.connect(["--virtual", "--speed", "30"])
    yield lambda: desk.hand.connected and desk.hand.can_see
    for command in ("home", "go 0 0", "live on"):
        desk.hand.say(command)
    yield lambda: not desk.hand.busy and desk.hand.picture
    settings.folder, settings.name, settings.angles = str(FOLDER), "A virtual lock", 8
    yield "focus"
    settings.far_mm, settings.near_mm, settings.speed = -0.8, 0.8, 1.5  # too short: it will be told
    ops.rig_start("INVOKE_DEFAULT")
    yield lambda: desk.run and desk.run.told.get("done", 0) >= 1
    yield "running"
    yield lambda: desk.run.warnings
    ops.rig_order("INVOKE_DEFAULT", what="pause")
    yield lambda: desk.run.state == "paused"
    yield "warning"
    ops.rig_order("INVOKE_DEFAULT", what="abort")
    yield lambda: not desk.running
    settings.speed = 60
    yield lambda: settings.begun
    ops.rig_start("INVOKE_DEFAULT")
    yield lambda: not desk.running and desk.then is None and desk.run
    yield lambda: desk.run.handed_over
    yield "done"
    for cls in others():
        bpy.utils.register_class(cls)


def rig_without_camera(path: Path) -> Path:
    """A rig file: a simulated controller, and a camera whose tethering software is not running."""
    controller, plan = loaded_core("rig.controller"), loaded_core("rig.plan")
    config = controller.ControllerConfig(time_factor=0.3)
    stage = controller.stage_config(controller.start_controller(config).url, config)
    camera = {"kind": "cable", "folder": str(path.parent / "tether")}  # which is not there
    plan.save_plan(path, plan.Plan(count=41, first_mm=-4.0, bytes_each=25_000_000), stage=asdict(stage), camera=camera)
    return path


def photograph(name: str, window, region) -> None:
    """The sidebar as a picture, without what is empty below it."""
    out, whole = OUT / f"panel_{name}.png", Path(tempfile.gettempdir()) / "strandscope_window.png"
    if shutil.which("import"):
        subprocess.run(["import", "-window", "root", whole], check=True)
    else:
        bpy.ops.screen.screenshot(filepath=str(whole))
    width, top = region.width - int(TABS_PX * SCALE), window.height - region.y - region.height
    cut = ["-crop", f"{width}x{region.height - EDGE_PX}+{region.x}+{top}", "+repage", "-fuzz", "1%", "-trim", "+repage", "-strip"]
    subprocess.run(["convert", whole, *cut, out], check=True)
    print(out, flush=True)


def main() -> None:
    view = bpy.context.preferences.view
    view.show_splash, view.ui_scale = False, SCALE
    bpy.context.preferences.system.use_region_overlap = False  # so that nothing shines through
    flow, waited = states(), [None, 0.0]

    def step():
        window = bpy.context.window_manager.windows[0]
        area = next(area for area in window.screen.areas if area.type == "VIEW_3D")
        region = next(region for region in area.regions if region.type == "UI")
        area.spaces.active.show_region_ui = True
        area.tag_redraw()
        try:
            region.active_panel_category = TAB
        except AttributeError:  # it has not been drawn yet
            return 0.5
        state, since = waited
        if callable(state) and not state():
            if time.monotonic() - since > WAIT_S:
                print("waited in vain", loaded("rig").desk, flush=True)
                bpy.ops.wm.quit_blender()
            return 0.1
        if isinstance(state, str) and time.monotonic() - since < DRAWN_S:
            return 0.2
        if isinstance(state, str):
            photograph(state, window, region)
        try:
            with bpy.context.temp_override(window=window, area=area, region=region):
                waited[:] = next(flow), time.monotonic()
        except StopIteration:
            bpy.ops.wm.quit_blender()
        return 0.1

    def guarded():
        try:
            return step()
        except Exception:
            traceback.print_exc()
            bpy.ops.wm.quit_blender()

    bpy.app.timers.register(guarded, first_interval=3.0)


main()
