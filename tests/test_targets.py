"""Outlines and the places of boundary vertices on them."""

from __future__ import annotations

import itertools
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from quasiharmonic import boundary_loops, surfaces, targets
from quasiharmonic.targets.boundary.correspondence import upright
from quasiharmonic.targets.outlines import truetype


def distance(points, contour):
    """Distance of every point from a closed polyline."""
    a, b = contour, np.roll(contour, -1, axis=0)
    along = ((points[:, None] - a) * (b - a)).sum(axis=2) / ((b - a) ** 2).sum(axis=1)
    foot = a + np.clip(along, 0, 1)[..., None] * (b - a)
    return np.linalg.norm(points[:, None] - foot, axis=2).min(axis=1)


def steps(points):
    return np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)


# --- outlines


@pytest.mark.parametrize(
    ("contour", "area", "points"),
    [
        (targets.disk(2.0, 100), 50 * 4 * np.sin(2 * np.pi / 100), 100),
        (targets.ellipse(3, 0.5, 64), 32 * 1.5 * np.sin(2 * np.pi / 64), 64),
        (targets.rectangle(2, 1), 2, 4),
        (targets.regular_polygon(4), 2, 4),
        (targets.regular_polygon(6, radius=2), 6 * np.sqrt(3), 6),
        (targets.star(5, 0.4), 5 * 0.4 * np.sin(np.pi / 5), 10),
    ],
)
def test_shapes_are_counterclockwise_and_have_their_area(contour, area, points):
    assert contour.shape == (points, 2)
    assert contour.dtype == np.float64
    assert targets.signed_area(contour) == pytest.approx(area)
    assert targets.signed_area(contour[::-1]) == pytest.approx(-area)
    assert steps(contour).min() > 0


def test_first_points():
    assert targets.ellipse(3, 0.5)[0] == pytest.approx((3, 0))
    assert targets.rectangle(2, 1)[[0, 2]].tolist() == [[0, 0], [2, 1]]
    assert targets.regular_polygon(3)[0] == pytest.approx((0, 1))
    assert targets.star(5)[0] == pytest.approx((0, 1))
    assert np.linalg.norm(targets.star(7, 0.3)[1::2], axis=1) == pytest.approx(np.full(7, 0.3))


def test_area_far_from_the_origin():
    assert targets.signed_area(targets.rectangle(2, 1) + 1e8) == pytest.approx(2)


@pytest.mark.parametrize(
    ("character", "areas"),
    [
        ("G", [0.3033]),
        ("S", [0.2607]),
        ("H", [0.3135]),
        ("R", [0.3433, -0.0323]),
        ("A", [0.3152, -0.0290]),
        ("8", [0.3581, -0.0397, -0.0273]),
        ("%", [0.1262, 0.1258, 0.0818, -0.0279, -0.0276]),
        (",", [0.0516]),
    ],
)
def test_letters(character, areas):
    contours = targets.letter(character)
    assert [targets.signed_area(c) for c in contours] == pytest.approx(areas, abs=1e-4)
    for contour in contours:
        assert steps(contour).min() > 0.005
    height = contours[0][:, 1]
    assert height.min() > -0.2
    assert height.max() < 0.8


def test_letter_with_straight_sides_has_only_its_corners():
    assert targets.letter("H")[0].shape == (12, 2)


def test_curves_are_flat_to_tolerance():
    from matplotlib import get_data_path
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    file = f"{get_data_path()}/fonts/ttf/DejaVuSans-Bold.ttf"
    path = TextPath((0, 0), "S", size=1, prop=FontProperties(fname=file))
    coarse = targets.letter("S", file)[0]
    fine = []
    here = None
    for points, code in path.iter_segments(simplify=False):
        if code == path.CURVE3:
            t = np.linspace(0, 1, 50)[:, None]
            fine.append((1 - t) ** 2 * here + 2 * t * (1 - t) * points[:2] + t**2 * points[2:])
        here = points[-2:]
    assert 1e-4 < distance(np.concatenate(fine), coarse).max() < 5e-4


@pytest.mark.parametrize("character", ["", "GG", " "])
def test_what_is_no_letter_is_refused(character):
    with pytest.raises(ValueError, match=r"a single character|no outline"):
        targets.letter(character)


def test_glyphs_whose_parts_overlap_are_refused_by_name():
    with pytest.raises(ValueError, match="the glyph of 'Ç': contours 0 and 1 of the outline meet"):
        targets.letter("Ç")


def test_missing_glyph_and_missing_font(tmp_path):
    with pytest.raises(ValueError, match=r"DejaVuSans-Bold\.ttf has no glyph for '猫'"):
        targets.letter("猫")
    with pytest.raises(FileNotFoundError, match=r"none\.ttf"):
        targets.letter("G", tmp_path / "none.ttf")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: targets.rectangle(0, 1), "width must be positive and finite, not 0"),
        (lambda: targets.rectangle(1, np.inf), "height must be positive"),
        (lambda: targets.ellipse(1, -1), "b must be positive"),
        (lambda: targets.disk(np.nan), "radius must be positive"),
        (lambda: targets.disk(1, 2), "points must be an integer of at least 3, not 2"),
        (lambda: targets.regular_polygon(2), "points must be an integer of at least 3, not 2"),
        (lambda: targets.star(5.5), "tips must be an integer of at least 3, not 5.5"),
        (lambda: targets.regular_polygon(6.5), "must be an integer of at least 3, not 6.5"),
        (lambda: targets.disk(1, 99.5), "must be an integer of at least 3, not 99.5"),
        (lambda: targets.star(2), "tips must be an integer of at least 3, not 2"),
        (lambda: targets.star(5, 1.0), "between 0 and 1, not 1.0"),
        (lambda: targets.ring(0), "between 0 and 1, not 0"),
        (lambda: targets.ring(0.5, 2), "points must be an integer of at least 3, not 2"),
        (lambda: targets.word("GS", overlap=0), "overlap must be positive"),
        (lambda: targets.word(""), "a word needs at least one letter"),
    ],
)
def test_impossible_shapes_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_fonts_by_name_and_by_file():
    bold = targets.letter("G", "DejaVu Sans:bold")
    assert all(np.array_equal(a, b) for a, b in zip(bold, targets.letter("G"), strict=True))
    assert targets.signed_area(targets.letter("G", "DejaVu Sans")[0]) < 0.8 * targets.signed_area(bold[0])
    with pytest.raises(ValueError, match=r"no font named 'DejaVu Sanz' is installed; similar names: .*DejaVu Sans"):
        targets.letter("G", "DejaVu Sanz")


def test_what_is_no_font(tmp_path):
    (tmp_path / "fake.ttf").write_text("not a font")
    with pytest.raises(ValueError, match=r"fake\.ttf is not a readable font"):
        targets.letter("G", tmp_path / "fake.ttf")


def test_tolerance_of_letters():
    fine = targets.letter("S", tolerance=1e-7)[0]
    for tolerance in (1e-2, 1e-4):
        assert 0.2 * tolerance < distance(fine, targets.letter("S", tolerance=tolerance)[0]).max() < tolerance


@pytest.mark.parametrize(("text", "holes"), [("QH", 1), ("LOVE", 1), ("G", 0), ("mesh", 2), ("R8", 3)])
def test_letters_of_a_word_make_one_piece(text, holes):
    pytest.importorskip("shapely")
    outer, *inner = targets.word(text)
    assert targets.signed_area(outer) > 0
    assert all(targets.signed_area(c) < 0 for c in inner)
    assert len(inner) == holes
    # Overlaps are small, so little of the letters is covered twice.
    alone = sum(targets.signed_area(c) for character in text for c in targets.letter(character))
    assert 0.9 * alone < sum(map(targets.signed_area, [outer, *inner])) <= alone + 1e-12
    first = targets.letter(text[0])[0]
    assert outer[:, 0].min() == pytest.approx(first[:, 0].min())


def test_words_that_fall_apart():
    pytest.importorskip("shapely")
    with pytest.raises(ValueError, match=r"1 part of 'hi' \(a dot, an accent\) touches no other"):
        targets.word("hi")


def test_words_need_shapely(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "shapely", None)
    with pytest.raises(ModuleNotFoundError, match=r"needs Shapely: pip install 'quasiharmonic\[shapes\]'"):
        targets.word("QH")


def test_nesting():
    square = targets.rectangle(1, 1) - 0.5
    islands = [2 * square, 8 * square[::-1], 4 * square, 6 * square, square / 2 + (3.5, 0)]
    ordered = targets.nested(islands)
    assert [targets.signed_area(c) for c in ordered] == [64, -36, 16, -4, -0.25]
    # Turned around, a contour keeps its first point.
    assert ordered[0][0].tolist() == islands[1][0].tolist()
    assert [targets.signed_area(c) for c in targets.filled(islands)] == [-64]
    assert [targets.signed_area(c) for c in targets.filled([square, square + 2])] == [1, 1]
    with pytest.raises(ValueError, match="encloses no area"):
        targets.nested([np.array([(0, 0), (1, 1), (2, 2)])])
    with pytest.raises(ValueError, match=r"contour 1 must be \(k, 2\)"):
        targets.nested([square, np.zeros((2, 2))])


@pytest.mark.parametrize(
    ("contours", "message"),
    [
        (
            [[(0, 0), (1, 1), (1, 0), (0, 1)]],
            r"contour 0 of the outline meets itself: its side from point 0 \(0, 0\) to point 1 \(1, 1\) crosses",
        ),
        ([[(0, 0), (2, 0), (2, 2), (1, 0), (0, 2)]], r"contour 0 .* touches its side from point 2 \(2, 2\) to point 3"),
        ([[(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (1, 1), (0, 1)]], r"olds back onto itself at point 4 \(1, 2\)"),
        ([[(0, 0), (9, 0), (9, 9), (0, 9)], [(1, 1), (3, 1), (3, 1 - 1e-300), (1, 0.5)]], None),
        (
            [[(0, 0), (9, 0), (9, 9), (0, 9)], [(1, 0), (2, 1), (1, 1)]],
            "contours 0 and 1 of the outline meet: .* touches",
        ),
        ([[(8, 1), (10, 1), (9, 2)], [(0, 0), (9, 0), (9, 9), (0, 9)]], "contours 0 and 1 .* crosses"),
        ([[(0, 0), (9, 0), (9, 9)], [(0, 0), (9, 0), (9, 9)]], "contours 0 and 1 .* runs along .*9 such pairs in all"),
        ([[(0, 0), (1, 0), (1, 1)], [(0, 0), (1, 1e-9), (3, 3e-9)], [(2, 2), (4, 4), (3, 3)]], "contour 2 .* no area"),
    ],
)
def test_contours_that_bound_no_region_are_refused(contours, message):
    contours = [np.array(c, dtype=float) for c in contours]
    if message is None:  # a hair is room enough, and no more points than they are
        assert [len(c) for c in targets.nested(contours)] == [4, 3]
        return
    for refuse in (targets.nested, targets.filled):
        with pytest.raises(ValueError, match=message):
            refuse(contours)


def test_repeated_points_are_dropped():
    square = targets.rectangle(1, 1)
    closed = np.concatenate([square[:2], square[1:], square[:1]])
    assert targets.nested([closed])[0].tolist() == square.tolist()


@pytest.mark.parametrize("scale", [1e-300, 1e-150, 1e150, 1e300])
def test_nesting_at_any_scale(scale):
    outer, inner = targets.nested([scale * c for c in (targets.disk(0.5)[::-1], targets.disk(1.0))])
    assert np.array_equal(outer, scale * targets.disk(1.0))
    assert np.array_equal(inner, scale * targets.disk(0.5)[::-1])


# --- correspondence


def test_lengths_are_in_proportion():
    angle = np.cumsum([0.1, 0.2, 0.4, 0.8, 0.7, 0.5, 0.9, 1.1])
    loop = np.stack([np.cos(angle), np.sin(angle), 0.3 * np.sin(2 * angle)], axis=1)
    circle = targets.disk(2.0, 4096)
    placed = targets.arc_length(loop, circle, start=0)
    turn = np.unwrap(np.arctan2(placed[:, 1], placed[:, 0]))
    ends = np.cumsum(steps(loop))
    assert turn == pytest.approx(np.concatenate([[0], ends[:-1] / ends[-1]]) * 2 * np.pi, abs=1e-5)


@pytest.mark.parametrize("character", "GSRAPH")
def test_corners_of_a_letter_are_kept(character):
    V, F = surfaces.disk(25)
    loop = boundary_loops(F, len(V))[0]
    outline = targets.letter(character)[0]
    placed = targets.arc_length(V[loop], outline)
    ahead = np.roll(outline, -1, axis=0) - outline
    before = np.roll(ahead, 1, axis=0)
    cosine = (ahead * before).sum(axis=1) / np.linalg.norm(ahead, axis=1) / np.linalg.norm(before, axis=1)
    corners = outline[cosine < np.cos(np.radians(20))]
    assert len(corners) >= 4
    assert all((placed == corner).all(axis=1).sum() == 1 for corner in corners)
    assert distance(placed, outline).max() < 1e-15
    # Every edge keeps its share of the length, but for the shift of the nearest vertex to a corner.
    share = steps(outline).sum() / len(loop)
    assert steps(placed).min() > 0.1 * share
    assert steps(placed).max() < 2.5 * share
    assert targets.signed_area(placed) == pytest.approx(targets.signed_area(outline), rel=0.02)


def test_every_corner_takes_its_nearest_vertex():
    loop = targets.disk(1.0, 40)
    placed = targets.arc_length(loop, targets.star(5, 0.4), start=7)
    where = [int(np.flatnonzero((placed == corner).all(axis=1))[0]) for corner in targets.star(5, 0.4)]
    assert where == [(7 + 4 * i) % 40 for i in range(10)]
    assert steps(placed) == pytest.approx(np.full(40, steps(placed)[0]))


def test_crowded_corners_get_vertices_of_their_own():
    # Five corners on a twentieth of the length, one vertex on each twelfth.
    outline = np.array([(0, 0), (1, 0), (1, 0.5), (0.55, 0.5), (0.55, 0.45), (0.45, 0.45), (0.45, 0.5), (0, 0.5)])
    placed = targets.arc_length(targets.disk(1.0, 12), outline, start=3)
    where = [int(np.flatnonzero((placed == corner).all(axis=1))[0]) for corner in outline]
    assert where[0] == 3
    assert all((b - a) % 12 > 0 for a, b in itertools.pairwise(where))
    assert sum((b - a) % 12 for a, b in itertools.pairwise([*where, where[0]])) == 12


def test_as_many_vertices_as_corners_and_one_fewer():
    star = targets.star(5)
    assert np.array_equal(targets.arc_length(targets.disk(1.0, 10), star, start=4), np.roll(star, 4, axis=0))
    with pytest.raises(ValueError, match="the loop has 9 vertices, too few to keep the 10 corners"):
        targets.arc_length(targets.disk(1.0, 9), star)
    relaxed = targets.arc_length(targets.disk(1.0, 9), star, start=0, corner_angle=120)
    assert steps(relaxed).min() > 0


def test_matching_shapes_fit_without_being_told():
    for V, F in (surfaces.grid(6, 4), surfaces.random_delaunay(150, seed=2), surfaces.disk(6)):
        loop = boundary_loops(F, len(V))[0]
        own = V[loop]
        assert targets.arc_length(np.roll(own, 9, axis=0), own) == pytest.approx(np.roll(own, 9, axis=0))
        lifted = np.column_stack([own, np.zeros(len(own))])
        assert targets.arc_length(lifted, own) == pytest.approx(own)


def test_holes_run_clockwise():
    V, F = surfaces.annulus(8)
    hole = V[boundary_loops(F, len(V))[1]]
    assert targets.signed_area(hole) == pytest.approx(-1)
    placed = targets.arc_length(hole, targets.rectangle(1, 1)[::-1] - 0.5)
    assert placed == pytest.approx(hole)


def test_curved_loop_is_seen_upright():
    V, F = surfaces.cat(20)
    loop = boundary_loops(F, len(V))[0]
    placed = targets.arc_length(V[loop], targets.disk())
    towards = V[loop, :2] / np.linalg.norm(V[loop, :2], axis=1)[:, None]
    assert (towards * placed).sum(axis=1).min() > 0.9


def test_curved_hole_is_seen_from_the_side_where_it_runs_as_the_contour_does():
    V, F = surfaces.annulus(8)
    hole = boundary_loops(F, len(V))[1]
    for turn in (0, 1.0):
        flat = V @ np.array([(np.cos(turn), np.sin(turn)), (-np.sin(turn), np.cos(turn))])
        lifted = np.column_stack([flat, np.zeros(len(V))])
        assert targets.arc_length(lifted[hole], flat[hole]) == pytest.approx(flat[hole])


@pytest.mark.parametrize("normal", np.vstack([np.eye(3), -np.eye(3), [(0, 0, 0), (1, 2, 3)]]))
def test_viewer_frame_is_a_rotation(normal):
    frame = upright(normal)
    assert frame @ frame.T == pytest.approx(np.eye(3))
    assert np.linalg.det(frame) == pytest.approx(1)
    assert frame[2] @ normal == pytest.approx(np.linalg.norm(normal))
    assert abs(frame[0, 1]) < 1e-15


def test_input_types_and_inputs_untouched():
    loop, outline = targets.disk(1.0, 30), targets.star(4)
    want = targets.arc_length(loop, outline, start=2)
    fortran, frozen = np.asfortranarray(loop), outline.copy()
    frozen.flags.writeable = False
    assert np.array_equal(targets.arc_length(fortran, frozen, start=2), want)
    single = targets.arc_length(loop.astype(np.float32), outline.tolist(), start=2)
    assert single == pytest.approx(want, abs=1e-5)


@pytest.mark.parametrize(
    ("loop", "outline", "options", "message"),
    [
        (np.zeros((5, 4)), targets.star(3), {}, r"loop must be \(k, 2\) or \(k, 3\) .* not \(5, 4\)"),
        (targets.disk(), np.zeros((2, 2)), {}, r"outline must be \(k, 2\) .* not \(2, 2\)"),
        (np.array([(0, 0), (1, 0), (1, np.nan)]), targets.rectangle(1, 1), {}, "loop is not finite at point 2"),
        (np.zeros((5, 3)), targets.rectangle(1, 1), {}, "all points of a closed curve coincide"),
        (targets.disk(1.0, 20), targets.star(3), {"start": 20}, "start = 20, but the loop has vertices 0 to 19"),
        (targets.disk(1.0, 20), targets.star(3), {"start": -1}, "start = -1"),
        (
            np.array([(0, 0), (1, 0), (1, 1), (1, 1), (0, 1), (0, 0.5)]),
            targets.disk(),
            {"start": 0},
            "vertices 2 and 3 of the loop coincide",
        ),
        (np.array([(0, 0), (1, 0), (0, 1), (0, 0)]), targets.disk(), {"start": 2}, "vertices 3 and 0 of the loop"),
    ],
)
def test_what_is_no_curve_is_refused(loop, outline, options, message):
    with pytest.raises(ValueError, match=message):
        targets.arc_length(loop, outline, **options)


FONTS = "DejaVuSans-Bold", "DejaVuSerif-Italic", "DejaVuSansMono", "cmr10", "STIXGeneral"
LARGE_FONTS = FONTS[:3]


@pytest.mark.parametrize(
    "font", [pytest.param(font, marks=[pytest.mark.slow] if font in LARGE_FONTS else []) for font in FONTS]
)
def test_glyphs_are_those_of_freetype_to_the_last_bit(font):
    """Letters, ligatures, accents put on letters, Greek, Cyrillic, signs: read here, and by way of matplotlib."""
    from matplotlib import get_data_path
    from matplotlib.font_manager import FontProperties
    from matplotlib.ft2font import FT2Font, __freetype_version__
    from matplotlib.path import Path as Outline
    from matplotlib.textpath import text_to_path

    # The one that older matplotlib brings rounds some points to another unit of the font.
    off = 0.5 / 1000 if __freetype_version__ == "2.6.1" else 0
    file = Path(get_data_path(), "fonts", "ttf", f"{font}.ttf")
    face = FT2Font(str(file))
    known = face.get_charmap()
    characters = [chr(code) for code in range(0x21, 0x530, 23) if code in known]
    read = {character: truetype.glyph(file, character) for character in characters}
    assert sum(paths is not None for paths in read.values()) > 0.3 * len(characters)
    for character, paths in read.items():
        if paths is None:
            continue
        points, codes = text_to_path.get_text_path(FontProperties(fname=file), character)
        curves = Outline(np.asarray(points) / text_to_path.FONT_SCALE, codes).iter_segments(simplify=False)
        drawn = [(flat, code) for flat, code in curves if code not in (Outline.MOVETO, Outline.CLOSEPOLY)]
        pieces = [piece for path in paths for piece in path]
        assert len(pieces) == len(drawn), character
        for piece, (flat, _) in zip(pieces, drawn, strict=True):
            assert np.abs(piece[1:].ravel() - flat).max() <= off, character


def test_odd_fonts_are_read_without_a_word():
    code = """if True:
        import matplotlib
        from quasiharmonic.targets import letter
        letter("R", matplotlib.get_data_path() + "/fonts/ttf/cmr10.ttf")"""
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stderr == ""


def test_no_font_is_asked_for_what_is_laid_out_by_rules_of_its_own(tmp_path):
    from matplotlib import get_data_path

    file = Path(get_data_path(), "fonts", "ttf", "DejaVuSans-Bold.ttf")
    assert truetype.glyph(file, "R") is not None
    for character in "\u0301\u05d0\u0628\ufb01\u00ad":
        assert truetype.glyph(file, character) is None


@pytest.mark.parametrize("cut", [0, 3, 11, 40, 300, 5000, 100_000])
def test_a_damaged_font_is_left_to_freetype(tmp_path, cut):
    from matplotlib import get_data_path

    data = Path(get_data_path(), "fonts", "ttf", "DejaVuSans-Bold.ttf").read_bytes()
    (tmp_path / "cut.ttf").write_bytes(data[:cut])
    assert truetype.glyph(tmp_path / "cut.ttf", "R") is None


def test_a_damaged_font_hangs_nobody(tmp_path, rng):
    """Bytes changed at random, in the tables and their directory: an outline, or none."""
    from matplotlib import get_data_path

    data = bytearray(Path(get_data_path(), "fonts", "ttf", "DejaVuSans-Bold.ttf").read_bytes())
    for _ in range(20):
        spoilt = data.copy()
        for at in rng.integers(0, 400, 5).tolist() + rng.integers(0, len(data), 50).tolist():
            spoilt[at] = int(rng.integers(256))
        (tmp_path / "spoilt.ttf").write_bytes(spoilt)
        truetype.glyph(tmp_path / "spoilt.ttf", "R")
