"""Every obstruction is found at its location, decided exactly, and gone after the named refinement."""

from __future__ import annotations

import json
from functools import cache

import numpy as np
import pytest

from quasiharmonic import Problem, diagnose, injective_map, refine
from quasiharmonic.results import Forbids, Kind
from quasiharmonic.surfaces import disk
from shared.infeasible_problems import HOUSE, OBSTRUCTED, moved, onto
from shared.polygons import circle
from shared.small_meshes import loose_wheel, two_wheels


def kinds(problem):
    return {o.kind for o in diagnose(problem).obstructions}


@cache
def diagnosed(name):
    return diagnose(OBSTRUCTED[name][0])


@pytest.mark.parametrize("name", OBSTRUCTED)
def test_obstruction_is_named(name):
    _, (kind, forbids, elements) = OBSTRUCTED[name]
    found = [o for o in diagnosed(name).obstructions if o.kind is Kind[kind]]
    assert found
    assert found[0].forbids is Forbids[forbids]
    for attribute, expected in elements.items():
        np.testing.assert_array_equal(getattr(found[0], attribute), expected)


def test_every_kind_has_a_problem():
    assert len(OBSTRUCTED) >= 20
    assert {kind for _, (kind, _, _) in OBSTRUCTED.values()} == {kind.name for kind in Kind}


@pytest.mark.long
@pytest.mark.parametrize("name", OBSTRUCTED)
def test_scale_and_location_do_not_matter(name):
    problem, _ = OBSTRUCTED[name]
    expected = [(o.kind, o.vertices.tolist(), o.split.tolist()) for o in diagnosed(name).obstructions]
    # Powers of two cause no rounding; the offset does, so it applies only to targets with few bits.
    changes = [problem.target * 2.0**-900, problem.target * 2.0**900]
    if np.all(problem.target * 8 == np.round(problem.target * 8)):
        changes.append(problem.target + 2.0**40)
    for target in changes:
        found = diagnose(problem.with_target(target)).obstructions
        assert [(o.kind, o.vertices.tolist(), o.split.tolist()) for o in found] == expected


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["flat ear", "chord over a notch", "chord touches a corner", "no kernel", "nothing sees all"]
)
def test_after_refining_there_is_a_map(name):
    problem, _ = OBSTRUCTED[name]
    before = injective_map(
        problem.V, problem.F, problem.fixed, problem.target, reference="equilateral", max_iterations=50
    )
    assert not before.injective
    V, F = problem.V, problem.F
    while len(split := diagnose(Problem(V, F, problem.fixed, problem.target, reference="equilateral")).split):
        refined = refine(V, F, split)
        V, F = refined.V, refined.F
    result = injective_map(V, F, problem.fixed, problem.target, reference="equilateral")
    assert result.injective


def test_chords_are_decided_exactly():
    inside = [[0, 0], [1, -1], [2, -1e-300], [3, -1], *HOUSE]
    touching = [[0, 0], [1, -1], [2, 0], [3, -1], *HOUSE]
    assert Kind.CHORD not in kinds(moved(two_wheels(), inside))
    assert Kind.CHORD in kinds(moved(two_wheels(), touching))


def test_visibility_is_decided_exactly():
    def shafts(gap):  # one corridor leads down and one up; both are visible where they overlap
        x = 4 - gap
        lower = [[0, 2], [3, 2], [3, 0], [4, 0], [4, 2], [8, 2]]
        return moved(loose_wheel(12), [*lower, [8, 4], [5, 4], [5, 6], [x, 6], [x, 4], [0, 4]])

    assert kinds(shafts(2.0**-50)) == set()
    assert kinds(shafts(0.0)) == {Kind.HIDDEN}


def test_a_minimal_reason_is_given():
    problem, _ = OBSTRUCTED["nothing sees all"]
    diagnosis = diagnose(problem)
    (found,) = diagnosis.obstructions
    assert found.vertices[0] == 8
    seen = found.vertices[1:]
    assert 2 <= len(seen) < 8
    assert found.split.tolist() == [[8, k] for k in sorted(seen)]
    # The command writes no meshes of finite elements.
    assert "refine_problem, or for surface files qhm refine." in diagnosis.summary()


def test_conditions_for_simple_targets_are_skipped_for_other_targets():
    problem, _ = OBSTRUCTED["band over itself"]
    diagnosis = diagnose(problem)
    assert diagnosis.forbids_bijective
    assert not diagnosis.forbids_injective
    assert any("visibility from vertices" in text for text in diagnosis.unchecked)


def test_feasible_problems_have_no_obstruction():
    diagnosis = diagnose(onto(disk(3), circle(18)))
    assert diagnosis.obstructions == ()
    assert not diagnosis.forbids_injective
    assert not diagnosis.forbids_bijective
    assert diagnosis.split.shape == (0, 2)
    assert diagnosis.summary().startswith("No known obstruction")


@pytest.mark.slow
def test_diagnoses_have_text_and_json_forms():
    for name, (_, (kind, _, _)) in OBSTRUCTED.items():
        diagnosis = diagnosed(name)
        text = diagnosis.summary(most=2)
        assert Kind[kind].value in text
        assert text.splitlines()[0].startswith(
            "No injective map" if diagnosis.forbids_injective else "No bijective map"
        )
        report = json.loads(json.dumps(diagnosis.to_dict()))
        assert report["forbids_bijective"] is True
        assert {o["kind"] for o in report["obstructions"]} == {o.kind.name.lower() for o in diagnosis.obstructions}


def test_obstructions_are_immutable():
    problem, _ = OBSTRUCTED["flat ear"]
    found = diagnose(problem).obstructions[0]
    with pytest.raises(ValueError, match="read-only"):
        found.triangles[0] = 3
