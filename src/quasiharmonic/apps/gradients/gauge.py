"""Maps that are as good wherever they lie: how their derivative is made one.

Where nothing is held, a flattened surface may be shifted and turned at will, where one vertex is held turned about it,
and where the energy is blind to scale enlarged as well. Of all maps that are as good the derivative is that of the one
which lies nearest to the map at hand by least squares over the vertices (Procrustes): in a small change the vertices'
displacements have no common part that shifts or turns them. A map whose scale is free keeps the surface's area.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from quasiharmonic.util.arrays import ComplexArray, IntArray, work


@dataclass(frozen=True, eq=False)
class Gauge:
    """What a map may do at no cost.

    Attributes
    ----------
    w : (n,) complex128
        The map.
    pin : int or None
        The vertex that is held, if one is.
    scales : bool
        Whether it may be enlarged.
    loops : sequence of (l,) int64
        Its boundary.
    """

    w: ComplexArray
    pin: int | None
    scales: bool
    loops: Sequence[IntArray]

    @property
    def arms(self) -> ComplexArray:
        """Places (n,) from what the map is turned about: the vertex that is held, or the middle of all."""
        centre = self.w.mean() if self.pin is None else self.w[self.pin]
        return np.asarray(self.w - centre)

    def fixing(self) -> tuple[IntArray, IntArray, ComplexArray]:
        """Vertices to hold, and one to keep on a line, so that nothing of this is possible.

        Returns
        -------
        held, sliding : (1 or 2,) and (1 or 0,) int64
        tangent : (1 or 0,) complex128
        """
        first = int(np.argmax(np.abs(self.arms))) if self.pin is None else self.pin
        apart = self.w - self.w[first]
        second = int(np.argmax(np.abs(apart)))
        if self.scales:
            return np.array([first, second]), np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.complex128)
        return np.array([first]), np.array([second]), apart[[second]] / abs(apart[second])

    def projected(self, dw: ComplexArray) -> ComplexArray:
        """A displacement, or a gradient, (n,) without its part in what costs nothing."""
        out = dw - dw.mean() if self.pin is None else dw
        arms = self.arms
        square = work(arms, arms)
        for way in (1j * arms, arms)[: 2 if self.scales else 1]:
            out = out - work(way, out) / square * way
        return out

    @property
    def keeps_area(self) -> bool:
        """Whether a map whose scale is free is given the surface's area, as `quasiharmonic.flatten` does."""
        return self.scales and self.pin is None

    def fixed(self, dw: ComplexArray, held: ComplexArray, more: float) -> ComplexArray:
        """The displacement (n,) that is the derivative's, of all that are as good.

        Parameters
        ----------
        dw, held : (n,) complex128
            One of them; the displacements of held vertices alone.
        more : float
            The change of the logarithm of the surface's size.
        """
        # What is held carries the others along, and they turn about it.
        along = 0j if self.pin is None else held[self.pin]
        out = self.projected(dw - along) + along
        if self.keeps_area:
            out = out + (more - work(self._by_area, out)) * self.arms
        return out

    def pulled(self, pull: ComplexArray) -> tuple[ComplexArray, complex, float]:
        """The transpose of `fixed`: the gradient (n,) by the displacement, what the pin has, that by ``more``."""
        out = self.projected(pull)
        if not self.keeps_area:
            return out, complex((pull - out).sum()), 0.0
        on_scale = work(self.arms, pull)
        return out - on_scale * self.projected(self._by_area), 0j, on_scale

    @cached_property
    def _by_area(self) -> ComplexArray:
        """The derivative (n,) of the logarithm of the map's size by its places."""
        return log_size(self.w, self.loops)


def log_size(w: ComplexArray, loops: Sequence[IntArray]) -> ComplexArray:
    """The derivative (n,) of half the logarithm of a map's area, which is a matter of its boundary, by its places."""
    by_area, area = np.zeros_like(w), 0.0
    for loop in loops:
        here = w[loop]
        following = np.roll(here, -1)
        area += 0.5 * float((here.conj() * following).imag.sum())
        by_area[loop] = -0.5j * (following - np.roll(here, 1))
    return by_area / (2 * area)
