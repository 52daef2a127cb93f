"""The records of TLC and Foldover-free, and the stated results."""

from __future__ import annotations

import numpy as np
import pytest

import problems
import recorded
from quasiharmonic import Problem, distortion, solve


def test_records_belong_to_generated_problems():
    for name in ("comb:261122:0.5 triangles=3774", "teeth:261124:0.736 triangles=3270"):
        made, _, triangles = name.partition(" triangles=")
        case = problems.make(*problems.parse(made), triangles=int(triangles))
        runs = [run for run in recorded.read_records() if run.problem == name]
        assert {run.program for run in runs} >= {"ours speed", "TLC-PN", "TLC-QN", "SBP"}
        assert {(run.triangles, run.feasible) for run in runs} == {(len(case.F), case.feasible)}


def test_distortion_is_recorded_exactly_for_injective_maps():
    runs = recorded.read_records()
    assert len({(run.problem, run.program) for run in runs}) == len(runs)
    for run in runs:
        assert np.isfinite(run.mips) == np.isfinite(run.stretch) == run.injective
        assert run.seconds >= 0 or not run.injective


def test_figures_of_the_documentation():
    rows = recorded.on_common_problems(recorded.read_records())
    table = recorded.summary(rows, recorded.PROGRAMS)
    solved = {name: (row["feasible solved"], row["unknown solved"]) for name, row in table.items()}
    assert solved["ours speed"] == (44, 21)
    assert solved["TLC-PN"] == (34, 20)
    assert solved["TLC-QN"] == (36, 17)
    assert solved["SBP"] == (42, 19)
    assert (table["TLC-QN"]["quicker"], table["TLC-QN"]["of"]) == (17, 42)
    assert [table[name]["ratio"][1] for name in ("TLC-PN", "TLC-QN", "SBP")] == [5.8, 1.5, 55]
    assert table["SBP"]["MIPS"] < table["ours speed"]["MIPS"] < table["TLC-QN"]["MIPS"] < table["TLC-PN"]["MIPS"]


def test_figures_of_the_documentation_for_repeated_runs():
    rows = recorded.on_common_problems([*recorded.read_records(), *recorded.read_repeated_runs()])
    row = recorded.summary(rows, (*recorded.PROGRAMS, recorded.ANEW))[recorded.ANEW]
    assert (row["feasible solved"], row["unknown solved"]) == (44, 22)
    assert (row["ratio"], row["of"]) == ([], 0)


def test_one_problem_is_repeated(tmp_path, monkeypatch):
    name = "moved:261125:0.354 triangles=498"
    runs = recorded.read_records()
    monkeypatch.setattr(recorded, "read_records", lambda: [run for run in runs if run.problem == name])
    recorded.repeat(tmp_path / "anew.csv")
    (run,) = recorded.read_repeated_runs(tmp_path / "anew.csv")
    assert (run.problem, run.program, run.injective) == (name, recorded.ANEW, True)
    assert run.polished < run.mips


def test_repeated_runs_agree_with_recorded_ones():
    rows = recorded.on_common_problems([*recorded.read_records(), *recorded.read_repeated_runs()])
    for row in rows.values():
        then, now = row["ours speed"], row[recorded.ANEW]
        assert (now.triangles, now.feasible, now.start_flipped) == (then.triangles, then.feasible, then.start_flipped)
        assert now.injective >= then.injective


def test_letters():
    rows = recorded.letters()
    assert len(rows) == 7
    assert all(float(row["ours_polished_mips"]) < float(row["foldover_free_mips"]) for row in rows)


def test_the_evaluation_covers_two_thousand_problems_of_all_sizes():
    rows = recorded.read_evaluation()
    assert len({row["problem"] for row in rows}) == len(rows) >= 2000
    assert min(len(some) for some in recorded.by_family(rows).values()) > 100
    assert min(len(some) for some in recorded.in_bands(rows, "triangles", recorded.SIZES).values()) > 400
    for row in rows:
        for run in ("paper", "speed"):
            assert (row[f"{run}_mips"] != "") == (row[f"{run}_stage"] != "0")


def test_the_evaluation_is_reproduced():
    (row,) = (row for row in recorded.read_evaluation() if row["problem"] == "comb:2000001:0.049 triangles=386")
    case = problems.make("comb", 2000001, 0.049, triangles=386)
    result = solve(Problem(case.V, case.F, case.fixed, case.target), strategy="paper")
    assert str(result.history[0].inverted) == row["start_flipped"]
    mips = distortion(case.V, case.F, result.uv).statistics("mips").mean
    assert mips == pytest.approx(float(row["paper_mips"]), rel=1e-3)
