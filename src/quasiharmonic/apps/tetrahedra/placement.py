"""Place the free vertices of a tetrahedral mesh: the others are fixed, or slide along flat parts of the boundary.

A sliding vertex keeps the boundary in shape if it moves only along directions that lie in the planes of all boundary
triangles around it: two directions on a plane, one on an edge between planes, none at a corner or on a curved surface.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.tetrahedra.certificate import certify_arrays, find_boundary_contacts, tetrahedron_array
from quasiharmonic.apps.tetrahedra.contacts import MAX_LISTED
from quasiharmonic.apps.tetrahedra.descent import ShapeEnergy, TetrahedraDescent, project
from quasiharmonic.apps.tetrahedra.elements import FaceReport, inspect_faces, tetrahedron_signs
from quasiharmonic.apps.tetrahedra.result import (
    TetrahedraObstruction,
    TetrahedraResult,
    TetrahedraStatus,
    find_obstructions,
    tetrahedron_quality,
)
from quasiharmonic.problem.run import Run
from quasiharmonic.util.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    check_finite,
    find_exponent,
    invert_indices,
    mark,
    names_of,
    real_array,
    reject,
)
from quasiharmonic.util.options import TetrahedraOptions


class PlacementTuning(NamedTuple):
    """Numbers that tune the placement of the boundary."""

    # Largest distance of a vertex from a plane, relative to the extent of the mesh.
    tolerance: float = 1e-6
    # Least cosine between a triangle on a named plane and this plane.
    parallel: float = 0.9
    # Maximum number of crossing pairs of boundary triangles that are listed.
    max_listed: int = 20
    # Newton steps without progress after which untangling has stalled.
    patience: int = 100


_TUNING = PlacementTuning()


@dataclass(frozen=True)
class Sliding:
    """Vertices that slide (k,), ascending, and the projections (k, 3, 3) to their directions."""

    vertices: IntArray
    projections: FloatArray

    def restrict(self, free: IntArray) -> FloatArray | None:
        """Return the projections (m, 3, 3) of free vertices (m,), ascending; None if no vertex slides."""
        if not self.vertices.size:
            return None
        P = np.broadcast_to(np.eye(3), (free.size, 3, 3)).copy()
        P[np.searchsorted(free, self.vertices)] = self.projections
        return P


#: No vertex slides.
NO_SLIDING = Sliding(np.empty(0, dtype=np.int64), np.empty((0, 3, 3)))


def find_sliding(F: IntArray, X: FloatArray, moved: IntArray, slide: bool | ArrayLike) -> Sliding:
    """Return the vertices of boundary triangles F (f, 3) that can slide, without those that are ``moved``.

    ``slide`` is True for all flat parts of the boundary, or the planes (m, 4) of those parts: ``(a, b, c, d)`` has the
    points with ``a x + b y + c z = d``. A vertex between a named and another part is fixed. A part counts as flat if
    rounding to single precision, or a millionth of the extent, explains its distance from a plane.
    ValueError if a plane has no direction or contains no boundary triangle.
    """
    everywhere = isinstance(slide, bool | np.bool_)
    if everywhere and not slide:
        return NO_SLIDING
    used = np.unique(F)
    centre = X[used].mean(axis=0)
    extent = np.abs(X[used] - centre).max()
    P = (X - centre) / extent
    a, b, c = P[F].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    longest = np.sqrt(np.max([((p - q) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0))
    area = np.linalg.norm(normals, axis=1)
    # Triangles without area restrict nothing.
    normals = np.divide(normals, area[:, None], out=np.zeros_like(normals), where=area[:, None] > 0)
    height = np.divide(area, longest, out=np.zeros_like(area), where=longest > 0)
    rounding = _resolution(X[used]) / extent
    if not everywhere:
        normals, named = _snap_to_planes(slide, F, P, normals, (centre, extent, rounding))
        used = np.setdiff1d(used, F[~named])
    vertices = np.setdiff1d(used, moved)
    number = invert_indices(len(X), vertices)
    # A unit step along a direction leaves the plane of a triangle by at most this, relative to its height.
    leaning = normals * height[:, None]
    squares = np.zeros((vertices.size, 3, 3))
    for corner in number[F].T:
        inside = corner >= 0
        np.add.at(squares, corner[inside], leaning[inside, :, None] * leaning[inside, None, :])
    values, directions = np.linalg.eigh(squares)
    # Directions across which no triangle leans.
    directions *= (values < (_TUNING.tolerance + rounding) ** 2)[:, None, :]
    free = directions.any(axis=(1, 2)) & (values[:, -1] > 0)
    directions = directions[free]
    return Sliding(vertices[free], directions @ directions.transpose(0, 2, 1))


def _resolution(X: FloatArray) -> float:
    """The distance by which coordinates may be rounded: that of single precision if all of them have it."""
    with np.errstate(over="ignore", under="ignore"):
        single = bool((X.astype(np.float32) == X).all())
    return 4 * float(np.abs(X).max()) * float(np.finfo(np.float32 if single else np.float64).eps)


def _snap_to_planes(
    slide: ArrayLike, F: IntArray, P: FloatArray, normals: FloatArray, frame: tuple[FloatArray, float, float]
) -> tuple[FloatArray, BoolArray]:
    """Return the normals with those of planes where triangles lie on one, and which triangles do.

    ``P`` (n, 3) are positions relative to the centre and the extent of the mesh; ``frame`` has both, and the rounding.
    """
    planes = real_array("slide", slide)
    if planes.ndim != 2 or planes.shape[1] != 4:
        raise ValueError(f"slide must be a bool or planes of shape (m, 4), not of shape {planes.shape}")
    check_finite("slide", "plane", "planes", planes)
    centre, extent, rounding = frame
    named = np.zeros(len(F), dtype=np.bool_)
    normals = normals.copy()
    for k, plane in enumerate(planes):
        size = np.abs(plane[:3]).max()
        if not size > 0:
            raise ValueError(f"slide has no direction in plane {k}: {plane.tolist()}")
        length = np.linalg.norm(plane[:3] / size)
        normal = plane[:3] / size / length
        height = P @ normal
        distance = height - (plane[3] / size / length - centre @ normal) / extent
        # Of a thin body only one side lies on the plane.
        near = np.abs(distance) <= _TUNING.tolerance * np.ptp(height[F]) + rounding
        parallel = (np.abs(normals @ normal) > _TUNING.parallel) | ~normals.any(axis=1)
        on = near[F].all(axis=1) & parallel
        if not on.any():
            raise ValueError(f"slide has plane {k}, {plane.tolist()}, but no boundary triangle lies on it")
        normals[on] = normal
        named |= on
    return normals, named


@dataclass(frozen=True, eq=False)
class RestMesh:
    """A checked rest mesh: positive tetrahedra ``T`` (t, 4), positions ``X`` (n, 3), and the faces."""

    T: IntArray
    X: FloatArray
    faces: FaceReport

    @property
    def boundary_vertices(self) -> IntArray:
        """Ascending vertices of the boundary."""
        return np.unique(self.faces.boundary)


def check_rest(T: ArrayLike, X: FloatArray) -> RestMesh:
    """Check a rest mesh and turn its tetrahedra positive.

    ValueError if there are no tetrahedra, a vertex of one is not finite, or one is degenerate, repeated or overlaps a
    neighbour.
    """
    T = tetrahedron_array(T, len(X))
    if not len(T):
        raise ValueError("the mesh has no tetrahedra")
    sign, nonfinite = tetrahedron_signs(T, X)
    reject(nonfinite, "tetrahedron", "tetrahedra", "points are not finite at {}")
    reject(sign == 0, "tetrahedron", "tetrahedra", "{} degenerate at rest: repair the mesh first")
    T = np.where((sign < 0)[:, None], T[:, [1, 0, 2, 3]], T)
    faces = inspect_faces(T, len(X))
    for found, what in (
        (faces.repeated, "repeated"),
        (faces.nonmanifold, "a face is in three or more tetrahedra"),
        (faces.inconsistent, "two tetrahedra are on the same side of a face, so one is inverted at rest"),
    ):
        if len(found):
            names = names_of("tetrahedron", "tetrahedra", found) if found.ndim == 1 else str(tuple(found[0].tolist()))
            raise ValueError(f"the rest mesh is not valid: {what}: {names}")
    return RestMesh(T, X, faces)


def place_vertices(
    mesh: RestMesh,
    points: FloatArray,
    fixed: IntArray,
    target: FloatArray,
    start: FloatArray | None,
    options: TetrahedraOptions,
    sliding: Sliding = NO_SLIDING,
) -> TetrahedraResult:
    """Find positions of the free vertices such that every tetrahedron is positive, then lower the distortion.

    ``points`` (n, 3) are the current positions, ``fixed`` (k,) the fixed vertices, and ``target`` (k, 3) their
    positions. Without ``start`` (n, 3) the search starts at the harmonic extension of the displacement.
    """
    began = time.perf_counter()
    T = mesh.T
    begin = points.copy()
    begin[fixed] = target
    free = np.setdiff1d(np.unique(T), fixed)
    projections = sliding.restrict(free)
    whole = bool(np.isin(mesh.boundary_vertices, fixed).all())
    obstructions = _find_crossings(mesh, begin, fixed)
    status, iterations = TetrahedraStatus.CROSSING, 0
    energy, X, exponent = make_energy(mesh, begin, whole)
    if not obstructions:
        if start is not None:
            X[free] = np.ldexp(start[free], -exponent)
            here = np.ldexp(points[sliding.vertices], -exponent)
            X[sliding.vertices] = here + project(sliding.projections, X[sliding.vertices] - here)
        else:
            X = extend_harmonically(energy, np.ldexp(points, -exponent), fixed, X[fixed], projections)
        X, status, iterations = _search(TetrahedraDescent(energy, free, X, projections=projections), options)
        after = np.ldexp(X, exponent)
        begin[free] = after[free]
    run = Run()
    with run.until_interrupted():
        certificate = certify_arrays(T, begin, faces=mesh.faces)
    if run.interrupted:
        # Keep the mesh that was found, and leave its boundary unchecked.
        certificate = certify_arrays(T, begin, boundary=False, faces=mesh.faces)
    sign, _ = tetrahedron_signs(T, begin)
    is_fixed = mark(len(points), fixed)
    forbidden = np.flatnonzero((sign <= 0) & is_fixed[T].all(axis=1))
    if not certificate.positive and status is not TetrahedraStatus.CROSSING:
        with run.until_interrupted():
            obstructions = find_obstructions(T, begin, is_fixed, mesh.faces.boundary if whole else None, sign)
        if obstructions:
            status = TetrahedraStatus.IMPOSSIBLE
        elif status not in (TetrahedraStatus.OUT_OF_ITERATIONS, TetrahedraStatus.INTERRUPTED):
            status = TetrahedraStatus.STALLED
    elif certificate.positive and not certificate.injective and status is not TetrahedraStatus.INTERRUPTED:
        status = TetrahedraStatus.OVERLAPPING
    if run.interrupted and not obstructions:
        status = TetrahedraStatus.INTERRUPTED
    return TetrahedraResult(
        points=begin,
        T=T,
        certificate=certificate,
        status=status,
        obstructions=obstructions,
        forbidden=forbidden,
        sliding=sliding.vertices,
        iterations=iterations,
        seconds=time.perf_counter() - began,
        energy=float(energy.densities(X).mean()) if certificate.positive else np.inf,
        quality_before=tetrahedron_quality(T, points),
        quality_after=tetrahedron_quality(T, begin),
        points_before=points.copy(),
    )


def _find_crossings(mesh: RestMesh, X: FloatArray, fixed: IntArray) -> tuple[TetrahedraObstruction, ...]:
    """Describe pairs of boundary triangles of fixed vertices that meet at target positions."""
    F = mesh.faces.boundary
    F = F[np.isin(F, fixed).all(axis=1)]
    pairs = F[find_boundary_contacts(F, X)]
    count = f"{'at least ' if len(pairs) >= MAX_LISTED else ''}{len(pairs)}"
    rest = f" (first of {count} pairs)" if len(pairs) > 1 else ""
    return tuple(
        TetrahedraObstruction(
            f"The boundary triangles {tuple(one)} and {tuple(other)} meet{rest if not k else ''}.", (*one, *other)
        )
        for k, (one, other) in enumerate(pairs[: _TUNING.max_listed].tolist())
    )


def make_energy(mesh: RestMesh, begin: FloatArray, whole: bool) -> tuple[ShapeEnergy, FloatArray, int]:
    """The energy with rest and target scaled to magnitude one and equal volume; the scaled start, and its exponent."""
    used = np.unique(mesh.T)
    rest = np.zeros_like(mesh.X)
    X = np.zeros_like(begin)
    exponents = []
    for there, here in ((mesh.X, rest), (begin, X)):
        exponents.append(find_exponent(there[used]))
        here[used] = np.ldexp(there[used], -exponents[-1])
    with np.errstate(all="ignore"):
        ratio = 0.0
        if whole:
            old, new = (_volume(mesh.faces.boundary, positions) for positions in (rest, X))
            ratio = new / old if old > 0 else 0.0
        scale = float(np.cbrt(ratio)) if 0 < ratio < np.inf else 2.0 ** (exponents[0] - exponents[1])
        energy = ShapeEnergy(mesh.T, rest * scale)
    bad = np.asarray(~np.isfinite(energy.gradients).all(axis=(0, 1)))
    reject(bad, "tetrahedron", "tetrahedra", "{} too thin or too small at rest for double precision")
    return energy, X, exponents[1]


def _volume(F: IntArray, X: FloatArray) -> float:
    """Six times the volume that oriented triangles enclose; accurate far from the origin, too."""
    a, b, c = (X[F] - X[F[0, 0]]).transpose(1, 0, 2)
    return float((a * np.cross(b, c)).sum())


def extend_harmonically(
    energy: ShapeEnergy, X: FloatArray, fixed: IntArray, target: FloatArray, projections: FloatArray | None = None
) -> FloatArray:
    """Add to positions (n, 3) the harmonic extension of the displacement of the fixed vertices to ``target`` (k, 3).

    ``projections`` (m, 3, 3), if given, restrict the displacements of the other vertices of the mesh, ascending.
    """
    from scipy.sparse import coo_array, dia_array
    from scipy.sparse.linalg import LinearOperator, cg

    T, G = energy.T, energy.gradients
    n = len(X)
    displacement = np.zeros_like(X)
    displacement[fixed] = target - X[fixed]
    stiffness = np.einsum("iat,jat->ijt", G, G) * energy.six_volumes
    rows, columns = np.broadcast_arrays(T.T[:, None], T.T[None])
    matrix = coo_array((stiffness.ravel(), (rows.ravel(), columns.ravel())), shape=(n, n)).tocsr()
    free = np.setdiff1d(np.unique(T), fixed)
    own = matrix[free][:, free]
    load = -(matrix[free] @ displacement)
    diagonal = own.diagonal()
    inverse = 1.0 / np.where(diagonal > 0, diagonal, 1.0)

    def apply(x: FloatArray) -> FloatArray:
        return project(projections, own @ x.reshape(-1, 3)).ravel()

    load = project(projections, load).ravel()
    if load.any():
        size = (load.size, load.size)
        operator = LinearOperator(size, matvec=apply, dtype=np.float64)
        preconditioner = dia_array((np.repeat(inverse, 3)[None], [0]), shape=size)
        solved = cg(operator, load, rtol=1e-6, maxiter=2000, M=preconditioner)[0]
        displacement[free] = project(projections, solved.reshape(-1, 3))
    there = X + displacement
    return there if np.isfinite(there[T]).all() else X


def _search(descent: TetrahedraDescent, options: TetrahedraOptions) -> tuple[FloatArray, TetrahedraStatus, int]:
    """Untangle and polish; return the best positions, why the search ended, and the number of steps.

    Ctrl-C ends the search, and a callback may raise KeyboardInterrupt.
    """
    energy, X = descent.energy, descent.X
    best = [(len(energy.T) + 1, X)]
    run = Run(options.callback)
    with run.until_interrupted(), np.errstate(all="ignore"):
        count = energy.count_inverted(X)
        best[:] = [(count, X)]
        run.record(count, np.inf)
        if count and descent.free.size:
            count = _untangle(descent, options, run, best)
        if count:
            ended = descent.iterations >= options.max_iterations
            status = TetrahedraStatus.OUT_OF_ITERATIONS if ended else TetrahedraStatus.STALLED
            return best[-1][1], status, descent.iterations
        status = _polish(descent, options, run)
        return descent.X, status, descent.iterations
    return descent.X if descent.is_valid() else best[-1][1], TetrahedraStatus.INTERRUPTED, descent.iterations


def _untangle(
    descent: TetrahedraDescent, options: TetrahedraOptions, run: Run, best: list[tuple[int, FloatArray]]
) -> int:
    """Untangle until nothing is inverted or progress ends, and keep the best mesh; return how many stay inverted."""
    energy = descent.energy
    since, least = 0, float(energy.determinants(descent.X).min())
    for now in descent.untangle(options.max_iterations):
        count = energy.count_inverted(descent.X)
        since += 1
        if count < best[-1][0] or now > least + 0.05 * abs(least):
            since, least = 0, max(now, least)
        if count < best[-1][0]:
            best[:] = [(count, descent.X)]
        run.record(count, np.inf)
        if since >= _TUNING.patience:
            break
    return energy.count_inverted(descent.X)


def _polish(descent: TetrahedraDescent, options: TetrahedraOptions, run: Run) -> TetrahedraStatus:
    """Lower the energy of a valid mesh; return why this ended."""
    if not options.polish or not descent.free.size:
        return TetrahedraStatus.FIRST_VALID
    for value in descent.polish(options.max_iterations - descent.iterations, options.tol):
        run.record(0, value)
    converged = descent.converged and np.isfinite(descent.energy.value(descent.X, 0.0))
    return TetrahedraStatus.POLISHED if converged else TetrahedraStatus.STILL_FALLING
