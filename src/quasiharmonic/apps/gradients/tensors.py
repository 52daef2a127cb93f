"""The derivative of quasi-harmonic maps: by the tensors, by the fixed vertices' places, by the surface.

The map is the solution of a linear system, so there is no more to it than one solve with the factor that the map itself
took. Written as forces, it is at rest with the energy ``Σ m φ(p, q)``,

    φ = c (|p|² + |q|²) − 2 Re (ω p q̄),    c = (1 + |μ|²) / (1 − |μ|²),    ω = 2μ / (1 − |μ|²).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.gradients.derivative import Derivative, Doubt, as_complex
from quasiharmonic.apps.gradients.forces import Forces
from quasiharmonic.apps.gradients.strain import CorrectedStrain, RestStrain, Strain
from quasiharmonic.apps.gradients.tensor_forces import TensorForces
from quasiharmonic.energies.energies import QuadraticForm
from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.linsolve.laplacian import FactoredLaplacian
from quasiharmonic.problem import Problem
from quasiharmonic.solver.field.objective import Objective
from quasiharmonic.solver.field.tensor import TANH, beltrami_coefficients
from quasiharmonic.util.arrays import ComplexArray, check_choice


class _Response:
    """A factored Laplacian as a derivative asks for its inverse."""

    def __init__(self, operator: FactoredLaplacian) -> None:
        self._operator = operator

    def solve(self, load: ComplexArray) -> ComplexArray:
        return self._operator.respond(load)


def quasi_harmonic_derivative(
    problem: Problem,
    mu: ArrayLike | None = None,
    *,
    reference: Reference = "equilateral",
    linear_solver: str = "auto",
) -> Derivative:
    """The quasi-harmonic map of a tensor field, and its derivative by tensors, held places and rest positions.

    Parameters
    ----------
    problem, mu, reference, linear_solver
        As of `quasiharmonic.quasi_harmonic_map`.

    Returns
    -------
    Derivative
        Its ``uv`` is that map, to the last bit. With the reference ``"equilateral"`` the rest positions do not matter.

    Raises
    ------
    ValueError
        As `quasiharmonic.quasi_harmonic_map`.
    quasiharmonic.linsolve.NotPositiveDefinite
        When rounding leaves no positive definite Laplacian.

    Notes
    -----
    The factor is the one that the map took. All derivatives on one `Problem` share the memory of a single one, so where
    two of them with different tensors are asked by turns, it is made anew.

    Examples
    --------
    >>> import numpy as np
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(6)
    >>> rim = np.arange(len(V) - 36, len(V))
    >>> derivative = quasi_harmonic_derivative(Problem(V, F, rim, V[rim]))
    >>> shifted = derivative.jvp(target=np.tile([1.0, 0.0], (36, 1)))  # the boundary moves, and everything with it
    >>> bool(np.allclose(shifted, [1, 0]))
    True
    """
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
    dw = mesh.derivatives(as_complex(uv - problem.frame.centre))
    double = 2.0 / field.defect
    c, twist = double - 1.0, double * field.mu
    zero = np.zeros_like(field.mu)
    form = QuadraticForm(pp=2 * c, qq=2 * c, p2=zero, q2=zero, pq=zero, pqc=-4 * twist)
    by_p, by_q = form.apply(dw.p, dw.q)
    corners = np.ascontiguousarray(problem.F.T)
    clipped = np.abs(field.mu - coefficients) > 1e-12
    return Derivative(
        uv,
        fixed=problem.fixed,
        forces=Forces(corners, problem.n, half, mesh.m, dw.p, dw.q, by_p, by_q, form),
        inverse=_Response(operator),
        strain=strain,
        rest_shape=problem.V.shape,
        doubts=[Doubt.CLIPPED] if clipped.any() else [],
        tensors=TensorForces(field),
    )
