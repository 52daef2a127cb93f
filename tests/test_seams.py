"""Maps with seams: islands, cuts along edges, and vertices with several texture coordinates."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import certify
from quasiharmonic.atlas import SeamedMesh
from quasiharmonic.geometry.mesh.splitting import fans
from quasiharmonic.surfaces import annulus, disk, grid, random_delaunay
from shared.meshes import lift
from shared.seam_meshes import islands, strips


class TestIslands:
    def test_one_piece_keeps_its_vertex_numbers(self):
        V, F = random_delaunay(60, seed=1)
        (one,) = islands(F, V)
        assert np.array_equal(one.F, F)
        assert np.array_equal(one.triangles, np.arange(len(F)))
        assert np.array_equal(one.vertices, np.arange(len(V)))
        assert np.array_equal(one.uv, V)

    def test_islands_of_strips_have_their_own_vertices(self):
        _, F, uv, FT, strip = strips(4)
        found = islands(F, uv, FT)
        assert len(found) == 3
        for k, island in enumerate(found):
            assert np.array_equal(island.triangles, np.flatnonzero(strip == k))
            assert np.array_equal(island.vertices[island.F], F[strip == k])
            assert np.array_equal(island.uv[island.F], uv[FT[strip == k]])
            assert np.all(np.diff(island.vertices) > 0)
            assert certify(island.F, island.uv).bijective

    def test_separate_coordinates_for_every_corner_are_no_seam(self):
        V, F = random_delaunay(60, seed=1)
        (one,) = islands(F, V[F.ravel()], np.arange(F.size).reshape(-1, 3))
        assert np.array_equal(one.F, F)
        assert np.array_equal(one.uv, V)

    def test_equal_coordinates_are_one_row_for_either_sign_of_zero(self):
        F = np.array([[0, 1, 2], [1, 0, 3]])
        uv = np.array([[0.0, 0.0], [1, 0], [0.5, 1], [-0.0, -0.0], [1, -0.0], [0.5, -1]])
        assert len(islands(F, uv, [[0, 1, 2], [4, 3, 5]])) == 1
        uv[4, 0] = np.nextafter(1, 2)
        assert len(islands(F, uv, [[0, 1, 2], [4, 3, 5]])) == 2

    def test_triangles_that_touch_at_a_vertex_are_separate(self):
        F = np.array([[0, 1, 2], [0, 3, 4]])
        found = islands(F, [[0, 0], [1, 0], [0, 1], [-1, 0], [0, -1]])
        assert [island.vertices.tolist() for island in found] == [[0, 1, 2], [0, 3, 4]]

    def test_a_seam_can_run_to_a_vertex_from_both_sides(self):
        """An open ring of triangles around a vertex, and a pinched one."""
        _, F = disk(1)
        split, component = fans(F[:-1])
        assert len(np.unique(split)) == 7
        assert not component.any()
        _, ring = disk(2)
        pinched = ring[(ring != 0).all(axis=1)].copy()
        pinched[pinched == 4] = 1
        split, component = fans(pinched)
        assert not component.any()
        assert len(np.unique(split)) == len(np.unique(pinched)) + 1

    def test_non_manifold_parts_are_separated(self):
        three_at_an_edge = [[0, 1, 2], [1, 0, 3], [0, 1, 4]]
        assert len(islands(three_at_an_edge, np.random.default_rng(0).random((5, 2)))) == 3
        wound_differently = [[0, 1, 2], [0, 1, 3]]
        assert len(islands(wound_differently, np.random.default_rng(0).random((4, 2)))) == 2

    def test_triangles_without_coordinates(self):
        V, F = grid(4, 4)
        FT = F.copy()
        FT[3] = -1
        FT[13, 1] = -1
        found = islands(F, V, FT)
        assert np.array_equal(
            np.sort(np.concatenate([island.triangles for island in found])), np.setdiff1d(np.arange(len(F)), [3, 13])
        )
        assert islands(F, V, np.full_like(F, -1)) == []

    def test_invalid_input_is_named(self):
        V, F = grid(2, 2)
        with pytest.raises(ValueError, match="FT must have as many rows as F, 8, not 7"):
            islands(F, V, F[:-1])
        with pytest.raises(ValueError, match="F refers to vertex 9, but there are only vertices 0 … 8"):
            SeamedMesh(V, np.where(np.arange(8)[:, None] == 2, 9, F), uv=V)
        with pytest.raises(ValueError, match="F refers to vertex -1, but"):
            islands(F - 1, V, F)
        with pytest.raises(ValueError, match="FT refers to row 9, but there are only rows 0 … 8"):
            islands(F, V, np.where(np.arange(8)[:, None] == 2, 9, F))
        with pytest.raises(ValueError, match="FT refers to row -2, but there are only rows 0 … 8"):
            islands(F, V, F - 2)
        with pytest.raises(ValueError, match="must contain integer"):
            islands(F, V, F.astype(float))
        with pytest.raises(ValueError, match="uv must have shape"):
            islands(F, V[:, :1])


class TestCut:
    def test_a_sheet_is_cut_along_a_line(self):
        V, F = grid(4, 3)
        line = [[k, k + 5] for k in (2, 7, 12)]
        cut = SeamedMesh(V, F).cut(line)
        assert [len(island.triangles) for island in cut.islands] == [12, 12]
        assert np.array_equal(cut.seams, line)
        assert np.array_equal(cut.V, V)
        assert np.array_equal(cut.F, F)
        # Every vertex keeps its number on one side, and the four on the line have another on the other side.
        assert np.array_equal(np.unique(cut.FT), np.arange(len(V) + 4))
        opened = cut.opened()
        assert np.array_equal(opened.V[opened.F], V[F])
        assert len(opened.V) == len(V) + 4

    def test_a_slit_that_ends_inside_splits_interior_vertices(self):
        V, F = disk(4)
        inner = 0
        spoke = [inner]
        edges = {tuple(sorted(e)) for t in F.tolist() for e in zip(t, t[1:] + t[:1], strict=True)}
        rim = set(np.unique(F[np.linalg.norm(V[F], axis=2).max(axis=1) > 0.99]).tolist())
        while not np.linalg.norm(V[spoke[-1]]) > 0.999:
            near = [b if a == spoke[-1] else a for a, b in edges if spoke[-1] in (a, b)]
            spoke.append(max(near, key=lambda v: (V[v, 0], v)))
        assert spoke[-1] in rim
        cut = SeamedMesh(V, F).cut(np.column_stack([spoke[:-1], spoke[1:]]))
        (one,) = cut.islands
        # The inner end of a slit has one position, as do its edges; every other vertex on it has two.
        assert len(one.vertices) == len(V) + len(spoke) - 1
        assert len(cut.seams) == len(spoke) - 1

    def test_edges_in_either_direction_and_repeated_edges(self):
        V, F = grid(2, 2)
        assert len(SeamedMesh(V, F).cut([[1, 4], [4, 1], [4, 7]]).islands) == 2
        assert len(SeamedMesh(V, F).cut(np.empty((0, 2), int)).islands) == 1

    def test_edges_not_in_the_mesh_are_named(self):
        V, F = grid(2, 2)
        with pytest.raises(ValueError, match=r"edge \(0, 5\): not an edge of the mesh, so it cannot be cut"):
            SeamedMesh(V, F).cut([[1, 4], [0, 5]])
        with pytest.raises(ValueError, match="edges refers to vertex 9"):
            SeamedMesh(V, F).cut([[1, 9]])

    def test_existing_seams_remain(self):
        V, F, uv, FT, _ = strips(4)
        mesh = SeamedMesh(V, F, FT, uv)
        ends = F[0][[0, 1]]
        cut = mesh.cut([ends])
        assert {tuple(e) for e in mesh.seams.tolist()} <= {tuple(e) for e in cut.seams.tolist()}
        assert cut.uv is None


class TestRows:
    def test_coordinates_of_a_cut_surface(self):
        V, F = grid(4, 3)
        cut = SeamedMesh(V, F).cut([[2, 7], [7, 12], [12, 17]])
        shifted = [V[island.vertices] + [10 * k, 0] for k, island in enumerate(cut.islands)]
        placed = cut.with_places(shifted)
        assert len(placed.islands) == 2
        assert np.array_equal(placed.seams, cut.seams)
        for k, island in enumerate(placed.islands):
            assert np.array_equal(island.uv, shifted[k])
        assert np.isfinite(placed.uv).all()

    def test_islands_that_share_a_vertex_have_their_own_rows(self):
        mesh = SeamedMesh([[0, 0], [1, 0], [0, 1], [-1, 0], [0, -1]], [[0, 1, 2], [0, 3, 4]])
        shifted = [mesh.V[island.vertices] + [10 * k, 0] for k, island in enumerate(mesh.islands)]
        placed = mesh.with_places(shifted)
        assert placed.FT.tolist() == [[0, 1, 2], [5, 3, 4]]
        assert np.array_equal(placed.uv[placed.FT], np.stack(shifted))

    def test_vertices_of_no_triangle_get_no_row(self):
        V, F = grid(2, 2)
        mesh = SeamedMesh(np.vstack([V, [[9.0, 9.0]]]), F)
        placed = mesh.with_places([island.vertices[:, None] * [1.0, 2.0] for island in mesh.islands])
        assert len(placed.uv) == len(V)
        assert np.isfinite(placed.uv).all()

    def test_opened_and_back(self):
        V, F, uv, FT, _ = strips(4)
        mesh = SeamedMesh(V, F, FT, uv)
        opened = mesh.opened()
        assert opened.seamless
        assert not mesh.seamless
        assert np.array_equal(opened.uv[opened.F], uv[FT])
        assert np.array_equal(opened.V[opened.F], V[F])
        assert np.array_equal(opened.V[: len(V)], V)

    def test_a_seamless_map_is_its_own_cut_mesh(self):
        V, F = annulus(3)
        mesh = SeamedMesh(lift(V), F, F, V)
        assert mesh.seamless
        assert not len(mesh.seams)
        assert np.array_equal(mesh.opened().F, F)

    def test_triangles_without_coordinates_are_not_cut(self):
        V, F = grid(2, 2)
        FT = F.copy()
        FT[3, 1] = -1
        with pytest.raises(ValueError, match="triangle 3 without texture coordinates"):
            SeamedMesh(V, F, FT, V).opened()
