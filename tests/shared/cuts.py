"""Surfaces to cut, and measures of cuts, computed independently."""

from __future__ import annotations

import numpy as np

from quasiharmonic import flatten, surfaces
from quasiharmonic.geometry.mesh.splitting import open_along
from quasiharmonic.geometry.mesh.topology import boundary_loops, components, edges
from quasiharmonic.targets.cuts.find import without_loose_ends
from shared.closed_surfaces import TETRAHEDRON, blocks, double_torus, torus
from shared.meshes import lift


def parts(V, F, cut):
    """Return the Euler number and the number of loops of every part, computed independently."""
    FT, origin = open_along(F, cut, len(V))
    assert np.array_equal(origin[FT], F)
    label = components(FT, len(origin))[FT[:, 0]]
    found = []
    for one in np.unique(label):
        used, T = np.unique(FT[label == one], return_inverse=True)
        T = T.reshape(-1, 3)
        there = edges(T, used.size)
        assert not there.nonmanifold.size
        assert not there.inconsistent.size
        sides = len(there.interior) + len(there.boundary)
        found.append((used.size - sides + len(T), len(boundary_loops(T, used.size))))
    return found


def length_of(V, cut):
    return float(np.linalg.norm(V[cut[:, 0]] - V[cut[:, 1]], axis=1).sum())


def energy_of(V, F, cut):
    """Return the mean symmetric Dirichlet energy of the map."""
    FT, origin = open_along(F, cut, len(V))
    return flatten(V[origin], FT).history[-1].energy


def jittered(V, seed=0, size=2e-3):
    """Perturb vertices so that no two lengths are equal and rounding does not matter."""
    return V + size * np.random.default_rng(seed).standard_normal(V.shape)


def without(F, *rows):
    return np.delete(F, rows, axis=0)


TORUS = torus()
CUBE = blocks(np.ones((1, 1, 1)), rounds=0)
SURFACES = {
    "tetrahedron": TETRAHEDRON,
    "cube": CUBE,
    "two triangles": (np.eye(3), np.array([[0, 1, 2], [0, 2, 1]])),
    "starfish": surfaces.starfish(3, 12),
    "torus": TORUS,
    "smallest torus": torus(3, 3),
    "torus with a hole": (TORUS[0], without(TORUS[1], 7)),
    "torus with holes": (TORUS[0], without(TORUS[1], 7, 200, 201, 400)),
    "two handles": double_torus(),
    "annulus": surfaces.annulus(12),
    "curved annulus": (lift(surfaces.annulus(12)[0]), surfaces.annulus(12)[1]),
    "disk": surfaces.disk(5),
    "cat": surfaces.cat(15),
}


def random_cut(graph, seed):
    """Return the edges that a random tree of triangles does not cross, without most loose ends."""
    rng = np.random.default_rng(seed)
    order, joined, root = rng.permutation(len(graph.ends)), np.arange(len(graph.F)), {}
    for t, numbers in enumerate(graph.side.T.tolist()):
        for number in numbers:
            root.setdefault(number, []).append(t)

    def find(t):
        while joined[t] != t:
            t = joined[t]
        return t

    cut = ~graph.rim
    for number in order.tolist():
        if len(root[number]) == 2:
            one, other = (find(t) for t in root[number])
            if one != other:
                joined[one] = other
                cut[number] = False
    bare = without_loose_ends(graph, cut)
    if bare.any():
        return bare
    # On a sphere all edges are loose ends; a path and a branch of the tree remain.
    for _ in range(12):
        degree = np.bincount(graph.ends[cut].ravel(), minlength=graph.n)
        loose = cut & (degree == 1)[graph.ends].any(axis=1)
        if loose.sum() + 2 > cut.sum():
            break
        cut = cut & ~loose
    return cut
