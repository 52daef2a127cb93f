"""PLY and STL: read as independent readers do, written without loss, and invalid files named."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from quasiharmonic import io, repair
from quasiharmonic.io import MeshData, MeshFileError
from quasiharmonic.surfaces import cat, disk
from shared.damaged_files import VALID
from shared.gltf_files import SQUARE, square

HEAD = b"ply\nformat ascii 1.0\ncomment made by hand\n"
MIXED = (
    HEAD + b"element vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
    b"property uchar red\nproperty uchar green\nproperty uchar blue\nproperty int label\n"
    b"element face 2\nproperty list uchar int vertex_indices\nproperty list uchar float texcoord\nproperty char flag\n"
    b"element edge 1\nproperty int vertex1\nproperty int vertex2\nend_header\n"
    b"0 0 0 255 0 0 7\n1 0 0 0 255 0 8\n1 1 0 0 0 255 9\n0 1 0 51 51 51 10\n.1 2 0 0 0 0 11\n"
    b"4 0 1 2 3 8 0 0 .5 0 .5 .5 0 .5 -1\n3 3 2 4 6 .6 .6 .8 .6 .7 .9 1\n0 1\n"
)


def swapped(data):
    """Return a text file of this package as big-endian bytes."""
    body = data.split(b"end_header\n")[1].splitlines()
    rows = [line.split() for line in body]
    out = data.split(b"end_header\n")[0].replace(b"ascii", b"binary_big_endian") + b"end_header\n"
    for row in rows[:5]:
        out += struct.pack(">fff3Bi", *map(float, row[:3]), *map(int, row[3:]))
    for row, size in ((rows[5], 4), (rows[6], 3)):
        out += struct.pack(f">B{size}iB{2 * size}fb", size, *map(int, row[1 : size + 1]), 2 * size,
                           *map(float, row[size + 2 : 3 * size + 2]), int(row[-1]))  # fmt: skip
    return out + struct.pack(">ii", 0, 1)


@pytest.mark.parametrize("form", [bytes, swapped, lambda data: data.replace(b"\n", b"\r\n")])
def test_all_variants_of_ply(form, tmp_path):
    path = tmp_path / "mixed.ply"
    path.write_bytes(form(MIXED))
    mesh = io.read_mesh(path)
    assert mesh.V[4].tolist() == [np.float64(np.float32(0.1)), 2, 0]
    assert mesh.polygons.sizes.tolist() == [4, 3]
    corners = mesh.polygons.corners
    assert mesh.F.ravel()[corners].tolist() == [0, 1, 2, 3, 3, 2, 4]
    expected = np.array([[0, 0], [0.5, 0], [0.5, 0.5], [0, 0.5], [0.6, 0.6], [0.8, 0.6], [0.7, 0.9]])
    np.testing.assert_array_equal(mesh.vt[mesh.FT.ravel()[corners]], expected.astype("f4"))
    np.testing.assert_array_equal(mesh.extra, np.array([[5, 0, 0], [0, 5, 0], [0, 0, 5], [1, 1, 1], [0, 0, 0]]) / 5)
    # Written again, the file contains all data, and only the positions may differ.
    io.write_mapped(tmp_path / "out.ply", mesh)
    data = (tmp_path / "out.ply").read_bytes()
    assert b"comment made by hand\n" in data
    again = io.read_mesh(tmp_path / "out.ply")
    for name in ("V", "F", "extra"):
        np.testing.assert_array_equal(getattr(again, name), getattr(mesh, name))
    np.testing.assert_array_equal(again.vt[again.FT], mesh.vt[mesh.FT])
    tables = again.carried.tables
    assert tables.find("vertex").find("label").values.tolist() == [7, 8, 9, 10, 11]
    assert tables.find("face").find("flag").values.tolist() == [-1, 1]
    assert tables.find("edge").find("vertex2").values.tolist() == [1]
    assert io.not_held("out.ply", mesh) == []
    assert io.not_held("out.obj", mesh) == [
        "label of vertex",
        "flag of face",
        "vertex1 of edge",
        "vertex2 of edge",
    ]


@pytest.mark.parametrize("binary", [True, False])
def test_files_of_other_libraries_are_read(binary, tmp_path):
    meshlane = pytest.importorskip("meshlane", reason="an independent reader and writer of PLY")
    V, F = cat(6)
    data = {"s": V[:, 0] / 3, "t": V[:, 1] / 7}
    there = meshlane.Mesh(V, [("triangle", F)], point_data=data)
    there.write(tmp_path / "cat.ply", binary=binary)
    mesh = io.read_mesh(tmp_path / "cat.ply")
    np.testing.assert_array_equal(mesh.V, V)
    np.testing.assert_array_equal(mesh.F, F)
    np.testing.assert_array_equal(io.map_of(mesh), np.stack([data["s"], data["t"]], axis=1))


def test_other_libraries_read_written_files(tmp_path):
    meshlane = pytest.importorskip("meshlane", reason="an independent reader and writer of PLY")
    trimesh = pytest.importorskip("trimesh", reason="an independent reader and writer of PLY")
    V, F = cat(6)
    uv = V[:, :2] / 3
    io.write_map(tmp_path / "cat.ply", MeshData(V, F), uv)
    there = meshlane.read(tmp_path / "cat.ply")
    np.testing.assert_array_equal(there.points, V)
    np.testing.assert_array_equal(there.cells_dict["triangle"], F)
    np.testing.assert_array_equal(np.stack([there.point_data["s"], there.point_data["t"]], axis=1), uv)
    seams = MeshData(V, F, vt=np.random.default_rng(1).random((F.size, 2)), FT=np.arange(F.size).reshape(-1, 3))
    io.write_mapped(tmp_path / "seams.ply", seams)
    torn = trimesh.load(tmp_path / "seams.ply", process=False)
    np.testing.assert_array_equal(torn.visual.uv[torn.faces], seams.vt[seams.FT])


def test_an_obj_as_ply(tmp_path):
    """Normals and colours are preserved if vertices have one each; other data that is lost is named."""
    text = "v 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 0 1 0 0 0 .5\nvn 0 0 1\nvn 0 1 0\nusemtl a\nf 1//1 2//2 3//1\n"
    (tmp_path / "in.obj").write_text(text)
    mesh = io.read_mesh(tmp_path / "in.obj")
    assert io.not_held("out.ply", mesh) == ["groups, material names and other statements"]
    io.write_mapped(tmp_path / "out.ply", mesh)
    again = io.read_mesh(tmp_path / "out.ply")
    assert again.normals == b"vn 0.0 0.0 1.0\nvn 0.0 1.0 0.0\nvn 0.0 0.0 1.0\n"
    np.testing.assert_array_equal(again.extra, mesh.extra)
    (tmp_path / "in.obj").write_text(text + "f 1//2 3//1 2//1\n")
    assert "normals, because some vertices have several" in io.not_held("out.ply", io.read_mesh(tmp_path / "in.obj"))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (MIXED[:-2], "too early"),
        (swapped(MIXED)[:-5], "too early"),
        (MIXED.replace(b"element vertex 5", b"element vertex 500000000000000000"), "too early"),
        (swapped(MIXED).replace(b"element vertex 5", b"element vertex 999999999999999"), "too early"),
        (MIXED.replace(b"element vertex 5", b"element vertex -5"), "element vertex -5"),
        (MIXED.replace(b"end_header", b"end_head"), "its header does not end"),
        (MIXED.replace(b"uchar float texcoord", b"float float texcoord"), "its header has"),
        (MIXED.replace(b"property int label", b"property int x"), "two properties"),
        (MIXED.replace(b"4 0 1 2 3", b"4 0 1 2 9"), "refers to vertex 9"),
        (MIXED.replace(b"4 0 1 2 3", b"4 0 1 2 1"), "vertex twice"),
        (MIXED.replace(b"3 3 2 4 6", b"-3 3 2 4 6"), "not uchar"),
        (
            swapped(MIXED).replace(b"list uchar int", b"list char int").replace(b"\4\0\0\0\0", b"\xff\0\0\0\0"),
            "of -1 num",
        ),
        (MIXED.replace(b".1 2 0", b"nan 2 0"), "not finite"),
        (MIXED.replace(b".1 2 0", b"1_0 2 0"), "underscore"),
        (MIXED.replace(b"8 0 0 .5 0 .5 .5 0 .5", b"4 0 0 .5 0"), "4 numbers of texcoord and 4 corners"),
        (MIXED.replace(b"vertex_indices", b"other"), "no faces"),
        (b"", "empty"),
    ],
)
def test_invalid_ply(data, message, tmp_path):
    path = tmp_path / "bad.ply"
    path.write_bytes(data)
    with pytest.raises(MeshFileError, match=message):
        io.read_mesh(path)


@pytest.mark.slow
def test_stl_vertices_are_merged(tmp_path):
    trimesh = pytest.importorskip("trimesh", reason="an independent writer of STL")
    V, F = cat(6)
    V = V.astype("f4").astype(float)
    there = trimesh.Trimesh(V, F, process=False)
    for name, file_type in (("binary.stl", "stl"), ("text.stl", "stl_ascii")):
        there.export(tmp_path / name, file_type=file_type)
        mesh = io.read_mesh(tmp_path / name)
        assert len(mesh.V) == len(V)
        np.testing.assert_allclose(mesh.V[mesh.F], V[F], atol=1e-7)
        if name == "binary.stl":
            np.testing.assert_array_equal(mesh.V[mesh.F], V[F])
            # In the order of their first occurrence.
            np.testing.assert_array_equal(
                np.unique(mesh.F, return_index=True)[1], np.sort(np.unique(F, return_index=True)[1])
            )
    with pytest.raises(MeshFileError, match=r"stl files cannot be written; supported: \.obj"):
        io.write_map(tmp_path / "out.stl", mesh, mesh.V[:, :2])


FACET = b"facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"


@pytest.mark.parametrize(
    "data",
    [
        b"solid a\n" + FACET + FACET[:50] + b"\nendsolid a\n",
        b"solid a\n" + FACET,
        b"solid a\n" + FACET.replace(b"1 0 0", b"1e 0 0") + b"endsolid a\n",
        b"solid a\n" + FACET.replace(b"1 0 0", b"1e999 0 0") + b"endsolid a\n",
        b"solid a\nendsolid a\n",
        b"\0" * 80 + (2**32 - 1).to_bytes(4, "little") + b"\0" * 50,
        b"\0" * 80 + (1).to_bytes(4, "little") + b"\0" * 49,
        b"\0" * 84,
        b"",
    ],
)
def test_invalid_stl(data, tmp_path):
    path = tmp_path / "bad.stl"
    path.write_bytes(data)
    with pytest.raises(MeshFileError, match=r"bad\.stl"):
        io.read_mesh(path)


def with_floats(data):
    """Return a PLY file with float positions and colours of vertices, and float texture coordinates of corners."""
    F = np.array([[0, 1, 2], [0, 2, 3]], dtype="<i4")
    names = ["x", "y", "z", "s", "t", "red", "green", "blue"]
    header = ["ply", "format binary_little_endian 1.0", "element vertex 4", *(f"property float {n}" for n in names)]
    header += ["element face 2", "property list uchar int vertex_indices", "property list uchar float texcoord"]
    text = "\n".join([*header, "end_header\n"]).encode()
    faces = b"".join(b"\3" + corners.tobytes() + b"\6" + data[corners, :2].tobytes() for corners in F)
    return text + np.hstack([data, data[:, :2], data]).tobytes() + faces


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "order", "data"),
    [
        ("a.ply", "<", VALID["binary.ply"]),
        ("b.ply", ">", swapped(MIXED)),
        ("c.ply", "<", with_floats(SQUARE)),
        ("d.stl", "<", VALID["binary.stl"]),
        ("e.glb", "<", square(TEXCOORD_0=SQUARE[:, :2]).glb()),
    ],
)
def test_a_signalling_nan_is_an_error_without_a_warning(name, order, data, tmp_path):
    """At every position in a binary file."""
    number, not_finite = struct.pack(f"{order}I", 0x7FA00001), 0
    for at in range(max(0, len(data) - 160), len(data) - 3):
        (tmp_path / name).write_bytes(data[:at] + number + data[at + 4 :])
        try:
            io.read_mesh(tmp_path / name)
        except MeshFileError as error:
            not_finite += "not finite" in str(error)
    assert not_finite


@pytest.mark.parametrize(("kind", "bits"), [("f4", 0x7FA00001), ("f8", 0x7FF4000000000001)])
def test_a_signalling_nan_in_an_array_is_an_error_without_a_warning(kind, bits):
    V, F = disk(3)
    odd = V.astype(kind)
    odd.view(f"u{kind[1]}")[0, 0] = bits
    with pytest.raises(ValueError, match="not finite at vertex 0"):
        repair(odd, F, V)
    # A position that is NaN is to be computed.
    assert np.isfinite(repair(V, F, odd).uv).all()


@pytest.mark.parametrize("space", [b" ", b"\r", b"\r\n", b"\n"])
@pytest.mark.parametrize("name", [b"a", b"facet", b""])
def test_white_space_of_stl_text(space, name, tmp_path):
    path = tmp_path / "two.stl"
    second = FACET.replace(b"1 0 0", b"2 0 0").replace(b"facet normal 0 0 1", b"FACET\tNORMAL 0 0 1", 1)
    path.write_bytes((b"solid " + name + b"\n" + FACET + second + b"endsolid " + name).replace(b"\n", space))
    mesh = io.read_mesh(path)
    assert len(mesh.F) == 2
    assert mesh.V[:, 0].max() == 2
