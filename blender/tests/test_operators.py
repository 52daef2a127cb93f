"""Each operator: what it promises of the UVs, and that nothing else changes."""

import sys
from pathlib import Path

import bpy
import numpy as np
import pytest
import scenes


@pytest.fixture(params=["scan", "quads"])
def thing(request):
    """A surface that is a disk, with UVs, and with what artists' meshes have."""
    if request.param == "quads":
        return scenes.adorn(scenes.add_quads())
    thing = scenes.add_scan()
    thing.data.uv_layers.new(name="UVMap")
    return scenes.adorn(thing)


def undoing(thing, act):
    """Do something, and undo it; the mesh's UVs after the one and after the other."""
    name = thing.name
    bpy.ops.ed.undo_push(message="before")
    act()
    after = scenes.places(bpy.data.objects[name])
    bpy.ops.ed.undo_push(message="after")
    bpy.ops.ed.undo()
    return after, scenes.places(bpy.data.objects[name])


def tangled(thing, seed=1):
    """Flatten a mesh, and throw a few vertices that are not at the border about."""
    assert bpy.ops.uv.qhm_flatten() == {"FINISHED"}
    inner = np.setdiff1d(np.arange(len(thing.data.vertices)), scenes.vertices_of_loops(thing)[scenes.border(thing)])
    rng = np.random.default_rng(seed)
    for vertex in rng.choice(inner, 3, replace=False).tolist():
        here = scenes.places(thing)[scenes.vertices_of_loops(thing) == vertex][0]
        scenes.move_vertex(thing, vertex, here + rng.normal(scale=0.3, size=2))
    assert not scenes.verdict(thing).injective


def test_the_zip_brings_all_that_is_needed(extension):
    import quasiharmonic

    assert Path(bpy.utils.resource_path("USER")) in Path(quasiharmonic.__file__).parents
    assert extension in bpy.context.preferences.addons
    assert hasattr(bpy.types, "QHM_PT_uv")


def test_flatten_a_large_model_twice():
    """Each time in a thread of its own, and the linear solver of large systems minds in which it is loaded."""
    bpy.ops.mesh.primitive_monkey_add()
    bpy.context.object.modifiers.new("finer", "SUBSURF").levels = 2
    bpy.ops.object.modifier_apply(modifier="finer")
    for _ in range(2):
        assert bpy.ops.uv.qhm_flatten() == {"FINISHED"}
    assert scenes.verdict(bpy.context.object).injective


def test_flatten(thing):
    before, kept = scenes.places(thing), scenes.everything_else(thing)
    assert bpy.ops.uv.qhm_flatten() == {"FINISHED"}
    assert scenes.verdict(thing).bijective
    assert scenes.everything_else(thing) == kept
    uv = scenes.places(thing)
    assert uv.min() >= 0
    assert 0.9 < uv.max() <= 1
    stretch = scenes.stretch(thing)
    assert not np.array_equal(uv, before)
    scenes.unwrap(thing, method="MINIMUM_STRETCH", iterations=100)
    assert stretch < 1.001 * scenes.stretch(thing)


@pytest.mark.parametrize("act", ["flatten", "reduce_stretch", "repair", "fit"])
def test_undo_gives_the_old_uvs(act):
    thing = scenes.add_quads()
    if act == "repair":
        scenes.move_vertex(thing, 24, [0.1, 0.1])
    before = scenes.places(thing)
    after, undone = undoing(thing, getattr(bpy.ops.uv, f"qhm_{act}"))
    assert not np.array_equal(after, before)
    assert np.array_equal(undone, before)


def test_flatten_makes_a_uv_layer_where_there_is_none():
    thing = scenes.add_scan()
    assert bpy.ops.uv.qhm_flatten(pack=False) == {"FINISHED"}
    assert [layer.name for layer in thing.data.uv_layers] == ["UVMap"]
    assert scenes.verdict(thing).bijective


def test_flatten_cuts_at_marked_seams_and_nowhere_else():
    bpy.ops.mesh.primitive_cube_add()
    thing = bpy.context.active_object
    # A cross: all edges but five, which hang the faces together.
    hinges = {(0, 1), (2, 3), (4, 5), (6, 7), (1, 3)}
    ends = [tuple(sorted(edge.vertices)) for edge in thing.data.edges]
    faces_of = {end: [f.index for f in thing.data.polygons if end in f.edge_keys] for end in ends}
    joined, hinges = {0}, []
    for end in sorted(ends):
        a, b = faces_of[end]
        if (a in joined) != (b in joined):
            joined |= {a, b}
            hinges.append(end)
    for edge, end in zip(thing.data.edges, ends, strict=True):
        edge.use_seam = end not in hinges
    if len(hinges) < 5:
        pytest.fail("the faces do not hang together")
    assert bpy.ops.uv.qhm_flatten() == {"FINISHED"}
    found = scenes.verdict(thing)
    assert found.bijective
    assert len(found.islands) == 1
    assert scenes.seams_of_map(thing) == set(ends) - set(hinges)
    assert scenes.stretch(thing) == pytest.approx(4, abs=1e-5)


def test_cut_and_flatten_opens_what_is_closed():
    bpy.ops.mesh.primitive_monkey_add()
    thing = bpy.context.active_object
    thing.data.uv_layers.remove(thing.data.uv_layers[0])
    kept = scenes.everything_else(thing)
    assert bpy.ops.uv.qhm_flatten(cut=True) == {"FINISHED"}
    found = scenes.verdict(thing)
    assert found.bijective
    assert not len(found.overlapping)
    assert scenes.everything_else(thing) == kept


def test_check_selects_the_flipped_faces(said):
    thing = scenes.add_quads()
    scenes.move_vertex(thing, 24, scenes.places(thing)[scenes.vertices_of_loops(thing) == 10][0])
    corners, face = scenes.triangles(thing)
    a, b, c = scenes.places(thing).astype(float)[corners].transpose(1, 0, 2)
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    expected = set(face[area <= 0].tolist())
    kept, before = scenes.everything_else(thing), scenes.places(thing)
    assert bpy.ops.uv.qhm_check() == {"FINISHED"}
    assert scenes.selected(thing) == expected
    assert expected
    assert f"{len(expected)} faces selected, of which {len(expected)} inverted" in said()
    assert scenes.everything_else(thing) == kept
    assert np.array_equal(scenes.places(thing), before)


def test_check_selects_the_faces_that_lie_on_others(said):
    thing = scenes.two_squares([0.625, 0])
    bpy.ops.uv.qhm_check()
    column = np.arange(32) % 4
    expected = np.flatnonzero(np.where(np.arange(32) < 16, column >= 2, column <= 1))
    assert scenes.selected(thing) == set(expected.tolist())
    assert "Warning" in said()


def test_check_tells_of_mirrored_islands_and_selects_none_of_them(said):
    thing = scenes.two_squares([1.5, 0], mirror=True)
    bpy.ops.uv.qhm_check()
    assert scenes.selected(thing) == set()
    text = said()
    assert "Mirrored" in text
    assert "2 bijective" in text


def test_check_tells_of_faces_that_are_not_convex(said):
    thing = scenes.add_mesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2, 3]])
    thing.data.uv_layers.new()
    # Not convex at the corner at which Blender's diagonal ends.
    scenes.set_places(thing, [[0, 0], [1, 0], [0.3, 0.3], [0, 1]])
    bpy.ops.uv.qhm_check()
    assert scenes.selected(thing) == set()
    assert "1 face is not convex" in said()


def test_check_calls_no_hidden_face_not_convex(said):
    thing = scenes.add_quads()
    thing.data.polygons[7].hide = thing.data.polygons[8].hide = True
    bpy.ops.object.mode_set(mode="EDIT")
    assert bpy.ops.uv.qhm_check() == {"FINISHED"}
    assert "not convex" not in said()


def test_repair(thing):
    tangled(thing)
    before, kept = scenes.places(thing), scenes.everything_else(thing)
    assert bpy.ops.uv.qhm_repair() == {"FINISHED"}
    uv = scenes.places(thing)
    assert scenes.verdict(thing).injective
    assert np.array_equal(uv[scenes.border(thing)], before[scenes.border(thing)])
    assert 0 < np.count_nonzero((uv != before).any(axis=1)) < len(uv) / 2
    assert scenes.everything_else(thing) == kept


def test_repair_leaves_mirrored_islands_unless_asked():
    thing = scenes.two_squares([1.5, 0], mirror=True)
    before = scenes.places(thing)
    bpy.ops.uv.qhm_repair()
    assert np.array_equal(scenes.places(thing), before)
    bpy.ops.uv.qhm_repair(unmirror=True)
    assert scenes.verdict(thing).mirrored.size == 0
    assert scenes.verdict(thing).injective


@pytest.mark.parametrize("chosen", [False, True])
def test_a_single_mirrored_island_is_called_mirrored(chosen, said):
    V, flat, faces = scenes.quads(4)
    thing = scenes.two_squares([1.5, 0], mirror=True) if chosen else scenes.add_mesh(V, faces, flat * [-1, 1])
    thing.data.polygons.foreach_set("select", np.arange(len(thing.data.polygons)) >= len(thing.data.polygons) - 16)
    before = scenes.places(thing)
    if chosen:
        bpy.context.tool_settings.mesh_select_mode = (False, False, True)
        bpy.ops.object.mode_set(mode="EDIT")
    assert bpy.ops.uv.qhm_repair() == {"FINISHED"}
    assert bpy.ops.uv.qhm_reduce_stretch() == {"FINISHED"}
    bpy.ops.object.mode_set(mode="OBJECT")
    assert said().count("option Turn mirrored islands over") == 2
    border = scenes.border(thing)
    assert np.array_equal(scenes.places(thing)[border], before[border])
    assert not np.array_equal(scenes.places(thing), before)
    bpy.ops.uv.qhm_check()
    assert scenes.selected(thing) == set()
    assert "Info: Check UVs: 0 faces selected" in said()
    bpy.ops.uv.qhm_repair(unmirror=True)
    assert scenes.verdict(thing).injective
    assert scenes.verdict(thing).mirrored.size == 0


@pytest.mark.parametrize("energy", ["symmetric-dirichlet", "mips", "blend"])
def test_reduce_stretch_keeps_borders(energy):
    thing = scenes.add_quads()
    V, flat, _ = scenes.quads()
    inner = np.setdiff1d(np.arange(len(V)), scenes.vertices_of_loops(thing)[scenes.border(thing)])
    for vertex in inner.tolist():
        scenes.move_vertex(thing, vertex, flat[vertex] ** 1.5)
    assert scenes.verdict(thing).injective
    before, stretch = scenes.places(thing), scenes.stretch(thing)
    assert bpy.ops.uv.qhm_reduce_stretch(energy=energy) == {"FINISHED"}
    border = scenes.border(thing)
    assert np.array_equal(scenes.places(thing)[border], before[border])
    assert scenes.stretch(thing) < stretch
    assert scenes.verdict(thing).injective


def test_reduce_stretch_frees_borders():
    thing = scenes.add_quads()
    kept = scenes.stretch(thing)
    bpy.ops.uv.qhm_reduce_stretch()
    held = scenes.stretch(thing)
    bpy.ops.uv.qhm_reduce_stretch(free=True)
    assert scenes.stretch(thing) < held <= kept
    assert scenes.verdict(thing).bijective


def add_curve(name="ring"):
    """A closed Bézier curve with a waist."""
    bpy.ops.curve.primitive_bezier_circle_add()
    curve = bpy.context.active_object
    curve.name = name
    curve.scale = (2, 1, 1)
    curve.data.dimensions = "2D"
    return curve


OUTLINES = [
    {"to": "RECTANGLE", "height": 0.5},
    {"to": "DISK"},
    {"to": "LETTER", "letter": "S"},
    {"to": "CURVE", "curve": "ring"},
]


@pytest.mark.parametrize("fit", OUTLINES)
def test_fit(thing, fit):
    add_curve()
    bpy.context.view_layer.objects.active = thing
    bpy.ops.uv.qhm_flatten()
    kept = scenes.everything_else(thing)
    assert bpy.ops.uv.qhm_fit(**fit) == {"FINISHED"}
    assert scenes.verdict(thing).bijective
    assert scenes.everything_else(thing) == kept
    uv = scenes.places(thing)
    edge = uv[scenes.border(thing)].astype(float)
    if fit["to"] == "RECTANGLE":
        assert edge.min(axis=0) == pytest.approx([0, 0])
        assert edge.max(axis=0) == pytest.approx([1, 0.5])
        off = np.minimum(np.minimum(edge[:, 0], 1 - edge[:, 0]), np.minimum(edge[:, 1], 0.5 - edge[:, 1]))
        assert abs(off).max() < 1e-6
    elif fit["to"] == "DISK":
        assert np.hypot(*(edge - 0.5).T) == pytest.approx(0.5, abs=1e-2)
    elif fit["to"] == "CURVE":
        # Nearly an ellipse, twice as wide as high.
        x, y = (2 * edge - [1, 0.5]).T
        assert np.hypot(x, 2 * y) == pytest.approx(1, abs=2e-2)
    else:
        assert uv.min() >= 0
        assert uv.max() <= 1
        assert scenes.stretch(thing) > 4.5


@pytest.mark.parametrize("letter", ["Q", "ß", "Ø"])
def test_fit_to_letters_that_double_back_or_are_not_ascii(letter):
    thing = scenes.add_quads(12)
    assert bpy.ops.uv.qhm_fit(to="LETTER", letter=letter) == {"FINISHED"}
    assert scenes.verdict(thing).bijective


@pytest.mark.parametrize("edit", [False, True])
def test_fit_treats_a_new_uv_layer_as_blank(edit):
    thing = scenes.add_mesh(*scenes.quads(4)[::2])
    thing.data.uv_layers.new()
    if edit:
        bpy.context.tool_settings.mesh_select_mode = (False, False, True)
        thing.data.polygons.foreach_set("select", np.arange(16) < 3)
        thing.data.polygons[15].hide = True
        bpy.ops.object.mode_set(mode="EDIT")
    assert bpy.ops.uv.qhm_fit(to="DISK") == {"FINISHED"}
    bpy.ops.object.mode_set(mode="OBJECT")
    found = scenes.verdict(thing)
    assert [len(island.triangles) for island in found.islands] == ([30, 2] if edit else [32])
    assert found.bijective


def test_a_square_fitted_to_a_rectangle_has_its_corners_at_the_corners():
    thing = scenes.add_quads()
    bpy.ops.uv.qhm_fit(to="RECTANGLE")
    at = scenes.vertices_of_loops(thing)
    corners = {tuple(scenes.places(thing)[at == v][0].tolist()) for v in (0, 6, 42, 48)}
    assert corners == {(0, 0), (1, 0), (0, 1), (1, 1)}


def test_a_text_object_and_a_flat_mesh_are_outlines_too():
    bpy.ops.object.text_add()
    bpy.context.active_object.data.body = "L"
    text = bpy.context.active_object.name
    bpy.ops.mesh.primitive_plane_add(size=3)
    plane = bpy.context.active_object.name
    thing = scenes.add_quads()
    for name in (text, plane):
        assert bpy.ops.uv.qhm_fit(to="CURVE", curve=name) == {"FINISHED"}
        assert scenes.verdict(thing).bijective


def test_in_edit_mode_islands_that_are_not_selected_stay():
    thing = scenes.two_squares([1.5, 0])
    scenes.move_vertex(thing, 7, [0.5, 0.35])
    scenes.move_vertex(thing, 32, [2.0, 0.35])
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="DESELECT")
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.context.tool_settings.mesh_select_mode = (False, False, True)
    thing.data.polygons[20].select = True
    before = scenes.places(thing)
    bpy.ops.object.mode_set(mode="EDIT")
    assert bpy.ops.uv.qhm_reduce_stretch() == {"FINISHED"}
    assert bpy.context.mode == "EDIT_MESH"
    bpy.ops.object.mode_set(mode="OBJECT")
    uv = scenes.places(thing)
    assert np.array_equal(uv[:64], before[:64])
    assert not np.array_equal(uv[64:], before[64:])
    bpy.ops.object.mode_set(mode="EDIT")
    assert bpy.ops.uv.qhm_fit(to="DISK") == {"FINISHED"}
    assert bpy.ops.uv.qhm_reduce_stretch(whole=True) == {"FINISHED"}
    bpy.ops.object.mode_set(mode="OBJECT")
    assert not np.array_equal(scenes.places(thing)[:64], before[:64])
    assert scenes.verdict(thing).injective


def test_check_in_edit_mode_selects_there():
    thing = scenes.add_quads()
    scenes.move_vertex(thing, 24, [0.1, 0.1])
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.mesh.select_mode(type="VERT")
    bpy.ops.uv.qhm_check()
    assert bpy.context.mode == "EDIT_MESH"
    bpy.ops.object.mode_set(mode="OBJECT")
    found = scenes.selected(thing)
    bpy.ops.uv.qhm_check()
    assert scenes.selected(thing) == found
    assert 0 < len(found) < 8


def test_roundings_of_one_place_are_no_seam(said):
    # Blender writes the places of its own grid with different roundings into the loops around a vertex.
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=10, y_subdivisions=10)
    bpy.ops.uv.qhm_check()
    assert "1 island: 1 injective, 1 bijective" in said()


def test_neither_matplotlib_nor_mkl_is_loaded():
    scenes.add_quads()
    bpy.ops.uv.qhm_check()
    bpy.ops.uv.qhm_flatten(cut=True)
    bpy.ops.uv.qhm_repair()
    bpy.ops.uv.qhm_reduce_stretch(free=True)
    for to in ("RECTANGLE", "LETTER"):
        bpy.ops.uv.qhm_fit(to=to)
    assert not [name for name in sys.modules if name.split(".")[0] in {"matplotlib", "mkl", "shapely", "PIL"}]
    maps = Path("/proc/self/maps")
    assert not maps.exists() or "mkl_" not in maps.read_text(encoding="utf-8")


@pytest.mark.parametrize("edit", [False, True])
def test_several_objects_are_changed_one_by_one(edit, said):
    things = []
    for seed in range(2):
        thing = scenes.add_quads()
        thing.name = f"thing {seed}"
        tangled(thing, seed)
        things.append(thing)
    for thing in things:
        thing.select_set(True)
    if edit:
        bpy.ops.object.mode_set(mode="EDIT")
        bpy.ops.mesh.select_all(action="SELECT")
    said()
    for name in ("check", "repair", "reduce_stretch", "flatten"):
        before = None if edit else [scenes.places(thing) for thing in things]
        assert getattr(bpy.ops.uv, f"qhm_{name}")() == {"FINISHED"}
        if before and name != "check":
            assert not any(np.array_equal(scenes.places(t), uv) for t, uv in zip(things, before, strict=True)), name
    told = said()
    for thing in things:
        assert f"Repair UVs: {thing.name}: " in told
        assert f"Check UVs: {thing.name}: " in told
    if edit:
        bpy.ops.object.mode_set(mode="OBJECT")
    assert all(scenes.verdict(thing).bijective for thing in things)


def test_if_one_of_several_objects_is_refused_none_is_changed(said):
    thing = scenes.add_quads()
    scenes.move_vertex(thing, 24, [0.9, 0.9])
    bare = scenes.add_quads()
    bare.data.uv_layers.remove(bare.data.uv_layers.active)
    for one in (bare, thing):
        one.select_set(True)
    before = scenes.places(thing)
    with pytest.raises(RuntimeError, match="no UV map"):
        bpy.ops.uv.qhm_repair()
    assert np.array_equal(scenes.places(thing), before)
