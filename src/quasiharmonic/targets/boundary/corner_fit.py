"""Match the corners of a boundary, found by angle, to the corners of its contour."""

from __future__ import annotations

import numpy as np

from quasiharmonic.targets.boundary.correspondence import arc
from quasiharmonic.targets.boundary.turning import BoundaryLoop, mean_turns
from quasiharmonic.targets.outlines.contours import as_complex, corners, turns
from quasiharmonic.util.arrays import FloatArray

# Maximum loss of similarity, relative to the best value (2 at most), that is accepted for an upright map.
_AS_GOOD = 0.1


def pins_by_angle(
    loop: BoundaryLoop, flat: FloatArray, contour: FloatArray, corner_angle: float
) -> list[tuple[int, float]]:
    """Find as many corners of a boundary loop as a contour has, and assign them to the contour's corners.

    The corners keep their cyclic order, so only the first one must be chosen. Turning angles and the lengths between
    corners determine it: convex corners go to convex ones, long sides to long ones. If several choices are about
    equally good, as for a square, the one with the least rotation is taken.

    Parameters
    ----------
    loop : BoundaryLoop
    flat : (l, 2) float64
        The loop projected to the plane.
    contour : (k, 2) float64
        Of about unit size.
    corner_angle : float
        Minimum turning angle of the contour's corners in degrees.

    Returns
    -------
    list of (int, float)
        Positions in the loop and parameters from 0 to 1 along the contour, in order around; empty for a contour without
        corners.

    Raises
    ------
    ValueError
        When the loop has fewer vertices than the contour has corners.
    """
    sharp = corners(contour, corner_angle)
    if not sharp.size:
        return []
    positions, turning = loop.corners(len(sharp))
    sides = np.linalg.norm(np.roll(contour, -1, axis=0) - contour, axis=1)
    ends = arc(contour)[sharp]
    lengths = np.cumsum(loop.lengths / loop.lengths.max())
    runs = lengths[positions - 1] / lengths[-1]
    alike = _likeness(turning + 0j, mean_turns(sides, turns(contour), sharp) + 0j)
    alike += _likeness(_gaps(runs) + 0j, _gaps(ends) + 0j)
    seen, goal = as_complex(flat[positions]), as_complex(contour[sharp])
    upright = _likeness(seen - seen.mean(), goal - goal.mean())
    first = int(np.argmax(np.where(alike >= alike.max() - _AS_GOOD, upright, -np.inf)))
    return list(zip(np.roll(positions, -first).tolist(), ends.tolist(), strict=True))


def _gaps(along: FloatArray) -> FloatArray:
    """Distances from each of some parameters on a closed curve of length 1 to the next."""
    return np.asarray((np.roll(along, -1) - along) % 1.0)


def _likeness(one: np.ndarray, other: np.ndarray) -> FloatArray:
    """Correlation of two cyclic complex sequences, for each cyclic shift of the first; at most 1."""
    size = np.linalg.norm(one) * np.linalg.norm(other)
    return np.array([np.vdot(other, np.roll(one, -k)).real for k in range(len(one))]) / (size or 1.0)
