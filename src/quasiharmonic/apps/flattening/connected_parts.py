"""Split a mesh into its connected surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from quasiharmonic.apps.flattening.piece import Piece
from quasiharmonic.geometry.mesh.topology import components
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, check_range, invert_indices


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
    of_triangle = label[F[:, 0]]
    labels, count = np.unique(of_triangle, return_counts=True)
    return [
        _make_part(V, F, np.flatnonzero(label == own), np.flatnonzero(of_triangle == own))
        for own in labels[np.argsort(-count, kind="stable")].tolist()
    ]


def _make_part(V: FloatArray, F: IntArray, vertices: IntArray, triangles: IntArray) -> Part:
    try:
        return Part(Piece(V[vertices], invert_indices(len(V), vertices)[F[triangles]]), vertices, triangles)
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
