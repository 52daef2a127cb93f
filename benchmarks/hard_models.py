"""Hard-surface models with sizes as parameters: plates, profiles, boxes, tubes, cones, blocks, gears, sheets."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Mesh = tuple[NDArray[np.float64], NDArray[np.int64]]


def split_edges(V: NDArray[np.float64], F: NDArray[np.int64], times: int) -> Mesh:
    """Divide every triangle into four, several times."""
    for _ in range(times):
        sides = np.sort(np.concatenate([F[:, [0, 1]], F[:, [1, 2]], F[:, [2, 0]]]), axis=1)
        ends, number = np.unique(sides, axis=0, return_inverse=True)
        a, b, c = (number.ravel() + len(V)).reshape(3, -1)
        x, y, z = F.T
        F = np.concatenate([np.stack(part, axis=1) for part in ((x, a, c), (a, y, b), (c, b, z), (a, b, c))])
        V = np.concatenate([V, V[ends].mean(axis=1)])
    return V, F


def blocks(solid: NDArray[np.bool_]) -> Mesh:
    """The surface of unit blocks."""
    padded = np.pad(solid, 1)
    squares = []
    for axis in range(3):
        for sense in (1, -1):
            at = np.argwhere(padded & ~np.roll(padded, -sense, axis=axis))
            first, second = np.eye(3, dtype=int)[[(axis + 1) % 3, (axis + 2) % 3]][::sense]
            corner = at + (np.eye(3, dtype=int)[axis] if sense > 0 else 0)
            squares.append(np.stack([corner, corner + first, corner + first + second, corner + second], axis=1))
    corners = np.concatenate(squares)
    V, number = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    Q = number.reshape(-1, 4)
    return V.astype(np.float64), np.concatenate([Q[:, [0, 1, 2]], Q[:, [0, 2, 3]]])


def sheet(points: NDArray[np.float64], *, closed: bool = False) -> Mesh:
    """Two triangles per cell of a grid of positions (m, n, 3); the last row may be joined to the first."""
    m, n = points.shape[:2]
    number = np.arange(m * n).reshape(m, n)
    number = np.vstack([number, number[:1]]) if closed else number
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    triangles = [np.stack([a, b, c], axis=-1).reshape(-1, 3), np.stack([a, c, d], axis=-1).reshape(-1, 3)]
    return points.reshape(-1, 3), np.concatenate(triangles)


def triangulate(outline: ArrayLike) -> NDArray[np.int64]:
    """Cut ears off a simple polygon (n, 2), counterclockwise; each ear has the largest smallest height."""
    P = np.asarray(outline, dtype=np.float64)
    rest, found = list(range(len(P))), []

    def height(k: int) -> float:
        a, b, c = (P[rest[(k + step) % len(rest)]] for step in (-1, 0, 1))
        turns = [(q[0] - p[0]) * (P[rest, 1] - p[1]) - (q[1] - p[1]) * (P[rest, 0] - p[0]) for p, q in ((a, b), (b, c))]
        turns.append((a[0] - c[0]) * (P[rest, 1] - c[1]) - (a[1] - c[1]) * (P[rest, 0] - c[0]))
        doubled = turns[0][(k + 1) % len(rest)]
        # A corner on a side would leave a triangle without area, also if rounding places it outside.
        inside = np.all(np.array(turns) >= -1e-9 * doubled, axis=0)
        longest = max(np.linalg.norm(a - b), np.linalg.norm(b - c), np.linalg.norm(c - a))
        return float(doubled / longest) if doubled > 0 and inside.sum() <= 3 else 0.0

    while len(rest) > 3:
        k = max(range(len(rest)), key=height)
        found.append([rest[k - 1], rest[k], rest[(k + 1) % len(rest)]])
        del rest[k]
    return np.array([*found, rest])


def extrude(P: NDArray[np.float64], T: NDArray[np.int64], heights: ArrayLike, *, caps: bool = True) -> Mesh:
    """A prism over a triangulated polygon (n, 2), which may have holes; one ring of vertices at each height."""
    z = np.asarray(heights, dtype=np.float64)
    n = len(P)
    V = np.column_stack([np.tile(P, (z.size, 1)), np.repeat(z, n)])
    sides = np.concatenate([T[:, [0, 1]], T[:, [1, 2]], T[:, [2, 0]]])
    there = set(map(tuple, sides.tolist()))
    rim = np.array([side for side in sides.tolist() if (side[1], side[0]) not in there])
    a, b = (rim.T[:, None] + n * np.arange(z.size - 1)[:, None]).reshape(2, -1)
    walls = [np.stack([a, b, b + n], axis=1), np.stack([a, b + n, a + n], axis=1)]
    if caps:
        return V, np.concatenate([T[:, ::-1], T + n * (z.size - 1), *walls])
    used, number = np.unique(np.concatenate(walls), return_inverse=True)
    return V[used], number.reshape(-1, 3)


def profile(outline: ArrayLike, heights: ArrayLike = (0, 1)) -> Mesh:
    """An extruded simple polygon (n, 2), counterclockwise."""
    return extrude(np.asarray(outline, dtype=np.float64), triangulate(outline), heights)


def channel(width: float = 2, depth: float = 1, thick: float = 0.2, length: float = 4) -> Mesh:
    """A channel with a U-shaped cross-section."""
    w, d, t = width, depth, thick
    return profile([[0, 0], [w, 0], [w, d], [w - t, d], [w - t, t], [t, t], [t, d], [0, d]], (0, length))


def bracket(width: float = 2, height: float = 1.5, thick: float = 0.3, length: float = 1, fillet: int = 0) -> Mesh:
    """An L bracket; the inner edge may be a fillet of some quadrilaterals."""
    w, h, t, r = width, height, thick, 0.3 * min(width, height)
    turn = np.linspace(0, np.pi / 2, fillet + 1)
    inner = np.column_stack([t + r - r * np.sin(turn), t + r - r * np.cos(turn)]) if fillet else [[t, t]]
    return profile(np.concatenate([[[0, 0], [w, 0], [w, t]], inner, [[t, h], [0, h]]]), (0, length))


def stairs(steps: int = 4, run: float = 1, rise: float = 0.7, width: float = 3) -> Mesh:
    """Stairs with a flat base and back."""
    k = np.arange(steps, 0, -1)
    treads = np.stack([np.stack([k * run, (steps - k) * rise], 1), np.stack([k * run, (steps - k + 1) * rise], 1)], 1)
    return profile(np.concatenate([[[0, 0]], treads.reshape(-1, 2), [[0, steps * rise]]]), (0, width))


def house(width: float = 2, wall: float = 1.5, roof: float = 0.8, length: float = 3) -> Mesh:
    """A house with a gable roof."""
    return profile([[0, 0], [width, 0], [width, wall], [width / 2, wall + roof], [0, wall]], (0, length))


def box(a: float = 1, b: float = 1, c: float = 1, times: int = 0) -> Mesh:
    """A box, its triangles divided several times."""
    V, F = blocks(np.ones((1, 1, 1), dtype=bool))
    return split_edges(V * [a, b, c], F, times)


def polygon(n: int, radius: float = 1) -> NDArray[np.float64]:
    """A regular polygon."""
    angle = 2 * np.pi * np.arange(n) / n
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


def tube(n: int = 24, radius: float = 0.5, length: float = 3, rings: int = 1, *, caps: bool = False) -> Mesh:
    """A tube with n sides, open or with flat caps."""
    P = polygon(n, radius)
    return extrude(P, triangulate(P), np.linspace(0, length, rings + 1), caps=caps)


def cone(n: int = 24, radius: float = 1, height: float = 2, *, cap: bool = True) -> Mesh:
    """A cone over a regular polygon."""
    P = polygon(n, radius)
    k = np.arange(n)
    V = np.vstack([np.column_stack([P, np.zeros(n)]), [0, 0, height]])
    sides = np.stack([k, (k + 1) % n, np.full(n, n)], axis=1)
    return V, np.concatenate([sides, triangulate(P)[:, ::-1]]) if cap else sides


def pierced(across: int, deep: int, radius: float = 0.25, corners: int = 16) -> Mesh:
    """A flat rectangle of unit squares, each with a round hole, in the plane z = 0; ``corners`` is a multiple of 4."""
    m = corners // 4
    side = np.column_stack([np.linspace(-0.5, 0.5, m + 1)[:-1], np.full(m, -0.5)])
    square = np.concatenate([_turn(side, k) for k in range(4)])
    middle = np.stack(np.meshgrid(np.arange(across), np.arange(deep), indexing="ij"), axis=-1).reshape(-1, 1, 2)
    hole = radius * square / np.linalg.norm(square, axis=1, keepdims=True)
    points = (np.concatenate([square, hole]) + middle).reshape(-1, 2)
    V, number = np.unique(np.round(points, 9), axis=0, return_inverse=True)
    k = np.arange(4 * m)
    after, inner = (k + 1) % (4 * m), 4 * m
    ring = np.concatenate([np.stack([k, after, after + inner], 1), np.stack([k, after + inner, k + inner], 1)])
    rows = ring + 8 * m * np.arange(across * deep)[:, None, None]
    return np.pad(V, [(0, 0), (0, 1)]), number.ravel()[rows.reshape(-1, 3)]


def _turn(points: NDArray[np.float64], times: int) -> NDArray[np.float64]:
    """Turn points (n, 2) by right angles, counterclockwise."""
    return points @ np.linalg.matrix_power(np.array([[0, 1], [-1, 0]]), times)


def plate(across: int = 3, deep: int = 1, radius: float = 0.25, thick: float = 0.2, corners: int = 16) -> Mesh:
    """A plate with a round hole in each unit square."""
    V, F = pierced(across, deep, radius, corners)
    return extrude(V[:, :2], F, (0, thick))


def gear(teeth: int = 12, radius: float = 1, tooth: float = 0.2, bore: float = 0.4, thick: float = 0.3) -> Mesh:
    """A gear with a bore."""
    n = 4 * teeth
    reach = np.where(np.arange(n) % 4 < 2, radius + tooth, radius)[:, None]
    P = np.concatenate([polygon(n) * reach, polygon(n, bore)])
    k = np.arange(n)
    after = (k + 1) % n
    ring = np.concatenate([np.stack([k, after, after + n], axis=1), np.stack([k, after + n, k + n], axis=1)])
    return extrude(P, ring, (0, thick))


def moved(mesh: Mesh, shift: ArrayLike, scale: ArrayLike = 1) -> Mesh:
    """A mesh, scaled and moved."""
    return mesh[0] * np.asarray(scale) + np.asarray(shift), mesh[1]


def together(*meshes: Mesh) -> Mesh:
    """Several meshes as one."""
    first = np.cumsum([0, *(len(V) for V, _ in meshes)])
    return (
        np.concatenate([V for V, _ in meshes]),
        np.concatenate([F + k for (_, F), k in zip(meshes, first, strict=False)]),
    )


def mirrored(half: Mesh) -> Mesh:
    """A mesh with x ≥ 0 and its mirror image; vertices on the plane x = 0 are shared."""
    V, F = half
    image = np.arange(len(V), 2 * len(V))
    points = np.concatenate([V, V * [-1, 1, 1]])
    image[V[:, 0] == 0] = np.flatnonzero(V[:, 0] == 0)
    used, number = np.unique(np.concatenate([F, image[F][:, ::-1]]), return_inverse=True)
    return points[used], number.reshape(-1, 3)


def robot() -> Mesh:
    """A model that is symmetric in x: a body that crosses the plane, two arms and two round legs."""
    V, F = box(0.6, 1, 2)
    low = V.min(axis=0)
    # The body's half is open at the plane.
    half = V - low, F[(V[F][:, :, 0] > low[0]).any(axis=1)]
    arm, leg = moved(box(0.4, 0.5, 1.5, times=1), [0.8, 0, 0]), moved(tube(12, 0.2, 1, 3, caps=True), [0.4, 0.5, -1.2])
    return mirrored(together(half, arm, leg))


def twisted_band(n: int = 11, *, half_turns: int = 1, width: float = 0.3) -> Mesh:
    """A band of n quadrilaterals around a circle, closed after half turns; an odd number makes a Möbius band."""
    t = 2 * np.pi * np.arange(n) / n
    turn = half_turns * t / 2
    out = np.stack([np.cos(t), np.sin(t), 0 * t], axis=1)
    along = width * (np.cos(turn)[:, None] * out + np.sin(turn)[:, None] * [0, 0, 1])
    V, F = sheet(np.stack([out - along, out + along], axis=1), closed=True)
    if half_turns % 2:
        last = (2 * (n - 1) <= F).any(axis=1) & (F < 2).any(axis=1)
        F[last] = np.where(F[last] < 2, 1 - F[last], F[last])
    return V, F


def terrain(size: int, random: np.random.Generator) -> Mesh:
    """Columns of blocks with random heights."""
    heights = random.integers(1, 4, (size, size))
    return blocks(np.arange(3) < heights[..., None])


def golf_ball(random: np.random.Generator, times: int = 3, depth: float = 0.1) -> Mesh:
    """A sphere with dents all over, most edges of which are creases."""
    V, F = split_edges(*blocks(np.ones((2, 2, 2), dtype=bool)), times)
    V -= V.mean(axis=0)
    V /= np.linalg.norm(V, axis=1, keepdims=True)
    return V * (1 - depth * random.random((len(V), 1))), F
