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
from functools import cached_property, partial
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.gradients.forces import Forces, TensorForces, TriangleResponse
from quasiharmonic.apps.gradients.gauge import Gauge
from quasiharmonic.apps.gradients.strain import Strain
from quasiharmonic.util.arrays import (
    ComplexArray,
    FloatArray,
    IntArray,
    check_finite,
    map_array,
    names_of,
    real_array,
    target_positions,
    work,
)


class Doubt(Enum):
    """A reason why a derivative may differ from finite differences of the map; the value is a sentence for the user."""

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
    """

    def __init__(
        self,
        target: Callable[[], FloatArray],
        rest: Callable[[], FloatArray],
        mu: Callable[[], ComplexArray | None],
    ) -> None:
        self._target, self._rest, self._mu = target, rest, mu

    @cached_property
    def target(self) -> FloatArray:
        """The gradient with respect to the target positions of the fixed vertices."""
        return self._target()

    @cached_property
    def rest(self) -> FloatArray:
        """The gradient with respect to the rest positions."""
        return self._rest()

    @cached_property
    def mu(self) -> ComplexArray | None:
        """The gradient with respect to the Beltrami coefficients."""
        return self._mu()


class Inverse(Protocol):
    """The inverse of the derivative of the forces by the free positions; symmetric."""

    def solve(self, load: ComplexArray) -> ComplexArray:
        """Return the displacement (n,) of all vertices under a load (n,); zero at fixed vertices."""


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
    """

    def __init__(
        self,
        uv: FloatArray,
        *,
        fixed: IntArray,
        forces: Forces,
        inverse: Inverse,
        strain: Callable[[], Strain] | None,
        rest_shape: tuple[int, ...],
        doubts: Iterable[Doubt] = (),
        unit: float = 1.0,
        on_curves: IntArray | None = None,
        scale: Scale | None = None,
        gauge: Gauge | None = None,
        tensors: TensorForces | None = None,
    ) -> None:
        self.uv = uv
        self.uv.flags.writeable = False
        self.doubts = tuple(doubts)
        self._fixed, self._forces, self._inverse = fixed, forces, inverse
        self._make_strain, self._rest_shape, self._unit = strain, rest_shape, unit
        self._follows = np.ones(fixed.size, dtype=bool) if on_curves is None else ~np.isin(fixed, on_curves)
        self._scale, self._gauge, self._tensors = scale, gauge, tensors

    @cached_property
    def _strain(self) -> Strain | None:
        return None if self._make_strain is None else self._make_strain()

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
        n, forces = len(self.uv), self._forces
        held = np.zeros(n, dtype=np.complex128)
        load = np.zeros(n, dtype=np.complex128)
        moved = np.zeros(self._rest_shape)
        if target is not None:
            positions = to_complex(target_positions(target, self._fixed.size)) / self._unit
            held[self._fixed[self._follows]] = positions[self._follows]
            load += forces.by_places(held)
        if rest is not None:
            moved = self._rest_positions(rest)
            if self._strain is not None:
                load += forces.by_strain(*self._strain.of(moved))
        if mu is not None:
            if self._tensors is None:
                raise ValueError("mu is supported only for quasi-harmonic maps")
            load += self._tensors.by_mu(forces, self._checked_mu(mu))
        more = 0.0 if self._scale is None else self._scale.change(held, moved)
        if self._scaled:
            load += more * forces.by_scale
        dw = held - self._inverse.solve(load)
        if self._gauge is not None:
            dw = self._gauge.select(dw, held, more)
        return to_rows(self._unit * dw)

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
        pull = self._unit * to_complex(map_array("cotangent", cotangent, len(self.uv)))
        on_pin, on_scale = 0j, 0.0
        if self._gauge is not None:
            pull, on_pin, on_scale = self._gauge.pull_back(pull)
        adjoint = self._inverse.solve(pull)
        response = self._forces.respond(adjoint)
        if self._scaled:
            on_scale -= work(self._forces.by_scale, adjoint)
        return Gradients(
            partial(self._by_target, pull, response, on_pin, on_scale),
            partial(self._by_rest, response, on_scale),
            partial(self._by_mu, response),
        )

    @property
    def _scaled(self) -> bool:
        """Whether the forces depend on the scale between map and surface."""
        return self._scale is not None and self._gauge is None

    def _by_target(
        self, pull: ComplexArray, response: TriangleResponse, on_pin: complex, on_scale: float
    ) -> FloatArray:
        by_places = pull - self._forces.gather(response.hp, response.hq)
        if self._scale is not None:
            by_places += on_scale * self._scale.by_places
        if self._gauge is not None and self._gauge.pin is not None:
            by_places[self._gauge.pin] += on_pin
        by_held = by_places[self._fixed] / self._unit
        by_held[~self._follows] = 0
        return to_rows(by_held)

    def _by_rest(self, response: TriangleResponse, on_scale: float) -> FloatArray:
        out = np.zeros(self._rest_shape)
        if self._strain is not None:
            out -= self._strain.pull(*self._forces.pull_strain(response))
        if self._scale is not None:
            out += on_scale * self._scale.by_rest
        return out

    def _by_mu(self, response: TriangleResponse) -> ComplexArray | None:
        return None if self._tensors is None else -self._tensors.of(self._forces, response)

    def _rest_positions(self, rest: ArrayLike) -> FloatArray:
        moved = real_array("rest", rest)
        if moved.shape != self._rest_shape:
            raise ValueError(f"rest must have the shape of the rest positions, {self._rest_shape}, not {moved.shape}")
        check_finite("rest", "vertex", "vertices", moved)
        return moved

    def _checked_mu(self, mu: ArrayLike) -> ComplexArray:
        array, f = np.asarray(mu), self._forces.share.size
        if array.shape != (f,) or array.dtype.kind not in "iufc":
            raise ValueError(
                f"mu must contain {f} numbers, one for each triangle, not {array.dtype} of shape {array.shape}"
            )
        if not np.isfinite(array).all():
            raise ValueError(
                f"mu is not finite at {names_of('triangle', 'triangles', np.flatnonzero(~np.isfinite(array)))}"
            )
        return array.astype(np.complex128)


def to_complex(rows: FloatArray) -> ComplexArray:
    """Return positions (n, 2) as complex numbers (n,)."""
    return np.ascontiguousarray(rows).view(np.complex128).ravel()


def to_rows(w: ComplexArray) -> FloatArray:
    """Return complex numbers (n,) as positions (n, 2)."""
    return np.ascontiguousarray(w).view(np.float64).reshape(-1, 2)
