"""Boundaries that slide: properties of every map, derivatives against differences, and errors."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.sparse import csr_array

from quasiharmonic import Status, boundary_loops, certify, injective_map, io, morph, polish, surfaces
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import SymmetricDirichlet
from quasiharmonic.energies.measures import distortion
from quasiharmonic.energies.newton.sliding_boundary import SlidingModel
from quasiharmonic.geometry.curves import BoundaryCurves, Curve
from quasiharmonic.geometry.curves.deviation import DeviationBarrier
from quasiharmonic.io.fem.files import read_fem
from quasiharmonic.targets import boundary_to, filled, outline, outline_curves
from quasiharmonic.targets.outlines.letters import glyph_paths
from quasiharmonic.ui.cli import main
from shared.meshes import lift

SQUARE = [(0, 0), (1, 0), (1, 1), (0, 1)]


def z_of(points):
    return points @ (1, 1j)


def points_of(z):
    return np.stack([z.real, z.imag], axis=1)


def sheared(n=10):
    """A grid on the unit square, and a map of it that moves the vertices of its sides along them."""
    V, F = surfaces.grid(n, n)
    x, y = V.T
    uv = np.stack([x + 0.7 * x * (1 - x) * (1 - 0.3 * y), y - 0.3 * y * (1 - y) * x], axis=1)
    (loop,) = boundary_loops(F, len(V))
    return V, F, uv, loop


def turned(rings=8, angle=0.5):
    """A disk, and a map of it that rotates the boundary against the centre, one side more than the other."""
    V, F = surfaces.disk(rings)
    z = z_of(V)
    (loop,) = boundary_loops(F, len(V))
    uv = points_of(z * np.exp(1j * angle * np.abs(z) ** 2 * (1 + 0.6 * np.sin(np.angle(z)))))
    # On the circle to the last bit.
    uv[loop] /= np.hypot(*uv[loop].T)[:, None]
    return V, F, uv, loop


def lettered(text, **options):
    """A curved disk mapped to a letter."""
    V, F = surfaces.random_delaunay(600, seed=4)
    V = lift(V)
    return V, F, *boundary_to(V, F, filled(outline(text))), outline_curves(text)


def off_the_glyph(points, character):
    """Return distances from the pieces that the font draws, by SciPy's search on each; (k,)."""
    away = np.full(len(points), np.inf)
    for control in [piece for path in glyph_paths(character) for piece in path]:

        def at(t, control=control):
            rows = list(control)
            while len(rows) > 1:
                rows = [(1 - t) * a + t * b for a, b in itertools.pairwise(rows)]
            return rows[0]

        near = np.linalg.norm(points[:, None] - np.array([at(t) for t in np.linspace(0, 1, 30)]), axis=2).min(axis=1)
        for i in np.flatnonzero(near < 0.03):
            found = minimize_scalar(
                lambda t, p=points[i]: np.linalg.norm(at(np.clip(t, 0, 1)) - p) ** 2,
                bounds=(-1e-9, 1 + 1e-9),
                method="bounded",
                options={"xatol": 1e-12},
            )
            ends = [found.x, 0, 1]
            away[i] = min(away[i], *(np.linalg.norm(at(np.clip(t, 0, 1)) - points[i]) for t in ends))
    return away


# Results


@pytest.mark.parametrize("character", "GSPH")
def test_a_letter_is_better_with_its_boundary_sliding(character):
    V, F, fixed, target, curves = lettered(f"letter:{character}")
    held = injective_map(V, F, fixed, target, polish="symmetric-dirichlet")
    result = injective_map(V, F, fixed, target, polish="symmetric-dirichlet", slide=BoundaryCurves(curves))
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


@pytest.mark.slow
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


def test_an_edge_does_not_cut_off_a_bend():
    """A curved letter with few vertices: without bounds, the last two jump across, for a lower energy."""
    V, F, fixed, target, curves = lettered("letter:S")
    result = injective_map(V, F, fixed, target, polish="symmetric-dirichlet", slide=BoundaryCurves(curves))
    (curve,) = curves

    def strays(uv):
        middle = (uv[fixed] + uv[np.roll(fixed, -1)]) / 2
        return curve.nearest(middle)[1].max()

    start = result.uv.copy()
    start[fixed] = target
    assert strays(result.uv) < 1.5 * strays(start)


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
    system.curve_stiffness = model.frame(start).forces
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


# Moved meshes


def channel(n=14):
    """Return a channel around a square body, mapped to a rectangle, and the body rotated."""
    V, F = surfaces.annulus(n, hole=(-0.6, -0.6, 0.6, 0.6))
    walls, body = sorted(boundary_loops(F, len(V)), key=lambda loop: -np.abs(V[loop]).max())
    turn = points_of(z_of(V[body]) * np.exp(0.5j))
    return V, F, walls, body, turn


@pytest.mark.parametrize("slide", [True, BoundaryCurves([np.array(SQUARE) * 2.0 - 1])])
def test_a_rotated_body_moves_the_wall_vertices(slide):
    V, F, walls, body, turn = channel()
    held = morph(V, F, body, turn)
    sliding = morph(V, F, body, turn, slide=slide)
    assert sliding.valid
    assert sliding.result.certificate.bijective
    assert sliding.result.history[-1].energy < 0.9 * held.result.history[-1].energy
    np.testing.assert_array_equal(sliding.points[body], turn)
    corners = walls[(np.abs(V[walls]) == 1).all(axis=1)]
    assert len(corners) == 4
    np.testing.assert_array_equal(sliding.points[corners], V[corners])
    # All vertices stay on their side, exactly, and have moved.
    for axis in (0, 1):
        side = walls[np.abs(V[walls, axis]) == 1]
        np.testing.assert_array_equal(sliding.points[side, axis], V[side, axis])
        inner = np.setdiff1d(side, corners)
        assert np.abs(sliding.points[inner] - V[inner]).max() > 0.03
        order = np.argsort(V[side, 1 - axis])
        for value in (-1, 1):
            run = side[order][V[side[order], axis] == value]
            assert (np.diff(sliding.points[run, 1 - axis]) > 0).all()


def test_moved_vertices_slide_on_given_curves():
    V, F, _, body, turn = channel()
    square = points_of(z_of(np.array(SQUARE) * 1.2 - 0.6) * np.exp(0.5j))
    on = dict.fromkeys(body.tolist(), 1)
    rails = BoundaryCurves([np.array(SQUARE) * 2.0 - 1, square], on=on)
    morphed = morph(V, F, body, turn, slide=rails)
    only_walls = morph(V, F, body, turn, slide=True)
    assert morphed.result.history[-1].energy < only_walls.result.history[-1].energy
    assert rails.curves[1].nearest(morphed.points[body])[1].max() <= np.spacing(1.0)
    assert np.abs(morphed.points[body] - turn).max() > 0.01


def test_vertices_of_no_triangle_are_numbered_as_well():
    V, F, walls, body, turn = channel(8)
    V, F = np.concatenate([[(9, 9)], V]), F + 1
    on = dict.fromkeys((walls + 1).tolist(), 0)
    morphed = morph(V, F, body + 1, turn, slide=BoundaryCurves([np.array(SQUARE) * 2.0 - 1], on=on))
    assert morphed.valid
    np.testing.assert_array_equal(morphed.points[0], (9, 9))
    with pytest.raises(ValueError, match="the boundary curves refer to vertex 0, but no triangle"):
        morph(V, F, body + 1, turn, slide=BoundaryCurves([SQUARE], fixed=[0]))


# Errors


@pytest.mark.parametrize(
    ("rails", "message"),
    [
        (
            lambda loop: BoundaryCurves([SQUARE], on={int(loop[3]): 1}),
            "on refers to curve 1, but there are only curves 0 … 0",
        ),
        (lambda loop: BoundaryCurves([SQUARE], on={int(loop[3]): 0.5}), "on must contain integer"),
        (lambda loop: BoundaryCurves([]), "no curve to slide along"),
        (lambda loop: BoundaryCurves([SQUARE], corner_angle=200), "corner_angle must be between 0 and 180"),
        (lambda loop: BoundaryCurves([SQUARE], tolerance=np.nan), "tolerance must be between 0 and 1"),
        (lambda loop: BoundaryCurves([[(0, 0), (1, np.nan), (1, 1)]]), "not finite at row 1"),
        (lambda loop: BoundaryCurves([SQUARE], fixed=[0.5]), "fixed must contain integer"),
        (lambda loop: BoundaryCurves([SQUARE], fixed=[10**6]), "fixed refers to vertex 1000000"),
        (lambda loop: BoundaryCurves([SQUARE], on={10**6: 0}), "on refers to vertex 1000000"),
        (lambda loop: BoundaryCurves([SQUARE], on={60: 0}), "interior vertex 60: only boundary vertices can slide"),
        (lambda loop: BoundaryCurves([np.array(SQUARE) + 7]), "no boundary vertex is within"),
        (
            lambda loop: BoundaryCurves([Curve.polyline([(0, 0), (1, 0)])], on={int(v): 0 for v in loop}),
            "on assigns curve 0 to vertices .* the distance to it is up to 1,",
        ),
        (lambda loop: 3, "slide must be True or BoundaryCurves, not 3"),
        (lambda loop: "letter:G", "slide must be True or BoundaryCurves, not 'letter:G'"),
    ],
)
def test_invalid_boundary_curves(rails, message):
    V, F, uv, loop = sheared()
    with pytest.raises(ValueError, match=message):
        polish(V, F, uv, fixed=loop, slide=rails(loop))


def test_violated_order():
    V, _, _, loop = sheared()
    lower = np.flatnonzero(V[:, 1] == 0)
    a, b = lower[np.argsort(V[lower, 0])][[3, 4]]
    swapped, met = V.copy(), V.copy()
    swapped[[a, b]] = V[[b, a]]
    met[a] = met[b]
    with pytest.raises(ValueError, match="are neighbours on the boundary but not along curve 0"):
        BoundaryCurves([SQUARE]).lay([loop], swapped)
    with pytest.raises(ValueError, match=f"boundary vertices {a} and {b} have the same position on curve 0"):
        BoundaryCurves([SQUARE]).lay([loop], met)


def test_a_start_far_from_the_curves():
    V, F, uv, loop = sheared()
    broken = uv.copy()
    broken[5] = np.nan
    with pytest.raises(ValueError, match="not finite at vertex 5"):
        polish(V, F, broken, fixed=loop, slide=True)
    # Moving the boundary to its curve may invert triangles close to it.
    thin = uv.copy()
    low = np.flatnonzero(V[:, 1] == 0)[3]
    thin[low, 1] = -5e-4
    inner = np.setdiff1d(F[(low == F).any(axis=1)].ravel(), loop)
    thin[inner, 1] = -2.5e-4
    if certify(F, thin).injective:
        with pytest.raises(ValueError, match="with the boundary on the curves"):
            polish(V, F, thin, fixed=loop, slide=BoundaryCurves([SQUARE]))


def test_sliding_needs_an_energy():
    V, F, fixed, target, curves = lettered("letter:H")
    with pytest.raises(ValueError, match="give an energy"):
        injective_map(V, F, fixed, target, slide=BoundaryCurves(curves))


def test_a_map_that_overlaps_itself_may_slide():
    """The map is only injective: the boundary crosses itself and may continue to."""
    t = np.linspace(0, 1, 61)
    arc = np.exp(2.2j * np.pi * t)
    z = np.concatenate([arc * 1.0, arc * 1.5, arc * 2.0])
    k = np.arange(60)
    quads = [(i + r, i + r + 1, i + r + 62, i + r + 61) for r in (0, 61) for i in k]
    F = np.array([tri for a, b, c, d in quads for tri in ((a, c, b), (a, d, c))])
    uv = points_of(z)
    V = np.stack([np.tile(6.0 * t, 3), np.repeat([0.0, 0.5, 1.0], 61)], axis=1) * (1, -1)
    (loop,) = boundary_loops(F, len(V))
    start = certify(F, uv)
    if not start.injective:
        F = F[:, ::-1]
        V = V * (1, -1)
        (loop,) = boundary_loops(F, len(V))
    assert certify(F, uv).injective
    assert not certify(F, uv).bijective
    rails = BoundaryCurves([Curve.polygon(uv[loop])], on=dict.fromkeys(loop.tolist(), 0))
    result = polish(V, F, uv, fixed=loop, slide=rails, max_iterations=5)
    assert result.injective
    assert result.history[-1].energy < result.history[0].energy


# The command


def test_map_slides(tmp_path):
    V, F = surfaces.random_delaunay(300, seed=2)
    _write(tmp_path / "in.obj", lift(V), F)
    energies = []
    for name, options in (("held", []), ("slid", ["--slide"])):
        call = ["map", str(tmp_path / "in.obj"), "--to", "letter:G", "--polish", "symmetric-dirichlet"]
        report = tmp_path / f"{name}.json"
        assert main([*call, *options, "-o", str(tmp_path / f"{name}.obj"), "--json", str(report)]) == 0
        facts = json.loads(report.read_text())
        assert facts["injective"]
        assert facts.get("slide", False) == bool(options)
        mesh = io.read_mesh(tmp_path / f"{name}.obj")
        energies.append(distortion(mesh.V, mesh.F, io.map_of(mesh)).statistics("symmetric_dirichlet").mean)
    assert energies[1] < energies[0]
    uv = io.map_of(io.read_mesh(tmp_path / "slid.obj"))
    (loop,) = boundary_loops(F, len(V))
    assert off_the_glyph(uv[loop], "G").max() < 1e-8
    # Continue from the result, with the outline's name and with the existing polygon.
    for options in (["--to", "letter:G"], []):
        call = ["polish", str(tmp_path / "slid.obj"), "-o", str(tmp_path / "more.obj"), "--slide", *options]
        assert main(call) == 0


def _write(path, V, F):
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in V.tolist()] + [f"f {a} {b} {c}" for a, b, c in (F + 1).tolist()]
    path.write_text("\n".join(lines) + "\n")


def test_errors_of_the_command(tmp_path, capsys):
    _write(tmp_path / "in.obj", lift(surfaces.disk(4)[0]), surfaces.disk(4)[1])
    out = ["-o", str(tmp_path / "out.obj")]
    assert main(["map", str(tmp_path / "in.obj"), "--to", "disk", "--slide", "--no-polish", *out]) == 2
    assert "--slide needs polishing: omit --no-polish" in capsys.readouterr().err
    assert main(["map", str(tmp_path / "in.obj"), "--to", "disk", "--slide", *out]) == 0
    assert main(["polish", str(tmp_path / "out.obj"), "--to", "disk", "-o", str(tmp_path / "b.obj")]) == 2
    assert "add --slide" in capsys.readouterr().err


def test_the_command_names_vertices_off_the_outline(tmp_path, capsys):
    V, F = surfaces.disk(6)
    source = tmp_path / "in.obj"
    io.write_obj(source, io.MeshData(lift(V), F).with_map(V))
    out = ["-o", str(tmp_path / "out.obj")]
    assert main(["polish", str(source), "--slide", "--to", "disk", *out]) == 0
    assert "off the outline" not in capsys.readouterr().out
    rim = boundary_loops(F, len(V))[0]
    V[rim[:3]] *= 1.01
    io.write_obj(source, io.MeshData(lift(V), F).with_map(V))
    assert main(["polish", str(source), "--slide", "--to", "disk", *out]) == 0
    named = ", ".join(map(str, rim[:3]))
    assert (
        f"3 of {len(rim)} boundary vertices are off the outline and stay fixed: vertices {named}"
        in capsys.readouterr().out
    )


def test_vertices_have_given_sides(tmp_path, capsys):
    V, F = surfaces.grid(10, 10)
    # With the diagonal before the corner (1, 0) flipped, there is space beside it for the next vertex of the right
    # side, which is closer to the lower one.
    F[18:20] = (9, 10, 21), (9, 21, 20)
    uv, moved = V.copy(), 21
    uv[moved] = 0.9995, 0.0004
    io.write_obj(tmp_path / "in.obj", io.MeshData(lift(V), F).with_map(uv))
    pieces, out = tmp_path / "sides.txt", tmp_path / "out.obj"
    call = ["polish", str(tmp_path / "in.obj"), "--to", "rect:1x1", "--slide", "-o", str(out)]
    assert main(call) == 2
    assert "assign vertices to curves" in capsys.readouterr().err
    pieces.write_text(f"# the right side is the second\n\n{moved}, 1\n")
    assert main([*call, "--pieces", str(pieces)]) == 0
    found = io.map_of(io.read_mesh(out))
    assert found[moved, 0] == 1
    assert found[moved, 1] > 0.05
    # The same for a new map.
    right = np.flatnonzero(V[:, 0] == 1)
    pieces.write_text("".join(f"{v} 1\n" for v in right))
    corners = [int(np.flatnonzero((place == V).all(axis=1))[0]) for place in SQUARE]
    call = ["map", str(tmp_path / "in.obj"), "--to", "rect:2x1", "--corners", ",".join(map(str, corners))]
    call += ["-o", str(out)]
    assert main([*call, "--slide", "--pieces", str(pieces)]) == 0
    assert (io.map_of(io.read_mesh(out))[right, 0] == 2).all()
    pieces.write_text("".join(f"{v} 3\n" for v in right))
    assert main([*call, "--slide", "--pieces", str(pieces)]) == 2
    assert (
        "on assigns curve 3 to vertices 10, 21, 32, 43, 54, … (11 in all), but the distance to it is up to 2"
        in capsys.readouterr().err
    )
    for text, message in (
        ("3 4", "says side 4, but the outline has only sides 0 … 3 at line 1"),
        ("3", "is not 'vertex side'"),
        ("-3 1", "is not 'vertex side'"),
        ("3 1\n3 1", "lists vertex 3 a second time at line 2"),
        ("9999 1", "on refers to vertex 9999"),
    ):
        pieces.write_text(text)
        assert main([*call, "--slide", "--pieces", str(pieces)]) == 2
        assert message in capsys.readouterr().err
    assert main([*call, "--pieces", str(pieces)]) == 2
    assert "add --slide and --to" in capsys.readouterr().err
    assert main([*call, "--slide", "--pieces", str(tmp_path / "none")]) == 2
    assert "cannot be read" in capsys.readouterr().err


def test_morph_slides(tmp_path):
    V, F, walls, body, turn = channel(10)
    shift = np.zeros((len(V), 3))
    shift[body, :2] = turn - V[body]
    lines = ["# vtk DataFile Version 3.0", "a channel", "ASCII", "DATASET UNSTRUCTURED_GRID", f"POINTS {len(V)} double"]
    lines += [f"{x!r} {y!r} 0" for x, y in V.tolist()]
    lines += [f"CELLS {len(F)} {4 * len(F)}", *(f"3 {a} {b} {c}" for a, b, c in F.tolist())]
    lines += [f"CELL_TYPES {len(F)}", *["5"] * len(F), f"POINT_DATA {len(V)}", "VECTORS displacement double"]
    lines += [f"{x!r} {y!r} {z!r}" for x, y, z in shift.tolist()]
    (tmp_path / "in.vtk").write_text("\n".join(lines) + "\n")
    call = ["morph", str(tmp_path / "in.vtk"), "--field", "displacement", "--slide", "-o", str(tmp_path / "out.vtk")]
    assert main(call) == 0
    after = read_fem(tmp_path / "out.vtk").points
    # The field moves the walls by zero, so they slide.
    np.testing.assert_array_equal(after, morph(V, F, body, V[body] + shift[body, :2], slide=True).points)
    assert np.abs(after[walls] - V[walls]).max() > 0.03
    assert (np.abs(after[walls]).max(axis=1) == 1).all()
    assert main([*call, "--no-polish"]) == 2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"curves": None}, "curves must be a Curve, a polygon"),
        ({"curves": [SQUARE], "on": [1, 2]}, "on must map vertices to curves"),
    ],
)
def test_invalid_curves(arguments, words):
    with pytest.raises(ValueError, match=words):
        BoundaryCurves(**arguments)
