"""Outlines from SVG drawings."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quasiharmonic import targets
from quasiharmonic.targets.outlines import svg
from quasiharmonic.targets.outlines.contours import flatten
from quasiharmonic.targets.outlines.svgpath import parse_path
from shared.drawings import drawing
from shared.examples import examples

AREA = targets.signed_area


@pytest.fixture
def read(tmp_path):
    """Read a drawing from a string."""

    def run(text, **options):
        path = tmp_path / "drawing.svg"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return targets.read_svg(path, **options)

    return run


# --- path data


def points(d):
    """Return the end points of all pieces, subpath by subpath."""
    return [[tuple(pieces[0][0]), *(tuple(piece[-1]) for piece in pieces)] for pieces in parse_path(d)]


@pytest.mark.parametrize(
    ("d", "wanted"),
    [
        ("M1 2L3 4z", [[(1, 2), (3, 4), (1, 2)]]),
        ("m1,2 3,4 5,6", [[(1, 2), (4, 6), (9, 12)]]),
        ("M1 2 3 4 5 6", [[(1, 2), (3, 4), (5, 6)]]),
        ("M0 0H5V7h-2v-3Z", [[(0, 0), (5, 0), (5, 7), (3, 7), (3, 4), (0, 0)]]),
        ("M1 1l1 0zl0 1z", [[(1, 1), (2, 1), (1, 1)], [(1, 1), (1, 2), (1, 1)]]),
        ("M1 1l1 0m5 5l1 1", [[(1, 1), (2, 1)], [(7, 6), (8, 7)]]),
        ("M.5.5-1-1", [[(0.5, 0.5), (-1, -1)]]),
        ("M1e1-2E-1L+3.,4", [[(10, -0.2), (3, 4)]]),
        ("\n M 0 0 \t C 1 1, 2 2 ,3 3 ", [[(0, 0), (3, 3)]]),
        ("M0 0", []),
        ("", []),
    ],
)
def test_path_commands(d, wanted):
    assert points(d) == wanted


def test_curves_and_their_smooth_continuations():
    (pieces,) = parse_path("M0 0C0 1 1 2 2 2S4 1 4 0T5 0 6 0Q7 1 8 0t2 0")
    assert [len(piece) - 1 for piece in pieces] == [3, 3, 2, 2, 2, 2]
    assert pieces[1].tolist() == [[2, 2], [3, 2], [4, 1], [4, 0]]  # (1, 2) reflected in (2, 2)
    assert pieces[2][1].tolist() == [4, 0]  # after a cubic there is no control point to reflect
    assert pieces[3][1].tolist() == [6, 0]
    assert pieces[5][1].tolist() == [9, -1]
    (relative,) = parse_path("M0 0c0 1 1 2 2 2s2 -1 2 -2t1 0 1 0q1 1 2 0t2 0")
    assert all(np.array_equal(a, b) for a, b in zip(pieces, relative, strict=True))


@pytest.mark.parametrize("turn", [0, 30, -75])
@pytest.mark.parametrize(("large", "sweep"), [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_arcs_lie_on_their_ellipse(turn, large, sweep):
    """There are two ellipses through both ends, each with two arcs; the flags choose one."""
    rx, ry, end = 3.0, 1.5, np.array([1.2, 1.7])
    (pieces,) = parse_path(f"M0 0A{rx} {ry} {turn} {large} {sweep} {end[0]} {end[1]}")
    arc = np.concatenate([flatten([piece], 1e-6) for piece in pieces])
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    circle = arc @ np.array([(c, -s), (s, c)]) / (rx, ry)
    # The centre of the circle through the first, middle and last point.
    a, b, d = circle[0], circle[len(circle) // 2], circle[-1]
    centre = np.linalg.solve(2 * np.stack([b - a, d - a]), [b @ b - a @ a, d @ d - a @ a])
    np.testing.assert_allclose(np.linalg.norm(circle - centre, axis=1), 1, rtol=0, atol=2e-7)
    angle = np.unwrap(np.arctan2(*(circle - centre).T[::-1]))
    assert (angle[-1] - angle[0] > 0) == bool(sweep)
    assert (abs(angle[-1] - angle[0]) > np.pi) == bool(large)
    assert arc[-1].tolist() == end.tolist()


def test_unusual_arcs():
    # Radii that are too small grow; without a radius, the arc is a line; an arc to the current point is empty.
    (pieces,) = parse_path("M0 0A1 1 0 0 1 4 0")
    half = np.concatenate([flatten([piece], 1e-6) for piece in pieces])
    assert np.linalg.norm(half - (2, 0), axis=1) == pytest.approx(np.full(len(half), 2), abs=1e-6)
    assert [len(piece) for piece in parse_path("M0 0A0 1 0 0 1 4 0")[0]] == [2]
    assert parse_path("M1 1A1 1 0 0 1 1 1") == []
    # Flags need no separator after them.
    (packed,), (spaced,) = parse_path("M0 0a1 1 0 01.5.5"), parse_path("M0 0 a 1 1 0 0 1 0.5 0.5")
    assert np.array_equal(packed, spaced)


@pytest.mark.parametrize(
    ("d", "message"),
    [
        ("L1 1", "begin with M at character 2"),
        ("1 1", "a command, which is a letter, is missing at character 1"),
        ("M1", "a number is missing at character 3"),
        ("M1 1L2", "a number is missing"),
        ("M1 1z2 2", "a command, which is a letter, is missing"),
        ("M1 1Lx", "a number is missing at character 6 .*'M1 1Lx'"),
        ("M1 1R2 2", "a command, which is a letter, is missing at character 5"),
        ("M0 0A1 1 0 2 0 1 1", "a flag, 0 or 1, is missing"),
        ("M1,,1", "a number is missing"),
        ("M1e999 0L1 1", "a number is too large"),
        ("M0 0ſ1 1 2 2", "a command, which is a letter, is missing"),
    ],
)
def test_invalid_path_data(d, message):
    with pytest.raises(ValueError, match=message):
        parse_path(d)


# --- drawings


@pytest.mark.parametrize(
    ("body", "areas", "points"),
    [
        ('<rect x="1" y="2" width="3" height="4"/>', [12], 4),
        ('<rect width="1in" height="2.54cm"/>', [96**2], 4),
        ('<polygon points="0,0 4,0 4,3"/>', [6], 3),
        ('<polyline points="0 0 4 0 4 3 0 3"/>', [12], 4),
        ('<path d="M0 0h4v3h-4z"/>', [12], 4),
        ('<path d="M0 0h4v3h-4"/>', [12], 4),
        ('<path d="M0 0h9v9h-9zM1 1h2v2h-2zM5 5h3v3h-3z"/>', [81, -9, -4], 4),
        ('<path d="M0 0h9v9h-9zM1 1h5v5h-5zM2 2h2v2h-2z"/>', [81, -25, 4], 4),
        ('<circle r="2" cx="9" cy="9"/>', [4 * np.pi], None),
        ('<ellipse rx="2" ry="1"/>', [2 * np.pi], None),
        ('<rect width="4" height="3" rx="1"/>', [8 + np.pi], None),
        ('<rect width="4" height="3" rx="9" ry="1"/>', [12 - (4 - np.pi) * 2], None),
        ('<g transform="scale(2 3)"><rect width="1" height="1" transform="rotate(33)"/></g>', [6], 4),
        ('<g><g transform="matrix(1 2 3 4 5 6)"><rect width="1" height="1"/></g></g>', [2], 4),
        ('<rect width="1" height="1" transform="skewX(50),skewY(10)"/>', None, 4),
        ('<svg x="5"><rect width="1" height="1"/></svg>', [1], 4),
        ('<g display="none"><circle r="9"/></g><rect width="1" height="1"/>', [1], 4),
        ('<g display=" none "><circle r="9"/></g><rect width="1" height="1"/>', [1], 4),
        ('<circle r="9" visibility="hidden"/><rect width="1" height="1"/>', [1], 4),
        ('<circle r="9" style="visibility: hidden"/><rect width="1" height="1"/>', [1], 4),
        (
            '<style>.a{fill:red;stroke-width:2}</style><rect width="1" height="1" style="fill:blue;x-offset:3"/>',
            [1],
            4,
        ),
        ('<g style="fill:red;display:none"><circle r="9"/></g><rect width="1" height="1"/>', [1], 4),
        ('<defs><circle r="9"/></defs><title>x</title><rect width="1" height="1"><title>y</title></rect>', [1], 4),
        ('<q:rect xmlns:q="urn:x" width="9" height="9"/><rect width="1" height="1"/>', [1], 4),
        ('<path/><rect width="0" height="1"/><circle r="0"/><polygon/><rect width="1" height="1"/>', [1], 4),
    ],
)
def test_shapes(read, body, areas, points):
    contours = read(drawing(body))
    assert areas or points
    if areas:
        assert [AREA(c) for c in targets.nested(contours)] == pytest.approx(areas, rel=1e-5)
        assert [abs(AREA(c)) for c in contours] == pytest.approx(np.abs(areas), rel=1e-5)
    if points:
        assert len(contours[0]) == points


def test_transforms_and_viewbox_apply(read):
    (contour,) = read(drawing('<polygon points="0,0 10,0 0,5" transform="translate(1 2)"/>'))
    assert {tuple(p) for p in contour} == {(1, -2), (11, -2), (1, -7)}


def test_transforms_apply_from_right_to_left(read):
    rect = '<rect width="2" height="1" transform="{}"/>'
    together = rect.format("translate(3,4) rotate(90) scale(2)")
    apart = f'<g transform="translate(3 4)"><g transform="rotate(90)">{rect.format("scale(2)")}</g></g>'
    (one,), (other,) = read(drawing(together)), read(drawing(apart))
    np.testing.assert_allclose(one, other, atol=1e-14)
    assert sorted(map(tuple, one.round(12))) == [(1, -8), (1, -4), (3, -8), (3, -4)]
    (about,) = read(drawing('<rect width="2" height="2" transform="rotate(45 1 1)"/>'))
    assert about.mean(axis=0) == pytest.approx((1, -1))


@pytest.mark.parametrize("tolerance", [1e-2, 1e-4, 1e-6])
def test_tolerance(read, tolerance):
    (contour,) = read(drawing('<circle r="50"/>'), tolerance=tolerance)
    middle = (contour + np.roll(contour, -1, axis=0)) / 2
    assert 0.01 * tolerance < (50 - np.linalg.norm(middle, axis=1).min()) / 100 <= 1.01 * tolerance
    assert np.linalg.norm(contour, axis=1) == pytest.approx(np.full(len(contour), 50), rel=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not well-formed XML"),
        ("hello", "not well-formed XML: .* at line 1"),
        ("<html></html>", "the root element is 'html' at line 1"),
        ('<svg xmlns="urn:other"/>', "not an SVG drawing"),
        (drawing("<g>"), "not well-formed XML: mismatched tag"),
        (drawing(""), "has no path or shape"),
        (drawing('<path d="M0 0L1 1"/>'), "encloses an area"),
        (drawing('<path d="M1 1C1 1 1 1 1 1"/>'), "encloses an area"),
        (drawing('<path d="M0 0C1e-320 0 0 1e-320 0 0"/>'), "encloses an area"),
        (drawing("\n\n<text>G</text>"), "the outline of a <text> is not supported at line 3; turn the text into paths"),
        (drawing('<use href="#a"/>'), "the outline of a <use> is not supported"),
        (drawing('\n<path d="M0 0L1"/>'), "<path>: path data: a number is missing at character 7 .* at line 2"),
        (drawing('<rect width="-1" height="1"/>'), "width='-1' is out of range"),
        (drawing('<rect width="50%" height="1"/>'), "width='50%' is not a length"),
        (drawing('<circle r="1em"/>'), "r='1em' is not a length"),
        (drawing('<g transform="spin(3)"/>'), "the transform 'spin\\(3\\)' is not supported"),
        (drawing('<g transform="scale(1,2,3)"/>'), "is not supported"),
        (drawing('<g transform="scale(1"/>'), "is not supported"),
        (drawing('<g transform="scale(inf)"/>'), "is not supported"),
        (drawing('<svg viewBox="0 0 1 1"/>'), "an inner <svg> with a viewBox"),
        (drawing('<rect width="1e300" height="1e300" transform="scale(1e300)"/>'), "too large|encloses|infin"),
        (
            drawing('<g style="fill:red; transform : rotate(9deg)"/>'),
            "<g>: 'transform' in a style is not supported at line 1",
        ),
        (drawing('<circle style="r:3px" r="1"/>'), "'r' in a style is not supported"),
        (drawing("<style>.a{fill:red;display:none}</style>"), "'display:none' in a style sheet is not supported"),
        (drawing('<path style="d:path(&quot;M0 0&quot;)"/>'), "'d' in a style is not supported"),
        (drawing("<defs><style>.a{fill:red;translate:3px}</style></defs>"), "<style>: 'translate' in a style is not"),
        (drawing('<g transform="scale(2)" transform-origin="3 3"/>'), "<g>: transform-origin is not supported"),
        (drawing('<path d="M0 0L1 1L1 0L0 1z"/>'), "contour 0 of the outline meets itself: .* crosses"),
        (drawing('<rect width="2" height="2"/><circle r="1"/>'), "contours 0 and 1 of the outline meet"),
        (drawing("<g>" * 300 + "</g>" * 300), "nested more than 200 deep"),
        (b"\xff\xfe<\x00", "is UTF-16 text"),
        (b"\x1f\x8b\x08", "compressed by gzip"),
    ],
)
def test_invalid_drawings(read, text, message):
    with pytest.raises(ValueError, match=message):
        read(text)


def test_entity_bombs_and_external_files(read, tmp_path):
    lines = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10 if i else "M0 0"}">' for i in range(12))
    with pytest.raises(ValueError, match="declares the entity 'e0', but entities are not supported at line 1"):
        read(f"<!DOCTYPE svg [{lines}]>" + drawing('<path d="&e11;"/>'))
    (tmp_path / "secret").write_text("M0 0h1v1z")
    declared = f'<!DOCTYPE svg [<!ENTITY x SYSTEM "{(tmp_path / "secret").as_uri()}">]>'
    with pytest.raises(ValueError, match="declares the entity 'x'"):
        read(declared + drawing("<g>&x;</g>"))
    dtd = '<!DOCTYPE svg PUBLIC "-//W3C//DTD SVG 1.1//EN" "http://www.w3.org/Graphics/SVG/1.1/DTD/svg11.dtd">'
    assert len(read(dtd + drawing('<rect width="1" height="1"/>'))) == 1


@pytest.mark.slow
def test_huge_drawings(read, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="more than 1,000,000 points"):
        read(drawing('<path d="M0 0' + "c1 9 9 1 0 0" * 9000 + 'z"/>'), tolerance=1e-7)
    monkeypatch.setattr("quasiharmonic.targets.outlines.svgpath.MAX_POINTS", 1000)
    with pytest.raises(ValueError, match="more than 1,000 pieces"):
        read(drawing('<path d="M0 0' + "h1v1" * 600 + '"/>'))
    monkeypatch.setattr("quasiharmonic.targets.outlines.svg.MAX_BYTES", 1 << 20)
    with pytest.raises(ValueError, match="larger than 1 MiB; simplify"):
        read(drawing(" " * (1 << 20)))
    with pytest.raises(ValueError, match="tolerance must be a fraction"):
        read(drawing(""), tolerance=0)
    with pytest.raises(ValueError, match="there is no such file"):
        targets.read_svg(tmp_path / "none.svg")


@pytest.mark.long
@pytest.mark.parametrize("share", [0.1, pytest.param(1, marks=pytest.mark.nightly)])
@pytest.mark.parametrize(
    ("start", "part", "count", "end", "message"),
    [
        ('<path d="M0 0', "h1v1", 500_010, '"/>', "1,000,000 pieces"),
        ('<path d="M0 0', "c1 1 2 2 3 0", 1_000_010, '"/>', "1,000,000 pieces"),
        ('<path d="M0 0c', "1 1 2 2 3 0 ", 1_000_010, '"/>', "1,000,000 pieces"),
        ('<path d="M0 0', "a9 9 0 015 1", 1_500_000, '"/>', "1,000,000 pieces"),
        ('<path d="M0 0h1v1', "z", 9_000_000, '"/>', "1,000,000 pieces"),
        ("", '<circle r="1"/>', 100_000, "", "1,000,000 pieces"),
        ("", '<path d="M0 0h1v1z"/>', 300_000, "", "1,000,000 pieces"),
        ('<path d="M', " ", 9_000_000, '"/>', "a number is missing"),
        ('<g transform="', "scale(1)", 90_000, ' "/>', "more than 1,000 transforms"),
        ("", "<g/>", 1_000_010, "", "more than 1,?0?00,000 elements"),
    ],
    ids=["lines", "curves", "unlettered", "arcs", "closings", "circles", "paths", "blanks", "transforms", "groups"],
)
def test_excessive_sizes_are_rejected_quickly(read, start, part, count, end, message, share, monkeypatch):
    """With a tenth of the limit and of the size, and as they are."""
    monkeypatch.setattr(svg, "MAX_POINTS", int(share * svg.MAX_POINTS))
    text = drawing(start + int(share * count) * part + end)
    began = time.process_time()
    with pytest.raises(ValueError, match=message):
        read(text)
    # At most two seconds on an idle machine for the whole size; without the limits, minutes.
    assert time.process_time() - began < 20 * share


SAMPLE = drawing(
    '<g transform="rotate(9) scale(2,1)"><path d="M0 0h20v12c-3 4-9 2-12 1S2 13-.5 9.5a9 9 20 01 .5-9z"/>'
    '<rect x="3" y="3" width="4" height="2" rx=".5"/><circle r="1mm" cx="14" cy="6"/></g>'
)


@pytest.mark.long
def test_damaged_drawings_are_read_or_rejected(tmp_path):
    outcomes = {"read": 0, "rejected": 0}

    @examples(100)
    @given(st.lists(st.tuples(st.integers(0, len(SAMPLE)), st.integers(0, 6), st.text(max_size=5)), max_size=4))
    def check(edits):
        text = SAMPLE
        for at, cut, put in edits:
            text = text[:at] + put + text[at + cut :]
        path = tmp_path / "damaged.svg"
        path.write_text(text, encoding="utf-8", errors="replace", newline="")
        try:
            contours = targets.read_svg(path, tolerance=1e-3)
        except ValueError:
            outcomes["rejected"] += 1
            return
        outcomes["read"] += 1
        assert contours
        assert all(np.isfinite(c).all() and len(c) > 2 for c in contours)

    check()
    assert min(outcomes.values()) > 5, outcomes
