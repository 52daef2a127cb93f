"""Tetrahedral meshes for tests."""

from itertools import combinations

import numpy as np

# Six tetrahedra around the diagonal of a cube, with vertices numbered z + 2 y + 4 x.
_KUHN = np.array([(0, 1, 3, 7), (0, 3, 2, 7), (0, 2, 6, 7), (0, 6, 4, 7), (0, 4, 5, 7), (0, 5, 1, 7)])


def box(*cells, size=1.0):
    """Points and positive tetrahedra of a box of cubes, given their numbers along x, y and z."""
    _, ny, nz = cells
    x = np.stack(np.meshgrid(*(np.arange(k + 1) for k in cells), indexing="ij"), axis=-1).reshape(-1, 3)
    corner = np.stack(np.meshgrid(*(np.arange(k) for k in cells), indexing="ij"), axis=-1).reshape(-1, 1, 3)
    offset = np.stack(np.meshgrid((0, 1), (0, 1), (0, 1), indexing="ij"), axis=-1).reshape(1, 8, 3)
    cube = (corner + offset) @ np.array([(ny + 1) * (nz + 1), nz + 1, 1])
    T = cube[:, _KUHN].reshape(-1, 4)
    return x * size / max(cells), positive(T, x.astype(float))


def positive(T, X):
    """The tetrahedra with two vertices exchanged where the volume is negative."""
    u, v, w = (X[T[:, k]] - X[T[:, 0]] for k in (1, 2, 3))
    negative = np.einsum("ij,ij->i", u, np.cross(v, w)) < 0
    return np.where(negative[:, None], T[:, [1, 0, 2, 3]], T)


def sphere_points(k, radius=1.0):
    """``k`` points spread over a sphere."""
    z = 1 - (2 * np.arange(k) + 1) / k
    angle = np.pi * (1 + 5**0.5) * np.arange(k)
    r = np.sqrt(1 - z * z)
    return radius * np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)


def ball(k=60, seed=0):
    """A Delaunay mesh of a ball with inner points; flat tetrahedra on its surface are left out."""
    from scipy.spatial import Delaunay

    rng = np.random.default_rng(seed)
    X = np.concatenate([sphere_points(k), rng.uniform(-0.5, 0.5, (k // 3, 3))])
    T = positive(Delaunay(X).simplices.astype(np.int64), X)
    return X, T


def double_cover():
    """A shell that covers a ball twice, branched along a circle, with one boundary sphere pushed outwards.

    All tetrahedra are positive, and the two boundary spheres are disjoint.
    """
    from scipy.spatial import Delaunay

    angle = 2 * np.pi * np.arange(8) / 8
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    X = np.concatenate([ring, [(0.0, 0.0, 0.0)], sphere_points(80, 3.0)])
    T = positive(Delaunay(X).simplices.astype(np.int64), X)
    n, centre = len(X), 8
    upper = X[T].mean(axis=1)[:, 2] > 0
    # Sheet k has the centre of sheet k above the disk that spans the circle, and that of the other sheet below.
    sheets = []
    for k in range(2):
        number = np.where(np.arange(n) < 8, np.arange(n), np.arange(n) + k * n)
        sheet = number[T]
        own = np.where(upper, k, 1 - k)
        sheets.append(np.where(centre == T, (centre + own * n)[:, None], sheet))
    Y = np.concatenate([X, X])
    Y[n + 9 :] *= 1.2
    return Y, np.concatenate(sheets)


def random_tiny(rng):
    """A mesh of a few tetrahedra with near-degenerate coordinates, most often positive."""
    kind = rng.integers(4)
    if kind == 0:  # a fan around an edge, which may wind twice
        k = int(rng.integers(3, 8))
        turns = rng.choice([1, 2])
        angle = 2 * np.pi * turns * np.arange(k) / k
        X = np.concatenate([[(0, 0, 0), (0, 0, 1)], np.stack([np.cos(angle), np.sin(angle), 0.3 * angle], axis=1)])
        T = np.array([(0, 1, 2 + i, 2 + (i + 1) % k) for i in range(k)])
        T = T[: k - int(rng.integers(0, 3))]
    elif kind == 1:  # two or three separate tetrahedra that may share vertices or lie in each other
        X = rng.integers(0, 3, (int(rng.integers(4, 9)), 3)).astype(float)
        T = np.array([rng.permutation(len(X))[:4] for _ in range(int(rng.integers(1, 4)))])
        T = positive(T, X)
    elif kind == 2:  # a Delaunay mesh with moved points
        from scipy.spatial import Delaunay

        X = rng.random((int(rng.integers(5, 7)), 3))
        T = positive(Delaunay(X).simplices.astype(np.int64), X)
        X = np.round(4 * X) / 4
    else:  # a tetrahedron inside the cavity, or on the wall, of a star of four
        outer = np.array([(0, 0, 0), (4, 0, 0), (0, 4, 0), (0, 0, 4)], dtype=float)
        X = np.concatenate([outer, [(1, 1, 1)], outer / rng.choice([2, 4, 8]) + rng.integers(0, 2, 3)])
        T = np.array([f for f in combinations(range(5), 4) if 4 in f] + [(5, 6, 7, 8)])
        T = positive(T, X)
    X = X + rng.choice([0.0, 2.0**-52, 0.125]) * rng.integers(-1, 2, X.shape)
    if rng.random() < 0.2:
        X = X * 10.0 ** rng.choice([-150, 150])
    return X, T


def folded_volume(n, folds, seed=0):
    """A smooth displacement field on n³ voxels with some bumps that fold, on separate cells of 12³ voxels."""
    rng = np.random.default_rng(seed)
    z, y, x = np.indices((n, n, n)) / n
    field = 0.02 * n * np.stack([np.sin(3 * y + 2 * z), np.cos(2 * x + z), np.sin(2 * x + 3 * y)], axis=-1)
    side = n // 12
    for spot in rng.permutation(side**3)[:folds]:
        centre = 12 * np.array(np.unravel_index(spot, (side,) * 3)) + 6 + rng.uniform(-1, 1, 3)
        away = np.stack(np.indices((n, n, n)), axis=-1) - centre
        way = rng.normal(size=3)
        field += 3.2 * np.exp(-(away**2).sum(axis=-1) / 4)[..., None] * way / np.linalg.norm(way)
    return field
