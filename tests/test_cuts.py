"""Cuts: they leave disks, they are short, and they reduce distortion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from quasiharmonic import crease_costs, find_cuts, surfaces
from quasiharmonic.geometry.mesh.splitting import open_along
from quasiharmonic.geometry.mesh.topology import boundary_loops, edge_keys, edges
from quasiharmonic.targets.cuts.find import opening_cuts
from quasiharmonic.targets.cuts.graph import edge_graph
from quasiharmonic.targets.cuts.reaching import Shrinking
from quasiharmonic.targets.cuts.shortening import shorten_cuts, stretches
from shared.closed_surfaces import TETRAHEDRON, blocks, double_torus, torus
from shared.cuts import SURFACES, TORUS, energy_of, jittered, length_of, parts, random_cut


class TestDisks:
    @pytest.mark.parametrize("gain", [0.02, 0.1, np.inf])
    @pytest.mark.parametrize("name", SURFACES)
    def test_every_surface(self, name, gain):
        V, F = SURFACES[name]
        before = V.copy(), F.copy()
        cut = find_cuts(V, F, min_gain=gain)
        assert parts(V, F, cut) == [(1, 1)]
        assert cut.dtype == np.int64
        assert np.array_equal(cut, np.unique(np.sort(cut, axis=1), axis=0))
        inner = edges(F, len(V)).interior
        assert np.isin(edge_keys(*cut.T, len(V)), edge_keys(*inner.T, len(V))).all()
        assert np.array_equal(V, before[0])
        assert np.array_equal(F, before[1])

    @pytest.mark.slow
    def test_several_surfaces_are_cut_like_each_alone(self):
        (V, F), (W, G) = surfaces.starfish(3, 12), torus(12, 8)
        V = jittered(V)
        both = np.concatenate([V, [[9, 9, 9]], 100 * W]), np.concatenate([F, G + len(V) + 1])
        found = find_cuts(*both)
        assert parts(*both, found) == [(1, 1), (1, 1)]
        own = find_cuts(V, F)
        assert np.array_equal(found[found[:, 0] < len(V)], own)

    def test_touching_surfaces_are_cut_separately(self):
        V, F = TETRAHEDRON
        V, F = np.concatenate([V, -V[1:]]), np.concatenate([F, np.where(F, F + 3, 0)[:, ::-1]])
        assert parts(V, F, find_cuts(V, F)) == [(1, 1), (1, 1)]

    @pytest.mark.parametrize("scale", [0, 1e-310, 1e-200, 1e200, 1e300])
    def test_any_size(self, scale):
        V, F = torus(12, 8)
        assert parts(V, F, find_cuts(scale * V, F)) == [(1, 1)]

    def test_slivers_and_triangles_without_area(self):
        V, F = surfaces.starfish(3, 12)
        V = V * (1, 1e-5, 1)
        V[F[100, 1]] = V[F[100, 0]]
        assert parts(V, F, find_cuts(V, F)) == [(1, 1)]

    @pytest.mark.long
    @pytest.mark.parametrize("seed", range(40))
    def test_random_surfaces(self, seed):
        """Any number of handles, holes and touching components, random edges, and any proportions."""
        rng = np.random.default_rng(seed)
        V, F = blocks(rng.random(rng.integers(1, 5, 3)) < rng.choice([0.5, 0.75, 0.95]), rounds=rng.integers(0, 3))
        F = F[rng.random(len(F)) >= rng.choice([0, 0.05, 0.3])]
        found = edges(F, len(V))
        F = F[~np.isin(F, [*found.nonmanifold.ravel(), *found.inconsistent.ravel()]).any(axis=1)]
        if not F.size:
            return
        inner = edges(F, len(V)).interior
        given = inner[rng.random(len(inner)) < rng.choice([0, 0.05, 0.3])]
        spared = inner[rng.random(len(inner)) < rng.choice([0, 0.2])]
        V = V * 10.0 ** rng.uniform(-3, 0, 3)
        cut = find_cuts(V, F, edges=given, forbidden_edges=spared, min_gain=rng.choice([0.01, 0.1, np.inf]))
        assert set(parts(V, F, cut)) == {(1, 1)}


class TestShortest:
    def test_two_edges_of_a_tetrahedron(self):
        assert len(find_cuts(*TETRAHEDRON, min_gain=np.inf)) == 2

    @pytest.mark.parametrize(("hole", "width"), [((-0.5, -0.5, 0.5, 0.75), 0.25), ((-0.9, -0.2, 0.1, 0.25), 0.1)])
    def test_across_the_narrowest_strip(self, hole, width):
        V, F = surfaces.annulus(12, hole=hole)
        assert length_of(V, find_cuts(V, F, min_gain=np.inf)) == pytest.approx(width)

    def test_a_ring_and_the_inner_equator_of_a_torus(self):
        V, F = torus(40, 20, radius=3)
        ring, equator = np.arange(20), 10 + 20 * np.arange(40)
        shortest = sum(np.linalg.norm(V[loop] - V[np.roll(loop, 1)], axis=1).sum() for loop in (ring, equator))
        assert length_of(V, find_cuts(V, F, min_gain=np.inf)) == pytest.approx(shortest, rel=1e-3)

    def test_no_cut_without_a_gain(self):
        assert find_cuts(*surfaces.disk(8)).shape == (0, 2)
        assert find_cuts(*surfaces.grid(30, 3)).shape == (0, 2)

    @pytest.mark.parametrize("seed", range(4))
    @pytest.mark.parametrize("name", ["starfish", "torus with holes", "two handles"])
    def test_a_random_cut_gets_shorter_and_stays_a_cut(self, name, seed):
        V, F = SURFACES[name]
        graph = edge_graph(V, F)
        cut = random_cut(graph, seed)
        assert parts(V, F, graph.ends[cut]) == [(1, 1)]
        better = shorten_cuts(graph, cut)
        assert parts(V, F, graph.ends[better]) == [(1, 1)]
        assert graph.cost[better].sum() < 0.9 * graph.cost[cut].sum()
        assert sum(way.size for way in stretches(graph, better)) == better.sum()
        # At most twice the length of the topological cut.
        if name != "starfish":
            assert graph.cost[better].sum() < 2 * graph.cost[shorten_cuts(graph, opening_cuts(graph))].sum()

    def test_creases_are_preferred(self):
        """The path around a bar has the same length on its edges and beside them."""
        V, F = blocks(np.ones((12, 4, 4)), rounds=0)
        graph = edge_graph(V, F)
        corner = np.isin(V[graph.ends][..., 1:], (1, 5)).all(axis=(1, 2))
        assert corner.any()
        assert np.allclose(graph.cost[corner], 0.75 * graph.length[corner])
        # Seen from inside, the bar's edges are folded inwards.
        inside_out = edge_graph(V, F[:, ::-1])
        assert np.allclose(inside_out.cost[corner], 0.5 * graph.length[corner])
        flat = np.isclose(graph.cost, graph.length)
        assert flat.sum() > corner.sum()
        cut = find_cuts(V, F, min_gain=np.inf)
        number = graph.numbers(*cut.T)
        assert graph.cost[number].sum() < 0.9 * graph.length[number].sum()

    def test_a_cut_ends_where_it_first_meets_the_boundary(self):
        """Further along the boundary, the distance is the same after rounding."""
        V, F = surfaces.grid(6, 6)
        place = np.rint(V * 6).astype(int)
        number = {(x, y): k for k, (x, y) in enumerate(place.tolist())}
        graph = edge_graph(V, F)

        def along(*corners):
            vertices = np.array([number[corner] for corner in corners])
            return graph.numbers(vertices[:-1], vertices[1:])

        cost = graph.cost.copy()
        cost[along((2, 0), (3, 0))] = 1e-20
        straight = along((3, 3), (3, 2), (3, 1), (3, 0))
        cost[straight] *= 0.5
        cut = np.zeros(len(cost), dtype=bool)
        cut[along((3, 3), (4, 3), (5, 3), (5, 2), (5, 1), (5, 0))] = True
        assert np.flatnonzero(shorten_cuts(replace(graph, cost=cost), cut)).tolist() == sorted(straight.tolist())


class TestGain:
    def test_cap_agrees_with_stereographic_projection(self):
        """On a sphere, e⁻ʷ is (1 + cos θ₀) / (1 + cos θ) if lengths are unchanged at θ₀."""
        flat, F = surfaces.disk(40)
        theta = 1.3 * np.hypot(*flat.T)
        turn = np.arctan2(flat[:, 1], flat[:, 0])
        V = np.stack([np.sin(theta) * np.cos(turn), np.sin(theta) * np.sin(turn), np.cos(theta)], axis=1)
        graph = edge_graph(V, F)
        w = Shrinking(graph).of(graph.rim_vertices)
        np.testing.assert_allclose(w, np.log((1 + np.cos(theta)) / (1 + np.cos(1.3))), atol=3e-3)

    def test_tube_depends_on_length_over_width(self):
        """A tube closed at one end contains half a sphere's curvature; w grows by 1 per radius along the tube."""
        around, along = 48, 60
        i, j = np.divmod(np.arange(around * along), around)
        V = np.stack([np.cos(2 * np.pi * j / around), np.sin(2 * np.pi * j / around), 2 * np.pi * i / around], axis=1)
        ahead = i * around + (j + 1) % around
        here = np.arange(around * along)
        lower = here[here < around * (along - 1)]
        tube = np.concatenate([
            np.stack([lower, ahead[lower], lower + around], axis=1),
            np.stack([ahead[lower], ahead[lower] + around, lower + around], axis=1),
        ])  # fmt: skip
        top = np.arange(around) + around * (along - 1)
        lid = np.stack([top, np.roll(top, -1), np.full(around, len(V))], axis=1)
        V, F = np.vstack([V, [0, 0, V[-1, 2]]]), np.concatenate([tube, lid])
        graph = edge_graph(V, F)
        w = Shrinking(graph).of(graph.rim_vertices)
        np.testing.assert_allclose(w[:-1], V[:-1, 2], rtol=5e-3, atol=1e-9)

    @pytest.mark.long
    @pytest.mark.parametrize("gain", [0.1, np.inf])
    def test_predicted_energy_is_close_to_that_of_the_map(self, gain):
        for V, F in (surfaces.starfish(5, 10), surfaces.starfish(3, 10), double_torus()):
            cut = find_cuts(V, F, min_gain=gain)
            graph, shrinking = edge_graph(V, F), Shrinking(edge_graph(V, F))
            open_at = np.zeros(len(V), dtype=bool)
            open_at[cut] = True
            told, true = shrinking.energy(shrinking.of(open_at | graph.rim_vertices)), energy_of(V, F, cut)
            assert 0.4 * true < told < 2.5 * true + 0.2

    @pytest.mark.long
    def test_cuts_reach_arms(self):
        V, F = surfaces.starfish(5, 12)
        cut = find_cuts(V, F)
        V = V / V[:, 0].max()
        for turn in 2 * np.pi * np.arange(5) / 5:
            tip = np.array([np.cos(turn), np.sin(turn), 0])
            assert np.linalg.norm(V[np.unique(cut)] - tip, axis=1).min() < 0.15
        # The cut is little longer than the arms and the centre.
        assert length_of(V, cut) < 5 * 1.3
        assert energy_of(V, F, cut) < 0.1 * energy_of(V, F, find_cuts(V, F, min_gain=np.inf))

    @pytest.mark.long
    def test_a_larger_required_gain_makes_cuts_shorter(self):
        V, F = surfaces.starfish(5, 12)
        lengths = [length_of(V, find_cuts(V, F, min_gain=gain)) for gain in (0.02, 0.2, 2, np.inf)]
        assert lengths == sorted(lengths, reverse=True)
        assert lengths[0] > 1.5 * lengths[-1]

    @pytest.mark.long
    def test_unit_position_and_orientation_do_not_matter(self):
        V, F = surfaces.starfish(4, 12)
        V = jittered(V)
        cut = find_cuts(V, F)
        assert np.array_equal(cut, find_cuts(V, F))
        assert np.array_equal(cut, find_cuts(2.0**-40 * V, F))
        rotation = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0]
        rotation *= np.linalg.det(rotation)
        assert np.array_equal(cut, find_cuts(1000.3 * V @ rotation.T + (5, -700, 30), F))


class TestCosts:
    @pytest.mark.slow
    def test_costs_of_one_change_nothing(self):
        V, F = SURFACES["starfish"]
        assert np.array_equal(find_cuts(V, F), find_cuts(V, F, edge_costs=np.ones(F.shape)))

    @pytest.mark.slow
    @pytest.mark.parametrize("shape", [(36, 14), (210, 76)], ids=["small", "large"])
    def test_cuts_leave_costly_parts(self, shape):
        """A cut around a torus may be anywhere: it moves to the half where it is cheap."""
        V, F = torus(*shape)
        for side in (-1, 1):
            costly = np.where(side * V[:, 0] > 0, 10.0, 1.0)
            costs = (costly[F] + costly[np.roll(F, -1, axis=1)]) / 2
            cut = find_cuts(V, F, edge_costs=costs, min_gain=np.inf)
            assert parts(V, F, cut) == [(1, 1)]
            # Only the cut along the torus crosses the costly half; the cut around the tube is in the other one.
            assert length_of(V, cut[(side * V[cut][..., 0] > 0).all(axis=1)]) < 1.1 * np.pi

    def test_creases_cost_less_if_concave(self):
        V, F = blocks(np.ones((12, 4, 4)), rounds=0)
        assert np.array_equal(crease_costs(V, F), np.ones(F.shape))
        costs = crease_costs(V, F[:, ::-1])
        ends = np.stack([F[:, ::-1], np.roll(F[:, ::-1], -1, axis=1)], axis=2)
        corner = np.isin(V[ends][..., 1:], (1, 5)).all(axis=(2, 3))
        assert corner.any()
        assert np.allclose(costs[corner], 0.25)
        assert set(np.unique(np.round(costs, 12))) == {0.25, 1.0}


class TestGiven:
    RING = np.stack([np.arange(14), (np.arange(14) + 1) % 14], axis=1)

    @pytest.mark.parametrize("gain", [0.1, np.inf])
    def test_a_ring_is_completed(self, gain):
        V, F = TORUS
        cut = find_cuts(V, F, edges=self.RING, min_gain=gain)
        assert parts(V, F, cut) == [(1, 1)]
        assert {tuple(pair) for pair in np.sort(self.RING, axis=1).tolist()} <= {tuple(pair) for pair in cut.tolist()}

    def test_parts_are_disks_each(self):
        V, F = TORUS
        cut = find_cuts(V, F, edges=np.concatenate([self.RING, self.RING + 14 * 18]), min_gain=np.inf)
        assert parts(V, F, cut) == [(1, 1), (1, 1)]
        assert length_of(V, cut) < length_of(V, self.RING) * 2 + 2 * np.pi

    def test_sufficient_cuts_are_not_extended(self):
        V, F = TORUS
        enough = find_cuts(V, F, min_gain=np.inf)
        assert np.array_equal(find_cuts(V, F, edges=enough[::-1, ::-1], min_gain=np.inf), enough)

    @pytest.mark.slow
    def test_one_interior_edge_opens_nothing(self):
        V, F = TORUS
        lone = np.setdiff1d(np.arange(len(V)), find_cuts(V, F))[0]
        end = F[(lone == F).any(axis=1)][0]
        edge = [lone, next(v for v in end if v != lone)]
        assert np.array_equal(find_cuts(V, F, edges=[edge]), find_cuts(V, F))
        assert parts(*TETRAHEDRON, find_cuts(*TETRAHEDRON, edges=[[0, 1]])) == [(1, 1)]

    def test_boundary_edges_are_no_cuts(self):
        V, F = surfaces.disk(4)
        (loop,) = boundary_loops(F, len(V))
        assert find_cuts(V, F, edges=np.stack([loop, np.roll(loop, 1)], axis=1)).shape == (0, 2)

    def test_diagonals_are_avoided(self):
        V, F = TORUS
        half = len(F) // 2
        diagonals = F[:half, [0, 2]]
        cut = find_cuts(V, F, forbidden_edges=diagonals)
        assert parts(V, F, cut) == [(1, 1)]
        assert not np.isin(edge_keys(*cut.T, len(V)), edge_keys(*diagonals.T, len(V))).any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"F": np.vstack([TETRAHEDRON[1], [[0, 1, 2]]])}, r"in more than two triangles|repeated"),
        ({"F": np.vstack([TETRAHEDRON[1], [[0, 1, 4]]])}, r"edge \(0, 1\) in more than two triangles"),
        ({"F": np.array([[0, 1, 2], [0, 1, 3]])}, r"mixed winding: edge \(0, 1\)"),
        ({"F": np.array([[0, 1, 1]])}, "triangle 0: a vertex is used twice"),
        ({"F": np.array([[0, 1, 9]])}, "refers to vertex 9"),
        ({"F": np.zeros((0, 3), dtype=int)}, "no triangles"),
        ({"V": np.full((5, 3), np.nan)}, "V is not finite at vertices 0, 1"),
        ({"edges": [0, 1]}, r"edges must have shape \(k, 2\)"),
        ({"edges": [[0, 4]]}, r"edge \(0, 4\): not an edge of the mesh"),
        ({"edges": [[0, 7]]}, "refers to vertex 7"),
        ({"edges": [[0.5, 1]]}, "edges must contain integer indices"),
        ({"forbidden_edges": [[0, 7]]}, "forbidden_edges refers to vertex 7"),
        ({"edge_costs": np.ones(4)}, r"edge_costs must have shape \(4, 3\), not \(4,\)"),
        ({"edge_costs": np.eye(4)[:, 1:]}, "edge_costs must be positive and finite: triangles 0, 1"),
        ({"edge_costs": np.full((4, 3), np.inf)}, "edge_costs must be positive and finite"),
        ({"min_gain": 0}, "min_gain must be a positive number, not 0"),
        ({"min_gain": np.nan}, "min_gain must be a positive number, not nan"),
        ({"min_gain": "much"}, "min_gain must be a positive number, not 'much'"),
    ],
)
def test_invalid_calls_are_rejected(change, message):
    V, F = TETRAHEDRON
    arguments = {"V": np.vstack([V, [2, 2, 2]]), "F": F} | change
    with pytest.raises(ValueError, match=message):
        find_cuts(**arguments)


class TestOpening:
    def test_copies_come_last_and_other_vertices_keep_their_numbers(self):
        V, F = surfaces.disk(3)
        FT, origin = open_along(F, np.array([[0, 1], [1, 7], [7, 19]]), len(V))
        assert np.array_equal(origin, [*range(len(V)), 1, 7, 19])
        assert np.array_equal(origin[FT], F)
        assert set(F[FT != F]) == {1, 7, 19}
        assert parts(V, F, np.array([[0, 1], [1, 7], [7, 19]])) == [(1, 1)]

    def test_no_cut_changes_nothing(self):
        V, F = surfaces.annulus(6)
        FT, origin = open_along(F, np.zeros((0, 2), dtype=np.int64), len(V))
        assert np.array_equal(FT, F)
        assert np.array_equal(origin, np.arange(len(V)))
