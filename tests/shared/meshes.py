"""Small meshes and maps shared by the tests."""

from __future__ import annotations

from functools import cache

import numpy as np

from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.surfaces import annulus, disk, random_delaunay


def bend(points):
    """A smooth injective map of the unit disk's neighbourhood: a rotation and a stretch, then a quadratic shear."""
    x, y = points[:, 0], points[:, 1]
    turn = np.exp(0.4j)
    z = (x + 1j * y) * turn
    u, v = 1.6 * z.real, 0.7 * z.imag
    return np.stack([u + 0.3 * v**2, v + 0.25 * (u + 0.3 * v**2) ** 2], axis=1)


def lift(points):
    """Lift a planar mesh to a curved surface."""
    x, y = points[:, 0], points[:, 1]
    return np.stack([x, y, 0.8 * np.exp(-2 * x**2 - y**2) + 0.3 * x * y], axis=1)


def irregular_disk(n, seed):
    """A mesh of `random_delaunay`, computed once."""
    return tuple(array.copy() for array in computed_disk(n, seed))


@cache
def computed_disk(n, seed):
    return random_delaunay(n, seed=seed)


def surfaces():
    """(name, V, F) of planar and curved meshes with one or two boundary loops."""
    flat, flat_faces = irregular_disk(90, 3)
    ring, ring_faces = annulus(8)
    return [
        ("disk", flat, flat_faces),
        ("bowl", lift(flat), flat_faces),
        ("annulus", ring, ring_faces),
        ("curved annulus", lift(ring), ring_faces),
        ("random annulus", *random_annulus(120)),
    ]


def random_annulus(n=220, seed=1, radius=0.35):
    """An irregular disk with a hole, without unused vertices."""
    V, F = irregular_disk(n, seed)
    F = F[np.hypot(*V[F].mean(axis=1).T) > radius]
    used, F = np.unique(F, return_inverse=True)
    return V[used], F.reshape(-1, 3)


def boundary_of(F):
    """Boundary vertices in ascending order."""
    return np.unique(boundary_edges(F, int(F.max()) + 1))


def signed_areas(F, uv):
    """Twice the signed areas, by the standard formula."""
    a, b, c = uv[F[:, 0]], uv[F[:, 1]], uv[F[:, 2]]
    return (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]


def random_xi(F, scale=0.7, seed=0):
    """A random ξ per triangle."""
    rng = np.random.default_rng(seed)
    return scale * (rng.standard_normal(len(F)) + 1j * rng.standard_normal(len(F)))


def tangled(rng, size):
    """A disk with many vertices of low degree: triangles (3, f), and a mask of its interior vertices (n,)."""
    V, F = disk(3)
    F, n = F.tolist(), len(V)
    for new in range(n, n + size):
        a, b, c = F[rng.integers(len(F))]
        split = [t for t in F if a in t and b in t]
        if len(split) == 2 and rng.random() < 0.7:
            halves = [[new if v == end else v for v in t] for t in split for end in (a, b)]
        else:
            split, halves = [[a, b, c]], [[a, b, new], [b, c, new], [c, a, new]]
        F = [t for t in F if t not in split] + halves
    T = np.array(F, dtype=np.int64)
    free = np.ones(n + size, dtype=bool)
    free[boundary_of(T)] = False
    return np.ascontiguousarray(T.T), free
