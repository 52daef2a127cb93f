"""Reference triangles, in which gradients are computed (§9.3, §F.1), and the operators of §6.2 from these gradients.

Whether an injective map exists depends on the connectivity of the triangles and not on their shapes. So the triangle in
which ``G`` and ``m`` are computed is a free choice. Each reference triangle has its own frame, with vertex 0 at
the origin and vertex 1 on the positive x axis, written as complex numbers::

                 z₂
                 ╱╲          γᵢ = gradient of the hat function of vertex i, as gₓ + i·g_y
               ╱    ╲        p = ∂u/∂z, q = ∂u/∂z̄ of the complex map u + iv on the triangle
             ╱        ╲      m = area
        z₀ ──────────── z₁

*Rest triangles* are laid into the plane to measure the distortion of a map. A `ReferenceMesh` may choose its triangles;
rest triangles are always the triangles of the mesh. They have no sign, because a
planar mesh counts as a surface seen from the side on which its triangles are counterclockwise. So the image of a
triangle is inverted exactly if the certificate lists it as inverted.

The `Operators` are sparse matrices. The solver assembles from the triangles (§F.1) and does not use them. They relate
its formulas to those of the paper, and the energy of second derivatives is made of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.util.arrays import (
    ComplexArray,
    FloatArray,
    IntArray,
    check_range,
    find_exponent,
    own_triangles,
    pad_to_space,
    reject,
    vertex_array,
)
from quasiharmonic.util.kernels import compiled

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Reference = Literal["equilateral", "rest", "corrected"]
# Coordinates of vectors: (d, k), or d arrays (k,).
Coordinates = FloatArray | list[FloatArray]


def rest_frames(V: FloatArray, F: NDArray[np.integer]) -> tuple[FloatArray, ComplexArray]:
    """Isometrically map every triangle of a mesh to a frame in the plane, with vertex 0 at the origin.

    Returns vertex 1 (f,) float64, which is on the real axis, and vertex 2 (f,) complex128. The imaginary part of vertex
    2 is signed for planar meshes and non-negative for curved ones.
    """
    return _frames(V, F)[:2]


def flat_triangles(V: FloatArray, F: NDArray[np.integer]) -> IntArray:
    """Ascending indices (k,) of the triangles with zero area, as computed by `rest_frames`."""
    z1, z2, flat = _frames(V, F)
    return np.flatnonzero((z1 == 0) | (z2.imag == 0)) if flat else np.empty(0, dtype=np.int64)


def _frames(V: FloatArray, F: NDArray[np.integer]) -> tuple[FloatArray, ComplexArray, int]:
    """Return the frames of `rest_frames` and the number of triangles with zero area."""
    T = own_triangles(F)
    check_range("F", T, len(V))
    # Scale by a power of two near the size of the mesh, so that products neither overflow nor underflow.
    exponent = math.frexp(max(V.max(initial=0), -V.min(initial=0)))[1]
    z1, z2 = np.empty(len(T)), np.empty(len(T), dtype=np.complex128)
    return z1, z2, lay_flat(V, T, exponent, z1, z2)


@compiled
def lay_flat(V: FloatArray, F: IntArray, exponent: int, z1: FloatArray, z2: ComplexArray) -> int:
    """Fill in the frames (f,) of `rest_frames`, computed in units of 2^exponent; return the number of zero areas."""
    coordinates = np.ldexp(V.T, -exponent, order="C")
    for part in blocks(len(F)):
        z1[part], z2.real[part], z2.imag[part] = _lay_each_flat(coordinates, F[part])
    np.ldexp(z1, exponent, out=z1)
    np.ldexp(z2.view(np.float64), exponent, out=z2.view(np.float64))
    return int(np.count_nonzero((z1 == 0) | (z2.imag == 0)))


def _lay_each_flat(coordinates: FloatArray, F: NDArray[np.integer]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Vertex 1 on the axis, and both coordinates of vertex 2, in each triangle's frame; (f,) each."""
    corners = [along.take(F) for along in coordinates]
    e1 = [corner[:, 1] - corner[:, 0] for corner in corners]
    e2 = [corner[:, 2] - corner[:, 0] for corner in corners]
    length = np.sqrt(dot(e1, e1))
    divisor = np.where(length > 0, length, 1.0)
    normal = [e1[i] * e2[j] - e1[j] * e2[i] for i, j in ((0, 1), (1, 2), (2, 0))[: 1 if len(e1) == 2 else 3]]
    across = normal[0] if len(normal) == 1 else np.sqrt(dot(normal, normal))
    # If vertices 0 and 1 coincide, the direction is arbitrary.
    along = np.where(length > 0, dot(e1, e2), np.sqrt(dot(e2, e2)))
    return length, along / divisor, across / divisor


def dot(a: Coordinates, b: Coordinates) -> FloatArray:
    """Scalar products (k,) of vectors given by their coordinates, (d, k) or a list of d arrays."""
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total += x * y
    return total


def cross(a: Coordinates, b: Coordinates) -> FloatArray:
    """Cross products (3, k) of vectors given by their coordinates, (3, k) or lists of 3 arrays.

    For many vectors, this is several times as fast as `numpy.cross` by rows, and has the same rounding.
    """
    return np.stack([a[k - 2] * b[k - 1] - a[k - 1] * b[k - 2] for k in range(3)])


def blocks(count: int) -> Iterator[slice]:
    """Yield slices of consecutive triangles, small enough for their intermediate arrays to stay in the cache.

    Formulas with many steps take half the time if all steps are computed for one block before the next.
    """
    # Triangles in a block: a complex array of one block takes 128 KiB, so about 12 of them fit into a core's cache.
    block = 8192
    return (slice(start, start + block) for start in range(0, count, block))


class ReferenceMesh:
    """Intrinsic gradient and area of every triangle of a mesh.

    Parameters
    ----------
    V : (n, 2) or (n, 3) float64
        Rest positions.
    F : (f, 3) int
        Triangles.
    kind : {"equilateral", "rest", "corrected"}
        Shape of the reference triangles. ``"rest"``: the triangles of ``V``. ``"equilateral"``: all equilateral; ``V``
        is used only for its length. ``"corrected"``: as in ``V``, with angles below π/6 raised to π/6 and all three
        scaled to sum to π. Every angle is then at least π/8 (§F.1).

    Attributes
    ----------
    m : (f,) float64
        Areas. Equilateral and corrected triangles have an arbitrary scale, which cancels in all of
        the functionals.
    gamma : (3, f) complex128
        Gradients of the hat functions. For equilateral triangles this is a broadcast view with stride 0,
        which saves memory.
    half_gamma : (2, f) complex128
        Half the gradients of the last two corners. The gradients of all three corners sum to zero.
    stiffness_by_entry : (9, f) float64
        Coefficients of a11, a12, a22 of the tensor in the stiffness of each edge, edge by edge.
    """

    def __init__(self, V: FloatArray, F: IntArray, kind: Reference) -> None:
        self.kind = kind
        self.F = F = own_triangles(F)
        self.n = len(V)
        if kind == "equilateral":
            check_range("F", F, self.n)
            m, gamma, per_entry = _equilateral()
        else:
            z1, z2 = rest_frames(V, F)
            if kind == "corrected":
                z1, z2 = _correct(z1, z2)
            m, gamma, per_entry = _tables(z1, z2)
        f = len(F)
        self.m: FloatArray = np.broadcast_to(m, (f,))
        self.gamma: ComplexArray = np.broadcast_to(gamma, (3, f))
        self.half_gamma: ComplexArray = np.broadcast_to(0.5 * gamma[1:], (2, f))
        self.stiffness_by_entry: FloatArray = np.broadcast_to(per_entry.reshape(9, -1), (9, f))

    def edge_stiffness(self, a: FloatArray) -> FloatArray:
        """Off-diagonal entries (3, f) of every triangle's ``Gᵀ A G``, for the edges (0,1), (1,2), (2,0).

        ``a`` (3, f) has the rows a11, a12, a22 of the tensor without its area factor, ``A₍ⱼ₎ = mⱼ 𝒜ⱼ``.
        """
        return np.einsum("eaf,af->ef", self.stiffness_by_entry.reshape(3, 3, -1), a)

    def derivatives(self, w: ComplexArray) -> Derivatives:
        """Differentiate a complex map (n,) on every triangle."""
        if w.shape != (self.n,):
            raise ValueError(f"w must have shape ({self.n},), one position for each vertex, not {w.shape}")
        f = len(self.F)
        p, q, area = np.empty(f, dtype=np.complex128), np.empty(f, dtype=np.complex128), np.empty(f)
        wirtinger(w, self.F, self.half_gamma, p, q, area)
        return Derivatives(p, q, area)


@compiled
def wirtinger(
    w: ComplexArray, F: IntArray, half_gamma: ComplexArray, p: ComplexArray, q: ComplexArray, area: FloatArray
) -> None:
    """Fill in ``∂w/∂z``, ``∂w/∂z̄`` and signed areas of a map (n,); half_gamma (2, f) is for the last two corners."""
    corners = w.take(F)
    d1, d2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    g1, g2 = half_gamma
    area[:] = 0.5 * (d1.conj() * d2).imag
    p[:] = d1 * g1.conj() + d2 * g2.conj()
    q[:] = d1 * g1 + d2 * g2


class Derivatives(NamedTuple):
    """Wirtinger derivatives of a complex map, one value per triangle.

    ``det J = |p|² - |q|²``, the singular values are ``|p| ± |q|`` in absolute value, and the
    Beltrami coefficient of the map is ``q / p``.

    Attributes
    ----------
    p, q : (f,) complex128
        ``∂w/∂z`` and ``∂w/∂z̄`` in the reference triangle's frame.
    area : (f,) float64
        Signed areas of the images, ``m det J``, computed from the images alone.
    """

    p: ComplexArray
    q: ComplexArray
    area: FloatArray


@cache
def _equilateral() -> tuple[FloatArray, ComplexArray, FloatArray]:
    return _tables(np.ones(1), np.array([0.5 + np.sqrt(0.75) * 1j]))


def _tables(z1: FloatArray, z2: ComplexArray) -> tuple[FloatArray, ComplexArray, FloatArray]:
    """Areas (f,), gradients of the hat functions (3, f), and edge stiffness per entry of the tensor (3, 3, f)."""
    opposite = np.stack([z2 - z1, -z2, z1 + 0j])
    m = 0.5 * z1 * z2.imag
    # Stiffness of the three edges (0,1), (1,2), (2,0), linear in the tensor's (a11, a12, a22): m ∇hᵢᵀ 𝒜 ∇hⱼ. It does
    # not depend on the scale of the triangle.
    gx, gy = (1j * opposite).real, (1j * opposite).imag
    gx1, gy1 = np.roll(gx, -1, axis=0), np.roll(gy, -1, axis=0)
    per_entry = np.stack([gx * gx1, gx * gy1 + gy * gx1, gy * gy1], axis=1) / (4 * m)
    return m, 1j * opposite / (2 * m), per_entry


def _correct(z1: FloatArray, z2: ComplexArray) -> tuple[FloatArray, ComplexArray]:
    """The corrected triangles of §F.1, with side 0-1 of unit length."""

    def angle(at: ComplexArray, to: ComplexArray) -> FloatArray:
        turn = np.conj(at) * to
        # Adding zero turns -0 into 0, so that the angle between coincident points is 0 and not π.
        return np.arctan2(np.abs(turn.imag), turn.real + 0.0)

    base = z1.astype(np.complex128)
    angles = np.stack([angle(base, z2), angle(z2 - base, -base), angle(-z2, base - z2)])
    angles = np.maximum(angles, np.pi / 6)
    angles *= np.pi / angles.sum(axis=0)
    # Sine rule: |z2| / sin(angle at 1) = |z1| / sin(angle at 2).
    return np.ones_like(z1), np.sin(angles[1]) / np.sin(angles[2]) * np.exp(1j * angles[0])


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
        remedy = "remove them with clean, or use unwrap, which excludes them"
        reject(self.flat, "triangle", "triangles", f"{{}} of zero area in the rest mesh: {reason}; {remedy}")

    def half_gradients(self) -> ComplexArray:
        """Half the gradients ``γᵢ/2`` of the hat functions (3, f) in inverse units; NaN for triangles without area.

        ``∂w/∂z = Σ conj(gᵢ) wᵢ`` and ``∂w/∂z̄ = Σ gᵢ wᵢ``.
        """
        m = np.where(self.m > 0, self.m, np.nan)
        return 0.25j * self.sides[(1, 2, 0), :] / m


def area_vectors(V: FloatArray, F: NDArray[np.integer]) -> FloatArray:
    """Return a normal (f, 3) of each triangle F (f, 3) between points V (n, 3); its length is twice the area."""
    # For rows, this is several times as fast as indexing.
    a, b, c = (V.take(corner, axis=0) for corner in F.T)
    return cross((b - a).T, (c - a).T).T


def surface_area(V: FloatArray, F: NDArray[np.integer]) -> float:
    """Return the area of triangles F (f, 3) between points V (n, 3)."""
    return 0.5 * float(np.linalg.norm(area_vectors(V, F), axis=1).sum())


def loop_lengths(V: FloatArray, loop: IntArray) -> FloatArray:
    """Return the lengths (l,) of the edges of a loop of vertices, from each one to the next."""
    return np.asarray(np.linalg.norm(V[np.roll(loop, -1)] - V[loop], axis=1))


def corner_angles(sides: ComplexArray) -> FloatArray:
    """Return the angles (f, 3) in radians of triangles that are given by their sides (3, f), as in `RestShapes`."""
    return np.stack([np.abs(np.angle(-sides[k - 1].conj() * sides[k])) for k in range(3)], axis=1)


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


@dataclass(frozen=True)
class Operators:
    """Discrete operators of a mesh (Table 1).

    Attributes
    ----------
    G : (2f, n) sparse
        Intrinsic gradient: f rows of x derivatives, then f rows of y derivatives.
    m : (f,) float64
        Triangle areas.
    D : (n, n) sparse, antisymmetric
        Circular boundary gradient (eq. 15 with the signs of §A.1): ``uᵀ D v`` is the signed area.
    R, S : (n, k) and (n, n - k) sparse
        Selection of the boundary and of the interior vertices.
    C : (k, k) sparse
        ``Rᵀ D R`` (eq. 16).
    """

    G: csr_array
    m: FloatArray
    D: csr_array
    R: csr_array
    S: csr_array
    C: csr_array

    def laplacian(self, a: FloatArray | None = None) -> csr_array:
        """``Gᵀ A G`` for a tensor field; the cotangent Laplacian by default.

        ``a`` (f, 3) has the entries a11, a12, a22 of ``mⱼ⁻¹ A₍ⱼ₎`` by triangle.
        """
        from scipy.sparse import csr_array, diags

        if a is None:
            a = np.tile([1.0, 0.0, 1.0], (self.m.size, 1))
        a11, a12, a22 = (csr_array(diags(self.m * entry)) for entry in a.T)
        f = self.m.size
        Gx, Gy = self.G[:f], self.G[f:]
        return csr_array(Gx.T @ (a11 @ Gx + a12 @ Gy) + Gy.T @ (a12 @ Gx + a22 @ Gy))


def operators(V: NDArray[np.floating], F: NDArray[np.integer], reference: Reference = "rest") -> Operators:
    """Build the operators of a mesh; ``reference`` selects the triangles of gradients and areas."""
    from scipy.sparse import csr_array, vstack

    triangles = own_triangles(F)
    mesh = ReferenceMesh(np.asarray(V, dtype=np.float64), triangles, reference)
    f, n = len(triangles), len(V)
    shape, offsets = (f, n), np.arange(0, 3 * f + 1, 3)
    Gx, Gy = (
        csr_array((part.T.ravel(), triangles.ravel(), offsets), shape=shape)
        for part in (mesh.gamma.real, mesh.gamma.imag)
    )
    edge = boundary_edges(triangles, n)
    half = csr_array((np.full(len(edge), 0.5), (edge[:, 0], edge[:, 1])), shape=(n, n))
    D = csr_array(half - half.T)
    boundary = np.unique(edge)
    R = _selection(boundary, n)
    S = _selection(np.setdiff1d(np.arange(n), boundary), n)
    return Operators(csr_array(vstack([Gx, Gy])), np.array(mesh.m), D, R, S, csr_array(R.T @ D @ R))


def _selection(rows: NDArray[np.integer], n: int) -> csr_array:
    from scipy.sparse import csr_array

    return csr_array((np.ones(rows.size), (rows, np.arange(rows.size))), shape=(n, rows.size))
