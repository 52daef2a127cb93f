"""Morphing of other libraries' meshes: conversion in both directions, and the command on their files."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from quasiharmonic import distortion, morph, surfaces
from quasiharmonic.geometry.exact.jacobian_signs import inverted_elements
from quasiharmonic.io import MeshFileError
from quasiharmonic.io.accepts_mesh import simulation_cells
from quasiharmonic.io.fem.files import read_fem
from quasiharmonic.ui.cli import main
from shared.simulation import quadrilaterals, second_order


def dent(points, depth=0.4):
    """Return the upper side of the unit square, and the target positions of a dent."""
    upper = np.flatnonzero(points[:, 1] == points[:, 1].max())
    return upper, points[upper] - depth * np.array([(0, 1)]) * np.sin(np.pi * points[upper, :1]) ** 2


def block(kind, rows):
    return SimpleNamespace(type=kind, data=rows)


def in_space(points):
    return np.column_stack([points, np.full(len(points), 3.0)])


TRIANGLES, QUADRILATERALS = surfaces.grid(4, 4), quadrilaterals(4, 4)
CURVED = second_order(*TRIANGLES)
# The names of each library for its parts, and the expected results.
STAND_INS = {
    "triangles of scikit-fem": (SimpleNamespace(doflocs=TRIANGLES[0].T, t=TRIANGLES[1].T), TRIANGLES),
    "quadrilaterals of scikit-fem": (
        SimpleNamespace(doflocs=QUADRILATERALS[0].T, t=QUADRILATERALS[1].T),
        QUADRILATERALS,
    ),
    "triangles of DOLFINx": (
        SimpleNamespace(geometry=SimpleNamespace(x=in_space(TRIANGLES[0]), dofmap=TRIANGLES[1].astype(np.int32))),
        TRIANGLES,
    ),
    "quadrilaterals of DOLFINx": (
        SimpleNamespace(geometry=SimpleNamespace(x=QUADRILATERALS[0], dofmap=QUADRILATERALS[1][:, [0, 1, 3, 2]])),
        QUADRILATERALS,
    ),
    # Node number 3 is opposite to corner 0 in this library.
    "second order of DOLFINx": (
        SimpleNamespace(geometry=SimpleNamespace(x=CURVED[0], dofmap=CURVED[1][:, [0, 1, 2, 4, 5, 3]])),
        CURVED,
    ),
    "meshio": (
        SimpleNamespace(
            points=in_space(CURVED[0]),
            cells=[block("line3", [[0, 1, 2]]), block("triangle6", CURVED[1][:5]), block("triangle6", CURVED[1][5:])],
        ),
        CURVED,
    ),
    "two kinds of meshio": (
        SimpleNamespace(
            points=QUADRILATERALS[0],
            cells=[block("quad", QUADRILATERALS[1][1:]), block("triangle", [[0, 1, 6], [0, 6, 5]])],
        ),
        (QUADRILATERALS[0], np.concatenate([QUADRILATERALS[1][1:], [[0, 1, 6, 6], [0, 6, 5, 5]]])),
    ),
    "PyVista": (
        SimpleNamespace(points=in_space(CURVED[0]), cells=np.zeros(7), cells_dict={21: [[0, 1, 2]], 22: CURVED[1]}),
        CURVED,
    ),
}
for mesh, (_, elements) in STAND_INS.values():
    if hasattr(mesh, "doflocs"):
        mesh.dofs = SimpleNamespace(element_dofs=elements.T)


@pytest.mark.parametrize("name", STAND_INS)
def test_supported_elements_are_converted(name):
    mesh, (points, F) = STAND_INS[name]
    found = simulation_cells(mesh)
    assert np.array_equal(found[0], points)
    assert np.array_equal(found[1], F)
    expected = morph(points, F, *dent(points))
    assert expected.valid
    assert np.array_equal(morph(mesh, *dent(points)).points, expected.points)


def test_unsupported_cells():
    points, F = QUADRILATERALS
    for cells, message in (
        ([block("tetra", F)], "of a SimpleNamespace have the cell type 'tetra'"),
        ([block("triangle6", CURVED[1]), block("quad", F)], "both six-node triangles and other elements"),
    ):
        with pytest.raises(ValueError, match=message):
            morph(SimpleNamespace(points=points, cells=cells), *dent(points))
    with pytest.raises(ValueError, match=r"\(f, 3\), \(f, 4\) or \(f, 6\)"):
        morph(SimpleNamespace(geometry=SimpleNamespace(x=points, dofmap=F[:, :2])), *dent(points))


# ---- libraries ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["MeshTri", "MeshQuad", "MeshTri2"])
def test_scikit_fem(kind):
    skfem = pytest.importorskip("skfem")
    coarse = (skfem.MeshQuad if kind == "MeshQuad" else skfem.MeshTri)().refined(3)
    mesh = skfem.MeshTri2.from_mesh(coarse) if kind == "MeshTri2" else coarse
    mesh = mesh.with_boundaries({"top": lambda x: x[1] == 1})
    morphed = morph(mesh, *dent(mesh.doflocs.T))
    back = replace(mesh, doflocs=morphed.points.T)
    assert morphed.valid
    assert np.array_equal(back.boundaries["top"], mesh.boundaries["top"])
    element = {"MeshTri": skfem.ElementTriP1, "MeshQuad": skfem.ElementQuad1, "MeshTri2": skfem.ElementTriP2}[kind]()
    before, after = (skfem.Basis(one, element, intorder=6) for one in (mesh, back))
    # The library's own determinants keep their signs at every integration point and add up to the area: ∫ 0.4 sin² is
    # 0.2.
    signs = [basis.mapping.detDF(basis.X) > 0 for basis in (before, after)]
    assert np.array_equal(*signs)
    assert after.dx.sum() == pytest.approx(0.8, abs=1e-3 if kind == "MeshTri2" else 1e-12)
    assert kind != "MeshTri" or np.array_equal(distortion(mesh, morphed.points).F, mesh.t.T)


@pytest.mark.parametrize("kind", ["triangle", "quad", "triangle6"])
def test_meshio(kind):
    meshio = pytest.importorskip("meshio")
    points, F = {"triangle": TRIANGLES, "quad": QUADRILATERALS, "triangle6": CURVED}[kind]
    mesh = meshio.Mesh(in_space(points), [(kind, F)])
    morphed = morph(mesh, *dent(points))
    mesh.points[:, :2] = morphed.points
    assert morphed.valid
    assert np.array_equal(mesh.points, in_space(morphed.points))


@pytest.mark.parametrize(("order", "recombined"), [(1, False), (1, True), (2, False)])
def test_gmsh(order, recombined):
    gmsh = pytest.importorskip("gmsh")
    gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.occ.addRectangle(0, 0, 0, 1, 1)
        gmsh.model.occ.synchronize()
        gmsh.option.setNumber("Mesh.MeshSizeMax", 0.2)
        if recombined:
            gmsh.model.mesh.setRecombine(2, 1)
        gmsh.model.mesh.generate(2)
        gmsh.model.mesh.setOrder(order)
        tags, places, _ = gmsh.model.mesh.getNodes()
        row = np.zeros(tags.max() + 1, dtype=np.int64)
        row[tags] = np.arange(len(tags))
        kinds, _, nodes = gmsh.model.mesh.getElements(dim=2)
        (F,) = (row[of].reshape(-1, {2: 3, 3: 4, 9: 6}[int(kind)]) for kind, of in zip(kinds, nodes, strict=True))
        points = places.reshape(-1, 3)[:, :2]
        morphed = morph(points, F, *dent(points))
        assert morphed.valid
        for tag, place in zip(tags, morphed.points, strict=True):
            gmsh.model.mesh.setNode(tag, [*place, 0], [])
        # The library's own measure: the smallest determinant over the largest.
        elements = np.concatenate(gmsh.model.mesh.getElements(dim=2)[1])
        assert min(gmsh.model.mesh.getElementQualities(elements, "minSJ" if order == 1 else "minDetJac")) > 0
        assert np.array_equal(gmsh.model.mesh.getNodes()[1].reshape(-1, 3)[:, :2], morphed.points)
    finally:
        gmsh.finalize()


@pytest.mark.parametrize("library", ["skfem", "meshio", "gmsh", "h5py"])
def test_examples_for_libraries_in_the_documentation(library, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if find_spec(library) is None or (library == "h5py" and find_spec("meshio") is None):
        pytest.skip(f"{library} is not installed; .ci/optional does it")
    page = (Path(__file__).parent.parent / "docs" / "howto" / "simulation_libraries.md").read_text(encoding="utf-8")
    (code,) = re.findall(rf"^```py\n# {library}\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    names = {}
    exec(compile(code, library, "exec"), names)
    assert names["morphed"].valid


# ---- the command ----------------------------------------------------------------------------------------------------


FORMATS = {
    "in.vtu": {},
    "in.vtk": {},
    "binary41.msh": {"file_format": "gmsh", "binary": True},
    "text22.msh": {"file_format": "gmsh22", "binary": False},
    "binary22.msh": {"file_format": "gmsh22", "binary": True},
}


def written(path, points, kind, F, depth=0.4):
    """Return a file with a displacement of the upper side."""
    meshlane = pytest.importorskip("meshlane")
    moved, positions = dent(points, depth)
    displacement = np.zeros((len(points), 3))
    displacement[moved, :2] = positions - points[moved]
    mesh = meshlane.Mesh(in_space(points), [(kind, F)], point_data={"u": displacement})
    meshlane.write(path, mesh, **FORMATS.get(path.name, {}))
    return path


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("kind", ["quad", "triangle6"])
def test_files_of_quadrilaterals_and_curved_triangles(tmp_path, capsys, kind, name):
    points, F = QUADRILATERALS if kind == "quad" else CURVED
    path, out = written(tmp_path / name, points, kind, F), tmp_path / f"out_{name}"
    assert np.array_equal(read_fem(path).F, F)
    assert main(["morph", str(path), "-o", str(out), "--field", "u", "--json", str(tmp_path / "report.json")]) == 0
    assert f"every {'quadrilateral' if kind == 'quad' else 'triangle'} is positive" in capsys.readouterr().out
    assert json.loads((tmp_path / "report.json").read_text())["valid"]
    assert np.array_equal(read_fem(out).points, morph(points, F, *dent(points)).points)
    assert not inverted_elements(F, read_fem(out).points).size


def test_a_chain_of_files(tmp_path, capsys):
    first = written(tmp_path / "first.vtu", *QUADRILATERALS[:1], "quad", QUADRILATERALS[1])
    once, twice, report = tmp_path / "once.vtu", tmp_path / "twice.vtu", tmp_path / "report.json"
    assert main(["morph", str(first), "-o", str(once), "--field", "u"]) == 0
    chain = ["morph", str(once), "-o", str(twice), "--field", "u", "--rest", str(first), "--json", str(report)]
    assert main(chain) == 0
    assert "maximum drift" in capsys.readouterr().out
    assert 0 <= json.loads(report.read_text())["drift"] < 1e-3
    other = written(tmp_path / "other.vtu", *QUADRILATERALS[:1], "quad", QUADRILATERALS[1][:-1])
    chain[chain.index(str(first))] = str(other)
    assert main(chain) == 2
    assert "must have the same nodes and elements" in capsys.readouterr().err


def test_files_whose_quadrilaterals_cannot_be_morphed(tmp_path, capsys):
    points, F = QUADRILATERALS
    bad = points.copy()
    bad[12] += 0.2
    path, out = written(tmp_path / "in.vtu", bad, "quad", F), tmp_path / "out.vtu"
    assert main(["morph", str(path), "-o", str(out), "--field", "u"]) == 2
    assert "quadrilateral 10 not convex" in capsys.readouterr().err
    assert not out.exists()
    # The side moves down by more than the height of the square, so corner elements are inverted.
    table = tmp_path / "to.csv"
    table.write_text("24 0.6 0.6\n")
    path = written(tmp_path / "good.vtu", points, "quad", F)
    assert main(["morph", str(path), "-o", str(out), "--positions", str(table)]) == 1
    said = capsys.readouterr().out
    assert "1 of 16 quadrilaterals are not positive" in said
    assert "Inverted for every position of the free nodes: quadrilateral 15" in said


def test_number_formats_in_tables(tmp_path):
    points, F = QUADRILATERALS
    path, table = written(tmp_path / "in.vtu", points, "quad", F), tmp_path / "to.csv"
    for text in ("24 1.25 1.5", "24, 1.25e0, +15.D-1", "24;1,25;1,5", "node\tx\ty\n24\t.125E+1\t1.5\n# end"):
        table.write_text(text)
        out = tmp_path / "out.vtu"
        assert main(["morph", str(path), "-o", str(out), "--positions", str(table)]) == 0
        assert read_fem(out).points[24].tolist() == [1.25, 1.5]


def test_a_path_in_place_of_a_mesh(tmp_path):
    points, F = QUADRILATERALS
    path = written(tmp_path / "in.vtu", points, "quad", F)
    assert np.array_equal(morph(path, *dent(points)).points, morph(points, F, *dent(points)).points)
    with pytest.raises(MeshFileError):
        morph(tmp_path / "none.msh", *dent(points))


def test_messages_on_unknown_files_list_formats_of_both_kinds():
    with pytest.raises(MeshFileError, match=r"\.xdmf files cannot be read; supported: \.obj, .*\.msh, .*\.mesh$"):
        morph("x.xdmf", [0], [[0, 0]])
