"""Strandscope in Blender."""
