"""Where hair is, in Blender: the volume as Blender itself reads it, the mesh, and the operator from the button to both."""

from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Vector

from strandscope.addon import hair, material
from strandscope.addon.volume import add_volume
from strandscope.core.errors import StrandscopeError
from strandscope.core.grid import Grid
from strandscope.core.pipeline import preset, reconstruct
from strandscope.core.simulate import SimulateParams, simulate
from strandscope.core.volume import Volume, centres, surface

GRID = Grid.around((-2.0, -1.0, -3.0), (3.0, 5.0, 3.0), 0.1)
MIDDLE, RADIUS, EDGE = np.array([0.7, 2.5, -0.6]), 1.4, 0.4  # mm; on no axis, so that a wrong sign shows


def ball(radius=RADIUS, middle=MIDDLE, grid=GRID):
    centres = np.stack(np.meshgrid(*(grid.centres(a) for a in range(3)), indexing="ij"), axis=-1)
    distance = (radius - np.linalg.norm(centres - middle, axis=-1)).astype(np.float32)
    nothing = np.zeros(grid.shape)
    return Volume(grid, nothing.astype(np.float32), nothing.astype(np.uint32), distance, EDGE, *surface(distance, grid))


def meshed(object_, threshold):
    """Vertices (n, 3) of the surface at which Blender's own Volume to Mesh finds the density to be ``threshold``."""
    mesh = bpy.data.meshes.new("meshed")
    judge = bpy.data.objects.new("judge", mesh)
    bpy.context.scene.collection.objects.link(judge)
    modifier = judge.modifiers.new("", "VOLUME_TO_MESH")
    modifier.object, modifier.threshold, modifier.resolution_mode = object_, threshold, "GRID"
    bpy.context.view_layer.update()
    found = judge.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    places = np.empty(3 * len(found.vertices), np.float32)
    found.vertices.foreach_get("co", places)
    bpy.data.objects.remove(judge)
    return places.reshape(-1, 3)


def away(places, middle=MIDDLE):
    """Distances (n,) mm from the middle of the ball, of places in Blender."""
    return np.linalg.norm(places - hair.to_blender(middle), axis=1) / hair.METRES_PER_MM


def vertices(object_):
    places = np.empty(3 * len(object_.data.vertices), np.float32)
    object_.data.vertices.foreach_get("co", places)
    return places.reshape(-1, 3)


def test_blender_sees_the_ball_where_the_hair_is(tmp_path):
    volume, mesh = add_volume(ball(), tmp_path / "ball.vdb")
    assert volume.data.grids.load()
    assert [(grid.name, grid.data_type) for grid in volume.data.grids] == [("density", "FLOAT")]
    np.testing.assert_allclose(np.array(volume.data.grids[0].matrix_object), centres(GRID), atol=1e-6)
    points = np.random.default_rng(0).uniform(-5, 5, (9, 3))
    np.testing.assert_allclose([volume.matrix_world @ Vector(point) for point in points], hair.to_blender(points), atol=1e-9)
    for threshold, depth in ((0.5, 0.0), (0.104, -0.12), (0.896, 0.12)):  # of the smooth step over EDGE: 0.2 and 0.8 of it
        off = away(meshed(volume, threshold)) - (RADIUS - depth)
        assert len(off) > 500
        assert np.abs(off).max() < 0.02  # mm, a fifth of a voxel
    assert np.abs(away(vertices(mesh)) - RADIUS).max() < 0.5 * GRID.voxel_mm / 10


@pytest.mark.parametrize("scale", [1, 10])
def test_cycles_shows_it_there(tmp_path, scale):
    """In metres Cycles would show voxels this small elsewhere, though Volume to Mesh finds them in place."""
    volume, mesh = add_volume(ball(), tmp_path / "ball.vdb")
    volume.scale, mesh.hide_render = [scale * factor for factor in volume.scale], True
    haze = volume.data.materials[0].node_tree.nodes["Principled Volume"]
    haze.inputs["Density"].default_value, haze.inputs["Color"].default_value = 6.0, (0, 0, 0, 1)  # smoke in front of a white sky
    scene = bpy.context.scene
    scene.world = bpy.data.worlds.new("sky")
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (1, 1, 1, 1)
    scene.render.engine, scene.cycles.samples, scene.view_settings.view_transform = "CYCLES", 8, "Raw"
    scene.render.resolution_x = scene.render.resolution_y = 100
    scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.camera.data.type, scene.camera.data.ortho_scale, scene.camera.data.clip_start = "ORTHO", 0.01 * scale, 1e-4
    scene.collection.objects.link(scene.camera)
    for place, turn, right, up in (((0, -0.03, 0), (np.pi / 2, 0, 0), 0, 2), ((0, 0, 0.03), (0, 0, 0), 0, 1)):
        scene.camera.location, scene.camera.rotation_euler = [scale * x for x in place], turn
        scene.render.filepath = str(tmp_path / "seen.png")
        bpy.ops.render.render(write_still=True)
        picture = bpy.data.images.load(scene.render.filepath)
        dark = np.array(picture.pixels).reshape(100, 100, 4)[..., 0] < 0.5  # from the lowest row up
        bpy.data.images.remove(picture)
        rows, columns = np.nonzero(dark)
        seen = 0.1 * (np.array([columns.mean(), rows.mean()]) - 49.5)  # mm
        assert seen == pytest.approx(hair.to_blender(MIDDLE)[[right, up]] * 1000, abs=0.05)
        assert np.sqrt(dark.sum() * 0.01 / np.pi) == pytest.approx(RADIUS + EDGE / 4, abs=EDGE / 4 + 0.05)


def test_the_mesh_faces_outwards_and_hair_is_seen_through_both(tmp_path):
    volume, mesh = add_volume(ball(), tmp_path / "ball.vdb")
    middle = Vector(hair.to_blender(MIDDLE))
    assert all(face.normal.dot(face.center - middle) > 0 for face in mesh.data.polygons)
    assert not mesh.data.validate()
    haze, glaze = volume.data.materials[0], mesh.data.materials[0]
    assert (haze.name, glaze.name) == (material.VOLUME, material.SURFACE)
    assert glaze.diffuse_color[3] < 0.5
    assert glaze.node_tree.nodes["Principled BSDF"].inputs["Alpha"].default_value < 0.5


def test_shown_again_it_takes_the_place_of_what_was_shown(tmp_path):
    """Of the file as it is now, not as Blender remembers it."""
    add_volume(ball(0.9), tmp_path / "ball.vdb")
    other = add_volume(ball(0.9), tmp_path / "other.vdb")
    assert away(meshed(bpy.data.objects["Hair Volume"], 0.5)).max() < 1.0
    volume, mesh = add_volume(ball(), tmp_path / "ball.vdb")
    assert set(bpy.data.objects) == {volume, mesh, *other}
    assert (len(bpy.data.volumes), len(bpy.data.materials)) == (2, 2)
    assert np.abs(away(meshed(volume, 0.5)) - RADIUS).max() < 0.02
    assert len(list(tmp_path.glob("ball_????????.vdb"))) == 2  # a Blender file that was saved shows the one before


def test_where_nothing_is_hair_it_says_so(tmp_path):
    with pytest.raises(StrandscopeError, match="nothing was found to be hair"):
        add_volume(ball(radius=-1.0), tmp_path / "none.vdb")
    assert not list(tmp_path.iterdir())
    assert not bpy.data.objects


# ---- the operator ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def lock(tmp_path_factory):
    """The folder of a capture of four fibers, and the strands that were found in it, with the volume beside them."""
    folder = tmp_path_factory.mktemp("simulated") / "capture"
    simulate(folder, SimulateParams(scale="tiny", fibers=4))
    strands = folder.parent / "results" / "strands.npz"
    reconstruct(folder, strands, preset())
    return folder, strands


@pytest.mark.usefixtures("registered")
def test_the_button_shows_the_volume_of_a_reconstruction(lock):
    folder, strands = lock
    settings, show = bpy.context.scene.strandscope, bpy.ops.strandscope.show_volume
    assert not show.poll()
    settings.capture_path = str(folder)
    settings.output_path = str(folder.parent / "none.npz")
    assert not show.poll()
    settings.output_path = str(strands)
    kept = strands.with_name("strands.work") / "volume.npz"
    before = kept.stat().st_mtime_ns
    assert show() == {"FINISHED"}
    assert kept.stat().st_mtime_ns == before  # what the reconstruction kept is shown
    volume, mesh = bpy.context.object, next(each for each in bpy.context.selected_objects if each.type == "MESH")
    assert volume.type == "VOLUME"
    assert Path(volume.data.filepath).parent == strands.parent
    bpy.ops.strandscope.import_strands(filepath=str(strands))
    points = hair.to_blender(hair.strands_of(bpy.context.object).points_mm)
    surface_mm = vertices(mesh) / hair.METRES_PER_MM
    inner = points[np.abs(points[:, 2] / hair.METRES_PER_MM) < np.abs(surface_mm[:, 2]).max() - 0.6] / hair.METRES_PER_MM
    nearest = [np.linalg.norm(surface_mm - point, axis=1).min() for point in inner[::97]]
    assert np.percentile(nearest, 50) == pytest.approx(0.5, abs=0.1)  # the surface of a lone hair is so far from it
    assert min(nearest) > 0.35


@pytest.mark.usefixtures("registered")
def test_showing_the_volume_can_be_undone(lock):
    folder, strands = lock
    bpy.context.scene.strandscope.capture_path = str(folder)
    bpy.context.scene.strandscope.output_path = str(strands)
    bpy.context.preferences.edit.use_global_undo = True
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.strandscope.show_volume()
    bpy.ops.ed.undo_push(message="shown")
    assert sorted(each.type for each in bpy.data.objects) == ["MESH", "VOLUME"]
    bpy.ops.ed.undo()
    assert not bpy.data.objects
    bpy.ops.ed.redo()
    volume = next(each for each in bpy.data.objects if each.type == "VOLUME")
    assert volume.data.grids.load()
    assert "density" in volume.data.grids
