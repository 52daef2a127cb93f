"""Result of a search for positions of a tetrahedral mesh, and simple reasons why no valid mesh exists.

Obstructions belong to the positions of the fixed vertices, and each is verified exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from fractions import Fraction
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from quasiharmonic.apps.tetrahedra.certificate import TetrahedraCertificate
from quasiharmonic.apps.tetrahedra.contacts import edges_meeting_triangles
from quasiharmonic.apps.tetrahedra.elements import EDGES, FACES, SignArray, find_mesh_edges
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, names_of
from quasiharmonic.util.outcome import Displayable, Outcome, as_plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Maximum number of obstructions of each kind.
_MAX_LISTED = 20
_Vector = list[Fraction]


class TetrahedraStatus(Enum):
    """Why a search ended; the value is a message for the user with the outcome and the next action.

    See Also
    --------
    TetrahedraResult : Has a status, and the message of it.
    Status : The statuses of maps of triangles.

    Examples
    --------
    >>> from quasiharmonic.apps.tetrahedra.result import TetrahedraStatus
    >>> TetrahedraStatus.POLISHED.value
    'Every tetrahedron is strictly positive, and the distortion has converged.'
    """

    POLISHED = "Every tetrahedron is strictly positive, and the distortion has converged."
    STILL_FALLING = (
        "Every tetrahedron is strictly positive. The distortion was still falling after the last iteration: "
        "allow more iterations to lower it further."
    )
    FIRST_VALID = "Every tetrahedron is strictly positive."
    STALLED = (
        "Stalled: some tetrahedra are still inverted and further iterations do not help. No known obstruction forbids "
        "a valid mesh, but this mesh and this target may still allow none. Move the boundary less, move it in several "
        "steps, or split the edges of the inverted tetrahedra."
    )
    OUT_OF_ITERATIONS = "Some tetrahedra were still inverted after the last iteration: allow more iterations."
    OVERLAPPING = (
        "Every tetrahedron is strictly positive, but the mesh overlaps itself: points are covered twice. Move apart "
        "the parts of the boundary that the certificate lists."
    )
    INTERRUPTED = "Interrupted. This is the best mesh so far: use it as the initial mesh of a new call to continue."
    IMPOSSIBLE = (
        "No valid mesh with these fixed vertices exists. Move the vertices that the obstructions list, or split the "
        "edges there."
    )
    CROSSING = (
        "The boundary crosses itself at its target positions, so no valid mesh exists, and nothing was computed. Move "
        "apart the triangles that the obstructions list."
    )


@dataclass(frozen=True)
class TetrahedraObstruction:
    """A reason why no valid mesh with these fixed vertices exists.

    Attributes
    ----------
    text : str
    vertices : tuple of int
        The vertices of the tetrahedron, edge or triangles, or the free vertex.

    See Also
    --------
    TetrahedraResult : Lists them as ``obstructions``.
    results.Obstruction : The same for triangles.

    Examples
    --------
    >>> from quasiharmonic import injective_tetrahedra
    >>> X = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    >>> reflected = [[0, 0, 0], [0, 1, 0], [1, 0, 0], [0, 0, 1]]
    >>> result = injective_tetrahedra(X, [[0, 1, 2, 3]], range(4), reflected)
    >>> result.obstructions[0].vertices
    (0, 1, 2, 3)
    """

    text: str
    vertices: tuple[int, ...]


@dataclass(frozen=True, eq=False, repr=False)
class TetrahedraResult(Outcome, Displayable):
    """A tetrahedral mesh with some fixed vertices; returned by `morph` and `injective_tetrahedra`.

    Attributes
    ----------
    points : (n, 3) float64
        All vertices; those in no tetrahedron keep their positions.
    T : (t, 4) int64
        The tetrahedra in the given order, positive at rest.
    certificate : TetrahedraCertificate
        The exact certificate of ``points``.
    status : TetrahedraStatus
    obstructions : tuple of TetrahedraObstruction
        Reasons that were found why no valid mesh exists; at most 20.
    forbidden : (k,) int64
        Inverted or degenerate tetrahedra whose four vertices are fixed.
    sliding : (k,) int64
        Boundary vertices that were free to slide; none unless ``slide`` was given.
    iterations : int
        Newton steps.
    seconds : float
    energy : float
        Mean isotropic energy relative to the rest mesh, 1 for a rotation; infinite if a tetrahedron is not positive.
    quality_before, quality_after : (t,) float64
        `tetrahedron_quality` of every tetrahedron.
    points_before : (n, 3) float64
        All vertices before the morph.

    See Also
    --------
    injective_tetrahedra : Makes it.
    morph : Makes it.
    apps.tetrahedra.result.TetrahedraStatus : What each status means.

    Examples
    --------
    >>> import numpy as np
    >>> from quasiharmonic import injective_tetrahedra
    >>> X = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0.2, 0.2, 0.2]])
    >>> T = [[0, 1, 2, 4], [0, 1, 3, 4], [0, 2, 3, 4], [1, 2, 3, 4]]
    >>> result = injective_tetrahedra(X, T, range(4), 2.0 * X[:4])
    >>> result.status.name, result.certificate.injective, bool(result.quality_after.min() > 0)
    ('POLISHED', True, True)
    """

    points: FloatArray
    T: IntArray
    certificate: TetrahedraCertificate
    status: TetrahedraStatus
    obstructions: tuple[TetrahedraObstruction, ...]
    forbidden: IntArray
    sliding: IntArray
    iterations: int
    seconds: float
    energy: float
    quality_before: FloatArray
    quality_after: FloatArray
    points_before: FloatArray

    @property
    def inverted(self) -> IntArray:
        """Tetrahedra that are inverted or degenerate, ascending."""
        return np.union1d(self.certificate.inverted, self.certificate.degenerate)

    @property
    def valid(self) -> bool:
        """Whether every tetrahedron is strictly positive, verified exactly."""
        return self.certificate.positive

    @property
    def success(self) -> bool:
        """Whether the search ended and the mesh is certified injective: positive tetrahedra, no point covered twice."""
        return bool(self.certificate.injective) and self.status is not TetrahedraStatus.INTERRUPTED

    @property
    def n_iterations(self) -> int:
        """Newton steps; equal to ``iterations``."""
        return self.iterations

    def summary(self) -> str:
        """Describe the outcome, the certificate, the obstructions and the quality."""
        lines = [self.status.value, self.certificate.summary()]
        if self.forbidden.size:
            which = names_of("tetrahedron", "tetrahedra", self.forbidden)
            lines.append(f"Inverted or degenerate with four fixed vertices: {which}. Move these vertices less.")
        lines += [obstruction.text for obstruction in self.obstructions[:5]]
        return "\n".join([*lines, self.describe_quality()])

    def short_repr(self) -> str:
        """Return the first line of `summary`."""
        return self.message

    def describe_quality(self) -> str:
        """Return a sentence on the quality before and after, and where to remesh if it has become poor."""
        return describe_qualities("tetrahedron", self.T, self.points, self.quality_before, self.quality_after)

    def plot(self) -> Figure:
        """Draw a cut through the mesh before and after, coloured by quality, and histograms of the quality.

        The cut is through the worst tetrahedron of the mesh after, normal to the shortest side of its bounding box.

        Returns
        -------
        matplotlib Figure
            Inverted tetrahedra are red. Notebooks display the figure directly.
        """
        return self._draw("quality")

    def to_dict(self) -> dict[str, Any]:
        """Return the result for JSON."""
        return {
            **super().to_dict(),
            **as_plain(self, "valid", "forbidden"),
            "obstructions": [{"text": o.text, "vertices": list(o.vertices)} for o in self.obstructions],
            "iterations": self.iterations,
            "energy": self.energy if np.isfinite(self.energy) else None,
            **summarise_qualities(self.quality_before, self.quality_after),
        }


def describe_qualities(what: str, F: IntArray, points: FloatArray, before: FloatArray, after: FloatArray) -> str:
    """Return a sentence on the qualities of elements before and after, and where to remesh if they have become poor."""
    if not len(after):
        return "no elements"
    worst = int(after.argmin())
    text = (
        f"{what.capitalize()} quality, 1 at best: worst {before.min():.3g} before and {after[worst]:.3g} "
        f"after ({what} {worst}), mean {before.mean():.3g} before and {after.mean():.3g} after."
    )
    if after[worst] < before.min() / 10:
        place = ", ".join(f"{x:.4g}" for x in points[F[worst]].mean(axis=0))
        text += f" Remesh around ({place}): the worst quality has fallen below a tenth of that before."
    return text


def summarise_qualities(before: FloatArray, after: FloatArray) -> dict[str, dict[str, float]]:
    """Return the minimum, the mean and the worst element of qualities before and after, for JSON."""
    return {
        name: {"minimum": float(quality.min()), "mean": float(quality.mean()), "worst": int(quality.argmin())}
        for name, quality in (("quality_before", before), ("quality_after", after))
    }


def tetrahedron_quality(T: IntArray, X: FloatArray) -> FloatArray:
    """Return the mean ratio of tetrahedra: 1 if regular, 0 without volume, negative if inverted; (t,) float64.

    This is ``12 (3 V)^(2/3) / Σ l²`` with the volume V and the edge lengths l.
    """
    p = X[T] - X[T[:, :1]]
    size = np.abs(p).max(axis=(1, 2))
    p /= np.where(size > 0, size, 1.0)[:, None, None]
    u, v, w = p[:, 1], p[:, 2], p[:, 3]
    volume = (u * np.cross(v, w)).sum(axis=1) / 6
    squares = sum(((p[:, i] - p[:, j]) ** 2).sum(axis=1) for i, j in EDGES)
    ratio = 12 * np.cbrt(3 * np.abs(volume)) ** 2 / np.where(squares > 0, squares, 1.0)
    return np.asarray(np.sign(volume) * ratio)


def find_obstructions(
    T: IntArray, X: FloatArray, fixed: BoolArray, boundary: IntArray | None, sign: SignArray
) -> tuple[TetrahedraObstruction, ...]:
    """Find obstructions to a valid mesh with the fixed vertices at their positions in ``X``.

    ``boundary`` (b, 3) are the boundary triangles if all their vertices are fixed and they do not cross, otherwise
    None. ``sign`` (t,) are the orientations at ``X``, which limit where to look for a free vertex without a position.
    """
    whole = np.flatnonzero(fixed[T].all(axis=1) & (sign <= 0))[:_MAX_LISTED]
    found = [
        TetrahedraObstruction(
            f"Tetrahedron {k} is {'inverted' if sign[k] < 0 else 'degenerate'}, and its four vertices are fixed.",
            tuple(T[k].tolist()),
        )
        for k in whole.tolist()
    ]
    edges = find_mesh_edges(T)
    equal = edges[fixed[edges].all(axis=1) & (X[edges[:, 0]] == X[edges[:, 1]]).all(axis=1)]
    for a, b in equal[:_MAX_LISTED].tolist():
        found.append(TetrahedraObstruction(f"Both ends of the edge {a}–{b} are fixed at one position.", (a, b)))
    if boundary is not None:
        sides = np.sort(boundary[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        n = len(X)
        inner = fixed[edges].all(axis=1) & ~np.isin(edges[:, 0] * n + edges[:, 1], sides[:, 0] * n + sides[:, 1])
        edges = edges[inner]
        for edge, triangle in edges_meeting_triangles(edges, boundary, X)[:_MAX_LISTED]:
            a, b = edges[edge].tolist()
            found.append(
                TetrahedraObstruction(
                    f"The inner edge {a}–{b} between fixed vertices meets the boundary triangle "
                    f"{tuple(boundary[triangle].tolist())}.",
                    (a, b),
                )
            )
    bad = T[sign <= 0]
    for vertex in np.unique(bad[~fixed[bad]])[: 50 * _MAX_LISTED].tolist():
        if len(found) >= 3 * _MAX_LISTED:
            break
        reason = _find_empty_kernel(T[(vertex == T).any(axis=1)], X, fixed, vertex)
        if reason is not None:
            found.append(reason)
    return tuple(found)


def _find_empty_kernel(T: IntArray, X: FloatArray, fixed: BoolArray, vertex: int) -> TetrahedraObstruction | None:
    """Decide whether a free vertex has no position for which all its tetrahedra with three fixed vertices are positive.

    By Helly's theorem, open half-spaces have no common point if and only if four of them have none. A linear programme
    in floating point finds candidates, and rational numbers decide.
    """
    from scipy.optimize import linprog

    T = T[(fixed[T] | (vertex == T)).all(axis=1)]
    if len(T) < 2:
        return None
    planes = [_half_space(X[row], row.tolist().index(vertex)) for row in T]
    unit = []
    for normal, offset in planes:
        longest = max(map(abs, normal))
        if not longest:
            return TetrahedraObstruction(f"A face opposite free vertex {vertex} is degenerate.", (vertex,))
        unit.append([float(x / longest) for x in (*normal, offset)])
    A = np.array(unit)
    # Largest s with normal · x − s |normal| ≥ offset.
    length = np.linalg.norm(A[:, :3], axis=1)
    size = float(np.abs(A[:, 3]).max()) or 1.0
    b = A[:, 3] / size
    solution = linprog([0, 0, 0, -1], np.column_stack([-A[:, :3], length]), -b, bounds=[(None, None)] * 3 + [(None, 1)])
    if solution.status != 0 or solution.x[3] > 1e-9:
        return None
    weights = -np.asarray(solution.ineqlin.marginals)
    active = np.argsort(-weights)[:8]
    for count in (2, 3, 4):
        for some in combinations(active.tolist(), min(count, len(active))):
            if _has_no_common_point([planes[k] for k in some]):
                faces = ", ".join(str(tuple(v for v in T[k].tolist() if v != vertex)) for k in some)
                return TetrahedraObstruction(
                    f"Free vertex {vertex} has no position on the inner side of the fixed faces {faces}.", (vertex,)
                )
    return None


def _half_space(points: FloatArray, corner: int) -> tuple[_Vector, Fraction]:
    """The open half-space ``normal · x > offset`` in which a corner of a tetrahedron (4, 3) makes it positive."""
    a, b, c = ([Fraction(value) for value in point] for point in points[FACES[corner]].tolist())
    u, v = ([y - x for x, y in zip(a, end, strict=True)] for end in (b, c))
    # The face is counterclockwise seen from outside, so its normal is turned inwards.
    normal = [-(u[1] * v[2] - u[2] * v[1]), -(u[2] * v[0] - u[0] * v[2]), -(u[0] * v[1] - u[1] * v[0])]
    return normal, sum((x * y for x, y in zip(normal, a, strict=True)), Fraction(0))


def _has_no_common_point(planes: list[tuple[_Vector, Fraction]]) -> bool:
    """Return whether open half-spaces have no common point.

    This holds if weights y ≥ 0 with Σ y normal = 0 and Σ y offset ≥ 0 exist (Farkas). Only weights that are unique up
    to a factor are considered.
    """
    weights = _null_vector([normal for normal, _ in planes])
    if weights is None:
        return False
    if all(y <= 0 for y in weights):
        weights = [-y for y in weights]
    if any(y < 0 for y in weights):
        return False
    return sum((y * offset for y, (_, offset) in zip(weights, planes, strict=True)), Fraction(0)) >= 0


def _null_vector(normals: list[_Vector]) -> list[Fraction] | None:
    """The weights y, unique up to a factor, with Σ y normal = 0; None if there are none or several."""
    m = len(normals)
    rows = [[normals[k][axis] for k in range(m)] for axis in range(3)]
    pivots: list[int] = []
    for column in range(m):
        rank = len(pivots)
        pivot = next((i for i in range(rank, 3) if rows[i][column]), None)
        if pivot is None:
            continue
        rows[rank], rows[pivot] = rows[pivot], rows[rank]
        rows[rank] = [x / rows[rank][column] for x in rows[rank]]
        for i in range(3):
            if i != rank and rows[i][column]:
                rows[i] = [x - rows[i][column] * y for x, y in zip(rows[i], rows[rank], strict=True)]
        pivots.append(column)
    free = [column for column in range(m) if column not in pivots]
    if len(free) != 1:
        return None
    weights = [Fraction(0)] * m
    weights[free[0]] = Fraction(1)
    for i, column in enumerate(pivots):
        weights[column] = -rows[i][free[0]]
    return weights
