"""Strands <-> Blender: the transform by hand, the round trip, what is shown."""

import dataclasses

import bpy
import numpy as np
import pytest

from strandscope.addon import hair, material
from strandscope.core.errors import StrandscopeError
from strandscope.core.strands import INFILL


def test_axes_and_unit():
    up, towards_camera = hair.to_blender([[0, 1000, 0], [0, 0, 1000]])
    np.testing.assert_array_equal(up, [0, 0, 1])
    np.testing.assert_array_equal(towards_camera, [0, -1, 0])
    assert hair.to_blender(np.zeros((2, 3))).dtype == np.float32


def test_transform_keeps_hands():
    """A right-handed frame stays one: the determinant is positive."""
    assert np.linalg.det(hair.to_blender(1000 * np.eye(3))) == pytest.approx(1)


def test_round_trip(strands):
    back = hair.strands_of(hair.add_hair(strands))
    for name in ("offsets", "kind", "confidence", "stops"):
        np.testing.assert_array_equal(getattr(back, name), getattr(strands, name))
        assert getattr(back, name).dtype == getattr(strands, name).dtype
    np.testing.assert_array_max_ulp(back.points_mm, strands.points_mm, maxulp=1)
    np.testing.assert_array_max_ulp(back.radius_mm, strands.radius_mm, maxulp=1)
    np.testing.assert_allclose(back.error_mm, strands.error_mm, rtol=1e-6)
    assert back.provenance == strands.provenance


def test_round_trip_of_strands_that_do_not_say_why_they_stopped(strands):
    assert hair.strands_of(hair.add_hair(dataclasses.replace(strands, stops=None))).stops is None


def test_errors_that_are_not_known_are_below_zero_for_shaders(strands):
    curves = hair.add_hair(strands).data
    error = np.array([d.value for d in curves.attributes["error"].data])
    np.testing.assert_array_equal(error < 0, np.isnan(strands.error_mm))
    assert hair.strands_of(hair.add_hair(dataclasses.replace(strands, error_mm=None))).error_mm is None


def test_attributes(strands):
    curves = hair.add_hair(strands).data
    found = {a.name: (a.data_type, a.domain) for a in curves.attributes}
    assert found["radius"] == found["confidence"] == ("FLOAT", "POINT")
    assert found["strand_id"] == ("INT", "CURVE")
    assert found["kind"] == ("INT8", "CURVE")
    assert curves.attributes["radius"].data[0].value == pytest.approx(strands.radius_mm[0] / 1000)
    assert [d.value for d in curves.attributes["strand_id"].data] == list(range(len(strands)))


@pytest.mark.parametrize(("captured", "infill"), [(True, True), (True, False), (False, True), (False, False)])
def test_switches_show_each_kind(strands, captured, infill):
    new = hair.add_hair(strands)
    for switch, value in zip(hair.switches(new), (captured, infill), strict=True):
        switch.value = value
    new.update_tag()
    shown = len(new.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.curves)
    assert shown == captured * (strands.kind != INFILL).sum() + infill * (strands.kind == INFILL).sum()
    np.testing.assert_array_equal(hair.strands_of(new).kind, strands.kind)  # hidden is not gone


def test_two_hairs_share_one_node_group(strands):
    hair.add_hair(strands), hair.add_hair(strands)
    assert len(bpy.data.node_groups) == 1


def test_no_strands_is_an_error(strands):
    with pytest.raises(StrandscopeError, match="no strands"):
        hair.add_hair(strands.select(np.zeros(len(strands), bool)))


def test_other_objects_are_no_hair():
    empty = bpy.data.objects.new("Empty", None)
    assert not hair.is_hair(empty)
    with pytest.raises(StrandscopeError, match="is no hair"):
        hair.strands_of(empty)


@pytest.mark.parametrize("model", material.MODELS)
def test_material(model):
    made = material.hair_material(melanin=0.4, redness=0.2, model=model)
    shader = next(node for node in made.node_tree.nodes if node.type == "BSDF_HAIR_PRINCIPLED")
    assert (shader.model, shader.parametrization) == (model, "MELANIN")
    assert shader.inputs["Melanin"].default_value == pytest.approx(0.4)
    assert shader.inputs["Random Color"].default_value > 0
    assert shader.inputs["Random"].links[0].from_socket.name == "Random"


def test_brighter_hair_has_less_melanin():
    values = [material.melanin_of(brightness) for brightness in (0.0, 0.05, 0.1, 0.2, 0.4, 1.0)]
    assert values == sorted(values, reverse=True)
    assert 0 <= values[-1] < values[0] <= 1
