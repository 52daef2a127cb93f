"""Maps that preserve distances along the surface."""

from __future__ import annotations

import re
import time
from dataclasses import replace
from functools import partial
from unittest.mock import Mock

import numpy as np
import pytest

from quasiharmonic import Status, certify, distortion, flatten, keep_distances, surfaces
from quasiharmonic.apps.flattening import free_boundary
from quasiharmonic.apps.flattening import piece as pieces
from quasiharmonic.apps.flattening.contacts import Rim
from quasiharmonic.apps.flattening.distance_descent import DistanceEnergy, DistancePairs, lower_distance_error
from quasiharmonic.apps.flattening.large_surfaces import lower_coarse_distance_error
from quasiharmonic.apps.flattening.piece import Piece
from quasiharmonic.apps.flattening.surface_descent import SurfaceDescent
from quasiharmonic.energies.distances import surface_distances
from quasiharmonic.energies.energies import SymmetricDirichlet
from quasiharmonic.util.options import DistanceOptions
from shared.distances import rolled, spherical, turned
from shared.distinct_steps import DistinctSteps

# --- the energy and its descent


@pytest.fixture(scope="module")
def energy(dome):
    piece = Piece(*dome)
    distances = surface_distances(piece.V, piece.F, rings=6, sources=100, targets=40, crossings=3)
    return DistanceEnergy(distances, piece.energy(SymmetricDirichlet(), None), len(piece.V)), piece, distances


def some_map(piece, amount=0.3):
    x, y = piece.V[:, :2].T
    return (x + 1j * y) * (1 + amount * x) * np.exp(1j * amount * y)


def test_derivatives_of_the_energy(energy):
    total, piece, _ = energy
    w = some_map(piece)
    rng = np.random.default_rng(1)
    dw = rng.normal(size=w.size) + 1j * rng.normal(size=w.size)
    h = 1e-6 * np.abs(w).max()
    gradient = total.gradient_of(total.deform(w), w.size)
    rise = total.value_of(total.deform(w + h * dw)) - total.value_of(total.deform(w - h * dw))
    assert rise / (2 * h) == pytest.approx(float((gradient.conj() * dw).real.sum()), rel=1e-6)


def test_the_value_is_the_smoothed_mean_error(energy):
    total, piece, distances = energy
    w = some_map(piece)
    off = np.abs(w[distances.source] - w[distances.target]) / distances.length - 1
    barrier = distortion(piece.V, piece.F, np.stack([w.real, w.imag], axis=1))
    singular = np.stack([barrier.sigma1, barrier.sigma2])
    symmetric = (singular**2 + singular**-2).sum(axis=0) - 4
    wanted = np.sqrt(off**2 + 0.09).mean() - 0.3 + 3e-3 * float(barrier.share @ symmetric)
    assert total.value_of(total.deform(w)) == pytest.approx(wanted, rel=1e-12)


def test_the_quadratic_form_is_the_second_derivative_without_its_negative_part(energy):
    """If all pairs are too long, no part is negative, and the form is the second derivative."""
    total, piece, _ = energy
    w = 9 * some_map(piece)
    rng = np.random.default_rng(2)
    dw = rng.normal(size=w.size) + 1j * rng.normal(size=w.size)
    h = 1e-5 * np.abs(w).max()

    def pull(places):
        derivatives = total.deform(places)
        barrier = 3e-3 * total.barrier.gradient_of(derivatives.deformation, w.size)
        return total.gradient_of(derivatives, w.size) - barrier

    form = total.pairs_at(w)
    assert (form.c - np.abs(form.c2) > 0).all()
    product = form.apply(dw)
    assert np.allclose(product, (pull(w + h * dw) - pull(w - h * dw)) / (2 * h), atol=1e-5 * np.abs(product).max())
    # If they are too short, the form is still not negative.
    assert float((dw.conj() * total.pairs_at(w / 90).apply(dw)).real.sum()) > 0


def test_diagonal_blocks_are_those_of_the_form(energy):
    total, piece, _ = energy
    form = total.pairs_at(some_map(piece))
    xx, xy, yy = form.diagonal
    for vertex in (0, 17, 300):
        for unit, column in ((1, (xx, xy)), (1j, (xy, yy))):
            e = np.zeros(len(piece.V), dtype=complex)
            e[vertex] = unit
            product = form.apply(e)
            assert product[vertex] == pytest.approx(column[0][vertex] + 1j * column[1][vertex], rel=1e-12)
            assert np.abs(form.apply_off_diagonal(e)[vertex]) < 1e-14 * np.abs(product).max()


@pytest.mark.slow
def test_direction_solves_newtons_system(energy):
    """Conjugate gradients agree with a solution that uses the whole matrix."""
    total, piece, _ = energy
    w = some_map(piece)
    uv = np.stack([w.real, w.imag], axis=1)
    pairs = DistancePairs(total)
    model = SurfaceDescent(total, uv, "auto", rim=Rim(piece.loops), pairs=pairs).model
    state = model.start(uv)
    model.assemble(state, 0.0)
    model.system.factor(1e-12)
    free = model.system.free
    gradient = model.gradient(state)
    found = model.solve(-gradient)

    matrix = model.system.matrix().toarray()
    for k in range(2 * free.size):
        unit = np.zeros(2 * free.size)
        unit[k] = 1
        whole = np.zeros(w.size, dtype=complex)
        whole[free] = unit.view(complex)
        matrix[:, k] += total.pairs_at(w).apply_off_diagonal(whole)[free].view(float)
    exact = np.linalg.solve(matrix, -gradient.view(float))
    off = found.view(float) - exact
    assert np.sqrt(off @ matrix @ off) < 0.2 * np.sqrt(exact @ matrix @ exact)


@pytest.mark.slow
def test_distance_errors_decrease_and_the_map_stays_bijective(dome):
    V, F = dome
    # A dome seen from above: its boundary region is compressed.
    start = V[:, :2]
    steps = DistinctSteps()
    result = keep_distances(V, F, start, rings=6, callback=steps.append)
    before, after = (distortion(V, F, uv, rings=6).distances for uv in (start, result.uv))
    assert result.status is Status.POLISHED
    assert result.certificate.bijective
    assert certify(F, result.uv).bijective
    assert after.mean < 0.5 * before.mean
    assert after.rms < 0.5 * before.rms
    # In the unit of the surface.
    assert after.scale == pytest.approx(1, abs=0.05)
    energies = [step.energy for step in steps]
    assert steps == result.history
    assert energies[-1] < energies[0]
    assert np.array_equal(keep_distances(V, F, start, rings=6).uv, result.uv)


@pytest.mark.slow
def test_unit_and_position_of_the_start_do_not_matter(dome):
    V, F = dome
    wanted = keep_distances(V, F, V[:, :2], rings=6).uv
    far = keep_distances(np.ldexp(V, 300), F, np.ldexp(V[:, :2], -200), rings=6).uv
    assert np.allclose(np.ldexp(far, -300), wanted, atol=1e-9)


@pytest.mark.slow
def test_developable_surfaces_are_unrolled(flat):
    V, F = flat
    start = np.stack([V[:, 0] * (1 + 0.5 * V[:, 0]), V[:, 1]], axis=1)
    result = keep_distances(rolled(V, 1.0), F, start, rings=8, tol=1e-6)
    assert distortion(V, F, result.uv, rings=8).distances.mean < 5e-3


@pytest.mark.slow
def test_the_boundary_does_not_cross_itself():
    """A ramp with more than one turn would overlap itself if all distances were exact."""
    V, F = surfaces.grid(45, 5)
    radius, angle = 1.5 - V[:, 1], 8.0 * V[:, 0]
    ramp = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.01 * angle], axis=1)
    as_it_would = np.stack([ramp[:, 0], ramp[:, 1]], axis=1)
    sample = surface_distances(ramp, F, rings=5)
    assert certify(F, as_it_would).injective
    assert not certify(F, as_it_would).bijective
    start = np.stack([radius * np.cos(0.6 * angle), radius * np.sin(0.6 * angle)], axis=1)
    result = keep_distances(ramp, F, start, rings=5)
    assert result.certificate.bijective
    assert sample.error(as_it_would).mean < sample.error(result.uv).mean < 0.5 * sample.error(start).mean


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 13])
def test_a_start_that_scaling_would_invert_is_not_scaled(seed):
    V, F = surfaces.grid(4, 4)
    rng = np.random.default_rng(seed)
    uv = turned(V, rng.uniform(0.2, 1.3))
    # A vertex is so close to the opposite side that few scales keep it there; with these seeds, the chosen scale does
    # not.
    a, b, c = (0, 1, 6)
    foot = 0.3 * uv[a] + 0.7 * uv[b]
    uv[c] = foot + (uv[c] - foot) * 2.0 ** -rng.uniform(49, 54)
    assert certify(F, uv).bijective
    scale = surface_distances(V, F, rings=4, sources=7, targets=120, crossings=3).error(uv).scale
    assert not certify(F, scale * (uv - uv.mean(axis=0))).bijective
    result = keep_distances(V, F, uv, rings=4)
    assert result.certificate.bijective
    assert result.history[-1].energy < result.history[0].energy


def test_ctrl_c_returns_the_best_map_so_far(dome):
    V, F = dome

    def stop(step):
        if step.iteration == 2:
            raise KeyboardInterrupt

    result = keep_distances(V, F, V[:, :2], rings=6, callback=stop)
    assert result.status is Status.INTERRUPTED
    assert result.certificate.bijective
    assert len(result.history) == 3


def test_few_iterations(dome):
    V, F = dome
    result = keep_distances(V, F, V[:, :2], rings=6, max_iterations=1)
    assert (result.status, result.n_iterations) == (Status.STILL_FALLING, 1)
    untouched = keep_distances(V, F, V[:, :2], rings=6, max_iterations=0)
    assert untouched.certificate.bijective
    assert untouched.n_iterations == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda uv: -uv * [1, -1], "uv is not bijective: the descent needs a bijective map. Not injective"),
        (lambda uv: uv[:-1], "one position for each vertex"),
        (lambda uv: np.where(uv > 0.5, np.inf, uv), "uv is not finite"),
    ],
)
def test_unusable_starts(dome, change, message):
    V, F = dome
    with pytest.raises(ValueError, match=re.escape(message)):
        keep_distances(V, F, change(V[:, :2]))


@pytest.mark.parametrize("rings", [None, "a", [3], 0, 2.5])
def test_numbers_of_rings_that_are_not_valid_are_rejected(dome, rings):
    V, F = dome
    with pytest.raises(ValueError, match="rings must be an integer of at least 1, not"):
        keep_distances(V, F, V[:, :2], rings=rings)


@pytest.mark.slow
def test_record_stores_intermediate_maps(dome):
    V, F = dome
    result = keep_distances(V, F, V[:, :2], rings=6, record_every=2)
    last = result.history[-1].iteration
    assert [lower_distance_error.iteration for lower_distance_error in result.path] == [*range(0, last + 1, 2)]
    assert all(certify(F, lower_distance_error.uv).bijective for lower_distance_error in result.path)
    if last % 2 == 0:
        assert np.array_equal(result.path[-1].uv, result.uv)
    assert not keep_distances(V, F, V[:, :2], rings=6).path
    with pytest.raises(ValueError, match="record_every must be an integer"):
        keep_distances(V, F, V[:, :2], record_every=-1)


# --- by way of a coarse mesh


RINGS, LEAST = 13, 800  # of the pairs, and vertices of the coarse mesh


@pytest.fixture(scope="module")
def folded():
    """A square with hills and valleys, of 4,600 triangles."""
    V, F = surfaces.grid(48, 48)
    return Piece(np.column_stack([V, 0.3 * np.sin(7 * V[:, 0]) * np.cos(5 * V[:, 1])]), F)


@pytest.fixture(scope="module")
def asked():
    return DistanceOptions(rings=RINGS)


@pytest.fixture(scope="module")
def coarse(folded, asked):
    """The result by way of a coarse mesh, with its record, and the steps passed to the callback."""
    steps = []
    settings = replace(asked, callback=steps.append, record_every=1)
    return lower_coarse_distance_error(folded, settings, least=LEAST), steps


@pytest.mark.long
def test_a_coarse_mesh_helps_the_fine_one(folded, asked, coarse):
    found, _ = coarse
    plain = flatten(folded.V, folded.F)
    whole = lower_distance_error(folded, plain.uv, asked)
    sample = surface_distances(folded.V, folded.F, rings=RINGS, sources=60)
    errors = [sample.error(uv) for uv in (plain.uv, whole.uv, found.uv)]
    assert found.status is Status.POLISHED
    assert certify(folded.F, found.uv).bijective
    assert errors[1].mean < 0.9 * errors[0].mean
    # It achieves most of the gain of the descent on the mesh itself.
    assert errors[2].mean < errors[1].mean + 0.3 * (errors[0].mean - errors[1].mean)
    assert errors[2].rms < errors[0].rms
    assert errors[2].scale == pytest.approx(1, abs=0.03)
    assert [stage.name for stage in found.stages] == ["start, coarse", "guarded descent, distances, coarse"]
    assert np.array_equal(lower_coarse_distance_error(folded, asked, least=LEAST).uv, found.uv)


def test_too_few_rings_for_a_coarser_mesh(folded, asked):
    assert lower_coarse_distance_error(folded, replace(asked, rings=3), least=LEAST) is None
    assert lower_coarse_distance_error(folded, replace(asked, rings=20), least=len(folded.V)) is None


@pytest.mark.long
def test_callbacks_and_records_on_a_coarse_mesh(folded, coarse):
    found, steps = coarse
    assert steps == found.history
    assert [step.iteration for step in steps] == [*range(len(steps))]
    assert steps[-1].energy < steps[0].energy
    (last,) = found.path
    assert last.iteration == steps[-1].iteration
    assert np.array_equal(last.uv, np.ldexp(found.uv, folded.exponent))


@pytest.mark.long
def test_ctrl_c_on_the_coarse_mesh_returns_a_map_of_the_surface(folded, asked):
    def stop(step):
        if step.iteration == 1:
            raise KeyboardInterrupt

    found = lower_coarse_distance_error(folded, replace(asked, callback=stop), least=LEAST)
    assert found.status is Status.INTERRUPTED
    assert len(found.uv) == len(folded.V)
    assert certify(folded.F, found.uv).bijective


@pytest.mark.long
@pytest.mark.parametrize("rings", [20, pytest.param(120, marks=pytest.mark.nightly)])
def test_a_large_surface_is_flattened_by_way_of_a_coarse_mesh(rings, monkeypatch):
    if rings < 120:
        for module in (pieces, free_boundary):
            monkeypatch.setattr(module, "COARSE_FROM", 1_500)
        coarse = partial(lower_coarse_distance_error, least=400)
        monkeypatch.setattr(free_boundary, "lower_coarse_distance_error", coarse)
    V, F = surfaces.cat(rings)
    assert len(F) >= pieces.COARSE_FROM
    plain, found = (flatten(V, F, **options) for options in ({}, {"energy": "distances"}))
    sample = surface_distances(V, F, sources=150, targets=150)
    assert found.stages[-1].name == "guarded descent, distances, coarse"
    assert certify(F, found.uv).bijective
    assert sample.error(found.uv).mean < 0.95 * sample.error(plain.uv).mean
    # A given map is optimised on the mesh itself.
    given = flatten(V, F, energy="distances", start=plain.uv, max_iterations=1)
    assert given.stages[-1].name == "guarded descent, distances"


@pytest.mark.nightly
def test_three_hundred_thousand_triangles_take_about_as_long_as_without_distances():
    V, F = surfaces.grid(388, 388)
    V = np.column_stack([V, 0.3 * np.sin(7 * V[:, 0]) * np.cos(5 * V[:, 1])])
    assert len(F) > 300_000
    maps, seconds = [], []
    for options in ({}, {"energy": "distances", "rings": 80}):
        began = time.process_time()
        maps.append(flatten(V, F, **options))
        seconds.append(time.process_time() - began)
    assert certify(F, maps[1].uv).bijective
    assert seconds[1] < 2.5 * seconds[0]
    sample = surface_distances(V, F, rings=80, sources=100, targets=100)
    before, after = (sample.error(found.uv) for found in maps)
    assert after.mean < 0.95 * before.mean
    assert after.rms < before.rms


# --- as an energy of `flatten`


@pytest.mark.slow
def test_flatten_ends_with_the_descent_of_distances():
    V, F = surfaces.cat(6)
    plain = flatten(V, F)
    result = flatten(V, F, energy="distances", rings=8, record_every=1)
    alone = keep_distances(V, F, plain.uv, rings=8)
    assert certify(F, result.uv).bijective
    sample = surface_distances(V, F, rings=8)
    errors = [sample.error(found.uv).mean for found in (plain, result, alone)]
    assert errors[1] < 0.9 * errors[0]
    assert errors[1] == pytest.approx(errors[2], rel=1e-3)
    # In the unit of the surface, aligned with its axis.
    assert sample.error(result.uv).scale == pytest.approx(1, abs=0.02)
    assert np.allclose(result.uv.min(axis=0), 0)
    assert [stage.name for stage in result.stages][-1] == "guarded descent, distances"
    assert [step.iteration for step in result.history] == [*range(len(result.history))]
    assert [lower_distance_error.iteration for lower_distance_error in result.path] == [*range(len(result.history))]


@pytest.mark.long
def test_flatten_preserves_the_distances_of_each_piece(dome):
    V, F = dome
    both = np.concatenate([V, 0.5 * V + [5, 0, 0]]), np.concatenate([F, F + len(V)])
    result = flatten(*both, energy="distances", rings=6, gap=3.0)
    alone = flatten(V, F, energy="distances", rings=6)
    assert certify(both[1], result.uv).bijective
    first, second = result.uv[: len(V)], result.uv[len(V) :]
    assert np.allclose(first, alone.uv, atol=1e-9)
    assert np.allclose(second - second.min(axis=0), 0.5 * alone.uv, atol=1e-9)
    assert second[:, 0].min() - first[:, 0].max() == pytest.approx(3.0)
    # The pieces are separated by a twentieth of the longest side.
    near = flatten(*both, energy="distances", rings=6).uv
    room = near[len(V) :, 0].min() - near[: len(V), 0].max()
    assert room == pytest.approx(0.05 * np.ptp(first, axis=0).max())


@pytest.mark.slow
def test_sampled_pairs_represent_all_pairs():
    """With few rings and on a small surface, too, the map does not fit the sampled pairs alone."""
    V, F = surfaces.disk(14)
    V = spherical(V, 0.45)
    sample = surface_distances(V, F, rings=4)
    before, after = (sample.error(flatten(V, F, **o).uv) for o in ({}, {"energy": "distances", "rings": 4}))
    assert after.mean < 0.99 * before.mean
    assert after.rms < before.rms


@pytest.mark.parametrize("stage", ["before", "in the middle"])
def test_ctrl_c_ends_flattening_by_distances_with_a_map(dome, stage):
    V, F = dome
    plain = flatten(V, F)
    last = len(plain.history) - 1 + (0 if stage == "before" else 3)

    def stop(step):
        if step.iteration == last:
            raise KeyboardInterrupt

    result = flatten(V, F, energy="distances", rings=6, callback=stop)
    assert result.status is Status.INTERRUPTED
    assert result.certificate.bijective
    assert result.history[-1].iteration == last


def test_ctrl_c_during_sampling_returns_the_current_map(dome, monkeypatch):
    sample = "quasiharmonic.apps.flattening.distance_descent.sample_distances"
    monkeypatch.setattr(sample, Mock(side_effect=KeyboardInterrupt))
    result = flatten(*dome, energy="distances", rings=6)
    assert result.status is Status.INTERRUPTED
    assert np.array_equal(result.uv, flatten(*dome).uv)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"weights": np.ones(4)}, "omit fixed and weights"),
        ({"fixed": [0], "target": [[0, 0]]}, "omit fixed and weights"),
        ({"rings": 0}, "rings must be an integer of at least 1, not 0"),
        ({"gap": -1}, "gap must be a finite number of at least 0"),
    ],
)
def test_incompatible_options_of_distances_are_named(dome, options, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        flatten(*dome, energy="distances", **options)
