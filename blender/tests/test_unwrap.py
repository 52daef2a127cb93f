"""The operator that unwraps any model: what it writes, what it accepts, and what it leaves alone."""

import bpy
import numpy as np
import pytest
import scenes


def seams(thing):
    return {tuple(sorted(edge.vertices)) for edge in thing.data.edges if edge.use_seam}


def layout(things):
    """The library's verdict on the UVs of several objects in one texture."""
    from quasiharmonic import atlas

    V, F, FT, uv = [], [], [], []
    n = m = 0
    for thing in things:
        corners, _ = scenes.triangles(thing)
        V.append(np.array([v.co for v in thing.data.vertices]))
        F.append(scenes.vertices_of_loops(thing)[corners] + n)
        FT.append(corners + m)
        uv.append(scenes.places(thing))
        n, m = n + len(V[-1]), m + len(uv[-1])
    return atlas.certify(atlas.SeamedMesh(*(np.concatenate(part) for part in (V, F, FT, uv))))


def assert_sound(*things):
    found = layout(things)
    assert found.bijective
    assert not len(found.overlapping)
    for thing in things:
        uv = scenes.places(thing)
        assert uv.min() >= 0
        assert uv.max() <= 1


def add_suzanne(levels=0):
    bpy.ops.mesh.primitive_monkey_add()
    thing = bpy.context.object
    if levels:
        thing.modifiers.new("finer", "SUBSURF").levels = levels
        bpy.ops.object.modifier_apply(modifier="finer")
    return thing


def add_prism(sides=9):
    """A closed prism with two n-gons, its seams unmarked."""
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    k, ahead = np.arange(sides), (np.arange(sides) + 1) % sides
    around = np.stack([k, ahead, ahead + sides, k + sides], axis=1)
    faces = [k[::-1].tolist(), (k + sides).tolist(), *around.tolist()]
    return scenes.add_mesh(np.concatenate([ring, ring + np.array([0, 0, 1])]), faces, name="prism")


@pytest.mark.parametrize("edit", [False, True])
def test_suzanne_of_three_components(edit, said):
    thing = scenes.adorn(add_suzanne())
    kept = scenes.everything_else(thing)
    bpy.ops.object.mode_set(mode="EDIT" if edit else "OBJECT")
    if edit:
        bpy.ops.mesh.select_all(action="SELECT")
    assert bpy.ops.uv.qhm_unwrap() == {"FINISHED"}
    assert bpy.context.mode == ("EDIT_MESH" if edit else "OBJECT")
    bpy.ops.object.mode_set(mode="OBJECT")
    assert_sound(thing)
    assert seams(thing) == scenes.seams_of_map(thing)
    after = scenes.everything_else(thing)
    without_seams = [[(ends, sharp) for ends, _, sharp in found.pop("edges")] for found in (kept, after)]
    assert without_seams[0] == without_seams[1]
    assert after == kept
    text = said()
    assert f"{len(layout([thing]).islands)} islands, stretch 1." in text
    assert "% of the texture used" in text
    assert "no two charts overlap" in text


def add_ribbon():
    """A long strip of few quads, so that the only cuts that make it shorter are between quads."""
    x = np.arange(5) * 3.0
    V = np.concatenate([np.stack([x, 0 * x, 0 * x], axis=1), np.stack([x, 0 * x + 1, 0 * x], axis=1)])
    return scenes.add_mesh(V, [[k, k + 1, k + 6, k + 5] for k in range(4)], name="ribbon")


@pytest.mark.parametrize("make", [add_prism, add_suzanne, add_ribbon])
def test_faces_of_many_corners_are_not_cut(make, said):
    thing = make()
    assert bpy.ops.uv.qhm_unwrap(max_stretch=1.2) == {"FINISHED"}
    assert_sound(thing)
    assert "crossed" not in said()
    assert seams(thing) == scenes.seams_of_map(thing)
    assert seams(thing)


def test_options_reach_the_library():
    thing = add_suzanne()
    bpy.ops.uv.qhm_unwrap(max_stretch=3.0)
    few = len(layout([thing]).islands)
    bpy.ops.uv.qhm_unwrap(max_stretch=1.1)
    assert len(layout([thing]).islands) > few
    bpy.ops.uv.qhm_unwrap(max_stretch=1.1, max_charts=few)
    assert len(layout([thing]).islands) <= few + 3
    with pytest.raises(RuntimeError, match="resolution"):
        bpy.ops.uv.qhm_unwrap(resolution=16, padding=16)


def test_marked_seams_are_kept():
    bpy.ops.mesh.primitive_cube_add()
    thing = bpy.context.object
    thing.data.uv_layers.remove(thing.data.uv_layers[0])
    for edge in thing.data.edges:
        edge.use_seam = True
    bpy.ops.uv.qhm_unwrap(keep_seams=True)
    assert len(layout([thing]).islands) == 6
    assert len(seams(thing)) == 12
    bpy.ops.uv.qhm_unwrap(mark_seams=False)
    assert len(layout([thing]).islands) < 6
    assert len(seams(thing)) == 12
    bpy.ops.uv.qhm_unwrap()
    assert seams(thing) == scenes.seams_of_map(thing)
    assert len(seams(thing)) < 12
    assert_sound(thing)


def test_borders_of_the_uvs_are_kept_without_marked_seams():
    bpy.ops.mesh.primitive_cube_add()
    thing = bpy.context.object
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.uv.cube_project()
    bpy.ops.object.mode_set(mode="OBJECT")
    uv = scenes.places(thing)
    # Two faces are parted from the others, which lie together.
    uv[thing.data.polygons[0].loop_start : thing.data.polygons[0].loop_start + 4] += 5
    scenes.set_places(thing, uv)
    before = scenes.seams_of_map(thing)
    bpy.ops.uv.qhm_unwrap(keep_seams=True)
    assert before <= scenes.seams_of_map(thing)
    assert_sound(thing)


def test_what_is_no_surface_is_unwrapped_and_told(said):
    # Three faces at an edge, one twice, one degenerate, one reversed.
    V = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [2, 0, 0], [2, 1, 0], [1, 1, 0]]
    thing = scenes.add_mesh(V, [[0, 1, 2], [1, 0, 3], [0, 1, 4], [0, 1, 5], [1, 7, 2], [1, 7, 6]])
    assert bpy.ops.uv.qhm_unwrap() == {"FINISHED"}
    text = said()
    assert "edges cut: 1" in text
    assert "triangles reversed: 1" in text
    assert (0, 1) in seams(thing)
    uv = scenes.places(thing)
    assert np.isfinite(uv).all()
    assert uv.min() >= 0
    assert uv.max() <= 1


def test_inside_out_is_told(said):
    thing = add_prism()
    thing.data.flip_normals()
    bpy.ops.uv.qhm_unwrap()
    assert "1 closed part is inside out" in said()


def test_modifiers_are_ignored_and_told(said):
    thing = add_suzanne()
    thing.modifiers.new("finer", "SUBSURF").levels = 2
    count = len(thing.data.loops)
    bpy.ops.uv.qhm_unwrap()
    assert "the modifiers of Suzanne are ignored" in said()
    assert len(thing.data.loops) == count
    assert_sound(thing)


@pytest.mark.parametrize("edit", [False, True])
def test_several_objects_share_one_texture(edit):
    first, second, third = add_suzanne(), add_prism(), add_prism()
    third.scale = (3, 3, 3)
    other = scenes.add_quads()
    kept = scenes.places(other)
    for thing in (first, second, third):
        thing.select_set(True)
    other.select_set(False)
    bpy.context.view_layer.objects.active = second
    bpy.context.view_layer.update()
    if edit:
        bpy.ops.object.mode_set(mode="EDIT")
        bpy.ops.mesh.select_all(action="SELECT")
        # Edited, and no longer selected.
        first.select_set(False)
        other.select_set(True)
    assert bpy.ops.uv.qhm_unwrap() == {"FINISHED"}
    if edit:
        assert set(bpy.context.objects_in_mode) == {first, second, third}
        assert not first.select_get()
        assert other.select_get()
        bpy.ops.object.mode_set(mode="OBJECT")
    assert bpy.context.active_object == second
    assert_sound(first, second, third)
    assert np.array_equal(scenes.places(other), kept)
    # Texel density counts the object's scale.
    assert area(third) == pytest.approx(9 * area(second), rel=0.01)


def area(thing):
    corners, _ = scenes.triangles(thing)
    a, b, c = scenes.places(thing).astype(float)[corners].transpose(1, 0, 2)
    return float(np.abs(np.cross(b - a, c - a)).sum() / 2)


def test_a_mesh_of_two_objects_is_unwrapped_once():
    first = add_prism()
    second = bpy.data.objects.new("twin", first.data)
    bpy.context.collection.objects.link(second)
    second.select_set(True)
    bpy.ops.uv.qhm_unwrap()
    assert_sound(first)
    assert area(first) > 0.4


def test_an_object_that_is_stretched_is_measured_as_it_is_seen():
    bpy.ops.mesh.primitive_plane_add()
    thing = bpy.context.object
    thing.scale = (4, 1, 1)
    thing.rotation_euler = (0.3, 0.2, 0.1)
    bpy.context.view_layer.update()
    bpy.ops.uv.qhm_unwrap(rotate=False)
    width, height = sorted(np.ptp(scenes.places(thing), axis=0).tolist(), reverse=True)
    assert width == pytest.approx(4 * height, rel=1e-3)


def test_rotation_and_place_of_an_object_do_not_matter():
    thing = add_suzanne()
    bpy.ops.uv.qhm_unwrap()
    before = scenes.places(thing)
    thing.rotation_euler, thing.location = (0.3, 0.2, 0.1), (5, 6, 7)
    bpy.context.view_layer.update()
    bpy.ops.uv.qhm_unwrap()
    assert np.array_equal(scenes.places(thing), before)


def test_hidden_and_unselected_faces_stay():
    thing = scenes.add_quads()
    before = scenes.places(thing)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="DESELECT")
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.context.tool_settings.mesh_select_mode = (False, False, True)
    for k in range(12):
        thing.data.polygons[k].hide = True
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.uv.qhm_unwrap()
    bpy.ops.object.mode_set(mode="OBJECT")
    assert np.array_equal(scenes.places(thing)[:48], before[:48])
    assert not np.array_equal(scenes.places(thing)[48:], before[48:])
    scenes.set_places(thing, before)
    for k in range(20, 24):
        thing.data.polygons[k].select = True
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.uv.qhm_unwrap()
    bpy.ops.object.mode_set(mode="OBJECT")
    changed = (scenes.places(thing) != before).any(axis=1)
    assert set(np.flatnonzero(changed) // 4) == set(range(20, 24))


@pytest.mark.parametrize("several", [False, True])
def test_islands_left_unchanged_are_counted(several, said):
    things = [scenes.two_squares([0, 0]) for _ in range(1 + several)]
    for thing in things:
        thing.select_set(True)
        thing.data.polygons.foreach_set("hide", np.arange(32) < 16)
    bpy.ops.object.mode_set(mode="EDIT")
    assert bpy.ops.uv.qhm_unwrap() == {"FINISHED"}
    count = "2 other islands" if several else "1 other island"
    assert f"{count} unchanged, of which {len(things)} overlap the new ones." in said()


@pytest.mark.parametrize("edit", [False, True])
def test_undo_gives_back_uvs_and_seams_of_all_objects(edit):
    things = [add_suzanne(), add_prism(), scenes.add_quads()]
    for thing in things:
        thing.data.edges[3].use_seam = True
        thing.select_set(True)
    names = [thing.name for thing in things]
    if edit:
        bpy.ops.object.mode_set(mode="EDIT")
        bpy.ops.mesh.select_all(action="SELECT")

    def state():
        mode = bpy.context.active_object.mode
        if mode == "EDIT":
            bpy.ops.object.mode_set(mode="OBJECT")
        found = [bpy.data.objects[name] for name in names]
        layers = [scenes.places(one).tobytes() if one.data.uv_layers else b"" for one in found]
        result = layers, [seams(one) for one in found]
        bpy.ops.object.mode_set(mode=mode)
        return result

    before = state()
    bpy.ops.ed.undo_push(message="before")
    assert bpy.ops.uv.qhm_unwrap() == {"FINISHED"}
    after = state()
    assert all(one != other for one, other in zip(before[0], after[0], strict=True))
    bpy.ops.ed.undo_push(message="after")
    bpy.ops.ed.undo()
    assert state() == before


def test_an_internal_error_is_reported(monkeypatch, extension):
    import importlib

    module = importlib.import_module(f"{extension}.unwrapping")
    monkeypatch.setattr(module, "unwrap", lambda *_, **__: np.zeros(2)[5])
    thing = scenes.add_quads()
    before = scenes.places(thing)
    with pytest.raises(RuntimeError, match=r"internal error, nothing has changed\. IndexError"):
        bpy.ops.uv.qhm_unwrap()
    assert np.array_equal(scenes.places(thing), before)
