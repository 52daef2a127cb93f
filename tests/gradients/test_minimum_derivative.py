"""Derivatives of polished and flattened maps against differences, and when they are doubtful."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from quasiharmonic import BoundaryCurves, certify, flatten, flatten_derivative, injective_map, polish, polish_derivative
from quasiharmonic.apps.gradients import Doubt
from quasiharmonic.energies.deformation import DeformationEnergy, signed_areas
from quasiharmonic.energies.energies import Isotropic, SymmetricDirichlet
from quasiharmonic.geometry.curves import Curve
from quasiharmonic.surfaces import disk, grid
from shared.derivative_problems import (
    aligned,
    flattened_ring,
    polished_ring,
    ring,
    worst_difference,
)


class NeoHookean(Isotropic):
    """A user's energy."""

    barrier = True

    def density(self, d):
        return np.where(d.det > 0, 2 * (d.a + d.b - 1 - np.log(np.abs(d.det))), np.inf)

    def density_gradient(self, d):
        return 2 - 2 / d.det, 2 + 2 / d.det

    def density_hessian(self, d):
        return 2 / d.det**2, -2 / d.det**2, 2 / d.det**2


ENERGIES = ["symmetric-dirichlet", "mips", "blend", "arap-barrier", NeoHookean()]


@pytest.mark.parametrize("energy", ENERGIES, ids=lambda e: e if isinstance(e, str) else "own")
@pytest.mark.parametrize("curved", [False, True], ids=["flat", "curved"])
def test_polished_against_differences(energy, curved):
    problem, uv = polished_ring(energy, curved)
    weights = 1 + np.random.default_rng(0).random(len(problem.F))

    def make(target, rest):
        start = uv.copy()
        start[problem.fixed] = target
        return polish_derivative(rest, problem.F, start, fixed=problem.fixed, energy=energy, weights=weights)

    off, skew = worst_difference(make, {"target": problem.target, "rest": problem.V})
    assert off < 1e-7
    assert skew < 1e-12


@pytest.mark.parametrize("pins", [(), (3,), (3, 20, 31)], ids=["free", "one pin", "three pins"])
@pytest.mark.parametrize("energy", ["symmetric-dirichlet", "mips"])
def test_flattened_against_differences(energy, pins):
    V, F, fixed, places, uv = flattened_ring(pins, energy)

    def make(rest, target=places):
        start = uv.copy()
        start[fixed] = target
        return flatten_derivative(rest, F, start, fixed=fixed, energy=energy)

    onto = {0: aligned, 1: partial(aligned, pin=3, scales=energy == "mips")}.get(len(pins))
    arguments = {"rest": V, "target": places} if len(pins) else {"rest": V}
    off, skew = worst_difference(make, arguments, onto)
    assert off < 1e-7
    assert skew < 1e-11


def test_a_flat_surface_with_units():
    """Rest positions and map in very different units, which also differ from 1."""
    V, F = ring()
    derivative = flatten_derivative(1e-7 * V, F, flatten(1e-7 * V, F).uv)
    moved = derivative.jvp(rest=V)
    assert np.allclose(aligned(moved, V), V, atol=1e-8)
    problem, uv = polished_ring()
    one = polish_derivative(problem.V, problem.F, uv, fixed=problem.fixed)
    other = polish_derivative(1e9 * problem.V, problem.F, 1e-6 * uv, fixed=problem.fixed)
    assert np.allclose(other.jvp(rest=1e9 * problem.V**2), 1e-6 * one.jvp(rest=problem.V**2), rtol=1e-9, atol=1e-15)
    assert np.allclose(other.vjp(uv).target, one.vjp(uv).target, rtol=1e-9, atol=1e-9)


def test_a_free_map_has_an_aligned_derivative():
    V, F, _, _, uv = flattened_ring()
    derivative = flatten_derivative(V, F, uv)
    moved = derivative.jvp(rest=np.random.default_rng(0).standard_normal(V.shape)) @ (1, 1j)
    arms = derivative.uv @ (1, 1j)
    arms -= arms.mean()
    size = np.abs(moved).sum()
    assert abs(moved.sum()) < 1e-12 * size
    assert abs(np.vdot(arms, moved).imag) < 1e-12 * size
    # A gradient for the position of the map only has no effect.
    assert np.abs(derivative.vjp(np.stack([-arms.imag + 3, arms.real - 2], axis=1)).rest).max() < 1e-10


def test_conformal_maps_keep_the_surface_area():
    V, F, _, _, uv = flattened_ring(energy="mips")
    derivative = flatten_derivative(V, F, uv, energy="mips")
    area = signed_areas(F, derivative.uv @ (1, 1j)).sum()
    corners = V[F]
    surface = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    assert np.isclose(area, surface, rtol=1e-12)


@pytest.fixture(scope="module")
def dome():
    """A curved disk with two pins, mapped into the unit circle."""
    V, F = disk(4)
    rng = np.random.default_rng(5)
    rim = np.arange(len(V) - 24, len(V))
    surface = np.column_stack([V * (1 + 0.03 * rng.standard_normal(V.shape)), 0.4 * np.sin(2 * V[:, 0])])
    fixed = np.append(rim, [10, 30])
    return surface, F, fixed, injective_map(surface, F, fixed, V[fixed], polish="symmetric-dirichlet").uv


@pytest.mark.slow
def test_sliding_along_straight_sides():
    V, F = grid(7, 6)
    surface = np.column_stack([V + 0.01 * np.sin(5 * V[:, ::-1]), 0.3 * np.cos(3 * V[:, 0])])
    boundary = np.flatnonzero(((V.min(axis=0) == V) | (V.max(axis=0) == V)).any(axis=1))
    fixed = np.append(boundary, [18, 29])
    rails = BoundaryCurves([[V.min(axis=0), (1, 0), V.max(axis=0), (0, V[:, 1].max())]])
    uv = polish(surface, F, V, fixed=fixed, slide=rails).uv

    def make(rest, pins):
        start = uv.copy()
        start[fixed[-2:]] = pins
        return polish_derivative(rest, F, start, fixed=fixed, slide=rails)

    here = make(surface, uv[fixed[-2:]])
    off, skew = worst_difference(lambda rest: make(rest, uv[fixed[-2:]]), {"rest": surface})
    assert off < 1e-7
    assert skew < 1e-12
    step = np.zeros((fixed.size, 2))
    step[-2:] = 1e-5 * np.random.default_rng(0).standard_normal((2, 2))
    ahead, behind = (make(surface, uv[fixed[-2:]] + way * step[-2:]).uv for way in (1, -1))
    assert np.abs((ahead - behind) / 2 - here.jvp(target=step)).max() < 1e-7 * np.abs(step).max()
    # The positions of boundary vertices before they slid do not matter.
    assert not here.vjp(here.uv).target[:-2].any()
    # They have slid, and lie exactly on their sides.
    assert np.ptp(here.uv[boundary] - V[boundary]) > 1e-3
    assert ((here.uv[boundary] == V.min(axis=0)) | (here.uv[boundary] == V.max(axis=0))).any(axis=1).all()


@pytest.mark.slow
def test_sliding_along_a_circle(dome):
    """The barrier that keeps edges near the circle has a hundredth of the energy's weight, treated as constant."""
    surface, F, fixed, uv = dome
    rails = BoundaryCurves([Curve.circle()])
    uv = polish(surface, F, uv, fixed=fixed, slide=rails).uv
    here = polish_derivative(surface, F, uv, fixed=fixed, slide=rails)
    assert here.reliable
    assert np.allclose(np.linalg.norm(here.uv[fixed[:-2]], axis=1), 1, atol=1e-15)
    change = 1e-5 * np.random.default_rng(0).standard_normal(surface.shape)
    ahead, behind = (polish_derivative(surface + way * change, F, uv, fixed=fixed, slide=rails).uv for way in (1, -1))
    moved = here.jvp(rest=change)
    assert np.abs((ahead - behind) / 2 - moved).max() < 0.01 * np.abs(moved).max()


@pytest.mark.slow
@pytest.mark.parametrize("width", [pytest.param(1.3, marks=pytest.mark.nightly), 1.5])
def test_sliding_along_an_ellipse_converges(dome, width):
    """The parameters are uneven along it: gradients of the barrier match its values only if they are exact."""
    surface, F, fixed, _ = dome
    V, _ = disk(4)
    found = injective_map(surface, F, fixed, V[fixed] * [width, 0.8], polish="symmetric-dirichlet")
    rails = BoundaryCurves([Curve.circle().transform([[width, 0], [0, 0.8]])])
    uv = polish(surface, F, found.uv, fixed=fixed, slide=rails).uv
    assert Doubt.NOT_AT_REST not in polish_derivative(surface, F, uv, fixed=fixed, slide=rails).doubts


def test_the_map_is_converged_and_injective(dome):
    surface, F, fixed, uv = dome
    derivative = polish_derivative(surface, F, uv, fixed=fixed)
    assert certify(F, derivative.uv).injective
    assert np.array_equal(derivative.uv[fixed], uv[fixed])
    area = signed_areas(F, derivative.uv @ (1, 1j)).sum()
    energy = DeformationEnergy(surface, F, SymmetricDirichlet(), area=area)
    before, after = (np.abs(np.delete(energy.gradient(there @ (1, 1j)), fixed)).max() for there in (uv, derivative.uv))
    assert after < 1e-13 < before


def test_a_map_that_was_not_found_has_no_derivative():
    problem, uv = polished_ring()
    crossed = uv.copy()
    crossed[problem.F[0, 0]] += 5
    with pytest.raises(ValueError, match="no map was found, so there is no derivative"):
        polish_derivative(problem.V, problem.F, crossed, fixed=problem.fixed)
    with pytest.raises(ValueError, match="not in fixed"):
        polish_derivative(problem.V, problem.F, uv, fixed=problem.fixed[1:])
    with pytest.raises(ValueError, match="mu is supported only for quasi-harmonic maps"):
        polish_derivative(problem.V, problem.F, uv, fixed=problem.fixed).jvp(mu=np.zeros(len(problem.F)))


def test_two_equally_good_maps_make_the_derivative_doubtful():
    """A slightly compressed strip buckles to either side; the straight strip is an unstable equilibrium."""
    V, F = grid(20, 4)
    V = (V - V.mean(axis=0)) * [1, 0.1]
    straight = V * [0.8, 1]
    ends = np.flatnonzero(np.abs(V[:, 0]) > 0.49)
    derivative = flatten_derivative(V, F, straight, fixed=ends)
    assert Doubt.NOT_LEAST in derivative.doubts
    assert not derivative.reliable
    # It is still a derivative.
    assert np.allclose(derivative.jvp(target=np.ones((ends.size, 2))), 1, atol=1e-6)


@pytest.mark.slow
def test_near_a_bifurcation_of_the_map():
    """At the onset of buckling, straight and bent strips coincide; and a disk may rotate in a circle."""
    V, F = grid(20, 4)
    V = (V - V.mean(axis=0)) * [1, 0.1]
    ends = np.flatnonzero(np.abs(V[:, 0]) > 0.49)

    def doubts(length):
        return flatten_derivative(V, F, V * [length, 1], fixed=ends).doubts

    short, long = 0.8, 1.0
    assert doubts(long) == ()
    while Doubt.NEAR_SINGULAR not in (found := doubts(0.5 * (short + long))):
        assert long - short > 1e-12
        short, long = (0.5 * (short + long), long) if found else (short, 0.5 * (short + long))
    disc, G = disk(4)
    rim = np.arange(len(disc) - 24, len(disc))
    turning = polish_derivative(disc, G, disc, fixed=rim, slide=BoundaryCurves([Curve.circle()]))
    assert Doubt.NEAR_SINGULAR in turning.doubts


def test_vertices_at_a_bend_are_doubtful():
    """The bent sides of the outline are polygons whose bends are smaller than a corner."""
    problem, uv = polished_ring(curved=True)
    derivative = polish_derivative(problem.V, problem.F, uv, fixed=problem.fixed, slide=True)
    assert Doubt.SLIDING in derivative.doubts
    assert Doubt.NOT_AT_REST not in derivative.doubts


class Creased(Isotropic):
    """An energy with a kink where areas are preserved, at which Newton's steps do not converge."""

    barrier = True

    def density(self, d):
        return np.where(d.det > 0, SymmetricDirichlet().density(d) + np.abs(np.log(np.abs(d.det))), np.inf)

    def density_gradient(self, d):
        a, b = SymmetricDirichlet().density_gradient(d)
        return a + np.sign(d.det - 1) / d.det, b - np.sign(d.det - 1) / d.det

    def density_hessian(self, d):
        crease = -np.sign(d.det - 1) / d.det**2
        return tuple(
            bend + way * crease for bend, way in zip(SymmetricDirichlet().density_hessian(d), (1, -1, 1), strict=True)
        )


@pytest.mark.slow
def test_a_map_that_does_not_converge_is_doubtful():
    V, F, _, _, uv = flattened_ring()
    assert Doubt.NOT_AT_REST in flatten_derivative(V, F, uv, energy=Creased()).doubts


@pytest.mark.slow
def test_a_boundary_in_contact_with_itself_is_doubtful():
    """A strip around more than the full circle of a cone that is flatter than the plane allows."""
    square, F = grid(45, 3)
    angle, radius = 7.2 * square[:, 0], 1 + square[:, 1] / square[:, 1].max() * 0.5
    V = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 0.02 * angle])
    result = flatten(V, F)
    assert result.certificate.bijective
    derivative = flatten_derivative(V, F, result.uv)
    assert Doubt.CONTACT in derivative.doubts
    assert np.array_equal(derivative.uv, result.uv)
    assert np.isfinite(derivative.jvp(rest=V)).all()


def test_an_almost_collapsed_triangle_is_doubtful():
    V, F = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]), np.array([[0, 1, 2], [0, 2, 3]])
    thin = np.array([[0, 0], [0.5, 0.5 - 1e-10], [1, 1], [0, 1]])
    assert polish_derivative(V, F, thin, fixed=[0, 1, 2, 3]).doubts == (Doubt.NEAR_COLLAPSE,)
