"""Surfaces that need cleaning, and a check of every promise of `clean`."""

from __future__ import annotations

from collections import Counter

import numpy as np

from quasiharmonic import clean, inspect_mesh

TETRAHEDRON = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
OUTWARD = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])


def cube(corner=(0, 0, 0)):
    """A cube of side 1 with its triangles facing outwards."""
    V = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) + np.array(corner)
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return V, np.array([t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))])


def merge(*meshes):
    """Several meshes as one that has each position once."""
    starts = np.cumsum([0, *(len(V) for V, _ in meshes)])
    V, which = np.unique(np.concatenate([V for V, _ in meshes]), axis=0, return_inverse=True)
    return V, which.ravel()[np.concatenate([F + start for (_, F), start in zip(meshes, starts, strict=False)])]


def soup(V, F):
    """The same triangles, each with vertices of its own."""
    return V[F].reshape(-1, V.shape[1]), np.arange(F.size).reshape(-1, 3)


def mobius(n, wide=1):
    """A Möbius band of 2 n · wide triangles, with a step of the winding at its end."""
    around, across = np.divmod(np.arange((n + 1) * (wide + 1)), wide + 1)
    angle, width = 2 * np.pi * around / n, 0.6 * (across / wide - 0.5)
    radius = 1 + width * np.cos(angle / 2)
    V = np.stack([radius * np.cos(angle), radius * np.sin(angle), width * np.sin(angle / 2)], axis=1)
    i, j = (x.ravel() for x in np.meshgrid(np.arange(n), np.arange(wide), indexing="ij"))
    a, b = i * (wide + 1) + j, (i + 1) * (wide + 1) + j
    F = np.concatenate([np.stack([a, b, b + 1], axis=1), np.stack([a, b + 1, a + 1], axis=1)])
    number = np.arange(len(V))
    number[-(wide + 1) :] = np.arange(wide + 1)[::-1]
    return V[: -(wide + 1)], number[F]


def turn(F, rows):
    F = F.copy()
    F[rows] = F[rows][:, ::-1]
    return F


def joined_pairs(cleaned):
    """Pairs of the model's triangles that have a common edge after cleaning."""
    at = {}
    for t, row in zip(cleaned.triangles.tolist(), cleaned.F.tolist(), strict=True):
        for a, b in zip(row, row[1:] + row[:1], strict=True):
            at.setdefault(frozenset((a, b)), []).append(t)
    return {tuple(sorted(pair)) for pair in at.values() if len(pair) == 2}


def check(V, F, **options):
    """Clean and verify every promise by simple loops."""
    cleaned = clean(V, F, **options)
    V, F = np.asarray(V, dtype=float), np.asarray(F, dtype=int)
    rows = cleaned.F.tolist()
    sides = [(a, b) for row in rows for a, b in zip(row, row[1:] + row[:1], strict=True)]
    # No edge has more than two triangles, and two traverse it in opposite directions.
    assert max(Counter(sides).values()) == 1
    assert max(Counter(map(frozenset, rows)).values()) == 1
    assert all(len(set(row)) == 3 for row in rows)
    # The triangles around each vertex form one fan: the links between its triangles connect them.
    behind = dict(zip(sides, (t for t in range(len(rows)) for _ in range(3)), strict=True))
    around = {}
    for t, row in enumerate(rows):
        for v in row:
            around.setdefault(v, set()).add(t)
    assert sorted(around) == list(range(len(cleaned.V)))
    for v, whole in around.items():
        reached, waiting = set(), [min(whole)]
        while waiting:
            t = waiting.pop()
            reached.add(t)
            k = rows[t].index(v)
            for edge in ((rows[t][(k + 1) % 3], v), (v, rows[t][k - 1])):
                if behind.get(edge, t) not in reached:
                    waiting.append(behind[edge])
        assert reached == whole
    report = inspect_mesh(cleaned.V, cleaned.F)
    assert report.clean, report.summary()
    assert report.components == cleaned.facing.size == cleaned.component.max() + 1
    # Every triangle of the model is there, or excluded with a substitute.
    assert sorted([*cleaned.triangles, *cleaned.excluded]) == list(range(len(F)))
    assert (np.diff(cleaned.triangles) > 0).all()
    assert (np.diff(cleaned.excluded) > 0).all()
    assert (np.diff(cleaned.vertices) >= 0).all()
    assert ((cleaned.substitutes >= 0) & (cleaned.substitutes < len(rows))).all()
    model = F[cleaned.triangles]
    model[cleaned.flipped] = model[cleaned.flipped][:, [0, 2, 1]]
    assert np.array_equal(model, cleaned.corners)
    same = ~cleaned.moved
    assert np.array_equal(V[cleaned.corners][same[cleaned.F]], cleaned.V[cleaned.F][same[cleaned.F]])
    assert np.array_equal(cleaned.V[same], V[cleaned.vertices[same]])
    assert same.all() or np.abs(cleaned.V - V[cleaned.vertices]).max() < 1e-3 * np.ptp(V, axis=0).max()
    assert cleaned.widened.any() == cleaned.moved.any()
    # Values at corners find their way back, also those of repeated triangles.
    back = cleaned.restore_corners(cleaned.corners)
    assert np.array_equal(back[cleaned.triangles], F[cleaned.triangles])
    repeated = cleaned.excluded[cleaned.repeated]
    assert np.array_equal(V[back[repeated]], V[F[repeated]])
    # In each component, at most half of the area is reversed.
    if not options.get("outward"):
        e1, e2 = (cleaned.V[cleaned.F[:, k]] - cleaned.V[cleaned.F[:, 0]] for k in (1, 2))
        scale = np.abs(np.concatenate([e1, e2])).max()
        e1, e2 = (np.column_stack([e / scale, np.zeros((len(e), 3 - e.shape[1]))]) for e in (e1, e2))
        area = np.linalg.norm(np.cross(e1, e2), axis=1)
        area[cleaned.widened] = 0
        flipped, whole = np.bincount(cleaned.component, area * cleaned.flipped), np.bincount(cleaned.component, area)
        # Vertices that were moved change areas by less than this.
        tolerance = 1e-2 if cleaned.moved.any() else 1e-9
        assert (flipped <= (0.5 + tolerance) * whole).all()
    # A second cleaning changes nothing.
    again = clean(cleaned.V, cleaned.F, weld=False)
    assert np.array_equal(again.F, cleaned.F)
    assert again.flipped.sum() + again.excluded.size + len(again.seams) == 0
    assert cleaned.summary()
    return cleaned
