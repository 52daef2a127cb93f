"""Outlines, and the target positions of boundary vertices on them."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from quasiharmonic import targets
from quasiharmonic.targets.boundary.correspondence import arc_parameters
from shared.contours import steps

# --- outlines


@pytest.mark.parametrize(
    ("contour", "area", "points"),
    [
        (targets.disk(2.0, 100), 50 * 4 * np.sin(2 * np.pi / 100), 100),
        (targets.ellipse(3, 0.5, 64), 32 * 1.5 * np.sin(2 * np.pi / 64), 64),
        (targets.rectangle(2, 1), 2, 4),
        (targets.regular_polygon(4), 2, 4),
        (targets.regular_polygon(6, radius=2), 6 * np.sqrt(3), 6),
        (targets.star(5, 0.4), 5 * 0.4 * np.sin(np.pi / 5), 10),
    ],
)
def test_shapes_are_counterclockwise_and_have_the_given_area(contour, area, points):
    assert contour.shape == (points, 2)
    assert contour.dtype == np.float64
    assert targets.signed_area(contour) == pytest.approx(area)
    assert targets.signed_area(contour[::-1]) == pytest.approx(-area)
    assert steps(contour).min() > 0


def test_first_points():
    assert targets.ellipse(3, 0.5)[0] == pytest.approx((3, 0))
    assert targets.rectangle(2, 1)[[0, 2]].tolist() == [[0, 0], [2, 1]]
    assert targets.regular_polygon(3)[0] == pytest.approx((0, 1))
    assert targets.star(5)[0] == pytest.approx((0, 1))
    assert np.linalg.norm(targets.star(7, 0.3)[1::2], axis=1) == pytest.approx(np.full(7, 0.3))


def test_area_far_from_the_origin():
    assert targets.signed_area(targets.rectangle(2, 1) + 1e8) == pytest.approx(2)


@pytest.mark.parametrize("count", [7, 9, 12])
def test_corners_take_the_vertices_that_are_closest_in_total(count, rng):
    corners = targets.star(3, 0.1)
    for _ in range(20):
        turn = np.sort(rng.random(count)) * 2 * np.pi
        loop = np.stack([np.cos(turn), np.sin(turn)], axis=1)
        placed = targets.arc_length(loop, corners, start=0)
        where = [int(np.flatnonzero((placed == corner).all(axis=1))[0]) for corner in corners]
        along, wanted = arc_parameters(loop), arc_parameters(corners)
        every = np.array(list(itertools.combinations(range(1, count), 5)))
        costs = ((along[every] - wanted[1:]) ** 2).sum(axis=1)
        assert costs.min() == pytest.approx(((along[where] - wanted) ** 2).sum())
