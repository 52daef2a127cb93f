"""Example meshes: planar and curved surfaces with few parameters.

Every function returns ``V, F``: vertices (n, 2) or (n, 3) float64 and triangles (f, 3) int64. The mesh is a connected
manifold without unused vertices. Its triangles are counterclockwise in the plane or seen from outside. The same
arguments give the same mesh. `starfish` is closed; all others have a boundary.

The boundaries have no *chords*, which are interior edges between two boundary vertices. A chord must fit inside the
target as one straight segment. The boundary alone determines a triangle with three boundary vertices (an "ear").
Without chords and ears, no choice of the boundary excludes an injective map by itself.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array
from scipy.spatial import Delaunay

from quasiharmonic.geometry.mesh.topology import find_sides
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    check_bool,
    check_integer,
    real_array,
    triangle_array,
    vertex_array,
)

__all__ = ["annulus", "cat", "disk", "grid", "random_delaunay", "refine", "starfish"]


def grid(nx: int, ny: int, *, alternating: bool = False) -> tuple[FloatArray, IntArray]:
    r"""Triangulate the unit square by ``nx`` × ``ny`` cells of two triangles.

    ::

        +---+---+---+---+     +---+---+---+---+
        | \ | / | / | / |     | \ | / | \ | / |
        +---+---+---+---+     +---+---+---+---+
        | / | / | / | \ |     | / | \ | / | \ |
        +---+---+---+---+     +---+---+---+---+
                              alternating

    Parameters
    ----------
    nx, ny : int
        Cells along x and y, at least 2 each.
    alternating : bool
        Alternate the direction of the diagonals. By default all diagonals rise to the right, except in two
        corners, where such a diagonal would create a triangle with all vertices on the boundary.

    Returns
    -------
    V : ((nx + 1)(ny + 1), 2) float64
        Row by row from the bottom: vertex ``i + j * (nx + 1)`` is at ``(i / nx, j / ny)``.
    F : (2 nx ny, 3) int64

    Raises
    ------
    ValueError
        If there are fewer than 2 cells along an axis; such a grid has chords.
    """
    check_integer("nx", nx, minimum=2)
    check_integer("ny", ny, minimum=2)
    check_bool("alternating", alternating)
    return _rectangles(np.arange(nx + 1) / nx, np.arange(ny + 1) / ny, None, alternating)


def annulus(
    cells: int = 16, *, hole: tuple[float, float, float, float] = (-0.5, -0.5, 0.5, 0.5)
) -> tuple[FloatArray, IntArray]:
    """Triangulate the square [-1, 1]² around a rectangular hole.

    Parameters
    ----------
    cells : int
        Cells across the whole square, at least 2. Each strip beside the hole has at least 2 cells across.
    hole : (4,) float
        Left, bottom, right and top of the hole.

    Returns
    -------
    V : (n, 2) float64
    F : (f, 3) int64
        There are two boundary loops, both with vertices at their corners.

    Raises
    ------
    ValueError
        If there are fewer than 2 cells, or the hole is empty or not inside the square.
    """
    check_integer("cells", cells, minimum=2)
    corners = real_array("hole", hole)
    if corners.shape != (4,):
        raise ValueError(f"hole must be four numbers, not an array of shape {corners.shape}")
    left, bottom, right, top = corners.tolist()
    if not (-1 < left < right < 1 and -1 < bottom < top < 1):
        raise ValueError(f"the hole {hole} is empty or not inside the square [-1, 1]²")

    def lines(low: float, high: float) -> tuple[FloatArray, int, int]:
        counts = [max(2, round(cells * length / 2)) for length in (low + 1, high - low, 1 - high)]
        ends = np.cumsum([0, *counts])
        return np.interp(np.arange(ends[3] + 1), ends, (-1, low, high, 1)), int(ends[1]), int(ends[2])

    x, i0, i1 = lines(left, right)
    y, j0, j1 = lines(bottom, top)
    solid = np.ones((y.size - 1, x.size - 1), dtype=bool)
    solid[j0:j1, i0:i1] = False
    return _rectangles(x, y, solid, False)


def disk(rings: int = 12) -> tuple[FloatArray, IntArray]:
    """Triangulate the unit disk in concentric rings.

    Parameters
    ----------
    rings : int
        Rings around the centre, at least 1; ring ``k`` has ``6 k`` vertices at radius
        ``k / rings``.

    Returns
    -------
    V : (1 + 3 rings (rings + 1), 2) float64
        From the centre outwards, each ring counterclockwise from the x-axis. The last ``6 rings``
        vertices are the boundary, in order.
    F : (6 rings², 3) int64

    Raises
    ------
    ValueError
        If ``rings`` is not positive.
    """
    check_integer("rings", rings, minimum=1)
    V, F = [np.zeros((1, 2))], []
    inner, m = 0, 1  # the first vertex of the previous ring, and its number of vertices
    for k in range(1, rings + 1):
        outer, step = inner + m, np.arange(6 * k, dtype=np.int64)
        angle = step * (np.pi / (3 * k))
        V.append(np.stack([np.cos(angle), np.sin(angle)], axis=1) * (k / rings))
        # In each of six sectors k triangles have an edge on the outer ring and k - 1 on the inner ring.
        a, b = outer + step, outer + (step + 1) % (6 * k)
        sector, along = np.divmod(step, k)
        c = sector * (k - 1) + along
        F.append(np.stack([a, b, inner + c % m], axis=1))
        F.append(np.stack([a, inner + c % m, inner + (c - 1) % m], axis=1)[along > 0])
        inner, m = outer, 6 * k
    return np.concatenate(V), np.concatenate(F)


def random_delaunay(n: int, seed: int | np.random.Generator = 0) -> tuple[FloatArray, IntArray]:
    """Triangulate the unit disk irregularly but with well-shaped triangles.

    The points are random. Four rounds then move each interior point to the centroid of its triangles.

    Parameters
    ----------
    n : int
        Number of vertices, at least 4.
    seed : int or numpy.random.Generator
        Seed of the random points, or their generator.

    Returns
    -------
    V : (n, 2) float64
        The first vertices are the boundary, evenly spaced on the unit circle and counterclockwise.
    F : (f, 3) int64

    Raises
    ------
    ValueError
        If there are fewer than 4 vertices.
    """
    check_integer("n", n, minimum=4)
    if not isinstance(seed, np.random.Generator):
        check_integer("seed", seed, minimum=0)
    # The number of boundary vertices of a disk of equilateral triangles.
    k = int(np.sqrt(12 * n - 3) - 3 + 1e-9)
    angle = np.arange(k) * (2 * np.pi / k)
    rng = np.random.default_rng(seed)
    radius = (1 - np.pi / k) * np.sqrt(rng.random(n - k))
    turn = rng.random(n - k) * (2 * np.pi)
    angle, radius = np.concatenate([angle, turn]), np.concatenate([np.ones(k), radius])
    V = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    for _ in range(4):
        F = _delaunay(V)
        V[k:] = _relax(V, F, np.ones(len(F)))[k:]
    return V, _delaunay(V)


# Features of the cat: direction (x, y), mirrored in x, two widths, height, and sharpness of the fall-off.
_CAT = np.array(
    [
        (0.56, 0.70, 0.20, 0.24, +0.80, 1.5),  # ears
        (0.47, 0.62, 0.12, 0.18, -0.30, 2.0),  # hollows of the ears
        (0.42, 0.14, 0.38, 0.30, -0.10, 2.0),  # sockets
        (0.42, 0.14, 0.26, 0.22, +0.20, 4.0),  # eyes
        (0.42, 0.14, 0.055, 0.16, -0.07, 4.0),  # pupils
        (0.19, -0.36, 0.20, 0.19, +0.26, 2.5),  # muzzle
        (0.00, -0.17, 0.14, 0.08, +0.27, 3.0),  # nose
        (0.00, -0.60, 0.16, 0.10, +0.12, 2.0),  # chin
        (0.66, -0.34, 0.22, 0.26, +0.16, 2.0),  # cheeks
    ]
)


def cat(rings: int = 50) -> tuple[FloatArray, IntArray]:
    """Model the head of a cat, a curved surface with one boundary.

    The shape is an ellipsoid, open at the back, with bumps for ears, eyes and nose. It looks along +z, and its ears
    point towards +y. The face makes the distortion of a map easy to see.

    Parameters
    ----------
    rings : int
        Rings of triangles around the nose, at least 1. Below about 30 the features are not resolved.

    Returns
    -------
    V : (1 + 3 rings (rings + 1), 3) float64
        The last ``6 rings`` vertices are the boundary, counterclockwise seen from the front.
    F : (6 rings², 3) int64
        Counterclockwise seen from outside; finer in the face than behind the ears.

    Raises
    ------
    ValueError
        If ``rings`` is not positive.
    """
    check_integer("rings", rings, minimum=1)
    V, F = _cat(int(rings))
    return V.copy(), F.copy()


@lru_cache(maxsize=8)
def _cat(rings: int) -> tuple[FloatArray, IntArray]:
    """Make the cat; it is kept, because it takes forty relaxations."""
    flat, F = disk(rings)
    inside = len(flat) - 6 * rings
    r = np.hypot(*flat.T)[:, None]  # in quarter turns; np.sinc avoids 0 / 0 in flat / r * sin(π r / 2)
    direction = np.concatenate([flat * np.sinc(r / 2) * (np.pi / 2), np.cos(r * (np.pi / 2))], axis=1)
    for _ in range(40):
        away = ((direction[F].mean(axis=1) - (0, -0.05, 1)) ** 2).sum(axis=1)
        # The weights concentrate the triangles in the face.
        moved = _relax(_cat_point(direction), F, 1 + 6 * np.exp(-away / 0.6))[:inside]
        direction[:inside] = moved / np.linalg.norm(moved, axis=1)[:, None]
    return _cat_point(direction), F


def _cat_point(direction: FloatArray) -> FloatArray:
    """Points of the cat in unit directions from its centre; both (n, 3) float64."""
    radius = 1 / np.linalg.norm(direction / (1.12, 0.98, 0.80), axis=1)
    for x, y, wide, high, height, sharpness in _CAT:
        z = np.sqrt(1 - x * x - y * y)
        for side in (x, -x) if x else (x,):
            away = np.linalg.norm((direction - (side, y, z)) / (wide, high, 0.4), axis=1)
            radius += height * np.exp(-(away**sharpness))
    return np.asarray(direction * radius[:, None])


def starfish(arms: int = 5, rings: int = 40) -> tuple[FloatArray, IntArray]:
    """Model a starfish, a closed surface that maps well to the plane only if cuts reach the ends of its arms.

    It is a flattened ball with arms at its equator.

    Parameters
    ----------
    arms : int
        Number of arms, evenly spaced, at least 1.
    rings : int
        Rings of triangles from the centre of either side to the equator, at least 2. The equator has ``6 rings``
        vertices; use at least a dozen for each arm.

    Returns
    -------
    V : (6 rings² + 2, 3) float64
        The upper side from the centre outwards, including the equator, then the lower side.
    F : (12 rings², 3) int64
        Counterclockwise seen from outside.

    Raises
    ------
    ValueError
        If there is no arm, or there are fewer than 2 rings.
    """
    check_integer("arms", arms, minimum=1)
    check_integer("rings", rings, minimum=2)
    flat, upper = disk(rings)
    inside = len(flat) - 6 * rings
    r = np.hypot(*flat.T)[:, None]
    across = flat * np.sinc(r / 2) * (np.pi / 2)
    drawn_out = (0.5 + 0.5 * np.cos(arms * np.arctan2(*flat.T[::-1])[:, None])) ** 3 * np.sin(r * (np.pi / 2)) ** 6
    V = np.concatenate([across * (1 + 3 * drawn_out), 0.45 * np.cos(r * (np.pi / 2))], axis=1)
    # The lower side is the mirror image of the upper side and shares its equator.
    lower = np.concatenate([len(flat) + np.arange(inside), np.arange(inside, len(flat))])
    return np.concatenate([V, V[:inside] * (1, 1, -1)]), np.concatenate([upper, lower[upper[:, ::-1]]])


def refine(V: ArrayLike, F: ArrayLike) -> tuple[FloatArray, IntArray]:
    """Split every triangle into four at the midpoints of its edges.

    Parameters
    ----------
    V : (n, 2) or (n, 3) float
    F : (f, 3) int

    Returns
    -------
    V : (n + e, d) float64
        The given vertices, then the midpoint of each of the ``e`` edges.
    F : (4 f, 3) int64
        Triangle ``t`` becomes ``4 t … 4 t + 3``: three corner triangles, then the middle triangle.

    Raises
    ------
    ValueError
        If an array has the wrong shape or contents.
    """
    V = vertex_array(V)
    F = triangle_array(F, len(V))
    pairs, side = find_sides(F, len(V))
    # Corners a, b, c and the midpoints of ab, bc, ca are columns 0 to 5.
    six = np.concatenate([F, len(V) + side], axis=1)
    quarters = six[:, [0, 3, 5, 3, 1, 4, 5, 4, 2, 3, 4, 5]].reshape(-1, 3)
    return np.concatenate([V, V[pairs].mean(axis=1)]), quarters


def _rectangles(
    x: FloatArray, y: FloatArray, solid: NDArray[np.bool_] | None, alternating: bool
) -> tuple[FloatArray, IntArray]:
    """Triangulate the cells between grid lines; only the ``solid`` cells if given."""
    nx, ny = x.size - 1, y.size - 1
    j, i = np.divmod(np.arange(nx * ny), nx)
    low = i + j * (nx + 1)
    corners = np.stack([low, low + 1, low + nx + 2, low + nx + 1], axis=1)
    falling = (i + j) % 2 == 1 if alternating else np.zeros(nx * ny, dtype=bool)
    # In the corners of the square the diagonal must end at the corner; otherwise it is a chord.
    falling[[0, -1]] = False
    falling[[nx - 1, -nx]] = True
    corners[falling] = np.roll(corners[falling], -1, axis=1)
    if solid is not None:
        corners = corners[solid.ravel()]
    F = corners[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    X, Y = np.meshgrid(x, y)
    used, F = np.unique(F, return_inverse=True)
    return np.stack([X.ravel(), Y.ravel()], axis=1)[used], F.reshape(-1, 3).astype(np.int64)


def _delaunay(V: FloatArray) -> IntArray:
    """Delaunay triangles of points in the plane, counterclockwise and in a deterministic order."""
    F: IntArray = Delaunay(V).simplices.astype(np.int64)
    a, b, c = V[F[:, 0]], V[F[:, 1]], V[F[:, 2]]
    turned = (b - a)[:, 0] * (c - a)[:, 1] < (b - a)[:, 1] * (c - a)[:, 0]
    F[turned] = F[turned][:, ::-1]
    return F


def _relax(V: FloatArray, F: IntArray, weight: FloatArray) -> FloatArray:
    """Move every vertex to the centroid of its triangles, weighted by (f,) ``weight`` × area."""
    corners = V[F]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    # Lagrange's identity gives twice the area in the plane and in space.
    area = np.sqrt(np.maximum((a * a).sum(1) * (b * b).sum(1) - (a * b).sum(1) ** 2, 0))
    triangle = np.arange(F.size) // 3
    around = csr_array(((weight * area)[triangle], (F.ravel(), triangle)), shape=(len(V), len(F)))
    return np.asarray((around @ corners.mean(axis=1)) / around.sum(axis=1)[:, None])
