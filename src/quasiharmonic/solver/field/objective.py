"""The function of ξ that is descended: one evaluation is one assembly, one factorisation, one solve.

There is one pass over all triangles before the solve and one after it:

    ξ ──eq. 33──▶ 𝒜 ──▶ edge stiffness        before
    ξ, w ──▶ areas, V₃, dV₃/dξ                after

For 1,000 triangles the number of array operations determines the time of an evaluation. For 10,000 triangles the
number of passes through memory does. The passes are therefore compiled.
"""

from __future__ import annotations

from copy import copy
from functools import cached_property
from typing import NamedTuple
from weakref import ref

import numpy as np

from quasiharmonic.geometry.mesh.reference import Derivatives, Reference, ReferenceMesh, blocks, wirtinger
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.linsolve.laplacian import FactoredLaplacian, Laplacian
from quasiharmonic.problem import Problem
from quasiharmonic.solver.field.functionals import FUNCTIONALS, Functional, beltrami_terms
from quasiharmonic.solver.field.tensor import (
    PARAMETERISATIONS,
    TANH,
    Parameterisation,
    TensorField,
    own_tensor,
    parameterisation_of,
)
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, as_offsets
from quasiharmonic.util.kernels import compiled


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

    def with_functional(self, functional: Functional) -> Objective:
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
        return self.evaluate(self.clip_xi(self.parameterisation.invert(self.own_tensor(w))))

    def step(self, start: Iterate, step: ComplexArray) -> Iterate:
        """Evaluate at ``ξ + step`` with clipped tensors; halve the step while no factorisation exists.

        Raises
        ------
        quasiharmonic.linsolve.NotPositiveDefinite
            If steps down to a thousandth of the given step fail.
        """
        for _ in range(10):
            try:
                return self.evaluate(self.clip_xi(start.xi + step))
            except NotPositiveDefinite:
                step = 0.5 * step
        return self.evaluate(self.clip_xi(start.xi + step))

    def clip_xi(self, xi: ComplexArray) -> ComplexArray:
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


def stiffness_of(mesh: ReferenceMesh, parameterisation: Parameterisation, xi: ComplexArray) -> FloatArray:
    """Compute the edge stiffness (3, f) of the tensors of ξ; see `ReferenceMesh.edge_stiffness`."""
    stiffness = np.empty((3, xi.size))
    fill_stiffness(xi, parameterisation.number, mesh.stiffness_by_entry, stiffness)
    return stiffness


def sweep(
    mesh: ReferenceMesh, parameterisation: Parameterisation, xi: ComplexArray, w: ComplexArray, starts: IntArray
) -> tuple[FloatArray, ComplexArray]:
    """Compute the quantities that the descent of V₃ needs, for one mesh or several meshes in a batch.

    Parameters
    ----------
    mesh, parameterisation, xi, w
        ``w`` (n,) is the quasi-harmonic map of ``xi`` (f,).
    starts : (k + 1,) int64
        Index of the first triangle of each mesh, and the total number of triangles. Every mesh has triangles.

    Returns
    -------
    sums : (k, 4) float64
        Per mesh: the number of triangles whose image does not have positive area in floating point, V₃, the map's
        signed area, and the sum of unsigned areas.
    gradient : (f,) complex128
        The gradient of V₃ in ξ.
    """
    sums, gradient = np.empty((len(starts) - 1, 4)), np.empty(xi.size, dtype=np.complex128)
    dirichlet_sweep(
        w, np.ascontiguousarray(mesh.F), mesh.half_gamma, mesh.m, xi, parameterisation.number, starts, gradient, sums
    )
    return sums, gradient


def own_sweep(mesh: ReferenceMesh, w: ComplexArray, starts: IntArray) -> tuple[FloatArray, ComplexArray]:
    """Compute V₃ of one or several maps at their own tensors, clipped to the range of tanh; see `sweep`.

    Returns
    -------
    sums : (k, 2) float64
        Per mesh: V₃ and the map's signed area.
    mu : (f,) complex128
        The Beltrami coefficients of these tensors.
    """
    sums, mu = np.empty((len(starts) - 1, 2)), np.empty(len(mesh.F), dtype=np.complex128)
    at_own_tensors(w, np.ascontiguousarray(mesh.F), mesh.half_gamma, mesh.m, starts, mu, sums)
    return sums, mu


@compiled
def fill_stiffness(xi: ComplexArray, number: int, by_entry: FloatArray, stiffness: FloatArray) -> None:
    """Fill in the edge stiffness (3, f); ``by_entry`` (9, f) has its derivatives by the tensor's entries."""
    for part in blocks(xi.size):
        entries = parameterisation_of(number).field(xi[part]).entries()
        np.einsum("eaf,af->ef", by_entry[:, part].reshape(3, 3, -1), entries, out=stiffness[:, part])


@compiled
def dirichlet_sweep(
    w: ComplexArray,
    F: IntArray,
    half_gamma: ComplexArray,
    m: FloatArray,
    xi: ComplexArray,
    number: int,
    starts: IntArray,
    gradient: ComplexArray,
    sums: FloatArray,
) -> None:
    """Fill in the gradient and the sums of `sweep`; ``half_gamma`` (2, f) belongs to the last two corners."""
    f = xi.size
    density, area = np.empty(f), np.empty(f)
    for part in blocks(f):
        p, q = np.empty_like(xi[part]), np.empty_like(xi[part])
        wirtinger(w, F[part], half_gamma[:, part], p, q, area[part])
        field = parameterisation_of(number).field(xi[part])
        density[part], in_mu = beltrami_terms(m[part], field, p, q)
        gradient[part] = field.pull(in_mu)
    # A NaN area does not count as positive.
    for column, values in enumerate((~(area > 0), 2.0 * density, area, np.abs(area))):
        sums[:, column] = np.add.reduceat(values, as_offsets(starts[:-1]), dtype=np.float64)


@compiled
def at_own_tensors(
    w: ComplexArray,
    F: IntArray,
    half_gamma: ComplexArray,
    m: FloatArray,
    starts: IntArray,
    mu: ComplexArray,
    sums: FloatArray,
) -> None:
    """Fill in the results of `own_sweep`; ``half_gamma`` (2, f) belongs to the last two corners."""
    f = mu.size
    density, area = np.empty(f), np.empty(f)
    for part in blocks(f):
        p, q = np.empty_like(mu[part]), np.empty_like(mu[part])
        wirtinger(w, F[part], half_gamma[:, part], p, q, area[part])
        field = TANH.field(TANH.invert(own_tensor(p, q)))
        density[part], mu[part] = beltrami_terms(m[part], field, p, q)[0], field.mu
    for column, values in enumerate((2.0 * density, area)):
        sums[:, column] = np.add.reduceat(values, as_offsets(starts[:-1]))


@compiled
def clip_moduli(xi: ComplexArray, bound: float) -> None:
    """Clip the moduli of ``xi`` to ``bound`` in place."""
    for part in blocks(xi.size):
        block = xi[part]
        square = block.real**2 + block.imag**2
        far = np.flatnonzero(square > bound**2)
        block[far] *= bound / np.sqrt(square[far])
