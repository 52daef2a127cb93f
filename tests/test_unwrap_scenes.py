"""Several meshes in one texture: lists, scenes of trimesh, and glTF files with several meshes."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest

import hard_models as models
from quasiharmonic import io, unwrap
from quasiharmonic.ui.cli import main

trimesh = pytest.importorskip("trimesh")
BOX, TUBE = models.box(), models.tube(12)
MIRROR = np.diag([-2.0, 2, 2, 1])
SQUEEZE = np.diag([0.5, 1, 1, 1])


def make_mesh(mesh):
    return trimesh.Trimesh(*mesh, process=False)


def make_scene():
    """Two meshes at three nodes: a box, its mirror image of twice the size, and a tube that is squeezed."""
    scene = trimesh.Scene()
    box = make_mesh(BOX)
    box.vertex_attributes["heat"] = np.arange(8.0)
    box.visual.vertex_colors = np.arange(32, dtype=np.uint8).reshape(8, 4)
    scene.add_geometry(box, node_name="near", geom_name="box")
    scene.graph.update(frame_to="far", geometry="box", matrix=MIRROR)
    scene.add_geometry(make_mesh(TUBE), node_name="pipe", geom_name="tube", transform=SQUEEZE)
    return scene


def texel_areas(part, size=2048):
    z = part.uvs[part.indices] @ [size, 1j * size]
    return ((z[:, 1] - z[:, 0]).conj() * (z[:, 2] - z[:, 0])).imag / 2


def model_areas(V, F):
    P = V[F]
    return np.linalg.norm(np.cross(P[:, 1] - P[:, 0], P[:, 2] - P[:, 0]), axis=1) / 2


def test_a_list_of_meshes_has_one_texture_and_keeps_their_numbering():
    result = unwrap([BOX, make_mesh(TUBE), {"vertices": BOX[0] + 9, "faces": BOX[1]}])
    assert result.certificate.bijective
    assert [part.name for part in result.parts] == ["0", "1", "2"]
    for (V, F), part in zip([BOX, TUBE, BOX], result.parts, strict=True):
        vmapping, indices, uvs = part
        np.testing.assert_array_equal(vmapping[indices], F)
        np.testing.assert_allclose(texel_areas(part), result.atlas.texels_per_unit**2 * model_areas(V, F), rtol=1e-3)
        assert uvs.min() >= 0
        assert uvs.max() <= 1
    # The charts of different meshes differ.
    assert not {*result.parts[0].charts} & {*result.parts[2].charts}
    assert [part["charts"] for part in result.to_dict()["parts"]] == [len({*part.charts}) for part in result.parts]


def test_meshes_at_the_same_place_are_not_joined():
    result = unwrap([BOX, (BOX[0].copy(), BOX[1])], resolution=256)
    assert result.atlas.cleaned.excluded.size == 0
    assert not {*result.parts[0].charts} & {*result.parts[1].charts}


@pytest.mark.parametrize("weld", [True, 1e-3])
def test_vertices_of_different_meshes_are_not_welded(weld):
    V, F = np.concatenate([BOX[0], BOX[0]]), np.concatenate([BOX[1], BOX[1] + 8])
    assert unwrap(V, F, weld=weld, resolution=256).cleaned.excluded.size == 12
    apart = unwrap(V, F, weld=weld, resolution=256, meshes=np.repeat([0, 1], 8))
    assert apart.cleaned.excluded.size == 0
    assert apart.certificate.bijective


def test_a_mesh_that_is_twice_in_a_list_shares_its_place_or_not():
    shared = unwrap([BOX, TUBE, BOX])
    np.testing.assert_array_equal(shared.parts[0].uvs, shared.parts[2].uvs)
    own = unwrap([BOX, TUBE, BOX], instances="own")
    assert not {*own.parts[0].charts} & {*own.parts[2].charts}


def test_weights_scale_the_density():
    result = unwrap([BOX, TUBE], weights=[1, 3])
    one, other = (part.texels_per_unit for part in result.parts)
    assert other == pytest.approx(3 * one)
    areas = texel_areas(result.parts[1]) / model_areas(*TUBE)
    np.testing.assert_allclose(areas, other**2, rtol=1e-3)


@pytest.mark.parametrize("instances", ["share", "own"])
def test_transformations_of_a_scene_scale_the_density(instances):
    scene = make_scene()
    result = unwrap(scene, instances=instances)
    assert result.certificate.bijective
    density = result.atlas.texels_per_unit
    places = [MIRROR, SQUEEZE] if instances == "share" else [np.eye(4), MIRROR, SQUEEZE]
    for part, place in zip(result.parts, places, strict=True):
        expected = density**2 * model_areas(part.V @ place[:3, :3].T, part.vmapping[part.indices])
        # Charts are not mirrored in the scene, where a reflection reverses triangles.
        np.testing.assert_allclose(texel_areas(part) * np.sign(np.linalg.det(place)), expected, rtol=1e-3)
        assert part.texels_per_unit == pytest.approx(density * abs(np.linalg.det(place[:3, :3])) ** (1 / 3))


@pytest.mark.parametrize("instances", ["share", "own"])
def test_scenes_come_back_with_their_nodes_and_attributes(instances):
    scene = make_scene()
    before = scene.copy()
    again = unwrap(scene, instances=instances).to_scene()
    assert set(scene.geometry) == set(before.geometry)
    assert set(again.graph.nodes_geometry) == set(scene.graph.nodes_geometry)
    for node in scene.graph.nodes_geometry:
        (matrix, old), (same, new) = scene.graph[node], again.graph[node]
        np.testing.assert_array_equal(matrix, same)
        one, other = scene.geometry[old], again.geometry[new]
        np.testing.assert_array_equal(one.vertices[one.faces], other.vertices[other.faces])
        assert other.visual.uv.shape == (len(other.vertices), 2)
        if old == "box":
            np.testing.assert_array_equal(
                other.vertex_attributes["heat"][other.faces], one.vertex_attributes["heat"][one.faces]
            )
            colours = other.visual.vertex_attributes["color"]
            np.testing.assert_array_equal(colours[other.faces], one.visual.vertex_colors[one.faces])
    assert len({again.graph[node][1] for node in ("near", "far")}) == (1 if instances == "share" else 2)
    with pytest.raises(ValueError, match="from a list"):
        unwrap([BOX]).to_scene()


def test_one_mesh_of_trimesh_keeps_its_attributes():
    box = make_scene().geometry["box"]
    made = unwrap(box, resolution=256).to_trimesh()
    np.testing.assert_array_equal(made.vertex_attributes["heat"][made.faces], np.arange(8.0)[BOX[1]])
    assert unwrap(*BOX, resolution=256).source is None


def no_inverse():
    scene = make_scene()
    scene.graph.update(frame_to="pipe", geometry="tube", matrix=np.diag([0.0, 1, 1, 1]))
    return scene


@pytest.mark.parametrize(
    ("given", "options", "message"),
    [
        (lambda: [BOX], {"weights": [1, 2]}, "weights must have 1 number, one per mesh, not 2"),
        (lambda: [BOX, BOX], {"weights": [1, -1]}, "mesh 1: weights must be positive"),
        (lambda: [BOX, (BOX[0], BOX[1] + 7)], {}, "mesh 1: F refers to vert"),
        (lambda: [BOX], {"instances": "all"}, "instances must be one of share, own, not 'all'"),
        (make_scene, {"weights": {"ball": 2}}, "weights names 'ball', which is no mesh of the scene: box, tube"),
        (trimesh.Scene, {}, "the scene has no meshes"),
        (no_inverse, {}, "the transformation of node 'pipe' has no inverse"),
        (lambda: make_mesh(BOX), {"instances": "own"}, "instances='own' needs several meshes"),
        (lambda: make_mesh(BOX), {"weights": [2]}, "weights needs several meshes"),
        (lambda: make_mesh(BOX), {"meshes": [0]}, "meshes must have shape \\(8,\\), one for each vertex"),
    ],
)
def test_wrong_calls(given, options, message):
    with pytest.raises(ValueError, match=message):
        unwrap(given(), **options)


def write_scene(path):
    path.write_bytes(make_scene().export(file_type="glb"))
    return path


def tree_of(path):
    data = path.read_bytes()
    return json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])


@pytest.mark.parametrize("instances", ["share", "own"])
def test_files_with_instances(tmp_path, instances):
    source, out = write_scene(tmp_path / "in.glb"), tmp_path / "out.glb"
    assert main(["unwrap", str(source), "--instances", instances, "-o", str(out)]) == 0
    before, after = tree_of(source), tree_of(out)
    assert len(after["meshes"]) == (2 if instances == "share" else 3)
    for old, new in zip(before["nodes"], after["nodes"], strict=True):
        assert {**old, "mesh": None} == {**new, "mesh": None}
    read = io.read_mesh(out)
    assert np.isfinite(read.corner_uv).all()
    meshes = read.carried.number_meshes()
    assert len({*meshes}) == len(after["meshes"])
    # A path and the contents of a file are unwrapped like that, too.
    assert unwrap(read).n_charts == unwrap(out).n_charts


@pytest.mark.parametrize("scale", [0, 0.1])
def test_instances_of_a_file_have_the_density_of_the_largest(tmp_path, scale):
    scene = trimesh.Scene()
    scene.add_geometry(make_mesh(BOX), node_name="small", geom_name="box", transform=np.diag([scale] * 3 + [1]))
    scene.graph.update(frame_to="large", geometry="box", matrix=np.diag([3.0, 3, 3, 1]))
    scene.export(tmp_path / "in.glb")
    assert main(["unwrap", str(tmp_path / "in.glb"), "-o", str(tmp_path / "out.glb"), "--resolution", "512"]) == 0
    read = io.read_mesh(tmp_path / "out.glb")
    np.testing.assert_allclose(np.ptp(read.V, axis=0), 3 * np.ptp(BOX[0], axis=0), rtol=1e-6)


@pytest.mark.parametrize(
    ("options", "words"),
    [(["--instances", "own"], "has no instances"), (["--instances", "none"], "invalid choice")],
)
def test_files_without_instances(tmp_path, capsys, options, words):
    io.write_mapped(tmp_path / "in.obj", io.MeshData(*BOX))
    with pytest.raises(SystemExit) if "none" in options else pytest.MonkeyPatch.context():
        assert main(["unwrap", str(tmp_path / "in.obj"), *options, "-o", str(tmp_path / "out.obj")]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--lightmap", "--texture", "checkerboard"), "omit --texture or --lightmap"),
        (("--instances", "own", "--texture", "checkerboard"), "omit --texture or --instances"),
        (("--lightmap", "--instances", "share"), "omit --instances share"),
        (("--tile-by", "material"), "the file has no materials: omit --tile-by"),
    ],
)
def test_options_that_exclude_each_other_are_named(tmp_path, capsys, words, message):
    source = write_scene(tmp_path / "in.glb")
    assert main(["unwrap", str(source), *words, "-o", str(tmp_path / "out.glb")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out.glb").exists()


@pytest.mark.parametrize("count", [100, pytest.param(1000, marks=pytest.mark.nightly)])
def test_many_small_meshes(count):
    half = count // 2
    meshes = [models.box(1, 1 + k / count, 1) for k in range(half)] + [
        models.tube(8, length=1 + k / half) for k in range(half)
    ]
    result = unwrap(meshes, instances="own")
    assert result.certificate.bijective
    assert len(result.parts) == count
    assert result.seconds < 0.06 * count


@pytest.mark.parametrize(
    ("given", "options", "message"),
    [
        (list, {}, "the list has no meshes"),
        (
            lambda: [BOX],
            {"tile_by": "materials"},
            "not 'materials'; did you mean material",
        ),
        (lambda: [BOX], {"weights": 3}, "weights must be a sequence with a number per mesh, not 3"),
        (make_scene, {"weights": [1, 2]}, "weights must be a mapping from names of meshes to numbers"),
    ],
)
def test_wrong_kinds_of_lists_and_weights(given, options, message):
    with pytest.raises(ValueError, match=message):
        unwrap(given(), **options)


def test_different_materials_of_one_name_have_tiles_of_their_own():
    material = trimesh.visual.material.SimpleMaterial
    red, green, red_again = (material(diffuse=colour) for colour in ([255, 0, 0], [0, 255, 0], [255, 0, 0]))
    meshes = []
    for one in (red, green, red_again):
        mesh = make_mesh(BOX)
        mesh.visual = trimesh.visual.TextureVisuals(uv=np.zeros((len(mesh.vertices), 2)), material=one)
        meshes.append(mesh)
    tiles = [set(np.floor(part.uvs[:, 0])) for part in unwrap(meshes, tile_by="material").parts]
    assert tiles == [{0.0}, {1.0}, {0.0}]
    with pytest.raises(ValueError, match="there are no materials"):
        unwrap([make_mesh(BOX)], tile_by="material")


@pytest.mark.slow
def test_a_padding_beyond_the_texture_is_refused():
    with pytest.raises(ValueError, match="do not fit into a lightmap"):
        unwrap(*BOX, lightmap=True, padding=1e6)


def test_other_formats_name_the_occurrences_that_they_lose(tmp_path):
    mesh = io.read_mesh(write_scene(tmp_path / "in.glb"))
    assert "1 further occurrence of meshes in the scene" in io.not_held(tmp_path / "out.obj", mesh)
    assert "1 further occurrence of meshes in the scene" in io.not_held(tmp_path / "out.ply", mesh)
    assert not io.not_held(tmp_path / "out.glb", mesh)


def test_of_equal_nodes_one_that_is_not_mirrored_counts():
    scene = trimesh.Scene()
    scene.add_geometry(make_mesh(TUBE), node_name="left", geom_name="tube", transform=np.diag([-1.0, 1, 1, 1]))
    scene.graph.update(frame_to="right", geometry="tube", matrix=np.eye(4))
    assert (texel_areas(unwrap(scene, resolution=256).parts[0]) > 0).all()


def test_given_coordinates_of_corners_belong_to_the_corners_of_the_meshes():
    scene = trimesh.Scene()
    scene.add_geometry(make_mesh(TUBE), transform=np.diag([-1.0, 1, 1, 1]))
    (part,) = unwrap(scene, resolution=256).parts
    corners = part.uvs[part.indices]
    (again,) = unwrap(scene, uv=corners, resolution=256).parts
    np.testing.assert_array_equal(again.charts, part.charts)
    lengths = [np.linalg.norm(uv - np.roll(uv, 1, axis=1), axis=2) for uv in (corners, again.uvs[again.indices])]
    np.testing.assert_allclose(*lengths, rtol=0.1)


def test_each_part_has_its_inverse():
    V, F = BOX
    broken = V, np.vstack([F, F[:1]])
    result = unwrap([TUBE, broken], resolution=256)
    for (points, triangles), part in zip([TUBE, broken], result.parts, strict=True):
        middle = part.uvs[part.indices].mean(axis=1)[: len(triangles) - (part.excluded.size or 0)]
        inverse = part.inverse()
        np.testing.assert_allclose(
            inverse.surface(inverse.locate(middle)), points[triangles[: len(middle)]].mean(axis=1), atol=1e-6
        )
    assert result.parts[1].excluded.tolist() == [len(F)]


def test_new_meshes_do_not_replace_others_with_their_names():
    scene, small, large = trimesh.Scene(), trimesh.creation.box(), trimesh.creation.box((9, 9, 9))
    scene.add_geometry(small, geom_name="crate", node_name="a")
    scene.graph.update(frame_to="b", geometry="crate")
    scene.add_geometry(large, geom_name="crate a", node_name="c")
    done = unwrap(scene, instances="own", resolution=128).to_scene()
    extents = {node: done.geometry[done.graph[node][1]].extents.max() for node in "abc"}
    assert extents == {"a": 1, "b": 1, "c": 9}
