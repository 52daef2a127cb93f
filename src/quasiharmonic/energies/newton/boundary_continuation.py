"""Fixed vertices that go somewhere else and take the map along, every triangle positive on the way.

A step of Newton's method for the boundary as it will be: with g the energy's gradient by the free vertices, H its
second derivative, and Δ how far the fixed ones have to go, the free ones go by::

    d = −H⁻¹ (g + (H Δ)_free)

which catches up with what the last step left undone too. It is taken as far as the triangles bear, and repeated from
there until the fixed vertices have arrived. So the map is carried continuously: it neither leaps to another minimum nor
turns the other way around a hole.
"""

from __future__ import annotations

import numpy as np

from quasiharmonic.energies.newton.newton_descent import SHIFTS, NewtonDescent, in_units
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.util.arrays import ComplexArray, FloatArray

# Of the way to the first triangle's collapse, what a step takes.
_FRACTION = 0.8
# No step is a smaller part of what is left of the way.
_SHORTEST = 1e-4


class CarryingDescent(NewtonDescent):
    """The descent of `NewtonDescent`, whose fixed vertices can be carried elsewhere."""

    def place(self, uv: FloatArray) -> None:
        """Go on from another injective map (n, 2), its fixed vertices where they are in it."""
        self.w, self._pinned = in_units(uv, self.exponent), uv[self.fixed]
        self._look()

    def carry(self, target: FloatArray, tolerance: float, steps: int) -> float:
        """Take the fixed vertices to a target (k, 2), or as far as the triangles let them.

        A map that had to stop on the way is lowered by one step before it goes on.

        Parameters
        ----------
        target : (k, 2) float64
        tolerance : float
            As of `NewtonDescent.step`.
        steps : int
            To take at most.

        Returns
        -------
        float
            Which share of the way: 1 where they have arrived, to the last bit.
        """
        left = 1.0
        for k in range(steps):
            if k > 0:
                self.step(tolerance)
            t = self._carried(target)
            left *= 1 - t
            if left == 0 or t == 0:
                break
        return 1 - left

    def _look(self) -> None:
        self._deformation = self.energy.deform(self.w)
        self.value = self.first = self.energy.value_of(self._deformation)

    def _carried(self, target: FloatArray) -> float:
        """Take a step of the way; its length, 1 for all of it and 0 for none."""
        way = np.zeros_like(self.w)
        way[self.fixed] = in_units(target, self.exponent) - self.w[self.fixed]
        self.assemble(0.0)
        found = self.system.descent(self.gradient() + self._pull(way), (0.0, *SHIFTS), self.solve)
        if found is None:
            return 0.0
        way[self.system.free] = found[0]
        start, pinned = self.w, self._pinned
        t = min(1.0, _FRACTION * float(self.energy.steps_to_collapse(start, way).min()))
        while t >= _SHORTEST:
            self.w = start + t * way
            there = np.ldexp(self.w[self.fixed].view(np.float64).reshape(-1, 2), self.exponent)
            self._pinned = target if t == 1 else there
            if is_injective(self.energy.F, self.positions(self.w)):
                self._look()
                return t
            t *= 0.5
        self.w, self._pinned = start, pinned
        return 0.0

    def _pull(self, way: ComplexArray) -> ComplexArray:
        """The second derivative, clamped as in the matrix, times a displacement (n,): what it is at the free ones."""
        corners, g = self.energy.F.T, self.energy.g
        form = self.energy.curvature_of(self._deformation)
        p, q = form.apply((g.conj() * way[corners]).sum(axis=0), (g * way[corners]).sum(axis=0))
        pull, at = (g * p + g.conj() * q).ravel(), corners.ravel()
        both = np.bincount(at, pull.real, minlength=way.size) + 1j * np.bincount(at, pull.imag, minlength=way.size)
        return both[self.system.free]
