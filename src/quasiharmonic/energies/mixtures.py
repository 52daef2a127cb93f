"""Sums of the package's own isotropic energies, with derivatives, evaluated in one pass over the triangles."""

from __future__ import annotations

from functools import cache

import numpy as np

from quasiharmonic.energies.energies import (
    ARAP,
    MIPS,
    AreaBarrier,
    Combination,
    Deformation,
    Energy,
    Isotropic,
    QuadraticForm,
    SymmetricDirichlet,
)
from quasiharmonic.geometry.mesh.reference import blocks
from quasiharmonic.util.arrays import ComplexArray, FloatArray
from quasiharmonic.util.kernels import compiled

#: The energies of a mixture, in the order of its factors.
TERMS: tuple[Isotropic, ...] = MIPS(), SymmetricDirichlet(), ARAP(), AreaBarrier()


def mixture_of(energy: Energy, *parts: str) -> FloatArray | None:
    """The factors (4,) float64 that express an energy as a sum of `TERMS`, or None if it is not one.

    ``parts`` are the methods that the caller uses. A subclass of one of `TERMS` that does not override them counts as
    that energy.
    """
    if type(energy) is not Combination:
        return _factors(type(energy), parts)
    factors = np.zeros(len(TERMS))
    for factor, term in energy.terms:
        part = mixture_of(term, *parts)
        if part is None:
            return None
        factors += factor * part
    return factors


@cache
def _factors(kind: type[Energy], parts: tuple[str, ...]) -> FloatArray | None:
    for energy, factors in zip(TERMS, np.eye(len(TERMS)), strict=True):
        own = type(energy)
        if issubclass(kind, own) and all(getattr(kind, part) is getattr(own, part) for part in parts):
            return factors
    return None


def energy_of(mixture: FloatArray) -> Isotropic:
    """The energy with the factors ``mixture`` of `TERMS`; the inverse of `mixture_of`."""
    terms = [(float(factor), energy) for factor, energy in zip(mixture, TERMS, strict=True) if factor]
    return terms[0][1] if len(terms) == 1 and terms[0][0] == 1 else Combination(*terms)


@compiled
def mixed_energy(mixture: FloatArray, p: ComplexArray, q: ComplexArray, det: FloatArray, share: FloatArray) -> float:
    """Return the sum of the densities times ``share``; ``p``, ``q``, ``det`` and ``share`` are (f,)."""
    return float(np.sum(share * energy_of(mixture).density(Deformation(p, q, det))))


@compiled
def mixed_slopes(
    mixture: FloatArray, p: ComplexArray, q: ComplexArray, det: FloatArray, by_p: ComplexArray, by_q: ComplexArray
) -> None:
    """Fill ``by_p`` and ``by_q`` with the derivatives of the densities with respect to p and q."""
    energy = energy_of(mixture)
    for part in blocks(det.size):
        by_p[part], by_q[part] = energy.gradient(Deformation(p[part], q[part], det[part]))


@compiled
def mixed_curvature(
    mixture: FloatArray,
    p: ComplexArray,
    q: ComplexArray,
    det: FloatArray,
    share: FloatArray,
    negative: float,
    pp: FloatArray,
    qq: FloatArray,
    p2: ComplexArray,
    q2: ComplexArray,
    pq: ComplexArray,
    pqc: ComplexArray,
) -> None:
    """Fill the fields of the second derivatives (see `Energy.curvature`), each multiplied by ``share``."""
    energy = energy_of(mixture)
    for part in blocks(det.size):
        form = energy.curvature(Deformation(p[part], q[part], det[part]), negative=negative).scaled(share[part])
        for whole, values in zip((pp, qq, p2, q2, pq, pqc), form, strict=True):
            whole[part] = values


def curvature_of_mixture(mixture: FloatArray, d: Deformation, share: FloatArray, negative: float) -> QuadraticForm:
    """Second derivatives of the densities times ``share``, as a quadratic form per triangle."""
    f = d.det.size
    reals, complexes = np.empty((2, f)), np.empty((4, f), dtype=np.complex128)
    mixed_curvature(mixture, d.p, d.q, d.det, share, negative, *reals, *complexes)
    return QuadraticForm(*reals, *complexes)
