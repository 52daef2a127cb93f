"""A deformation energy with a second-order term: maps that are smooth where single vertices are pinned.

Under an energy of first derivatives alone a pinned vertex is a cusp: a point has no capacity, and the finer the mesh
the more of the way the triangles next to it take upon themselves. With second derivatives a point can be held: a thin
plate does not break where a pin lifts it. To the mean energy E of a planar map w on a domain Ω is added, for the
displacements ``u = w − z`` and a length ℓ::

    E(w)  +  (1/A) [ ℓ² ∫ |Δu|²  +  Σₖ ωₖ |wₖ − yₖ|² ]          A the area of Ω

with ``∫ |Δu|² = Σᵥ |(L u)ᵥ|² / mᵥ`` over the vertices inside, L the cotangent Laplacian and m the vertices' areas.
Where the boundary of a polygon stays that is the energy of a thin plate, ``∫ |∇²u|²``, with hinges for an edge [1]_.
Up to lengths of about ℓ the plate decides, beyond them E. The last sum pulls vertices to places, softly.

References
----------
.. [1] P. Grisvard, Singularities in boundary value problems (1992), section 2.1: the two integrals agree for
   displacements that vanish on the boundary of a polygon.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.sparse import csr_array, dia_array, kron, triu

from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import Energy, QuadraticForm
from quasiharmonic.energies.newton.newton_descent import NewtonDescent
from quasiharmonic.energies.newton.newton_system import NewtonSystem
from quasiharmonic.energies.polishing import at_own_scale, energy_named
from quasiharmonic.geometry.exact.certificate import certify, is_injective
from quasiharmonic.geometry.mesh.operators import operators
from quasiharmonic.linsolve import make_solver
from quasiharmonic.problem import Domain
from quasiharmonic.problem.result import MapResult, Stage, Status, Step
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray

_STEPS, _TOLERANCE = 200, 1e-6


@dataclass(frozen=True, eq=False)
class Pull:
    """Vertices pulled to places.

    Attributes
    ----------
    vertices : (k,) int64
    places : (k, 2) float64
    weights : (k,) float64
        ω: what missing by one length costs, in energy spread over one length squared.
    """

    vertices: IntArray
    places: FloatArray
    weights: FloatArray


class Plate:
    """The second-order term and the pulls, a quadratic function of where vertices are.

    Parameters
    ----------
    V : (n, 2) float64
        Rest positions.
    F : (f, 3) int64
    inside : (m,) int64
        Vertices at which the second derivatives count.
    length : float
        ℓ.
    pull : Pull
    """

    def __init__(self, V: FloatArray, F: IntArray, inside: IntArray, length: float, pull: Pull) -> None:
        n = len(V)
        laid = operators(V, F)
        L = laid.laplacian()[inside]
        corner_area = np.repeat(laid.m / 3, 3)
        mass = np.bincount(F.ravel(), corner_area, minlength=n)[inside]
        area = float(laid.m.sum())
        weight = np.bincount(pull.vertices, pull.weights, minlength=n) / area
        self.rest: ComplexArray = V.view(np.complex128).ravel()
        towards = np.zeros((n, 2))
        towards[pull.vertices] = pull.places
        self.bent: csr_array = csr_array(L.T @ (L * (length**2 / area / mass)[:, None]))
        self.weight, self.towards = weight, towards.view(np.complex128).ravel()

    def matrix(self) -> csr_array:
        """K (n, n) of the term's ``Re xᴴ K x`` in displacements x."""
        n = len(self.weight)
        pulls = dia_array((self.weight[None], [0]), shape=(n, n))
        return csr_array(self.bent + pulls)

    def value(self, w: ComplexArray) -> float:
        """The term for a map (n,) complex128."""
        u, away = w - self.rest, w - self.towards
        return float(np.vdot(u, self.bent @ u).real + np.sum(self.weight * np.abs(away) ** 2))

    def gradient(self, w: ComplexArray) -> ComplexArray:
        """Its derivative, ``∂/∂u + i ∂/∂v``; (n,) complex128."""
        return 2 * (self.bent @ (w - self.rest) + self.weight * (w - self.towards))


class PlateSystem(NewtonSystem):
    """The matrix of Newton's steps with a constant one added, whose pattern is wider.

    Parameters
    ----------
    F, g, n, fixed, linear_solver
        As of `NewtonSystem`.
    constant : (n, n) csr_array
        Symmetric; for either coordinate.
    """

    def __init__(
        self, F: IntArray, g: ComplexArray, n: int, fixed: IntArray, linear_solver: str, constant: csr_array
    ) -> None:
        super().__init__(F, g, n, fixed, linear_solver)
        own = csr_array((np.ones(self._indices.size), self._indices, self._indptr), shape=(2 * self.free.size,) * 2)
        added = triu(kron(constant[self.free][:, self.free], np.eye(2)), format="csr")
        # Which entries there are is a matter of ones, so that none cancels.
        pattern = csr_array(own + csr_array((np.ones(added.nnz), added.indices, added.indptr), shape=added.shape))
        pattern.sort_indices()
        self._own_slots, self._constant = _places(own, pattern), np.zeros(pattern.nnz)
        self._constant[_places(csr_array(added), pattern)] = added.data
        self._starts = pattern.indptr[:-1]
        self.solver = make_solver(pattern.indptr, pattern.indices, name=linear_solver)

    def assemble(self, form: QuadraticForm) -> None:
        """Add up the triangles' quadratic forms and the constant matrix."""
        super().assemble(form)
        self._diagonal = self._diagonal + self._constant[self._starts]

    def factor(self, shift: float = 0.0) -> None:
        """Factor the assembled matrix; see `NewtonSystem.factor`."""
        values = self._constant.copy()
        values[self._own_slots] += self._values
        diagonal = self._diagonal * (1 + shift)
        values[self._starts] = np.where(diagonal > 0, diagonal, 1)
        self.solver.factor(values)


class BendingDescent(NewtonDescent):
    """The descent of `NewtonDescent`, with a plate.

    Parameters
    ----------
    energy, uv, fixed, exponent, linear_solver
        As of `NewtonDescent`.
    plate : Plate
        For positions as they are, not in units.
    """

    def __init__(
        self,
        energy: DeformationEnergy,
        uv: FloatArray,
        fixed: IntArray,
        exponent: int,
        linear_solver: str,
        plate: Plate,
    ) -> None:
        self.plate, self._unit = plate, float(np.ldexp(1.0, exponent))
        super().__init__(energy, uv, fixed, exponent, linear_solver)
        self.value = self.first = self.value + plate.value(self._unit * self.w)

    def _system(self, n: int, linear_solver: str) -> NewtonSystem:
        constant = csr_array(2 * self._unit**2 * self.plate.matrix())
        return PlateSystem(self.energy.F, self.energy.g, n, self.fixed, linear_solver, constant)

    def gradient(self) -> ComplexArray:
        """That of the energy, and of the plate."""
        bent = self._unit * self.plate.gradient(self._unit * self.w)
        return super().gradient() + bent[self.system.free]

    def evaluate_trial(self, w: ComplexArray, bound: float) -> tuple[float, tuple[ComplexArray, Any] | None]:
        """As `NewtonDescent.evaluate_trial`, of the energy with the plate."""
        deformation = self.energy.deform(w)
        value = self.energy.value_of(deformation) + self.plate.value(self._unit * w)
        accepted = value < bound and is_injective(self.energy.F, self.positions(w))
        return value, (w, deformation) if accepted else None


def bend_map(
    domain: Domain,
    result: MapResult,
    *,
    energy: str | Energy,
    length: float,
    pull: Pull,
    linear_solver: str = "auto",
    callback: Callable[[Step], object] | None = None,
) -> MapResult:
    """Lower the energy with its second-order term; stages and history of the result are continued.

    Parameters
    ----------
    domain : Domain
        Planar; its fixed vertices stay.
    result : MapResult
        An injective map of it.
    energy : str or Energy
        As of `quasiharmonic.polish`.
    length : float
        ℓ, in the unit of the domain.
    pull : Pull
    linear_solver, callback
        As of `quasiharmonic.polish`.

    Returns
    -------
    MapResult
        With a status as of a polish; certified.
    """
    began = time.perf_counter()
    inside = np.ones(domain.n, dtype=bool)
    inside[np.concatenate(domain.loops)] = False
    plate = Plate(domain.V, domain.F, np.flatnonzero(inside), length, pull)
    history = [*result.history]
    status = Status.STILL_FALLING
    # As in a polish: a step to infinity or NaN is never accepted.
    with np.errstate(all="ignore"):
        deformation, exponent = at_own_scale(domain, result.uv, energy_named(energy))
        descent = BendingDescent(deformation, result.uv, domain.fixed, exponent, linear_solver, plate)
    try:
        for number, outcome in enumerate(descent.descend(_STEPS, _TOLERANCE), start=1):
            history.append(Step(number, 0, descent.value))
            if callback is not None:
                callback(history[-1])
            status = outcome or status
    except KeyboardInterrupt:
        status = Status.INTERRUPTED
    uv = descent.positions(descent.w)
    seconds = time.perf_counter() - began
    stage = Stage(
        name="bending",
        iterations=len(history) - len(result.history),
        seconds=seconds,
        inverted=(0, 0),
        energy=descent.energies,
        kept=descent.value < descent.first,
    )
    return replace(
        result,
        uv=uv,
        status=status,
        certificate=certify(domain.F, uv, loops=domain.loops),
        stages=[*result.stages, stage],
        history=history,
        linear_solver=descent.system.solver.name,
        seconds=result.seconds + seconds,
    )


def _places(part: csr_array, whole: csr_array) -> IntArray:
    """Where the entries of a matrix are among those of one whose pattern has them; rows sorted in both."""
    rows = [np.repeat(np.arange(one.shape[0]), np.diff(one.indptr)) for one in (part, whole)]
    keys = [row * whole.shape[1] + one.indices for row, one in zip(rows, (part, whole), strict=True)]
    return np.searchsorted(keys[1], keys[0]).astype(np.int64)
