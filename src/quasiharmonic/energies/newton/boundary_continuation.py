"""Boundary continuation: move fixed vertices to new positions together with the map, keeping every triangle positive.

The step is a Newton step for the new boundary. Let g be the energy's gradient at the free vertices, H its second
derivative, and Δ the displacement of the fixed vertices. The free vertices move by::

    d = −H⁻¹ (g + (H Δ)_free)

The gradient term also corrects the error of earlier steps. The step is shortened so that no triangle collapses, and
repeated until the fixed vertices reach their target. The map thus changes continuously: it does not jump to another
minimum or to the other way around a hole.
"""

from __future__ import annotations

import numpy as np

from quasiharmonic.energies.newton.newton_descent import SHIFTS, NewtonDescent, in_units
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.util.arrays import ComplexArray, FloatArray

# Step as a fraction of the distance to the first collapse of a triangle.
_FRACTION = 0.8
# Minimum step, as a share of the remaining displacement.
_SHORTEST = 1e-4


class CarryingDescent(NewtonDescent):
    """`NewtonDescent` whose fixed vertices can be moved to new positions."""

    def place(self, uv: FloatArray) -> None:
        """Continue from another injective map (n, 2), with the fixed vertices at their positions in it."""
        self.w, self._pinned = in_units(uv, self.exponent), uv[self.fixed]
        self._look()

    def carry(self, target: FloatArray, tolerance: float, steps: int) -> float:
        """Move the fixed vertices to a target (k, 2), as far as possible without inverting triangles.

        Between two partial moves, one descent step lowers the energy.

        Parameters
        ----------
        target : (k, 2) float64
        tolerance : float
            As in `NewtonDescent.step`.
        steps : int
            Maximum number of steps.

        Returns
        -------
        float
            Share of the displacement that was reached: 1 if the vertices are exactly at the target.
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
        """Take one step of the displacement; return its length, 1 for all of it and 0 for none."""
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
        """Product of the clamped second derivative with a displacement (n,), at the free vertices."""
        corners, g = self.energy.F.T, self.energy.g
        form = self.energy.curvature_of(self._deformation)
        p, q = form.apply((g.conj() * way[corners]).sum(axis=0), (g * way[corners]).sum(axis=0))
        pull, at = (g * p + g.conj() * q).ravel(), corners.ravel()
        both = np.bincount(at, pull.real, minlength=way.size) + 1j * np.bincount(at, pull.imag, minlength=way.size)
        return both[self.system.free]
