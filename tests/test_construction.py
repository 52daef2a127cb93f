"""The construction of a map to every simple target: its parts, the whole, and the limits of double precision."""

from __future__ import annotations

from fractions import Fraction
from itertools import islice

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from quasiharmonic import Problem, Status, certify, injective_map
from quasiharmonic.geometry.mesh.splitting import split_edges
from quasiharmonic.geometry.mesh.topology import boundary_loops, components, edges
from quasiharmonic.solver.construction.constructing import construct_and_thin, is_simple
from quasiharmonic.solver.construction.cutting import Cutting, walk
from quasiharmonic.solver.construction.half_edges import HalfEdges, Regions, Sheet
from quasiharmonic.solver.construction.thinning import quality, thin_refinement, triangulate_best
from quasiharmonic.solver.field.objective import Objective
from quasiharmonic.solver.methods.local_repair import remap_patches
from quasiharmonic.solver.methods.untangling import untangle
from quasiharmonic.surfaces import disk, grid
from quasiharmonic.targets import flattened_edges
from shared.polygons import circle, random_polygon, spread
from shared.simple_targets import (
    check_construction,
    onto_polygon,
    polygon,
    turned_ring,
    with_holes,
    without_inner_vertices,
)
from shared.small_meshes import handle, wheel

KINDS = ["burst", "spiral", "comb", "grid", "flat"]


def construct(problem, guide=None, *, thin=True):
    """Return the constructed map, thinned unless ``thin`` is False."""
    *_, made = islice(construct_and_thin(problem, guide), None if thin else 1)
    return made


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", [0, 1, 6, 9])
def test_polygons_of_every_kind_are_targets(kind, seed):
    problem = onto_polygon(seed, kind)
    assert is_simple(problem)
    check_construction(problem, construct(problem, thin=seed > 1))


@pytest.mark.long
@settings(max_examples=6, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from(KINDS))
def test_random_polygons_are_targets(seed, kind):
    problem = onto_polygon(seed, kind)
    if is_simple(problem):
        check_construction(problem, construct(problem))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("holes", "pins"), [(1, 0), (0, 1), (0, 5), (3, 0), (2, 3), pytest.param(6, 6, marks=pytest.mark.nightly)]
)
def test_holes_and_pins_at_any_position(holes, pins):
    problem = with_holes(np.random.default_rng(holes), holes, pins, size=7 if pins == 5 else 9)
    assert is_simple(problem)
    assert len(problem.domain.loops) == 1 + holes
    assert len(problem.domain.pins) == pins
    check_construction(problem, construct(problem, thin=(holes, pins) != (2, 3)))


@pytest.mark.slow
@pytest.mark.parametrize("quarters", range(4))
def test_a_turned_ring_is_mapped(quarters):
    problem = turned_ring(quarters)
    check_construction(problem, construct(problem))


@pytest.mark.slow
def test_a_ring_turned_inside_out():
    """Any loop may be the outer one in the target."""
    problem = turned_ring(0)
    away = problem.target / np.sum(problem.target**2, axis=1)[:, None]
    # An inversion reverses the orientation of loops; a reflection restores it.
    problem = problem.with_target(away * [1, -1])
    assert is_simple(problem)
    check_construction(problem, construct(problem))


def test_a_guide_may_have_inverted_triangles():
    problem = onto_polygon(4, "grid")
    guide = np.zeros((problem.n, 2))
    guide[problem.fixed] = problem.target
    check_construction(problem, construct(problem, guide))


@pytest.mark.slow
@pytest.mark.parametrize("exponent", [-900, -40, 900])
def test_the_scale_of_the_target_has_no_effect(exponent):
    problem = onto_polygon(2, "grid")
    far = problem.with_target(np.ldexp(problem.target, exponent))
    made = construct(far)
    check_construction(far, made)
    assert np.array_equal(np.ldexp(made.uv, -exponent), construct(problem).uv)


def pinned_near_each_other(size, apart):
    """A disk mapped to itself, with three inner vertices pinned near the origin."""
    V, F = disk(4)
    (loop,) = boundary_loops(F, len(V))
    pins = np.setdiff1d(np.arange(len(V)), loop)[:3]
    places = np.array([[1, 0], [0, 1], [0, 0]]) * apart
    return Problem(V, F, np.concatenate([loop, pins]), np.concatenate([V[loop] * size, places]))


@pytest.mark.parametrize("apart", [1e-160, 1e-300])
def test_cuts_of_any_length(apart):
    problem = pinned_near_each_other(1, apart)
    assert is_simple(problem)
    cutting = Cutting(problem)
    # Three of the cuts connect a pin; each of the others makes a piece.
    assert len(cutting.sheet.loops()) == len(cutting.regions.cuts) // 2 - 3 + 1


@pytest.mark.parametrize("scale", [1e-130, 1e-160, 1e-300])
def test_patches_whose_areas_underflow_are_left_alone(scale):
    V, F = disk(2)
    (loop,) = boundary_loops(F, len(V))
    w = V @ np.array([1, 1j]) * scale
    w[np.setdiff1d(np.arange(len(V)), loop)] *= 9
    steps = list(untangle(F, w, loop, grading=0.0))
    assert bool(steps) == (scale > 1e-140)


def test_other_maps_of_patches_have_a_limit():
    problem = pinned_near_each_other(1, 1e-3)
    objective, tried = Objective(problem), []
    list(
        remap_patches(
            objective, np.zeros(problem.n) + 0j, np.arange(9), lambda *_: tried.append(0), patience=50, tries=3
        )
    )
    assert len(tried) == 3


def test_targets_beyond_the_precision_limit_are_reported():
    problem = pinned_near_each_other(1e300, 1e-25)
    assert is_simple(problem)
    made = construct(problem)
    assert not made.certificate.injective
    assert np.array_equal(made.refined.F, problem.F)
    assert made.crowded.size


def test_thinning_keeps_vertices_near_the_precision_limit():
    V, F = disk(2)
    (loop,) = boundary_loops(F, len(V))
    problem = Problem(V, F, loop, V[loop] * 1e300)
    refined = split_edges(V, F, problem.domain.edges.interior[:1])
    uv = refined.V * 1e300
    uv[np.hypot(*V.T).argmin()] = 1e-25, 0
    assert certify(refined.F, uv).bijective
    same, places = thin_refinement(problem, refined, uv)
    assert same is refined
    assert np.array_equal(places, uv)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("scale", [1e-310, 1.7e308])
def test_flattened_edges_at_any_scale(scale):
    F = np.array([[2, (2 + k) % 8, (3 + k) % 8] for k in range(1, 7)])
    target = circle(8)
    target[3] = (target[2] + target[4]) / 2
    expected = flattened_edges(F, np.arange(8), target)
    assert len(expected)
    assert np.array_equal(flattened_edges(F, np.arange(8), target * scale), expected)


def test_far_from_the_origin():
    problem = onto_polygon(2, "grid")
    far = problem.with_target(problem.target + 2.0**40)
    check_construction(far, construct(far))


def test_a_mesh_that_fits_needs_no_new_vertices():
    V, F = disk(5)
    (loop,) = boundary_loops(F, len(V))
    problem = Problem(V, F, loop, V[loop])
    made = construct(problem)
    check_construction(problem, made)
    assert not len(made.refined.parents)
    assert np.array_equal(made.refined.F, F)


def test_thinning_keeps_the_needed_vertices():
    """A chord outside the target needs one vertex; a chord inside needs none."""
    V, F = [[0, 0], [1, 0], [1, 1], [0, 1]], [[0, 1, 2], [0, 2, 3]]
    chevron = Problem(V, F, [0, 1, 2, 3], [[-1, -1], [0, 0], [1, -1], [0, 2]])
    made = construct(chevron)
    check_construction(chevron, made)
    assert len(made.refined.parents) == 1
    turned = chevron.with_target(np.roll(chevron.target, 1, axis=0))
    made = construct(turned)
    check_construction(turned, made)
    assert not len(made.refined.parents)


class TestPrecisionLimit:
    @pytest.mark.slow
    def test_a_triangle_of_adjacent_doubles(self):
        """The triangle contains no other point with double-precision coordinates."""
        V, F = wheel(3)
        step = 2.0**-52
        problem = Problem(V, F, [0, 1, 2], [[1, 1], [1 + step, 1], [1, 1 + step]])
        assert is_simple(problem)
        made = construct(problem)
        assert not made.certificate.injective
        assert set(made.crowded.tolist()) <= {0, 1, 2}
        assert made.crowded.size

    def test_one_point_in_between(self):
        """The construction finds the only lattice point inside."""
        V, F = wheel(3)
        step = 2.0**-52
        problem = Problem(V, F, [0, 1, 2], 1 + step * np.array([[0, 0], [3, 0], [0, 3]]))
        made = construct(problem)
        check_construction(problem, made)
        assert np.array_equal(made.uv[3], [1 + step, 1 + step])


class TestWhichProblems:
    def test_handles(self):
        V, F = handle()
        (loop,) = boundary_loops(F, len(V))
        assert not is_simple(Problem(V, F, loop, circle(len(loop))))

    def test_crossing_and_reversed_loops(self):
        V, F = disk(3)
        (loop,) = boundary_loops(F, len(V))
        round_ = circle(len(loop))
        assert is_simple(Problem(V, F, loop, round_))
        assert not is_simple(Problem(V, F, loop, round_[::-1]))
        assert not is_simple(Problem(V, F, loop, circle(len(loop), turns=2)))

    @pytest.mark.parametrize(
        ("place", "simple"), [([0.5, 0.5], True), ([0, 0.5], False), ([0, 0], False), ([1.5, 0.5], False)]
    )
    def test_pins(self, place, simple):
        V, F = grid(4, 4)
        (loop,) = boundary_loops(F, len(V))
        assert is_simple(Problem(V, F, [*loop, 12], [*V[loop], place])) is simple

    def test_pins_at_one_position(self):
        V, F = grid(4, 4)
        (loop,) = boundary_loops(F, len(V))
        assert not is_simple(Problem(V, F, [*loop, 11, 12], [*V[loop], [0.5, 0.5], [0.5, 0.5]]))

    def test_a_pin_in_a_hole(self):
        problem = with_holes(np.random.default_rng(0), 1, 1)
        hole = min(problem.domain.loops, key=len)
        target = problem.target.copy()
        target[-1] = target[np.isin(problem.fixed, hole)].mean(axis=0)
        assert is_simple(problem)
        assert not is_simple(problem.with_target(target))

    @pytest.mark.parametrize("seed", range(5))
    def test_pins_level_with_corners(self, seed):
        """On a lattice, rays pass through corners and along sides; a rational ray also decides these cases."""
        rng = np.random.default_rng(seed)
        corners = random_polygon(rng, 10, 6)
        V, F = disk(3)
        (loop,) = boundary_loops(F, len(V))
        outline = spread(corners, len(loop))
        for place in np.stack(np.meshgrid(np.arange(6.0), np.arange(6.0)), axis=2).reshape(-1, 2):
            problem = Problem(V, F, [*loop, 0], [*outline, place])
            assert is_simple(problem) == strictly_inside(place, corners)


def strictly_inside(point, corners):
    """Test whether a point is strictly inside a polygon, by a generic ray and fractions."""
    x, y = (Fraction(c) for c in point)
    slope, inside = Fraction(1234567, 7654321), False
    for p, q in zip(corners.tolist(), np.roll(corners, -1, axis=0).tolist(), strict=True):
        (px, py), (qx, qy) = ([Fraction(c) for c in r] for r in (p, q))
        cross = (qx - px) * (y - py) - (qy - py) * (x - px)
        if cross == 0 and min(px, qx) <= x <= max(px, qx) and min(py, qy) <= y <= max(py, qy):
            return False
        one, other = (py - y) - slope * (px - x), (qy - y) - slope * (qx - x)
        if (one > 0) != (other > 0):
            # The side meets the line through the point either ahead of it or behind it.
            share = one / (one - other)
            inside ^= px + share * (qx - px) > x
    return inside


def twice_area(corners):
    x, y = corners.T
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


class TestRegions:
    @pytest.mark.parametrize("kind", KINDS)
    def test_regions_are_convex_and_complete(self, kind):
        points = polygon(np.random.default_rng(1), kind, 30)
        points = points / np.abs(points).max()
        n = len(points)
        regions = Regions(points, [np.arange(n)], np.empty(0, dtype=np.int64))
        cuts = regions.diagonals([])
        assert regions.bridges() == []
        assert {frozenset(cut) for cut in cuts} == {frozenset(cut) for cut in regions.cuts}
        # No region turns right along its boundary.
        rim = {(k, (k + 1) % n) for k in range(n)} | regions.cuts
        area, seen = 0.0, set()
        for start in sorted(rim):
            here, loop = start, []
            while here not in seen:
                seen.add(here)
                loop.append(here[0])
                a, b = here
                c = regions.apex[a, b]
                while (b, c) not in rim:
                    c = regions.apex[c, b]
                here = b, c
            for k in range(len(loop)):
                assert regions.turn(loop[k - 2], loop[k - 1], loop[k]) >= 0
            area += twice_area(points[loop])
        assert np.isclose(area, twice_area(points))

    def test_bridges_connect_loops_and_pins(self):
        problem = with_holes(np.random.default_rng(3), 4, 5)
        number = np.full(problem.n, -1)
        number[problem.fixed] = np.arange(len(problem.fixed))
        loops = [number[loop] for loop in problem.domain.loops]
        regions = Regions(problem.target, loops, number[problem.domain.pins])
        bridges = regions.bridges()
        assert len(bridges) == len(loops) - 1 + 5
        chains = [(a, b, a) for a, b in bridges]
        chains += [(a, b, a) for loop in loops for a, b in zip(loop, np.roll(loop, 1), strict=True)]
        assert not components(np.array(chains), len(problem.fixed)).any()


class TestSheet:
    @pytest.mark.parametrize("seed", range(5))
    def test_cuts_make_disks(self, seed):
        """Random cuts between boundary vertices: each adds one piece, and all pieces are disks."""
        rng = np.random.default_rng(seed)
        V, F = without_inner_vertices(rng, 20) if seed % 2 else disk(3)
        sheet = Sheet(F, len(V))
        place = (V @ np.array([1, 1j])).tolist()
        cuts = 0
        for pieces in range(2, 8):
            loop = max(sheet.loops(), key=len)
            i, j = sorted(rng.choice(len(loop), 2, replace=False).tolist())
            if j - i < 2 or j - i > len(loop) - 2:
                continue
            cuts += 1
            before = len(sheet.loops())
            way = walk(sheet, place, loop[i], loop[j])
            assert not any(sheet.is_fixed(copy) for copy in way[1:-1])
            right = sheet.cut(way)
            place += [place[copy] for copy in way]
            assert len(place) == len(sheet.vertex)
            assert len(right) == len(way)
            rows = sheet.rows()
            kinds = edges(rows, len(sheet.vertex))
            assert not kinds.inconsistent.size
            assert not kinds.nonmanifold.size
            assert len(sheet.loops()) == before + 1 <= pieces
            assert {tuple(edge) for edge in kinds.boundary.tolist()} == set(sheet.following.items())
            euler = len(np.unique(rows)) - len(kinds.interior) - len(kinds.boundary) + len(rows)
            assert euler == len(np.unique(components(rows, len(sheet.vertex))[np.unique(rows)])) == before + 1
        assert cuts >= 3

    def test_links_of_vertices_list_their_triangles(self):
        V, F = disk(2)
        mesh = HalfEdges(F)
        for vertex in range(len(V)):
            around = sorted(tuple(sorted((vertex, a, b))) for a, b in mesh.link(vertex))
            assert around == sorted(tuple(sorted(row)) for row in F.tolist() if vertex in row)


def test_the_optimal_triangulation_is_optimal():
    """Compare with all triangulations of a polygon with seven corners."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        points = random_polygon(rng, 7, 9) @ [1, 1j]

        def worth(a, b, c, points=points):
            return quality(points[a], points[b], points[c])

        best = triangulate_best(list(range(7)), worth)
        assert min(worth(*t) for t in best) == max(min(worth(*t) for t in cut) for cut in cuts(0, 6))


def cuts(i, j):
    """Yield all triangulations of the polygon of corners i … j."""
    if j - i < 2:
        return [[]]
    return [[*a, (i, k, j), *b] for k in range(i + 1, j) for a in cuts(i, k) for b in cuts(k, j)]


def test_shapes_have_the_exact_sign():
    step = 2.0**-52
    p, q = complex(1, 1), complex(1 + 1e3 * step, 1 + 1e3 * step)
    middle = complex(1 + 500 * step, 1 + 500 * step)
    assert quality(p, q, middle) == 0
    assert quality(p, q, middle + 1j * step) > 0 > quality(p, q, middle - 1j * step)


def test_loops_beside_each_other_are_not_simple():
    V, F = disk(4)
    F = F[1:]
    outer, inner = sorted(boundary_loops(F, len(V)), key=len, reverse=True)
    beside = np.concatenate([V[outer], V[inner] * [-1, 1] + [3, 0]])
    problem = Problem(V, F, np.concatenate([outer, inner]), beside)
    assert not is_simple(problem)
    assert injective_map(problem.V, F, problem.fixed, beside, refine=True).status is Status.IMPOSSIBLE
