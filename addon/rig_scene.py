"""A scene like the capture rig: camera, turntable, light and background where geometry.py says they are.

In Blender's axes (z up) the turntable turns about z and the camera looks along +y from the -y side. Hair is kept in metres,
in real size; the turntable, its parent, shows it 100 times larger in a scene whose unit is the centimetre, so that all
lengths still read true. At one unit a metre Cycles would draw hair 2 to 3 % wrong in width and 20 to 60 % wrong in colour,
in bands along the strands; from 10 times larger on it agrees with itself within 0.05 %.
"""

import math
from dataclasses import dataclass

import bpy
import numpy as np

from ..core.capture import Capture
from ..core.geometry import Optics
from ..core.strands import Strands
from .hair import METRES_PER_MM

UNITS_PER_MM = 0.1
SENSOR_MM = 36.0
LIGHT_DEG, LIGHT_DISTANCE = 60.0, 1.5  # angle that the light fills, seen from the hair; its distance in working distances
LIGHT_RADIANCE = 8.0
BOARD_MM = 120.0  # background board behind the axis
BOARD_COLOR = (0.06, 0.16, 0.38)  # linear
FRAMES = 120  # of one turn
DEFAULT_WORKING_DISTANCE_MM, DEFAULT_CONE_DEG = 330.0, 10.0
MARGIN = 1.1  # of a view around strands without a capture


@dataclass(frozen=True)
class View:
    """What a photograph shows: the optics and the size of its channel plane."""

    optics: Optics
    width_px: int
    height_px: int


@dataclass(frozen=True)
class Rig:
    """The objects of a rig scene, and its units."""

    turntable: bpy.types.Object
    camera: bpy.types.Object
    light: bpy.types.Object
    board: bpy.types.Object
    view: View
    units_per_mm: float

    def turn(self, angle_deg: float) -> None:
        """Turn the hair as the turntable does."""
        self.turntable.rotation_euler = (0, 0, math.radians(angle_deg))

    def focus(self, focus_mm: float) -> None:
        """Move the camera so that its plane of focus is at d = focus_mm."""
        self.camera.location = (0, -(self.view.optics.working_distance_mm + focus_mm) * self.units_per_mm, 0)


def view_of(capture: Capture) -> View:
    """The view of a capture's photographs. Raises CaptureError if the first of them cannot be read."""
    height, width = capture.shape
    return View(capture.optics, width, height)


def view_around(strands: Strands, longest_px: int = 1440) -> View:
    """A view with all strands in it at every angle, for strands without a capture; the paper's camera."""
    low, high = strands.points_mm.min(axis=0), strands.points_mm.max(axis=0)
    reach = float(np.hypot(strands.points_mm[:, 0], strands.points_mm[:, 2]).max())
    near = DEFAULT_WORKING_DISTANCE_MM / max(DEFAULT_WORKING_DISTANCE_MM - reach, 0.2 * DEFAULT_WORKING_DISTANCE_MM)
    width_mm, height_mm = (MARGIN * near * extent for extent in (max(2 * reach, 1.0), max(float(high[1] - low[1]), 1.0)))
    pitch = max(width_mm, height_mm) / longest_px
    width, height = max(round(width_mm / pitch), 16), max(round(height_mm / pitch), 16)
    middle = float(low[1] + high[1]) / 2 * near
    return View(Optics(DEFAULT_WORKING_DISTANCE_MM, pitch, (width - 1) / 2, (height - 1) / 2 + middle / pitch, DEFAULT_CONE_DEG), width, height)


def build(scene: bpy.types.Scene, hair: bpy.types.Object, view: View, units_per_mm: float = UNITS_PER_MM, cone_deg: float | None = None) -> Rig:
    """Set up a scene for a view of hair: turntable (the hair's parent), camera at d = 0, light, board, and Cycles.

    cone_deg: full angle of the cone of rays of a thin lens, or None for a pinhole.
    """
    into = bpy.data.collections.new("Rig")
    scene.collection.children.link(into)
    rig = Rig(
        turntable=_turntable(into, hair, units_per_mm),
        camera=_camera(into, view, units_per_mm, cone_deg),
        light=_light(into, view, units_per_mm),
        board=_board(into, view, units_per_mm),
        view=view,
        units_per_mm=units_per_mm,
    )
    rig.focus(0.0)
    scene.camera = rig.camera
    scene.world = bpy.data.worlds.new("Dark room")
    scene.world.color = (0, 0, 0)
    scene.unit_settings.system, scene.unit_settings.length_unit = "METRIC", "MILLIMETERS"
    scene.unit_settings.scale_length = METRES_PER_MM / units_per_mm
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples = "CPU", 64
    scene.cycles_curves.shape = "THICK"
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = view.width_px, view.height_px, 100
    scene.view_settings.view_transform, scene.view_settings.look = "Standard", "None"
    return rig


def animate(scene: bpy.types.Scene, rig: Rig) -> None:
    """One full turn in ``FRAMES`` frames, evenly."""
    scene.frame_start, scene.frame_end = 1, FRAMES
    for frame, angle_deg in ((1, 0.0), (FRAMES + 1, 360.0)):
        rig.turn(angle_deg)
        rig.turntable.keyframe_insert("rotation_euler", index=2, frame=frame)
    for bag in rig.turntable.animation_data.action.layers[0].strips[0].channelbags:
        for curve in bag.fcurves:
            curve.extrapolation = "LINEAR"
            for key in curve.keyframe_points:
                key.interpolation = "LINEAR"
    scene.frame_set(1)


def _link(into: bpy.types.Collection, name: str, data) -> bpy.types.Object:
    new = bpy.data.objects.new(name, data)
    into.objects.link(new)
    return new


def _turntable(into, hair, units_per_mm) -> bpy.types.Object:
    turntable = _link(into, "Turntable", None)
    turntable.empty_display_type, turntable.empty_display_size = "SINGLE_ARROW", 0.02
    turntable.scale = (units_per_mm / METRES_PER_MM,) * 3
    hair.parent = turntable
    return turntable


def _camera(into, view: View, units_per_mm, cone_deg) -> bpy.types.Object:
    optics, lens = view.optics, bpy.data.cameras.new("Camera")
    lens.sensor_fit, lens.sensor_width = "HORIZONTAL", SENSOR_MM
    lens.lens = SENSOR_MM * optics.working_distance_mm / (view.width_px * optics.pitch_mm)
    lens.shift_x = ((view.width_px - 1) / 2 - optics.axis_col_px) / view.width_px
    lens.shift_y = (optics.axis_row_px - (view.height_px - 1) / 2) / view.width_px
    distance = optics.working_distance_mm * units_per_mm
    lens.clip_start, lens.clip_end = 0.1 * distance, 10 * distance
    lens.display_size = 20 * units_per_mm
    lens.dof.focus_distance = distance
    if cone_deg:
        lens.dof.use_dof = True
        lens.dof.aperture_fstop = lens.lens * 1e-3 / (2 * distance * math.tan(math.radians(cone_deg / 2)))
    camera = _link(into, "Camera", lens)
    camera.rotation_euler = (math.pi / 2, 0, 0)
    return camera


def _light(into, view: View, units_per_mm) -> bpy.types.Object:
    """An evenly bright disc behind the camera that fills ``LIGHT_DEG`` as seen from the hair."""
    distance = LIGHT_DISTANCE * view.optics.working_distance_mm * units_per_mm
    light = bpy.data.lights.new("Soft light", "AREA")
    light.shape, light.size = "DISK", 2 * distance * math.tan(math.radians(LIGHT_DEG / 2))
    light.energy = LIGHT_RADIANCE * math.pi * (math.pi / 4 * light.size**2)
    new = _link(into, "Soft light", light)
    new.location, new.rotation_euler = (0, -distance, 0), (math.pi / 2, 0, 0)
    return new


def _board(into, view: View, units_per_mm) -> bpy.types.Object:
    """A blue board that the camera sees and that lights nothing."""
    optics = view.optics
    field_mm = max(view.width_px, view.height_px) * optics.pitch_mm
    half = 3 * field_mm * (optics.working_distance_mm + BOARD_MM) / optics.working_distance_mm * units_per_mm
    y = BOARD_MM * units_per_mm
    mesh = bpy.data.meshes.new("Background")
    mesh.from_pydata([(-half, y, -half), (half, y, -half), (half, y, half), (-half, y, half)], [], [(0, 1, 2, 3)])
    material = bpy.data.materials.new("Background")
    nodes = material.node_tree.nodes
    nodes.clear()
    output, emission = nodes.new("ShaderNodeOutputMaterial"), nodes.new("ShaderNodeEmission")
    output.location = (200, 0)
    emission.inputs["Color"].default_value = (*BOARD_COLOR, 1)
    material.node_tree.links.new(emission.outputs[0], output.inputs["Surface"])
    material.diffuse_color = (*BOARD_COLOR, 1)
    mesh.materials.append(material)
    board = _link(into, "Background", mesh)
    board.visible_diffuse = board.visible_glossy = board.visible_transmission = board.visible_volume_scatter = board.visible_shadow = False
    board.display_type, board.hide_select = "WIRE", True
    return board
