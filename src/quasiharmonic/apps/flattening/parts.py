"""The connected surfaces that a mesh is made of, each a piece of its own."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from quasiharmonic.apps.flattening.piece import Piece
from quasiharmonic.geometry.mesh.topology import components
from quasiharmonic.problem.result import Status
from quasiharmonic.util.arrays import FloatArray, IntArray, check_range

# Several pieces together are as far as the one that comes first here; the status of those that have no bijective map is
# told in another way.
_FURTHEST_LAST = (
    Status.INTERRUPTED,
    Status.COLLAPSED,
    Status.STILL_FALLING,
    Status.EXHAUSTED,
    Status.POLISHED,
)


class Part(NamedTuple):
    """One of them.

    Attributes
    ----------
    piece : Piece
        Its elements numbered anew.
    vertices : (n,) int64
        The mesh's numbers of its vertices, ascending.
    triangles : (f,) int64
        Of its triangles.
    """

    piece: Piece
    vertices: IntArray
    triangles: IntArray

    @property
    def loops(self) -> list[IntArray]:
        """Its boundary loops, by the mesh's numbers."""
        return [self.vertices[loop] for loop in self.piece.loops]


def parts_of(V: FloatArray, F: IntArray) -> list[Part]:
    """The connected surfaces of a mesh, the one of most triangles first.

    Raises
    ------
    ValueError
        As `Piece`; of malformed arrays, too.
    """
    everything = np.arange(len(V)), np.arange(len(F))
    if V.ndim != 2 or F.ndim != 2 or F.shape[1] != 3 or not F.size:
        return [Part(Piece(V, F), *everything)]
    check_range("F", F, len(V))
    label = components(F, len(V))
    if not label.any() or np.bincount(F.ravel(), minlength=len(V)).min() == 0:
        # What is wrong with vertices of no triangle is said with the rest.
        return [Part(Piece(V, F), *everything)]
    of_triangle = label[F[:, 0]]
    labels, count = np.unique(of_triangle, return_counts=True)
    return [
        _part(V, F, np.flatnonzero(label == own), np.flatnonzero(of_triangle == own))
        for own in labels[np.argsort(-count, kind="stable")].tolist()
    ]


def _part(V: FloatArray, F: IntArray, vertices: IntArray, triangles: IntArray) -> Part:
    number = np.zeros(len(V), dtype=np.int64)
    number[vertices] = np.arange(vertices.size)
    try:
        return Part(Piece(V[vertices], number[F[triangles]]), vertices, triangles)
    except ValueError as error:
        raise ValueError(f"{anew(vertices)}: {error}") from None


def anew(vertices: IntArray) -> str:
    """Say which part it is that a message is of, where that has numbers of its own."""
    return f"the piece around vertex {vertices[0]}, with its own numbering"


def united(parts: Sequence[Part]) -> Part:
    """Several parts as one, its elements part after part."""
    return Part(
        Piece.united([part.piece for part in parts]),
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.triangles for part in parts]),
    )


def furthest_last(statuses: Iterable[Status]) -> Status:
    """How far several parts have come together: as far as the one that has come least far."""
    return min(statuses, key=lambda status: _FURTHEST_LAST.index(status) if status in _FURTHEST_LAST else -1)
