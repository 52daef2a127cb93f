"""``qhm transfer``: values, positions and landmarks go to the corresponding points of another surface."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

from quasiharmonic import io
from quasiharmonic.surfaces import grid
from quasiharmonic.ui.cli import main


def height(p):
    return p[:, 0] - 2 * p[:, 1]


@pytest.fixture
def files(tmp_path, monkeypatch):
    """Two meshes of one unit square, mapped by the identity: the source is a graph over the square, the target flat."""
    monkeypatch.chdir(tmp_path)
    (a, F), (b, G) = grid(4, 5), grid(7, 3)
    io.write_map("a.obj", io.MeshData(np.column_stack([3 * a, height(a)]), F), a)
    io.write_map("b.obj", io.MeshData(b, G), b)
    return a, F, b, G


def test_linear_data_are_transferred_exactly(files, capsys):
    a, F, b, G = files
    np.savetxt("v.csv", np.column_stack([height(a), a[:, 0]]), delimiter=",", header="height,x", comments="")
    np.savetxt("marks.txt", [7, 0], fmt="%d")
    np.save("t.npy", np.arange(len(F)))
    arguments = "--values v.csv out.csv --landmarks marks.txt marks.csv -o shape.ply --json r.json"
    assert main(f"transfer a.obj b.obj {arguments}".split()) == 0
    assert "Both maps are bijective" in capsys.readouterr().out
    expected = np.column_stack([height(b), b[:, 0]])
    np.testing.assert_allclose(np.loadtxt("out.csv", delimiter=","), expected, atol=1e-14)
    shape = io.read_mesh("shape.ply")
    np.testing.assert_allclose(shape.V, np.column_stack([3 * b, height(b)]), atol=1e-14)
    np.testing.assert_array_equal(shape.F, G)
    np.testing.assert_array_equal(io.map_of(shape), b)
    with open("marks.csv", encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["vertex"] for row in rows] == ["7", "0"]
    for row, mark in zip(rows, (7, 0), strict=True):
        corners = G[int(row["triangle"])]
        weights = [float(row[f"weight_{k}"]) for k in range(3)]
        np.testing.assert_allclose(weights @ b[corners], a[mark], atol=1e-14)
        np.testing.assert_allclose([float(row["x"]), float(row["y"])], a[mark], atol=1e-14)
        assert int(row["nearest_vertex"]) == corners[np.argmax(weights)]
    with open("r.json", encoding="utf-8") as file:
        facts = json.load(file)
    assert facts["onto"]
    assert facts["outside"] == 0
    assert main(["transfer", "a.obj", "b.obj", "--values", "t.npy", "t_out.npy", "--per", "triangle"]) == 0
    assert np.isin(np.load("t_out.npy"), np.arange(len(F))).all()


def test_several_files_are_transferred(files, capsys):
    a, _, b, _ = files
    np.savetxt("v.txt", height(a))
    np.savetxt("m.txt", [1], fmt="%d")
    twice = "--values v.txt 1.npy --values v.txt 2.csv --landmarks m.txt m1.csv --landmarks m.txt m2.csv"
    assert main(f"transfer a.obj b.obj {twice}".split()) == 0
    np.testing.assert_allclose(np.load("1.npy"), height(b), atol=1e-14)
    np.testing.assert_array_equal(np.loadtxt("2.csv"), np.load("1.npy"))
    assert np.loadtxt("m1.csv", delimiter=",", skiprows=1)[0] == np.loadtxt("m2.csv", delimiter=",", skiprows=1)[0] == 1
    assert main(["transfer", "a.obj", "b.obj", "--values", "v.txt", "3.npy", "--values", "v.txt", "3.npy"]) == 2
    assert "--values (2) 3.npy is also the file of --values" in capsys.readouterr().err


def test_seams_and_unused_vertices(files):
    a, F, b, _ = files
    # The left half of the source is shifted in the plane, and the target's last vertex belongs to no triangle.
    left = a[F][:, :, 0].mean(axis=1) < 0.5
    places = a[F] + np.where(left, 0, 5)[:, None, None] * [1, 0]
    mesh = io.MeshData(np.column_stack([a, height(a)]), F)
    mesh = io.read_mesh("a.obj").with_places(
        io.seamed(mesh).__class__(mesh.V, F, np.arange(F.size).reshape(-1, 3), places.reshape(-1, 2))
    )
    io.write_mapped("cut.obj", mesh)
    np.savetxt("v.txt", height(a))
    assert main(["transfer", "cut.obj", "b.obj", "--values", "v.txt", "out.txt", "--outside", "nan"]) == 0
    out, inside = np.loadtxt("out.txt"), b[:, 0] < 0.45
    np.testing.assert_allclose(out[inside], height(b[inside]), atol=1e-14)
    assert np.isnan(out[b[:, 0] > 0.55]).all()
    assert main(["transfer", "cut.obj", "b.obj", "-o", "x.obj", "--outside", "nan"]) == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("", "nothing to transfer"),
        ("--values v.csv out.xyz", "written as .npy, .csv, .txt"),
        ("--values short.csv out.csv", "has 3 rows, but a.obj has"),
        ("--landmarks short.csv out.csv --per triangle", "--per needs --values"),
        ("--values v.csv v.csv", "would replace an input"),
        ("-o out.off", "cannot store seams"),
    ],
)
def test_wrong_calls_write_nothing(files, tmp_path, capsys, arguments, message):
    np.savetxt("short.csv", [1, 2, 3])
    np.savetxt("v.csv", files[0])
    before = set(tmp_path.iterdir())
    assert main(f"transfer a.obj b.obj {arguments}".split()) == 2
    assert message in capsys.readouterr().err
    assert set(tmp_path.iterdir()) == before


def test_a_map_that_is_not_bijective_is_rejected(files, tmp_path, capsys):
    a, F, _, _ = files
    folded = a.copy()
    folded[np.argmin(((a - 0.5) ** 2).sum(axis=1))] = 2
    io.write_map("bad.obj", io.MeshData(a, F), folded)
    np.savetxt("v.csv", a)
    assert main(["transfer", "bad.obj", "b.obj", "--values", "v.csv", "out.csv"]) == 2
    assert "bad.obj: this map has no inverse" in capsys.readouterr().err
    assert not (tmp_path / "out.csv").exists()
