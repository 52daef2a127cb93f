"""The fast parts of the diagnosis agree with slow ones: triangulation, visibility, sampled points, quick tests."""

from __future__ import annotations

import inspect
import sys
import time
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from quasiharmonic import Problem, diagnose
from quasiharmonic.geometry.exact.loops import contacts, winding
from quasiharmonic.geometry.exact.predicates import SegmentRelation, orientation, segment_relation
from quasiharmonic.geometry.mesh.polygons import triangulate
from quasiharmonic.problem.diagnosis import examine, shortcuts
from quasiharmonic.problem.diagnosis.clipping import Effort, Lattice
from quasiharmonic.problem.diagnosis.views import Views
from quasiharmonic.problem.diagnosis.witness import clear
from quasiharmonic.results import Kind
from quasiharmonic.surfaces import annulus, disk, grid
from shared.infeasible_problems import OBSTRUCTED, onto
from shared.meshes import boundary_of
from shared.polygons import U, circle, random_polygon, spiral
from shared.small_meshes import loose_wheel, wheel

POLYGONS = 15


@cache
def polygons():
    rng, count = np.random.default_rng(11), POLYGONS - 3
    random = [
        random_polygon(rng, int(n), int(m))
        for n, m in zip(rng.integers(4, 26, count), rng.integers(6, 9, count), strict=True)
    ]
    return [np.array(U, dtype=float), circle(17), spiral(14, 1.6), *random]


def outlines(kind, n):
    """Simple outlines with many corners."""
    t = 2 * np.pi * np.arange(n) / n
    if kind == "spiral":
        return spiral(n // 2, 8.3)
    if kind == "star":
        return circle(n) * (0.05 + np.random.default_rng(0).random(n))[:, None]
    if kind == "gear":
        return circle(n) * (0.5 + 0.4 * np.sign(np.sin(500.5 * t + 0.1)))[:, None]
    return circle(n) * (1 + 0.3 * np.cos(5 * t) + 0.1 * np.cos(23 * t))[:, None]


def turned_ring(n, layers, angle=np.pi):
    """A ring with the given number of layers, whose inner loop is turned against the outer one."""
    V, F = grid(n, layers)
    here = np.arange(len(V))
    here[n :: n + 1] -= n  # the last column is the first
    kept, F = np.unique(here[F], return_inverse=True)
    radius, turn = 1 + V[kept, 1] / 2, -2 * np.pi * V[kept, 0]
    z = radius * np.exp(1j * turn)
    target = np.where(V[kept, 1] == 1, z * np.exp(1j * angle), z)
    F = F.reshape(-1, 3)
    fixed = boundary_of(F)
    return Problem(z.view(float).reshape(-1, 2), F, fixed, target.view(float).reshape(-1, 2)[fixed])


@pytest.mark.slow
@pytest.mark.parametrize("k", range(POLYGONS))
def test_triangles_fill_polygons(k):
    corners = polygons()[k]
    points = Lattice(corners).points
    triangles = np.array(triangulate(points))
    a, b, c = corners[triangles].transpose(1, 0, 2)
    assert (orientation(a, b, c) > 0).all()
    sides = {(i, j) for t in triangles.tolist() for i, j in pairwise([*t, t[0]])}
    n = len(corners)
    assert len(sides) == 3 * (n - 2) == 3 * len(triangles)
    # Every side of the polygon belongs to one triangle, every other edge to two.
    assert {(i, j) for i, j in sides if (j, i) not in sides} == {(k, (k + 1) % n) for k in range(n)}


def seen(here, eye, corners):
    """Test by brute force whether points see a corner from inside; None for those on a line with two corners."""
    result = []
    after = np.roll(corners, -1, axis=0)
    for x in here:
        met = segment_relation(np.tile(x, (len(corners), 1)), np.tile(corners[eye], (len(corners), 1)), corners, after)
        met[[eye, eye - 1]] = 0
        inside = winding(x[None], corners, after)
        before, behind = corners[eye - 1], after[eye]
        left, right = orientation(before, corners[eye], x), orientation(corners[eye], behind, x)
        convex = orientation(before, corners[eye], behind) >= 0
        opens = (left > 0 and right > 0) if convex else (left > 0 or right > 0)
        vague = (met == SegmentRelation.TOUCHING).any() or inside[1][0] or left == 0 or right == 0
        result.append(None if vague else bool(opens and not met.any() and inside[0][0] == 1))
    return result


@pytest.mark.long
@pytest.mark.parametrize("polygon", [pytest.param(k, marks=[pytest.mark.nightly] * (k % 3 > 0)) for k in range(12)])
def test_wedges_contain_exactly_the_visible_points(polygon, rng):
    corners = polygons()[polygon]
    n = len(corners)
    k = np.arange(n)
    after, before = (k + 1) % n, (k - 1) % n
    sides, beside = np.stack([k, after], axis=1), np.stack([after, before], axis=1)
    views = Views(sides, corners, Lattice(corners), beside, Effort(10**9))
    low, high = corners.min(axis=0), corners.max(axis=0)
    points = low + (high - low) * rng.random((20, 2))
    for eye in range(n):
        wedges = views.wedges(eye)
        (p, q), tip = corners[wedges.wall.T], corners[eye]
        held = [
            bool(
                (
                    (orientation(tip, corners[wedges.right], x) > 0)
                    & (orientation(tip, corners[wedges.left], x) < 0)
                    & (orientation(p, q, x) > 0)
                ).any()
            )
            for x in points
        ]
        for x, truth in zip(held, seen(points, eye, corners), strict=True):
            assert truth is None or x == truth


def test_directions_that_differ_by_rounding_are_sorted_exactly():
    # Seen from the first corner, floating point cannot distinguish the directions of the others.
    corners = np.array([[0, 0], *([1 + 0.1 * k, 1e-30 * k] for k in range(9)), [0.5, 1.0]])
    n = len(corners)
    k = np.arange(n)
    after, before = (k + 1) % n, (k - 1) % n
    sides, beside = np.stack([k, after], axis=1), np.stack([after, before], axis=1)
    views = Views(sides, corners, Lattice(corners), beside, Effort(10**9))
    wedges = views.wedges(0)
    # Each wall except the two at the viewpoint is visible, from right to left.
    assert wedges.wall.tolist() == [[j, j + 1] for j in range(1, n - 1)]
    assert wedges.right.tolist() == list(range(1, n - 1))


@pytest.mark.slow
def test_clear_segments_agree_with_all_pairs(rng):
    points = rng.integers(0, 12, (60, 2)).astype(float)
    walls = np.stack([np.arange(0, 40, 2), np.arange(1, 40, 2)], axis=1)
    ends = np.stack([rng.integers(0, 60, 300), rng.integers(0, 60, 300)], axis=1)
    p, q = points[ends.T]
    expected = []
    for (a, b), x, y in zip(ends.tolist(), p, q, strict=True):
        others = walls[~np.isin(walls, (a, b)).any(axis=1)]
        r, s = points[others.T]
        m = len(others)
        expected.append(not segment_relation(np.tile(x, (m, 1)), np.tile(y, (m, 1)), r, s).any())
    assert clear(p, q, ends, walls, points, 10**9).tolist() == expected
    assert not clear(p, q, ends, walls, points, 10).any()


def winding_number(x, corners):
    """Return the winding number by the definition of Hormann and Agathos, edge by edge."""
    turns = 0
    for p, q in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if (p[1] <= x[1]) != (q[1] <= x[1]):
            up = q[1] > p[1]
            if orientation(p, q, x) * (1 if up else -1) > 0:
                turns += 1 if up else -1
    return turns


@pytest.mark.parametrize("chunk", [1, 1 << 18])
def test_winding_numbers(rng, monkeypatch, chunk):
    monkeypatch.setattr("quasiharmonic.geometry.exact.loops.PAIR_CHUNK", chunk)
    for n in (3, 8, 30):
        corners = rng.integers(0, 9, (n, 2)).astype(float)
        points = np.concatenate([rng.integers(0, 9, (20, 2)), rng.integers(0, 18, (20, 2)) / 2, corners])
        after = np.roll(corners, -1, axis=0)
        turns, on = winding(points, corners, after)
        m = len(points)
        touched = [segment_relation(np.tile(x, (n, 1)), np.tile(x, (n, 1)), corners, after).any() for x in points]
        assert on.tolist() == touched
        for k in np.flatnonzero(~on):
            assert turns[k] == winding_number(points[k], corners)
        assert len(turns) == m
        assert turns.dtype == np.int64


def test_the_number_of_contacts_is_limited(rng):
    points = rng.random((200, 2))
    ends = np.arange(200).reshape(-1, 2)
    every = contacts(points, ends, 10**6)
    assert every.complete
    some = contacts(points, ends, 5)
    assert not some.complete
    assert len(some.pairs) == len(some.relation) == 5 < len(every.pairs)


def random_problems():
    """Simple targets with all kinds of obstruction."""
    rng = np.random.default_rng(4)
    for n in (3,):
        mesh = disk(n)
        count = len(boundary_of(mesh[1]))
        yield onto(mesh, np.roll(spiral(count // 2, rng.uniform(0.7, 1.7)), int(rng.integers(count)), axis=0))
        yield onto(mesh, circle(count) * (0.05 + rng.random(count))[:, None])
        if count <= 18:
            yield onto(mesh, random_polygon(rng, count, 7))
    for n in (5,):
        V, F = annulus(n)
        inner = np.abs(V).max(axis=1) < 1
        target = np.where(inner[:, None], V @ [[-1, 0], [0, -1]] * rng.uniform(0.5, 1.2), V)
        fixed = boundary_of(F)
        yield Problem(V, F, fixed, target[fixed])
    for _ in range(2):
        V, F = grid(5, 5)
        inside = np.setdiff1d(np.arange(len(V)), boundary_of(F))
        fixed = np.concatenate([boundary_of(F), pins := rng.choice(inside, 6, replace=False)])
        target = np.round(8 * (V + 0.2 * rng.normal(size=V.shape) * np.isin(np.arange(len(V)), pins)[:, None])) / 8
        yield Problem(V, F, fixed, target[fixed])


def found(problem):
    return [
        (o.kind, o.forbids, o.vertices.tolist(), o.edges.tolist(), o.split.tolist())
        for o in diagnose(problem).obstructions
    ]


@pytest.mark.long
def test_fast_tests_of_the_diagnosis_agree_with_slow_ones(monkeypatch):
    problems = [*random_problems(), *(problem for problem, _ in OBSTRUCTED.values())]
    quick = [found(problem) for problem in problems]
    monkeypatch.setattr(examine, "find_unplaced", lambda stars, *_: np.arange(len(stars)))
    monkeypatch.setattr(shortcuts.Shortcuts, "are_close", lambda self, i, j, k: np.zeros(len(i), dtype=bool))
    assert quick == [found(problem) for problem in problems]
    kinds = {kind for some in quick for kind, *_ in some}
    assert {Kind.HIDDEN, Kind.HALF_PLANES, Kind.LINK_DISTANCE, Kind.CHORD} <= kinds


def test_checks_that_take_too_long_are_reported_as_unchecked(monkeypatch):
    problem, _ = OBSTRUCTED["nothing sees all"]
    monkeypatch.setattr(examine, "MAX_EFFORT", 0)
    diagnosis = diagnose(problem)
    assert not diagnosis.obstructions
    assert "sees all fixed neighbours of vertex 8" in diagnosis.unchecked[0]


def crooked_wheel(n, mesh=wheel):
    """A hub that sees a whole star only from the centre; the star's corners have very different distances."""
    return onto(mesh(n), circle(n) * np.exp(2 * np.random.default_rng(0).normal(size=n))[:, None])


@pytest.mark.long
@pytest.mark.parametrize("mesh", [wheel, loose_wheel])
def test_hubs_with_a_thousand_neighbours_are_placed(mesh):
    problem = crooked_wheel(1_000, mesh)
    began = time.process_time()
    diagnosis = diagnose(problem)
    # It takes half a second or less on an idle machine.
    assert time.process_time() - began < 15
    assert diagnosis.obstructions == ()
    assert not any("sees" in words for words in diagnosis.unchecked)


@pytest.mark.long
def test_a_position_is_sought_for_any_number_of_neighbours(monkeypatch):
    # There are more nested visibility regions than Python allows nested calls.
    monkeypatch.setattr(examine, "find_unplaced", lambda stars, *_: np.arange(len(stars)))
    monkeypatch.setattr(examine, "MAX_EFFORT", 10**9)
    problem, usual = crooked_wheel(190), sys.getrecursionlimit()
    sys.setrecursionlimit(len(inspect.stack(0)) + 150)
    try:
        assert diagnose(problem).obstructions == ()
    finally:
        sys.setrecursionlimit(usual)


def test_the_effort_limit_also_applies_within_one_star(monkeypatch):
    monkeypatch.setattr(examine, "find_unplaced", lambda stars, *_: np.arange(len(stars)))
    monkeypatch.setattr(examine, "MAX_EFFORT", 2_000)
    diagnosis = diagnose(crooked_wheel(100))
    assert diagnosis.obstructions == ()
    assert "sees all fixed neighbours of vertex 100" in diagnosis.unchecked[0]


@pytest.mark.nightly
def test_five_thousand_neighbours_take_a_few_seconds():
    began = time.process_time()
    assert diagnose(crooked_wheel(5_000)).obstructions == ()
    # It takes five seconds on an idle machine.
    assert time.process_time() - began < 40


@pytest.mark.long
@pytest.mark.parametrize(
    "kind", ["wobble", "spiral", *(pytest.param(name, marks=pytest.mark.nightly) for name in ("star", "gear"))]
)
def test_ten_thousand_boundary_vertices(kind):
    problem = onto(grid(4990, 10), outlines(kind, 10_000))
    began = time.process_time()
    assert diagnose(problem).obstructions == ()
    # It takes less than a second on an idle machine.
    assert time.process_time() - began < 30


@pytest.mark.slow
def test_every_vertex_of_a_ring_sees_too_little():
    problem = turned_ring(60, 2)
    began = time.process_time()
    diagnosis = diagnose(problem)
    assert time.process_time() - began < 30
    assert {o.kind for o in diagnosis.obstructions} == {Kind.HIDDEN}
    assert {int(o.vertices[0]) for o in diagnosis.obstructions} == set(range(problem.n)) - set(problem.fixed.tolist())
