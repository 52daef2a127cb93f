"""``qhm check``, ``measure`` and ``plot`` of finite-element meshes, as ``qhm morph`` writes them."""

from __future__ import annotations

import json

import numpy as np
import pytest

from quasiharmonic.surfaces import grid
from quasiharmonic.ui.cli import main

CELLS = {
    "triangles": (np.array([[0, 1, 2], [0, 2, 3]]), 5),
    "quadrilaterals": (np.array([[0, 1, 2, 3]]), 9),
}
SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def write_vtk(path, points, cells, kind):
    """Write a legacy VTK file in text."""
    lines = ["# vtk DataFile Version 3.0", "mesh", "ASCII", "DATASET UNSTRUCTURED_GRID", f"POINTS {len(points)} double"]
    lines += [f"{float(x)!r} {float(y)!r} 0.0" for x, y in points]
    lines += [f"CELLS {len(cells)} {cells.size + len(cells)}"]
    lines += [" ".join(map(str, [len(cell), *cell.tolist()])) for cell in cells]
    lines += [f"CELL_TYPES {len(cells)}", *[str(kind)] * len(cells)]
    path.write_text("\n".join(lines) + "\n")
    return path


def run(capsys, command, path, *options):
    """The exit status and the report."""
    status = main([command, str(path), *options, "--json", "-"])
    return status, json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("name", CELLS)
def test_valid_meshes_pass(tmp_path, capsys, name):
    path = write_vtk(tmp_path / "a.vtk", SQUARE, *CELLS[name])
    status, facts = run(capsys, "check", path)
    assert (status, facts["injective"], facts["elements"]) == (0, True, len(CELLS[name][0]))
    status, facts = run(capsys, "measure", path)
    assert status == 0
    assert 0.8 < facts["quality"]["minimum"] <= facts["quality"]["mean"] <= 1
    assert main(["plot", str(path), "-o", str(tmp_path / "a.png")]) == 0
    assert (tmp_path / "a.png").stat().st_size > 1000


@pytest.mark.parametrize("name", CELLS)
def test_inverted_elements_are_named(tmp_path, capsys, name):
    bent = SQUARE.copy()
    bent[2] = -0.2
    path = write_vtk(tmp_path / "a.vtk", bent, *CELLS[name])
    status, facts = run(capsys, "check", path)
    assert (status, facts["injective"]) == (1, False)
    assert facts["inverted"]
    status, facts = run(capsys, "measure", path)
    assert facts["quality"]["minimum"] < 0


def test_what_morph_writes_is_accepted(tmp_path, capsys):
    points, F = grid(4, 4)
    source = write_vtk(tmp_path / "in.vtk", points, F, 5)
    (tmp_path / "to.csv").write_text("0,-0.1,-0.1\n")
    out = tmp_path / "out.vtk"
    assert main(["morph", str(source), "-o", str(out), "--positions", str(tmp_path / "to.csv")]) == 0
    capsys.readouterr()
    assert run(capsys, "check", out)[0] == 0


@pytest.mark.parametrize("kind", [5, 9])
def test_elements_that_overlap_are_named(tmp_path, capsys, kind):
    points, triangles = grid(2, 2)
    cells = triangles if kind == 5 else np.array([[0, 1, 4, 3], [1, 2, 5, 4], [3, 4, 7, 6], [4, 5, 8, 7]])
    for shift, overlapping in (((1, 0.3), 0), ((1, 1), 0), ((0.5, 0.5), 4 if kind == 5 else 2)):
        both = np.concatenate([points, points + shift])
        path = write_vtk(tmp_path / "a.vtk", both, np.concatenate([cells, cells + len(points)]), kind)
        status, facts = run(capsys, "check", path)
        assert (status, facts["injective"], len(facts["overlapping"])) == (0, True, overlapping)
        main(["check", str(path)])
        assert ("The mesh overlaps itself" in capsys.readouterr().out) == bool(overlapping)


@pytest.mark.parametrize("name", CELLS)
def test_morph_names_clockwise_elements(tmp_path, capsys, name):
    cells, kind = CELLS[name]
    source = write_vtk(tmp_path / "a.vtk", SQUARE, np.concatenate([cells[:1, ::-1], cells[1:]]), kind)
    (tmp_path / "to.csv").write_text("0,-0.1,-0.1\n")
    call = "-o", str(tmp_path / "b.vtk"), "--positions", str(tmp_path / "to.csv")
    status, facts = run(capsys, "morph", source, *call)
    assert (status, facts["injective"], facts["reversed"]) == (0, True, 1)
    main(["morph", str(source), *call])
    assert "The file lists 1 element in the opposite order of vertices." in capsys.readouterr().out
    status, facts = run(capsys, "check", tmp_path / "b.vtk")
    assert (status, facts["inverted"]) == (1, [0])


def test_sliding_needs_polishing(tmp_path, capsys):
    source = write_vtk(tmp_path / "a.vtk", SQUARE, *CELLS["triangles"])
    (tmp_path / "to.csv").write_text("0,-0.1,-0.1\n")
    call = "-o", str(tmp_path / "b.vtk"), "--positions", str(tmp_path / "to.csv")
    assert main(["morph", str(source), *call, "--slide", "--no-polish"]) == 2
    assert "--slide of planar meshes needs polishing: omit --no-polish" in capsys.readouterr().err


@pytest.mark.parametrize("call", [("measure",), ("plot", "-o", "a.png")])
def test_points_of_tetrahedra_must_be_finite(tmp_path, capsys, monkeypatch, call):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.vtk").write_text(
        "# vtk DataFile Version 3.0\nmesh\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 5 double\n"
        "nan 0 0 0 0 0 1 0 0 0 1 0 0 0 nan\nCELLS 1 5\n4 1 2 3 4\nCELL_TYPES 1\n10\n"
    )
    assert main([call[0], "a.vtk", *call[1:]]) == 2
    assert "a.vtk: not finite at point 4 (0-based)" in capsys.readouterr().err


def test_headings_and_quotes_of_positions(tmp_path, capsys):
    points, F = grid(4, 4)
    source, positions = write_vtk(tmp_path / "in.vtk", points, F, 5), tmp_path / "to.csv"
    call = ["morph", str(source), "-o", str(tmp_path / "out.vtk"), "--positions", str(positions)]
    for text in ("vertex,x,y\n0,-0.1,-0.1\n", '"Node";"X";"Y"\n"0";"-0,1";"-0,1"\n', '"0","-0.1","-0.1"\n'):
        positions.write_text(text)
        assert main(call) == 0
    capsys.readouterr()
    positions.write_text("vertex,y,x\n0,-0.1,-0.1\n")
    assert main(call) == 2
    assert "the columns are not in the order x, y" in capsys.readouterr().err


@pytest.mark.parametrize(
    "call",
    [
        ("check", "--as", "float32"),
        ("check", "--any-triangulation"),
        ("measure", "--distances"),
        ("measure", "--export", "a.csv"),
        ("plot", "-o", "a.png", "--kind", "distortion"),
        ("plot", "-o", "a.png", "--texture", "checkerboard"),
    ],
)
def test_options_for_surfaces_are_rejected(tmp_path, capsys, monkeypatch, call):
    monkeypatch.chdir(tmp_path)
    write_vtk(tmp_path / "a.vtk", SQUARE, *CELLS["triangles"])
    command, *options = call
    assert main([command, "a.vtk", *options]) == 2
    assert "needs a surface with a map" in capsys.readouterr().err
