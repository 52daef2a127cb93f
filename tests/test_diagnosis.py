"""Every obstruction is found where it was put, and none where a map is known."""

from __future__ import annotations

import json

import numpy as np
import pytest
from meshes import boundary_of

from quasiharmonic.diagnosis import Forbids, Kind, diagnose
from quasiharmonic.inject import injective_map
from quasiharmonic.mesh.topology import boundary_loops
from quasiharmonic.predicates import orientation
from quasiharmonic.problem import Problem
from quasiharmonic.refinement import refine
from quasiharmonic.surfaces import annulus, grid, random_delaunay

ARROW = [[0, 0], [2, -1], [0.5, 0], [2, 1]]  # seen from (0.3, 0), not from (1, 0)
SQUARE = [[0, 0], [4, 0], [4, 4], [0, 4]]
# A corridor around three sides of a square: nobody sees from one end to the other.
U = [[0, 0], [9, 0], [9, 9], [6, 9], [6, 3], [3, 3], [3, 9], [0, 9]]


def circle(n):
    t = 2 * np.pi * np.arange(n) / n
    return np.stack([np.cos(t), np.sin(t)], axis=1)


def wheel(n):
    """A vertex ``n`` joined to a ring of ``n``, each two neighbours of which make a triangle with it."""
    i = np.arange(n)
    return np.concatenate([circle(n), np.zeros((1, 2))]), np.stack([i, (i + 1) % n, np.full(n, n)], axis=1)


def loose_wheel(n):
    """As `wheel`, with a vertex ``n + 1 + i`` in each triangle: the hub has no boundary triangle."""
    V, F = wheel(n)
    middle = V[F].mean(axis=1)
    k = n + 1 + np.arange(n)
    a, b, c = F.T
    parts = [np.stack(t, axis=1) for t in ((a, b, k), (b, c, k), (c, a, k))]
    return np.concatenate([V, middle]), np.concatenate(parts)


def two_wheels(n, m):
    """A ring of ``n`` with a chord from 0 to ``m`` and a hub on either side, ``n`` to its right."""
    rings = [np.arange(m + 1), np.append(np.arange(m, n), 0)]
    V, F = circle(n), []
    for hub, ring in enumerate(rings, start=n):
        V = np.concatenate([V, V[ring].mean(axis=0)[None]])
        F += [(ring[k - 1], ring[k], hub) for k in range(len(ring))]
    return V, np.array(F)


def handle(n=6):
    """A torus of ``n`` by ``n`` cells without one cell: one boundary loop, and a handle."""
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")

    def at(a, b):
        return (a % n) * n + b % n

    F = np.stack(
        [
            np.stack([at(i, j), at(i + 1, j), at(i + 1, j + 1)], axis=-1),
            np.stack([at(i, j), at(i + 1, j + 1), at(i, j + 1)], axis=-1),
        ],
        axis=2,
    ).reshape(-1, 3)
    a, b = 2 * np.pi * i.ravel() / n, 2 * np.pi * j.ravel() / n
    V = np.stack([(2 + np.cos(b)) * np.cos(a), (2 + np.cos(b)) * np.sin(a), np.sin(b)], axis=1)
    return V, F[2:]


def problem(V, F, *, pins=(), **moved):
    """The planar mesh itself as a problem, or what other positions are given by vertex (``at=...``)."""
    V = np.asarray(V, dtype=float)
    where = V[:, :2].copy()
    for vertex, position in moved.get("at", {}).items():
        where[vertex] = position
    if "ring" in moved:
        where[: len(moved["ring"])] = moved["ring"]
    fixed = np.concatenate([boundary_of(F), np.asarray(pins, dtype=int)])
    return Problem(V, F, fixed, where[fixed], reference="equilateral")


def onto(V, F, *targets, **more):
    """A problem whose loops, in the order of `boundary_loops`, go onto given polygons."""
    where = np.full((len(V), 2), np.nan)
    for loop, target in zip(boundary_loops(F, len(V)), targets, strict=True):
        where[loop] = np.asarray(target, dtype=float)
    fixed = boundary_of(F)
    return Problem(V, F, fixed, where[fixed], reference="equilateral", **more)


def spread(polygon, n):
    """``n`` points on a polygon: its corners, and others evenly on its longest sides."""
    points = [np.asarray(p, dtype=float) for p in polygon]
    while len(points) < n:
        k = int(np.argmax([np.linalg.norm(points[k] - points[k - 1]) for k in range(len(points))]))
        points.insert(k, (points[k] + points[k - 1]) / 2)
    return np.array(points)


def collapsed_boundary_edge():
    return problem(*wheel(5), at={1: circle(5)[0]})


def collapsed_pinned_edge():
    V, F = grid(4, 4)
    return problem(V, F, pins=[6, 7], at={6: V[7]})


def inverted_ear():
    # 0, 1, 2 is the ear; its corner 1 goes inwards, between 0 and 2.
    return problem([[0, 0], [4, 0], [4, 4], [0, 4], [1, 3]], [[0, 1, 2], [0, 2, 4], [2, 3, 4], [3, 0, 4]], at={1: [1, 2]})


def flat_ear():
    return problem([[0, 0], [4, 0], [4, 4], [0, 4], [1, 3]], [[0, 1, 2], [0, 2, 4], [2, 3, 4], [3, 0, 4]], at={1: [2, 2]})


def chord_outside():
    return problem(*two_wheels(8, 4), ring=[[0, 0], [1, 3], [2, 4], [3, 3], [4, 0], [4, 6], [2, 7], [0, 6]])


def chord_through_corner():
    return problem(*two_wheels(8, 4), ring=[[0, 0], [1, -1], [2, 0], [3, -1], [4, 0], [4, 6], [2, 7], [0, 6]])


def chord_along_boundary():
    return problem(*two_wheels(8, 4), ring=[[0, 0], [1, -1], [2, 0], [3, 0], [4, 0], [4, 6], [2, 7], [0, 6]])


def crossing_pinned_edges():
    V, F = grid(6, 6)
    return problem(V, F, pins=[15, 16, 31, 32], at={15: [0.4, 0.4], 16: [0.6, 0.6], 31: [0.4, 0.6], 32: [0.6, 0.4]})


def pin_on_pinned_edge():
    V, F = grid(6, 6)
    return problem(V, F, pins=[15, 16, 32], at={15: [0.25, 0.5], 16: [0.75, 0.5], 32: [0.5, 0.5]})


def pin_outside():
    V, F = grid(4, 4)
    return problem(V, F, pins=[12], at={12: [2.0, 0.5]})


def pin_on_boundary():
    V, F = grid(4, 4)
    return problem(V, F, pins=[12], at={12: [1.0, 0.3]})


def pins_together():
    V, F = grid(6, 6)
    return problem(V, F, pins=[16, 32], at={32: V[16]})


def pin_in_hole():
    V, F = annulus(12)
    pin = int(np.argmin(np.linalg.norm(V - [0.75, 0.0], axis=1)))
    return problem(V, F, pins=[pin], at={pin: [0.1, 0.1]})


def no_kernel():
    return problem(*wheel(8), ring=U)


def opposite_pinned_edges():
    # Both triangles of vertex 12 in a row of cells lie between edges that change sides.
    V, F = wheel(4)
    return problem(V, F, ring=[[0, 0], [4, 0], [2, 1], [2, 0.5]])


def nothing_sees_all():
    return problem(*loose_wheel(8), ring=U)


def seen_from_wrong_side_only():
    # Around the hole nobody sees both of its far corners.
    V, F = annulus(4)
    return problem(V, F, at={})


def mirrored():
    return onto(*random_delaunay(60, seed=1), circle(len(boundary_of(random_delaunay(60, seed=1)[1])))[::-1])
