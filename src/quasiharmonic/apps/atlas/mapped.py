"""Apply an operation to each island of a mesh, and collect the results."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quasiharmonic.apps.atlas.verdict import MIRROR, AtlasVerdict, certify, mirrored_islands
from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.geometry.mesh.seams import Island, SeamedMesh, which_island
from quasiharmonic.geometry.mesh.surface import manifold_edges
from quasiharmonic.problem.result import MapResult, Status
from quasiharmonic.util.arrays import FloatArray, IntArray

# The status of an atlas is the first of these that one of its islands has; without any, that of the first island.
_FURTHEST_LAST = (
    Status.INTERRUPTED,
    Status.IMPOSSIBLE,
    Status.TOO_MANY_SPLITS,
    Status.PRECISION_LIMIT,
    Status.OUT_OF_ITERATIONS,
    Status.COLLAPSED,
    Status.STILL_FALLING,
    Status.EXHAUSTED,
)


@dataclass(frozen=True, eq=False)
class MappedIsland:
    """The result for one island.

    Attributes
    ----------
    triangles : (k,) int64
        Triangles of the island, as indices of the mesh, ascending.
    mirrored : bool
        Whether the island is mirrored. If so, ``result`` belongs to its reflection about the v axis.
    result : MapResult
        The result, in the island's own numbering.
    """

    triangles: IntArray
    mirrored: bool
    result: MapResult

    def to_dict(self) -> dict[str, Any]:
        """The result for JSON."""
        return {
            "first_triangle": int(self.triangles[0]),
            "triangles": len(self.triangles),
            "mirrored": self.mirrored,
            **self.result.to_dict(),
        }


@dataclass(frozen=True, eq=False)
class MappedAtlas:
    """A map with seams and the results of its islands.

    Attributes
    ----------
    mesh : SeamedMesh
        The surface with its new positions.
    islands : tuple of MappedIsland
        Results in the order of each island's first triangle. After Ctrl-C the remaining islands are not listed and
        keep their positions.
    """

    mesh: SeamedMesh
    islands: tuple[MappedIsland, ...]

    @property
    def injective(self) -> bool:
        """Whether every island is injective, or mirrored and injective (certified)."""
        return all(island.result.injective for island in self.islands)

    @property
    def status(self) -> Status:
        """The status of the island that made the least progress."""
        found = [island.result.status for island in self.islands]
        return next((status for status in _FURTHEST_LAST if status in found), found[0])

    def places(self) -> list[FloatArray]:
        """Return the vertex positions of every island, in the order of its result."""
        done = [one.result.uv * MIRROR if one.mirrored else one.result.uv for one in self.islands]
        return [*done, *(island.uv for island in self.mesh.islands[len(done) :])]

    def verdict(self) -> AtlasVerdict:
        """Return the exact verdict on the stored positions."""
        return certify(self.mesh)

    def to_dict(self) -> dict[str, Any]:
        """The results for JSON: with one island its result, otherwise totals and the list of islands."""
        results = [island.result for island in self.islands]
        if len(results) == 1:
            return results[0].to_dict()
        return {
            "injective": self.injective,
            "status": self.status.name.lower(),
            "message": self.status.value,
            "iterations": sum(result.iterations for result in results),
            "seconds": sum(result.seconds for result in results),
            "linear_solver": results[0].linear_solver,
            "islands": [island.to_dict() for island in self.islands],
        }


def each_island(mesh: SeamedMesh, lower: Callable[[Island], MapResult], *, reflect: bool = True) -> MappedAtlas:
    """Apply an operation to each island of a mesh.

    Parameters
    ----------
    mesh : SeamedMesh
        A mesh; without seams it must be a manifold surface.
    lower : callable
        Called with each island. Its result has a position for every vertex of the island, and may have further
        vertices at the end.
    reflect : bool
        If there are several islands, pass mirrored ones as their reflection, and reflect the result, so that they stay
        mirrored. A single mirrored island is treated as inverted.

    Returns
    -------
    MappedAtlas
        After Ctrl-C the remaining islands keep their positions.

    Raises
    ------
    ValueError
        If the mesh is not a surface or has no island, or ``lower`` rejects an island; the message names it.
    KeyboardInterrupt
        If Ctrl-C comes before every island has a position.
    """
    islands = faced(mesh, reflect=reflect)
    done: list[MappedIsland] = []
    places = [island.uv for island in mesh.islands]
    for k, (island, mirrored) in enumerate(islands):
        if done and done[-1].result.status is Status.INTERRUPTED:
            if np.isnan(island.uv).any():
                raise KeyboardInterrupt
            continue
        with naming(island, len(islands)):
            result = lower(island)
        # A refined island has further vertices at the end.
        places[k] = (result.uv * MIRROR if mirrored else result.uv)[: len(island.vertices)]
        done.append(MappedIsland(island.triangles, mirrored, result))
    return MappedAtlas(mesh.with_places(places), tuple(done))


def faced(mesh: SeamedMesh, *, reflect: bool = True) -> list[tuple[Island, bool]]:
    """Return the islands of a mesh, mirrored ones as their reflection, and whether each was reflected.

    Raises
    ------
    ValueError
        As `each_island`, if the mesh is not a surface or has no island.
    """
    if mesh.seamless:
        # A mesh without seams must be a surface: without this check it would silently split at non-manifold edges.
        manifold_edges(mesh.F, len(mesh.V))
    islands = mesh.islands
    if not islands:
        raise ValueError("the mesh has no triangles" if not len(mesh.F) else "no triangle has texture coordinates")
    mirrored = mirrored_islands(mesh) if reflect else [False] * len(islands)
    return [
        (replace(island, uv=island.uv * MIRROR) if turned else island, turned)
        for island, turned in zip(islands, mirrored, strict=True)
    ]


@contextmanager
def naming(island: Island, count: int) -> Iterator[None]:
    """Name the island in a ValueError if there are several islands."""
    try:
        yield
    except ValueError as error:
        if count == 1:
            raise
        raise ValueError(f"the {which_island(island.triangles)}, with its own numbering: {error}") from None


def in_place_of(island: Island, uv: FloatArray) -> FloatArray:
    """Rotate, scale and shift an island's map (m, 2) to the island's old direction, area and position.

    If rounding would invert a triangle, the map is returned unchanged.
    """
    before, after = (np.ascontiguousarray(w).view(np.complex128).ravel() for w in (island.uv, uv))
    centre, middle = before.mean(), after.mean()
    turn = np.vdot(after - middle, before - centre)
    area = [abs(float(signed_areas(island.F, w).sum())) for w in (before, after)]
    scale = np.sqrt(area[0] / area[1]) * (turn / abs(turn) if turn else 1.0)
    placed = ((after - middle) * scale + centre).view(np.float64).reshape(-1, 2)
    return placed if is_injective(island.F, placed) else uv
