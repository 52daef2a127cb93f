"""Synthetic surfaces in place of the paper's scans: an angel, a gargoyle, a rabbit, a bust and a hand, from formulas.

Each is a *field*, negative inside: rounded cones and ellipsoids, joined smoothly. Surface nets mesh it: a vertex in
every grid cell that the surface intersects, and a square across every edge that it crosses. The vertices are relaxed
along the surface. The part below a plane is removed, and the rim of the cut is the boundary. The surfaces stand upright
along y, face +z and are between one and three units high. Two creatures, an octopus and an armadillo, are closed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from quasiharmonic import Problem, refine, targets
from quasiharmonic.geometry.mesh.topology import boundary_edges, boundary_loops, edges
from quasiharmonic.util.arrays import FloatArray, IntArray

Field = Callable[[FloatArray], FloatArray]


def length(vectors: Sequence[FloatArray]) -> FloatArray:
    """Return the lengths of vectors, given one array per coordinate, which takes less time than rows of three."""
    x, y, z = vectors
    return np.sqrt(x * x + y * y + z * z)


def cone(x: FloatArray, a: ArrayLike, b: ArrayLike, ra: float, rb: float) -> FloatArray:
    """The field of the convex hull of two balls: radius ``ra`` at ``a`` and ``rb`` at ``b``."""
    a, axis = np.asarray(a), np.subtract(b, a)
    t = np.clip((x - a) @ axis / (axis @ axis), 0, 1)
    return length([x[..., k] - a[k] - t * axis[k] for k in range(3)]) - (ra + t * (rb - ra))


def ball(
    x: FloatArray, middle: Sequence[float], radii: Sequence[float], turn: float = 0.0, axis: int = 2
) -> FloatArray:
    """The field of an ellipsoid turned about ``axis`` by ``turn`` radians; near it an approximate signed distance."""
    p = [x[..., k] - c for k, c in enumerate(middle)]
    if turn:
        i, j = (k for k in range(3) if k != axis)
        w = (p[i] + 1j * p[j]) * np.exp(-1j * turn)
        p[i], p[j] = w.real, w.imag
    p = [c / radius + 1e-9 for c, radius in zip(p, radii, strict=True)]  # avoid 0 / 0
    near = length(p)
    return near * (near - 1) / length([c / radius for c, radius in zip(p, radii, strict=True)])


def join(smooth: float, *fields: FloatArray) -> FloatArray:
    """The union of fields, with seams rounded over a width of ``smooth``."""
    first, *others = fields
    for other in others:
        h = np.maximum(smooth - np.abs(first - other), 0) / smooth
        first = np.minimum(first, other) - h**2 * smooth / 4
    return first


def carve(smooth: float, field: FloatArray, *others: FloatArray) -> FloatArray:
    """The difference of a field and others, with seams rounded over a width of ``smooth``."""
    return -join(smooth, -field, *others)


def mirror(x: FloatArray) -> FloatArray:
    """Reflect points to x ≥ 0, so that a field evaluated there is symmetric."""
    return np.concatenate([np.abs(x[..., :1]), x[..., 1:]], axis=-1)


def bust(x: FloatArray) -> FloatArray:
    """A head with shoulders."""
    s = mirror(x)
    skull = join(0.15, ball(x, (0, 1.32, -0.06), (0.40, 0.47, 0.48)), ball(x, (0, 1.08, 0.16), (0.29, 0.36, 0.27)))
    face = carve(0.10, skull, ball(s, (0.16, 1.24, 0.50), (0.12, 0.075, 0.12)))
    face = join(0.04, face, ball(s, (0.155, 1.235, 0.365), (0.075, 0.06, 0.06)))
    face = join(0.08, face, cone(x, (0, 1.26, 0.40), (0, 1.09, 0.53), 0.035, 0.06))
    face = join(0.05, face, ball(s, (0.055, 1.065, 0.47), (0.045, 0.04, 0.06)))
    face = join(0.05, face, ball(x, (0, 0.96, 0.40), (0.12, 0.03, 0.05)), ball(x, (0, 0.91, 0.395), (0.10, 0.03, 0.05)))
    face = join(
        0.08, face, ball(x, (0, 0.80, 0.36), (0.10, 0.07, 0.08)), ball(s, (0.41, 1.2, -0.03), (0.05, 0.14, 0.09))
    )
    # Curls: a wavy shell over crown and neck.
    wave = 0.022 * np.sin(17 * x[..., 0]) * np.sin(15 * x[..., 1] + 8 * x[..., 2]) * np.sin(13 * x[..., 2])
    shell = ball(x, (0, 1.38, -0.13), (0.46, 0.47, 0.50)) + 1.6 * wave
    hair = np.maximum(shell, 0.75 * (x[..., 2] - 0.18) - 0.66 * (x[..., 1] - 1.50))
    head = join(0.05, face, hair)
    neck = cone(x, (0, 0.15, -0.10), (0, 0.95, -0.06), 0.25, 0.20)
    trunk = join(0.3, ball(s, (0.42, -0.12, -0.08), (0.46, 0.27, 0.28)), ball(x, (0, -0.42, 0.0), (0.72, 0.55, 0.36)))
    return join(0.14, join(0.12, neck, head), trunk)


def hand(x: FloatArray) -> FloatArray:
    """A raised hand, with fingers slightly spread and bent."""
    palm = join(0.2, ball(x, (0.02, 0.62, 0), (0.44, 0.50, 0.17)), cone(x, (0, -0.5, -0.02), (0, 0.3, 0), 0.23, 0.25))
    palm = carve(0.2, palm, ball(x, (0.02, 0.66, 0.30), (0.24, 0.30, 0.18)))
    parts = [palm]
    for at, lean, length, radius in (
        (-0.35, -0.34, 0.62, 0.090),
        (-0.12, -0.11, 0.80, 0.098),
        (0.12, 0.09, 0.86, 0.100),
        (0.35, 0.30, 0.76, 0.096),
    ):
        root = np.array((at, 0.98 - 0.5 * at * at, 0.0))
        joint = root + length * 0.42 * np.array((lean, 1.0, 0.06))
        middle = joint + length * 0.32 * np.array((lean, 0.96, 0.24))
        tip = middle + length * 0.26 * np.array((lean, 0.85, 0.45))
        parts.append(
            join(
                0.06,
                cone(x, root, joint, radius * 1.12, radius),
                cone(x, joint, middle, radius * 1.02, radius * 0.9),
                cone(x, middle, tip, radius * 0.92, radius * 0.74),
            )
        )
    thumb = join(
        0.1,
        cone(x, (0.28, 0.32, 0.06), (0.56, 0.66, 0.20), 0.16, 0.12),
        cone(x, (0.56, 0.66, 0.20), (0.66, 0.98, 0.26), 0.115, 0.085),
    )
    return join(0.1, join(0.05, *parts), thumb)


def rabbit(x: FloatArray) -> FloatArray:
    """A sitting rabbit."""
    s = mirror(x)
    body = join(0.35, ball(x, (0, 0.42, -0.30), (0.50, 0.52, 0.62)), ball(x, (0, 0.55, 0.15), (0.36, 0.44, 0.38)))
    body = join(0.10, body, ball(s, (0.40, 0.26, -0.38), (0.20, 0.36, 0.40)))
    body = join(
        0.12, body, ball(s, (0.30, 0.02, 0.10), (0.16, 0.12, 0.36)), ball(s, (0.17, 0.10, 0.50), (0.12, 0.22, 0.17))
    )
    body = join(0.08, body, ball(x, (0, 0.36, -0.96), (0.19, 0.19, 0.17)))
    head = join(0.18, ball(x, (0, 1.12, 0.42), (0.31, 0.31, 0.34)), ball(x, (0, 1.02, 0.68), (0.18, 0.17, 0.17)))
    head = join(0.10, head, ball(s, (0.15, 1.00, 0.62), (0.13, 0.12, 0.14)))
    head = join(
        0.03, head, ball(s, (0.215, 1.20, 0.625), (0.065, 0.075, 0.06)), ball(x, (0, 1.07, 0.85), (0.06, 0.045, 0.04))
    )
    ear = carve(
        0.06,
        ball(s, (0.21, 1.80, 0.22), (0.145, 0.52, 0.085), -0.17),
        ball(s, (0.215, 1.80, 0.33), (0.075, 0.40, 0.09), -0.17),
    )
    return join(0.10, join(0.22, body, head), ear)


def gargoyle(x: FloatArray) -> FloatArray:
    """A gargoyle crouching on its plinth, with wings half spread."""
    s = mirror(x)
    body = join(0.25, ball(x, (0, 0.50, -0.05), (0.38, 0.60, 0.34)), ball(x, (0, 0.95, 0.08), (0.40, 0.30, 0.30)))
    legs = join(
        0.1,
        cone(s, (0.30, 0.34, -0.02), (0.56, 0.46, 0.34), 0.22, 0.15),
        cone(s, (0.56, 0.46, 0.34), (0.47, 0.08, 0.28), 0.14, 0.09),
    )
    legs = join(
        0.08,
        legs,
        ball(s, (0.48, 0.05, 0.40), (0.12, 0.09, 0.20)),
        ball(s, (0.42, 0.22, 0.12), (0.17, 0.26, 0.24)),
        ball(s, (0.32, 0.02, 0.24), (0.12, 0.14, 0.26)),
    )
    arms = join(
        0.08,
        cone(s, (0.34, 1.00, 0.12), (0.30, 0.56, 0.30), 0.16, 0.11),
        cone(s, (0.30, 0.56, 0.30), (0.17, 0.08, 0.46), 0.11, 0.09),
    )
    arms = join(
        0.06, arms, ball(s, (0.16, 0.04, 0.53), (0.11, 0.08, 0.12)), ball(x, (0, 0.30, 0.18), (0.30, 0.50, 0.24))
    )
    head = join(0.12, ball(x, (0, 1.38, 0.24), (0.27, 0.27, 0.30)), ball(x, (0, 1.28, 0.50), (0.17, 0.14, 0.17)))
    head = carve(
        0.06, head, ball(x, (0, 1.20, 0.66), (0.15, 0.025, 0.10)), ball(s, (0.115, 1.42, 0.54), (0.07, 0.055, 0.08))
    )
    head = join(
        0.05,
        head,
        cone(s, (0.14, 1.56, 0.22), (0.30, 1.80, 0.12), 0.085, 0.07),
        cone(s, (0.30, 1.80, 0.12), (0.27, 2.02, 0.18), 0.07, 0.045),
    )
    head = join(
        0.05,
        head,
        cone(s, (0.24, 1.38, 0.16), (0.50, 1.52, 0.04), 0.09, 0.05),
        ball(s, (0.06, 1.31, 0.66), (0.045, 0.04, 0.05)),
    )
    wing = join(
        0.10,
        ball(s, (0.70, 1.16, -0.36), (0.58, 0.24, 0.085), 0.75),
        ball(s, (0.78, 0.88, -0.38), (0.42, 0.19, 0.075), 0.42),
        ball(s, (0.80, 0.68, -0.39), (0.26, 0.15, 0.075), 0.15),
        cone(s, (0.15, 0.95, -0.26), (0.55, 1.05, -0.36), 0.13, 0.09),
    )
    tail = join(
        0.08,
        cone(x, (0, 0.16, -0.25), (-0.45, 0.04, -0.48), 0.18, 0.10),
        cone(x, (-0.45, 0.04, -0.48), (-0.66, 0.02, -0.14), 0.10, 0.07),
    )
    walls = np.moveaxis(np.abs(x - (0, -0.22, 0)) - (0.76, 0.20, 0.62), -1, 0)
    plinth = -join(0.06, *-walls)
    figure = join(0.08, join(0.12, body, head, legs), arms, wing, tail)
    return join(0.06, figure, plinth)


def angel(x: FloatArray) -> FloatArray:
    """An angel with a torch, on a round base."""
    s = mirror(x)
    folds = 0.035 * np.sin(11 * np.arctan2(x[..., 0], x[..., 2])) * np.clip(1.1 - x[..., 1], 0, 1)
    robe = cone(x, (0, -0.2, 0), (0, 1.25, 0), 0.60, 0.20) * 0.92 + folds
    chest = join(0.15, ball(x, (0, 1.42, 0.0), (0.30, 0.34, 0.21)), ball(s, (0.24, 1.60, 0.0), (0.15, 0.12, 0.14)))
    head = join(
        0.05, ball(x, (0, 2.08, 0.03), (0.18, 0.235, 0.20)), cone(x, (0, 2.08, 0.20), (0, 2.04, 0.245), 0.02, 0.032)
    )
    hair = join(0.06, ball(x, (0, 2.14, -0.04), (0.215, 0.215, 0.22)), ball(x, (0, 1.92, -0.15), (0.15, 0.17, 0.11)))
    head = join(0.04, head, np.maximum(hair, 0.8 * (x[..., 2] - 0.10) - 0.6 * (x[..., 1] - 2.20)))
    neck = cone(x, (0, 1.60, 0), (0, 1.95, 0), 0.11, 0.09)
    right = join(
        0.06,
        cone(x, (0.32, 1.60, 0.02), (0.62, 1.78, 0.12), 0.105, 0.085),
        cone(x, (0.62, 1.78, 0.12), (0.66, 2.22, 0.20), 0.08, 0.062),
        ball(x, (0.67, 2.30, 0.21), (0.085, 0.09, 0.085)),
    )
    torch = join(
        0.04,
        cone(x, (0.67, 2.28, 0.21), (0.68, 2.50, 0.20), 0.05, 0.075),
        cone(x, (0.68, 2.55, 0.20), (0.70, 2.86, 0.18), 0.115, 0.045),
    )
    left = join(
        0.06,
        cone(x, (-0.30, 1.58, 0.02), (-0.36, 1.28, 0.10), 0.115, 0.10),
        cone(x, (-0.36, 1.28, 0.10), (-0.10, 1.34, 0.24), 0.10, 0.075),
        ball(x, (-0.05, 1.36, 0.245), (0.09, 0.07, 0.06)),
    )
    wing = join(
        0.10,
        ball(s, (0.66, 1.96, -0.34), (0.24, 0.62, 0.095), -0.62),
        ball(s, (0.76, 1.56, -0.36), (0.19, 0.64, 0.095), -0.36),
        ball(s, (0.68, 1.24, -0.36), (0.17, 0.58, 0.095), -0.24),
        cone(s, (0.08, 1.52, -0.10), (0.46, 1.66, -0.34), 0.13, 0.10),
    )
    base = -join(0.08, 0.74 - np.hypot(x[..., 0], x[..., 2]), 0.20 - np.abs(x[..., 1] + 0.45))
    figure = join(0.10, join(0.12, robe, chest), join(0.08, neck, head), right, left)
    return join(0.06, join(0.07, figure, wing), torch, base)


def arm(x: FloatArray, points: FloatArray, thick: float, thin: float) -> FloatArray:
    """A limb along a chain of points, tapering from ``thick`` to ``thin``."""
    radii = np.linspace(thick, thin, len(points))
    found = np.full(x.shape[:-1], np.inf)
    for k in range(len(points) - 1):
        found = np.minimum(found, cone(x, points[k], points[k + 1], radii[k], radii[k + 1]))
    return found


def octopus(x: FloatArray) -> FloatArray:
    """A walking octopus, each of whose eight arms is curled differently."""
    s = mirror(x)
    head = join(0.25, ball(x, (0, 1.02, -0.24), (0.44, 0.56, 0.46), 0.35, 0), ball(x, (0, 0.46, 0), (0.36, 0.26, 0.36)))
    head = join(0.05, head, ball(s, (0.20, 0.76, 0.29), (0.12, 0.13, 0.12)))
    arms = []
    for k in range(8):
        # The arm leaves below the head, goes down to the ground and along it; its end curls up.
        along = np.linspace(0, 1, 14)
        curl = (-1) ** (k // 2 + k % 2) * (6.5 + 1.5 * np.sin(5 * k)) * np.maximum(along - 0.45, 0) ** 1.5
        heading = np.pi * (2 * k + 1) / 8 + curl - 0.25 * np.sign(curl[-1]) * np.sin(4 * along)
        ground = 0.16 * np.exp(1j * heading[0]) + np.cumsum(2.15 / 14 * np.exp(1j * heading))
        rise = 0.50 * np.exp(-((along / 0.34) ** 2)) + (0.3 + 0.25 * np.sin(3 * k)) * np.maximum(along - 0.5, 0) ** 1.2
        arms.append(arm(x, np.stack([ground.real, 0.06 + rise, ground.imag], axis=1), 0.175, 0.045))
    return join(0.12, head, join(0.05, *arms))


def armadillo(x: FloatArray) -> FloatArray:
    """An armadillo that stands on its hind legs with raised arms."""
    s = mirror(x)
    trunk = join(0.2, ball(x, (0, 0.98, -0.05), (0.44, 0.58, 0.42)), ball(x, (0, 1.42, 0.02), (0.34, 0.32, 0.32)))
    # The banded shell.
    shell = ball(x, (0, 1.08, -0.16), (0.50, 0.72, 0.46)) + 0.022 * np.cos(26 * (x[..., 1] + 0.25 * x[..., 2]))
    shell = np.maximum(shell, x[..., 2] - 0.02 - 0.1 * x[..., 1])
    head = join(
        0.12, ball(x, (0, 1.92, 0.12), (0.25, 0.26, 0.27)), cone(x, (0, 1.88, 0.25), (0, 1.74, 0.66), 0.17, 0.075)
    )
    head = join(
        0.03, head, ball(x, (0, 1.745, 0.72), (0.06, 0.05, 0.05)), ball(s, (0.15, 1.97, 0.31), (0.055, 0.06, 0.05))
    )
    ear = carve(
        0.05,
        ball(s, (0.26, 2.30, 0.0), (0.115, 0.28, 0.075), -0.35),
        ball(s, (0.265, 2.30, 0.085), (0.06, 0.20, 0.06), -0.35),
    )
    arms = join(
        0.08,
        cone(s, (0.30, 1.48, 0.05), (0.72, 1.36, 0.16), 0.16, 0.125),
        cone(s, (0.72, 1.36, 0.16), (0.90, 1.74, 0.34), 0.12, 0.095),
        ball(s, (0.92, 1.83, 0.37), (0.12, 0.12, 0.085)),
    )
    fingers = [
        cone(s, (0.92, 1.84, 0.38), (0.92 + a, 1.84 + b, 0.38 + c), 0.058, 0.042)
        for a, b, c in ((-0.20, 0.13, 0.11), (-0.05, 0.26, 0.06), (0.14, 0.22, 0.03))
    ]
    legs = join(
        0.1,
        cone(s, (0.24, 0.70, -0.02), (0.42, 0.42, 0.16), 0.26, 0.18),
        cone(s, (0.42, 0.42, 0.16), (0.38, 0.08, 0.02), 0.16, 0.12),
        ball(s, (0.40, 0.07, 0.14), (0.15, 0.085, 0.22)),
    )
    toes = [cone(s, (0.40 + a, 0.06, 0.30), (0.40 + 1.7 * a, 0.045, 0.46), 0.062, 0.045) for a in (-0.09, 0.0, 0.09)]
    tail = arm(x, np.array([(0, 0.55, -0.35), (0, 0.30, -0.66), (0.08, 0.14, -0.95), (0.3, 0.1, -1.2)]), 0.2, 0.05)
    body = join(0.1, join(0.03, trunk, shell), join(0.03, arms, *fingers), join(0.03, legs, *toes), tail)
    return join(0.05, join(0.1, body, head), ear)


# The field and the corners of its box. The surface is cut open at the lower end of the box.
SCULPTURES: dict[str, tuple[Field, tuple[float, float, float], tuple[float, float, float]]] = {
    "angel": (angel, (-1.4, -0.55, -0.9), (1.4, 3.1, 0.9)),
    "gargoyle": (gargoyle, (-1.35, -0.34, -0.85), (1.35, 2.15, 0.95)),
    "rabbit": (rabbit, (-0.75, 0.0, -1.25), (0.75, 2.45, 1.05)),
    "bust": (bust, (-1.05, -0.6, -0.75), (1.05, 2.0, 0.75)),
    "hand": (hand, (-0.85, -0.45, -0.4), (0.95, 2.05, 0.75)),
}
# The field and the corners of its box, which contains the surface with a margin.
CREATURES: dict[str, tuple[Field, tuple[float, float, float], tuple[float, float, float]]] = {
    "octopus": (octopus, (-2.0, -0.3, -2.0), (2.0, 1.75, 2.0)),
    "armadillo": (armadillo, (-1.2, -0.15, -1.5), (1.2, 2.75, 0.95)),
}


@lru_cache
def creature(name: str, size: int = 64) -> tuple[FloatArray, IntArray]:
    """Mesh a closed surface without handles; its grid is ``size`` cells high.

    Returns
    -------
    V : (n, 3) float64
    F : (f, 3) int64
        Counterclockwise seen from outside.
    """
    field, low, high = CREATURES[name]
    V, F = largest_piece(*surface_net(field, low, high, (high[1] - low[1]) / size))
    for _ in range(12):
        V = onto_surface(field, centroids(V, F), None)
    return V, F


@lru_cache
def sculpture(name: str, size: int = 64) -> tuple[FloatArray, IntArray]:
    """Mesh a surface with one boundary loop and no chords, ``size`` grid cells high, with angles mostly above 20°.

    Returns
    -------
    V : (n, 3) float64
    F : (f, 3) int64
        Counterclockwise seen from outside.
    """
    return standing(*SCULPTURES[name], size)


def standing(
    field: Field, low: tuple[float, float, float], high: tuple[float, float, float], size: int
) -> tuple[FloatArray, IntArray]:
    """Mesh any field as `sculpture` does, between two corners of a box, cut off at the box's floor."""
    step, floor = (high[1] - low[1]) / size, low[1]
    V, F = cut_off(*surface_net(field, np.subtract(low, (0, 2 * step, 0)), high, step), floor)
    rim = np.concatenate(boundary_loops(F, len(V)))
    inside = np.setdiff1d(np.arange(len(V)), rim)
    for _ in range(12):
        V[inside] = onto_surface(field, centroids(V, F), None)[inside]
        # Each vertex of the rim moves to the midpoint of its neighbours.
        V[rim] = onto_surface(field, (V[np.roll(rim, 1)] + V[np.roll(rim, -1)]) / 2, floor)
    refined = refine(V, F, chords(F, len(V)))
    return refined.V, refined.F


def surface_net(field: Field, low: ArrayLike, high: ArrayLike, step: float) -> tuple[FloatArray, IntArray]:
    """Mesh the zero set of a field: a vertex for each cell it intersects, a square for each edge it crosses."""
    axes = [np.arange(a, b + step, step) for a, b in zip(np.asarray(low), np.asarray(high), strict=True)]
    values = field(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1))
    # Make the border of the grid empty, so that every crossed edge has four cells.
    for axis in range(3):
        ends = np.moveaxis(values, axis, 0)[[0, -1]]
        np.moveaxis(values, axis, 0)[[0, -1]] = np.maximum(ends, step)
    values = make_well_composed(values, 0.01 * step)
    inside = values < 0
    cells = np.array(values.shape) - 1
    total, count = np.zeros((*cells, 3)), np.zeros(cells, dtype=int)
    squares = []
    for k in range(3):
        here, there = (np.take(values, range(a, cells[k] + a), axis=k) for a in (0, 1))
        crossed = (here < 0) != (there < 0)
        at = np.argwhere(crossed)
        place = at.astype(float)
        place[:, k] += (here / np.where(crossed, here - there, 1))[crossed]
        around = []
        # The four cells around an edge, in cyclic order.
        for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)):
            cell = at.copy()
            cell[:, (k + 1) % 3] -= i
            cell[:, (k + 2) % 3] -= j
            around.append(cell)
            np.add.at(total, tuple(cell.T), place)
            np.add.at(count, tuple(cell.T), 1)
        ring = np.stack([np.ravel_multi_index(tuple(cell.T), tuple(cells)) for cell in around], axis=1)
        outwards = inside[tuple(at.T)]
        squares.append(np.where(outwards[:, None], ring, ring[:, ::-1]))
    used, quads = np.unique(np.concatenate(squares), return_inverse=True)
    V = np.array([a[0] for a in axes]) + step * (total.reshape(-1, 3)[used] / count.ravel()[used, None])
    quads = quads.reshape(-1, 4)
    a, b, c, d = (V[quads[:, k]] for k in range(4))
    short = np.linalg.norm(a - c, axis=1) < np.linalg.norm(b - d, axis=1)
    quads = np.where(short[:, None], quads, np.roll(quads, 1, axis=1))
    return V, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def make_well_composed(values: FloatArray, depth: float) -> FloatArray:
    """Fill grid points where the solid touches itself at an edge or a corner, so that its surface is a manifold."""
    values = values.copy()
    corners = np.array(list(np.ndindex(2, 2, 2)))
    faces = [corners[corners[:, axis] == side] for axis in range(3) for side in (0, 1)]
    # Two opposite corners, and the rest of their face or cell. If only one group is solid, the surface is no manifold.
    opposite = [(face[[k, 3 - k]], face[[1 - k, 2 + k]]) for face in faces for k in (0, 1)]
    opposite += [(corners[[k, 7 - k]], np.delete(corners, [k, 7 - k], axis=0)) for k in range(4)]
    while True:
        solid = values < 0
        bad = np.zeros(np.array(values.shape) - 1, dtype=bool)
        for pair, rest in opposite:
            here, there = (np.array([solid[corner_slices(c, solid.shape)] for c in which]) for which in (pair, rest))
            bad |= here.all(axis=0) & ~there.any(axis=0)
            bad |= ~here.any(axis=0) & there.all(axis=0)
        if not bad.any():
            return values
        for i, j, k in np.argwhere(bad):
            cell = values[i : i + 2, j : j + 2, k : k + 2]
            cell[cell == np.where(cell < 0, np.inf, cell).min()] = -depth


def corner_slices(corner: IntArray, shape: tuple[int, ...]) -> tuple[slice, ...]:
    """The slices that select one corner of every cell of a grid."""
    return tuple(slice(c, n - 1 + c) for c, n in zip(corner, shape, strict=True))


def cut_off(V: FloatArray, F: IntArray, floor: float) -> tuple[FloatArray, IntArray]:
    """Keep the part above a plane, without closed cavities and without triangles whose vertices all lie on the rim."""
    F = F[(V[F, 1] > floor).all(axis=1)]
    while True:
        rim = np.zeros(len(V), dtype=bool)
        rim[boundary_edges(F, len(V)).ravel()] = True
        ears = rim[F].all(axis=1)
        if not ears.any():
            break
        F = F[~ears]
    return largest_piece(V, F)


def largest_piece(V: FloatArray, F: IntArray) -> tuple[FloatArray, IntArray]:
    """Return the connected component with the most triangles, without unused vertices."""
    joined = csr_array((np.ones(F.size), (F.ravel(), np.roll(F, 1, axis=1).ravel())), shape=(len(V), len(V)))
    piece = connected_components(joined, directed=False)[1]
    F = F[piece[F[:, 0]] == np.bincount(piece[F.ravel()]).argmax()]
    used, F = np.unique(F, return_inverse=True)
    return V[used], F.reshape(-1, 3).astype(np.int64)


def centroids(V: FloatArray, F: IntArray) -> FloatArray:
    """For every vertex, the area-weighted mean of the centroids of its triangles."""
    corners = V[F]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    triangle = np.arange(F.size) // 3
    around = csr_array((area[triangle], (F.ravel(), triangle)), shape=(len(V), len(F)))
    return np.asarray((around @ corners.mean(axis=1)) / around.sum(axis=1)[:, None])


def onto_surface(field: Field, x: FloatArray, floor: float | None) -> FloatArray:
    """Move points onto the zero set of a field by one Newton step, within the plane y = ``floor`` if it is given."""
    width = 1e-4
    if floor is not None:
        x = np.stack([x[:, 0], np.full(len(x), floor), x[:, 2]], axis=1)
    value = field(x)
    slope = np.stack([field(x + width * e) - value for e in np.eye(3)], axis=1) / width
    if floor is not None:
        slope[:, 1] = 0
    step = value / np.maximum((slope**2).sum(axis=1), 0.1)
    return x - step[:, None] * slope


def chords(F: IntArray, n: int) -> IntArray:
    """Interior edges that join two boundary vertices."""
    rim = np.zeros(n, dtype=bool)
    rim[boundary_edges(F, n).ravel()] = True
    interior = edges(F, n).interior
    return interior[rim[interior].all(axis=1)]


@lru_cache
def seven(size: int = 64, count: int = 7) -> dict[str, Problem]:
    """The first pairs of surface and letter of the paper's Figure 10 and its tables, with synthetic surfaces."""
    surfaces = ("angel", "GS"), ("gargoyle", "GH"), ("rabbit", "R"), ("bust", "A"), ("hand", "P")
    found = {}
    for name, letter in [(name, letter) for name, letters in surfaces for letter in letters][:count]:
        V, F = sculpture(name, size)
        fixed, target = targets.boundary_to(V, F, targets.filled(targets.letter(letter)))
        found[f"{name} onto {letter}"] = Problem(V, F, fixed, target)
    return found
