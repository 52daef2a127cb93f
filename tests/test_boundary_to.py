"""The boundary on outlines, and ``qhm map --to``."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pytest

from quasiharmonic import Problem, cut_open, diagnose, injective_map, io, refine, surfaces, targets
from quasiharmonic.geometry.mesh.topology import boundary_loops, edges
from quasiharmonic.targets import boundary_to, flattened_edges, outline
from quasiharmonic.targets.boundary import correspondence
from quasiharmonic.targets.boundary.chord_clearance import ChordConditions, choose, clear_chords, reach
from quasiharmonic.targets.boundary.correspondence import arc_parameters, max_deviation, places_along, points_at
from quasiharmonic.targets.boundary.holes import choose_least_stretch
from quasiharmonic.targets.outlines import contours
from quasiharmonic.ui.cli import main
from shared.meshes import lift
from shared.obj_reader import written


def holed(n, *holes, seed=0):
    """Return a curved disk without the triangles whose centres lie in some circles (x, y, radius)."""
    V, F = surfaces.random_delaunay(n, seed)
    middle = V[F].mean(axis=1)
    solid = np.ones(len(F), dtype=bool)
    for x, y, radius in holes:
        solid &= np.hypot(*(middle - (x, y)).T) > radius
    used, F = np.unique(F[solid], return_inverse=True)
    V, F = surfaces.refine(V[used], F.reshape(-1, 3))
    return lift(V), F


def plain_grid(nx, ny):
    """Return a grid whose diagonals all rise to the right, with ears at two of its corners."""
    x, y = np.meshgrid(np.arange(nx + 1.0), np.arange(ny + 1.0))
    j, i = np.divmod(np.arange(nx * ny), nx)
    low = i + j * (nx + 1)
    corners = np.stack([low, low + 1, low + nx + 2, low, low + nx + 2, low + nx + 1], axis=1)
    return np.stack([x.ravel(), y.ravel()], axis=1), corners.reshape(-1, 3)


def placed(V, F, *arguments, **options):
    fixed, target = boundary_to(V, F, *arguments, **options)
    where = np.full((len(V), 2), np.nan)
    where[fixed] = target
    return where


def torus(n=24, m=12):
    a, b = np.meshgrid(np.arange(n), np.arange(m), indexing="ij")
    u, v = a.ravel() * 2 * np.pi / n, b.ravel() * 2 * np.pi / m
    V = np.stack([(2 + np.cos(v)) * np.cos(u), (2 + np.cos(v)) * np.sin(u), np.sin(v)], axis=1)
    at = lambda i, j: (i % n) * m + j % m  # noqa: E731
    a, b = a.ravel(), b.ravel()
    F = [
        np.stack([at(a, b), at(a + 1, b), at(a + 1, b + 1)], 1),
        np.stack([at(a, b), at(a + 1, b + 1), at(a, b + 1)], 1),
    ]
    return V, np.concatenate(F)


def octahedron():
    V = np.concatenate([np.eye(3), -np.eye(3)])
    F = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])
    V, F = surfaces.refine(V, F)
    return V / np.linalg.norm(V, axis=1)[:, None], F


# --- one loop


@pytest.mark.parametrize("text", ["disk", "rect:2x1", "star:5", "letter:G", "letter:H"])
def test_corners_are_matched_and_other_vertices_lie_on_the_outline(text):
    V, F = surfaces.cat(16)
    (contour,) = outline(text)
    fixed, target = boundary_to(V, F, [contour])
    assert sorted(fixed.tolist()) == sorted(boundary_loops(F, len(V))[0].tolist())
    sharp = contours.corners(contour, 20)
    assert all((target == contour[k]).all(axis=1).sum() == 1 for k in sharp)
    side = np.roll(contour, -1, axis=0) - contour
    for point in target:
        share = np.clip(((point - contour) * side).sum(axis=1) / (side**2).sum(axis=1), 0, 1)
        assert np.linalg.norm(contour + share[:, None] * side - point, axis=1).min() < 1e-12
    assert targets.signed_area(target) > 0
    assert injective_map(V, F, fixed, target).certificate.bijective


def test_same_positions_as_arc_length_without_conflicts():
    V, F = surfaces.cat(16)
    (loop,) = boundary_loops(F, len(V))
    for contour in (targets.rectangle(2, 1), targets.letter("G")[0]):
        # The outline may begin in the middle of a side, so start at a corner.
        first = contours.from_corner(contour, 20)
        np.testing.assert_allclose(boundary_to(V, F, contour)[1], targets.arc_length(V[loop], first), atol=1e-12)


def test_either_orientation_and_single_or_listed_outlines():
    V, F = surfaces.cat(10)
    square = targets.rectangle(1, 1)
    wanted = boundary_to(V, F, square)
    for other in ([square], (square.tolist(),), square[[0, 3, 2, 1]], square.astype(np.float32)):
        fixed, target = boundary_to(V, F, other)
        assert np.array_equal(fixed, wanted[0])
        assert np.array_equal(target, wanted[1])


def test_scale_and_position_of_the_surface_do_not_matter():
    V, F = holed(150, (0.1, 0.2, 0.3))
    wanted = boundary_to(V, F, outline("letter:R"))[1]
    for other in (V * 1e-200, V * 1e150, V + np.array([1e3, -1e3, 0])):
        np.testing.assert_allclose(boundary_to(other, F, outline("letter:R"))[1], wanted, atol=1e-6)


def test_a_clockwise_planar_mesh_is_mirrored():
    V, F = surfaces.grid(6, 4)
    where = placed(V, F[:, ::-1], targets.rectangle(1, 1))
    np.testing.assert_allclose(where[[0, 6, 34, 28]], [(1, 0), (0, 0), (0, 1), (1, 1)], atol=1e-12)


# --- given corners


@pytest.fixture
def cat():
    V, F = surfaces.cat(12)
    return V, F, boundary_loops(F, len(V))[0]


def test_corners_in_order(cat):
    V, F, loop = cat
    chosen = loop[[5, 20, 41, 66]]
    where = placed(V, F, targets.rectangle(2, 1), corners=chosen)
    assert where[chosen].tolist() == [[0, 0], [2, 0], [2, 1], [0, 1]]
    # Every run of the boundary is distributed on its own side by length.
    for (i, j), (axis, side) in zip([(5, 20), (20, 41), (41, 66)], [(1, 0), (0, 2), (1, 1)], strict=True):
        run = loop[i : j + 1]
        assert (where[run, axis] == side).all()
        lengths = np.linalg.norm(np.diff(V[run], axis=0), axis=1)
        steps = np.linalg.norm(np.diff(where[run], axis=0), axis=1)
        np.testing.assert_allclose(steps / steps.sum(), lengths / lengths.sum(), rtol=1e-9)
    assert injective_map(V, F, *boundary_to(V, F, targets.rectangle(2, 1), corners=chosen)).injective


def test_corners_by_number_and_by_point(cat):
    V, F, loop = cat
    a, b, c = loop[[5, 20, 41]].tolist()
    where = placed(V, F, targets.rectangle(2, 1), corners={a: 2, b: (0.25, 1), c: np.array([0, 1 + 1e-9])})
    assert where[[a, c]].tolist() == [[2, 1], [0, 1]]
    assert where[b] == pytest.approx((0.25, 1), abs=1e-14)
    assert sum((where == corner).all(axis=1).any() for corner in targets.rectangle(2, 1)) == 4
    # One vertex on an outline without corners: its first point.
    assert placed(V, F, targets.disk(), corners=[a])[a].tolist() == [1, 0]


def test_few_vertices_between_given_corners(cat):
    V, F, loop = cat
    star = targets.star(4)
    where = placed(V, F, star, corners={int(loop[0]): 0, int(loop[4]): 4})
    assert where[loop[:5]].tolist() == star[:5].tolist()
    with pytest.raises(ValueError, match=f"2 boundary vertices between {loop[0]} and {loop[3]}, too few to keep the 3"):
        boundary_to(V, F, star, corners={int(loop[0]): 0, int(loop[3]): 4})


@pytest.mark.parametrize(
    ("corners", "message"),
    [
        ([5, 20, 66, 41], "vertices 405, 420, 466, 441 follow each other .* but in the order 405, 420, 441, 466"),
        ([5, 20, 41], r"3 corner vertices for .* 4 corners \(0 at \(0, 0\), 1 at \(2, 0\), .*\): name one for each"),
        ([5, 20, 41, -3], "vertex 394 in corners, but not on the boundary"),
        ([5, 20, 41, 5], "corners name vertex 405 more than once"),
        ([], "corners must name boundary vertices"),
        ({5: 4}, "vertex 405 goes to corner 4, but the contour has corners 0 to 3"),
        ({5: (0.5, 0.5)}, r"vertex 405 goes to \(0.5, 0.5\), 0.5 off the outline at \(0.5, 0\)"),
        ({5: (0.5, np.nan)}, "vertex 405 goes to a corner's number or a point"),
        ({5: "x"}, "could not convert string"),
        ({5: 0, 9: (0, 0)}, "vertices 405 and 409 have the same target position"),
    ],
)
def test_invalid_corners(cat, corners, message):
    V, F, loop = cat
    number = lambda k: int(loop[k]) if k >= 0 else int(loop.min()) + k  # noqa: E731
    assert loop[0] == 397
    message = message.replace("394", str(number(-3)))
    for k in (5, 9, 20, 41, 66):
        message = message.replace(f"4{k:02}", str(number(k)))
    named = {number(k): v for k, v in corners.items()} if isinstance(corners, dict) else [number(k) for k in corners]
    with pytest.raises(ValueError, match=message):
        boundary_to(V, F, targets.rectangle(2, 1), corners=named)


@pytest.mark.parametrize("shift", [0, 1])
def test_corners_have_the_numbers_of_the_given_outline(cat, tmp_path, shift):
    """The direction does not matter; a first point that is no corner does not count."""
    V, F, loop = cat
    a, b, c, d = loop[[5, 20, 41, 66]].tolist()
    ring = np.array([(1, 0), (2, 0), (2, 1), (0, 1), (0, 0)], dtype=float)
    if shift:
        ring = np.roll(ring, -1, axis=0)
    (tmp_path / "o.txt").write_text("".join(f"{x} {y}\n" for x, y in ring[::-1]))
    for contour, order in ((ring, (a, b, c, d)), (ring[::-1], (d, c, b, a)), (outline(tmp_path / "o.txt")[0], None)):
        sharp = [tuple(p) for p in contour.tolist() if p[0] != 1]
        where = placed(V, F, contour, corners=list(order or (d, c, b, a)))
        assert [tuple(p) for p in where[list(order or (d, c, b, a))].tolist()] == sharp
        where = placed(V, F, contour, corners={a: 2})
        assert tuple(where[a]) == sharp[2]
    with pytest.raises(ValueError, match=r"in this order around the outline, .* to its left: reverse their order"):
        boundary_to(V, F, ring[::-1], corners=[a, b, c, d])


def test_edge_by_edge(cat):
    """Every point of a curve gets its given vertex, and every side the run between two of them."""
    V, F, loop = cat
    angle = np.arange(24) * 2 * np.pi / 24
    curve = np.stack([np.cos(angle), np.sin(angle)], axis=1) * (1 + 0.2 * np.cos(3 * angle))[:, None]
    chosen = loop[np.sort(np.random.default_rng(5).choice(len(loop), 24, replace=False))]
    where = placed(V, F, curve, corners=chosen, corner_angle=0)
    assert np.array_equal(where[chosen], curve)
    with pytest.raises(ValueError, match="23 corner vertices for a contour with 24 corners"):
        boundary_to(V, F, curve, corners=chosen[1:], corner_angle=0)
    every = {int(v): tuple(p) for v, p in zip(loop, targets.arc_length(V[loop], curve, start=3), strict=True)}
    where = placed(V, F, curve, corners=every)
    assert where[list(every)] == pytest.approx(np.array(list(every.values())), abs=1e-12)


@pytest.mark.parametrize(("scale", "offset"), [(1e-300, 0), (1e-150, 0), (1e150, 0), (1e300, 0), (1, 1e8), (1, 1e12)])
def test_scale_and_position_of_the_outline(scale, offset):
    V, F = surfaces.annulus(8)
    contours = [c * scale + offset for c in outline("letter:O", tolerance=1e-4)]
    vertex = int(boundary_loops(F, len(V))[0][3])
    for corners in (None, {vertex: contours[0][5]}):
        fixed, target = boundary_to(V, F, contours, corners=corners)
        _, wanted = boundary_to(
            V,
            F,
            [c / scale - offset / scale for c in contours],
            corners=corners and {vertex: contours[0][5] / scale - offset / scale},
        )
        np.testing.assert_allclose((target - offset) / scale, wanted, atol=1e-15 * max(offset, 10))
        assert injective_map(V, F, fixed, target).certificate.bijective
    with pytest.raises(ValueError, match="off the outline at"):
        boundary_to(V, F, contours, corners={vertex: (1e308, -1e308)})


def test_outlines_that_bound_no_region_are_rejected_at_once():
    V, F = surfaces.disk(6)
    with pytest.raises(ValueError, match="contour 0 of the outline meets itself"):
        boundary_to(V, F, [[(0, 0), (1, 1), (1, 0), (0, 1)]])
    with pytest.raises(ValueError, match="the outline has no contour"):
        boundary_to(V, F, [])


@pytest.mark.slow
def test_too_few_vertices_for_the_shape_are_rejected():
    """A thin spiral, cut off by a straight side between two vertices."""
    turn = np.linspace(0, 4 * np.pi, 200)
    arm = (0.2 + turn / 10)[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    spiral = np.concatenate([arm, 1.15 * arm[::-1]])
    V, F = surfaces.disk(3)
    with pytest.raises(
        ValueError,
        match=r"the boundary placed along the outline crosses or touches itself: boundary loop 0 meets itself.*too few",
    ):
        boundary_to(V, F, spiral)
    V, F = surfaces.disk(15)
    fixed, target = boundary_to(V, F, spiral)
    assert injective_map(V, F, fixed, target).certificate.bijective


# --- space for chords


def test_corners_go_to_ears():
    """The two triangles at corners of the grid fit only at corners of the rectangle, for every rotation."""
    V, F = plain_grid(7, 5)
    for turn in (0.0, 0.3, 2.0, 4.0):
        turned = V @ np.array([(np.cos(turn), np.sin(turn)), (-np.sin(turn), np.cos(turn))])
        for text in ("rect:2x1", "polygon:3", "letter:H"):
            fixed, target = boundary_to(turned, F, outline(text))
            assert len(flattened_edges(F, fixed, target)) == 0
            assert injective_map(turned, F, fixed, target).injective


def brute_force(along, wanted, room):
    count = len(along) - 1
    best = np.inf, None
    for chosen in itertools.combinations(range(1, count), len(wanted)):
        ends = [0, *chosen, count]
        sides = list(zip(itertools.pairwise(ends), room.straight, room.spare, strict=True))
        if any(b - a <= spare or (straight and room.reach[a] <= b) for (a, b), straight, spare in sides):
            continue
        if (np.abs(along[list(chosen)] - wanted) > room.farthest).any():
            continue
        best = min(best, (float(((along[list(chosen)] - wanted) ** 2).sum()), chosen))
    return best


def test_vertices_move_as_little_as_needed(rng):
    solved = 0
    for _ in range(300):
        count, k = int(rng.integers(3, 12)), int(rng.integers(0, 4))
        along = np.concatenate([[0], np.sort(rng.random(count - 1)), [1]])
        wanted = np.sort(rng.random(k))
        reach = np.minimum.accumulate(rng.integers(2, 8, count + 1)[::-1] + np.arange(count, -1, -1))[::-1]
        room = ChordConditions(
            np.minimum(reach, count + 1), rng.random(k + 1) < 0.7, rng.integers(0, 3, k + 1), rng.choice([0.3, 1])
        )
        cost, chosen = brute_force(along, wanted, room)
        found = choose(along, wanted, room)
        assert (found is None) == (chosen is None)
        if found is not None:
            solved += 1
            assert ((along[found] - wanted) ** 2).sum() == pytest.approx(cost)
    assert 50 < solved < 250


def test_chords_beyond_a_pin_are_not_changed():
    s = np.arange(12) / 12
    square = targets.rectangle(1, 1)
    chords = np.array([[11, 1], [4, 6]])
    pins = clear_chords(s, square, [(0, 0.0)], corner_angle=20, chords=chords)
    assert dict(pins)[5] in (0.25, 0.5)
    # The pin between the ends of a chord stays; the vertex between those of the other goes to a corner.
    pins = dict(clear_chords(s, square, [(5, 0.6)], corner_angle=20, chords=np.array([[4, 6], [7, 9]])))
    assert pins[5] == 0.6
    assert pins[8] in (0, 0.25, 0.5, 0.75)
    # More ears than corners.
    ears = np.stack([np.arange(1, 11, 2) - 1, np.arange(1, 11, 2) + 1], axis=1)
    assert clear_chords(s, square, [(0, 0.0)], corner_angle=20, chords=ears) is None
    stretch = next(correspondence.stretches(s, [(2, 0.0)]))
    assert reach(stretch, np.array([[3, 6], [1, 11]]), 12).tolist() == [
        4,
        4,
        11,
        11,
        11,
        11,
        11,
        11,
        11,
        11,
        13,
        13,
        13,
    ]


def test_distance_between_a_contour_and_its_sides():
    """Compare with distances of points from the sides that span them."""
    contour = targets.star(5)
    on_tips, between = np.arange(0, 1, 0.2), np.arange(10) / 10 + 0.05
    inner, first, second = contour[1], contour[0], contour[2]
    normal = np.array([first[1] - second[1], second[0] - first[0]]) / np.linalg.norm(second - first)
    assert max_deviation(contour, on_tips, points_at(contour, on_tips)) == pytest.approx(abs((inner - first) @ normal))
    assert max_deviation(contour, np.arange(10) / 10, contour) == 0
    # The vertices begin at any index.
    places = points_at(contour, between)
    assert max_deviation(contour, np.roll(between, 3), np.roll(places, 3, axis=0)) == pytest.approx(
        max_deviation(contour, between, places)
    )


@pytest.mark.slow
@pytest.mark.parametrize("character", "GC352")
@pytest.mark.parametrize("size", [(12, 8), (40, 20)])
def test_corners_move_only_up_to_a_limit(character, size):
    """A torus cut open has ears along the whole cut; the outline is not changed much for them."""
    opened = cut_open(*torus(*size))
    (contour,) = targets.filled(outline(f"letter:{character}"))
    fixed, target = boundary_to(opened.V, opened.F, contour)
    assert targets.signed_area(target) == pytest.approx(targets.signed_area(contour), rel=0.03)
    refined = refine(opened.V, opened.F, flattened_edges(opened.F, fixed, target))
    result = injective_map(refined.V, refined.F, fixed, target)
    assert result.certificate.bijective


def test_flattened_edges_are_named_and_splitting_them_helps():
    V, F = plain_grid(4, 4)
    fixed = boundary_loops(F, len(V))[0]
    start = int(np.flatnonzero(fixed == 2)[0])
    target = targets.arc_length(V[fixed], targets.rectangle(1, 1), start=start)
    flat = flattened_edges(F, fixed, target)
    # The square's corners are mapped to the middles of the grid's sides, and both ears lie on a side.
    assert flat.tolist() == [[3, 9], [15, 21]]
    assert not injective_map(V, F, fixed, target).injective
    refined = refine(V, F, flat)
    assert len(flattened_edges(refined.F, fixed, target)) == 0
    assert injective_map(refined.V, refined.F, fixed, target).injective


@pytest.mark.slow
def test_flattened_edges_agree_with_the_exact_diagnosis():
    """On coordinates without rounding, an edge is flat exactly if the diagnosis finds no space beside it."""
    V, F = plain_grid(4, 4)
    (loop,) = boundary_loops(F, len(V))
    found = []
    for contour in (targets.rectangle(4, 4), np.array([(0, 0), (4, 0), (4, 2), (2, 2), (2, 4), (0, 4)])):
        for start in range(16):
            target = targets.arc_length(V[loop], contour, start=start)
            assert (target % 1 == 0).all()
            flat = flattened_edges(F, loop, target).tolist()
            assert flat == diagnose(Problem(V, F, loop, target)).split.tolist()
            found.append(len(flat))
    assert set(found) == {0, 1, 2}


# --- several loops


@pytest.mark.parametrize(
    ("text", "holes"),
    [
        ("ring:0.4", [(0.4, 0, 0.25)]),
        ("letter:R", [(0.1, 0.3, 0.2)]),
        ("letter:A", [(0, -0.4, 0.2)]),
        ("letter:B", [(0, 0.5, 0.15), (0.1, -0.4, 0.2)]),
        ("letter:8", [(-0.5, 0, 0.15), (0.5, 0, 0.15)]),
    ],
)
def test_holes(text, holes):
    V, F = holed(250, *holes)
    contours = outline(text)
    fixed, target = boundary_to(V, F, contours)
    assert len(fixed) == len(np.unique(edges(F, len(V)).boundary))
    split = flattened_edges(F, fixed, target)
    refined = refine(V, F, split)
    result = injective_map(refined.V, refined.F, fixed, target)
    assert result.injective
    assert result.certificate.bijective


def test_holes_go_to_the_closest_contour():
    centres = np.array([(-0.5, -0.4), (0.5, -0.4), (0.0, 0.55)])
    V, F = holed(600, *((x, y, 0.12) for x, y in centres))
    square = targets.rectangle(0.2, 0.2) - 0.1
    contours = [targets.disk(), *(square + 0.9 * c for c in np.roll(centres, 1, axis=0))]
    where = placed(V, F, contours)
    for loop in boundary_loops(F, len(V)):
        middle = V[loop, :2].mean(axis=0)
        if len(loop) < 60:
            near = np.argmin(np.linalg.norm(centres - middle, axis=1))
            assert where[loop].mean(axis=0) == pytest.approx(0.9 * centres[near], abs=0.05)


def test_holes_are_rotated_for_the_least_energy():
    """Compare with the Dirichlet energy of Tutte's embedding, over all combinations of a few rotations."""
    from quasiharmonic import quasi_harmonic_map

    V, F = holed(150, (-0.45, 0.1, 0.2), (0.4, 0.2, 0.2), seed=1)
    fixed = np.concatenate(boundary_loops(F, len(V)))
    problem = Problem(V, F, fixed, V[fixed, :2])
    outer = int(np.argmax([len(loop) for loop in problem.domain.loops]))
    inner = [i for i in range(3) if i != outer]
    square = targets.rectangle(0.4, 0.4)[::-1] - 0.2
    given = {outer: targets.arc_length(V[problem.domain.loops[outer]], targets.disk())}
    choices = {}
    for i, x in zip(inner, (0.5, -0.4), strict=True):
        s = arc_parameters(V[problem.domain.loops[i]])
        starts = range(0, len(s), max(1, len(s) // 8))
        choices[i] = [
            points_at(square + np.array([x, 0.1]), places_along(s, square, [(k, 0.0)], corner_angle=20)) for k in starts
        ]

    def energy(places):
        uv = quasi_harmonic_map(problem.with_target(np.concatenate([places[i] for i in range(3)])))
        sides = uv[F] - uv[np.roll(F, -1, axis=1)]
        return float((sides**2).sum())

    every = {
        ks: energy(given | {i: choices[i][k] for i, k in zip(inner, ks, strict=True)})
        for ks in itertools.product(*(range(len(choices[i])) for i in inner))
    }
    chosen = energy(given | choose_least_stretch(problem.domain, given, choices))
    low, high = min(every.values()), max(every.values())
    assert chosen <= low + 0.01 * (high - low)


def test_a_point_assigns_loops_to_contours():
    """Turned inside out: the vertex of the hole is assigned to the outer circle."""
    V, F = surfaces.annulus(8)
    outer, inner = (int(loop[0]) for loop in boundary_loops(F, len(V)))
    circles = targets.ring(0.5)
    assert np.linalg.norm(placed(V, F, circles)[outer]) == pytest.approx(1)
    where = placed(V, F, circles, corners={inner: (1, 0)})
    assert where[inner].tolist() == [1, 0]
    assert np.linalg.norm(where[outer]) == pytest.approx(0.5, rel=1e-3)
    with pytest.raises(ValueError, match="two boundary loops have vertices that go to the same contour"):
        boundary_to(V, F, circles, corners={inner: (1, 0), outer: (0, 1)})
    with pytest.raises(ValueError, match="goes to a different contour than other vertices of its boundary loop"):
        boundary_to(V, F, circles, corners={inner: (1, 0), inner + 1: (0.5, 0)})
    with pytest.raises(ValueError, match="must lie on one boundary loop, but 2 loops have some"):
        boundary_to(V, F, circles, corners=[inner, outer])


# --- mismatches


@pytest.mark.parametrize(
    ("mesh", "text", "message"),
    [
        (
            surfaces.disk(4),
            "letter:B",
            "1 boundary loop, and the outline 3 contours .2 holes.: fill the outline's holes",
        ),
        (
            surfaces.annulus(4),
            "letter:B",
            r"2 boundary loops, and the outline 3 contours \(2 holes\): choose .* 1 hole",
        ),
        (
            surfaces.annulus(4),
            "disk",
            "2 boundary loops, and the outline 1 contour .no hole.: choose .* 1 hole, or close",
        ),
        (
            surfaces.disk(4),
            "letter:i",
            r"the outline is in 2 separate pieces \(beginning at \(.*\), \(.*\)\), and a connected surface can fill",
        ),
        (
            torus(),
            "disk",
            r"the surface is closed: .* cut it open first \(cut_open; --cut of qhm map and qhm flatten\)",
        ),
        (octahedron(), "disk", "the surface is closed"),
        ((torus()[0], torus()[1][1:]), "disk", "the surface has a handle and fits into no outline: cut it open"),
        (surfaces.disk(1), "letter:H", "the loop has 6 vertices, too few to keep the 12 corners"),
    ],
)
def test_surfaces_and_outlines_that_do_not_match(mesh, text, message):
    with pytest.raises(ValueError, match=message):
        boundary_to(*mesh, outline(text))


def test_malformed_meshes_are_left_to_the_problem():
    V, F = surfaces.disk(3)
    with pytest.raises(ValueError, match=r"more than two triangles|repeated"):
        boundary_to(V, np.vstack([F, F[3]]), outline("disk"))
    with pytest.raises(ValueError, match="2 components"):
        boundary_to(np.vstack([V, V]), np.vstack([F, F + len(V)]), outline("disk"))
    with pytest.raises(ValueError, match="refers to vertex 99"):
        boundary_to(V, np.vstack([F, [0, 1, 99]]), outline("disk"))


# --- cut open


@pytest.mark.parametrize("mesh", [torus(), (torus()[0], torus()[1][1:]), octahedron(), surfaces.annulus(6)])
def test_cut_open(mesh):
    V, F = mesh
    opened = cut_open(V, F)
    assert len(boundary_loops(opened.F, len(opened.V))) == 1
    assert np.array_equal(opened.origin[: len(V)], np.arange(len(V)))
    assert np.array_equal(opened.origin[opened.F], F)
    assert np.array_equal(opened.V, V[opened.origin])
    assert injective_map(opened.V, opened.F, *boundary_to(opened.V, opened.F, outline("disk"))).injective


@pytest.mark.parametrize("scale", [0, 1e-310, 1e-200, 1e200, 1e300])
def test_cut_open_at_any_scale(scale):
    V, F = octahedron()
    opened = cut_open(scale * V, F)
    assert len(boundary_loops(opened.F, len(opened.V))) == 1
    assert np.array_equal(opened.V, scale * V[opened.origin])


def test_cut_open_tetrahedron():
    """No two of its vertices are further apart than one edge, and cutting one edge opens nothing."""
    V, F = np.vstack([np.zeros(3), np.eye(3)]), np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    opened = cut_open(V, F)
    assert len(boundary_loops(opened.F, len(opened.V))[0]) == 4


def test_cut_open_along_more_edges_than_needed():
    V, F = surfaces.starfish(3, 12)
    copies = [len(cut_open(V, F, min_gain=gain).V) for gain in (np.inf, 0.1)]
    assert len(V) < copies[0] < copies[1]
    V, F = surfaces.disk(3)
    assert np.array_equal(cut_open(V, F).F, F)
    # An interior slit is connected to the boundary.
    slit = cut_open(V, F, edges=[[0, 1], [0, 2]])
    assert {0, 2} <= set(slit.origin[len(V) :])
    assert len(boundary_loops(slit.F, len(slit.V))) == 1


def test_surfaces_that_cannot_be_cut_open():
    V, F = surfaces.disk(3)
    with pytest.raises(ValueError, match="refers to vertex 99"):
        cut_open(V, np.vstack([F, [0, 1, 99]]))
    V, F = octahedron()
    with pytest.raises(ValueError, match=r"repeated|more than two"):
        cut_open(V, np.vstack([F, F[:1]]))


# --- the command


@pytest.fixture
def qhm(tmp_path, capsys):
    """Write a mesh without vt, map it, and return status, report and output."""

    def run(mesh, *options):
        io.write_obj(tmp_path / "in.obj", io.MeshData(*mesh))
        report = tmp_path / "report.json"
        report.unlink(missing_ok=True)
        status = main(
            ["map", str(tmp_path / "in.obj"), "-o", str(tmp_path / "out.obj"), "--json", str(report), *options]
        )
        said = capsys.readouterr()
        return status, json.loads(report.read_text()) if report.exists() else None, said.out + said.err

    run.out = tmp_path / "out.obj"
    return run


@pytest.mark.parametrize("text", ["disk", "letter:G", "rect:2x1", "star:5"])
def test_to(qhm, text):
    V, F = surfaces.cat(12)
    status, facts, _ = qhm((V, F), "--to", text)
    assert status == 0
    assert facts["injective"]
    assert facts["to"] == text
    written = io.read_mesh(qhm.out)
    assert np.array_equal(written.F, F)
    fixed, target = boundary_to(V, F, outline(text))
    assert np.array_equal(io.map_of(written)[fixed], target)


def test_to_files(qhm, tmp_path):
    (tmp_path / "o.svg").write_text('<svg><path d="M0 0h4v3h-4zm1 1h1v1h-1z" fill-rule="evenodd"/></svg>')
    (tmp_path / "o.txt").write_text("0 0\n4 0\n4 3\n0 3\n\n1 1\n2 1\n2 2\n1 2\n")
    for name in ("o.svg", "o.txt"):
        status, facts, _ = qhm(surfaces.annulus(8), "--to", str(tmp_path / name))
        assert status == 0
        assert facts["bijective"]


def test_to_with_corners(qhm):
    V, F = surfaces.cat(12)
    loop = boundary_loops(F, len(V))[0].tolist()
    a, b, c, d = (loop[k] for k in (5, 20, 41, 66))
    assert qhm((V, F), "--to", "rect:2x1", "--corners", f"{a},{b},{c},{d}")[0] == 0
    assert io.map_of(io.read_mesh(qhm.out))[[a, b, c, d]].tolist() == [[0, 0], [2, 0], [2, 1], [0, 1]]
    assert qhm((V, F), "--to", "rect:2x1", "--corners", f"{a}:1,{b}:1.5:1")[0] == 0
    assert io.map_of(io.read_mesh(qhm.out))[[a, b]].tolist() == [[2, 0], [1.5, 1]]


def test_to_edge_by_edge_from_a_file(qhm, tmp_path):
    V, F = surfaces.cat(12)
    loop = boundary_loops(F, len(V))[0]
    square = [(0, 0), (0.5, -0.01), (1, 0), (1, 1), (0, 1)]
    (tmp_path / "o.txt").write_text("".join(f"{x} {y}\n" for x, y in square))
    chosen = loop[[2, 10, 20, 40, 70]].tolist()
    to = ["--to", str(tmp_path / "o.txt"), "--corners", str(tmp_path / "pairs"), "--corner-angle", "0"]
    for text in ("{} {}\n", "{}:{} # a comment\n\n"):
        (tmp_path / "pairs").write_text("".join(text.format(v, k) for k, v in enumerate(chosen)))
        assert qhm((V, F), *to)[0] == 0
        np.testing.assert_array_equal(io.map_of(io.read_mesh(qhm.out))[chosen], square)
    status, _, said = qhm((V, F), *to[:4], "--json", str(tmp_path / "pairs"))
    assert status == 2
    assert "would replace an input" in said
    # Without it, the slight bend has no number.
    status, _, said = qhm((V, F), *to[:4])
    assert status == 2
    assert "goes to corner 4, but the contour has corners 0 to 3: 0 at (0, 0), 1 at (1, 0)" in said


def grouped(path, V, F):
    """Write an OBJ file with colours and two groups."""
    with path.open("w") as file:
        file.writelines(f"v {x} {y} {z} {k / len(V)} 0 0\n" for k, (x, y, z) in enumerate(V))
        for name, part in (("first", F[: len(F) // 2]), ("second", F[len(F) // 2 :])):
            file.write(f"g {name}\nusemtl of_{name}\n")
            file.writelines(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in part)


def groups(path):
    """Return the faces of each group, and vertices with their colours."""
    found, lines = {}, path.read_text().splitlines()
    for line in lines:
        if line.startswith("g "):
            here = found.setdefault(line[2:], [])
        if line.startswith("f "):
            here.append([int(word.split("/")[0]) - 1 for word in line.split()[1:]])
    return found, np.array([line.split()[1:] for line in lines if line.startswith("v ")], dtype=float)


def test_cut_and_refined_files_keep_groups_and_colours(tmp_path):
    V, F = torus()
    grouped(tmp_path / "in.obj", V, F)
    out = tmp_path / "out.obj"
    assert main(["map", str(tmp_path / "in.obj"), "-o", str(out), "--to", "letter:H", "--cut", "--refine"]) == 0
    found, vertices = groups(out)
    assert list(found) == ["first", "second"]
    assert "usemtl of_second" in out.read_text()
    assert len(vertices) >= len(V)
    np.testing.assert_array_equal(vertices[: len(V), 3], np.arange(len(V)) / len(V))
    assert np.isfinite(vertices[:, 3]).all()
    # After splits, a group covers the same area of the surface.
    area = lambda V, F: np.linalg.norm(np.cross(*(V[F[:, k]] - V[F[:, 0]] for k in (1, 2))), axis=1).sum()  # noqa: E731
    for part, before in (("first", F[: len(F) // 2]), ("second", F[len(F) // 2 :])):
        assert area(vertices[:, :3], np.array(found[part])) == pytest.approx(area(V, before))


def test_holes_missing_in_the_outline_are_filled(qhm):
    status, facts, said = qhm(surfaces.cat(12), "--to", "letter:B", "--font", "DejaVu Sans")
    assert status == 0
    assert facts["filled_holes"] == 2
    assert "the surface has no hole, so the 2 holes of letter:B are filled" in said


def test_to_a_word(qhm):
    pytest.importorskip("shapely")
    assert qhm(surfaces.cat(20), "--to", "word:QH")[0] == 0


@pytest.mark.slow
def test_rejection_and_refinement(qhm):
    V, F = surfaces.disk(2)
    ring = np.arange(len(V) - 12, len(V))
    # A triangle on every boundary edge.
    tips = 1.2 * (V[ring] + V[np.roll(ring, -1)]) / 2
    ears = np.stack([np.roll(ring, -1), ring, len(V) + np.arange(12)], axis=1)
    V, F = np.vstack([V, tips]), np.vstack([F, ears])
    status, _, said = qhm((V, F), "--to", "rect:2x1")
    assert status == 2
    assert "in.obj: the inner edges" in said
    assert "boundary vertices between which rect:2x1 does not bend outwards" in said
    assert "--refine" in said
    assert not qhm.out.exists()
    status, facts, said = qhm((V, F), "--to", "rect:2x1", "--refine")
    assert status == 0
    assert facts["added_vertices"] >= 8
    assert f"split {facts['added_vertices']} edges" in said
    written = io.read_mesh(qhm.out)
    assert np.array_equal(written.V[: len(V), :2], V)
    assert len(written.V) == len(V) + facts["added_vertices"] == facts["vertices"]


@pytest.mark.slow
def test_refine_without_to(tmp_path, capsys):
    """It treats positions in the file like an outline."""
    V, F = plain_grid(4, 4)
    fixed = boundary_loops(F, len(V))[0]
    uv = np.full((len(V), 2), 0.5)
    uv[fixed] = targets.arc_length(V[fixed], targets.rectangle(1, 1), start=int(np.flatnonzero(fixed == 2)[0]))
    io.write_obj(tmp_path / "in.obj", io.MeshData(V, F).with_map(uv))
    arguments = ["map", str(tmp_path / "in.obj"), "-o", str(tmp_path / "out.obj")]
    assert main(arguments) == 1
    assert main([*arguments, "--refine"]) == 0
    np.testing.assert_array_equal(io.map_of(io.read_mesh(tmp_path / "out.obj"))[fixed], uv[fixed])


def test_closed_surfaces(qhm):
    status, _, said = qhm(torus(), "--to", "disk")
    assert status == 2
    assert "the surface is closed" in said
    assert "--cut" in said
    V, F = torus()
    status, facts, said = qhm((V, F), "--to", "letter:G", "--cut")
    assert status == 0
    assert f"cut along {facts['cut_edges']} edges: seams of the map" in said
    written = io.read_mesh(qhm.out)
    np.testing.assert_array_equal(written.V, V)
    np.testing.assert_array_equal(written.F, F)
    assert len(io.mapped(written).seams) == facts["cut_edges"]


def test_non_manifold_surfaces_are_reported(qhm):
    """A strip with half a twist has one boundary loop with all vertices; the error is its orientation."""
    i, V = np.arange(0, 20, 2), np.random.default_rng(0).normal(size=(20, 3))
    a, b, c, d = i, i + 1, (i + 2) % 20, (i + 3) % 20
    c[-1], d[-1] = 1, 0
    F = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
    for onto in ("disk", "letter:A"):
        status, _, said = qhm((V, F), "--to", onto)
        assert status == 2
        assert "mixed winding: edge (0, 1) traversed" in said


def test_flat_triangles_are_reported_with_their_file(qhm):
    V, F = surfaces.disk(3)
    V[3] = V[0]
    status, _, said = qhm((V, F), "--to", "disk")
    assert status == 2
    assert "in.obj --to disk: triangle" in said


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--corners", "3"], "--corners applies only to an outline: give one by --to"),
        (["--font", "x"], "--font applies only to an outline"),
        (["--cut"], "--cut applies only to an outline"),
        (["--to", "lettr:G"], "unknown outline 'lettr:G'"),
        (["--to", "none.svg"], "none.svg: there is no such file"),
        (["--to", "disk", "--font", "x"], "'disk' takes no font"),
        (["--to", "rect:1x1", "--corners", "0"], "in.obj --to rect:1x1: vertex 0 in corners, but not on the boundary"),
        (["--to", "letter:i"], "in.obj --to letter:i: the outline is in 2 separate pieces"),
        (["--to", "rect:0x1"], "--to rect:0x1: width must be positive"),
        (["--to", "disk", "--corners", "a"], "--corners a: 'a' is not one of V, V:K and V:X:Y"),
        (["--to", "disk", "--corners", "1,,2"], "'' is not one of V"),
        (["--to", "disk", "--corners", "1:2:3:4"], "'1:2:3:4' is not one of V"),
        (["--to", "disk", "--corners", "1,2:3"], "vertex 1 has no corner or point"),
        (["--to", "disk", "--corners", "1:2,1:3"], "vertex 1 is named more than once"),
        (["--to", "disk", "--corners", "1,1"], "vertex 1 is named more than once"),
        (["--corner-angle", "0"], "--corner-angle applies only to an outline"),
        ([], "in.obj: no face refers to texture coordinates (vt), so the boundary has no targets: "),
    ],
)
def test_invalid_calls(qhm, options, message):
    status, _, said = qhm(surfaces.disk(3), *options)
    assert status == 2
    assert message in said
    assert not qhm.out.exists()


@pytest.mark.parametrize(
    "options",
    [["--to", "disk", "--fixed", "f"], ["--corner-angle", "181"], ["--corner-angle", "x"], ["--corner-angle", "nan"]],
)
def test_calls_that_cannot_be_read(qhm, options):
    with pytest.raises(SystemExit) as stop:
        qhm(surfaces.disk(3), *options)
    assert stop.value.code == 2


@pytest.mark.parametrize("character", "AGHPRS")
def test_letters_of_the_paper(character, tmp_path):
    """A curved surface on each letter, by this option alone."""
    out, report = tmp_path / "out.obj", tmp_path / "report.json"
    io.write_obj(tmp_path / "cat.obj", io.MeshData(*surfaces.cat(20)))
    command = ["map", str(tmp_path / "cat.obj"), "--to", f"letter:{character}"]
    assert main([*command, "-o", str(out), "--json", str(report)]) == 0
    facts = json.loads(report.read_text())
    assert facts["bijective"]
    assert facts["n_iterations"] < 100
    assert main(["check", str(out)]) == 0
    assert written(out).signs().min() == 1
