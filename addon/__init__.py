"""Strandscope in Blender. Importing it imports no bpy: ``register`` does."""

_commands = []  # what `blender --command strandscope` runs, between register and unregister


def _modules():
    from . import operators, panels, panels_rig, pictures, props

    return props, pictures, operators, panels, panels_rig


def register():
    import bpy

    from .cli import run_all

    for module in _modules():
        module.register()
    _commands.append(bpy.utils.register_cli_command("strandscope", run_all))


def unregister():
    import bpy

    while _commands:
        bpy.utils.unregister_cli_command(_commands.pop())
    for module in reversed(_modules()):
        module.unregister()
