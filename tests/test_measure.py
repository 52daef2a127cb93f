"""``qhm measure``, ``plot`` and ``view``, and values per triangle in files."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from matplotlib.image import imread

from quasiharmonic import distortion, io, surfaces
from quasiharmonic.energies.measures import MEASURES
from quasiharmonic.ui.cli import main
from quasiharmonic.ui.cli.arguments import MEASURES as OFFERED


@pytest.fixture
def stretched(tmp_path):
    """A file with a grid stretched to 3 × 1, its triangles, and its map."""
    V, F = surfaces.grid(6, 5)
    uv = V * (3, 1) + np.sin(V[:, ::-1] * 3) * 0.01
    path = tmp_path / "map.obj"
    io.write_map(path, io.MeshData(V, F), uv)
    return path, V, F, uv


def test_the_command_offers_every_measure():
    assert OFFERED == MEASURES


def test_csv_contains_every_digit(stretched, tmp_path):
    path, V, F, uv = stretched
    assert main(["measure", str(path), "--export", str(tmp_path / "faces.csv")]) == 0
    with open(tmp_path / "faces.csv", encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    found = distortion(V, F, uv).per_triangle()
    assert [int(row["triangle"]) for row in rows] == list(range(len(F)))
    for name in MEASURES:
        assert np.array_equal([float(row[name]) for row in rows], found[name]), name


def test_npz_contains_the_arrays(stretched, tmp_path):
    path, V, F, uv = stretched
    assert main(["measure", str(path), "--export", str(tmp_path / "faces.npz")]) == 0
    with np.load(tmp_path / "faces.npz") as file:
        assert np.array_equal(file["F"], F)
        assert np.array_equal(file["uv"], uv)
        assert np.array_equal(file["mips"], distortion(V, F, uv).mips)


def test_other_programs_read_ply(stretched, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    path, V, F, uv = stretched
    assert main(["measure", str(path), "--export", str(tmp_path / "faces.ply")]) == 0
    mesh = trimesh.load(tmp_path / "faces.ply", process=False)
    assert np.array_equal(mesh.faces, F)
    raw = mesh.metadata["_ply_raw"]
    found = distortion(V, F, uv)
    assert np.array_equal(raw["face"]["data"]["quality"].ravel(), found.isometric)
    assert np.array_equal(raw["face"]["data"]["shear"].ravel(), found.shear)
    assert np.array_equal(raw["vertex"]["data"]["s"].ravel(), uv[:, 0])


def test_ply_according_to_its_header(stretched, tmp_path):
    _, V, F, uv = stretched
    io.write_per_triangle(tmp_path / "faces.ply", V, F, uv, {"half": np.full(len(F), 0.5)})
    header, body = (tmp_path / "faces.ply").read_bytes().split(b"end_header\n")
    assert header.decode().splitlines()[-4:] == [
        f"element face {len(F)}",
        "property list uchar int vertex_indices",
        "property double quality",
        "property double half",
    ]
    vertices, faces = body[: 40 * len(V)], body[40 * len(V) :]
    assert np.array_equal(np.frombuffer(vertices, "<f8").reshape(-1, 5)[:, 3:], uv)
    rows = np.frombuffer(faces, [("n", "u1"), ("corners", "<i4", 3), ("values", "<f8", 2)])
    assert np.array_equal(rows["corners"], F)
    assert (rows["n"] == 3).all()
    assert (rows["values"] == 0.5).all()


@pytest.mark.parametrize("suffix", io.suffixes("encode_values"))
@pytest.mark.parametrize("name", ["triangle", "F", "uv", "file", "allow_pickle", "vertex_indices", "quality"])
def test_names_that_the_formats_reserve(stretched, tmp_path, suffix, name):
    _, V, F, uv = stretched
    one = np.ones(len(F))
    with pytest.raises(ValueError, match="choose another name"):
        io.write_per_triangle(tmp_path / f"o{suffix}", V, F, uv, {"one": one, name: one})
    assert not (tmp_path / f"o{suffix}").exists()


def test_values_that_cannot_be_written(stretched, tmp_path):
    _, V, F, uv = stretched
    one = np.ones(len(F))
    with pytest.raises(io.MeshFileError, match=r"\.txt files cannot store values per triangle; .*\.ply, \.csv, \.npz"):
        io.write_per_triangle(tmp_path / "faces.txt", V, F, uv, {"one": one})
    with pytest.raises(ValueError, match="not a word"):
        io.write_per_triangle(tmp_path / "faces.csv", V, F, uv, {"one, two": one})
    with pytest.raises(ValueError, match=r"one must have shape \(60,\), one for each triangle, not \(59,\)"):
        io.write_per_triangle(tmp_path / "faces.csv", V, F, uv, {"one": one[1:]})
    with pytest.raises(ValueError, match="uv must have shape"):
        io.write_per_triangle(tmp_path / "faces.csv", V, F, uv[1:], {"one": one})


def test_measure_reports(stretched, capsys):
    path, V, F, uv = stretched
    assert main(["measure", str(path), "--json", "-"]) == 0
    output = capsys.readouterr()
    facts = json.loads(output.out)
    assert facts["triangles"] == len(F)
    assert facts["conformal"]["median"] == distortion(V, F, uv).statistics("conformal").median
    assert "0 of 60 triangles inverted" in output.err
    assert "isometric" in output.err


def test_a_flat_surface_without_texture_coordinates_is_noted(stretched, tmp_path, capsys):
    V, F = surfaces.disk(3)
    io.write_map(tmp_path / "flat.off", io.MeshData(V, F), V)
    for path, noted in ((tmp_path / "flat.off", True), (stretched[0], False)):
        assert main(["measure", str(path)]) == 0
        assert ("flat and equal to the map" in capsys.readouterr().out) == noted


def test_measure_of_inverted_and_flat_triangles(tmp_path, capsys):
    path = tmp_path / "flat.obj"
    io.write_map(path, io.MeshData([[0, 0], [1, 0], [2, 0]], [[0, 1, 2]]), [[0, 0], [1, 0], [0, 1]])
    assert main(["measure", str(path), "--export", str(tmp_path / "faces.csv")]) == 0
    assert "undefined" in capsys.readouterr().out
    assert (tmp_path / "faces.csv").read_text().splitlines()[1].split(",")[1] == "nan"


@pytest.mark.long
@pytest.mark.parametrize(("kind", "size"), [("map", (450, 800)), ("distortion", (450, 1350)), ("texture", (480, 960))])
def test_plot(stretched, tmp_path, kind, size):
    picture = tmp_path / "picture.png"
    measure = ["--measure", "mips"] if kind == "distortion" else []
    assert main(["plot", str(stretched[0]), "-o", str(picture), "--kind", kind, *measure]) == 0
    assert imread(picture).shape[:2] == size


@pytest.mark.parametrize("arguments", [["plot", "-o", "map.png"], ["view", "--screenshot", "map.png"]])
def test_pictures_of_broken_maps(tmp_path, monkeypatch, capsys, arguments):
    monkeypatch.chdir(tmp_path)
    mesh = tmp_path / "mesh.obj"
    io.write_obj(mesh, io.MeshData([[0, 0, 0], [1, 0, 0], [0, 1, 1.0]], [[0, 1, 2]]))
    assert main([*arguments, str(mesh)]) == 2
    assert capsys.readouterr().err.startswith(f"qhm {arguments[0]}: {mesh}: has no map")
    assert [file.name for file in tmp_path.iterdir()] == ["mesh.obj"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["plot", "-o", "picture.jpg"], "written as .png"),
        (["plot", "-o", "nowhere/picture.png"], "no directory"),
        (["measure", "--export", "faces.xlsx"], "supported: .ply, .csv, .npz"),
        (["measure", "--json", "map.obj"], "would replace an input"),
        (["view", "--screenshot", "picture.gif"], "written as .png"),
    ],
)
def test_invalid_outputs(stretched, tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert main([*arguments, "map.obj"]) == 2
    assert message in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["map.obj"]


def test_flat_triangles_of_opposite_orientation(tmp_path, capsys):
    io.write_obj(tmp_path / "flip.obj", io.MeshData([[0, 0], [1, 0], [1, 1], [0, 1]], [[0, 1, 2], [0, 3, 2]]))
    assert main(["measure", str(tmp_path / "flip.obj")]) == 0
    assert "mirrored island 1 measured with reversed orientation" in capsys.readouterr().out


@pytest.mark.long
def test_vertices_without_a_triangle_have_no_position(stretched, tmp_path):
    path, V, F, uv = stretched
    spaced = np.concatenate([[[9, 9]], V])
    io.write_obj(path, io.MeshData(spaced, F + 1, vt=uv, FT=F))
    assert main(["check", str(path)]) == 0
    assert main(["measure", str(path), "--export", str(tmp_path / "faces.npz")]) == 0
    with np.load(tmp_path / "faces.npz") as file:
        assert file["mips"] == pytest.approx(distortion(V, F, uv).mips)
    for kind in ("map", "texture"):
        assert main(["plot", str(path), "-o", str(tmp_path / f"{kind}.png"), "--kind", kind]) == 0
