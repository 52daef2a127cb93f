"""Prepare a map that comes from a coarser mesh for Newton steps: smooth it, and improve its worst triangles locally.

Most vertices already have good positions. The remaining one percent would cost many steps on the whole mesh, but local
steps on patches around them are cheap.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice

import numpy as np
from scipy.sparse import csr_array

from quasiharmonic.apps.flattening.contacts import Rim
from quasiharmonic.apps.flattening.descent import FreeDescent, descend
from quasiharmonic.apps.flattening.multilevel.hierarchy import LOWEST
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import SymmetricDirichlet
from quasiharmonic.energies.newton.newton_descent import in_units
from quasiharmonic.energies.newton.reweighted import ReweightedDirichlet
from quasiharmonic.geometry.coarsening.levels import touching
from quasiharmonic.geometry.coarsening.prolongation import positive
from quasiharmonic.geometry.mesh.reference import rest_frames
from quasiharmonic.geometry.mesh.shapes import rest_shapes
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray

# Fraction of the way to the weighted mean of its neighbours that a vertex moves, number of sweeps, and minimum weight.
_SHARE, _SWEEPS, _LEAST_WEIGHT = 0.8, 4, 0.02
# A triangle is bad if its density is _BAD times the 75 % quantile. Patches have this number of rings around bad
# triangles, at most this fraction of the mesh, this maximum number of steps, and this tolerance.
_BAD, _RINGS, _MOST, _STEPS, _TOLERANCE = 20.0, 2, 0.4, 20, 1e-2


def touched_up(
    V: FloatArray, F: IntArray, loops: Sequence[IntArray], uv: FloatArray, linear_solver: str = "auto"
) -> FloatArray:
    """Lower the distortion of a bijective map at low cost.

    Parameters
    ----------
    V : (n, 3) float64
        Rest positions.
    F : (f, 3) int64
    loops : sequence of (l,) int64
        Boundary loops.
    uv : (n, 2) float64
        A bijective map.
    linear_solver : str

    Returns
    -------
    (n, 2) float64
        A bijective map.
    """
    energy = thick_energy(V, F)
    before = in_units(uv, 0)
    after = _smoothed(V, F, loops, before)
    with np.errstate(all="ignore"):
        better = energy.value(after) < energy.value(before)
    return _opened(V, F, loops, (after if better else before).view(np.float64).reshape(-1, 2), energy, linear_solver)


def thick_energy(V: FloatArray, F: IntArray) -> DeformationEnergy:
    """The symmetric Dirichlet energy with the thinnest rest triangles thickened, for maps far from the minimum."""
    shapes = rest_shapes(V, F, lowest=LOWEST)
    laid = np.zeros((len(F), 3), dtype=np.complex128)
    laid[:, 1], laid[:, 2] = shapes.unit * shapes.sides[0], -shapes.unit * shapes.sides[2]
    corners = np.arange(F.size).reshape(-1, 3)
    return DeformationEnergy(laid.view(np.float64).reshape(-1, 2), F, ReweightedDirichlet(), rest_F=corners)


def _smoothed(V: FloatArray, F: IntArray, loops: Sequence[IntArray], w: ComplexArray) -> ComplexArray:
    """Move interior vertices towards the Laplacian mean of their neighbours, without inverting triangles."""
    n = len(V)
    z1, z2 = rest_frames(V, F)
    corners = np.stack([np.zeros(z2.shape), z1, z2])
    twice_area = np.maximum(z1 * z2.imag, np.finfo(np.float64).tiny)
    tail, head, weight = [], [], []
    for k in range(3):
        after, before = (k + 1) % 3, (k + 2) % 3
        one, other = corners[after] - corners[k], corners[before] - corners[k]
        tail += [F[:, after], F[:, before]]
        head += [F[:, before], F[:, after]]
        weight += 2 * [np.maximum((one.conj() * other).real / twice_area, _LEAST_WEIGHT)]
    graph = csr_array((np.concatenate(weight), (np.concatenate(tail), np.concatenate(head))), shape=(n, n))
    total = graph @ np.ones(n)
    inner = np.ones(n, dtype=bool)
    inner[np.concatenate(loops)] = False
    for _ in range(_SWEEPS):
        new = np.where(inner, w + _SHARE * ((graph @ w) / total - w), w)
        back = np.zeros(n, dtype=bool)
        inverted = F.compress(~positive(new, F), axis=0)
        while len(inverted) and not back[inverted].all():
            back[inverted] = True
            new[inverted] = w[inverted]
            touched = F.compress(touching(F, back), axis=0)
            inverted = touched.compress(~positive(new, touched), axis=0)
        w = new
    return w


def _opened(
    V: FloatArray,
    F: IntArray,
    loops: Sequence[IntArray],
    uv: FloatArray,
    energy: DeformationEnergy,
    linear_solver: str,
) -> FloatArray:
    """Descend on patches around the worst triangles, with all other vertices fixed."""
    with np.errstate(all="ignore"):
        density = energy.energy.density(energy.deform(in_units(uv, 0)))
    loose = np.zeros(len(V), dtype=bool)
    loose[F[density > _BAD * np.quantile(density, 0.75)]] = True
    for _ in range(_RINGS):
        loose[F[touching(F, loose)]] = True
    patches = F[touching(F, loose)]
    if not 0 < len(patches) < _MOST * len(F):
        return uv
    vertices, flat = np.unique(patches, return_inverse=True)
    patches = flat.reshape(-1, 3)
    descent = FreeDescent(
        thick_energy(V[vertices], patches), uv[vertices], linear_solver, np.flatnonzero(~loose[vertices])
    )
    for _ in islice(descend(descent, SymmetricDirichlet(), _TOLERANCE), _STEPS):
        pass
    opened = uv.copy()
    opened[vertices] = descent.uv
    return uv if Rim(loops).meets_itself(opened) else opened
