"""Planar meshes after their boundary has moved, and the files of finite-element programs."""

from __future__ import annotations

import codecs
import json

import numpy as np
import pytest

from quasiharmonic import Status, morph, surfaces
from quasiharmonic.energies.measures import mean_ratio
from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.io import MeshFileError
from quasiharmonic.io.fem.files import read_fem, write_fem
from quasiharmonic.ui.cli import main


def dented(points, depth):
    """Return vertices of the upper side of the unit square, and their target positions on a dent."""
    upper = np.flatnonzero(points[:, 1] == 1)
    x = points[upper, 0]
    return upper, np.stack([x, 1 - depth * np.sin(np.pi * x) ** 8], axis=1)


def test_quality_of_known_triangles():
    points = np.array([[0, 0], [1, 0], [0.5, np.sqrt(3) / 2], [0, 1], [2, 0]])
    F = [[0, 1, 2], [0, 1, 3], [0, 2, 1], [0, 1, 4]]
    assert mean_ratio(points, F) == pytest.approx([1, np.sqrt(3) / 2, -1, 0])
    # It does not depend on scale, over the whole range of doubles.
    for unit in (1e-160, 1e150):
        assert mean_ratio(points * unit, F) == pytest.approx([1, np.sqrt(3) / 2, -1, 0])


@pytest.mark.slow
def test_a_deep_dent_stays_valid_where_springs_invert_triangles():
    points, F = surfaces.grid(16, 16)
    moved, positions = dented(points, 0.9)
    # The usual smoothing, with equal weights for all neighbours, inverts triangles there.
    first = morph(points, F, moved, positions, energy=None)
    morphed = morph(points, F, moved, positions)
    assert first.valid
    assert morphed.valid
    assert np.array_equal(morphed.points[moved], positions)
    rest = np.setdiff1d(boundary_edges(F, len(points)), moved)
    assert np.array_equal(morphed.points[rest], points[rest])
    assert np.array_equal(mean_ratio(morphed.points, F), morphed.quality_after)
    assert morphed.quality_after.min() > 0
    assert morphed.quality_after.mean() > first.quality_after.mean()
    assert json.loads(json.dumps(morphed.to_dict()))["quality_after"]["minimum"] > 0


@pytest.mark.slow
def test_more_iterations_lower_the_energy_further():
    """The hole of a square almost touches the outer side."""
    points, F = surfaces.annulus(6)
    body = np.flatnonzero(np.abs(points).max(axis=1) <= np.abs(points).max(axis=1).min())
    first = morph(points, F, body, points[body] + [0.4999, 0])
    assert first.status is Status.STILL_FALLING
    longer = morph(points, F, body, points[body] + [0.4999, 0], max_iterations=10_000)
    assert longer.status is Status.POLISHED
    assert longer.n_iterations > 2 * first.n_iterations


def test_without_moved_vertices_nothing_changes():
    points, F = surfaces.random_delaunay(200, seed=2)
    kept = points.copy()
    morphed = morph(points, F, [], np.empty((0, 2)))
    assert morphed.points == pytest.approx(points, abs=1e-9)
    assert np.array_equal(points, kept)


def test_any_winding_and_unused_vertices():
    points, F = surfaces.grid(6, 6)
    moved, positions = dented(points, 0.3)
    plain = morph(points, F, moved, positions)
    mixed = F.copy()
    mixed[::3] = mixed[::3, ::-1]
    spaced = np.concatenate([[[9.0, 9.0]], points, [[7.0, 7.0]]])
    other = morph(spaced, mixed + 1, moved + 1, positions)
    assert other.valid
    assert other.points[1:-1] == pytest.approx(plain.points, abs=1e-12)
    assert np.array_equal(other.points[[0, -1]], [[9, 9], [7, 7]])


def test_interior_vertices_can_be_moved():
    points, F = surfaces.grid(10, 10)
    middle = np.flatnonzero((np.abs(points - 0.5) < 1e-9).all(axis=1))
    morphed = morph(points, F, middle, [[0.8, 0.2]])
    assert morphed.valid
    assert np.array_equal(morphed.points[middle], [[0.8, 0.2]])


def test_a_boundary_that_crosses_itself_is_reported():
    points, F = surfaces.grid(8, 8)
    moved, positions = dented(points, 1.5)
    morphed = morph(points, F, moved, positions, max_iterations=60)
    assert not morphed.valid
    assert morphed.result.status in (Status.IMPOSSIBLE, Status.STALLED, Status.OUT_OF_ITERATIONS)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (lambda p, F: (p, F, [-1], [[0, 0]]), "vertex -1"),
        (lambda p, F: (p, F, [10**6], [[0, 0]]), "vertex 1000000"),
        (lambda p, F: (p, F, [0], [[0, 0, 0]]), r"shape \(1, 2\)"),
        (lambda p, F: (p, F, [0.5], [[0, 0]]), "moved_vertices must contain integer indices, not float64"),
        (lambda p, F: (p[:, :1], F, [0], [[0, 0]]), r"shape \(n, 2\)"),
        (lambda p, F: (p, F[:0], [0], [[0, 0]]), "the mesh has no triangles"),
        (lambda p, F: (p, F + 1, [0], [[0, 0]]), "F refers to vertex 16, but there are only vertices 0 … 15"),
        (lambda p, F: (p, F, [0, 1], [[0, 0], [0, np.nan]]), "target is not finite at row 1"),
        (
            lambda p, F: (np.where(np.arange(16)[:, None] == 5, np.nan, p), F, [0], [[0, 0]]),
            "points is not finite at vertex 5",
        ),
        (lambda p, F: (p * (1, 0), F, [0], [[0, 0]]), "triangles 0, 1, .* degenerate"),
        (lambda p, F: (np.where(np.arange(16)[:, None] == 5, 0.9, p), F, [0], [[0, 0]]), "folded at edge.* rest="),
        (lambda p, F: (np.concatenate([p, [[9, 9]]]), F, [len(p)], [[0, 0]]), "vertex 16, but no triangle uses"),
    ],
)
def test_wrong_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        morph(*arguments(*surfaces.grid(3, 3)))


@pytest.fixture
def plate(tmp_path):
    """Return a function that writes a plate of two materials with finite-element data, in a format."""
    meshlane = pytest.importorskip("meshlane")
    flat, F = surfaces.grid(8, 8)
    # Ordered as Gmsh orders its points: those of the upper side, of the left material, of the right one.
    entity = np.where(flat[:, 1] == 1, 0, 1 + (flat[:, 0] > 0.5))
    order = np.argsort(entity, kind="stable")
    flat, F, entity = flat[order], np.argsort(order)[F], entity[order]
    upper = np.flatnonzero(flat[:, 1] == 1)
    line = np.stack([upper[:-1], upper[1:]], axis=1)
    left = flat[F][:, :, 0].mean(axis=1) < 0.5
    displacement = np.zeros((len(flat), 3))
    moved, positions = dented(flat, 0.6)
    displacement[moved, :2] = positions - flat[moved]

    def write(name, **options):
        mesh = meshlane.Mesh(
            np.column_stack([flat, np.full(len(flat), 2.0)]),
            [("line", line), ("triangle", F[left]), ("triangle", F[~left])],
        )
        if name.endswith(".msh"):
            mesh.cell_data = {
                "gmsh:physical": [np.full(len(line), 7), np.full(left.sum(), 1), np.full((~left).sum(), 2)],
                "gmsh:geometrical": [np.full(len(line), 3), np.full(left.sum(), 1), np.full((~left).sum(), 2)],
            }
            mesh.field_data = {"upper side": np.array([7, 1]), "steel": np.array([1, 2]), "air": np.array([2, 2])}
            if "41" in name:
                mesh.point_data = {"gmsh:dim_tags": np.array([(1, 3), (2, 1), (2, 2)])[entity]}
        else:
            mesh.cell_data = {"stress": [np.arange(len(block.data)) * 1.5 for block in mesh.cells]}
        mesh.point_data.update({"displacement": displacement, "T": np.sin(flat[:, 0] * 9)})
        path = tmp_path / name
        meshlane.write(path, mesh, **options)
        return path

    return write


FORMATS = {
    "ascii41.msh": {"file_format": "gmsh", "binary": False},
    "binary41.msh": {"file_format": "gmsh", "binary": True},
    "ascii22.msh": {"file_format": "gmsh22", "binary": False},
    "binary22.msh": {"file_format": "gmsh22", "binary": True},
    "grid.vtu": {},
    "grid.vtk": {},
}


@pytest.mark.parametrize("name", FORMATS)
def test_all_data_but_positions_is_preserved(plate, tmp_path, name, capsys):
    import meshlane

    path = plate(name, **FORMATS[name])
    out, report = tmp_path / f"morphed_{name}", tmp_path / "report.json"
    assert main(["morph", str(path), "-o", str(out), "--field", "displacement", "--json", str(report)]) == 0
    said = capsys.readouterr().out
    assert said.startswith(f"wrote {out}: every triangle is positive")
    assert json.loads(report.read_text())["injective"]

    before, after = meshlane.read(path), meshlane.read(out)
    assert [block.type for block in after.cells] == [block.type for block in before.cells]
    for old, new in zip(before.cells, after.cells, strict=True):
        assert np.array_equal(old.data, new.data)
    assert set(after.point_data) == set(before.point_data)
    for key, values in before.point_data.items():
        assert np.array_equal(after.point_data[key], values), key
    assert set(after.cell_data) == set(before.cell_data)
    for key, blocks in before.cell_data.items():
        for old, new in zip(blocks, after.cell_data[key], strict=True):
            assert np.array_equal(old, new), key
    assert {key: list(value) for key, value in after.field_data.items()} == {
        key: list(value) for key, value in before.field_data.items()
    }
    assert (after.points[:, 2] == 2).all()
    # Positions are those that the function computes, to the last bit.
    mesh = read_fem(path)
    moved = np.unique(boundary_edges(mesh.F, len(mesh.points)))
    expected = morph(mesh.points, mesh.F, moved, mesh.points[moved] + mesh.point_field("displacement", moved)).points
    assert np.array_equal(after.points[:, :2], expected)
    if name.endswith(".msh"):
        assert path.read_bytes()[:40].split()[:4] == out.read_bytes()[:40].split()[:4]


def test_positions_from_a_table(plate, tmp_path):
    path, table, out = plate("grid.vtu"), tmp_path / "to.csv", tmp_path / "out.vtu"
    corner = int(np.flatnonzero((read_fem(path).points == 1).all(axis=1))[0])
    table.write_bytes(codecs.BOM_UTF8 + f"vertex;x;y\n# the corner\n{corner}; 1.25;1.5\n".encode())
    assert main(["morph", str(path), "-o", str(out), "--positions", str(table), "--no-polish"]) == 0
    assert read_fem(out).points[corner].tolist() == [1.25, 1.5]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0,1", "not 3 numbers: '0,1' at line 1"),
        ("0,1,2\nzero,1,2", "'zero' is not a finite number at line 2"),
        ("81,0,0", "from 0 to 80"),
        ("-1,0,0", "-1 is not a vertex from 0 to 80 at line 1"),
        ("0,nan,0", "'nan' is not a finite number at line 1"),
        ("0,0,0,0", "not 3 numbers"),
        ("", "moves no vertex"),
        ("3,0,0\n4,0,0\n3,1,0", "to.csv: lists vertex 3 a second time at line 3"),
    ],
)
def test_tables_that_cannot_be_read(plate, tmp_path, capsys, text, message):
    path, table, out = plate("grid.vtu"), tmp_path / "to.csv", tmp_path / "out.vtu"
    table.write_text(text)
    assert main(["morph", str(path), "-o", str(out), "--positions", str(table)]) == 2
    assert message in capsys.readouterr().err
    assert not out.exists()


def test_a_missing_table(plate, tmp_path, capsys):
    out, table = tmp_path / "out.vtu", tmp_path / "none.csv"
    assert main(["morph", str(plate("grid.vtu")), "-o", str(out), "--positions", str(table)]) == 2
    assert capsys.readouterr().err.strip() == f"qhm morph: {table}: there is no such file"


def test_meshes_that_cannot_be_morphed(plate, tmp_path, capsys):
    import meshlane

    path, out = plate("grid.vtu"), tmp_path / "out.vtu"
    assert main(["morph", str(path), "-o", str(out), "--field", "wind"]) == 2
    assert "no point data 'wind'; available: 'T', 'displacement'" in capsys.readouterr().err
    assert main(["morph", str(path), "-o", str(out), "--field", "T"]) == 2
    assert "not plane vectors" in capsys.readouterr().err
    assert main(["morph", str(path), "-o", str(path), "--field", "displacement"]) == 2
    assert "would replace an input" in capsys.readouterr().err
    garbage = tmp_path / "garbage.msh"
    garbage.write_bytes(b"$MeshFormat\n\xff\xff")
    with pytest.raises(MeshFileError, match="cannot be read"):
        read_fem(garbage)
    for name, cells, message in (
        ("solid", [("tetra", [[0, 1, 2, 3]])], "cells of type tetrahedron"),
        ("line", [("line", [[0, 1]])], "has no triangles"),
        ("bent", [("triangle", [[0, 1, 2]])], "is not planar"),
    ):
        meshlane.write(tmp_path / f"{name}.vtu", meshlane.Mesh([[0, 0, 0], [1, 0, 0], [1, 1, 1], [0, 1, 0.0]], cells))
        with pytest.raises(MeshFileError, match=message):
            read_fem(tmp_path / f"{name}.vtu")
    with pytest.raises(
        ValueError, match=r"points must have shape \(81, 2\), one position for each vertex, not \(3, 2\)"
    ):
        write_fem(out, read_fem(path), np.zeros((3, 2)))
    assert not out.exists()


def test_a_mesh_that_overlaps_itself_says_so():
    points, F = surfaces.grid(40, 2)
    points[:, 0] *= 20
    edge = np.unique(boundary_edges(F, len(points)))
    angle, radius = np.radians(430) * points[edge, 0] / 20, 5 - points[edge, 1]
    result = morph(points, F, edge, np.stack([radius * np.sin(angle), -radius * np.cos(angle)], axis=1))
    assert result.success
    assert "overlaps itself" in result.summary()


def test_the_message_says_what_ended_the_search_early():
    points, F = surfaces.grid(8, 8)
    moved, positions = dented(points, 0.9)
    assert not morph(points, F, moved, positions, energy=None, max_iterations=1).valid
    for energy, limit, valid, status in (
        (None, 1, False, Status.OUT_OF_ITERATIONS),
        (None, 2000, False, Status.INTERRUPTED),
        ("mips", 2000, True, Status.INTERRUPTED),
    ):
        calls = []

        def stop(step, calls=calls, valid=valid):
            calls.append(step)
            if step.inverted == 0 if valid else len(calls) == 3:
                raise KeyboardInterrupt

        callback = stop if status is Status.INTERRUPTED else None
        result = morph(points, F, moved, positions, energy=energy, max_iterations=limit, callback=callback)
        assert (result.valid, result.success, result.status) == (valid, False, status)
        assert result.message == status.value
        assert "Move the boundary less" not in result.summary()
