"""Islands in the unit square: apart, inside, at one density, not mirrored, none of their triangles inverted."""

from __future__ import annotations

import time
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from quasiharmonic import is_injective, surfaces
from quasiharmonic.apps.atlas.packing import packed
from quasiharmonic.apps.atlas.skyline import laid
from shared.exact import exact_orientation


def area(points, F):
    a, b = points[F[:, 1]] - points[F[:, 0]], points[F[:, 2]] - points[F[:, 0]]
    return float(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() / 2)


def turned(points, degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return points @ [[c, s], [-s, c]]


def check(out, margin):
    """Boxes within the square, and apart by the margin along an axis, without rounding."""
    low, high = np.array([p.min(axis=0) for p in out]), np.array([p.max(axis=0) for p in out])
    assert low.min() >= 0
    assert high.max() <= 1
    for i in range(len(out)):
        near = [
            j
            for j in range(i)
            if (low[i] < high[j] + 2 * margin + 1e-9).all() and (low[j] < high[i] + 2 * margin + 1e-9).all()
        ]
        for j in near:
            gaps = [
                Fraction(a) - Fraction(b)
                for a, b in [*zip(low[i], high[j], strict=True), *zip(low[j], high[i], strict=True)]
            ]
            assert max(gaps) >= Fraction(margin)
            assert max(gaps) > 0


def rectangles(count, seed=0):
    rng = np.random.default_rng(seed)
    V, F = surfaces.grid(2, 2)
    return [turned(V * rng.uniform(0.1, 1, 2), rng.uniform(0, 360)) for _ in range(count)], [F] * count


def areas_of(uv, F):
    return [area(points, rows) for points, rows in zip(uv, F, strict=True)]


@st.composite
def maps(draw):
    """Islands of a few shapes, in many places, sizes and ways around, some mirrored."""
    uv, F = [], []
    for _ in range(draw(st.integers(1, 12))):
        V, rows = draw(st.sampled_from([surfaces.grid(3, 2), surfaces.disk(2), surfaces.random_delaunay(12, 1)]))
        stretch = draw(st.tuples(st.floats(0.05, 20), st.sampled_from([1.0, 0.1, -1.0])))
        move = draw(st.tuples(st.floats(-5, 5), st.floats(-5, 5)))
        uv.append(turned(V[:, :2] * stretch, draw(st.integers(0, 359))) + move)
        F.append(rows)
    surface = draw(st.lists(st.floats(0.01, 100), min_size=len(uv), max_size=len(uv)))
    return uv, F, surface, draw(st.sampled_from([0, 1 / 1024, 0.02]))


@given(maps())
@settings(max_examples=40, deadline=None)
def test_what_is_promised(problem):
    uv, F, surface, margin = problem
    given_to_it = [points.copy() for points in uv]
    out = packed(uv, F, surface, margin=margin)
    assert all(np.array_equal(a, b) for a, b in zip(uv, given_to_it, strict=True))
    assert all(np.array_equal(a, b) for a, b in zip(out, packed(uv, F, surface, margin=margin), strict=True))
    check(out, margin)
    density = [area(p, rows) / s for p, rows, s in zip(out, F, surface, strict=True)]
    np.testing.assert_allclose(density, density[0], rtol=1e-6)
    for before, after, rows in zip(uv, out, F, strict=True):
        # The same shape, turned and scaled: no angle has another sign.
        scale = np.sqrt(area(after, rows) / area(before, rows))
        z = (before - before.mean(axis=0)).view(np.complex128).ravel()
        w = (after - after.mean(axis=0)).view(np.complex128).ravel()
        turn = np.vdot(z, w) / np.vdot(z, z).real
        assert abs(turn) == pytest.approx(scale, rel=1e-6)
        np.testing.assert_allclose(w, turn * z, atol=1e-7)
        signs = [[exact_orientation(*points[row]) for row in rows] for points in (before, after)]
        assert signs[0] == signs[1]


@given(st.lists(st.tuples(st.floats(0, 1.2), st.floats(0, 1.2)), max_size=15))
@settings(deadline=None)
def test_boxes_do_not_overlap(boxes):
    places = laid(boxes)
    if places is None:
        assert boxes
        return
    size = [(h, w) if place.turned else (w, h) for place, (w, h) in zip(places, boxes, strict=True)]
    for i, (one, (w, h)) in enumerate(zip(places, size, strict=True)):
        assert one.x + w <= 1
        assert one.y + h <= 1 + 1e-15
        for other, (w2, h2) in zip(places[:i], size, strict=False):
            apart = max(one.x - other.x - w2, other.x - one.x - w, one.y - other.y - h2, other.y - one.y - h)
            assert apart >= -1e-12


def test_boxes_that_fill_the_square_and_one_more():
    assert laid([(0.5, 0.5)] * 4) == [(0, 0, False), (0.5, 0, False), (0, 0.5, False), (0.5, 0.5, False)]
    assert laid([(0.5, 0.5)] * 5) is None
    assert laid([(1, 0.25), (0.75, 0.5), (0.7, 0.25)])[2] == (0.75, 0.25, True)


def test_a_square_fills_the_square():
    V, F = surfaces.grid(4, 4)
    for degrees in (0, 30, 45, 75, 180):
        (out,) = packed([turned(V, degrees) * 7 + 3], [F], [2.5], margin=0.125)
        np.testing.assert_allclose(out.min(axis=0), 0.0625, atol=1e-9)
        np.testing.assert_allclose(out.max(axis=0), 0.9375, atol=1e-9)


def test_an_island_stays_as_upright_as_its_least_box_lets_it():
    """What is upright stays so, to the last bit but for size; what is turned a little is turned back."""
    V, F = surfaces.grid(4, 4)
    for degrees in (0, 20, -40, 60):
        (out,) = packed([turned(V * [2, 1], degrees)], [F], [1], margin=0)
        side = (out[4] - out[0]) @ [1, 1j]
        back = np.degrees(np.angle(side)) - degrees
        assert min(abs((back - k + 180) % 360 - 180) for k in (0, 90)) <= 45 + 1e-9
        assert np.abs([side.real, side.imag]).min() < 1e-12
    assert np.ptp(packed([V], [F], [1], margin=0)[0][:5, 1]) == 0


@pytest.mark.parametrize("scale", [1e-300, 1e-100, 1e100, 1e300])
def test_any_unit_will_do(scale):
    uv, F = rectangles(6)
    wanted = packed(uv, F, areas_of(uv, F))
    found = packed([points * scale for points in uv], F, np.array(areas_of(uv, F)) * scale)
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)


def test_share_of_the_square():
    """What packing by boxes reaches; a worse way of doing it would fail here."""
    for count, least in ((5, 0.75), (20, 0.8), (100, 0.88)):
        uv, F = rectangles(count)
        assert sum(areas_of(packed(uv, F, areas_of(uv, F), margin=0), F)) > least


@pytest.mark.slow
def test_a_thousand_islands():
    uv, F = rectangles(1000)
    began = time.process_time()
    out = packed(uv, F, areas_of(uv, F), margin=1 / 1024)
    # About one on an idle machine.
    assert time.process_time() - began < 10
    check(out, 1 / 1024)
    assert sum(areas_of(out, F)) > 0.85


def test_islands_without_area_and_with_flips():
    V, F = surfaces.grid(2, 2)
    V = V[:, :2]
    folded = V.copy()
    folded[4] = (2, 2)
    uv = [V, np.zeros((9, 2)), V * [1, 0], folded, V]
    out = packed(uv, [F] * 5, [1, 1, 1, 2, 0], margin=0.01)
    check(out, 0.01)
    assert is_injective(F, out[0])
    assert area(out[1], F) == 0
    np.testing.assert_allclose(area(out[3], F), 2 * area(out[0], F))
    assert is_injective(F, out[4])


def test_nothing_to_pack():
    assert packed([], [], []) == []


def test_triangles_too_thin_for_the_square():
    V, F = np.array([(0, 0), (1, 0), (1 / 3, 1e-22), (0.4, 1.0)]), np.array([(0, 1, 2), (0, 2, 3), (2, 1, 3)])
    assert is_injective(F, V)
    with pytest.raises(ValueError, match="island 1: its triangle 0 would be inverted by rounding in the unit square"):
        packed([V + [(0, 1)] * 4, V], [F, F], [1, 1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"areas": [1]}, "uv has 2 islands, F has 2, and areas has shape"),
        ({"areas": [1, -1]}, "areas must be finite and not negative: check island 1"),
        ({"areas": [1, np.nan]}, "check island 1"),
        ({"margin": -0.1}, "margin must be a fraction of the square's side, at least 0 and less than 1, not -0.1"),
        ({"margin": 0.7}, "2 islands do not fit with a margin of 0.7 of the square's side around each"),
        ({"uv": [np.full((9, 2), np.inf)] * 2}, r"uv\[0\] is not finite at vertices 0, 1"),
        ({"uv": [np.zeros((8, 2))] * 2}, "F refers to vertex 8"),
    ],
)
def test_wrong_calls(change, message):
    V, F = surfaces.grid(2, 2)
    call = {"uv": [V, V], "F": [F, F], "areas": [1, 2], **change}
    with pytest.raises(ValueError, match=message):
        packed(**call)
