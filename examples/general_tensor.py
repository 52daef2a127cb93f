"""Tensors of two Beltrami coefficients
=======================================

Proposition D.2's ``s`` along the boundary, for Tutte's embedding and an injective map. It is negative exactly where a
boundary triangle is inverted (red). The solver does not use these tensors.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csc_array, csr_array, diags

from common import panels, run, save, show
from quasiharmonic import Problem, boundary_loops, quasi_harmonic_map, solve
from quasiharmonic.geometry.mesh.reference import Reference, ReferenceMesh, operators
from quasiharmonic.surfaces import disk
from quasiharmonic.util.arrays import ComplexArray, FloatArray, names_of

# This example is theory for study; the solver uses none of it. The figure shows Proposition D.2's ``s`` along the
# boundary of a disk, for Tutte's embedding onto a star and for an injective map. It is negative exactly where the
# triangle at the boundary edge is inverted. The injective map is also the conjugate quasi-harmonic map of tensors with
# random determinants.
#
# For any elliptic A, the equations ``∇·(A∇u) = 0`` and ``∇v = * A ∇u`` are one complex Beltrami equation for
# ``f = u + i v``
#
#     f_z̄ = μ f_z + ν conj(f_z),      |μ| + |ν| < 1,      * = [[0, −1], [1, 0]],
#
# and with ``d = |1 + ν|² − |μ|²``
#
#         1  ⎡ |1 − μ|² − |ν|²     2 Im(ν − μ)     ⎤                       1         ⎡ a22 − a11 − i (a12 + a21) ⎤
#     A = ─  ⎢                                     ⎥ ,   [μ, ν] = ──────────────── · ⎢                           ⎥
#         d  ⎣ −2 Im(ν + μ)        |1 + μ|² − |ν|² ⎦               1 + tr A + det A  ⎣ 1 − det A + i (a12 − a21) ⎦
#
# as in Astala, Iwaniec and Martin (2008, §16.1). The paper's eq. 32 has ``−2 Im μ`` in both off-diagonal entries and
# calls ν complex. This is right for real ν, which belongs to symmetric tensors (three numbers a triangle: μ and ν). For
# complex ν it keeps only the symmetric part, and the Beltrami equation fails. Determinant and eigenvalues are
#
#     det A = (|1 − ν|² − |μ|²) / (|1 + ν|² − |μ|²)
#     eigenvalues (1 + |μ| − ν) / (1 − |μ| + ν) and (1 − |μ| − ν) / (1 + |μ| + ν)       for real ν
#
# So for symmetric A the condition det A = 1 is ν = 0, and A is eq. 33.
#
# The solver uses ν = 0 alone: one complex number per triangle and the same tensor for u and for v. No map is lost by
# this (Theorem 6.4). With ν ≠ 0 the same holds for conjugate maps. Any map without inverted triangles is the conjugate
# quasi-harmonic map of *every* pair that satisfies the Beltrami equation on its triangles. So ν adds freedom that no
# map needs.
#
# The tensors are given in the frames of the reference triangles (`ReferenceMesh`), without the area factor. In a frame
# turned by φ, μ becomes ``μ e^{−2iφ}`` and ν is unchanged.


def beltrami_tensor(mu: ArrayLike, nu: ArrayLike) -> FloatArray:
    """Return the tensor A of a Beltrami pair (eq. 32, corrected for complex ν).

    Parameters
    ----------
    mu, nu : (...) complex
        The pair, with ``|μ| + |ν| < 1``, broadcast against each other.

    Returns
    -------
    (..., 2, 2) float64
        Positive definite, and symmetric where ν is real.

    Raises
    ------
    ValueError
        If ``|μ| + |ν| ≥ 1`` anywhere, because the equation is then not elliptic.
    """
    mu, nu = np.broadcast_arrays(np.asarray(mu, dtype=np.complex128), np.asarray(nu, dtype=np.complex128))
    bad = np.flatnonzero(~(np.abs(mu) + np.abs(nu) < 1))
    if bad.size:
        raise ValueError(f"|μ| + |ν| must be below 1, but is not at {names_of('entry', 'entries', bad)}")
    square = np.abs(nu) ** 2
    A = np.empty((*mu.shape, 2, 2))
    A[..., 0, 0] = np.abs(1 - mu) ** 2 - square
    A[..., 0, 1] = 2 * (nu - mu).imag
    A[..., 1, 0] = -2 * (nu + mu).imag
    A[..., 1, 1] = np.abs(1 + mu) ** 2 - square
    return A / (np.abs(1 + nu) ** 2 - np.abs(mu) ** 2)[..., None, None]


def beltrami_pair(A: ArrayLike) -> tuple[ComplexArray, ComplexArray]:
    """Return the Beltrami pair of a tensor; the inverse of `beltrami_tensor`.

    Parameters
    ----------
    A : (..., 2, 2) float
        Matrices with positive definite symmetric part.

    Returns
    -------
    mu, nu : (...) complex128
    """
    A = np.asarray(A, dtype=np.float64)
    a11, a12, a21, a22 = A[..., 0, 0], A[..., 0, 1], A[..., 1, 0], A[..., 1, 1]
    det = a11 * a22 - a12 * a21
    scale = 1 / (1 + a11 + a22 + det)
    return (a22 - a11 - 1j * (a12 + a21)) * scale, (1 - det + 1j * (a12 - a21)) * scale


def conjugate_tensor(A: ArrayLike) -> FloatArray:
    """Return the conjugate tensor ``Ā = *ᵀ A⁻¹ * = Aᵀ / det A`` (Definition 8.1), the tensor of v if A is that of u.

    Its Beltrami pair is ``(μ, −ν)``. It equals A exactly if ν = 0, that is, if A is symmetric and has unit determinant.

    Parameters
    ----------
    A : (..., 2, 2) float

    Returns
    -------
    (..., 2, 2) float64
    """
    A = np.asarray(A, dtype=np.float64)
    return np.asarray(np.swapaxes(A, -1, -2) / np.linalg.det(A)[..., None, None])


def conjugate_quasi_harmonic_map(problem: Problem, A: ArrayLike, reference: Reference = "rest") -> FloatArray:
    """Solve ``∇·(A∇u) = 0`` and ``∇·(Ā∇v) = 0`` with the problem's positions (eq. 31), in linear elements.

    This reproduces every map whose triangles satisfy the Beltrami equation of A's pair. For ν = 0 it is the
    quasi-harmonic map that the solver computes.

    Parameters
    ----------
    problem : Problem
    A : (f, 2, 2) float
        One tensor per triangle, in its reference frame.
    reference : {"rest", "equilateral", "corrected"}
        The reference triangles of A, used if the problem itself names none.

    Returns
    -------
    (n, 2) float64
        Vertex positions; fixed vertices are at their target positions.

    Raises
    ------
    ValueError
        If A has another shape or is not elliptic.
    """
    from scipy.sparse.linalg import splu

    A = _elliptic(A, len(problem.F))
    uv = np.zeros((problem.n, 2))
    uv[problem.fixed] = problem.target
    free = np.setdiff1d(np.arange(problem.n), problem.fixed)
    if free.size:
        for coordinate, tensor in enumerate((A, conjugate_tensor(A))):
            rows = _stiffness(problem, tensor, reference)[free]
            uv[free, coordinate] = splu(csc_array(rows[:, free])).solve(-(rows @ uv[:, coordinate]))
    return uv


@dataclass(frozen=True)
class Conormal:
    """The co-normal derivative of a map at the boundary, and the target's normal (Proposition D.2).

    The condition of eq. 8 is ``nᵀ [A∇u  A∇v] = s n̂ᵀ`` with some ``s > 0``: ``s`` positive and ``misalignment``
    zero. Eq. 9 is stronger: ``flux`` equal to ``normal``.

    Attributes
    ----------
    at : (k, 2) or (k,) int64
        Boundary edges, with the surface to their left, or boundary vertices.
    flux : (k,) complex128
        ``n · A∇(u + i v)`` integrated over the edge, or its weak form at the vertex: ``Gᵀ A G (u + i v)``.
    normal : (k,) complex128
        The target's outward normal times the length of the edge's image; at a vertex, the mean over its two edges.
    length : (k,) float64
        Rest length of the edge; at a vertex, the mean over its two edges.
    """

    at: NDArray[np.int64]
    flux: ComplexArray
    normal: ComplexArray
    length: FloatArray

    @property
    def s(self) -> FloatArray:
        """The component of the co-normal derivative along the unit normal n̂, zero where the image has no length."""
        size = np.abs(self.normal) * self.length
        along = (self.flux * self.normal.conj()).real
        return np.divide(along, size, out=np.zeros_like(along), where=size > 0)

    @property
    def misalignment(self) -> FloatArray:
        """The angle from n̂ to the co-normal derivative, in radians from −π to π."""
        return np.asarray(np.angle(self.flux * self.normal.conj()))


def conormal_derivative(A: ArrayLike, J: ArrayLike, n: ArrayLike) -> FloatArray:
    """Return ``nᵀ [A∇u  A∇v]`` as a vector, ``J Aᵀ n``: the left side of Proposition D.2's condition at points.

    With the tangent t counterclockwise of n and n̂ the unit normal of the image curve, clockwise of ``Jt``,

        det J = s |J t| / (nᵀ A n),      s = n̂ · J Aᵀ n.

    This is the quantitative form of the proposition. The proof's last line reads ``s n̂ᵀ n`` where it means
    ``s n̂ᵀ n̂``. It uses only the component along n̂, so ``s > 0`` suffices and alignment is not needed.

    Parameters
    ----------
    A : (..., 2, 2) float
        Tensors.
    J : (..., 2, 2) float
        Jacobians, rows ∇u and ∇v.
    n : (..., 2) float
        Outward unit normals of the domain.

    Returns
    -------
    (..., 2) float64
    """
    return np.einsum("...ij,...kj,...k->...i", np.asarray(J), np.asarray(A), np.asarray(n), dtype=np.float64)


def edge_conormal(problem: Problem, A: ArrayLike, uv: ArrayLike, reference: Reference = "rest") -> Conormal:
    """Evaluate Proposition D.2's condition on boundary edges, from the triangle at each edge.

    For every elliptic A and every map, ``s > 0`` on an edge exactly if its triangle is positive. With linear elements
    the condition constrains only this first row: the second row of triangles may be inverted behind a positive first
    row (the third failed attempt of §7.1). Theorem D.1 excludes this for smooth maps.

    Parameters
    ----------
    problem : Problem
    A : (f, 2, 2) float
        One tensor per triangle, in its reference frame.
    uv : (n, 2) float
        Any map.
    reference : {"rest", "equilateral", "corrected"}
        The reference triangles of A, used if the problem itself names none.

    Returns
    -------
    Conormal
        One row per boundary edge.

    Raises
    ------
    ValueError
        If A has another shape or is not elliptic.
    """
    A = _elliptic(A, len(problem.F))
    mesh, w = ReferenceMesh(problem.V, problem.F, problem.reference or reference), _complex(uv)
    tail, head = problem.F.T.ravel(), problem.F.T[(1, 2, 0), :].ravel()
    outer = np.flatnonzero(~np.isin(tail * problem.n + head, head * problem.n + tail))
    corner, triangle = np.divmod(outer, len(problem.F))
    # The gradient of the hat function at the opposite corner points inwards; its length is 1 / height.
    inward = mesh.gamma[(corner + 2) % 3, triangle]
    length = 2 * np.abs(mesh.m[triangle] * inward)
    n = np.stack([-inward.real, -inward.imag], axis=1) / np.abs(inward)[:, None]
    along = _complex(np.einsum("fij,fi->fj", A[triangle], n))
    p, q, _ = mesh.derivatives(w)
    flux = length * (p[triangle] * along + q[triangle] * along.conj())
    at = np.stack([tail[outer], head[outer]], axis=1)
    return Conormal(at, flux, -1j * (w[at[:, 1]] - w[at[:, 0]]), length)


def vertex_conormal(problem: Problem, A: ArrayLike, uv: ArrayLike, reference: Reference = "rest") -> Conormal:
    """Evaluate Proposition D.2's condition at boundary vertices in the weak form of §6.2: ``Rᵀ Gᵀ A G [u v]``, ``C b``.

    If the map is quasi-harmonic, ``det A = 1`` and ``flux = normal`` everywhere, the map is injective (Theorem 6.4).
    ``s > 0`` alone is not sufficient, because at a vertex positive triangles compensate for inverted ones.

    Parameters
    ----------
    problem, A, uv, reference
        As for `edge_conormal`.

    Returns
    -------
    Conormal
        One row per boundary vertex.

    Raises
    ------
    ValueError
        If A has another shape or is not elliptic.
    """
    w = _complex(uv)
    flux = _stiffness(problem, _elliptic(A, len(problem.F)), reference) @ w
    edges = edge_conormal(problem, A, uv, reference)
    at = np.unique(edges.at)
    place = np.searchsorted(at, edges.at)
    normal, length = np.zeros(at.size, dtype=np.complex128), np.zeros(at.size)
    for end in place.T:
        np.add.at(normal, end, 0.5 * edges.normal)
        np.add.at(length, end, 0.5 * edges.length)
    return Conormal(at, flux[at], normal, length)


def _stiffness(problem: Problem, A: FloatArray, reference: Reference) -> csc_array:
    """Return ``Gᵀ A G`` for tensors that may be asymmetric."""
    op = operators(problem.V, problem.F, problem.reference or reference)
    f = len(problem.F)
    Gx, Gy = op.G[:f], op.G[f:]
    a11, a12, a21, a22 = (csr_array(diags(op.m * entry)) for entry in A.reshape(f, 4).T)
    return csc_array(Gx.T @ (a11 @ Gx + a12 @ Gy) + Gy.T @ (a21 @ Gx + a22 @ Gy))


def _elliptic(A: ArrayLike, f: int) -> FloatArray:
    A = np.asarray(A, dtype=np.float64)
    if A.shape != (f, 2, 2):
        raise ValueError(f"A must have shape ({f}, 2, 2), a matrix for every triangle, not {A.shape}")
    both = A + np.swapaxes(A, 1, 2)
    bad = np.flatnonzero(~((both[:, 0, 0] > 0) & (both[:, 0, 0] * both[:, 1, 1] > both[:, 0, 1] ** 2)))
    if bad.size:
        raise ValueError(f"A is not positive definite on {names_of('triangle', 'triangles', bad)}")
    return A


def _complex(points: ArrayLike) -> ComplexArray:
    return np.ascontiguousarray(points, dtype=np.float64).view(np.complex128).ravel()


def admitted_pair(problem: Problem, uv: FloatArray, seed: int = 0) -> tuple[ComplexArray, ComplexArray]:
    """Return a random real ν per triangle of a positive map, and the μ with which the map satisfies the equation."""
    p, q, _ = ReferenceMesh(problem.V, problem.F, "rest").derivatives(_complex(uv))
    nu = 0.98 * (1 - np.abs(q / p)) * (np.random.default_rng(seed).random(p.size) - 0.5)
    return (q - nu * p.conj()) / p, nu.astype(np.complex128)


def star(rings: int) -> Problem:
    """A disk onto a star with five points."""
    V, F = disk(rings)
    (loop,) = boundary_loops(F, len(V))
    turn = 2 * np.pi * np.arange(len(loop)) / len(loop)
    radius = 1 + 0.6 * np.cos(5 * turn)
    return Problem(V, F, loop, radius[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1))


def main(output: Path, rings: int = 12) -> dict[str, Any]:
    problem = star(rings)
    maps = {"Tutte": quasi_harmonic_map(problem), "injective": solve(problem).uv}
    identity = np.broadcast_to(np.eye(2), (len(problem.F), 2, 2))
    figure, axes = panels(1, 3, (3.4, 3.4))
    curve = axes[0][2]
    curve.set_axis_on()
    numbers: dict[str, Any] = {}
    for ax, (name, uv) in zip(axes[0], maps.items(), strict=False):
        show(ax, problem, uv, name)
        found = edge_conormal(problem, identity, uv)
        order = np.argsort(np.arctan2(*problem.V[found.at].mean(axis=1)[:, 1::-1].T))
        curve.plot(np.linspace(0, 1, order.size), found.s[order], label=name)
        numbers[name] = {"edges with s < 0": int(np.sum(found.s < 0))}
    curve.axhline(0, color="black", lw=0.8)
    curve.set(xlabel="along the boundary", title="s, the co-normal derivative along n̂")
    curve.legend()
    mu, nu = admitted_pair(problem, maps["injective"])
    A = beltrami_tensor(mu, nu)
    again = conjugate_quasi_harmonic_map(problem, A)
    det = np.linalg.det(A)
    numbers["conjugate map"] = {
        "det A": [round(float(det.min()), 3), round(float(det.max()), 3)],
        "distance": float(np.abs(again - maps["injective"]).max()),
    }
    save(figure, output, "general_tensor")
    return numbers


if __name__ == "__main__":
    run(main)
