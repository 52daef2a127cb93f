"""The connected surfaces of a mesh, each of which is flattened alone, and their maps side by side.

A `Piece` is one of them, in a unit near its size. Its descent starts from a bijective map. `split_parts` returns all,
with their elements of the mesh.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.flattening.multilevel import flatten_coarse, map_to_disk
from quasiharmonic.apps.flattening.worst_triangles import thin_triangles
from quasiharmonic.energies.deformation import DeformationEnergy, signed_areas
from quasiharmonic.energies.energies import Energy, SymmetricDirichlet
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.geometry.exact.certificate import certify, is_injective
from quasiharmonic.geometry.mesh.reference import surface_area
from quasiharmonic.geometry.mesh.topology import components, group_by_label
from quasiharmonic.linsolve import available
from quasiharmonic.problem import Domain
from quasiharmonic.util.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    check_range,
    count_of,
    find_exponent,
    pad_to_space,
    scale_to_unit,
    to_complex,
    to_points,
)

#: Surfaces with at least this number of triangles are flattened with coarse meshes.
COARSE_FROM = 50_000
# Space between two components, relative to the largest side of all.
_GAP = 0.05


class Piece:
    """A connected surface that can be flattened, in a unit near its size.

    Raises ValueError as `Domain`, or if the surface has handles or a triangle has no area.

    Attributes
    ----------
    V : (n, 3) float64
        Positions in units of ``2 ** exponent``.
    F : (f, 3) int64
    loops : list of (l,) int64
        Boundary loops.
    exponent : int
    area : float
        Area of the surface, in square units.
    """

    def __init__(self, V: ArrayLike, F: ArrayLike) -> None:
        domain = Domain(V, F, [])
        self.F, self.loops = domain.F, domain.loops
        # Every handle lowers the Euler characteristic by two below that of a disk with as many loops.
        handles, odd = divmod(2 - len(domain.loops) - domain.euler, 2)
        if handles or odd:
            raise ValueError(
                f"the surface has {count_of('handle', 'handles', handles)} and cannot be flattened: "
                "cut it open first (cut_open; --cut of qhm map and qhm flatten)"
            )
        self.exponent = find_exponent(domain.V)
        self.V = pad_to_space(np.ldexp(domain.V, -self.exponent))
        self.area = surface_area(self.V, self.F)

    @classmethod
    def unite(cls, pieces: Sequence[Piece]) -> Piece:
        """Combine several pieces into one that is not connected, with elements in order, in the largest one's unit."""
        made = object.__new__(cls)
        first = np.cumsum([0, *(len(piece.V) for piece in pieces)])[:-1].tolist()
        made.F = np.concatenate([piece.F + k for piece, k in zip(pieces, first, strict=True)])
        made.loops = [loop + k for piece, k in zip(pieces, first, strict=True) for loop in piece.loops]
        made.exponent = max(piece.exponent for piece in pieces)
        smaller = [piece.exponent - made.exponent for piece in pieces]
        made.V = np.concatenate([np.ldexp(piece.V, down) for piece, down in zip(pieces, smaller, strict=True)])
        made.area = float(sum(np.ldexp(piece.area, 2 * down) for piece, down in zip(pieces, smaller, strict=True)))
        return made

    def planar_map(self) -> FloatArray | None:
        """Return the surface itself if it is planar and does not overlap itself, as no map is better."""
        if np.ptp(self.V[:, 2]) > 0:
            return None
        # Seen from the side on which its triangles are counterclockwise.
        uv = self.V[:, :2] * [np.sign(signed_areas(self.F, in_units(self.V[:, :2], 0)).sum()) or 1.0, 1.0]
        return uv if certify(self.F, uv, loops=self.loops).bijective else None

    def thin_planar_map(self) -> FloatArray | None:
        """Return `planar_map` if all triangles are so thin that energies are dominated by rounding errors."""
        return self.planar_map() if thin_triangles(self.V, self.F).all() else None

    def fit_scale(self, uv: FloatArray) -> FloatArray:
        """Scale a map to the surface's area; if this inverts a triangle, scale exactly by a power of two."""
        unit = scale_to_unit(uv)
        area = float(signed_areas(self.F, in_units(unit, 0)).sum())
        # The area of needles can be lost by rounding.
        factor = np.sqrt(self.area / area) if area > 0 else 1.0
        scaled = (unit - unit.mean(axis=0)) * factor
        return scaled if is_injective(self.F, scaled) else np.ldexp(unit, round(np.log2(factor)))

    def energy(self, density: Energy, weights: FloatArray | None) -> DeformationEnergy:
        """Return the energy of the piece's maps."""
        if weights is not None:
            return DeformationEnergy(self.V, self.F, density, weights=weights)
        return self._reference.with_density(density)

    @cached_property
    def _reference(self) -> DeformationEnergy:
        """An energy that knows the rest shapes of the triangles."""
        return DeformationEnergy(self.V, self.F, SymmetricDirichlet())


def check_in_range(uv: FloatArray) -> FloatArray:
    """Return a map unchanged if it is finite; otherwise raise ValueError."""
    if not np.isfinite(uv).all():
        raise ValueError("the map is outside the range of doubles (1e308): scale the surface or the pins down")
    return uv


def to_given_unit(uv: FloatArray, exponent: int) -> FloatArray:
    """Convert a map from units of ``2 ** exponent`` to the original unit; ValueError as `check_in_range`."""
    with np.errstate(over="ignore"):
        return check_in_range(np.ldexp(uv, exponent))


class InitialMap(NamedTuple):
    """A bijective map (n, 2) that has the surface's area, and its mean energy.

    ``linear_solver`` is that of the descents from here.
    """

    uv: FloatArray
    energy: float
    name: str
    linear_solver: str


def list_initial_maps(
    piece: Piece, measure: DeformationEnergy, linear_solver: str, used: Callable[[], str]
) -> Iterator[InitialMap]:
    """Yield the initial maps that exist, the most promising first; each is computed on demand.

    ``used`` returns the solver of the last descent. The last map is made with another one.
    """
    begun = set[tuple[str, float]]()
    for name, solver, compute in _list_methods(piece, linear_solver, used):
        uv = compute()
        if uv is None:
            continue
        uv = piece.fit_scale(uv)
        energy = measure.value(in_units(uv, 0))
        if (solver, energy) in begun:
            # The coarse mesh of a small surface is the surface itself.
            continue
        begun.add((solver, energy))
        yield InitialMap(uv, energy, name, solver)


def _list_methods(
    piece: Piece, solver: str, used: Callable[[], str]
) -> Iterator[tuple[str, str, Callable[[], FloatArray | None]]]:
    """Yield name, linear solver and function of each method. The function returns a bijective map or None."""
    surface = piece.V, piece.F, piece.loops
    disk = "disk", solver, partial(map_to_disk, *surface, solver)
    large = len(piece.F) >= COARSE_FROM
    yield "as it lies", solver, piece.planar_map
    if not large:
        yield disk
    yield "coarse mesh", solver, partial(flatten_coarse, *surface, solver)
    yield "coarse mesh, guarded", solver, partial(flatten_coarse, *surface, solver, guarded=True)
    if large:
        yield disk
    for other in [name for name in available() if name != used()][:1]:
        yield f"coarse mesh, {other}", other, partial(flatten_coarse, *surface, other)


class Part(NamedTuple):
    """A connected surface of a mesh, and the mesh's indices of its vertices (n,), ascending, and triangles (f,).

    The piece has its own numbering.
    """

    piece: Piece
    vertices: IntArray
    triangles: IntArray

    @property
    def loops(self) -> list[IntArray]:
        """Boundary loops, in the mesh's numbering."""
        return [self.vertices[loop] for loop in self.piece.loops]


def split_parts(V: FloatArray, F: IntArray, kept: BoolArray | None = None) -> list[Part]:
    """Return the connected surfaces of a mesh, the one with most triangles first; ValueError as `Piece`.

    ``kept`` (n,) are the vertices of the mesh, by default all; triangles use no others.
    """
    everything = np.arange(len(V)), np.arange(len(F))
    if V.ndim != 2 or F.ndim != 2 or F.shape[1] != 3 or not F.size:
        return [Part(Piece(V, F), *everything)]
    check_range("F", F, len(V))
    label = components(F, len(V))
    used = np.bincount(F.ravel(), minlength=len(V)) > 0
    # `Piece` reports vertices without triangles together with other errors.
    if kept is not None and not used[kept].all():
        return [_make_part(V, F, np.flatnonzero(kept), everything[1])]
    if not label.any() or (kept is None and not used.all()):
        return [Part(Piece(V, F), *everything)]
    # Both lists have the same order, because every used vertex has a triangle.
    groups = zip(group_by_label(np.where(used, label, -1)), group_by_label(label[F[:, 0]]), strict=True)
    return [_make_part(V, F, *own) for own in sorted(groups, key=lambda own: -len(own[1]))]


def _make_part(V: FloatArray, F: IntArray, vertices: IntArray, triangles: IntArray) -> Part:
    try:
        return Part(Piece(V[vertices], np.searchsorted(vertices, F[triangles])), vertices, triangles)
    except ValueError as error:
        raise ValueError(f"{name_part(vertices)}: {error}") from None


def name_part(vertices: IntArray) -> str:
    """Name a part in messages that use the part's own numbering."""
    return f"the piece around vertex {vertices[0]}, with its own numbering"


def unite_parts(parts: Sequence[Part]) -> Part:
    """Combine several parts into one, with their elements in order."""
    return Part(
        Piece.unite([part.piece for part in parts]),
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.triangles for part in parts]),
    )


def align_with_axis(F: IntArray, uv: FloatArray) -> FloatArray:
    """Rotate a map (n, 2) so that its principal axis is the x axis, with its bounding box at the origin.

    The map is of about unit size, and the axis is that of the image's moments of inertia. The longer tail of the
    image's area points to the right. The result has new rounding errors.
    """
    w = to_complex(uv)
    area = signed_areas(F, w)
    corners = w[F]
    middle = corners.mean(axis=1)
    centre = (area * middle).sum() / area.sum()
    # Second moment of a triangle about a point, from its corners c and centroid m: area/12 (Σ c² + 9 m²).
    spread = (area * (((corners - centre) ** 2).sum(axis=1) + 9 * (middle - centre) ** 2)).sum()
    turned = (w - centre) * np.exp(-0.5j * np.angle(spread)) if abs(spread) > 0 else w - centre
    along = turned[F].mean(axis=1).real
    if (area * along**3).sum() < 0:
        turned = -turned
    aligned = to_points(turned)
    return aligned - aligned.min(axis=0)


def place_in_row(parts: Sequence[FloatArray], gap: float = 0.0) -> list[FloatArray]:
    """Shift maps (n, 2) whose bounding boxes start at the origin so that they stand in a row.

    The space between them is ``gap``, but at least a fixed fraction of the largest side of all. Raises ValueError if
    the row exceeds the range of doubles.
    """
    gap = max(gap, _GAP * max(float(part.max()) for part in parts))
    shifted, right = [], 0.0
    with np.errstate(over="ignore"):
        for part in parts:
            shifted.append(part + np.array([right, 0.0]))
            right = float(shifted[-1][:, 0].max()) + gap
    return [check_in_range(positions) for positions in shifted]


def fit_unit_square(uv: FloatArray) -> FloatArray:
    """Scale a map uniformly, and centre it in the unit square."""
    low, high = uv.min(axis=0), uv.max(axis=0)
    size = float((high - low).max())
    return 0.5 + (uv - low - 0.5 * (high - low)) / size
