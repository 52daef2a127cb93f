"""Topology and defects of meshes: `inspect_mesh` and ``qhm check`` of meshes without a map."""

from __future__ import annotations

import json
from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from quasiharmonic import Problem, boundary_loops, flatten, inspect_mesh, io
from quasiharmonic.io import MeshData
from quasiharmonic.surfaces import annulus, cat, disk, starfish
from quasiharmonic.ui.cli import main

TETRAHEDRON = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
OUTWARD = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])


def torus(n=8):
    """A closed surface of genus 1: (V, F)."""
    i, j = np.divmod(np.arange(n * n), n)
    around, along = 2 * np.pi * i / n, 2 * np.pi * j / n
    V = np.stack([(2 + np.cos(along)) * np.cos(around), (2 + np.cos(along)) * np.sin(around), np.sin(along)], axis=1)
    at = lambda a, b: (a % n) * n + b % n  # noqa: E731
    lower = np.stack([at(i, j), at(i + 1, j), at(i + 1, j + 1)], axis=1)
    upper = np.stack([at(i, j), at(i + 1, j + 1), at(i, j + 1)], axis=1)
    return V, np.concatenate([lower, upper])


@pytest.mark.parametrize(
    ("mesh", "expected"),
    [
        (disk(3), (1, 0, 1, 0)),
        (annulus(8), (1, 0, 2, 0)),
        (starfish(rings=8), (1, 1, 0, 0)),
        ((TETRAHEDRON, OUTWARD), (1, 1, 0, 0)),
        (torus(), (1, 1, 0, 1)),
    ],
)
def test_topology_of_clean_meshes(mesh, expected):
    report = inspect_mesh(*mesh)
    assert report.clean, report.summary()
    assert (report.components, report.closed, report.loops, report.genus) == expected
    assert report.inward == 0
    assert report.summary().endswith("no defects")


def test_components_add_up():
    V, F = torus()
    G = np.concatenate([OUTWARD, F + 4, F + 4 + len(V)])
    report = inspect_mesh(np.concatenate([TETRAHEDRON, V + 9, V - 9]), G)
    assert (report.components, report.closed, report.genus) == (3, 3, 2)


def test_closed_components_that_are_inside_out_are_counted():
    assert inspect_mesh(TETRAHEDRON, OUTWARD[:, ::-1]).inward == 1
    both = np.concatenate([OUTWARD, OUTWARD[:, ::-1] + 4])
    assert inspect_mesh(np.concatenate([TETRAHEDRON, TETRAHEDRON + 5]), both).inward == 1


def test_every_class_of_defects_is_found():
    V, F = disk(2)
    n = len(V)
    V = np.concatenate([V, [[5, 5], [6, 5], [7, 5], [9, 9], [0.1, 0.1], [-4, -4], [-5, -4]]])
    i, j = F[0, :2]
    corner = int(boundary_loops(F, n)[0][0])
    G = np.concatenate(
        [
            F,
            [[n, n, n + 1]],  # uses a vertex twice
            [F[3]],  # repeated, which also gives its edges more than two triangles or mixed winding
            [[n, n + 1, n + 2]],  # no area
            [[j, i, n + 4]],  # a third triangle at an edge
            [[corner, n + 5, n + 6]],  # touches the disk at a vertex
        ]
    )
    f = len(F)
    report = inspect_mesh(V, G)
    assert not report.clean
    assert report.defects["triangles that use a vertex twice"].tolist() == [f]
    assert report.defects["triangles repeated"].tolist() == [f + 1]
    assert report.defects["triangles without area"].tolist() == [f + 2]
    assert sorted((i, j)) in report.defects["edges of three or more triangles"].tolist()
    assert report.defects["vertices where surfaces touch"].tolist() == [corner]
    assert report.defects["vertices without triangle"].tolist() == [n + 3]
    text = report.summary()
    assert all(name in text for name, found in report.defects.items() if found.size)
    assert report.to_dict()["defects"]["vertices without triangle"] == [n + 3]


def test_mixed_winding_is_found():
    V, F = disk(2)
    G = F.copy()
    G[0] = G[0, ::-1]
    report = inspect_mesh(V, G)
    edges = {tuple(sorted((a, b))) for a, b in zip(F[0], np.roll(F[0], -1), strict=True)}
    assert {tuple(edge) for edge in report.defects["edges with mixed winding"].tolist()} <= edges
    assert report.defects["edges with mixed winding"].size
    assert report.components == 2


def test_coincident_vertices_are_listed_but_are_no_defect():
    V, F = disk(2)
    report = inspect_mesh(np.concatenate([V, V]), np.concatenate([F, F + len(V)]))
    assert report.clean
    assert report.coincident.tolist() == list(range(len(V), 2 * len(V)))
    assert "at the position of an earlier vertex" in report.summary()


@pytest.mark.slow
def test_any_triangles_are_accepted_and_clean_ones_are_surfaces():
    seen = Counter()

    @given(st.integers(4, 9), st.integers(1, 25), st.booleans(), st.integers(0, 2**31))
    @settings(deadline=None, max_examples=60)
    def check(n, f, sheet, seed):
        rng = np.random.default_rng(seed)
        V, F = rng.normal(size=(n, 3)), rng.integers(n, size=(f, 3))
        if sheet:
            # Random triangles are never clean; neighbouring triangles of a disk often are.
            flat, F = disk(2)
            start = rng.integers(len(F))
            vertices, F = np.unique(F[start : start + f], return_inverse=True)
            V, F = flat[vertices], F.reshape(-1, 3)
        n = len(V)

        def make_problem():
            rim = np.concatenate([np.empty(0, dtype=int), *boundary_loops(F, n)])
            return Problem(V, F, rim, np.zeros((len(rim), 2)))

        report = inspect_mesh(V, F)
        assert report.genus >= 0
        if report.clean:
            sides = np.unique(np.sort(np.concatenate([F[:, (0, 1)], F[:, (1, 2)], F[:, (2, 0)]]), axis=1), axis=0)
            euler = n - len(sides) + len(F)
            assert euler == 2 * (report.components - report.genus) - report.loops
        usable = report.clean and report.components == 1 and report.loops > 0
        seen[usable] += 1
        if usable:
            assert make_problem().n == n
        else:
            with pytest.raises(ValueError, match=r"\w"):
                make_problem()

    check()
    assert min(seen[True], seen[False]) > 10


class TestCommand:
    def check(self, capsys, path, *options):
        status = main(["check", str(path), "--json", "-", *options])
        return status, json.loads(capsys.readouterr().out)

    def test_a_clean_surface_without_a_map(self, tmp_path, capsys):
        V, F = starfish(rings=8)
        io.write_obj(tmp_path / "a.obj", MeshData(V, F))
        status, facts = self.check(capsys, tmp_path / "a.obj")
        assert status == 0
        assert facts["injective"] is None
        assert facts["mesh"]["closed_components"] == 1
        assert main(["check", str(tmp_path / "a.obj")]) == 0
        assert "no defects" in capsys.readouterr().out

    def test_a_surface_with_defects_and_without_a_map(self, tmp_path, capsys):
        V, F = cat(3)
        io.write_obj(tmp_path / "a.obj", MeshData(V, np.concatenate([F, F[:1]])))
        status, facts = self.check(capsys, tmp_path / "a.obj")
        assert status == 1
        assert facts["mesh"]["defects"]["triangles repeated"] == [len(F)]

    @pytest.mark.parametrize("option", [("--as", "float32"), ("--any-triangulation",)])
    def test_options_about_the_map_need_one(self, tmp_path, capsys, option):
        io.write_obj(tmp_path / "a.obj", MeshData(*cat(3)))
        assert main(["check", str(tmp_path / "a.obj"), *option]) == 2
        assert "has no map" in capsys.readouterr().err

    @pytest.mark.parametrize("mapped", [False, True])
    @pytest.mark.parametrize("text", [None, "", "hello\n", "99999\n"])
    def test_the_list_of_fixed_vertices_is_always_read(self, tmp_path, capsys, mapped, text):
        V, F = cat(3)
        mesh = MeshData(V, F)
        io.write_obj(tmp_path / "a.obj", mesh.with_map(flatten(V, F).uv) if mapped else mesh)
        assert main(["check", str(tmp_path / "a.obj")]) == 0
        if text is not None:
            (tmp_path / "fixed.txt").write_text(text)
        capsys.readouterr()
        assert main(["check", str(tmp_path / "a.obj"), "--fixed", str(tmp_path / "fixed.txt")]) == 2
        assert "fixed.txt" in capsys.readouterr().err

    def test_a_mesh_that_unwrap_does_not_change(self, tmp_path, capsys):
        V, F = cat(3)
        io.write_obj(tmp_path / "unused.obj", MeshData(np.vstack([V, V[:1] + 9]), F))
        assert main(["check", str(tmp_path / "unused.obj")]) == 1
        assert "qhm unwrap uses this mesh without changes." in capsys.readouterr().out

    def test_obstructions_are_named_if_the_map_is_not_injective(self, tmp_path, capsys):
        V, F = cat(3)
        uv = flatten(V, F).uv
        io.write_obj(tmp_path / "good.obj", MeshData(V, F).with_map(uv))
        io.write_obj(tmp_path / "mirrored.obj", MeshData(V, F).with_map(uv * [-1, 1]))
        status, facts = self.check(capsys, tmp_path / "good.obj")
        assert (status, facts["injective"], facts["diagnosis"]) == (0, True, None)
        status, facts = self.check(capsys, tmp_path / "mirrored.obj")
        assert (status, facts["injective"]) == (1, False)
        assert facts["diagnosis"]["forbids_injective"]


@pytest.mark.parametrize("exponent", [0, -600, 600])
def test_close_vertices_of_a_soup_are_listed_with_a_remedy(exponent):
    V, F = disk(3)
    corners = V[F].reshape(-1, 2)
    jitter = 1e-8 * np.random.default_rng(0).normal(size=corners.shape)
    soup = inspect_mesh(np.ldexp(corners + jitter, exponent), np.arange(F.size).reshape(-1, 3))
    # A vertex of the boundary may have one triangle only.
    times = np.bincount(F.ravel())
    assert soup.close.tolist() == np.flatnonzero(times[F.ravel()] > 1).tolist()
    assert f"{soup.close.size} vertices are within 1e-06" in soup.summary()
    assert "Weld these vertices with weld=1e-06." in soup.summary()
    assert not inspect_mesh(V, F).close.size


def test_separate_triangles_far_from_each_other_are_no_soup():
    V = np.array([[0, 0], [1, 0], [0, 1]]) + 2 * np.arange(5)[:, None, None]
    assert not inspect_mesh(V.reshape(-1, 2), np.arange(15).reshape(-1, 3)).close.size


@pytest.mark.slow
def test_thousands_of_vertices_at_one_position_are_close():
    """A tree of equal points takes quadratic time: minutes here."""
    V = np.random.default_rng(0).normal(size=(300_000, 3))
    V[1::3] = V[2::3] = 0
    V[0] = V[3] + 1e-9
    close = inspect_mesh(V, np.arange(len(V)).reshape(-1, 3)).close
    np.testing.assert_array_equal(close, np.flatnonzero((np.arange(len(V)) % 3 > 0) | (np.arange(len(V)) < 4)))
