"""Collapsed maps: bijective, but stretched far more than the surface requires."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import Status, certify, distortion, find_cuts, flatten, inverted_triangles
from quasiharmonic.apps.flattening.contacts import Rim
from quasiharmonic.apps.flattening.multilevel import flatten_coarse
from quasiharmonic.apps.flattening.piece import Piece
from quasiharmonic.apps.flattening.worst_triangles import has_collapsed, stretch_of_boundary, worst_stretch
from quasiharmonic.atlas import SeamedMesh
from quasiharmonic.atlas import flatten as flatten_atlas
from quasiharmonic.energies.energies import SymmetricDirichlet
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.surfaces import cat, disk, starfish
from shared.closed_surfaces import TETRAHEDRON


def cut_starfish(arms, rings=12, min_gain=0.1):
    V, F = starfish(arms, rings)
    cut = SeamedMesh(V, F).cut(find_cuts(V, F, min_gain=min_gain)).opened()
    return cut.V / np.abs(cut.V).max(), cut.F


def worst(V, F, uv):
    return distortion(V, F, uv).statistics("isometric").maximum


def pinched(F, uv, loops, *, gap=1e-11, most=10):
    """A bijective map in which some narrow gaps of the boundary are almost closed."""
    rim, taken = Rim(loops), np.zeros(0, dtype=int)
    for _ in range(most):
        w = in_units(uv, 0)
        for v, a, b in rim.contacts(w).corners.T:
            if np.isin([v, a, b], taken).any():
                continue
            moved = w.copy()
            s = np.clip(((w[v] - w[a]) / (w[b] - w[a])).real, 0, 1)
            nearest = (1 - s) * w[a] + s * w[b]
            moved[v] = nearest + gap * (w[v] - nearest)
            closer = moved.view(np.float64).reshape(-1, 2)
            if certify(F, closer, loops=loops).bijective:
                uv, taken = closer, np.append(taken, [v, a, b])
                break
    assert taken.size >= 3 * most / 2
    return uv


@pytest.mark.slow
def test_a_start_from_which_the_map_collapses_is_replaced():
    replaced = 0
    for arms in (3, 5):
        V, F = cut_starfish(arms, 8)
        loops = boundary_loops(F, len(V))
        result = flatten(V, F, start=pinched(F, flatten_coarse(V, F, loops), loops))
        assert result.certificate.bijective
        assert result.status is Status.POLISHED
        assert worst(V, F, result.uv) < 5
        # With some linear solvers, one of the two starts needs no other start.
        if any(stage.name.startswith("start again") for stage in result.stages):
            replaced += 1
            assert result.stages[2].name == "start again, disk"
            # The collapsed result is recorded as discarded.
            assert [stage.kept for stage in result.stages] == [False, False, True, True]
            assert result.stages[1].energy[1] > 100 * result.stages[3].energy[1]
    assert replaced


def shrunk(F, uv, centre):
    """A map with the distances from a point raised to the highest power at which rounding inverts no triangle."""
    away = uv - centre
    size = np.linalg.norm(away, axis=1, keepdims=True)
    starts = (away * (size / size.max()) ** power for power in np.arange(8, 6, -0.125))
    return next(start for start in starts if not inverted_triangles(F, start).size)


@pytest.mark.slow
def test_a_far_start_with_a_guarded_boundary_takes_few_steps():
    # Almost all of the disk is shrunk to 1e-15. The energy at the start depends on rounding: 5e13 to 2e14. Newton steps
    # that at most halve the energy took 219.
    V, F = cut_starfish(5)
    disk = flatten(V, F, max_iterations=0).uv
    result = flatten(V, F, start=shrunk(F, disk, disk.mean(axis=0)))
    guarded = result.stages[-1]
    assert guarded.name.startswith("guarded")
    assert guarded.energy[0] > 1e12
    assert guarded.n_iterations < 100
    assert result.status is Status.POLISHED
    assert worst(V, F, result.uv) < 5


@pytest.mark.long
def test_a_descent_that_does_not_end_is_replaced_by_another_start():
    V, F = cut_starfish(5)
    disk = flatten(V, F, max_iterations=0).uv
    result = flatten(V, F, start=shrunk(F, disk, disk[np.argmax(np.linalg.norm(V, axis=1))]), max_iterations=100)
    assert result.status is Status.POLISHED
    assert worst(V, F, result.uv) < 5
    assert any(stage.name.startswith("start again") for stage in result.stages)


@pytest.mark.parametrize("energy", ["symmetric-dirichlet", "mips"])
def test_a_thin_planar_surface_is_its_own_map_even_if_scaling_makes_it_overlap(monkeypatch, energy):
    V, F = disk(3)
    V[:, 1] *= 1e-30
    # Scaled maps are not bijective, as if rounding made the boundary meet itself.
    monkeypatch.setattr(Piece, "fit_scale", lambda self, uv: uv * [-1, 0])
    result = flatten(V, F, energy=energy)
    assert result.status is Status.EXHAUSTED
    assert result.certificate.bijective
    assert np.ptp(result.uv[:, 0]) == np.ptp(V[:, 0])


class Stuck(SymmetricDirichlet):
    """The gradient has the wrong sign, so that no step lowers the energy."""

    def density_gradient(self, d):
        return tuple(-slope for slope in super().density_gradient(d))


@pytest.mark.slow
def test_collapse_from_every_start_is_reported_by_the_status(monkeypatch):
    V, F = cat(8)
    monkeypatch.setattr("quasiharmonic.apps.flattening.flattening_run.has_collapsed", lambda *surface, **more: True)
    result = flatten(V, F, energy=Stuck())
    assert result.status is Status.COLLAPSED
    assert result.certificate.bijective
    assert "energy='symmetric-dirichlet'" in result.status.value
    starts = [stage for stage in result.stages if stage.name.startswith("start")]
    assert len(starts) > 2
    # The result is the best map of all starts.
    ends = [stage.energy[1] for stage in result.stages if not stage.name.startswith("start")]
    kept = [stage.energy[1] for stage in result.stages if stage.kept and not stage.name.startswith("start")]
    assert min(ends) == kept[-1]


@pytest.mark.slow
def test_equal_results_of_two_starts_are_no_collapse(monkeypatch):
    V, F = cut_starfish(3, 10)
    monkeypatch.setattr("quasiharmonic.apps.flattening.flattening_run.has_collapsed", lambda *surface, **more: True)
    result = flatten(V, F)
    assert result.status is Status.POLISHED
    assert result.certificate.bijective


@pytest.mark.slow
def test_a_collapsed_island_is_reported_for_an_atlas(monkeypatch):
    monkeypatch.setattr("quasiharmonic.apps.flattening.flattening_run.has_collapsed", lambda *surface, **more: True)
    plane, F = disk(3)
    flat = np.column_stack([plane + 5, np.zeros(len(plane))])
    V, G = cat(8)
    both = SeamedMesh(np.concatenate([flat, V]), np.concatenate([F, G + len(flat)]))
    assert flatten_atlas(both, energy=Stuck()).status is Status.COLLAPSED


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_detection_of_collapse_does_not_depend_on_scale(scale):
    V, F = cat(12)
    loops, uv = boundary_loops(F, len(V)), flatten(V, F).uv
    area = 0.5 * np.linalg.norm(np.cross(V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]]), axis=1).sum()

    def collapsed(uv, overlapping=None):
        surface = V * scale, F, loops, area * scale**2
        return has_collapsed(*surface, uv, overlapping, angles_alone=False)

    squeezed = uv * [1.0, 1e-3]
    assert not collapsed(uv)
    assert collapsed(squeezed)
    # If the boundary may overlap itself, the map is stretched as much.
    assert not collapsed(squeezed, squeezed)
    assert worst_stretch(V * scale, F, uv, angles_alone=False) == pytest.approx(worst(V, F, uv))


def test_a_short_boundary_requires_stretch():
    V, F = TETRAHEDRON
    V, F = V * [1, 1, 100], F[1:]
    (loop,) = boundary_loops(F, len(V))
    a, b, c = V[F].swapaxes(0, 1)
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    assert stretch_of_boundary(V, [loop], area) == pytest.approx(np.sqrt(4 * np.pi * area) / (2 + np.sqrt(2)))
    V, F = disk(4)
    assert stretch_of_boundary(V, boundary_loops(F, len(V)), np.pi) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("flat", [1e-30, 1.2e-124])
def test_stretch_of_triangles_too_thin_for_doubles_is_computed_from_their_sides(flat):
    V, F = disk(4)
    V = np.column_stack([V * [flat, 1], np.zeros(len(V))])
    for angles_alone in (False, True):
        assert worst_stretch(V, F, V[:, :2], angles_alone=angles_alone) == pytest.approx(1)
        shorter = worst_stretch(V, F, V[:, :2] * [1, 2.0**-10], angles_alone=angles_alone)
        assert shorter == pytest.approx(2.0**10 if angles_alone else 2.0**5)
