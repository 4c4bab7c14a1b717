"""Install a built extension in Blender's Python module, enable it, use it, disable it, enable it again: check_extension.py ZIP

For a process of its own, with BLENDER_USER_RESOURCES set to an empty folder. Run by build_extension.py and by the tests.
"""

import sys

import bpy

KEY = "bl_ext.user_default.strandscope"


def main(package: str) -> None:
    bpy.ops.extensions.package_install_files(filepath=package, repo="user_default", enable_on_install=True)
    for enabled in (True, False, True, False):
        assert (KEY in bpy.context.preferences.addons) == enabled, f"enabled is not {enabled}"
        assert hasattr(bpy.types.Scene, "strandscope") == enabled, f"the scene's settings do not follow ({enabled})"
        assert hasattr(bpy.types, "STRANDSCOPE_PT_reconstruct") == enabled, f"the panel does not follow ({enabled})"
        if enabled:
            assert bpy.context.preferences.addons[KEY].preferences.memory_gb > 0, "the preferences are not there"
            assert sys.modules[KEY].addon.jobs.child_environment()["NUMBA_CACHE_DIR"], "no place for compiled kernels"
            bpy.ops.preferences.addon_disable(module=KEY)
        else:
            bpy.ops.preferences.addon_enable(module=KEY)
    bpy.ops.preferences.addon_disable(module=KEY)


if __name__ == "__main__":
    main(sys.argv[1])
