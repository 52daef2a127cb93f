"""Flat maps that keep distances: Newton steps on the distance energy among bijective maps.

A pair of distant vertices couples vertices that share no triangle, so the factors of a matrix with all pairs would have
much fill. Each vertex has pairs in all directions, so the diagonal blocks of the pairs are a good approximation. Write
``H = M + (P − D)``: P is the pairs' matrix, D its diagonal blocks, and M the triangles' matrix plus D. Conjugate
gradients with the factors of M as preconditioner give Newton's direction in about a dozen iterations. Products with M
need no work, as they are the residuals before preconditioning.

The energy is the mean error of the pairs' distances in the plane, relative to those along the surface, plus a small
multiple of a barrier. The barrier keeps every triangle positive and the map smooth between the pairs::

    E(w) = mean √(r² + δ²) − δ  +  λ B(w),    r = |wᵢ − wⱼ| / dᵢⱼ − 1

Errors well above δ count linearly and not quadratically. Otherwise the few pairs that no map can keep, on both sides of
a fold or around the end of a cut, would dominate. Newton's model of a pair keeps the positive second derivatives. Along
the pair, the second derivative is ``δ² (r² + δ²)^(−3/2) / d²``. Perpendicular to the pair, it is
``r (r² + δ²)^(−1/2) / (d |w|)`` if the pair is too long, otherwise 0.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from typing import NamedTuple, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array

from quasiharmonic.apps.flattening.contacts import Rim
from quasiharmonic.apps.flattening.piece import Piece, to_given_unit
from quasiharmonic.apps.flattening.surface_descent import SurfaceDescent, descend
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.distances import Sampling, SurfaceDistances, sample_distances
from quasiharmonic.energies.energies import Deformation, QuadraticForm, SymmetricDirichlet
from quasiharmonic.energies.newton.newton_system import NewtonSystem
from quasiharmonic.geometry.exact.certificate import certify
from quasiharmonic.io.accepts_mesh import accepts_mesh
from quasiharmonic.problem.result import MapResult, Status, Step
from quasiharmonic.problem.run import Run
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, map_array, to_complex, to_points
from quasiharmonic.util.options import DistanceOptions, takes
from quasiharmonic.util.progress import reports_progress


class DistanceTuning(NamedTuple):
    """Numbers that tune the descent of the distance error."""

    # Errors below this (δ) count quadratically, larger ones linearly. On a cortex, 0.1 gives a 3 % lower mean error and
    # an 11 % higher root mean square error.
    softening: float = 0.3
    # Weight of the barrier (λ). A third or three times the weight changes the error by 0.002 of the distances.
    barrier_weight: float = 3e-3
    # Number of pairs. On a cortex of 9,465 vertices, twice as many lower the error by 1 %, and half as many raise it by
    # 1 %.
    pairs: int = 300_000
    # Maximum number of edges that a segment crosses.
    crossings: int = 3
    # Number of sources times the squared rings, because the cost of the distances from a source grows with the square.
    work: int = 1_000_000
    # Minimum number of sources.
    min_sources: int = 1000
    # Maximum number of sources.
    max_sources: int = 4000
    # Conjugate gradients stop at this reduction of the residual.
    residual: float = 0.1
    # Maximum number of iterations of conjugate gradients.
    max_gradients: int = 20


_TUNING = DistanceTuning()


class _DistanceValues(NamedTuple):
    """The evaluation of a map by the energy."""

    deformation: Deformation
    #: Vectors from targets to sources, (k,) complex128.
    apart: ComplexArray
    #: Relative errors ``|apart| / length − 1``, (k,) float64.
    off: FloatArray


@dataclass(frozen=True, eq=False)
class PairForm:
    """A quadratic form in the displacements of the pairs, ``Σ ½ (c |dv|² + Re c̄₂ dv²)`` with ``dv = dwᵢ − dwⱼ``.

    ``c`` (k,) is float64 and ``c2`` (k,) complex128; ``energy`` defines the pairs.
    """

    c: FloatArray
    c2: ComplexArray
    energy: DistanceEnergy

    @cached_property
    def diagonal(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The diagonal blocks xx, xy and yy of the matrix at every vertex; (n,) float64 each."""
        c, real, imag = self.energy.sum_at_vertices(np.stack([self.c, self.c2.real, self.c2.imag], axis=1)).T
        return c + real, imag, c - real

    def apply(self, dw: ComplexArray) -> ComplexArray:
        """Return the form's matrix times a displacement (n,) complex128."""
        dv = self.energy.differences(dw)
        return self.energy.gather(self.c * dv + self.c2 * dv.conj())

    def apply_off_diagonal(self, dw: ComplexArray) -> ComplexArray:
        """Return the matrix without its diagonal blocks times a displacement (n,) complex128."""
        xx, xy, yy = self.diagonal
        return self.apply(dw) - (xx * dw.real + xy * dw.imag + 1j * (xy * dw.real + yy * dw.imag))


class DistanceEnergy:
    """The energy of the distances on a surface of ``n`` vertices, for `NewtonDescent`.

    Second derivatives have two parts, `curvature_of` on the triangles and `pairs_at` on the pairs. ``barrier`` is an
    energy of the same surface in the same unit that is infinite if a triangle collapses.
    """

    def __init__(self, distances: SurfaceDistances, barrier: DeformationEnergy, n: int) -> None:
        self.barrier, self.n = barrier, n
        self.F, self.g = barrier.F, barrier.g
        self._source, self._target, self._length = distances.source, distances.target, distances.length
        k = distances.length.size
        ends, ones = np.concatenate([self._source, self._target]), np.ones(k)
        at = ends, np.tile(np.arange(k), 2)
        self._pull = csr_array((np.concatenate([ones, -ones]), at), shape=(n, k))
        self._share = abs(self._pull)

    def differences(self, w: ComplexArray) -> ComplexArray:
        """Return the vectors (k,) from targets to sources, for vertices (n,)."""
        return np.asarray(w.take(self._source) - w.take(self._target))

    def gather(self, pull: ComplexArray) -> ComplexArray:
        """Sum at every vertex (n,) the forces (k,) of its pairs, with opposite signs for sources and targets."""
        return to_complex(self._pull @ to_points(pull))

    def sum_at_vertices(self, values: FloatArray) -> FloatArray:
        """Sum at every vertex, (n, c), the values of its pairs, (k, c)."""
        return np.asarray(self._share @ values)

    def deform(self, w: ComplexArray) -> _DistanceValues:
        """Evaluate the quantities of a map that the other methods need."""
        apart = self.differences(w)
        return _DistanceValues(self.barrier.deform(w), apart, np.abs(apart) / self._length - 1)

    def value_of(self, evaluation: _DistanceValues) -> float:
        """The mean softened error plus the weighted barrier."""
        error = float(np.mean(np.hypot(evaluation.off, _TUNING.softening))) - _TUNING.softening
        return error + _TUNING.barrier_weight * self.barrier.value_of(evaluation.deformation)

    def gradient_of(self, evaluation: _DistanceValues, n: int) -> ComplexArray:
        """The derivative with respect to ``n`` positions; (n,) complex128."""
        slope = evaluation.off / np.hypot(evaluation.off, _TUNING.softening) / (self._length * evaluation.off.size)
        pull = slope * evaluation.apart / np.abs(evaluation.apart)
        return self.gather(pull) + _TUNING.barrier_weight * self.barrier.gradient_of(evaluation.deformation, n)

    def curvature_of(self, evaluation: _DistanceValues, *, negative: float = 0.0) -> QuadraticForm:
        """Second derivatives of the weighted barrier on the triangles."""
        form = self.barrier.curvature_of(evaluation.deformation, negative=negative)
        return form.scaled(np.full(len(self.F), _TUNING.barrier_weight))

    def pairs_at(self, w: ComplexArray) -> PairForm:
        """Second derivatives of the error at a map, without their negative parts."""
        apart = self.differences(w)
        distance = np.abs(apart)
        off = distance / self._length - 1
        soft = np.hypot(off, _TUNING.softening)
        along = _TUNING.softening**2 / soft**3 / (self._length**2 * soft.size)
        across = np.maximum(off / soft, 0) / (self._length * distance * soft.size)
        direction = apart / distance
        return PairForm(0.5 * (along + across), 0.5 * (along - across) * direction**2, self)

    def steps_to_collapse(self, w: ComplexArray, direction: ComplexArray) -> FloatArray:
        """The step along a direction at which each triangle first becomes degenerate."""
        return self.barrier.steps_to_collapse(w, direction)


class DistanceKeywords(TypedDict, total=False):
    """Types of the options of `keep_distances`."""

    rings: int
    max_iterations: int
    tol: float
    linear_solver: str
    callback: Callable[[Step], object] | None
    record_every: int


@accepts_mesh
@reports_progress
@takes(DistanceOptions, DistanceKeywords)
def keep_distances(V: ArrayLike, F: ArrayLike, uv: ArrayLike, **options: Unpack[DistanceKeywords]) -> MapResult:
    """Lower the error of distances in a bijective map; all maps on the way are bijective.

    The objective is a mean over a sample of vertex pairs at most ``rings`` edges apart. It is the distance error of
    `quasiharmonic.distortion`, except that errors below 30 % count quadratically. A small multiple of the symmetric
    Dirichlet energy keeps triangles from collapsing. With 20 rings, the sample has 2,500 vertices, or all if there are
    fewer, with 120 others each. Fewer rings use up to 4,000 vertices, and more rings down to 1,000; there are at
    most 300,000 pairs in all. The sample is random but deterministic.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Rest positions.
    F : (f, 3) array of int
        Triangles of a connected surface with at least one boundary loop and without handles.
    uv : (n, 2) array
        A bijective map of any size, for example from `flatten`.
    rings : int
        Maximum number of edges between the vertices of a pair.
    max_iterations : int
        Maximum number of Newton steps.
    tol : float
        The descent has converged when Newton's model predicts a decrease below this fraction of the energy. Not
        negative.
    linear_solver, callback, record_every
        As for `quasiharmonic.flatten`.

    Returns
    -------
    MapResult
        ``uv`` is certified as bijective, and in the surface's unit of length, at the scale that fits distances best.
        The status is ``POLISHED`` if converged, ``STILL_FALLING`` after ``max_iterations``, ``EXHAUSTED`` if no better
        bijective map was found, or ``INTERRUPTED`` by Ctrl-C, with the best map so far: ``uv`` unchanged if the descent
        has not begun.

    Raises
    ------
    ValueError
        If the input is malformed (see `Problem`), the surface has handles, a rest triangle has no area, or ``uv`` is
        not bijective; the message names the elements.

    See Also
    --------
    flatten : Makes the map, and with ``energy="distances"`` does both.
    energies.distances.surface_distances : Samples distances.

    Examples
    --------
    A dome seen from above is compressed at its boundary; the descent spreads it out:

    >>> import numpy as np
    >>> from quasiharmonic import distortion
    >>> from quasiharmonic.surfaces import disk
    >>> flat, F = disk(12)
    >>> V = np.column_stack([flat, np.sqrt(1.1 - (flat**2).sum(axis=1))])
    >>> result = keep_distances(V, F, flat, rings=8)
    >>> result.certificate.bijective
    True
    >>> errors = [distortion(V, F, uv, rings=8).distances.mean for uv in (flat, result.uv)]
    >>> errors[1] < 0.5 * errors[0]
    True
    """
    began = time.perf_counter()
    checked = DistanceOptions(**options)
    piece = Piece(V, F)
    n = len(piece.V)
    positions = map_array("uv", uv, n)
    certificate = certify(piece.F, positions, loops=piece.loops)
    if not certificate.bijective:
        raise ValueError(
            f"uv is not bijective: the descent needs a bijective map. {certificate.summary()} Make one with flatten."
        )
    result = MapResult(uv=positions, status=Status.INTERRUPTED, certificate=certificate)
    with Run().until_interrupted():
        lowered = lower_distance_error(piece, positions, checked)
        uv = to_given_unit(lowered.uv, piece.exponent)
        result = replace(lowered, uv=uv, certificate=certify(piece.F, uv, loops=piece.loops))
    rest = np.ldexp(piece.V, piece.exponent)
    return replace(result, seconds=time.perf_counter() - began, V=rest)


def lower_distance_error(piece: Piece, uv: FloatArray, options: DistanceOptions, *, first: int = 0) -> MapResult:
    """Lower the error of distances in a bijective map (n, 2), of any size, of a piece; see `keep_distances`.

    ``first`` is the number of the first step. The result's ``uv`` is in the piece's unit, and its ``path`` in the
    surface's.
    """
    run = Run(options.callback, options.record_every, first=first)
    distances = sample_distances(piece.V, piece.F, choose_sampling(options.rings))
    barrier = piece.energy(SymmetricDirichlet(), None)
    descent = make_descent(distances, barrier, uv, piece.loops, options.linear_solver)
    status = lower_errors(run, "guarded descent, distances", descent, options, piece.exponent)
    return run.result(descent.uv, piece.F, status, loops=piece.loops, linear_solver=descent.linear_solver)


def make_descent(
    distances: SurfaceDistances, barrier: DeformationEnergy, uv: FloatArray, loops: list[IntArray], linear_solver: str
) -> SurfaceDescent:
    """Return the guarded descent of the error of distances from a bijective map (n, 2) of any size."""
    start = fit_scale(uv, distances, barrier.F, loops)
    with np.errstate(all="ignore"):
        energy = DistanceEnergy(distances, barrier, len(uv))
        return SurfaceDescent(energy, start, linear_solver, rim=Rim(loops), pairs=DistancePairs(energy))


def lower_errors(
    run: Run, name: str, descent: SurfaceDescent, options: DistanceOptions, exponent: int | None = None
) -> Status:
    """Run a descent of `make_descent` as a stage, and return its status; maps are recorded if ``exponent`` is given.

    The map is in units of ``2 ** exponent``.
    """
    with run.until_interrupted():
        return run.descend(
            name,
            islice(descend(descent, SymmetricDirichlet(), options.tol), options.max_iterations),
            lambda: descent.distortion,
            None if exponent is None else lambda: to_given_unit(descent.uv, exponent),
        )
    return Status.INTERRUPTED


def choose_sampling(rings: int) -> Sampling:
    """The sampling for a number of rings: a constant number of pairs, from fewer sources if there are many rings."""
    sources = int(np.clip(_TUNING.work // rings**2, _TUNING.min_sources, _TUNING.max_sources))
    return Sampling(rings, sources, _TUNING.pairs // sources, _TUNING.crossings)


def fit_scale(uv: FloatArray, distances: SurfaceDistances, F: IntArray, loops: list[IntArray]) -> FloatArray:
    """Scale a bijective map so that its distances fit the surface's best, and centre it at the origin.

    If rounding then inverts a triangle, only scale it, by a power of two.
    """
    # First scale by a power of two, so that squared lengths neither overflow nor underflow.
    uv = np.ldexp(uv, -int(np.frexp(np.ptp(uv, axis=0).max())[1]))
    scale = distances.error(uv).scale
    scaled = scale * (uv - uv.mean(axis=0))
    if certify(F, scaled, loops=loops).bijective:
        return scaled
    # Rounding inverts very thin triangles; scaling by a power of two does not change their signs.
    return np.ldexp(uv, int(np.rint(np.log2(scale))))


class DistancePairs:
    """Second derivatives of an energy of distances between distant vertices; see `Pairs`."""

    def __init__(self, energy: DistanceEnergy) -> None:
        self._energy = energy
        self._form: PairForm | None = None

    def add_to(self, system: NewtonSystem, w: ComplexArray) -> None:
        """Add the diagonal blocks of the pairs at a map (n,)."""
        self._form = self._energy.pairs_at(w)
        system.add_blocks(*(part[system.free] for part in self._form.diagonal))

    def solve(self, system: NewtonSystem, load: ComplexArray) -> ComplexArray:
        """Return Newton's direction for a load on the free vertices, by conjugate gradients."""
        assert self._form is not None
        free, full_step = system.free, np.zeros(self._energy.n, dtype=np.complex128)
        direction, residual = np.zeros_like(load), load
        step, by_matrix = system.solve(load), load
        now = first = _dot(load, step)
        for _ in range(_TUNING.max_gradients):
            if not now > _TUNING.residual**2 * first:
                break
            full_step[free] = step
            product = by_matrix + self._form.apply_off_diagonal(full_step)[free]
            size = now / _dot(step, product)
            direction, residual = direction + size * step, residual - size * product
            preconditioned = system.solve(residual)
            now, before = _dot(residual, preconditioned), now
            step, by_matrix = preconditioned + now / before * step, residual + now / before * by_matrix
        return direction


def _dot(a: ComplexArray, b: ComplexArray) -> float:
    return float(np.sum(a.real * b.real + a.imag * b.imag))
