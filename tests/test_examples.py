"""Every script under examples/ at a small size: it draws its picture, and its numbers are what they were."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest
from matplotlib.image import imread

FOLDER = Path(__file__).parent.parent / "examples"
SCRIPTS = sorted(path.stem for path in FOLDER.glob("figure_*.py"))


@pytest.fixture
def example(tmp_path, monkeypatch):
    """Run one script's ``main`` into a fresh folder; its numbers."""
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
    numbers = example("figure_05", size=16)
    assert numbers["tanh"]["flips"] == numbers["si-log"]["flips"] == 0
    assert numbers["tanh"]["iterations"] < 60 < numbers["si-log"]["iterations"] < 300
    assert numbers["si-log"]["MIPS"] < 0.7 * numbers["tanh"]["MIPS"]


def test_figure_06(example):
    numbers = example("figure_06", size=16)
    assert numbers["V₃"]["flips"] == numbers["V₂"]["flips"] == 0
    assert numbers["V₁"]["flips"] <= 2
    assert numbers["V₃"]["iterations"] < 400
    assert numbers["V₄"]["V₄ at an injective map's tensor"] == pytest.approx(0, abs=1e-9)
    assert numbers["V₄"]["largest close by"] < 0
    assert numbers["V₄ with tanh, turned by π/2"]["flips"] == 0


def test_figure_07(example):
    numbers = example("figure_07")
    assert numbers["tanh"]["|ξ| at |μ| = 0.9"] == pytest.approx(1.4722, abs=1e-4)
    assert numbers["si-log"]["|ξ| at |μ| = 0.9"] == pytest.approx(8102.1, abs=0.1)


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


def test_all_are_tested_and_listed():
    assert {f"test_{name}" for name in SCRIPTS} <= set(globals())
    listed = (FOLDER / "README.md").read_text(encoding="utf-8")
    assert all(f"`{name}.py`" in listed for name in SCRIPTS)


def test_command_line(tmp_path):
    """As a reader runs it, from another folder."""
    command = [sys.executable, str(FOLDER / "figure_03.py"), "-o", str(tmp_path / "new"), "--size", "8"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout)["cross"]["si-log"] == 0
    assert (tmp_path / "new" / "figure_03.png").stat().st_size > 10_000
