"""Parts of the unwrap of hard-surface models: hinges, pieces, paper models, directions of shapes, estimates of use."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

import hard_models as models
from quasiharmonic.apps.atlas.packing.bitmap_search import Textures
from quasiharmonic.apps.atlas.packing.layout import estimate_use, find_layout
from quasiharmonic.apps.atlas.packing.shapes import make_shape
from quasiharmonic.apps.unwrapping.developed_charts import PaperModel
from quasiharmonic.apps.unwrapping.hinges import DEMANDED_COST, FLAT, find_hinges
from quasiharmonic.apps.unwrapping.pieces import find_pieces
from shared.examples import examples
from shared.hinges import edges_of, groups, unit_normals

MODELS = {
    "channel": models.channel(),
    "plate": models.plate(),
    "tube with caps": models.tube(16, rings=2, caps=True),
    "cone": models.cone(16),
    "robot": models.robot(),
    "terrain": models.terrain(4, np.random.default_rng(1)),
}


def side_lengths(P):
    """Lengths (f, 3) of the sides of triangles with corners (f, 3, 3), or (f, 3) complex."""
    step = P - np.roll(P, -1, axis=1)
    return np.abs(step) if np.iscomplexobj(P) else np.linalg.norm(step, axis=2)


def doubled_areas(place):
    """Twice the signed areas (f,) of triangles in the plane."""
    return ((place[:, 1] - place[:, 0]).conj() * (place[:, 2] - place[:, 0])).imag


def count_covers(place, points):
    """How many triangles of the plane contain each point."""
    a, b, c = place.T[:, :, None]
    inside = [((q - p).conj() * (points[None] - p)).imag > 0 for p, q in ((a, b), (b, c), (c, a))]
    return np.all(inside, axis=0).sum(axis=0)


def is_overlapping(place, seed=0, tolerance=1e-3):
    """Whether triangles of the plane overlap at one of many random points of theirs, not too close to their sides."""
    random = np.random.default_rng(seed)
    weights = random.dirichlet([2, 2, 2], size=(4, len(place)))
    weights = tolerance + (1 - 3 * tolerance) * weights
    return bool((count_covers(place, (weights * place).sum(axis=2).ravel()) > 1).any())


@pytest.mark.parametrize("name", MODELS)
def test_hinges_have_the_angles_and_lengths_of_the_edges(name):
    V, F = MODELS[name]
    hinges, edges = find_hinges(V, F), edges_of(V, F, F)
    ends = np.sort(np.stack([F.ravel()[hinges.one], np.roll(F, -1, axis=1).ravel()[hinges.one]], axis=1), axis=1)
    place = {tuple(pair): k for k, pair in enumerate(edges.ends.tolist())}
    # Edges of more than two triangles are no hinges of a cleaned mesh.
    known = np.array([place.get(tuple(pair), -1) for pair in ends.tolist()])
    some = known >= 0
    np.testing.assert_allclose(np.degrees(np.abs(hinges.angle[some])), edges.degrees[known[some]], atol=1e-6)
    np.testing.assert_allclose(hinges.length[some], edges.length[known[some]], rtol=1e-8)
    np.testing.assert_array_equal(hinges.flat[some], edges.degrees[known[some]] < 1e-3)
    # At a concave edge, the far corner of one triangle lies above the plane of the other.
    apex = np.roll(F, 1, axis=1).ravel()[hinges.other]
    above = ((V[apex] - V[F.ravel()[hinges.one]]) * unit_normals(V, F)[hinges.first]).sum(axis=1)
    clear = np.abs(hinges.angle) > 0.01
    np.testing.assert_array_equal(hinges.angle[clear] < 0, above[clear] > 0)


@pytest.mark.parametrize("height", [0, 0.9, 1.1, 10])
def test_the_tolerance_of_flat_hinges(height):
    """A square of diagonal √2, one corner of which is moved."""
    V = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, height * FLAT * np.sqrt(2)]])
    assert find_hinges(V, np.array([[0, 1, 2], [0, 2, 3]])).flat.tolist() == [height < 1]


@pytest.mark.parametrize("name", MODELS)
def test_pieces_are_isometric_and_do_not_overlap(name):
    V, F = MODELS[name]
    pieces = find_pieces(V, F, find_hinges(V, F), np.ones(F.shape))
    assert (pieces.label >= 0).all()
    assert np.unique(pieces.label).tolist() == list(range(pieces.count))
    np.testing.assert_allclose(side_lengths(pieces.place), side_lengths(V[F]), rtol=1e-3)
    assert (doubled_areas(pieces.place) > 0).all()
    assert not any(is_overlapping(pieces.place[pieces.label == k]) for k in range(pieces.count))


@pytest.mark.parametrize("name", ["channel", "plate", "robot"])
def test_pieces_of_models_with_sharp_edges_are_their_faces(name):
    """Parts of the plate and of the robot are round, and have one piece."""
    V, F = MODELS[name]
    pieces = find_pieces(V, F, find_hinges(V, F), np.ones(F.shape))
    edges = edges_of(V, F, F)
    smooth = edges.degrees <= 30.01
    expected = groups(len(F), edges.left[smooth], edges.right[smooth])
    pairs = np.unique(np.stack([expected, pieces.label], axis=1), axis=0)
    assert len(pairs) == pieces.count == expected.max() + 1


def test_demanded_sides_separate_pieces():
    V, F = models.sheet(
        np.pad(np.stack(np.meshgrid(np.arange(3.0), np.arange(2.0), indexing="ij"), -1), [(0, 0)] * 2 + [(0, 1)])
    )
    cost = np.ones(F.shape)
    assert find_pieces(V, F, find_hinges(V, F), cost).count == 1
    cost[[set(side) == {2, 3} for side in zip(F[:, 0], F[:, 1], strict=True)], 0] = DEMANDED_COST
    cost[[set(side) == {2, 3} for side in zip(F[:, 1], F[:, 2], strict=True)], 1] = DEMANDED_COST
    assert find_pieces(V, F, find_hinges(V, F), cost).count == 2


def test_spheres_have_no_pieces():
    V, F = models.golf_ball(np.random.default_rng(0), depth=0)
    assert find_pieces(V, F, find_hinges(V, F), np.ones(F.shape)).count == 0


@pytest.mark.parametrize("name", ["channel", "plate", "tube with caps", "cone", "robot"])
@pytest.mark.parametrize("loss", [0.02, 10])
def test_paper_models_keep_lengths_areas_and_do_not_overlap(name, loss):
    V, F = MODELS[name]
    hinges = find_hinges(V, F)
    pieces = find_pieces(V, F, hinges, np.ones(F.shape))
    before = pieces.count
    area = np.abs(doubled_areas(pieces.place)).sum() / 2
    model = PaperModel(F, hinges, pieces, area, np.ones(hinges.one.size, dtype=bool))
    model.join(hinges.length, np.zeros(hinges.one.size, dtype=bool), 10.0, loss, lambda: None)
    joined = np.unique(pieces.label)
    if loss > 1:
        assert len(joined) < before
    np.testing.assert_allclose(side_lengths(pieces.place), side_lengths(V[F]), rtol=1e-3)
    assert np.abs(doubled_areas(pieces.place)).sum() / 2 == pytest.approx(area)
    assert not any(is_overlapping(pieces.place[pieces.label == k]) for k in joined)
    # Glued hinges lie at one place, and join triangles of one chart.
    z, ahead = pieces.place.ravel(), np.roll(pieces.place, -1, axis=1).ravel()
    one, other = hinges.one[pieces.glued], hinges.other[pieces.glued]
    np.testing.assert_array_equal(pieces.label[one // 3], pieces.label[other // 3])
    assert (np.abs(z[one] - ahead[other]) <= 2e-3 * hinges.length[pieces.glued]).all()
    for k in joined:
        rows = np.flatnonzero(pieces.label == k)
        number = np.full(len(F), -1)
        number[rows] = np.arange(len(rows))
        inside = number[one // 3] >= 0
        assert groups(len(rows), number[one // 3][inside], number[other // 3][inside]).max(initial=0) == 0


def test_a_cube_is_unfolded_to_one_net():
    V, F = models.box()
    hinges = find_hinges(V, F)
    pieces = find_pieces(V, F, hinges, np.ones(F.shape))
    model = PaperModel(F, hinges, pieces, 6.0, np.ones(hinges.one.size, dtype=bool))
    model.join(hinges.length, np.zeros(hinges.one.size, dtype=bool), 10.0, 10.0, lambda: None)
    assert len(np.unique(pieces.label)) == 1
    # Six unit squares, joined at five of twelve edges.
    assert np.count_nonzero(pieces.glued) == 6 + 5
    corners = pieces.place * np.exp(-1j * np.angle(pieces.place[0, 1] - pieces.place[0, 0]))
    quarter = np.angle(corners[0, 1] - corners[0, 0])
    assert quarter == pytest.approx(0)


def rotated(uv, angle):
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return np.asarray(uv, dtype=float) @ turn


def distance_to_right_angles(angle):
    return abs((angle + np.pi / 4) % (np.pi / 2) - np.pi / 4)


@given(st.floats(0, 6.3), st.floats(0.2, 3), st.floats(0.1, 0.6))
@examples(30)
@example(0.5, 0.2, 0.328125)  # a corner on a diagonal
def test_shapes_with_right_angles_are_straight(angle, width, notch):
    outline = [[0, 0], [width, 0], [width, 1], [notch * width, 1], [notch * width, notch], [0, notch]]
    shape = make_shape(rotated(outline, angle), models.triangulate(outline))
    assert shape.straight
    assert distance_to_right_angles(np.angle(shape.direction) - angle) <= 1e-6
    assert abs(np.angle(shape.direction)) <= np.pi / 4 + 1e-6
    assert sorted(shape.extent(shape.direction)) == pytest.approx(sorted([width, 1]))


@pytest.mark.parametrize("n", [5, 7, 9, 11, 31])
def test_regular_polygons_with_an_odd_number_of_sides_are_not_straight(n):
    outline = models.polygon(n)
    shape = make_shape(outline, models.triangulate(outline))
    assert not shape.straight
    angles = np.linspace(0, np.pi / 2, 2000)
    smallest = min(np.prod(shape.extent(np.exp(1j * angle))) for angle in angles)
    assert np.prod(shape.extent(shape.direction)) <= smallest * (1 + 1e-9)


@pytest.mark.parametrize("angle", [0, 0.3, 1])
def test_most_of_the_outline_decides_about_the_direction(angle):
    """A house: five of its seven units of outline have right angles, and its smallest box has the same direction."""
    outline = [[0, 0], [2, 0], [2, 1.5], [1, 2], [0, 1.5]]
    shape = make_shape(rotated(outline, angle), models.triangulate(outline))
    assert shape.straight
    assert distance_to_right_angles(np.angle(shape.direction) - angle) <= 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("sides", [[(1, 1)] * 4, [(3, 1), (2, 1), (1, 1), (1, 2)], [(2, 0.3)] * 9 + [(1, 1)] * 3])
def test_estimates_of_the_use_are_close_to_layouts(sides):
    shapes = [
        make_shape(np.array([[0, 0], [a, 0], [a, b], [0, b]], dtype=float), np.array([[0, 1, 2], [0, 2, 3]]))
        for a, b in sides
    ]
    estimate = estimate_use(shapes, Textures((1024, 1024), 4, 1, rotate=True))
    layout = find_layout(shapes, Textures((1024, 1024), 4, 1, rotate=True), None)
    used = sum(a * b for a, b in sides) * (layout.scale / 1024) ** 2
    assert used - 0.15 <= estimate <= min(used + 0.02, 1)


def test_the_use_of_shapes_that_do_not_fit_is_zero():
    shapes = [make_shape(np.array([[0, 0], [1, 0], [0, 1.0]]), np.array([[0, 1, 2]]))] * 200
    assert estimate_use(shapes, Textures((64, 64), 8, 1, rotate=True)) == 0
