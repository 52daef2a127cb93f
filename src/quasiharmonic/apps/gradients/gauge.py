"""The transformations that do not change a map's energy, and the derivative that excludes them.

Without fixed vertices, shifts and rotations of a flattened map do not change its energy. With one fixed vertex,
rotations about it do not. Some energies are also independent of scale. The derivative is that of the map nearest to the
given one by least squares over the vertices (Procrustes). So the vertices' displacements have no common shift or
rotation. If the scale is free, the map keeps the surface's area.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from quasiharmonic.util.arrays import ComplexArray, IntArray, work


@dataclass(frozen=True, eq=False)
class Gauge:
    """The transformations of a map that do not change its energy.

    ``pin`` is the fixed vertex, if there is one. ``scales`` says whether the energy is independent of the map's scale.
    ``loops`` are the map's boundary loops.
    """

    w: ComplexArray
    pin: int | None
    scales: bool
    loops: Sequence[IntArray]

    @property
    def arms(self) -> ComplexArray:
        """Positions (n,) relative to the centre of rotation: the fixed vertex, or the mean of all vertices."""
        centre = self.w.mean() if self.pin is None else self.w[self.pin]
        return np.asarray(self.w - centre)

    def constraints(self) -> tuple[IntArray, IntArray, ComplexArray]:
        """Return the constraints that exclude these transformations: fixed and sliding vertices, unit directions."""
        first = int(np.argmax(np.abs(self.arms))) if self.pin is None else self.pin
        apart = self.w - self.w[first]
        second = int(np.argmax(np.abs(apart)))
        if self.scales:
            return np.array([first, second]), np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.complex128)
        return np.array([first]), np.array([second]), apart[[second]] / abs(apart[second])

    def project(self, dw: ComplexArray) -> ComplexArray:
        """Remove the part of a displacement or gradient (n,) that lies along these transformations."""
        out = dw - dw.mean() if self.pin is None else dw
        arms = self.arms
        square = work(arms, arms)
        for way in (1j * arms, arms)[: 2 if self.scales else 1]:
            out = out - work(way, out) / square * way
        return out

    @property
    def keeps_area(self) -> bool:
        """Whether a map with a free scale is scaled to the surface's area, as in `quasiharmonic.flatten`."""
        return self.scales and self.pin is None

    def select(self, dw: ComplexArray, held: ComplexArray, more: float) -> ComplexArray:
        """Return the displacement (n,) that defines the derivative, from any equivalent one.

        ``held`` (n,) has the displacements of fixed vertices only. ``more`` is the change of the logarithm of the
        surface's size.
        """
        # A moving fixed vertex shifts the others, and they rotate about it.
        along = 0j if self.pin is None else held[self.pin]
        out = self.project(dw - along) + along
        if self.keeps_area:
            out = out + (more - work(self._by_area, out)) * self.arms
        return out

    def pull_back(self, pull: ComplexArray) -> tuple[ComplexArray, complex, float]:
        """The transpose of `select`: gradients by the displacement (n,), by the pin's position and by ``more``."""
        out = self.project(pull)
        if not self.keeps_area:
            return out, complex((pull - out).sum()), 0.0
        on_scale = work(self.arms, pull)
        return out - on_scale * self.project(self._by_area), 0j, on_scale

    @cached_property
    def _by_area(self) -> ComplexArray:
        """The derivative (n,) of the logarithm of the map's size by its positions."""
        return differentiate_map_size(self.w, self.loops)


def differentiate_map_size(w: ComplexArray, loops: Sequence[IntArray]) -> ComplexArray:
    """The derivative (n,) of half the logarithm of the map's area by its positions; only the boundary contributes."""
    by_area, area = np.zeros_like(w), 0.0
    for loop in loops:
        here = w[loop]
        following = np.roll(here, -1)
        area += 0.5 * float((here.conj() * following).imag.sum())
        by_area[loop] = -0.5j * (following - np.roll(here, 1))
    return by_area / (2 * area)
