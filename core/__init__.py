"""The numbers: from photographs to strands. Nothing here knows Blender.

Read the modules in the order in which the data flows:
raw -> capture -> ridges -> features -> grow -> hull -> infill -> strands -> compare; ``pipeline`` calls them in turn.
"""
