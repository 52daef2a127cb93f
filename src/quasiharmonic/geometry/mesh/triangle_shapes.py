"""Rest triangles of a surface, laid into the plane to measure the distortion of a map.

A `ReferenceMesh` may choose its triangles; these are always the triangles of the mesh. They have no sign, because a
planar mesh counts as a surface seen from the side on which its triangles are counterclockwise. So the image of a
triangle is inverted exactly if the certificate lists it as inverted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.geometry.mesh.reference import rest_frames
from quasiharmonic.util.arrays import ComplexArray, FloatArray, find_exponent, names_of, pad_to_space, vertex_array


@dataclass(frozen=True, eq=False)
class RestShapes:
    """Triangles laid into the plane counterclockwise, vertex 0 at 0 and vertex 1 on the positive x axis.

    Attributes
    ----------
    unit : float
        Unit of length: a power of two near the size of the mesh, so that areas and their inverses neither
        overflow nor underflow.
    sides : (3, f) complex128
        Sides from vertex 0 to 1, 1 to 2 and 2 to 0, in units.
    m : (f,) float64
        Areas in square units.
    """

    unit: float
    sides: ComplexArray
    m: FloatArray

    @property
    def flat(self) -> NDArray[np.int64]:
        """Ascending indices of the triangles whose area is zero in floating point."""
        return np.flatnonzero(~(self.m > 0))

    def check_areas(self, reason: str) -> None:
        """Raise a ValueError with the triangles of zero area and the reason why areas are needed, if there are any."""
        flat = self.flat
        if flat.size:
            raise ValueError(f"{names_of('triangle', 'triangles', flat)} of zero area in the rest mesh: {reason}")

    def half_gradients(self) -> ComplexArray:
        """Half the gradients ``γᵢ/2`` of the hat functions (3, f) in inverse units; NaN for triangles without area.

        ``∂w/∂z = Σ conj(gᵢ) wᵢ`` and ``∂w/∂z̄ = Σ gᵢ wᵢ``.
        """
        m = np.where(self.m > 0, self.m, np.nan)
        return 0.25j * self.sides[(1, 2, 0), :] / m


def rest_shapes(V: ArrayLike, F: NDArray[np.integer], *, lowest: float = 0.0) -> RestShapes:
    """Lay the triangles of a planar or curved mesh into the plane.

    ``lowest`` is the minimum height as a fraction of the longest side; lower triangles are raised to this height.
    """
    positions = vertex_array(V, finite=False)
    exponent = find_exponent(positions) - 1
    z1, z2 = rest_frames(pad_to_space(np.ldexp(positions, -exponent)), F)
    if lowest:
        longest = np.maximum(np.maximum(z1, np.abs(z2)), np.abs(z2 - z1))
        z1 = np.where(z1 > 0, z1, longest)
        z2.imag = np.maximum(z2.imag, lowest * longest**2 / np.where(z1 > 0, z1, 1.0))
    return RestShapes(float(np.ldexp(1.0, exponent)), np.stack([z1 + 0j, z2 - z1, -z2]), 0.5 * z1 * z2.imag)
