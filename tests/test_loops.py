"""Fast floating-point tests of loops and triangles, against rational arithmetic."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from quasiharmonic import certify
from quasiharmonic.geometry.exact import certificate
from quasiharmonic.geometry.exact.loops import (
    LoopEdges,
    check_loops,
    contacts,
    doubtful_pairs,
    join_items,
    simple_loops,
)
from quasiharmonic.geometry.exact.predicates import SegmentRelation
from quasiharmonic.geometry.exact.triangles import sure_signs, triangle_signs
from quasiharmonic.geometry.mesh.topology import boundary_loops, components
from shared.exact import exact_orientation, exact_relation
from shared.examples import examples
from shared.sheets import SQUARE, ring, spiral, square, together

lattice = st.integers(-2, 2).map(float)
# Points near a line through the origin, one unit in the last place beside it.
near = st.builds(lambda k, ulps: float(k / 8 * (1 + ulps * 2.0**-52)), st.integers(-8, 8), st.integers(-1, 1))
tiny = st.builds(lambda k, exponent: float(np.ldexp(k, exponent)), st.integers(-3, 3), st.sampled_from([-1074, 0, 900]))
coordinates = pytest.mark.parametrize("number", [lattice, near, tiny], ids=["lattice", "near", "tiny"])


def simple(places):
    """Test in rationals whether a closed polygon meets itself only where one edge ends and the next begins."""
    k = len(places)
    ends = [(places[i], places[(i + 1) % k]) for i in range(k)]
    for i, j in combinations(range(k), 2):
        relation = exact_relation(*ends[i], *ends[j])
        joined = j == i + 1 or (i, j) == (0, k - 1)
        if relation == SegmentRelation.OVERLAPPING or (relation != SegmentRelation.DISJOINT and not joined):
            return False
    return all(tuple(p) != tuple(q) for p, q in ends)


@pytest.mark.long
@coordinates
def test_simple_loops(number):
    @given(st.lists(st.lists(st.tuples(number, number), min_size=3, max_size=9), min_size=1, max_size=3))
    @examples(25)
    @example([[(0.0, 0.0), (2.0, 0.0), (1.0, 0.0)]])  # edges that overlap and meet no other
    def check(polygons):
        loops = np.split(np.arange(sum(map(len, polygons))), np.cumsum([len(one) for one in polygons])[:-1])
        found = simple_loops(loops, np.concatenate([np.array(one) for one in polygons]))
        assert found.tolist() == [simple(one) for one in polygons]

    check()


@pytest.mark.slow
@coordinates
def test_contacts_agree_with_exact_arithmetic(number):
    @given(
        st.lists(st.tuples(number, number), min_size=4, max_size=7),
        st.lists(st.tuples(st.integers(0, 3), st.integers(0, 6)), min_size=2, max_size=8),
    )
    @examples(25)
    def check(places, ends):
        ends = [(i, j % len(places)) for i, j in ends]
        expected = {}
        for a, b in combinations(range(len(ends)), 2):
            relation = exact_relation(*(places[i] for i in (*ends[a], *ends[b])))
            joined = bool(set(ends[a]) & set(ends[b]))
            if relation == SegmentRelation.OVERLAPPING or (relation != SegmentRelation.DISJOINT and not joined):
                expected[a, b] = relation
        found = contacts(np.array(places), np.array(ends), 1000)
        pairs = [tuple(pair) for pair in found.pairs.tolist()]
        assert dict(zip(pairs, found.relation.tolist(), strict=True)) == expected
        assert found.complete
        assert len(pairs) == len(expected)

    check()


@pytest.mark.slow
@coordinates
def test_signs_of_triangles(number):
    @given(st.lists(st.tuples(number, number), min_size=3, max_size=6), st.data())
    @examples(25)
    def check(places, data):
        corner = st.integers(0, len(places) - 1)
        F = np.array(data.draw(st.lists(st.tuples(corner, corner, corner), min_size=1, max_size=9)))
        sign, nonfinite = triangle_signs(F, np.array(places))
        assert sign.tolist() == [exact_orientation(*(places[i] for i in corners)) for corners in F.tolist()]
        assert not nonfinite.size
        assert sign.dtype == np.int8

    check()


def test_floating_point_decides_all_triangles_on_a_lattice(rng):
    places = rng.integers(-4, 5, (30, 2)).astype(float)
    F = rng.integers(0, len(places), (200, 3))
    expected = [exact_orientation(*places[corners]) for corners in F]
    signs = np.empty(len(F), dtype=np.int8)
    assert sure_signs(F, places, signs) == expected.count(0)
    assert signs.tolist() == expected


def test_floating_point_decides_all_pairs_of_segments_on_a_lattice(rng, monkeypatch):
    """Their determinants are small integers. So the pairs to examine are the pairs that meet."""
    monkeypatch.setattr("quasiharmonic.geometry.exact.box_pairs.PAIR_CHUNK", 50)

    def may_meet(i, j):
        ends = [places[k] for k in (tails[i], heads[i], tails[j], heads[j])]
        shared = [(tails[i], tails[j]), (tails[i], heads[j]), (heads[i], tails[j]), (heads[i], heads[j])]
        shared = sum(one == other for one, other in shared)
        relation = exact_relation(*ends)
        if shared == 1:
            zero = (ends[0] == ends[1]).all() or (ends[2] == ends[3]).all()
            return zero or relation == SegmentRelation.OVERLAPPING
        return shared > 1 or relation != SegmentRelation.DISJOINT

    for _ in range(4):
        places = rng.integers(-4, 5, (40, 2)).astype(float)
        tails, heads = rng.integers(0, len(places), (2, 60))
        starts = np.array([0, 4, 4, 20, 60], dtype=np.int64)
        group = np.searchsorted(starts, np.arange(60), side="right")
        expected = [(i, j) for i, j in combinations(range(60), 2) if group[i] == group[j] and may_meet(i, j)]
        pairs = np.full((len(expected), 2), -1, dtype=np.int64)
        assert doubtful_pairs(places, tails, heads, starts, pairs) == len(expected)
        assert pairs.tolist() == [list(pair) for pair in expected]
        assert doubtful_pairs(places, tails, heads, starts, pairs[1:]) == -1


@pytest.mark.slow
def test_a_loop_with_more_uncertain_pairs_than_edges():
    """All vertices at one point, on one line, and beside a simple loop."""
    around = np.exp(2j * np.pi * np.arange(400) / 400)
    circle = np.stack([around.real, around.imag], axis=1)
    line = np.stack([np.arange(400) % 7, np.arange(400) % 7], axis=1) / 7
    places = np.concatenate([circle, np.ones((400, 2)), line, circle / 3])
    loops = np.split(np.arange(1600), [400, 800, 1200])
    assert simple_loops(loops, places).tolist() == [True, False, False, True]
    ends = np.stack([np.arange(400, 799), np.arange(401, 800)], axis=1)
    found = contacts(places, ends, 100)
    assert len(found.pairs) == 100
    assert not found.complete


@pytest.mark.slow
@pytest.mark.parametrize("size", [3, 30])
def test_contacts_in_several_portions_up_to_a_limit(size, rng, monkeypatch):
    """On a small lattice there are more uncertain pairs than segments, on a large one fewer."""
    monkeypatch.setattr("quasiharmonic.geometry.exact.box_pairs.PAIR_CHUNK", 50)
    for _ in range(3):
        tails = rng.integers(0, size, (40, 2))
        places = np.concatenate([tails, tails + rng.integers(-3, 4, (40, 2))]).astype(float)
        ends = np.stack([np.arange(40), np.arange(40, 80)], axis=1)
        pairs = list(combinations(range(40), 2))
        relation = {pair: exact_relation(*places[ends[list(pair)]].reshape(4, 2)) for pair in pairs}
        expected = {pair: value for pair, value in relation.items() if value != SegmentRelation.DISJOINT}
        for limit in (0, 1, len(expected) - 1, len(expected), len(expected) + 1):
            found = contacts(places, ends, limit)
            pairs = [tuple(pair) for pair in found.pairs.tolist()]
            assert len(set(pairs)) == len(pairs) == min(limit, len(expected))
            assert found.relation.tolist() == [expected[pair] for pair in pairs]
            assert found.complete == (len(expected) <= limit)
            assert found.pairs.dtype == np.int64
            assert found.relation.dtype == np.int8


@pytest.mark.slow
def test_simple_loops_in_several_portions(rng, monkeypatch):
    """Many loops, and one of them may have all the contacts of the first portion."""
    monkeypatch.setattr("quasiharmonic.geometry.exact.box_pairs.PAIR_CHUNK", 20)
    angle = np.arange(40) * np.pi / 20
    circle = np.round(99 * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    seen = set()
    for count in (1, 6):
        for kind in range(4):
            polygons = [rng.integers(0, 4, (int(rng.integers(3, 7)), 2)).astype(float) for _ in range(count)]
            # One with 40 edges, simple or not.
            polygons.insert(kind, circle if kind % 2 else rng.integers(0, 9, (40, 2)).astype(float))
            order = rng.permutation(sum(map(len, polygons)))
            places = np.empty((order.size, 2))
            places[order] = np.concatenate(polygons)
            found = simple_loops(np.split(order, np.cumsum([len(one) for one in polygons])[:-1]), places)
            assert found.dtype == np.bool_
            assert found.tolist() == [simple(one.tolist()) for one in polygons]
            seen |= set(found.tolist())
    assert seen == {True, False}


def test_missing_vertices():
    with pytest.raises(ValueError, match=r"F refers to vertex 7, but there are only vertices 0 … 3"):
        certify([[0, 1, 2], [0, 2, 7]], np.eye(4, 2))
    with pytest.raises(ValueError, match=r"F refers to vertex -1"):
        triangle_signs(np.array([[0, 1, -1]]), np.eye(4, 2))
    assert sure_signs(np.array([[0, 1, -1]]), np.eye(4, 2), np.zeros(1, dtype=np.int8)) == -1
    with pytest.raises(ValueError, match=r"F refers to vertices 5, 9, but there are only vertices 0 … 3"):
        boundary_loops([[0, 1, 2], [0, 5, 9]], 4)
    with pytest.raises(ValueError, match=r"refers to node 9"):
        components([[0, 1, 2], [0, 2, 9]], 4)


def test_five_items_are_listed():
    assert join_items([3, "a"]) == "3, a"
    assert join_items(range(5)) == "0, 1, 2, 3, 4"
    assert join_items(range(6)) == "0, 1, 2, 3, 4, …"
    assert join_items(range(4), 3) == "0, 1, 2, …"


def few_maps():
    """Maps by what is wrong with them; those of three strips differ in their positions alone."""
    F, winding = spiral(turns=1.5, pitch=0.5)
    good = spiral(turns=1.5, pitch=1.1)[1]
    corners = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    return {
        "one triangle": (np.array([[0, 1, 2]]), corners[:3]),
        "a strip": (F, good),
        "a strip that meets itself": (F, winding),
        "another strip": (F, good + 1),
        # Its boundary is simple.
        "the first triangle is inverted": (SQUARE, np.array([[0.0, 0], [0.2, 0.8], [1, 1], [0, 1]])),
        "square": (SQUARE, corners),
        "islands that overlap": together(square(0, 0, 2), square(1, 1, 2)),
        "an inner loop outside": (ring()[0], ring()[1] + [[0, 0], [5, 0]] * 12),
        "a ring": ring(),
        "no triangles": (np.empty((0, 3), dtype=np.int64), corners),
    }


def test_certificates_have_arrays_of_the_given_types():
    found = {}
    for name, (T, places) in few_maps().items():
        # A loop may begin at any of its vertices.
        loops = [np.roll(loop, 1) for loop in boundary_loops(T, len(places))]
        found[name] = verdict = certificate.certify(T, places, loops=loops)
        assert verdict.crossings.shape[1] == 4
        assert verdict.uv.dtype == np.float64
        for kind in ("F", "inverted", "degenerate", "nonfinite", "crossings", "multiply_wound"):
            assert getattr(verdict, kind).dtype == np.int64
    bijective = {name for name, verdict in found.items() if verdict.bijective}
    assert bijective == {"one triangle", "a strip", "another strip", "square", "a ring"}


def test_many_loops_are_compared_wherever_they_are():
    rng = np.random.default_rng(3)
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    uv = np.concatenate([square + rng.uniform(0, 60, 2) for _ in range(300)])
    loops = list(np.arange(len(uv)).reshape(-1, 4))
    centers = uv[::4]
    apart = np.abs(centers[:, None] - centers[None]).max(axis=2)
    expected = {(i, j) for i, j in np.argwhere(apart < 1).tolist() if i < j}
    assert expected
    crossings, reasons = check_loops(loops, uv)
    assert {tuple(sorted((a // 4, c // 4))) for a, _, c, _ in crossings.tolist()} == expected
    assert {reason.loops for reason in reasons} == expected
    order = LoopEdges.of(loops, uv).order_by_place()
    assert np.array_equal(np.sort(order), np.arange(len(uv)))
    assert np.array_equal(order.reshape(-1, 4) % 4, np.tile(np.arange(4), (300, 1)))
