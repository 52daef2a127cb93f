"""Coarse meshes, prolongation from them, and the search that uses them."""

from __future__ import annotations

from collections import Counter
from copy import copy
from itertools import pairwise

import numpy as np
import pytest

from quasiharmonic import Problem, Status, distortion, inverted_triangles, is_injective, solve
from quasiharmonic.geometry.coarsening import (
    allocate_round,
    coarsen,
    has_marked_corner,
    remove_vertices,
    split_by_degree,
)
from quasiharmonic.geometry.mesh.topology import boundary_loops, edges
from quasiharmonic.geometry.prolongation import prolong, reinsertion_positions, smooth
from quasiharmonic.linsolve.laplacian import Laplacian
from quasiharmonic.problem import Domain
from quasiharmonic.solver.methods import VectorAdam
from quasiharmonic.solver.search import search
from quasiharmonic.solver.search.search import CoarseMesh, coarse_mesh
from quasiharmonic.solver.search.stages import CoarseToFine, speed
from quasiharmonic.surfaces import disk, grid, random_delaunay
from quasiharmonic.targets import arc_length, letter
from shared.distinct_steps import DistinctSteps
from shared.meshes import boundary_of, lift, random_annulus, signed_areas, tangled


def meshes():
    pinned = random_delaunay(1200, seed=5)
    return [
        ("disk", *disk(20), ()),
        ("grid", *grid(40, 30), ()),
        ("irregular, pinned", *pinned, (len(pinned[0]) - 1, len(pinned[0]) - 40)),
        ("annulus", *random_annulus(1500, seed=2), ()),
    ]


def coarsened(V, F, pins=(), goal=0):
    held = np.zeros(len(V), dtype=bool)
    held[boundary_of(F)] = True
    held[list(pins)] = True
    return held, coarsen(F, len(V), held, goal)


def turned(F):
    """Return the triangles as a set; each starts at its smallest vertex."""
    first = F.argmin(axis=1)[:, None] + np.arange(3)
    return set(map(tuple, np.take_along_axis(F, first % 3, axis=1).tolist()))


@pytest.mark.parametrize(("name", "V", "F", "pins"), meshes(), ids=lambda x: x if isinstance(x, str) else "")
class TestCoarsen:
    def test_gives_a_surface_with_the_same_boundary(self, name, V, F, pins):
        held, coarse = coarsened(V, F, pins)
        found, fine = edges(coarse.F, len(V)), edges(F, len(V))
        assert not found.nonmanifold.size
        assert not found.inconsistent.size
        assert set(map(tuple, found.boundary.tolist())) == set(map(tuple, fine.boundary.tolist()))
        assert np.isin(np.flatnonzero(held), coarse.F).all()
        # The Euler characteristic does not change: no handle and no hole.
        euler = [
            np.unique(T).size - len(e.interior) - len(e.boundary) + len(T) for T, e in ((coarse.F, found), (F, fine))
        ]
        assert euler[0] == euler[1]
        assert np.unique(coarse.F).size < 0.45 * len(V)

    @pytest.mark.slow
    def test_prolongs_to_the_original_mesh(self, name, V, F, pins):
        """In each round, rings contain the vertices that existed before, and fans fill them."""
        _, coarse = coarsened(V, F, pins)
        triangles = turned(coarse.F)
        for number in reversed(range(len(coarse.rounds))):
            for vertices, rings in coarse.rounds[number]:
                for vertex, ring in zip(vertices.tolist(), rings.tolist(), strict=True):
                    fan = turned(np.array([(ring[0], *pair) for pair in pairwise(ring[1:])]))
                    star = turned(np.array([(vertex, *pair) for pair in zip(ring, ring[1:] + ring[:1], strict=True)]))
                    assert fan <= triangles
                    assert not star & triangles
                    triangles = (triangles - fan) | star
            if number in coarse.levels:
                assert triangles == turned(coarse.levels[number])
        assert triangles == turned(F)
        assert 0 in coarse.levels

    def test_fixed_vertices_get_no_new_neighbours(self, name, V, F, pins):
        held, coarse = coarsened(V, F, pins)
        n = len(V)

        def at_held(T):
            e = edges(T, n)
            pairs = np.sort(np.concatenate([e.interior, e.boundary]), axis=1)
            return set(map(tuple, pairs[held[pairs].any(axis=1)].tolist()))

        assert at_held(coarse.F) <= at_held(F)

    def test_stops_at_its_goal_and_is_deterministic(self, name, V, F, pins):
        goal = int(0.7 * len(V))
        _, coarse = coarsened(V, F, pins, goal)
        _, again = coarsened(V, F, pins, goal)
        # A round removes at most a quarter of the vertices.
        assert 0.7 * goal < np.unique(coarse.F).size <= goal
        np.testing.assert_array_equal(coarse.F, again.F)


def removed_by_hand(T, free, dice):
    """Return the vertices that a round removes, with their rings, and the reasons why others stay, vertex by vertex."""
    triangles = T.T.tolist()
    following = {v: {} for v in range(free.size)}
    for t in triangles:
        for i in range(3):
            following[t[i]][t[i - 2]] = t[i - 1]
    left = {v: dice[v] + 0.35 * len(ring) for v, ring in following.items() if free[v] and len(ring) <= 8}
    chosen = []
    for _ in range(3):
        soon = [v for v in left if all(left[v] < left.get(other, np.inf) for other in following[v])]
        for v in soon:
            for near in (v, *following[v]):
                left.pop(near, None)
        chosen += soon
    rings, claimed, why = {}, set(), Counter()
    for v in sorted(chosen, key=lambda v: (len(following[v]), v)):
        ring = [min(following[v], key=lambda other: (not free[other], len(following[other]) + dice[other]))]
        while len(ring) < len(following[v]):
            ring.append(following[v][ring[-1]])
        if not all(free[other] for other in (ring[0], *ring[2:-1])):
            why["held"] += 1
            continue
        new = {frozenset((ring[0], other)) for other in ring[2:-1]}
        there = any(set(edge) <= {*following[u], u} for edge in new for u in edge)
        why["there"] += there
        why["claimed"] += bool(new & claimed)
        if not there and not new & claimed:
            rings[v] = ring
        claimed |= new
    return rings, why


@pytest.mark.slow
def test_rounds_remove_the_expected_vertices():
    """The meshes are such that every reason to keep a vertex occurs."""
    whys = Counter()
    for seed in range(25):
        rng = np.random.default_rng(seed)
        T, free = tangled(rng, 150)
        dice = 12 * rng.random(free.size)  # so that neighbours count little
        vertices, rings, of_degree = allocate_round(T)
        remove_vertices(T, free, dice, vertices, rings, of_degree)
        found = [ring for some in split_by_degree(rings, of_degree) for ring in some.tolist()]
        expected, why = removed_by_hand(T, free, dice)
        assert dict(zip(vertices.tolist(), found, strict=False)) == expected
        assert vertices[: len(found)].tolist() == list(expected)
        whys += why
    assert whys["held"] > 10
    assert whys["there"] > 2
    assert whys["claimed"] > 2


def test_vertices_that_touch():
    F = np.array([[0, 1, 2], [2, 1, 3], [3, 4, 5]])
    np.testing.assert_array_equal(
        has_marked_corner(F, np.array([True, False, False, False, True, False])),
        [True, False, True],
    )


class TestKernelPoints:
    @pytest.mark.parametrize("d", range(3, 9))
    @pytest.mark.parametrize("thin", [1.0, 1e-3, 1e-9])
    def test_see_the_whole_ring(self, d, thin, rng):
        """Rings that are visible from their apexes and from few other points."""
        rows = 300
        # The fan's sectors have any angles whose sum is below a full turn; the ring may be reflex at its apex.
        sectors = rng.random((rows, d - 2)) + 1e-2
        sectors *= (rng.uniform(0.2, 1.95 * np.pi, rows) / sectors.sum(axis=1))[:, None]
        sectors = np.minimum(sectors, 0.95 * np.pi)
        angle = np.concatenate([np.zeros((rows, 1)), np.cumsum(sectors, axis=1)], axis=1)
        arm = thin ** rng.random((rows, d - 1)) * np.exp(1j * angle)
        ring = np.concatenate([np.zeros((rows, 1)), arm], axis=1) * np.exp(2j * np.pi * rng.random((rows, 1)))
        ring += rng.standard_normal((rows, 1))
        place = reinsertion_positions(ring)
        spokes = ring - place[:, None]
        area = (spokes.conj() * np.roll(spokes, -1, axis=1)).imag
        if thin > 1e-6:
            assert area.min() > 0
        else:
            # If arms differ by nine orders of magnitude, rounding loses a few points.
            assert np.mean(area.min(axis=1) > 0) > 0.97

    def test_are_the_centre_of_a_regular_ring(self):
        ring = 3 + 2 * np.exp(2j * np.pi * np.arange(6) / 6)[None]
        assert reinsertion_positions(ring)[0] == pytest.approx(3)


class TestSmoothing:
    def test_moves_vertices_to_the_mean_of_their_neighbours(self, rng):
        V, F = disk(6)
        held = np.zeros(len(V), dtype=bool)
        held[[*boundary_of(F), 7]] = True
        w = V @ (1, 1j) + 0.01 * rng.random(len(V))
        pairs = np.unique(np.concatenate([F[:, (0, 1)], F[:, (1, 2)], F[:, (2, 0)]]), axis=0)
        neighbours = [pairs[pairs[:, 0] == v, 1] for v in range(len(V))]
        expected = [w[v] if held[v] else w[neighbours[v]].mean() for v in range(len(V))]
        smooth(w, F, held)
        np.testing.assert_allclose(w, expected, atol=1e-15)

    def test_inverts_nothing(self):
        """A spiral whose arms are crossed by the means of neighbours."""
        V, F = disk(30)
        held = np.zeros(len(V), dtype=bool)
        held[boundary_of(F)] = True
        z = V @ (1, 1j)
        w = np.abs(z) ** 3 * np.exp(10j * np.abs(z)) * z
        before = w.copy()
        assert inverted_triangles(F, w.view(float).reshape(-1, 2)).size == 0
        smooth(w, F, held)
        assert inverted_triangles(F, w.view(float).reshape(-1, 2)).size == 0
        assert 0.05 < np.mean(w[~held] == before[~held]) < 0.95


@pytest.mark.parametrize(("name", "V", "F", "pins"), meshes(), ids=lambda x: x if isinstance(x, str) else "")
def test_injective_maps_stay_injective(name, V, F, pins, rng):
    """Only the positions of the coarse vertices are given, and they may be far from even."""
    held, coarse = coarsened(V, F, pins)
    used, local = np.unique(coarse.F, return_inverse=True)
    local = local.reshape(-1, 3).astype(np.int64)
    fixed = np.flatnonzero(held[used])
    found = solve(Problem(V[used], local, fixed, V[used][fixed], reference="equilateral"))
    assert found.injective
    uv = found.uv
    for _ in range(100):
        # Move vertices at random towards one of their neighbours while triangles stay positive.
        some = local[rng.choice(len(local), 3)]
        free = some[~np.isin(some[:, 0], fixed)]
        moved = uv.copy()
        moved[free[:, 0]] += 0.8 * (uv[free[:, 1]] - uv[free[:, 0]])
        if is_injective(local, moved):
            uv = moved
    assert not np.array_equal(uv, found.uv)
    w = np.full(len(V), np.nan, dtype=complex)
    w[used] = uv @ (1, 1j)
    out = prolong(w, coarse, held)
    np.testing.assert_array_equal(out[held], w[held])
    assert inverted_triangles(F, np.stack([out.real, out.imag], axis=1)).size == 0


def on_letter(character, rings=50):
    V, F = disk(rings)
    (loop,) = boundary_loops(F, len(V))
    return lift(V), F, loop, arc_length(V[loop], letter(character)[0])


@pytest.fixture(scope="module")
def posed():
    return Problem(*on_letter("S", rings=50))


class TestSearch:
    def test_large_meshes_are_solved_without_factoring_them(self, posed, monkeypatch):
        factor, sizes = Laplacian.factor, set()

        def recorded(laplacian, *arguments):
            sizes.add(laplacian.n)
            return factor(laplacian, *arguments)

        monkeypatch.setattr(Laplacian, "factor", recorded)
        problem = posed.with_target(posed.target)
        steps = DistinctSteps()
        result = solve(problem, callback=steps.append)
        assert result.injective
        assert [s.name.split(",")[0] for s in result.stages] == ["coarse-to-fine"]
        assert 0 < max(sizes) < problem.n
        np.testing.assert_array_equal(result.uv[problem.fixed], problem.target)
        assert steps == result.history
        assert [s.iteration for s in steps] == list(range(len(steps)))
        assert result.n_iterations == len(steps) - 1
        assert (steps[-1].inverted, steps[-1].energy) == (0, 0.0)
        assert result.mu.shape == (len(problem.F),)
        assert np.all(np.abs(result.mu) < 1)

    @pytest.mark.slow
    def test_its_maps_are_no_worse(self, posed):
        def mean(uv):
            d = distortion(posed.V, posed.F, uv)
            return float((d.mips * d.share).sum())

        direct = solve(posed, strategy=[s for s in speed(posed) if not isinstance(s, CoarseToFine)])
        assert mean(solve(posed).uv) < 2 * mean(direct.uv)

    def test_repeats_for_a_moved_target(self, posed):
        shifted = posed.with_target(2 * posed.target + 1)
        strategy = [CoarseToFine(VectorAdam())]
        first, second = solve(posed, strategy=strategy), solve(shifted, strategy=strategy)
        np.testing.assert_allclose(second.uv, 2 * first.uv + 1, atol=1e-9)
        coarse = coarse_mesh(posed)
        assert coarse is not None
        assert coarse_mesh(shifted) is coarse

    @pytest.mark.slow
    def test_the_coarse_map_takes_three_polishing_steps(self, posed, monkeypatch):
        taken = []

        def polish_map(*given):
            polished = polish(*given)
            taken.append(polished.n_iterations)
            return polished

        polish = search.polish_map
        monkeypatch.setattr(search, "polish_map", polish_map)
        assert solve(posed).injective
        assert taken == [3]

    @pytest.mark.slow
    def test_handles_pins_and_holes(self):
        V, F = random_annulus(4000, seed=3)
        fixed = np.append(boundary_of(F), [int(np.argmin(np.abs(V - (0, 0.7)).sum(axis=1)))])
        target = V[fixed] @ [[1, 0.4], [0, 1]]
        target[-1] += 0.02
        strategy = [CoarseToFine(VectorAdam(parameterisation="si-log", iterations=400))]
        result = solve(Problem(lift(V), F, fixed, target), strategy=strategy)
        assert result.injective
        assert result.stages[0].name.startswith("coarse-to-fine, vector-adam, si-log")

    @pytest.mark.slow
    def test_continues_if_the_coarse_problem_fails(self, posed, monkeypatch):
        found = solve(posed)

        def mirrored(problem):
            """The coarse mesh with reversed triangles, which admits no map."""
            coarse = copy(coarse_mesh(problem))
            turned = coarse.domain.F[:, ::-1]
            coarse.domain = Domain(coarse.domain.V, turned, coarse.domain.fixed)
            return coarse

        monkeypatch.setattr(search, "coarse_mesh", mirrored)
        result = solve(posed)
        assert result.injective
        assert [s.name.split(",")[0] for s in result.stages] == [
            "coarse-to-fine",
            "composite",
        ]
        assert not result.stages[0].kept
        assert result.n_iterations == len(result.history) - 1
        assert not np.array_equal(result.uv, found.uv)

    @pytest.mark.slow
    @pytest.mark.parametrize("repaired", [True, False])
    def test_triangles_that_the_coarse_search_leaves_inverted_are_repaired(self, posed, monkeypatch, repaired):
        """A search on the whole mesh for one or two triangles took many times as long."""
        solved = search.search_coarse

        def nearly(coarse, *further):
            _, uv, _, solver = solved(coarse, *further)
            return Status.STALLED, uv, 1, solver

        def displaced(coarse, w):
            fine = prolonged(coarse, w)
            inside = posed.F[~np.isin(posed.F, posed.fixed).any(axis=1)]
            fine[inside[0, 0]] += 1.5 * (fine[inside[0, 1]] - fine[inside[0, 0]])
            return fine

        prolonged = CoarseMesh.prolong
        monkeypatch.setattr(CoarseMesh, "prolong", displaced)
        monkeypatch.setattr(search, "search_coarse", nearly)
        if not repaired:
            monkeypatch.setattr(search, "LOCAL_REPAIRS", ())
        result = solve(posed, strategy=[CoarseToFine(VectorAdam()), VectorAdam(iterations=1)])
        first, *others = [s.name.split(",")[0] for s in result.stages]
        left = result.stages[0].inverted[1]
        assert first == "coarse-to-fine"
        assert 0 < left <= 50
        assert result.injective is repaired
        if repaired:
            assert others == ["line shift"]
        else:
            # It starts again, and its result is worse than the stored one.
            assert others == ["vector-adam"]
            assert result.stages[1].inverted[1] > left == len(result.certificate.inverted)

    @pytest.mark.slow
    def test_is_skipped_where_it_does_not_help(self, posed):
        small = Problem(*on_letter("C", rings=12))
        assert coarse_mesh(small) is None
        names = [s.name.split(",")[0] for s in speed(small)]
        assert names.index("coarse-to-fine") == 2
        assert coarse_mesh(Problem(posed.V, posed.F, posed.fixed, posed.target, reference="rest")) is None
        recorded = solve(Problem(*on_letter("C")), record_every=1)
        assert "coarse-to-fine" not in recorded.stages[0].name

    def test_interrupted(self, posed):
        def stop(step):
            if step.iteration == 3:
                raise KeyboardInterrupt

        result = solve(posed, callback=stop)
        assert result.status is Status.INTERRUPTED
        assert result.certificate.inverted.size > 0
        # The result is the prolonged coarse map, not the centre of the target.
        assert np.count_nonzero(signed_areas(posed.F, result.uv) > 0) > len(posed.F) // 2

    @pytest.mark.parametrize("bend", [0.0, 1e-9], ids=["in a plane", "all but in a plane"])
    def test_flat_coarse_triangles_get_shapes(self, bend, rng):
        """On a grid, some coarse triangles have corners on a line, or almost."""
        V, F = grid(120, 120)
        V = np.column_stack([V, bend * rng.standard_normal(len(V))])
        problem = Problem(V, F, boundary_of(F), V[boundary_of(F), :2] @ [[1, 0.3], [0, 1]])
        result = solve(problem)
        assert result.injective
        coarse = coarse_mesh(problem).domain
        edge = np.linalg.norm(coarse.V[coarse.F] - coarse.V[np.roll(coarse.F, 1, axis=1)], axis=2)
        assert np.isfinite(coarse.V).all()
        assert edge.min() > 0
        area = np.linalg.norm(np.cross(*(coarse.V[coarse.F[:, i]] - coarse.V[coarse.F[:, 0]] for i in (1, 2))), axis=1)
        assert (area > 1e-5 * edge.max(axis=1) ** 2).all()


def test_degrees_stay_low():
    V, F = disk(60)
    _, coarse = coarsened(V, F)
    degree = Counter(coarse.F.ravel().tolist())
    assert max(degree.values()) <= 14
