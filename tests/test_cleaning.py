"""`clean`: the surfaces of any triangles, and the maps between their elements and those of the model."""

from __future__ import annotations

import json
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from quasiharmonic import boundary_loops, clean, inspect_mesh, io
from quasiharmonic.io import MeshData
from quasiharmonic.surfaces import disk, starfish
from quasiharmonic.ui.cli import main
from shared.cleaning import OUTWARD, TETRAHEDRON, check, cube, joined_pairs, merge, mobius, soup, turn
from shared.examples import examples


@pytest.mark.parametrize("mesh", [disk(3), starfish(rings=6), cube(), (TETRAHEDRON, OUTWARD)])
def test_a_clean_mesh_is_returned_unchanged(mesh):
    V, F = mesh
    cleaned = check(V, F)
    assert np.array_equal(cleaned.V, V)
    assert np.array_equal(cleaned.F, F)
    assert cleaned.flipped.sum() + cleaned.excluded.size + len(cleaned.seams) == 0
    assert cleaned.summary() == inspect_mesh(V, F).summary()
    assert not any(found.size for found in cleaned.changes.values())


@pytest.mark.slow
@given(st.integers(3, 12), st.integers(1, 60), st.integers(0, 2**31), st.integers(-20, -6))
@examples(20)
@example(10, 19, 825, -17)  # a widened triangle must not be thin in a second cleaning
def test_triangles_that_are_almost_degenerate_form_surfaces(n, f, seed, exponent):
    rng = np.random.default_rng(seed)
    V = rng.integers(3, size=(n, 3)) + 10.0**exponent * rng.normal(size=(n, 3))
    F = rng.integers(n, size=(f, 3))
    try:
        check(V, F)
        check(1e150 * V, F, weld=False, outward=True)
        check(1e-150 * V[:, :2], F)
    except ValueError as error:
        assert "degenerate" in str(error)  # noqa: PT017


@pytest.mark.slow
@given(st.integers(3, 9), st.integers(1, 40), st.integers(0, 2**31), st.booleans(), st.booleans())
@examples(30)
@example(7, 27, 3023, False, True)  # separated triangles change the larger part of a component
def test_any_triangles_form_surfaces(n, f, seed, weld, on_a_grid):
    rng = np.random.default_rng(seed)
    V = rng.integers(3, size=(n, 3)).astype(float) if on_a_grid else rng.normal(size=(n, 3))
    F = rng.integers(n, size=(f, 3))
    e1, e2 = V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]]
    if on_a_grid and not np.cross(e1, e2).any():
        with pytest.raises(ValueError, match="degenerate"):
            clean(V, F, weld=weld)
    elif (np.diff(np.sort(F, axis=1), axis=1) > 0).all(axis=1).any():
        check(V, F, weld=weld)
        check(V, F, weld=weld, outward=True)


@pytest.mark.slow
@given(st.integers(0, 2**31), st.floats(0, 1))
@examples(15)
def test_mixed_winding_is_mended_to_the_larger_part(seed, share):
    V, F = starfish(rings=6)
    rows = np.flatnonzero(np.random.default_rng(seed).random(len(F)) < share)
    e1, e2 = V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]]
    area = np.linalg.norm(np.cross(e1, e2), axis=1)
    cleaned = check(V, turn(F, rows))
    most = area[rows].sum() > area.sum() / 2
    assert np.array_equal(np.flatnonzero(cleaned.flipped ^ most), rows)
    assert cleaned.facing.tolist() == [-1 if most else 1]
    assert not len(cleaned.seams)


@pytest.mark.parametrize("wide", [1, 3])
@pytest.mark.parametrize("share", [0, 0.1, 0.5])
def test_a_mobius_band_is_cut_across_and_stays_in_one_piece(wide, share):
    V, F = mobius(24, wide)
    assert not inspect_mesh(V, F).closed
    rows = np.flatnonzero(np.random.default_rng(1).random(len(F)) < share)
    cleaned = check(V, turn(F, rows))
    report = inspect_mesh(cleaned.V, cleaned.F)
    assert (report.components, report.loops, report.genus) == (1, 1, 0)
    # The seam runs from boundary to boundary.
    assert wide <= len(cleaned.seams) <= 3 * wide
    if not share:
        assert cleaned.seams.tolist() == [[k, k + 1] for k in range(wide)]
        assert not cleaned.flipped.any()


def test_a_klein_bottle_is_cut():
    n = 12
    i, j = np.divmod(np.arange(n * n), n)
    a, b = 2 * np.pi * i / n, 2 * np.pi * j / n
    r = 3 + np.cos(a / 2) * np.sin(b) - np.sin(a / 2) * np.sin(2 * b)
    V = np.stack([r * np.cos(a), r * np.sin(a), np.sin(a / 2) * np.sin(b) + np.cos(a / 2) * np.sin(2 * b)], axis=1)

    def at(i, j):
        return (i % n) * n + np.where(i // n == 1, -j, j) % n

    F = np.concatenate(
        [
            np.stack([at(i, j), at(i + 1, j), at(i + 1, j + 1)], 1),
            np.stack([at(i, j), at(i + 1, j + 1), at(i, j + 1)], 1),
        ]
    )
    cleaned = check(V, F)
    assert cleaned.facing.tolist() == [0]
    assert n <= len(cleaned.seams) <= 3 * n


def test_of_three_pages_the_flattest_two_stay_joined():
    angles = np.radians([0, 80, 170])
    V = np.array([[0, 0, 0], [0, 0, 1], *([np.cos(a), np.sin(a), 0.5] for a in angles)])
    F = np.array([[0, 1, 2], [0, 1, 3], [1, 0, 4]])
    cleaned = check(V, F)
    assert joined_pairs(cleaned) == {(0, 2)}
    assert cleaned.facing.size == 2
    assert cleaned.seams.tolist() == [[0, 1]]


def test_orientation_goes_before_the_angle():
    angles = np.radians([0, 100, 180])
    V = np.array([[0, 0, 0], [0, 0, 1], *([np.cos(a), np.sin(a), 0.5] for a in angles)])
    assert joined_pairs(check(V, np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]))) == {(0, 1)}


@pytest.mark.parametrize("corner", [(1, 1, 0), (1, 1, 1), (-1, 0, 1)])
def test_cubes_with_a_common_edge_or_vertex_are_separated(corner):
    V, F = merge(cube(), cube(corner))
    cleaned = check(V, F)
    assert len(cleaned.V) == 16
    assert cleaned.facing.tolist() == [1, 1]
    assert np.bincount(cleaned.component).tolist() == [12, 12]
    assert not len(cleaned.seams)
    rotation = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    rotation *= np.linalg.det(rotation)
    assert check(V @ rotation.T, F).facing.tolist() == [1, 1]


def test_cubes_in_the_file_stay_as_they_are_joined_there():
    (V, F), (W, G) = cube(), cube((1, 1, 0))
    V, F = np.concatenate([V, W]), np.concatenate([F, G + 8])
    cleaned = check(V, F)
    assert np.array_equal(cleaned.F, F)
    assert np.array_equal(cleaned.V, V)


def test_a_common_face_of_two_cubes_is_excluded_once():
    V, F = merge(cube(), cube((1, 0, 0)))
    cleaned = check(V, F)
    assert cleaned.excluded.size == 2
    assert cleaned.repeated.all()
    assert cleaned.facing.size <= 2


@pytest.mark.parametrize("weld", [False, True])
@pytest.mark.parametrize("reverse", [False, True])
def test_double_sided_faces_are_excluded_once(weld, reverse):
    V, F = disk(3)
    both = np.concatenate([F, F[:, ::-1] if reverse else F])
    cleaned = check(V, both, weld=weld)
    assert np.array_equal(cleaned.F, F)
    assert cleaned.excluded.tolist() == list(range(len(F), 2 * len(F)))
    assert cleaned.repeated.all()
    assert np.array_equal(cleaned.restore_corners(cleaned.corners), both)
    # Also with vertices of their own, as in a glTF file.
    apart = np.concatenate([F, both[len(F) :] + len(V)])
    cleaned = check(np.concatenate([V, V]), apart, weld=weld)
    assert cleaned.excluded.size == (len(F) if weld else 0)


def test_coincident_vertices_are_merged_unless_told_otherwise():
    V, F = starfish(rings=6)
    cleaned = check(*soup(V, F))
    assert (len(cleaned.V), cleaned.facing.tolist()) == (len(V), [1])
    assert cleaned.changes["vertices merged"].size == 3 * len(F) - len(V)
    assert f"vertices merged {3 * len(F) - len(V):>9,}  " in cleaned.summary()
    assert check(*soup(V, F), weld=False).facing.size == len(F)


def test_isolated_degenerate_triangles_take_the_coordinates_of_the_nearest_vertex():
    V = np.array(
        [[0, 0, 0], [6, 0, 0], [0, 1, 0], [5, 3, 0], [6, 3, 0], [5, 4, 0], [6.1, 0, 0], [6.2, 0, 0], [9, 0, 0]]
    )
    cleaned = clean(V, np.arange(9).reshape(3, 3)[[1, 0, 2]])
    assert cleaned.excluded.tolist() == [2]
    assert cleaned.substitutes.tolist() == [1]


def test_degenerate_triangles_take_the_coordinates_of_a_neighbour():
    V, F = disk(3)
    n = len(V)
    V = np.concatenate([V, (V[F[7, :1]] + V[F[7, 1:2]]) / 2, [[9, 9], [9, 9], [9, 9]]])
    i, j = F[7, :2]
    G = np.concatenate([F[:4], [[i, i, j], [i, n, j], [j, j, j], [n + 1, n + 2, n + 3]], F[4:]])
    cleaned = check(V, G)
    assert cleaned.excluded.tolist() == [4, 5, 6, 7]
    assert not cleaned.repeated.any()
    row = cleaned.substitutes
    assert {i, j} <= set(cleaned.corners[row[0]])
    assert {i, j} <= set(cleaned.corners[row[1]])
    assert j in cleaned.corners[row[2]]
    back = cleaned.restore_corners(cleaned.corners)
    assert back[4].tolist() == [i, i, j]
    assert back[6].tolist() == [j, j, j]


@pytest.mark.parametrize("height", [0, 1e-18, 1e-12])
@pytest.mark.parametrize("dimension", [2, 3])
def test_thin_triangles_that_join_others_are_widened(height, dimension):
    V, F = disk(6)
    V = np.round(V * 1024) / 1024  # midpoints are exact
    if dimension == 3:
        V = np.column_stack([V, np.zeros(len(V))])
    rows = np.flatnonzero(np.random.default_rng(0).random(len(F)) < 0.3)
    a, b, c = F[rows].T
    m = len(V) + np.arange(len(rows))
    away = height * np.arange(1, dimension + 1)
    V = np.concatenate([V, (V[a] + V[b]) / 2 + away])
    split = [np.stack(corners, axis=1) for corners in ((a, m, c), (m, b, c), (a, b, m))]
    G = np.concatenate([np.delete(F, rows, axis=0), *split])
    thin = np.arange(len(G) - len(rows), len(G))
    cleaned = check(V, G)
    # On the boundary, a triangle without area joins nothing.
    rim = {frozenset(edge) for loop in boundary_loops(F) for edge in zip(loop, np.roll(loop, -1), strict=True)}
    outside = thin[[frozenset(edge) in rim for edge in zip(a, b, strict=True)]]
    excluded = np.intersect1d(outside, cleaned.report.defects["triangles without area"])
    assert cleaned.excluded.tolist() == excluded.tolist()
    assert cleaned.triangles[cleaned.widened].tolist() == np.setdiff1d(thin, excluded).tolist()
    report = inspect_mesh(cleaned.V, cleaned.F)
    assert (report.components, report.loops) == (1, 1)


def test_several_vertices_on_a_line_between_two_triangles():
    k = 9
    V = np.array([[0.0, 0, 0], [k + 1, 0, 0], [1, 5, 0], [1, -5, 0], *([i, 0, 0] for i in range(1, k + 1))])
    line = [0, *range(4, 4 + k), 1]
    fan = [[a, b, 2] for a, b in pairwise(line)]
    slivers = [[0, b, a] for a, b in pairwise(line[1:])]
    cleaned = check(V, [*fan, *slivers, [0, 3, 1]])
    assert cleaned.widened.sum() == k
    assert not cleaned.excluded.size
    assert inspect_mesh(cleaned.V, cleaned.F).loops == 1


def test_triangles_without_area_alone_are_excluded():
    V = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], *([i, 7, 0] for i in range(9))])
    F = [[0, 1, 2], *([3, 4 + i, 5 + i] for i in range(7))]
    cleaned = check(V, F)
    assert cleaned.excluded.tolist() == list(range(1, 8))


def test_no_crack_stays_where_a_collapsed_triangle_was():
    V, F = disk(4)
    collapsed = np.stack([F[:, 0], F[:, 1], F[:, 1]], axis=1)
    cleaned = check(V, np.concatenate([F, collapsed]))
    assert np.array_equal(cleaned.F, F)


def test_an_inside_out_component_is_reported_and_can_be_turned():
    V, F = np.concatenate([TETRAHEDRON, TETRAHEDRON + 5, disk(2)[0] @ np.eye(2, 3) - 5]), disk(2)[1]
    F = np.concatenate([OUTWARD[:, ::-1], OUTWARD + 4, F + 8])
    cleaned = check(V, F)
    assert cleaned.facing.tolist() == [-1, 1, 0]
    assert "(1 facing inwards)" in repr(cleaned)
    assert "1 closed component with triangles facing inwards" in cleaned.summary()
    cleaned = check(V, F, outward=True)
    assert cleaned.changes["triangles reversed"].tolist() == [0, 1, 2, 3]
    assert cleaned.facing.tolist() == [1, 1, 0]
    assert np.flatnonzero(cleaned.flipped).tolist() == [0, 1, 2, 3]


@pytest.mark.slow
def test_many_components():
    V, F = cube()
    shift = 2 * np.arange(10_000)
    many = (V + shift[:, None, None] * [1, 0, 0]).reshape(-1, 3)
    cleaned = clean(many, (F + 8 * np.arange(10_000)[:, None, None]).reshape(-1, 3))
    assert cleaned.facing.size == 10_000
    assert (cleaned.facing == 1).all()


def test_many_mobius_bands():
    V, F = mobius(5)
    many = (V + 3 * np.arange(2000)[:, None, None] * [1, 0, 0]).reshape(-1, 3)
    cleaned = clean(many, (F + len(V) * np.arange(2000)[:, None, None]).reshape(-1, 3))
    assert cleaned.facing.size == len(cleaned.seams) == 2000


def test_unused_vertices_are_dropped():
    V, F = disk(2)
    cleaned = check(np.concatenate([[[7, 7]], V, [[8, 8]]]), F + 1)
    assert cleaned.vertices.tolist() == list(range(1, len(V) + 1))
    assert np.array_equal(cleaned.F, F)


def test_a_fan_that_passes_an_edge_twice_is_split():
    """Four triangles at one edge are joined in pairs, and other triangles join the pairs around both ends."""
    V, F = starfish(rings=6)
    # Identify two vertices with a common neighbour: the edges to the neighbour become one of four triangles.
    sides = np.concatenate([F[:, :2], F[:, 1:], F[:, ::2]])
    a = int(F[len(F) // 2, 0])
    ring = np.unique(sides[(sides == a).any(axis=1)])
    ring = ring[ring != a]
    near = {tuple(sorted(side)) for side in sides.tolist()}
    i, j = next((i, j) for i in ring.tolist() for j in ring.tolist() if i < j and (i, j) not in near)
    number = np.arange(len(V))
    number[j] = i
    sides = np.sort(number[np.concatenate([F[:, :2], F[:, 1:], F[:, ::2]])], axis=1)
    edges, times = np.unique(sides, axis=0, return_counts=True)
    assert [min(a, i), max(a, i)] in edges[times == 4].tolist()
    assert len(inspect_mesh(V, number[F]).defects["edges of three or more triangles"]) == (times > 2).sum()
    cleaned = check(V, number[F])
    assert cleaned.facing.size == 1


@pytest.mark.parametrize("scale", [1e-150, 1e-300, 1, 1e150, 1e300])
def test_the_scale_has_no_effect(scale):
    V, F = merge(cube(), cube((1, 1, 0)))
    expected, cleaned = clean(V, F), check(scale * V, F)
    assert np.array_equal(cleaned.F, expected.F)
    assert cleaned.facing.tolist() == expected.facing.tolist()


def test_arrays_of_any_type_are_accepted_and_left_unchanged():
    V, F = cube()
    F = np.concatenate([turn(F, [3]), [[0, 0, 1]]])
    expected = clean(V, F)
    for W, G in (
        (V.astype(np.float32), F.astype(np.int32)),
        (np.asfortranarray(V), np.asfortranarray(F.astype(np.uint8))),
        (V.tolist(), F.tolist()),
    ):
        before = np.array(W), np.array(G)
        cleaned = clean(W, G)
        assert np.array_equal(cleaned.F, expected.F)
        assert cleaned.V.dtype == np.float64
        assert all(np.array_equal(one, other) for one, other in zip(before, (W, G), strict=True))
    assert cleaned.F.dtype == cleaned.vertices.dtype == cleaned.corners.dtype == np.int64
    assert cleaned.flipped.dtype == cleaned.repeated.dtype == np.bool_


def test_one_triangle():
    cleaned = check([[0, 0], [1, 0], [0, 1]], [[2, 1, 0]])
    assert cleaned.F.tolist() == [[2, 1, 0]]
    cleaned = check([[0, 0], [1, 0], [0, 1]], [[2, 1, 0], [1, 0, 2], [0, 1, 2], [0, 0, 1]])
    assert cleaned.excluded.tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    ("V", "F", "message"),
    [
        (np.empty((0, 3)), np.empty((0, 3), dtype=int), "no triangles"),
        (TETRAHEDRON, [], "no triangles"),
        (TETRAHEDRON, [[0, 1, 4]], "vertex 4"),
        (TETRAHEDRON, [[0, 1, -1]], "vertex -1"),
        ([[0, 0], [np.nan, 0], [0, 1]], [[0, 1, 2]], "vertex 1"),
        (TETRAHEDRON, [[0, 1, 1], [2, 2, 2]], "all 2 triangles are degenerate: each uses"),
        (TETRAHEDRON, [[0, 1, 1]], "the only triangle is degenerate: it uses"),
        ([[0, 0], [1, 1], [2, 2]], [[0, 1, 2]], "the only triangle is degenerate"),
        (np.zeros((3, 3)), [[0, 1, 2]], "degenerate"),
    ],
)
def test_bad_input_is_named(V, F, message):
    with pytest.raises(ValueError, match=message):
        clean(V, F)


@pytest.mark.parametrize(("name", "words"), [("outward", "True or False"), ("weld", "True, False, or a distance")])
def test_options_are_checked(name, words):
    with pytest.raises(ValueError, match=f"{name} must be {words}"):
        clean(*cube(), **{name: "no"})


def test_values_of_another_mesh_are_rejected():
    with pytest.raises(ValueError, match="values must have shape"):
        clean(*cube()).restore_corners(np.zeros((5, 3)))


def test_the_command_lists_the_changes(tmp_path, capsys):
    V, F = disk(3)
    V = np.column_stack([V, V[:, 0] ** 2])
    io.write_obj(tmp_path / "a.obj", MeshData(V, np.concatenate([turn(F, [2]), F[5:6], [[0, 0, 1]]])))
    assert main(["check", str(tmp_path / "a.obj"), "--json", str(tmp_path / "a.json")]) == 1
    text = capsys.readouterr().out
    assert "triangles reversed                    1  2\n" in text
    changes = json.loads((tmp_path / "a.json").read_text(encoding="utf-8"))["changes"]
    assert changes["repeated triangles excluded"] == [len(F)]
    assert changes["degenerate triangles excluded"] == [len(F) + 1]
    io.write_obj(tmp_path / "a.obj", MeshData(V, F))
    assert main(["check", str(tmp_path / "a.obj")]) == 0
    assert "change" not in capsys.readouterr().out
    io.write_obj(tmp_path / "a.obj", MeshData(V, F[:, [0, 1, 1]]))
    assert main(["check", str(tmp_path / "a.obj")]) == 1
    assert "are degenerate" in capsys.readouterr().out


@pytest.mark.nightly
def test_a_million_triangles():
    V, F = disk(408)
    rng = np.random.default_rng(0)
    rows = rng.random(len(F)) < 0.5
    cleaned = clean(*soup(V, turn(F, rows)[rng.permutation(len(F))]))
    assert len(cleaned.V) == len(V)
    assert cleaned.facing.tolist() == [0]
