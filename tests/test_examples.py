"""The other scripts of examples/ at a small size: each draws its picture, and its numbers have the expected values."""

from __future__ import annotations

import importlib
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from PIL import Image

from quasiharmonic.geometry.mesh.topology import boundary_loops, edges

pytestmark = pytest.mark.long


FOLDER = Path(__file__).parent.parent / "examples"


SCRIPTS = sorted({path.stem for path in FOLDER.glob("*.py")} - {"common", "sculptures"})


def test_cortex(example):
    pytest.importorskip("nilearn")
    numbers = example("cortex", rings=5)
    assert numbers["triangles"] == 18_654
    maps = [numbers[name] for name in ("published", "symmetric Dirichlet", "distances")]
    assert all(row["bijective"] for row in maps)
    assert maps[2]["distance error, mean"] < 0.95 * min(row["distance error, mean"] for row in maps[:2])
    assert maps[2]["distance error, rms"] < 0.95 * min(row["distance error, rms"] for row in maps[:2])


def test_creatures(example):
    numbers = example("creatures", size=20)
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
        V, F = sculptures.creature(name, 20)
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
    files = Path(__file__).parent.glob("test_examples*.py")
    tests = {name for path in files for name in re.findall(r"^def (test_\w+)", path.read_text("utf-8"), re.MULTILINE)}
    assert {f"test_{name}" for name in SCRIPTS} <= tests


def test_command_line(tmp_path):
    """Run it as a reader does, from another folder."""
    command = [sys.executable, str(FOLDER / "figure_03.py"), "-o", str(tmp_path / "new"), "--size", "8"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout)["cross"]["si-log"] == 0
    assert (tmp_path / "new" / "figure_03.png").stat().st_size > 10_000


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


@pytest.mark.parametrize("size", [24, pytest.param(32, marks=pytest.mark.nightly)])
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
    numbers = example("tetrahedra", size=6)
    assert len(numbers) == 2
    for row in numbers.values():
        assert row["inverted"] > 20
        assert row["success"]
        assert row["worst quality"] > 0


def test_cut(example):
    numbers = example("cut", size=8)
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
    numbers = example("letter_grid", size=12, steps=6)
    assert numbers["off"] < 0.7 * numbers["off at first"]
    assert numbers["inverted"] == 0
