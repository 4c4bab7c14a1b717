"""Where the hair is, in Blender: a volume of how much of each voxel is hair, and a mesh of its surface.

Both are in real size and in place with the hair (``hair.to_blender``). The volume is an OpenVDB file in mm of the object frame, as the
command line writes it, which Blender reads again whenever the Blender file is opened; its object has the scale and the turn, since
Cycles puts voxels of 0.1 mm that are told in metres millimetres away (5.2, also where OpenVDB wrote the file). The mesh is in the
Blender file.
"""

import hashlib
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

from ..core.errors import StrandscopeError
from ..core.volume import Volume, write_volume
from . import material
from .hair import to_blender

FILE = "strandscope_volume"  # custom property of both objects: the path that they were made for
DISPLAY_DENSITY = 0.3  # a mm, where all is hair


def add_volume(volume: Volume, path: Path, name: str = "Hair", collection: bpy.types.Collection | None = None) -> list[bpy.types.Object]:
    """A new volume object and a new mesh object, linked to ``collection`` (the scene's if None), in place of those of the same path.

    path: of the OpenVDB file to write. Its name gets a digest of what is in it: Blender reads a path once as long as it
    runs, and a Blender file, or an undone step, shows what it showed. Raises StrandscopeError where nothing is hair, or it cannot be written.
    """
    if len(volume.faces) == 0:
        raise StrandscopeError(f"{name}: nothing was found to be hair; expected some voxels at least")
    digest = hashlib.sha256(volume.distance_mm.tobytes() + repr((volume.grid, volume.edge_mm)).encode()).hexdigest()[:8]
    file = path.with_name(f"{path.stem}_{digest}.vdb")
    write_volume(file, volume)
    _remove(str(path))
    data = bpy.data.volumes.new(f"{name} Volume")
    data.filepath = str(file)
    data.display.density = DISPLAY_DENSITY
    mesh = bpy.data.meshes.new(f"{name} Surface")
    mesh.from_pydata(to_blender(volume.vertices_mm), [], volume.faces, shade_flat=False)
    made = []
    for block, make in ((data, material.volume_material), (mesh, material.surface_material)):
        block.materials.append(make())
        new = bpy.data.objects.new(block.name, block)
        new[FILE] = str(path)
        (collection or bpy.context.scene.collection).objects.link(new)
        made.append(new)
    made[0].matrix_world = in_blender()
    return made


def in_blender() -> Matrix:
    """``hair.to_blender`` as the matrix of an object whose data are mm of the object frame."""
    first, *ends = to_blender(np.eye(4, 3, -1)).astype(np.float64)
    return Matrix.LocRotScale(first, None, None) @ Matrix(np.array(ends) - first).transposed().to_4x4()


def _remove(path: str) -> None:
    """Take out the objects that were made for a file before."""
    for old in [each for each in bpy.data.objects if each.get(FILE) == path]:
        data = old.data
        bpy.data.objects.remove(old)
        if data.users == 0:
            (bpy.data.volumes if isinstance(data, bpy.types.Volume) else bpy.data.meshes).remove(data)
