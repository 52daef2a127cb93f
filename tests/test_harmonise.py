"""Quasi-harmonised energies: the descent and its results."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import (
    Energy,
    Problem,
    Status,
    boundary_loops,
    certify,
    distortion,
    harmonise,
    polish,
    quasi_harmonic_map,
)
from quasiharmonic.energies import polishing
from quasiharmonic.energies.deformation import DeformationEnergy, signed_areas
from quasiharmonic.energies.derivatives import check_energy
from quasiharmonic.energies.energies import MIPS, AreaPreserving, Combination
from quasiharmonic.linsolve import available
from quasiharmonic.solver.search.harmonising import ENERGIES, ETA
from quasiharmonic.surfaces import annulus, disk, grid, random_delaunay
from shared.distinct_steps import DistinctSteps
from shared.harmonising import bowl, energies_of, folded
from shared.meshes import bend, boundary_of

BARRIERS = set(polishing.ENERGIES)


class TestHarmonise:
    @pytest.mark.slow
    @pytest.mark.parametrize("name", ENERGIES)
    def test_lowers_the_energy_and_stays_certified(self, name):
        V, F, uv, fixed = bowl()
        result = harmonise(V, F, uv, fixed=fixed, energy=name)
        assert result.status in (Status.POLISHED, Status.STILL_FALLING)
        assert certify(F, result.uv).injective
        assert result.certificate.injective
        np.testing.assert_array_equal(result.uv[fixed], uv[fixed])
        area = float(signed_areas(F, uv @ (1, 1j)).sum())
        before, after = (
            DeformationEnergy(V, F, ENERGIES[name](V, F), area=area).value(w @ (1, 1j)) for w in (uv, result.uv)
        )
        assert after < 0.95 * before
        if name in BARRIERS:
            # Newton's method on the map itself, without tensors, finds this.
            least = polish(V, F, uv, fixed=fixed, energy=name, tol=1e-10).history[-1].energy
            assert least * (1 - 1e-9) < after < 1.01 * least

    @pytest.mark.slow
    def test_areas_become_as_equal_as_the_boundary_allows(self):
        V, F, uv, fixed = bowl()
        found = harmonise(V, F, uv, fixed=fixed, energy="area", conformal=0, max_iterations=80)
        barrier = Combination((1.0, AreaPreserving()), (1e-5, MIPS()))
        least = polish(V, F, uv, fixed=fixed, energy=barrier, tol=1e-10)
        assert least.status is found.status is Status.POLISHED
        uneven = [np.sum(d.share * (d.area_ratio - 1) ** 2) for d in (distortion(V, F, r.uv) for r in (least, found))]
        assert uneven[0] * (1 - 1e-3) < uneven[1] < 1.2 * uneven[0]

    @pytest.mark.slow
    @pytest.mark.parametrize("name", ["arap", "arap-unsigned", "area", "springs", None])
    def test_starts_from_any_map(self, name):
        """The map may even have inverted triangles, if the energy is finite."""
        problem, uv = folded()
        result = harmonise(
            problem.V, problem.F, uv, fixed=problem.fixed, energy=name, conformal=1.0 if name is None else 1e-3
        )
        assert result.injective
        assert result.certificate.bijective
        np.testing.assert_array_equal(result.uv[problem.fixed], problem.target)
        assert result.history[0].inverted > 0

    @pytest.mark.slow
    def test_as_the_paper_has_it(self):
        """One round with η = 1e-4 and without a barrier."""
        problem, uv = folded()
        result = harmonise(
            problem.V,
            problem.F,
            uv,
            fixed=problem.fixed,
            energy="arap-unsigned",
            eta=1e-4,
            conformal=0,
            max_iterations=100,
        )
        assert result.injective
        assert result.stages[0].name == "harmonise, arap-unsigned, η = 0.0001"

    @pytest.mark.slow
    def test_conformal_without_an_energy(self):
        """R₁ alone ends near the map with the least MIPS."""
        V, F, uv, fixed = bowl()
        found = harmonise(V, F, uv, fixed=fixed, energy=None, conformal=1.0)
        least = harmonise(V, F, uv, fixed=fixed, energy="mips", max_iterations=80)
        mips = [distortion(V, F, w).statistics("mips").mean for w in (uv, found.uv, least.uv)]
        assert mips[2] < mips[1] < mips[2] + 0.1 * (mips[0] - mips[2])

    @pytest.mark.slow
    def test_pins_and_inner_loops_do_not_move(self):
        V, F = annulus(12)
        pin = int(np.argmin(np.linalg.norm(V - [0.75, 0.1], axis=1)))
        uv, fixed = bend(V), np.append(boundary_of(F), pin)[::-1]
        result = harmonise(V, F, uv, fixed=fixed, energy="area")
        assert result.injective
        assert result.certificate.bijective
        np.testing.assert_array_equal(result.uv[fixed], uv[fixed])
        free = harmonise(V, F, uv, fixed=fixed[1:], energy="area")
        assert not np.array_equal(free.uv[pin], uv[pin])

    @pytest.mark.slow
    def test_weights_shift_the_distortion(self):
        V, F, uv, fixed = bowl()
        left = V[F].mean(axis=1)[:, 0] < 0
        shares = []
        for weights in (None, np.where(left, 30.0, 1.0), np.where(left, 1.0, 0.0)):
            result = harmonise(V, F, uv, fixed=fixed, energy="arap", weights=weights)
            assert result.injective
            found = distortion(V, F, result.uv)
            shares.append(np.sum((found.share * found.arap)[left]))
        assert shares[1] < 0.9 * shares[0]
        assert shares[2] < 0.9 * shares[0]

    @pytest.mark.slow
    def test_the_surfaces_own_scale(self):
        """Weighted triangles are undistorted in the surface's own scale; if the whole map is scaled, they are not."""
        V, F = disk(7)
        loose = np.linalg.norm(V[F].mean(axis=1), axis=1) > 0.5
        uv, fixed = 2 * V, boundary_of(F)
        inner = DeformationEnergy(V, F[~loose], ENERGIES["arap"](V, F))
        found = {}
        for scaled in (True, False):
            result = harmonise(V, F, uv, fixed=fixed, weights=~loose, scaled=scaled, max_iterations=100)
            assert result.injective
            found[scaled] = inner.value(result.uv @ (1, 1j))
        # σ₁ = σ₂ = 2 if it is scaled: a similarity, as before.
        assert found[True] == pytest.approx(2, rel=1e-6)
        assert found[False] < 0.02

    def test_the_scale_of_an_unscaled_energy(self):
        """E of the unscaled map, in any unit."""
        V, F, uv, fixed = bowl()
        for unit, energy in ((1, "arap"), (2.0**40, "springs"), (0.3, "symmetric-dirichlet")):
            known = DeformationEnergy(V * unit, F, ENERGIES[energy](V, F)).value(uv @ (1, 1j) * unit * 1.7)
            result = harmonise(
                V * unit, F, uv * unit * 1.7, fixed=fixed, energy=energy, conformal=0, scaled=False, max_iterations=2
            )
            assert result.history[0].energy == pytest.approx(known, rel=1e-9)

    def test_a_user_defined_energy(self):
        class Shear(Energy):
            """|q|² per unit of area: smooth, without a barrier and without second derivatives."""

            def density(self, d):
                return d.b

            def gradient(self, d):
                return np.zeros_like(d.p), 2 * d.q

        assert check_energy(Shear()).passed
        V, F, uv, fixed = bowl()
        result = harmonise(V, F, uv, fixed=fixed, energy=Shear())
        assert result.injective
        assert result.stages[0].name.startswith("harmonise, Shear")
        # With a fixed boundary this is the Dirichlet energy up to a constant: the harmonic map.
        harmonic = quasi_harmonic_map(Problem(V, F, fixed, uv[fixed]), reference="rest")
        np.testing.assert_allclose(result.uv, harmonic, atol=0.02)

    def test_is_deterministic_and_does_not_change_its_input(self):
        V, F, uv, fixed = bowl()
        before = [x.copy() for x in (V, F, uv, fixed)]
        for x in (V, F, uv, fixed):
            x.flags.writeable = False
        first, second = (harmonise(V, F, uv, fixed=fixed, energy="area", max_iterations=15) for _ in range(2))
        np.testing.assert_array_equal(first.uv, second.uv)
        assert energies_of(first).tolist() == energies_of(second).tolist()
        for x, y in zip((V, F, uv, fixed), before, strict=True):
            np.testing.assert_array_equal(x, y)
        assert not np.shares_memory(first.uv, uv)

    @pytest.mark.slow
    def test_is_never_worse_than_the_given_map(self):
        V, F, uv, fixed = bowl()
        best = harmonise(V, F, uv, fixed=fixed, energy="mips", max_iterations=100, eta=(1,) * 6, conformal=0)
        for eta in (1e-6, 1.0, 1e3):
            again = harmonise(V, F, best.uv, fixed=fixed, energy="mips", max_iterations=3, eta=eta, conformal=0)
            assert again.injective
            assert distortion(V, F, again.uv).statistics("mips").mean <= (
                distortion(V, F, best.uv).statistics("mips").mean * (1 + 1e-12)
            )

    def test_maps_that_cannot_be_improved(self, monkeypatch):
        """If all maps found have inverted triangles, the given map is returned, and the status says so."""
        V, F, uv, fixed = bowl()
        monkeypatch.setattr(
            "quasiharmonic.solver.search.harmonic_descent.inverted_triangles", lambda F, w: np.arange(3)
        )
        result = harmonise(V, F, uv, fixed=fixed, energy="arap", eta=0.1, max_iterations=3)
        assert result.injective
        assert result.status is not Status.POLISHED
        # The attempts to untangle are limited, too.
        assert all(stage.n_iterations <= 3 for stage in result.stages)

    @pytest.mark.slow
    def test_a_perfect_map_does_not_change(self):
        V, F = random_delaunay(30)
        for name in ENERGIES:
            result = harmonise(V, F, 3 * V, fixed=boundary_of(F), energy=name, max_iterations=10)
            assert result.injective
            np.testing.assert_allclose(result.uv, 3 * V, atol=1e-6)

    def test_steps_stages_and_interruption(self):
        V, F, uv, fixed = bowl()
        seen = DistinctSteps()
        result = harmonise(V, F, uv, fixed=fixed, energy="area", max_iterations=10, callback=seen.append)
        assert seen == result.history
        assert [step.iteration for step in seen] == list(range(len(seen)))
        assert sum(stage.n_iterations for stage in result.stages) == len(seen) - 1
        assert [stage.name for stage in result.stages[: len(ETA)]] == [f"harmonise, area, η = {eta:g}" for eta in ETA]
        assert result.stages[0].energy[0] == seen[0].energy
        assert all(stage.n_iterations <= 10 for stage in result.stages[: len(ETA)])

        def interrupt(step):
            if step.iteration == 12:
                raise KeyboardInterrupt

        stopped = harmonise(V, F, uv, fixed=fixed, energy="area", max_iterations=10, callback=interrupt)
        assert stopped.status is Status.INTERRUPTED
        assert stopped.injective
        assert len(stopped.history) == 13

    @pytest.mark.slow
    @pytest.mark.parametrize("linear_solver", available())
    def test_other_linear_solvers(self, linear_solver):
        V, F, uv, fixed = bowl()
        result = harmonise(V, F, uv, fixed=fixed, energy="mips", linear_solver=linear_solver)
        assert result.linear_solver == linear_solver
        expected = harmonise(V, F, uv, fixed=fixed, energy="mips")
        np.testing.assert_allclose(result.uv, expected.uv, atol=1e-2)

    @pytest.mark.parametrize("name", ENERGIES)
    def test_triangles_of_almost_zero_area(self, name):
        """Tensors beyond the range of doubles are clipped without an error."""
        V, F = disk(6)
        uv = V * np.linalg.norm(V, axis=1, keepdims=True) ** 11
        assert distortion(V, F, uv).area_ratio.min() < 1e-15
        result = harmonise(V, F, uv, fixed=boundary_of(F), energy=name, max_iterations=10)
        assert result.injective

    def test_malformed_input(self):
        V, F, uv, fixed = bowl()
        moved = uv.copy()
        moved[np.setdiff1d(np.arange(len(V)), fixed)[0]] = 5, 5
        with pytest.raises(ValueError, match=r"uv is not injective: triangles \d+.*repair the map first"):
            harmonise(V, F, moved, fixed=fixed, energy="mips")
        with pytest.raises(ValueError, match="energy must be one of arap, arap-unsigned, area"):
            harmonise(V, F, uv, fixed=fixed, energy="beauty")
        with pytest.raises(ValueError, match=r"uv must have shape \(80, 2\)"):
            harmonise(V, F, uv[1:], fixed=fixed)
        with pytest.raises(ValueError, match="encloses no area"):
            harmonise(V, F, uv * [1, -1], fixed=fixed)
        for eta in (0, -1, np.nan, [], [[1.0]], [1.0, np.inf]):
            with pytest.raises(ValueError, match="eta must be a positive number"):
                harmonise(V, F, uv, fixed=fixed, eta=eta)
        with pytest.raises(ValueError, match="eta must contain real numbers"):
            harmonise(V, F, uv, fixed=fixed, eta="much")
        for wrong in (-1, np.inf, np.nan, None, "little"):
            with pytest.raises(ValueError, match="conformal must be a finite number of at least 0"):
                harmonise(V, F, uv, fixed=fixed, conformal=wrong)
            with pytest.raises(ValueError, match="tol must be a finite number of at least 0"):
                harmonise(V, F, uv, fixed=fixed, tol=wrong)
        with pytest.raises(ValueError, match="conformal must be positive if energy is None"):
            harmonise(V, F, uv, fixed=fixed, energy=None, conformal=0)
        with pytest.raises(ValueError, match="weights belong to the energy"):
            harmonise(V, F, uv, fixed=fixed, energy=None, conformal=1, weights=np.ones(len(F)))
        with pytest.raises(ValueError, match="weights must have shape"):
            harmonise(V, F, uv, fixed=fixed, weights=np.ones(3))
        with pytest.raises(ValueError, match="reference must be one of"):
            harmonise(V, F, uv, fixed=fixed, reference="round")
        with pytest.raises(ValueError, match="iterations must be an integer"):
            harmonise(V, F, uv, fixed=fixed, max_iterations=0)

    @pytest.mark.slow
    def test_flat_rest_triangles(self):
        """The energy is undefined there; R₁ with triangles of another shape is not."""
        V, F, uv, fixed = bowl()
        flat = V.copy()
        flat[F[7, 0]] = flat[F[7, 1]]
        for reference in ("rest", "equilateral", "corrected"):
            with pytest.raises(ValueError, match=r"7.* of zero area in the rest mesh: distortion is undefined there"):
                harmonise(flat, F, uv, fixed=fixed, reference=reference)
        with pytest.raises(ValueError, match="choose the reference 'equilateral'"):
            harmonise(flat, F, uv, fixed=fixed, energy=None, conformal=1)
        result = harmonise(flat, F, uv, fixed=fixed, energy=None, conformal=1, reference="equilateral")
        assert result.injective
        assert result.history[-1].energy < result.history[0].energy

    def test_overflow_is_not_convergence(self):
        V, F, uv, fixed = bowl()
        for options in ({"eta": 1e300}, {"weights": np.full(len(F), 1e300)}):
            result = harmonise(V, F, uv, fixed=fixed, energy="area", max_iterations=10, **options)
            assert result.injective
            assert result.status in (Status.STILL_FALLING, Status.UNIMPROVED)

    def test_problems_without_a_map(self):
        """The reason is searched for and reported."""
        V, F = grid(3, 3)
        (loop,) = boundary_loops(F, len(V))
        # The boundary crosses itself.
        target = V[loop].copy()
        target[[1, 5]] = target[[5, 1]]
        problem = Problem(V, F, loop, target)
        result = harmonise(
            problem.V, problem.F, quasi_harmonic_map(problem), fixed=problem.fixed, energy="arap", max_iterations=5
        )
        assert not result.injective
        assert result.status is Status.IMPOSSIBLE
        assert result.diagnosis.forbids_injective
        assert result.to_dict()["diagnosis"]["forbids_injective"] is True
