"""Input that `Problem` rejects, with its messages, and input that it accepts."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from quasiharmonic import Problem
from quasiharmonic.geometry.mesh.topology import boundary_loops, components, edges
from quasiharmonic.surfaces import annulus, grid, random_delaunay
from shared.meshes import boundary_of

V, F = random_delaunay(60, seed=2)
RIM = boundary_of(F)
TARGET = V[RIM]


def posed(V=V, F=F, fixed=RIM, target=TARGET, **more):
    return Problem(V, F, fixed, target, **more)


def changed(array, index, value):
    array = np.array(array)
    array[index] = value
    return array


TWO_TRIANGLES = np.array([[0, 1, 2], [3, 4, 5]])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"V": changed(V, (7, 1), np.nan)}, "V is not finite at vertex 7"),
        ({"V": changed(V, ([3, 9], 0), np.inf)}, "V is not finite at vertices 3, 9"),
        ({"V": V[:, :1]}, r"V must have shape \(n, 2\) or \(n, 3\)"),
        ({"V": V[0]}, "V must have shape"),
        ({"V": V.astype(complex)}, "V must contain real numbers"),
        ({"V": V.astype(str)}, "V must contain real numbers"),
        ({"F": np.zeros((0, 3), int)}, "the mesh has no triangles"),
        ({"F": []}, "the mesh has no triangles"),
        ({"V": np.zeros((0, 2)), "F": []}, "the mesh has no triangles"),
        ({"F": F[:, :2]}, r"F must have shape \(f, 3\)"),
        ({"F": F.astype(float)}, "F must contain integer"),
        ({"F": changed(F, (5, 0), len(V))}, rf"F refers to vertex {len(V)}, but there are only vertices 0 … "),
        ({"F": changed(F, (5, 0), -1)}, "F refers to vertex -1"),
        ({"F": F.astype(np.uint64) + np.uint64(2**63)}, "F refers to vertex 9223372036854775"),
        ({"F": [[0, 1, 2], [1, 2]]}, "F is not an array: its rows differ in length"),
        ({"V": np.zeros((0, 2))}, "there are no vertices"),
        ({"F": changed(F, (5, 0), F[5, 1])}, "triangle 5: a vertex is used twice"),
        ({"F": np.vstack([F, F[4]])}, f"triangle {len(F)} repeated"),
        ({"F": np.vstack([F, np.roll(F[4], 1)[::-1]])}, f"triangle {len(F)} repeated"),
        ({"F": np.vstack([F, [F[0, 0], F[0, 1], RIM[0]]])}, r"edge \(\d+, \d+\) in more than two triangles"),
        ({"F": changed(F, 8, F[8][::-1])}, r"mixed winding: edges \(\d+, \d+\)"),
        ({"V": np.vstack([V, [[5, 5]]])}, f"vertex {len(V)}: no triangle uses them"),
        (
            {"V": np.eye(6)[:, :2] + np.arange(12).reshape(6, 2) % 5, "F": TWO_TRIANGLES, "fixed": range(6),
             "target": np.zeros((6, 2))},
            "2 components, the first ones around vertices 0, 3: map each component separately",
        ),
        (
            {"V": np.eye(4)[:, :3], "F": [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], "fixed": [], "target": []},
            "closed: it has no boundary",
        ),
        ({"fixed": RIM[1:], "target": TARGET[1:]}, f"boundary vertex {RIM[0]} not in fixed"),
        ({"fixed": [], "target": np.zeros((0, 2))}, rf"\({len(RIM)} in all\) not in fixed"),
        ({"fixed": np.append(RIM, RIM[2]), "target": np.vstack([TARGET, TARGET[2]])}, f"{RIM[2]} more than once"),
        ({"fixed": changed(RIM, 0, 999)}, "fixed refers to vertex 999"),
        ({"fixed": changed(RIM, 0, -3)}, "fixed refers to vertex -3"),
        ({"fixed": RIM.astype(float)}, "fixed must contain integer"),
        ({"fixed": RIM[None]}, r"fixed must have shape \(k,\)"),
        ({"target": TARGET[:-1]}, rf"target must have shape \({len(RIM)}, 2\)"),
        ({"target": changed(TARGET, (3, 0), np.nan)}, "target is not finite at row 3"),
        ({"V": changed(V, F[3, 0], V[F[3, 1]])}, "zero area in the rest mesh; choose the reference 'equilateral'"),
        ({"V": changed(V, F[3, 0], V[F[3, 1]]), "reference": "rest"}, "zero area"),
        ({"reference": "square"}, "reference must be one of equilateral, rest, corrected"),
    ],
)  # fmt: skip
def test_malformed_input_is_named(arguments, words):
    with pytest.raises(ValueError, match=words):
        posed(**arguments)


def test_touching_fans_are_rejected():
    """A bow-tie: two triangles that share only a vertex."""
    with pytest.raises(ValueError, match="boundary passes more than once through vertex 2"):
        Problem(np.arange(10.0).reshape(5, 2) ** 2, [[0, 1, 2], [2, 3, 4]], range(5), np.zeros((5, 2)))


def test_flat_triangles_are_accepted_with_an_option():
    flat = changed(V, F[3, 0], V[F[3, 1]])
    for reference in ("equilateral", "corrected"):
        assert posed(V=flat, reference=reference).reference == reference


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.longdouble, np.int32, np.uint8])
@pytest.mark.parametrize("index", [np.int8, np.uint16, np.int32, np.uint64])
def test_any_dtype_and_layout_is_accepted_and_nothing_is_modified(dtype, index):
    V, F = grid(3, 3)
    V = np.asfortranarray((9 * V).astype(dtype))
    F, rim = F.astype(index), boundary_of(F).astype(index)
    target = np.repeat(V[rim], 2, axis=0)[::2]
    copies = [a.copy() for a in (V, F, rim, target)]
    for array in (V, F, rim, target):
        array.flags.writeable = False
    problem = Problem(V, F, rim, target)
    for name, kind in (("V", np.float64), ("F", np.int64), ("fixed", np.int64), ("target", np.float64)):
        assert getattr(problem, name).dtype == kind
    for before, after in zip(copies, (V, F, rim, target), strict=True):
        np.testing.assert_array_equal(before, after)
    np.testing.assert_array_equal(problem.F, F)


def test_another_target_shares_the_factorisation_and_is_checked():
    problem = posed()
    moved = problem.with_target(2 * TARGET)
    assert moved.domain.laplacian() is problem.domain.laplacian()
    assert moved.domain.mesh("rest") is problem.domain.mesh("rest")
    np.testing.assert_array_equal(moved.target, 2 * TARGET)
    np.testing.assert_array_equal(problem.target, TARGET)
    with pytest.raises(ValueError, match="target is not finite"):
        problem.with_target(np.full_like(TARGET, np.nan))


@pytest.mark.parametrize("scale", [5e-324, 1e-300, 1e-150, 1.0, 1e150, 1e300, 1.7e308])
def test_the_frame_has_unit_size_and_is_invertible(scale, rng):
    target = rng.uniform(-1, 1, TARGET.shape) * scale
    frame = posed(target=target).frame
    w = frame.inward(target)
    assert np.all(np.isfinite(w.view(float)))
    assert 0.2 < np.abs(w).max() <= 2 or scale < 1e-320
    np.testing.assert_allclose(frame.outward(w), target, rtol=1e-15, atol=scale * 1e-15)


def test_pins_and_loops():
    V, F = annulus(6)
    rim = boundary_of(F)
    inner = np.setdiff1d(np.arange(len(V)), rim)
    problem = Problem(V, F, np.append(rim, inner[3]), np.vstack([V[rim], V[inner[3]]]))
    np.testing.assert_array_equal(problem.domain.pins, inner[3:4])
    assert sorted(map(len, problem.domain.loops)) == [12, 28]


class TestTopology:
    def test_kinds_of_edges(self):
        found = edges(np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4], [2, 1, 5], [5, 6, 4]]), 7)
        assert found.nonmanifold.tolist() == [[0, 1]]
        assert found.interior.tolist() == [[1, 2]]
        assert found.inconsistent.tolist() == []
        assert [0, 3] in found.boundary.tolist()
        assert [2, 0] in found.boundary.tolist()
        assert edges(np.array([[0, 1, 2], [0, 1, 3]]), 4).inconsistent.tolist() == [[0, 1]]

    @pytest.mark.slow
    @pytest.mark.parametrize("loaded", [True, False])
    def test_edges_of_many_triangles_agree_with_a_dictionary(self, loaded, monkeypatch, rng):
        """For both sorting methods, also if the triangles are not a surface."""
        import scipy.sparse

        if loaded:
            monkeypatch.setitem(sys.modules, "scipy.sparse", scipy.sparse)
        else:
            monkeypatch.delitem(sys.modules, "scipy.sparse")
        _, F = grid(50, 40)
        F = np.concatenate([F, rng.integers(0, 2091, (40, 3)), F[:20, ::-1], F[50:60]])
        found, met = edges(F, 2091), {}
        for triangle in F.tolist():
            for i, j in zip(triangle, triangle[1:] + triangle[:1], strict=True):
                met.setdefault((min(i, j), max(i, j)), []).append((i, j))
        kinds = {"interior": [], "boundary": [], "inconsistent": [], "nonmanifold": []}
        for edge, ways in sorted(met.items()):
            if len(ways) == 1:
                kinds["boundary"].append(ways[0])
            elif len(ways) > 2:
                kinds["nonmanifold"].append(edge)
            else:
                # A triangle with a repeated vertex has an edge from it to itself, without a direction.
                kinds["inconsistent" if ways[0] == ways[1] else "interior"].append(edge)
        for kind, expected in kinds.items():
            assert getattr(found, kind).tolist() == [list(edge) for edge in expected], kind

    def test_loops_have_the_surface_on_their_left(self):
        V, F = annulus(6)
        areas = []
        for loop in boundary_loops(F, len(V)):
            x, y = V[loop].T
            areas.append((x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2)
        assert sorted(areas) == pytest.approx([-1, 4])

    def test_agrees_with_brute_force(self, rng):
        V, F = random_delaunay(200, seed=5)
        half = [(int(a), int(b)) for t in F for a, b in zip(t, np.roll(t, -1), strict=True)]
        single = {(a, b) for a, b in half if (b, a) not in set(half)}
        found = edges(F[rng.permutation(len(F))], len(V))
        assert {tuple(e) for e in found.boundary.tolist()} == single
        assert len(found.interior) * 2 + len(single) == len(half)

    def test_components(self):
        labels = components(TWO_TRIANGLES, 7)
        assert len(set(labels[:3])) == len(set(labels[3:6])) == 1
        assert len(set(labels)) == 3
