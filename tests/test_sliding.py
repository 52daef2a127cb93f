"""Boundaries that slide: properties of every map, derivatives against differences, and errors."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.sparse import csr_array

from quasiharmonic import BoundaryCurves, Status, boundary_loops, certify, distortion, injective_map, polish, surfaces
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import SymmetricDirichlet
from quasiharmonic.energies.newton.sliding_boundary import SlidingModel
from quasiharmonic.geometry.curves import Curve
from quasiharmonic.geometry.curves.deviation import DeviationBarrier
from shared.sliding import SQUARE, lettered, off_the_glyph, points_of, sheared, z_of


def turned(rings=8, angle=0.5):
    """A disk, and a map of it that rotates the boundary against the centre, one side more than the other."""
    V, F = surfaces.disk(rings)
    z = z_of(V)
    (loop,) = boundary_loops(F, len(V))
    uv = points_of(z * np.exp(1j * angle * np.abs(z) ** 2 * (1 + 0.6 * np.sin(np.angle(z)))))
    # On the circle to the last bit.
    uv[loop] /= np.hypot(*uv[loop].T)[:, None]
    return V, F, uv, loop


@cache
def slid(text):
    """The problem of `lettered`, and its map with a sliding boundary."""
    V, F, fixed, target, curves = lettered(text)
    return (V, F, fixed, target, curves), injective_map(
        V, F, fixed, target, polish="symmetric-dirichlet", slide=BoundaryCurves(curves)
    )


# Results


@pytest.mark.slow
@pytest.mark.parametrize("character", ["G", "S", *(pytest.param(c, marks=pytest.mark.nightly) for c in "PH")])
def test_a_letter_is_better_with_its_boundary_sliding(character):
    (V, F, fixed, target, curves), result = slid(f"letter:{character}")
    held = injective_map(V, F, fixed, target, polish="symmetric-dirichlet")
    assert result.status is Status.POLISHED
    assert certify(F, result.uv).bijective
    polishing = [step.energy for step in result.history[-result.stages[-1].n_iterations - 1 :]]
    # The barrier may take a thousandth.
    assert np.all(np.diff(polishing) < 1e-3 * polishing[-1])
    assert result.history[-1].energy < 0.999 * held.history[-1].energy
    energies = [distortion(V, F, uv).statistics("symmetric_dirichlet").mean for uv in (held.uv, result.uv)]
    assert energies[1] < energies[0]
    # Corners are exact; other vertices lie on the font's own curves, and some of them have moved.
    bends = {tuple(p) for curve in curves for p in curve.position(curve.corners(20.0)).tolist()}
    corners = np.array([tuple(p) in bends for p in target.tolist()])
    outer = max(curves, key=lambda curve: curve.length)
    assert corners.sum() == outer.corners(20.0).size
    np.testing.assert_array_equal(result.uv[fixed[corners]], target[corners])
    places = result.uv[fixed]
    assert np.hypot(*(places - target).T).max() > 0.01
    assert outer.nearest(places)[1].max() <= np.spacing(1.0)
    assert off_the_glyph(places, character).max() < 1e-8
    # In their order, once around.
    along = outer.nearest(places)[0]
    steps = np.diff(np.append(along, along[0]))
    assert sorted([(steps > 0).sum(), (steps < 0).sum()])[0] == 1
    assert not (steps == 0).any()


@pytest.mark.long
def test_a_word_slides_along_the_curves_of_its_letters():
    pytest.importorskip("shapely")
    V, F, fixed, target, curves = lettered("word:OC")
    result = injective_map(V, F, fixed, target, polish="symmetric-dirichlet", slide=BoundaryCurves(curves))
    assert result.status is Status.POLISHED
    assert result.certificate.bijective
    outer = max(curves, key=lambda curve: curve.length)
    places = result.uv[fixed]
    assert np.hypot(*(places - target).T).max() > 0.01
    # Half a rounding error per coordinate, and as much again for the point on the curve used as reference.
    assert outer.nearest(places)[1].max() <= np.hypot(*np.spacing(np.abs(places).max(axis=0)))
    # The first letter has the same position as alone.
    first = places[:, 0] < 0.5
    assert first.any()
    assert off_the_glyph(places[first], "O").max() < 1e-8
    # The corners of the second letter are fixed, and so are the two points where the letters meet.
    held = outer.position(outer.corners(20.0))
    assert np.isin(held @ (1, 1j), places @ (1, 1j)).all()


@pytest.mark.slow
def test_a_boundary_on_a_circle_rotates_back():
    V, F, uv, loop = turned()
    held = polish(V, F, uv, fixed=loop)
    result = polish(V, F, uv, fixed=loop, slide=BoundaryCurves([Curve.circle()]), tol=1e-10)
    assert held.history[-1].energy > 0.1
    # The polygon of the boundary, which sets the scale, has grown slightly since the start.
    assert result.history[-1].energy < 1e-6
    assert distortion(V, F, result.uv).statistics("symmetric_dirichlet").mean < 1e-9
    assert np.abs(np.hypot(*result.uv[loop].T) - 1).max() <= np.spacing(1.0)
    # Nothing is fixed, so the result is the disk again in some position.
    turn = z_of(result.uv) / np.where(z_of(V) == 0, 1, z_of(V))
    assert np.ptp(np.angle(turn[np.hypot(*V.T) > 0])) < 1e-3


@pytest.mark.parametrize(
    "slide", [True, BoundaryCurves([SQUARE]), BoundaryCurves([Curve.polyline([*SQUARE, SQUARE[0]])])]
)
def test_sides_of_a_square(slide):
    V, F, uv, loop = sheared()
    before = uv.copy()
    result = polish(V, F, uv, fixed=loop, slide=slide, tol=1e-10)
    np.testing.assert_array_equal(uv, before)
    np.testing.assert_allclose(result.uv, V, atol=1e-7)
    # Axis-parallel sides are exact.
    for axis, value in ((0, 0), (0, 1), (1, 0), (1, 1)):
        side = V[:, axis] == value
        assert (result.uv[side, axis] == value).all()


def test_vertices_slide_across_small_bends():
    """A boundary with many vertices on a polygon with few bends, each smaller than a corner."""
    V, F, _, loop = turned(10)
    polygon = Curve.polygon(points_of(np.exp(2j * np.pi * np.arange(24) / 24)))
    # Vertices are distributed unevenly along it.
    share = np.arange(loop.size) / loop.size
    share = share + 0.1 * np.sin(2 * np.pi * share)
    target = polygon.position(share * polygon.length)
    held = injective_map(V, F, loop, target, polish="symmetric-dirichlet")
    result = injective_map(V, F, loop, target, polish="symmetric-dirichlet", slide=BoundaryCurves([polygon]))
    assert result.status is Status.POLISHED
    assert result.history[-1].energy < 0.1 * held.history[-1].energy
    assert polygon.nearest(result.uv[loop])[1].max() <= np.spacing(1.0)
    assert result.certificate.bijective


@pytest.mark.slow
def test_vertices_stop_at_bends():
    """The surface extends beyond the polygon's bends, so vertices are pushed into them, exactly."""
    V, F = surfaces.disk(6)
    (loop,) = boundary_loops(F, len(V))
    bends = points_of(np.exp(1j * (np.angle(z_of(V[loop[0]])) + 2 * np.pi * np.arange(18) / 18)))
    polygon = Curve.polygon(bends)
    s = np.arange(36) / 36 * polygon.length
    V[loop] = polygon.position(s)
    V[loop[::2]] *= 1.08
    uv = V.copy()
    uv[loop] = polygon.position(polygon.advance(s, 0.06 * np.sin(3 * s) + 0.02))
    result = polish(V, F, uv, fixed=loop, slide=BoundaryCurves([polygon]))
    assert result.status is Status.POLISHED
    at = {tuple(p) for p in result.uv[loop].tolist()}
    assert sum(tuple(p) in at for p in polygon.position(polygon.corners(1.0)).tolist()) == 18


@pytest.mark.slow
def test_an_edge_does_not_cut_off_a_bend():
    """A curved letter with few vertices: without bounds, the last two jump across, for a lower energy."""
    (_, _, fixed, target, curves), result = slid("letter:S")
    (curve,) = curves

    def strays(uv):
        middle = (uv[fixed] + uv[np.roll(fixed, -1)]) / 2
        return curve.nearest(middle)[1].max()

    start = result.uv.copy()
    start[fixed] = target
    assert strays(result.uv) < 1.5 * strays(start)


@pytest.mark.slow
def test_holes_slide_independently():
    V, F = surfaces.annulus(12)
    outer, inner = sorted(boundary_loops(F, len(V)), key=lambda loop: -np.abs(V[loop]).max())
    z = z_of(V)
    size = np.abs(V).max(axis=1)
    ring = np.where(np.abs(z) > 0, z / np.abs(z), 0) * (0.5 + (size - 0.5))
    angle = np.angle(ring)
    uv = points_of(ring * np.exp(1j * (0.3 * np.sin(angle) + 0.8 * size)))
    fixed = np.concatenate([outer, inner])
    circles = BoundaryCurves([Curve.circle(), Curve.circle(0.5)])
    result = polish(V, F, uv, fixed=fixed, slide=circles)
    assert result.history[-1].energy < polish(V, F, uv, fixed=fixed).history[-1].energy
    assert np.abs(np.hypot(*result.uv[outer].T) - 1).max() < 3e-16
    assert np.abs(np.hypot(*result.uv[inner].T) - 0.5).max() < 3e-16
    assert result.certificate.bijective


def test_nothing_can_slide_if_all_vertices_are_corners():
    V, F, _, loop = sheared(2)
    corners = BoundaryCurves([V[loop]], corner_angle=0)
    result = polish(V, F, V, fixed=loop, slide=corners)
    np.testing.assert_array_equal(result.uv[loop], V[loop])


def test_some_vertices_are_fixed_and_some_have_given_curves():
    V, F, uv, loop = sheared()
    lower, right, upper, left = (np.flatnonzero(V[:, axis] == v) for axis, v in ((1, 0), (0, 1), (1, 1), (0, 0)))
    rails = BoundaryCurves([Curve.polyline([(0, 0), (1, 0)]), Curve.polyline([(1, 1), (0, 1)])], fixed=upper[2:4])
    result = polish(V, F, uv, fixed=loop, slide=rails, max_iterations=5)
    stays = np.union1d(np.union1d(left, right), upper[2:4])
    np.testing.assert_array_equal(result.uv[stays], uv[stays])
    slid = np.setdiff1d(np.union1d(lower, upper), stays)
    assert (result.uv[slid, 1] == V[slid, 1]).all()
    assert (result.uv[slid, 0] != uv[slid, 0]).all()
    # If their curves are given, vertices stay on their side of a smooth outline: none slides past an end.
    half = [Curve([c]) for c in _half_circles()]
    V, F, uv, loop = turned(6, 0.3)
    on = {int(v): int(uv[v, 1] < 0) for v in loop}
    start = uv.copy()
    near = loop[np.argmin(np.abs(start[loop, 1]) + (start[loop, 0] < 0))]
    result = polish(V, F, start, fixed=loop, slide=BoundaryCurves(half, on=on, tolerance=0.05))
    assert all((result.uv[v, 1] < 1e-12) == bool(k) or abs(result.uv[v, 1]) < 1e-12 for v, k in on.items())
    assert np.abs(np.hypot(*result.uv[loop].T) - 1).max() <= np.spacing(1.0)
    assert near in loop


def _half_circles():
    from quasiharmonic.geometry.curves import Arc

    return Arc((0, 0), (1, 0), (0, 1), 0, np.pi), Arc((0, 0), (1, 0), (0, 1), np.pi, 2 * np.pi)


# Derivatives against differences


def laid(straight=False):
    V, F, uv, loop = sheared(6) if straight else turned(5)
    rails = BoundaryCurves([SQUARE]) if straight else BoundaryCurves([Curve.circle()])
    track = rails.lay([loop], uv)
    energy = DeformationEnergy(V, F, SymmetricDirichlet())
    return track, SlidingModel(energy, track, loop, [loop], 1, "auto")


@pytest.mark.parametrize("straight", [False, True])
def test_first_and_second_derivatives_along_curves(straight, rng):
    track, model = laid(straight)
    system, start = model.system, model.start()
    energy, unit = model.energy, 2.0**model.coordinates.exponent

    def go(step):
        """Return the map after a step in the unknowns, in the unit of the model."""
        w = start.w.copy()
        w[system.free] += step
        s = track.advance(track.s, step[system.at].real * unit)
        w[track.vertices] = z_of(track.position(s)) / unit
        return w, s

    def merit(step):
        w, s = go(step)
        return energy.value(w) + model.weight * model.deviation_barrier.value(s)

    def random_step():
        step = rng.standard_normal(system.free.size) + 1j * rng.standard_normal(system.free.size)
        step[system.at] = step[system.at].real
        return step * 1e-2

    gradient = model.gradient(start)
    assert (gradient[system.at].imag == 0).all()
    for _ in range(3):
        d, h = random_step(), 1e-3
        slope = np.sum(gradient.real * d.real + gradient.imag * d.imag)
        assert (merit(h * d) - merit(-h * d)) / (2 * h) == pytest.approx(slope, rel=1e-4)
    # The exact second derivative, without the barrier's, for which the Gauss–Newton form is used.
    system.curve_stiffness = model.frame(start).tangents.bending * unit
    system.assemble(energy.curvature_of(start.derivatives, negative=1.0))
    matrix = system.matrix()
    for _ in range(3):
        d, h = random_step(), 1e-2
        x = np.ascontiguousarray(d).view(np.float64)
        second = (energy.value(go(h * d)[0]) - 2 * energy.value(start.w) + energy.value(go(-h * d)[0])) / h**2
        assert x @ (matrix @ x) == pytest.approx(second, rel=1e-3)


def test_the_system_is_that_of_displacements(rng):
    track, model = laid()
    system, start = model.system, model.start()
    model.gradient(start)
    system.curve_stiffness = np.zeros(track.vertices.size)
    form = model.energy.curvature_of(start.derivatives)
    system.assemble(form)
    found = system.matrix().toarray()
    from quasiharmonic.energies.newton.newton_system import NewtonSystem

    whole = NewtonSystem(model.energy.F, model.energy.g, start.w.size, model.coordinates.fixed)
    whole.assemble(form)
    H, size = whole.matrix().toarray(), whole.free.size
    P = np.eye(2 * size)
    for i, tangent in zip(system.at, system.tangent, strict=True):
        P[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [(tangent.real, 0), (tangent.imag, 0)]
    np.testing.assert_allclose(found, csr_array(P.T @ H @ P).toarray(), atol=1e-12 * np.abs(H).max())


def test_the_deviation_barrier(rng):
    V, _, fixed, target, curves = lettered("letter:S")
    places = np.zeros((len(V), 2))
    places[fixed] = target
    track = BoundaryCurves(curves).lay([fixed], places)
    deviation_barrier = DeviationBarrier(track, [fixed])
    assert len(deviation_barrier.pairs) > 0.9 * fixed.size
    assert 0 < deviation_barrier.value(track.s) < 0.2
    slope, bend = deviation_barrier.derivatives(track.s)
    total = np.zeros(track.s.size)
    for end in (0, 1):
        number = deviation_barrier.pairs[:, end]
        np.add.at(total, number[number >= 0], slope[number >= 0, end])
    gap = curves[0].length / fixed.size
    for _ in range(3):
        d, h = rng.standard_normal(track.s.size) * gap, 1e-3
        change = [deviation_barrier.value(track.advance(track.s, t * d)) for t in (h, -h)]
        assert (change[0] - change[1]) / (2 * h) == pytest.approx(float(total @ d), rel=2e-2)
    assert np.linalg.eigvalsh(bend).min() > -1e-12 * bend.max()
    # At a full step, the edge between two separating vertices deviates too much.
    far = np.where(np.arange(track.s.size) < track.s.size // 2, -4.0, 4.0) * gap
    assert deviation_barrier.value(track.advance(track.s, far)) == np.inf
