"""Options of Unwrap Model, Fit of several objects, and the entry in the UV menus."""

import bpy
import numpy as np
import pytest
import scenes


def add_bricks(n):
    """Boxes of the same size, apart from each other."""
    box = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    faces = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    V = np.concatenate([box + np.array([2.5 * k, 0, 0]) for k in range(n)])
    return scenes.add_mesh(V, np.concatenate([faces + 8 * k for k in range(n)]), name="bricks")


def test_tiles_and_texel_density():
    thing = add_bricks(4)
    assert bpy.ops.uv.qhm_unwrap(tiles=3, texels_per_unit=100.0, resolution=512) == {"FINISHED"}
    uv = scenes.places(thing)
    assert 1 < uv[:, 0].max() <= 3
    assert scenes.verdict(thing).bijective
    corners, _ = scenes.triangles(thing)
    V = np.array([v.co for v in thing.data.vertices])[scenes.vertices_of_loops(thing)[corners]]
    space = np.linalg.norm(V[:, 1] - V[:, 0], axis=1)
    plane = np.linalg.norm(uv[corners][:, 1] - uv[corners][:, 0], axis=1) * 512
    assert plane / space == pytest.approx(100, rel=1e-3)


def test_sharp_edges_become_seams():
    thing = add_bricks(1)
    bpy.ops.uv.qhm_unwrap()
    free = scenes.seams_of_map(thing)
    for edge in thing.data.edges:
        edge.use_edge_sharp = True
    bpy.ops.uv.qhm_unwrap(hard_edges=True)
    assert len(free) < 12
    assert len(scenes.seams_of_map(thing)) == 12


def test_symmetric_seams(said):
    """A tetrahedron and its mirror image, of triangles: Blender divides quads without regard to symmetry."""
    V = np.array([[1, 0, 0], [2, 0, 0], [1, 1, 0], [1, 0.2, 1.5]], dtype=float)
    F = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    thing = scenes.add_mesh(np.concatenate([V, V * [-1, 1, 1]]), np.concatenate([F, F[:, ::-1] + 4]))
    assert bpy.ops.uv.qhm_unwrap(symmetry="x") == {"FINISHED"}
    seams = scenes.seams_of_map(thing)
    assert {tuple(sorted((v + 4) % 8 for v in pair)) for pair in seams} == seams
    assert "symmetric in x: seams and charts are mirrored" in said()
    bpy.ops.mesh.primitive_monkey_add()
    assert bpy.ops.uv.qhm_unwrap(symmetry="x") == {"FINISHED"}
    assert "not every triangle has a mirror image" in said()
    scenes.add_quads()
    for options, reason in [({}, "not every vertex has a mirror image"), ({"keep_seams": True}, "seams are kept")]:
        assert bpy.ops.uv.qhm_unwrap(symmetry="z", **options) == {"FINISHED"}
        (line,) = (line for line in said().splitlines() if reason in line)
        assert line.startswith("Warning: Unwrap Model: ")


def test_new_islands_are_placed_around_the_faces_that_are_not_selected():
    thing = scenes.two_squares([0.0, 0.0])
    uv = 0.4 * scenes.places(thing)
    scenes.set_places(thing, uv)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="DESELECT")
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.context.tool_settings.mesh_select_mode = (False, False, True)
    for face in thing.data.polygons[:16]:
        face.select = True
    bpy.ops.object.mode_set(mode="EDIT")
    assert bpy.ops.uv.qhm_unwrap(around=True, resolution=512) == {"FINISHED"}
    bpy.ops.object.mode_set(mode="OBJECT")
    after = scenes.places(thing)
    assert np.array_equal(after[64:], uv[64:])
    assert not np.array_equal(after[:64], uv[:64])
    verdict = scenes.verdict(thing)
    assert verdict.bijective
    assert not len(verdict.overlapping)


def test_fit_of_several_objects():
    first, second = scenes.add_quads(5), scenes.add_quads(7)
    first.select_set(True)
    assert bpy.ops.uv.qhm_fit(to="DISK") == {"FINISHED"}
    for thing in (first, second):
        assert np.hypot(*(scenes.places(thing)[scenes.border(thing)] - 0.5).T) == pytest.approx(0.5, abs=2e-2)
        assert scenes.verdict(thing).bijective


def test_energies_are_those_of_the_library():
    from quasiharmonic.util.options import ENERGIES

    offered = bpy.ops.uv.qhm_flatten.get_rna_type().properties["energy"].enum_items
    assert tuple(item.identifier for item in offered) == ENERGIES


@pytest.mark.parametrize("menu", ["VIEW3D_MT_uv_map", "IMAGE_MT_uvs"])
def test_unwrap_is_in_the_uv_menus(menu):
    drawn = getattr(bpy.types, menu).draw._draw_funcs
    assert any(function.__module__.endswith("quasiharmonic.panel") for function in drawn)
