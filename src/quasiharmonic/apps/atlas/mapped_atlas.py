"""Apply an operation to each island of a mesh, and combine the results into one mesh."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from quasiharmonic.apps.atlas.atlas_verdict import MIRROR, AtlasVerdict, IslandReport, certify, mirrored_islands
from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.geometry.exact import certificate
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.geometry.mesh.splitting import Refined
from quasiharmonic.geometry.mesh.topology import manifold_edges
from quasiharmonic.io import MeshData, refined_mesh
from quasiharmonic.io.seamed_mesh import Island, SeamedMesh, which_island
from quasiharmonic.problem.result import MapResult, Status
from quasiharmonic.util.arrays import FloatArray, names_of, to_complex
from quasiharmonic.util.outcome import Outcome


@dataclass(frozen=True, eq=False)
class MappedIsland(IslandReport):
    """The result for one island.

    Attributes
    ----------
    triangles : (k,) int64
        Triangles of the island, as indices of the mesh, ascending.
    mirrored : bool
        Whether the island is mirrored. If so, ``result`` belongs to its reflection about the v axis.
    result : MapResult
        The result, in the island's own numbering.

    See Also
    --------
    atlas.MappedAtlas : Lists them as ``islands``.

    Examples
    --------
    >>> from quasiharmonic import atlas
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(4)
    >>> (island,) = atlas.flatten(atlas.SeamedMesh(V, F)).islands
    >>> island.mirrored, island.result.status.name
    (False, 'POLISHED')
    """

    result: MapResult

    def to_dict(self) -> dict[str, Any]:
        """The result for JSON."""
        return {**super().to_dict(), **self.result.to_dict()}


@dataclass(frozen=True, eq=False, repr=False)
class MappedAtlas(Outcome):
    """A map with seams and the results of its islands.

    Attributes
    ----------
    mesh : SeamedMesh
        The surface with its new positions.
    islands : tuple of MappedIsland
        Results in the order of each island's first triangle. After Ctrl-C the remaining islands are not listed and
        keep their positions.

    See Also
    --------
    atlas.flatten : Makes it.
    atlas.polish : Makes it.
    atlas.harmonise : Makes it.
    atlas.injective_map : Makes it.
    atlas.certify : The verdict on its mesh.

    Examples
    --------
    >>> from quasiharmonic import atlas
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(4)
    >>> mapped = atlas.flatten(atlas.SeamedMesh(V, F))
    >>> mapped.status.name, mapped.mesh.uv.shape
    ('POLISHED', (61, 2))
    """

    mesh: SeamedMesh
    islands: tuple[MappedIsland, ...]

    @property
    def injective(self) -> bool:
        """Whether every island is injective, or mirrored and injective (certified)."""
        return all(island.result.injective for island in self.islands)

    @property
    def success(self) -> bool:
        """Whether the results of all islands are successes; False if the call was interrupted."""
        return len(self.islands) == len(self.mesh.islands) and all(island.result.success for island in self.islands)

    @cached_property
    def certificate(self) -> AtlasVerdict:
        """The exact verdict on the stored positions of all islands."""
        return certify(self.mesh)

    @property
    def n_iterations(self) -> int:
        """Iterations over all islands."""
        return sum(island.result.n_iterations for island in self.islands)

    @property
    def seconds(self) -> float:
        """Wall time over all islands."""
        return sum(island.result.seconds for island in self.islands)

    @property
    def linear_solver(self) -> str:
        """The linear solver of the first island that was mapped; empty if none was."""
        return next((name for island in self.islands if (name := island.result.linear_solver)), "")

    @property
    def status(self) -> Status:
        """The status of the island that made the least progress."""
        return Status.most_severe(island.result.status for island in self.islands)

    @property
    def message(self) -> str:
        """The message of the status, with the number of islands that have it if others have another one."""
        status, count = self.status, len(self.islands)
        share = sum(island.result.status is status for island in self.islands)
        # Ctrl-C ends the work on all islands, and if the status is INJECTIVE, all islands are injective.
        if share == count or status in (Status.INTERRUPTED, Status.INJECTIVE):
            return super().message
        return f"Worst outcome, on {share} of {count} islands: {super().message}"

    def places(self) -> list[FloatArray]:
        """Return the vertex positions of every island, in the order of its result."""
        done = [one.result.uv * MIRROR if one.mirrored else one.result.uv for one in self.islands]
        return [*done, *(island.uv for island in self.mesh.islands[len(done) :])]

    def verdict(self) -> AtlasVerdict:
        """Return the exact verdict on the stored positions; equal to `certificate`."""
        return self.certificate

    def to_dict(self) -> dict[str, Any]:
        """The results for JSON: with one island its result, otherwise totals and the list of islands."""
        results = [island.result for island in self.islands]
        if len(results) == 1:
            return results[0].to_dict()
        return {
            **super().to_dict(),
            "injective": self.injective,
            "linear_solver": self.linear_solver,
            "islands": [island.to_dict() for island in self.islands],
        }


def each_island(
    mesh: SeamedMesh,
    lower: Callable[[Island], MapResult],
    *,
    reflect: bool = True,
    only: Collection[int] | None = None,
) -> MappedAtlas:
    """Apply an operation to each island of a mesh; without seams it must be a manifold surface.

    ``lower`` maps an island to a result with a position for every vertex of it, and perhaps further vertices at the
    end. With ``reflect``, mirrored ones of several islands are passed as their reflection and stay mirrored. A single
    mirrored island is treated as inverted. Islands whose indices are not in ``only`` keep their positions. After Ctrl-C
    the remaining islands keep their positions, and so does an injective island whose new map is not injective yet;
    KeyboardInterrupt is raised if the remaining ones have no positions. ValueError as `orient_islands`, if an index in
    ``only`` has no island, or if ``lower`` rejects an island; the message names it.
    """
    islands = orient_islands(mesh, reflect=reflect)
    chosen = check_island_choice(mesh, only)
    done: list[MappedIsland] = []
    places = [island.uv for island in mesh.islands]
    for k, (island, mirrored) in enumerate(islands):
        if done and done[-1].result.status is Status.INTERRUPTED:
            if np.isnan(island.uv).any():
                raise KeyboardInterrupt
            continue
        if k in chosen:
            with name_island(island, len(islands)):
                result = lower(island)
            if result.status is Status.INTERRUPTED and not result.injective and is_injective(island.F, island.uv):
                result = replace(_keep(island), status=Status.INTERRUPTED)
        else:
            result = _keep(island)
        # A refined island has further vertices at the end.
        places[k] = (result.uv * MIRROR if mirrored else result.uv)[: len(island.vertices)]
        done.append(MappedIsland(island.triangles, mirrored, result))
    return MappedAtlas(mesh.with_places(places), tuple(done))


def check_island_choice(mesh: SeamedMesh, only: Collection[int] | None) -> Collection[int]:
    """Return the indices of the chosen islands, by default of all; ValueError if one does not exist or is not mapped.

    Islands that are not chosen need positions.
    """
    count = len(mesh.islands)
    if only is None:
        return range(count)
    absent = np.setdiff1d(list(only), np.arange(count))
    if not only:
        raise ValueError("no island is chosen: name at least one")
    if absent.size:
        raise ValueError(f"there is no {names_of('island', 'islands', absent)}: the mesh has {count}, from 0")
    bare = np.array([k for k, island in enumerate(mesh.islands) if k not in only and np.isnan(island.uv).any()])
    if bare.size:
        raise ValueError(f"{names_of('island', 'islands', bare)} without texture coordinates: choose them, too")
    return frozenset(only)


def _keep(island: Island) -> MapResult:
    """Return the current map of an island as a result."""
    found = certificate.certify(island.F, island.uv)
    return MapResult(uv=island.uv, status=Status.INJECTIVE if found.injective else Status.STALLED, certificate=found)


def orient_islands(mesh: SeamedMesh, *, reflect: bool = True) -> list[tuple[Island, bool]]:
    """Return the islands of a mesh, mirrored ones as their reflection, and whether each was reflected.

    Raises ValueError if the mesh is not a surface or has no island.
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
def name_island(island: Island, count: int) -> Iterator[None]:
    """Name the island in a ValueError if there are several islands."""
    try:
        yield
    except ValueError as error:
        if count == 1:
            raise
        raise ValueError(f"the {which_island(island.triangles)}, with its own numbering: {error}") from None


def fit_in_place(island: Island, uv: FloatArray) -> FloatArray:
    """Rotate, scale and shift an island's map (m, 2) to the island's old direction, area and position.

    If rounding would invert a triangle, the map is returned unchanged.
    """
    before, after = (to_complex(w) for w in (island.uv, uv))
    centre, middle = before.mean(), after.mean()
    turn = np.vdot(after - middle, before - centre)
    area = [abs(float(signed_areas(island.F, w).sum())) for w in (before, after)]
    scale = np.sqrt(area[0] / area[1]) * (turn / abs(turn) if turn else 1.0)
    placed = ((after - middle) * scale + centre).view(np.float64).reshape(-1, 2)
    return placed if is_injective(island.F, placed) else uv


def merge_refined(
    mesh: MeshData, islands: Sequence[Island], refined: Sequence[Refined | None], places: Sequence[FloatArray]
) -> MeshData:
    """Transfer refinements of islands and their positions to the mesh data that contains them.

    Each refinement splits only interior edges, or is None for an unchanged island. ``places`` has the positions of each
    island's vertices, including new ones. Old vertices keep their indices, and new ones follow. The parts of a triangle
    take its place in the order.
    """
    n, dimension = mesh.V.shape
    V, F, FT, parent = [mesh.V], [], [], []
    parents, weights = [np.empty((0, 3), dtype=np.int64)], [np.empty((0, 3))]
    rows = 0
    for island, fine, uv in zip(islands, refined, places, strict=True):
        origin, own, of = island.vertices, island.F, island.triangles
        if fine is not None:
            added, k = fine.parents.shape
            origin = np.concatenate([origin, n + np.arange(added)])
            own, of = fine.F, of[fine.parent]
            V.append(fine.V[len(island.vertices) :, :dimension])
            # Vertices have two or three parents; padded parents have weight zero.
            pad = (0, 0), (0, 3 - k)
            parents.append(np.pad(island.vertices[fine.parents], pad, mode="edge"))
            weights.append(np.pad(fine.weights, pad))
            n += added
        F.append(origin[own])
        FT.append(own + rows)
        parent.append(of)
        rows += len(uv)
    together = Refined(
        np.concatenate(V), np.concatenate(F), np.concatenate(parent), np.concatenate(parents), np.concatenate(weights)
    )
    # The zeros are placeholders for positions, replaced below.
    new, _ = refined_mesh(mesh, together, np.zeros((len(mesh.V), 2)))
    order = np.argsort(together.parent, kind="stable")
    return new.with_places(SeamedMesh(new.V, new.F, np.concatenate(FT)[order], np.concatenate(places)))
