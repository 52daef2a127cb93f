"""Files of finite-element programs: only positions change, according to the libraries that define the formats."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from importlib.util import find_spec
from multiprocessing import get_context

import numpy as np
import pytest

from quasiharmonic.io import MeshFileError
from quasiharmonic.io.fem.files import read_fem, write_fem
from quasiharmonic.ui.cli import main
from shared import gmsh_files, vtk_files


def shifted(mesh):
    """Return other positions: some vertices move, most do not."""
    points = mesh.points.copy()
    points[::3] += [1 / 3, -1e-17]
    return points


@pytest.fixture(scope="module")
def gmsh():
    """Call functions of `gmsh_files` in a separate process."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
        if reason := process.submit(gmsh_files.missing).result():
            pytest.skip(f"no gmsh: {reason}")
        yield lambda function, *arguments, **options: process.submit(function, *arguments, **options).result()


GMSH_KINDS = [
    pytest.param(
        version, binary, options, id=f"{version}-{'binary' if binary else 'text'}-{'-'.join(options) or 'plain'}"
    )
    for version in (2.2, 4.0, 4.1)
    for binary in (False, True)
    for options in ({}, {"gaps": True}, {"groups": False}, {"parametric": True})
    # Gmsh writes 4.0 as text only, and 2.2 with parameters in their own section.
    if not (version == 4.0 and binary) and not ("parametric" in options and version == 2.2)
]


@pytest.mark.slow
@pytest.mark.parametrize(("version", "binary", "options"), GMSH_KINDS)
def test_gmsh_finds_everything_that_was_there_before(gmsh, tmp_path, version, binary, options):
    path, out = tmp_path / "square.msh", tmp_path / "moved.msh"
    gmsh(gmsh_files.square, path, version, binary, **options)
    mesh = read_fem(path)
    points = shifted(mesh)
    write_fem(out, mesh, points)
    before, after = gmsh(gmsh_files.content, path), gmsh(gmsh_files.content, out)
    assert after[1] == before[1]
    if options.get("groups", True):
        assert before[1]["group", 1, 8] == ("clamped", [1, 3])
        assert before[1][1, 3][3] == [7, 8]
    if version != 4.0:
        assert sum(key[0] == "view" for key in before[1]) == 5
    # Positions of every node by tag.
    tags = before[1]["nodes"]
    own = np.searchsorted(tags, sorted(tags))
    assert np.array_equal(after[0][own, 2], before[0][own, 2])
    assert sorted(map(tuple, after[0][:, :2].tolist())) == sorted(map(tuple, points.tolist()))
    moved = (after[0] != before[0]).any(axis=1).sum()
    assert moved == len(points[::3])
    # Without moved vertices nothing changes.
    write_fem(out, mesh, mesh.points)
    assert out.read_bytes() == path.read_bytes()


@pytest.mark.parametrize("binary", [False, True])
def test_a_mesh_that_is_repeated_with_every_view(gmsh, tmp_path, binary):
    path, out = tmp_path / "square.msh", tmp_path / "moved.msh"
    gmsh(gmsh_files.square, path, 4.1, binary, repeated=True)
    assert path.read_bytes().count(b"$Nodes") == 4
    mesh = read_fem(path)
    write_fem(out, mesh, shifted(mesh))
    before, after = gmsh(gmsh_files.content, path), gmsh(gmsh_files.content, out)
    assert after[1] == before[1]
    # All four copies move alike, for Gmsh, whichever it takes, and for another reader.
    again = read_fem(out)
    assert np.array_equal(again.points, shifted(mesh))
    path.write_bytes(path.read_bytes() + out.read_bytes())
    with pytest.raises(MeshFileError, match="several meshes"):
        read_fem(path)


@pytest.mark.parametrize("version", [2.2, 4.1])
@pytest.mark.parametrize("binary", [False, True])
def test_the_last_of_several_time_steps_moves_the_boundary(gmsh, tmp_path, version, binary):
    path, out, report = tmp_path / "square.msh", tmp_path / "moved.msh", tmp_path / "report.json"
    gmsh(gmsh_files.square, path, version, binary, gaps=True)
    assert main(["morph", str(path), "-o", str(out), "--field", "displacement", "--json", str(report)]) == 0
    assert json.loads(report.read_text())["inverted"] == []
    before, after = gmsh(gmsh_files.content, path), gmsh(gmsh_files.content, out)
    assert after[1] == before[1]
    upper = before[0][:, 1] == 1
    dent = 1 - 0.2 * np.sin(np.pi * before[0][upper, 0]) ** 2
    assert after[0][upper, 1] == pytest.approx(dent, abs=1e-15)


@pytest.fixture(scope="module")
def vtk():
    """Call functions of `vtk_files` in a separate process."""
    if find_spec("vtkmodules") is None:
        pytest.skip("vtk is not installed")
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
        yield lambda function, *arguments, **options: process.submit(function, *arguments, **options).result()


VTK_KINDS = {
    **{
        f"{version}-{'binary' if binary else 'text'}.vtk": {"version": version, "binary": binary}
        for version in (42, 51)
        for binary in (False, True)
    },
    "text.vtu": {"mode": "Ascii"},
    "inline.vtu": {"mode": "Binary"},
    "inline-zlib.vtu": {"mode": "Binary", "compressor": "ZLib"},
    "raw.vtu": {"mode": "Appended"},
    "raw-64.vtu": {"mode": "Appended", "words": 64, "big": True},
    "raw-zlib.vtu": {"mode": "Appended", "compressor": "ZLib"},
    "raw-lzma.vtu": {"mode": "Appended", "compressor": "LZMA", "words": 64},
    "base64.vtu": {"mode": "Appended", "raw": False},
    "base64-zlib.vtu": {"mode": "Appended", "raw": False, "compressor": "ZLib"},
}


@pytest.mark.slow
@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("name", VTK_KINDS)
def test_vtk_finds_everything_that_was_there_before(vtk, tmp_path, name, single):
    path, out = tmp_path / name, tmp_path / f"moved_{name}"
    vtk(vtk_files.write, path, single=single, **VTK_KINDS[name])
    mesh = read_fem(path)
    points = shifted(mesh)
    write_fem(out, mesh, points)
    (old, before), (new, after) = vtk(vtk_files.content, path), vtk(vtk_files.content, out)
    assert after == before
    assert len(before) >= 12
    assert {("Point", "my T"), ("Field", "who"), ("Cell", "material")} <= set(before)
    assert new.dtype == old.dtype == (np.float32 if single else np.float64)
    assert np.array_equal(new[:, 2], old[:, 2])
    assert np.array_equal(new[:, :2], points.astype(old.dtype))
    write_fem(out, mesh, mesh.points)
    assert out.read_bytes() == path.read_bytes()
    assert main(["morph", str(path), "-o", str(out), "--field", "displacement"]) == 0
    assert vtk(vtk_files.content, out)[1] == before


@pytest.mark.parametrize("binary", [False, True])
def test_polygons_with_three_corners(vtk, tmp_path, binary):
    path, out = tmp_path / "square.vtk", tmp_path / "moved.vtk"
    vtk(vtk_files.write, path, polygons=True, version=42, binary=binary)
    assert main(["morph", str(path), "-o", str(out), "--field", "displacement"]) == 0
    assert vtk(vtk_files.content, out)[1] == vtk(vtk_files.content, path)[1]


def test_two_time_steps_in_one_vtu(vtk, tmp_path):
    path, out = tmp_path / "times.vtu", tmp_path / "moved.vtu"
    vtk(vtk_files.write, path, mode="Ascii")
    text = path.read_text()
    array = re.search(r'<DataArray [^>]*Name="displacement".*?</DataArray>', text, re.DOTALL)
    later = "<DataArray TimeStep='1' type='Float64' Name='displacement' NumberOfComponents='3' format='ascii'>"
    later += "0 -0.5 0 " * 49 + "</DataArray>"
    text = text.replace(array.group(), array.group().replace("<DataArray", '<DataArray TimeStep="0"') + later)
    path.write_text(text.replace("<UnstructuredGrid>", '<UnstructuredGrid TimeValues="0 0.5">'))
    mesh = read_fem(path)
    assert mesh.point_field("displacement", [0, 48]).tolist() == [[0, -0.5], [0, -0.5]]
    write_fem(out, mesh, shifted(mesh))
    assert out.read_text().count("TimeStep=") == 2
    assert later in out.read_text()


def test_positions_too_large_for_single_precision(vtk, tmp_path, capsys):
    path, table, out = tmp_path / "square.vtk", tmp_path / "to.csv", tmp_path / "moved.vtk"
    vtk(vtk_files.write, path, single=True, version=42)
    mesh = read_fem(path)
    corner = int(np.flatnonzero((mesh.points == mesh.points.max(axis=0)).all(axis=1))[0])
    table.write_text(f"{corner},1e39,0.3\n")
    assert main(["morph", str(path), "-o", str(out), "--positions", str(table)]) == 2
    assert "too large for the file's single precision" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        (
            "raw.vtu",
            lambda d: d.replace(b"<Points>", b"<Pionts>").replace(b"</Points>", b"</Pionts>"),
            "0 arrays of Po",
        ),
        ("raw-zlib.vtu", lambda d: d.replace(b"vtkZLib", b"vtkLZ4X"), "compressed by vtkLZ4X"),
        ("text.vtu", lambda d: d.replace(b"</VTKFile>", b""), "not well-formed XML"),
        (
            "raw.vtu",
            lambda d: d[: d.index(b"<AppendedData") + 60],
            "ends too early|refers to appended data that do not exist",
        ),
        ("inline-zlib.vtu", lambda d: d.replace(b"eJ", b"!!"), "base64|damaged"),
        ("42-text.vtk", lambda d: d.replace(b"UNSTRUCTURED_GRID", b"STRUCTURED_GRID"), "data set is STRUCTURED_GRID"),
        (
            "42-text.vtk",
            lambda d: d.replace(b"double\n", b"int\n", 1).replace(b"POINTS 49 double", b"POINTS 49 int"),
            "int",
        ),
        ("42-binary.vtk", lambda d: d[:900], "ends too early|not known|missing"),
        ("42-text.vtk", lambda d: d.replace(b"ASCII", b"ENGLISH"), "must be ASCII or BINARY"),
        ("42-text.vtk", lambda d: d[30:], "does not start like"),
    ],
)
def test_damaged_vtk_files_are_rejected(vtk, tmp_path, name, change, message):
    path = tmp_path / name
    vtk(vtk_files.write, path, **VTK_KINDS[name])
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(MeshFileError, match=message):
        read_fem(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.replace(b"4.1 0 8", b"3.0 0 8"), "version 3.0 is not supported"),
        (lambda d: d.replace(b"4.1 0 8", b"4.1 0 4"), "4 bytes"),
        (lambda d: d[: d.index(b"$EndNodes")], "Nodes does not end"),
        (lambda d: d.replace(b"Nodes", b"ParametricNodes"), "save it as 4.1, or without them"),
        (lambda d: d.replace(b"$Nodes", b"$Knots").replace(b"$EndNodes", b"$EndKnots"), r"no section \$Nodes"),
        (lambda d: b"solid x\n", "does not start like an MSH file"),
        (
            lambda d: re.sub(rb"\n2 1 2 (\d+)\n", rb"\n2 1 4 \1\n", d),
            "tetrahedron are not supported: use triangles of three or six",
        ),
        (
            lambda d: re.sub(rb"\n2 1 2 (\d+)\n", rb"\n2 1 21 \1\n", d),
            "third-order triangle are not supported: use triangles of three or six",
        ),
        (lambda d: re.sub(rb"\n2 1 2 \d+\n", rb"\n2 1 2 999999\n", d), "ends too early"),
    ],
)
def test_damaged_gmsh_files_are_rejected(gmsh, tmp_path, change, message):
    path = tmp_path / "square.msh"
    gmsh(gmsh_files.square, path, 4.1, False)
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(MeshFileError, match=message):
        read_fem(path)


MSH2 = """$MeshFormat
2.2 0 8
$EndMeshFormat
$Nodes
4
5 0 0 0
7 1e0 0.000 1e-17
20 1 1 -3e-17
3 0 1 0
$EndNodes
$Elements
4
1 2 2 1 1 5 7 20
2 2 2 1 1 5 20 3
3 2 2 2 1 5 7 20
4 1 2 7 1 5 7
$EndElements
$NodeData
1
"u"
1
0.5
3
0
3
2
5 0.25 0 0
7 0.5 0 0
$EndNodeData
"""


def test_gaps_noise_and_an_element_in_two_groups(tmp_path, capsys):
    path, out = tmp_path / "four.msh", tmp_path / "out.msh"
    path.write_text(MSH2)
    mesh = read_fem(path)
    assert mesh.F.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert mesh.point_field("u", [1, 0]).tolist() == [[0.5, 0], [0.25, 0]]
    points = mesh.points.copy()
    points[2] = [1.5, 0.1]
    write_fem(out, mesh, points)
    assert out.read_text() == MSH2.replace("20 1 1 -3e-17", "20 1.5 0.1 -3e-17")
    assert main(["morph", str(path), "-o", str(out), "--field", "u"]) == 2
    assert "'u' has no finite value at boundary points 2, 3 (0-based)" in capsys.readouterr().err


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".svg", ".vtu", ""])
def test_another_format_would_lose_data(tmp_path, capsys, suffix):
    path, out = tmp_path / "four.msh", tmp_path / f"out{suffix}"
    path.write_text(MSH2)
    assert main(["morph", str(path), "-o", str(out), "--field", "u"]) == 2
    assert "a .msh file can only be written as .msh" in capsys.readouterr().err
    assert not out.exists()
    assert main(["morph", str(tmp_path / "mesh.inp"), "-o", str(tmp_path / "out.inp"), "--field", "u"]) == 2
    assert "mesh.inp" in capsys.readouterr().err


def binary_msh(version, order):
    """One triangle as written by Gmsh on other machines and by other versions."""
    nodes = np.array([(1, 0, 0, 0), (2, 1, 0, 0), (3, 0, 1, 0)], dtype=f"{order}i4,{order}f8,{order}f8,{order}f8")

    def words(kind, *numbers):
        return np.array(numbers, dtype=order + kind).tobytes()

    head = b"$MeshFormat\n%s 1 8\n" % version + words("i4", 1) + b"\n$EndMeshFormat\n$Nodes\n"
    if version == b"2.2":
        before, elements = b"3\n", b"1\n" + words("i4", 2, 1, 2, 1, 9, 9, 1, 2, 3)
    else:
        before = words("u8", 1, 3) + words("i4", 1, 2, 0) + words("u8", 3)
        elements = words("u8", 1, 1) + words("i4", 1, 2, 2) + words("u8", 1) + words("i4", 1, 1, 2, 3)
    return head + before, nodes, b"\n$EndNodes\n$Elements\n" + elements + b"\n$EndElements\n"


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("version", [b"2.2", b"4.0"])
def test_binary_files_of_other_machines(tmp_path, version, order):
    path, out = tmp_path / "one.msh", tmp_path / "out.msh"
    head, nodes, tail = binary_msh(version, order)
    path.write_bytes(head + nodes.tobytes() + tail)
    mesh = read_fem(path)
    assert mesh.F.tolist() == [[0, 1, 2]]
    write_fem(out, mesh, mesh.points * [1.5, 1])
    nodes["f1"][1] = 1.5
    assert out.read_bytes() == head + nodes.tobytes() + tail


VTU = """<VTKFile type="UnstructuredGrid" version="0.1" byte_order="LittleEndian"><UnstructuredGrid>
<Piece NumberOfPoints="3" NumberOfCells="1">
<PointData><DataArray type="Float64" Name="u" NumberOfComponents="2" format="appended" offset="0"/></PointData>
<Points><DataArray type="Float32" NumberOfComponents="3" format="ascii">0 0 0 1 0 0 0 1 0</DataArray></Points>
<Cells><DataArray type="Int32" Name="connectivity" format="ascii">0 1 2</DataArray>
<DataArray type="Int32" Name="offsets" format="ascii">3</DataArray>
<DataArray type="UInt8" Name="types" format="ascii">5</DataArray></Cells></Piece></UnstructuredGrid>
<AppendedData encoding="base64">_MAAAAAAAAAAAAOA/AAAAAAAA4D8AAAAAAADgPwAAAAAAAOA/AAAAAAAA4D8AAAAAAADgPw==
</AppendedData></VTKFile>
"""
LEGACY = """# vtk DataFile Version 3.0
three points
ASCII
DATASET UNSTRUCTURED_GRID
POINTS 3 double
0 0 0 1 0 0 0 1 0
CELLS 1 4
3 0 1 2
CELL_TYPES 1
5
POINT_DATA 3
VECTORS u float
0.5 0.5 0 0.5 0.5 0 0.5 0.5 0
"""


@pytest.mark.long
@pytest.mark.parametrize("count", [300, pytest.param(1000, marks=pytest.mark.nightly)])
@pytest.mark.parametrize(
    ("name", "whole"),
    [
        ("text.msh", MSH2.encode()),
        ("binary.msh", b"".join(map(bytes, binary_msh(b"4.0", "<")))),
        ("appended.vtu", VTU.encode()),
        ("text.vtk", LEGACY.encode()),
    ],
)
def test_damage_causes_no_unexpected_error(tmp_path, name, whole, count):
    path = tmp_path / name
    rng = np.random.default_rng(7)
    path.write_bytes(whole)
    mesh = read_fem(path)
    if "u" in mesh.parts.fields and name != "text.msh":
        assert mesh.point_field("u", [0, 1, 2]).tolist() == [[0.5, 0.5]] * 3
    refused = 0
    for _ in range(count):
        damaged = bytearray(whole[: rng.integers(len(whole)) if rng.random() < 0.2 else None])
        for place in rng.integers(len(damaged), size=rng.integers(1, 4)) if damaged else ():
            damaged[place] = rng.choice([rng.integers(256), 48 + rng.integers(10), 32, 10])
        path.write_bytes(damaged)
        try:
            mesh = read_fem(path)
            for field in mesh.parts.fields:
                mesh.point_field(field, [0, 1])
        except MeshFileError:
            refused += 1
    assert refused > count / 10


@pytest.mark.slow
def test_gmsh_and_the_solver_in_one_process(gmsh):
    script = """
import gmsh
from quasiharmonic import morph, surfaces
points, F = surfaces.grid(6, 6)
assert morph(points, F, [0], [[-0.1, -0.1]]).valid
"""
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0
