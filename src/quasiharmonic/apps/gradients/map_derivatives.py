"""The derivatives of quasi-harmonic, polished and flattened maps.

A quasi-harmonic map solves a linear system, so its derivative by tensors, target and rest positions needs one more
solve with the same factor. The map is the stationary point of the energy ``Σ m φ(p, q)``,

    φ = c (|p|² + |q|²) − 2 Re (ω p q̄),    c = (1 + |μ|²) / (1 − |μ|²),    ω = 2μ / (1 − |μ|²).

Polished maps have a fixed boundary, or a boundary that slides along curves. Flattened maps have a free boundary, and
may have fixed vertices.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TypedDict, Unpack, get_args

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.gradients.derivative import Derivative, Doubt, Equilibrium, Scale
from quasiharmonic.apps.gradients.forces import CorrectedStrain, Forces, RestStrain, Strain, TensorForces
from quasiharmonic.apps.gradients.freedom import Freedom, Gauge, SlidingFreedom, differentiate_map_size
from quasiharmonic.apps.gradients.minimum import Minimum
from quasiharmonic.energies.deformation import DeformationEnergy, positive_weights, signed_areas
from quasiharmonic.energies.energies import Energy, QuadraticForm
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.energies.newton.sliding_boundary import move_boundary
from quasiharmonic.energies.polishing import check_injective, find_energy, scale_energy
from quasiharmonic.geometry.curves.boundary_curves import BoundaryCurves
from quasiharmonic.geometry.exact.loops import check_loops
from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.io.accepts_mesh import accepts_mesh
from quasiharmonic.problem import Domain, Problem, check_problem
from quasiharmonic.solver.field.objective import Objective
from quasiharmonic.solver.field.tensor import TANH, beltrami_coefficients
from quasiharmonic.util.arrays import (
    ComplexArray,
    FloatArray,
    IntArray,
    check_choice,
    find_exponent,
    to_complex,
    to_points,
)
from quasiharmonic.util.options import FlattenOptions, PolishOptions, takes

# Error message for maps that are not injective.
_NOT_FOUND = "no map was found, so there is no derivative"
# A coefficient μ that `TANH.invert` changes by more was clipped; rounding changes it by about 1e-16.
_CLIPPED = 1e-12


def quasi_harmonic_derivative(
    problem: Problem, mu: ArrayLike | None = None, *, reference: Reference = "equilateral", linear_solver: str = "auto"
) -> Derivative:
    """Compute a quasi-harmonic map and its derivative by tensors, target positions and rest positions.

    Parameters
    ----------
    problem, mu, reference, linear_solver
        As for `quasiharmonic.quasi_harmonic_map`.

    Returns
    -------
    Derivative
        Its ``uv`` is exactly that map. With the reference ``"equilateral"``, it does not depend on the rest positions.

    Raises
    ------
    ValueError
        As `quasiharmonic.quasi_harmonic_map`.
    quasiharmonic.linsolve.NotPositiveDefinite
        If rounding makes the Laplacian not positive definite.

    See Also
    --------
    quasi_harmonic_map : The map alone.
    polish_derivative : The derivative of another map.
    flatten_derivative : The derivative of another map.

    Notes
    -----
    The derivative uses the map's factor. All derivatives of one `Problem` share the memory of one factor, so
    alternating between derivatives with different tensors computes it again.

    Examples
    --------
    >>> import numpy as np
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(6)
    >>> rim = np.arange(len(V) - 36, len(V))
    >>> derivative = quasi_harmonic_derivative(Problem(V, F, rim, V[rim]))
    >>> shifted = derivative.jvp(target=np.tile([1.0, 0.0], (36, 1)))  # the whole map moves with its boundary
    >>> bool(np.allclose(shifted, [1, 0]))
    True
    """
    check_problem("quasi_harmonic_derivative", problem)
    check_choice("reference", reference, get_args(Reference))
    coefficients = beltrami_coefficients(mu, len(problem.F))
    with problem.exclusive() as own:
        objective = Objective(own, reference=reference, linear_solver=linear_solver)
        iterate = objective.evaluate(TANH.invert(coefficients))
        operator = iterate.operator
    mesh, field = objective.mesh, iterate.field
    half: ComplexArray = 0.5 * mesh.gamma
    strain: Callable[[], Strain] | None = None
    if mesh.kind != "equilateral":
        rest = problem.V, problem.F
        strain = partial(RestStrain, *rest) if mesh.kind == "rest" else partial(CorrectedStrain, *rest, half)
    uv = problem.positions(iterate.w)
    dw = mesh.derivatives(to_complex(uv - problem.frame.centre))
    double = 2.0 / field.defect
    c, omega = double - 1.0, double * field.mu
    zero = np.zeros_like(field.mu)
    # φ is quadratic in (p, q). So its second derivative along (dp, dq) is the constant form 2 φ(dp, dq), and its
    # gradient is the matrix of this form times (p, q), which `apply` returns.
    form = QuadraticForm(pp=2 * c, qq=2 * c, p2=zero, q2=zero, pq=zero, pqc=-4 * omega)
    by_p, by_q = form.apply(dw.p, dw.q)
    corners = np.ascontiguousarray(problem.F.T)
    clipped = np.abs(field.mu - coefficients) > _CLIPPED
    equilibrium = Equilibrium(
        fixed=problem.fixed,
        forces=Forces(corners, problem.n, half, mesh.m, dw.p, dw.q, by_p, by_q, form),
        inverse=operator.respond,
        make_strain=strain,
        rest_shape=problem.V.shape,
        tensors=TensorForces(field),
    )
    return Derivative(uv, equilibrium, [Doubt.CLIPPED] if clipped.any() else [])


class DerivativeKeywords(TypedDict, total=False):
    """Types of the options that the derivatives of polished and flattened maps share."""

    energy: str | Energy
    weights: ArrayLike | None
    linear_solver: str


class PolishDerivativeKeywords(DerivativeKeywords, total=False):
    """Types of the options of `polish_derivative`."""

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

    See Also
    --------
    polish : The map alone.
    quasi_harmonic_derivative : The derivative of another map.
    flatten_derivative : The derivative of another map.

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
    >>> gradients = derivative.vjp(derivative.uv)  # of half the sum of the squares of all positions
    >>> gradients.target.shape, gradients.rest.shape, derivative.reliable
    ((36, 2), (127, 2), True)
    """
    return differentiate_polish(Domain(V, F, fixed), uv, PolishOptions(**options))


def differentiate_polish(domain: Domain, uv: ArrayLike, options: PolishOptions) -> Derivative:
    """Converge a polished map to rounding, and differentiate it; see `polish_derivative`."""
    domain.check_boundary_fixed()
    chosen = find_energy(options.energy)
    start = check_injective(domain, uv, _NOT_FOUND)
    track = move_boundary(options.slide, domain, start) if options.slide is not False else None
    if track is not None:
        start = track.uv
    counts = None if options.weights is None else positive_weights(options.weights, len(domain.F))
    measure, exponent = scale_energy(domain, start, chosen, counts)
    w = in_units(start, exponent)
    strain = _make_strain(domain)
    # The energy measures the map times s = (size of the surface) / (size of the map), where a size is the root of an
    # area. So log s falls with the logarithm of the map's size. If the boundary slides, its curves determine
    # that size, and they count as constant.
    by_places = np.zeros_like(w)
    if track is None:
        freedom = Freedom(measure, domain.n, domain.fixed, options.linear_solver)
        by_places = -differentiate_map_size(w, domain.loops)
    else:
        freedom = SlidingFreedom(measure, track, domain, exponent, options.linear_solver)
    scale = Scale(by_places, _differentiate_surface_size(strain))
    minimum = Minimum(measure, w, freedom)
    placed = _place_map(minimum.w, exponent, np.setdiff1d(domain.fixed, freedom.sliding), start)
    # Curves determine the positions of the vertices that slide, and of those at corners.
    on_curves = None if track is None else np.concatenate([chain.vertices for chain in track.chains])
    equilibrium = _make_equilibrium(domain, minimum, strain, exponent, on_curves=on_curves, scale=scale)
    return Derivative(placed, equilibrium, minimum.doubts)


def _make_equilibrium(
    domain: Domain,
    minimum: Minimum,
    strain: RestStrain,
    exponent: int,
    *,
    scale: Scale | None,
    gauge: Gauge | None = None,
    on_curves: IntArray | None = None,
) -> Equilibrium:
    """Return the equilibrium at a minimum in units of ``2 ** exponent``; the keywords are attributes of it."""
    return Equilibrium(
        fixed=domain.fixed,
        forces=minimum.forces,
        inverse=minimum.solve,
        make_strain=lambda: strain,
        rest_shape=domain.V.shape,
        unit=2.0**exponent,
        scale=scale,
        gauge=gauge,
        on_curves=on_curves,
    )


def _make_strain(domain: Domain) -> RestStrain:
    """The change of triangles with the rest positions; planar triangles are taken as counterclockwise."""
    domain.check_areas()
    return RestStrain(domain.V, domain.F, signed=False)


def _differentiate_surface_size(strain: RestStrain) -> FloatArray:
    """The derivative (n, d) of half the logarithm of the surface's area with respect to the rest positions."""
    # The largest area may be near the largest double.
    relative = strain.m / strain.m.max()
    share = (relative / relative.sum()).astype(np.complex128)
    return strain.pull(share, np.zeros_like(share))


def _place_map(w: ComplexArray, exponent: int, fixed: IntArray, given: FloatArray) -> FloatArray:
    """Scale a map out of its units, with fixed vertices exactly at their given positions."""
    uv: FloatArray = np.ldexp(to_points(w), exponent)
    uv[fixed] = given[fixed]
    return uv


class FlattenDerivativeKeywords(DerivativeKeywords, total=False):
    """Types of the options of `flatten_derivative`."""

    fixed: ArrayLike | None


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
        fixed vertex the map can rotate about it, so the same holds for its rotation. If the energy is independent of
        scale (``"mips"``), the same holds for the map's size; without fixed vertices, this is the surface's area.

    Raises
    ------
    ValueError
        As `quasiharmonic.flatten`. If there are several surfaces, or ``uv`` is not injective.

    See Also
    --------
    flatten : The map alone.
    quasi_harmonic_derivative : The derivative of another map.
    polish_derivative : The derivative of another map.

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
    """Converge a flattened map to rounding, and differentiate it; see `flatten_derivative`.

    1. Find the transformations that do not change the energy. Constraints on one or two vertices exclude these.
    2. If the scale is free, converge at any scale, and scale the map to the surface's area.
    3. Converge to the minimum. If the map would then overlap itself, keep the map of step 2.
    """
    domain = Domain(V, F, () if options.fixed is None else options.fixed)
    chosen = find_energy(options.energy)
    start = check_injective(domain, uv, _NOT_FOUND)
    strain = _make_strain(domain)
    exponent = find_exponent(domain.V)
    w = in_units(start, exponent)
    measure = DeformationEnergy(
        np.ldexp(domain.V, -exponent),
        domain.F,
        chosen,
        weights=None if options.weights is None else positive_weights(options.weights, len(domain.F)),
    )
    gauge = _find_gauge(measure, w, domain)
    find_minimum = partial(_find_minimum, domain, measure, gauge, options.linear_solver)
    scale = None
    if gauge is not None and gauge.keeps_area:
        w = find_minimum(w).w
        size = float(np.ldexp(strain.m, -2 * exponent).sum())
        w = (w - w.mean()) * np.sqrt(size / signed_areas(domain.F, w).sum()) + w.mean()
        # Here s is the size of the surface alone, because the map is scaled to this size.
        scale = Scale(np.zeros_like(w), _differentiate_surface_size(strain))
    minimum, doubts = _converge_apart(domain, find_minimum, w)
    final_gauge = None if gauge is None else replace(gauge, w=minimum.w)
    equilibrium = _make_equilibrium(domain, minimum, strain, exponent, scale=scale, gauge=final_gauge)
    placed = _place_map(minimum.w, exponent, domain.fixed, start)
    return Derivative(placed, equilibrium, [*doubts, *minimum.doubts])


def _converge_apart(
    domain: Domain, find_minimum: Callable[..., Minimum], w: ComplexArray
) -> tuple[Minimum, list[Doubt]]:
    """Return the minimum near a map ``w``, or ``w`` itself with a doubt if its boundary is in contact with itself.

    A contact barrier of `flatten` keeps the boundary apart. The energy here lacks it, so Newton steps to its minimum
    would make the map overlap itself. Such a map stays, and the remaining forces are those of the contact.
    """
    minimum = find_minimum(w)
    if _overlaps(domain, minimum.w) and not _overlaps(domain, w):
        return find_minimum(w, converge=False), [Doubt.CONTACT]
    return minimum, []


def _find_minimum(
    domain: Domain,
    measure: DeformationEnergy,
    gauge: Gauge | None,
    linear_solver: str,
    w: ComplexArray,
    *,
    converge: bool = True,
) -> Minimum:
    """Return the minimum near a map ``w``, constrained by the gauge at this map; see `Minimum` for ``converge``."""
    fixed, sliding, tangent = domain.fixed, None, None
    if gauge is not None:
        fixed, sliding, tangent = replace(gauge, w=w).constraints()
    return Minimum(measure, w, Freedom(measure, w.size, fixed, linear_solver, sliding, tangent), converge=converge)


def _find_gauge(measure: DeformationEnergy, w: ComplexArray, domain: Domain) -> Gauge | None:
    """Return the transformations that do not change the energy; None if there are at least two fixed vertices."""
    if domain.fixed.size > 1:
        return None
    # Energies beyond the range of doubles are reported where derivatives are taken.
    with np.errstate(all="ignore"):
        scales = measure.is_scale_free(w)
    pin = int(domain.fixed[0]) if domain.fixed.size else None
    return Gauge(w, pin, scales, domain.loops)


def _overlaps(domain: Domain, w: ComplexArray) -> bool:
    """Return whether the boundary of a map touches or crosses itself."""
    return bool(check_loops(domain.loops, to_points(w))[1])
