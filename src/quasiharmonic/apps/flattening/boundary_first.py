"""Nearly conformal maps of disks that keep the lengths of boundary edges: boundary first flattening [1]_.

A conformal map multiplies lengths by eʷ. With the cotangent Laplacian L and the curvature K, ``L w = -K`` at interior
vertices. The map keeps lengths at the boundary if ``w = 0`` there. The flux ``L w`` at the boundary changes its turning
angles. They and the lengths give the boundary's image, a polygon. It is closed by the smallest change of lengths. The
harmonic map of the interior then needs the same factor of L. So the map takes one factorisation with one unknown per
vertex, as an embedding in a disk does, but its energy is much smaller. A few triangles can be inverted where the
Laplacian has negative weights or the polygon is concave.

References
----------
.. [1] R. Sawhney, K. Crane, Boundary first flattening. ACM Trans. Graph. 37 (2017).
"""

from __future__ import annotations

import numpy as np

from quasiharmonic.apps.flattening.piece import Piece
from quasiharmonic.energies.energies import SymmetricDirichlet
from quasiharmonic.geometry.mesh.reference import corner_angles, loop_lengths
from quasiharmonic.linsolve.laplacian import Laplacian, weigh_edges
from quasiharmonic.util.arrays import ComplexArray, FloatArray, to_points


@np.errstate(all="ignore")
def map_boundary_first(piece: Piece, linear_solver: str = "auto") -> FloatArray | None:
    """Map a disk nearly conformally and keep the lengths of its boundary edges, up to their closing to a polygon.

    Parameters
    ----------
    piece : Piece
    linear_solver : str
        A name of `quasiharmonic.linsolve`, or ``"auto"``.

    Returns
    -------
    (n, 2) float64 or None
        Triangles can be inverted, and the boundary can meet itself. None if the surface has more than one boundary
        loop, or if the numbers leave the range of doubles.

    Raises
    ------
    NotPositiveDefinite
        If the Laplacian is not positive definite because of rounding.
    """
    if len(piece.loops) != 1:
        return None
    F, n, (loop,) = piece.F, len(piece.V), piece.loops
    energy = piece.energy(SymmetricDirichlet(), None)
    # The gradients at the corners are the opposite sides, turned and scaled.
    angles = corner_angles(energy.g[(2, 0, 1), :])
    sums = np.bincount(F.ravel(), angles.ravel(), n)
    laplacian = Laplacian(F, n, loop, linear_solver).factor(weigh_edges(energy.g, energy.share))
    # The Laplacian has a constant factor, which w is divided by. The flux and the harmonic map do not depend on it.
    w = laplacian.respond((sums - 2 * np.pi).astype(np.complex128))
    turning = np.pi - sums[loop] + laplacian.flux(w)[loop].real
    image = np.zeros(n, dtype=np.complex128)
    image[loop] = close_polygon(loop_lengths(piece.V, loop), turning)
    image = laplacian.extend(image)
    return to_points(image) if np.isfinite(image).all() else None


def close_polygon(length: FloatArray, turning: FloatArray) -> ComplexArray:
    """Return the corners (l,) complex128 of a closed polygon with given turning angles and about the given lengths.

    Side k is from corner k to corner k + 1, and ``turning`` (l,) radians, with the sum 2π, is at corner k. With the
    directions t of the sides, the changes d of the lengths minimise ``Σ d² / length`` where ``Σ (length + d) t = 0``.
    The first side points along the x axis.
    """
    t = np.exp(1j * (np.cumsum(turning) - turning[0]))
    gap, twice, total = (length * t).sum(), (length * t * t).sum(), length.sum()
    # The condition gives d = -length Re(m̄ t), where total m + twice m̄ = 2 gap.
    m = 2 * (total * gap - twice * gap.conj()) / (total**2 - abs(twice) ** 2)
    closed = (length - length * (m.conj() * t).real) * t
    return np.concatenate([[0], np.cumsum(closed)[:-1]])
