"""The records of rival programs, and what is said of them."""

from __future__ import annotations

import numpy as np
import pytest

import problems
import rivals


def test_records_are_of_problems_that_the_generator_makes():
    for name in ("comb:261122:0.5 triangles=3774", "teeth:261124:0.736 triangles=3270"):
        made, _, triangles = name.partition(" triangles=")
        case = problems.make(*problems.parse(made), triangles=int(triangles))
        runs = [run for run in rivals.recorded() if run.problem == name]
        assert {run.program for run in runs} >= {"ours speed", "TLC-PN", "TLC-QN", "SBP"}
        assert {(run.triangles, run.feasible) for run in runs} == {(len(case.F), case.feasible)}


def test_distortion_is_known_of_injective_maps_and_of_no_others():
    runs = rivals.recorded()
    assert len({(run.problem, run.program) for run in runs}) == len(runs)
    for run in runs:
        assert np.isfinite(run.mips) == np.isfinite(run.stretch) == run.injective
        assert run.seconds >= 0 or not run.injective


def test_what_the_pages_say():
    rows = rivals.on_common_problems(rivals.recorded())
    table = rivals.summary(rows, rivals.PROGRAMS)
    solved = {name: (row["feasible solved"], row["unknown solved"]) for name, row in table.items()}
    assert solved["ours speed"] == (44, 21)
    assert solved["TLC-PN"] == (34, 20)
    assert solved["TLC-QN"] == (36, 17)
    assert solved["SBP"] == (42, 19)
    assert (table["TLC-QN"]["quicker"], table["TLC-QN"]["of"]) == (17, 42)
    assert [table[name]["ratio"][1] for name in ("TLC-PN", "TLC-QN", "SBP")] == [5.8, 1.5, 55]
    assert table["SBP"]["MIPS"] < table["ours speed"]["MIPS"] < table["TLC-QN"]["MIPS"] < table["TLC-PN"]["MIPS"]


def test_what_the_pages_say_of_runs_made_anew():
    programs = (*rivals.PROGRAMS, *rivals.ANEW)
    table = rivals.summary(rivals.on_common_problems([*rivals.recorded(), *rivals.kept()]), programs)
    solved = {name: (table[name]["feasible solved"], table[name]["unknown solved"]) for name in rivals.ANEW}
    assert solved == {"anew speed": (44, 21), "anew paper": (41, 20), "anew untangling": (43, 21)}
    assert [table[name]["ratio"][1] for name in rivals.ANEW] == [1, 8.2, 2.2]
    assert table["anew untangling"]["MIPS"] < table["anew speed"]["MIPS"]


def test_runs_of_one_search_on_one_problem_agree_whenever_they_were_made():
    rows = rivals.on_common_problems([*rivals.recorded(), *rivals.kept()])
    for row in rows.values():
        then, now = row["ours speed"], row["anew speed"]
        assert (now.triangles, now.feasible, now.start_flipped) == (then.triangles, then.feasible, then.start_flipped)
        assert now.injective == then.injective


def test_letters():
    rows = rivals.letters()
    assert len(rows) == 7
    assert all(float(row["ours_polished_mips"]) < float(row["foldover_free_mips"]) for row in rows)


@pytest.mark.slow
def test_our_side_anew():
    rows = dict(list(rivals.on_common_problems(rivals.recorded()).items())[1:2])
    ((name, row),) = rows.items()
    (run,) = rivals.anew(rows, "speed")
    assert run.injective
    assert run.triangles == row["ours speed"].triangles
    assert run.polished == pytest.approx(row["ours speed"].polished, rel=0.05)
    table = rivals.summary({name: row | {run.program: run}}, (*rivals.PROGRAMS, run.program))
    assert table["anew speed"]["feasible solved"] + table["anew speed"]["unknown solved"] == 1
