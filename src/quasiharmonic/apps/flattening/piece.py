"""One connected surface that is flattened, in a unit near its size, and the bijective maps from which it descends."""

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
from quasiharmonic.linsolve import available
from quasiharmonic.problem import Domain
from quasiharmonic.util.arrays import FloatArray, count_of, find_exponent, pad_to_space, scale_to_unit


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


#: Surfaces with at least this number of triangles are flattened with coarse meshes.
COARSE_FROM = 50_000


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
