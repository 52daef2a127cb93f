"""Computations of every evaluation on all triangles: one pass before the solve and one after it.

    ξ ──eq. 33──▶ 𝒜 ──▶ edge stiffness        before
    ξ, w ──▶ areas, V₃, dV₃/dξ                after

For 1,000 triangles the number of array operations determines the time of an evaluation. For 10,000 triangles the
number of passes through memory does. The passes are therefore compiled.
"""

from __future__ import annotations

import numpy as np

from quasiharmonic.geometry.mesh.reference import ReferenceMesh, blocks, wirtinger
from quasiharmonic.solver.field.functionals import beltrami_terms
from quasiharmonic.solver.field.tensor import TANH, Parameterisation, own_tensor, parameterisation_of
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, as_offsets
from quasiharmonic.util.kernels import compiled


def stiffness_of(mesh: ReferenceMesh, parameterisation: Parameterisation, xi: ComplexArray) -> FloatArray:
    """Compute the edge stiffness (3, f) of the tensors of ξ; see `ReferenceMesh.edge_stiffness`."""
    stiffness = np.empty((3, xi.size))
    fill_stiffness(xi, parameterisation.number, mesh.stiffness_by_entry, stiffness)
    return stiffness


def sweep(
    mesh: ReferenceMesh, parameterisation: Parameterisation, xi: ComplexArray, w: ComplexArray, starts: IntArray
) -> tuple[FloatArray, ComplexArray]:
    """Compute the quantities that the descent of V₃ needs, for one mesh or several meshes in a batch.

    Parameters
    ----------
    mesh, parameterisation, xi, w
        ``w`` (n,) is the quasi-harmonic map of ``xi`` (f,).
    starts : (k + 1,) int64
        Index of the first triangle of each mesh, and the total number of triangles. Every mesh has triangles.

    Returns
    -------
    sums : (k, 4) float64
        Per mesh: the number of triangles whose image does not have positive area in floating point, V₃, the map's
        signed area, and the sum of unsigned areas.
    gradient : (f,) complex128
        The gradient of V₃ in ξ.
    """
    sums, gradient = np.empty((len(starts) - 1, 4)), np.empty(xi.size, dtype=np.complex128)
    dirichlet_sweep(
        w, np.ascontiguousarray(mesh.F), mesh.half_gamma, mesh.m, xi, parameterisation.number, starts, gradient, sums
    )
    return sums, gradient


def own_sweep(mesh: ReferenceMesh, w: ComplexArray, starts: IntArray) -> tuple[FloatArray, ComplexArray]:
    """Compute V₃ of one or several maps at their own tensors, clipped to the range of tanh; see `sweep`.

    Returns
    -------
    sums : (k, 2) float64
        Per mesh: V₃ and the map's signed area.
    mu : (f,) complex128
        The Beltrami coefficients of these tensors.
    """
    sums, mu = np.empty((len(starts) - 1, 2)), np.empty(len(mesh.F), dtype=np.complex128)
    at_own_tensors(w, np.ascontiguousarray(mesh.F), mesh.half_gamma, mesh.m, starts, mu, sums)
    return sums, mu


@compiled
def fill_stiffness(xi: ComplexArray, number: int, by_entry: FloatArray, stiffness: FloatArray) -> None:
    """Fill in the edge stiffness (3, f); ``by_entry`` (9, f) has its derivatives by the tensor's entries."""
    for part in blocks(xi.size):
        entries = parameterisation_of(number).field(xi[part]).entries()
        np.einsum("eaf,af->ef", by_entry[:, part].reshape(3, 3, -1), entries, out=stiffness[:, part])


@compiled
def dirichlet_sweep(
    w: ComplexArray,
    F: IntArray,
    half_gamma: ComplexArray,
    m: FloatArray,
    xi: ComplexArray,
    number: int,
    starts: IntArray,
    gradient: ComplexArray,
    sums: FloatArray,
) -> None:
    """Fill in the gradient and the sums of `sweep`; ``half_gamma`` (2, f) belongs to the last two corners."""
    f = xi.size
    density, area = np.empty(f), np.empty(f)
    for part in blocks(f):
        p, q = np.empty_like(xi[part]), np.empty_like(xi[part])
        wirtinger(w, F[part], half_gamma[:, part], p, q, area[part])
        field = parameterisation_of(number).field(xi[part])
        density[part], in_mu = beltrami_terms(m[part], field, p, q)
        gradient[part] = field.pull(in_mu)
    # A NaN area does not count as positive.
    for column, values in enumerate((~(area > 0), 2.0 * density, area, np.abs(area))):
        sums[:, column] = np.add.reduceat(values, as_offsets(starts[:-1]), dtype=np.float64)


@compiled
def at_own_tensors(
    w: ComplexArray,
    F: IntArray,
    half_gamma: ComplexArray,
    m: FloatArray,
    starts: IntArray,
    mu: ComplexArray,
    sums: FloatArray,
) -> None:
    """Fill in the results of `own_sweep`; ``half_gamma`` (2, f) belongs to the last two corners."""
    f = mu.size
    density, area = np.empty(f), np.empty(f)
    for part in blocks(f):
        p, q = np.empty_like(mu[part]), np.empty_like(mu[part])
        wirtinger(w, F[part], half_gamma[:, part], p, q, area[part])
        field = TANH.field(TANH.invert(own_tensor(p, q)))
        density[part], mu[part] = beltrami_terms(m[part], field, p, q)[0], field.mu
    for column, values in enumerate((2.0 * density, area)):
        sums[:, column] = np.add.reduceat(values, as_offsets(starts[:-1]))


@compiled
def clip_moduli(xi: ComplexArray, bound: float) -> None:
    """Clip the moduli of ``xi`` to ``bound`` in place."""
    for part in blocks(xi.size):
        block = xi[part]
        square = block.real**2 + block.imag**2
        far = np.flatnonzero(square > bound**2)
        block[far] *= bound / np.sqrt(square[far])
