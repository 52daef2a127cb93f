"""Requested edges are split into a conforming mesh, and all parts can be traced back."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from quasiharmonic import Problem, diagnose, refine, refine_problem
from quasiharmonic.geometry.mesh.topology import edges
from shared.infeasible_problems import OBSTRUCTED
from shared.meshes import boundary_of, signed_areas, surfaces

TWO = ([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], [[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize(("name", "V", "F"), surfaces())
@pytest.mark.parametrize("share", [0.03, 0.4, 1.0])
def test_random_edges(name, V, F, share):
    rng = np.random.default_rng(7)
    interior = edges(F, len(V)).interior
    chosen = interior[rng.random(len(interior)) < share]
    turned = np.where(rng.random((len(chosen), 1)) < 0.5, chosen, chosen[:, ::-1])
    refined = refine(V, F, np.concatenate([turned, chosen[:3]]))

    n, s = len(V), len(chosen)
    np.testing.assert_array_equal(refined.V[:n], V)
    np.testing.assert_allclose(refined.V[n:], (V[chosen[:, 0]] + V[chosen[:, 1]]) / 2)
    np.testing.assert_array_equal(refined.parents, chosen)
    np.testing.assert_array_equal(refined.weights, 0.5)
    # There are two more triangles for each split edge, and the surface has the same boundary.
    assert len(refined.F) == len(F) + 2 * s
    found = edges(refined.F, len(refined.V))
    assert not found.nonmanifold.size
    assert not found.inconsistent.size
    np.testing.assert_array_equal(found.boundary, edges(F, n).boundary)
    assert len(found.interior) == len(interior) + 3 * s
    np.testing.assert_array_equal(np.unique(refined.F), np.arange(n + s))
    # Triangles keep their index, and unchanged ones everything else.
    np.testing.assert_array_equal(refined.parent[: len(F)], np.arange(len(F)))
    split = {tuple(e) for e in chosen.tolist()}
    sides = np.sort(np.stack([F, np.roll(F, -1, axis=1)], axis=2), axis=2)
    untouched = np.array([not any(tuple(e) in split for e in sides_of.tolist()) for sides_of in sides])
    np.testing.assert_array_equal(refined.F[: len(F)][untouched], F[untouched])
    assert not np.isin(refined.parent[len(F) :], np.flatnonzero(untouched)).any()


@pytest.mark.parametrize("share", [0.2, 0.7, 1.0])
def test_parts_fill_their_parent_triangles(share):
    _, V, F = surfaces()[0]
    every = np.concatenate([edges(F, len(V)).interior, edges(F, len(V)).boundary])
    chosen = every[np.random.default_rng(3).random(len(every)) < share]
    refined = refine(V, F, chosen, boundary=True)
    parts = signed_areas(refined.F, refined.V)
    whole = signed_areas(F, V)
    assert (parts > 0.2 * whole[refined.parent]).all()
    np.testing.assert_allclose(np.bincount(refined.parent, parts), whole)


def test_values_are_interpolated():
    _, V, F = surfaces()[1]
    refined = refine(V, F, edges(F, len(V)).interior[::5])
    np.testing.assert_allclose(refined.extend(V), refined.V)
    np.testing.assert_allclose(refined.extend(V[:, 0]), refined.V[:, 0])
    with pytest.raises(ValueError, match="one for each vertex"):
        refined.extend(refined.V)


def test_boundary_edges_are_split_only_on_request():
    with pytest.raises(ValueError, match=r"\(0, 1\), \(1, 2\): on the boundary"):
        refine(*TWO, [[0, 2], [2, 1], [0, 1]])
    refined = refine(*TWO, [[1, 0]], boundary=True)
    assert refined.parents.tolist() == [[0, 1]]
    assert 4 in boundary_of(refined.F)


def test_the_shorter_diagonal_is_used():
    V = [[0.0, 0.0], [4.0, 0.0], [4.0, 1.0], [0.0, 1.0], [2.0, 0.5]]
    F = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]
    refined = refine(V, F, [[0, 4], [1, 4]])
    # Both diagonals of the trapezoid 0, 1, 6, 5 have the same length; one of them is used.
    assert len(refined.F) == 4 + 4
    refined = refine(V, F, [[1, 4], [2, 4]])
    assert not edges(refined.F, 7).nonmanifold.size
    stretched = np.array(V) * [1.0, 5.0]
    stretched[1] -= [0.0, 2.0]
    refined = refine(stretched, F, [[0, 4], [1, 4]])
    inner = {tuple(e) for e in edges(refined.F, 7).interior.tolist()}
    lengths = {pair: np.linalg.norm(refined.V[pair[0]] - refined.V[pair[1]]) for pair in ((0, 6), (1, 5))}
    assert min(lengths, key=lengths.get) in inner
    assert max(lengths, key=lengths.get) not in inner


@pytest.mark.parametrize("scale", [1e-300, 1e300, 1.7e308])
def test_extreme_coordinates(scale):
    V = scale * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [0, 0.2]])
    F = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]
    refined = refine(V, F, [[0, 4], [1, 4], [2, 4]])
    assert np.isfinite(refined.V).all()
    assert len(refined.F) == 4 + 6


def test_nothing_to_split():
    refined = refine(*TWO, [])
    assert refined.F.tolist() == TWO[1]
    assert refined.V.tolist() == TWO[0]
    assert refined.parents.shape == (0, 2)


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        ([[1, 3]], r"\(1, 3\): not an edge"),
        ([[0, 7]], r"\(0, 7\): not an edge"),
        ([[-1, 2]], r"\(-1, 2\): not an edge"),
        ([[2, 2]], r"\(2, 2\): not an edge"),
        ([[0.0, 2.0]], "edges must contain integer indices, not float64"),
        ([0, 2], r"edges must have shape \(k, 2\), not \(2,\)"),
        ([[0, 2, 3]], r"edges must have shape \(k, 2\), not \(1, 3\)"),
        (
            np.array([[0, 2**64 - 1]], dtype=np.uint64),
            "edges refers to vertex 18446744073709551615, which is not a valid index",
        ),
    ],
)
def test_invalid_edges_are_named(pairs, message):
    with pytest.raises(ValueError, match=message):
        refine(*TWO, pairs)


def test_invalid_triangles_are_rejected():
    with pytest.raises(ValueError, match="F refers to vertex 4, but there are only vertices 0 … 3"):
        refine(TWO[0], [[0, 1, 4]], [])
    with pytest.raises(ValueError, match="F must contain integer"):
        refine(TWO[0], [[0.5, 1, 2]], [])


@pytest.mark.parametrize(
    ("V", "message"),
    [
        (np.array(TWO[0]) + 1j, "V must contain real numbers"),
        (TWO[0][0], r"V must have shape \(n, 2\) or \(n, 3\)"),
        (np.full((4, 2), np.nan), "V is not finite at vertices 0, 1, 2, 3"),
    ],
)
def test_invalid_vertices_are_rejected(V, message):
    with pytest.raises(ValueError, match=message):
        refine(V, TWO[1], [])


@cache
def refined_problem(name):
    return refine_problem(OBSTRUCTED[name][0])


@pytest.mark.slow
def test_refining_the_named_edges_leaves_only_obstructions_that_no_refinement_removes():
    incurable = {"COLLAPSED_EDGE", "PIN", "NESTING", "NEGATIVE_WINDING", "TURNING_NUMBER", "CROSSING"}
    rounds = {name: refined_problem(name).rounds for name in OBSTRUCTED}
    assert max(rounds.values()) < 6
    for name, number in rounds.items():
        if number:
            assert {o.kind.name for o in refined_problem(name).diagnosis.obstructions} <= incurable, name
    assert sum(number > 0 for number in rounds.values()) >= 15


def rounds_by_hand(problem):
    """Compute `refine_problem` independently, and transfer a function from each mesh to the next."""
    V, F, number = problem.V, problem.F, 0
    values = np.sin(np.arange(3 * len(V)).reshape(-1, 3))
    while len(split := diagnose(Problem(V, F, problem.fixed, problem.target, reference="equilateral")).split):
        refined = refine(V, F, split)
        V, F, values, number = refined.V, refined.F, refined.extend(values), number + 1
    return V, F, values, number


@pytest.mark.long
def test_problems_are_refined_until_no_obstruction_is_named():
    most = 0
    for name, (problem, _) in OBSTRUCTED.items():
        result = refined_problem(name)
        refined, n = result.refined, problem.n
        V, F, values, number = rounds_by_hand(problem)
        assert result.rounds == number
        most = max(most, number)
        np.testing.assert_array_equal(refined.V, V)
        np.testing.assert_array_equal(refined.F, F)
        np.testing.assert_allclose(refined.extend(values[:n]), values, atol=1e-15)
        np.testing.assert_array_equal(result.problem.V, V)
        np.testing.assert_array_equal(result.problem.fixed, problem.fixed)
        assert not len(result.diagnosis.split)
        # New vertices lie in one old triangle, and triangles in their parents.
        assert refined.parents.shape == refined.weights.shape == (len(V) - n, 3) or not number
        assert (np.diff(refined.parents, axis=1) >= 0).all()
        np.testing.assert_array_equal(refined.weights.sum(axis=1), 1)
        old = {frozenset(t) for t in problem.F.tolist()}
        for row in refined.parents.tolist():
            assert any(set(row) <= t for t in old)
        np.testing.assert_array_equal(refined.parent[: len(problem.F)], np.arange(len(problem.F)))
    assert most >= 2


@pytest.mark.slow
def test_rounds_are_limited():
    problem, _ = next(case for name, case in OBSTRUCTED.items() if refined_problem(name).rounds > 1)
    result = refine_problem(problem, max_rounds=1)
    assert result.rounds == 1
    assert len(result.diagnosis.split)
    assert refine_problem(problem, max_rounds=0).problem is problem
