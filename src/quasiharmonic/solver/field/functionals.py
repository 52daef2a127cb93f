"""Functionals of the tensor field that lead to injective maps (§7.3).

============  =================================================  ======================
name          value, summed over u and v                         solves beyond (u, v)
============  =================================================  ======================
neumann       V₁ = ½ ‖L w − g‖²                                  1
sobolev       V₂ = ½ ‖L w − g‖² in the norm of L†                1, with another factor
dirichlet     V₃ = ½ wᴴ L w − area                               0
poisson       V₄ = ½ gᴴ L† g − area                              1, with another factor
edge-poisson  V₄ in Crouzeix–Raviart elements                    1, of three times the size
============  =================================================  ======================

Here ``L = Gᵀ A G``, ``w = u + i v`` is the quasi-harmonic map, and ``g = g_u + i g_v = −i D w`` are the Neumann data of
an injective map onto the target (eq. 17). ``V₂ = V₃ + V₄``.

Every derivative by A is a combination of ``½ d(xᴴ L y)/dA`` for two maps x, y on the mesh. From it follow the gradients
in the Beltrami coefficient μ and in ξ (`quasiharmonic.solver.field.tensor`).

V₁, V₂ and V₃ are non-negative, and zero exactly at the tensors of injective maps (Theorem 6.4).

V₄ is zero at the tensors of injective maps, and at other tensors too. It depends on the target only through ``C b``, so
it ignores interior pins and the relative position of boundary loops. Unlike its continuous counterpart, V₄ is not
bounded below by zero: linear elements raise a Dirichlet energy and lower its dual. V₄ may be negative at a rough tensor
field, so a descent may pass through zero at maps with inverted triangles. In Crouzeix–Raviart elements V₄ is
non-negative, because it equals V₃ except for pins and loop positions (`EdgePoisson`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from copy import copy
from typing import Protocol

import numpy as np

from quasiharmonic.geometry.mesh.reference import Derivatives, ReferenceMesh
from quasiharmonic.geometry.mesh.topology import edge_keys, find_sides, pair_keys
from quasiharmonic.linsolve.laplacian import FactoredLaplacian, Laplacian
from quasiharmonic.problem import Problem
from quasiharmonic.solver.field.tensor import TensorField
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, work


class Functional(ABC):
    """A functional V of the tensor field, for one problem and its `ReferenceMesh`."""

    name: str
    #: Whether the value is non-negative, and zero only for injective maps with pins and loops at their target
    #: positions.
    sees_positions = True

    def __init__(self, problem: Problem, mesh: ReferenceMesh) -> None:
        self.problem = problem
        self.mesh = mesh

    @abstractmethod
    def value(self, at: QuasiHarmonicMap) -> float:
        """Return V at a tensor field and its map, in units of area of the problem's frame.

        The unit of V₁ depends on the mesh.
        """

    @abstractmethod
    def gradient(self, at: QuasiHarmonicMap) -> ComplexArray:
        """Return the gradient of V in ξ, ``∂V/∂Re ξ + i ∂V/∂Im ξ``; the map depends on ξ through its tensors."""


class QuasiHarmonicMap(Protocol):
    """Quantities of a map that a functional uses.

    Attributes
    ----------
    field : TensorField
    operator : FactoredLaplacian
        Its Laplacian on the problem's free vertices.
    w : (n,) complex128
        The quasi-harmonic map of ``field``, in the problem's frame.
    dw : Derivatives
        Its derivatives.
    dirichlet : float
        Its V₃.
    dirichlet_gradient : (f,) complex128
        The gradient of V₃ in ξ.
    """

    @property
    def field(self) -> TensorField: ...
    @property
    def operator(self) -> FactoredLaplacian: ...
    @property
    def w(self) -> ComplexArray: ...
    @property
    def dw(self) -> Derivatives: ...
    @property
    def dirichlet(self) -> float: ...
    @property
    def dirichlet_gradient(self) -> ComplexArray: ...


class Dirichlet(Functional):
    """V₃, the weighted Dirichlet energy (eq. 27); the default.

    It is computed as the energy of the Beltrami residual, which avoids cancellation and is self-adjoint:

        V₃ = Σ 2m |q − μp|² / (1 − |μ|²),     dV₃/dμ = −4m (q − μp) (p̄ − μq̄) / (1 − |μ|²)²
    """

    name = "dirichlet"

    def value(self, at: QuasiHarmonicMap) -> float:
        return at.dirichlet

    def gradient(self, at: QuasiHarmonicMap) -> ComplexArray:
        return at.dirichlet_gradient


class Neumann(Functional):
    """V₁, the plain norm of the Neumann residual (eq. 24, 25).

    The residual includes the pins, where the flux of an injective map is zero.
    """

    name = "neumann"

    def value(self, at: QuasiHarmonicMap) -> float:
        residual = neumann_residual(self.problem, at.operator, at.w)
        return 0.5 * work(residual, residual)

    def gradient(self, at: QuasiHarmonicMap) -> ComplexArray:
        residual = neumann_residual(self.problem, at.operator, at.w)
        spread = self.mesh.derivatives(at.operator.extend(residual))
        return at.field.pull(at.field.pull_twist(*twist(self.mesh, at.dw, spread)))


class DualFunctional(Functional):
    """A functional that needs the solution with the target's Neumann data, one more solve for each tensor field."""

    sees_positions = False

    def __init__(self, problem: Problem, mesh: ReferenceMesh) -> None:
        super().__init__(problem, mesh)
        self._cached: tuple[TensorField, ComplexArray] | None = None
        self._one_fixed: Laplacian | None = None

    def response(self, at: QuasiHarmonicMap) -> ComplexArray:
        """Return ``L† g`` up to a constant, computed once for a tensor field."""
        # Return a local variable, because another thread may overwrite the cache at any time.
        cached = self._cached
        if cached is None or cached[0] is not at.field:
            cached = self._cached = at.field, self._respond(at)
        return cached[1]

    @abstractmethod
    def _respond(self, at: QuasiHarmonicMap) -> ComplexArray:
        """Compute `response`."""

    def _solve(
        self, at: QuasiHarmonicMap, F: IntArray, first: IntArray, stiffness: FloatArray, load: ComplexArray
    ) -> ComplexArray:
        """Solve on triangles F (f, 3), always the same, with their ``first`` unknown (1,) fixed."""
        if self._one_fixed is None:
            self._one_fixed = Laplacian(F, load.size, first, at.operator.laplacian.solver.name)
        return self._one_fixed.factor(stiffness).respond(load)


class Poisson(DualFunctional):
    """V₄, the Poisson functional (eq. 29, 44), dual to V₃.

    ``L†`` is applied by a solve with one fixed vertex: the kernel of L contains only constants, and the Neumann data
    sum to zero.
    """

    name = "poisson"

    def _respond(self, at: QuasiHarmonicMap) -> ComplexArray:
        """Compute the map with the target's Neumann data; (n,) complex128."""
        stiffness = self.mesh.edge_stiffness(at.field.entries())
        load = neumann_target(self.problem, at.w)
        return self._solve(at, self.problem.F, self.problem.fixed[:1], stiffness, load)

    def value(self, at: QuasiHarmonicMap) -> float:
        return 0.5 * work(neumann_target(self.problem, at.w), self.response(at) - at.w)

    def gradient(self, at: QuasiHarmonicMap) -> ComplexArray:
        d = self.mesh.derivatives(self.response(at))
        return -0.5 * at.field.pull(at.field.pull_twist(*twist(self.mesh, d, d)))


class EdgePoisson(DualFunctional):
    """V₄ in Crouzeix–Raviart elements: linear on each triangle, continuous at the midpoints of edges.

    On a disk, their discrete rotated gradients and the gradients of linear elements are orthogonal complements in the
    piecewise constant vector fields (Arnold and Falk 1989). The flux of the solution is therefore the rotated gradient
    of a linear element with the target's boundary. Because ``det 𝒜 = 1``, both have the same energy. The minima agree
    too. On a disk this functional is V₃ of the map without pins; with holes it is V₃ minimised over translations of
    each inner loop. Hence it is non-negative.
    """

    name = "edge-poisson"

    def __init__(self, problem: Problem, mesh: ReferenceMesh) -> None:
        super().__init__(problem, mesh)
        F, n = problem.F, problem.n
        ends, side = find_sides(F, n)
        #: Edge opposite to each corner, (f, 3).
        self._edges = side[:, (1, 2, 0)]
        self._tail, self._head = problem.domain.edges.boundary.T
        self._boundary_edges = np.searchsorted(pair_keys(ends, n), edge_keys(self._tail, self._head, n))
        # The same triangles with separate corners.
        self._separate_mesh = copy(mesh)
        self._separate_mesh.F = np.arange(F.size).reshape(-1, 3)
        self._separate_mesh.n = F.size

    def _respond(self, at: QuasiHarmonicMap) -> ComplexArray:
        """Compute the solution at the midpoints of edges; (e,) complex128, edges sorted by their ends."""
        # The basis function of an edge has −2 times the gradient of the opposite corner's hat function.
        stiffness = 4 * self.mesh.edge_stiffness(at.field.entries())
        load = np.zeros(int(self._edges.max()) + 1, dtype=np.complex128)
        load[self._boundary_edges] = self._neumann_target(at.w)
        return self._solve(at, self._edges, self._boundary_edges[:1], stiffness, load)

    def value(self, at: QuasiHarmonicMap) -> float:
        middle = 0.5 * (at.w[self._tail] + at.w[self._head])
        return 0.5 * work(self._neumann_target(at.w), self.response(at)[self._boundary_edges] - middle)

    def gradient(self, at: QuasiHarmonicMap) -> ComplexArray:
        middles = self.response(at)[self._edges]
        corners = middles.sum(axis=1, keepdims=True) - 2 * middles
        d = self._separate_mesh.derivatives(corners.ravel())
        return -0.5 * at.field.pull(at.field.pull_twist(*twist(self.mesh, d, d)))

    def _neumann_target(self, w: ComplexArray) -> ComplexArray:
        """Return the target's Neumann data per boundary edge; (k,) complex128."""
        return -1j * (w[self._head] - w[self._tail])


class Sobolev(Poisson):
    """V₂ = V₃ + V₄, the Neumann residual in the norm of L† (eq. 26).

    It is the energy of the difference between the maps with the Dirichlet and with the Neumann data.
    """

    name = "sobolev"
    sees_positions = True

    def value(self, at: QuasiHarmonicMap) -> float:
        residual = neumann_residual(self.problem, at.operator, at.w)
        return 0.5 * work(residual, at.w - self.response(at))

    def gradient(self, at: QuasiHarmonicMap) -> ComplexArray:
        return at.dirichlet_gradient + super().gradient(at)


FUNCTIONALS: dict[str, type[Functional]] = {c.name: c for c in (Neumann, Sobolev, Dirichlet, Poisson, EdgePoisson)}


def beltrami_gradient(mesh: ReferenceMesh, field: TensorField, dw: Derivatives) -> tuple[float, ComplexArray]:
    """Return V₃ of any map and its partial gradient in μ for the fixed map, ``−4m (q − μp) (p̄ − μq̄) / (1 − |μ|²)²``.

    V₃ is the map's A-Dirichlet energy minus its signed area, ``Σ 2m |q − μp|² / (1 − |μ|²)``, in the target's units of
    area (eq. 27). It is non-negative. At the quasi-harmonic map of the tensors the gradient is the total one. ``dw``
    are the derivatives of the map.
    """
    density, gradient = beltrami_terms(mesh.m, field, dw.p, dw.q)
    return 2.0 * float(density.sum()), gradient


def beltrami_terms(
    m: FloatArray, field: TensorField, p: ComplexArray, q: ComplexArray
) -> tuple[FloatArray, ComplexArray]:
    """Return half of each triangle's energy, (f,) float64, and the gradient of `beltrami_gradient`."""
    residual = q - field.mu * p
    weight = m / field.defect
    density = residual.real**2 + residual.imag**2
    density *= weight
    gradient = q.conj()
    gradient *= field.mu
    np.subtract(p.conj(), gradient, out=gradient)
    gradient *= residual
    weight /= field.defect
    weight *= -4.0
    gradient *= weight
    return density, gradient


def twist(mesh: ReferenceMesh, dx: Derivatives, dy: Derivatives) -> tuple[FloatArray, ComplexArray]:
    """Return the derivative of ``Re xᴴ L y`` by each triangle's tensor ``c·I − [[Re w, Im w], [Im w, −Re w]]``.

    It equals ``sp(Gx)ᵀ G y`` summed over both coordinates, expressed in c and w.

    Returns
    -------
    by_c : (f,) float64
    by_w : (f,) complex128
        ``∂/∂Re w + i ∂/∂Im w``.
    """
    by_c = 2.0 * mesh.m * (dx.p * dy.p.conj() + dx.q * dy.q.conj()).real
    by_w = -2.0 * mesh.m * (dx.p.conj() * dy.q + dy.p.conj() * dx.q)
    return by_c, by_w


def neumann_target(problem: Problem, w: ComplexArray) -> ComplexArray:
    """Return the target's Neumann data ``R (g_u + i g_v)`` with ``g_u = C b_v``, ``g_v = −C b_u`` (Theorem 6.4).

    Only the boundary values of the map w (n,) are used. The data (n,) are zero except at the boundary.
    """
    g = np.zeros(problem.n, dtype=np.complex128)
    for loop in problem.domain.loops:
        # The boundary values with the last before the first and the first after the last: much faster than np.roll.
        b = w[np.concatenate([loop[-1:], loop, loop[:1]])]
        g[loop] = -0.5j * (b[2:] - b[:-2])
    return g


def neumann_residual(problem: Problem, operator: FactoredLaplacian, w: ComplexArray) -> ComplexArray:
    """Return the Neumann residual ``L w − R g`` (n,) of a quasi-harmonic map w (eq. 24).

    It is zero except at fixed vertices.
    """
    # A boundary vertex is fixed, so both terms are zero at free vertices.
    return operator.flux(w) - neumann_target(problem, w)
