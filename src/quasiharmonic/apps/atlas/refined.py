"""A file whose islands were refined, each on its own: one mesh again."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quasiharmonic.geometry.mesh.refinement import Refined
from quasiharmonic.geometry.mesh.seams import Island, SeamedMesh
from quasiharmonic.io import MeshData, refined_mesh
from quasiharmonic.util.arrays import FloatArray


def written_over(
    mesh: MeshData, islands: Sequence[Island], refined: Sequence[Refined | None], places: Sequence[FloatArray]
) -> MeshData:
    """Carry refinements of islands and their places over to the file that they are of.

    Parameters
    ----------
    mesh : MeshData
    islands : sequence of Island
        All islands of the mesh, by its numbers.
    refined : sequence of (Refined or None)
        What became of each; only inner edges were split. None where nothing was.
    places : sequence of (m_i, 2) float64
        For each island, where its vertices are, the new ones included.

    Returns
    -------
    MeshData
        Vertices keep their numbers, new ones follow; the parts of a triangle stand where it stood.
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
            # Two parents or three; what is repeated has no share.
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
    # The places take the place of these zeros.
    new, _ = refined_mesh(mesh, together, np.zeros((len(mesh.V), 2)))
    order = np.argsort(together.parent, kind="stable")
    return new.with_places(SeamedMesh(new.V, new.F, np.concatenate(FT)[order], np.concatenate(places)))
