"""Pinned UVs are held; hidden faces and islands that are not selected stay."""

import bpy
import numpy as np
import pytest
import scenes


def pin(thing, loops):
    """Pin the UVs of loops, and no others."""
    # Blender's name of the attribute; Blender 4.5 has no pin_ensure.
    name = f".pn.{thing.data.uv_layers.active.name}"
    layer = thing.data.attributes.get(name) or thing.data.attributes.new(name, "BOOLEAN", "CORNER")
    pinned = np.zeros(len(thing.data.loops), dtype=bool)
    pinned[loops] = True
    layer.data.foreach_set("value", pinned)


def pin_vertices(thing, positions):
    """Move vertices to positions in the plane and pin them there; return their loops."""
    at = scenes.vertices_of_loops(thing)
    for vertex, position in positions.items():
        scenes.move_vertex(thing, vertex, position)
    loops = np.flatnonzero(np.isin(at, list(positions)))
    pin(thing, loops)
    return loops


def select_faces(thing, faces):
    """Go to edit mode with these faces selected."""
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="DESELECT")
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.context.tool_settings.mesh_select_mode = (False, False, True)
    for face in faces:
        thing.data.polygons[face].select = True
    bpy.ops.object.mode_set(mode="EDIT")


PINS = {
    "one": {24: [0.7, 0.2]},
    "two": {0: [0.1, 0.1], 6: [0.3, 0.15]},
    "three": {0: [0.1, 0.1], 6: [0.4, 0.1], 42: [0.15, 0.3]},
    "interior": {16: [0.4, 0.4], 32: [0.5, 0.52]},
}


@pytest.mark.parametrize("pins", PINS.values(), ids=PINS)
def test_flatten_holds_pins(pins):
    thing = scenes.add_quads()
    loops = pin_vertices(thing, pins)
    before = scenes.places(thing)
    assert bpy.ops.uv.qhm_flatten() == {"FINISHED"}
    uv = scenes.places(thing)
    assert np.array_equal(uv[loops], before[loops])
    assert not np.array_equal(uv, before)
    assert scenes.verdict(thing).bijective
    # The surface is nearly flat, and the pins fit it nearly up to scale.
    assert scenes.stretch(thing) < 5


def test_flatten_places_other_islands_beside_the_pinned_one():
    thing = scenes.two_squares([0, 0])
    loops = pin_vertices(thing, {0: [0.5, 0.5], 6: [0.6, 0.5]})
    before = scenes.places(thing)
    assert bpy.ops.uv.qhm_flatten() == {"FINISHED"}
    assert np.array_equal(scenes.places(thing)[loops], before[loops])
    found = scenes.verdict(thing)
    assert found.bijective
    assert len(found.islands) == 2
    assert not len(found.overlapping)
    sizes = [np.ptp(part, axis=0).max() for part in np.split(scenes.places(thing), 2)]
    assert sizes[0] == pytest.approx(sizes[1], rel=0.1)


def test_pins_that_no_map_keeps_are_refused():
    thing = scenes.add_quads()
    loops = pin_vertices(thing, {0: [0.5, 0.5], 6: [0.5, 0.5]})
    before = scenes.places(thing)
    with pytest.raises(RuntimeError, match="Flatten"):
        bpy.ops.uv.qhm_flatten()
    assert np.array_equal(scenes.places(thing), before)
    assert len(loops)


def test_a_vertex_pinned_at_two_positions_is_named():
    thing = scenes.add_quads()
    uv = scenes.places(thing)
    at = np.flatnonzero(scenes.vertices_of_loops(thing) == 24)
    uv[at[0]] += 0.01
    scenes.set_places(thing, uv)
    pin(thing, at)
    # The marked seam is elsewhere, so the map is joined at the vertex.
    thing.data.edges[0].use_seam = True
    with pytest.raises(RuntimeError, match="vertex 24 is pinned at two positions"):
        bpy.ops.uv.qhm_flatten()


def test_fit_holds_pins():
    thing = scenes.add_quads()
    pins = {24: [0.45, 0.55], 16: [0.3, 0.35]}
    loops = pin_vertices(thing, pins)
    before = scenes.places(thing)
    assert bpy.ops.uv.qhm_fit(to="DISK") == {"FINISHED"}
    assert np.array_equal(scenes.places(thing)[loops], before[loops])
    assert np.hypot(*(scenes.places(thing)[scenes.border(thing)] - 0.5).T) == pytest.approx(0.5, abs=1e-2)
    assert scenes.verdict(thing).bijective


def test_unwrap_keeps_islands_with_pins_and_places_others_around_them(said):
    thing = scenes.two_squares([0.0, 0.0])
    uv = 0.4 * scenes.places(thing)
    scenes.set_places(thing, uv)
    held = np.isin(scenes.vertices_of_loops(thing), np.arange(25))
    pin(thing, [0])
    assert bpy.ops.uv.qhm_unwrap(resolution=512) == {"FINISHED"}
    after = scenes.places(thing)
    assert np.array_equal(after[held], uv[held])
    assert not np.array_equal(after[~held], uv[~held])
    verdict = scenes.verdict(thing)
    assert verdict.bijective
    assert not len(verdict.overlapping)
    assert "islands with pinned UVs stay as they are" in said()
    pin(thing, np.arange(len(held)))
    with pytest.raises(RuntimeError, match="all islands have pinned UVs"):
        bpy.ops.uv.qhm_unwrap()


def test_repair_holds_pins():
    """The vertex beside the misplaced one is pinned, so that the repair cannot move it."""
    thing = scenes.add_quads()
    scenes.move_vertex(thing, 24, [0.9, 0.9])
    at = scenes.vertices_of_loops(thing)
    free = scenes.places(thing)
    pin(thing, np.flatnonzero(np.isin(at, [16, 24])))
    with_pins = scenes.places(thing)
    bpy.ops.uv.qhm_repair()
    assert np.array_equal(scenes.places(thing)[np.isin(at, [16, 24])], with_pins[np.isin(at, [16, 24])])
    pin(thing, [])
    scenes.set_places(thing, free)
    assert bpy.ops.uv.qhm_repair() == {"FINISHED"}
    assert not np.array_equal(scenes.places(thing)[at == 24], free[at == 24])
    assert scenes.verdict(thing).bijective


@pytest.mark.parametrize("free", [False, True])
def test_reduce_stretch_holds_pins(free):
    thing = scenes.add_quads()
    V, flat, _ = scenes.quads()
    inner = np.setdiff1d(np.arange(len(V)), scenes.vertices_of_loops(thing)[scenes.border(thing)])
    for vertex in inner.tolist():
        scenes.move_vertex(thing, vertex, flat[vertex] ** 1.2)
    at = scenes.vertices_of_loops(thing)
    loops = np.flatnonzero(np.isin(at, [16, 24]))
    pin(thing, loops)
    before, stretch = scenes.places(thing), scenes.stretch(thing)
    assert bpy.ops.uv.qhm_reduce_stretch(free=free) == {"FINISHED"}
    assert np.array_equal(scenes.places(thing)[loops], before[loops])
    assert scenes.stretch(thing) < stretch
    assert scenes.verdict(thing).injective


@pytest.mark.parametrize("act", ["flatten", "reduce_stretch", "repair"])
def test_hidden_faces_stay(act):
    thing = scenes.add_quads()
    if act == "repair":
        scenes.move_vertex(thing, 40, [0.6, 0.6])
    for k in range(12):
        thing.data.polygons[k].hide = True
    before = scenes.places(thing)
    bpy.ops.object.mode_set(mode="EDIT")
    assert getattr(bpy.ops.uv, f"qhm_{act}")() == {"FINISHED"}
    bpy.ops.object.mode_set(mode="OBJECT")
    changed = np.unique(np.flatnonzero((scenes.places(thing) != before).any(axis=1)) // 4)
    assert changed.size
    assert changed.min() >= 12
    # In object mode, Blender shows hidden faces.
    assert bpy.ops.uv.qhm_flatten() == {"FINISHED"}
    assert not np.array_equal(scenes.places(thing)[:48], before[:48])


def test_hidden_faces_are_not_checked(said):
    thing = scenes.add_quads()
    scenes.move_vertex(thing, 8, [0.9, 0.9])
    for k in range(12):
        thing.data.polygons[k].hide = True
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.uv.qhm_check()
    assert "0 faces selected" in said()
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.ops.uv.qhm_check()
    assert "0 faces selected" not in said()


def test_all_faces_hidden():
    thing = scenes.add_quads()
    for face in thing.data.polygons:
        face.hide = True
    bpy.ops.object.mode_set(mode="EDIT")
    for act in ("check", "flatten", "unwrap", "repair", "reduce_stretch", "fit"):
        with pytest.raises(RuntimeError, match="all faces are hidden"):
            getattr(bpy.ops.uv, f"qhm_{act}")()


@pytest.mark.parametrize("act", ["flatten", "fit", "reduce_stretch"])
def test_islands_that_are_not_selected_stay_and_are_told(act, said):
    thing = scenes.two_squares([0.625, 0])
    before = scenes.places(thing)
    select_faces(thing, [20])
    assert getattr(bpy.ops.uv, f"qhm_{act}")() == {"FINISHED"}
    bpy.ops.object.mode_set(mode="OBJECT")
    uv = scenes.places(thing)
    assert np.array_equal(uv[:64], before[:64])
    assert not np.array_equal(uv[64:], before[64:])
    assert "1 other island unchanged, of which 1 overlap" in said()


def test_flatten_in_edit_mode_takes_all_islands_where_asked():
    thing = scenes.two_squares([1.5, 0])
    before = scenes.places(thing)
    select_faces(thing, [20])
    assert bpy.ops.uv.qhm_flatten(whole=True) == {"FINISHED"}
    bpy.ops.object.mode_set(mode="OBJECT")
    assert not np.array_equal(scenes.places(thing)[:64], before[:64])
