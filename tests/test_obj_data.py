"""Materials, groups and other data of an OBJ file are written back, every double to the last bit."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from quasiharmonic import io
from quasiharmonic.io import MeshData
from quasiharmonic.io.models.mesh_maps import is_planar
from shared.obj_files import SQUARE, SQUARE_F, SQUARE_VT, bits, both_readers_agree, same

# Every finite double; hypothesis prefers difficult ones.
finite = st.floats(allow_nan=False, allow_infinity=False)


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


@pytest.mark.long
def test_long_runs_of_faces_are_written_in_order(tmp_path):
    F = np.random.default_rng(0).integers(0, 50, (150_000, 3))
    mesh = MeshData(np.zeros((50, 3)), F, statements=b"g a\ng b\n", statement_faces=np.array([99_999, 150_000]))
    io.write_obj(tmp_path / "out.obj", mesh)
    again = io.read_mesh(tmp_path / "out.obj")
    assert same(mesh, again)
    assert both_readers_agree(tmp_path / "out.obj")


@pytest.mark.slow
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
