"""The derivative of flattened maps: the boundary is free, and there may be fixed vertices."""

from __future__ import annotations

from dataclasses import replace
from typing import TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.flattening.piece import is_scale_free
from quasiharmonic.apps.gradients.derivative import Derivative, Doubt, Equilibrium, Scale
from quasiharmonic.apps.gradients.freedom import Freedom, Gauge
from quasiharmonic.apps.gradients.minimum import Minimum
from quasiharmonic.apps.gradients.polish_gradient import NOT_FOUND, differentiate_surface_size, make_strain, place_map
from quasiharmonic.energies.deformation import DeformationEnergy, positive_weights, signed_areas
from quasiharmonic.energies.energies import Energy
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.energies.polishing import check_injective, find_energy
from quasiharmonic.geometry.exact.loops import check_loops
from quasiharmonic.io.adapters.accepts_mesh import accepts_mesh
from quasiharmonic.problem import Domain
from quasiharmonic.util.arrays import ComplexArray, find_exponent, to_points
from quasiharmonic.util.options import FlattenOptions, takes


class FlattenDerivativeKeywords(TypedDict, total=False):
    """Types of the options of `flatten_derivative`."""

    fixed: ArrayLike | None
    energy: str | Energy
    weights: ArrayLike | None
    linear_solver: str


@accepts_mesh
@takes(FlattenOptions, FlattenDerivativeKeywords)
def flatten_derivative(
    V: ArrayLike, F: ArrayLike, uv: ArrayLike, **options: Unpack[FlattenDerivativeKeywords]
) -> Derivative:
    """Converge a flattened map to rounding, and differentiate it by target and rest positions.

    Parameters
    ----------
    V, F, fixed, energy, weights, linear_solver
        As for the call of `quasiharmonic.flatten` that made the map; not ``"distances"``, and only one connected
        surface.
    uv : (n, 2) array
        The flattened map, with the vertices ``fixed`` at their target positions.

    Returns
    -------
    Derivative
        The derivative of the energy's minimum near ``uv``; this map is ``Derivative.uv``. Without fixed vertices, the
        derivative is that of the map nearest to ``uv`` (`quasiharmonic.apps.gradients.freedom`), although `flatten`
        would lay it out differently. Use functions that do not depend on the map's position and rotation. With one
        fixed vertex the map can rotate about it, so the same holds for its rotation.

    Raises
    ------
    ValueError
        As `quasiharmonic.flatten`. If there are several surfaces, or ``uv`` is not injective.

    Examples
    --------
    The area of a flattened cap grows twice as fast as the cap does:

    >>> import numpy as np
    >>> from quasiharmonic import flatten
    >>> from quasiharmonic.surfaces import disk
    >>> square, F = disk(6)
    >>> V = np.column_stack([square, 0.3 * (square**2).sum(axis=1)])
    >>> derivative = flatten_derivative(V, F, flatten(V, F).uv)
    >>> from quasiharmonic.energies.deformation import signed_areas
    >>> area = lambda uv: signed_areas(F, uv @ (1, 1j)).sum()
    >>> growth = derivative.jvp(rest=V)
    >>> change = area(derivative.uv + 1e-6 * growth) / area(derivative.uv) - 1
    >>> bool(abs(change - 2e-6) < 1e-9)
    True
    """
    return differentiate_flattened(V, F, uv, FlattenOptions(**options))


def differentiate_flattened(V: ArrayLike, F: ArrayLike, uv: ArrayLike, options: FlattenOptions) -> Derivative:
    """Converge a flattened map to rounding, and differentiate it; see `flatten_derivative`."""
    domain = Domain(V, F, () if options.fixed is None else options.fixed)
    chosen = find_energy(options.energy)
    start = check_injective(domain, uv, NOT_FOUND)
    strain = make_strain(domain)
    exponent = find_exponent(domain.V)
    w = in_units(start, exponent)
    measure = DeformationEnergy(
        np.ldexp(domain.V, -exponent),
        domain.F,
        chosen,
        weights=None if options.weights is None else positive_weights(options.weights, len(domain.F)),
    )
    gauge = _gauge(measure, w, domain)

    def find_minimum(w: ComplexArray, *, converge: bool = True) -> Minimum:
        fixed, sliding, tangent = domain.fixed, None, None
        if gauge is not None:
            fixed, sliding, tangent = replace(gauge, w=w).constraints()
        freedom = Freedom(measure, w.size, fixed, options.linear_solver, sliding, tangent)
        return Minimum(measure, w, freedom, converge=converge)

    if gauge is not None and gauge.keeps_area:
        # First converge at any scale, then scale to the surface's area.
        w = find_minimum(w).w
        size = float(np.ldexp(strain.m, -2 * exponent).sum())
        w = (w - w.mean()) * np.sqrt(size / signed_areas(domain.F, w).sum()) + w.mean()
    minimum, doubts = find_minimum(w), []
    if _overlaps(domain, minimum.w) and not _overlaps(domain, w):
        minimum, doubts = find_minimum(w, converge=False), [Doubt.CONTACT]
    scale = None
    if gauge is not None and gauge.keeps_area:
        scale = Scale(np.zeros_like(w), differentiate_surface_size(strain))
    equilibrium = Equilibrium(
        fixed=domain.fixed,
        forces=minimum.forces,
        inverse=minimum.solve,
        make_strain=lambda: strain,
        rest_shape=domain.V.shape,
        unit=2.0**exponent,
        scale=scale,
        gauge=None if gauge is None else replace(gauge, w=minimum.w),
    )
    uv = place_map(minimum.w, exponent, domain.fixed, start)
    return Derivative(uv, equilibrium, [*doubts, *minimum.doubts])


def _gauge(measure: DeformationEnergy, w: ComplexArray, domain: Domain) -> Gauge | None:
    """The transformations that do not change the energy; None if there are at least two fixed vertices."""
    if domain.fixed.size > 1:
        return None
    # Energies beyond the range of doubles are reported where derivatives are taken.
    with np.errstate(all="ignore"):
        scales = is_scale_free(measure, w)
    pin = int(domain.fixed[0]) if domain.fixed.size else None
    return Gauge(w, pin, scales, domain.loops)


def _overlaps(domain: Domain, w: ComplexArray) -> bool:
    return bool(check_loops(domain.loops, to_points(w))[1])
