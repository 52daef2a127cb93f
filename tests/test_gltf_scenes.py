"""Scenes of glTF files: meshes that share data, and nodes that mirror or collapse their meshes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from quasiharmonic import io
from quasiharmonic.io import MeshFileError
from quasiharmonic.io.formats.gltf import document
from quasiharmonic.io.untrusted import use_bound
from quasiharmonic.surfaces import cat
from quasiharmonic.ui.cli import main
from shared.gltf_files import HALVES, SQUARE, Gltf, numbers, opened, square


def read(made, path, **options):
    path.write_bytes(made.glb())
    return io.read_gltf(path, **options)


def place(made, *nodes):
    """Put meshes into the scene, by their nodes."""
    made.tree |= {"nodes": list(nodes), "scenes": [{"nodes": list(range(len(nodes)))}]}
    return made


def write_cut(path, mesh):
    """Write a mesh with texture coordinates of its own at each corner."""
    F = mesh.F
    io.write_mapped(
        path, replace(mesh, vt=np.arange(2.0 * F.size).reshape(-1, 2), FT=np.arange(F.size).reshape(F.shape))
    )
    return path.read_bytes()


def test_meshes_may_share_their_data_within_the_bound_of_memory(tmp_path):
    made = place(square(), *({"mesh": 0, "translation": [2 * k, 0, 0]} for k in range(100)))
    mesh = read(made, tmp_path / "in.glb", instances="own")
    assert len(np.unique(mesh.V, axis=0)) == 400
    with use_bound(100_000), pytest.raises(MeshFileError, match="repeat the same data, and need"):
        io.read_gltf(tmp_path / "in.glb", instances="own")


@pytest.mark.parametrize("mode", [0, 3])
def test_points_and_lines_that_share_vertices_stay_valid(tmp_path, mode):
    made = square()
    triangles = made.tree["meshes"][0]["primitives"][0]
    colours = made.accessor(SQUARE[:, :3])
    attributes = {"POSITION": triangles["attributes"]["POSITION"], "COLOR_0": colours}
    made.tree["meshes"][0]["primitives"].append({"attributes": attributes, "mode": mode})
    data = write_cut(tmp_path / "out.glb", read(made, tmp_path / "in.glb"))
    cut, other = (one["attributes"] for one in opened(data)[0]["meshes"][0]["primitives"])
    assert len(numbers(data, cut["POSITION"])) == len(numbers(data, cut["TEXCOORD_0"])) == 6
    np.testing.assert_array_equal(numbers(data, other["POSITION"]), SQUARE)
    np.testing.assert_array_equal(numbers(data, other["COLOR_0"]), SQUARE)


def test_a_mirrored_mesh_faces_outwards_and_its_triangles_stay_in_the_file(tmp_path):
    V, F = cat(4)
    made = Gltf()
    normals = np.tile(np.array([[0, 0, 1]], "f4"), (len(V), 1))
    attributes = {"POSITION": made.accessor(V.astype("f4")), "NORMAL": made.accessor(normals)}
    made.mesh({"attributes": attributes, "indices": made.accessor(F.ravel().astype("u2"))})
    mesh = read(place(made, {"mesh": 0, "scale": [1, 1, -2]}), tmp_path / "in.glb")
    np.testing.assert_array_equal(mesh.F, F[:, [0, 2, 1]])
    assert {float(line.split()[3]) for line in mesh.normals.splitlines()} == {-1}
    data = write_cut(tmp_path / "out.glb", mesh)
    (primitive,) = opened(data)[0]["meshes"][0]["primitives"]
    rows = numbers(data, primitive["indices"]).reshape(-1, 3)
    np.testing.assert_array_equal(numbers(data, primitive["attributes"]["POSITION"])[rows], V.astype("f4")[F])
    again = io.read_mesh(tmp_path / "out.glb")
    np.testing.assert_array_equal(again.F, mesh.F)
    np.testing.assert_array_equal(again.corner_uv.ravel(), np.arange(2.0 * F.size))


def flat_cat(node):
    """A curved mesh below a node of scale 0.5."""
    V, F = cat(4)
    made = Gltf()
    made.mesh(
        {"attributes": {"POSITION": made.accessor(V.astype("f4"))}, "indices": made.accessor(F.ravel().astype("u2"))}
    )
    made.tree |= {"nodes": [{"children": [1], "scale": [0.5, 0.5, 0.5]}, {"mesh": 0, **node}]}
    made.tree["scenes"] = [{"nodes": [0]}]
    return made, V.astype("f4"), F


@pytest.mark.parametrize(
    ("node", "size"),
    [
        ({"scale": [0, 0, 0]}, [1, 1, 1]),
        ({"scale": [0, 0, 3]}, [3, 3, 3]),
        ({"scale": [3, 3, 0]}, [3, 3, 3]),
        ({"scale": [0, 2, 3]}, [3, 2, 3]),
        ({"scale": [1, 0, -1]}, [1, -1, -1]),
        ({"matrix": [0, 2, 0, 0, -3, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1]}, [3, 2, 3]),
    ],
)
def test_scales_of_zero_are_replaced_by_the_largest_and_those_of_parents_stay(tmp_path, node, size):
    made, V, F = flat_cat(node)
    mesh = read(made, tmp_path / "in.glb")
    if "matrix" in node:  # A rotation by 90 degrees, and scales of 2 and 3.
        V, size = V[:, [1, 0, 2]], [-3, 2, 3]
    np.testing.assert_allclose(mesh.V, 0.5 * V * np.array(size), atol=1e-12)
    np.testing.assert_array_equal(mesh.F, F)


def test_of_equal_occurrences_one_that_is_not_mirrored_counts(tmp_path):
    nodes = [{"mesh": 0, "scale": scale} for scale in ([-1, 1, 1], [1, 1, 1], [1, -1, 1], [0, 5, 5])]
    np.testing.assert_array_equal(read(place(square(), *nodes), tmp_path / "in.glb").V, SQUARE)
    nodes[2]["scale"] = [1, -1, 1.01]
    np.testing.assert_array_equal(read(place(square(), *nodes), tmp_path / "in.glb").V, SQUARE * [1, -1, 1])


def test_infinite_numbers_of_nodes_are_named(tmp_path):
    made = place(square(), {"mesh": 0, "scale": [777777, 1, 1]})
    (tmp_path / "in.gltf").write_bytes(made.gltf().replace(b"777777", b"1e999"))
    with pytest.raises(MeshFileError, match=r"scale of node 0 must have 3 numbers, not \[inf, 1, 1\]$"):
        io.read_gltf(tmp_path / "in.gltf")


def test_the_least_integer_of_normals_is_reversed(tmp_path):
    made = square()
    (primitive,) = made.tree["meshes"][0]["primitives"]
    normals = np.array([[0, 0, -128], [0, 0, -127], [0, 0, 127], [0, 90, -90]], "i1")
    primitive["attributes"]["NORMAL"] = made.accessor(normals, normalized=True)
    mesh = read(made, tmp_path / "in.glb")
    write_cut(tmp_path / "out.glb", mesh.turn_over())
    before, after = (
        np.array([line.split()[1:] for line in one.normals.splitlines()], float)
        for one in (mesh, io.read_gltf(tmp_path / "out.glb"))
    )
    np.testing.assert_array_equal(after[:4], -before)


def test_instances_of_an_extension_in_a_lightmap_are_reported(tmp_path, capsys):
    name = "EXT_mesh_gpu_instancing"
    made = square()
    place(made, {"mesh": 0, "extensions": {name: {"attributes": {"TRANSLATION": 0}}}})
    made.tree["extensionsUsed"] = [name]
    (tmp_path / "in.glb").write_bytes(made.glb())
    command = ["unwrap", str(tmp_path / "in.glb"), "--resolution", "64", "-o"]
    assert main([*command, str(tmp_path / "out.glb"), "--lightmap"]) == 0
    assert f"instances of {name} share their texture coordinates" in capsys.readouterr().err
    assert main([*command, str(tmp_path / "out.glb")]) == 0
    assert name not in capsys.readouterr().err
    assert main([*command, str(tmp_path / "out.ply")]) == 0
    assert f"will not have: instances of {name}" in capsys.readouterr().err


def test_the_work_to_write_grows_with_the_number_of_meshes(tmp_path, monkeypatch):
    calls = []
    find_objects = document.find_objects
    monkeypatch.setattr(document, "find_objects", lambda *given: calls.append(1) or find_objects(*given))
    numbers_of_calls = []
    for count in (20, 40):
        made = Gltf()
        for _ in range(count):
            attributes = {"POSITION": made.accessor(SQUARE), "TEXCOORD_0": made.accessor(SQUARE[:, :2])}
            made.mesh({"attributes": attributes, "indices": made.accessor(HALVES.ravel())})
        mesh = read(made, tmp_path / "in.glb")
        calls.clear()
        write_cut(tmp_path / "out.glb", mesh)
        numbers_of_calls.append(len(calls))
    assert numbers_of_calls[1] < 3 * numbers_of_calls[0]


def test_meshes_that_share_a_view_get_views_of_their_own_except_one(tmp_path):
    """Only views that something else refers to are added."""
    made = Gltf()
    table = made.accessor(SQUARE), made.accessor(SQUARE[:, :2])
    half = made.accessor(HALVES[0])
    for _ in range(3):
        made.tree["accessors"].append(dict(made.tree["accessors"][table[1]]))
        last = len(made.tree["accessors"]) - 1
        made.mesh({"attributes": {"POSITION": table[0], "TEXCOORD_0": last}, "indices": half})
    made.tree["accessors"][table[1]] = dict(made.tree["accessors"][table[0]])
    mesh = read(made, tmp_path / "in.glb")
    data = write_cut(tmp_path / "out.glb", mesh)
    tree = opened(data)[0]
    assert len(tree["bufferViews"]) == len(made.tree["bufferViews"]) + 2
    np.testing.assert_array_equal(io.read_mesh(tmp_path / "out.glb").corner_uv.ravel(), np.arange(18.0))
