"""Problems to differentiate, and the reference for their derivatives: central differences of maps."""

from __future__ import annotations

import numpy as np

from quasiharmonic import Problem, boundary_loops, flatten, injective_map
from quasiharmonic.surfaces import annulus


def ring(curved=False):
    """A square with a square hole and perturbed vertices, planar or curved."""
    V, F = annulus(6, hole=(-0.34, -0.34, 0.34, 0.34))
    V = V + 0.02 * np.random.default_rng(1).standard_normal(V.shape)
    return (np.column_stack([V, 0.3 * np.sin(2 * V[:, 0])]) if curved else V), F


def held_ring(curved=False, pins=1):
    """A problem on `ring`: boundary and hole fixed at bent positions, and ``pins`` fixed interior vertices."""
    V, F = ring(curved)
    loops = np.concatenate(boundary_loops(F, len(V)))
    fixed = np.concatenate([loops, np.setdiff1d(np.arange(len(V)), loops)[3 : 3 + pins]])
    return Problem(V, F, fixed, 1.3 * V[fixed, :2] + 0.1 * V[fixed, :2] ** 2)


def tensors(f, most=0.6):
    """Random Beltrami coefficients with modulus at most ``most``."""
    rng = np.random.default_rng(2)
    return most * np.sqrt(rng.random(f)) * np.exp(2j * np.pi * rng.random(f))


def polished_ring(energy="symmetric-dirichlet", curved=False):
    """The problem of `held_ring`, and its polished map."""
    problem = held_ring(curved)
    found = injective_map(problem.V, problem.F, problem.fixed, problem.target, polish=energy)
    assert found.injective
    return problem, found.uv


def flattened_ring(pins=(), energy="symmetric-dirichlet", curved=True):
    """Surface, fixed vertices (possibly empty), their target positions near those of the free map, and the flat map."""
    V, F = ring(curved)
    free = flatten(V, F, energy=energy)
    pins = np.array(pins, dtype=np.int64)
    if not pins.size:
        return V, F, pins, np.zeros((0, 2)), free.uv
    places = 1.04 * free.uv[pins] + [0.1, 0.2]
    held = flatten(V, F, fixed=pins, target=places, energy=energy)
    assert held.certificate.bijective
    return V, F, pins, places, held.uv


def aligned(uv, base, pin=None, scales=False):
    """Align a map to another by least squares: by a rigid motion or, with ``scales``, a similarity.

    With ``pin``, turn it about that vertex instead, without translation.
    """
    w, there = uv @ (1, 1j), base @ (1, 1j)
    arms, goal = (z - (z.mean() if pin is None else z[pin]) for z in (w, there))
    factor = np.vdot(arms, goal)
    factor /= np.vdot(arms, arms).real if scales else abs(factor)
    laid = factor * arms + (there.mean() if pin is None else w[pin])
    return np.stack([laid.real, laid.imag], axis=1)


def worst_difference(make, arguments, onto=None):
    """Return the worst errors of derivatives and of their transposes.

    The first is the largest deviation from central differences, relative to the largest entry. The second is the
    relative difference between ``jvp`` and ``vjp`` products. ``make(**arguments)`` makes a derivative; ``onto(uv,
    base)`` aligns a map to the current one.
    """
    rng = np.random.default_rng(3)
    here = make(**arguments)
    assert here.reliable, here.doubts
    cotangent = rng.standard_normal(here.uv.shape)
    gradients = here.vjp(cotangent)
    off, skew = 0.0, 0.0
    for name, value in arguments.items():
        change = rng.standard_normal(value.shape) * (1 + 0j if np.iscomplexobj(value) else 1.0)
        if np.iscomplexobj(value):
            change += 1j * rng.standard_normal(value.shape)
        moved = here.jvp(**{name: change})
        ahead, behind = (make(**{**arguments, name: value + step * change}).uv for step in (1e-5, -1e-5))
        if onto is not None:
            ahead, behind = onto(ahead, here.uv), onto(behind, here.uv)
        off = max(off, np.abs((ahead - behind) / 2e-5 - moved).max() / np.abs(moved).max())
        one, other = np.sum(moved * cotangent), np.sum((np.conj(getattr(gradients, name)) * change).real)
        skew = max(skew, abs(one - other) / (np.linalg.norm(moved) * np.linalg.norm(cotangent)))
    return off, skew
