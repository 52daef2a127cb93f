"""Letters, words and fonts as targets."""

from __future__ import annotations

import itertools
import subprocess
import sys
from pathlib import Path
from unicodedata import category

import numpy as np
import pytest
from matplotlib import get_data_path

from quasiharmonic import boundary_loops, surfaces, targets
from quasiharmonic.targets.boundary.correspondence import viewer_axes
from quasiharmonic.targets.outlines.letters import glyph_paths
from shared.contours import steps


def distance(points, contour):
    """Return the distance of every point from a closed polyline."""
    a, b = contour, np.roll(contour, -1, axis=0)
    along = ((points[:, None] - a) * (b - a)).sum(axis=2) / ((b - a) ** 2).sum(axis=1)
    foot = a + np.clip(along, 0, 1)[..., None] * (b - a)
    return np.linalg.norm(points[:, None] - foot, axis=2).min(axis=1)


@pytest.mark.parametrize(
    ("character", "areas"),
    [
        ("G", [0.3033]),
        ("S", [0.2607]),
        ("H", [0.3135]),
        ("R", [0.3433, -0.0323]),
        ("A", [0.3151, -0.0290]),
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
def test_names_that_are_not_letters_are_rejected(character):
    with pytest.raises(ValueError, match=r"a single character|no outline"):
        targets.letter(character)


def test_glyphs_with_overlapping_parts_are_rejected_by_name():
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
def test_impossible_shapes_are_rejected(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_fonts_by_name_and_by_file():
    bold = targets.letter("G", "DejaVu Sans:bold")
    assert all(np.array_equal(a, b) for a, b in zip(bold, targets.letter("G"), strict=True))
    assert targets.signed_area(targets.letter("G", "DejaVu Sans")[0]) < 0.8 * targets.signed_area(bold[0])
    with pytest.raises(ValueError, match=r"no font named 'DejaVu Sanz' is installed; similar names: .*DejaVu Sans"):
        targets.letter("G", "DejaVu Sanz")


def test_files_that_are_not_fonts(tmp_path):
    (tmp_path / "fake.ttf").write_text("not a font")
    with pytest.raises(ValueError, match=r"fake\.ttf is not a readable font"):
        targets.letter("G", tmp_path / "fake.ttf")


def test_tolerance_of_letters():
    fine = targets.letter("S", tolerance=1e-6)[0]
    for tolerance in (1e-2, 1e-4):
        assert 0.2 * tolerance < distance(fine, targets.letter("S", tolerance=tolerance)[0]).max() < tolerance


@pytest.mark.slow
@pytest.mark.parametrize(("text", "holes"), [("QH", 1), ("LOVE", 1), ("G", 0), ("mesh", 2), ("R8", 3)])
def test_letters_of_a_word_form_one_piece(text, holes):
    pytest.importorskip("shapely")
    outer, *inner = targets.word(text)
    assert targets.signed_area(outer) > 0
    assert all(targets.signed_area(c) < 0 for c in inner)
    assert len(inner) == holes
    # Overlaps are small, so little area of the letters is covered twice.
    alone = sum(targets.signed_area(c) for character in text for c in targets.letter(character))
    assert 0.9 * alone < sum(map(targets.signed_area, [outer, *inner])) <= alone + 1e-12
    first = targets.letter(text[0])[0]
    assert outer[:, 0].min() == pytest.approx(first[:, 0].min())


def test_words_that_are_not_connected():
    pytest.importorskip("shapely")
    with pytest.raises(ValueError, match=r"1 part of 'hi' \(a dot, an accent\) touches no other"):
        targets.word("hi")


def test_words_need_shapely(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "shapely", None)
    with pytest.raises(ModuleNotFoundError, match=r"needs Shapely: pip install '.*\[shapes\]'"):
        targets.word("QH")


def test_nesting():
    square = targets.rectangle(1, 1) - 0.5
    islands = [2 * square, 8 * square[::-1], 4 * square, 6 * square, square / 2 + (3.5, 0)]
    ordered = targets.nested(islands)
    assert [targets.signed_area(c) for c in ordered] == [64, -36, 16, -4, -0.25]
    # A reversed contour keeps its first point.
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
def test_contours_that_bound_no_region_are_rejected(contours, message):
    contours = [np.array(c, dtype=float) for c in contours]
    if message is None:  # a tiny distance suffices, and points are not added
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


def test_lengths_are_proportional():
    angle = np.cumsum([0.1, 0.2, 0.4, 0.8, 0.7, 0.5, 0.9, 1.1])
    loop = np.stack([np.cos(angle), np.sin(angle), 0.3 * np.sin(2 * angle)], axis=1)
    circle = targets.disk(2.0, 4096)
    placed = targets.arc_length(loop, circle, start=0)
    turn = np.unwrap(np.arctan2(placed[:, 1], placed[:, 0]))
    ends = np.cumsum(steps(loop))
    assert turn == pytest.approx(np.concatenate([[0], ends[:-1] / ends[-1]]) * 2 * np.pi, abs=1e-5)


@pytest.mark.parametrize("character", "GSRAPH")
def test_corners_of_a_letter_are_preserved(character):
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
    # Every edge keeps its share of the length, except for the shift of the vertex closest to a corner.
    share = steps(outline).sum() / len(loop)
    assert steps(placed).min() > 0.1 * share
    assert steps(placed).max() < 2.5 * share
    assert targets.signed_area(placed) == pytest.approx(targets.signed_area(outline), rel=0.02)


def test_every_corner_takes_its_closest_vertex():
    loop = targets.disk(1.0, 40)
    placed = targets.arc_length(loop, targets.star(5, 0.4), start=7)
    where = [int(np.flatnonzero((placed == corner).all(axis=1))[0]) for corner in targets.star(5, 0.4)]
    assert where == [(7 + 4 * i) % 40 for i in range(10)]
    assert steps(placed) == pytest.approx(np.full(40, steps(placed)[0]))


def test_close_corners_get_separate_vertices():
    # Five corners lie on a twentieth of the length, with one vertex per twelfth.
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


def test_matching_shapes_fit_without_options():
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


@pytest.mark.slow
def test_a_curved_loop_is_seen_upright():
    V, F = surfaces.cat(20)
    loop = boundary_loops(F, len(V))[0]
    placed = targets.arc_length(V[loop], targets.disk())
    towards = V[loop, :2] / np.linalg.norm(V[loop, :2], axis=1)[:, None]
    assert (towards * placed).sum(axis=1).min() > 0.9


def test_a_curved_hole_is_seen_from_the_side_with_the_contours_direction():
    V, F = surfaces.annulus(8)
    hole = boundary_loops(F, len(V))[1]
    for turn in (0, 1.0):
        flat = V @ np.array([(np.cos(turn), np.sin(turn)), (-np.sin(turn), np.cos(turn))])
        lifted = np.column_stack([flat, np.zeros(len(V))])
        assert targets.arc_length(lifted[hole], flat[hole]) == pytest.approx(flat[hole])


@pytest.mark.parametrize("normal", np.vstack([np.eye(3), -np.eye(3), [(0, 0, 0), (1, 2, 3)]]))
def test_viewer_frame_is_a_rotation(normal):
    frame = viewer_axes(normal)
    assert frame @ frame.T == pytest.approx(np.eye(3))
    assert np.linalg.det(frame) == pytest.approx(1)
    assert frame[2] @ normal == pytest.approx(np.linalg.norm(normal))
    assert abs(frame[0, 1]) < 1e-15


def test_input_types_and_unchanged_inputs():
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
def test_invalid_curves_are_rejected(loop, outline, options, message):
    with pytest.raises(ValueError, match=message):
        targets.arc_length(loop, outline, **options)


@pytest.mark.long
@pytest.mark.parametrize("font", ["DejaVuSans-Bold", "cmr10", "STIXGeneral"])
def test_letters_agree_with_freetype_up_to_its_rounding(font):
    """Letters, ligatures, combined accents, Greek, Cyrillic, symbols: read by this package and by matplotlib."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.ft2font import FT2Font
    from matplotlib.path import Path as Outline
    from matplotlib.textpath import text_to_path

    file = Path(get_data_path(), "fonts", "ttf", f"{font}.ttf")
    known = FT2Font(str(file)).get_charmap()
    characters = [chr(code) for code in range(0x21, 0x530, 43) if code in known]
    # Recent matplotlib puts a mark that stands alone onto a dotted circle.
    characters = [character for character in characters if category(character)[0] != "M"]
    assert len(characters) > 3
    for character in characters:
        points, codes = text_to_path.get_text_path(FontProperties(fname=file), character)
        if not len(codes):
            continue
        curves = Outline(np.asarray(points) / text_to_path.FONT_SCALE, codes).iter_segments(simplify=False)
        drawn = [flat for flat, code in curves if code not in (Outline.MOVETO, Outline.CLOSEPOLY)]
        ends = np.concatenate([piece[[0, -1]] for path in glyph_paths(character, file) for piece in path])
        # FreeType rounds to 1/64 of a pixel, of which the font size has 100, and older versions to a unit of the font.
        expected = np.array([flat[-2:] for flat in drawn])
        away = np.linalg.norm(ends[:, None] - expected, axis=2)
        assert away.min(axis=0).max() < 1.1e-3, character
        assert away.min(axis=1).max() < 1.1e-3, character


def test_fonts_with_cubic_curves(tmp_path):
    """A font in the format of PostScript (CFF), whose one letter is a circle of four cubic curves."""
    from fontTools.fontBuilder import FontBuilder
    from fontTools.pens.t2CharStringPen import T2CharStringPen

    pen = T2CharStringPen(500, None)
    r, k = 400, 400 * 0.5522847
    pen.moveTo((r, 0))
    for turn in (1, 1j, -1, -1j):
        corners = [(r + 1j * k) * turn, (k + 1j * r) * turn, 1j * r * turn]
        pen.curveTo(*((z.real, z.imag) for z in corners))
    pen.closePath()
    builder = FontBuilder(1000, isTTF=False)
    builder.setupGlyphOrder([".notdef", "o"])
    builder.setupCharacterMap({ord("o"): "o"})
    empty = T2CharStringPen(500, None).getCharString()
    builder.setupCFF("Circle", {}, {".notdef": empty, "o": pen.getCharString()}, {})
    builder.setupHorizontalMetrics({".notdef": (500, 0), "o": (500, 0)})
    builder.setupHorizontalHeader()
    builder.setupPost()
    builder.save(tmp_path / "circle.otf")
    (circle,) = targets.letter("o", tmp_path / "circle.otf", tolerance=1e-5)
    assert np.hypot(*circle.T) == pytest.approx(np.full(len(circle), 0.4), abs=1e-3)
    assert targets.signed_area(circle) == pytest.approx(0.16 * np.pi, rel=1e-3)


@pytest.mark.slow
def test_unusual_fonts_cause_no_warning():
    code = """if True:
        import matplotlib
        from quasiharmonic.targets import letter
        letter("R", matplotlib.get_data_path() + "/fonts/ttf/cmr10.ttf")"""
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stderr == ""


@pytest.mark.parametrize("cut", [0, 3, 11, 40, 300, 5000, 100_000])
def test_a_damaged_font_is_an_error(tmp_path, cut):
    data = Path(get_data_path(), "fonts", "ttf", "DejaVuSans-Bold.ttf").read_bytes()
    (tmp_path / "cut.ttf").write_bytes(data[:cut])
    with pytest.raises(ValueError, match=r"cut\.ttf is not a readable font"):
        targets.letter("R", tmp_path / "cut.ttf")


@pytest.mark.slow
def test_a_damaged_font_causes_no_endless_loop(tmp_path, rng):
    """Bytes are changed at random, in the tables and their directory: the result is an outline or a ValueError."""
    data = bytearray(Path(get_data_path(), "fonts", "ttf", "DejaVuSans-Bold.ttf").read_bytes())
    read = rejected = 0
    for bytes_changed, end in 6 * [(3, len(data)), (10, len(data)), (50, len(data)), (5, 400)]:
        spoilt = data.copy()
        for at in rng.integers(0, end, bytes_changed).tolist():
            spoilt[at] = int(rng.integers(256))
        (tmp_path / "spoilt.ttf").write_bytes(spoilt)
        try:
            paths = glyph_paths("R", tmp_path / "spoilt.ttf")
        except ValueError:
            rejected += 1
        else:
            assert len(paths) > 0
            read += 1
    assert min(read, rejected) > 3
