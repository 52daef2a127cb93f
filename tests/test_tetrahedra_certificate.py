"""The exact certificate of tetrahedral meshes, against an independent oracle in rational numbers."""

import json
from itertools import combinations

import meshlane
import numpy as np
import pytest

from quasiharmonic import certify_tetrahedra
from quasiharmonic.apps.tetrahedra.contacts import find_contacts
from quasiharmonic.apps.tetrahedra.elements import ExactSigns, tetrahedron_signs
from quasiharmonic.io.fem.files import read_volume
from quasiharmonic.ui.cli import main
from shared.exact_space import contact, cross, determinant, dot, exact, minus, overlap
from shared.tetrahedral_meshes import ball, box, double_cover, random_tiny


def is_injective(T, X):
    """Oracle: positive tetrahedra with disjoint interiors whose faces meet only in common vertices and edges."""
    p = exact(X)
    if any(determinant([p[v] for v in t]) <= 0 for t in T):
        return False
    if any(overlap([p[v] for v in s], [p[v] for v in t]) for s, t in combinations(T.tolist(), 2)):
        return False
    faces = sorted({tuple(sorted(face)) for t in T.tolist() for face in combinations(t, 3)})
    return not any(meet_elsewhere(f, g, p) for f, g in combinations(faces, 2))


def meet_elsewhere(f, g, p):
    """Oracle: whether two triangles meet outside their common vertices and edge."""
    common = [p[v] for v in set(f) & set(g)]
    for point in contact([p[v] for v in f], [p[v] for v in g]):
        if len(common) < 2 and point not in common:
            return True
        if len(common) == 2 and (
            any(cross(minus(common[1], common[0]), minus(point, common[0])))
            or dot(minus(point, common[0]), minus(point, common[1])) > 0
        ):
            return True
    return False


def check_tiny_meshes(seeds):
    """Compare the certificate with the oracle; return the number of injective meshes."""
    good = 0
    for seed in seeds:
        X, T = random_tiny(np.random.default_rng(seed))
        found, expected = certify_tetrahedra(T, X), is_injective(T, X)
        assert found.injective == expected, (seed, found.summary())
        good += expected
    return good


@pytest.mark.slow
def test_signs_agree_with_rational_numbers():
    rng = np.random.default_rng(1)
    for trial in range(300):
        p = rng.integers(-2, 3, (4, 3)).astype(float)
        if trial % 6 == 1:
            p = 0.1 * p + rng.integers(-3, 4, (4, 3)) * 2.0**-56
        elif trial % 6 == 2:
            p *= 1e150
        elif trial % 6 == 3:
            p = (p + 0.1) * 10.0 ** rng.integers(-150, 150, (4, 3))
        elif trial % 6 == 4:
            p *= 1e-150 * (1 + 2.0**-52 * rng.integers(-2, 3, (4, 3)))
        elif trial % 6 == 5:
            p += rng.integers(-2, 3, (4, 3)) * 2.0**-51
            p[3] = p[0] + p[1] - p[2]
        expected = determinant(exact(p))
        assert tetrahedron_signs(np.arange(4)[None], p)[0][0] == (expected > 0) - (expected < 0), p


@pytest.mark.long
@pytest.mark.parametrize("common", [0, 1, 2])
def test_contacts_of_two_triangles_agree_with_the_oracle(rng, common):
    """Also of triangles in one plane, which are every third pair."""
    F = np.array([[0, 1, 2], [*range(common), *range(3, 6 - common)]])
    counts = [0, 0]
    for trial in range(200):
        X = rng.integers(-2, 3, (6 - common, 3)) * (1.0, 1.0, trial % 3 > 0)
        p = exact(X)
        if all(any(cross(minus(p[j], p[i]), minus(p[k], p[i]))) for i, j, k in F.tolist()):
            expected = meet_elsewhere(*F.tolist(), p)
            assert len(find_contacts(F, X, ExactSigns(X))) == expected, X
            counts[expected] += 1
    assert min(counts) > 20


@pytest.mark.parametrize("turn", [0, 1, 2])
def test_one_edge_of_each_triangle_meets_the_other(turn):
    """Like two links of a chain; the same edge of both, so that no edge can be left out."""
    X = np.array([[1, 1, 1], [1, 0, 0], [-1, 0, -1], [-1, -1, 0], [-1, 0, 0], [0, 1, -1]], dtype=float)
    F = np.roll([[0, 1, 2], [3, 4, 5]], turn, axis=1)
    assert find_contacts(F, X, ExactSigns(X)).tolist() == [[0, 1]]


@pytest.mark.slow
def test_tiny_meshes_agree_with_the_oracle():
    assert 15 < check_tiny_meshes(range(100)) < 85


@pytest.mark.nightly
def test_more_tiny_meshes_agree_with_the_oracle():
    check_tiny_meshes(range(1000, 1300))


def test_a_ball_covered_twice_is_not_injective():
    X, T = double_cover()
    found = certify_tetrahedra(T, X)
    assert found.positive
    assert not len(found.crossings)
    assert found.injective is False
    assert found.multiply_covered.size == 1
    assert "twice" in found.summary()
    # The sheet alone whose sphere was pushed outwards is a ball.
    X, T = ball()
    assert certify_tetrahedra(T, X).injective


@pytest.mark.slow
def test_components_inside_each_other():
    X, T = box(2, 2, 2)
    for scale, away, injective in ((0.1, 0.4, False), (0.1, 2.0, True), (1.0, 1.0, False), (1.0, 1.5, True)):
        both = np.concatenate([X, scale * X + away])
        found = certify_tetrahedra(np.concatenate([T, T + len(X)]), both)
        assert found.injective == injective, (scale, away)
        # Cubes that touch at a corner meet there; one inside the other does not touch it.
        assert bool(len(found.crossings)) == (scale == away)


@pytest.mark.slow
def test_a_cavity_is_no_overlap():
    X, T = box(5, 5, 5)
    shell = T[np.abs(X[T].mean(axis=1) - 0.5).max(axis=1) > 0.1]
    assert len(shell) == len(T) - 6
    assert certify_tetrahedra(shell, X).injective
    # Inside the cavity there is room for a component.
    small, S = box(1, 1, 1, size=0.1)
    both = np.concatenate([X, small + 0.45])
    assert certify_tetrahedra(np.concatenate([shell, S + len(X)]), both).injective
    # Inside out: every tetrahedron is inverted.
    assert len(certify_tetrahedra(shell, -X).inverted) == len(shell)


def test_names_what_is_wrong():
    X, T = box(2, 1, 1)
    broken = X.copy()
    broken[T[3, 0]] = np.nan
    found = certify_tetrahedra(T, broken)
    assert 3 in found.nonfinite
    assert found.injective is False
    assert certify_tetrahedra(np.concatenate([T, T[4:5]]), X).repeated.tolist() == [len(T)]
    # Even permutations of the vertices are the same tetrahedron.
    found = certify_tetrahedra(np.concatenate([T, T[4:5, [1, 2, 0, 3]]]), X)
    assert found.repeated.tolist() == [len(T)]
    flat = X.copy()
    flat[:, 2] = 0
    assert len(certify_tetrahedra(T, flat).degenerate) == len(T)
    apex = np.concatenate([X, [(0.25, 0.2, 0.3)]])
    inner = np.append(T[0, :3], len(X))
    found = certify_tetrahedra(np.concatenate([T, [inner]]), apex)
    assert found.injective is False
    assert f"({', '.join(map(str, sorted(T[0, :3].tolist())))})" in found.summary()
    assert certify_tetrahedra(np.empty((0, 4)), X).injective is False
    assert certify_tetrahedra(T, X, boundary=False).injective is None


def test_crossing_boundary_triangles_are_named():
    X, T = box(4, 1, 1)
    bent = X.copy()
    angle = 7.0 * X[:, 0]
    bent[:, 0], bent[:, 1] = (0.9 + X[:, 1]) * np.sin(angle), (0.9 + X[:, 1]) * -np.cos(angle)
    found = certify_tetrahedra(T, bent)
    assert found.injective is False
    assert len(found.crossings)
    assert "boundary triangles meet" in found.summary()


@pytest.mark.parametrize("scale", [1e-150, 1e150])
def test_scales(scale):
    X, T = box(2, 2, 2)
    assert certify_tetrahedra(T, scale * X).injective
    X, T = double_cover()
    assert certify_tetrahedra(T, scale * X).multiply_covered.size == 1


@pytest.mark.parametrize(
    ("T", "X", "message"),
    [
        ([[0, 1, 2, 4]], np.eye(4, 3), "T refers to vertex 4"),
        ([[0, 1, 2]], np.eye(4, 3), r"T must have shape \(t, 4\)"),
        ([list(range(10))], np.zeros((10, 3)), "second-order tetrahedra are not supported"),
        ([list(range(8))], np.zeros((8, 3)), "hexahedra are not supported"),
        ([[0, 1, 2, 3]], np.eye(4, 2), r"X must have shape \(n, 3\)"),
    ],
)
def test_wrong_arguments(T, X, message):
    with pytest.raises(ValueError, match=message):
        certify_tetrahedra(T, X)


SUFFIXES = (".vtu", ".vtk", ".msh")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_qhm_check_certifies_the_file(suffix, tmp_path, capsys):
    X, T = box(2, 2, 2)
    path = tmp_path / f"mesh{suffix}"
    walls = certify_tetrahedra(T, X).boundary
    form = {"file_format": "gmsh22"} if suffix == ".msh" else {}
    meshlane.write(path, meshlane.Mesh(X, [("triangle", walls), ("tetra", T)]), **form)
    read = read_volume(path)
    np.testing.assert_array_equal(read.F, T)
    np.testing.assert_array_equal(read.points, X)
    assert main(["check", str(path), "--json", str(tmp_path / "report.json")]) == 0
    assert "Injective: the boundary does not meet itself" in capsys.readouterr().out
    assert json.loads((tmp_path / "report.json").read_text())["boundary_triangles"] == len(walls)
    X[13] = (0.9, 0.9, 0.2)
    meshlane.write(path, meshlane.Mesh(X, [("tetra", T)]), **form)
    assert main(["check", str(path)]) == 1
    assert "are inverted" in capsys.readouterr().out


def test_qhm_check_judges_rounded_positions(tmp_path, capsys):
    """A tetrahedron that is positive in doubles is flat after the file has stored single precision."""
    X = np.array([(0, 0, 1), (1, 0, 1), (0, 1, 1), (1 / 3, 1 / 3, 1 + 1e-12)])
    path = tmp_path / "mesh.vtu"
    meshlane.write(path, meshlane.Mesh(X, [("tetra", [[0, 1, 2, 3]])]))
    assert main(["check", str(path)]) == 0
    meshlane.write(path, meshlane.Mesh(X.astype(np.float32), [("tetra", [[0, 1, 2, 3]])]))
    assert main(["check", str(path)]) == 1
    assert "tetrahedron 0 is degenerate" in capsys.readouterr().out


def test_qhm_check_reports_hexahedra_by_their_corners(tmp_path, capsys):
    X = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1.0)])
    path = tmp_path / "mesh.vtu"
    meshlane.write(path, meshlane.Mesh(X, [("hexahedron", [list(range(8))])]))
    assert main(["check", str(path), "--json", "-"]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["injective"] is None
    assert "does not certify" in printed.err
    X[6] = (0.2, 0.2, 0.2)
    meshlane.write(path, meshlane.Mesh(X, [("hexahedron", [list(range(8))])]))
    assert main(["check", str(path)]) == 1
    assert "hexahedron 0" in capsys.readouterr().out


def test_second_order_tetrahedra_and_prisms_are_rejected(tmp_path, capsys):
    X = np.random.default_rng(0).random((10, 3))
    for kind, count, name in (("tetra10", 10, "second-order tetrahedron"), ("wedge", 6, "wedge")):
        meshlane.write(tmp_path / "mesh.vtu", meshlane.Mesh(X, [(kind, [list(range(count))])]))
        assert main(["check", str(tmp_path / "mesh.vtu")]) == 2
        assert f"cells of type {name} are not supported: use tetrahedra" in capsys.readouterr().err
