import math
import os
import pickle
import re
import signal
import stat
import subprocess
import sys
import time
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from quasiharmonic import io
from quasiharmonic.io import MeshData, MeshFileError, OutputError
from quasiharmonic.io.errors import FileInUseError
from quasiharmonic.io.formats.obj import read_regular
from quasiharmonic.io.formats.objlines import read_obj_lines
from quasiharmonic.io.lowlevel import atomic
from quasiharmonic.io.lowlevel.textual import read_rows, read_text
from quasiharmonic.io.models.meshdata import is_planar
from shared.datasets import write_problem
from shared.obj_reader import written
from shared.solvable_problems import star_problem

posix = pytest.mark.skipif(os.name != "posix", reason="needs POSIX")

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
SQUARE_VT = "vt 0 0\nvt 2 0\nvt 2 2\nvt 0 2\n"
SQUARE_VN = "vn 0 0 1\nvn 0 0 -1\n"
SQUARE_F = [[0, 1, 2], [0, 2, 3]]

# Every finite double; hypothesis prefers difficult ones.
finite = st.floats(allow_nan=False, allow_infinity=False)


@pytest.fixture
def put(tmp_path):
    """Write a file and return its path."""

    def write(text, name="mesh.obj"):
        path = tmp_path / name
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return path

    return write


def bits(a):
    """Return doubles as integers: equal means equal to the last bit, including -0.0 and NaN."""
    return np.ascontiguousarray(a, dtype=np.float64).view(np.int64).tolist()


def same(a, b):
    """Test whether two meshes agree in all data, bit by bit."""
    for name in ("V", "vt", "extra"):
        x, y = getattr(a, name), getattr(b, name)
        if (x is None) != (y is None) or (x is not None and (x.shape != y.shape or bits(x) != bits(y))):
            return False
    for name in ("F", "FT", "FN", "statement_faces"):
        x, y = getattr(a, name), getattr(b, name)
        if (x is None) != (y is None) or (x is not None and not np.array_equal(x, y)):
            return False
    return (a.normals, a.statements) == (b.normals, b.statements)


def both_readers_agree(path):
    data = read_text(path)
    regular = read_regular(path, data)
    return regular is not None and same(regular, read_obj_lines(path, data))


# Reading OBJ


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


def test_files_that_cannot_be_opened(tmp_path):
    with pytest.raises(MeshFileError, match="there is no such file"):
        io.read_mesh(tmp_path / "none.obj")
    (tmp_path / "folder.obj").mkdir()
    with pytest.raises(MeshFileError, match="is a directory"):
        io.read_mesh(tmp_path / "folder.obj")
    with pytest.raises(MeshFileError, match="is not a file name"):
        io.read_mesh("a\0b.obj")
    # Windows says of such a name that there is no such file.
    with pytest.raises(MeshFileError, match=r"cannot be read|there is no such file"):
        io.read_mesh("x" * 5000 + ".obj")


@posix
def test_reading_a_pipe_does_not_block(tmp_path):
    os.mkfifo(tmp_path / "pipe.obj")
    with pytest.raises(MeshFileError, match="not a regular file"):
        io.read_mesh(tmp_path / "pipe.obj")


@pytest.mark.parametrize("name", ["mesh.3ds", "mesh", ".obj", "mesh.obj.gz"])
def test_unsupported_suffixes(tmp_path, name):
    mesh = MeshData([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]])
    with pytest.raises(MeshFileError, match=r"supported: \.obj, \.off"):
        io.read_mesh(tmp_path / name)
    with pytest.raises(MeshFileError, match=r"supported: \.obj, \.off"):
        io.write_map(tmp_path / name, mesh, mesh.V[:, :2])
    with pytest.raises(MeshFileError, match=r"supported: \.obj, \.off"):
        io.check_output(tmp_path / name)


def test_suffixes_in_capitals(put):
    assert len(io.read_mesh(put(SQUARE + "f 1 2 3\n", "MESH.OBJ")).V) == 4


def test_errors_can_be_pickled_and_contain_odd_names():
    error = pickle.loads(pickle.dumps(MeshFileError("a.obj", "what", 3, "then")))
    assert (str(error), error.line) == ("a.obj: what at line 3; then", 3)
    assert str(MeshFileError("\udcff.obj", "what")).encode() == b"\\udcff.obj: what"


@pytest.mark.slow
@posix
def test_memory_stays_bounded_for_malicious_files(tmp_path):
    # Lines of 100 MB and of 20 MB, which would need gigabytes if split into tokens, and indices and counts that would
    # allocate an array of their size.
    script = f"""
import resource
from quasiharmonic.io import MeshFileError, read_handles, read_mesh
with open("/proc/self/statm") as file:
    now = int(file.read().split()[0]) * resource.getpagesize()
def read(text, name, megabytes):
    resource.setrlimit(resource.RLIMIT_AS, (now + megabytes * 2**20, resource.RLIM_INFINITY))
    path = {str(tmp_path / "hostile")!r} + name
    with open(path, "wb") as file:
        file.write(text)
    del text
    try:
        read_handles(path, 5) if name == ".txt" else read_mesh(path)
    except MeshFileError as error:
        print(error)
read(b"v 0 0 0\\nf " + b"1 " * 50_000_000 + b"\\n", ".obj", 700)
for head, name in ((b"v ", ".obj"), (b"v 0 0 0\\nvt ", ".obj"), (b"OFF ", ".off"), (b"", ".txt")):
    read(head + b"1 " * 10_000_000 + b"\\n", name, 300)
for index in (b"2147483648", b"-2147483648", b"999999999999999999"):
    read(b"v 0 0 0\\nf 1 1 " + index + b"\\n", ".obj", 100)
    read(b"OFF\\n1 1 0\\n0 0 0\\n3 0 0 " + index + b"\\n", ".off", 100)
    read(b"OFF\\n" + index + b" 1 0\\n0 0 0\\n", ".off", 100)
    read(index, ".txt", 100)
"""
    if not Path("/proc/self/statm").exists():
        pytest.skip("needs /proc")
    done = subprocess.run([sys.executable, "-W", "error", "-c", script], capture_output=True, text=True)
    assert done.stderr == ""
    assert len(done.stdout.splitlines()) == 5 + 12


# Data that is preserved


DECORATED = """\
# made by hand
mtllib things.mtl
o Cube
v 0 0 0
v 1 0 0
# between
v 1 1 0
v 0 1 0
vt 0 0
vt 1 0
vt 1 1
vn 0 0 1
vn -nan(ind) 0 1
g all
usemtl näh red
s 1
f 1/1/1 2/2/1 3/3/1
usemtl blue
s off
f 1/1/2 3/3/2 4/1/2
l 1 2 3
# end
"""


def test_statements_keep_their_position_among_the_faces(put, tmp_path):
    path = put(DECORATED)
    mesh = io.read_mesh(path)
    assert both_readers_agree(put(DECORATED.replace("l 1 2 3\n", ""), "regular.obj"))
    uv = np.array([[0, 0], [0.1, 0], [1 / 3, 1e-320], [-0.0, 1e300]])
    io.write_map(tmp_path / "out.obj", mesh, uv)
    assert (tmp_path / "out.obj").read_text(encoding="utf-8") == (
        """\
# made by hand
mtllib things.mtl
o Cube
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
vt 0 0
vt 0.1 0.0
vt 0.3333333333333333 1e-320
vt -0.0 1e+300
vn 0 0 1
vn -nan(ind) 0 1
# between
g all
usemtl näh red
s 1
f 1/1/1 2/2/1 3/3/1
usemtl blue
s off
f 1/1/2 3/3/2 4/4/2
l 1 2 3
# end
"""
    )
    again = io.read_mesh(tmp_path / "out.obj")
    assert bits(io.map_of(again)) == bits(uv)
    assert bits(again.V) == bits(mesh.V)


def test_invalid_utf8_in_names_is_preserved(put, tmp_path):
    mesh = io.read_mesh(put(b"usemtl \xff\xe9\n" + SQUARE.encode() + b"f 1 2 3\n"))
    io.write_obj(tmp_path / "out.obj", mesh)
    assert (tmp_path / "out.obj").read_bytes().startswith(b"usemtl \xff\xe9\nv ")


@pytest.mark.parametrize(
    "vertices",
    [
        "v 0 0 0 1\nv 1 0 0 1\nv 0 1 0 0.5\n",
        "v 0 0 0 1 0 0.25\nv 1 0 0 0 1 0\nv 0 1 0 0 0 1\n",
        "v 0 0 0 1 0 0.25\nv 1 0 0\nv 0 1 0 0 0 1\n",
        "v 0 0 0 1 0.1 0.2 0.3 0.4\nv 1 0 0 1\nv 0 1 0\n",
    ],
)
def test_vertex_weights_and_colours_are_written_back(put, tmp_path, vertices):
    mesh = io.read_mesh(put(vertices + "f 1 2 3\n"))
    io.write_map(tmp_path / "out.obj", mesh, mesh.V[:, :2])
    again = io.read_mesh(tmp_path / "out.obj")
    assert bits(again.V) == bits(mesh.V) == bits([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    assert bits(again.extra) == bits(mesh.extra)
    lines = [line.split() for line in (tmp_path / "out.obj").read_text().splitlines()]
    assert [len(line) for line in lines if line[0] == "v"] == [len(v.split()) for v in vertices.splitlines()]


def test_a_third_texture_coordinate_is_dropped(put):
    mesh = io.read_mesh(put(SQUARE + SQUARE_VT.replace("\n", " 0.5\n") + "f 1/1 2/2 3/3\n"))
    assert mesh.vt.tolist() == [[0, 0], [2, 0], [2, 2], [0, 2]]


@pytest.mark.slow
def test_long_runs_of_faces_are_written_in_order(tmp_path):
    F = np.random.default_rng(0).integers(0, 50, (150_000, 3))
    mesh = MeshData(np.zeros((50, 3)), F, statements=b"g a\ng b\n", statement_faces=np.array([99_999, 150_000]))
    io.write_obj(tmp_path / "out.obj", mesh)
    again = io.read_mesh(tmp_path / "out.obj")
    assert same(mesh, again)
    assert both_readers_agree(tmp_path / "out.obj")


@settings(max_examples=60, deadline=None)
@given(arrays(np.float64, (4, 3), elements=finite), arrays(np.float64, (4, 2), elements=finite))
def test_every_double_is_preserved(tmp_path_factory, V, uv):
    folder = tmp_path_factory.getbasetemp()
    mesh = MeshData(V, SQUARE_F)
    for suffix in (".obj", ".off"):
        io.write_map(folder / f"double{suffix}", mesh, uv)
        again = io.read_mesh(folder / f"double{suffix}")
        assert again.F.tolist() == SQUARE_F
        assert bits(io.map_of(again)) == bits(uv)
        if suffix == ".obj":
            assert bits(again.V) == bits(V)


@pytest.mark.parametrize("size", [np.finfo(np.float64).max, 1.0, 5e-324])
def test_planar_meshes_of_any_size(size):
    flat = size * np.array([[-1.0, 0, 1], [1, 0, 1], [1, 1, 1]])
    assert is_planar(flat)
    # Rotated to its edge.
    assert not is_planar(flat[:, [1, 2, 0]])


def test_inputs_of_other_types_are_accepted_and_not_changed(tmp_path):
    V = np.asfortranarray(np.random.default_rng(1).random((4, 3)).astype(np.float32))
    F = np.array(SQUARE_F, dtype=np.int32)[:, ::-1]
    uv = np.random.default_rng(2).random((8, 2)).astype(np.float32)[::2]
    before = V.copy(), F.copy(), uv.copy()
    io.write_map(tmp_path / "out.obj", MeshData(V, F), uv)
    again = io.read_mesh(tmp_path / "out.obj")
    assert np.array_equal(again.V, V)
    assert np.array_equal(again.F, F)
    assert np.array_equal(io.map_of(again), uv)
    assert all(np.array_equal(a, b) for a, b in zip(before, (V, F, uv), strict=True))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: MeshData(np.zeros((3, 4)), [[0, 1, 2]]), r"V must have shape \(n, 2\) or \(n, 3\), not \(3, 4\)"),
        (lambda: MeshData(np.full((3, 3), np.nan), [[0, 1, 2]]), "V is not finite at vertices 0, 1, 2"),
        (lambda: MeshData(np.zeros((3, 3)), [[0, 1, 3]]), "F refers to vertex 3, but there are only vertices 0 … 2"),
        (lambda: MeshData(np.zeros((3, 3)), [[0, 1, -1]]), "F refers to vertex -1, but"),
        (
            lambda: MeshData(np.zeros((3, 3)), [[0, 1, 2, 0]]),
            r"F must have shape \(f, 3\), triangles only, not \(1, 4\)",
        ),
        (lambda: MeshData(np.zeros((3, 3)), [[0.0, 1.0, 2.0]]), "F must contain integer indices, not float64"),
        (
            lambda: MeshData(np.zeros((3, 3)), [[0, 1, 2]], vt=[[0, 0]], FT=[[0, 0, 1]]),
            "FT refers to row 1, but there are only rows 0 … 0",
        ),
        (lambda: MeshData(np.zeros((3, 3)), [[0, 1, 2]], vt=[[0, 0, 0]]), r"vt must have shape \(n, 2\), not \(1, 3\)"),
        (
            lambda: MeshData(np.zeros((3, 3)), [[0, 1, 2]]).with_map(np.zeros((2, 2))),
            r"uv must have shape \(3, 2\), one position for each vertex, not \(2, 2\)",
        ),
        (
            lambda: MeshData(np.zeros((3, 3)), [[0, 1, 2]]).with_map([[0, 0], [np.inf, 0], [0, 0]]),
            "uv is not finite at vertex 1",
        ),
    ],
)
def test_arrays_that_are_not_a_mesh(make, message):
    with pytest.raises(ValueError, match=message):
        make()


# The map in a mesh


def test_map_without_seams(put):
    shared = io.read_mesh(put(SQUARE + SQUARE_VT + "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"))
    assert io.map_of(shared).tolist() == [[0, 0], [2, 0], [2, 2], [0, 2]]
    # The same coordinates with another index are the same position.
    doubled = io.read_mesh(put(SQUARE + SQUARE_VT + "vt -0 0\nf 1/1 2/2 3/3\nf 1/5 3/3 4/4\n"))
    assert io.map_of(doubled).tolist() == io.map_of(shared).tolist()


def test_map_with_seams_is_rejected_with_a_vertex(put):
    seams = io.read_mesh(put(SQUARE + SQUARE_VT + "vt 5 5\nvt 6 5\nf 1/1 2/2 3/3\nf 1/5 3/6 4/4\n"))
    with pytest.raises(MeshFileError, match=r"more than one pair of texture coordinates for vertices 0, 2 \(0-based\)"):
        io.map_of(seams)
    uv, seam = io.vertex_places(seams)
    assert seam.tolist() == [True, False, True, False]
    assert uv[[1, 3]].tolist() == [[2, 0], [0, 2]]
    V, F, places = io.cut_at_seams(seams)
    assert F.tolist() == [[0, 1, 2], [4, 5, 3]]
    assert np.array_equal(V, seams.V[[0, 1, 2, 3, 0, 2]])
    assert np.array_equal(places[F], seams.vt[seams.FT])


def test_rounding_in_z_leaves_a_mesh_planar(put):
    mesh = io.read_mesh(put(SQUARE.replace("v 1 1 0", "v 1 1 1e-17") + "f 1 2 3\nf 1 3 4\n"))
    assert (mesh.V[:, 2] != 0).any()
    assert np.array_equal(io.map_of(mesh), mesh.V[:, :2])
    with pytest.raises(MeshFileError, match="is not planar"):
        io.map_of(io.read_mesh(put(SQUARE.replace("v 1 1 0", "v 1 1 1e-3") + "f 1 2 3\nf 1 3 4\n")))


def test_map_of_some_faces_only_is_rejected(put):
    with pytest.raises(MeshFileError, match=r"face 1 \(0-based\) without texture coordinates"):
        io.map_of(io.read_mesh(put(SQUARE + SQUARE_VT + "f 1/1 2/2 3/3\nf 1 3 4\n")))


def test_a_vertex_without_a_face_has_no_position(put):
    uv = io.map_of(io.read_mesh(put(SQUARE + SQUARE_VT + "f 1/1 2/2 3/3\n")))
    assert np.isnan(uv).tolist() == [[False] * 2] * 3 + [[True] * 2]


def test_positions_are_the_map_of_a_planar_mesh(put):
    planar = io.read_mesh(put(SQUARE.replace(" 0\n", " 7\n") + "f 1 2 3\n"))
    assert io.map_of(planar).tolist() == [[0, 0], [1, 0], [1, 1], [0, 1]]
    with pytest.raises(MeshFileError, match="no texture coordinates and is not planar"):
        io.map_of(io.read_mesh(put(SQUARE + "v 0 0 1\nf 1 2 3\nf 1 2 5\n")))
    # Flat surfaces of the cortex have vertices outside the map.
    assert io.map_of(io.read_mesh(put(SQUARE + "v 0 0 1\nf 1 2 3\n"))).shape == (5, 2)


# OFF


@pytest.mark.parametrize(
    "text",
    [
        "OFF\n4 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n",
        "OFF 4 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3",
        "# c\nOFF\n# c\n\n4 2\n0 0 0\n1 0 0 # c\n\n1 1 0\n0 1 0\n3 0 1 2 # c\n3 0 2 3\n\n",
        "OFF\r\n4 2 0\r\n0 0 0\r\n1 0 0\r\n1 1 0\r\n0 1 0\r\n3 0 1 2\r\n3 0 2 3\r\n",
        "OFF\n4 2 0\n 0 0  0\n1\t0 0 \n1 1 0\n0 1 0\n3  0 1 2 255 0 0\n3 0 2 3 7\n",
        "COFF\n4 2 0\n0 0 0 1 0 0 1\n1 0 0 1 0 0 1\n1 1 0 1 0 0 1\n0 1 0 1 0 0 1\n3 0 1 2\n3 0 2 3\n",
    ],
)
def test_off(put, text):
    mesh = io.read_mesh(put(text, "mesh.off"))
    assert mesh.V.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert mesh.F.tolist() == SQUARE_F


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "'' and not OFF at line 1"),
        ("4OFF\n1 1 0\n", "'4OFF' and not OFF at line 1"),
        ("OFF BINARY\n", "no counts of vertices and faces at line 1"),
        ("OFF\n", "no counts of vertices and faces at line 1"),
        ("OFF\n3\n", "no counts of vertices and faces at line 2"),
        ("OFF\nx 1 0\n", "no counts of vertices and faces: 'x' is not an integer at line 2"),
        ("OFF\n-1 1 0\n", "has -1 vertices and 1 faces at line 2"),
        ("OFF\n0 0 0\n", "has 0 vertices and 0 faces at line 2"),
        (f"OFF\n{10**30} 1 0\n", "far too large at line 2"),
        (f"OFF\n{10**17} {10**17} 0\n0 0 0\n", f"ends after 1 of {10**17} vertices and 0 of {10**17} faces"),
        ("OFF\n3 1 0\n0 0 0\n1 0\n0 1 0\n3 0 1 2\n", "a vertex with fewer than three coordinates at line 4"),
        ("OFF\n3 1 0\n0 0 0\n1 0 nan\n0 1 0\n3 0 1 2\n", "'nan' is not a finite number at line 4"),
        (
            "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n4 0 1 2 0\n",
            "face with 4 corners that uses a vertex twice at line 6; remove the rep",
        ),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1\n", "face of 3 corners lists only 2 at line 6"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n", "index 3, but the file has 3 vertices at line 6"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 -1\n", "index -1, but the file has 3 vertices at line 6"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 x\n", "'x' is not an integer at line 6"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n3 0 1 2\n", "more follows the 1 faces at line 7"),
    ],
)
def test_malformed_off_is_named_with_its_line(put, text, message):
    with pytest.raises(MeshFileError) as caught:
        io.read_mesh(put(text, "mesh.off"))
    assert message in str(caught.value)


def test_off_keeps_vertices_that_no_face_uses(tmp_path):
    mesh = MeshData(np.arange(12).reshape(4, 3), [[0, 1, 3]])
    io.write_map(tmp_path / "out.off", mesh, [[0, 0], [1, 0], [9, 9], [0, 1]])
    text = (tmp_path / "out.off").read_text()
    assert text == "OFF\n4 1 0\n0.0 0.0 0.0\n1.0 0.0 0.0\n9.0 9.0 0.0\n0.0 1.0 0.0\n3 0 1 3\n"


# Problems


FAN = (
    "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv .5 .5 1\n"
    "vt 0 0\nvt 2 0\nvt 2 2\nvt 0 2\nvt 1.5 0.25\n"
    "f 1/1 2/2 5/5\nf 2/2 3/3 5/5\nf 3/3 4/4 5/5\nf 4/4 1/1 5/5\n"
)


def test_without_handles_the_boundary_is_fixed(put, tmp_path):
    for source in (put(FAN, "input.obj"), tmp_path):
        V, F, fixed, target = io.read_problem(source)
        assert (V.shape, F.shape, fixed.tolist()) == ((5, 3), (4, 3), [0, 1, 2, 3])
        assert target.tolist() == [[0, 0], [2, 0], [2, 2], [0, 2]]


def test_handles_may_pin_the_interior(put, tmp_path):
    put(FAN, "input.obj")
    handles = put("# pins\n3\n4\n\n 0 # corner\r\n1\n2", "handles.txt")
    for problem in (io.read_problem(tmp_path), io.read_problem(tmp_path / "input.obj", handles)):
        assert problem.fixed.tolist() == [3, 4, 0, 1, 2]
        assert problem.target.tolist() == [[0, 2], [1.5, 0.25], [0, 0], [2, 0], [2, 2]]
    # A mesh file named directly is used without the handles file next to it.
    assert io.read_problem(tmp_path / "input.obj").fixed.tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0\n1\n5\n", "vertex 5 of a mesh with 5 at line 3; indices count from 0"),
        ("0\n-1\n", "vertex -1 of a mesh with 5 at line 2"),
        ("0\n1\n\n1\n", "vertex 1, already named at line 2, again at line 4"),
        ("0\n1 2\n", "'1 2' is not an integer at line 2; give one vertex index per line"),
        ("1.0\n", "'1.0' is not an integer at line 1"),
        (f"{10**30}\n", "far too large at line 1"),
        ("# none\n\n", "lists no vertices"),
        (b"\xff\xfe0\0", "UTF-16"),
        (b"0\n\0", "a NUL byte at line 2"),
    ],
)
def test_malformed_handles_are_named_with_their_line(put, text, message):
    with pytest.raises(MeshFileError) as caught:
        io.read_handles(put(text, "handles.txt"), 5)
    assert message in str(caught.value)


def test_problems_without_target_positions(put, tmp_path):
    with pytest.raises(MeshFileError, match="the fixed vertices have no target positions"):
        io.read_problem(put(SQUARE + "f 1 2 3\nf 1 3 4\n"))
    with pytest.raises(MeshFileError, match="no such file"):
        io.read_problem(tmp_path)
    pinned = put("3\n", "handles.txt")
    with pytest.raises(MeshFileError, match=r"no texture coordinates for the fixed vertex 3 \(0-based\)"):
        io.read_problem(put(SQUARE + SQUARE_VT + "f 1/1 2/2 3/3\n"), pinned)
    torn = put(SQUARE + SQUARE_VT + "vt 5 5\nf 1/1 2/2 3/3\nf 1/5 3/3 4/4\n")
    with pytest.raises(MeshFileError, match=r"more than one pair of texture coordinates for the fixed vertex 0 "):
        io.read_problem(torn)
    assert io.read_problem(torn, pinned).target.tolist() == [[0, 2]]
    closed = "f 1/1 3/3 2/2\nf 1/1 2/2 4/4\nf 2/2 3/3 4/4\nf 3/3 1/1 4/4\n"
    with pytest.raises(MeshFileError, match="no boundary"):
        io.read_problem(put(SQUARE + SQUARE_VT + closed))


# Writing whole files


def left_in(folder):
    return sorted(p.name for p in folder.iterdir())


def test_write_whole(tmp_path):
    path = tmp_path / "file"
    io.write_whole(path, b"one")
    assert path.read_bytes() == b"one"
    io.write_whole(str(path), lambda file: file.write(b"two"))
    assert path.read_bytes() == b"two"
    assert left_in(tmp_path) == ["file"]


def in_use(attempts):
    """Return a function that replaces a file after some attempts while another program has it open."""
    error = PermissionError(13, "Access is denied")
    error.winerror = 5
    errors = [error] * attempts

    def replace(old, new, move=os.replace):
        if errors:
            raise errors.pop()
        move(old, new)

    return replace


def test_a_file_that_another_program_has_open_is_tried_again(tmp_path, monkeypatch):
    path = tmp_path / "file"
    path.write_bytes(b"old")
    monkeypatch.setattr(os, "replace", in_use(3))
    io.write_whole(path, b"new")
    assert path.read_bytes() == b"new"
    monkeypatch.setattr(atomic, "PATIENCE", 0.1)
    monkeypatch.setattr(os, "replace", in_use(1000))
    with pytest.raises(FileInUseError, match="another program has it open"):
        io.write_whole(path, b"newer")
    assert path.read_bytes() == b"new"
    assert left_in(tmp_path) == ["file"]


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyError("x"), KeyboardInterrupt()])
def test_failure_keeps_the_old_file(tmp_path, error):
    path = tmp_path / "file"

    def fail(file):
        file.write(b"half")
        raise error

    expected = OutputError if isinstance(error, OSError) else type(error)
    for before in ([], ["file"]):
        with pytest.raises(expected):
            io.write_whole(path, fail)
        assert left_in(tmp_path) == before
        path.write_bytes(b"old")
    assert path.read_bytes() == b"old"


def test_paths_that_cannot_be_written(tmp_path):
    mesh = MeshData([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]])
    (tmp_path / "folder.obj").mkdir()
    (tmp_path / "file").write_bytes(b"")
    for path, message in (
        (tmp_path / "none" / "a.obj", "there is no directory"),
        (tmp_path / "file" / "a.obj", "there is no directory|Not a directory"),
        (tmp_path / "folder.obj", "it is a directory"),
        *([(tmp_path / ("x" * 5000 + ".obj"), "cannot write")] if os.name == "posix" else []),
        ("a\0b.obj", "cannot write"),
    ):
        with pytest.raises(OutputError, match=message):
            io.write_map(path, mesh, mesh.V[:, :2])
        with pytest.raises(OutputError, match=message):
            io.check_output(path)
    io.check_output(tmp_path / "new.obj")
    assert left_in(tmp_path) == ["file", "folder.obj"]


@posix
def test_devices_are_not_replaced():
    with pytest.raises(OutputError, match="not a regular file"):
        io.write_whole("/dev/null", b"")
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)


@posix
def test_permissions_and_links_are_preserved(tmp_path):
    path, link = tmp_path / "file", tmp_path / "link"
    old = os.umask(0o027)
    try:
        io.write_whole(path, b"new")
    finally:
        os.umask(old)
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    path.chmod(0o604)
    link.symlink_to(path)
    io.write_whole(link, b"newer")
    assert stat.S_IMODE(path.stat().st_mode) == 0o604
    assert link.is_symlink()
    assert path.read_bytes() == b"newer"


def test_write_protection_is_respected(tmp_path, monkeypatch):
    path = tmp_path / "file"
    path.write_bytes(b"old")
    # The error that a user without root rights would get.
    monkeypatch.setattr(os, "access", lambda place, mode: Path(place) != path)
    with pytest.raises(OutputError, match="write-protected"):
        io.write_whole(path, b"new")
    monkeypatch.setattr(os, "access", lambda place, mode: False)
    with pytest.raises(OutputError, match="is not writable"):
        io.write_whole(path, b"new")
    assert path.read_bytes() == b"old"


@posix
def test_a_full_disk_keeps_the_old_file(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"old")
    script = f"""
import resource
from quasiharmonic.io import OutputError, write_whole
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
try:
    write_whole({str(path)!r}, b"x" * 1_000_000)
except OutputError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout.startswith(f"cannot write {path}: ")
    assert left_in(tmp_path) == ["file"]
    assert path.read_bytes() == b"old"


@pytest.mark.slow
@posix
def test_kill_9_leaves_the_complete_old_or_new_file(tmp_path):
    path = tmp_path / "mesh.obj"
    script = f"""
import numpy as np
from quasiharmonic.io import MeshData, write_map
F = np.arange(3 * 3000).reshape(-1, 3)
mesh = MeshData(np.ones((9000, 3)), F)
print("ready", flush=True)
for k in range(10**9):
    write_map({str(path)!r}, mesh, np.full((9000, 2), k + 1 / 3))
"""
    io.write_map(path, MeshData(np.ones((9000, 3)), [[0, 1, 2]]), np.zeros((9000, 2)))
    rng = np.random.default_rng()
    for _ in range(5):
        with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE) as process:
            assert process.stdout.readline() == b"ready\n"
            time.sleep(rng.uniform(0, 0.15))
            process.send_signal(signal.SIGKILL)
        mesh = io.read_mesh(path)
        assert len(mesh.F) in (1, 3000)
        assert mesh.vt.shape == (9000, 2)
        assert np.all(mesh.vt == mesh.vt[0, 0])


def test_import_is_light():
    script = "import sys, quasiharmonic.io; print(*sorted({m.split('.')[0] for m in sys.modules}))"
    done = subprocess.run([sys.executable, "-W", "error", "-c", script], capture_output=True, text=True)
    assert not {"numpy", "scipy", "matplotlib", "meshio", "trimesh"} & set(done.stdout.split())
    script = "import sys; from quasiharmonic.io import *; print(*sorted({m.split('.')[0] for m in sys.modules}))"
    done = subprocess.run([sys.executable, "-W", "error", "-c", script], capture_output=True, text=True)
    assert "numpy" in done.stdout.split()
    assert not {"scipy", "matplotlib", "meshio", "trimesh"} & set(done.stdout.split())


def test_problems_in_every_combination_of_formats(tmp_path):
    V, F, fixed, target = star_problem()
    path, out = tmp_path / "star" / "input.obj", tmp_path / "out.obj"
    write_problem(path.parent, V, F, fixed, target)
    assert both_readers_agree(path)
    mesh = io.read_mesh(path)
    assert all(map(np.array_equal, io.read_problem(path.parent), (V, F, fixed, target)))
    uv = io.map_of(mesh)
    assert np.array_equal(uv[fixed], target)
    moved = uv + np.random.default_rng(0).normal(size=uv.shape)
    io.write_map(out, mesh, moved)
    # Written as plain text, without the library.
    found = written(out)
    assert bits(found.uv) == bits(moved)
    assert np.array_equal(found.F, F)
    again = io.read_mesh(out)
    assert bits(again.V) == bits(found.V) == bits(V)
    assert bits(io.map_of(again)) == bits(moved)


@pytest.mark.parametrize(
    ("text", "rows"),
    [
        ("1,2.5,-3e-2\n", [[1, 2.5, -0.03]]),
        ("1 2.5\t-.03\r\n2 1. +4\n", [[1, 2.5, -0.03], [2, 1, 4]]),
        ("1;2,5;-0,03\n", [[1, 2.5, -0.03]]),
        ("vertex,x,y\n# a comment\n\n1,2.5D0,-3d-02 # another\n", [[1, 2.5, -0.03]]),
        ("\ufeffvertex;x;y\n1; 2,5; -3,0E-2\n", [[1, 2.5, -0.03]]),
    ],
)
def test_rows_of_numbers_in_every_usual_notation(tmp_path, text, rows):
    path = tmp_path / "rows.csv"
    path.write_text(text, encoding="utf-8", newline="")
    assert [values for _, values in read_rows(path, 3)] == rows


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1,2\n", "not 3 numbers: '1,2' at line 1"),
        ("1,2,3\n1,2,3,4\n", "not 3 numbers: '1,2,3,4' at line 2"),
        ("1,2,nan\n", "'nan' is not a finite number"),
        ("1,2,3\nx,y,z\n", "'x' is not a finite number at line 2"),
        ("1,2,1_0\n", "'1_0' is not a finite number"),
        ("1,2,3d\n", "'3d' is not a finite number"),
        ("1;2.5;3;\n", "not 3 numbers"),
    ],
)
def test_rows_with_other_contents(tmp_path, text, words):
    path = tmp_path / "rows.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(MeshFileError, match=re.escape(words)):
        read_rows(path, 3)


def test_fortran_exponents_in_a_mesh(tmp_path):
    path = tmp_path / "m.obj"
    path.write_text("v 0 0 0\nv 1.0D+00 0 0\nv 0 5d-1 0\nf 1 2 3\n")
    assert io.read_mesh(path).V.tolist() == [[0, 0, 0], [1, 0, 0], [0, 0.5, 0]]
