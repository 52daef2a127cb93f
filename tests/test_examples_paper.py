"""The paper's figures and tables, drawn by the scripts of examples/ at a small size; their numbers are as expected."""

from __future__ import annotations

import importlib

import pytest

pytestmark = pytest.mark.long


def test_figure_03(example):
    numbers = example("figure_03", size=12)
    assert {name: row["si-log"] for name, row in numbers.items()} == {"arrow": 0, "cross": 0, "overlap": 0}
    assert all(row["harmonic"] > 15 for row in numbers.values())
    assert [row["bijective"] for row in numbers.values()] == [True, True, False]


def test_figure_04(example, monkeypatch):
    # Coarser rings with the same holes.
    cases = importlib.import_module("figure_04").CASES
    for name, cells in zip(cases, (16, 12), strict=False):
        monkeypatch.setitem(cases, name, (cells, cases[name][1]))
    rings = list(example("figure_04", size=3).values())
    assert rings[2]["V₃ tanh"] == "none exists"
    for column in ("V₃ tanh", "V₃ si-log", "V₂ si-log", "V₁ si-log"):
        assert all(int(ring[column]) < 400 for ring in rings[:2])


@pytest.mark.parametrize("size", [24, pytest.param(48, marks=pytest.mark.nightly)])
def test_figure_05(example, size):
    numbers = example("figure_05", size=size)
    assert numbers["tanh"]["flips"] == numbers["si-log"]["flips"] == 0
    assert numbers["untangling"]["flips"] == 0
    assert numbers["untangling"]["iterations"] < 80
    assert numbers["tanh"]["iterations"] < numbers["si-log"]["iterations"] < 300
    assert numbers["si-log"]["MIPS"] < 0.7 * numbers["tanh"]["MIPS"]
    if size == 48:
        assert numbers["tanh"]["iterations"] < 60 < numbers["si-log"]["iterations"]


# `test_figure_04` descends V₁, V₂ and V₃ in such rings; `test_v4_vanishes_at_a_map_with_inverted_triangles` tests V₄.
@pytest.mark.nightly
def test_figure_06(example):
    numbers = example("figure_06", size=12, iterations=500)
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
    numbers = example("figure_18", size=7)
    for name, row in numbers.items():
        assert row["status"] == "IMPOSSIBLE", name
        assert row["A-Dirichlet energy"] == pytest.approx(row["unsigned area"], rel=5e-3)
        if "ring" not in name:
            assert row["unsigned area"] == pytest.approx(row["least unsigned area of any map"], rel=1e-2)
        assert row["known obstructions"]


def test_figure_20(example):
    pytest.importorskip("shapely")
    numbers = example("figure_20", size=5, iterations=60, scenes=1)
    assert len(numbers) == 1
    for rows in numbers.values():
        ways = {way: row for way, row in rows.items() if isinstance(row, dict)}
        assert all(row["bijective"] for row in ways.values())
        first = ways.pop("first map")["energy"]
        assert ways.pop("paper's way, η = 1e-4")["energy"] < 0.7 * first
        assert all(row["energy"] < 0.2 * first for row in ways.values())


def test_figure_01(example):
    numbers = example("figure_01", size=24)
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
    assert {row["of"] for row in numbers["recorded"]["gallery"].values()} == {30}
    assert recorded["V₁ si-log"]["solved"] < recorded["V₃ si-log"]["solved"] <= recorded["V₃ si-log"]["of"] == 30


def test_the_runs_of_figure_10_are_recorded_once(example):
    runs = importlib.import_module("figure_10").read_letters_alone()
    assert len({(run.surface, run.triangles, run.letter, run.column) for run in runs}) == len(runs)


def test_figure_22(example):
    numbers = example("figure_22", size=16, iterations=300)
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
    numbers = example("table_3", size=24, problems=3)
    assert len(numbers) == 3
    assert all(row["tanh"]["flips"] == row["si-log"]["flips"] == 0 for row in numbers.values())
    assert all(row["tanh"]["iterations"] <= row["si-log"]["iterations"] < 500 for row in numbers.values())
    assert max(row["tanh"]["iterations"] for row in numbers.values()) < 40


def test_table_4(example):
    numbers = example("table_4", size=24, problems=3)
    assert len(numbers) == 3
    for row in numbers.values():
        first, angles, sizes = row["si-log, first map"], row["then least MIPS"], row["then symmetric Dirichlet"]
        assert first["flips"] == angles["flips"] == sizes["flips"] == 0
        assert angles["MIPS"] < 0.4 * first["MIPS"] < 4
        assert sizes["isometric"] < 60 < angles["isometric"]


def test_table_2(example):
    numbers = example("table_2", size=24, problems=3)
    assert len(numbers) == 3
    for row in numbers.values():
        columns = [row[name] for name in ("SBP's energy", "si-log", "tanh + MIPS")]
        assert all(column["flips"] == 0 for column in columns)
        assert columns[2]["MIPS"] < 0.9 * min(columns[0]["MIPS"], columns[1]["MIPS"])
        assert columns[0]["max(σ₁, 1/σ₂)"] < columns[2]["max(σ₁, 1/σ₂)"]


# `test_table_2` makes the same maps of this problem and of two more.
@pytest.mark.nightly
def test_figure_02(example):
    numbers = example("figure_02", size=24)
    assert all(numbers[name]["flips"] == 0 for name in ("tanh", "si-log", "tanh + MIPS"))
    assert numbers["si-log"]["99 % below"] < 0.5 * numbers["tanh"]["99 % below"]
    assert numbers["tanh + MIPS"]["mean"] < 0.5 * numbers["si-log"]["mean"]


# `TestHarmonise.test_lowers_the_energy_and_stays_certified` tests every energy on a small surface.
@pytest.mark.nightly
def test_figure_19(example):
    numbers = example("figure_19")
    assert all(row["flips"] == 0 for row in numbers.values())
    for name in ("ARAP", "mass and springs", "area-preserving", "MIPS", "symmetric Dirichlet"):
        assert min(row[name] for row in numbers.values()) > 0.95 * numbers[name][name]
    assert numbers["R₁"]["MIPS"] < 0.8 * numbers["tanh, the first map"]["MIPS"]


# `test_areas_become_as_equal_as_the_boundary_allows` compares the energies on one surface.
@pytest.mark.nightly
def test_figure_21(example):
    numbers = example("figure_21", size=24)
    for row in numbers.values():
        maps = [row[name] for name in ("area-preserving", "si-log", "ARAP")]
        assert all(found["flips"] == 0 for found in maps)
        assert maps[0]["areas off by"] < 0.35 * min(maps[1]["areas off by"], maps[2]["areas off by"])
        assert maps[1]["MIPS"] < maps[0]["MIPS"]
        assert maps[2]["ARAP"] < min(maps[0]["ARAP"], maps[1]["ARAP"])


# `TestHarmonise.test_lowers_the_energy_and_stays_certified` tests the same energies.
@pytest.mark.nightly
def test_figure_23(example):
    numbers = example("figure_23", size=20)
    for row in numbers.values():
        for name in ("ARAP", "springs", "areas"):
            assert row[name]["and V₃"]["flips"] == 0
            assert row[name]["and V₃"]["energy"] < row[name]["first map"]["energy"]
        assert row["ARAP"]["alone"]["flips"] > 30
        assert row["springs"]["alone"]["flips"] > 100


# `test_table_2` compares three of these maps on the same surfaces.
@pytest.mark.nightly
def test_figure_24(example):
    numbers = example("figure_24", size=24)
    for row in numbers.values():
        one, ours, zero, first, untangled = (row[name] for name in list(row)[1:])
        assert one["flips"] == ours["flips"] == zero["flips"] == first["flips"] == untangled["flips"] == 0
        assert one["areas off by"] < ours["areas off by"] < 0.5 * min(zero["areas off by"], first["areas off by"])
        assert zero["MIPS"] < first["MIPS"] < ours["MIPS"]
        assert zero["MIPS"] < untangled["MIPS"] < ours["MIPS"]
