"""Hand-written files of finite-element programs, section by section: what is read, and what is rejected."""

from __future__ import annotations

import base64
import lzma
import struct
import tracemalloc
import zlib
from functools import partial

import numpy as np
import pytest

from quasiharmonic import surfaces
from quasiharmonic.io import MeshFileError
from quasiharmonic.io.fem.files import read_fem, write_fem
from quasiharmonic.ui.cli import main
from shared.meshes import boundary_of

POINTS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
F = np.array([[0, 1, 2], [0, 2, 3]])
U = np.array([[0.5, 0, 0], [0, 0.25, 0], [0, 0, 0], [1, 2, 0.0]])


def refused(path, data, message):
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    with pytest.raises(MeshFileError, match=message):
        read_fem(path)


def moved(path):
    """Return the file as read after a map was written to it; everything else is unchanged."""
    mesh, out = read_fem(path), path.with_name(f"out{path.suffix}")
    points = mesh.points + np.array([0.125, -0.25])
    write_fem(out, mesh, points)
    after = read_fem(out)
    np.testing.assert_array_equal(after.points, points)
    np.testing.assert_array_equal(after.F, mesh.F)
    assert after.parts.fields.keys() == mesh.parts.fields.keys()
    write_fem(out, after, mesh.points)
    return mesh, read_fem(out)


# ---- legacy VTK -----------------------------------------------------------------------------------------------------


HEAD = "# vtk DataFile Version 3.0\nby hand\nASCII\nDATASET UNSTRUCTURED_GRID\n"
PLACES = "POINTS 4 double\n0 0 0 1 0 0\n1 1 0 0 1 0\n"
CELLS = "CELLS 3 11\n3 0 1 2\n3 0 2 3\n2 0 1\nCELL_TYPES 3\n5 5 3\n"
VECTORS = "VECTORS my%20u double\n" + "\n".join(" ".join(map(str, row)) for row in U.tolist()) + "\n"
SECTIONS = {
    "field": "FIELD FieldData 2\nTIME 1 1 double\n0.25\nwho 1 2 string\none two\nthree\n",
    "metadata": "METADATA\nINFORMATION 0\n\n",
    "scalars with a table": "POINT_DATA 4\nSCALARS t float 1\nLOOKUP_TABLE default\n1 2 3 4\n",
    "scalars without one": "POINT_DATA 4\nSCALARS t int\n1 2 3 4\n",
    "texture coordinates": "POINT_DATA 4\nTEXTURE_COORDINATES st 2 float\n0 0 1 0 1 1 0 1\n",
    "normals": "POINT_DATA 4\nNORMALS n float\n0 0 1 0 0 1 0 0 1 0 0 1\n",
    "bits of cells": "CELL_DATA 3\nSCALARS flag bit 1\nLOOKUP_TABLE default\n1 0 1\n",
    "field of points": "POINT_DATA 4\nFIELD f 2\ns 1 4 double\n1 2 3 4\nMETADATA\nINFORMATION 0\n\nNULL_ARRAY\n",
}


@pytest.mark.parametrize("name", SECTIONS)
def test_sections_around_the_vectors(tmp_path, name):
    path = tmp_path / "four.vtk"
    # Vectors follow; they are found only if the end of the section is.
    path.write_text(HEAD + PLACES + CELLS + SECTIONS[name] + "POINT_DATA 4\n" + VECTORS)
    mesh, again = moved(path)
    np.testing.assert_array_equal(mesh.points, POINTS[:, :2])
    np.testing.assert_array_equal(mesh.F, F)
    for one in (mesh, again):
        assert one.point_field("my u", range(4)).tolist() == U[:, :2].tolist()


def test_cells_of_version_5(tmp_path):
    path = tmp_path / "four.vtk"
    cells = "CELLS 3 6\nOFFSETS vtktypeint64\n0 3 6\nCONNECTIVITY vtktypeint64\n0 1 2 0 2 3\nCELL_TYPES 2\n5 5\n"
    path.write_text(HEAD.replace("3.0", "5.1") + PLACES + cells)
    mesh, _ = moved(path)
    np.testing.assert_array_equal(mesh.F, F)


def test_polygons_of_vtk_are_read(tmp_path):
    path = tmp_path / "four.vtk"
    path.write_text(
        HEAD.replace("UNSTRUCTURED_GRID", "POLYDATA") + PLACES + "LINES 1 3\n2 0 1\nPOLYGONS 2 8\n3 0 1 2\n3 0 2 3\n"
    )
    mesh, _ = moved(path)
    np.testing.assert_array_equal(mesh.F, F)


@pytest.mark.parametrize("kind", ["vtktypeint32", "vtktypeuint8", "vtktypeint64", "vtktypefloat64"])
def test_data_of_the_types_that_meshio_writes(tmp_path, kind):
    path = tmp_path / "a.vtk"
    path.write_text(HEAD + PLACES + CELLS + f"POINT_DATA 4\nFIELD FieldData 1\nu 2 4 {kind}\n1 2 3 4 5 6 7 8\n")
    assert moved(path)[1].point_field("u", range(4)).tolist() == [[1, 2], [3, 4], [5, 6], [7, 8]]


def test_binary_strings_and_bits_of_every_length(tmp_path):
    """The first two bits of a string give the number of bytes of its length."""
    path = tmp_path / "four.vtk"
    strings = bytes([3 << 6 | 3]) + b"abc" + struct.pack(">H", 2 << 14 | 300) + b"x" * 300
    strings += struct.pack(">I", 1 << 30 | 70_000) + b"y" * 70_000
    data = HEAD.replace("ASCII", "BINARY").encode() + b"POINTS 4 float\n" + POINTS.astype(">f4").tobytes()
    data += b"\nCELLS 2 8\n" + np.insert(F, 0, 3, axis=1).astype(">i4").tobytes()
    data += b"\nCELL_TYPES 2\n" + np.array([5, 5], dtype=">i4").tobytes()
    data += b"\nFIELD FieldData 1\nwho 1 3 string\n" + strings
    data += b"\nPOINT_DATA 4\nSCALARS flag bit\nLOOKUP_TABLE own\n\x50"
    data += b"\nLOOKUP_TABLE own 2\n" + bytes(8) + b"\nCOLOR_SCALARS c 3\n" + bytes(12)
    data += b"\nVECTORS u double\n" + U.astype(">f8").tobytes() + b"\n"
    path.write_bytes(data)
    mesh, again = moved(path)
    np.testing.assert_array_equal(mesh.F, F)
    for one in (mesh, again):
        assert one.point_field("u", range(4)).tolist() == U[:, :2].tolist()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEAD + CELLS, "there is no section POINTS"),
        (HEAD.replace("UNSTRUCTURED_GRID", "STRUCTURED_POINTS") + PLACES, "data set is STRUCTURED_POINTS"),
        (HEAD.replace("ASCII", "FRENCH") + PLACES, "must be ASCII or BINARY"),
        ("solid x\n", "does not start like a legacy VTK file"),
        (HEAD + PLACES.replace("double", "int") + CELLS, "its positions are int: save them as float or double"),
        (HEAD + PLACES + CELLS + "MIRACLES 3\n", "the section MIRACLES is not supported"),
        (HEAD + PLACES + CELLS + "POINT_DATA 4\nSCALARS t quaternion\n1\n", "arrays of quaternion are not supported"),
        (HEAD + PLACES + CELLS + "FIELD FieldData 1\nwhat is this, please\n", "cannot be read"),
        (
            HEAD + PLACES + CELLS + "FIELD FieldData 1\nTIME 1\n",
            "an array of a field was expected, not 'TIME 1'",
        ),
        (HEAD + PLACES + CELLS.replace("3 0 2 3", "9 0 2 3"), "lists of cells contradict each other"),
        (HEAD + PLACES + CELLS.replace("CELLS 3", "CELLS -3"), "lists of cells contradict each other"),
        (HEAD + PLACES + "CELLS 0 0\nCELL_TYPES 0\n", "has no triangles"),
        (HEAD + PLACES.replace("0 1 0\n", "0 1 nan\n") + CELLS, r"not finite at point 3 \(0-based\)"),
        (HEAD + PLACES.replace("0 1 0\n", "0 1 0.5\n") + CELLS, r"is not planar: z goes from 0 to 0.5"),
        (HEAD + "POINTS 4 double\n0 0 0 1", "ends too early"),
        (HEAD + PLACES + CELLS + "POINT_DATA 4\nVECTORS u double\n0 0 0\n", "ends too early"),
        (HEAD + "POINTS -1 double\n", "a count is negative or too small"),
    ],
)
def test_errors_in_legacy_vtk_files_are_described(tmp_path, text, message):
    refused(tmp_path / "bad.vtk", text, message)


def test_a_truncated_binary_file(tmp_path):
    head = HEAD.replace("ASCII", "BINARY").encode() + b"POINTS 4 float\n"
    refused(tmp_path / "bad.vtk", head + bytes(20), "ends too early")
    whole = head + POINTS.astype(">f4").tobytes() + b"\nPOINT_DATA 4\nVECTORS u double\n" + bytes(40)
    refused(tmp_path / "bad.vtk", whole, "ends too early")


def legacy(points, faces):
    """A planar mesh."""
    rows = "\n".join(f"{x!r} {y!r} 0" for x, y in points.tolist())
    cells = "\n".join(f"3 {a} {b} {c}" for a, b, c in faces.tolist())
    lists = f"CELLS {len(faces)} {4 * len(faces)}\n{cells}\nCELL_TYPES {len(faces)}\n" + "5\n" * len(faces)
    return HEAD + f"POINTS {len(points)} double\n{rows}\n" + lists


def test_boundaries_that_are_impossible_or_overlap_themselves(tmp_path, capsys):
    mesh, table, out = tmp_path / "strip.vtk", tmp_path / "to.csv", tmp_path / "out.vtk"
    points, faces = surfaces.grid(24, 2)
    mesh.write_text(legacy(points, faces))
    rim = boundary_of(faces)
    command = ["morph", str(mesh), "-o", str(out), "--positions", str(table)]

    # Slightly more than one turn: every triangle is positive, and some overlap others.
    turn = np.exp(8j * points[:, 0]) * (1.5 - 0.5 * points[:, 1])
    table.write_text("".join(f"{k},{turn[k].real:.17g},{turn[k].imag:.17g}\n" for k in rim))
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "every triangle is positive" in said
    assert "The mesh overlaps itself: triangles 0, 1, 2, 3, 4, … (48 in all)." in said

    # A mirror image.
    table.write_text("".join(f"{k},{-points[k, 0]:.17g},{points[k, 1]:.17g}\n" for k in rim))
    assert main(command) == 1
    said = capsys.readouterr().out
    assert f"of {len(faces)} triangles are not positive" in said
    assert "has the opposite orientation to the mesh" in said
    assert "quality, 1 at best" in said


# ---- VTU ------------------------------------------------------------------------------------------------------------


def block(values, word, coder=None, pieces=1):
    """An array as VTK encodes it: length and bytes, or compressed in parts."""
    data = values.tobytes()
    if coder is None:
        return np.array([len(data)], dtype=word).tobytes() + data, b""
    size = -(-len(data) // pieces)
    parts = [coder(data[i : i + size]) for i in range(0, len(data), size)]
    head = [len(parts), size, len(data) % size, *map(len, parts)]
    return np.array(head, dtype=word).tobytes(), b"".join(parts)


def vtu(form, *, coder=None, name=None, order="<", word="u4", points=POINTS, precision="f8"):
    """Four points and two triangles."""
    appended = b""
    arrays = {
        "u": (U, "f8", "Float64", 3),
        "Points": (points, precision, f"Float{8 * int(precision[1])}", 3),
        "connectivity": (F, "i8", "Int64", 1),
        "offsets": (np.array([3, 6]), "i4", "Int32", 1),
        "types": (np.array([5, 5]), "u1", "UInt8", 1),
    }
    written = {}
    for key, (values, kind, called, components) in arrays.items():
        tag = f'<DataArray type="{called}" Name="{key}" NumberOfComponents="{components}" format='
        coded = block(values.astype(order + kind), order + word, coder, 2)
        if form == "ascii":
            written[key] = f'{tag}"ascii">{" ".join(map(repr, values.ravel().tolist()))}</DataArray>'
        elif form == "inline":
            text = "".join(base64.b64encode(part).decode() for part in (coded if coder else [b"".join(coded)]))
            written[key] = f'{tag}"binary">\n  {text}\n</DataArray>'
        else:
            written[key] = f'{tag}"appended" offset="{len(appended)}"/>'
            parts = coded if coder else [b"".join(coded)]
            appended += b"".join(parts if form == "raw" else map(base64.b64encode, parts))
    compressor = f' compressor="{name}"' if name else ""
    text = f"""<?xml version="1.0"?>
<VTKFile type="UnstructuredGrid" version="1.0" byte_order="{"Little" if order == "<" else "Big"}Endian" \
header_type="{"UInt32" if word == "u4" else "UInt64"}"{compressor}>
<UnstructuredGrid><Piece NumberOfPoints="4" NumberOfCells="2">
<PointData>{written["u"]}</PointData><Points>{written["Points"]}</Points>
<Cells>{written["connectivity"]}{written["offsets"]}{written["types"]}</Cells></Piece></UnstructuredGrid>
"""
    if not appended:
        return (text + "</VTKFile>").encode()
    tail = f'<AppendedData encoding="{form}">_'
    return (text + tail).encode() + appended + b"</AppendedData></VTKFile>"


ZLIB, LZMA = (zlib.compress, "vtkZLibDataCompressor"), (partial(lzma.compress, preset=0), "vtkLZMADataCompressor")


@pytest.mark.parametrize(("order", "word"), [("<", "u4"), (">", "u8")])
@pytest.mark.parametrize("form", ["ascii", "inline", "raw", "base64"])
@pytest.mark.parametrize("coder", [None, ZLIB, LZMA], ids=["plain", "zlib", "lzma"])
def test_every_coding(tmp_path, form, coder, order, word):
    path = tmp_path / "four.vtu"
    path.write_bytes(vtu(form, coder=coder and coder[0], name=coder and coder[1], order=order, word=word))
    mesh, again = moved(path)
    np.testing.assert_array_equal(mesh.points, POINTS[:, :2])
    np.testing.assert_array_equal(mesh.F, F)
    for one in (mesh, again):
        assert one.point_field("u", range(4)).tolist() == U[:, :2].tolist()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (vtu("ascii").replace(b"UnstructuredGrid", b"PolyData"), "not a VTU file with an unstructured grid"),
        (vtu("ascii")[:-9], "is not well-formed XML"),
        (vtu("ascii").replace(b"</Piece>", b"</Piece><Piece NumberOfPoints='4'/>"), "it has 2 pieces: merge them"),
        (vtu("ascii").replace(b"Points>", b"Dots>"), "it has 0 arrays of Points: save one array"),
        (vtu("ascii").replace(b'Name="types"', b'Name="kinds"'), "it has 0 arrays of Cells called types"),
        (
            vtu("inline", coder=zlib.compress, name="vtkLZ4DataCompressor"),
            "compressed by vtkLZ4DataCompressor",
        ),
        (vtu("ascii").replace(b'type="UInt8"', b'type="String"'), "arrays of String are not numbers"),
        (vtu("ascii").replace(b'type="UInt8"', b'type="' + b"U" * 5000 + b'"'), "arrays of U{40} are not numbers"),
        (vtu("ascii").replace(b'type="UInt8" ', b""), "arrays of unknown type are not numbers"),
        (vtu("ascii").replace(b'"UInt32"', b'"UInt30"'), "its header_type must be UInt32 or UInt64, not UInt30"),
        (vtu("raw").replace(b'offset="100"', b""), "the array 'Points' has no offset in the appended data"),
        (vtu("raw")[:-90], "ends too early|cannot be read"),
        (vtu("inline").replace(b"AAA", b"!!!"), "base64 data are damaged"),
        (vtu("raw").replace(b'offset="0"', b'offset="99999"'), None),
        (vtu("raw").replace(b'offset="100"', b'offset="99999"'), "refers to appended data that do not exist"),
        (vtu("raw", coder=lambda d: zlib.compress(d)[:-2] + b"??", name=ZLIB[1]), "compressed data are damaged"),
        (vtu("ascii", points=np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, np.inf, 0]])), "not finite at point 3"),
    ],
)
def test_errors_in_vtu_files_are_described(tmp_path, data, message):
    if message is not None:
        refused(tmp_path / "bad.vtu", data, message)
        return
    # Unused data may be damaged; an error appears only if the data is requested.
    (tmp_path / "bad.vtu").write_bytes(data)
    mesh = read_fem(tmp_path / "bad.vtu")
    with pytest.raises(MeshFileError, match="refers to appended data that do not exist"):
        mesh.point_field("u", [0])


@pytest.mark.parametrize("form", ["ascii", "raw"])
def test_an_empty_piece_in_a_vtu_file(tmp_path, form):
    path, data = tmp_path / "a.vtu", vtu(form)
    numbers = b'<DataArray type="Float64" Name="%b" NumberOfComponents="3" format="ascii"/>'
    arrays = b"<PointData>%b</PointData><Points>%b</Points>" % (numbers % b"u", numbers % b"Points")
    empty = b'<Piece NumberOfPoints="0" NumberOfCells="0">%b</Piece>' % arrays
    path.write_bytes(data.replace(b"<Piece", empty + b"<Piece").replace(b"</Piece></U", b"</Piece>%b</U" % empty))
    mesh, again = moved(path)
    np.testing.assert_array_equal(mesh.points, POINTS[:, :2])
    assert again.point_field("u", range(4)).tolist() == U[:, :2].tolist()


def test_arrays_beside_a_group_in_a_vtu_file(tmp_path):
    path = tmp_path / "a.vtu"
    flag = b'<PointData><DataArray type="Int32" Name="flag" format="ascii">0 1 0 1</DataArray>'
    names = b'<CellData><DataArray type="String" Name="who" format="ascii">97 0 98 0</DataArray></CellData>'
    flag += b'<DataArray type="Int32" Name="none" NumberOfComponents="0" format="ascii"></DataArray>'
    data = vtu("ascii").replace(b"<PointData>", flag).replace(b"</Piece>", names + b"</Piece>")
    path.write_bytes(data)
    assert read_fem(path).find_set("flag").tolist() == [1, 3]
    path.write_bytes(data.replace(b"String", b"Int32"))
    with pytest.raises(MeshFileError, match="the array 'who' has 4 numbers, not 2"):
        read_fem(path).find_set("flag")


@pytest.mark.long
@pytest.mark.parametrize("coder", [ZLIB, LZMA], ids=["zlib", "lzma"])
@pytest.mark.parametrize("form", ["inline", "raw"])
def test_nothing_larger_than_the_memory_limit_is_decompressed(tmp_path, form, coder):
    pack, name = coder
    zeros = bytes(8 << 20)
    claims = "compressed data have 8388704 bytes, but at most 96 are expected"
    for data, message in (
        (
            vtu(form, coder=lambda d: pack(d + zeros if len(d) == 48 else d), name=name),
            "damaged: 48 bytes were expected",
        ),
        (vtu(form, points=np.concatenate([POINTS.ravel(), np.frombuffer(zeros)]), coder=pack, name=name), claims),
        (vtu(form, coder=lambda d: pack(d[:-1]), name=name), "damaged: 48 bytes were expected"),
    ):
        tracemalloc.start()
        refused(tmp_path / "bomb.vtu", data, message)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 4 << 20


@pytest.mark.parametrize("form", ["ascii", "raw"])
def test_positions_beyond_single_precision(tmp_path, form):
    path, out = tmp_path / "four.vtu", tmp_path / "out.vtu"
    path.write_bytes(vtu(form, precision="f4"))
    mesh = read_fem(path)
    with pytest.raises(MeshFileError, match="too large for the file's single precision"):
        write_fem(out, mesh, mesh.points * 1e39)
    for wrong, message in (
        (mesh.points[:3], r"must have shape \(4, 2\)"),
        (mesh.points * np.nan, "is not finite at vert"),
    ):
        with pytest.raises(ValueError, match=f"points {message}"):
            write_fem(out, mesh, wrong)
    assert not out.exists()
    write_fem(out, mesh, mesh.points + 0.1)
    np.testing.assert_array_equal(read_fem(out).points, (mesh.points + 0.1).astype(np.float32))


# ---- Gmsh -----------------------------------------------------------------------------------------------------------


MSH4 = """$MeshFormat
4.1 0 8
$EndMeshFormat
$Nodes
1 4 1 4
2 1 0 4
1
2
3
4
0 0 0
1 0 0
1 1 0
0 1 0
$EndNodes
$Elements
1 2 1 2
2 1 2 2
1 1 2 3
2 1 3 4
$EndElements
"""


def test_repeated_meshes_count_as_one_and_different_ones_do_not(tmp_path):
    path = tmp_path / "four.msh"
    sections = MSH4[MSH4.index("$Nodes") :]
    path.write_text(MSH4 + sections)
    mesh, _ = moved(path)
    np.testing.assert_array_equal(mesh.F, F)
    refused(path, MSH4 + sections.replace("0 1 0\n", "0 2 0\n"), "it has several meshes: save each in a separate file")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (MSH4.replace("$Elements", "$Parts").replace("$EndElements", "$EndParts"), r"there is no section \$Elements"),
        (MSH4.replace("1 4 1 4\n2 1 0 4\n", "0 0 0 0\n"), "there are no nodes|cannot be read"),
        (MSH4.replace("1 4 1 4\n", "1 4 1\n"), "cannot be read"),
        (MSH4.replace("2 1 3 4\n", "2 1 3 9\n"), "cannot be read"),
        (MSH4.replace("4.1 0 8", "1.0 0 8"), "version 1.0 is not supported"),
    ],
)
def test_errors_in_gmsh_files_are_described(tmp_path, text, message):
    refused(tmp_path / "bad.msh", text, message)


def test_unsupported_formats(tmp_path, capsys):
    path = tmp_path / "mesh.inp"
    refused(
        path, "*HEADING\n", r"\.inp files cannot be read as a mesh of finite elements; supported: \.msh, \.vtk, \.vtu"
    )
    assert main(["morph", str(path), "-o", str(path), "--field", "u"]) == 2
    assert "mesh.inp" in capsys.readouterr().err


def test_mfem_files_are_read_and_written(tmp_path):
    path, out = tmp_path / "in.mesh", tmp_path / "out.mesh"
    text = (
        "MFEM mesh v1.0\n\n# vertices\ndimension\n2\n\nelements # two kinds\n2\n1 3 0 1 4 3\n7 2 1 2 4\n\n"
        "boundary\n1\n5 1 0 1\n\nvertices\n5\n2\n0 0\n1 0 # a corner\n2 0.50\n0 1\n1 1e0\n"
    )
    path.write_text(text)
    mesh = read_fem(path)
    assert mesh.points.tolist() == [[0, 0], [1, 0], [2, 0.5], [0, 1], [1, 1]]
    assert mesh.F.tolist() == [[0, 1, 4, 3], [1, 2, 4, 4]]
    moved = mesh.points.copy()
    moved[1, 0] = 1.25
    write_fem(out, mesh, moved)
    assert out.read_text() == text.replace("1 0 # a corner", "1.25 0 # a corner")
    (tmp_path / "positions.csv").write_text("2,3,0.5\n")
    assert main(["morph", str(path), "--positions", str(tmp_path / "positions.csv"), "-o", str(out)]) == 0
    assert read_fem(out).points[2].tolist() == [3, 0.5]
    for wrong, message in (
        (text.replace("v1.0", "v1.1"), "does not start with MFEM"),
        (text + "nodes\nFiniteElementSpace\n", "curved elements"),
        (text.replace("7 2 1 2 4", "7 2 1 2 9"), "refers to point 9"),
        (text.replace("7 2 1 2 4", "7 9 1 2 4"), "unknown geometry 9"),
        (text[: text.index("1 1e0")], "ends too early"),
        (text.replace("vertices\n5", "vertice\n5"), "no section vertices"),
    ):
        path.write_text(wrong)
        with pytest.raises(MeshFileError, match=message):
            read_fem(path)
