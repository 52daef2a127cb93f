"""The function of ξ that is descended: one evaluation is one assembly, one factorisation, one solve."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.functionals import FUNCTIONALS, Functional, beltrami_energy
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.mesh.reference import Derivatives, Reference
from quasiharmonic.problem import Problem
from quasiharmonic.tensor import PARAMETERIZATIONS, TensorField

ComplexArray = NDArray[np.complex128]


class Objective:
    """``Q(ξ) = V(A(ξ))`` for one problem, functional and parameterisation (eq. 18, 34).

    Parameters
    ----------
    problem : Problem
    functional : str
        A name of `quasiharmonic.functionals.FUNCTIONALS`.
    parameterization : str
        A name of `quasiharmonic.tensor.PARAMETERIZATIONS`.
    reference : {"equilateral", "rest", "corrected"}
        Shape of the triangles, unless the problem itself names one.
    linear_solver : str
        A name of `quasiharmonic.linsolve`, or ``"auto"``.
    """

    def __init__(
        self,
        problem: Problem,
        functional: str = "dirichlet",
        parameterization: str = "tanh",
        reference: Reference = "equilateral",
        linear_solver: str = "auto",
    ) -> None:
        self.problem = problem
        self.mesh = problem.mesh(problem.reference or reference)
        self.parameterization = PARAMETERIZATIONS[parameterization]
        self.laplacian = problem.laplacian(linear_solver)
        self.functional: Functional = FUNCTIONALS[functional](problem, self.mesh, self.laplacian)
        self._boundary = np.zeros(problem.n, dtype=np.complex128)
        self._boundary[problem.fixed] = problem.frame.inward(problem.target)

    def evaluate(self, xi: ComplexArray) -> Iterate:
        """The map of ``xi`` and all that follows from it.

        Parameters
        ----------
        xi : (f,) complex128

        Raises
        ------
        quasiharmonic.linsolve.NotPositiveDefinite
            When rounding leaves no positive definite Laplacian.
        """
        field = self.parameterization.field(xi)
        self.laplacian.factor(self.mesh.edge_stiffness(field.entries()))
        w = self.laplacian.extend(self._boundary)
        if not np.isfinite(w.view(np.float64)).all():
            raise NotPositiveDefinite("the solution is not finite")
        return Iterate(self, field, w, self.mesh.derivatives(w))

    def step(self, start: Iterate, step: ComplexArray) -> Iterate:
        """Evaluate at ``ξ + step``, the tensors kept within the numbers' range and the step shortened when
        even so no factorisation exists.

        Raises
        ------
        quasiharmonic.linsolve.NotPositiveDefinite
            When steps down to a thousandth fail.
        """
        for _ in range(10):
            try:
                return self.evaluate(self.bounded(start.xi + step))
            except NotPositiveDefinite:
                step = 0.5 * step
        return self.evaluate(self.bounded(start.xi + step))

    def bounded(self, xi: ComplexArray) -> ComplexArray:
        """``xi`` with moduli clipped to where the rounded tensor is still positive definite."""
        bound = self.parameterization.bound
        modulus = np.sqrt(xi.real**2 + xi.imag**2)
        far = modulus > bound
        if far.any():
            xi = xi.copy()
            xi[far] *= bound / modulus[far]
        return xi


@dataclass(frozen=True)
class Iterate:
    """The state at one ξ.

    Attributes
    ----------
    field : TensorField
    w : (n,) complex128
        The quasi-harmonic map in the problem's frame.
    dw : Derivatives
        Its derivatives and the images' signed areas.
    """

    objective: Objective
    field: TensorField
    w: ComplexArray
    dw: Derivatives

    @property
    def xi(self) -> ComplexArray:
        """The variable (f,) complex128."""
        return self.field.xi

    @cached_property
    def flipped(self) -> int:
        """Number of triangles whose image's area is not positive, in floating point."""
        return int(np.count_nonzero(~(self.dw.area > 0)))

    @cached_property
    def dirichlet(self) -> float:
        """V₃, whatever the objective's functional."""
        return beltrami_energy(self.objective.mesh, self.field, self.dw)

    @cached_property
    def energy(self) -> float:
        """V₃ over the map's signed area (over the sum of unsigned areas where that is not positive)."""
        area = float(self.dw.area.sum())
        if not area > 0:
            area = float(np.abs(self.dw.area).sum())
        return self.dirichlet / area if area > 0 else np.inf

    @cached_property
    def value(self) -> float:
        """The objective's value."""
        return self.objective.functional.value(self)

    @cached_property
    def gradient(self) -> ComplexArray:
        """Its gradient in ξ, ``∂/∂Re ξ + i ∂/∂Im ξ``; (f,) complex128."""
        return self.field.pull(self.objective.functional.gradient(self))
