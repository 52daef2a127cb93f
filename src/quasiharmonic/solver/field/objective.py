"""The function of ξ that is descended: one evaluation is one assembly, one factorisation, one solve."""

from __future__ import annotations

from copy import copy
from functools import cached_property
from typing import NamedTuple
from weakref import ref

import numpy as np

from quasiharmonic.geometry.mesh.reference import Derivatives, Reference
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.linsolve.laplacian import FactoredLaplacian
from quasiharmonic.problem import Problem
from quasiharmonic.solver.field.functionals import FUNCTIONALS, Functional
from quasiharmonic.solver.field.passes import clip_moduli, stiffness_of, sweep
from quasiharmonic.solver.field.tensor import PARAMETERISATIONS, TANH, TensorField, own_tensor
from quasiharmonic.util.arrays import ComplexArray


class Objective:
    """``Q(ξ) = V(A(ξ))`` for one problem, functional and parameterisation (eq. 18, 34).

    Parameters
    ----------
    problem : Problem
    functional : str
        A name of `quasiharmonic.solver.field.functionals.FUNCTIONALS`.
    parameterisation : str
        A name of `quasiharmonic.solver.field.tensor.PARAMETERISATIONS`.
    reference : {"equilateral", "rest", "corrected"}
        Shape of the triangles, unless the problem itself names one.
    linear_solver : str
        A name of `quasiharmonic.linsolve`, or ``"auto"``.

    Attributes
    ----------
    problem, mesh, laplacian, parameterisation, functional
        What it is made of; none of them changes.
    """

    def __init__(
        self,
        problem: Problem,
        functional: str = "dirichlet",
        parameterisation: str = "tanh",
        reference: Reference = "equilateral",
        linear_solver: str = "auto",
    ) -> None:
        self.problem = problem
        self.mesh = problem.domain.mesh(problem.reference or reference)
        self.parameterisation = PARAMETERISATIONS[parameterisation]
        self.laplacian = problem.domain.laplacian(linear_solver)
        self.functional: Functional = FUNCTIONALS[functional](problem, self.mesh)

    def descending(self, functional: Functional) -> Objective:
        """The same with another functional, made for this problem and this mesh."""
        other = copy(self)
        other.functional = functional
        return other

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
        field = self.parameterisation.field(xi)
        operator = self.operator(field)
        w = operator.extend(self.problem.held)
        if not np.isfinite(w.view(np.float64)).all():
            raise NotPositiveDefinite("the solution is not finite")
        return Iterate(self, field, w, operator)

    def operator(self, field: TensorField) -> FactoredLaplacian:
        """The Laplacian of a tensor field, factored."""
        return self.laplacian.factor(stiffness_of(self.mesh, field.parameterisation, field.xi))

    def own_tensor(self, w: ComplexArray) -> ComplexArray:
        """The μ of each triangle's own image, at which V₃ is least with the map held (eq. 39); (f,) complex128."""
        dw = self.mesh.derivatives(w)
        return own_tensor(dw.p, dw.q)

    def of_map(self, w: ComplexArray) -> Iterate:
        """A map at its own tensors: where it is injective, it is their quasi-harmonic map.

        In the tanh parameterisation, which reaches them all.
        """
        return Iterate(self, TANH.field(TANH.invert(self.own_tensor(w))), w)

    def near_map(self, w: ComplexArray) -> Iterate:
        """The quasi-harmonic map of a map's own tensors, as far as this parameterisation reaches them.

        Raises
        ------
        quasiharmonic.linsolve.NotPositiveDefinite
            When rounding leaves no positive definite Laplacian.
        """
        return self.evaluate(self.bounded(self.parameterisation.invert(self.own_tensor(w))))

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
        """``xi`` itself, moduli clipped in place to where the rounded tensor is still positive definite."""
        clip_moduli(xi, self.parameterisation.bound)
        return xi


class Iterate:
    """A map, the tensors it belongs to, and what the objective is there.

    Parameters
    ----------
    objective : Objective
    field : TensorField
    w : (n,) complex128
        The quasi-harmonic map in the problem's frame.
    operator : FactoredLaplacian, optional
        Of ``field``; factored when it is asked for where it is not at hand.
    """

    def __init__(
        self, objective: Objective, field: TensorField, w: ComplexArray, operator: FactoredLaplacian | None = None
    ) -> None:
        self.objective = objective
        self.field = field
        self.w = w
        # The pattern keeps the last operator. Most iterates never need theirs again, and it is as large as they are.
        self._operator = None if operator is None else ref(operator)

    @property
    def operator(self) -> FactoredLaplacian:
        """The Laplacian of these tensors."""
        operator = None if self._operator is None else self._operator()
        if operator is None:
            operator = self.objective.operator(self.field)
            self._operator = ref(operator)
        return operator

    @property
    def xi(self) -> ComplexArray:
        """The variable (f,) complex128."""
        return self.field.xi

    @cached_property
    def dw(self) -> Derivatives:
        """Derivatives of the map and the images' signed areas."""
        return self.objective.mesh.derivatives(self.w)

    @cached_property
    def _sweep(self) -> _Sweep:
        """All that the descent of V₃ asks for, in one pass over the triangles."""
        everything = np.array([0, self.xi.size])
        sums, gradient = sweep(self.objective.mesh, self.field.parameterisation, self.xi, self.w, everything)
        inverted, energy, area, covered = sums[0].tolist()
        return _Sweep(int(inverted), energy, area if area > 0 else covered, gradient)

    @property
    def inverted(self) -> int:
        """Number of triangles whose image's area is not positive, in floating point."""
        return self._sweep.inverted

    @property
    def dirichlet(self) -> float:
        """V₃, whatever the objective's functional."""
        return self._sweep.dirichlet

    @property
    def dirichlet_gradient(self) -> ComplexArray:
        """The gradient of V₃ in ξ; (f,) complex128."""
        return self._sweep.gradient

    @cached_property
    def energy(self) -> float:
        """V₃ over the map's signed area (over the sum of unsigned areas where that is not positive)."""
        area = self._sweep.area
        return self.dirichlet / area if area > 0 else np.inf

    @cached_property
    def value(self) -> float:
        """The objective's value."""
        return self.objective.functional.value(self)

    @cached_property
    def gradient(self) -> ComplexArray:
        """Its gradient in ξ, ``∂/∂Re ξ + i ∂/∂Im ξ``; (f,) complex128."""
        return self.objective.functional.gradient(self)


class _Sweep(NamedTuple):
    inverted: int
    dirichlet: float
    area: float
    gradient: ComplexArray
