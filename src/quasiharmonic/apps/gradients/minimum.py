"""A map brought to rest to rounding, and the second derivative there, factored once.

A polish ends where Newton's model promises less than a ten-thousandth, and its matrices are made positive. Here steps
are Newton's own, with second derivatives as they are, and the last of them is no longer than rounding makes it. Where
they are not positive definite, as may be on the way, so much of what is negative on triangles is left out as it takes.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock
from typing import Any

import numpy as np

from quasiharmonic.apps.gradients.derivative import Doubt
from quasiharmonic.apps.gradients.forces import Forces
from quasiharmonic.apps.gradients.freedom import Freedom
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import Deformation
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.util.arrays import ComplexArray
from quasiharmonic.util.progress import heartbeat

# Steps at most, and how often one is halved.
_STEPS, _HALVINGS = 100, 40
# Where second derivatives have a negative direction, how much of what is negative on triangles is left out, in turn.
_CLAMPED = 1 / 64, 1 / 16, 1 / 4, 1.0
# A step that strains no triangle by more than this is none; one as short as the second, and not half as long as the one
# before, is rounding; and a map whose last step strains more than the third is not at rest.
_NOTHING, _SHORT, _AT_REST = 1e-12, 1e-6, 1e-6
# After a step as short as this second derivatives are the same to so many digits, and are not factored anew.
_NEAR = 1e-8
# What the energy may rise by, of itself: its rounding.
_ROUNDING = 1e-13
# With the diagonal scaled to one, an eigenvalue as small as this is none.
_SINGULAR, _ITERATIONS = 1e-10, 2
# A triangle's singular values, the smaller over the larger, from where on it is as good as collapsed.
_THIN = 1e-8


class Minimum:
    """A stationary point of an energy, and the inverse of its second derivative.

    Parameters
    ----------
    energy : DeformationEnergy
    w : (n,) complex128
        An injective map near it, the vertices of ``freedom`` on their curves.
    freedom : Freedom
    settle : bool
        Go there; or stay, and take the forces that are left as staying what they are.

    Attributes
    ----------
    w : (n,) complex128
        The map at rest; injective, decided exactly.
    forces : Forces
        At it.
    doubts : list of Doubt
    """

    def __init__(self, energy: DeformationEnergy, w: ComplexArray, freedom: Freedom, *, settle: bool = True) -> None:
        self._energy, self._freedom, self.w = energy, freedom, w
        self._lock = Lock()
        self._lu: Any = None
        self._clamped = 0.0
        self.doubts: list[Doubt] = []
        with np.errstate(all="ignore"):
            left = self._settle(_STEPS if settle else 0)
            self.forces = self._forces(self._deformation)
            if not self._exact:
                self._by_lu()
            self._judge(left)

    def solve(self, load: ComplexArray) -> ComplexArray:
        """The displacement (n,) of the vertices under a load (n,) on them."""
        freedom = self._freedom
        on_unknowns = freedom.gathered(load)
        if self._lu is None:
            return freedom.spread(freedom.system.solve(on_unknowns))
        with self._lock:
            return freedom.spread(self._lu.solve(on_unknowns.view(np.float64)).view(np.complex128))

    def _settle(self, steps: int) -> float:
        """Take steps until there is none to take, and leave the system factored; the strain of the step not taken."""
        last = np.inf
        for left in range(steps, -1, -1):
            heartbeat()
            gradient = self._at()
            step, self._exact = self._direction(gradient)
            size = self._strain(step)
            if size <= _NOTHING or (self._exact and size <= _SHORT and size > 0.5 * last):
                return size
            if not left or not self._moved(step):
                return size
            if self._exact and size <= _NEAR:
                # Quadratic convergence: this was the last step, and the factor is good to as many digits.
                self._at()
                return size
            last = size
        raise AssertionError("the last step has already returned")

    def _at(self) -> ComplexArray:
        """Look at the map at hand; the slopes by the unknowns."""
        self._deformation: Deformation = self._energy.deform(self.w)
        pull = self._energy.gradient_of(self._deformation, self.w.size)
        self._freedom.aim(pull)
        return self._freedom.slopes(pull)

    def _direction(self, gradient: ComplexArray) -> tuple[ComplexArray, bool]:
        """Newton's step, and whether by the second derivatives as they are."""
        system = self._freedom.system
        for clamped in (0.0, *_CLAMPED):
            if 0 < clamped < self._clamped:
                continue
            system.assemble(self._energy.curvature_of(self._deformation, negative=1.0 - clamped))
            if system.diagonal.min(initial=0.0) < 0:
                continue
            found = system.descent(gradient, (0.0,) if clamped < 1 else (1e-12, 1e-6))
            if found is not None:
                self._clamped = clamped / 4
                return found[0], clamped == 0
        return system.solve_diagonal(-gradient), False

    def _strain(self, step: ComplexArray) -> float:
        """By how much of itself a step changes a triangle, at most."""
        energy, moved = self._energy, self._freedom.spread(step)[self._energy.F.T]
        dp, dq = np.sum(energy.g.conj() * moved, axis=0), np.sum(energy.g * moved, axis=0)
        return float(np.max((np.abs(dp) + np.abs(dq)) / np.abs(self._deformation.p)))

    def _moved(self, step: ComplexArray) -> bool:
        """Take as much of a step as is good; False if none of it is."""
        before = self._energy.value_of(self._deformation) + self._freedom.extra()
        t = 1.0
        for _ in range(_HALVINGS):
            there = self._freedom.advance(self.w, t * step)
            if there is not None:
                value = self._energy.value(there) + self._freedom.extra()
                if value <= before + _ROUNDING * abs(before) and is_injective(
                    self._energy.F, there.view(np.float64).reshape(-1, 2)
                ):
                    self.w = there
                    self._freedom.keep()
                    return True
            t *= 0.5
        return False

    def _forces(self, d: Deformation) -> Forces:
        energy = self._energy
        by_p, by_q = energy.energy.gradient(d)
        form = energy.energy.curvature(d, negative=1.0)
        corners = np.ascontiguousarray(energy.F.T)
        return Forces(corners, self.w.size, energy.g, energy.share, d.p, d.q, by_p, by_q, form)

    def _by_lu(self) -> None:
        """Factor the second derivatives as they are although they have a negative direction."""
        from scipy.sparse import dia_array
        from scipy.sparse.linalg import splu

        system = self._freedom.system
        system.assemble(self._energy.curvature_of(self._deformation, negative=1.0))
        matrix = system.matrix()
        # Unknowns that there are none of, across a line, have empty rows.
        empty = (abs(matrix) @ np.ones(matrix.shape[0])) == 0
        self._lu = splu((matrix + dia_array((empty[None].astype(np.float64), [0]), shape=matrix.shape)).tocsc())
        self.doubts.append(Doubt.NOT_LEAST)

    def _judge(self, left: float) -> None:
        """Say what is doubtful."""
        if not left <= _AT_REST:
            self.doubts.append(Doubt.NOT_AT_REST)
        if self._least_eigenvalue() < _SINGULAR:
            self.doubts.append(Doubt.NEAR_SINGULAR)
        p, q = np.abs(self._deformation.p), np.abs(self._deformation.q)
        if np.any(p - q < _THIN * (p + q)):
            self.doubts.append(Doubt.NEAR_COLLAPSE)
        if self._freedom.resting:
            self.doubts.append(Doubt.SLIDING)

    def _least_eigenvalue(self) -> float:
        """About the least modulus of an eigenvalue, the diagonal scaled to one; from above."""
        system = self._freedom.system
        if not system.free.size:
            return 1.0
        scale = np.sqrt(np.abs(system.diagonal))
        solve: Callable[[ComplexArray], ComplexArray] = system.solve
        if self._lu is not None:
            lu = self._lu
            solve = lambda load: lu.solve(load.view(np.float64)).view(np.complex128)  # noqa: E731
        x = np.random.default_rng(0).standard_normal(scale.size)
        growth = 0.0
        for _ in range(_ITERATIONS):
            x *= scale / np.linalg.norm(x)
            try:
                x = scale * solve(x.view(np.complex128)).view(np.float64)
            except NotPositiveDefinite:
                return 0.0
            growth = float(np.linalg.norm(x))
        return 1 / growth if growth > 0 else 1.0
