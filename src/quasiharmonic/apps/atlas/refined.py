"""Combine islands that were refined separately into one mesh."""

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
    """Transfer refinements of islands and their positions to the mesh data that contains them.

    Parameters
    ----------
    mesh : MeshData
    islands : sequence of Island
        All islands of the mesh.
    refined : sequence of (Refined or None)
        The refinement of each island, which splits only interior edges; None for unchanged islands.
    places : sequence of (m_i, 2) float64
        Vertex positions of each island, including new vertices.

    Returns
    -------
    MeshData
        Old vertices keep their indices, and new ones follow. The parts of a triangle take its place in the order.
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
