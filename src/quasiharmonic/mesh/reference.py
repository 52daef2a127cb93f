"""Reference triangles: the shapes in which gradients are taken (§9.3, §F.1).

Whether an injective map exists depends on how the triangles are joined, not on their shapes, so the
triangle in which ``G`` and ``m`` are computed may be chosen. Each reference triangle lies in a frame
of its own: vertex 0 at the origin and vertex 1 on the positive x axis, written as complex numbers.

                 z₂
                 ╱╲          γᵢ = gradient of the hat function of vertex i, as gₓ + i·g_y
               ╱    ╲        p = ∂u/∂z, q = ∂u/∂z̄ of the complex map u + iv on the triangle
             ╱        ╲      m = area
        z₀ ──────────── z₁
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

Reference = Literal["equilateral", "rest", "corrected"]
FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def rest_frames(V: FloatArray, F: NDArray[np.integer]) -> tuple[FloatArray, ComplexArray]:
    """Lay every triangle of a mesh into the plane.

    Parameters
    ----------
    V : (n, 2) or (n, 3) float64
        Vertices of a planar or a curved mesh.
    F : (f, 3) int
        Triangles.

    Returns
    -------
    z1 : (f,) float64
        Vertex 1, on the real axis (vertex 0 is the origin).
    z2 : (f,) complex128
        Vertex 2. Its imaginary part is signed for planar meshes and not negative for curved ones.
    """
    # In units near the mesh's own, a power of two, so that products neither overflow nor vanish.
    exponent = int(np.frexp(np.max(np.abs(V)))[1])
    V = np.ldexp(V, -exponent)
    origin = V[F[:, 0]]
    e1, e2 = V[F[:, 1]] - origin, V[F[:, 2]] - origin
    length = np.sqrt(np.einsum("ij,ij->i", e1, e1))
    safe = np.where(length > 0, length, 1.0)
    along = np.einsum("ij,ij->i", e1, e2) / safe
    if V.shape[1] == 2:
        across = (e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]) / safe
    else:
        normal = np.cross(e1, e2)
        across = np.sqrt(np.einsum("ij,ij->i", normal, normal)) / safe
    # Vertices 0 and 1 coincide: any direction is as good as another.
    apart = np.where(length > 0, 0.0, np.sqrt(np.einsum("ij,ij->i", e2, e2)))
    z2 = np.stack([along + apart, across], axis=1)
    return np.ldexp(length, exponent), np.ldexp(z2, exponent).view(np.complex128).ravel()


class ReferenceMesh:
    """Intrinsic gradient and area of every triangle of a mesh.

    Parameters
    ----------
    V : (n, 2) or (n, 3) float64
        Rest positions.
    F : (f, 3) int
        Triangles.
    kind : {"equilateral", "rest", "corrected"}
        The triangles' shape. ``"rest"``: as they lie in ``V``. ``"equilateral"``: all alike, ``V`` is
        not looked at. ``"corrected"``: as in ``V``, but angles below π/6 raised to π/6 and the three
        scaled to sum to π, so that none stays below π/8 (§F.1).

    Attributes
    ----------
    m : (f,) float64
        Areas. Equilateral and corrected triangles have an arbitrary scale (which cancels in all of
        the functionals).
    gamma : (3, f) complex128
        Gradients of the hat functions. For equilateral triangles these arrays are one number seen
        f times (stride 0), which keeps them out of memory.
    """

    def __init__(self, V: FloatArray, F: NDArray[np.integer], kind: Reference) -> None:
        self.kind = kind
        self.F = F
        self.n = len(V)
        if kind == "equilateral":
            z1, z2 = np.ones(1), np.array([0.5 + np.sqrt(0.75) * 1j])
        else:
            z1, z2 = rest_frames(V, F)
            if kind == "corrected":
                z1, z2 = _corrected(z1, z2)
        opposite = np.stack([z2 - z1, -z2, z1 + 0j])
        f = len(F)
        m = 0.5 * z1 * z2.imag
        self.m: FloatArray = np.broadcast_to(m, (f,))
        self.gamma: ComplexArray = np.broadcast_to(1j * opposite / (2 * m), (3, f))
        # Stiffness of the three edges (0,1), (1,2), (2,0), linear in the tensor's (a11, a12, a22):
        # m ∇hᵢᵀ 𝒜 ∇hⱼ. It has no scale, so tiny and huge triangles are on a par.
        gx, gy = (1j * opposite).real, (1j * opposite).imag
        gx1, gy1 = np.roll(gx, -1, axis=0), np.roll(gy, -1, axis=0)
        per_entry = np.stack([gx * gx1, gx * gy1 + gy * gx1, gy * gy1], axis=1) / (4 * m)
        self._edge_stiffness = np.broadcast_to(per_entry, (3, 3, f))

    def edge_stiffness(self, a: FloatArray) -> FloatArray:
        """Off-diagonal entries of every triangle's ``Gᵀ A G``.

        Parameters
        ----------
        a : (3, f) float64
            Rows a11, a12, a22 of the tensor without its area factor, ``A₍ⱼ₎ = mⱼ 𝒜ⱼ``.

        Returns
        -------
        (3, f) float64
            For the edges (0,1), (1,2), (2,0) of each triangle.
        """
        return np.einsum("eaf,af->ef", self._edge_stiffness, a)

    def derivatives(self, w: ComplexArray) -> Derivatives:
        """Differentiate a complex map ``w = u + i v`` (n,) complex128 on every triangle."""
        w0 = w[self.F[:, 0]]
        d1, d2 = w[self.F[:, 1]] - w0, w[self.F[:, 2]] - w0
        g1, g2 = 0.5 * self.gamma[1], 0.5 * self.gamma[2]
        area = 0.5 * (d1.real * d2.imag - d1.imag * d2.real)
        return Derivatives(d1 * g1.conj() + d2 * g2.conj(), d1 * g1 + d2 * g2, area)


class Derivatives(NamedTuple):
    """Wirtinger derivatives of a complex map, by triangle.

    ``det J = |p|² - |q|²``, the singular values are ``|p| ± |q|`` in absolute value, and the map's own
    Beltrami coefficient is ``q / p``.

    Attributes
    ----------
    p, q : (f,) complex128
        ``∂w/∂z`` and ``∂w/∂z̄`` in the reference triangle's frame.
    area : (f,) float64
        Signed areas of the images, ``m det J`` computed from the images alone.
    """

    p: ComplexArray
    q: ComplexArray
    area: FloatArray


def _corrected(z1: FloatArray, z2: ComplexArray) -> tuple[FloatArray, ComplexArray]:
    """The triangles of §F.1, with side 0-1 of unit length."""

    def angle(at: ComplexArray, to: ComplexArray) -> FloatArray:
        turn = np.conj(at) * to
        # Adding zero turns -0 into 0: between coincident points the angle is 0, not π.
        return np.arctan2(np.abs(turn.imag), turn.real + 0.0)

    base = z1.astype(np.complex128)
    angles = np.stack([angle(base, z2), angle(z2 - base, -base), angle(-z2, base - z2)])
    angles = np.maximum(angles, np.pi / 6)
    angles *= np.pi / angles.sum(axis=0)
    # Sine rule: |z2| / sin(angle at 1) = |z1| / sin(angle at 2).
    return np.ones_like(z1), np.sin(angles[1]) / np.sin(angles[2]) * np.exp(1j * angles[0])
