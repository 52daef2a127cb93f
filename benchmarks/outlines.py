"""Outlines for the boundaries of `problems`: an outer contour, then holes."""

from __future__ import annotations

import numpy as np

from planar import points, span
from quasiharmonic import boundary_loops
from quasiharmonic.targets import arc_length, letter, star
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray

Generator = np.random.Generator

# Connected glyphs only; marks and dots would be separate components.
_GLYPHS = "ABCDEFGHKLMNOPQRSTUVWXYZabcdefghkmnopqrstuvwxyz023456789&@§$ß"


def laid(z: ComplexArray, F: IntArray, contours: list[FloatArray]) -> ComplexArray:
    """Return target positions: the longest loop along the first contour, the others along theirs in order."""
    image = np.zeros_like(z)
    loops = sorted(boundary_loops(F, len(z)), key=lambda loop: -span(z[loop]))
    for loop, contour in zip(loops, contours, strict=False):
        try:
            placed = arc_length(points(z[loop]), contour)
        except ValueError:
            # There are too few vertices to keep all corners.
            placed = arc_length(points(z[loop]), contour, corner_angle=180)
        image[loop] = placed[:, 0] + 1j * placed[:, 1]
    return image


def moved_holes(rng: Generator, z: ComplexArray, F: IntArray, difficulty: float) -> ComplexArray:
    """Rotate and move inner loops at random, as rigid bodies without contact to other loops."""
    image = z.copy()
    outer, *inner = sorted(boundary_loops(F, len(z)), key=lambda loop: -span(z[loop]))
    others = [z[outer]]
    for loop in inner:
        hole = z[loop]
        for _ in range(50):
            turn = np.exp(2j * np.pi * difficulty * rng.uniform(-1, 1))
            shift = difficulty * span(z) * rng.uniform(0, 0.8) * np.exp(2j * np.pi * rng.random())
            there = hole.mean() + shift + (hole - hole.mean()) * turn
            radius = abs(there - there.mean()).max()
            if _inside(there.mean(), z[outer]) and all(abs(o - there.mean()).min() > 1.1 * radius for o in others):
                image[loop] = there
                break
        others.append(image[loop])
    return image


def _inside(point: complex, loop: ComplexArray) -> bool:
    turned = np.angle((np.roll(loop, -1) - point) / (loop - point)).sum()
    return bool(turned > np.pi)


def polygon(rng: Generator, difficulty: float) -> list[FloatArray]:
    """A simple polygon: a tour of random points with crossings removed."""
    z = rng.normal(size=5 + int(25 * difficulty)) + 1j * rng.normal(size=5 + int(25 * difficulty))
    n, crossed = len(z), True
    while crossed:
        crossed = False
        for i in range(n - 2):
            for j in range(i + 2, n - (i == 0)):
                a, b, c, d = z[i], z[i + 1], z[j], z[(j + 1) % n]
                if abs(a - c) + abs(b - d) < abs(a - b) + abs(c - d) - 1e-12:
                    z[i + 1 : j + 1] = z[i + 1 : j + 1][::-1]
                    crossed = True
    if (z.conj() * np.roll(z, -1)).imag.sum() < 0:
        z = z[::-1]
    return [points(z)]


def burst(rng: Generator, difficulty: float) -> list[FloatArray]:
    """A star; corners get sharper with difficulty."""
    return [star(int(rng.integers(3, 5 + int(12 * difficulty))), 0.7 * (1 - difficulty) + 0.03)]


def whirl(rng: Generator, difficulty: float) -> list[FloatArray]:
    """A band wound into a spiral."""
    angle = np.linspace(0, 2 * np.pi * (0.3 + 3.7 * difficulty), 30 + int(120 * difficulty))
    half = np.pi * rng.uniform(0.3, 0.9)
    radius = angle + rng.uniform(1.1, 2) * np.pi
    turn = np.exp(1j * angle)
    return [points(np.concatenate([(radius + half) * turn, ((radius - half) * turn)[::-1]]))]


def teeth(rng: Generator, difficulty: float) -> list[FloatArray]:
    """A comb."""
    count, depth = int(rng.integers(2, 4 + int(6 * difficulty))), 0.5 + 12 * difficulty
    left = 2.0 * np.arange(count)[::-1]
    tooth = np.stack([left + 1 + 1j, left + 1 + (1 + depth) * 1j, left + (1 + depth) * 1j, left + 1j], axis=1).ravel()
    return [points(np.concatenate([[0, 2 * count - 1], tooth[1:-1]]))]


def glyph(rng: Generator, difficulty: float) -> list[FloatArray]:
    """A letter, a digit or a sign."""
    return letter(_GLYPHS[int(rng.integers(len(_GLYPHS)))])


def snowflake(rng: Generator, difficulty: float) -> list[FloatArray]:
    """Koch's snowflake."""
    return [points(koch(1 + int(3.99 * difficulty)))]


def filling(rng: Generator, difficulty: float) -> list[FloatArray]:
    """A band along Hilbert's curve."""
    z = hilbert(1 + int(3.99 * difficulty))
    step = np.diff(z)
    into, out = np.append(step[0], step), np.append(step, step[-1])
    # At a turn, the band's corner is offset from the curve by both normals, elsewhere by one.
    side = rng.uniform(0.2, 0.45) * 1j * (into + out) / (1 + (into.conj() * out).real)
    return [points(np.concatenate([z - side, (z + side)[::-1]]))]


def koch(level: int) -> ComplexArray:
    """Return the corners of Koch's snowflake around 0, counterclockwise; its shortest sides have length 1."""
    sixth = np.exp(1j * np.pi / 3)
    z = 3.0**level / np.sqrt(3) * np.exp(2j * np.pi * np.arange(3) / 3 - 1j * np.pi / 6)
    for _ in range(level):
        third = (np.roll(z, -1) - z) / 3
        z = np.stack([z, z + third, z + third + third / sixth, z + 2 * third], axis=1).ravel()
    return z


def hilbert(order: int) -> ComplexArray:
    """Return the corners of Hilbert's curve (4 ** order,), with unit steps."""
    z = np.zeros(1, dtype=complex)
    for k in range(order):
        side, turned = 2**k, 1j * z.conj()
        z = np.concatenate([turned, z + 1j * side, z + (1 + 1j) * side, 2 * side - 1 + 1j * (side - 1) - turned])
    return z
