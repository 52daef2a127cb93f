"""The boundary on outlines, and ``qhm map --to``."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from quasiharmonic import Problem, cut_open, diagnose, injective_map, refine, surfaces, targets
from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.targets import boundary_to, flattened_edges, outline
from quasiharmonic.targets.boundary import correspondence
from quasiharmonic.targets.boundary.correspondence import max_deviation, points_at
from quasiharmonic.targets.boundary.placement import ChordConditions, choose, clear_chords, reach
from quasiharmonic.targets.outlines import contours
from shared.boundaries import holed, placed, plain_grid, torus

# --- one loop


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.long
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
    V, F = surfaces.disk(12)
    fixed, target = boundary_to(V, F, spiral)
    assert injective_map(V, F, fixed, target).certificate.bijective


# --- space for chords


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.long
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


@pytest.mark.long
def test_flattened_edges_agree_with_the_exact_diagnosis():
    """On coordinates without rounding, an edge is flat exactly if the diagnosis finds no space beside it."""
    V, F = plain_grid(4, 4)
    (loop,) = boundary_loops(F, len(V))
    found = []
    for contour in (targets.rectangle(4, 4), np.array([(0, 0), (4, 0), (4, 2), (2, 2), (2, 4), (0, 4)])):
        for start in range(8):
            target = targets.arc_length(V[loop], contour, start=start)
            assert (target % 1 == 0).all()
            flat = flattened_edges(F, loop, target).tolist()
            assert flat == diagnose(Problem(V, F, loop, target)).split.tolist()
            found.append(len(flat))
    assert set(found) == {0, 1, 2}
