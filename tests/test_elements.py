"""Elements of three, four and six nodes: exact tests for inversion, and quality."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import surfaces
from quasiharmonic.apps.mesh_motion.quality import element_quality
from quasiharmonic.energies.measures import mean_ratio
from quasiharmonic.geometry.exact.jacobian_signs import inverted_elements
from quasiharmonic.geometry.exact.triangles import find_concave
from quasiharmonic.geometry.mesh.elements import (
    corner_triangles,
    covering_triangles,
    element_array,
    jacobian_coefficients,
    join_elements,
    reverse_elements,
    rim,
)
from quasiharmonic.geometry.mesh.polygons import Polygons
from shared.meshes import boundary_of
from shared.simulation import min_jacobian, quadrilaterals, second_order

STRAIGHT = np.array([(0, 0), (1, 0), (0, 1), (0.5, 0), (0.5, 0.5), (0, 0.5)])


def judged(nodes):
    """Return which six-node triangles (k, 6, 2) are inverted somewhere."""
    bad = np.zeros(len(nodes), dtype=bool)
    bad[inverted_elements(np.arange(6 * len(nodes)).reshape(-1, 6), nodes.reshape(-1, 2))] = True
    return bad


@pytest.mark.parametrize("noise", [0.1, 0.2])
def test_curved_triangles_agree_with_rational_arithmetic(noise):
    nodes = STRAIGHT + np.random.default_rng(4).normal(scale=noise, size=(100, 6, 2))
    least = np.array([float(min_jacobian(element)) for element in nodes])
    assert np.array_equal(judged(nodes), least <= 0)
    assert 10 < np.count_nonzero(least > 0) < 95
    values = jacobian_coefficients(nodes[..., 0], nodes[..., 1])
    # Positive control values are sufficient, but not necessary.
    assert (least[(values > 0).all(axis=1)] > 0).all()
    assert ((values <= 0).any(axis=1) & (least > 0)).any()
    # At the corners they are twice the determinant itself, and necessary.
    assert (values[:, :3] >= 2 * least[:, None] - 1e-12).all()
    quality = element_quality(np.arange(nodes[..., 0].size).reshape(-1, 6), nodes.reshape(-1, 2))
    assert np.array_equal(quality > 0, least > 0)


def test_determinants_with_zeros_are_decided():
    # On a lattice, zeros are frequent: along sides, at corners, inside.
    rng = np.random.default_rng(1)
    nodes = 4 * STRAIGHT + rng.integers(-1, 2, size=(4000, 6, 2))
    values = jacobian_coefficients(nodes[..., 0].astype(float), nodes[..., 1].astype(float))
    nodes = nodes[(values[:, :3] > 0).all(axis=1) & (values[:, 3:] < 0).any(axis=1)][:120]
    least = [min_jacobian(element) for element in nodes]
    zero = np.array([value == 0 for value in least])
    assert zero.any()
    assert (~zero).any()
    for unit, offset in ((1.0, 0.0), (2.0**-700, 0.0), (2.0**-20, 1.0)):
        assert judged(nodes * unit + offset).tolist() == [value <= 0 for value in least]


def test_a_node_outside_the_middle_half_inverts():
    # On a straight side, the determinant is zero at an end if the mid-side node is a quarter of the way from it.
    for along, bad in ((0.25, True), (np.nextafter(0.25, 1), False), (0.75, True), (np.nextafter(0.75, 0), False)):
        nodes = STRAIGHT.copy()
        nodes[3] = along, 0
        assert judged(nodes[None]).tolist() == [bad]


def test_quadrilaterals_are_valid_if_they_are_convex():
    rng = np.random.default_rng(0)
    points, F = quadrilaterals(30, 30)
    points += rng.normal(scale=0.012, size=points.shape)
    halves = F[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    rings = Polygons(6 * np.repeat(np.arange(len(F)), 4) + np.tile([0, 1, 2, 5], len(F)), 4 * np.arange(len(F) + 1))
    wrong = find_concave(rings, halves, points)
    assert 0 < wrong.size < len(F)
    assert np.array_equal(inverted_elements(F, points), wrong)
    assert np.array_equal(np.flatnonzero(element_quality(F, points) <= 0), wrong)
    assert np.array_equal(inverted_elements(F, np.full_like(points, np.nan)), np.arange(len(F)))


def test_quality_of_known_elements():
    points = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [3, 0], [3, 1], [0.5, np.sqrt(0.75)]])
    F = np.array([[0, 1, 2, 3], [0, 4, 5, 3], [0, 1, 6, 6], [0, 3, 2, 1]])
    assert element_quality(F, points) == pytest.approx([1, 0.6, 1, -1])
    assert element_quality(np.arange(6)[None], STRAIGHT) == pytest.approx([np.sqrt(0.75)])


@pytest.mark.parametrize("scale", [1, 1e-3, 1 / 3, 1e-130, 1e130])
def test_quality_of_straight_second_order_triangles_is_that_of_triangles(scale):
    points, corners = surfaces.grid(7, 7)
    points[:, 1] += 0.1 * np.sin(3 * points[:, 0])
    points, F = second_order(points * scale, corners)
    assert element_quality(F, points) == pytest.approx(mean_ratio(points, corners), rel=1e-9)


def test_quality_depends_on_the_smallest_jacobian():
    rng = np.random.default_rng(4)
    bent = STRAIGHT + rng.normal(scale=0.06, size=(60, 6, 2))
    F = np.arange(360).reshape(60, 6)
    quality = element_quality(F, bent.reshape(-1, 2))
    coefficients = jacobian_coefficients(bent[..., 0], bent[..., 1])
    mean = np.abs(coefficients.mean(axis=1)) / 2
    even = np.array([float(min_jacobian(nodes)) for nodes in bent]) / mean
    assert quality == pytest.approx(np.abs(mean_ratio(bent.reshape(-1, 2), F[:, :3])) * even, rel=1e-9, abs=1e-12)


def test_triangles_among_quadrilaterals():
    F = element_array([[0, 1, 2, 3], [1, 4, 2, 2]], 5)
    points = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [2, 0.5]])
    assert np.array_equal(F, join_elements([np.array([[0, 1, 2, 3]]), np.array([[1, 4, 2]])]))
    assert covering_triangles(F)[0].tolist() == [[0, 1, 2], [0, 2, 3], [1, 4, 2]]
    triangles, of = corner_triangles(F)
    assert of.tolist() == [0, 0, 0, 0, 1, 1]
    assert {frozenset(triangle) for triangle in triangles[4:].tolist()} == {frozenset((1, 4, 2))}
    assert not inverted_elements(F, points).size
    over = reverse_elements(F)
    assert over.tolist() == [[0, 3, 2, 1], [1, 2, 4, 4]]
    assert inverted_elements(over, points).tolist() == [0, 1]
    assert rim(F).tolist() == [0, 1, 2, 3, 4]
    with pytest.raises(ValueError, match="both six-node triangles and other elements"):
        join_elements([np.zeros((1, 6), dtype=int), np.zeros((1, 3), dtype=int)])


def test_boundary_nodes_do_not_depend_on_the_winding():
    points, F = surfaces.annulus(8)
    curved, six = second_order(points, F)
    mixed = np.where((np.arange(len(six)) % 3 == 0)[:, None], reverse_elements(six), six)
    found = rim(mixed)
    assert np.array_equal(found[found < len(points)], np.sort(boundary_of(F)))
    # One node in the middle of each boundary side.
    assert len(found) == 2 * len(boundary_of(F))
    assert np.array_equal(np.sort(reverse_elements(six), axis=1), np.sort(six, axis=1))
    assert inverted_elements(reverse_elements(six), curved).size == len(six)


@pytest.mark.parametrize(
    ("F", "message"),
    [
        ([[0, 1, 2, 3, 4]], r"\(f, 3\), \(f, 4\) or \(f, 6\)"),
        ([[0, 1, 1]], "triangle 0 with a node twice"),
        ([[0, 1, 2, 3], [0, 1, 2, 0]], "quadrilateral 1 with a node twice"),
        ([[0, 1, 1, 2]], "quadrilateral 0 with a node twice"),
        ([[0, 1, 2, 3, 4, 3]], "triangle 0 with a node twice"),
        ([[0, 1, 2, 9]], "F refers to vertex 9"),
    ],
)
def test_rows_that_are_not_elements(F, message):
    with pytest.raises(ValueError, match=message):
        element_array(F, 6)


@pytest.mark.parametrize("order", [[0, 1, 2, 3, 5, 4], [0, 1, 2, 4, 5, 3], [3, 4, 5, 0, 1, 2], [0, 3, 1, 4, 2, 5]])
def test_other_node_orders_are_reported(order):
    points, F = second_order(*surfaces.grid(2, 2))
    element_array(F, len(points))
    with pytest.raises(ValueError, match=r"nodes .* between different corners in one triangle than in another"):
        element_array(F[:, order], len(points))
