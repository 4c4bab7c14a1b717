"""Strands in Blender without a window: a Blender file of them, and renderings beside the photographs."""

import errno
import hashlib
import json
import math
import os
import re
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import bpy
import numpy as np
from mathutils import Euler, Vector

from ..core import sidebyside
from ..core.capture import Capture
from ..core.errors import StrandscopeError
from ..core.files import atomic
from ..core.progress import Progress, silent
from ..core.raw import read_planes
from ..core.strands import Strands, load_strands
from . import hair as hair_module
from . import material, rig_scene

SWEEP_F_NUMBER = 2.8  # at which sweeps are taken, with the cone of rays that the capture tells (sec. 3)
FRAMES_VERSION = 2  # of what a frame shows; a change renders existing frames again
PROGRESS_STAGE = "rendering"
EMPTY_BLEND_BYTES = 500_000  # of a Blender file without hair, nearly
EXR_HEAD_BYTES = 65_536  # of a frame, at most, beside its pixels


@dataclass(frozen=True)
class Shot:
    """A photograph to compare with: its file, where the turntable and the plane of focus were, and the cone of its rays."""

    file: str
    angle_deg: float
    focus_mm: float
    cone_deg: float
    name: str


def shots(capture: Capture, count: int) -> list[Shot]:
    """``count`` photographs (or all, if fewer) at angles as even as can be: of the capture's turntable sequence, or,
    where it has none, of each sweep the one with its plane of focus nearest to the axis."""
    table, optics = capture.turntable, capture.optics
    if table:
        cone_deg = 2 * math.degrees(math.atan(math.tan(math.radians(optics.aperture_cone_deg / 2)) * SWEEP_F_NUMBER / table.f_number))
        found = [
            Shot(file, angle, table.focus_mm, cone_deg, f"f/{table.f_number:g}") for file, angle in zip(table.files, table.angles_deg, strict=True)
        ]
    else:
        found = []
        for sweep in capture.sweeps:
            i = int(np.argmin(np.abs(sweep.positions_mm)))
            focus = sweep.positions_mm[i]
            found.append(Shot(sweep.files[i], sweep.angle_deg, focus, optics.aperture_cone_deg, f"a sweep's photograph, d = {focus:g} mm"))
    count = min(count, len(found))
    return [found[i * len(found) // count] for i in range(count)]


def render_turntable(
    capture: Capture,
    strands: Strands,
    out: Path,
    angles: int = 4,
    size: int = 360,
    samples: int = 16,
    progress: Progress = silent,
    part: tuple[int, int] | None = None,
) -> Path:
    """Render strands as the photographs of a capture show them, and set both side by side. Returns the picture's path.

    out: the picture to write (.png; the frames go to a folder ``NAME_frames`` beside it), or a folder for both, where it is
    ``turntable.png``. Frames ``render_000.png`` and their linear ``.exr`` that are there already, of the same strands and
    settings, are kept. size: pixels along the longer side. part: (i, n) renders the i-th (from 1) of n parts of the frames, and sets
    nothing side by side; returns the folder. Others may do other parts at once, when the first has begun its rendering. Raises
    CaptureError for a photograph that cannot be read and StrandscopeError for what cannot be written.
    """
    out = Path(out)
    picture, folder = (out, out.with_name(f"{out.stem}_frames")) if out.suffix.lower() == ".png" else (out / "turntable.png", out)
    chosen, view = shots(capture, angles), rig_scene.view_of(capture)
    scale = size / max(view.width_px, view.height_px)
    width, height = max(round(view.width_px * scale), 4), max(round(view.height_px * scale), 4)
    photographs = [sidebyside.resized(capture.planes(shot.file, "RGB"), width, height) for shot in chosen]
    _claim(folder, _identity(strands, view, chosen, width, height, samples))
    melanin = material.melanin_of(sidebyside.hair_brightness(photographs))
    frames = [folder / f"render_{i:03d}.exr" for i in range(len(chosen))]
    wanted = range(len(chosen)) if part is None else range(part[0] - 1, len(chosen), part[1])
    _render(strands, view, chosen, frames, wanted, (width, height), samples, melanin, progress)
    if part is not None:
        return folder
    renderings = [read_planes(frame, "RGBA") for frame in frames]
    exposure = sidebyside.match(photographs, renderings)
    pairs = [(exposure.develop(p), exposure.develop(exposure.expose(r))) for p, r in zip(photographs, renderings, strict=True)]
    for frame, (_, rendering) in zip(frames, pairs, strict=True):
        sidebyside.write_png(rendering, frame.with_suffix(".png"))
    captions = [(f"photograph at {shot.angle_deg:g}°, {shot.name}", f"{len(strands)} strands, rendered") for shot in chosen]
    sidebyside.write_pairs(pairs, captions, picture)
    return picture


def blend(strands_path: Path, out_blend: Path, capture: Capture | None = None) -> Path:
    """Make a Blender file of a strands file: hair, material and a scene like the rig, and nothing else. Atomic.

    capture: where the view comes from; without one, a view around all strands. Replaces what is open, so it is for
    Blender in the background only. Raises StrandsError for a bad strands file, StrandscopeError for a bad output.
    """
    strands, out_blend = load_strands(strands_path), Path(out_blend)
    if out_blend.suffix.lower() != ".blend":
        raise StrandscopeError(f"{out_blend}: the name of a Blender file must end in .blend")
    if not bpy.app.background:
        raise StrandscopeError(f"{out_blend}: a new file would replace the one that is open; run `blender --command strandscope blend`")
    view = rig_scene.view_of(capture) if capture else rig_scene.view_around(strands)
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene = bpy.context.scene
    scene.name = "Strandscope"
    hair = hair_module.add_hair(strands, _name(strands))
    hair.data.materials.append(material.hair_material())
    rig = rig_scene.build(scene, hair, view)
    rig_scene.animate(scene, rig)
    scene.render.hair_type = "STRIP"
    rig.board.hide_set(True)  # in the viewport; it would cover the hair from behind
    bpy.context.view_layer.objects.active = hair
    _look_at(strands)
    with atomic(out_blend) as part:
        try:
            with _without_messages():  # not compressed: of a compressed file Blender does not notice when the disk is full
                bpy.ops.wm.save_as_mainfile(filepath=str(part), compress=False, copy=True)
        except RuntimeError as error:
            if shutil.disk_usage(part.parent).free < EMPTY_BLEND_BYTES + strands.points_mm.nbytes:  # Blender does not say it
                raise OSError(errno.ENOSPC, "no room for a Blender file") from error
            raise StrandscopeError(f"{out_blend}: Blender could not save it ({' '.join(str(error).split())})") from error
    return out_blend


@contextmanager
def _without_messages() -> Iterator[None]:
    """Blender prints on stdout what it did; stdout is ours."""
    sys.stdout.flush()
    kept, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)


def _name(strands: Strands) -> str:
    return str(strands.provenance.get("capture") or "Hair")[:60]


def _look_at(strands: Strands) -> None:
    """Every 3D viewport of the file looks at the hair from the front, slightly above, in material colours; the first with its sidebar open."""
    larger = rig_scene.UNITS_PER_MM / hair_module.METRES_PER_MM
    low, high = (larger * hair_module.to_blender(corner(strands.points_mm, axis=0)) for corner in (np.min, np.max))
    centre, size = Vector(((low + high) / 2).tolist()), float(np.linalg.norm(high - low))
    for screen in bpy.data.screens:
        for area in screen.areas:
            if area.type != "VIEW_3D":
                continue
            space = area.spaces.active
            space.clip_start, space.clip_end, space.lens = size / 100, size * 100, 50
            space.shading.type, space.shading.color_type = "SOLID", "MATERIAL"
            if screen == bpy.context.window_manager.windows[0].screen:  # elsewhere Blender leaks memory, and says so
                space.show_region_ui = True
            region = space.region_3d
            region.view_perspective = "PERSP"
            region.view_location, region.view_distance = centre, 1.6 * size
            region.view_rotation = Euler((math.radians(80), 0, math.radians(20))).to_quaternion()


def _identity(strands: Strands, view: rig_scene.View, chosen: list[Shot], width: int, height: int, samples: int) -> dict:
    """What the frames depend on: frames of another identity are not kept."""
    content = hashlib.sha256()
    for values in (strands.points_mm, strands.offsets, strands.radius_mm):
        content.update(np.ascontiguousarray(values).tobytes())
    settings = {"version": FRAMES_VERSION, "width": width, "height": height, "samples": samples, "view": asdict(view)}
    return settings | {"strands": content.hexdigest(), "shots": [asdict(shot) for shot in chosen]}


def _claim(folder: Path, identity: dict) -> None:
    """Make the folder one for frames of this identity: frames of another are removed."""
    stamp, text = folder / "frames.json", json.dumps(identity, indent=1, sort_keys=True)
    if stamp.is_file() and stamp.read_text(encoding="utf-8") == text:
        return
    for old in folder.glob("render_*.exr"):
        old.unlink()
    with atomic(stamp) as part:
        part.write_text(text, encoding="utf-8")


def _render(strands, view, chosen, frames, wanted: range, resolution, samples, melanin, progress: Progress) -> None:
    """Render those of the ``wanted`` frames that are missing, in a scene of its own that is gone afterwards."""
    missing = [i for i in wanted if not frames[i].is_file()]
    progress(PROGRESS_STAGE, len(wanted) - len(missing), len(wanted))
    if not missing:
        return
    with scene_for_now("Strandscope turntable") as scene:
        hair = hair_module.add_hair(strands, "Hair", scene.collection)
        hair.data.materials.append(material.hair_material(melanin))
        rig = rig_scene.build(scene, hair, view, cone_deg=chosen[0].cone_deg)
        rig.board.hide_render = True
        _prepare(scene, resolution, samples)
        for i in missing:
            rig.turn(chosen[i].angle_deg)
            rig.focus(chosen[i].focus_mm)
            scene.cycles.seed = i
            render_frame(scene, frames[i], wanted.index(i), len(wanted), progress)


@contextmanager
def scene_for_now(name: str) -> Iterator[bpy.types.Scene]:
    """A new scene; it and all that is made meanwhile is gone afterwards."""
    before = {kind: set(getattr(bpy.data, kind)) for kind in _KINDS}
    try:
        yield bpy.data.scenes.new(name)
    finally:
        for kind in _KINDS:
            blocks = getattr(bpy.data, kind)
            for block in set(blocks) - before[kind]:
                blocks.remove(block)


_KINDS = ("scenes", "objects", "hair_curves", "cameras", "lights", "meshes", "materials", "worlds", "collections", "node_groups")


def _prepare(scene: bpy.types.Scene, resolution: tuple[int, int], samples: int) -> None:
    scene.render.resolution_x, scene.render.resolution_y = resolution
    scene.render.film_transparent = True
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_mode, scene.render.image_settings.color_depth = "RGBA", "32"
    scene.cycles.samples, scene.cycles.use_adaptive_sampling, scene.cycles.use_denoising = samples, False, True


def render_frame(scene: bpy.types.Scene, out: Path, index: int, count: int, progress: Progress) -> None:
    """Render one frame to ``out``, atomically. A progress callback that raises ends the work after the frame."""
    stopped: list[BaseException] = []

    def watch(text, *_):
        match = re.search(r"Sample (\d+)/(\d+)", str(text))
        if match and not stopped:
            try:
                progress(PROGRESS_STAGE, index + int(match[1]) / int(match[2]) * 0.99, count)
            except BaseException as error:  # Blender would print what a handler raises and go on
                stopped.append(error)

    bpy.app.handlers.render_stats.append(watch)
    try:
        with atomic(out) as part:
            part.write_bytes(bytes(16 * scene.render.resolution_x * scene.render.resolution_y + EXR_HEAD_BYTES))  # Blender notices no full disk
            bpy.ops.render.render(scene=scene.name)
            bpy.data.images["Render Result"].save_render(str(part), scene=scene)
    except RuntimeError as error:
        raise StrandscopeError(f"{out}: Blender could not render this picture ({' '.join(str(error).split())})") from error
    finally:
        bpy.app.handlers.render_stats.remove(watch)
    if stopped:
        raise stopped[0]
    progress(PROGRESS_STAGE, index + 1, count)
