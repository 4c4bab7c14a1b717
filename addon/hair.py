"""Strands <-> hair in Blender: one ``Curves`` object, every value in bulk.

The transform between the object frame (mm, y up) and Blender (m, z up) stands here and nowhere else: 1 mm is 0.001 m and
(x, y, z) becomes (x, -z, y). Positions and radii are float32 on both sides, so a round trip gives back every number to
the last bit but one; identities, kinds and confidences are kept exactly.
"""

import json

import bpy
import numpy as np

from ..core.errors import StrandscopeError
from ..core.strands import CAPTURED, Strands, statistics

METRES_PER_MM = 0.001
PROVENANCE, STATISTICS = "strandscope_provenance", "strandscope_statistics"  # custom properties of the curves, JSON
UNKNOWN = -1.0  # an error that is not known: shaders cannot work with NaN
CYCLES_RADIUS = 3e-4  # in units of the scene
SHOW = "Strandscope Show"  # modifier and node group that hide captured hair or infill

# name -> (type, domain, property, dtype) of what an attribute holds
_ATTRIBUTES = {
    "position": ("FLOAT_VECTOR", "POINT", "vector", np.float32),
    "radius": ("FLOAT", "POINT", "value", np.float32),
    "confidence": ("FLOAT", "POINT", "value", np.float32),
    "error": ("FLOAT", "POINT", "value", np.float32),
    "strand_id": ("INT", "CURVE", "value", np.int32),
    "kind": ("INT8", "CURVE", "value", np.int8),
    "stop_start": ("INT8", "CURVE", "value", np.int8),
    "stop_end": ("INT8", "CURVE", "value", np.int8),
}
_STOPS = ("stop_start", "stop_end")  # why either end stopped growing, where that is known


def to_blender(points_mm: np.ndarray) -> np.ndarray:
    """Points (..., 3) mm of the object frame -> (..., 3) float32, m, z up."""
    x, y, z = np.moveaxis(np.asarray(points_mm, np.float64), -1, 0)
    return (METRES_PER_MM * np.stack([x, -z, y], axis=-1)).astype(np.float32)


def from_blender(points: np.ndarray) -> np.ndarray:
    """Points (..., 3) m, z up -> (..., 3) float32, mm of the object frame: the inverse of ``to_blender``."""
    x, y, z = np.moveaxis(np.asarray(points, np.float64), -1, 0)
    return (np.stack([x, z, -y], axis=-1) / METRES_PER_MM).astype(np.float32)


def add_hair(strands: Strands, name: str = "Hair", collection: bpy.types.Collection | None = None) -> bpy.types.Object:
    """A new hair object with all strands, linked to ``collection`` (the scene's if None).

    Poly curves with the point attributes radius (m), confidence and, if it is known, error (the expected one, m; UNKNOWN for
    infill), and the curve attributes strand_id and kind (0 captured, 1 infill); where the strands came from is a custom
    property. A modifier with two switches shows each kind or not.
    Raises StrandscopeError if there are no strands.
    """
    if len(strands) == 0:
        raise StrandscopeError(f"{name}: there are no strands to make hair of")
    curves = bpy.data.hair_curves.new(name)
    curves.add_curves(np.diff(strands.offsets).tolist())
    curves.set_types(type="POLY")
    values = {
        "position": to_blender(strands.points_mm),
        "radius": METRES_PER_MM * strands.radius_mm.astype(np.float64),
        "confidence": strands.confidence,
        "strand_id": np.arange(len(strands)),
        "kind": strands.kind,
    }
    if strands.error_mm is not None:
        values["error"] = np.where(np.isnan(strands.error_mm), UNKNOWN, METRES_PER_MM * strands.error_mm.astype(np.float64))
    if strands.stops is not None:
        values |= dict(zip(_STOPS, strands.stops.T, strict=True))
    for attribute, each in values.items():
        _write(curves, attribute, each)
    curves[PROVENANCE] = json.dumps(strands.provenance, sort_keys=True)
    curves[STATISTICS] = json.dumps(statistics(strands))
    hair = bpy.data.objects.new(name, curves)
    (collection or bpy.context.scene.collection).objects.link(hair)
    _add_switches(hair)
    return hair


def strands_of(hair: bpy.types.Object) -> Strands:
    """The strands of a hair object, as ``add_hair`` got them. Attributes that are missing take a plain value.

    Reads the curves themselves, before modifiers. Raises StrandscopeError for an object that is no hair.
    """
    if hair is None or hair.type != "CURVES":
        raise StrandscopeError(f"{hair.name if hair else 'nothing'}: is no hair; expected a hair curves object")
    curves = hair.data
    offsets = np.empty(len(curves.curves) + 1, np.int32)
    curves.curve_offset_data.foreach_get("value", offsets)
    return Strands(
        points_mm=from_blender(_read(curves, "position").reshape(-1, 3)),
        offsets=offsets.astype(np.int64),
        radius_mm=(_read(curves, "radius", 4e-5).astype(np.float64) / METRES_PER_MM).astype(np.float32),
        kind=_read(curves, "kind", CAPTURED).astype(np.uint8),
        confidence=_read(curves, "confidence", 1),
        error_mm=_errors(curves) if "error" in curves.attributes else None,
        stops=np.stack([_read(curves, name) for name in _STOPS], axis=1).astype(np.uint8) if _STOPS[0] in curves.attributes else None,
        provenance=json.loads(curves.get(PROVENANCE, "{}")),
    )


def _errors(curves: bpy.types.Curves) -> np.ndarray:
    """Expected errors (N,) float32, mm, NaN where they are not known."""
    error = _read(curves, "error").astype(np.float64)
    return np.where(error < 0, np.nan, error / METRES_PER_MM).astype(np.float32)


def is_hair(hair: bpy.types.Object | None) -> bool:
    """Whether an object is hair that Strandscope made."""
    return hair is not None and hair.type == "CURVES" and PROVENANCE in hair.data


def describe(hair: bpy.types.Object) -> str:
    """Lines that tell what hair of ``add_hair`` was made of."""
    numbers = json.loads(hair.data.get(STATISTICS, "{}"))
    if not numbers:
        return hair.name
    length = numbers["length_mm"]
    lines = [
        f"{numbers['curves']:,} captured, {numbers['infill_curves']:,} infill",
        f"Length {length['mean']:.1f} mm, at most {length['longest']:.1f} mm",
        f"Thickness {2 * numbers['mean_radius_mm']:.3f} mm",
        f"{numbers['mean_curves_crossing_a_horizontal_plane']:.0f} in a cross-section",
    ]
    return "\n".join(lines)


def is_small_for_cycles(hair: bpy.types.Object) -> bool:
    """Whether Cycles would shade this hair wrongly, since it is so thin in units of the scene (see ``rig_scene``)."""
    numbers = json.loads(hair.data.get(STATISTICS, "{}"))
    scale = hair.matrix_world.to_scale()[0]
    return 0 < numbers.get("mean_radius_mm", 0) * METRES_PER_MM * scale < CYCLES_RADIUS


def switches(hair: bpy.types.Object):
    """The inputs (captured, infill) of the modifier that shows each kind or not, or None. Each has a boolean ``value``."""
    modifier = hair.modifiers.get(SHOW)
    if modifier is None or modifier.node_group is None:
        return None
    sockets = {item.name: item.identifier for item in modifier.node_group.interface.items_tree if item.item_type == "SOCKET"}
    inputs = modifier.properties.inputs
    return tuple(getattr(inputs, sockets[name]) for name in ("Captured", "Infill"))


def _write(curves, name: str, values: np.ndarray) -> None:
    """Values, one an element, to an attribute; made with the type and domain of the table above."""
    kind, domain, prop, dtype = _ATTRIBUTES[name]
    attribute = curves.attributes.get(name) or curves.attributes.new(name, kind, domain)
    attribute.data.foreach_set(prop, np.ascontiguousarray(values, dtype).ravel())


def _read(curves, name: str, missing: float = 0) -> np.ndarray:
    """The flat values of an attribute, all ``missing`` where there is none."""
    _, domain, prop, dtype = _ATTRIBUTES[name]
    attribute = curves.attributes.get(name)
    count = (len(curves.points) if domain == "POINT" else len(curves.curves)) * (3 if prop == "vector" else 1)
    values = np.full(count, missing, dtype)
    if attribute is not None:
        attribute.data.foreach_get(prop, values)
    return values


def _add_switches(hair: bpy.types.Object) -> None:
    modifier = hair.modifiers.new(SHOW, "NODES")
    modifier.node_group = bpy.data.node_groups.get(SHOW) or _switch_group()
    modifier.show_group_selector = False


def _switch_group() -> bpy.types.NodeTree:
    """Geometry nodes that delete the curves of a kind (attribute ``kind``) whose switch is off."""
    group = bpy.data.node_groups.new(SHOW, "GeometryNodeTree")
    group.is_modifier = True
    group.interface.new_socket("Hair", in_out="INPUT", socket_type="NodeSocketGeometry")
    for name, text in (("Captured", "Show the hairs that were photographed"), ("Infill", "Show the hairs that were added inside")):
        socket = group.interface.new_socket(name, description=text, in_out="INPUT", socket_type="NodeSocketBool")
        socket.default_value = True
    group.interface.new_socket("Hair", in_out="OUTPUT", socket_type="NodeSocketGeometry")

    def node(kind, column, row, **settings):
        new = group.nodes.new(kind)
        new.location = (200 * column, -180 * row)
        for key, value in settings.items():
            setattr(new, key, value)
        return new

    entry, leave = node("NodeGroupInput", 0, 0), node("NodeGroupOutput", 4, 0)
    kind = node("GeometryNodeInputNamedAttribute", 0, 1, data_type="INT")
    kind.inputs["Name"].default_value = "kind"
    shown = node("GeometryNodeSwitch", 1, 0, input_type="BOOLEAN", label="Shown: infill or captured")
    hidden = node("FunctionNodeBooleanMath", 2, 0, operation="NOT")
    delete = node("GeometryNodeDeleteGeometry", 3, 0, domain="CURVE")
    for source, target in (
        (kind.outputs["Attribute"], shown.inputs["Switch"]),
        (entry.outputs["Captured"], shown.inputs["False"]),
        (entry.outputs["Infill"], shown.inputs["True"]),
        (shown.outputs[0], hidden.inputs[0]),
        (hidden.outputs[0], delete.inputs["Selection"]),
        (entry.outputs["Hair"], delete.inputs["Geometry"]),
        (delete.outputs["Geometry"], leave.inputs["Hair"]),
    ):
        group.links.new(source, target)
    return group
