"""Untangling: Newton's method for the positions themselves, when a search over tensors has left triangles inverted.

The regularised energy of Garanzha et al. (2021),

    φ = (|p|² + |q|² + λ (D² + 1)) / χ(D),      D = |p|² − |q|²,      χ(D) = (D + √(ε² + D²)) / 2,

is finite for inverted triangles, and becomes a barrier against them as ε falls. A triangle or two against the
boundary with a millionth of a triangle's room are a small part of V₃, which hardly sees them; here they come to
outweigh all others.

Reference triangles are equilateral, their sides as long as the target's boundary edges near them to some power: with
1 a limb that shrinks is as good as one that does not, with 0 all triangles are to be alike. Either gets past what
stops the other.
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
from quasiharmonic.geometry.mesh.reference import ReferenceMesh
from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.linsolve.laplacian import Laplacian
from quasiharmonic.solver.field.objective import Iterate, Objective
from quasiharmonic.solver.methods.base import Iterates, VertexDescent
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, whole_number

# Powers of the boundary edges' lengths, tried in turn.
GRADINGS = 0.5, 0.0, 1.0
# Weight of areas against angles.
_LAMBDA = 1e-4
# The first ε, as a fraction of the least determinant; and what is done at each ε: so many steps, or as many as
# lower the energy by such a fraction.
_FIRST, _STEPS, _WORTHWHILE = 0.2, 20, 1e-3
# With ε this far below the least determinant hardly a triangle has ever been righted.
_HOPELESS = 5e-3
# Determinants below are those of triangles as small as positions are rounded; one of zero has no ε below it.
_FLAT = 1e-30
# From a map without inverted triangles: an ε so small that the energy is a barrier; and what a step is to bring.
_BARRIER, _NOTICEABLE = 1e-9, 1e-2
# Smallest reference triangle, relative to the largest, and of all: squared areas must stay within the numbers' range.
_SMALLEST, _LEAST = 1e-70, 1e-140
# Raised diagonals, one after the other until a factorisation exists.
_SHIFTS = 0.0, 1e-10, 1e-6, 1e-3
# How often a step is halved.
_HALVINGS = 24


class Regularised(Isotropic):
    """The energy above; ``φ`` in ``a = |p|²`` and ``b = |q|²``.

    Parameters
    ----------
    epsilon : float
        ε > 0: at a determinant of −ε and below, an inverted triangle is dear.
    """

    def __init__(self, epsilon: float) -> None:
        self.epsilon = epsilon

    def density(self, d: Deformation) -> FloatArray:
        """``N/χ`` with ``N = a + b + λ (D² + 1)``."""
        _, chi, numerator = self._parts(d)
        return numerator / chi

    def density_gradient(self, d: Deformation) -> tuple[FloatArray, FloatArray]:
        """``(1 ± G)/χ`` with ``G = 2λD − N/ρ``, since ``χ' = χ/ρ`` with ``ρ = √(ε² + D²)``."""
        root, chi, numerator = self._parts(d)
        by_det = 2 * _LAMBDA * d.det - numerator / root
        return (1 + by_det) / chi, (1 - by_det) / chi

    def density_hessian(self, d: Deformation) -> tuple[FloatArray, FloatArray, FloatArray]:
        """By ``S = a + b`` and D: ``φ_SD = −1/(χρ)``, ``φ_DD = 2λ (1 − 2D/ρ)/χ + 2N/ρ³``, and φ_SS = 0."""
        root, chi, numerator = self._parts(d)
        mixed = -1 / (chi * root)
        pure = 2 * _LAMBDA * (1 - 2 * d.det / root) / chi + 2 * numerator / root**3
        return pure + 2 * mixed, -pure, pure - 2 * mixed

    def _parts(self, d: Deformation) -> tuple[FloatArray, FloatArray, FloatArray]:
        root = np.hypot(self.epsilon, d.det)
        # D + ρ without cancellation.
        chi = np.where(d.det > 0, 0.5 * (d.det + root), 0.5 * self.epsilon**2 / (root + np.abs(d.det)))
        return root, chi, d.a + d.b + _LAMBDA * (d.det**2 + 1)


@dataclass(frozen=True, kw_only=True)
class Untangling(VertexDescent):
    """Right inverted triangles by moving all vertices.

    Attributes
    ----------
    iterations : int
        Steps to take at most, over all gradings.
    resume : bool
        Start from the map of the lowest V₃ so far.
    """

    iterations: int = 300

    word: ClassVar[str] = "untangling"

    def __post_init__(self) -> None:
        whole_number("iterations", self.iterations, least=1)

    def resumed(self, best_map: ComplexArray, lowest_energy: Iterate) -> ComplexArray:
        """All of the mesh is moved: what matters is how far it is from a map on the whole."""
        return lowest_energy.w

    def iterates(self, objective: Objective, start: Iterate) -> Iterates:
        """As of `Descent`."""
        problem, solver = objective.problem, objective.laplacian.solver.name
        left = self.iterations
        for grading in GRADINGS:
            for w in untangled(problem.F, start.w, problem.fixed, grading=grading, linear_solver=solver):
                yield objective.of_map(w)
                left -= 1
                if left <= 0:
                    return False
        return True


def untangled(
    F: IntArray,
    w: ComplexArray,
    held: IntArray,
    *,
    grading: float = 0.0,
    linear_solver: str = "auto",
    weights: FloatArray | None = None,
    rest: FloatArray | None = None,
) -> Iterator[ComplexArray]:
    """Newton steps down the regularised energy, ε falling.

    Parameters
    ----------
    F : (f, 3) int64
        Triangles; every vertex belongs to one.
    w : (n,) complex128
        A map.
    held : (k,) int64
        Vertices that stay.
    grading : float
        Power of the boundary edges' lengths.
    linear_solver : str
        A name of `quasiharmonic.linsolve`, or ``"auto"``.
    weights : (f,) float64, optional
        How much triangles count; all alike by default.
    rest : (n, 2) float64, optional
        Where the triangles have the shapes that they should have; equilateral ones by default. They may overlap then.

    Yields
    ------
    (n,) complex128
        The map after every step, until no triangle is inverted in floating point, or no more will be righted.
    """
    references = _even(F, w, grading, linear_solver) if rest is None else _References.at(rest, F)
    if references is None:
        return
    # Around what is computed, and not around a yield, which would carry the state to the caller.
    with np.errstate(all="ignore"):
        descent = RegularisedDescent(F, w, held, references, linear_solver, 1.0 if weights is None else weights)
    least = descent.least
    descent.energy.epsilon = np.hypot(1e-9, _FIRST * least)
    while not least > 0 and descent.energy.epsilon > _HOPELESS * max(abs(least), _FLAT):
        before = descent.value()
        for _ in range(_STEPS):
            with np.errstate(all="ignore"):
                after = descent.step(before)
            if after is None:
                break
            yield descent.w
            if descent.least > 0:
                return
            if after > (1 - _WORTHWHILE) * before:
                break
            before = after
        least = descent.least
        if not np.isfinite(least):
            return
        root = np.hypot(least, descent.energy.epsilon)
        descent.energy.epsilon *= 1 - 0.5 * root / (abs(least) + root)


def opened(
    F: IntArray, w: ComplexArray, held: IntArray, *, grading: float, linear_solver: str = "auto", steps: int = 10
) -> ComplexArray:
    """Newton steps from a map without inverted triangles towards one whose triangles are shaped and sized evenly.

    Parameters
    ----------
    F, w, held, grading, linear_solver
        As of `untangled`.
    steps : int
        At most; fewer where they no longer lower the energy noticeably.

    Returns
    -------
    (n,) complex128
        A map without inverted triangles, in floating point.
    """
    references = _even(F, w, grading, linear_solver)
    if references is None:
        return w
    with np.errstate(all="ignore"):
        descent = RegularisedDescent(F, w, held, references, linear_solver, 1.0)
        descent.energy.epsilon = _BARRIER
        before = descent.value()
        for _ in range(steps):
            after = descent.step(before)
            if after is None or not descent.least > 0:
                break
            w = descent.w
            if after > (1 - _NOTICEABLE) * before:
                break
            before = after
    return w


class _References(NamedTuple):
    """What triangles should look like.

    Attributes
    ----------
    corners : (f, 3, 2) float64
    areas : (f,) float64
        But for a factor that all have in common.
    """

    corners: FloatArray
    areas: FloatArray

    @classmethod
    def at(cls, rest: FloatArray, F: IntArray) -> _References:
        """Triangles as they are where vertices are at rest, (n, 2)."""
        return cls(rest[F], signed_areas(F, rest.view(np.complex128).ravel()))


def _even(F: IntArray, w: ComplexArray, grading: float, linear_solver: str) -> _References | None:
    """Equilateral triangles, or None where the map has no extent, or none whose square doubles hold.

    The logarithms of the boundary edges' lengths, carried inwards as by Tutte's embedding; in all, the references
    have the area of the map, inverted triangles counted as positive.
    """
    n = len(w)
    area = float(np.abs(signed_areas(F, w)).sum())
    rim = boundary_edges(F, n)
    length = np.abs(w[rim[:, 1]] - w[rim[:, 0]])
    if not (0 < area < np.inf and np.all(length > 0)):
        return None
    # At a boundary vertex the mean over the edges that leave it and arrive; one each, but where a patch is pinched.
    ends = np.bincount(rim.ravel(), minlength=n)
    log = np.zeros(n, dtype=np.complex128)
    log += np.bincount(rim.ravel(), np.repeat(np.log(length), 2), n) * (grading / np.maximum(ends, 1))
    if grading != 0:
        laplacian = Laplacian(F, n, np.flatnonzero(ends), linear_solver)
        unit = np.broadcast_to(np.array([[1.0], [0.0], [1.0]]), (3, len(F)))
        log = laplacian.factor(ReferenceMesh(np.zeros((n, 2)), F, "equilateral").edge_stiffness(unit)).extend(log)
    sizes: FloatArray = np.exp(log.real[F].mean(axis=1))
    # Of magnitude about one, so that no square underflows.
    sizes = np.ldexp(sizes, -int(np.frexp(sizes.max())[1]))
    sizes = np.maximum(sizes, _SMALLEST * sizes.max())
    sizes = sizes * np.sqrt(area / (np.sqrt(3) / 4 * (sizes**2).sum()))
    if not sizes.min() > _LEAST:
        return None
    corners = np.array([[0, 0], [1, 0], [0.5, np.sqrt(0.75)]])
    return _References(sizes[:, None, None] * corners, sizes**2)


class RegularisedDescent:
    """A map, and steps down its energy at the present ε."""

    def __init__(
        self,
        F: IntArray,
        w: ComplexArray,
        held: IntArray,
        references: _References,
        linear_solver: str,
        weights: FloatArray | float,
    ) -> None:
        self.energy = Regularised(1.0)
        rest = references.corners.reshape(-1, 2)
        # All triangles of one weight count alike, however small.
        weights = weights * references.areas.mean() / references.areas
        self._deformed = DeformationEnergy(
            rest, F, self.energy, weights=weights, rest_F=np.arange(3 * len(F)).reshape(-1, 3)
        )
        self._system = NewtonSystem(F, self._deformed.g, len(w), held, linear_solver)
        self.w = w
        self._at = self._deformed.deform(w)

    @property
    def least(self) -> float:
        """The least determinant."""
        return float(self._at.det.min())

    def value(self) -> float:
        """The energy."""
        with np.errstate(all="ignore"):
            return self._deformed.value_of(self._at)

    def step(self, before: float) -> float | None:
        """Take a step from where the energy is ``before``; the energy there, or None where no step lowers it."""
        system = self._system
        gradient = self._deformed.gradient_of(self._at, self.w.size)[system.free]
        system.assemble(self._deformed.curvature_of(self._at))
        found = system.descent(gradient, _SHIFTS)
        if found is None or not found[1] > 0:
            return None
        direction, expected_decrease, _ = found
        full = np.zeros_like(self.w)
        full[system.free] = direction
        start = self.w

        def trial(t: float, bound: float) -> tuple[float, tuple[ComplexArray, Deformation] | None]:
            w = start + t * full
            at = self._deformed.deform(w)
            value = self._deformed.value_of(at)
            return value, (w, at) if value < bound else None

        taken = backtrack(trial, before, expected_decrease, tries=_HALVINGS)
        if taken is None:
            return None
        _, after, (self.w, self._at) = extend(trial, taken)
        return after
