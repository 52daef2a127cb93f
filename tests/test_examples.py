"""Every script of examples/ at a small size: it draws its picture, and its numbers have the expected values."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from PIL import Image

from quasiharmonic.geometry.mesh.topology import boundary_loops, edges

pytestmark = pytest.mark.slow

FOLDER = Path(__file__).parent.parent / "examples"
SCRIPTS = sorted({path.stem for path in FOLDER.glob("*.py")} - {"common", "sculptures"})


@pytest.fixture
def example(tmp_path, monkeypatch):
    """Run the ``main`` of one script in a new folder; return its numbers."""
    monkeypatch.syspath_prepend(str(FOLDER))

    def run(name, **options):
        numbers = importlib.import_module(name).main(tmp_path, **options)
        picture = imread(tmp_path / f"{name}.png")
        assert picture.shape[0] > 300
        assert picture[..., :3].std() > 0.05
        json.dumps(numbers)
        return numbers

    return run


def test_figure_03(example):
    numbers = example("figure_03", size=12)
    assert {name: row["si-log"] for name, row in numbers.items()} == {"arrow": 0, "cross": 0, "overlap": 0}
    assert all(row["harmonic"] > 15 for row in numbers.values())
    assert [row["bijective"] for row in numbers.values()] == [True, True, False]


def test_figure_04(example):
    rings = list(example("figure_04", size=3).values())
    assert rings[2]["V₃ tanh"] == "none exists"
    for column in ("V₃ tanh", "V₃ si-log", "V₂ si-log", "V₁ si-log"):
        assert all(int(ring[column]) < 400 for ring in rings[:2])


def test_figure_05(example):
    numbers = example("figure_05", size=48)
    assert numbers["tanh"]["flips"] == numbers["si-log"]["flips"] == 0
    assert numbers["tanh"]["iterations"] < 60 < numbers["si-log"]["iterations"] < 300
    assert numbers["si-log"]["MIPS"] < 0.7 * numbers["tanh"]["MIPS"]
    assert numbers["untangling"]["flips"] == 0
    assert numbers["untangling"]["iterations"] < 80


def test_figure_06(example):
    numbers = example("figure_06", size=16)
    assert numbers["V₃"]["flips"] == numbers["V₂"]["flips"] == 0
    assert numbers["V₁"]["flips"] <= 2
    assert numbers["V₃"]["iterations"] < 400
    assert numbers["V₄"]["V₄ at an injective map's tensor"] == pytest.approx(0, abs=1e-9)
    assert numbers["V₄"]["largest close by"] < 0
    assert numbers["V₄ with tanh, turned by π/2"]["flips"] == 0


def test_edge_elements(example):
    numbers = example("edge_elements", size=8, cells=12)
    star, hole = numbers["star"], numbers["hole across the boundary"]
    assert star["inverted where V₄ is zero"] > 20
    assert abs(star["V₄ there"]) < 1e-12 < 0.5 < star["V₃ there"]
    assert star["V₄ by edges less V₃, at most"] < 1e-7
    assert star["iterations"]["V₄ by edges"] == star["iterations"]["V₃"]
    assert abs(hole["V₄"]) < 1e-10
    assert abs(hole["V₄ by edges"]) < 1e-10
    assert hole["V₃"] > 0.1
    assert numbers["ring turned by π"]["V₄ by edges"] < 400


def test_figure_07(example):
    numbers = example("figure_07")
    assert numbers["tanh"]["|ξ| at |μ| = 0.9"] == pytest.approx(1.4722, abs=1e-4)
    assert numbers["si-log"]["|ξ| at |μ| = 0.9"] == pytest.approx(8102.1, abs=0.1)


def test_general_tensor(example):
    numbers = example("general_tensor", rings=8)
    assert numbers["Tutte"]["edges with s < 0"] > 0
    assert numbers["injective"]["edges with s < 0"] == 0
    least, most = numbers["conjugate map"]["det A"]
    assert least < 0.6
    assert most > 1.5
    assert numbers["conjugate map"]["distance"] < 1e-9


def test_figure_08(example):
    numbers = example("figure_08", size=16)
    for row in numbers.values():
        assert row["harmonic"] > 0
        assert row["tanh"]["flips"] == row["si-log"]["flips"] == 0
        assert row["si-log"]["99 % below"] < row["tanh"]["99 % below"]


def test_figure_11(example):
    numbers = example("figure_11", size=24)
    assert numbers["si-log"]["flips"] == 0
    assert numbers["si-log"]["iterations"] < 60
    polished = numbers["si-log, then least MIPS"]
    assert polished["MIPS"] < 0.7 * numbers["si-log"]["MIPS"]
    assert polished["median σ₁/σ₂"] < 1.5 < numbers["si-log"]["median σ₁/σ₂"]


def test_figure_12(example):
    numbers = example("figure_12", size=16)
    assert all(numbers[name]["flips"] == 0 for name in ("tanh", "si-log", "least MIPS"))
    low, _, high = numbers["si-log"]["quartiles"]
    assert high - low < 0.4
    assert numbers["si-log"]["99 % below"] < 10 < numbers["tanh"]["99 % below"]
    assert numbers["least MIPS"]["MIPS"] < numbers["si-log"]["MIPS"] < numbers["tanh"]["MIPS"]


def test_figure_13(example):
    numbers = example("figure_13")
    assert numbers["problems"] == 68
    assert numbers["SBP"]["MIPS"] < numbers["ours speed"]["MIPS"] < numbers["TLC-QN"]["MIPS"]


def test_figure_17(example):
    numbers = example("figure_17", size=40)
    assert len(numbers) == 4
    assert all(row["flips"] == 0 and row["iterations"] < 500 for row in numbers.values())
    assert [row["held"] for row in numbers.values()] == [2, 2, 10, 26]


def test_figure_18(example):
    numbers = example("figure_18", size=10)
    for name, row in numbers.items():
        assert row["status"] == "IMPOSSIBLE", name
        assert row["A-Dirichlet energy"] == pytest.approx(row["unsigned area"], rel=5e-3)
        if "ring" not in name:
            assert row["unsigned area"] == pytest.approx(row["least unsigned area of any map"], rel=1e-2)
        assert row["known obstructions"]


def test_cortex(example):
    pytest.importorskip("nilearn")
    numbers = example("cortex", rings=5)
    assert numbers["triangles"] == 18_654
    maps = [numbers[name] for name in ("published", "symmetric Dirichlet", "distances")]
    assert all(row["bijective"] for row in maps)
    assert maps[2]["distance error, mean"] < 0.95 * min(row["distance error, mean"] for row in maps[:2])
    assert maps[2]["distance error, rms"] < 0.95 * min(row["distance error, rms"] for row in maps[:2])


def test_creatures(example):
    numbers = example("creatures", size=24)
    for name, most in (("octopus", 0.45), ("armadillo", 0.8)):
        one, every = (numbers[name][cut] for cut in ("one cut", "a cut to every limb"))
        assert one["bijective"]
        assert every["bijective"]
        assert every["symmetric Dirichlet"] < most < 3 < one["symmetric Dirichlet"]
        assert every["median stretch"] < 1.25


def test_creatures_are_spheres(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    sculptures = importlib.import_module("sculptures")
    for name in sculptures.CREATURES:
        V, F = sculptures.creature(name, 36)
        sides = edges(F, len(V))
        assert not len(sides.boundary), name
        assert len(V) - len(sides.interior) + len(F) == 2, name
        assert np.linalg.det(V[F] - V.mean(axis=0)).sum() > 0, name


def test_pattern(example, tmp_path):
    pytest.importorskip("shapely")
    panels = list(example("pattern", size=10).values())
    assert (tmp_path / "pattern.svg").exists()
    assert all(panel["bijective"] for panel in panels)
    assert all(0.9 < panel["strongest shrinking"] < panel["strongest stretch"] < 1.2 for panel in panels)
    upper, lower = panels[0], panels[2]
    assert upper["seam along the side, mm"] == pytest.approx(lower["seam along the side, mm"], rel=5e-3)
    right, left = panels[:2]
    assert right["seam along the back or belly, mm"] == pytest.approx(
        left["seam along the back or belly, mm"], rel=1e-3
    )


def test_all_are_tested():
    assert {f"test_{name}" for name in SCRIPTS} <= set(globals())


def test_command_line(tmp_path):
    """Run it as a reader does, from another folder."""
    command = [sys.executable, str(FOLDER / "figure_03.py"), "-o", str(tmp_path / "new"), "--size", "8"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout)["cross"]["si-log"] == 0
    assert (tmp_path / "new" / "figure_03.png").stat().st_size > 10_000


def test_figure_20(example):
    pytest.importorskip("shapely")
    numbers = example("figure_20", size=7, iterations=60)
    for rows in numbers.values():
        ways = {way: row for way, row in rows.items() if isinstance(row, dict)}
        assert all(row["bijective"] for row in ways.values())
        first = ways.pop("first map")["energy"]
        assert ways.pop("paper's way, η = 1e-4")["energy"] < 0.7 * first
        assert all(row["energy"] < 0.2 * first for row in ways.values())


def test_piston(example, tmp_path):
    pytest.importorskip("shapely")
    numbers = example("piston", size=5, steps=14)
    assert numbers["bijective"] == numbers["moments"] == 14
    assert 0.02 < max(numbers["energy"]) < 0.5
    assert numbers["thinnest air"] > 0
    assert (tmp_path / "piston.gif").read_bytes()[:6] == b"GIF89a"


def test_warped_photo(example):
    numbers = example("warped_photo")
    assert numbers["bijective"]
    assert numbers["landmarks"] == 16
    assert numbers["iterations"] < 200


def test_letters(example):
    numbers = example("letters", size=9)
    assert "".join(name[-1] for name in numbers) == "RAGHPGS"
    assert all(row["exit status"] == 0 and row["bijective"] for row in numbers.values())
    assert [row["loops"] for row in numbers.values()] == [1, 2, 1, 1, 2, 1, 1]
    assert sum(row["inverted by Tutte's embedding"] > 20 for row in numbers.values()) >= 5
    assert max(row["iterations"] for row in numbers.values()) < 60


def test_spline_fit(example):
    numbers = example("spline_fit", size=16)
    assert numbers["bijective"]
    assert numbers["samples found"] == 25 * 25
    assert numbers["furthest from the surface"] == pytest.approx(3.9e-3, rel=0.1)
    assert numbers["the mesh's own"] == pytest.approx(4.5e-3, rel=0.1)


def test_transfer(example):
    numbers = example("transfer", size=16)
    assert numbers["onto"]
    assert numbers["bijective"] == [True, True]
    assert numbers["vertices without a corresponding point"] == 0
    assert numbers["there and back"] < 1e-13


def test_bake_colours(example, tmp_path):
    numbers = example("bake_colours", size=6)
    assert numbers["certified"]
    assert numbers["covered texels"] == pytest.approx(numbers["utilisation"], rel=0.02)
    texture = imread(tmp_path / "bake_colours_texture.png")
    assert texture.shape[:2] == (192, 192)


def test_repair(example):
    numbers = example("repair", size=12)
    assert min(numbers["inverted before"]) > 3
    assert numbers["inverted"] == [0, 0]
    assert 5 < numbers["moved"] < numbers["dragged or brushed"]
    assert numbers["moved of those nobody touched"] == numbers["boundary moved"] == 0


@pytest.mark.parametrize("size", [24, 32])
def test_sculptures_are_disks(monkeypatch, size):
    monkeypatch.syspath_prepend(str(FOLDER))
    sculptures = importlib.import_module("sculptures")
    for name in sculptures.SCULPTURES:
        V, F = sculptures.sculpture(name, size)
        sides = edges(F, len(V))
        assert len(boundary_loops(F, len(V))) == 1, name
        assert len(V) - len(sides.interior) - len(sides.boundary) + len(F) == 1, name
        assert len(sculptures.chords(F, len(V))) == 0, name
        # The volume is positive if triangles are counterclockwise seen from outside.
        assert np.linalg.det(V[F] - V.mean(axis=0)).sum() > 0, name


def test_figure_01(example):
    numbers = example("figure_01", size=32)
    assert numbers["inverted by Tutte's embedding"] > 100
    assert numbers["inverted"] == 0
    assert numbers["bijective"]
    assert numbers["iterations"] < 40
    assert numbers["untangling"]["inverted"] == 0
    assert numbers["untangling"]["MIPS"] < 0.5 * numbers["MIPS"]


def test_figure_09(example):
    numbers = example("figure_09", size=32)
    assert {name: row["boundary edges"] for name, row in numbers.items()} == {
        "angel": 52,
        "gargoyle": 72,
        "rabbit": 80,
        "bust": 50,
        "hand": 24,
    }
    assert all(row["least angle"] > 3 for row in numbers.values())


def test_figure_10(example):
    numbers = example("figure_10", size=24, surfaces=1)
    assert numbers["drawn"]["solved"] == numbers["drawn"]["of"] == 6
    assert numbers["drawn"]["most iterations"] < 100
    # Those among the paper's three functionals that do not do so without help.
    recorded = numbers["recorded"]["gallery, small"]
    assert recorded["V₁ si-log"]["solved"] < recorded["V₃ si-log"]["solved"] <= recorded["V₃ si-log"]["of"] == 30


def test_figure_22(example):
    numbers = example("figure_22", size=20)
    assert numbers["least angle"] < 1e-5
    assert numbers["angles below 1°"] > 500
    assert numbers["the disk"]["flips"] == numbers["G"]["flips"] == 0
    assert all(count is not None for way, count in numbers["G"]["alone"].items() if way.startswith("tanh"))


def test_figure_14(example):
    numbers = example("figure_14")
    paper, speed = numbers["paper"], numbers["speed"]
    assert numbers["problems"] >= 2000
    assert 0.95 * numbers["problems"] < paper["solved"] < speed["solved"]
    assert paper["seconds"]["50 %"] > 3 * speed["seconds"]["50 %"]
    # It is not below tanh's on half of the problems, at every size.
    assert numbers["lower"] < 0.5
    assert all(middle > 1 for _, middle, _ in numbers["by size"].values())


def test_table_3(example):
    numbers = example("table_3", size=24)
    assert all(row["tanh"]["flips"] == row["si-log"]["flips"] == 0 for row in numbers.values())
    assert all(row["tanh"]["iterations"] <= row["si-log"]["iterations"] < 500 for row in numbers.values())
    assert max(row["tanh"]["iterations"] for row in numbers.values()) < 40


def test_table_4(example):
    for row in example("table_4", size=24).values():
        first, angles, sizes = row["si-log, first map"], row["then least MIPS"], row["then symmetric Dirichlet"]
        assert first["flips"] == angles["flips"] == sizes["flips"] == 0
        assert angles["MIPS"] < 0.4 * first["MIPS"] < 4
        assert sizes["isometric"] < 60 < angles["isometric"]


def test_table_2(example):
    numbers = example("table_2", size=24)
    assert len(numbers) == 7
    for row in numbers.values():
        columns = [row[name] for name in ("SBP's energy", "si-log", "tanh + MIPS")]
        assert all(column["flips"] == 0 for column in columns)
        assert columns[2]["MIPS"] < 0.9 * min(columns[0]["MIPS"], columns[1]["MIPS"])
        assert columns[0]["max(σ₁, 1/σ₂)"] < columns[2]["max(σ₁, 1/σ₂)"]


def test_figure_02(example):
    numbers = example("figure_02", size=40)
    assert all(numbers[name]["flips"] == 0 for name in ("tanh", "si-log", "tanh + MIPS"))
    assert numbers["si-log"]["99 % below"] < 0.5 * numbers["tanh"]["99 % below"]
    assert numbers["tanh + MIPS"]["mean"] < 0.5 * numbers["si-log"]["mean"]


def test_figure_19(example):
    numbers = example("figure_19")
    assert all(row["flips"] == 0 for row in numbers.values())
    for name in ("ARAP", "mass and springs", "area-preserving", "MIPS", "symmetric Dirichlet"):
        assert min(row[name] for row in numbers.values()) > 0.95 * numbers[name][name]
    assert numbers["R₁"]["MIPS"] < 0.8 * numbers["tanh, the first map"]["MIPS"]


def test_figure_21(example):
    numbers = example("figure_21", size=24)
    for row in numbers.values():
        maps = [row[name] for name in ("area-preserving", "si-log", "ARAP")]
        assert all(found["flips"] == 0 for found in maps)
        assert maps[0]["areas off by"] < 0.35 * min(maps[1]["areas off by"], maps[2]["areas off by"])
        assert maps[1]["MIPS"] < maps[0]["MIPS"]
        assert maps[2]["ARAP"] < min(maps[0]["ARAP"], maps[1]["ARAP"])


# `test_figure_19` maps one of these surfaces with the same energies.
@pytest.mark.nightly
def test_figure_23(example):
    numbers = example("figure_23", size=20)
    for row in numbers.values():
        for name in ("ARAP", "springs", "areas"):
            assert row[name]["and V₃"]["flips"] == 0
            assert row[name]["and V₃"]["energy"] < row[name]["first map"]["energy"]
        assert row["ARAP"]["alone"]["flips"] > 30
        assert row["springs"]["alone"]["flips"] > 100


def test_figure_24(example):
    numbers = example("figure_24", size=24)
    for row in numbers.values():
        one, ours, zero, first, untangled = (row[name] for name in list(row)[1:])
        assert one["flips"] == ours["flips"] == zero["flips"] == first["flips"] == untangled["flips"] == 0
        assert one["areas off by"] < ours["areas off by"] < 0.5 * min(zero["areas off by"], first["areas off by"])
        assert zero["MIPS"] < first["MIPS"] < ours["MIPS"]
        assert zero["MIPS"] < untangled["MIPS"] < ours["MIPS"]


def test_morph(example):
    numbers = example("morph", size=24)
    rows = [numbers[f"{degrees}°"] for degrees in (25, 50, 75)]
    assert [row["inverted by Laplace's equation"] for row in rows] == [2, 14, 40]
    assert all(row["valid"] and row["boundary off by"] == 0 for row in rows)
    assert [row["worst mean ratio"] for row in rows] == pytest.approx([0.19, 0.114, 0.08], rel=0.05)


def test_channel(example):
    numbers = example("channel", size=12)
    for degrees in (30, 60, 90):
        fixed, sliding = (numbers[f"{degrees}°"][name] for name in ("fixed", "sliding"))
        assert sliding["symmetric Dirichlet"] < 0.75 * fixed["symmetric Dirichlet"]
        assert sliding["worst mean ratio"] > fixed["worst mean ratio"]
        assert sliding["valid"]
        assert sliding["bijective"]
        assert sliding["corners off by"] == sliding["walls off by"] == 0


def test_tetrahedra(example):
    numbers = example("tetrahedra", size=8)
    assert len(numbers) == 2
    for row in numbers.values():
        assert row["inverted"] > 20
        assert row["success"]
        assert row["worst quality"] > 0


def test_cut(example):
    numbers = example("cut")
    assert [row["handles"] for row in numbers.values()] == [0, 1, 2]
    assert all(row["exit status"] == 0 and row["bijective"] for row in numbers.values())
    assert all(row["edges cut"] > 10 for row in numbers.values())
    assert all(row["vertices added"] < 60 for row in numbers.values())


def test_looks(example, tmp_path):
    numbers = example("looks", size=12)
    assert numbers["inverted at first"] > 30
    assert numbers["inverted"] == 0
    assert 10 < numbers["frames"] < 150
    assert numbers["median stretch"] == pytest.approx(1.725, rel=0.02)
    with Image.open(tmp_path / "looks.gif") as moving:
        assert moving.n_frames == numbers["frames"]
    assert imread(tmp_path / "looks_distortion.png")[..., :3].std() > 0.05


def test_looks_in_a_window(example, tmp_path):
    pytest.importorskip("polyscope")
    # An OpenGL program runs in its own process, so that its failure does not end the tests.
    command = [sys.executable, str(FOLDER / "looks.py"), "-o", str(tmp_path), "--size", "8", "--window"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode and ("EGL" in done.stderr or "OpenGL" in done.stderr or done.returncode < 0):
        pytest.skip("nothing here draws without a display")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["window"] == [1280, 720]
    assert imread(tmp_path / "looks_window.png")[..., :3].std() > 0.05


def test_shape_from_boundary(example):
    pytest.importorskip("skfem")
    numbers = example("shape_from_boundary", size=14, steps=25)
    assert numbers["misfit"] < 0.02 * numbers["misfit at first"]
    assert numbers["outline off by"] < 0.5 * numbers["outline off by at first"]
    assert numbers["inverted, quasiharmonic"] == 0
    assert numbers["elastic, inverted in the end"] > 0


def test_learned_landmarks(example):
    pytest.importorskip("torch")
    numbers = example("learned_landmarks", size=5, steps=40, count=12)
    assert numbers["loss"][1] < 0.8 * numbers["loss"][0]
    assert numbers["apart"] < 0.9 * numbers["apart before"]


def test_letter_grid(example):
    numbers = example("letter_grid", size=14, steps=8)
    assert numbers["off"] < 0.7 * numbers["off at first"]
    assert numbers["inverted"] == 0
