from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quasiharmonic.geometry.exact.box_pairs import box_pairs, box_pairs_between, box_pairs_within
from quasiharmonic.geometry.exact.predicates import (
    SegmentRelation,
    orientation,
    orientation_or_nonfinite,
    segment_relation,
    sure_orientation,
    twice_area,
    two_product,
    two_sum,
)
from shared.exact import exact_orientation, exact_relation
from shared.examples import examples


def agrees(a, b, c):
    expected = [exact_orientation(*corners) for corners in zip(a, b, c, strict=True)]
    np.testing.assert_array_equal(orientation(a, b, c), expected)


any_float = st.floats(allow_nan=False, allow_infinity=False)
# Few bits and many magnitudes: products that cancel exactly, and sums that underflow.
sparse_float = st.builds(
    lambda bits, exponent: float(np.ldexp(float(bits), exponent)), st.integers(-9, 9), st.integers(-1074, 1019)
)
lattice = st.integers(-3, 3).map(float)
point_of = {name: st.tuples(x, x) for name, x in (("any", any_float), ("sparse", sparse_float), ("lattice", lattice))}


@pytest.mark.slow
@pytest.mark.parametrize("kind", point_of)
def test_orientation_is_exact_for_all_doubles(kind):
    @given(st.lists(st.tuples(*[point_of[kind]] * 3), min_size=1, max_size=20))
    @examples(40)
    def check(triples):
        agrees(*np.array(triples).transpose(1, 0, 2))

    check()


@pytest.mark.slow
@given(
    st.tuples(any_float, any_float, any_float, any_float),
    st.floats(0, 1),
    st.integers(-2, 2),
    st.integers(-2, 2),
)
@examples(50)
def test_orientation_of_points_close_to_a_line(ends, t, i, j):
    a, b = np.array(ends[:2]) / 2, np.array(ends[2:]) / 2
    c = a * (1 - t) + b * t
    c = c + np.array([i, j]) * np.spacing(c)
    agrees(a[None], b[None], c[None])
    agrees(c[None], a[None], b[None])


@pytest.mark.parametrize("scale", [1.0, 1e-150, 1e150, 1e-161, 1e200, 1e-300, 1e299, 1e-310, 5e-324])
@pytest.mark.parametrize("offset", [0.0, 1e8])
def test_orientation_at_any_scale(rng, scale, offset):
    agrees(*((rng.integers(-3, 4, (3, 400, 2)) + offset) * scale))
    a, b = (rng.standard_normal((2, 400, 2)) + offset) * scale
    t = rng.random((400, 1))
    c = a * (1 - t) + b * t
    agrees(a, b, c)
    agrees(a, b, rng.permutation(c))


@pytest.mark.slow
def test_orientation_where_every_stage_is_needed(rng):
    size = 3000
    exponents = rng.integers(-430, 500, (3, size, 2)) * rng.integers(0, 2, (3, size, 2))
    a, b, c = rng.choice([-1.0, -0.75, 0.0, 1.0], (3, size, 2)) * 2.0**exponents
    agrees(a, b, c)
    # Differences of more than 53 bits on a line through the origin.
    d = rng.standard_normal((size, 2))
    agrees(d, 2.0**30 * d, 2.0**61 * d)
    agrees(2.0**30 * d, 2.0**61 * d, d)
    # The heads of both products are equal, and their tails decide.
    head = 1 + rng.integers(0, 4, (size, 2)) * 2.0**-52
    agrees(head, -head, np.stack([head[:, 1] * 2.0**-60, head[:, 0] * 2.0**-60], axis=1) * 2.0**-300)


def test_products_that_underflow_to_the_wrong_order():
    # The left product is 1.5 - 1.5ε, the right one 1.5 - 1.5·2⁻¹⁰⁰ - ε, in units of the smallest double, and ε is lost
    # in the differences. The left one rounds to 2, the right one to 1, but the right one is larger.
    unit = np.array([2.0**-500, 2.0**-574])
    a, b, c = np.array([[[1.5, 1.5 + 1.5 * 2.0**-50]], [[1 - 2.0**-50, 1.0]], [[0.0, 2.0**-80]]]) * unit
    assert orientation(a, b, c)[0] == exact_orientation(a[0], b[0], c[0]) == -1


def test_triples_over_more_than_130_orders_of_magnitude():
    """They are decided in integers: on a line, and with a determinant of one unit."""
    for far in (2.0**450, 2.0**1000):
        for turn in ([[1, 0], [0, 1]], [[0, 1], [-1, 0]]):
            a, b, c = np.array([[1.0, 1.0], [far, far], [-2 * far, -2 * far]]) @ turn
            agrees([a, b, c], [b, c, b], [c, a, a])
            assert orientation(a, b, c) == 0
            # (far − 1)(−2) − (−1)(2 far − 1) = 1
            a, b, c = np.array([[far, -1], [2 * far, -2], [1, 0]]) @ turn
            assert [int(orientation(*corners)) for corners in ((a, b, c), (b, a, c))] == [1, -1]


def test_a_coordinate_of_one_counts_beside_the_largest_doubles():
    """The line of the other two points meets the y-axis at 2¹⁰²³, and x = 1 decides the side of the first point."""
    high, b, c = 2.0**1023, 2.0**972, 2.0**971
    assert orientation(np.array([1.0, high]), np.array([b, high + b]), np.array([c, high + c])) == 1


def test_orientation_where_rounding_and_underflow_have_equal_bounds(rng):
    a, b = rng.standard_normal((2, 4000, 2)) * 2.0**-504
    t = rng.random((4000, 1))
    agrees(a, b, a * (1 - t) + b * t)


def test_signs_within_the_rounding_error_are_open():
    """The error of the determinant is up to three units, 3 · 2⁻⁵³, of the sum of both products, here 2."""
    origin = np.zeros((3, 2))
    a, b = np.array([[1.0, 1], [1, 1], [1, 1]]), np.array([[1.0, 1 + 3 * 2.0**-52], [1 + 3 * 2.0**-52, 1], [1, 1.5]])
    assert sure_orientation(a, b, origin).tolist() == [0, 0, 1]
    assert orientation(a, b, origin).tolist() == [1, -1, 1]


@pytest.mark.parametrize("scale", [1.0, 1e-310, 1e-162, 1e200, 1.7e308])
def test_signs_that_floating_point_is_sure_of_are_exact(rng, scale):
    a, b, c = rng.uniform(-1, 1, (3, 300, 2)) * scale
    c[:50] = a[:50] / 2 + b[:50] / 2
    c[50:60], c[60:70, 1] = np.nan, -np.inf
    sure, exact = sure_orientation(a, b, c), orientation_or_nonfinite(a, b, c)[0]
    assert sure.dtype == np.int8
    assert not (sure * exact < 0).any()
    assert not sure[exact == 0].any()
    # Products that overflow or underflow leave signs open.
    assert (np.mean(sure[70:] == exact[70:]) > 0.99) == (scale == 1.0)
    np.testing.assert_array_equal(sure_orientation(a[70], b[70:], c[70:]), sure_orientation(a[70:71], b[70:], c[70:]))
    # Settings of the caller do not matter.
    with np.errstate(all="raise"):
        np.testing.assert_array_equal(sure_orientation(a, b, c), sure)
        np.testing.assert_array_equal(orientation_or_nonfinite(a, b, c)[0], exact)
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    assert [int(sure_orientation(*corners[k])) for k in ([0, 1, 2], [2, 0, 1], [0, 2, 1])] == [1, 1, -1]


@pytest.mark.slow
def test_a_hundred_thousand_exactly_collinear_triples(rng):
    x = rng.random((3, 100_000)) + 0.1
    # With a slope of one and no rounding, the points lie on the diagonal, even with inexact differences.
    assert not orientation(*np.stack([x, x], axis=2)).any()
    d = rng.standard_normal((100_000, 2))
    assert not orientation(d, 2 * d, 4 * d).any()


def test_antisymmetry_close_to_a_line(rng):
    a, b = rng.random((2, 2000, 2))
    c = (a + b) / 2
    expected = orientation(a, b, c)
    assert set(expected) == {-1, 0, 1}
    for permuted, parity in (((b, c, a), 1), ((c, a, b), 1), ((b, a, c), -1), ((a, c, b), -1), ((c, b, a), -1)):
        np.testing.assert_array_equal(orientation(*permuted), parity * expected)


def test_shapes_broadcast_and_are_preserved():
    corner = np.array([0.0, 0.0])
    right = np.array([[1.0, 0.0], [2.0, 0.0]])
    third = np.array([[[0.0, 1.0]], [[3.0, 0.0]], [[0.0, -1e-320]]])
    np.testing.assert_array_equal(orientation(corner, right, third), [[1, 1], [0, 0], [-1, -1]])
    np.testing.assert_array_equal(orientation(corner, third, right), [[-1, -1], [0, 0], [1, 1]])
    transposed = np.asfortranarray(np.broadcast_to(third, (3, 2, 2)))
    np.testing.assert_array_equal(orientation(corner, right, transposed), [[1, 1], [0, 0], [-1, -1]])
    assert orientation(corner, [1.0, 0.0], [0.0, 1.0]).shape == ()
    assert orientation(corner, [1.0, 0.0], [2.0, 0.0]) == 0
    assert orientation(np.empty((0, 2)), np.empty((0, 2)), np.empty((0, 2))).shape == (0,)


def test_other_types_are_converted_to_double_precision(rng):
    a, b = rng.random((2, 500, 2)).astype(np.float32)
    c = (a + b) / 2
    agrees(a, b, c)
    far = 2**40
    assert orientation([0, 0], [far, 0], [far, far]) == 1
    assert orientation([0, 0], [far, far + 1], [far - 1, far]) == 1


def test_numbers_that_are_not_finite_are_rejected_or_named():
    a = np.zeros((6, 2))
    b = np.tile([1.0, 0.0], (6, 1))
    c = np.array([[0.0, 1], [np.nan, 1], [0, np.inf], [0, -1], [-np.inf, np.inf], [2, 0]])
    sign, nonfinite = orientation_or_nonfinite(a, b, c)
    np.testing.assert_array_equal(sign, [1, 0, 0, -1, 0, 0])
    np.testing.assert_array_equal(nonfinite, [1, 2, 4])
    for some in ([0, 3], [0, 1]):
        assert orientation_or_nonfinite(a[some], b[some], c[some])[1].dtype == np.int64
    with pytest.raises(ValueError, match=r"triple 1 \(3 in all\)"):
        orientation(a, b, c)


def test_sums_and_products_equal_their_rounded_value_and_error(rng):
    full = np.nextafter(2.0, 1.0) - rng.integers(0, 4, 200) * 2.0**-52
    a = np.concatenate([rng.standard_normal(2000), full]) * 2.0 ** rng.integers(-60, 60, 2200)
    b = rng.permutation(a)
    for (value, error), exact in (
        (two_sum(a, b), [Fraction(x) + Fraction(y) for x, y in zip(a, b, strict=True)]),
        (two_product(a, b), [Fraction(x) * Fraction(y) for x, y in zip(a, b, strict=True)]),
    ):
        assert [Fraction(x) + Fraction(y) for x, y in zip(value, error, strict=True)] == exact
        assert value.tolist() == [float(x) for x in exact]


def test_twice_the_area_has_48_bits_even_if_triangles_are_thin(rng):
    a, b = rng.random((2, 300, 2))
    t = rng.random((300, 1))
    # The third corner is on the line through the other two, or beside it by a few units in the last place, or anywhere.
    c = np.concatenate([(a * (1 - t) + b * t)[:100], (a + 3 * (b - a))[100:200], rng.random((100, 2))])
    c[50:100] = a[50:100]
    found = twice_area(a, b, c)
    exact = []
    for corners in zip(a, b, c, strict=True):
        (ax, ay), (bx, by), (cx, cy) = ([Fraction(float(x)) for x in corner] for corner in corners)
        exact.append((bx - ax) * (cy - ay) - (by - ay) * (cx - ax))
    assert all(abs(Fraction(float(x)) - y) <= abs(y) / 2**48 for x, y in zip(found, exact, strict=True))
    assert not found[50:100].any()
    assert len({x > 0 for x in exact[:50]}) == len({x > 0 for x in exact[200:]}) == 2
    # Many triangles are processed in blocks.
    many = np.resize(np.arange(300), 30_000)
    np.testing.assert_array_equal(twice_area(a[many], b[many], c[many]), found[many])


lattice_segments = st.lists(st.tuples(*[st.tuples(st.integers(0, 4), st.integers(0, 4))] * 4), min_size=1, max_size=30)


@pytest.mark.slow
@given(lattice_segments, st.sampled_from([1.0, 0.1, 1e-200, 1e299, 5e-324]), st.sampled_from([0.0, 1e8]))
@examples(50)
def test_segment_relation_is_exact(segments, scale, offset):
    p, q, r, s = ((np.array(segments) + offset) * scale).transpose(1, 0, 2)
    expected = [exact_relation(*ends) for ends in zip(p, q, r, s, strict=True)]
    found = segment_relation(p, q, r, s)
    assert found.dtype == np.int8
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(segment_relation(s, r, p, q), expected)


def test_segments_that_miss_each_other_by_rounding():
    p, q = np.array([[0.0, 0.0]]), np.array([[3.0, 1.0]])
    r = np.array([[0.3, 0.1]])  # not on pq: neither coordinate equals its decimal value
    away = np.array([[0.0, 5.0]])
    assert segment_relation(p, q, r, away)[0] == exact_relation(p[0], q[0], r[0], away[0]) != SegmentRelation.TOUCHING
    assert segment_relation(p, q, q / 2, away)[0] == SegmentRelation.TOUCHING


@pytest.mark.parametrize(
    ("starts", "least"), [([0, 5, 5, 6, 30, 63], 20), ([0, 4, 8, 12, 16], 5), ([0, 9, 10], 5), ([0, 0], 0), ([0], 0)]
)
def test_box_pairs_within_groups(rng, starts, least):
    starts = np.array(starts)
    lo = rng.random((starts[-1], 2))
    hi = lo + rng.random((starts[-1], 2)) * (0.3 if starts[-1] > 20 else 0.7)
    found = {pair for i, j in box_pairs_within(lo, hi, starts) for pair in zip(i.tolist(), j.tolist(), strict=True)}
    meeting = set()
    for first, last in itertools.pairwise(starts.tolist()):
        for i, j in itertools.combinations(range(first, last), 2):
            if (lo[i] <= hi[j]).all() and (lo[j] <= hi[i]).all():
                meeting.add((i, j))
    assert found == meeting
    assert len(meeting) >= least


@pytest.mark.slow
@pytest.mark.parametrize("chunk", [3, 1 << 17])
def test_box_pairs_are_those_that_intersect(rng, monkeypatch, chunk):
    monkeypatch.setattr("quasiharmonic.geometry.exact.box_pairs.PAIR_CHUNK", chunk)
    for count, dimension in itertools.product((0, 1, 2, 3, 8, 9, 57, 150), (2, 3)):
        lo = rng.integers(0, 20, (count, dimension)).astype(float)
        hi = lo + rng.integers(0, 5, (count, dimension))
        found = [pair for i, j in box_pairs(lo, hi) for pair in zip(i.tolist(), j.tolist(), strict=True)]
        expected = {
            (i, j)
            for i in range(count)
            for j in range(i + 1, count)
            if (lo[i] <= hi[j]).all() and (lo[j] <= hi[i]).all()
        }
        assert len(found) == len(expected)
        assert set(found) == expected


@pytest.mark.slow
@pytest.mark.parametrize("chunk", [3, 1 << 17])
def test_box_pairs_between_two_groups(rng, monkeypatch, chunk):
    monkeypatch.setattr("quasiharmonic.geometry.exact.box_pairs.PAIR_CHUNK", chunk)
    sizes = ((0, 0), (0, 3), (1, 1), (5, 0), (9, 5), (5, 9), (3, 40), (57, 8), (150, 90))
    for (count, other), dimension in itertools.product(sizes, (2, 3)):
        lo, low = (rng.integers(0, 20, (number, dimension)).astype(float) for number in (count, other))
        hi, high = lo + rng.integers(0, 5, lo.shape), low + rng.integers(0, 5, low.shape)
        found = [p for i, j in box_pairs_between(lo, hi, low, high) for p in zip(i.tolist(), j.tolist(), strict=True)]
        meet = (lo[:, None] <= high).all(axis=2) & (low <= hi[:, None]).all(axis=2)
        assert len(found) == meet.sum()
        assert set(found) == set(map(tuple, np.argwhere(meet).tolist()))
