"""Connected surfaces of a mesh: split the mesh, align their maps and place these side by side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from quasiharmonic.apps.flattening.piece import Piece, check_in_range
from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.geometry.mesh.topology import components, group_by_label
from quasiharmonic.util.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    check_range,
    to_complex,
    to_points,
)


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


# Space between two components, relative to the largest side of all.
_GAP = 0.05


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
