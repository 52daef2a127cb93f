"""VectorAdam in the Poincaré disk: tensors of determinant 1 are points of the hyperbolic plane (future work in §8.2).

A step follows a geodesic from μ for any |ξ|. Parallel transport carries the mean of the gradients along. Lengths are
``|dμ|/(1 − |μ|²)``, half of the usual hyperbolic length; at the origin they equal lengths of ξ with tanh. In these
units the gradient differs from tanh's only in its component across ξ, by ``2ρ/sinh 2ρ`` with ρ = |ξ|.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from quasiharmonic.solver.field.objective import Iterate, Objective
from quasiharmonic.solver.field.tensor import TANH
from quasiharmonic.solver.methods import VectorAdam
from quasiharmonic.solver.methods.base import Iterates
from quasiharmonic.util.arrays import ComplexArray, FloatArray


def exponential(mu: ComplexArray, step: ComplexArray) -> ComplexArray:
    """Return the end of a geodesic from μ in the direction and with the length of ``step``, by Möbius addition."""
    length = np.abs(step)
    there = np.tanh(length) * np.divide(step, length, out=np.zeros_like(step), where=length > 0)
    return (mu + there) / (1 + np.conj(mu) * there)


def transport(start: ComplexArray, end: ComplexArray) -> ComplexArray:
    """Return the phases by which parallel transport along the geodesic between two points multiplies vectors."""
    turn = 1 - end * np.conj(start)
    return turn / np.conj(turn)


def riemannian(gradient: ComplexArray, xi: ComplexArray) -> ComplexArray:
    """Return the gradient in an orthonormal frame at μ, with the axes of μ, from the gradient in ξ with tanh."""
    rho = np.abs(xi)
    axis = np.divide(xi, rho, out=np.ones_like(xi), where=rho > 0)
    local = np.conj(axis) * gradient
    across: FloatArray = np.divide(2 * rho, np.sinh(2 * rho), out=np.ones_like(rho), where=rho > 0)
    return axis * (local.real + 1j * across * local.imag)


@dataclass(frozen=True, kw_only=True)
class HyperbolicAdam(VectorAdam):
    """VectorAdam with steps along geodesics; tanh only."""

    label: ClassVar[str] = "hyperbolic-adam"

    def iterates(self, objective: Objective, start: Iterate) -> Iterates:
        """See `Descent`."""
        first, second = self.momenta
        times, lengths = zip(*self._steps, strict=True)
        mean, square = np.zeros_like(start.xi), np.zeros(start.xi.shape)
        here = start
        for k in range(1, self.iterations + 1):
            gradient = riemannian(here.gradient, here.xi)
            mean = first * mean + (1 - first) * gradient
            square = second * square + (1 - second) * np.abs(gradient) ** 2
            length = float(np.interp(k - 1, times, lengths)) * np.sqrt(1 - second**k) / (1 - first**k)
            step = np.divide(-length * mean, np.sqrt(square), out=np.zeros_like(mean), where=square > 0)
            there = objective.step(here, TANH.invert(exponential(here.field.mu, step)) - here.xi)
            mean *= transport(here.field.mu, there.field.mu)
            here = there
            yield here
        return False
