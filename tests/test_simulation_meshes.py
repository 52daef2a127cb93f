"""Simulation meshes with moving boundaries: chains of steps, quadrilaterals, second-order triangles, sliding."""

from __future__ import annotations

import json

import numpy as np
import pytest

from quasiharmonic import BoundaryCurves, Status, boundary_loops, morph, surfaces
from quasiharmonic.apps.mesh_motion.morph_result import describe_overlap
from quasiharmonic.geometry.exact.jacobian_signs import inverted_elements
from quasiharmonic.geometry.mesh.elements import rim
from quasiharmonic.ui.plot.canvas import RED
from shared.meshes import boundary_of
from shared.simulation import channel, min_jacobian, quadrilaterals, second_order, turned


@pytest.fixture(scope="module")
def flap():
    """Return a mesh around a flap, and the flap's vertices."""
    points, F = surfaces.annulus(8, hole=(-0.6, -0.05, 0.6, 0.05))
    loops = boundary_loops(F, len(points))
    return points, F, min(loops, key=lambda loop: np.abs(points[loop]).max())


def dent(points, depth, waves=1):
    """Return the upper side of the unit square, and its target positions with some dents of a given depth."""
    upper = np.flatnonzero(points[:, 1] == 1)
    x = points[upper, 0]
    return upper, np.stack([x, 1 - depth * np.sin(waves * np.pi * x) ** 2], axis=1)


# ---- second-order triangles ----------------------------------------------------------------------------------------


def test_a_curved_triangle_is_valid_although_a_straight_one_is_inverted():
    rest = [(0, 0), (1, 0), (0.5, 0.5), (0.5, 0), (0.75, 0.25), (0.25, 0.25)]
    bent = np.array([(0, 0), (1, 0), (0.5, -0.01), (0.5, -0.3), (0.75, -0.08), (0.25, -0.08)])
    moved = morph(rest, [[0, 1, 2, 3, 4, 5]], range(6), bent)
    assert min_jacobian(bent) > 0
    assert moved.success
    assert moved.status is Status.INJECTIVE
    assert "overlap" not in moved.summary()


def test_six_node_elements_may_overlap():
    corners = np.array([(0, 0), (1, 0), (0, 1), (0.5, 0), (0.5, 0.5), (0, 0.5)])
    F = np.arange(12).reshape(2, 6)
    for shift, overlapping in ((0.1, [0, 1]), (1, [])):
        found, text = describe_overlap(F, np.concatenate([corners, corners + np.array([shift, 0])]))
        assert found.tolist() == overlapping
        assert ["may overlap itself" in line for line in text] == [True] * bool(overlapping)


# ---- chains ---------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_small_steps_end_like_one_large_step(flap):
    points, F, body = flap
    whole = morph(points, F, body, turned(points[body], 50))
    here = careless = points
    for degrees in range(5, 51, 5):
        place = turned(points[body], degrees)
        morphed = morph(here, F, body, place, rest=points)
        assert morphed.valid
        here = morphed.points
        careless = morph(careless, F, body, place).points
    size = np.sqrt(4 / len(F))
    away = np.abs(here - whole.points).max()
    assert away < 1e-3 * size
    assert morphed.drift() == pytest.approx(np.hypot(*(here - whole.points).T).max(), rel=1e-6)
    # If each step is measured against the previous mesh, errors accumulate.
    assert np.abs(careless - whole.points).max() > 100 * away


@pytest.mark.slow
@pytest.mark.parametrize("slide", [False, True])
def test_a_closed_path_returns_to_the_start(flap, slide):
    points, F, body = flap
    here = points
    for degrees in (10, 20, 30, 20, 5, -10, 0):
        here = morph(here, F, body, turned(points[body], degrees), rest=points, slide=slide).points
    back = morph(points, F, body, points[body], slide=slide).points
    assert np.abs(here - back).max() < 1e-3
    if not slide:
        assert np.abs(here - points).max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["quadrilaterals", "second order"])
def test_chains_of_other_elements_return_to_the_start(flap, kind):
    if kind == "quadrilaterals":
        first, F, body = channel(16)
    else:
        first, F = second_order(*flap[:2])
        body = rim(F)[np.abs(first[rim(F)]).max(axis=1) < 0.9]
    here = first
    for degrees in (20, 40, 60):
        morphed = morph(here, F, body, turned(first[body], degrees), rest=first)
        here = morphed.points
    assert morphed.valid
    assert morphed.drift() < 1e-3
    for degrees in (30, 0):
        here = morph(here, F, body, turned(first[body], degrees), rest=first).points
    assert np.abs(here - first).max() < 1e-6


def test_drift_of_a_chain_is_reported(flap):
    points, F, body = flap
    # Without an energy, the mesh depends on the start of the search.
    here = points
    for degrees in (20, 40, 60):
        morphed = morph(here, F, body, turned(points[body], degrees), rest=points, energy=None)
        here = morphed.points
    assert morphed.valid
    assert morphed.drift() > 1e-3
    # A position that one step does not reach has no reference.
    crossing = points[body] * (1, 30)
    assert np.isnan(morph(points, F, body, crossing, max_iterations=20).drift())


def test_the_search_begins_at_the_start(flap):
    points, F, body = flap
    place = turned(points[body], 75)
    plain = morph(points, F, body, place)
    begun = morph(points, F, body, place, start=plain.points)
    assert begun.result.n_iterations < plain.result.n_iterations
    assert np.abs(begun.points - plain.points).max() < 1e-4
    again = morph(plain.points, F, body, place, rest=points)
    assert np.abs(again.points - begun.points).max() < 1e-12


@pytest.mark.parametrize("name", ["rest", "start"])
def test_invalid_start_and_rest_meshes(flap, name):
    points, F, body = flap
    lost = points.copy()
    lost[7] = np.nan
    for mesh, message in ((points[:-1], r"\(n, 2\)|shape"), (lost, f"{name} is not finite at vertex 7")):
        with pytest.raises(ValueError, match=message):
            morph(points, F, body, points[body], **{name: mesh})
    with pytest.raises(ValueError, match="degenerate"):
        morph(points, F, body, points[body], rest=points * (1, 0))


# ---- quadrilaterals -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("depth", "waves"), [(0.3, 1), (0.9, 1), (0.5, 3)])
def test_quadrilaterals_stay_convex(depth, waves):
    points, F = quadrilaterals(12, 12)
    moved, positions = dent(points, depth, waves)
    morphed = morph(points, F[:, ::-1], moved, positions)
    assert morphed.valid
    assert morphed.quality_after.min() > 0
    assert np.array_equal(morphed.points[moved], positions)
    still = np.setdiff1d(rim(F), moved)
    assert np.array_equal(morphed.points[still], points[still])
    assert not inverted_elements(F, morphed.points).size


@pytest.mark.slow
@pytest.mark.parametrize("slide", [False, True])
def test_both_diagonals_are_checked(slide):
    points, F, body = channel(16)
    place = turned(points[body], 120)
    morphed = morph(points, F, body, place, slide=slide)
    # The triangles on either side of one diagonal alone leave corners inverted.
    assert "untangling corners" in [stage.name for stage in morphed.result.stages]
    assert morphed.valid
    assert morphed.result.status is Status.POLISHED
    assert np.array_equal(morphed.points[body], place)
    walls = np.setdiff1d(rim(F), body)
    assert np.abs(np.abs(morphed.points[walls]).max(axis=1) - 1).max() < 1e-12
    assert np.array_equal(morphed.points[walls], points[walls]) is not slide


def test_quadrilaterals_and_triangles_in_one_mesh():
    points, F = quadrilaterals(10, 10)
    a, b, c, d = F[::7].T
    mixed = np.concatenate([np.delete(F, np.s_[::7], axis=0), np.stack([a, b, c, c], 1), np.stack([a, c, d, d], 1)])
    morphed = morph(points, mixed, *dent(points, 0.8))
    assert morphed.valid
    assert morphed.quality_after.min() > 0


def test_concave_quadrilaterals_are_named():
    points, F = quadrilaterals(6, 6)
    bad = points.copy()
    centre = 24
    bad[centre] += (0.1, 0.1)
    with pytest.raises(ValueError, match="quadrilateral 21 not convex: all four corners"):
        morph(bad, F, *dent(bad, 0.2))
    # Intermediate positions may be concave, but rest positions must not.
    assert morph(bad, F, *dent(bad, 0.2), rest=points).valid
    with pytest.raises(ValueError, match=r"quadrilaterals 0, 1, .* not convex"):
        morph(points * (1, 0), F, [0], [[0, 0]])


def test_quadrilaterals_inverted_by_the_boundary_are_named():
    points, F = quadrilaterals(6, 6)
    # The corner of the square moves across the line between its neighbours.
    corner = len(points) - 1
    morphed = morph(points, F, [corner], [[0.9, 0.9]])
    assert morphed.inverted.tolist() == morphed.forbidden.tolist() == [len(F) - 1]
    assert not morphed.valid
    assert "Inverted for every position of the free nodes: quadrilateral 35" in morphed.summary()
    assert json.loads(json.dumps(morphed.to_dict()))["forbidden"] == [35]


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", [surfaces.grid, quadrilaterals, lambda n, m: second_order(*surfaces.grid(n, m))], ids=["3", "4", "6"]
)
def test_figure_and_summary_of_the_element_quality(kind):
    points, F = kind(4, 4)
    # Two corners change places; a mid-side node moves to three quarters of its side.
    at, to = ((0.125,), [[0.2, 1]]) if F.shape[1] == 6 else ((0.5, 0.75), [[0.75, 1], [0.5, 1]])
    upper = np.flatnonzero((points[:, 1] == 1) & np.isin(points[:, 0], at))
    morphed = morph(points, F, upper, to, max_iterations=5)
    assert morphed.inverted.size
    np.testing.assert_array_equal(morphed.points_before, points)
    before, after, histogram = morphed.plot().axes
    for ax, count in ((before, 0), (after, len(morphed.inverted))):
        (shapes,) = ax.collections
        assert len(shapes.get_paths()) == len(F)
        assert (shapes.get_facecolor()[:, :3] == RED).all(axis=1).sum() == count
    for at, patch in zip((before, after), (points, morphed.points), strict=True):
        corners = np.concatenate([path.vertices for path in at.collections[0].get_paths()])
        assert {tuple(row) for row in patch[F].reshape(-1, 2)} <= {tuple(row) for row in corners}
    assert histogram.get_ylabel() == "elements"
    words = f"worst {morphed.quality_before.min():.3g} before and {morphed.quality_after.min():.3g} after"
    assert words in morphed.summary()
    assert "<img" in morphed._repr_html_()


# ---- second order ---------------------------------------------------------------------------------------------------


def middles(F):
    """Return mid-side nodes and the ends of their sides."""
    return F[:, 3:].ravel(), F[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def off_straight(points, F):
    """Return the distance of mid-side nodes from the middles of their sides, by node."""
    middle, ends = middles(F)
    off = np.zeros(len(points))
    off[middle] = np.hypot(*(points[middle] - points[ends].mean(axis=1)).T)
    return off


def test_mid_side_nodes_follow_straight_sides(flap):
    flat, three, body = flap
    points, F = second_order(flat, three)
    morphed = morph(points, F, body, turned(flat[body], 60))
    assert morphed.valid
    # Corners move as without mid-side nodes, and mid-side nodes stay in the middle.
    assert np.array_equal(morphed.points[: len(flat)], morph(flat, three, body, turned(flat[body], 60)).points)
    assert off_straight(morphed.points, F).max() < 1e-15
    still = np.setdiff1d(boundary_of(three), body)
    assert np.array_equal(morphed.points[still], flat[still])


@pytest.mark.slow
@pytest.mark.parametrize("mirror", [False, True])
def test_sides_bend_where_a_curved_boundary_requires_it(mirror):
    points, F = second_order(*surfaces.grid(8, 8))
    if mirror:
        F = F[:, [0, 2, 1, 5, 4, 3]]
    # Only the mid-side nodes of the upper side move down, by more than half an element.
    moved, positions = dent(points, 0.08, 8)
    morphed = morph(points, F, moved, positions)
    assert morphed.valid
    assert np.array_equal(morphed.points[moved], positions)
    straight = morphed.points.copy()
    middle, ends = middles(F)
    inner = ~np.isin(middle, rim(F))
    straight[middle[inner]] = straight[ends[inner]].mean(axis=1)
    assert inverted_elements(morphed.F, straight).size == 8
    # No side bends far from the boundary; an outward bulge requires no bend.
    off = off_straight(morphed.points, F)
    assert off[points[:, 1] < 0.7].max() < 1e-12
    bulging = morph(points, F, moved, positions * (1, -1) + (0, 2))
    assert bulging.valid
    assert off_straight(bulging.points, F)[np.setdiff1d(middle, moved)].max() < 1e-15


def test_a_bent_mesh_keeps_its_shape():
    points, F = second_order(*surfaces.grid(5, 5))
    rng = np.random.default_rng(0)
    number = np.unique(F[:, 3:])
    points[number] += rng.normal(scale=0.01, size=(len(number), 2))
    assert not inverted_elements(F, points).size
    morphed = morph(points, F, [], np.empty((0, 2)))
    assert morphed.valid
    assert np.abs(morphed.points - points).max() < 1e-12
    # Rotated as a whole, its sides keep their bends: interior ones, and boundary ones that are not given.
    corners = np.setdiff1d(rim(F), number)
    whole = morph(points, F, corners, turned(points[corners], 90))
    assert np.abs(whole.points - turned(points, 90)).max() < 1e-6


@pytest.mark.slow
def test_elements_that_remain_inverted_are_reported():
    points, F = second_order(*surfaces.grid(4, 4))
    # A mid-side node at three quarters of its side inverts the element at an end, wherever the others move.
    side = np.flatnonzero((points[:, 1] == 1) & (points[:, 0] == 0.125))
    morphed = morph(points, F, side, [[0.2, 1]])
    assert not morphed.valid
    assert morphed.inverted.size == 1
    assert side[0] in F[morphed.inverted[0]]


@pytest.mark.long
def test_failed_repair_causes_no_warning():
    points, F = second_order(*surfaces.grid(5, 5))
    side = np.flatnonzero(((points == 0) | (points == 1)).any(axis=1))
    x, y = points[side].T
    # A system of equations is singular during the repair.
    across = 0.18889902923018087 * np.sin(2 * np.pi * y + 0.38528662)
    up = 0.11786290113252539 * np.sin(3 * np.pi * x + 4.0750892)
    morphed = morph(points, F, side, np.stack([x + across, y + up], axis=1))
    assert morphed.inverted.size
    assert morphed.inverted.tolist() == [k for k, row in enumerate(F) if min_jacobian(morphed.points[row]) <= 0]


def test_an_element_moved_to_a_point_is_reported_without_a_warning():
    points, F = second_order(*surfaces.grid(3, 3))
    element = next(row for row in F if not np.isin(row[:3], rim(F)).any())
    morphed = morph(points, F, element, np.repeat(points[element[:1]], 6, axis=0))
    assert np.flatnonzero((element == F).all(axis=1)) in morphed.inverted


@pytest.mark.slow
@pytest.mark.parametrize("slide", [True, "rails"])
def test_mid_side_nodes_slide_too(flap, slide):
    points, F = second_order(*flap[:2])
    body = rim(F)[np.abs(points[rim(F)]).max(axis=1) < 0.9]
    square = BoundaryCurves([[(-1, -1), (1, -1), (1, 1), (-1, 1)]])
    morphed = morph(points, F, body, turned(points[body], 45), slide=square if slide == "rails" else True)
    held = morph(points, F, body, turned(points[body], 45))
    assert morphed.valid
    walls = np.setdiff1d(rim(F), body)
    assert np.abs(np.abs(morphed.points[walls]).max(axis=1) - 1).max() < 1e-12
    assert morphed.result.history[-1].energy < held.result.history[-1].energy
    assert morphed.drift() < 1e-4
    # Where nothing moves, nothing slides.
    still = morph(points, F, body, points[body], slide=square if slide == "rails" else True)
    assert np.abs(still.points - points).max() < 1e-6
