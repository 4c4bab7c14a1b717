"""The scene sees what geometry.py says a photograph shows."""

import math

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

from strandscope.addon import hair, material, rig_scene
from strandscope.addon.turntable import _prepare
from strandscope.core.geometry import Optics, pixels
from strandscope.core.raw import read_planes
from strandscope.core.strands import Strands, offsets_of

CENTRED = rig_scene.View(Optics(330.0, 12 / 420, 209.5, 209.5, 10.0), 420, 420)
SHIFTED = rig_scene.View(Optics(330.0, 0.03, 100.25, 311.5, 10.0), 640, 480)
UPRIGHT = rig_scene.View(Optics(250.0, 1 / 35, 300.0, 700.0, 8.0), 500, 1400)
UNITS = (0.001, rig_scene.UNITS_PER_MM)


@pytest.mark.parametrize("view", [CENTRED, SHIFTED, UPRIGHT])
@pytest.mark.parametrize("units_per_mm", UNITS)
@pytest.mark.parametrize("angle_deg", [0.0, 33.0, 170.0, -80.0])
@pytest.mark.parametrize("focus_mm", [0.0, -5.0, 12.0])
def test_projection_agrees_with_geometry(strands, view, units_per_mm, angle_deg, focus_mm):
    scene = bpy.context.scene
    rig = rig_scene.build(scene, hair.add_hair(strands), view, units_per_mm)
    rig.turn(angle_deg)
    rig.focus(focus_mm)
    bpy.context.view_layer.update()
    points = np.random.default_rng(0).uniform(-8, 8, (30, 3))
    expected = pixels(points, angle_deg, focus_mm, view.optics)
    for point, (col, row, _) in zip(hair.to_blender(points), expected, strict=True):
        seen = world_to_camera_view(scene, rig.camera, rig.turntable.matrix_world @ Vector(point))
        assert seen.x * view.width_px - 0.5 == pytest.approx(col, abs=0.01)
        assert (1 - seen.y) * view.height_px - 0.5 == pytest.approx(row, abs=0.01)


def test_cycles_draws_a_hair_where_geometry_says(tmp_path):
    """Pixel centres at integers, the turn, the width: a rendered hair, off the axis and off the plane of focus."""
    view = rig_scene.View(Optics(330.0, 0.04, 10.0, 20.0, 10.0), 32, 24)
    points = np.array([[-0.1, -5, 0.3], [-0.1, 5, 0.3]], np.float32)
    radius_mm = 0.08
    one = Strands(points, offsets_of([2]), np.full(2, radius_mm, np.float32), np.zeros(1, np.uint8), np.ones(2, np.float32))
    scene = bpy.context.scene
    rig = rig_scene.build(scene, hair.add_hair(one), view)
    rig.board.hide_render = True
    rig.turn(60.0)
    rig.focus(-2.0)
    _prepare(scene, (32, 24), 64)
    scene.render.filepath = str(tmp_path / "hair.exr")
    bpy.ops.render.render(write_still=True)
    cover = read_planes(tmp_path / "hair.exr", "RGBA")[3]
    middle = cover[12]
    col = pixels(points.mean(axis=0), 60.0, -2.0, view.optics)[0]
    assert (middle * np.arange(32)).sum() / middle.sum() == pytest.approx(col, abs=0.05)
    assert middle.sum() * 0.04 == pytest.approx(2 * radius_mm, rel=0.05)  # width in mm, to the grain of 64 samples


def test_cycles_shades_hair_the_same_in_a_larger_scene(tmp_path, strands):
    """At one unit a metre it does not: colours are then 20 to 60 % off. Same rays, so hardly any grain is in the difference."""
    view, sums = rig_scene.View(Optics(330.0, 0.05, 11.5, 11.5, 10.0), 24, 24), []
    for units_per_mm in (rig_scene.UNITS_PER_MM, 10 * rig_scene.UNITS_PER_MM):
        bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
        scene, new = bpy.context.scene, hair.add_hair(strands)
        new.data.materials.append(material.hair_material())
        rig_scene.build(scene, new, view, units_per_mm).board.hide_render = True
        _prepare(scene, (24, 24), 16)
        scene.render.filepath = str(tmp_path / "hair.exr")
        bpy.ops.render.render(write_still=True)
        sums.append(read_planes(tmp_path / "hair.exr", "RGBA").sum(axis=(1, 2)))
    np.testing.assert_allclose(sums[0], sums[1], rtol=0.01)


@pytest.mark.parametrize("units_per_mm", UNITS)
def test_light(strands, units_per_mm):
    """The light fills 60 degrees as seen from the hair, behind the camera, and its radiance is the same in any unit."""
    rig = rig_scene.build(bpy.context.scene, hair.add_hair(strands), CENTRED, units_per_mm)
    distance = -rig.light.location.y
    assert distance > -rig.camera.location.y > 0
    assert 2 * math.degrees(math.atan(rig.light.data.size / 2 / distance)) == pytest.approx(60, abs=1e-3)
    area = math.pi / 4 * rig.light.data.size**2
    assert rig.light.data.energy / (math.pi * area) == pytest.approx(rig_scene.LIGHT_RADIANCE, rel=1e-5)
    bpy.context.view_layer.update()
    towards = rig.light.matrix_world.to_3x3() @ Vector((0, 0, -1))
    assert towards.y == pytest.approx(1)


@pytest.mark.parametrize("units_per_mm", UNITS)
def test_thin_lens(strands, units_per_mm):
    """The aperture's radius is that of a cone of 10 degrees at the working distance."""
    lens = rig_scene.build(bpy.context.scene, hair.add_hair(strands), CENTRED, units_per_mm, cone_deg=10.0).camera.data
    assert lens.dof.use_dof
    radius = lens.lens * 1e-3 / (2 * lens.dof.aperture_fstop)
    assert lens.dof.focus_distance == pytest.approx(330 * units_per_mm)
    assert math.degrees(2 * math.atan(radius / lens.dof.focus_distance)) == pytest.approx(10.0, rel=1e-4)


def test_board_lights_nothing(strands):
    board = rig_scene.build(bpy.context.scene, hair.add_hair(strands), CENTRED).board
    assert board.visible_camera
    assert not any((board.visible_diffuse, board.visible_glossy, board.visible_transmission, board.visible_shadow))


def test_view_around_holds_all_strands(strands):
    view = rig_scene.view_around(strands)
    for angle_deg in range(0, 360, 45):
        seen = pixels(strands.points_mm, angle_deg, 0.0, view.optics)
        assert seen[:, :2].min() > 0
        assert (seen[:, 0] < view.width_px).all()
        assert (seen[:, 1] < view.height_px).all()


def test_one_turn_is_animated_evenly(strands):
    scene = bpy.context.scene
    rig = rig_scene.build(scene, hair.add_hair(strands), CENTRED)
    rig_scene.animate(scene, rig)
    for frame in (1, 31, 61, 120):
        scene.frame_set(frame)
        assert math.degrees(rig.turntable.rotation_euler.z) == pytest.approx(360 * (frame - 1) / rig_scene.FRAMES, abs=1e-3)
