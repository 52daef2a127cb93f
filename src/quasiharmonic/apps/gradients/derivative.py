"""The derivative of a map; the class that all kinds of maps share.

A map w of a surface with rest positions z, tensors μ and fixed vertices at t solves ``R(w, t, z, μ) = 0``: the forces
at the free vertices vanish. With K the derivative of R with respect to the unknowns,

    dw = −K⁻¹ (∂R/∂t dt + ∂R/∂z dz + ∂R/∂μ dμ).

For a function of the map with gradient c, one solve ``K ℓ = c`` gives all its gradients, ``−(∂R/∂t)ᵀ ℓ`` and so on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.gradients.forces import Forces, Strain, TensorForces, TriangleResponse
from quasiharmonic.apps.gradients.freedom import Gauge
from quasiharmonic.util.arrays import (
    BoolArray,
    ComplexArray,
    FloatArray,
    IntArray,
    check_finite,
    convert_array,
    map_array,
    real_array,
    target_positions,
    to_complex,
    to_points,
    work,
)


class Doubt(Enum):
    """A reason why a derivative may differ from finite differences of the map; the value is a sentence for the user.

    See Also
    --------
    Derivative : Lists them as ``doubts``.

    Examples
    --------
    >>> import numpy as np
    >>> from quasiharmonic import Problem, boundary_loops, quasi_harmonic_derivative
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(4)
    >>> (rim,) = boundary_loops(F)
    >>> quasi_harmonic_derivative(Problem(V, F, rim, V[rim])).doubts
    ()
    """

    NEAR_SINGULAR = (
        "The second derivative is singular up to rounding: maps next to this one are equally good, or a small change "
        "makes the map jump."
    )
    NOT_LEAST = "The second derivative has a negative direction: the map is stationary but not a minimum."
    NOT_AT_REST = "The map did not converge to rounding. The derivative treats the remaining forces as constant."
    NEAR_COLLAPSE = "Triangles of the map are so thin that rounding changes them noticeably."
    CONTACT = (
        "The boundary is in contact with itself: without the contact barrier the map would overlap itself. The "
        "derivative treats the contact forces as constant."
    )
    SLIDING = (
        "Sliding vertices are at a kink or an end of their curve. The derivative treats them as fixed; a small change "
        "may release them."
    )
    CLIPPED = "Tensors have the largest anisotropy that double precision allows, and no longer depend on μ."


@dataclass(frozen=True, eq=False)
class Scale:
    """A factor s between the scales of a map and its surface.

    Its fields are the derivatives of log s by the map, (n,) complex128, and by the rest positions, (n, d) float64.
    """

    by_places: ComplexArray
    by_rest: FloatArray

    def change(self, dw: ComplexArray, dV: FloatArray) -> float:
        """Return the change of log s."""
        return work(self.by_places, dw) + float(np.sum(self.by_rest * dV))


@dataclass(frozen=True, eq=False, kw_only=True)
class Equilibrium:
    """The forces at a map, all that they depend on, and the inverse of their derivative.

    ``fixed`` (k,) are the fixed vertices, and ``on_curves`` those of them whose positions curves determine. ``inverse``
    returns the displacement (n,) of all vertices under a load (n,), zero at fixed vertices; it is symmetric.
    ``make_strain`` makes the strain of the rest triangles when it is first used. ``unit`` is the unit of the forces'
    map, and ``rest_shape`` the shape of the rest positions.
    """

    fixed: IntArray
    forces: Forces
    inverse: Callable[[ComplexArray], ComplexArray]
    make_strain: Callable[[], Strain] | None
    rest_shape: tuple[int, ...]
    unit: float = 1.0
    on_curves: IntArray | None = None
    scale: Scale | None = None
    gauge: Gauge | None = None
    tensors: TensorForces | None = None

    @cached_property
    def follows(self) -> BoolArray:
        """Which fixed vertices move with their target positions; (k,) bool."""
        return np.ones(self.fixed.size, dtype=bool) if self.on_curves is None else ~np.isin(self.fixed, self.on_curves)

    @cached_property
    def strain(self) -> Strain | None:
        """The strain of the rest triangles; None if the map does not depend on them."""
        return None if self.make_strain is None else self.make_strain()

    @property
    def scaled(self) -> bool:
        """Whether the forces depend on the scale between map and surface."""
        return self.scale is not None and self.gauge is None


@dataclass(frozen=True, eq=False, repr=False)
class Gradients:
    """The gradients of a scalar function of a map, each computed at first access.

    Attributes
    ----------
    target : (k, 2) float64
        With respect to the target positions of the fixed vertices, in the order of ``fixed``.
    rest : (n, d) float64
        With respect to the rest positions.
    mu : (f,) complex128 or None
        With respect to the Beltrami coefficients, ``∂/∂Re μ + i ∂/∂Im μ``; None for maps without them.

    See Also
    --------
    Derivative : Its method `vjp` returns them.

    Examples
    --------
    >>> from quasiharmonic import Problem, boundary_loops, quasi_harmonic_derivative
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(4)
    >>> (rim,) = boundary_loops(F)
    >>> derivative = quasi_harmonic_derivative(Problem(V, F, rim, V[rim]))
    >>> gradients = derivative.vjp(derivative.uv)
    >>> gradients.target.shape, gradients.rest.shape, gradients.mu.shape
    ((24, 2), (61, 2), (96,))
    """

    _equilibrium: Equilibrium
    _pull: ComplexArray
    _response: TriangleResponse
    _on_pin: complex
    _on_scale: float

    @cached_property
    def target(self) -> FloatArray:
        """The gradient with respect to the target positions of the fixed vertices."""
        state = self._equilibrium
        by_places = self._pull - state.forces.gather(self._response.hp, self._response.hq)
        if state.scale is not None:
            by_places += self._on_scale * state.scale.by_places
        if state.gauge is not None and state.gauge.pin is not None:
            by_places[state.gauge.pin] += self._on_pin
        by_held = by_places[state.fixed] / state.unit
        by_held[~state.follows] = 0
        return to_points(by_held)

    @cached_property
    def rest(self) -> FloatArray:
        """The gradient with respect to the rest positions."""
        state = self._equilibrium
        out = np.zeros(state.rest_shape)
        if state.strain is not None:
            out -= state.strain.pull(*state.forces.pull_strain(self._response))
        if state.scale is not None:
            out += self._on_scale * state.scale.by_rest
        return out

    @cached_property
    def mu(self) -> ComplexArray | None:
        """The gradient with respect to the Beltrami coefficients."""
        tensors = self._equilibrium.tensors
        return None if tensors is None else -tensors.of(self._equilibrium.forces, self._response)


class Derivative:
    """The derivative of a map with respect to its inputs.

    Made by `quasi_harmonic_derivative`, `polish_derivative` and `flatten_derivative`, which factor the matrix. Each
    call of `jvp` or `vjp` takes one solve. Threads may share a derivative.

    Attributes
    ----------
    uv : (n, 2) float64
        The map, converged to rounding. It can differ slightly from the given map. Polished and flattened maps are
        certified as injective.
    doubts : tuple of Doubt
        Reasons not to rely on the derivative; usually empty.

    See Also
    --------
    quasi_harmonic_derivative : Makes it.
    polish_derivative : Makes it.
    flatten_derivative : Makes it.
    apps.gradients.Gradients : What `vjp` returns.

    Examples
    --------
    >>> import numpy as np
    >>> from quasiharmonic import Problem, boundary_loops, quasi_harmonic_derivative
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(4)
    >>> (rim,) = boundary_loops(F)
    >>> derivative = quasi_harmonic_derivative(Problem(V, F, rim, V[rim]))
    >>> derivative.reliable, derivative.jvp(target=np.ones((len(rim), 2))).shape
    (True, (61, 2))
    """

    def __init__(self, uv: FloatArray, equilibrium: Equilibrium, doubts: Iterable[Doubt] = ()) -> None:
        self.uv = uv
        self.uv.flags.writeable = False
        self.doubts = tuple(doubts)
        self._equilibrium = equilibrium

    @property
    def reliable(self) -> bool:
        """Whether there are no doubts."""
        return not self.doubts

    def jvp(
        self, *, target: ArrayLike | None = None, rest: ArrayLike | None = None, mu: ArrayLike | None = None
    ) -> FloatArray:
        """Return the change of the map for changes of its inputs.

        Parameters
        ----------
        target : (k, 2) array, optional
            Change of the target positions, in the order of ``fixed``. Boundary vertices that slide or are at corners of
            their curves are determined by the curves, so their entries are ignored.
        rest : (n, 2) or (n, 3) array, optional
            Change of the rest positions.
        mu : (f,) array, optional
            Change of the Beltrami coefficients, for maps that have them.

        Returns
        -------
        (n, 2) float64

        Raises
        ------
        ValueError
            If an argument has the wrong shape or is not finite, or ``mu`` is given for a map without tensors.
        """
        n, state = len(self.uv), self._equilibrium
        held = np.zeros(n, dtype=np.complex128)
        load = np.zeros(n, dtype=np.complex128)
        moved = np.zeros(state.rest_shape)
        if target is not None:
            positions = to_complex(target_positions(target, state.fixed.size)) / state.unit
            held[state.fixed[state.follows]] = positions[state.follows]
            load += state.forces.by_places(held)
        if rest is not None:
            moved = _check_rest(rest, state.rest_shape)
            if state.strain is not None:
                load += state.forces.by_strain(*state.strain.of(moved))
        if mu is not None:
            if state.tensors is None:
                raise ValueError("mu is supported only for quasi-harmonic maps")
            load += state.tensors.by_mu(state.forces, _check_mu(mu, state.forces.share.size))
        more = 0.0 if state.scale is None else state.scale.change(held, moved)
        if state.scaled:
            load += more * state.forces.by_scale
        dw = held - state.inverse(load)
        if state.gauge is not None:
            dw = state.gauge.select(dw, held, more)
        return to_points(state.unit * dw)

    def vjp(self, cotangent: ArrayLike) -> Gradients:
        """Return the gradients of a function of the map with respect to the map's inputs.

        Parameters
        ----------
        cotangent : (n, 2) array
            The function's gradient with respect to the map's positions.

        Returns
        -------
        Gradients

        Raises
        ------
        ValueError
            If the cotangent has the wrong shape or is not finite.
        """
        state = self._equilibrium
        pull = state.unit * to_complex(map_array("cotangent", cotangent, len(self.uv)))
        on_pin, on_scale = 0j, 0.0
        if state.gauge is not None:
            pull, on_pin, on_scale = state.gauge.pull_back(pull)
        adjoint = state.inverse(pull)
        if state.scaled:
            on_scale -= work(state.forces.by_scale, adjoint)
        return Gradients(state, pull, state.forces.respond(adjoint), on_pin, on_scale)


def _check_rest(rest: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    moved = real_array("rest", rest)
    if moved.shape != shape:
        raise ValueError(f"rest must have the shape of the rest positions, {shape}, not {moved.shape}")
    check_finite("rest", "vertex", "vertices", moved)
    return moved


def _check_mu(mu: ArrayLike, f: int) -> ComplexArray:
    array = convert_array("mu", mu)
    if array.shape != (f,) or array.dtype.kind not in "iufc":
        raise ValueError(
            f"mu must contain {f} numbers, one for each triangle, not {array.dtype} of shape {array.shape}"
        )
    check_finite("mu", "triangle", "triangles", array[:, None])
    return array.astype(np.complex128)
