"""What the panel's buttons do. Each operator gathers, calls one function, hands over."""

import bpy

from . import bring_in, rig, work

_CLASSES = (*bring_in.CLASSES, *rig.CLASSES, *work.CLASSES)


def register():
    for cls in _CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.TOPBAR_MT_file_import.append(bring_in.menu)
    rig.register()


def unregister():
    rig.unregister()
    bpy.types.TOPBAR_MT_file_import.remove(bring_in.menu)
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
