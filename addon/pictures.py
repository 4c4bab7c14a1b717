"""Pictures from files, as the panel shows them: read again when they have changed."""

import contextlib
from dataclasses import dataclass, field
from pathlib import Path

import bpy
import bpy.utils.previews


@dataclass
class _Shown:
    """The pictures that Blender holds for us, and of when they are."""

    previews: object = None
    times: dict = field(default_factory=dict)  # path -> time of its file


_shown = _Shown()


def icon(path: Path | None) -> int:
    """The icon of a picture, 0 where there is none."""
    if path is None or _shown.previews is None:
        return 0
    name = str(path)
    try:
        time = path.stat().st_mtime_ns
    except OSError:
        return 0
    if _shown.times.get(name) != time:
        if name in _shown.previews:
            del _shown.previews[name]
        tuple(_shown.previews.load(name, name, "IMAGE", force_reload=True).image_size)  # asked for, it is read at once
        _shown.times[name] = time
    return _shown.previews[name].icon_id


def refresh(path: Path | None) -> None:
    """Read a picture again that an image editor shows."""
    image = path and bpy.data.images.get(path.name)
    if image and bpy.path.abspath(image.filepath) == str(path) and image.users:
        with contextlib.suppress(RuntimeError):
            image.reload()


def show(context, path: Path) -> None:
    """Show a picture in a window of its own. Raises RuntimeError where it cannot be read."""
    image = bpy.data.images.load(str(path), check_existing=True)
    image.reload()
    if bpy.app.background:
        return
    bpy.ops.wm.window_new()
    window = context.window_manager.windows[-1]
    area = window.screen.areas[0]
    area.type = "IMAGE_EDITOR"
    area.spaces.active.image = image
    region = next(region for region in area.regions if region.type == "WINDOW")
    with context.temp_override(window=window, area=area, region=region):
        bpy.ops.image.view_all(fit_view=True)


def register():
    _shown.previews = bpy.utils.previews.new()


def unregister():
    bpy.utils.previews.remove(_shown.previews)
    _shown.previews = None
    _shown.times.clear()
