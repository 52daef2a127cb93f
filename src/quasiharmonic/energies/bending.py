"""A deformation energy with a second-order term, whose minimisers are smooth at pinned vertices.

Under an energy of first derivatives only, a pinned vertex becomes a cusp, because a point has no capacity. On finer
meshes more of the displacement concentrates in the triangles next to it. A term of second derivatives, as in a thin
plate, keeps the displacement smooth at a pin. For a planar map w on a domain Ω with displacements ``u = w − z`` and a
length ℓ, the term is added to the mean energy E::

    E(w)  +  (1/A) [ ℓ² ∫ |Δu|²  +  Σₖ ωₖ |wₖ − yₖ|² ]          A the area of Ω

Here ``∫ |Δu|² = Σᵥ |(L u)ᵥ|² / mᵥ`` over the interior vertices, with the cotangent Laplacian L and the vertex areas m.
If the boundary of a polygon is fixed, this is the energy of a hinged thin plate, ``∫ |∇²u|²`` [1]_. The plate term
dominates up to lengths of about ℓ, E beyond. The last sum softly pulls vertices to target positions.

References
----------
.. [1] P. Grisvard, Singularities in boundary value problems (1992), section 2.1: the two integrals agree for
   displacements that vanish on the boundary of a polygon.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array, dia_array, kron, triu

from quasiharmonic.energies.energies import Energy, QuadraticForm
from quasiharmonic.energies.newton.map_model import Coordinates, MapModel, in_units
from quasiharmonic.energies.newton.newton_descent import NewtonDescent
from quasiharmonic.energies.newton.newton_system import NewtonSystem
from quasiharmonic.energies.polishing import find_energy, scale_energy
from quasiharmonic.geometry.mesh.reference import operators
from quasiharmonic.linsolve import make_solver
from quasiharmonic.problem import Domain
from quasiharmonic.problem.result import MapResult, Status
from quasiharmonic.problem.run import Run
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, list_others, repeat_each, to_complex


@dataclass(frozen=True, eq=False)
class Pull:
    """Vertices that are pulled to target positions.

    Attributes
    ----------
    vertices : (k,) int64
    positions : (k, 2) float64
        Target positions.
    weights : (k,) float64
        ω: a deviation d costs as much as an energy density ω on an area |d|².
    """

    vertices: IntArray
    positions: FloatArray
    weights: FloatArray


class Plate:
    """The second-order term and the pulls: a quadratic `Term` for maps in multiples of ``unit``.

    ``V`` (n, 2) are the rest positions. The second derivatives are evaluated at the vertices ``inside`` (m,).
    ``length`` is ℓ.
    """

    def __init__(self, V: FloatArray, F: IntArray, inside: IntArray, length: float, pull: Pull, unit: float) -> None:
        n = len(V)
        rest_operators = operators(V, F)
        L = rest_operators.laplacian()[inside]
        corner_area = np.repeat(rest_operators.m / 3, 3)
        mass = np.bincount(F.ravel(), corner_area, minlength=n)[inside]
        area = float(rest_operators.m.sum())
        weight = np.bincount(pull.vertices, pull.weights, minlength=n) / area
        self.rest: ComplexArray = to_complex(V)
        towards = np.zeros((n, 2))
        towards[pull.vertices] = pull.positions
        self.second_order: csr_array = csr_array(L.T @ (L * (length**2 / area / mass)[:, None]))
        self.weight, self.towards, self.unit = weight, to_complex(towards), unit

    def matrix(self) -> csr_array:
        """Matrix K (n, n) of the quadratic form ``Re xᴴ K x`` in displacements x."""
        n = len(self.weight)
        pulls = dia_array((self.weight[None], [0]), shape=(n, n))
        return csr_array(self.second_order + pulls)

    def value(self, w: ComplexArray) -> float:
        """See `Term`."""
        u, deviation = self.unit * w - self.rest, self.unit * w - self.towards
        return float(np.vdot(u, self.second_order @ u).real + np.sum(self.weight * np.abs(deviation) ** 2))

    def gradient(self, w: ComplexArray) -> ComplexArray:
        """See `Term`."""
        u, deviation = self.unit * w - self.rest, self.unit * w - self.towards
        return self.unit * (2 * (self.second_order @ u + self.weight * deviation))

    def add_to(self, system: NewtonSystem, w: ComplexArray) -> None:
        """See `Term`; nothing, because `PlateSystem` contains the constant matrix."""


class PlateSystem(NewtonSystem):
    """Newton system with an added symmetric matrix (n, n) for each coordinate, and with its larger sparsity pattern."""

    def __init__(self, F: IntArray, g: ComplexArray, n: int, fixed: IntArray, constant: csr_array) -> None:
        super().__init__(F, g, n, fixed)
        own = csr_array((np.ones(self._indices.size), self._indices, self._indptr), shape=(2 * self.free.size,) * 2)
        added = triu(kron(constant[self.free][:, self.free], np.eye(2)), format="csr")
        # Compute the pattern with ones as values, so that no entries cancel.
        pattern = csr_array(own + csr_array((np.ones(added.nnz), added.indices, added.indptr), shape=added.shape))
        pattern.sort_indices()
        self._own_slots, self._constant = _entry_indices(own, pattern), np.zeros(pattern.nnz)
        self._constant[_entry_indices(csr_array(added), pattern)] = added.data
        self._starts = pattern.indptr[:-1]
        self.solver = make_solver(pattern.indptr, pattern.indices)

    def assemble(self, form: QuadraticForm) -> None:
        """Add up the triangles' quadratic forms and the constant matrix."""
        super().assemble(form)
        self.diagonal = self.diagonal + self._constant[self._starts]

    def factor(self, shift: float = 0.0) -> None:
        """Factor the assembled matrix; see `NewtonSystem.factor`."""
        values = self._constant.copy()
        values[self._own_slots] += self._values
        diagonal = self.diagonal * (1 + shift)
        values[self._starts] = np.where(diagonal > 0, diagonal, 1)
        self.solver.factor(values)


def bend_map(
    domain: Domain,
    result: MapResult,
    *,
    energy: str | Energy,
    length: float,
    pull: Pull,
) -> MapResult:
    """Lower the energy of an injective map with its second-order term; append to the stages and history of its result.

    The domain is planar, and ``length`` is ℓ in its unit. The status is one of `quasiharmonic.polish`.
    """
    # The descent converges below this relative decrease, and ends after this number of steps.
    tolerance = 1e-6
    max_steps = 200
    run = Run()
    inside = list_others(domain.n, np.concatenate(domain.loops))
    # As in `polish`, steps to inf or NaN are never accepted.
    with np.errstate(all="ignore"):
        deformation, exponent = scale_energy(domain, result.uv, find_energy(energy))
        unit = float(np.ldexp(1.0, exponent))
        plate = Plate(domain.V, domain.F, inside, length, pull, unit)
        constant = csr_array(2 * unit**2 * plate.matrix())
        system = PlateSystem(deformation.F, deformation.g, domain.n, domain.fixed, constant)
        coordinates = Coordinates.of(result.uv, domain.fixed, exponent)
        model = MapModel(deformation, coordinates, system, [plate])
        descent = NewtonDescent(model, model.evaluate(in_units(result.uv, exponent)))
    status = Status.INTERRUPTED
    with run.until_interrupted():
        status = run.descend("bending", descent.descend(max_steps, tolerance), lambda: descent.value)
    run.judge_last_stage(kept=descent.value < descent.first)
    uv = model.positions(descent.w)
    solver = system.solver.name
    return run.result(uv, domain.F, status, loops=domain.loops, linear_solver=solver, V=domain.V).after(result)


def _entry_indices(part: csr_array, whole: csr_array) -> IntArray:
    """Indices of the entries of ``part`` in ``whole``, whose pattern contains them; rows are sorted in both."""
    rows = [repeat_each(np.arange(one.shape[0]), np.diff(one.indptr)) for one in (part, whole)]
    keys = [row * whole.shape[1] + one.indices for row, one in zip(rows, (part, whole), strict=True)]
    return np.searchsorted(keys[1], keys[0]).astype(np.int64)
