"""Scenes with moving boundaries: generated meshes of a few thousand triangles, and the motion of their boundaries.

A scene moves one loop of its mesh, the body's, as a rigid or a bending body. Vertices of the walls are fixed, or slide
along them. For t from 0 to 1, ``places(t)`` returns the positions of the body's vertices, and ``extent(t)`` the
displacement in the scene's unit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from matplotlib.path import Path as Outline
from scipy.spatial import Delaunay, cKDTree

from quasiharmonic import boundary_loops
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray

#: A function of a time from 0 to 1 that returns positions (k, 2).
Places = Callable[[float], FloatArray]


@dataclass(frozen=True)
class Scene:
    """A mesh in a box with a moving body.

    Attributes
    ----------
    V : (n, 2) float64
    F : (f, 3) int64
    body, walls : (k,) int64
        The loops of the boundary.
    places : callable
        Positions of the body's vertices at a time from 0 to 1.
    extent : callable
        The displacement at a time from 0 to 1, in ``unit``.
    unit : str
    steps : int
        Number of steps of the scene.
    end : str
        Reason for the end of the scene.
    slide : bool
        Whether vertices of the walls slide along them, except at corners.
    axis, place_on_axis, log : str, callable, bool
        Abscissa of a plot: its label, its value at a time, and whether it is logarithmic and descending.
    """

    V: FloatArray
    F: IntArray
    body: IntArray
    walls: IntArray
    places: Places
    extent: Callable[[float], float]
    unit: str
    steps: int
    end: str
    slide: bool = False
    axis: str = ""
    place_on_axis: Callable[[float], float] = float
    log: bool = False
    fixed: IntArray = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "fixed", np.concatenate([self.body, self.walls]))

    def target(self, t: float) -> FloatArray:
        """Return the target positions of all ``fixed`` vertices, before sliding; (k, 2)."""
        return np.concatenate([self.places(t), self.V[self.walls]])

    def given(self) -> tuple[IntArray, IntArray]:
        """Return the vertices with prescribed x, and those with prescribed y."""
        if not self.slide:
            return self.fixed, self.fixed
        low, high = self.V[self.walls].min(axis=0), self.V[self.walls].max(axis=0)
        on = (self.V[self.walls] == low) | (self.V[self.walls] == high)
        x, y = (np.concatenate([self.body, self.walls[on[:, axis]]]) for axis in (0, 1))
        return x, y


def box(width: float, height: float, step: float) -> ComplexArray:
    """Return the boundary of a box around the origin, with vertices about ``step`` apart."""
    across, up = (max(2, round(length / step)) for length in (width, height))
    x, y = np.linspace(-width / 2, width / 2, across + 1), np.linspace(-height / 2, height / 2, up + 1)
    sides = [x[:-1] + 1j * y[0], x[-1] + 1j * y[:-1], x[:0:-1] + 1j * y[-1], x[0] + 1j * y[:0:-1]]
    return np.concatenate(sides)


def circle(radius: float, step: float, centre: complex = 0) -> ComplexArray:
    count = round(2 * np.pi * radius / step)
    return centre + radius * np.exp(2j * np.pi * np.arange(count) / count)


def meshed(
    outer: ComplexArray, inner: ComplexArray, size: Callable[[ComplexArray], FloatArray], seed: int = 0
) -> tuple[FloatArray, IntArray, IntArray, IntArray]:
    """Return a mesh between two loops, with edge lengths given by ``size``: vertices, triangles, and the two loops.

    Points repel each other along the edges of their Delaunay triangulation (Persson and Strang 2004); boundary points
    are fixed.
    """
    boundary = np.concatenate([outer, inner])
    near = cKDTree(_pairs(boundary))
    outlines = [Outline(_pairs(loop)) for loop in (outer, inner)]

    def inside(z: ComplexArray, margin: float) -> np.ndarray:
        away = near.query(_pairs(z))[0]
        within = outlines[0].contains_points(_pairs(z)) & ~outlines[1].contains_points(_pairs(z))
        return within & (away > margin * size(z))

    least = float(size(boundary).min())
    x = np.arange(outer.real.min(), outer.real.max(), least)
    y = np.arange(outer.imag.min(), outer.imag.max(), least * np.sqrt(0.75))
    z = (x + 0.5 * least * (np.arange(y.size)[:, None] % 2) + 1j * y[:, None]).ravel()
    z = z[inside(z, 0.6)]
    z = z[np.random.default_rng(seed).uniform(size=z.size) < (least / size(z)) ** 2]
    for turn in range(80):
        if turn % 20 == 19:
            z = z[inside(z, 0.4)]
        points = np.concatenate([boundary, z])
        F = _between(points, outlines)
        edges = np.unique(np.sort(np.concatenate([F[:, [0, 1]], F[:, [1, 2]], F[:, [2, 0]]]), axis=1), axis=0)
        way = points[edges[:, 1]] - points[edges[:, 0]]
        wanted = size(points[edges].mean(axis=1))
        wanted *= 1.2 * np.sqrt(np.sum(np.abs(way) ** 2) / np.sum(wanted**2))
        force = np.maximum(wanted - np.abs(way), 0) * way / np.abs(way)
        push = np.zeros(points.size, dtype=np.complex128)
        np.add.at(push, edges[:, 1], force)
        np.add.at(push, edges[:, 0], -force)
        z = z + 0.2 * push[boundary.size :]
        z = z[inside(z, 0.2)]
    points = np.concatenate([boundary, z])
    F = _between(points, outlines)
    used = np.unique(F)
    F = np.searchsorted(used, F)
    V = _pairs(points[used])
    loops = boundary_loops(F, len(V))
    assert sorted(map(len, loops)) == sorted([outer.size, inner.size]), (
        "the triangulation lacks an edge of the boundary"
    )
    return V, F, np.arange(outer.size, boundary.size), np.arange(outer.size)


def _pairs(z: ComplexArray) -> FloatArray:
    return np.stack([z.real, z.imag], axis=-1)


def _between(points: ComplexArray, outlines: list[Outline]) -> IntArray:
    """Return Delaunay triangles with centroids between two outlines, counterclockwise."""
    F = Delaunay(_pairs(points)).simplices.astype(np.int64)
    a, b, c = points[F].T
    area = ((b - a).conj() * (c - a)).imag
    F[area < 0] = F[area < 0][:, ::-1]
    middle = _pairs((a + b + c) / 3)
    kept = outlines[0].contains_points(middle) & ~outlines[1].contains_points(middle)
    return F[kept & (np.abs(area) > 1e-12)]


def _scene(
    outer: ComplexArray,
    inner: ComplexArray,
    size: Callable[[ComplexArray], FloatArray],
    places: Callable[[ComplexArray, float], ComplexArray],
    extent: Callable[[float], float],
    unit: str,
    steps: int,
    end: str,
    slide: bool = False,
    *,
    axis: str,
    place_on_axis: Callable[[float], float] | None = None,
    log: bool = False,
) -> Scene:
    V, F, body, walls = meshed(outer, inner, size)
    first = V[body] @ (1, 1j)
    over = axis, place_on_axis or extent, log
    return Scene(V, F, body, walls, lambda t: _pairs(places(first, t)), extent, unit, steps, end, slide, *over)


def _even(step: float) -> Callable[[ComplexArray], FloatArray]:
    return lambda z: np.full(z.shape, step)


def turning_disk(step: float = 0.07) -> Scene:
    """A disk that rotates in a channel."""
    return _scene(
        box(4, 2, step),
        circle(0.5, step),
        _even(step),
        lambda z, t: z * np.exp(6j * np.pi * t),
        lambda t: 1080 * t,
        "°",
        216,
        "three turns",
        axis="turn of the disk in degrees",
    )


def bending_beam(step: float = 0.07) -> Scene:
    """A beam, fixed in its middle, that bends into a ring."""
    length, thick = 2.4, 0.14
    beam = box(length, thick, step)

    def bent(z: ComplexArray, t: float) -> ComplexArray:
        turn = np.radians(358) * t
        angle = turn * z.real / length
        # The middle line is an arc; sinc handles its initial state, a straight line.
        along = z.real * np.sinc(angle / np.pi) + 1j * z.real * angle / 2 * np.sinc(angle / (2 * np.pi)) ** 2
        return along + 1j * z.imag * np.exp(1j * angle)

    return _scene(
        box(4, 3, step),
        beam,
        _even(step),
        bent,
        lambda t: 358 * t,
        "°",
        179,
        "its ends 2° from meeting",
        axis="angle of the arc in degrees",
    )


def closing_gap(step: float = 0.06) -> Scene:
    """A disk that descends obliquely to the floor, to 1e-4 of the initial gap, and rolls."""
    gap, radius, aside = 0.5, 0.4, 0.6

    def down(z: ComplexArray, t: float) -> ComplexArray:
        share = 1 - 10 ** (-4 * t)
        return (z - start) * np.exp(-1j * aside * share / radius) + start + share * (aside - 1j * gap)

    start = -0.3 - 0.1j
    return _scene(
        box(3, 2, step),
        circle(radius, step, start),
        _even(step),
        down,
        lambda t: 1 - 10 ** (-4 * t),
        "of the gap",
        200,
        "1e-4 of the gap left",
        axis="remaining part of the gap",
        place_on_axis=lambda t: 10 ** (-4 * t),
        log=True,
    )


def travelling_hole(step: float = 0.07, laps: float = 5) -> Scene:
    """A round hole that circles in a channel without rotating."""
    radius = 0.3

    def around(t: float) -> complex:
        return 1.4 * np.cos(2 * np.pi * laps * t) + 0.5j * np.sin(2 * np.pi * laps * t)

    return _scene(
        box(4, 2, step),
        circle(radius, step, around(0)),
        _even(step),
        lambda z, t: z + around(t) - around(0),
        lambda t: laps * t,
        "laps",
        400,
        f"{laps:g} laps",
        axis="laps of the hole",
    )


def flapping_aerofoil(step: float = 0.16) -> Scene:
    """A NACA 0012 that pitches about its quarter chord and heaves a quarter period later, with growing amplitude."""
    s = 0.5 * (1 - np.cos(np.linspace(0, np.pi, 36)))
    half = 0.6 * (0.2969 * np.sqrt(s) - 0.126 * s - 0.3516 * s**2 + 0.2843 * s**3 - 0.1036 * s**4)
    wing = np.concatenate([s[::-1] + 1j * half[::-1], s[1:-1] - 1j * half[1:-1]]) - 0.25
    near = cKDTree(_pairs(wing))
    between = np.abs(wing - np.roll(wing, 1))

    def size(z: ComplexArray) -> FloatArray:
        away, which = near.query(_pairs(z))
        return np.minimum(step, np.maximum(between, np.roll(between, -1))[which] + 0.25 * away)

    most, strokes = 180, 8

    def swing(t: FloatArray) -> FloatArray:
        return t * np.sin(2 * np.pi * strokes * t)

    def flapped(z: ComplexArray, t: float) -> ComplexArray:
        s = float(swing(np.asarray(t)))
        heave = -0.8 * t * np.cos(2 * np.pi * strokes * t)
        return z * np.exp(1j * np.radians(most) * s) + 1j * heave

    def extent(t: float) -> float:
        return most * float(np.abs(swing(np.linspace(0, t, 2001))).max())

    return _scene(
        box(5, 4, step),
        wing,
        size,
        flapped,
        extent,
        "° of pitch",
        400,
        "eight strokes, to 174°",
        axis="strokes of the aerofoil",
        place_on_axis=lambda t: strokes * t,
    )


def sliding_walls(step: float = 0.07) -> Scene:
    """An oval that rotates between walls whose vertices slide along them."""
    oval = circle(1, 1 / 40)
    oval = 0.75 * oval.real + 0.4j * oval.imag
    return _scene(
        box(4, 2, step),
        _evenly(oval, step),
        _even(step),
        lambda z, t: z * np.exp(6j * np.pi * t),
        lambda t: 1080 * t,
        "°",
        216,
        "three turns",
        slide=True,
        axis="turn of the oval in degrees",
    )


def _evenly(loop: ComplexArray, step: float) -> ComplexArray:
    """Return points about ``step`` apart along a closed curve given by fine steps."""
    closed = np.append(loop, loop[0])
    s = np.append(0, np.cumsum(np.abs(np.diff(closed))))
    at = np.linspace(0, s[-1], round(s[-1] / step), endpoint=False)
    return np.interp(at, s, closed.real) + 1j * np.interp(at, s, closed.imag)


SCENES: dict[str, Callable[..., Scene]] = {
    "turning disk": turning_disk,
    "bending beam": bending_beam,
    "closing gap": closing_gap,
    "travelling hole": travelling_hole,
    "flapping aerofoil": flapping_aerofoil,
    "sliding walls": sliding_walls,
}
