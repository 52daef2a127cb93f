"""A flat map that keeps distances: Newton's steps down their energy, among bijective maps.

A pair of vertices far apart couples what no triangle does, and a matrix with all pairs in it would fill up when it is
factored. But each vertex has pairs in all directions, so the pairs alone are nearly as good as a weight at every
vertex: with ``H = M + (P − D)``, in M the triangles' matrix and the pairs' blocks D on the diagonal, and P the pairs'
matrix, a dozen conjugate gradients preconditioned by the factors of M give Newton's direction. The product with M
comes for free: it is what the residuals were before they were preconditioned.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.flattening.contacts import Rim
from quasiharmonic.apps.flattening.descent import GuardedDescent
from quasiharmonic.apps.flattening.distances.energy import DistanceEnergy, PairForm
from quasiharmonic.apps.flattening.layout import in_given_unit
from quasiharmonic.apps.flattening.piece import Piece, Settings
from quasiharmonic.energies.distances import Sampling, SurfaceDistances, sampled
from quasiharmonic.energies.energies import SymmetricDirichlet
from quasiharmonic.geometry.exact.certificate import certify
from quasiharmonic.io.adapters.accepts_mesh import accepts_mesh
from quasiharmonic.problem.result import MapResult, Snapshot, Stage, Status, Step
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, map_array, not_negative, whole_number
from quasiharmonic.util.progress import reports_progress

# So many pairs are kept, along segments across so many edges. On a cortex of 9,465 vertices twice as many pairs lower
# the error by a hundredth of it, half as many raise it by as much.
_PAIRS, _CROSSINGS = 300_000, 3
# The more sources the better, but what distances from one cost grows with the square of the rings: of sources times
# that there are so many, within bounds.
_WORK, _FEWEST, _MOST = 1_000_000, 1000, 4000
# Gradients are followed until the residual has fallen to this share, or there were so many.
_ACCURACY, _GRADIENTS = 0.1, 20


@accepts_mesh
@reports_progress
def keep_distances(
    V: ArrayLike,
    F: ArrayLike,
    uv: ArrayLike,
    *,
    rings: int = 20,
    max_iterations: int = 100,
    tolerance: float = 1e-3,
    linear_solver: str = "auto",
    callback: Callable[[Step], object] | None = None,
    record_every: int = 0,
) -> MapResult:
    """Bring distances in the plane near to distances along the surface; every map on the way is bijective.

    What is lowered is the mean, over a sample of pairs of vertices at most ``rings`` edges apart, of how far their
    distance is off, as `quasiharmonic.distortion` measures it but for errors below 30 % counting by squares, and a
    small share of the symmetric Dirichlet energy, which keeps triangles from collapsing
    (`quasiharmonic.apps.flattening.distances.energy`). The sample has 2,500 vertices, or all if there are no more, with
    120 others each, drawn at random, always the same; for fewer rings up to 4,000 vertices, for more down to 1,000, and
    300,000 pairs in all.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Rest positions.
    F : (f, 3) array of int
        Triangles of a connected surface with at least one boundary loop and without handles.
    uv : (n, 2) array
        A bijective map of any size, such as `flatten` makes.
    rings : int
        How many edges apart vertices of a pair are at most.
    max_iterations : int
        Newton steps at most.
    tolerance : float
        The descent has converged when Newton's model promises a further decrease below this fraction of the energy.
        Not negative.
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.
    callback : callable, optional
        Called with a `Step` at the start and after every step, and with the last one again at least every half second
        in between, but not within a single factorisation.
    record_every : int
        Keep the map of every ``record_every``-th step in the result's ``path``; none of them by default.

    Returns
    -------
    MapResult
        Its ``uv`` is bijective, certified, and in the surface's own unit of length: distances in it are nearest to the
        surface's as they are. The status is ``POLISHED``, ``STILL_FALLING`` after the last iteration, ``EXHAUSTED``
        when no better bijective map was found, or ``INTERRUPTED`` by Ctrl-C, with the best map so far.

    Raises
    ------
    ValueError
        When the input is malformed (see `Problem`), the surface has handles, a rest triangle has no area, or ``uv`` is
        not bijective; the message says where.

    Examples
    --------
    A dome seen from above, its rim pressed together, is spread out:

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
    whole_number("max_iterations", max_iterations, least=0)
    whole_number("record_every", record_every, least=0)
    whole_number("rings", rings, least=1)
    not_negative("tolerance", tolerance)
    piece = Piece(V, F)
    n = len(piece.V)
    places = map_array("uv", uv, n)
    judged = certify(piece.F, places, loops=piece.loops)
    if not judged.bijective:
        raise ValueError(f"uv is not bijective: the descent needs a bijective map. {judged.summary()}")
    settings = Settings(
        SymmetricDirichlet(), "distances", tolerance, max_iterations, linear_solver, callback, record_every
    )
    result = kept(piece, places, rings, settings)
    uv = in_given_unit(result.uv, piece.exponent)
    certificate = certify(piece.F, uv, loops=piece.loops)
    rest = np.ldexp(piece.V, piece.exponent)
    return replace(result, uv=uv, certificate=certificate, seconds=time.perf_counter() - began, V=rest)


def kept(piece: Piece, uv: FloatArray, rings: int, settings: Settings, *, first: int = 0) -> MapResult:
    """Bring distances in a bijective map of a piece near to those along it.

    Parameters
    ----------
    piece : Piece
    uv : (n, 2) float64
        A bijective map of any size.
    rings : int
        As `keep_distances` has it.
    settings : Settings
        Of which the density is not read.
    first : int
        The number of the first step.

    Returns
    -------
    MapResult
        As `keep_distances` makes it, ``uv`` in the piece's unit and ``path`` in the surface's.
    """
    began = time.perf_counter()
    distances = sampled(piece.V, piece.F, sampling_of(rings))
    start = in_scale(uv, distances, piece.F, piece.loops)
    with np.errstate(all="ignore"):
        energy = DistanceEnergy(distances, piece.energy(SymmetricDirichlet(), None), len(piece.V))
        descent = DistanceDescent(energy, start, settings.linear_solver, Rim(piece.loops))
    history: list[Step] = []
    path: list[Snapshot] = []

    def report(value: float) -> None:
        history.append(Step(first + len(history), 0, value))
        if settings.record_every and history[-1].iteration % settings.record_every == 0:
            path.append(Snapshot(history[-1].iteration, in_given_unit(descent.uv, piece.exponent)))
        if settings.callback is not None:
            settings.callback(history[-1])

    status = followed(descent, settings, report)
    seconds = time.perf_counter() - began
    energies = history[0].energy, descent.distortion
    return MapResult(
        uv=descent.uv,
        status=status,
        certificate=certify(piece.F, descent.uv, loops=piece.loops),
        stages=[Stage("guarded descent, distances", len(history) - 1, seconds, (0, 0), energies)],
        history=history,
        path=path,
        linear_solver=descent.system.solver.name,
        seconds=seconds,
    )


def sampling_of(rings: int) -> Sampling:
    """The pairs that a descent keeps: as many whatever the rings, from fewer sources where these are many."""
    sources = int(np.clip(_WORK // rings**2, _FEWEST, _MOST))
    return Sampling(rings, sources, _PAIRS // sources, _CROSSINGS)


def in_scale(uv: FloatArray, distances: SurfaceDistances, F: IntArray, loops: list[IntArray]) -> FloatArray:
    """A bijective map scaled such that its distances are nearest to the surface's, its middle at the origin."""
    # A power of two first, so that squares of lengths neither overflow nor vanish.
    uv = np.ldexp(uv, -int(np.frexp(np.ptp(uv, axis=0).max())[1]))
    scale = distances.error(uv).scale
    scaled = scale * (uv - uv.mean(axis=0))
    if certify(F, scaled, loops=loops).bijective:
        return scaled
    # Triangles so thin that rounding inverts them: powers of two leave them as they are.
    return np.ldexp(uv, int(np.rint(np.log2(scale))))


def followed(descent: DistanceDescent, settings: Settings, report: Callable[[float], None]) -> Status:
    """Take steps until there is no other to take, or Ctrl-C comes.

    Parameters
    ----------
    descent : DistanceDescent
    settings : Settings
    report : callable
        Called with the energy at the start and after every step.
    """
    try:
        report(descent.distortion)
        for _ in range(settings.max_iterations):
            with np.errstate(all="ignore"):
                outcome = descent.step(settings.tolerance)
            report(descent.distortion)
            if outcome is not None and not descent.relax_barrier():
                return outcome
    except KeyboardInterrupt:
        return Status.INTERRUPTED
    return Status.STILL_FALLING


class DistanceDescent(GuardedDescent):
    """Steps of a map that stays bijective, down an energy of distances.

    Parameters
    ----------
    energy : DistanceEnergy
    uv : (n, 2) float64
        A bijective map, of about unit size.
    linear_solver : str
    rim : Rim
        The surface's boundary.
    """

    pairs: PairForm

    def __init__(self, energy: DistanceEnergy, uv: FloatArray, linear_solver: str, rim: Rim) -> None:
        self._between = energy
        super().__init__(energy, uv, linear_solver, rim)

    def assemble(self, negative: float) -> None:
        """Fill in the matrix of the triangles and contacts, and of the pairs what is on the diagonal."""
        super().assemble(negative)
        self.pairs = self._between.pairs_at(self.w)
        self.system.add_blocks(*(part[self.system.free] for part in self.pairs.diagonal))

    def solve(self, load: ComplexArray) -> ComplexArray:
        """Newton's direction under a load on the free vertices, by conjugate gradients."""
        free, whole = self.system.free, np.zeros(self.w.size, dtype=np.complex128)
        direction, residual = np.zeros_like(load), load
        step, by_matrix = self.system.solve(load), load
        now = first = _dot(load, step)
        for _ in range(_GRADIENTS):
            if not now > _ACCURACY**2 * first:
                break
            whole[free] = step
            product = by_matrix + self.pairs.apply_off_diagonal(whole)[free]
            size = now / _dot(step, product)
            direction, residual = direction + size * step, residual - size * product
            preconditioned = self.system.solve(residual)
            now, before = _dot(residual, preconditioned), now
            step, by_matrix = preconditioned + now / before * step, residual + now / before * by_matrix
        return direction


def _dot(a: ComplexArray, b: ComplexArray) -> float:
    return float(np.sum(a.real * b.real + a.imag * b.imag))
