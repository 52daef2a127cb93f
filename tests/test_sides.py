"""Edges of sides, pairs of sides, and sides at given edges, beside loops over all sides."""

from collections import defaultdict

import numpy as np
import pytest

from quasiharmonic.geometry.mesh.splitting import renumber
from quasiharmonic.geometry.mesh.topology import are_sides, find_pairs, find_sides, mark_sides
from quasiharmonic.surfaces import disk
from shared.kernel_arguments.registry import soup

MESHES = {
    "disk": lambda rng: disk(3)[1],
    "soup": lambda rng: soup(rng, 9, 40),
    "sparse soup": lambda rng: soup(rng, 300, 90),
    "none": lambda rng: np.empty((0, 3), dtype=np.int64),
}


def list_sides(F):
    """Numbers of the sides of each edge, by loops."""
    sides = defaultdict(list)
    for t, triangle in enumerate(F.tolist()):
        for k in range(3):
            sides[tuple(sorted((triangle[k], triangle[(k + 1) % 3])))].append(3 * t + k)
    return sides


@pytest.mark.parametrize("name", MESHES)
def test_sides_are_numbered_by_their_edges(name):
    F = MESHES[name](np.random.default_rng(1))
    sides = list_sides(F)
    ends, side = find_sides(F, int(F.max(initial=-1)) + 1)
    assert [tuple(edge) for edge in ends.tolist()] == sorted(sides)
    for number, edge in enumerate(sorted(sides)):
        assert np.flatnonzero(side.ravel() == number).tolist() == sides[edge]


@pytest.mark.parametrize("name", MESHES)
def test_pairs_are_the_edges_of_two_triangles(name):
    F = MESHES[name](np.random.default_rng(2))
    one, other = find_pairs(F)
    assert list(zip(one.tolist(), other.tolist(), strict=True)) == sorted(
        tuple(found) for found in list_sides(F).values() if len(found) == 2
    )


def test_vertices_out_of_range_are_named():
    with pytest.raises(ValueError, match="F"):
        find_sides(np.array([[0, 1, 5]]), 5)


@pytest.mark.parametrize("name", MESHES)
def test_sides_at_given_edges(name):
    rng = np.random.default_rng(3)
    F = MESHES[name](rng)
    n = int(F.max(initial=-1)) + 2
    pairs = rng.integers(0, n, (30, 2))
    wanted, sides = {tuple(sorted(pair)) for pair in pairs.tolist()}, list_sides(F)
    expected = sorted(side for edge in wanted & set(sides) for side in sides[edge])
    assert np.flatnonzero(mark_sides(F, pairs, n)).tolist() == expected
    assert are_sides(pairs, F, n).tolist() == [tuple(sorted(pair)) in sides for pair in pairs.tolist()]
    assert not mark_sides(F, pairs[:0], n).any()
    assert not are_sides(pairs[:0], F, n).size


@pytest.mark.parametrize("gap", [0, 10**6])
def test_parts_are_numbered_in_the_order_of_their_vertices(gap):
    rng = np.random.default_rng(4)
    F = rng.permutation(300)[soup(rng, 30, 40)]
    # Every vertex has one or two fans.
    split = 2 * F + rng.integers(0, 2, F.shape) + gap * (F > 200)
    own, corner = renumber(split, F)
    of = split.ravel()[corner]
    assert np.array_equal(of[own], split)
    assert np.array_equal(F.ravel()[corner][own], F)
    assert len(set(of.tolist())) == len(of)
    assert (np.diff(F.ravel()[corner]) >= 0).all()
