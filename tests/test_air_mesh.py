"""Elastic shapes among moving obstacles: every step is certified bijective, and shapes move as elasticity predicts."""

from __future__ import annotations

import sys

import numpy as np
import pytest

pytest.importorskip("shapely", minversion="2.1")

from quasiharmonic import AirMesh, surfaces
from quasiharmonic.apps.air_mesh import thicken, triangulate_between
from quasiharmonic.energies.measures import mean_ratio


def square(side, x=0.0, y=0.0, count=8):
    """A square around (x, y) with ``count`` points a side, counterclockwise."""
    t = np.linspace(-1, 1, count, endpoint=False)
    one = np.ones(count)
    return np.concatenate([np.stack(p, axis=1) for p in ((t, -one), (one, t), (-t, one), (-one, -t))]) * (
        side / 2
    ) + np.array((x, y))


def areas(points, F):
    a, b, c = points[F].transpose(1, 0, 2)
    return 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])


def test_triangles_fill_the_space_between_shapes_and_obstacles():
    V, F = surfaces.annulus(5)
    frame = [square(6), square(0.4), square(0.5, 2.2, 2.2)]
    air = AirMesh(V, F, frame)
    moment = air.moment
    assert moment.certificate.bijective
    assert np.array_equal(moment.points[: len(V)], V)
    assert areas(moment.points, moment.air).min() > 0
    total = areas(moment.points, moment.F).sum() + areas(moment.points, moment.air).sum()
    assert total == pytest.approx(36 - 0.16 - 0.25)


def test_holes_within_holes():
    V, F = surfaces.annulus(4)
    small, large = V * 0.2, V * 1.0
    points = np.concatenate([large, small, square(6), square(0.1)])
    from quasiharmonic import boundary_loops

    both = np.concatenate([F, F + len(V)])
    loops = boundary_loops(both, 2 * len(V))
    air = triangulate_between(points, loops, [len(square(6)), len(square(0.1))])
    solid = areas(points, both).sum()
    assert areas(points, air).sum() == pytest.approx(36 - 0.01 - solid)


@pytest.mark.slow
def test_a_free_shape_is_pushed_as_a_rigid_body():
    V, F = surfaces.disk(4)
    V = V * 0.5
    air = AirMesh(V, F, [square(6), square(1, -1.2)])
    for x in np.linspace(-1.2, 0.2, 5):
        moment = air.advance([square(6), square(1, x)])
        assert moment.certificate.bijective
    shape = moment.points[: len(V)]
    # The shape is pushed right by at least the overlap, and hardly deformed.
    assert shape[:, 0].min() > 0.7 - 1e-9
    turned = np.linalg.svd((shape - shape.mean(axis=0)).T @ V)
    rotation = turned[0] @ turned[2]
    assert np.abs((shape - shape.mean(axis=0)) @ rotation - (V - V.mean(axis=0))).max() < 0.03
    assert moment.energy < 1e-3


@pytest.mark.slow
def test_shapes_push_each_other():
    V, F = surfaces.disk(3)
    V = V * 0.4
    points = np.concatenate([V, V + np.array((1.0, 0.0))])
    air = AirMesh(points, np.concatenate([F, F + len(V)]), [square(6), square(0.8, -1.2)])
    for x in np.linspace(-1.2, 0.3, 6):
        moment = air.advance([square(6), square(0.8, x)])
        assert moment.certificate.bijective
    left, right = moment.points[: len(V)], moment.points[len(V) : 2 * len(V)]
    assert left[:, 0].min() > 0.7 - 1e-9
    assert right[:, 0].mean() > left[:, 0].mean() + 0.6


@pytest.mark.long
def test_results_are_deterministic_and_inputs_do_not_change():
    V, F = surfaces.disk(2)
    kept = V.copy()
    results = []
    for _ in range(2):
        air = AirMesh(V, F, [square(4), square(0.5, -1.5)])
        results.append(air.advance([square(4), square(0.5, -0.9)]).points)
    assert np.array_equal(*results)
    assert np.array_equal(V, kept)


@pytest.mark.slow
def test_missing_space_is_reported_and_the_current_state_kept():
    V, F = surfaces.disk(2)
    air = AirMesh(V, F, [square(4)])
    before = air.moment
    with pytest.raises(RuntimeError, match=r"can be moved only .* of the way"):
        air.advance([square(4) * (1, -1)], max_iterations=30)
    assert air.moment is before


def test_a_large_step():
    V, F = surfaces.disk(3)
    V = V * 0.5
    air = AirMesh(V, F, [square(6), square(1, -2)])
    moment = air.advance([square(6), square(1, 0.5)])
    assert moment.certificate.bijective
    assert moment.points[: len(V), 0].min() > -3
    assert np.array_equal(moment.points[-len(square(1)) :], square(1, 0.5))


def test_thin_triangles_are_raised_to_the_gap():
    corners = np.random.default_rng(3).normal(size=(50, 3, 2))
    area = areas(corners.reshape(-1, 2), np.arange(150).reshape(-1, 3))
    corners[area < 0] = corners[area < 0, ::-1]
    flat = np.arange(150).reshape(-1, 3)
    same = thicken(corners, 1e-9)
    assert mean_ratio(same.reshape(-1, 2), flat) == pytest.approx(mean_ratio(corners.reshape(-1, 2), flat))
    assert areas(same.reshape(-1, 2), flat) == pytest.approx(np.abs(area))
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    raised = thicken(corners, 0.5)
    assert areas(raised.reshape(-1, 2), flat) == pytest.approx(np.maximum(np.abs(area), 0.25 * longest))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda V, F, frame: (V[:, :1], F, frame), r"shape \(n, 2\)"),
        (lambda V, F, frame: (V, F[:0], frame), "the mesh has no triangles"),
        (lambda V, F, frame: (np.concatenate([V, [[0, 0]]]), F, frame), "no triangle uses vertex 19"),
        (lambda V, F, frame: (V, F[:, ::-1], frame), "not counterclockwise"),
        (lambda V, F, frame: (V, F + 0.5, frame), "F must contain integer indices"),
        (lambda V, F, frame: (V, F - 1, frame), "F refers to vertex -1, but there are only vertices 0 …"),
        (lambda V, F, frame: (V, F, [*frame, square(1, 2)[:2]]), r"at least 3 points, not \[\d+, 2\]"),
        (lambda V, F, frame: (V, F, [square(1)]), "and the container meet at|not inside"),
        (lambda V, F, frame: (V, F, [square(4), square(1, 1)]), "and obstacle 0 meet at"),
        (lambda V, F, frame: (V, F, [square(4), square(1, 9)]), "not inside"),
        (
            lambda V, F, frame: (V, F, [square(4)[[0, 9, *range(1, 9)]]]),
            r"the container meets itself at \(-?\d.*, -?\d",
        ),
        (
            lambda V, F, frame: (V, F, [square(9), square(2, 3), square(1, 3)]),
            r"the loop with a corner at \(.*\) is inside the loop with a corner at \(.*\): move it out",
        ),
        (lambda V, F, frame: (V, F, [square(4) * np.nan]), "loop 0 of the frame is not finite at points 0, 1, "),
        (lambda V, F, frame: (V, F, []), "frame has no loops: the first must be the container"),
        (lambda V, F, frame: (V, F, frame[0]), r"not a single loop: pass \[frame\]"),
        (
            lambda V, F, frame: (V, F, [*frame, np.ones((4, 3))]),
            r"loop 1 of the frame .* \(k, 2\), not \(4, 3\)",
        ),
    ],
)
def test_invalid_input(change, message):
    V, F = surfaces.disk(2)
    with pytest.raises(ValueError, match=message):
        AirMesh(*change(V, F, [square(4)]))


@pytest.mark.parametrize(
    ("offset", "obstacle", "names"),
    [
        ((1, 1), (3, 3), "vertex 0 and the shape's boundary through vertex 4 meet at \\(1, 1\\)"),
        ((1, 0.5), (3, 3), "vertex 0 and the shape's boundary through vertex 4 meet at \\(1, 0.5\\)"),
        ((2, 0), (1, 1), "vertex 0 and obstacle 0 meet at \\(1, 1\\)"),
        ((4, 0), (3, 3), "vertex 4 and the container meet at \\(5, "),
        ((2, 0), (4, 4), "the container and obstacle 0 meet at \\(5, "),
    ],
)
def test_shapes_that_touch_at_a_vertex_are_named(offset, obstacle, names):
    box = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    F = np.array([[0, 1, 2], [0, 2, 3]])
    container = 10 * box - 5
    with pytest.raises(ValueError, match=names):
        AirMesh(np.concatenate([box, box + offset]), np.concatenate([F, F + 4]), [container, box + obstacle])


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.nightly) for k in range(1, 6))])
def test_impossible_frames_are_reported_in_one_way(seed):
    rng = np.random.default_rng(seed)
    box = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    air = AirMesh(box, [[0, 1, 2], [0, 2, 3]], [10 * box - 5, box + 2])
    before = air.moment
    wild = [10 * box - 5, box[::-1] + 2, 11 * box - 5.5, (box - 0.5) * (-1, 1) + rng.normal(size=2), box * 0 + 3]
    with pytest.raises(RuntimeError, match=r"can be moved only .* of the way"):
        air.advance([10 * box - 5 + 9 * (seed == 0), wild[seed] if seed < 5 else rng.normal(size=(4, 2))])
    assert air.moment is before


@pytest.mark.parametrize("options", [{"gap": 0}, {"gap": np.nan}, {"air_weight": 0}, {"air_weight": 2}])
def test_invalid_options(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        AirMesh(*surfaces.disk(2), [square(4)], **options)


def test_frames_of_another_size():
    air = AirMesh(*surfaces.disk(2), [square(4)])
    with pytest.raises(ValueError, match=r"loops of \[\d+\] points, as in the initial frame, not of \[\d+\]$"):
        air.advance([square(4, count=9)])
    with pytest.raises(ValueError, match="frame has no loops"):
        air.advance([])


def test_without_shapely(monkeypatch):
    monkeypatch.setitem(sys.modules, "shapely", None)
    with pytest.raises(ImportError, match=r"\[shapes\]"):
        AirMesh(*surfaces.disk(2), [square(4)])
