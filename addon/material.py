"""Hair as Cycles shades it: the Principled Hair BSDF, coloured by melanin. And what fills its volume, so that hair is seen within."""

import bpy
import numpy as np

NAME = "Strandscope Hair"
VOLUME, SURFACE = "Strandscope Volume", "Strandscope Surface"
MODELS = ("CHIANG", "HUANG")
MELANIN = {"black": 0.95, "dark brown": 0.75, "medium brown": 0.6, "light brown": 0.4, "blond": 0.2, "white": 0.03}
DEFAULT_COLOR = "medium brown"
ROUGHNESS, RADIAL_ROUGHNESS, IOR = 0.3, 0.35, 1.55
TILT_RADIANS = 0.035  # of the cuticle's scales, 2 degrees
RANDOM_COLOR, RANDOM_ROUGHNESS = 0.25, 0.1  # from strand to strand
_SOLID = {0.0: (0.85, 0.78, 0.65), 0.3: (0.62, 0.44, 0.26), 0.6: (0.36, 0.21, 0.12), 1.0: (0.04, 0.03, 0.025)}  # melanin -> colour


def hair_material(melanin: float = MELANIN[DEFAULT_COLOR], redness: float = 0.1, model: str = "CHIANG", name: str = NAME) -> bpy.types.Material:
    """A new Principled Hair BSDF material. melanin: 0 white to 1 black; redness: 0 brown to 1 red; model: of ``MODELS``."""
    material = bpy.data.materials.new(name)
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    output, hair, info = (nodes.new(f"ShaderNode{kind}") for kind in ("OutputMaterial", "BsdfHairPrincipled", "HairInfo"))
    output.location, info.location = (320, 0), (-240, -120)
    hair.parametrization = "MELANIN"
    for socket, value in {
        "Melanin": melanin,
        "Melanin Redness": redness,
        "Roughness": ROUGHNESS,
        "Radial Roughness": RADIAL_ROUGHNESS,
        "IOR": IOR,
        "Offset": TILT_RADIANS,
        "Random Color": RANDOM_COLOR,
        "Random Roughness": RANDOM_ROUGHNESS,
    }.items():
        hair.inputs[socket].default_value = value
    hair.model = model  # only now: a socket that a model does not use cannot be found by its name
    links.new(info.outputs["Random"], hair.inputs["Random"])
    links.new(hair.outputs["BSDF"], output.inputs["Surface"])
    material.diffuse_color = (*solid_color(melanin), 1.0)
    material.roughness = 0.6
    return material


VOLUME_COLOR, SURFACE_COLOR = (0.9, 0.62, 0.35), (0.25, 0.6, 0.9)
VOLUME_DENSITY = 0.3  # a mm, in which the volume's data are: light passes 3 mm of what is all hair
SURFACE_ALPHA = 0.25


def volume_material() -> bpy.types.Material:
    """The material of volumes of hair, made where the file has none: a haze as dense as the grid "density" tells."""
    if (found := bpy.data.materials.get(VOLUME)) is not None:
        return found
    made, haze = _with_one(VOLUME, "VolumePrincipled", "Volume", "Volume")
    haze.inputs["Color"].default_value = (*VOLUME_COLOR, 1.0)
    haze.inputs["Density"].default_value = VOLUME_DENSITY
    haze.inputs["Anisotropy"].default_value = 0.2
    made.diffuse_color = (*VOLUME_COLOR, 1.0)
    return made


def surface_material() -> bpy.types.Material:
    """The material of surfaces of hair, made where the file has none: translucent in every mode of the viewport."""
    if (found := bpy.data.materials.get(SURFACE)) is not None:
        return found
    made, glaze = _with_one(SURFACE, "BsdfPrincipled", "BSDF", "Surface")
    glaze.inputs["Base Color"].default_value = (*SURFACE_COLOR, 1.0)
    glaze.inputs["Roughness"].default_value = 0.5
    glaze.inputs["Alpha"].default_value = SURFACE_ALPHA
    made.surface_render_method = "BLENDED"
    made.use_transparency_overlap = False  # else the far side and the near one add up, and hide the hair
    made.diffuse_color = (*SURFACE_COLOR, SURFACE_ALPHA)
    return made


def _with_one(name: str, kind: str, source: str, target: str) -> tuple[bpy.types.Material, bpy.types.Node]:
    """A new material of one shader node."""
    made = bpy.data.materials.new(name)
    nodes = made.node_tree.nodes
    nodes.clear()
    shader, output = nodes.new(f"ShaderNode{kind}"), nodes.new("ShaderNodeOutputMaterial")
    output.location = (320, 0)
    made.node_tree.links.new(shader.outputs[source], output.inputs[target])
    return made, shader


def solid_color(melanin: float) -> tuple[float, float, float]:
    """Linear RGB of hair in the viewport's solid mode, which knows no melanin."""
    return tuple(float(np.interp(melanin, list(_SOLID), channel)) for channel in zip(*_SOLID.values(), strict=True))


def melanin_of(brightness: float) -> float:
    """Melanin of hair that is so bright in a photograph: brightness of its median pixel, 0 … 1 of white, linear.

    A guess to start from: how much light there was is not known. Dark hair is below 0.03, blond hair above 0.3.
    """
    return float(np.interp(brightness, [0.02, 0.06, 0.15, 0.30, 0.60], [0.95, 0.75, 0.55, 0.30, 0.10]))
