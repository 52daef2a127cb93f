"""Curves on which vertices slide: exact positions, lengths, directions, corners."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import ellipe

from quasiharmonic.geometry.curves import Arc, Curve
from quasiharmonic.io import MeshFileError
from quasiharmonic.targets import outline, outline_curves

MIXED = [
    [(0.1, 0), (1, 2), (3, 1.3)],
    [(3, 1.3), (4, 0.95), (4, 0.2), (5, 0)],
    [(5, 0), (0.1, 0)],
]


def complex_of(points):
    return points @ (1, 1j)


def bezier(control, t):
    """Evaluate De Casteljau's construction in rational numbers."""
    points = [tuple(map(Fraction, row)) for row in control]
    t = Fraction(t)
    while len(points) > 1:
        points = [tuple((1 - t) * a + t * b for a, b in zip(p, q, strict=True)) for p, q in itertools.pairwise(points)]
    return points[0]


@pytest.mark.parametrize("control", MIXED)
def test_positions_are_rounded_once(control, rng):
    control = np.array(control) * 0.7 + 0.1
    curve = Curve([control])
    s = rng.random(300) * curve.length
    piece, t = curve.locate(s)
    assert not piece.any()
    for place, parameter in zip(curve.position(s), t, strict=True):
        for got, wanted in zip(place, bezier(control.tolist(), float(parameter)), strict=True):
            assert abs(Fraction(float(got)) - wanted) <= Fraction(np.spacing(abs(got))) * Fraction(501, 1000)


@pytest.mark.parametrize(("radius", "centre"), [(1.0, (0.0, 0.0)), (0.3, (0.0, 0.0)), (3.7, (12.5, -4.0))])
def test_positions_on_a_circle_have_one_rounding_error(radius, centre, rng):
    curve = Curve.circle(radius, centre)
    assert curve.closed
    assert curve.corners(0.0).tolist() == [0]
    assert curve.corners(1e-6).size == 0
    assert curve.length == pytest.approx(2 * np.pi * radius)
    x, y, r = (Fraction(c) for c in (*centre, radius))
    for place in curve.position(rng.random(500) * curve.length).tolist():
        u, v = map(Fraction, place)
        # A rounding error is at most half an ulp per coordinate.
        allowed = r * (Fraction(np.spacing(abs(place[0]))) + Fraction(np.spacing(abs(place[1])))) * Fraction(51, 100)
        assert abs((u - x) ** 2 + (v - y) ** 2 - r**2) <= 2 * allowed


def test_lengths_agree_with_other_formulas():
    ellipse = Curve([Arc((1, 2), (5, 0), (0, 0.3), 0, 2 * np.pi)])
    assert ellipse.length == pytest.approx(4 * 5 * ellipe(1 - (0.3 / 5) ** 2), rel=1e-7)
    control = np.array(MIXED[1])

    def speed(t):
        d = 3 * np.diff(control, axis=0)
        return np.linalg.norm((1 - t) ** 2 * d[0] + 2 * t * (1 - t) * d[1] + t**2 * d[2])

    assert Curve([control]).length == pytest.approx(quad(speed, 0, 1)[0], rel=1e-12)


def test_a_step_has_the_given_length_direction_and_curvature(rng):
    curve = Curve(MIXED)
    joints = np.append(curve.corners(0.0), curve.length)
    s = rng.random(400) * curve.length
    s = s[np.abs(s[:, None] - joints).min(axis=1) > 0.01]
    h = 1e-4

    def z(step):
        return complex_of(curve.position(curve.advance(s, np.full(s.size, step))))

    tangent, curvature = curve.frame(s, np.ones(s.size, dtype=bool))
    assert np.abs(np.abs(tangent) - 1).max() < 1e-14
    np.testing.assert_allclose((z(h) - z(-h)) / (2 * h), tangent, atol=1e-6)
    np.testing.assert_allclose((z(h) - 2 * z(0) + z(-h)) / h**2, 1j * tangent * curvature, atol=1e-4)


def test_two_directions_at_a_joint():
    square = Curve.polygon([(0, 0), (2, 0), (2, 2), (0, 2)])
    s = np.array([0.0, 2.0, 3.0])
    np.testing.assert_allclose(square.frame(s, np.array([True] * 3))[0], [1, 1j, 1j])
    np.testing.assert_allclose(square.frame(s, np.array([False] * 3))[0], [-1j, 1, 1j])
    line = Curve.polyline([(0, 0), (1, 0), (1, 1)])
    assert not line.closed
    assert line.corners(20.0).tolist() == [0, 1, 2]
    assert line.has_ended(np.array([0.0, 0.0, 2.0]), np.array([True, False, True])).tolist() == [False, True, True]


def test_closed_curves_continue_and_open_ones_end():
    square = Curve.polygon([(0, 0), (2, 0), (2, 2), (0, 2)])
    s, step = np.array([0.0, 1.5, 7.5, 2.0, 2.0]), np.array([-3.0, 0.4, 1.0, 0.0, 2.5])
    assert square.advance(s, step) == pytest.approx([5, 1.9, 0.5, 2, 4.5])
    assert square.advance(s, step, stop=True).tolist() == [6, 1.9, 0, 2, 4]
    line = Curve.polyline([(0, 0), (1, 0), (1, 1)])
    assert line.advance(np.array([0.5, 0.5, 1.5]), np.array([-3.0, 1.0, 1.0])).tolist() == [0, 1.5, 2]
    assert line.advance(np.array([0.5, 0.5, 1.5]), np.array([-3.0, 1.0, 1.0]), stop=True).tolist() == [0, 1, 2]


def test_coincident_handles_have_a_direction():
    curve = Curve([[(0, 0), (0, 0), (1, 1), (2, 0)], [(2, 0), (2, 0), (2, 0), (0, 0)]])
    tangent, curvature = curve.frame(np.array([0.0]), np.array([True]))
    np.testing.assert_allclose(tangent, np.exp(0.25j * np.pi), atol=1e-4)
    assert curvature[0] == 0
    assert curve.corners(20.0).size == 2


@pytest.mark.slow
def test_nearest_points(rng):
    for curve in (Curve(MIXED), Curve.circle(0.7, (3, 1)), *outline_curves("letter:R")):
        s = np.sort(rng.random(300)) * curve.length
        found, away = curve.nearest(curve.position(s))
        np.testing.assert_allclose(found, s, atol=1e-13 * curve.length)
        assert away.max() < 1e-15 * 10
        # Joints are exact.
        joints = curve.corners(0.0)
        assert curve.nearest(curve.position(joints))[0].tolist() == joints.tolist()
        # Slightly off the curve, along its normal.
        tangent, _ = curve.frame(s, np.ones(s.size, dtype=bool))
        beside = complex_of(curve.position(s)) + 1e-4j * tangent
        assert curve.nearest(np.stack([beside.real, beside.imag], axis=1))[1] == pytest.approx(1e-4, rel=0.1)


def test_a_transformed_curve_has_the_transformed_points():
    curve = Curve([*MIXED[:2], Arc((2.55, 0), (2.45, 0), (0, -1), 0, np.pi)])
    assert curve.closed
    matrix, shift = np.array([(0.5, -0.2), (0.3, 2.0)]), np.array([3.0, -1.0])
    there = curve.transform(matrix, shift)
    places = curve.position(np.linspace(0, curve.length, 500)) @ matrix.T + shift
    assert there.nearest(places)[1].max() < 1e-14
    assert curve.transform(10).length == pytest.approx(10 * curve.length)


@pytest.mark.parametrize(
    ("pieces", "message"),
    [
        ([[(0, 0), ("a", 0)]], "piece 0 of the curve must contain real numbers"),
        ([[(0, 0), (1,)]], "piece 0 of the curve is not an array: its rows differ in length"),
        ([], "at least one piece"),
        ([[(0, 0)]], r"piece 0 of the curve must have shape \(2, 2\), \(3, 2\) or \(4, 2\), not \(1, 2\)"),
        ([[(0, 0), (1, 0)], [(1, 0), (np.nan, 1)]], "piece 1 of the curve is not finite"),
        ([[(0, 0), (1, 0)], [(2, 0), (2, 1)]], "pieces 0 and 1 of the curve .* do not meet"),
        ([[(1, 1), (1, 1)]], "is outside the supported range"),
        ([[(0, 0), (1e200, 0)]], "is outside the supported range"),
        ([[(0, 0), (1e-200, 0)]], "is outside the supported range"),
        ([Arc((0, 0), (1, 0, 0), (0, 1), 0, 1)], "an arc has a centre and two axes"),
        ([Arc((0, 0), (1, 0), (0, 1), 0, np.inf)], "piece 0 of the curve is not finite"),
    ],
)
def test_malformed_curves(pieces, message):
    with pytest.raises(ValueError, match=message):
        Curve(pieces)


def test_malformed_polygons():
    with pytest.raises(ValueError, match=r"shape \(k, 2\) with k at least 3, not \(2, 2\)"):
        Curve.polygon([(0, 0), (1, 0)])
    with pytest.raises(ValueError, match="not finite at row 1"):
        Curve.polyline([(0, 0), (np.nan, 0)])


@pytest.mark.slow
@pytest.mark.parametrize("text", ["letter:G", "letter:R", "letter:@", "disk", "ellipse:2x1", "ring:0.5", "star:5"])
def test_outlines_lie_on_their_curves(text):
    curves = outline_curves(text)
    for contour in outline(text):
        away, curve = min(((c.nearest(contour)[1].max(), c) for c in curves), key=lambda pair: pair[0])
        assert away < 3e-15
        # Between its vertices it deviates by the sagitta of a chord.
        middle = (contour + np.roll(contour, -1, axis=0)) / 2
        assert curve.nearest(middle)[1].max() < 1.01e-6 * max(1, np.ptp(contour))


LONG_WORDS = [
    pytest.param(text, marks=pytest.mark.nightly) for text in ("LOVE", "mesh", "OOO", "LEEL", "SCAF", "&@", "Wgy")
]


@pytest.mark.slow
@pytest.mark.parametrize("text", ["QH", "G", "R8", *LONG_WORDS])
def test_a_word_follows_the_curves_of_its_letters(text):
    pytest.importorskip("shapely")
    contours, curves = outline(f"word:{text}"), outline_curves(f"word:{text}")
    assert len(curves) == len(contours)
    for contour in contours:
        away, curve = min(((c.nearest(contour)[1].max(), c) for c in curves), key=lambda pair: pair[0])
        # Where letters meet, their chords intersect slightly off their curves.
        assert away < 3e-6
        sides = np.hypot(*np.diff(contour, axis=0, append=contour[:1]).T)
        assert curve.length == pytest.approx(sides.sum(), rel=1e-4)
    # Curves of a letter are unchanged: the first letter has the same position as alone.
    s = np.concatenate([np.linspace(0, curve.length, 2000) for curve in curves])
    points = np.concatenate([c.position(part) for c, part in zip(curves, np.split(s, len(curves)), strict=True)])
    first = outline_curves(f"letter:{text[0]}")
    away = np.min([one.nearest(points)[1] for one in first], axis=0)
    left = points[:, 0] < max(one.position(np.linspace(0, one.length, 999))[:, 0].max() for one in first) - 0.2
    assert left.any()
    assert away[left].max() < 1e-14


@pytest.mark.slow
def test_letters_of_a_word_meet_where_their_curves_do():
    pytest.importorskip("shapely")
    (outer,) = sorted(outline_curves("word:OO"), key=lambda curve: -curve.length)[:1]
    corners = outer.position(outer.corners(20.0))
    assert len(corners) == 2
    (ring,) = sorted(outline_curves("letter:O"), key=lambda curve: -curve.length)[:1]
    assert ring.nearest(corners)[1].max() < 1e-15
    # The second letter is the first one, translated.
    right = [c.position(c.corners(0.0))[:, 0].max() for c in (outer, ring)]
    assert ring.nearest(corners - (right[0] - right[1], 0))[1].max() < 1e-14


@pytest.mark.slow
@pytest.mark.parametrize("curve", [Curve(MIXED), Curve.circle(2.0), Curve([*MIXED[:2]])])
def test_a_section_is_a_part_of_its_curve(curve, rng):
    for start, end in np.sort(rng.random((20, 2)), axis=1) * curve.length:
        part = Curve(curve.section(start, end))
        assert part.length == pytest.approx(end - start, rel=1e-9)
        t = np.linspace(0, 1, 40)
        there = curve.position(start + t * (end - start))
        np.testing.assert_allclose(part.position(t * part.length), there, rtol=0, atol=1e-12)
        if curve.closed:
            rest = Curve(curve.section(end, start))
            assert rest.length == pytest.approx(curve.length - end + start, rel=1e-9)
            np.testing.assert_allclose(rest.position(np.zeros(1)), curve.position(np.array([end])), atol=1e-12)


@pytest.mark.parametrize(
    ("control", "tips"),
    [
        # It has a cusp in the middle; the same rotated, translated and scaled.
        ([(0, 0), (1, 1), (0, 1), (1, 0)], [(0.5, 0.75)]),
        (np.array([(0, 0), (1, 1), (0, 1), (1, 0)]) @ [(0.6, 0.8), (-0.8, 0.6)] * 0.3 + 7, None),
        # It goes forward and back along one line.
        ([(0, 0), (2, 0), (0.5, 0)], [(8 / 7, 0)]),
        ([(0, 0), (3, 3), (-2, -2), (1, 1)], None),
    ],
)
def test_a_cusp_is_a_corner(control, tips):
    curve = Curve([control])
    found = curve.position(curve.corners(20.0)[1:-1])
    if tips is not None:
        np.testing.assert_allclose(found, tips, rtol=0, atol=1e-15)
    assert len(found) == (2 if len(control) == 4 and np.linalg.matrix_rank(np.diff(control, axis=0)) == 1 else 1)
    # It has the length of many chords and passes through the same points.
    t = np.linspace(0, 1, 20001)
    rows = [np.outer(1 - t, a) + np.outer(t, b) for a, b in itertools.pairwise(np.array(control, dtype=float))]
    while len(rows) > 1:
        rows = [(1 - t)[:, None] * a + t[:, None] * b for a, b in itertools.pairwise(rows)]
    points = rows[0]
    assert curve.length == pytest.approx(np.hypot(*np.diff(points, axis=0).T).sum(), rel=1e-6)
    assert curve.nearest(points[::50])[1].max() < 1e-13
    # Vertices are fixed there, and none slides past.
    s = curve.corners(20.0)[1]
    before, after = (curve.frame(np.array([s]), np.array([forward]))[0][0] for forward in (False, True))
    assert before == pytest.approx(-after, abs=1e-4)


def test_handles_at_the_ends_make_no_corner():
    curve = Curve([[(0, 0), (0, 0), (1, 1), (2, 0)], [(2, 0), (3, -1), (4, -1), (4, -1)]])
    assert curve.corners(20.0).tolist() == [0, curve.length]


def test_sides_lie_between_corners():
    square = Curve.polygon([(0, 0), (2, 0), (2, 1), (0, 1)])
    sides = square.sides(20.0)
    assert [side.position(np.array([0.0, side.length])).tolist() for side in sides] == [
        [[0, 0], [2, 0]],
        [[2, 0], [2, 1]],
        [[2, 1], [0, 1]],
        [[0, 1], [0, 0]],
    ]
    assert not any(side.closed for side in sides)
    (whole,) = Curve.circle().sides(20.0)
    assert whole.closed
    drop = Curve([[(0, 0), (3, 2), (-3, 2), (0, 0)]])
    (around,) = drop.sides(20.0)
    assert around.length == pytest.approx(drop.length)
    half = Curve.polyline([(0, 0), (1, 0), (1, 1)])
    assert [side.length for side in half.sides(20.0)] == [1, 1]
    # An arc is split only to compute its length, which adds no corner.
    arch = Curve([Arc((0, 0), (1, 0), (0, 1), 0, np.pi), [(-1, 0), (1, 0)]])
    assert [side.corners(0.0).size for side in arch.sides(20.0)] == [2, 2]


def test_a_drawing_keeps_its_arcs(tmp_path):
    path = tmp_path / "drawing.svg"
    path.write_text(
        '<svg xmlns="http://www.w3.org/2000/svg"><g transform="rotate(30) scale(2)">'
        '<path d="M-3,0 A3,3 0 0 1 3,0 L3,5 Q0,7 -3,5"/><circle cx="0" cy="1" r="0.5"/></g></svg>'
    )
    arch, circle = sorted(outline_curves(path), key=lambda curve: -curve.length)
    turn = np.exp(-1j * np.pi / 6)  # the y-axis points up here
    z = complex_of(circle.position(np.linspace(0, circle.length, 999))) / turn
    assert np.abs(np.abs(z + 2j) - 1).max() < 1e-15
    z = complex_of(arch.position(np.linspace(0, arch.length, 999))) / turn
    assert np.abs(np.abs(z[z.imag > 1e-9]) - 6).max() < 1e-14
    # There is no corner where the arc meets the sides; the last side is implicit and closes the outline.
    assert arch.closed
    assert arch.corners(20.0).size == 2


def test_invalid_drawings(tmp_path):
    path = tmp_path / "drawing.svg"
    path.write_text('<svg xmlns="http://www.w3.org/2000/svg"><circle r="0"/></svg>')
    with pytest.raises(MeshFileError, match="has no path or shape"):
        outline_curves(path)
