"""What is done to the islands of a mesh, one after another, and what came out."""

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

# An atlas is as far as the island that comes first here; of others, as the first one.
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
    """What became of an island.

    Attributes
    ----------
    triangles : (k,) int64
        Its triangles of the mesh, ascending.
    mirrored : bool
        Whether it was, and is, mirrored; the result then is of its reflection at the v axis.
    result : MapResult
        By the island's own numbers.
    """

    triangles: IntArray
    mirrored: bool
    result: MapResult

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "first_triangle": int(self.triangles[0]),
            "triangles": len(self.triangles),
            "mirrored": self.mirrored,
            **self.result.to_dict(),
        }


@dataclass(frozen=True, eq=False)
class MappedAtlas:
    """A map with seams, island by island.

    Attributes
    ----------
    mesh : SeamedMesh
        The surface with its new places.
    islands : tuple of MappedIsland
        By their first triangle. Those that Ctrl-C came before are not there, and are where they were.
    """

    mesh: SeamedMesh
    islands: tuple[MappedIsland, ...]

    @property
    def injective(self) -> bool:
        """Whether every island is injective, or mirrored and injective (certified)."""
        return all(island.result.injective for island in self.islands)

    @property
    def status(self) -> Status:
        """That of the island which went least far."""
        found = [island.result.status for island in self.islands]
        return next((status for status in _FURTHEST_LAST if status in found), found[0])

    def places(self) -> list[FloatArray]:
        """For each island, where its vertices are, in the order in which its result has them."""
        done = [one.result.uv * MIRROR if one.mirrored else one.result.uv for one in self.islands]
        return [*done, *(island.uv for island in self.mesh.islands[len(done) :])]

    def verdict(self) -> AtlasVerdict:
        """The exact verdict on the places as they are stored."""
        return certify(self.mesh)

    def to_dict(self) -> dict[str, Any]:
        """For JSON; of one island its result, of several their sums and the islands."""
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
    """Do something to each island of a mesh.

    Parameters
    ----------
    mesh : SeamedMesh
        A surface, if it has no seams; those in it may be anything else's edges.
    lower : callable
        Called with each island; its result has a place for every vertex of it, and may have further ones at the end.
    reflect : bool
        Of several islands, hand those that are mirrored over as their reflection, and reflect what comes out: they stay
        mirrored. A single one that is mirrored is inverted, and nobody's purpose.

    Returns
    -------
    MappedAtlas
        Ctrl-C ends it, and what is not yet done stays where it was.

    Raises
    ------
    ValueError
        When the mesh is none, or ``lower`` refuses an island; the message says which.
    KeyboardInterrupt
        When Ctrl-C comes before an island has a place.
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
        # A refinement of the island has further vertices, at the end.
        places[k] = (result.uv * MIRROR if mirrored else result.uv)[: len(island.vertices)]
        done.append(MappedIsland(island.triangles, mirrored, result))
    return MappedAtlas(mesh.with_places(places), tuple(done))


def faced(mesh: SeamedMesh, *, reflect: bool = True) -> list[tuple[Island, bool]]:
    """The islands of a mesh as `each_island` hands them over, and whether each is the reflection of a mirrored one.

    Raises
    ------
    ValueError
        As `each_island` for a mesh that is none.
    """
    if mesh.seamless:
        # What is no surface comes apart where it is none, which nobody has asked for.
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
    """Say of which island a ValueError speaks, where there are several."""
    try:
        yield
    except ValueError as error:
        if count == 1:
            raise
        raise ValueError(f"the {which_island(island.triangles)}, with its own numbering: {error}") from None


def in_place_of(island: Island, uv: FloatArray) -> FloatArray:
    """A map (m, 2) of an island, turned, scaled to its area and shifted to where the island was.

    Where rounding would invert a triangle it is left as it is.
    """
    before, after = (np.ascontiguousarray(w).view(np.complex128).ravel() for w in (island.uv, uv))
    centre, middle = before.mean(), after.mean()
    turn = np.vdot(after - middle, before - centre)
    area = [abs(float(signed_areas(island.F, w).sum())) for w in (before, after)]
    scale = np.sqrt(area[0] / area[1]) * (turn / abs(turn) if turn else 1.0)
    placed = ((after - middle) * scale + centre).view(np.float64).reshape(-1, 2)
    return placed if is_injective(island.F, placed) else uv
