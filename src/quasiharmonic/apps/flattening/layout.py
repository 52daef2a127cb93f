"""Where a flat map lies on the sheet: turned to its principal axis, its corner at the origin, several side by side."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.util.arrays import FloatArray, IntArray

# The space between two components, as a share of the largest side of all.
_GAP = 0.05


def laid_along_axis(F: IntArray, uv: FloatArray) -> FloatArray:
    """A map turned such that its principal axis is the x axis, its bounding box at the origin.

    The axis is that of the image's moments of inertia. Of its two senses the one is taken in which the image is
    skewed to the left: of its area, the longer tail points to the right.

    Parameters
    ----------
    F : (f, 3) int64
    uv : (n, 2) float64
        A map with positive triangles, of about unit size.

    Returns
    -------
    (n, 2) float64
        The same turned and shifted, and so rounded anew.
    """
    w = np.ascontiguousarray(uv).view(np.complex128).ravel()
    area = signed_areas(F, w)
    corners = w[F]
    middle = corners.mean(axis=1)
    centre = (area * middle).sum() / area.sum()
    # Second moments of a triangle about a point, by its corners c and its middle m: area/12 (Σ c² + 9 m²).
    spread = (area * (((corners - centre) ** 2).sum(axis=1) + 9 * (middle - centre) ** 2)).sum()
    turned = (w - centre) * np.exp(-0.5j * np.angle(spread)) if abs(spread) > 0 else w - centre
    along = turned[F].mean(axis=1).real
    if (area * along**3).sum() < 0:
        turned = -turned
    laid = turned.view(np.float64).reshape(-1, 2)
    return laid - laid.min(axis=0)


def side_by_side(parts: Sequence[FloatArray], gap: float = 0.0) -> list[FloatArray]:
    """Shift maps (n, 2) whose bounding boxes begin at the origin such that they stand in a row.

    Between them there is a share of the largest side of all, or ``gap`` if that is more.

    Raises
    ------
    ValueError
        When they are so large that the row leaves the numbers' range.
    """
    gap = max(gap, _GAP * max(float(part.max()) for part in parts))
    shifted, right = [], 0.0
    with np.errstate(over="ignore"):
        for part in parts:
            shifted.append(part + np.array([right, 0.0]))
            right = float(shifted[-1][:, 0].max()) + gap
    return [in_range(places) for places in shifted]


def in_range(uv: FloatArray) -> FloatArray:
    """A map as it is.

    Raises
    ------
    ValueError
        When positions have left the numbers' range.
    """
    if not np.isfinite(uv).all():
        raise ValueError("the map is outside the range of doubles (1e308): scale the surface or the pins down")
    return uv


def in_given_unit(uv: FloatArray, exponent: int) -> FloatArray:
    """A map in units of ``2 ** exponent`` in the unit that all was given in.

    Raises
    ------
    ValueError
        As `in_range`.
    """
    with np.errstate(over="ignore"):
        return in_range(np.ldexp(uv, exponent))


def in_unit_square(uv: FloatArray) -> FloatArray:
    """A map scaled evenly, and shifted, into the middle of the unit square."""
    low, high = uv.min(axis=0), uv.max(axis=0)
    size = float((high - low).max())
    return 0.5 + (uv - low - 0.5 * (high - low)) / size
