"""Polishing: less distortion, and injective at every step."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import Energy, Status, distortion, is_injective, polish
from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.energies.energies import ARAP, MIPS, AreaPreserving, conformal_area_blend
from quasiharmonic.energies.newton import map_model
from quasiharmonic.energies.newton.newton_system import NewtonSystem
from quasiharmonic.energies.polishing import ENERGIES, polish_map
from quasiharmonic.energies.springs import MassSpring
from quasiharmonic.linsolve import NotPositiveDefinite, available
from quasiharmonic.problem import Domain
from quasiharmonic.surfaces import annulus, disk, grid, random_delaunay
from quasiharmonic.util.options import PolishOptions
from shared.distinct_steps import DistinctSteps
from shared.meshes import bend, boundary_of, lift
from shared.polygons import circle


def twisted(V, turns=0.2):
    """Rotate points by an angle that decreases to zero at the unit circle."""
    angle = 2 * np.pi * turns * (1 - V[:, 0] ** 2 - V[:, 1] ** 2)
    z = (V[:, 0] + 1j * V[:, 1]) * np.exp(1j * angle)
    return np.stack([z.real, z.imag], axis=1)


def shrunken(rings=12, power=8):
    """A disk contracted at its centre: the innermost triangles have rings^(2 - 2 power) of their area."""
    V, F = disk(rings)
    return V, F, V * np.linalg.norm(V, axis=1, keepdims=True) ** (power - 1)


def bowl():
    V, F = random_delaunay(150, seed=3)
    return lift(V), F, twisted(V), boundary_of(F)


def energies_of(result):
    return np.array([step.energy for step in result.history])


@pytest.mark.parametrize("energy", ENERGIES)
def test_decreases_at_every_step_and_converges(energy):
    V, F, uv, fixed = bowl()
    result = polish(V, F, uv, fixed=fixed, energy=energy, tol=1e-8)
    assert result.status is Status.POLISHED
    assert result.injective
    assert is_injective(F, result.uv)
    assert np.all(np.diff(energies_of(result)) < 0)
    np.testing.assert_array_equal(result.uv[fixed], uv[fixed])
    # A local minimum: nothing close to it is better, up to the remaining gain.
    rng = np.random.default_rng(0)
    free = np.setdiff1d(np.arange(len(V)), fixed)
    for size in (1e-3, 1e-2):
        moved = result.uv.copy()
        moved[free] += size * rng.standard_normal((free.size, 2)) * 0.05
        there = polish(V, F, moved, fixed=fixed, energy=energy, max_iterations=0)
        assert there.history[0].energy > result.history[-1].energy * (1 - 1e-6)


def test_energies_are_means_of_the_measures():
    V, F, uv, fixed = bowl()
    for energy in ("mips", "symmetric-dirichlet"):
        result = polish(V, F, uv, fixed=fixed, energy=energy)
        name = energy.replace("-", "_")
        assert result.history[0].energy == pytest.approx(distortion(V, F, uv).statistics(name).mean)
        assert result.history[-1].energy == pytest.approx(distortion(V, F, result.uv).statistics(name).mean)
        (stage,) = result.stages
        assert stage.energy == (result.history[0].energy, result.history[-1].energy)
        assert stage.n_iterations == len(result.history) - 1
        assert stage.name == f"polish, {energy}"


def test_every_intermediate_map_is_injective():
    V, F, uv = shrunken()
    fixed = boundary_of(F)
    for steps in range(6):
        result = polish(V, F, uv, fixed=fixed, max_iterations=steps)
        assert is_injective(F, result.uv)
        assert len(result.history) == steps + 1
        assert result.status is Status.STILL_FALLING
        np.testing.assert_array_equal(result.uv[fixed], uv[fixed])


@pytest.mark.parametrize("energy", ["symmetric-dirichlet", "blend", "arap-barrier"])
def test_triangles_of_almost_zero_area_recover(energy):
    V, F, uv = shrunken()
    assert distortion(V, F, uv).area_ratio.min() < 1e-14
    result = polish(V, F, uv, fixed=boundary_of(F), energy=energy, tol=1e-10)
    assert result.status is Status.POLISHED
    np.testing.assert_allclose(result.uv, V, atol=1e-6)


def test_a_very_thin_map():
    # Rows at heights 1e-0 … 1e-11: some images have 1e-24 of the area of others.
    V, F, uv = shrunken(rings=12, power=12)
    assert distortion(V, F, uv).area_ratio.min() < 1e-22
    result = polish(V, F, uv, fixed=boundary_of(F), energy="mips")
    assert result.injective
    assert result.history[-1].energy < 0.01 * result.history[0].energy


@pytest.mark.parametrize("energy", ENERGIES)
def test_an_area_lost_to_rounding(energy):
    # The area of the last triangle is ε²/2, which is 0 in floating point but is positive.
    e = 2.0**-52
    uv = np.array([[0, 0], [2, 0], [1 + e, 1], [1, 1 - e]])
    F = np.array([[0, 1, 3], [1, 2, 3], [0, 3, 2]])
    V = np.array([[0, 0], [2, 0], [1, 2], [1, 0.7]])
    assert signed_areas(F, uv.view(complex).ravel())[2] == 0
    assert is_injective(F, uv)
    result = polish(V, F, uv, fixed=[0, 1, 2], energy=energy)
    assert result.status is Status.POLISHED
    assert distortion(V, F, result.uv).area_ratio.min() > 0.1


def nested_triangles(inner):
    """A triangle (3, 4, 5) within another and the region between them; the inner one has a given size."""
    corners = circle(3)
    F = np.array([[3, 4, 5], [0, 1, 3], [1, 4, 3], [1, 2, 4], [2, 5, 4], [2, 0, 5], [0, 3, 5]])
    return np.concatenate([corners, inner * corners]), F


@pytest.mark.parametrize("energy", ENERGIES)
@pytest.mark.parametrize("iterations", [0, 5])
@pytest.mark.parametrize(
    ("outer", "inner", "slide"), [(1e300, 1e-25, False), (1e300, 1e-300, False), (3, 1e-320, True)]
)
def test_coordinates_with_a_larger_range_than_one_unit(energy, iterations, outer, inner, slide):
    V, F = nested_triangles(0.3)
    uv = nested_triangles(1.0)[0] * np.repeat([[outer], [inner]], 3, axis=0)
    assert is_injective(F, uv)
    result = polish(V, F, uv, fixed=[0, 1, 2], energy=energy, max_iterations=iterations, slide=slide)
    assert result.injective
    assert is_injective(F, result.uv)
    if iterations == 0:
        np.testing.assert_array_equal(result.uv, uv)


@pytest.mark.parametrize("thin", [1e-2, 1e-4, 1e-6, 1e-7, 1e-8, 1e-10])
def test_a_compressed_square(thin):
    V, F = grid(10, 10)
    x, y = V.T
    bump = x * (1 - x) * y * (1 - y)
    uv = np.stack([x + bump, thin * (y + bump)], axis=1)
    result = polish(V, F, uv, fixed=boundary_of(F))
    # The optimum compresses all of it equally.
    least = 2 * thin + 2 / thin - 4
    if thin >= 1e-7:
        assert result.status is Status.POLISHED
        assert result.history[-1].energy < (1 + 1e-4) * least
    else:
        # The remaining gain along the rectangle is below the rounding error across it, and the status says so.
        assert result.status is Status.EXHAUSTED
    assert result.injective


def test_a_perfect_map_does_not_change():
    V, F = random_delaunay(60)
    for energy in ENERGIES:
        result = polish(V, F, 3 * V, fixed=boundary_of(F), energy=energy)
        assert result.status is Status.POLISHED
        np.testing.assert_allclose(result.uv, 3 * V, atol=1e-12)


def test_pins_and_inner_loops_do_not_move():
    V, F = annulus(12)
    pin = int(np.argmin(np.linalg.norm(V - [0.75, 0.1], axis=1)))
    uv = bend(V)
    fixed = np.append(boundary_of(F), pin)
    result = polish(V, F, uv, fixed=fixed[::-1])
    assert result.status is Status.POLISHED
    np.testing.assert_array_equal(result.uv[fixed], uv[fixed])
    free = polish(V, F, uv, fixed=fixed[:-1])
    assert not np.array_equal(free.uv[pin], uv[pin])
    assert free.history[-1].energy < result.history[-1].energy


def test_nothing_can_move():
    V, F = disk(1)
    result = polish(V, F, V, fixed=np.arange(len(V)))
    assert result.status is Status.POLISHED
    np.testing.assert_array_equal(result.uv, V)


@pytest.mark.parametrize("power", [-600, 0, 600])
def test_scales_of_map_and_surface_do_not_matter(power):
    V, F, uv, fixed = bowl()
    expected = polish(V, F, uv, fixed=fixed, max_iterations=4)
    found = polish(np.ldexp(V, -power), F, np.ldexp(uv, power), fixed=fixed, max_iterations=4)
    np.testing.assert_array_equal(np.ldexp(found.uv, -power), expected.uv)


def test_rotation_and_translation_change_almost_nothing():
    V, F, uv, fixed = bowl()
    turn = np.array([[0.6, 0.8], [-0.8, 0.6]])
    expected = polish(V, F, uv, fixed=fixed, tol=1e-10)
    found = polish(V[:, [1, 2, 0]], F, uv @ turn + [1000, -500], fixed=fixed, tol=1e-10)
    assert found.status is Status.POLISHED
    np.testing.assert_allclose(found.uv, expected.uv @ turn + [1000, -500], atol=1e-5)


def test_is_deterministic_and_does_not_change_its_input():
    V, F, uv, fixed = bowl()
    before = [x.copy() for x in (V, F, uv, fixed)]
    for x in (V, F, uv, fixed):
        x.flags.writeable = False
    first, second = (polish(V, F, uv, fixed=fixed) for _ in range(2))
    np.testing.assert_array_equal(first.uv, second.uv)
    assert energies_of(first).tolist() == energies_of(second).tolist()
    for x, y in zip((V, F, uv, fixed), before, strict=True):
        np.testing.assert_array_equal(x, y)
    assert not np.shares_memory(first.uv, uv)


def test_weights_shift_the_distortion():
    V, F, uv, fixed = bowl()
    left = V[F].mean(axis=1)[:, 0] < 0
    plain = polish(V, F, uv, fixed=fixed)
    weighted = polish(V, F, uv, fixed=fixed, weights=np.where(left, 100.0, 1.0))

    def on_the_left(result):
        found = distortion(V, F, result.uv)
        return np.sum((found.share * found.symmetric_dirichlet)[left])

    assert weighted.injective
    assert on_the_left(weighted) < on_the_left(plain)


def test_a_user_defined_energy():
    V, F, uv, fixed = bowl()
    by_name = polish(V, F, uv, fixed=fixed, energy="blend")
    by_hand = polish(V, F, uv, fixed=fixed, energy=conformal_area_blend(1 / 128))
    np.testing.assert_array_equal(by_hand.uv, by_name.uv)
    assert by_hand.stages[0].name == "polish, Combination"
    areas = polish(V, F, uv, fixed=fixed, energy=conformal_area_blend(1.0), max_iterations=200)
    assert distortion(V, F, areas.uv).area_ratio.std() < 0.5 * distortion(V, F, uv).area_ratio.std()


@pytest.mark.parametrize(
    ("spoilt", "words"),
    [
        ("density", "the energy is"),
        ("density_gradient", "the first derivative is"),
        ("density_hessian", "the second derivative is"),
    ],
)
def test_a_user_defined_energy_that_is_not_finite_is_named(spoilt, words):
    class Spoilt(MIPS):
        def density(self, d):
            return self.at_some("density", super().density(d))

        def density_gradient(self, d):
            return tuple(self.at_some("density_gradient", part) for part in super().density_gradient(d))

        def density_hessian(self, d):
            return tuple(self.at_some("density_hessian", part) for part in super().density_hessian(d))

        def at_some(self, what, values):
            values = np.array(values)
            if what == spoilt:
                values[[3, 50]] = np.nan
            return values

    V, F, uv, fixed = bowl()
    with pytest.raises(ValueError, match=rf"Spoilt: {words} NaN at triangles 3, 50, where \|p\| = "):
        polish(V, F, uv, fixed=fixed, energy=Spoilt())


def test_an_existing_problem():
    V, F, uv, fixed = bowl()
    expected = polish(V, F, uv, fixed=fixed, energy="mips")
    found = polish_map(Domain(V, F, fixed), uv, PolishOptions(energy="mips"))
    np.testing.assert_array_equal(found.uv, expected.uv)


@pytest.mark.parametrize("linear_solver", available())
def test_other_linear_solvers(linear_solver):
    V, F, uv, fixed = bowl()
    expected = polish(V, F, uv, fixed=fixed, tol=1e-9)
    found = polish(V, F, uv, fixed=fixed, tol=1e-9, linear_solver=linear_solver)
    assert found.linear_solver == linear_solver
    np.testing.assert_allclose(found.uv, expected.uv, atol=1e-6)


def test_steps_are_reported_as_they_happen():
    V, F, uv, fixed = bowl()
    seen = DistinctSteps()
    result = polish(V, F, uv, fixed=fixed, callback=seen.append)
    assert seen == result.history
    assert [step.iteration for step in seen] == list(range(len(seen)))
    assert {step.inverted for step in seen} == {0}


def test_interruption_keeps_the_best_map():
    V, F, uv, fixed = bowl()

    def interrupt(step):
        if step.iteration == 2:
            raise KeyboardInterrupt

    result = polish(V, F, uv, fixed=fixed, callback=interrupt)
    expected = polish(V, F, uv, fixed=fixed, max_iterations=2)
    assert result.status is Status.INTERRUPTED
    np.testing.assert_array_equal(result.uv, expected.uv)
    assert result.injective


def test_steps_rejected_by_the_exact_test_are_not_taken(monkeypatch):
    V, F, uv, fixed = bowl()
    full = polish(V, F, uv, fixed=fixed, max_iterations=1)
    asked = []

    def strict(F, uv):
        asked.append(uv)
        return len(asked) == 3

    monkeypatch.setattr(map_model, "is_injective", strict)
    result = polish(V, F, uv, fixed=fixed, max_iterations=1)
    # Rejected twice, halved twice.
    np.testing.assert_allclose(result.uv - uv, (asked[0] - uv) / 4, atol=1e-14)
    np.testing.assert_array_equal(result.uv, asked[2])
    assert np.abs(full.uv - uv).max() >= np.abs(asked[0] - uv).max()
    monkeypatch.setattr(map_model, "is_injective", lambda F, uv: False)
    result = polish(V, F, uv, fixed=fixed)
    assert result.status is Status.EXHAUSTED
    np.testing.assert_array_equal(result.uv, uv)


def test_descends_without_factorisations(monkeypatch):
    V, F, uv, fixed = bowl()
    shifts = []

    def refuse(self, shift=0.0):
        shifts.append(shift)
        if shift < 1e-7:
            raise NotPositiveDefinite("refused")
        return factor(self, shift)

    factor = NewtonSystem.factor
    monkeypatch.setattr(NewtonSystem, "factor", refuse)
    raised = polish(V, F, uv, fixed=fixed)
    assert raised.status is Status.POLISHED
    assert shifts[:4] == [1e-15, 1e-12, 1e-9, 1e-6]

    def never(self, shift=0.0):
        raise NotPositiveDefinite("refused")

    monkeypatch.setattr(NewtonSystem, "factor", never)
    result = polish(V, F, uv, fixed=fixed, max_iterations=5)
    assert result.injective
    assert np.all(np.diff(energies_of(result)) < 0)


def test_starts_that_are_not_injective():
    V, F, uv, fixed = bowl()
    moved = uv.copy()
    inner = int(np.setdiff1d(np.arange(len(V)), fixed)[0])
    moved[inner] = 5, 5
    with pytest.raises(ValueError, match=r"uv is not injective: triangles \d+, .* inverted or degenerate"):
        polish(V, F, moved, fixed=fixed)
    moved[inner] = np.nan, 0
    with pytest.raises(ValueError, match="uv is not finite at vertex"):
        polish(V, F, moved, fixed=fixed)


def test_malformed_input():
    V, F, uv, fixed = bowl()
    flat = V.copy()
    flat[F[7]] = flat[F[7, 0]]
    with pytest.raises(ValueError, match="of zero area in the rest mesh"):
        polish(flat, F, uv, fixed=fixed)
    with pytest.raises(ValueError, match=r"boundary vertex .* not in fixed"):
        polish(V, F, uv, fixed=fixed[1:])
    with pytest.raises(ValueError, match="fixed refers to vertex"):
        polish(V, F, uv, fixed=np.append(fixed, len(V)))
    with pytest.raises(ValueError, match=r"uv must have shape \(150, 2\)"):
        polish(V, F, uv[:-1], fixed=fixed)
    with pytest.raises(ValueError, match="energy must be one of symmetric-dirichlet, mips"):
        polish(V, F, uv, fixed=fixed, energy="beauty")
    for energy in (ARAP(), AreaPreserving(), MassSpring(V, F)):
        with pytest.raises(ValueError, match=f"{type(energy).__name__} is not a barrier energy"):
            polish(V, F, uv, fixed=fixed, energy=energy)
    weights = np.ones(len(F))
    weights[3] = 0
    with pytest.raises(ValueError, match="weight is not positive at triangle 3"):
        polish(V, F, uv, fixed=fixed, weights=weights)
    with pytest.raises(ValueError, match="weights must have shape"):
        polish(V, F, uv, fixed=fixed, weights=weights[4:])


def test_barriers_may_be_objects():
    V, F, uv, fixed = bowl()
    assert polish(V, F, uv, fixed=fixed, energy=MIPS()).status is Status.POLISHED


def test_invalid_options():
    V, F, uv, fixed = bowl()
    for wrong in (-1, 2.5, "many", None):
        with pytest.raises(ValueError, match="max_iterations must be an integer of at least 0"):
            polish(V, F, uv, fixed=fixed, max_iterations=wrong)
    for wrong in (-1, np.nan, np.inf, "small", None):
        with pytest.raises(ValueError, match="tol must be a finite number of at least 0"):
            polish(V, F, uv, fixed=fixed, tol=wrong)
    with pytest.raises(ValueError, match="weights must contain real numbers, not <U5"):
        polish(V, F, uv, fixed=fixed, weights=["heavy"] * len(F))

    class FirstOnly(Energy):
        barrier = True

        def density(self, d):
            return 1 / d.det

        def gradient(self, d):
            return -2 * d.p / d.det**2, 2 * d.q / d.det**2

    with pytest.raises(ValueError, match=r"FirstOnly has no second derivatives, .* use `harmonise`"):
        polish(V, F, uv, fixed=fixed, energy=FirstOnly())
