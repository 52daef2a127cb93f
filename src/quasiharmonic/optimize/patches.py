"""Local repair: only a patch around the last inverted triangles is solved again.

What is left at the end is typically a triangle or two against the boundary whose room is a millionth of a
triangle's: the energy of the whole map hardly sees them. Everything outside a few rings around them stays,
and inside the positions themselves are moved to lower the regularised energy of Garanzha et al. (2021),

    Σ (‖J‖²/2 + λ (det² J + 1)) / χ(det J),        χ(D) = (D + √(ε² + D²)) / 2,

which is finite for inverted triangles and a barrier against them as ε falls. From afar that gets stuck; on
small patches of a map that is nearly injective it works in most cases. A patch that fails is grown.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.certificate import flipped_triangles
from quasiharmonic.mesh.reference import ReferenceMesh
from quasiharmonic.mesh.topology import boundary_edges
from quasiharmonic.objective import Iterate, Objective
from quasiharmonic.optimize.alternating import own_tensor
from quasiharmonic.tensor import TANH

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]

# Rings of triangles around an inverted one, tried in turn.
_RINGS = 1, 2, 3, 4, 6, 8, 12, 16
# More flips than this are no matter for local repair, and larger patches are no patches.
_MOST_FLIPS, _MOST_TRIANGLES = 50, 1000
# Weight of areas against angles; rounds of lowering ε and descents within each.
_LAMBDA, _ROUNDS, _STEPS = 1e-2, 10, 300


def patches(
    objective: Objective,
    start: Iterate,
    visit: Callable[[Iterate], None],
    *,
    iterations: int,
) -> None:
    """Right the last inverted triangles one patch at a time.

    Parameters
    ----------
    objective : Objective
        Its functional is not looked at.
    start : Iterate
    visit : callable
        Called after every patch that left fewer inverted triangles; raises `Stop` to end.
    iterations : int
        Patches to try at most.
    """
    problem = objective.problem
    w = start.w
    left = flipped_triangles(problem.F, problem.positions(w))
    for ring in _RINGS:
        for triangle in left.tolist():
            if not 0 < left.size <= _MOST_FLIPS or iterations <= 0:
                return
            if triangle not in left:
                continue
            patch = _grown(problem.F, problem.n, triangle, ring)
            if patch.size > _MOST_TRIANGLES:
                continue
            iterations -= 1
            moved = _righted(problem.F[patch], w, problem.fixed)
            if moved is None:
                continue
            now = flipped_triangles(problem.F, problem.positions(moved))
            if now.size < left.size:
                w, left = moved, now
                dw = objective.mesh.derivatives(w)
                # The map's own tensors: where it is injective, it is the quasi-harmonic map of these (eq. 39).
                # In the tanh parameterisation, which reaches them all.
                visit(Iterate(objective, TANH.field(TANH.invert(own_tensor(dw))), w, dw))


def _grown(F: IntArray, n: int, triangle: int, rings: int) -> IntArray:
    """Triangles within some rings of one; ascending."""
    inside = np.zeros(n, dtype=bool)
    inside[F[triangle]] = True
    for _ in range(rings):
        inside[F[inside[F].any(axis=1)]] = True
    return np.flatnonzero(inside[F].all(axis=1))


def _righted(F: IntArray, w: ComplexArray, fixed: IntArray) -> ComplexArray | None:
    """The map with the patch's free vertices moved, or None where it has none or cannot be scaled."""
    used, local = np.unique(F, return_inverse=True)
    local = local.reshape(-1, 3).astype(np.int64)
    held = np.isin(used, fixed)
    held[boundary_edges(local, used.size)] = True
    if held.all():
        return None
    # Moved and scaled to its own size: limbs of a map can be 1e-10 of the whole.
    centre = w[used].mean()
    scale = float(np.abs(w[used] - centre).max())
    if not scale > 0:
        return None
    out = w.copy()
    free = used[~held]
    out[free] = centre + scale * _untangled(local, (w[used] - centre) / scale, held)[~held]
    return out


def _untangled(F: IntArray, w: ComplexArray, held: NDArray[np.bool_]) -> ComplexArray:
    """Descend the regularised energy, ε falling, until no triangle is inverted in floating point."""
    from scipy.optimize import minimize

    mesh = ReferenceMesh(np.zeros((w.size, 2)), F, "equilateral")
    # Reference triangles of the images' mean size, so that det J is of order one.
    per_area = F.shape[0] / np.abs(mesh.derivatives(w).area).sum()
    if not np.isfinite(per_area):
        return w
    shrink = np.sqrt(per_area * mesh.m[0])
    g1, corner = 0.5 * shrink * mesh.gamma, F.T.ravel()
    free = np.flatnonzero(~held)
    w = w.copy()

    def energy(x: FloatArray, epsilon: float) -> tuple[float, FloatArray]:
        w[free] = x.view(np.complex128)
        p, q, _ = mesh.derivatives(w)
        p, q = shrink * p, shrink * q
        a, b = p.real**2 + p.imag**2, q.real**2 + q.imag**2
        det = a - b
        root = np.sqrt(epsilon**2 + det**2)
        chi = np.where(det > 0, 0.5 * (det + root), 0.5 * epsilon**2 / (root + np.abs(det)))
        density = (a + b + _LAMBDA * (det**2 + 1)) / chi
        by_det = 2 * _LAMBDA * det / chi - density / root
        by_p, by_q = 2 * (1 / chi + by_det) * p, 2 * (1 / chi - by_det) * q
        pull = (by_p * g1 + by_q * g1.conj()).ravel()
        gradient = np.bincount(corner, pull.real, w.size) + 1j * np.bincount(corner, pull.imag, w.size)
        return float(density.sum()), gradient[free].view(np.float64)

    least = float(mesh.derivatives(w).area.min()) * per_area
    epsilon = np.sqrt(1e-18 + 0.04 * least**2)
    for _ in range(_ROUNDS):
        x = w[free].view(np.float64)
        with np.errstate(all="ignore"):
            before = energy(x, epsilon)[0]
            found = minimize(
                energy, x, args=(epsilon,), jac=True, method="L-BFGS-B", options={"maxiter": _STEPS, "maxcor": 20}
            )
        w[free] = found.x.view(np.complex128)
        least = float(mesh.derivatives(w).area.min()) * per_area
        if least > 0 or not np.isfinite(least):
            break
        sigma = max(1 - found.fun / before, 0.1)
        root = np.sqrt(least**2 + epsilon**2)
        epsilon *= 1 - sigma * root / (abs(least) + root)
    return w
