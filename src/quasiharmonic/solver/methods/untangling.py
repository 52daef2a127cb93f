"""Untangling: Newton's method for the positions, if a search over tensors has left triangles inverted.

The regularised energy of Garanzha et al. (2021),

    φ = (|p|² + |q|² + λ (D² + 1)) / χ(D),      D = |p|² − |q|²,      χ(D) = (D + √(ε² + D²)) / 2,

is finite for inverted triangles and becomes a barrier against them as ε falls. A triangle at the boundary with a
millionth of a triangle's area hardly affects V₃, but it dominates this energy.

Reference triangles are equilateral, with sides proportional to a power of the lengths of nearby target boundary edges.
With power 1 a limb may shrink without cost; with power 0 all triangles tend to equal size. Either may succeed where the
other stalls.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from quasiharmonic.energies.deformation import DeformationEnergy, signed_areas
from quasiharmonic.energies.energies import Deformation, Isotropic
from quasiharmonic.energies.newton.line_search import backtrack, extend
from quasiharmonic.energies.newton.newton_system import NewtonSystem
from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.linsolve.laplacian import embed_tutte
from quasiharmonic.solver.field.objective import Iterate, Objective
from quasiharmonic.solver.methods.base import Iterates, VertexDescent
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, scale_to_unit, to_complex
from quasiharmonic.util.options import option, positive

# Powers of the boundary edges' lengths, tried in this order.
GRADINGS = 0.5, 0.0, 1.0


class UntanglingTuning(NamedTuple):
    """Numbers that tune untangling."""

    # Weight λ of areas relative to angles.
    area_weight: float = 1e-4
    # First ε, as a fraction of the absolute least determinant, and its least value, for determinants near zero.
    first_epsilon: float = 0.2
    least_first_epsilon: float = 1e-9
    # Maximum number of steps at each ε.
    steps: int = 20
    # Relative decrease of the energy below which ε is reduced.
    min_decrease: float = 1e-3
    # If ε falls below this fraction of the least determinant, hardly any triangle is untangled any more.
    min_epsilon: float = 5e-3
    # Smaller determinants belong to triangles as small as the rounding of positions. A determinant of zero would never
    # end the loop over ε.
    min_determinant: float = 1e-30
    # For `open_triangles`: an ε so small that the energy is a barrier.
    barrier_epsilon: float = 1e-9
    # For `open_triangles`: the maximum number of steps.
    opening_steps: int = 10
    # For `open_triangles`: the least relative decrease per step.
    min_opening_decrease: float = 1e-2
    # Smallest reference triangle relative to the largest.
    min_relative_size: float = 1e-70
    # Smallest reference triangle: squared areas must not underflow.
    min_size: float = 1e-140
    # Shifts of the diagonal, tried in this order until a factorisation exists.
    shifts: tuple[float, ...] = (0.0, 1e-10, 1e-6, 1e-3)
    # Maximum number of halvings of a step.
    halvings: int = 24


_TUNING = UntanglingTuning()


class Regularised(Isotropic):
    """The energy above; ``φ`` in ``a = |p|²`` and ``b = |q|²``.

    Inverted triangles with a determinant of −ε (``epsilon`` > 0) or below have a high energy.
    """

    def __init__(self, epsilon: float) -> None:
        self.epsilon = epsilon

    def density(self, d: Deformation) -> FloatArray:
        """Return ``N/χ`` with ``N = a + b + λ (D² + 1)``."""
        _, chi, numerator = self._parts(d)
        return numerator / chi

    def density_gradient(self, d: Deformation) -> tuple[FloatArray, FloatArray]:
        """Return ``(1 ± G)/χ`` with ``G = 2λD − N/ρ``, since ``χ' = χ/ρ`` with ``ρ = √(ε² + D²)``."""
        root, chi, numerator = self._parts(d)
        by_det = 2 * _TUNING.area_weight * d.det - numerator / root
        return (1 + by_det) / chi, (1 - by_det) / chi

    def density_hessian(self, d: Deformation) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the Hessian: ``φ_SD = −1/(χρ)``, ``φ_DD = 2λ (1 − 2D/ρ)/χ + 2N/ρ³``, φ_SS = 0 with ``S = a + b``."""
        root, chi, numerator = self._parts(d)
        mixed = -1 / (chi * root)
        pure = 2 * _TUNING.area_weight * (1 - 2 * d.det / root) / chi + 2 * numerator / root**3
        return pure + 2 * mixed, -pure, pure - 2 * mixed

    def _parts(self, d: Deformation) -> tuple[FloatArray, FloatArray, FloatArray]:
        root = np.hypot(self.epsilon, d.det)
        # D + ρ without cancellation.
        chi = np.where(d.det > 0, 0.5 * (d.det + root), 0.5 * self.epsilon**2 / (root + np.abs(d.det)))
        return root, chi, d.a + d.b + _TUNING.area_weight * (d.det**2 + 1)


@dataclass(frozen=True, kw_only=True)
class Untangling(VertexDescent):
    """Untangle inverted triangles by moving all vertices.

    Attributes
    ----------
    iterations : int
        Maximum number of steps over all gradings.
    resume : bool
        Start from the map of lowest V₃ so far.
    """

    iterations: int = option(300, check=positive)

    label: ClassVar[str] = "untangling"

    def select_start(self, best_map: ComplexArray, lowest_energy: Iterate) -> ComplexArray:
        """Return the map of lowest V₃: the whole mesh moves, so its overall closeness to a solution matters."""
        return lowest_energy.w

    def iterates(self, objective: Objective, start: Iterate) -> Iterates:
        """See `Descent`."""
        problem, solver = objective.problem, objective.laplacian.solver.name
        left = self.iterations
        for grading in GRADINGS:
            for w in untangle(problem.F, start.w, problem.fixed, grading=grading, linear_solver=solver):
                yield objective.of_map(w)
                left -= 1
                if left <= 0:
                    return False
        return True


def untangle(
    F: IntArray,
    w: ComplexArray,
    fixed: IntArray,
    *,
    grading: float = 0.0,
    linear_solver: str = "auto",
    weights: FloatArray | None = None,
    rest: FloatArray | None = None,
) -> Iterator[ComplexArray]:
    """Yield the maps of Newton steps down the regularised energy with falling ε.

    Parameters
    ----------
    F : (f, 3) int64
        Triangles; every vertex belongs to one.
    w : (n,) complex128
        Initial map.
    fixed : (k,) int64
    grading : float
        Power of the boundary edges' lengths.
    linear_solver : str
        A name of `quasiharmonic.linsolve`, or ``"auto"``.
    weights : (f,) float64, optional
        Weights of the triangles; equal by default.
    rest : (n, 2) float64, optional
        Positions at which the triangles have their reference shapes, which may overlap. Default: equilateral triangles.

    Yields
    ------
    (n,) complex128
        The map after every step, until no triangle is inverted in floating point or no further progress is expected.
    """
    references = _equilateral_references(F, w, grading, linear_solver) if rest is None else _References.at(rest, F)
    if references is None:
        return
    # Enclose only the computation: around a yield, the setting would affect the caller.
    with np.errstate(all="ignore"):
        descent = RegularisedDescent(F, w, fixed, references, linear_solver, 1.0 if weights is None else weights)
    min_det = descent.min_det
    descent.energy.epsilon = np.hypot(_TUNING.least_first_epsilon, _TUNING.first_epsilon * min_det)
    while not min_det > 0 and descent.energy.epsilon > _TUNING.min_epsilon * max(abs(min_det), _TUNING.min_determinant):
        before = descent.value()
        for _ in range(_TUNING.steps):
            with np.errstate(all="ignore"):
                after = descent.step(before)
            if after is None:
                break
            yield descent.w
            if descent.min_det > 0:
                return
            if after > (1 - _TUNING.min_decrease) * before:
                break
            before = after
        min_det = descent.min_det
        if not np.isfinite(min_det):
            return
        # The rule of Garanzha et al. with σ = 1/2: ε is halved if the least determinant is near zero, and falls by a
        # quarter if it is far below −ε.
        root = np.hypot(min_det, descent.energy.epsilon)
        descent.energy.epsilon *= 1 - 0.5 * root / (abs(min_det) + root)


def open_triangles(F: IntArray, w: ComplexArray, fixed: IntArray, *, grading: float) -> ComplexArray:
    """Take a few Newton steps from a map without inverted triangles towards triangles of even shape and size.

    See `untangle`. The steps end when they no longer lower the energy noticeably. The result has no inverted triangles
    in floating point.
    """
    references = _equilateral_references(F, w, grading, "auto")
    if references is None:
        return w
    with np.errstate(all="ignore"):
        descent = RegularisedDescent(F, w, fixed, references, "auto", 1.0)
        descent.energy.epsilon = _TUNING.barrier_epsilon
        before = descent.value()
        for _ in range(_TUNING.opening_steps):
            after = descent.step(before)
            if after is None or not descent.min_det > 0:
                break
            w = descent.w
            if after > (1 - _TUNING.min_opening_decrease) * before:
                break
            before = after
    return w


class _References(NamedTuple):
    """Corners (f, 3, 2) of reference triangles, and their areas (f,) up to a common factor."""

    corners: FloatArray
    areas: FloatArray

    @classmethod
    def at(cls, rest: FloatArray, F: IntArray) -> _References:
        """Return the triangles at the rest positions (n, 2)."""
        return cls(rest[F], signed_areas(F, to_complex(rest)))


def _equilateral_references(F: IntArray, w: ComplexArray, grading: float, linear_solver: str) -> _References | None:
    """Return equilateral reference triangles; None if the map has no extent or squares would underflow.

    The logarithms of the boundary edges' lengths are extended to the interior as in Tutte's embedding. The total area
    of the reference triangles equals the total unsigned area of the map.
    """
    n = len(w)
    area = float(np.abs(signed_areas(F, w)).sum())
    rim = boundary_edges(F, n)
    length = np.abs(w[rim[:, 1]] - w[rim[:, 0]])
    if not (0 < area < np.inf and np.all(length > 0)):
        return None
    # At a boundary vertex: the mean over its boundary edges; two edges, except where a patch is pinched.
    ends = np.bincount(rim.ravel(), minlength=n)
    log = np.zeros(n, dtype=np.complex128)
    log += np.bincount(rim.ravel(), np.repeat(np.log(length), 2), n) * (grading / np.maximum(ends, 1))
    if grading != 0:
        log = embed_tutte(F, log, np.flatnonzero(ends), linear_solver=linear_solver)
    sizes: FloatArray = np.exp(log.real[F].mean(axis=1))
    sizes = scale_to_unit(sizes)
    sizes = np.maximum(sizes, _TUNING.min_relative_size * sizes.max())
    sizes = sizes * np.sqrt(area / (np.sqrt(3) / 4 * (sizes**2).sum()))
    if not sizes.min() > _TUNING.min_size:
        return None
    corners = np.array([[0, 0], [1, 0], [0.5, np.sqrt(0.75)]])
    return _References(sizes[:, None, None] * corners, sizes**2)


class RegularisedDescent:
    """A map and Newton steps that lower its energy at the current ε."""

    def __init__(
        self,
        F: IntArray,
        w: ComplexArray,
        fixed: IntArray,
        references: _References,
        linear_solver: str,
        weights: FloatArray | float,
    ) -> None:
        self.energy = Regularised(1.0)
        rest = references.corners.reshape(-1, 2)
        # Triangles of equal weight contribute equally, whatever their size.
        weights = weights * references.areas.mean() / references.areas
        self._deformation_energy = DeformationEnergy(
            rest, F, self.energy, weights=weights, rest_F=np.arange(3 * len(F)).reshape(-1, 3)
        )
        self._system = NewtonSystem(F, self._deformation_energy.g, len(w), fixed, linear_solver)
        self.w = w
        self._deformation = self._deformation_energy.deform(w)

    @property
    def min_det(self) -> float:
        """Least determinant."""
        return float(self._deformation.det.min())

    def value(self) -> float:
        """Energy of the map."""
        with np.errstate(all="ignore"):
            return self._deformation_energy.value_of(self._deformation)

    def step(self, before: float) -> float | None:
        """Take a step from energy ``before``; return the new energy, or None if no step lowers it."""
        system = self._system
        gradient = self._deformation_energy.gradient_of(self._deformation, self.w.size)[system.free]
        system.assemble(self._deformation_energy.curvature_of(self._deformation))
        found = system.descent(gradient, _TUNING.shifts)
        if found is None or not found[1] > 0:
            return None
        direction, expected_decrease, _ = found
        full = np.zeros_like(self.w)
        full[system.free] = direction
        start = self.w

        def evaluate_step(t: float, bound: float) -> tuple[float, tuple[ComplexArray, Deformation] | None]:
            w = start + t * full
            at = self._deformation_energy.deform(w)
            value = self._deformation_energy.value_of(at)
            return value, (w, at) if value < bound else None

        taken = backtrack(evaluate_step, before, expected_decrease, tries=_TUNING.halvings)
        if taken is None:
            return None
        _, after, (self.w, self._deformation) = extend(evaluate_step, taken)
        return after
