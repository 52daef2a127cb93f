"""The records of TLC and Foldover-free, and the stated results."""

from __future__ import annotations

import numpy as np
import pytest

import problems
import tlc_foldover


def test_records_belong_to_generated_problems():
    for name in ("comb:261122:0.5 triangles=3774", "teeth:261124:0.736 triangles=3270"):
        made, _, triangles = name.partition(" triangles=")
        case = problems.make(*problems.parse(made), triangles=int(triangles))
        runs = [run for run in tlc_foldover.read_records() if run.problem == name]
        assert {run.program for run in runs} >= {"ours speed", "TLC-PN", "TLC-QN", "SBP"}
        assert {(run.triangles, run.feasible) for run in runs} == {(len(case.F), case.feasible)}


def test_distortion_is_recorded_exactly_for_injective_maps():
    runs = tlc_foldover.read_records()
    assert len({(run.problem, run.program) for run in runs}) == len(runs)
    for run in runs:
        assert np.isfinite(run.mips) == np.isfinite(run.stretch) == run.injective
        assert run.seconds >= 0 or not run.injective


def test_figures_of_the_documentation():
    rows = tlc_foldover.on_common_problems(tlc_foldover.read_records())
    table = tlc_foldover.summary(rows, tlc_foldover.PROGRAMS)
    solved = {name: (row["feasible solved"], row["unknown solved"]) for name, row in table.items()}
    assert solved["ours speed"] == (44, 21)
    assert solved["TLC-PN"] == (34, 20)
    assert solved["TLC-QN"] == (36, 17)
    assert solved["SBP"] == (42, 19)
    assert (table["TLC-QN"]["quicker"], table["TLC-QN"]["of"]) == (17, 42)
    assert [table[name]["ratio"][1] for name in ("TLC-PN", "TLC-QN", "SBP")] == [5.8, 1.5, 55]
    assert table["SBP"]["MIPS"] < table["ours speed"]["MIPS"] < table["TLC-QN"]["MIPS"] < table["TLC-PN"]["MIPS"]


def test_figures_of_the_documentation_for_repeated_runs():
    programs = (*tlc_foldover.PROGRAMS, *tlc_foldover.ANEW)
    rows = tlc_foldover.on_common_problems([*tlc_foldover.read_records(), *tlc_foldover.read_repeated_runs()])
    table = tlc_foldover.summary(rows, programs)
    solved = {name: (table[name]["feasible solved"], table[name]["unknown solved"]) for name in tlc_foldover.ANEW}
    assert solved == {"anew speed": (44, 22), "anew paper": (41, 20), "anew untangling": (43, 21)}
    assert [table[name]["ratio"][1] for name in tlc_foldover.ANEW] == [1, 19, 6.3]
    assert table["anew untangling"]["MIPS"] < table["anew speed"]["MIPS"]


def test_repeated_runs_agree_with_recorded_ones():
    rows = tlc_foldover.on_common_problems([*tlc_foldover.read_records(), *tlc_foldover.read_repeated_runs()])
    for row in rows.values():
        then, now = row["ours speed"], row["anew speed"]
        assert (now.triangles, now.feasible, now.start_flipped) == (then.triangles, then.feasible, then.start_flipped)
        assert now.injective >= then.injective


def test_letters():
    rows = tlc_foldover.letters()
    assert len(rows) == 7
    assert all(float(row["ours_polished_mips"]) < float(row["foldover_free_mips"]) for row in rows)


@pytest.mark.long
def test_repeated_run():
    rows = dict(list(tlc_foldover.on_common_problems(tlc_foldover.read_records()).items())[1:2])
    ((name, row),) = rows.items()
    (run,) = tlc_foldover.anew(rows, "speed")
    assert run.injective
    assert run.triangles == row["ours speed"].triangles
    assert run.polished == pytest.approx(row["ours speed"].polished, rel=0.05)
    table = tlc_foldover.summary({name: row | {run.program: run}}, (*tlc_foldover.PROGRAMS, run.program))
    assert table["anew speed"]["feasible solved"] + table["anew speed"]["unknown solved"] == 1
