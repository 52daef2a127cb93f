"""Initial bijective maps of one surface, from which its flattening descends."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

from quasiharmonic.apps.flattening.multilevel import flatten_coarse, map_to_disk
from quasiharmonic.apps.flattening.piece import Piece
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.linsolve import available
from quasiharmonic.util.arrays import FloatArray

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
