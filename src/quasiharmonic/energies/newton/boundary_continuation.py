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

from quasiharmonic.energies.newton.line_search import backtrack
from quasiharmonic.energies.newton.map_model import Coordinates, NewtonObjective, in_units, newton_descent, out_of_units
from quasiharmonic.energies.newton.newton_descent import SHIFTS
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, sum_at

# Step as a fraction of the distance to the first collapse of a triangle.
_FRACTION = 0.8
# Minimum step, as a share of the remaining displacement.
_MIN_STEP = 1e-4


class MovingDescent:
    """A descent whose fixed vertices can be moved to new positions; see `newton_descent` for the parameters."""

    def __init__(
        self, energy: NewtonObjective, uv: FloatArray, fixed: IntArray, exponent: int, linear_solver: str
    ) -> None:
        self.newton, self._model = newton_descent(energy, uv, fixed, exponent, linear_solver)

    @property
    def uv(self) -> FloatArray:
        """The current map; (n, 2) float64."""
        return self._model.positions(self.newton.w)

    def set_map(self, uv: FloatArray) -> None:
        """Continue from another injective map (n, 2), with the fixed vertices at their positions in it."""
        coordinates = self._model.coordinates
        self._model.coordinates = coordinates.with_pinned(uv[coordinates.fixed])
        self.newton.state = self._model.evaluate(in_units(uv, coordinates.exponent))

    def move(self, target: FloatArray, tol: float, steps: int) -> float:
        """Move the fixed vertices to a target (k, 2), as far as possible without inverting triangles.

        Between two partial moves, one descent step lowers the energy. Return the share of the displacement that was
        reached: 1 if the vertices are exactly at the target.
        """
        left = 1.0
        for k in range(steps):
            if k > 0:
                self.newton.step(tol)
            t = self._move_once(target)
            left *= 1 - t
            if left == 0 or t == 0:
                break
        return 1 - left

    def _move_once(self, target: FloatArray) -> float:
        """Take one step of the displacement; return its length, 1 for all of it and 0 for none."""
        model, start = self._model, self.newton.state
        system, coordinates = model.system, model.coordinates
        displacement = np.zeros_like(start.w)
        displacement[coordinates.fixed] = in_units(target, coordinates.exponent) - start.w[coordinates.fixed]
        model.assemble(start, 0.0)
        found = system.descent(
            model.gradient(start) + self._multiply_curvature(displacement), (0.0, *SHIFTS), model.solve
        )
        if found is None:
            return 0.0
        displacement[system.free] = found[0]

        def trial(t: float, bound: float) -> tuple[float, Coordinates | None]:
            w = start.w + t * displacement
            there = out_of_units(w[coordinates.fixed], coordinates.exponent)
            moved = coordinates.with_pinned(target if t == 1 else there)
            return 0.0, moved if is_injective(model.energy.F, moved.positions(w)) else None

        longest = min(1.0, _FRACTION * float(model.energy.steps_to_collapse(start.w, displacement).min()))
        if not longest >= _MIN_STEP:
            return 0.0
        tries = 1 + int(np.log2(longest / _MIN_STEP))
        taken = backtrack(trial, 0.0, 0.0, longest=longest, tries=tries)
        if taken is None:
            return 0.0
        model.coordinates = taken.state
        self.newton.state = model.evaluate(start.w + taken.t * displacement)
        return taken.t

    def _multiply_curvature(self, displacement: ComplexArray) -> ComplexArray:
        """Product of the clamped second derivative with a displacement (n,), at the free vertices."""
        energy = self._model.energy
        corners, g = energy.F.T, energy.g
        form = energy.curvature_of(self.newton.state.derivatives)
        p, q = form.apply((g.conj() * displacement[corners]).sum(axis=0), (g * displacement[corners]).sum(axis=0))
        pull, at = (g * p + g.conj() * q).ravel(), corners.ravel()
        return sum_at(at, pull, displacement.size)[self._model.system.free]
