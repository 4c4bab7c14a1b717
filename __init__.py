"""Strandscope: capture a lock of hair fiber by fiber, and bring it into Blender.

This folder is the Python package ``strandscope`` and the Blender extension at once.
Importing it costs nothing: Blender's side is loaded in ``register``, the numbers in ``strandscope.core``.
"""

__version__ = "0.1.0"


def register():
    from . import addon

    addon.register()


def unregister():
    from . import addon

    addon.unregister()
