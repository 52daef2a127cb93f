"""The derivative of polished maps with a fixed boundary or a boundary that slides along curves."""

from __future__ import annotations

from typing import TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.gradients.derivative import Derivative, Equilibrium, Scale
from quasiharmonic.apps.gradients.forces import RestStrain
from quasiharmonic.apps.gradients.freedom import Freedom, SlidingFreedom, differentiate_map_size
from quasiharmonic.apps.gradients.minimum import Minimum
from quasiharmonic.energies.deformation import positive_weights
from quasiharmonic.energies.energies import Energy
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.energies.newton.sliding_boundary import move_boundary
from quasiharmonic.energies.polishing import check_injective, find_energy, scale_energy
from quasiharmonic.geometry.curves.boundary_curves import BoundaryCurves, Track
from quasiharmonic.io.adapters.accepts_mesh import accepts_mesh
from quasiharmonic.problem import Domain
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, to_points
from quasiharmonic.util.options import PolishOptions, takes

#: Error message for maps that are not injective.
NOT_FOUND = "no map was found, so there is no derivative"


class PolishDerivativeKeywords(TypedDict, total=False):
    """Types of the options of `polish_derivative`."""

    energy: str | Energy
    weights: ArrayLike | None
    linear_solver: str
    slide: bool | BoundaryCurves


@accepts_mesh
@takes(PolishOptions, PolishDerivativeKeywords)
def polish_derivative(
    V: ArrayLike,
    F: ArrayLike,
    uv: ArrayLike,
    *,
    fixed: ArrayLike | None = None,
    **options: Unpack[PolishDerivativeKeywords],
) -> Derivative:
    """Converge a polished map to rounding, and differentiate it by target and rest positions.

    Parameters
    ----------
    V, F, fixed, energy, weights, linear_solver, slide
        As for the call of `quasiharmonic.polish` that made the map.
    uv : (n, 2) array
        The polished map.

    Returns
    -------
    Derivative
        The derivative of the energy's minimum near ``uv``; this map is ``Derivative.uv``.

    Raises
    ------
    ValueError
        As `quasiharmonic.polish`. If ``uv`` is not injective, it has no derivative.

    Notes
    -----
    The method is implicit differentiation with the exact second derivative. A custom energy may depend on the rest
    positions through p and q only. If the boundary slides, its curves and the map's scale are constant.

    For curves that are not straight, a barrier keeps edges near them (`quasiharmonic.geometry.curves.deviation`). Its
    bounds and weight are those of a polish started at ``uv``, and count as constant. Derivatives along these curves are
    therefore typically accurate to 0.5 % only, and no doubt reports this.

    A disk that slides on a circle without fixed vertices can rotate freely, so its derivative has a doubt.

    Examples
    --------
    >>> import numpy as np
    >>> from quasiharmonic import polish
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(6)
    >>> rim = np.arange(len(V) - 36, len(V))
    >>> derivative = polish_derivative(V, F, polish(V, F, V, fixed=rim).uv, fixed=rim)
    >>> gradients = derivative.vjp(derivative.uv)  # of half the sum of the squares of all places
    >>> gradients.target.shape, gradients.rest.shape, derivative.reliable
    ((36, 2), (127, 2), True)
    """
    return differentiate_polish(Domain(V, F, fixed), uv, PolishOptions(**options))


def differentiate_polish(domain: Domain, uv: ArrayLike, options: PolishOptions) -> Derivative:
    """Converge a polished map to rounding, and differentiate it; see `polish_derivative`."""
    domain.check_boundary_fixed()
    chosen = find_energy(options.energy)
    start = check_injective(domain, uv, NOT_FOUND)
    track = move_boundary(options.slide, domain, start) if options.slide is not False else None
    if track is not None:
        start = track.uv
    counts = None if options.weights is None else positive_weights(options.weights, len(domain.F))
    measure, exponent = scale_energy(domain, start, chosen, counts)
    w = in_units(start, exponent)
    strain = make_strain(domain)
    by_rest = differentiate_surface_size(strain)
    if track is None:
        freedom = Freedom(measure, domain.n, domain.fixed, options.linear_solver)
        scale = Scale(-differentiate_map_size(w, domain.loops), by_rest)
    else:
        freedom = SlidingFreedom(measure, track, domain, exponent, options.linear_solver)
        scale = Scale(np.zeros_like(w), by_rest)
    minimum = Minimum(measure, w, freedom)
    equilibrium = Equilibrium(
        fixed=domain.fixed,
        forces=minimum.forces,
        inverse=minimum.solve,
        make_strain=lambda: strain,
        rest_shape=domain.V.shape,
        unit=2.0**exponent,
        on_curves=None if track is None else find_curve_vertices(track),
        scale=scale,
    )
    held = np.setdiff1d(domain.fixed, freedom.sliding)
    return Derivative(place_map(minimum.w, exponent, held, start), equilibrium, minimum.doubts)


def make_strain(domain: Domain) -> RestStrain:
    """The change of triangles with the rest positions; planar triangles are taken as counterclockwise."""
    domain.check_areas()
    return RestStrain(domain.V, domain.F, signed=False)


def differentiate_surface_size(strain: RestStrain) -> FloatArray:
    """The derivative (n, d) of half the logarithm of the surface's area with respect to the rest positions."""
    # The largest area may be near the largest double.
    relative = strain.m / strain.m.max()
    share = (relative / relative.sum()).astype(np.complex128)
    return strain.pull(share, np.zeros_like(share))


def find_curve_vertices(track: Track) -> IntArray:
    """Vertices whose positions the curves determine: those that slide, and those at corners."""
    return np.concatenate([chain.vertices for chain in track.chains])


def place_map(w: ComplexArray, exponent: int, fixed: IntArray, given: FloatArray) -> FloatArray:
    """Scale a map out of its units, with fixed vertices exactly at their given positions."""
    uv: FloatArray = np.ldexp(to_points(w), exponent)
    uv[fixed] = given[fixed]
    return uv
