"""Large surfaces are cut on a coarse mesh, and the cuts are carried over to the fine one."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import find_cuts, surfaces
from quasiharmonic.geometry.coarsening import coarsen
from quasiharmonic.geometry.mesh.reference import flat_triangles
from quasiharmonic.geometry.mesh.splitting import open_along
from quasiharmonic.geometry.mesh.topology import edge_keys, edges
from quasiharmonic.targets.cuts.graph import edge_graph
from quasiharmonic.targets.cuts.shortening import cut_by_levels, insert_vertices, shorten_cuts
from shared.closed_surfaces import torus
from shared.cuts import SURFACES, length_of, parts, random_cut


class TestLevels:
    """Large surfaces are cut on a coarse mesh; the cuts are carried to the fine one."""

    @pytest.mark.parametrize("seed", range(2))
    @pytest.mark.parametrize("name", ["starfish", "torus with holes", "two handles"])
    def test_cuts_keep_their_topology_when_vertices_are_inserted(self, name, seed):
        V, F = SURFACES[name]
        FT, origin = open_along(F, np.zeros((0, 2), dtype=np.int64), len(V))
        V, F = V[origin], FT
        fixed = np.zeros(len(V), dtype=bool)
        fixed[edges(F, len(V)).boundary] = True
        coarsening = coarsen(F, len(V), fixed, 60)
        vertices, coarse = np.unique(coarsening.F, return_inverse=True)
        graph = edge_graph(V[vertices], coarse.reshape(-1, 3))
        cut = vertices[graph.ends[random_cut(graph, seed)]]
        ends = (np.bincount(cut.ravel()) == 1).sum()
        assert len(coarsening.rounds) > 1
        for k in reversed(range(len(coarsening.rounds))):
            cut = insert_vertices(cut, coarsening.rounds[k], len(V))
            assert np.array_equal(cut, np.sort(cut, axis=1))
            assert (np.bincount(cut.ravel()) == 1).sum() == ends
            if k in coarsening.levels:
                assert parts(V, coarsening.levels[k], cut) == [(1, 1)]
        assert parts(V, F, cut) == [(1, 1)]

    @pytest.mark.parametrize("seed", range(2))
    @pytest.mark.parametrize("name", ["starfish", "torus with holes", "two handles"])
    def test_shortening_close_to_cuts(self, name, seed):
        V, F = SURFACES[name]
        graph = edge_graph(V, F)
        cut = random_cut(graph, seed)
        better = shorten_cuts(graph, cut, rings=3)
        assert parts(V, F, graph.ends[better]) == [(1, 1)]
        assert graph.cost[better].sum() < 0.9 * graph.cost[cut].sum()

    def test_a_part_of_a_graph_has_the_same_edges(self):
        V, F = SURFACES["torus with holes"]
        graph = edge_graph(V, F)
        part, own = graph.part_near(np.array([3]), 2)
        ring = np.unique(F[(F == 3).any(axis=1)])
        near = np.isin(F, ring).any(axis=1)
        assert np.array_equal(np.sort(part.V[part.F], axis=1), np.sort(graph.V[F[near]], axis=1))
        assert np.array_equal(part.V[part.ends], graph.V[graph.ends[own]])
        assert np.array_equal(
            part.ends[part.side], np.sort(np.stack([part.F, np.roll(part.F, -1, 1)], 2), 2).swapaxes(0, 1)
        )
        assert np.array_equal(part.rim, graph.rim[own])
        # Costs are infinite exactly at vertices outside the first ring.
        outer = ~np.isin(graph.ends[own], ring).all(axis=1)
        assert np.array_equal(np.isinf(part.cost), outer)

    def test_parts_stay_when_others_are_taken(self):
        """The graph uses its memory again; a part of one triangle could be a view of it."""
        V, F = surfaces.disk(5)
        V, F = np.concatenate([V, [[9, 9], [10, 9], [9, 10]]]), np.concatenate([F, [[len(V), len(V) + 1, len(V) + 2]]])
        graph = edge_graph(V, F)
        part, own = graph.part_near(np.array([len(V) - 1]), 1)
        before = [array.copy() for array in (part.V, part.F, part.ends, part.side, part.cost, own)]
        graph.part_near(np.array([0]), 3)
        assert len(part.F) == 1
        for then, now in zip(before, (part.V, part.F, part.ends, part.side, part.cost, own), strict=True):
            assert np.array_equal(then, now)

    @pytest.mark.long
    def test_a_large_torus(self):
        """The inner equator and a ring are nearly the shortest cuts."""
        V, F = torus(210, 76, radius=3)
        cut = find_cuts(V, F, min_gain=np.inf)
        assert parts(V, F, cut) == [(1, 1)]
        assert length_of(V, cut) < 1.03 * 2 * np.pi * (1 + 2)
        assert np.array_equal(cut, find_cuts(V, F, min_gain=np.inf))

    @pytest.mark.slow
    def test_a_large_surface_avoids_diagonals(self):
        V, F = torus(210, 76, radius=3)
        diagonals = F[: len(F) // 2, [0, 2]]
        cut = find_cuts(V, F, forbidden_edges=diagonals, min_gain=np.inf)
        assert parts(V, F, cut) == [(1, 1)]
        assert not np.isin(edge_keys(*cut.T, len(V)), edge_keys(*diagonals.T, len(V))).any()

    @pytest.mark.slow
    def test_a_large_disk_needs_no_cut(self):
        assert find_cuts(*surfaces.grid(150, 150), min_gain=np.inf).shape == (0, 2)

    @pytest.mark.long
    def test_large_arms(self):
        """On a fine mesh, cuts are about as long as on a coarse one, which reach all arms."""
        V, F = surfaces.starfish(3, 24)
        few = find_cuts(V, F)
        V, F = surfaces.starfish(3, 52)
        cut = find_cuts(V, F)
        assert parts(V, F, cut) == [(1, 1)]
        assert length_of(V, cut) < 1.2 * length_of(*surfaces.starfish(3, 24)[:1], few)


@pytest.mark.slow
def test_a_large_surface_that_needs_no_cut():
    V, F = surfaces.grid(130, 130)
    assert len(V) > 15_000
    assert find_cuts(np.column_stack([V, 0.1 * V[:, 0] * V[:, 1]]), F).shape == (0, 2)


@pytest.mark.parametrize("steps", [4, 6, 8])
def test_coarse_triangles_have_areas(steps):
    """The vertices of voxel models lie on a lattice, so that means of them often lie on a line."""
    V, F = torus(90, 80)
    seen = []

    def find(graph, vertices, rounds):
        seen.append(flat_triangles(graph.V, graph.F).size)
        return np.zeros(len(graph.ends), dtype=bool)

    cut_by_levels(np.round(V * steps) / steps, F, None, find, 3, goal=2000)
    assert seen == [0]
