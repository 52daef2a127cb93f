"""Which movements of a map's vertices are permitted, and which transformations do not change its energy.

Vertices are free, fixed, on a line that fixes the gauge, or on curves. The unknowns are those of `SlidingSystem`: both
coordinates of a free vertex, and the distance along the tangent of a sliding vertex.

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

from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.energies.newton.sliding_boundary import BARRIER_WEIGHT, SlidingSystem, choose_tangents
from quasiharmonic.geometry.curves.boundary_curves import Track
from quasiharmonic.geometry.curves.deviation import DeviationBarrier
from quasiharmonic.problem import Domain
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, work

# Step for differences of the barrier's gradient, relative to the mean length of a boundary edge: the curve's length
# divided by the number of sliding vertices.
_STEP = 1e-6


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


class Freedom:
    """Fixed vertices, vertices on lines through their positions, and free vertices.

    ``tangent`` (l,) are unit directions of the lines of the ``sliding`` vertices (l,). ``system`` is the linear system
    of the unknowns. ``resting`` tells whether a sliding vertex stays at its position, at a kink or an end of its curve.

    The calls of one step have this order: `prepare` at the current map, `gradient`, `advance` for each trial, `extra`
    for the value of the last trial, and `keep` for the trial that is accepted.
    """

    resting = False

    def __init__(
        self,
        energy: DeformationEnergy,
        n: int,
        fixed: IntArray,
        linear_solver: str,
        sliding: IntArray | None = None,
        tangent: ComplexArray | None = None,
    ) -> None:
        self._n = n
        self.sliding = np.zeros(0, dtype=np.int64) if sliding is None else sliding
        self.system = SlidingSystem(energy.F, energy.g, n, fixed, linear_solver, sliding=self.sliding)
        if tangent is not None:
            self.system.tangent = tangent

    def extra(self) -> float:
        """The value of additional terms of the objective at the current positions."""
        return 0.0

    def prepare(self, pull: ComplexArray) -> None:
        """Prepare the system for the forces (n,) at the current map."""

    def gather(self, load: ComplexArray) -> ComplexArray:
        """Loads (n,) on the unknowns; a sliding vertex uses the real part, and its imaginary part is zero."""
        system = self.system
        out = load[system.free]
        out[system.at] = (system.tangent.conj() * out[system.at]).real
        return out

    def gradient(self, pull: ComplexArray) -> ComplexArray:
        """The gradient of the objective with respect to the unknowns, from the forces (n,)."""
        return self.gather(pull)

    def spread(self, step: ComplexArray) -> ComplexArray:
        """Displacements (n,) of the vertices under a step of the unknowns, to first order."""
        out = np.zeros(self._n, dtype=np.complex128)
        out[self.system.free] = step
        out[self.sliding] = self.system.tangent * step[self.system.at].real
        return out

    def advance(self, w: ComplexArray, step: ComplexArray) -> ComplexArray | None:
        """The map after a step of the unknowns; None if the step is not possible."""
        return w + self.spread(step)

    def keep(self) -> None:
        """Accept the positions of the last step that was evaluated."""


class SlidingFreedom(Freedom):
    """Boundary vertices that slide along curves, as in `quasiharmonic.polish`; fixed vertices may be among them.

    A barrier keeps the boundary's edges near the curves. Its bounds and weight are those of a polish started here, and
    stay constant. The map is in units of ``2 ** exponent``.
    """

    def __init__(
        self, energy: DeformationEnergy, track: Track, domain: Domain, exponent: int, linear_solver: str
    ) -> None:
        held = np.setdiff1d(domain.fixed, track.vertices)
        super().__init__(energy, len(track.uv), held, linear_solver, track.vertices)
        self._track, self._s, self._there = track, track.s, track.s
        self._deviation, self._unit = DeviationBarrier(track, domain.loops, exactly=True), 2.0**exponent
        self._weight = BARRIER_WEIGHT * energy.value(in_units(track.uv, exponent))
        self._both = (self._deviation.pairs >= 0).all(axis=1)
        self.system.couple(self._deviation.pairs[self._both])

    def extra(self) -> float:
        """The barrier's value at the positions of the last step that was evaluated."""
        return self._weight * self._deviation.value(self._there)

    def prepare(self, pull: ComplexArray) -> None:
        s, system = self._s, self.system
        # The barrier's derivatives by the arc lengths of the sliding vertices, in units.
        self._by_arc = np.zeros(s.size)
        self._deviation.add_at_ends(self._by_arc, self._by_edges(s))
        tangent, _, bending, self._side = choose_tangents(self._track, s, pull[self.sliding], self._by_arc)
        self.resting = bool((tangent == 0).any())
        system.tangent = tangent
        system.curve_stiffness = bending * self._unit
        bends = self._barrier_hessian(s)
        self._deviation.add_at_ends(system.curve_stiffness, bends[:, (0, 1), (0, 1)])
        both = (tangent[self._deviation.pairs[self._both]] != 0).all(axis=1)
        system.coupling = np.where(both, bends[self._both, 0, 1], 0)

    def gradient(self, pull: ComplexArray) -> ComplexArray:
        out = self.gather(pull)
        out[self.system.at] += np.where(self.system.tangent == 0, 0, self._by_arc)
        return out

    def advance(self, w: ComplexArray, step: ComplexArray) -> ComplexArray | None:
        along = step[self.system.at].real
        along = np.where(along * self._side < 0, 0, along)
        there = self._track.advance(self._s, self._unit * along)
        if not self._track.in_order(there):
            return None
        self._there = there
        out = w + self.spread(step)
        exponent = round(np.log2(self._unit))
        out[self.sliding] = in_units(self._track.position(there), exponent)
        return out

    def keep(self) -> None:
        self._s = self._there

    def _by_edges(self, s: FloatArray) -> FloatArray:
        """The barrier's derivatives by the arc lengths at each edge's ends, in units; (e, 2)."""
        return self._weight * self._unit * self._deviation.derivatives(s)[0]

    @cached_property
    def _colours(self) -> IntArray:
        """A colouring of the sliding vertices with three colours; no edge joins two of the same colour.

        The vertices are numbered along their curves, so colours alternate, except where a closed curve or the numbers
        of two curves meet.
        """
        colours = np.arange(self._s.size) % 2
        one, other = self._deviation.pairs[self._both].T
        colours[other[colours[one] == colours[other]]] = 2
        return colours

    def _barrier_hessian(self, s: FloatArray) -> FloatArray:
        """The barrier's second derivatives by edge, (e, 2, 2), by differences; `DeviationBarrier` omits some terms."""
        pairs = self._deviation.pairs
        out = np.zeros((len(pairs), 2, 2))
        lengths = np.array([chain.curve.length for chain in self._track.chains for _ in range(chain.sliding.sum())])
        step = _STEP * lengths / max(s.size, 1)
        for colour in range(3):
            change = np.where(self._colours == colour, step, 0.0)
            if not change.any():
                continue
            ahead, behind = (self._by_edges(self._track.advance(s, way * change)) for way in (1, -1))
            for end in (0, 1):
                those = np.flatnonzero((pairs[:, end] >= 0) & (change[pairs[:, end]] > 0))
                width = 2 * change[pairs[those, end]] / self._unit
                out[those, :, end] = (ahead - behind)[those] / width[:, None]
        return 0.5 * (out + out.swapaxes(1, 2))
