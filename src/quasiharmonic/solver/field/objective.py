"""The function of ξ that is descended: one evaluation is one assembly, one factorisation, one solve."""

from __future__ import annotations

from copy import copy
from functools import cached_property
from typing import NamedTuple
from weakref import ref

import numpy as np

from quasiharmonic.geometry.mesh.reference import Derivatives, Reference, ReferenceMesh
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.linsolve.laplacian import FactoredLaplacian, Laplacian
from quasiharmonic.problem import Problem
from quasiharmonic.solver.field.functionals import FUNCTIONALS, Functional
from quasiharmonic.solver.field.passes import clip_moduli, stiffness_of, sweep
from quasiharmonic.solver.field.tensor import PARAMETERISATIONS, TANH, TensorField, own_tensor
from quasiharmonic.util.arrays import ComplexArray, FloatArray


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
        Reference triangles. A reference set in ``problem`` takes precedence.
    linear_solver : str
        A name of `quasiharmonic.linsolve`, or ``"auto"``.

    Attributes
    ----------
    problem, reference, mesh, laplacian, parameterisation, functional
        Constant. The mesh, the Laplacian and the functional are made on first use.
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
        self.reference = problem.reference or reference
        self.parameterisation = PARAMETERISATIONS[parameterisation]
        self._functional, self._linear_solver = functional, linear_solver

    @cached_property
    def mesh(self) -> ReferenceMesh:
        """The mesh with its reference triangles."""
        return self.problem.domain.mesh(self.reference)

    @cached_property
    def laplacian(self) -> Laplacian:
        """The Laplacian, analysed."""
        return self.problem.domain.laplacian(self._linear_solver)

    @cached_property
    def functional(self) -> Functional:
        """The functional of this problem."""
        return FUNCTIONALS[self._functional](self.problem, self.mesh)

    def descending(self, functional: Functional) -> Objective:
        """Return a copy with another functional, which must belong to this problem and mesh."""
        other = copy(self)
        other.functional = functional
        return other

    def evaluate(self, xi: ComplexArray) -> Iterate:
        """Compute the map of ``xi`` (f,) complex128.

        Raises
        ------
        quasiharmonic.linsolve.NotPositiveDefinite
            If the Laplacian is not positive definite after rounding.
        """
        field = self.parameterisation.field(xi)
        operator = self.operator(field)
        w = operator.extend(self.problem.fixed_positions)
        if not np.isfinite(w.view(np.float64)).all():
            raise NotPositiveDefinite("the solution is not finite")
        return Iterate(self, field, w, operator)

    def operator(self, field: TensorField) -> FactoredLaplacian:
        """Return the factored Laplacian of a tensor field."""
        return self.laplacian.factor(stiffness_of(self.mesh, field.parameterisation, field.xi))

    def own_tensor(self, w: ComplexArray) -> ComplexArray:
        """Return the μ of each triangle's own image, which minimises V₃ for the fixed map (eq. 39); (f,) complex128."""
        dw = self.mesh.derivatives(w)
        return own_tensor(dw.p, dw.q)

    def of_map(self, w: ComplexArray) -> Iterate:
        """Return a map at its own tensors; if the map is injective, it is their quasi-harmonic map.

        The tensors use the tanh parameterisation, which can represent all of them.
        """
        return Iterate(self, TANH.field(TANH.invert(self.own_tensor(w))), w)

    def near_map(self, w: ComplexArray) -> Iterate:
        """Return the quasi-harmonic map of a map's own tensors, clipped to the range of this parameterisation.

        Raises
        ------
        quasiharmonic.linsolve.NotPositiveDefinite
            If the Laplacian is not positive definite after rounding.
        """
        return self.evaluate(self.bounded(self.parameterisation.invert(self.own_tensor(w))))

    def step(self, start: Iterate, step: ComplexArray) -> Iterate:
        """Evaluate at ``ξ + step`` with clipped tensors; halve the step while no factorisation exists.

        Raises
        ------
        quasiharmonic.linsolve.NotPositiveDefinite
            If steps down to a thousandth of the given step fail.
        """
        for _ in range(10):
            try:
                return self.evaluate(self.bounded(start.xi + step))
            except NotPositiveDefinite:
                step = 0.5 * step
        return self.evaluate(self.bounded(start.xi + step))

    def bounded(self, xi: ComplexArray) -> ComplexArray:
        """Clip the moduli of ``xi`` in place so that the rounded tensors are positive definite, and return ``xi``."""
        clip_moduli(xi, self.parameterisation.bound)
        return xi


class Iterate:
    """A map w (n,) in the problem's frame, its tensors, and the objective's value and gradient there.

    The factored Laplacian of ``field`` and the sums over the triangles are computed on demand if they are not given.
    """

    def __init__(
        self,
        objective: Objective,
        field: TensorField,
        w: ComplexArray,
        operator: FactoredLaplacian | None = None,
        sums: Sums | None = None,
    ) -> None:
        self.objective = objective
        self.field = field
        self.w = w
        self._given_sums = sums
        # A weak reference: the pattern keeps the last operator. Most iterates do not need theirs again, and it is
        # large.
        self._operator = None if operator is None else ref(operator)

    @property
    def operator(self) -> FactoredLaplacian:
        """The factored Laplacian of these tensors."""
        operator = None if self._operator is None else self._operator()
        if operator is None:
            operator = self.objective.operator(self.field)
            self._operator = ref(operator)
        return operator

    @property
    def xi(self) -> ComplexArray:
        """The variable ξ; (f,) complex128."""
        return self.field.xi

    @cached_property
    def dw(self) -> Derivatives:
        """Derivatives of the map and signed areas of the image triangles."""
        return self.objective.mesh.derivatives(self.w)

    @cached_property
    def _sweep(self) -> tuple[Sums, ComplexArray]:
        """The sums and the gradient of V₃, computed in one pass over the triangles."""
        one_mesh = np.array([0, self.xi.size])
        sums, gradient = sweep(self.objective.mesh, self.field.parameterisation, self.xi, self.w, one_mesh)
        return sums_of(sums)[0], gradient

    @property
    def _sums(self) -> Sums:
        return self._given_sums or self._sweep[0]

    @property
    def inverted(self) -> int:
        """Number of triangles whose image does not have positive area, in floating point."""
        return self._sums.inverted

    @property
    def dirichlet(self) -> float:
        """V₃, independent of the objective's functional."""
        return self._sums.dirichlet

    @property
    def dirichlet_gradient(self) -> ComplexArray:
        """The gradient of V₃ in ξ; (f,) complex128."""
        return self._sweep[1]

    @cached_property
    def energy(self) -> float:
        """V₃ divided by the map's signed area, or by the sum of unsigned areas if that is not positive."""
        area = self._sums.area
        return self.dirichlet / area if area > 0 else np.inf

    @cached_property
    def value(self) -> float:
        """The objective's value."""
        return self.objective.functional.value(self)

    @cached_property
    def gradient(self) -> ComplexArray:
        """The objective's gradient in ξ, ``∂/∂Re ξ + i ∂/∂Im ξ``; (f,) complex128."""
        return self.objective.functional.gradient(self)


class Sums(NamedTuple):
    """Sums over the triangles of a map.

    Attributes
    ----------
    inverted : int
        Number of triangles whose image does not have positive area, in floating point.
    dirichlet : float
        V₃.
    area : float
        The map's signed area, or the sum of unsigned areas if that is not positive.
    """

    inverted: int
    dirichlet: float
    area: float


def sums_of(rows: FloatArray) -> list[Sums]:
    """Convert the sums (k, 4) of `sweep`."""
    return [
        Sums(int(inverted), energy, area if area > 0 else covered) for inverted, energy, area, covered in rows.tolist()
    ]
