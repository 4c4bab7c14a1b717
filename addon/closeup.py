"""Close-ups of hair: captured curves, infills and the truth under the same light, beside each other."""

import math
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import bpy
import numpy as np

from ..core import sidebyside
from ..core.compare import load_truth
from ..core.filled import parted
from ..core.geometry import Optics
from ..core.progress import Progress, silent
from ..core.statistics import load_hair
from ..core.strands import CAPTURED, INFILL, Strands, clip, fibers, load_strands
from . import hair as hair_module
from . import material, rig_scene, turntable

LIGHTS = (  # name, azimuth from the camera to its right and height in degrees, angle that it fills, radiance
    ("Key", -40.0, 30.0, 35.0, 26.0),
    ("Fill", 55.0, 5.0, 50.0, 4.0),
    ("Rim", 145.0, 25.0, 60.0, 2.2),
)
BACKDROP = (0.012, 0.012, 0.013)  # linear
LENS_DISTANCE_MM = 200.0
NAMES = ("captured only", "the paper's infill", "our infill", "the truth")
SECTION_NAMES = ("captured only", "with the paper's infill (orange)", "with our infill (orange)", "the truth (orange: not found)")
SHADE = "shade"  # curve attribute: a number of 0…1 that is the same for all pieces of a fiber
COLORS = {CAPTURED: (0.42, 0.40, 0.37), INFILL: (0.85, 0.22, 0.03)}  # linear, of a cross-section


@dataclass(frozen=True)
class CloseupParams:
    """What a close-up shows."""

    width_mm: float = 6.0
    height_mm: float = 4.6
    width_px: int = 410
    samples: int = 36
    melanin: float = material.MELANIN["medium brown"]
    tilt_deg: float = 0.0  # of what is above towards the camera: 0 from the front, 90 from above
    slab_mm: float | None = None  # thickness of a cross-section, in flat colours; None: all of the hair


@dataclass(frozen=True)
class Row:
    """Hair that is known, and two infills of the same captured curves."""

    title: str
    truth: Path
    paper: Path
    ours: Path


def render_closeups(rows: list[Row], out: Path, params: CloseupParams | None = None, progress: Progress = silent) -> Path:
    """Write a picture (.png) with a row for each of ``rows``: captured only, with either infill, and the truth.

    All show the volume that the truth's samples tell, a cylinder about the axis. A cross-section has captured hair in grey, and in orange
    what the cameras did not find: infill, and true hair far from all captured curves. Raises StrandsError for what cannot be read.
    """
    params = params or CloseupParams()
    pictures, captions, done = [], [], 0
    for row in rows:
        shown = _columns(row, params)
        pictures.append([])
        for _, cut in shown:
            progress(turntable.PROGRESS_STAGE, done, len(NAMES) * len(rows))
            pictures[-1].append(_rendered(cut, params))
            done += 1
        captions.append([f"{row.title}: {name}" for name, _ in shown])
    sidebyside.write_grid(pictures, captions, out)
    return out


def _columns(row: Row, params: CloseupParams) -> list[tuple[str, tuple[Strands, np.ndarray]]]:
    """What stands beside each other, with captions: strands cut to the volume to show, and their shades."""
    ours, paper, truth = load_strands(row.ours), load_strands(row.paper), load_hair(row.truth)
    samples = load_truth(row.truth).sample_points_mm.astype(float)
    reach, half = float(np.hypot(samples[:, 0], samples[:, 2]).max()), float(np.abs(samples[:, 1]).max())
    middle = samples.mean(axis=0) * (1, 0, 1)
    if params.slab_mm:
        truth, half = parted(truth, ours.captured), params.slab_mm / 2
    names = SECTION_NAMES if params.slab_mm else NAMES
    named = zip(names, (ours.captured, paper, ours, truth), strict=True)
    return [(name, _cut(strands, reach, half, middle)) for name, strands in named]


def _cut(strands: Strands, reach_mm: float, half_mm: float, middle_mm: np.ndarray) -> tuple[Strands, np.ndarray]:
    """Strands in the cylinder, moved so that middle_mm is the origin, and a shade (M,) of 0…1 that all pieces of a fiber have."""
    points = np.asarray(strands.points_mm, float)
    pieces, curve = clip(strands, np.minimum(reach_mm - np.hypot(points[:, 0], points[:, 2]), half_mm - np.abs(points[:, 1])))
    pieces = replace(pieces, points_mm=(pieces.points_mm - middle_mm).astype(np.float32))
    return pieces, np.random.default_rng(1).permutation(len(strands))[fibers(strands)[curve]] / len(strands)


def _rendered(cut: tuple[Strands, np.ndarray], params: CloseupParams) -> np.ndarray:
    """A close-up (H, W, 3) uint8 of strands and the shade of each."""
    strands, shade = cut
    pitch = params.width_mm / params.width_px
    width, height = params.width_px, round(params.height_mm / pitch)
    view = rig_scene.View(Optics(LENS_DISTANCE_MM, pitch, (width - 1) / 2, (height - 1) / 2, 0.0), width, height)
    with turntable.scene_for_now("Strandscope close-up") as scene, tempfile.TemporaryDirectory() as folder:
        if params.slab_mm:
            made = [_flat(strands.select(strands.kind == kind), kind, scene) for kind in COLORS if np.any(strands.kind == kind)]
        else:
            made = [_hair(strands, shade, params.melanin, scene)]
        rig = rig_scene.build(scene, made[0], view)
        for hair in made:
            hair.parent = rig.turntable
        if params.slab_mm:
            scene.cycles_curves.shape = "THICK_LINEAR"  # whose ends are closed
        rig.turntable.rotation_euler = (math.radians(params.tilt_deg), 0, 0)
        _light(scene, rig)
        rig.board.data.materials[0].node_tree.nodes["Emission"].inputs["Color"].default_value = (*BACKDROP, 1)
        scene.cycles.samples, scene.cycles.use_adaptive_sampling, scene.cycles.use_denoising = params.samples, False, True
        scene.cycles.max_bounces, scene.cycles.transmission_bounces, scene.cycles.glossy_bounces = 16, 16, 16
        scene.cycles.sample_clamp_indirect = 10.0
        scene.view_settings.view_transform = "AgX"
        scene.view_settings.look = "AgX - Medium High Contrast"
        scene.render.image_settings.file_format, scene.render.image_settings.color_mode = "PNG", "RGB"
        frame = Path(folder) / "closeup.png"
        turntable.render_frame(scene, frame, 0, 1, silent)
        return sidebyside.read_png(frame)


def _hair(strands: Strands, shade: np.ndarray, melanin: float, scene) -> bpy.types.Object:
    hair = hair_module.add_hair(strands, "Hair", scene.collection)
    hair.data.attributes.new(SHADE, "FLOAT", "CURVE").data.foreach_set("value", shade.astype(np.float32))
    skin = material.hair_material(melanin)
    nodes = skin.node_tree.nodes
    attribute = nodes.new("ShaderNodeAttribute")
    attribute.attribute_name = SHADE
    skin.node_tree.links.new(attribute.outputs["Fac"], nodes["Principled Hair BSDF"].inputs["Random"])
    hair.data.materials.append(skin)
    return hair


def _flat(strands: Strands, kind: int, scene) -> bpy.types.Object:
    hair = hair_module.add_hair(strands, f"Kind {kind}", scene.collection)
    skin = bpy.data.materials.new(hair.name)
    skin.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (*COLORS[kind], 1)
    skin.node_tree.nodes["Principled BSDF"].inputs["Roughness"].default_value = 0.7
    hair.data.materials.append(skin)
    return hair


def _light(scene, rig: rig_scene.Rig) -> None:
    """Three soft lights in place of the rig's."""
    distance = rig_scene.LIGHT_DISTANCE * LENS_DISTANCE_MM * rig.units_per_mm
    rig.light.hide_render = True
    for name, azimuth, height, fills, radiance in LIGHTS:
        light = bpy.data.lights.new(name, "AREA")
        light.shape, light.size = "DISK", 2 * distance * math.tan(math.radians(fills / 2))
        light.energy = radiance * math.pi * (math.pi / 4 * light.size**2)
        new = bpy.data.objects.new(name, light)
        scene.collection.objects.link(new)
        a, h = math.radians(azimuth), math.radians(height)
        new.location = (distance * math.cos(h) * math.sin(a), -distance * math.cos(h) * math.cos(a), distance * math.sin(h))
        new.rotation_euler = new.location.to_track_quat("Z", "Y").to_euler()
