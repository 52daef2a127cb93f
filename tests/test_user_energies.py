"""Users' energies with NaN or infinity: every function that takes an energy names the error and its location."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import (
    Problem,
    Status,
    animate,
    flatten,
    flatten_derivative,
    harmonise,
    injective_map,
    injective_maps,
    morph,
    polish,
    polish_derivative,
)
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import Deformation, QuadraticForm, SymmetricDirichlet
from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.surfaces import disk, grid

UV, F = disk(3)
V = np.column_stack([UV, 0.4 * UV[:, 0] ** 2 - 0.3 * UV[:, 1] ** 2 + 0.3 * UV[:, 0]])
RIM = boundary_loops(F, len(UV))[0]
PROBLEM = Problem(V, F, RIM, UV[RIM])
FUNCTIONS = {
    "polish": lambda energy: polish(V, F, UV, fixed=RIM, energy=energy),
    "slide": lambda energy: polish(V, F, UV, fixed=RIM, energy=energy, slide=True),
    "flatten": lambda energy: flatten(V, F, energy=energy),
    "start": lambda energy: flatten(V, F, energy=energy, start=UV),
    "harmonise": lambda energy: harmonise(V, F, UV, fixed=RIM, energy=energy),
    "polish_derivative": lambda energy: polish_derivative(V, F, UV, fixed=RIM, energy=energy),
    "flatten_derivative": lambda energy: flatten_derivative(V, F, UV, energy=energy),
    "animate": lambda energy: animate(PROBLEM, [UV[RIM], 1.1 * UV[RIM]], polish=energy),
    "morph": lambda energy: morph(UV, F, RIM, 1.1 * UV[RIM], energy=energy),
    "injective_map": lambda energy: injective_map(V, F, RIM, UV[RIM], polish=energy),
    "injective_maps": lambda energy: list(injective_maps([PROBLEM, PROBLEM], polish=energy)),
}
WORDS = {"density": "energy", "gradient": "first derivative", "curvature": "second derivative"}


class Spoilt(SymmetricDirichlet):
    """An energy with one wrong quantity at two triangles."""

    def __init__(self, part, value):
        self.part, self.value = part, value

    def density(self, d):
        return self.at_two("density", super().density(d))

    def gradient(self, d):
        by_p, by_q = super().gradient(d)
        return self.at_two("gradient", by_p), by_q

    def curvature(self, d, *, negative=0.0):
        form = super().curvature(d, negative=negative)
        self.at_two("curvature", form.pp)
        return form

    def at_two(self, part, values):
        if part == self.part:
            values[[3, 50]] = self.value
        return values


@pytest.mark.slow
@pytest.mark.parametrize(("value", "how"), [(np.nan, r"NaN"), (np.inf, "infinite")])
@pytest.mark.parametrize("part", WORDS)
@pytest.mark.parametrize("function", FUNCTIONS)
def test_energies_that_are_not_finite_are_named(function, part, value, how):
    if (function, part) == ("harmonise", "curvature"):
        # Harmonising does not use second derivatives.
        assert FUNCTIONS[function](Spoilt(part, value)).status is Status.POLISHED
        return
    with pytest.raises(ValueError, match=rf"Spoilt: the {WORDS[part]} is {how} at triangles 3, 50, where \|p\| = "):
        FUNCTIONS[function](Spoilt(part, value))


def test_an_energy_that_is_neither_a_barrier_nor_finite_for_inverted_triangles_is_named():
    class NoLogarithm(SymmetricDirichlet):
        barrier = False

        def density(self, d):
            return np.log(d.det) ** 2

    uv = UV.copy()
    uv[0] = 0.6, 0
    with pytest.raises(ValueError, match=r"NoLogarithm: the energy is NaN at triangles 0, "):
        harmonise(V, F, uv, fixed=RIM, energy=NoLogarithm())


def test_no_derivative_if_the_second_derivative_is_singular():
    square, right = grid(8, 8)
    corners = boundary_loops(right, len(square))[0]
    inside = np.flatnonzero(~np.isin(right, corners).any(axis=1))[0]

    class Area(SymmetricDirichlet):
        """The second derivative is that of a triangle's area, which is zero for translations of the triangle."""

        def curvature(self, d, *, negative=0.0):
            factor = np.zeros(len(d.det))
            factor[inside] = 2.0**20
            none = np.zeros(len(d.det), dtype=complex)
            return QuadraticForm(factor, -factor, none, none, none, none)

    with pytest.raises(ValueError, match="the second derivative of the energy at uv is singular"):
        polish_derivative(square, right, square, fixed=corners, energy=Area())


def test_overflow_at_a_triangle_dominated_by_rounding_is_not_blamed_on_the_energy():
    """A triangle shrunk to 1e-85, whose area, a rounding error, is too large."""
    energy = DeformationEnergy(V, F, SymmetricDirichlet())
    tiny = np.full(len(F), 1e-85 + 0j)
    energy.check_numbers(Deformation(tiny, tiny, np.full(len(F), 1e-100)))
