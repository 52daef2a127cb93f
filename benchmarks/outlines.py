"""Outlines that a boundary is laid along, for `problems`: an outer contour, then holes."""

from __future__ import annotations

import numpy as np

from planar import points, span
from quasiharmonic.arrays import ComplexArray, FloatArray, IntArray
from quasiharmonic.mesh.topology import boundary_loops
from quasiharmonic.targets import arc_length, letter, star

Generator = np.random.Generator

# Glyphs of one piece; marks and dots would be components of their own.
_GLYPHS = "ABCDEFGHKLMNOPQRSTUVWXYZabcdefghkmnopqrstuvwxyz023456789&@§$ß"


def laid(z: ComplexArray, F: IntArray, contours: list[FloatArray]) -> ComplexArray:
    """Where the boundary vertices go: the longest loop along the first contour, the others in turn along theirs."""
    image = np.zeros_like(z)
    loops = sorted(boundary_loops(F, len(z)), key=lambda loop: -span(z[loop]))
    for loop, contour in zip(loops, contours, strict=False):
        try:
            placed = arc_length(points(z[loop]), contour)
        except ValueError:
            # Too few vertices to keep all corners.
            placed = arc_length(points(z[loop]), contour, corner_angle=181)
        image[loop] = placed[:, 0] + 1j * placed[:, 1]
    return image


def moved_holes(rng: Generator, z: ComplexArray, F: IntArray, difficulty: float) -> ComplexArray:
    """Inner loops turned and moved at random, as rigid bodies that keep clear of each other and the outer loop."""
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
    """A simple polygon: the tour of random points, uncrossed."""
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
    """A star, ever sharper."""
    return [star(int(rng.integers(3, 5 + int(12 * difficulty))), 0.7 * (1 - difficulty) + 0.03)]


def whirl(rng: Generator, difficulty: float) -> list[FloatArray]:
    """A band wound up."""
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
