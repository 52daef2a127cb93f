"""Outlines by name and from files of points."""

from __future__ import annotations

import re

import numpy as np
import pytest

from quasiharmonic import targets
from shared.drawings import drawing

AREA = targets.signed_area


# --- files of points


@pytest.mark.parametrize(
    ("text", "areas"),
    [
        ("0 0\n4 0\n4 3\n0 3\n", [12]),
        ("0,0\n0,3\n4,3\n4,0", [12]),
        ("x;y\n0;0\n4;0\n4;3\n", [6]),
        (
            "# a frame\n0 0\n# here\n9 0\n9 9 # there\n0 9\n0 0\n\n\n\t1 1\r\n2 1\r\n2 2\r\n\n5 5\n7 5\n7 7\n",
            [81, -2, -0.5],
        ),
        ("1e-3 -2E+1\n+.5 1.\n3 3\n", [25.751]),
        ('"x","y"\n"0","0"\n"9","0"\n"9","9"\n', [40.5]),
        ('"0","0"\n"9","0"\n"9","9"\n', [40.5]),
    ],
)
def test_files_of_points(tmp_path, text, areas):
    path = tmp_path / "outline.csv"
    path.write_text(text, newline="")
    contours = targets.read_polylines(path)
    assert [AREA(c) for c in targets.nested(contours)] == pytest.approx(areas)


def test_contours_keep_their_direction(tmp_path):
    for points in ([(1, 0), (1, 1), (0, 0)], [(1, 0), (0, 0), (1, 1)]):
        (tmp_path / "outline.txt").write_text("".join(f"{x} {y}\n" for x, y in points))
        assert list(map(tuple, targets.read_polylines(tmp_path / "outline.txt")[0])) == points
        (tmp_path / "outline.svg").write_text(
            drawing(f'<polygon points="{" ".join(f"{x},{-y}" for x, y in points)}"/>')
        )
        (contour,) = targets.read_svg(tmp_path / "outline.svg")
        assert list(map(tuple, contour)) == points
        assert targets.nested([contour])[0].tolist() == [[1, 0], [1, 1], [0, 0]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "has no points"),
        ("# nothing\n", "has no points"),
        ("0 0\n1 0 0\n1 1\n", "3 values instead of two, x and y, at line 2"),
        ("0 0\n1\n1 1\n", "1 values instead of two"),
        ("0 0\n1 a\n1 1\n", "'a' is not a finite number at line 2"),
        ("0 0\n1 nan\n1 1\n", "'nan' is not a finite number"),
        ("a b\nc d\n", "'c' is not a finite number at line 2"),
        (
            "0 0\n1 0\n\n1 1\n",
            "2 different points that encloses no area begins at line 1; use blank lines only between",
        ),
        ("0 0\n1 0\n1 1\n\n\n5 5\n6 6\n7 7\n", "encloses no area begins at line 6"),
        ("0 0\n1 1\n1 0\n0 1\n", r"meets itself: .* crosses .* \(the contour begins at line 1\)"),
        ("0 0\n4 0\n4 4\n\n3 1\n5 1\n5 2\n", r"contours 0 and 1 .* meet.* \(the contours begin at lines 1, 5\)"),
        ("0 0\n0 0\n0 0\n", "a contour of 1 different points"),
    ],
)
def test_invalid_files_of_points(tmp_path, text, message):
    (tmp_path / "outline.txt").write_text(text)
    with pytest.raises(ValueError, match=message):
        targets.read_polylines(tmp_path / "outline.txt")


def test_too_many_points(tmp_path, monkeypatch):
    monkeypatch.setattr("quasiharmonic.targets.outlines.shapes.MAX_POINTS", 3)
    (tmp_path / "outline.txt").write_text("0 0\n1 0\n1 1\n0 1\n")
    with pytest.raises(ValueError, match="more than 3 points at line 4; use fewer points"):
        targets.read_polylines(tmp_path / "outline.txt")


# --- by name


@pytest.mark.parametrize(
    ("text", "areas", "points"),
    [
        ("disk", [np.pi], None),
        ("ellipse:2x0.5", [np.pi], None),
        ("rect:2x1", [2], 4),
        ("rect:3X.5", [1.5], 4),
        ("polygon:6", [1.5 * np.sqrt(3)], 6),
        ("star:5", [2.5 * np.sin(np.pi / 5)], 10),
        ("ring:0.5", [np.pi, -np.pi / 4], None),
        ("letter:H", [0.3135], 12),
        ("letter:8", [0.3587, -0.0399, -0.0275], None),
        ("letter::", [0.0333, 0.0333], 4),
    ],
)
def test_outlines_by_name(text, areas, points):
    contours = targets.outline(text)
    assert [AREA(c) for c in contours] == pytest.approx(areas, rel=2e-3)
    if points:
        assert len(contours[0]) == points


def test_tolerance_of_round_outlines():
    for text, size in (("disk", 2), ("ellipse:3x3", 6), ("ring:0.5", 2)):
        contour = targets.outline(text, tolerance=1e-4)[0]
        middle = np.linalg.norm(contour + np.roll(contour, -1, axis=0), axis=1) / 2
        assert 0.5e-4 < (size / 2 - middle.min()) / size <= 1.0001e-4
    assert len(targets.outline("letter:S", tolerance=1e-6)[0]) > 10 * len(targets.letter("S")[0])


def test_outline_files(tmp_path):
    (tmp_path / "a.SVG").write_text(drawing('<rect width="2" height="1"/>'))
    (tmp_path / "b.txt").write_text("0 0\n1 0\n1 1\n")
    assert AREA(targets.outline(tmp_path / "a.SVG")[0]) == -2
    assert AREA(targets.outline(str(tmp_path / "b.txt"))[0]) == 0.5


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("lettr:G", "unknown outline 'lettr:G': use disk, "),
        ("disk:3", "unknown outline"),
        ("rect", "unknown outline"),
        ("drawing.pdf", "unknown outline"),
        ("", "unknown outline ''"),
        ("rect:2", "'rect:2': give two numbers with an x between them, as in 2x1"),
        ("rect:2xa", "'a' is not a number"),
        ("rect:0x1", "width must be positive"),
        ("ellipse:1xinf", "b must be positive and finite"),
        ("polygon:2", "points must be an integer of at least 3, not 2"),
        ("polygon:six", "'six' is not a whole number"),
        ("polygon:-3", "'-3' is not a whole number"),
        ("star:9999999", "9999999 is too many"),
        ("star:5.5", "'star:5.5': '5.5' is not a whole number"),
        ("ring:1", "between 0 and 1, not 1.0"),
        ("letter:", "a single character, not ''"),
        ("letter:GG", "a single character, not 'GG'"),
        ("none.svg", "there is no such file"),
        ("none.txt", "there is no such file"),
    ],
)
def test_names_that_are_not_outlines(text, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        targets.outline(text)


def test_options_of_outlines():
    with pytest.raises(ValueError, match="'disk' takes no font"):
        targets.outline("disk", font="DejaVu Sans")
    with pytest.raises(ValueError, match="tolerance must be between 0 and 1"):
        targets.outline("disk", tolerance=0)


def test_the_command_lists_the_outlines_of_the_library():
    from quasiharmonic.targets import specification
    from quasiharmonic.ui.cli.map_options import FORMS

    assert FORMS == specification.FORMS
