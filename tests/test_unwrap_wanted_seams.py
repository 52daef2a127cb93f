"""Seams of the user in `unwrap`: edges that must or must not be seams, and labels of parts."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quasiharmonic import unwrap
from quasiharmonic.geometry.mesh.splitting import fans
from quasiharmonic.surfaces import starfish
from shared.closed_surfaces import torus
from shared.examples import examples


def all_edges(F):
    return np.unique(np.sort(np.stack([F, F[:, (1, 2, 0)]], axis=2).reshape(-1, 2), axis=1), axis=0)


def are_among(edges, seams):
    present = set(map(tuple, seams.tolist()))
    return [tuple(edge) in present for edge in np.sort(edges, axis=1).tolist()]


def box(n):
    """A box whose faces have n × n squares."""
    axes = np.meshgrid(*[np.arange(n + 1)] * 3, indexing="ij")
    points = np.stack(axes, axis=3).reshape(-1, 3)
    number = np.arange(len(points)).reshape(n + 1, n + 1, n + 1)
    sides = []
    for k in range(3):
        for end in (0, n):
            face = np.take(number, end, axis=k)
            square = np.stack([face[:-1, :-1], face[1:, :-1], face[1:, 1:], face[:-1, 1:]], axis=2).reshape(-1, 4)
            sides.append(square if (end > 0) == (k != 1) else square[:, ::-1])
    corners = np.concatenate(sides)
    F = np.concatenate([corners[:, (0, 1, 2)], corners[:, (0, 2, 3)]])
    used, F = np.unique(F, return_inverse=True)
    return points[used].astype(float), F.reshape(-1, 3)


def tube(n, rows):
    """An open cylinder."""
    turn = 2 * np.pi * np.arange(n) / n
    points = np.concatenate([np.stack([np.cos(turn), np.sin(turn), np.full(n, k)], axis=1) for k in range(rows + 1)])
    corner = np.arange(n * rows)
    ahead = corner - corner % n + (corner + 1) % n
    return points, np.concatenate(
        [np.stack([corner, ahead, ahead + n], axis=1), np.stack([corner, ahead + n, corner + n], axis=1)]
    )


def mirrored(V, F, axis):
    """The upper half of a symmetric model along an axis, and its mirror image."""
    middle = (V[:, axis].min() + V[:, axis].max()) / 2
    half = F[(V[F][:, :, axis] >= middle - 1e-9).all(axis=1)]
    images = np.where(np.arange(3) == axis, 2 * middle - V, V)
    image = np.linalg.norm(V[None] - images[:, None], axis=2).argmin(axis=1)
    return np.concatenate([half, image[half[:, ::-1]]])


MODELS = {"box": box(4), "tube": tube(12, 4), "torus": torus(24, 10, 1.5), "starfish": starfish(3, 6)}


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("count", [1, 4, 15])
def test_demanded_edges_are_seams(name, count):
    V, F = MODELS[name]
    plain = unwrap(V, F, resolution=256)
    sides, times = np.unique(np.sort(np.stack([F, F[:, (1, 2, 0)]], 2).reshape(-1, 2), 1), axis=0, return_counts=True)
    inside = sides[times == 2]
    free = inside[~np.array(are_among(inside, plain.seams))]
    chosen = free[np.random.default_rng(count).choice(len(free), count, replace=False)]
    result = unwrap(V, F, resolution=256, seams=np.concatenate([chosen[:, ::-1], chosen, sides[times == 1]]))
    assert result.success
    assert all(are_among(chosen, result.seams))


@pytest.mark.long
@given(st.sampled_from(sorted(MODELS)), st.integers(0, 2**31), st.integers(1, 40))
@examples(20)
def test_any_edges_can_be_demanded(name, seed, count):
    V, F = MODELS[name]
    edges = all_edges(F)
    chosen = edges[np.random.default_rng(seed).choice(len(edges), count, replace=False)]
    # `unwrap` raises an error if an edge is not a seam.
    assert unwrap(V, F, resolution=256, seams=chosen).success


def test_a_seam_that_ends_inside_a_flat_face_is_extended_to_its_border():
    V, F = box(4)
    at = {tuple(point): k for k, point in enumerate(V.tolist())}
    edge = [at[2.0, 2.0, 4.0], at[2.0, 3.0, 4.0]]
    result = unwrap(V, F, resolution=256, seams=[edge])
    assert all(are_among(np.array([edge]), result.seams))
    # The seam divides the face. Its parts may belong to one chart that is joined elsewhere.
    face = F[(V[F][:, :, 2] == 4).all(axis=1)]
    sides = np.stack([face, np.roll(face, -1, axis=1)], axis=2)
    seams = {tuple(edge) for edge in np.sort(result.seams, axis=1).tolist()}
    cut = np.array([[tuple(sorted(side)) in seams for side in row] for row in sides.tolist()])
    assert fans(face, cut)[1].max() + 1 == 2


def test_edges_that_must_not_be_seams():
    V, F = MODELS["starfish"]
    before = unwrap(V, F, resolution=256).seams
    after = unwrap(V, F, resolution=256, no_seams=before[::8, ::-1])
    assert after.success
    assert not any(are_among(before[::8], after.seams))


def cone(n, rows):
    """A cone with its base, which unroll together only where they share one edge."""
    points, F = tube(n, rows)
    points[:, :2] *= 1 - points[:, 2:] / (rows + 1)
    rim = np.arange(n)
    ends = rim + (rows * n), (rim + 1) % n + rows * n
    top = np.stack([*ends, np.full(n, len(points))], axis=1)
    base = np.stack([(rim + 1) % n, rim, np.full(n, len(points) + 1)], axis=1)
    return np.concatenate([points, [[0, 0, rows + 1], [0, 0, 0]]]), np.concatenate([F, top, base])


def test_pieces_that_cannot_be_joined_at_all_edges_are_stretched():
    V, F = cone(16, 3)
    kept = np.stack([np.arange(6), np.arange(1, 7)], axis=1)
    assert any(are_among(kept, unwrap(V, F, resolution=256).seams))
    result = unwrap(V, F, resolution=256, no_seams=kept)
    assert result.success
    assert not any(are_among(kept, result.seams))


def test_edges_of_merged_vertices_are_found():
    V, F = box(3)
    apart, own = V[F].reshape(-1, 3), np.arange(F.size).reshape(-1, 3)
    edge = own[20, :2]
    result = unwrap(apart, own, resolution=256, seams=[edge])
    places = {frozenset(map(tuple, ends)) for ends in apart[result.seams].tolist()}
    assert frozenset(map(tuple, apart[edge].tolist())) in places


def test_demanded_edges_with_given_coordinates():
    V, F = MODELS["tube"]
    first = unwrap(V, F, resolution=256)
    uv = first.uvs[first.indices]
    ring = np.stack([24 + np.arange(12), 24 + (np.arange(12) + 1) % 12], axis=1)
    result = unwrap(V, F, resolution=256, uv=uv, seams=ring)
    assert all(are_among(np.concatenate([ring, first.seams]), result.seams))
    with pytest.raises(ValueError, match="of no_seams became seams"):
        unwrap(V, F, resolution=256, uv=uv, no_seams=first.seams[:1])


@pytest.mark.slow
def test_symmetric_models_get_the_mirror_images_of_demanded_edges():
    V, F = box(4)
    F = mirrored(V, F, 0)
    edge = np.flatnonzero((V == [4, 2, 1]).all(axis=1) | (V == [4, 2, 2]).all(axis=1))
    result = unwrap(V, F, resolution=256, symmetry="x", seams=[edge])
    image = np.flatnonzero((V == [0, 2, 1]).all(axis=1) | (V == [0, 2, 2]).all(axis=1))
    assert result.symmetry.applied
    assert all(are_among(np.array([edge, image]), result.seams))
    assert not unwrap(V, F, resolution=256, seams=[edge]).symmetry.applied


def test_empty_lists_change_nothing():
    V, F = MODELS["tube"]
    plain = unwrap(V, F, resolution=256)
    np.testing.assert_array_equal(unwrap(V, F, resolution=256, seams=[], no_seams=np.empty((0, 2))).uvs, plain.uvs)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"seams": [[0, 1, 2]]}, r"seams must have shape \(k, 2\), two vertices each, not \(1, 3\)"),
        ({"no_seams": [1, 2]}, r"no_seams must have shape \(k, 2\)"),
        ({"seams": [[0, 60]]}, r"seams refers to vertex 60, but there are only vertices 0 … 59"),
        ({"seams": [[-1, 0]]}, "seams refers to vertex -1"),
        ({"seams": [[0, 1], [0, 5]]}, r"seams: edge \(0, 5\): not an edge of the mesh"),
        ({"seams": [[3, 3]]}, r"seams: edge \(3, 3\): not an edge of the mesh"),
        ({"seams": [[0.5, 1]]}, "seams must contain integer indices"),
        ({"seams": [[12, 13]], "no_seams": [[13, 12]]}, r"edge \(12, 13\): both in seams and in no_seams"),
        ({"labels": [0, 1]}, r"labels must have shape \(96,\), one for each triangle, not \(2,\)"),
        ({"labels": np.full(96, 0.5)}, "labels must contain integer"),
    ],
)
def test_wrong_lists_are_named(options, words):
    with pytest.raises(ValueError, match=words):
        unwrap(*MODELS["tube"], resolution=256, **options)


def test_edges_that_cannot_be_kept_together_are_named():
    V, F = MODELS["torus"]
    with pytest.raises(ValueError, match=r"edges \(.*in all\) of no_seams became seams"):
        unwrap(V, F, resolution=256, no_seams=all_edges(F))


@pytest.mark.slow
def test_seams_between_labels_cost_nothing():
    V, F = MODELS["torus"]
    labels = (V[F].mean(axis=1)[:, 0] > 0.5).astype(int) + 7
    edges = all_edges(F[labels == 7])
    between = edges[np.array(are_among(edges, all_edges(F[labels == 8])))]
    plain, result = (unwrap(V, F, resolution=256, labels=given) for given in (None, labels))
    share = [np.mean(are_among(between, found.seams)) for found in (plain, result)]
    assert share[0] < 0.4 <= share[1]
    assert result.success


@pytest.mark.slow
def test_pieces_are_joined_across_labels_last():
    """Two long edges of a box are not joined although the seams would be shorter."""
    V, F = box(2)
    V = V * [1, 2, 4]
    side = (V[F].min(axis=1) == V[F].max(axis=1)) @ [1, 2, 4]
    top = (V[F] == V.max(axis=0)).all(axis=1) @ [1, 2, 4]
    labels = np.where((side == 1) & (top == 0), 1, 0)
    edges = all_edges(F[labels == 1])
    border = edges[np.array(are_among(edges, all_edges(F[labels == 0])))]
    plain, result = (unwrap(V, F, resolution=256, labels=given) for given in (None, labels))
    assert sum(are_among(border, result.seams)) > sum(are_among(border, plain.seams))


@pytest.mark.parametrize(("up", "height"), [("z", -1), ("-z", 1)])
def test_a_lying_tube_is_cut_where_it_faces_down(up, height):
    V, F = tube(24, 5)
    V = V[:, (2, 0, 1)]
    result = unwrap(V, F, resolution=128, up=up, symmetry=None)
    assert result.n_charts == 1
    assert (height * V[result.seams][:, :, 2] > 0.5).all()


@pytest.mark.parametrize("turn", [0, 1])
def test_a_star_shaped_tube_is_cut_in_concave_edges(turn):
    V, F = tube(10, 2)
    radius = np.where((np.arange(30) + turn) % 2 == 0, 1.0, 0.6)
    V = V * radius[:, None] ** [1, 1, 0]
    plain, result = (unwrap(V, F, resolution=128, up=up, packing_loss=1, symmetry=None) for up in (None, "z"))
    assert radius[plain.seams].max() == 1
    assert radius[result.seams].max() == 0.6


def test_seams_of_a_model_that_is_mirrored_upwards_do_not_prefer_places_below():
    V, F = tube(24, 5)
    lying = V[:, (2, 0, 1)]
    F = mirrored(lying, F, 2)
    plain, result = (unwrap(lying, F, resolution=128, symmetry="z", up=up) for up in (None, "z"))
    assert result.symmetry.applied
    np.testing.assert_array_equal(result.seams, plain.seams)


def test_a_wrong_direction_is_named():
    with pytest.raises(ValueError, match="up"):
        unwrap(*MODELS["tube"], up="w")
