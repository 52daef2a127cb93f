"""Seeded problems with pins on surfaces with a free boundary, of several families, feasible by construction.

    V, F, fixed, target = make("swirl:7", scans)[:4]

A surface is flattened. A known map of the plane then deforms the flat map as far as it stays bijective, which is
certified exactly. Between 1 and 200 vertices are pinned at their positions in the result, which is stored as
``hidden``. A family and a number name a problem. With scans, a folder of OBJ files, half of the surfaces are patches of
these.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

import planar
import problems
from quasiharmonic import certify, flatten
from quasiharmonic.geometry.mesh.topology import boundary_loops, components, edges
from quasiharmonic.io import read_obj
from quasiharmonic.surfaces import cat
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray

Generator = np.random.Generator

SMALLEST, LARGEST = 500, 4000
# Maximum number of surfaces drawn to find one that allows a strong enough deformation.
_ATTEMPTS = 200


class Pinned(NamedTuple):
    """A problem.

    Attributes
    ----------
    V, F, fixed, target : arrays
        A surface with a boundary, and the target positions of some of its vertices.
    name : str
    surface : str
        The kind of surface.
    strength : float
        Strength of the deformation; its meaning depends on the family.
    hidden : (n, 2) float64
        A bijective map with these target positions.
    """

    V: FloatArray
    F: IntArray
    fixed: IntArray
    target: FloatArray
    name: str
    surface: str
    strength: float
    hidden: FloatArray


def make(name: str, scans: Sequence[Path] = ()) -> Pinned:
    """Make a problem from a name such as ``swirl:7``.

    Raises
    ------
    ValueError
        If the family does not exist.
    """
    family, _, number = name.partition(":")
    if family not in FAMILIES or not number.isdecimal():
        raise ValueError(f"{name!r} is no name of a problem, such as swirl:7; families are {', '.join(FAMILIES)}")
    for attempt in range(_ATTEMPTS):
        rng = np.random.default_rng([zlib.crc32(family.encode()), int(number), attempt])
        kind, V, F = _surface(rng, scans)
        # The flat map has low distortion, is a disk, or is a blend of both.
        flat = flatten(V, F, max_iterations=int(rng.choice([0, 3, 100])), tol=1e-2).uv @ (1, 1j)
        size = planar.span(flat)
        image, strength = FAMILIES[family](rng, (flat - flat.mean()) / size, F)
        # Weak deformations make no useful problem; meshes with slivers allow only those.
        if strength > WEAKEST[family]:
            break
    else:
        raise AssertionError(f"no surface bears {name}")
    # Move, rotate and scale the target.
    image = size * (image * np.exp(2j * np.pi * rng.random() + rng.uniform(-0.7, 0.7)) + rng.normal(0, 2, 2) @ (1, 1j))
    hidden = planar.points(image)
    if not certify(F, hidden).bijective:
        raise AssertionError(f"the solution of {name} is none")
    fixed = _chosen(rng, F, len(V))
    return Pinned(V, F, fixed, hidden[fixed], name, kind, strength, hidden)


def _surface(rng: Generator, scans: Sequence[Path]) -> tuple[str, FloatArray, IntArray]:
    """Return the kind, vertices and triangles of a surface with the topology of a plane region."""
    size = int(np.exp(rng.uniform(np.log(SMALLEST), np.log(LARGEST))))
    if scans and rng.random() < 0.5:
        path = scans[rng.integers(len(scans))]
        for _ in range(20):
            found = patch_of_scan(rng, path, size)
            if found is not None:
                return path.stem, *found
    if rng.random() < 0.2:
        return "cat", *cat(max(4, round(np.sqrt(size / 6))))
    holes = int(rng.choice(4, p=(0.55, 0.25, 0.1, 0.1)))
    z, F = planar.blank(rng, size, holes)
    V = problems.dressed(rng, z, F, 0.1 * rng.random())
    return f"made, {len(boundary_loops(F, len(V)))} loops", V, F


@cache
def _scan(path: Path) -> tuple[FloatArray, IntArray]:
    mesh = read_obj(path)
    return mesh.V, mesh.F


def patch_of_scan(rng: Generator, path: Path, size: int) -> tuple[FloatArray, IntArray] | None:
    """Return a patch of about ``size`` triangles around a random vertex, or None if it cannot be planar."""
    V, F = _scan(path)
    if len(F) > 1.5 * size:
        distance = _rings(F, len(V), int(rng.integers(len(V))))
        order = np.argsort(distance[F].max(axis=1), kind="stable")
        last = distance[F].max(axis=1)[order[size]]
        F = F[distance[F].max(axis=1) <= last]
    used, F = np.unique(F, return_inverse=True)
    V, F = V[used], F.reshape(-1, 3)
    found = edges(F, len(V))
    if not len(found.boundary) or found.nonmanifold.size or found.inconsistent.size or components(F, len(V)).any():
        return None
    try:
        loops = boundary_loops(F, len(V))
    except ValueError:
        return None
    # Require genus 0, so that the patch can be mapped into the plane.
    if len(V) - len(found.interior) - len(found.boundary) + len(F) != 2 - len(loops):
        return None
    a, b = V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]]
    return None if np.linalg.norm(np.cross(a, b), axis=1).min() == 0 else (V, F)


def _rings(F: IntArray, n: int, start: int) -> IntArray:
    """Return the distance of each vertex from one vertex, in edges; other components are farthest."""
    distance = np.full(n, n)
    distance[start] = 0
    for ring in range(1, n):
        near = F[(distance[F] == ring - 1).any(axis=1)]
        new = near[distance[near] == n]
        if not new.size:
            break
        distance[new] = ring
    return distance


def _chosen(rng: Generator, F: IntArray, n: int) -> IntArray:
    """Return vertices to pin: anywhere, close together, or on the boundary."""
    count = min(int(np.exp(rng.uniform(0, np.log(200.99)))), n // 3)
    way = rng.choice(["anywhere", "together", "boundary"], p=(0.6, 0.2, 0.2))
    if way == "together":
        order = np.argsort(_rings(F, n, int(rng.integers(n))), kind="stable")
        return np.sort(order[:count])
    pool = np.concatenate(boundary_loops(F, n)) if way == "boundary" else np.arange(n)
    return rng.choice(pool, min(count, len(pool)), replace=False)


def _bijective(z: Callable[[float], ComplexArray], F: IntArray, strength: float) -> tuple[ComplexArray, float]:
    """Return the points moved with the given strength, or with the greatest strength that stays bijective."""
    for _ in range(40):
        image = z(strength)
        if planar.positive(image, F) and certify(F, planar.points(image)).bijective:
            return image, strength
        strength *= 0.85
    return z(0.0), 0.0


def _swirl(rng: Generator, z: ComplexArray, F: IntArray) -> tuple[ComplexArray, float]:
    """Rotate a disk of the plane, most in its middle."""
    centre, radius = z[rng.integers(len(z))], rng.uniform(0.4, 1.0)
    bump = np.clip(1 - (abs(z - centre) / radius) ** 2, 0, None) ** 2
    return _turned(rng, z, F, centre, bump, rng.uniform(0.5, 6.0))


def _overwound(rng: Generator, z: ComplexArray, F: IntArray) -> tuple[ComplexArray, float]:
    """Rotate all points, more toward the middle, about as far as the triangles allow."""
    centre = z[np.argsort(abs(z))[rng.integers(1 + len(z) // 10)]]
    return _turned(rng, z, F, centre, 1 - abs(z - centre) / abs(z - centre).max(), 40.0)


def _turned(
    rng: Generator, z: ComplexArray, F: IntArray, centre: complex, share: FloatArray, angle: float
) -> tuple[ComplexArray, float]:
    way = rng.choice([-1, 1])
    return _bijective(lambda t: centre + (z - centre) * np.exp(1j * way * t * share), F, angle)


def _bend(rng: Generator, z: ComplexArray, F: IntArray) -> tuple[ComplexArray, float]:
    """Bend straight lines into arcs."""
    turn = np.exp(2j * np.pi * rng.random())
    w = z * turn
    return _bijective(
        lambda t: 1j / t * (1 - np.exp(1j * t * w.real) * (1 - t * w.imag)) if t else w, F, rng.uniform(1, 5)
    )


def _pinch(rng: Generator, z: ComplexArray, F: IntArray) -> tuple[ComplexArray, float]:
    """Contract or expand up to three regions."""
    centres = z[rng.integers(len(z), size=rng.integers(1, 4))]
    radii, signs = rng.uniform(0.2, 0.7, len(centres)), rng.choice([-1, 1], len(centres))

    def moved(t: float) -> ComplexArray:
        w = z
        for centre, radius, sign in zip(centres, radii, signs, strict=True):
            bump = np.clip(1 - (abs(w - centre) / radius) ** 2, 0, None) ** 2
            w = centre + (w - centre) * np.exp(-sign * t * bump)
        return w

    return _bijective(moved, F, rng.uniform(0.5, 3.0))


def _wave(rng: Generator, z: ComplexArray, F: IntArray) -> tuple[ComplexArray, float]:
    """Shear along waves in two directions."""
    ways = np.exp(2j * np.pi * rng.random(rng.integers(2, 5)))
    numbers, phases = rng.uniform(4, 14, len(ways)), rng.uniform(0, 2 * np.pi, len(ways))

    def moved(t: float) -> ComplexArray:
        w = z
        for way, number, phase in zip(ways, numbers, phases, strict=True):
            w = w + t / number * np.sin(number * (w / way).imag + phase) * way
        return w

    return _bijective(moved, F, rng.uniform(0.5, 2.5))


def _flow(rng: Generator, z: ComplexArray, F: IntArray) -> tuple[ComplexArray, float]:
    """Apply local twists, drags and pinches in sequence, each by a share of what the triangles allow."""
    strength = rng.uniform(0.2, 0.9)
    for _ in range(rng.integers(2, 7)):
        moved = planar.flow(rng, z, F, 1, strength)
        if certify(F, planar.points(moved)).bijective:
            z = moved
    return z, strength


def _mixed(rng: Generator, z: ComplexArray, F: IntArray) -> tuple[ComplexArray, float]:
    """Apply two to four of these in sequence, each about as strong as bijectivity allows."""
    for name in rng.choice(["swirl", "multiply_wound", "bend", "pinch", "wave", "flow"], rng.integers(2, 5)).tolist():
        z, strength = FAMILIES[name](rng, (z - z.mean()) / planar.span(z), F)
    return z, strength


FAMILIES: dict[str, Callable[[Generator, ComplexArray, IntArray], tuple[ComplexArray, float]]] = {
    "swirl": _swirl,
    "multiply_wound": _overwound,
    "bend": _bend,
    "pinch": _pinch,
    "wave": _wave,
    "flow": _flow,
    "mixed": _mixed,
}
# Minimum strengths of the families' problems.
WEAKEST = {"swirl": 0.5, "multiply_wound": 4.0, "bend": 0.5, "pinch": 0.4, "wave": 0.3, "flow": 0.1, "mixed": 0.0}
