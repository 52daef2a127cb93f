"""Faces with more than three corners: their triangulation, and reading and writing them."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quasiharmonic import io, refine
from quasiharmonic.geometry.exact.triangles import find_inverted_fans
from quasiharmonic.geometry.mesh.polygons import triangulate_polygons
from quasiharmonic.io import MeshFileError
from quasiharmonic.ui.cli import main
from shared.examples import examples


def rings(polygons):
    return np.concatenate([np.asarray(p) for p in polygons]), np.cumsum([0, *map(len, polygons)])


def triangles(V, polygons):
    V = np.asarray(V, dtype=float)
    vertices, starts = rings(polygons)
    T, found = triangulate_polygons(np.column_stack([V, np.zeros((len(V), 3 - V.shape[1]))]), vertices, starts)
    return vertices[T], found


def areas(V, F):
    a, b, c = np.asarray(V, dtype=float)[F, :2].swapaxes(0, 1)
    return 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])


class TestTriangulation:
    def test_a_quad_that_is_not_convex_is_cut_at_its_reflex_corner(self):
        V = [[0, 0], [2, 1], [0, 2], [0.5, 1]]
        for turn in range(4):
            F, _ = triangles(V, [np.roll([0, 1, 2, 3], turn)])
            assert areas(V, F).min() > 0
            assert all(3 in t for t in F.tolist())

    def test_collinear_corners_make_no_flat_triangle(self):
        V = [[0, 0], [1, 0], [2, 0], [3, 0], [3, 1], [3, 2], [1.5, 3]]
        for turn in range(7):
            F, _ = triangles(V, [np.roll(range(7), turn)])
            assert areas(V, F).min() > 0.1
            assert areas(V, F).sum() == pytest.approx(6.0)

    @pytest.mark.long
    @examples(40)
    @given(st.integers(4, 60), st.integers(0, 10**6))
    def test_a_star_shaped_polygon_is_triangulated_without_inversion(self, size, seed):
        rng = np.random.default_rng(seed)
        angle = 2 * np.pi * (np.arange(size) + 0.9 * rng.random(size)) / size
        V = (np.exp(0.7 * rng.normal(size=size)) * np.exp(1j * angle)).view(float).reshape(-1, 2)
        if size < 6:
            V = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        F, found = triangles(V, [range(size)])
        ahead = np.roll(V, -1, axis=0)
        assert areas(V, F).min() > 0
        assert areas(V, F).sum() == pytest.approx(0.5 * (V[:, 0] * ahead[:, 1] - V[:, 1] * ahead[:, 0]).sum())
        assert np.array_equal(F.ravel()[found.corners], range(size))

    def test_position_rotation_and_size_do_not_matter(self):
        rng = np.random.default_rng(3)
        V = rng.normal(size=(8, 3)) * [1, 1, 0.2]
        quads = [[0, 1, 2, 3], [4, 5, 6, 7]]
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        turn *= np.sign(np.linalg.det(turn))
        F, _ = triangles(V, quads)
        for scale in (1e-150, 1.0, 1e150):
            assert np.array_equal(triangles((V @ turn) * scale, quads)[0], F)

    def test_rings_and_diagonals(self):
        V = [[0, 0], [1, 0], [2, 0], [2, 1], [1, 1.2], [0, 1]]
        F, found = triangles(V, [[0, 1, 4, 5], [1, 2, 3], [1, 3, 4]])
        assert len(found) == 3
        assert found.sizes.tolist() == [4, 3, 3]
        assert found.of_triangle.tolist() == [0, 0, 1, 2]
        assert F.ravel()[found.corners].tolist() == [0, 1, 4, 5, 1, 2, 3, 1, 3, 4]
        assert found.diagonals(F).tolist() in ([[0, 4]], [[1, 5]])

    def test_a_polygon_without_area_still_has_triangles(self):
        F, _ = triangles([[0, 0], [1, 1], [2, 2], [3, 3]], [[0, 1, 2, 3]])
        assert F.shape == (2, 3)

    @pytest.mark.parametrize("far", [np.inf, np.nan, 1e200])
    def test_corners_out_of_range_are_triangulated_somehow(self, far):
        V = np.array([[far, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
        T, _ = triangulate_polygons(V, np.arange(4), np.array([0, 4]))
        assert T.shape == (2, 3)

    def test_a_ring_that_repeats_a_vertex_is_named(self):
        with pytest.raises(ValueError, match="face 1 with a vertex twice"):
            triangles(np.eye(4)[:, :2], [[0, 1, 2, 3], [0, 1, 2, 1]])


CUBE = """mtllib cube.mtl
v -1 -1 -1
v 1 -1 -1
v 1 1 -1
v -1 1 -1
v -1 -1 1
v 1 -1 1
v 1 1 1
v -1 1 1
vt 0 0
vt 1 0
vt 1 1
vt 0 1
vt 0.25 0.75
vn 0 0 1
usemtl red
f 1/1/1 4/2/1 3/3/1 2/4/1
f 5/1/1 6/2/1 7/3/1 8/4/1
g sides
f 1/1/1 2/2/1 6/3/1 5/4/1
usemtl blue
f 2/1/1 3/2/1 7/3/1 6/4/1
f 3/1/1 4/2/1 8/3/1 7/4/1
f -8/1/1 5/2/1 8/3/1 -5/4/1
"""


class TestFiles:
    def test_a_cube_of_quads_is_read_back(self, tmp_path):
        (tmp_path / "cube.obj").write_text(CUBE)
        mesh = io.read_mesh(tmp_path / "cube.obj")
        assert mesh.F.shape == (12, 3)
        assert mesh.faces == 6
        io.write_obj(tmp_path / "again.obj", mesh)
        lines = (tmp_path / "again.obj").read_text().replace(".0", "")
        assert lines == CUBE.replace("f -8/1/1 5/2/1 8/3/1 -5/4/1", "f 1/1/1 5/2/1 8/3/1 4/4/1")
        again = io.read_mesh(tmp_path / "again.obj")
        assert np.array_equal(again.F, mesh.F)
        assert np.array_equal(again.FT, mesh.FT)

    def test_faces_of_any_size(self, tmp_path):
        text = "".join(f"v {x} {y} 0\n" for x, y in [(0, 0), (1, 0), (2, 0), (2, 1), (1, 1), (0, 1), (3, 1)])
        text += "f 1 2 5 6\nf 2 3 4\nf 2 4 5\n# between\nf 3 7 4\n"
        (tmp_path / "mixed.obj").write_text(text)
        mesh = io.read_mesh(tmp_path / "mixed.obj")
        assert mesh.faces == 4
        assert mesh.F.shape == (5, 3)
        io.write_obj(tmp_path / "again.obj", mesh)
        assert (tmp_path / "again.obj").read_text().replace(".0", "") == text

    def test_the_fast_reader_and_the_general_one_agree(self, tmp_path):
        (tmp_path / "quick.obj").write_text(CUBE.replace("-8", "1").replace("-5", "4"))
        (tmp_path / "careful.obj").write_text(CUBE)
        quick, careful = (io.read_mesh(tmp_path / name) for name in ("quick.obj", "careful.obj"))
        for name in ("V", "F", "vt", "FT", "FN"):
            assert np.array_equal(getattr(quick, name), getattr(careful, name))
        assert np.array_equal(quick.polygons.corners, careful.polygons.corners)

    def test_unchanged_lines_stay_as_they_were(self, tmp_path):
        text = "v 0 0 0\r\nv 1.00 0 0\r\nv 0 1e0 0\r\nvt 0.50 0 0\r\nvt 1 0 0.25\r\nvt 0 1.000\r\nf 1/1 2/2 3/3\r\n"
        (tmp_path / "a.obj").write_bytes(text.encode())
        mesh = io.read_mesh(tmp_path / "a.obj")
        io.write_obj(tmp_path / "b.obj", mesh)
        assert (tmp_path / "b.obj").read_bytes() == text.encode()
        uv = mesh.vt.copy()
        uv[1] = 2, 3
        io.write_obj(tmp_path / "b.obj", mesh.with_map(uv))
        assert (tmp_path / "b.obj").read_bytes() == text.replace("vt 1 0 0.25", "vt 2.0 3.0").encode()

    def test_off(self, tmp_path):
        text = "OFF\n5 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n2 0 0\n4 0 1 2 3\n3 1 4 2\n"
        (tmp_path / "a.off").write_text(text)
        mesh = io.read_mesh(tmp_path / "a.off")
        assert (mesh.faces, len(mesh.F)) == (2, 3)
        io.write_off(tmp_path / "b.off", mesh)
        assert (tmp_path / "b.off").read_text().replace(".0", "") == text

    @pytest.mark.parametrize(
        ("face", "words"),
        [
            ("f 1 2 3 2", "face with 4 corners that uses a vertex twice at line 5"),
            ("f 1 2", "face with 2 corners at line 5; a triangle has 3"),
            ("f 1 2 3 9", "index 9, but the file has 4 vertices at line 5"),
        ],
    )
    def test_invalid_polygons_are_named_with_their_line(self, tmp_path, face, words):
        (tmp_path / "bad.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n" + face + "\n")
        with pytest.raises(MeshFileError, match=words):
            io.read_mesh(tmp_path / "bad.obj")

    def test_a_split_polygon_becomes_triangles(self, tmp_path):
        (tmp_path / "cube.obj").write_text(CUBE)
        mesh = io.read_mesh(tmp_path / "cube.obj")
        (diagonal, *_) = mesh.polygons.diagonals(mesh.F)
        split = refine(mesh.V, mesh.F, [diagonal])
        new, parent = io.refined_mesh(mesh, split, np.zeros((len(mesh.V), 2)))
        assert new.faces == 6 - 1 + 4
        assert sorted(new.polygons.sizes.tolist()) == [3] * 4 + [4] * 5
        io.write_obj(tmp_path / "new.obj", new)
        text = (tmp_path / "new.obj").read_text()
        assert text.count("\nf ") == 9
        again = io.read_mesh(tmp_path / "new.obj")
        assert np.array_equal(np.sort(again.F, axis=None), np.sort(new.F, axis=None))
        # The two materials and the group are still before the same faces.
        before = [line for line in text.splitlines() if line.startswith(("usemtl", "g ", "f "))]
        counts = np.diff([i for i, line in enumerate(before) if not line.startswith("f ")] + [len(before)]) - 1
        assert counts.sum() == 9
        assert counts.min() >= 1
        assert len(parent) == 12 + 2


@pytest.mark.parametrize("turn", range(4))
def test_faces_that_a_reader_splits_into_inverted_triangles_are_named(tmp_path, capsys, turn):
    # In the plane the quadrilateral has a reflex corner at (0.4, 0.4). On the surface the diagonal there is shorter.
    places = np.array([[0, 0], [1, 0], [0.4, 0.4], [0, 1]])
    points = np.array([[0, 0, 0], [2, 0, 0], [0.5, 0.5, 0], [0, 2, 0]])
    ring = np.roll(np.arange(1, 5), -turn)
    lines = ["v {} {} {}\n".format(*at) for at in points] + ["vt {} {}\n".format(*at) for at in places]
    path = tmp_path / "m.obj"
    path.write_text("".join([*lines, "f " + " ".join(f"{k}/{k}" for k in ring) + "\n"]))
    mesh = io.read_mesh(path)
    fans = [[ring[0] - 1, ring[k] - 1, ring[k + 1] - 1] for k in (1, 2)]
    bent = [0] if areas(places, np.array(fans)).min() <= 0 else []
    assert bent == ([0] if turn in (1, 3) else [])
    assert find_inverted_fans(mesh.polygons, mesh.FT, mesh.vt).tolist() == bent
    assert main(["check", str(path)]) == 0
    assert ("splits faces at their first corner" in capsys.readouterr().out) == bool(bent)


@pytest.mark.parametrize(
    ("faces", "code", "words", "inverted"),
    [
        ("f 1 2 5 4\nf 2/2 3/3 6/6 5/5\n", 0, "there are no texture coordinates on face 0", []),
        ("f 1 2 5 4\nf 2/2 3/3 5/5\nf 3/3 6/1 5/5\n", 1, "1 is inverted (3)", [3]),
        # One face without coordinates, another without one of them, and two islands.
        ("f 2/2 5/5 4\nf 1/1 2/2 4/4\nf 2 5 3\nf 3/3 6/6 5/5\n", 0, "on faces 0, 2", []),
        ("f 1 2 4\nf 2/2 5/5 4/4\nf 3/3 6/6 5/5\nf 2/7 3/3 5/5\n", 1, "island at triangle 2 (2 triangles)", [3]),
    ],
)
def test_check_verifies_the_faces_that_have_texture_coordinates(tmp_path, capsys, faces, code, words, inverted):
    corners = [f"{x} {y}" for y in (0, 1) for x in (0, 1, 2)]
    path = tmp_path / "m.obj"
    path.write_text("".join([*(f"v {at} 0\n" for at in corners), *(f"vt {at}\n" for at in [*corners, "3 3"]), faces]))
    assert main(["check", str(path), "--json", "-"]) == code
    out, err = capsys.readouterr()
    assert words in err
    found = json.loads(out)
    bare = [k for k, face in enumerate(faces.splitlines()) if any("/" not in corner for corner in face.split()[1:])]
    assert found["unmapped_faces"] == bare
    assert found["inverted"] + found["degenerate"] == inverted
    assert main(["check", str(path), "--any-triangulation", "--as", "float32"]) == code


@pytest.mark.slow
def test_repair_names_faces_that_a_reader_splits_into_inverted_triangles(tmp_path, capsys):
    points, places = "v 0 0 0\nv 2 0 0\nv .5 .5 0\nv 0 2 0\n", "vt 0 0\nvt 1 0\nvt .4 .4\nvt 0 1\n"
    (tmp_path / "m.obj").write_text(points + places + "f 2/2 3/3 4/4 1/1\n")
    assert main(["repair", str(tmp_path / "m.obj"), "-o", str(tmp_path / "o.obj"), "--json", "-"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["bent_faces"] == [0]
    assert "--any-triangulation" in err
