"""Volumes and surfaces of shapes that are known, and their files, read by what others read them with."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from strandscope.core.errors import StrandscopeError
from strandscope.core.grid import Grid
from strandscope.core.vdb import write_vdb
from strandscope.core.volume import Volume, centres, load_volume, save_volume, surface, write_volume

GRID = Grid.around((-3.0, -1.0, -2.0), (4.0, 6.0, 5.0), 0.2)
MIDDLE, RADIUS = np.array([0.7, 2.5, 1.4]), 1.9


def places(grid=GRID):
    return np.stack(np.meshgrid(*(grid.centres(a) for a in range(3)), indexing="ij"), axis=-1)


def ball(grid=GRID, middle=MIDDLE, far_mm=1.3):
    """Signed distance of a ball, clipped as ``surface_distance`` clips it."""
    return np.maximum(RADIUS - np.linalg.norm(places(grid) - middle, axis=-1), -far_mm).astype(np.float32)


def volume(distance, grid=GRID):
    rng = np.random.default_rng(1)
    blueness = np.where(distance > 0, 0.3, np.nan).astype(np.float32)
    rays = rng.integers(0, 99, distance.shape).astype(np.uint32)
    return Volume(grid, blueness, rays, distance, 0.4, *surface(distance, grid), made_from="a test")


def openvdb():
    """The library itself, which comes with Blender for Python, or a skipped test."""
    found = importlib.util.find_spec("bpy")
    sites = [str(path.parent) for path in Path(found.origin).parent.glob("**/site-packages/openvdb.*")] if found else []
    if not sites and not importlib.util.find_spec("openvdb"):
        pytest.skip("OpenVDB is not here")
    sys.path.extend(sites)
    try:
        return importlib.import_module("openvdb")
    finally:
        del sys.path[len(sys.path) - len(sites) :]


def read(path, name="density"):
    """(values (nx, ny, nz), grid) that OpenVDB reads from a file."""
    return openvdb().read(str(path), name)


# ---- the surface -----------------------------------------------------------------------------------------------------


def corners(vertices, faces):
    return vertices[faces].astype(float)


def held(vertices, faces):
    """Volume that a closed surface holds, positive where its triangles face outwards."""
    a, b, c = np.moveaxis(corners(vertices, faces), 1, 0)
    return np.einsum("fi,fi->f", a, np.cross(b, c)).sum() / 6


def is_closed(faces):
    """Whether each edge has a triangle on either side, that turns the other way."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there, back = {tuple(e) for e in edges.tolist()}, {tuple(e) for e in edges[:, ::-1].tolist()}
    return len(there) == len(edges) and there == back


def test_the_surface_of_a_ball_is_where_it_is_and_faces_outwards():
    vertices, faces = surface(ball(), GRID)
    off = np.linalg.norm(vertices - MIDDLE, axis=1) - RADIUS
    assert np.abs(off).max() < 0.02 * GRID.voxel_mm + 0.01  # between voxels a distance is nearly linear
    assert held(vertices, faces) == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.01)
    assert is_closed(faces)
    assert (vertices.dtype, faces.dtype) == (np.float32, np.int32)


def test_a_surface_that_leaves_the_grid_is_closed_there():
    low = Grid(GRID.origin_mm, GRID.voxel_mm, (GRID.shape[0], 15, GRID.shape[2]))  # up to y = 2: the ball goes on
    vertices, faces = surface(ball(low), low)
    assert is_closed(faces)
    assert vertices[:, 1].max() == pytest.approx(low.high_mm[1], abs=0.5 * low.voxel_mm)
    height = low.high_mm[1] - (MIDDLE[1] - RADIUS)
    assert held(vertices, faces) == pytest.approx(np.pi * height**2 * (RADIUS - height / 3), rel=0.04)


def test_nothing_has_no_surface_and_one_voxel_has_one():
    vertices, faces = surface(np.full(GRID.shape, -1.0, np.float32), GRID)
    assert (vertices.shape, faces.shape) == ((0, 3), (0, 3))
    one = np.full(GRID.shape, -0.1, np.float32)
    one[0, 3, -1] = 0.1
    vertices, faces = surface(one, GRID)
    assert is_closed(faces)
    at = [GRID.centres(axis)[i] for axis, i in enumerate((0, 3, -1))]
    assert np.abs(vertices - at).max() <= 0.51 * GRID.voxel_mm
    with pytest.raises(StrandscopeError, match="the distance has shape"):
        surface(one[1:], GRID)


# ---- files -----------------------------------------------------------------------------------------------------------


def test_a_volume_survives_its_file_and_the_bytes_are_the_same(tmp_path):
    made = volume(ball())
    for name in ("a.npz", "b.npz"):
        save_volume(tmp_path / name, made)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    again = load_volume(tmp_path / "a.npz")
    assert (again.grid, again.edge_mm, again.made_from) == (made.grid, made.edge_mm, made.made_from)
    for name in ("blueness", "rays", "distance_mm", "vertices_mm", "faces", "density"):
        np.testing.assert_array_equal(getattr(again, name), getattr(made, name))
        assert getattr(again, name).dtype == getattr(made, name).dtype


def test_a_damaged_volume_is_an_error_in_words(tmp_path):
    made = volume(ball())
    save_volume(tmp_path / "v.npz", made)
    arrays = dict(np.load(tmp_path / "v.npz"))
    for change, said in (({"rays": arrays["rays"][1:]}, "rays has shape"), ({"faces": arrays["faces"][:, :2]}, r"expected shape \(n, 3\)")):
        np.savez(tmp_path / "bad.npz", **arrays | change)
        with pytest.raises(StrandscopeError, match=said):
            load_volume(tmp_path / "bad.npz")
    np.savez(tmp_path / "bad.npz", rays=arrays["rays"])
    with pytest.raises(StrandscopeError, match="'origin_mm' is missing"):
        load_volume(tmp_path / "bad.npz")
    with pytest.raises(StrandscopeError, match=r"expected one of \.vdb, \.ply, \.npz"):
        write_volume(tmp_path / "v.stl", made)


def test_openvdb_reads_every_voxel_where_it_is(tmp_path):
    made = volume(ball())
    write_volume(tmp_path / "ball.vdb", made)
    grid = read(tmp_path / "ball.vdb")
    assert (grid.gridClass, grid.name, grid.background) == ("fog volume", "density", 0.0)
    values = np.zeros(GRID.shape, np.float32)
    grid.copyToArray(values)
    np.testing.assert_array_equal(values, made.density)
    assert grid.activeVoxelCount() == np.count_nonzero(made.density)
    for cell in ((0, 0, 0), (12, 3, 30)):
        assert grid.transform.indexToWorld(cell) == pytest.approx([GRID.centres(a)[i] for a, i in enumerate(cell)], abs=1e-9)
    at = np.argwhere(values > 0.5)
    volume_mm3 = len(at) * GRID.voxel_mm**3
    assert volume_mm3 == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.02)
    world = np.array([grid.transform.indexToWorld(tuple(cell)) for cell in at[::7]])
    assert world.mean(axis=0) == pytest.approx(MIDDLE, abs=0.05)


@pytest.mark.parametrize("shape", [(1, 1, 1), (8, 8, 8), (9, 130, 17), (4100, 3, 9), (0, 2, 2)])
def test_openvdb_reads_volumes_of_all_shapes(tmp_path, shape):
    """Beyond the bounds of leaves, of their nodes, and of the nodes of these (4096 voxels)."""
    rng = np.random.default_rng(2)
    noise = np.where(rng.uniform(size=shape) < 0.03, rng.normal(size=shape), 0).astype(np.float32)
    noise[tuple(np.array(shape) - 1) if noise.size else ()] = 7.5
    turned = np.array([[0, 0, 0.5, 3], [-0.5, 0, 0, 2], [0, 0.5, 0, 1], [0, 0, 0, 1.0]])
    write_vdb(tmp_path / "two.vdb", {"noise": noise, "none": np.zeros(shape, np.float32)}, turned)
    grid, none = read(tmp_path / "two.vdb", "noise"), read(tmp_path / "two.vdb", "none")
    assert none.activeVoxelCount() == 0
    if noise.size:
        values = np.zeros(shape, np.float32)
        grid.copyToArray(values)
        np.testing.assert_array_equal(values, noise)
    assert grid.activeVoxelCount() == np.count_nonzero(noise)
    assert grid.transform.indexToWorld((1, 2, 3)) == pytest.approx((turned @ [1, 2, 3, 1])[:3])


def test_the_same_volume_gives_the_same_vdb(tmp_path):
    for name in ("a.vdb", "b.vdb"):
        write_volume(tmp_path / name, volume(ball()))
    assert (tmp_path / "a.vdb").read_bytes() == (tmp_path / "b.vdb").read_bytes()
    with pytest.raises(StrandscopeError, match=r"expected \(nx, ny, nz\)"):
        write_vdb(tmp_path / "flat.vdb", {"flat": np.ones((3, 3), np.float32)}, np.eye(4))
    assert not (tmp_path / "flat.vdb").exists()


def test_a_mesh_file_has_the_mesh(tmp_path):
    made = volume(ball())
    write_volume(tmp_path / "ball.ply", made)
    data = (tmp_path / "ball.ply").read_bytes()
    head, _, body = data.partition(b"end_header\n")
    assert f"element vertex {len(made.vertices_mm)}".encode() in head
    np.testing.assert_array_equal(np.frombuffer(body, "<f4", 3 * len(made.vertices_mm)).reshape(-1, 3), made.vertices_mm)
    rows = np.frombuffer(body[12 * len(made.vertices_mm) :], [("n", "u1"), ("corners", "<i4", 3)])
    assert np.all(rows["n"] == 3)
    np.testing.assert_array_equal(rows["corners"], made.faces)


def test_centres_are_those_of_the_grid():
    cells = np.array([[0, 0, 0, 1], [5, 2, 9, 1]])
    expected = [[GRID.centres(a)[i] for a, i in enumerate(cell[:3])] for cell in cells]
    np.testing.assert_allclose((centres(GRID) @ cells.T).T[:, :3], expected)
