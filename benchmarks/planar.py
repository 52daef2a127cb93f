"""Planar meshes with holes, and injective maps of them, for `problems`. Points are complex numbers."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay

from quasiharmonic import refine, surfaces
from quasiharmonic.geometry.mesh.topology import boundary_edges, boundary_loops, components, edges
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray

Generator = np.random.Generator
Plane = tuple[ComplexArray, IntArray]


class Draft(NamedTuple):
    """A planar mesh and a map of it, as made by a family.

    Attributes
    ----------
    z : (n,) complex128
        The rest mesh.
    F : (f, 3) int64
    image : (n,) complex128
        The map; only fixed vertices count if no solution is known.
    pins : (k,) int64
        Interior vertices to fix.
    feasible : bool
        Whether the image is a solution.
    unit : float
        A factor for the rest positions after scaling them to size 1.
    """

    z: ComplexArray
    F: IntArray
    image: ComplexArray
    pins: IntArray = np.empty(0, dtype=np.int64)
    feasible: bool = True
    unit: float = 1.0


def points(z: ComplexArray) -> FloatArray:
    """Return complex numbers as (n, 2)."""
    return np.stack([z.real, z.imag], axis=1)


def span(z: ComplexArray) -> float:
    """Return the longer side of the bounding box of points."""
    return float(max(np.ptp(z.real), np.ptp(z.imag)))


def areas(z: ComplexArray, F: IntArray) -> FloatArray:
    """Return the signed area of every triangle."""
    a, b, c = z[F.T]
    return 0.5 * ((b - a).conj() * (c - a)).imag


def positive(z: ComplexArray, F: IntArray, share: float = 1e-9) -> bool:
    """Whether every triangle has at least this share of the mean area, safely above rounding."""
    signed = areas(z, F)
    return bool(signed.min() > share * abs(signed.mean()))


def blank(rng: Generator, size: int, holes: int) -> Plane:
    """Return a random planar mesh with about ``size`` triangles and ``holes`` + 1 boundary loops."""
    make = rng.choice(["grid", "rings", "even", "graded"])
    n = max(12, size // 2)
    if make == "grid":
        nx = max(2, round(np.sqrt(n * rng.uniform(0.3, 3))))
        V, F = surfaces.grid(nx, max(2, n // nx), alternating=bool(rng.integers(2)))
    elif make == "rings":
        V, F = surfaces.disk(max(2, round(np.sqrt(size / 6))))
    elif make == "even" and n < 5000:
        V, F = surfaces.random_delaunay(n, int(rng.integers(1 << 30)))
    else:
        V, F = _graded(rng, n)
    z = V[:, 0] + 1j * V[:, 1]
    if holes and len(F) > 40:
        z, F = _pierced(rng, z, F, holes)
    return z, F


def _graded(rng: Generator, n: int) -> tuple[FloatArray, IntArray]:
    """Return a Delaunay triangulation of points that concentrate around the middle of a disk."""
    k = max(6, int(np.sqrt(n)))
    rim = np.exp(2j * np.pi * np.arange(k) / k)
    inner = (1 - 2 / k) * rng.random(n - k) ** rng.uniform(0.5, 2.5) * np.exp(2j * np.pi * rng.random(n - k))
    V = points(np.concatenate([rim, inner]))
    # Delaunay triangulation may omit a point that is very close to another.
    used, corners = np.unique(Delaunay(V).simplices, return_inverse=True)
    V, F = V[used], corners.reshape(-1, 3).astype(np.int64)
    turned = areas(V[:, 0] + 1j * V[:, 1], F) < 0
    F[turned] = F[turned][:, ::-1]
    return V, F


def _pierced(rng: Generator, z: ComplexArray, F: IntArray, holes: int) -> Plane:
    """Cut holes into a mesh; skip holes that would touch another loop."""
    for _ in range(4 * holes):
        loops = len(boundary_loops(F, len(z)))
        if loops > holes:
            break
        away = abs(z - z[rng.integers(len(z))])
        left = F[(away[F] > np.quantile(away, rng.uniform(0.01, 0.08))).all(axis=1)]
        if len(left) < 0.6 * len(F):
            continue
        used, renumbered = np.unique(left, return_inverse=True)
        renumbered = renumbered.reshape(-1, 3)
        # A vertex that the boundary passes twice is not manifold.
        outgoing = np.bincount(boundary_edges(renumbered, used.size)[:, 0])
        if outgoing.max() > 1 or components(renumbered, used.size).max() > 0:
            continue
        if len(boundary_loops(renumbered, used.size)) == loops + 1:
            z, F = z[used], renumbered
    return z, F


def without_chords(z: ComplexArray, F: IntArray) -> Plane:
    """Split interior edges that join two boundary vertices: such an edge alone can make a map impossible."""
    found = edges(F, len(z))
    rim = np.zeros(len(z), dtype=bool)
    rim[found.boundary] = True
    refined = refine(points(z), F, found.interior[rim[found.interior].all(axis=1)])
    return refined.V[:, 0] + 1j * refined.V[:, 1], refined.F


def cells(mask: NDArray[np.bool_]) -> Plane:
    """Return unit squares at the true entries of a mask, [row, column] at (column, row): points and (m, 4) corners."""
    j, i = np.nonzero(mask)
    wide = mask.shape[1] + 1
    low = i + j * wide
    used, quads = np.unique(np.stack([low, low + 1, low + wide + 1, low + wide], axis=1), return_inverse=True)
    return used % wide + 1j * (used // wide), quads.reshape(-1, 4)


def split(rng: Generator, quads: IntArray) -> IntArray:
    """Split quadrilaterals into triangles along random diagonals."""
    turned = np.where((rng.random(len(quads)) < 0.5)[:, None], quads, np.roll(quads, 1, axis=1))
    return turned[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


def maze(rng: Generator, rooms: int, width: int, ways: int, winding: float) -> NDArray[np.bool_]:
    """Return a maze of ``rooms`` × ``rooms`` rooms with ``ways`` extra openings; ``winding`` makes corridors longer."""
    pitch = width + 1
    mask = np.zeros((rooms * pitch - 1,) * 2, dtype=bool)
    seen = np.zeros((rooms, rooms), dtype=bool)

    def room(j: int, i: int) -> None:
        seen[j, i] = True
        mask[j * pitch : j * pitch + width, i * pitch : i * pitch + width] = True

    def door(j: int, i: int, v: int, u: int) -> None:
        low, left = min(j, v) * pitch, min(i, u) * pitch
        mask[low : low + width + abs(v - j), left : left + width + abs(u - i)] = True

    def around(j: int, i: int) -> list[tuple[int, int]]:
        near = [(j + 1, i), (j - 1, i), (j, i + 1), (j, i - 1)]
        return [(v, u) for v, u in near if 0 <= v < rooms and 0 <= u < rooms]

    open_rooms = [(0, 0)]
    room(0, 0)
    while open_rooms:
        # Continuing from the last room makes long corridors; continuing from a random room makes a bush.
        at = len(open_rooms) - 1 if rng.random() < winding else int(rng.integers(len(open_rooms)))
        fresh = [near for near in around(*open_rooms[at]) if not seen[near]]
        if not fresh:
            open_rooms.pop(at)
            continue
        there = fresh[rng.integers(len(fresh))]
        room(*there)
        door(*open_rooms[at], *there)
        open_rooms.append(there)
    for _ in range(ways):
        j, i = (int(k) for k in rng.integers(rooms, size=2))
        near = around(j, i)
        door(j, i, *near[rng.integers(len(near))])
    return mask


def limbed(body: int, limbs: int, rows: int, width: int) -> tuple[ComplexArray, IntArray, list[IntArray]]:
    """Return a square of cells with straight limbs ``width`` wide: points, quadrilaterals, rows of every limb."""
    z, quads = cells(np.ones((body, body), dtype=bool))
    index = np.arange(z.size).reshape(body + 1, body + 1)
    left = (body - width) // 2
    # Order the sides so that limbs run from left to right when viewed from outside.
    sides = [index[-1], index[::-1, -1], index[0, ::-1], index[:, 0]]
    grown, parts, count = [], [z], z.size
    for side in sides[:limbs]:
        root = side[left : left + width + 1]
        outward = 1j * (z[root[1]] - z[root[0]])
        new = count + np.arange((width + 1) * rows).reshape(rows, width + 1)
        parts.append((z[root] + outward * np.arange(1, rows + 1)[:, None]).ravel())
        limb = np.concatenate([root[None], new])
        corners = [limb[:-1, :-1], limb[:-1, 1:], limb[1:, 1:], limb[1:, :-1]]
        quads = np.concatenate([quads, np.stack([c.ravel() for c in corners], axis=1)])
        grown.append(limb)
        count += new.size
    return np.concatenate(parts), quads, grown


def carved(rng: Generator, F: IntArray, n: int, share: float) -> IntArray:
    """Remove triangles from the boundary until a share of the interior vertices lies on the boundary."""
    across = {(int(t[k]), int(t[k - 2])): (f, int(t[k - 1])) for f, t in enumerate(F.tolist()) for k in range(3)}
    rim = [tuple(e) for e in boundary_edges(F, n).tolist()]
    on_rim = np.zeros(n, dtype=bool)
    on_rim[boundary_edges(F, n)] = True
    kept = np.ones(len(F), dtype=bool)
    goal = share * (n - on_rim.sum())
    while rim and goal >= 1:
        at = int(rng.integers(len(rim)))
        rim[at], rim[-1] = rim[-1], rim[at]
        i, j = rim.pop()
        f, k = across[i, j]
        if kept[f] and not on_rim[k]:
            kept[f], on_rim[k] = False, True
            goal -= 1
            rim += [(i, k), (k, j)]
    return F[kept]


class Mover:
    """Moves vertices in classes that share no triangle, and keeps every triangle positive."""

    def __init__(self, F: IntArray, n: int) -> None:
        near: list[set[int]] = [set() for _ in range(n)]
        for i, j, k in F.tolist():
            near[i] |= {j, k}
            near[j] |= {i, k}
            near[k] |= {i, j}
        colour = np.full(n, -1)
        for i in range(n):
            taken = {int(colour[j]) for j in near[i]}
            colour[i] = next(c for c in range(n) if c not in taken)
        self._groups = []
        for c in range(colour.max() + 1):
            t, k = np.nonzero(colour[F] == c)
            self._groups.append((t, F[t, k], F[t, (k + 1) % 3], F[t, (k + 2) % 3]))

    def move(self, z: ComplexArray, step: ComplexArray, floor: FloatArray) -> ComplexArray:
        """Move every vertex by its step, halved while a triangle's area would fall below its own ``floor``."""
        z = z.copy()
        for t, a, b, c in self._groups:
            side = (z[c] - z[b]).conj()
            # Triangles already below their floor must not shrink further, except for rounding.
            least = np.minimum(floor[t], (1 - 1e-9) * 0.5 * (side * (z[a] - z[b])).imag)
            going, moved = step.copy(), np.unique(a)
            for attempt in range(12):
                stuck = a[0.5 * (side * (z[a] + going[a] - z[b])).imag < least]
                if not stuck.size:
                    break
                going[stuck] = 0 if attempt == 10 else going[stuck] / (4 if attempt else 2)
            z[moved] += going[moved]
        return z


def roughen(
    rng: Generator, z: ComplexArray, F: IntArray, sweeps: int, share: float = 1e-3, held: IntArray | None = None
) -> ComplexArray:
    """Move all vertices except ``held`` at random; triangles keep a share of their area."""
    if sweeps == 0:
        return z
    mover, n = Mover(F, len(z)), len(z)
    floor = share * areas(z, F)
    for _ in range(sweeps):
        reach = np.full(n, np.inf)
        for k in range(3):
            np.minimum.at(reach, F[:, k], abs(z[F[:, k]] - z[F[:, k - 1]]))
            np.minimum.at(reach, F[:, k], abs(z[F[:, k]] - z[F[:, k - 2]]))
        step = 2 * reach * rng.random(n) * np.exp(2j * np.pi * rng.random(n))
        if held is not None:
            step[held] = 0
        z = mover.move(z, step, floor)
    return z


def flow(
    rng: Generator, z: ComplexArray, F: IntArray, times: int, strength: float, held: IntArray | None = None
) -> ComplexArray:
    """Twist, drag or pinch the plane in random disks, by a share of what the triangles allow."""
    for _ in range(times):
        centre, radius = z[rng.integers(len(z))], span(z) * rng.uniform(0.15, 0.6)
        bump = np.clip(1 - (abs(z - centre) / radius) ** 2, 0, None) ** 2
        if held is not None:
            bump[held] = 0
        kind, way = int(rng.integers(3)), np.exp(2j * np.pi * rng.random())
        warp = partial(_warped, z, kind, bump, centre, radius * way)
        z = strongest(warp, F, 10.0, strength)
    return z


def _warped(z: ComplexArray, kind: int, bump: FloatArray, centre: complex, drag: complex, t: float) -> ComplexArray:
    """Return points twisted around a centre in either direction, dragged along, or contracted to the centre."""
    if kind == 0:
        return centre + (z - centre) * np.exp(1j * np.sign(drag.real) * t * bump)
    return z + t * drag * bump if kind == 1 else centre + (z - centre) * np.exp(-t * bump)


def strongest(moved: Callable[[float], ComplexArray], F: IntArray, most: float, share: float) -> ComplexArray:
    """Return points moved by a share of the greatest strength, up to ``most``, that keeps triangles positive."""
    low, high = 0.0, most
    for _ in range(24):
        middle = 0.5 * (low + high)
        if positive(moved(middle), F):
            low = middle
        else:
            high = middle
    # Some motions are not monotone: a smaller strength may invert triangles that a larger one keeps positive.
    strength = share * low
    while not positive(moved(strength), F) and strength > 1e-3 * low:
        strength *= 0.8
    return moved(strength) if positive(moved(strength), F) else moved(0.0)
