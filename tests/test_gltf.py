"""glTF: files of other programs are read, other programs read ours, and only the map changes."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from quasiharmonic import certify, io
from quasiharmonic.io import MeshData, MeshFileError
from quasiharmonic.io.models.appearance import label_materials
from quasiharmonic.surfaces import cat, starfish
from shared.gltf_files import HALVES, SQUARE, Gltf, numbers, opened, square


def read(made, tmp_path, name="mesh.glb"):
    path = tmp_path / name
    path.write_bytes(made.glb() if name.endswith("glb") else made.gltf())
    return io.read_mesh(path)


def cube():
    """A cube as exporters write it: 24 vertices, and each face is an island."""
    trimesh = pytest.importorskip("trimesh", reason="an independent reader and writer of glTF")
    V = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    uv = np.concatenate([np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) / 4 + [k % 3 / 3, k // 3 / 2] for k in range(6)])
    F = np.concatenate([4 * np.arange(6)[:, None] + t for t in ([0, 1, 2], [0, 2, 3])])
    visual = trimesh.visual.TextureVisuals(uv=uv, material=trimesh.visual.material.PBRMaterial(name="paint"))
    return trimesh.Trimesh(V[quads.ravel()], F, visual=visual, process=False)


@pytest.mark.slow
def test_a_cube_is_closed_and_its_seams_are_at_the_right_edges(tmp_path):
    there = cube()
    there.export(tmp_path / "cube.glb")
    mesh = io.read_mesh(tmp_path / "cube.glb")
    assert len(mesh.V) == 8
    np.testing.assert_array_equal(mesh.V[mesh.F], there.vertices[there.faces])
    np.testing.assert_allclose(mesh.vt[mesh.FT], there.visual.uv[there.faces], atol=1e-7)
    assert len(io.seamed(mesh).islands) == 6
    assert b"usemtl paint\n" in mesh.statements


def test_another_library_reads_written_files(tmp_path):
    trimesh = pytest.importorskip("trimesh", reason="an independent reader and writer of glTF")
    V, F = cat(8)
    rng = np.random.default_rng(5)
    FT = np.arange(F.size).reshape(-1, 3)
    mesh = MeshData(V, F, vt=rng.random((F.size, 2)), FT=FT)
    io.write_mapped(tmp_path / "cat.glb", mesh)
    there = trimesh.load(tmp_path / "cat.glb", process=False, force="mesh")
    np.testing.assert_array_equal(there.vertices[there.faces], V.astype("f4")[F])
    np.testing.assert_allclose(there.visual.uv[there.faces], mesh.vt[FT], atol=1e-7)


def test_only_the_map_changes(tmp_path):
    made = square(
        TEXCOORD_0=SQUARE[:, :2],
        TEXCOORD_1=SQUARE[:, :2] * np.float32(0.5),
        NORMAL=np.tile(np.array([[0, 0, 1]], "f4"), (4, 1)),
        JOINTS_0=np.arange(16, dtype="u1").reshape(4, 4),
    )
    made.tree |= {
        "materials": [{"name": "skin", "extensions": {"KHR_materials_clearcoat": {"clearcoatFactor": 0.5}}}],
        "images": [{"bufferView": made.view(b"\x89PNG not looked into"), "mimeType": "image/png"}],
        "textures": [{"source": 0}],
        "animations": [{"channels": [], "samplers": []}],
        "nodes": [{"mesh": 0, "extras": {"mine": [1, None, "é"]}}],
        "scenes": [{"nodes": [0]}],
        "extras": {"kept": True},
    }
    made.tree["meshes"][0]["primitives"][0]["material"] = 0
    mesh = read(made, tmp_path)
    uv = np.array([[0, 0], [2, 0], [2, 2], [0, 1.5]])
    io.write_map(tmp_path / "out.glb", mesh, uv)
    before, after = opened(made.glb())[0], opened((tmp_path / "out.glb").read_bytes())[0]
    for tree in (before, after):
        for changed in ("buffers", "bufferViews"):
            del tree[changed]
        place = tree["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"]
        assert tree["accessors"][place].pop("componentType") == 5126
    assert after == before
    old, new = made.glb(), (tmp_path / "out.glb").read_bytes()
    for index in range(len(before["accessors"])):
        if index != place:
            np.testing.assert_array_equal(numbers(new, index), numbers(old, index))
    np.testing.assert_array_equal(numbers(new, place), [[0, 1], [2, 1], [2, -1], [0, -0.5]])
    assert b"\x89PNG not looked into" in new
    assert io.not_held("out.glb", mesh) == []
    assert io.not_held("out.obj", mesh) == ["animations", "JOINTS_0 of vertices", "TEXCOORD_1 of vertices"]
    assert "JOINTS_0 of vertices" in io.not_held("out.ply", mesh)


def test_shared_data_does_not_change(tmp_path):
    """Two sets of coordinates by one accessor, and two meshes by one accessor: only the map's data changes."""
    made = square(TEXCOORD_0=SQUARE[:, :2])
    first = made.tree["meshes"][0]["primitives"][0]
    first["attributes"]["TEXCOORD_1"] = shared = first["attributes"]["TEXCOORD_0"]
    made.mesh({"attributes": {"POSITION": made.accessor(SQUARE + 5), "TEXCOORD_0": shared}, "indices": 2})
    mesh = read(made, tmp_path)
    uv = 0.5 * mesh.V[:, :2]
    io.write_map(tmp_path / "out.glb", mesh, uv)
    data = (tmp_path / "out.glb").read_bytes()
    one, other = (shape["primitives"][0]["attributes"] for shape in opened(data)[0]["meshes"])
    np.testing.assert_array_equal(numbers(data, one["TEXCOORD_1"]), SQUARE[:, :2])
    for attributes, rows in ((one, uv[:4]), (other, uv[4:])):
        np.testing.assert_array_equal(
            numbers(data, attributes["TEXCOORD_0"]), np.column_stack([rows[:, 0], 1 - rows[:, 1]])
        )


def test_a_mesh_that_was_turned_over_keeps_the_data_of_its_file(tmp_path):
    made = square(TEXCOORD_0=SQUARE[:, :2], NORMAL=np.tile(np.float32([0, 0, 1]), (4, 1)))
    made.tree["materials"] = [{"name": "paint"}]
    made.tree["meshes"][0]["primitives"][0]["material"] = 0
    made.tree["nodes"] = [{"mesh": 0, "name": "here", "translation": [1, 2, 3]}]
    mesh = read(made, tmp_path)
    turned = mesh.turn_over()
    assert io.not_held("out.glb", turned) == []
    io.write_mapped(tmp_path / "out.glb", turned)
    again, data = io.read_mesh(tmp_path / "out.glb"), (tmp_path / "out.glb").read_bytes()
    np.testing.assert_array_equal(again.F, mesh.F[:, (0, 2, 1)])
    np.testing.assert_array_equal(again.corner_uv, mesh.corner_uv[:, (0, 2, 1)])
    tree = opened(data)[0]
    assert [tree[name] for name in ("materials", "nodes")] == [made.tree[name] for name in ("materials", "nodes")]
    normals = numbers(data, tree["meshes"][0]["primitives"][0]["attributes"]["NORMAL"])
    np.testing.assert_array_equal(normals, np.tile([0, 0, -1], (4, 1)))


def test_vertices_are_split_along_seams_with_all_attributes(tmp_path):
    colours = np.arange(12, dtype="u1").reshape(4, 3) * 10
    made = square(TEXCOORD_0=SQUARE[:, :2], COLOR_0=colours)
    primitive = made.tree["meshes"][0]["primitives"][0]
    made.tree["accessors"][primitive["attributes"]["COLOR_0"]]["normalized"] = True
    primitive["targets"] = [{"POSITION": made.accessor(SQUARE * np.float32(2))}]
    mesh = read(made, tmp_path)
    torn = io.seamed(mesh).cut([[0, 2]])
    places = [island.vertices[:, None] + np.array([[0.0, 0.5]]) + k for k, island in enumerate(torn.islands)]
    places = [np.where(np.isfinite(p), p, 0) for p in places]
    cut = mesh.with_places(torn.with_places(places))
    io.write_mapped(tmp_path / "torn.glb", cut)
    data = (tmp_path / "torn.glb").read_bytes()
    primitive = opened(data)[0]["meshes"][0]["primitives"][0]
    rows = numbers(data, primitive["indices"]).reshape(-1, 3)
    np.testing.assert_array_equal(numbers(data, primitive["attributes"]["POSITION"])[rows], SQUARE[HALVES])
    np.testing.assert_array_equal(numbers(data, primitive["targets"][0]["POSITION"])[rows], 2 * SQUARE[HALVES])
    assert len(numbers(data, primitive["attributes"]["TEXCOORD_0"])) == 6
    again = io.read_mesh(tmp_path / "torn.glb")
    np.testing.assert_array_equal(again.F, mesh.F)
    np.testing.assert_array_equal(again.V, mesh.V)
    np.testing.assert_array_equal(again.extra, mesh.extra)
    np.testing.assert_array_equal(again.vt[again.FT], cut.vt[cut.FT])
    assert len(io.seamed(again).islands) == 2


def test_number_formats(tmp_path):
    """Normalised integers, strides, sparse accessors, and primitives without indices."""
    made = Gltf()
    places = np.array([[0, 0], [65535, 0], [65535, 65535]], dtype="u2")
    rows = np.zeros((3, 5), dtype="f4")
    rows[:, :3], rows[:, 3:] = SQUARE[:3], 7
    view = made.view(rows.tobytes(), byteStride=20)
    made.tree["accessors"].append({"bufferView": view, "componentType": 5126, "count": 3, "type": "VEC3"})
    made.tree["accessors"].append(
        {
            "componentType": 5126,
            "count": 3,
            "type": "VEC3",
            "sparse": {
                "count": 1,
                "indices": {"bufferView": made.view(np.array([2], "u2").tobytes()), "componentType": 5123},
                "values": {"bufferView": made.view(np.array([[0, 0, 1]], "f4").tobytes())},
            },
        }
    )
    made.mesh({"attributes": {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": made.accessor(places, normalized=True)}})
    mesh = read(made, tmp_path, "mesh.gltf")
    np.testing.assert_array_equal(mesh.V, SQUARE[:3])
    np.testing.assert_array_equal(mesh.F, [[0, 1, 2]])
    np.testing.assert_array_equal(mesh.vt, [[0, 1], [1, 1], [1, 0]])
    assert mesh.normals == b"vn 0.0 0.0 0.0\nvn 0.0 0.0 0.0\nvn 0.0 0.0 1.0\n"
    # Written in single precision, they are still at the same positions.
    io.write_map(tmp_path / "out.gltf", mesh, mesh.vt)
    again = io.read_mesh(tmp_path / "out.gltf")
    np.testing.assert_array_equal(again.vt, mesh.vt)
    assert again.normals == mesh.normals


@pytest.mark.parametrize(("mode", "expected"), [(5, [[0, 1, 2], [1, 3, 2]]), (6, [[1, 2, 0], [2, 3, 0]])])
def test_strips_and_fans(mode, expected, tmp_path):
    made = Gltf()
    made.mesh({"attributes": {"POSITION": made.accessor(SQUARE)}, "mode": mode})
    np.testing.assert_array_equal(read(made, tmp_path).F, expected)


def test_several_meshes_in_a_scene(tmp_path):
    """Objects stay separate where they touch, and are placed by their nodes."""
    made = Gltf()
    shared = {"POSITION": made.accessor(SQUARE), "NORMAL": made.accessor(np.tile(np.array([[1, 0, 0]], "f4"), (4, 1)))}
    one, other = made.accessor(HALVES[0]), made.accessor(HALVES[1])
    made.mesh({"attributes": shared, "indices": one, "material": 1}, {"attributes": shared, "indices": other})
    made.mesh({"attributes": {"POSITION": made.accessor(SQUARE)}, "indices": one}, name="second\nf 1 2 3")
    turn = [0, 0, np.sqrt(0.5), np.sqrt(0.5)]
    made.tree |= {
        "nodes": [
            {"children": [1, 2], "translation": [0, 0, 5]},
            {"mesh": 0, "rotation": turn, "scale": [2, 2, 2]},
            {"mesh": 1},
            {"mesh": 1, "translation": [9, 9, 9]},
        ],
        "scenes": [{"nodes": [0, 3]}],
        "materials": [{}, {"name": "wood"}],
    }
    mesh = read(made, tmp_path)
    assert len(mesh.V) == 8
    np.testing.assert_allclose(mesh.V[:4], 2 * SQUARE[:, [1, 0, 2]] * [-1, 1, 1] + [0, 0, 5], atol=1e-15)
    np.testing.assert_array_equal(mesh.V[4:], SQUARE + np.array([0, 0, 5]))
    assert mesh.statements == b"usemtl wood\nusemtl -\no second f 1 2 3\n"
    np.testing.assert_array_equal(mesh.statement_faces, [0, 1, 2])
    np.testing.assert_allclose([float(x) for x in mesh.normals.split()[1:4]], [0, 1, 0], atol=1e-15)


def test_meshes_with_the_same_attributes_have_vertices_of_their_own(tmp_path):
    made = Gltf()
    shared, half = {"POSITION": made.accessor(SQUARE)}, made.accessor(HALVES[0])
    for _ in range(3):
        made.mesh({"attributes": shared, "indices": half})
    made.tree |= {
        "nodes": [{"mesh": 0}, {"mesh": 1, "translation": [9, 0, 0]}, {"mesh": 2}],
        "scenes": [{"nodes": [0, 1, 2]}],
    }
    mesh = read(made, tmp_path)
    np.testing.assert_array_equal(mesh.V, np.concatenate([SQUARE, SQUARE + np.array([9, 0, 0]), SQUARE]))
    np.testing.assert_array_equal(mesh.F, np.concatenate([HALVES[0], HALVES[0] + 4, HALVES[0] + 8]).reshape(-1, 3))
    np.testing.assert_array_equal(mesh.carried.number_meshes()[mesh.F], np.arange(3)[:, None].repeat(3, axis=1))
    io.write_mapped(
        tmp_path / "out.glb", replace(mesh, vt=np.random.default_rng(1).random((9, 2)), FT=np.arange(9).reshape(-1, 3))
    )
    written = io.read_mesh(tmp_path / "out.glb")
    np.testing.assert_array_equal(written.V[written.F], mesh.V[mesh.F])


def test_a_primitive_without_material_has_none_of_another(tmp_path):
    made = Gltf()
    shared = {"POSITION": made.accessor(SQUARE)}
    made.mesh(*({"attributes": shared, "indices": made.accessor(half)} for half in HALVES))
    made.tree["materials"] = [{"name": "wood"}]
    made.tree["meshes"][0]["primitives"][0]["material"] = 0
    mesh = read(made, tmp_path)
    label, names = label_materials(mesh)
    assert [names[k] for k in label] == ["wood", "-"]


def test_materials_of_equal_names_are_told_apart(tmp_path):
    made = Gltf()
    V, F = starfish(2, 12)
    table = {"POSITION": made.accessor(V.astype("f4"))}
    halves = F[: len(F) // 2], F[len(F) // 2 :]
    made.mesh(
        *(
            {"attributes": table, "indices": made.accessor(f.ravel().astype("u2")), "material": k}
            for k, f in enumerate(halves)
        )
    )
    made.tree["materials"] = [{"name": "same"}, {"name": "same"}]
    label, names = label_materials(read(made, tmp_path))
    assert [names[k] for k in (label[0], label[-1])] == ["same.0", "same.1"]


def test_a_new_file_has_materials_normals_and_colours(tmp_path):
    path = tmp_path / "in.obj"
    path.write_text(
        "v 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 1 1 0 0 0 1\nv 0 1 0 .5 .5 .5\nvt 0 0\nvt 1 0\nvt 1 1\n"
        "vn 0 0 1\nvn 0 1 0\nusemtl a\nf 1/1/1 2/2/1 3/3/1\nusemtl b\nf 1//1 3//2 4//1\n"
    )
    mesh = io.read_mesh(path)
    io.write_mapped(tmp_path / "out.glb", mesh)
    again = io.read_mesh(tmp_path / "out.glb")
    np.testing.assert_array_equal(again.V[again.F], mesh.V[mesh.F])
    np.testing.assert_array_equal(again.extra, mesh.extra)
    np.testing.assert_array_equal((again.FT < 0).all(axis=1), [False, True])
    np.testing.assert_array_equal(again.vt[again.FT[0]], mesh.vt)
    assert again.statements == b"usemtl a\nusemtl b\n"
    lines = np.array(again.normals.split(b"\n"))
    assert lines[again.FN].tolist() == np.array([b"vn 0.0 0.0 1.0", b"vn 0.0 1.0 0.0"])[mesh.FN].tolist()


def test_external_images_are_embedded(tmp_path):
    made = square(TEXCOORD_0=SQUARE[:, :2])
    made.tree["images"] = [{"uri": "photo%20one.png"}, {"uri": "../secret.png"}, {"uri": "notes.png"}]
    folder = tmp_path / "in"
    folder.mkdir()
    (folder / "photo one.png").write_bytes(b"\x89PNG of the photo")
    (folder / "notes.png").write_text("no picture")
    (tmp_path / "secret.png").write_bytes(b"\x89PNG a secret")
    mesh = read(made, folder, "mesh.gltf")
    losses = io.not_held("x.glb", mesh)
    io.write_mapped(tmp_path / "out.glb", mesh)
    data = (tmp_path / "out.glb").read_bytes()
    assert b"\x89PNG of the photo" in data
    assert b"a secret" not in data
    assert b"no picture" not in data
    assert len(losses) == 2
    assert "secret" in losses[0]


def test_single_precision_map_is_certified(tmp_path):
    """Triangles that are flat in single precision are reported as flat in the file."""
    V = np.array([[0, 0], [1, 0], [0.5, 1e-12], [0.5, 1]])
    F = np.array([[0, 1, 2], [0, 2, 3], [2, 1, 3]])
    io.write_map(tmp_path / "thin.glb", MeshData(V, F), V)
    again = io.read_mesh(tmp_path / "thin.glb")
    assert certify(F, V).injective
    np.testing.assert_array_equal(certify(again.F, io.map_of(again)).degenerate, [0])


def test_vertices_that_single_precision_merges_are_reported_before(tmp_path):
    """Two triangles that touch at a corner without sharing it, and one that is too small for single precision."""
    V = np.array([[0, 0], [1, 0], [0, 1], [0, 0], [-1, 0], [0, -1], [5, 5], [5 + 1e-9, 5], [5, 6.0]])
    mesh = MeshData(V, np.arange(9).reshape(3, 3))
    (digits, joined) = io.not_held("out.glb", mesh)
    assert digits.startswith("digits")
    assert joined.startswith("2 vertices at positions that coincide with others")
    io.write_map(tmp_path / "out.glb", mesh, V)
    assert len(io.read_mesh(tmp_path / "out.glb").V) == 7


def test_too_large_for_single_precision(tmp_path):
    V, F = cat(4)
    mesh = MeshData(V, F)
    with pytest.raises(ValueError, match="single precision"):
        io.write_map(tmp_path / "out.glb", mesh, 1e39 * V[:, :2])
    with pytest.raises(ValueError, match="single precision"):
        io.write_map(tmp_path / "out.glb", MeshData(1e39 * V, F), V[:, :2])
    assert not (tmp_path / "out.glb").exists()


def placed(tree, **node):
    tree.update(nodes=[{"mesh": 0, **node}], scenes=[{"nodes": [0]}])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda tree: tree["accessors"][0].update(count=10**15), "too short for its numbers"),
        (lambda tree: tree["accessors"][0].update(count=-1), "whole number"),
        (lambda tree: (tree["accessors"][0].update(count=10**15), tree["accessors"][0].pop("bufferView")), "no data"),
        (lambda tree: tree["accessors"][-1].update(count=4), "has 4 indices, not a multiple of 3"),
        (lambda tree: tree["bufferViews"][0].update(byteLength=10**9), "after the end of its buffer"),
        (lambda tree: tree["buffers"][0].update(byteLength=10**9), "shorter"),
        (lambda tree: tree["buffers"][0].update(uri="../../etc/passwd"), "not in the folder"),
        (lambda tree: tree["buffers"][0].update(uri="/etc/passwd"), "not in the folder"),
        (lambda tree: tree["buffers"][0].update(uri="http://example.org/x.bin"), "not in the folder"),
        (lambda tree: tree["buffers"][0].update(uri="gone.bin"), "no such file"),
        (lambda tree: tree["asset"].update(version="1.0"), "glTF 2.0"),
        (lambda tree: tree.update(extensionsUsed=["KHR_draco_mesh_compression"]), "without compression"),
        (lambda tree: tree.update(meshes=[]), "no triangles"),
        (lambda tree: tree.update(meshes=3), "meshes must be a list"),
        (lambda tree: tree.update(scenes=[{"nodes": [7]}]), "damaged"),
        (lambda tree: tree["meshes"][0]["primitives"][0].update(indices=99), "damaged"),
        (
            lambda tree: tree["meshes"][0]["primitives"][0]["attributes"].update(TEXCOORD_0=1),
            "different numbers of vertices",
        ),
        (
            lambda tree: tree["meshes"][0]["primitives"][0]["attributes"].update(TEXCOORD_0=0),
            "3 numbers for each vertex",
        ),
        (lambda tree: tree["meshes"][0]["primitives"][0].update(targets=[{"POSITION": 7}]), "damaged"),
        (lambda tree: tree.update(images=[3]), "images must be a list"),
        (
            lambda tree: tree["accessors"][0].update(type="MAT9"),
            "type of accessor 0 must be one of SCALAR, ",
        ),
        (lambda tree: placed(tree, matrix=[1]), "matrix of node 0 must have 16 numbers, not 1$"),
        (lambda tree: placed(tree, rotation=[0, 0, 1]), "rotation of node 0 must have 4 numbers, not 3$"),
        (lambda tree: placed(tree, scale=2), "scale of node 0 must have 3 numbers, not 2$"),
        (
            lambda tree: placed(tree, translation=[0, 0, "x"]),
            r"translation of node 0 .*, not \[0, 0, 'x'\]$",
        ),
    ],
)
def test_damaged_parts_are_named(change, message, tmp_path):
    made = square()
    tree = json.loads(made.gltf())
    change(tree)
    path = tmp_path / "bad.gltf"
    path.write_text(json.dumps(tree))
    with pytest.raises(MeshFileError, match=message):
        io.read_mesh(path)


def test_nodes_that_contain_themselves_and_deep_nesting(tmp_path):
    made = square()
    made.tree |= {"nodes": [{"children": [0, 1]}, {"mesh": 0, "children": [0]}], "scenes": [{"nodes": [0]}]}
    assert len(read(made, tmp_path).F) == 2
    (tmp_path / "deep.gltf").write_text("[" * 100_000)
    with pytest.raises(MeshFileError, match="not a glTF"):
        io.read_mesh(tmp_path / "deep.gltf")


def test_a_changed_mesh_is_written_as_a_new_file(tmp_path):
    mesh = read(square(TEXCOORD_0=SQUARE[:, :2]), tmp_path)
    fewer = replace(mesh, F=mesh.F[:1], FT=mesh.FT[:1])
    io.write_mapped(tmp_path / "out.glb", fewer)
    np.testing.assert_array_equal(io.read_mesh(tmp_path / "out.glb").F, [[0, 1, 2]])


def test_a_binary_file_without_its_json(tmp_path):
    data = square().glb()
    (tmp_path / "a.glb").write_bytes(data[:16] + b"XXXX" + data[20:])
    with pytest.raises(MeshFileError, match="it has no JSON chunk"):
        io.read_mesh(tmp_path / "a.glb")
