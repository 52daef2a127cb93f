"""GIFTI files, FreeSurfer's surfaces and patches, and nibabel's objects as meshes."""

from __future__ import annotations

import struct
import sys

import numpy as np
import pytest

from quasiharmonic import atlas, certify, flatten, io
from quasiharmonic.surfaces import cat, grid, starfish
from quasiharmonic.ui.cli import main

NEEDED = "no dependency of the tests: .ci/optional installs it"


def sphere_with_patch(folder):
    """Write a closed surface ``lh.inflated`` and a patch of it; return the surface and the patch's vertices."""
    geometry = pytest.importorskip("nibabel", reason=NEEDED).freesurfer
    V, F = starfish(rings=5)
    V = V.astype(np.float32).astype(float)
    geometry.write_geometry(str(folder / "lh.inflated"), V, F)
    inside = np.flatnonzero(V[:, 2] > 0)
    inside = np.union1d(inside, F[np.isin(F, inside).all(axis=1)])
    # By the documented layout: -1, the count, then for each vertex its number from 1 and three floats, big-endian.
    data = struct.pack(">ii", -1, len(inside))
    (folder / "lh.half.patch.3d").write_bytes(
        data + b"".join(struct.pack(">ifff", number + 1, *V[number]) for number in inside)
    )
    return V, F, inside


def parse_patch(path):
    """Read a binary patch by the documented layout; return signed numbers from 1 and positions."""
    data = path.read_bytes()
    mark, count = struct.unpack_from(">ii", data)
    assert mark == -1
    assert len(data) == 8 + 16 * count
    rows = [struct.unpack_from(">ifff", data, 8 + 16 * k) for k in range(count)]
    return np.array([row[0] for row in rows]), np.array([row[1:] for row in rows])


def test_a_patch_is_flattened_by_the_command(tmp_path, capsys):
    V, F, inside = sphere_with_patch(tmp_path)
    patch, flat = tmp_path / "lh.half.patch.3d", tmp_path / "lh.half.flat.patch.3d"
    read = io.read_mesh(patch)
    triangles = F[np.isin(F, inside).all(axis=1)]
    np.testing.assert_array_equal(read.F, triangles)
    np.testing.assert_array_equal(read.V[inside], V[inside])
    assert main(["flatten", str(patch), "-o", str(flat)]) == 0
    out = capsys.readouterr().out
    assert "Bijective" in out
    # The distortion is measured against the surface, which the file does not contain.
    assert "maximum stretch 1\n" not in out
    numbers, places = parse_patch(flat)
    np.testing.assert_array_equal(np.abs(numbers) - 1, np.unique(triangles))
    sides = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges, uses = np.unique(sides, axis=0, return_counts=True)
    np.testing.assert_array_equal(np.sort(-numbers[numbers < 0] - 1), np.unique(edges[uses == 1]))
    uv = np.zeros((len(V), 2))
    uv[np.abs(numbers) - 1] = places[:, :2]
    assert certify(triangles, uv).bijective
    assert not places[:, 2].any()
    assert main(["check", str(flat)]) == 0


@pytest.mark.slow
def test_a_patch_needs_its_surface(tmp_path, capsys):
    sphere_with_patch(tmp_path)
    patch = tmp_path / "lh.half.patch.3d"
    surface = (tmp_path / "lh.inflated").rename(tmp_path / "elsewhere.surf")
    assert main(["check", str(patch)]) == 2
    assert "no surface of the same hemisphere" in capsys.readouterr().err
    assert main(["flatten", str(patch), "--surface", str(surface), "-o", str(tmp_path / "lh.flat.patch.3d")]) == 0
    assert len(io.read_patch(patch, surface).F) == len(io.read_patch(tmp_path / "lh.flat.patch.3d", surface).F)
    # The option holds for one command.
    with pytest.raises(io.MeshFileError, match="no surface"):
        io.read_mesh(patch)
    assert "the list of triangles" in capsys.readouterr().err
    # A patch without a surface beside it is verified by the triangles that were mapped.
    assert main(["flatten", str(surface), "--cut", "-o", str(tmp_path / "rh.flat.patch.3d")]) == 0
    small = tmp_path / "small.off"
    small.write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    with pytest.raises(io.MeshFileError, match="has 3 vertices"):
        io.read_patch(patch, small)


@pytest.mark.slow
def test_a_closed_surface_is_cut_where_vertices_are_left_out(tmp_path, capsys):
    _, F, _ = sphere_with_patch(tmp_path)
    assert main(["flatten", str(tmp_path / "lh.inflated"), "-o", str(tmp_path / "lh.flat.gii")]) == 2
    assert "closed" in capsys.readouterr().err
    written = []
    for name in "lh.flat.gii", "lh.flat.gii.gz", "lh.flat", "lh.flat.patch.3d":
        assert main(["flatten", str(tmp_path / "lh.inflated"), "--cut", "-o", str(tmp_path / name)]) == 0
        assert "on seams" in capsys.readouterr().err
        written.append(io.read_mesh(tmp_path / name))
    for mesh in written:
        np.testing.assert_array_equal(mesh.F, written[0].F)
        np.testing.assert_array_equal(mesh.V[mesh.F], written[0].V[mesh.F])
        assert certify(mesh.F, mesh.V[:, :2]).bijective
    kept = {tuple(row) for row in written[0].F.tolist()}
    assert kept < {tuple(row) for row in F.tolist()}


def test_patches_in_text_are_read(tmp_path):
    path = tmp_path / "lh.x.patch.asc"
    rows = [(1, 0, 0), (4, 1, 0), (3, 0, 1)]
    text = "#!ascii version of patch lh.orig. The 1st index is not a vertex number\n3 1\n"
    text += "".join(f"{-n} vno={n - 1}\n{x}  {y}  0.5\n" for n, x, y in rows)
    path.write_text(text + "7\n0 3 2 \n")
    mesh = io.read_mesh(path)
    np.testing.assert_array_equal(mesh.F, [[0, 3, 2]])
    np.testing.assert_array_equal(mesh.V, [[0, 0, 0.5], [0, 0, 0], [0, 1, 0.5], [1, 0, 0.5]])
    for bad in (text, text + "7\n0 3 1\n", text + "7\n0 3 x\n"):
        path.write_text(bad)
        with pytest.raises(io.MeshFileError, match="is not a text patch"):
            io.read_mesh(path)


@pytest.mark.parametrize("name", ["lh.flat.gii", "lh.flat.gii.gz"])
def test_nibabel_reads_what_was_written(name, tmp_path):
    nibabel = pytest.importorskip("nibabel", reason=NEEDED)
    V, F = cat(6)
    io.write_map(tmp_path / name, io.MeshData(V, F), flatten(V, F).uv)
    image = nibabel.load(tmp_path / name)
    points, triangles = image.agg_data()
    np.testing.assert_array_equal(triangles, F)
    assert points.dtype == np.float32
    assert certify(triangles, points[:, :2]).bijective
    meta = image.darrays[0].metadata
    assert meta["AnatomicalStructurePrimary"] == "CortexLeft"
    assert meta["GeometricType"] == "Flat"


def test_labels_are_not_interpolated(tmp_path, monkeypatch):
    gifti = pytest.importorskip("nibabel", reason=NEEDED).gifti
    monkeypatch.chdir(tmp_path)
    (a, F), (b, G) = grid(4, 5), grid(7, 3)
    io.write_map("a.obj", io.MeshData(a, F), a)
    io.write_map("b.obj", io.MeshData(b, G), b)
    labels = (np.arange(len(a)) % 3 * 100).astype(np.int32)
    np.savetxt("v.csv", labels)
    for name, intent in (("v.label.gii", "NIFTI_INTENT_LABEL"), ("v.func.gii", "NIFTI_INTENT_NONE")):
        gifti.GiftiImage(darrays=[gifti.GiftiDataArray(labels, intent)]).to_filename(name)
    for more, whole in (("v.label.gii", True), ("v.csv", False), ("v.csv --nearest", True), ("v.func.gii", False)):
        name, *option = more.split()
        assert main(["transfer", "a.obj", "b.obj", "--values", name, "out.csv", *option]) == 0
        assert np.isin(np.loadtxt("out.csv"), labels).all() == whole
    assert main(["transfer", "a.obj", "b.obj", "-o", "c.obj", "--nearest"]) == 2


@pytest.mark.parametrize("where", ["file", "points"])
def test_the_hemisphere_of_the_input_is_kept(where, tmp_path):
    gifti = pytest.importorskip("nibabel", reason=NEEDED).gifti
    V, F = grid(3, 3)
    about = {"AnatomicalStructurePrimary": "CortexLeft"}
    arrays = [
        gifti.GiftiDataArray(np.column_stack([V, 0 * V[:, 0]]).astype(np.float32), "NIFTI_INTENT_POINTSET"),
        gifti.GiftiDataArray(F.astype(np.int32), "NIFTI_INTENT_TRIANGLE"),
    ]
    image = gifti.GiftiImage(darrays=arrays)
    (image if where == "file" else arrays[0]).meta.update(about)
    image.to_filename(tmp_path / "100307.L.pial.surf.gii")
    for name, mesh, expected in (
        ("100307.L.flat.gii", io.read_mesh(tmp_path / "100307.L.pial.surf.gii"), "CortexLeft"),
        ("rhea_flat.gii", io.read_mesh(tmp_path / "100307.L.pial.surf.gii"), "CortexLeft"),
        ("rhea_flat.gii", io.MeshData(V, F), None),
        ("rh.flat.gii", io.MeshData(V, F), "CortexRight"),
        ("flat.gii", io.MeshData(V, F, source="x/LH.pial"), "CortexLeft"),
    ):
        io.write_map(tmp_path / name, mesh, V)
        written = gifti.GiftiImage.from_filename(tmp_path / name)
        assert written.darrays[0].meta.get("AnatomicalStructurePrimary") == expected
    assert io.not_held("a.glb", io.read_mesh(tmp_path / "100307.L.flat.gii")) == []


def test_objects_of_nibabel_are_meshes(tmp_path):
    nibabel = pytest.importorskip("nibabel", reason=NEEDED)
    V, F = cat(6)
    V, F = V.astype(np.float32), F.astype(np.int32)
    expected = flatten(V, F).uv
    gifti = nibabel.gifti
    arrays = (
        gifti.GiftiDataArray(V, "NIFTI_INTENT_POINTSET"),
        gifti.GiftiDataArray(F, "NIFTI_INTENT_TRIANGLE"),
    )
    image = gifti.GiftiImage(darrays=list(arrays))
    nibabel.freesurfer.write_geometry(str(tmp_path / "lh.x"), V, F)
    for mesh in (
        image,
        image.agg_data(),
        nibabel.freesurfer.read_geometry(str(tmp_path / "lh.x")),
        nibabel.freesurfer.read_geometry(str(tmp_path / "lh.x"), read_stamp=True),
        tmp_path / "lh.x",
    ):
        np.testing.assert_array_equal(flatten(mesh).uv, expected)
    with pytest.raises(ValueError, match="1 array of points and 0 of triangles"):
        flatten(gifti.GiftiImage(darrays=[arrays[0]]))


@pytest.mark.parametrize("name", ["lh.x.obj.gz", "lh.a.png", "rh.a.json", "lh.csv", "lh.aparc.annot", "lh.patch.png"])
def test_names_with_the_ending_of_another_file_are_no_surfaces(name, tmp_path):
    V, F = grid(3, 3)
    with pytest.raises(io.MeshFileError, match="files cannot"):
        io.write_map(tmp_path / name, io.MeshData(V, F), V)
    for surface in ("lh.pial", "rh.pial.T1", "lh.white.preaparc.H", "lh.json.flat"):
        assert io.format_of(surface).name == "FreeSurfer surface"


def test_values_per_vertex_are_not_a_surface(tmp_path):
    pytest.importorskip("nibabel", reason=NEEDED)
    path = tmp_path / "lh.thickness"
    path.write_bytes(b"\xff\xff\xff" + struct.pack(">iii5f", 5, 6, 1, *range(5)))
    with pytest.raises(io.MeshFileError, match="holds values per vertex, not a surface"):
        io.read_mesh(path)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(io.MeshFileError, match="is not a binary surface"):
        io.read_mesh(path)


def test_without_nibabel_the_command_to_install_it_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "nibabel", None)
    (tmp_path / "lh.pial").write_bytes(b"\xff\xff\xfe")
    assert main(["check", str(tmp_path / "lh.pial")]) == 2
    assert "[neuro]'" in capsys.readouterr().err


def test_a_patch_is_flattened_in_python(tmp_path):
    """A patch has vertices that no triangle uses, which `atlas.flatten` accepts, as the guide says."""
    _, _, inside = sphere_with_patch(tmp_path)
    patch = io.read_mesh(tmp_path / "lh.half.patch.3d")
    flat = atlas.flatten(atlas.as_seamed_mesh(tmp_path / "lh.half.patch.3d"))
    assert flat.verdict().bijective
    io.write_mapped(tmp_path / "lh.half.flat.patch.3d", patch.with_places(flat.mesh))
    numbers, _ = parse_patch(tmp_path / "lh.half.flat.patch.3d")
    np.testing.assert_array_equal(np.abs(numbers) - 1, np.intersect1d(inside, patch.F))
