"""Place flat maps: along their principal axis, with the corner at the origin, and side by side."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.util.arrays import FloatArray, IntArray, to_complex, to_points

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


def check_in_range(uv: FloatArray) -> FloatArray:
    """Return a map unchanged if it is finite; otherwise raise ValueError."""
    if not np.isfinite(uv).all():
        raise ValueError("the map is outside the range of doubles (1e308): scale the surface or the pins down")
    return uv


def to_given_unit(uv: FloatArray, exponent: int) -> FloatArray:
    """Convert a map from units of ``2 ** exponent`` to the original unit; ValueError as `check_in_range`."""
    with np.errstate(over="ignore"):
        return check_in_range(np.ldexp(uv, exponent))


def fit_unit_square(uv: FloatArray) -> FloatArray:
    """Scale a map uniformly, and centre it in the unit square."""
    low, high = uv.min(axis=0), uv.max(axis=0)
    size = float((high - low).max())
    return 0.5 + (uv - low - 0.5 * (high - low)) / size
