"""The derivative of quasi-harmonic maps by tensors, target positions and rest positions.

The map solves a linear system, so a derivative needs one more solve with the same factor. The map is the stationary
point of the energy ``Σ m φ(p, q)``,

    φ = c (|p|² + |q|²) − 2 Re (ω p q̄),    c = (1 + |μ|²) / (1 − |μ|²),    ω = 2μ / (1 − |μ|²).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.gradients.derivative import Derivative, Doubt, Equilibrium
from quasiharmonic.apps.gradients.forces import CorrectedStrain, Forces, RestStrain, Strain, TensorForces
from quasiharmonic.energies.energies import QuadraticForm
from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.problem import Problem, check_problem
from quasiharmonic.solver.field.objective import Objective
from quasiharmonic.solver.field.tensor import TANH, beltrami_coefficients
from quasiharmonic.util.arrays import ComplexArray, check_choice, to_complex


def quasi_harmonic_derivative(
    problem: Problem,
    mu: ArrayLike | None = None,
    *,
    reference: Reference = "equilateral",
    linear_solver: str = "auto",
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
    >>> shifted = derivative.jvp(target=np.tile([1.0, 0.0], (36, 1)))  # the boundary moves, and everything with it
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
    c, twist = double - 1.0, double * field.mu
    zero = np.zeros_like(field.mu)
    form = QuadraticForm(pp=2 * c, qq=2 * c, p2=zero, q2=zero, pq=zero, pqc=-4 * twist)
    by_p, by_q = form.apply(dw.p, dw.q)
    corners = np.ascontiguousarray(problem.F.T)
    clipped = np.abs(field.mu - coefficients) > 1e-12
    equilibrium = Equilibrium(
        fixed=problem.fixed,
        forces=Forces(corners, problem.n, half, mesh.m, dw.p, dw.q, by_p, by_q, form),
        inverse=operator.respond,
        make_strain=strain,
        rest_shape=problem.V.shape,
        tensors=TensorForces(field),
    )
    return Derivative(uv, equilibrium, [Doubt.CLIPPED] if clipped.any() else [])
