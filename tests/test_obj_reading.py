"""OBJ files are read exactly; an error names the line."""

import math
from fractions import Fraction

import numpy as np
import pytest

from quasiharmonic import io
from quasiharmonic.io import MeshFileError
from quasiharmonic.io.formats.obj import read_regular
from quasiharmonic.io.untrusted import read_text
from shared.obj_files import SQUARE, SQUARE_F, SQUARE_VN, SQUARE_VT, bits, same


@pytest.mark.parametrize(
    ("faces", "FT", "FN"),
    [
        ("f 1 2 3\nf 1 3 4\n", None, None),
        ("f -4 -3 -2\nf -4 -2 -1\n", None, None),
        ("f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n", SQUARE_F, None),
        ("f 1/-4 2/-3 3/-2\nf -4/1 -2/3 -1/4\n", SQUARE_F, None),
        ("f 1//1 2//1 3//1\nf 1//2 3//2 4//2\n", None, [[0] * 3, [1] * 3]),
        ("f 1/1/1 2/2/1 3/3/1\nf 1/1/2 3/3/2 4/4/2\n", SQUARE_F, [[0] * 3, [1] * 3]),
        ("f 1/1/-2 2/2/-2 3/3/-2\nf 1/1/-1 3/3/-1 4/4/-1\n", SQUARE_F, [[0] * 3, [1] * 3]),
        ("f 1/1 2/2 3/3\nf 1//1 3//1 4//1\n", [[0, 1, 2], [-1] * 3], [[-1] * 3, [0] * 3]),
    ],
)
def test_face_forms(put, tmp_path, faces, FT, FN):
    mesh = io.read_mesh(put(SQUARE + SQUARE_VT + SQUARE_VN + faces))
    assert mesh.F.tolist() == SQUARE_F
    assert mesh.F.dtype == np.int64
    assert (None if mesh.FT is None else mesh.FT.tolist()) == FT
    assert (None if mesh.FN is None else mesh.FN.tolist()) == FN
    io.write_obj(tmp_path / "again.obj", mesh)
    assert same(mesh, io.read_mesh(tmp_path / "again.obj"))


def test_negative_indices_count_back_from_their_line(put):
    mesh = io.read_mesh(put("v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 5 0 0\nv 6 0 0\nv 5 1 0\nf -3 -2 -1\n"))
    assert mesh.F.tolist() == [[0, 1, 2], [3, 4, 5]]


def test_a_face_may_precede_its_vertices(put):
    assert io.read_mesh(put("f 1 2 3\nf 1 3 4\n" + SQUARE)).F.tolist() == SQUARE_F


@pytest.mark.parametrize(
    "text",
    [
        (SQUARE + "f 1 2 3\nf 1 3 4\n").replace("\n", "\r\n"),
        (SQUARE + "f 1 2 3\nf 1 3 4\n").replace("\n", "\r"),
        "\ufeff" + SQUARE + "f 1 2 3\nf 1 3 4",
        (SQUARE + "f 1 2 3\nf 1 3 4\n").replace(" ", "\t  "),
        (SQUARE + "f 1 2 3\nf 1 3 4\n").replace("\n", " \t\n\n"),
        (SQUARE + "f 1 2 3\nf 1 3 4\n").replace("\n", " # why\n"),
        "  " + (SQUARE + "f 1 2 3\nf 1 3 4\n").replace("\n", "\n\t "),
        (SQUARE + "f 1 2 3\nf 1 3 4\n").replace(" 1", " \\\n1"),
        SQUARE + "f 1 2 3\nf 1 3 4 \\",
        SQUARE + "f 01 002 0000000000000000000000003\nf 1 3 4\n",
    ],
)
def test_layout_does_not_matter(put, text):
    mesh = io.read_mesh(put(text))
    assert mesh.V.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert mesh.F.tolist() == SQUARE_F
    assert mesh.statements == b""


@pytest.mark.parametrize("regular", [True, False])
def test_decimal_text_is_rounded_correctly(put, regular):
    texts = [
        "9007199254740993",
        "9007199254740993.00000000000000000000000000000000001",
        "1.00000000000000011102230246251565404236316680908203125",
        "1.00000000000000011102230246251565404236316680908203124",
        "1.00000000000000011102230246251565404236316680908203126",
        "2.2250738585072011e-308",
        "2.4703282292062327208e-324",
        "2.4703282292062328e-324",
        "1e-320",
        "1.7976931348623158e308",
        "0.1",
        "-0.0",
        "5.",
        ".5",
        "+1E+2",
    ]
    lines = "".join(f"v {t} {t} {t}\n" for t in texts) + ("" if regular else " ") + "f 1 2 3\n"
    path = put(lines)
    assert (read_regular(path, read_text(path)) is not None) == regular
    V = io.read_mesh(path).V

    def nearest(x):
        # No neighbour of the value read is closer; ties go to the even one.
        exact = Fraction(x)
        got = float(x)
        rivals = [r for r in (math.nextafter(got, -math.inf), math.nextafter(got, math.inf)) if math.isfinite(r)]
        gap = abs(Fraction(got) - exact)
        for rival in rivals:
            assert gap <= abs(Fraction(rival) - exact)
            assert gap != abs(Fraction(rival) - exact) or np.float64(got).view(np.int64) % 2 == 0
        return got

    assert bits(V) == bits([[nearest(t)] * 3 for t in texts])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (SQUARE + "f 1 2 3 2\n", "face with 4 corners that uses a vertex twice at line 5; remove the repetition"),
        (
            SQUARE + "f 1 2 3\n\nf 1 2 3 4 1\n",
            "face with 5 corners that uses a vertex twice at line 7; remove the repetition",
        ),
        (SQUARE + "f 1 2\n", "face with 2 corners at line 5"),
        (SQUARE + "f\n", "face with 0 corners at line 5"),
        (SQUARE + "f" + " 1" * 2000 + "\n", "more than 1000 corners at line 5; triangulate it first"),
        (SQUARE + "f 1 2 5\n", "index 5, but the file has 4 vertices at line 5"),
        (SQUARE + "f 1 2 3\nf 1 2 2147483648\n", "index 2147483648, but the file has 4 vertices at line 6"),
        (SQUARE + f"f 1 2 {10**30}\n", "'1" + "0" * 30 + "' is far too large at line 5"),
        (SQUARE + "f 1 2 " + "7" * 9999 + "\n", "is far too large at line 5"),
        (SQUARE + "f 1 2 -5\n", "index -5 reaches back beyond the 4 that come before it at line 5"),
        ("f -1 -2 -3\n" + SQUARE, "reaches back beyond the 0 that come before it at line 1"),
        (SQUARE + "f 0 1 2\n", "index 0 in '0' at line 5; OBJ counts from 1"),
        (SQUARE + "f 1/1 2/2 3/3\n", "index 1, but the file has 0 texture coordinates at line 5"),
        (SQUARE + SQUARE_VT + "f 1/1 2/2 3/9\n", "index 9, but the file has 4 texture coordinates at line 9"),
        (SQUARE + "f 1//1 2//1 3//1\n", "index 1, but the file has 0 normals at line 5"),
        (SQUARE + "f 1/1/1/1 2 3\n", "'1/1/1/1' is not a corner of a face at line 5"),
        (SQUARE + "f /1 2 3\n", "'/1' is not a corner of a face at line 5"),
        (SQUARE + "f 1.0 2 3\n", "'1.0' is not an integer at line 5"),
        (SQUARE + "f 1_0 2 3\n", "'1_0' is not an integer at line 5"),
        (SQUARE + "f ١ 2 3\n", "is not an integer at line 5"),
        ("v 0 0\n" + SQUARE, "a vertex with 2 coordinates at line 1"),
        ("v\n" + SQUARE, "a vertex with 0 coordinates at line 1"),
        (SQUARE + "v 1 2 3 4 5 6 7 8 9\n", "'v' with more than 8 numbers at line 5"),
        (SQUARE + "v 0 0 nan\nf 1 2 3\n", "'nan' is not a finite number at line 5"),
        (SQUARE + "v 0 0 -inf\nf 1 2 3\n", "'-inf' is not a finite number at line 5"),
        (SQUARE + "v 0 0 1e999\nf 1 2 3\n", "'1e999' is not a finite number at line 5"),
        (SQUARE + "v 0 0 1_0\nf 1 2 3\n", "'1_0' is not a finite number at line 5"),
        (SQUARE + "v 0 0 0x1p3\nf 1 2 3\n", "'0x1p3' is not a finite number at line 5"),
        (SQUARE + "v 0 0 1,5\nf 1 2 3\n", "'1,5' is not a finite number at line 5"),
        (SQUARE + "v 0 0 " + "x" * 9999 + "\n", f"'{'x' * 40}...' is not a finite number at line 5"),
        (SQUARE + "vt nan 0\nf 1 2 3\n", "'nan' is not a finite number at line 5"),
        (SQUARE + "vt 0.5\nf 1 2 3\n", "a texture coordinate with 1 number at line 5"),
        (SQUARE + "f 1 2 3\nsurf 0 1 0 1 1 2 3\n", "'surf' statement at line 6; only polygons"),
        (SQUARE + "f 1 2 3\nl 1/1 2/2\n", "'l' element with relative or texture indices at line 6"),
        (SQUARE + "f 1 2 3\np -1\n", "'p' element with relative or texture indices at line 6"),
        (SQUARE, "has no faces"),
        ("", "has no vertices"),
        ("\n\n# nothing\n", "has no vertices"),
        ("solid\nfacet normal 0 0 1\n", "has no vertices; is it an OBJ file?"),
        (SQUARE + "f 1 2 3\0\n", "a NUL byte at line 5"),
        ((SQUARE + "f 1 2 3\n").encode("utf-16"), "is UTF-16 text; save it as UTF-8"),
        (b"\x1f\x8b\x08\0", "is compressed by gzip; unpack it first"),
        (b"PK\x03\x04\0", "is a zip archive; unpack it first"),
        (b"v 0 0 \xff\xfe\n", "is not a finite number at line 1"),
    ],
)
def test_malformed_obj_is_named_with_its_line(put, text, message):
    path = put(text)
    with pytest.raises(MeshFileError) as caught:
        io.read_mesh(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)
    assert caught.value.path == path


def test_lines_are_counted_across_continuations(put):
    with pytest.raises(MeshFileError, match="4 corners that uses a vertex twice at line 9"):
        io.read_mesh(put("# a\r\n\r\n" + SQUARE + "f 1 \\\n2 3\nf 1 \\\n2 \\\n3 2\n"))


def test_a_comment_that_ends_in_a_backslash_ends_there(put):
    mesh = io.read_mesh(put("# C:\\out\\\n" + SQUARE + "f 1 2 3\n"))
    assert len(mesh.V) == 4
    assert mesh.statements == b"# C:\\out\\\n"


def test_fortran_exponents_in_a_mesh(tmp_path):
    path = tmp_path / "m.obj"
    path.write_text("v 0 0 0\nv 1.0D+00 0 0\nv 0 5d-1 0\nf 1 2 3\n")
    assert io.read_mesh(path).V.tolist() == [[0, 0, 0], [1, 0, 0], [0, 0.5, 0]]
