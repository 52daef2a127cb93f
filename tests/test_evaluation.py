"""The paper's evaluation on problems of every size: problems, records and the stated figures."""

from __future__ import annotations

import gzip

import numpy as np
import pytest

import evaluation
import stages
from quasiharmonic import Problem, solve


@pytest.fixture(scope="module")
def rows():
    return evaluation.read(evaluation.RECORDS)


def test_names_are_distinct_and_cover_every_family_and_size():
    names = list(evaluation.names(2100))
    assert len(set(names)) == 2100
    assert {evaluation.family_of(name) for name in names} == set(evaluation.FAMILIES)
    sizes = np.array([int(name.partition("triangles=")[2]) for name in names if "triangles=" in name])
    counts = np.histogram(np.log(sizes / 100) / np.log(200), bins=5, range=(0, 1))[0]
    assert counts.min() > 0.85 * counts.max()
    heights = {name.rpartition(":")[2] for name in names if name.startswith("sculpture")}
    assert heights == {str(height) for height in evaluation.HEIGHTS}


def test_records_cover_two_thousand_problems_of_all_sizes(rows):
    assert len({row["problem"] for row in rows}) == len(rows) >= 2000
    assert {row["problem"] for row in rows} <= set(evaluation.names(2100))
    bands = evaluation.in_bands(rows, "triangles", evaluation.SIZES)
    assert min(len(some) for some in bands.values()) > 400
    for row in rows:
        for run in ("paper", "speed"):
            assert (row[f"{run}_mips"] != "") == (row[f"{run}_stage"] != "0")


@pytest.mark.parametrize("name", ["comb:2000001:0.049 triangles=386", "swirl:2000000:0.35 triangles=1414"])
def test_a_record_is_reproduced(rows, name):
    (row,) = (row for row in rows if row["problem"] == name)
    again = evaluation.measured(name)
    assert (str(again["triangles"]), str(again["feasible"])) == (row["triangles"], row["feasible"])
    assert str(again["start_flipped"]) == row["start_flipped"]
    assert float(again["paper_mips"]) == pytest.approx(float(row["paper_mips"]), rel=1e-3)
    assert float(again["thin"]) == float(row["thin"])


def test_thin_triangles_are_those_with_an_angle_below_25_degrees():
    def triangle(degrees):
        apex = np.exp(1j * np.deg2rad(degrees))
        return Problem([(0, 0), (1, 0), (apex.real, apex.imag)], [(0, 1, 2)], [0, 1, 2], [(0, 0), (1, 0), (0, 1)])

    assert [evaluation.thin(triangle(degrees)) for degrees in (24, 26, 129, 131)] == [1, 0, 0, 1]


def test_a_truncated_table_is_read_up_to_its_last_complete_row(tmp_path):
    table = tmp_path / "table.csv"
    lines = gzip.decompress(evaluation.RECORDS.read_bytes()).decode().splitlines(keepends=True)
    table.write_text("".join(lines[:3]) + lines[3][:20])
    assert len(evaluation.read(table)) == 2
    assert evaluation.read(tmp_path / "none.csv") == []


def test_label_and_contribution_of_a_stage():
    case = evaluation.problem_named("noise:2000001:0.049 triangles=386")[0]
    result = solve(case, strategy="paper")
    (outcome,) = stages.outcomes(["comb:0:0.1"], "paper")
    assert outcome.result.injective == np.isfinite(outcome.mips)
    assert stages.kind(result.stages[0]) == "vector-adam, si-log"
    table = stages.stages("paper", [stages.Outcome(result, 1.0, 1.0), outcome])
    first = table.splitlines()[2]
    assert first.startswith("| vector-adam, si-log | 2 |")
