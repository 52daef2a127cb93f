"""Families of problems for `problems` that are extreme in one respect each, to find where programs fail.

All but the last two families are made from a solution, so they are feasible. The last two map the boundary of any mesh
to an outline.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import outlines
import planar
from planar import Draft, blank, flow, roughen
from quasiharmonic import Problem, quasi_harmonic_map, refine
from quasiharmonic.geometry.mesh.topology import boundary_edges, boundary_loops, edges
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray

Generator = np.random.Generator


def _needles(rng: Generator, d: float, size: int) -> Draft:
    """A target as flat as 1e-6, rotated by any angle and deformed again."""
    z, F = blank(rng, size, int(rng.integers(3)))
    w = roughen(rng, flow(rng, z, F, 1 + int(3 * d), 0.5), F, 1 + int(3 * d))
    flat = (w.real + 1j * 10 ** (-6 * d) * w.imag) * np.exp(2j * np.pi * rng.random())
    return Draft(z, F, flow(rng, flat, F, int(3 * d), 0.5))


def _sizes(rng: Generator, d: float, size: int) -> Draft:
    """Rings around a vertex or a hole that shrink geometrically, down to 1e-8 of the outermost ring."""
    spokes = int(rng.integers(6, 13))
    # Radii of consecutive rings have a ratio of at least 0.3.
    rings = max(16, size // (2 * spokes))
    ratio = 10 ** (-(2 + 6 * d) / (rings - 1))
    ray = np.exp(2j * np.pi * np.arange(spokes) / spokes)
    z = np.outer(1.0 + np.arange(rings), ray).ravel()
    image = np.outer(ratio ** np.arange(rings)[::-1], ray).ravel()
    F = _between(np.arange(rings * spokes).reshape(rings, spokes))
    if rng.random() < 0.5:
        z, image, F = np.append(z, 0), np.append(image, 0), np.concatenate([F, _fan(np.arange(spokes), len(z))])
    return Draft(z, F, roughen(rng, image, F, int(4 * d)))


def _hub(rng: Generator, d: float, size: int) -> Draft:
    """A vertex with up to 5,000 neighbours, in one or two rings, in an outline with widely varying radii."""
    spokes = round(10 ** (1 + 2.699 * d))
    rings = int(rng.integers(1, 3))
    ray = np.exp(2j * np.pi * np.arange(spokes) / spokes)
    radius = np.exp(2 * d * rng.normal(size=spokes))
    share = np.arange(1, rings + 1) / rings
    hub = rings * spokes
    F = np.concatenate([_between(np.arange(hub).reshape(rings, spokes)), _fan(np.arange(spokes), hub)])
    return Draft(np.append(np.outer(share, ray), 0), F, np.append(np.outer(share, radius * ray), 0))


def _between(rings: IntArray) -> IntArray:
    """Return the triangles between closed rings of vertices (r, k), each ring around the previous one."""
    inner, outer = rings[:-1], rings[1:]
    quads = np.stack([inner, outer, np.roll(outer, -1, axis=1), np.roll(inner, -1, axis=1)], axis=2).reshape(-1, 4)
    return quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


def _fan(ring: IntArray, hub: int) -> IntArray:
    """Return the triangles from the sides of a ring to a vertex in its middle."""
    return np.stack([np.full_like(ring, hub), ring, np.roll(ring, -1)], axis=1)


def _hilbert(rng: Generator, d: float, size: int) -> Draft:
    """A straight strip mapped along Hilbert's curve, with round turns."""
    curve = outlines.hilbert(1 + int(3.99 * d))
    across, steps, half = int(rng.integers(2, 4)), int(rng.integers(2, 5)), rng.uniform(0.2, 0.45)
    z, quads = planar.cells(np.ones((across, steps * len(curve)), dtype=bool))
    step = np.diff(curve)
    into, out = np.append(step[0], step), np.append(step, step[-1])
    at = np.minimum(z.real // steps, len(curve) - 1).astype(int)
    part, left = z.real / steps - at, half * (2 * z.imag / across - 1)
    way, turn = into[at], np.round((into.conj() * out).imag)[at]
    start = curve[at] - way / 2
    # A turn is a quarter circle around the corner of its cell.
    pivot = start + 0.5j * turn * way
    round_it = pivot - 1j * (0.5 * turn - left) * way * np.exp(0.5j * np.pi * turn * part)
    image = np.where(turn == 0, start + (part + 1j * left) * way, round_it)
    F = planar.split(rng, quads)
    return Draft(z, F, _held_still(rng, image, F, int(3 * d)))


def _koch(rng: Generator, d: float, size: int) -> Draft:
    """A disk mapped to Koch's snowflake; the target is a partly split lattice, the rest mesh its Tutte embedding."""
    corners = outlines.koch(1 + int(3.99 * d))
    # Relative to a corner, the corners are lattice points; the second direction leans by half of its height.
    reach = 3 * int(abs(corners).max() + 2)
    a, b = (k.ravel() for k in np.meshgrid(*2 * [np.arange(-reach, reach)]))
    lattice = corners[0] + a + b * np.exp(1j * np.pi / 3)
    low, wide = np.flatnonzero((a < reach - 1) & (b < reach - 1)), 2 * reach
    triangles = np.concatenate(
        [np.stack([low, low + 1, low + wide], axis=1), np.stack([low + 1, low + 1 + wide, low + wide], axis=1)]
    )
    inside = _within(lattice[triangles].mean(axis=1), corners)
    used, F = np.unique(triangles[inside], return_inverse=True)
    image, F = lattice[used], F.reshape(-1, 3)
    # A regular lattice is already harmonic; after splitting half of its edges it is not.
    inner = edges(F, len(image)).interior
    refined = refine(planar.points(image), F, inner[rng.random(len(inner)) < 0.5])
    image, F = refined.V[:, 0] + 1j * refined.V[:, 1], refined.F
    (loop,) = boundary_loops(F, len(image))
    circle = np.exp(2j * np.pi * np.arange(loop.size) / loop.size)
    # All cotangents of equilateral triangles are equal.
    on_circle = Problem(planar.points(image), F, loop, planar.points(circle), reference="equilateral")
    rest = quasi_harmonic_map(on_circle)
    return Draft(rest[:, 0] + 1j * rest[:, 1], F, image)


def _within(z: ComplexArray, corners: ComplexArray) -> IntArray:
    """Return which points lie in a polygon, by the parity of the number of its sides to their right."""
    odd = np.zeros(z.shape, dtype=bool)
    for p, q in zip(corners, np.roll(corners, -1), strict=True):
        beside = (p.imag > z.imag) != (q.imag > z.imag)
        odd[beside] ^= ((q - p).conjugate() * (z[beside] - p)).imag * np.sign(q.imag - p.imag) > 0
    return np.flatnonzero(odd)


def _coil(rng: Generator, d: float, size: int) -> Draft:
    """A straight strip wound up to 20 times; each coil is smaller by the same factor, down to 1e-6."""
    turns, steps, across = 2 + int(18 * d), int(rng.integers(8, 17)), int(rng.integers(1, 5))
    z, quads = planar.cells(np.ones((across, turns * steps), dtype=bool))
    shrink = np.log(10.0) * (1 + 5 * d) / turns
    # The vertices of all coils lie on the same rays, so chords are nested as arcs are.
    turn = z.real / steps
    image = np.exp(-shrink * (turn + rng.uniform(0.5, 0.95) * z.imag / across) + 2j * np.pi * turn)
    F = planar.split(rng, quads)
    return Draft(z, F, roughen(rng, image, F, int(4 * d)))


def _gaps(rng: Generator, d: float, size: int) -> Draft:
    """A straight strip wound up with gaps down to 1e-10 between its coils."""
    turns, steps, across = 2 + int(4 * rng.random()), int(rng.integers(8, 17)), int(rng.integers(2, 5))
    z, quads = planar.cells(np.ones((across, turns * steps), dtype=bool))
    turn = z.real / steps
    radius = 1 + turn + (1 - 10 ** (-2 - 8 * d)) * z.imag / across
    F = planar.split(rng, quads)
    return Draft(z, F, _held_still(rng, radius * np.exp(-2j * np.pi * turn), F, 1 + int(3 * d)))


def _sieve(rng: Generator, d: float, size: int) -> Draft:
    """A sheet with up to 90 holes, deformed by drags."""
    count = max(1, round(90 * d))
    columns = int(np.ceil(np.sqrt(count)))
    hole = np.arange(count)
    mask = np.ones((3 * -(-count // columns) + 2, 3 * columns + 2), dtype=bool)
    mask[3 * (hole // columns) + 2, 3 * (hole % columns) + 2] = False
    z, quads = planar.cells(mask)
    F = planar.split(rng, quads)
    return Draft(z, F, roughen(rng, flow(rng, z, F, 1 + int(4 * d), 0.3 + 0.6 * d), F, int(6 * d)))


def _nailed(rng: Generator, d: float, size: int) -> Draft:
    """Up to 3,000 fixed interior vertices, about a third of all vertices."""
    count = round(10 ** (1 + 2.477 * d))
    z, F = blank(rng, 7 * count, 0)
    inside = np.setdiff1d(np.arange(len(z)), np.concatenate(boundary_loops(F, len(z))))
    image = roughen(rng, flow(rng, z, F, 1 + int(3 * d), 0.3 + 0.5 * d), F, 1 + int(2 * d), 10 ** (-2 - 2 * d))
    return Draft(z, F, image, rng.choice(inside, min(count, inside.size), replace=False))


def _scales(rng: Generator, d: float, size: int) -> Draft:
    """Mesh and target, each of a size between 1e-300 and 1e300."""
    z, F = blank(rng, size, int(rng.integers(3)))
    image = roughen(rng, flow(rng, z, F, 1 + int(5 * d), 0.5 + 0.4 * d), F, 1 + int(2 * d))
    unit, scale = 10.0 ** (300 * d * rng.choice([-1, 1], size=2))
    return Draft(z, F, scale * image / planar.span(image), unit=float(unit))


def _held_still(rng: Generator, image: ComplexArray, F: IntArray, sweeps: int) -> ComplexArray:
    """Perturb the interior of a map at random; boundary vertices stay unchanged."""
    return roughen(rng, image, F, sweeps, held=np.concatenate(boundary_loops(F, len(image))))


def _along(draw: Callable[[Generator, float], list[FloatArray]]) -> Callable[[Generator, float, int], Draft]:
    """Return the family of meshes whose boundary is split until it can follow every corner of an outline."""

    def family(rng: Generator, d: float, size: int) -> Draft:
        (contour,) = draw(rng, d)
        z, F = blank(rng, size, 0)
        while len(rim := boundary_edges(F, len(z))) < len(contour):
            refined = refine(planar.points(z), F, rim, boundary=True)
            z, F = refined.V[:, 0] + 1j * refined.V[:, 1], refined.F
        z, F = planar.without_chords(z, F)
        return Draft(z, F, outlines.laid(z, F, [contour]), feasible=False)

    return family


ADVERSARIAL: dict[str, Callable[[Generator, float, int], Draft]] = {
    "needles": _needles,
    "sizes": _sizes,
    "hub": _hub,
    "hilbert": _hilbert,
    "koch": _koch,
    "coil": _coil,
    "gaps": _gaps,
    "sieve": _sieve,
    "nailed": _nailed,
    "scales": _scales,
    "snowflake": _along(outlines.snowflake),
    "filling": _along(outlines.filling),
}
